"""Surfaces and point clouds in Wavefront .obj files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from harnack.files.obj import read_obj
from harnack.files.surface_parts import Parts, Polygons, parts_of_contents
from harnack.files.text_tables import Lines, quick_table, read_numbers
from harnack.geometry.convex_volume import FloatArray

# Statements that neither add nor change vertices, faces or lines.
_PASSED_OVER = (b"#", b"vn ", b"vt ", b"g ", b"o ", b"s ", b"usemtl ", b"mtllib ")


def read_obj_surface(path: Path, data: bytes) -> Parts:
    """Vertices, faces and, for files of vertices alone, normals if there is one a vertex.

    A plain file, one like most, is read in a hundredth of the time `read_obj` takes; all others,
    and those with errors, are left to it.

    Raises:
        FileFormatError: as `read_obj`; a malformed normal.
    """
    lines = data.splitlines()
    parts = _read_plain(lines) or parts_of_contents(read_obj(path, data))
    if parts.polygons or parts.has_lines:
        return parts
    return Parts(parts.vertices, _normals(path, lines, len(parts.vertices)))


def _read_plain(lines: list[bytes]) -> Parts | None:
    """What a file holds in which every line is simple and every face has as many corners."""
    vertex_rows: list[bytes] = []
    face_rows: list[bytes] = []
    for line in lines:
        if line.startswith(b"v "):
            vertex_rows.append(line[2:])
        elif line.startswith(b"f "):
            face_rows.append(line[2:])
        elif line.strip() and not line.startswith(_PASSED_OVER):
            return None
        if line.endswith(b"\\"):
            return None
    vertices = quick_table(vertex_rows, 3)
    if vertices is None or not np.isfinite(vertices).all():
        return None
    if not face_rows:
        return Parts(vertices)
    # Texture and normal indices stand behind slashes.
    table = quick_table([re.sub(rb"/\S*", b"", row) if b"/" in row else row for row in face_rows])
    if table is None or table.shape[1] < 3 or not (table == np.rint(table)).all():
        return None
    if table.min() < 1 or table.max() > len(vertices):
        return None
    faces = table.astype(np.int64) - 1
    return Parts(vertices, None, (Polygons(np.arange(len(faces), dtype=np.int64), faces),))


def _normals(path: Path, lines: list[bytes], count: int) -> FloatArray | None:
    numbers = [k for k, line in enumerate(lines, 1) if line.startswith(b"vn ")]
    if not numbers or len(numbers) != count:
        return None
    rows = [lines[k - 1][3:].split(b"#", 1)[0] for k in numbers]
    return read_numbers(Lines(path, rows, numbers), 3)
