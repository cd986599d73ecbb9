"""Mean and Gaussian curvature of level sets, from first and second derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.backend.extrema import fmax, fmin
from harnack.backend.numbers import refuses_derivatives
from harnack.distance.batches import in_batches
from harnack.distance.tangent import TangentPlane
from harnack.fields.batch import BatchedField
from harnack.fields.field import check_is_field

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields.field import Field

__all__ = ["Curvatures", "curvature"]

# The error of a mean curvature that is good enough: this share of it, or of one over the size of
# the surface where that is more.
_ACCURACY = 1e-3
# How many times farther than usual clusters have to be to count as a whole, in turn, until the
# error is small enough; at infinity all terms of a sum are taken one by one.
_CLOSER = (1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
# In epsilons, of gradient and Hessian: what the arithmetic here may do.
_ROUNDING = 16.0


@dataclass(frozen=True)
class Curvatures:
    """Of the level sets through n points. NaN where the gradient is zero, so that there is no
    surface, and where its error is not less than the gradient: nothing is known of the surface.

    mean: (n,) half the divergence of the normal, 1/length. Its sign is the normal's: a sphere of
        radius r has 1/r if f grows outward, -1/r if f grows inward.
    gaussian: (n,) product of the principal curvatures, 1/length^2; the same for f and -f.
    normal: (n, 3) grad f/|grad f|.
    mean_error, gaussian_error: (n,) proved bounds of how far `mean` and `gaussian` may be off, as
        far as the field states the errors of its derivatives; infinite where they are NaN.
    """

    mean: FloatArray
    gaussian: FloatArray
    normal: FloatArray
    mean_error: FloatArray
    gaussian_error: FloatArray


@refuses_derivatives
def curvature(field: Field, points: Any, *, precision: Precision = "double") -> Curvatures:
    """Mean and Gaussian curvature of the level sets of a field through points (n, 3).

    The derivative of n = grad f/|grad f| along a tangent u of the level set has the tangential
    part (A u)/|grad f|, A the Hessian; its component along n is zero, for |n| = 1. So with an
    orthonormal frame (u, v) of the tangent plane the shape operator is S = (u, v)^T A (u, v) /
    |grad f|, and

        mean = tr S/2 = (tr A - n.An)/(2 |grad f|) = (div n)/2,
        gaussian = det S = n.adj(A)n/|grad f|^2.

    Of a sum over a tree (`BatchedField`) both derivatives have an error that the field states.
    Where it leaves the mean curvature uncertain by more than a thousandth of itself, or of one over
    the size of the surface, clusters are taken as a whole only from farther away, up to the sum of
    all terms one by one. What remains is in `mean_error` and `gaussian_error` (`_bounds`).

    Raises:
        NotImplementedError: the field has no second derivatives.
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers.
    """
    check_is_field(field)
    backend = choose_backend(precision)
    if not isinstance(field, BatchedField):
        prepared = field.prepare(backend)

        def directly(p: Vec3) -> tuple[Real | Vec3, ...]:
            sample = prepared.evaluate(p)
            rows = prepared.hessian(p)
            errors = prepared.derivative_errors(p, sample)
            return _Derivatives(backend, sample.gradient, rows, *errors).bent()

        *found, _ = in_batches(backend, directly, points)
        return Curvatures(*found)

    def by_tree(p: Vec3, closer: Real) -> tuple[Real | Vec3, ...]:
        at = field.values_at(p, 2, closer)
        if at.gradient is None or at.hessian is None:
            raise RuntimeError(f"{type(field).__name__}: values_at(x, 2) gave no derivatives")
        rows = at.hessian.rows(backend.Array3f)
        return _Derivatives(backend, at.gradient, rows, at.gradient_error, at.hessian_error).bent()

    return _refined(backend, field, by_tree, points)


def _refined(
    backend: Backend,
    field: BatchedField,
    by_tree: Callable[[Vec3, Real], tuple[Real | Vec3, ...]],
    points: Any,
) -> Curvatures:
    """The curvatures by a tree that is looked at more closely where the error is too large."""

    def at(closer: float) -> Callable[[Vec3], tuple[Real | Vec3, ...]]:
        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            return by_tree(p, dr.opaque(backend.Float, closer))

        return compute

    *found, is_truncated = in_batches(backend, at(_CLOSER[0]), points)
    x = np.asarray(points, np.float64)
    flat = _ACCURACY / _size(field, x)
    for closer in _CLOSER[1:]:
        mean, error = found[0], found[3]
        with np.errstate(invalid="ignore"):
            good = error <= np.maximum(_ACCURACY * np.abs(mean), flat)
        rows = np.flatnonzero(~good & (is_truncated > 0))
        if not rows.size:
            break
        *closely, is_truncated[rows] = in_batches(backend, at(closer), x[rows])
        for whole, part in zip(found, closely, strict=True):
            whole[rows] = part
    return Curvatures(*found)


def _size(field: BatchedField, points: FloatArray) -> float:
    """The size of the surface: of the box that holds it, else the extent of the points."""
    volume = field.extent((field.default_level,))
    if volume is not None:
        lower, upper = volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.abs(points).max(initial=0.0)), 1e-30)


@dataclass(frozen=True)
class _Derivatives:
    """Gradient and rows of the Hessian, and bounds of their errors: of the length of one and the
    spectral norm of the other."""

    backend: Backend
    gradient: Vec3
    rows: tuple[Vec3, Vec3, Vec3]
    gradient_error: Real
    hessian_error: Real

    def bent(self) -> tuple[Real | Vec3, ...]:
        """Mean, Gaussian curvature and normal, the two errors, and 0 where the field states that
        its derivatives are exact, else 1.

        Bounds. Let g, A be the derivatives at hand, G = |g|, T = tr M and D = det M of the matrix
        M = (u, v)^T A (u, v), so that mean H = T/(2G) and Gaussian K = D/G^2. Let g', A' be the
        true ones, |g' - g| <= c < G and |A' - A| <= h in the spectral norm; T', D', .. theirs. Then
        G' >= G - c, and n' is at an angle t <= pi/2 to n with sin t <= c/G =: s. Let S be at least
        the range of A's eigenvalues: sqrt(2) |A - (tr A/3) 1|_F, as (a-b)^2 <= 2 (a^2 + b^2).

        - T = tr A - n.An. nn^T - n'n'^T has the eigenvalues sin t, -sin t and 0, the first two with
          unit eigenvectors p, q: |n.An - n'.An'| = sin t |p.Ap - q.Aq| <= s S. The projection
          1 - n'n'^T has two eigenvalues 1: |tr((1 - n'n'^T)(A - A'))| <= 2 h. So |T - T'| <= s S +
          2 h, and as |1/G' - 1/G| <= c/(G (G - c)), |H - H'| <= ((s S + 2 h)/2 + |H| c)/(G - c).
        - Let the rotation R by the angle t take n to n'. M' is that of R^T A' R in the same frame
          (its determinant does not depend on the frame). With m the middle of A's range,
          |A - R^T A R| = |(R - 1)(A - m) - (A - m)(R - 1)| <= 2 |R - 1| S/2, |R - 1| = 2 sin(t/2) =
          sin t sqrt(2/(1 + cos t)) <= s sqrt(2/(1 + sqrt(1 - s^2))) =: r. So E = M' - M is at most
          e := r S + h, and det(M + E) = det M + tr(adj(M) E) + det E differs from det M by at most
          e (|a| + |b|) + e^2, a and b the eigenvalues of M, |a| + |b| = max(|T|, |a - b|).
          With 1/G'^2 - 1/G^2 <= c (2G - c)/(G^2 (G - c)^2):
          |K - K'| <= (e (|a| + |b|) + e^2 + |K| c (2G - c))/(G - c)^2.

        The arithmetic here is that of derivatives changed by a few epsilons of themselves, which
        are added to c and h.
        """
        real = self.backend.Float
        x, y, z = self.rows
        plane = TangentPlane.of(self.gradient)
        uu, vv, uv = plane.restricted(self.rows)
        share = 1 / plane.gradient_norm
        mean = 0.5 * (uu + vv) * share
        gaussian = (uu * share) * (vv * share) - (uv * share) * (uv * share)

        rounding = _ROUNDING * self.backend.epsilon
        third = (x.x + y.y + z.z) / 3
        off = dr.square(x.y) + dr.square(x.z) + dr.square(y.z)
        diagonal = dr.square(x.x - third) + dr.square(y.y - third) + dr.square(z.z - third)
        deviator = dr.sqrt(diagonal + 2 * off)
        size = deviator + math.sqrt(3) * dr.abs(third)
        wide = math.sqrt(2) * deviator + rounding * size
        c = dr.fma(rounding, plane.gradient_norm, real(self.gradient_error))
        h = dr.fma(rounding, size, real(self.hessian_error))
        left = plane.gradient_norm - c
        known = (left > 0) & dr.isfinite(mean) & dr.isfinite(gaussian)
        s = fmin(c * share, real(1))
        mean_error = (0.5 * s * wide + h + dr.abs(mean) * c) / left
        e = dr.fma(s * dr.sqrt(2 / (1 + dr.sqrt(1 - s * s))), wide, h)
        both = fmax(dr.abs(uu + vv), dr.sqrt(dr.square(uu - vv) + 4 * uv * uv))
        moved = e * (both + e) + dr.abs(gaussian) * c * (2 * plane.gradient_norm - c)
        gaussian_error = moved / (left * left)
        is_exact = (real(self.gradient_error) <= 0) & (real(self.hessian_error) <= 0)
        return (
            dr.select(known, mean, dr.nan),
            dr.select(known, gaussian, dr.nan),
            dr.select(known, plane.n, dr.nan),
            _or_infinite(known, mean_error),
            _or_infinite(known, gaussian_error),
            dr.select(is_exact, real(0), 1),
        )


def _or_infinite(known: Any, error: Real) -> Real:
    """Errors, rounded up; infinite where nothing is known."""
    return dr.select(known & dr.isfinite(error), error * (1 + 1e-5), dr.inf)
