"""Many rays by few lanes: one that has followed a ray to its end fetches the next.

Rays differ in length, and a packet of a processor waits for its longest. Bounces of light paths go
in all directions: there the longest ray of a packet took three to six times as many looks as the
mean one (measured).

A level set on a backend: what can be asked of it while a kernel is being recorded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import drjit as dr

from harnack.backend.elementary import fmax, fmin, largest_coordinate
from harnack.backend.loops import while_queued
from harnack.fields.look import Path
from harnack.fields.sheets import NO_PART, NO_SHEET
from harnack.tracer.contact import Contact, Hysteresis, PreparedTolerance, Status, settled
from harnack.tracer.march import March, MarchState
from harnack.tracer.walks import PartTracer, SheetTracer

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Proofs, TargetLevels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tree.cells import UniformGrid

__all__ = ["PlainTracer", "RayTracer", "TracerOf", "trace_queued"]


class RayTracer(Protocol):
    """A walk that advances each ray by one item a turn: a trial point, a sheet, or a part."""

    def begin(self, state: MarchState) -> Any:
        """Rays at their start."""
        ...

    def next(self, walk: Any, /) -> Any:
        """One station more."""
        ...

    def end_of(self, walk: Any, /) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the sheet or part that each hit."""
        ...

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The same, of rays that are followed to their end."""
        ...


# From a path, its start and its end.
TracerOf: TypeAlias = "Callable[[Path, Real, Real], RayTracer]"


@dataclass(frozen=True)
class PlainTracer:
    """Rays through a field that is continuous and has no parts."""

    march: March
    field: Field
    path: Path
    end: Real

    def begin(self, state: MarchState) -> MarchState:
        """Rays at their start."""
        return state

    def next(self, walk: MarchState) -> MarchState:
        """One trial more."""
        return self.march.next_trial(self.field, self.path, self.end, walk)

    def end_of(self, walk: MarchState) -> tuple[MarchState, Any]:
        """The state of rays; none hit a sheet."""
        return walk, self.march.backend.UInt32(NO_SHEET)

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays (`March.advance` has the proof)."""
        return self.end_of(self.march.advance(self.field, self.path, self.end, state))


@dataclass(frozen=True)
class _Ray:
    """A ray from start to end, and where it is: all that a lane knows."""

    origin: Vec3
    direction: Vec3
    start: Real
    end: Real
    walk: Any

    @property
    def active(self) -> Mask:
        return self.walk.active


def trace_queued(
    tracer_of: TracerOf, path: Path, start: Real, end: Real, state: MarchState
) -> tuple[MarchState, Any]:
    """What `RayTracer.run` finds, with a queue: the same numbers, evaluated."""
    proofs: Proofs = path.proofs

    def tracer(ray: _Ray) -> RayTracer:
        return tracer_of(Path(ray.origin, ray.direction, proofs), ray.start, ray.end)

    def one(ray: _Ray) -> _Ray:
        return dataclasses.replace(ray, walk=tracer(ray).next(ray.walk))

    begun = tracer_of(path, start, end).begin(state)
    rays = _Ray(path.origin, path.direction, start, end, begun)
    walk = while_queued(rays, one, lambda ray: ray.walk, "harnack queue")
    return tracer(rays).end_of(walk)


# Rays that look for crossings begin and end outside the proved extent of the surface by this part
# of the size of coordinates, to be seen on one side of it.
_AROUND = 1 / 64
# And by this part of the length between, for rays that leave it at small angles.
_ALONG = 1 / 7
# Rays that start so many roundings off a sheet start on it.
_ON_SHEET = 8.0


@dataclass(frozen=True)
class MarchResult:
    """Ends of rays, as Dr.Jit arrays. t is where the proof of freedom ends (inf for a miss).

    A ray that hits a sheet (see `harnack.fields.sheets`) has its index in `sheet`, NO_SHEET
    elsewhere; its t is that of the crossing, `value` is f just before it, and `gradient` is the
    sheet's unit normal, to the side of larger f. excess: by how much f at t may be farther from
    the level than the tolerance allows.

    Where hits are confirmed, t and gradient are those of the crossing, f at which is the level;
    `value` is f a little behind it, and `side` 1 where f rises through the level along the ray, -1
    where it falls through it. Where they are not, `side` is None.

    part: of a field with parts, the index of the one that was hit, NO_PART elsewhere; else None.
    """

    t: Real
    value: Real
    gradient: Vec3
    excess: Real
    evaluations: Any
    status: Any
    sheet: Any
    side: Real | None = None
    part: Any | None = None

    @property
    def on_sheet(self) -> Mask:
        """Mask of the rays that hit a sheet."""
        return self.sheet != NO_SHEET


