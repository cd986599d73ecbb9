"""The closest point of the curve in which the level sets of a solid angle end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import aligned
from harnack.backend.extrema import clamp
from harnack.fields.edges.edge_sums import inverse_squares

if TYPE_CHECKING:
    from harnack.backend import Backend, Vec3

__all__ = ["Segments", "closest_on_segments"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Segments:
    """Line segments on the device: records of start, 1/length^2, end and a zero."""

    backend: Backend
    buffer: Any
    count: Any

    @classmethod
    def upload(cls, backend: Backend, start: FloatArray, end: FloatArray) -> Segments:
        """Segments (k, 3) to (k, 3), k >= 1, of a size of about one. One whose ends are the same
        in the backend's precision is a point."""
        cast = np.float64 if backend.precision == "double" else np.float32
        start, end = (q.astype(cast).astype(np.float64) for q in (start, end))
        inverse = inverse_squares(end - start)[:, None]
        records = np.concatenate([start, inverse, end, np.zeros_like(inverse)], axis=1)
        count = dr.opaque(backend.UInt32, len(start))
        return cls(backend, aligned(backend, records.ravel().astype(cast)), count)


def closest_on_segments(segments: Segments, x: Vec3) -> Vec3:
    """The point of the segments that is closest to x."""
    backend = segments.backend
    vector, index = backend.Array3f, backend.UInt32
    x = vector(x)

    def body(i: Any, nearest: Any, best: Vec3) -> Any:
        row = dr.gather(backend.ArrayXf, segments.buffer, i, shape=(8, 1))
        p, q = vector(row[0], row[1], row[2]), vector(row[4], row[5], row[6])
        share = clamp(dr.dot(x - p, q - p) * row[3], 0, 1)
        foot = dr.fma(vector(share), q - p, p)
        square = dr.squared_norm(x - foot)
        closer = square < nearest
        return i + 1, dr.select(closer, square, nearest), dr.select(closer, foot, best)

    def more(i: Any, *_: Any) -> Any:
        return i < segments.count

    start = (index(0), backend.Float(dr.inf), vector(0))
    return dr.while_loop(start, more, body, label="nearest edge")[2]
