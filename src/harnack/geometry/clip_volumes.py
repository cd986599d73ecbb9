"""Clip volumes, the convex sets to which rays are cut: ball, box, half-space and their
intersections, and polytopes in general. A ray is o + t d, with origin o, direction d and ray
parameter t. A plane n.x = h has the unit normal n, which points out of the volume, and the offset
h; the volume lies in n.x <= h. Host means NumPy, in double precision; a kernel is a program that
Dr.Jit compiles for the device, for many rays at once (lanes)."""

from __future__ import annotations

import abc
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, TypeVar, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import (
    Backend,
    BoolArray,
    FloatArray,
    Mask,
    Real,
    Vec3,
    backend_of,
    upload_floats,
)
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_real
from harnack.geometry.volume import (
    Point,
    Volume,
    as_padding,
    as_point,
    as_points,
    check_volume,
    clip_rounding,
    normalize_empty_interval,
)

__all__ = ["Ball", "Box", "HalfSpace", "VolumeIntersection", "box_around_volumes"]

MAX_UNROLLED = 32
"""Up to this number of planes, the loop over planes is unrolled in the kernel."""

_PLANES_PER_ITERATION = 4
_UNBOUNDED_PLANE = (0.0, 0.0, 0.0, 1e30)

FoldState = TypeVar("FoldState", bound=tuple[Any, ...])
Uploaded = TypeVar("Uploaded", bound="Polytope")


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes of a polytope for a kernel: a plane n.x <= h (n a unit normal, h an offset) is a row
    (n, h) of four numbers. The kernel either contains these numbers as literals, or reads them from
    a buffer on the device.

    backend: the backend on which the kernel runs.
    rows: (m, 4) on the host.
    buffer: the rows on the backend; None if they are literals.
    plane_count: the number of rows in the buffer, as a kernel parameter (a number that may change
        without compiling again).
    max_offset: the largest |h|; a kernel parameter if there is a buffer.

    Time per plane and ray: 0.4 ns if the loop over planes is unrolled, where reading a number from
    the buffer at a literal index takes no longer than a literal; 1.1 ns in a loop with four planes
    per iteration.
    """

    backend: Backend
    rows: FloatArray
    buffer: Any
    plane_count: Any
    max_offset: Real

    @classmethod
    def literal(cls, backend: Backend, rows: FloatArray) -> PlaneTable:
        """A table whose rows (m, 4) are literals of the kernel."""
        return cls(backend, rows, None, None, backend.Float(_max_offset(rows)))

    @classmethod
    def upload(cls, backend: Backend, rows: FloatArray) -> PlaneTable:
        """A table whose rows (m, 4) are in a buffer. If there are more than eight, planes without
        effect fill it up to a multiple of eight, so that volumes with about as many planes share a
        kernel."""
        count = len(rows) if len(rows) <= 8 else -(-len(rows) // 8) * 8
        padded = np.concatenate([rows, np.tile(_UNBOUNDED_PLANE, (count - len(rows), 1))])
        plane_count = dr.opaque(backend.UInt32, count)
        max_offset = dr.opaque(backend.Float, _max_offset(rows))
        return cls(backend, padded, upload_floats(backend, padded.ravel()), plane_count, max_offset)

    def fold(
        self,
        state: FoldState,
        step: Callable[[FoldState, Vec3, Real], FoldState],
        may_change: Callable[..., Mask] | None = None,
    ) -> FoldState:
        """Apply state = step(state, n, h) to one plane n.x <= h after the other, and return the
        last state.

        state: a tuple of arrays.
        step: returns the next state from the state, the normal n and the offset h of a plane.
        may_change: may_change(*state) is False in lanes in which no further plane can change the
            result; a recorded loop stops there. If the loop is unrolled (few planes), all planes
            are applied.
        """
        index = self.backend.UInt32
        if self.buffer is None or len(self.rows) <= MAX_UNROLLED:
            for k in range(len(self.rows)):
                x, y, z, h = (self._entry(k, i) for i in range(4))
                state = step(state, self.backend.Array3f(x, y, z), h)
            return state

        def body(k: Any, *values: Any) -> tuple[Any, ...]:
            """Apply the step to the planes of the four rows from row k on. Returns the index of the
            next row, and the new state. values: the state."""
            folded: Any = values
            for i in range(_PLANES_PER_ITERATION):
                row: Any = dr.gather(self.backend.Array4f, self.buffer, k + i)
                folded = step(folded, self.backend.Array3f(row.x, row.y, row.z), row.w)
            return (k + _PLANES_PER_ITERATION, *folded)

        def may_continue(*values: Any) -> Mask:
            """The mask of lanes in which further planes may change the state. values: the state."""
            return self.backend.Bool(True) if may_change is None else may_change(*values)

        while_loop: Any = dr.while_loop  # its overloads do not know run-time array types
        result: Any = while_loop(
            state=(index(0), *state),
            cond=lambda k, *values: (k < self.plane_count) & may_continue(*values),  # pyright: ignore
            body=body,
            label="planes",
        )
        return result[1:]

    def _entry(self, k: int, i: int) -> Real:
        """Entry i (0 to 2 for the normal, 3 for the offset) of row k: a literal, or read from the
        buffer."""
        if self.buffer is None:
            return self.backend.Float(float(self.rows[k, i]))
        return dr.gather(self.backend.Float, self.buffer, self.backend.UInt32(4 * k + i))


RoundingSlacks: TypeAlias = tuple[Real, Real]


def _max_offset(rows: FloatArray) -> float:
    """The largest |h| of the planes (n, h), given by rows (m, 4)."""
    return float(np.abs(rows[:, 3]).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Polytope(Volume):
    """The intersection of half-spaces n.x <= h, each on the inner side of a plane with the unit
    normal n and the offset h. Subclasses say which planes they have (`planes`); all other methods
    follow.

    Rounding. A point o + t d of a ray lies in a half-space if N - t D >= 0, with N = h - n.o and D
    = n.d. With u the unit roundoff, the computed N and D are off by at most a few u times |n|.|o| +
    |h| and |n|.|d| (absolute values of each component). Adding such a bound to N and subtracting it
    from D, for t >= 0, turns N - t D >= 0 into a condition that every point of the volume still
    meets. No special case for nearly parallel rays is needed: where D <= 0, the condition is t >=
    |N / D| if N < 0, and always true if N >= 0.
    """

    _device_planes: PlaneTable | None = field(default=None, repr=False, compare=False, kw_only=True)

    @abc.abstractmethod
    def planes(self) -> FloatArray:
        """The planes as rows (nx, ny, nz, h), shape (m, 4), float64, all finite."""

    def upload(self: Uploaded, backend: Backend) -> Uploaded:
        """An equal polytope whose planes are in a buffer on the backend."""
        return replace(self, _device_planes=PlaneTable.upload(backend, self.planes()))

    def _plane_table(self, backend: Backend) -> PlaneTable:
        """The uploaded table of planes if there is one for this backend, otherwise a new one. A new
        table consists of literals if there are few planes, or while a loop is recorded, when
        nothing can be uploaded."""
        if self._device_planes is not None and self._device_planes.backend == backend:
            return self._device_planes
        rows = self.planes()
        is_recording = dr.flag(dr.JitFlag.SymbolicScope)
        if len(rows) <= MAX_UNROLLED or is_recording:
            return PlaneTable.literal(backend, rows)
        return PlaneTable.upload(backend, rows)

    def _slacks(
        self, table: PlaneTable, o: Vec3, d: Vec3
    ) -> Callable[[Vec3, Real], RoundingSlacks]:
        """Return a function of the normal n and the offset h of a plane. The function returns
        bounds of the rounding errors of h - n.o and of n.d, for rays o + t d. table: the planes of
        the polytope."""
        del table
        rounding = clip_rounding(backend_of(o))
        abs_o, abs_d = dr.abs(o), dr.abs(d)

        def slacks(n: Vec3, h: Real) -> RoundingSlacks:
            """Bounds of the rounding errors of h - n.o and of n.d, as a pair, for the plane n.x <=
            h."""
            abs_n = dr.abs(n)
            return rounding * (dr.dot(abs_n, abs_o) + dr.abs(h)), rounding * dr.dot(abs_n, abs_d)

        return slacks

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The interval [t0, t1] of each ray o + t d within the polytope (see `Volume.clip`).
        Returns t0 and t1; t0 = inf and t1 = -inf if the ray misses the polytope. The interval
        [t_min, t_max] is cut by one plane after the other."""
        backend = backend_of(o)
        table = self._plane_table(backend)
        slacks = self._slacks(table, o, d)

        def step(state: tuple[Real, Real], n: Vec3, h: Real) -> tuple[Real, Real]:
            """Cut the interval `state`, (t0, t1), to the half-space n.x <= h, and return the new
            interval. The condition is room - t speed >= 0 with room = h - n.o and speed = n.d.
            Bounds of their rounding errors are added to room and subtracted from speed, so that no
            point is lost."""
            t0, t1 = state
            room_slack, speed_slack = slacks(n, h)
            room = h - dr.dot(n, o) + room_slack
            speed = dr.dot(n, d) - speed_slack
            t = room / speed
            is_leaving = speed > 0
            # The ray leaves the half-space at t if speed > 0; else it enters at |t|, if it is
            # outside at first.
            t1 = dr.select(is_leaving, fmin(t, t1), t1)
            t0 = dr.select(is_leaving | (room >= 0), t0, fmax(dr.abs(t), t0))
            return t0, t1

        # Zeros, which give the interval's ends as many lanes as the widest argument has.
        lanes = dr.zeros(backend.Float, dr.width(o, d, t_min, t_max))

        def is_nonempty(t0: Real, t1: Real) -> Mask:
            """Whether further planes can change the interval [t0, t1]: only if it is not empty, as
            an empty one stays empty."""
            return t0 < t1

        return normalize_empty_interval(
            *table.fold((lanes + t_min, lanes + t_max), step, is_nonempty)
        )

    def contains(self, p: Vec3) -> Mask:
        """Whether points p lie in the polytope, up to rounding."""
        backend = backend_of(p)
        rounding = clip_rounding(backend)
        abs_p = dr.abs(p)

        def step(state: tuple[Mask], n: Vec3, h: Real) -> tuple[Mask]:
            """Whether the points lie in the half-space n.x <= h, too, up to rounding. state:
            whether they lie in all half-spaces before; a tuple of one, as is the result."""
            slack = rounding * (dr.dot(dr.abs(n), abs_p) + dr.abs(h))
            return (state[0] & (dr.dot(n, p) - h <= slack),)

        all_lanes = dr.full(backend.Bool, True, dr.width(p))
        return self._plane_table(backend).fold((all_lanes,), step)[0]

    def signed_distance(self, p: Vec3) -> Real:
        """The largest of the signed distances of p from the planes."""
        return self._nearest_plane(p)[0]

    def outward_normal(self, p: Vec3) -> Vec3:
        """The normal of the plane with the largest signed distance from p."""
        return self._nearest_plane(p)[1]

    def _nearest_plane(self, p: Vec3) -> tuple[Real, Vec3]:
        """The largest of the signed distances n.p - h of p from the planes, and the normal n of
        that plane."""
        backend = backend_of(p)

        def step(state: tuple[Real, Vec3], n: Vec3, h: Real) -> tuple[Real, Vec3]:
            """The larger of two signed distances, and the normal of the plane to which it belongs.
            One distance is that of `state`, the largest so far; the other is that from the plane
            n.x = h."""
            distance = dr.dot(n, p) - h
            is_larger = distance > state[0]
            return dr.select(is_larger, distance, state[0]), dr.select(is_larger, n, state[1])

        width = dr.width(p)
        # The first plane replaces both: a distance of -inf, and any normal.
        start = (
            dr.full(backend.Float, -dr.inf, width),
            backend.Array3f(0, 0, 1) + dr.zeros(backend.Array3f, width),
        )
        return self._plane_table(backend).fold(start, step)

    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        """Whether points (n, 3) lie in the polytope, up to rounding: (n,)."""
        x = as_points(points)
        rows = self.planes()
        is_inside = np.ones(len(x), dtype=np.bool_)
        for row in rows:
            n, h = row[:3], float(row[3])
            # A bound of the rounding of n.x - h.
            slack = 8.0 * sys.float_info.epsilon * (np.abs(x) @ np.abs(n) + abs(h))
            is_inside &= x @ n - h <= slack
        return is_inside


