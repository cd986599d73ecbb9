"""A proof about the point y of a level set that is closest to a query x: a ball about y holds no
point of the level set that is nearer to x than y. f is the function of the level set."""

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

# Powers of two: the radii that are tried, in units of the distance of the surface point.
_RADIUS_EXPONENTS = range(8, -12, -1)
_PROOF_MARGIN = 1 / 64
"""The smallest value that has to remain of 1 in the proof: it covers the rounding of second
derivatives, and that x - y is at right angles to the surface only up to the square root of
epsilon."""


def exclusion_radius(sample: Sample, rows: Rows | None, x: Vec3, y: Vec3) -> Real:
    """Return the radius of a ball about y in which no surface point is nearer to x than y; 0 if
    none is proved.

    sample: f at y, without rounding errors.
    rows: the rows of the Hessian of f at y; None if it is not known.
    x, y: a query, and a surface point such that x - y is normal to the surface at y.

    Radii r that are powers of two times the distance |x - y| are tried, the largest first.

    Proof. Let g = grad f(y), n = g/|g| and x = y + d n with d >= 0; if x is on the side of smaller
    f, take -f for f. Let y + w be a point of the surface with |w| <= r. Let R1 be the bound of the
    Taylor remainder of degree 1 (`taylor_remainder`) within r. As it falls at least as the square
    of the radius, |f(y + w) - f(y) - g . w| <= R1 |w|^2/r^2, so |n . w| <= c |w|^2 with c = R1/(|g|
    r^2). Hence |x - y - w|^2 = d^2 - 2 d n . w + |w|^2 >= d^2 + |w|^2 (1 - 2 d c).

    With second derivatives H, and R2 the bound of the remainder of degree 2: -n . w |g| is w.Hw/2
    plus a remainder of at most R2 |w|^3/r^3. Let t be the part of w along the tangent plane, k the
    minimum of 0 and the eigenvalues of H in that plane, a = |Hn - (n.Hn) n|, b = |n.Hn|. As
    |n . w| <= c r |w|,

        w.Hw >= k |t|^2 - 2 |n . w| |t| a - (n . w)^2 b >= |w|^2 (k - 2 c r a - c^2 r^2 b),

    so that in the inequality above 1 - 2 d c may be replaced by
    1 + d/|g| (k - 2 c r a - c^2 r^2 b - 2 R2/r^2). Here c also is at most (|H|/2 + R2/r^2)/|g|.
    """
    gradient_norm, d = safe_norm(sample.gradient), safe_norm(x - y)
    hessian = None if rows is None else _HessianBounds.of(sample, rows, x - y)
    largest = 0 * d
    for exponent in _RADIUS_EXPONENTS:
        r = fmax(d, 1e-12) * 2.0**exponent  # not 0, as it divides
        # R1/r^2 of the proof; `second_order` is R2/r^2.
        first_order = taylor_remainder(sample, r) / (r * r)
        # By the bounds of first and of second order: |x - y - w|^2 is at least d^2 + margin |w|^2.
        margin = 1 - 2 * d * first_order / gradient_norm
        if hessian is not None:
            # (2: the degree of the Taylor polynomial.)
            second_order = taylor_remainder(sample, r, 2) / (r * r)
            # c r of the proof, a bound of |n . w|/|w|.
            max_slope = fmin(first_order, hessian.half_norm + second_order) * r / gradient_norm
            bound = hessian.least_tangential - max_slope * (
                2 * hessian.across + max_slope * hessian.along
            )
            margin = fmax(margin, 1 + d / gradient_norm * (bound - 2 * second_order))
        # Radii are tried from the largest down; the first that is proved stays.
        largest = dr.select((largest == 0) & (margin >= _PROOF_MARGIN), r, largest)
    return largest


@dataclass(frozen=True)
class _HessianBounds:
    """Bounds of the Hessian H of a function f at a point y of its level set. The sign of f is
    chosen such that the gradient g = |g| n points toward the query x.

    least_tangential: the smallest eigenvalue of H restricted to the tangent plane, or 0 if that is
        positive.
    across: |Hn - (n.Hn) n|.
    along: |n.Hn|.
    half_norm: an upper bound of half the spectral norm of H.
    """

    least_tangential: Real
    across: Real
    along: Real
    half_norm: Real

    @classmethod
    def of(cls, sample: Sample, rows: Rows, to_query: Vec3) -> _HessianBounds:
        """Compute the bounds for the sample of f at y.

        rows: the three rows of the Hessian of f at y.
        to_query: the vector x - y from y to the query x.
        """
        plane = TangentPlane.of(sample.gradient)
        eigen = SymmetricEigen2.of(*plane.restrict_hessian(rows))
        # With the other sign of f the eigenvalues change signs and places.
        smallest = dr.select(dr.dot(to_query, plane.n) > 0, eigen.smallest, -eigen.largest)
        h_times_n = matvec(rows, plane.n)
        # The Frobenius norm is at least the spectral norm.
        # (Below, the cross product with n has the length of the part of Hn at right angles to n.)
        squares = dr.squared_norm(rows[0]) + dr.squared_norm(rows[1]) + dr.squared_norm(rows[2])
        return cls(
            fmin(smallest, 0), safe_norm(dr.cross(h_times_n, plane.n)),
            dr.abs(dr.dot(h_times_n, plane.n)), 0.5 * dr.sqrt(squares),
        )  # fmt: skip
