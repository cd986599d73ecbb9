"""Groups of cells that are separated by cells proved empty, and the largest of them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.cells.uniform_grid import distances_to_full

if TYPE_CHECKING:
    from harnack.backend import IntArray
    from harnack.cells.occupied import OccupiedCells

__all__ = ["largest_component"]

# Cells that share a face, an edge or a corner are neighbours.
_AROUND = np.ones((3, 3, 3), np.bool_)


def largest_component(cells: OccupiedCells) -> OccupiedCells:
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
    a corner, which is to be neighbours. So it lies in the cells of one group.

    Proof that rays may jump across the other groups, with the margin that `UniformGrid.run` goes
    beyond the cells that it jumps across. A neighbour of a cell of another group belongs to that
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
