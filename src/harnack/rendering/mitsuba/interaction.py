"""Encounters as Mitsuba's surface interactions, and rays that leave them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.rendering.surfaces.encounter import SurfaceHit


def surface_interaction(mi: Any, met: SurfaceHit, ray: Any, shape: Any) -> Any:
    """The SurfaceInteraction3f of a ray with one of our surfaces, valid where `met.met`.

    shape: ShapePtr of the carrier, whose BSDF is asked. Texture coordinates are x and y of the
    position in the world: a level set has no parametrization of its own. The index of the primitive
    is the number of the isoline that is drawn there, which `lined` looks at.
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
