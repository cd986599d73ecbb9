"""Meshes that are written, read back by other libraries than the ones that wrote them: coordinates,
units, normals and colors as numbers; and what a format lacks is refused."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.cli import main
from harnack.files.geometry_files import LoadedMesh, read_geometry
from harnack.geometry.boundary_edges import singular_edges, weld_vertices
from harnack.io import write_mesh
from harnack.mesh_to_file import _colors_of  # pyright: ignore[reportPrivateUsage]
from harnack.meshing import MeshingError

# A part that is not symmetric, so that axes cannot be confused.
_BOX = trimesh.creation.box((1.0, 2.0, 3.0))
_BALL = trimesh.creation.icosphere(subdivisions=3)
_SRGB = np.array([0, 10, 128, 255], np.uint8)
_LINEAR = np.array([0.0, 10 / 255 / 12.92, 0.2158605, 1.0])
_USD = (".usda", ".usdc", ".usdz")


def colored(mesh: trimesh.Trimesh, of: str, *, opacity: int = 255) -> tuple[Any, np.ndarray]:
    """The mesh with colors of vertices or of faces, and these (k, 4)."""
    count = len(mesh.vertices if of == "vertex" else mesh.faces)
    rng = np.random.default_rng(4)
    colors = np.concatenate([_SRGB[rng.integers(0, 4, (count, 3))],
                             np.full((count, 1), opacity, np.uint8)], axis=1)  # fmt: skip
    options: Any = {f"{of}_colors": colors}
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **options), colors


def linear(colors: np.ndarray) -> np.ndarray:
    """The linear values of colors of `_SRGB`."""
    return _LINEAR[np.searchsorted(_SRGB, colors)]


# What other libraries read.


def glb(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray, Any]:
    """The attributes of the only mesh of a .glb file, its faces and its document, by pygltflib."""
    pygltflib = pytest.importorskip("pygltflib")
    document = pygltflib.GLTF2().load(str(path))
    blob = document.binary_blob()

    def array(number: int) -> np.ndarray:
        accessor = document.accessors[number]
        view = document.bufferViews[accessor.bufferView]
        code = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor.componentType]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        values = np.frombuffer(blob, code, accessor.count * width, view.byteOffset)
        return values.reshape(-1, width) / (65535 if accessor.normalized else 1)

    (primitive,) = document.meshes[0].primitives
    names = {"POSITION", "NORMAL", "COLOR_0"}
    numbers = {name: getattr(primitive.attributes, name) for name in names}
    arrays = {name: array(k) for name, k in numbers.items() if k is not None}
    return arrays, array(primitive.indices).astype(int).reshape(-1, 3), document


def three_mf(path: Path) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """The vertices and faces of a .3mf file, its only mesh and its model, by lib3mf, which refuses
    what its standard does not allow."""
    lib3mf = pytest.importorskip("lib3mf")
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(path))
    assert reader.GetWarningCount() == 0
    meshes = model.GetMeshObjects()
    assert meshes.MoveNext()
    mesh = meshes.GetCurrentMeshObject()
    assert not meshes.MoveNext()
    vertices = np.array([list(vertex.Coordinates) for vertex in mesh.GetVertices()])
    faces = np.array([list(triangle.Indices) for triangle in mesh.GetTriangleIndices()])
    return vertices, faces, mesh, model


def usda(path: Path) -> dict[str, Any]:
    """The entries of a .usda file: its text, its arrays as rows of numbers, and what stands behind
    their names."""
    text = path.read_text()
    entries: dict[str, Any] = {"text": text}
    for name, values, rest in re.findall(r"(\S+) = \[(.*)\](.*(?:\n\s+interpolation.*)?)", text):
        numbers = [float(word) for word in re.findall(r"[-+.\de]+", values)]
        entries[name] = np.array(numbers).reshape(-1, 3 if values.startswith("(") else 1)
        entries[f"{name} is"] = "".join(re.findall(r'interpolation = "(\w+)"', rest))
    return entries


def words_of(path: Path) -> list[list[str]]:
    """The words of each line of a text file that is not blank."""
    return [line.split() for line in path.read_text().splitlines() if line.strip()]


def meshio_of(path: Path) -> Any:
    """What meshio reads."""
    return pytest.importorskip("meshio").read(path)


# Shapes and units.


@pytest.mark.parametrize("kind", [".stl", ".ply", ".obj"])
def test_meshio_reads_the_same_triangles(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a{kind}"
    write_mesh(_BALL, path)
    read = meshio_of(path)
    (faces,) = (cells.data for cells in read.cells if cells.type == "triangle")
    np.testing.assert_allclose(read.points[faces], _BALL.vertices[_BALL.faces], atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "number", "meters"),
    [("mm", 1, 0.001), ("cm", 2, 0.01), ("in", 3, 0.0254), ("m", 5, 1.0)],
)
def test_units_are_those_of_the_formats(
    tmp_path: Path, unit: Any, number: int, meters: float
) -> None:
    write_mesh(_BOX, tmp_path / "a.3mf", unit=unit)
    vertices, _, mesh, model = three_mf(tmp_path / "a.3mf")
    assert int(model.GetUnit()) == number  # lib3mf's own numbers
    assert mesh.IsManifoldAndOriented()
    np.testing.assert_array_equal(np.ptp(vertices, axis=0), (1, 2, 3))
    # Coordinates of glTF are meters, and y is up.
    write_mesh(_BOX, tmp_path / "a.glb", unit=unit)
    scene: Any = trimesh.load(tmp_path / "a.glb")
    np.testing.assert_allclose(scene.extents, meters * np.array([1, 3, 2]), rtol=1e-12)
    assert scene.to_geometry().volume > 0
    pytest.importorskip("pxr")
    write_mesh(_BOX, tmp_path / "a.usda", unit=unit)
    entries = usda(tmp_path / "a.usda")
    assert f"metersPerUnit = {meters}".removesuffix(".0") in entries["text"]
    assert 'upAxis = "Z"' in entries["text"]
    np.testing.assert_array_equal(np.ptp(entries["points"], axis=0), (1, 2, 3))


def test_without_a_unit_it_is_that_of_the_format(tmp_path: Path) -> None:
    write_mesh(_BOX, tmp_path / "a.3mf")
    assert int(three_mf(tmp_path / "a.3mf")[3].GetUnit()) == 1
    write_mesh(_BOX, tmp_path / "a.glb")
    np.testing.assert_array_equal(trimesh.load(tmp_path / "a.glb").extents, (1, 3, 2))
    pytest.importorskip("pxr")
    write_mesh(_BOX, tmp_path / "a.usda")
    assert "metersPerUnit = 0.01\n" in usda(tmp_path / "a.usda")["text"]


def test_what_is_up_stays_up(tmp_path: Path) -> None:
    tall = trimesh.creation.cone(0.5, 4.0)  # its tip at z = 4
    write_mesh(tall, tmp_path / "a.glb")
    scene: Any = trimesh.load(tmp_path / "a.glb")
    np.testing.assert_allclose(scene.bounds[:, 1], (0, 4), atol=1e-6)
    # Reading turns it back.
    x = hk.io.field_from_file(tmp_path / "a.glb").field.parameters()["vertices"]
    np.testing.assert_allclose([x.min(axis=0), x.max(axis=0)], tall.bounds, atol=1e-6)


@pytest.mark.parametrize("kind", _USD)
def test_usd_files_of_all_kinds_hold_the_same(tmp_path: Path, kind: str) -> None:
    usd = pytest.importorskip("pxr.Usd")
    path = tmp_path / f"odd [name] of:a part{kind.upper()}"
    mesh, colors = colored(_BOX, "face", opacity=128)
    write_mesh(mesh, path, unit="mm")
    # Reading takes what stands in brackets for a file in an archive; writing must not.
    stage = usd.Stage.Open(str(path.rename(tmp_path / f"plain{kind}")))
    prim = stage.GetDefaultPrim()
    assert prim.GetAttribute("subdivisionScheme").Get() == "none"
    np.testing.assert_array_equal(
        np.array(prim.GetAttribute("faceVertexIndices").Get()).reshape(-1, 3), _BOX.faces
    )
    np.testing.assert_allclose(
        prim.GetAttribute("primvars:displayColor").Get(), linear(colors[:, :3]), atol=1e-6
    )
    np.testing.assert_allclose(
        prim.GetAttribute("primvars:displayOpacity").Get(), 128 / 255, rtol=1e-6
    )


# Normals.


def normals_in(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and indices of the corners of all triangles in a file."""
    kind = path.suffix
    if kind == ".glb":
        arrays, faces, _ = glb(path)
        return arrays["POSITION"][faces], arrays["NORMAL"][faces], faces
    if kind == ".usda":
        entries = usda(path)
        faces = entries["faceVertexIndices"].astype(int).reshape(-1, 3)
        per_vertex = entries["normals is"] == "vertex"
        normals = entries["normals"][faces] if per_vertex else entries["normals"].reshape(-1, 3, 3)
        return entries["points"][faces], normals, faces
    if kind == ".obj":
        rows = words_of(path)
        positions = np.array([row[1:] for row in rows if row[0] == "v"], float)
        normals = np.array([row[1:] for row in rows if row[0] == "vn"], float)
        corners = np.array([[c.split("//") for c in row[1:]] for row in rows if row[0] == "f"], int)
        return positions[corners[..., 0] - 1], normals[corners[..., 1] - 1], corners[..., 0] - 1
    read = meshio_of(path)
    faces = read.cells[0].data
    normals = np.stack([read.point_data[name] for name in ("nx", "ny", "nz")], axis=1)
    return read.points[faces], normals[faces], faces


