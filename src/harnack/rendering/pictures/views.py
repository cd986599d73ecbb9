"""Pictures of what the tracer did: normals, evaluations, status, depth. One ray a pixel.

All of them are exact, not averaged: the ray goes through the middle of the pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import to_numpy
from harnack.rendering.mitsuba.integrator import LOST_COLOUR
from harnack.rendering.mitsuba.world import World
from harnack.rendering.pictures.colormap import viridis
from harnack.rendering.pictures.images import as_bytes
from harnack.rendering.pictures.pixels import bands, film_places, in_tiles, uploaded
from harnack.tracer import Status

FloatArray = npt.NDArray[np.floating[Any]]

# Ctrl-C works between bands.
_RAYS_A_BAND = 2**20
_BACKGROUND = (0.10, 0.10, 0.11)
_STATUS_COLOURS = {
    Status.MISS: _BACKGROUND,
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
    """

    depth: FloatArray
    normal: FloatArray
    evaluations: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]


def look(mi: Any, scene: Any, sensor: Any, unit: float = 1.0) -> View:
    """What a sensor sees first. unit: of depths, in lengths of the scene."""
    width, height = (int(n) for n in sensor.film().crop_size())
    world = World.of(mi, scene)
    order = in_tiles((width, height))
    parts = [
        _look_at(mi, world, sensor, uploaded(mi, order[start:stop]))
        for start, stop in bands(width * height, _RAYS_A_BAND)
    ]

    def by_rows(column: tuple[Any, ...]) -> Any:
        image = np.empty((height, width, *column[0].shape[1:]), column[0].dtype)
        image.reshape(height * width, *column[0].shape[1:])[order] = np.concatenate(column)
        return image

    depth, normal, evaluations, status = (by_rows(one) for one in zip(*parts, strict=True))
    return View(depth / unit, normal, evaluations, status)


def _look_at(mi: Any, world: World, sensor: Any, pixel: Any) -> tuple[Any, ...]:
    """Depth, normal, evaluations and status of pixels, counted by rows."""
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
    return numbers(first.t), normal, numbers(first.evaluations).astype(np.int64), status


def normal_picture(view: View) -> npt.NDArray[np.uint8]:
    """x, y, z from [-1, 1] as red, green, blue."""
    met = (view.status == int(Status.HIT))[..., None]
    return _with_lost(view, np.where(met, 0.5 + 0.5 * view.normal, _BACKGROUND))


def depth_picture(view: View) -> npt.NDArray[np.uint8]:
    """Near is bright, far is dark."""
    met = view.status == int(Status.HIT)
    if not met.any():
        return _with_lost(view, np.broadcast_to(_BACKGROUND, (*view.depth.shape, 3)))
    near, far = view.depth[met].min(), view.depth[met].max()
    level = (far - np.where(met, view.depth, far)) / max(far - near, 1e-6 * far, 1e-30)
    grey = np.where(met, 0.25 + 0.75 * level, 0.0)[..., None]
    return _with_lost(view, np.where(met[..., None], grey, _BACKGROUND))


def evaluations_picture(view: View) -> npt.NDArray[np.uint8]:
    """Zero is dark blue; the 99.5th percentile, and all above it, is yellow."""
    top = max(float(np.percentile(view.evaluations, 99.5)), 1.0)
    return _with_lost(view, viridis(view.evaluations / top))


def status_picture(view: View) -> npt.NDArray[np.uint8]:
    """Misses dark, hits white, out of steps magenta."""
    picture = np.zeros((*view.status.shape, 3))
    for status, colour in _STATUS_COLOURS.items():
        picture[view.status == int(status)] = colour
    return as_bytes(picture)


def _with_lost(view: View, picture: FloatArray) -> npt.NDArray[np.uint8]:
    lost = (view.status == int(Status.OUT_OF_STEPS))[..., None]
    return as_bytes(np.where(lost, LOST_COLOUR, picture))


@dataclass(frozen=True)
class Show:
    """What to take from a view as numbers, and how to draw it."""

    numbers: Callable[[View], Any]
    picture: Callable[[View], npt.NDArray[np.uint8]]


VIEWS = {
    "normal": Show(lambda view: view.normal, normal_picture),
    "evaluations": Show(lambda view: view.evaluations, evaluations_picture),
    "status": Show(lambda view: view.status, status_picture),
    "depth": Show(lambda view: view.depth, depth_picture),
}
