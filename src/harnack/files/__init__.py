"""Curves, meshes and clouds from files, and files that are never half written."""

from __future__ import annotations

from harnack.files.file_format import FileFormatError
from harnack.files.loops import read_loops
from harnack.files.surfaces import ClosedCurves, Cloud, Mesh, read_surface
from harnack.files.writing import write_atomically

__all__ = [
    "ClosedCurves",
    "Cloud",
    "FileFormatError",
    "Mesh",
    "read_loops",
    "read_surface",
    "write_atomically",
]
