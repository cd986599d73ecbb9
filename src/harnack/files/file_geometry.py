"""What all readers and writers of files share: errors and locations in files, limits, the geometry
that a file holds, and atomic writing (a file appears complete or not at all).
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import tempfile
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend import FloatArray, IntArray

__all__ = ["check_writable", "write_atomically"]

MAX_BYTES = 1 << 28
# The largest number of elements in files whose elements are read one by one, some microseconds
# each.
MAX_ELEMENTS = 10_000_000


class FileFormatError(ValueError):
    """The error for a file that cannot be read. The message names the file, the location of the
    fault and what to do."""


@dataclass(frozen=True)
class FileLocation:
    """A location in a file, which prints as 'model.obj, line 12'. position: where in the file, such
    as "line 12"; "" for the whole file."""

    path: Path
    position: str = ""

    def __str__(self) -> str:
        # A name may contain line ends and control characters, which a terminal would execute.
        name = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(self.path))
        return f"{name}, {self.position}" if self.position else name

    def error(self, message: str) -> FileFormatError:
        """Return an error whose message begins with this location."""
        return FileFormatError(f"{self}: {message}")


@dataclass(frozen=True, eq=False)
class FileLocations:
    """The locations in a file of all members of a list, such as of all vertices. Index k gives the
    `FileLocation` of member k.

    noun: the word before the number in messages, such as "line" in "line 12".
    numbers: for each member, the number of its line, or its position in the file.
    """

    path: Path
    noun: str
    numbers: Sequence[int]

    def __getitem__(self, k: int | np.integer[Any]) -> FileLocation:
        return FileLocation(self.path, f"{self.noun} {self.numbers[int(k)]}")


@dataclass(frozen=True, eq=False)
class PolygonList:
    """Polygons or polylines of a file, as indices of vertices.

    corners: the vertex indices of all polygons, one polygon after the other.
    sizes: (m,) the number of corners of each polygon.
    locations: (m,) the location of each polygon in the file.
    """

    corners: IntArray
    sizes: IntArray
    locations: FileLocations

    def __len__(self) -> int:
        return len(self.sizes)

    def location_of_corner(self, k: int | np.integer[Any]) -> FileLocation:
        """Return the location in the file of the polygon that contains `corners[k]`."""
        return self.locations[int(np.searchsorted(np.cumsum(self.sizes), k, side="right"))]

    def __iter__(self) -> Iterator[tuple[IntArray, FileLocation]]:
        """Yield the corners (k,) and the location of each polygon."""
        ends = np.cumsum(self.sizes)
        for k, (begin, end) in enumerate(zip(ends - self.sizes, ends, strict=True)):
            yield self.corners[begin:end], self.locations[k]


_NO_INDICES = np.zeros(0, dtype=np.int64)
NO_POLYGONS = PolygonList(_NO_INDICES, _NO_INDICES, FileLocations(Path(), "", ()))


@dataclass(frozen=True, eq=False)
class FileGeometry:
    """The geometry that a file holds.

    path: of the file.
    vertices: (n, 3), finite.
    normals: (n, 3) normals of the vertices, or None.
    faces: closed polygons; the last corner of each is joined to the first.
    polylines: chains of edges, each closed only if its last index equals its first.
    notes: short texts about what the file holds and is not used, for the summary of a point cloud.

    All indices lie in [0, n).
    """

    path: Path
    vertices: FloatArray
    normals: FloatArray | None = None
    faces: PolygonList = NO_POLYGONS
    polylines: PolygonList = NO_POLYGONS
    notes: tuple[str, ...] = ()


def triangles_as_polygons(path: Path, corners: IntArray) -> PolygonList:
    """Return triangles as a `PolygonList`. corners: (m, 3) their vertex indices, which were read
    from the file `path`."""
    sizes = np.full(len(corners), 3, dtype=np.int64)
    return PolygonList(corners.ravel(), sizes, FileLocations(path, "triangle", range(len(corners))))


@contextlib.contextmanager
def errors_of_library(place: FileLocation, kind: str) -> Generator[None, None, None]:
    """A context in which any error, such as libraries raise for malformed files, becomes a
    FileFormatError that says that `place` is no sound file of this kind; warnings are silenced."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (FileFormatError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    # Libraries that are written in Rust raise a BaseException where they find a fault of their own.
    except BaseException as error:
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise place.error(f"it is no sound {kind} file ({reason[0][:120]})") from None


