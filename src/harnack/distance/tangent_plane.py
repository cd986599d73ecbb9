"""The geometry of a level set of a function f near a point: its tangent plane, second derivatives
along it, and first- and second-order estimates of the distance from the level set.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import fmax, orthonormal_basis, safe_norm
from harnack.backend.validation import MAX_COORDINATE, as_real_array
from harnack.fields import batch_evaluation as field_points

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.evaluator import Evaluator

__all__ = [
    "SymmetricEigen2",
    "TangentPlane",
    "first_order_distance",
    "has_hessian",
    "in_batches",
    "matvec",
    "second_order_distance",
]


@dataclass(frozen=True)
class TangentPlane:
    """The tangent plane of a level set of a function f at a point where grad f is not zero.

    gradient_norm: |grad f|.
    n: the unit normal along grad f.
    u, v: two unit tangents, at right angles to each other.
    """

    gradient_norm: Real
    n: Vec3
    u: Vec3
    v: Vec3

    @classmethod
    def of(cls, gradient: Vec3) -> TangentPlane:
        """Return the plane at right angles to a gradient; NaN where that is zero."""
        gradient_norm = safe_norm(gradient)
        n = gradient / gradient_norm
        u, v = orthonormal_basis(n)
        return cls(gradient_norm, n, u, v)

    def restrict_hessian(self, rows: tuple[Vec3, Vec3, Vec3]) -> tuple[Real, Real, Real]:
        """Return the numbers u.Au, v.Av and u.Av for a symmetric 3x3 matrix A, such as a Hessian,
        where u and v are the unit tangents of the plane. rows: the three rows of A."""
        along_u, along_v = matvec(rows, self.u), matvec(rows, self.v)
        return dr.dot(self.u, along_u), dr.dot(self.v, along_v), dr.dot(self.u, along_v)


@dataclass(frozen=True)
class SymmetricEigen2:
    """The eigenvalues and eigenvectors of a symmetric 2x2 matrix. (cosine, sine) is the unit
    eigenvector of the larger eigenvalue, (-sine, cosine) that of the smaller one.

    largest, smallest: the two eigenvalues.
    """

    largest: Real
    smallest: Real
    cosine: Real
    sine: Real

    @classmethod
    def of(cls, uu: Real, vv: Real, uv: Real) -> SymmetricEigen2:
        """Return the eigenvalues and eigenvectors of the matrix ((uu, uv), (uv, vv))."""
        # The eigenvectors are turned against the axes by half the polar angle of (half, uv).
        middle, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
        spread = dr.sqrt(dr.fma(half, half, uv * uv))
        s, c = dr.sincos(0.5 * dr.atan2(uv, half))
        return cls(middle + spread, middle - spread, c, s)

    def coordinates(self, u: Real, v: Real) -> tuple[Real, Real]:
        """Return the coordinates of the vector (u, v) in the basis of unit eigenvectors; the
        eigenvector of the larger eigenvalue comes first."""
        return (
            dr.fma(self.cosine, u, self.sine * v),
            dr.fma(self.cosine, v, -self.sine * u),
        )

    def combination(self, along_larger: Real, along_smaller: Real) -> tuple[Real, Real]:
        """Return the vector (u, v) whose coordinates in the basis of unit eigenvectors are
        `along_larger`, for the eigenvector of the larger eigenvalue, and `along_smaller`, for the
        other."""
        return (
            dr.fma(self.cosine, along_larger, -self.sine * along_smaller),
            dr.fma(self.sine, along_larger, self.cosine * along_smaller),
        )


def has_hessian(backend: Backend, evaluator: Evaluator) -> bool:
    """Return whether an evaluator can compute second derivatives."""
    try:
        evaluator.hessian(backend.Array3f(0))
    except NotImplementedError:
        return False
    return True


def matvec(rows: tuple[Vec3, Vec3, Vec3], vector: Vec3) -> Vec3:
    """Return the product of a 3x3 matrix, given by its three rows, and a vector."""
    return type(vector)(*(dr.dot(row, vector) for row in rows))


def first_order_distance(above: Real, gradient: Vec3) -> Real:
    """Return the first-order estimate of the signed distance of a point x from a level set:
    above/|grad f|, where above = f - level and the gradient are taken at x. Its error is O(d^2) at
    the distance d from a smooth surface.

    Proof. Let y be the closest point of the level set, N its normal grad f/|grad f|(y), and
    x = y + d N (x - y is normal at the closest point; d has the sign of above). Taylor's formula
    along this line, from x back to y, and |grad f(x)| = |grad f(y)| + O(d) give
    above = d N.grad f(x) + O(d^2) = d |grad f(x)| + O(d^2).

    If the gradient is zero, the estimate is infinite, with the sign of `above`; on the level itself
    it is zero.
    """
    return dr.select(above == 0, 0, above / safe_norm(gradient))


def second_order_distance(above: Real, gradient: Vec3, rows: tuple[Vec3, Vec3, Vec3]) -> Real:
    """Return the second-order estimate of the signed distance d of a point x from a level set:
    d1/(1 - k d1/2) with above = f - level, d1 = above/|grad f| and k = n.An/|grad f|. Its error is
    O(d^3).

    above: f - level at x.
    gradient, rows: g = grad f at x, and the three rows of the Hessian A there; n = g/|g|.

    k tells how fast the slope changes along n; it is not a curvature of the surface.

    Proof. With x = y + d N as in `first_order_distance`, Taylor along that line is
    above = d N.g - d^2 N.AN/2 + O(d^3), whose root is d = e + (N.AN/N.g) e^2/2 + O(d^3) with
    e = above/N.g. N is not n: but n is smooth and n(y) = N, so N = n + O(d); for unit vectors
    N.n = 1 - |N-n|^2/2, hence N.g = |g| (1 + O(d^2)), and N.AN = n.An + O(d). As above = O(d),
    replacing N by n changes e and the second term by O(d^3): d = d1 + k d1^2/2 + O(d^3). So does
    any function with the same expansion.

    Three have it: the polynomial, the smaller root 2 d1/(1 + sqrt(1 - 2 k d1)) of the parabola, and
    Halley's quotient above. The root does not exist for k d1 > 1/2; the polynomial changes sign at
    k d1 = -2; the quotient is exact for f = c/r + const along its rays (for every f = (a+bs)/(c+es)
    on the line), as harmonic functions often are, and bounded for k d1 < 0. For k d1 > 1, where
    Taylor's formula says nothing, its denominator is held at 1/2: the sign is always that of
    above, and the size at most 2 |d1|.
    """
    gradient_norm = safe_norm(gradient)
    n = gradient / gradient_norm
    first = first_order_distance(above, gradient)
    k = dr.dot(n, matvec(rows, n)) / gradient_norm
    quotient = first / fmax(1 - 0.5 * k * first, 0.5)
    return dr.select(dr.isfinite(first) & (first != 0), quotient, first)


# Evaluation at points in batches. Arguments and results are NumPy arrays of float64.

# Number of points per batch. It bounds the memory, and the time until an interrupt is noticed.
_BATCH_SIZE = 1 << 18


def in_batches(
    backend: Backend,
    compute: Callable[..., tuple[Real | Vec3, ...]],
    points: Any,
    *extra_vectors: FloatArray,
) -> tuple[Any, ...]:
    """Evaluate a function of Dr.Jit vectors at points (n, 3), for one batch after the other.
    Returns its results as a tuple of float64 arrays, (n,) for numbers and (n, 3) for vectors.

    compute: the function. It takes the points, and one vector for each of `extra_vectors`, and
        returns a tuple of numbers and vectors.
    extra_vectors: further arguments of `compute`, arrays (n, 3) each, whose values are not checked.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers of at most
            1e100.
    """
    _check_size(points)
    with np.errstate(over="ignore"):
        rounded = (values.astype(backend.dtype, copy=False) for values in extra_vectors)
        results = field_points.map_batches(backend, compute, points, *rounded, at_once=_BATCH_SIZE)
    return tuple(values.astype(np.float64, copy=False) for values in results)


def _check_size(points: Any) -> None:
    """Raise a ValueError if a finite coordinate of the points is larger than `MAX_COORDINATE`.
    Dr.Jit arrays are not checked."""
    coordinates = None if dr.is_array_v(type(points)) else as_real_array(points, "points")
    if coordinates is None or not coordinates.size:
        return
    size = float(np.abs(coordinates).max())
    if MAX_COORDINATE < size < np.inf:
        raise ValueError(
            f"points: coordinates up to {size:g} are too large: at most {MAX_COORDINATE:g}"
        )
