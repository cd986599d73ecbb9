"""A level set uploaded to a backend, and the ways in which its rays are advanced.

`PreparedLevelSet` is what renderers and `trace` call: first hits, occlusion and clipping, most of
it while a kernel is being recorded. `trace_queued` traces many rays by few lanes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import drjit as dr

from harnack.backend.elementary import fmax, fmin, largest_coordinate
from harnack.backend.loops import while_queued
from harnack.fields.capabilities import NO_PART, NO_SHEET
from harnack.fields.samples import Path
from harnack.tracer.branch_tracker import WholeNumbers
from harnack.tracer.level_contact import Contact, Hysteresis, PreparedTolerance, Status, settled
from harnack.tracer.march import March, MarchState
from harnack.tracer.walks import PartTracer, SheetTracer

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Proofs, TargetLevels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tree.empty_space import UniformGrid

__all__ = ["PlainTracer", "RayTracer", "TracerOf", "trace_queued"]


class RayTracer(Protocol):
    """Advances rays, each call of `next` by one item: a trial point, a sheet, or a part."""

    def begin(self, state: MarchState) -> Any:
        """Rays at their start."""
        ...

    def next(self, walk: Any, /) -> Any:
        """Rays one item further."""
        ...

    def end_of(self, walk: Any, /) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the sheet or part that each hit."""
        ...

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """What `end_of` returns for rays followed to their end."""
        ...


# From a path, its start and its end.
TracerOf: TypeAlias = "Callable[[Path, Real, Real], RayTracer]"


@dataclass(frozen=True)
class PlainTracer:
    """Rays through a field that has neither sheets nor parts."""

    march: March
    field: Field
    path: Path
    end: Real

    def begin(self, state: MarchState) -> MarchState:
        """Rays at their start."""
        return state

    def next(self, walk: MarchState) -> MarchState:
        """Rays after one more trial point."""
        return self.march.next_trial(self.field, self.path, self.end, walk)

    def end_of(self, walk: MarchState) -> tuple[MarchState, Any]:
        """The state of rays; none hit a sheet."""
        return walk, self.march.backend.UInt32(NO_SHEET)

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays (`March.advance` has the proof)."""
        return self.end_of(self.march.advance(self.field, self.path, self.end, state))


@dataclass(frozen=True)
class _Ray:
    """A ray from start to end, and how far it has got: all the state of a lane."""

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
    tracer_of: TracerOf, path: Path, start: Real, end: Real, state: MarchState,
    wanted: Callable[[MarchState, Any], Ends],
) -> Ends:  # fmt: skip
    """What is wanted of what `RayTracer.run` finds, evaluated, by few lanes: one that has followed
    a ray to its end fetches the next.

    wanted: a record of some arrays of the end state and the index. Each is written by itself, which
        takes a good part of the time of a step.

    Rays differ in length, and a packet of a processor waits for its longest. Bounces of light paths
    go in all directions: there the longest ray of a packet took three to six times as many samples
    as the mean one (measured).
    """
    proofs: Proofs = path.proofs

    def tracer(ray: _Ray) -> RayTracer:
        return tracer_of(Path(ray.origin, ray.direction, proofs), ray.start, ray.end)

    def one(ray: _Ray) -> _Ray:
        return dataclasses.replace(ray, walk=tracer(ray).next(ray.walk))

    begun = tracer_of(path, start, end).begin(state)
    rays = _Ray(path.origin, path.direction, start, end, begun)
    return while_queued(
        rays, one, lambda ray: wanted(*tracer(ray).end_of(ray.walk)), "harnack queue"
    )


# Rays that look for crossings begin before the proved extent of the surface and end behind it, so
# that f is sampled on one side of the level there: by this fraction of the size of coordinates,
_AROUND = 1 / 64
# or by this fraction of the length within the extent, for rays that leave it at small angles.
_ALONG = 1 / 7
# A ray that starts no farther than so many roundings from a sheet counts as starting on it.
_ON_SHEET = 8.0


@dataclass(frozen=True)
class MarchResult:
    """Ends of rays, as Dr.Jit arrays.

    t: up to where the ray is proved free of levels; inf for a miss.
    value, gradient: f at t. Where a sheet was hit, f just before it, and the sheet's unit normal,
        to the side of larger f.
    excess: by how much f at t may be farther from the level than the tolerance allows.
    sheet: index of the sheet (see `harnack.fields.capabilities`) that was hit, at t; NO_SHEET
        elsewhere.
    side: where hits are confirmed, 1 where f rises through the level along the ray, -1 where it
        falls through it; else None. Then t and gradient are those of the root, and `value` is f a
        little behind it.
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
class _Ends:
    """What `MarchResult` is made of: some of a `MarchState`, and the index of the sheet or part."""

    proved_to: Real
    value: Real
    gradient: Vec3
    excess: Real
    evaluations: Any
    status: Any
    contact: Contact | None
    sheet: Any

    @classmethod
    def of(cls, end: MarchState, sheet: Any) -> _Ends:
        """Those of an end state."""
        names = (field.name for field in dataclasses.fields(cls) if field.name != "sheet")
        return cls(**{name: getattr(end, name) for name in names}, sheet=sheet)


@dataclass(frozen=True)
class _Status:
    """How rays ended, alone."""

    status: Any

    @classmethod
    def of(cls, end: MarchState, sheet: Any) -> _Status:
        """That of an end state."""
        del sheet
        return cls(end.status)


