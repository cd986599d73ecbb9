"""Harmonic polynomials and spherical harmonics, clipped to a ball (paper, section 4.1)."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax
from harnack.fields.field import Curvature, Field, HarmonicBall, Sample
from harnack.fields.solid_harmonics import (
    LARGEST_DEGREE,
    Weights,
    evaluate,
    from_monomials,
    hessian,
    laplacian,
)
from harnack.fields.sphere_range import BallRange, range_of_harmonic
from harnack.geometry.volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.geometry.volumes import Volume

__all__ = ["HarmonicPolynomial", "SphericalHarmonic"]

# Promised ends are moved out by this much of their distance for the roundings of float32.
_ROUNDING = 1e-5
# Radii of harmonic balls tried, in units of the ball about the domain.
# Radii of the balls on which the Hessian is bounded (by experiment: two of unlike size).
_REACHES = ((0.25, 0.05), (1.0, 0.1))
_RADII = np.geomspace(0.1, 8.0, 200)


class _SolidHarmonics(Field):
    """A sum of solid harmonics of p/size, for |p| <= size or a little beyond.

    The promise at p is for a ball about p, of a radius R that depends on |p|. It lies in the
    ball of radius |p| + R about the origin, where `BallRange` bounds the polynomial. The paper
    takes the fixed ball |y| <= 1.25 size; near level 0 a step loses to the second-order term of
    the bound, proportional to (range on |y| <= |p|+R)/R^2, so R is chosen to make that least:
    2|p|/(l-2) for a single degree l > 2. With the slope bound Y_(8,4) took 19 evaluations a ray,
    with the fixed ball 30 (27 at best, for 1.15); Y_(12,5) took 24 and 61 (50).
    """

    def __init__(self, weights: Weights, known: BallRange, size: float, domain: Volume) -> None:
        self.domain = domain
        self._weights = weights
        self._size = size
        self._inner, self._outer = _best_radius(known, 0.0), _best_radius(known, 1.0)
        largest = 1.01 * max(self._inner, 1.0 + self._outer)
        self._known = known.with_spheres(weights, largest)
        self.value_range = known.with_spheres(weights, 1.0).on_ball(1.0)

    @property
    def degree(self) -> int:
        """The largest degree of a term."""
        return max(degree for degree, _ in self._weights)

    def evaluate(self, p: Vec3) -> Sample:
        s = p / self._size
        value, gradient = evaluate(self._weights, s.x, s.y, s.z)
        distance = dr.norm(s)
        radius = self._radius(distance)
        lower, upper = self._known.at(distance + radius)
        margin = _ROUNDING * (upper - lower)
        ball = HarmonicBall(radius * self._size, lower - margin, upper + margin)
        known = (ball, *(self._curvature(distance, *reach) for reach in _REACHES))
        error = 8 * dr.epsilon(type(value)) * fmax(upper, -lower)
        return Sample(value, type(p)(*gradient) / self._size, known, error)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the Hessian, free of trace to rounding."""
        s, share = p / self._size, 1 / self._size**2
        xx, yy, zz, xy, xz, yz = (share * one for one in hessian(self._weights, s.x, s.y, s.z))
        return type(p)(xx, xy, xz), type(p)(xy, yy, yz), type(p)(xz, yz, zz)

    def _curvature(self, distance: Real, share: float, least: float) -> Curvature:
        """The Hessian's bound on a ball of radius share |p|/(l-2), at least `least` sizes."""
        radius = fmax(share / max(self.degree - 2, 0.5) * distance, least)
        constant = self._known.curvature(distance + radius) * (1 + _ROUNDING)
        return Curvature(constant / self._size**2, radius * self._size)

    def _radius(self, distance: Real) -> Real:
        if self._inner < self._outer:
            return fmax(self._outer * distance, self._inner)
        return fmax(dr.fma(distance, self._outer - self._inner, self._inner), self._outer)

    def differentiable_value(self, p: Vec3) -> Real:
        s = p / self._size
        return evaluate(self._weights, s.x, s.y, s.z)[0]

    def check_levels(self, levels: tuple[float, ...]) -> None:
        """ValueError for a level that is proved to lie outside the range in the domain."""
        low, high = self.value_range
        for level in levels:
            if not low <= level <= high:
                raise ValueError(
                    f"no surface has level {level:g}: in its domain the function stays within "
                    f"[{low:.6g}, {high:.6g}]"
                )

    def describe(self) -> dict[str, Any]:
        return {
            "degree": self.degree,
            "solid harmonics": len(self._weights),
            "range in the domain": self.value_range,
        }


