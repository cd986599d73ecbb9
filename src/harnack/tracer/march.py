"""The only marching loop: the first point of a ray on a level set, with every step proved.

It knows neither fields nor proofs. It asks a field for a sample, the certificates of the sample
for a bound, and the bound how far the ray is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.backend.lengths import largest_component, length
from harnack.certify import Levels, certify
from harnack.fields.sheets import NO_SHEET, Crossing
from harnack.tracer.stretches import STATUS, State, Walk, loop, meet
from harnack.tracer.tolerance import PreparedTolerance, Status

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.bounds import Longest
    from harnack.certify import Certificate
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume


# A sample is repeated more closely where a level is nearer in value than this many times its error,
# to make truncation this part of that distance, or of what truncation may be (`_finer`).
_REFINE_BELOW, _OF_GAP, _OF_ALLOWED = 2.0, 0.25, 0.85
# Of the tolerance, less so many roundings, and of rounding: what truncation may be at a hit.
_OF_TOLERANCE, _LESS, _OF_ROUNDING = 0.4, 0.55, 0.6
# The next sample may be so coarse that its truncation is this part of the distance to a level.
_COARSEN = 0.2
# Trials stop short of where the slope alone would take f to a level by this factor.
_AIM = 0.99
# Of the size of coordinates, how far from the surface rounding may leave a point that is a hit.
_CLEAR = 1 / 16
# A repeated sample is closer by these factors at least and at most.
_CLOSER = 1.25, 16.0
# Truncation falls like this power of detail; beyond the largest detail there is none.
_POWER, _MOST_DETAIL = 3.2, 1e6


@dataclass(frozen=True)
class Trace:
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
    levels: Levels
    volume: Volume | None
    bound: Longest
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
        return self._march(o, d, t_min, t_max, active)[0][STATUS] != int(Status.MISS)

    def first_hit(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Trace:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        state, sheet = self._march(o, d, t_min, t_max, active)
        t, _, _, f, g, excess, evaluations, _, status, _ = state
        missed = status == int(Status.MISS)
        return Trace(dr.select(missed, dr.inf, t), f, g, excess, evaluations, status, sheet)

    def _march(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask) -> tuple[State, Any]:
        """The end state of rays, and the index of the sheet that each hit."""
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        o, d = vector(o), vector(d)
        start, end = self.clip(o, d, real(t_min), real(t_max))
        running = self.backend.Bool(active) & (start < end)
        state: State = (
            real(start), real(0), real(0), real(0), vector(0), real(0), count(0),
            real(0), count(int(Status.MISS)), running,
        )  # fmt: skip
        if not self.field.has_sheets:
            return self._advance(self.field.along(d), o, d, end, state), count(NO_SHEET)

        def march(field: Field, stop: Real, ahead: Crossing, state: State) -> State:
            return self._advance(field, o, d, stop, state, ahead)

        walk = Walk(
            self.backend, self.field, o, d, real(start), real(end),
            self.max_steps, self.overstep, march,
        )  # fmt: skip
        return walk.run(state)

    def _advance(
        self, field: Field, o: Vec3, d: Vec3, end: Real, state: State, ahead: Crossing | None = None
    ) -> State:
        """The loop. Proof that no hit is missed: `base` is a point up to which the ray is free,
        `reach` a proved length from there. A trial point base + step is accepted only if step <=
        reach, or the bound at the trial point looking back covers step - reach; then all up to it
        is free. Otherwise the ray goes back to base + reach, which needs no such test. A ray ends
        as a miss when base + reach passes its end, as a hit only at an accepted point. A point is
        not accepted on a sample that is too coarse (`_finer`), but sampled again.

        A hit is a point where f is within the tolerance of a level *after* the truncation error of
        f is taken off; where rounding leaves f less certain than that, within twice what it leaves.
        A trial point at which the level is nearer than the error of f may lie behind the root, by
        less than the tolerance: it is a hit (`_finer`), so nothing is passed there.

        In rounded arithmetic a surface could slip through between the two looks, so both see
        it nearer by the rounding of value and position together (`_blur`).

        ahead: of a field with sheets, the crossing at `end`, on lanes where there is one. Those
        lanes look at that point as well. Accepted there, they hit the sheet or have passed it: a
        miss, with the step that the value behind the sheet allows from there.
        """
        real, vector, bound = self.backend.Float, self.backend.Array3f, self.bound
        size = largest_component(o)

        def body(
            base: Real, step: Real, reach: Real, f: Real, g: Vec3, excess: Real, n: Any,
            detail: Real, status: Any, active: Mask,
        ) -> State:  # fmt: skip
            t = base + step
            if ahead is not None:  # the crossing exactly
                t = dr.select(step >= end - base, end, t)
            beyond = None if ahead is None else (ahead, t == end)
            seen = field.at_detail(detail) if field.has_detail else field
            sample = seen.evaluate(dr.fma(vector(t), d, o))
            gaps, steepness = self.levels.gaps(sample.value), length(sample.gradient)
            blur = self._blur(sample, steepness, size + t)
            certificates, ahead_gaps = self._certify(sample, gaps, blur), gaps
            slope, doubt = dr.dot(sample.gradient, d), sample.gradient_error
            accepted = step <= reach
            if self.overstep > 1:
                accepted |= _covers(bound, certificates, -slope, doubt, step - reach)
            within = self.tolerance.in_value(fmax(steepness - doubt, real(0)), t)
            truncation, gap = sample.truncation, fmin(*gaps)
            again, closer, coarser = self.backend.Bool(False), detail, detail
            if field.has_detail:
                deciding = self._deciding_gap(sample.value, beyond)
                now = fmax(detail, field.coarsest_detail)
                closer, again = _finer(now, deciding, blur, truncation, within)
                coarser = _coarser(now, gap, truncation, field.coarsest_detail)
            accepted &= ~again & dr.isfinite(blur)  # what is not known is not free
            detail = dr.select(again, closer, dr.select(accepted, coarser, detail))
            # Where not even the gradient is known, rounding makes no hits.
            rounded = dr.select(doubt <= steepness, 2 * (blur - truncation), 0)
            hit, met = accepted & (gap <= fmax(within - truncation, rounded)), None
            # Nor is a point one of which rounding hardly says where the surface is.
            hit &= gap + blur - within <= _CLEAR * steepness * (size + t)
            if beyond is not None:
                met = meet(beyond[0], accepted & beyond[1], sample.value, blur, self.levels)
                certificates, ahead_gaps = self._certify(sample, met.gaps, blur), met.gaps
            forward = fmax(_step(bound, certificates, slope, doubt), real(0))
            trial = self._trial(forward, slope, ahead_gaps)
            step = dr.select(accepted, trial, dr.select(again, step, reach))
            reach, base = dr.select(accepted, forward, reach), dr.select(accepted, t, base)
            f, g = dr.select(accepted, sample.value, f), dr.select(accepted, sample.gradient, g)
            excess = dr.select(accepted, fmax(gap + blur - within, real(0)), excess)
            n, free = n + 1, base + reach >= end
            if met is not None:
                free = dr.select(met.awaited, met.passed, free)
            status = self._status(hit, free)
            if met is not None:
                status, g = met.mark(status, g)
            active = active & ~(hit | free | (n >= self.max_steps))
            step = fmin(step, end - base)
            return base, step, reach, f, g, excess, n, detail, status, active

        return loop(state, body, "harnack")

    def _trial(self, forward: Real, slope: Real, gaps: tuple[Real, Real]) -> Real:
        """How far to try, where `forward` is proved: longer, but not past where the slope alone
        would take f to a level. Whatever is tried must still be proved, looking back."""
        down, up = gaps
        rate = dr.abs(slope)
        crossing = dr.select(rate > 0, dr.select(slope > 0, up, down) / rate, dr.inf)
        return fmin(self.overstep * forward, fmax(_AIM * crossing, forward))

    def _status(self, hit: Mask, free: Mask) -> Any:
        """Of a ray that goes no farther."""
        ended = dr.select(free, int(Status.MISS), int(Status.OUT_OF_STEPS))
        return self.backend.UInt32(dr.select(hit, int(Status.HIT), ended))

    def _deciding_gap(self, value: Real, beyond: tuple[Crossing, Mask] | None) -> Real:
        """The distance in value to the nearest level, of f or of what f is behind the crossing at
        the end of the stretch. beyond: that crossing, and whether this is there."""
        gap = fmin(*self.levels.gaps(value))
        if beyond is not None:
            ahead, there = beyond
            behind = self.levels.gaps(value + ahead.jump)
            gap = dr.select(there & (ahead.sheet != NO_SHEET), fmin(gap, fmin(*behind)), gap)
        return gap

    def _certify(
        self, sample: Sample, gaps: tuple[Real, Real], blur: Real
    ) -> tuple[Certificate, ...]:
        """What is known about levels these gaps (down, up) away, known up to `blur`."""
        (down, up), real = gaps, self.backend.Float
        return certify(sample, fmax(down - blur, real(0)), fmax(up - blur, real(0)))

    def _blur(self, sample: Sample, steepness: Real, size: Real) -> Real:
        """What rounding may have done to f at a point whose coordinates are at most `size`."""
        epsilon = self.backend.epsilon
        position = 4 * epsilon * size
        # What is below the smallest normal number is lost.
        value = 8 * fmax(epsilon * dr.abs(sample.value), self.backend.Float(self._smallest))
        return dr.fma(steepness, position, value + sample.error)

    @property
    def _smallest(self) -> float:
        return float(dr.smallest(self.backend.Float))


def _finer(
    detail: Real, gap: Real, blur: Real, truncation: Real, within: Real
) -> tuple[Real, Mask]:
    """The detail to sample a point at again, and whether the sample at this one is too coarse.

    It is where its error shortens the step by much or decides about a hit, unless truncation is a
    small part of it: of what a hit may be off, `within`, or of rounding, which no detail helps.
    What is allowed leaves the march a way to a hit: its steps end where a level is as near as
    `blur`, and 1.25 times that is less than what makes a hit, within - truncation or twice the
    rounding.
    """
    rounding = blur - truncation
    allowed = fmax(_OF_TOLERANCE * within - _LESS * rounding, _OF_ROUNDING * rounding)
    again = (gap < _REFINE_BELOW * blur) & (truncation > allowed) & (detail < _MOST_DETAIL)
    wanted = fmax(_OF_GAP * gap, _OF_ALLOWED * allowed)
    closer = clamp(dr.power(truncation / wanted, 1 / _POWER), *_CLOSER)
    return fmin(fmax(detail * closer, 1), _MOST_DETAIL), again


def _coarser(detail: Real, gap: Real, truncation: Real, coarsest: float) -> Real:
    """The detail for the next sample, no finer than that of this one, with its truncation and a gap
    to the next level: 0 for as coarse as can be, or at least 1."""
    wanted = detail * dr.power(truncation / (_COARSEN * gap), 1 / _POWER)
    return dr.select(wanted > coarsest, fmin(fmax(wanted, 1), detail), 0)


def _step(bound: Longest, certificates: tuple[Certificate, ...], slope: Real, doubt: Real) -> Real:
    """The longest proved step where the slope is known up to `doubt` (0: exactly).

    Proof. A bound encloses f along the ray; both ends of the enclosure do not fall as the slope
    grows (more of the measure or of its caps lies ahead), so what slope + doubt proves about
    levels above and slope - doubt about levels below holds for every slope in between.
    """
    if isinstance(doubt, float) and doubt == 0.0:
        return bound.step(certificates, slope)
    best = type(slope)(0)
    for one, certificate in bound.pairs(certificates):
        steps = [fmax(one.step(certificate, slope + s), best * 0) for s in (doubt, -doubt)]
        best = fmax(fmin(*steps), best)
    return best


def _covers(
    bound: Longest, certificates: tuple[Certificate, ...], slope: Real, doubt: Real, length: Real
) -> Mask:
    """Whether the length is proved free whatever the slope is, up to `doubt`; see `_step`."""
    if isinstance(doubt, float) and doubt == 0.0:
        return bound.covers(certificates, slope, length)
    free = length <= 0
    for one, certificate in bound.pairs(certificates):
        ends = (one.covers(certificate, slope + s, length) for s in (doubt, -doubt))
        free |= next(ends) & next(ends)
    return free
