"""Reading Wavefront .obj: vertices, `f` faces and `l` polylines; all else is passed over."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from harnack.files.file_format import (
    Contents,
    Element,
    Place,
    as_integer,
    as_number,
    check_element_count,
    excerpt,
    text_lines,
)


def read_obj(path: Path, data: bytes) -> Contents:
    """Vertices, faces and polylines of an .obj file.

    Indices may be negative (counted back from the last vertex so far) and carry texture and
    normal indices after slashes, which are not read.

    Raises:
        FileFormatError: a malformed statement, an index out of range.
    """
    vertices: list[tuple[float, float, float]] = []
    elements: dict[bytes, list[Element]] = {b"f": [], b"l": []}
    count = 0
    for number, line in _statements(text_lines(path, data)):
        words = line.split(b"#", 1)[0].split()
        if not words:
            continue
        keyword, rest = words[0], words[1:]
        place = Place(path, f"line {number}")
        count += 1
        check_element_count(place, count)
        if keyword == b"v":
            vertices.append(_vertex(rest, place))
        elif keyword in elements:
            indices = tuple(_index(word, len(vertices), place) for word in rest)
            least = 3 if keyword == b"f" else 2
            if len(indices) < least:
                raise place.error(f"{excerpt(keyword)} needs at least {least} vertices")
            elements[keyword].append(Element(indices, place))
        elif not keyword.replace(b"_", b"").isalnum():
            raise place.error(f"{excerpt(keyword)} is no .obj statement")
    found = Contents(
        path,
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        tuple(elements[b"f"]),
        tuple(elements[b"l"]),
    )
    _check_range(found)
    return found


def _statements(lines: list[bytes]) -> Iterator[tuple[int, bytes]]:
    """Numbered statements; a backslash at the end of a line continues it on the next."""
    begun: list[bytes] = []
    first = 1
    for number, line in enumerate(lines, 1):
        if not begun:
            first = number
        if line.endswith(b"\\"):
            begun.append(line[:-1])
            continue
        yield first, b" ".join([*begun, line])
        begun = []
    if begun:
        yield first, b" ".join(begun)


def _vertex(words: list[bytes], place: Place) -> tuple[float, float, float]:
    if len(words) < 3:
        raise place.error(f"a vertex needs three coordinates, not {len(words)}")
    x, y, z = (as_number(word, place) for word in words[:3])
    return x, y, z


def _index(word: bytes, count: int, place: Place) -> int:
    """Index from 0; a positive one may point to a vertex that comes later in the file."""
    value = as_integer(word.split(b"/", 1)[0], place)
    if value == 0:
        raise place.error("vertices are counted from 1, there is no vertex 0")
    if value < -count:
        raise place.error(f"vertex {value} is out of range: {count} vertices precede it")
    return value - 1 if value > 0 else count + value


def _check_range(found: Contents) -> None:
    count = len(found.vertices)
    for element in (*found.faces, *found.polylines):
        largest = max(element.indices)
        if largest >= count:
            raise element.place.error(
                f"vertex {largest + 1} is out of range: the file has {count} vertices"
            )
