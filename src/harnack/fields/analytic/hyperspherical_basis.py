"""Harmonic functions on the sphere S^3, the unit sphere of R^4: the (l+1)^2 functions of degree l,
their sums and ranges. Let X = (y, w) be a point of R^4, with y in R^3. The homogeneous harmonic
polynomials of degree l of R^4 are spanned by P_ljm(X) = N_lj S_jm(y) |X|^(l-j) C_(l-j)^(j+1)(w/|X|)
with 0 <= j <= l and -j <= m <= j. Here S_jm = |y|^j Y_jm is a solid harmonic of `solid_harmonics`,
C_n^k is a Gegenbauer polynomial, and N_lj is the factor for which the integral of P^2 over S^3 is
1. The weights of a sum are its coefficients c_jm. The point w = 1 of S^3 is called the pole. All
functions here are evaluated on S^3, where |X| = 1.

The Gegenbauer polynomials obey n C_n = 2 (n+k-1) w C_(n-1) - (n+2k-2) C_(n-2) for fixed k. With n =
l-j and k = j+1 (DLMF 18.3),

    N^-2 = integral of sin(a)^(2k) C_n^k(cos a)^2 = pi 2^(1-2k) (n+2k-1)!/(n! (n+k) ((k-1)!)^2).
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
    """The factor N_lj of the polynomial P_ljm, for which the integral of P_ljm^2 over S^3 is 1."""
    n, k = l - j, j + 1
    # The integral of C_n^k(w)^2 (1 - w^2)^(k - 1/2) over [-1, 1]; over S^2 that of Y_jm^2 is 1.
    square = math.pi * 2.0 ** (1 - 2 * k) * math.factorial(n + 2 * k - 1)
    square /= math.factorial(n) * (n + k) * math.factorial(k - 1) ** 2
    return 1 / math.sqrt(square)


def gegenbauer(n: int, k: int, w: Any) -> Any:
    """The Gegenbauer polynomial C_n^k at w, a NumPy or Dr.Jit number; 0 for n < 0. It is computed
    by its recurrence in n."""
    if n < 0:
        return 0.0 * w
    # C_-1 = 0 and C_0 = 1; then C_i = a w C_(i-1) - b C_(i-2).
    previous, value = 0.0 * w, 0.0 * w + 1.0
    for degree in range(1, n + 1):
        a, b = _coefficients(degree, k)
        previous, value = value, a * (w * value) - b * previous
    return value


def _coefficients(i: int, k: int) -> tuple[float, float]:
    """The coefficients (a, b) of the recurrence C_i = a w C_(i-1) - b C_(i-2) of the Gegenbauer
    polynomials C_i^k for fixed k."""
    return 2 * (i + k - 1) / i, (i + 2 * k - 2) / i


@functools.cache
def gegenbauer_rounding(n: int, k: int) -> float:
    """A bound of the rounding error of `gegenbauer` for w in [-1, 1], in units of the unit roundoff
    u, to first order.

    A step of the recurrence C_i = a w C_(i-1) - b C_(i-2) adds an error of 4u |a w C_(i-1)| + 3u |b
    C_(i-2)|. The errors of earlier steps grow by the same recurrence. The sum of the absolute
    errors is sampled at 4001 angles; the factor 1.03 covers values between samples.
    """
    w = np.cos(np.linspace(0, math.pi, 4001))
    error_sum = np.zeros_like(w)
    for step in range(1, n + 1):
        a, b = _coefficients(step, k)
        step_error = 4 * np.abs(a * w * gegenbauer(step - 1, k, w))
        step_error += 3 * np.abs(b * gegenbauer(step - 2, k, w))
        # By which factor the error of this step has grown at degree n.
        last_growth, growth = np.zeros_like(w), np.ones_like(w)
        for i in range(step + 1, n + 1):
            a, b = _coefficients(i, k)
            last_growth, growth = growth, a * w * growth - b * last_growth
        error_sum += np.abs(growth) * step_error
    return 1.03 * float(error_sum.max())


def weights_by_order(l: int, weights: SphereWeights) -> dict[int, dict[tuple[int, int], float]]:  # noqa: E741
    """Sort the terms of a sum of P_ljm by j. The terms of the same j have the common factor
    C_(l-j)^(j+1)(w), which is multiplied by a sum of solid harmonics of y.

    weights: a mapping (j, m) -> coefficient of P_ljm.

    Returns a mapping j -> {(j, m): weight}, the weights of the solid harmonics, with the factor
    N_lj included.
    """
    orders: dict[int, dict[tuple[int, int], float]] = {}
    for (j, m), weight in sorted(weights.items()):
        orders.setdefault(j, {})[j, m] = norm(l, j) * weight
    return orders


def from_monomials(coefficients: Monomials) -> tuple[int, dict[tuple[int, int], float]]:
    """Write a homogeneous harmonic polynomial of R^4 as a sum of c P_ljm. Returns its degree l and
    its weights, a mapping (j, m) -> c.

    coefficients: a mapping (a, b, c, d) -> coefficient of x^a y^b z^c w^d.

    The weights are integrals over S^3 of products of degree 2l <= 12. The quadrature is exact for
    them: Gauss and Chebyshev's rule in w, Gauss and Legendre's on S^2, even steps in longitude. A
    polynomial that is not harmonic differs from the sum of these projections.

    Raises:
        ValueError: the polynomial is not homogeneous, of a degree above 6, zero, or not harmonic.
    """
    degrees = sorted({sum(powers) for powers, entry in coefficients.items() if entry != 0})
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
    # Products of two polynomials up to degree 6 are integrated exactly by eight nodes of each of
    # Gauss's rules (up to degree 15), and by 16 longitudes.
    polar_angles = math.pi * np.arange(1, 9) / 9
    z_nodes, z_weights = np.polynomial.legendre.leggauss(8)
    # The nodes of S^3: angle from the w axis, cosine of the angle from the z axis, longitude.
    longitudes = 2 * math.pi * np.arange(16) / 16
    angle, cosine, longitude = (
        entry.ravel() for entry in np.meshgrid(polar_angles, z_nodes, longitudes, indexing="ij")
    )
    sine = np.sqrt(1 - cosine**2)
    # The weights are pi/(8 + 1) sin^2 for the angle from the w axis, those of Gauss and Legendre,
    # and 2 pi/16 for the longitude.
    quadrature_weights = (
        (np.sin(polar_angles) ** 2 * math.pi / 9)[:, None, None]
        * z_weights[:, None]
        * (math.pi / 8)
    )
    quadrature_weights = np.broadcast_to(quadrature_weights, (8, 8, 16)).ravel()
    direction = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), cosine])
    # The points (y, w) of S^3.
    y, w = np.sin(angle) * direction, np.cos(angle)
    values = sum(
        entry * y[0] ** i * y[1] ** j * y[2] ** k * w**n
        for (i, j, k, n), entry in coefficients.items()
    )
    weights: dict[tuple[int, int], float] = {}
    residual = np.array(values, dtype=np.float64)
    for j in range(l + 1):
        axial = norm(l, j) * gegenbauer(l - j, j + 1, w)
        for m in range(-j, j + 1):
            # P_ljm at the nodes. (The first result of `evaluate` is the value; 0 w makes an array
            # of it.)
            basis = axial * (evaluate({(j, m): 1.0}, *y)[0] + 0.0 * w)
            # The projection to P_ljm, which is subtracted.
            weights[j, m] = float(quadrature_weights @ (values * basis))
            residual -= weights[j, m] * basis
    largest_value = float(np.abs(values).max())
    # More than rounding is left.
    if float(np.abs(residual).max()) > 1e-9 * largest_value:
        raise ValueError(
            "the polynomial is not harmonic in R^4: its second derivatives in x, y, z and w do not "
            f"add up to zero (on the unit sphere {float(np.abs(residual).max()):.3g} is left of it)"
        )
    largest = max(abs(entry) for entry in weights.values())
    # Weights that are rounding errors are left out.
    return l, {key: entry for key, entry in weights.items() if abs(entry) > 1e-13 * largest}


@dataclass(frozen=True)
class HypersphereRange:
    """Proved ranges of a sum P of P_ljm on S^3, the unit sphere of R^4, and on zones of it about
    the pole w = 1. A zone is the part of S^3 with angles from the pole in a certain range, such as
    between two circles of latitude.

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
        """Compute proved ranges of a sum P of the P_ljm of degree l on S^3 and on its zones, and
        the value at the pole w = 1, from samples.

        weights: a mapping (j, m) -> coefficient of P_ljm.

        P is sampled on the sphere in the middle of each zone, at points that are within the angle
        `covering` of all others. With e = (l covering)^2/2 and H half the length of the range of
        the samples, P exceeds this range by at most H e/(1 - e) on that sphere (`proved_range`).
        Within the zone it exceeds it by at most l A zone_angle/2 more (Bernstein), with A half the
        length of the range on S^3 and `zone_angle` the angle from the start of a zone to its end.
        """
        covering = _RESOLUTION / max(1, l)
        sphere = unit_sphere(covering)
        zone_angle = math.pi / _SLICES
        middle_angles = zone_angle * (np.arange(_SLICES) + 0.5)
        values = np.zeros((_SLICES, sphere.shape[1]))
        pole = 0.0
        for j, harmonic_weights in weights_by_order(l, weights).items():
            # The value of the harmonic, without its gradient; the added 0 makes an array of a
            # constant.
            harmonic = evaluate(harmonic_weights, *sphere)[0] + 0.0 * sphere[0]
            # A point of S^3 is (sin(a) q, cos(a)) with q on S^2, and the harmonic has degree j.
            values += (
                np.sin(middle_angles) ** j * gegenbauer(l - j, j + 1, np.cos(middle_angles))
            )[:, None] * harmonic
            # At the pole y = 0, so only the constant harmonic is not 0.
            if j == 0:
                pole += float(harmonic[0]) * float(gegenbauer(l, 1, np.ones(1))[0])
        # The range of the samples in each zone, and on all of S^3.
        lower, upper = values.min(axis=1), values.max(axis=1)
        low, high = float(lower.min()), float(upper.max())
        low, high = proved_range(low, high, l, covering + 0.5 * zone_angle)
        # First part of the margin: between samples on the sphere in the middle of the zone.
        e = 0.5 * (l * covering) ** 2
        # The last term of the margin is for rounding.
        margin = 0.5 * (upper - lower) * e / (1 - e)
        margin = margin + 0.5 * (high - low) * (0.5 * zone_angle * l) + 1e-11 * (high - low)
        return cls(l, low, high, lower - margin, upper + margin, pole)

    @property
    def largest(self) -> float:
        """A bound of |P| on S^3."""
        return max(-self.low, self.high)

    def radius(self, level: float) -> float:
        """The radius of a ball about the origin of space that contains all points with this level;
        infinite if there is no such ball, and 0 if the level does not occur. A point of space
        belongs to a point of S^3 (by stereographic projection from the pole w = 1).

        Proof. Points at the angle a from the pole have the distance cot(a/2) from the origin. So
        the first zone in which the level may occur tells the radius. If that is the zone around the
        pole, write P = A cos(b) along a great circle from the pole, with A >= |P|. Then b changes
        at a rate of at most l (Szego), so the level is at an angle of at least |b(level) -
        b(pole)|/l.
        """
        zones = np.flatnonzero((self.lower <= level) & (level <= self.upper))
        if zones.size and zones[0] > 0:
            angle = math.pi / len(self.lower) * float(zones[0])
        elif zones.size == 0:
            return 0.0
        else:
            bound, l = self.largest, max(1, self.degree)  # noqa: E741
            b, b_at_pole = (math.acos(max(-1.0, min(1.0, f / bound))) for f in (level, self.pole))
            angle = abs(b - b_at_pole) / l - 1e-9
        return 1 / math.tan(0.5 * angle) * (1 + 1e-9) if angle > 0 else math.inf
