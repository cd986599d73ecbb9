"""Closed meshes: solids with caps, clips, thick surfaces, what is refused, files."""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.cli import main
from harnack.geometry import example_curves
from harnack.meshing import checks, components, thickening
from harnack.meshing.bcc_lattice import BccLattice
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh
from tests.oracles.extents import longest_side
from tests.oracles.mesh_files import read_closed

BOX = hk.Box((-1, -1, -1), (1, 1, 1))
KNOT = example_curves.torus_knot(2, 3, 64)


def is_part(mesh: Any) -> bool:
    """Closed, with its outside outside, and nowhere more than two faces at an edge."""
    checks.check_manifold(mesh.faces)
    return mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


# The lattice


def test_tetrahedra_fill_the_box_and_share_their_faces() -> None:
    lattice = BccLattice.covering_box(np.zeros(3), np.array([1.0, 2.0, 1.5]), 0.5)
    cells = np.argwhere(np.ones(lattice.counts))
    coordinates, corners = lattice.tetrahedra(cells)
    points = lattice.points(coordinates)
    t = points[corners]
    volume = np.abs(np.linalg.det(t[:, 1:] - t[:, :1])) / 6
    assert volume.min() > 0.9 * volume.max() / 2
    assert volume.sum() == pytest.approx(3.0)
    faces = np.sort(np.concatenate([np.delete(corners, k, axis=1) for k in range(4)]), axis=1)
    distinct, uses = np.unique(faces, axis=0, return_counts=True)
    assert uses.max() == 2
    once = points[distinct[uses == 1]]
    on_box = (once == lattice.lower) | (once == lattice.upper)
    assert on_box.all(axis=1).any(axis=1).all()


def test_tetrahedra_of_a_lattice_have_no_small_angles() -> None:
    """60 and 90 degrees, 45 where halves lie at the box."""
    lattice = BccLattice.covering_box(np.zeros(3), np.ones(3), 0.25)
    coordinates, corners = lattice.tetrahedra(np.argwhere(np.ones(lattice.counts)))
    t = lattice.points(coordinates)[corners]
    for i, j in itertools.combinations(range(4), 2):
        k, m = (x for x in range(4) if x not in (i, j))
        edge = t[:, j] - t[:, i]
        a, b = (np.cross(edge, t[:, x] - t[:, i]) for x in (k, m))
        cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        angles = np.degrees(np.arccos(cosine))
        assert np.isclose(angles[:, None], [45, 60, 90]).any(axis=1).all()


def test_vertices_where_faces_are_no_manifold_are_found() -> None:
    two = np.array([[0, 1, 2], [0, 3, 4]])  # fans that touch in 0
    assert checks.nonmanifold_vertices(two).tolist() == [0]
    fin = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert checks.nonmanifold_vertices(fin).tolist() == [0, 1]
    assert not len(checks.nonmanifold_vertices(np.array([[0, 1, 2], [1, 0, 3]])))


# Solids


@pytest.fixture(scope="module")
def walls() -> Any:
    """Gyroid walls |g| < 0.3 in a box."""
    return hk.mesh(hk.Gyroid(1.0, domain=BOX), level=(-0.3, 0.3), side="between", tolerance=4e-3)


def gyroid(x: np.ndarray) -> np.ndarray:
    s, c = np.sin(2 * np.pi * x), np.cos(2 * np.pi * x)
    return s[:, 0] * c[:, 1] + s[:, 1] * c[:, 2] + s[:, 2] * c[:, 0]


@pytest.mark.slow
def test_gyroid_walls_are_a_part_within_the_box(walls: Any) -> None:
    """The volume by quadrature of 400^3 points is 1.54867."""
    assert is_part(walls)
    assert walls.volume == pytest.approx(1.54867, rel=2.5e-3)
    assert np.abs(walls.vertices).max() == 1.0
    assert walls.body_count == 3
    assert walls.euler_number == -102


@pytest.mark.slow
def test_points_of_gyroid_walls_are_on_walls_or_on_caps(walls: Any) -> None:
    points = np.asarray(trimesh.sample.sample_surface(walls, 20_000, seed=0)[0])
    on_cap = np.abs(np.abs(points).max(axis=1) - 1) < 1e-9
    off = np.abs(np.abs(gyroid(points)) - 0.3)
    assert off[~on_cap].max() < 4e-3 * 7.7  # its slope is at most 2 pi sqrt(1.5)
    assert (np.abs(gyroid(points[on_cap])) < 0.3 + 4e-3 * 7.7).all()
    assert 0.05 < on_cap.mean() < 0.4


