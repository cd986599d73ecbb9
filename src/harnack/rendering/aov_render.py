"""Pictures of what the tracer did and found: normals, evaluations, status, depth, and values of
another function on the surface.

The numbers are exact, not averaged: those of one ray through the middle of each pixel. So are the
pictures, but that of values: where it has edges, the colors of several rays are averaged.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray, aligned, to_numpy
from harnack.fields import Field
from harnack.rendering.hybrid_scene import World
from harnack.rendering.images import as_bytes, linear_of, transferred
from harnack.rendering.integrator import LOST_COLOR
from harnack.rendering.isolines import defined_in
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.placed_surface import Placement
from harnack.rendering.scales import Color, Scale, grays, viridis, with_bar
from harnack.rendering.shading import (
    Hands,
    OwnHands,
    edges_of,
    film_places,
    grid_offsets,
    in_tiles,
    uploaded,
)
from harnack.tracer import Status

# Ctrl-C works between bands.
_RAYS_A_BAND = 2**20
_BACKGROUND = (0.10, 0.10, 0.11)
GROUND_OF_VIEWS = {"dark": _BACKGROUND, "light": (0.90, 0.90, 0.89)}
"""One color for each of the studio's backdrops, to be behind views."""
_UNKNOWN = (0.45, 0.45, 0.45)
_IDENTITY = Placement.identity()
_STATUS_COLORS = {
    Status.HIT: (0.93, 0.93, 0.90),
    Status.OUT_OF_STEPS: LOST_COLOR,
}


@dataclass(frozen=True)
class View:
    """First hits of the rays through the middles of all pixels.

    depth: (h, w) distance from the camera in the unit of the viewer's placement, inf without a hit.
        Where the ray ran out of steps, how far it is proved free.
    normal: (h, w, 3) unit, zero without a hit; of a level set it points to larger values.
    evaluations: (h, w) of all the scene's fields.
    status: (h, w) a `Status`; shapes of Mitsuba count as hits.
    line: (h, w, 3) color in sRGB of the isoline that is hit; NaN where none is.
    lined: (h, w) whether the edge of an isoline may pass through the pixel.
    value: (h, w) of a function at hits, NaN elsewhere; None without a function.
    period: of that function, if it is angle-valued.
    background: sRGB in [0, 1], of pictures without a hit.
    """

    depth: FloatArray
    normal: FloatArray
    evaluations: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]
    line: FloatArray
    lined: npt.NDArray[np.bool_]
    value: FloatArray | None = None
    period: float | None = None
    background: Color = _BACKGROUND


