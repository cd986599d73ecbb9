"""The marching loop, the only one of the tracer. It finds the first point of each ray at which a
field takes a level, with a proof of every step.

The loop depends neither on the kind of field nor on the kind of proof. It samples a field f along
the ray. Each sample brings enclosures, intervals that provably contain the change of f along the
ray, and they tell on which length the ray meets no level.

Trial steps are aimed: a step is longer than the proved length, but it ends just short of the point
    at which f is predicted to reach a level. Without this, half of the samples near the surface
    were rejected. The prediction comes from the cubic through the last two values and slopes for
    smooth fields, and from the slope alone for approximate fields.

The state of the march is a record, which `backend.loops` takes apart and puts together for Dr.Jit's
loop. For fields with jumps, the march also compares the value at the end of its interval with the
jump there. `jump_tracer.JumpTracer`, which goes from jump to jump, calls the march.
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
_TRUNCATION_OF_TOLERANCE, _ROUNDING_DEDUCTION, _TRUNCATION_OF_ROUNDING = 0.4, 0.55, 0.6
# The next sample may be so coarse that its truncation error is this fraction of the level gap.
_COARSE_FRACTION = 0.2
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
_GROWTH_FRACTION = 0.1
# The accuracy scale of a repeated sample is larger by these factors at least and at most.
_REFINEMENT_LIMITS = 1.25, 16.0
# Truncation falls as this power of the accuracy scale; beyond the largest scale there is none.
_TRUNCATION_ORDER, _MAX_ACCURACY = 3.2, 1e6
# In contact, a step that leads to where the band is much smaller is tried again with this fraction
# of its length.
_RETRY_FRACTION = 0.125


@dataclass(frozen=True)
class MarchState:
    """The state of rays during the march, with one entry for each ray.

    proved_to: the ray parameter of the last accepted point; f takes no level on the ray up
        to there.
    proved_step: a length from there on which f takes no level, either.
    trial_step: the length from there to the next trial point.
    enclosure_reach: the length on which the next sample should enclose the change of f.
    value, gradient: f and its gradient (3,) at `proved_to`; behind the jump, if f jumps there.
    tolerance_excess: by how much |f - level| at `proved_to` may exceed what the tolerance allows,
        because of rounding.
    evaluations: the number of evaluations of f so far.
    accuracy_scale: the accuracy scale of the next sample (`Field.at_accuracy`), larger for more
        accurate samples; None for fields with a single accuracy (Dr.Jit records a loop twice if a
        state in it never changes).
    status: the `RayStatus` of rays that have ended.
    active: whether the ray goes on.
    contact: for rays that end only where they cross a level, the level that they reached last: from
        which side they reached it, and whether f is still within the tolerance of it. None for rays
        that end where they reach a level.
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

        start, end: the ray parameters between which rays are traced; rays without start < end are
            not active.
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
    """The sample at the trial point of each ray, and quantities that are derived from it.

    t: the ray parameter of the trial point.
    at_end: whether the ray, or its interval before the next jump of f, ends there.
    coordinate_size: a bound of the absolute values of coordinates on the ray up to there.
    unproved_length: the length before the point that no step has proved free of levels yet.
    on_ray: the sample of f there, with its enclosures (intervals that provably contain the change
        of f along the ray).
    gradient_norm: the length of the gradient there.
    gaps: the differences between f and the next levels below and above; in contact with a level, to
        levels that the hysteresis has moved.
    total_error: a bound of the rounding and truncation error of f.
    value_tolerance: the largest |f - level| at a hit; in contact, half of it.
    band: in contact, the tolerance in value around a level (`Hysteresis.band`); else
        `value_tolerance`.
    is_near: whether a level is near enough for a hit.
    accepts_unknown_side: whether the point may be accepted although rounding hides on which side of
        a level it lies.
    excess: by how much |f - level| may exceed `value_tolerance`, because of rounding.
    is_smooth: whether value and slope at two points predict f.
    passes_branch_level, needs_branch: for samples that gave f only modulo an integer, the two masks
        that `BranchTracker.gaps` returns; else None.
    steep: bounds that rest on ranges of values of f; None for fields whose slopes are bounded.
    extra_evaluations: the number of evaluations of f besides that at the trial point.
    """

    t: Real
    at_end: Mask
    coordinate_size: Real
    unproved_length: Real
    on_ray: RaySample
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
    extra_evaluations: Any = 0

    @property
    def value(self) -> Real:
        """f at the trial points."""
        return self.on_ray.sample.value

    def gaps_after_jump(self, behind: LevelGaps) -> LevelGaps:
        """The differences between f behind a jump and the next levels, for a field whose samples
        give f only modulo 1. The jump is an integer, so the differences to levels modulo 1 stay as
        they are. On lanes of `passes_branch_level` the differences are to true levels and are
        replaced by those in `behind`."""
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
    over_relaxation: trial steps are at most this many times as long as proved steps.
    hysteresis: for rays that end where they have crossed a level, the rule by which a crossing is
        counted; None for rays that end where they reach a level.
    cone_radius: for cones that end where they come near a level (`pixel_cones`), their radius per
        unit of t; None for rays.
    occupied: for rays that end where they reach a level, a grid of cells. Outside of its marked
        cells there is no level, not even for the function that continues f behind a jump. None if
        no cells are known.
    ray_end: the ray parameter at which rays with `occupied` end.
    only_component: whether levels may lie outside of the marked cells, but do not belong to the
        surface.
    branch_tracker: finds the integer that is missing in samples that give f only modulo 1; None if
        there are no such samples.
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
        """March each ray to the first level or to its end, and return the state there.

        field, path: the function f and the rays.
        end: the ray parameter at which each ray, or its interval before the next jump of f, ends.
        ahead: for a field with jumps, the crossing of a facet (a flat piece of surface at which f
            jumps) at `end`; its facet is NO_FACET on lanes without one. On lanes with one, the
            point of the crossing is sampled as well. If this point is accepted, the ray has hit the
            facet or passed it. A ray that has passed it ends as a miss, with the step that the
            value behind the facet allows from there. `value` is then f behind the facet; but if the
            facet was hit by a ray without `hysteresis`, f before it.

        Proof that no hit is missed. `proved_to` is a point before which no level lies, and
        `proved_step` is a proved length from there. A trial point, at the distance `trial_step`
        from `proved_to`, is accepted in two cases only: if `trial_step` is at most `proved_step`,
        or if an enclosure that reaches back from the trial point covers the difference. In both
        cases no level lies before the trial point. Otherwise the next trial point is proved_to +
        proved_step, which needs no such test. A ray ends as a miss if proved_to + proved_step
        passes its end, and as a hit only at an accepted point. A point whose sample is too coarse
        (`_refined_accuracy`) is not accepted but sampled again.

        Hits. At a hit, |f - level| is at most the tolerance less the truncation error of f, or at
        most twice the rounding error of f if that is larger. If the level is nearer to f than the
        error of f, the trial point may lie behind the root, by less than the tolerance. Then it is
        a hit (`_refined_accuracy`), so no root is passed. If it is no hit, because the error is
        large, then no enclosure that reaches back makes it accepted, and no step from it is proved,
        as it is not known on which side of the point the level lies.

        Rounding. A surface could be missed between the enclosure that reaches ahead from a point
        and the enclosure that reaches back from the next point. So for both enclosures the
        differences between f and the levels are reduced by the rounding of value and position
        (`value_error_bound`).

        With `hysteresis`, the ray does not end where it reaches a level. It goes on towards levels
        that the hysteresis has moved, and ends as a hit when it has crossed a level. The caller may
        make it active again, to go on to the next level.

        With `cone_radius`, a whole cone must stay clear of the levels. The differences between f
        and the levels shrink by |grad f| times the radius of the cone, which grows with t. A tenth
        of a difference is reserved for this growth: no step is longer than the length on which the
        cone grows by that much, unless the level is never met and f moves away from it faster than
        the cone grows.

        With `occupied`, the part of the ray behind a proved step is skipped, too, as far as it lies
        in cells that contain no level (`EmptySpaceGrid.empty_run` has the proof).

        With `only_component`, levels outside of the marked cells belong to other components of the
        surface. Proved steps end in marked cells, and a trial step that would end elsewhere is
        replaced by the proved step. So no hit lies outside of the marked cells, and levels that are
        passed there do not count.
        """

        def one_trial(now: MarchState) -> MarchState:
            """One more trial point of each ray."""
            return self.next_trial(field, path, end, now, ahead)

        return loop_while_active(state, one_trial, "harnack")

    def next_trial(
        self,
        field: Field,
        path: Ray,
        end: Real,
        now: MarchState,
        ahead: JumpCrossing | None = None,
    ) -> MarchState:
        """The state after one more trial point of each ray. Parameters and proof are those of
        `advance`, whose loop calls this; now: the state before."""
        trial = self._sample_trial(field, path, end, now, ahead)
        if self.hysteresis is not None and now.contact is not None:
            trial = self._apply_hysteresis(trial, self.hysteresis, now.contact)
        accepted, accuracy, too_coarse = self._accept(field, trial, now, ahead)
        fallback = now.proved_step
        if self.hysteresis is not None and now.contact is not None:
            tolerance = dr.fma(trial.t, self.tolerance.per_length, self.tolerance.distance)
            reaches = self.hysteresis.may_reach(now.contact, trial.band, now.trial_step, tolerance)
            reaches &= ~now.contact.is_touching | dr.isfinite(trial.total_error)
            shorter = fmin(now.proved_step, _RETRY_FRACTION * now.trial_step)
            fallback = dr.select(reaches | too_coarse, now.proved_step, shorter)
            accepted &= reaches

        # Is the trial point a hit, a facet, or a crossing?
        is_hit, gaps_ahead, jump = accepted & trial.is_near, trial.gaps, None
        if ahead is not None:
            jump = test_jump(
                ahead, accepted & trial.at_end, trial.value, trial.total_error, self.levels
            )
            gaps_ahead = (
                jump.gaps if trial.passes_branch_level is None else trial.gaps_after_jump(jump.gaps)
            )
        aim_gaps, contact, value = gaps_ahead, now.contact, trial.value
        if self.hysteresis is not None and now.contact is not None:
            contact, is_hit, jump, value = self._update_contact(
                trial, self.hysteresis, now.contact, path, now, accepted, ahead, jump
            )
            arguments = contact, value, self.levels.gaps(value), trial.band
            gaps_ahead, aim_gaps = (
                self.hysteresis.gaps(*arguments),
                self.hysteresis.gaps(*arguments, CONTACT_AIM),
            )
        elif jump is not None and ahead is not None:
            value = value + dr.select(jump.at_crossing & ~jump.is_hit, ahead.jump, 0)

        # The step from the trial point.
        proved = self._proved_step(trial, gaps_ahead, contact)
        next_step = self._next_trial_step(
            proved, trial.on_ray, aim_gaps, now, path, trial.is_smooth
        )
        forward = proved
        if self.occupied is not None:
            forward, next_step = self._skip_empty_cells(
                self.occupied, path, end, trial, accepted, forward, next_step
            )
        reach = self._next_reach(now, trial, end, proved, contact, is_hit)
        proved_step = dr.select(accepted, forward, fallback)
        is_free = self._is_free(now, trial, end, accepted, proved_step, contact)
        if jump is not None:
            is_free = dr.select(jump.has_crossing, jump.at_crossing, is_free)
        evaluations = now.evaluations + 1 + trial.extra_evaluations
        status = self._status(is_hit, is_free)
        gradient = dr.select(accepted, trial.on_ray.sample.gradient, now.gradient)
        if jump is not None:
            status, gradient = jump.mark(status, gradient)
        proved_to = dr.select(accepted, trial.t, now.proved_to)
        step = dr.select(accepted, next_step, dr.select(too_coarse, now.trial_step, fallback))
        return MarchState(
            proved_to=proved_to,
            trial_step=fmin(step, end - proved_to),
            proved_step=proved_step,
            enclosure_reach=dr.select(accepted, reach, now.enclosure_reach),
            value=dr.select(accepted, value, now.value),
            gradient=gradient,
            tolerance_excess=dr.select(accepted, trial.excess, now.tolerance_excess),
            evaluations=evaluations,
            accuracy_scale=accuracy,
            status=status,
            active=now.active & ~(is_hit | is_free | (evaluations >= self.max_steps)),
            contact=contact,
        )

    def _sample_trial(
        self, field: Field, path: Ray, end: Real, now: MarchState, ahead: JumpCrossing | None
    ) -> _TrialSample:
        """Sample f at the trial point of each ray, `trial_step` behind the last accepted point, and
        derive all of a `_TrialSample`. ahead: the facet at the end of the interval, for a field
        with jumps."""
        real = self.backend.Float
        t = now.proved_to + now.trial_step
        if ahead is not None or now.contact is not None:  # the end exactly
            t = dr.select(now.trial_step >= end - now.proved_to, end, t)
        scaled, tracker, is_modulo = field, self.branch_tracker, None
        if now.accuracy_scale is not None and field.has_variable_accuracy:
            needs_branch = field.has_unknown_branch and tracker is None
            scaled = field.at_accuracy(
                fmax(now.accuracy_scale, 1) if needs_branch else now.accuracy_scale
            )
        unproved, size = now.trial_step - now.proved_step, max_norm(path.origin) + t
        ray_sample = scaled.sample_ray(
            path, t, fmin(now.enclosure_reach, end - t), fmax(unproved, real(0))
        )
        passes_level, is_unsure, is_sure = None, None, None
        gradient_norm = safe_norm(ray_sample.sample.gradient)
        if tracker is not None and ray_sample.sample.branch_unknown is not None:
            is_modulo = ray_sample.sample.branch_unknown
            error = value_error_bound(ray_sample.sample, gradient_norm, size)
            ray_sample, is_sure = tracker.resolve(ray_sample, now.value, now.trial_step, error)
        sample = ray_sample.sample
        gaps = self.levels.gaps(sample.value)
        gap, total_error = gaps.nearest, value_error_bound(sample, gradient_norm, size)
        if tracker is not None and is_modulo is not None and is_sure is not None:
            gaps, passes_level, is_unsure = tracker.gaps(sample, is_modulo, is_sure, total_error)
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(self.cone_radius * t * gradient_norm)
            gap = gaps.nearest
        steep = None
        if field.is_steep:
            length = fmin(now.enclosure_reach, end - t)
            steep = SteepPlace.at(field, self.levels, path, t, length, sample)
            total_error = total_error if steep.error is None else steep.error
        steepness = fmax(gradient_norm - sample.gradient_error, real(0))
        if ray_sample.slope_error is not None:  # the gradient is at least as long as its projection
            steepness = fmax(dr.abs(ray_sample.slope) - ray_sample.slope_error, steepness)
        if ray_sample.min_gradient_norm is not None:
            steepness = fmax(ray_sample.min_gradient_norm, steepness)
        if steep is not None:  # the gradient is no number where only slopes along the path are
            gradient_norm = fmax(gradient_norm, steepness)
        within = self.tolerance.value_tolerance(steepness, t)
        knows_gradient = (sample.gradient_error <= gradient_norm) | (steepness > 0)
        if self.hysteresis is not None:
            if field.is_steep:  # otherwise f would have to change by more than it does
                reach = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
                change = largest_change(field, path.point(t), sample.value, reach)
                within = fmax(fmin(within, change), self.tolerance.value)
            within = self.hysteresis.contact_tolerance(within)
        # Where not even the gradient is known, no hit is due to rounding.
        rounding = dr.select(knows_gradient, total_error - sample.truncation_error, 0)
        is_near = self._is_near(
            gap, within, total_error, rounding, ray_sample, gradient_norm, size, end
        )
        evaluations: Any = 0
        if steep is not None:
            touches = steep.is_level
            is_near = (is_near | touches) & now.active & dr.isfinite(total_error)
            is_near, evaluations = self._confirms_level(
                field, path, t, ray_sample, gaps, size, is_near, touches
            )
        return _TrialSample(
            t=t,
            at_end=t == end,
            coordinate_size=size,
            unproved_length=unproved,
            on_ray=ray_sample,
            gradient_norm=gradient_norm,
            gaps=gaps,
            total_error=total_error,
            value_tolerance=within,
            band=within,
            is_near=is_near,
            accepts_unknown_side=is_near,
            excess=fmax(gap + total_error - within, real(0)),
            is_smooth=ahead is None and not field.has_variable_accuracy,
            passes_branch_level=passes_level,
            needs_branch=is_unsure,
            steep=steep,
            extra_evaluations=evaluations,
        )

    def _confirms_level(
        self,
        field: Field,
        path: Ray,
        t: Real,
        ray_sample: RaySample,
        gaps: LevelGaps,
        size: Real,
        is_near: Mask,
        touches: Mask,
    ) -> tuple[Mask, Any]:
        """Mask of points at which f really takes the level nearby, and the number of evaluations
        that this test took. It is for fields whose slopes are not bounded.

        gaps: the differences between f at the point and the next levels.
        size: a bound of the coordinates.
        is_near: mask of points that count as near a level, by the slope of f or because rounding of
            the point may hide the level.
        touches: whether f may equal the level up to rounding.

        The test asks whether f takes the level within the tolerance, or within twice the rounding
        of the point. It does if the enclosures (intervals that contain the change of f along the
        ray) prove it, or if a sample of f lies at the level or on its other side (`steep.beyond`).
        """
        sample, p = ray_sample.sample, path.point(t)
        tolerance = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
        slack = 8 * self.backend.machine_epsilon * size
        reach = fmax(tolerance, 2 * slack)
        proved = gaps.nearest <= self.tolerance.value
        for enclosure in ray_sample.forward:
            proved |= enclosure.arrives(gaps, reach)
        toward = down_or_up(sample.gradient, gaps, path.direction)
        ways = (toward, safe_norm(sample.gradient)), (path.direction, ray_sample.slope)
        unsure = is_near & ~proved
        passed, evaluations = beyond(
            self.backend,
            field,
            self.levels,
            gaps,
            p,
            ways,
            sample.value,
            reach,
            touches,
            unsure,
        )
        return is_near & (proved | passed), evaluations

    def _apply_hysteresis(
        self, trial: _TrialSample, hysteresis: Hysteresis, contact: Contact
    ) -> _TrialSample:
        """The same sample with gaps, the differences between f and the next levels, to levels that
        the hysteresis has moved. The band (the tolerance in value around a level) includes all
        rounding of f; otherwise a ray would get stuck in a crease."""
        band = hysteresis.band(
            trial.value_tolerance, trial.total_error - trial.on_ray.sample.truncation_error
        )
        may_pass = trial.accepts_unknown_side & ~contact.is_touching
        if self.levels.period is not None:  # here only the value tells the side of a level
            may_pass = self.backend.Bool(False)
        gaps = hysteresis.gaps(contact, trial.value, trial.gaps, band)
        return replace(
            trial,
            gaps=gaps,
            value_tolerance=CONTACT_TOLERANCE * trial.value_tolerance,
            band=band,
            accepts_unknown_side=may_pass,
        )

    def _accept(
        self, field: Field, trial: _TrialSample, now: MarchState, ahead: JumpCrossing | None
    ) -> tuple[Mask, Real | None, Mask]:
        """Three arrays. The mask of trial points that are accepted: no level lies before them, and
        their sample is not too coarse. The accuracy scale of the next sample. The mask of samples
        that were too coarse."""
        accepted = now.trial_step <= now.proved_step
        if self.over_relaxation > 1:
            knows_side = trial.accepts_unknown_side | (trial.gaps.nearest > trial.total_error)
            proved = any_is_free(
                trial.on_ray.backward,
                trial.gaps.reduced_by(trial.total_error),
                trial.unproved_length,
            )
            accepted |= knows_side & proved
        is_known = dr.isfinite(trial.total_error)  # without an error bound nothing is free
        if trial.steep is not None:  # values prove the next step
            is_known = is_known | (now.trial_step <= now.proved_step)
        if now.accuracy_scale is None or not field.has_variable_accuracy:
            return accepted & is_known, now.accuracy_scale, self.backend.Bool(False)
        truncation, coarsest = trial.on_ray.sample.truncation_error, field.coarsest_accuracy
        deciding = self._deciding_gap(trial.value, ahead, trial.at_end)
        accuracy = fmax(now.accuracy_scale, coarsest)
        finer, too_coarse = _refined_accuracy(
            accuracy, deciding, trial.total_error, truncation, trial.value_tolerance
        )
        coarser = _next_accuracy(accuracy, trial.gaps.nearest, truncation, coarsest)
        if trial.passes_branch_level is not None and trial.needs_branch is not None:
            too_coarse |= trial.needs_branch & accepted  # others go back in any case
            coarser = dr.select(
                trial.passes_branch_level, fmax(accuracy, 1), coarser
            )  # the next knows it too
        accepted &= ~too_coarse & is_known
        scale = dr.select(too_coarse, finer, dr.select(accepted, coarser, now.accuracy_scale))
        return accepted, scale, too_coarse

    def _update_contact(
        self,
        trial: _TrialSample,
        hysteresis: Hysteresis,
        contact: Contact,
        path: Ray,
        now: MarchState,
        accepted: Mask,
        ahead: JumpCrossing | None,
        jump: JumpTest | None,
    ) -> tuple[Contact, Mask, JumpTest | None, Real]:
        """The contact with a level behind the trial point, the mask of rays that have crossed the
        level, the comparison with the facet at the end of the interval, and f behind that facet.

        now: the state before the trial point.
        accepted: mask of accepted trial points.
        ahead, jump: for a field with jumps, the facet at the end of the interval and its comparison
            with the level; else None.
        """
        value = trial.value
        previous = now.proved_to, now.value, dr.dot(now.gradient, path.direction), now.gradient
        is_last = trial.at_end if jump is None else trial.at_end & ~jump.has_crossing
        excess = dr.select(
            trial.total_error > trial.value_tolerance, fmax(trial.excess, now.tolerance_excess), 0
        )
        point = AcceptedPoint(
            trial.t, value, trial.on_ray.sample.gradient, trial.on_ray.slope, previous, excess,
            trial.total_error, trial.is_near, trial.band, is_last,
        )  # fmt: skip
        contact, crosses = hysteresis.update(contact, accepted, point)
        if ahead is not None and jump is not None:
            # A crossing before the facet comes first: the facet will be sampled again.
            passed = jump.at_crossing & ~crosses
            contact, is_hit = hysteresis.update_at_jump(
                contact, passed, point, ahead, path.direction
            )
            jump = replace(jump, at_crossing=passed, is_hit=is_hit)
            value = value + dr.select(passed, ahead.jump, 0)
        return contact, crosses, jump, value

    def _proved_step(self, trial: _TrialSample, gaps: LevelGaps, contact: Contact | None) -> Real:
        """The length from the trial point on which no level lies. gaps: the differences between f
        there and the next levels. contact: the contact with a level behind the point; None if rays
        end at levels."""
        growth = _GROWTH_FRACTION * trial.gaps.nearest
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(growth)
        forward = longest_free_length(trial.on_ray.forward, gaps.reduced_by(trial.total_error))
        if self.cone_radius is not None:
            slope, smallest = trial.on_ray.slope, float(dr.smallest(self.backend.Float))
            widening = fmax(self.cone_radius * trial.gradient_norm, smallest)
            leaving = dr.select(trial.gaps.below <= trial.gaps.above, slope, -slope)
            endless = (forward == dr.inf) & (leaving >= widening)
            forward = dr.select(endless, forward, fmin(forward, growth / widening))
        forward = dr.select(gaps.nearest > trial.total_error, forward, 0)
        if trial.steep is not None and self.cone_radius is None:
            length = trial.steep.free
            if contact is not None:  # in contact, levels lie elsewhere
                length = dr.select(contact.is_touching, trial.steep.free_of(gaps), length)
            forward = fmax(length, forward)
        return forward

    def _skip_empty_cells(
        self,
        occupied: EmptySpaceGrid,
        path: Ray,
        end: Real,
        point: _TrialSample,
        accepted: Mask,
        forward: Real,
        trial: Real,
    ) -> tuple[Real, Real]:
        """The proved step and the trial step, extended over the empty cells that follow the proved
        step.

        point: the sample at the trial point, and `accepted` the mask of lanes on which it was
            accepted.
        forward, trial: the proved step and the trial step from there.
        """
        free_to = dr.select(accepted, point.t + forward, self.ray_end)
        free_to = occupied.end_of_empty_run(path.origin, path.direction, free_to, self.ray_end)
        forward = fmax(forward, dr.select(free_to >= self.ray_end, dr.inf, free_to - point.t))
        trial = fmax(trial, forward)
        if self.only_component:
            target = path.point(point.t + fmin(trial, end - point.t))
            trial = dr.select(occupied.cell(target).empty_distance > 0, forward, trial)
        return forward, trial

    def _next_reach(
        self,
        now: MarchState,
        trial: _TrialSample,
        end: Real,
        proved: Real,
        contact: Contact | None,
        is_hit: Mask,
    ) -> Real:
        """The length on which the next sample should enclose the change of f: a multiple of the
        proved step `proved`, or a third of the present length if no step was proved. A ray that has
        just left a level, or hit it, gets the rest of the ray again."""
        # After a step of zero, the next enclosures need reach only a third as far: bisection.
        candidate = fmin(now.enclosure_reach, end - trial.t)
        shorter = dr.select(dr.isfinite(candidate), candidate / 3, 1 + 16 * trial.coordinate_size)
        reach = dr.select(proved > 0, trial.on_ray.reach_growth * proved, shorter)
        if now.contact is not None and contact is not None:  # off the surface: the whole ray again
            leaves = now.contact.is_touching & ~contact.is_touching
            reach = dr.select(leaves | is_hit, end - trial.t, reach)
        return reach

    def _is_free(
        self,
        now: MarchState,
        trial: _TrialSample,
        end: Real,
        accepted: Mask,
        proved_step: Real,
        contact: Contact | None,
    ) -> Mask:
        """Mask of rays on which no level lies up to their end."""
        farthest = float(dr.largest(self.backend.Float)) ** _MISS_EXPONENT
        proved_to = dr.select(accepted, trial.t, now.proved_to)
        is_free = proved_to + proved_step >= dr.select(end == dr.inf, farthest, end)
        if self.hysteresis is not None and contact is not None:
            is_free &= ~(accepted & self.hysteresis.must_sample_end(contact, end) & (trial.t < end))
        return is_free

    def _is_near(
        self,
        gap: Real,
        within: Real,
        total_error: Real,
        rounding: Real,
        ray_sample: RaySample,
        gradient_norm: Real,
        size: Real,
        end: Real,
    ) -> Mask:
        """Mask of trial points at which a level is near enough in value for a hit, as `advance`
        states.

        gap: the difference between f and the nearest level.
        within: the largest such difference that the tolerance allows.
        total_error, rounding: bounds of the error of f, and of its part due to rounding.
        size: a bound of the coordinates.

        A point is no hit if rounding leaves the distance to the surface uncertain by more than a
            sixteenth of a length L: the size of the coordinates or, if larger, the radius of the
            ball in which f is proved to be smooth. On a ray without an end, there is a second
            condition. If only rounding brings the point near the level, it is no hit if rounding
            leaves t uncertain by more than L. Otherwise, far enough away, rounding would make a hit
            of every ray parallel to the surface.
        """
        sample = ray_sample.sample
        near = gap <= fmax(within - sample.truncation_error, 2 * rounding)
        for promise in sample.promises:
            radius = promise.radius
            size = fmax(dr.select(dr.isfinite(radius), radius, 0), size)
        excess = gap + total_error - within
        may_hit = (gap <= within - sample.truncation_error) | (end < dr.inf)
        may_hit |= excess <= dr.abs(ray_sample.slope) * size
        return near & may_hit & (excess <= _LARGEST_UNCERTAINTY * gradient_norm * size)

    def _next_trial_step(
        self,
        forward: Real,
        ray_sample: RaySample,
        gaps: LevelGaps,
        now: MarchState,
        path: Ray,
        is_smooth: bool,
    ) -> Real:
        """The length of the next trial step, at least the proved step `forward`.

        The trial step is longer by over-relaxation, but does not pass the point at which f is
        predicted to reach a level. The prediction may be wrong without harm: a trial point is
        accepted only if an enclosure of the change of f, back to the proved length, proves it.

        gaps: the differences between f and the next levels.
        now: the state at the last accepted point.
        is_smooth: whether value and slope at the last accepted point help to predict f. They do not
            for an approximate field, whose truncation error differs from point to point.
        """
        slope = ray_sample.slope
        rate, gap = dr.abs(slope), dr.select(slope > 0, gaps.above, gaps.below)
        if is_smooth:
            second = dr.mulsign(self._second_derivative(ray_sample, now, path), slope)
            root = dr.fma(rate, rate, 2 * second * gap)
            target = _TRIAL_AIM * dr.select(root >= 0, 2 * gap / (rate + dr.sqrt(root)), dr.inf)
        else:
            target = _AIM_BY_SLOPE * dr.select(rate > 0, gap / rate, dr.inf)
        return fmin(self.over_relaxation * forward, fmax(target, forward))

    def _second_derivative(self, ray_sample: RaySample, now: MarchState, path: Ray) -> Real:
        """The second derivative at the trial point, along the ray, of the cubic that has the values
        and slopes of f at the trial point and at the last accepted point; 0 if no point was
        accepted before.

        With h the distance of the two points, D the difference quotient, and s0 and s the slopes at
        the accepted and the trial point, it is 2 (2s + s0 - 3D)/h (Hermite).
        """
        h, slope, slope_before = (
            now.trial_step,
            ray_sample.slope,
            dr.dot(now.gradient, path.direction),
        )
        rise = ray_sample.sample.value - now.value
        if self.levels.period is not None:  # the lift that the slopes predict
            periods = dr.round((rise - 0.5 * h * (slope + slope_before)) / self.levels.period)
            rise = dr.fma(periods, -self.levels.period, rise)
        has_before = (now.evaluations > 0) & (h > 0)
        return dr.select(has_before, 2 * (2 * slope + slope_before - 3 * rise / h) / h, 0)

    def _status(self, is_hit: Mask, is_free: Mask) -> Any:
        """The `RayStatus` with which a ray ends: HIT on lanes of `is_hit`, MISS on other lanes of
        `is_free`, else OUT_OF_STEPS."""
        ended = dr.select(is_free, int(RayStatus.MISS), int(RayStatus.OUT_OF_STEPS))
        return self.backend.UInt32(dr.select(is_hit, int(RayStatus.HIT), ended))

    def _deciding_gap(self, value: Real, ahead: JumpCrossing | None, at_end: Mask | None) -> Real:
        """The difference between f and the nearest level; at a jump of f, the smaller of the
        differences before and behind it. ahead: the facet at the end of the interval, or None."""
        gap = self.levels.gaps(value).nearest
        if ahead is not None:
            gap_behind = self.levels.gaps(value + ahead.jump).nearest
            gap = dr.select(at_end & (ahead.facet != NO_FACET), fmin(gap, gap_behind), gap)
        return gap


