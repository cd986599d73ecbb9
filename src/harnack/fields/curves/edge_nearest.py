"""The closest point of the curve in which the level sets of a solid angle end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import clamp
from harnack.backend.records import Records
from harnack.fields.edges.edge_records import single_edges

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["closest_on_segments", "segments"]


def segments(backend: Backend, start: FloatArray, end: FloatArray) -> Records:
    """Segments (k, 3) to (k, 3), k >= 1, of a size of about one. One whose ends are the same in
    the backend's precision is a point."""
    start, end = (q.astype(backend.dtype).astype(np.float64) for q in (start, end))
    return Records.upload(backend, single_edges(start, end))


def closest_on_segments(segments: Records, x: Vec3) -> Vec3:
    """The point of the segments that is closest to x."""
    vector = segments.backend.Array3f
    x = vector(x)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        nearest, best = state
        p, q = vector(*row[:3]), vector(*row[4:7])
        share = clamp(dr.dot(x - p, q - p) * row[7], 0, 1)
        foot = dr.fma(vector(share), q - p, p)
        square = dr.squared_norm(x - foot)
        closer = square < nearest
        return dr.select(closer, square, nearest), dr.select(closer, foot, best)

    start = (segments.backend.Float(dr.inf), vector(0))
    return segments.for_each(add, start, "nearest edge")[1]
