"""Pictures of what the tracer did and found: normals, evaluations, status, depth, and values of
another function on the surface. One ray a pixel.

All of them are exact, not averaged: the ray goes through the middle of the pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import to_numpy
from harnack.fields import Field
from harnack.rendering.mitsuba.integrator import LOST_COLOUR
from harnack.rendering.mitsuba.world import World
from harnack.rendering.pictures.images import as_bytes
from harnack.rendering.pictures.pixels import bands, film_places, in_tiles, uploaded
from harnack.rendering.pictures.scales.bar import with_bar
from harnack.rendering.pictures.scales.colormap import greys, viridis
from harnack.rendering.pictures.scales.scale import Scale
from harnack.rendering.surfaces.colours import Colour
from harnack.rendering.surfaces.functions import defined_in
from harnack.rendering.surfaces.placement import Placement
from harnack.tracer import Status

FloatArray = npt.NDArray[np.floating[Any]]

# Ctrl-C works between bands.
_RAYS_A_BAND = 2**20
_BACKGROUND = (0.10, 0.10, 0.11)
GROUND_OF_VIEWS = {"dark": _BACKGROUND, "light": (0.90, 0.90, 0.89)}
"""What is behind views before the studio's backdrops, which are no single color."""
_UNKNOWN = (0.45, 0.45, 0.45)
_IDENTITY = Placement.identity()
_STATUS_COLOURS = {
    Status.HIT: (0.93, 0.93, 0.90),
    Status.OUT_OF_STEPS: LOST_COLOUR,
}


@dataclass(frozen=True)
class View:
    """First hits of the rays through the middles of all pixels.

    depth: (h, w) distance from the camera in the unit asked for, inf where nothing is met. Where
        the ray ran out of steps, how far it is proved free.
    normal: (h, w, 3) unit, zero where nothing is met; of a level set it points to larger values.
    evaluations: (h, w) of all the scene's fields.
    status: (h, w) a `Status`; shapes of Mitsuba count as hits.
    value: (h, w) of a function where something is met, NaN elsewhere; None if none was asked for.
    period: of that function, if it is angle-valued.
    background: sRGB in [0, 1], of pictures where nothing is met.
    """

    depth: FloatArray
    normal: FloatArray
    evaluations: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]
    value: FloatArray | None = None
    period: float | None = None
    background: Colour = _BACKGROUND