@pytest.mark.slow
def test_solids_are_given_by_levels_as_they_are_drawn() -> None:
    """The same part by `side`, by `hk.solid`, and by the domain in place of the clip."""
    settings: dict[str, Any] = {"tolerance": 3.2e-3}
    box = hk.Box((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4))
    field = hk.fields.SchwarzP(1.0, domain=box)
    walls = hk.mesh(field, level=(-0.2, 0.2), side="between", **settings)
    clipped = hk.mesh(hk.solid(hk.fields.SchwarzP(1.0), between=(-0.2, 0.2)), clip=box, **settings)
    assert is_part(walls)
    assert walls.volume == pytest.approx(clipped.volume, rel=1e-9)
    inside = hk.mesh(field, level=-0.2, side="below", **settings)
    outside = hk.mesh(field, level=0.2, side="above", **settings)
    assert is_part(inside)
    assert is_part(outside)
    assert walls.volume + inside.volume + outside.volume == pytest.approx(0.8**3, rel=1e-6)


def lens(r: float, s: float, d: float) -> float:
    """Of two balls of radii r and s, d apart, what they have in common."""
    return (
        math.pi * (r + s - d) ** 2 * (d * d + 2 * d * (r + s) - 3 * (r - s) ** 2) / (12 * d)
    )  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (hk.Sphere(0.8), 4 / 3 * math.pi * 0.512),
        (hk.Sphere(0.8) - hk.Sphere(0.5).translated((0.6, 0, 0)),
         4 / 3 * math.pi * 0.512 - lens(0.8, 0.5, 0.6)),
        (hk.Sphere(0.8) | hk.Sphere(0.5).translated((0.6, 0, 0)),
         4 / 3 * math.pi * (0.512 + 0.125) - lens(0.8, 0.5, 0.6)),
        (hk.Sphere(0.8) & ~hk.solids.Plane((0, 0, 1), 0.0), 2 / 3 * math.pi * 0.512),
        (hk.Torus(0.8, 0.2).rotated(20, "x"), 2 * math.pi**2 * 0.8 * 0.04),
    ],
    ids=["ball", "difference", "union", "half", "torus"],
)  # fmt: skip
def test_volumes_of_solids(part: Any, volume: float) -> None:
    mesh = hk.mesh(part, tolerance=3.3e-3)
    assert is_part(mesh)
    assert mesh.volume == pytest.approx(volume, rel=8e-3)


def test_boxes_are_exact_and_so_are_their_creases() -> None:
    part = hk.Cuboid((1.0, 0.8, 0.6)) - hk.Cuboid((0.4, 0.4, 2.0)).rotated(45, "z")
    mesh = hk.mesh(part)
    assert is_part(mesh)
    assert mesh.volume == pytest.approx((1 - 0.16) * 0.8 * 0.6 + 0.16 * 0.8 * 0.6 - 0.16 * 0.6)
    assert len(mesh.faces) < 100
    assert mesh.euler_number == 0


@pytest.mark.parametrize(
    "part",
    [
        hk.Cuboid((1.0, 0.8, 0.6)).translated((1, 2, 3)),
        hk.Cuboid((1.0, 0.8, 0.6)).rotated(30, (1, 1, 0)).translated((100, 0, 0)),
        hk.Cuboid((1.0, 0.8, 0.6)).scaled(0.5).rotated(20, "x").scaled(2),
    ],
    ids=["moved", "rotated", "scaled"],
)
def test_boxes_anywhere_are_twelve_triangles(part: hk.solids.Solid) -> None:
    mesh = hk.mesh(part)
    assert is_part(mesh)
    assert len(mesh.faces) == 12
    assert mesh.volume == pytest.approx(0.48, rel=1e-6)


def test_balls_cut_solids() -> None:
    ball = hk.Ball((0.1, 0.2, 0.3), 0.7)
    mesh = hk.mesh(~hk.Sphere(0.3), clip=ball, tolerance=2.8e-3)
    assert is_part(mesh)
    assert (np.linalg.norm(mesh.vertices - ball.center, axis=1) <= 0.7 * (1 + 1e-12)).all()
    expected = 4 / 3 * math.pi * (0.7**3 - 0.3**3)
    assert mesh.volume == pytest.approx(expected, rel=5e-3)


@pytest.mark.slow
def test_a_thick_seifert_surface_ends_at_the_knot() -> None:
    """The two sides of a solid around a level of an angle share the vertices of the curve."""
    solid = hk.solid(hk.SolidAngle(KNOT), around=(2 * math.pi, 0.3))
    mesh = hk.mesh(solid, tolerance=1.3e-2)
    assert is_part(mesh)
    assert mesh.euler_number == -2  # of two surfaces of -1 each
    stored = {tuple(v) for v in mesh.vertices.tolist()}
    assert all(tuple(v) in stored for v in KNOT.tolist())


