"""Welding of meshes: vertices at the same position, up to rounding, are joined.

Programs compute a corner once for each face around it, and may get 0 for one face and 2.7e-16 for
another. As edges are compared by index, such faces would not be neighbors. So corners at open edges
are joined if rounding explains their distance; all others stay as they are, and so does a closed
mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harnack.backend.validation import FloatArray, IntArray
from harnack.geometry.boundary_edges import NetFaces, net_faces, singular_edges, weld_vertices
from harnack.geometry.meshes import zero_area_faces

__all__ = ["Welded", "connected_groups", "pairs_within", "rounding_of"]

# The distance, in units in the last place of the largest coordinate, that rounding explains.
_UNITS = 4
# Rounding explains no distance that is more than this fraction of the shortest edge there.
_MAX_EDGE_FRACTION = 1e-3


def rounding_of(vertices: FloatArray) -> float:
    """The distance by which rounding may separate corners at the same position: four units in the
    last place of the largest coordinate, of single precision if all coordinates are numbers of
    single precision."""
    single = vertices.astype(np.float32)
    precision = np.float32 if (single == vertices).all() else np.float64
    return _UNITS * float(np.finfo(precision).eps) * float(np.abs(vertices).max(initial=0.0))


@dataclass(frozen=True)
class Welded:
    """A mesh after welding.

    index: (n,) the vertex that each vertex was joined to: the first at exactly its position, or the
        first of the positions that rounding separates.
    net: the faces between these vertices, duplicates added up (`net_faces`).
    edges, weights: the edges at which these faces do not cancel (`singular_edges`).
    rounded: the number of positions that were joined with others from which rounding separates
        them.
    """

    index: IntArray
    net: NetFaces
    edges: IntArray
    weights: IntArray
    rounded: int

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> Welded:
        """Weld vertices (n, 3) of faces (m, 3).

        Corners are joined if they are nearer to each other than `rounding_of` and than a thousandth
        of the edges there, if edges at them do not cancel, and if joining leaves fewer such edges.
        No face loses its area, or two of its corners to the same position: where a face would, the
        corners that it touches stay apart. So the number of faces is the same as before, except for
        faces that cancel; and a wider gap stays, as two corners are joined only if they are as near
        as two results of the same computation.
        """
        welded = cls._by(weld_vertices(vertices), vertices, faces, 0)
        if not len(welded.edges):
            return welded
        joined = _joined_by_rounding(vertices, welded.net.faces, np.unique(welded.edges))
        count = int((joined != np.arange(len(vertices))).sum())
        if not count:
            return welded
        closer = cls._by(joined[welded.index], vertices, faces, count)
        return closer if closer.weights.sum() < welded.weights.sum() else welded

    @classmethod
    def _by(cls, index: IntArray, vertices: FloatArray, faces: IntArray, rounded: int) -> Welded:
        net = net_faces(index[faces])
        return cls(index, net, *singular_edges(net.faces, net.multiplicity), rounded)


def _joined_by_rounding(x: FloatArray, faces: IntArray, places: IntArray) -> IntArray:
    """(n,) the vertex that stands for each vertex. Only vertices in `places`, all at different
    positions, are joined."""
    stands = np.arange(len(x))
    pairs = places[pairs_within(x[places], rounding_of(x[faces]))]
    distance = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    corner = x[faces]
    shortest = np.full(len(x), np.inf)
    edges = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).min(axis=1)
    for k in range(3):
        np.minimum.at(shortest, faces[:, k], edges)
    pairs = pairs[distance <= _MAX_EDGE_FRACTION * shortest[pairs].min(axis=1)]
    while len(pairs):
        group = connected_groups(pairs, len(x))
        stands = np.unique(group, return_index=True)[1][group]
        joined = stands[faces]
        changed = np.flatnonzero((joined != faces).any(axis=1))
        vanished = (joined == np.roll(joined, 1, axis=1)).any(axis=1)
        flat = changed[zero_area_faces(x, joined[changed])]
        vanished[np.setdiff1d(flat, zero_area_faces(x, faces))] = True
        if not vanished.any():
            break
        stays = np.unique(joined[vanished])
        pairs = pairs[~np.isin(stands[pairs[:, 0]], stays)]
        stands = np.arange(len(x))
    return stands


def pairs_within(points: FloatArray, distance: float) -> IntArray:
    """(k, 2) indices of the pairs of points (n, 3) that are at most a distance apart."""
    import scipy.spatial  # here: half a second that few need

    spatial = cast("Any", scipy.spatial)
    pairs = spatial.cKDTree(points).query_pairs(distance, output_type="ndarray")
    return np.asarray(pairs, np.int64).reshape(-1, 2)


def connected_groups(pairs: IntArray, count: int) -> IntArray:
    """(count,) the number of the group of each index, where pairs (k, 2) join indices to groups.
    Groups are numbered in the order of their first indices."""
    import scipy.sparse  # here: half a second that few need
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    joined = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return np.asarray(csgraph.connected_components(joined, directed=False)[1], np.int64)
