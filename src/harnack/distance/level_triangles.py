"""The level sets of a closed mesh's winding number, as triangles, the nearest found by a tree.

Off its triangles the winding number of a closed mesh is a whole number; so its level sets consist
of triangles. One of them belongs to a level as a whole unless others pass through it: then it is
cut along these first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend
from harnack.distance.tangent_plane import in_batches
from harnack.enclosures import TargetLevels
from harnack.fields.clearance import distance_below, placed, single
from harnack.fields.field import AtDetail
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.tree import build_hierarchy
from harnack.tree.closest_triangles import nearest_triangle, square_to_some_vertex
from harnack.tree.triangle_splitting import on_level, pieces_of_faces
from harnack.tree.triangle_tree import NO_TRIANGLE, TriangleRays, triangle_records

if TYPE_CHECKING:
    from harnack.backend import Backend, Vec3
    from harnack.tracer import LevelSet

__all__ = ["MeshSurface"]

_LEAF_SIZE = 8
# Of the mesh's size: the distance from a triangle at which f is evaluated on either side.
_BESIDE = 1e-9


@dataclass(frozen=True)
class MeshSurface:
    """Triangles: corners (k, 3, 3) in coordinates of at most about one, center + size times which
    are the real ones. is_all: whether the surface is nothing else."""

    corners: FloatArray
    center: FloatArray
    size: float
    is_all: bool

    @classmethod
    def of(cls, surface: LevelSet) -> MeshSurface | None:
        """Of the winding number of a mesh that nothing clips, and of the boundary of a `MeshSolid`;
        else None. Of a mesh that is not closed, those triangles that are proved to belong to the
        surface as a whole; or all, if the surface is nothing else."""
        if isinstance(surface.field, MeshSolid) and surface.cut is None:
            if surface.field.domain is not None or any(surface.numbers):
                return None
            closed = surface.field.surface
            return cls(closed.corners, closed.center, closed.size, True)
        mesh = surface.field.mesh_of_sheets()
        if mesh is None or surface.cut is not None or surface.field.domain is not None:
            return None
        vertices, faces, is_all = mesh
        only_sheets = surface.field.is_of_sheets_alone(surface.numbers)
        low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        size = float(2.0 ** np.ceil(np.log2(0.5 * (high - low).max())))
        center = single(0.5 * (low + high))
        unit = (vertices - center) / size
        if only_sheets:
            return cls(unit[faces], center, size, True)
        rays = _tree(choose_backend("double"), unit, faces)
        pieces, _ = pieces_of_faces(rays, unit, faces)
        if is_all:
            on = on_level(rays, pieces, surface.numbers)
        else:
            on = _proved_on_level(surface, center + size * pieces, size)
        return cls(pieces[on], center, size, is_all)

    def upload(self, backend: Backend) -> Callable[[Vec3], Vec3]:
        """A function that gives the way from points to the nearest; NaN if there are none."""
        vector, real = backend.Array3f, backend.Float
        if not len(self.corners):
            return lambda p: vector(dr.nan) + 0 * p
        corners = self.corners
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        rays = _tree(backend, corners.reshape(-1, 3), faces, slabs=True)
        on, center, size = placed(backend, self.center, self.size)
        del on

        def nearest(p: Vec3) -> Vec3:
            x: Any = (vector(p) - center) / size
            limit = square_to_some_vertex(rays, x)
            after = real(-1), backend.UInt32(NO_TRIANGLE)
            return nearest_triangle(rays, x, after, limit, backend.Bool(True)).offset * size

        return nearest


def _tree(
    backend: Backend, vertices: FloatArray, faces: Any, *, slabs: bool = False
) -> TriangleRays:
    tree = build_hierarchy(vertices[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    return TriangleRays.of(backend, tree, triangle_records(vertices, faces), slabs=slabs)


def _proved_on_level(surface: LevelSet, corners: FloatArray, size: float) -> BoolArray:
    """(k,) whether all of a triangle, which none passes through, belongs to a level.

    Proof. With its jumps, whole numbers, removed, f is smooth about the triangle's center, and
    takes no level mod 1 within the radius that `distance_below` proves. If that holds the triangle,
    f on either side of it stays on the same side of the level as just beside the center.
    """
    backend, field = choose_backend("double"), surface.field
    prepared = surface.field_on(backend)
    smooth = AtDetail(prepared.evaluate)
    targets = TargetLevels(tuple(dr.opaque(backend.Float, v) for v in surface.numbers), 1.0)

    def clearance(p: Vec3) -> tuple[Any]:
        return (distance_below(backend, smooth, targets, p, prepared.evaluate(p)),)

    center = corners.mean(axis=1)
    (free,) = in_batches(backend, clearance, center)
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    way = _BESIDE * size * normal / np.maximum(length, 1e-300)
    sides = [field.value(center + sign * way, precision="double") for sign in (1, -1)]
    low, high = np.minimum(*sides), np.maximum(*sides)
    between = np.any([(low < v) & (v < high) for v in surface.numbers], axis=0)
    return between & (free > radius + 2 * _BESIDE * size) & (length[:, 0] > 0)