def placed_mesh(geometry: Any, matrix: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the vertices (n, 3) of a mesh or of points that trimesh read, moved by the transform
    `matrix` (4, 4); and the faces (m, 3), reversed if the transform makes a mirror image."""
    x = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), np.int64)
    return x, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def joined_meshes(path: Path, meshes: list[tuple[FloatArray, IntArray]]) -> FileGeometry:
    """Return meshes, given by vertices (n, 3) and faces (m, 3), as the geometry of the file `path`
    from which they were read."""
    import trimesh  # here, since it takes half a second

    append_faces: Any = trimesh.util.append_faces
    x, faces = append_faces(*zip(*meshes, strict=True))
    return FileGeometry(path, x, faces=triangles_as_polygons(path, faces))


def check_finite(coordinates: FloatArray, places: FileLocations) -> None:
    """Raise a FileFormatError if a number in an array `coordinates` (n, k) is not finite. The
    message names the location of the first such row. places: the locations of the rows."""
    wrong = np.flatnonzero(~np.isfinite(coordinates).all(axis=1))
    if wrong.size:
        raise places[wrong[0]].error("coordinates must be finite")


def check_indices(polygons: PolygonList, count: int, *, first: int = 0) -> None:
    """Raise a FileFormatError if a vertex index of the polygons is outside of [0, count). The
    message names the first such index and its location.

    count: the number of vertices.
    first: the index that the file's format gives to the first vertex (0 or 1), for the message.
    """
    corners = polygons.corners
    wrong = np.flatnonzero((corners < 0) | (corners >= count))
    if wrong.size:
        raise polygons.location_of_corner(wrong[0]).error(
            f"vertex {corners[wrong[0]] + first} is out of range: the file has {count:,} vertices"
        )


def read_bytes(path: Path) -> bytes:
    """Return all bytes of a file.

    Raises:
        FileFormatError: the file is missing, a directory or a device, unreadable, empty, or larger
            than 256 MiB.
    """
    place = FileLocation(path)
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


def check_element_count(place: FileLocation, count: int) -> None:
    """Raise a FileFormatError if a file has more than MAX_ELEMENTS elements. It is called for files
    whose elements are read one by one, which takes long. place: the location that the message
    names. count: the number of vertices, faces and lines that the file declares."""
    if count > MAX_ELEMENTS:
        raise place.error(
            f"{count:,} elements are too many in a file whose faces differ in size: at most "
            f"{MAX_ELEMENTS:,} are read; let the program that made it triangulate them"
        )


def have_mixed_sizes(polygons: PolygonList) -> bool:
    """Return whether polygons have different numbers of corners, or fewer than three. Such polygons
    are read one by one, which takes long."""
    sizes = polygons.sizes
    # All sizes must be that of the first polygon, and at least 3.
    return bool(len(sizes)) and bool((sizes != max(3, int(sizes[0]))).any())


# Writing files so that no partial file remains.


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """Context manager that yields a temporary name to write to, in the folder of `path`. At the end
    of the block, the file is renamed to `path`.

    If the block raises, nothing is left and an existing file stays as it was. The name has the
    extension of `path`, from which many writers derive the format.

    Raises:
        FileNotFoundError: the folder does not exist, or the block wrote no file.
        IsADirectoryError: `path` is a directory.
        OSError: `path` is a device or a pipe; or the system refuses to write, as when the disk is
            full. The message names the file, why, and what to do.
    """
    target = _writable_target(path)
    partial = _partial_name(target)
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial)):
            raise  # an error about another file
        raise _write_error(path, error) from error
    finally:
        try:
            _remove(partial)
        except KeyboardInterrupt:  # it may have come before the file was removed
            _remove(partial)
            raise


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that `write_atomically` can write to `path`: raise the errors that it would raise
    before its block runs, and try to create a file there."""
    target = _writable_target(path)
    try:
        # Where the system can, this file has no name that an interrupt could leave behind.
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise _write_error(path, error) from error


def _writable_target(path: str | os.PathLike[str]) -> Path:
    """Return the file to which `path` leads if symbolic links are followed. Raises an OSError if a
    file cannot be written there."""
    cannot = f"cannot write {_printable_path(path)}"
    try:
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise FileNotFoundError(
                f"{cannot}: create the folder {_printable_path(target.parent)} first"
            )
        if target.is_dir():
            raise IsADirectoryError(f"{cannot}: it is a directory, name a file in it")
        if target.exists() and not target.is_file():
            raise OSError(f"{cannot}: it is a device or a pipe, name an ordinary file")
    except ValueError as error:  # a NUL character in the name
        raise ValueError(f"{str(path)!r} is no name of a file: {error}") from None
    except OSError as error:
        if error.errno is None:
            raise
        raise _write_error(path, error) from error
    return target


def _remove(partial: Path) -> None:
    """Remove the file `partial` if it exists."""
    if os.path.lexists(partial):
        partial.unlink()


def _partial_name(target: Path) -> Path:
    """Return a random name, in the folder of `target`, for the file that is written first and then
    renamed to `target`. If the target's name is long, this name is not longer, so that the file
    system accepts it as well."""
    token = f".{secrets.token_hex(4)}.partial"
    # The stem is cut by the bytes of the token and of the dot before it.
    stem = os.fsencode(target.stem)
    prefix = os.fsdecode(stem[: max(0, len(stem) - len(token) - 1)])
    return target.with_name(f".{prefix}{token}{target.suffix}")


_WRITE_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space, or write to another disk",
    errno.EDQUOT: "your share of the disk is used up; free some space, or write to another disk",
    errno.EACCES: "you may not write in its folder; name another one",
    errno.EPERM: "you may not write in its folder; name another one",
    errno.EROFS: "its disk can only be read; name a folder on another one",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
    errno.EFBIG: "it would be larger than files may be here; write to another disk",
}


def _printable_path(path: str | os.PathLike[str]) -> str:
    """Return the path for messages, with unprintable characters escaped."""
    return str(FileLocation(Path(path)))


def _write_error(path: str | os.PathLike[str], error: OSError) -> OSError:
    """Return an error of the same type as `error`, whose message says that the file `path` could
    not be written, why, and what to do."""
    number = error.errno
    reason = _WRITE_ADVICE.get(number or 0) or f"{error.strerror or error}; name a file elsewhere"
    write_error = type(error)(f"cannot write {_printable_path(path)}: {reason}")
    write_error.errno = number
    return write_error
