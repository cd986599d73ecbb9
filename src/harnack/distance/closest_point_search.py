"""The closest points of a surface: of the triangles of a closed mesh, or by search in cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import finite_vectors, upload_vectors
from harnack.backend.elementary import largest_coordinate, length
from harnack.distance.cell_classification import RimDescent
from harnack.distance.cell_search import Found, Known, Tolerance, search
from harnack.distance.closest_point_descent import Descent
from harnack.distance.jump_surface_search import SheetSearch, close_in
from harnack.distance.level_triangles import MeshSurface
from harnack.distance.tangent_plane import first_order, in_batches
from harnack.fields.batch_evaluation import morton_order
from harnack.fields.capabilities import NO_SHEET
from harnack.fields.clearance import distance_below
from harnack.fields.field import Field

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import TargetLevels
    from harnack.fields.samples import Sample
    from harnack.geometry import Volume
    from harnack.tracer import LevelSet

__all__ = ["Closest", "find_closest"]

# In epsilons, of coordinates: what rounding may do to a distance.
_ROUNDING = 64.0
# Of the size of the surface: cells are split until none can hold a point so much nearer.
_TOLERANCE = 1e-6
# Cells along an axis that points are sorted by, as a power of two.
_BITS = 10
# The surface may leave its boundary at this cosine away from a point and yet come nearer to it.
_AWAY = 0.2
# About the boundary the surface may be as far along a circle, in radii.
_LONGEST_ARC = 2.5
# Of feet of a field without jumps, which knows f but for a whole number: so near to a level f is.
_SAME_LEVEL = 0.25
# Where f is compared on both sides of a triangle: so far from the point towards the middle, in
# parts of the way to it, and so far on either side, in sizes of the surface. By how much f has to
# be on different sides of a level.
_WITHIN_FACE, _BESIDE_FACE, _SURE = 1e-7, 1e-12, 1e-3
# How often what clusters leave out is computed for a foot.
_CORRECTIONS = 2
# Samples of a smooth part for each point, about.
_LOOKS = 10
# Sheets that are examined for each point before cells are.
_SHEETS = 16


@dataclass(frozen=True)
class Closest:
    """The closest points found.

    points: (n, 3), rounded to the precision in use.
    feet: (n, 3) the closest points of the surface, NaN where none was found.
    distance: (n,) to these, NaN likewise.
    above: (n,) f - level, of the level nearest in value.
    lower: (n,) proved: no point of the surface is nearer.
    is_refused: (n,) whether a point was found that is nearer than the field's promises allow.
    """

    points: FloatArray
    feet: FloatArray
    distance: FloatArray
    above: FloatArray
    lower: FloatArray
    is_refused: BoolArray


def find_closest(
    backend: Backend, surface: LevelSet, levels: TargetLevels, points: Any,
    progress: Callable[[str], None], *, is_proved: bool = False,
) -> Closest:  # fmt: skip
    """The closest point of a surface to each of the points (n, 3).

    is_proved: whether `lower` is wanted as close as cells can prove it.

    Points are sorted along a Morton curve, so that neighboring lanes traverse a tree together.
    """
    x = finite_vectors(points, "points")
    order = to_numpy(morton_order(backend, upload_vectors(backend, x), _BITS))
    found = _in_order(backend, surface, levels, x[order], progress, is_proved)
    back = np.empty_like(order)
    back[order] = np.arange(len(order), dtype=order.dtype)
    return Closest(*(part[back] for part in vars(found).values()))


def _in_order(
    backend: Backend, surface: LevelSet, levels: TargetLevels, points: FloatArray,
    progress: Callable[[str], None], is_proved: bool,
) -> Closest:  # fmt: skip
    mesh = MeshSurface.of(surface)
    if mesh is not None and mesh.is_all:
        return _closest_on_mesh(backend, surface, levels, mesh, points)
    job = _Points(backend, surface, levels)
    x, start, above, lower, near = job.look(points)
    if mesh is not None:
        start = _nearer(x, start, mesh)
    if surface.field.has_sheets:
        start = job.on_sheets(x, start)
    tolerance = Tolerance(_TOLERANCE * _size(surface, x), is_proved)
    many = surface.field.for_rays(_LOOKS * len(x))
    smooth = many.smooth_part() if surface.cut is None else None
    if smooth is None:
        found = search(surface, x, Known(start, near), job, tolerance, progress)
    else:
        found = _besides_sheets(job, smooth, x, Known(start, near), tolerance, progress)
    found.feet = _or_singular(surface, x, job.refined(x, found.feet))
    distance = _length(x - found.feet)
    # A foot nearer than the proof allows: either it is off the surface by rounding, or a promise of
    # the field does not hold.
    short = distance < lower
    slack = np.zeros(len(x))
    slack[short] = 4 * job.noise(found.feet[short])
    slack += _ROUNDING * backend.epsilon * (np.abs(x).max(axis=1, initial=0.0) + lower)
    refused = distance < lower - slack
    feet = np.where(refused[:, None], np.nan, found.feet)
    distance = np.where(refused, np.nan, distance)
    lower = np.fmin(np.maximum(lower, found.lower), distance)
    return Closest(x, feet, distance, above, lower, refused)


def _besides_sheets(
    job: _Points, smooth: Field, points: FloatArray, known: Known, tolerance: Tolerance,
    progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """What is found of a surface with sheets: on its smooth part, or what is known on sheets.

    smooth: `Sheets.smooth_part` of the surface's field. known: feet on sheets.

    Proof of the lower bounds: the surface lies on level sets of `smooth` and on sheets, and is no
    nearer than the nearest of either. Feet on the former are of the surface where f has the level
    too. Where f has not, and where a sheet is nearer than all feet, which may be of the surface
    elsewhere than at its nearest point, rays look further.
    """
    backend, surface = job.backend, job.surface
    alone = replace(surface, field=smooth).in_one_call(begins=True)
    parts = _Points(backend, alone, alone.levels_on(backend))
    near = parts.look(points)[-1]
    found = search(
        alone, points, Known(known.feet, near, on_boundary=False), parts, tolerance, progress
    )
    sheets = job.to_sheets(points)
    rounding = _ROUNDING * backend.epsilon * (np.abs(points).max(axis=1, initial=0.0) + sheets)
    lower = np.maximum(np.minimum(found.lower, sheets - rounding), 0)
    away, feet = _length(points - known.feet), known.feet.copy()
    rows = np.flatnonzero(_length(points - found.feet) < np.nan_to_num(away, nan=np.inf) - rounding)
    there = parts.refined(points[rows], found.feet[rows])
    value = np.asarray(surface.field.value(there, precision="double"))
    is_level = np.abs(value[:, None] - surface.numbers).min(axis=1) < _SAME_LEVEL
    feet[rows[is_level]] = there[is_level]
    is_known = _length(points - feet) <= sheets + rounding + tolerance.length
    is_known[rows[~is_level]] = False
    again = np.flatnonzero(~is_known)
    if len(again):
        rest = Known(feet[again], known.near[again])
        others = search(surface, points[again], rest, job, tolerance, progress)
        feet[again], lower[again] = others.feet, np.maximum(lower[again], others.lower)
    return Found(feet, lower)


def _or_singular(surface: LevelSet, points: FloatArray, feet: FloatArray) -> FloatArray:
    """The feet (n, 3), or the nearest singular points where these are nearer: beside those the
    surface is a tiny loop that descents do not see."""
    singular = surface.field.singular_points
    if surface.cut is not None and len(singular):
        singular = singular[surface.cut.contains_points(singular)]
    if not len(singular) or not len(points):
        return feet
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    away, row = searching.cKDTree(singular).query(points)
    nearer = ~(_length(points - feet) <= away)
    return np.where(nearer[:, None], singular[row], feet)


def _closest_on_mesh(
    backend: Backend, surface: LevelSet, levels: TargetLevels, mesh: MeshSurface, points: Any
) -> Closest:
    prepared, nearest = surface.field_on(backend), mesh.upload(backend)

    def look(p: Vec3) -> tuple[Real | Vec3, ...]:
        above = -levels.to_nearest(prepared.evaluate(p).value)
        offset = nearest(p)
        return p, p + offset, length(offset), above

    x, feet, distance, above = in_batches(backend, look, points)
    slack = _ROUNDING * backend.epsilon * (np.abs(x).max(axis=1, initial=0.0) + mesh.size)
    lower = np.maximum(distance - slack, 0)
    return Closest(x, feet, distance, above, lower, np.zeros(len(x), np.bool_))


def _nearer(points: FloatArray, start: FloatArray, mesh: MeshSurface) -> FloatArray:
    """The places (n, 3), or the nearest points of triangles where these are nearer."""
    backend = choose_backend("double")
    nearest = mesh.upload(backend)
    (way,) = in_batches(backend, lambda p: (nearest(p),), points)  # pyright: ignore
    nearer = ~(_length(points - start) <= _length(way))
    return np.where(nearer[:, None], points + way, start)


@dataclass(frozen=True)
class _Points:
    """What is computed at points of a surface that is searched in cells."""

    backend: Backend
    surface: LevelSet
    levels: TargetLevels

    def __post_init__(self) -> None:
        backend, field = self.backend, self.surface.field_on(self.backend)
        set_ = object.__setattr__
        set_(self, "_field", field)
        exact = field.without_truncation(backend)
        set_(self, "_descent", Descent.of(backend, field, self.levels))
        set_(self, "_exact", Descent.of(backend, exact, self.levels) if field.has_detail else None)
        domain = field.domain and field.domain.prepare(backend)
        set_(self, "_domain", domain)
        set_(self, "_rim", domain and RimDescent(backend, field, self.levels, domain))
        # Rays are compared by differences of angles, for which single precision is too short.
        double = choose_backend("double")
        set_(self, "_prepared", self.surface.prepare(double) if field.has_sheets else None)

    _field: Field = dataclasses.field(init=False)
    _descent: Descent = dataclasses.field(init=False)
    _exact: Descent | None = dataclasses.field(init=False)
    _domain: Volume | None = dataclasses.field(init=False)
    _rim: RimDescent | None = dataclasses.field(init=False)
    _prepared: Any = dataclasses.field(init=False)

    def look(self, points: Any) -> tuple[FloatArray, ...]:
        """The points as rounded, what is known of the surface near them, f - level, proved lower
        bounds of the distance, and what it is to first order."""

        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            sample = self._field.evaluate(p)
            above = -self.levels.to_nearest(sample.value)
            boundary = self._field.closest_on_boundary(p)
            start = self.backend.Array3f(dr.nan) if boundary is None else boundary
            start = dr.select(above == 0, p, start)
            lower = self.backend.Float(0)
            if sample.promises:
                lower = distance_below(self.backend, self._field, self.levels, p, sample)
            return p, start, above, lower, dr.abs(first_order(above, sample.gradient))

        x, start, above, lower, near = in_batches(self.backend, compute, points)
        domain = self.surface.field.domain
        if domain is not None and len(x):
            lower[~domain.contains_points(x)] = 0
        return x, self._within(start), above, lower, near

    def on_sheets(self, points: FloatArray, start: FloatArray) -> FloatArray:
        """The places (n, 3), or points of the surface on sheets where these are nearer."""
        away, start = _length(points - start), start.copy()
        rows = np.flatnonzero(~(away <= self.to_sheets(points) * (1 + 1e-12)))
        start[rows] = self._on_nearest_face(points[rows])
        rows = rows[np.isnan(start[rows, 0])]
        if len(rows):
            start[rows] = self._on_sheets(points[rows], start[rows])
        return start

    def _on_nearest_face(self, points: FloatArray) -> FloatArray:
        """The nearest points (n, 3) of triangles that are the sheets, where the level lies between
        the values of f on both sides right beside them; NaN elsewhere."""
        mesh, prepared = self.surface.field.mesh_of_sheets(), self._prepared
        feet = np.full_like(points, np.nan)
        if mesh is None or not len(points):
            return feet
        real, index = prepared.backend.Float, prepared.backend.UInt32

        def nearest(p: Vec3) -> tuple[Vec3, Any, Vec3]:
            none, always = (real(-1), index(NO_SHEET)), prepared.backend.Bool(True)
            found = prepared.field.nearest_sheet(p, none, real(dr.inf), always)
            return p + found.offset, found.sheet, found.normal

        y, sheet, normal = in_batches(prepared.backend, nearest, points)
        corners = mesh[0][mesh[1][sheet.astype(np.int64)]]
        y_within = y + _WITHIN_FACE * (corners.mean(axis=1) - y)
        way = _BESIDE_FACE * _size(self.surface, points) * normal
        sides = [self.surface.field.value(y_within + k * way, precision="double") for k in (1, -1)]
        low, high = np.minimum(*sides) + _SURE, np.maximum(*sides) - _SURE
        on = np.any([(low < one) & (one < high) for one in self.surface.numbers], axis=0)
        feet[on] = y[on]
        return feet

    def to_sheets(self, points: FloatArray) -> FloatArray:
        """The distances (n,) to sheets, of the surface or not."""
        prepared = self._prepared

        def compute(p: Vec3) -> tuple[Real]:
            return (prepared.field.distance_to_sheets(p),)

        return in_batches(prepared.backend, compute, points)[0]

    def _on_sheets(self, points: FloatArray, start: FloatArray) -> FloatArray:
        x = np.concatenate([points, np.nan_to_num(start)])
        search = SheetSearch(self._prepared, max(float(np.abs(x).max(initial=0)), 1e-30), _SHEETS)

        def look(p: Vec3, foot: Vec3) -> tuple[Vec3]:
            away = length(foot - p)
            return (search.closest(p, dr.select(dr.isnan(away), dr.inf, away))[0],)

        (feet,) = in_batches(self._prepared.backend, look, points, start)
        return np.where(np.isnan(feet), start, feet)

    def _within(self, feet: FloatArray) -> FloatArray:
        """The points (n, 3), NaN for those outside the field's domain: the surface is cut there."""
        domain = self.surface.field.domain
        if domain is None or not len(feet):
            return feet
        inside = domain.contains_points(np.nan_to_num(feet))
        return np.where(inside[:, None], feet, np.nan)

    def polish(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`search.Descents`: by descent, or with sheets by rays."""
        if self.surface.field.has_sheets:

            def close(p: Vec3, start: Vec3) -> tuple[Vec3]:
                return (close_in(self._prepared, p, start),)

            return in_batches(self._prepared.backend, close, points, start)[0], np.zeros(
                len(points)
            )
        is_far_off = (start == points).all(axis=1)
        if is_far_off.any():

            def to_level(p: Vec3) -> tuple[Vec3]:
                y = self._descent.onto_level(p)
                return (dr.select(dr.isnan(y.x), p, y),)

            start = start.copy()
            (start[is_far_off],) = in_batches(self.backend, to_level, points[is_far_off])
        limits = np.tile(limit[:, None], 3)
        feet, y, free, goes_on, is_far = in_batches(
            self.backend, self._directly, points, start, limits
        )
        rows = np.flatnonzero(goes_on)
        if len(rows):
            feet[rows], free[rows] = in_batches(self.backend, self._descend, points[rows], y[rows])
        feet = self._within(feet)
        left, rim = np.flatnonzero(np.isnan(feet[:, 0]) & (is_far == 0)), self._rim
        if rim is not None and len(left):  # out of the domain

            def along(p: Vec3, y: Vec3) -> tuple[Vec3]:
                return (rim.closest(p, y)[0],)

            (there,) = in_batches(self.backend, along, points[left], start[left])
            feet[left], free[left] = self._within(there), 0
        return feet, free

    def leave_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`search.Descents`."""

        def level_away(p: Vec3, b: Vec3, length_: Vec3) -> tuple[Real]:
            way = p - b
            sample = self._field.evaluate(b + length_.x / length(way) * way)
            return (first_order(self.levels.to_nearest(sample.value), sample.gradient),)

        def beside(p: Vec3, b: Vec3, length_: Vec3) -> tuple[Vec3]:
            way = p - b
            y = self._descent.onto_level(b + length_.x / length(way) * way)
            towards = dr.dot(way, y - b) > -_AWAY * length(way) * length(y - b)
            return (dr.select(towards, y, dr.nan),)

        feet, free = np.full_like(points, np.nan), np.zeros(len(points))
        lengths = np.tile(aside[:, None], 3)
        if not len(points):
            return feet, free
        # Beside an edge f is the angle about it: to first order the level is as far as the arc.
        (away,) = in_batches(self.backend, level_away, points, boundary, lengths)
        rows = np.flatnonzero(~(np.abs(away) > _LONGEST_ARC * aside))
        start = points[rows]
        if len(rows):
            (start,) = in_batches(self.backend, beside, points[rows], boundary[rows], lengths[rows])
        rows, start = rows[~np.isnan(start[:, 0])], start[~np.isnan(start[:, 0])]
        if len(rows):
            feet[rows], free[rows] = in_batches(self.backend, self._descend, points[rows], start)
        return self._within(feet), free

    def directly(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """`search.Descents`."""
        p, vector = self.backend.Array3f(x), cast("Any", type(x))
        foot, _, free, goes_on, _ = self._newton(p, self.backend.Array3f(start), limit)
        if self._domain is not None:
            slack = _ROUNDING * self.backend.epsilon * largest_coordinate(foot)
            goes_on |= ~(self._domain.signed_distance(foot) < -slack)
        return vector(foot), type(x.x)(free), goes_on

    def _newton(self, p: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Vec3, Real, Mask, Mask]:
        """By Newton's method: feet, NaN where there is none; where the search goes on; radii about
        feet; whether it does go on, and whether it ends farther than `limit` away."""
        y, first, is_lost, is_far = self._descent.directly(p, start, self.backend.Float(limit))
        foot, found, free = self._descent.end(p, y)
        most = (length(p - start) + 2 * first) * (1 + 64 * self.backend.epsilon)
        most = dr.fma(64 * self.backend.epsilon, largest_coordinate(y), most)
        is_lost |= is_far
        is_foot = found & ~is_lost & (length(p - foot) <= most)
        return dr.select(is_foot, foot, dr.nan), y, free, ~(found | is_lost), is_far

    def _directly(self, p: Vec3, start: Vec3, limit: Vec3) -> tuple[Vec3, Vec3, Real, Real, Real]:
        """`_newton` with numbers for masks."""
        one, zero = self.backend.Float(1), self.backend.Float(0)
        *found, goes_on, is_far = self._newton(p, start, limit.x)
        return *found, dr.select(goes_on, one, zero), dr.select(is_far, one, zero)

    def _descend(self, p: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        y, found, on_level = self._descent.closest(p, start)
        return dr.select(on_level, y, dr.nan), dr.select(found, self._descent.end(p, y)[2], 0)

    def refined(self, points: FloatArray, feet: FloatArray) -> FloatArray:
        """The feet (n, 3) moved onto the level of the field without what clusters leave out: by
        Newton's method for the closest point, else straight to the level."""
        rows = np.flatnonzero(np.isfinite(feet[:, 0]))
        exact = self._exact
        if exact is None or not len(rows):
            return feet

        def to_level(start: Vec3) -> tuple[Vec3]:
            y = exact.onto_level(start)
            return (dr.select(dr.isfinite(dr.squared_norm(y)), y, start),)

        feet = feet.copy()
        there = self._corrected(exact, points[rows], feet[rows])
        left = np.flatnonzero(np.isnan(there[:, 0]))
        if len(left):
            (there[left],) = in_batches(self.backend, to_level, feet[rows[left]])
        inside = ~np.isnan(self._within(there)[:, 0])
        feet[rows[inside]] = there[inside]
        return feet

    def _corrected(self, exact: Descent, points: FloatArray, feet: FloatArray) -> FloatArray:
        """The feet (n, 3) on the level of the exact field, NaN where they are not found.

        What clusters leave out hardly changes on the way, and costs as much as all of the field: so
        it is computed at the foot, with its gradient, and Newton's method is that of the field with
        clusters and this correction. Twice, as the foot moves by what is left out at first. What
        remains is a short step to the level of the exact field.
        """
        rough = self._descent

        def left_out(y: Vec3) -> tuple[Vec3, Vec3]:
            one, other = exact.field.evaluate(y), rough.field.evaluate(y)
            vector = self.backend.Array3f
            return vector(one.value - other.value), vector(one.gradient) - vector(other.gradient)

        def newton(p: Vec3, y: Vec3, value: Vec3, slope: Vec3) -> tuple[Vec3]:
            field = _Corrected(rough.field, y, value.x, slope)
            descent = replace(rough, field=field)
            end, _, is_lost, _ = descent.directly(p, y, self.backend.Float(dr.inf))
            foot, found, _ = descent.end(p, end)
            return (dr.select(found & ~is_lost, foot, dr.nan),)

        def on_level(p: Vec3, y: Vec3) -> tuple[Vec3]:
            return (exact.last_step(p, y),)

        feet, rows = feet.copy(), np.arange(len(feet))
        for _ in range(_CORRECTIONS):
            if len(rows):
                given = points[rows], feet[rows], *in_batches(self.backend, left_out, feet[rows])
                (feet[rows],) = in_batches(self.backend, newton, *given)
                rows = rows[~np.isnan(feet[rows, 0])]
        if len(rows):
            (feet[rows],) = in_batches(self.backend, on_level, points[rows], feet[rows])
        return feet

    def noise(self, feet: FloatArray) -> FloatArray:
        """How far rounding and approximation may have moved the level at feet (n, 3)."""
        if not len(feet):
            return np.zeros(0)

        def compute(y: Vec3) -> tuple[Real]:
            return (self._descent.noise(y),)

        return in_batches(self.backend, compute, feet)[0]


class _Corrected(Field):
    """A field plus a linear function of the way from a point, other ones in each lane; its error is
    what rounding does."""

    def __init__(self, field: Field, at: Vec3, value: Real, slope: Vec3) -> None:
        self._field, self._at, self._value, self._slope = field, at, value, slope

    def evaluate(self, p: Vec3) -> Sample:
        sample = self._field.evaluate(p)
        shifted = sample.shifted(dr.dot(self._slope, p - self._at) + self._value)
        return replace(
            shifted, gradient=sample.gradient + self._slope, error=sample.error - sample.truncation,
            truncation=0.0,
        )  # fmt: skip

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self._field.hessian(p)


def _length(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (n, 3), whose squares may overflow."""
    x, y, z = vectors.T
    return np.hypot(np.hypot(x, y), z)


def _size(surface: LevelSet, points: FloatArray) -> float:
    """The size of the surface, or of the points where it is unknown."""
    if surface.volume is not None:
        lower, upper = surface.volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.ptp(points, axis=0).max()) if len(points) else 0.0, 1.0)
