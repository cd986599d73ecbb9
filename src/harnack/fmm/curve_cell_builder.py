"""Builds FMM cells of curves (`curve_cells`), one octree depth at a time. A curve consists of
closed loops of straight edges, in unit coordinates (a size of about 1). In a cell, its solid angle
is a sum over the near edges, plus a local expansion: a harmonic polynomial for all far edges. The
ball of a cell is a ball around the cell; an edge is near if it is within a few radii of the ball
from the cell's center. The near edges form runs of consecutive edges, each of which is closed to a
loop by two closing edges that meet in a further vertex, its apex (`edge_runs`). The parent of a
cell is the cell around it that was split.

A cell inherits the expansion and the near runs of its parent. The edges of these runs that are far
from the cell are added to the expansion. So the work for a cell is proportional to the number of
near edges of its parent, and not to the whole curve. All edges are visited only for bounds of the
far edges.

- `build_curve_cells`: builds the cells of a cube, with a limit of their bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.fmm.curve_cells import HEADER_SIZE, VERTICES_PER_RECORD, CurveCells
from harnack.fmm.edge_expansion import COEFFICIENTS, DEGREE, EdgeExpansions
from harnack.fmm.edge_runs import EdgeRuns, VertexTable, subtract_runs
from harnack.fmm.edges import Edge, LoopEdges, inverse_squares
from harnack.fmm.local_expansion import local_to_local_matrices, rounding_tables
from harnack.tree.closest_triangles import squared_distance_to_segment
from harnack.tree.octree_lookup import BALL_MARGIN, OCTANT_OFFSET, OctreeCells, OctreeLookup

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

_PERIOD = 4 * math.pi
# Edges are near to a cell if they are within this many radii of its ball from its center:
# `_NEAR_RADII` for cells that are not split; `_SHARED_RADII` for cells that are split. It is larger
# for these, as the expansion of their far edges is passed on to all cells inside them.
_NEAR_RADII, _SHARED_RADII = 3.0, 4.5
# Cells are split if they have more near edges than `_NEAR_PER_CUBE_ROOT` times the cube root of the
# number of all edges (but at least `_MIN_NEAR`), or if the truncation error exceeds about
# `_MAX_TAIL_RATIO` times the integral of |dp|/D^2, a bound of the gradient. Chosen by
# experiment.
_NEAR_PER_CUBE_ROOT, _MIN_NEAR, _MAX_TAIL_RATIO = 2.0, 6.0, 1e-5
# If memory is short, cells may have twice as many near edges and four times the truncation error,
# in at most this many attempts.
_ATTEMPTS = 4
# Corners and centers of all cells are multiples of this over 2^DEEPEST, in unit coordinates: single
# precision holds them exactly.
_GRID_STEP = 2.0**-8
# The relative margin of sums in single precision that serve as bounds. Edges that are near by less
# than this fraction of the distance count in the bounds of far edges as well.
_SUM_MARGIN = 1e-3
# The largest number of records of near edges, so that single precision holds their indices.
_MAX_RECORDS = 2**24


def build_curve_cells(
    backend: Backend, loops: tuple[FloatArray, ...], low: FloatArray, high: FloatArray,
    most_bytes: int, near: float = 1.0, shared: float = _SHARED_RADII,
) -> CurveCells | None:  # fmt: skip
    """Build the FMM cells of a curve, in a cube around a box.

    loops: for each loop of the curve, its vertices (n, 3) in unit coordinates (a size of about 1).
    low, high: (3,) two opposite corners of the box, in unit coordinates.
    most_bytes: the number of bytes that the cells may take. If they would take more, they are built
        again, larger and with more near edges.
    near: the factor by which cells may have more near edges, and a larger truncation error, than
        usual.
    shared: if a cell is split, the edges farther than this many radii of its ball from its center
        are summed once, in an expansion that all cells inside it inherit.

    Returns None if even the largest cells would take more than `most_bytes`.

    Proof. The cell of the cube begins with all loops as its near runs and an expansion of 0. Each
    cell keeps those edges of its parent's runs that are near to it, as runs that are closed again.
    The remaining edges (`edge_runs.subtract_runs`) form a cycle that is far from the cell's ball,
    and go into the expansion. So in each cell, near loops and expansion together have the solid
    angle of the curve, modulo 4 pi.
    """
    loops = tuple(loop.astype(backend.dtype).astype(np.float64) for loop in loops)
    # The cube's center and half side are multiples of `_GRID_STEP`; the cube is larger by one step
    # than the box needs.
    middle = np.round(0.5 * (low + high) / _GRID_STEP) * _GRID_STEP
    half = float(np.maximum(high - middle, middle - low).max())
    half = (math.ceil(half / _GRID_STEP) + 1) * _GRID_STEP
    edges = LoopEdges.upload(backend, loops)
    # A cell is split if it has more near edges than the first number, or if its truncation error is
    # more than the second number times a bound of the gradient.
    max_near, max_tail = (
        max(_MIN_NEAR, _NEAR_PER_CUBE_ROOT * sum(map(len, loops)) ** (1 / 3)),
        _MAX_TAIL_RATIO,
    )
    max_near, max_tail = near * max_near, near * max_tail
    for _ in range(_ATTEMPTS):
        builder = _CurveCellBuilder(
            backend, VertexTable.of(loops), edges, middle, half, max_near, max_tail, shared
        )
        if builder.grow(most_bytes):
            return builder.cells()
        max_near, max_tail = 2 * max_near, 4 * max_tail
    return None


@dataclass
class _CurveCellBuilder:
    """The FMM cells of a curve in a cube, under construction: the octree of the cells, and the
    records of the cells that are not split. In integrals along the curve, D is the distance from a
    cell's center to the point p of the curve.

    backend: the backend of the finished cells.
    vertices: the curve as a table of vertices, for runs of edges.
    edges: the same curve on the backend, for sums over all edges.
    middle, half: the center (3,) of the cube, and half of its side.
    most_near, max_tail_ratio: a cell is split if it has more near edges than `most_near`, or if its
        truncation error is more than `max_tail_ratio` times the integral of |dp|/D^2.
    parent_ratio: edges are near to a cell that is split if they are within this many radii of its
        ball from its center.
    levels: for each depth so far, the mask (n,) of the cells that are not split.
    tables: the records of the cells so far that are not split, as in `CurveCells.records`.
    near: the records of their near edges, as in `CurveCells.near`.
    """

    backend: Backend
    vertices: VertexTable
    edges: LoopEdges
    middle: FloatArray
    half: float
    most_near: float
    max_tail_ratio: float
    parent_ratio: float
    levels: list[BoolArray] = field(default_factory=list[BoolArray])
    tables: list[FloatArray] = field(default_factory=list[FloatArray])
    near: list[FloatArray] = field(default_factory=list[FloatArray])

    def grow(self, most_bytes: int) -> bool:
        """Build all cells, one depth of the octree after the other. Returns False as soon as the
        cells exceed `most_bytes` or there are too many records of near edges, and True when all are
        built."""
        shifts = local_to_local_matrices(DEGREE, OCTANT_OFFSET)
        # The first depth has one cell, the cube. far: the expansions of the cells of a depth.
        cells = OctreeCells(self.middle[None], self.half)
        runs, far = EdgeRuns.of_loops(self.vertices), EdgeExpansions.zero(1)
        while len(cells.centers):
            is_leaf, runs, far = self._build_depth(cells, runs, far)
            self.levels.append(is_leaf)
            if self.size > most_bytes or sum(map(len, self.near)) >= _MAX_RECORDS:
                return False
            runs, far = runs.to_octants(~is_leaf), far.to_octants(~is_leaf, shifts, cells.radius)
            cells = cells.octants(~is_leaf)
        return True

    def _build_depth(
        self, cells: OctreeCells, runs: EdgeRuns, far: EdgeExpansions
    ) -> tuple[BoolArray, EdgeRuns, EdgeExpansions]:
        """Build the n cells of one depth of the octree, and decide which of them are split. Records
        of the cells that are not split are appended to `tables` and `near`.

        runs: the near runs that the cells inherit from their parents.
        far: the expansions of far edges that the cells inherit from their parents.

        Returns the mask (n,) of the cells that are not split, and the near runs and the expansions
        of all n cells.
        """
        # run, cell, distance: for each edge of the inherited runs, the index of its run, the index
        # of its cell, and its distance from the cell's center.
        double, n = choose_backend("double"), len(cells.centers)
        centers, radius = cells.centers, cells.radius
        run, vertex_ids = runs.edges()
        cell = runs.cell[run]
        distance = _distances(self.vertices, centers, cell, vertex_ids, double)
        near_count = np.bincount(cell, distance <= _NEAR_RADII * radius, n)
        far_bounds = _FarBounds.of(self.edges, centers, radius)
        is_leaf = (near_count <= self.most_near) & (
            far_bounds.tail <= self.max_tail_ratio * far_bounds.total
        ) | cells.is_last
        # The runs of near edges, closed again; all other edges go into the expansion. Cells that
        # are split keep edges up to `parent_ratio` radii, for their octants.
        near_radius = np.where(is_leaf, _NEAR_RADII, self.parent_ratio) * radius
        near_runs, is_kept = runs.restrict_to_near(run, distance <= near_radius[cell])
        near_runs = near_runs.with_apexes(
            self.vertices, centers, near_radius, np.dtype(self.backend.dtype)
        )
        remaining = subtract_runs(
            runs, (run, vertex_ids), is_kept, near_runs, len(self.vertices.points)
        )
        # `remaining` refers to a table of the vertices, the old apexes and the new apexes.
        points = np.concatenate([self.vertices.points, runs.apex, near_runs.apex])
        # Zeros fill each record up to a packet of eight numbers.
        point_records = RecordTable.upload(
            double, np.column_stack([points, np.zeros((len(points), 5))])
        )
        far = far.plus(
            EdgeExpansions.of(
                point_records,
                remaining,
                to_vector3(double, centers),
                dr.opaque(double.Float, radius),
                n,
            )
        )
        if is_leaf.any():
            near_table, first_record, record_counts = near_records(
                self.vertices, near_runs, is_leaf
            )
            factor = _rounding_factor(self.vertices, near_runs, centers, radius)[is_leaf]
            bounds = far.subset(is_leaf), far_bounds.subset(is_leaf), factor
            near_range = sum(map(len, self.near)) + first_record, record_counts
            records = _cell_records(self.backend, centers[is_leaf], radius, *bounds, *near_range)
            self.tables.append(records)
            self.near.append(near_table)
        return is_leaf, near_runs, far

    @property
    def size(self) -> int:
        """The number of bytes of all cells so far: their records, the records of their near edges,
        and the octree with its lookup grid."""
        # A vertex of near edges takes four numbers.
        tables = (self.tables, HEADER_SIZE + COEFFICIENTS), (self.near, 4 * VERTICES_PER_RECORD)
        return OctreeLookup.memory_bytes(sum(map(len, self.levels))) + sum(
            RecordTable.memory_bytes(self.backend, sum(map(len, parts)), width)
            for parts, width in tables
        )

    def cells(self) -> CurveCells:
        """Upload the finished cells to the backend."""
        backend = self.backend
        lookup = OctreeLookup.from_levels(
            backend, self.middle - self.half, 2 * self.half, self.levels
        )
        # One more record, so that the table is not empty if no cell has near edges.
        near = np.concatenate([*self.near, np.zeros((1, 4 * VERTICES_PER_RECORD))])
        table = np.concatenate(self.tables)
        records, near_edges = (RecordTable.upload(backend, rows) for rows in (table, near))
        return CurveCells(backend, lookup, records, near_edges, len(table), self.size)


@dataclass(frozen=True)
class _FarBounds:
    """Bounds of sums over the far edges of a curve, for each of n cells. D is the distance of the
    point p of an edge from the cell's center.

    least: (n,) a lower bound of the distance of the far edges from the center.
    inverse_cubes: (n,) an upper bound of the integral of |dp|/D^3 over the far edges.
    slope: (n, 3) the gradient of this integral as a function of the center.
    tail: (n,) an estimate of the truncation error of the expansion's value.
    total: (n,) an upper bound of the integral of |dp|/D^2 over all edges, far and near.
    """

    least: FloatArray
    inverse_cubes: FloatArray
    slope: FloatArray
    tail: FloatArray
    total: FloatArray

    @classmethod
    def of(cls, edges: LoopEdges, centers: FloatArray, radius: float) -> _FarBounds:
        """Compute the bounds for n cells, by a sum over all edges. Edges farther than about
        `_NEAR_RADII` radii from a center count as far.

        edges: the edges of the curve.
        centers: (n, 3) the centers of the cells.
        radius: the radius of their balls.
        """
        backend, c = edges.backend, to_vector3(edges.backend, centers)
        ball_radius = dr.opaque(backend.Float, radius)
        far_from = dr.opaque(backend.Float, _NEAR_RADII * radius * (1 - _SUM_MARGIN))

        def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the edge from p to q to the sums of the cells with the centers c.

            An edge is far if its distance from c is more than `far_from`. `ball_radius` is the
            radius of the cells' balls.

            inverse: 1/|q - p|^2.
            state: the smallest squared distance of a far edge; then, summed over the far edges,
                the integral of |dp|/D^3, the gradient of this integral, and an estimate of the
                truncation error; then, summed over all edges, a bound of the integral of |dp|/D^2.

            Returns the new state.
            """
            least_square, inverse_cubes, slope, tail, total = state
            edge = Edge.between(p, q, inverse, c)
            square, length = edge.squared_distance, dr.rsqrt(inverse)
            # weight: the integral of |dp|/D^3 over the edge, which is the factor w of `Edge` times
            # the length. The second one of `hessian_factors` is grad w.
            weight, inverse_distance = edge.biot_savart()[0] * length, dr.rsqrt(square)
            is_far, radius_ratio = square > far_from * far_from, ball_radius * inverse_distance
            # The first omitted term, of degree p + 1: proportional to (radius/D)^(p+1)/D per
            # length.
            truncation = weight * square
            for _ in range(DEGREE + 1):
                truncation = truncation * radius_ratio
            new_slope = dr.fma(type(slope)(length), edge.hessian_factors()[1], slope)
            # The integral of |dp|/D^2 is at most 2 D times that of |dp|/D^3, with the least D
            # (`edges.sum_over_edges`).
            return (
                dr.select(is_far, fmin(least_square, square), least_square),
                inverse_cubes + dr.select(is_far, weight, 0),
                dr.select(is_far, new_slope, slope),
                tail + dr.select(is_far, truncation, 0),
                dr.fma(2 * weight, square * inverse_distance, total),
            )

        zero = backend.Float(0)
        # The first number is larger than all squared distances; it stays if no edge is far.
        start = (backend.Float(1e6), zero, backend.Array3f(0), zero, zero)
        sums = edges.for_each(add, start, "around cells")
        dr.eval(*sums)
        columns = (to_numpy(column).astype(np.float64) for column in sums)
        least_square, inverse_cubes, slope, tail, total = columns
        return cls(
            np.sqrt(least_square) * (1 - _SUM_MARGIN),
            inverse_cubes * (1 + _SUM_MARGIN),
            slope,
            tail,
            total,
        )

    def subset(self, which: BoolArray) -> _FarBounds:
        """Select the bounds of the cells on which a mask (n,) is true."""
        return _FarBounds(*(values[which] for values in vars(self).values()))


