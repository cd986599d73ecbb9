"""Open surfaces cut at planes and spheres (`clip_to_volume`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Volume, VolumeIntersection
from harnack.geometry.mesh_edges import (
    boundary_edges,
    edge_keys,
    has_distinct_corners,
    normals_at_vertices,
    shortest_edges_at_vertices,
)
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.name_suggestions import with_article

__all__ = ["clip_to_volume", "snap_to_box"]

# Vertices that are no farther from a boundary than this, relative to the size of the mesh, count as
# on it.
_ON_BOUNDARY = 1e-9
# Vertices that are nearer to a boundary than this fraction of their shortest edge are moved onto
# it, or slivers (thin triangles) would remain.
_SNAP_DISTANCE = 0.25


@dataclass(frozen=True)
class _ClipBoundary:
    """A plane or a sphere at which a surface is cut. It has an inner side: behind the plane's
    normal, or in the sphere.

    center: (3,) a point of the plane, or the center of the sphere.
    normal: (3,) the plane's unit normal, outwards; unused for a sphere.
    radius: of the sphere; None for a plane.
    """

    center: FloatArray
    normal: FloatArray
    radius: float | None

    def heights(self, x: FloatArray) -> FloatArray:
        """(n,) signed distances of points x (n, 3) from the plane or sphere, negative on its inner
        side."""
        if self.radius is None:
            return (x - self.center) @ self.normal
        return np.linalg.norm(x - self.center, axis=1) - self.radius

    def slopes(self, x: FloatArray) -> FloatArray:
        """(n, 3) the gradients of the signed distance from the plane or sphere at points x (n, 3);
        they are unit vectors."""
        if self.radius is None:
            return np.broadcast_to(self.normal, x.shape)
        from_center = x - self.center
        return from_center / np.maximum(np.linalg.norm(from_center, axis=1), 1e-300)[:, None]


def clip_to_volume(surface: TriangleMesh, volume: Volume) -> TriangleMesh:
    """The part of a surface inside of a volume. New edges lie exactly on the volume's planes; on a
    sphere they are chords. The vertices that are kept come first and keep their order.

    Raises:
        MeshingError: the volume is neither a box, a ball, a half-space, a convex hull nor an
            intersection of such volumes.
    """
    if isinstance(volume, VolumeIntersection):
        for operand in volume.volumes:
            surface = clip_to_volume(surface, operand)
        return surface
    if isinstance(volume, Ball):
        return _cut(surface, _ClipBoundary(np.array(volume.center), np.zeros(3), volume.radius))
    if not isinstance(volume, Box | HalfSpace | ConvexHull):
        raise MeshingError(
            f"{with_article(type(volume).__name__)} cannot cut a mesh: give a box or a ball"
        )
    # A row holds the plane's outward normal and its distance from the origin.
    for row in volume.planes():
        surface = _cut(surface, _ClipBoundary(row[:3] * row[3], row[:3], None))
    if isinstance(volume, Box):
        return TriangleMesh(snap_to_box(surface.vertices, volume), surface.faces)
    return surface


def snap_to_box(vertices: FloatArray, box: Box, rounding: float = _ON_BOUNDARY) -> FloatArray:
    """Move vertices (n, 3) onto the plane of a face of the box if only rounding separates them from
    it, by no more than `rounding` relative to the plane's coordinate; returns all vertices."""
    for end in box.bounds():
        near = np.abs(vertices - end) <= rounding * (1 + np.abs(end))
        vertices = np.where(near, end, vertices)
    return vertices


def _snap_to_boundary(
    surface: TriangleMesh, boundary: _ClipBoundary
) -> tuple[FloatArray, FloatArray]:
    """Move vertices that are very near the plane or sphere `boundary` onto it, since cutting beside
    them would leave slivers (thin triangles). A vertex is moved in the surface's tangent plane, if
    the move is shorter than a quarter of the vertex's shortest edge. Vertices on the boundary edges
    of the surface itself are not moved.

    Returns the vertices (n, 3), and their signed distances (n,) from the plane or sphere.
    """
    x, faces = surface.vertices, surface.faces
    shortest_edge = shortest_edges_at_vertices(x, faces)
    vertex_normals = normals_at_vertices(x, faces)
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=1), 1e-300)[:, None]
    heights = boundary.heights(x)
    moved = x
    for _ in range(4):
        slope = boundary.slopes(moved)
        # A step of Newton's method within the tangent plane; at most about 1000 times the height,
        # where the tangent plane is nearly parallel to the boundary.
        tangential = slope - (slope * vertex_normals).sum(axis=1)[:, None] * vertex_normals
        squared_length = np.maximum((tangential * tangential).sum(axis=1), 1e-3)
        moved = moved - (boundary.heights(moved) / squared_length)[:, None] * tangential
    is_snapped = np.linalg.norm(moved - x, axis=1) < _SNAP_DISTANCE * shortest_edge
    # The steps must have converged.
    is_snapped &= np.abs(boundary.heights(moved)) <= 1e-9 * shortest_edge
    is_snapped[np.unique(boundary_edges(faces))] = False
    return np.where(is_snapped[:, None], moved, x), np.where(is_snapped, 0.0, heights)


