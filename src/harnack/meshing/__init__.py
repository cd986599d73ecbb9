"""Triangle meshes of level sets."""

from harnack.meshing.checks import MeshingError
from harnack.meshing.mesh import mesh
from harnack.meshing.repair import repair

__all__ = ["MeshingError", "mesh", "repair"]
