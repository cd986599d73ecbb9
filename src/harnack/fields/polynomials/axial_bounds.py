"""Bounds of sums of solid harmonics by the distances rho and r to the z axis and to the origin.

r^l Y_lm vanishes to order |m| along the z axis and to order l at the origin. There it, its
derivatives and the rounding of both are far smaller than anywhere else on the sphere of radius r,
and a bound that is to be of use there must shrink with both distances: it is a sum of terms
c rho^i r^j with c >= 0. As such a sum rises with rho and r, its value at (rho(p) + R, |p| + R)
bounds whatever it bounds on the whole ball B(p, R).

Every r^l Y_lm is homogeneous, so a constant c need only be found on the unit sphere. With Q = Q_l^m
of `solid_harmonics`, x + iy = sin(a) exp(i b) and z = cos(a), the functions to be bounded are
trigonometric polynomials of degree at most l in the polar angle a once the power of sin(a) is taken
out, and of degree 1 in m b: samples and Bernstein's inequality prove their largest values, as in
`sphere_range.proved_range`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.polynomials.solid_harmonics import (
    Legendre,
    Weights,
    legendre_weight,
    unit_hessian,
)

if TYPE_CHECKING:
    from harnack.backend import Real

__all__ = [
    "AxialBound",
    "amplitudes",
    "gradient_bound",
    "hessian_bound",
    "largest_gradient",
    "largest_hessian",
    "order_on_axis",
    "value_bound",
]


_ANGLES = 720  # intervals of the polar angle from pole to pole
_TURNS = 24  # azimuths over half a turn of m b


@dataclass(frozen=True)
class AxialBound:
    """The sum of c rho^i r^j, c >= 0.

    rows: (i, ((j, c), ...)) with i and j falling.
    """

    rows: tuple[tuple[int, tuple[tuple[int, float], ...]], ...]

    @classmethod
    def of(cls, terms: dict[tuple[int, int], float]) -> AxialBound:
        """terms: (i, j) -> c."""
        powers = sorted({i for i, _ in terms}, reverse=True)
        return cls(
            tuple(
                (
                    i,
                    tuple(
                        (j, terms[i, j]) for _, j in sorted(terms, reverse=True) if (i, j) in terms
                    ),
                )
                for i in powers
            )
        )

    def __call__(self, rho: Real, r: Real) -> Real:
        """Its value, by Horner's rule in both variables."""
        outer = [(i, _horner([(j, 0.0 * r + c) for j, c in row], r)) for i, row in self.rows]
        return _horner(outer, rho) if outer else 0.0 * r


def _horner(terms: list[tuple[int, Real]], x: Real) -> Real:
    """The sum of c x^i over terms (i, c), i falling."""
    (i, total), *rest = terms
    for j, c in rest:
        total, i = total * _power(x, i - j) + c, j
    return total * _power(x, i) if i else total


