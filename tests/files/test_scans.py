"""Files of laser scanners, written by laspy and pye57: coordinates of maps, normals, withheld and
invalid points, poses, and damaged files."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.files import scans
from harnack.files.file_geometry import FileFormatError
from harnack.files.geometry_files import LoadedCloud, read_geometry

_MAP = np.array([500_123.25, 5_400_321.5, 212.75])
_RNG = np.random.default_rng(3)
_NORMALS = _RNG.normal(size=(300, 3))
_NORMALS /= np.linalg.norm(_NORMALS, axis=1)[:, None]
_POINTS = 20.0 * _NORMALS + _MAP


def las(path: Path, kind: int = 3, *, withheld: int = 0, normals: bool = True) -> Path:
    """A .las or .laz file of the points, in steps of a tenth of a millimeter."""
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=kind, version="1.2" if kind < 6 else "1.4")
    header.offsets, header.scales = np.floor(_MAP), [1e-4] * 3
    for axis in "XYZ" if normals else "":
        header.add_extra_dim(laspy.ExtraBytesParams(name=f"Normal{axis}", type=np.float32))
    points = laspy.LasData(header)
    points.x, points.y, points.z = _POINTS.T
    for axis, column in zip("XYZ" if normals else "", _NORMALS.T, strict=normals):
        points[f"Normal{axis}"] = column
    points.withheld[:withheld] = 1
    points.write(path)
    return path


def cloud_of(path: Path) -> LoadedCloud:
    """The point cloud in a file."""
    cloud = read_geometry(path)
    assert isinstance(cloud, LoadedCloud)
    return cloud


@pytest.mark.parametrize("kind", [0, 3, 6, 8])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_files_keep_coordinates_of_maps(tmp_path: Path, suffix: str, kind: int) -> None:
    cloud = cloud_of(las(tmp_path / f"a{suffix}", kind))
    # Half a step, and the rounding of the scaled integers.
    np.testing.assert_allclose(cloud.points, _POINTS, rtol=0, atol=0.5e-4 + 2e-9)
    np.testing.assert_allclose(cloud.normals, _NORMALS, rtol=0, atol=1e-7)  # pyright: ignore
    has_color = "; colors not used" * (kind in (3, 8))
    assert cloud.summary == f"300 points with normals, no faces: a point cloud{has_color}"


def test_withheld_points_are_left_out(tmp_path: Path) -> None:
    cloud = cloud_of(las(tmp_path / "a.laz", 6, withheld=7, normals=False))
    np.testing.assert_allclose(cloud.points, _POINTS[7:], rtol=0, atol=0.5e-4 + 2e-9)
    assert cloud.normals is None
    assert cloud.summary.endswith("a point cloud; 7 withheld ones left out")
    with pytest.raises(FileFormatError, match="all of its points are withheld"):
        read_geometry(las(tmp_path / "b.las", withheld=300))


def test_a_scan_is_drawn_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, picture = las(tmp_path / "scan.laz", 7), tmp_path / "scan.png"
    command = ["render", str(path), "-o", str(picture), "--size", "32x24", "--spp", "1", "--quiet"]
    assert main(command) == 0
    assert "its point (500120, 5400320, 210) is the origin" in capsys.readouterr().out
    assert picture.exists()
    # Single precision leaves nothing of it where it is.
    assert main([*command, "--origin", "file"]) == 1
    assert "--origin center" in capsys.readouterr().err


def test_a_view_of_a_scan_says_where_it_was_moved(tmp_path: Path) -> None:
    from harnack.cli.arguments import parse
    from harnack.cli.sources import load_content

    path = las(tmp_path / "scan.las")
    arguments = parse(["render", str(path), "--quiet"])
    _, _, ((_, source),) = load_content("render", arguments, path)
    assert source == {"file": str(path.resolve()), "origin": [500_120.0, 5_400_320.0, 210.0]}


def with_bytes(data: bytes, offset: int, code: str, value: int) -> bytes:
    """The data with a number changed."""
    changed = bytearray(data)
    struct.pack_into(code, changed, offset, value)
    return bytes(changed)


@pytest.mark.parametrize(
    ("suffix", "change", "message"),
    [
        (".las", lambda data, begin: b"x" + data, "does not begin with 'LASF'"),
        (".las", lambda data, begin: data[:100], "ends within its header"),
        (".las", lambda data, begin: data[: begin - 1], "its points begin at byte"),
        (".las", lambda data, begin: data[:-1], "promises 300 points, .* room for 299: .*trunc"),
        (".las", lambda data, begin: with_bytes(data, 107, "<I", 2**32 - 1),
         "promises 4,294,967,295 points, but there is room for"),
        (".las", lambda data, begin: with_bytes(data, 100, "<I", 2**32 - 1),
         "declares 4,294,967,295 records, for which there is no room"),
        (".las", lambda data, begin: with_bytes(data, 107, "<I", 0), "it holds no points"),
        (".las", lambda data, begin: with_bytes(data, 104, "<B", 99), "no sound LAS file"),
        (".las", lambda data, begin: data[:131] + struct.pack("<d", np.nan) + data[139:],
         "coordinates must be finite: its scales or offsets are not"),
        (".laz", lambda data, begin: data[:-20], "its packed points"),
        (".laz", lambda data, begin: data[: begin + 50], "its packed points"),
        (".laz", lambda data, begin: with_bytes(data, 107, "<I", 2**32 - 1),
         "bytes when unpacked: at most"),
        (".laz", lambda data, begin: with_bytes(data, begin, "<q", begin - 9), "chunks is wrong"),
        (".laz", lambda data, begin: with_bytes(
            data, struct.unpack_from("<q", data, begin)[0] + 4, "<I", 2**31), "chunks is wrong"),
    ],
)  # fmt: skip
def test_damaged_las_files_are_refused_early(
    save: Any, tmp_path: Path, suffix: str, change: Any, message: str
) -> None:
    data = las(tmp_path / f"whole{suffix}", 3).read_bytes()
    (begin,) = struct.unpack_from("<I", data, 96)
    with pytest.raises(FileFormatError, match=message):
        read_geometry(save(f"a{suffix}", change(data, begin)))


def test_sizes_of_layers_reserve_no_memory(save: Any, tmp_path: Path) -> None:
    data = las(tmp_path / "whole.laz", 6, normals=False).read_bytes()
    (begin,) = struct.unpack_from("<I", data, 96)
    # Behind the position of the table, the first point of 30 bytes and the number of points.
    changed = with_bytes(data, begin + 8 + 30 + 4 + 8, "<I", 4_000_000_000)
    with pytest.raises(FileFormatError, match="its packed points"):
        read_geometry(save("a.laz", changed))


def test_packages_that_are_missing_are_named(save: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for module, name in (("laspy", "a.laz"), ("laspy", "a.las"), ("pye57", "a.e57")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'harnack\[scan\]'"):
            read_geometry(save(name, b"LASF"))


# .e57 files, in which pye57 writes coordinates in single precision.

_UNIT = _NORMALS.astype(np.float32).astype(np.float64)


def e57(path: Path, *scans: dict[str, Any]) -> Path:
    """An .e57 file of scans, given as the arguments of pye57's writer."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for scan in scans:
            file.write_scan_raw(**scan)
    return path


