"""Cells that may hold a level set, found by leaving out those that are proved empty."""

from harnack.cells.octree import Cells, Clearance, carve

__all__ = ["Cells", "Clearance", "carve"]
