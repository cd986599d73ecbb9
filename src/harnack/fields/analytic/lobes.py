"""The lobes |x| = |Y(x/|x|)| of a function Y on the unit sphere, as in pictures of atomic orbitals.
Y is a real spherical harmonic, or a sum of these with coefficients called weights. For a point x, u
= x/|x| is its direction from the origin and r = |x|/scale its scaled distance; in the methods "for
scale 1" r is the distance itself. The field f is negative inside of the lobes and 0 on their
surface. Either the lobes of both signs of Y are drawn, or only those where Y is positive or
negative."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin, safe_norm
from harnack.backend.validation import as_finite, as_positive, integer
from harnack.enclosures import SlopeRange, TaylorRemainder
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.samples import RaySample, space_scaled
from harnack.fields.analytic.rounding import HarmonicRounding
from harnack.fields.analytic.solid_harmonics import (
    LARGEST_DEGREE,
    Weights,
    degree_and_order,
    evaluate,
    hessian,
)
from harnack.fields.analytic.sphere_bounds import BallRange, range_of_harmonic
from harnack.fields.attached_arrays import scaled_in_space, with_formula
from harnack.fields.attached_numbers import attached_vector
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Sample, Traits
from harnack.fields.parameters import kept_arguments, record_call
from harnack.geometry.clip_volumes import Ball
from harnack.name_suggestions import is_one_of

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures.samples import Ray
    from harnack.geometry.volume import Volume

__all__ = ["Lobes"]

LobeSign = Literal["both", "positive", "negative"]
_SIGNS: tuple[LobeSign, ...] = ("both", "positive", "negative")
# Ends of promised ranges are moved outwards by this fraction for the roundings of float32.
_ROUNDING = 1e-5
# For each precision a number m. The scale and the largest |Y| must be from 1/m to m: the fourth
# powers of such numbers neither overflow nor underflow.
_LARGEST_SIZE = {"single": 1e6, "double": 1e60}
# Added to bounds of second derivatives, so that they are not 0.
_MIN_BOUND = 1e-20


class Lobes(Field):
    """The surface |x| = scale |Y(x/|x|)| of a function Y on the unit sphere, a real spherical
    harmonic (as in `SphericalHarmonic`: orthonormal, without the Condon-Shortley phase, of a degree
    up to 12) or a sum of these; or only its lobes of one sign of Y. With r = |x|/scale and u =
    x/|x|, the field is f = r^2 (r^2 - Y(u)^2) for both signs, and f = r^2 (r - Y(u)) or r^2 (r +
    Y(u)) for the lobes where Y is positive or negative. The lobes are the points with f <= 0.

    Orders m > 0 contain cos(m phi), orders m < 0 contain sin(|m| phi). The factor r^2 makes second
    derivatives bounded at the origin, where all lobes meet: f and its gradient vanish there, and
    the origin belongs to the surface. So a mesh of both signs crosses itself at the origin and is
    refused: mesh `positive` and `negative`, one by one. To distinguish signs by color, draw both
    parts:

        lobes, signs = hk.fields.Lobes(3, 2), ["plastic", "porcelain"]
        hk.render([lobes.positive, lobes.negative], material=signs, side="below")

    l, m: degree 0 <= l <= 12 and order -l <= m <= l.
    scale: a positive number, the length of a lobe in which Y reaches 1.
    sign: "both", "positive" or "negative".

    Bounds of second derivatives, for scale 1. Let W be Y^2 for both signs, else Y or -Y, so that f
    = r^4 - r^2 W or f = r^3 - r^2 W. Let L be the degree of Y and N that of W (2 L or L). Along a
    great circle W is a trigonometric polynomial T of degree N, whose values lie within A of the
    middle of its range. So T' = N A a and T" = N^2 A b with a^2 + b^2 <= 1 (Bernstein and Szego,
    for T and then T'). r^2 W has the same second derivatives at x as at u = x/|x|. Take the unit
    vector c u + q v, where v is at right angles to u and c^2 + q^2 = 1: along it they are

        2 W + 2 c q T' + q^2 T",   and   |2 c q T' + q^2 T"| <= q N A sqrt(4 c^2 + q^2 N^2)

    (Cauchy and Schwarz), at most N^2 A for N >= 2 and 2 A/sqrt(3) for N = 1. The second derivatives
    of r^3 are in [0, 6 r], those of r^4 in [0, 12 r^2]. So those of f along a segment are bounded
    on both sides by functions of the larger distance of its ends from the origin. The gradient is
    continuous and 0 at the origin, so this also holds for segments through the origin.

    Raises:
        ValueError: l, m, scale or sign out of range; no direction with that sign.
        TypeError: l or m is no integer.
    """

    traits = Traits(over_relaxation=1.6, differentiable_arguments=("scale",))

    def __init__(self, l: int, m: int, *, scale: float = 1.0, sign: LobeSign = "both") -> None:  # noqa: E741
        """Set up the lobes of a single spherical harmonic, Y_lm. The class describes the arguments
        `scale` and `sign`."""
        self._initialize({(integer(l, "l"), integer(m, "m")): 1.0}, scale, sign)

    @classmethod
    def combined(
        cls,
        weights: Mapping[tuple[int, int], float],
        *,
        scale: float = 1.0,
        sign: LobeSign = "both",
    ) -> Lobes:
        """The lobes of a sum Y of real spherical harmonics.

        weights: a mapping {(l, m): c}, for the sum of c Y_lm.
        scale: a positive number, the length of a lobe in which Y reaches 1.
        sign: "both", "positive" or "negative": for which signs of Y lobes are drawn.

        Raises:
            ValueError: a weight, the scale or the sign is out of range; no direction has that sign.
            TypeError: the weights are no mapping of pairs of integers to numbers.
        """
        field = cls.__new__(cls)
        field._initialize(weights, scale, sign)
        record_call(field, (weights,), {"scale": scale, "sign": sign}, "combined")
        return field

    def _initialize(self, weights: Any, scale: Any, sign: LobeSign) -> None:
        """Check the parameters, and compute a proved range of Y.

        weights: a mapping {(l, m): c}, for the sum Y of c Y_lm.
        scale: the length of a lobe in which Y reaches 1.
        sign: "both", "positive" or "negative".
        """
        self.weights = _checked(weights)
        scale = as_positive(scale, "the scale of lobes")
        if not is_one_of(sign, _SIGNS):
            raise ValueError(f"part must be one of {', '.join(_SIGNS)}, not {sign!r}")
        self.scale = scale
        self.part: LobeSign = sign
        (first_harmonic, *other_harmonics) = self.weights
        if other_harmonics:
            # The range of the sum of solid harmonics on the unit ball, which contains the sphere.
            value_range = BallRange.of(self.weights).with_spheres(self.weights, 1.0).on_ball(1.0)
        else:
            # A single harmonic has a sharper range. A negative weight exchanges its ends.
            weight = self.weights[first_harmonic]
            low, high = (weight * end for end in range_of_harmonic(*first_harmonic))
            value_range = min(low, high), max(low, high)
        self.value_range = value_range
        # The rounding of the division x/|x| is counted in `_errors`.
        self._rounding = HarmonicRounding.of(self.weights, is_divided=False)
        if self.extent_radius() <= 0:
            raise ValueError(f"there is no direction in which the function is {sign}")

    @property
    def positive(self) -> Lobes:
        """The field of the lobes where Y is positive, alone."""
        return self._only("positive")

    @property
    def negative(self) -> Lobes:
        """The field of the lobes where Y is negative, alone."""
        return self._only("negative")

    def _only(self, sign: LobeSign) -> Lobes:
        """The lobes of the same Y and scale where Y has this sign."""
        scale = kept_arguments(self).get("scale", self.scale)  # one with derivatives is refused
        return Lobes.combined(self.weights, scale=scale, sign=sign)

    def with_attached_numbers(self, backend: Backend) -> Lobes:
        """The copy whose formula has derivatives by the scale: f is that of the scale 1 at p/scale
        (`_LobesEvaluator`)."""
        (scale,) = attached_vector([kept_arguments(self)["scale"]], [self.scale], backend)
        return with_formula(self, scaled_in_space(self.evaluator(backend), scale))

    @property
    def degree(self) -> int:
        """The degree of Y: the largest degree of a spherical harmonic in it."""
        return max(l for l, _ in self.weights)  # noqa: E741

    def extent_radius(self) -> float:
        """A proved upper bound of the length of the longest lobe (the distance of its tip from the
        origin); 0 or less if there is no lobe of the chosen sign."""
        low, high = self.value_range
        ends = {"both": max(-low, high), "positive": high, "negative": -low}
        return self.scale * ends[self.part]

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f for any plan. The scale lies on the backend as data, not as a literal:
        Dr.Jit then need not compile its code again for another scale.

        Raises:
            ValueError: the scale or the largest |Y| is too small or too large for the precision.
        """
        del plan
        limit, largest = _LARGEST_SIZE[backend.precision], max(map(abs, self.value_range))
        if not (1 / limit <= self.scale <= limit and 1 / limit <= largest <= limit):
            raise ValueError(
                f"lobes in {backend.precision} precision need a scale and a largest |Y| from "
                f"{1 / limit:.0e} to {limit:.0e}, not {self.scale:.3g} and {largest:.3g}: choose "
                "another unit of length"
            )
        scale = dr.opaque(backend.Float, self.scale)
        return _LobesEvaluator(self.weights, self.part, scale, self.value_range, self._rounding)

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """A ball about the origin that contains the level sets.

        levels: the levels of f.

        Proof for scale 1 and a level c > 0. Let a be the length of the longest lobe, and let W be
        Y^2 for both signs, else Y or -Y. For r >= a, r^2 - W >= (r - a)^2 for both signs and r - W
        >= r - a for one sign, and r^2 >= (r - a)^2. So f > c where r > a + c^(1/4) or, for one
        sign, r > a + c^(1/3). Levels c <= 0 are within a.
        """
        beyond = max(*levels, 0.0) ** (1 / 4 if self.part == "both" else 1 / 3)
        # (1e-6 covers the rounding of the radius.)
        return Ball(radius=(self.extent_radius() + self.scale * beyond) * (1 + 1e-6))

    def describe(self) -> dict[str, Any]:
        """The degree, the chosen sign and the length of the longest lobe, as a dictionary for
        users."""
        return {"degree": self.degree, "lobes": self.part, "longest": self.extent_radius()}


