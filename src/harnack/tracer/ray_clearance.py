"""The clearance of rays that miss a surface: how near they came to it. The surface is where f, the
function of a field, takes a level. The clearance e of a ray is the least first-order distance

    |f - level| / |grad f|

that was found along it. `trace` measures it if it is asked to, and attaches its derivatives: a loss
over masks then has a gradient where a ray should hit and misses.

The march itself cannot supply it. Its proofs pass over whole rays in a step or two, its samples
lie where the proofs need them, and a ray that misses the extent of the surface is not sampled at
all. So rays that missed are sampled again, at distances that follow e, and e is minimized between
the samples beside the least one. Nothing of the march changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.elementary import clamp, fmax, fmin, max_norm
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.loops import compute_on_active, loop_while_active
from harnack.fields.attached_numbers import gradient_with_parameters, refuse_moving_domain
from harnack.fields.capabilities import EXACT
from harnack.tracer.derivatives import (
    change_of_nearest_level,
    change_of_value,
    with_implicit_derivative,
)
from harnack.tracer.surface import intersection_of

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.trace_options import TraceOptions
    from harnack.tracer.traced_surface import TracedSurface

# Samples lie this fraction of the first-order distance apart, but at least one pitch, and at most
# the third number of pitches. The pitch is the sampled length over the second number; on a ray
# without an end, the size of its coordinates over the fourth number.
_STEP_FRACTION, _PITCHES, _LONGEST_STEP, _PITCHES_OF_SIZE = 0.25, 64, 4, 32
# The largest number of samples (only rays without an end need that many), and of steps by which the
# least e is then refined.
_MAX_SAMPLES, _MAX_REFINEMENTS = 128, 48
# The fraction of an interval at which it is divided by the golden ratio.
_GOLDEN = 0.3819660112501051
# |grad f| is differentiated by differences over this power of the machine epsilon times e, or times
# the second number times the size of coordinates if that is larger.
_DIFFERENCE_EXPONENT, _SMALLEST_LENGTH = 1 / 3, 2.0**-10
# Where the gradient changes by more than this fraction over such a difference, there is a crease.
_CREASE_CHANGE = 1 / 8


def validate_clearance(surface: TracedSurface, options: TraceOptions) -> None:
    """Raise an error if the clearance of rays from this surface is not defined here.

    Raises:
        ValueError: only the largest component is traced, as e is small beside the others, too; or
            another device traces the rays.
        NotImplementedError: the field jumps at facets, or is a union of patches; or derivatives
            are enabled on numbers that move its domain.
    """
    refuse_moving_domain(surface.field)
    if options.backend is not None:
        raise ValueError(
            f'clearance=True is not measured with backend="{options.backend}": leave out one of '
            "the two"
        )
    if surface.largest:
        raise ValueError(
            "clearance=True knows the levels of f, and not which component they belong to: leave "
            "out largest"
        )
    traits, name = surface.field.traits, type(surface.field).__name__
    if traits.has_jumps:
        raise NotImplementedError(
            f"clearance=True takes a field without jumps, and this {name} has facets, to which "
            "values of f give no distance"
        )
    if traits.has_patches:
        raise NotImplementedError(
            f"clearance=True takes one function, and this {name} has one for each patch: trace a "
            "patch by itself, such as mesh.face(0) of a polygon mesh"
        )


@dataclass(frozen=True)
class Nearest:
    """Where rays come nearest to a surface, to first order.

    t, clearance: the ray parameters, and the clearance there; both inf on rays that are sampled
        nowhere.
    at_boundary: mask of the rays that come nearest where they enter or leave the region in which
        levels count (`ClearanceSearch.region`).
    """

    t: Real
    clearance: Real
    at_boundary: Mask


@dataclass(frozen=True)
class _MissedRay:
    """The rays whose clearance is measured, as a dataclass of arrays for `compute_on_active`:
    origins and directions (3,), and the ray parameters between which they were traced."""

    origin: Vec3
    direction: Vec3
    t_min: Real
    t_max: Real


@dataclass(frozen=True)
class ClearanceSearch:
    """The surface as the search for the nearest point of a ray needs it.

    tracer: the surface.
    region: the volume in which f may be evaluated and levels count: the intersection of the field's
        domain, clip and section. None for all of space.
    center, radius: a ball around the box of the surface's proved extent; None if there is no
        bounded one.
    """

    tracer: SurfaceTracer
    region: Volume | None
    center: Vec3 | None
    radius: Real

    @classmethod
    def of(cls, surface: TracedSurface, tracer: SurfaceTracer) -> ClearanceSearch:
        """Prepare the search for a surface. tracer: its tracer."""
        backend = tracer.backend
        region = intersection_of([surface.field.domain, surface.clip, surface.section])
        center, radius = None, backend.Float(0)
        if surface.volume is not None:
            low, high = surface.volume.bounds()
            if np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all():
                center = as_kernel_parameters(backend.Array3f(*((low + high) / 2).tolist()))
                radius = dr.opaque(backend.Float, float(np.linalg.norm(high - low) / 2))
        return cls(tracer, None if region is None else region.upload(backend), center, radius)

    def nearest(self, is_missed: Mask, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> Nearest:
        """Return where the rays o + t d, |d| = 1, come nearest to the surface, evaluated.

        is_missed: mask of the rays that are searched; the others get t = inf and clearance inf.
        o, d, t_min, t_max: the rays, without derivatives.
        """
        backend = self.tracer.backend
        endless = backend.Float(dr.inf)
        return compute_on_active(
            is_missed,
            lambda ray: self._nearest(ray),
            _MissedRay(o, d, t_min, t_max),
            Nearest(endless, endless, backend.Bool(False)),
        )

    def _nearest(self, ray: _MissedRay) -> Nearest:
        """Return where each ray comes nearest to the surface: the least sample, refined between the
        samples before and after it."""
        low, high = ray.t_min, ray.t_max
        if self.region is not None:
            low, high = self.region.clip(ray.origin, ray.direction, low, high)
        is_met = low <= high
        low, high = dr.select(is_met, low, 0), dr.select(is_met, high, 0)
        start, end = self._interval(ray, low, high)
        scan = _Scan.at(self.tracer.backend, start, end, is_met)
        scan = loop_while_active(
            scan, lambda now: self._next_sample(ray, now, end), "harnack clearance scan"
        )
        least = _Minimum.between(self.tracer.backend, scan)
        least = loop_while_active(
            least, lambda now: self._next_refinement(ray, now), "harnack clearance"
        )
        is_found = dr.isfinite(least.e)
        enters, leaves = (
            (least.t == low) & (low > ray.t_min),
            (least.t == high) & (high < ray.t_max),
        )
        return Nearest(
            t=dr.select(is_found, least.t, dr.inf),
            clearance=dr.select(is_found, least.e, dr.inf),
            at_boundary=is_found & (enters | leaves),
        )

    def _interval(self, ray: _MissedRay, low: Real, high: Real) -> tuple[Real, Real]:
        """Return the ray parameters between which each ray is sampled. low, high: those of its part
        in `region`.

        Let D be the distance of the ray from the center of the ball. The ray is sampled as far as
        radius + D from its point nearest to the center, and at the nearer end of its part in
        `region` if that lies farther away.
        """
        if self.center is None:
            return low, high
        o, d = ray.origin, ray.direction
        middle = dr.dot(self.center - o, d)
        half = self.radius + norm(dr.fma(type(o)(middle), d, o) - self.center)
        return clamp(middle - half, low, high), clamp(middle + half, low, high)

    def _first_order_distance(self, ray: _MissedRay, t: Real, active: Mask) -> Real:
        """Return e at the ray parameters t; inf where it has no value, as where grad f is 0."""
        point = dr.fma(type(ray.origin)(t), ray.direction, ray.origin)
        sample = self.tracer.sample_where(point, active)
        gap = self.tracer.levels.gaps(sample.value).nearest
        e = gap / norm(sample.gradient)
        return dr.select(gap == 0, 0, dr.select(dr.isfinite(e), e, dr.inf))

    def _next_sample(self, ray: _MissedRay, now: _Scan, end: Real) -> _Scan:
        """Return the state of the scan after one more sample of each ray. end: where it ends."""
        t, e = now.t, self._first_order_distance(ray, now.t, now.active)
        is_less = e < now.least
        pitch = dr.select(
            dr.isfinite(end), now.pitch, (max_norm(ray.origin) + t) / _PITCHES_OF_SIZE + now.pitch
        )
        step = fmin(fmax(_STEP_FRACTION * e, pitch), _LONGEST_STEP * pitch)
        samples = now.samples + 1
        return _Scan(
            t=fmin(t + step, end),
            previous=t,
            least=dr.select(is_less, e, now.least),
            least_at=dr.select(is_less, t, now.least_at),
            before=dr.select(is_less, now.previous, now.before),
            # The sample after the least one is the next one, unless that is less.
            after=dr.select(is_less | (now.previous == now.least_at), t, now.after),
            pitch=now.pitch,
            samples=samples,
            active=now.active & (t < end) & (samples < _MAX_SAMPLES),
        )

    def _next_refinement(self, ray: _MissedRay, now: _Minimum) -> _Minimum:
        """Return the state of the minimization after one more sample of each ray."""
        t = now.trial()
        return now.updated(t, self._first_order_distance(ray, t, now.active))


@dataclass(frozen=True)
class _Scan:
    """The state of the scan of rays for the sample with the least e, as a dataclass of arrays.

    t, previous: the ray parameters of the next sample and of the last one.
    least, least_at: the least e so far, and its ray parameter.
    before, after: the ray parameters of the samples before and after the least one.
    pitch: the shortest step.
    samples: the number of samples so far.
    active: whether the ray goes on.
    """

    t: Real
    previous: Real
    least: Real
    least_at: Real
    before: Real
    after: Real
    pitch: Real
    samples: Any
    active: Mask

    @classmethod
    def at(cls, backend: Backend, start: Real, end: Real, active: Mask) -> _Scan:
        """Return the state before the first sample. start, end: the ray parameters between which
        rays are sampled. active: mask of the rays that are sampled."""
        real = backend.Float
        # (On a ray without an end, the smallest step that is no step of 0.)
        pitch = dr.select(dr.isfinite(end), (end - start) / _PITCHES, backend.machine_epsilon)
        return cls(
            real(start), real(start), real(dr.inf), real(start), real(start), real(start), pitch,
            backend.UInt32(0), backend.Bool(active),
        )  # fmt: skip


@dataclass(frozen=True)
class _Minimum:
    """The state of Brent's minimization of e along rays (Brent 1973, chapter 5), which takes the
    vertex of a parabola through three samples, or divides the interval by the golden ratio.

    low, high: the ray parameters between which the minimum lies.
    t, second, third: those of the three least samples, with the values e, e_second and e_third.
    step, last_step: the last step of t and the one before it.
    tolerance: the length up to which t is found. Beyond the root of rounding, values of e no
        longer differ.
    count: the number of samples so far.
    active: whether the minimization goes on.
    """

    low: Real
    high: Real
    t: Real
    second: Real
    third: Real
    e: Real
    e_second: Real
    e_third: Real
    step: Real
    last_step: Real
    tolerance: Real
    count: Any
    active: Mask

    @classmethod
    def between(cls, backend: Backend, scan: _Scan) -> _Minimum:
        """Begin between the samples before and after the least one of a scan that has ended."""
        t, e, low, high = scan.least_at, scan.least, scan.before, scan.after
        tolerance = backend.machine_epsilon**0.5 * (high - low) / 4
        zero = backend.Float(0)
        return cls(
            low, high, t, t, t, e, e, e, zero, zero, tolerance, backend.UInt32(0),
            (low < high) & (e > 0) & dr.isfinite(e),
        )  # fmt: skip

    def trial(self) -> Real:
        """Return the ray parameters of the next samples."""
        return self.t + self._step()[0]

    def _step(self) -> tuple[Real, Real]:
        """Return the step from t to the next sample, and the `last_step` that belongs to it."""
        middle = (self.low + self.high) / 2
        # The vertex of the parabola is at t + p/q.
        r = (self.t - self.second) * (self.e - self.e_third)
        q = (self.t - self.third) * (self.e - self.e_second)
        p = (self.t - self.third) * q - (self.t - self.second) * r
        q = 2 * (q - r)
        p, q = dr.select(q > 0, -p, p), dr.abs(q)
        is_parabola = (
            (dr.abs(self.last_step) > self.tolerance)
            & (dr.abs(p) < dr.abs(0.5 * q * self.last_step))
            & (p > q * (self.low - self.t))
            & (p < q * (self.high - self.t))
        )
        parabolic = p / q
        to_ends = fmin(self.t + parabolic - self.low, self.high - self.t - parabolic)
        inward = dr.select(middle >= self.t, self.tolerance, -self.tolerance)
        parabolic = dr.select(to_ends < 2 * self.tolerance, inward, parabolic)
        longer = dr.select(self.t >= middle, self.low - self.t, self.high - self.t)
        step = dr.select(is_parabola, parabolic, _GOLDEN * longer)
        smallest = dr.select(step >= 0, self.tolerance, -self.tolerance)
        step = dr.select(dr.abs(step) >= self.tolerance, step, smallest)
        return step, dr.select(is_parabola, self.step, longer)

    def updated(self, t: Real, e: Real) -> _Minimum:
        """Return the state after a sample with value e at t = `trial()`."""
        step, last_step = self._step()
        is_least = e <= self.e
        # The interval ends at the worse one of the two samples.
        worse = dr.select(is_least, self.t, t)
        is_low = dr.select(is_least, t >= self.t, t < self.t)
        low, high = dr.select(is_low, worse, self.low), dr.select(is_low, self.high, worse)
        is_second = ~is_least & ((e <= self.e_second) | (self.second == self.t))
        is_third = (e <= self.e_third) | (self.third == self.t) | (self.third == self.second)
        is_third &= ~is_least & ~is_second
        moves = is_least | is_second
        count = self.count + 1
        best = dr.select(is_least, t, self.t)
        is_exact = dr.abs(best - (low + high) / 2) <= 2 * self.tolerance - (high - low) / 2
        return _Minimum(
            low=low,
            high=high,
            t=best,
            second=dr.select(is_least, self.t, dr.select(is_second, t, self.second)),
            third=dr.select(moves, self.second, dr.select(is_third, t, self.third)),
            e=dr.select(is_least, e, self.e),
            e_second=dr.select(is_least, self.e, dr.select(is_second, e, self.e_second)),
            e_third=dr.select(moves, self.e_second, dr.select(is_third, e, self.e_third)),
            step=step,
            last_step=last_step,
            tolerance=self.tolerance,
            count=count,
            active=self.active & ~is_exact & (count < _MAX_REFINEMENTS),
        )


def attach_clearance_derivative(
    search: ClearanceSearch, o: Vec3, d: Vec3, nearest: Nearest
) -> Real:
    """Return the clearance e of rays with its derivatives by rays, levels and parameters of f.

    search: the surface.
    o, d: (3,) origins and directions of the rays, possibly with derivatives.
    nearest: where rays come nearest to the surface, without derivatives.

    The clearance is the minimum of e over t. By the envelope theorem, its derivative is that of e
    at a fixed t, whether de/dt = 0 there or t is an end of the ray. (Where the ray enters or leaves
    the region in which levels count, t has the derivative of the ray parameter at which the ray
    meets the tangent plane of that boundary.) With s the sign of f - level and n = grad f/|grad f|,

        de = (s (df - dlevel) - e d|grad f|) / |grad f|,     d|grad f| = n . d(grad f).
    """
    tracer, backend = search.tracer, search.tracer.backend
    vector = backend.Array3f
    with dr.suspend_grad():
        is_near = dr.isfinite(nearest.clearance) & dr.isfinite(nearest.t)
        t, e = dr.select(is_near, nearest.t, 0), dr.select(is_near, nearest.clearance, 0)
        if tracer.evaluator.variable_accuracy is not None:
            # The derivative of a truncation error may be much larger than the error.
            scale = dr.select(is_near, backend.Float(EXACT), 0)
            tracer = replace(tracer, evaluator=tracer.evaluator.variable_accuracy.at(scale))
        x = dr.fma(vector(t), dr.detach(d), dr.detach(o))
        sample = tracer.sample(x)
        gaps, length = tracer.levels.gaps(sample.value), norm(sample.gradient)
        sign = dr.select(gaps.above < gaps.below, backend.Float(-1), 1)
        inverse = dr.select(is_near & (length > 0), 1 / length, 0)
        dr.eval(x, sample.value, sample.gradient, sign, inverse)
    point = dr.fma(vector(t), d, o)
    if search.region is not None:
        # On the boundary, t moves with the ray.
        normal = dr.detach(search.region.outward_normal(x))
        slope = dr.dot(normal, dr.detach(d))
        change = dr.dot(normal, point - x)
        moved = with_implicit_derivative(t, change, slope, nearest.at_boundary)
        point = dr.fma(vector(moved), d, o)
    value_change = change_of_value(tracer, point, x, sample.gradient)
    gap_change = sign * (value_change - change_of_nearest_level(tracer, sample.value))
    length_change = _change_of_gradient_norm(tracer, point, x, e, sample.gradient, inverse)
    return dr.replace_grad(nearest.clearance, (gap_change - e * length_change) * inverse)


def _change_of_gradient_norm(
    tracer: SurfaceTracer, point: Vec3, x: Vec3, e: Real, gradient: Vec3, inverse: Real
) -> Real:
    """Return a zero with a derivative: that of |grad f| at points, by the points and by the
    parameters of the field.

    tracer: the surface. point: (3,) points, possibly with derivatives.
    x, gradient: (3,) the same points without derivatives, and grad f there.
    e: the first-order distance of the surface, which sets the scale of differences.
    inverse: 1/|grad f|; 0 where no derivative is attached.

    Formulas and solids give the derivative of their gradient. For other fields mixed derivatives
    are not known, but those of values are: with n = grad f/|grad f|, n . grad f is the derivative
    of f along n, which is taken here as (f(x + h n) - f(x - h n))/(2h) with constant n and h. With
    h = u^(1/3) e, for a machine epsilon u, what differences leave out and what rounding does to
    them are both about u^(2/3) of e d|grad f|.

    Where a crease of such a field lies between x and x +- h n, |grad f| is held constant: the
    difference of the functions on both sides, over h, is no derivative.
    """
    backend = tracer.backend
    normal = gradient * inverse
    known = gradient_with_parameters(tracer.field, tracer.evaluator, point)
    if known is not None:
        return dr.dot(normal, known - dr.detach(known))
    with dr.suspend_grad():
        h = fmax(e, _SMALLEST_LENGTH * max_norm(x))
        h = h * backend.machine_epsilon**_DIFFERENCE_EXPONENT
        # (On other lanes, h may be 0.)
        offset, weight = normal * h, dr.select((inverse > 0) & (h > 0), 0.5 / h, 0)
        gradients = tracer.sample(x - offset).gradient, tracer.sample(x + offset).gradient
        if tracer.field.traits.has_creases:
            change = fmax(*(max_norm(beside - gradient) for beside in gradients))
            weight = dr.select(change * inverse <= _CREASE_CHANGE, weight, 0)
        dr.eval(offset, gradients, weight)
    before, after = (
        change_of_value(tracer, point + shift, x + shift, beside)
        for shift, beside in zip((-offset, offset), gradients, strict=True)
    )
    return weight * (after - before)
