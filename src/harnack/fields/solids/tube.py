"""Tubes: `Tube` around polylines and cubic Bezier curves, `TubeNetwork` around many separate
segments."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NoReturn, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray, backend_of
from harnack.backend.elementary import clamp, fmax, fmin, max_norm
from harnack.backend.record_table import RecordTable
from harnack.backend.validation import (
    as_integer_in_range,
    as_positive,
    as_real,
    as_real_array,
    check_coordinate_size,
    check_finite,
    check_vectors,
)
from harnack.enclosures import Enclosure, LevelGaps, Lipschitz, Promise, TaylorRemainder
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.field import Field
from harnack.fields.patch_boxes import PatchBoxes, PatchField
from harnack.fields.samples import Ray, RaySample, Sample
from harnack.fields.solids.solid import Solid, box_around
from harnack.geometry.beziers import flatten_bezier
from harnack.tree.closest_triangles import MAX_BOXES

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

__all__ = ["TubeNetwork"]

_MOST_SEGMENTS = 1_000_000
# Segments in a group, and the number of segments from which on they are grouped.
_GROUP, _MANY = 8, 64
# The inner knots of the piecewise linear bound, as fractions of the length asked for.
_KNOTS = (0.125, 0.25, 0.5)
# For a ray without an end, that length is so many times the size of the tube and of coordinates.
_FAR = 8.0


@dataclass(frozen=True, eq=False)
class Tube(Solid):
    """The points within `radius` of a polyline.

    points: (n, 3) its vertices, one after the other; repeat the first to close it.
    starts: indices of vertices at which another polyline starts, not joined to the one before: see
        `from_polylines`.
    flattening_error: a bound of the distance of the polyline from the curve that it stands for, and
        so of the distance between the surfaces: see `bezier`.

    f is the signed distance, whose Lipschitz constant is 1 (Hart 1996, equations 32 to 35, for
    cubic Bezier curves). Along a path more is proved: see `TangentEnclosure`.
    """

    points: FloatArray
    radius: float
    starts: tuple[int, ...] = field(default=(), kw_only=True)
    flattening_error: float = field(default=0.0, kw_only=True)

    lipschitz = 1.0

    def __post_init__(self) -> None:
        array = as_real_array(self.points, "the points of a tube")
        check_vectors(array, "the points of a tube")
        points = np.array(array, dtype=np.float64)
        check_finite(points, "point {} of a tube", ValueError)
        check_coordinate_size(points, ValueError)
        parts: list[FloatArray] = []
        if not isinstance(cast("Any", self.starts), tuple | list | np.ndarray):
            raise TypeError(f"starts must be indices of vertices, not {self.starts!r:.60}")
        starts = [as_integer_in_range(start, "each start", 0, len(points)) for start in self.starts]
        if not 0 <= as_real(self.flattening_error, "flattening_error") < math.inf:
            raise ValueError(f"flattening_error must be a length, not {self.flattening_error!r}")
        for part in np.split(points, starts):
            if len(part):
                moves = np.any(part[1:] != part[:-1], axis=1)
                part = part[np.concatenate([[True], moves])]
            if len(part) < 2:
                raise ValueError("a tube needs two points or more that differ: use Sphere for one")
            parts.append(part)
        points = np.concatenate(parts)
        ends = np.cumsum([len(part) for part in parts])[:-1]
        object.__setattr__(self, "starts", tuple(int(one) for one in ends))
        points.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "radius", as_positive(self.radius, "the radius of a tube"))

    @classmethod
    def from_polylines(cls, polylines: Iterable[npt.ArrayLike], radius: float) -> Tube:
        """The points within `radius` of any of several polylines (n_i, 3): one distance for all.

        Raises:
            ValueError: there is none, or one is no polyline; TypeError: not numbers.
        """
        parts: list[FloatArray] = []
        for k, one in enumerate(polylines):
            array = as_real_array(one, f"polyline {k} of a tube")
            check_vectors(array, f"polyline {k} of a tube")
            parts.append(np.array(array, dtype=np.float64))
        if not parts:
            raise ValueError("a tube needs a polyline, and there are none")
        ends = np.cumsum([len(part) for part in parts])[:-1]
        return cls(np.concatenate(parts), radius, starts=tuple(int(one) for one in ends))

    @classmethod
    def bezier(
        cls, controls: npt.ArrayLike, radius: float, *, tolerance: float | None = None
    ) -> Tube:
        """The tube around a chain of cubic Bezier curves, which end where the next one starts.

        controls: (3 n + 1, 3) control points of n curves; every third one is where two curves meet.
        tolerance: how far the surface may be from the exact one, in units of length; by default a
            thousandth of the radius. The number of segments grows like its square root.

        Proof: `harnack.geometry.beziers.flatten_bezier`.

        Raises:
            ValueError: another number of points, or numbers that are not finite.
        """
        array = as_real_array(controls, "the control points")
        check_vectors(array, "the control points")
        points = np.asarray(array, dtype=np.float64)
        if len(points) < 4 or len(points) % 3 != 1:
            raise ValueError(
                "a chain of n cubic Bezier curves has 3 n + 1 control points (4, 7, 10, ...), "
                f"not {len(points)}"
            )
        check_finite(points, "control point {}", ValueError)
        radius = as_positive(radius, "the radius of a tube")
        allowed = 1e-3 * radius if tolerance is None else as_positive(tolerance, "the tolerance")
        made = [points[:1]]
        off = 0.0
        for start in range(0, len(points) - 1, 3):
            more, error = flatten_bezier(points[start : start + 4], allowed)
            made.append(more)
            off = max(off, error)
        return cls(np.concatenate(made), radius, flattening_error=off)

    @classmethod
    def helix(
        cls, radius: float, pitch: float, turns: float, wire: float, *,
        left_handed: bool = False, tolerance: float | None = None,
    ) -> Tube:  # fmt: skip
        """A coil of round wire about the z axis, from (radius, 0, 0) to z = pitch turns; its ends
        are round.

        radius: of the helix that is the middle of the wire. pitch: along the axis, of one turn.
        wire: its radius. left_handed: whether it turns clockwise as it rises.
        tolerance: how far the surface may be from the exact one, in units of length; by default a
            thousandth of the radius of the wire.

        Proof. A chord between two angles h apart is within h^2/8 max |c''| of the helix c, taken at
        equal angles, and |c''| is the radius.

        Raises:
            ValueError: numbers that are not positive, or more than a million segments.
        """
        radius, wire = as_positive(radius, "the radius of a helix"), as_positive(wire, "the wire")
        pitch, turns = as_positive(pitch, "the pitch of a helix"), as_positive(turns, "its turns")
        allowed = 1e-3 * wire if tolerance is None else as_positive(tolerance, "the tolerance")
        angle = 2 * math.pi * turns
        count = max(1.0, angle * math.sqrt(radius / (8.0 * allowed)))
        if not count <= _MOST_SEGMENTS:
            raise ValueError(f"{count:,.0f} segments: allow a larger tolerance")
        t = np.linspace(0.0, angle, math.ceil(count) + 1)
        y = np.sin(t) * (-radius if left_handed else radius)
        points = np.column_stack([radius * np.cos(t), y, pitch * t / (2 * math.pi)])
        off = radius * (angle / math.ceil(count)) ** 2 / 8.0
        return cls(points, wire, flattening_error=off)

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        segments = len(self.points) - 1 - len(self.starts)
        return {"segments": segments, "flattening_error": self.flattening_error}

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if above:
            return None
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        reach = self.radius + level
        x, y, z = (float(v) for v in 0.5 * (high - low) + reach)
        return box_around((x, y, z), tuple(float(v) for v in 0.5 * (low + high)))

    @cached_prepare
    def prepare(self, backend: Backend) -> Tube:
        made = copy.copy(self)
        joined = np.ones(len(self.points) - 1, dtype=np.bool_)
        joined[[one - 1 for one in self.starts]] = False
        start, side = self.points[:-1][joined], np.diff(self.points, axis=0)[joined]
        rows = np.column_stack([start, side, 1.0 / np.sum(side * side, axis=1)])
        groups = None
        if len(rows) >= _MANY:
            rows, balls = _grouped(rows)
            groups = RecordTable.upload(backend, balls)
        object.__setattr__(made, "_records", RecordTable.upload(backend, rows))
        object.__setattr__(made, "_groups", groups)
        object.__setattr__(made, "_radius", dr.opaque(backend.Float, self.radius))
        size = float(np.abs(self.points).max()) + self.radius
        object.__setattr__(made, "_size", dr.opaque(backend.Float, size))
        return made

    def evaluate(self, p: Vec3) -> Sample:
        return self._sample_with_bounds(p, None, ())[0]

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        del back
        p = path.point(t)
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        if not hasattr(self, "_records"):
            return self.prepare(backend_of(p)).sample_ray(path, t, ahead, ahead)
        far = _FAR * (max_norm(p) + self._parameter("_size"))
        length = dr.select(dr.isfinite(ahead), ahead, far)
        knots = (*(one * length for one in _KNOTS), ahead)
        sample, distance, lows = self._sample_with_bounds(p, path.direction, knots)
        slope = dr.dot(sample.gradient, path.direction)
        most = fmin(slope + sample.gradient_error, 1.0)
        return RaySample(sample, (TangentEnclosure(distance, most, knots, lows),), (), slope, 4.0)

    def _sample_with_bounds(
        self, p: Vec3, direction: Vec3 | None, knots: tuple[Real, ...]
    ) -> tuple[Sample, Real, tuple[Real, ...]]:
        """The sample, the distance from the polyline, and bounds of the movement at the knots."""
        if not hasattr(self, "_records"):
            return self.prepare(backend_of(p))._sample_with_bounds(p, direction, knots)
        real, vector = cast("Any", type(p.x)), cast("Any", type(p))
        unit = 2 * float(dr.epsilon(real))
        records: RecordTable = cast("Any", self)._records

        def body(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            nearest, x, y, z, size, *lows = state
            from_start, side = p - vector(*row[:3]), vector(*row[3:6])
            t = clamp(dr.dot(from_start, side) * row[6], 0, 1)
            away = dr.fma(side, -t, from_start)
            distance = dr.norm(away)
            # The error of the vector is a few roundings of its terms.
            off = 8 * unit * (dr.norm(from_start) + dr.norm(side))
            if direction is not None:
                slope = dr.dot(away, direction) / distance - off / distance * 2
                lows = min_with_tangent(
                    lows, knots, distance - off, slope, 4 * unit * distance, unit
                )
            nearer = distance < nearest
            return (
                dr.select(nearer, distance, nearest),
                *(dr.select(nearer, a, b) for a, b in zip(away, (x, y, z), strict=True)),
                fmax(off, size),
                *lows,
            )

        zero = 0 * p.x
        start = (zero + dr.inf, zero, zero, zero, zero, *(zero + dr.inf for _ in knots))
        groups: RecordTable | None = cast("Any", self)._groups
        if groups is None:
            found = records.for_each(body, start, "tube")
        else:
            found = _visit_by_groups(p, direction, knots, records, groups, body, start)
        distance, error = found[0], found[4]
        away = vector(*found[1:4])
        gradient = dr.select(distance > 0, away / distance, vector(0))
        value = distance - self._parameter("_radius")
        error = error + 4 * unit * (distance + self._parameter("_radius"))
        doubt = dr.select(distance > 0, fmin(4 * error / distance, 2), 2)
        sample = Sample(value, gradient, (Lipschitz(zero + 1),), error, doubt)
        return sample, distance, tuple(low - distance - error for low in found[5:])

    def _parameter(self, name: str) -> Any:
        return getattr(self, name)


def _grouped(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Records of segments in groups of `_GROUP`, the last padded with copies, and a ball (center,
    radius) around each group."""
    missing = -len(rows) % _GROUP
    rows = np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])
    ends = np.concatenate([rows[:, :3], rows[:, :3] + rows[:, 3:6]], axis=1)
    points = ends.reshape(-1, 2 * _GROUP, 3)
    centers = 0.5 * (points.min(axis=1) + points.max(axis=1))
    radii = np.linalg.norm(points - centers[:, None], axis=2).max(axis=1)
    return rows, np.column_stack([centers, radii * (1 + 1e-5)])


