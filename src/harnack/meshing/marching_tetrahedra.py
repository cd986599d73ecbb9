"""Marching tetrahedra: the triangles in which the level set of a function cuts tetrahedra. "The
function" is f - level for a field f. It may be an angle, known modulo its period; then it has many
levels, a period apart. Points of the tetrahedra ("vertices", "corners") are either on the level or
on one side of it.

For each edge of the tetrahedra, the level crossings are counted: upward ones (the function grows)
minus downward ones. The count is 0, 1 or -1 if cells are small enough. For a real-valued function
it follows from the signs at the ends. For an angle it follows from the continuous change of the
function along the edge, which may differ from the difference of the values by whole periods. From
the crossings of its edges it follows on which side of the level each corner of a tetrahedron lies.
It is checked that the crossings of the three edges of each face add up, and that at most one level
passes between the corners of a tetrahedron. A corner on the level, such as a vertex of the curve at
which a surface ends, becomes a mesh vertex.

`delaunay` makes tetrahedra between points, by Qhull.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.fields import Field
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    edge_keys,
    row_dots,
    row_norms,
)
from harnack.meshing.delaunay_points import TetrahedronPoints
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import LocalizedMeshingError, MeshingError

__all__ = [
    "OUTSIDE_VALUE",
    "EdgeCrossings",
    "EdgeRootFinder",
    "Tetrahedra",
    "count_crossings",
    "delaunay",
    "extract_triangles",
    "is_cut",
]

_PAIRS = tuple(itertools.combinations(range(4), 2))
# Values this large mark points outside of the region that matters. An edge with one such end is
# crossed in its middle.
OUTSIDE_VALUE = 1e299
# The error of roots on edges, as a fraction of the edge. Roots by secants keep the second fraction
# of the edge from its ends, so that triangles have an area.
_ROOT_ERROR, _MIN_END_DISTANCE = 1e-10, 1e-4


@dataclass(frozen=True)
class Tetrahedra:
    """Tetrahedra and their edges.

    points: (n, 3) the vertices of the tetrahedra.
    corners: (m, 4) the points of each tetrahedron, by index.
    ends: (k, 2) the points at the ends of each edge, the lower index first.
    edges: (m, 6) the edges of each tetrahedron, by index, for the pairs of corners (0, 1), (0, 2),
        (0, 3), (1, 2), (1, 3), (2, 3)."""

    points: FloatArray
    corners: IntArray
    ends: IntArray
    edges: IntArray

    @classmethod
    def of(cls, points: FloatArray, corners: IntArray) -> Tetrahedra:
        """Tetrahedra with these points and corners; their edges are found and numbered."""
        edges = Edges.of(np.concatenate([corners[:, pair] for pair in _PAIRS]))
        return cls(points, corners, edges.vertices, edges.edge_of_pair.reshape(len(_PAIRS), -1).T)

    def edge_between(self, i: int, j: int, rows: IntArray) -> tuple[IntArray, IntArray]:
        """The edge between corners i and j (numbers from 0 to 3) of each of the tetrahedra with the
        indices `rows` (k,).

        Returns:
            The indices (k,) of the edges; and their directions (k,): 1 if the edge leads from
            corner i to corner j, else -1.
        """
        edge = self.edges[rows, _PAIRS.index((min(i, j), max(i, j)))]
        return edge, np.where(self.ends[edge, 0] == self.corners[rows, i], 1, -1)

    def has_edges(self, pairs: IntArray) -> BoolArray:
        """(k,) whether two points are joined by an edge, for pairs (k, 2) of points."""
        n = len(self.points)
        return np.isin(edge_keys(pairs, n), edge_keys(self.ends, n))


def delaunay(points: FloatArray) -> Tetrahedra:
    """The Delaunay tetrahedra of points (n, 3), by Qhull. The points must be in general position,
    except that many may lie on the faces of a box.

    Eight points far away are added, and removed again with their tetrahedra, because Qhull takes
    long if the convex hull of the points is flat.

    Raises:
        MeshingError: some points are too near to each other, relative to their extent.
    """
    import scipy.spatial  # imported here: it takes half a second

    qhull: Any = scipy.spatial
    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    # The far points are the corners of a large cube. It is rotated against the axes, since many of
    # the points may lie on the faces of a box.
    rotation = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    far_corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) @ rotation
    n = len(points)
    # Relative to the middle, so that Qhull's rounding does not grow with the distance from the
    # origin.
    all_points = np.concatenate([points - middle, 20 * size * far_corners])
    try:
        corners: IntArray = qhull.Delaunay(all_points).simplices.astype(np.int64)
    except qhull.QhullError as error:
        raise MeshingError(
            f"there are no Delaunay tetrahedra of {n:,} points, some of which are next to nothing "
            "apart: join corners or edges that lie on each other"
        ) from error
    corners = corners[(corners < n).all(axis=1)]
    return Tetrahedra.of(points, corners)


@dataclass(frozen=True)
class EdgeCrossings:
    """How a function crosses its level along the k edges of tetrahedra. An edge with an end on the
    level has no crossings.

    count: (k,) for each edge the number of upward crossings minus the number of downward crossings.
    change: (k,) the continuous change of the function from the first to the second end of each
        edge. For an angle, it may differ from the difference of the values by whole periods.
    proved: the number of edges along which the change of an angle is proved to be the difference of
        the values, moved by whole periods into half a period around 0.
    integrated_count: the number of edges along which the change was integrated."""

    count: IntArray
    change: FloatArray
    proved: int
    integrated_count: int


def count_crossings(
    function: LevelFunction, points: TetrahedronPoints, tets: Tetrahedra
) -> EdgeCrossings:
    """Count how a function crosses its level along every edge of tetrahedra.

    points: the vertices of the tetrahedra, with the values of the function there.

    For an angle, the continuous change along each edge is needed. Each vertex has a radius within
    which the function is proved to change by less than a quarter of its period
    (`LevelSamples.quarter_period_radius`). If the radii of both ends together are as long as the
    edge, the function changes by less than half a period along it. Then the change is the
    difference of the values, moved by whole periods into half a period around 0. Along other edges
    the field integrates its change (`Boundary.continuous_change`).

    Raises:
        MeshingError: the field cannot integrate its change along an edge.
    """
    a, b = tets.ends.T
    value = points.samples.value
    has_free_ends = ~points.is_on_level[a] & ~points.is_on_level[b]
    change = np.where(has_free_ends, value[b] - value[a], 0.0)
    if function.period is None:
        count = np.where(has_free_ends, (value[b] > 0).astype(np.int64) - (value[a] > 0), 0)
        # All edges count as proved, and none is integrated.
        return EdgeCrossings(count, change, int(has_free_ends.sum()), 0)
    period = function.period
    change -= period * np.round(change / period)
    length = row_norms(points.points[a] - points.points[b])
    radius = points.samples.quarter_period_radius
    # (1e-9 covers the rounding of the length.)
    unproved_rows = np.flatnonzero(has_free_ends & (radius[a] + radius[b] < length * (1 + 1e-9)))
    if len(unproved_rows):
        p, q = points.points[a[unproved_rows]], points.points[b[unproved_rows]]
        change[unproved_rows] = _integrate_change(
            function.field, p, q, change[unproved_rows], period
        )
    # Reduced to [0, period), a value plus the change exceeds the value at the other end by one
    # period for each level crossed.
    value_in_period = np.remainder(value, period)
    count = np.where(
        has_free_ends, np.round((value_in_period[a] + change - value_in_period[b]) / period), 0
    ).astype(np.int64)
    return EdgeCrossings(
        count, change, int(has_free_ends.sum()) - len(unproved_rows), len(unproved_rows)
    )


def _integrate_change(
    field: Field, p: FloatArray, q: FloatArray, wrapped: FloatArray, period: float
) -> FloatArray:
    """(n,) the continuous change of the field's function f along the segments from p to q (n, 3),
    as the field integrates it.

    wrapped: (n,) the differences f(q) - f(p), known up to whole multiples of `period`. The integral
        only decides which multiples are added to these, so the result does not have the integral's
        error.

    Raises:
        MeshingError: the field cannot integrate its change, or the result does not differ by whole
            periods.
    """
    boundary = field.boundary
    if boundary is None or boundary.continuous_change is None:
        raise MeshingError(
            f"how {type(field).__name__} changes along {len(p)} edges of the mesh is not proved, "
            "and its boundary has no `continuous_change`: choose a smaller `cell_size`"
        )
    integrated = boundary.continuous_change(p, q)
    # The integral only decides how many whole periods are added.
    periods = np.round((integrated - wrapped) / period)
    if np.abs(integrated - wrapped - period * periods).max(initial=0.0) > 1e-6:
        raise MeshingError(
            f"{type(field).__name__}.boundary.continuous_change is not the difference of two "
            "values, modulo the period"
        )
    return wrapped + period * periods


EdgeRootFinder: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""A function from the ends (k, 3) of edges, first those below the level and then those above it, to
the points (k, 3) where the edges meet the level set."""


