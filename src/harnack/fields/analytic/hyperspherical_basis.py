"""Harmonic functions on the sphere S^3: the (l+1)^2 functions of degree l, their sums and ranges.

Let X = (y, w) with y in R^3. The homogeneous harmonic polynomials of degree l of R^4 are spanned by

    P_ljm(X) = N_lj S_jm(y) |X|^(l-j) C_(l-j)^(j+1)(w/|X|),   0 <= j <= l, -j <= m <= j.

Here S_jm = |y|^j Y_jm is a solid harmonic of `solid_harmonics`. C_n^k is a Gegenbauer polynomial;
it obeys n C_n = 2 (n+k-1) w C_(n-1) - (n+2k-2) C_(n-2) for fixed k. N_lj is the factor for which
the integral of P^2 over S^3 is 1: with n = l-j and k = j+1 (DLMF 18.3),

    N^-2 = integral of sin(a)^(2k) C_n^k(cos a)^2 = pi 2^(1-2k) (n+2k-1)!/(n! (n+k) ((k-1)!)^2).

All functions here are evaluated on the sphere |X| = 1.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.analytic.solid_harmonics import evaluate
from harnack.fields.analytic.sphere_bounds import proved_range, unit_sphere

__all__ = [
    "LARGEST_DEGREE",
    "HypersphereRange",
    "Monomials",
    "SphereWeights",
    "from_monomials",
    "gegenbauer",
    "gegenbauer_rounding",
    "weights_by_order",
]

LARGEST_DEGREE = 6

SphereWeights: TypeAlias = Mapping[tuple[int, int], float]  #: (j, m) -> coefficient of P_ljm
Monomials: TypeAlias = Mapping[tuple[int, int, int, int], float]  #: of x^a y^b z^c w^d

# The number of zones of equal width in the angle from the pole on which ranges are proved.
_SLICES = 256
# The product of degree and grid spacing on each of these spheres.
_RESOLUTION = 0.1


def norm(l: int, j: int) -> float:  # noqa: E741
    """The factor N_lj, for which the integral of P_ljm^2 over S^3 is 1."""
    n, k = l - j, j + 1
    square = math.pi * 2.0 ** (1 - 2 * k) * math.factorial(n + 2 * k - 1)
    square /= math.factorial(n) * (n + k) * math.factorial(k - 1) ** 2
    return 1 / math.sqrt(square)


def gegenbauer(n: int, k: int, w: Any) -> Any:
    """The Gegenbauer polynomial C_n^k(w), for NumPy or Dr.Jit numbers w; 0 for n < 0."""
    if n < 0:
        return 0.0 * w
    previous, value = 0.0 * w, 0.0 * w + 1.0
    for i in range(1, n + 1):
        a, b = _coefficients(i, k)
        previous, value = value, a * (w * value) - b * previous
    return value


def _coefficients(i: int, k: int) -> tuple[float, float]:
    """The coefficients (a, b) of the step C_i = a w C_(i-1) - b C_(i-2) of the recurrence of
    Gegenbauer polynomials C_i^k for fixed k."""
    return 2 * (i + k - 1) / i, (i + 2 * k - 2) / i


@functools.cache
def gegenbauer_rounding(n: int, k: int) -> float:
    """A bound, to first order in u, of the rounding error of `gegenbauer` on [-1, 1], in units of
    u.

    A step of the recurrence adds an error of 4u |a w C_(i-1)| + 3u |b C_(i-2)|, and propagates the
    errors of earlier steps by the same recurrence. The sum of the absolute errors is sampled at
    4001 angles; the factor 1.03 covers values between samples.
    """
    w = np.cos(np.linspace(0, math.pi, 4001))
    total = np.zeros_like(w)
    for step in range(1, n + 1):
        a, b = _coefficients(step, k)
        step_error = 4 * np.abs(a * w * gegenbauer(step - 1, k, w))
        step_error += 3 * np.abs(b * gegenbauer(step - 2, k, w))
        last_growth, growth = np.zeros_like(w), np.ones_like(w)
        for i in range(step + 1, n + 1):
            a, b = _coefficients(i, k)
            last_growth, growth = growth, a * w * growth - b * last_growth
        total += np.abs(growth) * step_error
    return 1.03 * float(total.max())


def weights_by_order(l: int, weights: SphereWeights) -> dict[int, dict[tuple[int, int], float]]:  # noqa: E741
    """For each j, the weights of the solid harmonics in the factor S(y) of C_(l-j)^(j+1)(w).

    weights: (j, m) -> coefficient of P_ljm.

    Returns j -> {(j, m): weight}, where the weights contain the factor N_lj.
    """
    orders: dict[int, dict[tuple[int, int], float]] = {}
    for (j, m), weight in sorted(weights.items()):
        orders.setdefault(j, {})[j, m] = norm(l, j) * weight
    return orders


def from_monomials(coefficients: Monomials) -> tuple[int, dict[tuple[int, int], float]]:
    """The degree l and the weights (j, m) -> c of a homogeneous harmonic polynomial, sum of c
    P_ljm.

    coefficients: (a, b, c, d) -> coefficient of x^a y^b z^c w^d.

    The weights are integrals over S^3 of products of degree 2l <= 12. The quadrature is exact for
    them: Gauss and Chebyshev's rule in w, Gauss and Legendre's on S^2, even steps in longitude. A
    polynomial that is not harmonic differs from the sum of these projections.

    Raises:
        ValueError: the polynomial is not homogeneous, of a degree above 6, zero, or not harmonic.
    """
    degrees = sorted({sum(powers) for powers, c in coefficients.items() if c != 0})
    if not degrees:
        raise ValueError("the polynomial is zero: it has no level sets")
    if len(degrees) > 1:
        raise ValueError(
            f"the polynomial has terms of degrees {degrees}: all must have one degree (multiply "
            "those of degree l - 2 by x^2 + y^2 + z^2 + w^2, which is 1 on the sphere)"
        )
    l = degrees[0]  # noqa: E741
    if l > LARGEST_DEGREE:
        raise ValueError(f"the degree must be 0 to {LARGEST_DEGREE}, not {l}")
    a = math.pi * np.arange(1, 9) / 9
    c, legendre = np.polynomial.legendre.leggauss(8)
    longitudes = 2 * math.pi * np.arange(16) / 16
    angle, cosine, longitude = (
        entry.ravel() for entry in np.meshgrid(a, c, longitudes, indexing="ij")
    )
    sine = np.sqrt(1 - cosine**2)
    weight = (np.sin(a) ** 2 * math.pi / 9)[:, None, None] * legendre[:, None] * (math.pi / 8)
    weight = np.broadcast_to(weight, (8, 8, 16)).ravel()
    direction = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), cosine])
    y, w = np.sin(angle) * direction, np.cos(angle)
    values = sum(
        entry * y[0] ** i * y[1] ** j * y[2] ** k * w**n
        for (i, j, k, n), entry in coefficients.items()
    )
    weights: dict[tuple[int, int], float] = {}
    misfit = np.array(values, dtype=np.float64)
    for j in range(l + 1):
        axial = norm(l, j) * gegenbauer(l - j, j + 1, w)
        for m in range(-j, j + 1):
            basis = axial * (evaluate({(j, m): 1.0}, *y)[0] + 0.0 * w)
            weights[j, m] = float(weight @ (values * basis))
            misfit -= weights[j, m] * basis
    size = float(np.abs(values).max())
    if float(np.abs(misfit).max()) > 1e-9 * size:
        raise ValueError(
            "the polynomial is not harmonic in R^4: its second derivatives in x, y, z and w do not "
            f"add up to zero (on the unit sphere {float(np.abs(misfit).max()):.3g} is left of it)"
        )
    largest = max(abs(entry) for entry in weights.values())
    return l, {key: entry for key, entry in weights.items() if abs(entry) > 1e-13 * largest}


@dataclass(frozen=True)
class HypersphereRange:
    """Proved ranges of a sum of P_ljm on S^3, and on zones of S^3 about the pole w = 1.

    degree: the degree l of the sum P.
    low, high: the range on all of S^3.
    lower, upper: (n,) the ranges on the zones of points whose angle from the pole w = 1 is from i
        pi/n to (i+1) pi/n.
    pole: the value at w = 1, to which f tends far away.

    Proof. P is sampled on the sphere in the middle of each zone, where it is a polynomial of degree
    l on S^2, at points within the angle `covering` of all others: `proved_range` gives its range
    there. Each point of S^3 is within `covering` plus half a step of angle of a sample, so
    `proved_range`, whose proof is along great circles, also gives the range on S^3. From the middle
    of a zone to its ends P changes by at most l A pi/(2n) (Bernstein), where A is half the length
    of the range on S^3.
    """

    degree: int
    low: float
    high: float
    lower: FloatArray
    upper: FloatArray
    pole: float

    @classmethod
    def of(cls, l: int, weights: SphereWeights) -> HypersphereRange:  # noqa: E741
        """Proved ranges of a sum P of the P_ljm of degree l on the unit sphere S^3 and on its
        zones, from samples.

        weights: the mapping (j, m) -> coefficient of P_ljm.

        P is sampled on the sphere in the middle of each zone, at points that are within the angle
        `covering` of all others. With e = (l covering)^2/2 and H half the length of the range of
        the samples, P exceeds this range by at most H e/(1 - e) on that sphere (`proved_range`).
        Within the zone it exceeds it by at most l A step/2 more (Bernstein), with A half the length
        of the range on S^3 and `step` the angle from the start of a zone to its end.
        """
        covering = _RESOLUTION / max(1, l)
        sphere = unit_sphere(covering)
        step = math.pi / _SLICES
        a = step * (np.arange(_SLICES) + 0.5)
        values = np.zeros((_SLICES, sphere.shape[1]))
        pole = 0.0
        for j, sums in weights_by_order(l, weights).items():
            # A constant becomes an array.
            harmonic = evaluate(sums, *sphere)[0] + 0.0 * sphere[0]
            values += (np.sin(a) ** j * gegenbauer(l - j, j + 1, np.cos(a)))[:, None] * harmonic
            if j == 0:
                pole += float(harmonic[0]) * float(gegenbauer(l, 1, np.ones(1))[0])
        lower, upper = values.min(axis=1), values.max(axis=1)
        low, high = float(lower.min()), float(upper.max())
        low, high = proved_range(low, high, l, covering + 0.5 * step)
        e = 0.5 * (l * covering) ** 2
        # The last term of the margin is for rounding.
        margin = 0.5 * (upper - lower) * e / (1 - e)
        margin = margin + 0.5 * (high - low) * (0.5 * step * l) + 1e-11 * (high - low)
        return cls(l, low, high, lower - margin, upper + margin, pole)

    @property
    def largest(self) -> float:
        """A bound of |P| on S^3."""
        return max(-self.low, self.high)

    def radius(self, level: float) -> float:
        """The radius of a ball about the origin of space that contains all points with this level;
        infinite if there is no such ball, and 0 if the level does not occur.

        Points at the angle a from the pole w = 1 have the distance cot(a/2) from the origin. If the
        level may occur in the first zone, write P = A cos(b) along a great circle from the pole,
        with A >= |P|. Then b changes at a rate of at most l (Szego), so the level is at an angle of
        at least |b(level) - b(pole)|/l.
        """
        slices = np.flatnonzero((self.lower <= level) & (level <= self.upper))
        if slices.size and slices[0] > 0:
            angle = math.pi / len(self.lower) * float(slices[0])
        elif slices.size == 0:
            return 0.0
        else:
            bound, l = self.largest, max(1, self.degree)  # noqa: E741
            b, start = (math.acos(max(-1.0, min(1.0, f / bound))) for f in (level, self.pole))
            angle = abs(b - start) / l - 1e-9
        return 1 / math.tan(0.5 * angle) * (1 + 1e-9) if angle > 0 else math.inf
