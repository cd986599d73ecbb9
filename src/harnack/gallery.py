"""Named scenes, shared by the command line, the docs and the tests. No numerics.

A scene is data: fields, levels, materials and a camera. `Scene.render` hands them to the renderer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from harnack.fields import (
    DipolePotential,
    EigenfunctionSum,
    Field,
    Gyroid,
    HarmonicPolynomial,
    Product,
    SchwarzD,
    SchwarzP,
    SolidAngle,
    SphericalHarmonic,
    WindingNumber,
    sine,
)
from harnack.geometry import Ball, Box, HalfSpace, mesh_shapes, shapes
from harnack.rendering import Camera, render
from harnack.tracer import LevelSet, Tolerance, level_set

Surfaces = Callable[[], "list[LevelSet]"]

# Fine enough that no pixel of a demo picture shows it, coarse enough for shadow rays to be quick.
_DRAWN = Tolerance(2e-4)


@dataclass(frozen=True)
class Scene:
    """A picture waiting to be made.

    surfaces: makes the level sets; materials: one name for each of them (or one for all).
    demo_spp: samples a pixel in `make demo`, 0 for not in it; few, to keep it to a few minutes.
    """

    name: str
    title: str
    surfaces: Surfaces
    materials: tuple[str, ...] = ("two-tone",)
    camera: Camera = field(default_factory=Camera)
    show: str = "color"
    demo_spp: int = 0

    def render(self, path: Any = None, **settings: Any) -> Any:
        """The picture, as `harnack.rendering` makes it; settings override the scene's own."""
        surfaces = self.surfaces()
        names = self.materials * len(surfaces) if len(self.materials) == 1 else self.materials
        chosen: dict[str, Any] = {
            "material": list(names), "camera": self.camera, "show": self.show, **settings,
        }  # fmt: skip
        return render(surfaces, path, **chosen)


def _curve(loops: Any, level: Any = None, **settings: Any) -> list[LevelSet]:
    return [level_set(SolidAngle(loops), level, tolerance=_DRAWN, **settings)]


def _levels() -> list[LevelSet]:
    """Five levels of one polygon, cut open."""
    cut = HalfSpace((0.5, -0.9, 0.0), 0.0)
    levels = [k * math.pi for k in (1.0, 1.5, 2.0, 2.5, 3.0)]
    return _curve(shapes.wavy_polygon(48), levels, clip=cut)


def _holes() -> list[LevelSet]:
    """A square with three holes, bent like a sheet in the wind so that no plane contains it."""
    loops: list[Any] = []
    for loop in shapes.square_with_holes(24):
        x, y, _ = loop.T
        loops.append(np.column_stack([x, y, 0.25 * np.sin(2.2 * x) + 0.2 * np.cos(2.0 * y)]))
    edge = loops[0]
    s = np.linspace(0, 1, 10, endpoint=False)[:, None]
    fine = [(1 - s) * a + s * b for a, b in zip(edge, np.roll(edge, -1, axis=0), strict=True)]
    outer = np.concatenate(fine)
    outer[:, 2] = 0.25 * np.sin(2.2 * outer[:, 0]) + 0.2 * np.cos(2.0 * outer[:, 1])
    return _curve([outer, *loops[1:]])


def _periodic(kind: Any, *, solid: tuple[float, float], box: bool = False) -> list[LevelSet]:
    domain = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)) if box else Ball(radius=1.0)
    return [level_set(kind(1.0, domain=domain), solid=solid, tolerance=_DRAWN)]


def _eigenfunctions() -> list[LevelSet]:
    """The paper's Fig. 21: the 1/2 level of a sum of two eigenfunctions."""
    terms = [Product(1.0, x=sine(k), y=sine(k), z=sine(k)) for k in (6.0, 2.0)]
    side = math.pi / 2
    domain = Box((-side, -side, -side), (side, side, side))
    solid = (0.5, math.inf)
    return [level_set(EigenfunctionSum(terms, domain=domain), solid=solid, tolerance=_DRAWN)]


def _harmonic(field: Field) -> list[LevelSet]:
    return [level_set(field, tolerance=_DRAWN)]


def _cut_mesh() -> list[LevelSet]:
    """A bumpy sphere with round holes cut into it."""
    vertices, faces = mesh_shapes.bumpy_sphere(4)
    middles = vertices[faces].mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    holes = np.random.default_rng(3).normal(size=(8, 3))
    holes /= np.linalg.norm(holes, axis=1, keepdims=True)
    whole = (middles @ holes.T < math.cos(0.26)).all(axis=1)
    return [level_set(WindingNumber(vertices, faces[whole]), tolerance=_DRAWN)]


def _soup() -> list[LevelSet]:
    """Loose triangles: every one shrunk about its middle, a tenth of them missing."""
    vertices, faces = mesh_shapes.bumpy_sphere(3)
    faces = mesh_shapes.remove_faces(faces, 0.1, seed=1)
    corners = vertices[faces]
    middle = corners.mean(axis=1, keepdims=True)
    loose = (middle + 0.93 * (corners - middle)).reshape(-1, 3)
    field = WindingNumber(loose, np.arange(len(loose)).reshape(-1, 3), method="tree")
    return [level_set(field, tolerance=_DRAWN)]


