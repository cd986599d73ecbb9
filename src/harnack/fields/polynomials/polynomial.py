"""Harmonic polynomials and spherical harmonics, clipped to a ball (paper, section 4.1)."""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.enclosures import Curvature, HarmonicBall, Lipschitz, Promise
from harnack.fields.field import Field, Sample, check_in_range
from harnack.fields.polynomials.axial_bounds import order_on_axis
from harnack.fields.polynomials.harmonic_promises import HarmonicPromises
from harnack.fields.polynomials.solid_harmonics import (
    LARGEST_DEGREE,
    Weights,
    degree_and_order,
    evaluate,
    from_monomials,
    hessian,
    laplacian,
)
from harnack.fields.polynomials.sphere_range import BallRange, range_of_harmonic
from harnack.geometry.volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Vec3
    from harnack.geometry.volumes import Volume

__all__ = ["HarmonicPolynomial", "SphericalHarmonic"]


class _SolidHarmonics(Field):
    """A sum of solid harmonics of p/size, for |p| <= size; see `HarmonicPromises`."""

    overstep = 1.6

    def __init__(
        self, weights: Weights, known: BallRange, size: float, domain: Volume, axis: int = 2
    ) -> None:
        """axis: of p, that is z of the solid harmonics; x and y follow it cyclically."""
        self.domain = domain
        self._axis = axis
        self._weights = weights
        self._size = size
        self._promises = HarmonicPromises.of(weights, known, is_divided=size != 1.0)
        self.value_range = known.with_spheres(weights, 1.0).on_ball(1.0)

    @property
    def degree(self) -> int:
        """The largest degree of a term."""
        return max(degree for degree, _ in self._weights)

    def evaluate(self, p: Vec3) -> Sample:
        s, size = self._local(p), self._size
        value, gradient = evaluate(self._weights, s.x, s.y, s.z)
        rho, r = dr.norm(type(s)(s.x, s.y, 0)), dr.norm(s)
        ball, lipschitz = self._promises.ball(rho, r), self._promises.lipschitz(rho, r)
        curvatures = self._promises.curvatures(rho, r)
        known = tuple(Curvature(one.constant / size**2, one.radius * size) for one in curvatures)
        weaker: list[Promise] = [HarmonicBall(ball.radius * size, ball.lower, ball.upper)]
        if lipschitz is not None:
            weaker.append(Lipschitz(lipschitz.constant / size, lipschitz.radius * size))
        error = self._promises.error(rho, r, curvatures[0])
        slope = type(p)(*_turned(gradient, -self._axis - 1)) / size
        return Sample(value, slope, known, error, weaker=tuple(weaker))

    def _local(self, p: Vec3) -> Vec3:
        return type(p)(*_turned((p.x, p.y, p.z), self._axis + 1)) / self._size

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the Hessian, free of trace to rounding."""
        s, share, k = self._local(p), 1 / self._size**2, -self._axis - 1
        xx, yy, zz, xy, xz, yz = (share * one for one in hessian(self._weights, s.x, s.y, s.z))
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        x, y, z = _turned([type(p)(*_turned(row, k)) for row in rows], k)
        return x, y, z

    def check_levels(self, levels: tuple[float, ...]) -> None:
        check_in_range(levels, self.value_range, "in its domain the function")

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

    Raises:
        ValueError: l or m outside these ranges, or a radius that is not positive.
        TypeError: l or m is no whole number.
    """

    def __init__(self, l: int, m: int, *, radius: float = 1.0) -> None:  # noqa: E741
        l, m = degree_and_order((l, m))  # noqa: E741
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

    Raises:
        ValueError: the polynomial is not harmonic (the message shows its Laplacian), its degree is
            above 12, a coefficient is not finite, or the domain is unbounded.
        TypeError: coefficients is no dictionary.
    """

    def __init__(
        self, coefficients: Mapping[tuple[int, int, int], float], *, domain: Volume | None = None
    ) -> None:
        self.coefficients = _checked(coefficients)
        domain = Ball() if domain is None else domain
        size = _enclosing_radius(domain)
        scaled = {powers: c * size ** sum(powers) for powers, c in self.coefficients.items()}
        # The z axis of the solid harmonics is the one along which it vanishes to the highest order.
        along = [
            from_monomials({_turned(k, axis + 1): c for k, c in scaled.items()})
            for axis in range(3)
        ]
        axis = max((2, 0, 1), key=lambda axis: order_on_axis(along[axis]))
        weights = along[axis]
        super().__init__(weights, BallRange.of(weights), size, domain, axis)


def _turned(three: Sequence[Any], n: int) -> tuple[Any, Any, Any]:
    """Three things moved n places to the front, cyclically: (x, y, z) becomes (y, z, x) for 1."""
    return three[n % 3], three[(n + 1) % 3], three[(n + 2) % 3]


def _checked(given: Any) -> dict[tuple[int, int, int], float]:
    """The coefficients that are not zero.

    Raises:
        TypeError, ValueError: they make no harmonic polynomial.
    """
    if not isinstance(given, Mapping):
        raise TypeError(
            "a harmonic polynomial is given by its coefficients, such as {(2, 1, 0): 1, "
            f"(0, 1, 2): -1}} for x^2 y - y z^2, not by {given!r}"
        )
    checked: dict[tuple[int, int, int], float] = {}
    for powers, value in cast("Mapping[Any, Any]", given).items():
        try:
            i, j, k = (operator.index(n) for n in powers)
        except (TypeError, ValueError):
            raise ValueError(f"{powers!r} is no exponent (i, j, k) of x^i y^j z^k") from None
        if min(i, j, k) < 0:
            raise ValueError(f"exponents must not be negative: {powers!r}")
        if not (isinstance(value, numbers.Real) and math.isfinite(value)):
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
        terms = [f"{c:g} {_monomial(powers)}".strip() for powers, c in sorted(rest.items())]
        shown = " + ".join(terms)
        raise ValueError(f"the polynomial is not harmonic: its Laplacian is {shown}, not 0")
    return checked


def _monomial(powers: tuple[int, int, int]) -> str:
    named = zip("xyz", powers, strict=True)
    return " ".join(name if n == 1 else f"{name}^{n}" for name, n in named if n)


def _enclosing_radius(domain: Volume) -> float:
    """The radius of a ball about the origin that holds the domain."""
    if isinstance(domain, Ball):
        return float(np.linalg.norm(domain.center)) + domain.radius
    corners = np.abs(np.array(domain.bounds())).max(axis=0)
    if not np.isfinite(corners).all():
        raise ValueError("a harmonic polynomial needs a bounded domain, such as a Ball or a Box")
    return float(np.linalg.norm(corners))
