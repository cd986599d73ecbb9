"""A path tracer that sees both Mitsuba's shapes and level sets, and the sampler of its light paths.
A light path begins at the camera, and each of its vertices is a hit of a ray with a surface, where
the next direction is sampled. `mi` is the Mitsuba module, `si` is a surface interaction of
Mitsuba's at a vertex, and a lane is the entry of one path in Dr.Jit arrays. A path whose ray runs
out of steps, neither proved free nor led to a hit, is called lost.

All light paths advance together, one vertex at a time, and the rays of a vertex are traced from a
queue: a lane that has finished a ray takes the next one. In a recorded loop over whole paths, each
packet of lanes would wait for its slowest ray at each vertex, and three quarters of the lanes were
idle. Paths that have ended are left out after each vertex. Fields whose samples take less time than
taking a ray from the queue are traced without it (`Traits.is_cheap`). The queue only changes the
order of lanes, not the results. Intermediate results are written to memory, so that kernels do not
depend on the number of paths that are left.

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
from harnack.rendering.mitsuba_proxy import refuse_attached_surfaces

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
    """Computes the random numbers of light paths: Sobol' points, scrambled after Owen. Each number
    depends only on the path's pixel, the index of the path in this pixel, and the dimension, which
    counts how many numbers the path has used.

    A sampler with a state would have to be carried along with the path when it changes lanes. This
    one has none. So paths can be moved to other lanes, and a path has the same numbers whatever
    else is drawn. Every call uses the first two dimensions of Sobol's points, but in another order
    and scrambled in another way (Burley 2020, Practical Hash-based Owen Scrambling). This
    stratifies the samples of a pixel as well as multi-jittering does, for any number of samples.

    Methods are called as those of Mitsuba's samplers. Each call takes the next dimension.

    pixel, index: UInt32, for each path its pixel, and the index of the path in the pixel.
    seed: UInt32; another seed gives other points.
    dimension: UInt32, the dimension that the next call takes.
    """

    mi: Any
    pixel: Any
    index: Any
    seed: Any
    dimension: Any

    def at_vertex(self, depth: Any, rows: Any) -> SobolSampler:
        """Return the sampler for some of the paths at one of their vertices. Each vertex has its
        own eight dimensions, after those of the camera.

        depth: the number of the vertex, counted from 0.
        rows: the indices of the paths among all paths of this sampler.
        """
        uint = self.mi.UInt32
        pixel, index = dr.gather(uint, self.pixel, rows), dr.gather(uint, self.index, rows)
        return SobolSampler(self.mi, pixel, index, self.seed, _CAMERA + _VERTEX * uint(depth))

    def next_2d(self, active: Any = True) -> Any:
        """Return the next random point in [0, 1)^2 of each path. `active` is accepted for Mitsuba's
        interface, and ignored."""
        del active
        uint, mi = self.mi.UInt32, self.mi
        # The key determines the order and the scrambling; it differs for all pixels and dimensions.
        key = _hashed(uint, self.pixel + _hashed(uint, self.dimension + _hashed(uint, self.seed)))
        self.dimension = self.dimension + 1
        # Scrambling the index visits the points of each pixel and dimension in another order.
        shuffled_index = _owen(uint, self.index, key)
        # The first dimension of Sobol' is the index with its bits in reverse order. The second one,
        # y, multiplies the index by Pascal's triangle modulo 2, with its bits in reverse order too.
        x, y = dr.brev(shuffled_index), shuffled_index
        for mask, shift in _PASCAL:
            y = y ^ ((y & uint(mask)) >> shift)
        scrambled_bits = (
            _owen(uint, x, _hashed(uint, key + 1)),
            _owen(uint, dr.brev(y), _hashed(uint, key + 2)),
        )
        # Rounding could give 1.
        largest = 1 - dr.epsilon(mi.Float)
        return mi.Point2f(
            *(dr.minimum(mi.Float(bits) * 2.0**-32, largest) for bits in scrambled_bits)
        )

    def next_1d(self, active: Any = True) -> Any:
        """Return the next random number in [0, 1) of each path. `active` is ignored."""
        return self.next_2d(active).x


def _hashed(uint: Any, x: Any) -> Any:
    """Return a hash of 32-bit integers x (Wellons 2018). uint: the array type of unsigned
    integers."""
    x = uint(x)
    for multiplier, shift in zip(_HASH, (16, 15), strict=True):
        x = (x ^ (x >> shift)) * uint(multiplier)
    return x ^ (x >> 15)


def _owen(uint: Any, x: Any, seed: Any) -> Any:
    """Apply Owen's scrambling to 32-bit integers x: whether a bit is flipped depends only on the
    bits above it and on the seed.

    uint: the array type of unsigned integers.

    Multiplication carries from low bits to high ones, so it is done with the bits in reverse order.
    """
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
    """The last vertex of each path, at which its next ray begins: the position (3,) and normal (3,)
    of the surface, the shape on which it lies, and whether there is one. A path that comes from the
    camera has no vertex yet."""

    position: Any
    normal: Any
    shape: Any
    is_valid: Mask

    @classmethod
    def none(cls, mi: Any) -> _Vertex:
        """Return the vertex of paths that have none yet, as they come from the camera. It is not
        valid."""
        zeros = dr.zeros(mi.SurfaceInteraction3f)
        return cls(zeros.p, zeros.n, zeros.shape, mi.Bool(False))

    @classmethod
    def of(cls, si: Any) -> _Vertex:
        """Return the vertex at a surface interaction of Mitsuba's."""
        return cls(si.p, si.n, si.shape, si.is_valid())

    def interaction(self, mi: Any) -> Any:
        """Return the vertex as a surface interaction of Mitsuba's, which has only position, normal
        and shape. Its t is infinite if there is no vertex, which makes it invalid."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p, si.n, si.shape = self.position, self.normal, self.shape
        si.t = dr.select(self.is_valid, mi.Float(0), dr.inf)
        return si


@dataclass(frozen=True)
class _PathState:
    """The state of light paths on the ray between two vertices, with one entry for each path.

    number: the index of the path among all paths.
    ray: from the last vertex to the next one.
    throughput: the fraction of the light along the ray that reaches the camera.
    eta: the product of the relative refractive indices so far. It keeps Russian roulette from
        ending paths in glass.
    previous: the last vertex.
    pdf: the probability density with which the last vertex sampled the direction of the ray.
    delta: whether the last vertex could sample no other direction, like a mirror. pdf and delta
        determine the weight of light that the ray hits.
    is_diffused: whether a rough surface has scattered the path at or before the last vertex.
    was_diffused: the same, without the last vertex.
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
    """The light of an emitter that a vertex would scatter along the path to the camera, if nothing
    lies between the vertex and the emitter. One entry for each path.

    ray: from the vertex to a sampled point of the emitter.
    light: the light that reaches the camera this way.
    active: whether there is such light.
    """

    ray: Any
    light: Any
    active: Mask


