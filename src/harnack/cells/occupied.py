"""Equal cubes of which those that are proved to hold no level are known: rays jump across them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from harnack.cells.octree import Cells, octree
from harnack.cells.uniform_grid import GridLayout, UniformGrid, distances_to_full, short_length

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray
    from harnack.cells.octree import Clearance

__all__ = ["OccupiedCells"]

# Empty cells are proved to be empty so far beyond their faces, in cells; cubes of the octree's
# first round have 2^_ROUNDS cells a side.
_MARGIN, _ROUNDS = 1 / 16, 3


@dataclass(frozen=True)
class OccupiedCells(GridLayout):
    """A grid whose empty cells hold no point of a set, nor does what is around them: see
    `UniformGrid`."""

    @classmethod
    def of(
        cls, lower: FloatArray, upper: FloatArray, clearance: Clearance, across: int
    ) -> OccupiedCells:
        """A grid over a box that holds the set, with about so many cells along its longest side.

        Outside of the box there is nothing, so a cell at its faces is empty outwards as well.
        There are fewer cells where they would be smaller than the spacing of single precision.
        """
        reach = np.abs([lower, upper]).max().astype(np.float32)
        cell = max(float((upper - lower).max()) / across, float(np.spacing(reach)))
        cell = short_length(cell)
        # Room for rounding the corner down, and for the margin beyond what the set may reach.
        room = (_MARGIN + 1e-3) * cell
        origin = np.nextafter((lower - room).astype(np.float32), np.float32(-np.inf))
        origin = origin.astype(np.float64)
        side = cell * 2**_ROUNDS
        nx, ny, nz = (int(count) for count in np.ceil((upper + room - origin) / side))
        places = np.indices((nx, ny, nz)).reshape(3, -1).T
        roots = Cells(origin + side * places, np.full(3, side))
        roots = roots.some(~roots.proved_empty(clearance, _MARGIN))
        cells = octree(roots, clearance, np.iinfo(np.int64).max, _ROUNDS, _MARGIN).leaves
        nx, ny, nz = (count << _ROUNDS for count in (nx, ny, nz))
        empty = np.ones((nz, ny, nx), np.bool_)
        x, y, z = np.round((cells.corners - origin) / cell).astype(np.int64).T
        empty[z, y, x] = False
        return cls(origin, cell, (nx, ny, nz), distances_to_full(empty))

    @classmethod
    def none(cls) -> OccupiedCells:
        """A grid around the empty set: one cell, and all is empty."""
        return cls(np.zeros(3), 1.0, (1, 1, 1), distances_to_full(np.ones((1, 1, 1), np.bool_)))

    def centres(self) -> FloatArray:
        """Of the cells that are not empty, (n, 3)."""
        x, y, z = self.shape
        places = np.argwhere((self.free == 0).reshape(z, y, x))[:, ::-1]
        return self.origin + self.cell * (places + 0.5)

    def thinned(self, clearance: Clearance) -> OccupiedCells:
        """The same grid without cells whose eight halves are proved empty, as far beyond the faces
        of the cell."""
        x, y, z = self.shape
        full = (self.free == 0).reshape(z, y, x)
        places = np.argwhere(full)[:, ::-1]
        halves = Cells(self.origin + self.cell * places, np.full(3, self.cell)).split()
        full[full] = ~halves.proved_empty(clearance, 2 * _MARGIN).reshape(-1, 8).all(axis=1)
        return replace(self, free=distances_to_full(~full))

    def upload(self, backend: Backend) -> UniformGrid:
        """The grid on a backend."""
        return UniformGrid(*UniformGrid.placed(backend, self), _MARGIN)
