"""Ball, box and half-space, and intersections of volumes."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import Backend, BoolArray, FloatArray, Mask, Real, Vec3, backend_of
from harnack.backend.extrema import fmax, fmin
from harnack.backend.numbers import real
from harnack.geometry.volumes.polytope import Polytope
from harnack.geometry.volumes.volume import (
    Point,
    Volume,
    as_points,
    checked_distance,
    checked_point,
    emptied,
    rounding,
)

__all__ = ["Ball", "Box", "HalfSpace", "Intersection"]


@dataclass(frozen=True)
class Ball(Volume):
    """Points within `radius` (> 0) of `center`."""

    center: Point = (0.0, 0.0, 0.0)
    radius: float = 1.0
    _numbers: Any = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.center, int | float):
            raise ValueError(
                f"the center of a ball must be three numbers, not {self.center!r}: for one about "
                f"the origin, write Ball(radius={self.center!r})"
            )
        object.__setattr__(self, "center", checked_point(self.center, "the center of a ball"))
        radius = real(self.radius, "the radius of a ball")
        if not 0.0 < radius < np.inf:
            raise ValueError(f"the radius of a ball must be positive, not {self.radius!r}")
        object.__setattr__(self, "radius", radius)

    def _on(self, backend: Backend) -> tuple[Vec3, Real]:
        if self._numbers is not None and backend_of(self._numbers[0]) == backend:
            return self._numbers
        return backend.Array3f(*self.center), backend.Float(self.radius)

    def prepare(self, backend: Backend) -> Ball:
        center = backend.Array3f(*(dr.opaque(backend.Float, c) for c in self.center))
        return replace(self, _numbers=(center, dr.opaque(backend.Float, self.radius)))

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The discriminant r^2 - |perp|^2 is taken from perp, the vector from the center to the
        nearest point of the line: (o.d)^2 - |d|^2 (|o|^2 - r^2) cancels for far origins.

        With u the unit roundoff, perp and the parameter of the nearest point are off by a few
        u |o - c|, c and r by u |c| and u r: so much is added to r and to both ends."""
        backend = backend_of(o)
        c, r = self._on(backend)
        from_center = o - c
        speed = dr.norm(d)
        along = -dr.dot(from_center, d) / (speed * speed)
        clearance = dr.norm(dr.fma(d, along, from_center))
        slack = rounding(backend) * (dr.norm(from_center) + dr.norm(c) + r)
        reach = r + slack
        half = dr.sqrt(fmax((reach - clearance) * (reach + clearance), 0.0))
        half = (half + slack) / speed
        t0 = fmax(along - half, t_min)
        t1 = fmin(along + half, t_max)
        return emptied(t0, dr.select(clearance <= reach, t1, -dr.inf))

    def contains(self, p: Vec3) -> Mask:
        backend = backend_of(p)
        c, r = self._on(backend)
        distance = dr.norm(p - c)
        return distance - r <= rounding(backend) * (distance + dr.norm(c) + r)

    def signed_distance(self, p: Vec3) -> Real:
        c, r = self._on(backend_of(p))
        return dr.norm(p - c) - r

    def outward_normal(self, p: Vec3) -> Vec3:
        backend = backend_of(p)
        from_center = p - self._on(backend)[0]
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
        return Ball(self.center, self.radius + checked_distance(distance))


@dataclass(frozen=True)
class Box(Polytope):
    """Points between two corners, lower <= x <= upper; sides may be infinite."""

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        lower = checked_point(self.lower, "the lower corner of a box", finite=False)
        upper = checked_point(self.upper, "the upper corner of a box", finite=False)
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
        r = checked_distance(distance)
        x0, y0, z0 = self.lower
        x1, y1, z1 = self.upper
        return Box((x0 - r, y0 - r, z0 - r), (x1 + r, y1 + r, z1 + r))


@dataclass(frozen=True)
class HalfSpace(Polytope):
    """Points with normal.x <= offset. The normal points out; its length is divided out."""

    normal: Point
    offset: float

    def __post_init__(self) -> None:
        normal = np.array(checked_point(self.normal, "the normal of a half-space"))
        size = float(np.abs(normal).max())
        if size == 0.0:
            raise ValueError("the normal of a half-space must not be zero")
        normal /= size  # so that squares neither overflow nor vanish
        length = float(np.linalg.norm(normal))
        offset = real(self.offset, "the offset of a half-space") / size / length
        if not np.isfinite(offset):
            raise ValueError(
                f"the offset of a half-space must be finite, not {self.offset!r}, and so must its "
                f"ratio to the length of the normal {self.normal!r}"
            )
        x, y, z = (float(v) for v in normal / length)
        object.__setattr__(self, "normal", (x, y, z))
        object.__setattr__(self, "offset", offset)

    def planes(self) -> FloatArray:
        return np.array([[*self.normal, self.offset]])

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
        for k, n in enumerate(self.normal):
            if n and not any(np.delete(self.normal, k)):  # only an axis bounds it
                (upper if n > 0 else lower)[k] = n * self.offset
        return lower, upper

    def padded(self, distance: float) -> HalfSpace:
        return HalfSpace(self.normal, self.offset + checked_distance(distance))


@dataclass(frozen=True)
class Intersection(Volume):
    """Points that lie in all of several volumes (at least one)."""

    volumes: tuple[Volume, ...]

    def __init__(self, volumes: Iterable[Volume]) -> None:
        members = tuple(volumes)
        if not members:
            raise ValueError("an intersection needs at least one volume")
        object.__setattr__(self, "volumes", members)

    def prepare(self, backend: Backend) -> Intersection:
        return Intersection(v.prepare(backend) for v in self.volumes)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        t0, t1 = t_min, t_max
        for volume in self.volumes:
            t0, t1 = volume.clip(o, d, t0, t1)
        return t0, t1

    def contains(self, p: Vec3) -> Mask:
        inside = self.volumes[0].contains(p)
        for volume in self.volumes[1:]:
            inside &= volume.contains(p)
        return inside

    def signed_distance(self, p: Vec3) -> Real:
        distance = self.volumes[0].signed_distance(p)
        for volume in self.volumes[1:]:
            distance = fmax(volume.signed_distance(p), distance)
        return distance

    def outward_normal(self, p: Vec3) -> Vec3:
        distance, normal = self.volumes[0].signed_distance(p), self.volumes[0].outward_normal(p)
        for volume in self.volumes[1:]:
            other = volume.signed_distance(p)
            nearer = other > distance
            distance = dr.select(nearer, other, distance)
            normal = dr.select(nearer, volume.outward_normal(p), normal)
        return normal

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner; lower > upper somewhere if the volumes are seen not to meet."""
        boxes = [v.bounds() for v in self.volumes]
        return np.max([b[0] for b in boxes], axis=0), np.min([b[1] for b in boxes], axis=0)

    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        return np.all([v.contains_points(points) for v in self.volumes], axis=0)

    def padded(self, distance: float) -> Intersection:
        return Intersection(v.padded(distance) for v in self.volumes)
