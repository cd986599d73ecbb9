"""The closest point of a surface, of all that several ways of looking for it find."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.distance.around import nearest_seen
from harnack.distance.batches import FloatArray, in_batches
from harnack.distance.projection import Descent
from harnack.tracer import trace

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.certify import Levels
    from harnack.fields.field import Field
    from harnack.tracer import LevelSet

__all__ = ["Closest", "find_closest", "find_on_sheets"]

# Further descents start this share of the distance found from the point.
_ASIDE = 0.5
# In square roots of epsilon: how far, relative to the distance, rays pass an edge that others may
# have slipped past, and how long, relative to coordinates, rays through points on a sheet are.
_ASLANT = 10.0
_SHORT = 10.0


def _length(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (n, 3), whose squares may overflow."""
    x, y, z = vectors.T
    return np.hypot(np.hypot(x, y), z)


@dataclass(frozen=True)
class Closest:
    """points: (n, 3), rounded to the precision in use. feet: (n, 3) the closest points found, NaN
    where none was. above: (n,) f - level, of the level nearest in value."""

    points: FloatArray
    feet: FloatArray
    above: FloatArray

    @property
    def distance(self) -> FloatArray:
        """(n,) |point - foot|."""
        return _length(self.points - self.feet)

    def or_nearer(self, feet: FloatArray) -> Closest:
        """Itself, or where they are nearer, other feet; NaN is never nearer."""
        other = _length(self.points - feet)
        nearer = (other < self.distance) | (np.isnan(self.distance) & ~np.isnan(other))
        return Closest(self.points, np.where(nearer[:, None], feet, self.feet), self.above)


def find_closest(backend: Backend, surface: LevelSet, levels: Levels, points: Any) -> Closest:
    """The closest of these: the end of the descent from the point, and of five more that start
    half its length from the point, away from its end and to the four sides; the closest point of
    the curve that the surface ends in; the closest point of the sheets, if the surface is there.

    Where that is none, the end of the descent from the nearest point that rays find
    (`nearest_seen`).
    """
    field = surface.field
    prepared = field.prepare(backend)
    surface = dataclasses.replace(surface, field=prepared)  # uploaded once
    descent = Descent.of(backend, prepared, levels)

    def descend(p: Vec3, start: Vec3) -> tuple[Real | Vec3, ...]:
        foot, found, _ = descent.closest(p, start)
        return dr.select(found, foot, dr.nan), foot

    def look(p: Vec3) -> tuple[Real | Vec3, ...]:
        above = -levels.to_nearest(prepared.evaluate(p).value)
        foot, end = descend(p, p)
        boundary = prepared.closest_on_boundary(p)
        nowhere = backend.Array3f(dr.nan)
        return (
            p,
            dr.select(above == 0, p, foot),
            end,
            nowhere if boundary is None else boundary,
            above,
        )

    x, feet, ends, boundary, above = in_batches(backend, look, points)
    found = Closest(x, _within(field, feet), above).or_nearer(_within(field, boundary))
    if field.has_sheets:
        found = found.or_nearer(find_on_sheets(backend, surface, x))
    ways = _ways(x - np.where(np.isnan(found.feet), ends, found.feet))
    starts = [_usable(field, x + _ASIDE * way, x) for way in ways]
    several = np.concatenate([x] * len(starts))
    feet, _ = in_batches(backend, descend, several, np.concatenate(starts))
    for part in np.split(_within(field, feet), len(starts)):
        found = found.or_nearer(part)
    return _with_seen(backend, surface, descent, found)


def _with_seen(backend: Backend, surface: LevelSet, descent: Descent, found: Closest) -> Closest:
    """With feet for points that have none: from the nearest point that is seen, down to where the
    descent ends. That is a point of the surface even where it is no minimum."""
    lost = np.flatnonzero(np.isnan(found.feet[:, 0]))
    if not lost.size:
        return found

    def descend(p: Vec3, start: Vec3) -> tuple[Real | Vec3, ...]:
        foot, _, on_level = descent.closest(p, start)
        return (dr.select(on_level, foot, start),)

    x = found.points[lost]
    seen = nearest_seen(backend, surface, x)
    some = ~np.isnan(seen[:, 0])
    feet = np.full_like(found.feet, np.nan)
    (feet[lost[some]],) = in_batches(backend, descend, x[some], seen[some])
    # The way down may leave the domain; what is seen lies within.
    feet[lost] = np.where(np.isnan(_within(surface.field, feet[lost])), seen, feet[lost])
    return found.or_nearer(feet)