@dataclass(frozen=True)
class Viewer:
    """A sensor in a world.

    placement: of the surfaces, in whose coordinates depths are given.
    function: of the same coordinates, to be evaluated at hits; None for none.
    """

    mi: Any
    world: World
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
    ) -> Viewer:
        """Of a loaded scene."""
        return cls(mi, World.of(mi, scene), sensor, placement, function, background)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = (int(n) for n in self.sensor.film().crop_size())
        return width, height

    @functools.cached_property
    def order(self) -> IntArray:
        """All pixels, as `in_tiles` visits them."""
        return in_tiles(self.size)

    def view(self, start: int, stop: int) -> View:
        """The first hits of the rays through the middles of some pixels, (n,); `order` counts."""
        return self._look_at(uploaded(self.mi, self.order[start:stop]), self.mi.Vector2f(0.5))

    def look(
        self, hands: Hands | None = None, advance: Callable[[float], None] | None = None
    ) -> View:
        """The first hits of the rays through the middles of all pixels.

        hands: call methods of a viewer like this one, in the place of this one's. advance: told
        what part has been finished since the last call.
        """
        hands = OwnHands(self) if hands is None else hands
        width, height = self.size
        order = self.order
        cut, parts = hands.cut(width * height, _RAYS_A_BAND), list[View]()
        for (start, stop), part in zip(cut, hands.each("view", cut), strict=True):
            parts.append(part)
            if advance is not None:
                advance((stop - start) / (width * height))

        def by_rows(*column: Any) -> Any:
            image = np.empty((height, width, *column[0].shape[1:]), column[0].dtype)
            image.reshape(height * width, *column[0].shape[1:])[order] = np.concatenate(column)
            return image

        return _each(by_rows, *parts)

    def look_again(self, pixels: IntArray, offsets: FloatArray) -> View:
        """The first hits of rays through places (m, 2) in each of n pixels, counted by rows: arrays
        (n, m)."""
        mi, count = self.mi, len(offsets)
        pixel = uploaded(mi, np.repeat(pixels, count))
        table = np.tile(offsets, (len(pixels), 1)).T
        places = mi.Vector2f(*(aligned(mitsuba_backend(mi), one) for one in table))

        def by_pixels(one: Any) -> Any:
            return one.reshape(len(pixels), count, *one.shape[1:])

        return _each(by_pixels, self._look_at(pixel, places))

    def _look_at(self, pixel: Any, offset: Any) -> View:
        """The first hits of rays through places in pixels, counted by rows: arrays (n,)."""
        mi, count = self.mi, dr.width(pixel)
        place = film_places(mi, pixel, offset, self.size)
        ray, _ = self.sensor.sample_ray_differential(
            self.sensor.shutter_open(), 0.5, place, mi.Point2f(0.5)
        )
        none = dr.zeros(mi.SurfaceInteraction3f)
        si, first = self.world.intersect(mi.Ray3f(ray), none, mi.Bool(True))
        lined, line = mi.Bool(False), mi.Vector3f(dr.nan)
        if self.function is not None:
            lined = first.met & self.world.has_line_near(si, ray, ray.d, first.t)
            line = self._line_color(si, first)
        dr.eval(first, lined, line)

        def numbers(values: Any) -> Any:
            flat = to_numpy(values)
            return np.broadcast_to(flat, (count, *flat.shape[1:]))

        met, lost = numbers(first.met), numbers(first.lost)
        status = np.where(met, int(Status.HIT), int(Status.MISS))
        view = View(
            depth=numbers(first.t) / self.placement.scale,
            normal=np.where(met[:, None], numbers(first.normal), 0),
            evaluations=numbers(first.evaluations).astype(np.int64),
            status=np.where(lost, int(Status.OUT_OF_STEPS), status),
            line=numbers(line),
            lined=numbers(lined),
            background=self.background,
        )
        if self.function is None:
            return view
        value = np.full(count, np.nan, dtype=np.float32)
        if met.any():
            value[met] = _values(self.function, self.placement.undo(numbers(first.position)[met]))
        return replace(view, value=value, period=self.function.period)

    def _line_color(self, si: Any, first: Any) -> Any:
        """sRGB of the line that is met; NaN where none is."""
        mi = self.mi
        found = mi.Vector3f(dr.nan)
        for carrier in self.world.carriers:
            own = first.met & (si.shape == mi.ShapePtr(carrier))
            if carrier.cut_face is not None:
                own |= first.met & (si.shape == mi.ShapePtr(carrier.cut_face))
            for number, color in enumerate(carrier.line_colors, start=1):
                found = dr.select(own & (first.line == number), mi.Vector3f(*color), found)
        return found


def _each(change: Callable[..., Any], *views: View) -> View:
    """A view whose arrays are made of those of the same name in others."""
    arrays = {
        name: change(*(getattr(view, name) for view in views))
        for name, value in vars(views[0]).items()
        if isinstance(value, np.ndarray)
    }
    return replace(views[0], **arrays)


def _values(function: Field, points: FloatArray) -> FloatArray:
    """Values at points (n, 3), NaN where the function is not defined."""
    values: FloatArray = function.value(points)
    volume = defined_in(function, float(np.ptp(points, axis=0).max()))
    return values if volume is None else np.where(volume.contains_points(points), values, np.nan)


def normal_picture(view: View) -> npt.NDArray[np.uint8]:
    """x, y, z from [-1, 1] as red, green, blue."""
    return _of_surfaces(view, 0.5 + 0.5 * view.normal)


def status_picture(view: View) -> npt.NDArray[np.uint8]:
    """Misses dark, hits white, out of steps magenta."""
    picture = np.zeros((*view.status.shape, 3))
    for status, color in {Status.MISS: view.background, **_STATUS_COLORS}.items():
        picture[view.status == int(status)] = color
    return as_bytes(picture)


def depth_picture(view: View, scale: Scale) -> npt.NDArray[np.uint8]:
    """Depths of what is met as the colors of a scale."""
    return _of_surfaces(view, scale.colors(view.depth))


def value_picture(view: View, scale: Scale) -> npt.NDArray[np.uint8]:
    """Values on what is met as the colors of a scale, gray where there is none; isolines on it."""
    value = value_of(view)
    picture = np.where(np.isnan(value)[..., None], _UNKNOWN, scale.colors(value))
    return _of_surfaces(view, np.where(np.isnan(view.line), picture, view.line))


def evaluations_picture(view: View, scale: Scale) -> npt.NDArray[np.uint8]:
    """Evaluations as the colors of a scale, of rays that miss as well."""
    return _with_lost(view, scale.colors(view.evaluations.astype(np.float64)))


def depth_scale(view: View) -> Scale:
    """Near is bright, far is dark."""
    return Scale(*_range(view, view.depth), "depth", grays)


