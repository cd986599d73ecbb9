"""Triangle meshes: the vertices and faces that all ways of meshing return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray, IntArray

__all__ = ["TriangleMesh"]


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh in space.

    vertices: (n, 3).
    faces: (m, 3) the indices of the vertices of each face, counter-clockwise as seen from the
        outside, where the meshed function is larger."""

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def without_unused_vertices(cls, vertices: FloatArray, faces: IntArray) -> TriangleMesh:
        """The mesh of `faces` (m, 3) with only those of the `vertices` (n, 3) that a face uses.
        Their order stays; faces are renumbered."""
        used = np.flatnonzero(np.bincount(faces.ravel()))
        index = np.full(len(vertices), -1, np.int64)
        index[used] = np.arange(len(used))
        return cls(vertices[used], index[faces])

    def reversed(self) -> TriangleMesh:
        """The same mesh with the orientation of all faces reversed."""
        return TriangleMesh(self.vertices, self.faces[:, ::-1])
