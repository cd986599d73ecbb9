"""Reading Wavefront .obj: vertices, normals, `f` faces and `l` polylines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import (
    Contents,
    Place,
    Places,
    Polygons,
    check_element_count,
    check_indices,
    differ_in_size,
)
from harnack.files.text_tables import (
    Lines,
    as_integer,
    content_lines,
    excerpt,
    read_integers,
    read_table,
)

# Statements by which there is more of the surface: free forms, old faces, other files.
_NOT_READ = (b"curv", b"curv2", b"surf", b"bzp", b"bsp", b"fo", b"call")


def read_obj(path: Path, data: bytes) -> Contents:
    """Vertices, faces and polylines of an .obj file, normals of a cloud if there is one a vertex.

    Points `p` choose vertices, and the normals of theirs. Statements of groups, materials and
    textures are passed over; those by which there is more of the surface are refused.

    Indices may be negative (counted back from the last vertex so far) and carry texture and
    normal indices after slashes, which are not read.

    Raises:
        FileFormatError: a malformed statement, an index out of range.
    """
    lines = content_lines(path, data)
    if b"\\" in data:
        lines = _joined(lines)
    found: dict[bytes, tuple[list[bytes], list[int]]]
    found = {keyword: ([], []) for keyword in (b"v", b"vn", b"f", b"l", b"p")}
    for number, line in zip(lines.places.numbers, lines.text, strict=True):
        keyword = line.split(None, 1)[0]
        if listed := found.get(keyword):
            listed[0].append(line[len(keyword) :])
            listed[1].append(number)
        elif keyword in _NOT_READ or keyword.lower() in found:
            raise Place(path, f"line {number}").error(
                f"the statement {excerpt(keyword)} is not read: save the surface as 'v' and 'f'"
            )
        elif keyword.isdigit() or not keyword.replace(b"_", b"").isalnum():
            raise Place(path, f"line {number}").error(f"{excerpt(keyword)} is no .obj statement")
    rows = {k: Lines(text, Places(path, "line", numbers)) for k, (text, numbers) in found.items()}
    vertices = read_table(rows[b"v"], 3, few="a vertex needs three coordinates, not {}")
    faces = _polygons(rows[b"f"], "'f' needs at least 3 vertices", 3, rows[b"v"])
    polylines = _polygons(rows[b"l"], "'l' needs at least 2 vertices", 2, rows[b"v"])
    if differ_in_size(faces):
        check_element_count(Place(path), len(lines))
    if len(faces) or len(polylines):
        return Contents(path, vertices, None, faces, polylines)
    normals = read_table(rows[b"vn"], 3) if len(rows[b"vn"]) else None
    if len(rows[b"p"]):
        return _points(path, vertices, normals, rows)
    if normals is not None and len(normals) != len(vertices):
        normals = None
    return Contents(path, vertices, normals, faces, polylines)


def _points(
    path: Path, vertices: FloatArray, normals: FloatArray | None, rows: dict[bytes, Lines]
) -> Contents:
    """The vertices that points name, with normals if all name one."""
    listed = _polygons(rows[b"p"], "'p' needs a vertex", 1, rows[b"v"])
    words = [word.split(b"/") for line in rows[b"p"].text for word in line.split()]
    named = [word[2] for word in words if len(word) == 3 and word[2]]
    if normals is None or not named:
        return Contents(path, vertices[listed.corners])
    own = [as_integer(word, rows[b"p"].places[0]) for word in named]
    if len(own) != len(words) or not all(1 <= k <= len(normals) for k in own):
        raise (
            rows[b"p"]
            .places[0]
            .error(f"points need normals from 1 to {len(normals):,} each, or none of them one")
        )
    return Contents(path, vertices[listed.corners], normals[np.array(own) - 1])


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
