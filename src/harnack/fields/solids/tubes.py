"""Tubes around many segments, such as the edges of a mesh: each a part in a box of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.extrema import clamp, fmax
from harnack.backend.numbers import check_finite, check_size, check_vectors, positive, real_array
from harnack.backend.records import Records
from harnack.enclosures import Curvature, Lipschitz, Promise
from harnack.fields.boxed_parts import BoxedField, BoxedParts
from harnack.fields.field import Field
from harnack.fields.look import Sample
from harnack.tree.boxes import MOST_BOXES

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["Tubes"]

# Boxes are wider than the tubes by this part of their size.
_SLACK = 1e-5
# The radius on which second derivatives are bounded, as a part of the distance to the segment.
_REACH = 0.5


class Tubes(BoxedField["_TubeBuffers"]):
    """The surfaces at distance `radius` from many segments: edges of meshes, wires, struts.

    points: (n, 3). segments: (m, 2) indices of points, counted from 0. radius: a number, or (m,).

    Each segment is a part with rounded ends (`harnack.fields.sheets`): a ray pays only for those
    whose boxes it enters, so that thousands cost little more than one, and `Hits.sheet` is the
    index of the segment. `level` makes all tubes thicker by so much. For one polyline, and for
    combinations with other solids, there is `Tube`.

    Raises ValueError for arrays of other shapes, numbers that are not finite, an index without a
    point, a segment without a length, a radius that is not positive.
    """

    default_level: float = 0.0

    def __init__(self, points: Any, segments: Any, radius: Any) -> None:
        super().__init__()
        array = real_array(points, "the points of tubes")
        check_vectors(array, "the points of tubes")
        self.points: FloatArray = np.array(array, dtype=np.float64)
        check_finite(self.points, "point {} of tubes", ValueError)
        check_size(self.points, ValueError)
        self.segments: IntArray = _checked_segments(segments, self.points)
        self.radius: FloatArray = _checked_radius(radius, len(self.segments))

    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corners (m, 3) of boxes around the tubes."""
        level = max(self.levels if levels is None else levels)
        ends = self.points[self.segments]
        reach = (self.radius + level)[:, None]
        low, high = ends.min(axis=1) - reach, ends.max(axis=1) + reach
        slack = _SLACK * (high - low).max(axis=1)[:, None]
        return low - slack, high + slack

    def evaluate(self, p: Vec3) -> NoReturn:
        """Raises TypeError: there is a function for each segment, and none of them all."""
        del p
        raise TypeError(
            "tubes are no level set of one function, but of one for each segment: take "
            "harnack.Tube for one polyline that is to be evaluated or combined with other solids"
        )

    def _upload(self, backend: Backend) -> _TubeBuffers:
        boxes = BoxedParts.upload(backend, *self.boxes())
        center = np.array(boxes.center, dtype=np.float64).reshape(3)
        start, end = ((self.points[ends] - center) for ends in self.segments.T)
        side = end - start
        inverse = 1.0 / (side * side).sum(axis=1)
        rows = np.column_stack([start, self.radius, side, inverse])
        return _TubeBuffers(boxes, Records.upload(backend, rows))

    def part_at(self, index: Any) -> Field:
        on = self._on()
        return _Segment(on.boxes, on.segments.row(index))

    def check_levels(self, levels: tuple[float, ...]) -> None:
        least = float(self.radius.min())
        for level in levels:
            if not level > -least:
                raise ValueError(
                    f"level {level:g} leaves nothing of the thinnest tube, of radius {least:g}"
                )

    def describe(self) -> dict[str, Any]:
        return {"segments": len(self.segments)}


@dataclass(frozen=True)
class _TubeBuffers:
    """The tubes' boxes and segments on a backend; segments relative to the center of the boxes."""

    boxes: BoxedParts
    segments: Records


class _Segment(Field):
    """The distance from a segment, in each lane another, less its radius.

    It is convex, as the distance from a convex set is, and grows no faster than by 1. Its second
    derivative along a line is at most 1/D at distance D (Hart 1996): the distance from a point or a
    line has that across the gradient, and a segment has one or the other. So it is at most
    1/(D - r) within r.
    """

    def __init__(self, boxes: BoxedParts, row: list[Real]) -> None:
        self._boxes, self._row = boxes, row

    def evaluate(self, p: Vec3) -> Sample:
        backend, row = self._boxes.backend, self._row
        vector, unit = backend.Array3f, 2 * backend.epsilon
        from_start = vector(p) - self._boxes.center - vector(*row[:3])
        side = vector(*row[4:7])
        along = clamp(dr.dot(from_start, side) * row[7], 0, 1)
        away = dr.fma(side, vector(-along), from_start)
        distance = dr.norm(away)
        # The vector is off by a few roundings of what it is made of.
        off = 8 * unit * (dr.norm(from_start) + dr.norm(side) + dr.norm(vector(*row[:3])))
        error = off + 4 * unit * (distance + row[3])
        gradient = dr.select(distance > 0, away / distance, vector(0))
        doubt = dr.select(distance > 0, dr.minimum(4 * error / distance, 2), 2)
        r = _REACH * fmax(distance - error, 0)
        known: tuple[Promise, ...] = (Lipschitz(backend.Float(1)), Curvature(1 / r, r))
        return Sample(distance - row[3], gradient, known, error, doubt)


def _checked_segments(segments: Any, points: FloatArray) -> IntArray:
    array = real_array(segments, "the segments of tubes")
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"the segments of tubes must have shape (m, 2), not {array.shape}")
    if array.dtype.kind not in "iu":
        raise ValueError(f"the segments of tubes must be integer indices, not {array.dtype}")
    if len(array) >= MOST_BOXES:
        raise ValueError(f"{len(array):,} segments are too many: at most {MOST_BOXES:,}")
    pairs = np.array(array, dtype=np.int64)
    if (out := np.flatnonzero(((pairs < 0) | (pairs >= len(points))).any(axis=1))).size:
        raise ValueError(
            f"segment {out[0]} joins points {pairs[out[0], 0]} and {pairs[out[0], 1]}: there are "
            f"{len(points):,} points, counted from 0"
        )
    ends = points[pairs]
    if (none := np.flatnonzero(np.abs(ends[:, 0] - ends[:, 1]).max(axis=1) < 1e-100)).size:
        raise ValueError(f"segment {none[0]} has no length: leave it out")
    pairs.setflags(write=False)
    return pairs


def _checked_radius(radius: Any, count: int) -> FloatArray:
    array = real_array(radius, "the radius of tubes")
    if array.ndim == 0:
        return np.full(count, positive(radius, "the radius of tubes"))
    if array.shape != (count,):
        raise ValueError(
            f"the radius of tubes is a number or has shape ({count},), not {array.shape}"
        )
    for one in (array.min(), array.max()):
        positive(float(one), "the radius of tubes")
    return np.array(array, dtype=np.float64)
