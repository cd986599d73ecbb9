"""Tables of numbers in text files: quickly where all is well, line by line where it is not."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harnack.files.file_format import Place, as_integer, as_number, text_lines
from harnack.geometry.convex_volume import FloatArray
from harnack.geometry.meshes import IntArray

__all__ = ["Lines", "content_lines", "quick_table", "read_integers", "read_numbers"]


@dataclass(frozen=True)
class Lines:
    """Lines of a text file that are not blank, without comments, and their numbers from 1."""

    path: Path
    text: list[bytes]
    numbers: list[int]

    def __len__(self) -> int:
        return len(self.text)

    def __getitem__(self, part: slice) -> Lines:
        return Lines(self.path, self.text[part], self.numbers[part])

    def place(self, k: int) -> Place:
        """Where line k of these stands in the file."""
        return Place(self.path, f"line {self.numbers[k]}")


def content_lines(path: Path, data: bytes, *, comment: bytes = b"#") -> Lines:
    """The lines of a file that say something.

    Raises:
        FileFormatError: as `text_lines`.
    """
    stripped = [line.split(comment, 1)[0].strip() for line in text_lines(path, data)]
    numbers = [number for number, line in enumerate(stripped, 1) if line]
    return Lines(path, [stripped[number - 1] for number in numbers], numbers)


def read_numbers(lines: Lines, columns: int | None = None) -> FloatArray:
    """A table (n, columns) of finite numbers, one row a line.

    columns: how many to read, further ones are passed over. None: all, as many in each line.

    Raises:
        FileFormatError: naming the first line with too few, or with what is no finite number.
    """
    table = quick_table(lines.text, columns)
    if table is not None and np.isfinite(table).all():
        return table
    return np.array(_read_slowly(lines, columns, as_number), dtype=np.float64)


def read_integers(lines: Lines, columns: int | None = None) -> IntArray:
    """A table (n, columns) of integers below 2^53, as `read_numbers`."""
    table = quick_table(lines.text, columns)
    if table is not None and (np.abs(table) < 2.0**53).all() and (table == np.rint(table)).all():
        return table.astype(np.int64)
    rows = _read_slowly(lines, columns, as_integer)
    for k, row in enumerate(rows):
        for value in row:
            if abs(value) >= 2**53:
                raise lines.place(k).error(f"{value} is too large an integer")
    return np.array(rows, dtype=np.int64)


def quick_table(rows: list[bytes], columns: int | None = None) -> FloatArray | None:
    """A table of numbers by NumPy, or None where it does not succeed. Nothing is checked."""
    if not rows:
        return None
    used = None if columns is None else range(columns)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            table = np.loadtxt(rows, dtype=np.float64, ndmin=2, usecols=used, encoding="latin1")
    except (ValueError, UserWarning):
        return None
    return table if len(table) == len(rows) else None  # it passes over blank rows


def _read_slowly(
    lines: Lines, columns: int | None, convert: Callable[[bytes, Place], float]
) -> list[list[float]]:
    rows: list[list[float]] = []
    for k, line in enumerate(lines.text):
        words, place = line.split(), lines.place(k)
        if columns is None and rows and len(words) != len(rows[0]):
            raise place.error(f"{len(words)} columns, but the lines before have {len(rows[0])}")
        if columns is not None and len(words) < columns:
            raise place.error(f"{len(words)} numbers are too few: {columns} are expected")
        rows.append([convert(word, place) for word in words[:columns]])
    return rows
