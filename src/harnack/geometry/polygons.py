"""Closed polygons: removal of opposite edges, and triangulation. A loop is an array (n, 3) of
points, the last joined to the first; its edges are directed. Two edges are opposite if they join
the same two points in the two directions. A polygon is a list of indices of vertices (its corners),
the last joined to the first.

Pairs of opposite edges are removed by integer index, before a curve is uploaded: in floating point,
two opposite contributions to a solid angle would leave their rounding errors.
"""

from __future__ import annotations

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.boundary_edges import (
    boundary_edges,
    join_edges,
    net_edges,
    singular_loops,
    weld_vertices,
)
from harnack.geometry.curves import Loops
from harnack.geometry.meshes import MeshError

__all__ = ["cancel_opposite_edges", "remaining_edges", "triangulate"]


def cancel_opposite_edges(loops: Loops) -> Loops:
    """Remove pairs of opposite edges from closed loops; returns the loops that are left. The solid
    angle of the loops stays the same modulo 4 pi.

    Seen from a point, the contribution of an edge is minus that of the reversed edge, so both drop
    out of the sum. If they were kept, they would leave rounding errors, and would count in
    distances and in tests of convexity as a curve that is not there.

    Vertices at exactly the same position are the same. If edges run both ways between two vertices,
    the surplus is left: as many edges as one direction has more than the other. If no edges cancel,
    the loops are returned as they are; if all cancel, no loop is returned. Only entire edges are
    compared: of two edges that overlap in part and run opposite ways, both stay.

    Proof that the remaining loops are closed: in loops the same number of edges begins and ends at
    a vertex, and this stays true when an edge and its reverse are removed. Proof that the solid
    angle stays the same modulo 4 pi: its gradient is the sum of the fields of the edges (Biot and
    Savart), and those of opposite edges cancel. So the solid angle changes by a constant at most,
    modulo 4 pi. This constant is 0, since both solid angles vanish far away.
    """
    points = np.concatenate(loops)
    begin, end = _welded_edges(loops, points)
    edges, weights = net_edges(begin, end)
    # Every edge is left.
    if int(weights.sum()) == len(points):
        return loops
    return tuple(points[np.array(loop)] for loop in singular_loops(edges, weights))


