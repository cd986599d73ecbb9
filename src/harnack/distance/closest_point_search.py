"""Searches the points of a surface that are closest to given query points. The surface is a level
set of a function f: the points at which f takes a given value, the level. The search goes over the
triangles of a closed mesh, or over cells (branch and bound). f may jump at facets, such as the
triangles of a mesh; these form a jump surface.

Every search ends at a root of f - level, at the first hit of a ray, or on a triangle. So the points
found are points of the surface, and their distances are upper bounds of the true distances. A point
that is nearer than the proved lower bound is rejected.

Cells are cubes that may hold the surface; those that are proved empty are left out. In most other
cells a point of the surface is known, from which a descent to the closest point can start
(`cell_search`). For each query, the first descent starts in a coarse cell. If finer cells may hold
a nearer point, further descents start in four of these. Around each closest point found, a ball is
proved to hold no nearer point (`exclusion_ball`). Cells inside this ball need no search, which
settles most queries. The cells that remain give a lower bound of the distance, and they are
subdivided if proofs are wanted.

For a closed mesh, a tree finds the nearest triangle of the level set (`level_triangles`). If a mesh
has holes, its surface also has parts off the triangles. There the winding number w has the level,
and so does w modulo 1, which is smooth across the triangles (`Jumps.smooth_field`).
Therefore the level set of w modulo 1 is searched, and a closest point of it is accepted only if w
itself has the level there. (A search by rays toward ever nearer points was slower by a factor of
18, and a tenth of its results were too far away.)
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
from harnack.distance.crease_search import MAX_OPERANDS, CreaseSearch
from harnack.distance.jump_surface_search import JumpSurfaceSearch, compass_search
from harnack.distance.level_triangles import LevelTriangles
from harnack.distance.tangent_plane import first_order_distance, in_batches
from harnack.fields.batch_evaluation import morton_order
from harnack.fields.capabilities import NO_FACET, exactly_sampled
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.evaluator import Evaluator
from harnack.fields.field import Field
from harnack.fields.solids.solid import Solid
from harnack.geometry.neighborhoods import kd_tree

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.enclosures.samples import Sample
    from harnack.geometry import Volume
    from harnack.tracer import TracedSurface

__all__ = ["ClosestPoints", "find_closest"]

# Allowance for the rounding of a distance, in machine epsilons of the coordinates.
_ROUNDING = 64.0
# Fraction of the surface's size: cells are split until none can hold a point that is nearer than
# the best one by more than this.
_TOLERANCE = 1e-6
# Fraction of that tolerance: distances of combined solids that exceed a proved lower bound by more
# are improved at creases.
_SETTLED = 1e-4
# Bits per axis of the Morton codes by which points are sorted.
_MORTON_BITS = 10
# The surface is followed from its boundary in the direction of the query, or in one that points
# away from the query with at most this cosine.
_MAX_OPPOSING_COSINE = 0.2
# On a small circle around the boundary the surface is searched up to this arc length, in radii of
# the circle.
_MAX_ARC_RADII = 2.5
# The field without jumps knows f but for a whole number. A closest point of it belongs to the
# surface if f differs from a level by less than this.
_LEVEL_MATCH = 0.25
# f is compared on both sides of a triangle. The point is first moved into the triangle, by this
# fraction of the way to its center; then off the triangle, by this fraction of the surface's size;
# and the two values must lie on different sides of a level by this margin.
_WITHIN_FACE, _BESIDE_FACE, _LEVEL_MARGIN = 1e-7, 1e-12, 1e-3
# Number of times that the truncation error of the treecode is computed for a closest point.
_TRUNCATION_CORRECTIONS = 2
# Approximate number of samples of the smooth part for each query point.
_SAMPLES_PER_POINT = 10
# Number of facets of the jump surface that are examined for each query before cells are searched.
_MAX_JUMPS_EXAMINED = 16


@dataclass(frozen=True)
class ClosestPoints:
    """The points of a surface that are closest to n query points, and bounds of their distances. f
    is the function whose level is the surface.

    points: (n, 3) the query points, as rounded to the precision of the computation.
    closest: (n, 3) the closest points of the surface, NaN where none was found.
    distance: (n,) the distances of the queries from these points; NaN where none was found.
    signed_value: (n,) f - level at the queries, for the level nearest in value.
    lower: (n,) proved lower bounds of the distance.
    violates_promises: (n,) whether a surface point was found, and left out, that is nearer than
        `lower`, which follows from the field's promises (proved bounds of f near a point).
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
    """Find the closest point of a surface to each query point.

    levels: the values of f on the surface, on the backend.
    points: (n, 3) the queries, in any order.
    progress: called with a message before each stage.
    is_proved: whether cells are subdivided, so that the lower bounds become as large as can be
        proved.

    The result is in the order of `points`. The search itself sorts them along a Morton curve, so
    that neighboring lanes traverse a tree together.
    """
    x = as_finite_vectors(points, "points")
    order = to_numpy(morton_order(backend, upload_vectors(backend, x), _MORTON_BITS))
    closest = _find_sorted(backend, surface, levels, x[order], progress, is_proved)
    # The inverse of the permutation `order`.
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order), dtype=order.dtype)
    return ClosestPoints(*(column[rank] for column in vars(closest).values()))


