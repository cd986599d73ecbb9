"""Triangles of a level set in tetrahedra, for functions that may be angles; and the tetrahedra.

The continuous change of the function along an edge is its *lift*. The signed number of level
crossings is that of the lift: 0 or +-1 if cells are small enough. For a real-valued function it
follows from the signs at the ends. For an angle, the lift may differ from the difference of the
wrapped values by whole periods. The crossings of a tetrahedron's edges between corners off the
level determine on which side of the level each corner lies, if they are consistent around every
face; that is checked, and that at most one level passes between the corners. A corner on the level,
such as a vertex of the curve, becomes a mesh vertex.

Tetrahedra between points are Delaunay's, by Qhull (`delaunay`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.fields import Field
from harnack.meshing.checks import LocalizedMeshingError, MeshingError
from harnack.meshing.delaunay_points import TetrahedronPoints
from harnack.meshing.edges import Edges, IntArray, area_normals, edge_keys, row_dots, row_norms
from harnack.meshing.level_function import LevelFunction

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
# Values this large mark points outside: where the other end has a value, the edge is crossed in its
# middle.
OUTSIDE_VALUE = 1e299
# The error of roots on edges, relative to the edge; and the distance of roots by secants from its
# ends, so that triangles have an area.
_ROOT_ERROR, _FROM_ENDS = 1e-10, 1e-4


@dataclass(frozen=True)
class Tetrahedra:
    """Tetrahedra and their edges.

    points: (n, 3).
    corners: (m, 4) indices of points.
    ends: (k, 2) endpoints of all edges, the lower index first.
    edges: (m, 6) indices of edges, for the pairs of corners (0, 1), (0, 2), (0, 3), (1, 2), (1, 3),
        (2, 3).
    """

    points: FloatArray
    corners: IntArray
    ends: IntArray
    edges: IntArray

    @classmethod
    def of(cls, points: FloatArray, corners: IntArray) -> Tetrahedra:
        """Tetrahedra with these corners; their edges are numbered."""
        edges = Edges.of(np.concatenate([corners[:, pair] for pair in _PAIRS]))
        return cls(points, corners, edges.vertices, edges.edge_of_pair.reshape(len(_PAIRS), -1).T)

    def edge_between(self, i: int, j: int, rows: IntArray) -> tuple[IntArray, IntArray]:
        """For tetrahedra `rows`, the edge between corners i and j, and its direction: 1 if it leads
        from i to j, else -1."""
        edge = self.edges[rows, _PAIRS.index((min(i, j), max(i, j)))]
        return edge, np.where(self.ends[edge, 0] == self.corners[rows, i], 1, -1)

    def has_edges(self, pairs: IntArray) -> BoolArray:
        """(k,) whether there are edges between pairs (k, 2) of points."""
        n = len(self.points)
        return np.isin(edge_keys(pairs, n), edge_keys(self.ends, n))


def delaunay(points: FloatArray) -> Tetrahedra:
    """The Delaunay tetrahedra of points (n, 3) in general position, except that many may lie on the
    faces of a box.

    Eight points far away are added and left out again with their tetrahedra: Qhull takes long over
    a hull that is flat.

    Raises:
        MeshingError: points are too near to each other, relative to their extent.
    """
    import scipy.spatial  # imported here: it takes half a second

    qhull: Any = scipy.spatial
    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    rotation = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    far_corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) @ rotation
    n = len(points)
    # Relative to the middle, so that Qhull's rounding does not grow with the distance from the
    # origin.
    together = np.concatenate([points - middle, 20 * size * far_corners])
    try:
        corners: IntArray = qhull.Delaunay(together).simplices.astype(np.int64)
    except qhull.QhullError as error:
        raise MeshingError(
            f"there are no Delaunay tetrahedra of {n:,} points, some of which are next to nothing "
            "apart: join corners or edges that lie on each other"
        ) from error
    corners = corners[(corners < n).all(axis=1)]
    return Tetrahedra.of(points, corners)


@dataclass(frozen=True)
class EdgeCrossings:
    """Crossings of all edges of tetrahedra, between points off the level.

    count: (k,) the number of upward minus that of downward crossings of the level along each edge.
    change: (k,) the change of the function along each edge.
    proved: the number of changes that are proved to be the difference of wrapped values.
    integrated_count: the number of changes that were integrated along the edge.
    """

    count: IntArray
    change: FloatArray
    proved: int
    integrated_count: int


def count_crossings(
    function: LevelFunction, points: TetrahedronPoints, tets: Tetrahedra
) -> EdgeCrossings:
    """Count the crossings of every edge.

    Wrapping. Within `LevelSamples.quarter_period_radius` of a point the function changes by less
    than a quarter of its period. If these radii at both ends cover the edge, it changes by less
    than half a period along it, so that the change is the wrapped difference. Along other edges
    the change is integrated (`Field.continuous_change`).

    Raises:
        MeshingError: edges that are not covered, of a field that cannot be integrated.
    """
    a, b = tets.ends.T
    value = points.samples.value
    is_off = ~points.is_on_level[a] & ~points.is_on_level[b]
    change = np.where(is_off, value[b] - value[a], 0.0)
    if function.period is None:
        count = np.where(is_off, (value[b] > 0).astype(np.int64) - (value[a] > 0), 0)
        return EdgeCrossings(count, change, int(is_off.sum()), 0)
    period = function.period
    change -= period * np.round(change / period)
    span = row_norms(points.points[a] - points.points[b])
    reach = points.samples.quarter_period_radius
    unsure = np.flatnonzero(is_off & (reach[a] + reach[b] < span * (1 + 1e-9)))
    if len(unsure):
        p, q = points.points[a[unsure]], points.points[b[unsure]]
        change[unsure] = _integrate_change(function.field, p, q, change[unsure], period)
    # Values between levels lie in (0, period).
    level = np.remainder(value, period)
    count = np.where(is_off, np.round((level[a] + change - level[b]) / period), 0).astype(np.int64)
    return EdgeCrossings(count, change, int(is_off.sum()) - len(unsure), len(unsure))


def _integrate_change(
    field: Field, p: FloatArray, q: FloatArray, wrapped: FloatArray, period: float
) -> FloatArray:
    """The change of f from p to q (n, 3), as the field integrates it, which differs from the
    wrapped change by whole periods."""
    exact = field.continuous_change(p, q)
    if exact is None:
        raise MeshingError(
            f"how {type(field).__name__} changes along {len(p)} edges of the mesh is not proved, "
            "and it has no `change_along`: choose a smaller `cell_size`"
        )
    turns = np.round((exact - wrapped) / period)
    if np.abs(exact - wrapped - period * turns).max(initial=0.0) > 1e-6:
        raise MeshingError(
            f"{type(field).__name__}.change_along is not the difference of two values, modulo "
            "the period"
        )
    return wrapped + period * turns


EdgeRootFinder: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""From the ends (k, 3) of edges, below the level and above it, to where they meet it (k, 3)."""


