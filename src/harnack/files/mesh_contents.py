"""What writers of meshes are given, and what they share: a mesh with normals and colors, units of
length, and linear colors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.geometry.vertex_splitting import SplitVertices

__all__ = ["METERS", "Colors", "LengthUnit", "MeshContents", "VertexArrays", "linear_colors"]

LengthUnit = Literal["mm", "cm", "m", "in"]

METERS: Mapping[LengthUnit, float] = MappingProxyType(
    {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}
)
"""The length of each unit in meters."""

Colors = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class VertexArrays:
    """A mesh whose normals and colors all belong to vertices, as formats of graphics processors
    want it.

    positions: (k, 3). Several vertices may be at the same position.
    faces: (m, 3) indices of vertices.
    normals: (k, 3) unit normals, or None.
    colors: (k, 4) red, green, blue and opacity in bytes, of sRGB; or None.
    """

    positions: FloatArray
    faces: IntArray
    normals: FloatArray | None
    colors: Colors | None


@dataclass(frozen=True, eq=False)
class MeshContents:
    """A mesh that is to be written.

    vertices, faces: (n, 3), (m, 3).
    is_closed: whether every edge has two faces.
    sides: how vertices are split where the mesh has creases; by itself they are not.
    normals: (k, 3) unit normals at the k vertices of `sides`, or None.
    vertex_colors: (n, 4) red, green, blue and opacity of vertices in bytes, of sRGB; or None.
    face_colors: (m, 4) the same of faces. At most one of both is not None.
    """

    vertices: FloatArray
    faces: IntArray
    is_closed: bool
    sides: SplitVertices
    normals: FloatArray | None = None
    vertex_colors: Colors | None = None
    face_colors: Colors | None = None

    def at_vertices(self) -> VertexArrays:
        """Return the mesh with its vertices split so that each has one normal and one color."""
        vertex, faces, normals = self.sides.vertex, self.sides.faces, self.normals
        if self.face_colors is None:
            colors = None if self.vertex_colors is None else self.vertex_colors[vertex]
            return VertexArrays(self.vertices[vertex], faces, normals, colors)
        distinct, color_of_face = np.unique(self.face_colors, axis=0, return_inverse=True)
        labels = np.repeat(color_of_face.reshape(-1, 1), 3, axis=1)
        by_color = SplitVertices.by_labels(faces, labels)
        color_of_vertex = np.empty(len(by_color.vertex), np.int64)
        color_of_vertex[by_color.faces] = labels
        return VertexArrays(
            self.vertices[vertex[by_color.vertex]],
            by_color.faces,
            None if normals is None else normals[by_color.vertex],
            distinct[color_of_vertex],
        )


def linear_colors(colors: Colors) -> FloatArray:
    """Return colors (n, 4) in bytes of sRGB as linear ones from 0 to 1, by IEC 61966-2-1. The
    fourth column, the opacity, is linear already."""
    values = colors / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    linear[:, 3] = values[:, 3]
    return linear
