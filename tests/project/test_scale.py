"""Defaults follow the size of the surface, and precision follows the input: a surface scaled by
1e-3 or 1e3 gives the same results with defaults alone, and float64 input is computed in double."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import harnack as hk
from harnack.geometry.example_curves import torus_knot
from harnack.geometry.example_meshes import bumpy_sphere

KNOT = torus_knot(2, 3, 200)
VERTICES, FACES = bumpy_sphere(3)
KEPT = np.arange(len(FACES)) % 37 > 2
RNG = np.random.default_rng(0)
NORMALS = RNG.normal(size=(1500, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
FIELDS: dict[str, Callable[[float], hk.Field]] = {
    "trefoil": lambda s: hk.SolidAngle(s * KNOT),
    "gyroid ball": lambda s: hk.Gyroid(0.7 * s, domain=hk.Ball((0, 0, 0), s)),
    "mesh with holes": lambda s: hk.WindingNumber(s * VERTICES, FACES[KEPT]),
    "cloud": lambda s: hk.DipolePotential(s * NORMALS, NORMALS),
}
ORIGINS = RNG.normal(size=(1000, 3))
ORIGINS *= 4.0 / np.linalg.norm(ORIGINS, axis=1, keepdims=True)
DIRECTIONS = (RNG.uniform(-0.7, 0.7, ORIGINS.shape) - ORIGINS).astype(np.float32)
POINTS = RNG.uniform(-1.2, 1.2, (30, 3))
SCALES = (1e-3, 1e3)


@pytest.mark.parametrize("name", FIELDS)
def test_scaled_surfaces_have_the_same_hits(name: str) -> None:
    origins = ORIGINS.astype(np.float32)
    hits = hk.trace(FIELDS[name](1.0), origins, DIRECTIONS)
    for scale in SCALES:
        scaled = hk.trace(FIELDS[name](scale), np.float32(scale) * origins, DIRECTIONS)
        assert (scaled.status == hits.status).all()
        apart = np.abs(scaled.t[hits.is_hit] / scale - hits.t[hits.is_hit])
        # Grazing rays, of which t depends on rounding, meet within the tolerance of the surface.
        assert np.quantile(apart, 0.99) < 5e-6
        assert apart.max() < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_scaled_surfaces_have_the_same_pictures_meshes_and_distances(name: str) -> None:
    def results(scale: float) -> tuple[np.ndarray, float, int]:
        field = FIELDS[name](scale)
        scaled_distance = hk.signed_distance(field, scale * POINTS) / scale
        np.testing.assert_allclose(scaled_distance, distance, atol=1e-13)
        picture = hk.render(field, show="shaded", size=(60, 45), progress=False)
        mesh = hk.mesh(field)
        return np.asarray(picture), mesh.area / scale**2, len(mesh.faces)

    distance = hk.signed_distance(FIELDS[name](1.0), POINTS)
    picture, area, count = results(1.0)
    for scale in SCALES:
        scaled_picture, scaled_area, scaled_count = results(scale)
        assert np.abs(scaled_picture - picture).max() < 0.03
        assert scaled_area == pytest.approx(area, rel=1e-5)
        assert scaled_count == pytest.approx(count, rel=1e-3)


@pytest.mark.parametrize("name", ["trefoil", "gyroid ball"])
def test_arrays_of_float64_are_computed_in_double_precision(name: str) -> None:
    """A surface that is 1e5 away from the origin: values right to 1e-6, where single precision is
    off by far more, and hits within the tolerance."""
    shift = np.array([1e5, -7e4, 3e4])
    moved: dict[str, hk.Field] = {
        "trefoil": hk.SolidAngle(KNOT + shift),
        "gyroid ball": hk.expression(
            lambda x, y, z: (
                hk.math.sin(x - 1e5) * hk.math.cos(y + 7e4)
                + hk.math.sin(y + 7e4) * hk.math.cos(z - 3e4)
                + hk.math.sin(z - 3e4) * hk.math.cos(x - 1e5)
            ),
            domain=hk.Ball(tuple(shift), 1.0),
        ),
    }
    centered: dict[str, hk.Field] = {
        "trefoil": hk.SolidAngle(KNOT),
        "gyroid ball": hk.expression(
            lambda x, y, z: (
                hk.math.sin(x) * hk.math.cos(y)
                + hk.math.sin(y) * hk.math.cos(z)
                + hk.math.sin(z) * hk.math.cos(x)
            ),
            domain=hk.Ball((0, 0, 0), 1.0),
        ),
    }
    field, reference = moved[name], centered[name]
    assert field.value(POINTS + shift).dtype == np.float64
    np.testing.assert_allclose(field.value(POINTS + shift), reference.value(POINTS), atol=1e-6)
    np.testing.assert_allclose(
        field.gradient(POINTS + shift), reference.gradient(POINTS), atol=1e-5
    )
    hits = hk.trace(field, ORIGINS + shift, DIRECTIONS.astype(np.float64))
    expected = hk.trace(reference, ORIGINS, DIRECTIONS.astype(np.float64))
    assert hits.t.dtype == np.float64
    assert (hits.status == expected.status).mean() > 0.995
    both = hits.is_hit & expected.is_hit
    assert np.quantile(np.abs(hits.t[both] - expected.t[both]), 0.99) < 1e-4


def test_input_of_other_kinds_is_computed_in_single_precision() -> None:
    field = FIELDS["gyroid ball"](1.0)
    assert field.value(list(POINTS)).dtype == np.float64  # a list of arrays of float64
    for points in (POINTS.astype(np.float32), POINTS.tolist()):
        assert field.value(points).dtype == np.float32
        assert field.value(points, precision="double").dtype == np.float64
    assert field.value(POINTS, precision="single").dtype == np.float32
    hits = hk.trace(field, ORIGINS.astype(np.float32), DIRECTIONS)
    assert hits.t.dtype == np.float32