@dataclass(frozen=True)
class Ball(Volume):
    """The ball of the points within `radius` of `center`.

    center: (3,).
    radius: a positive length.
    """

    center: Point = (0.0, 0.0, 0.0)
    radius: float = 1.0
    _device_numbers: Any = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Validate and convert the attributes. Raises ValueError for a center that is not three
        finite numbers, or a radius that is not positive."""
        if isinstance(self.center, int | float):
            raise ValueError(
                f"the center of a ball must be three numbers, not {self.center!r}: for one about "
                f"the origin, write Ball(radius={self.center!r})"
            )
        object.__setattr__(self, "center", as_point(self.center, "the center of a ball"))
        radius = as_real(self.radius, "the radius of a ball")
        if not 0.0 < radius < np.inf:
            raise ValueError(f"the radius of a ball must be positive, not {self.radius!r}")
        object.__setattr__(self, "radius", radius)

    def _center_and_radius(self, backend: Backend) -> tuple[Vec3, Real]:
        """The center (3,) and the radius on the backend: kernel parameters if the ball was
        uploaded, otherwise literals."""
        if self._device_numbers is not None and backend_of(self._device_numbers[0]) == backend:
            return self._device_numbers
        return backend.Array3f(*self.center), backend.Float(self.radius)

    def upload(self, backend: Backend) -> Ball:
        """An equal ball whose center and radius are kernel parameters."""
        center = backend.Array3f(*(dr.opaque(backend.Float, c) for c in self.center))
        return replace(self, _device_numbers=(center, dr.opaque(backend.Float, self.radius)))

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The interval [t0, t1] of each ray o + t d within the ball, for t_min <= t <= t_max.
        Returns t0 and t1; t0 = inf and t1 = -inf if the ray misses the ball.

        The line's half-length in the ball follows from r^2 - |perp|^2, where r is the radius, c the
        center, and perp the vector from c to the nearest point of the line. The usual formula
        (o.d)^2 - |d|^2 (|o|^2 - r^2) loses all digits for far origins o. With u the unit roundoff,
        perp and the parameter of the nearest point are off by a few u |o - c|, the center by u |c|
        and the radius by u r. The sum of these bounds is added to r and to both ends of the
        interval.
        """
        backend = backend_of(o)
        center, radius = self._center_and_radius(backend)
        from_center = o - center
        speed = dr.norm(d)
        t_nearest = -dr.dot(from_center, d) / (speed * speed)
        line_distance = dr.norm(dr.fma(d, t_nearest, from_center))
        slack = clip_rounding(backend) * (dr.norm(from_center) + dr.norm(center) + radius)
        radius_bound = radius + slack
        # r^2 - |perp|^2 as a product, which loses no digits.
        half_length = dr.sqrt(
            fmax((radius_bound - line_distance) * (radius_bound + line_distance), 0.0)
        )
        half_length = (half_length + slack) / speed
        t0 = fmax(t_nearest - half_length, t_min)
        t1 = fmin(t_nearest + half_length, t_max)
        return normalize_empty_interval(t0, dr.select(line_distance <= radius_bound, t1, -dr.inf))

    def contains(self, p: Vec3) -> Mask:
        """Whether points p lie in the ball, up to rounding."""
        backend = backend_of(p)
        c, r = self._center_and_radius(backend)
        distance = dr.norm(p - c)
        return distance - r <= clip_rounding(backend) * (distance + dr.norm(c) + r)

    def signed_distance(self, p: Vec3) -> Real:
        c, r = self._center_and_radius(backend_of(p))
        return dr.norm(p - c) - r

    def outward_normal(self, p: Vec3) -> Vec3:
        """The unit vector from the center to p; the z axis at the center."""
        backend = backend_of(p)
        from_center = p - self._center_and_radius(backend)[0]
        length = dr.norm(from_center)
        axis = backend.Array3f(0, 0, 1)
        return dr.select(length > 0, from_center / length, axis)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        c = np.array(self.center)
        return c - self.radius, c + self.radius

    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        distance: FloatArray = np.linalg.norm(as_points(points) - self.center, axis=1)
        size = distance + float(np.linalg.norm(self.center)) + self.radius
        return distance - self.radius <= 8.0 * sys.float_info.epsilon * size

    def padded(self, distance: float) -> Ball:
        return Ball(self.center, self.radius + as_padding(distance))