# Open surfaces that are cut


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "clip",
    [
        hk.Ball((0.1, 0, 0), 0.5),
        hk.HalfSpace((1, 1, 0), 0.1 / math.sqrt(2)),
        hk.Box((0, 0, 0), (1, 1, 1)),
    ],
)
def test_spheres_that_are_cut_have_the_area_left(clip: Any) -> None:
    """Of a sphere of radius r, a plane at height h leaves 2 pi r (r + h) or 2 pi r (r - h)."""
    mesh = hk.mesh(hk.Sphere(0.5), side="surface", clip=clip, tolerance=2e-3)
    checks.check_manifold(mesh.faces)
    assert clip.padded(1e-12).contains_points(mesh.vertices).all()
    expected = {
        hk.Ball: 2 * math.pi * 0.5 * (0.5 - 0.05),
        hk.HalfSpace: 2 * math.pi * 0.5 * (0.5 + 0.1 / math.sqrt(2)),
        hk.Box: 4 * math.pi * 0.25 / 8,
    }[type(clip)]
    assert mesh.area == pytest.approx(expected, rel=5e-3)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    assert len(rim) > 20
    if isinstance(clip, hk.Ball):
        np.testing.assert_allclose(np.linalg.norm(rim - clip.center, axis=1), 0.5, atol=1e-8)


@pytest.mark.slow
def test_a_level_without_extent_is_cut_by_the_clip() -> None:
    curve = example_curves.wavy_polygon(32)
    mesh = hk.mesh(
        hk.SolidAngle(curve),
        level=4 * math.pi,
        clip=hk.Ball(radius=2.0),
        tolerance=4.4e-2,
        cell_size=0.2,
    )
    assert np.linalg.norm(mesh.vertices, axis=1).max() <= 2 * (1 + 1e-9)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    stored = {tuple(v) for v in rim.tolist()}
    assert all(tuple(v) in stored for v in curve.tolist())
    others = rim[[tuple(v) not in {tuple(c) for c in curve.tolist()} for v in rim.tolist()]]
    assert np.abs(np.linalg.norm(others, axis=1) - 2).min() < 1e-8


# Thickness


@pytest.mark.slow
def test_a_thick_surface_has_the_volume_of_area_times_thickness() -> None:
    mesh = hk.mesh(hk.SolidAngle(KNOT), thickness=0.06, tolerance=6.4e-3)
    facts = mesh.metadata["harnack"]
    assert is_part(mesh)
    assert facts["thickened_by"] == "offset"
    assert mesh.volume == pytest.approx(facts["area"] * 0.06, rel=5e-3)
    assert not len(intersecting_faces(mesh.vertices, mesh.faces))
    assert facts["euler_characteristic"] == -2


@pytest.mark.slow
def test_a_thick_sphere_is_a_shell() -> None:
    mesh = hk.mesh(hk.Sphere(0.8), thickness=0.1, tolerance=3.2e-3)
    assert is_part(mesh)
    assert mesh.body_count == 2
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * (0.85**3 - 0.75**3), rel=5e-3)


@pytest.mark.slow
def test_beyond_its_reach_a_surface_is_made_of_hulls() -> None:
    """A small sphere, thicker than its diameter, is a ball."""
    mesh = hk.mesh(hk.Sphere(0.3), thickness=0.8, tolerance=0.03, cell_size=0.2)
    facts = mesh.metadata["harnack"]
    assert is_part(mesh)
    assert facts["thickened_by"] == "hulls of balls"
    assert "turn over" in facts["why"] or "nearer" in facts["why"]
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=0.15)


def test_too_many_hulls_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thickening, "_MOST_HULLS", 10)
    with pytest.raises(hk.MeshingError, match="reach"):
        hk.mesh(hk.Sphere(0.3), thickness=0.8, tolerance=0.03, cell_size=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "volume", "bodies"),
    [
        (hk.Sphere(0.5) | hk.Sphere(0.5).translated((1, 0, 0)), math.pi / 3, 2),
        (hk.Sphere(0.5) | hk.Sphere(0.5), math.pi / 6, 1),
        (hk.Sphere(0.5).translated((1e6, 0, 0)), math.pi / 6, 1),
        (hk.Sphere(1e-6), 8e-18 * math.pi / 6, 1),
        (hk.Sphere(1e6), 8e18 * math.pi / 6, 1),
        (hk.Cuboid((1.0,) * 3) | hk.Cuboid((1.0,) * 3).translated((1, 0, 0)), 2.0, 1),
    ],
    ids=["touching", "twice", "far", "tiny", "huge", "sharing a face"],
)
def test_parts_that_touch_or_are_far(part: Any, volume: float, bodies: int) -> None:
    mesh = hk.mesh(part, tolerance=4e-3 * longest_side(part))
    assert is_part(mesh)
    assert mesh.body_count == bodies
    assert mesh.volume == pytest.approx(volume, rel=1e-2)


