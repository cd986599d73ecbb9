"""Closed meshes as manifold3d's solids, and back; clip volumes as such solids."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Intersection
from harnack.meshing.checks import MeshingError
from harnack.meshing.lattice_surface import Surface

if TYPE_CHECKING:
    from manifold3d import Manifold

    from harnack.geometry import Volume

__all__ = ["box_manifold", "manifold_of", "surface_of", "volume_manifold"]

_MOST_SEGMENTS = 2000


def manifold_of(surface: Surface) -> Manifold:
    """A closed mesh whose faces are seen counter-clockwise from outside.

    Raises:
        MeshingError: it is not closed.
    """
    from manifold3d import Error, Manifold, Mesh64

    if not len(surface.faces):
        return Manifold()
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    made = Manifold(Mesh64(vertices, np.ascontiguousarray(surface.faces, np.uint64)))
    if made.status() != Error.NoError:
        raise MeshingError(
            f"a surface of the solid is not closed ({made.status().name}): cells are too large for "
            "it; choose a smaller `spacing`"
        )
    return made


def surface_of(manifold: Manifold) -> Surface:
    """The triangles of a solid."""
    mesh = manifold.to_mesh64()
    vertices = np.array(mesh.vert_properties, np.float64)[:, :3]
    return Surface(vertices, np.array(mesh.tri_verts, np.int64))


def box_manifold(lower: FloatArray, upper: FloatArray) -> Manifold:
    """The box between two corners (3,)."""
    from manifold3d import Manifold

    x, y, z = (float(v) for v in upper - lower)
    a, b, c = (float(v) for v in lower)
    return Manifold.cube((x, y, z)).translate((a, b, c))


def volume_manifold(
    volume: Volume, lower: FloatArray, upper: FloatArray, tolerance: float
) -> Manifold:
    """The part of a volume in a box: polytopes as they are, balls as polyhedra whose vertices lie
    on the sphere and whose faces are within `tolerance` of it.

    Raises:
        MeshingError: another volume, or a ball so fine that it has millions of faces.
    """
    from manifold3d import Manifold

    around = box_manifold(lower, upper)
    if isinstance(volume, Intersection):
        for one in volume.volumes:
            around ^= volume_manifold(one, lower, upper, tolerance)
        return around
    if isinstance(volume, Box):
        low, high = (np.array(end, np.float64) for end in volume.bounds())
        low, high = np.maximum(low, lower), np.minimum(high, upper)
        return box_manifold(low, high) if (low < high).all() else Manifold()
    if isinstance(volume, HalfSpace | ConvexHull):
        for row in volume.planes():
            x, y, z, h = (float(v) for v in row)
            around = around.trim_by_plane((-x, -y, -z), -h)
        return around
    if isinstance(volume, Ball):
        return around ^ _ball(volume, tolerance)
    raise MeshingError(f"a {type(volume).__name__} cannot cut a mesh: give a box or a ball")


def _ball(ball: Ball, tolerance: float) -> Manifold:
    """A geodesic polyhedron of n segments around. The octahedron's faces are cut into equilateral
    triangles and blown up: an edge is at most sqrt(3) times as long as the mean of those along its
    sides, r pi/(2 n/4), and a circle through its corners of radius edge/sqrt(3) has a sagitta of
    half its square over r."""
    from manifold3d import Manifold

    r = ball.radius
    segments = 4 * math.ceil(0.25 * 2 * math.pi * math.sqrt(r / (2 * tolerance)))
    if segments > _MOST_SEGMENTS:
        raise MeshingError(
            f"a ball of radius {r:g} within {tolerance:.3g} has {2 * segments**2:,} faces: choose "
            "a larger `tolerance`"
        )
    x, y, z = ball.center
    return Manifold.sphere(r, max(16, segments)).translate((x, y, z))
