"""What all file readers share: the error, reading with a limit, and what was found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from harnack.geometry.convex_volume import FloatArray

MAX_BYTES = 1 << 28
MAX_LINE = 1 << 24
# Of files that are read element by element, which takes some 200 bytes and 3 microseconds each.
MAX_ELEMENTS = 10_000_000


class FileFormatError(ValueError):
    """A file that cannot be read; the message names the file, the place and what to do."""


@dataclass(frozen=True)
class Place:
    """Where in a file something stands: prints as 'model.obj, line 12'."""

    path: Path
    where: str = ""

    def __str__(self) -> str:
        # A name may hold line ends and other characters that a terminal would obey.
        name = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(self.path))
        return f"{name}, {self.where}" if self.where else name

    def error(self, message: str) -> FileFormatError:
        """An error about this place."""
        return FileFormatError(f"{self}: {message}")


@dataclass(frozen=True)
class Element:
    """A polygon or polyline: indices of vertices, and where it stands in the file."""

    indices: tuple[int, ...]
    place: Place


@dataclass(frozen=True)
class Contents:
    """The geometry in a file.

    vertices: (n, 3), finite. faces: closed, last vertex joined to first. polylines: as listed,
    closed only if the last index is the first. All indices lie in [0, n).
    """

    path: Path
    vertices: FloatArray
    faces: tuple[Element, ...]
    polylines: tuple[Element, ...]


def read_bytes(path: Path) -> bytes:
    """All bytes of a file.

    Raises:
        FileFormatError: missing, a directory or a device, unreadable, empty, above 256 MiB.
    """
    place = Place(path)
    try:
        if not path.exists():
            if path.is_symlink():
                raise place.error("this is a link that leads to no file")
            raise place.error("there is no such file")
        if path.is_dir():
            raise place.error("this is a directory, not a file")
        if not path.is_file():
            raise place.error("this is not an ordinary file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise place.error(f"{size:,} bytes are too many: at most {MAX_BYTES:,} are read")
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the name
        if isinstance(error, FileFormatError):
            raise
        raise place.error(f"it cannot be read ({error})") from None
    if not data.strip():
        raise place.error("the file is empty")
    return data


def check_element_count(place: Place, count: int) -> None:
    """Raise FileFormatError for more than MAX_ELEMENTS vertices, faces and lines."""
    if count > MAX_ELEMENTS:
        raise place.error(
            f"{count:,} elements are too many in a file whose faces differ in size: at most "
            f"{MAX_ELEMENTS:,} are read; let the program that made it triangulate them"
        )


def text_lines(path: Path, data: bytes, *, first: int = 1) -> list[bytes]:
    """Lines of a text file, without line ends and byte order mark.

    first: number of the first line, for messages.

    Raises:
        FileFormatError: it holds binary data, or a line above 16 MiB.
    """
    if b"\0" in data:
        raise Place(path).error("this is binary data, not the text that its extension announces")
    lines = data.removeprefix(b"\xef\xbb\xbf").splitlines()
    for number, line in enumerate(lines, first):
        if len(line) > MAX_LINE:
            raise Place(path, f"line {number}").error(
                f"a line of {len(line):,} bytes is too long: at most {MAX_LINE:,} are read"
            )
    return lines


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
    """An integer.

    Raises:
        FileFormatError: it is not one.
    """
    try:
        return int(word)
    except ValueError:
        raise place.error(f"{excerpt(word)} is not an integer") from None


def excerpt(word: bytes) -> str:
    """A word from a file, short and printable, in quotes."""
    shown = word[:32].decode("ascii", "backslashreplace")
    return repr(shown + ("..." if len(word) > 32 else ""))
