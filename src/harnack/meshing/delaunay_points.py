"""The points of a Delaunay tetrahedralization around the level set {f = 0} of a function f: the
corners and centers of the cells of an octree around it, and the points of the boundary curve, the
closed curve at which the level set ends. Tetrahedra are made of these points, and the level set is
meshed in them. Walls are the faces of the box that cells fill, if the level set may end there:
points on them stay on them.

The vertices of the curve are points of the tetrahedralization. All other points are kept so far
from the curve that no point lies in a ball that has an edge of the curve as its diameter. So every
edge of the curve is an edge of the Delaunay tetrahedralization (Gabriel's condition). Points near
the level set are moved onto it, which removes most slivers (thin tetrahedra).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import limited_rows, row_dots, row_norms
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.tree.empty_space import BoxCells, RefinedCells, refine_cells

__all__ = [
    "BoundaryCurve",
    "RefinementBalls",
    "TetrahedronPoints",
    "box_cells",
    "newton_to_level",
    "sample_delaunay_points",
    "snap_to_level",
    "to_multiple_roots",
]

# All relative to the size of a cell, by experiment.
_JITTER = 1e-3  # the largest random move, so that no five points are on a sphere
_SNAP_DISTANCE = 0.3  # points that are nearer to the level are moved onto it
_MIN_CURVE_DISTANCE = 0.45  # points that are not on the curve are farther from it
# The largest number of cells of the octree.
_MAX_CELLS = 4_000_000
# A step of Newton's method that is shorter than this, relative to the longest step, is the last.
_CONVERGED = 1e-9
# How often the limit of Newton's steps to a multiple root is computed from two of them; and the
# range of ratios of a step to the one before in which that is done.
_SERIES_STEPS, _RATE_RANGE = 4, (0.4, 0.97)
_CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class RefinementBalls:
    """Balls of equal radius that mark where cells have to be smaller: a cell is halved once more if
    it meets one of the balls.

    points: (n, 3) their centers.
    radius: the radius of every ball.
    """

    points: FloatArray
    radius: float

    def meet(self, centers: FloatArray, radii: FloatArray | float) -> BoolArray:
        """(k,) whether other balls meet any of these balls.

        centers, radii: (k, 3), (k,) of the other balls; `radii` may be a common radius.
        """
        if not len(centers):
            return np.zeros(0, np.bool_)
        # (`query` returns distances and indices.)
        distance: FloatArray = kd_tree(self.points).query(centers)[0]
        return distance < self.radius + radii


@dataclass(frozen=True)
class BoundaryCurve:
    """The curve at which a level set ends: closed loops of straight edges between points.

    points: (n, 3).
    edges: (n, 2) indices of the two points of each edge, in the direction in which the curve runs.
    """

    points: FloatArray
    edges: IntArray

    @classmethod
    def of(cls, loops: tuple[FloatArray, ...], longest: float) -> BoundaryCurve:
        """Make the curve of closed loops, each an array (k, 3) of vertices. Its points are first
        the vertices of the loops, in their order; then the points that divide edges longer than the
        length `longest` into equal parts."""
        points = [*loops]
        inner_points: list[FloatArray] = []
        edges: list[tuple[int, int]] = []
        loop_start, point_count = 0, sum(map(len, loops))
        for loop in loops:
            for k, (a, b) in enumerate(zip(loop, np.roll(loop, -1, axis=0), strict=True)):
                part_count = max(1, math.ceil(float(np.linalg.norm(b - a)) / longest))
                inner = a + (np.arange(1, part_count)[:, None] / part_count) * (b - a)
                inner_points.append(inner)
                # The points of the edge in order: a, the new points, b.
                ends = [
                    loop_start + k,
                    *range(point_count, point_count + part_count - 1),
                    loop_start + (k + 1) % len(loop),
                ]
                edges += itertools.pairwise(ends)
                point_count += part_count - 1
            loop_start += len(loop)
        pairs = np.array(edges, np.int64).reshape(-1, 2)
        return cls(np.concatenate([*points, *inner_points, np.zeros((0, 3))]), pairs)

    def split(self, which: BoolArray) -> BoundaryCurve:
        """The curve with those edges halved that the mask `which` selects, (k,) for k edges. Their
        midpoints become additional points, after all existing ones."""
        a, b = self.edges[which].T
        middle = len(self.points) + np.arange(len(a))
        points = np.concatenate([self.points, 0.5 * (self.points[a] + self.points[b])])
        halves = np.concatenate([np.stack([a, middle], axis=1), np.stack([middle, b], axis=1)])
        return BoundaryCurve(points, np.concatenate([self.edges[~which], halves]))

    def split_near(self, places: RefinementBalls, longest: float) -> BoundaryCurve:
        """The curve with edges halved, again and again, as long as an edge is longer than the
        length `longest` and the ball around it meets one of the balls `places`."""
        curve = self
        while True:
            ends = curve.points[curve.edges]
            half = 0.5 * row_norms(ends[:, 1] - ends[:, 0])
            which = (2 * half > longest) & places.meet(ends.mean(axis=1), half)
            if not which.any():
                return curve
            curve = curve.split(which)


@dataclass(frozen=True)
class TetrahedronPoints:
    """The points of a Delaunay tetrahedralization, with samples (value, gradient and more) of the
    function f at them.

    points: (n, 3); the points of the boundary curve come first.
    is_on_level: (n,) whether points are on the level set {f = 0}; points of the curve count as on
        it.
    samples: of f at all points; 0 at the points of the curve.
    """

    points: FloatArray
    is_on_level: BoolArray
    samples: LevelSamples


def box_cells(
    lower: FloatArray, upper: FloatArray, spacing: float, exact: bool
) -> tuple[BoxCells, int]:
    """A few cells that fill a box, from which octrees start; and how many times these cells are to
    be halved until they are no larger than `spacing`.

    lower, upper: the corners (3,) of the box.
    spacing: a length.
    exact: whether the cells fill the box exactly; otherwise they are cubes with edges of `spacing`
        times a power of two, which may reach beyond the box on all sides.
    """
    size = upper - lower
    halvings = max(1, math.ceil(math.log2(float(size.max()) / spacing)))
    # At first the longest side has up to 8 = 2^3 cells; the rest is left to halvings.
    if exact:
        edge = float(size.max()) / 2 ** min(halvings, 3)
        # (1 - 1e-9: rounding adds no cell.)
        counts = np.maximum(1, np.ceil(size / edge * (1 - 1e-9))).astype(int)
        halvings = max(0, math.ceil(math.log2(float((size / counts).max()) / spacing)))
        edges = size / counts
    else:
        edge = spacing * 2.0 ** max(0, halvings - 3)
        counts = np.maximum(1, np.ceil(size / edge)).astype(int)
        lower, edges = 0.5 * (lower + upper - counts * edge), np.full(3, edge)
        halvings = round(math.log2(edge / spacing))
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    return BoxCells(lower + grid * edges, edges), halvings


def sample_delaunay_points(
    function: LevelFunction,
    root: tuple[BoxCells, int],
    boundary: BoundaryCurve,
    walls: tuple[FloatArray, FloatArray] | None,
    seed: int,
    finer: tuple[RefinementBalls, ...] = (),
) -> TetrahedronPoints:
    """Choose the points of a Delaunay tetrahedralization around a level set, and sample the
    function at them. They are the corners and centers of the cells of an octree around the level
    set, moved onto the level set if they are near it, and the points of the boundary curve.

    function: f.
    root: cells that fill the box, and how many times they are to be halved.
    boundary: the curve at which the level set ends.
    walls: the lower and upper corners (3,) of the box, if points on its faces have to stay on them;
        else None.
    seed: the seed of the random moves of points, which make sure that no five points lie on a
        sphere.
    finer: sets of balls; a cell of the octree is halved again, once for each set with a ball that
        meets it.

    Raises:
        MemoryError: there are more than four million cells.
    """
    # Leaves of the octree are `occupied` (they may hold the level set) or proved `empty`.
    tree = refine_cells(root[0], function.clearance, _MAX_CELLS, root[1])
    points, size = _corners_and_centers(tree, _subdivided_cells(function, tree.occupied, finer))
    # Large empty cells count as twice as large as the occupied ones at most.
    min_curve_distance = _MIN_CURVE_DISTANCE * np.minimum(size, 2 * float(tree.occupied.size.max()))
    is_far = _is_far(points, min_curve_distance, boundary)
    points, size = points[is_far], size[is_far]
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-1, 1, points.shape) * _JITTER * size[:, None]
    points = points + (jitter if walls is None else jitter * _off_walls(points, walls))
    samples = function.sample(points)
    points, samples, is_on = _move_onto_level(
        function, points, size, min_curve_distance[is_far], samples, boundary, walls
    )
    n = len(boundary.points)
    # The samples at the points of the curve.
    zeros = LevelSamples(np.zeros(n), np.zeros((n, 3)), np.zeros(n))
    together = [
        np.concatenate([getattr(batch, name) for batch in (zeros, samples)])
        for name in ("value", "gradient", "quarter_period_radius")
    ]
    return TetrahedronPoints(
        np.concatenate([boundary.points, points]),
        np.concatenate([np.ones(n, np.bool_), is_on]),
        LevelSamples(*together),
    )


def _subdivided_cells(
    function: LevelFunction, leaves: BoxCells, finer: tuple[RefinementBalls, ...]
) -> list[BoxCells]:
    """The cells into which leaves of the octree are split, grouped by size, smallest first. A leaf
    is split into octants if it meets a ball of the first entry of `finer`; all cells so far are
    split again if they meet a ball of the second entry; and so on. Cells that are proved to be free
    of the level set are left out, and so are leaves that are not split.

    function: f - level for a field f; it is 0 on the level set.
    """
    pool = [leaves]
    for balls in finer:
        octants: list[BoxCells] = []
        for cells in pool:
            parts = cells.subset(balls.meet(cells.centers, cells.half_diagonal)).octants()
            octants.append(parts.subset(~parts.is_proved_empty(function.clearance)))
        pool += octants
    # The first entry holds the leaves themselves.
    nonempty = [cells for cells in pool[1:] if len(cells.corners)]
    return sorted(nonempty, key=lambda cells: float(cells.size.max()))


def _corners_and_centers(
    tree: RefinedCells, finer: list[BoxCells]
) -> tuple[FloatArray, FloatArray]:
    """The corners and centers of cells, each point once. Returns the points (n, 3); and for each of
    them the edge (n,) of the smallest cell that has it as its corner or center. Cells that are
    proved empty contribute their corners only.

    tree: the octree.
    finer: cells that leaves were split into, grouped by size, smallest first.
    """
    leaves = [*finer, tree.occupied]
    points = [cells.centers for cells in leaves]
    sizes = [np.full(len(cells.corners), float(cells.size.max())) for cells in leaves]
    for layer in [*leaves, *reversed(tree.empty)]:
        corners = (layer.corners[:, None] + _CORNERS * layer.size).reshape(-1, 3)
        points.append(corners)
        sizes.append(np.full(len(corners), float(layer.size.max())))
    x, size = np.concatenate(points), np.concatenate(sizes)
    order = np.argsort(size, kind="stable")
    x, size = x[order], size[order]
    # Coordinates in quarters of the smallest cell are integers, up to rounding.
    steps: FloatArray = (x - x.min(axis=0)) / (0.25 * leaves[0].size)
    keys = np.rint(steps).astype(np.int64)
    # Of equal points the first one is kept; it belongs to the smallest cell.
    kept: IntArray = np.sort(np.unique(keys, axis=0, return_index=True)[1])
    return x[kept], size[kept]


def _is_far(points: FloatArray, free: FloatArray, boundary: BoundaryCurve) -> BoolArray:
    """(n,) whether points are far enough from the boundary curve: farther than given distances, and
    outside of the balls that have the curve's edges as diameters, enlarged by a tenth.

    points: (n, 3).
    free: (n,) the distance for each point.
    """
    if not len(boundary.edges):
        return np.ones(len(points), np.bool_)
    a, b = (boundary.points[boundary.edges[:, k]] for k in (0, 1))
    middle, half = 0.5 * (a + b), 0.5 * row_norms(b - a)
    distance = np.full(len(points), np.inf)
    is_far = np.ones(len(points), np.bool_)
    # Curves may have edges of any lengths: edges of one size, up to a factor of 2, are examined at
    # a time; only the eight edges with the nearest midpoints count.
    log2_half = np.floor(np.log2(half))
    for exponent in np.unique(log2_half):
        rows = np.flatnonzero(log2_half == exponent)
        neighbor_count = min(8, len(rows))
        nearest: IntArray = kd_tree(middle[rows]).query(points, k=neighbor_count)[1]
        index = rows[nearest.reshape(len(points), neighbor_count)]
        edge_vectors, offset = (b - a)[index], points[:, None] - a[index]
        fraction = np.clip(
            (offset * edge_vectors).sum(axis=2) / (edge_vectors * edge_vectors).sum(axis=2), 0, 1
        )
        distances_from_edges = np.linalg.norm(offset - fraction[..., None] * edge_vectors, axis=2)
        from_middle = np.linalg.norm(points[:, None] - middle[index], axis=2)
        distance = np.minimum(distance, distances_from_edges.min(axis=1))
        is_far &= (from_middle > 1.1 * half[index]).all(axis=1)
    return is_far & (distance > free)


def _off_walls(points: FloatArray, walls: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Factors (n, 3) by which moves of points (n, 3) are multiplied, so that points on the faces of
    a box stay on them. A factor is 0 for a point and an axis if the point lies on a face of the box
    at right angles to the axis; else 1.

    walls: the lower and upper corners (3,) of the box.
    """
    # Points this near to a face lie on it, up to rounding.
    margin = 1e-9 * (walls[1] - walls[0])
    is_on_face = (np.abs(points - walls[0]) <= margin) | (np.abs(points - walls[1]) <= margin)
    return np.where(is_on_face, 0.0, 1.0)


