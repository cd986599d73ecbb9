"""Computes where rays first hit a level set of a field, or the boundary of a solid, and which way
the surface faces there.

A field is a scalar function f of space, and its level set is the surface on which f equals a given
number, the level. f may also jump across triangles, which are called facets; then they belong to
the surface too. A `SurfaceTracer` holds everything that tracing one surface needs. Its
march moves along a ray by proved steps and ends near the surface, within a tolerance; the functions
here move this end onto the surface and compute a normal that points to a known side.

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
from harnack.enclosures.samples import Sample
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
    is_hole_filling: whether f jumps somewhere (as the winding number of a mesh does at its
        triangles) but not at this hit. Then the hit is on a smooth part of the level set, which
        closes a hole between the triangles.
    is_on_section: whether the hit is on the flat face along which a solid was cut open. The section
        is the volume that cuts it.
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
    tracer: SurfaceTracer, o: Vec3, d: Vec3, t_max: Real, active: Mask
) -> SurfaceHit:
    """Find the first hits of rays o + t d, |d| = 1, 0 <= t <= t_max, with the level set. Returns
    one `SurfaceHit`.

    tracer: the tracer of the surface.
    active: mask of the rays that are traced.

    The march ends within the tolerance of the surface. One Newton step along the ray, one
    evaluation of f there, and one step along the gradient then lead to the surface itself. The last
    value of the march tells from which side of the level the ray comes. If the normal contradicts
    that, because the Newton step along a grazing ray went too far, the normal is tilted to agree.

    If hits require a crossing of the level, the march itself gives the root and the side, and no
    Newton step is made. A hit on a jump of f is not moved; its normal points to the side of larger
    values.
    """
    # The march goes from t = 0 to t_max.
    trace = tracer.first_hit(o, d, 0, t_max, active)
    if not tracer.uses_ray_queue:
        return _refine_hits(tracer, _MarchedRays(o, d, trace))
    # With a queue of rays, the refinement is computed only for the rays that hit.
    return compute_on_active(
        trace.status == int(RayStatus.HIT),
        lambda rays: _refine_hits(tracer, rays),
        _MarchedRays(o, d, trace),
        _no_hit(tracer, trace),
    )


@dataclass(frozen=True)
class _MarchedRays:
    """Rays and how their march ended: origins o (3,), unit directions d (3,), and the
    `MarchResult`."""

    o: Vec3
    d: Vec3
    trace: MarchResult


def _no_hit(tracer: SurfaceTracer, trace: MarchResult) -> SurfaceHit:
    """Return the `SurfaceHit` of rays that hit nothing: of misses, and of rays that are out of
    steps. trace: how the march of each ray ended."""
    backend = tracer.backend
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


def _refine_hits(tracer: SurfaceTracer, rays: _MarchedRays) -> SurfaceHit:
    """Return the `SurfaceHit` of marched rays. Hits are moved onto the surface as
    `intersect_surface` describes; other rays keep the end of their march.

    rays: the rays and the `MarchResult` of each.

    The march may stop within some distance of the level set (`_uncertainty`). Every movement is
    limited to `reach`, twice this distance.
    """
    vector, o, d, trace = tracer.backend.Array3f, rays.o, rays.d, rays.trace
    # Of a union of patches (level sets of several functions), the patch that each ray hit.
    tracer = tracer.hit_surface(trace)
    is_hit, has_jumps = trace.status == int(RayStatus.HIT), tracer.evaluator.jumps is not None
    is_smooth = is_hit & ~trace.at_jump if has_jumps else is_hit
    # The difference between the nearest level and f at the end of the march.
    value_to_level = tracer.levels.offset_to_nearest(trace.value)
    slope_on_ray = dr.dot(trace.gradient, d)
    reach = _MAX_REFINEMENT * _uncertainty(tracer, trace.gradient, trace.t, trace.value)
    newton_step = dr.select(
        is_smooth & (slope_on_ray != 0), dr.clip(value_to_level / slope_on_ray, -reach, reach), 0
    )
    # value_to_level > 0: the level is above, so the ray comes from the side of smaller values.
    side = dr.select(value_to_level > 0, tracer.backend.Float(1), -1)
    if trace.side is not None:  # hits at crossings are at a root
        newton_step, side = dr.zeros(type(newton_step)), trace.side
    # Rays without a hit may have t = inf: they keep their origin.
    t = dr.maximum(dr.select(is_hit, trace.t, 0) + newton_step, 0)
    position = dr.fma(vector(t), d, o)
    if has_jumps:
        sample = _sample_where(tracer, position, trace.value, d, is_smooth)
    else:
        sample = tracer.sample_where(position, is_hit)
    gradient_norm = norm(sample.gradient)
    normal = dr.select(gradient_norm > 0, sample.gradient / gradient_norm, -d)
    # A field may have another normal for shading than its gradient.
    shading_normal = normal if sample.shading_normal is None else sample.shading_normal
    shading_normal = dr.select(is_hit, shading_normal, -d)
    value = dr.select(is_hit, sample.value, trace.value)
    uncertainty = _uncertainty(tracer, sample.gradient, t, sample.value, sample.value_error)
    # Second movement: along the gradient, by the distance to the level to first order.
    correction = tracer.levels.offset_to_nearest(sample.value) / gradient_norm
    correction = dr.select(gradient_norm > 0, dr.clip(correction, -reach, reach), 0)
    # If f is farther from the level than before, a facet may lie between, behind which f does not
    # concern this surface.
    if has_jumps:
        correction = dr.select(
            dr.abs(correction) * gradient_norm <= dr.abs(value_to_level), correction, 0
        )
    hit = SurfaceHit(
        t=dr.select(is_hit, t, trace.t),
        is_hit=is_hit,
        is_out_of_steps=trace.status == int(RayStatus.OUT_OF_STEPS),
        position=dr.fma(vector(correction), normal, position),
        normal=orient_normal(shading_normal, d, side),
        ray_offset=RAY_OFFSET * uncertainty,
        value=value,
        evaluations=trace.evaluations + dr.select(is_smooth, tracer.backend.UInt32(1), 0),
        is_hole_filling=is_smooth & has_jumps,
        is_on_section=tracer.backend.Bool(False),
        isoline_index=tracer.backend.UInt32(0),
    )
    if not has_jumps:
        return hit
    return dr.select(trace.at_jump, _hit_on_facet(tracer, o, d, trace, hit), hit)


def _sample_where(tracer: SurfaceTracer, p: Vec3, value: Real, d: Vec3, active: Mask) -> Sample:
    """Return the `Sample` of f at points p (3,) on active lanes: value, bound of its rounding
    error, gradient and shading normal. All of these are 0 on other lanes. The sample has no bounds
    of f in the neighborhood of p.

    value: f near p. A multivalued f is evaluated on the branch whose value is closest to it.
    d: (3,) the direction of the ray; a point with a zero gradient has the normal -d.

    The evaluation is skipped if no lane is active. Evaluating a mesh with holes takes longer than
    tracing a ray, and most rays hit a triangle or nothing.
    """
    real, vector = tracer.backend.Float, tracer.backend.Array3f

    def sample_all(_: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return value, error bound, gradient and shading normal at all points p. The argument, the
        state before, is not used: it has the same four numbers."""
        sample = tracer.sample_with_branch(p, value)
        length = norm(sample.gradient)
        normal = dr.select(length > 0, sample.gradient / length, -d)
        shading = vector(normal if sample.shading_normal is None else sample.shading_normal)
        return real(sample.value), real(sample.value_error), vector(sample.gradient), shading

    start = real(0), real(0), vector(0), vector(0)
    value, error, gradient, normal = update_where_active(active, sample_all, start, "at hits")
    # (): no bounds in the neighborhood.
    return Sample(value, gradient, (), error, shading_normal=normal)


