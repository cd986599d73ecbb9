"""Writing triangle meshes: STL, PLY, OBJ, GLB and 3MF, by trimesh."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING

from harnack.files.file_geometry import check_writable, write_atomically
from harnack.files.three_mf import REQUIRED_PACKAGES

if TYPE_CHECKING:
    import trimesh

__all__ = ["MESH_FILES", "check_mesh_path", "write_mesh"]

MESH_FILES = (".stl", ".ply", ".obj", ".glb", ".3mf")
"""Endings of the files that meshes are written to."""


def check_mesh_path(path: str | os.PathLike[str]) -> Path:
    """The path of a mesh to be written, with every check that is possible before the mesh is
    computed.

    Raises:
        ValueError: an extension that is none of a mesh.
        ImportError: a format that needs packages which are not installed.
        OSError: as `check_writable`.
    """
    target = Path(path)
    if target.suffix.lower() not in MESH_FILES:
        raise ValueError(f"{target} has no extension of a mesh: name it {', '.join(MESH_FILES)}")
    if target.suffix.lower() == ".3mf":
        missing = [name for name in REQUIRED_PACKAGES if importlib.util.find_spec(name) is None]
        if missing:
            raise ImportError(
                f"{target}: 3MF needs {' and '.join(missing)}: pip install 'harnack[3mf]', or name "
                "the file .stl"
            )
    check_writable(target)
    return target


def write_mesh(mesh: trimesh.Trimesh, path: str | os.PathLike[str]) -> None:
    """Write a mesh in the format that the name ends in; if that fails no file is left.

    Closed meshes are closed in the file as well: see `ClosedMesh`.

    3MF has millimeters as its unit, which is written there; the other formats have none.

    Raises:
        ValueError, ImportError, OSError: as `check_mesh_path`.
        MeshingError: as `ClosedMesh.export`.
    """
    from harnack.meshing.closed_mesh import ClosedMesh

    target = check_mesh_path(path)
    kind = target.suffix.lower()[1:]
    plain = ClosedMesh.of(mesh)
    if kind == "3mf":
        plain.units = "millimeters"
    with write_atomically(target) as partial:
        plain.export(partial, file_type=kind)
