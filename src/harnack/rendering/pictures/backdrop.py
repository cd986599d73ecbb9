"""What is behind everything in a picture of the studio.

The camera does not see the environment that lights the stage, but the ground going on to the
horizon, and above it a wall of the same color that is darker higher up. So there is no edge at the
horizon, however low the camera stands. Or it sees colors or an image, as they are.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, to_numpy
from harnack.rendering.pictures.pixels import film_places
from harnack.rendering.pictures.shading import Light
from harnack.rendering.studio.backdrops import Gradient, Ground, Photo
from harnack.rendering.studio.lighting import far_ground, reflectance_of
from harnack.rendering.surfaces.colors import linear

# How much darker the wall is straight above.
_DARKER = 0.45
FloatImage = npt.NDArray[np.float32]


def wall(mi: Any, sensor: Any, ground: Ground, azimuth: float, show: str) -> FloatImage:
    """Radiance (h, w, 3) of a ground and the wall behind it, in the middle of each pixel.

    azimuth: of the camera, in degrees. show: "color" or "shaded".
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixel = dr.arange(mi.UInt32, width * height)
    place = film_places(mi, pixel, mi.Vector2f(0.5), (width, height))
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
    rise = np.clip(to_numpy(ray.d)[:, 2], 0, 1) ** 0.7
    far = far_ground(ground.name, azimuth)
    if show == "shaded":
        far = _far_shaded(mi, sensor, ground)
    image = far * (1 - _DARKER * rise[:, None])
    return image.astype(np.float32).reshape(height, width, 3)


def _far_shaded(mi: Any, sensor: Any, ground: Ground) -> FloatArray:
    """Radiance (3,) of the ground far away, in the light of shaded pictures."""
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    color = mi.Color3f(*reflectance_of(ground.name).tolist())
    up, one = mi.Vector3f(0, 0, 1), mi.Float(1)
    lit = Light.of(matrix).on(color, up, up, mi.Bool(False), one)
    return to_numpy(lit).reshape(3).astype(np.float64)


def flat(mi: Any, backdrop: Gradient | Photo, size: tuple[int, int]) -> FloatImage:
    """Linear sRGB (h, w, 3) of colors or an image in a picture of (width, height) pixels."""
    if isinstance(backdrop, Photo):
        return _covering(mi, backdrop.pixels, size)
    width, height = size
    if backdrop.bottom == backdrop.top:
        rows = np.array([[linear(backdrop.top)]], dtype=np.float32)
    else:  # even steps in sRGB look even
        rise = (height - 0.5 - np.arange(height)[:, None]) / height
        shown = (1 - rise) * np.array(backdrop.bottom) + rise * np.array(backdrop.top)
        rows = np.array([[linear(tuple(row))] for row in shown.tolist()], dtype=np.float32)
    return np.broadcast_to(rows, (height, width, 3))


def _covering(mi: Any, image: FloatImage, size: tuple[int, int]) -> FloatImage:
    """The largest part of an image, around its middle, that has the shape of a picture of
    (width, height) pixels, as large as that."""
    height, width = image.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    part = [min(round(side / scale), own) for side, own in zip(size, (width, height), strict=True)]
    columns, rows = (max(one, 1) for one in part)
    left, top = (width - columns) // 2, (height - rows) // 2
    cut = np.ascontiguousarray(image[top : top + rows, left : left + columns])
    if (columns, rows) == size:
        return cut
    bitmap = mi.Bitmap(cut).resample(mi.ScalarVector2u(*size), clamp=(0.0, np.inf))
    return np.array(bitmap, dtype=np.float32)
