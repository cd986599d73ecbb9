"""Mitsuba scenes with level sets in them: rays are traced through both, and hits become surface
interactions.

Mitsuba's integrators cannot see level sets. Where a scene's integrator asks for light that
harnack's path tracer computes, that path tracer is used; scenes without level sets are left to
Mitsuba; all else is refused by name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend import Mask
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.mitsuba_proxy import is_proxy
from harnack.rendering.placed_surface import PlacedSurface
from harnack.rendering.surface_hits import SurfaceHit

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3


def surface_interaction(mi: Any, met: SurfaceHit, ray: Any, shape: Any) -> Any:
    """The SurfaceInteraction3f of a ray with a level set, valid where `met.is_hit`.

    shape: ShapePtr of the proxy, whose BSDF is evaluated. Texture coordinates are x and y of the
        position in the world: a level set has no parametrization of its own. The index of the
        primitive is the number of the isoline that is drawn there, by which a BSDF chooses
        (`mitsuba_proxy.isoline_bsdf`).
    """
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.t = dr.select(met.is_hit, met.t, dr.inf)
    si.p = mi.Point3f(met.position)
    si.n = mi.Normal3f(met.normal)
    si.sh_frame = mi.Frame3f(mi.Vector3f(met.normal))
    si.dp_du, si.dp_dv = si.sh_frame.s, si.sh_frame.t
    si.uv = mi.Point2f(si.p.x, si.p.y)
    si.prim_index = met.isoline_index
    si.time = ray.time
    si.wavelengths = ray.wavelengths
    si.shape = dr.select(met.is_hit, shape, dr.zeros(mi.ShapePtr))
    si.wi = si.to_local(-ray.d)
    return si


def offset_origin(mi: Any, si: Any, clearance: Real, d: Vec3) -> Any:
    """The origin of a ray in direction d that does not hit the surface of `si` again.

    It is off the surface along the normal, on the side to which the ray leaves, as far as for
    Mitsuba's own rays, (1 + |p|_max) RayEpsilon, but no less than `clearance`: within its tolerance
    of a level set every point is a hit.
    """
    distance = dr.maximum((1 + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon, clearance)
    return dr.fma(dr.mulsign(distance, dr.dot(si.n, d)), mi.Vector3f(si.n), si.p)


def spawn_ray(mi: Any, si: Any, clearance: Real, d: Vec3) -> Any:
    """The ray from `si` in direction d."""
    return mi.Ray3f(
        offset_origin(mi, si, clearance, d), d, dr.largest(mi.Float), si.time, si.wavelengths
    )


def spawn_ray_to(mi: Any, si: Any, clearance: Real, target: Vec3) -> Any:
    """The ray from `si` to a target point, ending just before it."""
    o = offset_origin(mi, si, clearance, target - si.p)
    vector = target - o
    length = dr.norm(vector)
    return mi.Ray3f(
        o, vector / length, length * (1 - mi.math.ShadowEpsilon), si.time, si.wavelengths
    )


@dataclass(frozen=True)
class HybridScene:
    """The scene that rays are traced in: all of its shapes, Mitsuba's and the level sets of
    harnack."""

    mi: Any
    scene: Any
    proxies: tuple[Any, ...]

    queued: bool = False

    @classmethod
    def of(cls, mi: Any, scene: Any, *, queued: bool = False) -> HybridScene:
        """Find the proxies of level sets in a scene.

        queued: whether rays are traced without delay, from a queue, which is faster where they
            differ in length, and cannot be done while a kernel is being recorded.
        """
        return cls(mi, scene, tuple(s for s in scene.shapes() if is_proxy(s)), queued)

    def _placed(self, carrier: Any) -> PlacedSurface:
        return carrier.placed.queued() if self.queued else carrier.placed

    def intersect(
        self, ray: Any, start: Any, active: Mask, hidden: Mask | None = None
    ) -> tuple[Any, SurfaceHit]:
        """The first hit of rays, as a surface interaction and as a `SurfaceHit`.

        start: the interaction that rays leave, not valid for rays that come from a camera.
        hidden: mask of rays that do not see shapes that emit light; None for no such rays.

        For a ray out of steps the interaction is not valid.
        """
        mi = self.mi
        preliminary = self.scene.ray_intersect_preliminary(ray, active=active)
        if hidden is not None:
            preliminary = self._skip_emitters(ray, preliminary, active & hidden)
        limit = dr.minimum(preliminary.t, ray.maxt)
        if self.queued:
            dr.eval(preliminary, limit)
        hit, hit_shape = self.no_hit(dr.zeros(mi.SurfaceInteraction3f)), dr.zeros(mi.ShapePtr)
        for proxy in self.proxies:
            shape = mi.ShapePtr(proxy)
            side = dr.sign(dr.dot(start.n, ray.d))
            from_it = start.shape == shape
            if proxy.section_proxy is not None:
                from_it |= start.shape == mi.ShapePtr(proxy.section_proxy)
            leaves = dr.select(start.is_valid() & from_it, side, 0)
            new = self._placed(proxy).intersect(ray.o, ray.d, limit, active, leaves)
            evaluations = hit.evaluations + new.evaluations
            ended = new.is_hit | new.is_out_of_steps
            hit = replace(dr.select(ended, new, hit), evaluations=evaluations)
            hit_shape = dr.select(ended, shape, hit_shape)
            if proxy.section_proxy is not None:
                hit_shape = dr.select(
                    ended & new.is_on_section, mi.ShapePtr(proxy.section_proxy), hit_shape
                )
            limit = dr.select(ended, new.t, limit)
        ended: Mask = hit.is_hit | hit.is_out_of_steps
        missed = active & ~ended
        si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All, missed)
        scene_hit = replace(self._of_scene(si, active), evaluations=hit.evaluations)
        si = dr.select(ended, surface_interaction(mi, hit, ray, hit_shape), si)
        return si, dr.select(ended, hit, scene_hit)

    def _skip_emitters(self, ray: Any, first: Any, active: Mask) -> Any:
        """The first hits of rays with the scene behind the shapes that emit light."""
        mi = self.mi

        def is_emitter(hit: Any, active: Mask) -> Mask:
            return active & hit.is_valid() & hit.shape.is_emitter()

        def skip(hit: Any, active: Mask) -> tuple[Any, Mask]:
            distance = hit.t * (1 + mi.math.RayEpsilon) + mi.math.RayEpsilon
            rest_ray = mi.Ray3f(ray)
            rest_ray.o = dr.fma(mi.Vector3f(distance), ray.d, ray.o)
            rest_ray.maxt = ray.maxt - distance
            next_hit = self.scene.ray_intersect_preliminary(rest_ray, active=active)
            next_hit.t += distance
            return dr.select(active, next_hit, hit), is_emitter(next_hit, active)

        def is_running(hit: Any, active: Mask) -> Mask:
            del hit
            return active

        loop: Any = dr.while_loop
        hit, _ = loop((first, is_emitter(first, active)), is_running, skip, label="behind lights")
        return hit

    def no_hit(self, si: Any) -> SurfaceHit:
        """The `SurfaceHit` of rays that hit nothing. si: invalid interactions, one for each ray."""
        return self._of_scene(si, self.mi.Bool(False))

    def _of_scene(self, si: Any, active: Mask) -> SurfaceHit:
        mi, vector = self.mi, mitsuba_backend(self.mi).Array3f
        return SurfaceHit(
            t=si.t,
            is_hit=active & si.is_valid(),
            is_out_of_steps=mi.Bool(False),
            position=vector(si.p),
            normal=vector(si.n),
            ray_offset=mi.Float(0),
            value=mi.Float(0),
            evaluations=mi.UInt32(0),
            is_hole_filling=mi.Bool(False),
            is_on_section=mi.Bool(False),
            isoline_index=mi.UInt32(0),
        )

    def has_line_near(self, si: Any, ray: Any, d: Any, t: Any) -> Mask:
        """Whether the edge of an isoline may pass through the pixel of a ray with differentials.

        d: the direction in which the ray arrives.
        t: the length of its path.

        The points at which neighboring rays hit the tangent plane are computed along d.
        """
        mi, near = self.mi, self.mi.Bool(False)
        normal = mi.Vector3f(si.n)
        facing = dr.dot(normal, d)

        def to_neighbor(o: Any, along: Any) -> Any:
            offset = o + t * along - ray.o - t * ray.d
            return offset - d * (dr.dot(offset, normal) / facing)

        across, down = to_neighbor(ray.o_x, ray.d_x), to_neighbor(ray.o_y, ray.d_y)
        for proxy in self.proxies:
            if proxy.placed.isolines:
                is_near = proxy.placed.has_line_near(si.p, normal, across, down)
                near |= (si.shape == mi.ShapePtr(proxy)) & is_near
        return near

    def occluded(self, ray: Any, active: Mask) -> Mask:
        """Whether rays hit anything; rays that are not proved to hit nothing count as hitting."""
        blocked = self.scene.ray_test(ray, active)
        for proxy in self.proxies:
            blocked |= self._placed(proxy).occludes(ray.o, ray.d, ray.maxt, active & ~blocked)
        return blocked