def extract_triangles(
    function: LevelFunction,
    points: TetrahedronPoints,
    tets: Tetrahedra,
    crossings: EdgeCrossings,
    roots_of: EdgeRootFinder | None = None,
) -> tuple[FloatArray, IntArray]:
    """The triangles in which the level set of a function cuts tetrahedra.

    points: the vertices of the tetrahedra, with the values of the function there.
    crossings: how the function crosses its level along the edges of the tetrahedra `tets`.
    roots_of: a function that computes the points where edges meet the level of a real-valued
        function; None to search for these points along the edges (`_roots`).

    Returns:
        Vertices (n, 3) and faces (m, 3), counter-clockwise as seen from where the function is
        larger. The first vertices are `points`, whether they are used or not; then follows one
        vertex for each crossed edge, in the order of the edges.

    Raises:
        MeshingError: crossings do not agree around a face, or two levels pass between corners.
    """
    side = _sides(points, tets, crossings)
    is_on_level = points.is_on_level[tets.corners]
    # The lowest and the highest side of the corners that are not on the level.
    lowest = np.where(is_on_level, np.iinfo(np.int64).max, side).min(axis=1)
    highest = np.where(is_on_level, np.iinfo(np.int64).min, side).max(axis=1)
    has_two_levels = (highest - lowest > 1) & ~is_on_level.all(axis=1)
    if has_two_levels.any():
        raise LocalizedMeshingError(
            "two sheets of the level set pass between corners of one tetrahedron: choose a smaller "
            "`cell_size`",
            _mean(points.points, tets.corners[has_two_levels]),
        )
    cut_rows = np.flatnonzero(~is_on_level.all(axis=1) & (highest > lowest))
    edges = np.flatnonzero(crossings.count)
    if roots_of is None:
        roots = _roots(function, points, tets, crossings, edges)
    else:
        is_rising = (crossings.count[edges] > 0)[:, None]
        ends = np.where(is_rising, tets.ends[edges], tets.ends[edges, ::-1])
        roots = roots_of(points.points[ends[:, 0]], points.points[ends[:, 1]])
    vertex_of_edge = np.full(len(tets.ends), -1, np.int64)
    vertex_of_edge[edges] = len(points.points) + np.arange(len(edges))
    vertices = np.concatenate([points.points, roots])
    parts: list[tuple[IntArray, FloatArray]] = []
    is_above = (side > lowest[:, None]) & ~is_on_level
    # Tetrahedra with the same corners above and on the level are cut alike: bits 0 to 3 of the
    # pattern mark corners above, bits 4 to 7 corners on the level.
    pattern = (is_above[cut_rows] * [1, 2, 4, 8]).sum(axis=1) + 16 * (
        is_on_level[cut_rows] * [1, 2, 4, 8]
    ).sum(axis=1)
    for code in np.unique(pattern):
        rows = cut_rows[pattern == code]
        up = [k for k in range(4) if code >> k & 1]
        level = [k for k in range(4) if code >> (4 + k) & 1]
        down = [k for k in range(4) if k not in up and k not in level]
        corner = tets.corners[rows]
        # A vector from the corners below to those above, for the orientation of the triangles.
        rise = _mean(points.points, corner[:, up]) - _mean(points.points, corner[:, down])

        def at(i: int, j: int, rows: IntArray = rows) -> IntArray:
            """The vertices (k,) on the edges between corners i and j of tetrahedra `rows`."""
            return vertex_of_edge[tets.edge_between(i, j, rows)[0]]

        on_level = [corner[:, k] for k in level]
        crossed = [at(i, j) for i in up for j in down]
        if len(crossed) == 4:  # two corners on each side
            quadrilateral = [
                at(up[0], down[0]),
                at(up[0], down[1]),
                at(up[1], down[1]),
                at(up[1], down[0]),
            ]
            for face in _halves(vertices, quadrilateral):
                parts.append((face, rise))
        else:
            parts.append((np.stack([*on_level, *crossed], axis=1), rise))
    parts.append(_faces_on_the_level(function, points, tets))
    faces, rise = (np.concatenate(column) for column in zip(*parts, strict=True))
    # The orientation is tested with vertices in the middles of edges: any plane through points of
    # the edges has all corners above on one side, and roots at an end, as where f jumps, leave
    # triangles without an area.
    middles = _mean(points.points, tets.ends[edges])
    is_inward = row_dots(area_normals(np.concatenate([points.points, middles])[faces]), rise) < 0
    faces[is_inward] = faces[is_inward][:, ::-1]
    return vertices, faces


