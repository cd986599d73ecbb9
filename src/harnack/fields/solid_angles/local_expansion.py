"""Local expansions: the potential f of dipoles outside of a ball as a harmonic polynomial in the
ball. The coefficients L_jk are complex numbers of degree j and order k. They can be computed from
multipole moments M_lm of the dipoles about another point (`multipole`), and can be moved to the
centers of smaller balls. The ball has the center c and the radius rho. A complex number is a pair
(real part, imaginary part).

With the harmonics of `multipole` and coefficients L_jk about the center c of a ball of radius rho,
every f that is harmonic in the ball is

    f(c + u) = sum_{j>=0} sum_{|k|<=j} conj(R_jk(u)) L_jk,      L_j,-k = (-1)^k conj L_jk.

- `multipole_to_local`: L_jk of dipoles from their moments about a point outside of the ball.
- `local_to_local_matrices`: L_jk about the centers of the eight octants of a cell.
- `evaluate_expansion`: the polynomial, from the coefficients in a record.
- `tail_factors`: a bound of the terms of higher degree; `rounding_tables`: a bound of all rounding.

Coefficients are stored as real and imaginary parts for k >= 0 in the order of `coefficient_keys`,
times rho^j, so that u is taken in units of rho.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.solid_angles.multipole import Pairs, regular_harmonics

if TYPE_CHECKING:
    from collections.abc import Sequence

# Harmonics have degree l.
# ruff: noqa: E741


def coefficient_keys(degree: int) -> list[tuple[int, int, int]]:
    """List the keys (j, k, part) of the (degree + 1)^2 coefficients of a local expansion, in the
    order in which they are stored. A key stands for the real part (part = 0) or the imaginary part
    (part = 1) of L_jk, with j <= degree and 0 <= k <= j. L_j0 is real and has no second key."""
    return [
        (j, k, part)
        for j in range(degree + 1)
        for k in range(j + 1)
        for part in range(2 if k else 1)
    ]


def irregular_harmonics(x: Any, y: Any, z: Any, inverse: Any, degree: int) -> Pairs:
    """Compute the irregular solid harmonics I_lm at the vector (x, y, z), for l <= degree and
    0 <= m <= l.

    inverse: 1/r, with r the length of (x, y, z).

    Returns a dictionary of pairs (real part, imaginary part) by (l, m).

    With the regular solid harmonics R_lm of `multipole`, I_lm = (l+m)! (l-m)! R_lm / r^(2l+1) by
    definition, and R_lm(v / r^2) = R_lm(v) / r^(2l).
    """
    square = inverse * inverse
    harmonics: Pairs = {}
    for (l, m), (re, im) in regular_harmonics(x * square, y * square, z * square, degree).items():
        scale = float(math.factorial(l + m) * math.factorial(l - m)) * inverse
        harmonics[l, m] = scale * re, scale * im if m else 0.0
    return harmonics


def _signed(values: Pairs, l: int, m: int) -> tuple[Any, Any]:
    """Look up the entry (l, m) of harmonics or moments, for m of either sign, as a pair (real part,
    imaginary part).

    values: the entries for m >= 0. For m < 0 the entry is (-1)^m times the conjugate of the entry
        (l, -m).
    """
    re, im = values[l, abs(m)]
    if m >= 0:
        return re, im
    return (re, -im) if m % 2 == 0 else (-re, im)


def multipole_to_local(moments: Pairs, harmonics: Pairs, degree: int) -> list[Any]:
    """Compute the coefficients L_jk of the local expansion of the potential f of dipoles about a
    point c, from the dipoles' multipole moments.

    moments: the moments M_lm of the dipoles about a point y, by (l, m). Moments of degrees that are
        missing count as 0.
    harmonics: I_lm (`irregular_harmonics`) at c - y, up to the degree `degree` plus the largest
        degree of the moments.
    degree: the largest degree j.

    Returns real and imaginary parts in the order of `coefficient_keys`, without powers of a radius.

    Proof. f(x) = -sum conj(M_lm) I_lm(x - y). The addition theorem of R, applied to both arguments
    of 1/|r + u - y| = sum conj(R_lm(y)) I_lm(r + u) = sum conj(R_lm(y - u)) I_lm(r), gives
    I_lm(r + u) = sum_jk conj(R_jk(-u)) I_(l+j),(m+k)(r), as the R_lm are linearly independent, and
    R_jk(-u) = (-1)^j R_jk(u). So L_jk = -(-1)^j sum_lm conj(M_lm) I_(l+j),(m+k)(c - y).
    """
    # conj(a + ib)(u + iv) = (au + bv) + i (av - bu).
    coefficients: list[Any] = []
    degrees = sorted({l for l, _ in moments})
    for j in range(degree + 1):
        for k in range(j + 1):
            re, im = 0.0, 0.0
            for l in degrees:
                for m in range(-l, l + 1):
                    a, b = _signed(moments, l, m)
                    u, v = _signed(harmonics, l + j, m + k)
                    re = re + (a * u + b * v)
                    if k:
                        im = im + (a * v - b * u)
            sign = -1.0 if j % 2 == 0 else 1.0
            coefficients += [sign * re, sign * im] if k else [sign * re]
    return coefficients


def local_to_local_matrices(degree: int, offset: float) -> FloatArray:
    """Compute the matrices T (8, n, n) that move a local expansion from the center of a cube to the
    centers of its eight octants. If L (n,) are the coefficients about the cube's center, T[i] @ L
    are those about the center of octant i. They are in units of the radius of the octant's ball,
    which is half the radius of the cube's ball.

    degree: the degree of the expansion, with n = (degree + 1)^2 coefficients.
    offset: the offset of an octant's center along each axis, in units of the radius of the cube's
        ball.

    Octants are in the order of the cube's corners: z changes fastest, x slowest.

    Proof. For the offset s of the octant's center and the offset v of a point from there,
    R_jk(s + v) = sum R_ab(v) R_(j-a),(k-b)(s). So L'_ab = sum_jk L_jk conj(R_(j-a),(k-b)(s)). This
    is exact, as all are polynomials.
    """
    order = coefficient_keys(degree)
    index = {key: i for i, key in enumerate(order)}
    matrices = np.zeros((8, len(order), len(order)))
    for octant, corner in enumerate(itertools.product((-offset, offset), repeat=3)):
        x, y, z = corner
        shifted = regular_harmonics(x, y, z, degree)
        for (j, k, part), column in index.items():
            for sign in (1, -1) if k else (1,):  # L_j,-k = (-1)^k conj L_jk counts too
                # phase: L_j,(sign k) if this coefficient is 1 and all others are 0.
                phase = 1j if part else 1.0
                if sign < 0:
                    phase = (-1) ** k * np.conj(phase)
                for a, b in {(a, b) for a, b, _ in order if a <= j}:
                    if abs(sign * k - b) > j - a:
                        continue
                    # 0.5**a: the result is in units of half the radius.
                    re, im = _signed(shifted, j - a, sign * k - b)
                    term = phase * (re - 1j * im) * 0.5**a
                    matrices[octant, index[a, b, 0], column] += term.real
                    if b:
                        matrices[octant, index[a, b, 1], column] += term.imag
    return matrices


def evaluate_expansion(coefficients: Sequence[Any], y: Sequence[Any], degree: int) -> list[Any]:
    """Evaluate a local expansion at a point y. Returns a list of four numbers: the value, and the
    three first derivatives by the coordinates of y.

    coefficients: L_jk, in the order of `coefficient_keys`.
    y: the three coordinates of the point relative to the center, in units of the ball's radius.
    degree: the degree of the expansion.

    Formulas. With A_jk = w_k conj L_jk, w_0 = 1 and w_k = 2 otherwise, f = Re sum A_jk R_jk over k
    >= 0. R_j,-1 = -conj R_j1. So by the derivatives of R_jk (`multipole`), each derivative of f is
    Re sum B_jk R_jk. For d/dz, B_jk = A_j+1,k. Up to factors 2 where k + 1 or k - 1 is 0, B_jk is
    (A_j+1,k+1 - A_j+1,k-1)/2 for d/dx, and i (A_j+1,k+1 + A_j+1,k-1)/2 for d/dy.
    """
    r, a = (
        regular_harmonics(y[0], y[1], y[2], degree),
        dict(zip(coefficient_keys(degree), coefficients, strict=True)),
    )
    total: list[Any] = [0.0] * 4
    for j, k in sorted(r):
        re, im = r[j, k]
        real, imag = a[j, k, 0], a.get((j, k, 1), 0.0)
        weight = 2.0 if k else 1.0
        total[0] = total[0] + weight * (real * re + (imag * im if k else 0.0))
        if j == degree:
            continue
        # up, iup: real and imaginary part of L_j+1,k+1; down, idown: of L_j+1,k-1; zr, zi: of
        # L_j+1,k. From these, x, xi: of the difference up - down, for d/dx; v, vi: of the sum up +
        # down, for d/dy. For k = 0 `up` alone is used, as L_j+1,-1 follows from it.
        up, down = a[j + 1, k + 1, 0], a.get((j + 1, k - 1, 0), 0.0)
        iup, idown = a[j + 1, k + 1, 1], a.get((j + 1, k - 1, 1), 0.0)
        zr, zi = a[j + 1, k, 0], a.get((j + 1, k, 1), 0.0)
        x, xi = (up, iup) if k == 0 else (up - down, iup - idown)
        v, vi = (up, iup) if k == 0 else (up + down, iup + idown)
        total[1] = total[1] + (x * re + (xi * im if k else 0.0))
        total[2] = total[2] + (vi * re if k == 0 else vi * re - v * im)
        total[3] = total[3] + weight * (zr * re + (zi * im if k else 0.0))
    return total


class _AbsoluteValues:
    """An array of absolute values, with arithmetic in which signs do not count: differences are
    sums. So an expression in such arrays gives the sum of the absolute values of its terms."""

    def __init__(self, number: Any) -> None:
        """number: the numbers whose absolute values are kept, as an array or a single number."""
        self.number = number

    def __add__(self, other: Any) -> _AbsoluteValues:
        """Add the absolute values of both operands. This method also computes differences."""
        return _AbsoluteValues(
            self.number + np.abs(other.number if isinstance(other, _AbsoluteValues) else other)
        )

    def __mul__(self, other: Any) -> _AbsoluteValues:
        """Multiply the absolute values of both operands."""
        return _AbsoluteValues(
            self.number * np.abs(other.number if isinstance(other, _AbsoluteValues) else other)
        )

    def __neg__(self) -> _AbsoluteValues:
        """Return this object itself, because signs do not count."""
        return self

    __radd__ = __sub__ = __rsub__ = __add__
    __rmul__ = __mul__


def rounding_tables(degree: int, largest: float) -> FloatArray:
    """Compute factors (n, 4) that bound the rounding errors of `evaluate_expansion`. There is a row
    for each of the n coefficients, and a column for the value and for each of the three
    derivatives. An error is at most the backend's machine epsilon times the sum over the
    coefficients of |L_jk| times the factor.

    degree: the degree of the expansion, with n = (degree + 1)^2 coefficients.
    largest: the largest absolute value of a coordinate, in units of the ball's radius.

    Proof. Value and derivatives are sums of products of coefficients, coordinates and constants.
    Each product passes through at most N = 9 degree + 2 (degree + 1)^2 roundings: 6 per degree in
    the recurrence of R_jk, 3 per degree of the coordinates, and the roundings of the sums. So they
    are off by at most 1.01 N u times the sum of the absolute values of the products, where
    u = epsilon/2. This sum is the same expression with all signs positive, at the largest
    coordinates.
    """
    count = (degree + 1) ** 2
    coordinate = _AbsoluteValues(np.full(count, largest))
    units = [_AbsoluteValues(row) for row in np.eye(count)]
    # Entry i of each result is for an expansion whose coefficient i is 1, all others 0.
    sums = evaluate_expansion(units, (coordinate, coordinate, coordinate), degree)
    roundings = 0.51 * (9 * degree + 2 * count)
    return roundings * np.stack([absolute.number for absolute in sums], axis=1)


def tail_factors(degree: int, l: int) -> tuple[float, float]:
    """Compute the factors (b, c) of a bound of the truncation error of a local expansion.

    degree: p, the degree of the expansion.
    l: the degree of the multipole term that is expanded.

    Take a multipole term of degree l that is at most B/r^(l+1) at the distance r from the
    multipole's center. Expand it up to the degree p in a ball of radius rho, whose center is at the
    distance D from the multipole's center. With q = rho/D, the sum of the omitted terms is in the
    ball at most

        B/D^(l+1) b q^(p+1)/(1 - c q),   b = C(l+p+1, p+1), c = (l+p+2)/(p+2),

    with binomial coefficients C. The gradient of this sum is at most (p+1)/rho times the same
    formula, but with c = (l+p+2)/(p+1).

    Proof. At the ball's center, the derivative of order j along a line is at most
    (l+j)!/l! B/D^(l+1+j) (`multipole.truncation_bounds`). So the term of degree j of the expansion
    is at most C(l+j, j) q^j B/D^(l+1). From j = p+1 on, the next of these bounds is at most c q
    times the bound before: the sum is at most a geometric series. For the gradient, by Bernstein
    and Szego's inequality, a harmonic polynomial of degree j has a gradient of at most j/rho times
    its largest value on the sphere; and j C(l+j, j) grows from j to j+1 by the factor (l+j+1)/j.

    Returns b, and c for the truncation error itself (not for its gradient).
    """
    return float(math.comb(l + degree + 1, degree + 1)), (l + degree + 2) / (degree + 2)
