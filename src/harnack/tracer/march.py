"""The only marching loop: the first point of a ray on a level set, with every step proved.

It knows neither fields nor proofs. It samples a field along the ray, and the enclosures that come
with each sample say how far the ray is free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin, largest_coordinate, length
from harnack.backend.loops import while_active
from harnack.enclosures import any_covers, longest_step
from harnack.fields.capabilities import NO_SHEET, Crossing
from harnack.fields.samples import value_error
from harnack.tracer.level_contact import (
    AIM,
    CLOSER,
    Accepted,
    Contact,
    Hysteresis,
    PreparedTolerance,
    SheetComparison,
    Status,
    compare_with_sheet,
)
from harnack.tracer.steep import SteepPlace, beyond, down_or_up, largest_change

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Gaps, TargetLevels
    from harnack.fields.field import Field
    from harnack.fields.samples import Look, Path
    from harnack.tracer.branch_tracker import WholeNumbers
    from harnack.tree.empty_space import UniformGrid

# A coarse sample is repeated at higher detail where a level is closer in value than this many times
# its total error. The detail is chosen to make truncation this fraction of that distance, or of
# what truncation may be, whichever is larger (`_finer`).
_REFINE_BELOW, _OF_GAP, _OF_ALLOWED = 2.0, 0.25, 0.85
# What truncation may be at a hit: this fraction of the tolerance, less this many times the
# rounding; or this many times the rounding if that is larger.
_OF_TOLERANCE, _LESS, _OF_ROUNDING = 0.4, 0.55, 0.6
# The next sample may be so coarse that its truncation is this fraction of the distance to a level.
_COARSEN = 0.2
# Trials stop short of where f is predicted to reach a level by this factor: by a parabola, or where
# there is only a slope.
_AIM, _AIM_BY_SLOPE = 0.999, 0.99
# How far from the surface rounding may leave a point that is a hit: see `March._is_near`.
_LARGEST_UNCERTAINTY = 1 / 16
# Rays without an end that get as far as this power of the largest number end as misses: squares of
# larger numbers overflow.
_FARTHEST = 0.47
# The fraction of the gap to the cover of a cone by which the cone may widen in a step.
_WIDENING = 0.1
# The detail of a repeated sample is larger by these factors at least and at most.
_CLOSER = 1.25, 16.0
# Truncation falls like this power of detail; beyond the largest detail there is none.
_POWER, _MOST_DETAIL = 3.2, 1e6
# In contact, a step that leads to where the band is much smaller is tried again so much shorter.
_SHORTER = 0.125


@dataclass(frozen=True)
class MarchState:
    """Where rays are.

    proved_to: the ray is proved free up to here; the last accepted point.
    proved_step: a length from there that is proved free too.
    trial_step: from there to the next trial point.
    look_ahead: how far enclosures are asked to reach next.
    value, gradient: f at `proved_to`; the value is that behind the sheet if one was passed there.
    excess: by how much f there may be farther from a level than the tolerance allows.
    evaluations: of f, so far.
    detail: of the next sample (`Field.at_detail`); None for fields without a choice of detail
        (Dr.Jit records a loop twice if a state in it never changes).
    status: a `Status` once the ray has ended.
    active: whether it goes on.
    contact: what is known of the level reached last; None for rays that end where they reach one.
    """

    proved_to: Real
    trial_step: Real
    proved_step: Real
    look_ahead: Real
    value: Real
    gradient: Vec3
    excess: Real
    evaluations: Any
    detail: Real | None
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
        """At the start of rays, before the first sample."""
        real, vector, count = backend.Float, backend.Array3f, backend.UInt32
        return cls(
            proved_to=real(start),
            trial_step=real(0),
            proved_step=real(0),
            look_ahead=real(end - start),
            value=real(0),
            gradient=vector(0),
            excess=real(0),
            evaluations=count(0),
            detail=real(0) if has_detail else None,
            status=count(int(Status.MISS)),
            active=backend.Bool(active) & (start < end),
            contact=Contact.none(backend) if crosses else None,
        )


@dataclass(frozen=True)
class _Seen:
    """What is known of f at the trial points of rays.

    t: of the points. at_end: whether the ray ends there. size: of coordinates there.
    unproved: the length before the point that no step has proved yet.
    look: the field's answer there. gradient_norm: the length of its gradient.
    gaps: from f to the levels on both sides; in contact, to where the hysteresis puts them.
    total_error: what rounding and truncation may have done to f.
    within: how near in value a level makes a hit; in contact, a crossing.
    band: in contact that of `Hysteresis.band`.
    is_near: whether a level is near enough for a hit.
    may_pass: whether a point may be accepted although it is not known on which side of a level
        it lies.
    excess: as that of `MarchState`.
    is_smooth: whether value and slope predict f.
    passes, is_doubtful: see `WholeNumbers.gaps`; None for fields that know their values.
    steep: what values prove there; None for fields whose slopes are bounded.
    looks: evaluations of f beyond the points.
    """

    t: Real
    at_end: Mask
    size: Real
    unproved: Real
    look: Look
    gradient_norm: Real
    gaps: Gaps
    total_error: Real
    within: Real
    band: Real
    is_near: Mask
    may_pass: Mask
    excess: Real
    is_smooth: bool
    passes: Mask | None = None
    is_doubtful: Mask | None = None
    steep: SteepPlace | None = None
    looks: Any = 0

    @property
    def value(self) -> Real:
        """f at the points."""
        return self.look.sample.value

    def rungs_or(self, behind: Gaps) -> Gaps:
        """The gaps to rungs, which a sheet does not change; behind it where these are passed."""
        down = dr.select(self.passes, behind.down, self.gaps.down)
        return replace(self.gaps, down=down, up=dr.select(self.passes, behind.up, self.gaps.up))


@dataclass(frozen=True)
class March:
    """How to march: the levels to find, when to stop, and by how much to try longer steps.

    overstep: trial steps are at most this many times as long as the proved ones.
    hysteresis: for rays that end where they have crossed a level, and not where they reach one.
    cover: for cones that end where they come near a level (`pixel_cones`): their radius per unit
        of t.
    occupied: for rays that end where they reach a level, cells outside of which there is no level,
        not even behind a sheet.
    last: where these rays end.
    is_part: whether there may be levels outside of these cells, which do not count.
    whole_numbers: for fields whose coarse samples know f but for a whole number, how rays find it;
        None for no such samples.
    """

    backend: Backend
    levels: TargetLevels
    tolerance: PreparedTolerance
    max_steps: Any
    overstep: float
    hysteresis: Hysteresis | None = None
    cover: Real | None = None
    occupied: UniformGrid | None = None
    last: Real = 0.0
    is_part: bool = False
    whole_numbers: WholeNumbers | None = None

    def advance(
        self,
        field: Field,
        path: Path,
        end: Real,
        state: MarchState,
        ahead: Crossing | None = None,
    ) -> MarchState:
        """March to the first level, or to the end.

        Proof that no hit is missed: `proved_to` is a point up to which the ray is free, and
        `proved_step` a proved length from there. A trial point, `trial_step` from there, is
        accepted only if that is no more than `proved_step`, or an enclosure at the trial point,
        looking back, covers the difference; then all up to it is free. Otherwise the ray goes back
        to proved_to + proved_step, which needs no such test. A ray ends as a miss when proved_to +
        proved_step passes its end, as a hit only at an accepted point. A point is not accepted on a
        sample that is too coarse (`_finer`), but sampled again.

        A hit is a point where f is within the tolerance of a level *after* the truncation error of
        f is taken off; where rounding leaves f less certain than that, within twice what it leaves.
        A trial point at which the level is nearer than the error of f may lie behind the root, by
        less than the tolerance: it is a hit (`_finer`), so nothing is passed there. If it is no
        hit, because the error is large, it is not accepted by looking back, and no step from it is
        proved: on which side of the point the level lies is not known.

        In rounded arithmetic a surface could be missed between the enclosure that reaches ahead
        from one point and the one that looks back from the next, so for both the levels are nearer
        by the rounding of value and position together (`value_error`).

        With `hysteresis` a level that is reached is not the end: the ray goes on, towards levels
        that lie where the hysteresis puts them, and ends as a hit where it has crossed one. It may
        be made active again there, to go on to the next.

        With `cover` the levels lie nearer by |grad f| times the radius of a cone, which grows with
        t: a tenth of the gap is set aside for that growth, and no step is longer than the cone
            takes
        to widen by so much, unless the level is never met and f leaves it faster than the cone
        widens.

        With `occupied` what follows a proved step is passed as well, as far as it lies in cells
        that hold no level (`UniformGrid.run` has the proof): a union of free intervals is free.

        With `is_part` levels outside of `occupied` belong to other components of the surface.
        Proved steps end in occupied cells, and so do trials: one that would not is not made. So no
        hit lies outside of them, and levels that are passed there do not count.

        ahead: for a field with sheets, the crossing at `end`, on lanes where there is one. Those
        lanes sample that point as well. Accepted there, they hit the sheet or have passed it: a
        miss, with the step that the value behind the sheet allows from there. `value` is then that
        behind the sheet; without `hysteresis` not where the sheet was hit.
        """

        def body(now: MarchState) -> MarchState:
            return self.next_trial(field, path, end, now, ahead)

        return while_active(state, body, "harnack")

    def next_trial(
        self,
        field: Field,
        path: Path,
        end: Real,
        now: MarchState,
        ahead: Crossing | None = None,
    ) -> MarchState:
        """The state after one more trial point of each ray; `advance` has the proof."""
        seen = self._look(field, path, end, now, ahead)
        if self.hysteresis is not None and now.contact is not None:
            seen = self._in_contact(seen, self.hysteresis, now.contact)
        accepted, detail, too_coarse = self._accept(field, seen, now, ahead)
        fallback = now.proved_step
        if self.hysteresis is not None and now.contact is not None:
            tolerance = dr.fma(seen.t, self.tolerance.per_length, self.tolerance.distance)
            reaches = self.hysteresis.may_reach(now.contact, seen.band, now.trial_step, tolerance)
            reaches &= ~now.contact.is_touching | dr.isfinite(seen.total_error)
            shorter = fmin(now.proved_step, _SHORTER * now.trial_step)
            fallback = dr.select(reaches | too_coarse, now.proved_step, shorter)
            accepted &= reaches

        # Is it a hit, a sheet, or a crossing?
        hit, gaps_ahead, sheet = accepted & seen.is_near, seen.gaps, None
        if ahead is not None:
            sheet = compare_with_sheet(
                ahead, accepted & seen.at_end, seen.value, seen.total_error, self.levels
            )
            gaps_ahead = sheet.gaps if seen.passes is None else seen.rungs_or(sheet.gaps)
        aims, contact, value = gaps_ahead, now.contact, seen.value
        if self.hysteresis is not None and now.contact is not None:
            contact, hit, sheet, value = self._cross(
                seen, self.hysteresis, now.contact, path, now, accepted, ahead, sheet
            )
            after = contact, value, self.levels.gaps(value), seen.band
            gaps_ahead, aims = self.hysteresis.gaps(*after), self.hysteresis.gaps(*after, AIM)
        elif sheet is not None and ahead is not None:
            value = value + dr.select(sheet.at_crossing & ~sheet.is_hit, ahead.jump, 0)

        # How far to go from there.
        proved = self._proved(seen, gaps_ahead, contact)
        trial = self._trial(proved, seen.look, aims, now, path, seen.is_smooth)
        forward = proved
        if self.occupied is not None:
            forward, trial = self._jump(self.occupied, path, end, seen, accepted, forward, trial)
        look_ahead = self._look_ahead(now, seen, end, proved, contact, hit)
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
            look_ahead=dr.select(accepted, look_ahead, now.look_ahead),
            value=dr.select(accepted, value, now.value),
            gradient=gradient,
            excess=dr.select(accepted, seen.excess, now.excess),
            evaluations=evaluations,
            detail=detail,
            status=status,
            active=now.active & ~(hit | free | (evaluations >= self.max_steps)),
            contact=contact,
        )

    def _look(
        self, field: Field, path: Path, end: Real, now: MarchState, ahead: Crossing | None
    ) -> _Seen:
        """Sample f at the trial points of rays."""
        real = self.backend.Float
        t = now.proved_to + now.trial_step
        if ahead is not None or now.contact is not None:  # the end exactly
            t = dr.select(now.trial_step >= end - now.proved_to, end, t)
        seen, whole, is_modulo = field, self.whole_numbers, None
        if now.detail is not None and field.has_detail:
            knows = field.is_modulo and whole is None
            seen = field.at_detail(fmax(now.detail, 1) if knows else now.detail)
        unproved, size = now.trial_step - now.proved_step, largest_coordinate(path.origin) + t
        look = seen.look(path, t, fmin(now.look_ahead, end - t), fmax(unproved, real(0)))
        passes, is_doubtful, is_sure = None, None, None
        gradient_norm = length(look.sample.gradient)
        if whole is not None and look.sample.is_modulo is not None:
            is_modulo = look.sample.is_modulo
            error = value_error(look.sample, gradient_norm, size)
            look, is_sure = whole.continued(look, now.value, now.trial_step, error)
        sample = look.sample
        gaps = self.levels.gaps(sample.value)
        gap, total_error = gaps.smaller, value_error(sample, gradient_norm, size)
        if whole is not None and is_modulo is not None and is_sure is not None:
            gaps, passes, is_doubtful = whole.gaps(sample, is_modulo, is_sure, total_error)
        if self.cover is not None:
            gaps = gaps.less(self.cover * t * gradient_norm)
            gap = gaps.smaller
        steep = None
        if field.is_steep:
            look_ahead = fmin(now.look_ahead, end - t)
            steep = SteepPlace.at(field, self.levels, path, t, look_ahead, sample)
            total_error = total_error if steep.error is None else steep.error
        steepness = fmax(gradient_norm - sample.gradient_error, real(0))
        if look.slope_error is not None:  # the gradient is at least as long as its projection
            steepness = fmax(dr.abs(look.slope) - look.slope_error, steepness)
        if look.least_gradient is not None:
            steepness = fmax(look.least_gradient, steepness)
        if steep is not None:  # the gradient is no number where only slopes along the path are
            gradient_norm = fmax(gradient_norm, steepness)
        within = self.tolerance.in_value(steepness, t)
        knows_gradient = (sample.gradient_error <= gradient_norm) | (steepness > 0)
        if self.hysteresis is not None:
            if field.is_steep:  # or what f has to swing is more than it does
                reach = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
                change = largest_change(field, path.point(t), sample.value, reach)
                within = fmax(fmin(within, change), self.tolerance.value)
            within = self.hysteresis.within(within)
        # Where not even the gradient is known, no hit is due to rounding.
        rounding = dr.select(knows_gradient, total_error - sample.truncation, 0)
        is_near = self._is_near(gap, within, total_error, rounding, look, gradient_norm, size, end)
        looks: Any = 0
        if steep is not None:
            may_be = steep.is_level
            is_near = (is_near | may_be) & now.active & dr.isfinite(total_error)
            is_near, looks = self._is_there(field, path, t, look, gaps, size, is_near, may_be)
        return _Seen(
            t=t,
            at_end=t == end,
            size=size,
            unproved=unproved,
            look=look,
            gradient_norm=gradient_norm,
            gaps=gaps,
            total_error=total_error,
            within=within,
            band=within,
            is_near=is_near,
            may_pass=is_near,
            excess=fmax(gap + total_error - within, real(0)),
            is_smooth=ahead is None and not field.has_detail,
            passes=passes,
            is_doubtful=is_doubtful,
            steep=steep,
            looks=looks,
        )

    def _is_there(
        self,
        field: Field,
        path: Path,
        t: Real,
        look: Look,
        gaps: Gaps,
        size: Real,
        is_near: Mask,
        may_be: Mask,
    ) -> tuple[Mask, Any]:
        """At which of the points that are near a level, by their slope or by what f may be within
        the rounding of the point, f takes it within the tolerance or twice that rounding, and how
        many evaluations of f that took.

        It does if the enclosures prove it along the ray, or if f is seen on the other side of the
        level or at it (`steep.beyond`). may_be: whether the level may be f up to rounding.
        """
        sample, p = look.sample, path.point(t)
        tolerance = dr.fma(t, self.tolerance.per_length, self.tolerance.distance)
        slack = 8 * self.backend.epsilon * size
        reach = fmax(tolerance, 2 * slack)
        sure = gaps.smaller <= self.tolerance.value
        for enclosure in look.ahead:
            sure |= enclosure.arrives(gaps, reach)
        along = down_or_up(sample.gradient, gaps, path.direction)
        ways = (along, length(sample.gradient)), (path.direction, look.slope)
        unsure = is_near & ~sure
        passed, looks = beyond(
            self.backend, field, self.levels, gaps, p, ways, sample.value, reach, may_be, unsure
        )
        return is_near & (sure | passed), looks

    def _in_contact(self, seen: _Seen, hysteresis: Hysteresis, contact: Contact) -> _Seen:
        """The same, with levels where the hysteresis puts them. The band takes all rounding of f
        into account, or a ray would stick in a crease."""
        band = hysteresis.band(seen.within, seen.total_error - seen.look.sample.truncation)
        may_pass = seen.may_pass & ~contact.is_touching
        if self.levels.period is not None:  # here only the value tells the side of a level
            may_pass = self.backend.Bool(False)
        gaps = hysteresis.gaps(contact, seen.value, seen.gaps, band)
        return replace(seen, gaps=gaps, within=CLOSER * seen.within, band=band, may_pass=may_pass)

    def _accept(
        self, field: Field, seen: _Seen, now: MarchState, ahead: Crossing | None
    ) -> tuple[Mask, Real | None, Mask]:
        """Whether all up to the trial point is proved free, by a sample that is not too coarse; the
        detail of the next sample; and whether this one was too coarse."""
        accepted = now.trial_step <= now.proved_step
        if self.overstep > 1:
            knows_side = seen.may_pass | (seen.gaps.smaller > seen.total_error)
            covered = any_covers(seen.look.back, seen.gaps.less(seen.total_error), seen.unproved)
            accepted |= knows_side & covered
        is_known = dr.isfinite(seen.total_error)  # what is not known is not free
        if seen.steep is not None:  # values prove the next step
            is_known = is_known | (now.trial_step <= now.proved_step)
        if now.detail is None or not field.has_detail:
            return accepted & is_known, now.detail, self.backend.Bool(False)
        truncation, coarsest = seen.look.sample.truncation, field.coarsest_detail
        deciding = self._deciding_gap(seen.value, ahead, seen.at_end)
        at = fmax(now.detail, coarsest)
        finer, too_coarse = _finer(at, deciding, seen.total_error, truncation, seen.within)
        coarser = _coarser(at, seen.gaps.smaller, truncation, coarsest)
        if seen.passes is not None and seen.is_doubtful is not None:
            too_coarse |= seen.is_doubtful & accepted  # others go back in any case
            coarser = dr.select(seen.passes, fmax(at, 1), coarser)  # the next knows it too
        accepted &= ~too_coarse & is_known
        detail = dr.select(too_coarse, finer, dr.select(accepted, coarser, now.detail))
        return accepted, detail, too_coarse

    def _cross(
        self,
        seen: _Seen,
        hysteresis: Hysteresis,
        contact: Contact,
        path: Path,
        now: MarchState,
        accepted: Mask,
        ahead: Crossing | None,
        sheet: SheetComparison | None,
    ) -> tuple[Contact, Mask, SheetComparison | None, Real]:
        """The contact behind the trial point, whether rays have crossed the level, the comparison
        with the sheet, and f behind it."""
        value = seen.value
        before = now.proved_to, now.value, dr.dot(now.gradient, path.direction), now.gradient
        last = seen.at_end if sheet is None else seen.at_end & ~sheet.has_crossing
        doubt = dr.select(seen.total_error > seen.within, fmax(seen.excess, now.excess), 0)
        there = Accepted(
            seen.t, value, seen.look.sample.gradient, seen.look.slope, before, doubt,
            seen.total_error, seen.is_near, seen.band, last,
        )  # fmt: skip
        contact, hit = hysteresis.update(contact, accepted, there)
        if ahead is not None and sheet is not None:
            # A crossing before the sheet comes first: the sheet will be sampled again.
            passed = sheet.at_crossing & ~hit
            contact, jumps = hysteresis.jump(contact, passed, there, ahead, path.direction)
            sheet = replace(sheet, at_crossing=passed, is_hit=jumps)
            value = value + dr.select(passed, ahead.jump, 0)
        return contact, hit, sheet, value

    def _proved(self, seen: _Seen, gaps: Gaps, contact: Contact | None) -> Real:
        """How far from the trial point rays are proved free of levels that far away in value."""
        spent = _WIDENING * seen.gaps.smaller
        if self.cover is not None:
            gaps = gaps.less(spent)
        forward = longest_step(seen.look.ahead, gaps.less(seen.total_error))
        if self.cover is not None:
            slope, smallest = seen.look.slope, float(dr.smallest(self.backend.Float))
            widening = fmax(self.cover * seen.gradient_norm, smallest)
            away = dr.select(seen.gaps.down <= seen.gaps.up, slope, -slope)
            for_ever = (forward == dr.inf) & (away >= widening)
            forward = dr.select(for_ever, forward, fmin(forward, spent / widening))
        forward = dr.select(gaps.smaller > seen.total_error, forward, 0)
        if seen.steep is not None and self.cover is None:
            free = seen.steep.free
            if contact is not None:  # in contact, levels lie elsewhere
                free = dr.select(contact.is_touching, seen.steep.free_of(gaps), free)
            forward = fmax(free, forward)
        return forward

    def _jump(
        self,
        occupied: UniformGrid,
        path: Path,
        end: Real,
        seen: _Seen,
        accepted: Mask,
        forward: Real,
        trial: Real,
    ) -> tuple[Real, Real]:
        """The proved and the trial step, made longer by cells without a level behind the proof."""
        free_to = dr.select(accepted, seen.t + forward, self.last)
        free_to = occupied.free_until(path.origin, path.direction, free_to, self.last)
        forward = fmax(forward, dr.select(free_to >= self.last, dr.inf, free_to - seen.t))
        trial = fmax(trial, forward)
        if self.is_part:
            there = path.point(seen.t + fmin(trial, end - seen.t))
            trial = dr.select(occupied.cell(there).free > 0, forward, trial)
        return forward, trial

    def _look_ahead(
        self,
        now: MarchState,
        seen: _Seen,
        end: Real,
        proved: Real,
        contact: Contact | None,
        hit: Mask,
    ) -> Real:
        """How far ahead enclosures are asked to reach next."""
        # After a step of zero, enclosures are asked to reach a third as far: bisection.
        candidate = fmin(now.look_ahead, end - seen.t)
        shorter = dr.select(dr.isfinite(candidate), candidate / 3, 1 + 16 * seen.size)
        tried = dr.select(proved > 0, seen.look.growth * proved, shorter)
        if now.contact is not None and contact is not None:  # off the surface: the whole ray again
            leaves = now.contact.is_touching & ~contact.is_touching
            tried = dr.select(leaves | hit, end - seen.t, tried)
        return tried

    def _is_free(
        self,
        now: MarchState,
        seen: _Seen,
        end: Real,
        accepted: Mask,
        proved_step: Real,
        contact: Contact | None,
    ) -> Mask:
        """Whether rays are proved free to their end."""
        farthest = float(dr.largest(self.backend.Float)) ** _FARTHEST
        proved_to = dr.select(accepted, seen.t, now.proved_to)
        free = proved_to + proved_step >= dr.select(end == dr.inf, farthest, end)
        if self.hysteresis is not None and contact is not None:
            free &= ~(accepted & self.hysteresis.samples_end(contact, end) & (seen.t < end))
        return free

    def _is_near(
        self,
        gap: Real,
        within: Real,
        total_error: Real,
        rounding: Real,
        look: Look,
        gradient_norm: Real,
        size: Real,
        end: Real,
    ) -> Mask:
        """Whether a level is near enough in value for a hit; see `advance`.

        within: how near the tolerance asks it to be. rounding: what it may have done to f.

        A point is no hit if rounding leaves the distance to the surface uncertain by more than a
        sixteenth of a size: that of the coordinates or, if larger, the radius on which f is known
        to be smooth. Nor is it on a ray without an end if rounding alone makes it one and leaves t
        uncertain by more than that size: far enough away, rounding would make a hit of every ray
        that is parallel to the surface.
        """
        sample = look.sample
        near = gap <= fmax(within - sample.truncation, 2 * rounding)
        for promise in sample.known:
            radius = promise.radius
            size = fmax(dr.select(dr.isfinite(radius), radius, 0), size)
        excess = gap + total_error - within
        crosses = (gap <= within - sample.truncation) | (end < dr.inf)
        crosses |= excess <= dr.abs(look.slope) * size
        return near & crosses & (excess <= _LARGEST_UNCERTAINTY * gradient_norm * size)

    def _trial(
        self, forward: Real, look: Look, gaps: Gaps, now: MarchState, path: Path, is_smooth: bool
    ) -> Real:
        """The next trial step, where `forward` is proved: longer, but not past where f is predicted
        to reach a level. The prediction need not be right: a trial must still be proved, looking
        back.

        is_smooth: whether value and slope at the last accepted point help to predict f. Those of an
        approximate field, whose truncation differs from point to point, do not.
        """
        slope = look.slope
        rate, gap = dr.abs(slope), dr.select(slope > 0, gaps.up, gaps.down)
        if is_smooth:
            bend = dr.mulsign(self._bend(look, now, path), slope)
            root = dr.fma(rate, rate, 2 * bend * gap)
            target = _AIM * dr.select(root >= 0, 2 * gap / (rate + dr.sqrt(root)), dr.inf)
        else:
            target = _AIM_BY_SLOPE * dr.select(rate > 0, gap / rate, dr.inf)
        return fmin(self.overstep * forward, fmax(target, forward))

    def _bend(self, look: Look, now: MarchState, path: Path) -> Real:
        """The second derivative here of the cubic with the values and slopes of f here and at the
        last accepted point, a length h before; 0 where nothing was accepted before.

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
        """The status of a ray that goes no farther."""
        ended = dr.select(free, int(Status.MISS), int(Status.OUT_OF_STEPS))
        return self.backend.UInt32(dr.select(hit, int(Status.HIT), ended))

    def _deciding_gap(self, value: Real, ahead: Crossing | None, at_end: Mask | None) -> Real:
        """The distance in value from f to the nearest level; where the sample lies at a sheet, the
        smaller of those of f before and behind the sheet."""
        gap = self.levels.gaps(value).smaller
        if ahead is not None:
            behind = self.levels.gaps(value + ahead.jump).smaller
            gap = dr.select(at_end & (ahead.sheet != NO_SHEET), fmin(gap, behind), gap)
        return gap