def is_cut(points: TetrahedronPoints, tets: Tetrahedra, crossings: EdgeCrossings) -> BoolArray:
    """(m,) for each tetrahedron, whether the level set passes between its corners or through one of
    them.

    points: the vertices of the tetrahedra `tets`, with the values of the function there.
    crossings: how the function crosses its level along their edges."""
    return points.is_on_level[tets.corners].any(axis=1) | (crossings.count[tets.edges] != 0).any(
        axis=1
    )


def _mean(points: FloatArray, index: IntArray) -> FloatArray:
    """(k, 3) for each row of `index` (k, j), the mean of the j points with these indices. points:
    (n, 3)."""
    return points[index].mean(axis=1)


def _halves(vertices: FloatArray, ring: list[IntArray]) -> tuple[IntArray, IntArray]:
    """Cut k quadrilaterals along their shorter diagonals. Returns the corners (k, 3) of the first
    and of the second triangle of each.

    ring: the indices (k,) of the four corners, in their order around the quadrilateral."""
    a, b, c, d = ring
    # The lengths of the two diagonals.
    ac, bd = (row_norms(vertices[x] - vertices[y]) for x, y in ((a, c), (b, d)))
    longer = (ac > bd)[:, None]
    first = np.where(longer, np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    second = np.where(longer, np.stack([b, c, d], axis=1), np.stack([a, c, d], axis=1))
    return first, second


def _sides(points: TetrahedronPoints, tets: Tetrahedra, crossings: EdgeCrossings) -> IntArray:
    """(m, 4) for each corner of each of m tetrahedra, an integer that tells on which side of the
    level it lies. It is counted from the first corner of the tetrahedron that is not on the level:
    the number of level crossings (upward minus downward) on the edge from there to this corner. It
    is 0 for that first corner and for corners on the level.

    Raises:
        LocalizedMeshingError: the crossings of three edges of a face do not add up.
    """
    is_on = points.is_on_level[tets.corners]
    rows = np.arange(len(is_on))
    # (`argmin` finds the first False.)
    first_free_corner = np.argmin(is_on, axis=1)
    side = np.zeros(is_on.shape, np.int64)

    def crossed(i: int, j: int, rows: IntArray) -> IntArray:
        """The signed crossings (k,) of the edges from corner i to corner j of tetrahedra `rows`."""
        edge, sign = tets.edge_between(i, j, rows)
        return sign * crossings.count[edge]

    for i, j in itertools.permutations(range(4), 2):
        chosen = rows[(first_free_corner == i) & ~is_on[:, j]]
        side[chosen, j] = crossed(i, j, chosen)
    # Going from corner to corner by another way must lead to the same side.
    is_wrong = np.zeros(len(rows), np.bool_)
    for i, j in _PAIRS:
        chosen = rows[~is_on[:, i] & ~is_on[:, j]]
        is_wrong[chosen] |= side[chosen, j] - side[chosen, i] != crossed(i, j, chosen)
    if is_wrong.any():
        raise LocalizedMeshingError(
            "crossings of the level set do not agree around a triangle: the curve passes "
            "through it; choose a smaller `cell_size`",
            _mean(points.points, tets.corners[is_wrong]),
        )
    return side


def _roots(
    function: LevelFunction,
    points: TetrahedronPoints,
    tets: Tetrahedra,
    crossings: EdgeCrossings,
    edges: IntArray,
) -> FloatArray:
    """(r, 3) the points where edges of tetrahedra meet the level set.

    crossings: the crossings and the change of the function along all edges.
    edges: (r,) the indices of the edges that have a crossing.

    The points are found by the secant method if the function has `secant_steps`, else by
    Chandrupatla's method. In the latter case, if an end of an edge has the value `OUTSIDE_VALUE`,
    which stands for the outside of the meshed region, the point is the middle of the edge."""
    a, b = tets.ends[edges].T
    p, direction = points.points[a], points.points[b] - points.points[a]
    value, change = points.samples.value[a], crossings.change[edges]
    if function.period is not None:
        # Count from the level that is crossed: below it at one end, above it at the other.
        value = np.remainder(value, function.period)
        value = value - np.where(crossings.count[edges] > 0, function.period, 0)

    def lifted_values(t: FloatArray, *args: FloatArray) -> FloatArray:
        """(k,) f - level at the fractions t (k,) of k edges. Values of an angle are moved by the
        whole number of periods that brings them nearest to the middle of the change, so that they
        change continuously along the edge.

        args: eight arrays (k,): the three coordinates of the start of each edge, the three of the
            vector to its end, f - level at the start, and the change along the edge."""
        origin, edge, start, rise = (
            np.stack(args[0:3], axis=-1), np.stack(args[3:6], axis=-1), args[6], args[7]
        )  # fmt: skip
        locations = (origin + t[..., None] * edge).reshape(-1, 3)
        wrapped = function.values(locations).reshape(t.shape)
        if function.period is None:
            return wrapped
        return wrapped + function.period * np.rint((start + 0.5 * rise - wrapped) / function.period)

    if function.secant_steps:
        return p + _illinois(function, p, direction, value, value + change)[:, None] * direction
    inside_rows = np.flatnonzero(np.maximum(np.abs(value), np.abs(value + change)) < OUTSIDE_VALUE)
    fraction = np.full(len(a), 0.5)
    fraction[inside_rows] = _chandrupatla(
        function,
        p[inside_rows],
        direction[inside_rows],
        value[inside_rows],
        change[inside_rows],
        lifted_values,
    )
    return p + fraction[:, None] * direction


def _illinois(
    function: LevelFunction, p: FloatArray, edge: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """(r,) the fractions of edges at which they meet the level set, by a few secant steps.

    function: f - level for a field f; it is 0 on the level set.
    p, edge: (r, 3) one end of each edge, and the vector to the other end.
    low, high: (r,) the values of f - level at these two ends, of different signs.

    Each step replaces one end of the search interval. If it is the same end twice or more in a row,
    the value at the other end is halved for the next secant (the Illinois method).
    """
    left, right = np.zeros(len(p)), np.ones(len(p))
    is_rising = high > low
    # Falling edges are negated, so that values are negative at the left ends.
    low, high = (np.where(is_rising, low, -low), np.where(is_rising, high, -high))
    repeats = np.zeros(len(p), np.int64)
    fraction = low / (low - high)
    for _ in range(function.secant_steps):
        value = function.values(p + fraction[:, None] * edge)
        value = np.where(is_rising, value, -value)
        is_positive = value > 0
        # How often in a row the right end (positive) or the left end (negative) was replaced.
        repeats = np.where(is_positive, np.maximum(repeats, 0) + 1, np.minimum(repeats, 0) - 1)
        low = np.where(is_positive, np.where(repeats > 1, 0.5 * low, low), value)
        high = np.where(is_positive, value, np.where(repeats < -1, 0.5 * high, high))
        left, right = np.where(is_positive, left, fraction), np.where(is_positive, fraction, right)
        # The root of the secant; values of equal size would divide by 0.
        fraction = left + (right - left) * low / np.minimum(low - high, -1e-300)
    return np.clip(fraction, _MIN_END_DISTANCE, 1 - _MIN_END_DISTANCE)


def _chandrupatla(
    function: LevelFunction,
    start: FloatArray,
    direction: FloatArray,
    value: FloatArray,
    change: FloatArray,
    lifted_values: Callable[..., FloatArray],
) -> FloatArray:
    """(r,) the fractions of edges at which they meet the level set, by Chandrupatla's method (a
    bracketing search by inverse quadratic interpolation and bisection).

    start, direction: (r, 3) one end of each edge, and the vector to the other.
    value, change: (r,) f - level at that end, and its change along the edge.
    lifted_values: the function whose root is searched, of the fraction and of eight more arrays
        (r,): the coordinates of `start` and `direction`, `value` and `change`.

    Raises:
        MeshingError: roots are not found.
    """
    import scipy.optimize.elementwise as elementwise  # imported here: it takes half a second

    search = cast("Any", elementwise).find_root
    arguments = (*start.T, *direction.T, value, change)
    result = search(
        lifted_values, (np.zeros(len(start)), np.ones(len(start))), args=arguments,
        tolerances={"xatol": _ROOT_ERROR, "fatol": 0.0, "xrtol": 0.0, "frtol": 0.0},
        maxiter=60,
    )  # fmt: skip
    if not bool(np.all(result.success)):
        raise MeshingError(
            f"{int((~result.success).sum())} crossings of edges were not found: the function may "
            "not be continuous there; choose another level"
        )
    return np.array(result.x, np.float64)


def _faces_on_the_level(
    function: LevelFunction, points: TetrahedronPoints, tets: Tetrahedra
) -> tuple[IntArray, FloatArray]:
    """The faces of tetrahedra that are part of the level set: all three corners are on the level,
    and the two tetrahedra at the face lie on different sides of the level.

    Returns:
        The corners (k, 3) of the faces; and for each face a vector (k, 3) through it, from the side
        where the function is smaller to the side where it is larger.

    The side on which a tetrahedron lies is that of its fourth corner or, if that is on the level
    too, of its center. Two points on both sides of an angle's face lie on different sides if the
    continuous change on the way from one over the face's center to the other crosses a level.
    """
    is_on = points.is_on_level[tets.corners]
    face_rows: list[IntArray] = []
    for k in range(4):
        rows = np.flatnonzero(np.delete(is_on, k, axis=1).all(axis=1))
        face = np.sort(np.delete(tets.corners[rows], k, axis=1), axis=1)
        face_rows.append(np.column_stack([face, rows, np.full(len(rows), k)]))
    table = np.concatenate(face_rows)
    # Equal faces of two tetrahedra are in successive rows.
    table = table[np.lexsort(table[:, 2::-1].T)]
    shared = np.flatnonzero((table[1:, :3] == table[:-1, :3]).all(axis=1))
    first, second, face = table[shared], table[shared + 1], table[shared, :3]
    if not len(face):
        return np.zeros((0, 3), np.int64), np.zeros((0, 3))
    middle = _mean(points.points, face)
    (first_point, first_value), (second_point, second_value) = (
        _side_sample(function, points, tets, row) for row in (first, second)
    )
    if function.period is None:
        crossing_count = (second_value > 0).astype(np.int64) - (first_value > 0)
    else:
        period = function.period
        value = function.values(middle)
        # The continuous change from the first point over the face's center to the second.
        change = sum(
            sign
            * _integrate_change(function.field, side, middle, _wrap(value - start, period), period)
            for sign, side, start in (
                (1, first_point, first_value),
                (-1, second_point, second_value),
            )
        )
        # Reduced to [0, period), the first value plus the change exceeds the second value by one
        # period for each level crossed.
        difference = np.remainder(first_value, period) + change - np.remainder(second_value, period)
        crossing_count = np.round(difference / period).astype(np.int64)
    rise = (second_point - first_point) * np.sign(crossing_count)[:, None]
    return face[crossing_count != 0], rise[crossing_count != 0]


def _wrap(change: FloatArray, period: float) -> FloatArray:
    """Changes (n,), moved by whole periods into [-period/2, period/2]."""
    return change - period * np.round(change / period)


def _side_sample(
    function: LevelFunction, points: TetrahedronPoints, tets: Tetrahedra, table: IntArray
) -> tuple[FloatArray, FloatArray]:
    """A point (n, 3) inside of each of n tetrahedra, or at one of its corners, that lies off a
    given face, and the value (n,) of f - level there. It is the corner opposite to the face or, if
    that is on the level, the center of the tetrahedron.

    function: f - level for a field f; it is 0 on the level set.
    table: (n, 5) one row for each tetrahedron and face: the three corners of the face, the index of
        the tetrahedron, and which of its corners (0 to 3) is opposite to the face.
    """
    corners = tets.corners[table[:, 3]]
    apex = corners[np.arange(len(table)), table[:, 4]]
    side_points, value = points.points[apex], points.samples.value[apex]
    is_on = np.flatnonzero(points.is_on_level[apex])
    side_points[is_on] = points.points[corners[is_on]].mean(axis=1)
    value[is_on] = function.values(side_points[is_on])
    return side_points, value
