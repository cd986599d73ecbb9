"""Smoothed dipoles: the kernel, its bounds, errors of the tree, and surfaces of noisy clouds."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_float, to_numpy
from harnack.fields.solid_angles.smoothed import SmoothedKernel
from harnack.geometry.clouds import CloudError

DOUBLE = choose_backend("double")


def noisy_sphere(count: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + rng.normal(0, noise, (count, 3)), normals


def smoothed_sum(field: hk.DipolePotential, x: np.ndarray) -> np.ndarray:
    """The sum as the docstring has it, term by term."""
    z = field.points - x[:, None]
    square, h2 = (z * z).sum(axis=2), field.smoothing**2
    along = (z * (field.areas[:, None] * field.normals)).sum(axis=2)
    return (along * (square + 2.5 * h2) / (square + h2) ** 2.5).sum(axis=1)


@pytest.mark.parametrize("m", range(2, 7))
def test_bounds_of_derivatives_hold_and_are_attained(m: int) -> None:
    """Along lines, by Taylor's coefficients on a circle in the complex plane."""
    kernel = SmoothedKernel(DOUBLE, 1.0)
    rho, cosine = np.geomspace(1e-3, 5000, 60)[:, None, None], np.linspace(-1, 1, 41)[:, None]
    d = np.sqrt(rho**2 + 1)
    turn = np.exp(2j * np.pi * np.arange(64) / 64)
    t = 0.3 * d * turn
    square = d**2 + 2 * t * rho * cosine + t * t
    value = square**-0.5 + 0.5 * square**-1.5
    coefficient = np.abs((value * turn**-m).mean(axis=2)) / (0.3 * d[:, :, 0]) ** m
    distance = d[:, 0, 0]
    bound = to_numpy(kernel.bounds(to_float(DOUBLE, distance), m)[m - 2])
    largest = coefficient.max(axis=1) * distance ** (m + 1)
    assert (largest <= bound * (1 + 1e-9)).all()
    assert largest[-1] >= bound[-1] * (1 - 1e-4)  # far off, where it is that of plain dipoles


def test_values_are_the_sum_within_their_errors() -> None:
    points, normals = noisy_sphere(3000, 0.02)
    field = hk.DipolePotential(points, normals, smoothing=0.05)
    x = np.random.default_rng(1).uniform(-1.5, 1.5, (300, 3))
    x[:50] = points[:50]
    wanted = smoothed_sum(field, x)
    for precision in ("single", "double"):
        off = np.abs(field.value(x, precision=precision) - wanted)
        assert (off <= field.error_bound(x, precision=precision)).all()
    assert np.abs(field.value(x, precision="double") - wanted).max() < 0.02 * 4 * math.pi
    step = 1e-5
    slope = [(smoothed_sum(field, x + e) - smoothed_sum(field, x - e)) / (2 * step)
             for e in step * np.eye(3)]  # fmt: skip
    off = np.abs(field.gradient(x, precision="double") - np.stack(slope, axis=1))
    assert off.max() < 0.02 * np.abs(slope).max()


def test_the_level_lies_between_the_points() -> None:
    points, normals = noisy_sphere(4000, 0.03)
    field = hk.DipolePotential(points, normals, smoothing=0.08)
    inside = field.value(points) > field.default_level
    assert 0.45 < inside.mean() < 0.55
    directions = noisy_sphere(200, 0.0, seed=5)[1]
    hits = hk.trace(field, -3 * directions, directions)
    radius = np.linalg.norm(hits.position[hits.is_hit], axis=1)
    assert hits.is_hit.all()
    assert np.abs(radius - 1).max() < 0.03  # the noise of single points is 0.03, up to 0.1
    assert np.abs(radius - 1).mean() < 0.008


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_units_do_not_matter(scale: float) -> None:
    points, normals = noisy_sphere(500, 0.03)
    field = hk.DipolePotential(points, normals, smoothing=0.1)
    scaled = hk.DipolePotential(scale * points, normals, smoothing=scale * 0.1)
    assert scaled.default_level == pytest.approx(field.default_level, rel=1e-6)
    x = np.array([[0.2, 0.1, 0.3], [1.0, 0.2, 0.1], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        scaled.value(scale * x, precision="double"), field.value(x, precision="double"), rtol=1e-5
    )


def test_moved_points_stay_smoothed() -> None:
    points, normals = noisy_sphere(500, 0.03)
    field = hk.DipolePotential(points, normals, smoothing=0.1)
    moved = field.with_points(2 * points, normals, 4 * field.areas)
    assert moved.smoothing == field.smoothing
    x = np.array([[1.9, 0.1, 0.3], [0.4, 0.2, 0.1]])
    np.testing.assert_allclose(
        moved.value(x, precision="double"), smoothed_sum(moved, x), rtol=1e-2
    )


@pytest.mark.parametrize(
    ("smoothing", "message"),
    [
        (-0.1, "smoothing"),
        (math.nan, "smoothing"),
        (math.inf, "smoothing"),
        ("much", "smoothing"),
        (5.0, r"about 4 across: give one between 2e-05 and 2,"),
        (1e-9, "such as the length of the noise"),
    ],
)
def test_smoothing_that_cannot_be(smoothing: float, message: str) -> None:
    points = np.concatenate([np.eye(3), -np.eye(3)])
    with pytest.raises((ValueError, TypeError), match=message):
        hk.DipolePotential(points, points, smoothing=smoothing)


def test_normals_that_cancel_each_other_have_no_level() -> None:
    points = np.repeat(noisy_sphere(300, 0.0)[0], 2, axis=0)
    normals = points * np.tile([1.0, -1.0], 300)[:, None]
    with pytest.raises(CloudError, match="normals cancel each other, or the points lie"):
        hk.DipolePotential(points, normals, smoothing=0.1)


def test_smoothing_that_makes_a_blob_is_told_of() -> None:
    """Of a flat ellipsoid: smoothing as long as a cloud is wide was silent."""
    points, _ = hk.geometry.example_meshes.icosphere(3)
    normals = points / (2.0, 1.0, 0.2)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = points * (2.0, 1.0, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hk.DipolePotential(cloud, normals, smoothing=0.05)
    with pytest.warns(UserWarning, match="may be too long"):
        hk.DipolePotential(cloud, normals, smoothing=1.0)
