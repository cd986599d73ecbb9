"""Elementary functions of Dr.Jit arrays, where Dr.Jit's own are slow, inexact or overflow.

Minimum, maximum and clamp are one instruction each. `drjit.minimum` follows IEEE 754's
NaN-propagating `minimum`, three instructions with AVX2 (and a crash with LLVM 15 and 16). A
comparison and a select become a single `minps`. With a NaN in either place the *second* argument is
returned: put the safe value there.

`safe_norm` is right for vectors whose squares would overflow or vanish. `sincos` is as accurate on
every backend as the promises of sums of waves assume.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3
    from harnack.backend.validation import FloatArray


def fmin(a: Any, b: Any) -> Any:
    """The smaller of a and b; b if either is NaN."""
    return dr.select(a < b, a, b)


def fmax(a: Any, b: Any) -> Any:
    """The larger of a and b; b if either is NaN."""
    return dr.select(a > b, a, b)


def clamp(x: Any, low: Any, high: Any) -> Any:
    """x limited to [low, high]; low if x is NaN."""
    return fmin(fmax(x, low), high)


# Per precision two pairs (limit, factor) of exponents of 2: vectors shorter than the first limit,
# or longer than the second, are multiplied by the factor beside it. That is exact, and squares then
# neither underflow nor overflow.
_SCALING_EXPONENTS_SINGLE, _SCALING_EXPONENTS_DOUBLE = (
    ((-50, 76), (60, -68)),
    ((-450, 572), (500, -524)),
)


def safe_norm(v: Vec3) -> Real:
    """|v|, right for every vector of ordinary numbers; NaN if a component is NaN.

    `drjit.norm` squares first: in single precision it is 0 for vectors shorter than 1e-19, such as
    the gradient of a polynomial of degree 12 at a fiftieth of its size from a zero of that order.
    """
    largest = max_norm(v)
    real = cast("Any", type(largest))
    (low, up), (high, down) = _norm_scaling_exponents(largest)
    is_short, is_long = largest < 2.0**low, largest > 2.0**high
    scale = dr.select(is_short, real(2.0**up), dr.select(is_long, real(2.0**down), real(1)))
    inverse = dr.select(is_short, real(2.0**-up), dr.select(is_long, real(2.0**-down), real(1)))
    return dr.norm(v * scale) * inverse


def safe_normalize(v: Vec3) -> Vec3:
    """v/|v|, right for every vector whose largest component is a normal number."""
    largest = dr.detach(max_norm(v))
    (low, _), (high, _) = _norm_scaling_exponents(largest)
    is_ordinary = (largest >= 2.0**low) & (largest <= 2.0**high)
    scaled = v / dr.select(is_ordinary, 1, largest)
    return scaled / dr.norm(scaled)


def max_norm(v: Vec3) -> Real:
    """The largest of |x|, |y| and |z|."""
    return fmax(fmax(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z))


def _norm_scaling_exponents(x: Real) -> tuple[tuple[int, int], tuple[int, int]]:
    """The scaling exponents for the precision of x."""
    return (
        _SCALING_EXPONENTS_DOUBLE
        if dr.type_v(type(x)) == dr.VarType.Float64
        else _SCALING_EXPONENTS_SINGLE
    )


# pi/2 in three parts, the first two so short that their products with integers below 2^11 are exact
# (Cody and Waite 1980), and the minimax polynomials of Cephes (Moshier) on [-pi/4, pi/4].
_HALF_PI = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
# pi/2 in two parts, for fused products: the second is the rounding error of the first.
_HALF_PI_DOUBLE = (1.5707963267948966, 6.123233995736766e-17)
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)


def sincos(x: Any) -> tuple[Any, Any]:
    """sin x and cos x, each within 2u (u the unit roundoff) for |x| <= `max_sincos_argument`;
    beyond it they are not numbers.

    In single precision, they are computed here. Dr.Jit's own functions are one instruction on CUDA,
    with an error of 2^-20.5 = 11u, and of 600u for an angle of 300 (PTX ISA, sin.approx); on LLVM
    they lose accuracy above 8192: the error is 16u at 10^5, and no digit is right at 10^6. In
    double precision, Dr.Jit's functions are accurate within 1.6u up to about 10^9, so only the
    angles are reduced here: x - k pi/2 is rounded once, and once more for the second part of pi/2,
    as products are fused.
    """
    is_double = dr.type_v(type(x)) == dr.VarType.Float64
    k = dr.round(x * 0.6366197723675814)
    reduced = dr.select(dr.abs(x) <= max_sincos_argument(type(x)), x, dr.nan)
    for part in _HALF_PI_DOUBLE if is_double else _HALF_PI:
        reduced = dr.fma(k, -part, reduced)
    if is_double:
        sine, cosine = dr.sincos(reduced)
    else:
        square = reduced * reduced
        sine, cosine = _polynomial(_SINE, square), _polynomial(_COSINE, square)
        sine = dr.fma(sine * square, reduced, reduced)
        cosine = dr.fma(cosine * square, square, dr.fma(square, -0.5, 1))
    # k modulo 4 is 0, 1, 2, 3 for (s, c), (c, -s), (-s, -c), (-c, s).
    half = 0.5 * k
    floor = dr.floor(half)
    is_odd, is_late = floor != half, dr.floor(0.5 * floor) != 0.5 * floor
    s, c = dr.select(is_odd, cosine, sine), dr.select(is_odd, sine, cosine)
    return dr.select(is_late, -s, s), dr.select(is_late ^ is_odd, -c, c)


def max_sincos_argument(real: Any) -> float:
    """The largest angle whose sine is known in the precision of `real`. The rounding of such an
    angle is up to 0.06 in single precision, and 0.01 in double precision."""
    return 2.0**47 if dr.type_v(real) == dr.VarType.Float64 else 1e6


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    """The polynomial with these coefficients, the highest power first, at x."""
    total = coefficients[0]
    for coefficient in coefficients[1:]:
        total = dr.fma(total, x, coefficient)
    return total


def orthonormal_basis(d: Vec3) -> tuple[Vec3, Vec3]:
    """u and v with (u, v, d) orthonormal and right-handed, |d| = 1 (Duff et al. 2017, "Building an
    Orthonormal Basis, Revisited")."""
    vector = cast("Any", type(d))
    sign = dr.select(d.z >= 0, type(d.z)(1), -1)
    a = -1 / (sign + d.z)
    b = d.x * d.y * a
    u = vector(dr.fma(sign * d.x, d.x * a, 1), sign * b, -sign * d.x)
    v = vector(b, dr.fma(d.y, d.y * a, sign), -d.y)
    return u, v


def orthonormal_basis_rows(d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`orthonormal_basis` of rows (n, 3) on the host."""
    x, y, z = d.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.column_stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.column_stack([b, sign + y * y * a, -y])
    return u, v
