"""`SurfaceTracer`: a surface on a backend, with methods that trace rays to it. The surface
consists of the points at which a function f (a field) takes one of given values, the levels. f may
jump at facets, flat pieces of surface such as the triangles of a mesh; or the field may be a union
of patches, many level sets in boxes of their own.

Renderers and `trace` call it for first hits, for occlusion and to clip rays, mostly while Dr.Jit
records a kernel. `trace_queued` traces many rays with few lanes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.loops import loop_with_queue
from harnack.enclosures.samples import Ray
from harnack.fields.capabilities import NO_FACET, NO_PATCH
from harnack.fields.formula_evaluator import without_alternatives
from harnack.tracer.level_contact import (
    Contact,
    DeviceHitTolerance,
    Hysteresis,
    RayStatus,
    refine_crossing,
)
from harnack.tracer.level_rule import PlainLevels
from harnack.tracer.march import March, MarchState

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import EnclosureKinds, Levels
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tracer.level_rule import LevelRule
    from harnack.tree.empty_space import EmptySpaceGrid

__all__ = ["RayTracer", "SmoothTracer", "TracerFactory", "trace_queued"]


class RayTracer(Protocol):
    """Interface to the ways to trace rays: through smooth functions, functions with jumps at
    facets, and unions of patches. Each has a state of its own, `walk`; it is made from a
    `MarchState`, and becomes one at the end. One call of `advance` makes one trial point, or
    marches one interval between jumps, or one patch."""

    def begin(self, state: MarchState) -> Any:
        """Return this tracer's own state for rays that have not moved yet. state: their
        `MarchState`."""
        ...

    def advance(self, walk: Any, /) -> Any:
        """Return the state after one more trial point, interval or patch of each active ray."""
        ...

    def finish(self, walk: Any, /) -> tuple[MarchState, Any]:
        """Return how rays ended: a `MarchState`, and the index of the facet or patch that each ray
        hit.

        walk: this tracer's own state when no ray is active any more.
        """
        ...

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """Advance rays until all have ended, and return the result of `finish`: the end state, and
        the index of the facet or patch that each ray hit. state: the `MarchState` of rays that have
        not moved yet."""
        ...


# A function of rays, their start and their end.
TracerFactory: TypeAlias = "Callable[[Ray, Real, Real], RayTracer]"


@dataclass(frozen=True)
class SmoothTracer:
    """Traces rays to a level set of a continuous function. Its own state is the common `MarchState`
    itself.

    march: the parameters of the march.
    evaluator: samples the function.
    path, end: the rays, and the ray parameter at which each ends.
    """

    march: March
    evaluator: Evaluator
    path: Ray
    end: Real

    def begin(self, state: MarchState) -> MarchState:
        """Return the state of rays that have not moved yet, unchanged."""
        return state

    def advance(self, walk: MarchState) -> MarchState:
        """Return the state after one more trial point of each ray."""
        return self.march.next_trial(self.evaluator, self.path, self.end, walk)

    def finish(self, walk: MarchState) -> tuple[MarchState, Any]:
        """Return the end state of rays, and NO_FACET, as a smooth function has no facets to hit."""
        return walk, self.march.backend.UInt32(NO_FACET)

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """March rays from `state` to a hit or to their end. Returns their end state, and NO_FACET.
        `March.advance` has the proof that no hit is missed."""
        return self.finish(self.march.advance(self.evaluator, self.path, self.end, state))


@dataclass(frozen=True)
class _QueuedRay:
    """A ray o + t d as it waits in the queue: its parameters from `start` to `end`, and the state
    `walk` of its tracer. This is all that a lane needs when it takes the ray from the queue."""

    origin: Vec3
    direction: Vec3
    start: Real
    end: Real
    walk: Any

    @property
    def active(self) -> Mask:
        """Whether the ray goes on."""
        return self.walk.active


Ends = TypeVar("Ends")


def trace_queued(
    tracer_of: TracerFactory, path: Ray, start: Real, end: Real, state: MarchState,
    collect: Callable[[MarchState, Any], Ends],
) -> Ends:  # fmt: skip
    """Trace many rays with few lanes: a lane that has finished a ray takes the next one from a
    queue.

    Returns `collect(state, index)` for each ray, evaluated. Here state and index are what
    `RayTracer.run` returns: the end of the ray, and the index of the facet or patch that it hit.

    tracer_of: makes a tracer from rays, their start and their end.
    path, start, end: the rays, and the ray parameters between which each is traced.
    state: the `MarchState` of rays that have not moved yet.
    collect: makes a dataclass of arrays from the end state and the index. Each of its arrays is
        written to memory separately, which takes a good part of the time of a step; so it should
        hold only what is needed.

    Rays need different numbers of steps, and a packet of a processor waits for its longest ray. For
    light paths that were reflected in all directions, the longest ray of a packet took three to six
    times as many samples as the mean ray (measured). With the queue no lane waits.
    """
    proofs: EnclosureKinds = path.proofs

    def tracer(ray: _QueuedRay) -> RayTracer:
        """Return the tracer of the rays `ray` that are in the lanes now."""
        return tracer_of(Ray(ray.origin, ray.direction, proofs), ray.start, ray.end)

    def advance(ray: _QueuedRay) -> _QueuedRay:
        """Return the rays in the lanes after one more step."""
        return dataclasses.replace(ray, walk=tracer(ray).advance(ray.walk))

    begin = tracer_of(path, start, end).begin(state)
    rays = _QueuedRay(path.origin, path.direction, start, end, begin)
    return loop_with_queue(
        rays, advance, lambda ray: collect(*tracer(ray).finish(ray.walk)), "harnack queue"
    )


# Rays that look for crossings begin before the proved extent of the surface and end behind it, so
# that f is sampled on one side of the level there: by this fraction of the size of coordinates,
_MARGIN_OF_SIZE = 1 / 64
# or by this fraction of the length within the extent, for rays that leave it at small angles.
_MARGIN_OF_LENGTH = 1 / 7
# A ray that starts within this many roundings of a facet counts as starting on it.
_AT_JUMP_ROUNDINGS = 8.0


@dataclass(frozen=True)
class MarchResult:
    """How rays ended, as Dr.Jit arrays with one entry for each ray. f is the function whose level
    is the surface.

    t: the ray parameter of the hit; inf for a miss. For a ray that ran out of steps, the parameter
        up to which no level lies on it.
    value, gradient: f and its gradient (3,) at t. At a hit on a facet, f just before the facet, and
        the facet's unit normal, which points to the side of larger f.
    tolerance_excess: by how much |f - level| at t may exceed what the tolerance allows, because of
        rounding.
    evaluations: the number of evaluations of f.
    status: a `RayStatus`.
    facet: the index of the facet (a flat piece of surface at which f jumps) that was hit; NO_FACET
        for other rays.
    side: if hits require a crossing, 1 if f rises through the level along the ray and -1 if it
        falls; otherwise None. If hits require a crossing, t and gradient are those of the root, and
        `value` is f a little beyond it.
    patch: for a union of patches, the index of the patch that was hit, NO_PATCH for rays without a
        hit; None for other fields.
    """

    t: Real
    value: Real
    gradient: Vec3
    tolerance_excess: Real
    evaluations: Any
    status: Any
    facet: Any
    side: Real | None = None
    patch: Any | None = None

    @property
    def at_jump(self) -> Mask:
        """Mask of the rays that hit a facet, a flat piece of surface at which f jumps."""
        return self.facet != NO_FACET


@dataclass(frozen=True)
class _EndState:
    """What `SurfaceTracer.first_hit` needs to know of how rays ended: some attributes of a
    `MarchState`, and as `sheet` the index of the facet or patch that was hit. If rays are traced
    from a queue, each attribute is written to memory; so there are no others."""

    proved_to: Real
    value: Real
    gradient: Vec3
    tolerance_excess: Real
    evaluations: Any
    status: Any
    contact: Contact | None
    sheet: Any

    @classmethod
    def of(cls, end: MarchState, sheet: Any) -> _EndState:
        """Take these attributes from `end`, the end state of rays. sheet: the index of the facet or
        patch that was hit."""
        names = (field.name for field in dataclasses.fields(cls) if field.name != "sheet")
        return cls(**{name: getattr(end, name) for name in names}, sheet=sheet)


@dataclass(frozen=True)
class _EndStatus:
    """What `SurfaceTracer.occluded` needs to know of how rays ended: their `RayStatus` alone."""

    status: Any

    @classmethod
    def of(cls, end: MarchState, sheet: Any) -> _EndStatus:
        """Take the status from `end`, the end state of rays; `sheet`, the index of the facet or
        patch that was hit, is not used."""
        del sheet
        return cls(end.status)


@dataclass(frozen=True)
class SurfaceTracer:
    """A surface on a backend, with methods that trace rays o + t d to it. The surface
    consists of the points of `volume` at which f, the function of `field`, takes one of the
    `levels`. The methods can be called while Dr.Jit records a kernel, except with `uses_ray_queue`.

    evaluator: the evaluator of the field, which samples f on the backend.
    levels: the values of f that belong to the surface.
    volume: a volume that contains the surface; None for all of space.
    proofs: the classes of enclosures by which steps are proved. An enclosure is an interval that is
        proved to contain the change of f along a ray.
    tolerance: how near to the surface a hit must be.
    max_steps: the number of evaluations of f after which a ray is out of steps.
    over_relaxation: trial steps are at most this many times as long as proved steps.
    require_crossing: whether a ray hits only where f passes to the other side of a level.
    region: the volume in which f may be evaluated, for rays that look for crossings; it contains
        `volume`. None for all of space.
    occupied: a grid of cells, in which those that may contain a level are marked; None if there is
        none.
    only_component: whether only levels in the marked cells of `occupied` belong to the surface.
        Otherwise there are no levels outside of these cells.
    section: the volume that cuts the surface open, one of the volumes whose intersection is
        `volume`; None if nothing cuts it open.
    uses_ray_queue: whether rays are traced at once when a method is called, by few lanes that share
        a queue of rays (unless samples are cheap). Then no kernel may be being recorded.
    known_branch_volume: for a function whose samples may lack an unknown integer (give f only
        modulo 1), a volume outside of which the integer is known. There no level, and no number
        that differs from a level by an integer, lies between f and 0. None for other functions.
    """

    backend: Backend
    field: Field
    evaluator: Evaluator
    levels: Levels
    volume: Volume | None
    proofs: EnclosureKinds
    tolerance: DeviceHitTolerance
    max_steps: Any
    over_relaxation: float
    require_crossing: bool = False
    region: Volume | None = None
    occupied: EmptySpaceGrid | None = None
    only_component: bool = False
    section: Volume | None = None
    uses_ray_queue: bool = False
    known_branch_volume: Volume | None = None

    def sample(self, p: Vec3) -> Sample:
        """Return the sample of f (value, gradient, error bounds) at points p (3,)."""
        return self.evaluator.evaluate(p)

    def sample_where(self, p: Vec3, active: Mask) -> Sample:
        """Return the sample of f at points p (3,) on active lanes, and anything on others. It is
        without the alternative promises of formulas."""
        with without_alternatives():
            return self.evaluator.evaluate_where(p, active)

    def sample_with_branch(self, p: Vec3, value: Real) -> Sample:
        """Return the sample of f at p, with the integer added that is unknown if samples give f
        only modulo 1.

        value: an approximation of f at p with an error below a half. The integer is chosen for
            which f is nearest to it.
        """
        if self.known_branch_volume is None or self.evaluator.modulo_one is None:
            return self.sample(p)
        sample = self.evaluator.modulo_one.evaluate(p)
        return sample.shifted(dr.round(value - sample.value))

    def hit_surface(self, hit: MarchResult) -> SurfaceTracer:
        """Return the surface that each ray hit: the patch that was hit if the field is a union of
        patches, else this surface. Rays without a hit get the first patch."""
        if hit.patch is None or self.evaluator.patches is None:
            return self
        patch = dr.select(hit.patch == NO_PATCH, self.backend.UInt32(0), hit.patch)
        return replace(self, evaluator=self.evaluator.patches.patch(patch))

    def level_counts(self, p: Vec3) -> Mask:
        """Return the mask of the points p at which a level, if f takes one there, belongs to the
        surface. If only the largest component is traced, these are the points in its cells; else
        all points."""
        if self.occupied is None or not self.only_component:
            return self.backend.Bool(True)
        return self.occupied.cell(p).empty_distance == 0

    def is_resolved(self, o: Vec3, end: Real) -> Mask:
        """Return the mask of rays on which rounding leaves no doubt in which cell of the grid a
        point lies. Only tracing the largest component alone needs that; else all rays are in the
        mask.

        o: (3,) origins. end: the ray parameters up to which this is asked.
        """
        if self.occupied is None or not self.only_component:
            return self.backend.Bool(True)
        return self.occupied.is_resolved(o, end)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """Return the interval (start, end) of ray parameters, within [t_min, t_max], on which rays
        o + t d can meet the surface: the part in `volume`. It is empty unless start < end."""
        if self.volume is None:
            return t_min, t_max
        return self.volume.clip(o, d, t_min, t_max)

    def occluded(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Mask:
        """Return the mask of rays o + t d that meet the surface for t between t_min and t_max. A
        ray that is out of steps counts as meeting it, as light must not pass where nothing is
        proved.

        active: mask of rays that are traced; others count as not meeting it.
        """
        end = self._march(o, d, t_min, t_max, active, _EndStatus.of, any_hit=True)
        return end.status != int(RayStatus.MISS)

    def first_hit(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True
    ) -> MarchResult:
        """Return the first hits of rays o + t d, |d| = 1, t_min <= t <= t_max, as a `MarchResult`.

        active: mask of rays that are traced; others miss.
        """
        end = self._march(o, d, t_min, t_max, active, _EndState.of)
        facet, t, gradient, excess, side = (
            end.sheet,
            end.proved_to,
            end.gradient,
            end.tolerance_excess,
            None,
        )
        contact, evaluations = end.contact, end.evaluations
        # If hits require a crossing, t is its root.
        if contact is not None:
            is_hit = end.status == int(RayStatus.HIT)
            root, gradient_at_root, extra_evaluations = self.refined_crossings(
                o, d, contact, is_hit
            )
            t = dr.select(is_hit, root, t)
            gradient = dr.select(is_hit, gradient_at_root, gradient)
            evaluations = evaluations + extra_evaluations
            excess, side = dr.select(is_hit, contact.tolerance_excess, 0), contact.side
        t = dr.select(end.status == int(RayStatus.MISS), dr.inf, t)
        patch = None
        if self.evaluator.patches is not None:  # the index is that of a patch, and no facet was hit
            facet, patch = self.backend.UInt32(NO_FACET), facet
        return MarchResult(
            t, end.value, gradient, excess, evaluations, end.status, facet, side, patch
        )

    def refined_crossings(
        self, o: Vec3, d: Vec3, contact: Contact, active: Mask
    ) -> tuple[Real, Vec3, Any]:
        """Return the roots (ray parameters) at which rays cross the level, the gradients of f
        there, and the number of evaluations of f that this took.

        contact: the crossings, each with a first approximation of the root. This is returned
            unchanged if f has jumps, or if it has no creases, as then it is good enough.
        active: mask of rays with a crossing.
        """
        if self.evaluator.jumps is not None or not self.field.traits.has_creases:
            return (
                contact.root,
                contact.gradient,
                dr.zeros(self.backend.UInt32, dr.width(contact.root)),
            )
        path = Ray(self.backend.Array3f(o), self.backend.Array3f(d), self.proofs)
        return refine_crossing(self.evaluator, self.levels, self.tolerance, path, contact, active)

    def begin_march(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask, *, crosses: bool
    ) -> tuple[March, Ray, Real, Real, MarchState]:
        """Prepare the march of rays o + t d: clip them to the surface's volume, and skip cells
        without a level at their start.

        Returns the march, the rays, the ray parameters of their start and end, and their state
        before the first sample.

        t_min, t_max: the ray parameters between which each ray is traced.
        active: mask of rays that are traced.
        crosses: whether rays end only where f has passed to the other side of a level, and not
            where they reach the level.

        If only the largest component is traced, a ray on which rounding leaves it uncertain in
        which cell a point lies ends at once, as out of steps.
        """
        backend, real = self.backend, self.backend.Float
        path = Ray(backend.Array3f(o), backend.Array3f(d), self.proofs)
        # Rays that are not active get an empty interval.
        t_min, t_max = real(t_min), dr.select(active, real(t_max), real(t_min))
        start, end = self.clip(path.origin, path.direction, t_min, t_max)
        has_jumps = self.evaluator.jumps is not None
        # The functions that continue f beyond its jumps may have samples of several accuracies.
        has_detail = self.evaluator.variable_accuracy is not None or has_jumps
        hysteresis = None
        if crosses:
            start, end, hysteresis = self._crossing_interval(
                path, real(t_min), real(t_max), start, end
            )
        # Up to empty_until the ray lies in cells that contain no level. If the field has no jumps,
        # the ray starts there.
        occupied, empty_until = None if crosses else self.occupied, start
        if occupied is not None:
            # Empty intervals become [0, 0]: their ends may be infinite.
            is_nonempty = backend.Bool(active) & (start < end)
            start, end = dr.select(is_nonempty, start, 0), dr.select(is_nonempty, end, 0)
            empty_until = occupied.end_of_empty_run(path.origin, path.direction, start, end)
            if not has_jumps:
                start = empty_until
        state = MarchState.at(backend, start, end, active, has_detail=has_detail, crosses=crosses)
        if occupied is not None and has_jumps and not self.only_component:
            # Facets in empty cells have to be compared with the level. So the ray starts before
            # them, and its first proved step leads to empty_until.
            state = replace(state, proved_step=empty_until - start)
        if occupied is not None and self.only_component:
            # If rounding leaves it uncertain in which cell a point lies, nothing can be proved.
            in_uncertain_cell = state.active & ~self.is_resolved(path.origin, end)
            out_of_steps = backend.UInt32(int(RayStatus.OUT_OF_STEPS))
            status = dr.select(in_uncertain_cell, out_of_steps, state.status)
            state = replace(state, active=state.active & ~in_uncertain_cell, status=status)
        rule: LevelRule = PlainLevels(self.levels)
        samples, known = self.evaluator.modulo_one, self.known_branch_volume
        if samples is not None and known is not None and not crosses:
            from harnack.tracer.branch_tracker import BranchTracker  # imported where it is needed

            rule = tracker = BranchTracker(self.levels)
            state = tracker.begin(samples, known, path, (t_min, t_max), state)
        march = March(
            backend,
            rule,
            self.tolerance,
            self.max_steps,
            self.over_relaxation,
            hysteresis,
            occupied=occupied,
            ray_end=end,
            only_component=self.only_component,
        )
        return march, path, real(start), real(end), state

    def _crossing_interval(
        self, path: Ray, t_min: Real, t_max: Real, start: Real, end: Real
    ) -> tuple[Real, Real, Hysteresis]:
        """Return the interval (start, end) of ray parameters on which rays look for crossings, and
        the `Hysteresis` (the rule by which a crossing is counted).

        t_min, t_max: the ends of the ray.
        start, end: the ends of the part of the ray in `volume`, the proved extent of the surface.

        The surface may touch the ends of this part, and then f does not change sign within it.
        Outside the part the ray meets no surface. So the part is made a little longer at both ends,
        and longer still for a ray that leaves a flat solid at a small angle. But it stays within
        the ray and within `region`, the larger volume in which f may be evaluated. If no extent is
        proved (`volume` is None), the interval stays as it is.

        Proof that this suffices if f is convex along the ray. Suppose that f is W below the level
        at some point of the extent, and reaches the level at the end of the extent. Let e be the
        error of f there, and W >= 8 e, the least depth at which crossings are guaranteed
        (`Hysteresis.band`). Beyond the end, f rises at least as steeply as on average before it,
        and the way from that point to the end is at most end - start. So (end - start)/7 beyond the
        end, f is at least W/7 >= 8/7 e above the level, which a sample there shows.
        """
        never, size = self.backend.Bool(False), max_norm(path.origin)
        # A bound of the rounding of the point o + t_min d, whose coordinates are at most
        # size + t_min. A ray whose start is no farther than that from a facet (at which f jumps)
        # counts as starting on it.
        rounding = _AT_JUMP_ROUNDINGS * self.backend.machine_epsilon * (size + t_min)
        if self.volume is None:
            # Nothing is known of levels before the interval and after it.
            return start, end, Hysteresis.of(self.levels, (never, never), start, rounding)
        lowest_start, highest_end = t_min, t_max
        if self.region is not None:
            lowest_start, highest_end = self.region.clip(path.origin, path.direction, t_min, t_max)
        is_nonempty = start < end
        length = dr.select(dr.isfinite(start) & dr.isfinite(end), end - start, 0)
        margin = _MARGIN_OF_LENGTH * length
        before = fmax(start - fmax(_MARGIN_OF_SIZE * (size + dr.abs(start)), margin), lowest_start)
        after = fmin(end + fmax(_MARGIN_OF_SIZE * (size + dr.abs(end)), margin), highest_end)
        # free_before, free_after: whether it is proved that the ray meets no level beyond this end
        # of the interval. An end that could only be moved to the end of the ray, or of `region`,
        # leaves that unknown.
        free_before, free_after = before > lowest_start, after < highest_end
        start, end = dr.select(is_nonempty, before, start), dr.select(is_nonempty, after, end)
        free = is_nonempty & free_before, is_nonempty & free_after
        return start, end, Hysteresis.of(self.levels, free, start, rounding)

    def _march(
        self,
        o: Vec3,
        d: Vec3,
        t_min: Real,
        t_max: Real,
        active: Mask,
        collect: Callable[[MarchState, Any], Ends],
        *,
        any_hit: bool = False,
    ) -> Ends:
        """Trace rays o + t d, t_min <= t <= t_max, and return `collect(end state, index)`. The end
        state is a `MarchState`, and the index is that of the facet or patch that each ray hit.

        active: mask of rays that are traced.
        collect: makes a dataclass of arrays from the end state and the index.
        any_hit: whether a ray may end at any hit, if that takes less work than finding the first
            hit.

        With a queue of rays, rays are traced at once; but not if they look for crossings or if
        evaluations of the field are cheap.
        """
        march, path, start, end, state = self.begin_march(
            o, d, t_min, t_max, active, crosses=self.require_crossing
        )

        def tracer(path: Ray, start: Real, end: Real) -> RayTracer:
            """Return the tracer for this kind of field: smooth, with jumps, or a union of patches.

            path, start, end: the rays, and the ray parameters between which they are traced.
            """
            to_end = replace(march, ray_end=end)
            if self.evaluator.jumps is not None:
                from harnack.tracer.jump_tracer import JumpTracer  # imported where it is needed

                return JumpTracer(to_end, self.evaluator.jumps, path, start, end)
            if self.evaluator.patches is not None:
                from harnack.tracer.patch_tracer import PatchTracer  # imported where it is needed

                return PatchTracer(to_end, self.evaluator.patches, path, start, end, any_hit)
            return SmoothTracer(to_end, self.evaluator, path, end)

        if self.uses_ray_queue and march.hysteresis is None and not self.field.traits.is_cheap:
            return trace_queued(tracer, path, start, end, state, collect)
        return collect(*tracer(path, start, end).run(state))
