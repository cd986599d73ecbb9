"""A grid of cells over a box, with a pruned tape for each cell: the instructions of a formula that
can matter there. Cells whose tapes are the same, as those of an octant that is not divided, share
one list."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.tape.pruning import OCTANTS, BoxLimits, BoxTapes, PrunedTapes
from harnack.tree.empty_space import GridData, distance_to_occupied, round_to_short_float

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.tape.recording import Tape

__all__ = ["CELL_MARGIN", "TapeCells"]

CELL_MARGIN = 1 / 8
"""How far beyond a cell its tape is valid, as a fraction of the cell's size."""

# Cells are not smaller than this fraction of the largest coordinate, so that rounding in single
# precision moves points by far less than the margin.
_MIN_CELL = 2.0**-13
# The grid is larger than the box by about this fraction, half on each side.
_BORDER = 1 / 16
# The smallest and the largest number of times that the box is divided.
_MIN_DEPTH, _MAX_DEPTH = 3, 7
# The largest number where nothing can be left out of a list.
_DEPTH_OF_WHOLE_LISTS = 4
# Where all values matter, lists are longer, and the box is divided this number of times less.
_COARSER = 2
# Cells are divided no further if all of their octants would be more, or the lists of these would
# have more entries.
_MAX_OCTANTS, _MAX_ENTRIES = 1_000_000, 24_000_000
# The number of entries that are treated at once, so that they stay in the processor's cache.
_ENTRIES_AT_ONCE = 100_000


