"""Meshes of outlines and of threads: flat faces as they are, edges sharp, curved faces within the
tolerance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk

STAR = [((3 + k % 2) * math.cos(k * math.pi / 5), (3 + k % 2) * math.sin(k * math.pi / 5))
        for k in range(10)]  # fmt: skip
HOLE = [(-1.0, -1.0), (1.0, -1.0), (0.0, 1.5)]
AREA = 5 * 3 * 4 * math.sin(math.pi / 5) - 2.5
CUP = [(0.0, -0.6), (0.5, -0.6), (0.9, 0.6), (0.8, 0.65), (0.4, -0.4), (0.0, -0.4)]


def off(solid: Any, mesh: Any) -> float:
    points = np.concatenate([mesh.vertices, mesh.triangles_center])
    return float(np.abs(solid.value(points, precision="double")).max())


@pytest.mark.parametrize("taper", [1.0, 0.5])
def test_flat_faces_are_exact(taper: float) -> None:
    solid = hk.Extrusion([STAR, HOLE], 2.0, taper=taper)
    mesh = hk.mesh(solid)
    assert mesh.is_watertight
    assert len(mesh.vertices) == 26
    assert mesh.volume == pytest.approx(AREA * 2 * (1 + taper + taper**2) / 3, rel=1e-12)
    assert off(solid, mesh) < 1e-12
    moved = hk.mesh(solid.rotated(30, "x").scaled(0.1) - hk.Sphere(0.12))
    assert moved.is_watertight


def test_twisted_faces_are_within_the_tolerance() -> None:
    solid = hk.Extrusion([STAR, HOLE], 2.0, twist=90.0, taper=0.7)
    mesh = hk.mesh(solid, tolerance=3.2e-2)
    assert mesh.is_watertight
    assert off(solid, mesh) < 3.2e-2
    # The corners' way up is an edge of the mesh.
    x, y, z = (np.array(mesh.vertices) * [1, 1, 0.5]).T
    corner = 4 * (1 - 0.3 * z) * np.exp(1j * (0.5 * np.pi * z + np.pi / 5))
    assert np.count_nonzero(np.abs(x + 1j * y - corner) < 1e-9) > 5


def test_revolved_outlines_keep_their_rings() -> None:
    solid = hk.SolidOfRevolution(CUP)
    mesh = hk.mesh(solid)
    assert mesh.is_watertight
    r = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    found = np.unique(np.round(np.column_stack([r, mesh.vertices[:, 2]]), 9), axis=0)
    assert np.allclose(found, [one for one in sorted(CUP) if one[0] > 0])
    p, q = np.array(CUP), np.roll(CUP, -1, axis=0)
    turned = np.pi / 3 * ((p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]) * (p[:, 0] + q[:, 0])).sum()
    assert mesh.volume == pytest.approx(turned, rel=5e-3)


@pytest.mark.parametrize(
    ("profile", "starts", "left_handed"),
    [([(0, 4), (0.5, 4), (1, 3)], 1, False), ([(0, 4), (1, 3), (1.5, 3)], 3, True)],
)
def test_threads_keep_their_edges(profile: Any, starts: int, left_handed: bool) -> None:
    thread = hk.solids.Thread(profile, 2.0, starts, left_handed)
    solid = thread & hk.Cylinder(4.5, 10.0)
    mesh = hk.mesh(solid)
    assert mesh.is_watertight
    assert off(solid, mesh) < 1e-2
    # All corners of the profile between the ends, on their helices.
    x, y, z = mesh.vertices[np.abs(mesh.vertices[:, 2]) < 4.9].T
    lead = 2.0 * starts * (-1 if left_handed else 1)
    u = (z - lead * np.arctan2(y, x) / (2 * np.pi) + 1e-7) % 2.0 - 1e-7
    near = np.abs(u[:, None] - np.array(profile)[:, 0]).min(axis=1) < 1e-6
    assert near.mean() > 0.95
    turn = np.linspace(0, 2 * np.pi, 400)[:, None]
    at = (np.linspace(0, 1, 401)[None] * 2.0 - lead * turn / (2 * np.pi)) % 2.0
    curve = np.array([*profile, (2.0, profile[0][1])])
    area = 0.5 * np.trapezoid(np.mean(np.interp(at, *curve.T) ** 2, axis=1), turn[:, 0])
    assert mesh.volume == pytest.approx(10.0 * area, rel=1e-2)


ACUTE = hk.Tube([(1, 0, 0), (0, 0, 0), (math.cos(math.pi / 6), 0.5, 0)], 0.2)
SQUARE = hk.Tube([(1, 0, 0), (0, 0, 0), (0, 1, 0), (1, 1, 0.4), (1, 0, 0)], 0.1)
BACK = hk.Tube([(1, 0, 0), (0, 0, 0), (0.5, 0, 0)], 0.1)


def trefoil(radius: float) -> hk.Tube:
    t = np.linspace(0, 2 * np.pi, 101)
    x = [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)]
    points = np.stack(x, axis=1)
    points[-1] = points[0]
    return hk.Tube(points, radius)


def spline(radius: float) -> hk.Tube:
    points = np.random.default_rng(0).uniform(-1, 1, (10, 3))
    return hk.Tube(hk.geometry.smooth_curve(points, closed=False), radius)


@pytest.mark.parametrize(
    ("tube", "volume", "tolerance"),
    [
        # By sums over distances in NumPy; of one edge twice that of a capsule.
        (ACUTE, 0.25899, 1.4e-3),
        (BACK, 0.01 * math.pi * (1 + 4 / 30), 1.2e-3),
        (SQUARE, 0.1288, 1.2e-3),
        pytest.param(trefoil(0.8), 56.684, 7e-3, marks=pytest.mark.slow),
        pytest.param(spline(0.2), 1.9001, 2.6e-3, marks=pytest.mark.slow),
        pytest.param(hk.Tube.helix(2.0, 0.3, 4.0, 0.2), None, 4.4e-3, marks=pytest.mark.slow),
    ],
    ids=["acute", "there and back", "closed", "trefoil", "spline", "coil"],
)
def test_tubes_that_come_back_to_themselves(
    tube: hk.Tube, volume: float | None, tolerance: float
) -> None:
    """All but the closed one were refused: creases of one function, narrower than cells."""
    mesh = hk.mesh(tube, tolerance=tolerance)
    assert mesh.is_watertight
    assert off(tube, mesh) < tolerance
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=6e-3)


def test_tubes_of_several_polylines_offset_and_cut() -> None:
    cross = hk.Tube.from_polylines([[(-1, 0, 0), (1, 0, 0)], [(0, -1, 0), (0, 1, 0)]], 0.1)
    grown = hk.mesh(cross.offset(0.1), tolerance=2.4e-3)
    # Two capsules of radius r less what they have in common, 16/3 r^3.
    right = 2 * math.pi * 0.2**2 * (2 + 4 / 3 * 0.2) - 16 / 3 * 0.2**3
    assert grown.volume == pytest.approx(right, rel=6e-3)
    half = hk.mesh(cross & hk.solids.Plane((0, 0, 1)), tolerance=2.2e-3)
    assert half.volume == pytest.approx(0.5 * hk.mesh(cross, tolerance=2.2e-3).volume, rel=2e-3)


def test_a_bolt_and_its_nut_do_not_meet() -> None:
    hexagon = hk.io.outline.regular_polygon(6, 13 / math.sqrt(3))
    bolt = hk.solids.metric_thread("M8", 12.0, clearance=0.1)
    nut = hk.Extrusion(hexagon, 6.5) - hk.solids.metric_thread("M8", 8.0, internal=True)
    meshes = [hk.mesh(part, tolerance=2.6e-2) for part in (bolt, nut)]
    assert all(mesh.is_watertight for mesh in meshes)
    inside = bolt.translated((0.0, 0.0, -2.5)).value(meshes[1].vertices, precision="double")
    assert inside.min() > 0.1 - 2 * 2.6e-2
