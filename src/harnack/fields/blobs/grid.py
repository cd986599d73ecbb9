"""A uniform grid with a list of blobs for each cell, so that the sum of all blobs at a point is
computed from the few blobs nearby. A blob is a bump around a center that is 0 outside of a ball,
its support. A cell's list holds every blob whose support meets the cell, enlarged by a margin on
all sides. So the sum over the list is the sum over all blobs until a path has left the enlarged
cell. Lists hold indices of blobs, one list after another in a single array.

For a cell with an empty list, the grid stores the distance to the nearest cell whose list is not
empty, so that a path passes empty cells in few jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.arrays import upload_integers
from harnack.tree.empty_space import (
    EmptySpaceGrid,
    GridData,
    distance_to_occupied,
    round_to_short_float,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Vec3

# How far beyond a cell its list is valid, as a fraction of the cell's size.
_MARGIN = 1 / 4
# The number of pairs (ball, cell) that are compared in one NumPy expression, to save memory.
_PAIRS_AT_ONCE = 4_000_000
# The maximal number of cells, and the maximal number of list entries per blob. If a grid would have
# more, its cells are made larger.
_MOST_CELLS, _MOST_ENTRIES = 1 << 24, 200.0


@dataclass(frozen=True)
class CellLists(GridData):
    """A uniform grid with a list of blobs for each cell, as NumPy arrays: the blobs whose supports
    (balls outside of which they are 0) meet the enlarged cell. A cell is empty if its list is
    empty.

    starts: (cells + 1,) the list of cell k is entries[starts[k]:starts[k + 1]].
    entries: the lists, one after another: indices of blobs, increasing within each list.
    """

    starts: IntArray
    entries: IntArray

    @classmethod
    def of(cls, centers: FloatArray, supports: FloatArray, cell: float | None = None) -> CellLists:
        """Make the grid and its lists for blobs that are 0 outside of balls.

        centers: (n, 3) centers of the balls.
        supports: (n,) radii of the balls.
        cell: the approximate size of a cell; None for 3/5 of the median radius. Cells are made
            larger if there would be more than 2^24 of them or more than 200 list entries for each
            blob.
        """
        size = float(np.median(supports)) * 0.6 if cell is None else cell
        lower, upper = (centers - supports[:, None]).min(0), (centers + supports[:, None]).max(0)
        while True:
            size = round_to_short_float(size)
            # The grid extends beyond all supports by two margins.
            margin = _MARGIN * size
            # Rounded down to single precision, so that every backend has the same corner.
            origin = np.nextafter((lower - 2 * margin).astype(np.float32), np.float32(-np.inf))
            origin = origin.astype(np.float64)
            counts = np.ceil((upper + 2 * margin - origin) / size)
            # A ball of radius r meets about (2 r / size + 1.1)^3 cells.
            entry_estimate = float(((2 * supports / size + 1.1) ** 3).sum())
            too_large = counts.prod() > _MOST_CELLS or entry_estimate > _MOST_ENTRIES * len(
                supports
            )
            if not too_large or counts.max() == 1:
                break
            # Too many cells or entries: again with larger cells.
            size *= 1.25
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        cell_of_pair, blob_of_pair = _cell_ball_pairs(centers, supports, origin, size, shape)
        # Stable, so that the blobs of each list stay in increasing order.
        by_cell = np.argsort(cell_of_pair, kind="stable")
        cell_count = shape[0] * shape[1] * shape[2]
        starts = np.zeros(cell_count + 1, dtype=np.int64)
        starts[1:] = np.cumsum(np.bincount(cell_of_pair, minlength=cell_count))
        is_empty = (np.diff(starts) == 0).reshape(shape[::-1])
        return cls(
            origin, size, shape, distance_to_occupied(is_empty), starts, blob_of_pair[by_cell]
        )


def _cell_ball_pairs(
    centers: FloatArray,
    radii: FloatArray,
    origin: FloatArray,
    size: float,
    shape: tuple[int, int, int],
) -> tuple[IntArray, IntArray]:
    """All pairs of a cell of a grid and a ball for which the ball meets the cell, enlarged by
    `_MARGIN` of its size on all sides.

    centers, radii: (n, 3) and (n,), of the balls.
    origin: the lowest corner of the grid.
    size: the side length of a cell.
    shape: the number of cells along x, y and z.

    Returns the index of the cell and the index of the ball of each pair, sorted by balls. The index
    of the cell (i, j, k) is i + nx (j + ny k).
    """
    # (1e-6 covers the rounding of the positions.)
    padded_radii = radii * (1 + 1e-6)
    first_cell = np.floor((centers - padded_radii[:, None] - origin) / size - _MARGIN).astype(
        np.int64
    )
    last_cell = np.floor((centers + padded_radii[:, None] - origin) / size + _MARGIN).astype(
        np.int64
    )
    # The number of cells along an axis that may meet a ball. Balls with the same number are treated
    # at once.
    spans = (last_cell - first_cell).max(axis=1) + 1
    cells: list[IntArray] = []
    blobs: list[IntArray] = []
    for span in cast("list[int]", np.unique(spans).tolist()):
        same_span = np.flatnonzero(spans == span)
        for balls in np.array_split(same_span, max(1, len(same_span) * span**3 // _PAIRS_AT_ONCE)):
            indices = first_cell[balls, :, None] + np.arange(span)  # (m, 3, span)
            lower = origin[:, None] + (indices - _MARGIN) * size
            upper = origin[:, None] + (indices + 1 + _MARGIN) * size
            center = centers[balls, :, None]
            # The square of the distance from the center to a cell, axis by axis.
            squares = np.maximum(np.maximum(lower - center, center - upper), 0) ** 2
            is_inside = (indices >= 0) & (indices < np.array(shape)[:, None])
            squares[~is_inside] = np.inf
            x, y, z = squares[:, 0], squares[:, 1], squares[:, 2]
            # The squared distances: for each ball, an array over z, y and x.
            square_sums = z[:, :, None, None] + y[:, None, :, None] + x[:, None, None, :]
            ball, k, j, i = np.nonzero(
                square_sums <= (padded_radii[balls] ** 2)[:, None, None, None]
            )
            cell_x, cell_y, cell_z = (indices[ball, axis, n] for axis, n in enumerate((i, j, k)))
            cells.append(cell_x + shape[0] * (cell_y + shape[1] * cell_z))
            blobs.append(balls[ball])
    all_cells, all_blobs = np.concatenate(cells), np.concatenate(blobs)
    by_ball = np.argsort(all_blobs, kind="stable")
    return all_cells[by_ball], all_blobs[by_ball]


@dataclass(frozen=True)
class BlobGrid(EmptySpaceGrid):
    """A uniform grid with a list of blobs for each cell, as arrays on a backend. The blobs of a
    cell's list are all that may be nonzero in the cell, enlarged by a margin.

    starts: (cells + 1,) Dr.Jit integers: the list of cell k is entries[starts[k]:starts[k + 1]].
    entries: the lists, one after another, as Dr.Jit integers: indices of blobs.
    """

    starts: Any
    entries: Any

    @classmethod
    def upload(cls, backend: Backend, lists: CellLists) -> BlobGrid:
        """Make the grid on a backend from the lists of all cells in NumPy arrays."""
        return cls(
            *cls.upload_layout(backend, lists),
            _MARGIN,
            upload_integers(backend, lists.starts),
            upload_integers(backend, lists.entries),
        )

    def list_at(self, p: Vec3) -> tuple[Any, Any]:
        """The list of blobs that may be nonzero at p, as the two positions (begin, end) for which
        it is entries[begin:end].

        It is the list of the cell that contains p. For p outside of the grid it is that of the
        nearest cell. This list is right, too, since no blob extends beyond the grid, so that all
        are 0 at p.
        """
        kind, index = self.backend.UInt32, self.cell(p).index
        return dr.gather(kind, self.starts, index), dr.gather(kind, self.starts, index + 1)
