"""FMM cells of dipoles or triangles: in each cell, a sum over all of them is a direct sum over a
near list plus a local expansion, a harmonic polynomial, of all others.

The cells are the leaves of an octree over a cube around these primitives. The near list of a cell
has the primitives within `_NEAR` times the radius of the cell's ball from its center
(`dipole_expansion`). So the cost of a sample depends on the near list only, and not on the number
of all primitives.

- `DipoleCells`: the cells on a backend.
- `build_cells`: builds the cells, one octree level at a time, from the moments of the tree.

The expansion has degree 6 and is computed from the moments of the tree. Contributions that the
children of a cell share are added once, in the cell, from lists of the nodes and dipoles that no
ancestor has added (`dipole_expansion`, `lane_lists`). Small leaves of the tree are split into
dipoles, as the moments of a node cost as much as seven dipoles. The remainder, bounded node by
node, is the truncation error of accuracy scale 1; higher accuracy comes from the tree. A promise is
about f and not about the expansion, so that steps lead from cell to cell. The remainder of an
expansion of degree p falls with the power p + 1 of the distance from the cell's center, and so does
its bound: therefore dipoles count as near within 2.5 radii of a cell and not within 3, which gives
half as many cells, and a third of the samples that the tree had to repeat.
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
from harnack.fields.clearance import coordinate_rounding
from harnack.fields.solid_angles.dipole_expansion import (
    COEFFICIENTS,
    DEGREE,
    DipoleExpansions,
    PendingSources,
    source_tree,
)
from harnack.fields.solid_angles.local_expansion import (
    evaluate_expansion,
    local_to_local_matrices,
    rounding_tables,
)
from harnack.fields.source_sums import SUM_MARGIN, SourceSums
from harnack.tree import NO_PRIMITIVE
from harnack.tree.octree_lookup import (
    BALL_MARGIN,
    MAX_DEPTH,
    OCTANT_DIRECTIONS,
    OctreeLookup,
    encode_nodes,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, IntArray, Mask, Real, Vec3
    from harnack.fields.solid_angles.multipole import NodeMoments
    from harnack.fields.solid_angles.treecode import AddPrimitive, Treecode
    from harnack.tree import BalancedTree, PackedTree

# Factors k of `dipole_expansion`, by experiment: for cells that are not split, and for cells that
# are, whose far primitives count in all cells inside them. The second factor is larger, as each
# level of cells adds to the truncation.
_NEAR, _SHARED_FACTOR = 2.5, 4.0
# Nodes of the tree with a radius up to this fraction of the radius of a cell's ball are left to the
# cells inside it.
_SMALL_NODE_RATIO = 0.35
# Cells are split if they have more than `_MOST_NEAR` near primitives, by experiment. If memory is
# short, this limit is doubled again and again, up to `_MAX_NEAR`, or up to `_MAX_NEAR_FRACTION` of
# all triangles, from where on the tree, or cells of edges, are faster. Cells of points for very
# many rays have the fraction `_FINER_FRACTION` of that limit.
_MOST_NEAR, _MAX_NEAR, _MAX_NEAR_FRACTION = 64, 512, 1 / 8
_FINER_FRACTION = 3 / 8
# The number of cells that are built at once.
_CHUNK_SIZE = 1 << 14
# Numbers of a record before the coefficients, and the base in which the first index is stored:
# single precision holds no integers above 2^24.
_HEADER_SIZE, _INDEX_BASE = 14, 4096
_NO_LIMIT = 2**31 - 1


@dataclass(frozen=True)
class DipoleCells:
    """Cells on a backend.

    lookup: the octree whose leaves are the cells.
    records: one record per cell: center and one over the radius; bounds of truncation of value and
        gradient, everywhere and in powers of the distance (`DipoleExpansions`), and of the rounding
        of the value; `DipoleExpansions.s4` and `min_distance`; first index (two numbers) and number
        of near primitives | coefficients.
    near: the near primitives, as rows of `primitives`.
    primitives: records of all primitives, in the slots of their tree.
    count, size: the number of cells, and the number of their bytes.
    """

    backend: Backend
    lookup: OctreeLookup
    records: RecordTable
    near: Any
    primitives: RecordTable
    count: int
    size: int

    def sums(
        self, x: Vec3, active: Mask, add: AddPrimitive, extra: tuple[Any, ...]
    ) -> tuple[SourceSums, tuple[Any, ...], Mask]:
        """The sums over all primitives at x, with gradients; the caller's own state; and the mask
        of the lanes on which the sums hold: the active lanes whose point lies in the cube.

        add: as for `Treecode.sums`, for near primitives.
        extra: the caller's own state, which `add` updates.

        Proof of the bounds on far primitives, D >= least from the center, at a point a from it: the
        distance to x is at least D - a >= D (1 - a/least), so that the sum of area/distance^4 is at
        most `fourth` (1 - a/least)^-4, and that of area/distance^5 at most that over least - a.

        Rounding: x was rounded, by less than 2 units as a length; the center is exact. f changes by
        at most the gradient times that, and by that squared times 4 `s4` (`SourceSums.sample`).
        """
        vector, index = self.backend.Array3f, self.backend.UInt32
        cell, inside = self.lookup.find_leaf(x)
        active = active & inside
        row = self.records.read_record(cell, active)
        u, inverse = x - vector(*row[:3]), row[3]
        y = u * inverse
        value, *slopes = evaluate_expansion(
            row[_HEADER_SIZE : _HEADER_SIZE + COEFFICIENTS], [*y], DEGREE
        )
        error, slope_error, tail, tail_slope, rounding, fourth, least, low, high, count = row[
            4:_HEADER_SIZE
        ]
        distance = dr.norm(u) * (1 + SUM_MARGIN)
        error, slope_error = _with_tail(distance * inverse, error, slope_error, tail, tail_slope)
        free = least - distance
        s4 = fourth * dr.square(dr.square(least / free))
        zero, gradient, shift = (
            self.backend.Float(0),
            inverse * vector(*slopes),
            2 * coordinate_rounding(x),
        )
        rounding = dr.fma(shift, dr.norm(gradient) + slope_error + 4 * shift * s4, rounding)
        far = SourceSums(
            value, gradient, None, error, slope_error, None, rounding, free, s4, s4 / free, zero
        )
        first, count = index(low) + index(high) * _INDEX_BASE, dr.select(active, index(count), 0)

        def runs(i: Any, *_: Any) -> Mask:
            return i < count

        def step(i: Any, sums: Any, extra: Any) -> tuple[Any, ...]:
            in_list = i < count
            primitive = self.primitives.read_record(
                dr.gather(index, self.near, first + i, in_list), in_list
            )
            new_sums, extra = add(primitive, in_list, SourceSums.from_state(sums), extra)
            return i + 1, new_sums.to_state(), extra

        start = (index(0), far.to_state(), extra)
        _, state, extra = dr.while_loop(start, runs, step, label="near primitives")
        sums, n = SourceSums.from_state(state), self.backend.Float(count)
        added = (_NEAR + 1) * self.backend.machine_epsilon * n * sums.s4 / inverse
        sums = dataclasses.replace(sums, gradient_truncation=sums.gradient_truncation + added)
        return sums, extra, active

    def sums_with_tree(
        self, tree: Treecode, x: Vec3, detail: Real, add: tuple[AddPrimitive, AddPrimitive],
        extra: tuple[Any, ...], where: Mask = True,
    ) -> tuple[SourceSums, tuple[Any, ...]]:  # fmt: skip
        """The sums at x, with gradients, and the caller's own state: from the cells for details up
        to 1, and from the tree of the same primitives for larger details or outside of the cube.

        add: adds a near primitive to the sums of a cell, and to the sums of the tree.
        extra: the caller's own state.
        """
        in_cell, in_tree = add
        lanes, tree_detail = self.backend.Bool(where), fmax(detail, self.backend.Float(1))
        sums, state, is_valid = self.sums(x, lanes & (detail <= 1), in_cell, extra)
        tree_sums, tree_state = tree.sums(x, tree_detail, in_tree, extra, lanes & ~is_valid)
        pairs = zip(state, tree_state, strict=True)
        state = tuple(dr.select(is_valid, ours, theirs) for ours, theirs in pairs)
        return sums.select(~is_valid, tree_sums), state


def _with_tail(
    q: Real, error: Real, slope: Real, tail: Real, tail_slope: Real
) -> tuple[Real, Real]:
    """Bounds of truncation of value and gradient at q times the radius: see `DipoleExpansions`."""
    power = 1.0 + 0 * q
    for _ in range(DEGREE):
        power = power * q
    margin = 1 + SUM_MARGIN
    return dr.fma(tail * margin, power * q, error), dr.fma(tail_slope * margin, power, slope)


@dataclass(frozen=True)
class _CellLevel:
    """The cells of one size.

    centers: (n, 3) centers of the cells.
    radius: the radius of their balls.
    is_leaf: (n,) whether a cell is not split.
    near: (n,) the number of near primitives, exact for cells that are not split.
    """

    centers: FloatArray
    radius: float
    is_leaf: BoolArray
    near: IntArray


def build_cells(
    backend: Backend, tree: BalancedTree, levels: list[NodeMoments], rows: FloatArray,
    primitives: RecordTable, half: float, most_bytes: int, *, finer: bool = False,
) -> DipoleCells | None:  # fmt: skip
    """Cells of a cube [-h, h]^3, h at least `half`, of at most `most_bytes` bytes, not counting the
    memory for building them, which is several times as much; None if useful cells would need more
    memory. h has so few digits that single precision holds the centers of all cells exactly.

    levels, rows: the moments of the tree, and its primitives in their slots (`source_tree`).
    primitives: records of the primitives on the backend, in the same slots.
    finer: whether cells are for very many rays. If small cells would take more bytes, cells are
        larger and have more near primitives.

    Proof that each primitive counts once in each cell that is not split. The root of the octree
    begins with the root of the tree. A cell that is split adds the primitives far from it to the
    expansions of all cells in it, and leaves the rest, nodes and primitives, to each of its octants
    (`PendingSources.split_far`). In a cell that is not split only near primitives are left.
    """
    packed = source_tree(tree, levels, rows)
    step = 2.0 ** (math.ceil(math.log2(half)) - 8)
    half = math.ceil(half / step) * step
    start_near, max_near = _MOST_NEAR, _MAX_NEAR
    if finer:
        start_near = int(_FINER_FRACTION * start_near)
    if packed.primitives.packets_per_record > 1:
        limit = int(_MAX_NEAR_FRACTION * (tree.leaf_slots != NO_PRIMITIVE).sum())
        max_near = max(_MOST_NEAR, min(_MAX_NEAR, limit))
    octree = _octree_within_memory(packed, half, backend, (start_near, max_near), most_bytes)
    if octree is None:
        return None
    double, shifts = (
        packed.backend,
        local_to_local_matrices(DEGREE, 0.5 / (math.sqrt(3) * BALL_MARGIN)),
    )
    sources, parents = (
        PendingSources.of_root(double),
        _ParentExpansions(DipoleExpansions.zero(1), shifts, 0.0),
    )
    nodes: list[IntArray] = []
    tables: list[npt.NDArray[Any]] = []
    near: list[npt.NDArray[Any]] = []
    splits, count, total = 0, 0, 0
    for level in octree:
        leaves, split = np.flatnonzero(level.is_leaf), np.flatnonzero(~level.is_leaf)
        radius, none_stay = (dr.opaque(double.Float, number) for number in (level.radius, -1.0))
        for cells in _chunks(leaves):
            batch, c = sources.subset(double, cells), to_vector3(double, level.centers[cells])
            sums, nearby = batch.split_far(packed, c, radius, _NEAR, none_stay)
            lengths = to_numpy(nearby.primitives.count).astype(np.int64)
            first = total + np.cumsum(lengths) - lengths
            geometry = level.centers[cells], level.radius
            table = _cell_records(backend, *geometry, sums.plus(parents.of(cells)), first, lengths)
            tables.append(table.astype(backend.dtype))
            near.append(to_numpy(nearby.primitives.entries)[: int(lengths.sum())])
            total += int(lengths.sum())
        nodes.append(encode_nodes(level.is_leaf, count, splits))
        count, splits = count + len(leaves), splits + len(split)
        split_sums: list[DipoleExpansions] = []
        pending: list[PendingSources] = []
        for cells in _chunks(split):
            inner, c = sources.subset(double, cells), to_vector3(double, level.centers[cells])
            sums, rest = inner.split_far(
                packed, c, radius, _SHARED_FACTOR, _SMALL_NODE_RATIO * radius
            )
            split_sums.append(sums.plus(parents.of(cells)))
            pending.append(rest)
        if len(split):
            parents = _ParentExpansions(
                DipoleExpansions.concatenate(split_sums), shifts, level.radius
            )
            sources = PendingSources.concatenate(double, pending).subset(
                double, np.repeat(np.arange(len(split)), 8)
            )
    table, entries = np.concatenate(tables), np.concatenate(near)
    return DipoleCells(
        backend, OctreeLookup.from_levels(backend, np.full(3, -half), 2 * half, nodes),
        RecordTable.upload(backend, table),
        upload_integers(backend, entries if len(entries) else np.zeros(1, np.uint32)), primitives,
        count, _bytes(backend, octree),
    )  # fmt: skip


def _chunks(cells: IntArray) -> list[IntArray]:
    """The cells in batches, so small that lists of the sources far from them take little memory."""
    return [cells[start : start + _CHUNK_SIZE] for start in range(0, len(cells), _CHUNK_SIZE)]


@dataclass(frozen=True)
class _ParentExpansions:
    """The sums that cells of a level inherit from their parents.

    sums: the sums of the parents, whose octants come in the order of the parents.
    shifts: `local_expansion.local_to_local_matrices`.
    radius: the radius of the parents' balls.
    """

    sums: DipoleExpansions
    shifts: FloatArray
    radius: float

    def of(self, cells: IntArray) -> DipoleExpansions:
        """The inherited sums of the cells of the level with these indices."""
        if not self.radius:  # the first level has no parents
            return self.sums
        parents, parent_index = np.unique(cells // 8, return_inverse=True)
        octants = self.sums.subset(parents).to_octants(self.shifts, self.radius)
        return octants.subset(8 * parent_index + cells % 8)


def _cell_records(
    backend: Backend, centers: FloatArray, radius: float, sums: DipoleExpansions, first: IntArray,
    lengths: IntArray,
) -> FloatArray:  # fmt: skip
    """Records of cells. The rounding of the value is that of `rounding_tables`, for coordinates
    within a cell. The rounding of positions is added during evaluation; the rounding of the
    gradient, over the radius, counts as truncation."""
    tables = rounding_tables(DEGREE, BALL_MARGIN / math.sqrt(3))
    rounding = backend.machine_epsilon * np.abs(sums.coefficients) @ tables
    slope = sums.slope + rounding[:, 1:].sum(axis=1) / radius
    margin, inverse = 1 + SUM_MARGIN, np.full(len(first), 1 / radius)
    least = np.minimum(sums.min_distance, 1e3) / margin
    bounds = (sums.error, slope, sums.tail, sums.tail_slope, rounding[:, 0], sums.s4)
    near_range = first % _INDEX_BASE, first // _INDEX_BASE, lengths
    head = [centers, inverse, *(bound * margin for bound in bounds), least, *near_range]
    return np.column_stack([*head, sums.coefficients])


def _octree_within_memory(
    packed: PackedTree, half: float, backend: Backend, near: tuple[int, int], most_bytes: int
) -> list[_CellLevel] | None:
    """The octree with the smallest limit of near primitives per cell that fits in memory, beginning
    with the first number of `near`; None if even the second number takes too much memory: lists of
    near primitives take nearly as much memory, whatever the size of the cells."""

    def is_too_large(levels: list[_CellLevel]) -> bool:
        return _bytes(backend, levels) > most_bytes

    limit, most_near = near
    while (octree := _octree(packed, half, limit, is_too_large)) is None and limit < most_near:
        limit = min(2 * limit, most_near)
    return octree


def _octree(
    packed: PackedTree, half: float, most_near: int, too_large: Callable[[list[_CellLevel]], bool]
) -> list[_CellLevel] | None:
    """The cells of a cube, level by level, split where more than `most_near` primitives are near;
    None if they are too large."""
    backend = packed.backend
    root = PendingSources.of_root(backend)
    levels: list[_CellLevel] = []
    centers = np.zeros((1, 3))
    while len(centers):
        side = half / 2 ** len(levels)
        radius = math.sqrt(3) * side * BALL_MARGIN
        is_last = len(levels) == MAX_DEPTH
        limit = dr.opaque(backend.UInt32, _NO_LIMIT if is_last else most_near)
        near, none_stay = dr.opaque(backend.Float, _NEAR * radius), dr.opaque(backend.Float, -1.0)
        roots, c = (
            root.subset(backend, np.zeros(len(centers), np.int64)),
            to_vector3(backend, centers),
        )
        counts = roots.primitives_of(packed, c, near, none_stay, None, far=False, max_count=limit)
        count = to_numpy(counts).astype(np.int64)
        is_leaf = np.broadcast_to(count <= most_near, len(centers)) | is_last
        levels.append(_CellLevel(centers, radius, is_leaf, count))
        if too_large(levels):
            return None
        centers = (centers[~is_leaf][:, None] + 0.5 * side * OCTANT_DIRECTIONS).reshape(-1, 3)
    return levels


def _bytes(backend: Backend, levels: list[_CellLevel]) -> int:
    """The number of bytes of cells: records, lists of near primitives, and nodes; and at least
    eight records for each cell that is still to be split."""
    leaves, near = 8 * int((~levels[-1].is_leaf).sum()), 0
    for level in levels:
        leaves += int(level.is_leaf.sum())
        near += int(level.near[level.is_leaf].sum())
    nodes = sum(len(level.is_leaf) for level in levels)
    record = 8 * -(-(_HEADER_SIZE + COEFFICIENTS) // 8) * np.dtype(backend.dtype).itemsize
    return record * leaves + 4 * near + OctreeLookup.memory_bytes(nodes)
