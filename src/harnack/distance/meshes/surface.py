"""The level sets of the winding number of a closed mesh: triangles, the nearest of which a tree
finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.distance.meshes.pieces import on_level, pieces_of_faces
from harnack.fields.unit_coordinates import placed, single
from harnack.tree import build_hierarchy
from harnack.tree.nearest import nearest_triangle, square_to_some_vertex
from harnack.tree.triangles import NO_TRIANGLE, TriangleRays, triangle_records

if TYPE_CHECKING:
    from harnack.backend import Backend, Vec3
    from harnack.tracer import LevelSet

__all__ = ["MeshSurface"]

_LEAF_SIZE = 8


@dataclass(frozen=True)
class MeshSurface:
    """Triangles: corners (k, 3, 3) in coordinates of at most about one, centre + size times which
    are the real ones."""

    corners: FloatArray
    centre: FloatArray
    size: float

    @classmethod
    def of(cls, surface: LevelSet) -> MeshSurface | None:
        """The surface, if the field is the winding number of a closed mesh and nothing clips it."""
        mesh = surface.field.closed_mesh()
        if mesh is None or surface.clip is not None or surface.field.domain is not None:
            return None
        vertices, faces = mesh
        low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        size = float(2.0 ** np.ceil(np.log2(0.5 * (high - low).max())))
        centre = single(0.5 * (low + high))
        unit = (vertices - centre) / size
        rays = _tree(choose_backend("double"), unit, faces)
        pieces = pieces_of_faces(rays, unit, faces)
        return cls(pieces[on_level(rays, pieces, surface.numbers)], centre, size)

    def upload(self, backend: Backend) -> Callable[[Vec3], Vec3]:
        """A function that gives the way from points to the nearest; NaN if there are none."""
        vector, real = backend.Array3f, backend.Float
        if not len(self.corners):
            return lambda p: vector(dr.nan) + 0 * p
        corners = self.corners
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        rays = _tree(backend, corners.reshape(-1, 3), faces, slabs=True)
        on, centre, size = placed(backend, self.centre, self.size)
        del on

        def nearest(p: Vec3) -> Vec3:
            x: Any = (vector(p) - centre) / size
            limit = square_to_some_vertex(rays, x)
            after = real(-1), backend.UInt32(NO_TRIANGLE)
            return nearest_triangle(rays, x, after, limit, backend.Bool(True)).offset * size

        return nearest


def _tree(
    backend: Backend, vertices: FloatArray, faces: Any, *, slabs: bool = False
) -> TriangleRays:
    tree = build_hierarchy(vertices[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    return TriangleRays.of(backend, tree, triangle_records(vertices, faces), slabs=slabs)
