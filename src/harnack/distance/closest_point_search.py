"""Searches the closest points of a surface: among the triangles of a closed mesh, or by branch and
bound over cells.

Every search ends at a root of f, at the first hit of a ray or on a triangle. So closest points are
points of the surface, and distances are upper bounds whatever path led there; a point that is
nearer than the proved lower bound is refused.

Cells that are proved empty are left out; descents begin at a known surface point of each of the
other cells (`cell_search`): first, in one kernel, from a few coarse cells, then, where finer cells
may hold a nearer point, from four of their points. The ball about a closest point that holds no
nearer point (`exclusion_ball`) settles most queries, as boxes within it are left out. The remaining
cells bound the distance from below, and are subdivided for proofs.

Closed meshes are triangles and a tree (`level_triangles`). For a mesh with holes the part of the
surface off its triangles is a smooth surface of w modulo 1 (`JumpSurface.without_jumps`), whose
closest points count where w itself has the level: rays that closed in on each point took 18 times
as long, and a tenth of them ended too far away.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import as_finite_vectors, upload_vectors
from harnack.backend.elementary import max_norm, safe_norm
from harnack.distance.cell_classification import ClipCurveDescent
from harnack.distance.cell_search import InitialGuess, SearchResult, StoppingRule, search
from harnack.distance.closest_point_descent import ClosestPointDescent
from harnack.distance.jump_surface_search import JumpSurfaceSearch, compass_search
from harnack.distance.level_triangles import LevelTriangles
from harnack.distance.tangent_plane import first_order_distance, in_batches
from harnack.fields.batch_evaluation import morton_order
from harnack.fields.capabilities import NO_FACET
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.field import Field

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.samples import Sample
    from harnack.geometry import Volume
    from harnack.tracer import TracedSurface

__all__ = ["ClosestPoints", "find_closest"]

# In epsilons, of coordinates: what rounding may do to a distance.
_ROUNDING = 64.0
# Of the size of the surface: cells are split until none can hold a point so much nearer.
_TOLERANCE = 1e-6
# Cells along an axis that points are sorted by, as a power of two.
_MORTON_BITS = 10
# The surface may leave its boundary at this cosine away from a point and yet come nearer to it.
_MAX_OPPOSING_COSINE = 0.2
# About the boundary the surface may be as far along a circle, in radii.
_MAX_ARC_RADII = 2.5
# Of feet of a field without jumps, which knows f but for a whole number: so near to a level f is.
_LEVEL_MATCH = 0.25
# Where f is compared on both sides of a triangle: so far from the point towards the middle, in
# parts of the way to it, and so far on either side, in sizes of the surface. By how much f has to
# be on different sides of a level.
_WITHIN_FACE, _BESIDE_FACE, _LEVEL_MARGIN = 1e-7, 1e-12, 1e-3
# How often what clusters leave out is computed for a foot.
_TRUNCATION_CORRECTIONS = 2
# Samples of a smooth part for each point, about.
_SAMPLES_PER_POINT = 10
# Sheets that are examined for each point before cells are.
_MAX_JUMPS_EXAMINED = 16


@dataclass(frozen=True)
class ClosestPoints:
    """The closest points of a surface to n query points, and bounds of the distances.

    points: (n, 3) the query points, rounded to the precision in use.
    closest: (n, 3) the closest points of the surface, NaN where none was found.
    distance: (n,) to these, NaN likewise.
    signed_value: (n,) f - level, of the level nearest in value.
    lower: (n,) proved lower bounds of the distance.
    violates_promises: (n,) whether a point was found that is nearer than the field's promises
        allow.
    """

    points: FloatArray
    closest: FloatArray
    distance: FloatArray
    signed_value: FloatArray
    lower: FloatArray
    violates_promises: BoolArray


def find_closest(
    backend: Backend, surface: TracedSurface, levels: Levels, points: Any,
    progress: Callable[[str], None], *, is_proved: bool = False,
) -> ClosestPoints:  # fmt: skip
    """The closest point of a surface to each of the points (n, 3).

    is_proved: whether cells are subdivided to make `lower` as large as they can prove.

    Points are sorted along a Morton curve, so that neighboring lanes traverse a tree together.
    """
    x = as_finite_vectors(points, "points")
    order = to_numpy(morton_order(backend, upload_vectors(backend, x), _MORTON_BITS))
    result = _find_sorted(backend, surface, levels, x[order], progress, is_proved)
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order), dtype=order.dtype)
    return ClosestPoints(*(array[inverse] for array in vars(result).values()))


def _find_sorted(
    backend: Backend, surface: TracedSurface, levels: Levels, points: FloatArray,
    progress: Callable[[str], None], is_proved: bool,
) -> ClosestPoints:  # fmt: skip
    mesh = LevelTriangles.of(surface)
    if mesh is not None and mesh.is_complete:
        return _closest_on_mesh(backend, surface, levels, mesh, points)
    job = _QueryEvaluator(backend, surface, levels)
    x, guess, above, lower, near = job.evaluate(points)
    if mesh is not None:
        guess = _with_mesh_points(x, guess, mesh)
    if surface.field.has_jumps:
        guess = job.with_jump_points(x, guess)
    tolerance = StoppingRule(_TOLERANCE * _size(surface, x), is_proved)
    field = surface.field.for_ray_count(_SAMPLES_PER_POINT * len(x))
    smooth = field.without_jumps() if surface.clip_volume is None else None
    if smooth is None:
        result = search(surface, x, InitialGuess(guess, near), job, tolerance, progress)
    else:
        result = _search_smooth_part(job, smooth, x, InitialGuess(guess, near), tolerance, progress)
    result.closest = _with_singular_points(surface, x, job.remove_truncation(x, result.closest))
    distance = _length(x - result.closest)
    # If a foot is nearer than the proof allows, then either it is off the surface by rounding, or a
    # promise of the field does not hold.
    is_short = distance < lower
    slack = np.zeros(len(x))
    slack[is_short] = 4 * job.level_uncertainty(result.closest[is_short])
    slack += _ROUNDING * backend.machine_epsilon * (np.abs(x).max(axis=1, initial=0.0) + lower)
    refused = distance < lower - slack
    feet = np.where(refused[:, None], np.nan, result.closest)
    distance = np.where(refused, np.nan, distance)
    lower = np.fmin(np.maximum(lower, result.lower_bounds), distance)
    return ClosestPoints(x, feet, distance, above, lower, refused)


def _search_smooth_part(
    job: _QueryEvaluator,
    smooth: Field,
    points: FloatArray,
    known: InitialGuess,
    tolerance: StoppingRule,
    progress: Callable[[str], None],
) -> SearchResult:
    """Search the smooth part of a surface that has jumps, and merge the result with closest points
    already known on its jump surfaces.

    smooth: `JumpSurface.without_jumps` of the surface's field.
    known: closest points on jump surfaces.

    Proof of the lower bounds: the surface lies in the union of the level sets of `smooth` and the
    jump surfaces, so it is no nearer than the nearer of the two. A point found on a level set of
    `smooth` is accepted only if f has the level there. Queries are searched again, with rays, where
    it does not, and where a jump surface is nearer than all accepted points: its nearest point need
    not belong to the surface.
    """
    backend, surface = job.backend, job.surface
    smooth_surface = replace(surface, field=smooth).with_call_cache(begins=True)
    evaluator = _QueryEvaluator(backend, smooth_surface, smooth_surface.target_levels(backend))
    near = evaluator.evaluate(points)[-1]
    result = search(
        smooth_surface,
        points,
        InitialGuess(known.feet, near, on_boundary=False),
        evaluator,
        tolerance,
        progress,
    )
    to_jumps = job.distance_to_jumps(points)
    rounding = (
        _ROUNDING * backend.machine_epsilon * (np.abs(points).max(axis=1, initial=0.0) + to_jumps)
    )
    lower = np.maximum(np.minimum(result.lower_bounds, to_jumps - rounding), 0)
    to_known, feet = _length(points - known.feet), known.feet.copy()
    rows = np.flatnonzero(
        _length(points - result.closest) < np.nan_to_num(to_known, nan=np.inf) - rounding
    )
    moved = evaluator.remove_truncation(points[rows], result.closest[rows])
    value = np.asarray(surface.field.value(moved, precision="double"))
    is_level = np.abs(value[:, None] - surface.level_values).min(axis=1) < _LEVEL_MATCH
    feet[rows[is_level]] = moved[is_level]
    is_known = _length(points - feet) <= to_jumps + rounding + tolerance.length
    is_known[rows[~is_level]] = False
    unsure = np.flatnonzero(~is_known)
    if len(unsure):
        guess = InitialGuess(feet[unsure], known.estimate[unsure])
        retried = search(surface, points[unsure], guess, job, tolerance, progress)
        feet[unsure], lower[unsure] = (
            retried.closest,
            np.maximum(lower[unsure], retried.lower_bounds),
        )
    return SearchResult(feet, lower)


def _with_singular_points(
    surface: TracedSurface, points: FloatArray, feet: FloatArray
) -> FloatArray:
    """The feet (n, 3), or the nearest singular points where these are nearer: beside singular
    points the surface may be a tiny loop that descents do not find."""
    singular = surface.field.singular_points
    if surface.clip_volume is not None and len(singular):
        singular = singular[surface.clip_volume.contains_points(singular)]
    if not len(singular) or not len(points):
        return feet
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    distance, index = searching.cKDTree(singular).query(points)
    is_nearer = ~(_length(points - feet) <= distance)
    return np.where(is_nearer[:, None], singular[index], feet)


def _closest_on_mesh(
    backend: Backend, surface: TracedSurface, levels: Levels, mesh: LevelTriangles, points: Any
) -> ClosestPoints:
    prepared, nearest = surface.evaluator(backend), mesh.upload(backend)

    def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
        above = -levels.offset_to_nearest(prepared.evaluate(p).value)
        offset = nearest(p)
        return p, p + offset, safe_norm(offset), above

    x, feet, distance, above = in_batches(backend, compute, points)
    slack = _ROUNDING * backend.machine_epsilon * (np.abs(x).max(axis=1, initial=0.0) + mesh.size)
    lower = np.maximum(distance - slack, 0)
    return ClosestPoints(x, feet, distance, above, lower, np.zeros(len(x), np.bool_))


def _with_mesh_points(points: FloatArray, start: FloatArray, mesh: LevelTriangles) -> FloatArray:
    """The points `start` (n, 3), or the nearest points of triangles where these are nearer."""
    backend = choose_backend("double")
    nearest = mesh.upload(backend)
    (offset,) = in_batches(backend, lambda p: (nearest(p),), points)  # pyright: ignore
    is_nearer = ~(_length(points - start) <= _length(offset))
    return np.where(is_nearer[:, None], points + offset, start)


@dataclass(frozen=True)
class _QueryEvaluator:
    """Evaluates one surface's field on a backend and runs the closest-point descents, for arrays of
    query points."""

    backend: Backend
    surface: TracedSurface
    levels: Levels

    def __post_init__(self) -> None:
        backend, field = self.backend, self.surface.evaluator(self.backend)
        set_ = object.__setattr__
        set_(self, "_field", field)
        exact = field.exact(backend)
        set_(self, "_descent", ClosestPointDescent.of(backend, field, self.levels))
        set_(
            self,
            "_exact",
            ClosestPointDescent.of(backend, exact, self.levels)
            if field.has_variable_accuracy
            else None,
        )
        domain = field.domain and field.domain.prepare(backend)
        set_(self, "_domain", domain)
        set_(self, "_rim", domain and ClipCurveDescent(backend, field, self.levels, domain))
        # Rays are compared by differences of angles, for which single precision is too short.
        double = choose_backend("double")
        set_(self, "_prepared", self.surface.prepare(double) if field.has_jumps else None)

    _field: Field = dataclasses.field(init=False)
    _descent: ClosestPointDescent = dataclasses.field(init=False)
    _exact: ClosestPointDescent | None = dataclasses.field(init=False)
    _domain: Volume | None = dataclasses.field(init=False)
    _rim: ClipCurveDescent | None = dataclasses.field(init=False)
    _prepared: Any = dataclasses.field(init=False)

    def evaluate(self, points: Any) -> tuple[FloatArray, ...]:
        """First estimates at query points. Returns the points as rounded to the precision in use,
        points of the surface near them (NaN for none), f - level, proved lower bounds of the
        distance, and the first-order distance."""

        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            sample = self._field.evaluate(p)
            above = -self.levels.offset_to_nearest(sample.value)
            boundary = self._field.closest_boundary_point(p)
            start = self.backend.Array3f(dr.nan) if boundary is None else boundary
            start = dr.select(above == 0, p, start)
            lower = self.backend.Float(0)
            if sample.all_promises:
                lower = level_distance_lower_bound(
                    self.backend, self._field, self.levels, p, sample
                )
            return p, start, above, lower, dr.abs(first_order_distance(above, sample.gradient))

        x, start, above, lower, near = in_batches(self.backend, compute, points)
        domain = self.surface.field.domain
        if domain is not None and len(x):
            lower[~domain.contains_points(x)] = 0
        return x, self._inside_domain_or_nan(start), above, lower, near

    def with_jump_points(self, points: FloatArray, start: FloatArray) -> FloatArray:
        """The points `start` (n, 3), or points of the surface on facets where these are nearer."""
        distance, start = _length(points - start), start.copy()
        rows = np.flatnonzero(~(distance <= self.distance_to_jumps(points) * (1 + 1e-12)))
        start[rows] = self._nearest_face_points(points[rows])
        rows = rows[np.isnan(start[rows, 0])]
        if len(rows):
            start[rows] = self._closest_on_facets(points[rows], start[rows])
        return start

    def _nearest_face_points(self, points: FloatArray) -> FloatArray:
        """The nearest points (n, 3) of the triangles of a jump surface, where the level lies
        between the values of f on both sides right beside them; NaN elsewhere."""
        mesh, prepared = self.surface.field.jump_mesh(), self._prepared
        feet = np.full_like(points, np.nan)
        if mesh is None or not len(points):
            return feet
        real, index = prepared.backend.Float, prepared.backend.UInt32

        def nearest(p: Vec3) -> tuple[Vec3, Any, Vec3]:
            none, always = (real(-1), index(NO_FACET)), prepared.backend.Bool(True)
            closest = prepared.field.nearest_facet(p, none, real(dr.inf), always)
            return p + closest.offset, closest.facet, closest.normal

        y, facet, normal = in_batches(prepared.backend, nearest, points)
        corners = mesh[0][mesh[1][facet.astype(np.int64)]]
        y_within = y + _WITHIN_FACE * (corners.mean(axis=1) - y)
        offset = _BESIDE_FACE * _size(self.surface, points) * normal
        sides = [
            self.surface.field.value(y_within + k * offset, precision="double") for k in (1, -1)
        ]
        low, high = np.minimum(*sides) + _LEVEL_MARGIN, np.maximum(*sides) - _LEVEL_MARGIN
        inside = np.any(
            [(low < level) & (level < high) for level in self.surface.level_values], axis=0
        )
        feet[inside] = y[inside]
        return feet

    def distance_to_jumps(self, points: FloatArray) -> FloatArray:
        """The distances (n,) to facets, whether these belong to the surface or not."""
        prepared = self._prepared

        def compute(p: Vec3) -> tuple[Real]:
            return (prepared.field.distance_to_jumps(p),)

        return in_batches(prepared.backend, compute, points)[0]

    def _closest_on_facets(self, points: FloatArray, start: FloatArray) -> FloatArray:
        x = np.concatenate([points, np.nan_to_num(start)])
        search = JumpSurfaceSearch(
            self._prepared, max(float(np.abs(x).max(initial=0)), 1e-30), _MAX_JUMPS_EXAMINED
        )

        def compute(p: Vec3, foot: Vec3) -> tuple[Vec3]:
            distance = safe_norm(foot - p)
            return (search.closest(p, dr.select(dr.isnan(distance), dr.inf, distance))[0],)

        (feet,) = in_batches(self._prepared.backend, compute, points, start)
        return np.where(np.isnan(feet), start, feet)

    def _inside_domain_or_nan(self, feet: FloatArray) -> FloatArray:
        """The points (n, 3), NaN for those outside the field's domain: the surface is cut there."""
        domain = self.surface.field.domain
        if domain is None or not len(feet):
            return feet
        inside = domain.contains_points(np.nan_to_num(feet))
        return np.where(inside[:, None], feet, np.nan)

    def descend(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`cell_search.DescentMethods`: by descent, or for fields with jumps by rays."""
        if self.surface.field.has_jumps:

            def by_rays(p: Vec3, start: Vec3) -> tuple[Vec3]:
                return (compass_search(self._prepared, p, start),)

            return in_batches(self._prepared.backend, by_rays, points, start)[0], np.zeros(
                len(points)
            )
        is_far_off = (start == points).all(axis=1)
        if is_far_off.any():

            def to_level(p: Vec3) -> tuple[Vec3]:
                y = self._descent.newton_to_level(p)
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
        feet = self._inside_domain_or_nan(feet)
        missing, rim = np.flatnonzero(np.isnan(feet[:, 0]) & (is_far == 0)), self._rim
        if rim is not None and len(missing):  # out of the domain

            def along_rim(p: Vec3, y: Vec3) -> tuple[Vec3]:
                return (rim.closest(p, y)[0],)

            (on_rim,) = in_batches(self.backend, along_rim, points[missing], start[missing])
            feet[missing], free[missing] = self._inside_domain_or_nan(on_rim), 0
        return feet, free

    def descend_from_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`cell_search.DescentMethods`."""

        def level_away(p: Vec3, b: Vec3, length_: Vec3) -> tuple[Real]:
            ray = p - b
            sample = self._field.evaluate(b + length_.x / safe_norm(ray) * ray)
            return (
                first_order_distance(self.levels.offset_to_nearest(sample.value), sample.gradient),
            )

        def to_level(p: Vec3, b: Vec3, length_: Vec3) -> tuple[Vec3]:
            ray = p - b
            y = self._descent.newton_to_level(b + length_.x / safe_norm(ray) * ray)
            ahead = dr.dot(ray, y - b) > -_MAX_OPPOSING_COSINE * safe_norm(ray) * safe_norm(y - b)
            return (dr.select(ahead, y, dr.nan),)

        feet, free = np.full_like(points, np.nan), np.zeros(len(points))
        lengths = np.tile(aside[:, None], 3)
        if not len(points):
            return feet, free
        # Beside an edge f is the angle about it: to first order the level is as far as the arc.
        (gap,) = in_batches(self.backend, level_away, points, boundary, lengths)
        rows = np.flatnonzero(~(np.abs(gap) > _MAX_ARC_RADII * aside))
        start = points[rows]
        if len(rows):
            (start,) = in_batches(
                self.backend, to_level, points[rows], boundary[rows], lengths[rows]
            )
        rows, start = rows[~np.isnan(start[:, 0])], start[~np.isnan(start[:, 0])]
        if len(rows):
            feet[rows], free[rows] = in_batches(self.backend, self._descend, points[rows], start)
        return self._inside_domain_or_nan(feet), free

    def newton_in_kernel(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """`cell_search.DescentMethods`."""
        p, vector = self.backend.Array3f(x), cast("Any", type(x))
        foot, _, free, goes_on, _ = self._newton(p, self.backend.Array3f(start), limit)
        if self._domain is not None:
            slack = _ROUNDING * self.backend.machine_epsilon * max_norm(foot)
            goes_on |= ~(self._domain.signed_distance(foot) < -slack)
        return vector(foot), type(x.x)(free), goes_on

    def _newton(self, p: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Vec3, Real, Mask, Mask]:
        """The results of Newton's method: feet, NaN if there is no foot; the points at which the
        search goes on; radii about feet; whether the search goes on; and whether it ended farther
        than `limit` away."""
        y, first_step, is_lost, is_far = self._descent.newton(p, start, self.backend.Float(limit))
        foot, is_found, free = self._descent.finish(p, y)
        reach = (safe_norm(p - start) + 2 * first_step) * (1 + 64 * self.backend.machine_epsilon)
        reach = dr.fma(64 * self.backend.machine_epsilon, max_norm(y), reach)
        is_lost |= is_far
        is_foot = is_found & ~is_lost & (safe_norm(p - foot) <= reach)
        return dr.select(is_foot, foot, dr.nan), y, free, ~(is_found | is_lost), is_far

    def _directly(self, p: Vec3, start: Vec3, limit: Vec3) -> tuple[Vec3, Vec3, Real, Real, Real]:
        """`_newton` with numbers for masks."""
        one, zero = self.backend.Float(1), self.backend.Float(0)
        *results, goes_on, is_far = self._newton(p, start, limit.x)
        return *results, dr.select(goes_on, one, zero), dr.select(is_far, one, zero)

    def _descend(self, p: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        y, is_found, on_level = self._descent.descend(p, start)
        return dr.select(on_level, y, dr.nan), dr.select(is_found, self._descent.finish(p, y)[2], 0)

    def remove_truncation(self, points: FloatArray, feet: FloatArray) -> FloatArray:
        """The feet (n, 3) moved onto the level of the field without truncation: by Newton's method
        for the closest point, else straight to the level."""
        rows = np.flatnonzero(np.isfinite(feet[:, 0]))
        exact = self._exact
        if exact is None or not len(rows):
            return feet

        def to_level(start: Vec3) -> tuple[Vec3]:
            y = exact.newton_to_level(start)
            return (dr.select(dr.isfinite(dr.squared_norm(y)), y, start),)

        feet = feet.copy()
        corrected = self._corrected(exact, points[rows], feet[rows])
        missing = np.flatnonzero(np.isnan(corrected[:, 0]))
        if len(missing):
            (corrected[missing],) = in_batches(self.backend, to_level, feet[rows[missing]])
        inside = ~np.isnan(self._inside_domain_or_nan(corrected)[:, 0])
        feet[rows[inside]] = corrected[inside]
        return feet

    def _corrected(
        self, exact: ClosestPointDescent, points: FloatArray, feet: FloatArray
    ) -> FloatArray:
        """The feet (n, 3) on the level of the exact field, NaN where they are not found.

        The truncation of clusters hardly changes on the way, and computing it costs as much as the
        exact field. So it is computed at the foot, with its gradient, and Newton's method is that
        of the field with clusters and this correction. This is done twice, as the foot moves by the
        first correction. A short step to the level of the exact field remains.
        """
        rough = self._descent

        def left_out(y: Vec3) -> tuple[Vec3, Vec3]:
            full, partial = exact.field.evaluate(y), rough.field.evaluate(y)
            vector = self.backend.Array3f
            return vector(full.value - partial.value), vector(full.gradient) - vector(
                partial.gradient
            )

        def newton(p: Vec3, y: Vec3, value: Vec3, slope: Vec3) -> tuple[Vec3]:
            field = _LinearlyShiftedField(rough.field, y, value.x, slope)
            shifted = replace(rough, field=field)
            end, _, is_lost, _ = shifted.newton(p, y, self.backend.Float(dr.inf))
            foot, is_found, _ = shifted.finish(p, end)
            return (dr.select(is_found & ~is_lost, foot, dr.nan),)

        def on_level(p: Vec3, y: Vec3) -> tuple[Vec3]:
            return (exact.last_step(p, y),)

        feet, rows = feet.copy(), np.arange(len(feet))
        for _ in range(_TRUNCATION_CORRECTIONS):
            if len(rows):
                inputs = points[rows], feet[rows], *in_batches(self.backend, left_out, feet[rows])
                (feet[rows],) = in_batches(self.backend, newton, *inputs)
                rows = rows[~np.isnan(feet[rows, 0])]
        if len(rows):
            (feet[rows],) = in_batches(self.backend, on_level, points[rows], feet[rows])
        return feet

    def level_uncertainty(self, feet: FloatArray) -> FloatArray:
        """The distances by which rounding and approximation may have moved the level at feet
        (n, 3)."""
        if not len(feet):
            return np.zeros(0)

        def compute(y: Vec3) -> tuple[Real]:
            return (self._descent.noise(y),)

        return in_batches(self.backend, compute, feet)[0]


class _LinearlyShiftedField(Field):
    """A field plus a linear function of the vector from a point, both different in each lane; its
    error is the rounding error alone."""

    def __init__(self, field: Field, at: Vec3, value: Real, slope: Vec3) -> None:
        self._field, self._at, self._value, self._slope = field, at, value, slope

    def evaluate(self, p: Vec3) -> Sample:
        sample = self._field.evaluate(p)
        shifted = sample.shifted(dr.dot(self._slope, p - self._at) + self._value)
        return replace(
            shifted,
            gradient=sample.gradient + self._slope,
            value_error=sample.value_error - sample.truncation_error,
            truncation_error=0.0,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self._field.hessian(p)


def _length(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (n, 3), whose squares may overflow."""
    x, y, z = vectors.T
    return np.hypot(np.hypot(x, y), z)


def _size(surface: TracedSurface, points: FloatArray) -> float:
    """The size of the surface, or of the points where it is unknown."""
    if surface.volume is not None:
        lower, upper = surface.volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.ptp(points, axis=0).max()) if len(points) else 0.0, 1.0)