def _refined_accuracy(
    scale: Real, gap: Real, total_error: Real, truncation: Real, within: Real
) -> tuple[Real, Mask]:
    """The accuracy scale with which a sample is repeated, and a mask of samples that are too
    coarse.

    scale, total_error, truncation: the accuracy scale, total error and truncation error of the
        sample.
    gap: the difference between f and the nearest level.
    within: the largest such difference at a hit.

    A sample is too coarse if its error shortens the step much or decides whether the point is a
    hit. It is not too coarse if its truncation error is a small part of `within`, or of the
    rounding error, which a higher accuracy does not reduce. With this allowance the march still
    arrives at hits: its steps end where f is as near to a level as `total_error`, and 1.25
    total_error is less than the difference that makes a hit (within - truncation, or twice the
    rounding).
    """
    rounding = total_error - truncation
    allowed = fmax(
        _TRUNCATION_OF_TOLERANCE * within - _ROUNDING_DEDUCTION * rounding,
        _TRUNCATION_OF_ROUNDING * rounding,
    )
    too_coarse = (
        (gap < _REFINE_BELOW * total_error) & (truncation > allowed) & (scale < _MAX_ACCURACY)
    )
    target = fmax(_TRUNCATION_OF_GAP * gap, _TRUNCATION_OF_ALLOWED * allowed)
    factor = clamp(dr.power(truncation / target, 1 / _TRUNCATION_ORDER), *_REFINEMENT_LIMITS)
    return fmin(fmax(scale * factor, 1), _MAX_ACCURACY), too_coarse


def _next_accuracy(scale: Real, gap: Real, truncation: Real, coarsest: float) -> Real:
    """The accuracy scale of the next sample: 0, the coarsest, or at least 1, and at most `scale`.

    scale, gap, truncation: of this sample, the accuracy scale, the difference between f and the
        nearest level, and the truncation error.
    coarsest: the accuracy scale that 0 stands for.
    """
    target = scale * dr.power(truncation / (_COARSE_FRACTION * gap), 1 / _TRUNCATION_ORDER)
    return dr.select(target > coarsest, fmin(fmax(target, 1), scale), 0)