def _visit_by_groups(
    p: Vec3,
    direction: Vec3 | None,
    knots: tuple[Real, ...],
    records: RecordTable,
    groups: RecordTable,
    body: Callable[[list[Real], tuple[Any, ...]], tuple[Any, ...]],
    start: tuple[Any, ...],
) -> tuple[Any, ...]:
    """The state after `body` for all segments, where the ball of a far group replaces its segments.

    Proof. A segment in a ball of radius r about c is at least |p - c| - r and at most |p - c| + r
    away. So the nearest segment is in no group whose ball begins farther away than another one
    ends. The distance from the ball, which bounds that of all its segments, is convex along the
    ray as well, and lies above its own tangent.
    """
    real, vector = cast("Any", type(p.x)), cast("Any", type(p))
    unit = 2 * float(dr.epsilon(real))

    def bound(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        return (fmin(dr.norm(p - vector(*row[:3])) + row[3], state[0]),)

    (most,) = groups.for_each(bound, (real(dr.inf),), "tube groups")
    limit = most * (1 + 16 * unit) + 16 * unit * dr.norm(p)

    def visit(i: Any, *state: Any) -> tuple[Any, ...]:
        row = groups.read_record(i)
        away = p - vector(*row[:3])
        distance = dr.norm(away)
        is_near = distance - row[3] <= limit
        found = list(state)
        if direction is not None:
            off = 8 * unit * (dr.norm(p) + distance + row[3])
            slope = dr.dot(away, direction) / distance - 2 * off / distance
            start = dr.select(is_near, dr.inf, distance - row[3] - off)
            found[5:] = min_with_tangent(found[5:], knots, start, slope, 4 * unit * distance, unit)

        def each(j: Any, *inner: Any) -> tuple[Any, ...]:
            return j + 1, *body(records.read_record(i * _GROUP + j), inner)

        def more(j: Any, *_: Any) -> Any:
            return j < last

        last = dr.select(is_near, type(i)(_GROUP), type(i)(0))
        inside = dr.while_loop((type(i)(0), *found), more, each, label="tube")
        return i + 1, *inside[1:]

    def more_groups(i: Any, *_: Any) -> Any:
        return i < groups.iteration_count

    index = groups.backend.UInt32(0)
    return dr.while_loop((index, *start), more_groups, visit, label="tube by groups")[1:]


def min_with_tangent(
    lows: Sequence[Real],
    knots: tuple[Real, ...],
    start: Real,
    slope: Real,
    rounding: Real,
    unit: float,
) -> list[Real]:
    """The smaller of `lower_bounds` and of the values of a tangent at the knots, the last of which
    may be infinite.

    start: the tangent's value at 0, known up to `rounding`.
    slope: of the tangent, at least -1; NaN, as on the segment itself, counts as -1.

    The slope is lowered by four roundings, for that of the product with a knot. It is never 0, so
    that at infinity the tangent is infinite, with the slope's sign, and never 0 times infinity.
    """
    slope = fmax(slope, -1) - 4 * unit
    slope = dr.select(slope == 0, -unit, slope)
    start = start - rounding
    return [fmin(dr.fma(knot, slope, start), low) for low, knot in zip(lows, knots, strict=True)]


@dataclass(frozen=True)
class TangentEnclosure(Enclosure):
    """The distance from a set of segments along a path.

    distance: from the nearest segment.
    slope: a bound of the rate at which that grows.
    knots: increasing lengths s.
    lower_bounds: lower bounds of F at these, by the tangents of the distances.

    Proof. The distance from one segment is a convex function of s, so it lies above its tangent at
    s = 0 (Hart 1996, theorem 4). The smallest of all tangents is a concave function, which lies
    above the chord between two of its points: so F lies above the piecewise linear function through
    0 and the lows at the knots. The last knot may be infinite: if the low there is -inf, nothing is
    known beyond the knot before; if it is +inf, no tangent falls, and F never falls below the low
    before.

    From above, the distance from the polyline is at most that from the nearest point c,
    sqrt(D^2 + 2 D m s + s^2), with D the distance and m its slope; so F does not reach g before
    s^2 + 2 D m s = g^2 + 2 D g. Where these squares overflow: a distance does not before s = g.
    """

    distance: Real
    slope: Real
    knots: tuple[Real, ...]
    lower_bounds: tuple[Real, ...]

    def free_length(self, gaps: LevelGaps) -> Real:
        across = self.distance * self.slope
        right = gaps.above * (gaps.above + 2 * self.distance)
        root = dr.sqrt(fmax(dr.fma(across, across, right), 0))
        up = dr.select(across > 0, right / (across + root), root - across)
        # Squares of large numbers overflow: a distance rises by 1 per unit of length at most.
        up = dr.select(dr.isfinite(right) & dr.isfinite(root), up, gaps.above)
        total, start, low = 0 * self.distance, 0 * self.distance, 0 * self.distance
        free = gaps.below >= 0  # and not NaN
        for knot, next_low in zip(self.knots, self.lower_bounds, strict=True):
            is_clear = next_low >= -gaps.below
            part = fmax((gaps.below + low) / (low - next_low) * (knot - start), 0)
            reached = dr.select(is_clear, knot, fmin(start + part, knot))
            total = dr.select(free, reached, total)
            free &= is_clear
            start, low = knot, next_low
        known = (total >= 0) & (up >= 0)
        return dr.select(known, fmin(total, up) * (1 - 1e-6), 0)


# Boxes are wider than the tubes by this fraction of their size.
_SLACK = 1e-5
# The radius on which second derivatives are bounded, as a fraction of the distance to the segment.
_REACH = 0.5


class TubeNetwork(PatchField["_TubeBuffers"]):
    """The surfaces at distance `radius` from many segments: edges of meshes, wires, struts.

    points: (n, 3).
    segments: (m, 2) indices of points, counted from 0.
    radius: a number, or (m,).

    Each segment is a part with rounded ends (`harnack.fields.capabilities`): a ray pays only for
    those whose boxes it enters, so that thousands cost little more than one, and
    `Hits.primitive_index` is the index of the segment. `level` makes all tubes thicker by so much.
    For one polyline, and for combinations with other solids, there is `Tube`.

    Raises ValueError for arrays of other shapes, numbers that are not finite, an index without a
    point, a segment without a length, a radius that is not positive.
    """

    default_level: float = 0.0

    def __init__(self, points: Any, segments: Any, radius: Any) -> None:
        super().__init__()
        array = as_real_array(points, "the points of tubes")
        check_vectors(array, "the points of tubes")
        self.points: FloatArray = np.array(array, dtype=np.float64)
        check_finite(self.points, "point {} of tubes", ValueError)
        check_coordinate_size(self.points, ValueError)
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
        """Raises TypeError: there is a function for each segment, and none for all together."""
        del p
        raise TypeError(
            "tubes are no level set of one function, but of one for each segment: take "
            "harnack.Tube for one polyline that is to be evaluated or combined with other solids"
        )

    def _upload(self, backend: Backend) -> _TubeBuffers:
        boxes = PatchBoxes.upload(backend, *self.boxes())
        center = np.array(boxes.center, dtype=np.float64).reshape(3)
        start, end = ((self.points[ends] - center) for ends in self.segments.T)
        side = end - start
        inverse = 1.0 / (side * side).sum(axis=1)
        rows = np.column_stack([start, self.radius, side, inverse])
        return _TubeBuffers(boxes, RecordTable.upload(backend, rows))

    def patch(self, index: Any) -> Field:
        on = self._require_data()
        return _Segment(on.boxes, on.segments.read_record(index))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
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

    boxes: PatchBoxes
    segments: RecordTable


class _Segment(Field):
    """The distance from a segment, in each lane another, less its radius.

    It is convex, as the distance from a convex set is, with the Lipschitz constant 1. Its second
    derivative along a line is at most 1/D at distance D (Hart 1996): the distance from a point or a
    line has that across the gradient, and that from a segment is one or the other. So it is at most
    1/(D - r) within r.
    """

    def __init__(self, boxes: PatchBoxes, row: list[Real]) -> None:
        self._boxes, self._row = boxes, row

    def evaluate(self, p: Vec3) -> Sample:
        backend, row = self._boxes.backend, self._row
        vector, unit = backend.Array3f, 2 * backend.machine_epsilon
        from_start = vector(p) - self._boxes.center - vector(*row[:3])
        side = vector(*row[4:7])
        along = clamp(dr.dot(from_start, side) * row[7], 0, 1)
        away = dr.fma(side, vector(-along), from_start)
        distance = dr.norm(away)
        # The error of the vector is a few roundings of its terms.
        off = 8 * unit * (dr.norm(from_start) + dr.norm(side) + dr.norm(vector(*row[:3])))
        error = off + 4 * unit * (distance + row[3])
        gradient = dr.select(distance > 0, away / distance, vector(0))
        doubt = dr.select(distance > 0, dr.minimum(4 * error / distance, 2), 2)
        r = _REACH * fmax(distance - error, 0)
        known: tuple[Promise, ...] = (Lipschitz(backend.Float(1)), TaylorRemainder(1 / r, r))
        return Sample(distance - row[3], gradient, known, error, doubt)


def _checked_segments(segments: Any, points: FloatArray) -> IntArray:
    array = as_real_array(segments, "the segments of tubes")
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"the segments of tubes must have shape (m, 2), not {array.shape}")
    if array.dtype.kind not in "iu":
        raise ValueError(f"the segments of tubes must be integer indices, not {array.dtype}")
    if len(array) >= MAX_BOXES:
        raise ValueError(f"{len(array):,} segments are too many: at most {MAX_BOXES:,}")
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
    array = as_real_array(radius, "the radius of tubes")
    if array.ndim == 0:
        return np.full(count, as_positive(radius, "the radius of tubes"))
    if array.shape != (count,):
        raise ValueError(
            f"the radius of tubes is a number or has shape ({count},), not {array.shape}"
        )
    for one in (array.min(), array.max()):
        as_positive(float(one), "the radius of tubes")
    return np.array(array, dtype=np.float64)
