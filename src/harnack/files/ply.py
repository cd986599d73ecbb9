"""Reading Stanford .ply files, text and binary: vertices, faces and edges. Other elements are
ignored. A .ply file is a header and rows. An "element" is a kind of row, such as "vertex", with the
number of its rows; its "properties" are the numbers, or lists of numbers, in each row. `data` are
the bytes of a file, and a `place` is a location in it, for error messages.

Each property is read in all rows of an element at once. A "position" says where a number is in the
file: in bytes for a binary file, in words (entries between blanks) for a text file. The position of
a property in a row follows from the properties before it, and the lengths of the lists among these.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import (
    NO_POLYGONS,
    FileFormatError,
    FileGeometry,
    FileLocation,
    FileLocations,
    PolygonList,
    check_element_count,
    check_finite,
    check_indices,
    have_mixed_sizes,
)
from harnack.files.point_fields import find_normals, find_positions, unused_notes
from harnack.files.text_tables import (
    TextLines,
    excerpt,
    parse_any_number,
    read_floats,
    split_content_lines,
)
from harnack.geometry.flat_lists import ranks_in_lists

# PLY name of a type -> its code in `struct`
_CODES = {
    b"char": "b", b"int8": "b", b"uchar": "B", b"uint8": "B",
    b"short": "h", b"int16": "h", b"ushort": "H", b"uint16": "H",
    b"int": "i", b"int32": "i", b"uint": "I", b"uint32": "I",
    b"float": "f", b"float32": "f", b"double": "d", b"float64": "d",
}  # fmt: skip
_BYTE_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_MAX_HEADER = 1 << 16
# Elements that hold faces in a form that is not read, or under another name.
_UNSUPPORTED_FACE_ELEMENTS = (
    "tristrips",
    "strips",
    "trifans",
    "faces",
    "polygon",
    "polygons",
    "triangle",
)
# What may follow the last row of a binary file.
_PADDING = b"\0 \t\r\n"


@dataclass(frozen=True)
class Property:
    """A property that the header of a .ply file declares: a number, or a list of numbers, in each
    row of an element.

    code: the type of the numbers, as a format character of the module `struct`.
    length_code: for a list, the type of its length; None for a single number.
    """

    name: str
    code: str
    length_code: str | None = None


@dataclass(frozen=True)
class PlyElement:
    """An element that the header of a .ply file declares: its name, the number of rows that follow,
    and the properties of a row."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class PlyHeader:
    """The header of a .ply file.

    byte_order: "<" or ">" for a binary file, "" for text.
    size, lines: the number of bytes and the number of lines before the first row.
    """

    byte_order: str
    elements: tuple[PlyElement, ...]
    size: int
    lines: int

    def declared_rows(self, size: int) -> int:
        """Return the number of rows that the header declares for all elements together. The number
        for a single element counts as at most `size`, the file's size in bytes, as a file cannot
        hold more."""
        return sum(min(section.count, size) for section in self.elements)


class BinaryValues:
    """The bytes of a binary .ply file, from which numbers are read at byte positions."""

    def __init__(self, data: bytes, byte_order: str) -> None:
        self.size = len(data)
        self.data = data
        self.byte_order = byte_order

    def read(self, where: IntArray, code: str) -> npt.NDArray[Any]:
        """Return the numbers that are stored at the byte positions `where` (n,).

        code: the type of the numbers, a format character of the module `struct`.

        A position outside of the file gives an arbitrary number. Callers detect such positions,
        since the rows that contain them end after the file's end.
        """
        kind = np.dtype(self.byte_order + code)
        last_position = self.size - kind.itemsize  # the header alone is longer than a number
        # A view of the data as the numbers that begin at each byte, so that one index reads them
        # all.
        all_numbers = np.ndarray((last_position + 1,), kind, self.data, strides=(1,))
        return all_numbers[np.clip(where, 0, last_position)].astype(kind.newbyteorder("="))

    def width(self, code: str) -> int:
        """Return the number of bytes of a number of the type `code`, a format character of
        `struct`."""
        return struct.calcsize("=" + code)


