"""Tetrahedra between points, with their edges numbered: Delaunay's, by Qhull."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.edges import Edges, IntArray, edge_keys

__all__ = ["Tetrahedra", "delaunay"]

_PAIRS = tuple(itertools.combinations(range(4), 2))


@dataclass(frozen=True)
class Tetrahedra:
    """points: (n, 3). corners: (m, 4) indices of points.
    ends: (k, 2) of all edges, the lower index first. edges: (m, 6) indices of edges, for the pairs
    of corners (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3).
    """

    points: FloatArray
    corners: IntArray
    ends: IntArray
    edges: IntArray

    @classmethod
    def of(cls, points: FloatArray, corners: IntArray) -> Tetrahedra:
        """With their edges numbered."""
        edges = Edges.of(np.concatenate([corners[:, pair] for pair in _PAIRS]))
        return cls(points, corners, edges.ends, edges.index.reshape(len(_PAIRS), -1).T)

    def edge_between(self, i: int, j: int, rows: IntArray) -> tuple[IntArray, IntArray]:
        """For tetrahedra `rows`, the edge between corners i and j, and its direction: 1 if it leads
        from i to j, else -1."""
        edge = self.edges[rows, _PAIRS.index((min(i, j), max(i, j)))]
        return edge, np.where(self.ends[edge, 0] == self.corners[rows, i], 1, -1)

    def has_edges(self, pairs: IntArray) -> BoolArray:
        """(k,) whether there are edges between pairs (k, 2) of points."""
        n = len(self.points)
        return np.isin(edge_keys(pairs, n), edge_keys(self.ends, n))


def delaunay(points: FloatArray) -> Tetrahedra:
    """The Delaunay tetrahedra of points (n, 3) in general position, but that many may lie on the
    faces of a box.

    Eight points far away are added and left out again with their tetrahedra: Qhull takes long over
    a hull that is flat.
    """
    import scipy.spatial  # here: half a second that few need

    qhull: Any = scipy.spatial
    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    around = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) @ turn
    n = len(points)
    # About the middle, so that Qhull does not round far from the origin.
    together = np.concatenate([points - middle, 20 * size * around])
    corners: IntArray = qhull.Delaunay(together).simplices.astype(np.int64)
    corners = corners[(corners < n).all(axis=1)]
    return Tetrahedra.of(points, corners)
