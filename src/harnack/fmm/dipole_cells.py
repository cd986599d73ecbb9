"""FMM cells of dipoles or triangles, which are called primitives. A triangle counts as a sheet of
dipoles along its normal, and f is the sum of the potentials of all primitives. In each cell f is
computed as a direct sum over the near primitives, plus a local expansion (a harmonic polynomial)
for all far ones. The cells are the leaves of an octree over a cube around the primitives. The ball
of a cell is a ball around the cell; a dipole is near if it is within 2.5 radii of the ball from the
cell's center. So the cost of a sample depends only on the number of near primitives. All lengths
are in unit coordinates, in which the data have a size of about one.

- `DipoleCells`: the cells on a backend.
- `TreeWithCells`: sums by cells, or by a tree.
- `build_cells`: builds the cells, one octree level at a time, from the moments of a tree.

Construction. The expansions have degree 6 and are computed from the multipole moments of the nodes
of a tree over the primitives. If sources (nodes or primitives) are far from a cell that is split,
they are added once, to the expansion that all cells inside it inherit. For this, each cell has
lists of the sources that no larger cell around it has added (`dipole_expansion`, `lane_lists`).
Small leaves of the tree are replaced by their dipoles, as the moments of a node cost as much as
seven dipoles.

Errors. The remainder of the expansion is bounded node by node. It is the truncation error of
accuracy scale 1; for larger scales the tree is used. It grows with the distance from the cell's
center to the power 7, one more than the degree, and so does its bound. This allows a factor of 2.5
instead of 3 for near dipoles, with half as many cells. The proved bounds of f near a point are
about f and not about the expansion, so a ray's step may lead into another cell.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, to_numpy, to_vector3
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmax
from harnack.backend.record_table import RecordTable
from harnack.fmm.dipole_expansion import (
    COEFFICIENTS,
    DEGREE,
    TRIANGLE_RATIO,
    DipoleExpansions,
    PendingSources,
    source_tree,
)
from harnack.fmm.local_expansion import (
    evaluate_expansion,
    local_to_local_matrices,
    rounding_tables,
)
from harnack.fmm.source_sums import SUM_MARGIN, SourceSums
from harnack.fmm.unit_frame import coordinate_rounding
from harnack.tree import NO_PRIMITIVE
from harnack.tree.octree_lookup import BALL_MARGIN, OCTANT_OFFSET, OctreeCells, OctreeLookup

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, IntArray, Mask, Real, Vec3
    from harnack.fmm.multipole import NodeMoments
    from harnack.fmm.treecode import AddPrimitive, Treecode
    from harnack.tree import BalancedTree, PackedTree

# The factors k of `dipole_expansion`, by experiment: sources beyond k radii of a cell's ball from
# its center are far. The first factor is for cells that are not split, the second for cells that
# are split, whose expansion all cells inside them inherit. It is larger, as the truncation errors
# of cells of all sizes add up.
_NEAR, _SHARED_RADII = 2.5, 4.0
# Nodes of the tree with a radius up to this fraction of the radius of a cell's ball are left to the
# cells inside it.
_SMALL_NODE_RATIO = 0.35
# Cells are split if they have more than `_MOST_NEAR` near primitives, by experiment. If memory is
# short, this limit is doubled again and again, up to `_MAX_NEAR`, and for triangles up to
# `_MAX_NEAR_FRACTION` of their number; with more near primitives the tree, or cells of edges, are
# faster. Cells of points for very many rays begin with `_FINER_FRACTION` times `_MOST_NEAR`.
_MOST_NEAR, _MAX_NEAR, _MAX_NEAR_FRACTION = 64, 512, 1 / 8
_FINER_FRACTION = 3 / 8
# The number of cells that are built at once.
_CHUNK_SIZE = 1 << 14
# The number of entries of a record before the coefficients; and the base in which an index is
# stored as two numbers, as single precision does not hold all integers above 2^24.
_HEADER_SIZE, _INDEX_BASE = 14, 4096
_UNLIMITED = 2**31 - 1


@dataclass(frozen=True)
class DipoleCells:
    """The FMM cells of dipoles or triangles (the primitives) on a backend. A cell has a list of
    near primitives, and for all far primitives a local expansion: a harmonic polynomial in the
    offset from the cell's center. f is the sum over all primitives.

    lookup: the octree whose leaves are the cells.
    records: one record per cell. In this order it holds: the cell's center (3,), and one over the
        radius of its ball; `error`, `slope`, `tail` and `tail_slope` of `DipoleExpansions`; a bound
        of the rounding of the value; `s4` and `min_distance` of `DipoleExpansions`; the index in
        `near` of the cell's first near primitive, as two numbers (low and high digit); the number
        of its near primitives; and the coefficients of the expansion.
    near: the near primitives of all cells, one list after the other. An entry is an index of a
        record in `primitives`.
    primitives: records of all primitives, in the slots of the leaves of their tree.
    count, size: the number of cells, and the number of bytes that they take.
    """

    backend: Backend
    lookup: OctreeLookup
    records: RecordTable
    near: Any
    primitives: RecordTable
    count: int
    size: int

    def sums(
        self, x: Vec3, active: Mask, add: AddPrimitive, extra_state: tuple[Any, ...]
    ) -> tuple[SourceSums, tuple[Any, ...], Mask]:
        """Sum over all primitives at points x, with gradients: the local expansion of the cell that
        contains x, plus its near primitives one by one.

        x: (3, n), in unit coordinates.
        active: the mask of the lanes to compute.
        add: a function that adds a near primitive to the sums (`treecode.AddPrimitive`).
        extra_state: a further state of the caller, which `add` updates.

        Returns the sums, the new state of the caller, and the mask of the lanes on which the sums
        are valid: the active lanes whose point lies in the cube.

        Proof of the bounds on far primitives. Let a be the distance of x from the cell's center,
        and let all far primitives be at distances D >= `least` from the center. Their distance from
        x is at least D - a >= D (1 - a/least). So the sum of area/distance^4 at x is at most its
        value `fourth` at the center times (1 - a/least)^-4, and the sum of area/distance^5 at most
        that over least - a.

        Rounding. The length by which x was rounded is less than 2 units, where a unit is
        `coordinate_rounding`; the center is exact. f changes by at most the gradient times that
        length, plus 4 `s4` times its square (`SourceSums.sample`).
        """
        vector, index = self.backend.Array3f, self.backend.UInt32
        cell, inside = self.lookup.find_leaf(x)
        active = active & inside
        row = self.records.read_record(cell, active)
        # u: the offset from the cell's center; y: the same in units of the ball's radius.
        u, inverse = x - vector(*row[:3]), row[3]
        y = u * inverse
        value, *slopes = evaluate_expansion(
            row[_HEADER_SIZE : _HEADER_SIZE + COEFFICIENTS], [*y], DEGREE
        )
        error, slope_error, tail, tail_slope, rounding, fourth, least, low, high, count = row[
            4:_HEADER_SIZE
        ]
        # distance: an upper bound of |x - center|; the truncation errors at this distance.
        distance = dr.norm(u) * (1 + SUM_MARGIN)
        error, slope_error = _truncation_at(
            distance * inverse, error, slope_error, tail, tail_slope
        )
        # far_distance: a lower bound of the distance from x to the far primitives; s4 as in the
        # proof.
        far_distance = least - distance
        s4 = fourth * dr.square(dr.square(least / far_distance))
        zero, gradient, shift = (
            self.backend.Float(0),
            inverse * vector(*slopes),
            2 * coordinate_rounding(x),
        )
        rounding = dr.fma(shift, dr.norm(gradient) + slope_error + 4 * shift * s4, rounding)
        far = SourceSums(
            value,
            gradient,
            None,
            error,
            slope_error,
            None,
            rounding,
            far_distance,
            s4,
            s4 / far_distance,
            zero,
        )
        # The cell's part of `near`: the index of its first entry, and the number of entries.
        first, count = index(low) + index(high) * _INDEX_BASE, dr.select(active, index(count), 0)

        def runs(i: Any, *_: Any) -> Mask:
            """Whether the loop goes on, on each lane: its cell has a near primitive number i."""
            return i < count

        def step(i: Any, sums: Any, extra_state: Any) -> tuple[Any, ...]:
            """Add near primitive number i of the cell to the sums, given as a tuple of arrays, by
            the caller's function `add`, which also updates `extra_state`, the state of the caller.
            Returns i + 1, the new sums and the new state of the caller."""
            # The list of each lane's cell: `count` entries of `self.near`, from `first` on. Other
            # lanes in the loop have longer lists.
            in_list = i < count
            primitive = self.primitives.read_record(
                dr.gather(index, self.near, first + i, in_list), in_list
            )
            new_sums, extra_state = add(primitive, in_list, far.with_state(sums), extra_state)
            return i + 1, new_sums.to_state(), extra_state

        start = (index(0), far.to_state(), extra_state)
        _, state, extra_state = dr.while_loop(start, runs, step, label="near primitives")
        sums, near_count = far.with_state(state), self.backend.Float(count)
        # The rounding of the additions to the gradient: a near primitive of area a is at
        # most `_NEAR` + 1 radii away, so its gradient, of order a/distance^3, is at most its part
        # of s4 times this distance.
        added = (_NEAR + 1) * self.backend.machine_epsilon * near_count * sums.s4 / inverse
        sums = dataclasses.replace(sums, gradient_truncation=sums.gradient_truncation + added)
        return sums, extra_state, active


@dataclass(frozen=True)
class TreeWithCells:
    """A sum over dipoles or triangles (the primitives) on a backend: by FMM cells if there are any,
    and by a tree elsewhere. All is in unit coordinates, in which the data have a size of about one.

    clusters: the tree with its multipole moments.
    rounding: a bound of the rounding of the last operations, which turn the sums into the result.
    cells: FMM cells of the same primitives, with which the cost of a sample depends only on the
        number of near primitives; None for no cells.
    """

    clusters: Treecode
    rounding: Real
    cells: DipoleCells | None = None

    @property
    def backend(self) -> Backend:
        return self.clusters.backend

    @property
    def coarsest_accuracy(self) -> float:
        """The smallest accuracy scale that makes a difference: a smaller one gives the same samples
        (`VariableAccuracy.coarsest`). It is 1 if there are cells, which have a single accuracy."""
        return self.clusters.coarsest_accuracy if self.cells is None else 1.0

    def sums(
        self, x: Vec3, detail: Real, adder: Callable[[Real], AddPrimitive],
        extra_state: tuple[Any, ...], active: Mask = True, derivatives: int = 1,
    ) -> tuple[SourceSums, tuple[Any, ...]]:  # fmt: skip
        """Sum over all primitives at points x. The cells are used on lanes on which the accuracy
        scale is at most 1 and x is in their cube, unless second derivatives are requested.

        x: (3, n).
        detail: the accuracy scale; larger is more accurate.
        adder: a function that makes the function that adds a near primitive
            (`treecode.AddPrimitive`). Its argument is a number: primitives are near if they are
            within about so many times their size.
        extra_state: a further state of the caller, which the made function updates.
        active: the mask of the lanes to compute.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian. If there are
            cells, 0 counts as 1.

        Returns the sums, and the new state of the caller.
        """
        if self.cells is None or derivatives == 2:
            add = adder(self.clusters.acceptance_ratio(detail))
            return self.clusters.sums(x, detail, add, extra_state, active, derivatives=derivatives)
        # The tree is at least as accurate as the cells: x may be outside of the cube at a smaller
        # scale.
        lanes, tree_detail = self.backend.Bool(active), fmax(detail, self.backend.Float(1))
        in_cell = adder(self.backend.Float(TRIANGLE_RATIO))
        in_tree = adder(self.clusters.acceptance_ratio(tree_detail))
        sums, state, is_valid = self.cells.sums(x, lanes & (detail <= 1), in_cell, extra_state)
        tree_sums, tree_state = self.clusters.sums(
            x, tree_detail, in_tree, extra_state, lanes & ~is_valid
        )
        pairs = zip(state, tree_state, strict=True)
        state = tuple(dr.select(is_valid, ours, theirs) for ours, theirs in pairs)
        return sums.select(~is_valid, tree_sums), state


def _truncation_at(
    q: Real, error: Real, slope: Real, tail: Real, tail_slope: Real
) -> tuple[Real, Real]:
    """Bound the truncation errors of the local expansion, of value and gradient, at a point whose
    distance from the cell's center is q times the radius of the cell's ball.

    error, slope: bounds of the part of each error that is the same in the whole ball.
    tail, tail_slope: bounds of the other part at q = 1. It is proportional to q^(p+1) for the value
        and to q^p for the gradient, with p = `DEGREE` (`DipoleExpansions`).

    Returns the two bounds: of the value's error, and of the gradient's error.
    """
    power = 1.0 + 0 * q  # 1 on each lane of q
    for _ in range(DEGREE):
        power = power * q
    margin = 1 + SUM_MARGIN
    return dr.fma(tail * margin, power * q, error), dr.fma(tail_slope * margin, power, slope)


@dataclass(frozen=True)
class _CountedCells(OctreeCells):
    """The cells at one depth of the octree, with the numbers of their near primitives.

    is_leaf: (n,) whether a cell is not split.
    near: (n,) the number of near primitives of each cell. For a cell that is split it is only a
        number above the limit, as counting stops there.
    """

    is_leaf: BoolArray = dataclasses.field(kw_only=True)
    near: IntArray = dataclasses.field(kw_only=True)


def build_cells(
    backend: Backend, tree: BalancedTree, levels: list[NodeMoments], rows: FloatArray,
    primitives: RecordTable, half: float, most_bytes: int, *, finer: bool = False,
) -> DipoleCells | None:  # fmt: skip
    """Build the FMM cells of primitives (dipoles or triangles) that lie in a cube.

    tree: a tree over the primitives: which primitives are in which node.
    levels: the multipole moments of its nodes, one entry for each level of the tree.
    rows: the records of the primitives, in the slots of the tree's leaves (`source_tree`).
    primitives: the same records on the backend.
    half: half the side of the cube. The cells fill a slightly larger cube [-h, h]^3, in which h has
        so few digits that single precision holds the centers of all cells exactly.
    most_bytes: the number of bytes that the cells may take. To build them takes several times as
        much memory, which is not counted. If small cells would take more bytes, cells are larger
        and have more near primitives.
    finer: whether to build smaller cells, which take longer to build and save time for very many
        rays.

    Returns None if useful cells would need more than `most_bytes`.

    Proof that each primitive counts once in each cell that is not split. The root of the octree
    begins with the root of the tree. A cell that is split adds the primitives far from it to the
    expansion that all cells in it inherit, and passes the rest, nodes and primitives, to each of
    its octants (`PendingSources.split_far`). In a cell that is not split only near primitives are
    left.
    """
    packed = source_tree(tree, levels, rows)
    # h is a multiple of a power of two near half/256.
    step = 2.0 ** (math.ceil(math.log2(half)) - 8)
    half = math.ceil(half / step) * step
    start_near, max_near = _MOST_NEAR, _MAX_NEAR
    if finer:
        start_near = int(_FINER_FRACTION * start_near)
    if packed.primitives.packets_per_record > 1:  # triangles; the record of a dipole is one packet
        fraction = int(_MAX_NEAR_FRACTION * (tree.leaf_slots != NO_PRIMITIVE).sum())
        max_near = max(_MOST_NEAR, min(_MAX_NEAR, fraction))
    # Cells are split if they have more near primitives than a limit, which is doubled until they
    # take little enough memory. Beyond `max_near`, lists of near primitives take nearly as much
    # memory, whatever the size of the cells.
    limit = start_near
    while (octree := _octree(packed, half, limit, backend, most_bytes)) is None:
        if limit >= max_near:
            return None
        limit = min(2 * limit, max_near)
    double, shifts = packed.backend, local_to_local_matrices(DEGREE, OCTANT_OFFSET)
    sources, parents = (
        PendingSources.of_root(double),
        _ParentExpansions(DipoleExpansions.zero(1), shifts, 0.0),
    )
    tables: list[npt.NDArray[Any]] = []
    near: list[npt.NDArray[Any]] = []
    near_count = 0
    # Each pass adds the cells of one depth: first the cells that are not split, then the others.
    # `sources` has the sources that are left to each cell of this depth, `parents` the expansions
    # that they inherit. With the negative radius `none_stay`, `split_far` replaces every near node
    # by its primitives.
    for level in octree:
        leaves, split = np.flatnonzero(level.is_leaf), np.flatnonzero(~level.is_leaf)
        radius, none_stay = (dr.opaque(double.Float, number) for number in (level.radius, -1.0))
        for cells in _chunks(leaves):
            batch, c = (sources.subset(double, cells), to_vector3(double, level.centers[cells]))
            sums, nearby = batch.split_far(packed, c, radius, _NEAR, none_stay)
            # Lengths and first indices of the lists of near primitives of these cells.
            lengths = to_numpy(nearby.primitives.count).astype(np.int64)
            first = near_count + np.cumsum(lengths) - lengths
            geometry = level.centers[cells], level.radius
            table = _cell_records(backend, *geometry, sums.plus(parents.of(cells)), first, lengths)
            tables.append(table.astype(backend.dtype))
            near.append(to_numpy(nearby.primitives.entries)[: int(lengths.sum())])
            near_count += int(lengths.sum())
        # A cell that is split hands its expansion and its remaining sources to its eight octants.
        split_sums: list[DipoleExpansions] = []
        pending: list[PendingSources] = []
        for cells in _chunks(split):
            to_split, c = (sources.subset(double, cells), to_vector3(double, level.centers[cells]))
            sums, remaining = to_split.split_far(
                packed, c, radius, _SHARED_RADII, _SMALL_NODE_RATIO * radius
            )
            split_sums.append(sums.plus(parents.of(cells)))
            pending.append(remaining)
        if len(split):
            parents = _ParentExpansions(
                DipoleExpansions.concatenate(split_sums), shifts, level.radius
            )
            sources = PendingSources.concatenate(double, pending).subset(
                double, np.repeat(np.arange(len(split)), 8)
            )
    table, entries = np.concatenate(tables), np.concatenate(near)
    levels_of_leaves = [level.is_leaf for level in octree]
    return DipoleCells(
        backend, OctreeLookup.from_levels(backend, np.full(3, -half), 2 * half, levels_of_leaves),
        RecordTable.upload(backend, table),
        upload_integers(backend, entries if len(entries) else np.zeros(1, np.uint32)), primitives,
        len(table), _bytes(backend, octree),
    )  # fmt: skip


def _chunks(cells: IntArray) -> list[IntArray]:
    """Divide an array of indices of cells into batches. A batch is so small that the lists of far
    sources of its cells take little memory."""
    return [cells[start : start + _CHUNK_SIZE] for start in range(0, len(cells), _CHUNK_SIZE)]


@dataclass(frozen=True)
class _ParentExpansions:
    """The expansions that the cells of one depth inherit from their parents, the cells around them
    at the depth above. Cells 8 i to 8 i + 7 are the octants of parent i.

    sums: the expansions of the parents, about the parents' centers.
    shifts: (8, COEFFICIENTS, COEFFICIENTS) matrices that map the coefficients of a parent to those
        about the centers of its octants (`local_expansion.local_to_local_matrices`).
    radius: the radius of the parents' balls; 0 for the root of the octree, which has no parent.
    """

    sums: DipoleExpansions
    shifts: FloatArray
    radius: float

    def of(self, cells: IntArray) -> DipoleExpansions:
        """Compute the expansions that the cells with these indices inherit, about their own
        centers."""
        # self.sums: the expansions of the parents. self.radius: the radius of their balls; 0 for
        # the root, which inherits nothing: `sums` is zero.
        if not self.radius:
            return self.sums
        parents, parent_index = np.unique(cells // 8, return_inverse=True)
        octants = self.sums.subset(parents).to_octants(self.shifts, self.radius)
        return octants.subset(8 * parent_index + cells % 8)


def _cell_records(
    backend: Backend, centers: FloatArray, radius: float, sums: DipoleExpansions, first: IntArray,
    lengths: IntArray,
) -> FloatArray:  # fmt: skip
    """Make the records (n, k) of n cells that are not split, with the columns that
    `DipoleCells.records` describes.

    centers: (n, 3) the centers of the cells.
    radius: the radius of their balls.
    sums: the sums over their far primitives.
    first: (n,) the index of the first near primitive of each cell in the list of all cells.
    lengths: (n,) the number of near primitives of each cell.

    Rounding. Errors of the evaluated polynomial are bounded by `rounding_tables`, for points in the
    cell. The error of the value has its own column; the error of the gradient, which is
    proportional to 1/radius, is added to its truncation error. The rounding of the point x is added
    when a sample is computed (`DipoleCells.sums`).
    """
    tables = rounding_tables(DEGREE, BALL_MARGIN / math.sqrt(3))
    rounding = backend.machine_epsilon * np.abs(sums.coefficients) @ tables
    slope = sums.slope + rounding[:, 1:].sum(axis=1) / radius
    margin, inverse = 1 + SUM_MARGIN, np.full(len(first), 1 / radius)
    # A cell without far primitives has an infinite distance, which must not enter products.
    least = np.minimum(sums.min_distance, 1e3) / margin
    # Column 0 of `rounding` is for the value. s4: the bound of the sum of area/D^4.
    bounds = (sums.error, slope, sums.tail, sums.tail_slope, rounding[:, 0], sums.s4)
    # The index in two parts, since single precision does not hold large integers exactly.
    near_range = first % _INDEX_BASE, first // _INDEX_BASE, lengths
    head = [centers, inverse, *(bound * margin for bound in bounds), least, *near_range]
    return np.column_stack([*head, sums.coefficients])


def _octree(
    packed: PackedTree, half_side: float, max_near: int, backend: Backend, most_bytes: int
) -> list[_CountedCells] | None:
    """Divide the cube [-half_side, half_side]^3 into the cells of an octree. A cell is split if too
    many primitives are near to it, that is, within `_NEAR` radii of its ball from its center. Cells
    of the greatest depth are not split in any case.

    packed: the tree of the primitives.
    max_near: a cell is split if it has more near primitives than this.
    backend: the backend of the finished cells.
    most_bytes: the number of bytes that they may take.

    Returns one entry for each depth of the octree, or None if the cells take more memory.
    """
    double = packed.backend
    root = PendingSources.of_root(double)
    levels: list[_CountedCells] = []
    cells = OctreeCells(np.zeros((1, 3)), half_side)
    while len(cells.centers):
        # Counting stops above the limit; cells of the last depth need the exact number. With the
        # negative radius `none_stay`, near nodes are replaced by their primitives.
        limit = dr.opaque(double.UInt32, _UNLIMITED if cells.is_last else max_near)
        near, none_stay = (dr.opaque(double.Float, length) for length in (_NEAR * cells.radius, -1))
        # Each cell searches the whole tree for its near primitives.
        roots, c = (
            root.subset(double, np.zeros(len(cells.centers), np.int64)),
            to_vector3(double, cells.centers),
        )
        # None: primitives are counted, and not stored.
        counts = roots.primitives_of(packed, c, near, none_stay, None, far=False, count_limit=limit)
        count = to_numpy(counts).astype(np.int64)
        is_leaf = np.broadcast_to(count <= max_near, len(cells.centers)) | cells.is_last
        levels.append(_CountedCells(**vars(cells), is_leaf=is_leaf, near=count))
        if _bytes(backend, levels) > most_bytes:
            return None
        cells = cells.octants(~is_leaf)
    return levels


def _bytes(backend: Backend, levels: list[_CountedCells]) -> int:
    """Compute the number of bytes that cells take: their records, their lists of near primitives,
    and the octree's nodes.

    levels: the cells of each depth of the octree. A cell at the last of these depths that is still
        to be split counts as eight cells, as it becomes at least eight.
    """
    leaves, near = 8 * int((~levels[-1].is_leaf).sum()), 0
    for level in levels:
        leaves += int(level.is_leaf.sum())
        near += int(level.near[level.is_leaf].sum())
    nodes = sum(len(level.is_leaf) for level in levels)
    records = RecordTable.memory_bytes(backend, leaves, _HEADER_SIZE + COEFFICIENTS)
    # The index of a near primitive takes four bytes.
    return records + 4 * near + OctreeLookup.memory_bytes(nodes)
