"""Triangle meshes of level sets."""

from harnack.meshing.checks import MeshingError
from harnack.meshing.mesh import mesh

__all__ = ["MeshingError", "mesh"]
