"""Sine and cosine as accurate on every backend as what is promised of sums of waves assumes."""

from __future__ import annotations

from typing import Any

import drjit as dr

# pi/2 in three parts, the first two so short that their products with integers below 2^11 are exact
# (Cody and Waite 1980), and the minimax polynomials of Cephes (Moshier) on [-pi/4, pi/4].
_HALF_PI = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
# And in two, with fused products: the second is what double precision leaves over.
_HALF_PI_DOUBLE = (1.5707963267948966, 6.123233995736766e-17)
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)


def sincos(x: Any) -> tuple[Any, Any]:
    """sin x and cos x, each within 2u (u the unit roundoff) for |x| <= `largest_angle`; beyond it
    they are not numbers.

    In single precision by arithmetic alone. Dr.Jit's own functions are one instruction on CUDA,
    off by 2^-20.5 = 11u and by 600u for an angle of 300 (PTX ISA, sin.approx), and on LLVM they
    lose accuracy from 8192 on: 16u at 10^5, everything at 10^6. In double precision they are right
    within 1.6u up to some 10^9, so that angles are reduced here: x - k pi/2 is rounded once, and
    once more for the part of pi/2 that double precision leaves over, as products are fused.
    """
    is_double = dr.type_v(type(x)) == dr.VarType.Float64
    quarter = dr.round(x * 0.6366197723675814)
    rest = dr.select(dr.abs(x) <= largest_angle(type(x)), x, dr.nan)
    for part in _HALF_PI_DOUBLE if is_double else _HALF_PI:
        rest = dr.fma(quarter, -part, rest)
    if is_double:
        sine, cosine = dr.sincos(rest)
    else:
        square = rest * rest
        sine, cosine = _polynomial(_SINE, square), _polynomial(_COSINE, square)
        sine = dr.fma(sine * square, rest, rest)
        cosine = dr.fma(cosine * square, square, dr.fma(square, -0.5, 1))
    # quarter modulo 4 is 0, 1, 2, 3 for (s, c), (c, -s), (-s, -c), (-c, s).
    half = 0.5 * quarter
    whole = dr.floor(half)
    is_odd, is_late = whole != half, dr.floor(0.5 * whole) != 0.5 * whole
    s, c = dr.select(is_odd, cosine, sine), dr.select(is_odd, sine, cosine)
    return dr.select(is_late, -s, s), dr.select(is_late ^ is_odd, -c, c)


def largest_angle(real: Any) -> float:
    """The largest angle whose sine is known in the precision of `real`: an angle that is itself
    rounded is off by 0.06 there in single precision, and by 0.01 in double."""
    return 2.0**47 if dr.type_v(real) == dr.VarType.Float64 else 1e6


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    total = coefficients[0]
    for one in coefficients[1:]:
        total = dr.fma(total, x, one)
    return total
