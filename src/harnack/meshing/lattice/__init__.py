"""Level sets of real-valued functions in the tetrahedra of a regular lattice."""

from harnack.meshing.lattice.cells import Lattice
from harnack.meshing.lattice.surface import (
    MissedError,
    Surface,
    check_size,
    closed_surface,
    open_surface,
)

__all__ = ["Lattice", "MissedError", "Surface", "check_size", "closed_surface", "open_surface"]
