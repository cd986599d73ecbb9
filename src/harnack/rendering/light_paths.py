"""Renders pictures by path tracing: for each pixel of a sensor (a Mitsuba camera with its film),
several random light paths are traced backward from the camera, and the light that they carry is
averaged. `mi` is the Mitsuba module. A path that runs out of steps, because a ray was neither
proved free nor led to a hit, is called lost.

The module also estimates the time of a picture before it is begun, removes noise from it, and
traces rays of shaded pictures through transparent solids.

A ray that enters a solid leaves it before it enters anything else. So whether a segment of a ray
lies in glass, which absorbs light, depends only on the hit at which the segment begins.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import Mask, Real, to_numpy
from harnack.cluster.executor import Executor
from harnack.optional_packages import import_optional
from harnack.rendering.hybrid_scene import HybridScene, spawn_ray
from harnack.rendering.integrator import PathResults, PathTracer, SobolSampler
from harnack.rendering.mitsuba import refract, refractive_index, transmittance
from harnack.rendering.shading import (
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
    """A picture that was rendered by path tracing: the light of all pixels.

    image: (h, w, 4) linear sRGB radiance and, last, the fraction of the pixel that is covered.
    lost: the number of paths that ran out of steps.
    albedo, normal: (h, w, 3) means of albedos and normals at the first hits of the paths, for the
        denoiser; None unless requested.
    """

    image: npt.NDArray[np.float32]
    lost: int
    albedo: npt.NDArray[np.float32] | None = None
    normal: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True)
class PathRenderTask:
    """Renders a picture by path tracing, one range of pixels at a time. `mi` is the Mitsuba module,
    `scene` and `sensor` are Mitsuba's, and `tracer` follows the paths.

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
        """Width and height of the picture in pixels."""
        width, height = (int(n) for n in self.sensor.film().crop_size())
        return width, height

    def render_range(self, start: int, stop: int) -> tuple[npt.NDArray[np.float32], int]:
        """Render the pixels from `start` to `stop`, counted by rows. Returns two results: the means
        over the paths of each pixel, an array (n, 4), or (n, 10) with features; and the number of
        paths that ran out of steps. The columns are radiance (3), covered fraction, albedo (3) and
        normal (3).

        All samples of a pixel are traced at once, so that the sampler can stratify them. Every
        pixel averages only its own samples. So there are no sums whose order threads could change:
        the same seed gives the same picture, in whatever parts it is drawn.
        """
        mi, spp = self.mi, self.spp
        bands: list[npt.NDArray[np.float32]] = []
        lost = 0
        for first, last in pixel_ranges(stop - start, max(1, self.paths_a_band // spp)):
            # Successive lanes are the samples of one pixel, then those of the next pixel.
            path = dr.arange(mi.UInt32, (last - first) * spp)
            # Opaque numbers are kernel parameters: another number compiles no other kernel.
            opaque_spp = dr.opaque(mi.UInt32, spp)
            pixel = path // opaque_spp + dr.opaque(mi.UInt32, start + first)
            results, wavelengths = trace_samples(
                mi, self.scene, self.sensor, self.tracer, pixel, path % opaque_spp, self.seed,
                self.features,
            )  # fmt: skip
            covered = dr.select(results.valid, mi.Float(1), 0)
            means = [mi.Vector4f(*as_rgb(mi, results.light, wavelengths), covered)]
            if results.features is not None:
                means += [as_rgb(mi, results.features.albedo, wavelengths), results.features.normal]
            means = [to_numpy(mean_of_blocks(mean, spp)) for mean in means]
            bands.append(np.concatenate(means, axis=1))
            lost += int(dr.count(results.lost)[0])
        return np.concatenate(bands), lost


def render_paths(
    task: PathRenderTask, advance: Callable[[float], None], executor: Executor | None = None
) -> PathRender:
    """Render all pixels of a task. Returns a `PathRender`.

    advance: called with the fraction of the picture that has been finished since the last call.
    executor: runs `render_range` of the task, for example on a cluster; None to call it
        in this process.
    """
    executor = Executor(task) if executor is None else executor
    width, height = task.size
    features = task.features
    # The columns are those of `render_range`: radiance, covered fraction, albedo and normal.
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
    """Trace one light path through a random point of each given pixel. Returns the `PathResults` of
    the paths, with light weighted by the sensor, and the wavelengths that they carry.

    scene, sensor: Mitsuba's scene and camera.
    tracer: follows the paths.
    pixel, sample: (n,) for each path, the index of its pixel, counted by rows, and the index of the
        path among those of its pixel.
    seed: another seed gives other random numbers.
    features: whether to store albedo and normal at first hits, too.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    first_dimension, hashed_seed = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, _mixed(seed))
    sampler = SobolSampler(mi, pixel, sample, hashed_seed, first_dimension)
    position = film_positions(mi, pixel, _in_pixel(mi, sampler.next_2d()), (width, height))
    ray, weight = _camera_ray(mi, sensor, sampler, position)
    dr.eval(ray, weight)
    results = tracer.trace(scene, sampler, ray, mi.Bool(True), features)
    return replace(results, light=results.light * weight), ray.wavelengths


def _mixed(seed: int) -> int:
    """Return a 32-bit hash of the seed, so that pictures with neighboring seeds have independent
    noise."""
    return int(np.random.SeedSequence(seed % 2**63).generate_state(1)[0])


def _in_pixel(mi: Any, sample: Any) -> Any:
    """Turn uniform random numbers into sample points of a pixel. Returns coordinates (2,) in units
    of a pixel, from its corner. They are distributed as a Gaussian around the pixel's middle, cut
    off at two pixels from it, so they may lie outside the pixel. This replaces a reconstruction
    filter.

    sample: (2,) uniform numbers in [0, 1).

    The Gaussian is sampled by inverting its distribution function. `edge` limits the argument to
    the part that is not cut off.
    """
    edge = float(dr.erf(_FILTER_REACH / _FILTER_DEVIATION / np.sqrt(2)))
    offset = dr.erfinv(edge * (2 * sample - 1)) * (np.sqrt(2) * _FILTER_DEVIATION)
    return mi.Vector2f(offset) + 0.5


def _camera_ray(mi: Any, sensor: Any, sampler: Any, position: Any) -> tuple[Any, Any]:
    """Sample a ray of the camera through a point of the film. Returns the ray and the weight of its
    light. Time, wavelength and the point on the lens are sampled if the sensor has them.

    position: (2,) the point, in [0, 1]^2 across the whole film.
    sampler: gives the random numbers.
    """
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else 0
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    return sensor.sample_ray(time, wavelength, position, lens)


def as_rgb(mi: Any, radiance: Any, wavelengths: Any) -> Any:
    """Convert radiance to linear sRGB. Mitsuba's variants represent it as samples of a spectrum, as
    a single luminance, or as RGB already.

    radiance: one number for each wavelength, or for each channel.
    wavelengths: the wavelengths of spectral radiance, in nm; not used otherwise.
    """
    if mi.is_spectral:
        color_matching = [mi.cie1931_xyz(wavelength) for wavelength in wavelengths]
        xyz = sum(value * weights for value, weights in zip(radiance, color_matching, strict=True))
        # The mean over the wavelengths, scaled such that white has Y = 1.
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(color_matching)))
    return mi.Color3f(radiance[0]) if mi.is_monochromatic else mi.Color3f(radiance)


def mean_of_blocks(color: Any, spp: int) -> Any:
    """Average the colors of the samples of each pixel. The samples of a pixel are `spp` successive
    lanes. Returns one color for each pixel."""
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
    """The estimated time in seconds: `path` for one light path, `picture` for all paths of a
    picture."""

    path: float
    picture: float

    @property
    def paths_a_band(self) -> int:
        """How many paths to trace at once such that a progress bar moves about every four
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
        # Seconds behind minutes are rounded down to tens.
        if minutes < 90:
            return f"{minutes} min {rest // 10 * 10} s" if minutes < 10 else f"{minutes} min"
        return f"{hours} h {rest_of_hour} min"


def estimate_time(
    mi: Any, scene: Any, sensor: Any, tracer: PathTracer, *, spp: int, features: bool
) -> TimeEstimate:
    """Estimate how long a picture takes, by timing a few paths all over it. Returns a
    `TimeEstimate`.

    scene, sensor: Mitsuba's scene and camera.
    tracer: follows the paths.
    spp: the number of paths of a pixel.
    features: whether albedo and normal are stored, too.

    A run takes some time to start, whatever the number of its paths. So the time of a path is
    computed from the additional time that four times as many paths take. A picture of few paths is
    not measured, and its estimate is 0.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixel_count = width * height
    path_count = pixel_count * spp

    def seconds(count: int) -> float:
        """Return the time of a run of `count` paths."""
        # The golden ratio spreads any number of pixels evenly.
        indices = (np.arange(count) * 0.6180339887498949 % 1 * pixel_count).astype(np.int64)
        pixel = upload_indices(mi, np.minimum(indices, pixel_count - 1))
        sample = dr.opaque(mi.UInt32, 0, count)
        began = time.perf_counter()
        # One path in each of these pixels, with 0 as the seed.
        results, _ = trace_samples(mi, scene, sensor, tracer, pixel, sample, 0, features)
        dr.eval(results.light)
        dr.sync_thread()
        return time.perf_counter() - began

    count, seconds_a_path = _FIRST_TRIAL_PATHS, 0.0
    if _TRIAL_GROWTH * count <= _MAX_TRIAL_FRACTION * path_count:
        seconds(count)  # not measured: this run compiles the kernels
        first_time = time_of_run = seconds(count)
        # Runs grow until one is long enough to be measured, or they take too much of the whole
        # time.
        while (
            _TRIAL_GROWTH * count <= _MAX_TRIAL_FRACTION * path_count
            and time_of_run < _MIN_TIME_RATIO * first_time
        ):
            time_of_longer_run = seconds(_TRIAL_GROWTH * count)
            seconds_a_path = max(time_of_longer_run - time_of_run, 0.0) / (
                (_TRIAL_GROWTH - 1) * count
            )
            count, time_of_run = _TRIAL_GROWTH * count, time_of_longer_run
    return TimeEstimate(seconds_a_path, path_count * seconds_a_path)


def load_denoiser() -> Any:
    """Import the package `pyoidn`, which holds Open Image Denoise, and return the module.

    Raises:
        ModuleNotFoundError: it is not installed, or its library cannot be loaded.
    """
    try:
        return import_optional(
            "pyoidn", "denoise needs Open Image Denoise: pip install 'harnack[denoise]'"
        )
    except OSError as wrong:
        raise ModuleNotFoundError(f"Open Image Denoise cannot be loaded: {wrong}") from None


def denoise_image(render: PathRender) -> npt.NDArray[np.float32]:
    """Remove the noise of a rendered picture. Returns the image (h, w, 4).

    Open Image Denoise, a neural network that runs on CPUs, removes the noise. It guesses: the
    result looks clean and is close to a picture with more samples, but its numbers are not averages
    of samples, and may be biased. It needs the features of the render (albedo and normal). The
    covered fraction of each pixel is not changed.

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
    """Rays on their way through transparent solids, with one entry for each ray. When all rays have
    ended, the object holds their first opaque hits.

    A ray is bent at each boundary of a transparent solid, so its path consists of several segments.
    A segment is traced by `intersect`, which returns an interaction of Mitsuba's and a
    `SurfaceHit`.

    ray: the current segment; at the end, the last one.
    si, first: the hit of this segment, as an interaction and as a `SurfaceHit`.
    throughput: the fraction of the light from there that reaches the eye.
    reflected_light: the light that the crossed boundaries reflect to the eye.
    path_length: the length of the path before the current segment.
    interface_count: the number of hits so far: the boundaries crossed, and the last hit.
    active: mask of rays that are still being traced.
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
    """Traces rays through transparent solids for shaded pictures, with refraction, until they hit
    something opaque.

    Only one ray is followed behind a boundary: the transmitted ray, or the reflected one for total
    reflection. The light that a boundary reflects is approximated by the sky and a highlight of the
    key light. So there is no noise, and there are no caustics.

    indices: pairs of a proxy, the Mitsuba mesh that stands for a transparent solid, and its index
        of refraction.
    hides_lights: whether shapes that emit light are invisible.
    """

    def __init__(
        self, world: HybridScene, light: StudioLight, *, hides_lights: bool = False
    ) -> None:
        self.world, self.light = world, light
        # The mask of rays that do not see lights: all of them, or none.
        self.hidden = world.mi.Bool(True) if hides_lights else None
        mi = world.mi
        pairs = ((proxy, refractive_index(mi, proxy)) for proxy in world.proxies)
        self.indices = tuple((proxy, index) for proxy, index in pairs if index is not None)

    def trace(self, ray: Any) -> RefractedHits:
        """Find the first opaque hits of camera rays, behind transparent solids. Returns
        `RefractedHits`."""
        mi, world = self.world.mi, self.world
        nothing = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
        # At first there is no hit, all light would reach the eye, and none is reflected.
        hits = RefractedHits(
            ray, nothing, world.no_hit(nothing), mi.Spectrum(1), mi.Spectrum(0), mi.Float(0),
            mi.UInt32(0), dr.full(mi.Bool, True, dr.width(ray.d)),
        )  # fmt: skip
        # Without transparent solids a single trace suffices.
        if not self.indices:
            camera = dr.zeros(mi.SurfaceInteraction3f)
            hits.si, hits.first = world.intersect(ray, camera, mi.Bool(True), self.hidden)
            return hits

        def is_running(hits: RefractedHits) -> Mask:
            return hits.active

        def cross(hits: RefractedHits) -> tuple[RefractedHits]:
            return (self._through_boundary(hits),)

        (hits,) = dr.while_loop((hits,), is_running, cross, label="clear")
        return hits

    def _is_clear(self, si: Any) -> Mask:
        """Return the mask of interactions `si` that lie on the boundary of a transparent solid."""
        is_clear = self.world.mi.Bool(False)
        for proxy, _ in self.indices:
            is_clear |= si.shape == self.world.mi.ShapePtr(proxy)
        return is_clear

    def _through_boundary(self, hits: RefractedHits) -> RefractedHits:
        """Trace the current segment of each ray and return the new `RefractedHits`. A ray that hits
        a transparent solid is refracted there and goes on; any other ray ends. A ray also ends
        where it hits an isoline, and at the 33rd boundary."""
        mi, world, d = self.world.mi, self.world, hits.ray.d
        # The segment starts at the hit of the last one.
        si, first = world.intersect(hits.ray, hits.si, hits.active, self.hidden)
        throughput = hits.throughput * transmittance(mi, world.proxies, hits.si, si, d)
        interface_count = hits.interface_count + 1
        is_crossed = (
            self._is_clear(si)
            & (first.isoline_index == 0)
            & first.is_hit
            & (interface_count <= _MAX_INTERFACES)
        )
        # The refractive index; 1, which is not used, for what is no transparent solid.
        index = mi.Float(1)
        for proxy, value in self.indices:
            index = dr.select(si.shape == mi.ShapePtr(proxy), value, index)
        normal = mi.Vector3f(si.n)
        direction, reflected_fraction = refract(normal, d, index)
        # Reflections on the way out of a solid are left out.
        enters_solid = is_crossed & (dr.dot(normal, d) < 0)
        reflected_light = dr.select(
            enters_solid, throughput * self._reflected(si, d, index, reflected_fraction), 0
        )
        # A fraction of 1 is total reflection: then the reflected ray is followed, and nothing is
        # lost.
        transmitted_fraction = dr.select(
            is_crossed & (reflected_fraction < 1), 1 - reflected_fraction, 1
        )
        onward_ray = spawn_ray(mi, si, first.ray_offset, direction)
        return RefractedHits(
            ray=dr.select(is_crossed, onward_ray, hits.ray),
            si=si,
            first=first,
            throughput=throughput * transmitted_fraction,
            reflected_light=hits.reflected_light + reflected_light,
            path_length=hits.path_length + dr.select(is_crossed, first.t, 0),
            interface_count=interface_count,
            active=hits.active & is_crossed,
        )

    def _reflected(self, si: Any, d: Any, index: Any, fraction: Real) -> Any:
        """Approximate the light that a boundary of a transparent solid reflects toward the eye:
        light of the sky from the mirrored direction, and a highlight of the key light. Returns a
        spectrum.

        si, d: the interaction at the boundary, and the unit direction of the ray that arrives
            there.
        index: the refractive index of the inside relative to the outside.
        fraction: the fraction of the sky's light that the boundary reflects.
        """
        mi = self.world.mi
        normal = mi.Vector3f(si.n)
        mirrored = d - 2 * dr.dot(normal, d) * normal
        reflectance_straight_on = dr.square((index - 1) / (index + 1))
        black, one = dr.zeros(mi.Color3f), mi.Float(1)
        # Of a glossy black surface that nothing hides, only the highlight remains. It is scaled
        # from the usual reflectance.
        gloss = self.light.shade(black, normal, -d, mi.Bool(True), one) * (
            reflectance_straight_on / _DEFAULT_REFLECTANCE
        )
        # Variants with one channel hold luminance.
        light = mi.Spectrum(gloss) if not mi.is_monochromatic else mi.Spectrum(mi.luminance(gloss))
        sky = self.world.scene.environment()
        if sky is not None:
            interaction = dr.zeros(mi.SurfaceInteraction3f)
            interaction.wi, interaction.wavelengths = -mirrored, si.wavelengths
            light += fraction * sky.eval(interaction)
        return light
