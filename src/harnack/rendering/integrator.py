"""A path tracer that sees both Mitsuba's shapes and level sets, and the sampler of its light paths.

All light paths advance together, one vertex at a time, and the rays of a vertex are traced from a
    queue: a lane that has finished a ray takes the next one. In a recorded loop over whole paths,
    each packet of lanes would wait for its slowest ray at each vertex, and three quarters of the
    lanes were idle. Paths that have ended are left out after each vertex. Fields whose samples take
    less time than taking a ray from the queue are traced without it (`Field.is_cheap`). The queue
    only changes the order of lanes, not the results. Intermediate results are written to memory, so
    that kernels do not depend on the number of paths that are left.

Paths change lanes. So the random numbers of a path are computed from its pixel and index, and not
from a state of its lane.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.loops import active_lanes, array_leaves, broadcast_copy, gather_record
from harnack.rendering.hybrid_scene import HybridScene, spawn_ray, spawn_ray_to
from harnack.rendering.mitsuba import load_mitsuba, transmittance

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

# Dimensions for camera rays, and for each vertex of a path.
_CAMERA, _VERTEX = 8, 8
# Sobol's second dimension is Pascal's triangle modulo 2, applied by halves.
_PASCAL = ((0xAAAAAAAA, 1), (0xCCCCCCCC, 2), (0xF0F0F0F0, 4), (0xFF00FF00, 8), (0xFFFF0000, 16))
# Multipliers of a permutation of 32 bits in which each depends on those below (Vegdahl 2021), and
# of a hash of 32 bits (Wellons 2018).
_OWEN = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)
_HASH = (0x21F0AAAD, 0xD35A2D97)


@dataclass
class SobolSampler:
    """Points of Sobol' for light paths, scrambled after Owen, computed from their index alone.

    A sampler with a state would have to be carried along with each path. This one needs only the
    path's pixel, the index of its sample and the dimension. So paths can be moved to other lanes,
    and a path has the same numbers whatever else is drawn. Each pair of dimensions consists of the
    first two dimensions of Sobol' in an order of its own (Burley 2020, Practical Hash-based Owen
    Scrambling). This stratifies the samples of a pixel as well as multi-jittering does, for any
    number of samples.

    Methods are called as those of Mitsuba's samplers. Each call takes the next dimension.

    pixel, index: UInt32, for each path its pixel, and the index of its sample in the pixel.
    seed: UInt32; another seed gives other points.
    dimension: UInt32, the dimension that the next call takes.
    """

    mi: Any
    pixel: Any
    index: Any
    seed: Any
    dimension: Any

    def at_vertex(self, depth: Any, rows: Any) -> SobolSampler:
        """The sampler of a subset of the paths at the vertex `depth`, counted from 0. rows: the
        indices of these paths."""
        uint = self.mi.UInt32
        pixel, index = dr.gather(uint, self.pixel, rows), dr.gather(uint, self.index, rows)
        return SobolSampler(self.mi, pixel, index, self.seed, _CAMERA + _VERTEX * uint(depth))

    def next_2d(self, active: Any = True) -> Any:
        """The next random point in [0, 1)^2 of each path."""
        del active
        uint, mi = self.mi.UInt32, self.mi
        key = _hashed(uint, self.pixel + _hashed(uint, self.dimension + _hashed(uint, self.seed)))
        self.dimension = self.dimension + 1
        shuffled = _owen(uint, self.index, key)
        x, y = dr.brev(shuffled), shuffled
        for mask, shift in _PASCAL:
            y = y ^ ((y & uint(mask)) >> shift)
        pair = (
            _owen(uint, x, _hashed(uint, key + 1)),
            _owen(uint, dr.brev(y), _hashed(uint, key + 2)),
        )
        largest = 1 - dr.epsilon(mi.Float)
        return mi.Point2f(*(dr.minimum(mi.Float(bits) * 2.0**-32, largest) for bits in pair))

    def next_1d(self, active: Any = True) -> Any:
        """The next random number in [0, 1) of each path."""
        return self.next_2d(active).x


def _hashed(uint: Any, x: Any) -> Any:
    """A hash of 32-bit integers (Wellons 2018). uint: the array type."""
    x = uint(x)
    for multiplier, shift in zip(_HASH, (16, 15), strict=True):
        x = (x ^ (x >> shift)) * uint(multiplier)
    return x ^ (x >> 15)


def _owen(uint: Any, x: Any, seed: Any) -> Any:
    """Owen's scrambling of 32-bit integers: whether a bit is flipped depends on the bits above it
    and on the seed. uint: the array type."""
    x = dr.brev(x) + seed
    for multiplier in _OWEN:
        x ^= x * uint(multiplier)
    return dr.brev(x)


PLUGIN = "harnack_path"
INTEGRATOR = "HarnackPath"
# The color of rays out of steps: nothing in nature has this color.
OUT_OF_STEPS_COLOR = (1.0, 0.0, 1.0)

_UNLIMITED = 2**32 - 1


@dataclass(frozen=True)
class _Vertex:
    """The last vertex of each path: its position (3,) and normal (3,), the shape on which it lies,
    and whether there is one (before the first vertex there is none)."""

    position: Any
    normal: Any
    shape: Any
    is_valid: Mask

    @classmethod
    def none(cls, mi: Any) -> _Vertex:
        """The vertex of paths that have none yet, as they come from the camera; it is not valid."""
        zero = dr.zeros(mi.SurfaceInteraction3f)
        return cls(zero.p, zero.n, zero.shape, mi.Bool(False))

    @classmethod
    def of(cls, si: Any) -> _Vertex:
        """The vertex at a surface interaction of Mitsuba's."""
        return cls(si.p, si.n, si.shape, si.is_valid())

    def interaction(self, mi: Any) -> Any:
        """The vertex as a surface interaction of Mitsuba's, which has only position, normal and
        shape."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p, si.n, si.shape = self.position, self.normal, self.shape
        si.t = dr.select(self.is_valid, mi.Float(0), dr.inf)
        return si


@dataclass(frozen=True)
class _PathState:
    """The state of light paths between two vertices.

    number: the index of the path among all paths.
    ray: from the last vertex to the next one.
    throughput: the fraction of the light along the ray that reaches the camera.
    eta: the product of the relative refractive indices so far. It keeps Russian roulette from
        ending paths in glass.
    previous: the last vertex.
    pdf, delta: the probability density with which the last vertex sampled the ray, and whether it
        could sample no other direction. They give the weight of a light that the ray finds.
    is_diffused, was_diffused: whether a rough surface has scattered the path up to the last vertex,
        and up to the vertex before that.
    """

    number: Any
    ray: Any
    throughput: Any
    eta: Real
    previous: _Vertex
    pdf: Real
    delta: Mask
    is_diffused: Mask
    was_diffused: Mask


@dataclass(frozen=True)
class _LightConnection:
    """The light that comes from an emitter to a vertex and is scattered there along the path, if
    nothing lies on the ray to the emitter.

    ray: from the vertex to a point of the emitter. active: whether there is such light.
    """

    ray: Any
    light: Any
    active: Mask


@dataclass
class DenoisingFeatures:
    """What the denoiser needs of the first hits of paths: albedo, in (0, 1), and unit normal. Both
    are 0 for paths that hit nothing."""

    albedo: Any
    normal: Any

    def record(self, mi: Any, si: Any, numbers: Any, active: Mask) -> None:
        """Store the albedo and normal at surface interactions `si`, at the indices `numbers` of
        their paths."""
        bsdf, straight = si.bsdf(), mi.SurfaceInteraction3f(si)
        straight.wi = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), si.wi.z))
        albedo = bsdf.eval_diffuse_reflectance(straight, active)
        # Mirrors may give more than 1 straight on: their hue stays. Clear matter counts as white.
        albedo = albedo / dr.maximum(1, dr.max(albedo))
        albedo = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), albedo, 1)
        dr.scatter(self.albedo, mi.Spectrum(albedo), numbers, active)
        dr.scatter(self.normal, mi.Vector3f(si.sh_frame.n), numbers, active)


@dataclass
class PathResults:
    """The results of light paths, with one entry for each path.

    light: the radiance that reaches the camera.
    valid: whether the path hits a surface.
    lost: whether one of its rays ran out of steps.
    features: albedo and normal at the first hit, if requested; else None.
    """

    light: Any
    valid: Mask
    lost: Mask
    features: DenoisingFeatures | None = None


class PathTracer:
    """Path tracing with multiple importance sampling of lights and BSDFs (Veach 1997).

    max_depth: the length of the longest path in edges, -1 for no limit.
    rr_depth: the vertex, counted from 1, at which Russian roulette begins.
    hide_emitters: whether lights and environment are invisible to the camera.
    clamp: an upper limit of the contribution of a path whose light was scattered by a rough surface
        before its last scattering. A finite limit removes some light, and with it the white specks
        ("fireflies") of sharp reflections and caustics that paths sample too rarely.
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
        self._first_roulette = dr.opaque(mi.UInt32, rr_depth)
        self._brightest = dr.opaque(mi.Float, clamp)
        self.lost_color = mi.load_dict(
            {"type": "srgb", "color": list(OUT_OF_STEPS_COLOR)}, parallel=False
        )

    def with_depth(self, max_depth: int) -> PathTracer:
        """The same path tracer with another length of the longest path in edges, -1 for no
        limit."""
        return PathTracer(self.mi, max_depth, self.rr_depth, self.hide_emitters, self.clamp)

    def trace(
        self, scene: Any, sampler: SobolSampler, ray: Any, active: Mask, features: bool = False
    ) -> PathResults:
        """Trace the light paths that begin with the given camera rays, one for each lane of the
        sampler, and return their `PathResults`.

        features: whether albedo and normal at first hits are stored, too.

        All paths advance together, vertex by vertex. Paths that have ended are left out, and each
        part of the work at a vertex is done only for the paths that need it (`backend.loops`).
        """
        mi, world = self.mi, HybridScene.of(self.mi, scene, queued=True)
        width = dr.width(sampler.index)
        results = PathResults(
            dr.zeros(mi.Spectrum, width), dr.zeros(mi.Bool, width), dr.zeros(mi.Bool, width)
        )
        if features:
            results.features = DenoisingFeatures(
                dr.zeros(mi.Spectrum, width), dr.zeros(mi.Vector3f, width)
            )
            dr.make_opaque(results.features.albedo, results.features.normal)
        paths = _PathState(
            number=dr.arange(mi.UInt32, width),
            ray=mi.Ray3f(dr.detach(ray)),
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            previous=_Vertex.none(mi),
            pdf=mi.Float(1),
            delta=mi.Bool(True),
            is_diffused=mi.Bool(False),
            was_diffused=mi.Bool(False),
        )
        paths = broadcast_copy(paths, width, mi.UInt32)
        dr.make_opaque(results.light, results.valid, results.lost)
        goes_on, depth = mi.Bool(active) & dr.full(mi.Bool, True, width), 0
        while True:
            rows, count = active_lanes(goes_on)
            if not count:
                return results
            paths = gather_record(paths, rows)
            # `rows` lists a single path twice; the second entry is not active.
            active = dr.arange(mi.UInt32, len(rows)) < dr.opaque(mi.UInt32, count)
            # No number is a literal, so that all vertices run the same kernels.
            dr.make_opaque(active, *array_leaves(paths))
            paths, goes_on = self._vertex(world, paths, active, sampler, depth, results)
            depth += 1

    def _vertex(
        self, world: HybridScene, paths: _PathState, exist: Mask, sampler: SobolSampler, depth: int,
        results: PathResults,
    ) -> tuple[_PathState, Mask]:  # fmt: skip
        """Find the next vertex of paths, add its light to `results`, and sample the next direction.
        Returns the state of the paths behind the vertex, and the mask of paths that go on.

        exist: mask of lanes that hold a path.
        depth: the number of the vertex, counted from 0.
        """
        mi, vertex = self.mi, dr.opaque(self.mi.UInt32, depth)
        previous = paths.previous.interaction(mi)
        hidden = (vertex == 0) if self.hide_emitters else None
        si, hit = world.intersect(paths.ray, previous, exist, hidden)
        numbers = sampler.at_vertex(vertex, paths.number)
        remaining = transmittance(mi, world.proxies, previous, si, paths.ray.d)
        paths = replace(paths, throughput=paths.throughput * remaining)
        shows = exist & ~hit.is_out_of_steps & (vertex < self._deepest)
        if hidden is not None:
            shows &= ~hidden
        light = self._emitted(world.scene, paths, si, shows)
        lost_light = paths.throughput * mi.Spectrum(self.lost_color.eval(si, hit.is_out_of_steps))
        light += dr.select(hit.is_out_of_steps, lost_light, 0)
        active = si.is_valid() & (vertex + 1 < self._deepest)
        bsdf = si.bsdf()
        connection = self._connection(world, paths, si, hit.ray_offset, numbers, active)

        sample, weight = bsdf.sample(
            mi.BSDFContext(), si, numbers.next_1d(), numbers.next_2d(), active
        )
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        throughput = paths.throughput * weight
        eta = paths.eta * sample.eta
        brightest = dr.max(throughput)
        active &= brightest > 0
        # Russian roulette, without the factor eta^-2 that radiance takes on in glass.
        survival = dr.minimum(brightest * eta * eta, 0.95)
        in_roulette = vertex + 1 >= self._first_roulette
        active &= ~in_roulette | (numbers.next_1d() < survival)
        next_paths = _PathState(
            number=paths.number,
            ray=spawn_ray(mi, si, hit.ray_offset, si.to_world(sample.wo)),
            throughput=dr.select(in_roulette, throughput / survival, throughput),
            eta=eta,
            previous=_Vertex.of(si),
            pdf=sample.pdf,
            delta=delta,
            is_diffused=paths.is_diffused | ~delta,
            was_diffused=paths.is_diffused,
        )
        is_first = (vertex == 0) & (si.is_valid() | hit.is_out_of_steps)
        dr.scatter(results.valid, mi.Bool(True), paths.number, is_first)
        dr.scatter(results.lost, mi.Bool(True), paths.number, hit.is_out_of_steps)
        if results.features is not None:
            results.features.record(mi, si, paths.number, is_first & si.is_valid())
        # In one kernel, so that nothing about vertices is computed twice.
        outputs = (results.valid, results.lost, results.features)
        dr.eval(active, light, outputs, *array_leaves(next_paths), *array_leaves(connection))
        blocked = world.occluded(connection.ray, connection.active)
        light += dr.select(connection.active & ~blocked, connection.light, 0)
        # Each path has its own entry, so that the order of sums is fixed.
        dr.scatter_add(results.light, light, paths.number, exist, mode=dr.ReduceMode.NoConflicts)
        dr.eval(results.light)
        return next_paths, active

    def _emitted(self, scene: Any, paths: _PathState, si: Any, active: Mask) -> Any:
        """The light that the surface at a vertex emits along the path. If a ray has hit nothing, it
        is the light of the environment.

        si: the interaction at the vertex.
        """
        mi, previous = self.mi, paths.previous.interaction(self.mi)
        direction = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, direction, active & ~paths.delta)
        weight = _power_heuristic(paths.pdf, emitter_pdf)
        light = paths.throughput * weight * direction.emitter.eval(si, active)
        return dr.select(active, self._clamped(light, paths.was_diffused), 0)

    def _clamped(self, light: Any, indirect: Mask) -> Any:
        """The light; on lanes of `indirect` it is dimmed such that no channel exceeds `clamp`."""
        if self.clamp == math.inf:
            return light
        excess = dr.max(light) / self._brightest
        return dr.select(indirect & (excess > 1), light / excess, light)

    def _connection(
        self,
        world: HybridScene,
        paths: _PathState,
        si: Any,
        clearance: Real,
        numbers: SobolSampler,
        active: Mask,
    ) -> _LightConnection:
        """The light from a sampled point of an emitter that each vertex scatters along its path,
        and the ray to that point, which has to be free.

        si: the interaction at the vertex.
        clearance: the distance from the surface at which a ray has to start.
        numbers: the sampler.
        """
        mi, bsdf = self.mi, si.bsdf()
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light, weight = world.scene.sample_emitter_direction(si, numbers.next_2d(), False, active)
        active &= light.pdf > 0
        scattered, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(light.d), active)
        active &= dr.max(scattered) > 0
        fraction = dr.select(light.delta, 1, _power_heuristic(light.pdf, pdf))
        sent = self._clamped(paths.throughput * scattered * weight * fraction, paths.is_diffused)
        return _LightConnection(spawn_ray_to(mi, si, clearance, light.p), sent, active)


