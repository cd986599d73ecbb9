"""The local repair of closed meshes of which a few vertices or centers of faces are too far from
the level set. "The function" is f - level for a field f; the level set is where it is 0. These
vertices and centers ("outliers") are moved onto the level set, and faces are split for that.

A triangle may lie across a crease of the surface, with its center near the level set. If another
solid cuts this triangle, the pieces have other centers and corners, which may be farther from the
level set; this happens for about one piece in a hundred thousand. Then the edges across the crease
are split at the crease, and the new faces are checked together with the faces around them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import edge_keys, half_edges, row_norms, sorted_unique
from harnack.meshing.delaunay_points import newton_to_level
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import MeshingError, OffLevelError
from harnack.meshing.refinement import fan_faces, split_faces
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.self_intersection_repair import resolve_local_intersections
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["project_outliers"]

# The largest number of locations that is mended; and how often faces may be cut, one after the
# other.
_MAX_OUTLIERS, _MAX_ROUNDS = 100, 4
# Edges of such faces are cut if their middle is farther off the level than this, in tolerances.
_MAX_MIDPOINT_DISTANCE = 0.5
# How far mending of intersections may move cut faces, in tolerances.
_MENDED_WITHIN = 0.25


def project_outliers(
    function: LevelFunction,
    surface: TriangleMesh,
    places: FloatArray,
    tolerance: float,
    check: Callable[[TriangleMesh], None],
) -> TriangleMesh | None:
    """Mend a closed surface of which a few vertices or centers of faces are too far from the level
    set.

    A vertex that is too far is moved onto the level set. A face whose center is too far is split at
    the midpoints of those of its edges that are off the level set, or at its center if there are
    none, and the new vertices are moved onto the level set. The changed faces are checked, and
    split again up to four times.

    surface: a mesh of which no triangles pass through each other, and nearly all are near the level
        set.
    places: (k, 3) the vertices and the centers of faces that are too far. Nothing is tried if there
        are more than 100.
    tolerance: a length; no point is moved farther than twice that.
    check: a function that raises a MeshingError for a surface that is not near the level set. It is
        called with the changed faces. Whether these pass through other triangles is decided
        exactly.

    Returns:
        The mended surface, or None if that fails.
    """
    if len(places) > _MAX_OUTLIERS:
        return None
    vertices, faces = surface.vertices, surface.faces
    is_new = np.zeros(len(faces), np.bool_)
    for _ in range(_MAX_ROUNDS):
        changed = _project_and_split(
            function, TriangleMesh(vertices, faces), is_new, places, tolerance
        )
        if changed is None:
            return None
        (vertices, faces), is_new = changed
        try:
            # New points off the level set are mended in the next round.
            check(TriangleMesh.without_unused_vertices(vertices, faces[is_new]))
        except OffLevelError as error:
            places = error.locations
            continue
        except MeshingError:
            return None
        return _check_new_faces(TriangleMesh(vertices, faces), is_new, tolerance, check)
    return None


def _project_and_split(
    function: LevelFunction,
    surface: TriangleMesh,
    is_new: BoolArray,
    points: FloatArray,
    tolerance: float,
) -> tuple[tuple[FloatArray, IntArray], BoolArray] | None:
    """Move the vertices that lie at one of `points` (k, 3) onto the level set, and split the faces
    whose center lies at one of them.

    A face is split at the midpoints of those of its edges that are off the level set by more than
    half of `tolerance` (a length), or at its center if there are none. The new vertices are moved
    onto the level set.

    function: f - level for a field f; it is 0 on the level set.
    is_new: (m,) the mask of the faces that earlier calls made.

    Returns:
        The vertices and the faces; and the mask of the faces to be checked: those made by this call
        or by earlier ones, and the faces at moved vertices. None if a point is neither a vertex nor
        the center of a face, or would be moved by more than two tolerances.
    """
    vertices, faces = surface.vertices, surface.faces
    moved_vertices = _rows_at(points, vertices)
    center_rows = _rows_at(points, vertices[faces].mean(axis=1))
    if len(moved_vertices) + len(center_rows) < len(points):
        return None
    split_edges = half_edges(faces[center_rows])
    midpoints = vertices[split_edges].mean(axis=1)
    split_edges = split_edges[
        function.sample(midpoints).distance > _MAX_MIDPOINT_DISTANCE * tolerance
    ]
    count = len(vertices)
    # A key is the number a * count + b for the edge between the vertices a < b.
    keys = sorted_unique(edge_keys(split_edges, count))
    ends = np.stack(np.divmod(keys, count), axis=1)
    # For each face the new vertices on its edges, or -1. Neighbors share the edges that are split.
    vertex_on_edge = np.full(faces.shape, -1, np.int64)
    rows = np.flatnonzero(np.isin(faces, ends).any(axis=1))
    position = np.searchsorted(keys, face_keys := edge_keys(half_edges(faces[rows]), count))
    position = np.minimum(position, max(len(keys) - 1, 0))
    if len(keys):
        is_cut = keys[position] == face_keys
        vertex_on_edge[rows] = np.where(is_cut, count + position, -1).reshape(3, -1).T
    # Other faces with a far center get a vertex there, and become a fan of three.
    fan_rows = np.setdiff1d(center_rows, np.flatnonzero((vertex_on_edge >= 0).any(axis=1)))
    # Move all three kinds of points at once: far vertices, new vertices on edges, new centers. Each
    # step is at most the tolerance, and there are no walls (None).
    start = np.concatenate(
        [
            vertices[moved_vertices],
            vertices[ends].mean(axis=1),
            vertices[faces[fan_rows]].mean(axis=1),
        ]
    )
    moved = newton_to_level(
        function, start, function.sample(start), np.full(len(start), tolerance), None
    )
    if not (row_norms(moved - start) <= 2 * tolerance).all():
        return None
    vertices = np.concatenate([vertices, moved[len(moved_vertices) :]])
    vertices[moved_vertices] = moved[: len(moved_vertices)]
    is_split = (vertex_on_edge >= 0).any(axis=1)
    split = split_faces(vertices, faces[is_split], vertex_on_edge[is_split])
    fan_centers = count + len(ends) + np.arange(len(fan_rows))
    # To be checked: new faces, and faces at moved vertices.
    removed_rows = np.union1d(np.flatnonzero(is_split), fan_rows)
    remaining = np.delete(faces, removed_rows, axis=0)
    is_moved = np.zeros(len(vertices), np.bool_)
    is_moved[moved_vertices] = True
    is_new = np.delete(is_new, removed_rows) | is_moved[remaining].any(axis=1)
    faces = np.concatenate([remaining, split, fan_faces(faces[fan_rows], fan_centers)])
    is_new = np.concatenate([is_new, np.ones(len(faces) - len(remaining), np.bool_)])
    return (vertices, faces), is_new


def _check_new_faces(
    surface: TriangleMesh,
    is_new: BoolArray,
    tolerance: float,
    check: Callable[[TriangleMesh], None],
) -> TriangleMesh | None:
    """Check that the new faces of a surface pass through no other faces; if they do, try to mend
    the surface by contracting and flipping edges.

    is_new: (m,) the mask of the new faces.
    tolerance: a length; one contraction or flip may move the surface by a quarter of it.
    check: a function that raises a MeshingError for a surface that is not near the level set.

    Returns:
        The surface, if no faces cross; the mended surface, if none cross any more and `check`
        accepts it; None otherwise.
    """
    vertices, faces = surface.vertices, surface.faces
    nearby = _in_boxes_of(vertices[faces], np.flatnonzero(is_new))
    crossing = nearby[intersecting_faces(vertices, faces[nearby])]
    if not len(crossing):
        return surface
    mended, remaining = resolve_local_intersections(surface, crossing, _MENDED_WITHIN * tolerance)
    if remaining:
        return None
    try:
        check(mended)
    except MeshingError:
        return None
    return mended


def _in_boxes_of(triangles: FloatArray, rows: IntArray) -> IntArray:
    """The indices of the triangles (m, 3, 3) whose bounding box meets that of one of the triangles
    with the indices `rows`."""
    lower, upper = triangles.min(axis=1), triangles.max(axis=1)
    meets = np.zeros(len(triangles), np.bool_)
    for row in rows.tolist():
        meets |= (lower <= upper[row]).all(axis=1) & (upper >= lower[row]).all(axis=1)
    return np.flatnonzero(meets)


def _rows_at(targets: FloatArray, points: FloatArray) -> IntArray:
    """The indices of those of the points (n, 3) that are equal to one of the targets (k, 3), bit by
    bit."""
    rows = np.flatnonzero(np.isin(points[:, 0], targets[:, 0]))
    is_equal = (points[rows, None] == targets).all(axis=2).any(axis=1)
    return rows[is_equal]
