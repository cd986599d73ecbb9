"""Reading Stanford .ply, ascii and binary: vertices, faces and edges; all else is passed over."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harnack.files.file_format import (
    Contents,
    Element,
    Place,
    check_element_count,
    excerpt,
    text_lines,
)
from harnack.geometry.convex_volume import FloatArray

# PLY name of a type -> its code in `struct`
_CODES = {
    b"char": "b", b"int8": "b", b"uchar": "B", b"uint8": "B",
    b"short": "h", b"int16": "h", b"ushort": "H", b"uint16": "H",
    b"int": "i", b"int32": "i", b"uint": "I", b"uint32": "I",
    b"float": "f", b"float32": "f", b"double": "d", b"float64": "d",
}  # fmt: skip
_BYTE_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_MAX_HEADER = 1 << 16

Row = dict[str, Any]


@dataclass(frozen=True)
class Property:
    """One column. code: type of the value, length_code: type of the length if it is a list."""

    name: str
    code: str
    length_code: str | None = None


@dataclass(frozen=True)
class Section:
    """An element of the header: its name, how many rows follow, and their columns."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """byte_order: "<" or ">", "" for ascii. size, lines: what comes before the first row."""

    byte_order: str
    sections: tuple[Section, ...]
    size: int
    lines: int


def read_ply(path: Path, data: bytes) -> Contents:
    """Vertices, faces and edges (as polylines of two vertices) of a .ply file.

    Raises:
        FileFormatError: a malformed header, fewer data than it declares, an index out of range.
    """
    header = read_header(path, data)
    check_element_count(Place(path), _promised(header, len(data)))
    body = data[header.size :]
    rows = _binary_rows(path, body, header) if header.byte_order else _text_rows(path, body, header)
    vertices: list[tuple[float, float, float]] = []
    elements: dict[str, list[Element]] = {"face": [], "edge": []}
    for section, number, row in rows:
        place = Place(path, f"{section.name} {number}")
        try:
            if section.name == "vertex":
                vertices.append((float(row["x"]), float(row["y"]), float(row["z"])))
            elif section.name in elements:
                elements[section.name].append(Element(_indices(section.name, row, place), place))
        except KeyError as missing:
            raise place.error(f"this element needs a property {missing}") from None
        except TypeError:
            raise place.error("a list where one number is expected, or the reverse") from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    _check(path, points, elements)
    return Contents(path, points, tuple(elements["face"]), tuple(elements["edge"]))


def _promised(header: Header, size: int) -> int:
    """How many rows a header declares, of those that a file of this size has room for."""
    return sum(min(section.count, size) for section in header.sections)


def _indices(name: str, row: Row, place: Place) -> tuple[int, ...]:
    if name == "edge":
        indices: tuple[Any, ...] = (row["vertex1"], row["vertex2"])
    else:
        indices = tuple(row["vertex_index" if "vertex_index" in row else "vertex_indices"])
    for index in indices:
        if not isinstance(index, int):
            raise place.error(f"indices must be integers, not {index!r}")
    return indices


def _check(path: Path, points: FloatArray, elements: dict[str, list[Element]]) -> None:
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise Place(path, f"vertex {bad[0]}").error("coordinates must be finite")
    for element in (*elements["face"], *elements["edge"]):
        for index in element.indices:
            if not 0 <= index < len(points):
                raise element.place.error(
                    f"vertex {index} is out of range: the file has {len(points)} vertices"
                )


def read_header(path: Path, data: bytes) -> Header:
    """What the header of a .ply file declares.

    Raises:
        FileFormatError: it is malformed, or not the header of a .ply file.
    """
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith((b"ply\n", b"ply\r")) or end < 0:
        raise Place(path).error("this is no .ply file: a header from 'ply' to 'end_header' lacks")
    newline = data.find(b"\n", end)
    size = newline + 1 if newline >= 0 else len(data)
    byte_order: str | None = None
    sections: list[Section] = []
    for number, line in enumerate(data[:end].splitlines()[1:], 2):
        place = Place(path, f"line {number}")
        words = line.split()
        if not words or words[0] in (b"comment", b"obj_info"):
            continue
        if words[0] == b"format" and len(words) == 3 and words[1] in _BYTE_ORDERS:
            byte_order = _BYTE_ORDERS[words[1]]
        elif words[0] == b"element" and len(words) == 3 and words[2].isdigit():
            name = words[1].decode("ascii", "backslashreplace")
            sections.append(Section(name, _count(words[2], place), ()))
        elif words[0] == b"property" and sections:
            last = sections[-1]
            columns = (*last.properties, _property(words, last, place))
            sections[-1] = Section(last.name, last.count, columns)
        else:
            raise place.error(f"{excerpt(line)} is no statement of a .ply header")
    if byte_order is None:
        raise Place(path).error("the header names no format")
    for section in sections:
        if section.count and not section.properties:
            raise Place(path).error(f"element {section.name!r} has no properties")
    return Header(byte_order, tuple(sections), size, len(data[:size].splitlines()))


def _count(word: bytes, place: Place) -> int:
    if len(word) > 18:
        raise place.error(f"{excerpt(word)} is too large a count")
    return int(word)


def _property(words: list[bytes], section: Section, place: Place) -> Property:
    types = words[2:4] if words[1:2] == [b"list"] else words[1:2]
    if len(words) != (5 if len(types) == 2 else 3) or any(t not in _CODES for t in types):
        raise place.error("a property is 'property TYPE NAME' or 'property list TYPE TYPE NAME'")
    name = words[-1].decode("ascii", "backslashreplace")
    if any(name == other.name for other in section.properties):
        raise place.error(f"property {name!r} is declared twice")
    codes = [_CODES[t] for t in types]
    if len(codes) == 2 and codes[0] in "fd":
        raise place.error("the length of a list must be an integer")
    return Property(name, codes[-1], codes[0] if len(codes) == 2 else None)


def _binary_rows(path: Path, body: bytes, header: Header) -> Iterator[tuple[Section, int, Row]]:
    offset = 0
    for section in header.sections:
        fixed = "".join(p.length_code or p.code for p in section.properties)
        least = struct.calcsize(header.byte_order + fixed)
        if section.count * least > len(body) - offset:
            raise _too_short(path, section)
        is_simple = not any(p.length_code for p in section.properties)
        reader = struct.Struct(header.byte_order + fixed)
        names = [p.name for p in section.properties]
        for number in range(section.count):
            if is_simple:
                row: Row = dict(zip(names, reader.unpack_from(body, offset), strict=True))
                offset += least
            else:
                try:
                    row, offset = _binary_row(body, offset, header.byte_order, section)
                except struct.error:
                    raise _too_short(path, section) from None
            yield section, number, row


def _binary_row(body: bytes, offset: int, order: str, section: Section) -> tuple[Row, int]:
    row: Row = {}
    for p in section.properties:
        if p.length_code is None:
            (row[p.name],) = struct.unpack_from(order + p.code, body, offset)
            offset += struct.calcsize(order + p.code)
            continue
        (length,) = struct.unpack_from(order + p.length_code, body, offset)
        offset += struct.calcsize(order + p.length_code)
        size = length * struct.calcsize(order + p.code)
        if not 0 <= size <= len(body) - offset:
            raise struct.error
        row[p.name] = struct.unpack_from(f"{order}{length}{p.code}", body, offset)
        offset += size
    return row, offset


def _too_short(path: Path, section: Section) -> Exception:
    return Place(path).error(
        f"the file ends before the {section.count:,} rows of element {section.name!r} that its "
        "header declares"
    )


def _text_rows(path: Path, body: bytes, header: Header) -> Iterator[tuple[Section, int, Row]]:
    lines = [line for line in text_lines(path, body, first=header.lines + 1) if line.strip()]
    next_line = 0
    for section in header.sections:
        if section.count > len(lines) - next_line:
            raise _too_short(path, section)
        for number in range(section.count):
            place = Place(path, f"{section.name} {number}")
            yield section, number, _text_row(lines[next_line].split(), section, place)
            next_line += 1


def _text_row(words: list[bytes], section: Section, place: Place) -> Row:
    row: Row = {}
    rest = iter(words)
    try:
        for p in section.properties:
            convert = float if p.code in "fd" else int
            if p.length_code is None:
                row[p.name] = convert(next(rest))
            else:
                length = int(next(rest))
                row[p.name] = tuple([convert(word) for word in _take(rest, length)])
    except StopIteration:
        raise place.error(f"{len(words)} numbers are too few") from None
    except ValueError as error:
        raise place.error(str(error)[:80]) from None
    if any(True for _ in rest):
        raise place.error(f"{len(words)} numbers are too many")
    return row


def _take(words: Iterator[bytes], count: int) -> list[bytes]:
    """The next `count` words; StopIteration if there are fewer, or count is negative."""
    found = [word for _, word in zip(range(count), words, strict=False)]
    if len(found) != count:
        raise StopIteration
    return found