def _hit_on_facet(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, trace: MarchResult, hit: SurfaceHit
) -> SurfaceHit:
    """Return the `SurfaceHit` of rays that hit a facet (a flat piece of the surface at which f
    jumps). The intersection with the facet's plane is exact up to rounding, so neither t nor the
    normal is refined.

    o, d, trace: origins and directions (3,) of the rays, and how their march ended.
    hit: the same rays' `SurfaceHit` as for hits where f is smooth. Its entries that do not depend
        on the facet are kept.

    f is larger on the side to which the normal points. So a ray that runs along the normal comes
    from the side of smaller values. A ray that leaves the facet starts as far off it as off a level
    set, and at least several roundings of the position.
    """
    t = dr.select(trace.at_jump, trace.t, 0)
    position = dr.fma(tracer.backend.Array3f(t), d, o)
    # 1 if the ray comes from the side of smaller values, else -1.
    side = dr.mulsign(tracer.backend.Float(1), dr.dot(trace.gradient, d))
    rounding = 4 * tracer.backend.machine_epsilon * (dr.max(dr.abs(o)) + t)
    # For |gradient| = 1, the tolerance of the value is a length.
    tolerance = tracer.tolerance.value_tolerance(tracer.backend.Float(1), t)
    return replace(
        hit,
        t=t,
        position=position,
        normal=orient_normal(trace.gradient, d, side),
        ray_offset=RAY_OFFSET * dr.maximum(tolerance, rounding),
        value=trace.value,
        is_hole_filling=tracer.backend.Bool(False),
    )


