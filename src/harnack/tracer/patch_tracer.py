"""`PatchTracer`: traces rays through unions of patches. A patch is a surface with a function and a
box of its own, such as a face of a polygon mesh.

Each patch lies in its box, and `March` traces rays to it as to any level set. A ray gets the first
hit of all patches.

The patches cannot be marched as one field: no single function has all of them as its level set, and
for the faces of a polygon mesh each step would evaluate every face. So a ray marches its patches
one after another, in the order in which it enters their boxes. A tree of the boxes gives this
order. At any time different lanes may be in different patches. All patches read their edges from
one table (`RecordTable.view`), so the compiled kernel is the same for every mesh.
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
    from harnack.enclosures.samples import Ray
    from harnack.fields.capabilities import Patches


@dataclass(frozen=True)
class PatchTraceState:
    """The state of rays through a union of patches, each with a box of its own. A ray marches the
    patches one after another, in the order in which it enters their boxes.

    enter, box: the ray parameter at which the ray entered the last box, and the index of this box.
    t: the ray parameter of the nearest hit so far; for a ray without a hit, its end; for a ray out
        of steps, the parameter up to which no surface lies on it.
    value, gradient, excess, status: the results of the march that gave this t: f and its gradient
        (3,) there, by how much |f - level| may exceed the tolerance because of rounding, and a
        `RayStatus`.
    evaluations: the number of evaluations of functions in all marches so far.
    part: the index of the patch that was hit, NO_PATCH for none.
    active: whether the ray may meet further patches.
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
    """Traces rays o + t d, start <= t <= end, to the first of many patches. A patch is a surface
    with a function and a box of its own.

    march: marches rays to one level set.
    patches: the patches of the surface.
    path: the rays.
    any_hit: whether a ray may end at any hit, and not only at the first.
    """

    march: March
    patches: Patches
    path: Ray
    start: Real
    end: Real
    any_hit: bool = False

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """Trace rays until all have ended. Returns their end state, and the index of the patch that
        each ray hit, NO_PATCH for none.

        state: the `MarchState` of rays that have not moved yet.

        Proof that no hit is missed. Each patch lies in its box, and the boxes come in the order in
        which the ray enters them. In each box the ray marches from its entry to its exit, or to the
        first hit so far if that is nearer. So when the search ends, no patch whose box the ray
        enters before the hit was passed unnoticed before the hit, and all patches whose boxes it
        enters later lie behind the hit. If a ray runs out of steps in a patch, no surface lies
        before its entry into the box of this patch.
        """
        end_state = loop_while_active(self.begin(state), self.advance, "harnack parts")
        return self.finish(end_state)

    def begin(self, state: MarchState) -> PatchTraceState:
        """Return the tracer's own state, a `PatchTraceState`, for rays that have entered no box
        yet.

        state: the `MarchState` of the same rays, before their first sample.
        """
        real, count = self.march.backend.Float, self.march.backend.UInt32
        return PatchTraceState(
            # Before all entries, whose parameters are at least 0.
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
        """Return the end state of rays as a `MarchState`, and the index of the patch that each ray
        hit, NO_PATCH for none.

        walk: the tracer's own state when no ray is active any more.
        """
        backend = self.march.backend
        # (Patches are sampled with a single accuracy, and need no accuracy scale.)
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
        """March each active ray through one more patch: the next one whose box it enters before the
        first hit so far. Returns the state after it.

        walk: the tracer's own state before.

        Rays without such a patch end; their nearest hit, if any, is the first. A ray that runs out
        of steps in a patch ends there.
        """
        backend, path = self.march.backend, self.path
        # The last entry. Entries are ordered by `enter` and `patch` alone; its `leave` is not used.
        after = PatchEntry(walk.enter, walk.enter, walk.box)
        entry = self.patches.next_entry(
            path.origin, path.direction, after, self.start, walk.t, walk.active
        )
        active = walk.active & (entry.patch != NO_PATCH)
        start, end = fmax(entry.enter, self.start), fmin(entry.leave, walk.t)
        # (Inactive lanes get patch 0, since NO_PATCH is no index.)
        patch = self.patches.patch(dr.select(active, entry.patch, 0))
        used_all_steps = active & (walk.evaluations >= self.march.max_steps)
        # (Patches are sampled with a single accuracy, and need no accuracy scale.)
        now = MarchState.at(backend, start, end, active & ~used_all_steps, has_detail=False)
        now = dataclasses.replace(now, evaluations=backend.UInt32(walk.evaluations))
        now = self.march.advance(patch, path, backend.Float(end), now)
        out_of_steps = backend.UInt32(int(RayStatus.OUT_OF_STEPS))
        is_hit = active & (now.status == int(RayStatus.HIT))
        is_undecided = used_all_steps | (active & (now.status == int(RayStatus.OUT_OF_STEPS)))
        has_ended = is_hit | is_undecided
        # Rays without a hit keep the value of the last patch.
        takes_value = active & (has_ended | (walk.part == NO_PATCH))
        # After a hit, a patch whose box is entered before it may still be nearer.
        goes_on = active & ~has_ended if self.any_hit else active & ~is_undecided
        return PatchTraceState(
            enter=entry.enter,
            box=entry.patch,
            t=dr.select(is_hit, now.proved_to, dr.select(is_undecided, start, walk.t)),
            value=dr.select(takes_value, now.value, walk.value),
            gradient=dr.select(has_ended, now.gradient, walk.gradient),
            excess=dr.select(has_ended, now.tolerance_excess, walk.excess),
            evaluations=dr.select(active, now.evaluations, walk.evaluations),
            status=dr.select(
                is_hit, now.status, dr.select(is_undecided, out_of_steps, walk.status)
            ),
            part=dr.select(is_hit, entry.patch, dr.select(is_undecided, NO_PATCH, walk.part)),
            active=goes_on,
        )