@dataclass(frozen=True, eq=False)
class _LobesEvaluator(Evaluator):
    """The evaluator of the field f of lobes (`Lobes`), on a backend.

    weights: a mapping {(l, m): c}, for the sum Y of c Y_lm.
    part: for which signs of Y lobes are drawn.
    scale: the length of a lobe in which Y reaches 1, a number of the backend.
    value_range: an interval that contains all values of Y on the unit sphere.
    rounding: bounds of the rounding of Y and of its gradient.
    """

    weights: Weights
    part: LobeSign
    scale: Real
    value_range: tuple[float, float]
    rounding: HarmonicRounding

    @property
    def degree(self) -> int:
        """The degree of Y: the largest degree of a spherical harmonic in it."""
        return max(l for l, _ in self.weights)  # noqa: E741

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value, gradient and bounds of second derivatives of f on balls about p.
        It is that of lobes of scale 1 at p/scale, scaled back."""
        return space_scaled(self._unscaled(p / self.scale), self.scale)

    def _unscaled(self, x: Vec3) -> Sample:
        """The sample at points x for lobes of scale 1: value, gradient, bounds of their errors, and
        bounds of second derivatives on balls."""
        r = safe_norm(x)
        at_origin = r <= float(dr.smallest(type(r))) ** 0.25  # f is 0 up to rounding
        # At the origin any direction will do.
        u = dr.select(at_origin, type(x)(0, 0, 1), x / dr.select(at_origin, 1, r))
        r = dr.select(at_origin, 0, r)
        y_value, y_gradient = evaluate(self.weights, u.x, u.y, u.z)
        tangential = type(x)(*y_gradient)
        tangential -= dr.dot(tangential, u) * u  # the gradient of Y(x/r), times r
        # f = r^4 - r^2 Y^2 or r^3 - r^2 Y. The gradient of r is u, that of Y is tangential/r.
        if self.part == "both":
            value = r * r * ((r - y_value) * (r + y_value))
            gradient = r * ((4 * r * r - 2 * y_value * y_value) * u - (2 * y_value) * tangential)
        else:
            y_value, tangential = (
                (y_value, tangential) if self.part == "positive" else (-y_value, -tangential)
            )
            value = r * r * (r - y_value)
            gradient = r * ((3 * r - 2 * y_value) * u - tangential)
        tangential_norm = safe_norm(tangential)
        error, gradient_error = self._errors(
            r, y_value, tangential_norm, dr.sqrt(u.x * u.x + u.y * u.y)
        )
        lower, upper = self._second_derivatives(1.5 * r + 0.5)
        # On the ball of this radius, the distance from the origin is at most 1.5 r + 0.5.
        promises = [TaylorRemainder(fmax(-lower, upper), 0.5 * (r + 1))]
        if self.part == "both" and self.degree > 0:
            promises.append(self._local_remainder(r, y_value, tangential_norm))
        return Sample(value, gradient, tuple(promises), error, gradient_error)

    def _local_remainder(self, r: Real, y: Real, slope: Real) -> TaylorRemainder:
        """A bound of second derivatives of f on a small ball about a point x, for the lobes of both
        signs and scale 1.

        It is sharp where Y and its slope are far smaller than elsewhere: between lobes that come
        close to each other.

        r: the distance of x from the origin.
        y: Y(u) at the direction u of x.
        slope: the length of the gradient of Y on the unit sphere at u.

        Proof, for the ball B(x, q r) with q <= 1/4. The directions of its points from the origin
        are within the angle 1.05 q of u. Let M be the largest |Y| and L the degree of Y. Second
        derivatives of Y along the sphere are at most L^2 M, so at these directions slopes are at
        most G = |slope| + 1.05 q L^2 M, and |Y| <= H = |Y(u)| + 1.05 q G. Second derivatives along
        a unit vector with the radial component c and the tangential component t are, for r^2 Y^2, 2
        Y^2 + 2 Y (2 c t Y' + t^2 Y") + 2 t^2 Y'^2. This is at most 2 H^2 + 2 H b + 2 G^2, where b
        bounds |2 c t Y' + t^2 Y"| (the class docstring has such bounds, here for Y itself). The
        second derivatives of r^4 are at most 12 r^2. As f = r^4 - r^2 Y^2, its second derivatives
        are between minus the first bound and 12 r^2 + 2 H b.
        """
        max_value, degree = max(map(abs, self.value_range)), self.degree
        # Near the surface |Y| is r. Where its slope is 0, it changes by about r within the angle
        # sqrt(r/M)/L.
        radius_fraction = fmin(0.8 * dr.sqrt(r / max_value), 0.25) / degree
        second_max = degree**2 * max_value
        max_slope = slope + (1.05 * second_max) * radius_fraction
        max_abs = dr.abs(y) + 1.05 * radius_fraction * max_slope
        tangential_bound = second_max if degree > 1 else 2 / math.sqrt(3) * max_value
        bound = 2 * (max_abs * (max_abs + tangential_bound) + max_slope * max_slope)
        bound = fmax(
            bound, 12 * dr.square(r * (1 + radius_fraction)) + 2 * max_abs * tangential_bound
        )
        return TaylorRemainder(bound * (1 + _ROUNDING) + _MIN_BOUND, radius_fraction * r)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the position t of a ray, with enclosures (proved bounds of f along the ray)
        in front of the point and behind it. Some follow from the sample. The others are parabolas,
        from ranges of the second derivatives of f on the whole length that is asked for.

        path: the ray.
        t: a length along it.
        ahead, back: the lengths in front of and behind the point on which bounds are wanted.
        """
        p = path.point(t)
        sample = self.evaluate(p)
        from_sample = path.enclose(sample)
        slopes = SlopeRange.around(from_sample.slope, sample.gradient_error)

        def enclosure(length: Real, sign: int, slope_range: SlopeRange) -> ParabolaEnclosure:
            """Two parabolas that bound f on a length of the ray, from below and from above.

            length: the length; if it is infinite, 4 (|p| + scale) is taken instead.
            sign: 1 for the length in front of the point, -1 for the length behind it.
            slope_range: the range of the derivative of f in that direction.
            """
            length = dr.select(dr.isfinite(length), length, 4 * (safe_norm(p) + self.scale))
            end = dr.fma(type(p)(sign * length), path.direction, p)
            # The distance from the origin is largest at an end of the length.
            farthest = fmax(safe_norm(p), safe_norm(end)) * ((1 + _ROUNDING) / self.scale)
            inverse_square = 1 / dr.square(self.scale)
            lower, upper = self._second_derivatives(farthest)
            return ParabolaEnclosure(
                slope_range, inverse_square * lower, inverse_square * upper, length
            )

        forward, backward = enclosure(ahead, 1, slopes), enclosure(back, -1, slopes.negated())
        return RaySample(
            sample,
            (*from_sample.forward, forward),
            (*from_sample.backward, backward),
            from_sample.slope,
        )

    def _second_derivatives(self, farthest: Real) -> tuple[Real, Real]:
        """Bounds (lower, upper) of the second derivatives of f along any line, for scale 1; `Lobes`
        has the proof.

        farthest: the bounds hold at points within this distance of the origin.

        f is r^4 or r^3, minus r^2 W with W = Y^2 for both signs, else Y or -Y. In the code [low,
        high] is the range of W and `degree` its degree; `tangential_bound` bounds by how much
        second derivatives of r^2 W differ from 2 W; `power` is the largest second derivative of r^3
        or r^4.
        """
        low, high = self.value_range
        if self.part == "both":
            # The range of W = Y^2 is taken as [0, the largest Y^2].
            upper, degree = max(low * low, high * high), 2 * self.degree
            low, high = 0.0, upper
            power = 12 * farthest * farthest
        else:
            low, high = (low, high) if self.part == "positive" else (-high, -low)
            degree, power = self.degree, 6 * farthest
        # The proof has a bound of its own for degree 1.
        tangential_bound = 0.5 * (high - low) * (degree**2 if degree != 1 else 2 / math.sqrt(3))
        lower, upper = -(2 * high + tangential_bound), power - (2 * low - tangential_bound)
        margin = _ROUNDING * (abs(lower) + dr.abs(upper))
        return lower - margin, upper + margin

    def _errors(self, r: Real, y: Real, slope_norm: Real, rho: Real) -> tuple[Real, Real]:
        """Bounds of the rounding errors of the value and the gradient of f at a point, for scale 1,
        to first order in the unit roundoff u.

        r: the distance of the point from the origin.
        y: Y at the direction of the point.
        slope_norm: the length of the gradient of Y on the unit sphere there.
        rho: the distance of the direction from the z axis.

        The computed unit vector has a relative error of 4u. With M the largest |Y| and L the
        degree, this changes Y by at most 4u L M, its extension along the radius by as much, and the
        gradient by 4u L^2 M for each of the two. `HarmonicRounding` bounds the error of the
        evaluation of Y. Each product after that adds a few roundings.
        """
        # The errors of Y and of its gradient; 8 L M and 8 L^2 M in them come from the unit vector.
        roundoff = float(dr.epsilon(type(r)))
        max_value, degree = max(map(abs, self.value_range)), self.degree
        # The direction is at the distance 1 from the origin.
        y_error = roundoff * (self.rounding.value_error(rho, 1.0) + (8 * degree + 4) * max_value)
        slope_error = roundoff * (
            2 * self.rounding.gradient_error(rho, 1.0)
            + (8 * degree**2 + 16 * degree + 16) * max_value
        )
        if self.part == "both":
            # The errors of Y^2 and of its gradient 2 Y grad Y.
            max_abs_y = dr.abs(y) + y_error
            y_error, slope_error = (
                2 * max_abs_y * y_error,
                2 * (max_abs_y * slope_error + slope_norm * y_error),
            )
            return r * r * (y_error + 8 * roundoff * r * r), r * (
                slope_error + 4 * y_error + 32 * roundoff * r * r
            )
        return r * r * (y_error + 8 * roundoff * r), r * (
            slope_error + 2 * y_error + 24 * roundoff * r
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p.

        At the origin its limit depends on the direction of approach; the result is the limit along
        z.
        """
        distance = safe_norm(p)
        at_origin = distance == 0
        u = dr.select(at_origin, type(p)(0, 0, 1), p / dr.select(at_origin, 1, distance))
        r = distance / self.scale
        sign, inverse_square = (
            -1.0 if self.part == "negative" else 1.0,
            1 / dr.square(self.scale),
        )
        rows: list[Any] = []
        if self.part == "both":
            root, root_gradient, root_hessian = self._of_power(u, 1)  # r^2 Y^2 is the square of r Y
            # The Hessian of r^4 is 4 r^2 I + 8 r^2 u u^T; that of (r Y)^2 does not depend on r.
            for k in range(3):
                curved = 2 * (root_gradient[k] * root_gradient + root * root_hessian[k])
                row = r * r * (8 * u[k] * u) - curved
                row[k] += 4 * r * r
                rows.append(row)
        else:
            # The Hessian of r^3 is 3 r I + 3 r u u^T; that of r^2 Y does not depend on r.
            root_hessian = self._of_power(u, 2)[2]  # here of r^2 Y
            for k in range(3):
                row = 3 * r * u[k] * u - sign * root_hessian[k]
                row[k] += 3 * r
                rows.append(row)
        return inverse_square * rows[0], inverse_square * rows[1], inverse_square * rows[2]

    def _of_power(self, u: Vec3, n: int) -> tuple[Real, Vec3, tuple[Vec3, Vec3, Vec3]]:
        """Return the value, the gradient and the three rows of the Hessian of the function r^n
        Y(x/r) of points x of space, with r = |x|, at the unit vectors x = u.

        The function is the sum of r^(n-l) P_l, where P_l is the part of degree l of Y as a sum of
        solid harmonics (homogeneous harmonic polynomials). With k = n - l and P = P_l, whose
        gradient is g and Hessian H, the Hessian of r^k P at a unit vector x is

            H + k (x g^T + g x^T) + k P (I + (k-2) x x^T).
        """
        vector = cast("Any", type(u))
        value, gradient = 0 * u.x, 0 * u
        rows = [0 * u, 0 * u, 0 * u]
        # The solid harmonic part of each degree l.
        for l in {l for l, _ in self.weights}:  # noqa: E741
            harmonics = {key: c for key, c in self.weights.items() if key[0] == l}
            k, (harmonic, components) = n - l, evaluate(harmonics, u.x, u.y, u.z)
            g, (xx, yy, zz, xy, xz, yz) = vector(*components), hessian(harmonics, u.x, u.y, u.z)
            value, gradient = value + harmonic, gradient + g + (k * harmonic) * u
            for i, row in enumerate(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))):
                new_row = (
                    vector(*row) + k * (u[i] * g + g[i] * u) + (k * (k - 2) * harmonic * u[i]) * u
                )
                new_row[i] += k * harmonic
                rows[i] = rows[i] + new_row
        return value, gradient, (rows[0], rows[1], rows[2])


def _checked(weights: Any) -> dict[tuple[int, int], float]:
    """The weights that are not zero, as Python numbers, after checks.

    weights: the mapping {(l, m): c} that a user gave, for the sum of c Y_lm.

    Raises:
        TypeError: it is no mapping, a key is no pair of integers, or a weight no number.
        ValueError: no weight differs from 0, or a key names no harmonic of degree up to 12.
    """
    if not isinstance(weights, Mapping):
        raise TypeError(f"weights must be {{(l, m): coefficient}}, not {weights!r}")
    checked: dict[tuple[int, int], float] = {}
    for key, weight in cast("Mapping[Any, Any]", weights).items():
        l, m = degree_and_order(key)  # noqa: E741
        if not 0 <= l <= LARGEST_DEGREE:
            raise ValueError(f"the degree l must be 0 to {LARGEST_DEGREE}, not {l}")
        if abs(m) > l:
            raise ValueError(f"the order m must be -l to l, here -{l} to {l}, not {m}")
        number = as_finite(weight, f"the coefficient of Y_{l},{m}")
        if number != 0:
            checked[l, m] = number
    if not checked:
        raise ValueError("lobes need a coefficient that is not zero")
    return checked