class TextValues:
    """The numbers of all rows of an element in a text file, read at positions. A position is
    counted in words (entries between blanks) from the first row.

    counts: (n,) the number of words of each row.
    """

    def __init__(self, rows: TextLines) -> None:
        numbers, self.counts = read_floats(rows, convert=parse_any_number)
        self._numbers = np.append(numbers, 0.0)
        self.size = len(numbers)

    def read(self, where: IntArray, code: str) -> npt.NDArray[Any]:
        """Return the numbers at the word positions `where` (n,). They are returned as integers if
        `code` (a format character of `struct`) is an integer type and all of them are whole. A
        position outside of the rows gives an arbitrary number."""
        values = self._numbers[np.clip(where, 0, self.size)]
        if code in "fd" or (values != np.rint(values)).any():
            return values
        # Larger numbers would overflow; as indices or lengths they are out of range anyway.
        return np.clip(values, -(2.0**53), 2.0**53).astype(np.int64)

    def width(self, code: str) -> int:
        """Return how many positions a number takes: always 1, as positions in a text file are
        counted in words. (The same method of `BinaryValues` returns the number of bytes of the type
        `code`.)"""
        return 1


Values: TypeAlias = BinaryValues | TextValues


@dataclass(frozen=True, eq=False)
class PropertyColumn:
    """A property of an element in all n rows. In row k, its numbers begin at positions[k] + offset.

    code: the type of the numbers, as a format character of the module `struct`.
    positions: (n,) in bytes for a binary file, in words for a text file.
    list_lengths: (n,) the lengths of the lists; None for a property that is a single number.
    """

    code: str
    positions: IntArray
    offset: int
    list_lengths: IntArray | None


@dataclass(frozen=True, eq=False)
class ElementTable:
    """All rows of an element of a .ply file: its properties as columns by name, and the location of
    each row in the file (`places`). `values` reads the numbers."""

    values: Values
    columns: dict[str, PropertyColumn]
    places: FileLocations

    def has_scalars(self, *names: str) -> bool:
        """Return whether there are columns with all of these names that hold single numbers, not
        lists."""
        return all(
            name in self.columns and self.columns[name].list_lengths is None for name in names
        )

    def scalar_column(self, name: str) -> npt.NDArray[Any]:
        """Return the numbers (n,) of a column of single numbers. Raises a FileFormatError if there
        is no such column, or if it holds lists."""
        column = self._column(name)
        if column.list_lengths is not None:
            raise self._wrong_kind_error()
        return self.values.read(column.positions + column.offset, column.code)

    def vectors(self, x: str, y: str, z: str) -> FloatArray:
        """Return the vectors (n, 3) whose components are the columns with these names. Raises a
        FileFormatError if there is no such column, or if it holds lists."""
        columns = [self.scalar_column(name) for name in (x, y, z)]
        return np.stack(columns, axis=1).astype(np.float64)

    def list_column(self, name: str) -> tuple[npt.NDArray[Any], IntArray]:
        """Return the numbers of a column of lists: all lists in one array, one list after the
        other; and the length (n,) of each list. Raises a FileFormatError if there is no such
        column, or if it holds single numbers."""
        column = self._column(name)
        if column.list_lengths is None:
            raise self._wrong_kind_error()
        # The position of each number: that of its list plus its rank in the list.
        where = np.repeat(column.positions + column.offset, column.list_lengths)
        where += ranks_in_lists(column.list_lengths) * self.values.width(column.code)
        return self.values.read(where, column.code), column.list_lengths

    def _column(self, name: str) -> PropertyColumn:
        """Return the column with this name. Raises a FileFormatError if there is none."""
        if name not in self.columns:
            raise self.places[0].error(f"this element needs a property {name!r}")
        return self.columns[name]

    def _wrong_kind_error(self) -> FileFormatError:
        """Return the error for a column that holds lists where single numbers are expected, or the
        reverse."""
        return self.places[0].error("a list where one number is expected, or the reverse")


