"""Poisson integrals along an axis: harmonic functions with known values, for tests of proofs. A
positive harmonic function on the unit ball of R^n is the Poisson integral of a positive measure
(mass) on the sphere: the integral of the Poisson kernel P over the mass. Its values on an axis
depend only on the latitudes s of the mass: the cosines of the angles to the axis, s = 1 in front
and s = -1 behind. A ring is mass at one latitude; a cap of height b is the part of the sphere with
s >= 1 - b. All results are functions of the position q on the axis, -1 < q < 1, minus their value
at the center q = 0 (movements).

The formulas have no cancellation at small q, and none of them is used in `harnack.enclosures`. They
are computed by NumPy in double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray

# Below this |q| the movement of a cap is a power series, whose terms fall like q^l.
_SERIES_BELOW = 0.25
_TERMS = 30


def kernel_difference(q: npt.ArrayLike, s: npt.ArrayLike, dimension: int) -> FloatArray:
    """P - 1 for 0 <= q < 1 and -1 <= s <= 1, where P = (1-q^2)/(1+q^2-2qs)^(n/2) is the Poisson
    kernel of the unit ball of dimension n = `dimension`.

    q: the position on the axis.
    s: the latitude of the mass.
    """
    q, s = np.asarray(q, np.float64), np.asarray(s, np.float64)
    squared_distance = (1 - q) ** 2 + 2 * q * (1 - s)  # accurate where q and s are near 1
    log = np.where(q < 0.5, np.log1p(np.maximum(q * (q - 2 * s), -0.99)), np.log(squared_distance))
    return np.expm1(np.log1p(-q * q) - 0.5 * dimension * log)


def cap_mass(height: npt.ArrayLike, dimension: int) -> FloatArray:
    """The fraction of the unit sphere of R^n, n = `dimension`, that lies in the cap s >= 1 -
    height, for 0 <= height <= 2. s is the cosine of the angle to the axis."""
    b = np.asarray(height, np.float64)
    if dimension == 3:
        return 0.5 * b
    angle = _cap_angle(b)
    if dimension == 2:
        return angle / math.pi
    return (angle - np.sin(angle) * np.cos(angle)) / math.pi


def cap_slope(height: npt.ArrayLike, dimension: int) -> FloatArray:
    """The derivative at q = 0, by the position q on the axis, of the Poisson integral of the
    indicator of the cap s >= 1 - height of the unit sphere of R^n, n = `dimension`
    (`cap_movement`)."""
    b = np.asarray(height, np.float64)
    if dimension == 3:
        return 0.75 * b * (2 - b)
    sine = np.sin(_cap_angle(b))
    return 2 / math.pi * sine if dimension == 2 else 8 / (3 * math.pi) * sine**3


def cap_movement(q: npt.ArrayLike, height: npt.ArrayLike, dimension: int) -> FloatArray:
    """The Poisson integral of the indicator of the cap s >= 1 - height of the unit sphere of R^n, n
    = `dimension`, at the position q on the axis, -1 < q < 1, minus its value at the center
    (`cap_mass`).

    For the opposite cap, s <= -(1 - height), evaluate at -q.
    """
    q, b = np.broadcast_arrays(np.asarray(q, np.float64), np.asarray(height, np.float64))
    is_small = np.abs(q) < _SERIES_BELOW
    # Both formulas are computed at all positions, and one is selected. Where a formula is not
    # valid, it is computed at a position where it is (0 or 0.5), and its result is not used.
    series = _cap_series(np.where(is_small, q, 0.0), b, dimension)
    closed_form = _cap_closed_form(np.where(is_small, 0.5, q), b, dimension) - cap_mass(
        b, dimension
    )
    return np.where(is_small, series, closed_form)


def _cap_angle(height: FloatArray) -> FloatArray:
    """The angle between the axis and the border of a cap, as seen from the center of the sphere."""
    return 2 * np.arcsin(np.sqrt(np.clip(0.5 * height, 0, 1)))


def _cap_series(q: FloatArray, b: FloatArray, dimension: int) -> FloatArray:
    """The Poisson integral of the indicator of the cap of height b, at the position q on the axis,
    minus its value at q = 0, in R^n with n = `dimension`. It is computed as the sum of c_l q^l over
    l >= 1, for small q.

    The series is the expansion of the Poisson kernel in Gegenbauer polynomials, integrated over the
    cap, which reaches from the latitude s = 1 - b to 1. For n = 3 these are the Legendre
    polynomials P_l: the integral of P_l over [s, 1] is (1-s^2) P_l'(s)/(l(l+1)), and P_{l+1}' =
    P_{l-1}' + (2l+1) P_l.
    """
    total, power = np.zeros_like(q), np.ones_like(q)
    angle, s = _cap_angle(b), 1 - b
    # For n = 3: P_(l-1) and P_l at s, then their derivatives.
    p0, p1 = np.ones_like(s), s
    d0, d1 = np.zeros_like(s), np.ones_like(s)
    for degree in range(1, _TERMS + 1):
        # c is the coefficient of q^degree.
        power = power * q
        k = 2 * degree + 1
        if dimension == 2:
            c = 2 / math.pi * np.sin(degree * angle) / degree
        elif dimension == 3:
            c = 0.5 * k / (degree * (degree + 1)) * b * (2 - b) * d1
            d0, d1 = d1, d0 + k * p1
            p0, p1 = p1, (k * s * p1 - degree * p0) / (degree + 1)
        else:
            ends = np.sin(degree * angle) / degree - np.sin((degree + 2) * angle) / (degree + 2)
            c = (degree + 1) / math.pi * ends
        total = total + c * power
    return total


def _cap_closed_form(q: FloatArray, b: FloatArray, dimension: int) -> FloatArray:
    """The Poisson integral of the indicator of a cap of height b, at the position q on the axis, in
    R^n with n = `dimension`, by a formula in closed form. If its value at q = 0 is subtracted from
    the result, digits are lost at small q."""
    if dimension == 3:  # the integral of (1-q^2)/2 (1+q^2-2qs)^(-3/2) over [1-b, 1]
        s = np.sqrt((1 - q) ** 2 + 2 * q * b)
        return b * (1 + q) / (s * (s + 1 - q))
    angle = _cap_angle(b)
    if dimension == 2:
        return 2 / math.pi * np.arctan2((1 + q) * np.sin(angle / 2), (1 - q) * np.cos(angle / 2))
    # n = 4: the sums over j of q^j sin(j angle) and of q^j sin(j angle)/j.
    real_part, imaginary_part = q * np.cos(angle), q * np.sin(angle)
    sine_sum = imaginary_part / ((1 - real_part) ** 2 + imaginary_part**2)
    sine_sum_over_j = np.arctan2(imaginary_part, 1 - real_part)
    return (angle + sine_sum + sine_sum_over_j - (sine_sum - sine_sum_over_j) / (q * q)) / math.pi


@dataclass(frozen=True)
class AxialFunctions:
    """Harmonic functions u on balls of R^n, on an axis through the center; one function per row.
    Each u is the Poisson integral of a few rings of mass on the sphere, or has boundary values that
    are a sum of indicators of caps.

    measure: "points" if u is the Poisson integral of rings of mass; "caps" if the boundary values
        of u are a sum of indicators of caps.
    latitudes_or_heights: (rows, k) the latitudes of the rings, or the heights of the caps.
    weights: (rows, k) of the rings (>= 0) or of the caps.
    radius: (rows,) of the balls.
    dimension: n.
    """

    measure: str
    latitudes_or_heights: FloatArray
    weights: FloatArray
    radius: FloatArray
    dimension: int

    @property
    def slope(self) -> FloatArray:
        """The derivatives (rows,) of the functions along the axis, at the center."""
        if self.measure == "points":
            slopes = self.dimension * self.latitudes_or_heights
        else:
            slopes = cap_slope(self.latitudes_or_heights, self.dimension)
        return (self.weights * slopes).sum(axis=1) / self.radius

    def movement(self, t: FloatArray) -> FloatArray:
        """u(t) - u(0), an array (rows, m), at distances t (rows, m) along the axis, 0 <= t <
        radius."""
        q = t / self.radius[:, None]
        total = np.zeros_like(q)
        for j in range(self.latitudes_or_heights.shape[1]):
            position, weight = self.latitudes_or_heights[:, j, None], self.weights[:, j, None]
            # "points": rings of mass. Otherwise caps.
            function = kernel_difference if self.measure == "points" else cap_movement
            total += weight * function(q, position, self.dimension)
        return total


@dataclass(frozen=True)
class GreenPotentials:
    """Potentials of balls of constant density inside of the unit ball of R^3, evaluated on an axis
    through the centers of all balls; several balls per row. `centers` are their positions on the
    axis, `sizes` their radii. The potentials vanish on the unit sphere.

    centers, sizes: (rows, k) the positions of the balls on the axis, and their radii; |center| +
        size <= 1.

    For a ball of density s, the potential w has the Laplacian -s in the ball, and 0 outside of it.
    It is Newton's potential of the ball minus that of its image. The image is outside of the unit
    ball, where the ball's potential is that of a point mass at its center.
    """

    centers: FloatArray
    sizes: FloatArray

    def at_center(self, density: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The sums of the potentials (rows,) at the center of the unit ball, and their derivatives
        (rows,) along the axis there.

        density: (rows, k) the densities of the balls.
        """
        y, size = self.centers, self.sizes
        distance = np.abs(y)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Newton's potential of a ball at the center, and its slope there: outside of the ball
            # that of a point mass, else that of the interior.
            outside = distance > size
            value = np.where(outside, size**3 / (3 * distance), 0.5 * size**2 - y * y / 6)
            slope = np.where(outside, size**3 * y / (3 * distance**3), y / 3)
        # Subtract the potential of the ball's image in the unit sphere, so that it is 0 there.
        value, slope = value - size**3 / 3, slope - size**3 * y / 3
        return (density * value).sum(axis=1), (density * slope).sum(axis=1)

    def movement(self, q: FloatArray, density: FloatArray) -> FloatArray:
        """w(q) - w(0), an array (rows, m), at the positions q (rows, m) on the axis, 0 <= q < 1,
        where w is the sum of the potentials.

        density: (rows, k) the densities of the balls.
        """
        total = np.zeros_like(q)
        for j in range(self.centers.shape[1]):
            y, size = self.centers[:, j, None], self.sizes[:, j, None]
            # The movement of the ball's Newtonian potential minus that of its image.
            total += density[:, j, None] * (_newton(q, y, size) - size**3 / 3 * q * y / (1 - q * y))
        return total


def _newton(q: FloatArray, y: FloatArray, size: FloatArray) -> FloatArray:
    """Newton's potential of a ball of density 1, at the position q on the axis, minus its value at
    the position 0.

    y, size: the position of the ball's center on the axis, and its radius.
    """
    # The distances of the positions 0 and q from the ball's center; the potentials at q and at 0.
    distance0, distance = np.abs(y), np.abs(q - y)
    values: list[FloatArray] = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for d in (distance, distance0):
            # Outside of the ball it is the potential of a point mass.
            values.append(np.where(d > size, size**3 / (3 * d), 0.5 * size**2 - d * d / 6))
        difference = q * (2 * y - q) / 6  # free of cancellation where both are inside
        return np.where((distance0 <= size) & (distance <= size), difference, values[0] - values[1])