@dataclass(frozen=True)
class PreparedLevelSet:
    """A level set on a backend. Its methods can be called while a kernel is being recorded.

    volume: what holds the surface. region: where the field may be looked at, only for rays that
        look for crossings; it is all of space, or larger than `volume`. Both None for all of space.
    occupied: cells outside of which there is no level; None where none are known.
    is_part: whether the levels outside of `occupied` do not count, where there may be some.
    section: of the volume, that by which the surface is opened; None for none.
    queued: whether rays are traced at once, by few lanes that share a queue, so that its methods
        can not be called while a kernel is being recorded.
    """

    backend: Backend
    field: Field
    levels: TargetLevels
    volume: Volume | None
    proofs: Proofs
    tolerance: PreparedTolerance
    max_steps: Any
    overstep: float
    confirm: bool = False
    region: Volume | None = None
    occupied: UniformGrid | None = None
    is_part: bool = False
    section: Volume | None = None
    queued: bool = False

    def sample(self, p: Vec3) -> Sample:
        """The field at p."""
        return self.field.evaluate(p)

    def of_hit(self, hit: MarchResult) -> PreparedLevelSet:
        """The level set that was hit: of a field with parts that of the part, else this."""
        if hit.part is None:
            return self
        part = dr.select(hit.part == NO_PART, self.backend.UInt32(0), hit.part)
        return replace(self, field=self.field.part_at(part))

    def counts(self, p: Vec3) -> Mask:
        """Whether points are where levels count."""
        if self.occupied is None or not self.is_part:
            return self.backend.Bool(True)
        return self.occupied.cell(p).free == 0

    def resolves(self, o: Vec3, end: Real) -> Mask:
        """Whether rounding leaves open nowhere on rays up to `end` whether levels count there."""
        if self.occupied is None or not self.is_part:
            return self.backend.Bool(True)
        return self.occupied.resolves(o, end)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The part of [t_min, t_max] that can hold the surface; empty unless start < end."""
        if self.volume is None:
            return t_min, t_max
        return self.volume.clip(o, d, t_min, t_max)

    def occluded(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Mask:
        """Whether the surface lies between t_min and t_max. Out of steps counts as occluded:
        what is not proved free must not let light through."""
        end, _ = self._march(o, d, t_min, t_max, active, any_hit=True)
        return end.status != int(Status.MISS)

    def first_hit(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True
    ) -> MarchResult:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        end, sheet = self._march(o, d, t_min, t_max, active)
        t, gradient, excess, side = end.proved_to, end.gradient, end.excess, None
        contact, evaluations = end.contact, end.evaluations
        if contact is not None:
            crossed = end.status == int(Status.HIT)
            root, at_root, looks = self.settled(o, d, contact, crossed)
            t = dr.select(crossed, root, t)
            gradient = dr.select(crossed, at_root, gradient)
            evaluations = evaluations + looks
            excess, side = dr.select(crossed, contact.excess, 0), contact.side
        t = dr.select(end.status == int(Status.MISS), dr.inf, t)
        part = None
        if self.field.has_parts:
            sheet, part = self.backend.UInt32(NO_SHEET), sheet
        return MarchResult(
            t, end.value, gradient, excess, evaluations, end.status, sheet, side, part
        )

    def settled(self, o: Vec3, d: Vec3, found: Contact, active: Mask) -> tuple[Real, Vec3, Any]:
        """Roots of crossings, the gradients there, and how often f was looked at for them: as they
        are where f has no creases."""
        if self.field.has_sheets or not self.field.has_creases:
            return found.root, found.gradient, dr.zeros(self.backend.UInt32, dr.width(found.root))
        path = Path(self.backend.Array3f(o), self.backend.Array3f(d), self.proofs)
        return settled(self.field, self.levels, self.tolerance, path, found, active)

    def ready(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask, *, crosses: bool
    ) -> tuple[March, Path, Real, Real, MarchState]:
        """How to march, along which path, from where to where, and the state before it.

        crosses: whether rays end where they have crossed a level, and not where they reach one.
        """
        backend, real = self.backend, self.backend.Float
        path = Path(backend.Array3f(o), backend.Array3f(d), self.proofs)
        t_min, t_max = real(t_min), dr.select(active, real(t_max), real(t_min))
        start, end = self.clip(path.origin, path.direction, t_min, t_max)
        has_detail = self.field.has_detail or self.field.has_sheets
        hysteresis = None
        if crosses:
            start, end, hysteresis = self._around(path, real(t_min), real(t_max), start, end)
        occupied = None if crosses else self.occupied
        if occupied is not None:
            holds = backend.Bool(active) & (start < end)
            start, end = dr.select(holds, start, 0), dr.select(holds, end, 0)
            if not self.field.has_sheets:  # a sheet on the start must be looked at
                start = occupied.free_until(path.origin, path.direction, start, end)
        state = MarchState.at(backend, start, end, active, has_detail=has_detail, crosses=crosses)
        if occupied is not None and self.is_part:
            # Where rounding leaves open in which cell a point is, nothing is said.
            lost = state.active & ~self.resolves(path.origin, end)
            out = backend.UInt32(int(Status.OUT_OF_STEPS))
            status = dr.select(lost, out, state.status)
            state = replace(state, active=state.active & ~lost, status=status)
        march = March(
            backend,
            self.levels,
            self.tolerance,
            self.max_steps,
            self.overstep,
            hysteresis,
            occupied=occupied,
            last=end,
            is_part=self.is_part,
        )
        return march, path, real(start), real(end), state

    def _around(
        self, path: Path, t_min: Real, t_max: Real, start: Real, end: Real
    ) -> tuple[Real, Real, Hysteresis]:
        """The part of rays to look at for crossings, given the part that can hold the surface.

        The surface may touch the ends of the latter, so that on it f is on one side only. Beyond
        it the ray is free. So a little more of the ray is looked at, if there is more of it, and
        behind a ray that leaves a flat solid at a small angle more than that.

        Proof that it is enough where f is convex along the ray. Let f be W below the level in the
        extent and pass it at its end, and e be the error of f there: W >= 8 e (`Hysteresis.band`).
        Then f rises at least as steeply behind as on the way there, no longer than end - start: a
        seventh of that behind the end it is 8/7 e above the level, and is seen there.
        """
        none, size = self.backend.Bool(False), largest_coordinate(path.origin)
        rounding = _ON_SHEET * self.backend.epsilon * (size + t_min)
        if self.volume is None:
            return start, end, Hysteresis.of(self.levels, (none, none), start, rounding)
        first, last = t_min, t_max
        if self.region is not None:
            first, last = self.region.clip(path.origin, path.direction, t_min, t_max)
        holds = start < end
        length = dr.select(dr.isfinite(start) & dr.isfinite(end), end - start, 0)
        around = _ALONG * length
        before = fmax(start - fmax(_AROUND * (size + dr.abs(start)), around), first)
        after = fmin(end + fmax(_AROUND * (size + dr.abs(end)), around), last)
        free_before, free_after = before > first, after < last
        start, end = dr.select(holds, before, start), dr.select(holds, after, end)
        free = holds & free_before, holds & free_after
        return start, end, Hysteresis.of(self.levels, free, start, rounding)

    def _march(
        self,
        o: Vec3,
        d: Vec3,
        t_min: Real,
        t_max: Real,
        active: Mask,
        *,
        any_hit: bool = False,
    ) -> tuple[MarchState, Any]:
        """The end state of rays, and the index of the sheet or the part that each hit.

        any_hit: whether any hit will do, if that is found with less work than the first.
        """
        march, path, start, end, state = self.ready(
            o, d, t_min, t_max, active, crosses=self.confirm
        )

        def tracer(path: Path, start: Real, end: Real) -> RayTracer:
            here = replace(march, last=end)
            if self.field.has_sheets:
                return SheetTracer(here, self.field, path, start, end)
            if self.field.has_parts:
                return PartTracer(here, self.field, path, start, end, any_hit)
            return PlainTracer(here, self.field, path, end)

        if self.queued and march.hysteresis is None:
            return trace_queued(tracer, path, start, end, state)
        return tracer(path, start, end).run(state)
