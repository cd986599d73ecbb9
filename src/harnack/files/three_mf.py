"""Reading .3mf files, which slicers write, through trimesh. The result is triangles in
millimeters."""

from __future__ import annotations

import importlib.util
import warnings
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from harnack.files.file_geometry import (
    MAX_BYTES,
    FileFormatError,
    FileGeometry,
    FileLocation,
    FileLocations,
    check_finite,
    check_indices,
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
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene: Any = trimesh.load(BytesIO(data), file_type="3mf", force="scene", process=False)
            return _contents(place, scene)
    except FileFormatError:
        raise
    except Exception as error:  # trimesh raises any error for malformed files
        # The first line of the message or, if there is none, the error's type.
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise place.error(f"it is no sound 3MF file ({reason[0][:120]})") from None


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
    # The empty arrays are for a scene without nodes.
    vertices, faces, vertex_count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        corners = np.asarray(geometry.faces, np.int64)
        polygons = triangles_as_polygons(place.path, corners)
        check_indices(polygons, len(geometry.vertices))
        x = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror image: faces must be reversed
            corners = corners[:, ::-1]
        vertices.append(_UNITS[unit] * x)
        faces.append(corners + vertex_count)
        vertex_count += len(x)
    x, triangles = np.concatenate(vertices), np.concatenate(faces)
    check_finite(x, FileLocations(place.path, "vertex", range(len(x))))
    if not len(triangles):
        raise place.error("it holds no triangles")
    return FileGeometry(place.path, x, faces=triangles_as_polygons(place.path, triangles))
