"""Readers of curves, meshes, clouds, blobs and molecules, and atomic writing of files."""

from __future__ import annotations

from harnack.files import outline as outline
from harnack.files.file_geometry import FileFormatError, write_atomically
from harnack.files.geometry_files import (
    LoadedCloud,
    LoadedCurves,
    LoadedMesh,
    LoadedPolygons,
    read_geometry,
    read_loops,
)
from harnack.files.molecules import Atoms, read_molecule
from harnack.files.text_formats import Metaballs

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
