"""Parts of winding numbers, clouds and blobs that are thinner than cells: found, or told of."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.meshing.lost_parts import _are_farther
from harnack.meshing.meshing_errors import EmptySurfaceError
from tests.meshing.test_sign_isosurface import sphere_points

LOST = "not quite the level of this"
TURN = np.linalg.qr([[7.0, 7, -3], [3, -16, -7], [19, 7, -13]])[0]


def boxes(*sizes_and_middles: tuple[tuple[float, ...], tuple[float, ...]]) -> hk.WindingNumber:
    """The winding number of boxes of some sizes around some middles, all turned together."""
    parts = [trimesh.creation.box(size) for size, _ in sizes_and_middles]
    for part, (_, middle) in zip(parts, sizes_and_middles, strict=True):
        part.apply_translation(middle)
    whole = trimesh.util.concatenate(parts)
    return hk.WindingNumber(whole.vertices @ TURN.T, whole.faces)


def meshed(field: hk.Field, **options: Any) -> tuple[trimesh.Trimesh, str]:
    """A mesh, and what is warned of."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = hk.mesh(field, **options)
    return made, "\n".join(str(one.message) for one in told)


# A cube of volume 8 with a fin of 0.02 x 1.6 x 1.1 outside of it.
FIN = boxes(((2, 2, 2), (0, 0, 0)), ((0.02, 1.6, 1.2), (0.13, 0, 1.5)))


def test_a_lost_fin_is_told_of() -> None:
    mesh, warned = meshed(FIN, cell_size=0.2, tolerance=1.5e-2)
    assert mesh.volume == pytest.approx(8, rel=5e-3)  # the fin has 0.0352
    assert LOST in warned
    assert "thinner than these are missing" in warned
    assert "about 0.02" in warned
    assert "gaps" not in warned
    facts = mesh.metadata["harnack"]
    # Of the area, 24 and 3.6, that is the fin's.
    assert facts["lost"] / facts["sought"] == pytest.approx(3.6 / 27.6, abs=0.03)
    place = (
        np.array([float(x) for x in warned.split("as near (")[1].split(")")[0].split(",")]) @ TURN
    )
    assert abs(place[0] - 0.13) <= 0.0101
    assert 1 < place[2] <= 2.1


@pytest.mark.slow
def test_a_fin_as_thick_as_cells_is_made() -> None:
    thick = boxes(((2, 2, 2), (0, 0, 0)), ((0.3, 1.6, 1.2), (0.13, 0, 1.5)))
    mesh, warned = meshed(thick, cell_size=0.2, tolerance=1.5e-2)
    assert LOST not in warned
    assert mesh.volume == pytest.approx(8 + 0.3 * 1.6 * 1.1, rel=2e-3)


@pytest.mark.slow
def test_a_gap_is_told_of() -> None:
    apart = boxes(((2, 2, 1), (0, 0, 0.505)), ((2, 2, 1), (0, 0, -0.505)))
    mesh, warned = meshed(apart, cell_size=0.2, tolerance=6e-3)
    assert max(part.volume for part in mesh.split()) > 7.5
    assert "narrower than these are filled" in warned
    assert "about 0.01" in warned


@pytest.mark.slow
def test_a_thin_plate() -> None:
    """Six triangles of a corner were all of it, and nothing was said."""
    mesh, warned = meshed(boxes(((10, 10, 0.005), (0, 0, 0))))
    assert abs(mesh.volume) < 0.1  # of 0.5
    assert mesh.metadata["harnack"]["lost"] > 2000
    assert "repairing the mesh keeps thin parts" in warned
    with pytest.raises(EmptySurfaceError, match=r"of 2,012 points .* are missing, as near"):
        hk.mesh(boxes(((10, 10, 1e-6), (0, 0, 0))))
    sought = boxes(((1, 1, 0.05), (0, 0, 0)))
    mesh, warned = meshed(sought, tolerance=1e-2, cell_size=0.04)
    assert LOST not in warned
    assert mesh.volume == pytest.approx(0.05, rel=0.02)


@pytest.mark.slow
def test_what_is_lost_elsewhere_does_not_count() -> None:
    """The clip holds the cube alone, and half of it."""
    below = hk.HalfSpace(tuple(TURN[:, 2]), 0.0)
    options: dict[str, Any] = {"cell_size": 0.2, "tolerance": 1.5e-2, "level": 0.5, "side": "above"}
    mesh, warned = meshed(FIN, section=below, **options)
    assert LOST not in warned
    assert mesh.volume == pytest.approx(4, rel=5e-3)
    assert LOST in meshed(FIN, **options)[1]
    assert LOST in meshed(hk.Surface(FIN, 0.9), cell_size=0.2, tolerance=1.5e-2)[1]


def test_islands_of_blobs_and_sheets_of_clouds() -> None:
    near = hk.Blobs([[0.0, 0, 0], [3.13, 0.13, 0.11]], [1.0, 0.06], [4.0, 4.0])
    assert LOST in meshed(near, cell_size=0.4, tolerance=5e-2)[1]
    points, normals = sphere_points(1000)
    plate = np.concatenate([points * [1, 1, 1], points * [0.3, 0.3, 0.02] + [1.5, 0.1, 0.1]])
    across = normals / [0.3, 0.3, 0.02]
    across /= np.linalg.norm(across, axis=1)[:, None]
    cloud = hk.DipolePotential(plate, np.concatenate([normals, across]))
    mesh, warned = meshed(cloud, cell_size=0.25, tolerance=5e-2)
    assert mesh.volume < 4 * math.pi / 3
    assert LOST in warned
    whole, warned = meshed(hk.DipolePotential(points, normals), cell_size=0.12, tolerance=5e-2)
    assert not warned
    assert whole.volume == pytest.approx(4 * math.pi / 3, rel=0.01)


def test_distances_from_triangles_of_all_sizes() -> None:
    rng = np.random.default_rng(0)
    corner = rng.uniform(size=(60, 1, 3)) + 10 ** rng.uniform(-3, 0, (60, 1, 1)) * rng.normal(
        size=(60, 3, 3)
    )
    points = rng.uniform(-0.5, 1.5, (40, 3))
    spread = rng.dirichlet((1, 1, 1), 500)
    dense = np.einsum("kc,mcx->mkx", spread, corner).reshape(-1, 3)
    nearest = np.array([np.linalg.norm(dense - x, axis=1).min() for x in points])
    for distance in (0.03, 0.1, 0.3):
        sure = np.abs(nearest - distance) > 0.05 * (1 + nearest)
        is_far = _are_farther(points, corner, distance)
        assert (is_far == (nearest > distance))[sure].all()