def _uncertainty(
    tracer: SurfaceTracer, gradient: Vec3, t: Real, f: Real, error: Real = 0.0
) -> Real:
    """Return a distance: to first order, a point that the march accepts as a hit lies within this
    distance of the level set.

    gradient, t, f, error: at the point, the gradient (3,) of f, the ray parameter, the value of f,
        and the bound of the rounding error of the value.

    The bound is the tolerance, or the distance 2 error/|gradient| that corresponds to the rounding
    of f if that is larger. Where the gradient is 0, it is the tolerance. Rounding of positions is
    left out: Mitsuba's rays start much farther off surfaces anyway.
    """
    gradient_norm = norm(gradient)
    # A miss has t = inf, which would make the tolerance infinite.
    t = dr.select(dr.isfinite(t), t, 0)
    # Beside the bound `error`, the value itself is rounded by some units in its last place.
    rounding = 2 * (error + 8 * tracer.backend.machine_epsilon * dr.abs(f))
    value_tolerance = dr.maximum(tracer.tolerance.value_tolerance(gradient_norm, t), rounding)
    return dr.select(gradient_norm > 0, value_tolerance / gradient_norm, tracer.tolerance.distance)


def orient_normal(normal: Vec3, d: Vec3, side: Real) -> Vec3:
    """Return the unit normal, turned to the given side of the surface as the ray sees it.

    If side * (normal . d) is at least a small positive margin, the normal is returned as it is.
    Otherwise it is tilted, in the plane of normal and d, until this holds.

    normal, d: (3,) unit normal, and unit direction of the ray.
    side: 1 if the normal is to point along the ray, -1 if against it.
    """
    cosine = dr.dot(normal, d)
    tilted = dr.normalize(normal + (side * _GRAZING - cosine) * d)
    return dr.select(side * cosine >= _GRAZING, normal, tilted)


