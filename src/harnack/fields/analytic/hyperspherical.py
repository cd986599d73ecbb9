"""Hyperspherical harmonics, mapped to space by stereographic projection (paper, section 4.7). A
point p of space belongs to the point X = (y, w) of S^3, the unit sphere of R^4, with y = 2p/(1 +
|p|^2) and w = (|p|^2 - 1)/(1 + |p|^2); far away w tends to 1, the pole. f(p) = P(X) for a
homogeneous harmonic polynomial P of R^4 of degree l. P is a sum over j of parts S(y) C(w): S is a
sum of solid harmonics of degree j, each times a weight (its coefficient), and C = C_(l-j)^(j+1) is
a Gegenbauer polynomial of w. Distances of y: r from 0, and rho from the third axis. A square is
|p|^2, and a chord is a distance in R^4 between points of S^3."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import integer
from harnack.enclosures import Lipschitz, SlopeRange, TaylorRemainder
from harnack.enclosures.parabola import ParabolaEnclosure, SphereArcEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.analytic.hyperspherical_basis import (
    LARGEST_DEGREE,
    HypersphereRange,
    Monomials,
    SphereWeights,
    from_monomials,
    gegenbauer,
    gegenbauer_rounding,
    weights_by_order,
)
from harnack.fields.analytic.rounding import HarmonicRounding
from harnack.fields.analytic.solid_harmonics import Weights, evaluate, hessian
from harnack.fields.analytic.sphere_bounds import (
    AxialBound,
    gradient_bound,
    hessian_bound,
    value_bound,
)
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits, validate_levels_in_range
from harnack.fields.parameters import record_call
from harnack.geometry.clip_volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry.volume import Volume

__all__ = ["HypersphericalHarmonic"]

# Constants are increased by this fraction for the roundings of float32.
_ROUNDING = 1e-5
# Radii of the two balls on which the Hessian is bounded, in units of sqrt(1 + |p|^2).
_BALL_RADII = _SMALL, _BIG = 0.2, 0.6
# For the ball near a zero of high order. First, the chord on the sphere S^3 that contains the image
# of the ball: in units of (distance of the zero)/(order - 2). Second, the largest radius, in units
# of sqrt(1 + |p|^2). Third, the radius of a ball in space whose image lies within a chord: in units
# of the chord times 1 + |p|^2.
_ZERO_CHORD, _MAX_RADIUS, _RADIUS_OF_CHORD = 0.5, 0.3, 0.349
# A factor that covers terms of second order in the unit roundoff, and the rounding of the bounds.
_SECOND_ORDER = 1.05
# Rounding errors, in units of u: the relative error of 1/(1 + |p|^2), and the error of w.
_SCALE_ERROR, _W_ERROR = 6.0, 13.0


@dataclass(frozen=True)
class _OrderTerm:
    """The part S(y) C_n^k(w) of a function of points (y, w) of S^3 that belongs to one j, with
    proved bounds of its factors. S is a sum of solid harmonics of degree j of y, and C_n^k is a
    Gegenbauer polynomial.

    j: the degree of S.
    n, k: l - j and j + 1, the indices of C_n^k.
    weights: (j, m) -> coefficient of the solid harmonic in S.
    value, gradient, hessian: bounds of |S|, of its gradient and of its second derivatives, as
        functions of the distances rho of y from the third axis and r from 0.
    rounding: bounds of the rounding of S as it is evaluated.
    """

    j: int
    n: int
    k: int
    weights: Weights
    value: AxialBound
    gradient: AxialBound
    hessian: AxialBound
    rounding: HarmonicRounding

    @classmethod
    def of(cls, l: int, j: int, weights: Weights) -> _OrderTerm:  # noqa: E741
        """The part S(y) C(w) that belongs to this j of a function of degree l.

        weights: (j, m) -> coefficient of the solid harmonic in S. It includes N_lj, the factor that
            normalizes the harmonic polynomial of R^4.
        """
        bounds = value_bound(weights), gradient_bound(weights), hessian_bound(weights)
        rounding = HarmonicRounding.of(weights, is_divided=True)
        # The second and the third are the n and the k of C_n^k.
        return cls(j, l - j, j + 1, weights, *bounds, rounding)

    def largest(self, rho: Real, r: Real) -> tuple[Real, Real]:
        """Two bounds, of the first and of the second derivatives of S(y) C(w) in R^4, for |w| <= 1.

        rho, r: y is within rho of the third axis and within r of 0.

        C and its derivatives are largest at w = 1.
        """
        # C, C' and C'' at w = 1; below, bounds of S, of its gradient and of its Hessian.
        c, first, second = (float(number) for number in self.axial(1.0))
        value, slope, curvature = self.value(rho, r), self.gradient(rho, r), self.hessian(rho, r)
        # The second derivative along a unit vector (u, v), with u in R^3, has the mixed term
        # 2 v (u . grad S) C'. As 2 |u| |v| <= 1, this is at most slope * first, without a factor 2.
        return slope * c + value * first, curvature * c + slope * first + value * second

    def axial(self, w: Real) -> tuple[Real, Real, Real]:
        """Return three numbers, the values at w of the Gegenbauer polynomial C_n^k and of its first
        and second derivatives, which are Gegenbauer polynomials, too."""
        n, k = self.n, self.k
        first = 2 * k * gegenbauer(n - 1, k + 1, w)
        return gegenbauer(n, k, w), first, 4 * k * (k + 1) * gegenbauer(n - 2, k + 2, w)


class HypersphericalHarmonic(Field):
    """A harmonic function of the sphere S^3, the unit sphere of R^4, mapped to space: f(p) = P(y,
    w) at the point y = 2p/(1 + |p|^2), w = (|p|^2 - 1)/(1 + |p|^2) of S^3. P is a homogeneous
    harmonic polynomial of degree l of R^4; by default it is P_ljm(X) = N S_jm(y) |X|^(l-j)
    C_(l-j)^(j+1)(w/|X|) with X = (y, w). S_jm is the solid harmonic of `SphericalHarmonic`, C is a
    Gegenbauer polynomial, and N is such that the integral of P^2 over S^3 is 1.

    The origin of space is the point w = -1 of S^3, the unit sphere is w = 0, and far away f tends
    to the value at w = 1, which is 0 for j > 0. No level set needs to be clipped: rays that leave
    are proved to meet nothing.

    l, j, m: degree 0 <= l <= 6, and 0 <= j <= l, -j <= m <= j: (l+1)^2 functions for each l. For
        more general functions see `from_polynomial`.
    domain: the volume in which f is drawn; None for all of space. Surfaces of the level to which f
        tends far away (0 for j > 0) may be unbounded, and so may rays along them: they need a
        domain, or a t_max.

    Proofs. On S^3 let |P| <= M, and let A be half the length of the range of P
    (`HypersphereRange`). P is harmonic and homogeneous, so |grad P| <= l M on S^3 and |v . H v| <=
    l (l-1) M for unit vectors v and the Hessian H (`BallRange.curvature` has the proof). Let Q = 1
    + |p|^2.

    - `TaylorRemainder` on a ball. The image on S^3 of a line with parameter t moves at speed 2/Q,
      and its second derivative by t has the length 4/Q^1.5 (for the circle in `SphereArcEnclosure`
      it is sqrt(c^2 + t^2) 4/Q^2). By the chain rule |f''| <= M l (4 (l-1)/Q^2 + 4/Q^1.5) with the
      smallest Q on the ball, and |grad f| <= 2 l A/Q (Bernstein on the great circle along the
      line).
    - A further `TaylorRemainder` near places where f vanishes to an order above 2: the point y = 0,
      and for |m| > 2 the circle y_1 = y_2 = 0. Its ball has a radius that is a fraction of the
      distance to that place. `AxialBound` bounds S_jm, its gradient and its Hessian at such
      distances. The bound for S_jm(y) C(w) follows by the same chain rule, with 2ab <= 1 for the
      components (a, b) of unit vectors. The ball's image: for R <= 0.3 sqrt(Q), 1 + |q|^2 >= 0.49 Q
      at all points q of the ball, so on S^3 the image is within the chord 2R/(0.7 Q).
    - `SphereArcEnclosure` along a ray. The image of the ray lies on a circle of radius 1/c. The
      first and the second derivative of its point by the angle have the length 1/c, so |f_aa| <= M
      l ((l-1)/c^2 + 1/c) for derivatives by the angle. And f is a trigonometric polynomial of
      degree l of the angle, so |f_aa| <= l^2 A (Bernstein).

    Raises:
        ValueError: l, j or m outside these ranges.
        TypeError: l, j or m is no integer.
    """

    traits = Traits(is_cheap=True, over_relaxation=1.6, is_global=True)
    _coefficients: Monomials  # of `from_polynomial` only

    def __init__(self, l: int, j: int, m: int, *, domain: Volume | None = None) -> None:  # noqa: E741
        """Check l, j and m, and set up the function with this single term."""
        l, j, m = integer(l, "the degree l"), integer(j, "j"), integer(m, "the order m")  # noqa: E741
        if not 0 <= l <= LARGEST_DEGREE:
            raise ValueError(f"the degree l must be 0 to {LARGEST_DEGREE}, not {l}")
        if not 0 <= j <= l:
            raise ValueError(f"j must be 0 to l = {l}, not {j}")
        if not -j <= m <= j:
            raise ValueError(f"the order m must be -{j} to {j}, not {m}")
        self._initialize(l, {(j, m): 1.0}, domain)

    @classmethod
    def from_polynomial(
        cls, coefficients: Monomials, *, domain: Volume | None = None
    ) -> HypersphericalHarmonic:
        """The field f of a homogeneous harmonic polynomial of R^4, given by the polynomial's
        coefficients.

        coefficients: a mapping (a, b, c, d) -> coefficient of x^a y^b z^c w^d. The degree a + b + c
            + d = l is the same for all, l <= 6. At a point p of space, (x, y, z) is 2p/(1 + |p|^2)
            and w is (|p|^2 - 1)/(1 + |p|^2).
        domain: the volume in which f is drawn; None for all of space.

        Raises:
            ValueError: the polynomial is not homogeneous, of a degree above 6, zero, not finite, or
                not harmonic.
            TypeError: a key is not four integers.
        """
        terms: dict[tuple[int, int, int, int], float] = {}
        for key, value in coefficients.items():
            powers = tuple(operator.index(power) for power in key)
            if len(powers) != 4 or min(powers) < 0:
                raise TypeError(
                    f"a monomial of R^4 is four powers >= 0, of x, y, z and w, not {key!r}"
                )
            if not math.isfinite(value):
                raise ValueError(f"the coefficient of {key} is {value!r}, not a finite number")
            a, b, c, d = powers
            terms[a, b, c, d] = terms.get((a, b, c, d), 0.0) + float(value)
        field = cls.__new__(cls)
        field._initialize(*from_monomials(terms), domain)
        field._coefficients = terms
        record_call(field, (terms,), {"domain": domain}, "from_polynomial")
        return field

    def _initialize(self, l: int, weights: SphereWeights, domain: Volume | None) -> None:  # noqa: E741
        """Set up the function whose P is a sum of the P_ljm of degree l.

        weights: a mapping (j, m) -> coefficient of P_ljm.
        domain: the volume in which f is drawn; None for all of space.
        """
        self.domain = domain
        self.degree = l
        self._orders = tuple(
            _OrderTerm.of(l, j, harmonic_weights)
            for j, harmonic_weights in weights_by_order(l, weights).items()
        )
        self._range = HypersphereRange.of(l, weights)

    @property
    def value_range(self) -> tuple[float, float]:
        """The ends (low, high) of an interval that is proved to contain all values of f."""
        return self._range.low, self._range.high

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f. As it holds Python numbers only, it is the same for every backend and
        every plan (what the evaluator is used for)."""
        del backend, plan
        return _HypersphericalEvaluator(self.degree, self._orders, self._range)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The domain or, if there is none, a ball about the origin that contains the level sets;
        None if they may be unbounded.

        levels: the levels of f.
        """
        if self.domain is not None:
            return self.domain
        radius = max((self._range.radius(level) for level in levels), default=0.0)
        return Ball(radius=radius) if 0 < radius < math.inf else None

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level outside of the proved range of f, and for a constant f."""
        if self.degree == 0:
            raise ValueError(
                "a hyperspherical harmonic of degree 0 is constant: it has no level sets"
            )
        validate_levels_in_range(levels, self.value_range)

    def describe(self) -> dict[str, Any]:
        """The degree, the number of terms and the proved range of f, as a dictionary for users."""
        return {
            "degree": self.degree,
            "harmonics": sum(len(term.weights) for term in self._orders),
            "range": self.value_range,
            "value far away": self._range.pole,
        }