@dataclass
class DenoisingFeatures:
    """The albedo, in (0, 1], and the unit normal at the first hit of each path, which the denoiser
    needs. Both are 0 for paths that hit nothing."""

    albedo: Any
    normal: Any

    def record(self, mi: Any, si: Any, numbers: Any, active: Mask) -> None:
        """Store the albedo and the normal of some paths.

        si: the first hits of these paths, as surface interactions.
        numbers: the indices of these paths among all paths.
        active: mask of the entries to store.

        The albedo is the diffuse reflectance for light that arrives along the normal. Shapes
        without a smooth BSDF, such as clear glass, count as white.
        """
        bsdf, along_normal = si.bsdf(), mi.SurfaceInteraction3f(si)
        # The same interaction, but seen along the normal, from the same side.
        along_normal.wi = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), si.wi.z))
        albedo = bsdf.eval_diffuse_reflectance(along_normal, active)
        # Mirrors may give more than 1 straight on: they are darkened, and keep their hue.
        albedo = albedo / dr.maximum(1, dr.max(albedo))
        albedo = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), albedo, 1)
        dr.scatter(self.albedo, mi.Spectrum(albedo), numbers, active)
        dr.scatter(self.normal, mi.Vector3f(si.sh_frame.n), numbers, active)


@dataclass
class PathResults:
    """What light paths bring back, with one entry for each path.

    light: the radiance that reaches the camera.
    valid: whether the path hits a surface, or is lost at its first ray.
    lost: whether one of its rays ran out of steps.
    features: albedo and normal at the first hit, if requested; else None.
    """

    light: Any
    valid: Mask
    lost: Mask
    features: DenoisingFeatures | None = None


