"""Renders pictures of numbers, which renderers call arbitrary output variables (AOVs): normals,
numbers of evaluations, status of rays, depth, and values of another function on the surface. `mi`
is the Mitsuba module, and a ray that ran out of steps, neither proved free nor led to a hit, is
called lost. `view` is an `AovBuffers`: what the rays of a picture found. A color scale says which
color each number has.

The numbers of a pixel are those of the single ray through its middle; nothing is averaged. The
pixels of pictures show these numbers, too, except for pictures of values: at edges, the colors of
several rays are averaged.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray, to_numpy, upload_floats
from harnack.cluster.executor import Executor
from harnack.fields import Field
from harnack.rendering.hybrid_scene import HybridScene
from harnack.rendering.images import linear_to_srgb, srgb_to_linear, to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.isolines import padded_domain
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.placed_surface import Placement
from harnack.rendering.scales import Color, ColorScale, add_color_bar, gray_colormap, viridis
from harnack.rendering.shading import (
    edge_pixels,
    film_positions,
    multijitter_offsets,
    tiled_pixel_order,
    upload_indices,
)
from harnack.tracer import RayStatus

# Ctrl-C works between bands.
_RAYS_A_BAND = 2**20
_BACKGROUND = (0.10, 0.10, 0.11)
AOV_BACKGROUNDS = {"dark": _BACKGROUND, "light": (0.90, 0.90, 0.89)}
"""One color for each of the studio's backdrops, to be behind views."""
_UNKNOWN = (0.45, 0.45, 0.45)
_IDENTITY = Placement.identity()
STATUS_COLORS = {
    RayStatus.HIT: (0.93, 0.93, 0.90),
    RayStatus.OUT_OF_STEPS: OUT_OF_STEPS_COLOR,
}


@dataclass(frozen=True)
class AovBuffers:
    """The numbers that rays found at their first hits, with one ray for each pixel, through its
    middle. Arrays have the shape (h, w) unless another shape is stated; for parts of a picture they
    have the shape (n,) or (n, m) instead.

    depth: the distance from the camera in the coordinates of the surfaces; inf without a hit; for a
        ray that ran out of steps, the distance up to which no surface lies.
    normal: (h, w, 3) unit normals, 0 without a hit. The normal of a level set points to larger
        values.
    evaluations: the number of evaluations of fields along the ray, summed over all fields of the
        scene.
    status: a `RayStatus`; hits of Mitsuba's own shapes count as hits.
    isoline_color: (h, w, 3) sRGB color of the isoline that is hit; NaN if no isoline is hit.
    is_near_isoline: whether the edge of an isoline may pass through the pixel.
    value: at hits, the value of the function that colors the surface; NaN without a hit; None if
        there is no such function.
    period: the period of this function if its values are angles, else None.
    background: the sRGB color, in [0, 1], of pixels without a hit.
    """

    depth: FloatArray
    normal: FloatArray
    evaluations: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]
    isoline_color: FloatArray
    is_near_isoline: npt.NDArray[np.bool_]
    value: FloatArray | None = None
    period: float | None = None
    background: Color = _BACKGROUND


