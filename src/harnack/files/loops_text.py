"""Reading .loops text: one loop a line, `x y z` repeated; `#` begins a comment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harnack.files.file_format import Place, as_number, text_lines
from harnack.geometry.convex_volume import FloatArray


def read_loops_text(path: Path, data: bytes) -> list[tuple[FloatArray, Place]]:
    """Loops (n, 3) of a .loops file and the lines they stand on.

    Raises:
        FileFormatError: something that is no number, or a line whose count is no multiple of 3.
    """
    loops: list[tuple[FloatArray, Place]] = []
    for number, line in enumerate(text_lines(path, data), 1):
        words = line.split(b"#", 1)[0].split()
        if not words:
            continue
        place = Place(path, f"line {number}")
        numbers = np.array([as_number(word, place) for word in words])
        if len(words) % 3:
            raise place.error(f"{len(words)} numbers: a loop is x y z repeated, so a multiple of 3")
        loops.append((numbers.reshape(-1, 3), place))
    if not loops:
        raise Place(path).error("there are no loops: write one a line, x y z repeated")
    return loops
