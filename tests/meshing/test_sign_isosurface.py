"""Meshes by signs alone: closed whatever the input, and where their vertices lie."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry.example_meshes import flip_faces, icosphere, remove_faces
from harnack.meshing import sign_isosurface
from harnack.meshing.bcc_lattice import BccLattice
from harnack.meshing.sign_function import SignFunction
from harnack.meshing.sign_isosurface import extract_from_signs
from tests.oracles.triangle_pairs import intersecting_pairs


def soup(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A cube of loose triangles: some lost, some turned over, all moved a little."""
    box = trimesh.creation.box().subdivide().subdivide()
    rng = np.random.default_rng(seed)
    faces = flip_faces(remove_faces(np.asarray(box.faces), 0.05, seed=seed), 0.05, seed=seed)
    corners = box.vertices[faces] + rng.normal(0, 0.002, (len(faces), 1, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    loose = corners.reshape(-1, 3) @ turn
    return loose, np.arange(len(loose)).reshape(-1, 3)


def sphere_points(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unit sphere on a spiral, and normals there."""
    k = np.arange(n) + 0.5
    height, turn = 1 - 2 * k / n, math.pi * (1 + math.sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    points = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), height])
    return points, points


def check(made: trimesh.Trimesh) -> dict[str, Any]:
    """Closed and without crossings, by other means than `mesh`."""
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.volume > 0
    assert not len(intersecting_pairs(np.asarray(made.vertices), np.asarray(made.faces)))
    return made.metadata["harnack"]


def test_a_soup_is_closed() -> None:
    with pytest.warns(UserWarning, match="are farther from the level of this WindingNumber"):
        mesh = hk.mesh(hk.WindingNumber(*soup()), tolerance=6.4e-3, cell_size=0.1)
    facts = check(mesh)
    assert facts["made_by"] == "signs"
    assert mesh.volume == pytest.approx(1.0, abs=0.03)
    assert math.isfinite(facts["within"])


def test_both_ends_of_a_solid_are_told_of() -> None:
    ball = hk.DipolePotential(*sphere_points(1000))
    solids = [
        hk.Surface(ball, 5.0, side="above"),
        hk.Surface(ball, 8.0, side="above"),
        hk.Surface(ball, (5.0, 8.0), side="between"),
    ]
    low, high, both = (
        hk.mesh(solid, tolerance=2e-2, cell_size=0.12).metadata["harnack"] for solid in solids
    )
    for key in ("evaluations", "looked_at", "far", "undecided"):
        assert both[key] == pytest.approx(low[key] + high[key], rel=0.2, abs=20), key
    assert both["within"] == max(low["within"], high["within"])


def test_what_is_nowhere_near_the_level_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sign_isosurface, "points_off_level", lambda *_: (np.zeros((1, 3)), 1000))
    with pytest.raises(hk.MeshingError, match="farther than several cells"):
        hk.mesh(hk.WindingNumber(*icosphere(1)), cell_size=0.2)


def test_vertices_lie_on_triangles_and_creases_are_sharp() -> None:
    box = trimesh.creation.box()
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn[0] *= np.sign(np.linalg.det(turn))
    vertices = np.asarray(box.vertices) @ turn.T
    mesh = hk.mesh(hk.WindingNumber(vertices, box.faces), tolerance=7e-3, cell_size=0.1)
    facts = check(mesh)
    off = np.abs(np.abs(mesh.vertices @ turn).max(axis=1) - 0.5)
    assert np.quantile(off, 0.95) < 1e-4 * 0.1  # within edges of tetrahedra, not at their ends
    assert mesh.volume == pytest.approx(1.0, rel=2e-3)
    assert facts["far"] <= 0.05 * len(mesh.vertices)


def boxes(*ends: tuple[tuple[int, ...], tuple[int, ...]]) -> hk.WindingNumber:
    """The winding number of boxes between lowest and highest corners."""
    parts = [trimesh.creation.box(bounds=np.array(corners, float)) for corners in ends]
    whole = trimesh.util.concatenate(parts)
    return hk.WindingNumber(whole.vertices, whole.faces)


@pytest.mark.parametrize(
    ("parts", "volume"),
    [
        pytest.param(boxes(((0, 0, 0), (30, 20, 10))), 6000, id="plate"),
        pytest.param(
            boxes(((0, 0, 0), (30, 20, 10)), ((5, 5, 10), (15, 15, 35))), 8500,
            id="box on it", marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_flat_parts_and_parts_in_contact(parts: hk.WindingNumber, volume: float) -> None:
    """Their faces are planes of coordinates, in which every sign is as good as the other."""
    result = hk.mesh(parts, tolerance=0.12, cell_size=1.5)
    facts = check(result)
    assert result.volume == pytest.approx(volume, rel=1e-3)
    assert facts["far"] <= 0.01 * facts["looked_at"]
    assert facts["within"] < facts["spacing"]


@pytest.mark.few(1)
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-5, 0.0), (1.0, 1e4), (1e6, -1e7)])
def test_units_and_places(scale: float, shift: float) -> None:
    vertices, faces = icosphere(2)
    moved = scale * vertices + shift
    mesh = hk.mesh(
        hk.WindingNumber(moved, faces[3:]), tolerance=2e-2 * scale, cell_size=0.2 * scale
    )
    check(mesh)
    assert np.linalg.norm(mesh.vertices - shift, axis=1).max() < 1.001 * scale


def test_a_cloud_is_closed_and_near() -> None:
    points, _ = sphere_points(1000)
    mesh = hk.mesh(hk.DipolePotential(points, points), tolerance=2e-2, cell_size=0.12)
    check(mesh)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02
    half = hk.mesh(
        hk.DipolePotential(points, points), level=2 * math.pi, side="above", tolerance=2e-2,
        cell_size=0.12, section=hk.HalfSpace((0, 0, 1), 0.0),
    )  # fmt: skip
    check(half)
    assert half.volume == pytest.approx(2 * math.pi / 3, rel=0.03)


class Noise(hk.DipolePotential):
    """A field whose sign at each point is a matter of chance."""

    def value(self, points: Any, *, precision: Any = "single") -> Any:
        x = np.sin(1e4 * np.asarray(points, np.float64) @ [1.0, 1.7, 2.3])
        return 2 * math.pi + np.asarray(1e3 * x % 1 - 0.5)


def test_signs_by_chance_give_a_closed_surface() -> None:
    field = Noise(np.eye(3), np.eye(3))
    function = SignFunction(field, 2 * math.pi)
    function.clearance = lambda points: np.zeros(len(points))  # nothing is proved empty
    lattice = BccLattice.covering_box(np.full(3, -1.0), np.full(3, 1.0), 0.25, layers=1)
    made = extract_from_signs(function, lattice, 1e-2, print, closed=True).surface
    mesh = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent


def test_what_is_refused() -> None:
    field = hk.WindingNumber(*icosphere(1))
    with pytest.raises(TypeError, match="no normals to thicken"):
        hk.mesh(field, thickness=0.1)
    with pytest.raises(ValueError, match="level 0 of a winding number"):
        hk.mesh(field, level=0.0)
    with pytest.raises(hk.MeshingError, match="max_triangles"):
        hk.mesh(field, max_triangles=100)
