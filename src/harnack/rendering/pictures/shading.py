"""The light of shaded pictures: a formula, so that one ray a sample is all they need.

A soft key light from the upper left of the camera, a hemisphere of light that is cooler above
than below, and a gloss on what is glossy. `shaded.visible_sky` says how much
of the hemisphere is hidden by what is near, `floor` where the studio's floor lies in shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray

Color = tuple[float, float, float]

# Irradiance over pi, linear sRGB: of the key light at its brightest, and of the hemisphere.
_KEY: Color = (0.74, 0.71, 0.66)
_ABOVE: Color = (0.36, 0.40, 0.46)
_BELOW: Color = (0.25, 0.225, 0.20)
# Towards the key light, along the camera's axes to the right, up and back.
_TO_KEY = np.array([-0.52, 0.62, 0.59]) / np.linalg.norm([-0.52, 0.62, 0.59])
# The key light reaches round to where its cosine is minus this.
_WRAP = 0.25
# How much of the key light is taken away where the whole hemisphere is hidden.
_KEY_HIDDEN = 0.6
_HIGHLIGHT = 0.22
_SHARPNESS = 60.0
_RIM = 0.45
# What shines through is drawn in this; mirrors keep their hue.
_CLEAR: Color = (0.52, 0.60, 0.64)
_METAL = 0.78
# The side of larger values of a surface that has one color for both.
_INSIDE: Color = (0.52, 0.60, 0.74)
# Where a level set spans what a mesh leaves open: this share of amber, or of teal on warm colors.
_MENDED = 0.55
_AMBER: Color = (0.92, 0.40, 0.06)
_TEAL: Color = (0.05, 0.40, 0.46)


@dataclass(frozen=True)
class Light:
    """Unit vectors, as lists of three numbers, to the key light and to the brighter hemisphere."""

    key: Sequence[float]
    up: Sequence[float]

    @classmethod
    def of(cls, world_from_camera: FloatArray) -> Light:
        """The light that goes with a camera, from its matrix (4, 4): x left, y up, z forward."""
        left, up, forward = (axis / np.linalg.norm(axis) for axis in world_from_camera[:3, :3].T)
        key = np.stack([-left, up, -forward], axis=1) @ _TO_KEY
        return cls(key.tolist(), up.tolist())

    def on(
        self, color: Any, normal: Any, eye: Any, glossy: Any, visible: Any, reached: Any = 1.0
    ) -> Any:
        """Radiance towards the eye; all are Dr.Jit arrays.

        color: reflectance. normal, eye: unit, on the same side. glossy: mask. visible: the part
        of the hemisphere over the normal that nothing near hides, and reached: the part of the
        key light that is not in shadow, in [0, 1].
        """
        key, up = _parameter(normal, self.key), _parameter(normal, self.up)
        wrapped = dr.clip((dr.dot(normal, key) + _WRAP) / (1 + _WRAP), 0, 1)
        shown = (1 - _KEY_HIDDEN * (1 - visible)) * reached
        share = 0.5 + 0.5 * dr.dot(normal, up)
        sky = dr.lerp(_like(color, _BELOW), _like(color, _ABOVE), share) * visible
        radiance = color * (_like(color, _KEY) * (wrapped * shown) + sky)
        half = dr.normalize(key + eye)
        # Where the light is below the horizon there is no highlight, and no edge to it either.
        spot = _HIGHLIGHT * dr.power(dr.maximum(dr.dot(normal, half), 0), _SHARPNESS)
        rim = _RIM * dr.power(1 - dr.clip(dr.dot(normal, eye), 0, 1), 5)
        gloss = _like(color, _KEY) * (spot * wrapped * shown) + sky * rim
        return radiance + dr.select(glossy, gloss, 0)


def reflectance(color: Any, painted: Any) -> Any:
    """What a surface is drawn in, from the reflectance that its BSDF reports straight on.

    painted: mask of lines, which are of that reflectance, and black where it is 0.
    """
    own = color
    top = dr.max(color)
    metal = dr.square(color / top) * _METAL  # what is seen in a mirror has met it more than once
    color = dr.select(top > 1, metal, color)
    return dr.select(painted, own, dr.select(top > 0, color, _like(color, _CLEAR)))


def of_side(color: Any, other: Any, inside: Any) -> Any:
    """The color of a side: that of larger values is darker and cooler if the other is as it.

    inside: mask of what is seen from the side of larger values.
    """
    same = dr.max(dr.abs(color - other)) < 1e-4
    return dr.select(inside & same, color * _like(color, _INSIDE), color)


def of_mended(color: Any, mended: Any) -> Any:
    """The color, tinted where a level set spans what a mesh leaves open."""
    tint = dr.select(color[0] > 1.6 * color[2], _like(color, _TEAL), _like(color, _AMBER))
    return dr.select(mended, dr.lerp(color, tint, _MENDED), color)


def _parameter(array: Any, numbers: Sequence[float]) -> Any:
    """Numbers as a vector of the kind of another, which no kernel is compiled anew for."""
    vector = _like(array, numbers)
    dr.make_opaque(vector)
    return vector


def _like(array: Any, numbers: Sequence[float]) -> Any:
    """Numbers as an array of the kind of another."""
    return type(array)(*numbers)
