"""A path tracer that sees Mitsuba's shapes and ours."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from harnack.backend import Mask, Real  # needed at run time: Dr.Jit reads annotations of _Path
from harnack.rendering.mitsuba.clear import transmittance
from harnack.rendering.mitsuba.interaction import connecting_ray, leaving_ray
from harnack.rendering.mitsuba.variant import load_mitsuba
from harnack.rendering.mitsuba.world import World

PLUGIN = "harnack_path"
INTEGRATOR = "HarnackPath"
# What a ray that ran out of steps is drawn in: nothing in nature is this colour.
LOST_COLOUR = (1.0, 0.0, 1.0)

_UNLIMITED = 2**32 - 1


@dataclass
class _Path:
    """What a path remembers from one vertex to the next.

    previous, pdf, delta: the last vertex and how it sampled the ray, for the weights of lights
        that the ray finds.
    eta: product of relative refractive indices; keeps Russian roulette from ending paths in glass.
    spread, spread_before: whether a rough surface has scattered the path up to the last vertex,
        and up to the one before that.
    """

    ray: Any
    radiance: Any
    throughput: Any
    eta: Real
    depth: Any
    previous: Any
    pdf: Real
    delta: Mask
    spread: Mask
    spread_before: Mask
    lost: Mask
    valid: Mask
    active: Mask


class PathTracer:
    """Path tracing with multiple importance sampling of lights and BSDFs (Veach 1997).

    max_depth: longest path in edges, -1 for no limit. rr_depth: where Russian roulette begins.
    hide_emitters: whether lights and environment are invisible to the camera.
    clamp: the most that a path may bring of light that was spread by a rough surface before its
        last scattering. A finite one takes some light away, and with it the white specks of
        sharp reflections and caustics that paths find too rarely.
    """

    def __init__(
        self,
        mi: Any,
        max_depth: int = 12,
        rr_depth: int = 4,
        hide_emitters: bool = False,
        clamp: float = math.inf,
    ) -> None:
        if max_depth < -1 or rr_depth < 1:
            raise ValueError(
                "max_depth must be -1 (no limit) or >= 0 and rr_depth >= 1, "
                f"not {max_depth} and {rr_depth}"
            )
        self.mi = mi
        self.max_depth = _UNLIMITED if max_depth == -1 else max_depth
        self.rr_depth = rr_depth
        self.hide_emitters = hide_emitters
        self.clamp = clamp
        # Kernel parameters: other limits compile nothing.
        self._deepest = dr.opaque(mi.UInt32, self.max_depth)
        self._first_gamble = dr.opaque(mi.UInt32, rr_depth)
        self._brightest = dr.opaque(mi.Float, clamp)
        self.lost_colour = mi.load_dict(
            {"type": "srgb", "color": list(LOST_COLOUR)}, parallel=False
        )

    def with_depth(self, max_depth: int) -> PathTracer:
        """The same with another longest path."""
        return PathTracer(self.mi, max_depth, self.rr_depth, self.hide_emitters, self.clamp)

    def trace(self, scene: Any, sampler: Any, ray: Any, active: Mask) -> tuple[Any, Mask, Mask]:
        """Radiance along rays, whether they met a surface, whether a ray of the path got lost."""
        mi, world = self.mi, World.of(self.mi, scene)
        start = _Path(
            ray=mi.Ray3f(dr.detach(ray)),
            radiance=mi.Spectrum(0),
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            depth=mi.UInt32(0),
            previous=dr.zeros(mi.SurfaceInteraction3f),
            pdf=mi.Float(1),
            delta=mi.Bool(True),
            spread=mi.Bool(False),
            spread_before=mi.Bool(False),
            lost=mi.Bool(False),
            valid=mi.Bool(False),
            active=mi.Bool(active),
        )

        def body(path: _Path, sampler: Any) -> tuple[_Path, Any]:
            return self._vertex(world, path, sampler), sampler

        def running(path: _Path, sampler: Any) -> Mask:
            del sampler
            return path.active

        path, _ = dr.while_loop((start, sampler), running, body, label="harnack path")
        return path.radiance, path.valid, path.lost

    def _vertex(self, world: World, path: _Path, sampler: Any) -> _Path:
        """Finds the next vertex of paths, collects its light and samples where to go on."""
        mi = self.mi
        si, met = world.intersect(path.ray, path.previous, path.active)
        clearance, lost = met.clearance, met.lost
        left = transmittance(mi, world.carriers, path.previous, si, path.ray.d)
        path = replace(path, throughput=path.throughput * left)
        radiance = path.radiance + self._emitted(world.scene, path, si, path.active & ~lost)
        shown = path.throughput * mi.Spectrum(self.lost_colour.eval(si, lost))
        radiance += dr.select(path.active & lost, shown, 0)
        active = path.active & si.is_valid() & (path.depth + 1 < self._deepest)
        bsdf = si.bsdf()
        radiance += self._lit(world, path, si, clearance, bsdf, sampler, active)

        sample, weight = bsdf.sample(
            mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
        )
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        throughput = path.throughput * weight
        eta = path.eta * sample.eta
        brightest = dr.max(throughput)
        active &= brightest > 0
        # Russian roulette, without the factor eta^-2 that radiance takes on in glass.
        keep = dr.minimum(brightest * eta * eta, 0.95)
        gamble = path.depth + 1 >= self._first_gamble
        active &= ~gamble | (sampler.next_1d(active) < keep)
        throughput = dr.select(gamble, throughput / keep, throughput)
        return _Path(
            ray=leaving_ray(mi, si, clearance, si.to_world(sample.wo)),
            radiance=radiance,
            throughput=throughput,
            eta=eta,
            depth=path.depth + 1,
            previous=si,
            pdf=sample.pdf,
            delta=delta,
            spread=path.spread | ~delta,
            spread_before=path.spread,
            lost=path.lost | (path.active & lost),
            valid=path.valid | ((path.depth == 0) & (si.is_valid() | lost)),
            active=active,
        )

    def _emitted(self, scene: Any, path: _Path, si: Any, active: Mask) -> Any:
        """Light that a vertex, or the environment behind no vertex, sends along the ray."""
        mi = self.mi
        if self.hide_emitters:
            active = active & (path.depth > 0)
        found = mi.DirectionSample3f(scene, si, path.previous)
        other = scene.pdf_emitter_direction(path.previous, found, active & ~path.delta)
        weight = _power_heuristic(path.pdf, other)
        light = path.throughput * weight * found.emitter.eval(si, active)
        return dr.select(active, self._limited(light, path.spread_before), 0)

    def _limited(self, light: Any, indirect: Mask) -> Any:
        """Light, dimmed to at most `clamp` in every channel where it is indirect."""
        if self.clamp == math.inf:
            return light
        excess = dr.max(light) / self._brightest
        return dr.select(indirect & (excess > 1), light / excess, light)

    def _lit(
        self,
        world: World,
        path: _Path,
        si: Any,
        clearance: Real,
        bsdf: Any,
        sampler: Any,
        active: Mask,
    ) -> Any:
        """Light that a vertex scatters along the ray from a sampled point of an emitter."""
        mi = self.mi
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light, weight = world.scene.sample_emitter_direction(
            si, sampler.next_2d(active), False, active
        )
        active &= light.pdf > 0
        scattered, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(light.d), active)
        active &= dr.max(scattered) > 0
        active &= ~world.occluded(connecting_ray(mi, si, clearance, light.p), active)
        share = dr.select(light.delta, 1, _power_heuristic(light.pdf, pdf))
        found = path.throughput * scattered * weight * share
        return dr.select(active, self._limited(found, path.spread), 0)


def _power_heuristic(a: Real, b: Real) -> Real:
    """Veach's power heuristic with exponent 2."""
    a, b = a * a, b * b
    weight = a / (a + b)
    return dr.select(dr.isfinite(weight), weight, 0)


