"""Rays through surfaces that are made of many level sets, each in a box: the first hit of all.

Each part is marched as any field is. What is added here is which part comes next, and how far it
need be followed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.backend.loops import while_active
from harnack.fields.sheets import NO_PART, PartEntry
from harnack.tracer.march import March, MarchState
from harnack.tracer.tolerance import Status

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.fields.look import Path


@dataclass(frozen=True)
class PartWalk:
    """Where rays are among parts, and the nearest end of a march so far.

    enter, box: of the box entered last. t: of the first hit, or the end of the ray; or to where a
    ray out of steps is free. value, gradient, excess, status: of the march that ended there.
    part: that of the hit, NO_PART for none. active: whether there may be more parts.
    """

    enter: Real
    box: Any
    t: Real
    value: Real
    gradient: Vec3
    excess: Real
    evaluations: Any
    status: Any
    part: Any
    active: Mask


@dataclass(frozen=True)
class PartTracer:
    """Rays through a field with parts, from `start` to `end`, and how to march one part.

    any_hit: whether any hit will do, and not the first alone.
    """

    march: March
    field: Field
    path: Path
    start: Real
    end: Real
    any_hit: bool = False

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays, and the index of the part that each hit (NO_PART: none).

        Proof that no hit is missed: a part's level set lies in its box, and boxes come in the order
        in which the ray enters them, all that it meets. Each is marched from where the ray enters
        it to where it leaves it, or to the first hit so far if that comes before; so up to a hit
        the ray is free of every part whose box it entered before the hit, and all others come
        behind. A ray that is out of steps in a part is proved free up to where it entered that.
        """
        walk = while_active(self.begin(state), self.next, "harnack parts")
        return self.end_of(walk)

    def begin(self, state: MarchState) -> PartWalk:
        """Rays before the first box."""
        real, count = self.march.backend.Float, self.march.backend.UInt32
        return PartWalk(
            enter=real(-1),
            box=count(NO_PART),
            t=real(self.end),
            value=state.value,
            gradient=state.gradient,
            excess=state.excess,
            evaluations=state.evaluations,
            status=state.status,
            part=count(NO_PART),
            active=state.active,
        )

    def end_of(self, walk: PartWalk) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the part that each hit, NO_PART for none."""
        backend = self.march.backend
        before = MarchState.at(backend, self.start, self.end, walk.active, has_detail=False)
        end = dataclasses.replace(
            before,
            proved_to=walk.t,
            value=walk.value,
            gradient=walk.gradient,
            excess=walk.excess,
            evaluations=walk.evaluations,
            status=walk.status,
            active=walk.active,
        )
        return end, walk.part

    def next(self, walk: PartWalk) -> PartWalk:
        """One part more: the next whose box is entered before the first hit so far."""
        backend, path = self.march.backend, self.path
        after = PartEntry(walk.enter, walk.enter, walk.box)
        entry = self.field.next_part(
            path.origin, path.direction, after, self.start, walk.t, walk.active
        )
        active = walk.active & (entry.part != NO_PART)
        near, far = fmax(entry.enter, self.start), fmin(entry.leave, walk.t)
        part = self.field.part_at(dr.select(active, entry.part, 0))
        spent = active & (walk.evaluations >= self.march.max_steps)
        now = MarchState.at(backend, near, far, active & ~spent, has_detail=False)
        now = dataclasses.replace(now, evaluations=backend.UInt32(walk.evaluations))
        now = self.march.advance(part, path, backend.Float(far), now)
        out = backend.UInt32(int(Status.OUT_OF_STEPS))
        hit = active & (now.status == int(Status.HIT))
        lost = spent | (active & (now.status == int(Status.OUT_OF_STEPS)))
        ended = hit | lost
        looked = active & (ended | (walk.part == NO_PART))
        goes_on = active & ~ended if self.any_hit else active & ~lost
        return PartWalk(
            enter=entry.enter,
            box=entry.part,
            t=dr.select(hit, now.proved_to, dr.select(lost, near, walk.t)),
            value=dr.select(looked, now.value, walk.value),
            gradient=dr.select(ended, now.gradient, walk.gradient),
            excess=dr.select(ended, now.excess, walk.excess),
            evaluations=dr.select(active, now.evaluations, walk.evaluations),
            status=dr.select(hit, now.status, dr.select(lost, out, walk.status)),
            part=dr.select(hit, entry.part, dr.select(lost, NO_PART, walk.part)),
            active=goes_on,
        )
