"""Groups of cells that are separated by cells proved empty, and the largest of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy import ndimage

from harnack.cells.uniform_grid import distances_to_full

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.cells.occupied import OccupiedCells

__all__ = ["largest_component"]

# Cells that share a face, an edge or a corner are neighbours.
_AROUND = np.ones((3, 3, 3), np.bool_)

_label = cast("Any", ndimage).label  # untyped


def largest_component(
    cells: OccupiedCells, size: Callable[[FloatArray], FloatArray]
) -> OccupiedCells:
    """The grid in which only the cells of one group are not empty: that of the largest size.

    size: for centres of cells (n, 3), how much of the set is in each (n,).

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
    groups, _ = _label(full, _AROUND)
    places = np.argwhere(full)[:, ::-1]
    sizes = np.bincount(groups[full], size(cells.origin + cells.cell * (places + 0.5)))
    wanted = groups == 1 + int(np.argmax(sizes[1:]))
    return replace(cells, free=distances_to_full(~wanted))
