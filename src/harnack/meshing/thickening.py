"""Closed parts of a given thickness, made of open surfaces. A surface here is a triangle mesh; it
is open if it has boundary edges (edges with a single face). The reach of a surface is the largest
distance up to which points have a single closest point on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry.mesh_edges import (
    area_normals,
    boundary_edges,
    edge_keys,
    half_edges,
    sorted_unique,
)
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.closed_mesh import from_manifold
from harnack.meshing.meshing_errors import (
    LocalizedMeshingError,
    SelfIntersectionError,
    point_text,
)
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["thicken"]

# Triangles may turn over when they are moved to a side if they have at most this fraction of the
# area: so few are slivers (thin triangles).
_MAX_TURNED_AREA = 1e-2
# The largest number of triangles whose hulls are computed.
_MOST_HULLS = 20_000
# A surface is thickened too much if points of a side come nearer to it than this fraction of half
# of the thickness.
_MIN_SIDE_DISTANCE = 0.98


def thicken(
    surface: TriangleMesh, normals: FloatArray, thickness: float, tolerance: float
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Make a closed part of a given thickness around an open surface. Returns the part, and facts
    about it as a dictionary, whose entry `thickened_by` is "offset" or "hulls of balls".

    Let t be the thickness. If the surface's reach is larger than t/2, the part consists of the
    surface moved by t/2 to both sides along its normals, and of walls along its boundary, straight
    between the sides, so that the boundary stays where it is. To second order in t, its volume is
    area * t * (1 + K t^2/12), with the Gaussian curvature K. The reach is too small if triangles
    turn over in this way, or come nearer to the surface than t/2, or pass through each other. Then
    the part is a union over all triangles of convex hulls, each of three balls of radius t/2 around
    the triangle's corners. These are all points within t/2 of the surface, so the boundary is
    round.

    surface: the open surface.
    normals: (n, 3) unit normals at the vertices, on the side from which faces run
        counter-clockwise.
    thickness: t, a length.
    tolerance: a length; how far the polyhedra in place of balls may be from these.

    Raises:
        MeshingError: hulls are needed, and there are too many triangles. It is a
            SelfIntersectionError if the surface crosses itself, and is then raised at once.
    """
    if len(surface.faces) > _MOST_HULLS:
        _check_not_crossing(surface)
    area = 0.5 * float(np.linalg.norm(area_normals(surface.vertices[surface.faces]), axis=1).sum())
    facts: dict[str, Any] = {"thickness": thickness, "area": area}
    why = _why_too_thick(surface, normals, thickness)
    if why is None:
        part = _offset_part(surface, normals, thickness)
        crossing = intersecting_faces(part.vertices, part.faces)
        if not len(crossing):
            return part, {**facts, "thickened_by": "offset"}
        why = f"{len(crossing)} triangles of the two sides pass through each other"
    return _hull_union(surface, 0.5 * thickness, tolerance, why), {
        **facts, "thickened_by": "hulls of balls", "why": why
    }  # fmt: skip


def _check_not_crossing(surface: TriangleMesh) -> None:
    """Raise a SelfIntersectionError if the surface crosses itself: its reach is 0."""
    crossing = intersecting_faces(surface.vertices, surface.faces)
    if len(crossing):
        centers = surface.vertices[surface.faces[crossing]].mean(axis=1)
        raise SelfIntersectionError(
            f"the surface crosses itself, such as near {point_text(centers[0])}: its reach is 0, "
            "so no `thickness` is small enough",
            centers,
            crossing,
        )


def _offset_part(surface: TriangleMesh, normals: FloatArray, thickness: float) -> TriangleMesh:
    """The closed surface that consists of two sides, each half of the thickness from the surface,
    and of walls along the boundary, straight between the sides.

    normals: (n, 3) unit normals at the vertices.
    thickness: a length.
    """
    n = len(surface.vertices)
    offset = 0.5 * thickness * normals / _normal_cosines(surface, normals)[:, None]
    a, b = boundary_edges(surface.faces).T
    # A face of the upper side runs the boundary edge from a to b, so the wall runs it from b to a.
    walls = [np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)]
    vertices = np.concatenate([surface.vertices + offset, surface.vertices - offset])
    return TriangleMesh(
        vertices, np.concatenate([surface.faces, surface.faces[:, ::-1] + n, *walls])
    )