@dataclass(frozen=True, eq=False)
class _HypersphericalEvaluator(Evaluator):
    """The evaluator of a `HypersphericalHarmonic` f, which has the proofs.

    degree: the degree l of the polynomial P.
    orders: the parts of P that belong to one j each.
    value_range: ranges of P on S^3.
    """

    degree: int
    orders: tuple[_OrderTerm, ...]
    value_range: HypersphereRange

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value, gradient and bounds of f near p. These are bounds of the Hessian
        on several balls and a Lipschitz constant; `HypersphericalHarmonic` has the proofs."""
        square = dr.squared_norm(p)
        value, gradient, error, gradient_error = self._values(p, 1 + square)
        promises = (*self._remainder_near_zero(p, square), *self._curvatures(square))
        # 2 l A, with A half the length of the range of P.
        slope = self.degree * (self.value_range.high - self.value_range.low) * (1 + _ROUNDING)
        lipschitz = Lipschitz(slope / self._min_square(square, _BIG), self._radius(square, _BIG))
        return Sample(
            value, gradient, promises, error, gradient_error, alternative_promises=(lipschitz,)
        )

    def _values(self, p: Vec3, total: Real) -> tuple[Real, Vec3, Real, Real]:
        """Return four results: the value and the gradient of f at p, and bounds of the rounding
        errors of both.

        total: 1 + |p|^2.

        Let s = 1/total, y = 2 s p and w = 1 - 2 s. f is a sum of S(y) C(w). Since S is homogeneous
        of degree j, grad f = 2 s (sum of C grad S + p S (2 s C' - j C)). The errors, to first order
        in the unit roundoff u, come from y, from w, and from S, grad S and C. The relative error of
        y is `_SCALE_ERROR` u, the same for all coordinates, and two roundings of each coordinate,
        which `HarmonicRounding` includes. The error of w is `_W_ERROR` u. The errors of S, grad S
        and C come from their recurrences.
        """
        s = 1 / total
        y, w, norm_p = 2 * s * p, 1 - 2 * s, dr.norm(p)
        r, rho = dr.norm(y), dr.norm(type(y)(y.x, y.y, 0))
        zero = 0 * p.x
        value, gradient_sum, radial_sum = zero, type(p)(0), zero
        error, gradient_error = zero, zero
        # The roundings of a term: a few for its products, and one for each sum over the parts.
        operations = len(self.orders) + 8.0
        for term in self.orders:
            # C(w), C'(w) and C''(w)
            c, first, second = term.axial(w)
            harmonic, (x1, x2, x3) = evaluate(term.weights, y.x, y.y, y.z)
            value = value + c * harmonic
            gradient_sum = gradient_sum + c * type(p)(zero + x1, zero + x2, zero + x3)
            radial = 2 * s * first - term.j * c
            radial_sum = radial_sum + harmonic * radial
            # Rounding: bounds of |S| and |grad S|, then of the errors of S, grad S, C, C' and
            # 2 s C' - j C.
            max_harmonic, max_gradient = term.value(rho, r), term.gradient(rho, r)
            value_error = term.rounding.value_error(rho, r) + _SCALE_ERROR * term.j * max_harmonic
            slope_error = (
                term.rounding.gradient_error(rho, r)
                + (_SCALE_ERROR * max(term.j - 1, 0) + operations) * max_gradient
            )
            c_error = dr.fma(_W_ERROR, dr.abs(first), gegenbauer_rounding(term.n, term.k))
            next_error = 2 * term.k * gegenbauer_rounding(term.n - 1, term.k + 1)
            first_error = dr.fma(_W_ERROR, dr.abs(second), next_error)
            radial_error = 2 * s * dr.fma(8.0, dr.abs(first), first_error)
            radial_error = radial_error + term.j * (c_error + 3 * dr.abs(c))
            c = dr.abs(c)
            error = error + c * (value_error + operations * max_harmonic) + max_harmonic * c_error
            gradient_error = gradient_error + c * slope_error + max_gradient * c_error
            gradient_error = gradient_error + norm_p * (
                dr.abs(radial) * (value_error + operations * max_harmonic)
                + max_harmonic * radial_error
            )
        roundoff = float(dr.epsilon(type(zero))) * _SECOND_ORDER
        gradient = 2 * s * (gradient_sum + p * radial_sum)
        underflow = 64 * float(dr.smallest(type(zero)))
        return (
            value,
            gradient,
            dr.fma(error, roundoff, underflow),
            2 * s * roundoff * gradient_error,
        )

    def _min_square(self, square: Real, fraction: float) -> Real:
        """A lower bound of 1 + |q|^2 for all points q of space in the ball of radius fraction *
        sqrt(1 + |p|^2) about p.

        square: |p|^2.
        """
        smallest_norm = fmax(dr.sqrt(square) - fraction * dr.sqrt(1 + square), 0)
        return dr.fma(smallest_norm, smallest_norm, 1) * (1 - _ROUNDING)

    def _radius(self, square: Real, fraction: float) -> Real:
        """The radius fraction * sqrt(1 + |p|^2) of a ball about p.

        square: |p|^2.
        """
        return fraction * dr.sqrt(1 + square)

    def _curvatures(self, square: Real) -> list[TaylorRemainder]:
        """Proved bounds of the Hessian of f on two balls about p and on all of space.

        square: |p|^2.
        """
        l = self.degree  # noqa: E741
        max_gradient = l * self.value_range.largest * (1 + _ROUNDING)
        promises: list[TaylorRemainder] = []
        for fraction in _BALL_RADII:
            # By the chain rule: with Q = 1 + |q|^2, the image on S^3 of a line moves at the speed
            # 2/Q and has a second derivative of the length 4/Q^1.5; on S^3 the gradient of P is at
            # most l M and its Hessian l (l-1) M, where M is the largest |P|. So second derivatives
            # are at most M l (4 (l-1)/Q^2 + 4/Q^1.5), with the smallest Q of the ball.
            min_square = self._min_square(square, fraction)
            # It is negative for l = 0, where f is constant; hence the maximum with 0 below.
            second = (4 * (l - 1) / min_square + 4 / dr.sqrt(min_square)) / min_square
            promises.append(
                TaylorRemainder(fmax(max_gradient * second, 0), self._radius(square, fraction))
            )
        # In all of space 1 + |q|^2 is at least 1.
        return [*promises, TaylorRemainder(0 * square + max(max_gradient * 4.0 * l, 0.0), dr.inf)]

    def _remainder_near_zero(self, p: Vec3, square: Real) -> tuple[TaylorRemainder, ...]:
        """A proved bound of the Hessian of f on a ball about p that is small near a zero of high
        order: near y = 0, or near the third axis of y. A tuple with this bound; empty if f has no
        zero of an order above 2.

        square: |p|^2.
        """
        # By the chain rule: with Q = 1 + |q|^2, the image on S^3 of a line moves at the speed 2/Q
        # and has a second derivative of the length 4/Q^1.5. Derivatives of S(y) C(w) are bounded at
        # all points of S^3 within a chord.
        axis_order = min(abs(m) for term in self.orders for _, m in term.weights)
        center_order = min(term.j for term in self.orders)
        if center_order < 3:
            return ()
        y = (2 / (1 + square)) * p
        r, rho = dr.norm(y), dr.norm(type(y)(y.x, y.y, 0))
        # How far on S^3 the image of the ball may extend: a fraction of the distance to the zero.
        chord = _ZERO_CHORD / (center_order - 2) * r
        if axis_order > 2:
            chord = fmin(chord, _ZERO_CHORD / (axis_order - 2) * rho)
        min_square = self._min_square(square, _MAX_RADIUS)
        inverse_root = dr.rcp(dr.sqrt(min_square))
        second_max = 0 * square
        for term in self.orders:
            first, second = term.largest(rho + chord, r + chord)
            second_max = second_max + 4 * inverse_root * inverse_root * inverse_root * dr.fma(
                inverse_root, second, first
            )
        radius = fmin(_RADIUS_OF_CHORD * chord * (1 + square), _MAX_RADIUS * dr.sqrt(1 + square))
        return (TaylorRemainder(second_max * (1 + _ROUNDING), radius),)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the position t of a ray, with enclosures (proved bounds of the change of f
        along the ray) in front of the point and behind it. Their proof uses that the image of the
        ray on S^3 lies on a circle.

        path: the ray.
        t: a length along it.
        ahead, back: not used, as the proofs hold on the whole ray.

        If the ray's options exclude the sharpest proofs (`PiecewiseTaylorEnclosure`), the
        enclosures follow from the sample of `evaluate` alone.
        """
        del ahead, back
        p = path.point(t)
        sample = self.evaluate(p)
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(sample)
        slope = dr.dot(sample.gradient, path.direction)
        slopes = SlopeRange.around(slope, sample.gradient_error)
        # The point of the line that is closest to the origin of space, and the position of p along
        # the line from there.
        start = dr.dot(path.origin, path.direction)
        closest = path.origin - start * path.direction
        square = 1 + dr.squared_norm(closest)
        position = dr.dot(p, path.direction)
        l, sqrt_square = self.degree, dr.sqrt(square)  # noqa: E741
        bounds = self.value_range
        # Two bounds of |f_aa|, the second derivative by the angle on the circle. By the chain rule,
        # as the circle has the radius 1/c with c^2 = `square`; and by Bernstein's inequality, as f
        # is a trigonometric polynomial of degree l of the angle.
        bernstein_bound = l * l * 0.5 * (bounds.high - bounds.low)
        second = fmin(
            bounds.largest * l * ((l - 1) / square + 1 / sqrt_square), bernstein_bound
        ) * (1 + _ROUNDING)
        forward = SphereArcEnclosure(slopes, second, position, square)
        backward = SphereArcEnclosure(slopes.negated(), second, -position, square)
        curvatures = [
            promise for promise in sample.promises if isinstance(promise, TaylorRemainder)
        ]
        # Those before the two balls and all of space: at most one, from `_remainder_near_zero`.
        near_zero = curvatures[: -len(_BALL_RADII) - 1]
        ahead_near = [
            ParabolaEnclosure(slopes, -promise.constant, promise.constant, promise.radius)
            for promise in near_zero
        ]
        back_near = [
            ParabolaEnclosure(slopes.negated(), -promise.constant, promise.constant, promise.radius)
            for promise in near_zero
        ]
        return RaySample(sample, (forward, *ahead_near), (backward, *back_near), slope)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p. Its trace is not 0: f is harmonic on S^3 and not
        in space.

        Let x be the point p, s = 1/(1 + |x|^2), and d_ik = 1 for i = k, else 0. The chain rule is
        applied to f = P(y, w), with

        - first derivatives dy_i/dx_k = 2s (d_ik - 2s x_i x_k) and dw/dx_k = 4 s^2 x_k;
        - second derivatives 4 s^2 (4s x_i x_k x_m - x_m d_ik - x_k d_im - x_i d_km) of y_i and 4
          s^2 (d_km - 4s x_k x_m) of w.

        In the code `rows` and `slopes` are the Hessian (its upper triangle) and the gradient of P
        as a function of (y, w) in R^4.
        """
        vector = cast("Any", type(p))
        s = 1 / (1 + dr.squared_norm(p))
        y, w, zero = 2 * s * p, 1 - 2 * s, 0 * p.x
        rows = [[zero] * 4 for _ in range(4)]
        slopes = [zero] * 4
        for term in self.orders:
            # C(w), C'(w) and C''(w)
            c, first, second = term.axial(w)
            harmonic, gradient = evaluate(term.weights, y.x, y.y, y.z)
            xx, yy, zz, xy, xz, yz = hessian(term.weights, y.x, y.y, y.z)
            s_hessian = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
            for i in range(3):
                for k in range(3):
                    rows[i][k] = rows[i][k] + c * s_hessian[i][k]
                rows[i][3] = rows[i][3] + first * gradient[i]
                slopes[i] = slopes[i] + c * gradient[i]
            rows[3][3] = rows[3][3] + second * harmonic
            slopes[3] = slopes[3] + first * harmonic
        x = (p.x, p.y, p.z)
        # The derivatives of (y, w) by the three coordinates of x.
        jacobian = [[2 * s * ((i == k) - 2 * s * x[i] * x[k]) for k in range(3)] for i in range(3)]
        jacobian.append([4 * s * s * x[k] for k in range(3)])
        radial = x[0] * slopes[0] + x[1] * slopes[1] + x[2] * slopes[2]
        result: list[Vec3] = []
        for k in range(3):
            row: list[Real] = []
            for m in range(3):
                # The Hessian of P between two columns of the first derivatives.
                total = zero
                for i in range(4):
                    for n in range(4):
                        entry = rows[min(i, n)][max(i, n)]
                        total = total + jacobian[i][k] * entry * jacobian[n][m]
                # The gradient of P times the second derivatives of (y, w), divided by 4 s^2.
                curved = 4 * s * x[k] * x[m] * (radial - slopes[3])
                curved = curved - x[m] * slopes[k] - x[k] * slopes[m]
                if k == m:
                    curved = curved + slopes[3] - radial
                row.append(total + 4 * s * s * curved)
            result.append(vector(*row))
        return result[0], result[1], result[2]
