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
    lines = content_lines(path, data)
    if b"\\" in data:
        lines = _joined(lines)
    found: dict[bytes, tuple[list[bytes], list[int]]]
    found = {keyword: ([], []) for keyword in (b"v", b"vn", b"f", b"l")}
    for number, line in zip(lines.places.numbers, lines.text, strict=True):
        keyword = line.split(None, 1)[0]
        if listed := found.get(keyword):
            listed[0].append(line[len(keyword) :])
            listed[1].append(number)
        elif not keyword.replace(b"_", b"").isalnum():
            raise Place(path, f"line {number}").error(f"{excerpt(keyword)} is no .obj statement")
    rows = {k: Lines(text, Places(path, "line", numbers)) for k, (text, numbers) in found.items()}
    vertices = read_table(rows[b"v"], 3, few="a vertex needs three coordinates, not {}")
    faces = _polygons(rows[b"f"], "'f' needs at least 3 vertices", 3, rows[b"v"])
    polylines = _polygons(rows[b"l"], "'l' needs at least 2 vertices", 2, rows[b"v"])
    if differ_in_size(faces):
        check_element_count(Place(path), len(lines))
    normals = None
    if not (len(faces) or len(polylines)) and 0 < len(rows[b"vn"]) == len(vertices):
        normals = read_table(rows[b"vn"], 3)
    return Contents(path, vertices, normals, faces, polylines)


def _joined(lines: Lines) -> Lines:
    """A backslash at the end of a line continues it on the next."""
    pieces: list[list[bytes]] = []
    numbers: list[int] = []
    continued = 0  # the number of the line that continues the last
    for line, number in zip(lines.text, lines.places.numbers, strict=True):
        if number != continued:
            pieces.append([])
            numbers.append(number)
        pieces[-1].append(line.removesuffix(b"\\"))
        continued = number + 1 if line.endswith(b"\\") else 0
    joined = [(b" ".join(piece).strip(), k) for piece, k in zip(pieces, numbers, strict=True)]
    joined = [(line, k) for line, k in joined if line]
    return Lines([x for x, _ in joined], Places(lines.places.path, "line", [k for _, k in joined]))


def _polygons(lines: Lines, few: str, least: int, vertices: Lines) -> Polygons:
    """Faces or polylines, counted from 0. few: the error of one with fewer corners than `least`."""
    # Texture and normal indices stand behind slashes.
    text = [re.sub(rb"(?<=\S)/\S*", b"", line) if b"/" in line else line for line in lines.text]
    corners, sizes = read_integers(Lines(text, lines.places))
    if (short := np.flatnonzero(sizes < least)).size:
        raise lines.places[short[0]].error(few)
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
