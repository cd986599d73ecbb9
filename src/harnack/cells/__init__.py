"""Cells that may hold a level set, found by leaving out those that are proved empty."""

from harnack.cells.free_cells import FreeCells, PreparedFreeCells, free_cells
from harnack.cells.octree import (
    Cells,
    Clearance,
    Octree,
    carve,
    octree,
    union,
    wrapped_points,
)

__all__ = [
    "Cells",
    "Clearance",
    "FreeCells",
    "Octree",
    "PreparedFreeCells",
    "carve",
    "free_cells",
    "octree",
    "union",
    "wrapped_points",
]
