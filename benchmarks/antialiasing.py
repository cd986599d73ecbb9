"""Error of shaded pictures against many rays a pixel, and their time, by the pixels chosen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import harnack as hk
from harnack.gallery import SCENES
from harnack.geometry import example_curves
from harnack.rendering import Camera, render
from harnack.rendering.images import tone_map
from harnack.rendering.shading import multijitter_offsets

_SIZE = (320, 240)
_REFERENCE, _ROUNDS = 100, 3
_WAYS = (("edges", 1), ("edges", 9), ("edges", 25), ("cones", 9), ("cones", 25))

Surfaces = Callable[[], "list[Any]"]
"""A function that returns fields, or harnack.Surface."""


def _wires() -> list[hk.Field]:
    """Three rings, each a tenth to a fifth of a pixel wide."""
    angle = np.linspace(0, 2 * math.pi, 61)
    return [
        hk.Tube(
            radius * np.column_stack([np.cos(angle), tilt * np.sin(angle),
                                      math.sqrt(1 - tilt**2) * np.sin(angle)]),
            1e-3,
        )
        for radius, tilt in ((1.0, 0.2), (0.8, -0.5), (0.9, 0.8))
    ]  # fmt: skip


def _scenes() -> dict[str, tuple[Surfaces, str, Camera, float]]:
    """Of each scene: its surfaces, their material, the camera, and the tolerance."""
    letters = SCENES["letters"]
    knot = hk.SolidAngle(example_curves.torus_knot(2, 3, 120))
    gyroid = hk.Gyroid(0.5, domain=hk.Ball(radius=1.0))
    carved = hk.Sphere(1.0) - hk.Torus(1.0, 0.25)
    wall = hk.Surface(gyroid, (-0.4, 0.4), side="between")
    letters_tolerance = letters.options.hit_tolerance
    assert letters_tolerance is not None
    return {
        "trefoil knot's surface": (lambda: [knot], "two-tone", Camera(elevation=48), 2e-4),
        "ball less a torus": (lambda: [carved], "clay", Camera(), 2e-4),
        "gyroid wall": (lambda: [wall], "copper", Camera(), 2e-4),
        "letters": (
            letters.surfaces, letters.materials[0], letters.camera, letters_tolerance.distance
        ),
        "wires": (_wires, "clay", Camera(), 1e-5),
    }  # fmt: skip


def _many_rays(surfaces: list[Any], material: str, camera: Camera, tolerance: float) -> np.ndarray:
    """The picture with the same rays in every pixel, without a choice of pixels.

    A picture that is `side` times as wide and high has them all, each in the middle of a pixel.
    """
    side = math.isqrt(len(multijitter_offsets(_REFERENCE)))
    large = (side * _SIZE[0], side * _SIZE[1])
    image = render(
        surfaces, show="shaded", size=large, material=material, camera=camera, spp=1,
        tolerance=tolerance, progress=False,
    )  # fmt: skip
    return image.reshape(_SIZE[1], side, _SIZE[0], side, 3).mean(axis=(1, 3))


def _error(image: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square error over all pixels and colors, in 255 steps of the displayed picture."""
    shown = (tone_map(pixels.astype(np.float32)).astype(float) for pixels in (image, reference))
    first, second = shown
    return float(np.sqrt(np.mean((first - second) ** 2)))


def antialiasing() -> str:
    """The section of the page."""
    lines = [
        "## Antialiasing of shaded pictures\n",
        f"Pictures of {_SIZE[0]} x {_SIZE[1]} against {_REFERENCE} rays in every pixel: the root "
        "mean square error in steps of the 8-bit picture, and the time of the whole picture, its "
        f"studio included (least of {_ROUNDS}). Pixels on edges that one ray a pixel shows get all "
        "samples; `antialias=\"cones\"` adds the pixels whose cone a surface covers in part (Hart "
        "1996, Section 3). Edges that a ray in the middle of a pixel tells are found either way; "
        "wires thinner than a pixel are found by cones alone.\n",
        "| scene | pixels chosen by | samples | RMS error | seconds | of one ray a pixel |",
        "|---|---|---:|---:|---:|---:|",
    ]  # fmt: skip
    for name, (make, material, camera, tolerance) in _scenes().items():
        surfaces = make()
        reference = _many_rays(surfaces, material, camera, tolerance)
        base = math.nan
        for antialias, spp in _WAYS:
            settings: dict[str, Any] = {
                "show": "shaded", "size": _SIZE, "material": material, "camera": camera,
                "spp": spp, "antialias": antialias, "tolerance": tolerance, "progress": False,
            }  # fmt: skip
            render(surfaces, **settings)  # compiles
            seconds: list[float] = []
            image = np.zeros(())
            for _ in range(_ROUNDS):
                start = time.perf_counter()
                image = render(surfaces, **settings)
                seconds.append(time.perf_counter() - start)
            fastest = min(seconds)
            base = fastest if spp == 1 else base
            lines.append(
                f"| {name} | {antialias if spp > 1 else ''} | {spp} "
                f"| {_error(image, reference):.2f} | {fastest:.2f} | {fastest / base:.2f} x |"
            )
    return "\n".join(lines) + "\n"