def remaining_edges(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """Two arrays (k, 3): the starts and the ends of the edges of closed loops that remain after
    opposite edges were cancelled, each edge once.

    Let n be how often an edge is run in one direction, less how often it is run in the other.
    Around this edge the solid angle changes by 4 pi n. Unless n = 0 it takes every value modulo 4
    pi next to each point of the edge, so that every level set ends there.
    """
    if not loops:
        return np.zeros((0, 3)), np.zeros((0, 3))
    points = np.concatenate(loops)
    edges, _ = net_edges(*_welded_edges(loops, points))
    return points[edges[:, 0]], points[edges[:, 1]]


def _welded_edges(loops: Loops, points: FloatArray) -> tuple[IntArray, IntArray]:
    """The edges of loops: the indices (m,) of their first points, and the indices (m,) of their
    last points. Points at the same position have the same index.

    points: (m, 3) the points of all loops, to which the indices refer.
    """
    index = weld_vertices(points)
    parts = np.split(index, np.cumsum([len(loop) for loop in loops])[:-1])
    return index, np.concatenate([np.roll(part, -1) for part in parts])


# Triangles of polygons.

# The largest work for ear clipping, which takes about ten seconds. The work is the sum of the
# squared number of corners plus _WORK_PER_POLYGON, over the polygons that need it.
_MAX_EAR_WORK = 1_000_000_000
_WORK_PER_POLYGON = 1000
# Twice the area of a triangle, in a polygon of size about 1, up to which it counts as flat.
_FLAT_AREA = 1e-12
# For ear clipping, corners in the middle of a straight edge are moved inwards: a corner at the
# distances a and b from the ends of the edge moves by this times a b.
_INWARD_CURVATURE = 1e-6
_CORNERS_PER_GROUP = 2_000_000


def triangulate(vertices: FloatArray, corners: IntArray, sizes: IntArray) -> IntArray:
    """Triangulate polygons. Returns triangles (k, 3), in the order of the polygons.

    A polygon need not be exactly planar: it is judged by its projection along its mean normal.
    First the fan around its first corner is tried (all diagonals from that corner), then the fan
    around its second corner. If neither is a valid triangulation, because the polygon is not
    convex, ears are cut off it (Meisters 1975). If opposite edges of the triangles are cancelled,
    those of the polygon always remain. So a polygon that crosses itself gets triangles that
    overlap, but in a winding number they still add up to the polygon.

    vertices: (n, 3).
    corners: the vertex indices of all polygons, one polygon after the other.
    sizes: (m,) the number of corners of each polygon; polygons with fewer than three yield no
        triangles.

    Raises:
        MeshError: the triangulation would take too long, because of the number of non-convex
            polygons and of their corners.
    """
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    begins = np.cumsum(sizes) - sizes
    triangles = [np.zeros((0, 3), dtype=np.int64)]
    polygon_of_triangles = [np.zeros(0, dtype=np.int64)]
    work = 0
    for group in _group_by_size(sizes):
        corner_count = int(sizes[group[0]])
        polygons = corners[begins[group][:, None] + np.arange(corner_count)]
        is_concave = np.zeros(len(group), dtype=bool)
        if corner_count > 3:
            is_concave = _fan_is_invalid(vertices, polygons)
            # The fan around the second corner is the fan around the first corner of the rotated
            # polygon.
            polygons[is_concave] = np.roll(polygons[is_concave], -1, axis=1)
            # A quadrilateral has no other triangulation.
            is_concave[is_concave] = corner_count > 4 and _fan_is_invalid(
                vertices, polygons[is_concave]
            )
        work += int(is_concave.sum()) * (corner_count * corner_count + _WORK_PER_POLYGON)
        if work > _MAX_EAR_WORK:
            raise MeshError(
                f"{is_concave.sum():,} polygons with dents and {corner_count:,} corners each take "
                "too long to triangulate: let the program that made the file triangulate them"
            )
        triangles.append(_fans(polygons[~is_concave]))
        polygon_of_triangles.append(np.repeat(group[~is_concave], corner_count - 2))
        projections = _projections(vertices, polygons[is_concave])
        for owner, polygon, projection in zip(
            group[is_concave], polygons[is_concave], projections, strict=True
        ):
            triangles.append(_clip_ears(polygon, projection))
            polygon_of_triangles.append(np.full(len(triangles[-1]), owner))
    # In the order of the polygons again.
    return np.concatenate(triangles)[
        np.argsort(np.concatenate(polygon_of_triangles), kind="stable")
    ]


def _group_by_size(sizes: IntArray) -> list[IntArray]:
    """Group polygons by their numbers of corners. Polygons with fewer than three corners are left
    out.

    sizes: (n,) the number of corners of each polygon.

    Returns a list of arrays of indices of polygons. All polygons of an array have the same number
    of corners, and together at most two million corners, which limits memory.
    """
    order = np.argsort(sizes, kind="stable")
    order = order[sizes[order] >= 3]
    # The first polygon of each number of corners, in this order.
    distinct, first = np.unique(sizes[order], return_index=True)
    groups: list[IntArray] = []
    for corner_count, begin, end in zip(distinct, first, [*first[1:], len(order)], strict=True):
        polygons_at_once = max(1, _CORNERS_PER_GROUP // int(corner_count))
        groups += [
            order[k : min(k + polygons_at_once, end)] for k in range(begin, end, polygons_at_once)
        ]
    return groups


def _fans(polygons: IntArray) -> IntArray:
    """Divide polygons into triangles by the diagonals from their first corners. Returns the
    triangles (m (k - 2), 3) of m polygons with k corners each, polygon after polygon.

    polygons: (m, k) indices of vertices.
    """
    first = np.broadcast_to(polygons[:, :1], polygons[:, 2:].shape)
    return np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2).reshape(-1, 3)


def _fan_is_invalid(vertices: FloatArray, polygons: IntArray) -> BoolArray:
    """(m,) for each polygon, whether a triangle of the fan around its first corner (the triangles
    between the diagonals from there) is reversed or flat. Polygons of zero area count as convex.

    vertices: (n, 3).
    polygons: (m, k) indices of vertices.
    """
    points = vertices[polygons]
    diagonals = points[:, 1:] - points[:, :1]
    areas = np.cross(diagonals[:, :-1], diagonals[:, 1:])
    normal = areas.sum(axis=1)
    square = np.einsum("mj,mj->m", normal, normal)
    # No positive component along the polygon's mean normal.
    is_turned = np.einsum("mkj,mj->mk", areas, normal) <= _FLAT_AREA * square[:, None]
    return is_turned.any(axis=1) & (square > 0.0)


def _projections(vertices: FloatArray, polygons: IntArray) -> FloatArray:
    """Project polygons to planes, each along its mean normal. Returns plane coordinates (m, k, 2),
    in which the polygons run counter-clockwise and have a size of about 1.

    vertices: (n, 3).
    polygons: (m, k) indices of vertices.
    """
    offsets = vertices[polygons]
    offsets = offsets - offsets[:, :1]
    normal = np.cross(offsets[:, :-1], offsets[:, 1:]).sum(axis=1)
    # The axis most across the normal gives a first tangent, the cross product the second.
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    second = np.cross(normal, first)
    size = np.abs(offsets).max(axis=(1, 2), keepdims=True)[..., 0]  # (m, 1)
    axes = [axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True) * size, 1e-300)
            for axis in (first, second)]  # fmt: skip
    return np.stack([np.einsum("mkj,mj->mk", offsets, axis) for axis in axes], axis=2)


