"""The only marching loop: the first point of a ray on a level set, with every step proved.

It knows neither fields nor proofs. It asks a field for a sample, the certificates of the sample
for a bound, and the bound how far the ray is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.certify import Levels, certify
from harnack.tracer.tolerance import Status, Tolerance

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.bounds import Longest
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume


# base, step, reach, value, gradient, evaluations, status, active: see `_advance`.
State: TypeAlias = "tuple[Any, ...]"
_STATUS = 6


@dataclass(frozen=True)
class Trace:
    """Ends of rays, as Dr.Jit arrays. t is where the proof of freedom ends (inf for a miss)."""

    t: Real
    value: Real
    gradient: Vec3
    evaluations: Any
    status: Any


@dataclass(frozen=True)
class PreparedLevelSet:
    """A level set on a backend. Its methods can be called while a kernel is being recorded."""

    backend: Backend
    field: Field
    levels: Levels
    volume: Volume | None
    bound: Longest
    tolerance: Tolerance
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
        return self._march(o, d, t_min, t_max, active)[_STATUS] != int(Status.MISS)

    def first_hit(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask = True) -> Trace:
        """The first hit of rays o + t d, |d| = 1, for t_min <= t <= t_max. Inactive rays miss."""
        t, _, _, f, g, evaluations, status, _ = self._march(o, d, t_min, t_max, active)
        missed = status == int(Status.MISS)
        return Trace(dr.select(missed, dr.inf, t), f, g, evaluations, status)

    def _march(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real, active: Mask) -> State:
        """The end state of rays."""
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        o, d = vector(o), vector(d)
        start, end = self.clip(o, d, real(t_min), real(t_max))
        running = self.backend.Bool(active) & (start < end)
        state: State = (
            real(start), real(0), real(0), real(0), vector(0), count(0),
            count(int(Status.MISS)), running,
        )  # fmt: skip
        return self._advance(o, d, end, state)

    def _advance(self, o: Vec3, d: Vec3, end: Real, state: State) -> State:
        """The loop. Proof that no hit is missed: `base` is a point up to which the ray is free,
        `reach` a proved length from there. A trial point base + step is accepted only if step <=
        reach, or the bound at the trial point looking back covers step - reach; then all up to it
        is free. Otherwise the ray goes back to base + reach, which needs no such test. A ray ends
        as a miss when base + reach passes its end, as a hit only at an accepted point.

        In rounded arithmetic a surface could slip through between the two looks, so both see
        it nearer by the rounding of value and position together (`_blur`).
        """
        real, vector, bound = self.backend.Float, self.backend.Array3f, self.bound
        size = fmax(fmax(dr.abs(o.x), dr.abs(o.y)), dr.abs(o.z))

        def body(
            base: Real, step: Real, reach: Real, f: Real, g: Vec3, n: Any, status: Any, active: Mask
        ) -> State:
            t = base + step
            sample = self.field.evaluate(dr.fma(vector(t), d, o))
            down, up = self.levels.gaps(sample.value)
            steepness = dr.norm(sample.gradient)
            blur = self._blur(sample, steepness, size + t)
            certificates = certify(sample, fmax(down - blur, real(0)), fmax(up - blur, real(0)))
            slope = dr.dot(sample.gradient, d)
            accepted = step <= reach
            if self.overstep > 1:
                accepted |= bound.covers(certificates, -slope, step - reach)
            close = fmax(self.tolerance.in_value(steepness, t), 2 * blur)
            hit = accepted & (fmin(down, up) <= close)
            forward = fmax(bound.step(certificates, slope), real(0))
            step = dr.select(accepted, self.overstep * forward, reach)
            reach = dr.select(accepted, forward, reach)
            base = dr.select(accepted, t, base)
            f = dr.select(accepted, sample.value, f)
            g = dr.select(accepted, sample.gradient, g)
            n = n + 1
            free = base + reach >= end
            ended = dr.select(free, int(Status.MISS), int(Status.OUT_OF_STEPS))
            status = self.backend.UInt32(dr.select(hit, int(Status.HIT), ended))
            active = active & ~(hit | free | (n >= self.max_steps))
            return base, fmin(step, end - base), reach, f, g, n, status, active

        def running(*state: Any) -> Mask:
            return state[-1]

        try:
            return dr.while_loop(state, running, body, label="harnack")
        except RuntimeError as error:  # Dr.Jit wraps what the body raises
            raise (error.__cause__ or error) from None

    def _blur(self, sample: Sample, steepness: Real, size: Real) -> Real:
        """What rounding may have done to f at a point whose coordinates are at most `size`."""
        epsilon = self.backend.epsilon
        position = 4 * epsilon * size
        return dr.fma(steepness, position, dr.fma(8 * epsilon, dr.abs(sample.value), sample.error))
