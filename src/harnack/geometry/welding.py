"""Welds meshes: joins vertices that are at the same position up to rounding. Programs compute a
corner once for each face around it, and may get 0 for one face and 2.7e-16 for another. As edges
are compared by the indices of their ends, such faces would not be neighbors. So vertices at edges
that do not cancel between faces (boundary edges) are joined if rounding explains their distance.
All other vertices, and closed meshes, stay as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend.validation import FloatArray, IntArray
from harnack.geometry.boundary_edges import NetFaces, net_faces, singular_edges, weld_vertices
from harnack.geometry.mesh_edges import has_distinct_corners, shortest_edges_at_vertices
from harnack.geometry.meshes import zero_area_faces
from harnack.geometry.neighborhoods import connected_groups, pairs_within

__all__ = ["Welded", "rounding_of"]

# The distance, in units in the last place of the largest coordinate, that rounding explains.
_MAX_ULPS = 4
# A distance that is more than this fraction of the shortest edge there is never explained by
# rounding.
_MAX_EDGE_FRACTION = 1e-3


def rounding_of(vertices: FloatArray) -> float:
    """The distance by which rounding may separate two vertices that should be at the same position:
    four units in the last place of the largest coordinate of the vertices (n, 3). These are units
    of single precision if all coordinates are numbers of single precision."""
    single = vertices.astype(np.float32)
    precision = np.float32 if (single == vertices).all() else np.float64
    return _MAX_ULPS * float(np.finfo(precision).eps) * float(np.abs(vertices).max(initial=0.0))


@dataclass(frozen=True)
class Welded:
    """A mesh after its vertices at the same position, up to rounding, were joined. An edge (a, b)
    cancels against the same edge run the other way; the edges that are left over are boundary
    edges.

    index: (n,) for each vertex the index of the vertex to which it was joined: the first one at
        exactly its position or, if positions were joined that differ by rounding, the first one at
        any of these.
    net: the faces between these vertices, duplicates added up (`net_faces`).
    edges, weights: the directed edges (k, 2) at which these faces do not cancel, and how often each
        remains (`singular_edges`).
    rounded: the number of positions that were joined with others although they differ by rounding.
    """

    index: IntArray
    net: NetFaces
    edges: IntArray
    weights: IntArray
    rounded: int

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> Welded:
        """Weld the vertices (n, 3) of faces (m, 3).

        Two vertices are joined if both are on edges that do not cancel, and if their distance is at
        most `rounding_of` and at most a thousandth of the shortest edge there. If this does not
        leave fewer edges that do not cancel, only vertices at exactly the same position are joined.
        If a face would lose its area, or two of its corners would become one, the corners of that
        face are not joined. So the number of faces is the same as before, except for faces that
        cancel. Wider gaps stay, as two vertices are joined only if they are as near as two results
        of the same computation.
        """
        # First only vertices at the same position are joined: 0 that differ by rounding.
        welded = cls._from_index(weld_vertices(vertices), vertices, faces, 0)
        # The mesh is closed.
        if not len(welded.edges):
            return welded
        joined = _joined_by_rounding(vertices, welded.net.faces, np.unique(welded.edges))
        count = int((joined != np.arange(len(vertices))).sum())
        if not count:
            return welded
        rounded = cls._from_index(joined[welded.index], vertices, faces, count)
        return rounded if rounded.weights.sum() < welded.weights.sum() else welded

    @classmethod
    def _from_index(
        cls, index: IntArray, vertices: FloatArray, faces: IntArray, rounded: int
    ) -> Welded:
        """The welded mesh in which vertex k is replaced by vertex index[k].

        rounded: the number of positions that were joined although they differ by rounding.
        """
        net = net_faces(index[faces])
        return cls(index, net, *singular_edges(net.faces, net.multiplicity), rounded)


def _joined_by_rounding(positions: FloatArray, faces: IntArray, candidates: IntArray) -> IntArray:
    """For each vertex the index (n,) of the vertex to which it is joined, or its own index. Pairs
    of candidates are joined if rounding explains their distance. If a face would then lose its area
    or a corner, the vertices of that face are not joined after all, and the rest is tried again.

    positions: (n, 3) of the vertices.
    faces: (m, 3).
    candidates: (k,) the vertices that may be joined, all at different positions.
    """
    representative = np.arange(len(positions))
    pairs = candidates[pairs_within(positions[candidates], rounding_of(positions[faces]))]
    distance = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    shortest_edge = shortest_edges_at_vertices(positions, faces)
    pairs = pairs[distance <= _MAX_EDGE_FRACTION * shortest_edge[pairs].min(axis=1)]
    while len(pairs):
        group = connected_groups(pairs, len(positions))
        # The first vertex of each group stands for the group.
        representative = np.unique(group, return_index=True)[1][group]
        joined = representative[faces]
        changed_faces = np.flatnonzero((joined != faces).any(axis=1))
        is_degenerate = ~has_distinct_corners(joined)
        # Faces that lose their area by the joining.
        new_flat = changed_faces[zero_area_faces(positions, joined[changed_faces])]
        is_degenerate[np.setdiff1d(new_flat, zero_area_faces(positions, faces))] = True
        if not is_degenerate.any():
            break
        kept_apart = np.unique(joined[is_degenerate])
        pairs = pairs[~np.isin(representative[pairs[:, 0]], kept_apart)]
        representative = np.arange(len(positions))
    return representative