@dataclass(frozen=True)
class TapeCells(GridData):
    """A uniform grid with a list of instructions for each cell, valid in the cell enlarged by
    `CELL_MARGIN`. A cell is empty if the formula takes no level there.

    lists: the lists. The first is that of the whole tape, for all of space.
    limits: for each list, which values it computes rightly.
    sides: for each list (lists,) the number of cells along a side of the block of cells that have
        it. A block of n^3 cells begins at a multiple of n. (1 for the whole tape.)
    list_of_cell: (cells,) for each cell, x fastest, the index of its list.
    """

    lists: BoxTapes
    limits: BoxLimits
    sides: IntArray
    list_of_cell: IntArray

    @classmethod
    def of(
        cls, tape: Tape, lower: FloatArray, upper: FloatArray, levels: tuple[float, ...]
    ) -> TapeCells:
        """Make the grid over a box.

        lower, upper: (3,) the corners of the box.
        levels: cells in which the formula takes none of them are empty, and not divided further;
            and in other cells values far from them are not computed rightly (`BoxLimits`). () if
            all values matter everywhere.

        Proof that a cell is empty: the range of the formula on the enlarged cell does not contain a
        level.
        """
        depth = round(3.5 + np.log2(tape.operation_count) / 3) - (0 if levels else _COARSER)
        depth = int(np.clip(depth, _MIN_DEPTH, _MAX_DEPTH))
        if all(o.choice is None and not o.is_member for o in tape.operations):
            # Nothing is ever left out of a list, so that cells only tell where no level is.
            depth = min(depth, _DEPTH_OF_WHOLE_LISTS)
        reach = float(np.abs([lower, upper]).max())
        longest = float((upper - lower).max()) * (1 + _BORDER)
        while depth > 0 and longest / 2**depth < _MIN_CELL * reach:
            depth -= 1
        size = round_to_short_float(max(longest / 2**depth, _MIN_CELL * reach))
        origin = (lower - 0.25 * _BORDER * longest).astype(np.float32).astype(np.float64)
        shape = np.ceil((upper + 0.25 * _BORDER * longest - origin) / size).astype(np.int64)
        blocks = -(-shape // 2**depth)
        octree = _Octree(origin, size, levels)
        indices: IntArray = np.indices(tuple(blocks.tolist())).reshape(3, -1).T
        lists = BoxTapes.whole(tape).subset(np.zeros(len(indices), np.int64))
        limits = BoxLimits.unlimited(len(indices), levels)
        for rest in range(depth, -1, -1):
            lists, indices, limits = octree.divide(lists, indices, limits, rest)
            if not len(lists):
                break
        shape = blocks * 2**depth
        list_of_cell, is_empty = octree.fill(tuple(shape[::-1].tolist()))
        lists = BoxTapes.concatenated([BoxTapes.whole(tape), *(p.lists for p in octree.parts)])
        whole = BoxLimits.unlimited(1, levels)
        limits = BoxLimits(
            np.concatenate([whole.floor, *(part.limits.floor for part in octree.parts)]),
            np.concatenate([whole.cap, *(part.limits.cap for part in octree.parts)]),
            levels,
        )
        counts = (int(shape[0]), int(shape[1]), int(shape[2]))
        return cls(
            origin,
            size,
            counts,
            distance_to_occupied(is_empty),
            lists,
            limits,
            np.concatenate([[1], *octree.sides]),
            list_of_cell.ravel(),
        )


class _Octree:
    """The cells of an octree that are not divided further, as far as it is built.

    parts: their lists.
    leaves: for each part (indices (n, 3) of the cells in a grid of their own size; the number of
        times such a cell could be divided; whether the cells (n,) are empty).
    """

    def __init__(self, origin: FloatArray, size: float, levels: tuple[float, ...]) -> None:
        """origin, size: the lower corner of the grid, and the size of its smallest cells."""
        self._origin, self._size, self._levels = origin, size, levels
        self.parts: list[PrunedTapes] = []
        self.leaves: list[tuple[IntArray, int, BoolArray]] = []

    @property
    def sides(self) -> list[IntArray]:
        """For each part the sides of its cells, in smallest cells."""
        return [np.full(len(indices), 2**rest) for indices, rest, _ in self.leaves]

    def divide(
        self, lists: BoxTapes, indices: IntArray, limits: BoxLimits, rest: int
    ) -> tuple[BoxTapes, IntArray, BoxLimits]:
        """Prune the lists of cells of one size, keep those that are not divided, and return lists,
        indices and limits of the octants of the others.

        lists: the lists of the cells, pruned for larger boxes around them.
        indices: (n, 3) of the cells in a grid of their own size.
        limits: those of the lists.
        rest: how many times the cells could be divided.
        """
        batches = _batches(lists.lengths)
        results = [self._pruned(lists, indices, limits, rest, cells) for cells in batches]
        # A list of one instruction is not made shorter, so that only fewer empty cells would be
        # told apart: for that the smallest cells cost too much.
        is_divided = [
            ~self._is_empty(part) & (rest > 0) & ((rest > 1) | (part.lists.lengths > 1))
            for part in results
        ]
        octant_count = 8 * sum(int(divided.sum()) for divided in is_divided)
        entry_count = sum(
            8 * int(part.lists.lengths[divided].sum())
            for part, divided in zip(results, is_divided, strict=True)
        )
        is_last = octant_count > _MAX_OCTANTS or entry_count > _MAX_ENTRIES
        octants: list[tuple[BoxTapes, IntArray, BoxLimits]] = []
        for part, divided, cells in zip(results, is_divided, batches, strict=True):
            divided &= not is_last
            leaves, inner = np.flatnonzero(~divided), np.flatnonzero(divided)
            self.parts.append(part.subset(leaves))
            self.leaves.append((indices[cells][leaves], rest, self._is_empty(self.parts[-1])))
            children, corners = np.tile(inner, 8), indices[cells][inner]
            places = (2 * corners + OCTANTS[:, None]).reshape(-1, 3)
            middles = self._origin + self._size * 2**rest * (corners + 0.5)
            margin = self._size * CELL_MARGIN * (1 + 1e-6)
            of_octants = part.subset(inner).octants(middles, margin)
            octants.append((of_octants, places, part.limits.subset(children)))
        return (
            BoxTapes.concatenated([entry[0] for entry in octants]),
            np.concatenate([entry[1] for entry in octants]),
            BoxLimits(
                np.concatenate([entry[2].floor for entry in octants]),
                np.concatenate([entry[2].cap for entry in octants]),
                limits.levels,
            ),
        )

    def _pruned(
        self, lists: BoxTapes, indices: IntArray, limits: BoxLimits, rest: int, cells: IntArray
    ) -> PrunedTapes:
        """The lists of some cells, pruned for these cells with their margins (`divide`)."""
        size = self._size * 2**rest
        lower, margin = self._origin + size * indices[cells], self._size * CELL_MARGIN * (1 + 1e-9)
        return lists.subset(cells).pruned(
            lower - margin, lower + size + margin, limits.subset(cells)
        )

    def _is_empty(self, part: PrunedTapes) -> BoolArray:
        """Whether the formula takes no level in the cells of a part; False without levels."""
        is_empty = np.full(len(part.lists), bool(self._levels))
        for value in self._levels:
            is_empty &= (part.low > value) | (part.high < value)
        return is_empty

    def fill(self, shape: tuple[int, ...]) -> tuple[IntArray, BoolArray]:
        """For each cell of the grid the index of its list, after that of the whole tape, and
        whether it is empty: two arrays of this shape (z, y, x)."""
        list_of_cell, is_empty = np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
        first = 1
        for indices, rest, empty in self.leaves:
            side = 2**rest
            x, y, z = indices.T
            for target, values in (
                (list_of_cell, first + np.arange(len(indices))),
                (is_empty, empty),
            ):
                # Blocks of side^3 cells; the axes of blocks come first.
                blocks = target.reshape(
                    shape[0] // side, side, shape[1] // side, side, shape[2] // side, side
                ).transpose(0, 2, 4, 1, 3, 5)
                blocks[z, y, x] = values[:, None, None, None]
            first += len(indices)
        return list_of_cell, is_empty


def _batches(lengths: IntArray) -> list[IntArray]:
    """The indices of lists, in consecutive batches of about `_ENTRIES_AT_ONCE` entries; one batch
    at least."""
    batch = np.cumsum(lengths) // _ENTRIES_AT_ONCE
    return np.split(np.arange(len(lengths)), np.flatnonzero(np.diff(batch)) + 1)
