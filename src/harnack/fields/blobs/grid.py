"""A uniform grid with a list of blobs in each cell, so that a look costs what is near.

A cell's list holds every blob whose support meets the cell, enlarged by a margin on all sides: the
function is that of the list until a path has left the enlarged cell. Cells with an empty list know
how many cells around them are empty too, so that a path passes them in few jumps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
from scipy import ndimage

from harnack.backend.arrays import aligned_integers
from harnack.backend.extrema import clamp, fmin

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3

# Of a cell: how far lists are right beyond it, and how far a path goes on into the next one. The
# difference is what rounding of positions may be.
_MARGIN, _BEYOND = 1 / 4, 1 / 4 - 1 / 64
# Spheres times cells that are compared at once.
_AT_ONCE = 4_000_000
# Cells at most, and entries of all lists for each blob at most: beyond, cells get larger.
_MOST_CELLS, _MOST_ENTRIES = 1 << 24, 200.0


@dataclass(frozen=True)
class CellLists:
    """A grid on the host.

    origin: (3,) its lower corner, numbers of single precision. cell: the side of a cell, a power
        of two times an integer below 2^12, so that single precision holds it. shape: cells a side.
    starts: (cells + 1,) where each cell's list begins among `entries`. The first cell's neighbour
        is the next along x.
    entries: blobs, by their index, in order within each list.
    free: (cells,) 0 where the list is not empty, else the distance to the nearest cell where it is
        not, in cells, the largest of the three coordinates.
    """

    origin: FloatArray
    cell: float
    shape: tuple[int, int, int]
    starts: IntArray
    entries: IntArray
    free: IntArray

    @classmethod
    def of(cls, centres: FloatArray, supports: FloatArray, cell: float | None = None) -> CellLists:
        """The lists of balls with centres (n, 3) and radii (n,).

        cell: about how large a cell is; None for 3/5 of the median radius.
        """
        size = float(np.median(supports)) * 0.6 if cell is None else cell
        low, high = (centres - supports[:, None]).min(0), (centres + supports[:, None]).max(0)
        while True:
            size = _short(size)
            margin = _MARGIN * size
            origin = np.nextafter((low - 2 * margin).astype(np.float32), np.float32(-np.inf))
            origin = origin.astype(np.float64)
            counts = np.ceil((high + 2 * margin - origin) / size)
            entries = float(((2 * supports / size + 1.1) ** 3).sum())
            many = counts.prod() > _MOST_CELLS or entries > _MOST_ENTRIES * len(supports)
            if not many or counts.max() == 1:
                break
            size *= 1.25
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        cells, blobs = _pairs(centres, supports, origin, size, shape)
        order = np.argsort(cells, kind="stable")
        total = shape[0] * shape[1] * shape[2]
        starts = np.zeros(total + 1, dtype=np.int64)
        starts[1:] = np.cumsum(np.bincount(cells, minlength=total))
        empty = (np.diff(starts) == 0).reshape(shape[::-1])
        free = np.asarray(_chessboard(empty), dtype=np.int64)
        return cls(origin, size, shape, starts, blobs[order], free.ravel())


_chessboard = cast("Any", ndimage).distance_transform_cdt  # untyped; its usual metric


def _short(size: float) -> float:
    """A number nearby that has few digits in base two."""
    mantissa, exponent = math.frexp(size)
    return math.ldexp(round(mantissa * 4096), exponent - 12)


def _pairs(
    centres: FloatArray,
    radii: FloatArray,
    origin: FloatArray,
    size: float,
    shape: tuple[int, int, int],
) -> tuple[IntArray, IntArray]:
    """Cells, enlarged by the margin, and balls that meet; balls in order for each cell."""
    wide = radii * (1 + 1e-6)
    first = np.floor((centres - wide[:, None] - origin) / size - _MARGIN).astype(np.int64)
    last = np.floor((centres + wide[:, None] - origin) / size + _MARGIN).astype(np.int64)
    spans = (last - first).max(axis=1) + 1
    cells: list[IntArray] = []
    blobs: list[IntArray] = []
    for span in cast("list[int]", np.unique(spans).tolist()):
        alike = np.flatnonzero(spans == span)
        for part in np.array_split(alike, max(1, len(alike) * span**3 // _AT_ONCE)):
            places = first[part, :, None] + np.arange(span)  # (m, 3, span)
            lower = origin[:, None] + (places - _MARGIN) * size
            upper = origin[:, None] + (places + 1 + _MARGIN) * size
            c = centres[part, :, None]
            squares = np.maximum(np.maximum(lower - c, c - upper), 0) ** 2
            inside = (places >= 0) & (places < np.array(shape)[:, None])
            squares[~inside] = np.inf
            x, y, z = squares[:, 0], squares[:, 1], squares[:, 2]
            total = z[:, :, None, None] + y[:, None, :, None] + x[:, None, None, :]
            ball, k, j, i = np.nonzero(total <= (wide[part] ** 2)[:, None, None, None])
            px, py, pz = (places[ball, axis, n] for axis, n in enumerate((i, j, k)))
            cells.append(px + shape[0] * (py + shape[1] * pz))
            blobs.append(part[ball])
    found, which = np.concatenate(cells), np.concatenate(blobs)
    order = np.argsort(which, kind="stable")
    return found[order], which[order]


@dataclass(frozen=True)
class Grid:
    """Cell lists on a backend."""

    backend: Backend
    origin: Vec3
    size: Real
    shape: Vec3
    starts: Any
    entries: Any
    free: Any

    @classmethod
    def upload(cls, backend: Backend, lists: CellLists) -> Grid:
        """The lists on a backend, all numbers of them as data."""

        def vector(numbers: Any) -> Vec3:
            return backend.Array3f(*(dr.opaque(backend.Float, float(one)) for one in numbers))

        return cls(
            backend,
            vector(lists.origin),
            dr.opaque(backend.Float, lists.cell),
            vector(lists.shape),
            aligned_integers(backend, lists.starts),
            aligned_integers(backend, lists.entries),
            aligned_integers(backend, lists.free),
        )

    def cell(self, p: Vec3) -> Cell:
        """The cell in which p lies; outside of the grid the nearest one, whose list is right there
        too, since no support reaches beyond the grid."""
        place = (p - self.origin) / self.size
        corner = type(p)(*(clamp(dr.floor(place[k]), 0, self.shape[k] - 1) for k in range(3)))
        x, y, z = (self.backend.UInt32(corner[k]) for k in range(3))
        row, layer = self.backend.UInt32(self.shape.x), self.backend.UInt32(self.shape.y)
        return Cell(self, place, corner, x + row * (y + layer * z))

    def run(self, p: Vec3, d: Vec3, length: Real) -> Real:
        """How far p + s d stays in cells with empty lists; about `length` if it is that at least.

        The end lies in the next cell, but within the margin of the last.
        """

        def state_of(s: Real) -> tuple[Real, Mask]:
            cell = self.cell(dr.fma(type(p)(s), d, p))
            free = cell.free
            return dr.select(free > 0, s + cell.exit(d, self.backend.Float(free)), s), free > 0

        def body(s: Real, active: Mask) -> tuple[Real, Mask]:
            further, empty = state_of(s)
            return dr.select(active, further, s), active & empty & (further < length)

        start = self.backend.Float(0) + 0 * p.x
        active = dr.full(self.backend.Bool, True, 1) & (start == start)

        def running(s: Real, active: Mask) -> Mask:
            del s
            return active

        return dr.while_loop((start, active), running, body, label="empty cells")[0]


@dataclass(frozen=True)
class Cell:
    """Where points lie: their place in units of cells, the cell's lower corner, and its index."""

    grid: Grid
    place: Vec3
    corner: Vec3
    index: Any

    @property
    def free(self) -> Any:
        """See `CellLists`."""
        return dr.gather(self.grid.backend.UInt32, self.grid.free, self.index)

    def entries(self) -> tuple[Any, Any]:
        """Where the cell's list begins and ends."""
        kind, starts = self.grid.backend.UInt32, self.grid.starts
        return dr.gather(kind, starts, self.index), dr.gather(kind, starts, self.index + 1)

    def exit(self, d: Vec3, around: Real = 1.0) -> Real:
        """How far the path with direction d stays among the cells fewer than `around` away, and a
        little beyond; infinite where the grid ends there."""
        length: Real = self.grid.backend.Float(dr.inf)
        for k in range(3):
            upper, lower = self.corner[k] + around, self.corner[k] + 1 - around
            rising = d[k] > 0
            gap = dr.select(rising, upper - self.place[k], self.place[k] - lower)
            ends = dr.select(rising, upper >= self.grid.shape[k], lower <= 0)
            reach = (gap + _BEYOND) / dr.abs(d[k])
            length = fmin(dr.select(ends | (d[k] == 0), dr.inf, reach), length)
        return length * self.grid.size
