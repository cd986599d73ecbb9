"""Gradients and Hessians of winding numbers at points: those of the boundary alone.

Off the triangles w is, but for a whole number, the solid angle of its boundary edges over 4 pi. So
all surfaces with these edges have the same derivatives. The triangles of a mesh with small holes
nearly cancel: a tree over them leaves out many times its gradient. Two other sums do not:

- over the edges, one by one (Biot and Savart's law), for few edges;
- of *caps*, fans of triangles over the loops that the edges make, by a tree.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import IntArray
from harnack.fields.batched_fields import PointValues, SymmetricMatrix, sharpened
from harnack.fields.clearance import coordinate_rounding
from harnack.fields.solid_angles.edge_lift import LiftedEdges, edge_rates
from harnack.fields.solid_angles.trail_sums import closed_trails
from harnack.fields.solid_angles.winding_mesh import WindingMesh
from harnack.fields.solid_angles.winding_tree import TreeWinding

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["BoundaryRates", "with_rates"]

# Up to so many edges are summed one by one, by experiment: that takes as long as trees do that are
# looked at closely enough.
_FEW = 32_768
# A tree over caps takes clusters as a whole beyond so many times their radius.
_ACCURACY = 2.0
# Caps are of use if they have less area than this part of the mesh.
_SMALLER = 0.5


@dataclass(frozen=True)
class BoundaryRates:
    """The derivatives of w off the triangles, in units in which the mesh has a size of about one.

    summed: the edges; or a tree of caps, or of the triangles themselves; None of a closed mesh.
    """

    summed: LiftedEdges | TreeWinding | None

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, order: int, whole: TreeWinding
    ) -> BoundaryRates:
        """Of a mesh with a tree over its triangles, which is used where it has cells, and where
        caps would be no smaller, as those of a soup."""
        if not len(mesh.singular_edges):
            return cls(None)
        if whole.cells is not None:
            return cls(whole)
        if len(mesh.singular_edges) <= _FEW:
            return cls(LiftedEdges.upload(backend, mesh.unit_vertices, mesh.singular_edges))
        if len(mesh.singular_edges) > len(mesh.triangles):
            return cls(whole)
        caps = caps_of(mesh)
        if caps.area > _SMALLER * mesh.area:
            return cls(whole)
        return cls(TreeWinding.of(backend, caps, _ACCURACY, order))

    def at(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """The derivatives asked for, at one detail, with a value of no meaning."""
        if isinstance(self.summed, TreeWinding):
            return self.summed.values(x, derivatives, closer)
        real = cast("Any", type(x.x))
        if self.summed is None:
            return PointValues(
                real(0), real(0), dr.zeros(type(x), dr.width(x)), SymmetricMatrix.zero(real)
            )
        sums = edge_rates(self.summed, x, derivatives)
        return sums.values(1 / (4 * math.pi), coordinate_rounding(x), real(0))

    def sharp(self, x: Vec3) -> PointValues:
        """Those of `at` with the gradient to about 1 % of its length (`sharpened`)."""
        if isinstance(self.summed, TreeWinding):
            return sharpened(lambda place, closer: self.at(place, 1, closer), x)
        return self.at(x, 1, 1.0)


def with_rates(value: PointValues, rates: PointValues) -> PointValues:
    """The value of one evaluation with the derivatives of another."""
    return dataclasses.replace(rates, value=value.value, error=value.error)


def caps_of(mesh: WindingMesh) -> WindingMesh:
    """Triangles with the same boundary as a mesh, in the same unit coordinates: a fan over each of
    the loops that its singular edges make, about the middle of the loop's vertices."""
    loops = simple_loops(mesh.singular_edges)
    middles = [mesh.vertices[loop].mean(axis=0) for loop in loops]
    vertices = np.concatenate([mesh.vertices, middles])
    fans = [
        loop[None]
        if len(loop) == 3
        else np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), len(mesh.vertices) + k)])
        for k, loop in enumerate(loops)
    ]
    faces = np.concatenate(fans)
    once, own = np.ones(len(faces), np.int64), np.arange(len(faces))
    welded = np.arange(len(vertices))
    return WindingMesh(
        vertices, faces, once, own, mesh.singular_edges, faces, welded, 0, mesh.center, mesh.size
    )


def simple_loops(edges: IntArray) -> list[IntArray]:
    """Closed directed edges (k, 2) as loops of vertices, each of which comes once in a loop: the
    smallest that a walk along the edges closes."""
    loops: list[IntArray] = []
    for trail in closed_trails(edges):
        path: list[int] = []
        place: dict[int, int] = {}
        for vertex in trail.tolist():
            if vertex not in place:
                place[vertex] = len(path)
                path.append(vertex)
                continue
            start = place[vertex]
            loops.append(np.array(path[start:], np.int64))
            for passed in path[start + 1 :]:
                del place[passed]
            path = path[: start + 1]
    return loops
