"""A surface on a backend, and the ways to advance its rays.

Renderers and `trace` call `SurfaceTracer` for first hits, occlusion and clipping, mostly while a
kernel is being recorded. `trace_queued` traces many rays with few lanes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.loops import loop_with_queue
from harnack.fields.capabilities import NO_FACET, NO_PATCH
from harnack.fields.samples import Ray
from harnack.tracer.branch_tracker import BranchTracker
from harnack.tracer.jump_tracer import JumpTracer
from harnack.tracer.level_contact import (
    Contact,
    Hysteresis,
    PreparedHitTolerance,
    RayStatus,
    refine_crossing,
)
from harnack.tracer.march import March, MarchState
from harnack.tracer.patch_tracer import PatchTracer

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import EnclosureKinds, Levels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tree.empty_space import EmptySpaceGrid

__all__ = ["RayTracer", "SmoothTracer", "TracerFactory", "trace_queued"]


class RayTracer(Protocol):
    """Advances rays. Each call of `advance` makes one trial point, one interval, or one patch."""

    def begin(self, state: MarchState) -> Any:
        """Rays at their start."""
        ...

    def advance(self, walk: Any, /) -> Any:
        """The rays after one more trial point, interval or patch."""
        ...

    def finish(self, walk: Any, /) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the facet or patch that each ray hit."""
        ...

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The result of `finish` for rays that were advanced to their end."""
        ...


# A function of rays, their start and their end.
TracerFactory: TypeAlias = "Callable[[Ray, Real, Real], RayTracer]"


@dataclass(frozen=True)
class SmoothTracer:
    """Traces rays through a field without jumps and patches."""

    march: March
    field: Field
    path: Ray
    end: Real

    def begin(self, state: MarchState) -> MarchState:
        """Rays at their start."""
        return state

    def advance(self, walk: MarchState) -> MarchState:
        """Rays after one more trial point."""
        return self.march.next_trial(self.field, self.path, self.end, walk)

    def finish(self, walk: MarchState) -> tuple[MarchState, Any]:
        """The state of rays; no ray hits a facet."""
        return walk, self.march.backend.UInt32(NO_FACET)

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays (`March.advance` has the proof)."""
        return self.finish(self.march.advance(self.field, self.path, self.end, state))


@dataclass(frozen=True)
class _QueuedRay:
    """The whole state of a lane: a ray from `start` to `end`, and the state of its tracer."""

    origin: Vec3
    direction: Vec3
    start: Real
    end: Real
    walk: Any

    @property
    def active(self) -> Mask:
        return self.walk.active


Ends = TypeVar("Ends")


