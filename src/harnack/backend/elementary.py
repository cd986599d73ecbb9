"""Elementary functions of Dr.Jit arrays for which Dr.Jit's own are slow, inexact, or overflow.

Minimum, maximum and clamp take one instruction each (`minps` for a comparison and a select).
`drjit.minimum` is slower: it follows IEEE 754's `minimum`, whose result is NaN if an argument is
NaN. That takes three instructions with AVX2, and crashes with LLVM 15 and 16. Here, if either
argument is NaN, the *second* argument is returned: pass the safe value there.

`safe_norm` is right for vectors whose squares would overflow or underflow. `sincos` has, on every
backend, the accuracy that proved bounds of sums of waves assume.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3
    from harnack.backend.validation import FloatArray


def fmin(a: Any, b: Any) -> Any:
    """Return the smaller of a and b; b if either is NaN."""
    return dr.select(a < b, a, b)


def fmax(a: Any, b: Any) -> Any:
    """Return the larger of a and b; b if either is NaN."""
    return dr.select(a > b, a, b)


def clamp(x: Any, low: Any, high: Any) -> Any:
    """Return x limited to [low, high]; low if x is NaN."""
    # fmax returns low for NaN.
    return fmin(fmax(x, low), high)


# Per precision two pairs (limit, factor) of exponents of 2: vectors shorter than the first limit,
# or longer than the second, are multiplied by the factor beside it. That is exact, and squares then
# neither underflow nor overflow.
_SCALING_EXPONENTS_SINGLE, _SCALING_EXPONENTS_DOUBLE = (
    ((-50, 76), (60, -68)),
    ((-450, 572), (500, -524)),
)


def safe_norm(v: Vec3) -> Real:
    """Return the length |v| of a vector, also if its squares would underflow or overflow; NaN if a
    component is NaN.

    `drjit.norm` squares the components first: in single precision it is 0 for vectors shorter than
    1e-19. Such a vector is, for example, the gradient of x^12 at x = 0.01. Here very short and very
    long vectors are multiplied by a power of 2 first.
    """
    largest = max_norm(v)
    real = cast("Any", type(largest))
    (low, up), (high, down) = _norm_scaling_exponents(largest)
    is_short, is_long = largest < 2.0**low, largest > 2.0**high
    # The power of 2 for each lane, and its inverse, by which the length is multiplied afterwards.
    scale = dr.select(is_short, real(2.0**up), dr.select(is_long, real(2.0**down), real(1)))
    inverse = dr.select(is_short, real(2.0**-up), dr.select(is_long, real(2.0**-down), real(1)))
    return dr.norm(v * scale) * inverse


def safe_normalize(v: Vec3) -> Vec3:
    """Return the unit vector v / |v|. This holds for every vector whose largest component is a
    normal floating-point number, also if its square would underflow or overflow."""
    # This factor cancels, so it needs no derivative.
    largest = dr.detach(max_norm(v))
    (low, _), (high, _) = _norm_scaling_exponents(largest)
    is_ordinary = (largest >= 2.0**low) & (largest <= 2.0**high)
    # Very short and very long vectors are divided by their largest component first.
    scaled = v / dr.select(is_ordinary, 1, largest)
    return scaled / dr.norm(scaled)


def max_norm(v: Vec3) -> Real:
    """Return the largest of |x|, |y| and |z| of a vector."""
    return fmax(fmax(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z))


def _norm_scaling_exponents(x: Real) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the exponents by which `safe_norm` scales vectors, for the precision of x: ((low, up),
    (high, down)). Vectors shorter than 2^low are multiplied by 2^up, vectors longer than 2^high by
    2^down."""
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
    """Return sin x and cos x, each with an error of at most 2u (u is the unit roundoff of the
    precision). If |x| is larger than `max_sincos_argument`, the results are NaN.

    Method: with k = x / (pi/2), rounded to an integer, the angle x - k pi/2 is small. Its sine and
    cosine are exchanged and negated as k modulo 4 says.

    In single precision, Dr.Jit's own functions are not accurate enough. On CUDA they are one
    instruction, with an error of 2^-20.5 = 11u, and of 600u for an angle of 300 (PTX ISA,
    sin.approx). On LLVM they lose accuracy above 8192: the error is 16u at 10^5, and no digit is
    right at 10^6. So polynomials are used here. In double precision, Dr.Jit's functions are
    accurate within 1.6u up to about 10^9, and are used for the reduced angle. In both precisions,
    pi/2 is the sum of a few floating-point numbers, its parts. The reduced angle x - k pi/2 is
    computed by subtracting k times each part by a fused multiply-add, so it is rounded only once
    for each part.
    """
    is_double = dr.type_v(type(x)) == dr.VarType.Float64
    # 0.6366... is 2/pi.
    k = dr.round(x * 0.6366197723675814)
    reduced = dr.select(dr.abs(x) <= max_sincos_argument(type(x)), x, dr.nan)
    # Subtract k pi/2 part by part, from the largest part of pi/2 to the smallest.
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
    is_odd, is_second_half = floor != half, dr.floor(0.5 * floor) != 0.5 * floor
    swapped_sine, swapped_cosine = dr.select(is_odd, cosine, sine), dr.select(is_odd, sine, cosine)
    return dr.select(is_second_half, -swapped_sine, swapped_sine), dr.select(
        is_second_half ^ is_odd, -swapped_cosine, swapped_cosine
    )


def max_sincos_argument(real: Any) -> float:
    """Return the largest angle, in radians, for which `sincos` gives numbers in the precision of
    the type `real`. The rounding of an angle of this size is up to 0.06 in single precision, and
    0.01 in double precision."""
    return 2.0**47 if dr.type_v(real) == dr.VarType.Float64 else 1e6


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    """Return the value at x of the polynomial with these coefficients, the coefficient of the
    highest power first."""
    value = coefficients[0]
    for coefficient in coefficients[1:]:
        value = dr.fma(value, x, coefficient)
    return value


def orthonormal_basis(d: Vec3) -> tuple[Vec3, Vec3]:
    """Return two unit vectors u and v for each unit vector d such that (u, v, d) is orthonormal and
    right-handed (Duff et al. 2017, "Building an Orthonormal Basis, Revisited")."""
    vector = cast("Any", type(d))
    # With this sign, the divisor is at least 1 in absolute value.
    sign = dr.select(d.z >= 0, type(d.z)(1), -1)
    a = -1 / (sign + d.z)
    b = d.x * d.y * a
    u = vector(dr.fma(sign * d.x, d.x * a, 1), sign * b, -sign * d.x)
    v = vector(b, dr.fma(d.y, d.y * a, sign), -d.y)
    return u, v


def orthonormal_basis_rows(d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two arrays u and v (n, 3) of unit vectors for an array d (n, 3) of unit vectors: (u,
    v, d) is orthonormal and right-handed in each row. It is the formula of `orthonormal_basis`, for
    NumPy arrays."""
    x, y, z = d.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.column_stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.column_stack([b, sign + y * y * a, -y])
    return u, v
