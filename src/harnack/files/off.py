"""Reading .off files: vertices and polygons as text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from harnack.files.file_format import Contents, Element, Place, as_integer, excerpt
from harnack.files.surface_parts import Parts, Polygons, parts_of_contents
from harnack.files.text_tables import Lines, content_lines, quick_table, read_numbers


def read_off(path: Path, data: bytes) -> Parts:
    """Vertices and faces of an .off file. Colors, normals and textures are passed over.

    Raises:
        FileFormatError: no .off file of points in space, truncated, malformed, an index out of
            range, a coordinate that is not finite.
    """
    count, faces_count, lines = _header(path, content_lines(path, data))
    if len(lines) < count + faces_count:
        raise Place(path).error(
            f"its header promises {count:,} vertices and {faces_count:,} faces, but "
            f"{len(lines):,} lines follow: the file is truncated"
        )
    if not count:
        raise Place(path).error("it holds no vertices")
    vertices = read_numbers(lines[:count], 3)
    rows = lines[count : count + faces_count]
    table = quick_table(rows.text)
    if table is not None and table.shape[1] >= 4:
        k = int(table[0, 0]) if 3 <= table[0, 0] < table.shape[1] else 0
        corners = table[:, 1 : k + 1]
        regular = k and (table[:, 0] == k).all() and (corners == np.rint(corners)).all()
        if regular and corners.min() >= 0 and corners.max() < count:
            numbers = np.arange(faces_count, dtype=np.int64)
            return Parts(vertices, None, (Polygons(numbers, corners.astype(np.int64)),))
    faces = tuple(_face(rows, k, count) for k in range(faces_count))
    return parts_of_contents(Contents(path, vertices, faces, ()))


def _header(path: Path, lines: Lines) -> tuple[int, int, Lines]:
    """Numbers of vertices and faces, and the lines that follow."""
    match = (
        re.match(rb"(ST)?(C)?(N)?(4)?(n)?OFF(?!\S)\s*(.*)", lines.text[0]) if len(lines) else None
    )
    if match is None:
        raise Place(path).error("this is no .off file: it does not begin with 'OFF'")
    if match[4] or match[5]:
        raise Place(path).error("its vertices have other than three coordinates")
    rest = match[6]
    if rest.upper().startswith(b"BINARY"):
        raise Place(path).error("binary .off files are not read: save it as text, or as .ply")
    at = 0 if rest else 1
    if at == len(lines):
        raise Place(path).error("the file ends before the numbers of vertices and faces")
    words = (rest or lines.text[1]).split()
    if len(words) < 2:
        raise lines.place(at).error("numbers of vertices and faces are expected here")
    counts = [as_integer(word, lines.place(at)) for word in words[:2]]
    if min(counts) < 0:
        raise lines.place(at).error("numbers of vertices and faces cannot be negative")
    return counts[0], counts[1], lines[at + 1 :]


def _face(rows: Lines, k: int, count: int) -> Element:
    words, place = rows.text[k].split(), rows.place(k)
    size = as_integer(words[0], place)
    if not 1 <= size < len(words):
        raise place.error(f"a face of {excerpt(words[0])} vertices does not fit on this line")
    indices = tuple(as_integer(word, place) for word in words[1 : size + 1])
    for index in indices:
        if not 0 <= index < count:
            raise place.error(f"vertex {index} is out of range: the file has {count:,} vertices")
    return Element(indices, place)
