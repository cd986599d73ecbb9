"""Cells that may hold a level set, found by leaving out those that are proved empty."""

from harnack.cells.components import OccupiedCells, largest_connected_component
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
    "OccupiedCells",
    "Octree",
    "carve",
    "largest_connected_component",
    "octree",
    "union",
    "wrapped_points",
]
