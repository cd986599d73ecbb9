"""Triangles near a point: what the edges of their union add to the winding number.

By Stokes' theorem the field of a set of triangles is that of the boundary of their union, so only
edges at which they do not cancel are summed up. `edge_lift` says how crossings and edges together
make the winding number: both are decided by the same bits, so that nothing is rounded beside an
edge that two triangles share.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.fields.edges.edge_field import edge_field
from harnack.fields.edges.edge_hessian import edge_rates
from harnack.fields.edges.edge_lift import LiftedProduct, edge_factor
from harnack.fields.symmetric import SymmetricSum
from harnack.tree.nearest import squared_distance_to_segment
from harnack.tree.triangles import EDGES, INDEX, PARITY, Frame, Upwards, corners_of

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

# The first column of a record behind those of `tree.triangles`: 1 where an edge is singular.
SINGULAR = EDGES + 3
# The corners that edges join, and whether they run as the triangle does.
_EDGES = ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0))


@dataclass(frozen=True)
class NearEdge:
    """An edge of a triangle, seen from x.

    a, b: its ends less x. e: from a to b, without the rounding of x. lengths: |a| and |b|. seen: a
    and b across the frame's rays and along them. way: 1 or -1, as the triangle runs from a to b or
    back. inverse: 1/length^2, or 0 for no edge. square: that of its distance from x. is_singular:
    whether the mesh ends there.
    """

    a: Vec3
    b: Vec3
    e: Vec3
    lengths: tuple[Real, Real]
    seen: tuple[Vec3, Vec3]
    way: Real
    inverse: Real
    square: Real
    is_singular: Mask

    def is_open(self, reach: Real) -> Mask:
        """Whether the edge may be part of the boundary of the triangles near x.

        It is not if it is nearer than (reach - 1)/2 times its length L and not singular: a far
        node with a triangle at it has radius R >= L/2 and is farther than reach R, hence the edge
        farther than (reach - 1) R. So all triangles at it are near, and they cancel there.
        """
        closed = ~self.is_singular & (self.square * self.inverse < dr.square(0.5 * (reach - 1)))
        return (self.inverse > 0) & ~closed

    def times(self, product: LiftedProduct, active: Mask) -> LiftedProduct:
        """The product with this edge's factor, where active."""
        re, im = edge_factor(*self.seen, *self.lengths)
        return product.times(dr.select(active, re, 1), dr.select(active, self.way * im, 0))

    def gradient(self) -> Vec3:
        """Of its solid angle: Biot and Savart's field (paper, Eq. 11)."""
        c, weight = edge_field(self.a, self.b, *self.lengths)
        return (self.way * weight) * c

    def add_hessian(self, total: SymmetricSum, active: Mask) -> SymmetricSum:
        """Its part of the Hessian of the solid angle added, where active."""
        c, rate = edge_rates(self.a, self.e, self.inverse)
        return total.plus(dr.select(active, self.way * c, 0), dr.select(active, rate, 0))


def edges_of(row: list[Real], x: Vec3, frame: Frame | Upwards) -> Iterator[NearEdge]:
    """The edges of the triangle of a record, seen from x; there are none in an empty slot."""
    vector = cast("Any", type(x))
    ends = corners_of(row, vector)
    corners = [p - x for p in ends]
    lengths = [dr.norm(a) for a in corners]
    pairs = zip(ends, corners, strict=True)
    seen = [vector(*frame.across(p), frame.component(a)) for p, a in pairs]
    for k, (i, j, sign) in enumerate(_EDGES):
        a, b, inverse = corners[i], corners[j], dr.select(row[INDEX] >= 0, row[EDGES + k], 0)
        yield NearEdge(
            a, b, ends[j] - ends[i], (lengths[i], lengths[j]), (seen[i], seen[j]),
            sign * row[PARITY], inverse, squared_distance_to_segment(a, b - a, inverse),
            row[SINGULAR + k] > 0,
        )  # fmt: skip
