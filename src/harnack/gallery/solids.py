"""Scenes of solids: distance surfaces, what is made of them, noise, and blobs to look through."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Solid
from harnack.fields.blobs.blobs import Blobs
from harnack.fields.blobs.kernels import Compact
from harnack.fields.curves.solid_angle import SolidAngle
from harnack.fields.solids.combined import union
from harnack.fields.solids.fractal import Displaced, FractalNoise
from harnack.fields.solids.julia import Julia
from harnack.fields.solids.region import solid
from harnack.fields.solids.round import Sphere, Torus
from harnack.fields.solids.tube import Tube
from harnack.fields.waves.periodic import Gyroid
from harnack.gallery.scene import DRAWN, Scene
from harnack.geometry import shapes
from harnack.rendering import Camera
from harnack.tracer import LevelSet, level_set


def _drawn(*solids: Solid) -> list[LevelSet]:
    return [level_set(one, tolerance=DRAWN) for one in solids]


def _carved() -> list[LevelSet]:
    """A ball with a torus cut out, twisted, and a ring blended to it."""
    ball = (Sphere(1.0) - Torus(0.85, 0.28)).twisted(1.5, "x")
    return _drawn(ball.blended(Torus(1.15, 0.12), 0.15))


def _tori() -> list[LevelSet]:
    """Two tori of radii 1 and 0.1 blended with (power, radius) = (2, 0.5), (8, 0.5), (8, 0.2)."""
    link = Torus(1.0, 0.1).rotated(90, "x")
    pairs = [Torus(1.0, 0.1).blended(link, r, power=p) for p, r in ((2, 0.5), (8, 0.5), (8, 0.2))]
    return _drawn(*(one.moved((0.0, 2.4 * k, 0.0)) for k, one in enumerate(pairs)))


# Cubic Bezier curves in the plane of the page, letter by letter: "harnack".
_LETTERS: tuple[tuple[float, tuple[tuple[float, ...], ...]], ...] = (
    (0.0, ((0, 2, 0, 1.3, 0, 0.7, 0, 0), (0, 0.6, 0.1, 1.3, 0.9, 1.3, 0.9, 0.6),
           (0.9, 0.6, 0.9, 0.4, 0.9, 0.2, 0.9, 0))),
    (1.5, ((0.9, 1.0, 0.5, 1.3, 0, 1.1, 0, 0.55), (0, 0.55, 0, -0.1, 0.6, -0.1, 0.9, 0.4),
           (0.9, 1.1, 0.9, 0.8, 0.9, 0.3, 1.0, 0))),
    (3.1, ((0, 1.1, 0, 0.8, 0, 0.4, 0, 0), (0, 0.6, 0.1, 1.1, 0.4, 1.2, 0.7, 1.05))),
    (4.2, ((0, 1.1, 0, 0.8, 0, 0.4, 0, 0), (0, 0.6, 0.1, 1.3, 0.9, 1.3, 0.9, 0.6),
           (0.9, 0.6, 0.9, 0.4, 0.9, 0.2, 0.9, 0))),
    (5.7, ((0.9, 1.0, 0.5, 1.3, 0, 1.1, 0, 0.55), (0, 0.55, 0, -0.1, 0.6, -0.1, 0.9, 0.4),
           (0.9, 1.1, 0.9, 0.8, 0.9, 0.3, 1.0, 0))),
    (7.2, ((0.85, 0.95, 0.5, 1.3, 0, 1.1, 0, 0.55), (0, 0.55, 0, -0.05, 0.5, -0.15, 0.85, 0.2))),
    (8.6, ((0, 2, 0, 1.3, 0, 0.7, 0, 0), (0.8, 1.15, 0.5, 0.9, 0.3, 0.75, 0, 0.55),
           (0.25, 0.7, 0.5, 0.5, 0.65, 0.25, 0.9, 0))),
)  # fmt: skip


def _letters() -> list[LevelSet]:
    """Tubes around 19 cubic Bezier curves."""
    tubes: list[Solid] = []
    for start, curves in _LETTERS:
        for curve in curves:
            x, z = np.reshape(curve, (4, 2)).T
            controls = np.column_stack([x + start - 4.7, 0.25 * np.sin(x + start), z - 1.0])
            tubes.append(Tube.bezier(controls, 0.13, tolerance=2e-3))
    return _drawn(union(*tubes))


def _lava() -> list[LevelSet]:
    noise = FractalNoise(6, beta=1.0, frequency=1.6, amplitude=0.55, seed=4)
    return _drawn(Displaced(Sphere(1.0), noise))


def _lattice() -> list[LevelSet]:
    return _drawn(solid(Gyroid(0.5), between=(-0.4, 0.4)) & Torus(0.8, 0.4))


def _knot() -> list[LevelSet]:
    """A thick Seifert surface of the trefoil knot, and a tube around the knot itself."""
    curve: FloatArray = shapes.torus_knot(2, 3, 120)
    surface = solid(SolidAngle(curve), around=(2 * math.pi, 0.12))
    return _drawn(surface, Tube(np.concatenate([curve, curve[:1]]), 0.09))


def _jelly() -> list[LevelSet]:
    rng = np.random.default_rng(8)
    blobs: Any = Blobs(rng.normal(size=(14, 3)) * 0.55, 0.55, kernel=Compact(1.7))
    return [level_set(blobs, solid=(1.0, math.inf), tolerance=DRAWN)]


SHAPES = (
    Scene(
        "carved",
        "a ball, a torus cut out, twisted, and a ring blended to it",
        _carved,
        ("clay",),
        Camera(azimuth=-55, elevation=28),
        demo_spp=25,
    ),
    Scene(
        "blended-tori",
        "two tori blended by superellipses (Hart 1996, Fig. 8)",
        _tori,
        ("copper", "porcelain", "plastic"),
        Camera(azimuth=20, elevation=32),
    ),
    Scene(
        "letters",
        "tubes around cubic Bezier curves (after Hart 1996, Fig. 9)",
        _letters,
        ("gold",),
        Camera(azimuth=-80, elevation=12),
    ),
    Scene(
        "lava",
        "a ball displaced by six octaves of noise (after Hart 1996, Fig. 11)",
        _lava,
        ("clay",),
    ),
    Scene("julia", "a quaternion Julia set", lambda: _drawn(Julia()), ("two-tone",)),
    Scene(
        "lattice",
        "a gyroid wall cut by a torus",
        _lattice,
        ("copper",),
        Camera(elevation=38),
        demo_spp=25,
    ),
    Scene(
        "knot-tube",
        "a thick Seifert surface of the trefoil knot, and a tube around the knot",
        _knot,
        ("two-tone", "gold"),
        Camera(elevation=48),
    ),
    Scene(
        "jelly",
        "blobs to look through",
        _jelly,
        ("jelly",),
        show="shaded",
    ),
)