# Last steps


@pytest.mark.slow
def test_simplified_parts_are_within_the_tolerance() -> None:
    settings: dict[str, Any] = {"clip": hk.Box((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4))}
    tolerance = 8e-3
    mesh = hk.mesh(
        hk.Gyroid(1.0), level=0.0, side="above", simplify=True, tolerance=tolerance, **settings
    )
    assert is_part(mesh)
    assert len(mesh.faces) < 0.7 * mesh.metadata["harnack"]["triangles_before_simplification"]
    points = np.asarray(trimesh.sample.sample_surface(mesh, 10_000, seed=0)[0])
    field = hk.Gyroid(1.0)
    steep = np.linalg.norm(field.gradient(points, precision="double"), axis=1)
    # From the wall, or from the caps if inside.
    apart = np.minimum(np.abs(gyroid(points)) / steep, 0.4 - np.abs(points).max(axis=1))
    assert apart.max() < tolerance


@pytest.mark.slow
def test_the_largest_part_is_kept() -> None:
    both = hk.Sphere(0.3) | hk.Sphere(0.5).translated((1.5, 0, 0))
    mesh = hk.mesh(both, largest=True, tolerance=9e-3)
    assert is_part(mesh)
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.125, rel=1e-2)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("part", "arguments", "volume"),
    [
        (hk.Sphere(1.0) - hk.Sphere(0.5), {}, 4 / 3 * math.pi * (1 - 0.125)),
        (~hk.Sphere(0.8), {"clip": BOX}, 8 - 4 / 3 * math.pi * 0.512),
        (hk.Sphere(0.8), {"thickness": 0.2}, 4 / 3 * math.pi * (0.9**3 - 0.7**3)),
    ],
    ids=["hollow ball", "box with a hole", "thick sphere"],
)
def test_the_largest_part_keeps_its_cavities(part: Any, arguments: Any, volume: float) -> None:
    mesh = hk.mesh(part, largest=True, tolerance=4e-2, **arguments)
    assert is_part(mesh)
    assert mesh.volume == pytest.approx(volume, rel=2e-2)


def test_cavities_belong_to_the_innermost_shell_around_them() -> None:
    """A ball in the cavity of another one has a cavity itself; beside them lies a ball which is
    smaller than the outer shell and larger than what that bounds."""
    ball = trimesh.creation.icosphere(2)
    unit = TriangleMesh(np.array(ball.vertices), np.array(ball.faces, np.int64))
    shells = [(1.0, 0.0, False), (0.8, 0.0, True), (0.6, 0.0, False), (0.2, 0.0, True)]

    def nested(*rows: tuple[float, float, bool]) -> TriangleMesh:
        moved = [r * unit.vertices + np.array([x, 0, 0]) for r, x, _ in rows]
        faces = [unit.faces[:, ::-1] if inwards else unit.faces for _, _, inwards in rows]
        n = len(unit.vertices)
        return TriangleMesh(np.concatenate(moved), np.concatenate(
            [one + k * n for k, one in enumerate(faces)]))  # fmt: skip

    def kept(surface: TriangleMesh) -> float:
        body = components.largest_body(surface)
        return float(trimesh.Trimesh(body.vertices, body.faces, process=False).volume)

    whole = float(ball.volume)
    assert kept(nested(*shells)) == pytest.approx((1 - 0.8**3) * whole)
    assert kept(nested(*shells, (0.9, 2.0, False))) == pytest.approx(0.9**3 * whole)
    assert kept(nested((0.7, 0.0, True), *shells[2:], (0.75, 0.0, False))) == pytest.approx(
        (0.6**3 - 0.2**3) * whole
    )
    with pytest.raises(hk.MeshingError, match="inside out"):
        kept(nested((1.0, 0.0, True)))


class Holed(hk.solids.FormulaSolid):
    """A sphere that is no number beside its center."""

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return hk.math.sqrt(x * x + y * y + z * z - 0.3) - 0.7