@dataclass(frozen=True)
class Box(Polytope):
    """The points x with lower <= x <= upper in each coordinate.

    lower, upper: (3,) the corners; coordinates may be infinite.
    """

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        """Validate and convert the corners. Raises ValueError unless lower <= upper in each
        coordinate."""
        lower = as_point(self.lower, "the lower corner of a box", finite=False)
        upper = as_point(self.upper, "the upper corner of a box", finite=False)
        # A box from inf, or up to -inf, has no point either.
        if any(a > b or a == np.inf or b == -np.inf for a, b in zip(lower, upper, strict=True)):
            raise ValueError(
                f"a box needs lower <= upper in each coordinate, not {lower} and {upper}"
            )
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def planes(self) -> FloatArray:
        rows = np.zeros((6, 4))
        rows[:3, :3], rows[:3, 3] = np.eye(3), self.upper
        rows[3:, :3], rows[3:, 3] = -np.eye(3), -np.array(self.lower)
        return rows[np.isfinite(rows[:, 3])]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        return np.array(self.lower), np.array(self.upper)

    def padded(self, distance: float) -> Box:
        r = as_padding(distance)
        x0, y0, z0 = self.lower
        x1, y1, z1 = self.upper
        return Box((x0 - r, y0 - r, z0 - r), (x1 + r, y1 + r, z1 + r))


