"""`harnack render FILE`: every format, what it is taken for, overrides and errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from harnack.cli import main
from harnack.field_from_file import field_from_file
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.gallery import SCENES
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere

Run = Callable[..., tuple[int, str, str]]

TALL = np.array([1.0, 1.0, 1.6])


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Renders a file to picture.png; the exit code, what was said and what was complained of."""

    def render(path: Path, *arguments: str) -> tuple[int, str, str]:
        target = str(tmp_path / "picture.png")
        small = ["--show", "normal", "--size", "32x24", "--quiet"]
        code = main(["render", str(path), "-o", target, *small, *arguments])
        said, complaint = capsys.readouterr()
        return code, said, complaint.replace("\n", " ")

    return render


def tall_ball(missing: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid along z, some faces of which may be missing at the end of the list."""
    x, faces = icosphere(1)
    return x * TALL, faces[: len(faces) - missing]


def write_mesh(path: Path, missing: int = 0) -> Path:
    mesh = trimesh.Trimesh(*tall_ball(missing), process=False)
    if path.suffix == ".gltf":
        for name, data in mesh.export(file_type="gltf").items():
            (path.parent / (path.name if name.endswith(".gltf") else name)).write_bytes(data)
    else:
        mesh.export(path)
    return path


def write_cloud(path: Path, *, with_normals: bool = True) -> Path:
    x = tall_ball()[0]
    normals = x / TALL**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    names = "xyz" if not with_normals else ("x", "y", "z", "nx", "ny", "nz")
    header = f"ply\nformat ascii 1.0\nelement vertex {len(x)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header"
    np.savetxt(
        path, np.hstack([x, normals]) if with_normals else x,
        header=header if path.suffix == ".ply" else "", comments="",
    )  # fmt: skip
    return path


def picture(tmp_path: Path) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.Bitmap(str(tmp_path / "picture.png")))


def extent_of(path: Path, **settings: Any) -> np.ndarray:
    """Sides of the box around what a mesh file becomes."""
    field = field_from_file(path, **settings).field
    assert isinstance(field, WindingNumber)
    return np.ptp(field.mesh.vertices, axis=0)


@pytest.mark.few(3)
@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "glb", "gltf"])
def test_a_closed_mesh_of_any_format_is_drawn_by_its_winding_number(run, tmp_path, kind):
    code, said, _ = run(write_mesh(tmp_path / f"a.{kind}"))
    assert code == 0
    assert "80 triangles without singular edges: a closed mesh" in said
    assert "WindingNumber: triangles: 80, singular edges: 0" in said
    assert f"; {'y' if kind in ('obj', 'glb', 'gltf') else 'z'} is up" in said
    image = picture(tmp_path)
    assert image.shape[:2] == (24, 32)
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 10


@pytest.mark.slow
def test_a_mesh_with_holes_is_drawn_by_its_winding_number(run, tmp_path):
    code, said, _ = run(write_mesh(tmp_path / "a.obj", missing=20), "--level", "0.4")
    assert code == 0
    assert "a mesh with holes or faces turned round" in said
    assert "WindingNumber: triangles: 60" in said


@pytest.mark.parametrize("kind", ["xyz", "ply"])
def test_a_cloud_is_drawn_by_its_dipoles(run, tmp_path, kind):
    code, said, _ = run(write_cloud(tmp_path / f"a.{kind}"))
    assert code == 0
    assert "42 points with normals, no faces: a point cloud" in said
    assert "DipolePotential: points: 42, normals: given, areas: estimated" in said
    assert len(np.unique(picture(tmp_path))) > 10


@pytest.mark.slow
def test_curves_are_drawn_by_their_solid_angle(run, tmp_path):
    path = tmp_path / "a.loops"
    path.write_text(" ".join(f"{c:.6f}" for c in example_curves.wavy_polygon(12).ravel()) + "\n")
    code, said, _ = run(path, "--level", "1.5pi", "--material", "copper")
    assert code == 0
    assert "1 loop of 12 vertices: curves" in said
    assert "SolidAngle: loops: 1, vertices: 12" in said


@pytest.mark.slow
def test_meshes_and_clouds_are_shaded_and_curves_drawn_in_color(tmp_path, capsys):
    mesh = write_mesh(tmp_path / "a.stl", missing=20)
    cloud = write_cloud(tmp_path / "a.xyz")
    curve = tmp_path / "a.loops"
    curve.write_text(" ".join(f"{c:.6f}" for c in example_curves.wavy_polygon(12).ravel()) + "\n")
    target = str(tmp_path / "picture.png")
    pictures = []
    for path, shaded in ((mesh, True), (cloud, True), (curve, False)):
        small = ["-o", target, "--size", "32x24", "--spp", "1", "--quiet"]
        assert main(["render", str(path), *small]) == 0
        assert ("drawn shaded; --show path" in capsys.readouterr().out) == shaded
        pictures.append(picture(tmp_path))
        assert main(["render", str(path), *small, "--show", "shaded" if shaded else "path"]) == 0
        assert "drawn shaded" not in capsys.readouterr().out
        np.testing.assert_array_equal(picture(tmp_path), pictures[-1])
    outside = pictures[1][12, 16].astype(int)
    assert outside[0] >= outside[1] >= outside[2] > 90  # eggshell


@pytest.mark.slow
def test_the_camera_goes_where_it_is_sent(run, tmp_path):
    mesh = write_mesh(tmp_path / "a.stl", missing=20)
    assert run(mesh)[0] == 0
    usual = picture(tmp_path)
    assert run(mesh, "--azimuth", "-50", "--elevation", "28")[0] == 0
    np.testing.assert_array_equal(picture(tmp_path), usual)
    assert run(mesh, "--azimuth", "60")[0] == 0
    assert (picture(tmp_path) != usual).mean() > 0.1
    code, _, said = run(mesh, "--elevation", "91")
    assert code == 1
    assert "elevation must lie within" in said


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("options", "field", "said"),
    [
        (["--read-as", "winding"], "WindingNumber: triangles: 60", "a mesh with holes"),
        (["--read-as", "dipole"], "DipolePotential: points: 60, normals: given, areas: given",
         "60 triangles, each taken as a point"),
        (["--read-as", "dipole", "--normals", "estimate"],
         "normals: estimated, areas: given", "60"),
        (["--read-as", "loops"], "SolidAngle: loops: ", "the boundary of the faces, as asked"),
        (["--take-boundary"], "SolidAngle: loops: ", "the boundary of the faces, as asked"),
        (["--take-boundary", "--read-as", "loops"],
         "SolidAngle: loops: ", "the boundary of the faces"),
    ],
)  # fmt: skip
def test_the_same_file_is_taken_as_asked(run, tmp_path, options, field, said):
    code, printed, _ = run(write_mesh(tmp_path / "a.obj", missing=20), *options)
    assert code == 0
    assert field in printed
    assert said in printed


@pytest.mark.parametrize("kind", ["obj", "stl"])
def test_a_boundary_is_the_same_by_either_name(tmp_path, kind):
    path = write_mesh(tmp_path / f"a.{kind}", missing=20)
    fields = [
        field_from_file(path, take_boundary=True).field,
        field_from_file(path, read_as="loops").field,
    ]
    edges = []
    for field in fields:
        assert isinstance(field, SolidAngle)
        ends = [np.hstack([loop, np.roll(loop, -1, axis=0)]) for loop in field.loops]
        edges.append(sorted(np.concatenate(ends).round(6).tolist()))
    assert edges[0] == edges[1]


def test_normals_of_a_cloud_are_estimated_if_asked(run, tmp_path):
    path = write_cloud(tmp_path / "a.xyz", with_normals=False)
    code, said, _ = run(path, "--normals", "estimate")
    assert code == 0
    assert "normals: estimated, areas: estimated" in said
    field = field_from_file(path, normals="estimate").field
    assert isinstance(field, DipolePotential)
    assert ((field.normals * field.points).sum(axis=1) > 0.0).all()  # outward


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_the_axis_named_up_turns_to_z(tmp_path, up):
    tall = write_mesh(tmp_path / "a.stl")
    sides = np.ptp(tall_ball()[0], axis=0)
    assert extent_of(tall, up=up)[2] == pytest.approx(sides["xyz".index(up)], rel=1e-6)
    field = field_from_file(tall, up=up).field
    assert isinstance(field, WindingNumber)
    assert field.value([[0.0, 0.0, 0.0]])[0] == pytest.approx(1.0, abs=1e-4)  # not mirrored


def test_up_turns_points_and_normals_of_a_cloud_together(tmp_path):
    path = write_cloud(tmp_path / "a.xyz")
    plain, turned = (field_from_file(path, up=up).field for up in ("z", "y"))
    assert isinstance(plain, DipolePotential)
    assert isinstance(turned, DipolePotential)
    np.testing.assert_allclose(turned.points[:, 2], plain.points[:, 1])
    np.testing.assert_allclose(turned.normals[:, 2], plain.normals[:, 1])
    np.testing.assert_allclose(turned.areas, plain.areas, rtol=1e-9)


def test_gltf_and_obj_are_y_up_and_other_formats_z_up(tmp_path):
    sides = np.ptp(tall_ball()[0], axis=0)
    for kind, expected in (("glb", sides[1]), ("obj", sides[1]), ("off", sides[2])):
        path = write_mesh(tmp_path / f"a.{kind}")
        assert extent_of(path)[2] == pytest.approx(expected, rel=1e-6)
    assert extent_of(tmp_path / "a.glb", up="z")[2] == pytest.approx(sides[2], rel=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "options", "complaint"),
    [
        ("a.xyz", "0 0 0\n1 0 0\n0 1 0\n0 0 1\n", [],
         r"a.xyz: 4 points without faces, and no normals read: .* --normals estimate"),
        ("a.xyz", "0 0 0\n1 0 0\n", ["--normals", "estimate"], "a.xyz: .*at least 4"),
        ("a.xyz", "0 0 0\n1 0 0\n", ["--read-as", "winding"], "it holds points only"),
        ("a.step", "ISO-10303-21;", [], r"a.step' is no scene: .*\.glb, .*\.xyz"),
        ("a.stl", "", [], "a.stl: the file is empty"),
        ("a.obj", "", [], "a.obj: the file is empty"),
        ("a.glb", None, [], "a.glb: there is no such file"),
        ("a.gltf", json.dumps({"asset": {"version": "2.0"}}), [], "a.gltf: "),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ["--normals", "estimate"],
         "normals are estimated for point clouds.* --read-as dipole"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
         ["--take-boundary", "--read-as", "dipole"],
         "--take-boundary takes faces as curves, which contradicts --read-as dipole"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ["--level", "0"], "level 0 "),
        ("a.xml", "<scene/>", ["--up", "y"], "up: a Mitsuba scene sets this in its own file"),
        ("trefoil", None, ["--read-as", "loops"], "--read-as is for surface files"),
    ],
)  # fmt: skip
def test_errors_say_what_to_do_and_nothing_is_written(
    run, tmp_path, name, content, options, complaint
):
    path = tmp_path / name if "." in name else Path(name)
    if content is not None:
        path.write_text(content)
    code, _, said = run(path, *options)
    assert code == 1
    assert not (tmp_path / "picture.png").exists()
    assert re.search(complaint, said), said


def test_a_closed_mesh_has_no_boundary_to_draw(run, tmp_path):
    for kind in ("obj", "glb"):
        code, _, said = run(write_mesh(tmp_path / f"a.{kind}"), "--take-boundary")
        assert code == 1
        assert "closed surface, which has no boundary" in said


def test_where_a_picture_goes_is_checked_before_the_file_is_read(tmp_path, capsys) -> None:
    missing = tmp_path / "mesh.obj"
    for name, message in (("q.jpg", ".png or .exr"), ("nowhere/q.png", "create the folder")):
        assert main(["render", str(missing), "-o", str(tmp_path / name)]) == 1
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["render", str(missing), "--azimuth", "inf"])
    assert "must be a finite number" in capsys.readouterr().err


def test_the_gallery_lists_a_scene_a_line_however_narrow_the_window(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    assert main(["gallery", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(SCENES)
    assert "hyperspherical-sextic  a hyperspherical harmonic of degree 6 (j = 4, m = 3)" in lines


@pytest.mark.slow
def test_meshes_of_files_take_the_options_that_their_messages_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`harnack mesh cloud.xyz` recommended --normals, which it had not."""
    points, target = icosphere(2)[0], str(tmp_path / "a.stl")
    np.savetxt(tmp_path / "cloud.xyz", points * [1.0, 1.0, 2.0])
    asked = ["mesh", str(tmp_path / "cloud.xyz"), "-o", target, "--tolerance", "0.02"]
    assert main(asked) == 1
    assert "--normals estimate" in capsys.readouterr().err
    assert main([*asked, "--normals", "estimate", "--up", "y", "--largest"]) == 0
    made = trimesh.load(target)
    assert made.extents[1] > 1.5 * made.extents[2]  # what was z is y
    assert main(["mesh", "gyroid", "-o", target, "--normals", "estimate"]) == 1
    assert "--normals is for surface files" in capsys.readouterr().err
