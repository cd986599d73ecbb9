"""Curves, meshes and clouds from files, and files that are never half written."""

from __future__ import annotations

from harnack.files.loops import FileFormatError, read_loops, write_atomically
from harnack.files.surfaces import Cloud, Loops, Mesh, read_surface

__all__ = [
    "Cloud",
    "FileFormatError",
    "Loops",
    "Mesh",
    "read_loops",
    "read_surface",
    "write_atomically",
]
