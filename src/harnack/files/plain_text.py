"""Reading text files of bare numbers: .xyz, a point a line, and .loops, a closed curve a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import Contents, Place
from harnack.files.text_tables import content_lines, read_floats


def read_xyz(path: Path, data: bytes) -> Contents:
    """Points, from columns 1 to 3, and normals, from columns 4 to 6 if there are six or more.

    Further columns are passed over. `#` begins a comment.

    Raises:
        FileFormatError: lines with different numbers of columns or fewer than three, words, numbers
            that are not finite; columns 4 to 6 that hold no normals (lengths far from 1).
    """
    lines = content_lines(path, data)
    if not len(lines):
        raise Place(path).error("it holds no points: write one a line, x y z")
    numbers, counts = read_floats(lines)
    columns = int(counts[0])
    ragged = np.flatnonzero(counts != columns)
    if ragged.size:
        raise lines.places[ragged[0]].error(
            f"{counts[ragged[0]]} columns, but the lines before have {columns}"
        )
    if columns < 3:
        raise lines.places[0].error(f"a point needs three coordinates, not {columns}")
    table = numbers.reshape(-1, columns)
    if columns < 6:
        return Contents(path, table[:, :3])
    normals = table[:, 3:6]
    length = np.linalg.norm(normals, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 0.1)
    if wrong.size:
        raise lines.places[wrong[0]].error(
            f"columns 4 to 6 should be a unit normal, but their length is {length[wrong[0]]:.3g}: "
            "remove these columns if they are colors or the like"
        )
    return Contents(path, table[:, :3], normals)


def read_loops_text(path: Path, data: bytes) -> list[tuple[FloatArray, Place]]:
    """Loops (n, 3) of a .loops file, x y z repeated, and where they stand. `#` begins a comment.

    Raises:
        FileFormatError: something that is no number, or a line whose count is no multiple of 3.
    """
    lines = content_lines(path, data)
    if not len(lines):
        raise Place(path).error("there are no loops: write one a line, x y z repeated")
    numbers, counts = read_floats(lines)
    wrong = np.flatnonzero(counts % 3)
    if wrong.size:
        raise lines.places[wrong[0]].error(
            f"{counts[wrong[0]]} numbers: a loop is x y z repeated, so a multiple of 3"
        )
    points = np.split(numbers.reshape(-1, 3), np.cumsum(counts // 3)[:-1])
    return [(loop, lines.places[k]) for k, loop in enumerate(points)]
