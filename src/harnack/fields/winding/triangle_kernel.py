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

from harnack.fields.edges.edge_lift import LiftedEdge
from harnack.tree.triangles import EDGES, INDEX, PARITY, Frame, Upwards, corners_of

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

# The first column of a record behind those of `tree.triangles`: 1 where an edge is singular.
SINGULAR = EDGES + 3
# The corners that edges join, and whether they run as the triangle does.
_EDGES = ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0))


@dataclass(frozen=True)
class NearEdge:
    """An edge of a triangle. is_singular: whether the mesh ends there."""

    edge: LiftedEdge
    is_singular: Mask

    def is_open(self, reach: Real) -> Mask:
        """Whether the edge may be part of the boundary of the triangles near x.

        It is not if it is nearer than (reach - 1)/2 times its length L and not singular: a far
        node with a triangle at it has radius R >= L/2 and is farther than reach R, hence the edge
        farther than (reach - 1) R. So all triangles at it are near, and they cancel there.
        """
        square, inverse = self.edge.edge.square, self.edge.edge.inverse
        closed = ~self.is_singular & (square * inverse < dr.square(0.5 * (reach - 1)))
        return (inverse > 0) & ~closed


def edges_of(row: list[Real], x: Vec3, frame: Frame | Upwards) -> Iterator[NearEdge]:
    """The edges of the triangle of a record, seen from x; there are none in an empty slot."""
    ends = corners_of(row, cast("Any", type(x)))
    for k, (i, j, sign) in enumerate(_EDGES):
        inverse = dr.select(row[INDEX] >= 0, row[EDGES + k], 0)
        edge = LiftedEdge.between(ends[i], ends[j], sign * row[PARITY], inverse, frame, x)
        yield NearEdge(edge, row[SINGULAR + k] > 0)
