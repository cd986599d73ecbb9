"""Scenes of the gallery: curves, harmonic polynomials, periodic surfaces, and functions of the
plane. Each function here makes the surfaces of a scene (a list of `Surface`). The solid angle of a
closed curve, a function of space, has level sets that span the curve.

A function of the plane gives a Riemann surface (Fig. 19 of Gillespie et al. 2024), level curves or
a height field.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harnack.arithmetic import cos, exp, sin
from harnack.backend import FloatArray
from harnack.fields import Field
from harnack.fields.analytic.fourier_series import FourierSeries
from harnack.fields.analytic.hyperspherical import HypersphericalHarmonic
from harnack.fields.analytic.lobes import Lobes
from harnack.fields.analytic.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from harnack.fields.analytic.plane import HeightField, LevelCurves
from harnack.fields.analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from harnack.fields.analytic.riemann_surface import RiemannSurface
from harnack.fields.analytic.waves import WaveProduct, sine_factor
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.gallery.scene import Scene
from harnack.geometry import Ball, Box, HalfSpace, Volume, example_curves
from harnack.rendering import Camera
from harnack.tracer import Surface


def _curve(loops: Any, level: Any = None, **settings: Any) -> list[Surface]:
    """Return a surface that spans closed curves: a level set of their solid angle. loops: the
    vertices (n, 3) of a curve, or a list of such arrays. level: the level; None for the default.
    settings: keywords of `Surface`."""
    return [Surface(SolidAngle(loops), level, **settings)]


def _levels() -> list[Surface]:
    """Return five level sets of the solid angle of one polygon, cut by a half-space."""
    cut = HalfSpace((0.5, -0.9, 0.0), 0.0)
    levels = [k * math.pi for k in (1.0, 1.5, 2.0, 2.5, 3.0)]
    return _curve(example_curves.wavy_polygon(48), levels, clip=cut)


def _holes() -> list[Surface]:
    """Return a surface spanned by a square with three holes. The curves are bent like a sheet in
    the wind, so that no plane contains them."""
    # The square comes first; each hole has 24 vertices.
    edge, *holes = example_curves.square_with_holes(24)
    s = np.linspace(0, 1, 10, endpoint=False)[:, None]
    # Ten points on each side of the square, so that it can be bent.
    fine = [(1 - s) * a + s * b for a, b in zip(edge, np.roll(edge, -1, axis=0), strict=True)]
    return _curve([_on_wave(loop) for loop in (np.concatenate(fine), *holes)])


def _on_wave(loop: FloatArray) -> FloatArray:
    """Return the points (n, 3) of a loop moved vertically onto a wavy surface."""
    x, y, _ = loop.T
    return np.column_stack([x, y, 0.25 * np.sin(2.2 * x) + 0.2 * np.cos(2.0 * y)])


def _periodic(kind: Any, half_wall: float, *, box: bool = False) -> list[Surface]:
    """Return a wall: the solid between the levels -half_wall and half_wall of a periodic function.

    kind: the class of the function.
    box: whether it is cut to a box; otherwise to a ball.
    """
    domain = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)) if box else Ball(radius=1.0)
    # The first argument is the period along each axis.
    return [Surface(kind(1.0, domain=domain), (-half_wall, half_wall), side="between")]


def _golden_gyroid() -> list[Surface]:
    """Return the half of space in which the gyroid's function is negative, cut to a box."""
    domain = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    return [Surface(Gyroid(1.0, domain=domain), 0.0, side="below")]


def _eigenfunctions() -> list[Surface]:
    """Return the solid in which a sum of two Laplacian eigenfunctions is at least 1/2 (Fig. 21 of
    Gillespie et al. 2024)."""
    terms = [
        WaveProduct(1.0, x=sine_factor(k), y=sine_factor(k), z=sine_factor(k)) for k in (6.0, 2.0)
    ]
    end = math.pi / 2
    domain = Box((-end, -end, -end), (end, end, end))
    return [Surface(EigenfunctionSum(terms, domain=domain), 0.5, side="above")]


def _harmonic(field: Field) -> list[Surface]:
    """Return a scene of one surface: the field's default level set."""
    return [Surface(field)]


