"""The soft shadow on the studio's floor in shaded pictures: traced on a coarse grid, blurred."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, to_numpy
from harnack.backend.arrays import aligned
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.pictures.shading import Light
from harnack.rendering.studio.lighting import FLOOR

# Cells a side of a square of half this side, which holds what stands on the stage and its shadow.
_CELLS = 64
_REACH = 2.4
# Rays of a cell to the key light and to the sky. Each of 4 x 4 neighboring cells has others.
_RAYS = 8
_BLOCK = 4
# The tangent of the angle that the key light seems wide, and how far the rays look.
_SPREAD = 0.34
_FAR = 3.5
# Weights of a cell and its neighbors along each axis: a block's cells count nearly alike.
_BLUR = (0.05, 0.2, 0.25, 0.25, 0.2, 0.05)


class Casting(Protocol):
    """What casts shadows, such as a `World`."""

    @property
    def mi(self) -> Any: ...

    def occluded(self, ray: Any, active: Any) -> Any:
        """Whether rays of Mitsuba's meet anything."""
        ...


@dataclass(frozen=True)
class Floor:
    """What of the key light and of the sky reaches the floor: a texture of two channels."""

    mi: Any
    texture: Any

    @classmethod
    def of(cls, world: Casting, light: Light) -> Floor:
        """Traced in a studio."""
        mi = world.mi
        cell = (np.arange(_CELLS) + 0.5) / _CELLS * 2 * _REACH - _REACH
        y, x = np.meshgrid(cell, cell, indexing="ij")
        seen = _parts_seen(world, x, y, np.stack([_to_key(light.key), _to_sky()]))
        image = np.stack([_blurred(part) for part in seen], axis=-1)
        numbers = mi.Float(aligned(mitsuba_backend(mi), image.ravel()))
        tensor = mi.TensorXf(numbers, image.shape)
        return cls(mi, mi.Texture2f(tensor, wrap_mode=dr.WrapMode.Clamp))

    def at(self, position: Any) -> tuple[Any, Any]:
        """The parts of key light and sky that reach points of the floor; 1 for other points."""
        mi = self.mi
        on_floor = position.z < 0.5 * FLOOR
        place = mi.Point2f(position.x, position.y) / (2 * _REACH) + 0.5
        key, sky = self.texture.eval(dr.select(on_floor, place, 0))
        return dr.select(on_floor, key, 1), dr.select(on_floor, sky, 1)


def _parts_seen(world: Casting, x: FloatArray, y: FloatArray, towards: FloatArray) -> FloatArray:
    """What parts (k, n, n) of their directions (k, 16, rays, 3) points of the floor see free."""
    mi = world.mi
    j, i = np.indices(x.shape)
    d = towards[:, (j % _BLOCK) * _BLOCK + i % _BLOCK]
    o = np.stack([x, y, np.zeros_like(x)], axis=-1)[:, :, None]
    o = np.broadcast_to(o, d.shape)
    ray = mi.Ray3f(_vectors(mi.Point3f, o), _vectors(mi.Vector3f, d))
    ray.maxt = mi.Float(_FAR)
    free = to_numpy(~world.occluded(ray, mi.Bool(True)))
    parts: FloatArray = free.reshape(d.shape[:-1]).mean(axis=-1)
    return parts


def _vectors(kind: Any, rows: FloatArray) -> Any:
    return kind(np.ascontiguousarray(rows.reshape(-1, 3).T, dtype=np.float32))


def _square() -> FloatArray:
    """Places (16, rays, 2) in the unit square, spread evenly (Roberts 2018)."""
    k = np.arange(_BLOCK * _BLOCK * _RAYS)
    plastic = 1.32471795724474602596  # the real root of x^3 = x + 1
    places = np.mod(0.5 + np.outer(k, [1 / plastic, 1 / plastic**2]), 1.0)
    return places.reshape(_RAYS, _BLOCK * _BLOCK, 2).transpose(1, 0, 2)


def _to_key(key: Any) -> FloatArray:
    """Directions (16, rays, 3) to places on the round key light."""
    axis = np.asarray(key, dtype=np.float64)
    u = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u /= np.linalg.norm(u)
    radius, turn = _SPREAD * np.sqrt(_square()[..., :1]), 2 * math.pi * _square()[..., 1:]
    d = axis + radius * (np.cos(turn) * u + np.sin(turn) * np.cross(axis, u))
    d[..., 2] = np.maximum(d[..., 2], 0.05)  # the floor itself casts no shadow
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def _to_sky() -> FloatArray:
    """Directions (16, rays, 3) to the sky, distributed with the cosine."""
    s, turn = np.moveaxis(_square(), -1, 0)
    across = np.sqrt(s)
    return np.stack([across * np.cos(2 * math.pi * turn), across * np.sin(2 * math.pi * turn),
                     np.sqrt(np.maximum(1 - s, 1e-3))], axis=-1)  # fmt: skip


def _blurred(image: FloatArray) -> FloatArray:
    """The image (n, n) of what is free, on both axes; outside of it everything is."""
    kernel = np.convolve(_BLUR, [0.5, 0.5])  # of odd length: it stays in place
    for _ in range(2):
        rows = [np.convolve(row, kernel, mode="valid") for row in _framed(image, len(kernel) // 2)]
        image = np.array(rows).T
    return image


def _framed(image: FloatArray, width: int) -> FloatArray:
    return np.pad(image, ((0, 0), (width, width)), constant_values=1.0)
