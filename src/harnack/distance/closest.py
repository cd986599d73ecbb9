"""The closest point of a surface, of all that several ways of looking for it find."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.basis import across_rows
from harnack.distance.around import nearest_seen, surface_box
from harnack.distance.batches import in_batches
from harnack.distance.closing_in import close_in, nearer_along
from harnack.distance.on_sheets import SheetSearch
from harnack.distance.projection import Descent
from harnack.fields.clearance import distance_below

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures import TargetLevels
    from harnack.fields.field import Field, Sample
    from harnack.tracer import LevelSet

__all__ = ["Closest", "find_closest", "find_on_sheets"]


# Further descents start this share of the distance found from the point.
_ASIDE = 0.5
# Sheets that are looked at for each point, in the order of their distance: at first, and where none
# of these is the surface, up to the best that rays find.
_FEW, _MANY = 16, 1024
# In epsilons, of coordinates: what rounding may do to a distance.
_ROUNDING = 64.0


def _length(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (n, 3), whose squares may overflow."""
    x, y, z = vectors.T
    return np.hypot(np.hypot(x, y), z)


@dataclass(frozen=True)
class Closest:
    """The closest points found so far.

    points: (n, 3), rounded to the precision in use.
    feet: (n, 3) the closest points of the surface found, NaN where none was.
    above: (n,) f - level, of the level nearest in value.
    lower: (n,) proved lower bounds of the distance; 0 where nothing is proved.
    is_refused: (n,) whether a point was found that is nearer than `lower` allows.
    """

    points: FloatArray
    feet: FloatArray
    above: FloatArray
    lower: FloatArray
    is_refused: BoolArray

    @property
    def distance(self) -> FloatArray:
        """(n,) |point - foot|."""
        return _length(self.points - self.feet)


@dataclass(frozen=True)
class _Candidates:
    """How points that a search finds are compared with what is proved."""

    backend: Backend
    field: Field
    descent: Descent

    def consider(self, found: Closest, feet: FloatArray) -> Closest:
        """With other feet (n, 3) where these are nearer; NaN is never nearer.

        A foot lies on the surface up to what rounding and approximation have done to the level
        there (`Descent.noise`). One that is nearer by more than that than the lower bound allows is
        no point of the surface, or the field does not keep a promise: it is refused, and counted.
        """
        distance = _length(found.points - feet)
        short = distance < found.lower
        if short.any():
            off = np.zeros(len(feet))
            (off[short],) = in_batches(self.backend, self._noise, feet[short])
            size = np.abs(found.points).max(axis=1) + found.lower
            slack = 4 * off + _ROUNDING * self.backend.epsilon * size
            short &= distance < found.lower - slack
            feet = np.where(short[:, None], np.nan, feet)
            distance = np.where(short, np.nan, distance)
        nearer = (distance < found.distance) | (np.isnan(found.distance) & ~np.isnan(distance))
        return dataclasses.replace(
            found,
            feet=np.where(nearer[:, None], feet, found.feet),
            is_refused=found.is_refused | short,
        )

    def _noise(self, y: Vec3) -> tuple[Real]:
        return (self.descent.noise(y),)


def find_closest(backend: Backend, surface: LevelSet, levels: TargetLevels, points: Any) -> Closest:
    """For each of the points the nearest of these candidates:

    1. the end of the descent from the point;
    2. the closest point of the curve in which the surface ends;
    3. the closest point of the nearest sheets that are part of the surface;
    4. the ends of five more descents, which start at half the best distance so far: opposite the
       best candidate, and to the four sides.

    If none of them is found, descend from the nearest hit of some rays (`nearest_seen`). If a sheet
    is nearer than the best candidate but not part of the surface at its nearest point, rays in
    directions near the best look for what is nearer (`close_in`), and more sheets are tried, up to
    that distance.

    No point is taken that is nearer than the lower bound that the field's promises prove.
    """
    field = surface.field
    prepared = field.prepare(backend).without_truncation(backend)
    surface = dataclasses.replace(surface, field=prepared)  # uploaded once
    descent = Descent.of(backend, prepared, levels)
    candidates = _Candidates(backend, field, descent)

    def descend(p: Vec3, start: Vec3) -> tuple[Real | Vec3, ...]:
        foot, found, _ = descent.closest(p, start)
        return dr.select(found, foot, dr.nan), foot

    def look(p: Vec3) -> tuple[Real | Vec3, ...]:
        sample = prepared.evaluate(p)
        above = -levels.to_nearest(sample.value)
        foot, end = descend(p, p)
        boundary = prepared.closest_on_boundary(p)
        return (
            p,
            dr.select(above == 0, p, foot),
            end,
            backend.Array3f(dr.nan) if boundary is None else boundary,
            above,
            _lower(backend, prepared, levels, p, sample),
        )

    x, feet, ends, boundary, above, lower = in_batches(backend, look, points)
    lower = np.where(np.isnan(_within(field, x)[:, 0]), 0.0, lower)
    found = Closest(x, np.full_like(x, np.nan), above, lower, np.zeros(len(x), np.bool_))
    for part in (feet, boundary):
        found = candidates.consider(found, _within(field, part))
    to_sheet = np.full(len(x), np.inf)
    if field.has_sheets:
        on_sheet, along, to_sheet = _on_sheets(backend, surface, x, found.feet)
        found = candidates.consider(candidates.consider(found, on_sheet), along)
    offsets = _probe_offsets(x - np.where(np.isnan(found.feet), ends, found.feet))
    starts = [_usable(field, x + _ASIDE * offset, x) for offset in offsets]
    several = np.concatenate([x] * len(starts))
    feet, _ = in_batches(backend, descend, several, np.concatenate(starts))
    for part in np.split(_within(field, feet), len(starts)):
        found = candidates.consider(found, part)
    found = _with_seen(backend, surface, candidates, found)
    return _past_sheets(backend, surface, candidates, found, to_sheet)


