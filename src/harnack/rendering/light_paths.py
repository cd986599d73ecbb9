"""Renders pictures by light paths, and traces rays of shaded pictures through transparent solids.

The time that a picture will take is estimated before it is begun, and noise can be removed from it.

A ray that enters a solid leaves it before it enters anything else. So whether a segment of a ray
lies in glass, which absorbs light, depends only on the hit at which the segment begins.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import Mask, Real, to_numpy
from harnack.rendering.hybrid_scene import HybridScene, spawn_ray
from harnack.rendering.integrator import PathResults, PathTracer, SobolSampler
from harnack.rendering.mitsuba import refract, refractive_index, transmittance
from harnack.rendering.shading import (
    LocalRenderExecutor,
    RenderExecutor,
    StudioLight,
    film_positions,
    pixel_ranges,
    upload_indices,
)

# Paths of one band at most: about two seconds on a CPU. Ctrl-C works between bands.
MAX_PATHS_PER_BATCH = 2**21
# The pixel's filter: samples are drawn from a Gaussian of this standard deviation, in pixels,
# cut at two pixels from its middle (Ernst et al. 2006, filter importance sampling).
_FILTER_DEVIATION = 0.45
_FILTER_REACH = 2.0


@dataclass(frozen=True)
class PathRender:
    """The light of all pixels of a sensor.

    image: (h, w, 4) linear sRGB radiance and, last, the fraction of the pixel that is covered.
    lost: the number of paths that ran out of steps.
    albedo, normal: (h, w, 3) means of albedos and normals at first hits; None unless requested.
    """

    image: npt.NDArray[np.float32]
    lost: int
    albedo: npt.NDArray[np.float32] | None = None
    normal: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True)
class PathRenderTask:
    """The rendering of a picture by light paths for a sensor, by ranges of pixels.

    spp: the number of paths of a pixel.
    seed: another seed gives other noise.
    features: whether to compute albedos and normals at first hits too, for denoising.
    paths_a_band: the largest number of paths traced at once.
    """

    mi: Any
    scene: Any
    sensor: Any
    tracer: PathTracer
    spp: int
    seed: int
    features: bool = False
    paths_a_band: int = MAX_PATHS_PER_BATCH

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = (int(n) for n in self.sensor.film().crop_size())
        return width, height

    def render_range(self, start: int, stop: int) -> tuple[npt.NDArray[np.float32], int]:
        """The means of the paths of each pixel from `start` to `stop`, counted by rows, as an array
        (n, 4), or (n, 10) with features; and the number of paths that ran out of steps. The columns
        are radiance, covered fraction, albedo and normal.

        All samples of a pixel are traced at once, so that samplers can stratify them. Every pixel
        averages only its own samples. So there are no sums whose order threads could change: the
        same seed gives the same picture, in whatever parts it is drawn.
        """
        mi, spp = self.mi, self.spp
        rows: list[npt.NDArray[np.float32]] = []
        lost = 0
        for first, last in pixel_ranges(stop - start, max(1, self.paths_a_band // spp)):
            lane = dr.arange(mi.UInt32, (last - first) * spp)
            samples = dr.opaque(mi.UInt32, spp)
            pixel = lane // samples + dr.opaque(mi.UInt32, start + first)
            results, wavelengths = trace_samples(
                mi, self.scene, self.sensor, self.tracer, pixel, lane % samples, self.seed,
                self.features,
            )  # fmt: skip
            covered = dr.select(results.valid, mi.Float(1), 0)
            means = [mi.Vector4f(*as_rgb(mi, results.light, wavelengths), covered)]
            if results.features is not None:
                means += [as_rgb(mi, results.features.albedo, wavelengths), results.features.normal]
            means = [to_numpy(mean_of_blocks(mean, spp)) for mean in means]
            rows.append(np.concatenate(means, axis=1))
            lost += int(dr.count(results.lost)[0])
        return np.concatenate(rows), lost


def render_paths(
    task: PathRenderTask, advance: Callable[[float], None], executor: RenderExecutor | None = None
) -> PathRender:
    """The light of all pixels, as a `PathRender`.

    advance: called with the fraction of the picture that has been finished since the last call.
    executor: calls `render_range` of a copy of the task, for example on a cluster; None to call it
        in this process.
    """
    executor = LocalRenderExecutor(task) if executor is None else executor
    width, height = task.size
    features = task.features
    image = np.empty((width * height, 10 if features else 4), dtype=np.float32)
    lost = 0
    ranges = executor.split_range(width * height, max(1, task.paths_a_band // task.spp))
    for (start, stop), (means, lost_paths) in zip(
        ranges, executor.run_tasks("render_range", ranges), strict=True
    ):
        image[start:stop] = means
        lost += int(lost_paths)
        advance((stop - start) / (width * height))
    image = image.reshape(height, width, -1)
    if not features:
        return PathRender(image, lost)
    return PathRender(image[..., :4], lost, image[..., 4:7], image[..., 7:])


def trace_samples(
    mi: Any, scene: Any, sensor: Any, tracer: PathTracer, pixel: Any, sample: Any, seed: int,
    features: bool,
) -> tuple[PathResults, Any]:  # fmt: skip
    """Trace light paths through samples of pixels. Returns their `PathResults`, with light weighted
    by the sensor, and their wavelengths.

    pixel, sample: (n,) for each path, the index of its pixel, counted by rows, and of its sample in
        the pixel.
    features: whether to store albedo and normal at first hits, too.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    zero, hashed = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, _mixed(seed))
    sampler = SobolSampler(mi, pixel, sample, hashed, zero)
    position = film_positions(mi, pixel, _in_pixel(mi, sampler.next_2d()), (width, height))
    ray, weight = _camera_ray(mi, sensor, sampler, position)
    dr.eval(ray, weight)
    results = tracer.trace(scene, sampler, ray, mi.Bool(True), features)
    return replace(results, light=results.light * weight), ray.wavelengths


