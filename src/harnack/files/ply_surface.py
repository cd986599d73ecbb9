"""Surfaces and point clouds in .ply files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from harnack.files.ply import Header, Section, read_header, read_ply
from harnack.files.surface_parts import Parts, Polygons, parts_of_contents
from harnack.files.text_tables import quick_table
from harnack.geometry.convex_volume import FloatArray
from harnack.geometry.meshes import IntArray


class _IrregularError(Exception):
    """A file that is not a plain table, or has an error: left to the reader row by row."""


def read_ply_surface(path: Path, data: bytes) -> Parts:
    """Vertices, faces, and normals where all vertices have nx, ny, nz.

    A plain file, in which no list but those of the faces occurs and all faces have as many corners,
    is read in a hundredth of the time `read_ply` takes; all others, and those with errors, are left
    to it, which reads no normals.

    Raises:
        FileFormatError: as `read_ply`.
    """
    header = read_header(path, data)
    try:
        return _read_plain(header, data[header.size :])
    except _IrregularError:
        return parts_of_contents(read_ply(path, data))


def _read_plain(header: Header, body: bytes) -> Parts:
    vertices: FloatArray | None = None
    normals: FloatArray | None = None
    polygons: tuple[Polygons, ...] = ()
    has_lines = False
    rows = [line for line in body.splitlines() if line.strip()] if not header.byte_order else []
    for section in header.sections:
        names = [p.name for p in section.properties]
        if header.byte_order:
            columns, size = _binary_columns(section, header.byte_order, body)
            body = body[size:]
        else:
            columns = _text_columns(section, rows[: section.count])
            rows = rows[section.count :]
        if section.name == "vertex" and section.count:
            vertices = _stack(columns, names, ("x", "y", "z"))
            if {"nx", "ny", "nz"} <= set(names):
                normals = _stack(columns, names, ("nx", "ny", "nz"))
        elif section.name == "face" and section.count:
            polygons = (_faces(columns, names),)
        has_lines |= section.name == "edge" and section.count > 0
    if vertices is None or not np.isfinite(vertices).all():
        raise _IrregularError
    for group in polygons:
        if group.corners.min() < 0 or group.corners.max() >= len(vertices):
            raise _IrregularError
    return Parts(vertices, normals, polygons, has_lines)


def _binary_columns(
    section: Section, order: str, body: bytes
) -> tuple[list[npt.NDArray[np.generic]], int]:
    """The columns of a section, that of a list (m, length), and how many bytes it takes."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    lengths: dict[str, int] = {}
    offset = 0
    for k, p in enumerate(section.properties):
        if p.length_code is not None:
            kind = np.dtype(order + p.length_code)
            first = body[offset : offset + kind.itemsize]
            if len(first) < kind.itemsize:
                raise _IrregularError
            length = int(np.frombuffer(first, kind)[0])
            if not 0 < length < 1024:
                raise _IrregularError
            lengths[f"length{k}"] = length
            fields += [(f"length{k}", kind.str), (str(k), order + p.code, (length,))]
            offset += kind.itemsize + length * np.dtype(p.code).itemsize
        else:
            fields.append((str(k), order + p.code))
            offset += np.dtype(p.code).itemsize
    size = section.count * offset
    if size > len(body):
        raise _IrregularError
    table = np.frombuffer(body, np.dtype(fields), section.count)
    for name, length in lengths.items():
        if (table[name] != length).any():
            raise _IrregularError
    return [table[str(k)] for k in range(len(section.properties))], size


def _text_columns(section: Section, rows: list[bytes]) -> list[npt.NDArray[np.generic]]:
    if not section.count:
        return []
    table = quick_table(rows)
    if table is None or len(table) != section.count:
        raise _IrregularError
    columns: list[npt.NDArray[np.generic]] = []
    at = 0
    for p in section.properties:
        length = 1
        if p.length_code is not None:
            length = int(table[0, at]) if at < table.shape[1] else 0
            if length < 1 or (table[:, at] != length).any():
                raise _IrregularError
            at += 1
        column = table[:, at : at + length]
        if p.code not in "fd":
            if (column != np.rint(column)).any():
                raise _IrregularError
            column = column.astype(np.int64)
        columns.append(column if p.length_code is not None else column[:, 0])
        at += length
    if at != table.shape[1]:
        raise _IrregularError
    return columns


def _stack(
    columns: list[npt.NDArray[np.generic]], names: list[str], wanted: tuple[str, ...]
) -> FloatArray:
    """The wanted columns side by side. A list or no column of that name is irregular."""
    if not set(wanted) <= set(names) or any(columns[names.index(w)].ndim != 1 for w in wanted):
        raise _IrregularError
    return np.stack([columns[names.index(w)].astype(np.float64) for w in wanted], axis=1)


def _faces(columns: list[npt.NDArray[np.generic]], names: list[str]) -> Polygons:
    name = "vertex_index" if "vertex_index" in names else "vertex_indices"
    column = columns[names.index(name)] if name in names else None
    if column is None or column.ndim != 2 or column.dtype.kind not in "iu" or column.shape[1] < 3:
        raise _IrregularError
    corners: IntArray = column.astype(np.int64)
    return Polygons(np.arange(len(corners), dtype=np.int64), corners)
