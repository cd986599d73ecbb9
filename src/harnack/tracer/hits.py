"""The function `trace`, which finds the first hits of rays with a surface, and its result `Hits`.
The surface consists of the points at which a function f, the field, takes one of given values, the
levels. f may jump at facets, flat pieces of surface such as the triangles of a mesh.

NumPy rays give NumPy arrays, Dr.Jit rays give Dr.Jit arrays, and tensors give tensors. On request
the hits also say how near the other rays came to the surface (`ClearanceHits`, `ray_clearance`).

A hit is doubtful where rounding hides the surface: then the distance of the surface is searched for
(`doubtful`). With `backend="webgpu"` another device traces the rays, and its hits are compared with
those of Dr.Jit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NoReturn, cast, overload

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.backend.elementary import fmax, max_norm
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.loops import compute_on_active
from harnack.backend.tensors import array_to_tensor, is_tensor
from harnack.backend.validation import check_no_derivatives, flag
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.tracer.derivatives import (
    NEWTON_STEP,
    attach_derivatives,
    needs_derivatives,
    refuse_derivative,
    value_with_derivative,
)
from harnack.tracer.doubtful import Doubtful, seen_distance
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.ray_clearance import (
    ClearanceSearch,
    attach_clearance_derivative,
    validate_clearance,
)
from harnack.tracer.rays import RayBatch
from harnack.tracer.trace_options import TRACE_OPTIONS, shows_keywords, surface_and_options
from harnack.tracer.traced_surface import TracedSurface

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.tracer.surface import Surface
    from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer
    from harnack.tracer.trace_options import TraceKeywords, TraceOptions
    from harnack.webgpu import Arrays

# The keywords of `trace`.
_HONORED = ("level", "clip", "section", "largest", *TRACE_OPTIONS)
# With at least this many rays it pays to search for empty cells first.
MIN_RAYS_FOR_CELLS = 4096
# Rays are scattered if the directions of successive rays differ by more than the first number, or
# their origins by more than the second number times the spread of all origins (both as roots of
# mean squares), measured on the third number of rays.
_MAX_TURN, _MAX_STRAY, _SAMPLED_RAYS = 0.15, 0.7, 4096
# A hit is doubtful if rounding adds to the first-order distance of the surface more than the first
# number times the tolerance, and more than the second number of roundings of the point. The
# distance is then multiplied by the third number, as where this many sheets of the surface meet. If
# the first-order distance is more than the fourth number times the tolerance, the surface is
# searched for instead, which takes a kernel.
_DOUBT_FRACTION, _DOUBT_ROUNDINGS, _SHEET_COUNT, _SEARCH_TOLERANCES = 0.5, 64, 3, 8


@dataclass(frozen=True)
class Hits:
    """How n rays o + t d ended, as NumPy arrays or, if the rays were Dr.Jit arrays or tensors, as
    these. f is the function of the field, and the surface is where f takes the level.

    is_hit: (n,) mask of rays that hit. Rays that ran out of steps have a finite t as well, so
        `isfinite(t)` is no such mask.
    t: (n,) the ray parameter of the hit, a length; inf for a miss; for a ray that ran out of steps,
        the parameter up to which no surface lies. A hit is within the tolerance of the first root,
        mostly before it. With `require_crossing` a hit is at a root. It lies between two samples
        with f on different sides of the level: at the root of the cubic through their values and
        slopes, or found by bisection if there is a crease between them.
    position: (n, 3) the point at t, NaN for a miss.
    normal: (n, 3) the unit normal grad f/|grad f|, or the normal of the facet that was hit; it
        points to the side of larger f. Zero for rays without a hit. (A facet is a flat piece of
        surface at which f jumps, such as a triangle of a mesh.)
    value: (n,) f at the last accepted point; for an angle-valued field up to a multiple of its
        period. For hits on facets, f just before the facet.
    evaluations: (n,) the number of evaluations of the field.
    status: (n,) a `RayStatus`.
    primitive_index: (n,) the index of the facet (such as a triangle) or of the patch (such as a
        face of a `PolygonMesh`) that was hit; -1 for misses, for hits of a smooth level set, and
        for all rays of fields that have neither facets nor patches.
    uncertainty: (n,) a length that rounding adds to the tolerance: at a hit of a smooth level set,
        |f - level| is proved to be at most (tolerance + uncertainty) |grad f|. It is 0 if the error
        of f is within the tolerance, and for all other rays.

    Tolerance + uncertainty bounds the distance of the surface from a hit to first order. If |grad
    f| may be unbounded, the surface is proved to be within the tolerance, or within the rounding of
    the point (see `HitTolerance`). Exceptions are lines and points at which grad f is 0 and f -
    level behaves as a power u^m of the distance u, for example where m sheets of the surface meet.
    There the surface may be m times as far. Beside the edge of a cusp, such as y^2 = x^3, it may be
    still farther: 0.002 for a tolerance of 1e-4, and 0.02 for y^2 = x^5.

    Rounding hides the surface near such lines and points. If rounding adds more than half the
    tolerance, the uncertainty is computed as for three sheets, m = 3. If it adds seven tolerances
    or more, the surface is searched for around the hit, and the uncertainty is chosen such that at
    points within tolerance + uncertainty of the hit, f is certainly on different sides of the
    level, or touches it up to its error. The uncertainty is infinite if no such points are found
    within a sixteenth of the size of coordinates. (The evaluations of this search are not in
    `evaluations`.) If a ray passes close by such a line or point, t may be too small by more than
    the uncertainty, since no more of the ray is proved free. Use `precision="double"` or
    `require_crossing` there.
    """

    t: Any
    position: Any
    normal: Any
    value: Any
    evaluations: Any
    status: Any
    primitive_index: Any
    uncertainty: Any

    @property
    def is_hit(self) -> Any:
        """(n,) mask of rays that hit."""
        status, hit = self.status, int(RayStatus.HIT)
        if is_tensor(status) and status.shape == (0,):  # not compared with numbers by Dr.Jit
            return dr.zeros(dr.mask_t(type(status)), (0,))
        return status == hit

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            """Raise AttributeError for a name that these hits do not have."""
            remedy = ": call trace(..., clearance=True)" if name in _CLEARANCE_NAMES else ""
            raise AttributeError(f"{type(self).__name__} has no {name!r}{remedy}")


@dataclass(frozen=True)
class ClearanceHits(Hits):
    """How n rays o + t d ended, as `Hits`, and how near those without a hit came to the surface:
    what `trace(..., clearance=True)` returns. f is the function of the field, and e = |f - level| /
    |grad f| at a point is the distance of the surface from it to first order.

    clearance: (n,) the least e that was found along the ray, a length >= 0, for rays that missed or
        ran out of steps; 0 for hits. Of several levels the nearest counts, and levels of an
        angle-valued field are repeated with its period. It is inf for rays that do not meet the
        field's domain, clip and section, which no change of f could make hit, and for rays on which
        grad f is 0 wherever it was sampled.
    nearest_point: (n, 3) the point of the ray at which e was least; the position of the hit for
        hits; NaN where the clearance is inf.

    Proved is no more than the status: that a ray whose status is a miss did not hit. This clearance
    is an estimate, unlike those of points, which are proved. It is the distance of the surface from
    the ray for distance fields. For other smooth fields it is near that distance if this is small
    beside the lengths on which grad f changes; else it may be smaller or larger, and where |grad f|
    has no bound it is no length. It is the least e of the samples that were taken: 17 to 65 along
    the ray (up to 128 on a ray without an end), and some 10 to 30 between the two beside the least
    of these. So it is never below the least e of the ray up to rounding, and may be above it where
    e has another, narrow minimum between samples.

    Rays are sampled where they pass the proved extent of the surface, whether they meet it or not,
    within [t_min, t_max]; a ray that points away from it is sampled at its start. So every ray that
    meets domain, clip and section has a clearance unless grad f is 0, as it is far from blobs.

    The derivative of the clearance by rays, levels and parameters of f is that of the least e,
    including the change of |grad f| (`attach_clearance_derivative` has the formula). It is 0 at
    hits and where the clearance is inf. If e is least on a crease, where the gradient jumps, it is
    that of one side; near creases of fields that are neither formulas nor solids, |grad f| is held
    constant. `nearest_point` has no derivative.
    """

    clearance: Any
    nearest_point: Any


_CLEARANCE_NAMES = "clearance", "nearest_point"


@overload
def trace(
    surface: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    t_min: Any = ...,
    t_max: Any = ...,
    clearance: Literal[True],
    options: TraceOptions | None = ...,
    **keywords: Unpack[TraceKeywords],
) -> ClearanceHits: ...


@overload
def trace(
    surface: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    t_min: Any = ...,
    t_max: Any = ...,
    clearance: bool = ...,
    options: TraceOptions | None = ...,
    **keywords: Unpack[TraceKeywords],
) -> Hits: ...


@accepts_dask_arrays("origins", "directions", "t_min", "t_max")
@shows_keywords(*_HONORED)
def trace(
    surface: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    t_min: Any = 0.0,
    t_max: Any = math.inf,
    clearance: bool = False,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> Hits:
    """Find the first hits of rays with a level set of a field's function f: the points at which f
    takes a given value, the level. No hit is missed: every step is proved.

    surface: a field; or a `Surface`, with its levels, clip, section and largest component. A
        `Surface` with a `side` raises an error: the faces of a solid where its clip cuts it are no
        level set.
    origins, directions: (n, 3) array-likes or Dr.Jit tensors (one of them may be (1, 3)), or Dr.Jit
        3-vectors. Directions need not have length 1; t counts multiples of the *unit* direction, so
        it is a length.
    t_min, t_max: (n,) or a number. With an infinite t_max, a ray that leaves the proved extent of
        the surface is a proved miss.
    clearance: whether to measure how near rays without a hit came to the surface. The result is
        then a `ClearanceHits`. Such a ray takes some 35 evaluations more, which `evaluations` does
        not count; the hits are the same.
    options: a `TraceOptions`.
    keywords: the options of `Surface` beside a bare field, and the options of `TraceOptions` in
        place of `options`: `trace(field, o, d, level=2.0, tolerance=1e-6)`.

    Arrays of float64 are traced in double precision and give such arrays, other arrays in single
    precision, unless `precision` says otherwise. To find further crossings beyond the first hit,
    use `crossings`.

    With Dr.Jit rays, t and position carry derivatives with respect to rays, level, vertices of a
    `SolidAngle`, and numbers of formulas and solids, if these have derivatives enabled (implicit
    differentiation at the hit); and so do normals of formulas and solids, and the `clearance`, by
    which a loss can pull the surface to rays that should hit it. The other results have no
    derivatives: in reverse mode, using their derivatives raises NotImplementedError; in forward
    mode they are NaN. Fields raise an error if other numbers of theirs have derivatives enabled.

    With `backend="webgpu"`, NumPy rays are traced in single precision by the package `wgpu` (`pip
    install harnack[webgpu]`) with a translation of the kernel that Dr.Jit records. Rounding is
    proved for Dr.Jit's own backends only. So at each call up to 4,096 of the rays are traced by
    Dr.Jit, too, and the results of the device must agree.

    On CPUs, if there are at least 4,096 rays and successive rays differ much, rays are traced by
    few lanes that share a queue, unless evaluations of f are cheap (`Traits.is_cheap`). This gives
    the same hits, bit by bit, in about half the time. If only the `largest` component is traced, a
    ray is out of steps if it starts so far away that its coordinates are rounded by more than a
    small part of a cell.

    Raises:
        TypeError, ValueError: shapes that do not match, NaN, directions of length zero, an empty or
            negative interval, a level that no surface has; keywords beside an object that holds
            them; `clearance` with `largest` or a backend.
        RuntimeError: with a backend, there is no device, or the device disagrees.
        NotImplementedError: with a backend, a field whose kernel is not translated; `clearance` of
            fields with facets or patches, or with derivatives enabled on t_min or t_max.
    """
    flag(clearance, "clearance")
    target, choices = surface_and_options("trace", surface, options, keywords, _HONORED)
    traced = TracedSurface.of(target, choices).with_call_cache()
    if clearance:
        validate_clearance(traced, choices)
        check_no_derivatives("a trace with clearance=True", t_min, t_max)
    if choices.backend is not None:
        if any(is_tensor(a) or dr.is_array_v(type(a)) for a in (origins, directions, t_min, t_max)):
            raise TypeError('backend="webgpu" takes rays as NumPy arrays: Dr.Jit\'s have a backend')
        rays = RayBatch.of(origins, directions, t_min, t_max, "single")
        return _trace_on_device(traced, rays) if rays.count else _no_hits(rays)
    rays = RayBatch.of(origins, directions, t_min, t_max, choices.precision)
    if rays.count == 0:
        return _no_hits(rays, measures_clearance=clearance)
    hits = _trace(traced, rays, measures_clearance=clearance)
    if rays.is_numpy:
        return _as_numpy(hits, rays.count)
    return _as_tensors(hits) if rays.is_tensor else hits


def _as_tensors(hits: Hits) -> Hits:
    """Return the hits with all Dr.Jit arrays as tensors."""
    n = dr.width(hits.status)
    return type(hits)(*(array_to_tensor(array, (n,)) for array in vars(hits).values()))


def _trace(surface: TracedSurface, rays: RayBatch, *, measures_clearance: bool) -> Hits:
    """Trace rays, and return their hits as Dr.Jit arrays. The arrays carry derivatives if the rays
    were given as Dr.Jit arrays, and rays, levels or field have derivatives enabled.

    measures_clearance: whether the result is a `ClearanceHits`.
    """
    count = rays.count
    tracer = surface.for_rays(count).tracer(rays.backend, many_rays=count >= MIN_RAYS_FOR_CELLS)
    if not tracer.field.traits.is_cheap and _are_scattered(
        rays.backend, dr.detach(rays.origin), dr.detach(rays.direction)
    ):
        tracer = replace(tracer, uses_ray_queue=True)
    hits, has_derivatives = hits_with_derivatives(tracer, rays)
    if measures_clearance:
        hits = _with_clearance(surface, tracer, rays, hits, has_derivatives=has_derivatives)
    dr.eval(*vars(hits).values())
    return hits


def hits_with_derivatives(
    tracer: SurfaceTracer, rays: RayBatch, *, longest_step: float = NEWTON_STEP
) -> tuple[Hits, bool]:
    """Return the first hits of rays with a surface, as Dr.Jit arrays, and whether they carry
    derivatives: if the rays were given as Dr.Jit arrays, and rays, levels or field have derivatives
    enabled.

    longest_step: by so many tolerances, hits with derivatives may move along the ray in a step of
        Newton's method, to come to the level exactly.
    """
    o, d = rays.origin, rays.direction
    # The trace itself has no derivatives; they are attached to its results.
    with dr.suspend_grad():
        end, hits, doubt = _first_hits(tracer, *(dr.detach(array) for array in rays.arrays))
        if doubt is not None:
            hits = _with_searched_distances(tracer, hits, doubt)
    has_derivatives = not rays.is_numpy and needs_derivatives(tracer, o, d)
    if has_derivatives:
        t, normal = attach_derivatives(tracer, o, d, end, hits.normal, longest_step=longest_step)
        value = value_with_derivative(tracer, o, d, end, hits.value)
        # It has no known derivative, and raises an error if that is used.
        uncertainty = refuse_derivative(tracer, o, d, "uncertainty", hits.uncertainty)
        position = _positions(o, d, t)
        hits = replace(
            hits, t=t, position=position, normal=normal, value=value, uncertainty=uncertainty
        )
    return hits, has_derivatives


def _with_clearance(
    surface: TracedSurface, tracer: SurfaceTracer, rays: RayBatch, hits: Hits, *,
    has_derivatives: bool,
) -> ClearanceHits:  # fmt: skip
    """Return the hits with the clearance of all rays.

    surface, tracer: the surface of the rays.
    has_derivatives: whether derivatives are attached.
    """
    o, d, is_hit = rays.origin, rays.direction, hits.is_hit
    with dr.suspend_grad():
        start, direction, near, far = (dr.detach(array) for array in rays.arrays)
        search = ClearanceSearch.of(surface, tracer)
        nearest = search.nearest(~is_hit, start, direction, near, far)
        clearance = dr.select(is_hit, 0, nearest.clearance)
        point = dr.select(is_hit, dr.detach(hits.position), _positions(start, direction, nearest.t))
    if has_derivatives:
        clearance = attach_clearance_derivative(search, o, d, replace(nearest, clearance=clearance))
        point = refuse_derivative(tracer, o, d, "nearest_point", point)
    return ClearanceHits(**vars(hits), clearance=clearance, nearest_point=point)


def _are_scattered(backend: Backend, o: Vec3, d: Vec3) -> bool:
    """Return whether there are many rays on a CPU and successive rays differ much, unlike the rays
    of a camera. Then tracing with a queue of rays is faster.

    backend: the backend that traces the rays.
    o, d: (3,) origins and unit directions of the rays.

    A CPU traces packets of successive rays together, and most of such rays would wait for the
    longest one. Measured: reflected rays, and chords through curves, clouds and unions of shapes,
    take half the time with a queue; a camera's rays take a fifth more.
    """
    count = dr.width(o, d)
    if count < MIN_RAYS_FOR_CELLS or dr.backend_v(d) != dr.JitBackend.LLVM:
        return False
    # Compare about 4096 rays with their successors. (An opaque step compiles no new kernel if it
    # changes.)
    step = (count - 1) // min(count - 1, _SAMPLED_RAYS)
    indices = dr.arange(backend.UInt32, (count - 1) // step) * dr.opaque(backend.UInt32, step)

    def gather(rays: Vec3, rows: Any) -> FloatArray:
        """Return the vectors (n, 3) of the rays with the indices `rows`. A single vector belongs to
        all rays."""
        index = rows if dr.width(rays) > 1 else 0 * rows
        return to_numpy(dr.gather(backend.Array3f, rays, index)).astype(np.float64)

    with np.errstate(over="ignore", invalid="ignore"):  # in rays that are not finite
        starts, origin_changes = gather(o, indices), gather(o, indices) - gather(o, indices + 1)
        direction_changes = gather(d, indices) - gather(d, indices + 1)
        turns_much = np.square(direction_changes).sum(axis=1).mean() > _MAX_TURN**2
        # The mean square of the distance of two random origins.
        spread = 2 * starts.var(axis=0).sum()
        # `> 0`: rays with a common origin are judged by their directions alone.
        return bool(
            turns_much or np.square(origin_changes).sum(axis=1).mean() > _MAX_STRAY**2 * spread > 0
        )


def _first_hits(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, near: Real, far: Real
) -> tuple[MarchResult, Hits, _DistanceDoubt | None]:
    """Trace rays o + t d from t = near to t = far, without derivatives.

    tracer: the surface.

    Returns three results: the ends of rays as the tracer gives them; the `Hits` made from them; and
    for each hit whether it may be due to rounding alone. The third is None if there can be no such
    hits.
    """
    backend = tracer.backend
    end = tracer.first_hit(o, d, near, far)
    is_hit = end.status == int(RayStatus.HIT)
    length = norm(end.gradient)
    normal = dr.select(is_hit & (length > 0), end.gradient / length, 0)
    # The index of the facet or patch; -1 for none.
    index = dr.full(backend.Int32, -1, dr.width(end.status))
    if tracer.evaluator.jumps is not None:
        index = dr.reinterpret_array(backend.Int32, end.facet)  # NO_FACET becomes -1
    if end.patch is not None:
        index = dr.reinterpret_array(backend.Int32, end.patch)
    is_smooth_hit = is_hit & ~end.at_jump
    # Rounding adds the length excess / |grad f| to the distance of the surface. `length == length`
    # is False where the gradient is NaN, because its length has no bound (`tracer.steep`).
    is_uncertain = is_smooth_hit & (end.tolerance_excess > 0) & (length == length)
    uncertainty = dr.select(is_uncertain, end.tolerance_excess / length, 0)
    doubt = None
    # No other hits are doubtful: with `end.side` rays hit at roots only, and hits of a steep field
    # were tested on the other side of the level.
    if end.side is None and not tracer.evaluator.is_steep:
        doubt = _DistanceDoubt.of(tracer, o, end.t, length, uncertainty)
        # The distance as if several sheets of the surface met there.
        doubtful_uncertainty = _SHEET_COUNT * doubt.distance - doubt.tolerance
        uncertainty = dr.select(doubt.is_doubtful, doubtful_uncertainty, uncertainty)
    position = _positions(o, d, end.t)
    hits = Hits(end.t, position, normal, end.value, end.evaluations, end.status, index, uncertainty)
    return end, hits, doubt


# The distance of the surface from hits that may be due to rounding.


@dataclass(frozen=True)
class _DistanceDoubt:
    """How far the surface may be from hits because rounding hides it, with one entry for each hit.
    A hit is doubtful if rounding adds much to the first-order distance |f - level| / |grad f| of
    the surface: where grad f is nearly 0, this estimate is too short.

    size: a bound of the coordinates on the ray up to the hit.
    tolerance: the tolerance as a length.
    distance: the distance of the surface to first order, including rounding.
    is_doubtful: whether this distance may be much too short.
    """

    size: Real
    tolerance: Real
    distance: Real
    is_doubtful: Mask

    @classmethod
    def of(
        cls, tracer: SurfaceTracer, o: Vec3, t: Real, steepness: Real, uncertainty: Real
    ) -> _DistanceDoubt:
        """Determine which hits are doubtful, and their first-order distances.

        tracer: the surface, with its tolerance.
        o, t: origins (3,) of the rays and ray parameters of the hits.
        steepness: |grad f| at the hits.
        uncertainty: the length that rounding adds to the tolerance, to first order.
        """
        # Rays without a hit have t = inf.
        t = dr.select(dr.isfinite(t), t, 0)
        size = max_norm(o) + t
        tolerance = tracer.tolerance.value_tolerance(steepness, t) / steepness
        limit = fmax(
            _DOUBT_FRACTION * tolerance, _DOUBT_ROUNDINGS * tracer.backend.machine_epsilon * size
        )
        return cls(size, tolerance, tolerance + uncertainty, uncertainty > limit)


@dataclass(frozen=True)
class _SearchedHits:
    """The hits around which the surface is searched for, as a dataclass of arrays for
    `compute_on_active`.

    doubtful: the hits.
    part: the index of the patch that each ray hit. It is used only if the field is a union of
        patches (many level sets, each with a function and a box of its own).
    """

    doubtful: Doubtful
    part: Any


@dataclass(frozen=True)
class _SearchDistance:
    """For each hit, the distance from it within which the surface was found, as a dataclass for
    `compute_on_active`."""

    length: Real


def _with_searched_distances(tracer: SurfaceTracer, hits: Hits, doubt: _DistanceDoubt) -> Hits:
    """Return the hits, with the uncertainty of the most doubtful ones replaced. Around each of
    these the surface is searched for; its new uncertainty is the distance within which the surface
    was found, less the tolerance.

    tracer: the surface.
    doubt: which hits are doubtful, and how far the surface may be from them to first order. Only
        where this distance is more than 8 tolerances is the surface searched for.

    All arrays of the hits are evaluated. If there is no such hit, nothing is searched.
    """
    backend, evaluator = tracer.backend, tracer.evaluator
    is_far = doubt.is_doubtful & (doubt.distance > _SEARCH_TOLERANCES * doubt.tolerance)
    # Whether any hit is to be searched: lanes of `is_far` write a 1. This is computed by the kernel
    # that computes the hits, and needs no other one.
    any_far = dr.zeros(backend.UInt32, 1)
    dr.scatter(any_far, 1, 0, is_far)
    dr.eval(any_far, *vars(hits).values())
    if not any_far[0]:
        return hits

    def search(hit: _SearchedHits) -> _SearchDistance:
        """Return the distance from each hit within which the surface was found."""
        sampled = evaluator
        if evaluator.patches is not None:
            sampled = evaluator.patches.patch(dr.reinterpret_array(backend.UInt32, hit.part))
        return _SearchDistance(seen_distance(backend, sampled, tracer.levels, hit.doubtful))

    doubtful = Doubtful(hits.position, hits.normal, doubt.size, doubt.distance)
    searched = compute_on_active(
        is_far,
        search,
        _SearchedHits(doubtful, hits.primitive_index),
        _SearchDistance(doubt.distance),
    )
    uncertainty = dr.select(is_far, searched.length - doubt.tolerance, hits.uncertainty)
    return replace(hits, uncertainty=uncertainty)


def _positions(o: Vec3, d: Vec3, t: Real) -> Vec3:
    """Return the points o + t d (3,); NaN where t is not finite (no hit)."""
    return dr.select(dr.isfinite(t), dr.fma(type(o)(t), d, o), dr.nan)


# Tracing on other GPUs, by WebGPU.


def _trace_on_device(surface: TracedSurface, rays: RayBatch) -> Hits:
    """Trace rays on another device, by WebGPU, and return the hits as NumPy arrays.

    rays: at least one ray, in single precision.

    Raises RuntimeError if the device's hits of a sample of the rays differ from those of Dr.Jit.
    """
    from harnack.webgpu import evaluate_on_device, find_device  # imported here: few need it

    count = rays.count
    tracer = surface.tracer(rays.backend, many_rays=count >= MIN_RAYS_FOR_CELLS)
    # A device needs every array at full width: single numbers are repeated for each ray.
    lanes = {
        name: array + dr.zeros(type(array), count)
        for name, array in zip(("o", "d", "near", "far"), rays.arrays, strict=True)
    }
    dr.eval(lanes)

    def compute(o: Vec3, d: Vec3, near: Real, far: Real) -> dict[str, Any]:
        """Return the arrays of `Hits` by name, for rays o + t d from t = near to t = far."""
        # Of the three results, [1] is the `Hits`.
        return vars(_first_hits(tracer, o, d, near, far)[1])

    directions = to_numpy(lanes["d"])

    def differences(rows: IntArray, expected: Arrays, computed: Arrays) -> str:
        """Return a message on how the hits that the device computed for some rays differ from the
        expected ones; "" if they agree. rows: the indices of these rays."""
        pair = Hits(**expected), Hits(**computed)
        return _compare_hits(*pair, directions[rows], surface.hit_tolerance)

    arrays = evaluate_on_device(find_device(), compute, lanes, tracer, differences)
    return _as_numpy(Hits(**arrays), count)


# Where the cosine of the angle between a ray and the normal is less than this, a device that rounds
# differently may find the hit anywhere along the surface; elsewhere, within the tolerance.
_GRAZING = 0.1
# Requirements on a device (in brackets: the worst values of a device that computes as it should,
# Mesa's on a CPU, over 110 surfaces). At most this fraction of rays has another status, or hits
# farther off than the tolerance, as at an apex (0);
_MAX_OUTLIERS = 1e-3
# nine in ten hits lie within this fraction of the tolerance (0.03), and their normals differ by no
# more than this (2e-5);
_MAX_OFFSET, _MAX_NORMAL_CHANGE = 0.1, 2e-4
# the numbers of evaluations differ, summed over all rays, by no more than this fraction of their
# sum and one for each ray (0.020).
_MAX_COUNT_CHANGE = 0.03


def _compare_hits(
    expected: Hits, actual: Hits, directions: FloatArray, tolerance: HitTolerance
) -> str:
    """Return a message on how a device's hits of n rays differ from the expected ones by more than
    rounding explains; "" if they do not.

    expected, actual: the hits by Dr.Jit and by the device.
    directions: (n, 3) unit directions of the rays.
    tolerance: the tolerance of hits.

    A ray that runs along the surface within the tolerance may hit it anywhere there, miss it, or
    run out of steps. Such rays may differ. The device must agree in the status of rays, then in the
    places of hits, in the normals, and in the number of evaluations.
    """
    hit, hit_both = expected.is_hit | actual.is_hit, expected.is_hit & actual.is_hit
    normal = cast("FloatArray", np.where(expected.is_hit[:, None], expected.normal, actual.normal))
    cosine = np.abs((normal * directions).sum(axis=1))
    differs = expected.status != actual.status
    # OUT_OF_STEPS is the largest status: at least one of the two is that.
    is_undecided = np.maximum(expected.status, actual.status) == int(RayStatus.OUT_OF_STEPS)
    may_differ = is_undecided | (hit & (cosine < _GRAZING))
    if (differs & ~may_differ).any() or differs.sum() > _MAX_OUTLIERS * len(differs):
        k = int(np.flatnonzero(differs)[0])  # the first of these rays, as an example
        return (
            f"{differs.sum()} of {len(differs)} rays end otherwise, such as ray {k} of the sample: "
            f"{RayStatus(expected.status[k]).name} here, {RayStatus(actual.status[k]).name} there"
        )
    t = expected.t
    allowed = tolerance.distance + tolerance.per_length * np.where(hit_both, t, 0)
    with np.errstate(invalid="ignore"):
        # The distance across the surface between the two hits of a ray.
        offset = np.where(hit_both, np.abs(actual.t - t), 0) * np.maximum(cosine, _GRAZING)
    # t has single precision.
    rounding = 64 * np.finfo(np.float32).eps * np.where(hit_both, 1 + np.abs(t), 1)
    # Each of the two hits may be as far from the surface as is allowed.
    if (offset > 2 * allowed + rounding).mean() > _MAX_OUTLIERS:
        return (
            f"hits lie up to {offset.max():.2g} off the surface, and {allowed.max():.2g} is asked"
        )
    # Nine in ten hits must be nearer to each other than that.
    if (
        hit_both.any()
        and np.quantile((offset - rounding)[hit_both] / allowed[hit_both], 0.9) > _MAX_OFFSET
    ):
        return "hits lie elsewhere, if within the tolerance"
    # So must the normals of nine in ten of the hits at which rays are not grazing.
    normal_changes = np.linalg.norm(actual.normal - expected.normal, axis=1)[
        hit_both & (cosine >= _GRAZING)
    ]
    if normal_changes.size and np.quantile(normal_changes, 0.9) > _MAX_NORMAL_CHANGE:
        return "normals differ"
    counts, actual_counts = (result.evaluations.astype(np.float64) for result in (expected, actual))
    # (2 more, so that a few rays may differ, too.)
    if np.abs(actual_counts - counts).sum() > _MAX_COUNT_CHANGE * (counts + 1).sum() + 2:
        return "rays take another number of evaluations"
    return ""


def _no_hits(rays: RayBatch, *, measures_clearance: bool = False) -> Hits:
    """Return the `Hits` of no rays, as the kind of arrays that the rays have; `ClearanceHits` with
    `measures_clearance`."""
    backend = rays.backend
    number, vector = dr.zeros(backend.Float, 0), dr.zeros(backend.Array3f, 0)
    count = dr.zeros(backend.UInt32, 0)
    index = dr.zeros(backend.Int32, 0)
    # In the order of the attributes: t, position, normal, value, evaluations, status, ...
    arrays = number, vector, vector, number, count, count, index, number
    hits = ClearanceHits(*arrays, number, vector) if measures_clearance else Hits(*arrays)
    if rays.is_numpy:
        return _as_numpy(hits, 0)
    return _as_tensors(hits) if rays.is_tensor else hits


# The integers among the attributes of `Hits`.
_INTEGERS = "evaluations", "status", "primitive_index"


def _as_numpy(hits: Hits, n: int) -> Hits:
    """Return the hits of n rays as NumPy arrays."""

    def flat(name: str, array: Any) -> Any:
        """Return an array as a NumPy array with n rows; a single row is repeated."""
        values: Any = to_numpy(array) if dr.is_array_v(type(array)) else array
        rows = np.broadcast_to(values, (n, *values.shape[1:])).copy()
        return rows.astype(np.int64) if name in _INTEGERS else rows

    return type(hits)(**{name: flat(name, array) for name, array in vars(hits).items()})
