"""Reading loops from files, and writing files so that none is ever left half done."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import secrets
import tempfile
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np

from harnack.files.file_format import Contents, FileFormatError, Place, read_bytes
from harnack.files.loops_text import read_loops_text
from harnack.files.obj import read_obj
from harnack.files.ply import read_ply
from harnack.geometry.chains import Edge, OpenChainError, boundary_edges, join
from harnack.geometry.convex_volume import FloatArray
from harnack.geometry.curves import CurveError, validate_loops
from harnack.geometry.singular import weld_vertices

__all__ = ["FileFormatError", "check_writable", "read_loops", "write_atomically"]

PlacedLoop = tuple[FloatArray, Place]

_READERS: dict[str, Callable[[Path, bytes], Contents]] = {".obj": read_obj, ".ply": read_ply}


def read_loops(path: str | os.PathLike[str], *, boundary: bool = False) -> list[FloatArray]:
    """The closed curves in an .obj, .ply or .loops file, as arrays (n, 3).

    .obj: every `f` face is a loop, every `l` polyline that ends at its first vertex is one, and
    all other `l` polylines are joined end to end. .ply: every face is a loop, edges are joined;
    a file with vertices only is one loop in their order. .loops: one loop a line, x y z
    repeated. Where edges are joined, equal positions count as one vertex.

    boundary: not the faces, but the boundary of the surface they form: the edges that do not
    cancel between neighbouring faces, equal positions counted as one vertex.

    Raises:
        FileFormatError: unreadable, malformed or hostile; open polylines; a loop that
            `validate_loops` rejects; a closed surface, which has no boundary.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_READERS, ".loops"):
        raise FileFormatError(f"{path}: curves are read from .obj, .ply and .loops files")
    data = read_bytes(path)
    if kind == ".loops":
        if boundary:
            raise FileFormatError(f"{path}: a .loops file has no faces to take the boundary of")
        placed = read_loops_text(path, data)
    else:
        contents = _READERS[kind](path, data)
        placed = _boundary_loops(contents) if boundary else _all_loops(contents)
    return [_validated(loop, place) for loop, place in placed]


def _validated(loop: FloatArray, place: Place) -> FloatArray:
    try:
        return validate_loops(loop)[0]
    except CurveError as error:
        raise place.error(str(error)) from error


def _all_loops(contents: Contents) -> list[PlacedLoop]:
    x = contents.vertices
    loops = [(x[list(face.indices)], face.place) for face in contents.faces]
    if contents.polylines:
        loops += _joined_polylines(contents)
    if not loops and contents.path.suffix.lower() == ".ply" and len(x):
        loops.append((x, Place(contents.path)))
    if not loops:
        raise Place(contents.path).error("it holds no faces or polylines to make curves of")
    return loops


def _joined_polylines(contents: Contents) -> list[PlacedLoop]:
    x, same = contents.vertices, weld_vertices(contents.vertices)
    loops: list[PlacedLoop] = []
    open_edges: list[Edge] = []
    places: dict[int, Place] = {}
    for line in contents.polylines:
        ids = [int(same[k]) for k in line.indices]
        if ids[0] == ids[-1] and len(ids) > 3:
            loops.append((x[ids[:-1]], line.place))
            continue
        for edge in itertools.pairwise(ids):
            if edge[0] == edge[1]:
                raise line.place.error(f"two vertices in a row are both {x[edge[0]].tolist()}")
            open_edges.append(edge)
        places.update(dict.fromkeys(ids, line.place))
    try:
        joined = join(open_edges)
    except OpenChainError as error:
        raise places[error.vertex].error(_open_message(error, x[error.vertex])) from None
    return loops + [(x[ids], places[ids[0]]) for ids in joined]


def _open_message(error: OpenChainError, position: FloatArray) -> str:
    point = position.tolist()
    if error.count == 1:
        return (
            f"the polyline that ends at {point} is open: to close it, end it with its first "
            "vertex or add the missing segment"
        )
    return (
        f"{error.count} segments meet at {point}: two must meet at every vertex of a closed "
        "curve, or as many begin there as end"
    )


def _boundary_loops(contents: Contents) -> list[PlacedLoop]:
    place = Place(contents.path)
    if not contents.faces:
        raise place.error("it has no faces to take the boundary of")
    same = weld_vertices(contents.vertices)
    remaining = boundary_edges(same[list(face.indices)].tolist() for face in contents.faces)
    if not remaining:
        raise place.error("its faces form a closed surface, which has no boundary")
    return [(contents.vertices[np.array(ids)], place) for ids in join(remaining)]


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """A name to write to, in the folder of `path`, that becomes `path` when the block ends.

    If the block raises, nothing is left and an existing file stays as it was. The name has the
    extension of `path`, from which many writers tell the format.

    Raises:
        FileNotFoundError: the folder does not exist, or the block wrote no file.
        IsADirectoryError: `path` is a directory.
        OSError: `path` is a device or a pipe; or the system refuses to write, as where the disk
            is full. The message names the file, why, and what to do.
    """
    target = _writable_target(path)
    partial = _partial_name(target)
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial)):
            raise  # about something else than this file
        raise _write_error(path, error) from error
    finally:
        try:
            _remove(partial)
        except KeyboardInterrupt:
            _remove(partial)
            raise


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise what `write_atomically` would raise at once, and try to create a file there."""
    target = _writable_target(path)
    try:
        # Where the system can, this file has no name that an interrupt could leave behind.
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise _write_error(path, error) from error


def _writable_target(path: str | os.PathLike[str]) -> Path:
    """The file that `path` names, links followed."""
    cannot = f"cannot write {_name(path)}"
    try:
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise FileNotFoundError(f"{cannot}: create the folder {_name(target.parent)} first")
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
    if os.path.lexists(partial):
        partial.unlink()


def _partial_name(target: Path) -> Path:
    # As long as the target's name if that is long, so that it is allowed where the target's is.
    token = f".{secrets.token_hex(4)}.partial"
    stem = os.fsencode(target.stem)
    kept = os.fsdecode(stem[: max(0, len(stem) - len(token) - 1)])
    return target.with_name(f".{kept}{token}{target.suffix}")


_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space, or write to another disk",
    errno.EDQUOT: "your share of the disk is used up; free some space, or write to another disk",
    errno.EACCES: "you may not write in its folder; name another one",
    errno.EPERM: "you may not write in its folder; name another one",
    errno.EROFS: "its disk can only be read; name a folder on another one",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
    errno.EFBIG: "it would be larger than files may be here; write to another disk",
}


def _name(path: str | os.PathLike[str]) -> str:
    return str(Place(Path(path)))


def _write_error(path: str | os.PathLike[str], error: OSError) -> OSError:
    """The error that says which file could not be written, why, and what to do."""
    number = error.errno
    why = _ADVICE.get(number or 0) or f"{error.strerror or error}; name a file elsewhere"
    explained = type(error)(f"cannot write {_name(path)}: {why}")
    explained.errno = number
    return explained
