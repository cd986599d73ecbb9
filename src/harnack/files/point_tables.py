"""Reading point clouds from tables in text: .xyz, .txt, .csv and .pts, with a point on each line.

Columns are separated by blanks, commas or semicolons. A first line of words names them; otherwise
columns 1 to 3 are the position, and 4 to 6 the normal if they are unit vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import FileGeometry, FileLocation, FileLocations
from harnack.files.point_fields import find_normals, find_positions, unused_notes
from harnack.files.text_tables import TextLines, excerpt, read_floats, split_content_lines

__all__ = ["read_point_table"]

# What CloudCompare writes before the names of columns.
_SLASHES = b"//"


def read_point_table(path: Path, data: bytes) -> FileGeometry:
    """Read the points of a .xyz, .xyzn, .txt, .csv or .pts file, and normals if it has them.

    `#` and, at the beginning of a line, `//` begin a comment. A first line of words, also behind
    `//` or, if it has a word for each column, behind `#`, names the columns: x, y and z, and nx, ny
    and nz or other names of normals (`point_fields`). Without it, columns 4 to 6 are normals if
    there are six columns or more; of a .pts file, only if all of them have the length 1. If they
    are integers from 0 to 255, they are colors, and columns 7 to 9 are normals if all have the
    length 1. A first line of one integer, which .pts files and some others have, is the number of
    points. Other columns are ignored.

    Raises:
        FileFormatError: lines have different numbers of columns, or fewer than three; a word is not
            a finite number; numbers have decimal commas; the named columns lack x, y or z; columns
            4 to 6 are neither normals nor colors; or a .pts file has another number of points than
            its first line says.
    """
    lines = split_content_lines(path, data)
    names: list[str] | None = None
    if len(lines) and lines.text[0].startswith(_SLASHES):
        names = _column_names(lines.text[0].removeprefix(_SLASHES))
        names = names if names and find_positions(names) else None
    lines = _separated_by_blanks(_without_slashes(lines))
    if names is None and len(lines) and (names := _column_names(lines.text[0])):
        lines = lines[1:]
    is_pts = path.suffix.lower() == ".pts"
    if len(lines) and lines.text[0].isdigit():
        count = int(lines.text[0][:18])
        if is_pts or count == len(lines) - 1:
            lines = lines[1:]
        if is_pts and len(lines) != count:
            raise FileLocation(path).error(
                f"its first line promises {count:,} points, but {len(lines):,} lines follow"
            )
    if not len(lines):
        raise FileLocation(path).error("it holds no points: write one a line, x y z")
    table = _read_rectangle(lines)
    if names is None:
        names = _names_in_comments(data, table.shape[1])
    if names is not None:
        return _by_names(path, table, names)
    return _by_order(path, table, lines.locations, is_pts)


def _names_in_comments(data: bytes, count: int) -> list[str] | None:
    """Return the names of `count` columns that the last comment before the first point lists, as
    `numpy.savetxt` writes them behind `#`; None if it lists no x, y and z, or other names."""
    names: list[str] | None = None
    for line in data.removeprefix(b"\xef\xbb\xbf").splitlines():
        line = line.strip()
        if line and not line.startswith(b"#"):
            break
        if line:
            names = _column_names(line.lstrip(b"# "))
    if names is None or len(names) != count or find_positions(names) is None:
        return None
    return names


def _without_slashes(lines: TextLines) -> TextLines:
    """Return the lines that do not begin with `//`."""
    if not any(line.startswith(_SLASHES) for line in lines.text):
        return lines
    kept = [k for k, line in enumerate(lines.text) if not line.startswith(_SLASHES)]
    places = lines.locations
    numbers = [places.numbers[k] for k in kept]
    return TextLines(
        [lines.text[k] for k in kept], FileLocations(places.path, places.noun, numbers)
    )


def _separated_by_blanks(lines: TextLines) -> TextLines:
    """Return the lines with blanks in place of the commas or semicolons that separate columns.

    Raises:
        FileFormatError: a line has commas beside other separators, so that these may be decimal
            commas.
    """
    result: list[bytes] = []
    for k, line in enumerate(lines.text):
        if b"," in line:
            if b";" in line or any(len(word.split()) > 1 for word in line.split(b",")):
                raise lines.locations[k].error(
                    f"{excerpt(line)} has commas beside other separators: write numbers with "
                    "decimal points"
                )
            line = line.replace(b",", b" ")
        result.append(line.replace(b";", b" "))
    return TextLines(result, lines.locations)


def _column_names(line: bytes) -> list[str] | None:
    """Return the names of columns that a line lists; None if it is a line of numbers, or has fewer
    than three words."""
    for separator in b",;":
        line = line.replace(bytes([separator]), b" ")
    words = line.split()
    if len(words) < 3 or any(_is_number(word) for word in words):
        return None
    return [word.decode("utf-8", "backslashreplace").strip("\"'") for word in words]


def _is_number(word: bytes) -> bool:
    """Return whether a word stands for a number, also NaN or infinite."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_rectangle(lines: TextLines) -> FloatArray:
    """Return the numbers of all lines as a table (n, k).

    Raises:
        FileFormatError: lines have different numbers of words, or fewer than three, or a word is
            not a finite number.
    """
    numbers, counts = read_floats(lines)
    columns = int(counts[0])
    # All lines must have as many columns as the first.
    ragged = np.flatnonzero(counts != columns)
    if ragged.size:
        raise lines.locations[ragged[0]].error(
            f"{counts[ragged[0]]} columns, but the lines before have {columns}"
        )
    if columns < 3:
        raise lines.locations[0].error(f"a point needs three coordinates, not {columns}")
    return numbers.reshape(-1, columns)


