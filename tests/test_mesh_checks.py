"""What leaves `harnack.mesh` has been checked, and what cannot be done raises in time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.cli.mesh_files import write_mesh
from harnack.meshing.checks import (
    LocalError,
    MeshingError,
    TooLargeError,
    check_apart,
    check_inside,
    check_near_level,
)
from harnack.meshing.samples import LevelFunction

_BALL = trimesh.creation.icosphere(subdivisions=3)
_FACES = np.asarray(_BALL.faces, np.int64)


def test_a_limit_of_triangles_is_named():
    with pytest.raises(TooLargeError, match="max_triangles"):
        hk.mesh(hk.Sphere(1.0), max_triangles=1000)
    with pytest.raises(TooLargeError, match="max_triangles is 9,000"):
        hk.mesh(hk.Sphere(1.0), max_triangles=9000, tolerance=1e-5)
    with pytest.raises(ValueError, match="max_triangles must be positive"):
        hk.mesh(hk.Sphere(1.0), max_triangles=0)


def test_vertices_and_centres_are_looked_at():
    function = LevelFunction(hk.Sphere(1.0), 0.0)
    x = np.array(_BALL.vertices, np.float64)
    check_near_level(function, x, _FACES, 0.02, None)
    with pytest.raises(LocalError, match="farther than the tolerance"):
        check_near_level(function, x, _FACES, 1e-3, None)  # the centres are not so near
    x[7] *= 1.05
    with pytest.raises(LocalError, match="farther than the tolerance") as found:
        check_near_level(function, x, _FACES, 0.02, None)
    assert (np.linalg.norm(found.value.places - x[7], axis=1) == 0).any()
    check_inside(x, hk.Ball((0, 0, 0), 2.0), 0.0)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.Box((-1, -1, -1), (1, 1, 0.5)), 0.1)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.HalfSpace((1, 1, 1), 1.0), 0.1)
    check_inside(x, hk.Ball((0, 0, 0), 0.95), 0.1)
    with pytest.raises(MeshingError, match="outside of what was asked for"):
        check_inside(x, hk.Ball((0, 0, 0), 0.95), 0.01)


def test_faces_through_each_other_are_found():
    x = np.array(_BALL.vertices, np.float64)
    check_apart(x, _FACES)
    both = np.concatenate([x, x + np.array([0.3, 0.1, 0.2])])
    with pytest.raises(LocalError, match="pass through each other"):
        check_apart(both, np.concatenate([_FACES, _FACES + len(x)]))
    x[0, 0] = math.nan
    with pytest.raises(MeshingError, match="no numbers"):
        check_apart(x, _FACES)


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "glb"])
def test_edges_shorter_than_single_precision_do_not_open_a_file(tmp_path: Path, kind: str):
    # A vertex 5e-11 from another, in the middle of an edge's two faces, as booleans leave them.
    x = np.array(_BALL.vertices, np.float64)
    a, b = (int(v) for v in _BALL.edges_unique[0])
    beside = [f for f in range(len(_FACES)) if {a, b} <= set(_FACES[f].tolist())]
    new, rest = len(x), np.delete(_FACES, beside, axis=0)
    halves = [np.where(_FACES[f] == old, new, _FACES[f]) for f in beside for old in (a, b)]
    middle = x[a] + 5e-11 * (x[b] - x[a])
    made = trimesh.Trimesh(
        np.concatenate([x, [middle]]), np.concatenate([rest, halves]), process=False
    )
    assert made.is_watertight
    path = tmp_path / f"a.{kind}"
    write_mesh(made, path)
    read = trimesh.load(path, force="mesh")
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight
    assert len(read.faces) == len(_FACES)
    check_apart(np.array(read.vertices, np.float64), np.array(read.faces, np.int64))


def test_thin_parts_are_made_finer_until_no_faces_pass_through_each_other():
    made = hk.mesh(hk.Cylinder(0.01, 1.0), tolerance=4e-3)
    assert made.is_watertight
    check_apart(np.array(made.vertices), np.array(made.faces))
    x = np.array(made.triangles_center)
    assert (np.hypot(x[:, 0], x[:, 1]) <= 0.01 + 1e-9).all()


def test_sharp_creases_are_found_and_not_cut_into_ever_smaller_triangles():
    made = hk.mesh(hk.Cylinder(0.3, 1.0).moved((0.2, 0, 0)))
    assert made.is_watertight
    assert len(made.faces) < 10_000
    x = np.concatenate([made.vertices, made.triangles_center]) - (0.2, 0, 0)
    f = np.maximum(np.hypot(x[:, 0], x[:, 1]) - 0.3, np.abs(x[:, 2]) - 1)
    assert np.abs(f).max() < 2.1e-3
    assert abs(made.volume / (2 * math.pi * 0.09) - 1) < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("n", [300, 700])
def test_a_cloud_by_dipoles_is_right(n: int):
    points, index = trimesh.sample.sample_surface(_BALL, n, seed=n)
    normals = np.asarray(_BALL.face_normals)[index]
    field = hk.DipolePotential(points, normals, areas=np.full(n, _BALL.area / n), accuracy=8)
    made = hk.mesh(field, largest=True, tolerance=2e-3)
    assert made.is_watertight
    assert abs(made.volume / _BALL.volume - 1) < 0.03
    x = np.array(made.vertices)
    r = points - x[:, None]
    terms = (r * normals).sum(axis=2) / np.linalg.norm(r, axis=2) ** 3
    direct = terms.sum(axis=1) * _BALL.area / n
    assert np.abs(direct - field.default_level).max() < 1e-4 * 4 * math.pi