@functools.cache
def integrator_class(variant: str) -> Any:
    """The plugin's class; Mitsuba's classes differ from variant to variant."""
    mi = load_mitsuba()
    if mi.variant() != variant:
        raise RuntimeError(f"the variant changed from {variant} to {mi.variant()}")

    class HarnackPath(mi.SamplingIntegrator):
        """Mitsuba's interface to `PathTracer`, whose arguments are the plug-in's properties."""

        def __init__(self, props: Any) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.tracer = PathTracer(
                mi,
                props.get("max_depth", 12),
                props.get("rr_depth", 4),
                props.get("hide_emitters", False),
                props.get("clamp", math.inf),
            )
            self.lost = mi.UInt32(0)

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Mask = True
        ) -> tuple[Any, Mask, list[Any]]:
            del medium
            radiance, valid, lost = self.tracer.trace(scene, sampler, ray, active)
            dr.scatter_add(self.lost, mi.UInt32(1), mi.UInt32(0), lost)
            return radiance, valid, []

        def take_lost(self) -> int:
            """How many paths ran out of steps since the last call."""
            count = int(self.lost[0])
            self.lost = mi.UInt32(0)
            return count

        def to_string(self) -> str:
            return f"{INTEGRATOR}[max_depth = {self.tracer.max_depth}]"

    return HarnackPath
