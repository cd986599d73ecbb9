"""Cases of an audit of the readers: files that programs write, of which something was left out or
misread without a word. Each is read rightly now, or refused by name."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
import pytest

from harnack.files.file_geometry import FileFormatError
from harnack.files.geometry_files import LoadedCloud, read_geometry

POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
THREE = POINTS + "f 1 3 2\nf 1 2 4\nf 2 3 4\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
LIST = "property list uchar int vertex_indices\n"
ROWS, FACES = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n", "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"


def facets(n: int, count: int) -> bytes:
    """A binary .stl file of n triangles that promises so many."""
    rows = [struct.pack("<12fH", 0, 0, 0, k, 0, 0, k + 1, 0, 0, k, 1, 0, 0) for k in range(n)]
    return bytes(80) + struct.pack("<I", count) + b"".join(rows)


def atom(number: int, name: str, residue: str, x: float, at: int = 1) -> str:
    element = name.strip()[0]
    return (
        f"HETATM{number:5d}  {name:3s}{residue} A{at:4d}    {x:8.3f}   0.000   0.000"
        f"  1.00  0.00           {element}\n"
    )


def scene(**changed: Any) -> str:
    """A .gltf file of a tetrahedron, some entries of which are others."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4").tobytes()
    data = x + np.array([0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2], "<u2").tobytes()
    whole: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
             "min": [0, 0, 0], "max": [1, 1, 1]},
            {"bufferView": 0, "byteOffset": 48, "componentType": 5123, "count": 12,
             "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{
            "byteLength": len(data),
            "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
        }],
    }  # fmt: skip
    return json.dumps({**whole, **changed})


TETRAHEDRON = {"attributes": {"POSITION": 0}, "indices": 1}


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.obj", THREE + "f 1 4 3\nsurf 0 1 0 1 1 2 3 4\n", "'surf' is not read"),
        ("a.obj", POINTS + "vn 0 0 1\n" * 4 + "surf 0 1 0 1 1 2 3 4\n", "'surf' is not read"),
        ("a.obj", POINTS + "l 1 2 3 1\ncurv 0 1 1 2 3 4\n", "'curv' is not read"),
        ("a.obj", THREE + "fo 1 4 3\n", "'fo' is not read"),
        ("a.obj", THREE + "F 1 4 3\n", "'F' is not read"),
        ("a.obj", THREE + "call rest.obj\n", "'call' is not read"),
        ("a.obj", POINTS + "f 1 2 3 \\\n# last\n 4\n", "'4' is no .obj statement"),
        ("a.obj", "v 1_0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "'1_0' is not a number"),
        ("a.ply", PLY + "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
         + ROWS + "4 0 1 2 3\n", "element 'tristrips' is not read"),
        ("a.ply", PLY + "element faces 4\n" + LIST + "end_header\n" + ROWS + FACES,
         "element 'faces' is not read"),
        ("a.ply", PLY + "element face 1\n" + LIST + "element face 3\n" + LIST + "end_header\n"
         + ROWS + FACES, "'face' twice"),
        ("a.ply", PLY + "element face 3\n" + LIST + "end_header\n" + ROWS + FACES,
         "more follows than the rows"),
        ("a.off", "OFF\n4 3 6\n" + ROWS + FACES, "more follows than the 4 vertices and 3 faces"),
        ("a.stl", facets(4, 3), "promises 3 triangles, but 1 more follow"),
        ("a.stl", facets(2, 2) + facets(2, 2), "several files were joined"),
        ("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"
         "vertex 0 1 0\nvertex 0 0 1\nendloop\nendfacet\nfacet normal 0 0 1\nouter loop\n"
         "vertex 5 0 0\nvertex 6 0 0\nendloop\nendfacet\nendsolid a\n", "each needs three"),
        ("a.gltf", scene(meshes=[{"primitives": [TETRAHEDRON, {**TETRAHEDRON, "mode": 6}]}]),
         "in fans"),
        ("a.gltf", scene(meshes=[{"primitives": [TETRAHEDRON, {**TETRAHEDRON, "mode": 1}]}]),
         "points or lines beside triangles"),
        ("a.gltf", scene(nodes=[{"mesh": 0, "skin": 0}]), "moved by a skin"),
        ("a.gltf", scene(meshes=[{"weights": [1.0], "primitives": [
            {**TETRAHEDRON, "targets": [{"POSITION": 0}]}]}]), "moved by morph targets"),
        ("a.gltf", scene(extensionsUsed=["EXT_mesh_gpu_instancing"]), "EXT_mesh_gpu_instancing"),
        ("a.gltf", scene(extensionsUsed=["KHR_mesh_quantization"]), "KHR_mesh_quantization"),
        ("a.pdb", atom(1, "C1", " LIG", 1.0) + " " + atom(2, "O1", " LIG", 2.0),
         "begin in column 1"),
        ("a.pdb", "ATOM      1  C   ALA A   1    12345.67812345.67812345.678  1.00  0.00"
         "           C\n", "run out of their columns"),
    ],
)  # fmt: skip
def test_what_would_be_left_out_is_refused(
    save: Any, name: str, content: str | bytes, complaint: str
) -> None:
    with pytest.raises(FileFormatError, match=complaint):
        read_geometry(save(name, content))


def test_the_scene_by_itself_is_read(save: Any) -> None:
    assert len(read_geometry(save("a.gltf", scene())).faces) == 4


def test_points_choose_vertices_and_normals(save: Any) -> None:
    text = "v 0 0 0\nv 9 9 9\nv 1 0 0\nvn 1 0 0\nvn 0 0 1\np 1//2 3//1\n"
    cloud = read_geometry(save("a.obj", text))
    assert isinstance(cloud, LoadedCloud)
    np.testing.assert_array_equal(cloud.points, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1], [1, 0, 0]])


@pytest.mark.parametrize(
    ("content", "xs"),
    [
        (b"\xef\xbb\xbf" + (atom(1, "C1", " LIG", 1.0) + atom(2, "O1", " LIG", 2.0)).encode(),
         [1, 2]),
        ((atom(1, "C1", " LIG", 1.0) + atom(2, "O1", " LIG", 2.0)).replace("\n", "\r"), [1, 2]),
        (atom(1, "O5\u00b4", " LIG", 12.345), [12.345]),
        (atom(1, "O5\u2032", " LIG", 12.345).encode(), [12.345]),
        (atom(1, "O5\u00b4", " LIG", 12.345).encode("latin-1"), [12.345]),
        # Waters whose numbers begin again behind a line TER are no alternatives,
        (atom(1, "O", "AHOH", 0.0) + "TER\n" + atom(2, "O", "BHOH", 50.0), [0, 50]),
        # nor are residues with the same letter; those with others are.
        (atom(1, "O1", "AHOH", 1.0) + atom(2, "C9", "ALIG", 9.0), [1, 9]),
        (atom(1, "O1", "AHOH", 1.0) + atom(2, "O1", "BHOH", 1.2), [1]),
    ],
)  # fmt: skip
def test_every_atom_counts_where_it_stands(save: Any, content: str | bytes, xs: Any) -> None:
    atoms = read_geometry(save("a.pdb", content))
    np.testing.assert_allclose(atoms.positions[:, 0], xs)
