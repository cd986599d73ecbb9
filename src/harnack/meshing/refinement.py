"""The refinement of triangle meshes of a level set. Edges are split where the mesh is too far from
the level set, the new vertices are moved onto it, and vertices are smoothed. "The function" is f -
level for a field f, so the level set is where it is 0; "normals" of the level set are its
gradients, normalized. A "crease" is a sharp edge of the level set. "Boundary edges" belong to one
face only; they and their vertices stay as they are, unless "walls" are given: a box on whose faces
the boundary lies.

The distance of a point from the level set is estimated as |f - level|/|gradient|.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    boundary_edges,
    half_edges,
    limited_rows,
    longest_edges,
    row_dots,
    row_norms,
    unit_rows,
)
from harnack.meshing.checks import check_triangle_limit
from harnack.meshing.delaunay_points import newton_to_level
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.meshing.mesh_improvement import collapse_slivers, flip_edges, relax_vertices

__all__ = [
    "cuts_off_crease",
    "fan_faces",
    "improve",
    "refine",
    "smooth",
    "smooth_within_tolerance",
    "split_faces",
    "unrefined_midpoints",
]

Walls = tuple[FloatArray, FloatArray] | None
# A function from points (k, 3) to the mask (k,) of those that matter; None if all do.
Where = Callable[[FloatArray], BoolArray] | None
# At the two ends of an edge that cuts off a crease, normals differ by an angle a of more than the
# first number; at a point between the ends and at one of the ends, by more than a times the second.
_CREASE, _SHARE = math.radians(20), 0.75
# A vertex within this distance, relative to the tolerance, counts as on the surface.
_ON_SURFACE = 1e-5
# The largest distance of a crease from the middle of an edge, relative to the edge.
_OFFSET = 1.5
# A point on a crease is not used if it is nearer to an end of the edge than this fraction of the
# edge; and the number of samples of the search for it, which is done twice.
_FROM_ENDS, _SAMPLES = 0.05, 33
# The level set is searched for up to this multiple of the displacement to the point where tangent
# planes meet; and three planes meet in a point if the determinant of their unit normals is larger
# than the second.
_SEARCH_LENGTH, _INDEPENDENT = 1.25, 0.1
# Edges shorter than this, relative to the tolerance, are never cut.
_MIN_EDGE_LENGTH = 0.5
_MOST_ROUNDS = 12
# The number of edges and centers to be cut grows at first, and then falls. If it grows to this
# multiple of its smallest value before, refinement will not end: the surface bends within any
# triangle, as around each dipole of a cloud.
_DIVERGENCE_FACTOR = 3


def refine(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
    report: Callable[[str], None],
    where: Where = None,
) -> tuple[FloatArray, IntArray]:
    """Split edges at their midpoints, and move the new vertices onto the level set, until the mesh
    is within `tolerance` of it.

    That is, until the midpoints of all edges, except boundary edges, and the centers of all faces
    are within the tolerance (a length). It also ends if refinement is found to diverge, and after
    12 rounds; then the mesh is not within the tolerance, which the caller has to check
    (`check_near_level`).

    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary lies.
        If it is None, boundary edges stay as they are; otherwise they are split too.
    report: called with messages about progress.
    where: a function of points (k, 3) that returns the mask (k,) of the points that lie in the
        region to be refined; None for everywhere. An edge that leads out of that region may be
        split as well. Its midpoint is always moved onto the level set: otherwise the new edges
        would end off the level set, and would be split again and again.

    Returns the vertices and the faces.

    Raises:
        TriangleLimitError: it takes more triangles than the function allows.
    """
    smallest_count, last_count = math.inf, 0
    for round_number in range(_MOST_ROUNDS):
        report(f"refining, round {round_number + 1}: {len(faces):,} triangles")
        marks = _RefinementMarks.of(function, vertices, faces, tolerance, walls, where)
        is_split = marks.marked
        count = int(is_split.sum()) + int(marks.misses_corner.sum())
        if not count:
            break
        if count > _DIVERGENCE_FACTOR * smallest_count:
            break
        # The smallest count so far, once counts have begun to fall: they may grow at first.
        smallest_count = min(smallest_count, count) if count < last_count else smallest_count
        last_count = count
        # Every edge that is cut adds one triangle on each side, and so does every center.
        check_triangle_limit(len(faces) + 2 * count, function.most_faces)
        # The midpoints of the edges that are split become new vertices.
        samples, max_step = marks.samples.select(is_split), 0.5 * marks.span[is_split]
        moved = newton_to_level(function, marks.middle[is_split], samples, max_step, walls)
        if function.field.traits.has_creases:
            moved = _project_to_creases(function, vertices, marks.ends[is_split], moved, walls)
        new_vertex = np.full(len(is_split), -1, np.int64)
        new_vertex[is_split] = len(vertices) + np.arange(int(is_split.sum()))
        vertices = np.concatenate([vertices, moved])
        # Faces with a new vertex in their interior become a fan of three around it.
        is_fan = marks.misses_corner & ~is_split[marks.edges].any(axis=1)
        fan_centers = len(vertices) + np.arange(np.count_nonzero(is_fan))
        vertices = np.concatenate(
            [vertices, _crease_corners(function, vertices, faces[is_fan], walls)]
        )
        smaller_faces = split_faces(vertices, faces[~is_fan], new_vertex[marks.edges[~is_fan]])
        faces = np.concatenate([smaller_faces, fan_faces(faces[is_fan], fan_centers)])
    if function.field.traits.has_variable_accuracy:
        vertices = _converge_vertices(function, vertices, faces, tolerance, walls)
    return vertices, faces


def _converge_vertices(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float, walls: Walls
) -> FloatArray:
    """Make more steps of Newton's method for the vertices that are not yet on the level set.
    Returns all vertices (n, 3).

    There are such vertices beside the dipoles of a point cloud, where the gradient changes much
    within a step. A vertex is moved only if that brings it closer to the level set, and by less
    than `tolerance` (a length). Boundary vertices stay if `walls` is None.

    function: f - level for a field f; it is 0 on the level set.
    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary lies.
    """
    samples = function.sample(vertices)
    is_off = samples.distance > _ON_SURFACE * tolerance
    if walls is None:
        is_off[boundary_edges(faces)] = False
    rows = np.flatnonzero(is_off)
    if not len(rows):
        return vertices
    max_step = np.full(len(rows), 0.5 * tolerance)
    # Twenty short steps, of half of the tolerance at most.
    moved = newton_to_level(
        function, vertices[rows], samples.select(rows), max_step, walls, steps=20
    )
    is_closer = np.abs(function.sample(moved).value) < np.abs(samples.value[rows])
    is_closer &= row_norms(moved - vertices[rows]) < tolerance
    vertices = vertices.copy()
    vertices[rows[is_closer]] = moved[is_closer]
    return vertices


def _project_to_creases(
    function: LevelFunction, vertices: FloatArray, ends: IntArray, moved: FloatArray, walls: Walls
) -> FloatArray:
    """The new vertices (k, 3) of k edges that are split. If an edge cuts off a sharp crease of the
    level set, its new vertex is put onto the crease; otherwise it is the given one.

    function: f - level for a field f; it is 0 on the level set.
    ends: (k, 2) the indices of the vertices at the ends of each edge.
    moved: (k, 3) the given new vertices: the midpoints of the edges, moved onto the level set by
        Newton's method.
    walls: None, or the lower and the upper corner (3,) of a box to which points are confined.

    Newton's method moves a midpoint to one of the two sides of a crease, possibly back to an end of
    the edge; then splitting would not shorten the edge. Instead, take the line in which the tangent
    planes at both ends meet, and its point nearest to the midpoint. It is on the crease if the
    sides of the crease are flat (Kobbelt et al. 2001). The new vertex is where the segment from the
    midpoint to this point passes the level.

    An edge cuts off a crease if the normals at its ends differ by an angle a of more than 20
    degrees, and the normal at the moved midpoint differs from one of them by nearly a (on a smooth
    surface, by about a/2). For other edges the given vertex is kept. It is also kept if the segment
    does not pass the level, or passes it too near to an end of the edge.
    """
    used, vertex_rows = np.unique(ends, return_inverse=True)
    gradient = function.sample(vertices[used]).gradient
    end_normals = unit_rows(gradient)[vertex_rows.reshape(-1, 2)]
    midpoint_normal = unit_rows(function.sample(moved).gradient)
    n_a, n_b = end_normals[:, 0], end_normals[:, 1]
    cosine = row_dots(n_a, n_b)
    # The last condition: the tangent planes are not nearly parallel, so that they meet in a line.
    rows = np.flatnonzero(
        cuts_off_crease(n_a, n_b, midpoint_normal, _CREASE) & (1 - cosine**2 > 0.01)
    )
    if not len(rows):
        return moved
    n_a, n_b, cosine = n_a[rows], n_b[rows], cosine[rows]
    a, b = (vertices[ends[rows, k]] for k in (0, 1))
    middle, span = 0.5 * (a + b), row_norms(b - a)
    # The point nearest to the midpoint is u n_a + v n_b, relative to the midpoint, with u and v
    # such that it lies in both planes: n_a . point = h_a and n_b . point = h_b.
    h_a, h_b = row_dots(n_a, a - middle), row_dots(n_b, b - middle)
    weights = np.stack([h_a - cosine * h_b, h_b - cosine * h_a]) / (1 - cosine**2)
    direction = weights[0][:, None] * n_a + weights[1][:, None] * n_b
    # Segments to the crease are at most `_OFFSET` times as long as the edge.
    projected, is_found = _level_along(function, middle, direction, _OFFSET * span, walls)
    is_found &= np.minimum(row_norms(projected - a), row_norms(projected - b)) > _FROM_ENDS * span
    moved = moved.copy()
    moved[rows[is_found]] = projected[is_found]
    return moved


def cuts_off_crease(
    first: FloatArray, second: FloatArray, between: FloatArray, min_angle: float
) -> BoolArray:
    """Return the mask (k,) of the edges of a mesh that cut off a crease of the surface.

    An edge does if the normals at its two ends differ by an angle a > `min_angle` (in radians), and
    the normal between them differs from one of the two by nearly a. Then the surface bends in one
    place only, on one side of the point between. On a smooth surface the normal between differs
    from each of the two by about a/2.

    first, second: (k, 3) unit normals of the surface at the two ends of each edge.
    between: (k, 3) unit normals at a point of the surface between the ends.
    """
    # The larger of the two angles between the normal at the point between and those at the ends has
    # the smaller cosine.
    angle_of_ends, angle_to_end = (
        np.arccos(np.clip(cosine, -1, 1))
        for cosine in (
            row_dots(first, second),
            np.minimum(row_dots(first, between), row_dots(second, between)),
        )
    )
    return (angle_of_ends > min_angle) & (angle_to_end > _SHARE * angle_of_ends)


def _crease_corners(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, walls: Walls
) -> FloatArray:
    """New vertices (k, 3) on the level set for faces (k, 3) that cut off a corner of the level set,
    one for each face.

    If the normals at the three vertices of a face are linearly independent, the tangent planes at
    these vertices meet in a point. The new vertex is where the segment from the face's center to
    this point passes the level. If it does not pass the level, or if the normals are dependent, the
    new vertex is the center of the face, moved onto the level set by Newton's method.

    function: f - level for a field f; it is 0 on the level set.
    walls: None, or the lower and the upper corner (3,) of a box to which points are confined.
    """
    corner = vertices[faces]
    center = corner.mean(axis=1)
    longest_edge = longest_edges(corner)
    moved = newton_to_level(function, center, function.sample(center), 0.5 * longest_edge, walls)
    normal = unit_rows(function.sample(corner.reshape(-1, 3)).gradient).reshape(-1, 3, 3)
    rows = np.flatnonzero(np.abs(np.linalg.det(normal)) > _INDEPENDENT)
    # The planes n_k . p = offset_k, with p relative to the center.
    offsets = (normal * (corner - center[:, None])).sum(axis=2)
    solve: Any = np.linalg.solve
    direction: FloatArray = solve(normal[rows], offsets[rows][:, :, None])[:, :, 0]
    # Segments to the corner are at most `_OFFSET` times as long as the longest edge.
    crossing, is_found = _level_along(
        function, center[rows], direction, _OFFSET * longest_edge[rows], walls
    )
    moved[rows[is_found]] = crossing[is_found]
    return moved


def _level_along(
    function: LevelFunction, start: FloatArray, along: FloatArray, limit: FloatArray, walls: Walls
) -> tuple[FloatArray, BoolArray]:
    """Search for the level set along segments.

    function: f - level for a field f; it is 0 on the level set.
    start, along: (k, 3) the start of each segment, and the vector to its end. A vector longer than
        `limit` (k,) is shortened to that length. The search goes a quarter of the length beyond the
        end.
    walls: None, or the lower and the upper corner (3,) of a box to which points are confined.

    Returns:
        The first crossing (k, 3) of the level on each segment; and the mask (k,) of the segments
        that cross the level. If a segment does not cross it, its point has no meaning.
    """
    along = limited_rows(along, limit)
    low, high = np.zeros(len(start)), np.full(len(start), _SEARCH_LENGTH)
    is_found = np.ones(len(start), np.bool_)
    fractions = np.linspace(0, 1, _SAMPLES)
    # Evaluate at 33 points, then at 33 points within the first interval with a change of sign.
    for _ in range(2):
        t = low[:, None] + (high - low)[:, None] * fractions
        x = start[:, None] + t[:, :, None] * along[:, None]
        x = x if walls is None else np.clip(x, *walls)
        is_above = (function.sample(x.reshape(-1, 3)).value > 0).reshape(t.shape)
        changes_sign = is_above[:, 1:] != is_above[:, :-1]
        is_found &= changes_sign.any(axis=1)
        first_change = changes_sign.argmax(axis=1)[:, None]
        low, high = (np.take_along_axis(t, first_change + k, axis=1)[:, 0] for k in (0, 1))
    crossing = start + low[:, None] * along
    crossing = crossing if walls is None else np.clip(crossing, *walls)
    # Newton's steps are at most four of the last intervals long.
    max_step = 4 * (high - low) * row_norms(along)
    return newton_to_level(function, crossing, function.sample(crossing), max_step, walls), is_found


def unrefined_midpoints(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> FloatArray:
    """Return the midpoints (k, 3) of the edges of a mesh that `refine` would still split, because
    the mesh is farther than `tolerance` (a length) from the level set there.

    function: f - level for a field f; it is 0 on the level set.
    vertices, faces: the mesh, (n, 3) and (m, 3).
    """
    # Without walls, and everywhere.
    marks = _RefinementMarks.of(function, vertices, faces, tolerance, None, None)
    return marks.middle[marks.marked]


@dataclass(frozen=True)
class _RefinementMarks:
    """Which edges of a mesh with m faces and k edges are to be split, because the mesh is too far
    from the level set; and the measurements from which that follows.

    edges: (m, 3) the indices of the edges of each face.
    ends: (k, 2) the vertices at the ends of each edge.
    middle: (k, 3) the midpoints of the edges. span: (k,) their lengths.
    samples: values and gradients of the function at the midpoints.
    is_beyond: (k,) the mask of the edges whose midpoint is farther than the tolerance from the
        level set (and lies in the region that is refined).
    is_off: (m,) the mask of the faces whose center is that far.
    marked: (k,) the mask of the edges to be split.
    misses_corner: (m,) the mask of the faces that cut off a corner of the surface, where creases
        meet: their center is too far from the level set, but no midpoint of their edges is. Such a
        face gets a new vertex in its interior."""

    edges: IntArray
    ends: IntArray
    middle: FloatArray
    span: FloatArray
    samples: LevelSamples
    is_beyond: BoolArray
    is_off: BoolArray
    marked: BoolArray
    misses_corner: BoolArray

    @classmethod
    def of(
        cls,
        function: LevelFunction,
        vertices: FloatArray,
        faces: IntArray,
        tolerance: float,
        walls: Walls,
        where: Where,
    ) -> _RefinementMarks:
        """Decide which edges of a mesh are to be split.

        These are the edges whose midpoint is farther than `tolerance` (a length) from the level
        set; and of each face whose center is that far, the longest edge that may be split. Boundary
        edges and very short edges are never split. If the function has creases and a face cuts off
        a corner, no edge is split for the sake of its center; it is noted in `misses_corner`.

        vertices, faces: (n, 3), (m, 3) the mesh.
        walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary of
            the mesh lies; then boundary edges may be split too.
        where: a function of points (k, 3) that returns the mask (k,) of the points that lie in the
            region to be refined; others are taken to be on the level set. None: all lie in it."""
        ends, edges, is_boundary = _edges(faces)
        if walls is not None:  # the boundary lies in the walls, and so do the middles of its edges
            is_boundary = np.zeros_like(is_boundary)
        middle = 0.5 * (vertices[ends[:, 0]] + vertices[ends[:, 1]])
        span = row_norms(vertices[ends[:, 0]] - vertices[ends[:, 1]])
        center = vertices[faces].mean(axis=1)
        samples = function.sample(middle)
        is_beyond = samples.distance > tolerance
        is_off = function.sample(center).distance > tolerance
        if where is not None:
            is_beyond &= where(middle)
            is_off &= where(center)
        marked = is_beyond.copy()
        must_split = is_off & (span[edges].max(axis=1) > _MIN_EDGE_LENGTH * tolerance)
        misses_corner = np.zeros(len(faces), np.bool_)
        # Faces whose center is far although no midpoint of their edges is.
        center_only_rows = np.flatnonzero(must_split & ~marked[edges].any(axis=1))
        if function.field.traits.has_creases:
            misses_corner[center_only_rows] = _normals_turn(
                function, vertices[faces[center_only_rows]]
            )
        must_split &= ~misses_corner
        # For a face that is off the surface, the longest edge that may be cut.
        splittable_length = np.where(is_boundary[edges], 0.0, span[edges])
        longest_edge = edges[np.arange(len(faces)), splittable_length.argmax(axis=1)]
        marked[longest_edge[must_split]] = True
        marked &= ~is_boundary & (span > _MIN_EDGE_LENGTH * tolerance)
        return cls(edges, ends, middle, span, samples, is_beyond, is_off, marked, misses_corner)


def _normals_turn(function: LevelFunction, corner: FloatArray) -> BoolArray:
    """(k,) for each of k faces, whether the level set between its corners has a crease: the normals
    at two corners differ by more than 20 degrees.

    function: f - level for a field f; it is 0 on the level set.
    corner: (k, 3, 3) the corners of the faces."""
    normal = unit_rows(function.sample(corner.reshape(-1, 3)).gradient).reshape(-1, 3, 3)
    cosines = [row_dots(normal[:, k], normal[:, k - 1]) for k in range(3)]
    return np.min(cosines, axis=0) < math.cos(_CREASE)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """The edges of faces (m, 3).

    Returns:
        The vertices (k, 2) of all edges; the indices (m, 3) of the edges of each face, first the
        edge between its first two corners; and the mask (k,) of the edges that belong to one face
        only.
    """
    edges = Edges.of(half_edges(faces))
    return edges.vertices, edges.edge_of_pair.reshape(3, -1).T, edges.multiplicity == 1


def fan_faces(faces: IntArray, centers: IntArray) -> IntArray:
    """Divide each of the faces (k, 3) into a fan of three around a new vertex in its interior.
    Returns the faces (3k, 3). centers: (k,) the indices of the new vertices."""
    a, b, c = faces.T
    return np.concatenate([np.stack([*ends, centers], 1) for ends in ((a, b), (b, c), (c, a))])


def split_faces(vertices: FloatArray, faces: IntArray, middle: IntArray) -> IntArray:
    """Split faces (m, 3) at the midpoints of some of their edges, into two, three or four faces
    each. Returns all faces (k, 3), unsplit ones first.

    vertices: (n, 3) the positions of all vertices, midpoints included.
    middle: (m, 3) the vertices at the midpoints of the edges 01, 12 and 20 of each face; -1 for
        edges that are not split.

    If two edges of a face are split, what is left beside the corner between them is a
    quadrilateral. It is divided along its shorter diagonal."""
    is_edge_split = middle >= 0
    split_count = is_edge_split.sum(axis=1)
    parts = [faces[split_count == 0]]
    # All three edges split: three faces at the corners and one in the middle.
    has_three = split_count == 3
    (a, b, c), (x, y, z) = faces[has_three].T, middle[has_three].T
    parts += [np.stack(t, axis=1) for t in ((a, x, z), (x, b, y), (z, y, c), (x, y, z))]
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        # One edge split, from a to b: two faces.
        has_one = (split_count == 1) & is_edge_split[:, k]
        (a, b, c), x = faces[has_one][:, order].T, middle[has_one, k]
        parts += [np.stack(t, axis=1) for t in ((a, x, c), (x, b, c))]
        has_two = (split_count == 2) & ~is_edge_split[:, k]
        # Two edges split: three faces. The edge from a to b is whole; y and z are the middles of
        # the other two.
        (a, b, c), y, z = (
            faces[has_two][:, order].T,
            middle[has_two, order[1]],
            middle[has_two, order[2]],
        )
        length_ay = row_norms(vertices[a] - vertices[y])
        length_bz = row_norms(vertices[b] - vertices[z])
        is_ay_shorter = (length_ay < length_bz)[:, None]
        parts.append(np.stack([z, y, c], axis=1))
        parts.append(np.where(is_ay_shorter, np.stack([a, b, y], 1), np.stack([a, b, z], 1)))
        parts.append(np.where(is_ay_shorter, np.stack([a, y, z], 1), np.stack([b, y, z], 1)))
    return np.concatenate(parts)


def improve(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Improve the angles of the triangles of a mesh. Returns the vertices (n, 3) and faces (m, 3).

    First, edges are flipped and vertices smoothed in turn. Then slivers are contracted, and edges
    are split where triangles are no longer within `tolerance` (a length) of the level set. Finally
    edges are flipped and vertices moved for larger angles.

    function: f - level for a field f; it is 0 on the level set.
    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary lies.
    report: called with messages about progress.
    """
    for _ in range(2):
        faces = flip_edges(function, vertices, faces, tolerance)
        vertices = smooth(function, vertices, faces, walls, rounds=2)
    is_boundary_vertex = np.zeros(len(vertices), np.bool_)
    is_boundary_vertex[boundary_edges(faces)] = True
    # Twice the tolerance, as the mesh is refined afterwards.
    faces = collapse_slivers(function, vertices, faces, is_boundary_vertex, 2 * tolerance)
    vertices, faces = refine(function, vertices, faces, tolerance, walls, report)
    for _ in range(2):
        faces = flip_edges(function, vertices, faces, tolerance)
        vertices = relax_vertices(function, vertices, faces, tolerance, walls)
    return vertices, flip_edges(function, vertices, faces, tolerance)


