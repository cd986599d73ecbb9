"""Closed polygonal curves in space: what is accepted, and their simplest measures.

A loop is an array (n, 3) of vertices; its last vertex is joined to its first. A curve is a
tuple of loops, which may be knotted, linked, nested or cross each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from harnack.backend.numbers import (
    TRANSPOSE,
    FloatArray,
    and_more,
    check_finite,
    check_vectors,
    real_array,
    vector_text,
)
from harnack.geometry.circles import Circle
from harnack.geometry.convexity import is_convex_position

__all__ = [
    "CurveError",
    "CurveScaleError",
    "CurveShapeError",
    "Loops",
    "LoopsLike",
    "NonFiniteVertexError",
    "RepeatedVertexError",
    "TooFewVerticesError",
    "TooManyVerticesError",
    "bounding_box",
    "edges",
    "is_convex_position",
    "total_length",
    "validate_curves",
    "validate_loops",
]

MAX_VERTICES = 10_000_000

Loops: TypeAlias = tuple[FloatArray, ...]
LoopsLike: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]


class CurveError(ValueError):
    """A curve that cannot be used; the message says why and what to do."""


class CurveShapeError(CurveError):
    """Not numbers of shape (n, 3), or a list of such arrays."""


class NonFiniteVertexError(CurveError):
    """A vertex with a NaN or infinite coordinate."""


class TooFewVerticesError(CurveError):
    """Fewer than three different vertices."""


class TooManyVerticesError(CurveError):
    """More than MAX_VERTICES vertices."""


class RepeatedVertexError(CurveError):
    """Two equal vertices in a row."""


class CurveScaleError(CurveError):
    """So large or small that lengths overflow or vanish."""


def validate_loops(loops: LoopsLike) -> Loops:
    """One array-like (n, 3), or a list of them, as a tuple of float64 arrays of their own.

    A loop closes by itself. If its last vertex repeats its first, that one is dropped; any other
    vertex equal to the one before it is an error. Edges that fold back on themselves are allowed.

    Raises:
        CurveError: one of its subclasses above, by what is wrong.
    """
    parts = _as_list(loops)
    if not parts:
        raise CurveShapeError("there are no loops: give an array (n, 3) or a list of them")
    several = len(parts) > 1
    checked = [_validate_loop(part, f"loop {k}" if several else "the loop") for k, part in parts]
    total = sum(len(loop) for loop in checked)
    if total > MAX_VERTICES:
        raise TooManyVerticesError(_too_many("the curve", total))
    return tuple(checked)


def validate_curves(curves: Any) -> tuple[Loops, tuple[Circle, ...]]:
    """Closed curves as loops of vertices and circles: what `validate_loops` accepts, a `Circle`, or
    a list in which each entry is one of the two.

    Raises:
        CurveError: as `validate_loops`.
    """
    if isinstance(curves, Circle):
        return (), (curves,)
    parts = _as_parts(curves)
    if not any(isinstance(one, Circle) for one in parts):
        return validate_loops(curves), ()
    circles = tuple(one for one in parts if isinstance(one, Circle))
    loops = [
        _validate_loop(one, f"loop {k}")
        for k, one in enumerate(parts)
        if not isinstance(one, Circle)
    ]
    total = sum(len(loop) for loop in loops)
    if total > MAX_VERTICES:
        raise TooManyVerticesError(_too_many("the curve", total))
    return tuple(loops), circles


def _as_parts(curves: Any) -> list[Any]:
    """The entries of a list or tuple; none of anything else."""
    return list(curves) if isinstance(curves, list | tuple) else []  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]


def _as_list(loops: Any) -> list[tuple[int, Any]]:
    """Numbered loops. A list is a list of loops if its entries' entries are points."""
    try:
        whole = np.asarray(loops)
    except ValueError:  # loops of different lengths, or points of different lengths
        if any(_is_point(part) for part in loops):
            raise CurveShapeError("every vertex needs three coordinates: some differ") from None
        return _numbered(loops)
    if whole.ndim == 3:
        return _numbered(whole)
    if whole.dtype == object and whole.ndim == 1 and len(whole):  # so does older NumPy
        return _numbered(whole)
    if whole.ndim == 1 and whole.size == 0:
        return []
    return [(0, whole)]


def _is_point(part: Any) -> bool:
    try:
        return np.ndim(part) == 1
    except ValueError:
        return False


def _numbered(loops: Any) -> list[tuple[int, Any]]:
    return [(k, loop) for k, loop in enumerate(loops)]


def _validate_loop(loop: Any, name: str) -> FloatArray:
    vertices = _as_vertices(loop, name)
    check_finite(vertices, f"vertex {{}} of {name}", NonFiniteVertexError)
    if len(vertices) > 1 and (vertices[0] == vertices[-1]).all():
        vertices = vertices[:-1]
    distinct = _count_distinct(vertices)
    if distinct < 3:
        raise TooFewVerticesError(
            f"{name} has {distinct} different vertices: a closed curve needs at least 3"
        )
    _check_edges(vertices, name)
    return vertices


def _as_vertices(loop: Any, name: str) -> FloatArray:
    ragged = "is ragged: every vertex needs three coordinates"
    array = real_array(loop, name, CurveShapeError, ragged=ragged)
    planar = "; append a column of zeros to a planar curve"
    check_vectors(array, name, CurveShapeError, planar=planar, transposed=TRANSPOSE)
    if len(array) > MAX_VERTICES:
        raise TooManyVerticesError(_too_many(name, len(array)))
    return np.array(array, dtype=np.float64, order="C")


def _count_distinct(vertices: FloatArray) -> int:
    """Number of different vertices, counted up to 3."""
    others = vertices
    for found in range(3):
        if len(others) == 0:
            return found
        others = others[(others != others[0]).any(axis=1)]
    return 3


def _check_edges(vertices: FloatArray, name: str) -> None:
    """No edge of length zero, and no length that overflows or underflows."""
    ends = np.roll(vertices, -1, axis=0)
    same = np.flatnonzero((vertices == ends).all(axis=1))
    if same.size:
        first, second = int(same[0]), (int(same[0]) + 1) % len(vertices)
        raise RepeatedVertexError(
            f"vertices {first} and {second} of {name} are both {vector_text(vertices[first])}"
            f"{and_more(same.size)}: remove one of them"
        )
    size = float(np.abs(vertices).max())
    shortest = float(np.abs(ends - vertices).max(axis=1).min())
    if size > 1e100 or shortest < 1e-100:
        raise CurveScaleError(
            f"{name} has coordinates up to {size:g} and an edge as short as {shortest:g}: "
            "choose units that bring it nearer to 1"
        )


def _too_many(name: str, count: int) -> str:
    return f"{name} has {count:,} vertices: at most {MAX_VERTICES:,} are accepted; resample it"


def edges(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """Start and end points of all edges, (m, 3) each, loop by loop in order."""
    return np.concatenate(loops), np.concatenate([np.roll(v, -1, axis=0) for v in loops])


def total_length(loops: Loops) -> float:
    """Sum of the lengths of all edges."""
    start, end = edges(loops)
    return float(np.linalg.norm(end - start, axis=1).sum())


def bounding_box(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner, (3,) each."""
    vertices = np.concatenate(loops)
    return vertices.min(axis=0), vertices.max(axis=0)
