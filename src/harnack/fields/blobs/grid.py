"""A uniform grid with a list of blobs for each cell, so that a sample reads only the blobs nearby.

A cell's list holds every blob whose support meets the cell, enlarged by a margin on all sides: the
function is that of the list until a path has left the enlarged cell. For a cell with an empty list,
the grid stores the distance to the nearest cell whose list is not empty, so that a path passes
empty cells in few jumps.
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

# The margin, in cells, within which a cell's list is valid.
_MARGIN = 1 / 4
# The number of pairs of a ball and a cell that are compared at once.
_AT_ONCE = 4_000_000
# The maximal number of cells, and of entries of all lists for each blob; beyond these, cells become
# larger.
_MAX_CELLS, _MAX_ENTRIES = 1 << 24, 200.0


@dataclass(frozen=True)
class CellLists(GridData):
    """A grid of lists of blobs in NumPy, in which a cell is empty if its list is.

    starts: (cells + 1,) the index in `entries` at which each cell's list begins.
    entries: the indices of blobs, in order within each list.
    """

    starts: IntArray
    entries: IntArray

    @classmethod
    def of(cls, centers: FloatArray, supports: FloatArray, cell: float | None = None) -> CellLists:
        """The lists of balls with centers (n, 3) and radii (n,), the supports of blobs.

        cell: the approximate size of a cell; None for 3/5 of the median radius.
        """
        size = float(np.median(supports)) * 0.6 if cell is None else cell
        lower, upper = (centers - supports[:, None]).min(0), (centers + supports[:, None]).max(0)
        while True:
            size = round_to_short_float(size)
            margin = _MARGIN * size
            origin = np.nextafter((lower - 2 * margin).astype(np.float32), np.float32(-np.inf))
            origin = origin.astype(np.float64)
            counts = np.ceil((upper + 2 * margin - origin) / size)
            entries = float(((2 * supports / size + 1.1) ** 3).sum())
            too_large = counts.prod() > _MAX_CELLS or entries > _MAX_ENTRIES * len(supports)
            if not too_large or counts.max() == 1:
                break
            size *= 1.25
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        cells, blobs = _pairs(centers, supports, origin, size, shape)
        order = np.argsort(cells, kind="stable")
        total = shape[0] * shape[1] * shape[2]
        starts = np.zeros(total + 1, dtype=np.int64)
        starts[1:] = np.cumsum(np.bincount(cells, minlength=total))
        is_empty = (np.diff(starts) == 0).reshape(shape[::-1])
        return cls(origin, size, shape, distance_to_occupied(is_empty), starts, blobs[order])


def _pairs(
    centers: FloatArray,
    radii: FloatArray,
    origin: FloatArray,
    size: float,
    shape: tuple[int, int, int],
) -> tuple[IntArray, IntArray]:
    """The pairs of a cell, enlarged by the margin, and a ball that meets it: the indices of the
    cells and of the balls, sorted by balls."""
    padded = radii * (1 + 1e-6)
    first = np.floor((centers - padded[:, None] - origin) / size - _MARGIN).astype(np.int64)
    last = np.floor((centers + padded[:, None] - origin) / size + _MARGIN).astype(np.int64)
    spans = (last - first).max(axis=1) + 1
    cells: list[IntArray] = []
    blobs: list[IntArray] = []
    for span in cast("list[int]", np.unique(spans).tolist()):
        same_span = np.flatnonzero(spans == span)
        for group in np.array_split(same_span, max(1, len(same_span) * span**3 // _AT_ONCE)):
            indices = first[group, :, None] + np.arange(span)  # (m, 3, span)
            lower = origin[:, None] + (indices - _MARGIN) * size
            upper = origin[:, None] + (indices + 1 + _MARGIN) * size
            c = centers[group, :, None]
            squares = np.maximum(np.maximum(lower - c, c - upper), 0) ** 2
            is_inside = (indices >= 0) & (indices < np.array(shape)[:, None])
            squares[~is_inside] = np.inf
            x, y, z = squares[:, 0], squares[:, 1], squares[:, 2]
            distances = z[:, :, None, None] + y[:, None, :, None] + x[:, None, None, :]
            ball, k, j, i = np.nonzero(distances <= (padded[group] ** 2)[:, None, None, None])
            px, py, pz = (indices[ball, axis, n] for axis, n in enumerate((i, j, k)))
            cells.append(px + shape[0] * (py + shape[1] * pz))
            blobs.append(group[ball])
    all_cells, all_blobs = np.concatenate(cells), np.concatenate(blobs)
    order = np.argsort(all_blobs, kind="stable")
    return all_cells[order], all_blobs[order]


@dataclass(frozen=True)
class BlobGrid(EmptySpaceGrid):
    """The cell lists of blobs on a backend."""

    starts: Any
    entries: Any

    @classmethod
    def upload(cls, backend: Backend, lists: CellLists) -> BlobGrid:
        """The lists on a backend."""
        return cls(
            *cls.upload_layout(backend, lists),
            _MARGIN,
            upload_integers(backend, lists.starts),
            upload_integers(backend, lists.entries),
        )

    def list_at(self, p: Vec3) -> tuple[Any, Any]:
        """The indices at which the list of the cell of p begins and ends. Outside of the grid the
        list of the nearest cell is valid too, since no support reaches beyond the grid."""
        kind, index = self.backend.UInt32, self.cell(p).index
        return dr.gather(kind, self.starts, index), dr.gather(kind, self.starts, index + 1)
