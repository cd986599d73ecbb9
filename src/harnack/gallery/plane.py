"""Scenes over the plane: Riemann surfaces (the paper's Fig. 19), level curves, height fields."""

from __future__ import annotations

import math
from typing import Any

from harnack.arithmetic import cos, exp, sin
from harnack.fields.plane.height_field import HeightField
from harnack.fields.plane.level_curves import LevelCurves
from harnack.fields.plane.riemann_surface import RiemannSurface
from harnack.gallery.scene import DRAWN, Scene
from harnack.geometry import Ball, Box, Volume
from harnack.rendering import Camera
from harnack.tracer import LevelSet, level_set


def _surface(function: Any, part: str = "imag", **settings: Any) -> list[LevelSet]:
    return [level_set(RiemannSurface(function, part, **settings), tolerance=DRAWN)]


def _elliptic(domain: Volume) -> list[LevelSet]:
    """sqrt(z^3 - z): a torus less its points at infinity."""
    return _surface("sqrt", of={0: 1, 1: 1, -1: 1}, height=0.6, domain=domain)


def _lemniscates() -> list[LevelSet]:
    """Level curves of the potential of three line charges."""
    triangle = {complex(math.cos(a), math.sin(a)): 1 for a in (0.5 * math.pi, 3.7, 5.8)}
    field = LevelCurves("log", of=triangle, domain=Box((-2.2, -2.2, -0.2), (2.2, 2.2, 0.2)))
    return [level_set(field, [-1.2, -0.6, 0.0, 0.6, 1.2, 1.8], tolerance=DRAWN)]


def _field_lines() -> list[LevelSet]:
    """Field lines of a charge and its opposite: level curves of the conjugate function."""
    field = LevelCurves("log", "imag", of={1: 1, -1: -1})
    return [level_set(field, [k * math.pi / 6 for k in range(12)], tolerance=DRAWN)]


def _ripples() -> list[LevelSet]:
    field = HeightField(
        lambda x, y: exp(-(x**2 + y**2) * 1.5) * sin(x * 5 + cos(y * 4)) * 0.6,
        domain=Box((-1.5, -1.5, -1.0), (1.5, 1.5, 1.0)),
    )
    return [level_set(field, tolerance=DRAWN)]


PLANE = (
    Scene(
        "riemann-log",
        "the Riemann surface of log z, cut to a ball (the paper's Fig. 19)",
        lambda: _surface("log", domain=Ball(radius=7.0)),
        camera=Camera(azimuth=-60, elevation=18),
        demo_spp=25,
    ),
    Scene(
        "riemann-sqrt",
        "the Riemann surface of the square root, in the unit ball (Fig. 19)",
        lambda: _surface("sqrt"),
        camera=Camera(azimuth=-60, elevation=24),
        demo_spp=25,
    ),
    Scene(
        "riemann-cbrt",
        "the Riemann surface of the cube root, in the unit ball (Fig. 19)",
        lambda: _surface("cbrt"),
        camera=Camera(azimuth=-60, elevation=24),
    ),
    Scene(
        "riemann-asin",
        "the Riemann surface of arc sine, its real part, cut to a ball (Fig. 19)",
        lambda: _surface("asin", "real", domain=Ball(radius=6.0)),
        camera=Camera(azimuth=-70, elevation=14),
        demo_spp=25,
    ),
    Scene(
        "riemann-elliptic",
        "the Riemann surface of sqrt(z^3 - z)",
        lambda: _elliptic(Ball(radius=2.0)),
        camera=Camera(azimuth=-60, elevation=28),
    ),
    Scene(
        "riemann-log-open",
        "the Riemann surface of log z, without an end in the picture",
        lambda: _surface("log", domain=Ball(radius=30.0)),
        camera=Camera(azimuth=-60, elevation=9, zoom=1.7),
    ),
    Scene(
        "riemann-sqrt-open",
        "the Riemann surface of the square root, without an end in the picture",
        lambda: _surface("sqrt", domain=Ball(radius=6.0)),
        camera=Camera(azimuth=-60, elevation=24, zoom=2.2),
    ),
    Scene(
        "lemniscates",
        "level curves of a harmonic function of the plane, as walls",
        _lemniscates,
        camera=Camera(azimuth=-65, elevation=48),
    ),
    Scene(
        "field-lines",
        "level curves of an angle-valued harmonic function of the plane, as walls",
        _field_lines,
        camera=Camera(azimuth=-65, elevation=52),
    ),
    Scene(
        "ripples",
        "a height field over the plane",
        _ripples,
        ("porcelain",),
        Camera(azimuth=-55, elevation=34),
    ),
)
