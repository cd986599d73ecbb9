"""Reading .xyz point clouds: a point a line, and its normal where there are six columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harnack.files.file_format import Place
from harnack.files.surface_parts import Parts
from harnack.files.text_tables import content_lines, read_numbers


def read_xyz(path: Path, data: bytes) -> Parts:
    """Points, from columns 1 to 3, and normals, from columns 4 to 6 if there are six or more.

    Further columns are passed over. `#` begins a comment.

    Raises:
        FileFormatError: lines with different numbers of columns or fewer than three, words, numbers
            that are not finite; columns 4 to 6 that hold no normals (lengths far from 1).
    """
    lines = content_lines(path, data)
    if not len(lines):
        raise Place(path).error("it holds no points: write one a line, x y z")
    table = read_numbers(lines)
    columns = table.shape[1]
    if columns < 3:
        raise lines.place(0).error(f"a point needs three coordinates, not {columns}")
    if columns < 6:
        return Parts(table[:, :3])
    normals = table[:, 3:6]
    length = np.linalg.norm(normals, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 0.1)
    if wrong.size:
        raise lines.place(int(wrong[0])).error(
            f"columns 4 to 6 should be a unit normal, but their length is {length[wrong[0]]:.3g}: "
            "remove these columns if they are colors or the like"
        )
    return Parts(table[:, :3], normals)
