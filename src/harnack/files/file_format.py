"""What all file readers share: the error, reading with a limit, and what was found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend import FloatArray, IntArray

MAX_BYTES = 1 << 28
# Of files that must be gone through element by element, up to some microseconds each.
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


@dataclass(frozen=True, eq=False)
class Places:
    """Where the members of a list stand in a file. numbers: one a member, of lines or the like."""

    path: Path
    noun: str
    numbers: Sequence[int]

    def __getitem__(self, k: int | np.integer[Any]) -> Place:
        return Place(self.path, f"{self.noun} {self.numbers[int(k)]}")


@dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons or polylines of a file, as indices of vertices.

    corners: those of all of them, one polygon after the other. sizes: (m,), how many each has.
    places: (m,), where each stands in the file.
    """

    corners: IntArray
    sizes: IntArray
    places: Places

    def __len__(self) -> int:
        return len(self.sizes)

    def place_of(self, k: int | np.integer[Any]) -> Place:
        """Where the polygon stands to which corner k of all belongs."""
        return self.places[int(np.searchsorted(np.cumsum(self.sizes), k, side="right"))]

    def __iter__(self) -> Iterator[tuple[IntArray, Place]]:
        """The corners of each, and where it stands."""
        ends = np.cumsum(self.sizes)
        for k, (begin, end) in enumerate(zip(ends - self.sizes, ends, strict=True)):
            yield self.corners[begin:end], self.places[k]


_NONE = np.zeros(0, dtype=np.int64)
NO_POLYGONS = Polygons(_NONE, _NONE, Places(Path(), "", ()))


@dataclass(frozen=True, eq=False)
class Contents:
    """The geometry in a file.

    vertices: (n, 3), finite. normals: (n, 3) or none. faces: closed, last vertex joined to first.
    polylines: as listed, closed only if the last index is the first. All indices lie in [0, n).
    """

    path: Path
    vertices: FloatArray
    normals: FloatArray | None = None
    faces: Polygons = NO_POLYGONS
    polylines: Polygons = NO_POLYGONS


def positions(sizes: IntArray) -> IntArray:
    """Positions within lists that stand one after the other: 0 to size - 1 for each of them."""
    found = np.arange(int(sizes.sum()), dtype=np.int64)
    found -= np.repeat(np.cumsum(sizes) - sizes, sizes)
    return found


def triangle_list(path: Path, corners: IntArray) -> Polygons:
    """Triangles (m, 3) as polygons."""
    sizes = np.full(len(corners), 3, dtype=np.int64)
    return Polygons(corners.ravel(), sizes, Places(path, "triangle", range(len(corners))))


def check_finite(coordinates: FloatArray, places: Places) -> None:
    """Raise FileFormatError for the first row (n, k) with a number that is not finite."""
    wrong = np.flatnonzero(~np.isfinite(coordinates).all(axis=1))
    if wrong.size:
        raise places[wrong[0]].error("coordinates must be finite")


def check_indices(polygons: Polygons, count: int, *, first: int = 0) -> None:
    """Raise FileFormatError for the first index outside of [0, count).

    first: the index that the file gives its first vertex, for messages.
    """
    corners = polygons.corners
    wrong = np.flatnonzero((corners < 0) | (corners >= count))
    if wrong.size:
        raise polygons.place_of(wrong[0]).error(
            f"vertex {corners[wrong[0]] + first} is out of range: the file has {count:,} vertices"
        )


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


def differ_in_size(polygons: Polygons) -> bool:
    """Whether polygons have different numbers of corners, or fewer than three."""
    sizes = polygons.sizes
    return bool(len(sizes)) and bool((sizes != max(3, int(sizes[0]))).any())