def _ways(away: FloatArray) -> tuple[FloatArray, ...]:
    """Vectors (n, 3) and four at right angles to each of them, of the same length."""
    away = np.where(np.isfinite(away).all(axis=1, keepdims=True), away, 0.0)
    flattest = np.eye(3)[np.abs(away).argmin(axis=1)]
    length = _length(away)[:, None]
    unit = away / np.maximum(length, 1e-300)
    u = np.cross(unit, flattest)
    u *= length / np.maximum(_length(u)[:, None], 1e-300)
    v = np.cross(unit, u)
    return away, u, -u, v, -v


def _within(field: Field, feet: FloatArray) -> FloatArray:
    """The points (n, 3), NaN for those outside the field's domain: the surface is cut there."""
    if field.domain is None or not len(feet):
        return feet
    inside = field.domain.contains_points(np.nan_to_num(feet))
    return np.where(inside[:, None], feet, np.nan)


def _usable(field: Field, points: FloatArray, others: FloatArray) -> FloatArray:
    """The points (n, 3); where they are outside the field's domain, others."""
    return np.where(np.isnan(_within(field, points)), others, points)


def find_on_sheets(backend: Backend, surface: LevelSet, points: FloatArray) -> FloatArray:
    """Where straight lines (n, 3) to the nearest sheets first meet the surface; NaN: nowhere.

    The line is a ray to be traced, up to and with the sheet. Its direction is that in which the
    distance to the sheets falls, by central differences: off by epsilon^(2/3), it is longer by a
    share epsilon^(4/3). Where it meets nothing it may have slipped past an edge in which a sheet
    and a smooth part of the surface meet: four more pass it on either side. From a point on a sheet
    there is no direction: short rays through it along the axes tell what it is on.
    """
    prepared = surface.field.prepare(backend)

    def look(p: Vec3) -> tuple[Real | Vec3, ...]:
        distance = prepared.distance_to_sheets(p)
        h = backend.epsilon ** (1 / 3) * distance
        rate: list[Real] = []
        for axis in range(3):
            move = backend.Array3f(*(h if k == axis else 0 for k in range(3)))
            ahead, back = (prepared.distance_to_sheets(q) for q in (p + move, p - move))
            rate.append((back - ahead) / (2 * h))
        return distance, backend.Array3f(*rate)

    distance, direction = in_batches(backend, look, points)
    root = backend.epsilon**0.5
    scale = max(float(np.abs(points).max(initial=0.0)), 1e-30)
    short = np.full(len(points), _SHORT * root * scale)
    on_sheet = distance <= 1e-3 * short
    usable = np.isfinite(distance) & (np.linalg.norm(direction, axis=1) > 0.1) & ~on_sheet
    feet = np.full_like(points, np.nan)
    reach = distance * (1 + 1e-6 + 200 * backend.epsilon)
    _trace_into(feet, backend, surface, usable, points, direction, reach)
    for aside in _ways(direction)[1:]:
        missed = usable & np.isnan(feet[:, 0])
        _trace_into(
            feet, backend, surface, missed, points, direction + _ASLANT * root * aside, reach
        )
    for axis in np.eye(3):
        start = points - short[:, None] * axis
        _trace_into(feet, backend, surface, on_sheet, start, axis + 0 * points, 2 * short)
    return feet


def _trace_into(
    feet: FloatArray, backend: Backend, surface: LevelSet, rows: npt.NDArray[np.bool_],
    origins: FloatArray, directions: FloatArray, t_max: FloatArray,
) -> None:  # fmt: skip
    """Puts the first hits of some of the rays into `feet`."""
    index = np.flatnonzero(rows)
    if not index.size:
        return
    hits = trace(
        surface, origins[index], directions[index], t_max=t_max[index], precision=backend.precision
    )
    feet[index[hits.hit]] = hits.position[hits.hit]