def _power_heuristic(a: Real, b: Real) -> Real:
    """The weight a^2/(a^2 + b^2) of a sample with probability density a, if another technique gives
    it with density b: Veach's power heuristic. It is 0 if it is not finite."""
    a, b = a * a, b * b
    weight = a / (a + b)
    return dr.select(dr.isfinite(weight), weight, 0)


def _sobol_from(mi: Any, sampler: Any) -> SobolSampler:
    """A `SobolSampler` with a seed from one of Mitsuba's samplers, whose lanes are the samples of
    pixel after pixel."""
    width, spp = sampler.wavefront_size(), max(int(sampler.sample_count()), 1)
    lane = dr.arange(mi.UInt32, width)
    seed = mi.UInt32(dr.gather(mi.Float, sampler.next_1d(), mi.UInt32(0)) * 2.0**24)
    samples = dr.opaque(mi.UInt32, spp)
    return SobolSampler(mi, lane // samples, lane % samples, seed, dr.opaque(mi.UInt32, 0))


@functools.cache
def integrator_class(variant: str) -> Any:
    """The class of the plug-in `harnack_path` for a Mitsuba variant, as Mitsuba's base classes
    differ from variant to variant."""
    mi = load_mitsuba()
    if mi.variant() != variant:
        raise RuntimeError(f"the variant changed from {variant} to {mi.variant()}")

    class HarnackPath(mi.SamplingIntegrator):
        """Mitsuba's interface to `PathTracer`. Its properties are the arguments of `PathTracer`."""

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
            """The light of camera rays, whether they hit a surface, and no further channels, as
            Mitsuba asks for them."""
            del medium
            results = self.tracer.trace(scene, _sobol_from(mi, sampler), ray, active)
            self.lost = self.lost + dr.count(results.lost)
            return results.light, results.valid, []

        def take_lost(self) -> int:
            """The number of paths that ran out of steps since the last call of this method."""
            count = int(self.lost[0])
            self.lost = mi.UInt32(0)
            return count

        def to_string(self) -> str:
            return f"{INTEGRATOR}[max_depth = {self.tracer.max_depth}]"

    return HarnackPath
