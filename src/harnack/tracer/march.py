"""The loop that steps along rays (the march), the only one of the tracer. f is a function of space;
the surface consists of the points at which f takes one of given values, the levels. The march finds
the first point of each ray on the surface, and proves of every step that it passes no level.

The loop depends neither on the kind of function nor on the kind of proof. At a trial point of the
ray it evaluates f: a sample. Each sample comes with enclosures. An enclosure is an interval that is
proved to contain the change of f along the ray up to a given distance; so it proves that a length
of the ray meets no level. A trial point is accepted if the ray is proved to meet no level before
it.

Trial steps are aimed: a step is longer than the proved length, but it ends just short of the point
at which f is predicted to reach a level. Without this, half of the samples near the surface were
rejected. For functions without truncation error, the prediction comes from the cubic through the
last two values and slopes; for others, from the slope alone.

The state of the march is a dataclass of arrays, which `backend.loops` takes apart and puts together
for Dr.Jit's loop. For functions that jump at facets (triangles), `jump_tracer.JumpTracer` cuts the
ray at the facets and calls the march for each interval. The march then also compares f on both
sides of the facet at the end of the interval with the levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin, max_norm, safe_norm
from harnack.backend.loops import loop_while_active
from harnack.enclosures import any_is_free, longest_free_length
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.tracer.level_contact import (
    CONTACT_AIM,
    CONTACT_TOLERANCE,
    AcceptedPoint,
    Contact,
    DeviceHitTolerance,
    Hysteresis,
    JumpTest,
    RayStatus,
    test_jump,
)
from harnack.tracer.steep import SteepPlace, beyond, down_or_up, largest_change

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import LevelGaps, Levels
    from harnack.enclosures.samples import Ray, RaySample, Sample
    from harnack.fields.evaluator import Evaluator
    from harnack.tracer.level_rule import LevelReading, LevelRule
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
    """The state of the march, as arrays with one entry for each ray. f is the function whose levels
    rays look for. A trial point is accepted if no level lies on the ray before it.

    proved_to: the ray parameter of the last accepted point; no level lies on the ray up to there.
    proved_step: a length from that point on which no level lies, either.
    trial_step: the length from that point to the next trial point.
    enclosure_reach: the length of the ray on which the next sample should bound the change of f.
    value, gradient: f and its gradient (3,) at `proved_to`. If f jumps there, the value behind the
        jump.
    tolerance_excess: by how much |f - level| at `proved_to` may exceed what the hit tolerance
        allows, because of rounding.
    evaluations: the number of evaluations of f so far.
    accuracy_scale: the accuracy scale of the next sample (`VariableAccuracy`); larger is more
        accurate. None if f has a single accuracy. (Then a number would never change, and Dr.Jit
        records a loop twice if a part of its state never changes.)
    status: how the ray ended, a `RayStatus`.
    active: whether the ray goes on.
    contact: for rays that end only where f has passed to the other side of a level, a `Contact`:
        which level the ray reached last, from which side, and whether f is still within the
        tolerance of this level. None for rays that end where they reach a level.
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
        """Return the state of rays before their first sample.

        start, end: the ray parameters between which rays are traced. Rays without start < end are
            not active.
        active: mask of rays that are traced.
        has_detail: whether the accuracy of samples can be chosen; then the state has an
            `accuracy_scale`.
        crosses: whether rays end only where f has passed to the other side of a level, and not
            where they reach the level; then the state has a `contact`, the level that the ray
            reached last, which is none at first.
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
            # A miss, as long as no hit is found.
            status=count(int(RayStatus.MISS)),
            active=backend.Bool(active) & (start < end),
            contact=Contact.none(backend) if crosses else None,
        )


@dataclass(frozen=True)
class _TrialSample:
    """What is known at the trial point of each ray: the sample of f, its distance from the levels
    in value, and whether the point can be a hit. All entries are arrays with one entry for each
    ray.

    t: the ray parameter of the trial point.
    at_end: whether the trial point is the end of the ray, or of its interval up to the next jump of
        f.
    coordinate_size: a bound of the absolute values of coordinates on the ray up to t.
    unproved_length: the length of the ray before the trial point that is not yet proved to hold no
        level.
    on_ray: the sample of f at t, with its enclosures (intervals that contain the change of f along
        the ray in front of and behind t).
    gradient_norm: |grad f| at t.
    gaps: the differences between f and the next levels below and above it. For a ray in contact
        with a level (`Hysteresis`), the levels are moved.
    total_error: a bound of the rounding and truncation error of f.
    value_tolerance: the largest |f - level| at a hit; half of it for a ray in contact.
    band: for rays that look for crossings, the tolerance in value around a level
        (`Hysteresis.band`); else `value_tolerance`.
    is_near: whether f is so near to a level that the point is a hit if it is accepted.
    accepts_unknown_side: whether the point may be accepted although the error of f leaves it open
        on which side of the level f is.
    excess: by how much |f - level| may exceed `value_tolerance`, because of rounding.
    is_smooth: whether f is predicted from values and slopes at two points, and not from one slope
        alone.
    reading: the comparison of the sample with the levels.
    steep: bounds of f that come from ranges of its values, for functions whose slope has no bound;
        else None.
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
    reading: LevelReading
    steep: SteepPlace | None = None
    extra_evaluations: Any = 0

    @property
    def value(self) -> Real:
        """f at the trial points."""
        return self.on_ray.sample.value