def trace_queued(
    tracer_of: TracerFactory, path: Ray, start: Real, end: Real, state: MarchState,
    collect: Callable[[MarchState, Any], Ends],
) -> Ends:  # fmt: skip
    """Trace many rays with few lanes: a lane that has finished a ray fetches the next.

    Returns `collect(state, index)` for each ray, evaluated. State and index are those that
    `RayTracer.run` returns.

    collect: gives a record of arrays of the end state and the index. Each array is written
        separately, which takes a good part of the time of a step.

    Rays differ in length, and a packet of a processor waits for its longest ray. Bounces of light
    paths go in all directions: there the longest ray of a packet took three to six times as many
    samples as the mean ray (measured).
    """
    proofs: EnclosureKinds = path.proofs

    def tracer(ray: _QueuedRay) -> RayTracer:
        return tracer_of(Ray(ray.origin, ray.direction, proofs), ray.start, ray.end)

    def advance(ray: _QueuedRay) -> _QueuedRay:
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
    """The ends of rays, as Dr.Jit arrays.

    t: ray parameter up to which the ray is proved free of levels; inf for a miss.
    value, gradient: f and its gradient (3,) at t. If a facet was hit, f just before it, and the
        facet's unit normal, to the side of larger f.
    tolerance_excess: by how much f at t may be farther from the level than the tolerance allows.
    evaluations: the number of evaluations of f.
    status: a `RayStatus`.
    facet: index of the facet (see `harnack.fields.capabilities`) that was hit, at t; NO_FACET for
        other rays.
    side: if hits require a crossing, 1 if f rises through the level along the ray, -1 if it falls
        through it; else None. If hits require a crossing, t and gradient are those of the root, and
        `value` is f a little behind it.
    patch: for a union of patches, the index of the patch that was hit, NO_PATCH for other rays; for
        other fields None.
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
        """Mask of the rays that hit a facet."""
        return self.facet != NO_FACET


@dataclass(frozen=True)
class _EndState:
    """The data of a `MarchResult`: attributes of a `MarchState`, and the index of the facet or
    patch."""

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
        """The data of an end state."""
        names = (field.name for field in dataclasses.fields(cls) if field.name != "sheet")
        return cls(**{name: getattr(end, name) for name in names}, sheet=sheet)


@dataclass(frozen=True)
class _EndStatus:
    """The status with which rays ended, and nothing else."""

    status: Any

    @classmethod
    def of(cls, end: MarchState, sheet: Any) -> _EndStatus:
        """The status of an end state."""
        del sheet
        return cls(end.status)


@dataclass(frozen=True)
class SurfaceTracer:
    """A surface on a backend. Its methods can be called while a kernel is being recorded.

    volume: a volume that contains the surface; None for all of space.
    region: where the field may be evaluated, for rays that look for crossings; it contains
        `volume`. None for all of space.
    occupied: cells outside of which there is no level; None if no cells are known.
    only_component: whether only the surface within `occupied` is traced; levels outside may exist
        and do not count.
    section: the volume that cuts the surface open, one of the volumes whose intersection is
        `volume`; None if nothing cuts it open.
    uses_ray_queue: whether rays are traced at once: if a sample is not cheap, by few lanes that
        share a queue. Then the methods cannot be called while a kernel is being recorded.
    known_branch_volume: outside of it f has the branch of f = 0. None if all samples know their
        branch.
    """

    backend: Backend
    field: Field
    levels: Levels
    volume: Volume | None
    proofs: EnclosureKinds
    tolerance: PreparedHitTolerance
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
        """The field at p."""
        return self.field.evaluate(p)

    def sample_with_branch(self, p: Vec3, value: Real) -> Sample:
        """The sample at p, on the branch nearest to `value`. f must differ from `value` by less
        than a half."""
        if self.known_branch_volume is None:
            return self.sample(p)
        sample = self.field.evaluate_modulo_one(p)
        return sample.shifted(dr.round(value - sample.value))

    def hit_surface(self, hit: MarchResult) -> SurfaceTracer:
        """The surface that was hit: for a field with patches the patch, else this surface."""
        if hit.patch is None:
            return self
        patch = dr.select(hit.patch == NO_PATCH, self.backend.UInt32(0), hit.patch)
        return replace(self, field=self.field.patch(patch))

    def level_counts(self, p: Vec3) -> Mask:
        """Whether levels count at points p (see `only_component`)."""
        if self.occupied is None or not self.only_component:
            return self.backend.Bool(True)
        return self.occupied.cell(p).empty_distance == 0

    def is_resolved(self, o: Vec3, end: Real) -> Mask:
        """Whether, everywhere on rays up to `end`, it is known in spite of rounding whether levels
        count there (see `only_component`)."""
        if self.occupied is None or not self.only_component:
            return self.backend.Bool(True)
        return self.occupied.is_resolved(o, end)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The part of [t_min, t_max] that can hold the surface; empty unless start < end."""
        if self.volume is None:
            return t_min, t_max
        return self.volume.clip(o, d, t_min, t_max)

    def occluded(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Mask:
        """Whether rays meet the surface between t_min and t_max. Rays that are out of steps count
        as occluded: a ray that is not proved free must not let light through."""
        end = self._march(o, d, t_min, t_max, active, _EndStatus.of, any_hit=True)
        return end.status != int(RayStatus.MISS)

    def first_hit(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True
    ) -> MarchResult:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        end = self._march(o, d, t_min, t_max, active, _EndState.of)
        facet, t, gradient, excess, side = (
            end.sheet,
            end.proved_to,
            end.gradient,
            end.tolerance_excess,
            None,
        )
        contact, evaluations = end.contact, end.evaluations
        if contact is not None:
            is_hit = end.status == int(RayStatus.HIT)
            root, at_root, samples = self.refined_crossings(o, d, contact, is_hit)
            t = dr.select(is_hit, root, t)
            gradient = dr.select(is_hit, at_root, gradient)
            evaluations = evaluations + samples
            excess, side = dr.select(is_hit, contact.tolerance_excess, 0), contact.side
        t = dr.select(end.status == int(RayStatus.MISS), dr.inf, t)
        patch = None
        if self.field.has_patches:
            facet, patch = self.backend.UInt32(NO_FACET), facet
        return MarchResult(
            t, end.value, gradient, excess, evaluations, end.status, facet, side, patch
        )

    def refined_crossings(
        self, o: Vec3, d: Vec3, contact: Contact, active: Mask
    ) -> tuple[Real, Vec3, Any]:
        """Roots of crossings, the gradients there, and the number of evaluations of f for them. The
        roots of `contact` are kept if f has jumps or no creases."""
        if self.field.has_jumps or not self.field.has_creases:
            return (
                contact.root,
                contact.gradient,
                dr.zeros(self.backend.UInt32, dr.width(contact.root)),
            )
        path = Ray(self.backend.Array3f(o), self.backend.Array3f(d), self.proofs)
        return refine_crossing(self.field, self.levels, self.tolerance, path, contact, active)

    def begin_march(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask, *, crosses: bool
    ) -> tuple[March, Ray, Real, Real, MarchState]:
        """The march, its rays, their start and end (ray parameters), and the state at the start.

        crosses: whether rays end where they have crossed a level, and not where they reach it.
        """
        backend, real = self.backend, self.backend.Float
        path = Ray(backend.Array3f(o), backend.Array3f(d), self.proofs)
        t_min, t_max = real(t_min), dr.select(active, real(t_max), real(t_min))
        start, end = self.clip(path.origin, path.direction, t_min, t_max)
        has_detail = self.field.has_variable_accuracy or self.field.has_jumps
        hysteresis = None
        if crosses:
            start, end, hysteresis = self._crossing_interval(
                path, real(t_min), real(t_max), start, end
            )
        occupied, free_to = None if crosses else self.occupied, start
        if occupied is not None:
            may_hold = backend.Bool(active) & (start < end)
            start, end = dr.select(may_hold, start, 0), dr.select(may_hold, end, 0)
            free_to = occupied.end_of_empty_run(path.origin, path.direction, start, end)
            if not self.field.has_jumps:
                start = free_to
        state = MarchState.at(backend, start, end, active, has_detail=has_detail, crosses=crosses)
        if occupied is not None and self.field.has_jumps and not self.only_component:
            # Facets in empty cells are still compared with the level.
            state = replace(state, proved_step=free_to - start)
        if occupied is not None and self.only_component:
            # Where it is uncertain, by rounding, in which cell a point is, nothing can be proved.
            unclear = state.active & ~self.is_resolved(path.origin, end)
            out = backend.UInt32(int(RayStatus.OUT_OF_STEPS))
            status = dr.select(unclear, out, state.status)
            state = replace(state, active=state.active & ~unclear, status=status)
        tracker = None
        if self.known_branch_volume is not None and not crosses:
            tracker = BranchTracker(self.levels)
            entry, _ = self.known_branch_volume.clip(path.origin, path.direction, t_min, t_max)
            outside = (entry > t_min) & (start <= entry)
            begins = state.active & ~outside
            rounding = backend.machine_epsilon * (max_norm(path.origin) + start)
            value = self.field.value_if_cheap(path.point(start), rounding, begins)
            has_branch = outside | dr.isfinite(value)
            accuracy = dr.select(has_branch, 0, real(self.field.coarsest_accuracy))
            value = dr.select(dr.isfinite(value), value, 0)
            state = replace(state, accuracy_scale=accuracy, value=real(value))
        march = March(
            backend,
            self.levels,
            self.tolerance,
            self.max_steps,
            self.over_relaxation,
            hysteresis,
            occupied=occupied,
            ray_end=end,
            only_component=self.only_component,
            branch_tracker=tracker,
        )
        return march, path, real(start), real(end), state

    def _crossing_interval(
        self, path: Ray, t_min: Real, t_max: Real, start: Real, end: Real
    ) -> tuple[Real, Real, Hysteresis]:
        """The interval of rays to search for crossings, given the one that can hold the surface.

        The surface may touch the ends of the latter, so that within it f is on one side only.
        Beyond it the ray is free. So the interval is made a little longer, as far as the ray goes,
        and for a ray that leaves a flat solid at a small angle longer still.

        Proof that it is enough where f is convex along the ray. Let f be W below the level at some
        point of the extent and pass the level at its end, and e be the error of f there: W >= 8 e
        (`Hysteresis.band`). Behind the end f rises at least as steeply as on the way to it, which
        is no longer than end - start: a seventh of that behind the end it is 8/7 e above the level,
        which a sample there shows.
        """
        never, size = self.backend.Bool(False), max_norm(path.origin)
        rounding = _AT_JUMP_ROUNDINGS * self.backend.machine_epsilon * (size + t_min)
        if self.volume is None:
            return start, end, Hysteresis.of(self.levels, (never, never), start, rounding)
        first, last = t_min, t_max
        if self.region is not None:
            first, last = self.region.clip(path.origin, path.direction, t_min, t_max)
        may_hold = start < end
        length = dr.select(dr.isfinite(start) & dr.isfinite(end), end - start, 0)
        margin = _MARGIN_OF_LENGTH * length
        before = fmax(start - fmax(_MARGIN_OF_SIZE * (size + dr.abs(start)), margin), first)
        after = fmin(end + fmax(_MARGIN_OF_SIZE * (size + dr.abs(end)), margin), last)
        free_before, free_after = before > first, after < last
        start, end = dr.select(may_hold, before, start), dr.select(may_hold, after, end)
        free = may_hold & free_before, may_hold & free_after
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
        """A record of the end state of rays and the index of the facet or patch that each ray hit.

        any_hit: whether any hit will do if it is found with less work than the first.
        """
        march, path, start, end, state = self.begin_march(
            o, d, t_min, t_max, active, crosses=self.require_crossing
        )

        def tracer(path: Ray, start: Real, end: Real) -> RayTracer:
            to_end = replace(march, ray_end=end)
            if self.field.has_jumps:
                return JumpTracer(to_end, self.field, path, start, end)
            if self.field.has_patches:
                return PatchTracer(to_end, self.field, path, start, end, any_hit)
            return SmoothTracer(to_end, self.field, path, end)

        if self.uses_ray_queue and march.hysteresis is None and not self.field.is_cheap:
            return trace_queued(tracer, path, start, end, state, collect)
        return collect(*tracer(path, start, end).run(state))