def _distances(
    vertices: VertexTable, centers: FloatArray, cell: IntArray, first: IntArray, backend: Backend
) -> FloatArray:
    """Compute the distances (k,) of edges from the centers of their cells.

    vertices: the table of the curve's vertices.
    centers: (n, 3) of the cells.
    cell: (k,) for each edge the index of its cell.
    first: (k,) for each edge the row of its start in the table; its end is in the next row.
    """
    if not len(cell):
        return np.zeros(0)
    vector = backend.Array3f
    points, middles = to_vector3(backend, vertices.points), to_vector3(backend, centers)
    start = upload_integers(backend, first)
    c = dr.gather(vector, middles, upload_integers(backend, cell))
    p, q = dr.gather(vector, points, start), dr.gather(vector, points, start + 1)
    # For an edge of length 0 any finite number will do.
    inverse = dr.rcp(fmax(dr.squared_norm(q - p), backend.Float(1e-30)))
    return to_numpy(dr.sqrt(squared_distance_to_segment(p - c, q - p, inverse)))


def near_records(
    vertices: VertexTable, runs: EdgeRuns, is_leaf: BoolArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Make the records of the near edges of the cells that are not split, as `CurveCells.near`
    describes them. A cell's records hold its near runs, one after another: the vertices of a run,
    then, unless the run is a whole loop, its apex and its first vertex again.

    vertices: the table of the curve's vertices.
    runs: the near runs of all n cells, closed by apexes.
    is_leaf: (n,) the mask of the cells that are not split.

    Returns the table of records; and two arrays with an entry for each cell that is not split: the
    index of its first record, and the number of its records.
    """
    # length: the number of vertices that a run takes; `count` is the number of its edges.
    run_ids = np.flatnonzero(is_leaf[runs.cell])
    first, count, is_open = runs.first[run_ids], runs.count[run_ids], ~runs.is_whole[run_ids]
    leaf_index = (np.cumsum(is_leaf) - 1)[runs.cell[run_ids]]
    # An open run has two vertices more than its edges have: the apex, and the first vertex again.
    length = count + np.where(is_open, 3, 1)
    per_leaf = np.bincount(leaf_index, length, int(is_leaf.sum())).astype(np.int64)
    record_count = -(-per_leaf // VERTICES_PER_RECORD)
    first_record = np.cumsum(record_count) - record_count
    # first_slot: the position of each run's first vertex among the vertices of its own cell; then
    # its position in the table.
    first_slot = np.cumsum(length) - length - (np.cumsum(per_leaf) - per_leaf)[leaf_index]
    first_slot += first_record[leaf_index] * VERTICES_PER_RECORD
    table = np.zeros((int(record_count.sum()) * VERTICES_PER_RECORD, 4))
    # The vertices of the runs: rank is the position of a vertex in its run. The first vertex of a
    # run keeps the number 0, as no edge leads to it.
    run = np.repeat(np.arange(len(run_ids)), count + 1)
    rank = np.arange(len(run)) - (np.cumsum(count + 1) - count - 1)[run]
    slot, vertex = first_slot[run] + rank, first[run] + rank
    table[slot, :3] = vertices.points[vertex]
    is_later = rank > 0
    edge = vertices.points[vertex[is_later]] - vertices.points[vertex[is_later] - 1]
    table[slot[is_later], 3] = inverse_squares(edge)
    # The two closing edges of each open run, marked by negative numbers.
    last_slot = (first_slot + count)[is_open]
    apex, start_point = runs.apex[run_ids[is_open]], vertices.points[first[is_open]]
    table[last_slot + 1, :3], table[last_slot + 2, :3] = apex, start_point
    table[last_slot + 1, 3] = -inverse_squares(apex - table[last_slot, :3])
    table[last_slot + 2, 3] = -inverse_squares(apex - start_point)
    return table.reshape(-1, 4 * VERTICES_PER_RECORD), first_record, record_count


def _rounding_factor(
    vertices: VertexTable, runs: EdgeRuns, centers: FloatArray, radius: float
) -> FloatArray:
    """Compute factors (n,) for the rounding errors of the near loops of n cells. The result of
    `edges.vertex_rounding`, times the cell's factor, bounds the error also for loops with apexes.

    vertices: the table of the curve's vertices.
    runs: the near runs of the cells.
    centers: (n, 3) the centers of the cells.
    radius: the radius of their balls.

    Proof. Let h be the largest half length of an edge, and R the largest distance of a vertex from
    x. By `LoopEdges.rounding` the error is at most epsilon (2.9 h + 2.25 R) times the integral of
    |dp|/D^2, a sum without products of h and R. `edges.vertex_rounding` puts 1 for h and 1 + |x|
    for R, which is right for edges of the curve, as it lies in the unit ball. Apexes may lie
    outside: then h may exceed 1, and R may exceed 1 + |x|. A factor F that is at least 1, at least
    h, and at least the distance from x to any apex, is enough: 2.9 F >= 2.9 h, and
    2.25 (1 + |x|) F >= 2.25 R. (The factors 0.51 = 1.02/2 and 1.01 leave a little for rounding.)
    """
    # Each cell's factor is the largest over its runs: of the half lengths of their closing edges,
    # and of the distances of their apexes from the points of the ball.
    factors = np.ones(len(centers))
    run_ids = np.flatnonzero(~runs.is_whole)
    apex, cell, first = runs.apex[run_ids], runs.cell[run_ids], runs.first[run_ids]
    ends = vertices.points[first], vertices.points[first + runs.count[run_ids]]
    for end in ends:
        np.maximum.at(factors, cell, 0.51 * np.linalg.norm(apex - end, axis=1))
    np.maximum.at(factors, cell, 1.01 * (np.linalg.norm(apex - centers[cell], axis=1) + radius))
    return factors


def _cell_records(
    backend: Backend, centers: FloatArray, radius: float, far: EdgeExpansions, bounds: _FarBounds,
    factor: FloatArray, first: IntArray, count: IntArray,
) -> FloatArray:  # fmt: skip
    """Make the records (n, k) of n cells that are not split, with the columns that
    `CurveCells.records` describes.

    centers: (n, 3) the centers of the cells.
    radius: the radius of their balls.
    far: the expansions of their far edges.
    bounds: the bounds of their far edges.
    factor: (n,) factors for the rounding of the near loops, from `_rounding_factor`.
    first: (n,) the index of the first record of near edges of each cell.
    count: (n,) the number of these records.

    The rounding of the value has three parts. The first is that of the polynomial without its
    constant (`rounding_tables`). The second is that of the angle of the near loops
    (`LoopEdges.rounding`). The third comes from the constant, which is at most 2 pi, and from two
    sums, each of which is at most 6 pi plus the polynomial: it is at most 32 epsilon, plus a part
    that the tables cover. The rounding of the gradient, which is proportional to 1/radius, is added
    to the bound of its truncation error.
    """
    tables = rounding_tables(DEGREE, BALL_MARGIN / math.sqrt(3))
    coefficients, margin = far.coefficients.copy(), 1 + _SUM_MARGIN
    # The constant is known modulo 4 pi: the smallest such number is used.
    coefficients[:, 0] -= _PERIOD * np.round(coefficients[:, 0] / _PERIOD)
    # rounding: (n, 4) for the value, and for the three derivatives in units of 1/radius.
    rounding = backend.machine_epsilon * np.abs(coefficients[:, 1:]) @ tables[1:]
    # 48 is 16 of `LoopEdges.rounding` and 32 of the third part.
    value_rounding = rounding[:, 0] + backend.machine_epsilon * (
        48 + 7.25 * VERTICES_PER_RECORD * count
    )
    slope_error = far.slope + rounding[:, 1:].sum(axis=1) / radius
    # `least` is finite also for cells without far edges.
    inverse, least = np.full(len(first), 1 / radius), np.minimum(bounds.least, 1e3)
    columns = [
        far.error * margin,
        slope_error * margin,
        value_rounding * margin,
        least,
        factor,
        bounds.inverse_cubes,
    ]
    return np.column_stack([centers, inverse, *columns, bounds.slope, first, count, coefficients])
