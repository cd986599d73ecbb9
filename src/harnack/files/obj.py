"""Reading Wavefront .obj: vertices, normals, `f` faces and `l` polylines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from harnack.files.file_format import (
    Contents,
    Place,
    Places,
    Polygons,
    check_element_count,
    check_indices,
    differ_in_size,
)
from harnack.files.text_tables import Lines, content_lines, excerpt, read_integers, read_table


def read_obj(path: Path, data: bytes) -> Contents:
    """Vertices, faces and polylines of an .obj file, normals of a cloud if there is one a vertex.

    All other statements are passed over.

    Indices may be negative (counted back from the last vertex so far) and carry texture and
    normal indices after slashes, which are not read.

    Raises:
        FileFormatError: a malformed statement, an index out of range.
    """
    lines = _statements(content_lines(path, data))
    found: dict[bytes, list[int]] = {b"v": [], b"vn": [], b"f": [], b"l": []}
    for k, line in enumerate(lines.text):
        keyword = line.split(None, 1)[0]
        if keyword in found:
            found[keyword].append(k)
        elif not keyword.replace(b"_", b"").isalnum():
            raise lines.places[k].error(f"{excerpt(keyword)} is no .obj statement")
    rows = lines.chosen(found[b"v"])
    vertices = read_table(rows, 3, skip=1, few="a vertex needs three coordinates, not {}")
    faces = _polygons(lines.chosen(found[b"f"]), 3, rows)
    polylines = _polygons(lines.chosen(found[b"l"]), 2, rows)
    if differ_in_size(faces):
        check_element_count(Place(path), len(lines))
    normals = None
    if not (len(faces) or len(polylines)) and 0 < len(found[b"vn"]) == len(vertices):
        normals = read_table(lines.chosen(found[b"vn"]), 3, skip=1)
    return Contents(path, vertices, normals, faces, polylines)


def _statements(lines: Lines) -> Lines:
    """A backslash at the end of a line continues it on the next."""
    if not any(line.endswith(b"\\") for line in lines.text):
        return lines
    text: list[bytes] = []
    numbers: list[int] = []
    continued = 0  # the number of the line that continues the last
    for line, number in zip(lines.text, lines.places.numbers, strict=True):
        if number == continued:
            text[-1] += b" " + line.removesuffix(b"\\")
        else:
            text.append(line.removesuffix(b"\\"))
            numbers.append(number)
        continued = number + 1 if line.endswith(b"\\") else 0
    return Lines(text, Places(lines.places.path, "line", numbers))


def _polygons(lines: Lines, least: int, vertices: Lines) -> Polygons:
    """Faces or polylines, of so many corners at least, counted from 0."""
    # Texture and normal indices stand behind slashes.
    text = [re.sub(rb"(?<=\S)/\S*", b"", line) if b"/" in line else line for line in lines.text]
    corners = read_integers(Lines(text, lines.places), skip=1)
    sizes = lines.counts() - 1
    if (short := np.flatnonzero(sizes < least)).size:
        k = int(short[0])
        keyword = excerpt(lines.text[k].split()[0])
        raise lines.places[k].error(f"{keyword} needs at least {least} vertices")
    listed = Polygons(corners, sizes, lines.places)
    if (zero := np.flatnonzero(corners == 0)).size:
        raise listed.place_of(zero[0]).error("vertices are counted from 1, there is no vertex 0")
    # Negative ones are counted back from the statement.
    before = np.repeat(np.searchsorted(vertices.places.numbers, lines.places.numbers), sizes)
    if (low := np.flatnonzero(corners < -before)).size:
        raise listed.place_of(low[0]).error(
            f"vertex {corners[low[0]]} is out of range: {before[low[0]]} vertices precede it"
        )
    corners = np.where(corners > 0, corners - 1, corners + before)
    polygons = Polygons(corners, sizes, lines.places)
    check_indices(polygons, len(vertices), first=1)
    return polygons
