"""Real solid harmonics r^l Y_lm in Cartesian coordinates, up to degree 12, and their sums. They are
homogeneous harmonic polynomials of degree l; m, with -l <= m <= l, is called the order. For m >= 0,
r^l Y_lm = N_lm Q_l^m(z, r^2) C_m(x, y); for m < 0, |m| takes the place of m in Q, and S_|m| the
place of C_m. Here C_m + i S_m = (x + iy)^m; Q_l^m is r^(l-m) times the m-th derivative of the
Legendre polynomial P_l at z/r, which is a polynomial in z and r^2; and N_lm is the factor for which
the integral of Y_lm^2 over the unit sphere is 1. The weights of a sum are its coefficients c_lm.

C_m, S_m and Q_l^m are computed by recurrences that lose no accuracy (for Q_l^m the upward
recurrence of associated Legendre functions). A sum of monomials instead would lose three digits to
cancellation at degree 12. All operations are arithmetic, so the same code serves Dr.Jit arrays,
NumPy arrays and Python floats.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

LARGEST_DEGREE = 12

Weights: TypeAlias = Mapping[tuple[int, int], float]  #: (l, m) -> coefficient of r^l Y_lm
Monomials: TypeAlias = Mapping[tuple[int, int, int], float]  #: (i, j, k) -> that of x^i y^j z^k


def degree_and_order(key: Any) -> tuple[int, int]:
    """The degree l and the order m of a harmonic as two ints, from a pair of integers.

    key: the pair (l, m), any value that a user gave.

    Raises:
        TypeError: key is not a pair of integers.
    """
    try:
        l, m = key  # noqa: E741
        if isinstance(key, str) or isinstance(l, bool) or isinstance(m, bool):
            raise TypeError
        return operator.index(l), operator.index(m)
    except (TypeError, ValueError):
        raise TypeError(
            f"a harmonic is named by two whole numbers, degree and order (l, m), not {key!r}"
        ) from None


def normalization(l: int, m: int) -> float:  # noqa: E741
    """The factor N_lm of the solid harmonic r^l Y_lm, for which the integral of Y_lm^2 over the
    unit sphere is 1."""
    order = abs(m)
    ratio = math.factorial(l - order) / math.factorial(l + order)
    return math.sqrt((2 * l + 1) / (4 * math.pi) * ratio * (2 if order else 1))


def odd_factorial(m: int) -> float:
    """The product of the odd numbers (2m-1)!! = 1 * 3 * ... * (2m-1), which is the value of the
    polynomial Q_m^m."""
    return float(math.prod(range(1, 2 * m, 2)))


def legendre_weight(l: int, m: int) -> float:  # noqa: E741
    """The factor N_lm (2m-1)!! that a solid harmonic has beside the polynomial Q_l^m/(2m-1)!!, for
    m >= 0."""
    return normalization(l, m) * odd_factorial(m)


class Legendre:
    """The polynomials Q_l^m / (2m-1)!! at given z and r^2, computed when they are asked for, each
    once. Q_l^m is r^(l-m) times the m-th derivative of the Legendre polynomial P_l at z/r, and
    (2m-1)!! is the product of the odd numbers up to 2m-1.

    Without the division by (2m-1)!!, which is Q_m^m, values would leave the range of float32. The
    factors `legendre_weight` of a sum contain it.

    z, r2: z and r^2, numbers or arrays.
    """

    def __init__(self, z: Any, r2: Any) -> None:
        self.z = z
        self.r2 = r2
        self._known: dict[tuple[int, int], Any] = {}

    def __call__(self, l: int, m: int) -> Any:  # noqa: E741
        """The polynomial Q_l^m / (2m-1)!! at the given z and r^2, for m >= 0; 0.0 for l < m.

        It follows from those of the degrees l-1 and l-2: (l-m) Q_l = (2l-1) z Q_(l-1) - (l+m-1) r^2
        Q_(l-2).
        """
        if l <= m:
            # Q_m^m is (2m-1)!!.
            return 1.0 if l == m else 0.0
        if (l, m) not in self._known:
            previous, before_previous = self(l - 1, m), self(l - 2, m)
            q = (2 * l - 1) / (l - m) * (self.z * previous)
            if l > m + 1:
                q = q - (l + m - 1) / (l - m) * (self.r2 * before_previous)
            self._known[l, m] = q
        return self._known[l, m]


def evaluate(weights: Weights, x: Any, y: Any, z: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """The value and the gradient of the sum of c_lm r^l Y_lm at points.

    weights: the coefficients (l, m) -> c_lm.
    x, y, z: the coordinates, numbers or arrays.

    Returns the value and the three components of the gradient.

    With Q = Q_l^m, C_m and S_m as in the module, r^l Y_lm / N_lm is Q C_m for the order m >= 0 and
    Q S_m for the order -m. The derivative of Q by z at fixed r^2 is Q_l^(m+1), and by r^2 it is
    -Q_(l-1)^(m+1)/2. So Q C_m has the derivatives

        d/dx = -x Q_(l-1)^(m+1) C_m + m Q C_(m-1),   d/dz = (l+m) Q_(l-1)^m C_m,
        d/dy = -y Q_(l-1)^(m+1) C_m - m Q S_(m-1),

    and Q S_m the derivatives

        d/dx = -x Q_(l-1)^(m+1) S_m + m Q S_(m-1),   d/dz = (l+m) Q_(l-1)^m S_m,
        d/dy = -y Q_(l-1)^(m+1) S_m + m Q C_(m-1).
    """
    legendre = Legendre(z, x * x + y * y + z * z)
    zero = 0.0 * z
    value, slope_x, slope_y, slope_z = zero, zero, zero, zero
    c, s, c_lower, s_lower = zero + 1.0, zero, zero, zero
    for m in range(max(abs(m) for _, m in weights) + 1):
        if m > 0:
            # C_m and S_m by a complex product with x + iy; `_lower` are those of m - 1.
            c_lower, s_lower, c, s = c, s, x * c - y * s, x * s + y * c
        # The orders m and -m. dx and dy are the derivatives of C_m or S_m, divided by m.
        for order, basis, dx, dy in ((m, c, c_lower, -s_lower), (-m, s, s_lower, c_lower)):
            # The order 0 has no sine. (Its second turn would count the cosine's weights again.)
            if m == 0 and basis is s:
                continue
            degree_weights = [
                (key[0], weight) for key, weight in weights.items() if key[1] == order
            ]
            if not degree_weights:
                continue
            # The sums over the degrees l of c_lm N_lm times Q_l^m, Q_(l-1)^(m+1) and (l+m)
            # Q_(l-1)^m.
            at_m, at_next, z_derivative = _slope_sums(sorted(degree_weights), m, legendre)
            value = value + at_m * basis
            slope_z = slope_z + z_derivative * basis
            slope_x = slope_x - (x * at_next) * basis
            slope_y = slope_y - (y * at_next) * basis
            if m > 0:
                slope_x, slope_y = slope_x + (m * at_m) * dx, slope_y + (m * at_m) * dy
    return value, (slope_x, slope_y, slope_z)


def hessian(weights: Weights, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """The second derivatives xx, yy, zz, xy, xz, yz of the sum of c_lm r^l Y_lm at points.

    weights: the coefficients (l, m) -> c_lm.
    x, y, z: the coordinates, numbers or arrays.

    The rules of `evaluate` are applied twice to Q B, where B is C_m or S_m. With Q' =
    Q_(l-1)^(m+1), Q" = Q_(l-2)^(m+2) and the derivatives B_x, B_xx, ... of B, for which B_yy =
    -B_xx,

        xx = (x^2 Q" - Q') B - 2 x Q' B_x + Q B_xx,   xy = xy Q" B - Q' (x B_y + y B_x) + Q B_xy,
        yy = (y^2 Q" - Q') B - 2 y Q' B_y - Q B_xx,   zz = (l+m) (l+m-1) Q_(l-2)^m B,
        xz = (l+m) (Q_(l-1)^m B_x - x Q_(l-2)^(m+1) B),
        yz = (l+m) (Q_(l-1)^m B_y - y Q_(l-2)^(m+1) B).
    """
    legendre = Legendre(z, x * x + y * y + z * z)
    zero = 0.0 * z
    sums = [zero] * 6
    powers = [(zero, zero), (zero, zero), (zero + 1.0, zero)]  # C and S of m-2, m-1, m
    for m in range(max(abs(m) for _, m in weights) + 1):
        if m > 0:
            c, s = powers[2]
            powers = [*powers[1:], (x * c - y * s, x * s + y * c)]
        # C and S of the orders m - 2, m - 1 and m.
        (c2, s2), (c1, s1), (c, s) = powers
        falling_product = m * (m - 1)
        # For the orders m and -m: B, B_x, B_y, B_xx and B_xy.
        bases = (
            (m, (c, m * c1, -m * s1, falling_product * c2, -falling_product * s2)),
            (-m, (s, m * s1, m * c1, falling_product * s2, falling_product * c2)),
        )
        # The order 0 has no sine.
        for order, basis in bases[: 2 if m else 1]:
            degree_weights = [
                (key[0], weight) for key, weight in weights.items() if key[1] == order
            ]
            if degree_weights:
                terms = _hessian_of_sums(
                    _hessian_sums(sorted(degree_weights), m, legendre), basis, x, y
                )
                sums = [entry + term for entry, term in zip(sums, terms, strict=True)]
    return sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]


def unit_hessian(l: int, m: int, rho: Any, z: Any, azimuth: float, removed_power: int) -> Any:  # noqa: E741
    """The Hessians (n, 3, 3) of the solid harmonic r^l Y_lm, divided by rho^removed_power, at n
    points of the unit sphere with the same azimuth.

    l, m: degree and order, m >= 0; either removed_power is 0, or m >= 2 + removed_power.
    rho, z: (n,) the distances of the points from the z axis, and their z.
    azimuth: the azimuth of the points, in radians.
    removed_power: how many factors rho are left out. For m >= 2 every entry of the Hessian contains
        rho^(m-2). So the factors are left out of the formula, and the result is finite at rho = 0.
    """

    def power(n: int) -> Any:
        """The power rho^(n - removed_power) of the distances `rho`, where `removed_power` is how
        many factors rho the caller leaves out. For n < removed_power it is 1; the factor by which
        it is multiplied below is 0 then."""
        return rho ** max(n - removed_power, 0)

    x, y = rho * math.cos(azimuth), rho * math.sin(azimuth)
    # C_m = rho^m cos(m azimuth) and its derivatives by x, y, xx and xy.
    basis = (
        power(m) * math.cos(m * azimuth),
        m * power(m - 1) * math.cos((m - 1) * azimuth),
        -m * power(m - 1) * math.sin((m - 1) * azimuth),
        m * (m - 1) * power(m - 2) * math.cos((m - 2) * azimuth),
        -m * (m - 1) * power(m - 2) * math.sin((m - 2) * azimuth),
    )
    # A single term with the weight 1; on the unit sphere r^2 is 1.
    sums = _hessian_sums([(l, 1.0)], m, Legendre(z, 1.0))
    # The added 0 makes arrays of constants.
    xx, yy, zz, xy, xz, yz = (entry + 0.0 * z for entry in _hessian_of_sums(sums, basis, x, y))
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)


def _hessian_of_sums(sums: Sequence[Any], basis: Sequence[Any], x: Any, y: Any) -> tuple[Any, ...]:
    """The second derivatives xx, yy, zz, xy, xz, yz of the sum over l of c_l N_lm Q_l^m B, where B
    is C_m or S_m, by the formulas of `hessian`.

    sums: the six sums over l that `_hessian_sums` returns.
    basis: B, B_x, B_y, B_xx, B_xy, where indices are derivatives.
    """
    at_m, at_next, at_second, rate, rate_next, rate_twice = sums
    b, bx, by, bxx, bxy = basis
    # By the formulas for xx, yy, zz, xy, xz and yz.
    return (
        (x * x * at_second - at_next) * b - 2 * x * at_next * bx + at_m * bxx,
        (y * y * at_second - at_next) * b - 2 * y * at_next * by - at_m * bxx,
        rate_twice * b,
        x * y * at_second * b - at_next * (x * by + y * bx) + at_m * bxy,
        rate * bx - x * rate_next * b,
        rate * by - y * rate_next * b,
    )


def _hessian_sums(
    degree_weights: Sequence[tuple[int, float]], m: int, q: Legendre
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """For one order m, the six sums over the degrees l that second derivatives of a sum of solid
    harmonics need.

    With c_l the weight of the degree l, these are the sums of c_l N_lm times Q_l^m, Q_(l-1)^(m+1),
    Q_(l-2)^(m+2), (l+m) Q_(l-1)^m, (l+m) Q_(l-2)^(m+1) and (l+m) (l+m-1) Q_(l-2)^m.

    degree_weights: (l, c_l) for all degrees l of the order.
    m: the absolute value of the order.
    q: the polynomials Q_l^m/(2m-1)!! at the points.
    """
    at_m, at_next, rate = _slope_sums(degree_weights, m, q)
    at_second, rate_next, rate_twice = 0.0, 0.0, 0.0
    for l, weight in degree_weights:  # noqa: E741
        # The factors 2m + 1 and 2m + 3 turn (2m-1)!! into the double factorials of the orders m + 1
        # and m + 2. Polynomials that are 0 are left out.
        factor = weight * legendre_weight(l, m)
        if l > m + 1:
            rate_twice = rate_twice + (factor * (l + m) * (l + m - 1)) * q(l - 2, m)
        if l > m + 2:
            rate_next = rate_next + (factor * (l + m) * (2 * m + 1)) * q(l - 2, m + 1)
        if l > m + 3:
            at_second = at_second + (factor * (2 * m + 1) * (2 * m + 3)) * q(l - 2, m + 2)
    return at_m, at_next, at_second, rate, rate_next, rate_twice


def _slope_sums(
    degree_weights: Sequence[tuple[int, float]], m: int, q: Legendre
) -> tuple[Any, Any, Any]:
    """For one order m, the three sums over the degrees l that values and gradients of a sum of
    solid harmonics need.

    With c_l the weight of the degree l, these are the sums of c_l N_lm times Q_l^m, Q_(l-1)^(m+1)
    and (l+m) Q_(l-1)^m.

    degree_weights: (l, c_l) for all degrees l of the order.
    m: the absolute value of the order.
    q: the polynomials Q_l^m/(2m-1)!! at the points.
    """
    at_m, at_next, rate = 0.0, 0.0, 0.0
    for l, weight in degree_weights:  # noqa: E741
        # The factor 2m + 1 below turns (2m-1)!! into the double factorial of the order m + 1.
        # Polynomials that are 0 are left out.
        factor = weight * legendre_weight(l, m)
        at_m = at_m + factor * q(l, m)
        if l > m:
            rate = rate + (factor * (l + m)) * q(l - 1, m)
        if l > m + 1:
            at_next = at_next + (factor * (2 * m + 1)) * q(l - 1, m + 1)
    return at_m, at_next, rate


def laplacian(coefficients: Monomials) -> tuple[dict[tuple[int, int, int], float], float]:
    """The Laplacian of a polynomial, and a measure of how large it is.

    coefficients: a mapping (i, j, k) -> coefficient of x^i y^j z^k.

    Returns the coefficients of the Laplacian, without those that are rounding errors; and the
    measure, from 0 to 1. Each coefficient of the Laplacian is a sum; the measure is the largest
    ratio of the absolute value of a sum to the sum of the absolute values.
    """
    total: dict[tuple[int, int, int], float] = {}
    abs_sum: dict[tuple[int, int, int], float] = {}
    for powers, coefficient in coefficients.items():
        for axis in range(3):
            n = powers[axis]
            if n >= 2:
                lowered_powers = (
                    powers[0] - 2 * (axis == 0),
                    powers[1] - 2 * (axis == 1),
                    powers[2] - 2 * (axis == 2),
                )
                term = n * (n - 1) * coefficient
                total[lowered_powers] = total.get(lowered_powers, 0.0) + term
                abs_sum[lowered_powers] = abs_sum.get(lowered_powers, 0.0) + abs(term)
    largest_ratio = max((abs(total[k]) / abs_sum[k] for k in total if abs_sum[k] > 0), default=0.0)
    return {k: v for k, v in total.items() if abs(v) > 1e-12 * abs_sum[k]}, largest_ratio


def from_monomials(coefficients: Monomials) -> dict[tuple[int, int], float]:
    """The weights (l, m) -> c_lm of a harmonic polynomial as a sum of solid harmonics, from the
    coefficients of its monomials.

    coefficients: a mapping (i, j, k) -> coefficient of x^i y^j z^k; their degree is at most 12, and
        the polynomial must be harmonic.

    A harmonic function is determined by its values and its z-derivatives on the plane z = 0. For
    the part of degree l, these are Fourier series on the circle r = 1 of that plane, with
    coefficients c_lm N_lm Q_l^m(0, 1) for even l - m (the values) and c_lm N_lm (l+m) Q_(l-1)^m(0,
    1) for odd l - m (the z-derivatives). Their degree is at most 12, so 64 samples determine them
    exactly.
    """
    sample_count = 64
    angles = 2 * np.pi * np.arange(sample_count) / sample_count
    x, y = np.cos(angles), np.sin(angles)
    # On the circle z is 0 and r^2 is 1.
    legendre = Legendre(0.0, 1.0)
    weights: dict[tuple[int, int], float] = {}
    for l in range(max(sum(powers) for powers in coefficients) + 1):  # noqa: E741
        # The part f_l of degree l and its z-derivative, on the circle.
        circle_values = [np.zeros(sample_count), np.zeros(sample_count)]
        largest_coefficient = 0.0
        for (i, j, k), coefficient in coefficients.items():
            if i + j + k == l:
                largest_coefficient = max(largest_coefficient, abs(coefficient))
                if k < 2:
                    circle_values[k] += coefficient * x**i * y**j
        spectra = [np.fft.rfft(part) / sample_count for part in circle_values]
        for m in range(l + 1):
            parity = (l - m) % 2
            factor = legendre_weight(l, m)
            factor *= (l + m) * legendre(l - 1, m) if parity else legendre(l, m)
            # Its real part belongs to cos(m t), its negated imaginary part to sin(m t). For m > 0
            # the spectrum has half of each.
            fourier_coefficient = complex(spectra[parity][m]) * (2 if m else 1) / factor
            for order, weight in ((m, fourier_coefficient.real), (-m, -fourier_coefficient.imag)):
                # Smaller weights are rounding errors.
                if abs(weight) > 1e-13 * largest_coefficient:
                    weights[l, order] = weight
    return weights