def smooth(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    walls: Walls,
    rounds: int = 3,
) -> FloatArray:
    """Smooth a mesh: in each of `rounds` rounds, every vertex is moved halfway to the mean of its
    neighbors, and then back onto the level set. Returns the vertices (n, 3).

    Boundary vertices stay. A vertex that does not come back to the level set stays too, and moves
    that turn a face by more than about 70 degrees are undone.

    function: f - level for a field f; it is 0 on the level set.
    walls: None, or the lower and the upper corner (3,) of a box to which vertices are confined.
    """
    ends, _, _ = _edges(faces)
    boundary = np.unique(boundary_edges(faces))
    is_free = np.zeros(len(vertices), np.bool_)
    is_free[np.unique(faces)] = True
    is_free[boundary] = False
    neighbor_count = np.maximum(np.bincount(ends.ravel(), minlength=len(vertices)), 1)
    free_rows = np.flatnonzero(is_free)
    size = float(np.ptp(vertices[is_free], axis=0).max(initial=0.0)) if len(free_rows) else 0.0
    for _ in range(rounds):
        neighbor_sum = np.zeros_like(vertices)
        # The sum of the neighbors of each vertex, over both directions of all edges.
        for i, j in ((0, 1), (1, 0)):
            for axis in range(3):
                neighbor_sum[:, axis] += np.bincount(
                    ends[:, i], vertices[ends[:, j], axis], minlength=len(vertices)
                )
        target = 0.5 * (vertices + neighbor_sum / neighbor_count[:, None])
        target_samples = function.sample(target[free_rows])
        # Newton's steps are limited to twice the move: beside the boundary, gradients turn. (1e-300
        # keeps the limit above 0.)
        move_length = row_norms(target[free_rows] - vertices[free_rows]) + 1e-300
        moved = vertices.copy()
        moved[free_rows] = newton_to_level(
            function, target[free_rows], target_samples, 2 * move_length, walls
        )
        moved_samples = function.sample(moved[free_rows])
        # Off the level set by more than rounding.
        is_off = moved_samples.distance > 1e-7 * size + 1e-12 * row_norms(moved[free_rows])
        moved[free_rows[is_off]] = vertices[free_rows[is_off]]
        vertices = _undo_flipped(vertices, moved, faces)
    return vertices


