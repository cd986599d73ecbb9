"""Meshes of point clouds: with noise, without normals, hostile ones, and Hermite interpolation."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.geometry.clouds import CloudError, estimate_normals
from harnack.geometry.example_meshes import torus_mesh


def sphere(count: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + rng.normal(0, noise, (count, 3)), normals


def check_ball(made: Any, off: float, center: float = 0.0) -> None:
    """A closed mesh of one part, with vertices so far from the unit sphere at most."""
    assert made.is_watertight
    assert made.body_count == 1
    assert made.volume > 0
    assert np.abs(np.linalg.norm(made.vertices - center, axis=1) - 1).max() < off


def test_points_with_noise_and_no_normals_are_one_closed_surface() -> None:
    points, normals = sphere(8000, noise=0.03)  # as far apart as the noise is wide
    field = hk.DipolePotential(points, "estimate", smoothing=0.08)
    assert (np.einsum("ij,ij->i", field.normals, normals) > 0).mean() > 0.999
    check_ball(hk.mesh(field, cell_size=0.12, tolerance=2e-2), 0.04)


@pytest.mark.slow
def test_a_thin_dense_torus_with_noise_is_turned_outwards() -> None:
    vertices, _ = torus_mesh(1.0, 0.15, 400, 60)
    ring = vertices * [1, 1, 0]
    normals = vertices - ring / np.linalg.norm(ring, axis=1, keepdims=True)
    points = vertices + np.random.default_rng(0).normal(0, 0.02, vertices.shape)
    assert (np.einsum("ij,ij->i", estimate_normals(points), normals) > 0).mean() > 0.99


def test_the_command_estimates_and_smooths(tmp_path: Path) -> None:
    points, _ = sphere(3000, noise=0.02)
    np.savetxt(tmp_path / "cloud.xyz", points)
    out = tmp_path / "cloud.ply"
    options = ["--normals", "estimate", "--smoothing", "0.1", "--cell-size", "0.15"]
    assert main(["mesh", str(tmp_path / "cloud.xyz"), *options, "-o", str(out)]) == 0
    import trimesh

    check_ball(trimesh.load(out), 0.06)
    assert main(["mesh", "gyroid", "--smoothing", "0.1", "-o", str(out)]) == 1


@pytest.mark.few(2)
@pytest.mark.parametrize("smoothing", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["duplicates", "far away", "uneven", "outliers"])
def test_hostile_clouds_have_the_right_surface(kind: str, smoothing: float) -> None:
    x, shift = sphere(2000)[0], 0.0
    if kind == "duplicates":
        points, normals = np.concatenate([x] * 3), np.concatenate([x] * 3)
    elif kind == "far away":
        points, normals, shift = x + 1e5, x, 1e5
    elif kind == "uneven":
        points = normals = np.concatenate([x[x[:, 2] > 0], x[x[:, 2] <= 0][::10]])
    else:
        outliers = np.random.default_rng(0).uniform(-4, 4, (10, 3))
        points, normals = np.concatenate([x, outliers]), np.concatenate([x, outliers])
    field = hk.DipolePotential(points, normals, smoothing=smoothing)
    mesh = hk.mesh(field, cell_size=0.12, tolerance=4e-2, largest=True)
    check_ball(mesh, 0.15 if kind == "uneven" else 0.03, shift)


def test_one_point_too_far_away_is_named() -> None:
    x = np.concatenate([sphere(500)[0], [[4000.0, 0, 0]]])
    with pytest.raises(hk.MeshingError, match=r"1 of 501 points are far .* \(4000, 0, 0\)"):
        hk.mesh(hk.DipolePotential(x, x, smoothing=0.1))


def test_two_parts_are_both_turned_outwards() -> None:
    x = sphere(1500)[0]
    field = hk.DipolePotential(
        np.concatenate([x, x + np.array([2.6, 0, 0])]), "estimate", smoothing=0.1
    )
    mesh = hk.mesh(field, cell_size=0.15, tolerance=3.5e-2)
    assert mesh.body_count == 2
    assert mesh.volume == pytest.approx(8 / 3 * math.pi, rel=0.03)


_FLAT = np.column_stack([np.random.default_rng(0).random((200, 2)), np.zeros(200)])
_UP = np.tile([0.0, 0, 1], (200, 1))


@pytest.mark.parametrize(
    ("points", "normals", "message"),
    [
        (_FLAT, _UP, "enclose nothing.*lie in a plane"),
        (np.outer(np.arange(50.0), [1, 2, 3]), _UP[:50], "enclose nothing"),
        (sphere(200)[0], -sphere(200)[0], "normals face inwards: turn them around"),
    ],
)
def test_what_encloses_nothing_is_refused(
    points: np.ndarray, normals: np.ndarray, message: str
) -> None:
    with pytest.raises(hk.MeshingError, match=message):
        hk.mesh(hk.DipolePotential(points, normals))


def test_smoothed_points_of_a_plane_are_refused() -> None:
    with pytest.raises(CloudError, match="or the points lie in a plane or on a line"):
        hk.DipolePotential(_FLAT, _UP, smoothing=0.1)
    rng = np.random.default_rng(0)
    line, normals = np.linspace(0, 1, 200)[:, None] * (1.0, 2.0, 3.0), rng.normal(size=(200, 3))
    with pytest.raises(CloudError, match="or the points lie in a plane or on a line"):
        hk.DipolePotential(line, normals, smoothing=0.05)


def test_normals_turned_inwards_do_not_matter_to_what_is_smoothed() -> None:
    points, normals = sphere(1000)
    check_ball(hk.mesh(hk.DipolePotential(points, -normals, smoothing=0.1), cell_size=0.2), 0.05)


@pytest.mark.few(1)
@pytest.mark.parametrize("count", [60, 400])
def test_hermite_interpolation_is_meshed_by_signs(count: int) -> None:
    points, normals = sphere(count)
    mesh = hk.mesh(hk.fields.HRBF(points, normals), tolerance=1.2e-2, cell_size=0.15)
    assert mesh.metadata["harnack"]["made_by"] == "signs"
    check_ball(mesh, 0.03)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*beyond the tolerance|.*farther from the level")
def test_many_blobs_are_meshed() -> None:
    rng = np.random.default_rng(0)
    blobs = hk.Blobs(rng.uniform(-1, 1, (500, 3)), rng.uniform(0.1, 0.2, 500))
    made = hk.mesh(blobs, cell_size=0.15)
    assert made.is_watertight
    x = np.asarray(made.vertices)
    assert np.abs(blobs.value(x) - 1).max() < 0.2
