"""How a level set bends: mean and Gaussian curvature from first and second derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harnack.backend import choose_backend
from harnack.distance.batches import FloatArray, in_batches
from harnack.distance.tangent import TangentPlane

if TYPE_CHECKING:
    from harnack.backend import Precision, Real, Vec3
    from harnack.fields.field import Field

__all__ = ["Curvatures", "curvature"]


@dataclass(frozen=True)
class Curvatures:
    """Of the level sets through n points. NaN where the gradient is zero: no surface there.

    mean: (n,) half the divergence of the normal, 1/length. Its sign is the normal's: a sphere of
        radius r has 1/r if f grows outward, -1/r if f grows inward.
    gaussian: (n,) product of the principal curvatures, 1/length^2; the same for f and -f.
    normal: (n, 3) grad f/|grad f|.
    """

    mean: FloatArray
    gaussian: FloatArray
    normal: FloatArray


def curvature(field: Field, points: Any, *, precision: Precision = "double") -> Curvatures:
    """Mean and Gaussian curvature of the level sets of a field through points (n, 3).

    The derivative of n = grad f/|grad f| along a tangent u of the level set has the tangential
    part (A u)/|grad f|, A the Hessian; its component along n is zero, for |n| = 1. So with an
    orthonormal frame (u, v) of the tangent plane the shape operator is S = (u, v)^T A (u, v) /
    |grad f|, and

        mean = tr S/2 = (tr A - n.An)/(2 |grad f|) = (div n)/2,
        gaussian = det S = n.adj(A)n/|grad f|^2.

    Raises NotImplementedError for a field without second derivatives, TypeError or ValueError for
    points that are not an (n, 3) array of finite numbers.
    """
    backend = choose_backend(precision)
    prepared = field.prepare(backend)

    def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
        plane = TangentPlane.of(prepared.evaluate(p).gradient)
        uu, vv, uv = plane.restricted(prepared.hessian(p))
        share = 1 / plane.steepness
        mean = 0.5 * (uu + vv) * share
        return mean, (uu * share) * (vv * share) - (uv * share) * (uv * share), plane.n

    return Curvatures(*in_batches(backend, compute, points))