def _clip_ears(polygon: IntArray, projection: FloatArray) -> IntArray:
    """Triangulate a polygon by cutting off ears (triangles at convex corners). Returns its
    triangles, k - 2 of them for k corners; a polygon that crosses itself may give another number.

    polygon: (k,) indices of vertices.
    projection: (k, 2) the polygon in the plane.
    """
    import mapbox_earcut  # imported here, since most files do not need it

    ears = np.zeros((0, 3), dtype=np.int64)
    if np.isfinite(projection).all():
        # A single ring of points, which ends after the last one: there are no holes.
        ends = np.array([len(polygon)], dtype=np.uint32)
        indices = mapbox_earcut.triangulate_float64(_perturb_straight_corners(projection), ends)
        ears = polygon[indices.reshape(-1, 3)]
    if len(ears) == len(polygon) - 2:
        return ears
    # The polygon crosses or touches itself, and corners were dropped: fans fill what remains.
    remaining = join_edges(boundary_edges([polygon.tolist(), *ears[:, ::-1].tolist()]))
    return np.concatenate([ears, *(_fans(np.array([loop])) for loop in remaining)])


def _perturb_straight_corners(projection: FloatArray) -> FloatArray:
    """Move each corner of a polygon that is in the middle of a straight edge inwards by a tiny
    amount. Ear clipping then does not cut off such a corner, which would give a triangle of zero
    area. Returns the polygon (k, 2).

    projection: (k, 2) the polygon in the plane, counter-clockwise and of size about 1.
    """
    arriving, leaving = (
        projection - np.roll(projection, 1, axis=0),
        np.roll(projection, -1, axis=0) - projection,
    )
    turn = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    is_straight = (np.abs(turn) <= _FLAT_AREA) & ((arriving * leaving).sum(axis=1) > 0.0)
    ends = np.flatnonzero(~is_straight)
    # All corners are straight, or none is.
    if len(ends) in (0, len(projection)):
        return projection
    k = np.arange(len(projection))
    # The ends of the straight edge that each corner is on.
    edge_begin = projection[ends[np.searchsorted(ends, k, side="right") - 1]]
    edge_end = projection[ends[np.searchsorted(ends, k) % len(ends)]]
    edge = edge_end - edge_begin
    length = np.maximum(np.linalg.norm(edge, axis=1), 1e-300)
    product_of_distances = np.linalg.norm(projection - edge_begin, axis=1) * np.linalg.norm(
        edge_end - projection, axis=1
    )
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / length[:, None]
    return projection + _INWARD_CURVATURE * product_of_distances[:, None] * inward
