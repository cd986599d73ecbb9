"""Mitsuba scenes with level sets in them. Rays are traced through both, and hits with level sets
become surface interactions of Mitsuba's. Each level set is represented in the Mitsuba scene by a
proxy, a mesh that no ray of Mitsuba hits; it carries the BSDF. `mi` is the Mitsuba module, and `si`
is a surface interaction.

Mitsuba's integrators cannot see level sets. If a scene's integrator asks for light that harnack's
path tracer computes, that path tracer is used. Scenes without level sets are left to Mitsuba. All
other scenes are refused with an error that names the integrator.
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
    """Convert hits of rays with a level set to a SurfaceInteraction3f of Mitsuba's, which is valid
    where `met.is_hit`.

    met: the hits, in world coordinates.
    ray: the rays.
    shape: ShapePtr of the proxy (the Mitsuba mesh that stands for the level set), whose BSDF is
        evaluated.

    Texture coordinates are x and y of the position in the world, as a level set has no
    parametrization. The primitive index is the number of the isoline at the hit, by which the BSDF
    chooses a color (`mitsuba_proxy.isoline_bsdf`).
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
    """Return the origin (3,) of a ray that leaves the surface at `si` in direction d and does not
    hit it again there.

    clearance: the least distance of the origin from the surface. A level set needs one, as every
        point within its tolerance is a hit.
    d: (3,) the direction, of any length.

    The origin is moved along the normal to the side to which the ray leaves: as far as for
    Mitsuba's own rays, (1 + |p|_max) RayEpsilon with p the position, but at least by `clearance`.
    """
    distance = dr.maximum((1 + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon, clearance)
    return dr.fma(dr.mulsign(distance, dr.dot(si.n, d)), mi.Vector3f(si.n), si.p)


def spawn_ray(mi: Any, si: Any, clearance: Real, d: Vec3) -> Any:
    """Return the ray from a surface interaction in the unit direction d (3,). clearance: the least
    distance of its origin from the surface."""
    return mi.Ray3f(
        offset_origin(mi, si, clearance, d), d, dr.largest(mi.Float), si.time, si.wavelengths
    )


def spawn_ray_to(mi: Any, si: Any, clearance: Real, target: Vec3) -> Any:
    """Return the ray from a surface interaction to a target point (3,), ending just before it.
    clearance: the least distance of its origin from the surface."""
    o = offset_origin(mi, si, clearance, target - si.p)
    vector = target - o
    length = dr.norm(vector)
    return mi.Ray3f(
        o, vector / length, length * (1 - mi.math.ShadowEpsilon), si.time, si.wavelengths
    )


@dataclass(frozen=True)
class HybridScene:
    """A Mitsuba scene in which rays meet all shapes, Mitsuba's own and the level sets of harnack.

    proxies: the Mitsuba meshes that stand for level sets. No ray of Mitsuba's hits them.
    queued: whether level sets are traced by a queue of rays: few lanes share the rays, and a lane
        that has finished one takes the next. Then rays are traced at once when a method is called,
        not recorded.
    """

    mi: Any
    scene: Any
    proxies: tuple[Any, ...]

    queued: bool = False

    @classmethod
    def of(cls, mi: Any, scene: Any, *, queued: bool = False) -> HybridScene:
        """Return the scene with the proxies that are found in it: the Mitsuba meshes that stand for
        level sets.

        queued: whether rays are traced at once when a method is called, by few lanes that share a
            queue of rays. That is faster for rays of different lengths, and impossible while a
            kernel is being recorded.
        """
        return cls(mi, scene, tuple(s for s in scene.shapes() if is_proxy(s)), queued)

    def _placed(self, proxy: Any) -> PlacedSurface:
        """Return the level set of a proxy, placed in the world. It is traced with a queue of rays
        if the scene is."""
        return proxy.placed.queued() if self.queued else proxy.placed

    def intersect(
        self, ray: Any, start: Any, active: Mask, hidden: Mask | None = None
    ) -> tuple[Any, SurfaceHit]:
        """Find the first hit of rays with a shape or a level set. Returns it as a surface
        interaction of Mitsuba's and as a `SurfaceHit`. For a ray out of steps the interaction is
        not valid.

        start: the interaction at which rays start; not valid for rays that come from a camera.
        active: mask of rays to trace.
        hidden: mask of rays that do not see shapes that emit light; None if there are no such rays.

        Mitsuba's shapes are intersected first, then each level set up to the nearest hit so far.
        """
        mi = self.mi
        preliminary = self.scene.ray_intersect_preliminary(ray, active=active)
        if hidden is not None:
            preliminary = self._skip_emitters(ray, preliminary, active & hidden)
        t_max = dr.minimum(preliminary.t, ray.maxt)
        # Queues trace rays at once, so their ends must be in memory.
        if self.queued:
            dr.eval(preliminary, t_max)
        hit, hit_shape = self.no_hit(dr.zeros(mi.SurfaceInteraction3f)), dr.zeros(mi.ShapePtr)
        for proxy in self.proxies:
            shape = mi.ShapePtr(proxy)
            # 1 if the ray leaves to the side of the normal. A solid has to know whether a ray that
            # starts on it goes out or in.
            side = dr.sign(dr.dot(start.n, ray.d))
            starts_on_it = start.shape == shape
            if proxy.section_proxy is not None:
                starts_on_it |= start.shape == mi.ShapePtr(proxy.section_proxy)
            leaving_side = dr.select(start.is_valid() & starts_on_it, side, 0)
            level_hit = self._placed(proxy).intersect(ray.o, ray.d, t_max, active, leaving_side)
            evaluations = hit.evaluations + level_hit.evaluations
            has_ended = level_hit.is_hit | level_hit.is_out_of_steps
            hit = replace(dr.select(has_ended, level_hit, hit), evaluations=evaluations)
            hit_shape = dr.select(has_ended, shape, hit_shape)
            if proxy.section_proxy is not None:
                hit_shape = dr.select(
                    has_ended & level_hit.is_on_section, mi.ShapePtr(proxy.section_proxy), hit_shape
                )
            t_max = dr.select(has_ended, level_hit.t, t_max)
        has_ended: Mask = hit.is_hit | hit.is_out_of_steps
        # Where no level set was met, the hit with Mitsuba's shapes counts.
        missed = active & ~has_ended
        si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All, missed)
        scene_hit = replace(self._of_scene(si, active), evaluations=hit.evaluations)
        si = dr.select(has_ended, surface_interaction(mi, hit, ray, hit_shape), si)
        return si, dr.select(has_ended, hit, scene_hit)

    def _skip_emitters(self, ray: Any, first: Any, active: Mask) -> Any:
        """Find the first hits of rays with shapes of Mitsuba's that do not emit light. Returns the
        interactions.

        first: the first hits with all of Mitsuba's shapes.
        active: mask of rays that pass through shapes that emit light; other rays keep their first
            hit.
        """
        mi = self.mi

        def is_emitter(hit: Any, active: Mask) -> Mask:
            """Return the mask of hits with a shape that emits light."""
            return active & hit.is_valid() & hit.shape.is_emitter()

        # The state of the loop is the current hit, and the mask of rays that go on.
        def skip(hit: Any, active: Mask) -> tuple[Any, Mask]:
            """Find the next hit of each active ray, behind the shape that it has hit. Returns the
            hits, and the mask of those that are again with a shape that emits light."""
            # The new ray begins just behind the shape.
            distance = hit.t * (1 + mi.math.RayEpsilon) + mi.math.RayEpsilon
            rest_ray = mi.Ray3f(ray)
            rest_ray.o = dr.fma(mi.Vector3f(distance), ray.d, ray.o)
            rest_ray.maxt = ray.maxt - distance
            next_hit = self.scene.ray_intersect_preliminary(rest_ray, active=active)
            # The hit's t counts from the origin of the first ray.
            next_hit.t += distance
            return dr.select(active, next_hit, hit), is_emitter(next_hit, active)

        def is_running(hit: Any, active: Mask) -> Mask:
            del hit
            return active

        loop: Any = dr.while_loop
        hit, _ = loop((first, is_emitter(first, active)), is_running, skip, label="behind lights")
        return hit

    def no_hit(self, si: Any) -> SurfaceHit:
        """Return the `SurfaceHit` of rays that hit nothing. si: interactions that are not valid,
        one for each ray."""
        return self._of_scene(si, self.mi.Bool(False))

    def _of_scene(self, si: Any, active: Mask) -> SurfaceHit:
        """Return the `SurfaceHit` of surface interactions with Mitsuba's own shapes. Entries that
        only level sets have are 0.

        active: mask of the interactions that count as hits if they are valid.
        """
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
        """Return the mask of rays for which the edge of an isoline may pass through the pixel.

        si: the first hit of each ray.
        ray: rays with differentials, that is with the rays of two neighboring pixels.
        d: (3,) the direction in which the ray arrives at the hit; behind glass it is not that of
            the ray.
        t: the length of the path of the ray.

        The rays of the neighboring pixels are assumed to arrive along d, too. Where they meet the
        tangent plane of the hit tells how large the pixel is there.
        """
        mi, is_near = self.mi, self.mi.Bool(False)
        normal = mi.Vector3f(si.n)
        normal_dot_d = dr.dot(normal, d)

        def to_neighbor(o: Any, along: Any) -> Any:
            """Return the vector from the hit to the point at which the ray of a neighboring pixel
            meets the tangent plane. o, along: (3,) the origin and the direction of this ray."""
            # How far the neighbor's ray is from this one, after the length t.
            offset = o + t * along - ray.o - t * ray.d
            return offset - d * (dr.dot(offset, normal) / normal_dot_d)

        # From the hit to where the rays of the neighbors to the right and below meet its plane.
        across, down = to_neighbor(ray.o_x, ray.d_x), to_neighbor(ray.o_y, ray.d_y)
        for proxy in self.proxies:
            if proxy.placed.isolines:
                has_line = proxy.placed.has_line_near(si.p, normal, across, down)
                is_near |= (si.shape == mi.ShapePtr(proxy)) & has_line
        return is_near

    def occluded(self, ray: Any, active: Mask) -> Mask:
        """Return the mask of rays that hit a shape or a level set. Rays that are not proved to miss
        count as hits."""
        blocked = self.scene.ray_test(ray, active)
        for proxy in self.proxies:
            blocked |= self._placed(proxy).occludes(ray.o, ray.d, ray.maxt, active & ~blocked)
        return blocked
