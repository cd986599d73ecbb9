"""Enclosures by lines and parabolas. An enclosure bounds F(s), the change of a function f along a
path (a ray) from its value at a sample, at the length s. A level is a value of f that rays look
for; the gap to it is its difference from f at the sample.

- `ParabolaEnclosure`: between two parabolas. `LipschitzEnclosure` follows from a Lipschitz
  constant, `TaylorEnclosure` from a bound of the second derivatives.
- `ConvexityEnclosure`: a convex function lies above its tangents.
- `SphereArcEnclosure`: a parabola in the angle along a circle, for functions on the sphere S^3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin, sincos
from harnack.enclosures.enclosure import STEP_SAFETY, Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.promises import Lipschitz, Promise, TaylorRemainder

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real

_ROOT_OF_TWO = math.sqrt(2.0)


@dataclass(frozen=True)
class ParabolaEnclosure(Enclosure):
    """An enclosure of F(s), the change of f along a path at the length s, between two parabolas:
    for 0 <= s < reach

        slopes.lower s + min_second_derivative s^2/2 <= F(s)
        <= slopes.upper s + max_second_derivative s^2/2.

    The second derivatives may have either sign.

    Proof of the step. The upper parabola a s + c s^2/2 starts a gap g > 0 below the level above. It
    first reaches the level at the smallest positive root of a s + c s^2/2 = g. With r = sqrt(a^2 +
    2 c g) the root, in forms that do not cancel, is 2g/(a + r) if a > 0, and (r - a)/c if a <= 0 <
    c. There is no root if a <= 0 and c <= 0, or if r is not real. For the level below the same
    holds of -F. If the second derivatives are exact, the step is exact to second order, so that
    steps converge quadratically at the surface. The upper end increases with the largest slope, the
    lower end with the smallest.
    """

    slopes: SlopeRange
    min_second_derivative: Real
    max_second_derivative: Real
    reach: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the length up to which the upper parabola stays below the next level above, and
        the lower parabola above the next level below. It is at most `reach`, and 0 if a number is
        NaN.

        gaps: the differences between f at the sample and these two levels.
        """
        up = first_reach(gaps.above, self.slopes.upper, self.max_second_derivative)
        down = first_reach(gaps.below, -self.slopes.lower, -self.min_second_derivative)
        is_valid = (up >= 0) & (down >= 0) & (self.reach > 0)  # and not NaN
        return fmax(dr.select(is_valid, fmin(fmin(up, down), self.reach), 0) * STEP_SAFETY, 0)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which both parabolas stay between the next levels below and
        above on the length `length`, and this length is at most `reach`.

        gaps: the differences between f at the sample and these two levels.
        """
        free = _stays_below(gaps.above, self.slopes.upper, self.max_second_derivative, length)
        free &= _stays_below(gaps.below, -self.slopes.lower, -self.min_second_derivative, length)
        return (length <= 0) | ((length <= self.reach) & free)


@dataclass(frozen=True)
class LipschitzEnclosure(ParabolaEnclosure):
    """The Lipschitz cone, |F(s)| <= K s for s < reach, with a Lipschitz constant K: the step of
    sphere tracing. K and reach come from a promise (a proved bound of f near the sample).

    Proof. The bounds are parabolas without a second-order term, and the step is K^-1 times the
    smaller gap. Source: Hart 1996, Theorem 1.
    """

    @classmethod
    def from_promise(
        cls, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Self | None:
        """Return the enclosure from a `Lipschitz`, the promise of a Lipschitz constant; None for
        another kind of promise. The value of f, its error and the slopes are not used."""
        if not isinstance(promise, Lipschitz):
            return None
        constant = _nan_if_negative(promise.constant)
        # Second derivatives of 0: both parabolas are lines.
        return cls(SlopeRange(-constant, constant), 0.0, 0.0, promise.radius)

    # Both sides in one formula, for speed: a ray along an edge uses a dozen cones at each point.

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the smaller of the two gaps divided by the Lipschitz constant, at most `reach`; 0
        if a gap is 0 or a number is NaN."""
        length = gaps.nearest / self.slopes.upper
        is_valid = (gaps.below > 0) & (gaps.above > 0) & (self.slopes.upper >= 0) & (self.reach > 0)
        return dr.select(is_valid, fmin(length, self.reach), 0) * STEP_SAFETY

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to change on the length `length` by no more
        than the smaller of the two gaps, and this length is at most `reach`."""
        movement = self.slopes.upper * length
        free = (length <= self.reach) & (movement <= gaps.below) & (movement <= gaps.above)
        return (length <= 0) | free


@dataclass(frozen=True)
class TaylorEnclosure(ParabolaEnclosure):
    """Taylor's formula for F(s), the change of f along a path, with a bound H of the second
    derivatives. H comes from a promise (a proved bound of f near the sample).

    Proof. If the slope at the sample is in [low, high], the promise says that F(s) lies between low
    s - H s^2/2 and high s + H s^2/2 for s < reach, the radius of the promise.
    """

    @classmethod
    def from_promise(
        cls, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Self | None:
        """Return the enclosure from a `TaylorRemainder`, the promise of such a bound; None for
        another kind of promise. The value of f and its error are not used.

        slopes: the range of the derivative of f along the path at the sample.
        """
        if not isinstance(promise, TaylorRemainder):
            return None
        constant = _nan_if_negative(promise.constant)
        return cls(slopes, -constant, constant, promise.radius)


def _nan_if_negative(constant: Real) -> Real:
    """Return the constant of a promise; NaN if it is negative, so that nothing is proved."""
    return dr.select(constant >= 0, constant, dr.nan)


def first_reach(gap: Real, slope: Real, curvature: Real) -> Real:
    """Return the first s > 0 at which slope s + curvature s^2/2 reaches the gap; infinite if there
    is none.

    gap: the difference in value to a level, >= 0; infinite if there is no level on this side.
    slope, curvature: the slope of the parabola at s = 0, and its second derivative.

    With r = sqrt(slope^2 + 2 curvature gap), s is gap/(slope/2 + r/2) for slope > 0, and (r -
    slope)/curvature for slope <= 0 < curvature. r is computed from the larger and the smaller of
    |slope| and sqrt(2 |curvature| gap), in a form whose squares neither overflow nor underflow:
    near a zero of high order, slope, curvature and gap are all far below the square root of the
    smallest number.
    """
    no_level = gap == dr.inf  # there is no level on this side
    turns_away = curvature < 0
    gap = _rounded_down_where(turns_away, dr.select(no_level, 0, gap))
    slope_size, turn_slope = dr.abs(slope), _max_turning_slope(gap, curvature)
    larger, smaller = fmax(slope_size, turn_slope), fmin(slope_size, turn_slope)
    ratio = dr.select(larger > 0, smaller / larger, 0)
    # r; NaN where it is not real, where the result is infinite.
    root = larger * dr.sqrt(dr.fma(dr.select(turns_away, -ratio, ratio), ratio, 1))
    # Without an upward curvature and with slope <= 0 the gap is never reached; at a gap of 0 it is
    # at once.
    without_root = dr.select(slope <= 0, dr.select(gap > 0, dr.inf, 0), dr.nan)
    from_root = dr.select(curvature <= 0, without_root, (root - slope) / curvature)
    result = dr.select(slope > 0, gap / (0.5 * slope + 0.5 * root), from_root)
    return dr.select(no_level | (turns_away & (slope_size < turn_slope)), dr.inf, result)


def _stays_below(gap: Real, slope: Real, curvature: Real, length: Real) -> Mask:
    """Return the mask of lanes on which slope s + curvature s^2/2 <= gap for 0 <= s <= length.

    gap: the difference in value to a level.

    The largest value of the parabola is at s = 0, at s = length, or at its vertex if it rises and
    then falls in between.
    """
    half_change = 0.5 * curvature * length
    # The slope at the end is slope + curvature length.
    turns_back = (slope > 0) & (slope + 2 * half_change < 0)
    max_slope = _max_turning_slope(_rounded_down_where(turns_back, gap), curvature)
    return dr.select(turns_back, slope <= max_slope, (half_change + slope) * length <= gap)


def _max_turning_slope(gap: Real, curvature: Real) -> Real:
    """Return sqrt(2 |curvature| gap): the slope at the start of a parabola slope s - |curvature|
    s^2/2 whose largest value is the gap. With a smaller slope it turns back before it reaches the
    gap."""
    return dr.sqrt(dr.abs(curvature)) * (_ROOT_OF_TWO * dr.sqrt(gap))


def _rounded_down_where(turns: Mask, gap: Real) -> Real:
    """Return the gap, smaller by eight roundings on the lanes of the mask `turns`, and unchanged on
    all others.

    turns: the lanes on which the parabola slope s + curvature s^2/2 bends away from the level, so
        that it may turn back before it reaches the level. If its vertex is close to the level,
        rounding would decide whether the discriminant slope^2 + 2 curvature gap is negative, that
        is, whether the parabola reaches the level.
    """
    return dr.select(turns, gap * (1 - 8 * float(dr.epsilon(type(gap)))), gap)


@dataclass(frozen=True)
class ConvexityEnclosure(Enclosure):
    """The bound F(s) >= slopes.lower s for all s >= 0, for a function f that is convex along the
    path; F is the change of f along it.

    Proof. A convex function lies above its tangents. So f does not fall to a level at a gap g below
    before s = g/|slope|, and never if it rises at the start. Nothing is proved about levels above.
    f itself must be convex. That a solid is convex, with f a bound of the distance from it, is not
    enough (Hart 1996, equation 21: 1 - e^-d is not convex). The lower end increases with the slope.
    """

    slopes: SlopeRange

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the length on which f stays above the level below; 0 if there is a level above, if
        f is at the level below, or if the slope is NaN."""
        # f falls at most at this rate.
        rate = -self.slopes.lower
        length = dr.select(rate > 0, gaps.below / rate, dr.select(rate <= 0, dr.inf, 0))
        length = dr.select(gaps.below > 0, length * STEP_SAFETY, 0)
        return dr.select(gaps.above == dr.inf, fmax(length, 0), 0)


