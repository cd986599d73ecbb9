"""Level sets of real-valued functions in the tetrahedra of a regular lattice."""

from harnack.meshing.lattice.cells import Lattice
from harnack.meshing.lattice.estimates import check_size
from harnack.meshing.lattice.missed import MissedError
from harnack.meshing.lattice.surface import Surface, closed_surface, open_surface

__all__ = ["Lattice", "MissedError", "Surface", "check_size", "closed_surface", "open_surface"]
