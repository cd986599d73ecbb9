"""The level sets of a closed mesh's winding number f as triangles, with a tree that finds the
nearest one. A triangle belongs to a level set if the level lies between the values of f on its two
sides.

Off its triangles the winding number of a closed mesh is an integer, so its level sets consist of
triangles. A triangle belongs to a level set as a whole, unless other triangles pass through it:
then it is cut along them first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend
from harnack.distance.tangent_plane import in_batches
from harnack.enclosures import Levels
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.field import EvaluateOnly
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.fmm.unit_frame import frame_parameters, round_to_single
from harnack.geometry.mesh_edges import area_normals
from harnack.tree import build_balanced_tree
from harnack.tree.closest_triangles import initial_squared_distance, next_closest_triangle
from harnack.tree.triangle_splitting import separates_levels, split_intersecting_faces
from harnack.tree.triangle_tree import NO_TRIANGLE, TriangleTree, triangle_records

if TYPE_CHECKING:
    from harnack.backend import Backend, Vec3
    from harnack.tracer import TracedSurface

__all__ = ["LevelTriangles"]

_LEAF_SIZE = 8
# The distance from a triangle at which f is evaluated on either side, as a fraction of the mesh
# size.
_SIDE_DISTANCE = 1e-9


@dataclass(frozen=True)
class LevelTriangles:
    """The triangles of a mesh on which a level set of its winding number f lies (f jumps there from
    one side of the level to the other), in scaled coordinates.

    corners: (k, 3, 3) the corners, in coordinates of at most about 1; the unscaled corners are
        center + size * corners.
    center: (3,) the center of the mesh's bounding box.
    size: about half the longest side of that box, a power of two.
    is_complete: whether the surface consists of these triangles only.
    """

    corners: FloatArray
    center: FloatArray
    size: float
    is_complete: bool

    @classmethod
    def of(cls, surface: TracedSurface, backend: Backend) -> LevelTriangles | None:
        """Return the triangles of which a surface consists, wholly or in part. The surface is the
        boundary of a `MeshSolid`, or a level set of the winding number of a mesh, without clip and
        domain; for other surfaces the result is None.

        If the surface also has parts off the triangles, as that of a mesh with holes, the result
        has only those triangles that are proved to belong to the surface as a whole.
        """
        if isinstance(surface.field, MeshSolid) and surface.clip_volume is None:
            # The boundary of the solid is the level 0.
            if surface.field.domain is not None or any(surface.level_values):
                return None
            solid = surface.field.surface
            # True: the surface consists of these triangles only.
            return cls(solid.corners, solid.center, solid.size, True)
        jumps = surface.evaluator(backend).jumps
        mesh = None if jumps is None else jumps.mesh()
        if (
            jumps is None
            or mesh is None
            or surface.clip_volume is not None
            or surface.field.domain is not None
        ):
            return None
        vertices, faces, is_integer_off_faces = mesh
        is_jumps_only = jumps.are_whole_surface(surface.level_values)
        # The scale is a power of two and the center has single precision: so scaling is exact.
        lower, upper = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        size = float(2.0 ** np.ceil(np.log2(0.5 * (upper - lower).max())))
        center = round_to_single(0.5 * (lower + upper))
        scaled = (vertices - center) / size
        # The field says that every triangle belongs to the level set, and nothing else.
        if is_jumps_only:
            return cls(scaled[faces], center, size, True)
        tree = _tree(choose_backend("double"), scaled, faces)
        # The second result, the face of which each triangle is a piece, is not needed.
        pieces, _ = split_intersecting_faces(tree, scaled, faces)
        # Off the faces of such a mesh f is an integer, so that the triangles are the whole level
        # set.
        if is_integer_off_faces:
            on_level = separates_levels(tree, pieces, surface.level_values)
        else:
            on_level = _proved_on_level(surface, center + size * pieces, size)
        return cls(pieces[on_level], center, size, is_integer_off_faces)

    def upload(self, backend: Backend) -> Callable[[Vec3], Vec3]:
        """Upload the triangles to the backend. Returns a function: for points it gives the vector
        from each to the nearest point of a triangle; NaN if there are no triangles."""
        vector, real = backend.Array3f, backend.Float
        if not len(self.corners):
            return lambda p: vector(dr.nan) + 0 * p
        # Each triangle has three vertices of its own.
        corners = self.corners
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        tree = _tree(backend, corners.reshape(-1, 3), faces, slabs=True)
        _frame, center, size = frame_parameters(backend, self.center, self.size)
        del _frame

        def nearest(p: Vec3) -> Vec3:
            """Return the vector from p to the nearest point of a triangle."""
            x: Any = (vector(p) - center) / size
            limit = initial_squared_distance(tree, x)
            # The place before all triangles: the squared distance -1 is below all others.
            start = real(-1), backend.UInt32(NO_TRIANGLE)
            return next_closest_triangle(tree, x, start, limit, backend.Bool(True)).offset * size

        return nearest


def _tree(
    backend: Backend, vertices: FloatArray, faces: Any, *, slabs: bool = False
) -> TriangleTree:
    """Return a tree that finds the nearest of some triangles.

    vertices, faces: (n, 3) the vertices, and (m, 3) their indices for each triangle.
    slabs: whether its nodes store slabs, between parallel planes, as well as boxes; they bound flat
        groups of triangles more tightly.
    """
    tree = build_balanced_tree(vertices[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    return TriangleTree.of(backend, tree, triangle_records(vertices, faces), slabs=slabs)


def _proved_on_level(surface: TracedSurface, corners: FloatArray, size: float) -> BoolArray:
    """Return the mask (k,) of triangles that are proved to belong to a level set as a whole.

    corners: (k, 3, 3) the corners of triangles through which no other triangle passes.
    surface: the surface, whose levels are the values of f in question.
    size: the size of the mesh, a length.

    Proof. f is the winding number, which jumps by whole numbers. f modulo 1 is smooth around the
    triangle's center; within the radius that `level_distance_lower_bound` proves, it does not take
    the level modulo 1. Let the ball of that radius about the center contain the triangle. Then on
    either side of the triangle, f stays on the side of the level on which it is beside the center.
    """
    backend, field = choose_backend("double"), surface.field
    evaluator = surface.evaluator(backend)
    # The same samples, and levels with the period 1: those of f modulo 1.
    smooth = EvaluateOnly(evaluator.evaluate)
    levels = Levels(tuple(dr.opaque(backend.Float, level) for level in surface.level_values), 1.0)

    def clearance(p: Vec3) -> tuple[Any]:
        """Return the radius, as a tuple of one, of the ball about p in which f modulo 1 is proved
        not to take the level."""
        sample = evaluator.evaluate(p)
        return (level_distance_lower_bound(backend, smooth, levels, p, sample),)

    center = corners.mean(axis=1)
    (clearances,) = in_batches(backend, clearance, center)
    # The ball about the center that contains the triangle.
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    normal = area_normals(corners)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # f right beside the center, on both sides.
    offset = _SIDE_DISTANCE * size * normal / np.maximum(length, 1e-300)
    side_values = [field.value(center + sign * offset, precision="double") for sign in (1, -1)]
    lower, upper = np.minimum(*side_values), np.maximum(*side_values)
    is_between = np.any(
        [(lower < level) & (level < upper) for level in surface.level_values], axis=0
    )
    # Triangles without an area have no normal, and are not proved.
    return is_between & (clearances > radius + 2 * _SIDE_DISTANCE * size) & (length[:, 0] > 0)
