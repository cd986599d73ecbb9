"""What `check_print` and `thickness` say of meshes whose faults and walls are known."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.cli import main
from harnack.files.file_geometry import FileFormatError
from harnack.geometry import example_meshes

PLATE = trimesh.creation.box((20.0, 10.0, 2.0))
FINE_PLATE = PLATE.subdivide().subdivide()


def kinds(part: Any, **options: Any) -> dict[str, int]:
    return {one.kind: one.count for one in hk.check_print(part, **options).problems}


def test_a_plate_is_fine() -> None:
    found = hk.check_print(PLATE, min_thickness=1.9, build_volume=(10.0, 20.0, 2.0))
    assert found.is_printable
    assert [one.kind for one in found.problems] == ["walls measured coarsely"]
    assert hk.check_print(PLATE, build_volume=(10.0, 20.0, 2.0)).problems == ()
    assert found.volume == pytest.approx(400.0)
    assert found.size == (20.0, 10.0, 2.0)


def test_faults_are_named_and_placed() -> None:
    x, faces = np.array(PLATE.vertices), np.array(PLATE.faces)
    assert kinds((x, faces[1:])) == {"open edges": 3}
    turned = faces.copy()
    turned[0] = turned[0][::-1]
    assert kinds((x, turned)) == {"sides that disagree": 3}
    assert kinds((x, faces[:, ::-1])) == {"inside out": 1}
    twice = kinds((x, np.concatenate([faces, faces[:1]])))
    assert twice == {"edges of many faces": 3, "duplicate faces": 1}
    opened = hk.check_print((x, faces[1:])).problems[0]
    assert opened.message.startswith("3 edges have one face alone, such as at (")
    ends = x[faces[0]]
    middles = 0.5 * (ends + np.roll(ends, 1, axis=0))
    assert {*map(tuple, opened.locations)} == {*map(tuple, middles)}


def test_parts_that_cross_are_found() -> None:
    other = PLATE.copy()
    other.apply_translation((10.0, 3.0, 0.7))
    both = trimesh.util.concatenate([PLATE, other])
    found = kinds(both)
    assert found["crossing faces"] >= 4
    assert found["loose parts"] == 2
    far = PLATE.copy()
    far.apply_translation((50.0, 0.0, 0.0))
    apart = hk.check_print(trimesh.util.concatenate([PLATE, far]))
    assert apart.is_printable  # a hint alone
    assert [one.kind for one in apart.problems] == ["loose parts"]


def test_cavities_and_tiny_parts() -> None:
    inner = PLATE.copy()
    inner.apply_scale(0.5)
    inner.invert()
    hollow = trimesh.util.concatenate([PLATE, inner])
    assert kinds(hollow) == {"cavities": 1}
    assert "1 cavity has no way out" in hk.check_print(hollow).problems[0].message
    assert hk.check_print(hollow).volume == pytest.approx(400 * (1 - 0.125))
    crumb = trimesh.creation.icosphere(1, 0.05)
    crumb.apply_translation((30.0, 0.0, 0.0))
    assert kinds(trimesh.util.concatenate([PLATE, crumb])) == {"tiny parts": 1, "loose parts": 2}


def test_thin_walls_beds_and_units() -> None:
    assert kinds(FINE_PLATE, min_thickness=2.1)["thin walls"] == 2 * len(FINE_PLATE.faces) // 6
    assert "thin walls" not in kinds(FINE_PLATE, min_thickness=2.0)  # no thinner than asked
    assert kinds(PLATE, build_volume=(19.0, 30.0, 5.0)) == {}
    assert kinds(PLATE, build_volume=(19.0, 19.0, 5.0)) == {"bed": 1}
    small = PLATE.copy()
    small.apply_scale(1 / 25.4)
    assert kinds(small) == {"unit": 1}
    with pytest.raises(ValueError, match="min_thickness must be positive and finite"):
        hk.check_print(PLATE, min_thickness=-1.0)


def test_thickness_is_that_of_plates_balls_and_wedges() -> None:
    plate = hk.printing.wall_thickness(FINE_PLATE)
    assert np.unique(plate.values.round(5)).tolist() == [2.0, 10.0, 20.0]
    assert plate.thinnest == pytest.approx(2.0, abs=1e-5)
    assert (np.abs(plate.thin_locations(3.0)[:, 2]) == 1.0).all()
    # The widest ball within an inscribed polyhedron of the unit sphere.
    ball = hk.printing.wall_thickness(example_meshes.icosphere(3))
    assert 1.98 < ball.thinnest <= ball.values.max() < 2.0
    # A wedge of half-angle a: the ball that touches one side at a distance s from the edge touches
    # the other as well if its radius is s tan a.
    half = np.array([[0, 0, -1.0], [0, 0, 1], [10, 0, -1], [10, 0, 1], [0, 1, -1], [0, 1, 1]])
    wedge = trimesh.convex.convex_hull(half)
    for _ in range(4):
        wedge = wedge.subdivide()
    found = hk.printing.wall_thickness(wedge)
    center = wedge.triangles_center
    side = (wedge.face_normals[:, 1] < -0.9) & (center[:, 0] > 3)
    side &= np.abs(center[:, 2]) < 0.6  # beside the ends the ray's length is given
    expected = 2 * (10 - center[side, 0]) * np.tan(0.5 * np.arctan(0.1))
    assert found.values[side] == pytest.approx(expected, abs=1e-4)


@pytest.mark.few(1)
@pytest.mark.parametrize("degrees", [20.0, 45.0, 60.0, 80.0])
def test_thin_places_at_acute_edges_are_told_from_thin_walls(degrees: float) -> None:
    """A rim where walls meet at a slant was named as the thinnest wall, without a word."""
    height = 10 * np.tan(np.radians(degrees))
    ends = [[0, y, 0] for y in (0, 8)] + [[10, y, z] for y in (0, 8) for z in (0, height)]
    wedge = trimesh.convex.convex_hull(np.array(ends, float)).subdivide_to_size(0.7)
    found = hk.check_print(wedge, min_thickness=0.8).problems[0]
    assert found.kind == "thin walls"
    assert "; all at edges with an acute angle, where any part is thin" in found.message
    plate = trimesh.creation.box((6.0, 6.0, 0.3)).subdivide_to_size(0.7)
    plate.apply_translation((30.0, 0.0, 0.0))
    alone = hk.check_print(plate, min_thickness=0.8).problems[0]
    assert "acute" not in alone.message
    both = hk.check_print(trimesh.util.concatenate([wedge, plate]), min_thickness=0.8).problems[0]
    assert both.count == found.count + alone.count
    assert f"; {found.count:,} at edges with an acute angle" in both.message
    assert "the thinnest elsewhere is 0.3, such as at (" in both.message
    assert (both.locations[: alone.count, 0] > 20).all()


def test_thickness_of_a_solid_is_that_of_its_mesh() -> None:
    shell = hk.Sphere(1.0) - hk.Sphere(0.8)
    found = hk.printing.wall_thickness(shell, tolerance=4e-3)
    assert found.values.min() > 0.2 - 0.02
    colored = found.to_colored_mesh(0.1, 0.3)
    assert len(colored.visual.face_colors) == len(found.values)
    with pytest.raises(TypeError, match="tolerance is for solids"):
        hk.printing.wall_thickness(PLATE, tolerance=1e-3)


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = str(tmp_path / "plate.stl")
    PLATE.export(name)
    assert main(["check", name]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    colors = str(tmp_path / "thin.ply")
    assert main(["check", name, "--min-thickness", "2.5", "--colors", colors]) == 1
    assert "wrong: thin walls" in capsys.readouterr().out
    assert len(trimesh.load(colors).faces) == len(PLATE.faces)
    printed = str(tmp_path / "thin.3mf")
    assert main(["check", name, "--min-thickness", "2.5", "--colors", printed]) == 1
    capsys.readouterr()
    with zipfile.ZipFile(printed) as archive:
        model = archive.read("3D/3dmodel.model").decode()
    # Gray and red.
    assert re.findall('<m:color color="(.*?)"/>', model) == ["#BEBEBEFF", "#C81E1EFF"]
    assert main(["check", name, "--min-thickness", "2.5", "--colors", name]) == 1
    assert "a .stl file has no colors" in capsys.readouterr().err
    assert main(["check", name, "--json", "--build-volume", "5", "5", "5"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [one["kind"] for one in found["problems"]] == ["bed"]
    assert main(["check", name, "--colors", colors]) == 1
    assert "--min-thickness" in capsys.readouterr().err


def test_hostile_files_are_refused(tmp_path: Path) -> None:
    for name, data in (
        ("a.stl", b""),
        ("b.stl", b"\0" * 83),
        ("c.ply", b"ply\n"),
        ("d.xyz", b"1 2 3"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises((FileFormatError, hk.geometry.MeshError)):
            hk.check_print(path)


def test_faces_without_area_that_close_a_file_are_kept(tmp_path: Path) -> None:
    # A vertex in the middle of an edge of one neighbor alone, and a face without width between.
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]], float)
    faces = np.array([[0, 2, 1], [0, 4, 3], [4, 1, 3], [1, 2, 3], [0, 3, 2], [0, 1, 4]])
    assert trimesh.Trimesh(x, faces, process=False).is_watertight
    path = tmp_path / "flat.stl"
    trimesh.Trimesh(x, faces, process=False).export(path)
    assert hk.solid(path).value([[0.2, 0.2, 0.2]])[0] < 0
    found = hk.check_print(path)
    assert found.is_printable
    assert found.volume == pytest.approx(1 / 6)
    assert [one.kind for one in found.problems] == ["faces without area", "unit"]


def test_parts_in_the_material_of_others_are_wrong() -> None:
    # Their volume counts twice; slicers print them, or a cavity in their place.
    ball = trimesh.creation.icosphere(1, radius=10.0)
    x, f, n = ball.vertices, ball.faces, len(ball.vertices)

    def nested(*sides: int) -> dict[str, int]:
        """Balls in balls, the largest first; -1: turned inwards."""
        vertices = [x * (1 - 0.25 * k) for k in range(len(sides))]
        faces = [f[:, ::side] + k * n for k, side in enumerate(sides)]
        return kinds((np.concatenate(vertices), np.concatenate(faces)))

    assert nested(1, 1) == {"nested parts": 1, "loose parts": 2}
    assert nested(1, -1, 1) == {"cavities": 1, "loose parts": 2}
    assert nested(1, -1, -1) == {"inside out": 1, "cavities": 1, "loose parts": 2}
    moved = trimesh.util.concatenate([ball, ball.copy().apply_translation((5.0, 1.0, 2.0))])
    assert "nested parts" not in kinds(moved)  # they cross, which is said


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 0.04, 1e5])
def test_thickness_knows_no_unit(scale: float) -> None:
    # Rays ended at once where a mesh was less than 1 long, and it was said to be thin all over.
    plate = (FINE_PLATE.vertices * scale, FINE_PLATE.faces)
    found = hk.printing.wall_thickness(plate)
    assert found.thinnest == pytest.approx(2.0 * scale, rel=1e-5)
    assert np.median(found.values) > 2.5 * scale


@pytest.mark.parametrize("height", [1e-5, 1e-6, 1e-9])
def test_foils_are_thin(height: float) -> None:
    # Rays that began beyond the other side ran into the open: 0.0067 and 32 were found.
    foil = trimesh.creation.box((20.0, 10.0, height))
    is_flat = np.abs(foil.face_normals[:, 2]) > 0.5
    assert hk.printing.wall_thickness(foil).values[is_flat].max() < 3.3e-5


@pytest.mark.parametrize("bed", [220, (220, 220), (220, 220, 0), "abc"])
def test_beds_that_are_none_are_refused(bed: Any) -> None:
    with pytest.raises(ValueError, match="build_volume must be"):
        hk.check_print(PLATE, build_volume=bed)


def test_what_overlaps_can_be_united_and_that_is_said() -> None:
    ball = trimesh.creation.icosphere(1)
    two = trimesh.util.concatenate([ball, ball.copy().apply_translation((0.7, 0.1, 0.05))])
    [found] = hk.check_print(two, min_thickness=0.1).problems[:1]
    assert found.kind == "crossing faces"
    assert "hk.mesh(hk.solid(part))" in found.message
    assert "walls not measured" in kinds(two, min_thickness=0.1)  # and not: thin
    united = hk.mesh(hk.solid(two))
    assert "crossing faces" not in kinds(united)
    other = ball.copy().apply_translation((0.7, 0.1, 0.05))
    expected = trimesh.boolean.union([ball, other], engine="manifold").volume
    assert united.volume == pytest.approx(expected, rel=1e-6)


def test_parts_that_touch_inside_a_face_are_not_said_to_be_apart() -> None:
    box = trimesh.creation.box((20.0, 20.0, 20.0))
    point = [(3, 1, 10), (5, 1, 15), (1, 5, 15), (-3, -3, 15)]
    faces = [(0, 2, 1), (0, 3, 2), (0, 1, 3), (1, 2, 3)]
    found = hk.check_print(trimesh.util.concatenate([box, trimesh.Trimesh(point, faces)]))
    [loose] = [one for one in found.problems if one.kind == "loose parts"]
    assert "joined by vertices" in loose.message
    assert "do not touch" not in loose.message


CUBE = trimesh.creation.box()
WEDGE_FACES = [
    (0, 3, 1),
    (0, 2, 3),
    (1, 4, 0),
    (1, 5, 4),
    (2, 5, 3),
    (2, 4, 5),
    (0, 4, 2),
    (1, 3, 5),
]
TIP = (
    [(3, 1, 10), (5, 1, 15), (1, 5, 15), (-3, -3, 15)],
    [(0, 2, 1), (0, 3, 2), (0, 1, 3), (1, 2, 3)],
)


def wedge(half: float) -> tuple[Any, Any]:
    """On its edge, which is 2 half long."""
    ends = [(0, 10), (3, 15), (-3, 15)]
    return [(x, y + 1.1, z) for y, z in ends for x in (-half, half)], WEDGE_FACES


@pytest.mark.parametrize(
    ("other", "count"),
    [
        (TIP, 1),
        (wedge(3.0), 2),  # its ends: a diagonal of the face passes under its edge as well
        ((CUBE.vertices * 4.0 + np.array([12, 3, 12]), CUBE.faces), 2),
    ],
)
def test_parts_that_touch_inside_a_face_are_wrong(other: Any, count: int) -> None:
    box = trimesh.creation.box((20.0, 20.0, 20.0))
    touching = trimesh.Trimesh(*other, process=False)
    checked = hk.check_print(trimesh.util.concatenate([box, touching]))
    assert {problem.kind: problem.count for problem in checked.problems} == {
        "touching faces": count,
        "loose parts": 2,
    }
    assert not checked.is_printable
    touching.apply_translation((0, 0, 1e-6))
    assert hk.check_print(trimesh.util.concatenate([box, touching])).is_printable


def test_large_faces_are_told_of_where_walls_are_measured() -> None:
    """A pit beside the center of a face was not seen, and nothing said so."""
    box = trimesh.creation.box((20.0, 10.0, 5.0))
    found = {one.kind: one for one in hk.check_print(box, min_thickness=1.0).problems}
    assert found["walls measured coarsely"].count == 12
    assert not found["walls measured coarsely"].is_error
    fine = box.subdivide_to_size(4.0)
    assert not hk.check_print(fine, min_thickness=1.0).problems
