"""The refinement of meshes: edges are split where the surface is too far from them, vertices are
moved onto the surface and smoothed.

Vertices and edges of the boundary stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import check_triangle_limit
from harnack.meshing.delaunay_points import newton_to_level
from harnack.meshing.edges import (
    Edges,
    IntArray,
    area_normals,
    boundary_edges,
    half_edges,
    row_dots,
    row_norms,
)
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.meshing.mesh_improvement import collapse_slivers, flip_edges, relax_vertices

__all__ = [
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
# Across a crease normals turn by at least this angle; and by this fraction of the angle between the
# middle of an edge and one of its ends.
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
    are within the tolerance (a length); or until refinement is found to diverge, which the caller
    has to check (`check_near_level`).

    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary lies.
        If it is None, boundary edges stay as they are; otherwise they are split too.
    where: a function of points (k, 3) that returns the mask (k,) of the points that lie in the
        region to be refined; None for everywhere. An edge that leads out of that region may be
        split as well. Its midpoint is always moved onto the level set: otherwise the new edges
        would end off the level set, and would be split again and again.

    Returns the vertices and the faces.

    Raises:
        TriangleLimitError: it takes more triangles than the function allows.
    """
    smallest_count, before = math.inf, 0
    for round_number in range(_MOST_ROUNDS):
        report(f"refining, round {round_number + 1}: {len(faces):,} triangles")
        marks = _RefinementMarks.of(function, vertices, faces, tolerance, walls, where)
        marked = marks.marked
        count = int(marked.sum()) + int(marks.misses_corner.sum())
        if not count:
            break
        if count > _DIVERGENCE_FACTOR * smallest_count:
            break
        smallest_count = min(smallest_count, count) if count < before else smallest_count
        before = count
        # Every edge that is cut adds one triangle on each side, and so does every center.
        check_triangle_limit(len(faces) + 2 * count, function.most_faces)
        samples, reach = marks.samples.select(marked), 0.5 * marks.span[marked]
        moved = newton_to_level(function, marks.middle[marked], samples, reach, walls)
        if function.field.has_creases:
            moved = _project_to_creases(function, vertices, marks.ends[marked], moved, walls)
        new_vertex = np.full(len(marked), -1, np.int64)
        new_vertex[marked] = len(vertices) + np.arange(int(marked.sum()))
        vertices = np.concatenate([vertices, moved])
        cut_off = marks.misses_corner & ~marked[marks.edges].any(axis=1)
        inner = len(vertices) + np.arange(np.count_nonzero(cut_off))
        vertices = np.concatenate(
            [vertices, _crease_corners(function, vertices, faces[cut_off], walls)]
        )
        a, b, c = faces[cut_off].T
        fans = [np.stack([*ends, inner], axis=1) for ends in ((a, b), (b, c), (c, a))]
        split = split_faces(vertices, faces[~cut_off], new_vertex[marks.edges[~cut_off]])
        faces = np.concatenate([split, *fans])
    if function.field.has_variable_accuracy:
        vertices = _converge_vertices(function, vertices, faces, tolerance, walls)
    return vertices, faces