def extract_triangles(
    function: LevelFunction,
    points: TetrahedronPoints,
    tets: Tetrahedra,
    crossings: EdgeCrossings,
    roots_of: EdgeRootFinder | None = None,
) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and faces (m, 3), counter-clockwise as seen from where the function is
    greater. The first vertices are `points`, whether they are in use or not; they are followed by a
    vertex for each edge that is crossed, in their order.

    roots_of: computes where edges meet the level of a real-valued function; None for a search along
        them.

    Raises:
        MeshingError: crossings that do not agree around a face, or two levels between corners.
    """
    side = _sides(points, tets, crossings)
    on = points.is_on_level[tets.corners]
    lowest = np.where(on, np.iinfo(np.int64).max, side).min(axis=1)
    highest = np.where(on, np.iinfo(np.int64).min, side).max(axis=1)
    double = (highest - lowest > 1) & ~on.all(axis=1)
    if double.any():
        raise LocalizedMeshingError(
            "two sheets of the level set pass between corners of one tetrahedron: choose a smaller "
            "`cell_size`",
            _mean(points.points, tets.corners[double]),
        )
    cut = np.flatnonzero(~on.all(axis=1) & (highest > lowest))
    edges = np.flatnonzero(crossings.count)
    if roots_of is None:
        roots = _roots(function, points, tets, crossings, edges)
    else:
        upwards = (crossings.count[edges] > 0)[:, None]
        ends = np.where(upwards, tets.ends[edges], tets.ends[edges, ::-1])
        roots = roots_of(points.points[ends[:, 0]], points.points[ends[:, 1]])
    vertex_of_edge = np.full(len(tets.ends), -1, np.int64)
    vertex_of_edge[edges] = len(points.points) + np.arange(len(edges))
    vertices = np.concatenate([points.points, roots])
    parts: list[tuple[IntArray, FloatArray]] = []
    above = (side > lowest[:, None]) & ~on
    pattern = (above[cut] * [1, 2, 4, 8]).sum(axis=1) + 16 * (on[cut] * [1, 2, 4, 8]).sum(axis=1)
    for code in np.unique(pattern):
        rows = cut[pattern == code]
        up = [k for k in range(4) if code >> k & 1]
        level = [k for k in range(4) if code >> (4 + k) & 1]
        down = [k for k in range(4) if k not in up and k not in level]
        corner = tets.corners[rows]
        rise = _mean(points.points, corner[:, up]) - _mean(points.points, corner[:, down])

        def at(i: int, j: int, rows: IntArray = rows) -> IntArray:
            return vertex_of_edge[tets.edge_between(i, j, rows)[0]]

        on_level = [corner[:, k] for k in level]
        crossed = [at(i, j) for i in up for j in down]
        if len(crossed) == 4:  # two corners on each side
            ring = [at(up[0], down[0]), at(up[0], down[1]), at(up[1], down[1]), at(up[1], down[0])]
            for face in _halves(vertices, ring):
                parts.append((face, rise))
        else:
            parts.append((np.stack([*on_level, *crossed], axis=1), rise))
    parts.append(_faces_on_the_level(function, points, tets))
    faces, rise = (np.concatenate(column) for column in zip(*parts, strict=True))
    # The orientation is tested with vertices in the middles of edges: any plane through points of
    # the edges has all corners above on one side, and roots at an end, as where f jumps, leave
    # triangles without an area.
    middles = _mean(points.points, tets.ends[edges])
    turned = row_dots(area_normals(np.concatenate([points.points, middles])[faces]), rise) < 0
    faces[turned] = faces[turned][:, ::-1]
    return vertices, faces


def is_cut(points: TetrahedronPoints, tets: Tetrahedra, crossings: EdgeCrossings) -> BoolArray:
    """(m,) whether a level passes between corners of a tetrahedron, or through one."""
    return points.is_on_level[tets.corners].any(axis=1) | (crossings.count[tets.edges] != 0).any(
        axis=1
    )


def _mean(points: FloatArray, index: IntArray) -> FloatArray:
    return points[index].mean(axis=1)


def _halves(vertices: FloatArray, ring: list[IntArray]) -> tuple[IntArray, IntArray]:
    """The two triangles of a quadrilateral cut along its shorter diagonal."""
    a, b, c, d = ring
    ac, bd = (row_norms(vertices[x] - vertices[y]) for x, y in ((a, c), (b, d)))
    longer = (ac > bd)[:, None]
    first = np.where(longer, np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    second = np.where(longer, np.stack([b, c, d], axis=1), np.stack([a, c, d], axis=1))
    return first, second


def _sides(points: TetrahedronPoints, tets: Tetrahedra, crossings: EdgeCrossings) -> IntArray:
    """(m, 4) the number of levels between the first corner that is off the level and each other
    corner."""
    on = points.is_on_level[tets.corners]
    rows = np.arange(len(on))
    first = np.argmin(on, axis=1)
    side = np.zeros(on.shape, np.int64)

    def between(i: int, j: int, rows: IntArray) -> IntArray:
        edge, sign = tets.edge_between(i, j, rows)
        return sign * crossings.count[edge]

    for i, j in itertools.permutations(range(4), 2):
        chosen = rows[(first == i) & ~on[:, j]]
        side[chosen, j] = between(i, j, chosen)
    disagrees = np.zeros(len(rows), np.bool_)
    for i, j in _PAIRS:
        chosen = rows[~on[:, i] & ~on[:, j]]
        disagrees[chosen] |= side[chosen, j] - side[chosen, i] != between(i, j, chosen)
    if disagrees.any():
        raise LocalizedMeshingError(
            "crossings of the level set do not agree around a triangle: the curve passes "
            "through it; choose a smaller `cell_size`",
            _mean(points.points, tets.corners[disagrees]),
        )
    return side


def _roots(
    function: LevelFunction,
    points: TetrahedronPoints,
    tets: Tetrahedra,
    crossings: EdgeCrossings,
    edges: IntArray,
) -> FloatArray:
    """(r, 3) the points where `edges` meet the level, by Chandrupatla's method along the edge."""
    a, b = tets.ends[edges].T
    p, direction = points.points[a], points.points[b] - points.points[a]
    value, change = points.samples.value[a], crossings.change[edges]
    if function.period is not None:
        # Count from the level that is crossed: below it at one end, above it at the other.
        value = np.remainder(value, function.period)
        value = value - np.where(crossings.count[edges] > 0, function.period, 0)

    def lifted(t: FloatArray, *of: FloatArray) -> FloatArray:
        origin, along, start, rise = (
            np.stack(of[0:3], axis=-1), np.stack(of[3:6], axis=-1), of[6], of[7]
        )  # fmt: skip
        flat = (origin + t[..., None] * along).reshape(-1, 3)
        sampled = function.values(flat).reshape(t.shape)
        if function.period is None:
            return sampled
        return sampled + function.period * np.rint((start + 0.5 * rise - sampled) / function.period)

    if function.secant_steps:
        return p + _illinois(function, p, direction, value, value + change)[:, None] * direction
    finite = np.flatnonzero(np.maximum(np.abs(value), np.abs(value + change)) < OUTSIDE_VALUE)
    fraction = np.full(len(a), 0.5)
    fraction[finite] = _chandrupatla(
        function, p[finite], direction[finite], value[finite], change[finite], lifted
    )
    return p + fraction[:, None] * direction


