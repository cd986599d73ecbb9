"""The marching loop, the only one of the tracer: it gives the first point of a ray on a level set,
with a proof of every step.

The loop depends neither on the kind of field nor on the kind of proof. It samples a field along the
ray, and the enclosures of each sample tell how far the ray is free of levels.

Trial steps are aimed: an over-relaxed step ends just short of the point at which f is predicted to
reach a level. Without this, half of the samples near the surface were rejected. The prediction is
the cubic through the last two values and slopes for smooth fields, and the slope for approximate
fields.

The state of the march is a record, which `backend.loops` takes apart and puts together for Dr.Jit's
loop. The march compares samples with the facet at the end of an interval; the tracer that goes from
facet to facet (`jump_tracer.JumpTracer`) calls the march, and not the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin, max_norm, safe_norm
from harnack.backend.loops import loop_while_active
from harnack.enclosures import any_is_free, longest_free_length
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.fields.samples import value_error_bound
from harnack.tracer.level_contact import (
    CONTACT_AIM,
    CONTACT_TOLERANCE,
    AcceptedPoint,
    Contact,
    Hysteresis,
    JumpTest,
    PreparedHitTolerance,
    RayStatus,
    test_jump,
)
from harnack.tracer.steep import SteepPlace, beyond, down_or_up, largest_change

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import LevelGaps, Levels
    from harnack.fields.field import Field
    from harnack.fields.samples import Ray, RaySample
    from harnack.tracer.branch_tracker import BranchTracker
    from harnack.tree.empty_space import EmptySpaceGrid

# A coarse sample is repeated with higher accuracy where a level is nearer in value than the first
# number times the total error. The accuracy is chosen so that the truncation error becomes the
# second number times the distance to that level, or the third number times the allowed truncation
# error, whichever is larger (`_refined_accuracy`).
_REFINE_BELOW, _TRUNCATION_OF_GAP, _TRUNCATION_OF_ALLOWED = 2.0, 0.25, 0.85
# The truncation error that is allowed at a hit: the first number times the tolerance, less the
# second times the rounding error; or the third times the rounding error if that is larger.
_TRUNCATION_OF_TOLERANCE, _LESS_ROUNDINGS, _TRUNCATION_OF_ROUNDING = 0.4, 0.55, 0.6
# The next sample may be so coarse that its truncation error is this fraction of the level gap.
_COARSEN = 0.2
# Trial steps are this fraction of the length at which f is predicted to reach a level: predicted by
# a parabola, or by the slope alone.
_TRIAL_AIM, _AIM_BY_SLOPE = 0.999, 0.99
# The largest distance from the surface that rounding may leave uncertain at a hit: see
# `March._is_near`.
_LARGEST_UNCERTAINTY = 1 / 16
# Rays without an end become misses where t reaches this power of the largest number: squares of
# larger numbers overflow.
_MISS_EXPONENT = 0.47
# The fraction of the level gap that is reserved for the growth of a cone during a step.
_WIDENING = 0.1
# The accuracy scale of a repeated sample is larger by these factors at least and at most.
_REFINEMENT_LIMITS = 1.25, 16.0
# Truncation falls as this power of the accuracy scale; beyond the largest scale there is none.
_TRUNCATION_ORDER, _MAX_ACCURACY = 3.2, 1e6
# In contact, a step that leads to where the band is much smaller is tried again with this fraction
# of its length.
_RETRY_FRACTION = 0.125


@dataclass(frozen=True)
class MarchState:
    """The state of rays during the march.

    proved_to: ray parameter of the last accepted point; up to it the ray is proved free of levels.
    proved_step: a length from there that is proved free, too.
    trial_step: the length from there to the next trial point.
    enclosure_reach: the length that the next enclosures should reach.
    value, gradient: of f at `proved_to`; the value behind the facet if a facet was passed there.
    tolerance_excess: by how much f at `proved_to` may be farther from a level than the tolerance
        allows.
    evaluations: the number of evaluations of f so far.
    accuracy_scale: the accuracy scale of the next sample (`Field.at_accuracy`); None for fields
        with a single accuracy (Dr.Jit records a loop twice if a state in it never changes).
    status: the `RayStatus` of rays that have ended.
    active: whether the ray goes on.
    contact: the state of contact with the level that was reached last; None for rays that end where
        they reach a level.
    """

    proved_to: Real
    trial_step: Real
    proved_step: Real
    enclosure_reach: Real
    value: Real
    gradient: Vec3
    tolerance_excess: Real
    evaluations: Any
    accuracy_scale: Real | None
    status: Any
    active: Mask
    contact: Contact | None = None

    @classmethod
    def at(
        cls,
        backend: Backend,
        start: Real,
        end: Real,
        active: Mask,
        *,
        has_detail: bool,
        crosses: bool = False,
    ) -> MarchState:
        """The state at the start of rays, before the first sample.

        has_detail: whether the field has variable accuracy.
        crosses: whether rays end where they have crossed a level, and not where they reach it.
        """
        real, vector, count = backend.Float, backend.Array3f, backend.UInt32
        return cls(
            proved_to=real(start),
            trial_step=real(0),
            proved_step=real(0),
            enclosure_reach=real(end - start),
            value=real(0),
            gradient=vector(0),
            tolerance_excess=real(0),
            evaluations=count(0),
            accuracy_scale=real(0) if has_detail else None,
            status=count(int(RayStatus.MISS)),
            active=backend.Bool(active) & (start < end),
            contact=Contact.none(backend) if crosses else None,
        )


@dataclass(frozen=True)
class _TrialSample:
    """The sample at the trial point of each ray, and what follows from it.

    t: ray parameter of the trial point.
    at_end: whether the ray (or the interval before the next facet) ends there.
    coordinate_size: a bound of the absolute values of the coordinates there.
    unproved_length: the length before the point that no step has proved yet.
    look: the sample of the field there, with its enclosures.
    gradient_norm: the length of the gradient there.
    gaps: from f to the levels on both sides; in contact, to the levels as the hysteresis places
        them.
    total_error: a bound of the rounding and truncation error of f.
    value_tolerance: the largest level gap that makes a hit; in contact, a crossing.
    band: in contact, the band of `Hysteresis.band`; else `value_tolerance`.
    is_near: whether a level is near enough for a hit.
    accepts_unknown_side: whether the point may be accepted although it is not known on which side
        of a level it lies.
    excess: as `MarchState.tolerance_excess`.
    is_smooth: whether value and slope predict f.
    passes_branch_level, needs_branch: the masks of `BranchTracker.gaps`; None if the sample knows
        its branch on all lanes.
    steep: bounds that rest on values of f; None for fields whose slopes are bounded.
    looks: the number of further evaluations of f, beyond the trial point.
    """

    t: Real
    at_end: Mask
    coordinate_size: Real
    unproved_length: Real
    look: RaySample
    gradient_norm: Real
    gaps: LevelGaps
    total_error: Real
    value_tolerance: Real
    band: Real
    is_near: Mask
    accepts_unknown_side: Mask
    excess: Real
    is_smooth: bool
    passes_branch_level: Mask | None = None
    needs_branch: Mask | None = None
    steep: SteepPlace | None = None
    looks: Any = 0

    @property
    def value(self) -> Real:
        """f at the points."""
        return self.look.sample.value

    def gaps_after_jump(self, behind: LevelGaps) -> LevelGaps:
        """The level gaps behind a facet for a field with unknown branch. A jump does not change the
        gaps to the periodic levels. Lanes of `passes_branch_level` have gaps to the true levels,
        and take those behind the facet."""
        down = dr.select(self.passes_branch_level, behind.below, self.gaps.below)
        return replace(
            self.gaps,
            below=down,
            above=dr.select(self.passes_branch_level, behind.above, self.gaps.above),
        )


@dataclass(frozen=True)
class March:
    """The parameters of the march: the levels, the hit tolerance and the lengths of trial steps.

    max_steps: the number of evaluations of f after which a ray is out of steps.
    over_relaxation: trial steps are at most this many times as long as the proved steps.
    hysteresis: for rays that end where they have crossed a level, and not where they reach it.
    cone_radius: for cones that end where they come near a level (`pixel_cones`): their radius per
        unit of t.
    occupied: for rays that end where they reach a level: cells outside of which there is no level,
        not even for a continuation of f behind a facet.
    ray_end: the ray parameter at which these rays end.
    only_component: whether levels may lie outside of the occupied cells; these do not count.
    branch_tracker: determines the branch of samples that give f only modulo 1; None if all samples
        know their branch.
    """

    backend: Backend
    levels: Levels
    tolerance: PreparedHitTolerance
    max_steps: Any
    over_relaxation: float
    hysteresis: Hysteresis | None = None
    cone_radius: Real | None = None
    occupied: EmptySpaceGrid | None = None
    ray_end: Real = 0.0
    only_component: bool = False
    branch_tracker: BranchTracker | None = None

    def advance(
        self,
        field: Field,
        path: Ray,
        end: Real,
        state: MarchState,
        ahead: JumpCrossing | None = None,
    ) -> MarchState:
        """March to the first level, or to the end.

        Proof that no hit is missed: `proved_to` is a point up to which the ray is free, and
        `proved_step` a proved length from there. A trial point, `trial_step` from there, is
        accepted only if `trial_step` is at most `proved_step`, or if an enclosure behind the trial
        point covers the difference; then the ray is free up to the trial point. Otherwise the ray
        goes back to proved_to + proved_step, which needs no such test. A ray ends as a miss when
        proved_to + proved_step passes its end, and as a hit only at an accepted point. A point
        whose sample is too coarse (`_refined_accuracy`) is not accepted but sampled again.

        A hit is a point at which f is within the tolerance, less the truncation error, of a level;
        or within twice the rounding error of f, if that is more. A trial point at which the level
        is nearer than the error of f may lie behind the root, by less than the tolerance: it is a
        hit (`_refined_accuracy`), so nothing is passed there. If it is no hit, because the error is
        large, then it is not accepted by an enclosure behind it, and no step from it is proved: it
        is not known on which side of the point the level lies.

        In rounded arithmetic a surface could be missed between the enclosure ahead of a point and
        the enclosure behind the next point. So for both, the level gaps are reduced by the rounding
        of value and position together (`value_error_bound`).

        With `hysteresis` the ray does not end where it reaches a level. It goes on towards levels
        as the hysteresis places them, and ends as a hit where it has crossed a level. There it may
        be made active again, to go on to the next level.

        With `cone_radius`, a whole cone must stay clear of the levels: gaps shrink by |grad f|
        times its radius, which grows with t. A tenth of a gap is reserved for the growth of the
        cone, and no step is longer than the cone takes to grow by it, unless the level is never met
        and f leaves it faster than the cone grows.

        With `occupied`, the ray after a proved step is passed, too, as far as it lies in cells that
        contain no level (`EmptySpaceGrid.empty_run` has the proof): a union of free
        intervals is free.

        With `only_component`, levels outside of `occupied` belong to other components of the
        surface. Proved steps end in occupied cells. A trial step that would end elsewhere is
        replaced by the proved step. So no hit lies outside of the occupied cells, and levels that
        are passed there do not count.

        ahead: for a field with jumps, the crossing at `end`, on lanes that have one. These lanes
            sample the point of the crossing as well. If it is accepted, they hit the facet or have
            passed it. A ray that has passed it ends as a miss, with the step that the value behind
            the facet allows from there. `value` is then the value behind the facet; without
            `hysteresis` not if the facet was hit.
        """

        def body(now: MarchState) -> MarchState:
            return self.next_trial(field, path, end, now, ahead)

        return loop_while_active(state, body, "harnack")

    def next_trial(
        self,
        field: Field,
        path: Ray,
        end: Real,
        now: MarchState,
        ahead: JumpCrossing | None = None,
    ) -> MarchState:
        """The state after one more trial point of each ray; `advance` has the proof."""
        seen = self._sample_trial(field, path, end, now, ahead)
        if self.hysteresis is not None and now.contact is not None:
            seen = self._apply_hysteresis(seen, self.hysteresis, now.contact)
        accepted, detail, too_coarse = self._accept(field, seen, now, ahead)
        fallback = now.proved_step
        if self.hysteresis is not None and now.contact is not None:
            tolerance = dr.fma(seen.t, self.tolerance.per_length, self.tolerance.distance)
            reaches = self.hysteresis.may_reach(now.contact, seen.band, now.trial_step, tolerance)
            reaches &= ~now.contact.is_touching | dr.isfinite(seen.total_error)
            shorter = fmin(now.proved_step, _RETRY_FRACTION * now.trial_step)
            fallback = dr.select(reaches | too_coarse, now.proved_step, shorter)
            accepted &= reaches

        # Is it a hit, a sheet, or a crossing?
        hit, gaps_ahead, sheet = accepted & seen.is_near, seen.gaps, None
        if ahead is not None:
            sheet = test_jump(
                ahead, accepted & seen.at_end, seen.value, seen.total_error, self.levels
            )
            gaps_ahead = (
                sheet.gaps if seen.passes_branch_level is None else seen.gaps_after_jump(sheet.gaps)
            )
        aims, contact, value = gaps_ahead, now.contact, seen.value
        if self.hysteresis is not None and now.contact is not None:
            contact, hit, sheet, value = self._update_contact(
                seen, self.hysteresis, now.contact, path, now, accepted, ahead, sheet
            )
            after = contact, value, self.levels.gaps(value), seen.band
            gaps_ahead, aims = (
                self.hysteresis.gaps(*after),
                self.hysteresis.gaps(*after, CONTACT_AIM),
            )
        elif sheet is not None and ahead is not None:
            value = value + dr.select(sheet.at_crossing & ~sheet.is_hit, ahead.jump, 0)

        # How far to go from there.
        proved = self._proved_step(seen, gaps_ahead, contact)
        trial = self._next_trial_step(proved, seen.look, aims, now, path, seen.is_smooth)
        forward = proved
        if self.occupied is not None:
            forward, trial = self._skip_empty_cells(
                self.occupied, path, end, seen, accepted, forward, trial
            )
        look_ahead = self._next_reach(now, seen, end, proved, contact, hit)
        proved_step = dr.select(accepted, forward, fallback)
        free = self._is_free(now, seen, end, accepted, proved_step, contact)
        if sheet is not None:
            free = dr.select(sheet.has_crossing, sheet.at_crossing, free)
        evaluations = now.evaluations + 1 + seen.looks
        status = self._status(hit, free)
        gradient = dr.select(accepted, seen.look.sample.gradient, now.gradient)
        if sheet is not None:
            status, gradient = sheet.mark(status, gradient)
        proved_to = dr.select(accepted, seen.t, now.proved_to)
        step = dr.select(accepted, trial, dr.select(too_coarse, now.trial_step, fallback))
        return MarchState(
            proved_to=proved_to,
            trial_step=fmin(step, end - proved_to),
            proved_step=proved_step,
            enclosure_reach=dr.select(accepted, look_ahead, now.enclosure_reach),
            value=dr.select(accepted, value, now.value),
            gradient=gradient,
            tolerance_excess=dr.select(accepted, seen.excess, now.tolerance_excess),
            evaluations=evaluations,
            accuracy_scale=detail,
            status=status,
            active=now.active & ~(hit | free | (evaluations >= self.max_steps)),
            contact=contact,
        )

    def _sample_trial(
        self, field: Field, path: Ray, end: Real, now: MarchState, ahead: JumpCrossing | None
    ) -> _TrialSample:
        """Sample f at the trial points of rays."""
        real = self.backend.Float
        t = now.proved_to + now.trial_step
        if ahead is not None or now.contact is not None:  # the end exactly
            t = dr.select(now.trial_step >= end - now.proved_to, end, t)
        seen, whole, is_modulo = field, self.branch_tracker, None
        if now.accuracy_scale is not None and field.has_variable_accuracy:
            knows = field.has_unknown_branch and whole is None
            seen = field.at_accuracy(fmax(now.accuracy_scale, 1) if knows else now.accuracy_scale)
        unproved, size = now.trial_step - now.proved_step, max_norm(path.origin) + t
        look = seen.sample_ray(path, t, fmin(now.enclosure_reach, end - t), fmax(unproved, real(0)))
        passes, is_doubtful, is_sure = None, None, None
        gradient_norm = safe_norm(look.sample.gradient)
        if whole is not None and look.sample.branch_unknown is not None:
            is_modulo = look.sample.branch_unknown
            error = value_error_bound(look.sample, gradient_norm, size)
            look, is_sure = whole.resolve(look, now.value, now.trial_step, error)
        sample = look.sample
        gaps = self.levels.gaps(sample.value)
        gap, total_error = gaps.nearest, value_error_bound(sample, gradient_norm, size)
        if whole is not None and is_modulo is not None and is_sure is not None:
            gaps, passes, is_doubtful = whole.gaps(sample, is_modulo, is_sure, total_error)
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(self.cone_radius * t * gradient_norm)
            gap = gaps.nearest
        steep = None
        if field.is_steep:
            look_ahead = fmin(now.enclosure_reach, end - t)
            steep = SteepPlace.at(field, self.levels, path, t, look_ahead, sample)
            total_error = total_error if steep.error is None else steep.error
        steepness = fmax(gradient_norm - sample.gradient_error, real(0))
        if look.slope_error is not None:  # the gradient is at least as long as its projection
            steepness = fmax(dr.abs(look.slope) - look.slope_error, steepness)
        if look.min_gradient_norm is not None:
            steepness = fmax(look.min_gradient_norm, steepness)
        if steep is not None:  # the gradient is no number where only slopes along the path are
            gradient_norm = fmax(gradient_norm, steepness)
        within = self.tolerance.value_tolerance(steepness, t)
        knows_gradient = (sample.gradient_error <= gradient_norm) | (steepness > 0)
        if self.hysteresis is not None:
            if field.is_steep:  # or what f has to swing is more than it does
                reach = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
                change = largest_change(field, path.point(t), sample.value, reach)
                within = fmax(fmin(within, change), self.tolerance.value)
            within = self.hysteresis.contact_tolerance(within)
        # Where not even the gradient is known, no hit is due to rounding.
        rounding = dr.select(knows_gradient, total_error - sample.truncation_error, 0)
        is_near = self._is_near(gap, within, total_error, rounding, look, gradient_norm, size, end)
        looks: Any = 0
        if steep is not None:
            may_be = steep.is_level
            is_near = (is_near | may_be) & now.active & dr.isfinite(total_error)
            is_near, looks = self._is_there(field, path, t, look, gaps, size, is_near, may_be)
        return _TrialSample(
            t=t,
            at_end=t == end,
            coordinate_size=size,
            unproved_length=unproved,
            look=look,
            gradient_norm=gradient_norm,
            gaps=gaps,
            total_error=total_error,
            value_tolerance=within,
            band=within,
            is_near=is_near,
            accepts_unknown_side=is_near,
            excess=fmax(gap + total_error - within, real(0)),
            is_smooth=ahead is None and not field.has_variable_accuracy,
            passes_branch_level=passes,
            needs_branch=is_doubtful,
            steep=steep,
            looks=looks,
        )

    def _is_there(
        self,
        field: Field,
        path: Ray,
        t: Real,
        look: RaySample,
        gaps: LevelGaps,
        size: Real,
        is_near: Mask,
        may_be: Mask,
    ) -> tuple[Mask, Any]:
        """Whether f really takes the level near points that are near it in value, and the number of
        evaluations that this test took.

        A point is near a level by its slope, or because f may equal the level within the rounding
        of the point. The test asks whether f takes the level within the tolerance, or within twice
        that rounding. It does if the enclosures prove it along the ray, or if a sample of f lies on
        the other side of the level or at it (`steep.beyond`).

        may_be: whether f may equal the level up to rounding.
        """
        sample, p = look.sample, path.point(t)
        tolerance = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
        slack = 8 * self.backend.machine_epsilon * size
        reach = fmax(tolerance, 2 * slack)
        sure = gaps.nearest <= self.tolerance.value
        for enclosure in look.forward:
            sure |= enclosure.arrives(gaps, reach)
        along = down_or_up(sample.gradient, gaps, path.direction)
        ways = (along, safe_norm(sample.gradient)), (path.direction, look.slope)
        unsure = is_near & ~sure
        passed, looks = beyond(
            self.backend, field, self.levels, gaps, p, ways, sample.value, reach, may_be, unsure
        )
        return is_near & (sure | passed), looks

    def _apply_hysteresis(
        self, seen: _TrialSample, hysteresis: Hysteresis, contact: Contact
    ) -> _TrialSample:
        """The same sample with gaps to the levels as the hysteresis places them. The band includes
        all rounding of f, or a ray would stick in a crease."""
        band = hysteresis.band(
            seen.value_tolerance, seen.total_error - seen.look.sample.truncation_error
        )
        may_pass = seen.accepts_unknown_side & ~contact.is_touching
        if self.levels.period is not None:  # here only the value tells the side of a level
            may_pass = self.backend.Bool(False)
        gaps = hysteresis.gaps(contact, seen.value, seen.gaps, band)
        return replace(
            seen,
            gaps=gaps,
            value_tolerance=CONTACT_TOLERANCE * seen.value_tolerance,
            band=band,
            accepts_unknown_side=may_pass,
        )

    def _accept(
        self, field: Field, seen: _TrialSample, now: MarchState, ahead: JumpCrossing | None
    ) -> tuple[Mask, Real | None, Mask]:
        """Whether the ray is proved free up to the trial point, by a sample that is not too coarse;
        the accuracy scale of the next sample; and whether this sample was too coarse."""
        accepted = now.trial_step <= now.proved_step
        if self.over_relaxation > 1:
            knows_side = seen.accepts_unknown_side | (seen.gaps.nearest > seen.total_error)
            covered = any_is_free(
                seen.look.backward, seen.gaps.reduced_by(seen.total_error), seen.unproved_length
            )
            accepted |= knows_side & covered
        is_known = dr.isfinite(seen.total_error)  # what is not known is not free
        if seen.steep is not None:  # values prove the next step
            is_known = is_known | (now.trial_step <= now.proved_step)
        if now.accuracy_scale is None or not field.has_variable_accuracy:
            return accepted & is_known, now.accuracy_scale, self.backend.Bool(False)
        truncation, coarsest = seen.look.sample.truncation_error, field.coarsest_accuracy
        deciding = self._deciding_gap(seen.value, ahead, seen.at_end)
        at = fmax(now.accuracy_scale, coarsest)
        finer, too_coarse = _refined_accuracy(
            at, deciding, seen.total_error, truncation, seen.value_tolerance
        )
        coarser = _next_accuracy(at, seen.gaps.nearest, truncation, coarsest)
        if seen.passes_branch_level is not None and seen.needs_branch is not None:
            too_coarse |= seen.needs_branch & accepted  # others go back in any case
            coarser = dr.select(
                seen.passes_branch_level, fmax(at, 1), coarser
            )  # the next knows it too
        accepted &= ~too_coarse & is_known
        detail = dr.select(too_coarse, finer, dr.select(accepted, coarser, now.accuracy_scale))
        return accepted, detail, too_coarse

    def _update_contact(
        self,
        seen: _TrialSample,
        hysteresis: Hysteresis,
        contact: Contact,
        path: Ray,
        now: MarchState,
        accepted: Mask,
        ahead: JumpCrossing | None,
        sheet: JumpTest | None,
    ) -> tuple[Contact, Mask, JumpTest | None, Real]:
        """The contact behind the trial point, whether rays have crossed the level, the comparison
        with the facet, and f behind the facet."""
        value = seen.value
        before = now.proved_to, now.value, dr.dot(now.gradient, path.direction), now.gradient
        last = seen.at_end if sheet is None else seen.at_end & ~sheet.has_crossing
        doubt = dr.select(
            seen.total_error > seen.value_tolerance, fmax(seen.excess, now.tolerance_excess), 0
        )
        there = AcceptedPoint(
            seen.t, value, seen.look.sample.gradient, seen.look.slope, before, doubt,
            seen.total_error, seen.is_near, seen.band, last,
        )  # fmt: skip
        contact, hit = hysteresis.update(contact, accepted, there)
        if ahead is not None and sheet is not None:
            # A crossing before the sheet comes first: the sheet will be sampled again.
            passed = sheet.at_crossing & ~hit
            contact, jumps = hysteresis.update_at_jump(
                contact, passed, there, ahead, path.direction
            )
            sheet = replace(sheet, at_crossing=passed, is_hit=jumps)
            value = value + dr.select(passed, ahead.jump, 0)
        return contact, hit, sheet, value

    def _proved_step(self, seen: _TrialSample, gaps: LevelGaps, contact: Contact | None) -> Real:
        """The length from the trial point that is proved free of levels with these gaps."""
        spent = _WIDENING * seen.gaps.nearest
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(spent)
        forward = longest_free_length(seen.look.forward, gaps.reduced_by(seen.total_error))
        if self.cone_radius is not None:
            slope, smallest = seen.look.slope, float(dr.smallest(self.backend.Float))
            widening = fmax(self.cone_radius * seen.gradient_norm, smallest)
            away = dr.select(seen.gaps.below <= seen.gaps.above, slope, -slope)
            for_ever = (forward == dr.inf) & (away >= widening)
            forward = dr.select(for_ever, forward, fmin(forward, spent / widening))
        forward = dr.select(gaps.nearest > seen.total_error, forward, 0)
        if seen.steep is not None and self.cone_radius is None:
            free = seen.steep.free
            if contact is not None:  # in contact, levels lie elsewhere
                free = dr.select(contact.is_touching, seen.steep.free_of(gaps), free)
            forward = fmax(free, forward)
        return forward

    def _skip_empty_cells(
        self,
        occupied: EmptySpaceGrid,
        path: Ray,
        end: Real,
        seen: _TrialSample,
        accepted: Mask,
        forward: Real,
        trial: Real,
    ) -> tuple[Real, Real]:
        """The proved step and the trial step, extended over empty cells that follow the proved
        step."""
        free_to = dr.select(accepted, seen.t + forward, self.ray_end)
        free_to = occupied.end_of_empty_run(path.origin, path.direction, free_to, self.ray_end)
        forward = fmax(forward, dr.select(free_to >= self.ray_end, dr.inf, free_to - seen.t))
        trial = fmax(trial, forward)
        if self.only_component:
            there = path.point(seen.t + fmin(trial, end - seen.t))
            trial = dr.select(occupied.cell(there).empty_distance > 0, forward, trial)
        return forward, trial

    def _next_reach(
        self,
        now: MarchState,
        seen: _TrialSample,
        end: Real,
        proved: Real,
        contact: Contact | None,
        hit: Mask,
    ) -> Real:
        """The length that the next enclosures should reach."""
        # After a step of zero, the next enclosures need reach only a third as far: bisection.
        candidate = fmin(now.enclosure_reach, end - seen.t)
        shorter = dr.select(dr.isfinite(candidate), candidate / 3, 1 + 16 * seen.coordinate_size)
        tried = dr.select(proved > 0, seen.look.reach_growth * proved, shorter)
        if now.contact is not None and contact is not None:  # off the surface: the whole ray again
            leaves = now.contact.is_touching & ~contact.is_touching
            tried = dr.select(leaves | hit, end - seen.t, tried)
        return tried

    def _is_free(
        self,
        now: MarchState,
        seen: _TrialSample,
        end: Real,
        accepted: Mask,
        proved_step: Real,
        contact: Contact | None,
    ) -> Mask:
        """Whether rays are proved free of levels up to their end."""
        farthest = float(dr.largest(self.backend.Float)) ** _MISS_EXPONENT
        proved_to = dr.select(accepted, seen.t, now.proved_to)
        free = proved_to + proved_step >= dr.select(end == dr.inf, farthest, end)
        if self.hysteresis is not None and contact is not None:
            free &= ~(accepted & self.hysteresis.must_sample_end(contact, end) & (seen.t < end))
        return free

    def _is_near(
        self,
        gap: Real,
        within: Real,
        total_error: Real,
        rounding: Real,
        look: RaySample,
        gradient_norm: Real,
        size: Real,
        end: Real,
    ) -> Mask:
        """Whether a level is near enough in value for a hit; see `advance`.

        within: the largest level gap that the tolerance allows.
        rounding: a bound of the rounding error of f.

        A point is no hit if rounding leaves the distance to the surface uncertain by more than a
        sixteenth of a size: the size of the coordinates or, if larger, the radius of the ball on
        which f is proved to be smooth. On a ray without an end, a point is no hit either if it is
        near a level only by rounding and rounding leaves t uncertain by more than that size: far
        enough away, rounding would make a hit of every ray that is parallel to the surface.
        """
        sample = look.sample
        near = gap <= fmax(within - sample.truncation_error, 2 * rounding)
        for promise in sample.promises:
            radius = promise.radius
            size = fmax(dr.select(dr.isfinite(radius), radius, 0), size)
        excess = gap + total_error - within
        crosses = (gap <= within - sample.truncation_error) | (end < dr.inf)
        crosses |= excess <= dr.abs(look.slope) * size
        return near & crosses & (excess <= _LARGEST_UNCERTAINTY * gradient_norm * size)

    def _next_trial_step(
        self,
        forward: Real,
        look: RaySample,
        gaps: LevelGaps,
        now: MarchState,
        path: Ray,
        is_smooth: bool,
    ) -> Real:
        """The next trial step, at least the proved step `forward`.

        It is longer by over-relaxation, but not past the point at which f is predicted to reach a
        level. The prediction need not be right: a trial must still be proved by an enclosure behind
        it.

        is_smooth: whether value and slope at the last accepted point help to predict f. They do not
            for an approximate field, whose truncation error differs from point to point.
        """
        slope = look.slope
        rate, gap = dr.abs(slope), dr.select(slope > 0, gaps.above, gaps.below)
        if is_smooth:
            bend = dr.mulsign(self._second_derivative(look, now, path), slope)
            root = dr.fma(rate, rate, 2 * bend * gap)
            target = _TRIAL_AIM * dr.select(root >= 0, 2 * gap / (rate + dr.sqrt(root)), dr.inf)
        else:
            target = _AIM_BY_SLOPE * dr.select(rate > 0, gap / rate, dr.inf)
        return fmin(self.over_relaxation * forward, fmax(target, forward))

    def _second_derivative(self, look: RaySample, now: MarchState, path: Ray) -> Real:
        """The second derivative, at the trial point, of the cubic with the values and slopes of f
        at the trial point and at the last accepted point, a length h before; 0 if no point was
        accepted before.

        With D the difference quotient and s0, s the slopes: 2 (2s + s0 - 3D)/h (Hermite).
        """
        h, slope, before = now.trial_step, look.slope, dr.dot(now.gradient, path.direction)
        rise = look.sample.value - now.value
        if self.levels.period is not None:  # the lift that the slopes predict
            turns = dr.round((rise - 0.5 * h * (slope + before)) / self.levels.period)
            rise = dr.fma(turns, -self.levels.period, rise)
        known = (now.evaluations > 0) & (h > 0)
        return dr.select(known, 2 * (2 * slope + before - 3 * rise / h) / h, 0)

    def _status(self, hit: Mask, free: Mask) -> Any:
        """The status of a ray that ends here."""
        ended = dr.select(free, int(RayStatus.MISS), int(RayStatus.OUT_OF_STEPS))
        return self.backend.UInt32(dr.select(hit, int(RayStatus.HIT), ended))

    def _deciding_gap(self, value: Real, ahead: JumpCrossing | None, at_end: Mask | None) -> Real:
        """The gap from f to the nearest level; at a facet, the smaller of the gaps from f before
        and behind the facet."""
        gap = self.levels.gaps(value).nearest
        if ahead is not None:
            behind = self.levels.gaps(value + ahead.jump).nearest
            gap = dr.select(at_end & (ahead.facet != NO_FACET), fmin(gap, behind), gap)
        return gap


def _refined_accuracy(
    detail: Real, gap: Real, total_error: Real, truncation: Real, within: Real
) -> tuple[Real, Mask]:
    """The accuracy scale for a repeated sample, and whether the sample of this scale is too coarse.

    detail, total_error, truncation: the accuracy scale, total error and truncation error of the
        sample.
    gap: the gap from f to the nearest level.
    within: the value tolerance of a hit.

    A sample is too coarse if its error shortens the step by much or decides about a hit, unless its
    truncation error is a small part of `within` or of the rounding error, which a higher accuracy
    does not reduce. With the truncation error that is allowed, the march still arrives at hits: its
    steps end where a level is as near as `total_error`, and 1.25 times that is less than the gap
    that makes a hit (within - truncation, or twice the rounding).
    """
    rounding = total_error - truncation
    allowed = fmax(
        _TRUNCATION_OF_TOLERANCE * within - _LESS_ROUNDINGS * rounding,
        _TRUNCATION_OF_ROUNDING * rounding,
    )
    again = (gap < _REFINE_BELOW * total_error) & (truncation > allowed) & (detail < _MAX_ACCURACY)
    wanted = fmax(_TRUNCATION_OF_GAP * gap, _TRUNCATION_OF_ALLOWED * allowed)
    closer = clamp(dr.power(truncation / wanted, 1 / _TRUNCATION_ORDER), *_REFINEMENT_LIMITS)
    return fmin(fmax(detail * closer, 1), _MAX_ACCURACY), again


def _next_accuracy(detail: Real, gap: Real, truncation: Real, coarsest: float) -> Real:
    """The accuracy scale of the next sample: 0 (coarsest) or at least 1, and never above `detail`,
    the scale of this sample. truncation, gap: of this sample."""
    wanted = detail * dr.power(truncation / (_COARSEN * gap), 1 / _TRUNCATION_ORDER)
    return dr.select(wanted > coarsest, fmin(fmax(wanted, 1), detail), 0)
