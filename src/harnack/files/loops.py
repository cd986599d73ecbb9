"""Reading closed curves from files."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import Contents, FileFormatError, Place, read_bytes
from harnack.files.obj import read_obj
from harnack.files.plain_text import read_loops_text
from harnack.files.ply import read_ply
from harnack.geometry.chains import Edge, OpenChainError, boundary_edges, join
from harnack.geometry.curves import CurveError, validate_loops
from harnack.geometry.singular import weld_vertices

__all__ = ["loops_in", "read_loops"]

PlacedLoop = tuple[FloatArray, Place]

_LOOP_READERS: dict[str, Callable[[Path, bytes], Contents]] = {".obj": read_obj, ".ply": read_ply}


def read_loops(path: str | os.PathLike[str], *, boundary: bool = False) -> list[FloatArray]:
    """The closed curves in an .obj, .ply or .loops file, as arrays (n, 3).

    .obj: every `f` face is a loop, every `l` polyline that ends at its first vertex is one, and
    all other `l` polylines are joined end to end. .ply: every face is a loop, edges are joined;
    a file with vertices only is one loop in their order. .loops: one loop a line, x y z
    repeated. Where edges are joined, equal positions count as one vertex.

    boundary: not the faces, but the boundary of the surface they form: the edges that do not
    cancel between neighboring faces, equal positions counted as one vertex.

    Raises:
        FileFormatError: unreadable, malformed or hostile; open polylines; a loop that
            `validate_loops` rejects; a closed surface, which has no boundary.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_LOOP_READERS, ".loops"):
        raise FileFormatError(f"{path}: curves are read from .obj, .ply and .loops files")
    data = read_bytes(path)
    if kind == ".loops":
        if boundary:
            raise FileFormatError(f"{path}: a .loops file has no faces to take the boundary of")
        return [_validated(loop, place) for loop, place in read_loops_text(path, data)]
    return loops_in(_LOOP_READERS[kind](path, data), boundary=boundary)


def loops_in(contents: Contents, *, boundary: bool = False) -> list[FloatArray]:
    """The closed curves in an .obj or .ply file that was read, as `read_loops` has them."""
    placed = _boundary_loops(contents) if boundary else _all_loops(contents)
    return [_validated(loop, place) for loop, place in placed]


def _validated(loop: FloatArray, place: Place) -> FloatArray:
    try:
        return validate_loops(loop)[0]
    except CurveError as error:
        raise place.error(str(error)) from error


def _all_loops(contents: Contents) -> list[PlacedLoop]:
    x = contents.vertices
    loops = [(x[corners], place) for corners, place in contents.faces]
    if len(contents.polylines):
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
    for corners, place in contents.polylines:
        ids: list[int] = same[corners].tolist()
        if ids[0] == ids[-1] and len(ids) > 3:
            loops.append((x[ids[:-1]], place))
            continue
        for edge in itertools.pairwise(ids):
            if edge[0] == edge[1]:
                raise place.error(f"two vertices in a row are both {x[edge[0]].tolist()}")
            open_edges.append(edge)
        places.update(dict.fromkeys(ids, place))
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
    if not len(contents.faces):
        raise place.error("it has no faces to take the boundary of")
    same = weld_vertices(contents.vertices)
    remaining = boundary_edges(
        same[corners].tolist() for corners, _ in contents.faces if len(corners)
    )
    if not remaining:
        raise place.error("its faces form a closed surface, which has no boundary")
    return [(contents.vertices[np.array(ids)], place) for ids in join(remaining)]