@dataclass(frozen=True)
class PreparedLevelSet:
    """A level set on a backend. Its methods can be called while a kernel is being recorded.

    volume: a volume that contains the surface; None for all of space.
    region: where the field may be evaluated, for rays that look for crossings; it contains
        `volume`. None for all of space.
    occupied: cells outside of which there is no level; None where none are known.
    is_part: whether only the surface within `occupied` is traced: there may be levels outside,
        which do not count.
    section: the volume, one of those that `volume` is the intersection of, that cuts the surface
        open; None for none.
    queued: whether rays are traced at once, and where a sample is not cheap by few lanes that share
        a queue. Then its methods cannot be called while a kernel is being recorded.
    around: for a field whose coarse samples know f but for a whole number, the volume outside of
        which that number is the one of f = 0; None for no such samples.
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
    around: Volume | None = None

    def sample(self, p: Vec3) -> Sample:
        """The field at p."""
        return self.field.evaluate(p)

    def sample_near(self, p: Vec3, value: Real) -> Sample:
        """The field at p, where f is known to differ from a value by less than a half."""
        if self.around is None:
            return self.sample(p)
        sample = self.field.evaluate_modulo_one(p)
        return sample.shifted(dr.round(value - sample.value))

    def of_hit(self, hit: MarchResult) -> PreparedLevelSet:
        """The level set that was hit: for a field with parts that of the part, else this one."""
        if hit.part is None:
            return self
        part = dr.select(hit.part == NO_PART, self.backend.UInt32(0), hit.part)
        return replace(self, field=self.field.part_at(part))

    def counts(self, p: Vec3) -> Mask:
        """Whether levels count at points p (see `is_part`)."""
        if self.occupied is None or not self.is_part:
            return self.backend.Bool(True)
        return self.occupied.cell(p).free == 0

    def resolves(self, o: Vec3, end: Real) -> Mask:
        """Whether rounding leaves no doubt, anywhere on rays up to `end`, if levels count there."""
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
        end = self._march(o, d, t_min, t_max, active, _Status.of, any_hit=True)
        return end.status != int(Status.MISS)

    def first_hit(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True
    ) -> MarchResult:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        end = self._march(o, d, t_min, t_max, active, _Ends.of)
        sheet, t, gradient, excess, side = end.sheet, end.proved_to, end.gradient, end.excess, None
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
        """Roots of crossings, the gradients there, and how many evaluations of f that took. Those
        that were found are kept where f has no creases."""
        if self.field.has_sheets or not self.field.has_creases:
            return found.root, found.gradient, dr.zeros(self.backend.UInt32, dr.width(found.root))
        path = Path(self.backend.Array3f(o), self.backend.Array3f(d), self.proofs)
        return settled(self.field, self.levels, self.tolerance, path, found, active)

    def ready(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask, *, crosses: bool
    ) -> tuple[March, Path, Real, Real, MarchState]:
        """The march, its path, where that starts and ends, and the state at the start.

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
        occupied, free_to = None if crosses else self.occupied, start
        if occupied is not None:
            holds = backend.Bool(active) & (start < end)
            start, end = dr.select(holds, start, 0), dr.select(holds, end, 0)
            free_to = occupied.free_until(path.origin, path.direction, start, end)
            if not self.field.has_sheets:
                start = free_to
        state = MarchState.at(backend, start, end, active, has_detail=has_detail, crosses=crosses)
        if occupied is not None and self.field.has_sheets and not self.is_part:
            # Sheets in empty cells are still compared with the level.
            state = replace(state, proved_step=free_to - start)
        if occupied is not None and self.is_part:
            # Where rounding leaves it open in which cell a point is, nothing can be proved.
            lost = state.active & ~self.resolves(path.origin, end)
            out = backend.UInt32(int(Status.OUT_OF_STEPS))
            status = dr.select(lost, out, state.status)
            state = replace(state, active=state.active & ~lost, status=status)
        whole_numbers = None
        if self.around is not None and not crosses:
            whole_numbers = WholeNumbers(self.levels)
            entry, _ = self.around.clip(path.origin, path.direction, t_min, t_max)
            outside = (entry > t_min) & (start <= entry)
            begins = state.active & ~outside
            rounding = backend.epsilon * (largest_coordinate(path.origin) + start)
            value = self.field.value_where_known(path.point(start), rounding, begins)
            knows = outside | dr.isfinite(value)
            detail = dr.select(knows, 0, real(self.field.coarsest_detail))
            value = dr.select(dr.isfinite(value), value, 0)
            state = replace(state, detail=detail, value=real(value))
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
            whole_numbers=whole_numbers,
        )
        return march, path, real(start), real(end), state

    def _around(
        self, path: Path, t_min: Real, t_max: Real, start: Real, end: Real
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
        wanted: Callable[[MarchState, Any], Ends],
        *,
        any_hit: bool = False,
    ) -> Ends:
        """What is wanted of the end state of rays and the index of the sheet or part that each hit.

        any_hit: whether any hit will do if it is found with less work than the first.
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

        if self.queued and march.hysteresis is None and not self.field.is_cheap:
            return trace_queued(tracer, path, start, end, state, wanted)
        return wanted(*tracer(path, start, end).run(state))