class PathTracer:
    """Path tracing with multiple importance sampling of lights and BSDFs (Veach 1997). A path ends
    after `max_depth` edges, by Russian roulette, or where it hits nothing.

    max_depth: the length of the longest path in edges, -1 for no limit.
    rr_depth: the vertex, counted from 1, at which Russian roulette begins.
    hide_emitters: whether lights and environment are invisible to the camera.
    clamp: an upper limit of the light that a path brings, if one of its vertices except the one
        next to the light lies on a rough surface. A finite limit removes some light, and with it
        the white specks ("fireflies") of sharp reflections and caustics that paths sample too
        rarely.
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
        """Return the same path tracer with another length of the longest path, in edges; -1 for no
        limit."""
        return PathTracer(self.mi, max_depth, self.rr_depth, self.hide_emitters, self.clamp)

    def trace(
        self, scene: Any, sampler: SobolSampler, ray: Any, active: Mask, features: bool = False
    ) -> PathResults:
        """Trace light paths that begin with the given camera rays, one for each path of the
        sampler. Returns their `PathResults`.

        scene: the Mitsuba scene, with level sets in it.
        active: mask of the paths to trace.
        features: whether albedo and normal at first hits are stored, too.

        All paths advance together, vertex by vertex. Paths that have ended are left out, and each
        part of the work at a vertex is done only for the paths that need it (`backend.loops`).
        """
        mi, world = self.mi, HybridScene.of(self.mi, scene, queued=True)
        width = dr.width(sampler.index)
        # At first no path has brought light, hit anything or been lost.
        results = PathResults(
            dr.zeros(mi.Spectrum, width), dr.zeros(mi.Bool, width), dr.zeros(mi.Bool, width)
        )
        if features:
            results.features = DenoisingFeatures(
                dr.zeros(mi.Spectrum, width), dr.zeros(mi.Vector3f, width)
            )
            dr.make_opaque(results.features.albedo, results.features.normal)
        # Camera rays count as sampled by a mirror: the light that they see has the weight 1.
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
        # Give every entry its full width, so that single paths can be picked.
        paths = broadcast_copy(paths, width, mi.UInt32)
        dr.make_opaque(results.light, results.valid, results.lost)
        goes_on, depth = mi.Bool(active) & dr.full(mi.Bool, True, width), 0
        while True:
            remaining, remaining_count = active_lanes(goes_on)
            if not remaining_count:
                return results
            paths = gather_record(paths, remaining)
            # `remaining` lists a single path twice; the second entry is not active.
            active = dr.arange(mi.UInt32, len(remaining)) < dr.opaque(mi.UInt32, remaining_count)
            # No number is a literal, so that all vertices run the same kernels.
            dr.make_opaque(active, *array_leaves(paths))
            paths, goes_on = self._vertex(world, paths, active, sampler, depth, results)
            depth += 1

    def _vertex(
        self, world: HybridScene, paths: _PathState, exist: Mask, sampler: SobolSampler, depth: int,
        results: PathResults,
    ) -> tuple[_PathState, Mask]:  # fmt: skip
        """Advance paths by one vertex: trace their rays to it, add its light to `results`, and
        sample the next direction. Returns the state of the paths behind the vertex, and the mask of
        paths that go on.

        world: the scene that is traced.
        exist: mask of lanes that hold a path.
        sampler: the random numbers of all paths.
        depth: the number of the vertex, counted from 0.
        results: receives the light and the first hits, at the indices of the paths.

        Light is added in two ways, weighted such that none counts twice: what the surface at the
        vertex emits, and what a sampled point of an emitter sends to the vertex (`_connection`). A
        ray out of steps adds magenta.
        """
        mi, vertex = self.mi, dr.opaque(self.mi.UInt32, depth)
        previous = paths.previous.interaction(mi)
        # Only camera rays pass through lights that are hidden.
        sees_no_emitter = (vertex == 0) if self.hide_emitters else None
        si, hit = world.intersect(paths.ray, previous, exist, sees_no_emitter)
        vertex_sampler = sampler.at_vertex(vertex, paths.number)
        # Glass between the last vertex and this one absorbs light.
        transmitted = transmittance(mi, world.proxies, previous, si, paths.ray.d)
        paths = replace(paths, throughput=paths.throughput * transmitted)
        # The edge to this vertex may be the last one that the path may have.
        counts_emission = exist & ~hit.is_out_of_steps & (vertex < self._deepest)
        if sees_no_emitter is not None:
            counts_emission &= ~sees_no_emitter
        light = self._emitted(world.scene, paths, si, counts_emission)
        lost_light = paths.throughput * mi.Spectrum(self.lost_color.eval(si, hit.is_out_of_steps))
        light += dr.select(hit.is_out_of_steps, lost_light, 0)
        # Light that is scattered here needs one more edge.
        active = si.is_valid() & (vertex + 1 < self._deepest)
        bsdf = si.bsdf()
        connection = self._connection(world, paths, si, hit.ray_offset, vertex_sampler, active)

        sample, weight = bsdf.sample(
            mi.BSDFContext(), si, vertex_sampler.next_1d(), vertex_sampler.next_2d(), active
        )
        # Where only one direction is possible, as in a mirror, lights cannot be sampled.
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        throughput = paths.throughput * weight
        eta = paths.eta * sample.eta
        largest_throughput = dr.max(throughput)
        active &= largest_throughput > 0
        # Russian roulette, without the factor eta^-2 that radiance takes on in glass.
        survival = dr.minimum(largest_throughput * eta * eta, 0.95)
        in_roulette = vertex + 1 >= self._first_roulette
        active &= ~in_roulette | (vertex_sampler.next_1d() < survival)
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
        # Write the results: paths of this vertex are scattered to their indices.
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
        """Return the light that the surface at a vertex emits along the path, weighted against
        sampling this light from the last vertex. For a ray that has hit nothing it is the light of
        the environment.

        paths: the rays that led to the vertex.
        si: the interaction at the vertex.
        active: mask of vertices whose light counts; it is 0 elsewhere.
        """
        mi, previous = self.mi, paths.previous.interaction(self.mi)
        direction = mi.DirectionSample3f(scene, si, previous)
        # A mirror cannot be sampled by choosing a point of a light: the density is 0 and the weight
        # 1.
        emitter_pdf = scene.pdf_emitter_direction(previous, direction, active & ~paths.delta)
        weight = _power_heuristic(paths.pdf, emitter_pdf)
        light = paths.throughput * weight * direction.emitter.eval(si, active)
        return dr.select(active, self._clamped(light, paths.was_diffused), 0)

    def _clamped(self, light: Any, indirect: Mask) -> Any:
        """Return the light; on lanes of the mask `indirect` it is dimmed such that no channel
        exceeds `clamp`."""
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
        vertex_sampler: SobolSampler,
        active: Mask,
    ) -> _LightConnection:
        """Sample a point of an emitter for each vertex. Returns the light from there that the
        vertex scatters along its path, weighted against finding the emitter by the BSDF, and the
        ray to the point. The light counts only if this ray is free, which is not tested here.

        world: the scene that is traced.
        paths: the rays that led to the vertices.
        si: the interaction at the vertex.
        clearance: the least distance from the surface at which a ray may start.
        vertex_sampler: the random numbers of the paths at this vertex.
        active: mask of vertices to connect. Of these, only those with a BSDF that scatters into a
            range of directions are connected.
        """
        mi, bsdf = self.mi, si.bsdf()
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        # False: whether the emitter is visible is not tested here.
        to_light, radiance = world.scene.sample_emitter_direction(
            si, vertex_sampler.next_2d(), False, active
        )
        # The radiance comes divided by the density with which its direction was sampled.
        active &= to_light.pdf > 0
        scattered, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(to_light.d), active)
        active &= dr.max(scattered) > 0
        # A BSDF cannot find a light that is a point: its weight is 1.
        mis_weight = dr.select(to_light.delta, 1, _power_heuristic(to_light.pdf, pdf))
        sent = self._clamped(
            paths.throughput * scattered * radiance * mis_weight, paths.is_diffused
        )
        return _LightConnection(spawn_ray_to(mi, si, clearance, to_light.p), sent, active)


def _power_heuristic(a: Real, b: Real) -> Real:
    """Return the weight a^2/(a^2 + b^2) of a sample with probability density a, if another
    technique finds it with density b: Veach's power heuristic. It is 0 if it is not finite."""
    a, b = a * a, b * b
    weight = a / (a + b)
    return dr.select(dr.isfinite(weight), weight, 0)