@dataclass(frozen=True)
class AovTask:
    """Renders a picture of numbers for a sensor in a scene, one range of pixels at a time. The
    results are `AovBuffers`.

    world: the Mitsuba scene with the level sets in it.
    sensor: Mitsuba's camera, with the film that has the size of the picture.
    placement: the map from the coordinates of the surfaces to the world. Depths are in the
        coordinates of the surfaces.
    function: the function that is evaluated at hits, in the coordinates of the surfaces; None for
        none.
    background: the sRGB color, in [0, 1], of pixels without a hit.
    """

    mi: Any
    world: HybridScene
    sensor: Any
    placement: Placement
    function: Field | None
    background: Color = _BACKGROUND

    @classmethod
    def of(
        cls,
        mi: Any,
        scene: Any,
        sensor: Any,
        placement: Placement = _IDENTITY,
        function: Field | None = None,
        background: Color = _BACKGROUND,
    ) -> AovTask:
        """Return the task for a loaded Mitsuba scene. The parameters are the attributes of the
        class."""
        return cls(mi, HybridScene.of(mi, scene), sensor, placement, function, background)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture in pixels."""
        width, height = (int(n) for n in self.sensor.film().crop_size())
        return width, height

    @functools.cached_property
    def order(self) -> IntArray:
        """The indices (n,) of all pixels, counted by rows, in the order in which they are traced:
        squares of 4 x 4 pixels, one after the other."""
        return tiled_pixel_order(self.size)

    def render_range(self, start: int, stop: int) -> AovBuffers:
        """Trace the pixels from `start` to `stop` in the list `order`. Returns their `AovBuffers`,
        with arrays (n,)."""
        return self._trace_pixels(
            upload_indices(self.mi, self.order[start:stop]), self.mi.Vector2f(0.5)
        )

    def look(
        self, executor: Executor | None = None, advance: Callable[[float], None] | None = None
    ) -> AovBuffers:
        """Trace all pixels. Returns their `AovBuffers`, with arrays (h, w).

        executor: runs `render_range` of this task, for example on a cluster; None to
            call it in this process.
        advance: called with the fraction of the pixels that has been finished since the last call.
        """
        executor = Executor(self) if executor is None else executor
        width, height = self.size
        order = self.order  # the numbers of the pixels, in the order in which they are traced
        ranges, buffers = executor.split_range(width * height, _RAYS_A_BAND), list[AovBuffers]()
        for (start, stop), buffer in zip(
            ranges, executor.run_tasks("render_range", ranges), strict=True
        ):
            buffers.append(buffer)
            if advance is not None:
                advance((stop - start) / (width * height))

        def by_rows(*parts: Any) -> Any:
            """Put the arrays (n, ...) of all ranges of pixels together, from the order of tracing
            into the rows of the image. Returns an array (h, w, ...)."""
            image = np.empty((height, width, *parts[0].shape[1:]), parts[0].dtype)
            image.reshape(height * width, *parts[0].shape[1:])[order] = np.concatenate(parts)
            return image

        return _map_arrays(by_rows, *buffers)

    def render_samples(self, pixels: IntArray, offsets: FloatArray) -> AovBuffers:
        """Trace rays through m points in each of n pixels. Returns their `AovBuffers`, with arrays
        (n, m).

        pixels: (n,) indices of the pixels, counted by rows.
        offsets: (m, 2) coordinates in [0, 1) of the points in each pixel.
        """
        mi, count = self.mi, len(offsets)
        # All m points of the first pixel, then those of the next.
        pixel = upload_indices(mi, np.repeat(pixels, count))
        coordinates = np.tile(offsets, (len(pixels), 1)).T
        positions = mi.Vector2f(
            *(upload_floats(mitsuba_backend(mi), array) for array in coordinates)
        )

        def by_pixels(array: Any) -> Any:
            return array.reshape(len(pixels), count, *array.shape[1:])

        return _map_arrays(by_pixels, self._trace_pixels(pixel, positions))

    def _trace_pixels(self, pixel: Any, offset: Any) -> AovBuffers:
        """Trace a ray through one point in each of n pixels. Returns their `AovBuffers`, with
        arrays (n,).

        pixel: (n,) indices of the pixels, counted by rows.
        offset: (2,) the coordinates in [0, 1) of the point in its pixel.
        """
        mi, count = self.mi, dr.width(pixel)
        position = film_positions(mi, pixel, offset, self.size)
        # One fixed wavelength and the middle of the lens: no random numbers are needed.
        ray, _ = self.sensor.sample_ray_differential(
            self.sensor.shutter_open(), 0.5, position, mi.Point2f(0.5)
        )
        # An interaction that is not valid: the rays start at the camera, not on a surface.
        camera = dr.zeros(mi.SurfaceInteraction3f)
        si, first = self.world.intersect(mi.Ray3f(ray), camera, mi.Bool(True))
        # Isolines are looked for only in pictures of values: other pictures do not show them.
        is_near_isoline, color = mi.Bool(False), mi.Vector3f(dr.nan)
        if self.function is not None:
            is_near_isoline = first.is_hit & self.world.has_line_near(si, ray, ray.d, first.t)
            color = self._line_color(si, first)
        dr.eval(first, is_near_isoline, color)

        def rows_of(values: Any) -> Any:
            """Return a Dr.Jit array as a NumPy array with one row for each ray. A single entry
            stands for all rays."""
            flat = to_numpy(values)
            return np.broadcast_to(flat, (count, *flat.shape[1:]))

        is_hit, is_lost = rows_of(first.is_hit), rows_of(first.is_out_of_steps)
        status = np.where(is_hit, int(RayStatus.HIT), int(RayStatus.MISS))
        buffers = AovBuffers(
            depth=rows_of(first.t) / self.placement.scale,
            normal=np.where(is_hit[:, None], rows_of(first.normal), 0),
            evaluations=rows_of(first.evaluations).astype(np.int64),
            status=np.where(is_lost, int(RayStatus.OUT_OF_STEPS), status),
            isoline_color=rows_of(color),
            is_near_isoline=rows_of(is_near_isoline),
            background=self.background,
        )
        if self.function is None:
            return buffers
        value = np.full(count, np.nan, dtype=np.float32)
        if is_hit.any():
            # The function takes coordinates of the surfaces, and hits are in the world.
            value[is_hit] = _values(
                self.function, self.placement.apply_inverse(rows_of(first.position)[is_hit])
            )
        return replace(buffers, value=value, period=self.function.period)

    def _line_color(self, si: Any, first: Any) -> Any:
        """Return the sRGB color of the isoline that each ray hits; NaN if it hits no isoline.

        si, first: the hit of each ray, as an interaction and as a `SurfaceHit`.
        """
        mi = self.mi
        line_color = mi.Vector3f(dr.nan)
        # A proxy is the Mitsuba mesh that stands for a level set; the faces on its section have a
        # proxy of their own.
        for proxy in self.world.proxies:
            is_on_proxy = first.is_hit & (si.shape == mi.ShapePtr(proxy))
            if proxy.section_proxy is not None:
                is_on_proxy |= first.is_hit & (si.shape == mi.ShapePtr(proxy.section_proxy))
            # The hit tells the number of the isoline, counted from 1 for each surface.
            for number, color in enumerate(proxy.line_colors, start=1):
                line_color = dr.select(
                    is_on_proxy & (first.isoline_index == number), mi.Vector3f(*color), line_color
                )
        return line_color


def _map_arrays(change: Callable[..., Any], *views: AovBuffers) -> AovBuffers:
    """Combine the arrays of several `AovBuffers`. Returns `AovBuffers` in which each array is
    `change(...)` of the arrays of this name in all `views`. Entries that are no arrays are those of
    the first view."""
    arrays = {
        name: change(*(getattr(view, name) for view in views))
        for name, value in vars(views[0]).items()
        if isinstance(value, np.ndarray)
    }
    return replace(views[0], **arrays)


def _values(function: Field, points: FloatArray) -> FloatArray:
    """Return the values of a function at points (n, 3); NaN at points outside the volume in which
    the function is defined."""
    values: FloatArray = function.value(points)
    # The volume is enlarged a little, relative to the size of the points, as hits on its boundary
    # are rounded.
    volume = padded_domain(function, float(np.ptp(points, axis=0).max()))
    return values if volume is None else np.where(volume.contains_points(points), values, np.nan)


def normal_picture(view: AovBuffers) -> npt.NDArray[np.uint8]:
    """Draw the normals as a picture (h, w, 3). Red, green and blue are the x, y and z of the
    normals, with [-1, 1] mapped to [0, 1]."""
    return _of_surfaces(view, 0.5 + 0.5 * view.normal)


def status_picture(view: AovBuffers) -> npt.NDArray[np.uint8]:
    """Draw the status of rays as a picture (h, w, 3), in which misses are dark, hits are white, and
    rays out of steps are magenta."""
    picture = np.zeros((*view.status.shape, 3))
    for status, color in {RayStatus.MISS: view.background, **STATUS_COLORS}.items():
        picture[view.status == int(status)] = color
    return to_uint8(picture)


def depth_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Draw the depths of hits as a picture (h, w, 3), in the colors of a scale."""
    return _of_surfaces(view, scale.colors(view.depth))


