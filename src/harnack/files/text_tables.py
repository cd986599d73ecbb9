"""Numbers in text files: all at once where all is well, line by line to find what is not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat
from pathlib import Path

import numpy as np

from harnack.files.file_format import Place, Places
from harnack.geometry.convex_volume import FloatArray
from harnack.geometry.meshes import IntArray

__all__ = [
    "Lines",
    "as_integer",
    "as_number",
    "content_lines",
    "excerpt",
    "read_floats",
    "read_integers",
    "read_table",
]

MAX_LINE = 1 << 24


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of a text file, such as all that say something, and where they stand."""

    text: list[bytes]
    places: Places

    def __len__(self) -> int:
        return len(self.text)

    def __getitem__(self, part: slice) -> Lines:
        places = self.places
        return Lines(self.text[part], Places(places.path, places.noun, places.numbers[part]))

    def chosen(self, which: list[int]) -> Lines:
        """Some of the lines."""
        places = self.places
        numbers = [places.numbers[k] for k in which]
        return Lines([self.text[k] for k in which], Places(places.path, places.noun, numbers))

    def counts(self) -> IntArray:
        """How many words each line has."""
        return np.fromiter((len(line.split()) for line in self.text), np.int64)

    def words(self, skip: int = 0, stop: int | IntArray | None = None) -> Iterator[list[bytes]]:
        """Words number `skip` and following of each line. stop: the first not to be given."""
        stops = stop.tolist() if isinstance(stop, np.ndarray) else repeat(stop)
        for line, end in zip(self.text, stops, strict=False):
            yield line.split(None, -1 if end is None else end)[skip:end]


def content_lines(
    path: Path, data: bytes, *, comment: bytes | None = b"#", first: int = 1
) -> Lines:
    """The lines of a text file that are not blank, without comments and byte order mark.

    first: number of the first line, for messages.

    Raises:
        FileFormatError: it holds binary data, or a line above 16 MiB.
    """
    if b"\0" in data:
        raise Place(path).error("this is binary data, not the text that its extension announces")
    lines = data.removeprefix(b"\xef\xbb\xbf").splitlines()
    longest = max(map(len, lines), default=0)
    if longest > MAX_LINE:
        number = first + next(k for k, line in enumerate(lines) if len(line) > MAX_LINE)
        raise Place(path, f"line {number}").error(
            f"a line of {longest:,} bytes is too long: at most {MAX_LINE:,} are read"
        )
    if comment is not None and comment in data:
        lines = [line.split(comment, 1)[0] for line in lines]
    lines = [line.strip() for line in lines]
    numbers = [number for number, line in enumerate(lines, first) if line]
    return Lines([line for line in lines if line], Places(path, "line", numbers))


def as_number(word: bytes, place: Place) -> float:
    """A finite number.

    Raises:
        FileFormatError: it is not one.
    """
    try:
        value = float(word)
    except ValueError:
        raise place.error(f"{excerpt(word)} is not a number") from None
    if not math.isfinite(value):
        raise place.error(f"coordinates must be finite, not {excerpt(word)}")
    return value


def as_integer(word: bytes, place: Place) -> int:
    """An integer that can be the index of a vertex.

    Raises:
        FileFormatError: it is not one.
    """
    try:
        value = int(word)
    except ValueError:
        # Some programs write 3 as 3.000e+00.
        if not _is_integral(word):
            raise place.error(f"{excerpt(word)} is not an integer") from None
        value = int(float(word))
    if abs(value) >= 2**62:
        raise place.error(f"vertex {value} is out of range: no file has as many")
    return value


def _is_integral(word: bytes) -> bool:
    try:
        return float(word).is_integer()
    except ValueError:
        return False


def excerpt(word: bytes) -> str:
    """A word from a file, short and printable, in quotes."""
    shown = word[:32].decode("ascii", "backslashreplace")
    return repr(shown + ("..." if len(word) > 32 else ""))


def read_integers(lines: Lines, skip: int = 0, stop: int | IntArray | None = None) -> IntArray:
    """The integers that `Lines.words` gives, those of all lines one after the other.

    Raises:
        FileFormatError: naming the line of the first that is none.
    """
    try:
        return np.fromiter(map(int, chain.from_iterable(lines.words(skip, stop))), np.int64)
    except (ValueError, OverflowError):
        return np.fromiter(_converted(lines, skip, stop, as_integer), np.int64)


def read_floats(
    lines: Lines, *, convert: Callable[[bytes, Place], float] = as_number
) -> FloatArray:
    """The numbers of all lines, one after the other.

    convert: makes numbers of the words where not all are finite numbers, or raises.

    Raises:
        FileFormatError: what `convert` raises.
    """
    found = _floats(lines, 0, None)
    if found is None:
        return np.fromiter(_converted(lines, 0, None, convert), np.float64)
    return found


def read_table(
    lines: Lines,
    columns: int,
    *,
    skip: int = 0,
    few: str = "{} numbers are too few: {} are expected",
) -> FloatArray:
    """A table (n, columns) of finite numbers, one row a line; further words are passed over.

    skip: how many words come before the first number. few: the error of a line with fewer numbers.

    Raises:
        FileFormatError: naming the first line with too few, or with what is no finite number.
    """
    found = _floats(lines, skip, skip + columns)
    if found is None or len(found) != columns * len(lines):
        for k, words in enumerate(lines.words(skip, skip + columns)):
            if len(words) < columns:
                raise lines.places[k].error(few.format(len(words), columns))
            for word in words:
                as_number(word, lines.places[k])
        raise AssertionError("what cannot be read has an error")
    return found.reshape(-1, columns)


def _floats(lines: Lines, skip: int, stop: int | None) -> FloatArray | None:
    """The numbers that `Lines.words` gives; None if not all are finite numbers."""
    try:
        found = np.fromiter(map(float, chain.from_iterable(lines.words(skip, stop))), np.float64)
    except ValueError:
        return None
    return found if np.isfinite(found).all() else None


def _converted(
    lines: Lines,
    skip: int,
    stop: int | IntArray | None,
    convert: Callable[[bytes, Place], float],
) -> Iterator[float]:
    for k, words in enumerate(lines.words(skip, stop)):
        place = lines.places[k]
        for word in words:
            yield convert(word, place)
