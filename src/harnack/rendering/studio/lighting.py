"""The studio's ground and lights, placed around the camera's view of the stage."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harnack.backend import FloatArray

# Radiances of the environment, linear sRGB: at the horizon, overhead, and of a soft strip of
# light behind the stage that draws edges and gives metal something to reflect.
_HORIZON = np.array([0.17, 0.17, 0.18])
_ZENITH = np.array([0.36, 0.40, 0.46])
_STRIP = np.array([0.70, 0.66, 0.60])
_KEY = (4.7, 4.5, 4.25)
# The height of the floor: a hair below what stands on it.
FLOOR = -0.002
# Reflectance of the ground, by the backdrop's name. Without a ground, what is behind the surfaces
# is cut out of the picture.
GROUNDS = {"light": (0.74, 0.73, 0.715), "dark": (0.055, 0.058, 0.065)}
# (height, width) of the environment's bitmap.
_ENVIRONMENT_SIZE = (64, 128)


def reflectance_of(backdrop: str) -> FloatArray:
    """Of the ground, (3,)."""
    return np.array(GROUNDS[backdrop])


def far_ground(backdrop: str, azimuth: float) -> FloatArray:
    """Radiance (3,) of the ground far from the stage, which the environment alone lights."""
    image = environment(azimuth)
    z = np.cos(math.pi * (np.arange(len(image)) + 0.5) / len(image))
    weight = np.clip(z, 0, None) * np.sqrt(1 - z * z)  # of rows, by the cosine
    mean = np.average(image.mean(axis=1), axis=0, weights=weight)
    return reflectance_of(backdrop) * mean


def ground(mi: Any, backdrop: str) -> dict[str, Any]:
    """A wide floor."""
    floor = mi.ScalarTransform4f().translate([0, 0, FLOOR]).scale(100)
    color = {"type": "rgb", "value": list(GROUNDS[backdrop])}
    return {
        "ground": {
            "type": "disk",
            "to_world": floor,
            "bsdf": {"type": "diffuse", "reflectance": color},
        }
    }


def lights(mi: Any, azimuth: float) -> dict[str, Any]:
    """A large key light to the left of the camera and above, and an environment that fills.

    azimuth: of the camera, in degrees.

    The environment is smooth: paths that find it by themselves are less noisy than samples of
    it, so it is not sampled.
    """
    key = 4.9 * _direction(azimuth - 52, 55)
    look = mi.ScalarTransform4f().look_at(origin=key.tolist(), target=[0, 0, 0.3], up=[0, 0, 1])
    y_to_z = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {
        "key": {
            "type": "disk",
            "to_world": look.scale(2.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(_KEY)}},
        },
        "fill": {
            "type": "envmap",
            "bitmap": mi.Bitmap(environment(azimuth)),
            "to_world": y_to_z,
            "sampling_weight": 0.0,
        },
    }


def environment(azimuth: float) -> Any:
    """Radiance of the environment as an equirectangular image (h, w, 3) of float32, z up."""
    height, width = _ENVIRONMENT_SIZE
    theta = math.pi * (np.arange(height) + 0.5) / height
    phi = 2 * math.pi * (np.arange(width) + 0.5) / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    # Mitsuba's direction at these angles, after its y axis has been turned up to z.
    x, y, z = np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)
    d = np.stack([x, y, z], axis=-1)
    rise = np.clip(z, 0, 1)[..., None] ** 0.7
    image = _HORIZON + (_ZENITH - _HORIZON) * rise
    strip = _direction(azimuth + 125, 28)
    image += _STRIP * np.exp((d @ strip - 1) / 0.14)[..., None]
    return image.astype(np.float32)


def _direction(azimuth: float, elevation: float) -> FloatArray:
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