def _sobol_from(mi: Any, sampler: Any) -> SobolSampler:
    """Turn one of Mitsuba's samplers into a `SobolSampler`. Its seed is taken from Mitsuba's
    sampler, whose lanes are the samples of one pixel after the other."""
    width, spp = sampler.wavefront_size(), max(int(sampler.sample_count()), 1)
    lane = dr.arange(mi.UInt32, width)
    # 2^24: a number in single precision has 24 bits.
    seed = mi.UInt32(dr.gather(mi.Float, sampler.next_1d(), mi.UInt32(0)) * 2.0**24)
    opaque_spp = dr.opaque(mi.UInt32, spp)
    return SobolSampler(mi, lane // opaque_spp, lane % opaque_spp, seed, dr.opaque(mi.UInt32, 0))


@functools.cache
def integrator_class(variant: str) -> Any:
    """Return the class of the Mitsuba plug-in `harnack_path`. There is one class for each variant
    of Mitsuba, as Mitsuba's base classes differ.

    Raises:
        RuntimeError: `variant` is not the one that is set now.
    """
    mi = load_mitsuba()
    if mi.variant() != variant:
        raise RuntimeError(f"the variant changed from {variant} to {mi.variant()}")

    class HarnackPath(mi.SamplingIntegrator):
        """Lets Mitsuba call the `PathTracer`. The plug-in's properties are the arguments of
        `PathTracer`."""

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
            """Return what Mitsuba's interface asks for: the light of camera rays, whether they hit
            a surface, and no further channels. `medium` is ignored. Lost paths are counted.
            Derivatives by level sets of harnack are refused."""
            del medium
            refuse_attached_surfaces(scene)
            results = self.tracer.trace(scene, _sobol_from(mi, sampler), ray, active)
            self.lost = self.lost + dr.count(results.lost)
            return results.light, results.valid, []

        def take_lost(self) -> int:
            """Return the number of paths that ran out of steps since the last call of this
            method."""
            count = int(self.lost[0])
            self.lost = mi.UInt32(0)
            return count

        def to_string(self) -> str:
            return f"{INTEGRATOR}[max_depth = {self.tracer.max_depth}]"

    return HarnackPath
