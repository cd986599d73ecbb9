"""Equal cubes, most of them empty, and how far a ray stays among the empty ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend.arrays import aligned_integers
from harnack.backend.extrema import clamp, fmin
from harnack.backend.lengths import largest_coordinate

if TYPE_CHECKING:
    from harnack.backend import Backend, BoolArray, FloatArray, IntArray, Mask, Real, Vec3

__all__ = ["GridCell", "GridLayout", "UniformGrid", "distances_to_full", "short_length"]

# Of what is true beyond an empty cell, this part of a cell is left to the rounding of positions.
_ROUNDING = 1 / 64


Layout = TypeVar("Layout", bound="GridLayout")


@dataclass(frozen=True)
class GridLayout:
    """A grid on the host.

    origin: (3,) its lower corner, numbers of single precision. cell: the side of a cell
        (`short_length`). shape: cells a side. The first cell's neighbor is the next along x.
    free: (cells,) 0 where a cell is not empty, else the distance to the nearest that is not, in
        cells, the largest of the three coordinates.
    """

    origin: FloatArray
    cell: float
    shape: tuple[int, int, int]
    free: IntArray


@dataclass(frozen=True)
class UniformGrid:
    """A grid on a backend, all numbers of it as data.

    margin: in cells; the cube around an empty cell that is so much larger on all sides is empty.
    Outside of the grid all is as in its nearest cell.
    """

    backend: Backend
    origin: Vec3
    size: Real
    shape: Vec3
    free: Any
    margin: float

    @staticmethod
    def placed(backend: Backend, layout: GridLayout) -> tuple[Backend, Vec3, Real, Vec3, Any]:
        """The first five numbers of a grid."""

        def vector(numbers: Any) -> Vec3:
            return backend.Array3f(*(dr.opaque(backend.Float, float(one)) for one in numbers))

        return (
            backend,
            vector(layout.origin),
            dr.opaque(backend.Float, layout.cell),
            vector(layout.shape),
            aligned_integers(backend, layout.free),
        )

    def cell(self, p: Vec3) -> GridCell:
        """The cell in which p lies, or the nearest one."""
        place = (p - self.origin) / self.size
        corner = type(p)(*(clamp(dr.floor(place[k]), 0, self.shape[k] - 1) for k in range(3)))
        x, y, z = (self.backend.UInt32(corner[k]) for k in range(3))
        row, layer = self.backend.UInt32(self.shape.x), self.backend.UInt32(self.shape.y)
        return GridCell(self, place, corner, x + row * (y + layer * z))

    def run(self, p: Vec3, d: Vec3, length: Real) -> Real:
        """How far p + s d stays in empty cells; about `length` if it is that at least.

        Proof. The cell of a point and all fewer than `free` away are empty, and so is what is
        within the margin around each: the cube of these cells, wider by the margin. A step
        leaves that cube by `margin` less `_ROUNDING` at most, so that all of it is empty; the rest
        of the margin is for the rounding of positions. Steps end where a cell is not empty.
        """

        def state_of(s: Real) -> tuple[Real, Mask]:
            cell = self.cell(dr.fma(type(p)(s), d, p))
            free = cell.free
            return dr.select(free > 0, s + cell.exit(d, self.backend.Float(free)), s), free > 0

        def body(s: Real, active: Mask) -> tuple[Real, Mask]:
            further, empty = state_of(s)
            return dr.select(active, further, s), active & empty & (further < length)

        start = self.backend.Float(0) + 0 * p.x
        active = dr.full(self.backend.Bool, True, 1) & (start == start) & (length > 0)

        def running(s: Real, active: Mask) -> Mask:
            del s
            return active

        return dr.while_loop((start, active), running, body, label="empty cells")[0]

    def resolves(self, o: Vec3, end: Real) -> Mask:
        """Whether rounding leaves points of rays up to `end` in their cells or close to them."""
        rounding = 4 * self.backend.epsilon * (largest_coordinate(o) + end)
        return (rounding < _ROUNDING * self.size) & dr.all(dr.isfinite(o))

    def free_until(self, o: Vec3, d: Vec3, t: Real, end: Real) -> Real:
        """A place up to which rays o + t d, |d| = 1, stay in empty cells from t on, at most `end`.

        It is t itself where coordinates are so large that rounding might lead into another cell:
        a point is off by at most four roundings of the largest number in it.
        """
        length = dr.select(self.resolves(o, end), end - t, 0)
        run = self.run(dr.fma(type(o)(t), d, o), d, length)
        return dr.select(length > 0, fmin(t + run, end), t)


@dataclass(frozen=True)
class GridCell:
    """Where points lie: their place in units of cells, the cell's lower corner, and its index."""

    grid: UniformGrid
    place: Vec3
    corner: Vec3
    index: Any

    @property
    def free(self) -> Any:
        """See `GridLayout`."""
        return dr.gather(self.grid.backend.UInt32, self.grid.free, self.index)

    def exit(self, d: Vec3, around: Real = 1.0) -> Real:
        """How far the path with direction d stays among the cells fewer than `around` away, and a
        little beyond; infinite where the grid ends there."""
        length: Real = self.grid.backend.Float(dr.inf)
        beyond = self.grid.margin - _ROUNDING
        for k in range(3):
            upper, lower = self.corner[k] + around, self.corner[k] + 1 - around
            rising = d[k] > 0
            gap = dr.select(rising, upper - self.place[k], self.place[k] - lower)
            ends = dr.select(rising, upper >= self.grid.shape[k], lower <= 0)
            reach = (gap + beyond) / dr.abs(d[k])
            length = fmin(dr.select(ends | (d[k] == 0), dr.inf, reach), length)
        return length * self.grid.size


def distances_to_full(empty: BoolArray) -> IntArray:
    """`GridLayout.free` of cells (nz, ny, nx)."""
    if empty.all():
        return np.full(empty.size, max(empty.shape), np.int64)
    from scipy import ndimage  # here: a third of a second that few need

    chessboard: Any = cast("Any", ndimage).distance_transform_cdt  # by its usual metric
    return np.asarray(chessboard(empty), dtype=np.int64).ravel()


def short_length(size: float) -> float:
    """A length nearby, at most one part in 4,096 off, that is a power of two times an integer below
    2^13, so that single precision holds its multiples."""
    mantissa, exponent = math.frexp(size)
    return math.ldexp(round(mantissa * 4096), exponent - 12)