def _converge_vertices(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float, walls: Walls
) -> FloatArray:
    """Make more of Newton's steps for the vertices that are not yet on the level set. Returns all
    vertices (n, 3).

    There are such vertices beside the dipoles of a point cloud, where the gradient changes much
    within a step. A vertex is moved only if that brings it closer to the level set, and by less
    than `tolerance` (a length). Boundary vertices stay if `walls` is None.

    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary
        lies."""
    samples = function.sample(vertices)
    is_off = samples.distance > _ON_SURFACE * tolerance
    if walls is None:
        is_off[boundary_edges(faces)] = False
    rows = np.flatnonzero(is_off)
    if not len(rows):
        return vertices
    max_step = np.full(len(rows), 0.5 * tolerance)
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
    surface, its new vertex is put onto the crease; otherwise it is the given one.

    ends: (k, 2) the indices of the vertices at the ends of each edge.
    moved: (k, 3) the midpoints of the edges, moved onto the level set by Newton's method.
    walls: None, or the lower and the upper corner (3,) of a box to which points are confined.

    Newton's method moves a midpoint to one of the two sides of a crease, possibly back to an end of
    the edge; then splitting would not shorten the edge. Instead, take the point nearest to the
    midpoint in the line in which the tangent planes at both ends meet. It is on the crease if the
    sides of the crease are flat (Kobbelt et al. 2001). The new vertex is where the segment from the
    midpoint to this point passes the level.

    An edge cuts off a crease if the normals at its ends differ by 20 degrees or more, and the
    normals at the moved midpoint and at one of the ends differ by nearly that angle. On a smooth
    surface the latter two differ by about half of it."""
    used, index = np.unique(ends, return_inverse=True)
    slope = function.sample(vertices[used]).gradient
    at_ends = (slope / np.maximum(row_norms(slope), 1e-300)[:, None])[index.reshape(-1, 2)]
    n = function.sample(moved).gradient
    n = n / np.maximum(row_norms(n), 1e-300)[:, None]
    n_a, n_b = at_ends[:, 0], at_ends[:, 1]
    cosine = row_dots(n_a, n_b)
    angle = np.arccos(np.clip(np.minimum(row_dots(n_a, n), row_dots(n_b, n)), -1, 1))
    total = np.arccos(np.clip(cosine, -1, 1))
    rows = np.flatnonzero((total > _CREASE) & (angle > _SHARE * total) & (1 - cosine**2 > 0.01))
    if not len(rows):
        return moved
    n_a, n_b, cosine = n_a[rows], n_b[rows], cosine[rows]
    a, b = (vertices[ends[rows, k]] for k in (0, 1))
    middle, span = 0.5 * (a + b), row_norms(b - a)
    h_a, h_b = row_dots(n_a, a - middle), row_dots(n_b, b - middle)
    weights = np.stack([h_a - cosine * h_b, h_b - cosine * h_a]) / (1 - cosine**2)
    direction = weights[0][:, None] * n_a + weights[1][:, None] * n_b
    projected, found = _level_along(function, middle, direction, _OFFSET * span, walls)
    found &= np.minimum(row_norms(projected - a), row_norms(projected - b)) > _FROM_ENDS * span
    moved = moved.copy()
    moved[rows[found]] = projected[found]
    return moved


def _crease_corners(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, walls: Walls
) -> FloatArray:
    """New vertices (k, 3) on the level set for faces (k, 3) that cut off a corner of the surface,
    one for each face.

    If the normals at the three vertices of a face are linearly independent, the tangent planes at
    these vertices meet in a point. The new vertex is where the segment from the face's center to
    this point passes the level. If it does not pass the level, or if the normals are dependent, the
    new vertex is the center of the face, moved onto the level set by Newton's method."""
    corner = vertices[faces]
    center = corner.mean(axis=1)
    span = np.stack([row_norms(corner[:, k] - corner[:, k - 1]) for k in range(3)]).max(axis=0)
    moved = newton_to_level(function, center, function.sample(center), 0.5 * span, walls)
    slope = function.sample(corner.reshape(-1, 3)).gradient
    normal = (slope / np.maximum(row_norms(slope), 1e-300)[:, None]).reshape(-1, 3, 3)
    rows = np.flatnonzero(np.abs(np.linalg.det(normal)) > _INDEPENDENT)
    offsets = (normal * (corner - center[:, None])).sum(axis=2)
    solve: Any = np.linalg.solve
    direction: FloatArray = solve(normal[rows], offsets[rows][:, :, None])[:, :, 0]
    crossing, found = _level_along(function, center[rows], direction, _OFFSET * span[rows], walls)
    moved[rows[found]] = crossing[found]
    return moved


