"""What surface files hold, whatever their format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.files.file_format import Contents
from harnack.geometry.convex_volume import FloatArray
from harnack.geometry.meshes import IntArray
from harnack.geometry.polygons import triangulate

__all__ = ["Parts", "Polygons", "parts_of_contents", "triangles"]


@dataclass(frozen=True, eq=False)
class Polygons:
    """Faces with equally many corners. numbers: (m,) in the file. corners: (m, k) of vertices."""

    numbers: IntArray
    corners: IntArray


@dataclass(frozen=True, eq=False)
class Parts:
    """vertices: (n, 3), finite. normals: (n, 3) or none. Indices of corners lie in [0, n).

    has_lines: whether the file holds polylines or edges as well.
    """

    vertices: FloatArray
    normals: FloatArray | None = None
    polygons: tuple[Polygons, ...] = ()
    has_lines: bool = False


def parts_of_contents(contents: Contents) -> Parts:
    """Vertices and faces, the latter sorted by how many corners they have."""
    sizes = np.array([len(face.indices) for face in contents.faces], dtype=np.int64)
    groups: list[Polygons] = []
    for size in np.unique(sizes):
        numbers = np.flatnonzero(sizes == size)
        corners = np.array([contents.faces[k].indices for k in numbers], dtype=np.int64)
        if size >= 3:
            groups.append(Polygons(numbers, corners))
    return Parts(contents.vertices, None, tuple(groups), bool(contents.polylines))


def triangles(parts: Parts) -> IntArray:
    """All faces cut into triangles (m, 3), in the order of the file.

    Raises:
        MeshError: as `triangulate`.
    """
    cut = [triangulate(parts.vertices, group.corners) for group in parts.polygons]
    if len(cut) == 1:
        return cut[0]
    of_face = [np.repeat(g.numbers, g.corners.shape[1] - 2) for g in parts.polygons]
    if not cut:
        return np.zeros((0, 3), dtype=np.int64)
    return np.concatenate(cut)[np.argsort(np.concatenate(of_face), kind="stable")]
