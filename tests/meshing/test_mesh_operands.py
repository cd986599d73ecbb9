"""Meshes as operands of solids: themselves where they are not cut, offsets within the tolerance."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry import mesh_shapes
from tests.fields.test_shapes import CROSSING, UNITED

CUBE = trimesh.creation.box((2.0, 2.0, 2.0))


def test_a_mesh_is_itself_with_a_hole() -> None:
    solid = hk.solid(CUBE).moved((5.0, 0.0, 0.0))
    made = hk.mesh(solid - hk.Cylinder(0.5).moved((5.0, 0.0, 0.0)), tolerance=2e-3)
    assert made.is_watertight
    assert made.volume == pytest.approx(8 - 2 * math.pi / 4, rel=2e-3)
    for corner in CUBE.vertices + np.array([5.0, 0.0, 0.0]):
        assert (made.vertices == corner).all(axis=1).any()
    plain = hk.mesh(hk.solid(CUBE))
    assert sorted(map(tuple, plain.vertices)) == sorted(map(tuple, CUBE.vertices))


def test_parts_that_cross_are_joined() -> None:
    made = hk.mesh(hk.solid(CROSSING))
    assert made.is_watertight
    united = trimesh.Trimesh(UNITED.vertices, UNITED.faces)
    assert made.volume == pytest.approx(united.volume, rel=1e-9)


def test_shells_are_as_thick_as_asked() -> None:
    ball = hk.solid(mesh_shapes.bumpy_sphere(3))
    made = hk.mesh(ball.shell(0.2), tolerance=1e-2)
    assert made.is_watertight
    assert made.body_count == 2  # outside and inside
    inner = made.split()[np.argmin([np.ptp(one.vertices) for one in made.split()])]
    centers = inner.triangles_center
    assert np.abs(ball.value(centers, precision="double") + 0.2).max() < 1e-2 * 2.5
    grown = hk.mesh(hk.solid(CUBE).grown(0.2), tolerance=1e-2)
    exact = 8 + 0.2 * 24 + math.pi * 0.04 * 6 + 4 / 3 * math.pi * 0.008
    assert grown.volume == pytest.approx(exact, rel=1e-2)