def _level_along(
    function: LevelFunction, start: FloatArray, along: FloatArray, limit: FloatArray, walls: Walls
) -> tuple[FloatArray, BoolArray]:
    """Search for the level set along segments.

    start, along: (k, 3) the start of each segment, and the vector to its end. A vector longer than
        `limit` (k,) is shortened to that length. The search goes a quarter of the length beyond the
        end.
    walls: None, or the lower and the upper corner (3,) of a box to which points are confined.

    Returns:
        The first crossing (k, 3) of the level on each segment; and the mask (k,) of the segments
        that cross the level. If a segment does not cross it, its point has no meaning.
    """
    along = along * np.minimum(1, limit / np.maximum(row_norms(along), 1e-300))[:, None]
    low, high = np.zeros(len(start)), np.full(len(start), _SEARCH_LENGTH)
    found = np.ones(len(start), np.bool_)
    fractions = np.linspace(0, 1, _SAMPLES)
    for _ in range(2):
        t = low[:, None] + (high - low)[:, None] * fractions
        x = start[:, None] + t[:, :, None] * along[:, None]
        x = x if walls is None else np.clip(x, *walls)
        is_above = (function.sample(x.reshape(-1, 3)).value > 0).reshape(t.shape)
        passes = is_above[:, 1:] != is_above[:, :-1]
        found &= passes.any(axis=1)
        first = passes.argmax(axis=1)[:, None]
        low, high = (np.take_along_axis(t, first + k, axis=1)[:, 0] for k in (0, 1))
    crossing = start + low[:, None] * along
    crossing = crossing if walls is None else np.clip(crossing, *walls)
    max_step = 4 * (high - low) * row_norms(along)
    return newton_to_level(function, crossing, function.sample(crossing), max_step, walls), found


