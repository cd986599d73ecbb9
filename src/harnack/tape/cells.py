"""A grid of cells over a box, with a pruned tape for each cell: the instructions of a formula that
can matter there. Cells whose tapes are the same, as those of an octant that is not divided, share
one list."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.tape.pruning import BoxTapes
from harnack.tree.empty_space import GridData, distance_to_occupied, round_to_short_float

if TYPE_CHECKING:
    from harnack.backend import FloatArray, IntArray
    from harnack.tape.recording import Tape

__all__ = ["CELL_MARGIN", "TapeCells"]

CELL_MARGIN = 1 / 8
"""How far beyond a cell its tape is valid, as a fraction of the cell's size."""

# Cells are not divided if their list has at most this many entries.
_SHORT_LIST = 6
# Cells are not smaller than this fraction of the largest coordinate, so that rounding in single
# precision moves points by far less than the margin.
_MIN_CELL = 2.0**-13
# The grid is larger than the box by about this fraction, half on each side.
_BORDER = 1 / 16
# The smallest and the largest number of times that the box is divided.
_MIN_DEPTH, _MAX_DEPTH = 3, 6
# Cells are divided no further if the lists of all of their octants would have more entries; and the
# number of entries that are treated at once, so that they stay in the processor's cache.
_MAX_ENTRIES, _ENTRIES_AT_ONCE = 24_000_000, 400_000
_OCTANTS = np.array(list(itertools.product((0, 1), repeat=3)))


@dataclass(frozen=True)
class TapeCells(GridData):
    """A uniform grid with a list of instructions for each cell, valid in the cell enlarged by
    `CELL_MARGIN`. A cell is empty if the formula takes no level there.

    lists: the lists. The first is that of the whole tape, for all of space.
    list_of_cell: (cells,) for each cell, x fastest, the index of its list.
    """

    lists: BoxTapes
    list_of_cell: IntArray

    @classmethod
    def of(
        cls, tape: Tape, lower: FloatArray, upper: FloatArray, levels: tuple[float, ...]
    ) -> TapeCells:
        """Make the grid over a box.

        lower, upper: (3,) the corners of the box.
        levels: cells in which the formula takes none of them are empty, and not divided further.

        Proof that a cell is empty: the range of the formula on the enlarged cell does not contain a
        level.
        """
        depth = int(np.clip(round(2.5 + np.log2(len(tape)) / 3), _MIN_DEPTH, _MAX_DEPTH))
        reach = float(np.abs([lower, upper]).max())
        longest = float((upper - lower).max()) * (1 + _BORDER)
        while depth > 0 and longest / 2**depth < _MIN_CELL * reach:
            depth -= 1
        size = round_to_short_float(max(longest / 2**depth, _MIN_CELL * reach))
        origin = (lower - 0.25 * _BORDER * longest).astype(np.float32).astype(np.float64)
        shape = np.ceil((upper + 0.25 * _BORDER * longest - origin) / size).astype(np.int64)
        blocks = -(-shape // 2**depth)
        octree = _Octree(origin, size, levels)
        indices = np.indices(blocks).reshape(3, -1).T
        level = BoxTapes.whole(tape).subset(np.zeros(len(indices), np.int64))
        for rest in range(depth, -1, -1):
            level, indices = octree.divide(level, indices, rest)
            if not len(level):
                break
        shape = blocks * 2**depth
        list_of_cell, is_empty = octree.fill(tuple(shape[::-1].tolist()))
        lists = BoxTapes.concatenated([BoxTapes.whole(tape), *octree.parts])
        counts = (int(shape[0]), int(shape[1]), int(shape[2]))
        return cls(
            origin, size, counts, distance_to_occupied(is_empty), lists, list_of_cell.ravel()
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
        self.parts: list[BoxTapes] = []
        self.leaves: list[tuple[IntArray, int, FloatArray]] = []

    def divide(self, level: BoxTapes, indices: IntArray, rest: int) -> tuple[BoxTapes, IntArray]:
        """Prune the lists of cells of one size, keep those that are not divided, and return the
        octants of the others.

        level: the lists of the cells, pruned for larger boxes around them.
        indices: (n, 3) of the cells in a grid of their own size.
        rest: how many times they could be divided.
        """
        next_lists: list[BoxTapes] = []
        next_indices: list[IntArray] = []
        kept: list[tuple[BoxTapes, IntArray, FloatArray]] = []
        for cells in _batches(level.lengths):
            lower = self._origin + self._size * 2**rest * indices[cells]
            margin = self._size * CELL_MARGIN * (1 + 1e-9)
            lists, low, high = level.subset(cells).pruned(
                lower - margin, lower + self._size * 2**rest + margin
            )
            is_empty = np.ones(len(cells), np.bool_)
            for value in self._levels:
                is_empty &= ~((low <= value) & (high >= value))
            is_divided = ~is_empty & (lists.lengths > _SHORT_LIST) & (rest > 0)
            kept.append((lists, is_divided, is_empty))
        entry_count = sum(8 * int(lists.lengths[divided].sum()) for lists, divided, _ in kept)
        for (lists, is_divided, is_empty), cells in zip(kept, _batches(level.lengths), strict=True):
            if entry_count > _MAX_ENTRIES:
                is_divided = np.zeros_like(is_divided)
            leaves, inner = np.flatnonzero(~is_divided), np.flatnonzero(is_divided)
            self.parts.append(lists.subset(leaves))
            self.leaves.append((indices[cells][leaves], rest, is_empty[leaves]))
            octants = 2 * indices[cells][inner][:, None] + _OCTANTS
            next_indices.append(octants.reshape(-1, 3))
            next_lists.append(lists.subset(np.repeat(inner, 8)))
        return BoxTapes.concatenated(next_lists), np.concatenate(next_indices)

    def fill(self, shape: tuple[int, ...]) -> tuple[IntArray, FloatArray]:
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
