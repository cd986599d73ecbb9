"""`JumpTracer`: traces rays through functions f with jumps, such as the winding number of a mesh.
The flat pieces of surface at which such a function jumps (triangles) are called facets. The surface
consists of the points at which f takes a given value, the level, and of the facets with a level
between the values of f on their two sides.

A ray is cut into intervals at the facets that it crosses. On each interval f is continuous, and
`March` traces the ray. At each crossing of a facet, the values before and behind it are compared
with the level.

The crossings come from a query of this package and not from Embree, for two reasons. Whether a ray
passes an edge must be decided by the same bits for both triangles of the edge and for the sum over
the boundary; otherwise the winding number is wrong by 1 behind the edge. And the query must work in
double precision.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.loops import loop_while_active
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.tracer.level_contact import HIT_AT_JUMP, RayStatus
from harnack.tracer.march import March, MarchState

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures.samples import Ray
    from harnack.fields.capabilities import Jumps

# Facets count as crossed at the same point if they are at most the first number of roundings of the
# coordinates apart, and the cosine of the angle between them is larger than the second number. The
# sine of a ray's angle to a facet counts as at least the third number.
_COINCIDENT_ROUNDINGS, _MIN_COSINE, _MIN_SINE = 2.0, 0.999, 1 / 64
# If this distance of coincidence is more than this fraction of the ray, facets that face each other
# at the same point may be the two sides of a wall.
_COARSE_FRACTION = 1e-4


@dataclass(frozen=True)
class JumpTraceState:
    """The state of rays through a function f with jumps at facets (triangles), between two
    intervals. An interval is the part of a ray from one facet to the next, on which f is
    continuous.

    offset: a number from which the field makes f on an interval (`Jumps.continuation`): that at the
        start of the ray (`Jumps.initial_offset`) plus all jumps since.
    behind: the crossing of a facet from which the ray goes on: the last one so far.
    march: the state of the march.
    reported_facet: for rays that look for crossings of the level, the index of the facet that is
        reported if the ray crossed the level at the facets behind which it is. If it met several
        at the same point, this need not be the facet of `behind`. NO_FACET if the ray is behind no
        facet so far. None for rays that look for first hits.
    """

    offset: Real
    behind: JumpCrossing
    march: MarchState
    reported_facet: Any | None = None

    @property
    def active(self) -> Mask:
        """Mask of the rays that go on."""
        return self.march.active


@dataclass(frozen=True)
class _CoincidentJumps:
    """The sum of the crossings of several facets at the same point of a ray, up to rounding, while
    they are added one by one.

    jump: the sum of the jumps of f at the facets.
    t, last: the ray parameter and the facet index of the last crossing.
    up, normal_up: the index and normal (3,) of the first facet at which f jumps up; NO_FACET if
        there is none.
    down, normal_down: the index and normal (3,) of the first facet at which f jumps down; NO_FACET
        if there is none.
    folded: whether one of the crossed facets is parallel to the first of them and f jumps the other
        way there, as at the two sides of a thin wall.
    active: whether there may be further crossings at this point.
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
    """Traces rays o + t d, start <= t <= end, through a function f with jumps. The flat pieces of
    surface at which f jumps are called facets. They cut each ray into intervals, on which f is
    continuous.

    march: marches rays through the intervals.
    jumps: the facets at which f jumps.
    path: the rays.

    A smooth hit is a hit that is not on a facet: a point within the tolerance of a level set, that
    of the function which continues f from its interval beyond the facets. The level set of f itself
    may end at a facet. Within the tolerance of such an end, a ray may hit the continued level set
    although the facet cuts it off. That happens mostly near singular edges, where gradients grow
    without limit.
    """

    march: March
    jumps: Jumps
    path: Ray
    start: Real
    end: Real

    @property
    def backend(self) -> Backend:
        """The backend of the march."""
        return self.march.backend

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """Trace rays until all have ended. Returns their end state, and the index of the facet that
        each ray hit, NO_FACET for none.

        state: the `MarchState` of rays that have not moved yet.

        Proof that no hit is missed. The crossings of facets come in order, so the intervals between
        them cover the ray. On each interval `march` samples a continuous function up to and
        including its last point. There the values before and behind the facet are compared with the
        level. The ray then goes on with the step that the value behind the facet allows. So no
        smooth level lies on the ray before `proved_to`, and every facet before it was compared with
        the level.

        Rays begin just before `start`, so that a facet at the very start is not skipped.
        """
        return self.finish(loop_while_active(self.begin(state), self.advance, "harnack intervals"))

    def begin(self, state: MarchState) -> JumpTraceState:
        """Return the tracer's own state, a `JumpTraceState`, for rays that have not moved yet and
        have crossed no facet.

        state: the `MarchState` of the same rays, before their first sample.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        o, d = self.path.origin, self.path.direction
        # A little before the start, so that a facet at the very start is crossed (1e-30: also if
        # the start is 0).
        before = real(self.start * (1 - self.backend.machine_epsilon) - 1e-30)
        offset = real(self.jumps.initial_offset(o, d, before, state.active))
        # The place from which facets are looked for: no facet, no jump, no normal.
        no_crossing = JumpCrossing(before, count(NO_FACET), real(0), vector(0))
        # Only rays that look for crossings of the level have a contact.
        reported = None if state.contact is None else count(NO_FACET)
        return JumpTraceState(offset, no_crossing, state, reported)

    def finish(self, outer: JumpTraceState) -> tuple[MarchState, Any]:
        """Return the end state of rays as a `MarchState`, and the index of the facet that each ray
        hit, NO_FACET for none.

        outer: the tracer's own state when no ray is active any more.
        """
        count, end = self.backend.UInt32, outer.march
        at_facet = end.status == HIT_AT_JUMP
        status = dr.select(at_facet, count(int(RayStatus.HIT)), end.status)
        reported = outer.behind.facet if outer.reported_facet is None else outer.reported_facet
        facet = dr.select(at_facet, reported, count(NO_FACET))
        return dataclasses.replace(end, status=status), facet

    def advance(self, outer: JumpTraceState) -> JumpTraceState:
        """March each active ray through one interval: to the next facet, to the end of the ray, or
        to a hit before that. Returns the state after it.

        outer: the tracer's own state before.

        A ray that has passed a facet goes on with the next interval, unless it has used all of its
        steps. A ray on which the order of facets is uncertain ends as out of steps.
        """
        count = self.backend.UInt32
        o, d = self.path.origin, self.path.direction
        behind, now = outer.behind, outer.march
        ahead, last, unclear = self._merge_coincident(
            self._next(behind, self.end, now.active), now.active
        )
        out_of_steps = count(int(RayStatus.OUT_OF_STEPS))
        now = dataclasses.replace(
            now, status=dr.select(unclear, out_of_steps, now.status), active=now.active & ~unclear
        )
        has_facet = ahead.facet != NO_FACET
        stop = dr.select(has_facet, ahead.t, self.end)
        # The last step may already have proved the rest of the ray.
        goes_on = now.proved_to + now.proved_step < stop
        if now.contact is not None and self.march.hysteresis is not None:
            samples_end = self.march.hysteresis.must_sample_end(now.contact, stop)
            goes_on |= samples_end & (now.proved_to < stop)
        # The interval is marched to compare the facet at its end with the level, even if its steps
        # are proved.
        active = now.active & (has_facet | goes_on)
        step = fmin(self.march.over_relaxation * now.proved_step, stop - now.proved_to)
        now = dataclasses.replace(now, trial_step=step, active=active)
        # The function that is f on this interval and continues it beyond the facets.
        evaluator = self.jumps.continuation(o, d, behind, ahead, outer.offset)
        now = self.march.advance(evaluator, self.path, stop, now, ahead)
        # A march that ends at a facet as a miss has passed it.
        passed = active & has_facet & (now.status == int(RayStatus.MISS))
        # Rays that look for crossings of the level have a contact.
        if now.contact is not None:
            return self._after_jump(outer, now, ahead, last, passed, active & has_facet)
        used_all_steps = passed & (now.evaluations >= self.march.max_steps)
        status = dr.select(used_all_steps, out_of_steps, now.status)
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
            dataclasses.replace(now, status=status, active=passed & ~used_all_steps),
        )

    def _after_jump(
        self,
        previous: JumpTraceState,
        now: MarchState,
        ahead: JumpCrossing,
        last: JumpCrossing,
        passed: Mask,
        stopped: Mask,
    ) -> JumpTraceState:
        """Return the state after an interval for rays that look for crossings of the level. Where a
        ray has crossed the level at a facet, the returned state is behind this facet, but not
        active; the caller may make it active again, to look for the next crossing.

        previous: the state before the interval.
        now: the march at the end of the interval.
        ahead: the crossing of a facet at the end of the interval. It may stand for several facets
            that the ray crosses at the same point, with the sum of their jumps.
        last: the last of these facets, from which the ray goes on.
        passed: mask of rays that go on behind the facet, as they did not cross the level there.
        stopped: mask of rays whose interval ends at a facet.
        """
        used_all_steps = passed & (now.evaluations >= self.march.max_steps)
        status = dr.select(
            used_all_steps, self.backend.UInt32(int(RayStatus.OUT_OF_STEPS)), now.status
        )
        # Rays that crossed the level at the facet are behind it, too.
        is_past = passed | (stopped & (now.status == HIT_AT_JUMP))
        # Rays that are past the facet go on from the last merged crossing.
        behind = JumpCrossing(
            dr.select(is_past, last.t, previous.behind.t),
            dr.select(is_past, last.facet, previous.behind.facet),
            dr.select(is_past, ahead.jump, previous.behind.jump),
            dr.select(is_past, ahead.normal, previous.behind.normal),
        )
        return JumpTraceState(
            dr.select(is_past, previous.offset + ahead.jump, previous.offset),
            behind,
            dataclasses.replace(now, status=status, active=passed & ~used_all_steps),
            dr.select(is_past, ahead.facet, previous.reported_facet),
        )

    def _merge_coincident(
        self, first: JumpCrossing, active: Mask
    ) -> tuple[JumpCrossing, JumpCrossing, Mask]:
        """Merge all crossings of facets at the same t, up to rounding, into one whose jump is the
        sum of their jumps.

        Returns the merged crossing; the last of the crossings that were merged, from which the ray
        goes on; and a mask of lanes on which it is uncertain whether the crossings are at the same
        point.

        first: the first of the crossings.
        active: mask of rays whose crossings are merged.

        A ray through an edge or a vertex crosses several facets at once, in no particular order. f
        jumps there by the sum of their jumps, and there is no interval between them. The same holds
        for parallel facets that follow each other more closely than coordinates are rounded, as
        rounding decides their order. The merged crossing has the index and normal of the first
        facet whose jump has the sign of the sum.

        If the origin of the ray is far away, rounding may be as large as the thickness of a wall,
        and the jumps of its two sides would cancel. So if rounding is no small part of the ray, a
        crossing of parallel facets whose jumps cancel is uncertain.
        """
        real, count = self.backend.Float, self.backend.UInt32
        size = max_norm(self.path.origin)
        tolerance = _COINCIDENT_ROUNDINGS * self.backend.machine_epsilon * (size + first.t)
        # A rounding across the facet is a length of rounding / sine along the ray.
        sine = fmax(dr.abs(dr.dot(first.normal, self.path.direction)), real(_MIN_SINE))
        # Further crossings up to this t may be at the same point.
        limit = fmax(fmin(first.t + tolerance / sine, self.end), first.t)

        def add_next(now: _CoincidentJumps) -> _CoincidentJumps:
            """Add the next crossing of a facet to the sums, if it is at the same point as the
            crossing `first` of the enclosing function, up to rounding: at most at the t called
            `limit`. Returns the new sums."""
            # The field looks for the next crossing after the place (t, facet) of the last one. The
            # jump and the normal of that one are not used.
            crossing = self._next(
                JumpCrossing(now.t, now.last, 0.0, first.normal), limit, now.active
            )
            # Facets at an angle to each other are merged only at exactly the same t.
            is_parallel = dr.abs(dr.dot(crossing.normal, first.normal)) > _MIN_COSINE
            is_same_point = (
                now.active & (crossing.facet != NO_FACET) & ((crossing.t == first.t) | is_parallel)
            )
            # Of the facets at which f jumps up (down), the first one is kept.
            new_up = is_same_point & (crossing.jump > 0) & (now.up == NO_FACET)
            new_down = is_same_point & (crossing.jump < 0) & (now.down == NO_FACET)
            return _CoincidentJumps(
                jump=now.jump + dr.select(is_same_point, crossing.jump, 0),
                t=dr.select(is_same_point, crossing.t, now.t),
                last=dr.select(is_same_point, crossing.facet, now.last),
                up=dr.select(new_up, crossing.facet, now.up),
                down=dr.select(new_down, crossing.facet, now.down),
                normal_up=dr.select(new_up, crossing.normal, now.normal_up),
                normal_down=dr.select(new_down, crossing.normal, now.normal_down),
                folded=now.folded
                | (is_same_point & is_parallel & (crossing.jump * first.jump < 0)),
                active=is_same_point,
            )

        no_facet = count(NO_FACET)
        initial = _CoincidentJumps(
            jump=first.jump,
            t=first.t,
            last=first.facet,
            up=dr.select(first.jump > 0, first.facet, no_facet),
            down=dr.select(first.jump < 0, first.facet, no_facet),
            normal_up=first.normal,
            normal_down=first.normal,
            folded=self.backend.Bool(False),
            active=self.backend.Bool(active) & (first.facet != NO_FACET),
        )
        total = loop_while_active(initial, add_next, "together")
        # The first facet whose jump has the sign of the sum gives index and normal.
        rises, falls = total.jump > 0, total.jump < 0
        facet = dr.select(rises, total.up, dr.select(falls, total.down, first.facet))
        normal = dr.select(
            rises, total.normal_up, dr.select(falls, total.normal_down, first.normal)
        )
        # The place (t, facet) from which the ray goes on; its jump and normal are not used.
        behind = JumpCrossing(total.t, total.last, first.jump, first.normal)
        is_unclear = total.folded & (total.jump == 0)
        # Only if rounding is no small part of the ray.
        is_unclear &= tolerance > _COARSE_FRACTION * (self.end - self.start)
        return JumpCrossing(first.t, facet, real(total.jump), normal), behind, is_unclear

    def _next(self, behind: JumpCrossing, end: Real, active: Mask) -> JumpCrossing:
        """Return the next crossing of a facet after the crossing `behind`, as arrays of this
        backend. If there is none up to the parameter `end`, its t is inf and its facet NO_FACET.

        active: mask of rays that need the result.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        ahead = self.jumps.next_crossing(self.path.origin, self.path.direction, behind, end, active)
        # The field may return other arrays or Python numbers; all become arrays of this backend.
        is_valid = real(ahead.t) <= end
        is_valid &= count(ahead.facet) != NO_FACET
        return JumpCrossing(
            dr.select(is_valid, real(ahead.t), dr.inf),
            dr.select(is_valid, count(ahead.facet), count(NO_FACET)),
            dr.select(is_valid, real(ahead.jump), 0),
            vector(*ahead.normal),
        )
