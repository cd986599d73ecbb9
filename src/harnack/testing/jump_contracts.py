"""Tests of the jumps of a field by random rays (`fields.capabilities.Jumps`). The function f of
such a field jumps across facets, such as triangles. Facets cut a ray into intervals. On each
interval the tracer does not march along the field itself but along its continuation, another field,
which has the values of f there. Here both are compared, and what is said of the crossings is
tested."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray, IntArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import SlopeRange
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.testing.violation_search import (
    FieldSamples,
    distance_to_exit,
    random_directions,
    require,
    sample_field,
    samples_as_arrays,
    to_lanes,
)

if TYPE_CHECKING:
    from harnack.backend import BoolArray
    from harnack.fields.capabilities import Jumps
    from harnack.fields.field import Field

__all__ = ["check_jumps"]

# The number of rays through each point, and of restarts of the search for crossings on each ray.
_RAYS_PER_POINT, _RESTARTS = 3, 3
# The points of an interval at which f is sampled, as fractions of its length.
_FRACTIONS = np.array([0.0, 0.03, 0.12, 0.3, 0.5, 0.7, 0.88, 0.97, 1.0])
# Intervals narrower than this fraction of the size of all coordinates are left out: rounding moves
# their points across facets.
_MIN_RELATIVE_WIDTH = 1e-8
# Relative roundings: of values, of a unit normal, and of a coordinate of a point on a ray.
_VALUE_ROUNDING, _NORMAL_ROUNDING, _COORDINATE_ROUNDING = 1e-9, 1e-6, 2.0**-48


def check_jumps(field: Field, points: FloatArray, rng: np.random.Generator) -> None:
    """Check what a field says of its jumps, on random rays through points (n, 3) of its domain. A
    field without jumps passes.

    rng: a generator of random numbers.

    These checks are made:

    - `next_crossing` lists the crossings of a ray in ascending order of (t, facet), up to the given
      t. Each has a unit normal on the side where f is larger. The list is the same from any start.
    - Between two crossings `continuation` has the values of f, if it gets `initial_offset` plus the
      jumps since the start. At both ends it has the limit of f, so that from one interval to the
      next it changes by the jump.
    - `distance`, where it is defined, is at most the length of each ray up to its first crossing.
    - f keeps on the interval what samples of the continuation promise (proved bounds of f near a
      point).

    A field that takes its levels only at its facets (`Jumps.takes_all_levels`) does not have the
    values of f elsewhere: for it only the crossings are tested.

    Raises:
        BrokenPromiseError: naming the method that is wrong, and a point.
        TypeError: a method returns something of another type.
    """
    jumps = field.evaluator(choose_backend("double")).jumps
    if jumps is None:
        return
    rays = _random_rays(field, points, rng)
    crossings = _follow_crossings(jumps, rays)
    if jumps.gives_distances:
        _check_distance(jumps, rays, crossings[1])
    for _ in range(_RESTARTS):
        _check_restart(jumps, rays, crossings, rng)
    if not jumps.takes_all_levels:
        _check_continuation(field, jumps, _cut_into_intervals(jumps, rays, crossings))


@dataclass(frozen=True)
class _Rays:
    """n rays o + t d within the domain of a field.

    o, d: (n, 3) origins, and unit directions.
    start, end: (n,) the smallest and the largest t.
    """

    o: FloatArray
    d: FloatArray
    start: FloatArray
    end: FloatArray

    def point(self, t: FloatArray) -> FloatArray:
        """The points (n, 3) with the parameters t (n,)."""
        return self.o + t[:, None] * self.d

    def subset(self, rows: BoolArray | IntArray) -> _Rays:
        """Some of the rays, by a mask or by indices."""
        return _Rays(self.o[rows], self.d[rows], self.start[rows], self.end[rows])


@dataclass(frozen=True)
class _Crossings:
    """One crossing of each of n rays with a facet, or an end of the ray: the numbers of a
    `JumpCrossing` as NumPy arrays, t (n,), facet (n,), jump (n,) and normal (n, 3)."""

    t: FloatArray
    facet: IntArray
    jump: FloatArray
    normal: FloatArray

    @property
    def is_found(self) -> BoolArray:
        """(n,) whether there is a crossing."""
        return np.asarray(np.isfinite(self.t) & (self.facet != NO_FACET))

    def on_device(self) -> JumpCrossing:
        """These crossings as arrays of Dr.Jit, in double precision."""
        backend = choose_backend("double")
        return JumpCrossing(
            backend.Float(np.ascontiguousarray(self.t)),
            backend.UInt32(np.ascontiguousarray(self.facet.astype(np.uint32))),
            backend.Float(np.ascontiguousarray(self.jump)),
            to_vector3(backend, self.normal),
        )

    def subset(self, rows: BoolArray | IntArray) -> _Crossings:
        """Some of the crossings, by a mask or by indices."""
        return _Crossings(self.t[rows], self.facet[rows], self.jump[rows], self.normal[rows])


def _random_rays(field: Field, points: FloatArray, rng: np.random.Generator) -> _Rays:
    """Random rays through points (n, 3), `_RAYS_PER_POINT` for each. They start at the point, or
    begin before it and start there, and end where they leave the domain."""
    start_points = np.tile(points, (_RAYS_PER_POINT, 1))
    n = len(start_points)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    d = random_directions(rng, n)
    length = np.minimum(distance_to_exit(field, start_points, d), 2 * size)
    # Half of the rays have their origin at the point.
    start = np.where(rng.random(n) < 0.5, 0.0, size * rng.random(n))
    return _Rays(start_points - start[:, None] * d, d, start, start + length)


def _next_crossings(
    jumps: Jumps, rays: _Rays, after: _Crossings, t_max: FloatArray, active: BoolArray
) -> _Crossings:
    """The result of `Jumps.next_crossing` as NumPy arrays. On rays that are not active it is that
    there is no crossing."""
    backend = choose_backend("double")
    n = len(rays.o)
    crossing = jumps.next_crossing(
        to_vector3(backend, rays.o),
        to_vector3(backend, rays.d),
        after.on_device(),
        backend.Float(np.ascontiguousarray(t_max)),
        backend.Bool(np.ascontiguousarray(active)),
    )
    normal = np.broadcast_to(to_numpy(backend.Array3f(*crossing.normal)), (n, 3))
    return _Crossings(
        np.where(active, to_lanes(crossing.t, n), np.inf),
        np.where(active, to_lanes(crossing.facet, n), NO_FACET).astype(np.int64),
        np.where(active, to_lanes(crossing.jump, n), 0.0),
        np.where(active[:, None], normal, rays.d),
    )


def _starts(rays: _Rays, t: FloatArray) -> _Crossings:
    """The places with the parameters t (n,) on rays, as crossings with no facet."""
    n = len(t)
    return _Crossings(t, np.full(n, NO_FACET), np.zeros(n), rays.d)


def _follow_crossings(jumps: Jumps, rays: _Rays) -> list[_Crossings]:
    """All crossings of the rays one after the other, as `Jumps.next_crossing` gives them. The first
    entry is the start of the rays, the last one the end of all of them, where none finds a
    crossing.

    Raises:
        BrokenPromiseError: the crossings are not in order, or a number is not valid.
    """
    crossings = [_starts(rays, rays.start)]
    active = np.full(len(rays.o), True)
    while active.any():
        before = crossings[-1]
        now = _next_crossings(jumps, rays, before, rays.end, active)
        _check_crossings(f"{type(jumps).__name__}.next_crossing", rays, before, now)
        active = now.is_found
        crossings.append(now)
    return crossings


def _check_distance(jumps: Jumps, rays: _Rays, first: _Crossings) -> None:
    """Check that `Jumps.distance` at the starts of rays is no longer than the way to the first
    crossing, `first`. Raises a BrokenPromiseError if it is."""
    backend = choose_backend("double")
    start = rays.point(rays.start)
    distance = to_numpy(jumps.distance(to_vector3(backend, start)) + 0 * backend.Float(rays.start))
    length = first.t - rays.start
    excess = np.where(first.is_found, distance - length, 0.0)
    allowed = 1e-9 * (np.abs(length) + np.abs(start).max(axis=1))
    message = f"{type(jumps).__name__}.distance is longer than a way to a facet"
    require(~(excess > allowed), message, start, excess)


def _check_crossings(name: str, rays: _Rays, before: _Crossings, now: _Crossings) -> None:
    """Check the numbers of crossings, and that they follow the crossings `before`. Raises a
    BrokenPromiseError that begins with `name` if not."""
    is_found = now.is_found
    at = rays.point(np.where(np.isfinite(now.t), now.t, rays.start))
    is_none = (now.t == np.inf) & (now.facet == NO_FACET) & (now.jump == 0)
    message = (
        f"{name}: t, facet and jump must be a number, an index and a number, or inf, NO_FACET and "
        "0 where there is no crossing"
    )
    require((is_found & np.isfinite(now.jump)) | is_none, message, at)
    is_later = (now.t > before.t) | ((now.t == before.t) & (now.facet > before.facet))
    message = f"{name}: the crossing is not after the crossing `after`, in the order of (t, facet)"
    require(is_later | ~is_found, message, at)
    # A few roundings more, as fields compute in units of their own.
    is_within = now.t <= rays.end + 1e-12 * (np.abs(rays.end) + np.abs(rays.o).max(axis=1))
    require(is_within | ~is_found, f"{name}: the crossing is beyond t_max", at)
    length = np.linalg.norm(now.normal, axis=1)
    is_unit = np.abs(length - 1) <= _NORMAL_ROUNDING
    require(is_unit | ~is_found, f"{name}: the normal does not have the length 1", at)
    rise = np.einsum("nk,nk->n", now.normal, rays.d) * now.jump
    is_uphill = rise >= -_NORMAL_ROUNDING * np.abs(now.jump)
    message = (
        f"{name}: the normal is not on the side where f is larger: (normal . d) jump is negative"
    )
    require(is_uphill | ~is_found, message, at)


def _check_restart(
    jumps: Jumps, rays: _Rays, crossings: list[_Crossings], rng: np.random.Generator
) -> None:
    """Check that a search for crossings that begins elsewhere on the rays, and ends elsewhere,
    finds one of the known crossings: the first one behind its start. Raises a BrokenPromiseError if
    it finds another one, or none.

    crossings: all crossings of the rays, from `_follow_crossings`.
    """
    low, high = np.sort(rng.uniform(rays.start, rays.end, (2, len(rays.o))), axis=0)
    active = np.full(len(low), True)
    restarted = _next_crossings(jumps, rays, _starts(rays, low), high, active)
    # Later crossings are overwritten by earlier ones.
    t, facet, jump = np.full(len(low), np.inf), np.full(len(low), NO_FACET), np.zeros(len(low))
    for known in reversed(crossings[1:]):
        is_met = known.is_found & (known.t > low) & (known.t <= high)
        t, facet = np.where(is_met, known.t, t), np.where(is_met, known.facet, facet)
        jump = np.where(is_met, known.jump, jump)
    message = (
        f"{type(jumps).__name__}.next_crossing: t, facet or jump depend on where the search begins "
        "and ends"
    )
    is_same = (restarted.t == t) & (restarted.facet == facet) & (restarted.jump == jump)
    require(is_same, message, rays.point(low))


@dataclass(frozen=True)
class _Intervals:
    """m intervals of rays between two consecutive crossings.

    rays: the m rays on which the intervals lie.
    behind, ahead: the crossings at both ends, or an end of the ray.
    offset: (m,) `Jumps.initial_offset` plus the jumps since the start.
    stop: (m,) the largest t, which is finite.
    size: (m,) a bound of the coordinates of all points of the rays.
    ray, number: (m,) the index of the ray, and that of the interval on it.
    """

    rays: _Rays
    behind: _Crossings
    ahead: _Crossings
    offset: FloatArray
    stop: FloatArray
    size: FloatArray
    ray: IntArray
    number: IntArray

    def subset(self, rows: BoolArray | IntArray) -> _Intervals:
        """Some of the intervals, by a mask or by indices."""
        return _Intervals(
            self.rays.subset(rows),
            self.behind.subset(rows),
            self.ahead.subset(rows),
            self.offset[rows],
            self.stop[rows],
            self.size[rows],
            self.ray[rows],
            self.number[rows],
        )

    @property
    def is_wide(self) -> BoolArray:
        """(m,) whether rounding leaves the points of an interval on their side of its facets, also
        if the ray meets one at a small angle."""
        sines = [
            np.where(end.is_found, np.abs(np.einsum("nk,nk->n", end.normal, self.rays.d)), 1.0)
            for end in (self.behind, self.ahead)
        ]
        width = (self.stop - self.behind.t) * np.minimum(*sines)
        return np.asarray(width > _MIN_RELATIVE_WIDTH * self.size)


def _cut_into_intervals(jumps: Jumps, rays: _Rays, crossings: list[_Crossings]) -> _Intervals:
    """The intervals of rays between their crossings (`_follow_crossings`): the first intervals of
    all rays, then the second ones, and so on. Of the last one of a ray, the end of the ray is the
    end."""
    backend = choose_backend("double")
    n = len(rays.o)
    initial = jumps.initial_offset(
        to_vector3(backend, rays.o),
        to_vector3(backend, rays.d),
        backend.Float(np.ascontiguousarray(rays.start)),
        backend.Bool(np.full(n, True)),
    )
    offset, active = to_lanes(initial, n), np.full(n, True)
    size = np.abs(rays.o).max(axis=1) + rays.end
    parts: list[_Intervals] = []
    for behind, ahead in itertools.pairwise(crossings):
        offset = offset + behind.jump
        stop = np.where(ahead.is_found, ahead.t, rays.end)
        ray, number = np.arange(n), np.full(n, len(parts))
        part = _Intervals(rays, behind, ahead, offset, stop, size, ray, number)
        parts.append(part.subset(active))
        active = ahead.is_found
    return _concatenate(parts)


def _concatenate(parts: list[_Intervals]) -> _Intervals:
    """All intervals of several groups as one group."""
    rays, behind, ahead = (
        [getattr(part, name) for part in parts] for name in ("rays", "behind", "ahead")
    )

    def joined(records: Any, names: str) -> list[Any]:
        """The attributes with these names, each of all records in one array."""
        return [
            np.concatenate([getattr(record, name) for record in records]) for name in names.split()
        ]

    return _Intervals(
        _Rays(*joined(rays, "o d start end")),
        _Crossings(*joined(behind, "t facet jump normal")),
        _Crossings(*joined(ahead, "t facet jump normal")),
        *joined(parts, "offset stop size ray number"),
    )


def _check_continuation(field: Field, jumps: Jumps, intervals: _Intervals) -> None:
    """Check values and promises of the field that `Jumps.continuation` gives on intervals, those of
    `_cut_into_intervals`. Raises a BrokenPromiseError if the field `field` does not have these
    values, or breaks these promises."""
    wide = intervals.subset(intervals.is_wide)
    if not len(wide.stop):
        return
    m, k = len(wide.stop), len(_FRACTIONS)
    width = (wide.stop - wide.behind.t)[:, None]
    t = wide.behind.t[:, None] + width * _FRACTIONS
    # All points of the first interval, then of the second one, and so on.
    each = wide.subset(np.repeat(np.arange(m), k))
    points = each.rays.point(t.ravel())
    samples = _sample_continuation(jumps, each, points)
    name = f"{type(jumps).__name__}.continuation"
    is_number = np.isfinite(samples.value) & np.isfinite(samples.gradient).all(axis=1)
    require(is_number, f"{name}: the value or the gradient is not a finite number", points)
    # The rounding of values, and of points on a ray.
    rounding = _VALUE_ROUNDING * (np.abs(samples.value) + np.abs(each.offset))
    slope = np.linalg.norm(samples.gradient, axis=1)
    rounding += samples.error + _COORDINATE_ROUNDING * each.size * slope
    _check_values(field, name, each, points, samples, rounding)
    _check_promises(name, wide, t, samples, rounding.reshape(m, k))
    _check_ends(name, wide, samples.value.reshape(m, k), rounding.reshape(m, k))


def _check_values(
    field: Field,
    name: str,
    each: _Intervals,
    points: FloatArray,
    samples: FieldSamples,
    rounding: FloatArray,
) -> None:
    """Check that samples of a continuation have the values of f between the ends of their
    intervals, where it is known on which side of all facets a point lies. Raises a
    BrokenPromiseError that contains `name` if not.

    each: the interval of each sample.
    points: (n, 3) the points of the samples, `_FRACTIONS` on each interval.
    rounding: (n,) bounds of the rounding of their values.
    """
    is_inner = np.tile((_FRACTIONS > 0) & (_FRACTIONS < 1), len(points) // len(_FRACTIONS))
    exact = sample_field(field, points[is_inner])
    value, offset = samples.value[is_inner], each.offset[is_inner]
    error = value - exact.value
    allowed = rounding[is_inner] + exact.error + _VALUE_ROUNDING * np.abs(exact.value)
    # Differences as they come from numbers in single precision.
    is_wrong = ~(np.abs(error) <= allowed)
    is_small = np.abs(error) <= 2.0**-22 * (np.abs(value) + np.abs(offset)).max()
    hint = (
        " (in single precision it would be: dr.select of two Python numbers is a number of single "
        "precision, write type(p.x)(1.5) for one of them)"
        if is_small[is_wrong].all()
        else ""
    )
    is_first = each.behind.facet[is_inner] == NO_FACET
    rows: BoolArray
    for rows, place, other in (
        (is_first, "in front of the first crossing", "initial_offset"),
        (~is_first, "behind a crossing", "the jump there"),
    ):
        message = f"{name} is not f {place}: it is wrong, or {other}{hint}"
        require(~is_wrong[rows], message, points[is_inner][rows], error[rows])


def _sample_continuation(jumps: Jumps, each: _Intervals, points: FloatArray) -> FieldSamples:
    """Samples of `Jumps.continuation` at one point (n, 3) of each of n intervals. Promises that
    hold only along the ray are among their promises."""
    backend = choose_backend("double")
    field = jumps.continuation(
        to_vector3(backend, each.rays.o),
        to_vector3(backend, each.rays.d),
        each.behind.on_device(),
        each.ahead.on_device(),
        backend.Float(np.ascontiguousarray(each.offset)),
    )
    sample = field.evaluate(to_vector3(backend, points))
    promises = sample.promises + sample.ray_promises
    return samples_as_arrays(dataclasses.replace(sample, promises=promises), len(points))


def _check_promises(
    name: str, wide: _Intervals, t: FloatArray, samples: FieldSamples, rounding: FloatArray
) -> None:
    """Check the promises of samples of a continuation: between two samples of an interval f does
    not change by more than is promised at the first one. Raises a BrokenPromiseError that begins
    with `name` if it does.

    wide: m intervals.
    t: (m, k) the parameters of the samples.
    samples: the m * k samples.
    rounding: (m, k) bounds of the rounding of values.
    """
    m, k = t.shape
    value = samples.value.reshape(m, k)
    slope = np.einsum("mkj,mj->mk", samples.gradient.reshape(m, k, 3), wide.rays.d)
    gradient_error = samples.gradient_error.reshape(m, k)
    for promise in samples.promises:
        # (`map_numbers` also passes the exponents of each number's unit.)
        table = promise.map_numbers(lambda number, _, __: number.reshape(m, k))
        for column in range(k):
            at = table.map_numbers(lambda number, _, __, c=column: number[:, c : c + 1])
            length = t - t[:, column, None]
            # The slope in the direction of the other sample.
            along = slope[:, column, None] * np.sign(length)
            slopes = SlopeRange.around(along, gradient_error[:, column, None])
            moved = value - value[:, column, None]
            with np.errstate(invalid="ignore"):  # 0 * inf
                lower, upper = at.movement_bounds(value[:, column, None], slopes, np.abs(length))
                excess = np.maximum(moved - upper, lower - moved)
            is_within = (np.abs(length) < at.radius) & (length != 0)
            allowed = rounding + rounding[:, column, None] + _VALUE_ROUNDING * np.abs(moved)
            excess = np.where(is_within, excess - allowed, -np.inf)
            worst = excess.argmax(axis=1)
            rows = np.arange(len(t))
            message = (
                f"{name}: f leaves what {type(promise).__name__} promises here by more than "
                "rounding"
            )
            there = wide.rays.point(t[rows, worst])
            here = wide.rays.point(t[:, column])
            require(excess.max(axis=1) <= 0, message, here, excess.max(axis=1), there)


def _check_ends(name: str, wide: _Intervals, value: FloatArray, rounding: FloatArray) -> None:
    """Check that the values of a continuation, from the end of an interval to the start of the next
    one, change by the jump of f at the crossing between them. Raises a BrokenPromiseError that
    begins with `name` if not.

    wide: m intervals. Neighbors of which one is missing are left out.
    value, rounding: (m, k) their values, from the first to the last point, and bounds of the
        rounding.
    """
    order = np.lexsort((wide.number, wide.ray))
    first, second = order[:-1], order[1:]
    is_next = (wide.ray[first] == wide.ray[second]) & (
        wide.number[first] + 1 == wide.number[second]
    )
    first, second = first[is_next], second[is_next]
    jump = wide.ahead.jump[first]
    error = value[second, 0] - value[first, -1] - jump
    allowed = rounding[first, -1] + rounding[second, 0] + _VALUE_ROUNDING * np.abs(jump)
    message = f"{name}: at a crossing its limits from both sides do not differ by the jump there"
    points = wide.rays.subset(first).point(wide.stop[first])
    require(np.abs(error) <= allowed, message, points, error)