def read_ply(path: Path, data: bytes) -> FileGeometry:
    """Read the bytes `data` of a .ply file. The result has its vertices, with their normals if they
    have nx, ny and nz, or other names that programs give to normals (`point_fields`); its faces;
    and its edges, as polylines with two vertices.

    Raises:
        FileFormatError: the header is malformed, the file has fewer data than it declares, or an
            index is out of range.
    """
    header = _header(path, data)
    _check_elements(path, header)
    tables = (_binary_tables if header.byte_order else _text_tables)(path, data, header)
    vertices, normals, notes = np.zeros((0, 3)), None, ()
    if table := tables.get("vertex"):
        vertices = table.vectors(*(find_positions(table.columns) or "xyz"))
        check_finite(vertices, table.places)
        names = find_normals(table.columns)
        if names is not None and table.has_scalars(*names):
            normals = table.vectors(*names)
        notes = unused_notes(table.columns)
    faces = edges = NO_POLYGONS
    if table := tables.get("face"):
        name = "vertex_index" if "vertex_index" in table.columns else "vertex_indices"
        faces = _polygons(table, *table.list_column(name), len(vertices))
    table = tables.get("edge")
    # Beside faces, edges with other property names are not needed.
    if table and (table.has_scalars("vertex1", "vertex2") or not tables.get("face")):
        ends = np.stack([table.scalar_column("vertex1"), table.scalar_column("vertex2")], axis=1)
        # Each edge is a polyline of two vertices.
        edges = _polygons(table, ends.ravel(), np.full(len(ends), 2), len(vertices))
    # Faces of different sizes are handled one by one, which takes long.
    if have_mixed_sizes(faces):
        check_element_count(FileLocation(path), header.declared_rows(len(data)))
    return FileGeometry(path, vertices, normals, faces, edges, notes)


def _check_elements(path: Path, header: PlyHeader) -> None:
    """Raise a FileFormatError if a header declares an element twice, or an element that contains
    faces in a form that is not supported, such as strips of triangles."""
    names = [section.name for section in header.elements]
    for name in names:
        has_capitals = name.lower() in ("vertex", "face", "edge") and name != name.lower()
        if name.lower() in _UNSUPPORTED_FACE_ELEMENTS or has_capitals:
            raise FileLocation(path).error(
                f"its element {name[:40]!r} is not read: triangles are rows of the element 'face'"
            )
        if names.count(name) > 1:
            raise FileLocation(path).error(f"its header has the element {name[:40]!r} twice")


def _check_end(path: Path, remainder: bytes) -> None:
    """Raise a FileFormatError if there are data (`remainder`) after the last row of the file."""
    if remainder.strip(_PADDING):
        raise FileLocation(path).error(
            "more follows than the rows that its header promises: its counts are too small"
        )


def _polygons(
    table: ElementTable, corners: npt.NDArray[Any], sizes: IntArray, count: int
) -> PolygonList:
    """Return the polygons (or edges) that are listed in the rows of an element. Raises a
    FileFormatError if an index is not an integer in [0, count).

    table: the rows of the element, for their locations in the file.
    corners: the vertex indices, one polygon after the other.
    sizes: (m,) the number of corners of each polygon.
    count: the number of vertices.
    """
    polygons = PolygonList(corners.astype(np.int64), sizes, table.places)
    # Indices are read as floats only if one of them is not whole. argmax finds the first such one.
    if corners.dtype.kind == "f" and corners.size:
        k = int(np.argmax(corners != np.rint(corners)))
        raise polygons.location_of_corner(k).error(
            f"indices must be integers, not {float(corners[k])}"
        )
    check_indices(polygons, count)
    return polygons


def _columns(
    section: PlyElement, values: Values, begins: IntArray, places: FileLocations
) -> tuple[dict[str, PropertyColumn], IntArray]:
    """Find where the properties of the element `section` are in all its rows. Returns them as
    columns by name, and the position (n,) at which each row ends.

    values: the numbers of the file.
    begins: (n,) the position at which each row begins.
    places: the locations of the rows, for errors.

    If the length of a list is invalid, the returned end of its row lies after the end of the file;
    callers test for that.
    """
    columns: dict[str, PropertyColumn] = {}
    positions, offset = begins, 0
    for ply_property in section.properties:
        if ply_property.length_code is None:  # a single number, with no lengths of lists
            columns[ply_property.name] = PropertyColumn(ply_property.code, positions, offset, None)
            offset += values.width(ply_property.code)
            continue
        # What follows a list begins at another place in each row: positions are counted from there.
        lengths = values.read(positions + offset, ply_property.length_code)
        # Lengths are read as floats only if one of them is not whole.
        if lengths.dtype.kind == "f":
            k = int(np.argmax(lengths != np.rint(lengths)))
            raise places[k].error(f"the length of a list is no integer, but {lengths[k]}")
        # A list with a negative or too large length gets a length that ends after the end of the
        # file.
        sizes = np.where(lengths < 0, values.size + 1, lengths.astype(np.int64))
        sizes = np.minimum(sizes, values.size + 1)
        offset += values.width(ply_property.length_code)
        columns[ply_property.name] = PropertyColumn(ply_property.code, positions, offset, sizes)
        positions, offset = positions + offset + values.width(ply_property.code) * sizes, 0
    return columns, positions + offset


