"""The cells of a grid that have small networks (`cell_networks`), on a backend: which network a
point has, and how far it is right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Backend, Index, Mask, Real, Vec3
    from harnack.enclosures.samples import Ray
    from harnack.tree.empty_space import EmptySpaceGrid, GridCell, OccupancyGrid

__all__ = ["NetworkGrid", "NetworkPlace"]


@dataclass(frozen=True)
class NetworkPlace:
    """The network of a point.

    network: its index: 0 is the whole network.
    radius: the length from the point up to which the network is right, in all directions or along
        a ray; infinite for the whole network.
    """

    network: Index
    radius: Real


@dataclass(frozen=True)
class NetworkGrid:
    """A grid whose occupied cells have small networks, which are right in the cells and in the
    margins around them.

    cells: the grid.
    networks: for each cell the index of its network; 0, the whole network, if it has none.
    """

    cells: EmptySpaceGrid
    networks: Index

    @classmethod
    def upload(cls, backend: Backend, grid: OccupancyGrid) -> NetworkGrid:
        """Upload a grid, of which occupied cells have the networks 1, 2, ... in their order."""
        is_occupied = grid.empty_distance == 0
        networks = np.where(is_occupied, np.cumsum(is_occupied), 0)
        return cls(grid.upload(backend), upload_integers(backend, networks))

    def place(self, p: Vec3) -> NetworkPlace:
        """The network at points, and the radius of a ball in which it is right."""
        cell = self.cells.cell(p)
        radius: Real = self.cells.backend.Float(dr.inf)
        for k in range(3):
            offset = cell.cell_coordinates[k] - cell.corner[k]
            radius = fmin(radius, fmin(offset, 1 - offset))
        radius = (radius + self.cells.usable_margin) * self.cells.cell_size
        return self._place(cell, self.cells.is_resolved(p, self.cells.cell_size), radius)

    def place_on_ray(self, path: Ray, t: Real, p: Vec3) -> NetworkPlace:
        """The network at the points p of rays with parameter t, and the length up to which the ray
        stays where it is right."""
        cell = self.cells.cell(p)
        length = cell.exit_distance(path.direction)
        is_resolved = self.cells.is_resolved(path.origin, t + self.cells.cell_size)
        return self._place(cell, is_resolved, length)

    def _place(self, cell: GridCell, is_resolved: Mask, radius: Real) -> NetworkPlace:
        """The network of a cell, unless coordinates are too coarse, or points so far outside of the
        cell that the network is not right there."""
        index = dr.gather(type(cell.index), self.networks, cell.index)
        index = dr.select(is_resolved & (radius > 0), index, 0)
        return NetworkPlace(index, dr.select(index > 0, fmax(radius, 0), dr.inf))
