"""Bounds of the rounding errors of sums of solid harmonics, and of sums of waves. A solid harmonic
r^l Y_lm of degree l and order m is a homogeneous harmonic polynomial; with x + iy = rho exp(ib), it
is the product of a constant N, of a polynomial Q = Q_l^m in z and r^2 (`solid_harmonics`), and of
rho^m times cos(mb) or sin(mb). A weight is the coefficient of a solid harmonic in a sum. A wave is
a sine or cosine, or a product of these. All bounds are multiples of u, the unit roundoff (half of
the machine epsilon of the precision in use).

The bounds are to first order in u. Each operation is exact up to a factor 1 + d with |d| <= u, so
the relative errors of factors add up. In single precision the terms of second order are below 1e-4
of those of first order; `_SECOND_ORDER` covers them.

- `HarmonicRounding`: the rounding of `solid_harmonics.evaluate`.
- `WaveRounding`: the rounding of `waves.evaluate_terms`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

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
    """Bounds of the rounding errors of the value and the gradient of a sum of solid harmonics, as
    multiples of the unit roundoff u. They hold at a point of the unit ball, and depend on its
    distances rho from the z axis and r from the origin.

    value_bounds, gradient_bounds: two bounds each; the smaller one is used. The first is sharp near
        the z axis: it is a sum of terms c rho^m r^(l-m). The second is a sum of terms c r^l, whose
        c are computed from the largest error on the unit sphere; away from the axis it is smaller.
    underflow: the error of the value by underflow, in smallest normal numbers.

    Let z = r c, so that c is the cosine of the polar angle.

    - r^2 = x^2 + y^2 + z^2 has a relative error of 3u.
    - One step of the recurrence for Q is q_l = A z q_(l-1) - B r^2 q_(l-2), where A and B are
      rounded coefficients. It adds an error of at most g_l = 4u |A z q_(l-1)| + 7u |B r^2 q_(l-2)|,
      and propagates the errors of earlier steps by the same recurrence. So the error of q_l is at
      most the sum over k of |G_lk| g_k, where G_lk is the solution of the recurrence that begins
      with G_kk = 1 and 0 before. In units of u r^(l-m) this is a function of c only; `_recurrence`
      computes it at samples of c.
    - (x + iy)^m: a product of complex numbers has an error of at most 2 sqrt(2) u of its absolute
      value (each component has at most 2u (|x c| + |y s|) or 2u (|x s| + |y c|) if c + is is the
      other factor w, and 4 |x c y s| <= rho^2 |w|^2). The first factor is exact, so m - 1 products
      make 2 sqrt(2) (m-1) u rho^m.
    - A term of the sum: 3u for its weight and two products; then u for each further term of its
      order and for each further order.
    - If the point was divided by the size of the domain: 3u of each coordinate, which changes a
      function f by at most 3u (rho |f_rho| + |z f_z|).

    Numbers that underflow are lost altogether: the error is the smallest normal number for each
    operation, times the factor by which the recurrence may enlarge it.
    """

    value_bounds: tuple[AxialBound, AxialBound]
    gradient_bounds: tuple[AxialBound, AxialBound]
    underflow: float

    @classmethod
    def of(cls, weights: Weights, *, is_divided: bool) -> HarmonicRounding:
        """Compute the bounds for the sum of solid harmonics with these weights, as
        `solid_harmonics.evaluate` computes it.

        weights: a mapping (l, m) -> coefficient.
        is_divided: whether points are divided by a size other than 1 before.
        """
        # The terms of the four bounds, as (power of rho, power of r) -> coefficient.
        tables: list[dict[tuple[int, int], float]] = [{}, {}, {}, {}]
        order_count = len({m for _, m in weights})
        underflow = 1.0
        for (l, m), amplitude in amplitudes(weights).items():  # noqa: E741
            # The amplitude stands for two columns: cos(m b) and sin(m b), at right angles.
            term_count = max(sum(order == k for _, order in weights) for k in (m, -m))
            addition_count = (term_count - 1) + (order_count - 1)
            factor = amplitude * legendre_weight(l, m)
            value_near, value_anywhere = _value_errors(l, m, addition_count, is_divided)
            steep_near, steep_anywhere = (
                _slope_errors(l, m, addition_count, is_divided) if l else (0.0, 0.0)
            )
            rho_power = max(m - 1, 0)
            for terms, i, degree, constant in (
                (tables[0], m, l, value_near),
                (tables[1], 0, l, value_anywhere),
                (tables[2], rho_power, l - 1, steep_near),
                (tables[3], 0, l - 1, steep_anywhere),
            ):
                # rho^i r^(degree - i)
                if degree >= i:
                    terms[i, degree - i] = terms.get((i, degree - i), 0.0) + factor * constant
            underflow += 2.0 + factor * _underflow(l, m)
        a, b, c, d = (AxialBound.of(terms) for terms in tables)
        # A pair for the value and one for the gradient: near the z axis, and anywhere.
        return cls((a, b), (c, d), underflow)

    def value_error(self, rho: Real, r: Real) -> Real:
        """The bound of the error of the value, in units of u, at a point with the distances rho
        from the z axis and r from the origin."""
        near, anywhere = self.value_bounds
        return fmin(near(rho, r), anywhere(rho, r))

    def gradient_error(self, rho: Real, r: Real) -> Real:
        """The bound of the error of the gradient, as a length in units of u, at a point with the
        distances rho from the z axis and r from the origin."""
        near, anywhere = self.gradient_bounds
        return fmin(near(rho, r), anywhere(rho, r))


@functools.cache
def _recurrence(l: int, m: int) -> tuple[FloatArray, FloatArray, float]:  # noqa: E741
    """Rounding errors of the recurrence by which the polynomials q_l = Q_l^m/(2m-1)!! are computed,
    at points of the unit sphere with `_SAMPLES` + 1 polar angles. `HarmonicRounding` has the
    formulas.

    Returns an array of |q_l|; an array of bounds of its error in units of u; and the factor for
    underflow: the sum over the steps k of the recurrence of the largest |G_lk| (by which an error
    of step k has grown at step l) times the sum of the step's coefficients plus 2.
    """
    cosine, _ = polar_samples(_SAMPLES)
    # On the unit sphere z is the cosine, and r^2 is 1.
    q = Legendre(cosine, 1.0)
    zeros, ones = 0.0 * cosine, 0.0 * cosine + 1.0
    if l < m:
        return zeros, zeros, 0.0
    # For each step k: the error that it adds, 4u |A z q_(k-1)| + 7u |B r^2 q_(k-2)| with the two
    # coefficients A and B, and its growth G_lk up to step l, by the same recurrence.
    error, underflow_factor = zeros.copy(), 0.0
    for k in range(m + 1, l + 1):
        z_coefficient, square_coefficient = (2 * k - 1) / (k - m), (k + m - 1) / (k - m)
        step_error = 4 * np.abs(z_coefficient * cosine * q(k - 1, m))
        if k > m + 1:
            step_error = step_error + 7 * np.abs(square_coefficient * q(k - 2, m))
        last_growth, growth = zeros, ones
        for j in range(k + 1, l + 1):
            next_growth = (2 * j - 1) / (j - m) * cosine * growth - (j + m - 1) / (
                j - m
            ) * last_growth
            last_growth, growth = growth, next_growth
        error = error + np.abs(growth) * step_error
        underflow_factor += float(np.abs(growth).max()) * (z_coefficient + square_coefficient + 2.0)
    return np.abs(q(l, m) + zeros), error, underflow_factor


def _complex_power_error(m: int) -> float:
    """A bound of the relative error of the computed power (x + iy)^m, in units of u."""
    return 2 * math.sqrt(2) * max(m - 1, 0)


def _value_errors(l: int, m: int, addition_count: int, is_divided: bool) -> tuple[float, float]:  # noqa: E741
    """Two bounds of the error of the computed value of a solid harmonic r^l Y_lm, which is a term
    of a sum; both are divided by its constant factor, `legendre_weight`. The first one is in units
    of u rho^m r^(l-m), the second one in units of u r^l.

    addition_count: the number of additions in which the term takes part.
    is_divided: whether the point was divided by a size before.
    """
    abs_q, q_error, _ = _recurrence(l, m)
    cosine, sine = polar_samples(_SAMPLES)
    # The error of Q; then 3u for the weight and two products, u for each addition, and the error of
    # (x + iy)^m.
    total = q_error + (3 + addition_count + _complex_power_error(m)) * abs_q
    if is_divided:
        # |q_(l-1)| of the orders m + 1 and m.
        at_next, at_lower = _recurrence(l - 1, m + 1)[0], _recurrence(l - 1, m)[0]
        # 3u (rho |f_rho| + |z f_z|), by the derivatives of Q rho^m.
        total = total + 3 * (
            m * abs_q + (2 * m + 1) * sine * sine * at_next + np.abs(cosine) * (l + m) * at_lower
        )
    return _largest_sample(total), _largest_sample(total * sine**m)


def _slope_errors(l: int, m: int, addition_count: int, is_divided: bool) -> tuple[float, float]:  # noqa: E741
    """Two bounds of the error, a length, of the computed gradient of a solid harmonic r^l Y_lm,
    which is a term of a sum; both are divided by its constant factor, `legendre_weight`. The first
    one is in units of u rho^(m-1) r^(l-m) (for m = 0: of u r^(l-1)), the second one in units of u
    r^(l-1).

    addition_count: the number of additions in which the term takes part.
    is_divided: whether the point was divided by a size before.

    The errors in the order in which `solid_harmonics.evaluate` computes: 4u for weights,
    coefficients and products in each component, 2u for the two terms of the x- and y-components,
    then the sums. If the point was divided by a size, this adds 3u (rho |H| + |z grad f_z|), where
    H is the Hessian and f_z = (l+m) Q_(l-1)^m B, with B the real or imaginary part of (x + iy)^m,
    has the degree l-1 and the order m; and 3u for the division of the gradient by the size.
    """
    _, sine = polar_samples(_SAMPLES)
    operations = 4 + 2 + 2 * addition_count + _complex_power_error(m) + (3 if is_divided else 0)
    abs_q, q_error, _ = _recurrence(l, m)
    at_next, next_error, _ = _recurrence(l - 1, m + 1)
    at_lower, lower_error, _ = _recurrence(l - 1, m)
    power = sine if m > 0 else 0.0 * sine + 1.0
    # The errors of the components of the gradient along rho, azimuth and z, divided by rho^(m-1).
    radial = sine * power * (2 * m + 1) * (next_error + operations * at_next)
    azimuthal = m * (q_error + operations * abs_q)
    axial = power * (l + m) * (lower_error + operations * at_lower)
    total = np.hypot(radial + azimuthal, axial)
    near_axis, anywhere = _largest_sample(total), _largest_sample(total * sine ** max(m - 1, 0))
    if is_divided:
        # On the sphere |H| <= l (l-1) M and |grad f_z| <= (l-1) l M: see `BallRange.curvature`.
        division = 3 * largest_hessian(l, m) / legendre_weight(l, m)
        if l > m:
            division += 3 * (l + m) * largest_gradient(l - 1, m) / legendre_weight(l - 1, m)
        near_axis += division
        anywhere += min(division, 6 * l * (l - 1) * _largest_sample(abs_q * sine**m))
    return near_axis, anywhere


def _largest_sample(sampled: FloatArray) -> float:
    """The largest of the samples, times a factor that covers values between samples
    (`_SECOND_ORDER`)."""
    return float(sampled.max()) * _SECOND_ORDER


def _underflow(l: int, m: int) -> float:  # noqa: E741
    """A bound of the error by underflow of a computed solid harmonic r^l Y_lm, divided by its
    constant factor, `legendre_weight`. It is a multiple of the smallest normal number."""
    abs_q, _, factors = _recurrence(l, m)
    return factors + (2 * m + 2) * float(abs_q.max()) + 2


# The rounding of a sine or cosine in units of u (`backend.elementary.sincos`).
_SINE = 2.0

# (constant, x, y, z): the bound constant + x |p_x| + y |p_y| + z |p_z| at a point p.
_LinearBound: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True)
class WaveRounding:
    """Bounds of the rounding errors of a sum of waves at a point p, as multiples of the unit
    roundoff u. A term of the sum is a plane wave or a product of sines and cosines, its factors. A
    part of the rounding acts as if the point were moved; it is kept apart from the rest.

    move: (x, y, z). Rounding that is the same for all terms acts as if p were moved, in each
        coordinate by this number times the absolute value of the coordinate.
    value, gradient: the errors of value and gradient apart from this move, each as (constant, x, y,
        z) for constant + x |p_x| + y |p_y| + z |p_z|.
    slopes, hessian: the whole errors of gradient and Hessian, in the same form; no error counts as
        a move of the point there.

    A sine or cosine has an error of 2u (`backend.elementary.sincos`).

    - The angle of a factor is k x + phase, with a rounded k. The two roundings of the product make
      an error of 2u |k x|, or none if k is a power of two. A phase adds 2u |phase| + u |k x|. If
      all factors of an axis have the same |k|, the error of the product is the same for all of
      them: it moves the point by 2u |x|, and value *and* gradient are those of the moved point.
    - The angle of a plane wave has an error of 5u sum |k_i x_i| + 2u |phase|.
    - A product of n factors has n times the error of a sine, u for each product with a factor, and
      2u for an amplitude other than 1. Each partial sum adds u of its size.
    - A derivative along an axis contains the frequency as a further factor: 2u more. A second
      derivative: 6u more. If d is the relative error, the error of the entry i, j of the Hessian is
      at most d |k_i| |k_j|, and this matrix has the norm d |k|^2.
    """

    move: tuple[float, float, float]
    value: _LinearBound
    gradient: _LinearBound
    slopes: _LinearBound
    hessian: _LinearBound

    @classmethod
    def of(cls, terms: Sequence[Term]) -> WaveRounding:
        """Compute the bounds of the rounding errors that `evaluate_terms` makes when it sums these
        terms of waves."""
        common_frequencies = [_common_frequency(terms, axis) for axis in range(3)]
        # Each list has four numbers: a constant, and the factors of |x|, |y| and |z|. They are of
        # the attributes with these names: `slopes` bounds the whole error of the gradient.
        value, gradient, slopes, hessian = ([0.0] * 4 for _ in range(4))
        value_sum, slope_sum, second_sum = 0.0, 0.0, 0.0
        for n, term in enumerate(terms):
            amplitude, vector = abs(term.amplitude), _wave_vector(term)
            norm = math.sqrt(sum(k * k for k in vector))
            second_size = amplitude * norm * norm
            # Bounds of the sums so far, each of which is rounded.
            value_sum, slope_sum, second_sum = (
                value_sum + amplitude,
                slope_sum + amplitude * norm,
                second_sum + second_size,
            )
            # The rounding of products that counts as a move of the point is left out of the first
            # result for axes, and is included in the second one.
            angle_error, axis_errors, other_errors = _term_roundings(term, common_frequencies)
            _, whole_axis_errors, _ = _term_roundings(term, (None, None, None))
            # The first sum is exact.
            partial_sums = (value_sum, slope_sum, second_sum) if n else (0.0, 0.0, 0.0)
            # The added 2 and 6 are roundings of the factors that differentiation adds.
            value[0] += amplitude * (angle_error + other_errors) + partial_sums[0]
            gradient[0] += amplitude * norm * (angle_error + other_errors + 2) + partial_sums[1]
            hessian[0] += second_size * (angle_error + other_errors + 6) + partial_sums[2]
            for axis in range(3):
                value[axis + 1] += amplitude * axis_errors[axis]
                gradient[axis + 1] += amplitude * norm * axis_errors[axis]
                slopes[axis + 1] += amplitude * norm * whole_axis_errors[axis]
                hessian[axis + 1] += second_size * whole_axis_errors[axis]
        # A move is proportional to a coordinate, so the constants of both bounds are the same.
        slopes[0] = gradient[0]
        moves = [0.0 if k is None else _product_rounding(k) for k in common_frequencies]
        value_bound, gradient_bound, slopes_bound, hessian_bound = (
            (s[0], s[1], s[2], s[3]) for s in (value, gradient, slopes, hessian)
        )
        return cls(
            (moves[0], moves[1], moves[2]), value_bound, gradient_bound, slopes_bound, hessian_bound
        )

    def errors(self, p: Vec3, gradient: Vec3) -> tuple[Real, Real]:
        """Two bounds, of the errors of the computed value and of the computed gradient of the sum
        at p. The error of the gradient is a length: its difference from the exact gradient at the
        point p moved by `move`.

        gradient: the computed gradient at p.
        """
        abs_p = [dr.abs(p.x), dr.abs(p.y), dr.abs(p.z)]
        # Entry 0 of a bound is a constant, entries 1 to 3 are factors of |x|, |y| and |z|.
        value, slope = self.value[0], self.gradient[0]
        for axis in range(3):
            if not _is_zero(self.move[axis]):
                value = value + self.move[axis] * abs_p[axis] * dr.abs(gradient[axis])
            if not _is_zero(self.value[axis + 1]):
                value = value + self.value[axis + 1] * abs_p[axis]
                slope = slope + self.gradient[axis + 1] * abs_p[axis]
        roundoff = float(dr.epsilon(type(p.x)))
        return roundoff * (value + 0 * p.x), roundoff * (slope + 0 * p.x)

    def derivative_errors(self, p: Vec3) -> tuple[Real, Real]:
        """Two bounds, of the error of the computed gradient of the sum, as a length, and of the
        error of the computed Hessian, as a matrix norm. Both are compared with the exact ones at p
        itself."""
        roundoff = float(dr.epsilon(type(p.x)))

        def at(parts: _LinearBound) -> Real:
            """The bound constant + x |p_x| + y |p_y| + z |p_z| at p. parts: (constant, x, y, z)."""
            terms = (rate * dr.abs(x) for rate, x in zip(parts[1:], p, strict=True))
            return roundoff * (parts[0] + sum(terms, 0 * p.x))

        return at(self.slopes), at(self.hessian)


def _is_zero(bound: Any) -> bool:
    """Whether a bound is the Python number 0. (A number on a backend is not known.)"""
    return isinstance(bound, float) and bound == 0.0


def _wave_vector(term: Term) -> tuple[float, ...]:
    """The wave vector of a term that is a plane wave. For a product of sines and cosines, the
    frequencies of its factors."""
    if isinstance(term, PlaneWave):
        return term.wave_vector
    return tuple(factor.frequency for _, factor in term.factors)


def _common_frequency(terms: Sequence[Term], axis: int) -> float | None:
    """The absolute frequency that all factors (sines and cosines) of one coordinate have in common;
    None if their frequencies differ, if there are no factors, or if a plane wave has a component
    along this axis.

    terms: the terms of a sum of waves.
    axis: the index of the coordinate.
    """
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


def _product_rounding(frequency: float) -> float:
    """The error of the computed product of frequency and coordinate, as a multiple of u times the
    product. It is 0 if the frequency is a power of two, else 2, which includes the rounding of the
    frequency."""
    return 0.0 if abs(math.frexp(frequency)[0]) == 0.5 else 2.0


def _term_roundings(term: Term, common: Sequence[float | None]) -> tuple[float, list[float], float]:
    """The rounding errors of a term (a plane wave or a product of sines and cosines) of amplitude
    1, in units of u.

    common: for each axis the frequency that all terms share, or None. The error of a product with a
        shared frequency is left out, as it counts as a move of the point.

    Returns three results: the part of the errors of its angles that is constant; for each axis, the
    part that is proportional to the absolute value of that coordinate, as a factor; and the error
    of the other operations. `WaveRounding` derives the numbers.
    """
    if isinstance(term, PlaneWave):
        operations = _SINE + 2
        return 2 * abs(term.phase), [5 * abs(k) for k in term.wave_vector], operations
    angle, per_axis = 0.0, [0.0] * 3
    for axis, factor in term.factors:
        angle += 2 * abs(factor.phase)
        per_axis[axis] = abs(factor.frequency) * _angle_rounding(factor, common[axis] is not None)
    n = len(term.factors)
    return angle, per_axis, n * _SINE + max(n - 1, 0) + (0 if term.amplitude == 1.0 else 2)


def _angle_rounding(factor: WaveFactor, is_common: bool) -> float:
    """The rounding error of the angle k x + phase of a sine or cosine, in units of u |k x|, without
    the part 2u |phase|.

    is_common: whether all factors of the axis have this frequency k. The error of the product k x
        is then left out, as it counts as a move of the point.
    """
    total = 0.0 if is_common else _product_rounding(factor.frequency)
    return total + 1.0 if factor.phase else total