def _move_onto_level(
    function: LevelFunction,
    points: FloatArray,
    size: FloatArray,
    free: FloatArray,
    samples: LevelSamples,
    boundary: BoundaryCurve,
    walls: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, LevelSamples, BoolArray]:
    """Move points that are near the level set onto it. A point stays where it is if Newton's method
    does not converge, or would move it by more than 0.45 cells or too near to the curve.

    points: (n, 3).
    size: (n,) the edge of the smallest cell at each point.
    free: (n,) the smallest permitted distances from the boundary curve.
    samples: of the function at the points.
    walls: the lower and upper corners (3,) of the box, if points on its faces have to stay on them;
        else None.

    Returns the points (n, 3); their samples; and a mask (n,) of the points that are on the level
    set.
    """
    near = np.flatnonzero(samples.distance < _SNAP_DISTANCE * size)
    size = size[near]
    # Steps of at most a quarter of a cell, and moves of at most 0.45 cells.
    moved, new_samples, is_moved = snap_to_level(
        function, points[near], samples.select(near), size,
        0.25 * size, 1.5 * _SNAP_DISTANCE * size, walls,
    )  # fmt: skip
    is_moved &= _is_far(moved, free[near], boundary)
    rows = near[is_moved]
    points, is_on = points.copy(), np.zeros(len(points), np.bool_)
    points[rows], is_on[rows] = moved[is_moved], True
    return points, samples.replaced(rows, new_samples.select(is_moved)), is_on