def _find_sorted(
    backend: Backend, surface: TracedSurface, levels: Levels, points: FloatArray,
    progress: Callable[[str], None], is_proved: bool,
) -> ClosestPoints:  # fmt: skip
    """Find the closest point of a surface to each of the query points (n, 3), which are sorted
    along a Morton curve. This is the work of `find_closest`, with the same parameters.

    A surface of triangles alone is searched by a tree of them. For others, points that are known at
    once (on triangles and other facets, and at boundaries) are the first guess of a search over
    cells. A point that is found nearer than the proved lower bound, by more than rounding, is
    refused: the query then has no closest point.

    progress: called with a message before each stage.
    is_proved: whether cells are subdivided for larger lower bounds.
    """
    triangles = LevelTriangles.of(surface, backend)
    if triangles is not None and triangles.is_complete:
        return _closest_on_mesh(backend, surface, levels, triangles, points)
    query = _Query(backend, surface, levels)
    x, guess, residual, lower, estimate = query.evaluate(points)
    if triangles is not None:
        guess = _with_mesh_points(x, guess, triangles)
    if surface.field.traits.has_jumps:
        guess = query.with_jump_points(x, guess)
    tolerance = StoppingRule(_TOLERANCE * _size(surface, x), is_proved)
    # Off the facets of a mesh without a clip, f differs from a smooth function by constants.
    jumps = surface.evaluator(backend).jumps
    smooth = None if jumps is None or surface.clip_volume is not None else jumps.smooth_field()
    if smooth is None:
        result = search(surface, x, InitialGuess(guess, estimate), query, tolerance, progress)
        if jumps is not None:
            result.closest = _with_points_between_jumps(query, x, result.closest)
    else:
        result = _search_smooth_part(
            query, smooth, x, InitialGuess(guess, estimate), tolerance, progress
        )
    result.closest = _with_singular_points(surface, x, query.remove_truncation(x, result.closest))
    if not surface.field.traits.has_jumps:
        proved = np.maximum(lower, result.lower_bounds)
        result.closest = _with_gradient_feet(
            query, x, result.closest, estimate, proved + tolerance.length
        )
        result.closest = _with_crease_points(
            query, x, result.closest, proved + _SETTLED * tolerance.length
        )
    distance = _length(x - result.closest)
    # A closest point may be nearer than the proved lower bound: either rounding has moved it off
    # the surface, or a promise of the field does not hold.
    is_below_bound = distance < lower
    allowed_error = np.zeros(len(x))
    allowed_error[is_below_bound] = 4 * query.level_uncertainty(result.closest[is_below_bound])
    allowed_error += (
        _ROUNDING * backend.machine_epsilon * (np.abs(x).max(axis=1, initial=0.0) + lower)
    )
    is_refused = distance < lower - allowed_error
    closest = np.where(is_refused[:, None], np.nan, result.closest)
    distance = np.where(is_refused, np.nan, distance)
    # The cells may prove more than f at the query alone.
    lower = np.fmin(np.maximum(lower, result.lower_bounds), distance)
    return ClosestPoints(x, closest, distance, residual, lower, is_refused)


