"""Curves, meshes, clouds, blobs and molecules from files, and files that are never half written."""

from __future__ import annotations

from harnack.files import outline as outline
from harnack.files.file_geometry import FileFormatError, write_atomically
from harnack.files.geometry_files import (
    ClosedCurves,
    Cloud,
    Mesh,
    PolygonSurface,
    read_loops,
    read_surface,
)
from harnack.files.molecules import Atoms, read_molecule
from harnack.files.text_formats import Metaballs

__all__ = [
    "Atoms",
    "ClosedCurves",
    "Cloud",
    "FileFormatError",
    "Mesh",
    "Metaballs",
    "PolygonSurface",
    "outline",
    "read_loops",
    "read_molecule",
    "read_surface",
    "write_atomically",
]