@dataclass(frozen=True)
class HalfSpace(Polytope):
    """The half-space of the points x with n.x <= offset, where n is the unit vector along `normal`;
    n points out of the half-space.

    normal: (3,), not zero; it is scaled to length one.
    offset: the distance of the boundary plane from the origin, negative if the origin is outside of
        the half-space.
    """

    normal: Point
    offset: float

    def __post_init__(self) -> None:
        """Validate the attributes, and scale the normal to length one. Raises ValueError for a
        normal of length zero, or numbers that are not finite."""
        normal = np.array(as_point(self.normal, "the normal of a half-space"))
        largest = float(np.abs(normal).max())
        if largest == 0.0:
            raise ValueError("the normal of a half-space must not be zero")
        normal /= largest  # so that squares neither overflow nor vanish
        offset = as_real(self.offset, "the offset of a half-space")
        if not np.isfinite(offset):
            raise ValueError(f"the offset of a half-space must be finite, not {self.offset!r}")
        x, y, z = (float(v) for v in normal / np.linalg.norm(normal))
        object.__setattr__(self, "normal", (x, y, z))
        object.__setattr__(self, "offset", offset)

    def planes(self) -> FloatArray:
        return np.array([[*self.normal, self.offset]])

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner, (3,) each, of a box around the half-space. All
        coordinates are infinite, except that one is finite if the plane is at right angles to an
        axis."""
        lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
        for k, n in enumerate(self.normal):
            # Only a plane at right angles to an axis bounds the box.
            if n and not any(np.delete(self.normal, k)):
                (upper if n > 0 else lower)[k] = n * self.offset
        return lower, upper

    def padded(self, distance: float) -> HalfSpace:
        return HalfSpace(self.normal, self.offset + as_padding(distance))


@dataclass(frozen=True)
class VolumeIntersection(Volume):
    """The intersection of one or more volumes, whose methods combine the results of these volumes.

    volumes: the volumes; any iterable is accepted.
    """

    volumes: tuple[Volume, ...]

    def __init__(self, volumes: Iterable[Volume]) -> None:
        """Validate and store the volumes. Raises TypeError if one of them is no volume, and
        ValueError if there is none."""
        if not isinstance(cast("Any", volumes), Iterable):
            raise TypeError(f"an intersection is of several volumes, not of {volumes!r:.60}")
        members = tuple(volumes)
        if not members:
            raise ValueError("an intersection needs at least one volume")
        for member in members:
            # `check_volume` accepts None; here a text, which it refuses, takes its place.
            check_volume(cast("Any", member) or "none", "each part of an intersection")
        object.__setattr__(self, "volumes", members)

    def upload(self, backend: Backend) -> VolumeIntersection:
        return VolumeIntersection(v.upload(backend) for v in self.volumes)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The interval [t0, t1] of each ray o + t d within all volumes, for t_min <= t <= t_max.
        Returns t0 and t1; t0 = inf and t1 = -inf if the ray misses the intersection."""
        t0, t1 = t_min, t_max
        for volume in self.volumes:
            t0, t1 = volume.clip(o, d, t0, t1)
        return t0, t1

    def contains(self, p: Vec3) -> Mask:
        is_inside = self.volumes[0].contains(p)
        for volume in self.volumes[1:]:
            is_inside &= volume.contains(p)
        return is_inside

    def signed_distance(self, p: Vec3) -> Real:
        """The largest of the signed distances of p from the volumes."""
        distance = self.volumes[0].signed_distance(p)
        for volume in self.volumes[1:]:
            distance = fmax(volume.signed_distance(p), distance)
        return distance

    def outward_normal(self, p: Vec3) -> Vec3:
        """The normal at p of the volume with the largest signed distance."""
        distance, normal = self.volumes[0].signed_distance(p), self.volumes[0].outward_normal(p)
        for volume in self.volumes[1:]:
            other_distance = volume.signed_distance(p)
            is_larger = other_distance > distance
            distance = dr.select(is_larger, other_distance, distance)
            normal = dr.select(is_larger, volume.outward_normal(p), normal)
        return normal

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner, (3,) each, of a box around the intersection. If the boxes of the
        volumes do not meet, lower > upper for some coordinate."""
        boxes = [v.bounds() for v in self.volumes]
        return np.max([b[0] for b in boxes], axis=0), np.min([b[1] for b in boxes], axis=0)

    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        return np.all([v.contains_points(points) for v in self.volumes], axis=0)

    def padded(self, distance: float) -> VolumeIntersection:
        return VolumeIntersection(v.padded(distance) for v in self.volumes)


def box_around_volumes(volumes: list[Volume]) -> Volume | None:
    """A volume that contains the given volumes: a box around them or, if there is only one, that
    volume itself. None if one of them is unbounded."""
    # `bounds` is a pair of corners, the lowest and the highest.
    corners = [entry.bounds() for entry in volumes]
    lower = np.min([entry for entry, _ in corners], axis=0)
    upper = np.max([entry for _, entry in corners], axis=0)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        return None
    if len(volumes) == 1:
        return volumes[0]
    return Box(tuple(lower), tuple(upper))