def _illinois(
    function: LevelFunction, p: FloatArray, direction: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """(r,) the fractions along edges where they meet the level, by a few secants from the values at
    both ends; the value at an end that stays is halved from the second time on (the Illinois
    method)."""
    first, last = np.zeros(len(p)), np.ones(len(p))
    up = high > low
    low, high = np.where(up, low, -low), np.where(up, high, -high)
    stayed = np.zeros(len(p), np.int64)
    fraction = low / (low - high)
    for _ in range(function.secant_steps):
        value = function.values(p + fraction[:, None] * direction)
        value = np.where(up, value, -value)
        is_positive = value > 0
        stayed = np.where(is_positive, np.maximum(stayed, 0) + 1, np.minimum(stayed, 0) - 1)
        low = np.where(is_positive, np.where(stayed > 1, 0.5 * low, low), value)
        high = np.where(is_positive, value, np.where(stayed < -1, 0.5 * high, high))
        first, last = np.where(is_positive, first, fraction), np.where(is_positive, fraction, last)
        fraction = first + (last - first) * low / np.minimum(low - high, -1e-300)
    return np.clip(fraction, _FROM_ENDS, 1 - _FROM_ENDS)


def _chandrupatla(
    function: LevelFunction,
    p: FloatArray,
    direction: FloatArray,
    value: FloatArray,
    change: FloatArray,
    lifted: Callable[..., FloatArray],
) -> FloatArray:
    """(r,) the fractions along edges where they meet the level, by Chandrupatla's method."""
    import scipy.optimize.elementwise as elementwise  # imported here: it takes half a second

    search = cast("Any", elementwise).find_root
    arguments = (*p.T, *direction.T, value, change)
    result = search(
        lifted, (np.zeros(len(p)), np.ones(len(p))), args=arguments,
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
    """Faces of tetrahedra that have all corners on the level and different sides of the level
    before and behind them; and the upward direction through each.

    The side of a tetrahedron is that of its fourth corner or, if this is on the level too, of its
    center.
    """
    on = points.is_on_level[tets.corners]
    triples: list[IntArray] = []
    for k in range(4):
        rows = np.flatnonzero(np.delete(on, k, axis=1).all(axis=1))
        face = np.sort(np.delete(tets.corners[rows], k, axis=1), axis=1)
        triples.append(np.column_stack([face, rows, np.full(len(rows), k)]))
    table = np.concatenate(triples)
    table = table[np.lexsort(table[:, 2::-1].T)]
    twice = np.flatnonzero((table[1:, :3] == table[:-1, :3]).all(axis=1))
    first, second, face = table[twice], table[twice + 1], table[twice, :3]
    if not len(face):
        return np.zeros((0, 3), np.int64), np.zeros((0, 3))
    middle = _mean(points.points, face)
    (before, low), (behind, high) = (
        _side_sample(function, points, tets, row) for row in (first, second)
    )
    if function.period is None:
        count = (high > 0).astype(np.int64) - (low > 0)
    else:
        period = function.period
        value = function.values(middle)
        change = sum(
            sign
            * _integrate_change(function.field, side, middle, _wrap(value - start, period), period)
            for sign, side, start in ((1, before, low), (-1, behind, high))
        )
        difference = np.remainder(low, period) + change - np.remainder(high, period)
        count = np.round(difference / period).astype(np.int64)
    rise = (behind - before) * np.sign(count)[:, None]
    return face[count != 0], rise[count != 0]


def _wrap(change: FloatArray, period: float) -> FloatArray:
    return change - period * np.round(change / period)


def _side_sample(
    function: LevelFunction, points: TetrahedronPoints, tets: Tetrahedra, rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) on one side of faces, and the values of the function at them."""
    corners = tets.corners[rows[:, 3]]
    apex = corners[np.arange(len(rows)), rows[:, 4]]
    side_points, value = points.points[apex], points.samples.value[apex]
    is_on = np.flatnonzero(points.is_on_level[apex])
    side_points[is_on] = points.points[corners[is_on]].mean(axis=1)
    value[is_on] = function.values(side_points[is_on])
    return side_points, value