def _on_the_sphere(field: HypersphericalHarmonic, level: float) -> list[Surface]:
    """Return the level sets -level and level of a function on the sphere S^3, projected to space.
    Both are bounded, so that nothing is clipped."""
    return [Surface(field, [-level, level])]


def _lobes() -> list[Surface]:
    """Return the lobes of the spherical harmonic with l = 3, m = 2 as two solids: the lobes on
    which it is positive, and the lobes on which it is negative."""
    lobes = Lobes(3, 2)
    return [Surface(part, 0.0, side="below") for part in (lobes.positive, lobes.negative)]


def _quartic() -> list[Surface]:
    """Return level sets of x^3 y + x y^3 - 3 x y (w^2 + z^2) on the sphere S^3 (Gillespie et al.
    2024, Appendix E.2). On the sphere it equals x y (4 (x^2 + y^2) - 3), hence is at most 1/2."""
    terms = {(3, 1, 0, 0): 1.0, (1, 3, 0, 0): 1.0, (1, 1, 0, 2): -3.0, (1, 1, 2, 0): -3.0}
    return _on_the_sphere(HypersphericalHarmonic.from_polynomial(terms), 0.15)


def _fitted_knot() -> list[Surface]:
    """Return a solid around a trefoil knot. Its field is a sum of Gaussians along the knot,
    approximated by a series of 16 x 16 x 9 cosines."""
    # The trefoil is the (2, 3) torus knot, here of 150 vertices.
    curve = example_curves.torus_knot(2, 3, 150)
    # The lengths of the curve's edges are the weights of the sum.
    edge_lengths = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
    # The Gaussians' width.
    width = 0.15 * float(np.ptp(curve, axis=0).max()) / 2

    def density(x: FloatArray) -> FloatArray:
        """Return the sum of Gaussians (n,) at points x (n, 3): the integral over the curve of a
        Gaussian of the distance to x. It is divided by the integral for a straight line through x,
        so that it is about 1 on the curve."""
        # In batches, as the array of all distances would take much memory.
        sums = [
            np.exp(-((batch[:, None] - curve) ** 2).sum(axis=2) / width**2) @ edge_lengths
            for batch in np.array_split(x, len(x) // 4000 + 1)
        ]
        return np.concatenate(sums) / (width * math.sqrt(math.pi))

    # Beyond 2.6 widths a Gaussian is below 0.002.
    low, high = curve.min(axis=0) - 2.6 * width, curve.max(axis=0) + 2.6 * width
    box = low.tolist(), high.tolist()
    series = FourierSeries.fit(density, box, (16, 16, 9), samples=(48, 48, 28))
    return [Surface(series, 0.4, side="above")]


CURVES = (
    Scene(
        "polygon",
        "a nonplanar polygon",
        lambda: _curve(example_curves.wavy_polygon(64)),
        demo_spp=36,
    ),
    Scene(
        "levels",
        "five level sets of a nonplanar polygon, cut open",
        _levels,
        camera=Camera(azimuth=-62, elevation=24),
        demo_spp=25,
    ),
    Scene(
        "evaluations",
        "evaluations a ray, as the paper's Fig. 22",
        lambda: _curve(example_curves.wavy_polygon(64)),
        show="evaluations",
        demo_spp=1,
    ),
    Scene(
        "trefoil",
        "a Seifert surface of the trefoil knot",
        lambda: _curve(example_curves.torus_knot(2, 3, 96)),
        camera=Camera(azimuth=-80, elevation=52),
        demo_spp=25,
    ),
    Scene(
        "figure-eight",
        "a Seifert surface of the figure-eight knot",
        lambda: _curve(example_curves.figure_eight_knot(120)),
        camera=Camera(elevation=48),
    ),
    Scene(
        "hopf",
        "a Seifert surface of the Hopf link",
        lambda: _curve(example_curves.hopf_link(48)),
        demo_spp=25,
    ),
    Scene(
        "borromean",
        "a Seifert surface of the Borromean rings",
        lambda: _curve(example_curves.borromean_rings(48)),
    ),
    Scene(
        "holes",
        "a polygon with holes",
        _holes,
        ("plastic",),
        Camera(azimuth=-50, elevation=42),
        demo_spp=25,
    ),
    Scene("coil", "a coil of five turns", lambda: _curve(example_curves.coil(5, 160)), ("copper",)),
)

HARMONICS = (
    Scene(
        "harmonic",
        "level set of a spherical harmonic, l = 5, m = 3",
        lambda: _harmonic(SphericalHarmonic(5, 3)),
        demo_spp=36,
    ),
    Scene(
        "polynomial",
        "the harmonic polynomial of the paper's Eq. 8",
        lambda: _harmonic(HarmonicPolynomial({(2, 1, 0): 1.0, (0, 1, 2): -1.0})),
    ),
    Scene(
        "hyperspherical",
        "a quartic on the sphere S^3, projected: levels of both signs, unclipped",
        _quartic,
        camera=Camera(azimuth=-35, elevation=22),
        demo_spp=25,
    ),
    Scene(
        "hyperspherical-sextic",
        "a hyperspherical harmonic of degree 6 (j = 4, m = 3)",
        lambda: _on_the_sphere(HypersphericalHarmonic(6, 4, 3), 0.3),
        camera=Camera(elevation=48),
    ),
    Scene(
        "orbital",
        "lobes of a spherical harmonic, l = 3, m = 2, and their signs",
        _lobes,
        ("plastic", "porcelain"),
        demo_spp=36,
    ),
)

SOLIDS = (
    Scene(
        "gyroid",
        "a gyroid wall in glass, cut to a ball",
        lambda: _periodic(Gyroid, 0.35),
        ("glass",),
        demo_spp=144,
    ),
    Scene(
        "gyroid-gold",
        "half of space behind the gyroid in gold, cut to a box",
        _golden_gyroid,
        ("gold",),
        demo_spp=64,
    ),
    Scene(
        "schwarz-p",
        "Schwarz's primitive surface as a wall, cut to a box",
        lambda: _periodic(SchwarzP, 0.25, box=True),
        ("porcelain",),
    ),
    Scene(
        "schwarz-d",
        "Schwarz's diamond surface as a wall, cut to a ball",
        lambda: _periodic(SchwarzD, 0.15),
        ("copper",),
    ),
    Scene(
        "eigenfunctions",
        "a sum of Laplacian eigenfunctions (the paper's Fig. 21)",
        _eigenfunctions,
        ("clay",),
    ),
    Scene(
        "fourier",
        "a knot of Gaussians by a Fourier series fitted to it",
        _fitted_knot,
        ("clay",),
        Camera(azimuth=-80, elevation=52),
        show="shaded",
        demo_spp=4,
    ),
)


# Over the plane.


def _surface(function: Any, part: str = "imag", **settings: Any) -> list[Surface]:
    """Return the Riemann surface of a function. function: its name, such as "log". part: "real" or
    "imag", the part of the function that is the height. settings: options of `RiemannSurface`."""
    return [Surface(RiemannSurface(function, part, **settings))]


def _elliptic(domain: Volume) -> list[Surface]:
    """Return the Riemann surface of sqrt(z^3 - z), cut to `domain`: a torus without its points at
    infinity."""
    return _surface("sqrt", argument={0: 1, 1: 1, -1: 1}, height=0.6, domain=domain)


def _lemniscates() -> list[Surface]:
    """Return level curves of the potential of three line charges, as vertical walls."""
    triangle = {complex(math.cos(a), math.sin(a)): 1 for a in (0.5 * math.pi, 3.7, 5.8)}
    field = LevelCurves("log", argument=triangle, domain=Box((-2.2, -2.2, -0.2), (2.2, 2.2, 0.2)))
    return [Surface(field, [-1.2, -0.6, 0.0, 0.6, 1.2, 1.8])]


def _field_lines() -> list[Surface]:
    """Return field lines of two opposite line charges, as vertical walls: the level curves of the
    conjugate of the potential."""
    field = LevelCurves("log", "imag", argument={1: 1, -1: -1})
    return [Surface(field, [k * math.pi / 6 for k in range(12)])]


def _ripples() -> list[Surface]:
    """Return the graph of a function of x and y that looks like ripples on water."""
    field = HeightField(
        lambda x, y: exp(-(x**2 + y**2) * 1.5) * sin(x * 5 + cos(y * 4)) * 0.6,
        domain=Box((-1.5, -1.5, -1.0), (1.5, 1.5, 1.0)),
    )
    return [Surface(field)]


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