def _normal_cosines(surface: TriangleMesh, normals: FloatArray) -> FloatArray:
    """(n,) the mean cosine of the angles between each vertex normal and the normals of the faces
    there, weighted by the faces' areas, and clipped to [0.7, 1]. A move of a vertex by distance /
    cosine along its normal moves the faces by about the distance.

    normals: (n, 3) unit normals at the vertices.
    """
    cross = area_normals(surface.vertices[surface.faces])
    cosines, areas = np.zeros(len(normals)), np.zeros(len(normals))
    size = np.linalg.norm(cross, axis=1)
    for k in range(3):
        rows = surface.faces[:, k]
        cosines += np.bincount(rows, (cross * normals[rows]).sum(axis=1), minlength=len(normals))
        areas += np.bincount(rows, size, minlength=len(normals))
    return np.clip(cosines / np.maximum(areas, 1e-300), 0.7, 1.0)


def _why_too_thick(surface: TriangleMesh, normals: FloatArray, thickness: float) -> str | None:
    """The reason, in words, why half of the thickness is larger than the surface's reach; None if
    there is no sign of that. There are two signs: triangles turn over when their vertices are moved
    along the normals by half of the thickness; or a moved vertex comes nearer than that to another
    vertex to which no edge joins it.

    normals: (n, 3) unit normals at the vertices.
    thickness: a length.
    """
    half = 0.5 * thickness
    face_normals = area_normals(surface.vertices[surface.faces])
    areas = np.linalg.norm(face_normals, axis=1)
    tree = kd_tree(surface.vertices)
    vertex_ids = np.arange(len(surface.vertices))
    # Of each moved vertex, the nearest 16 vertices are looked at.
    neighbor_count = min(16, len(vertex_ids))
    edges_of_mesh = sorted_unique(edge_keys(half_edges(surface.faces), len(vertex_ids)))
    for sign in (1, -1):
        side = surface.vertices + sign * half * normals
        turned = (area_normals(side[surface.faces]) * face_normals).sum(axis=1) <= 0
        # A smaller area is slivers.
        if areas[turned].sum() > _MAX_TURNED_AREA * areas.sum():
            return f"{turned.sum()} triangles turn over: the surface bends more than 1/{half:.3g}"
        # Only the vertex that a point was moved from, and the neighbors of this vertex, may be near
        # the point.
        distances, nearest = tree.query(side, k=neighbor_count)
        pairs = np.stack([np.broadcast_to(vertex_ids[:, None], nearest.shape), nearest], axis=-1)
        is_too_near = (distances < _MIN_SIDE_DISTANCE * half) & (pairs[..., 0] != pairs[..., 1])
        near_keys = sorted_unique(edge_keys(pairs[is_too_near], len(vertex_ids)))
        count = int((~np.isin(near_keys, edges_of_mesh)).sum())
        if count:
            return f"{count} points of a side are nearer to another place than to their own"
    return None


def _hull_union(surface: TriangleMesh, radius: float, tolerance: float, why: str) -> TriangleMesh:
    """The union over all triangles of convex hulls, each of three balls around the triangle's
    corners.

    Balls are polyhedra with their corners on the sphere, so the result lies inside of the union for
    exact balls. The distance is at most the larger of `tolerance` and a tenth of the radius, unless
    that would need more than 16 segments around; then there are 16.

    radius: of the balls, a length.
    why: the reason why hulls are needed, for the message of the error.

    Raises:
        MeshingError: there are too many triangles.
    """
    from manifold3d import Manifold, OpType

    if len(surface.faces) > _MOST_HULLS:
        raise LocalizedMeshingError(
            f"{2 * radius:.3g} is thicker than the surface's reach allows ({why}), and there are "
            f"{len(surface.faces):,} triangles, too many for a union of as many hulls: choose a "
            "larger `tolerance`, or a smaller thickness",
            surface.vertices,
        )
    max_error = max(tolerance, 0.1 * radius)
    # A multiple of 4 whose chords are within `max_error` of the circle, from 8 to 16.
    segments = int(np.clip(4 * np.ceil(np.pi / 2 * np.sqrt(radius / (2 * max_error))), 8, 16))
    mesh = Manifold.sphere(radius, segments).to_mesh64()
    ball = np.array(mesh.vert_properties, np.float64)[:, :3]
    hulls = [
        Manifold.hull_points(np.ascontiguousarray((corners[:, None] + ball).reshape(-1, 3)))
        for corners in surface.vertices[surface.faces]
    ]
    return from_manifold(Manifold.batch_boolean(hulls, OpType.Add))