CURVE = hk.SolidAngle(example_curves.wavy_polygon(12))
WALLS: dict[str, Any] = {"level": (-0.3, 0.3), "side": "between"}


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("field", "arguments", "message"),
    [
        (hk.Gyroid(1.0), WALLS | {"thickness": 0.1}, "either side or thickness"),
        (hk.Gyroid(1.0), WALLS | {"level": (0.3, -0.3)}, "low < high"),
        (hk.Gyroid(1.0), WALLS | {"level": (-math.inf, math.inf)}, "level must be finite"),
        (hk.Gyroid(1.0), WALLS | {"level": (math.nan, 0.3)}, "level must be finite"),
        (hk.Gyroid(1.0), WALLS | {"level": 0.3}, "two levels.*and 1 are given: 0.3"),
        (hk.Gyroid(1.0), {"side": True}, 'side must be one of "surface", "below"'),
        (hk.Gyroid(1.0), WALLS | {"level": (-9.0, 9.0)}, "no surface has level"),
        (hk.Gyroid(1.0), WALLS | {"side": "below"}, "one level, and 2 are given: -0.3, 0.3"),
        (~hk.Sphere(0.5), {}, "where it ends"),
        (hk.Sphere(0.5), {"clip": hk.Box((1, 1, 1), (2, 2, 2))}, "empty"),
        (hk.Sphere(0.5), {"side": "surface", "clip": hk.Ball((3, 0, 0), 1)}, "empty"),
        (hk.Sphere(0.5) & hk.Sphere(0.5).translated((3, 0, 0)), {}, "empty"),
        (hk.Sphere(0.5), {"clip": "box"}, "must be a volume"),
        (hk.Sphere(0.5), {"thickness": 0.0}, "thickness must be a positive length"),
        (hk.Sphere(0.5), {"thickness": -1.0}, "thickness must be a positive length"),
        (hk.Sphere(0.5), {"thickness": math.inf}, "thickness must be a positive length"),
        (hk.Sphere(0.5), {"thickness": "thick"}, "must be a number"),
        (hk.Sphere(0.5), {"tolerance": math.nan}, "tolerance"),
        (hk.Sphere(0.5), {"tolerance": 1e-12}, "triangles"),
        (hk.Sphere(0.5), {"cell_size": 1e-7}, "cells"),
        (hk.Gyroid(1.0), WALLS | {"level": (-1e-8, 1e-8), "clip": BOX}, "thick, and its sides"),
        (hk.Gyroid(1.0), WALLS | {"level": (-1e-3, 1e-3), "clip": BOX}, "thick, and its sides"),
        (hk.Gyroid(1.0), WALLS | {"clip": hk.Box((0, 0, 0), (1, 1, 0))}, "empty"),
        (CURVE, {"simplify": True}, "closed meshes"),
        (CURVE, {"level": 1.0, "side": "above"}, "angle-valued"),
        (CURVE, {"clip": hk.Ball((9, 9, 9), 1)}, "empty"),
        (CURVE, {"tolerance": 1e-9}, "triangles"),
        (hk.fields.RiemannSurface("log"), {}, "angle-valued"),
        (Holed(), {"clip": BOX}, "no finite value"),
    ],
)  # fmt: skip
def test_what_is_no_part_is_refused(field: Any, arguments: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        hk.mesh(field, **arguments)


# Files


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "glb", "3mf"])
def test_files_of_every_format_are_closed_when_read_again(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"part.{kind}"
    command = ["mesh", "gyroid", "--tolerance", "0.006", "--scale", "10", "--quiet"]
    command += ["--clip", "box:-.3,-.3,-.3,.3,.3,.3", "-o", str(path)]
    assert main(command) == 0
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    again = read_closed(path)
    np.testing.assert_allclose(again.bounds, [[-3] * 3, [3] * 3], atol=1e-5)


def test_formats_whose_packages_lack_are_refused_early(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.delitem(sys.modules, "pxr.Usd", raising=False)
    assert main(["mesh", "trefoil", "-o", str(tmp_path / "a.usda")]) == 1
    assert "pip install 'harnack[usd]'" in capsys.readouterr().err


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-o", "a.step"], "no extension of a mesh"),
        (["-o", "missing/a.stl"], "create the folder"),
        (["--level", "1,0", "--side", "between"], "low < high, not (1.0, 0.0)"),
        (["--clip", "ball:1,2"], "4 numbers"),
        (["--thickness", "0"], "positive"),
        (["--max-triangles", "1000"], "--max-triangles"),
        (["--max-triangles", "0"], "--max-triangles: '0' must be a whole number"),
        (["--clip", "cube:0,0,0,1"], "is no volume; write ball:X,Y,Z,RADIUS"),
    ],
)
def test_wrong_commands_are_refused(
    options: list[str], said: str, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["mesh", "trefoil", *options])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code != 0
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert sys.exc_info() == (None, None, None)
