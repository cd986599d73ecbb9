"""Reading numbers from text files. A "word" is an entry of a line, between blanks. All numbers of a
file are parsed at once by NumPy, which is fast. If that fails, they are parsed word by word, to
find the wrong word for the error message, and for lines with different numbers of words.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import FileLocation, FileLocations

__all__ = [
    "TextLines",
    "excerpt",
    "parse_any_number",
    "parse_finite",
    "parse_vertex_index",
    "read_floats",
    "read_integers",
    "read_table",
    "split_content_lines",
]

MAX_LINE = 1 << 24

_Number = TypeVar("_Number", int, float)


@dataclass(frozen=True, eq=False)
class TextLines:
    """Some lines of a text file, for example all that are not blank, and the location of each in
    the file."""

    text: list[bytes]
    locations: FileLocations

    def __len__(self) -> int:
        return len(self.text)

    def __getitem__(self, part: slice) -> TextLines:
        places = self.locations
        return TextLines(
            self.text[part], FileLocations(places.path, places.noun, places.numbers[part])
        )


def split_content_lines(
    path: Path, data: bytes, *, comment: bytes | None = b"#", first: int = 1
) -> TextLines:
    """Return the lines of a text file that are not blank, without comments and byte order mark.

    data: the bytes of the file.
    comment: what begins a comment; None if there are no comments.
    first: number of the first line, for messages.

    Raises:
        FileFormatError: it holds binary data, or a line above 16 MiB.
    """
    if b"\0" in data:
        raise FileLocation(path).error(
            "this is binary data, not the text that its extension announces"
        )
    lines = data.removeprefix(b"\xef\xbb\xbf").splitlines()
    longest = max(map(len, lines), default=0)
    if longest > MAX_LINE:
        number = first + next(k for k, line in enumerate(lines) if len(line) > MAX_LINE)
        raise FileLocation(path, f"line {number}").error(
            f"a line of {longest:,} bytes is too long: at most {MAX_LINE:,} are read"
        )
    if comment is not None and comment in data:
        lines = [line.split(comment, 1)[0] if comment in line else line for line in lines]
    lines = [line.strip() for line in lines]
    # The numbers of the lines in the file, which stay when blank lines are left out.
    numbers: Sequence[int] = range(first, first + len(lines))
    if not all(lines):
        numbers = [number for number, line in zip(numbers, lines, strict=True) if line]
        lines = [line for line in lines if line]
    return TextLines(lines, FileLocations(path, "line", numbers))


def parse_finite(word: bytes, place: FileLocation) -> float:
    """Return the finite number that a word of a text file stands for. place: the word's location,
    for the error.

    Raises:
        FileFormatError: the word is not a finite number.
    """
    try:
        value = float(b"" if b"_" in word else word)  # Python reads 1_0 as 10
    except ValueError:
        raise place.error(f"{excerpt(word)} is not a number") from None
    if not math.isfinite(value):
        raise place.error(f"coordinates must be finite, not {excerpt(word)}")
    return value


def parse_any_number(word: bytes, place: FileLocation) -> float:
    """Return the number that a word of a text file stands for, also NaN or infinite. place: the
    word's location, for the error.

    Raises:
        FileFormatError: the word is not a number.
    """
    try:
        return float(b"" if b"_" in word else word)  # Python reads 1_0 as 10
    except ValueError:
        raise place.error(f"{excerpt(word)} is not a number") from None


def parse_vertex_index(word: bytes, place: FileLocation) -> int:
    """Return the integer that a word of a text file stands for, small enough for the index of a
    vertex. place: the word's location, for the error.

    Raises:
        FileFormatError: the word is not such an integer.
    """
    try:
        value = int(b"" if b"_" in word else word)  # Python reads 1_0 as 10; int(b"") fails
    except ValueError:
        # Some programs write 3 as 3.000e+00.
        if not _is_integral(word):
            raise place.error(f"{excerpt(word)} is not an integer") from None
        value = int(float(word))
    # It must fit into 64 bits, also after numbers of vertices were added.
    if abs(value) >= 2**62:
        raise place.error(f"vertex {value} is out of range: no file has as many")
    return value


def _is_integral(word: bytes) -> bool:
    """Return whether a word of a text file is a number whose value is an integer, such as
    3.000e+00."""
    try:
        return b"_" not in word and float(word).is_integer()
    except ValueError:
        return False


def excerpt(word: bytes) -> str:
    """Return a word from a file in quotes, as it is shown in messages: shortened if it is long, and
    with unprintable characters escaped."""
    shown = word[:32].decode("ascii", "backslashreplace")
    return repr(shown + ("..." if len(word) > 32 else ""))


def read_table(
    lines: TextLines,
    columns: int,
    *,
    too_few_message: str = "{} numbers are too few: {} are expected",
) -> FloatArray:
    """Read a table (n, columns) of finite numbers: the first `columns` words of each of n lines.
    Further words of a line are ignored.

    too_few_message: the error message for a line with fewer words.

    Raises:
        FileFormatError: naming the first line with too few numbers, or with a word that is not a
            finite number.
    """
    table = _parse_with_numpy(lines, range(columns))
    if table is not None and np.isfinite(table).all():
        return table
    # Word by word, to find the first wrong word, or for lines with too few.
    numbers: list[float] = []
    for k, line in enumerate(lines.text):
        words, place = line.split()[:columns], lines.locations[k]
        if len(words) < columns:
            raise place.error(too_few_message.format(len(words), columns))
        numbers += [parse_finite(word, place) for word in words]
    return np.array(numbers, dtype=np.float64).reshape(-1, columns)


def read_floats(
    lines: TextLines, *, convert: Callable[[bytes, FileLocation], float] = parse_finite
) -> tuple[FloatArray, IntArray]:
    """Return the numbers in all words of n lines, as one array, line after line; and the number
    (n,) of words of each line.

    convert: a function that converts a word to a number or raises an error. It is called only if
        not all words are finite numbers.

    Raises:
        FileFormatError: `convert` raises it for some word.
    """
    table = _parse_with_numpy(lines)
    if table is not None and np.isfinite(table).all():
        return table.ravel(), _row_lengths(table)
    return _parse_words(lines, float, convert)


def read_integers(lines: TextLines) -> tuple[IntArray, IntArray]:
    """Return the integers in all words of n lines, as one array, line after line; and the number
    (n,) of words of each line.

    Raises:
        FileFormatError: some word is not an integer; the message names the line of the first one.
    """
    # NumPy reads floating-point numbers; if they are whole and below 2^53, they are exact.
    table = _parse_with_numpy(lines)
    if table is not None and (np.abs(table) < 2.0**53).all() and (table == np.rint(table)).all():
        return table.astype(np.int64).ravel(), _row_lengths(table)
    return _parse_words(lines, int, parse_vertex_index)


def _parse_with_numpy(lines: TextLines, columns: Sequence[int] | None = None) -> FloatArray | None:
    """Return the numbers of n lines with k words each as a table (n, k), parsed by NumPy, which is
    fast. None if that fails, because some word is not a number, or because lines have different
    numbers of words.

    columns: the columns to read; None for all.
    """
    # NumPy would read 1_0 as 10.
    if not len(lines) or b"_" in b"\n".join(lines.text):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            table = np.loadtxt(
                lines.text, np.float64, comments=None, usecols=columns, ndmin=2, encoding="latin1"
            )
    except (ValueError, UserWarning):
        return None
    return table if len(table) == len(lines) else None  # NumPy skips blank lines


def _row_lengths(table: FloatArray) -> IntArray:
    """Return how many words each line has, for lines that were read as a rectangular table (n, k):
    an array (n,) filled with k. `read_floats` and `read_integers` return such an array for lines of
    any lengths."""
    return np.full(len(table), table.shape[1], dtype=np.int64)


def _parse_words(
    lines: TextLines, kind: type[_Number], convert: Callable[[bytes, FileLocation], _Number]
) -> tuple[npt.NDArray[Any], IntArray]:
    """Parse n lines word by word, also if they have different numbers of words. Returns the numbers
    of all lines as one array; and the number (n,) of words of each line.

    kind: float or int, by which all words are converted, if that succeeds.
    convert: a function that converts a word, or raises an error for an invalid one. It is slower,
        and is called for every word if `kind` fails for one, or gives a number that is not finite.
    """

    def slow_numbers() -> Iterator[_Number]:
        """Yield the number of each word, converted by `convert`."""
        for k, line in enumerate(lines.text):
            place = lines.locations[k]
            for word in line.split():
                yield convert(word, place)

    counts = np.fromiter((len(line.split()) for line in lines.text), np.int64)
    try:
        # First the fast way: Python's own conversion of all words.
        words = chain.from_iterable(map(bytes.split, lines.text))
        numbers = np.fromiter(map(kind, words), np.dtype(kind))
        if np.isfinite(numbers).all():
            return numbers, counts
    except (ValueError, OverflowError):
        pass
    return np.fromiter(slow_numbers(), np.dtype(kind)), counts
