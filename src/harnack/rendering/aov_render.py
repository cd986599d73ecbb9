"""Renders arbitrary output variables (AOVs): normals, evaluations, status, depth, and values of
another function on the surface.

The numbers are exact, not averaged: those of a single ray through the middle of each pixel. So are
the pictures, except those of values: at edges, the colors of several rays are averaged.
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
from harnack.fields import Field
from harnack.rendering.hybrid_scene import HybridScene
from harnack.rendering.images import linear_to_srgb, srgb_to_linear, to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.isolines import padded_domain
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.placed_surface import Placement
from harnack.rendering.scales import Color, ColorScale, add_color_bar, gray_colormap, viridis
from harnack.rendering.shading import (
    LocalRenderExecutor,
    RenderExecutor,
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
_STATUS_COLORS = {
    RayStatus.HIT: (0.93, 0.93, 0.90),
    RayStatus.OUT_OF_STEPS: OUT_OF_STEPS_COLOR,
}


@dataclass(frozen=True)
class AovBuffers:
    """First hits of the rays through the middles of all pixels.

    depth: (h, w) distance from the camera in the unit of the viewer's placement, inf without a hit;
        for a ray out of steps, the distance up to which it is proved free.
    normal: (h, w, 3) unit, zero without a hit; of a level set it points to larger values.
    evaluations: (h, w) of all the scene's fields.
    status: (h, w) a `RayStatus`; shapes of Mitsuba count as hits.
    isoline_color: (h, w, 3) color in sRGB of the isoline that is hit; NaN where no isoline is hit.
    is_near_isoline: (h, w) whether the edge of an isoline may pass through the pixel.
    value: (h, w) of a function at hits, NaN elsewhere; None without a function.
    period: of that function, if it is angle-valued.
    background: sRGB in [0, 1], of pictures without a hit.
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
    """The rendering of AOVs for a sensor in a scene, by ranges of pixels.

    placement: of the surfaces, in whose coordinates depths are given.
    function: of the same coordinates, to be evaluated at hits; None for no function.
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
        """The task for a loaded Mitsuba scene."""
        return cls(mi, HybridScene.of(mi, scene), sensor, placement, function, background)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = (int(n) for n in self.sensor.film().crop_size())
        return width, height

    @functools.cached_property
    def order(self) -> IntArray:
        """All pixels, as `tiled_pixel_order` visits them."""
        return tiled_pixel_order(self.size)

    def render_range(self, start: int, stop: int) -> AovBuffers:
        """The first hits (n,) of the rays through the middles of a range of pixels, counted as in
        `order`."""
        return self._trace_pixels(
            upload_indices(self.mi, self.order[start:stop]), self.mi.Vector2f(0.5)
        )

    def look(
        self, executor: RenderExecutor | None = None, advance: Callable[[float], None] | None = None
    ) -> AovBuffers:
        """The first hits of the rays through the middles of all pixels.

        executor: executes the methods of a task like this one in place of this task.
        advance: called with the fraction that has been finished since the last call.
        """
        executor = LocalRenderExecutor(self) if executor is None else executor
        width, height = self.size
        order = self.order
        ranges, buffers = executor.split_range(width * height, _RAYS_A_BAND), list[AovBuffers]()
        for (start, stop), buffer in zip(
            ranges, executor.run_tasks("render_range", ranges), strict=True
        ):
            buffers.append(buffer)
            if advance is not None:
                advance((stop - start) / (width * height))

        def by_rows(*column: Any) -> Any:
            image = np.empty((height, width, *column[0].shape[1:]), column[0].dtype)
            image.reshape(height * width, *column[0].shape[1:])[order] = np.concatenate(column)
            return image

        return _map_arrays(by_rows, *buffers)

    def render_samples(self, pixels: IntArray, offsets: FloatArray) -> AovBuffers:
        """The first hits of rays through points (m, 2) in each of n pixels, which are counted by
        rows: arrays (n, m)."""
        mi, count = self.mi, len(offsets)
        pixel = upload_indices(mi, np.repeat(pixels, count))
        table = np.tile(offsets, (len(pixels), 1)).T
        positions = mi.Vector2f(*(upload_floats(mitsuba_backend(mi), array) for array in table))

        def by_pixels(array: Any) -> Any:
            return array.reshape(len(pixels), count, *array.shape[1:])

        return _map_arrays(by_pixels, self._trace_pixels(pixel, positions))

    def _trace_pixels(self, pixel: Any, offset: Any) -> AovBuffers:
        """The first hits of rays through places in pixels, counted by rows: arrays (n,)."""
        mi, count = self.mi, dr.width(pixel)
        position = film_positions(mi, pixel, offset, self.size)
        ray, _ = self.sensor.sample_ray_differential(
            self.sensor.shutter_open(), 0.5, position, mi.Point2f(0.5)
        )
        none = dr.zeros(mi.SurfaceInteraction3f)
        si, first = self.world.intersect(mi.Ray3f(ray), none, mi.Bool(True))
        near, color = mi.Bool(False), mi.Vector3f(dr.nan)
        if self.function is not None:
            near = first.is_hit & self.world.has_line_near(si, ray, ray.d, first.t)
            color = self._line_color(si, first)
        dr.eval(first, near, color)

        def numbers(values: Any) -> Any:
            flat = to_numpy(values)
            return np.broadcast_to(flat, (count, *flat.shape[1:]))

        is_hit, is_lost = numbers(first.is_hit), numbers(first.is_out_of_steps)
        status = np.where(is_hit, int(RayStatus.HIT), int(RayStatus.MISS))
        view = AovBuffers(
            depth=numbers(first.t) / self.placement.scale,
            normal=np.where(is_hit[:, None], numbers(first.normal), 0),
            evaluations=numbers(first.evaluations).astype(np.int64),
            status=np.where(is_lost, int(RayStatus.OUT_OF_STEPS), status),
            isoline_color=numbers(color),
            is_near_isoline=numbers(near),
            background=self.background,
        )
        if self.function is None:
            return view
        value = np.full(count, np.nan, dtype=np.float32)
        if is_hit.any():
            value[is_hit] = _values(
                self.function, self.placement.apply_inverse(numbers(first.position)[is_hit])
            )
        return replace(view, value=value, period=self.function.period)

    def _line_color(self, si: Any, first: Any) -> Any:
        """The color in sRGB of the isoline that is hit; NaN where no isoline is hit."""
        mi = self.mi
        line_color = mi.Vector3f(dr.nan)
        for proxy in self.world.proxies:
            is_there = first.is_hit & (si.shape == mi.ShapePtr(proxy))
            if proxy.section_proxy is not None:
                is_there |= first.is_hit & (si.shape == mi.ShapePtr(proxy.section_proxy))
            for number, color in enumerate(proxy.line_colors, start=1):
                line_color = dr.select(
                    is_there & (first.isoline_index == number), mi.Vector3f(*color), line_color
                )
        return line_color


def _map_arrays(change: Callable[..., Any], *views: AovBuffers) -> AovBuffers:
    """AOV buffers whose arrays are the results of `change` for the arrays of that name in all
    views."""
    arrays = {
        name: change(*(getattr(view, name) for view in views))
        for name, value in vars(views[0]).items()
        if isinstance(value, np.ndarray)
    }
    return replace(views[0], **arrays)


def _values(function: Field, points: FloatArray) -> FloatArray:
    """Values at points (n, 3), NaN where the function is not defined."""
    values: FloatArray = function.value(points)
    volume = padded_domain(function, float(np.ptp(points, axis=0).max()))
    return values if volume is None else np.where(volume.contains_points(points), values, np.nan)


def normal_picture(view: AovBuffers) -> npt.NDArray[np.uint8]:
    """x, y, z from [-1, 1] as red, green, blue."""
    return _of_surfaces(view, 0.5 + 0.5 * view.normal)


def status_picture(view: AovBuffers) -> npt.NDArray[np.uint8]:
    """Misses dark, hits white, out of steps magenta."""
    picture = np.zeros((*view.status.shape, 3))
    for status, color in {RayStatus.MISS: view.background, **_STATUS_COLORS}.items():
        picture[view.status == int(status)] = color
    return to_uint8(picture)


def depth_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Depths of hits as the colors of a scale."""
    return _of_surfaces(view, scale.colors(view.depth))


