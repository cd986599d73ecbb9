"""First hits of rays with level sets and closed solids: refined positions, oriented normals.

Everything here is in the surface's own coordinates and knows no Mitsuba;
`hybrid_scene.surface_interaction` turns a hit into what a BSDF takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend import Mask, Real, Vec3
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.loops import compute_on_active, update_where_active
from harnack.fields.samples import Sample
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from harnack.tracer import MarchResult, SurfaceTracer, TracedSurface

# A hit is refined by at most this many tolerances: along a ray that only grazes the surface there
# is no crossing to converge to.
_MAX_REFINEMENT = 2.0
# A ray leaves a surface this many tolerances away from it, so as not to meet it again there.
RAY_OFFSET = 4.0
# Normals of grazing hits are tilted until their cosine with the ray is at least this.
_GRAZING = 1e-3


@dataclass
class SurfaceHit:
    """First hits of rays. Rays without a hit have is_hit = is_out_of_steps = False and t = inf.

    t: ray parameter of the hit; of a ray out of steps, up to where it is proved free.
    is_hit: there is a surface at t.
    is_out_of_steps: the ray ran out of steps behind t.
    position, normal: of the surface. The normal is unit and points toward larger values or, of a
        solid, outward.
    ray_offset: how far off the surface the next ray must start.
    value: of the field, close to the surface or just before a jump; undefined without a hit.
    evaluations: number of evaluations of the field.
    is_hole_filling: the field has jumps but the hit is on none; the surface closes a hole between
        jump surfaces there.
    is_on_section: the hit is on a face where the section cuts a solid.
    isoline_index: of the isoline drawn there, from 1; 0 for none.
    """

    t: Real
    is_hit: Mask
    is_out_of_steps: Mask
    position: Vec3
    normal: Vec3
    ray_offset: Real
    value: Real
    evaluations: Any
    is_hole_filling: Mask
    is_on_section: Mask
    isoline_index: Any


def intersect_surface(
    prepared: SurfaceTracer, o: Vec3, d: Vec3, t_max: Real, active: Mask
) -> SurfaceHit:
    """The first hits of rays o + t d, |d| = 1, 0 <= t <= t_max, with the level set.

    One Newton step along the ray, one evaluation there, and one projection along its gradient take
    a hit from within tolerance to the surface. The proof tells which side of the surface the ray
    comes from; a normal that says otherwise (the step went past the point where a grazing ray is
    nearest) is turned to that side.

    A hit that requires a crossing is at a root already, and its side is known.

    A hit on a jump surface is not moved; the normal points to the side of larger values.
    """
    trace = prepared.first_hit(o, d, 0, t_max, active)
    if not prepared.uses_ray_queue:
        return _refine_hits(prepared, _MarchedRays(o, d, trace))
    return compute_on_active(
        trace.status == int(RayStatus.HIT),
        lambda rays: _refine_hits(prepared, rays),
        _MarchedRays(o, d, trace),
        _no_hit(prepared, trace),
    )


@dataclass(frozen=True)
class _MarchedRays:
    """Rays, and the ends of their marches."""

    o: Vec3
    d: Vec3
    trace: MarchResult


def _no_hit(prepared: SurfaceTracer, trace: MarchResult) -> SurfaceHit:
    """The `SurfaceHit` of rays that hit nothing."""
    backend = prepared.backend
    zero, vector, none = backend.Float(0), backend.Array3f(0), backend.Bool(False)
    return SurfaceHit(
        t=trace.t,
        is_hit=none,
        is_out_of_steps=trace.status == int(RayStatus.OUT_OF_STEPS),
        position=vector,
        normal=vector,
        ray_offset=zero,
        value=zero,
        evaluations=trace.evaluations,
        is_hole_filling=none,
        is_on_section=none,
        isoline_index=backend.UInt32(0),
    )


def _refine_hits(prepared: SurfaceTracer, rays: _MarchedRays) -> SurfaceHit:
    """The `SurfaceHit` of rays, with hits refined."""
    vector, o, d, trace = prepared.backend.Array3f, rays.o, rays.d, rays.trace
    prepared = prepared.hit_surface(trace)
    is_hit = trace.status == int(RayStatus.HIT)
    is_smooth = is_hit & ~trace.at_jump if prepared.field.has_jumps else is_hit
    gap = prepared.levels.offset_to_nearest(trace.value)
    slope = dr.dot(trace.gradient, d)
    reach = _MAX_REFINEMENT * _uncertainty(prepared, trace.gradient, trace.t, trace.value)
    step = dr.select(is_smooth & (slope != 0), dr.clip(gap / slope, -reach, reach), 0)
    # gap > 0: the level is above, so the ray comes from the side of smaller values.
    side = dr.select(gap > 0, prepared.backend.Float(1), -1)
    if trace.side is not None:  # hits at crossings are at a root
        step, side = dr.zeros(type(step)), trace.side
    t = dr.maximum(dr.select(is_hit, trace.t, 0) + step, 0)
    p = dr.fma(vector(t), d, o)
    if prepared.field.has_jumps:
        sample = _sample_where(prepared, p, trace.value, d, is_smooth)
    else:
        sample = prepared.sample(p)
    length = norm(sample.gradient)
    normal = dr.select(length > 0, sample.gradient / length, -d)
    shading = normal if sample.shading_normal is None else sample.shading_normal
    uncertainty = _uncertainty(prepared, sample.gradient, t, sample.value, sample.value_error)
    correction = prepared.levels.offset_to_nearest(sample.value) / length
    correction = dr.select(length > 0, dr.clip(correction, -reach, reach), 0)
    if prepared.field.has_jumps:  # behind a facet, the value does not concern this surface
        correction = dr.select(dr.abs(correction) * length <= dr.abs(gap), correction, 0)
    hit = SurfaceHit(
        t=dr.select(is_hit, t, trace.t),
        is_hit=is_hit,
        is_out_of_steps=trace.status == int(RayStatus.OUT_OF_STEPS),
        position=dr.fma(vector(correction), normal, p),
        normal=orient_normal(shading, d, side),
        ray_offset=RAY_OFFSET * uncertainty,
        value=sample.value,
        evaluations=trace.evaluations + dr.select(is_smooth, prepared.backend.UInt32(1), 0),
        is_hole_filling=is_smooth & prepared.field.has_jumps,
        is_on_section=prepared.backend.Bool(False),
        isoline_index=prepared.backend.UInt32(0),
    )
    if not prepared.field.has_jumps:
        return hit
    return dr.select(trace.at_jump, _hit_on_facet(prepared, o, d, trace, hit), hit)


def _sample_where(prepared: SurfaceTracer, p: Vec3, value: Real, d: Vec3, active: Mask) -> Sample:
    """Value, error, gradient and normal at p where active, zeros elsewhere, and no promises.

    value: f near p. d: of the ray; a point with a zero gradient has the normal -d.

    Skipped where no lane is active: a sample of a broken mesh costs more than a ray that hits a
    triangle or nothing, and most rays do.
    """
    real, vector = prepared.backend.Float, prepared.backend.Array3f

    def sampled(_: tuple[Any, ...]) -> tuple[Any, ...]:
        sample = prepared.sample_with_branch(p, value)
        length = norm(sample.gradient)
        normal = dr.select(length > 0, sample.gradient / length, -d)
        shading = vector(normal if sample.shading_normal is None else sample.shading_normal)
        return real(sample.value), real(sample.value_error), vector(sample.gradient), shading

    start = real(0), real(0), vector(0), vector(0)
    value, error, gradient, normal = update_where_active(active, sampled, start, "at hits")
    return Sample(value, gradient, (), error, shading_normal=normal)


def _hit_on_facet(
    prepared: SurfaceTracer, o: Vec3, d: Vec3, trace: MarchResult, hit: SurfaceHit
) -> SurfaceHit:
    """Hits on facets: t is exact up to rounding, and so is the plane of the normal.

    The ray comes from the side of smaller values if it runs along the normal. The next ray keeps as
    far away as from a level set, and no less than several roundings of the position.
    """
    t = dr.select(trace.at_jump, trace.t, 0)
    p = dr.fma(prepared.backend.Array3f(t), d, o)
    side = dr.mulsign(prepared.backend.Float(1), dr.dot(trace.gradient, d))
    rounding = 4 * prepared.backend.machine_epsilon * (dr.max(dr.abs(o)) + t)
    tolerance = prepared.tolerance.value_tolerance(prepared.backend.Float(1), t)
    return replace(
        hit,
        t=t,
        position=p,
        normal=orient_normal(trace.gradient, d, side),
        ray_offset=RAY_OFFSET * dr.maximum(tolerance, rounding),
        value=trace.value,
        is_hole_filling=prepared.backend.Bool(False),
    )


def _uncertainty(
    prepared: SurfaceTracer, gradient: Vec3, t: Real, f: Real, error: Real = 0.0
) -> Real:
    """The largest distance from the level, to first order, at which a point may be a hit.

    It is the tolerance, or the distance that rounding of f (`Sample.value_error`) amounts to if
    that is larger; the rounding of positions is far below the distance that Mitsuba's rays keep
    from surfaces anyway.
    """
    gradient_norm = norm(gradient)
    t = dr.select(dr.isfinite(t), t, 0)
    rounding = 2 * (error + 8 * prepared.backend.machine_epsilon * dr.abs(f))
    value_tolerance = dr.maximum(prepared.tolerance.value_tolerance(gradient_norm, t), rounding)
    return dr.select(
        gradient_norm > 0, value_tolerance / gradient_norm, prepared.tolerance.distance
    )


def orient_normal(normal: Vec3, d: Vec3, side: Real) -> Vec3:
    """The normal, turned if need be such that side * (normal . d) > 0."""
    cosine = dr.dot(normal, d)
    tilted = dr.normalize(normal + (side * _GRAZING - cosine) * d)
    return dr.select(side * cosine >= _GRAZING, normal, tilted)


@dataclass(frozen=True)
class CappedSolid:
    """A closed solid: the points of a volume where low <= f <= high, with caps where it is cut.

    Its boundary consists of level sets inside the volume and of caps on the volume's own boundary.
    A ray hits a cap where it enters the volume at a point of the solid, or leaves it at one without
    having hit a level before. Volumes are convex, so a ray enters and leaves at most once. A cap
    lies on the section if it is the section that ends the ray's part in the volume there.

    prepared: a level set whose levels are the finite ones of `low` and `high`.
    """

    prepared: SurfaceTracer
    low: Real
    high: Real

    @classmethod
    def of(cls, surface: TracedSurface, prepared: SurfaceTracer) -> CappedSolid:
        """The solid that `surface.side` describes."""
        if surface.solid_range is None:
            raise ValueError("this surface is not the boundary of a solid: give it a side")
        finite = iter(prepared.levels.values)
        low, high = (next(finite) if math.isfinite(end) else end for end in surface.solid_range)
        return cls(prepared, low, high)

    def _contains(self, p: Vec3) -> Mask:
        """Whether points of the volume belong to the solid."""
        f = self.prepared.sample(p).value
        return (f >= self.low) & (f <= self.high) & self.prepared.level_counts(p)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, side: Real = 0.0
    ) -> SurfaceHit:
        """The first crossings of rays o + t d, |d| = 1, 0 <= t <= t_max, with the boundary.

        side: of a ray that starts at the boundary, 1 if it goes out of the solid there, -1 if it
            goes in; else 0. Such a ray starts off the boundary by a clearance. Where the solid or a
            gap in it is thinner than that, it starts on the wrong side: then it crosses back at
            once, straight on. So going in and going out always alternate, and no light is lost at
            the sharp edges of caps.
        """
        zero = self.prepared.backend.Float(0)
        start, end = self.prepared.clip(o, d, zero, t_max)
        enters = active & (start < end)
        start = dr.select(enters, start, 0)
        resolved = self.prepared.is_resolved(o, end)  # others run out of steps in `_meet_levels`
        starts_inside = enters & resolved & self._contains(self._at(o, d, start))
        inside = starts_inside & (start <= 0)
        slipped = active & resolved & (((side < 0) & ~inside) | ((side > 0) & inside))
        entering = starts_inside & ~inside & ~slipped
        hit = self._meet_levels(o, d, t_max, active & ~entering & ~slipped)
        hit = replace(
            hit, evaluations=hit.evaluations + type(hit.evaluations)(dr.select(enters, 1, 0))
        )
        leaving = inside & ~slipped & ~hit.is_hit & ~hit.is_out_of_steps & (end < t_max)
        capped = entering | leaving | slipped
        t = dr.select(capped & ~slipped, dr.select(leaving, end, start), 0)
        position = self._at(o, d, t)
        outwards = dr.select(leaving | (side < 0), zero + 1, -1)
        normal = outwards * d
        if self.prepared.volume is not None:
            cap = orient_normal(self.prepared.volume.outward_normal(position), d, outwards)
            normal = dr.select(slipped, normal, cap)
        clearance = zero + RAY_OFFSET * self.prepared.tolerance.distance
        on_section = hit.is_on_section
        if self.prepared.section is not None:
            first, last = self.prepared.section.clip(o, d, zero, t_max)
            on_section = dr.select(leaving, last <= end, entering & (first >= start))
        cap_hit = replace(
            hit,
            t=t,
            is_hit=capped,
            position=position,
            normal=normal,
            ray_offset=clearance,
            is_on_section=on_section,
        )
        return dr.select(capped, cap_hit, hit)

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Whether rays hit the boundary; rays that are not proved to miss it count as hits."""
        start, end = self.prepared.clip(o, d, self.prepared.backend.Float(0), t_max)
        enters = active & (start < end)
        start = dr.select(enters, start, 0)
        resolved = self.prepared.is_resolved(o, end)
        starts_inside = enters & resolved & self._contains(self._at(o, d, start))
        capped = starts_inside & ((start > 0) | (end < t_max))
        return capped | self.prepared.occluded(o, d, 0, t_max, active & ~capped)

    def _meet_levels(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> SurfaceHit:
        """The first level set inside the volume, its normal turned out of the solid."""
        hit = intersect_surface(self.prepared, o, d, t_max, active)
        at_low = dr.abs(hit.value - self.low) < dr.abs(hit.value - self.high)
        normal = dr.select(at_low, -hit.normal, hit.normal)
        return replace(hit, normal=normal)

    def _at(self, o: Vec3, d: Vec3, t: Real) -> Vec3:
        t = dr.select(dr.isfinite(t), t, 0)
        return dr.fma(self.prepared.backend.Array3f(t), d, o)
