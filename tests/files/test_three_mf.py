"""Meshes written and read back in every format, and what is refused of .3mf files."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.files.file_geometry import FileFormatError
from harnack.files.geometry_files import LoadedMesh, read_geometry
from harnack.mesh_to_file import MESH_FILES, write_mesh


@pytest.mark.parametrize("kind", [k for k in MESH_FILES if not k.startswith(".usd")])
def test_what_is_written_is_read_closed_and_of_the_same_volume(kind: str, tmp_path: Path) -> None:
    ring = trimesh.creation.torus(8.0, 3.0, major_sections=24, minor_sections=12)
    path = tmp_path / f"ring{kind}"
    write_mesh(ring, path)
    found = hk.check_print(path)
    assert found.is_printable
    assert found.volume is not None
    assert math.isclose(found.volume, ring.volume, rel_tol=1e-6)
    # In a .glb file y is up.
    x, y, z = ring.extents
    assert np.allclose(found.size, (x, z, y) if kind == ".glb" else (x, y, z), rtol=1e-6)
    assert math.isclose(hk.mesh(hk.solid(path)).volume, ring.volume, rel_tol=1e-6)


def model(unit: str, items: str, vertices: str = "") -> str:
    corners = vertices or "".join(
        f'<vertex x="{x}" y="{y}" z="{z}"/>'
        for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    faces = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}"/>'
        for a, b, c in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
    )
    return (
        '<?xml version="1.0"?><model '
        f'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02" unit="{unit}">'
        f'<resources><object id="1" type="model"><mesh><vertices>{corners}</vertices>'
        f"<triangles>{faces}</triangles></mesh></object></resources><build>{items}</build></model>"
    )


def write(path: Path, text: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", text)
    return path


def test_units_become_millimeters_and_items_stand_where_they_are_put(tmp_path: Path) -> None:
    items = (
        '<item objectid="1"/><item objectid="1" transform="1 0 0 0 1 0 0 0 1 5 0 0"/>'
        '<item objectid="1" transform="-1 0 0 0 1 0 0 0 1 0 5 0"/>'
    )
    found = read_geometry(write(tmp_path / "a.3mf", model("inch", items)))
    assert isinstance(found, LoadedMesh)
    assert len(found.faces) == 12
    assert np.allclose(np.ptp(found.vertices, axis=0), 25.4 * np.array([7.0, 6.0, 1.0]))
    corner = found.vertices[found.faces]
    volumes = np.linalg.det(corner).sum() / 6
    assert math.isclose(volumes, 3 * 25.4**3 / 6, rel_tol=1e-9)  # a mirror image is turned


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (model("parsec", '<item objectid="1"/>'), "unit"),
        (model("inch", ""), "no sound 3MF"),
        (model("inch", '<item objectid="1"/>', '<vertex x="0" y="0" z="0"/>'), "range"),
        (model("inch", '<item objectid="1"/>').replace('x="1"', 'x="nan"'), "finite"),
        ("<model>", "no sound 3MF"),
    ],
)
def test_unsound_files_are_refused(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=why):
        read_geometry(write(tmp_path / "a.3mf", text))


def test_what_is_no_archive_or_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.3mf").write_text("no archive")
    with pytest.raises(FileFormatError, match="no zip archive"):
        read_geometry(tmp_path / "a.3mf")
    monkeypatch.setattr("harnack.files.three_mf.MAX_BYTES", 100)
    with pytest.raises(FileFormatError, match="unpacked"):
        read_geometry(write(tmp_path / "b.3mf", model("inch", '<item objectid="1"/>')))
