"""Scenes of the gallery: blobs and solids. Each function here makes the surfaces of a scene.
"Blobs" are fields that are sums of bumps; the scenes are metaballs, a surface through points with
normals, and a molecule.

Solids are distance surfaces (level sets of distances), Boolean combinations of them, noise, and
transparent blobs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Field, Solid
from harnack.fields.analytic.periodic import Gyroid
from harnack.fields.blobs.blobs import Blobs, Molecule
from harnack.fields.blobs.hrbf import HRBF
from harnack.fields.blobs.kernels import CompactKernel
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.booleans import union
from harnack.fields.solids.fractal import DisplacedSolid, FractalNoise
from harnack.fields.solids.from_field import solid
from harnack.fields.solids.julia import Julia
from harnack.fields.solids.lattices import octet
from harnack.fields.solids.primitives import Cylinder, Sphere, Torus
from harnack.fields.solids.tube import Tube
from harnack.files import Atoms
from harnack.gallery.scene import Scene
from harnack.geometry import example_curves
from harnack.rendering import Camera
from harnack.tracer import Surface

_VAN_DER_WAALS = {"H": 1.2, "C": 1.7, "N": 1.55, "O": 1.52}


def _solid(field: Field, level: float) -> list[Surface]:
    """Return the solid of the points at which the field is at least `level`, as the only surface of
    a scene."""
    return [Surface(field, level, side="above")]


def _metaballs() -> list[Surface]:
    """Return metaballs: drops around a large ball, and a blob of negative weight that carves a bite
    out of it."""
    angle = np.linspace(0, 2 * math.pi, 9, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.35 * np.sin(3 * angle)])
    # The large ball, the nine drops, and the blob that carves.
    centers = np.concatenate([[[0.0, 0.0, 0.0]], 1.15 * ring, [[0.35, -0.55, 0.5]]])
    radii = np.concatenate([[0.72], 0.26 + 0.06 * np.cos(2 * angle), [0.42]])
    weights = np.array([1.0] * 10 + [-1.2])
    # A blob ends at 1.8 of its radius; the solid is where the sum is at least 1.
    return _solid(Blobs(centers, radii, weights, kernel=CompactKernel(1.8)), 1.0)


def _groups() -> list[Surface]:
    """Return two groups of blobs, each a ring. Blobs of one ring blend with each other; the two
    rings meet in creases."""
    angle = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    flat = np.column_stack([np.cos(angle) - 0.5, np.sin(angle), 0 * angle])
    upright = np.column_stack([np.cos(angle) + 0.5, 0 * angle, np.sin(angle)])
    centers = np.concatenate([flat, upright])
    # All blobs have the radius 0.3; the solid is where the sum of a group is at least 1.
    return _solid(Blobs(centers, 0.3, groups=[0] * 12 + [1] * 12), 1.0)


def _through_points() -> list[Surface]:
    """Return a surface through 18 points on a torus, with the torus's normals."""
    points, normals = [], []
    for j in range(6):
        for k in range(3):
            # The angles around the axis and around the tube; every other ring is turned by half a
            # step.
            u, v = 2 * math.pi * j / 6, 2 * math.pi * (k + 0.5 * (j % 2)) / 3
            radial = np.array([math.cos(u), math.sin(u), 0.0])
            normal = math.cos(v) * radial + math.sin(v) * np.array([0.0, 0.0, 1.0])
            points.append(radial + 0.42 * normal)
            normals.append(normal)
    return [Surface(HRBF(points, normals), 0.0, side="below")]


def _helix() -> Atoms:
    """Return the backbone of an alpha helix of 14 residues, with 3.6 residues per turn and a rise
    of 1.5 angstrom per residue. The cylindrical coordinates of its atoms (radius, angle in degrees,
    height) give bond lengths that are right within 0.05 angstrom."""
    backbone = (
        ("N", 1.55, -28.3, -0.89), ("C", 2.28, 0.0, 0.0), ("C", 1.68, 26.3, 1.13),
        ("O", 2.03, 21.9, 2.35), ("C", 3.30, -19.6, 0.75),
    )  # fmt: skip
    elements: list[str] = []
    positions: list[tuple[float, float, float]] = []
    for residue in range(14):
        for element, radius, degrees, height in backbone:
            # 100 degrees a residue: 3.6 residues a turn.
            angle = math.radians(degrees + 100.0 * residue)
            elements.append(element)
            positions.append(
                (
                    radius * math.cos(angle),
                    radius * math.sin(angle),
                    height + 1.5 * residue,
                )
            )
    radii = np.array([_VAN_DER_WAALS[element] for element in elements])
    return Atoms(np.array(positions), radii, tuple(elements), "an alpha helix")


