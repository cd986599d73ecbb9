"""Noise of clouds: how much is found, and points moved onto the surface."""

from __future__ import annotations

import numpy as np
import pytest

from harnack.geometry.clouds import build_point_tree
from harnack.geometry.denoising import CloudDenoiser, NoiseEstimate, estimate_noise, outlier_indices


def sphere(count: int, noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + rng.normal(0, noise, (count, 3)), normals


def cube(count: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Of points on [-1, 1]^3, and normals of its faces."""
    rng = np.random.default_rng(0)
    axis, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points, normals = rng.uniform(-1, 1, (count, 3)), np.zeros((count, 3))
    rows = np.arange(count)
    points[rows, axis] = normals[rows, axis] = side
    return points + rng.normal(0, noise, points.shape), normals


@pytest.mark.parametrize(
    ("count", "noise", "off"), [(4000, 0.05, 0.15), (4000, 0.01, 0.15), (40_000, 0.06, 0.25)]
)
@pytest.mark.parametrize("is_given", [True, False])
def test_noise_and_spacing_are_found(count: int, noise: float, off: float, is_given: bool) -> None:
    points, normals = sphere(count, noise)
    found = estimate_noise(points, normals if is_given else None, build_point_tree(points))
    assert found.deviation == pytest.approx(noise, rel=off)
    assert found.spacing == pytest.approx(np.sqrt(4 * np.pi / count), rel=0.2)


def test_without_noise_next_to_none_is_found() -> None:
    points, normals = sphere(4000)
    tree = build_point_tree(points)
    spacing = np.sqrt(4 * np.pi / 4000)
    assert estimate_noise(points, normals, tree).deviation < 1e-12
    assert estimate_noise(points, None, tree).deviation < 0.05 * spacing


def test_points_of_a_sphere_stay_where_they_are() -> None:
    """As neighbors say exactly that they are on it, however far these are."""
    points, normals = sphere(500)
    moved = CloudDenoiser(points, NoiseEstimate(0.1, 0.16)).denoise_points(normals)
    assert np.abs(moved - points).max() < 1e-12


@pytest.mark.parametrize(("count", "noise", "left"), [(4000, 0.04, 0.3), (40_000, 0.06, 0.15)])
def test_noise_is_taken_away_and_nothing_shrinks(count: int, noise: float, left: float) -> None:
    points, normals = sphere(count, noise)
    cloud = CloudDenoiser(points, NoiseEstimate(noise, float(np.sqrt(4 * np.pi / count))))
    assert (len(cloud.selected) < count) == (count == 40_000)
    off = np.linalg.norm(cloud.denoise_points(normals), axis=1) - 1
    assert np.sqrt((off**2).mean()) < left * noise
    # Noise along the sphere moves points out by noise^2.
    assert abs(off.mean()) < 2 * noise**2


def test_points_beside_edges_stay_on_their_faces() -> None:
    points, normals = cube(6000, 0.03)
    moved = CloudDenoiser(points, NoiseEstimate(0.03, 0.063)).denoise_points(normals)
    height = np.einsum("ij,ij->i", moved, normals) - 1
    beside = (np.abs(moved) > 0.9).sum(axis=1) > 1
    assert beside.sum() > 500
    for off in (height[beside], height[~beside]):
        assert abs(off.mean()) < 0.15 * 0.03
        assert off.std() < 0.4 * 0.03


def test_estimated_normals_get_better_at_edges() -> None:
    points, normals = cube(6000, 0.03)
    tree = build_point_tree(points)
    rounded = normals[tree.query(points, k=32)[1]].mean(axis=1)
    rounded /= np.linalg.norm(rounded, axis=1, keepdims=True)
    moved, turned = CloudDenoiser(
        points, NoiseEstimate(0.03, 0.063), tree
    ).denoise_points_and_normals(rounded)
    assert len(moved) > 0.99 * len(points)
    before = np.einsum("ij,ij->i", rounded, normals)
    after = np.einsum("ij,ij->i", turned, normals[tree.query(moved)[1]])
    assert (after < 0.9).mean() < 0.6 * (before < 0.9).mean()


def test_points_in_the_middle_of_thin_parts_are_left_out() -> None:
    """Two walls, and points between them with normals that no neighbor has."""
    rng = np.random.default_rng(2)
    walls = np.column_stack([rng.uniform(-1, 1, (6000, 2)), rng.choice([-0.2, 0.2], 6000)])
    points = walls + rng.normal(0, 0.01, walls.shape)
    normals = np.column_stack([np.zeros((6000, 2)), np.sign(walls[:, 2])])
    points[:5], normals[:5] = [[x, 0, 0] for x in (-0.8, -0.4, 0, 0.4, 0.8)], (1, 0, 0)
    moved, turned = CloudDenoiser(points, NoiseEstimate(0.03, 0.052)).denoise_points_and_normals(
        normals
    )
    assert len(moved) == len(turned) == 5995
    assert (np.abs(moved[:, 2]) > 0.1).all()


def test_points_far_from_all_others_are_found() -> None:
    points, _ = sphere(2000, 0.03)
    dense, _ = sphere(8000, seed=1)
    some = np.array([[3.0, 0, 0], [3.01, 0, 0], [0, 0, 0], [-40, 9, 5]])
    x = np.concatenate([points, dense[dense[:, 2] > 0], some])
    assert outlier_indices(x, build_point_tree(x)).tolist() == list(range(len(x) - 4, len(x)))
