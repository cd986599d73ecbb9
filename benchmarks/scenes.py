"""The measured fields, and the camera of all measurements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import harnack as hk
from harnack.geometry import example_curves

EYE = np.array([2.2, -2.2, 1.6])
FIELD_OF_VIEW = math.radians(40.0)


@dataclass(frozen=True)
class Scene:
    """A field of about unit size, made on demand, and its number of vertices (0: no curve)."""

    name: str
    make: Callable[[], hk.Field]
    vertices: int = 0


class WithoutExtent(hk.SolidAngle):
    """A curve without a bound of its surface's extent: rays are clipped at t_max alone, as in the
    published code."""

    def extent(self, levels):  # type: ignore[no-untyped-def]
        return None


def unit(loops):  # type: ignore[no-untyped-def]
    """Loops centered and scaled to fit the unit ball."""
    loops = loops if isinstance(loops, list) else [loops]
    points = np.concatenate(loops)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = np.linalg.norm(points - center, axis=1).max()
    return [(loop - center) / size for loop in loops]


def polygons() -> list[Scene]:
    """The curve (cos t, sin t, 0.45 cos 3t) with 12, 64 and 256 vertices."""
    return [
        Scene(f"polygon, N = {n}", lambda n=n: hk.SolidAngle(example_curves.wavy_polygon(n)), n)
        for n in (12, 64, 256)
    ]


def others() -> list[Scene]:
    """Knots, coils and links, and the real-valued fields."""
    return [
        Scene(
            "trefoil, N = 96", lambda: hk.SolidAngle(unit(example_curves.torus_knot(2, 3, 96))), 96
        ),
        Scene(
            "5-turn coil, N = 160", lambda: hk.SolidAngle(unit(example_curves.coil(5, 160))), 160
        ),
        Scene(
            "Hopf link, N = 2 x 48", lambda: hk.SolidAngle(unit(example_curves.hopf_link(48))), 96
        ),
        Scene("spherical harmonic l = 4, m = 2", lambda: hk.SphericalHarmonic(4, 2)),
        Scene("spherical harmonic l = 9, m = 5", lambda: hk.SphericalHarmonic(9, 5)),
        Scene("gyroid, 3 cells across", lambda: hk.Gyroid(cell=2 / 3, domain=hk.Ball(radius=1))),
    ]


def camera(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (width^2, 3) of a pinhole looking at the origin.

    Pixels come in tiles of 8 x 8, as a renderer would trace them.
    """
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    pixel = (2 * (np.arange(width) + 0.5) / width - 1) * math.tan(FIELD_OF_VIEW / 2)
    x, y = np.meshgrid(pixel, -pixel)
    d = forward + x[..., None] * right + y[..., None] * up
    tiles = d.reshape(width // 8, 8, width // 8, 8, 3).transpose(0, 2, 1, 3, 4).reshape(-1, 3)
    return EYE, tiles / np.linalg.norm(tiles, axis=1, keepdims=True)
