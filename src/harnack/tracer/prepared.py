"""A level set on a backend: what can be asked of it while a kernel is being recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.fields.look import Path
from harnack.fields.sheets import NO_SHEET
from harnack.tracer.march import March, MarchState
from harnack.tracer.stretches import SheetTracer
from harnack.tracer.tolerance import PreparedTolerance, Status

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Proofs, TargetLevels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume


@dataclass(frozen=True)
class MarchResult:
    """Ends of rays, as Dr.Jit arrays. t is where the proof of freedom ends (inf for a miss).

    A ray that hits a sheet (see `harnack.fields.sheets`) has its index in `sheet`, NO_SHEET
    elsewhere; its t is that of the crossing, `value` is f just before it, and `gradient` is the
    sheet's unit normal, to the side of larger f. excess: by how much f at t may be farther from
    the level than the tolerance allows.
    """

    t: Real
    value: Real
    gradient: Vec3
    excess: Real
    evaluations: Any
    status: Any
    sheet: Any

    @property
    def on_sheet(self) -> Mask:
        """Mask of the rays that hit a sheet."""
        return self.sheet != NO_SHEET


@dataclass(frozen=True)
class PreparedLevelSet:
    """A level set on a backend. Its methods can be called while a kernel is being recorded."""

    backend: Backend
    field: Field
    levels: TargetLevels
    volume: Volume | None
    proofs: Proofs
    tolerance: PreparedTolerance
    max_steps: int
    overstep: float

    def sample(self, p: Vec3) -> Sample:
        """The field at p."""
        return self.field.evaluate(p)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The part of [t_min, t_max] that can hold the surface; empty unless start < end."""
        if self.volume is None:
            return t_min, t_max
        return self.volume.clip(o, d, t_min, t_max)

    def occluded(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Mask:
        """Whether the surface lies between t_min and t_max. Out of steps counts as occluded:
        what is not proved free must not let light through."""
        return self._march(o, d, t_min, t_max, active)[0].status != int(Status.MISS)

    def first_hit(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True
    ) -> MarchResult:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        end, sheet = self._march(o, d, t_min, t_max, active)
        t = dr.select(end.status == int(Status.MISS), dr.inf, end.base)
        return MarchResult(
            t, end.value, end.gradient, end.excess, end.evaluations, end.status, sheet
        )

    def _march(
        self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask
    ) -> tuple[MarchState, Any]:
        """The end state of rays, and the index of the sheet that each hit."""
        backend, real = self.backend, self.backend.Float
        path = Path(backend.Array3f(o), backend.Array3f(d), self.proofs)
        start, end = self.clip(path.origin, path.direction, real(t_min), real(t_max))
        has_detail = self.field.has_detail or self.field.has_sheets
        state = MarchState.at(backend, start, end, active, has_detail=has_detail)
        march = March(backend, self.levels, self.tolerance, self.max_steps, self.overstep)
        if self.field.has_sheets:
            return SheetTracer(march, self.field, path, real(start), real(end)).run(state)
        return march.advance(self.field, path, end, state), backend.UInt32(NO_SHEET)