def value_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Draw the values at hits as a picture (h, w, 3), in the colors of a scale; gray where a hit
    has no value. Isolines have their own colors."""
    value = value_of(view)
    picture = np.where(np.isnan(value)[..., None], _UNKNOWN, scale.colors(value))
    return _of_surfaces(view, np.where(np.isnan(view.isoline_color), picture, view.isoline_color))


def evaluations_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Draw the numbers of evaluations as a picture (h, w, 3), in the colors of a scale. Rays that
    miss are colored, too."""
    return _with_lost(view, scale.colors(view.evaluations.astype(np.float64)))


def depth_scale(view: AovBuffers) -> ColorScale:
    """Return the gray scale for depths, from the smallest that is seen, which is bright, to the
    largest, which is dark."""
    return ColorScale(*_range(view, view.depth), "depth", gray_colormap)


def evaluations_scale(view: AovBuffers) -> ColorScale:
    """Return the color scale for numbers of evaluations, from zero, which is dark blue, to the
    99.5th percentile, which is yellow, like all larger numbers."""
    top = max(float(np.percentile(view.evaluations, 99.5)), 1.0)
    return ColorScale(0.0, top, "evaluations")


def value_scale(view: AovBuffers) -> ColorScale:
    """Return the color scale for values, from the smallest that is seen, dark blue, to the largest,
    yellow. If the values are angles, it is a circle of hues instead."""
    if view.period is not None:
        return ColorScale.cyclic(view.period, "value")
    return ColorScale(*_range(view, value_of(view)), "value")