def _mixed(seed: int) -> int:
    """A hash of 32 bits of an integer, so that pictures with neighboring seeds have independent
    noise."""
    return int(np.random.SeedSequence(seed % 2**63).generate_state(1)[0])


def _in_pixel(mi: Any, sample: Any) -> Any:
    """Offsets (2,) of a point in a pixel or near it, distributed as the pixel's filter, from
    uniform numbers in [0, 1)^2."""
    edge = float(dr.erf(_FILTER_REACH / _FILTER_DEVIATION / np.sqrt(2)))
    gauss = dr.erfinv(edge * (2 * sample - 1)) * (np.sqrt(2) * _FILTER_DEVIATION)
    return mi.Vector2f(gauss) + 0.5


def _camera_ray(mi: Any, sensor: Any, sampler: Any, position: Any) -> tuple[Any, Any]:
    """The ray of a sensor through a point of the film in [0, 1]^2, and the weight of its light.
    Time, wavelength and lens are sampled if the sensor has them."""
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else 0
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    return sensor.sample_ray(time, wavelength, position, lens)


def as_rgb(mi: Any, radiance: Any, wavelengths: Any) -> Any:
    """The radiance of a Mitsuba variant, which may be spectral or monochromatic, in linear sRGB."""
    if mi.is_spectral:
        matching = [mi.cie1931_xyz(wavelength) for wavelength in wavelengths]
        xyz = sum(value * weights for value, weights in zip(radiance, matching, strict=True))
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(matching)))
    return mi.Color3f(radiance[0]) if mi.is_monochromatic else mi.Color3f(radiance)


def mean_of_blocks(color: Any, spp: int) -> Any:
    """The means of colors over blocks of `spp` successive lanes, which are the samples of one
    pixel."""
    return type(color)(*(dr.block_sum(channel, spp) / spp for channel in color))


# Estimates of the time for a picture, before it is drawn.

# Paths of trial runs: the number of the first run, the growth from run to run, and the largest
# fraction of all paths.
_FIRST_TRIAL_PATHS, _TRIAL_GROWTH, _MAX_TRIAL_FRACTION = 2**12, 4, 1 / 16
# Runs that take this many times as long as the first run are long enough to be measured.
_MIN_TIME_RATIO = 3.0
# In seconds: the time of a picture is reported only if it is longer.
MIN_REPORTED_SECONDS = 15.0
# Seconds between two moves of the progress bar, and the smallest number of paths of a band.
_SECONDS_PER_BAND, _MIN_BAND_PATHS = 4.0, 2**14


@dataclass(frozen=True)
class TimeEstimate:
    """Seconds for one light path, and for all paths of a picture."""

    path: float
    picture: float

    @property
    def paths_a_band(self) -> int:
        """The number of paths to trace at once such that a progress bar moves about every four
        seconds."""
        return round(
            min(max(_SECONDS_PER_BAND / max(self.path, 1e-9), _MIN_BAND_PATHS), MAX_PATHS_PER_BATCH)
        )

    def __str__(self) -> str:
        seconds = round(self.picture)
        minutes, rest = divmod(seconds, 60)
        hours, rest_of_hour = divmod(minutes, 60)
        if seconds < 90:
            return f"{seconds} s"
        if minutes < 90:
            return f"{minutes} min {rest // 10 * 10} s" if minutes < 10 else f"{minutes} min"
        return f"{hours} h {rest_of_hour} min"


