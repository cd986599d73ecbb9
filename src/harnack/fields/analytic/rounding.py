"""Bounds of the rounding of sums of solid harmonics, and of sums of waves.

Everything here is to first order in u, the unit roundoff (eps/2 of the precision in use): each
operation is exact up to a factor 1 + d, |d| <= u, so errors of factors add up. Terms of second
order are below 1e-4 of that in single precision and covered by `_SECOND_ORDER`.

- `HarmonicRounding`: the rounding of `solid_harmonics.evaluate`.
- `WaveRounding`: the rounding of `waves.evaluate_terms`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import fmin
from harnack.fields.analytic.solid_harmonics import Legendre, Weights, legendre_weight
from harnack.fields.analytic.sphere_bounds import (
    AxialBound,
    amplitudes,
    largest_gradient,
    largest_hessian,
    polar_samples,
)
from harnack.fields.analytic.waves import PlaneWave, Term, WaveFactor

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

# Sums of products of sizes of polynomials in cos(a), of degree 24 at most, are sampled at
# `_SAMPLES` angles a; between samples each factor changes by at most 24 pi/2/_SAMPLES of its
# largest size (Bernstein), which `_SECOND_ORDER` covers, together with terms of second order in u.
_SAMPLES = 4000
_SECOND_ORDER = 1.03


@dataclass(frozen=True)
class HarmonicRounding:
    """Rounding of value and gradient of a sum of solid harmonics, in units of u, at a point of the
    unit ball with the distances rho from the z axis and r from the origin.

    value_bounds, gradient_bounds: two bounds each, the smaller of which is used: a bound that is
        sharp near the axis, in powers of rho and r, and a bound in powers of r only (the largest
        c rho^m on the sphere, and not the largest c).
    underflow: the error of the value by underflow, in smallest normal numbers.

    With z = r c:

    - r^2 = x^2 + y^2 + z^2 is off by 3u of itself.
    - q_l = A z q_(l-1) - B r^2 q_(l-2), A and B the rounded coefficients of the recurrence: a step
      adds an error of up to g_l = 4u |A z q_(l-1)| + 7u |B r^2 q_(l-2)|, and propagates the errors
      of earlier steps by the same recurrence, so the error of q_l is at most the sum over k of
      |G_lk| g_k, where G_lk is the recurrence that begins with G_kk = 1 and 0 before. In units of
      u r^(l-m) it is a function of c only, whose largest value is computed by sampling
      (`_recurrence`).
    - (x + iy)^m: a product of complex numbers is off by at most 2 sqrt(2) u of its size (each
      component by 2u (|x c| + |y s|) or 2u (|x s| + |y c|), and 4 |x c y s| <= rho^2 |w|^2), and
      the first factor is exact: 2 sqrt(2) (m-1) u rho^m.
    - A term of the sum: 3u for its weight and two products; then u for each further term of its
      order and for each further order.
    - A point divided by the size of the domain: 3u of each coordinate, that is 3u (rho |f_rho| +
      |z f_z|).

    Numbers that underflow are lost altogether: the error is the smallest normal number for each
    operation, times the factor by which the recurrence may enlarge it.
    """

    value_bounds: tuple[AxialBound, AxialBound]
    gradient_bounds: tuple[AxialBound, AxialBound]
    underflow: float

    @classmethod
    def of(cls, weights: Weights, *, is_divided: bool) -> HarmonicRounding:
        """The rounding of a sum with these weights; is_divided: whether points are divided by a
        size other than 1 first."""
        tables: list[dict[tuple[int, int], float]] = [{}, {}, {}, {}]
        orders = len({m for _, m in weights})
        underflow = 1.0
        for (l, m), amplitude in amplitudes(weights).items():  # noqa: E741
            # The amplitude stands for two columns: cos(m b) and sin(m b), at right angles.
            terms = max(sum(order == k for _, order in weights) for k in (m, -m))
            sums = (terms - 1) + (orders - 1)
            size = amplitude * legendre_weight(l, m)
            near, anywhere = _of_value(l, m, sums, is_divided)
            steep_near, steep_anywhere = _of_gradient(l, m, sums, is_divided) if l else (0.0, 0.0)
            power = max(m - 1, 0)
            for table, i, degree, constant in (
                (tables[0], m, l, near),
                (tables[1], 0, l, anywhere),
                (tables[2], power, l - 1, steep_near),
                (tables[3], 0, l - 1, steep_anywhere),
            ):
                if degree >= i:
                    table[i, degree - i] = table.get((i, degree - i), 0.0) + size * constant
            underflow += 2.0 + size * _underflow(l, m)
        a, b, c, d = (AxialBound.of(table) for table in tables)
        return cls((a, b), (c, d), underflow)

    def value(self, rho: Real, r: Real) -> Real:
        """The bound for the value, in units of u."""
        near, anywhere = self.value_bounds
        return fmin(near(rho, r), anywhere(rho, r))

    def gradient(self, rho: Real, r: Real) -> Real:
        """The bound for the gradient, as a length, in units of u."""
        near, anywhere = self.gradient_bounds
        return fmin(near(rho, r), anywhere(rho, r))


@functools.cache
def _recurrence(l: int, m: int) -> tuple[FloatArray, FloatArray, float]:  # noqa: E741
    """|Q| and its error in units of u, on the grid of c; and the sum over k of the largest |G_lk|
    times coefficients."""
    c, _ = polar_samples(_SAMPLES)
    q = Legendre(c, 1.0)
    zeros, ones = 0.0 * c, 0.0 * c + 1.0
    if l < m:
        return zeros, zeros, 0.0
    error, factors = zeros.copy(), 0.0
    for k in range(m + 1, l + 1):
        a, b = (2 * k - 1) / (k - m), (k + m - 1) / (k - m)
        committed = 4 * np.abs(a * c * q(k - 1, m))
        if k > m + 1:
            committed = committed + 7 * np.abs(b * q(k - 2, m))
        previous, current = zeros, ones
        for j in range(k + 1, l + 1):
            step = (2 * j - 1) / (j - m) * c * current - (j + m - 1) / (j - m) * previous
            previous, current = current, step
        error = error + np.abs(current) * committed
        factors += float(np.abs(current).max()) * (a + b + 2.0)
    return np.abs(q(l, m) + zeros), error, factors


def _product(m: int) -> float:
    """The error of (x + iy)^m in units of u of its size."""
    return 2 * math.sqrt(2) * max(m - 1, 0)


def _of_value(l: int, m: int, sums: int, is_divided: bool) -> tuple[float, float]:  # noqa: E741
    """The two bounds for the value of a term, in units of u rho^m r^(l-m), and of u r^l."""
    q, error, _ = _recurrence(l, m)
    c, s = polar_samples(_SAMPLES)
    total = error + (3 + sums + _product(m)) * q
    if is_divided:
        at_next, below = _recurrence(l - 1, m + 1)[0], _recurrence(l - 1, m)[0]
        total = total + 3 * (m * q + (2 * m + 1) * s * s * at_next + np.abs(c) * (l + m) * below)
    return _largest(total), _largest(total * s**m)


def _of_gradient(l: int, m: int, sums: int, is_divided: bool) -> tuple[float, float]:  # noqa: E741
    """The two bounds for the gradient of a term, in units of u rho^(m-1) r^(l-m) (m = 0: u
    r^(l-1)), and of u r^(l-1).

    In the order in which `evaluate` computes it: 4u for weights, coefficients and products in each
    component, 2u for the two terms of gx and gy, then the sums. If the point is divided by a size,
    3u (rho |H| + |z grad f_z|), f_z = (l+m) Q_(l-1)^m B being of degree l-1 and order m; and 3u for
    the division of the gradient by the size.
    """
    _, s = polar_samples(_SAMPLES)
    operations = 4 + 2 + 2 * sums + _product(m) + (3 if is_divided else 0)
    q, q_error, _ = _recurrence(l, m)
    at_next, next_error, _ = _recurrence(l - 1, m + 1)
    below, below_error, _ = _recurrence(l - 1, m)
    power = s if m > 0 else 0.0 * s + 1.0
    radial = s * power * (2 * m + 1) * (next_error + operations * at_next)
    azimuthal = m * (q_error + operations * q)
    axial = power * (l + m) * (below_error + operations * below)
    total = np.hypot(radial + azimuthal, axial)
    near, anywhere = _largest(total), _largest(total * s ** max(m - 1, 0))
    if is_divided:
        # On the sphere |H| <= l (l-1) M and |grad f_z| <= (l-1) l M: see `BallRange.curvature`.
        division = 3 * largest_hessian(l, m) / legendre_weight(l, m)
        if l > m:
            division += 3 * (l + m) * largest_gradient(l - 1, m) / legendre_weight(l - 1, m)
        near += division
        anywhere += min(division, 6 * l * (l - 1) * _largest(q * s**m))
    return near, anywhere


def _largest(sampled: FloatArray) -> float:
    """The largest sample, with the margin `_SECOND_ORDER`."""
    return float(sampled.max()) * _SECOND_ORDER


def _underflow(l: int, m: int) -> float:  # noqa: E741
    """A bound of the error of a term by underflow, in smallest normal numbers."""
    q, _, factors = _recurrence(l, m)
    return factors + (2 * m + 2) * float(q.max()) + 2


# The rounding of a sine or cosine in units of u (`backend.elementary.sincos`).
_SINE = 2.0

Share: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True)
class WaveRounding:
    """Rounding of a sum of waves at a point p, in units of u.

    move: (x, y, z): the rounding that is the same for all terms acts like a move of the point by
        these multiples of the sizes of its coordinates.
    value, gradient: (constant, x, y, z), the rest of the rounding: the constant, plus x, y and z
        times the sizes of the coordinates.
    slopes, hessian: the same for the whole rounding of the gradient and the Hessian, without
        counting any of it as a move of the point.

    A sine or cosine has an error of 2u (`backend.elementary.sincos`).

    - The angle of a factor, fl(fl(k) x + phase), is off by c u |k x|, c = 2 for the two roundings
      of the product, 0 if k is a power of two; with a phase by 2u |phase| and u |k x| more. If all
      factors of an axis have the same |k|, the first error is the same for all of them: a move of
      the point by c u |x|, after which value *and* gradient are those of the moved point.
    - The angle of a plane wave is off by 5u sum |k_i x_i| + 2u |phase|.
    - A product of n factors is off by n times the error of a sine, by u for each product with a
      factor and 2u for an amplitude other than 1; a partial sum by u of its size.
    - A derivative along an axis contains the frequency as well: 2u more; a second derivative 6u.
      The error of an entry i, j of the Hessian is at most d |k_i| |k_j|, which as a matrix has the
      norm d |k|^2.
    """

    move: tuple[float, float, float]
    value: Share
    gradient: Share
    slopes: Share
    hessian: Share

    @classmethod
    def of(cls, terms: Sequence[Term]) -> WaveRounding:
        """The rounding of the operations of `evaluate_terms`."""
        common = [_shared_frequency(terms, axis) for axis in range(3)]
        value, gradient, total_slopes, second = ([0.0] * 4 for _ in range(4))
        sizes, slopes, seconds = 0.0, 0.0, 0.0
        for n, term in enumerate(terms):
            size, vector = abs(term.amplitude), _vector(term)
            norm = math.sqrt(sum(k * k for k in vector))
            second_size = size * norm * norm
            sizes, slopes, seconds = sizes + size, slopes + size * norm, seconds + second_size
            angle, per_axis, operations = _of_term(term, common)
            _, all_per_axis, _ = _of_term(term, (None, None, None))
            partial = (sizes, slopes, seconds) if n else (0.0, 0.0, 0.0)  # the first sum is exact
            value[0] += size * (angle + operations) + partial[0]
            gradient[0] += size * norm * (angle + operations + 2) + partial[1]
            second[0] += second_size * (angle + operations + 6) + partial[2]
            for axis in range(3):
                value[axis + 1] += size * per_axis[axis]
                gradient[axis + 1] += size * norm * per_axis[axis]
                total_slopes[axis + 1] += size * norm * all_per_axis[axis]
                second[axis + 1] += second_size * all_per_axis[axis]
        total_slopes[0] = gradient[0]
        moves = [0.0 if k is None else _rounded(k) for k in common]
        a, b, c, d = ((s[0], s[1], s[2], s[3]) for s in (value, gradient, total_slopes, second))
        return cls((moves[0], moves[1], moves[2]), a, b, c, d)

    def errors(self, p: Vec3, gradient: Vec3) -> tuple[Real, Real]:
        """Errors of value and gradient at p; of the gradient after the point is moved by `move`."""
        size = [dr.abs(p.x), dr.abs(p.y), dr.abs(p.z)]
        value, slope = self.value[0], self.gradient[0]
        for axis in range(3):
            if self.move[axis] > 0:
                value = value + self.move[axis] * size[axis] * dr.abs(gradient[axis])
            if self.value[axis + 1] > 0:
                value = value + self.value[axis + 1] * size[axis]
                slope = slope + self.gradient[axis + 1] * size[axis]
        unit = float(dr.epsilon(type(p.x)))
        return unit * (value + 0 * p.x), unit * (slope + 0 * p.x)

    def derivative_errors(self, p: Vec3) -> tuple[Real, Real]:
        """Errors of gradient and Hessian at p itself."""
        unit = float(dr.epsilon(type(p.x)))

        def at(parts: Share) -> Real:
            terms = (rate * dr.abs(x) for rate, x in zip(parts[1:], p, strict=True))
            return unit * (parts[0] + sum(terms, 0 * p.x))

        return at(self.slopes), at(self.hessian)


def _vector(term: Term) -> tuple[float, ...]:
    """The wave vector of a term, or the frequencies of its factors."""
    if isinstance(term, PlaneWave):
        return term.wave_vector
    return tuple(factor.frequency for _, factor in term.factors)


def _shared_frequency(terms: Sequence[Term], axis: int) -> float | None:
    """The |frequency| that all terms share along an axis; None if there are several."""
    frequencies: set[float] = set()
    for term in terms:
        if isinstance(term, PlaneWave):
            if term.wave_vector[axis] != 0:
                return None
        else:
            frequencies |= {
                abs(factor.frequency) for factor_axis, factor in term.factors if factor_axis == axis
            }
    return frequencies.pop() if len(frequencies) == 1 else None


def _rounded(frequency: float) -> float:
    """The rounding of frequency and product together: none for powers of two."""
    return 0.0 if abs(math.frexp(frequency)[0]) == 0.5 else 2.0


def _of_term(term: Term, common: Sequence[float | None]) -> tuple[float, list[float], float]:
    """For a term of amplitude 1: the rounding of its angles, as a constant part and a part in units
    of the coordinates' sizes, and the rounding of its operations."""
    if isinstance(term, PlaneWave):
        operations = _SINE + 2
        return 2 * abs(term.phase), [5 * abs(k) for k in term.wave_vector], operations
    angle, per_axis = 0.0, [0.0] * 3
    for axis, factor in term.factors:
        angle += 2 * abs(factor.phase)
        per_axis[axis] = abs(factor.frequency) * _of_angle(factor, common[axis] is not None)
    n = len(term.factors)
    return angle, per_axis, n * _SINE + max(n - 1, 0) + (0 if term.amplitude == 1.0 else 2)


def _of_angle(factor: WaveFactor, is_common: bool) -> float:
    """The rounding of a factor's angle in units of u |k x|, without the part that counts as a move
    of the point if the frequency is common to all factors."""
    total = 0.0 if is_common else _rounded(factor.frequency)
    return total + 1.0 if factor.phase else total
