"""What is behind everything in a picture of the studio.

The camera does not see the environment that lights the stage, but the ground going on to the
horizon, and above it a wall of the same colour that is darker higher up. So there is no edge at the
horizon, however low the camera stands.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, to_numpy
from harnack.rendering.pictures.pixels import film_places
from harnack.rendering.pictures.shading import Light
from harnack.rendering.studio.lighting import far_ground, reflectance_of
from harnack.rendering.studio.stage import Studio

# How much darker the wall is straight above.
_DARKER = 0.45


def behind(mi: Any, sensor: Any, stage: Studio, show: str) -> npt.NDArray[np.float32]:
    """Radiance (h, w, 3) behind everything, as seen in the middle of each pixel."""
    width, height = (int(n) for n in sensor.film().crop_size())
    pixel = dr.arange(mi.UInt32, width * height)
    place = film_places(mi, pixel, mi.Vector2f(0.5), (width, height))
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
    rise = np.clip(to_numpy(ray.d)[:, 2], 0, 1) ** 0.7
    far = far_ground(stage.backdrop, stage.azimuth)
    if show == "shaded":
        far = _far_shaded(mi, sensor, stage)
    image = far * (1 - _DARKER * rise[:, None])
    return image.astype(np.float32).reshape(height, width, 3)


def _far_shaded(mi: Any, sensor: Any, stage: Studio) -> FloatArray:
    """Radiance (3,) of the ground far away, in the light of shaded pictures."""
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    colour = mi.Color3f(*reflectance_of(stage.backdrop).tolist())
    up, one = mi.Vector3f(0, 0, 1), mi.Float(1)
    lit = Light.of(matrix).on(colour, up, up, mi.Bool(False), one)
    return to_numpy(lit).reshape(3).astype(np.float64)