class SphericalHarmonic(_SolidHarmonics):
    """The solid harmonic (|p|/radius)^l Y_lm(p/|p|), a homogeneous polynomial, in a ball.

    Y_lm is the real spherical harmonic with unit mean square *integral* (orthonormal: the
    integral of Y^2 over the unit sphere is 1), without the Condon-Shortley phase: Y_11 is a
    positive multiple of x, Y_1-1 of y, Y_10 of z. m > 0 has cos(m phi), m < 0 sin(|m| phi).

    l, m: degree 0 <= l <= 12 and order -l <= m <= l.
    radius: of the ball that it is clipped to, about the origin.

    Raises ValueError (TypeError if not whole numbers) for others.
    """

    def __init__(self, l: int, m: int, *, radius: float = 1.0) -> None:  # noqa: E741
        l, m = operator.index(l), operator.index(m)  # noqa: E741
        if not 0 <= l <= LARGEST_DEGREE:
            raise ValueError(f"the degree l must be 0 to {LARGEST_DEGREE}, not {l}")
        if abs(m) > l:
            raise ValueError(f"the order m must be -l to l, here -{l} to {l}, not {m}")
        domain = Ball(radius=radius)
        self.l, self.m = l, m
        low, high = range_of_harmonic(l, m)
        known = BallRange(low, ()) if l == 0 else BallRange(0.0, ((l, low, high),))
        super().__init__({(l, m): 1.0}, known, domain.radius, domain)


class HarmonicPolynomial(_SolidHarmonics):
    """A harmonic polynomial given by its monomials, up to degree 12.

    coefficients: {(i, j, k): c} stands for the sum of c x^i y^j z^k; the paper's Eq. 8 is
        HarmonicPolynomial({(2, 1, 0): 1, (0, 1, 2): -1}).
    domain: the volume it is clipped to, bounded; by default the ball of radius 1.

    The Laplacian must vanish, up to 1e-9 of the terms that cancel in it. The polynomial is
    evaluated as a sum of solid harmonics, which agrees with it in value and z-derivative on the
    plane z = 0, thus everywhere if it is harmonic.

    Raises ValueError for a polynomial that is not harmonic (showing its Laplacian), of a higher
    degree, with coefficients that are not finite, or for an unbounded domain.
    """

    def __init__(
        self, coefficients: Mapping[tuple[int, int, int], float], *, domain: Volume | None = None
    ) -> None:
        self.coefficients = _checked(coefficients)
        domain = Ball() if domain is None else domain
        size = _enclosing_radius(domain)
        scaled = {powers: c * size ** sum(powers) for powers, c in self.coefficients.items()}
        weights = from_monomials(scaled)
        super().__init__(weights, BallRange.of(weights), size, domain)


def _checked(
    coefficients: Mapping[tuple[int, int, int], float],
) -> dict[tuple[int, int, int], float]:
    """The coefficients that are not zero. ValueError unless they make a harmonic polynomial."""
    checked: dict[tuple[int, int, int], float] = {}
    for powers, value in coefficients.items():
        try:
            i, j, k = (operator.index(n) for n in powers)
        except (TypeError, ValueError):
            raise ValueError(f"{powers!r} is no exponent (i, j, k) of x^i y^j z^k") from None
        if min(i, j, k) < 0:
            raise ValueError(f"exponents must not be negative: {powers!r}")
        if not math.isfinite(value):
            raise ValueError(f"the coefficient of {powers!r} is {value!r}, not a finite number")
        if i + j + k > LARGEST_DEGREE:
            raise ValueError(
                f"{_monomial((i, j, k))} has degree {i + j + k}: at most {LARGEST_DEGREE} is "
                "supported"
            )
        if value != 0:
            checked[i, j, k] = float(value)
    if not checked:
        raise ValueError("a harmonic polynomial needs a coefficient that is not zero")
    rest, worst = laplacian(checked)
    if worst > 1e-9:
        shown = " + ".join(f"{c:g} {_monomial(powers)}" for powers, c in sorted(rest.items()))
        raise ValueError(f"the polynomial is not harmonic: its Laplacian is {shown}, not 0")
    return checked


def _monomial(powers: tuple[int, int, int]) -> str:
    named = zip("xyz", powers, strict=True)
    shown = " ".join(name if n == 1 else f"{name}^{n}" for name, n in named if n)
    return shown or "1"


def _enclosing_radius(domain: Volume) -> float:
    """The radius of a ball about the origin that holds the domain."""
    if isinstance(domain, Ball):
        return float(np.linalg.norm(domain.center)) + domain.radius
    corners = np.abs(np.array(domain.bounds())).max(axis=0)
    if not np.isfinite(corners).all():
        raise ValueError("a harmonic polynomial needs a bounded domain, such as a Ball or a Box")
    return float(np.linalg.norm(corners))


def _best_radius(known: BallRange, distance: float) -> float:
    """The radius R that makes (range on |y| <= distance + R)/R^2 least."""
    lower, upper = known.by_degree(distance + _RADII)
    return float(_RADII[np.argmin((upper - lower) / _RADII**2)])