@dataclass(frozen=True)
class CappedSolid:
    """A closed solid: the points of a volume at which low <= f <= high. The volume is convex, and
    is what the surface is clipped to (box, ball, or their intersection with a section that cuts the
    solid open).

    The boundary of the solid consists of level sets inside the volume and of caps, which are parts
    of the volume's own boundary. A ray hits a cap where it enters the volume at a point of the
    solid, or where it leaves the volume from inside the solid without having hit a level before. A
    ray enters and leaves the convex volume at most once. A cap lies on the section if the ray
    enters or leaves the section there.

    tracer: the tracer of the level sets f = low and f = high. An infinite bound has no level set.
    low, high: the bounds of f; one of them may be infinite.
    """

    tracer: SurfaceTracer
    low: Real
    high: Real

    @classmethod
    def of(cls, surface: TracedSurface, tracer: SurfaceTracer) -> CappedSolid:
        """Return the solid that a surface with the option `side` describes, such as all points
        below its level.

        tracer: the tracer of the same surface.

        Raises:
            ValueError: the surface is a level set, not the boundary of a solid.
        """
        if surface.solid_range is None:
            raise ValueError("this surface is not the boundary of a solid: give it a side")
        # The tracer's levels are the finite bounds, in increasing order, as the tracer computes
        # with them.
        finite = iter(tracer.levels.values)
        low, high = (next(finite) if math.isfinite(end) else end for end in surface.solid_range)
        return cls(tracer, low, high)

    def _contains(self, p: Vec3, active: Mask) -> Mask:
        """Return the mask of points p (3,) of the volume that belong to the solid; anything on
        lanes that are not active."""
        value = self.tracer.sample_where(p, active).value
        # `level_counts` leaves out other components if only the largest one is drawn.
        return (value >= self.low) & (value <= self.high) & self.tracer.level_counts(p)

    def intersect(
        self, o: Vec3, d: Vec3, t_max: Real, active: Mask, side: Real = 0.0
    ) -> SurfaceHit:
        """Find the first crossings of rays o + t d, |d| = 1, 0 <= t <= t_max, with the boundary of
        the solid. Returns a `SurfaceHit`.

        active: mask of the rays that are traced.
        side: for a ray that starts at the boundary, 1 if it goes out of the solid there and -1 if
            it goes in; 0 for other rays.

        A ray that starts at the boundary begins a little off it. If the solid, or a gap in it, is
        thinner than this distance, the ray begins on the wrong side. It then gets an immediate hit
        at t = 0 with the normal along the ray, which takes it to the right side without bending it.
        So going in and going out always alternate, and no light is lost at the sharp edges of caps.
        """
        zero = self.tracer.backend.Float(0)
        t_enter, t_leave = self.tracer.clip(o, d, zero, t_max)
        meets_volume = active & (t_enter < t_leave)
        t_enter = dr.select(meets_volume, t_enter, 0)
        # If only the largest connected component is drawn, rounding may leave in doubt on some rays
        # which points belong to it. Such rays are not resolved, and run out of steps in
        # `_meet_levels`.
        is_resolved = self.tracer.is_resolved(o, t_leave)
        is_known = meets_volume & is_resolved
        starts_inside = is_known & self._contains(self._point_on_ray(o, d, t_enter), is_known)
        origin_is_inside = starts_inside & (t_enter <= 0)
        # The ray should start inside (side < 0) or outside (side > 0), and does not.
        is_on_wrong_side = (
            active
            & is_resolved
            & (((side < 0) & ~origin_is_inside) | ((side > 0) & origin_is_inside))
        )
        hits_entry_cap = starts_inside & ~origin_is_inside & ~is_on_wrong_side
        # Rays that hit a cap at once need not be traced to the level sets.
        hit = self._meet_levels(o, d, t_max, active & ~hits_entry_cap & ~is_on_wrong_side)
        # `_contains` has evaluated f once.
        hit = replace(
            hit, evaluations=hit.evaluations + type(hit.evaluations)(dr.select(meets_volume, 1, 0))
        )
        hits_exit_cap = (
            origin_is_inside
            & ~is_on_wrong_side
            & ~hit.is_hit
            & ~hit.is_out_of_steps
            & (t_leave < t_max)
        )
        hits_cap = hits_entry_cap | hits_exit_cap | is_on_wrong_side
        t = dr.select(hits_cap & ~is_on_wrong_side, dr.select(hits_exit_cap, t_leave, t_enter), 0)
        position = self._point_on_ray(o, d, t)
        # 1 where the ray leaves the solid, so that the outward normal is along it; -1 where it
        # enters. (`zero + 1` is the number 1 in the kernel's type.)
        out_along_ray = dr.select(hits_exit_cap | (side < 0), zero + 1, -1)
        # On the wrong side, the normal is along the ray.
        normal = out_along_ray * d
        if self.tracer.volume is not None:
            cap_normal = orient_normal(
                self.tracer.volume.outward_normal(position), d, out_along_ray
            )
            normal = dr.select(is_on_wrong_side, normal, cap_normal)
        ray_offset = zero + RAY_OFFSET * self.tracer.tolerance.distance
        on_section = hit.is_on_section
        # The cap is on the section if the section, not another part of the volume, ends the ray
        # there.
        if self.tracer.section is not None:
            t_section_enter, t_section_leave = self.tracer.section.clip(o, d, zero, t_max)
            on_section = dr.select(
                hits_exit_cap,
                t_section_leave <= t_leave,
                hits_entry_cap & (t_section_enter >= t_enter),
            )
        cap_hit = replace(
            hit,
            t=t,
            is_hit=hits_cap,
            position=position,
            normal=normal,
            ray_offset=ray_offset,
            is_on_section=on_section,
        )
        return dr.select(hits_cap, cap_hit, hit)

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Return the mask of rays o + t d, 0 <= t <= t_max, that hit the boundary of the solid.
        Rays that are not proved to miss it count as hits.

        Rays of two kinds are known to hit the boundary: rays that start outside of the volume and
        enter it at a point of the solid, and rays that start in the solid and leave the volume
        before t_max. All other active rays are tested against the level sets.
        """
        t_enter, t_leave = self.tracer.clip(o, d, self.tracer.backend.Float(0), t_max)
        meets_volume = active & (t_enter < t_leave)
        t_enter = dr.select(meets_volume, t_enter, 0)
        # Rays for which rounding leaves in doubt what belongs to the solid are not resolved;
        # `occluded` counts them as hits.
        is_resolved = self.tracer.is_resolved(o, t_leave)
        is_known = meets_volume & is_resolved
        starts_inside = is_known & self._contains(self._point_on_ray(o, d, t_enter), is_known)
        hits_cap = starts_inside & ((t_enter > 0) | (t_leave < t_max))
        # All other rays are tested from t = 0 to t_max.
        return hits_cap | self.tracer.occluded(o, d, 0, t_max, active & ~hits_cap)

    def _meet_levels(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> SurfaceHit:
        """Find the first hits of rays o + t d, 0 <= t <= t_max, with the level sets inside the
        volume. Returns a `SurfaceHit` whose normals point out of the solid: toward smaller f at the
        lower bound, and toward larger f at the upper one."""
        hit = intersect_surface(self.tracer, o, d, t_max, active)
        is_at_low = dr.abs(hit.value - self.low) < dr.abs(hit.value - self.high)
        normal = dr.select(is_at_low, -hit.normal, hit.normal)
        return replace(hit, normal=normal)

    def _point_on_ray(self, o: Vec3, d: Vec3, t: Real) -> Vec3:
        """Return the points o + t d (3,) of rays with the origins o and directions d; o where t is
        not finite."""
        t = dr.select(dr.isfinite(t), t, 0)
        return dr.fma(self.tracer.backend.Array3f(t), d, o)
