"""Tracers for fields with jumps and for unions of patches (see `harnack.fields.capabilities`), by
the loop of `March`.

- `JumpTracer`: for fields with jumps. A ray goes from one crossing of the jump surface to the next.
- `PatchTracer`: for unions of patches, each in its own box. A ray gets the first hit of all
  patches.

The winding number of a mesh jumps at its triangles, and the jumps are exact. A ray is cut into
intervals at the triangles that it crosses. On each interval the winding number w is an ordinary
smooth field, and at each crossing the values on both sides are compared with the level. Crossings
come from our own query and not from Embree's: whether a ray passes an edge must be decided by the
same bits for both triangles of the edge *and* for the boundary sum, or w is wrong by 1 behind the
edge; and the query must work in double precision.

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

from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.loops import loop_while_active
from harnack.fields.capabilities import NO_FACET, NO_PATCH, JumpCrossing, PatchEntry
from harnack.tracer.level_contact import HIT_AT_JUMP, RayStatus
from harnack.tracer.march import March, MarchState

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.fields.samples import Ray

# Two facets count as crossed at the same point if they are no farther apart than the first number
# of roundings of coordinates, and the cosine of the angle between them is larger than the second
# number. The sine of a ray's angle to a facet counts as at least the third number.
_COINCIDENT_ROUNDINGS, _MIN_COSINE, _MIN_SINE = 2.0, 0.999, 1 / 64
# If that distance is more than this fraction of the ray, facets that face each other at the same
# point may be the two sides of a wall.
_COARSE = 1e-4


@dataclass(frozen=True)
class JumpTraceState:
    """The state of rays through a field with jumps.

    offset: `Field.initial_offset` plus all jumps since the start.
    behind: the jump crossing that was passed last.
    march: the state of the march.
    reported_facet: for rays that look for crossings: index of the facet to report for the last
        crossing; None for other rays.
    """

    offset: Real
    behind: JumpCrossing
    march: MarchState
    reported_facet: Any | None = None

    @property
    def active(self) -> Mask:
        return self.march.active


@dataclass(frozen=True)
class _CoincidentJumps:
    """Jump crossings at the same point of a ray, up to rounding.

    jump: the sum of their jumps.
    t, last: ray parameter and facet index of the last of them.
    up, normal_up: index and normal of the first facet at which f jumps up; NO_FACET if none.
    down, normal_down: index and normal of the first facet at which f jumps down; NO_FACET if none.
    folded: whether f jumps the other way at a facet parallel to the first.
    active: whether there may be more of them.
    """

    jump: Real
    t: Real
    last: Any
    up: Any
    down: Any
    normal_up: Vec3
    normal_down: Vec3
    folded: Mask
    active: Mask


@dataclass(frozen=True)
class JumpTracer:
    """Traces rays through a field with jumps, from `start` to `end`.

    Between two jump crossings the field is continuous, and `March` proves that ray interval as it
    proves any ray. This class adds the order of the intervals.

    A smooth hit is a point within the tolerance of a level of the function that continues the
    interval. The level set of f may end at a facet. Within the tolerance of this end, a ray may
    hit the continued level set although the facet cuts it off: mostly near singular edges, where
    gradients grow without limit.
    """

    march: March
    field: Field
    path: Ray
    start: Real
    end: Real

    @property
    def backend(self) -> Backend:
        return self.march.backend

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays, and the index of the facet that each ray hit (NO_FACET: none).

        Proof that no hit is missed: crossings come in order, so the intervals cover the ray. On
        each interval `march` samples a continuous function, up to and including the last point,
        where the values before and behind the facet are compared with the level. From there the ray
        goes on with the step that the value behind the facet allows. So the part of the ray up to
        `proved_to` is free of smooth levels, and every facet on it was compared with the level.

        Rays begin just before `start`, so that a facet at the very start is not skipped.
        """
        return self.finish(loop_while_active(self.begin(state), self.advance, "harnack intervals"))

    def begin(self, state: MarchState) -> JumpTraceState:
        """Rays at their start."""
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        o, d = self.path.origin, self.path.direction
        before = real(self.start * (1 - self.backend.machine_epsilon) - 1e-30)
        offset = real(self.field.initial_offset(o, d, before, state.active))
        start = JumpCrossing(before, count(NO_FACET), real(0), vector(0))
        named = None if state.contact is None else count(NO_FACET)
        return JumpTraceState(offset, start, state, named)

    def finish(self, outer: JumpTraceState) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the facet that each ray hit, NO_FACET for none."""
        count, end = self.backend.UInt32, outer.march
        on_sheet = end.status == HIT_AT_JUMP
        status = dr.select(on_sheet, count(int(RayStatus.HIT)), end.status)
        named = outer.behind.facet if outer.reported_facet is None else outer.reported_facet
        sheet = dr.select(on_sheet, named, count(NO_FACET))
        return dataclasses.replace(end, status=status), sheet

    def advance(self, outer: JumpTraceState) -> JumpTraceState:
        """Rays after one interval: at the next crossing, the end of the ray, or a hit."""
        count = self.backend.UInt32
        o, d = self.path.origin, self.path.direction
        behind, now = outer.behind, outer.march
        ahead, last, lost = self._merge_coincident(
            self._next(behind, self.end, now.active), now.active
        )
        out = count(int(RayStatus.OUT_OF_STEPS))
        now = dataclasses.replace(
            now, status=dr.select(lost, out, now.status), active=now.active & ~lost
        )
        stops = ahead.facet != NO_FACET
        stop = dr.select(stops, ahead.t, self.end)
        # The last step may already have proved the rest of the ray.
        goes_on = now.proved_to + now.proved_step < stop
        if now.contact is not None and self.march.hysteresis is not None:
            samples_end = self.march.hysteresis.must_sample_end(now.contact, stop)
            goes_on |= samples_end & (now.proved_to < stop)
        active = now.active & (stops | goes_on)
        step = fmin(self.march.over_relaxation * now.proved_step, stop - now.proved_to)
        now = dataclasses.replace(now, trial_step=step, active=active)
        field = self.field.continuation(o, d, behind, ahead, outer.offset)
        now = self.march.advance(field, self.path, stop, now, ahead)
        passed = active & stops & (now.status == int(RayStatus.MISS))
        if now.contact is not None:
            return self._after_jump(outer, now, ahead, last, passed, active & stops)
        spent = passed & (now.evaluations >= self.march.max_steps)
        status = dr.select(spent, out, now.status)
        # Of several facets at a point, a hit reports `ahead`; a ray that passes goes on from
        # `last`.
        crossing = JumpCrossing(
            dr.select(passed, last.t, ahead.t),
            dr.select(passed, last.facet, ahead.facet),
            ahead.jump,
            ahead.normal,
        )
        return JumpTraceState(
            dr.select(passed, outer.offset + ahead.jump, outer.offset),
            crossing,
            dataclasses.replace(now, status=status, active=passed & ~spent),
        )

    def _after_jump(
        self,
        outer: JumpTraceState,
        now: MarchState,
        ahead: JumpCrossing,
        last: JumpCrossing,
        passed: Mask,
        stopped: Mask,
    ) -> JumpTraceState:
        """The state, after an interval, of rays that look for crossings. A ray that has crossed the
        level at a facet has passed that facet; it may be made active again."""
        spent = passed & (now.evaluations >= self.march.max_steps)
        status = dr.select(spent, self.backend.UInt32(int(RayStatus.OUT_OF_STEPS)), now.status)
        through = passed | (stopped & (now.status == HIT_AT_JUMP))
        behind = JumpCrossing(
            dr.select(through, last.t, outer.behind.t),
            dr.select(through, last.facet, outer.behind.facet),
            dr.select(through, ahead.jump, outer.behind.jump),
            dr.select(through, ahead.normal, outer.behind.normal),
        )
        return JumpTraceState(
            dr.select(through, outer.offset + ahead.jump, outer.offset),
            behind,
            dataclasses.replace(now, status=status, active=passed & ~spent),
            dr.select(through, ahead.facet, outer.reported_facet),
        )

    def _merge_coincident(
        self, first: JumpCrossing, active: Mask
    ) -> tuple[JumpCrossing, JumpCrossing, Mask]:
        """Merge all jump crossings at the same t, up to rounding, into one with the sum of their
        jumps.

        Returns the merged crossing, the last of its crossings (from which the ray continues), and
        the lanes on which it is uncertain whether the crossings are at the same point.

        A ray through an edge or a vertex crosses several facets at once, in no particular order: f
        jumps there by the sum of their jumps, and there is no interval between them. The same holds
        for facets in the same plane: facets that follow each other more closely than coordinates
        are rounded count as at the same t, as rounding decides their order. The merged crossing has
        the index and normal of the first facet whose jump has the sign of the sum.

        Far from the origin of rays or of coordinates, rounding may be as large as the thickness of
        a wall, whose two sides would cancel. So if rounding is no small part of the ray, parallel
        facets whose jumps cancel make the crossing uncertain.
        """
        real, count = self.backend.Float, self.backend.UInt32
        size = max_norm(self.path.origin)
        close = _COINCIDENT_ROUNDINGS * self.backend.machine_epsilon * (size + first.t)
        steep = fmax(dr.abs(dr.dot(first.normal, self.path.direction)), real(_MIN_SINE))
        furthest = fmax(fmin(first.t + close / steep, self.end), first.t)

        def body(now: _CoincidentJumps) -> _CoincidentJumps:
            one = self._next(JumpCrossing(now.t, now.last, 0.0, first.normal), furthest, now.active)
            # Facets at an angle to each other are merged only at exactly the same t.
            level = dr.abs(dr.dot(one.normal, first.normal)) > _MIN_COSINE
            found = now.active & (one.facet != NO_FACET) & ((one.t == first.t) | level)
            new_up = found & (one.jump > 0) & (now.up == NO_FACET)
            new_down = found & (one.jump < 0) & (now.down == NO_FACET)
            return _CoincidentJumps(
                jump=now.jump + dr.select(found, one.jump, 0),
                t=dr.select(found, one.t, now.t),
                last=dr.select(found, one.facet, now.last),
                up=dr.select(new_up, one.facet, now.up),
                down=dr.select(new_down, one.facet, now.down),
                normal_up=dr.select(new_up, one.normal, now.normal_up),
                normal_down=dr.select(new_down, one.normal, now.normal_down),
                folded=now.folded | (found & level & (one.jump * first.jump < 0)),
                active=found,
            )

        none = count(NO_FACET)
        start = _CoincidentJumps(
            jump=first.jump,
            t=first.t,
            last=first.facet,
            up=dr.select(first.jump > 0, first.facet, none),
            down=dr.select(first.jump < 0, first.facet, none),
            normal_up=first.normal,
            normal_down=first.normal,
            folded=self.backend.Bool(False),
            active=self.backend.Bool(active) & (first.facet != NO_FACET),
        )
        all_there = loop_while_active(start, body, "together")
        up, down = all_there.jump > 0, all_there.jump < 0
        sheet = dr.select(up, all_there.up, dr.select(down, all_there.down, first.facet))
        normal = dr.select(
            up, all_there.normal_up, dr.select(down, all_there.normal_down, first.normal)
        )
        behind = JumpCrossing(all_there.t, all_there.last, first.jump, first.normal)
        lost = all_there.folded & (all_there.jump == 0)
        lost &= close > _COARSE * (self.end - self.start)
        return JumpCrossing(first.t, sheet, real(all_there.jump), normal), behind, lost

    def _next(self, behind: JumpCrossing, end: Real, active: Mask) -> JumpCrossing:
        """The next crossing, as arrays of this backend; none if it lies beyond the end."""
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        ahead = self.field.next_jump(self.path.origin, self.path.direction, behind, end, active)
        there = real(ahead.t) <= end
        there &= count(ahead.facet) != NO_FACET
        return JumpCrossing(
            dr.select(there, real(ahead.t), dr.inf),
            dr.select(there, count(ahead.facet), count(NO_FACET)),
            dr.select(there, real(ahead.jump), 0),
            vector(*ahead.normal),
        )


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
        walk = loop_while_active(self.begin(state), self.advance, "harnack parts")
        return self.finish(walk)

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
        near, far = fmax(entry.enter, self.start), fmin(entry.leave, walk.t)
        part = self.field.patch(dr.select(active, entry.patch, 0))
        spent = active & (walk.evaluations >= self.march.max_steps)
        now = MarchState.at(backend, near, far, active & ~spent, has_detail=False)
        now = dataclasses.replace(now, evaluations=backend.UInt32(walk.evaluations))
        now = self.march.advance(part, path, backend.Float(far), now)
        out = backend.UInt32(int(RayStatus.OUT_OF_STEPS))
        hit = active & (now.status == int(RayStatus.HIT))
        lost = spent | (active & (now.status == int(RayStatus.OUT_OF_STEPS)))
        ended = hit | lost
        looked = active & (ended | (walk.part == NO_PATCH))
        goes_on = active & ~ended if self.any_hit else active & ~lost
        return PatchTraceState(
            enter=entry.enter,
            box=entry.patch,
            t=dr.select(hit, now.proved_to, dr.select(lost, near, walk.t)),
            value=dr.select(looked, now.value, walk.value),
            gradient=dr.select(ended, now.gradient, walk.gradient),
            excess=dr.select(ended, now.tolerance_excess, walk.excess),
            evaluations=dr.select(active, now.evaluations, walk.evaluations),
            status=dr.select(hit, now.status, dr.select(lost, out, walk.status)),
            part=dr.select(hit, entry.patch, dr.select(lost, NO_PATCH, walk.part)),
            active=goes_on,
        )