@dataclass(frozen=True)
class _Arrival:
    """How rays whose trial points were accepted go on from there. A point is accepted if no level
    lies before it on the ray.

    is_hit: whether the ray ends at the point, as it reaches or crosses a level there.
    gaps: the differences between f and the next levels that the step from the point may not pass.
    aim_gaps: the differences at which the next trial step aims. They differ from `gaps` only for
        rays that count crossings.
    contact: the contact with a level behind the point (`Hysteresis`); None if rays end where they
        reach a level.
    value: f at the point; if f jumps there at a facet that the ray passes, f behind the facet.
    jump: the comparison of f on both sides of that facet with the levels; None for functions
        without jumps.
    """

    is_hit: Mask
    gaps: LevelGaps
    aim_gaps: LevelGaps
    contact: Contact | None
    value: Real
    jump: JumpTest | None


@dataclass(frozen=True)
class March:
    """The fixed parameters of the march, which steps along rays to the first point at which f takes
    a level. A trial point of a ray is accepted if the ray is proved to meet no level before it. A
    trial step is the length from the last accepted point to the next trial point. If rays look for
    crossings, they do not end at levels: a ray is in contact with a level from where it reaches it
    until f has left a band around it, a tolerance in value (`Hysteresis`).

    rule: the levels, which are the values of f that rays look for, and how samples are compared
        with them.
    tolerance: how near to a level f must be at a hit.
    max_steps: the number of evaluations of f after which a ray ends as out of steps.
    over_relaxation: trial steps are at most this many times as long as proved steps.
    hysteresis: for rays that end where f has passed to the other side of a level, the rule that
        counts such crossings; None for rays that end where they reach a level.
    cone_radius: if cones are marched instead of rays (`pixel_cones`), their radius per unit of t; a
        cone ends where it comes near a level. None for rays.
    occupied: a grid of cells with marks, for rays that end where they reach a level. Outside of the
        marked cells there is no level. This also holds for the function that continues f beyond a
        jump. None if no such cells are known.
    ray_end: the ray parameter at which rays end if `occupied` is given.
    only_component: if true, levels may lie outside of the marked cells, but do not belong to the
        surface.

    With `hysteresis`, the ray does not end where it reaches a level. It goes on towards levels
    that the hysteresis has moved, and ends as a hit when it has crossed a level. The caller may
    make it active again, to go on to the next level.

    With `cone_radius`, a whole cone must stay clear of the levels. The differences between f
    and the levels shrink by |grad f| times the radius of the cone, which grows with t. A tenth of a
    difference is reserved for this growth: on a step, |grad f| times the radius grows by no more
    than that. Only a step on which the level is proved never to be met, and f moves away from it
    faster than the cone grows, may be longer.

    With `occupied`, the part of the ray beyond a proved step is skipped, too, as far as it lies
    in cells that contain no level (`EmptySpaceGrid.empty_run` has the proof).

    With `only_component`, levels outside of the marked cells belong to other components of the
    surface. Proved steps end in marked cells, and a trial step that would end elsewhere is
    replaced by the proved step. So no hit lies outside of the marked cells, and levels that are
    passed there do not count.
    """

    backend: Backend
    rule: LevelRule
    tolerance: DeviceHitTolerance
    max_steps: Any
    over_relaxation: float
    hysteresis: Hysteresis | None = None
    cone_radius: Real | None = None
    occupied: EmptySpaceGrid | None = None
    ray_end: Real = 0.0
    only_component: bool = False

    @property
    def levels(self) -> Levels:
        """The values of f that rays look for."""
        return self.rule.levels

    def advance(
        self,
        evaluator: Evaluator,
        path: Ray,
        end: Real,
        state: MarchState,
        ahead: JumpCrossing | None = None,
    ) -> MarchState:
        """March each ray to the first level or to its end, and return the state there.

        evaluator, path: the function f and the rays.
        end: the ray parameter at which each ray, or its interval before the next jump of f, ends.
        ahead: for a field with jumps, the crossing of a facet (a flat piece of surface at which f
            jumps) at `end`; its facet is NO_FACET on lanes without one. On lanes with one, the
            point of the crossing is sampled as well. If this point is accepted, the ray has hit the
            facet or passed it. A ray that has passed it ends as a miss here; its state holds f
            behind the facet as `value`, and the step that this value allows. If a ray without
            `hysteresis` has hit the facet, `value` is f before it.

        Proof that no hit is missed. `proved_to` is a point before which no level lies, and
        `proved_step` is a proved length from there. A trial point, at the distance `trial_step`
        from `proved_to`, is accepted in two cases only: if `trial_step` is at most `proved_step`,
        or if an enclosure that reaches back from the trial point covers the difference. In both
        cases no level lies before the trial point. Otherwise the next trial point is proved_to +
        proved_step, which needs no such test. A ray ends as a miss if proved_to + proved_step
        reaches its end, and as a hit only at an accepted point. A point whose sample is too coarse
        (`_refined_accuracy`) is not accepted but sampled again.

        Hits. At a hit, |f - level| is at most the tolerance less the truncation error of f, or at
        most twice the rounding error of f if that is larger. If the level is nearer to f than the
        error of f, the trial point may lie beyond the root, by less than the tolerance. Then it is
        a hit (`_refined_accuracy`), so no root is passed. If it is no hit, because the error is
        large, it is not known on which side of the point the level lies. Then no enclosure that
        reaches back makes the point accepted, and no step from it is proved.

        Rounding. A surface could be missed between the enclosure that reaches ahead from a point
        and the enclosure that reaches back from the next point. So for both enclosures the
        differences between f and the levels are reduced by the rounding of value and position
        (`value_error_bound`). The docstring of the class says what changes with `hysteresis`,
        `cone_radius`, `occupied` and `only_component`.
        """

        def one_trial(now: MarchState) -> MarchState:
            """Return the state after one more trial point of each ray. now: the state before."""
            return self.next_trial(evaluator, path, end, now, ahead)

        return loop_while_active(state, one_trial, "harnack")

    def next_trial(
        self,
        evaluator: Evaluator,
        path: Ray,
        end: Real,
        now: MarchState,
        ahead: JumpCrossing | None = None,
    ) -> MarchState:
        """Sample one more trial point of each ray, and return the state after it.

        now: the state before.

        The loop of `advance` calls this function; field, path, end, ahead and the proof are
        described there.

        If the point is accepted, the ray moves there. Otherwise it stays, and tries a shorter step
        (`fallback`) or, if the sample was too coarse, the same step with a more accurate sample.
        """
        trial = self._sample_trial(evaluator, path, end, now, ahead)
        if self.hysteresis is not None and now.contact is not None:
            trial = self._apply_hysteresis(trial, self.hysteresis, now.contact)
        accepted, accuracy, too_coarse = self._accept(evaluator, trial, now, ahead)
        accepted, fallback = self._shorten_in_contact(trial, now, accepted, too_coarse)
        arrival = self._arrive(trial, path, now, accepted, ahead)
        jump, is_hit = arrival.jump, arrival.is_hit

        # The step from the trial point.
        proved = self._proved_step(trial, arrival.gaps, arrival.contact)
        next_step = self._next_trial_step(
            proved, trial.on_ray, arrival.aim_gaps, now, path, trial.is_smooth
        )
        extended_step = proved
        if self.occupied is not None:
            extended_step, next_step = self._skip_empty_cells(
                self.occupied, path, end, trial, accepted, extended_step, next_step
            )
        # With cells, the step goes on over empty ones; the next enclosures depend on the proof of f
        # alone.
        reach = self._next_reach(now, trial, end, proved, arrival.contact, is_hit)
        proved_step = dr.select(accepted, extended_step, fallback)
        is_free = self._is_free(now, trial, end, accepted, proved_step, arrival.contact)
        if jump is not None:
            # An interval that ends at a facet must be sampled there, whatever its steps prove.
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
            value=dr.select(accepted, arrival.value, now.value),
            gradient=gradient,
            tolerance_excess=dr.select(accepted, trial.excess, now.tolerance_excess),
            evaluations=evaluations,
            accuracy_scale=accuracy,
            status=status,
            active=now.active & ~(is_hit | is_free | (evaluations >= self.max_steps)),
            contact=arrival.contact,
        )

    def _shorten_in_contact(
        self, trial: _TrialSample, now: MarchState, accepted: Mask, too_coarse: Mask
    ) -> tuple[Mask, Real]:
        """Return the mask of accepted trial points, and the length of the next trial step for rays
        whose trial point is rejected.

        now: the state before the trial point.
        accepted: mask of the trial points before which no level lies.
        too_coarse: mask of the trial points whose sample is not accurate enough.

        A trial point at the proved step needs no proof, so it is the next one if this one is
        rejected. On a ray in contact with a level, a step that leads to a point with a much smaller
        band is rejected, and so is one to a point without an error bound. Then even the proved step
        is too long, and is shortened.
        """
        if self.hysteresis is None or now.contact is None:
            return accepted, now.proved_step
        tolerance_length = dr.fma(trial.t, self.tolerance.per_length, self.tolerance.distance)
        band_reaches = self.hysteresis.may_reach(
            now.contact, trial.band, now.trial_step, tolerance_length
        )
        band_reaches &= ~now.contact.is_touching | dr.isfinite(trial.total_error)
        shorter = fmin(now.proved_step, _RETRY_FRACTION * now.trial_step)
        fallback = dr.select(band_reaches | too_coarse, now.proved_step, shorter)
        return accepted & band_reaches, fallback

    def _arrive(
        self,
        trial: _TrialSample,
        path: Ray,
        now: MarchState,
        accepted: Mask,
        ahead: JumpCrossing | None,
    ) -> _Arrival:
        """Find out whether accepted trial points are hits, facets or crossings of a level, and from
        which values the ray goes on behind them.

        path, now: the rays, and their state before the trial points.
        accepted: mask of the accepted points.
        ahead: for a function with jumps, the crossing of the facet at the end of the interval; else
            None.
        """
        is_hit, gaps, jump = accepted & trial.is_near, trial.gaps, None
        if ahead is not None:
            jump = test_jump(
                ahead, accepted & trial.at_end, trial.value, trial.total_error, self.levels
            )
            gaps = trial.reading.gaps_after_jump(jump.gaps)
        if self.hysteresis is not None and now.contact is not None:
            contact, is_hit, jump, value = self._update_contact(
                trial, self.hysteresis, now.contact, path, now, accepted, ahead, jump
            )
            contact_arguments = contact, value, self.levels.gaps(value), trial.band
            gaps = self.hysteresis.gaps(*contact_arguments)
            # Trial steps aim at a point before the moved levels: at a part of the way to them.
            aim_gaps = self.hysteresis.gaps(*contact_arguments, CONTACT_AIM)
            return _Arrival(is_hit, gaps, aim_gaps, contact, value, jump)
        value = trial.value
        if jump is not None and ahead is not None:
            # A ray that passes the facet goes on with the value behind it.
            value = value + dr.select(jump.at_crossing & ~jump.is_hit, ahead.jump, 0)
        return _Arrival(is_hit, gaps, gaps, now.contact, value, jump)

    def _sample_trial(
        self,
        evaluator: Evaluator,
        path: Ray,
        end: Real,
        now: MarchState,
        ahead: JumpCrossing | None,
    ) -> _TrialSample:
        """Evaluate f at the trial point of each ray, and derive all quantities of a `_TrialSample`.

        end: the ray parameter at which the ray, or its interval before the next jump, ends.
        now: the state of the march; the trial point lies `trial_step` beyond its last accepted
            point.
        ahead: for a function with jumps, the crossing of the facet at the end of the interval; else
            None.
        """
        real = self.backend.Float
        t = now.proved_to + now.trial_step
        if ahead is not None or now.contact is not None:  # the end exactly
            t = dr.select(now.trial_step >= end - now.proved_to, end, t)
        scaled = evaluator
        if now.accuracy_scale is not None and evaluator.variable_accuracy is not None:
            scale = self.rule.accuracy_of(evaluator.variable_accuracy, now.accuracy_scale)
            scaled = evaluator.variable_accuracy.at(scale)
        unproved, size = now.trial_step - now.proved_step, max_norm(path.origin) + t
        # Enclosures are wanted ahead of the point, and back to where the ray is proved already.
        ray_sample = scaled.sample_ray(
            path, t, fmin(now.enclosure_reach, end - t), fmax(unproved, real(0))
        )
        # How far f is from the levels, and how well it is known.
        reading = self.rule.read(ray_sample, now.value, now.trial_step, size)
        ray_sample, sample = reading.ray_sample, reading.ray_sample.sample
        gaps, gap, total_error = reading.gaps, reading.nearest_gap, reading.total_error
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(self.cone_radius * t * reading.gradient_norm)
            gap = gaps.nearest
        steep = None
        if evaluator.is_steep:
            length = fmin(now.enclosure_reach, end - t)
            steep = SteepPlace.at(evaluator, self.levels, path, t, length, sample)
            total_error = total_error if steep.error is None else steep.error
        gradient_norm, steepness = _gradient_bounds(reading, is_steep=evaluator.is_steep)
        within = self._value_tolerance(evaluator, path, t, sample, steepness)
        knows_gradient = (sample.gradient_error <= gradient_norm) | (steepness > 0)
        # Where not even the gradient is known, no hit is due to rounding.
        rounding = dr.select(knows_gradient, total_error - sample.truncation_error, 0)
        is_near = self._is_near(
            gap, within, total_error, rounding, ray_sample, gradient_norm, size, end
        )
        evaluations: Any = 0
        if steep is not None:
            # Points at which f may equal a level up to rounding are tested as well.
            touches = steep.is_level
            is_near = (is_near | touches) & now.active & dr.isfinite(total_error)
            is_near, evaluations = self._confirms_level(
                evaluator, path, t, ray_sample, gaps, size, is_near, touches
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
            # A ray that ends at the point need not know on which side of the level f is.
            accepts_unknown_side=is_near,
            excess=fmax(gap + total_error - within, real(0)),
            is_smooth=ahead is None and evaluator.variable_accuracy is None,
            reading=reading,
            steep=steep,
            extra_evaluations=evaluations,
        )

    def _value_tolerance(
        self, evaluator: Evaluator, path: Ray, t: Real, sample: Sample, steepness: Real
    ) -> Real:
        """Return the largest |f - level| at a hit. For rays that look for crossings, it is the
        largest one at which contact with a level begins.

        sample: the sample of f at the parameter t of the rays `path`.
        steepness: a proved lower bound of |grad f| there.
        """
        within = self.tolerance.value_tolerance(steepness, t)
        if self.hysteresis is None:
            return within
        if evaluator.is_steep:
            # No crossing needs a larger change of f than its values allow within the tolerance.
            reach = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
            change = largest_change(evaluator, path.point(t), sample.value, reach)
            within = fmax(fmin(within, change), self.tolerance.value)
        return self.hysteresis.contact_tolerance(within)

    def _confirms_level(
        self,
        evaluator: Evaluator,
        path: Ray,
        t: Real,
        ray_sample: RaySample,
        gaps: LevelGaps,
        size: Real,
        is_near: Mask,
        touches: Mask,
    ) -> tuple[Mask, Any]:
        """Return the mask of points near which f is proved to take the level, and the number of
        evaluations of f that this test took. It is for functions whose slope has no bound: there a
        small |f - level| does not show that f takes the level.

        t: the ray parameters of the points; ray_sample: the samples there.
        gaps: the differences between f at the point and the next levels below and above.
        size: a bound of the absolute values of coordinates on the ray up to the points.
        is_near: mask of points to be tested. They are near a level by the slope of f, or rounding
            of the point may hide the level.
        touches: mask of points at which f may equal the level up to rounding.

        f must take the level within the hit tolerance, or within twice the rounding of the point if
        that is larger. This is proved by the enclosures of f along the ray, or by a sample at the
        level or on its other side (`steep.beyond`). A point at which |f - level| is at most
        `HitTolerance.value` always counts.
        """
        sample, p = ray_sample.sample, path.point(t)
        tolerance_length = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
        # A bound of the rounding of the point.
        slack = 8 * self.backend.machine_epsilon * size
        reach = fmax(tolerance_length, 2 * slack)
        is_proved = gaps.nearest <= self.tolerance.value
        # The change of f along the ray may prove that it takes the level.
        for enclosure in ray_sample.forward:
            is_proved |= enclosure.arrives(gaps, reach)
        # Otherwise samples are taken along the gradient and along the ray.
        toward = down_or_up(sample.gradient, gaps, path.direction)
        directions_and_slopes = (
            (toward, safe_norm(sample.gradient)),
            (path.direction, ray_sample.slope),
        )
        is_unsure = is_near & ~is_proved
        is_beyond, evaluations = beyond(
            self.backend,
            evaluator,
            self.levels,
            gaps,
            p,
            directions_and_slopes,
            sample.value,
            reach,
            touches,
            is_unsure,
        )
        return is_near & (is_proved | is_beyond), evaluations

    def _apply_hysteresis(
        self, trial: _TrialSample, hysteresis: Hysteresis, contact: Contact
    ) -> _TrialSample:
        """Return the trial sample as a ray that looks for crossings needs it: the levels are moved
        (`Hysteresis.gaps`), and tolerances are those for contact.

        hysteresis, contact: the rule that counts crossings, and the level that each ray reached
            last.

        The band (the tolerance in value around a level) includes all rounding of f; otherwise a ray
        would get stuck in a crease.
        """
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
        self, evaluator: Evaluator, trial: _TrialSample, now: MarchState, ahead: JumpCrossing | None
    ) -> tuple[Mask, Real | None, Mask]:
        """Decide which trial points are accepted: no level lies before them on the ray, and their
        sample is not too coarse.

        Returns the mask of accepted points, the accuracy scale of the next sample (larger is more
        accurate), and the mask of samples that were too coarse.

        evaluator: the function f; the accuracy of the next sample is chosen here.
        now: the state before the trial.
        ahead: for a function with jumps, the facet at the end of the interval; else None.
        """
        # Up to the proved step no level lies on the ray. Beyond it, an enclosure that reaches back
        # from the trial point has to prove the rest, and the side of the level has to be known.
        accepted = now.trial_step <= now.proved_step
        if self.over_relaxation > 1:
            knows_side = trial.accepts_unknown_side | (trial.gaps.nearest > trial.total_error)
            is_proved = any_is_free(
                trial.on_ray.backward,
                trial.gaps.reduced_by(trial.total_error),
                trial.unproved_length,
            )
            accepted |= knows_side & is_proved
        is_known = dr.isfinite(trial.total_error)  # without an error bound nothing is free
        if trial.steep is not None:  # values prove the next step
            is_known = is_known | (now.trial_step <= now.proved_step)
        sampling = evaluator.variable_accuracy
        if now.accuracy_scale is None or sampling is None:
            return accepted & is_known, now.accuracy_scale, self.backend.Bool(False)
        truncation, coarsest = trial.on_ray.sample.truncation_error, sampling.coarsest
        smallest_gap = self._deciding_gap(trial.value, ahead, trial.at_end)
        accuracy = fmax(now.accuracy_scale, coarsest)
        finer, too_coarse = _refined_accuracy(
            accuracy, smallest_gap, trial.total_error, truncation, trial.value_tolerance
        )
        coarser = _next_accuracy(accuracy, trial.gaps.nearest, truncation, coarsest)
        too_coarse = trial.reading.must_repeat(too_coarse, accepted)
        coarser = trial.reading.next_accuracy(accuracy, coarser)
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
        """Update the contact of each ray with a level after the trial point, and at the facet there
        if f jumps.

        hysteresis: the rule that counts crossings. contact, now: the contact and the state before
            the trial point.
        accepted: mask of accepted trial points.
        ahead, jump: for a function with jumps, the facet at the end of the interval and its
            comparison with the levels; else None.

        Returns four results: the new contact; the mask of rays that have crossed the level at the
        trial point, before a jump there; the comparison with the facet, in which `is_hit` now marks
        rays that cross the level by the jump; and f behind the facet, or at the trial point if
        there is none.
        """
        value = trial.value
        previous = now.proved_to, now.value, dr.dot(now.gradient, path.direction), now.gradient
        is_last = trial.at_end if jump is None else trial.at_end & ~jump.has_crossing
        # Only an error of f larger than the tolerance makes the crossing uncertain.
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
        """Return the length of the ray beyond the trial point that is proved to hold no level.

        gaps: the differences between f at the trial point, or behind the jump there, and the next
            levels.
        contact: the contact with a level after the point; None if rays end at levels.

        For cones, the step is also limited by the growth of the cone. It is 0 where the error of f
        is as large as the difference between f and a level.
        """
        growth = _GROWTH_FRACTION * trial.gaps.nearest
        # A tenth of the gap is kept for the growth of the cone.
        if self.cone_radius is not None:
            gaps = gaps.reduced_by(growth)
        forward = longest_free_length(trial.on_ray.forward, gaps.reduced_by(trial.total_error))
        if self.cone_radius is not None:
            # The smallest number avoids 0/0. A step is at most as long as the cone needs to grow by
            # the tenth.
            slope, smallest = trial.on_ray.slope, float(dr.smallest(self.backend.Float))
            widening = fmax(self.cone_radius * trial.gradient_norm, smallest)
            # How fast f moves away from the nearer level. If that is faster than the cone grows,
            # and no level is ever met, the step needs no limit.
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
        proved_step: Real,
        trial_step: Real,
    ) -> tuple[Real, Real]:
        """Extend the proved step and the trial step over the cells beyond the proved step that hold
        no level.

        occupied: the grid of cells. end: the ray parameter at which rays end.
        point: the sample at the trial point, and `accepted` the mask of rays on which it was
            accepted.
        proved_step, trial_step: the two steps from the trial point.

        Returns the two steps. The proved step is inf if the ray ends before the next cell that may
        hold a level.
        """
        # Where the point was not accepted, nothing is searched: the search begins at the end.
        free_to = dr.select(accepted, point.t + proved_step, self.ray_end)
        free_to = occupied.end_of_empty_run(path.origin, path.direction, free_to, self.ray_end)
        proved_step = fmax(
            proved_step, dr.select(free_to >= self.ray_end, dr.inf, free_to - point.t)
        )
        trial_step = fmax(trial_step, proved_step)
        if self.only_component:
            # With `only_component`, a trial step may not end in a cell without a mark.
            target = path.point(point.t + fmin(trial_step, end - point.t))
            trial_step = dr.select(
                occupied.cell(target).empty_distance > 0, proved_step, trial_step
            )
        return proved_step, trial_step

    def _next_reach(
        self,
        now: MarchState,
        trial: _TrialSample,
        end: Real,
        proved: Real,
        contact: Contact | None,
        is_hit: Mask,
    ) -> Real:
        """Return the length of the ray on which the next sample should bound the change of f.

        It is a multiple of `proved`, the proved step. If no step was proved, it is a third of the
        length for the present sample. For a ray that looks for crossings and has just left a level,
        or crossed it, it is the rest of the ray up to `end`.

        now: the state before the trial point.
        contact: the contact with a level after the trial point; None if rays end at levels.
        is_hit: mask of trial points that are hits.
        """
        # After a step of zero, the next enclosures need reach only a third as far: bisection. On a
        # ray without an end, an infinite reach becomes one of some sizes of the coordinates.
        # (16 is "some sizes"; 1 is for coordinates of 0.)
        candidate = fmin(now.enclosure_reach, end - trial.t)
        shorter = dr.select(dr.isfinite(candidate), candidate / 3, 1 + 16 * trial.coordinate_size)
        reach = dr.select(proved > 0, trial.on_ray.reach_growth * proved, shorter)
        if now.contact is not None and contact is not None:  # off the surface: the whole ray again
            leaves_level = now.contact.is_touching & ~contact.is_touching
            reach = dr.select(leaves_level | is_hit, end - trial.t, reach)
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
        """Return the mask of rays on which no level lies up to their end.

        now: the state before the trial point.
        end: the ray parameter at which each ray ends; inf for a ray without an end.
        accepted: mask of accepted trial points.
        proved_step: the proved step from there, or from the last accepted point on other rays.
        contact: the contact after the trial point; None if rays end at levels.

        Rays without an end count as free from a very large t on. A ray in contact must sample its
        end (`Hysteresis.must_sample_end`).
        """
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
        length_scale: Real,
        end: Real,
    ) -> Mask:
        """Return the mask of trial points at which f is near enough to a level for a hit, as
        `advance` states.

        gap: the difference between f and the nearest level.
        within: the largest difference of this kind that the tolerance allows.
        total_error, rounding: bounds of the error of f, and of its part due to rounding.
        ray_sample, gradient_norm: the sample of f at the point, and |grad f|.
        length_scale: a bound of the absolute values of coordinates on the ray.
        end: the ray parameter at which the ray ends.

        A point is no hit if rounding leaves the distance to the surface uncertain by more than a
        sixteenth of a length L: the size of the coordinates or, if larger, the radius of the ball
        in which f is proved to be smooth. On a ray without an end, there is a second condition: a
        point that only rounding brings near the level is no hit if rounding leaves t uncertain by
        more than L. Otherwise, far enough away, rounding would make a hit of every ray parallel to
        the surface.
        """
        sample = ray_sample.sample
        is_close = gap <= fmax(within - sample.truncation_error, 2 * rounding)
        for promise in sample.promises:
            radius = promise.radius
            length_scale = fmax(dr.select(dr.isfinite(radius), radius, 0), length_scale)
        # By how much |f - level| may exceed the tolerance. Divided by a slope, this is a length:
        # the uncertainty of t along the ray, and of the distance to the surface.
        excess = gap + total_error - within
        may_hit = (gap <= within - sample.truncation_error) | (end < dr.inf)
        may_hit |= excess <= dr.abs(ray_sample.slope) * length_scale
        return is_close & may_hit & (excess <= _LARGEST_UNCERTAINTY * gradient_norm * length_scale)

    def _next_trial_step(
        self,
        forward: Real,
        ray_sample: RaySample,
        gaps: LevelGaps,
        now: MarchState,
        path: Ray,
        is_smooth: bool,
    ) -> Real:
        """Return the length of the next trial step, at least the proved step `forward`.

        The trial step is up to `over_relaxation` times as long as the proved step, but does not
        pass the point at which f is predicted to reach a level. A wrong prediction does no harm: a
        trial point is accepted only if an enclosure of f that reaches back from it proves the rest
        of the step.

        forward, ray_sample: the proved step from the trial point, and the sample of f there.
        gaps: the differences between f and the next levels.
        now: the state at the last accepted point.
        is_smooth: whether value and slope at the last accepted point help to predict f. They do not
            if f has a truncation error, which differs from point to point.

        Let r = |slope|, g the difference between f and the level towards which f moves, and c the
        second derivative of f along the ray, counted positive towards that level. With is_smooth, f
        is predicted to reach the level at the first x > 0 with r x + c x^2/2 = g, which is 2g/(r +
        sqrt(r^2 + 2 c g)), and nowhere if the square root is not real. Without is_smooth it is
        predicted to reach the level at g/r.
        """
        slope = ray_sample.slope
        slope_size, gap = dr.abs(slope), dr.select(slope > 0, gaps.above, gaps.below)
        if is_smooth:
            # Times the sign of the slope: positive towards the level.
            second_derivative = dr.mulsign(self._second_derivative(ray_sample, now, path), slope)
            discriminant = dr.fma(slope_size, slope_size, 2 * second_derivative * gap)
            target = _TRIAL_AIM * dr.select(
                discriminant >= 0, 2 * gap / (slope_size + dr.sqrt(discriminant)), dr.inf
            )
        else:
            target = _AIM_BY_SLOPE * dr.select(slope_size > 0, gap / slope_size, dr.inf)
        return fmin(self.over_relaxation * forward, fmax(target, forward))

    def _second_derivative(self, ray_sample: RaySample, now: MarchState, path: Ray) -> Real:
        """Return an estimate of the second derivative of f along the ray at the trial point: that
        of the cubic which has the values and slopes of f at the trial point and at the last
        accepted point. The result is 0 if no point was accepted before.

        ray_sample: the sample at the trial point. now: the state at the last accepted point.

        Let h be the distance of the two points, D the difference quotient, and s0 and s the slopes
        at the accepted and the trial point. The derivative is 2 (2s + s0 - 3D)/h (Hermite). For a
        periodic f, D uses the multiple of the period that agrees best with the slopes.
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
        """Return the `RayStatus` of rays: HIT on lanes of `is_hit`, MISS on other lanes of
        `is_free` (the rest of the ray is proved to hold no level), else OUT_OF_STEPS."""
        ended = dr.select(is_free, int(RayStatus.MISS), int(RayStatus.OUT_OF_STEPS))
        return self.backend.UInt32(dr.select(is_hit, int(RayStatus.HIT), ended))

    def _deciding_gap(self, value: Real, ahead: JumpCrossing | None, at_end: Mask | None) -> Real:
        """Return |f - level| for the level nearest to f. By it the march decides whether the
        accuracy of samples suffices. Where a trial point lies at a facet, at which f jumps, it is
        the smaller of the two numbers before and behind the jump.

        value: f at the trial point, before the jump.
        ahead: the crossing of the facet at the end of the interval; None for functions without
            jumps.
        at_end: mask of trial points at the end of the interval.
        """
        gap = self.levels.gaps(value).nearest
        if ahead is not None:
            gap_behind = self.levels.gaps(value + ahead.jump).nearest
            gap = dr.select(at_end & (ahead.facet != NO_FACET), fmin(gap, gap_behind), gap)
        return gap


def _gradient_bounds(reading: LevelReading, *, is_steep: bool) -> tuple[Real, Real]:
    """Return |grad f| at the point of a sample, and a proved lower bound of |grad f|. The tolerance
    in value is the tolerance in space times this bound.

    is_steep: whether f may be so steep that samples hold no gradient, but only slopes along the
        ray. Then the first result is at least as large as the second.
    """
    ray_sample, gradient_norm = reading.ray_sample, reading.gradient_norm
    steepness = fmax(gradient_norm - ray_sample.sample.gradient_error, type(gradient_norm)(0))
    if ray_sample.slope_error is not None:  # the gradient is at least as long as its projection
        steepness = fmax(dr.abs(ray_sample.slope) - ray_sample.slope_error, steepness)
    if ray_sample.min_gradient_norm is not None:
        steepness = fmax(ray_sample.min_gradient_norm, steepness)
    if is_steep:
        gradient_norm = fmax(gradient_norm, steepness)
    return gradient_norm, steepness


def _refined_accuracy(
    scale: Real, gap: Real, total_error: Real, truncation: Real, within: Real
) -> tuple[Real, Mask]:
    """Return the accuracy scale with which each sample would be repeated (larger is more accurate),
    and the mask of samples that are too coarse and so have to be repeated.

    scale, total_error, truncation: the accuracy scale, total error and truncation error of the
        sample.
    gap: the difference between f and the nearest level.
    within: the largest such difference at a hit.

    A sample is too coarse if its error shortens the step much, or decides whether the point is a
    hit. It is not too coarse if its truncation error is a small part of `within`, or of the
    rounding error, which a higher accuracy does not reduce. With this allowance the march still
    arrives at hits: its steps end where `gap` is as small as `total_error`, and 1.25 total_error is
    less than the difference that makes a hit (within - truncation, or twice the rounding).
    """
    rounding = total_error - truncation
    allowed = fmax(
        _TRUNCATION_OF_TOLERANCE * within - _ROUNDING_DEDUCTION * rounding,
        _TRUNCATION_OF_ROUNDING * rounding,
    )
    too_coarse = (
        (gap < _REFINE_BELOW * total_error) & (truncation > allowed) & (scale < _MAX_ACCURACY)
    )
    # The truncation error falls as a power of the scale: so the scale for this target follows.
    target = fmax(_TRUNCATION_OF_GAP * gap, _TRUNCATION_OF_ALLOWED * allowed)
    factor = clamp(dr.power(truncation / target, 1 / _TRUNCATION_ORDER), *_REFINEMENT_LIMITS)
    return fmin(fmax(scale * factor, 1), _MAX_ACCURACY), too_coarse


def _next_accuracy(scale: Real, gap: Real, truncation: Real, coarsest: float) -> Real:
    """Return the accuracy scale of the next sample (larger is more accurate): 0, which means the
    coarsest, or else at least 1. It is at most `scale`.

    scale, truncation: the accuracy scale and the truncation error of this sample.
    gap: the difference between f and the nearest level. The scale is chosen such that the next
        truncation error may be a fifth of it.
    coarsest: the accuracy scale that 0 stands for.
    """
    # The truncation error falls as a power of the scale.
    target = scale * dr.power(truncation / (_COARSE_FRACTION * gap), 1 / _TRUNCATION_ORDER)
    return dr.select(target > coarsest, fmin(fmax(target, 1), scale), 0)
