"""The names of the package, and where they are."""

from .mesh_pipeline import mesh
from .meshing_errors import MeshingError
from .print_checks import PrintCheck, PrintProblem, check_print
from .repair_stages import repair
from .thickness import WallThickness, wall_thickness

__all__ = [
    "MeshingError",
    "PrintCheck",
    "PrintProblem",
    "WallThickness",
    "check_print",
    "mesh",
    "repair",
    "wall_thickness",
]