def value_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Values at hits as the colors of a scale, gray where there is no value; with isolines."""
    value = value_of(view)
    picture = np.where(np.isnan(value)[..., None], _UNKNOWN, scale.colors(value))
    return _of_surfaces(view, np.where(np.isnan(view.isoline_color), picture, view.isoline_color))


def evaluations_picture(view: AovBuffers, scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Evaluations as the colors of a scale, of rays that miss as well."""
    return _with_lost(view, scale.colors(view.evaluations.astype(np.float64)))


def depth_scale(view: AovBuffers) -> ColorScale:
    """Near is bright, far is dark."""
    return ColorScale(*_range(view, view.depth), "depth", gray_colormap)


def evaluations_scale(view: AovBuffers) -> ColorScale:
    """Zero is dark blue; the 99.5th percentile, and all above it, is yellow."""
    top = max(float(np.percentile(view.evaluations, 99.5)), 1.0)
    return ColorScale(0.0, top, "evaluations")


def value_scale(view: AovBuffers) -> ColorScale:
    """From the least value that is seen, dark blue, to the greatest, yellow; angles as hues."""
    if view.period is not None:
        return ColorScale.cyclic(view.period, "value")
    return ColorScale(*_range(view, value_of(view)), "value")


def value_of(view: AovBuffers) -> FloatArray:
    """The values of the function at hits. Raises ValueError if there was no function."""
    if view.value is None:
        raise ValueError("values of no function were looked at")
    return view.value


