"""Triangle meshes of level sets."""

from harnack.meshing.mesh_pipeline import mesh
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.print_checks import PrintCheck, PrintProblem, check_print
from harnack.meshing.repair_stages import repair
from harnack.meshing.thickness import WallThickness, wall_thickness

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
