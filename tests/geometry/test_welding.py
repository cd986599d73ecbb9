"""Corners that are apart by rounding are joined at open edges, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.files import read_geometry
from harnack.geometry.example_meshes import icosphere
from harnack.geometry.welding import Welded, rounding_of

FloatArray = np.ndarray


def halves(offset: FloatArray | float, *, subdivisions: int = 2) -> tuple[FloatArray, FloatArray]:
    """A closed ball of two halves with corners of their own, the upper one moved."""
    vertices, faces = icosphere(subdivisions)
    upper = vertices[faces].mean(axis=1)[:, 2] > 0
    moved = vertices + np.broadcast_to(offset, 3)
    return np.concatenate([vertices, moved]), np.where(upper[:, None], faces + len(vertices), faces)


def single(vertices: FloatArray) -> FloatArray:
    return vertices.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(
    ("offset", "is_single", "is_closed"),
    [
        (0.0, False, True),
        (2e-16, False, True),
        (1e-14, False, False),  # in double precision that is a gap
        (1e-7, True, True),  # and in single precision rounding
        (1e-6, True, False),
    ],
)
def test_gaps_of_rounding_are_closed_and_no_others(
    offset: float, is_single: bool, is_closed: bool
) -> None:
    vertices, faces = halves((0.0, 0.0, offset))
    if is_single:
        vertices = single(vertices)
    welded = Welded.of(vertices, faces)
    assert (len(welded.edges) == 0) == is_closed
    assert (welded.rounded > 0) == (is_closed and offset > 0)
    moved = np.abs(vertices[welded.index] - vertices).max()
    assert moved <= rounding_of(vertices) < (1e-6 if is_single else 1e-14)


def test_zero_and_what_programs_get_for_it() -> None:
    """Corners in single precision at 0 and at 2.7e-16, as CAD programs write them."""
    box, faces = trimesh.creation.box([20.0, 20.0, 20.0]), np.arange(36).reshape(-1, 3)
    vertices = np.add(box.triangles, [0, 0, 10]).reshape(-1, 3)
    vertices[::2, 2] -= np.where(vertices[::2, 2] == 0, 2.7e-16, 0.0)
    vertices = single(vertices)
    field = hk.WindingNumber(vertices, faces)
    assert (field.describe()["singular edges"], field.mesh.rounded) == (0, 4)
    assert hk.solid(trimesh.Trimesh(vertices, faces, process=False)).describe()["triangles"] == 12
    check = hk.check_print((vertices, faces))
    assert check.is_printable
    assert check.volume == pytest.approx(8000.0)
    assert [problem.kind for problem in check.problems] == ["corners apart by rounding"]
    result = hk.repair(trimesh.Trimesh(vertices, faces, process=False))
    facts = result.metadata["harnack"]
    assert (facts["stage"], facts["kept"], facts["welded"]) == ("filled", 12, 4)
    assert result.volume == pytest.approx(8000.0)


def test_files_say_how_many(tmp_path: Path) -> None:
    vertices, faces = halves((0.0, 0.0, 1e-7))
    path = tmp_path / "halves.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    read = read_geometry(path, "winding")
    assert isinstance(read, hk.files.geometry_files.LoadedMesh)
    assert 0 < read.rounded < 40
    assert "a closed mesh" in read.summary
    assert f"{read.rounded} corners joined with others that were apart by rounding" in read.summary


def test_no_face_loses_corners_or_its_area() -> None:
    """A needle in a gap, as wide as rounding, closes the gap as it is; where it does not, its
    corners stay apart."""
    vertices, faces = halves(1e-16)
    end = int(faces.max())
    near = np.abs(vertices - vertices[end]).max(axis=1) < 1e-15
    other = int(near.argmax())
    needle = np.array([[other, end, 0]])
    welded = Welded.of(vertices, np.concatenate([faces, needle]))
    assert welded.index[other] != welded.index[end]
    assert len(welded.net.faces) == len(faces) + 1


def test_thin_walls_stay() -> None:
    """What is closed needs no corner joined, however thin it is."""
    box = trimesh.creation.box([1.0, 1.0, 1e-16])
    vertices = np.asarray(box.vertices)
    assert (Welded.of(vertices, np.asarray(box.faces)).index == np.arange(8)).all()


def test_small_triangles_far_from_the_origin_stay() -> None:
    """Where rounding is not small against edges, nothing is told to be rounding."""
    vertices, faces = icosphere(2)
    far = single(0.05 * vertices + 4e5)
    kept = faces[:-3]
    assert Welded.of(far, kept).rounded == 0


def test_moved_meshes_stay_joined() -> None:
    vertices, faces = halves(2e-16)
    field = hk.WindingNumber(vertices, faces)
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    inside = field.with_vertices(2 * vertices @ turned).value([[0.3, 0.2, 0.1]], precision="double")
    assert abs(inside[0]) == pytest.approx(1.0)
