"""Reading .3mf files, which slicers write, through trimesh. The result is triangles in
millimeters."""

from __future__ import annotations

import importlib.util
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import (
    MAX_BYTES,
    FileGeometry,
    FileLocation,
    FileLocations,
    check_finite,
    check_indices,
    errors_of_library,
    joined_meshes,
    placed_mesh,
    triangles_as_polygons,
)

__all__ = ["missing_packages", "read_3mf"]

# The length of each unit of the format in millimeters. The names are in the singular, as in the
# format; trimesh has the plural.
_UNITS = {
    "micron": 1e-3, "millimeter": 1.0, "centimeter": 10.0, "inch": 25.4, "foot": 304.8,
    "meter": 1000.0,
}  # fmt: skip


def missing_packages() -> str:
    """Return a text that names the packages without which trimesh cannot read and write 3MF, and
    how they are installed; "" if none is missing."""
    required = ("lxml", "networkx")
    missing = [name for name in required if importlib.util.find_spec(name) is None]
    return f"3MF needs {' and '.join(missing)}: pip install 'harnack[3mf]'" if missing else ""


def read_3mf(path: Path, data: bytes) -> FileGeometry:
    """Read all triangles in the bytes `data` of a .3mf file: the triangles of the parts in its
    build (the list of what is to be printed), at their positions there, in millimeters. Colors and
    settings are ignored, including the setting that a part is not to be printed.

    Raises:
        FileFormatError: the file is not an archive, is too large when unpacked, is malformed, or
            has no triangles; or Python packages that are needed to read it are missing.
    """
    import trimesh  # here, since it takes half a second

    place = FileLocation(path)
    if missing := missing_packages():
        raise place.error(missing)
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except zipfile.BadZipFile:
        raise place.error("this is no .3mf file: it is no zip archive") from None
    if size > MAX_BYTES:
        raise place.error(f"it has {size:,} bytes when unpacked: at most {MAX_BYTES:,} are read")
    with errors_of_library(place, "3MF"):
        scene: Any = trimesh.load(BytesIO(data), file_type="3mf", force="scene", process=False)
        return _contents(place, scene)


def _contents(place: FileLocation, scene: Any) -> FileGeometry:
    """Return the triangles of all nodes of a trimesh scene, in one coordinate system and in
    millimeters. place: the file, for error messages.

    Raises:
        FileFormatError: an unknown unit, an index out of range, numbers that are not finite, or no
            triangles.
    """
    unit = str(scene.units or "millimeter").lower().removesuffix("s")
    if unit not in _UNITS:
        raise place.error(f"its unit, {unit[:40]!r}, is none of {', '.join(_UNITS)}")
    meshes: list[tuple[FloatArray, IntArray]] = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        polygons = triangles_as_polygons(place.path, np.asarray(geometry.faces, np.int64))
        check_indices(polygons, len(geometry.vertices))
        positions, corners = placed_mesh(geometry, matrix)
        meshes.append((_UNITS[unit] * positions, corners))
    if not any(len(corners) for _, corners in meshes):
        raise place.error("it holds no triangles")
    joined = joined_meshes(place.path, meshes)
    check_finite(joined.vertices, FileLocations(place.path, "vertex", range(len(joined.vertices))))
    return joined