def _power(x: Real, n: int) -> Real:
    """x^n for n >= 1 by squaring."""
    half = None if n < 2 else _power(x, n // 2)
    if half is None:
        return x
    return half * half * x if n % 2 else half * half


def order_on_axis(weights: Weights) -> int:
    """The order to which a sum, less its constant, vanishes along the z axis."""
    return min((abs(m) for l, m in weights if l > 0), default=0)  # noqa: E741


def value_bound(weights: Weights) -> AxialBound:
    """A bound of |f|: |r^l Y_lm| <= N |Q(cos a)| rho^m r^(l-m)."""
    return _summed(weights, lambda l, m: (m, l, largest_value(l, m)))  # noqa: E741


def gradient_bound(weights: Weights) -> AxialBound:
    """A bound of |grad f|, of order m-1 in rho (0 for m = 0) for each term."""
    return _summed(weights, lambda l, m: (max(m - 1, 0), l - 1, largest_gradient(l, m)))  # noqa: E741


def hessian_bound(weights: Weights) -> AxialBound:
    """A bound of all directional second derivatives, of order m-2 in rho (0 for m < 2)."""
    return _summed(weights, lambda l, m: (max(m - 2, 0), l - 2, largest_hessian(l, m)))  # noqa: E741


def _summed(weights: Weights, one: Callable[[int, int], tuple[int, int, float]]) -> AxialBound:
    """The sum over terms; one: (l, m >= 0) -> power of rho, degree in both, constant for Y_lm.

    cos(m b) and sin(m b) together have an amplitude of the root of the sum of squares.
    """
    terms: dict[tuple[int, int], float] = {}
    for (l, m), amplitude in amplitudes(weights).items():  # noqa: E741
        power, degree, constant = one(l, m)
        if degree >= power and constant > 0:
            key = (power, degree - power)
            terms[key] = terms.get(key, 0.0) + amplitude * constant
    return AxialBound.of(terms)


def amplitudes(weights: Weights) -> dict[tuple[int, int], float]:
    """(l, m >= 0) -> amplitude of the harmonics of orders m and -m together."""
    sizes: dict[tuple[int, int], float] = {}
    for (l, m), weight in weights.items():  # noqa: E741
        sizes[l, abs(m)] = math.hypot(sizes.get((l, abs(m)), 0.0), weight)
    return sizes


def polar_samples(count: int = _ANGLES) -> tuple[FloatArray, FloatArray]:
    """cos(a) and sin(a) at count + 1 polar angles, evenly spaced from 0 to pi."""
    a = np.linspace(0.0, math.pi, count + 1)
    return np.cos(a), np.sin(a)


def _proved(sampled: FloatArray, degree: int) -> float:
    """The largest size of a trigonometric polynomial in a, from its samples at `polar_samples`.

    At its maximum A its slope is 0 and its second derivative at most degree^2 A (Bernstein), and a
    sample is within half a spacing, so the samples fall short of A by at most e A.
    """
    e = 0.5 * (max(degree, 1) * 0.5 * math.pi / _ANGLES) ** 2
    return float(np.abs(sampled).max()) / (1 - e) * (1 + 1e-12)


@functools.cache
def largest_value(l: int, m: int) -> float:  # noqa: E741
    """The largest N |Q(cos a)|."""
    z, _ = polar_samples()
    return legendre_weight(l, m) * _proved(np.broadcast_to(Legendre(z, 1.0)(l, m), z.shape), l)


@functools.cache
def largest_gradient(l: int, m: int) -> float:  # noqa: E741
    """The largest |grad r^l Y_lm| / sin(a)^(m-1) on the unit sphere (m = 0: |grad|).

    With B = rho^m cos(m b) the components along rho and z are cos(m b) times (Q rho^m)_rho and
    (l+m) Q_(l-1)^m rho^m, that along b is -sin(m b) m Q rho^(m-1): the length is at most the larger
    of the two parts.
    """
    if l == 0:
        return 0.0
    z, rho = polar_samples()
    q = Legendre(z, 1.0)
    at_m, at_next = q(l, m), (2 * m + 1) * q(l - 1, m + 1)
    if m == 0:
        radial, axial, around = -rho * at_next, l * q(l - 1, 0), 0.0 * z
    else:
        radial = m * at_m - rho * rho * at_next
        axial, around = rho * ((l + m) * (q(l - 1, m) if l > m else 0.0)), m * at_m
    # The square of a directional derivative is of degree 2 l, and so is their sum.
    steep = np.maximum(radial**2 + axial**2, around**2)
    return legendre_weight(l, m) * math.sqrt(_proved(steep, 2 * l))


@functools.cache
def largest_hessian(l: int, m: int) -> float:  # noqa: E741
    """The largest |v . H v| / sin(a)^(m-2) on the unit sphere, v a unit vector (m < 2: |v . H v|).

    For fixed v in the frame of the cylinder it is of degree l in a, and A cos(m b) + B sin(m b),
    which samples a spacing w of m b apart find up to cos(w/2).
    """
    if l < 2:
        return 0.0
    z, rho = polar_samples()
    worst = 0.0
    for turn in np.pi * np.arange(_TURNS) / _TURNS:
        b = turn / max(m, 1)
        rows = unit_hessian(l, m, rho, z, float(b), drop=max(m - 2, 0))
        sizes = np.abs(np.linalg.eigvalsh(rows)).max(axis=1)
        worst = max(worst, _proved(sizes, l))
        if m == 0:
            break
    return worst / math.cos(0.5 * math.pi / _TURNS)
