"""Point clouds as programs write them: names of normals, .pcd files, tables in text, and
coordinates of maps. Some cases are small copies of files in public bug reports of other readers."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.files.file_geometry import FileFormatError
from harnack.files.geometry_files import LoadedCloud, read_geometry
from harnack.files.pcd import _unpack_lzf  # pyright: ignore[reportPrivateUsage]

X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
N = np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, -1]])


def read(path: Any, **options: Any) -> LoadedCloud:
    """The point cloud in a file."""
    cloud = read_geometry(path, **options)
    assert isinstance(cloud, LoadedCloud)
    return cloud


# Which numbers of a point are its normal.


@pytest.mark.parametrize(
    "names",
    [
        ("nx", "ny", "nz"),  # MeshLab, Open3D, CloudCompare
        ("normal_x", "normal_y", "normal_z"),  # PCL
        ("normalx", "normaly", "normalz"),
        ("NormalX", "NormalY", "NormalZ"),  # PDAL
        ("n_x", "n_y", "n_z"),
        ("scalar_Nx", "scalar_Ny", "scalar_Nz"),  # CloudCompare, of another program's normals
        ("scalar_NormalX", "scalar_NormalY", "scalar_NormalZ"),
    ],
)
def test_normals_of_ply_files_have_many_names(save: Any, names: tuple[str, str, str]) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "red", *names)
    )
    rows = [(*x, 7, *n) for x, n in zip(X, N, strict=True)]
    text = header + "end_header\n" + "".join(" ".join(map(str, row)) + "\n" for row in rows)
    cloud = read(save("a.ply", text))
    np.testing.assert_array_equal(cloud.points, X)
    np.testing.assert_array_equal(cloud.normals, N)
    assert cloud.summary == "4 points with normals, no faces: a point cloud; colors not used"


def test_wrong_normals_do_not_matter_if_normals_are_estimated(save: Any) -> None:
    # PCL writes nan where it could not estimate a normal.
    rows = np.random.default_rng(0).normal(size=(50, 3))
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    text = pcd_header(["x", "y", "z", "normal_x", "normal_y", "normal_z"], 50, "ascii")
    path = save("a.pcd", text + "".join(f"{x} {y} {z} nan nan nan\n" for x, y, z in rows))
    with pytest.raises(FileFormatError, match=r"normal 0 is .nan"):
        hk.io.field_from_file(path)
    field = hk.io.field_from_file(path, normals="estimate").field
    outward = (np.asarray(field.normals) * rows).sum(axis=1)  # pyright: ignore
    assert (outward > 0.5).all()


# .pcd files.


def pcd_header(names: list[str], count: int, encoding: str, **changed: str) -> str:
    """The header of a .pcd file of such fields, single floats, some lines of which are others."""
    k = len(names)
    lines = {
        "VERSION": "0.7", "FIELDS": " ".join(names), "SIZE": "4 " * k, "TYPE": "F " * k,
        "COUNT": "1 " * k, "WIDTH": str(count), "HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(count), "DATA": encoding,
    } | changed  # fmt: skip
    return "# .PCD v0.7\n" + "".join(f"{name} {value}\n" for name, value in lines.items())


def packed_literally(data: bytes) -> bytes:
    """Bytes in the form of LZF, none of which is taken from bytes before."""
    parts = [data[k : k + 32] for k in range(0, len(data), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(data)) + packed


NAMES = ["x", "y", "z", "normal_x", "normal_y", "normal_z"]


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_are_read_in_every_encoding(save: Any, encoding: str) -> None:
    table = np.concatenate([X, N], axis=1).astype("<f4")
    body = {
        "ascii": "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode(),
        "binary": table.tobytes(),
        "binary_compressed": packed_literally(table.T.tobytes()),
    }[encoding]
    cloud = read(save("a.pcd", pcd_header(NAMES, 4, encoding).encode() + body))
    np.testing.assert_array_equal(cloud.points, X)
    np.testing.assert_array_equal(cloud.normals, N)
    assert cloud.summary == "4 points with normals, no faces: a point cloud"


def test_padding_and_wide_fields_of_pcd_files_are_skipped(save: Any) -> None:
    header = pcd_header(
        ["x", "y", "z", "_", "intensity", "ring", "_"], 4, "binary",
        SIZE="8 8 8 1 4 2 1", TYPE="F F F U F U U", COUNT="1 1 1 4 1 1 10",
    )  # fmt: skip
    rows = [struct.pack("<3d4sfH10s", *x, b"pads", 0.5, 3, b"more padds") for x in X + 5e6]
    for tail in (b"", b"\0" * 9):  # some programs write more than they declare
        cloud = read(save("a.pcd", header.encode() + b"".join(rows) + tail))
        np.testing.assert_array_equal(cloud.points, X + 5e6)
        assert cloud.normals is None


def test_points_without_a_measurement_are_left_out(save: Any) -> None:
    header = pcd_header(["x", "y", "z", "rgb"], 6, "ascii", WIDTH="3", HEIGHT="2",
                        VIEWPOINT="1 0 0 1 0 0 0")  # fmt: skip
    rows = "".join(f"{x} {y} {z} 4.2108e+06\n" for x, y, z in X)
    cloud = read(save("a.pcd", header + "nan nan nan 0\n" + rows + "0 inf 0 0\n"))
    np.testing.assert_array_equal(cloud.points, X)
    assert cloud.summary.endswith(
        "a point cloud; 2 without coordinates left out; colors not used; its viewpoint not used"
    )


@pytest.mark.parametrize(
    ("packed", "whole"),
    [
        (b"\x02abc", b"abc"),
        (b"\x02abc\x20\x02", b"abcabc"),  # three bytes, from three bytes back
        (b"\x00a\xe0\x05\x00", b"a" * 15),  # 14 bytes, from one byte back: it repeats itself
        (b"\x01ab\xa0\x01", b"ab" + b"ababababa"[:7]),
    ],
)
def test_lzf_is_unpacked(packed: bytes, whole: bytes) -> None:
    assert _unpack_lzf(packed, len(whole)) == whole
    assert _unpack_lzf(packed, len(whole) - 1) is None
    assert _unpack_lzf(packed, len(whole) + 1) is None
    assert _unpack_lzf(packed[:-1], len(whole)) is None


FEW = pcd_header(["x", "y", "z"], 4, "binary")
BODY = X.astype("<f4").tobytes()
BAD_PCD = [
    ("FIELDS x y z\n", "its header has no line DATA"),
    ("hello\nDATA ascii\n", "line 1: 'hello' is no statement"),
    (FEW.replace("VERSION", "FIELDS"), "line 3: 'FIELDS x y z' is no statement .* second"),
    (FEW.replace("binary", "packed"), "DATA must be ascii, binary, binary_compressed"),
    (FEW.replace("SIZE 4 4 4", "SIZE 4 4"), "no sound .pcd header"),
    (FEW.replace("SIZE 4 4 4", "SIZE 4 3 4"), "field 'y' has the unknown type F of 3 bytes"),
    (FEW.replace("COUNT 1 1 1", "COUNT 1 -1 1"), "field 'y' has the count -1"),
    (FEW.replace("COUNT 1 1 1", "COUNT 1 2 1"), "'y' must be one number a point"),
    (FEW.replace("WIDTH 4", "WIDTH four"), "no sound .pcd header"),
    (FEW.replace("WIDTH 4", "WIDTH 5"), "WIDTH 5 times HEIGHT 1 is not POINTS 4"),
    (FEW.replace("WIDTH 4", "WIDTH 0").replace("POINTS 4", "POINTS 0"), "declares no points"),
    (FEW.replace("x y z", "x y w"), "its fields, x, y, w, lack x, y or z"),
    (FEW.replace("x y z", "x y y"), "lack x, y or z"),
    (FEW.replace(" 4\n", " 999999999999\n"), "have 11,999,999,999,988 bytes: at most"),
    (FEW, "its 4 points need 48 bytes, and there are 0: the file is truncated"),
    (FEW.encode() + BODY[:-1], "need 48 bytes, and there are 47"),
    (FEW.replace("binary", "ascii") + "0 0 0\n" * 3, "declares 4 points, but 3 lines follow"),
    (FEW.replace("binary", "ascii") + "0 0 0\n" * 3 + "0 0\n", "line 15: 2 numbers, but .* 3"),
    (FEW.replace("binary", "ascii") + "0 0 0\n" * 3 + "0 a 0\n", "line 15: 'a' is not a number"),
    (FEW.replace("binary", "ascii") + "nan 0 0\n" * 4, "none of its points has coordinates"),
    (FEW.replace("binary", "binary_compressed").encode() + packed_literally(BODY)[:-1],
     "49 packed bytes|50 packed bytes"),
    (FEW.replace("binary", "binary_compressed").encode() + packed_literally(BODY[:-4]),
     "need 48 bytes, and there are 44"),
    (FEW.replace("binary", "binary_compressed").encode() + struct.pack("<II", 2, 48) + b"\x20\x00",
     "cannot be unpacked"),
    (FEW.replace("binary", "binary_compressed").encode() + struct.pack("<II", 9, 2**31),
     "2,147,483,648 bytes when unpacked"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "message"), BAD_PCD)
def test_each_bad_pcd_file_has_its_own_error(save: Any, content: str | bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_geometry(save("a.pcd", content))


# Tables in text.


def lines(*columns: np.ndarray, separator: str = " ", head: str = "") -> str:
    """A table of these columns."""
    rows = np.concatenate(columns, axis=1).tolist()
    return head + "".join(separator.join(f"{c:g}" for c in row) + "\n" for row in rows)


RGB = np.array([[0, 0, 0], [255, 0, 9], [1, 2, 3], [0, 0, 1]])
ONE = np.ones((4, 1))


@pytest.mark.parametrize(
    ("name", "text", "normals", "note"),
    [
        ("a.txt", lines(X, N), N, ""),
        ("a.csv", lines(X, N, separator=","), N, ""),
        ("a.csv", lines(X, N, separator=", "), N, ""),
        ("a.txt", lines(X, N, separator=";"), N, ""),
        ("a.txt", lines(X, N, separator="\t"), N, ""),
        ("a.csv", lines(N, RGB, X, separator=",", head="Nx,Ny,Nz,R,G,B,X,Y,Z\n"), N,
         "; colors not used"),
        ("a.csv", lines(X, ONE, separator=";", head='"x";"y";"z";"time"\n'), None, ""),
        # CloudCompare
        ("a.txt", lines(X, RGB, N, head="//X,Y,Z,R,G,B,Nx,Ny,Nz\n"), N,
         "; colors not used"),
        ("a.txt", lines(X, RGB, N, head="//X Y Z R G B Nx Ny Nz\n4\n"), N, "; colors not used"),
        ("a.txt", lines(X, RGB, N), N, "; columns 4 to 6 are colors, not used"),
        ("a.txt", lines(X, RGB, 3 * N), None, "; columns 4 to 6 are colors, not used"),
        ("a.xyz", lines(X, N, head="// scanned\n"), N, ""),
        # NumPy
        ("a.txt", lines(N, X, head="# nx ny nz x y z\n"), N, ""),
        ("a.txt", lines(ONE, X, head="# made by hand\n# id x y z\n"), None, ""),
        ("a.txt", lines(X, N, head="# x y z and normals\n"), N, ""),
        # Other columns that are called alike
        ("a.csv", lines(X, ONE, separator=",", head="x,y,z,Z\n"), None, ""),
        ("a.txt", lines(X, N, ONE, head="x y z nx ny nz scalar_Nz\n"), N, ""),
        # Open3D
        ("a.xyzn", lines(X, N), N, ""),
        ("a.xyz", lines(X, RGB), None, "; columns 4 to 6 are colors, not used"),
        # Leica
        ("a.pts", lines(X, -900 * ONE, RGB, head="4\n"), None, "; columns 4 and up not used"),
        ("a.pts", lines(X, RGB, head="4\n"), None, "; columns 4 to 6 are colors, not used"),
        ("a.pts", lines(X, N), N, ""),
    ],
)  # fmt: skip
def test_tables_are_read(
    save: Any, name: str, text: str, normals: np.ndarray | None, note: str
) -> None:
    cloud = read(save(name, text))
    np.testing.assert_array_equal(cloud.points, X)
    if normals is None:
        assert cloud.normals is None
    else:
        np.testing.assert_array_equal(cloud.normals, normals)
    assert cloud.summary.endswith(f"a point cloud{note}")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "0,5;1,5;2,5\n", "line 1: .*decimal points"),
        ("a.txt", "0,5 1,5 2,5\n", "line 1: .*decimal points"),
        ("a.csv", "x,y,name\n0,1,2\n", "its columns, x, y, name, lack x, y or z"),
        ("a.csv", "x,y,z\n0,1,2,3\n", "3 columns are named, and there are 4"),
        ("a.csv", "x,y,z\n", "it holds no points"),
        ("a.csv", "x,y,z\n0,one,2\n", "line 2: 'one' is not a number"),
        ("a.pts", "5\n" + lines(X), "promises 5 points, but 4 lines follow"),
        ("a.pts", "4\n" + lines(X) + "4\n" + lines(X), "promises 4 points, but 9 lines follow"),
        ("a.xyz", lines(X, 2 * N + 0.5), "name all columns in a first line"),
    ],
)
def test_what_a_table_may_mean_otherwise_is_refused(
    save: Any, name: str, text: str, message: str
) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_geometry(save(name, text))


# Coordinates of maps.

MAP = np.array([500_123.25, 5_400_321.5, 212.75])


def test_what_is_far_away_is_moved_if_asked_without_losing_a_digit(save: Any) -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = 20.0 * normals + MAP
    path = save("a.xyz", "".join(f"{' '.join(map(repr, row))}\n" for row in
                                 np.concatenate([points, normals], axis=1).tolist()))  # fmt: skip
    kept = hk.io.field_from_file(path)
    assert kept.origin == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(kept.field.points, points)  # pyright: ignore
    moved = hk.io.field_from_file(path, origin="auto")
    assert moved.origin == (500_120.0, 5_400_320.0, 210.0)
    assert moved.summary.endswith("; its point (500120, 5400320, 210) is the origin")
    np.testing.assert_array_equal(moved.field.points + moved.origin, points)  # pyright: ignore
    np.testing.assert_array_equal(moved.field.normals, kept.field.normals)  # pyright: ignore
    turned = hk.io.field_from_file(path, origin=MAP, up="y")
    np.testing.assert_allclose(turned.field.points, 20 * normals[:, [0, 2, 1]] * [1, -1, 1],
                               atol=2e-9)  # fmt: skip
    # What is near stays where it is, unless the middle is asked for.
    near = save("b.xyz", lines(X + 3, N))
    assert hk.io.field_from_file(near, origin="auto").origin == (0.0, 0.0, 0.0)
    assert hk.io.field_from_file(near, origin="center").origin == (4.0, 4.0, 4.0)
    for wrong in ("middle", [1, 2], [1, 2, np.nan], ["a", 1, 2]):
        with pytest.raises(ValueError, match='origin must be "auto", "center", three'):
            hk.io.field_from_file(near, origin=wrong)  # pyright: ignore


def test_curves_meshes_and_blobs_are_moved_as_well(save: Any) -> None:
    x = X * 10 + MAP
    obj = "".join(f"v {a!r} {b!r} {c!r}\n" for a, b, c in x.tolist())
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    for name, text in (
        ("a.obj", obj + faces), ("b.obj", obj + "l 1 2 3 1\n"),
        ("c.blobs", "".join(f"{a!r} {b!r} {c!r} 2\n" for a, b, c in x.tolist())),
    ):  # fmt: skip
        opened = hk.io.field_from_file(save(name, text), origin=tuple(x[0].tolist()), up="z")
        box = opened.field.extent((opened.field.default_level,))
        assert isinstance(box, hk.Box | hk.geometry.ConvexHull)
        assert np.abs([box.lower, box.upper]).max() < 20
