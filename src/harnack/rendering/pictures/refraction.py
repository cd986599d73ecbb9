"""What shaded pictures show behind clear matter: rays go on through it, bent and tinted.

Of the two ways that light takes at a boundary only the one through it is followed, and the one back
where all of it is reflected; what else is reflected is the sky's light and a highlight. So a
picture has no noise, and no caustics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from harnack.backend import Mask, Real  # at run time: Dr.Jit reads annotations of Sight
from harnack.rendering.mitsuba.clear import index_of, refracted, transmittance
from harnack.rendering.mitsuba.interaction import leaving_ray
from harnack.rendering.mitsuba.world import World
from harnack.rendering.pictures.shading import Light

# Boundaries that a ray goes through; the next one is opaque.
_MOST = 32
# The highlight of matter with this reflectance straight on is that of other glossy materials.
_USUAL = 0.04


@dataclass
class Sight:
    """What rays see: the first thing that light does not pass through.

    ray: the last part of their way. si, first: what it meets. throughput: what is left of the light
    from there. gathered: the light that boundaries on the way reflect to the eye. traveled: the
    length of the way before the last part.
    """

    ray: Any
    si: Any
    first: Any
    throughput: Any
    gathered: Any
    traveled: Real
    boundaries: Any
    active: Mask


class Through:
    """Rays through the clear matter of a world.

    indices: of refraction, of each carrier that is clear. hides_lights: whether shapes that shine
        are not seen.
    """

    def __init__(self, world: World, light: Light, *, hides_lights: bool = False) -> None:
        self.world, self.light = world, light
        self.hidden = world.mi.Bool(True) if hides_lights else None
        mi = world.mi
        found = ((carrier, index_of(mi, carrier)) for carrier in world.carriers)
        self.indices = tuple((carrier, index) for carrier, index in found if index is not None)

    def look(self, ray: Any) -> Sight:
        """What camera rays see."""
        mi, world = self.world.mi, self.world
        nothing = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
        sight = Sight(
            ray, nothing, world.nothing(nothing), mi.Spectrum(1), mi.Spectrum(0), mi.Float(0),
            mi.UInt32(0), dr.full(mi.Bool, True, dr.width(ray.d)),
        )  # fmt: skip
        if not self.indices:
            start = dr.zeros(mi.SurfaceInteraction3f)
            sight.si, sight.first = world.intersect(ray, start, mi.Bool(True), self.hidden)
            return sight

        def running(sight: Sight) -> Mask:
            return sight.active

        def on(sight: Sight) -> tuple[Sight]:
            return (self._on(sight),)

        (sight,) = dr.while_loop((sight,), running, on, label="clear")
        return sight

    def _is_clear(self, si: Any) -> Mask:
        clear = self.world.mi.Bool(False)
        for carrier, _ in self.indices:
            clear |= si.shape == self.world.mi.ShapePtr(carrier)
        return clear

    def _on(self, sight: Sight) -> Sight:
        """The next thing that rays meet and, where it is clear, the way behind it."""
        mi, world, d = self.world.mi, self.world, sight.ray.d
        si, first = world.intersect(sight.ray, sight.si, sight.active, self.hidden)
        throughput = sight.throughput * transmittance(mi, world.carriers, sight.si, si, d)
        boundaries = sight.boundaries + 1
        clear = self._is_clear(si) & (first.line == 0) & first.met & (boundaries <= _MOST)
        index = mi.Float(1)
        for carrier, own in self.indices:
            index = dr.select(si.shape == mi.ShapePtr(carrier), own, index)
        normal = mi.Vector3f(si.n)
        onward, reflected = refracted(normal, d, index)
        outside = clear & (dr.dot(normal, d) < 0)
        gathered = dr.select(outside, throughput * self._reflected(si, d, index, reflected), 0)
        part = dr.select(clear & (reflected < 1), 1 - reflected, 1)
        way = leaving_ray(mi, si, first.clearance, onward)
        return Sight(
            ray=dr.select(clear, way, sight.ray),
            si=si,
            first=first,
            throughput=throughput * part,
            gathered=sight.gathered + gathered,
            traveled=sight.traveled + dr.select(clear, first.t, 0),
            boundaries=boundaries,
            active=sight.active & clear,
        )

    def _reflected(self, si: Any, d: Any, index: Any, share: Real) -> Any:
        """Light of the sky, and of the key light in a highlight, that boundaries send back."""
        mi = self.world.mi
        normal = mi.Vector3f(si.n)
        back = d - 2 * dr.dot(normal, d) * normal
        straight = dr.square((index - 1) / (index + 1))
        black, one = dr.zeros(mi.Color3f), mi.Float(1)
        gloss = self.light.on(black, normal, -d, mi.Bool(True), one) * (straight / _USUAL)
        light = mi.Spectrum(gloss) if not mi.is_monochromatic else mi.Spectrum(mi.luminance(gloss))
        sky = self.world.scene.environment()
        if sky is not None:
            seen = dr.zeros(mi.SurfaceInteraction3f)
            seen.wi, seen.wavelengths = -back, si.wavelengths
            light += share * sky.eval(seen)
        return light
