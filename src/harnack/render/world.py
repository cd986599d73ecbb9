"""A Mitsuba scene together with the level sets that travel in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.render.carrier import is_carrier
from harnack.render.interaction import surface_interaction

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


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

    def intersect(self, ray: Any, coherent: bool, active: Mask) -> tuple[Any, Real, Mask]:
        """The first thing that rays meet: (interaction, clearance, lost).

        clearance: how far off the surface the next ray has to start, at least.
        lost: the ray ran out of steps before anything that is known to be there; its
            interaction is not valid.
        """
        mi = self.mi
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent, active)
        nearest = dr.minimum(si.t, ray.maxt)
        clearance, lost = mi.Float(0), mi.Bool(False)
        for carrier in self.carriers:
            met = carrier.placed.meet(ray.o, ray.d, nearest, active)
            ours = surface_interaction(mi, met, ray, mi.ShapePtr(carrier))
            event = met.met | met.lost
            si = dr.select(event, ours, si)
            clearance = dr.select(met.met, met.clearance, clearance)
            lost = (lost & ~event) | met.lost
            nearest = dr.select(event, met.t, nearest)
        return si, clearance, lost

    def occluded(self, ray: Any, active: Mask) -> Mask:
        """Whether anything lies on the rays. What is not proved free counts as lying there."""
        blocked = self.scene.ray_test(ray, active)
        for carrier in self.carriers:
            blocked |= carrier.placed.occludes(ray.o, ray.d, ray.maxt, active & ~blocked)
        return blocked