BLOBS = (
    Scene(
        "metaballs",
        "metaballs, one of them carving",
        _metaballs,
        ("porcelain",),
        demo_spp=36,
    ),
    Scene(
        "metaball-groups",
        "two groups of metaballs: the largest of two sums",
        _groups,
        ("plastic",),
        Camera(azimuth=-50, elevation=30),
    ),
    Scene(
        "hermite",
        "a surface through 18 points with normals, of Hermite radial basis functions",
        _through_points,
        ("copper",),
        Camera(elevation=38),
    ),
    Scene(
        "helix",
        "an alpha helix, its atoms as Gaussians",
        lambda: _solid(Molecule(_helix(), sharpness=2.0), 1.0),
        ("clay",),
        Camera(elevation=12),
        demo_spp=25,
    ),
)


# Solids.


def _drawn(*solids: Solid) -> list[Surface]:
    """Return each of the solids as a surface of a scene."""
    return [Surface(solid) for solid in solids]


def _carved() -> list[Surface]:
    """Return a ball with a torus cut out, twisted, and a ring blended to it."""
    ball = (Sphere(1.0) - Torus(0.85, 0.28)).twisted(86.0, "x")
    return _drawn(ball.blended(Torus(1.15, 0.12), 0.15))


def _tori() -> list[Surface]:
    """Return three pairs of linked tori of radii 1 and 0.1, blended by superellipses of different
    power p and blend radius r: (p, r) = (2, 0.5), (8, 0.5) and (8, 0.2)."""
    link = Torus(1.0, 0.1).rotated(90, "x")
    pairs = [Torus(1.0, 0.1).blended(link, r, power=p) for p, r in ((2, 0.5), (8, 0.5), (8, 0.2))]
    return _drawn(*(pair.translated((0.0, 2.4 * k, 0.0)) for k, pair in enumerate(pairs)))


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


def _letters() -> list[Surface]:
    """Return a word of tubes around 19 cubic Bezier curves."""
    tubes: list[Solid] = []
    for start, curves in _LETTERS:
        for curve in curves:
            x, z = np.reshape(curve, (4, 2)).T
            # The word is moved to the origin, and bent like a wave along y.
            controls = np.column_stack([x + start - 4.7, 0.25 * np.sin(x + start), z - 1.0])
            tubes.append(Tube.bezier(controls, 0.13, tolerance=2e-3))
    return _drawn(union(*tubes))


def _lava() -> list[Surface]:
    """Return a ball displaced by fractal noise."""
    noise = FractalNoise(6, beta=1.0, frequency=1.6, amplitude=0.55, seed=4)
    return _drawn(DisplacedSolid(Sphere(1.0), noise))


def _lattice() -> list[Surface]:
    """Return a gyroid wall, intersected with a torus."""
    return _drawn(solid(Gyroid(0.5), between=(-0.4, 0.4)) & Torus(0.8, 0.4))


def _octet() -> list[Surface]:
    """Return a cylinder of an octet truss, its struts blended at the nodes."""
    cylinder = Cylinder(1.0, 1.2)
    return _drawn(octet(0.6, region=cylinder).struts(0.045, smooth=0.03) & cylinder)


def _knot() -> list[Surface]:
    """Return a thick Seifert surface of the trefoil knot, and a tube around the knot itself."""
    curve: FloatArray = example_curves.torus_knot(2, 3, 120)
    surface = solid(SolidAngle(curve), around=(2 * math.pi, 0.12))
    return _drawn(surface, Tube(np.concatenate([curve, curve[:1]]), 0.09))


def _jelly() -> list[Surface]:
    """Return a cluster of random blobs, to be drawn transparent."""
    rng = np.random.default_rng(8)
    blobs: Any = Blobs(rng.normal(size=(14, 3)) * 0.55, 0.55, kernel=CompactKernel(1.7))
    return [Surface(blobs, 1.0, side="above")]


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
        "octet-lattice",
        "an octet truss of blended struts, cut to a cylinder",
        _octet,
        ("silver",),
        Camera(elevation=32),
        show="shaded",
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
