"""What leaves `harnack.mesh` has been checked, and what cannot be done raises in time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry.example_meshes import bumpy_sphere
from harnack.mesh_to_file import write_mesh
from harnack.meshing.checks import check_inside, check_near_level, check_no_self_intersection
from harnack.meshing.closed_export import ClosedMesh
from harnack.meshing.finishing import simplify_mesh
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import LocalizedMeshingError, MeshingError, TriangleLimitError
from harnack.meshing.triangle_mesh import TriangleMesh
from tests.oracles.extents import longest_side
from tests.oracles.mesh_files import read_closed

_BALL = trimesh.creation.icosphere(subdivisions=3)
_FACES = np.asarray(_BALL.faces, np.int64)


def test_open_meshes_are_not_shown_as_closed() -> None:
    result = ClosedMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    assert repr(result).startswith("<trimesh.Trimesh(")


def test_a_limit_of_triangles_is_named():
    with pytest.raises(TriangleLimitError, match="max_triangles"):
        hk.mesh(hk.Sphere(1.0), max_triangles=1000)
    with pytest.raises(TriangleLimitError, match="max_triangles is 9,000"):
        hk.mesh(hk.Sphere(1.0), max_triangles=9000, tolerance=2e-5)
    with pytest.raises(ValueError, match="max_triangles must be an integer from 1"):
        hk.mesh(hk.Sphere(1.0), max_triangles=0)


def test_vertices_and_centers_are_looked_at():
    function = LevelFunction(hk.Sphere(1.0), 0.0)
    x = np.array(_BALL.vertices, np.float64)
    check_near_level(function, x, _FACES, 0.02, None)
    with pytest.raises(LocalizedMeshingError, match="farther than the tolerance"):
        check_near_level(function, x, _FACES, 1e-3, None)  # the centers are not so near
    x[7] *= 1.05
    with pytest.raises(LocalizedMeshingError, match="farther than the tolerance") as refusal:
        check_near_level(function, x, _FACES, 0.02, None)
    assert (np.linalg.norm(refusal.value.locations - x[7], axis=1) == 0).any()
    check_inside(x, hk.Ball((0, 0, 0), 2.0), 0.0)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.Box((-1, -1, -1), (1, 1, 0.5)), 0.1)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.HalfSpace((1, 1, 1), 1.0 / math.sqrt(3)), 0.1)
    check_inside(x, hk.Ball((0, 0, 0), 0.95), 0.1)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.Ball((0, 0, 0), 0.95), 0.01)


def test_faces_through_each_other_are_found():
    x = np.array(_BALL.vertices, np.float64)
    check_no_self_intersection(x, _FACES)
    both = np.concatenate([x, x + np.array([0.3, 0.1, 0.2])])
    with pytest.raises(LocalizedMeshingError, match="pass through each other"):
        check_no_self_intersection(both, np.concatenate([_FACES, _FACES + len(x)]))
    x[0, 0] = math.nan
    with pytest.raises(MeshingError, match="no numbers"):
        check_no_self_intersection(x, _FACES)


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "glb", "3mf", "off"])
def test_edges_shorter_than_single_precision_do_not_open_a_file(tmp_path: Path, kind: str):
    # A vertex 5e-11 from another, in the middle of an edge's two faces, as booleans leave them.
    x = np.array(_BALL.vertices, np.float64)
    a, b = (int(v) for v in _BALL.edges_unique[0])
    beside = [f for f in range(len(_FACES)) if {a, b} <= set(_FACES[f].tolist())]
    new, rest = len(x), np.delete(_FACES, beside, axis=0)
    halves = [np.where(_FACES[f] == old, new, _FACES[f]) for f in beside for old in (a, b)]
    middle = x[a] + 5e-11 * (x[b] - x[a])
    made = trimesh.Trimesh(
        np.concatenate([x, [middle]]), np.concatenate([rest, halves]), process=False
    )
    assert made.is_watertight
    path = tmp_path / f"a.{kind}"
    ClosedMesh.of(made).export(path)
    assert len(read_closed(path).faces) == len(_FACES)


_CUBE = hk.Cuboid((1.0,) * 3)
_CARVED = hk.Sphere(1.0) - hk.Cuboid((1.0, 1.0, 4.0))


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("part", "message"),
    [
        (_CARVED.scaled(1e-5), r"2e-05 long.*scale it \(apply_scale\)"),
        (hk.Torus(0.8, 0.3).translated((1e6, 0, 0)), r"up to 1e\+06 from the origin.*move it"),
        (
            (hk.Torus(0.8, 0.3) | hk.Cuboid((0.4, 0.4, 2.0))).translated((1e6, 0, 0)),
            "move it to the",
        ),
        (
            _CUBE.translated((-0.5, -0.5, 0)) | _CUBE.translated((0.5, 0.5, 0)),
            r"parts touch.*near \(0, 0,",
        ),
        (
            _CUBE.translated((-0.5,) * 3) | _CUBE.translated((0.5,) * 3),
            r"parts touch.*near \(0, 0, 0\)",
        ),
    ],
    ids=["tiny", "far", "union far", "touching in an edge", "touching in a point"],
)
def test_what_is_closed_in_memory_and_not_in_a_file_is_not_written(
    part: hk.solids.Solid, message: str, tmp_path: Path
):
    mesh = hk.mesh(part, tolerance=2e-2 * longest_side(part))
    assert mesh.is_watertight
    for copy in (mesh, mesh.copy()):
        with pytest.raises(hk.MeshingError, match=message):
            copy.export(tmp_path / "a.stl")
    with pytest.raises(hk.MeshingError, match=message):
        write_mesh(mesh, tmp_path / "a.stl")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_what_was_refused_is_right_once_it_is_moved_and_scaled(tmp_path: Path):
    mesh = hk.mesh(hk.Torus(0.8, 0.3).translated((1e6, 0, 0)), tolerance=4.5e-2)
    mesh.apply_translation((-1e6, 0, 0))
    mesh.apply_scale(1e20)
    with pytest.raises(hk.MeshingError, match=r"up to 6.9e\+10.*scale it"):
        mesh.export(tmp_path / "a.ply")
    mesh.apply_scale(1e-23)
    mesh.visual.face_colors = np.arange(len(mesh.faces))[:, None] % 256 * [1, 0, 0, 0] + [
        0, 0, 0, 255]  # fmt: skip
    mesh.export(tmp_path / "a.ply")
    read = read_closed(tmp_path / "a.ply")
    assert read.volume == pytest.approx(2 * math.pi**2 * 0.8 * 0.09e-9, rel=5e-2)
    assert (read.visual.face_colors == mesh.visual.face_colors).all()
    assert "harnack" in mesh.metadata


@pytest.mark.few(1)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3, 1e10])
def test_slivers_that_turn_over_in_single_precision_are_left_out(scale: float, tmp_path: Path):
    """A vertex in the middle of a face, 1e-9 from one of its edges: rounded, it lies beyond it."""
    x = np.array(_BALL.vertices, np.float64)
    corner = x[_FACES]
    rng = np.random.default_rng(1)
    share = rng.uniform(0.2, 0.8, (len(_FACES), 1))
    inwards = 1e-9 * (corner.mean(axis=1) - corner[:, 0])
    new = corner[:, 0] + share * (corner[:, 1] - corner[:, 0]) + inwards
    n = len(x) + np.arange(len(_FACES))
    parts = [np.column_stack([_FACES[:, k], _FACES[:, (k + 1) % 3], n]) for k in range(3)]
    made = ClosedMesh(scale * np.concatenate([x, new]), np.concatenate(parts), process=False)
    check_no_self_intersection(np.array(made.vertices), np.array(made.faces))
    path = tmp_path / "a.stl"
    made.export(path)
    assert read_closed(path).volume == pytest.approx(made.volume, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "tolerance"),
    [
        (
            hk.Surface(
                hk.Gyroid(1.0), (-0.3, 0.3), side="between", clip=hk.Box((-0.3,) * 3, (0.3,) * 3)
            ),
            5e-3,
        ),
        (hk.Surface(_CARVED), 1.6e-2),
    ],
    ids=["walls", "carved"],
)
def test_simplified_meshes_have_no_more_triangles_than_without(
    surface: hk.Surface, tolerance: float
):
    """They were made within half of the tolerance first, which took more than was left out."""
    plain = hk.mesh(surface, tolerance=tolerance)
    fewer = hk.mesh(surface, tolerance=tolerance, simplify=True)
    assert fewer.is_watertight
    facts = fewer.metadata["harnack"]
    assert facts["triangles_before_simplification"] == len(plain.faces)
    assert len(fewer.faces) <= len(plain.faces)
    assert fewer.volume == pytest.approx(plain.volume, rel=2e-2)


def test_simplification_keeps_what_no_simpler_mesh_passes_the_check_for():
    ball = TriangleMesh(np.array(_BALL.vertices), _FACES)

    def never(surface: TriangleMesh) -> None:
        raise MeshingError("no")

    assert simplify_mesh(ball, 0.1, never)[0] is ball
    assert len(simplify_mesh(ball, 0.1, lambda surface: None)[0].faces) < len(_FACES)


_GYROID = hk.Gyroid(5.0)
_WALLS = hk.solid(_GYROID, between=(-0.3, 0.3))


def test_solids_know_the_waves_they_are_made_of():
    wave = 5 / math.sqrt(2)  # sin x cos y is two waves along diagonals
    below = hk.solid(_GYROID, below=0.0)
    for part, expected in [
        (_GYROID, wave),
        (hk.fields.SchwarzP(5.0), 5.0),
        (_WALLS, wave),
        (~_WALLS, wave),
        (_WALLS.offset(0.1), wave),
        (_WALLS.translated((1, 2, 3)).rotated(30, "x").scaled((1.0, 2.0, 0.5)), 0.5 * wave),
        (_WALLS & hk.Sphere(1.0) | hk.solid(hk.fields.SchwarzP(2.0), below=0.0), 2.0),
        (below.twisted(math.degrees(0.1)), wave),
        (below.tapered((0, 1.0), (1, 0.5)), 0.5 * wave),
        (below.blended(hk.Sphere(1.0), 0.1), wave),
        (hk.fields.EigenfunctionSum(
            [hk.fields.PlaneWave(1.0, (1, 0, 0)), hk.fields.PlaneWave(1e-9, (90, 0, 0))]),
         2 * math.pi),
        (hk.fields.FourierSeries(np.eye(4)[3].reshape(4, 1, 1), hk.Box((0, 0, 0), (3, 1, 1))), 2.0),
    ]:  # fmt: skip
        assert part.traits.min_wavelength == pytest.approx(expected, rel=1e-5)
    assert (hk.Sphere(1.0) | hk.Torus(0.8, 0.3)).traits.min_wavelength is None


def _volume(part: hk.solids.Solid, half: tuple[float, float, float], step: float) -> float:
    """By the middles of cells within a box."""
    axes = [np.arange(-h + 0.5 * step, h, step) for h in half]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return float((part.value(points) < 0).sum()) * step**3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "half", "bodies"),
    [
        (hk.solid(hk.fields.SchwarzP(1.0), between=(-0.3, 0.3)) & hk.Cylinder(0.6, 12.0),
         (0.6, 0.6, 6.0), 1),
        (_WALLS.scaled(0.1) & hk.Cylinder(0.3, 6.0), (0.3, 0.3, 3.0), 1),
        (_WALLS & hk.Cylinder(5.0, 20.0), (5.0, 5.0, 10.0), None),
    ],
    ids=["Schwarz P", "gyroid", "gyroid of 20 mm"],
)  # fmt: skip
def test_cells_are_as_small_as_a_lattice_needs(
    part: hk.solids.Solid, half: tuple[float, float, float], bodies: int | None
):
    """A 24th of these parts is a third of a cell or half of it, where walls are missed, or found
    in pieces, the wrong volume and all."""
    mesh = hk.mesh(part, tolerance=(1.5e-3 if bodies else 4e-3) * longest_side(part))
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["spacing"] < part.traits.min_wavelength / 4.999
    assert mesh.volume == pytest.approx(
        _volume(part, half, half[2] / (400 if bodies else 150)), rel=2e-2 if bodies else 3e-2
    )
    assert bodies is None or mesh.body_count == bodies


@pytest.mark.slow
def test_a_spacing_that_is_asked_for_is_not_changed_for_waves():
    part = hk.solid(hk.fields.SchwarzP(1.0), below=0.0) & hk.Cuboid((0.6, 0.6, 6.0))
    assert hk.mesh(part, cell_size=0.25, tolerance=0.12).metadata["harnack"]["spacing"] == 0.25
    with pytest.raises(TriangleLimitError, match="max_triangles"):
        hk.mesh(part, tolerance=0.12, max_triangles=500)


@pytest.mark.slow
def test_thin_parts_are_made_finer_until_no_faces_pass_through_each_other():
    mesh = hk.mesh(hk.Cylinder(0.01, 2.0), tolerance=8e-3)
    assert mesh.is_watertight
    check_no_self_intersection(np.array(mesh.vertices), np.array(mesh.faces))
    x = np.array(mesh.triangles_center)
    assert (np.hypot(x[:, 0], x[:, 1]) <= 0.01 + 1e-9).all()


@pytest.mark.slow
def test_sharp_creases_are_found_and_not_cut_into_ever_smaller_triangles():
    made = hk.mesh(hk.Cylinder(0.3, 2.0).translated((0.2, 0, 0)))
    assert made.is_watertight
    assert len(made.faces) < 10_000
    x = np.concatenate([made.vertices, made.triangles_center]) - (0.2, 0, 0)
    f = np.maximum(np.hypot(x[:, 0], x[:, 1]) - 0.3, np.abs(x[:, 2]) - 1)
    assert np.abs(f).max() < 2.1e-3
    assert abs(made.volume / (2 * math.pi * 0.09) - 1) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("n", [300, 700])
def test_a_cloud_by_dipoles_is_right(n: int):
    points, index = trimesh.sample.sample_surface(_BALL, n, seed=n)
    normals = np.asarray(_BALL.face_normals)[index]
    field = hk.DipolePotential(points, normals, areas=np.full(n, _BALL.area / n), accuracy=8)
    mesh = hk.mesh(field, largest=True, tolerance=1e-2)
    assert mesh.is_watertight
    assert abs(mesh.volume / _BALL.volume - 1) < 0.03

    def above(x: Any) -> Any:
        r = points - x[..., None, :]
        terms = (r * normals).sum(axis=-1) / np.linalg.norm(r, axis=-1) ** 3
        return terms.sum(axis=-1) * _BALL.area / n - field.default_level

    # Values near a point are so steep that they tell no distance: most vertices are on the level,
    # and it passes each of the others within the tolerance.
    x = np.array(mesh.vertices)
    value = above(x)
    off = np.abs(value) > 1e-4 * 4 * math.pi
    assert off.mean() < 0.25
    tolerance = 2e-3 * np.linalg.norm(mesh.extents)
    ways = trimesh.creation.icosphere(subdivisions=1).vertices
    passes = np.zeros(off.sum(), bool)
    for part in (0.05, 0.2, 0.5, 1.0):
        around = above(x[off, None] + part * tolerance * ways)
        passes |= (np.sign(around) != np.sign(value[off, None])).any(axis=1)
    assert passes.all()


def test_the_outside_of_a_closed_mesh_has_no_end() -> None:
    """It was closed at the walls of the box in which it was meshed, without a word."""
    field = hk.WindingNumber(*bumpy_sphere(1))
    with pytest.raises(MeshingError, match="reaches to infinity: choose the other side, or give a"):
        hk.mesh(field, side="below", cell_size=0.4)
    shell = hk.mesh(field, side="below", cell_size=0.4, clip=hk.Box((-2, -2, -2), (2, 2, 2)))
    inside = hk.mesh(field, side="above", cell_size=0.4)
    assert shell.volume + inside.volume == pytest.approx(64.0, rel=1e-3)