def _cut(surface: TriangleMesh, boundary: _ClipBoundary) -> TriangleMesh:
    """The part of a surface on the inner side of the plane or sphere `boundary`. Edges are cut
    where they meet it, and the faces there are divided into triangles."""
    faces = surface.faces
    if not len(faces):
        return surface
    vertices, h = _snap_to_boundary(surface, boundary)
    # h is the signed distance of each vertex: inside if negative, on the boundary if 0.
    h = np.where(np.abs(h) <= _ON_BOUNDARY * float(np.ptp(vertices, axis=0).max()), 0.0, h)
    is_out = (h > 0)[faces]
    # Faces on the boundary with no corner inside are left out.
    is_kept = (h < 0)[faces].any(axis=1)
    # Faces with corners on both sides are cut.
    is_mixed = is_kept & is_out.any(axis=1)
    edges = np.concatenate([faces[is_mixed][:, [k, (k + 1) % 3]] for k in range(3)])
    # Edges with one end inside and the other outside; a product of different signs is negative.
    crossed = edges[h[edges[:, 0]] * h[edges[:, 1]] < 0]
    # A key is the number i * n + j for the edge between the vertices i < j of n.
    keys = np.unique(edge_keys(crossed, len(vertices)))
    a, b = keys // len(vertices), keys % len(vertices)
    # The distance from a plane is linear along the edge.
    fraction = (h[a] / (h[a] - h[b]))[:, None]
    points = vertices[a] + fraction * (vertices[b] - vertices[a])
    if boundary.radius is not None:
        points = _sphere_cuts(vertices[a], vertices[b], boundary.center, boundary.radius)
    first_new = len(vertices)

    def crossing(i: IntArray, j: IntArray) -> IntArray:
        """(k,) the indices of the vertices at which the edges from vertices i to j, both (k,), meet
        the plane or sphere: i itself if it lies on it, else the new vertex on the edge."""
        index = np.searchsorted(keys, edge_keys(np.column_stack([i, j]), len(vertices)))
        return np.where(h[i] == 0, i, first_new + index)

    pieces = [faces[is_kept & ~is_out.any(axis=1)]]
    rows = faces[is_mixed]
    # How many corners of each face are outside: one or two.
    outer_count = is_out[is_mixed].sum(axis=1)
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        # Faces with one corner outside, begun at that corner.
        triangles = rows[(outer_count == 1) & is_out[is_mixed][:, k]][:, order]
        # Two corners inside: the part is a quadrilateral, two triangles. p and q are the points at
        # which the edges at the outer corner are cut.
        p, q = (
            crossing(triangles[:, 1], triangles[:, 0]),
            crossing(triangles[:, 2], triangles[:, 0]),
        )
        pieces += [
            np.stack([triangles[:, 1], triangles[:, 2], p], axis=1),
            np.stack([triangles[:, 2], q, p], axis=1),
        ]
        # Faces with two corners outside, begun at the corner inside: a triangle at it remains.
        tip = rows[(outer_count == 2) & ~is_out[is_mixed][:, k]][:, order]
        pieces.append(
            np.stack([tip[:, 0], crossing(tip[:, 0], tip[:, 1]), crossing(tip[:, 0], tip[:, 2])], 1)
        )
    new = np.concatenate(pieces)
    # Where a corner lies on the boundary, two corners of a piece may be the same.
    is_proper = has_distinct_corners(new)
    return TriangleMesh.without_unused_vertices(np.concatenate([vertices, points]), new[is_proper])


def _sphere_cuts(a: FloatArray, b: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    """The points (n, 3) where segments from `a` to `b`, both (n, 3), pass through a sphere. One end
    of each segment is inside of the sphere, the other end outside.

    Proof. Relative to the center, the point is o + t d, with o the inner end and d the vector from
    it to the outer end. |o + t d| = radius means t^2 d.d + 2 t o.d = room, with room = radius^2 -
    o.o. Its solution t >= 0 is room / (o.d + sqrt((o.d)^2 + d.d room)).
    """
    # The inner end is the one nearer to the center.
    is_a_in = np.linalg.norm(a - center, axis=1) < np.linalg.norm(b - center, axis=1)
    start, end = np.where(is_a_in[:, None], a, b), np.where(is_a_in[:, None], b, a)
    o, d = start - center, end - start
    d_squared, o_dot_d = ((d * d).sum(axis=1), (o * d).sum(axis=1))
    room = np.maximum(radius**2 - (o * o).sum(axis=1), 0)
    fraction = room / (o_dot_d + np.sqrt(o_dot_d * o_dot_d + d_squared * room))
    return start + fraction[:, None] * d