def snap_to_level(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    size: FloatArray | float,
    max_step: FloatArray,
    max_distance: FloatArray | float,
    walls: tuple[FloatArray, FloatArray] | None,
    steps: int = 5,
) -> tuple[FloatArray, LevelSamples, BoolArray]:
    """Move points onto the level set by Newton's method (`newton_to_level`). Returns the moved
    points (n, 3); their samples; and a mask (n,) of those that may be used: the method converged,
    and moved the point by less than `max_distance` (n,).

    function, points, samples, max_step, walls, steps: as in `newton_to_level`.
    size: (n,) the size of cells at the points, to which distances from the level set are compared.
    """
    moved = newton_to_level(function, points, samples, max_step, walls, steps)
    new_samples = function.sample(moved)
    slope = row_norms(new_samples.gradient)
    # |f| / |grad f|, an estimate of the distance, is tiny compared with the cell.
    is_on_level = np.abs(new_samples.value) < 1e-9 * np.maximum(slope * size, 1e-300)
    return moved, new_samples, is_on_level & (row_norms(moved - points) < max_distance)


def newton_to_level(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    max_step: FloatArray,
    walls: tuple[FloatArray, FloatArray] | None,
    steps: int = 5,
) -> FloatArray:
    """Move points towards the level set {f = 0} by steps of Newton's method along the gradient:
    each step is -f grad f / |grad f|^2. Returns the moved points (n, 3).

    function: f - level for a field f; it is 0 on the level set.
    points: (n, 3).
    samples: of f at the points.
    max_step: (n,) the largest length of each step.
    walls: the lower and upper corners of a box; points on its faces stay on them, and no point
        leaves it. None if there is none.
    steps: the largest number of steps.

    A point stops after a step so short that the next step, of the order of the square of this one,
    would be lost in rounding. A point for which the step is not finite, as beside a pole, is not
    moved.
    """
    # `rows` are the points that still move.
    x, rows = points.copy(), np.arange(len(points))
    for k in range(steps):
        current = x[rows]
        g = samples.gradient if walls is None else samples.gradient * _off_walls(current, walls)
        square = row_dots(g, g)
        with np.errstate(invalid="ignore", over="ignore"):
            move = -(samples.value / np.maximum(square, 1e-300))[:, None] * g
            length = row_norms(move)
        lost = ~np.isfinite(length)
        move[lost], length[lost] = 0.0, 0.0
        moved = current + limited_rows(move, max_step[rows])
        x[rows] = moved if walls is None else np.clip(moved, *walls)
        rows = rows[length > _CONVERGED * max_step[rows]]
        if k == steps - 1 or not len(rows):
            break
        samples = function.sample(x[rows])
    return x


