"""Scenes of blobs: metaballs, a surface through points with normals, and molecules."""

from __future__ import annotations

import math

import numpy as np

from harnack.fields import Field
from harnack.fields.blobs.blobs import Blobs
from harnack.fields.blobs.hrbf import HRBF
from harnack.fields.blobs.kernels import Compact
from harnack.fields.blobs.molecule import Molecule
from harnack.files import Atoms
from harnack.gallery.scene import DRAWN, Scene
from harnack.rendering import Camera
from harnack.tracer import LevelSet, level_set

_VAN_DER_WAALS = {"H": 1.2, "C": 1.7, "N": 1.55, "O": 1.52}


def _solid(field: Field, level: float) -> list[LevelSet]:
    return [level_set(field, solid=(level, math.inf), tolerance=DRAWN)]


def _metaballs() -> list[LevelSet]:
    """Drops around a large one, and a bite taken out of it."""
    angle = np.linspace(0, 2 * math.pi, 9, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.35 * np.sin(3 * angle)])
    centers = np.concatenate([[[0.0, 0.0, 0.0]], 1.15 * ring, [[0.35, -0.55, 0.5]]])
    radii = np.concatenate([[0.72], 0.26 + 0.06 * np.cos(2 * angle), [0.42]])
    weights = np.array([1.0] * 10 + [-1.2])
    return _solid(Blobs(centers, radii, weights, kernel=Compact(1.8)), 1.0)


def _groups() -> list[LevelSet]:
    """Two rings of blobs that flow together, each ring by itself, and meet in creases."""
    angle = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    flat = np.column_stack([np.cos(angle) - 0.5, np.sin(angle), 0 * angle])
    upright = np.column_stack([np.cos(angle) + 0.5, 0 * angle, np.sin(angle)])
    centers = np.concatenate([flat, upright])
    return _solid(Blobs(centers, 0.3, groups=[0] * 12 + [1] * 12), 1.0)


def _through_points() -> list[LevelSet]:
    """A surface through 18 points on a torus, with the torus's normals."""
    points, normals = [], []
    for j in range(6):
        for k in range(3):
            u, v = 2 * math.pi * j / 6, 2 * math.pi * (k + 0.5 * (j % 2)) / 3
            way = np.array([math.cos(u), math.sin(u), 0.0])
            normal = math.cos(v) * way + math.sin(v) * np.array([0.0, 0.0, 1.0])
            points.append(way + 0.42 * normal)
            normals.append(normal)
    return [level_set(HRBF(points, normals), solid=(-math.inf, 0.0), tolerance=DRAWN)]


def _helix() -> Atoms:
    """The backbone of an alpha helix of 14 residues: 3.6 residues a turn, a rise of 1.5 angstrom
    each; radius, angle in degrees and height of its atoms, by which bonds have their lengths within
    0.05 angstrom."""
    backbone = (
        ("N", 1.55, -28.3, -0.89), ("C", 2.28, 0.0, 0.0), ("C", 1.68, 26.3, 1.13),
        ("O", 2.03, 21.9, 2.35), ("C", 3.30, -19.6, 0.75),
    )  # fmt: skip
    elements: list[str] = []
    positions: list[tuple[float, float, float]] = []
    for residue in range(14):
        for element, radius, degrees, height in backbone:
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
