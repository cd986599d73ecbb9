"""Writes triangle meshes to STL, PLY, OBJ, GLB and 3MF files, by trimesh."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from harnack.files.file_geometry import check_writable, write_atomically
from harnack.files.three_mf import missing_packages

if TYPE_CHECKING:
    import trimesh

__all__ = ["MESH_FILES", "check_mesh_path", "write_mesh"]

MESH_FILES = (".stl", ".ply", ".obj", ".glb", ".3mf")
"""Endings of the files that meshes are written to."""


def check_mesh_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of a mesh file to be written. Everything that can be checked before the mesh
    is computed is checked here.

    Raises:
        ValueError: the extension is not that of a mesh format.
        ImportError: the format needs packages that are not installed.
        OSError: the file cannot be written there.
    """
    target = Path(path)
    if target.suffix.lower() not in MESH_FILES:
        raise ValueError(f"{target} has no extension of a mesh: name it {', '.join(MESH_FILES)}")
    if target.suffix.lower() == ".3mf" and (missing := missing_packages()):
        raise ImportError(f"{target}: {missing}, or name the file .stl")
    check_writable(target)
    return target


def write_mesh(mesh: trimesh.Trimesh, path: str | os.PathLike[str]) -> None:
    """Write a mesh in the format of the path's extension. If writing fails, no file is left.

    A closed mesh is still closed after rounding to the file's precision: see `ClosedMesh`. A 3MF
    file says that its unit is the millimeter; the other formats have no unit.

    Raises:
        ValueError, ImportError, OSError: the path is refused by `check_mesh_path`.
        MeshingError: the mesh cannot be written as a closed one.
    """
    from harnack.meshing.closed_export import ClosedMesh

    target = check_mesh_path(path)
    kind = target.suffix.lower()[1:]
    plain = ClosedMesh.of(mesh)
    if kind == "3mf":
        plain.units = "millimeters"
    with write_atomically(target) as partial:
        plain.export(partial, file_type=kind)
