"""First hits of rays with level sets and with boundaries of solids: their positions, moved onto the
surface, and normals that point to a known side.

All coordinates are those of the surface, and nothing here depends on Mitsuba.
`hybrid_scene.surface_interaction` turns a hit into the interaction that a BSDF takes.
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
    """How each ray ended at a surface, with one entry for each ray.

    A ray ends in one of three ways. Hit: is_hit is True, and t is the ray parameter of the hit.
    Miss: is_hit and is_out_of_steps are False, and t = inf. Undecided: is_out_of_steps is True; the
    ray used up its evaluations, no surface lies before t, and nothing is known behind t.

    position, normal: (3,) the point of the surface, and its unit normal. The normal points toward
        larger values of the field f or, for a solid, outward.
    ray_offset: the distance from the surface at which a ray that leaves it must start.
    value: f close to the hit, or just before the jump if the hit is on a jump of f; undefined
        without a hit.
    evaluations: the number of evaluations of f along the ray.
    is_hole_filling: whether f has jumps (such as the winding number of a mesh at its triangles) and
        the hit is on none of them: it is on a smooth part of the level set, which closes a hole
        between them.
    is_on_section: whether the hit is on a flat face where the section, a volume that cuts a solid
        open, cuts it.
    isoline_index: the number of the isoline at the hit, counted from 1; 0 if no isoline is there.
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
    """The first hits of rays o + t d, |d| = 1, 0 <= t <= t_max, with the level set, as a
    `SurfaceHit`.

    The march ends within the tolerance of the surface. One Newton step along the ray, one
    evaluation of f there, and one step along the gradient then lead to the surface itself. The last
    value of the march tells from which side of the level the ray comes. If the normal contradicts
    that, because the Newton step along a grazing ray went too far, the normal is tilted to agree.

    If hits require a crossing, the march itself gives the root and the side, and no Newton step is
    made. A hit on a jump of f is not moved; its normal points to the side of larger values.
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
    """Origins and unit directions of rays, and the `MarchResult` of each."""

    o: Vec3
    d: Vec3
    trace: MarchResult


def _no_hit(prepared: SurfaceTracer, trace: MarchResult) -> SurfaceHit:
    """The `SurfaceHit` of rays without a hit: misses, and rays that are out of steps. trace: how
    the rays ended."""
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
    """The `SurfaceHit` of marched rays, with hits moved onto the surface as `intersect_surface`
    describes."""
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
    """The `Sample` of f at points p on active lanes: value, error, gradient and shading normal. It
    is zero on other lanes and holds no promises (proved bounds of f near a point).

    value: f near p, which selects the branch of a multivalued f.
    d: the direction of the ray; a point with a zero gradient has the normal -d.

    The evaluation is skipped if no lane is active. Evaluating a mesh with holes costs more than
    tracing a ray, and most rays hit a triangle or nothing.
    """
    real, vector = prepared.backend.Float, prepared.backend.Array3f

    def sample_all(_: tuple[Any, ...]) -> tuple[Any, ...]:
        """Value, error, gradient and shading normal at all points p."""
        sample = prepared.sample_with_branch(p, value)
        length = norm(sample.gradient)
        normal = dr.select(length > 0, sample.gradient / length, -d)
        shading = vector(normal if sample.shading_normal is None else sample.shading_normal)
        return real(sample.value), real(sample.value_error), vector(sample.gradient), shading

    start = real(0), real(0), vector(0), vector(0)
    value, error, gradient, normal = update_where_active(active, sample_all, start, "at hits")
    return Sample(value, gradient, (), error, shading_normal=normal)


def _hit_on_facet(
    prepared: SurfaceTracer, o: Vec3, d: Vec3, trace: MarchResult, hit: SurfaceHit
) -> SurfaceHit:
    """The `SurfaceHit` of rays that hit a facet (a flat piece of the surface at which f jumps). The
    intersection with the facet's plane is exact up to rounding, so neither t nor the normal is
    refined.

    hit: the result for smooth hits, whose other entries stay.

    f is larger on the side to which the normal points. So a ray that runs along the normal comes
    from the side of smaller values. The next ray starts as far off as from a level set, and at
    least several roundings of the position.
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
    """The largest distance from the level, to first order, at which the march may accept a point as
    a hit.

    gradient, t, f, error: at the point, its gradient (3,), ray parameter, value, and the bound of
        its rounding error.

    It is the tolerance, or the distance 2 error/|gradient| that corresponds to the rounding of f if
    that is larger. Rounding of positions is left out: Mitsuba's rays start much farther off
    surfaces anyway.
    """
    gradient_norm = norm(gradient)
    t = dr.select(dr.isfinite(t), t, 0)
    rounding = 2 * (error + 8 * prepared.backend.machine_epsilon * dr.abs(f))
    value_tolerance = dr.maximum(prepared.tolerance.value_tolerance(gradient_norm, t), rounding)
    return dr.select(
        gradient_norm > 0, value_tolerance / gradient_norm, prepared.tolerance.distance
    )


