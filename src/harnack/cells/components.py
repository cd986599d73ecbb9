"""Groups of cells that are separated by cells proved empty, and the largest of them.

Equal cubes of which those that are proved to hold no level are known: rays jump across them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.cells.octree import Cells, octree
from harnack.cells.uniform_grid import GridLayout, UniformGrid, distances_to_full, short_length

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray
    from harnack.cells.octree import Clearance

__all__ = ["OccupiedCells", "largest_connected_component"]

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

    def centers(self) -> FloatArray:
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


# Cells that share a face, an edge or a corner are neighbors.
_AROUND = np.ones((3, 3, 3), np.bool_)


def largest_connected_component(cells: OccupiedCells) -> OccupiedCells:
    """The grid in which only the cells of one group are not empty: that with the largest shadows,
    in all, along the three axes.

    A shadow is all rows of cells, along one axis, with a cell of the group. A count of cells would
    be of areas, or of volumes, only if as many cells were left around each piece of a surface: but
    more are left where its function vanishes to a higher order, and as few around both sides of a
    plate that is thinner than a cell as around one. Shadows are the same for all of these, but for
    the cells at their rims: those are more, by several, where a function vanishes to a higher
    order, so that coarse cells may choose a smaller component for it. Of equal shadows, the first
    along z, y and x is the largest.

    Proof that no component of the set is cut in two. All of the set lies in cells that are not
    empty, as closed cubes. A connected part of it cannot be covered by two unions of such cubes
    that are closed and have no point in common; cubes have a point in common if they share at least
    a corner, which is to be neighbors. So it lies in the cells of one group.

    Proof that rays may jump across the other groups, with the margin that `UniformGrid.run` goes
    beyond the cells that it jumps across. A neighbor of a cell of another group belongs to that
    group or was empty before, and the margin is less than a cell, so it holds nothing of this
    group; that of a cell that was empty before holds nothing of the set at all.
    """
    x, y, z = cells.shape
    full = (cells.free == 0).reshape(z, y, x)
    if not full.any():
        return cells
    from scipy import ndimage  # here: a third of a second that few need

    groups, count = cast("Any", ndimage).label(full, _AROUND)
    group, places = groups[full], np.argwhere(full)
    sizes = sum(_shadows(group, np.delete(places, axis, 1), count) for axis in range(3))
    wanted = groups == 1 + int(np.argmax(sizes))
    return replace(cells, free=distances_to_full(~wanted))


def _shadows(group: IntArray, places: IntArray, count: int) -> IntArray:
    """(count,) how many different places (n, 2) there are of each group 1 to count."""
    width = 1 + places.max(axis=0)
    index = (group * width[0] + places[:, 0]) * width[1] + places[:, 1]
    return np.bincount(np.unique(index) // (width[0] * width[1]), minlength=count + 1)[1:]