@pytest.mark.parametrize("kind", [".glb", ".usda", ".ply", ".obj"])
def test_normals_are_smooth_but_at_creases(tmp_path: Path, kind: str) -> None:
    if kind == ".usda":
        pytest.importorskip("pxr")
    path = tmp_path / f"a{kind}"
    write_mesh(_BOX, path, normals=True)
    positions, normals, faces = normals_in(path)
    # Each corner of a face of the box has the normal of that face.
    expected = np.repeat(np.asarray(_BOX.face_normals)[:, None], 3, axis=1)
    np.testing.assert_allclose(normals, expected, atol=1e-6)
    assert len(np.unique(faces)) == (8 if kind == ".usda" else 24)
    np.testing.assert_allclose(positions, _BOX.vertices[_BOX.faces], atol=1e-6)
    # Vertices are split, and the surface is still closed.
    if kind != ".usda":
        mesh = read_geometry(path)
        assert isinstance(mesh, LoadedMesh)
        edges, _ = singular_edges(weld_vertices(mesh.vertices)[mesh.faces])
        assert not len(edges)
    write_mesh(_BALL, path, normals=True)
    positions, normals, faces = normals_in(path)
    assert len(np.unique(faces)) == len(_BALL.vertices)
    np.testing.assert_allclose(normals, positions, atol=6e-3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1.0, atol=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_normals_that_are_given_are_written_where_there_is_no_crease(
    tmp_path: Path, sign: float
) -> None:
    # A half ball, with a flat cap: the gradient is right on the ball alone.
    part = hk.mesh(hk.Sphere(1.0), clip=hk.HalfSpace((0, 0, -1), 0.0), tolerance=2e-2)
    given = sign * 1e-200 * np.asarray(part.vertices)
    given[5] = np.nan
    write_mesh(part, tmp_path / "a.glb", normals=given)
    positions, normals, _ = normals_in(tmp_path / "a.glb")
    face_normals = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
    is_cap = np.isclose(positions[..., 2], 0).all(axis=1)
    assert is_cap.any()
    np.testing.assert_allclose(normals[is_cap], [[[0, 0, -1.0]] * 3] * int(is_cap.sum()), atol=1e-6)
    # At the rim of the cap, means of faces.
    is_inner = positions[..., 2] > 1e-6
    errors = np.linalg.norm(normals - positions, axis=2)[is_inner]
    assert np.mean(errors > 1e-5) < 0.01  # but at the vertex without a number
    assert ((normals[:, 0] * face_normals).sum(axis=1) > 0).all()


def test_the_gradient_of_a_field_is_nearer_to_its_normals_than_faces_are(tmp_path: Path) -> None:
    torus = hk.Torus(0.8, 0.3)
    mesh = hk.mesh(torus, tolerance=2e-2)
    errors: list[float] = []
    for normals in (True, torus.gradient(mesh.vertices, precision="double")):
        write_mesh(mesh, tmp_path / "a.glb", normals=normals)
        arrays, _, _ = glb(tmp_path / "a.glb")
        exact = torus.gradient(arrays["POSITION"].astype(float), precision="double")
        errors.append(float(np.linalg.norm(arrays["NORMAL"] - exact, axis=1).max()))
    assert errors[1] < 1e-5 < 1e-3 < errors[0]


# Colors.


def test_colors_of_vertices_are_in_every_format_that_has_them(tmp_path: Path) -> None:
    mesh, colors = colored(_BALL, "vertex", opacity=128)
    write_mesh(mesh, tmp_path / "a.ply")
    read = meshio_of(tmp_path / "a.ply")
    for name, column in zip(("red", "green", "blue", "alpha"), colors.T, strict=True):
        # (meshio takes unsigned bytes for signed ones.)
        np.testing.assert_array_equal(read.point_data[name].astype(np.uint8), column)
    with pytest.warns(UserWarning, match="no opacity"):
        write_mesh(mesh, tmp_path / "a.obj")
    rows = words_of(tmp_path / "a.obj")
    values = np.array([row[4:] for row in rows if row[0] == "v"], float)
    np.testing.assert_allclose(values, colors[:, :3] / 255, atol=1e-6)
    write_mesh(mesh, tmp_path / "a.glb", normals=False)
    arrays, faces, document = glb(tmp_path / "a.glb")
    np.testing.assert_array_equal(faces, _BALL.faces)
    np.testing.assert_allclose(arrays["COLOR_0"][:, :3], linear(colors[:, :3]), atol=1 / 65535)
    np.testing.assert_allclose(arrays["COLOR_0"][:, 3], 128 / 255, atol=1 / 65535)
    assert document.materials[0].alphaMode == "BLEND"
    write_mesh(mesh, tmp_path / "a.3mf")
    _, faces, part, model = three_mf(tmp_path / "a.3mf")
    np.testing.assert_array_equal(corner_colors(part, model, len(faces)), colors[faces])
    pytest.importorskip("pxr")
    write_mesh(mesh, tmp_path / "a.usda")
    entries = usda(tmp_path / "a.usda")
    found = entries["primvars:displayColor"]
    np.testing.assert_allclose(found, linear(colors[:, :3]), atol=1e-6)
    assert entries["primvars:displayColor is"] == "vertex"


def corner_colors(part: Any, model: Any, count: int) -> np.ndarray:
    """The colors (count, 3, 4) of the corners of the triangles of a .3mf file."""
    rows: list[list[tuple[int, ...]]] = []
    for k in range(count):
        properties = part.GetTriangleProperties(k)
        group = model.GetColorGroupByID(properties.ResourceID)
        found = [group.GetColor(number) for number in properties.PropertyIDs]
        rows.append([(c.Red, c.Green, c.Blue, c.Alpha) for c in found])
    return np.array(rows)


def test_colors_of_faces_are_in_every_format_that_has_colors(tmp_path: Path) -> None:
    mesh, colors = colored(_BALL, "face")
    write_mesh(mesh, tmp_path / "a.ply")
    text = (tmp_path / "a.ply").read_bytes()
    row = np.dtype([("count", "u1"), ("corners", "<i4", 3), ("color", "u1", 4)])
    rows = np.frombuffer(text[-len(colors) * row.itemsize :], row)
    np.testing.assert_array_equal(rows["corners"], _BALL.faces)
    np.testing.assert_array_equal(rows["color"], colors)
    for normals in (False, True):
        write_mesh(mesh, tmp_path / "a.glb", normals=normals)
        arrays, faces, _ = glb(tmp_path / "a.glb")
        expected = np.repeat(linear(colors[:, None, :3]), 3, axis=1)
        np.testing.assert_allclose(arrays["COLOR_0"][faces][..., :3], expected, atol=1 / 65535)
        np.testing.assert_allclose(
            arrays["POSITION"][faces], _BALL.vertices[_BALL.faces], atol=1e-6
        )
    write_mesh(mesh, tmp_path / "a.3mf")
    _, faces, part, model = three_mf(tmp_path / "a.3mf")
    found = corner_colors(part, model, len(faces))
    np.testing.assert_array_equal(found, np.repeat(colors[:, None], 3, axis=1))
    write_mesh(mesh, tmp_path / "a.obj")
    loops = words_of(tmp_path / "a.obj")
    values = np.array([row[4:] for row in loops if row[0] == "v"], float)
    corners = np.array([row[1:] for row in loops if row[0] == "f"], int) - 1
    np.testing.assert_allclose(
        values[corners], np.repeat(colors[:, None, :3], 3, axis=1) / 255, atol=1e-6
    )


def test_the_color_of_a_texture_is_written_at_vertices(tmp_path: Path) -> None:
    from PIL import Image

    image = Image.fromarray(np.full((2, 2, 3), (255, 128, 0), np.uint8))
    material = trimesh.visual.material.SimpleMaterial(image=image)  # pyright: ignore
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    mesh = trimesh.Trimesh(_BOX.vertices, _BOX.faces, visual=visual, process=False)
    with pytest.warns(UserWarning, match="texture is written as colors of vertices"):
        write_mesh(mesh, tmp_path / "a.ply")
    read = meshio_of(tmp_path / "a.ply")
    assert set(read.point_data["red"].astype(np.uint8)) == {255}
    assert set(read.point_data["green"].astype(np.uint8)) == {128}


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.glb", "a.3mf"])
def test_the_color_of_a_material_is_that_of_all_vertices(tmp_path: Path, name: str) -> None:
    kind = trimesh.visual.material.PBRMaterial  # pyright: ignore
    material = kind(baseColorFactor=[255, 128, 0, 255])
    visual = trimesh.visual.TextureVisuals(material=material)
    mesh = trimesh.Trimesh(_BOX.vertices, _BOX.faces, visual=visual, process=False)
    colors, _ = _colors_of(mesh)
    assert colors is not None
    assert colors.tolist() == [[255, 128, 0, 255]] * 8
    write_mesh(mesh, tmp_path / name)
    assert (tmp_path / name).stat().st_size > 100


def test_open_meshes_too_far_away_for_single_precision_are_refused(tmp_path: Path) -> None:
    far = trimesh.Trimesh(
        _BOX.vertices + np.array((4.2e6, 5.1e6, 0.0)), _BOX.faces[:-1], process=False
    )
    with pytest.raises(MeshingError, match=r"move it to the origin"):
        write_mesh(far, tmp_path / "a.ply")
    huge = trimesh.Trimesh(_BOX.vertices * 1e39, _BOX.faces[:-1], process=False)
    with pytest.raises(MeshingError, match=r"up to 6.9e\+10"):
        write_mesh(huge, tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


# What is refused, and what is left as it was.


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.stl", {"unit": "mm"}, r"a .stl file has no unit; leave .* it .glb, .3mf, .usda"),
        ("a.ply", {"unit": "mm"}, "has no unit"),
        ("a.3mf", {"unit": "inch"}, "unit must be mm, cm, m, in or None, not 'inch'"),
        ("a.stl", {"normals": True}, "has no normals at vertices; leave out the normals"),
        ("a.3mf", {"normals": np.ones((8, 3))}, "has no normals at vertices"),
        ("a.glb", {"normals": np.ones((7, 3))}, r"array .8, 3., .* not one of shape .7, 3."),
        ("a.glb", {"normals": "field"}, "normals must be True, False, None or an array"),
        ("a.step", {}, "has no extension of a mesh: name it .stl"),
    ],
)
def test_what_a_format_lacks_is_refused(
    tmp_path: Path, name: str, options: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        write_mesh(_BOX, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("of", ["vertex", "face"])
def test_colors_are_not_lost_in_stl_files_without_a_word(tmp_path: Path, of: str) -> None:
    with pytest.raises(ValueError, match=r"a .stl file has no colors; .* name it .ply, .obj, .glb"):
        write_mesh(colored(_BOX, of)[0], tmp_path / "a.stl")
    assert not list(tmp_path.iterdir())


def test_what_is_no_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"a trimesh.Trimesh is written, not Scene; to_mesh"):
        write_mesh(trimesh.Scene([_BOX]), tmp_path / "a.glb")  # pyright: ignore
    with pytest.raises(ValueError, match="no faces"):
        write_mesh(trimesh.Trimesh(), tmp_path / "a.glb")
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(ValueError, match="not finite"):
        write_mesh(flat, tmp_path / "a.obj")
    assert not list(tmp_path.iterdir())


def test_the_package_for_usd_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*sys.modules]:
        if name.split(".")[0] == "pxr":
            monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'harnack\[usd\]'"):
        write_mesh(_BOX, tmp_path / "a.usdz")