def _by_names(path: Path, table: FloatArray, names: Sequence[str]) -> FileGeometry:
    """Return the points of a table (n, k) whose columns have these names.

    Raises:
        FileFormatError: there are other than k names, or x, y or z is missing.
    """
    place = FileLocation(path)
    if len(names) != table.shape[1]:
        raise place.error(f"{len(names)} columns are named, and there are {table.shape[1]}")
    axes = find_positions(names)
    if axes is None:
        raise place.error(f"its columns, {', '.join(names)[:80]}, lack x, y or z")
    normal_names = find_normals(names)
    position = table[:, [names.index(name) for name in axes]]
    normals = normal_names and table[:, [names.index(name) for name in normal_names]]
    return FileGeometry(path, position, normals, notes=unused_notes(names))


def _by_order(path: Path, table: FloatArray, places: FileLocations, is_pts: bool) -> FileGeometry:
    """Return the points of a table (n, k) whose columns have no names.

    places: the locations of the rows.
    is_pts: whether columns 4 to 6 may be anything but normals.

    Raises:
        FileFormatError: columns 4 to 6 are neither normals nor colors.
    """
    positions, following = table[:, :3], table[:, 3:6]
    if following.shape[1] < 3:
        return FileGeometry(path, positions)
    wrong = _rows_without_normals(following)
    if not wrong.size:
        return FileGeometry(path, positions, following)
    is_color = (following == np.rint(following)) & (following >= 0) & (following <= 255)
    # Integers up to 1 could be normals along an axis, one of which has the length 0.
    if is_color.all() and following.max() > 1:
        notes = ("columns 4 to 6 are colors, not used",)
        last = table[:, 6:9]
        has_normals = last.shape[1] == 3 and not _rows_without_normals(last).size
        return FileGeometry(path, positions, last if has_normals else None, notes=notes)
    if is_pts:
        return FileGeometry(path, positions, notes=("columns 4 and up not used",))
    length = np.linalg.norm(following[wrong[0]])
    raise places[wrong[0]].error(
        f"columns 4 to 6 should be a unit normal, but their length is {length:.3g}: remove "
        "these columns if they are something else, or name all columns in a first line, "
        "x y z and others"
    )


def _rows_without_normals(columns: FloatArray) -> IntArray:
    """Return the rows of three columns (n, 3) that are no unit normals. Normals with few digits are
    not exactly of unit length."""
    return np.flatnonzero(np.abs(np.linalg.norm(columns, axis=1) - 1.0) > 0.1)