def _cloud() -> list[LevelSet]:
    """Oriented points on a bumpy sphere, and nothing else."""
    vertices, faces = mesh_shapes.bumpy_sphere(5)
    p, q, r = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(q - p, r - p)
    chosen = np.random.default_rng(2).choice(len(faces), 4000, replace=False)
    points = (p + q + r)[chosen] / 3
    return [level_set(DipolePotential(points, normals[chosen]), tolerance=_DRAWN)]


def _knot_cloud() -> list[LevelSet]:
    """Oriented points on a tube around a trefoil."""
    curve = shapes.torus_knot(2, 3, 240)
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    u = np.cross(along, (0.0, 0.0, 1.0))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    turn = np.linspace(0, 2 * math.pi, 24, endpoint=False)[None, :, None]
    normals = np.cos(turn) * u[:, None] + np.sin(turn) * v[:, None]
    radius = 0.09 * float(np.ptp(curve))
    points = curve[:, None] + radius * normals
    field = DipolePotential(points.reshape(-1, 3), normals.reshape(-1, 3))
    return [level_set(field, tolerance=_DRAWN)]


_CURVES = (
    Scene(
        "polygon",
        "a nonplanar polygon",
        lambda: _curve(shapes.wavy_polygon(64)),
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
        lambda: _curve(shapes.wavy_polygon(64)),
        show="evaluations",
        demo_spp=1,
    ),
    Scene(
        "trefoil",
        "a Seifert surface of the trefoil knot",
        lambda: _curve(shapes.torus_knot(2, 3, 96)),
        camera=Camera(azimuth=-80, elevation=52),
        demo_spp=25,
    ),
    Scene(
        "figure-eight",
        "a Seifert surface of the figure-eight knot",
        lambda: _curve(shapes.figure_eight_knot(120)),
        camera=Camera(elevation=48),
    ),
    Scene(
        "hopf",
        "a Seifert surface of the Hopf link",
        lambda: _curve(shapes.hopf_link(48)),
        demo_spp=25,
    ),
    Scene(
        "borromean",
        "a Seifert surface of the Borromean rings",
        lambda: _curve(shapes.borromean_rings(48)),
    ),
    Scene(
        "holes",
        "a polygon with holes",
        _holes,
        ("plastic",),
        Camera(azimuth=-50, elevation=42),
        demo_spp=25,
    ),
    Scene("coil", "a coil of five turns", lambda: _curve(shapes.coil(5, 160)), ("copper",)),
)

_HARMONICS = (
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
)

_SOLIDS = (
    Scene(
        "gyroid",
        "a gyroid wall in glass, cut to a ball",
        lambda: _periodic(Gyroid, solid=(-0.35, 0.35)),
        ("glass",),
        demo_spp=144,
    ),
    Scene(
        "gyroid-gold",
        "half of space behind the gyroid in gold, cut to a box",
        lambda: _periodic(Gyroid, solid=(-math.inf, 0.0), box=True),
        ("gold",),
        demo_spp=64,
    ),
    Scene(
        "schwarz-p",
        "Schwarz's primitive surface as a wall, cut to a box",
        lambda: _periodic(SchwarzP, solid=(-0.25, 0.25), box=True),
        ("porcelain",),
    ),
    Scene(
        "schwarz-d",
        "Schwarz's diamond surface as a wall, cut to a ball",
        lambda: _periodic(SchwarzD, solid=(-0.15, 0.15)),
        ("copper",),
    ),
    Scene(
        "eigenfunctions",
        "a sum of Laplacian eigenfunctions (the paper's Fig. 21)",
        _eigenfunctions,
        ("clay",),
    ),
)

# Most of these are drawn as normals: light paths through them take minutes on a CPU.
_MESHES = (
    Scene(
        "cut-mesh",
        "a mesh with holes, mended by its winding number",
        _cut_mesh,
        ("plastic",),
        demo_spp=4,
    ),
    Scene(
        "soup",
        "a soup of loose triangles, mended by its winding number",
        _soup,
        ("clay",),
        show="normal",
        demo_spp=1,
    ),
    Scene(
        "cloud",
        "a surface through 4,000 oriented points",
        _cloud,
        ("porcelain",),
        show="normal",
        demo_spp=1,
    ),
    Scene(
        "knot-cloud",
        "a trefoil tube through 5,760 oriented points",
        _knot_cloud,
        ("copper",),
        Camera(azimuth=-80, elevation=52),
        show="normal",
        demo_spp=1,
    ),
)

SCENES: Mapping[str, Scene] = MappingProxyType(
    {scene.name: scene for scene in (*_CURVES, *_HARMONICS, *_SOLIDS, *_MESHES)}
)
"""All scenes by name."""
