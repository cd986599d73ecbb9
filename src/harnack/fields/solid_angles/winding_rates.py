"""Gradients and Hessians of the winding number w of a mesh at points, from the mesh's boundary
only. The boundary consists of the *singular edges*, at which triangles do not cancel. Off the
triangles w is, up to an integer, the solid angle of these edges over 4 pi. So all surfaces with the
same boundary have the same derivatives. "Rates" are these derivatives.

If a mesh has only small holes, the terms of its triangles nearly cancel, and the truncation error
of a tree over them is many times the gradient. Two other sums have no such error:

- a direct sum over the edges (Biot and Savart's law), for few edges;
- a sum by a tree over *caps*, fans of triangles over the loops that the edges form.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import IntArray
from harnack.fields.solid_angles.winding_mesh import WindingMesh
from harnack.fields.solid_angles.winding_tree import TreeWinding
from harnack.fmm.edge_lift import LiftedEdges, edge_rates
from harnack.fmm.point_values import PointValues, SymmetricMatrix, sharpened
from harnack.fmm.trail_sums import closed_trails
from harnack.fmm.unit_frame import coordinate_rounding

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["BoundaryRates", "with_rates"]

# Up to this number of edges the sum is direct, by experiment: it then takes as long as trees of
# sufficient accuracy.
_FEW = 32_768
# A tree over caps uses the moments of clusters beyond this many times their radius.
_CAPS_ACCURACY = 2.0
# Caps are of use if their area is less than this fraction of the area of the mesh.
_MAX_AREA_RATIO = 0.5


@dataclass(frozen=True)
class BoundaryRates:
    """An object that evaluates the derivatives of the winding number w of a mesh off its triangles,
    in units in which the mesh has a size of about one.

    summed: what is summed: the singular edges; or a tree of caps (triangles that close the loops of
        these edges); or a tree of the mesh's triangles; None for a closed mesh, where derivatives
        are 0.
    """

    summed: LiftedEdges | TreeWinding | None

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, order: int, whole: TreeWinding
    ) -> BoundaryRates:
        """Choose and upload what is summed for the derivatives of w.

        order: the order of the multipoles of a tree over caps.
        whole: a tree over the mesh's triangles. It is used in three cases: it has FMM cells; there
            are more singular edges than triangles, as in a triangle soup; or caps would have more
            than half of the mesh's area. Otherwise up to 32,768 edges are summed directly, and more
            by a tree over caps.
        """
        if not len(mesh.singular_edges):
            # (None: nothing is summed.)
            return cls(None)
        if whole.cells is not None:
            return cls(whole)
        if len(mesh.singular_edges) <= _FEW:
            return cls(LiftedEdges.upload(backend, mesh.unit_vertices, mesh.singular_edges))
        if len(mesh.singular_edges) > len(mesh.triangles):
            return cls(whole)
        caps = caps_of(mesh)
        if caps.area > _MAX_AREA_RATIO * mesh.area:
            return cls(whole)
        return cls(TreeWinding.of(backend, caps, _CAPS_ACCURACY, order))

    def at(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """The derivatives of w up to order `derivatives` (1 or 2) at points x (3, n), with error
        bounds. The value in the result has no meaning, unless a tree of the mesh's own triangles is
        summed.

        closer: the accuracy scale of a tree; larger is more accurate.
        """
        if isinstance(self.summed, TreeWinding):
            return self.summed.values(x, derivatives, closer)
        real = cast("Any", type(x.x))
        if self.summed is None:
            # Value and its error, gradient, Hessian: all are 0 for a closed mesh.
            return PointValues(
                real(0), real(0), dr.zeros(type(x), dr.width(x)), SymmetricMatrix.zero(real)
            )
        sums = edge_rates(self.summed, x, derivatives)
        # real(0): there is no value to be rounded.
        return sums.values(1 / (4 * math.pi), coordinate_rounding(x), real(0))

    def sharp(self, x: Vec3) -> PointValues:
        """The gradient of w at points x (3, n), with error bounds. The error of the gradient is
        about 1 % of the gradient's length in most places: if it comes from a tree, the accuracy is
        increased until that is so (`sharpened`)."""
        if isinstance(self.summed, TreeWinding):
            return sharpened(lambda points, accuracy: self.at(points, 1, accuracy), x)
        return self.at(x, 1, 1.0)


def with_rates(value: PointValues, rates: PointValues) -> PointValues:
    """Combine two results: the value of `value` and the derivatives of `rates`, each with its error
    bounds."""
    return dataclasses.replace(rates, value=value.value, error=value.error)


def caps_of(mesh: WindingMesh) -> WindingMesh:
    """A mesh of triangles with the same boundary as `mesh`, in the same unit coordinates. They form
    a fan over each of the loops that the singular edges form. The apex of a fan is the mean of the
    loop's vertices; a loop of three vertices is one triangle without apex."""
    loops = simple_loops(mesh.singular_edges)
    centers = [mesh.vertices[loop].mean(axis=0) for loop in loops]
    vertices = np.concatenate([mesh.vertices, centers])
    # The apex of loop k is the vertex len(mesh.vertices) + k.
    fans = [
        loop[None]
        if len(loop) == 3
        else np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), len(mesh.vertices) + k)])
        for k, loop in enumerate(loops)
    ]
    faces = np.concatenate(fans)
    # Every face occurs once, and no vertices are joined.
    ones, ids = np.ones(len(faces), np.int64), np.arange(len(faces))
    welded = np.arange(len(vertices))
    return WindingMesh(
        vertices, faces, ones, ids, mesh.singular_edges, faces, welded, 0, mesh.center, mesh.size
    )


def simple_loops(edges: IntArray) -> list[IntArray]:
    """Divide directed edges (k, 2), which enter each vertex as often as they leave it, into closed
    loops. Each loop is an array of vertex indices without repetition. A walk along the edges cuts
    off a loop as soon as it comes back to a vertex."""
    loops: list[IntArray] = []
    for trail in closed_trails(edges):
        walk: list[int] = []
        place_in_walk: dict[int, int] = {}
        for vertex in trail.tolist():
            if vertex not in place_in_walk:
                place_in_walk[vertex] = len(walk)
                walk.append(vertex)
                continue
            # The walk is back at a vertex: cut the loop off, and go on from that vertex.
            start = place_in_walk[vertex]
            loops.append(np.array(walk[start:], np.int64))
            for dropped in walk[start + 1 :]:
                del place_in_walk[dropped]
            walk = walk[: start + 1]
    return loops
