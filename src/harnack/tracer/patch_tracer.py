"""`PatchTracer`: traces rays through unions of patches (see `harnack.fields.capabilities`).

Each patch lies in its own box and is marched by the loop of `March`. A ray gets the first hit of
all patches.

Patches are marched one after the other, as no single function has all of them as a level set, and a
union of the faces of a polygon mesh would evaluate all faces at each step. A tree gives the proved
boxes in the order in which a ray enters them. Each lane marches its own patch, which is a view of a
single table of edges (`RecordTable.view`), so that no kernel depends on the mesh.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.backend.loops import loop_while_active
from harnack.fields.capabilities import NO_PATCH, PatchEntry
from harnack.tracer.level_contact import RayStatus
from harnack.tracer.march import March, MarchState

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.fields.samples import Ray


@dataclass(frozen=True)
class PatchTraceState:
    """The state of rays through a union of patches: the box entered last, and the nearest hit so
    far.

    enter, box: the ray parameter at which the ray entered the last box, and the index of the box.
    t: ray parameter of the nearest hit so far, else the end of the ray; for a ray out of steps, the
        parameter up to which it is proved free.
    value, gradient, excess, status: of the march that ended there.
    evaluations: the number of evaluations of all marches so far.
    part: index of the patch that was hit, NO_PATCH for none.
    active: whether there may be more patches.
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
class PatchTracer:
    """Traces rays through a union of patches, from `start` to `end`.

    Each patch is marched as any field is. This class adds the order of the patches, and the
    interval in which the ray must be followed in each.

    any_hit: whether a ray may end at any hit, and not only at the first.
    """

    march: March
    field: Field
    path: Ray
    start: Real
    end: Real
    any_hit: bool = False

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays, and the index of the patch that each ray hit (NO_PATCH: none).

        Proof that no hit is missed: a patch lies in its box, and all boxes that the ray meets come
        in the order in which it enters them. Each patch is marched from the entry into its box to
        the exit, or to the first hit so far if that comes before. So up to a hit the ray is free of
        every patch whose box it entered before the hit, and all other patches lie behind the hit. A
        ray that is out of steps in a patch is proved free up to its entry into that box.
        """
        end_state = loop_while_active(self.begin(state), self.advance, "harnack parts")
        return self.finish(end_state)

    def begin(self, state: MarchState) -> PatchTraceState:
        """Rays before the first box."""
        real, count = self.march.backend.Float, self.march.backend.UInt32
        return PatchTraceState(
            enter=real(-1),
            box=count(NO_PATCH),
            t=real(self.end),
            value=state.value,
            gradient=state.gradient,
            excess=state.tolerance_excess,
            evaluations=state.evaluations,
            status=state.status,
            part=count(NO_PATCH),
            active=state.active,
        )

    def finish(self, walk: PatchTraceState) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the patch that each ray hit, NO_PATCH for none."""
        backend = self.march.backend
        before = MarchState.at(backend, self.start, self.end, walk.active, has_detail=False)
        end = dataclasses.replace(
            before,
            proved_to=walk.t,
            value=walk.value,
            gradient=walk.gradient,
            tolerance_excess=walk.excess,
            evaluations=walk.evaluations,
            status=walk.status,
            active=walk.active,
        )
        return end, walk.part

    def advance(self, walk: PatchTraceState) -> PatchTraceState:
        """Rays after one more patch: the next patch whose box they enter before the first hit so
        far."""
        backend, path = self.march.backend, self.path
        after = PatchEntry(walk.enter, walk.enter, walk.box)
        entry = self.field.next_patch(
            path.origin, path.direction, after, self.start, walk.t, walk.active
        )
        active = walk.active & (entry.patch != NO_PATCH)
        start, end = fmax(entry.enter, self.start), fmin(entry.leave, walk.t)
        patch = self.field.patch(dr.select(active, entry.patch, 0))
        spent = active & (walk.evaluations >= self.march.max_steps)
        now = MarchState.at(backend, start, end, active & ~spent, has_detail=False)
        now = dataclasses.replace(now, evaluations=backend.UInt32(walk.evaluations))
        now = self.march.advance(patch, path, backend.Float(end), now)
        out = backend.UInt32(int(RayStatus.OUT_OF_STEPS))
        hit = active & (now.status == int(RayStatus.HIT))
        lost = spent | (active & (now.status == int(RayStatus.OUT_OF_STEPS)))
        ended = hit | lost
        sampled = active & (ended | (walk.part == NO_PATCH))
        goes_on = active & ~ended if self.any_hit else active & ~lost
        return PatchTraceState(
            enter=entry.enter,
            box=entry.patch,
            t=dr.select(hit, now.proved_to, dr.select(lost, start, walk.t)),
            value=dr.select(sampled, now.value, walk.value),
            gradient=dr.select(ended, now.gradient, walk.gradient),
            excess=dr.select(ended, now.tolerance_excess, walk.excess),
            evaluations=dr.select(active, now.evaluations, walk.evaluations),
            status=dr.select(hit, now.status, dr.select(lost, out, walk.status)),
            part=dr.select(hit, entry.patch, dr.select(lost, NO_PATCH, walk.part)),
            active=goes_on,
        )
