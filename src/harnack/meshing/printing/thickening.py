"""Closed parts of a given thickness around a surface.

Where the surface's reach is larger than half of the thickness t (no point that near has two closest
points), the part is the surface moved by t/2 to both sides along its normals, and walls along its
rim: straight between the sides, so that the rim stays where it is. Its volume is area x t up to the
second order: (K t^2/12) of it, K the Gaussian curvature. Where that makes triangles turn over, or
come nearer to the surface than t/2, or pass through each other, the part is the union of the convex
hulls of three balls around the corners of each triangle: all points within t/2, with a round rim.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.checks import MeshingError
from harnack.meshing.edges import boundary_edges, directed_edges, distinct, edge_keys
from harnack.meshing.intersections import intersecting_faces
from harnack.meshing.lattice_surface import Surface
from harnack.meshing.printing.manifolds import surface_of

__all__ = ["thickened"]

# So much of the area may turn over where the two sides are made: slivers.
_TURNED = 1e-2
# More triangles than that are not each made a hull of.
_MOST_HULLS = 20_000
# A side that comes so near to the surface, in parts of t/2, is within its reach.
_NEAR = 0.98


def thickened(
    surface: Surface, normals: FloatArray, thickness: float, tolerance: float
) -> tuple[Surface, dict[str, Any]]:
    """The closed part, and how it was made: `thickened_by` is "offset" or "hulls of balls".

    normals: (n, 3), of unit length, on the side that faces are seen counter-clockwise from.
    tolerance: of the balls' polyhedra, and of the triangles given, a length.

    Raises:
        MeshingError: the part is far thicker than triangles are large, of which there are too many.
    """
    area = 0.5 * float(np.linalg.norm(_crosses(surface.vertices, surface.faces), axis=1).sum())
    facts: dict[str, Any] = {"thickness": thickness, "area": area}
    why = _beyond_reach(surface, normals, thickness)
    if why is None:
        part = _offset(surface, normals, thickness)
        crossing = intersecting_faces(part.vertices, part.faces)
        if not len(crossing):
            return part, {**facts, "thickened_by": "offset"}
        why = f"{len(crossing)} triangles of the two sides pass through each other"
    return _hulls(surface, 0.5 * thickness, tolerance, why), {
        **facts, "thickened_by": "hulls of balls", "why": why
    }  # fmt: skip


def _crosses(vertices: FloatArray, faces: Any) -> FloatArray:
    corner = vertices[faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _offset(surface: Surface, normals: FloatArray, thickness: float) -> Surface:
    """Both sides, and walls along the rim."""
    n = len(surface.vertices)
    move = 0.5 * thickness * normals / _slants(surface, normals)[:, None]
    a, b = boundary_edges(surface.faces).T
    # A face above the rim runs it from a to b, so the wall runs it from b to a.
    walls = [np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)]
    vertices = np.concatenate([surface.vertices + move, surface.vertices - move])
    return Surface(vertices, np.concatenate([surface.faces, surface.faces[:, ::-1] + n, *walls]))


def _slants(surface: Surface, normals: FloatArray) -> FloatArray:
    """(n,) cosines between normals at vertices and those of the faces there, means by area: as much
    farther vertices are moved, so that faces are moved by the thickness."""
    cross = _crosses(surface.vertices, surface.faces)
    total, area = np.zeros(len(normals)), np.zeros(len(normals))
    size = np.linalg.norm(cross, axis=1)
    for k in range(3):
        rows = surface.faces[:, k]
        total += np.bincount(rows, (cross * normals[rows]).sum(axis=1), minlength=len(normals))
        area += np.bincount(rows, size, minlength=len(normals))
    return np.clip(total / np.maximum(area, 1e-300), 0.7, 1.0)


def _beyond_reach(surface: Surface, normals: FloatArray, thickness: float) -> str | None:
    """Why half of the thickness is more than the surface's reach; None if that was not seen."""
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    half = 0.5 * thickness
    flat = _crosses(surface.vertices, surface.faces)
    areas = np.linalg.norm(flat, axis=1)
    tree = searching.cKDTree(surface.vertices)
    own = np.arange(len(surface.vertices))
    few = min(16, len(own))
    neighbors = distinct(edge_keys(directed_edges(surface.faces), len(own)))
    for sign in (1, -1):
        side = surface.vertices + sign * half * normals
        turned = (_crosses(side, surface.faces) * flat).sum(axis=1) <= 0
        if areas[turned].sum() > _TURNED * areas.sum():  # less are slivers
            return f"{turned.sum()} triangles turn over: the surface bends more than 1/{half:.3g}"
        # Nearer than the vertex that a point was moved from are at most its neighbors.
        away, other = tree.query(side, k=few)
        pairs = np.stack([np.broadcast_to(own[:, None], other.shape), other], axis=-1)
        near = (away < _NEAR * half) & (pairs[..., 0] != pairs[..., 1])
        found = distinct(edge_keys(pairs[near], len(own)))
        count = int((~np.isin(found, neighbors)).sum())
        if count:
            return f"{count} points of a side are nearer to another place than to their own"
    return None


def _hulls(surface: Surface, radius: float, tolerance: float, why: str) -> Surface:
    """The union of the hulls of three balls around the corners of each triangle.

    Balls are polyhedra with corners on the sphere, so that the part is inside of what it should be,
    by at most `tolerance` or a tenth of the radius.
    """
    from manifold3d import Manifold, OpType

    if len(surface.faces) > _MOST_HULLS:
        raise MeshingError(
            f"{2 * radius:.3g} is thicker than the surface's reach allows ({why}), and there are "
            f"{len(surface.faces):,} triangles, too many for a union of as many hulls: choose a "
            "larger `tolerance`, or a smaller thickness"
        )
    allowed = max(tolerance, 0.1 * radius)
    segments = int(np.clip(4 * np.ceil(np.pi / 2 * np.sqrt(radius / (2 * allowed))), 8, 16))
    mesh = Manifold.sphere(radius, segments).to_mesh64()
    ball = np.array(mesh.vert_properties, np.float64)[:, :3]
    parts = [
        Manifold.hull_points(np.ascontiguousarray((corners[:, None] + ball).reshape(-1, 3)))
        for corners in surface.vertices[surface.faces]
    ]
    return surface_of(Manifold.batch_boolean(parts, OpType.Add))