def test_open_meshes_are_seen_from_both_sides(tmp_path: Path) -> None:
    half = trimesh.Trimesh(_BALL.vertices, _BALL.faces[: len(_BALL.faces) // 2], process=False)
    half.remove_unreferenced_vertices()
    for mesh, is_open in ((half, True), (_BALL, False)):
        write_mesh(mesh, tmp_path / "a.glb")
        assert glb(tmp_path / "a.glb")[2].materials[0].doubleSided is is_open
    tiny = half.copy()
    tiny.apply_scale(1e-7)
    write_mesh(tiny, tmp_path / "a.obj")
    np.testing.assert_allclose(np.ptp(meshio_of(tmp_path / "a.obj").points, axis=0), tiny.extents,
                               rtol=1e-6)  # fmt: skip


def test_the_same_mesh_makes_the_same_file(tmp_path: Path) -> None:
    for kind in (".3mf", ".glb"):
        paths = [tmp_path / f"{name}{kind}" for name in "ab"]
        for path in paths:
            write_mesh(colored(_BALL, "vertex")[0], path)
        assert paths[0].read_bytes() == paths[1].read_bytes()


# The command.


def test_the_command_writes_units_and_normals_of_the_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["mesh", "x^2 + y^2 + z^2 = 1", "--clip", "ball:0,0,0,2", "--tolerance", "0.02",
               "--scale", "25", "--quiet"]  # fmt: skip
    path = tmp_path / "a.glb"
    assert main([*command, "--unit", "mm", "-o", str(path)]) == 0
    scene: Any = trimesh.load(path)
    np.testing.assert_allclose(scene.extents, 0.05, rtol=1e-3)
    positions, normals, _ = normals_in(path)
    np.testing.assert_allclose(normals, positions / 25, atol=2e-3)
    # Their directions are those of the gradient, not of the faces.
    lengths = np.linalg.norm(positions, axis=2, keepdims=True)
    np.testing.assert_allclose(normals, positions / lengths, atol=1e-5)
    capsys.readouterr()
    for more, message in (
        (["--unit", "mm", "-o", str(tmp_path / "a.stl")], "a .stl file has no unit"),
        (["--vertex-normals", "-o", str(tmp_path / "a.3mf")], "a .3mf file has no normals"),
    ):
        assert main([*command, *more]) == 1
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*command, "--unit", "km", "-o", str(path)])
    assert "km" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["a.glb"]