def to_multiple_roots(
    function: LevelFunction, points: FloatArray, samples: LevelSamples, max_step: FloatArray
) -> FloatArray:
    """Move points towards a level set {f = 0} on which f has a multiple root: f = u^m near it for
    some function u and some m > 1. There Newton's steps converge only linearly: each step is 1 -
    1/m times the step before. So two of Newton's steps are computed, and the points are moved to
    the limit of the geometric series that begins with these two. This is done four times. Where the
    ratio of the two steps is no such number, both steps are taken. Returns the moved points (n, 3).

    points: (n, 3).
    samples: of f at the points.
    max_step: (n,) the largest length of each of Newton's steps.
    """
    x = points
    for k in range(_SERIES_STEPS):
        # Two single steps, without walls (None).
        once = newton_to_level(
            function, x, samples if k == 0 else function.sample(x), max_step, None, steps=1
        )
        twice = newton_to_level(function, once, function.sample(once), max_step, None, steps=1)
        first_length, second_length = row_norms(once - x), row_norms(twice - once)
        ratio = second_length / np.maximum(first_length, 1e-300)
        is_slow = (ratio > _RATE_RANGE[0]) & (ratio < _RATE_RANGE[1])
        # The second step and all further ones have the sum (second step) / (1 - ratio).
        factor = np.where(is_slow, 1 / (1 - np.minimum(ratio, _RATE_RANGE[1])), 1.0)
        x = once + factor[:, None] * (twice - once)
    return x
