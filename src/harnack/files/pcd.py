"""Reading .pcd files of the Point Cloud Library: text ("ascii"), "binary" and "binary_compressed".

A .pcd file is a header of lines and then the points. A "field" is a number, or several numbers, of
each point, such as "x" or "normal_x"; fields named "_" fill gaps. Binary files hold one point after
the other, compressed ones one field after the other, packed by LZF.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_geometry import (
    MAX_BYTES,
    FileGeometry,
    FileLocation,
)
from harnack.files.point_fields import find_normals, find_positions, unused_notes
from harnack.files.text_tables import excerpt, parse_any_number, read_floats, split_content_lines

__all__ = ["read_pcd"]

_KEYWORDS = (
    "VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT",
    "POINTS", "DATA",
)  # fmt: skip
_TYPES = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_MAX_HEADER = 1 << 16
_NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Field:
    """A field that the header of a .pcd file declares: its name, the type of its numbers in NumPy's
    notation, and how many of them a point has."""

    name: str
    code: str
    count: int


@dataclass(frozen=True)
class _Header:
    """The header of a .pcd file.

    points: the number of points that it declares.
    encoding: "ascii", "binary" or "binary_compressed".
    size, lines: the number of bytes and the number of lines before the points.
    viewpoint: the position of the sensor, and the quaternion of its rotation.
    """

    fields: tuple[_Field, ...]
    points: int
    encoding: str
    size: int
    lines: int
    viewpoint: tuple[float, ...]


def read_pcd(path: Path, data: bytes) -> FileGeometry:
    """Read the points in the bytes `data` of a .pcd file, with their normals if there are fields
    `normal_x`, `normal_y` and `normal_z`. Points whose coordinates are not finite, which stand for
    no measurement, are left out. Colors and the viewpoint are ignored; the notes of the result say
    so.

    Raises:
        FileFormatError: the header is malformed, or the file is truncated or damaged.
    """
    place = FileLocation(path)
    header = _parse_header(path, data)
    names = [field.name for field in header.fields]
    axes = find_positions(names)
    if axes is None:
        raise place.error(f"its fields, {', '.join(names)[:80]}, lack x, y or z")
    normal_names = find_normals(names)
    for name in (*axes, *(normal_names or ())):
        if names.count(name) > 1 or header.fields[names.index(name)].count != 1:
            raise place.error(f"its field {name!r} must be one number a point, declared once")
    columns = _read_columns(path, data, header, [*axes, *(normal_names or ())])
    is_measured = np.isfinite(columns[:, :3]).all(axis=1)
    notes: list[str] = []
    if not is_measured.all():
        left_out = len(columns) - int(is_measured.sum())
        columns = columns[is_measured]
        notes.append(f"{left_out:,} without coordinates left out")
        if not len(columns):
            raise place.error("none of its points has coordinates that are finite")
    notes += unused_notes(names)
    if header.viewpoint != _NO_VIEWPOINT:
        notes.append("its viewpoint not used")
    normals = None if normal_names is None else columns[:, 3:]
    return FileGeometry(path, columns[:, :3], normals, notes=tuple(notes))


def _parse_header(path: Path, data: bytes) -> _Header:
    """Parse the header of a .pcd file.

    Raises:
        FileFormatError: it is malformed, or not the header of a .pcd file.
    """
    entries: dict[str, list[str]] = {}
    position, number = 0, 0
    while "DATA" not in entries:
        newline = data.find(b"\n", position, _MAX_HEADER)
        if newline < 0:
            raise FileLocation(path).error("this is no .pcd file: its header has no line DATA")
        line, number = data[position:newline].split(b"#", 1)[0].strip(), number + 1
        position = newline + 1
        if not line:
            continue
        keyword, *words = line.decode("ascii", "backslashreplace").split()
        if keyword not in _KEYWORDS or keyword in entries:
            raise FileLocation(path, f"line {number}").error(
                f"{excerpt(line)} is no statement of a .pcd header, or its second of this kind"
            )
        entries[keyword] = words
    place = FileLocation(path, f"header, lines 1 to {number}")
    # Version 0.5 and older had COLUMNS.
    entries.setdefault("FIELDS", entries.pop("COLUMNS", []))
    encoding = " ".join(entries["DATA"])
    if encoding not in _ENCODINGS:
        raise place.error(f"DATA must be {', '.join(_ENCODINGS)}, not {encoding[:40]!r}")
    try:
        fields = _parse_fields(entries)
        width, height = int(*entries["WIDTH"]), int(*entries.get("HEIGHT", ["1"]))
        points = int(*entries.get("POINTS", [str(width * height)]))
        viewpoint = tuple(float(word) for word in entries.get("VIEWPOINT", [])) or _NO_VIEWPOINT
    except (KeyError, TypeError, ValueError) as error:
        raise place.error(f"it is no sound .pcd header ({str(error)[:80]})") from None
    if width * height != points or points < 0:
        raise place.error(f"WIDTH {width} times HEIGHT {height} is not POINTS {points}")
    if not points:
        raise place.error("it declares no points")
    return _Header(fields, points, encoding, position, number, viewpoint)


def _parse_fields(entries: dict[str, list[str]]) -> tuple[_Field, ...]:
    """Return the fields that the entries FIELDS, SIZE, TYPE and COUNT of a header declare. Raises a
    ValueError if these do not fit together, and a KeyError if one is missing."""
    names, sizes, types = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
    counts = entries.get("COUNT", ["1"] * len(names))
    fields: list[_Field] = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if kind not in _TYPES or int(size) not in _SIZES[kind]:
            raise ValueError(f"field {name!r} has the unknown type {kind} of {size} bytes")
        # 2^20: more numbers than any descriptor of a point has.
        if not 0 < int(count) <= 1 << 20:
            raise ValueError(f"field {name!r} has the count {count}")
        fields.append(_Field(name, f"<{_TYPES[kind]}{int(size)}", int(count)))
    return tuple(fields)


def _read_columns(path: Path, data: bytes, header: _Header, names: list[str]) -> FloatArray:
    """Return the numbers (n, k) of the fields with these k names, each of which has one number a
    point.

    Raises:
        FileFormatError: the file holds fewer or more than the points that its header declares.
    """
    place = FileLocation(path)
    indices = [[field.name for field in header.fields].index(name) for name in names]
    if header.encoding == "ascii":
        return _read_text(path, data, header)[
            :, _offsets(header, [1] * len(header.fields), indices)
        ]
    widths = [np.dtype(field.code).itemsize for field in header.fields]
    row = sum(width * field.count for width, field in zip(widths, header.fields, strict=True))
    if header.points * row > MAX_BYTES:
        raise place.error(
            f"its {header.points:,} points have {header.points * row:,} bytes: at most "
            f"{MAX_BYTES:,} are read"
        )
    is_compressed = header.encoding == "binary_compressed"
    body = _decompress(place, data[header.size :]) if is_compressed else data[header.size :]
    if len(body) < header.points * row or (is_compressed and len(body) > header.points * row):
        raise place.error(
            f"its {header.points:,} points need {header.points * row:,} bytes, and there are "
            f"{len(body):,}: the file is truncated or damaged"
        )
    # In a compressed file all numbers of a field stand together, as if its points were one.
    scale, stride = (header.points, None) if is_compressed else (1, row)
    starts = _offsets(header, widths, indices)
    result = np.empty((header.points, len(names)))
    for column, (index, start) in enumerate(zip(indices, starts, strict=True)):
        code, step = np.dtype(header.fields[index].code), stride or widths[index]
        numbers = np.ndarray((header.points,), code, body, scale * start, (step,))
        result[:, column] = numbers
    return result


def _offsets(header: _Header, widths: list[int], indices: list[int]) -> list[int]:
    """Return, for each index of a field, the sum of the widths of the fields before it. widths: the
    width of a number of each field."""
    totals = np.cumsum([0, *(w * f.count for w, f in zip(widths, header.fields, strict=True))])
    return [int(totals[index]) for index in indices]


def _read_text(path: Path, data: bytes, header: _Header) -> FloatArray:
    """Return all numbers (n, k) of the points of a text file, which may be NaN or infinite."""
    lines = split_content_lines(path, data[header.size :], first=header.lines + 1)
    if len(lines) != header.points:
        raise FileLocation(path).error(
            f"its header declares {header.points:,} points, but {len(lines):,} lines follow"
        )
    numbers, counts = read_floats(lines, convert=parse_any_number)
    columns = sum(field.count for field in header.fields)
    wrong = np.flatnonzero(counts != columns)
    if wrong.size:
        raise lines.locations[wrong[0]].error(
            f"{counts[wrong[0]]} numbers, but the fields of a point have {columns}"
        )
    return numbers.reshape(-1, columns)


def _decompress(place: FileLocation, data: bytes) -> bytearray:
    """Return the unpacked points of a compressed file. data: what follows the header: the packed
    and the unpacked size in bytes, 32 bits each, and the packed bytes.

    Raises:
        FileFormatError: the sizes or the packed bytes are wrong.
    """
    packed_size, size = (int.from_bytes(data[k : k + 4], "little") for k in (0, 4))
    if size > MAX_BYTES:
        raise place.error(f"it has {size:,} bytes when unpacked: at most {MAX_BYTES:,} are read")
    if len(data) < 8 + packed_size:
        raise place.error(
            f"it should have {packed_size:,} packed bytes, and has {max(len(data) - 8, 0):,}: the "
            "file is truncated"
        )
    result = _unpack_lzf(data[8 : 8 + packed_size], size)
    if result is None:
        raise place.error("its packed points cannot be unpacked: the file is damaged")
    return result


def _unpack_lzf(packed: bytes, size: int) -> bytearray | None:
    """Return the `size` bytes that were packed by LZF; None if these are no such bytes.

    A control byte c < 32 announces c + 1 bytes that are taken as they are. Otherwise its upper
    three bits, and a further byte if they are 7, give a length (less 2), and its lower five bits
    and the next byte the distance (less 1) back to where these bytes have occurred already.
    """
    result = bytearray()
    position, end = 0, len(packed)
    try:
        while position < end:
            control = packed[position]
            position += 1
            if control < 32:
                literal = packed[position : position + control + 1]
                if len(literal) <= control:
                    return None
                result += literal
                position += control + 1
            else:
                length = control >> 5
                if length == 7:
                    length += packed[position]
                    position += 1
                distance = ((control & 31) << 8) + packed[position] + 1
                position += 1
                start, length = len(result) - distance, length + 2
                if start < 0:
                    return None
                # If the length is above the distance, what is copied repeats itself.
                repeats = -(-length // distance)
                result += (result[start : start + length] * repeats)[:length]
            if len(result) > size:
                return None
    except IndexError:
        return None
    return result if len(result) == size else None