def value_of(view: AovBuffers) -> FloatArray:
    """Return the values of the function at hits.

    Raises:
        ValueError: there was no function.
    """
    if view.value is None:
        raise ValueError("values of no function were looked at")
    return view.value


def _range(view: AovBuffers, numbers: FloatArray) -> tuple[float, float]:
    """Return the smallest and the largest finite one of `numbers` at hits; (0, 1) if there is no
    such number.

    numbers: an array with an entry for each pixel of `view`.
    """
    finite = numbers[(view.status == int(RayStatus.HIT)) & np.isfinite(numbers)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _of_surfaces(view: AovBuffers, picture: FloatArray) -> npt.NDArray[np.uint8]:
    """Return the 8-bit pixels (h, w, 3) that have the colors of `picture` (h, w, 3; sRGB in [0, 1])
    at hits, magenta for rays out of steps, and the background elsewhere."""
    is_hit = (view.status == int(RayStatus.HIT))[..., None]
    return _with_lost(view, np.where(is_hit, picture, view.background))


def _with_lost(view: AovBuffers, picture: FloatArray) -> npt.NDArray[np.uint8]:
    """Return `picture` (h, w, 3; sRGB in [0, 1]) as 8-bit pixels, with magenta for rays out of
    steps."""
    is_lost = (view.status == int(RayStatus.OUT_OF_STEPS))[..., None]
    return to_uint8(np.where(is_lost, OUT_OF_STEPS_COLOR, picture))


@dataclass(frozen=True)
class AovMode:
    """How one kind of picture, such as "depth", is made from `AovBuffers`.

    numbers: returns the array that `render` returns, from the buffers.
    picture: returns the pixels (h, w, 3), from the buffers and the color scale.
    scale: returns the color scale of the numbers, from the buffers; None for a kind of picture
        without a scale.
    is_averaged: whether the colors, not the numbers, of several rays are averaged at edges.
    """

    numbers: Callable[[AovBuffers], Any]
    picture: Callable[[AovBuffers, Any], npt.NDArray[np.uint8]]
    scale: Callable[[AovBuffers], ColorScale] | None = None
    is_averaged: bool = False


AOV_MODES = {
    "normal": AovMode(lambda view: view.normal, lambda view, _: normal_picture(view)),
    "evaluations": AovMode(lambda view: view.evaluations, evaluations_picture, evaluations_scale),
    "status": AovMode(lambda view: view.status, lambda view, _: status_picture(view)),
    "depth": AovMode(
        lambda view: view.depth,
        depth_picture,
        depth_scale,
    ),
    "value": AovMode(
        value_of,
        value_picture,
        value_scale,
        is_averaged=True,
    ),
}
MODES_WITH_SCALE = tuple(name for name, show in AOV_MODES.items() if show.scale is not None)
"""Pictures of numbers that have a scale."""


def aov_picture(
    show: str,
    viewer: AovTask,
    view: AovBuffers,
    value_range: tuple[float, float] | None,
    bar: str | bool,
    spp: int,
    executor: Executor | None = None,
) -> npt.NDArray[np.uint8]:
    """Draw the pixels (h, w, 3) of a picture of normals, depths, values or other numbers, with a
    color bar if requested.

    show: the kind of picture, a key of `AOV_MODES`.
    viewer, view: the task, and its result for all pixels.
    value_range: (low, high), the numbers at the ends of the color scale; None for the least and the
        greatest number that is seen.
    bar: whether to put a color bar beside the picture; a text is the title of this bar.
    spp: the number of rays of a pixel at an edge, for pictures in which edges are averaged.
    executor: calls methods of `viewer`, for example on a cluster; None to call them in this
        process.
    """
    mode = AOV_MODES[show]
    scale = None if mode.scale is None else mode.scale(view)
    if scale is None:  # normals and status have colors of their own
        return mode.picture(view, None)
    if value_range is not None:
        # A range that is given is not cyclic, even for angles.
        colormap = viridis if scale.period is not None else scale.colors_of
        scale = ColorScale(*value_range, scale.name, colormap)
    if isinstance(bar, str):
        scale = replace(scale, name=bar)
    picture = mode.picture(view, scale)
    if mode.is_averaged and spp > 1:
        _antialias(
            viewer, view, picture, lambda samples: mode.picture(samples, scale), spp, executor
        )
    if not bar:
        return picture
    numbers = np.asarray(mode.numbers(view), dtype=np.float64)
    if show != "evaluations":  # rays that miss have evaluations, but none of the other numbers
        numbers = numbers[view.status == int(RayStatus.HIT)]
    # The bar gets a pointed end where the picture has numbers beyond its range.
    scale = scale.with_exceeded(numbers[np.isfinite(numbers)])
    return add_color_bar(picture, scale, view.background)


def _antialias(
    viewer: AovTask,
    view: AovBuffers,
    picture: npt.NDArray[np.uint8],
    colors: Callable[[AovBuffers], npt.NDArray[np.uint8]],
    spp: int,
    executor: Executor | None,
) -> None:
    """Draw pixels at edges again, each as the mean light of a grid of rays. This changes `picture`
    (h, w, 3) in place. A pixel is at an edge if it differs visibly from a neighbor, or if the edge
    of an isoline may pass through it.

    viewer, view: the task, and its result for all pixels.
    colors: returns the pixels of an `AovBuffers`.
    spp: the least number of rays of a pixel.
    executor: calls methods of `viewer`; None to call them in this process.
    """
    order = tiled_pixel_order(viewer.size)
    edges = order[(edge_pixels(picture) | view.is_near_isoline).ravel()[order]]
    offsets = multijitter_offsets(spp)
    executor = Executor(viewer) if executor is None else executor
    ranges = executor.split_range(len(edges), max(1, _RAYS_A_BAND // len(offsets)))
    calls = [(edges[start:stop], offsets) for start, stop in ranges]
    for (pixels, _), samples in zip(
        calls, executor.run_tasks("render_samples", calls), strict=True
    ):
        # The samples of each pixel, in linear light.
        light = srgb_to_linear(colors(samples) / 255)
        picture.reshape(-1, 3)[pixels] = to_uint8(linear_to_srgb(light.mean(axis=1)))
