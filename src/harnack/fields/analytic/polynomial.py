"""Harmonic polynomials and spherical harmonics, clipped to a ball (paper, section 4.1). Both are
sums f of solid harmonics r^l Y_lm, homogeneous harmonic polynomials of degree l and order m, each
times a coefficient. For a point p, r is its distance from the origin and rho its distance from the
z axis. Proved bounds of f near a point are called promises, as in the rest of the library: a
`HarmonicBall` is a ball in which f is harmonic, with a range of f; a `TaylorRemainder` bounds
second derivatives. The paper is Gillespie, Yang, Botsch and Crane 2024.

- `SphericalHarmonic`, `HarmonicPolynomial`: sums of solid harmonics, as fields.
- `HarmonicPromises`: the promises of such a sum near a point.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import numbers
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_real
from harnack.enclosures import HarmonicBall, Lipschitz, Promise, TaylorRemainder
from harnack.fields.analytic.rounding import HarmonicRounding
from harnack.fields.analytic.solid_harmonics import (
    LARGEST_DEGREE,
    Weights,
    degree_and_order,
    evaluate,
    from_monomials,
    hessian,
    laplacian,
)
from harnack.fields.analytic.sphere_bounds import (
    AxialBound,
    BallRange,
    gradient_bound,
    hessian_bound,
    order_on_axis,
    range_of_harmonic,
    value_bound,
)
from harnack.fields.attached_arrays import opaque_numbers, scaled_in_space, with_formula
from harnack.fields.attached_numbers import attached_vector
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Sample, Traits, is_attached, validate_levels_in_range
from harnack.fields.parameters import kept_arguments
from harnack.geometry.clip_volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry.volume import Volume

__all__ = ["HarmonicPolynomial", "SphericalHarmonic"]

# Ends of promised ranges are moved outwards by this fraction for the roundings of float32.
_ROUNDING = 1e-5
# Bounds of the Hessian are larger by this fraction, which covers the rounding of the gradient.
_SLOPE_SHARE = 1e-5
# Radii of harmonic balls that are tried, in units of the radius of the ball about the domain.
_RADII = np.geomspace(0.1, 8.0, 200)
# Radii of the balls on which the Hessian is bounded, by experiment. The first two are in units of
# |p|/(l-2), l the degree; the third is the smallest value of the second one. The fourth is for
# points near an axis of high order m, in units of rho/(m-2).
_NEAR, _WIDE, _FLOOR, _BESIDE_AXIS = 0.4, 0.75, 0.1, 0.5
# The distance to a zero of high order counts as at least this, so that no ball has the radius 0.
_MIN_DISTANCE = 1e-9


@dataclass(frozen=True)
class HarmonicPromises:
    """Proved bounds (promises) of a sum f of solid harmonics near points p of the unit ball. They
    depend on two distances of p only: rho from the z axis and r from the origin. f is the sum of
    parts, one for each degree l; a ball of radius R about p lies in the ball of radius r + R about
    the origin, where `ball_range` bounds f.

    ball_range: ranges of f on balls about the origin.
    degree, lowest_degree: the largest degree of a term, and the smallest degree above 0.
    order: the order to which f minus its constant term vanishes along the z axis.
    center_radius, boundary_radius: radii of harmonic balls at r = 0 and r = 1.
    is_larger_outside: whether the second is larger than the first.
    axis_share: if rho is less than this fraction of r, rho determines the radius of the ball.
    axial: three bounds, of |f| without the constant term, of the gradient and of the Hessian, in
        powers of rho and r, if the order is 3 or more; else None.
    rounding: bounds of the rounding of value and gradient.

    The radius R. The paper uses the fixed ball |y| <= 1.25. Near level 0 steps are shortened by the
    second-order term of the bound, which is proportional to (range on |y| <= |p|+R)/R^2, and R is
    chosen to minimize this quotient. For a single degree l > 2, R is 2|p|/(l-2). (By experiment
    this takes about two thirds of the evaluations that the fixed ball takes.)

    Zeros of high order. Where f vanishes to a high order, at the origin or along the z axis, R goes
    to zero with the distance from there, and the range on the ball goes to zero as f does. So every
    step is a fraction of that distance. With any other radius or range, steps would become smaller
    than such a fraction, and rays that pass by would never arrive. Levels other than the value of f
    at the origin need a large ball there. So one promise has a smallest radius: the
    `TaylorRemainder`, and for proofs that do not use it the `Lipschitz` promise.
    """

    ball_range: BallRange
    degree: int
    lowest_degree: int
    order: int
    center_radius: float
    boundary_radius: float
    is_larger_outside: bool
    axis_share: float
    axial: tuple[AxialBound, AxialBound, AxialBound] | None
    rounding: HarmonicRounding

    @classmethod
    def of(cls, weights: Weights, known: BallRange, *, is_divided: bool) -> HarmonicPromises:
        """Compute what the bounds near points need, for the sum f of solid harmonics with these
        coefficients.

        weights: a mapping (l, m) -> coefficient of the solid harmonic of degree l and order m.
        known: proved ranges of the parts of f of each degree.
        is_divided: whether points are divided by a size other than 1 first, which adds rounding.
        """
        # The radii of the balls about the origin, and about a point of the unit sphere.
        center_radius, boundary_radius = _best_radius(known, 0.0), _best_radius(known, 1.0)
        order, axial_bounds, axis_share = order_on_axis(weights), None, 0.0
        if order > 2:
            nonconstant = {key: weight for key, weight in weights.items() if key[0] > 0}
            # If f vanishes along the axis to a high order, bounds in powers of rho are sharper near
            # it.
            axial_bounds = (
                value_bound(nonconstant),
                gradient_bound(nonconstant),
                hessian_bound(nonconstant),
            )
            # The largest |f - constant| on the unit ball.
            lower, upper = known.by_degree(1.0)
            max_value = max(upper - known.constant, known.constant - lower)
            # If rho = axis_share r, both bounds of a single term are the same.
            axis_share = (max_value / float(axial_bounds[0](1.0, 1.0))) ** (1 / order)
        # The spheres reach a little beyond the largest ball about the origin that is needed: that
        # around a harmonic ball at r = 0 or at r = 1.
        return cls(
            known.with_spheres(weights, 1.01 * max(center_radius, 1.0 + boundary_radius)),
            max(degree for degree, _ in weights),  # the degree, and the lowest degree but 0
            min((degree for degree, _ in weights if degree > 0), default=0),
            order,
            center_radius,
            boundary_radius,
            center_radius < boundary_radius,
            axis_share,
            axial_bounds,
            HarmonicRounding.of(weights, is_divided=is_divided),
        )

    def ball(self, rho: Real, r: Real) -> HarmonicBall:
        """A ball about a point in which f is harmonic, with a proved range of f on it.

        rho, r: the distances of the point from the z axis and from the origin.
        """
        radius = self._radius(rho, r)
        lower, upper = self.ball_range.at(r + radius)
        if self.axial is not None:
            # `axial` has bounds of |f - constant|, of |grad f| and of the Hessian.
            axial_bound = self.axial[0](rho + radius, r + radius) * (1 + _ROUNDING)
            lower = fmax(lower, self.ball_range.constant - axial_bound)
            upper = fmin(upper, self.ball_range.constant + axial_bound)
        margin = dr.fma(upper - lower, _ROUNDING, self._underflow(r))
        return HarmonicBall(radius, lower - margin, upper + margin)

    def curvatures(self, rho: Real, r: Real) -> list[TaylorRemainder]:
        """Proved bounds of the Hessian of f on balls about a point, the smallest ball first. For
        degrees up to 2 the Hessian is constant, and there is one bound.

        rho, r: the distances of the point from the z axis and from the origin.
        """
        radii = [dr.inf]  # where the Hessian is constant
        if self.degree > 2:
            # Second derivatives, about r^(degree - 2), grow by a factor of e on this length.
            scale = r / (self.degree - 2)
            radii = [_NEAR * scale, fmax(_WIDE * scale, _FLOOR)]
            # Near an axis of high order, a smaller ball has a much smaller bound.
            if self.axial is not None:
                radii.insert(0, fmin(rho * (_BESIDE_AXIS / (self.order - 2)), radii[0]))
        return [TaylorRemainder(self._curvature(rho, r, radius), radius) for radius in radii]

    def _curvature(self, rho: Real, r: Real, radius: Real) -> Real:
        """A bound of the Hessian of f, as a norm, on the ball of this radius about a point.

        rho, r: the distances of the point from the z axis and from the origin.
        """
        if self.degree < 3:
            # Second derivatives are constant, so the ball about the origin may have the radius 0.
            bound = self.ball_range.curvature(0.0 * r)
        else:
            bound = self.ball_range.curvature(r + radius)
        if self.axial is not None:
            # Entry 2 of `axial` is the bound of the Hessian near the z axis.
            bound = fmin(bound, self.axial[2](rho + radius, r + radius))
        # The share covers the rounding of the gradient: see `error`.
        return dr.fma(bound, 1 + _ROUNDING + _SLOPE_SHARE, self._underflow(r))

    def lipschitz(self, rho: Real, r: Real) -> Lipschitz | None:
        """A Lipschitz constant of f on a ball about a point. The ball has a smallest radius, so
        that rays do not stop at a zero of high order; None if the harmonic ball has a smallest
        radius, too.

        rho, r: the distances of the point from the z axis and from the origin.
        """
        if self.lowest_degree < 3:
            return None
        radius = fmax(r * (_WIDE / (self.degree - 2)), _FLOOR)
        bound = self.ball_range.gradient(r + radius)
        if self.axial is not None:
            # Entry 1 of `axial` is the bound of the gradient near the z axis.
            bound = fmin(bound, self.axial[1](rho + radius, r + radius))
        return Lipschitz(dr.fma(bound, 1 + _ROUNDING, self._underflow(r)), radius)

    def error(self, rho: Real, r: Real, curvature: TaylorRemainder) -> Real:
        """A bound of the rounding error of the value of f at a point, plus the effect that the
        rounding error of the gradient has on bounds by Taylor's formula.

        rho, r: the distances of the point from the z axis and from the origin.
        curvature: the bound of the Hessian on the smallest ball about the point.

        Let E bound the rounding error of the gradient, let H bound the Hessian, and let u be the
        unit roundoff. The constant in `curvature` is (1 + h) H with h = `_SLOPE_SHARE`. For all
        lengths t

            E t <= E^2/(2 h H) + h H t^2/2   (since 2 a b <= a^2 + b^2),

        so the larger constant and E^2/(2 h H), added to the error of the value, cover the
        difference between the exact and the rounded Taylor polynomial. If the degree is below 2,
        the gradient is constant and has a relative error of a few u, less than the tracer allows
        for the rounding of points (8 u |grad f| times their size). For a harmonic ball of radius R,
        E R is a few u times the range; `enclosures.free_radius.condition_rounding` covers 16 u.
        """
        roundoff = float(dr.epsilon(type(r)))  # u, half the distance from 1 to the next number
        error = dr.fma(self.rounding.value_error(rho, r), roundoff, self._underflow(r))
        if self.degree < 2:
            return error
        slope_error = roundoff * self.rounding.gradient_error(rho, r)
        return dr.fma(slope_error * (0.5 / _SLOPE_SHARE), slope_error / curvature.constant, error)

    def _radius(self, rho: Real, r: Real) -> Real:
        """The radius of the harmonic ball about a point.

        rho, r: the distances of the point from the z axis and from the origin.

        If f has a term of degree 1 or 2, the radius goes from `center_radius` at r = 0 to
        `boundary_radius` at r = 1. Otherwise it is proportional to r, because f vanishes to a high
        order at the origin. If f also vanishes along the z axis, to the order m > 2 (then `axial`
        is set), the range on a ball near this axis is about proportional to (rho + R)^m (r +
        R)^(l-m), where l is the degree. Steps are longest where range/R^2 is smallest; for a small
        rho/r this is about at R = 2/((m-2)/rho + (l-m)/r).
        """
        if self.lowest_degree < 3:
            # Never below the smaller of the two radii: proportional to r if that is the radius at
            # the center, else falling linearly in r.
            if self.is_larger_outside:
                return fmax(self.boundary_radius * r, self.center_radius)
            return fmax(
                dr.fma(r, self.boundary_radius - self.center_radius, self.center_radius),
                self.boundary_radius,
            )
        radius = self.boundary_radius * r
        if self.axial is not None:
            # m - 2 and l - m
            excess_order, other_degree = self.order - 2.0, float(self.degree - self.order)
            axis_radius = 2 / (excess_order / rho + other_degree / fmax(r, _MIN_DISTANCE))
            radius = dr.select(rho < self.axis_share * r, fmin(axis_radius, radius), radius)
        return fmax(radius, _MIN_DISTANCE * self.boundary_radius)

    def _underflow(self, r: Real) -> float:
        """A bound of the error by underflow in any of the sums that this class computes or bounds
        (f, its derivatives, their bounds), in the precision of r."""
        return self.rounding.underflow * max(1, self.degree) ** 2 * float(dr.smallest(type(r)))


def _best_radius(known: BallRange, distance: float) -> float:
    """The radius R for which the harmonic ball about a point gives the longest steps: it minimizes
    (range of f on |y| <= distance + R)/R^2.

    known: the ranges on balls about the origin.
    distance: the distance of the point from the origin.
    """
    lower, upper = known.by_degree(distance + _RADII)
    return float(_RADII[np.argmin((upper - lower) / _RADII**2)])


class _SolidHarmonics(Field):
    """A field f(p) that is a sum of solid harmonics (homogeneous harmonic polynomials r^l Y_lm,
    each times a coefficient) of the point p/size, for |p| <= size. Its bounds near points are those
    of `HarmonicPromises`."""

    traits = Traits(is_cheap=True, over_relaxation=1.6)

    def __init__(
        self, weights: Weights, known: BallRange, size: float, domain: Volume, axis: int = 2
    ) -> None:
        """Set up a field.

        weights: a mapping (l, m) -> coefficient of the solid harmonic of degree l and order m.
        known: the ranges of the parts of each degree on the unit sphere.
        size: the radius of a ball about the origin that contains the domain.
        domain: the volume in which f is drawn.
        axis: the index of the coordinate of p that is the z of the solid harmonics. Their x and y
            are the next two coordinates, cyclically.
        """
        self.domain = domain
        self._axis = axis
        self._weights = weights
        self._size = size
        self._promises = HarmonicPromises.of(weights, known, is_divided=size != 1.0)
        # On the ball |p| <= size, in units of the size.
        self.value_range = known.with_spheres(weights, 1.0).on_ball(1.0)

    @property
    def degree(self) -> int:
        """The largest degree of a solid harmonic in the sum."""
        return max(degree for degree, _ in self._weights)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f, for every plan (what the evaluator is used for). It holds Python
        numbers, which are the same for every backend; unless derivatives by them are wanted, so
        that they change from step to step and should compile nothing."""
        del plan
        numbers: Any = (self._weights, self._axis, self._size, self._promises)
        if is_attached(self):
            numbers = opaque_numbers(numbers, backend)
        return _SolidHarmonicsEvaluator(*numbers)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level outside of the proved range of f in its domain."""
        validate_levels_in_range(levels, self.value_range, "in its domain the function")

    def describe(self) -> dict[str, Any]:
        """The degree, the number of terms and the proved range of f, as a dictionary for users."""
        return {
            "degree": self.degree,
            "solid harmonics": len(self._weights),
            "range in the domain": self.value_range,
        }


@dataclass(frozen=True, eq=False)
class _SolidHarmonicsEvaluator(Evaluator):
    """The evaluator of a sum of solid harmonics of the point p/size.

    weights: a mapping (l, m) -> coefficient of the solid harmonic of degree l and order m.
    axis: the index of the coordinate of p that is the z of the solid harmonics.
    size: the size.
    promises: the proved bounds of the sum near a point p/size.
    """

    weights: Weights
    axis: int
    size: float
    promises: HarmonicPromises

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value, gradient and bounds of f near p. They are computed at the point
        p/size, where `HarmonicPromises` has the bounds, and scaled back to p."""
        local_p, size = self._local(p), self.size
        value, gradient = evaluate(self.weights, local_p.x, local_p.y, local_p.z)
        # The distances of the scaled point from the z axis and from the origin.
        rho, r = dr.norm(type(local_p)(local_p.x, local_p.y, 0)), dr.norm(local_p)
        ball, lipschitz = self.promises.ball(rho, r), self.promises.lipschitz(rho, r)
        curvatures = self.promises.curvatures(rho, r)
        promises = tuple(
            TaylorRemainder(promise.constant / size**2, promise.radius * size)
            for promise in curvatures
        )
        alternatives: list[Promise] = [HarmonicBall(ball.radius * size, ball.lower, ball.upper)]
        if lipschitz is not None:
            alternatives.append(Lipschitz(lipschitz.constant / size, lipschitz.radius * size))
        error = self.promises.error(rho, r, curvatures[0])
        # The gradient with its components in the order of the coordinates of p, which `_local`
        # rotates by axis + 1 positions.
        gradient_at_p = type(p)(*_rotate_axes(gradient, -self.axis - 1)) / size
        return Sample(
            value, gradient_at_p, promises, error, alternative_promises=tuple(alternatives)
        )

    def _local(self, p: Vec3) -> Vec3:
        """The point p in the coordinates of the solid harmonics: with its axes rotated, and divided
        by the size."""
        return type(p)(*_rotate_axes((p.x, p.y, p.z), self.axis + 1)) / self.size

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p; its trace is 0 up to rounding."""
        local_p, scale, turns = self._local(p), 1 / self.size**2, -self.axis - 1
        xx, yy, zz, xy, xz, yz = (
            scale * entry for entry in hessian(self.weights, local_p.x, local_p.y, local_p.z)
        )
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        # Rows and columns in the order of the coordinates of p.
        x, y, z = _rotate_axes([type(p)(*_rotate_axes(row, turns)) for row in rows], turns)
        return x, y, z


class SphericalHarmonic(_SolidHarmonics):
    """The solid harmonic (|p|/radius)^l Y_lm(p/|p|) of degree l and order m, a homogeneous harmonic
    polynomial, in a ball, for degrees up to 12. Y_lm is a real spherical harmonic, a function on
    the unit sphere. It is orthonormal: the integral of Y_lm^2 over the sphere is 1. It is without
    the Condon-Shortley phase: Y_11 is a positive multiple of x, Y_1-1 of y, Y_10 of z. Orders m > 0
    contain cos(m phi), orders m < 0 contain sin(|m| phi).

    l, m: degree 0 <= l <= 12 and order -l <= m <= l.
    radius: the radius of the ball about the origin to which it is clipped.

    Raises:
        ValueError: l or m outside these ranges, or a radius that is not positive.
        TypeError: l or m is no integer.
    """

    traits = dataclasses.replace(_SolidHarmonics.traits, differentiable_arguments=("radius",))

    def __init__(self, l: int, m: int, *, radius: float = 1.0) -> None:  # noqa: E741
        """Check the arguments, and set up the sum of solid harmonics with this single term."""
        l, m = degree_and_order((l, m))  # noqa: E741
        if not 0 <= l <= LARGEST_DEGREE:
            raise ValueError(f"the degree l must be 0 to {LARGEST_DEGREE}, not {l}")
        if abs(m) > l:
            raise ValueError(f"the order m must be -l to l, here -{l} to {l}, not {m}")
        domain = Ball(radius=as_real(radius, "the radius"))
        self.domain_moves = is_attached(self)
        self.l, self.m = l, m
        low, high = range_of_harmonic(l, m)
        # The range of the constant Y_00 is its value; of all others, the range on the unit sphere.
        known = BallRange(low, ()) if l == 0 else BallRange(0.0, ((l, low, high),))
        super().__init__({(l, m): 1.0}, known, domain.radius, domain)

    def with_attached_numbers(self, backend: Backend) -> SphericalHarmonic:
        """The copy whose formula has derivatives by the radius, with which f scales."""
        argument = kept_arguments(self)["radius"]
        (radius,) = attached_vector([argument], [self._size], backend)
        return with_formula(self, scaled_in_space(self.evaluator(backend), radius))


class HarmonicPolynomial(_SolidHarmonics):
    """A harmonic polynomial, given by the coefficients of its monomials x^i y^j z^k, up to degree
    12. It is evaluated as a sum of solid harmonics.

    coefficients: {(i, j, k): c}, for the sum of c x^i y^j z^k; the paper's Eq. 8 is
        HarmonicPolynomial({(2, 1, 0): 1, (0, 1, 2): -1}). Values, gradients and hits can be
        differentiated by those that are Dr.Jit numbers.
    domain: the bounded volume to which it is clipped; by default the ball of radius 1.

    The Laplacian must vanish, up to 1e-9 of the terms that cancel in it. The sum of solid harmonics
    has the same values and z-derivatives on the plane z = 0 as the polynomial, and so, both being
    harmonic, agrees with it everywhere.

    Raises:
        ValueError: the polynomial is not harmonic (the message shows its Laplacian), its degree is
            above 12, a coefficient is not finite, or the domain is unbounded.
        TypeError: coefficients is no dictionary.
    """

    traits = dataclasses.replace(_SolidHarmonics.traits, differentiable_arguments=("coefficients",))

    def __init__(
        self, coefficients: Mapping[tuple[int, int, int], float], *, domain: Volume | None = None
    ) -> None:
        """Check the arguments, and convert the monomials to solid harmonics of p/size, where the
        ball of radius `size` contains the domain. Of the three coordinate axes, the one along which
        the polynomial vanishes to the highest order becomes the z axis of the solid harmonics."""
        self.coefficients = _checked(coefficients)
        domain = Ball() if domain is None else domain
        size = _enclosing_radius(domain)
        scaled_coefficients = {
            powers: c * size ** sum(powers) for powers, c in self.coefficients.items()
        }
        # The axis along which the polynomial vanishes to the highest order becomes the z axis of
        # the solid harmonics, since `HarmonicPromises` has sharper bounds near a z axis of high
        # order. Of axes of the same order z comes first: it needs no rotation.
        weights_by_axis = [
            from_monomials(
                {
                    _rotate_axes(exponents, axis + 1): c
                    for exponents, c in scaled_coefficients.items()
                }
            )
            for axis in range(3)
        ]
        axis = max((2, 0, 1), key=lambda axis: order_on_axis(weights_by_axis[axis]))
        weights = weights_by_axis[axis]
        super().__init__(weights, BallRange.of(weights), size, domain, axis)

    def with_attached_numbers(self, backend: Backend) -> HarmonicPolynomial:
        """The copy whose formula, the sum of c x^i y^j z^k, has derivatives by the coefficients c,
        those that are 0 included. (The sum of solid harmonics is more accurate, and has the value
        alone.)"""
        other = copy.copy(self)
        terms = [
            (powers, attached_vector([c], [as_real(c, "a coefficient")], backend)[0])
            for powers, c in kept_arguments(self)["coefficients"].items()
        ]

        def formula(x: Any, y: Any, z: Any) -> Any:
            """The sum of c x^i y^j z^k."""
            total = x * 0.0
            for powers, c in terms:
                factors = [v**n for v, n in zip((x, y, z), powers, strict=True) if n]
                total = total + functools.reduce(operator.mul, [*factors, c])
            return total

        object.__setattr__(other, "formula", formula)
        return other


def _rotate_axes(values: Sequence[Any], n: int) -> tuple[Any, Any, Any]:
    """The three values rotated by n positions, cyclically; for n = 1, (x, y, z) becomes (y, z,
    x)."""
    return values[n % 3], values[(n + 1) % 3], values[(n + 2) % 3]


def _checked(coefficients: Any) -> dict[tuple[int, int, int], float]:
    """The coefficients that are not zero, as Python numbers, after checks.

    coefficients: the mapping {(i, j, k): c} that a user gave, for the sum of c x^i y^j z^k.

    Raises:
        TypeError, ValueError: it is no mapping of exponents to finite numbers, all are zero, the
            degree is above 12, or the polynomial is not harmonic.
    """
    if not isinstance(coefficients, Mapping):
        raise TypeError(
            "a harmonic polynomial is given by its coefficients, such as {(2, 1, 0): 1, "
            f"(0, 1, 2): -1}} for x^2 y - y z^2, not by {coefficients!r}"
        )
    checked: dict[tuple[int, int, int], float] = {}
    for powers, value in cast("Mapping[Any, Any]", coefficients).items():
        try:
            i, j, k = (operator.index(n) for n in powers)
        except (TypeError, ValueError):
            raise ValueError(f"{powers!r} is no exponent (i, j, k) of x^i y^j z^k") from None
        if min(i, j, k) < 0:
            raise ValueError(f"exponents must not be negative: {powers!r}")
        is_array = dr.is_array_v(type(value))
        number = as_real(value, f"the coefficient of {powers!r}") if is_array else value
        if not (isinstance(number, numbers.Real) and math.isfinite(number)):
            raise ValueError(f"the coefficient of {powers!r} is {value!r}, not a finite number")
        if i + j + k > LARGEST_DEGREE:
            raise ValueError(
                f"{_monomial((i, j, k))} has degree {i + j + k}: at most {LARGEST_DEGREE} is "
                "supported"
            )
        if number != 0:
            checked[i, j, k] = float(number)
    if not checked:
        raise ValueError("a harmonic polynomial needs a coefficient that is not zero")
    remainder, worst = laplacian(checked)
    if worst > 1e-9:
        terms = [f"{c:g} {_monomial(powers)}".strip() for powers, c in sorted(remainder.items())]
        shown = " + ".join(terms)
        raise ValueError(f"the polynomial is not harmonic: its Laplacian is {shown}, not 0")
    return checked


def _monomial(powers: tuple[int, int, int]) -> str:
    """The monomial x^i y^j z^k as text, such as "x^2 y".

    powers: (i, j, k).
    """
    factors = zip("xyz", powers, strict=True)
    return " ".join(name if n == 1 else f"{name}^{n}" for name, n in factors if n)


def _enclosing_radius(domain: Volume) -> float:
    """The radius of a ball about the origin that contains the domain.

    Raises:
        ValueError: the domain is unbounded.
    """
    if isinstance(domain, Ball):
        return float(np.linalg.norm(domain.center)) + domain.radius
    corners = np.abs(np.array(domain.bounds())).max(axis=0)
    if not np.isfinite(corners).all():
        raise ValueError("a harmonic polynomial needs a bounded domain, such as a Ball or a Box")
    return float(np.linalg.norm(corners))
