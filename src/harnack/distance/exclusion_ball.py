"""The ball about a closest point of a level set that is proved to hold no nearer one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr

from harnack.backend.elementary import fmax, fmin, safe_norm
from harnack.distance.cell_classification import taylor_remainder
from harnack.distance.tangent_plane import SymmetricEigen2, TangentPlane, matvec

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields.field import Sample

    Rows: TypeAlias = tuple[Vec3, Vec3, Vec3]

__all__ = ["exclusion_radius"]

# Radii that are tried, in units of the distance of the surface point: powers of two.
_RADIUS_EXPONENTS = range(8, -12, -1)
_PROOF_MARGIN = 1 / 64
"""The smallest value that has to remain of 1 in the proof: it covers the rounding of second
derivatives, and that x - y is at right angles to the surface only up to the square root of
epsilon."""


def exclusion_radius(sample: Sample, rows: Rows | None, x: Vec3, y: Vec3) -> Real:
    """Radius of a ball about y in which no surface point is nearer to x than y; 0 if none is
    proved. x - y is normal to the surface at y.

    sample: f at y, without rounding errors.
    rows: of the Hessian of f at y; None if it is not known.

    Proof. Let y + w be a point of the surface, |w| <= r, n = grad f/|g| and x = y + d n, where f
    is taken with the other sign if x is on the other side. With |f(y + w) - f(y) - g . w| <=
    R1 |w|^2/r^2 (`taylor_remainder` falls at least as the square), |n . w| <= c |w|^2,
    c = R1/(|g| r^2). So |x - y - w|^2 = d^2 - 2 d n . w + |w|^2 >= d^2 + |w|^2 (1 - 2 d c).

    With second derivatives H: -n . w |g| is w.Hw/2 plus a remainder of at most R2 |w|^3/r^3. Let t
    be the part of w along the tangent plane, k the minimum of 0 and the eigenvalues of H in that
    plane, a = |Hn - (n.Hn) n|, b = |n.Hn|. As |n . w| <= c r |w|,

        w.Hw >= k |t|^2 - 2 |n . w| |t| a - (n . w)^2 b >= |w|^2 (k - 2 c r a - c^2 r^2 b),

    so that in the inequality above 1 - 2 d c may be replaced by
    1 + d/|g| (k - 2 c r a - c^2 r^2 b - 2 R2/r^2). Here c also is at most (|H|/2 + R2/r^2)/|g|.
    """
    slope, d = safe_norm(sample.gradient), safe_norm(x - y)
    hessian = None if rows is None else _HessianBounds.of(sample, rows, x - y)
    best = 0 * d
    for exponent in _RADIUS_EXPONENTS:
        r = fmax(d, 1e-12) * 2.0**exponent
        first = taylor_remainder(sample, r) / (r * r)
        margin = 1 - 2 * d * first / slope
        if hessian is not None:
            second = taylor_remainder(sample, r, 2) / (r * r)
            c = fmin(first, hessian.half_norm + second) * r / slope
            bound = hessian.least_tangential - c * (2 * hessian.across + c * hessian.along)
            margin = fmax(margin, 1 + d / slope * (bound - 2 * second))
        best = dr.select((best == 0) & (margin >= _PROOF_MARGIN), r, best)
    return best


@dataclass(frozen=True)
class _HessianBounds:
    """Bounds of the Hessian H of f, taken with the sign for which x - y is along the gradient of f:
    the smallest eigenvalue in the tangent plane, if it is negative, else 0; |Hn - (n.Hn) n|;
    |n.Hn|; and an upper bound of half the norm."""

    least_tangential: Real
    across: Real
    along: Real
    half_norm: Real

    @classmethod
    def of(cls, sample: Sample, rows: Rows, direction: Vec3) -> _HessianBounds:
        plane = TangentPlane.of(sample.gradient)
        eigen = SymmetricEigen2.of(*plane.restrict_hessian(rows))
        smallest = dr.select(dr.dot(direction, plane.n) > 0, eigen.smallest, -eigen.largest)
        hn = matvec(rows, plane.n)
        squares = dr.squared_norm(rows[0]) + dr.squared_norm(rows[1]) + dr.squared_norm(rows[2])
        return cls(
            fmin(smallest, 0), safe_norm(dr.cross(hn, plane.n)), dr.abs(dr.dot(hn, plane.n)),
            0.5 * dr.sqrt(squares),
        )  # fmt: skip