def estimate_time(
    mi: Any, scene: Any, sensor: Any, tracer: PathTracer, *, spp: int, features: bool
) -> TimeEstimate:
    """The time for a picture, measured on a few paths all over it.

    spp: the number of paths of a pixel. features: whether albedo and normal are stored, too.

    A run takes some time to start, whatever the number of its paths. So the time of a path is
    computed from the additional time that four times as many paths take. A picture of few paths is
    not measured, and its estimate is 0.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels = width * height
    path_count = pixels * spp

    def seconds(count: int) -> float:
        """The time of a run of `count` paths."""
        # The golden ratio spreads any number of pixels evenly.
        indices = (np.arange(count) * 0.6180339887498949 % 1 * pixels).astype(np.int64)
        pixel = upload_indices(mi, np.minimum(indices, pixels - 1))
        sample = dr.opaque(mi.UInt32, 0, count)
        began = time.perf_counter()
        results, _ = trace_samples(mi, scene, sensor, tracer, pixel, sample, 0, features)
        dr.eval(results.light)
        dr.sync_thread()
        return time.perf_counter() - began

    count, path = _FIRST_TRIAL_PATHS, 0.0
    if _TRIAL_GROWTH * count <= _MAX_TRIAL_FRACTION * path_count:
        seconds(count)  # compiles
        first = shorter = seconds(count)
        while (
            _TRIAL_GROWTH * count <= _MAX_TRIAL_FRACTION * path_count
            and shorter < _MIN_TIME_RATIO * first
        ):
            longer = seconds(_TRIAL_GROWTH * count)
            path = max(longer - shorter, 0.0) / ((_TRIAL_GROWTH - 1) * count)
            count, shorter = _TRIAL_GROWTH * count, longer
    return TimeEstimate(path, path_count * path)


def load_denoiser() -> Any:
    """The package `pyoidn`, which holds Open Image Denoise.

    Raises:
        ModuleNotFoundError: it is not installed, or its library cannot be loaded.
    """
    try:
        return importlib.import_module("pyoidn")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "denoise needs Open Image Denoise: pip install 'harnack[denoise]'"
        ) from None
    except OSError as wrong:
        raise ModuleNotFoundError(f"Open Image Denoise cannot be loaded: {wrong}") from None


def denoise_image(render: PathRender) -> npt.NDArray[np.float32]:
    """The image (h, w, 4) of a render with features (albedo and normal), without noise.

    Open Image Denoise, a neural network that runs on CPUs, removes the noise. It guesses: the
    result looks clean and is close to a picture with more samples, but its numbers are no means of
    samples. The covered fraction of each pixel is not changed.

    Raises:
        ValueError: the render has no features.
    """
    if render.albedo is None or render.normal is None:
        raise ValueError("an exposure without features cannot be denoised")
    light = np.maximum(render.image[..., :3], 0)
    features = (np.clip(render.albedo, 0, 1), np.clip(render.normal, -1, 1))
    arrays = [np.ascontiguousarray(array, dtype=np.float32) for array in (light, *features)]
    clean = load_denoiser().denoise(arrays[0], albedo=arrays[1], normal=arrays[2], hdr=True)
    return np.concatenate([clean, render.image[..., 3:]], axis=-1)


# Rays through transparent solids.

# The largest number of interfaces that a ray crosses; the next one is opaque.
_MAX_INTERFACES = 32
# The highlight of matter with this reflectance straight on is that of other glossy materials.
_DEFAULT_REFLECTANCE = 0.04


@dataclass
class RefractedHits:
    """The first opaque hits of rays through transparent solids, with one entry for each ray.

    ray: the last segment of the ray's path.
    si, first: the hit of this segment, as an interaction and as a `SurfaceHit`.
    throughput: the fraction of the light from there that reaches the eye.
    reflected_light: the light that the crossed boundaries of transparent solids reflect to the eye.
    path_length: the length of the path before the last segment.
    interface_count: the number of boundaries that the path has crossed, and the last hit.
    active: rays that are still being traced.
    """

    ray: Any
    si: Any
    first: Any
    throughput: Any
    reflected_light: Any
    path_length: Real
    interface_count: Any
    active: Mask


class RefractionTracer:
    """Traces rays through transparent solids for shaded pictures, with refraction.

    Only one ray is followed behind a boundary: the transmitted ray, or the reflected one for total
        reflection. Reflection of other light is approximated: sky light and a highlight. So there
        is no noise, and there are no caustics.

    indices: pairs of a proxy, the mesh that stands for a transparent solid, and its index of
        refraction.
    hides_lights: whether shapes that emit light are not seen.
    """

    def __init__(
        self, world: HybridScene, light: StudioLight, *, hides_lights: bool = False
    ) -> None:
        self.world, self.light = world, light
        self.hidden = world.mi.Bool(True) if hides_lights else None
        mi = world.mi
        pairs = ((carrier, refractive_index(mi, carrier)) for carrier in world.proxies)
        self.indices = tuple((carrier, index) for carrier, index in pairs if index is not None)

    def trace(self, ray: Any) -> RefractedHits:
        """The first opaque hits of camera rays, behind transparent solids, as `RefractedHits`."""
        mi, world = self.world.mi, self.world
        nothing = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
        hits = RefractedHits(
            ray, nothing, world.no_hit(nothing), mi.Spectrum(1), mi.Spectrum(0), mi.Float(0),
            mi.UInt32(0), dr.full(mi.Bool, True, dr.width(ray.d)),
        )  # fmt: skip
        if not self.indices:
            start = dr.zeros(mi.SurfaceInteraction3f)
            hits.si, hits.first = world.intersect(ray, start, mi.Bool(True), self.hidden)
            return hits

        def is_running(hits: RefractedHits) -> Mask:
            return hits.active

        def cross(hits: RefractedHits) -> tuple[RefractedHits]:
            return (self._through_boundary(hits),)

        (hits,) = dr.while_loop((hits,), is_running, cross, label="clear")
        return hits

    def _is_clear(self, si: Any) -> Mask:
        """Mask of interactions with the boundary of a transparent solid."""
        clear = self.world.mi.Bool(False)
        for proxy, _ in self.indices:
            clear |= si.shape == self.world.mi.ShapePtr(proxy)
        return clear

    def _through_boundary(self, hits: RefractedHits) -> RefractedHits:
        """The state of rays at their next hit. A ray that hits a transparent solid is refracted
        there and goes on; another ray ends."""
        mi, world, d = self.world.mi, self.world, hits.ray.d
        si, first = world.intersect(hits.ray, hits.si, hits.active, self.hidden)
        throughput = hits.throughput * transmittance(mi, world.proxies, hits.si, si, d)
        boundaries = hits.interface_count + 1
        clear = (
            self._is_clear(si)
            & (first.isoline_index == 0)
            & first.is_hit
            & (boundaries <= _MAX_INTERFACES)
        )
        index = mi.Float(1)
        for proxy, value in self.indices:
            index = dr.select(si.shape == mi.ShapePtr(proxy), value, index)
        normal = mi.Vector3f(si.n)
        direction, reflected = refract(normal, d, index)
        outside = clear & (dr.dot(normal, d) < 0)
        gathered = dr.select(outside, throughput * self._reflected(si, d, index, reflected), 0)
        transmitted = dr.select(clear & (reflected < 1), 1 - reflected, 1)
        onward_ray = spawn_ray(mi, si, first.ray_offset, direction)
        return RefractedHits(
            ray=dr.select(clear, onward_ray, hits.ray),
            si=si,
            first=first,
            throughput=throughput * transmitted,
            reflected_light=hits.reflected_light + gathered,
            path_length=hits.path_length + dr.select(clear, first.t, 0),
            interface_count=boundaries,
            active=hits.active & clear,
        )

    def _reflected(self, si: Any, d: Any, index: Any, fraction: Real) -> Any:
        """The light of the sky, and of the key light in a highlight, that a boundary of a
        transparent solid reflects towards the eye.

        si, d: the interaction at the boundary, and the unit direction of the ray.
        index: of refraction, of the inside relative to the outside.
        fraction: the reflected fraction of the sky's light.
        """
        mi = self.world.mi
        normal = mi.Vector3f(si.n)
        mirrored = d - 2 * dr.dot(normal, d) * normal
        straight = dr.square((index - 1) / (index + 1))
        black, one = dr.zeros(mi.Color3f), mi.Float(1)
        gloss = self.light.shade(black, normal, -d, mi.Bool(True), one) * (
            straight / _DEFAULT_REFLECTANCE
        )
        light = mi.Spectrum(gloss) if not mi.is_monochromatic else mi.Spectrum(mi.luminance(gloss))
        sky = self.world.scene.environment()
        if sky is not None:
            interaction = dr.zeros(mi.SurfaceInteraction3f)
            interaction.wi, interaction.wavelengths = -mirrored, si.wavelengths
            light += fraction * sky.eval(interaction)
        return light