def look(
    mi: Any,
    scene: Any,
    sensor: Any,
    placement: Placement = _IDENTITY,
    function: Field | None = None,
) -> View:
    """What a sensor sees first.

    placement: of the surfaces, in whose coordinates depths are given. function: of the same
    coordinates, to be evaluated at what is met.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    world = World.of(mi, scene)
    order = in_tiles((width, height))
    parts = [
        _look_at(mi, world, sensor, uploaded(mi, order[start:stop]), placement, function)
        for start, stop in bands(width * height, _RAYS_A_BAND)
    ]

    def by_rows(column: tuple[Any, ...]) -> Any:
        image = np.empty((height, width, *column[0].shape[1:]), column[0].dtype)
        image.reshape(height * width, *column[0].shape[1:])[order] = np.concatenate(column)
        return image

    depth, normal, evaluations, status, *value = map(by_rows, zip(*parts, strict=True))
    view = View(depth / placement.scale, normal, evaluations, status)
    if function is None:
        return view
    return replace(view, value=value[0], period=function.period)


def _look_at(
    mi: Any, world: World, sensor: Any, pixel: Any, placement: Placement, function: Field | None
) -> tuple[Any, ...]:
    """Depth, normal, evaluations and status of pixels, counted by rows; and values, if any."""
    width, height = (int(n) for n in sensor.film().crop_size())
    count = dr.width(pixel)
    place = film_places(mi, pixel, mi.Vector2f(0.5), (width, height))
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
    none = dr.zeros(mi.SurfaceInteraction3f)
    _, first = world.intersect(mi.Ray3f(ray), none, mi.Bool(True))
    dr.eval(first)

    def numbers(values: Any) -> Any:
        flat = to_numpy(values)
        return np.broadcast_to(flat, (count, *flat.shape[1:]))

    met, lost = numbers(first.met), numbers(first.lost)
    status = np.where(met, int(Status.HIT), int(Status.MISS))
    status = np.where(lost, int(Status.OUT_OF_STEPS), status)
    normal = np.where(met[:, None], numbers(first.normal), 0)
    found = numbers(first.t), normal, numbers(first.evaluations).astype(np.int64), status
    if function is None:
        return found
    value = np.full(count, np.nan, dtype=np.float32)
    if met.any():
        value[met] = _values(function, placement.undo(numbers(first.position)[met]))
    return *found, value


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
    for status, colour in {Status.MISS: view.background, **_STATUS_COLOURS}.items():
        picture[view.status == int(status)] = colour
    return as_bytes(picture)


def scaled_picture(view: View, numbers: FloatArray, scale: Scale) -> npt.NDArray[np.uint8]:
    """Numbers of what is met as the colours of a scale; grey where there is none."""
    known = ~np.isnan(numbers)[..., None]
    return _of_surfaces(view, np.where(known, scale.colours(numbers), _UNKNOWN))


def evaluations_picture(view: View, scale: Scale) -> npt.NDArray[np.uint8]:
    """Evaluations as the colours of a scale, of rays that miss as well."""
    return _with_lost(view, scale.colours(view.evaluations.astype(np.float64)))


def depth_scale(view: View) -> Scale:
    """Near is bright, far is dark."""
    return Scale(*_range(view, view.depth), "depth", greys)


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
    """Of the function that was asked for."""
    if view.value is None:
        raise ValueError("values of no function were looked at")
    return view.value


def _range(view: View, numbers: FloatArray) -> tuple[float, float]:
    """The least and the greatest finite number of what is met; (0, 1) where there is none."""
    found = numbers[(view.status == int(Status.HIT)) & np.isfinite(numbers)]
    return (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)


def _of_surfaces(view: View, picture: FloatArray) -> npt.NDArray[np.uint8]:
    """Colours where something is met, before the background."""
    met = (view.status == int(Status.HIT))[..., None]
    return _with_lost(view, np.where(met, picture, view.background))


def _with_lost(view: View, picture: FloatArray) -> npt.NDArray[np.uint8]:
    lost = (view.status == int(Status.OUT_OF_STEPS))[..., None]
    return as_bytes(np.where(lost, LOST_COLOUR, picture))


@dataclass(frozen=True)
class Show:
    """What to take from a view as numbers, and how to draw it.

    scale: of numbers that have one, which `picture` draws them by; None for others.
    """

    numbers: Callable[[View], Any]
    picture: Callable[[View, Any], npt.NDArray[np.uint8]]
    scale: Callable[[View], Scale] | None = None


VIEWS = {
    "normal": Show(lambda view: view.normal, lambda view, _: normal_picture(view)),
    "evaluations": Show(lambda view: view.evaluations, evaluations_picture, evaluations_scale),
    "status": Show(lambda view: view.status, lambda view, _: status_picture(view)),
    "depth": Show(
        lambda view: view.depth,
        lambda view, scale: scaled_picture(view, view.depth, scale),
        depth_scale,
    ),
    "value": Show(
        value_of, lambda view, scale: scaled_picture(view, value_of(view), scale), value_scale
    ),
}
SCALED = tuple(name for name, show in VIEWS.items() if show.scale is not None)
"""Pictures of numbers that have a scale."""


def drawn(
    show: str, view: View, value_range: tuple[float, float] | None, bar: str | bool
) -> npt.NDArray[np.uint8]:
    """The pixels of a view.

    value_range: of the scale, in place of what is seen. bar: whether to put a colour bar beside
    it, or what to write over that.
    """
    one = VIEWS[show]
    scale = None if one.scale is None else one.scale(view)
    if scale is None:
        return one.picture(view, None)
    if value_range is not None:
        map_of = viridis if scale.period is not None else scale.colours_of
        scale = Scale(*value_range, scale.name, map_of)
    if isinstance(bar, str):
        scale = replace(scale, name=bar)
    picture = one.picture(view, scale)
    if not bar:
        return picture
    numbers = np.asarray(one.numbers(view), dtype=np.float64)
    if show != "evaluations":  # which rays that miss have, too
        numbers = numbers[view.status == int(Status.HIT)]
    scale = scale.passed_by(numbers[np.isfinite(numbers)])
    return with_bar(picture, scale, view.background)
