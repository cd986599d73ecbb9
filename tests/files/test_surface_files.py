"""Surface files: every format, what is decided of their contents, and hostile ones."""

from __future__ import annotations

import contextlib
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harnack.field_from_file import field_from_file
from harnack.fields.solid_angles.polygon_mesh import PolygonMesh
from harnack.files import gltf
from harnack.files import ply as ply_files
from harnack.files.file_geometry import FileFormatError
from harnack.files.geometry_files import LoadedCloud, LoadedCurves, LoadedMesh, read_geometry
from harnack.geometry.boundary_edges import singular_edges, weld_vertices
from harnack.geometry.example_meshes import icosphere, remove_faces, torus_mesh
from harnack.geometry.polygons import triangulate

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
FORMATS = ("obj", "stl", "stl_ascii", "off", "ply", "ply_ascii", "glb")


def exported(vertices, faces, kind: str) -> bytes:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    options = {"encoding": "ascii"} if kind == "ply_ascii" else {}
    data = mesh.export(file_type="ply" if kind == "ply_ascii" else kind, **options)
    return data if isinstance(data, bytes) else data.encode()


def area(vertices, faces) -> np.ndarray:
    """Area vectors of triangles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


# --- meshes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", FORMATS)
def test_a_mesh_is_the_same_in_every_format(save, kind):
    x, faces = icosphere(2)
    mesh = read_geometry(save(f"a.{kind.split('_')[0]}", exported(x, faces, kind)))
    assert isinstance(mesh, LoadedMesh)
    assert mesh.summary == "320 triangles without singular edges: a closed mesh"
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    np.testing.assert_allclose(mesh.vertices[mesh.faces], x[faces], atol=1e-7)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: remove_faces(f, 0.05, 0), r"304 triangles, \d+ singular edges: a mesh with hol"),
        (lambda f: remove_faces(f, 0.9, 0), r"32 triangles, \d+ singular edges: a triangle soup"),
        (lambda f: np.concatenate([f, [[0, 1, 1], [2, 2, 2]]]),
         "320 triangles .*a closed mesh; 2 of zero area left out"),
        (lambda f: np.concatenate([f, f[:3]]), "323 triangles, .*; 3 are added to or canceled"),
        (lambda f: f[:, ::-1], "a closed mesh, whose faces look inward"),
    ],
)  # fmt: skip
def test_what_is_said_of_a_mesh(save, damage, said):
    x, faces = icosphere(2)
    path = save("a.off", exported(x, damage(faces), "off"))
    assert re.search(said, read_geometry(path).summary)


def scene_of_two(tmp_path: Path, kind: str) -> Path:
    """A sphere at (5, 0, 0), twice as large, and its mirror image at (-5, 0, 0)."""
    sphere = trimesh.Trimesh(*icosphere(1), process=False)
    scene = trimesh.Scene()
    for sign in (1.0, -1.0):
        placed = np.diag([2.0 * sign, 2.0, 2.0, 1.0])
        placed[0, 3] = 5.0 * sign
        scene.add_geometry(sphere, geom_name="sphere", transform=placed)
    if kind == "glb":
        (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
        return tmp_path / "a.glb"
    for name, data in scene.export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    return tmp_path / "model.gltf"


@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_the_nodes_of_a_scene_are_put_in_their_places(tmp_path, kind):
    mesh = read_geometry(scene_of_two(tmp_path, kind))
    assert len(mesh.faces) == 160
    assert mesh.summary == "160 triangles without singular edges: a closed mesh"
    x = mesh.vertices
    np.testing.assert_allclose(np.linalg.norm(np.abs(x) - [5.0, 0, 0], axis=1), 2.0, atol=1e-6)
    for side in (-1.0, 1.0):
        here = side * x[mesh.faces][:, 0, 0] > 0.0
        center = np.array([5.0 * side, 0, 0])
        assert (np.linalg.det(x[mesh.faces[here]] - center) > 0.0).all()  # outward, both


def test_a_missing_buffer_of_a_scene_is_named(tmp_path):
    path = scene_of_two(tmp_path, "gltf")
    (tmp_path / "gltf_buffer_1.bin").unlink()
    with pytest.raises(FileFormatError, match=r"gltf_buffer_1.bin: there is no such file"):
        read_geometry(path)


L_SHAPE = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]]


@pytest.mark.parametrize("shift", range(6))
def test_polygons_with_dents_are_cut_without_overlaps(save, shift):
    corners = np.roll(L_SHAPE, shift, axis=0)
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3 4 5 6\n"
    mesh = read_geometry(save("l.obj", text), "winding")
    assert np.linalg.norm(area(mesh.vertices, mesh.faces), axis=1).sum() == pytest.approx(3.0)
    assert area(mesh.vertices, mesh.faces).sum(axis=0).tolist() == [0, 0, 3]


@given(seed=st.integers(0, 2**32 - 1), k=st.integers(4, 24))
def test_star_shaped_polygons_in_space_are_cut_without_overlaps(seed, k):
    rng = np.random.default_rng(seed)
    t = 2.0 * np.pi * (np.arange(k) + rng.uniform(0, 0.5, size=(9, k))) / k
    r = rng.uniform(0.1, 1.0, size=(9, k))
    plane = np.stack([r * np.cos(t), r * np.sin(t), 0.0 * r], axis=2)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    x = (plane @ rotation.T + rng.normal(size=3)).reshape(-1, 3)
    cut = triangulate(x, np.arange(9 * k), np.full(9, k))
    assert cut.shape == (9 * (k - 2), 3)
    vectors = area(x, cut).reshape(9, k - 2, 3)
    whole = np.linalg.norm(vectors.sum(axis=1), axis=1)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=2).sum(axis=1), whole, rtol=1e-9)
    plain = 0.5 * np.abs(np.cross(plane, np.roll(plane, -1, axis=1))[..., 2].sum(axis=1))
    np.testing.assert_allclose(whole, plain, rtol=1e-9)


def test_a_corner_in_the_middle_of_an_edge_leaves_no_gap(save):
    # Two quads beside a pentagon whose first corners lie on a line: no triangle of zero area.
    text = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nv 0 -1 0\nv 1 -1 0\nv 2 -1 0\n"
    text += "f 1 2 3 4 5\nf 6 7 2 1\nf 7 8 3 2\n"
    mesh = read_geometry(save("t.obj", text))
    assert "left out" not in mesh.summary
    edges, _ = singular_edges(weld_vertices(mesh.vertices)[mesh.faces])
    assert len(edges) == 7


@given(seed=st.integers(0, 2**32 - 1), k=st.integers(3, 12), n=st.integers(3, 12))
def test_triangles_of_polygons_that_cross_themselves_add_up_to_them(seed, k, n):
    rng = np.random.default_rng(seed)
    x = rng.integers(0, 4, size=(n, 3)) * [1.0, 1.0, 0.0]
    polygon = rng.integers(0, n, size=k)
    triangles = triangulate(x, polygon, np.array([k]))
    directed = [(int(a), int(b)) for a, b in zip(polygon, np.roll(polygon, -1), strict=True)]
    for a, b, c in triangles.tolist():
        directed += [(b, a), (c, b), (a, c)]
    for a, b in directed:
        assert directed.count((a, b)) == directed.count((b, a)) or a == b


def test_a_polygon_of_many_corners_with_dents_is_cut():
    t = 2.0 * np.pi * np.arange(1500) / 1500
    r = 1.0 + 0.5 * np.sin(37.0 * t)
    x = np.stack([r * np.cos(t), r * np.sin(t), 0.0 * t], axis=1)
    cut = area(x, triangulate(x, np.arange(1500), np.array([1500])))
    whole = 0.5 * np.cross(x, np.roll(x, -1, axis=0)).sum(axis=0)
    assert len(cut) == 1498
    np.testing.assert_allclose(np.linalg.norm(cut, axis=1).sum(), whole[2], rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_corners_in_the_middle_of_edges_leave_no_triangle_without_area(seed):
    # An L of which every edge is cut in four, turned in space.
    corners = np.array(L_SHAPE, dtype=float)
    s = np.arange(4)[None, :, None] / 4
    x = (corners[:, None] + s * (np.roll(corners, -1, axis=0) - corners)[:, None]).reshape(-1, 3)
    x = np.roll(x, seed, axis=0)
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    cut = np.linalg.norm(
        area(x @ rotation, triangulate(x @ rotation, np.arange(24), np.array([24]))), axis=1
    )
    assert len(cut) == 22
    assert cut.min() > 1e-3
    assert cut.sum() == pytest.approx(3.0)


def test_faces_of_different_sizes_keep_their_order(save):
    text = SQUARE + "v 0 0 1\nf 1 2 5\nf 1 2 3 4\nf 2 3 5\nf 1 2 3 4\n"
    mesh = read_geometry(save("mixed.obj", text))
    corners = [sorted(face) for face in mesh.faces.tolist()]
    assert corners[0] == [0, 1, 4]
    assert corners[3] == [1, 2, 4]
    assert len(corners) == 6


# --- clouds and curves -------------------------------------------------------------------------


def ply(order: str, names: list[str], rows, *more: tuple[str, bytes]) -> bytes:
    words = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}
    header = f"ply\nformat {words[order]} 1.0\nelement vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in names)
    header += "".join(text for text, _ in more)
    if order:
        body = b"".join(struct.pack(f"{order}{len(names)}f", *row) for row in rows)
    else:
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    return header.encode() + b"end_header\n" + body + b"".join(data for _, data in more)


ROWS = [[0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 1, 0], [0, 1, 0, 1, 0, 0], [0, 0, 1, 0, 0, -1]]
NAMES = ["x", "y", "z", "nx", "ny", "nz"]
XYZ = "".join(" ".join(map(str, row)) + "\n" for row in ROWS)
OBJ = "".join("v {} {} {}\nvn {} {} {}\n".format(*row) for row in ROWS)

CLOUDS = [
    ("a.xyz", XYZ),
    ("a.xyz", "# scanned\n\n" + XYZ.replace("\n", " 12 13\r\n")),
    ("a.obj", OBJ),
    ("a.obj", OBJ.replace("v 0 0 0\n", "v 0 0 \\\n 0\n")),  # not plain
    ("a.ply", ply("", NAMES, ROWS)),
    ("a.ply", ply("<", NAMES, ROWS)),
    ("a.ply", ply(">", ["nz", "q", "x", "y", "z", "nx", "ny"],
                  [[r[5], 9, *r[:5]] for r in ROWS])),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content"), CLOUDS)
def test_points_with_normals_are_a_cloud(save, name, content):
    cloud = read_geometry(save(name, content))
    assert isinstance(cloud, LoadedCloud)
    assert cloud.summary == "4 points with normals, no faces: a point cloud"
    assert cloud.points.tolist() == [row[:3] for row in ROWS]
    assert cloud.normals is not None
    assert cloud.normals.tolist() == [row[3:] for row in ROWS]
    assert cloud.areas is None


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"),
        ("a.xyz", "0 0 0 7\n1 0 0 7\n0 1 0 7\n0 0 1 7\n"),
        ("a.obj", OBJ + "vn 0 0 1\n"),  # not one normal a vertex
        ("a.ply", ply("<", NAMES[:3], [row[:3] for row in ROWS])),
        ("a.ply", ply("", NAMES[:5], [row[:5] for row in ROWS])),
        ("a.glb", trimesh.Scene([trimesh.PointCloud(np.array(ROWS)[:, :3])]).export(
            file_type="glb")),
    ],
)  # fmt: skip
def test_points_without_normals_are_a_cloud(save, name, content):
    cloud = read_geometry(save(name, content))
    assert isinstance(cloud, LoadedCloud)
    assert cloud.summary == "4 points without faces, and no normals read: a point cloud"
    assert cloud.normals is None
    assert cloud.points.tolist() == [row[:3] for row in ROWS]


def test_a_mesh_can_be_taken_as_dipoles(save):
    x, faces = torus_mesh(1.0, 0.4, 30, 20)
    cloud = read_geometry(save("t.ply", exported(x, faces, "ply")), "dipole")
    assert isinstance(cloud, LoadedCloud)
    assert (
        cloud.summary == "1,200 triangles, each taken as a point with its normal and area, as asked"
    )
    assert cloud.areas is not None
    assert cloud.normals is not None
    np.testing.assert_allclose(cloud.normals * cloud.areas[:, None], area(x, faces), atol=1e-7)
    np.testing.assert_allclose(cloud.points, x[faces].mean(axis=1), atol=1e-7)


def test_edges_beside_faces_may_have_any_names(save):
    numbers = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{numbers}element face 1\n"
    head += "property list uchar int vertex_indices\nelement edge 1\nproperty int from\n"
    surface = read_geometry(save("a.ply", head + "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n0\n"))
    assert surface.faces.tolist() == [[0, 1, 2]]


PENTAGON = SQUARE + "v -1 0.5 0\n"


@pytest.mark.parametrize(
    ("name", "content", "read_as", "said"),
    [
        ("a.obj", SQUARE + "l 1 2 3 4 1\n", None, "1 loop of 4 vertices: polylines without faces"),
        ("a.obj", SQUARE + "l 1 2\nl 2 3\nl 3 1\n", "loops", "1 loop of 3 vertices: polylines"),
        ("a.obj", PENTAGON + "f 1 2 3 4 5\n", None, "1 loop of 5 vertices: polygons of which no"),
        ("a.obj", PENTAGON + "v 9 9 9\nf 1 2 3 4 5\nf 6 1 3\n", None, "2 loops of 8 vertices"),
        ("a.obj", SQUARE + "f 1 2 3\nf 1 3 4\n", "loops", "1 loop of 4 edges: the boundary of"),
        ("a.obj", SQUARE + "f 1 2 3 4\nl 1 2 4 1\n", "loops", "2 loops of 7 vertices"),
        ("a.loops", "0 0 0 1 0 0 0 1 0\n", None, "1 loop of 3 vertices: curves, since"),
        ("a.ply", ply("<", NAMES[:3], np.array(ROWS)[:, :3]), "loops",
         "1 loop of 4 vertices: points joined"),
        ("a.ply", ply("<", NAMES[:3], np.array(ROWS)[:, :3], (
            "element edge 3\nproperty int vertex1\nproperty int vertex2\n",
            struct.pack("<6i", 0, 1, 1, 2, 2, 0))), None, "1 loop of 3 vertices: polylines"),
        ("a.stl", exported(np.array(ROWS)[:, :3], [[0, 1, 2]], "stl"), "loops",
         "1 loop of 3 edges: the boundary of the faces"),
    ],
)  # fmt: skip
def test_curves(save, name, content, read_as, said):
    loops = read_geometry(save(name, content), read_as)
    assert isinstance(loops, LoadedCurves)
    assert loops.summary.startswith(said)
    assert all(loop.shape[1] == 3 for loop in loops.loops)


def test_faces_that_share_edges_or_have_few_corners_are_no_curves(save):
    for text in (
        SQUARE + "f 1 2 3 4\n",
        PENTAGON + "v -2 2 0\nf 1 2 3 4 5\nf 5 4 6\n",
    ):
        assert isinstance(read_geometry(save("a.obj", text)), LoadedMesh)
    assert isinstance(
        read_geometry(save("a.obj", PENTAGON + "f 1 2 3 4 5\n"), "winding"), LoadedMesh
    )
    both = read_geometry(save("a.obj", SQUARE + "f 1 2 3 4\nl 1 2 4 1\n"))
    assert isinstance(both, LoadedMesh)
    assert both.summary.endswith("polylines not used")


@pytest.mark.parametrize(
    ("name", "content", "read_as", "message"),
    [
        ("a.xyz", XYZ, "winding", 'it holds points only: .* as "winding", which needs faces'),
        ("a.xyz", XYZ, "loops", 'it holds points only: .* "loops", which needs polylines or faces'),
        ("a.obj", OBJ, "loops", "it holds points only"),
        ("a.obj", SQUARE + "l 1 2 3 1\n", "dipole", "polylines only: .* needs points or faces"),
        ("a.loops", "0 0 0 1 0 0 0 1 0\n", "winding", "it holds curves only"),
        ("a.off", exported(*icosphere(0), "off"), "loops", "closed surface, which has no boundary"),
    ],
)
def test_what_cannot_be_taken_as_asked(save, name, content, read_as, message):
    with pytest.raises(FileFormatError, match=message):
        read_geometry(save(name, content), read_as)


def test_as_must_be_known(save):
    with pytest.raises(ValueError, match=r'read_as must be .*"loops", "polygons" or None'):
        read_geometry(save("a.xyz", XYZ), "mesh")


# --- ways to write the same --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        (SQUARE + "f 1 2 3\nf 1 3 4\n", [[0, 1, 2], [0, 2, 3]]),
        ("# by hand\r\no thing\r\n" + SQUARE.replace("\n", " # corner\r\n")
         + "s off\nf 1 2 3 4\r\n", [[0, 1, 2], [0, 2, 3]]),
        (SQUARE + "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1 # end",
         [[0, 1, 2], [0, 2, 3]]),
        ("f 1 2 3\n" + SQUARE, [[0, 1, 2]]),
        (SQUARE + "f -4 -3 -2\n", [[0, 1, 2]]),
        (SQUARE + "f 1 2 3\nf 1 2 3 4\n", [[0, 1, 2], [0, 1, 2], [0, 2, 3]]),
        (SQUARE + "f 1 2 \\\n3\n", [[0, 1, 2]]),
        (SQUARE + "  f 1 2 3\n", [[0, 1, 2]]),
        (SQUARE + "l 1 2 3 1\nf 1 2 3\n", [[0, 1, 2]]),
        (SQUARE + "f 1 2 3 #\nf\t1 2 3\n", [[0, 1, 2], [0, 1, 2]]),
        (SQUARE + "f 1.0 2.000e+00 3\n", [[0, 1, 2]]),
        (SQUARE + "f 1 2 3 \\\n\nf 1 2 3\\", [[0, 1, 2], [0, 1, 2]]),
    ],
)  # fmt: skip
def test_ways_to_write_faces_in_obj_files(save, text, faces):
    mesh = read_geometry(save("a.obj", text))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == faces


FACES = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
REGULAR = struct.pack("<BB3iBB3i", 7, 3, 0, 1, 2, 7, 3, 0, 2, 3)
MIXED = struct.pack("<BB3iBB4i", 7, 3, 0, 1, 2, 7, 4, 0, 1, 2, 3)


def test_ply_faces_are_read_quickly_if_regular(save, monkeypatch):
    rows = [row[:3] for row in ROWS]
    mixed = ply("<", NAMES[:3], rows, (FACES, MIXED))
    assert len(read_geometry(save("m.ply", mixed)).faces) == 3
    regular = ply("<", NAMES[:3], rows, (FACES, REGULAR))
    text = ply("", NAMES[:3], rows, (FACES, b"7 3 0 1 2\n7 3 0 2 3\n"))
    # Called before rows are gone through one by one.
    monkeypatch.setattr(ply_files, "check_element_count", None)
    for data in (regular, text):
        assert read_geometry(save("r.ply", data)).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


# --- hostile and mistaken files ----------------------------------------------------------------

NOISE = bytes(range(256)) * 40
TRIANGLE_STL = exported(np.array(ROWS)[:, :3], [[0, 1, 2], [0, 2, 3]], "stl")
ASCII_STL = exported(np.array(ROWS)[:, :3], [[0, 1, 2]], "stl_ascii")
OFF = "OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 2 3\n"
GLB = exported(np.array(ROWS, dtype=float)[:, :3], [[0, 1, 2], [0, 2, 3]], "glb")


def glb(change) -> bytes:
    """The file GLB with its header changed."""
    size = int.from_bytes(GLB[12:16], "little")
    header = json.loads(GLB[20 : 20 + size])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = GLB[20 + size :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A
                       ) + text + rest  # fmt: skip


def with_indices(*values: int) -> bytes:
    return GLB.replace(struct.pack("<6I", 0, 1, 2, 0, 2, 3), struct.pack("<6I", *values))


def looped(header) -> None:
    header["nodes"] = [{"children": [1]}, {"children": [0], "mesh": 0}]
    header["scenes"] = [{"nodes": [0]}]


def nested(header) -> None:
    header["nodes"] = [{"children": [k + 1]} for k in range(2000)] + [{"mesh": 0}]
    header["scenes"] = [{"nodes": [0]}]


def doubling(header) -> None:
    header["nodes"] = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    header["scenes"] = [{"nodes": [0]}]


BAD = [
    *[(f"empty.{kind}", b"", "the file is empty")
      for kind in ("obj", "ply", "stl", "off", "glb", "gltf", "xyz")],
    ("noise.obj", NOISE, "binary data"),
    ("noise.ply", NOISE, "this is no .ply file"),
    ("noise.stl", NOISE, "promises 1,397,903,696 triangles, but there is room for 203"),
    ("noise.off", NOISE, "binary data"),
    ("noise.glb", NOISE, "does not begin with 'glTF'"),
    ("noise.gltf", NOISE, "its header is no JSON"),
    ("noise.xyz", NOISE, "binary data"),
    ("a.step", "ISO-10303-21;", "surfaces are read from .obj, .ply, .stl"),
    ("a", "v 0 0 0", "surfaces are read from .obj"),
    ("points.stl", b"\0" * 84, "it holds no triangles"),
    ("short.stl", b"\0" * 40 + b"x", "41 bytes are too few for an .stl file"),
    ("vast.stl", b"\1" * 80 + b"\0\xca\x9a\x3b" + b"\1" * 50,
     "promises 1,000,000,000 triangles, but there is room for 1:"),
    ("cut.stl", TRIANGLE_STL[:-1], "promises 2 triangles, but there is room for 1: .* truncated"),
    ("nan.stl", TRIANGLE_STL[:96] + struct.pack("<f", np.nan) + TRIANGLE_STL[100:],
     "triangle 0: coordinates must be finite"),
    ("cut2.stl", ASCII_STL[:-20], "line 7: the file ends before 'endsolid'"),
    ("word.stl", ASCII_STL.replace(b"outer", b"inner"), "line 3: 'inner' is no .stl statement"),
    ("word2.stl", ASCII_STL.replace(b"vertex 1", b"vertex one"), "'one.*' is not a number"),
    ("nan2.stl", ASCII_STL.replace(b"vertex 1.0", b"vertex nan"), "must be finite"),
    ("two.stl", ASCII_STL.replace(b"vertex 1", b"outer 1"), "2 vertices in 1 facets"),
    ("none.stl", "solid a\nendsolid a\n", "it holds no triangles"),
    ("head.off", OFF.replace("OFF", "AFF"), "it does not begin with 'OFF'"),
    ("four.off", OFF.replace("OFF", "4OFF"), "other than three coordinates"),
    ("binary.off", OFF.replace("OFF", "OFF BINARY"), "binary .off files are not read"),
    ("end.off", "OFF\n", "ends before the numbers of vertices and faces"),
    ("counts.off", "OFF 4\n", "line 1: numbers of vertices and faces are expected"),
    ("counts2.off", "OFF\nfour two zero\n", "line 2: 'four' is not an integer"),
    ("minus.off", OFF.replace("4 2", "4 -2"), "line 2: .* cannot be negative"),
    ("vast.off", OFF.replace("4 2", "4 1000000000"), "promises 4 vertices and 1,000,000,000 faces"),
    ("cut.off", OFF[:-8], "but 5 lines follow: the file is truncated"),
    ("none.off", "OFF\n0 0 0\n", "it holds no vertices"),
    ("range.off", OFF.replace("3 0 2 3", "3 0 2 4"), "line 8: vertex 4 is out of range"),
    ("minus2.off", OFF.replace("3 0 2 3", "3 0 2 -1"), "line 8: vertex -1 is out of range"),
    ("float.off", OFF.replace("3 0 2 3", "3 0 2 1.5"), "line 8: '1.5' is not an integer"),
    ("size.off", OFF.replace("3 0 2 3", "4 0 2 3"), "line 8: a face of '4' vertices does not fit"),
    ("size2.off", OFF.replace("3 0 2 3", "-3 0 2 3"), "line 8: a face of '-3' vertices"),
    ("few.off", OFF.replace("1 0 0", "1 0"), "line 4: 2 numbers are too few: 3 are expected"),
    ("nan.off", OFF.replace("1 0 0", "1 0 nan"), "line 4: coordinates must be finite, not 'nan'"),
    ("none.xyz", "# nothing\n", "it holds no points"),
    ("two.xyz", "0 0\n1 0\n", "line 1: a point needs three coordinates, not 2"),
    ("ragged.xyz", "0 0 0\n\n1 0 0\n1 0\n", "line 4: 2 columns, but the lines before have 3"),
    ("word.xyz", "0 0 0\n1 one 0\n", "line 2: 'one' is not a number"),
    ("molecule.xyz", "1\nwater\nO 0 0 0\n", "line 2: 'water' is not a number"),
    ("comma.xyz", "0,5 0,5 1,5\n", "line 1: .* write numbers with decimal points"),
    ("nan.xyz", "0 0 0\n1 nan 0\n", "line 2: coordinates must be finite"),
    ("scalars.xyz", "0 0 0 255 128 0.5\n", "line 1: columns 4 to 6 .* length is 285: remove"),
    ("large.xyz", "0 0 0\n1e200 0 0\n", r"up to 1e\+200 are too large"),
    ("none.obj", "vn 0 0 1\n", "there are no points"),
    ("range.obj", SQUARE + "f 1 2 5\n", "line 5: vertex 5 is out of range"),
    ("nan.obj", SQUARE + "v 0 nan 0\nf 1 2 3\n", "line 5: coordinates must be finite"),
    ("flat.obj", SQUARE + "f 1 2 2\nf 1 1 1\n", "all 2 faces have zero area"),
    ("turned.obj", SQUARE + "f 1 2 3\nf 3 2 1\n", "its 2 faces cancel each other"),
    ("large.obj", SQUARE + "v 1e200 0 0\nf 1 2 5\n", r"up to 1e\+200 are too large"),
    ("zero.obj", SQUARE.replace("v", "vn 0 0 0\nv"), "normal 0 is zero .and 3 more.*estimate"),
    ("word.obj", SQUARE + "vn 0 0 1\n" * 3 + "vn up\n", "line 8: 1 numbers are too few"),
    ("dents.obj", "".join(f"v {k * k % 11} {k % 5} 0\n" for k in range(40000)) + "f " +
     " ".join(map(str, range(1, 40001))) + "\nf 1 2 3\n", "take too long to triangulate"),
    ("many.ply", ply("<", NAMES, ROWS).replace(b"vertex 4", b"vertex 999999999"), "ends before"),
    ("cut.ply", ply("<", NAMES, ROWS)[:-1], "the file ends before the 4 rows"),
    *[(f"cut{k}.ply", ply("<", NAMES[:3], [row[:3] for row in ROWS], (FACES, REGULAR))[:-k],
       "the file ends before the 2 rows of element 'face'") for k in (1, 4, 13, 14)],
    ("nan.ply", ply("", NAMES, [*ROWS, ["nan", 0, 0, 0, 0, 1]]), "vertex 4: coordinates must"),
    ("range.ply", ply("<", NAMES[:3], np.array(ROWS)[:, :3], (FACES, REGULAR[:-4] + b"\4\0\0\0")),
     "face 1: vertex 4 is out of range"),
    ("size.ply", ply("<", NAMES[:3], np.array(ROWS)[:, :3],
                     (FACES.replace("uchar int", "uint int"), b"\7" + b"\xff" * 40)),
     "the file ends before the 2 rows of element 'face'"),
    ("zero.ply", ply("<", NAMES, [[*row[:3], 0, 0, 0] for row in ROWS]), "normal 0 is zero"),
    ("flat.ply", ply("<", NAMES[:2], [row[:2] for row in ROWS]), "needs a property 'z'"),
    ("cut.glb", GLB[:-1], "it is truncated"),
    ("cut2.glb", GLB[:19], "does not begin with 'glTF'"),
    ("old.glb", GLB[:4] + b"\1" + GLB[5:], "version 1 of glTF is not read"),
    ("json.glb", GLB[:20] + b"[" + GLB[21:], "its header is no JSON"),
    ("list.gltf", "[]", "its header is no JSON object"),
    ("deep.gltf", "[" * 100_000, "its header is no JSON"),
    ("none.gltf", '{"asset": {"version": "2.0"}}', "neither triangles nor points|no sound glTF"),
    ("draco.glb", glb(lambda h: h.update(extensionsRequired=["KHR_draco_mesh_compression"])),
     "needs the extension KHR_draco_mesh_compression, which is not read"),
    ("vast.glb", glb(lambda h: h["accessors"][1].update(count=10**9)), "asks for 12,000,000,0"),
    ("minus.glb", glb(lambda h: h["accessors"][1].update(count=-1)), "count is -1"),
    ("view.glb", glb(lambda h: h["bufferViews"][1].update(byteLength=10**9)), "lies outside"),
    ("empty.glb", glb(lambda h: h["accessors"][1].pop("bufferView")), "compressed or sparse"),
    ("type.glb", glb(lambda h: h["accessors"][1].update(componentType=1)), "no sound glTF file"),
    ("loop.glb", glb(looped), "hangs below two others"),
    ("double.glb", glb(doubling), "hangs below two others"),
    ("nested.glb", glb(nested), "nested more than 1000 nodes deep"),
    ("range.glb", with_indices(0, 1, 2, 0, 2, 4), "vertex 4 of mesh .* is out of range"),
    ("uri.gltf", json.dumps({"buffers": [{"uri": "../../etc/passwd", "byteLength": 9}]}),
     "is not a file beside it"),
    ("uri2.gltf", json.dumps({"buffers": [{"uri": "http://a/b.bin", "byteLength": 9}]}),
     "is not a file beside it"),
    ("nan.glb", GLB.replace(struct.pack("<3f", 1, 0, 0), struct.pack("<3f", np.nan, 0, 0)),
     "coordinates must be finite"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), BAD, ids=[bad[0] for bad in BAD])
def test_each_bad_file_has_its_own_error(save, name, content, message):
    path = save(name, content)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_geometry(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 350 + len(str(path))


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "glb", "gltf", "xyz", "loops"])
def test_what_is_not_a_file_is_said(tmp_path, kind):
    with pytest.raises(FileFormatError, match="no such file"):
        read_geometry(tmp_path / f"missing.{kind}")
    (tmp_path / f"folder.{kind}").mkdir()
    with pytest.raises(FileFormatError, match="a directory"):
        read_geometry(tmp_path / f"folder.{kind}")


def test_a_scene_that_draws_one_mesh_too_often_is_refused(save, monkeypatch):
    def repeat(header) -> None:
        header["nodes"] = [{"mesh": 0} for _ in range(50)]
        header["scenes"] = [{"nodes": list(range(50))}]

    path = save("repeat.glb", glb(repeat))
    assert len(read_geometry(path).faces) == 100
    monkeypatch.setattr(gltf, "MAX_BYTES", 299)
    with pytest.raises(FileFormatError, match="draws 300 corners: at most 299"):
        read_geometry(path)


SEEDS = [
    ("a.obj", (SQUARE + "vn 0 0 1\nf 1//1 2//1 3//1\nf 1//1 3//1 4//1\n").encode()),
    ("a.ply", ply("<", NAMES, ROWS, (FACES, MIXED))),
    ("a.ply", ply("", NAMES, ROWS)),
    ("a.stl", TRIANGLE_STL),
    ("a.stl", ASCII_STL),
    ("a.off", OFF.encode()),
    ("a.glb", GLB),
    ("a.xyz", XYZ.encode()),
]


@pytest.mark.slow
@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.sampled_from(SEEDS),
    edits=st.lists(st.tuples(st.integers(0, 900), st.binary(max_size=4)), max_size=4),
    cut=st.integers(0, 900) | st.none(),
    read_as=st.sampled_from([None, "winding", "dipole", "loops", "polygons"]),
)
def test_a_damaged_file_is_read_or_refused_but_nothing_else(save, seed, edits, cut, read_as):
    name, data = seed
    for position, bytes_ in edits:
        position %= len(data)
        data = data[:position] + bytes_ + data[position + len(bytes_) :]
    with contextlib.suppress(FileFormatError):
        assert read_geometry(save(name, data[:cut]), read_as).summary


EMPTY_FACES = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 30000000\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", EMPTY_FACES + b"\0" * 30_000_012),
        ("a.obj", b"v 0 0 0\nf 1 1 1\nf 1 1 1 1\n" + b"x\n" * 1000),
    ],
)
def test_files_of_many_irregular_elements_take_neither_all_memory_nor_minutes(
    save, monkeypatch, name, content
):
    if name == "a.obj":
        monkeypatch.setattr("harnack.files.file_geometry.MAX_ELEMENTS", 500)
    with pytest.raises(FileFormatError, match=r"elements are too many .* let the program"):
        read_geometry(save(name, content))


def test_polygons_are_read_as_they_are(save):
    corners = "v 0 0 0\nv 2 0 0\nv 2 1 1\nv 1 2 0\nv 0 1 1\nv 3 3 0\n"
    path = save("net.obj", corners + "f 1 2 3 4 5\nf 3 2 6\nf 4/1 3/2 6/3\n")
    surface = read_geometry(path, "polygons")
    assert [face.tolist() for face in surface.faces] == [[0, 1, 2, 3, 4], [2, 1, 5], [3, 2, 5]]
    assert surface.summary.startswith("3 polygons of 3 to 5 corners")
    opened = field_from_file(path, read_as="polygons", up="z")
    assert isinstance(opened.field, PolygonMesh)
    assert opened.field.faces.face_count == 3
    assert opened.show == "shaded"
    # Without being asked they are cut into triangles.
    assert len(read_geometry(path, "winding").faces) == 5
    with pytest.raises(FileFormatError, match="face 1 visits vertex 0 twice"):
        field_from_file(save("bad.obj", corners + "f 1 2 3\nf 1 2 1 3\n"), read_as="polygons")
    with pytest.raises(FileFormatError, match='cannot be taken as "polygons", which needs faces'):
        read_geometry(save("a.xyz", XYZ), "polygons")