def smooth_within_tolerance(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    walls: Walls,
    tolerance: float,
    where: Where = None,
) -> FloatArray:
    """Smooth a mesh: move its vertices towards the mean of their neighbors and back onto the level
    set, for some rounds (`smooth`). Returns the vertices (n, 3).

    Beside a crease, that can move faces away from the level set. A face is too far if its center,
    or the midpoint of one of its edges, is farther than `tolerance` (a length) from it. The
    vertices of such faces get their former positions, and so do the vertices of the faces around
    them. If that does not come to an end, all vertices do.

    walls: None, or the lower and the upper corner (3,) of a box to which vertices are confined.
    where: a function of points (k, 3) that returns the mask (k,) of those that are to be within the
        tolerance; None for all."""
    after = smooth(function, vertices, faces, walls)
    rows = np.arange(len(faces))
    # At most eight rounds, each with more vertices at their former positions.
    for _ in range(8):
        marks = _RefinementMarks.of(function, after, faces[rows], tolerance, walls, where)
        is_off = np.zeros(len(faces), np.bool_)
        is_off[rows] = marks.is_beyond[marks.edges].any(axis=1) | marks.is_off
        is_reverted = np.zeros(len(vertices), np.bool_)
        for _ in range(2):  # together with neighbors, so that the loop ends soon
            is_reverted[faces[is_off]] = True
            is_off = is_reverted[faces].any(axis=1)
        is_reverted &= (after != vertices).any(axis=1)
        if not is_reverted.any():
            return after
        after = np.where(is_reverted[:, None], vertices, after)
        rows = np.flatnonzero(is_reverted[faces].any(axis=1))  # other faces have not changed
    return vertices


def _undo_flipped(before: FloatArray, after: FloatArray, faces: IntArray) -> FloatArray:
    """The vertices (n, 3) after a move, except that the move is undone at faces (m, 3) that it
    turned over: a face whose normal turned by more than about 70 degrees gets its former vertices.

    before, after: (n, 3) the vertices before and after the move.

    Undoing a move at some vertices may turn other faces over, so this is repeated. If it does not
    come to an end, all vertices get their positions in `before`."""
    # At most eight rounds.
    for _ in range(8):
        new_corner = after[faces]
        new_normal = area_normals(new_corner)
        old_corner = before[faces]
        old_normal = area_normals(old_corner)
        # The cosine between both normals is at most 0.3.
        is_turned = row_dots(new_normal, old_normal) <= 0.3 * row_norms(new_normal) * row_norms(
            old_normal
        )
        if not is_turned.any():
            return after
        after = after.copy()
        reverted = np.unique(faces[is_turned])
        after[reverted] = before[reverted]
    return before