# Covers the rounding errors, in single precision, of the angle and of the length computed from it.
_ARC_SAFETY = 1.0 - 1e-5
_PI_BELOW = 3.14159


@dataclass(frozen=True)
class SphereArcEnclosure(Enclosure):
    """The bound |F - m psi| <= curvature psi^2/2 for functions f of points on the sphere S^3. F is
    the change of f along a line, psi the angle traveled along the line's image on the sphere, a
    circle, and m the derivative of f by psi at the start.

    By stereographic projection a line of space becomes a circle on S^3. A function that is a
    trigonometric polynomial on the circle has a bounded second derivative by its angle, from one
    end of the line to the other. A step in this angle, taken back to the line, may be infinite.

    slopes: the range of the derivative of f along the path, by length, where it starts.
    curvature: a bound of the second derivative of f by the angle, on the whole circle.
    offset: the length t along the line from q to the start of the path, where q is the point of the
        line closest to the origin.
    squared_radius: c^2 = 1 + |q|^2.

    Proof. The line x = q + t v with q . v = 0 becomes the circle of the points

        y = 2x/(1 + |x|^2) = (q (1 + cos a) + c v sin a)/c^2,   w = 1 - (1 + cos a)/c^2,

    with t = c tan(a/2), at speed da/dt = 2c/S, where S = c^2 + t^2. So m is S/(2c) times the slope
    by length, and f stays within the parabola of `curvature`. `first_reach` gives the first psi at
    which that parabola meets a gap. From t the angle psi leads to t + s with

        s = S sin(psi/2)/(c cos(psi/2) - t sin(psi/2)),

    and to infinity, where the path ends, as soon as the denominator is not positive: then no level
    is ever met. Relative errors of slope, curvature, gap and length change psi by at most as much,
    and an error of the denominator acts as one of psi of the same relative size. `_ARC_SAFETY`
    covers them. Both ends increase with the slope.
    """

    slopes: SlopeRange
    curvature: Real
    offset: Real
    squared_radius: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the length of the line on which f is proved to take neither of the next levels
        below and above; infinite if no level is ever met.

        gaps: the differences between f at the start and these levels.

        Let t (`offset`) be the position of the start on the line, measured from the line's point q
        closest to the origin, and c^2 = 1 + |q|^2 (`squared_radius`). `square_sum` is S = c^2 +
        t^2, `length_per_angle` is dt/da = S/(2c) at the start, and `half_angle` is half the
        smallest angle psi at which f may reach a level. The result is the length s that belongs to
        psi.
        """
        c = dr.sqrt(self.squared_radius)
        square_sum = dr.fma(self.offset, self.offset, self.squared_radius)
        length_per_angle = 0.5 * square_sum / c
        angle_above = first_reach(gaps.above, self.slopes.upper * length_per_angle, self.curvature)
        angle_below = first_reach(gaps.below, -self.slopes.lower * length_per_angle, self.curvature)
        half_angle = 0.5 * _ARC_SAFETY * fmin(angle_above, angle_below)
        is_valid = (angle_above >= 0) & (angle_below >= 0) & (self.curvature >= 0)  # and not NaN
        is_valid &= dr.isfinite(square_sum)  # its square does not overflow
        is_full_turn = half_angle >= _PI_BELOW  # once around the circle
        sin, cos = sincos(dr.select(is_full_turn, 0, half_angle))
        divisor = dr.fma(c, cos, -self.offset * sin)
        length = dr.select(
            (divisor > 0) & ~is_full_turn, square_sum * sin / divisor * _ARC_SAFETY, dr.inf
        )
        return dr.select(is_valid, fmax(length, 0), 0)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return (length <= 0) | (length <= self.free_length(gaps))
