"""The function `crossings`, which finds all points at which rays cross a surface, and its result
`RayCrossings`. The surface consists of the points at which a function f, the field, takes one of
given values, the levels. A crossing is a point of a ray at which f passes to the other side of a
level. f may also jump past a level at a facet, a flat piece of surface such as a triangle of a
mesh.

`find_crossings` finds the crossings of each ray one after another while a kernel is recorded.
`RayCrossings` is the result for users: NumPy arrays for NumPy rays, Dr.Jit arrays for Dr.Jit rays.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.backend.arrays import gather_vectors
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.loops import loop_while_active
from harnack.backend.tensors import array_to_tensor
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.fields.capabilities import NO_FACET
from harnack.tracer.derivatives import attach_derivatives, needs_derivatives, refuse_derivative
from harnack.tracer.jump_tracer import JumpTracer, JumpTraceState
from harnack.tracer.level_contact import Contact, RayStatus
from harnack.tracer.rays import RayBatch
from harnack.tracer.surface_tracer import MarchResult
from harnack.tracer.trace_options import shows_keywords, surface_and_options
from harnack.tracer.traced_surface import TracedSurface

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.tracer.march import MarchState
    from harnack.tracer.surface import Surface
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.trace_options import TraceKeywords, TraceOptions

# The keywords of `crossings`.
_HONORED = (
    "level", "clip", "section", "tolerance", "enclosures", "max_steps", "over_relaxation",
    "precision",
)  # fmt: skip


@dataclass(frozen=True)
class CrossingArrays:
    """The first k crossings of n rays with a surface, as Dr.Jit arrays. A crossing is a point at
    which a function f passes to the other side of a level. Crossing j of ray i is at i k + j in
    arrays of n k entries.

    t: (n k) ray parameters; inf if a ray has fewer crossings.
    gradient: (n k, 3) the gradient of f at the crossing, or the normal of the facet; 0 for no
        crossing. A facet is a flat piece of surface at which f jumps.
    sheet: (n k) the index of the facet that was crossed, NO_FACET for none.
    side: (n k) 1 if f rises through the level along the ray, -1 if it falls, 0 for no crossing.
    count: (n) the number of crossings, at most k.
    end: (n) the ray parameter up to which the ray was followed; inf if it was followed to its end.
    evaluations: (n) the number of evaluations of f.
    status: (n) a `RayStatus`: MISS if the ray has no further crossings, HIT if it has k,
        OUT_OF_STEPS if the ray beyond `end` is not known.
    """

    t: Real
    gradient: Vec3
    sheet: Any
    side: Real
    count: Any
    end: Real
    evaluations: Any
    status: Any


@dataclass(frozen=True)
class _SearchState:
    """The state of rays that look for crossings with a surface, and the number of crossings that
    each has found.

    march: the state of the march, which steps along rays with proofs; None for a field with jumps.
    sheets: for a field with jumps, the state of `JumpTracer`, which includes the state of the
        march; else None.
    count: the number of crossings so far.
    """

    march: MarchState | None
    sheets: JumpTraceState | None
    count: Any

    @property
    def active(self) -> Mask:
        """Mask of the rays that go on."""
        return self.now.active

    @property
    def now(self) -> MarchState:
        """The state of the march, for fields with and without jumps."""
        state = self.march if self.sheets is None else self.sheets.march
        assert state is not None
        return state

    def with_march(self, now: MarchState, count: Any) -> _SearchState:
        """Return this state with another state `now` of the march and another number `count` of
        crossings."""
        if self.sheets is None:
            return _SearchState(now, None, count)
        return _SearchState(None, dataclasses.replace(self.sheets, march=now), count)


def find_crossings(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, t_min: Real, t_max: Real, k: int
) -> CrossingArrays:
    """Find the first k crossings of rays o + t d, |d| = 1, for t_min <= t <= t_max, with the
    surface of `tracer`.

    `Hysteresis`, the rule by which a crossing is counted, states the guarantees and proves them. A
    ray is marched from one crossing to the next without a new start: what is known of f at a
    crossing is used after it, and the ray may reach and leave levels any number of times.
    """
    backend = tracer.backend
    real, vector, count = backend.Float, backend.Array3f, backend.UInt32
    # (True: all rays are active.)
    march, path, start, end, state = tracer.begin_march(o, d, t_min, t_max, True, crosses=True)
    n = max(dr.width(array) for array in (path.origin, path.direction, start, end))
    # Crossing j of ray i is at i k + j.
    first_slot = dr.arange(count, n) * k
    # The loop scatters into these arrays, so they must lie in memory before it is recorded.
    # `before` and `behind` are the ray parameters of the two samples around a crossing.
    t, side = dr.full(real, dr.inf, n * k), dr.zeros(real, n * k)
    before, behind = dr.zeros(real, n * k), dr.zeros(real, n * k)
    gradient, facets = dr.zeros(vector, n * k), dr.full(count, NO_FACET, n * k)
    dr.make_opaque(t, side, before, behind, gradient, facets)
    jumps = tracer.evaluator.jumps
    jump_tracer = None if jumps is None else JumpTracer(march, jumps, path, start, end)

    def advance(now: _SearchState) -> _SearchState:
        """Bring each active ray to its next crossing, to the next jump of f, or to its end. Returns
        the state after it. A crossing is written to the arrays outside, in the next free place of
        its ray."""
        next_state, facet = now, None
        if jump_tracer is None or now.sheets is None:
            after = march.advance(tracer.evaluator, path, end, now.now)
        else:
            # The tracer's own state includes that of the march.
            walk = jump_tracer.advance(now.sheets)
            next_state = _SearchState(None, walk, now.count)
            after, facet = jump_tracer.finish(walk)
        contact = after.contact
        assert contact is not None
        is_at_crossing = now.active & (after.status == int(RayStatus.HIT))
        # If the surface consists of facets only, other crossings do not count.
        is_crossing = is_at_crossing
        if facet is not None and jumps is not None and jumps.takes_all_levels:
            is_crossing = is_at_crossing & (facet != NO_FACET)
        # The place of the next crossing of each ray in the arrays of results.
        slot = first_slot + now.count
        dr.scatter(t, contact.root, slot, is_crossing)
        dr.scatter(side, contact.side, slot, is_crossing)
        dr.scatter(before, contact.before, slot, is_crossing)
        dr.scatter(behind, contact.after, slot, is_crossing)
        dr.scatter(gradient, contact.gradient, slot, is_crossing)
        if facet is not None:
            dr.scatter(facets, facet, slot, is_crossing)
        crossings = now.count + dr.select(is_crossing, count(1), 0)
        # A ray with fewer than k crossings goes on, unless its rest is already proved to hold no
        # level.
        goes_on = is_at_crossing & (crossings < k)
        # MISS stands for a ray without a hit so far.
        status = dr.select(goes_on, count(int(RayStatus.MISS)), after.status)
        if now.sheets is None:
            undecided = after.proved_to + after.proved_step < end
            if march.hysteresis is not None:
                undecided |= march.hysteresis.must_sample_end(contact, end) & (
                    after.proved_to < end
                )
            goes_on &= undecided
        else:
            # The tracer keeps rays active that have passed a facet without a crossing.
            goes_on |= after.active
        return next_state.with_march(
            dataclasses.replace(after, status=status, active=goes_on), crossings
        )

    begin = _SearchState(state, None, dr.zeros(count, n))
    if jump_tracer is not None:
        begin = _SearchState(None, jump_tracer.begin(state), dr.zeros(count, n))
    walk = loop_while_active(begin, advance, "harnack crossings")
    final = walk.now
    ray_indices, zero = dr.arange(count, n * k) // k, real(0)
    # The crossings as a `Contact`, for `refined_crossings`. It does not use the attributes that are
    # False and zero here.
    roots = Contact(side, backend.Bool(False), t, gradient, zero, before, behind, zero)
    # Each crossing gets the ray to which it belongs, and is refined.
    origins, directions = (
        gather_vectors(backend, o, ray_indices),
        gather_vectors(backend, d, ray_indices),
    )
    t, gradient, extra_evaluations = tracer.refined_crossings(
        origins, directions, roots, dr.isfinite(t)
    )
    evaluations = final.evaluations + dr.block_reduce(dr.ReduceOp.Add, extra_evaluations, k)
    traced_to = dr.select(final.status == int(RayStatus.MISS), dr.inf, final.proved_to)
    return CrossingArrays(
        t, gradient, facets, side, walk.count, traced_to, evaluations, final.status
    )


@dataclass(frozen=True)
class RayCrossings:
    """The first k crossings of n rays with a level set of a function f, in the order along each
    ray. A crossing is a point at which f passes to the other side of the level.

    They are NumPy arrays; tensors if the rays were tensors; Dr.Jit arrays if the rays were Dr.Jit
    arrays. The latter are flat: crossing j of ray i is at i k + j.

    t: (n, k) the ray parameter of the crossing, inf if a ray has fewer crossings. It lies between
        two samples with f on different sides of the level: at the root of the cubic through their
        values and slopes, or found by bisection if there is a crease between them.
    position: (n, k, 3) the point at t, NaN for no crossing.
    normal: (n, k, 3) the unit normal grad f/|grad f|, which points to the side of larger f; zero
        for no crossing.
    primitive_index: (n, k) the index of the facet that was crossed, a flat piece of surface at
        which f jumps, such as a triangle; -1 if no facet was crossed.
    side: (n, k) integers: 1 if f rises through the level along the ray, -1 if it falls through it,
        0 for no crossing.
    count: (n,) the number of crossings, at most k.
    traced_to: (n,) the ray parameter up to which the ray was followed: inf if it was followed to
        its end; else the point just beyond the last crossing at which this crossing was noticed, or
        the point at which the ray ran out of steps.
    status: (n,) a `RayStatus`. MISS: the ray is proved to have no other crossings. HIT: there are k
        crossings, and the rest of the ray was not examined. OUT_OF_STEPS: the ray beyond
        `traced_to` is not known.
    evaluations: (n,) the number of evaluations of the field.
    """

    t: Any
    position: Any
    normal: Any
    primitive_index: Any
    side: Any
    count: Any
    traced_to: Any
    status: Any
    evaluations: Any


@accepts_dask_arrays("origins", "directions", "t_min", "t_max")
@shows_keywords(*_HONORED)
def crossings(
    surface: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    max_crossings: int,
    t_min: Any = 0.0,
    t_max: Any = math.inf,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> RayCrossings:
    """Find the first crossings of rays with a level set of a field's function f, in the order along
    each ray. A crossing is a point at which f passes to the other side of the level.

    If f goes farther than the tolerance to both sides of the level, the crossing is not missed, and
    no crossing is counted twice. If a ray touches a level without passing to its other side, or
    starts on it, that is no crossing. The tolerance in value is that of `TraceOptions` times |grad
    f|. If levels differ by less than four such tolerances, a quarter of their difference takes the
    place of the tolerance; rays run out of steps if that is below rounding. Otherwise the tolerance
    is at least eight times the rounding error of f, in single precision about 1e-5 of the size of
    the coordinates: if f goes less far than that to one side, the crossing may not count.

    surface, origins, directions, t_min, t_max, options, keywords: the surface, the rays and the
        options, as `trace` takes them. The options `side`, `largest`, `require_crossing` and
        `backend` do not exist here. `max_steps` is for the whole ray.
    max_crossings: the number of crossings of each ray to return, at least 1.

    With Dr.Jit rays, t and position carry derivatives with respect to rays, level, and vertices of
    a `SolidAngle`, if these have derivatives enabled.

    Raises:
        TypeError, ValueError: wrong rays, levels or options, which `trace` lists; also several
            levels of a field with jumps.
        NotImplementedError: a union of patches, which has a function for each patch.
    """
    target, choices = surface_and_options("crossings", surface, options, keywords, _HONORED)
    traced = TracedSurface.of(target, choices).with_call_cache()
    k = _check_count(max_crossings)
    traced.validate_crossings("crossings")
    rays = RayBatch.of(origins, directions, t_min, t_max, choices.precision)
    result = empty_crossings(rays.backend)
    if rays.count:
        result = trace_crossings(traced, rays, k, differentiable=not rays.is_numpy)
    if rays.is_numpy:
        return crossings_to_numpy(result, rays.count, k)
    if not rays.is_tensor:
        return result
    n = dr.width(result.status)
    of_rays = {"count", "traced_to", "status", "evaluations"}
    return RayCrossings(
        **{
            name: array_to_tensor(array, (n,) if name in of_rays else (n, k))
            for name, array in vars(result).items()
        }
    )


def _check_count(max_crossings: Any) -> int:
    """Return `max_crossings` as an int of at least 1. Raises TypeError or ValueError otherwise."""
    try:
        k = operator.index(max_crossings)
    except TypeError:
        raise TypeError(
            "max_crossings is how many crossings of a ray to look for, an integer such as 8, "
            f"not {max_crossings!r}"
        ) from None
    if k < 1 or isinstance(max_crossings, bool):
        raise ValueError(f"max_crossings must be at least 1, such as 8, not {max_crossings}")
    return k


def trace_crossings(
    surface: TracedSurface, rays: RayBatch, k: int, *, differentiable: bool
) -> RayCrossings:
    """Find the first k crossings of each ray, and return them as a `RayCrossings` of Dr.Jit arrays.

    differentiable: whether t and positions are to carry derivatives, if rays, levels or field have
        derivatives enabled.
    """
    backend, o, d = rays.backend, rays.origin, rays.direction
    tracer = surface.tracer(backend, crosses=True)
    with dr.suspend_grad():
        detached_o, detached_d, near, far = (dr.detach(array) for array in rays.arrays)
        arrays = find_crossings(tracer, detached_o, detached_d, near, far, k)
        is_found = dr.isfinite(arrays.t)
        length = norm(arrays.gradient)
        normal = dr.select(length > 0, arrays.gradient / length, 0)
        dr.eval(*vars(arrays).values(), normal)
    ray = dr.arange(backend.UInt32, dr.width(arrays.t)) // k
    o, d = gather_vectors(backend, o, ray), gather_vectors(backend, d, ray)
    t, end = arrays.t, arrays.end
    if differentiable and needs_derivatives(tracer, o, d):
        with dr.suspend_grad():
            # The crossings as if each were the end of a ray of its own. The attributes that are
            # zero (`value`, `tolerance_excess` and `evaluations`) are not used.
            status = dr.select(is_found, backend.UInt32(int(RayStatus.HIT)), int(RayStatus.MISS))
            zero = dr.zeros(backend.Float, dr.width(t))
            ends = MarchResult(
                t, zero, arrays.gradient, zero, zero, status, arrays.sheet, arrays.side
            )
        t, normal = attach_derivatives(tracer, o, d, ends, normal)
        end = refuse_derivative(tracer, o, d, "traced_to", end)
    position = dr.select(dr.isfinite(t), dr.fma(backend.Array3f(t), d, o), dr.nan)
    side = backend.Int32(arrays.side)
    index = dr.reinterpret_array(backend.Int32, arrays.sheet)  # NO_FACET becomes -1
    ray_results = arrays.count, end, arrays.status, arrays.evaluations
    hits = RayCrossings(t, position, normal, index, side, *ray_results)
    dr.eval(*vars(hits).values())
    return hits


def empty_crossings(backend: Backend) -> RayCrossings:
    """Return the `RayCrossings` of no rays, as Dr.Jit arrays."""
    number, vector = dr.zeros(backend.Float, 0), dr.zeros(backend.Array3f, 0)
    count, side = dr.zeros(backend.UInt32, 0), dr.zeros(backend.Int32, 0)
    return RayCrossings(number, vector, vector, side, side, count, number, count, count)


def crossings_to_numpy(hits: RayCrossings, n: int, k: int) -> RayCrossings:
    """Return the crossings `hits` of n rays, k for each, as NumPy arrays (n, k, ...) and (n,)."""

    def each(array: Any) -> Any:
        """Return an array of crossings as a NumPy array (n, k, ...)."""
        values = to_numpy(array)
        return values.reshape(n, k, *values.shape[1:])

    def of_ray(array: Any) -> Any:
        """Return an array with one entry for each ray as a NumPy array (n,); a single entry is
        repeated."""
        return np.broadcast_to(to_numpy(array), (n,)).copy()

    return RayCrossings(
        each(hits.t),
        each(hits.position),
        each(hits.normal),
        each(hits.primitive_index).astype(np.int64),
        each(hits.side).astype(np.int64),
        of_ray(hits.count).astype(np.int64),
        of_ray(hits.traced_to),
        of_ray(hits.status).astype(np.int64),
        of_ray(hits.evaluations).astype(np.int64),
    )
