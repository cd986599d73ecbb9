"""Revised affine arithmetic along a path: a function is a line plus a bounded error. A path is a
piece of a ray; s is the length along it, from 0 at its start to h at its end, and e = 2s/h - 1 goes
from -1 to 1. A number of this arithmetic (`AffineForm`) stands for a function c + l e + r with
numbers c and l and an unknown r with |r| <= error. Sums are exact. Products and functions put the
terms that are not linear in s into the error. A formula that is evaluated with the coordinates of
the path as such numbers returns such a number.

Unlike `ParabolaBounds`, such a number is not exact at s = 0. If it proves nothing on a length, the
march tries shorter lengths.

Source: Vu, Sam-Haroud and Faltings 2009; Fryazinov, Pasko and Comninos 2010.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.interval import Interval, machine_epsilon
from harnack.arithmetic.operators import FormulaNumber
from harnack.backend.elementary import fmax, fmin
from harnack.literature.relative_angle import relative_angle

if TYPE_CHECKING:
    from harnack.arithmetic.functions import ElementaryFunction
    from harnack.backend import Real, Vec3

# The number of units in the last place, of the sum of all absolute values, that bounds rounding.
_ROUNDINGS = 16.0


@dataclass(frozen=True, eq=False)
class AffineForm(FormulaNumber):
    """A function center + slope e + r along a path, with an unknown r, |r| <= error. Here e = 2s/h
    - 1 goes from -1 to 1 for the length s along the path, 0 <= s <= h.

    center, slope, error: numbers of the backend.
    """

    center: Real
    slope: Real
    error: Real

    @classmethod
    def along_ray(
        cls, p: Vec3, direction: Vec3, length: Real
    ) -> tuple[AffineForm, AffineForm, AffineForm]:
        """The three coordinates of the points p + s d as functions of s, for 0 <= s <= length.

        direction: d.
        """

        def coordinate(x: Real, rate: Real) -> AffineForm:
            """The function x + s rate. Its error is caused by rounding alone."""
            half = 0.5 * length * rate
            return cls(x + half, half, _rounding_bound(dr.abs(x) + dr.abs(half)))

        x, y, z = (coordinate(p[k], direction[k]) for k in range(3))
        return x, y, z

    @property
    def range(self) -> Interval:
        """The range of the function on the whole path: center plus and minus the size of slope and
        error."""
        half_width = dr.abs(self.slope) + self.error
        rounding = _rounding_bound(dr.abs(self.center) + half_width)
        return Interval(self.center - half_width - rounding, self.center + half_width + rounding)

    def constant(self, x: float | Real) -> AffineForm:
        """The constant number x as a function along the same path. Its error is caused by rounding
        alone; it is 0 for small integers and Dr.Jit numbers."""
        kind = cast("Any", type(self.center))
        value = kind(x)
        exact = not isinstance(x, int | float) or (float(x).is_integer() and abs(x) < 2**20)
        error = 0 * value if exact else _rounding_bound(dr.abs(value))
        return AffineForm(value, 0 * self.center, error)

    def __neg__(self) -> AffineForm:
        return AffineForm(-self.center, -self.slope, self.error)

    def sum(self, other: Any) -> AffineForm:
        """The sum of this function and another one. It is exact up to rounding, which goes into the
        error."""
        center, slope = self.center + other.center, self.slope + other.slope
        return AffineForm(
            center,
            slope,
            self.error + other.error + _rounding_bound(dr.abs(center) + dr.abs(slope)),
        )

    def product(self, other: Any) -> AffineForm:
        """The product of this function and another one.

        Proof. In (c + l e + r)(d + m e + q), e^2 lies in [0, 1], so l m e^2 is within |l m|/2 of l
        m/2. The other terms that are not linear in e go into the error.
        """
        c, l, r = self.center, self.slope, self.error  # noqa: E741
        d, m, q = other.center, other.slope, other.error
        half = 0.5 * l * m
        error = (dr.abs(c) + dr.abs(l)) * q + (dr.abs(d) + dr.abs(m)) * r + r * q + dr.abs(half)
        size = (dr.abs(c) + dr.abs(l) + r) * (dr.abs(d) + dr.abs(m) + q)
        return AffineForm(c * d + half, c * m + d * l, error + _rounding_bound(size))

    def apply(self, function: ElementaryFunction) -> AffineForm:
        """The composition phi(f) of an elementary function phi with this function f. phi is
        replaced by a line plus an error: its chord, a line of its mean slope, or a constant,
        whichever has the smallest error.

        Proof. Let f have the range [x, y] of width w, and let m be the middle of the range. For the
        chord, phi(t) is above it by -phi''(z) (t - x)(y - t)/2 for some z. This is at most max(0,
        -min phi'' w^2/8) and at least min(0, -max phi'' w^2/8). For the mean slope, if phi' is in
        [D-, D+], phi(t) is within (D+ - D-)/2 |t - m| of phi(m) + (D+ + D-)/2 (t - m). For the
        constant, phi stays within its range.
        """
        f_range = self.range
        value, slopes, curvature = function.ranges(f_range)
        width = f_range.upper - f_range.lower
        epsilon = machine_epsilon(width)
        # The ranges of phi at the two ends of the range of f; they contain the rounding of phi.
        ends = [function.ranges(Interval(end, end))[0] for end in (f_range.lower, f_range.upper)]
        chord_slope = dr.select(width > 0, (ends[1].midpoint - ends[0].midpoint) / width, 0)
        chord_slope = dr.select(dr.isfinite(chord_slope), chord_slope, 0)
        eighth = 0.125 * width * width
        max_above_chord, min_above_chord = (
            fmax(-curvature.lower * eighth, 0),
            fmin(-curvature.upper * eighth, 0),
        )
        end_size = dr.abs(ends[0].midpoint) + dr.abs(ends[1].midpoint)
        # Each line as (its value in the middle of the range, its slope by f, its error).
        chord = (
            0.5 * (ends[0].midpoint + ends[1].midpoint) + 0.5 * (max_above_chord + min_above_chord),
            chord_slope,
            0.5 * (max_above_chord - min_above_chord)
            + ends[0].radius
            + ends[1].radius
            + _rounding_bound(end_size),
        )
        middle = 0.5 * f_range.lower + 0.5 * f_range.upper
        middle_value = function.ranges(Interval(middle, middle))[0]
        mean_slope_line = (
            middle_value.midpoint,
            slopes.midpoint,
            (slopes.radius * width * 0.5 + middle_value.radius) * (1 + 8 * epsilon)
            + _rounding_bound(dr.abs(middle_value.midpoint) + dr.abs(slopes.midpoint) * width),
        )
        constant_line = (
            value.midpoint,
            0 * width,
            value.radius + _rounding_bound(dr.abs(value.midpoint)),
        )
        best = _smaller_error(_smaller_error(chord, mean_slope_line), constant_line)
        best_center, best_slope, best_error = best
        # The line as a function of e, by f = self.center + self.slope e + r.
        shift = best_slope * (self.center - middle)
        rounding = _rounding_bound(
            dr.abs(best_center)
            + dr.abs(best_slope) * (dr.abs(self.center) + dr.abs(self.slope) + self.error)
        )
        return AffineForm(
            best_center + shift,
            best_slope * self.slope,
            best_error + dr.abs(best_slope) * self.error + rounding,
        )

    def pointwise_maximum(self, other: Any) -> AffineForm:
        """The maximum of this function f and another function g, as g + max(f - g, 0). On lanes on
        which f or g is proved to be the larger one on the whole path, it is f or g itself."""
        difference = self.sum(-other)
        difference_range = difference.range
        is_self_larger, is_other_larger = difference_range.lower >= 0, difference_range.upper <= 0
        # max(t, 0) on [x, y], x < 0 < y: its chord has slope y/(y - x) and lies above by at most
        # -x y/(y - x), at 0.
        chord_slope = difference_range.upper / (difference_range.upper - difference_range.lower)
        # The line lies in the middle between the chord and the chord lowered by `excess`.
        excess = -difference_range.lower * chord_slope
        center = chord_slope * (difference.center - difference_range.lower) - 0.5 * excess
        size = dr.abs(chord_slope) * (
            dr.abs(difference.center)
            + dr.abs(difference_range.lower)
            + dr.abs(difference_range.upper)
        )
        positive_part = AffineForm(
            center,
            chord_slope * difference.slope,
            chord_slope * difference.error + 0.5 * excess + _rounding_bound(size),
        )
        general_maximum = other.sum(positive_part)
        return AffineForm(
            *(
                dr.select(is_self_larger, u, dr.select(is_other_larger, v, w))
                for u, v, w in zip(
                    _entries(self), _entries(other), _entries(general_maximum), strict=True
                )
            )
        )

    def polar_angle(self, x: Any) -> AffineForm:
        """The polar angle atan2(y, x) of the point z = (x, y), where y is this function: the angle
        of a direction c near the middle of z's range, plus the angle of z relative to c
        (`relative_angle`). Where that is not proved, only [-pi, pi] is known.
        """
        # c = (a, b). The range of its angle is as narrow as rounding: its middle belongs to the
        # center, its radius to the error.
        relative, is_valid, a, b = relative_angle(self, x, self.center, x.center)
        c_angle, _ = angle_range(Interval.point(b), Interval.point(a))
        center = relative.center + c_angle.midpoint
        error = (
            relative.error
            + c_angle.radius
            + _rounding_bound(dr.abs(center) + dr.abs(c_angle.midpoint))
        )
        is_valid &= dr.isfinite(center) & dr.isfinite(relative.slope) & dr.isfinite(error)
        half_turn = math.pi * (1 + 1e-6)  # above pi in every precision
        return AffineForm(
            dr.select(is_valid, center, 0),
            dr.select(is_valid, relative.slope, 0),
            dr.select(is_valid, error, half_turn),
        )


def _entries(x: AffineForm) -> tuple[Real, Real, Real]:
    """Center, slope and error of an affine form as a tuple."""
    return x.center, x.slope, x.error


def _smaller_error(
    first: tuple[Real, Real, Real], second: tuple[Real, Real, Real]
) -> tuple[Real, Real, Real]:
    """The line with the smaller error of the lines `first` and `second`, each given by (center,
    slope, error). If one of the two has a number that is not finite, it is the other line."""
    is_first_finite = dr.isfinite(first[0]) & dr.isfinite(first[1]) & dr.isfinite(first[2])
    is_second_finite = dr.isfinite(second[0]) & dr.isfinite(second[1]) & dr.isfinite(second[2])
    use_first = is_first_finite & ((first[2] <= second[2]) | ~is_second_finite)
    x, y, z = (dr.select(use_first, u, v) for u, v in zip(first, second, strict=True))
    return x, y, z


def _rounding_bound(size: Real) -> Real:
    """A bound of the errors by rounding and underflow in a computed sum.

    size: the sum of the absolute values of its terms.
    """
    smallest = float(dr.smallest(cast("Any", type(size))))
    return dr.fma(size, _ROUNDINGS * machine_epsilon(size), _ROUNDINGS * smallest)