def evaluations_scale(view: View) -> Scale:
    """Zero is dark blue; the 99.5th percentile, and all above it, is yellow."""
    top = max(float(np.percentile(view.evaluations, 99.5)), 1.0)
    return Scale(0.0, top, "evaluations")


def value_scale(view: View) -> Scale:
    """From the least value that is seen, dark blue, to the greatest, yellow; angles as hues."""
    if view.period is not None:
        return Scale.cyclic(view.period, "value")
    return Scale(*_range(view, value_of(view)), "value")


def value_of(view: View) -> FloatArray:
    """Values of the function that was asked for."""
    if view.value is None:
        raise ValueError("values of no function were looked at")
    return view.value


def _range(view: View, numbers: FloatArray) -> tuple[float, float]:
    """The least and the greatest finite number of what is met; (0, 1) where there is none."""
    found = numbers[(view.status == int(Status.HIT)) & np.isfinite(numbers)]
    return (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)


def _of_surfaces(view: View, picture: FloatArray) -> npt.NDArray[np.uint8]:
    """Colors where something is hit, over the background."""
    met = (view.status == int(Status.HIT))[..., None]
    return _with_lost(view, np.where(met, picture, view.background))


def _with_lost(view: View, picture: FloatArray) -> npt.NDArray[np.uint8]:
    lost = (view.status == int(Status.OUT_OF_STEPS))[..., None]
    return as_bytes(np.where(lost, LOST_COLOR, picture))


@dataclass(frozen=True)
class Show:
    """What to take from a view as numbers, and how to draw it.

    scale: of numbers that have one, which `picture` draws them by; None for others.
    is_averaged: whether the picture, not the numbers, averages several rays where it has edges.
    """

    numbers: Callable[[View], Any]
    picture: Callable[[View, Any], npt.NDArray[np.uint8]]
    scale: Callable[[View], Scale] | None = None
    is_averaged: bool = False


VIEWS = {
    "normal": Show(lambda view: view.normal, lambda view, _: normal_picture(view)),
    "evaluations": Show(lambda view: view.evaluations, evaluations_picture, evaluations_scale),
    "status": Show(lambda view: view.status, lambda view, _: status_picture(view)),
    "depth": Show(
        lambda view: view.depth,
        depth_picture,
        depth_scale,
    ),
    "value": Show(
        value_of,
        value_picture,
        value_scale,
        is_averaged=True,
    ),
}
SCALED = tuple(name for name, show in VIEWS.items() if show.scale is not None)
"""Pictures of numbers that have a scale."""


def drawn(
    show: str,
    viewer: Viewer,
    view: View,
    value_range: tuple[float, float] | None,
    bar: str | bool,
    spp: int,
    hands: Hands | None = None,
) -> npt.NDArray[np.uint8]:
    """The pixels of what a viewer has seen.

    value_range: of the scale, in place of what is seen. bar: whether to put a color bar beside
    it, or what to write over that. spp: rays of a pixel on an edge, of pictures that are averaged.
    hands: as for `Viewer.look`.
    """
    one = VIEWS[show]
    scale = None if one.scale is None else one.scale(view)
    if scale is None:
        return one.picture(view, None)
    if value_range is not None:
        map_of = viridis if scale.period is not None else scale.colors_of
        scale = Scale(*value_range, scale.name, map_of)
    if isinstance(bar, str):
        scale = replace(scale, name=bar)
    picture = one.picture(view, scale)
    if one.is_averaged and spp > 1:
        _average(viewer, view, picture, lambda part: one.picture(part, scale), spp, hands)
    if not bar:
        return picture
    numbers = np.asarray(one.numbers(view), dtype=np.float64)
    if show != "evaluations":  # which rays that miss have, too
        numbers = numbers[view.status == int(Status.HIT)]
    scale = scale.passed_by(numbers[np.isfinite(numbers)])
    return with_bar(picture, scale, view.background)


def _average(
    viewer: Viewer,
    view: View,
    picture: npt.NDArray[np.uint8],
    colors: Callable[[View], npt.NDArray[np.uint8]],
    spp: int,
    hands: Hands | None,
) -> None:
    """Make pixels that differ visibly from a neighbor, or that the edge of an isoline may pass
    through, the mean light of a grid of rays."""
    order = in_tiles(viewer.size)
    again = order[(edges_of(picture) | view.lined).ravel()[order]]
    offsets = grid_offsets(spp)
    hands = OwnHands(viewer) if hands is None else hands
    cut = hands.cut(len(again), max(1, _RAYS_A_BAND // len(offsets)))
    parts = [(again[start:stop], offsets) for start, stop in cut]
    for (chosen, _), seen in zip(parts, hands.each("look_again", parts), strict=True):
        light = linear_of(colors(seen) / 255)
        picture.reshape(-1, 3)[chosen] = as_bytes(transferred(light.mean(axis=1)))