def _finer(
    detail: Real, gap: Real, total_error: Real, truncation: Real, within: Real
) -> tuple[Real, Mask]:
    """The detail to sample a point at again, and whether the sample at this detail is too coarse.

    It is too coarse where its error shortens the step by much or decides about a hit, unless
    truncation is a small part of `within`, by which a hit may be off, or of rounding, which more
    detail does not reduce. With the truncation that is allowed the march still arrives at hits: its
    steps end where a level is as near as `total_error`, and 1.25 times that is less than what makes
    a hit, within - truncation or twice the rounding.
    """
    rounding = total_error - truncation
    allowed = fmax(_OF_TOLERANCE * within - _LESS * rounding, _OF_ROUNDING * rounding)
    again = (gap < _REFINE_BELOW * total_error) & (truncation > allowed) & (detail < _MOST_DETAIL)
    wanted = fmax(_OF_GAP * gap, _OF_ALLOWED * allowed)
    closer = clamp(dr.power(truncation / wanted, 1 / _POWER), *_CLOSER)
    return fmin(fmax(detail * closer, 1), _MOST_DETAIL), again


def _coarser(detail: Real, gap: Real, truncation: Real, coarsest: float) -> Real:
    """The detail for the next sample, at most that of this one, given the truncation of this one
    and
    its gap to the next level: 0 for the coarsest, or at least 1."""
    wanted = detail * dr.power(truncation / (_COARSEN * gap), 1 / _POWER)
    return dr.select(wanted > coarsest, fmin(fmax(wanted, 1), detail), 0)
