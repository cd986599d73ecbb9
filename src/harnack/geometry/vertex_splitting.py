"""Splitting the vertices of a triangle mesh, so that a vertex may have several normals or colors:
at a crease, a file needs a vertex of its own for each side. A corner is one of the three corners
of a face; row i, column k of an array (m, 3) belongs to corner k of face i. All copies of a vertex
stay at its position, so a mesh that was closed is closed by positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    half_edges,
    row_dots,
    unique_with_inverse,
    unit_normals,
    unit_rows,
)
from harnack.geometry.neighborhoods import connected_groups

__all__ = ["SplitVertices", "crease_sides", "normals_of_sides"]

# An edge is a crease if the cosine of the angle between its faces' normals is below this.
_CREASE_COSINE = math.cos(math.radians(30))
# Normals that are given are used where they are within 20 degrees of the faces' mean normal.
_LEAST_AGREEMENT = math.cos(math.radians(20))


@dataclass(frozen=True, eq=False)
class SplitVertices:
    """The vertices of a mesh after some of them were split.

    vertex: (k,) for each new vertex, the index of the old one; in increasing order.
    faces: (m, 3) the corners of the faces, as indices of new vertices.
    """

    vertex: IntArray
    faces: IntArray

    @classmethod
    def by_labels(cls, faces: IntArray, labels: IntArray) -> SplitVertices:
        """Split vertices so that all corners of a new vertex have the same label. Vertices without
        a face are left out.

        faces: (m, 3) the corners of the faces, as indices of vertices.
        labels: (m, 3) a nonnegative integer for each corner.
        """
        count = int(labels.max(initial=0)) + 1
        keys, index, _, _ = unique_with_inverse((faces * count + labels).ravel())
        return cls(keys // count, index.reshape(-1, 3))


def crease_sides(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Return the side (m, 3) of each corner, an integer: corners of a vertex are on the same side
    if a path leads from face to face around the vertex, across no crease and no boundary. Creases
    are edges whose two faces have normals more than 30 degrees apart, and edges that do not have
    exactly two faces.

    vertices, faces: (n, 3), (m, 3) the mesh.
    """
    count = len(faces)
    pairs = half_edges(faces)
    first, second = Edges.of(pairs).paired_half_edges().T
    normals = unit_normals(vertices[faces])
    # Half-edge k m + i runs from corner k of face i to its corner k + 1.
    is_smooth = row_dots(normals[first % count], normals[second % count]) >= _CREASE_COSINE
    first, second = first[is_smooth], second[is_smooth]
    joined: list[IntArray] = []
    for end in (0, 1):
        corner = 3 * (first % count) + (first // count + end) % 3
        # The other face runs the edge in the opposite direction, if the two agree on their sides.
        is_opposite = pairs[second, 0] != pairs[first, 0]
        other_end = np.where(is_opposite, 1 - end, end)
        other = 3 * (second % count) + (second // count + other_end) % 3
        joined.append(np.stack([corner, other], axis=1))
    return connected_groups(np.concatenate(joined), 3 * count).reshape(-1, 3)


def normals_of_sides(
    vertices: FloatArray, faces: IntArray, split: SplitVertices, given: FloatArray | None = None
) -> FloatArray:
    """Return unit normals (k, 3) at the vertices of a split mesh: the mean of the normals of a
    vertex's faces, weighted by their angles there (Thürmer and Wüthrich 1998); 0 where they cancel.

    vertices, faces: (n, 3), (m, 3) the mesh before it was split.
    split: its split vertices, k of them.
    given: (n, 3) better normals at the vertices of the mesh, of any length and of either sign. One
        is used where it is finite and, with one of both signs, within 20 degrees of the mean.
    """
    corners = vertices[faces]
    face_normals = unit_normals(corners)
    sums = np.zeros((len(split.vertex), 3))
    for k in range(3):
        to_next = unit_rows(corners[:, (k + 1) % 3] - corners[:, k])
        to_last = unit_rows(corners[:, (k + 2) % 3] - corners[:, k])
        angle = np.arccos(np.clip(row_dots(to_next, to_last), -1.0, 1.0))
        np.add.at(sums, split.faces[:, k], angle[:, None] * face_normals)
    mean = unit_rows(sums)
    if given is None:
        return mean
    candidates = given[split.vertex]
    # First divided by their largest components, so that no square overflows.
    largest = np.abs(candidates).max(axis=1)
    is_usable = np.isfinite(largest) & (largest > 0)
    candidates = np.where(is_usable[:, None], candidates, 1.0)
    largest = np.where(is_usable, largest, 1.0)
    candidates = unit_rows(candidates / largest[:, None])
    agreement = np.where(is_usable, row_dots(candidates, mean), 0.0)
    candidates = np.where((agreement < 0)[:, None], -candidates, candidates)
    return np.where((np.abs(agreement) > _LEAST_AGREEMENT)[:, None], candidates, mean)