def _with_gradient_feet(
    query: _Query, points: FloatArray, closest: FloatArray, estimate: FloatArray,
    settled: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the closest points of queries, replaced where f is a distance: there the surface point
    to which the gradient leads is the closest one, even at an edge or a corner, where descents
    along the surface may end beside it. This is so where the estimate of the distance is proved.

    points, closest: (n, 3) the queries, and their closest points so far, NaN for none.
    estimate: (n,) first-order estimates of the distances.
    settled: (n,) the length up to which a distance needs no improvement: its proved lower bound and
        the tolerance.
    """
    distance = _length(points - closest)
    rows = np.flatnonzero(~(distance <= settled) & (estimate <= settled))
    if not len(rows):
        return closest
    feet = query.gradient_feet(points[rows])
    is_nearer = _length(points[rows] - feet) < np.nan_to_num(distance[rows], nan=np.inf)
    closest = closest.copy()
    closest[rows[is_nearer]] = feet[is_nearer]
    return closest


def _with_points_between_jumps(
    query: _Query, points: FloatArray, closest: FloatArray
) -> FloatArray:
    """Return the closest points of queries for a function that jumps, replaced where the gradient
    leads to a nearer point. The search in cells begins at a single point of each cell, and a facet
    may pass between that point and the query.

    Where f, sampled at a point, equals the level, the point is on the surface, whatever facets are
    near. From there a compass search leads to a point that is nearer still.

    points, closest: (n, 3) the queries, and their closest points so far, NaN for none.
    """
    feet = query.gradient_feet(points)
    distance = np.nan_to_num(_length(points - closest), nan=np.inf)
    rows = np.flatnonzero(_length(points - feet) < distance)
    if not len(rows):
        return closest
    closest = closest.copy()
    closest[rows] = feet[rows]
    nearer, _ = query.descend(points[rows], feet[rows], np.full(len(rows), np.inf))
    is_nearer = _length(points[rows] - nearer) < _length(points[rows] - feet[rows])
    closest[rows[is_nearer]] = nearer[is_nearer]
    return closest


def _with_crease_points(
    query: _Query, points: FloatArray, closest: FloatArray, settled: FloatArray
) -> FloatArray:
    """Return the closest points of queries on a combination of solids, replaced where descents
    along one operand alone, or along the creases at which operands meet, find nearer ones
    (`CreaseSearch`). Fields that are no combinations keep their points, and so do combinations of
    more operands than `MAX_OPERANDS`.

    points, closest: (n, 3) the queries, and their closest points so far, NaN for none.
    settled: (n,) the length up to which a distance needs no improvement: its proved lower bound and
        a fraction of the tolerance.
    """
    backend, surface = query.backend, query.surface
    field = surface.field
    operands = field.operands() if isinstance(field, Solid) else ()
    rows = np.flatnonzero(~(_length(points - closest) <= settled))
    if not 1 < len(operands) <= MAX_OPERANDS or not len(rows):
        return closest
    descents = (
        _Query(backend, replace(surface, field=operand), query.levels) for operand in operands
    )
    creases = CreaseSearch(backend, query.evaluator, query.levels, tuple(descents))
    candidates = query.inside_domain_or_nan(creases.candidates(points[rows], closest[rows]))
    is_found = ~np.isnan(candidates[:, 0])
    closest = closest.copy()
    closest[rows[is_found]] = candidates[is_found]
    return closest


def _search_smooth_part(
    query: _Query,
    smooth: Field,
    points: FloatArray,
    known: InitialGuess,
    tolerance: StoppingRule,
    progress: Callable[[str], None],
) -> SearchResult:
    """Search the part of a surface that does not lie on jump surfaces (the facets across which its
    function f jumps, such as triangles). The result also takes account of the closest points on
    jump surfaces.

    query: evaluates f and runs descents.
    smooth: a function without jumps that differs from f by a constant between jump surfaces
        (`Jumps.smooth_field`).
    points: (n, 3) the query points.
    known: for each query, a point of the surface on a jump surface (NaN if none is known), and an
        estimate of the query's distance from the surface.
    tolerance: when the search ends.
    progress: called with a message before each stage.

    Proof of the lower bounds: the surface lies in the union of the level sets of `smooth` and the
    jump surfaces, so it is no nearer than the nearer of the two. A point found on a level set of
    `smooth` is accepted only if f has the level there. A query is searched again, with rays, if f
    does not have the level there, or if a jump surface is nearer than all accepted points: the
    nearest point of the jump surface need not belong to the surface.
    """
    backend, surface = query.backend, query.surface
    ray_count = _SAMPLES_PER_POINT * len(points)
    smoothed = replace(surface, field=smooth, ray_count=ray_count).with_call_cache(begins=True)
    smooth_query = _Query(backend, smoothed, smoothed.target_levels(backend))
    # The last result: first-order estimates of the distances.
    estimate = smooth_query.evaluate(points)[-1]
    result = search(
        smoothed,
        points,
        InitialGuess(known.closest, estimate, on_boundary=False),
        smooth_query,
        tolerance,
        progress,
    )
    jump_gap = query.distance_to_jumps(points)
    rounding = (
        _ROUNDING * backend.machine_epsilon * (np.abs(points).max(axis=1, initial=0.0) + jump_gap)
    )
    lower = np.maximum(np.minimum(result.lower_bounds, jump_gap - rounding), 0)
    distance, closest = _length(points - known.closest), known.closest.copy()
    # Only the points that are nearer than the known ones on jump surfaces improve the result.
    nearer_rows = np.flatnonzero(
        _length(points - result.closest) < np.nan_to_num(distance, nan=np.inf) - rounding
    )
    candidates = smooth_query.remove_truncation(points[nearer_rows], result.closest[nearer_rows])
    # f itself must have the level there, not only `smooth`.
    values = np.asarray(surface.field.value(candidates, precision="double"))
    is_level = np.abs(values[:, None] - surface.level_values).min(axis=1) < _LEVEL_MATCH
    closest[nearer_rows[is_level]] = candidates[is_level]
    # A query needs no further search if no jump surface is nearer than its accepted point.
    is_settled = _length(points - closest) <= jump_gap + rounding + tolerance.length
    is_settled[nearer_rows[~is_level]] = False
    unsettled_rows = np.flatnonzero(~is_settled)
    if len(unsettled_rows):
        guess = InitialGuess(closest[unsettled_rows], known.estimate[unsettled_rows])
        # Search again with f itself, by rays.
        retry = search(surface, points[unsettled_rows], guess, query, tolerance, progress)
        closest[unsettled_rows], lower[unsettled_rows] = (
            retry.closest,
            np.maximum(lower[unsettled_rows], retry.lower_bounds),
        )
    return SearchResult(closest, lower)


def _with_singular_points(
    surface: TracedSurface, points: FloatArray, closest: FloatArray
) -> FloatArray:
    """Return the closest points of queries, each replaced by the nearest singular point of the
    field if that is nearer to the query. Singular points are those to which all level sets come
    arbitrarily near; there the surface is a tiny loop, which descents miss. Singular points outside
    the clip volume do not count.

    points, closest: (n, 3) the queries, and their closest points so far, NaN for none.
    """
    boundary = surface.field.boundary
    if boundary is None or boundary.points is None:
        return closest
    singular = boundary.points
    if surface.clip_volume is not None and len(singular):
        singular = singular[surface.clip_volume.contains_points(singular)]
    if not len(singular) or not len(points):
        return closest
    distance, rows = kd_tree(singular).query(points)
    # Written with `not <=`, so that it is True where there is no closest point (NaN).
    is_nearer = ~(_length(points - closest) <= distance)
    return np.where(is_nearer[:, None], singular[rows], closest)


def _closest_on_mesh(
    backend: Backend, surface: TracedSurface, levels: Levels, mesh: LevelTriangles, points: Any
) -> ClosestPoints:
    """Find the closest point to each query on a surface that consists of triangles only. In the
    result, the lower bound of a distance is the distance less an allowance for rounding.

    backend, surface, levels: the surface, and on which backend its function is evaluated.
    mesh: the triangles of the surface.
    points: (n, 3) the queries.
    """
    evaluator, nearest = surface.evaluator(backend), mesh.upload(backend)

    def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
        """Return four results for the query p: p as rounded, the nearest triangle point, the
        distance from it, and f - level."""
        residual = -levels.offset_to_nearest(evaluator.evaluate(p).value)
        offset = nearest(p)
        return p, p + offset, safe_norm(offset), residual

    x, closest, distance, residual = in_batches(backend, compute, points)
    slack = _ROUNDING * backend.machine_epsilon * (np.abs(x).max(axis=1, initial=0.0) + mesh.size)
    lower = np.maximum(distance - slack, 0)
    # No promise is used here, so none is violated.
    return ClosestPoints(x, closest, distance, residual, lower, np.zeros(len(x), np.bool_))


def _with_mesh_points(points: FloatArray, guess: FloatArray, mesh: LevelTriangles) -> FloatArray:
    """Return the surface points `guess`, each replaced by the nearest point of the triangles if
    that is nearer to the query.

    points, guess: (n, 3) the queries, and a surface point for each; NaN counts as infinitely far.
    mesh: the triangles, which belong to the surface.
    """
    backend = choose_backend("double")
    nearest = mesh.upload(backend)
    (offset,) = in_batches(backend, lambda p: (nearest(p),), points)  # pyright: ignore
    # Written with `not <=`, so that it is True where the guess is NaN.
    is_nearer = ~(_length(points - guess) <= _length(offset))
    return np.where(is_nearer[:, None], points + offset, guess)


@dataclass(frozen=True)
class _Query:
    """Evaluates the function f of one surface on a backend, and runs descents from points near the
    surface to closest points, for arrays of query points. Facets are the triangles or other pieces
    at which f may jump.

    levels: the values of f on the surface, on the backend.

    The attributes with an underscore are made from the given ones:

    _evaluator: samples f on the backend.
    _descent, _exact_descent: the descent on the level set of f; and, if f is the approximation of a
        sum with a truncation error, on the level set of the exact sum (else None).
    _domain, _clip: the field's domain; and the descent to the clip curve, in which the boundary of
        the domain cuts the surface (None without a domain).
    _tracer: for functions with jumps, the tracer of the surface in double precision.
    """

    backend: Backend
    surface: TracedSurface
    levels: Levels

    def __post_init__(self) -> None:
        """Make the attributes with an underscore. It uses `object.__setattr__`, as the dataclass is
        frozen."""
        backend, evaluator = self.backend, self.surface.evaluator(self.backend)
        domain = self.surface.field.domain
        assign = object.__setattr__
        assign(self, "_evaluator", evaluator)
        exact = exactly_sampled(evaluator, backend)
        assign(self, "_descent", ClosestPointDescent.of(backend, evaluator, self.levels))
        assign(
            self,
            "_exact_descent",
            ClosestPointDescent.of(backend, exact, self.levels)
            if evaluator.variable_accuracy is not None
            else None,
        )
        domain = domain and domain.upload(backend)
        assign(self, "_domain", domain)
        assign(self, "_clip", domain and ClipCurveDescent(backend, evaluator, self.levels, domain))
        # For a function with jumps, closest points are searched by rays from the query
        # (`compass_search`), in directions that differ less and less. Single precision is too
        # coarse for such small angles.
        double = choose_backend("double")
        assign(
            self, "_tracer", self.surface.tracer(double) if evaluator.jumps is not None else None
        )

    _evaluator: Evaluator = dataclasses.field(init=False)
    _descent: ClosestPointDescent = dataclasses.field(init=False)
    _exact_descent: ClosestPointDescent | None = dataclasses.field(init=False)
    _domain: Volume | None = dataclasses.field(init=False)
    _clip: ClipCurveDescent | None = dataclasses.field(init=False)
    _tracer: Any = dataclasses.field(init=False)

    @property
    def evaluator(self) -> Evaluator:
        """The evaluator of the function f."""
        return self._evaluator

    def gradient_feet(self, points: FloatArray) -> FloatArray:
        """Return the points of the surface (n, 3) to which Newton's method along the gradient leads
        from `points` (n, 3); NaN where it leads to none."""

        def to_level(p: Vec3) -> tuple[Vec3]:
            return (self._descent.newton_to_level(p),)

        (feet,) = in_batches(self.backend, to_level, points)
        return self.inside_domain_or_nan(feet)

    def evaluate(self, points: Any) -> tuple[FloatArray, ...]:
        """Evaluate f at query points, and return first estimates of their distances.

        Returns the points (n, 3) as rounded to the precision in use; points (n, 3) of the surface
        near them, NaN where none is known; f - level (n,); proved lower bounds (n,) of the
        distance; and its first-order estimates (n,).

        A query on the level is its own surface point; otherwise the nearest point of the curve at
        which the surface ends is taken, if the field knows it. Outside the domain no lower bound is
        proved: it is 0.
        """

        def compute(p: Vec3) -> tuple[Real | Vec3, ...]:
            """Return five results for the query p: p as rounded; a point of the surface known near
            it, or NaN; f - level; a proved lower bound of the distance from the level set; and the
            first-order estimate of that distance."""
            sample = self._evaluator.evaluate(p)
            residual = -self.levels.offset_to_nearest(sample.value)
            boundary, surface_point = self.surface.field.boundary, self.backend.Array3f(dr.nan)
            if boundary is not None and boundary.closest_point is not None:
                surface_point = boundary.closest_point(p)
            surface_point = dr.select(residual == 0, p, surface_point)
            lower = self.backend.Float(0)
            if sample.all_promises:
                lower = level_distance_lower_bound(
                    self.backend, self._evaluator, self.levels, p, sample
                )
            return (
                p,
                surface_point,
                residual,
                lower,
                dr.abs(first_order_distance(residual, sample.gradient)),
            )

        x, surface_point, residual, lower, estimate = in_batches(self.backend, compute, points)
        domain = self.surface.field.domain
        if domain is not None and len(x):
            # Nothing is promised outside the domain.
            lower[~domain.contains_points(x)] = 0
        return x, self.inside_domain_or_nan(surface_point), residual, lower, estimate

    def with_jump_points(self, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Return surface points (n, 3) near queries. They are those of `guess`, except for queries
        to which a facet (at which f jumps) is nearer than their guess. These get a point of the
        surface on a facet instead, or NaN if none is found.

        points, guess: (n, 3) the queries, and the surface points; NaN counts as infinitely far.
        """
        distance, guess = _length(points - guess), guess.copy()
        # 1e-12 allows for rounding; `not <=` is True for NaN.
        searched_rows = np.flatnonzero(~(distance <= self.distance_to_jumps(points) * (1 + 1e-12)))
        # First the nearest triangle alone; where that is not on the surface, all facets in turn.
        # (NaN stands for no point, also in place of the guess.)
        guess[searched_rows] = self._nearest_face_points(points[searched_rows])
        searched_rows = searched_rows[np.isnan(guess[searched_rows, 0])]
        if len(searched_rows):
            guess[searched_rows] = self._search_facets(points[searched_rows], guess[searched_rows])
        return guess

    def _nearest_face_points(self, points: FloatArray) -> FloatArray:
        """Return the nearest points (n, 3) of the triangles across which f jumps. A point is part
        of the surface, and is returned, only if a level lies between the values of f right beside
        it, on the two sides of the triangle; else the row is NaN.

        points: (n, 3) the queries.
        """
        jumps, tracer = self._tracer.evaluator.jumps, self._tracer
        mesh = jumps.mesh()
        closest = np.full_like(points, np.nan)
        if mesh is None or not len(points):
            return closest
        real, index = tracer.backend.Float, tracer.backend.UInt32

        def nearest(p: Vec3) -> tuple[Vec3, Any, Vec3]:
            """Return the point of a facet that is nearest to p, the index of the facet, and the
            facet's normal at the point."""
            no_key, always = (real(-1), index(NO_FACET)), tracer.backend.Bool(True)
            facet = jumps.nearest_facet(p, no_key, real(dr.inf), always)
            return p + facet.offset, facet.facet, facet.normal

        y, facet_id, normal = in_batches(tracer.backend, nearest, points)
        # `mesh` holds the vertices and the faces.
        corners = mesh[0][mesh[1][facet_id.astype(np.int64)]]
        y_within = y + _WITHIN_FACE * (corners.mean(axis=1) - y)
        offset = _BESIDE_FACE * _size(self.surface, points) * normal
        # f beside the triangle, where the point was moved a little into the triangle to avoid its
        # edges.
        sides = [
            self.surface.field.value(y_within + k * offset, precision="double") for k in (1, -1)
        ]
        low, high = np.minimum(*sides) + _LEVEL_MARGIN, np.maximum(*sides) - _LEVEL_MARGIN
        is_on = np.any(
            [(low < level) & (level < high) for level in self.surface.level_values], axis=0
        )
        closest[is_on] = y[is_on]
        return closest

    def distance_to_jumps(self, points: FloatArray) -> FloatArray:
        """Return the distances (n,) of points (n, 3) from the facets across which f jumps, whether
        these are part of the surface or not."""
        jumps = self._tracer.evaluator.jumps

        def compute(p: Vec3) -> tuple[Real]:
            return (jumps.distance(p),)

        return in_batches(self._tracer.backend, compute, points)[0]

    def _search_facets(self, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Return the closest points (n, 3) that `JumpSurfaceSearch` finds on facets, nearer than
        `guess` (n, 3); `guess` where it finds none. It examines at most `_MAX_JUMPS_EXAMINED`
        facets for each query."""
        # The search takes an upper bound of all coordinates.
        coordinates = np.concatenate([points, np.nan_to_num(guess)])
        search = JumpSurfaceSearch(
            self._tracer, max(float(np.abs(coordinates).max(initial=0)), 1e-30), _MAX_JUMPS_EXAMINED
        )

        def compute(p: Vec3, guess_point: Vec3) -> tuple[Vec3]:
            distance = safe_norm(guess_point - p)
            # The first result is the point; a missing guess sets no limit.
            return (search.closest(p, dr.select(dr.isnan(distance), dr.inf, distance))[0],)

        (closest,) = in_batches(self._tracer.backend, compute, points, guess)
        return np.where(np.isnan(closest), guess, closest)

    def inside_domain_or_nan(self, points: FloatArray) -> FloatArray:
        """Return the points (n, 3), with NaN in place of those outside the field's domain, as the
        domain cuts the surface."""
        domain = self.surface.field.domain
        if domain is None or not len(points):
            return points
        is_inside = domain.contains_points(np.nan_to_num(points))
        return np.where(is_inside[:, None], points, np.nan)

    def descend(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Find the closest points of the surface to query points, by Newton's method, and by a
        slower descent where that does not converge. For functions that jump, a compass search with
        rays is used instead (`compass_search`).

        points: (n, 3) the queries.
        start: (n, 3) points near the surface from which the searches start. A row that equals its
            query means that no start is known; Newton's method then first leads to the surface.
        limit: (n,) closest points that are farther from their query than this need not be found.

        Returns:
            The closest points (n, 3), NaN where none is found or it is farther than the limit. One
            that lies outside the field's domain is replaced by the closest point of the clip curve,
            in which the boundary of the domain cuts the surface. And radii (n,): in the ball of
            this radius about the closest point, no point of the surface is nearer to the query; 0
            if that is not proved.
        """
        if self.surface.field.traits.has_jumps:

            def by_compass_search(p: Vec3, start: Vec3) -> tuple[Vec3]:
                return (compass_search(self._tracer, p, start),)

            # (Radii of 0: no ball is proved.)
            return in_batches(self._tracer.backend, by_compass_search, points, start)[0], np.zeros(
                len(points)
            )
        is_unknown = (start == points).all(axis=1)
        # Without a start, Newton's method along the gradient leads to the surface, if it converges.
        if is_unknown.any():

            def to_level(p: Vec3) -> tuple[Vec3]:
                y = self._descent.newton_to_level(p)
                return (dr.select(dr.isnan(y.x), p, y),)

            start = start.copy()
            (start[is_unknown],) = in_batches(self.backend, to_level, points[is_unknown])
        limits = np.tile(limit[:, None], 3)  # as `in_batches` takes arrays (n, 3) only
        closest, y, free, is_unfinished, is_far = in_batches(
            self.backend, self._newton_with_float_masks, points, start, limits
        )
        # If Newton's method did not converge, the slower descent goes on from its last point.
        rows = np.flatnonzero(is_unfinished)
        if len(rows):
            closest[rows], free[rows] = in_batches(
                self.backend, self._descend, points[rows], y[rows]
            )
        closest = self.inside_domain_or_nan(closest)
        ids, clip = np.flatnonzero(np.isnan(closest[:, 0]) & (is_far == 0)), self._clip
        # Closest points outside the domain are replaced by points of the clip curve.
        if clip is not None and len(ids):

            def to_clip_curve(p: Vec3, y: Vec3) -> tuple[Vec3]:
                # Without the curvature of the curve, the second result.
                return (clip.closest(p, y)[0],)

            (clipped,) = in_batches(self.backend, to_clip_curve, points[ids], start[ids])
            closest[ids], free[ids] = self.inside_domain_or_nan(clipped), 0
        return closest, free

    def descend_from_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Find the closest points of the surface to queries whose best point so far lies on the
        curve at which the surface ends. Each search starts on the surface beside that curve.

        points: (n, 3) the queries.
        boundary: (n, 3) the points b on the curve.
        aside: (n,) the distance from b, in the direction of the query, at which f is evaluated. If
            the level is near there to first order, Newton's method leads to the surface, and the
            descent starts there, unless that point lies on the side of b away from the query.

        Returns the closest points (n, 3), NaN where none is found; and radii (n,) of balls about
        them that hold no point of the surface nearer to the query.
        """

        def distance_to_level(p: Vec3, b: Vec3, lengths: Vec3) -> tuple[Real]:
            """Return the first-order signed distance (level - f)/|grad f| of the level from a
            point, as a tuple of one. The point lies at the distance lengths.x from the point b of
            the boundary curve, in the direction of the query p. (A length comes as a vector of
            three equal components, since `in_batches` takes vectors only.)"""
            to_query = p - b
            sample = self._evaluator.evaluate(b + lengths.x / safe_norm(to_query) * to_query)
            return (
                first_order_distance(self.levels.offset_to_nearest(sample.value), sample.gradient),
            )

        def near_edge(p: Vec3, b: Vec3, lengths: Vec3) -> tuple[Vec3]:
            """Run Newton's method to the surface, from the point at the distance lengths.x from the
            point b of the boundary curve, in the direction of the query p. Returns the surface
            point, as a tuple of one; NaN if it is on the side of b away from p."""
            to_query = p - b
            y = self._descent.newton_to_level(b + lengths.x / safe_norm(to_query) * to_query)
            # A little beyond a right angle still counts.
            is_on_query_side = dr.dot(to_query, y - b) > -_MAX_OPPOSING_COSINE * safe_norm(
                to_query
            ) * safe_norm(y - b)
            return (dr.select(is_on_query_side, y, dr.nan),)

        closest, free = np.full_like(points, np.nan), np.zeros(len(points))
        offsets = np.tile(aside[:, None], 3)
        if not len(points):
            return closest, free
        # Beside an edge of the surface f is the angle about the edge: so the first-order distance
        # of the level is the length of an arc around the edge.
        (arc_length,) = in_batches(self.backend, distance_to_level, points, boundary, offsets)
        rows = np.flatnonzero(~(np.abs(arc_length) > _MAX_ARC_RADII * aside))
        start = points[rows]
        if len(rows):
            (start,) = in_batches(
                self.backend, near_edge, points[rows], boundary[rows], offsets[rows]
            )
        rows, start = rows[~np.isnan(start[:, 0])], start[~np.isnan(start[:, 0])]
        if len(rows):
            closest[rows], free[rows] = in_batches(self.backend, self._descend, points[rows], start)
        return self.inside_domain_or_nan(closest), free

    def newton_in_kernel(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """Run Newton's method for the closest point to the query x, as part of another kernel.

        start: a point near the surface.
        limit: a closest point farther from x than this need not be found.

        Returns the closest point, NaN if none is found; the radius of a ball about it in which no
        surface point is nearer to x; and the mask of lanes for which `descend` has to be called
        afterwards, because the method did not converge, or led out of the domain or to its
        boundary.
        """
        # x has the types of the other kernel, perhaps of another precision; the results get them.
        p, vector = self.backend.Array3f(x), cast("Any", type(x))
        closest, _, free, is_unfinished, _ = self._newton(p, self.backend.Array3f(start), limit)
        if self._domain is not None:
            slack = _ROUNDING * self.backend.machine_epsilon * max_norm(closest)
            is_unfinished |= ~(self._domain.signed_distance(closest) < -slack)
        return vector(closest), type(x.x)(free), is_unfinished

    def _newton(self, p: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Vec3, Real, Mask, Mask]:
        """Run Newton's method for the surface point closest to p, from the point `start` near the
        surface. A closest point that is farther from p than `limit` need not be found.

        Returns five results. The closest point: NaN if the method does not converge, or converges
        to a point that is farther from p than the surface near `start`. The last iterate, from
        which `_descend` can continue. The radius of a ball about the closest point in which no
        surface point is nearer to p. The mask of lanes in which `_descend` has to continue the
        search. The mask of lanes that stopped because their closest point is farther than `limit`
        from p.
        """
        y, first_step, is_lost, is_far = self._descent.newton(p, start, self.backend.Float(limit))
        closest, is_converged, free = self._descent.finish(p, y)
        # The surface near `start` is about first_step away from it; twice that is safe, with
        # rounding.
        bound = (safe_norm(p - start) + 2 * first_step) * (1 + 64 * self.backend.machine_epsilon)
        bound = dr.fma(64 * self.backend.machine_epsilon, max_norm(y), bound)
        # Lanes that stopped at the limit have no result, and need no further search.
        is_lost |= is_far
        is_closest = is_converged & ~is_lost & (safe_norm(p - closest) <= bound)
        return dr.select(is_closest, closest, dr.nan), y, free, ~(is_converged | is_lost), is_far

    def _newton_with_float_masks(
        self, p: Vec3, start: Vec3, limit: Vec3
    ) -> tuple[Vec3, Vec3, Real, Real, Real]:
        """Return the five results of `_newton`, in a form that `in_batches` can pass on: the two
        masks as numbers, 1 for True and 0 for False.

        p, start: the parameters of `_newton`.
        limit: its parameter `limit`, three times as the components of a vector.
        """
        one, zero = self.backend.Float(1), self.backend.Float(0)
        *results, is_unfinished, is_far = self._newton(p, start, limit.x)
        return *results, dr.select(is_unfinished, one, zero), dr.select(is_far, one, zero)

    def _descend(self, p: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        """Descend from `start` to a surface point closest to p. Returns this point, NaN if the
        descent does not end on the level; and the radius of a ball about it in which no surface
        point is nearer to p, 0 if the descent does not converge."""
        y, is_converged, on_level = self._descent.descend(p, start)
        # The radius is the third result of `finish`.
        return dr.select(on_level, y, dr.nan), dr.select(
            is_converged, self._descent.finish(p, y)[2], 0
        )

    def remove_truncation(self, points: FloatArray, closest: FloatArray) -> FloatArray:
        """Move closest points onto the exact level set. The field's function is a sum over many
        terms. The points were found on the level set of an approximation, a treecode with a
        truncation error; the exact function sums all terms one by one.

        points, closest: (n, 3) the queries, and their closest points, NaN for none.

        Returns the closest points (n, 3) on the exact level set, found by Newton's method. Where
        that fails, a point is moved straight to the exact level. A point that would leave the
        domain is not moved.
        """
        rows = np.flatnonzero(np.isfinite(closest[:, 0]))
        exact = self._exact_descent
        if exact is None or not len(rows):
            return closest

        def to_level(start: Vec3) -> tuple[Vec3]:
            y = exact.newton_to_level(start)
            return (dr.select(dr.isfinite(dr.squared_norm(y)), y, start),)

        closest = closest.copy()
        corrected = self._corrected(exact, points[rows], closest[rows])
        failed_rows = np.flatnonzero(np.isnan(corrected[:, 0]))
        if len(failed_rows):
            (corrected[failed_rows],) = in_batches(
                self.backend, to_level, closest[rows[failed_rows]]
            )
        # Points that the correction moved out of the domain keep their place.
        is_inside = ~np.isnan(self.inside_domain_or_nan(corrected)[:, 0])
        closest[rows[is_inside]] = corrected[is_inside]
        return closest

    def _corrected(
        self, exact: ClosestPointDescent, points: FloatArray, closest: FloatArray
    ) -> FloatArray:
        """Return the closest points (n, 3) to `points` (n, 3) on the level set of the exact
        function; NaN where they are not found.

        exact: the descent on the function that sums all terms one by one.
        closest: (n, 3) the closest points on the level set of the approximate function.

        The truncation error of the treecode hardly changes along a descent, and its computation
        takes as long as the whole exact function. So it is computed at the closest point, with its
        gradient; Newton's method then runs on the approximate function plus this linear correction.
        This is done twice, as the first correction moves the closest point. A short step to the
        level of the exact function remains.
        """
        approximate = self._descent

        def truncation(y: Vec3) -> tuple[Vec3, Vec3]:
            """Return the exact function minus the approximate one at y: the difference of the
            values (as a vector of equal components), and that of the gradients."""
            at_exact, at_approximate = (
                exact.evaluator.evaluate(y),
                approximate.evaluator.evaluate(y),
            )
            vector = self.backend.Array3f
            return vector(at_exact.value - at_approximate.value), vector(
                at_exact.gradient
            ) - vector(at_approximate.gradient)

        def newton(p: Vec3, y: Vec3, value: Vec3, gradient: Vec3) -> tuple[Vec3]:
            """Return the closest point to p, as a tuple of one, by Newton's method from y; NaN if
            it does not converge. The level set is that of the approximate function plus the linear
            function that has at y the value value.x and the gradient `gradient`."""
            evaluator = _LinearlyShifted(approximate.evaluator, y, value.x, gradient)
            descent = replace(approximate, evaluator=evaluator)
            end, _, is_lost, _ = descent.newton(p, y, self.backend.Float(dr.inf))
            nearest, is_found, _ = descent.finish(p, end)
            return (dr.select(is_found & ~is_lost, nearest, dr.nan),)

        def on_level(p: Vec3, y: Vec3) -> tuple[Vec3]:
            return (exact.last_step(p, y),)

        closest, rows = closest.copy(), np.arange(len(closest))
        for _ in range(_TRUNCATION_CORRECTIONS):
            if len(rows):
                newton_arguments = (
                    points[rows],
                    closest[rows],
                    *in_batches(self.backend, truncation, closest[rows]),
                )
                (closest[rows],) = in_batches(self.backend, newton, *newton_arguments)
                # Points that were not found are left out of the next correction.
                rows = rows[~np.isnan(closest[rows, 0])]
        if len(rows):
            (closest[rows],) = in_batches(self.backend, on_level, points[rows], closest[rows])
        return closest

    def level_uncertainty(self, points: FloatArray) -> FloatArray:
        """Return bounds (n,), which are lengths, of how far rounding and approximation of f may
        have moved the level set at its `points` (n, 3)."""
        if not len(points):
            return np.zeros(0)

        def compute(y: Vec3) -> tuple[Real]:
            return (self._descent.noise(y),)

        return in_batches(self.backend, compute, points)[0]


class _LinearlyShifted(Evaluator):
    """The sum of a function and of the linear function value + slope . (p - anchor) of the point p.
    Each lane has a linear function of its own.

    The linear function corrects the truncation error that the field has at the anchor, and the
    gradient of that error. So the sum has hardly any truncation error near the anchor. The error
    that the sum states is the rounding error of the field alone.
    """

    def __init__(self, evaluator: Evaluator, anchor: Vec3, value: Real, slope: Vec3) -> None:
        self._evaluator, self._anchor, self._offset, self._slope = evaluator, anchor, value, slope

    def evaluate(self, p: Vec3) -> Sample:
        """Return the sample of the sum at p. The value error of the field's sample is the sum of
        its rounding error and its truncation error. In the result it is the rounding error alone:
        the linear function corrects the truncation error."""
        sample = self._evaluator.evaluate(p)
        shifted = sample.shifted(dr.dot(self._slope, p - self._anchor) + self._offset)
        return replace(
            shifted,
            gradient=sample.gradient + self._slope,
            value_error=sample.value_error - sample.truncation_error,
            truncation_error=0.0,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Return the rows of the Hessian of the field at p. The linear function does not change
        it, since its second derivatives are 0."""
        return self._evaluator.hessian(p)


def _length(vectors: FloatArray) -> FloatArray:
    """Return the lengths (n,) of vectors (n, 3), also where their squares overflow."""
    x, y, z = vectors.T
    return np.hypot(np.hypot(x, y), z)


def _size(surface: TracedSurface, points: FloatArray) -> float:
    """Return the size of a surface, a length: the diagonal of the box that is known to contain it.
    If there is no finite box, it is the largest extent of the query points (n, 3) along an axis, or
    1 if that is less."""
    if surface.volume is not None:
        lower, upper = surface.volume.bounds()
        if np.isfinite([lower, upper]).all():
            return float(np.linalg.norm(upper - lower))
    return max(float(np.ptp(points, axis=0).max()) if len(points) else 0.0, 1.0)