def _lower(backend: Backend, field: Field, levels: TargetLevels, p: Vec3, sample: Sample) -> Real:
    if not sample.promises:
        return backend.Float(0)
    return distance_below(backend, field, levels, p, sample)


def _with_seen(
    backend: Backend, surface: LevelSet, candidates: _Candidates, found: Closest
) -> Closest:
    """With feet for points that have none: the end of the descent from the nearest ray hit. That is
    a point of the surface even where it is no minimum of the distance."""
    unresolved = np.flatnonzero(np.isnan(found.feet[:, 0]))
    if not unresolved.size:
        return found

    def descend(p: Vec3, start: Vec3) -> tuple[Real | Vec3, ...]:
        foot, _, on_level = candidates.descent.closest(p, start)
        return (dr.select(on_level, foot, start),)

    x = found.points[unresolved]
    seen = nearest_seen(backend, surface, x)
    some = ~np.isnan(seen[:, 0])
    feet = np.full_like(found.feet, np.nan)
    (feet[unresolved[some]],) = in_batches(backend, descend, x[some], seen[some])
    # The way down may leave the domain; what is seen lies within.
    ends = feet[unresolved]
    feet[unresolved] = np.where(np.isnan(_within(surface.field, ends)), seen, ends)
    return candidates.consider(found, feet)


def _probe_offsets(away: FloatArray) -> tuple[FloatArray, ...]:
    """Vectors (n, 3) and four at right angles to each of them, of the same length."""
    away = np.where(np.isfinite(away).all(axis=1, keepdims=True), away, 0.0)
    length = _length(away)[:, None]
    u, v = (length * one for one in across_rows(away / np.maximum(length, 1e-300)))
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
    """The closest points (n, 3) to `points` (n, 3) of the surface that lie on a sheet, or between
    the point and the nearest sheet; NaN: none was found."""
    surface = dataclasses.replace(surface, field=surface.field.prepare(backend))
    on_sheet, along, _ = _on_sheets(backend, surface, points, np.full_like(points, np.nan))
    distances = (np.linalg.norm(points - feet, axis=1) for feet in (on_sheet, along))
    nearer = np.less(*distances) | np.isnan(along[:, 0])
    return np.where(nearer[:, None], on_sheet, along)


def _on_sheets(
    backend: Backend, surface: LevelSet, points: FloatArray, feet: FloatArray, most: int = _FEW
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of the surface (n, 3) on sheets, and (n, 3) on the straight way to the nearest sheet
    and on, nearer than `feet` (n, 3), NaN elsewhere; the distance (n,) of the nearest sheet."""
    prepared = surface.prepare(backend)
    search = SheetSearch(prepared, _scale(surface, points), most)

    def look(p: Vec3, foot: Vec3) -> tuple[Real | Vec3, ...]:
        distance = dr.norm(foot - p)
        limit = dr.select(dr.isnan(distance), dr.inf, distance)
        on_sheet, way = search.closest(p, limit)
        return on_sheet, nearer_along(prepared, p, way, limit), dr.norm(way)

    on_sheet, along, to_sheet = in_batches(backend, look, points, feet)
    return on_sheet, along, to_sheet


def _past_sheets(
    backend: Backend, surface: LevelSet, candidates: _Candidates, found: Closest,
    to_sheet: FloatArray,
) -> Closest:  # fmt: skip
    """With nearer feet for points that have a sheet nearer than their foot: that sheet may be the
    surface at another place than at its nearest point, and so may others behind it."""
    rounding = 2 * _ROUNDING * backend.epsilon * _scale(surface, found.points)
    rows = np.flatnonzero(found.distance > to_sheet * (1 + 1e-9) + rounding)
    if not rows.size:
        return found
    prepared, x = surface.prepare(backend), found.points[rows]

    def look(p: Vec3, foot: Vec3) -> tuple[Vec3]:
        return (close_in(prepared, p, foot),)

    feet = np.full_like(found.feet, np.nan)
    (feet[rows],) = in_batches(backend, look, x, found.feet[rows])
    found = candidates.consider(found, feet)
    feet[rows], _, _ = _on_sheets(backend, surface, x, found.feet[rows], _MANY)
    return candidates.consider(found, feet)


def _scale(surface: LevelSet, points: FloatArray) -> float:
    """At least the size of coordinates at and on the way to the surface."""
    box = surface_box(surface)
    sizes = [float(np.abs(points).max(initial=0.0))]
    if box is not None:
        sizes += [float(np.abs(corner).max()) for corner in box]
    return max(*sizes, 1e-30)