def unrefined_midpoints(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> FloatArray:
    """(k, 3) the midpoints of the edges of a mesh that `refine` would still split, because the mesh
    is farther than `tolerance` (a length) from the level set there."""
    marks = _RefinementMarks.of(function, vertices, faces, tolerance, None, None)
    return marks.middle[marks.marked]


@dataclass(frozen=True)
class _RefinementMarks:
    """The k edges of a mesh with m faces, and which edges are to be split.

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
        edges and very short edges are never split. A face that cuts off a corner of a surface with
        creases is noted in `misses_corner` instead.

        vertices, faces: (n, 3), (m, 3) the mesh.
        walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary of
            the mesh lies; then boundary edges may be split too.
        where: a function of points (k, 3) that returns the mask (k,) of those that count. Midpoints
            and centers that do not count are taken to be on the level set. None: all count."""
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
        cuts_off = np.zeros(len(faces), np.bool_)
        lone = np.flatnonzero(must_split & ~marked[edges].any(axis=1))
        if function.field.has_creases:
            cuts_off[lone] = _normals_turn(function, vertices[faces[lone]])
        must_split &= ~cuts_off
        # For a face that is off the surface, the longest edge that may be cut.
        free = np.where(is_boundary[edges], 0.0, span[edges])
        worst = edges[np.arange(len(faces)), free.argmax(axis=1)]
        marked[worst[must_split]] = True
        marked &= ~is_boundary & (span > _MIN_EDGE_LENGTH * tolerance)
        return cls(edges, ends, middle, span, samples, is_beyond, is_off, marked, cuts_off)


def _normals_turn(function: LevelFunction, corner: FloatArray) -> BoolArray:
    """(k,) for each of k faces, whether the normals of the level set at two of its corners differ
    by so much that the surface between them has a crease.

    corner: (k, 3, 3) the corners of the faces."""
    slope = function.sample(corner.reshape(-1, 3)).gradient
    normal = (slope / np.maximum(row_norms(slope), 1e-300)[:, None]).reshape(-1, 3, 3)
    cosines = [row_dots(normal[:, k], normal[:, k - 1]) for k in range(3)]
    return np.min(cosines, axis=0) < math.cos(_CREASE)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """The edges of faces (m, 3).

    Returns:
        The vertices (k, 2) of all edges; the indices (m, 3) of the edges of each face, that between
        its first two corners first; and the mask (k,) of the edges that belong to one face only.
    """
    edges = Edges.of(half_edges(faces))
    return edges.vertices, edges.edge_of_pair.reshape(3, -1).T, edges.multiplicity == 1


def split_faces(vertices: FloatArray, faces: IntArray, middle: IntArray) -> IntArray:
    """Split faces (m, 3) at the midpoints of some of their edges, into two, three or four faces
    each. Returns all faces (k, 3), unsplit ones first.

    middle: (m, 3) the vertices at the midpoints of the edges 01, 12 and 20 of each face; -1 for
        edges that are not split."""
    cut = middle >= 0
    number = cut.sum(axis=1)
    parts = [faces[number == 0]]
    all_cut = number == 3
    (a, b, c), (x, y, z) = faces[all_cut].T, middle[all_cut].T
    parts += [np.stack(t, axis=1) for t in ((a, x, z), (x, b, y), (z, y, c), (x, y, z))]
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        single = (number == 1) & cut[:, k]
        (a, b, c), x = faces[single][:, order].T, middle[single, k]
        parts += [np.stack(t, axis=1) for t in ((a, x, c), (x, b, c))]
        pair = (number == 2) & ~cut[:, k]
        # The edge from a to b is not cut; y and z are the middles of the other edges.
        (a, b, c), y, z = faces[pair][:, order].T, middle[pair, order[1]], middle[pair, order[2]]
        length_ay = row_norms(vertices[a] - vertices[y])
        length_bz = row_norms(vertices[b] - vertices[z])
        shorter = (length_ay < length_bz)[:, None]
        parts.append(np.stack([z, y, c], axis=1))
        parts.append(np.where(shorter, np.stack([a, b, y], 1), np.stack([a, b, z], 1)))
        parts.append(np.where(shorter, np.stack([a, y, z], 1), np.stack([b, y, z], 1)))
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

    walls: None, or the lower and the upper corner (3,) of a box on whose faces the boundary
        lies."""
    for _ in range(2):
        faces = flip_edges(function, vertices, faces, tolerance)
        vertices = smooth(function, vertices, faces, walls, rounds=2)
    fixed = np.zeros(len(vertices), np.bool_)
    fixed[boundary_edges(faces)] = True
    faces = collapse_slivers(function, vertices, faces, fixed, 2 * tolerance)
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
    """Smooth a mesh: in each round, every vertex is moved halfway to the mean of its neighbors, and
    then back onto the level set. Returns the vertices (n, 3). Boundary vertices stay, and moves
    that turn a face by much are undone.

    walls: None, or the lower and the upper corner (3,) of a box to which vertices are confined."""
    ends, _, _ = _edges(faces)
    boundary = np.unique(boundary_edges(faces))
    free = np.zeros(len(vertices), np.bool_)
    free[np.unique(faces)] = True
    free[boundary] = False
    count = np.maximum(np.bincount(ends.ravel(), minlength=len(vertices)), 1)
    rows = np.flatnonzero(free)
    size = float(np.ptp(vertices[free], axis=0).max(initial=0.0)) if len(rows) else 0.0
    for _ in range(rounds):
        sums = np.zeros_like(vertices)
        for i, j in ((0, 1), (1, 0)):
            for axis in range(3):
                sums[:, axis] += np.bincount(
                    ends[:, i], vertices[ends[:, j], axis], minlength=len(vertices)
                )
        aim = 0.5 * (vertices + sums / count[:, None])
        start = function.sample(aim[rows])
        # No farther than the neighbors: beside the curve gradients turn.
        span = row_norms(aim[rows] - vertices[rows]) + 1e-300
        moved = vertices.copy()
        moved[rows] = newton_to_level(function, aim[rows], start, 2 * span, walls)
        after = function.sample(moved[rows])
        worse = after.distance > 1e-7 * size + 1e-12 * row_norms(moved[rows])
        moved[rows[worse]] = vertices[rows[worse]]
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
    vertices of such faces get their former positions.

    walls: None, or the lower and the upper corner (3,) of a box to which vertices are confined.
    where: a function of points (k, 3) that returns the mask (k,) of those that are to be within the
        tolerance; None for all."""
    after = smooth(function, vertices, faces, walls)
    rows = np.arange(len(faces))
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
    """The vertices (n, 3) after a move, with the move undone at faces (m, 3) that it turned over: a
    face whose normal turned by more than about 70 degrees gets its former vertices.

    before, after: (n, 3) the vertices before and after the move.

    Undoing a move at some vertices may turn other faces over, so this is repeated. If it does not
    come to an end, all vertices get their positions in `before`.
    """
    for _ in range(8):
        corner = after[faces]
        normal = area_normals(corner)
        old = before[faces]
        old_normal = area_normals(old)
        turned = row_dots(normal, old_normal) <= 0.3 * row_norms(normal) * row_norms(old_normal)
        if not turned.any():
            return after
        after = after.copy()
        reverted = np.unique(faces[turned])
        after[reverted] = before[reverted]
    return before
