"""The names of the package, and where they are."""

from . import outline as outline
from .file_geometry import FileFormatError, write_atomically
from .geometry_files import (
    LoadedCloud,
    LoadedCurves,
    LoadedMesh,
    LoadedPolygons,
    read_geometry,
    read_loops,
)
from .molecules import Atoms, read_molecule
from .text_formats import Metaballs

__all__ = [
    "Atoms",
    "FileFormatError",
    "LoadedCloud",
    "LoadedCurves",
    "LoadedMesh",
    "LoadedPolygons",
    "Metaballs",
    "outline",
    "read_geometry",
    "read_loops",
    "read_molecule",
    "write_atomically",
]