def orient_normal(normal: Vec3, d: Vec3, side: Real) -> Vec3:
    """The unit normal if side * (normal . d) > 0 by some margin; else the normal tilted in its
    plane with d until that holds. d: (3,) unit direction of the ray. side: 1 or -1."""
    cosine = dr.dot(normal, d)
    tilted = dr.normalize(normal + (side * _GRAZING - cosine) * d)
    return dr.select(side * cosine >= _GRAZING, normal, tilted)


@dataclass(frozen=True)
class CappedSolid:
    """A closed solid: the points of a volume at which low <= f <= high.

    Its boundary consists of level sets inside the volume and of caps, which are parts of the
    volume's own boundary. A ray hits a cap where it enters the volume at a point of the solid, or
    where it leaves the volume from inside the solid without having hit a level before. Volumes are
    convex, so a ray enters and leaves a volume at most once. The volume may be an intersection that
    includes the section (a volume that cuts the solid open). A cap lies on the section if the ray
    enters or leaves the section there.

    prepared: the tracer of the level sets f = low and f = high. There is no level set for a bound
        that is infinite.
    low, high: the bounds of f, of which one may be infinite.
    """

    prepared: SurfaceTracer
    low: Real
    high: Real

    @classmethod
    def of(cls, surface: TracedSurface, prepared: SurfaceTracer) -> CappedSolid:
        """The solid of a surface whose `side` describes one. prepared: the tracer of the surface.
        Raises ValueError if the surface is a level set."""
        if surface.solid_range is None:
            raise ValueError("this surface is not the boundary of a solid: give it a side")
        finite = iter(prepared.levels.values)
        low, high = (next(finite) if math.isfinite(end) else end for end in surface.solid_range)
        return cls(prepared, low, high)

    def _contains(self, p: Vec3) -> Mask:
        """Mask of points (3,) of the volume that belong to the solid."""
        f = self.prepared.sample(p).value
        return (f >= self.low) & (f <= self.high) & self.prepared.level_counts(p)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, side: Real = 0.0
    ) -> SurfaceHit:
        """The first crossings of rays o + t d, |d| = 1, 0 <= t <= t_max, with the boundary, as a
        `SurfaceHit`.

        side: for a ray that starts at the boundary, 1 if it goes out of the solid there and -1 if
            it goes in; 0 for other rays.

        A ray that starts at the boundary begins a little off it. If the solid, or a gap in it, is
        thinner than this distance, the ray begins on the wrong side. It then gets an immediate hit
        at t = 0 with the normal along the ray, which takes it to the right side without bending it.
        So going in and going out always alternate, and no light is lost at the sharp edges of caps.
        """
        zero = self.prepared.backend.Float(0)
        start, end = self.prepared.clip(o, d, zero, t_max)
        enters = active & (start < end)
        start = dr.select(enters, start, 0)
        resolved = self.prepared.is_resolved(o, end)  # others run out of steps in `_meet_levels`
        starts_inside = enters & resolved & self._contains(self._point_on_ray(o, d, start))
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
        position = self._point_on_ray(o, d, t)
        outwards = dr.select(leaving | (side < 0), zero + 1, -1)
        normal = outwards * d
        if self.prepared.volume is not None:
            cap_normal = orient_normal(self.prepared.volume.outward_normal(position), d, outwards)
            normal = dr.select(slipped, normal, cap_normal)
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
        """Mask of rays o + t d, 0 <= t <= t_max, that hit the boundary of the solid. Rays that are
        not proved to miss it count as hits."""
        start, end = self.prepared.clip(o, d, self.prepared.backend.Float(0), t_max)
        enters = active & (start < end)
        start = dr.select(enters, start, 0)
        resolved = self.prepared.is_resolved(o, end)
        starts_inside = enters & resolved & self._contains(self._point_on_ray(o, d, start))
        capped = starts_inside & ((start > 0) | (end < t_max))
        return capped | self.prepared.occluded(o, d, 0, t_max, active & ~capped)

    def _meet_levels(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> SurfaceHit:
        """The first hits of rays with the level sets inside the volume, as a `SurfaceHit` whose
        normals point out of the solid."""
        hit = intersect_surface(self.prepared, o, d, t_max, active)
        at_low = dr.abs(hit.value - self.low) < dr.abs(hit.value - self.high)
        normal = dr.select(at_low, -hit.normal, hit.normal)
        return replace(hit, normal=normal)

    def _point_on_ray(self, o: Vec3, d: Vec3, t: Real) -> Vec3:
        """The points o + t d (3,) of rays with the origins o and directions d; o if t is not
        finite."""
        t = dr.select(dr.isfinite(t), t, 0)
        return dr.fma(self.prepared.backend.Array3f(t), d, o)
