"""smoothing="auto": clouds with noise that is not known."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.fields.solid_angles import denoised_cloud
from harnack.geometry.clouds import CloudError


def sphere(count: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + rng.normal(0, noise, (count, 3)), normals


@pytest.mark.parametrize("is_given", [True, False])
def test_a_sphere_with_noise(is_given: bool) -> None:
    points, normals = sphere(4000, 0.04)
    field = hk.DipolePotential(points, normals if is_given else "estimate", smoothing="auto")
    about = field.describe()
    assert about["noise"] == pytest.approx(0.04, rel=0.15)
    assert about["given"] == 4000
    assert about["left out"] == 0
    assert about["normals"] == ("given" if is_given else "estimated")
    assert about["smoothing"] == field.smoothing > 0
    assert field.areas.sum() == pytest.approx(4 * math.pi, rel=0.1)
    mesh = hk.mesh(field, tolerance=4e-3)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    off = np.linalg.norm(mesh.vertices, axis=1) - 1
    assert np.abs(off).max() < 0.05  # of single points it is up to 0.15
    assert np.abs(off).mean() < 0.01
    assert mesh.metadata["harnack"]["cloud"] == about


def test_of_many_points_with_much_noise_a_part_is_moved() -> None:
    points, normals = sphere(20_000, 0.06)
    field = hk.DipolePotential(points, normals, smoothing="auto")
    assert field.describe()["points"] == len(field.points) < 12_000
    assert np.abs(np.linalg.norm(field.points, axis=1) - 1).mean() < 0.012


def test_far_points_are_left_out_with_a_warning() -> None:
    points, normals = sphere(3000, 0.02)
    far = np.array([[300.0, 0, 0], [0, 2, 0]])
    with pytest.warns(UserWarning, match="2 of 3,002 points are far from all others"):
        field = hk.DipolePotential(
            np.concatenate([points, far]), np.concatenate([normals, far]), smoothing="auto"
        )
    assert field.describe()["left out"] == 2
    assert hk.mesh(field, tolerance=1e-2).volume == pytest.approx(4 / 3 * math.pi, rel=0.02)


def test_normals_that_are_turned_wrongly_are_turned_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of a whole region, which agree with each other."""
    points, normals = sphere(4000, 0.02)
    wrong = np.where((points[:, 2] > 0.95)[:, None], -normals, normals)

    def estimated(points: np.ndarray) -> np.ndarray:
        del points
        return wrong

    monkeypatch.setattr(denoised_cloud, "estimate_normals", estimated)
    field = hk.DipolePotential(points, "estimate", smoothing="auto")
    assert (np.einsum("ij,ij->i", field.normals, normals) > 0.7).all()


def test_without_noise_the_surface_passes_through_the_points() -> None:
    points, normals = sphere(1000, 0.0)
    field = hk.DipolePotential(points, normals, smoothing="auto")
    assert field.smoothing == 0
    np.testing.assert_array_equal(field.points, points)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_units_do_not_matter(scale: float) -> None:
    points, _ = sphere(600, 0.05)
    field = hk.DipolePotential(points, "estimate", smoothing="auto")
    scaled = hk.DipolePotential(scale * points, "estimate", smoothing="auto")
    assert scaled.smoothing == pytest.approx(scale * field.smoothing, rel=1e-6)
    np.testing.assert_allclose(scaled.points / scale, field.points, atol=1e-4)


def test_what_cannot_be() -> None:
    points, normals = sphere(100, 0.02)
    with pytest.raises(CloudError, match="leave out the areas"):
        hk.DipolePotential(points, normals, np.ones(100), smoothing="auto")
    with pytest.raises(CloudError, match='needed for smoothing="auto": give a length'):
        hk.DipolePotential(points[:20], normals[:20], smoothing="auto")


def test_the_command_says_what_was_found(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points, _ = sphere(3000, 0.03)
    np.savetxt(tmp_path / "cloud.xyz", np.concatenate([points, [[50.0, 0, 0]]]))
    out = tmp_path / "cloud.ply"
    options = ["--normals", "estimate", "--smoothing", "auto", "--tolerance", "0.01"]
    assert main(["mesh", str(tmp_path / "cloud.xyz"), *options, "-o", str(out)]) == 0
    printed = "".join(capfd.readouterr())
    assert "note: 1 of 3,001 points are far from all others and were left out" in printed
    assert re.search(r"given: 3001, left out: 1, noise: 0\.0(2[789]|3[0123])", printed), printed