def axes(points: np.ndarray, **more: np.ndarray) -> dict[str, np.ndarray]:
    """Points as pye57 takes them."""
    return {f"cartesian{axis}": column for axis, column in zip("XYZ", points.T, strict=True)} | more


_TURN = np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])  # by 0.6 about z
_MATRIX = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1.0]])


def test_scans_of_an_e57_file_are_put_at_their_poses(tmp_path: Path) -> None:
    colors = np.zeros(300, np.uint8)
    first = {"data": axes(_UNIT, colorRed=colors, colorGreen=colors, colorBlue=colors),
             "rotation": _TURN, "translation": _MAP}  # fmt: skip
    states = np.array([0] * 290 + [1] * 6 + [2] * 4, np.int8)
    second = {"data": axes(_UNIT, cartesianInvalidState=states)}
    cloud = cloud_of(e57(tmp_path / "a.e57", first, second))
    expected = np.concatenate([_UNIT @ _MATRIX.T + _MAP, _UNIT[:290]])
    np.testing.assert_allclose(cloud.points, expected, rtol=0, atol=2e-9)
    assert cloud.summary == (
        "590 points without faces, and no normals read: a point cloud; of 2 scans at their poses; "
        "10 invalid ones left out; colors not used"
    )


def test_a_rotation_of_length_zero_is_none(tmp_path: Path) -> None:
    scan = {"data": axes(_UNIT), "rotation": np.zeros(4), "translation": np.array([1.0, 2, 3])}
    cloud = cloud_of(e57(tmp_path / "a.e57", scan))
    np.testing.assert_allclose(cloud.points, _UNIT + np.array([1, 2, 3]), atol=1e-12)
    assert "1 scans with a rotation of length 0, not turned" in cloud.summary


@pytest.mark.slow
def test_an_e57_file_is_drawn_with_estimated_normals(tmp_path: Path) -> None:
    path = e57(tmp_path / "a.e57", {"data": axes(_UNIT), "translation": _MAP})
    with pytest.raises(FileFormatError, match='normals="estimate"'):
        hk.io.field_from_file(path)
    opened = hk.io.field_from_file(path, normals="estimate", origin="auto")
    assert opened.origin == (500_123.0, 5_400_322.0, 213.0)
    hit = hk.trace(opened.field, _MAP[None] - opened.origin, [[1.0, 0, 0]], precision="double")
    assert abs(float(hit.t[0]) - 1.0) < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"x" + data, "does not begin with 'ASTM-E57'"),
        (lambda data: data[:40], "ends within its header"),
        (lambda data: data[:-1], "the file is truncated or damaged"),
        (lambda data: with_bytes(data, 24, "<Q", 2**60), "the file is truncated or damaged"),
        (lambda data: data[:1500] + b"\1" + data[1501:], "no sound E57 file .checksum"),
        (lambda data: data.replace(b"<?xml", b"<!DOC"), "no sound E57 file .checksum"),
        (lambda data: data.replace(b'<?xml vers', b"<!DOCTYPE "), "has a document type"),
    ],
)  # fmt: skip
def test_damaged_e57_files_are_refused(
    save: Any, tmp_path: Path, change: Any, message: str
) -> None:
    data = e57(tmp_path / "whole.e57", {"data": axes(_UNIT)}).read_bytes()
    with pytest.raises(FileFormatError, match=message):
        read_geometry(save("a.e57", change(data)))


def test_scans_with_too_many_points_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = e57(tmp_path / "a.e57", {"data": axes(_UNIT)}, {"data": axes(_UNIT)})
    monkeypatch.setattr(scans, "MAX_BYTES", 600 * 24 - 1)
    with pytest.raises(FileFormatError, match="its 600 points have 14,400 bytes when unpacked"):
        read_geometry(path)