def _text_tables(path: Path, data: bytes, header: PlyHeader) -> dict[str, ElementTable]:
    """Return the rows of each element of a text file, as a table by the element's name. Elements
    without rows are left out.

    Raises:
        FileFormatError: fewer or more rows than the header declares, or a row of wrong length.
    """
    lines = split_content_lines(path, data[header.size :], comment=None, first=header.lines + 1)
    tables: dict[str, ElementTable] = {}
    for section in header.elements:
        if section.count > len(lines):
            raise _too_short(path, section)
        if not section.count:
            continue
        places = FileLocations(path, section.name, range(section.count))
        rows, lines = TextLines(lines.text[: section.count], places), lines[section.count :]
        values = TextValues(rows)
        counts = values.counts
        columns, ends = _columns(section, values, np.cumsum(counts) - counts, places)
        # Each row must end where the next line begins.
        wrong = np.flatnonzero(ends != np.cumsum(counts))
        if wrong.size:
            how = "few" if ends[wrong[0]] > np.cumsum(counts)[wrong[0]] else "many"
            raise places[wrong[0]].error(f"{counts[wrong[0]]} numbers are too {how}")
        tables[section.name] = ElementTable(values, columns, places)
    # The first line after all rows, if there is one.
    _check_end(path, b"".join(lines.text[:1]))
    return tables


def _binary_tables(path: Path, data: bytes, header: PlyHeader) -> dict[str, ElementTable]:
    """Return the rows of each element of a binary file, as a table by the element's name. Elements
    without rows are left out.

    Rows are first read as if all were as long as the first row, which is fast. If their ends show
    that they are not, the end of each row is found one by one.

    Raises:
        FileFormatError: fewer or more data than the header declares.
    """
    values = BinaryValues(data, header.byte_order)
    tables: dict[str, ElementTable] = {}
    begin = header.size
    for section in header.elements:
        # The length of a row whose lists are all empty.
        min_stride = sum(values.width(p.length_code or p.code) for p in section.properties)
        if section.count * min_stride > values.size - begin:
            raise _too_short(path, section)
        if not section.count:
            continue
        places = FileLocations(path, section.name, range(section.count))
        try:
            # In most files the lists of all rows are as long as those of the first row, and not
            # empty.
            stride = next(_row_ends(section, values, begin)) - begin
            # A file could declare any number of rows with empty lists only, which take few bytes.
            # If the first row is one, the number of rows is checked.
            if stride == min_stride and any(p.length_code for p in section.properties):
                check_element_count(FileLocation(path), header.declared_rows(len(data)))
            begins = begin + stride * np.arange(section.count, dtype=np.int64)
            columns, ends = _columns(section, values, begins, places)
            if (ends != begins + stride).any() or ends[-1] > values.size:
                check_element_count(FileLocation(path), header.declared_rows(len(data)))
                ends = np.fromiter(_row_ends(section, values, begin), np.int64, section.count)
                # Each row begins where the one before ends.
                columns, _ = _columns(section, values, np.append(begin, ends[:-1]), places)
        except struct.error:
            raise _too_short(path, section) from None
        begin = int(ends[-1])
        tables[section.name] = ElementTable(values, columns, places)
    _check_end(path, data[begin:])
    return tables


