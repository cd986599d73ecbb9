"""The sign of distances: negative inside, of every field that has an inside."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from harnack.geometry.example_meshes import bumpy_sphere

VERTICES, FACES = bumpy_sphere(2)
NORMALS = VERTICES / np.linalg.norm(VERTICES, axis=1, keepdims=True)
INSIDE_AND_OUTSIDE = [[0.0, 0.0, 0.1], [0.0, 0.0, 1.2]]


@pytest.mark.parametrize(
    "field",
    [
        hk.Sphere(1.0),
        hk.WindingNumber(VERTICES, FACES),
        hk.DipolePotential(VERTICES, NORMALS),
        hk.fields.ScreenedWindingNumber(VERTICES, NORMALS, length=1.0),
        hk.fields.HRBF(VERTICES[::4], NORMALS[::4]),
        hk.Blobs([[0.0, 0.0, 0.0]], [1.0]),
    ],
    ids=lambda field: type(field).__name__,
)
def test_distances_are_negative_inside(field: hk.Field) -> None:
    for method in ("first_order", "lower_bound", "closest_point"):
        inside, outside = hk.signed_distance(field, INSIDE_AND_OUTSIDE, method=method)
        assert inside <= 0 <= outside
    assert inside < 0 < outside


def test_clips_cut_the_surface_whose_distance_is_measured() -> None:
    """A sphere below the plane z = 0.3: the nearest point is on it, or on its edge."""
    cut = hk.HalfSpace((0, 0, 1), 0.3)
    points = np.random.default_rng(0).normal(scale=1.2, size=(200, 3))
    length = np.linalg.norm(points, axis=1)
    edge = np.hypot(np.hypot(points[:, 0], points[:, 1]) - np.sqrt(1 - 0.09), points[:, 2] - 0.3)
    exact = np.where(points[:, 2] <= 0.3 * length, np.abs(length - 1), edge)
    surface = hk.Surface(hk.Sphere(1.0), section=cut)
    for distance in (
        hk.signed_distance(surface, points),
        hk.signed_distance(hk.Sphere(1.0), points, clip=cut),
    ):
        np.testing.assert_allclose(np.abs(distance), exact, atol=1e-12)
    assert (np.abs(hk.signed_distance(surface, points, method="lower_bound")) <= exact + 1e-9).all()
    with pytest.raises(TypeError, match='method="first_order" does not see clip'):
        hk.signed_distance(surface, points, method="first_order")
    with pytest.raises(NotImplementedError, match=r"takes no clip.* which jumps"):
        hk.signed_distance(hk.WindingNumber(VERTICES, FACES), points, clip=cut)
