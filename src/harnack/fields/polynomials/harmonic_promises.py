"""What a sum of solid harmonics promises on balls about a point of the unit ball.

The promise at p is for a ball B(p, R), in the ball of radius |p| + R about the origin, where
`BallRange` bounds the polynomial. The paper takes the fixed ball |y| <= 1.25; near level 0 a step
loses to the second-order term of the bound, proportional to (range on |y| <= |p|+R)/R^2, so R is
chosen to make that least: 2|p|/(l-2) for a single degree l > 2. With the slope bound Y_(8,4) took
19 evaluations a ray, with the fixed ball 30 (27 at best, for 1.15); Y_(12,5) took 24 and 61 (50).

Where f vanishes to a high order, at the origin or along the z axis, R goes to zero with the
distance from there, and what is promised on the ball as f does: every step is then a share of that
distance. With any other radius or range steps would fall behind it, and rays that pass by would
never arrive. Levels other than that at the origin need a wide ball there: one promise (`Curvature`;
`Lipschitz` for bounds that know none) keeps a least radius.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures import Curvature, HarmonicBall, Lipschitz
from harnack.fields.polynomials.axial_bounds import (
    AxialBound,
    gradient_bound,
    hessian_bound,
    order_on_axis,
    value_bound,
)
from harnack.fields.polynomials.harmonic_rounding import HarmonicRounding
from harnack.fields.polynomials.solid_harmonics import Weights
from harnack.fields.polynomials.sphere_range import BallRange

if TYPE_CHECKING:
    from harnack.backend import Real

# Promised ends are moved out by this much of their distance for the roundings of float32.
_ROUNDING = 1e-5
# Bounds of the Hessian are larger by this much, which pays for the rounding of the gradient.
_SLOPE_SHARE = 1e-5
# Radii of harmonic balls tried, in units of the ball about the domain.
_RADII = np.geomspace(0.1, 8.0, 200)
# Radii of the balls on which the Hessian is bounded, by experiment: two of unlike size, in
# |p|/(l-2), the larger one at least so much; near an axis of high order m, in rho/(m-2).
_NEAR, _WIDE, _LEAST, _BESIDE_AXIS = 0.4, 0.75, 0.1, 0.5
# Balls at a zero of high order have a radius nonetheless, that of such a distance.
_ORIGIN = 1e-9


@dataclass(frozen=True)
class HarmonicPromises:
    """Promises of a sum of solid harmonics at a point with distances rho and r.

    degree, lowest: the largest degree of a term, and the smallest above 0.
    order: to which the sum, less its constant, vanishes along the z axis.
    inner, outer: radii of harmonic balls at r = 0 and r = 1.
    axis_share: the share of r below which rho says how large a ball is.
    value, gradient, hessian: bounds near an axis of order 3 or more, None where the order is less.
    rounding: of value and gradient as they are evaluated.
    """

    known: BallRange
    degree: int
    lowest: int
    order: int
    inner: float
    outer: float
    axis_share: float
    axial: tuple[AxialBound, AxialBound, AxialBound] | None
    rounding: HarmonicRounding

    @classmethod
    def of(cls, weights: Weights, known: BallRange, *, is_divided: bool) -> HarmonicPromises:
        """known: the ranges of the degrees. is_divided: points are divided by a size before."""
        inner, outer = _best_radius(known, 0.0), _best_radius(known, 1.0)
        order, axial, axis_share = order_on_axis(weights), None, 0.0
        if order > 2:
            rest = {key: weight for key, weight in weights.items() if key[0] > 0}
            axial = value_bound(rest), gradient_bound(rest), hessian_bound(rest)
            lower, upper = known.by_degree(1.0)
            most = max(upper - known.constant, known.constant - lower)
            # Where rho = axis_share r, both bounds of a single term are the same.
            axis_share = (most / float(axial[0](1.0, 1.0))) ** (1 / order)
        return cls(
            known.with_spheres(weights, 1.01 * max(inner, 1.0 + outer)),
            max(degree for degree, _ in weights),
            min((degree for degree, _ in weights if degree > 0), default=0),
            order,
            inner,
            outer,
            axis_share,
            axial,
            HarmonicRounding.of(weights, is_divided=is_divided),
        )

    def ball(self, rho: Real, r: Real) -> HarmonicBall:
        """The harmonic ball."""
        radius = self._radius(rho, r)
        lower, upper = self.known.at(r + radius)
        if self.axial is not None:
            most = self.axial[0](rho + radius, r + radius) * (1 + _ROUNDING)
            lower = fmax(lower, self.known.constant - most)
            upper = fmin(upper, self.known.constant + most)
        margin = dr.fma(upper - lower, _ROUNDING, self._smallest(r))
        return HarmonicBall(radius, lower - margin, upper + margin)

    def curvatures(self, rho: Real, r: Real) -> list[Curvature]:
        """Bounds of the Hessian H, the one of the smallest ball first."""
        radii = [dr.inf]  # where the Hessian is constant
        if self.degree > 2:
            share = r / (self.degree - 2)
            radii = [_NEAR * share, fmax(_WIDE * share, _LEAST)]
            if self.axial is not None:
                radii.insert(0, fmin(rho * (_BESIDE_AXIS / (self.order - 2)), radii[0]))
        return [Curvature(self._curvature(rho, r, radius), radius) for radius in radii]

    def _curvature(self, rho: Real, r: Real, radius: Real) -> Real:
        if self.degree < 3:
            constant = self.known.curvature(0.0 * r)
        else:
            constant = self.known.curvature(r + radius)
        if self.axial is not None:
            constant = fmin(constant, self.axial[2](rho + radius, r + radius))
        return dr.fma(constant, 1 + _ROUNDING + _SLOPE_SHARE, self._smallest(r))

    def lipschitz(self, rho: Real, r: Real) -> Lipschitz | None:
        """A Lipschitz constant on a ball with a least radius, where the harmonic ball has none."""
        if self.lowest < 3:
            return None
        radius = fmax(r * (_WIDE / (self.degree - 2)), _LEAST)
        constant = self.known.gradient(r + radius)
        if self.axial is not None:
            constant = fmin(constant, self.axial[1](rho + radius, r + radius))
        return Lipschitz(dr.fma(constant, 1 + _ROUNDING, self._smallest(r)), radius)

    def error(self, rho: Real, r: Real, curvature: Curvature) -> Real:
        """How far rounding may have moved the value, and the gradient in what follows from it.

        curvature: the promise of the smallest ball. With E, a bound of the rounding of the
        gradient, and H, of the Hessian, promised as (1 + h) H with h = `_SLOPE_SHARE`,

            E t <= E^2/(2 h H) + h H t^2/2   for all t   (2 a b <= a^2 + b^2),

        so what the exact Taylor polynomial does beyond the rounded one is covered by the larger
        promise and by E^2/(2 h H) added to the error of the value. Without second derivatives the
        gradient is constant and right to a few u of itself, less than the tracer allows for the
        rounding of points (8 u |grad f| times their size). For a harmonic ball E R is a few u of
        the range, of which `enclosures.balls.solve.rounding` covers 16 u.
        """
        unit = float(dr.epsilon(type(r)))  # u, half the distance from 1 to the next number
        error = dr.fma(self.rounding.value(rho, r), unit, self._smallest(r))
        if self.degree < 2:
            return error
        slope = unit * self.rounding.gradient(rho, r)
        return dr.fma(slope * (0.5 / _SLOPE_SHARE), slope / curvature.constant, error)

    def _radius(self, rho: Real, r: Real) -> Real:
        """The radius of the harmonic ball.

        Near an axis of order m, with (range on the ball) ~ (rho + R)^m (r + R)^(l-m), the best R
        is 2/((m-2)/rho + (l-m)/r) where rho is a small part of r, and where it is r.
        """
        if self.lowest < 3:
            if self.inner < self.outer:
                return fmax(self.outer * r, self.inner)
            return fmax(dr.fma(r, self.outer - self.inner, self.inner), self.outer)
        radius = self.outer * r
        if self.axial is not None:
            order, rest = self.order - 2.0, float(self.degree - self.order)
            by_axis = 2 / (order / rho + rest / fmax(r, _ORIGIN))
            radius = dr.select(rho < self.axis_share * r, fmin(by_axis, radius), radius)
        return fmax(radius, _ORIGIN * self.outer)

    def _smallest(self, r: Real) -> float:
        """What numbers too small for the exponent may have lost of any sum here."""
        return self.rounding.lost * max(1, self.degree) ** 2 * float(dr.smallest(type(r)))


def _best_radius(known: BallRange, distance: float) -> float:
    """The radius R that makes (range on |y| <= distance + R)/R^2 least."""
    lower, upper = known.by_degree(distance + _RADII)
    return float(_RADII[np.argmin((upper - lower) / _RADII**2)])