def _row_ends(section: PlyElement, values: BinaryValues, begin: int) -> Iterator[int]:
    """Yield the position at which each row of the element `section` ends, one row after the other.
    This is for elements whose rows have different lengths because they contain lists.

    values: the bytes of the file.
    begin: the position at which the first row begins.

    Raises struct.error if a row ends after the end of the file, or a list has a negative length.
    """
    # For each list: the bytes since the list before, how its length is stored, and the bytes of
    # each of its numbers. At the end `fixed_bytes` is what follows the last list.
    fixed_bytes = 0
    lists: list[tuple[int, struct.Struct, int]] = []
    for ply_property in section.properties:
        if ply_property.length_code is None:
            fixed_bytes += values.width(ply_property.code)
        else:
            length = struct.Struct(values.byte_order + ply_property.length_code)
            lists.append((fixed_bytes, length, values.width(ply_property.code)))
            fixed_bytes = 0
    position = begin
    for _ in range(section.count):
        for fixed_before, length, width in lists:
            (count,) = length.unpack_from(values.data, position + fixed_before)
            if count < 0:
                raise struct.error
            position += fixed_before + length.size + count * width
        position += fixed_bytes
        if position > values.size:
            raise struct.error
        yield position


def _too_short(path: Path, section: PlyElement) -> FileFormatError:
    """Return the error for a file that ends before all rows of the element `section`."""
    return FileLocation(path).error(
        f"the file ends before the {section.count:,} rows of element {section.name!r} that its "
        "header declares"
    )


def _header(path: Path, data: bytes) -> PlyHeader:
    """Parse the header of a .ply file: its format, and the elements and properties that it
    declares.

    Raises:
        FileFormatError: it is malformed, or not the header of a .ply file.
    """
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith((b"ply\n", b"ply\r")) or end < 0:
        raise FileLocation(path).error(
            "this is no .ply file: a header from 'ply' to 'end_header' lacks"
        )
    newline = data.find(b"\n", end)
    size = newline + 1 if newline >= 0 else len(data)
    byte_order: str | None = None
    sections: list[PlyElement] = []
    # Line 1 is the word "ply".
    for number, line in enumerate(data[:end].splitlines()[1:], 2):
        place = FileLocation(path, f"line {number}")
        words = line.split()
        if not words or words[0] in (b"comment", b"obj_info"):
            continue
        if words[0] == b"format" and len(words) == 3 and words[1] in _BYTE_ORDERS:
            byte_order = _BYTE_ORDERS[words[1]]
        elif words[0] == b"element" and len(words) == 3 and words[2].isdigit():
            name = words[1].decode("ascii", "backslashreplace")
            sections.append(PlyElement(name, _parse_count(words[2], place), ()))
        # A property belongs to the element before it.
        elif words[0] == b"property" and sections:
            last = sections[-1]
            columns = (*last.properties, _parse_property(words, last, place))
            sections[-1] = PlyElement(last.name, last.count, columns)
        else:
            raise place.error(f"{excerpt(line)} is no statement of a .ply header")
    if byte_order is None:
        raise FileLocation(path).error("the header names no format")
    for section in sections:
        if section.count and not section.properties:
            raise FileLocation(path).error(f"element {section.name!r} has no properties")
    return PlyHeader(byte_order, tuple(sections), size, len(data[:size].splitlines()))


def _parse_count(word: bytes, place: FileLocation) -> int:
    """Return the number of rows of an element. word: its digits in the header. Raises a
    FileFormatError for more than 18 digits."""
    if len(word) > 18:
        raise place.error(f"{excerpt(word)} is too large a count")
    return int(word)


def _parse_property(words: list[bytes], section: PlyElement, place: FileLocation) -> Property:
    """Return the property that a line of the header declares for the element `section`. words: the
    words of the line.

    Raises:
        FileFormatError: a malformed line, a name that occurs twice, or a list whose length is no
            integer.
    """
    types = words[2:4] if words[1:2] == [b"list"] else words[1:2]
    # A list has two types: of its length, and of its numbers.
    if len(words) != (5 if len(types) == 2 else 3) or any(t not in _CODES for t in types):
        raise place.error("a property is 'property TYPE NAME' or 'property list TYPE TYPE NAME'")
    name = words[-1].decode("ascii", "backslashreplace")
    if any(name == other.name for other in section.properties):
        raise place.error(f"property {name!r} is declared twice")
    codes = [_CODES[t] for t in types]
    if len(codes) == 2 and codes[0] in "fd":
        raise place.error("the length of a list must be an integer")
    return Property(name, codes[-1], codes[0] if len(codes) == 2 else None)
