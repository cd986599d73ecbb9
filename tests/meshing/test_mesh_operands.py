"""Meshes as operands of solids: themselves where they are not cut, offsets within the tolerance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry import example_meshes
from harnack.meshing.closed_mesh import volume_manifold
from harnack.meshing.meshing_errors import MeshingError
from tests.fields.test_shapes import CROSSING, UNITED

CUBE = trimesh.creation.box((2.0, 2.0, 2.0))


def test_a_mesh_is_itself_with_a_hole() -> None:
    solid = hk.solid(CUBE).translated((5.0, 0.0, 0.0))
    mesh = hk.mesh(solid - hk.Cylinder(0.5).translated((5.0, 0.0, 0.0)), tolerance=4e-3)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8 - 2 * math.pi / 4, rel=2e-3)
    for corner in CUBE.vertices + np.array([5.0, 0.0, 0.0]):
        assert (mesh.vertices == corner).all(axis=1).any()
    plain = hk.mesh(hk.solid(CUBE))
    assert sorted(map(tuple, plain.vertices)) == sorted(map(tuple, CUBE.vertices))


def test_parts_that_cross_are_joined() -> None:
    made = hk.mesh(hk.solid(CROSSING))
    assert made.is_watertight
    united = trimesh.Trimesh(UNITED.vertices, UNITED.faces)
    assert made.volume == pytest.approx(united.volume, rel=1e-9)


def box(low: Any, high: Any) -> Any:
    return trimesh.creation.box(bounds=np.array([low, high], float))


PLATE = box((0, 0, 0), (30, 20, 10))


@pytest.mark.parametrize(
    ("parts", "volume"),
    [
        ([PLATE, box((5, 5, 10), (15, 15, 35))], 8500),
        ([PLATE, box((30, 0, 0), (40, 20, 10))], 8000),
        ([PLATE, box((25, 0, 10), (40, 20, 20))], 9000),
        ([PLATE, box((10, 0, 0), (40, 20, 10))], 8000),
        ([PLATE, box((0, 5, 5), (10, 10, 8))], 6000),
        ([PLATE, PLATE], 6000),
        ([PLATE, PLATE, box((30, 0, 0), (40, 20, 10))], 8000),
        ([PLATE, box((0, 20, 0), (20, 40, 10)), box((10, 10, 10), (20, 30, 20))], 12000),
    ],
)
@pytest.mark.parametrize("is_askew", [False, True])
def test_parts_in_contact_are_joined(parts: list[Any], volume: float, is_askew: bool) -> None:
    """Exactly in contact, or up to rounding."""
    whole = trimesh.util.concatenate(parts)
    if is_askew:
        whole.apply_transform(trimesh.transformations.rotation_matrix(0.7, (0.3, -1.0, 0.4)))
    result = hk.mesh(hk.solid(whole))
    assert result.volume == pytest.approx(volume, rel=1e-7)
    assert result.is_watertight
    assert result.body_count == 1


def test_within_parts_in_contact_distances_are_from_their_union() -> None:
    whole = trimesh.util.concatenate([PLATE, box((5, 5, 10), (15, 15, 35))])
    points = np.array([[7.5, 9, 9], [10, 10, 10], [2.5, 9, 9], [4, 10, 12]])
    computed = hk.solid(whole).value(points, precision="double")
    assert computed == pytest.approx([-math.hypot(2.5, 1), -5, -1, 1], abs=1e-12)


def test_shells_are_as_thick_as_asked() -> None:
    ball = hk.solid(example_meshes.bumpy_sphere(3))
    mesh = hk.mesh(ball.shell(0.2), tolerance=2e-2)
    assert mesh.is_watertight
    assert mesh.body_count == 2  # outside and inside
    inner = mesh.split()[np.argmin([np.ptp(part.vertices) for part in mesh.split()])]
    centers = inner.triangles_center
    assert np.abs(ball.value(centers, precision="double") + 0.2).max() < 1e-2 * 2.5
    grown = hk.mesh(hk.solid(CUBE).offset(0.2), tolerance=2.4e-2)
    exact = 8 + 0.2 * 24 + math.pi * 0.04 * 6 + 4 / 3 * math.pi * 0.008
    assert grown.volume == pytest.approx(exact, rel=1e-2)


def test_a_ball_of_too_many_faces_is_refused_with_their_number() -> None:
    """Its polyhedron has 44,432 segments around: 8 (44432/4)^2 faces."""
    ball, corner = hk.Ball(radius=1.0), np.full(3, 2.0)
    with pytest.raises(MeshingError, match="has 987,101,312 faces"):
        volume_manifold(ball, -corner, corner, 1e-8)
