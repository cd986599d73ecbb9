"""A Mitsuba scene together with the level sets that travel in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from harnack.backend import Mask
from harnack.rendering.mitsuba.carrier import is_carrier
from harnack.rendering.mitsuba.interaction import surface_interaction
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.surfaces.encounter import SurfaceHit


@dataclass(frozen=True)
class World:
    """What rays are traced in: all of a scene's shapes, ours and Mitsuba's."""

    mi: Any
    scene: Any
    carriers: tuple[Any, ...]

    @classmethod
    def of(cls, mi: Any, scene: Any) -> World:
        """Finds the carriers in a scene."""
        return cls(mi, scene, tuple(s for s in scene.shapes() if is_carrier(s)))

    def intersect(self, ray: Any, start: Any, active: Mask) -> tuple[Any, SurfaceHit]:
        """The first thing that rays meet, as interaction and as encounter.

        start: the interaction that rays leave, not valid for rays that come from a camera.

        Where the encounter is lost (the ray ran out of steps before anything that is known to be
        there) the interaction is not valid.
        """
        mi = self.mi
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        first = self._of_scene(si, active)
        limit = dr.minimum(si.t, ray.maxt)
        for carrier in self.carriers:
            shape = mi.ShapePtr(carrier)
            side = dr.sign(dr.dot(start.n, ray.d))
            leaves = dr.select(start.is_valid() & (start.shape == shape), side, 0)
            met = carrier.placed.meet(ray.o, ray.d, limit, active, leaves)
            evaluations = first.evaluations + met.evaluations
            event = met.met | met.lost
            si = dr.select(event, surface_interaction(mi, met, ray, shape), si)
            first = replace(dr.select(event, met, first), evaluations=evaluations)
            limit = dr.select(event, met.t, limit)
        return si, first

    def nothing(self, si: Any) -> SurfaceHit:
        """What rays have met before they are traced, given as many interactions that are none."""
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
        )

    def occluded(self, ray: Any, active: Mask) -> Mask:
        """Whether anything lies on the rays. What is not proved free counts as lying there."""
        blocked = self.scene.ray_test(ray, active)
        for carrier in self.carriers:
            blocked |= carrier.placed.occludes(ray.o, ray.d, ray.maxt, active & ~blocked)
        return blocked
