"""Mitsuba scenes with level sets in them: rays through both, and hits as surface interactions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend import Mask
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.mitsuba_proxy import is_carrier
from harnack.rendering.placed_surface import PlacedSurface
from harnack.rendering.surface_hits import SurfaceHit

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3


def surface_interaction(mi: Any, met: SurfaceHit, ray: Any, shape: Any) -> Any:
    """The SurfaceInteraction3f of a ray with one of our surfaces, valid where `met.met`.

    shape: ShapePtr of the carrier, whose BSDF is asked. Texture coordinates are x and y of the
    position in the world: a level set has no parametrization of its own. The index of the primitive
    is the number of the isoline that is drawn there, by which a BSDF chooses
    (`carrier.with_lines`).
    """
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.t = dr.select(met.met, met.t, dr.inf)
    si.p = mi.Point3f(met.position)
    si.n = mi.Normal3f(met.normal)
    si.sh_frame = mi.Frame3f(mi.Vector3f(met.normal))
    si.dp_du, si.dp_dv = si.sh_frame.s, si.sh_frame.t
    si.uv = mi.Point2f(si.p.x, si.p.y)
    si.prim_index = met.line
    si.time = ray.time
    si.wavelengths = ray.wavelengths
    si.shape = dr.select(met.met, shape, dr.zeros(mi.ShapePtr))
    si.wi = si.to_local(-ray.d)
    return si


def leaving_from(mi: Any, si: Any, clearance: Real, d: Vec3) -> Any:
    """Where a ray in direction d starts so as not to meet the surface of `si` again.

    Off the surface along its normal on the side that the ray leaves to, as far as Mitsuba's own
    rays do, (1 + |p|_max) RayEpsilon, but no less than `clearance`: within its tolerance of a
    level set every point is a hit.
    """
    distance = dr.maximum((1 + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon, clearance)
    return dr.fma(dr.mulsign(distance, dr.dot(si.n, d)), mi.Vector3f(si.n), si.p)


def leaving_ray(mi: Any, si: Any, clearance: Real, d: Vec3) -> Any:
    """The ray from `si` in direction d."""
    return mi.Ray3f(
        leaving_from(mi, si, clearance, d), d, dr.largest(mi.Float), si.time, si.wavelengths
    )


def connecting_ray(mi: Any, si: Any, clearance: Real, target: Vec3) -> Any:
    """The ray from `si` to a target point, ending just before it."""
    o = leaving_from(mi, si, clearance, target - si.p)
    way = target - o
    length = dr.norm(way)
    return mi.Ray3f(o, way / length, length * (1 - mi.math.ShadowEpsilon), si.time, si.wavelengths)


@dataclass(frozen=True)
class World:
    """What rays are traced in: all of a scene's shapes, ours and Mitsuba's."""

    mi: Any
    scene: Any
    carriers: tuple[Any, ...]

    queued: bool = False

    @classmethod
    def of(cls, mi: Any, scene: Any, *, queued: bool = False) -> World:
        """Finds the carriers in a scene.

        queued: whether rays are traced without delay, from a queue, which is faster where they
            differ in length, and cannot be done while a kernel is being recorded.
        """
        return cls(mi, scene, tuple(s for s in scene.shapes() if is_carrier(s)), queued)

    def _placed(self, carrier: Any) -> PlacedSurface:
        return carrier.placed.queued() if self.queued else carrier.placed

    def intersect(
        self, ray: Any, start: Any, active: Mask, hidden: Mask | None = None
    ) -> tuple[Any, SurfaceHit]:
        """The first hit of rays, as a surface interaction and as a `SurfaceHit`.

        start: the interaction that rays leave, not valid for rays that come from a camera. hidden:
        rays that do not see shapes that shine; None for none.

        Where the hit is lost (the ray ran out of steps before anything that is known to be there)
        the interaction is not valid.
        """
        mi = self.mi
        preliminary = self.scene.ray_intersect_preliminary(ray, active=active)
        if hidden is not None:
            preliminary = self._behind_lights(ray, preliminary, active & hidden)
        limit = dr.minimum(preliminary.t, ray.maxt)
        if self.queued:
            dr.eval(preliminary, limit)
        ours, whose = self.nothing(dr.zeros(mi.SurfaceInteraction3f)), dr.zeros(mi.ShapePtr)
        for carrier in self.carriers:
            shape = mi.ShapePtr(carrier)
            side = dr.sign(dr.dot(start.n, ray.d))
            own = start.shape == shape
            if carrier.cut_face is not None:
                own |= start.shape == mi.ShapePtr(carrier.cut_face)
            leaves = dr.select(start.is_valid() & own, side, 0)
            met = self._placed(carrier).meet(ray.o, ray.d, limit, active, leaves)
            evaluations = ours.evaluations + met.evaluations
            event = met.met | met.lost
            ours = replace(dr.select(event, met, ours), evaluations=evaluations)
            whose = dr.select(event, shape, whose)
            if carrier.cut_face is not None:
                whose = dr.select(event & met.cut, mi.ShapePtr(carrier.cut_face), whose)
            limit = dr.select(event, met.t, limit)
        event: Mask = ours.met | ours.lost
        others = active & ~event
        si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All, others)
        first = replace(self._of_scene(si, active), evaluations=ours.evaluations)
        si = dr.select(event, surface_interaction(mi, ours, ray, whose), si)
        return si, dr.select(event, ours, first)

    def _behind_lights(self, ray: Any, first: Any, active: Mask) -> Any:
        """What rays hit of the scene behind the shapes that shine."""
        mi = self.mi

        def shines(found: Any, active: Mask) -> Mask:
            return active & found.is_valid() & found.shape.is_emitter()

        def on(found: Any, active: Mask) -> tuple[Any, Mask]:
            past = found.t * (1 + mi.math.RayEpsilon) + mi.math.RayEpsilon
            rest = mi.Ray3f(ray)
            rest.o = dr.fma(mi.Vector3f(past), ray.d, ray.o)
            rest.maxt = ray.maxt - past
            after = self.scene.ray_intersect_preliminary(rest, active=active)
            after.t += past
            return dr.select(active, after, found), shines(after, active)

        def running(found: Any, active: Mask) -> Mask:
            del found
            return active

        loop: Any = dr.while_loop
        found, _ = loop((first, shines(first, active)), running, on, label="behind lights")
        return found

    def nothing(self, si: Any) -> SurfaceHit:
        """The `SurfaceHit` of rays that hit nothing, given as many invalid interactions."""
        return self._of_scene(si, self.mi.Bool(False))

    def _of_scene(self, si: Any, active: Mask) -> SurfaceHit:
        mi, vector = self.mi, mitsuba_backend(self.mi).Array3f
        return SurfaceHit(
            t=si.t,
            met=active & si.is_valid(),
            lost=mi.Bool(False),
            position=vector(si.p),
            normal=vector(si.n),
            clearance=mi.Float(0),
            value=mi.Float(0),
            evaluations=mi.UInt32(0),
            mended=mi.Bool(False),
            cut=mi.Bool(False),
            line=mi.UInt32(0),
        )

    def has_line_near(self, si: Any, ray: Any, d: Any, t: Any) -> Mask:
        """Whether the edge of an isoline may pass through the pixel of a ray with differentials.

        d: the direction in which the ray arrives. t: the length of its way. Where neighboring rays
        hit the tangent plane is found along d.
        """
        mi, near = self.mi, self.mi.Bool(False)
        normal = mi.Vector3f(si.n)
        facing = dr.dot(normal, d)

        def to_neighbor(o: Any, along: Any) -> Any:
            way = o + t * along - ray.o - t * ray.d
            return way - d * (dr.dot(way, normal) / facing)

        across, down = to_neighbor(ray.o_x, ray.d_x), to_neighbor(ray.o_y, ray.d_y)
        for carrier in self.carriers:
            if carrier.placed.lines:
                found = carrier.placed.has_line_near(si.p, normal, across, down)
                near |= (si.shape == mi.ShapePtr(carrier)) & found
        return near

    def occluded(self, ray: Any, active: Mask) -> Mask:
        """Whether rays hit anything; those not proved to hit nothing count as hitting."""
        blocked = self.scene.ray_test(ray, active)
        for carrier in self.carriers:
            blocked |= self._placed(carrier).occludes(ray.o, ray.d, ray.maxt, active & ~blocked)
        return blocked