def _range(view: AovBuffers, numbers: FloatArray) -> tuple[float, float]:
    """The smallest and the largest finite number at hits; (0, 1) if there is no such number."""
    finite = numbers[(view.status == int(RayStatus.HIT)) & np.isfinite(numbers)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _of_surfaces(view: AovBuffers, picture: FloatArray) -> npt.NDArray[np.uint8]:
    """Colors where something is hit, over the background."""
    is_hit = (view.status == int(RayStatus.HIT))[..., None]
    return _with_lost(view, np.where(is_hit, picture, view.background))


def _with_lost(view: AovBuffers, picture: FloatArray) -> npt.NDArray[np.uint8]:
    is_lost = (view.status == int(RayStatus.OUT_OF_STEPS))[..., None]
    return to_uint8(np.where(is_lost, OUT_OF_STEPS_COLOR, picture))


@dataclass(frozen=True)
class AovMode:
    """How an AOV is read from the buffers as numbers, and drawn.

    scale: the color scale of the numbers, by which `picture` draws them; None for AOVs without a
        scale.
    is_averaged: whether the picture, not the numbers, averages several rays at edges.
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
    executor: RenderExecutor | None = None,
) -> npt.NDArray[np.uint8]:
    """The picture (h, w, 3) of AOV buffers.

    value_range: of the scale, in place of the range of the numbers that are seen.
    bar: whether to put a color bar beside the picture, or its title.
    spp: rays of a pixel at an edge, for pictures that are averaged.
    executor: as for `AovTask.look`.
    """
    mode = AOV_MODES[show]
    scale = None if mode.scale is None else mode.scale(view)
    if scale is None:
        return mode.picture(view, None)
    if value_range is not None:
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
    if show != "evaluations":  # which rays that miss have, too
        numbers = numbers[view.status == int(RayStatus.HIT)]
    scale = scale.with_exceeded(numbers[np.isfinite(numbers)])
    return add_color_bar(picture, scale, view.background)


def _antialias(
    viewer: AovTask,
    view: AovBuffers,
    picture: npt.NDArray[np.uint8],
    colors: Callable[[AovBuffers], npt.NDArray[np.uint8]],
    spp: int,
    executor: RenderExecutor | None,
) -> None:
    """Make pixels that differ visibly from a neighbor, or that the edge of an isoline may pass
    through, the mean light of a grid of rays."""
    order = tiled_pixel_order(viewer.size)
    edges = order[(edge_pixels(picture) | view.is_near_isoline).ravel()[order]]
    offsets = multijitter_offsets(spp)
    executor = LocalRenderExecutor(viewer) if executor is None else executor
    ranges = executor.split_range(len(edges), max(1, _RAYS_A_BAND // len(offsets)))
    calls = [(edges[start:stop], offsets) for start, stop in ranges]
    for (rows, _), samples in zip(calls, executor.run_tasks("render_samples", calls), strict=True):
        light = srgb_to_linear(colors(samples) / 255)
        picture.reshape(-1, 3)[rows] = to_uint8(linear_to_srgb(light.mean(axis=1)))
