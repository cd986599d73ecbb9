"""Tubes: the points within a radius of line segments. `Tube` is a single solid around polylines and
cubic Bezier curves; its function f is the signed distance from its surface, which is the distance D
from the nearest segment minus the radius. `TubeNetwork` is a surface of a large number of separate
tubes, one for each segment. An enclosure is a proved bound of the change of a function along a ray.
Bounds along a ray are computed at knots, which are increasing lengths along it; the last may be
infinite. Segments are read by loops, as records of numbers. The state of a loop is the tuple of
numbers that it changes from one segment to the next."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
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
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.number_table import AlikeParts, detached, plain_numbers
from harnack.fields.parameters import kept_arguments
from harnack.fields.patch_boxes import PatchBoxes, PatchesInBoxes, PatchField
from harnack.fields.solids.round_cones import PlainCone
from harnack.fields.solids.solid import Solid, box_around
from harnack.geometry.beziers import flatten_bezier
from harnack.tree.closest_triangles import MAX_BOXES

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.number_table import NumberReader, NumberTable
    from harnack.geometry import Volume

__all__ = ["TubeNetwork"]

_MOST_SEGMENTS = 1_000_000
# The number of segments in a group; and the number of segments from which on they are grouped.
_GROUP_SIZE, _MIN_SEGMENTS_FOR_GROUPS = 8, 64
# Along a ray the distance is bounded at knots. The inner knots are these fractions of the requested
# length.
_KNOT_FRACTIONS = (0.125, 0.25, 0.5)
# If the requested length is infinite, inner knots are fractions of this multiple of the sum of the
# tube's size and the largest coordinate of the point.
_ENDLESS_LENGTH = 8.0


@dataclass(frozen=True, eq=False)
class Tube(Solid):
    """A tube: the points within `radius` of a polyline, or of several polylines. f is the signed
    distance from its surface: the distance from the nearest segment of the polylines minus the
    radius.

    points: (n, 3) the vertices of the polyline in order. Repeat the first to close it.
    radius: of the tube.
    starts: if `points` holds several polylines one after another, the indices of the first vertices
        of the second, third, ... polyline. Polylines are not joined to each other: see
        `from_polylines`.
    flattening_error: if the polyline approximates a curve, a bound of the distance between curve
        and polyline, which also bounds the distance between the two tubes' surfaces: see `bezier`.

    f has the Lipschitz constant 1 (Hart 1996, equations 32 to 35, for cubic Bezier curves). Along a
    ray a stronger bound is proved: see `TangentEnclosure`.
    """

    traits = dataclasses.replace(Solid.traits, differentiable_arguments=("points", "radius"))

    points: FloatArray
    radius: float
    starts: tuple[int, ...] = field(default=(), kw_only=True)
    flattening_error: float = field(default=0.0, kw_only=True)

    lipschitz = 1.0

    def __post_init__(self) -> None:
        """Check the arguments, and leave out points that repeat the point before.

        Raises:
            ValueError, TypeError: arguments of another kind, or a polyline of fewer than two
                different points.
        """
        array = as_real_array(detached(self.points), "the points of a tube")
        check_vectors(array, "the points of a tube")
        points = np.array(array, dtype=np.float64)
        check_finite(points, "point {} of a tube", ValueError)
        check_coordinate_size(points, ValueError)
        parts: list[FloatArray] = []
        indices: list[IntArray] = []
        if not isinstance(cast("Any", self.starts), tuple | list | np.ndarray):
            raise TypeError(f"starts must be indices of vertices, not {self.starts!r:.60}")
        starts = [as_integer_in_range(start, "each start", 0, len(points)) for start in self.starts]
        if not 0 <= as_real(self.flattening_error, "flattening_error") < math.inf:
            raise ValueError(f"flattening_error must be a length, not {self.flattening_error!r}")
        # Split at the starts of polylines, and leave out repeated points of each polyline.
        numbered = np.split(np.arange(len(points)), starts)
        for part, own in zip(np.split(points, starts), numbered, strict=True):
            if len(part):
                # For each point but the first, whether it differs from the point before.
                differs = np.concatenate([[True], np.any(part[1:] != part[:-1], axis=1)])
                part, own = part[differs], own[differs]
            if len(part) < 2:
                raise ValueError("a tube needs two points or more that differ: use Sphere for one")
            parts.append(part)
            indices.append(own)
        object.__setattr__(self, "_given_indices", np.concatenate(indices))
        points = np.concatenate(parts)
        # The indices at which polylines start, after points were left out.
        ends = np.cumsum([len(part) for part in parts])[:-1]
        object.__setattr__(self, "starts", tuple(int(end) for end in ends))
        points.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "radius", as_positive(self.radius, "the radius of a tube"))

    @classmethod
    def from_polylines(cls, polylines: Iterable[npt.ArrayLike], radius: float) -> Tube:
        """One tube around several polylines: the points within `radius` of any of them. It has a
        single function f.

        polylines: arrays (n_i, 3) of vertices.
        radius: of the tube.

        Raises:
            ValueError: no polylines, or an array that is not a polyline.
            TypeError: arrays that are not of numbers.
        """
        arrays: list[FloatArray] = []
        for k, entry in enumerate(polylines):
            array = as_real_array(entry, f"polyline {k} of a tube")
            check_vectors(array, f"polyline {k} of a tube")
            arrays.append(np.array(array, dtype=np.float64))
        if not arrays:
            raise ValueError("a tube needs a polyline, and there are none")
        ends = np.cumsum([len(part) for part in arrays])[:-1]
        return cls(np.concatenate(arrays), radius, starts=tuple(int(entry) for entry in ends))

    @classmethod
    def bezier(
        cls, controls: npt.ArrayLike, radius: float, *, tolerance: float | None = None
    ) -> Tube:
        """The tube around a chain of cubic Bezier curves, each of which starts where the one before
        ends. The curves are approximated by segments.

        controls: (3 n + 1, 3) control points of n curves; two curves meet at every third point.
        radius: of the tube.
        tolerance: the largest distance allowed between the surface and the exact surface, in units
            of length; None for a thousandth of the radius. The number of segments grows like the
            inverse of its square root.

        Proof: `harnack.geometry.beziers.flatten_bezier`.

        Raises:
            ValueError: a number of points that is not 3 n + 1, or numbers that are not finite.
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
        # The first point of each curve is the last of the one before.
        pieces = [points[:1]]
        max_error = 0.0
        for start in range(0, len(points) - 1, 3):
            vertices, error = flatten_bezier(points[start : start + 4], allowed)
            pieces.append(vertices)
            max_error = max(max_error, error)
        return cls(np.concatenate(pieces), radius, flattening_error=max_error)

    @classmethod
    def helix(
        cls, radius: float, pitch: float, turns: float, wire: float, *,
        left_handed: bool = False, tolerance: float | None = None,
    ) -> Tube:  # fmt: skip
        """A coil of round wire about the z axis. The middle of the wire is a helix from (radius, 0,
        0) to z = pitch turns, which is approximated by segments. The ends of the wire are round.

        radius: the radius of the helix.
        pitch: how far the helix rises along the axis in each turn.
        turns: the number of turns.
        wire: the radius of the wire.
        left_handed: whether the helix turns clockwise as it rises.
        tolerance: the largest distance allowed between the surface and the exact surface, in units
            of length; None for a thousandth of the wire's radius.

        Proof of the error. Let c be the helix as a function of the angle; then |c''| is its radius.
        A chord between two points whose angles differ by h is within h^2/8 max |c''| of the helix.

        Raises:
            ValueError: numbers that are not positive, or more than a million segments.
        """
        radius, wire = as_positive(radius, "the radius of a helix"), as_positive(wire, "the wire")
        pitch, turns = as_positive(pitch, "the pitch of a helix"), as_positive(turns, "its turns")
        allowed = 1e-3 * wire if tolerance is None else as_positive(tolerance, "the tolerance")
        angle = 2 * math.pi * turns
        # The number of segments for which radius h^2/8 is the allowed error.
        count = max(1.0, angle * math.sqrt(radius / (8.0 * allowed)))
        if not count <= _MOST_SEGMENTS:
            raise ValueError(f"{count:,.0f} segments: allow a larger tolerance")
        t = np.linspace(0.0, angle, math.ceil(count) + 1)
        y = np.sin(t) * (-radius if left_handed else radius)
        points = np.column_stack([radius * np.cos(t), y, pitch * t / (2 * math.pi)])
        error = radius * (angle / math.ceil(count)) ** 2 / 8.0
        return cls(points, wire, flattening_error=error)

    def with_read_numbers(self, numbers: NumberReader) -> AlikeParts:
        """The same function of the points and the radius with their derivatives."""
        table, kept = cast("NumberTable", numbers), kept_arguments(self)
        indices = vars(self)["_given_indices"]
        points = kept.get("points")
        count = len(indices) if points is None else plain_numbers(points).shape[0]
        places = table.places(points, 3 * count).reshape(-1, 3)[
            indices if points is not None else ...
        ]
        start = self._segment_starts()
        ends = np.stack([start, start + 1], axis=1)
        radius = np.full((len(start), 1), self.radius)
        radius_place = np.tile(table.places(kept.get("radius"), 1), (len(start), 1))
        return AlikeParts(
            table,
            np.hstack([self.points[ends].reshape(-1, 6), radius]),
            np.hstack([places[ends].reshape(-1, 6), radius_place]),
            PlainCone.read_capsule,
            is_least=True,
        )

    def _segment_starts(self) -> IntArray:
        """The indices of the points at which segments begin."""
        is_segment = np.ones(len(self.points) - 1, dtype=np.bool_)
        # The last vertex of a polyline is not joined to the first of the next.
        is_segment[[vertex - 1 for vertex in self.starts]] = False
        return np.flatnonzero(is_segment)

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        segments = len(self.points) - 1 - len(self.starts)
        return {"segments": segments, "flattening_error": self.flattening_error}

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box of the points, grown by radius
        and level on each side. None if `above` (a volume for all points where f >= level), as these
        points are unbounded."""
        if above:
            return None
        lower, upper = self.points.min(axis=0), self.points.max(axis=0)
        reach = self.radius + level
        x, y, z = (float(v) for v in 0.5 * (upper - lower) + reach)
        return box_around((x, y, z), tuple(float(v) for v in 0.5 * (lower + upper)))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        del plan
        return _TubeEvaluator(self._upload(backend))

    @cached_upload
    def _upload(self, backend: Backend) -> _TubeData:
        """Upload the segments as records to a backend. If there are many, they are grouped, and
        each group has a ball around it."""
        first = self._segment_starts()
        start, segment = self.points[first], np.diff(self.points, axis=0)[first]
        # A record: the start, the vector to the end, and 1 / length^2.
        rows = np.column_stack([start, segment, 1.0 / np.sum(segment * segment, axis=1)])
        groups = None
        if len(rows) >= _MIN_SEGMENTS_FOR_GROUPS:
            rows, balls = _group_segments(rows)
            groups = RecordTable.upload(backend, balls)
        records = RecordTable.upload(backend, rows)
        size = float(np.abs(self.points).max()) + self.radius
        radius, size = (dr.opaque(backend.Float, length) for length in (self.radius, size))
        return _TubeData(records, groups, radius, size)


@dataclass(frozen=True)
class _TubeData:
    """The data of a tube on a backend.

    records: for each segment a record of its start, the vector to its end, and 1 / length^2.
    groups: for each group of segments a record of the center and the radius of a ball that contains
        them; None for a small number of segments.
    radius: of the tube.
    size: a bound of the absolute values of coordinates on the tube.
    """

    records: RecordTable
    groups: RecordTable | None
    radius: Real
    size: Real


@dataclass(frozen=True, eq=False)
class _TubeEvaluator(Evaluator):
    """The evaluator of a `Tube`."""

    data: _TubeData

    def evaluate(self, p: Vec3) -> Sample:
        # Without a direction (None) and without knots there are no bounds along a ray.
        return self._sample_with_bounds(p, None, ())[0]

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with an enclosure (a proved bound of
        the change of f along the ray) in front of the point. The enclosure is a `TangentEnclosure`,
        up to the length `ahead`; behind the point there is none. If the caller asks for other kinds
        of enclosures, they follow from the Lipschitz constant 1, in front of the point and behind
        it.

        path: the ray.
        ahead, back: the lengths in front of and behind the point; `back` is not used.
        """
        del back
        p = path.point(t)
        # The caller chooses the kinds of enclosures. `TangentEnclosure` is used with the sharpest
        # choice, which is the one that has `PiecewiseTaylorEnclosure`.
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        # If `ahead` is infinite, the inner knots are fractions of another length.
        endless_length = _ENDLESS_LENGTH * (max_norm(p) + self.data.size)
        length = dr.select(dr.isfinite(ahead), ahead, endless_length)
        knots = (*(fraction * length for fraction in _KNOT_FRACTIONS), ahead)
        sample, distance, bounds = self._sample_with_bounds(p, path.direction, knots)
        slope = dr.dot(sample.gradient, path.direction)
        # A distance grows no faster than the length.
        max_slope = fmin(slope + sample.gradient_error, 1.0)
        # 4.0: the next sample asks for enclosures up to four times the length of this step.
        return RaySample(
            sample, (TangentEnclosure(distance, max_slope, knots, bounds),), (), slope, 4.0
        )

    def _sample_with_bounds(
        self, p: Vec3, direction: Vec3 | None, knots: tuple[Real, ...]
    ) -> tuple[Sample, Real, tuple[Real, ...]]:
        """Three results: the sample of f at p; the distance D of p from the nearest segment; and,
        for each knot, a lower bound of the change of D from p to the point p + knot direction.

        direction: the unit directions of lines from p; None if there are no knots.
        knots: increasing lengths along these lines; the last may be infinite.
        """
        real, vector = cast("Any", type(p.x)), cast("Any", type(p))
        epsilon = 2 * float(dr.epsilon(real))  # the machine epsilon
        records, groups = self.data.records, self.data.groups

        def add_segment(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Return the state of the loop over segments after one more segment was visited.

            row: the record of the segment: its start (3), the vector to its end (3), and 1 /
                length^2.
            state: the state before: the distance from the nearest segment so far, the three
                components of the vector from its nearest point to p, the largest rounding error of
                such a vector, and for each knot the smallest value there of the tangents of the
                distances from all segments so far.
            """
            nearest, x, y, z, max_rounding, *bounds = state
            from_start, segment = p - vector(*row[:3]), vector(*row[3:6])
            fraction = clamp(dr.dot(from_start, segment) * row[6], 0, 1)
            away = dr.fma(segment, -fraction, from_start)
            distance = dr.norm(away)
            # The error of the vector is a few roundings of its terms.
            rounding = 8 * epsilon * (dr.norm(from_start) + dr.norm(segment))
            if direction is not None:
                # The slope of the distance along the line, lowered by its rounding error.
                slope = dr.dot(away, direction) / distance - rounding / distance * 2
                bounds = min_with_tangent(
                    bounds, knots, distance - rounding, slope, 4 * epsilon * distance, epsilon
                )
            is_nearer = distance < nearest
            return (
                dr.select(is_nearer, distance, nearest),
                *(dr.select(is_nearer, a, b) for a, b in zip(away, (x, y, z), strict=True)),
                fmax(rounding, max_rounding),
                *bounds,
            )

        zero = 0 * p.x
        # The state before any segment.
        start = (zero + dr.inf, zero, zero, zero, zero, *(zero + dr.inf for _ in knots))
        if groups is None:
            final = records.for_each(add_segment, start, "tube")
        else:
            final = _add_segments_by_groups(
                p, direction, knots, records, groups, add_segment, start
            )
        # The distance, the largest rounding error, and the vector from the nearest point to p.
        distance, error = final[0], final[4]
        away = vector(*final[1:4])
        gradient = dr.select(distance > 0, away / distance, vector(0))
        value = distance - self.data.radius
        error = error + 4 * epsilon * (distance + self.data.radius)
        # The error of a unit vector is that of the vector over its length, and at most 2.
        gradient_error = dr.select(distance > 0, fmin(4 * error / distance, 2), 2)
        sample = Sample(value, gradient, (Lipschitz(zero + 1),), error, gradient_error)
        return sample, distance, tuple(bound - distance - error for bound in final[5:])


def _group_segments(records: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Put the records of segments into groups of `_GROUP_SIZE` consecutive segments. The last group
    is filled up with copies of the last segment.

    records: (n, 7): for each segment its start, the vector from its start to its end, and 1 /
        length^2.

    Returns the records of all groups; and for each group a record of the center and the radius of a
    ball that contains its segments.
    """
    copy_count = -len(records) % _GROUP_SIZE
    records = np.concatenate([records, np.repeat(records[-1:], copy_count, axis=0)])
    ends = np.concatenate([records[:, :3], records[:, :3] + records[:, 3:6]], axis=1)
    points = ends.reshape(-1, 2 * _GROUP_SIZE, 3)
    centers = 0.5 * (points.min(axis=1) + points.max(axis=1))
    radii = np.linalg.norm(points - centers[:, None], axis=2).max(axis=1)
    # (1e-5 covers rounding.)
    return records, np.column_stack([centers, radii * (1 + 1e-5)])


def _add_segments_by_groups(
    p: Vec3,
    direction: Vec3 | None,
    knots: tuple[Real, ...],
    records: RecordTable,
    groups: RecordTable,
    add_segment: Callable[[list[Real], tuple[Any, ...]], tuple[Any, ...]],
    start: tuple[Any, ...],
) -> tuple[Any, ...]:
    """Loop over groups of segments, and return the state of the loop over segments of
    `_TubeEvaluator._sample_with_bounds` with all segments added. A group that is too far away to
    hold the nearest segment is not visited: the distance from its ball takes the place of the
    distances from its segments.

    p: the points.
    direction: the unit directions of lines from p; None if there are no knots.
    knots: increasing lengths along these lines, at which the distance is bounded.
    records: the records of the segments.
    groups: records (center, radius) of the groups' balls.
    add_segment: a function that takes a record and a state, and returns the state with that segment
        added.
    start: the state before any segment.

    Proof. If a segment lies in a ball of radius r about c, its distance from p is at least |p - c|
    - r and at most |p - c| + r. So the nearest segment is in no group whose smallest distance |p -
    c| - r is more than the largest distance |p - c| + r of another group. The distance from the
    ball is a lower bound of the distance from each of its segments. Along the ray it is convex as
    well, and so lies above its own tangent.
    """
    real, vector = cast("Any", type(p.x)), cast("Any", type(p))
    epsilon = 2 * float(dr.epsilon(real))  # the machine epsilon

    def add_ball_end(ball: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Update the state of a loop over balls: the smallest |p - c| + r so far, in a tuple of one
        number.

        ball: the record (center c, radius r) of one more ball.
        """
        return (fmin(dr.norm(p - vector(*ball[:3])) + ball[3], state[0]),)

    # The nearest segment is within `max_distance`.
    (min_end,) = groups.for_each(add_ball_end, (real(dr.inf),), "tube groups")
    max_distance = min_end * (1 + 16 * epsilon) + 16 * epsilon * dr.norm(p)

    def visit_group(i: Any, *state: Any) -> tuple[Any, ...]:
        """Return the next index, and the state of the loop over segments with group i added: by its
        segments if the group is near, else by the tangent of the distance from its ball."""
        ball = groups.read_record(i)
        from_center = p - vector(*ball[:3])
        distance = dr.norm(from_center)
        is_near = distance - ball[3] <= max_distance
        updated = list(state)
        if direction is not None:
            rounding = 8 * epsilon * (dr.norm(p) + distance + ball[3])
            slope = dr.dot(from_center, direction) / distance - 2 * rounding / distance
            start = dr.select(is_near, dr.inf, distance - ball[3] - rounding)
            # From index 5 on the state holds the bounds at the knots. If the group is near, the
            # tangent starts at infinity and changes no bound: the segments do that below.
            updated[5:] = min_with_tangent(
                updated[5:], knots, start, slope, 4 * epsilon * distance, epsilon
            )

        def visit_segment(j: Any, *segment_state: Any) -> tuple[Any, ...]:
            """Return the next index, and the state with segment j of the group added."""
            return j + 1, *add_segment(records.read_record(i * _GROUP_SIZE + j), segment_state)

        def has_more_segments(j: Any, *_: Any) -> Any:
            return j < segment_count

        # A far group has no segments to visit.
        segment_count = dr.select(is_near, type(i)(_GROUP_SIZE), type(i)(0))
        visited = dr.while_loop(
            (type(i)(0), *updated), has_more_segments, visit_segment, label="tube"
        )
        return i + 1, *visited[1:]

    def has_groups(i: Any, *_: Any) -> Any:
        return i < groups.iteration_count

    index = groups.backend.UInt32(0)
    return dr.while_loop((index, *start), has_groups, visit_group, label="tube by groups")[1:]


def min_with_tangent(
    lows: Sequence[Real],
    knots: tuple[Real, ...],
    start: Real,
    slope: Real,
    rounding: Real,
    unit: float,
) -> list[Real]:
    """For each knot (a length along a line), the smaller of two numbers: the bound in `lows`, and
    the value start + slope * knot of a tangent.

    lows: a bound for each knot.
    knots: the lengths; the last may be infinite.
    start: the tangent's value at 0, with an error of up to `rounding`.
    slope: of the tangent, at least -1 (the slope of a distance). NaN, which arises on the segment
        itself, counts as -1.
    unit: the machine epsilon.

    The slope is lowered by four roundings, for the rounding of its product with a knot. A slope of
    0 is lowered once more, because 0 times an infinite knot would be NaN. So the tangent at an
    infinite knot is infinite, with the sign of the slope.
    """
    slope = fmax(slope, -1) - 4 * unit
    slope = dr.select(slope == 0, -unit, slope)
    start = start - rounding
    return [fmin(dr.fma(knot, slope, start), low) for low, knot in zip(lows, knots, strict=True)]


@dataclass(frozen=True)
class TangentEnclosure(Enclosure):
    """A proved bound of the change of F(s), the distance from a set of segments at the length s
    along a line. The gaps are the differences between F(0) and the next level below and above. The
    knots are lengths s at which F is bounded from below.

    distance: F(0), the distance from the nearest segment.
    slope: an upper bound of the derivative at s = 0 of the distance from that segment.
    knots: increasing lengths s; the last may be infinite.
    lower_bounds: for each knot s, a lower bound of F(s) - F(0), which comes from the tangents of
        the distances from all segments.

    Proof. The distance from a segment is a convex function of s, so it lies above its tangent at s
    = 0 (Hart 1996, theorem 4). The smallest of all tangents is a concave function, and lies above
    the chord between any two of its points. So F(s) - F(0) lies above the piecewise linear function
    through 0 at s = 0 and the lower bounds at the knots. The last knot may be infinite. If the
    bound there is -inf, F has no bound beyond the knot before; if it is +inf, no tangent falls, and
    F never falls below the bound at the knot before.

    From above, F(s) is at most the distance from the point that is nearest at s = 0. With D = F(0)
    and m the slope, that is sqrt(D^2 + 2 D m s + s^2). So F does not rise by g before this root is
    D + g, that is, before s^2 + 2 D m s = g^2 + 2 D g. Where these squares overflow, F does not
    rise by g before s = g, since a distance rises at most as fast as the length.
    """

    distance: Real
    slope: Real
    knots: tuple[Real, ...]
    lower_bounds: tuple[Real, ...]

    def free_length(self, gaps: LevelGaps) -> Real:
        """The length of the line on which F is proved to meet neither level: the smaller of two
        lengths. Up to the first, F does not rise to the level above. Up to the second, its lower
        bound does not fall to the level below.

        gaps: the differences between F(0) and these levels.
        """
        # With g the gap above: D m, and g^2 + 2 D g. The positive root s of s^2 + 2 D m s = g^2 + 2
        # D g, in the form without cancellation for each sign of D m.
        half_slope = self.distance * self.slope
        product = gaps.above * (gaps.above + 2 * self.distance)
        root = dr.sqrt(fmax(dr.fma(half_slope, half_slope, product), 0))
        length_up = dr.select(half_slope > 0, product / (half_slope + root), root - half_slope)
        # Squares of large numbers overflow: a distance rises at most as fast as the length.
        length_up = dr.select(dr.isfinite(product) & dr.isfinite(root), length_up, gaps.above)
        length_down, start, bound = 0 * self.distance, 0 * self.distance, 0 * self.distance
        is_free = gaps.below >= 0  # and not NaN
        for knot, next_bound in zip(self.knots, self.lower_bounds, strict=True):
            is_clear = next_bound >= -gaps.below
            # Where the chord from the knot before falls by the gap below. `start` is that knot and
            # `bound` the bound there; before the first knot both are 0.
            part = fmax((gaps.below + bound) / (bound - next_bound) * (knot - start), 0)
            # Up to the whole knot, if the bound there is above the level. Knots after the first one
            # that is not clear (`is_free` is False) change nothing.
            length = dr.select(is_clear, knot, fmin(start + part, knot))
            length_down = dr.select(is_free, length, length_down)
            is_free &= is_clear
            start, bound = knot, next_bound
        is_valid = (length_down >= 0) & (length_up >= 0)
        # (1e-6 covers the rounding of the length.)
        return dr.select(is_valid, fmin(length_down, length_up) * (1 - 1e-6), 0)


# The box of a tube is enlarged on each side by this fraction of the box's longest side.
_BOX_MARGIN = 1e-5
# The radius of the ball on which second derivatives are bounded, as a fraction of the distance to
# the segment.
_TAYLOR_RADIUS = 0.5


class TubeNetwork(PatchField):
    """The surfaces at distance `radius` from each of a set of segments, such as edges of meshes,
    wires or struts. Each segment is a patch: its tube is a level set of a function of its own, in a
    box of its own.

    points: (n, 3).
    segments: (m, 2) indices of points, counted from 0.
    radius: a number, or (m,), one for each segment.

    Tubes have round ends (`harnack.fields.capabilities` explains patches). A ray evaluates only the
    patches whose boxes it enters, so that thousands of segments take little more time than one.
    `Hits.primitive_index` is the index of the segment. A level is added to the radius of all tubes.
    For a single polyline, and for combinations with other solids, use `Tube`.

    Raises:
        ValueError: arrays of other shapes, numbers that are not finite, an index out of range, a
            segment without a length, or a radius that is not positive.
    """

    default_level: float = 0.0
    no_single_function = (
        "tubes are no level set of one function, but of one for each segment: take "
        "harnack.Tube for one polyline that is to be evaluated or combined with other solids"
    )

    def __init__(self, points: Any, segments: Any, radius: Any) -> None:
        """Check points, segments and radius (see the class), and store them as NumPy arrays."""
        self.points: FloatArray = checked_points(points)
        self.segments: IntArray = checked_pairs(segments, self.points)
        if len(self.segments) >= MAX_BOXES:
            raise ValueError(f"{len(self.segments):,} segments are too many: at most {MAX_BOXES:,}")
        self.radius: FloatArray = checked_radii(radius, len(self.segments))

    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """Return two arrays (m, 3): the lower and the upper corners of boxes. There is a box for
        each segment, which contains the segment's tube.

        levels: values of f that are drawn; the largest is added to the radii. None for the default
            level.
        """
        level = max((self.default_level,) if levels is None else levels)
        ends = self.points[self.segments]
        enlarged_radius = (self.radius + level)[:, None]
        lower, upper = ends.min(axis=1) - enlarged_radius, ends.max(axis=1) + enlarged_radius
        slack = _BOX_MARGIN * (upper - lower).max(axis=1)[:, None]
        return lower - slack, upper + slack

    @cached_upload
    def _upload(self, backend: Backend, levels: tuple[float, ...]) -> _TubePatches:
        """Upload the boxes of all tubes, and the records of their segments, to a backend. Positions
        are relative to the center of the boxes, so that they are rounded less."""
        boxes = PatchBoxes.upload(backend, *self.boxes(levels))
        center = np.array(boxes.center, dtype=np.float64).reshape(3)
        start, end = ((self.points[ends] - center) for ends in self.segments.T)
        segment = end - start
        inverse = 1.0 / (segment * segment).sum(axis=1)
        rows = np.column_stack([start, self.radius, segment, inverse])
        return _TubePatches(boxes, RecordTable.upload(backend, rows))

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level that leaves nothing of the thinnest tube."""
        min_radius = float(self.radius.min())
        for level in levels:
            if not level > -min_radius:
                raise ValueError(
                    f"level {level:g} leaves nothing of the thinnest tube, of radius {min_radius:g}"
                )

    def describe(self) -> dict[str, Any]:
        return {"segments": len(self.segments)}


@dataclass(frozen=True)
class _TubePatches(PatchesInBoxes):
    """The tubes of a network on a backend.

    segments: for each segment a record of its start, the radius of its tube, the vector from its
        start to its end, and 1 / length^2. Positions are relative to the center of the boxes.
    """

    segments: RecordTable

    def patch(self, index: Any) -> Evaluator:
        return _SegmentEvaluator(self.boxes, self.segments.read_record(index))


@dataclass(frozen=True, eq=False)
class _SegmentEvaluator(Evaluator):
    """The evaluator of one tube of a network: of the distance D from its segment minus its radius
    r. Each lane may have another segment.

    boxes: the boxes of all tubes. Only the center of all of them together is used, to which the
        positions in records are relative.
    row: the record of the segment: its start, the radius of its tube, the vector from its start to
        its end, and 1 / length^2. Each entry is a Dr.Jit array.

    D is convex, as the distance from a convex set, and its Lipschitz constant is 1. Proof of the
    bound of second derivatives. Along any line they are at most 1/D (Hart 1996): for the distance
    from a point or from a line the second derivative is 1/D across the gradient, and the distance
    from a segment is everywhere one of these two distances. So on a ball of radius s < D about p it
    is at most 1/(D - s). Here s = D/2, so that the bound is 1/s.
    """

    boxes: PatchBoxes
    row: list[Real]

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value and gradient of D - r, with two proved bounds near p: the
        Lipschitz constant 1, and a bound of second derivatives on a ball."""
        backend, row = self.boxes.backend, self.row
        vector, epsilon = backend.Array3f, 2 * backend.machine_epsilon
        # The record: the start of the segment (0 to 2), the radius (3), the vector from the start
        # to the end (4 to 6), and 1 / length^2 (7). Positions are relative to the center of the
        # boxes.
        from_start = vector(p) - self.boxes.center - vector(*row[:3])
        segment = vector(*row[4:7])
        # The position of the segment's point nearest to p, as a fraction of the segment; and the
        # vector from that point to p.
        fraction = clamp(dr.dot(from_start, segment) * row[7], 0, 1)
        away = dr.fma(segment, vector(-fraction), from_start)
        distance = dr.norm(away)
        # The error of the vector is a few roundings of its terms.
        vector_error = (
            8 * epsilon * (dr.norm(from_start) + dr.norm(segment) + dr.norm(vector(*row[:3])))
        )
        error = vector_error + 4 * epsilon * (distance + row[3])
        gradient = dr.select(distance > 0, away / distance, vector(0))
        # The error of a unit vector is that of the vector over its length, and at most 2.
        gradient_error = dr.select(distance > 0, dr.minimum(4 * error / distance, 2), 2)
        # The distance D is convex with second derivatives of at most 1/D. So on the ball of radius
        # D/2 they are at most 2/D, one over that radius. D is taken as the smallest possible one.
        taylor_radius = _TAYLOR_RADIUS * fmax(distance - error, 0)
        promises: tuple[Promise, ...] = (
            Lipschitz(backend.Float(1)),
            TaylorRemainder(1 / taylor_radius, taylor_radius),
        )
        return Sample(distance - row[3], gradient, promises, error, gradient_error)


def checked_points(points: Any, names: tuple[str, str] = ("point", "tubes")) -> FloatArray:
    """Check points, and return them as a read-only array (n, 3).

    names: what a point and the whole are called in messages.

    Raises:
        ValueError: a wrong shape, or coordinates that are not finite or too large.
    """
    point, whole = names
    array = as_real_array(points, f"the {point}s of {whole}")
    check_vectors(array, f"the {point}s of {whole}")
    result: FloatArray = np.array(array, dtype=np.float64)
    check_finite(result, f"{point} {{}} of {whole}", ValueError)
    check_coordinate_size(result, ValueError)
    result.setflags(write=False)
    return result


def checked_pairs(
    pairs: Any, points: FloatArray, names: tuple[str, str, str] = ("segment", "point", "tubes")
) -> IntArray:
    """Check pairs of points, and return them as a read-only array (m, 2) of indices of points.

    points: (n, 3).
    names: what a pair, a point, and the whole are called in messages.

    Raises:
        ValueError: a wrong shape or type, an index out of range, or a pair without a length.
    """
    pair, point, whole = names
    array = as_real_array(pairs, f"the {pair}s of {whole}")
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"the {pair}s of {whole} must have shape (m, 2), not {array.shape}")
    if array.dtype.kind not in "iu":
        raise ValueError(f"the {pair}s of {whole} must be integer indices, not {array.dtype}")
    indices = np.array(array, dtype=np.int64)
    # Each index must be that of a point.
    if (bad := np.flatnonzero(((indices < 0) | (indices >= len(points))).any(axis=1))).size:
        raise ValueError(
            f"{pair} {bad[0]} joins {point}s {indices[bad[0], 0]} and {indices[bad[0], 1]}: there "
            f"are {len(points):,} {point}s, counted from 0"
        )
    ends = points[indices]
    if (empty := np.flatnonzero(np.abs(ends[:, 0] - ends[:, 1]).max(axis=1) < 1e-100)).size:
        raise ValueError(f"{pair} {empty[0]} has no length: leave it out")
    indices.setflags(write=False)
    return indices


def checked_radii(
    radius: Any, count: int, names: tuple[str, str] = ("segment", "tubes")
) -> FloatArray:
    """Check a radius, a number or an array (count,), and return the radii (count,).

    names: what each of them belongs to, and what the whole is called in messages.

    Raises:
        ValueError: a wrong shape, or a radius that is not positive.
    """
    entry, whole = names
    array = as_real_array(radius, f"the radius of {whole}")
    if array.ndim == 0:
        return np.full(count, as_positive(radius, f"the radius of {whole}"))
    if array.shape != (count,):
        raise ValueError(
            f"the radius of {whole} is a number or has shape ({count},), one for each {entry}, not "
            f"{array.shape}"
        )
    radii = np.array(array, dtype=np.float64)
    for k in np.flatnonzero(~((radii > 0) & np.isfinite(radii)))[:1].tolist():
        as_positive(float(radii[k]), f"the radius of {entry} {k} of {whole}")
    return radii
