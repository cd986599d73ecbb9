"""Closed meshes as solids: rays through vertices and along edges, odd triangles, refusals."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.arithmetic import Jet
from harnack.backend import choose_backend, to_numpy
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.geometry import MeshError, example_meshes
from harnack.testing import check_field
from tests.fields.test_shapes import SPIKES
from tests.oracles.direct_sums import winding_sum
from tests.oracles.mesh_distance import signed_distance

CUBE = trimesh.creation.box((2.0, 2.0, 2.0))
# Two tetrahedra with all corners of a cube.
STAR = (
    np.array(
        [[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    )
    / 1.0,
    np.array(
        [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3], [4, 6, 5], [4, 5, 7], [5, 6, 7], [4, 7, 6]]
    ),
)
BUMPY = example_meshes.bumpy_sphere(3)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_places_in_line_with_vertices_and_edges(precision: Any) -> None:
    """The rays that decide on the sign pass through vertices and along edges."""
    rng, (vertices, faces) = np.random.default_rng(1), SPIKES
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    middles = vertices[edges].mean(axis=1)
    x = np.concatenate([*(vertices for _ in range(8)), *(middles for _ in range(8))])
    x[:, 2] = rng.uniform(-1.2, 1.2, len(x))
    found = hk.solid(SPIKES).value(x, precision=precision)
    assert np.abs(found - signed_distance(x, *SPIKES)).max() < (
        3e-6 if precision == "single" else 1e-14
    )
    # A cube has edges along z: on its faces and edges nothing is above rounding.
    corners = np.concatenate([CUBE.vertices, CUBE.triangles_center])
    for shift in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.25]):
        off = np.abs(
            hk.solid(CUBE).value(corners * 0.5 + shift, precision=precision)
            - signed_distance(corners * 0.5 + shift, CUBE.vertices, CUBE.faces)
        )
        assert off.max() < 1e-6


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_rays_to_vertices_and_edges_hit(precision: Any, shift: float) -> None:
    vertices, faces = SPIKES
    moved = vertices + shift
    solid = hk.solid((moved, faces))
    a, b = vertices[faces[:, 0]], vertices[faces[:, 1]]
    targets = np.concatenate([vertices, 0.5 * (a + b), 0.7 * a + 0.3 * b])
    o = 3.0 * targets / np.linalg.norm(targets, axis=1, keepdims=True)
    d = -o / 3.0
    hits = hk.trace(solid, o + shift, d, precision=precision)
    assert (np.array(hits.status) == int(hk.RayStatus.HIT)).all()
    at = o + np.array(hits.t)[:, None] * d
    blur = 3e-3 if precision == "single" and shift else 2e-4
    assert np.linalg.norm(at - targets, axis=1).max() < 3 * blur  # seen at a slant
    # Along an edge of the cube, just beside it on either side.
    cube = hk.solid((CUBE.vertices + shift, CUBE.faces))
    start = np.array([[1 - 0.01, 1 - 0.01, 5.0], [1 + 0.01, 1 + 0.01, 5.0]]) + shift
    status = hk.trace(cube, start, np.array([[0.0, 0.0, -1.0]] * 2), precision=precision).status
    assert np.array(status).tolist() == [int(hk.RayStatus.HIT), int(hk.RayStatus.MISS)]


def test_first_hits_are_those_of_the_winding_number() -> None:
    rng = np.random.default_rng(2)
    o = 3 * rng.normal(size=(300, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1, 1, o.shape) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    one = hk.trace(hk.solid(BUMPY), o, d, precision="double", tolerance=1e-7)
    two = hk.trace(hk.WindingNumber(*BUMPY), o, d, precision="double")
    both = np.isfinite(one.t) & np.isfinite(two.t)
    assert (np.isfinite(one.t) == np.isfinite(two.t)).mean() > 0.99
    assert np.median(np.abs(one.t[both] - two.t[both])) < 1e-6


def test_faces_without_area_join_others() -> None:
    """A vertex on an edge of the cube, tied to it by a triangle whose corners lie on a line."""
    faces = CUBE.faces.copy()
    a, b = faces[0, 0], faces[0, 1]
    c = faces[0, 2]
    middle = len(CUBE.vertices)
    vertices = np.concatenate([CUBE.vertices, [0.5 * (CUBE.vertices[a] + CUBE.vertices[b])]])
    split = [[a, middle, c], [middle, b, c], [a, b, middle]]
    solid = hk.solid((vertices, np.concatenate([faces[1:], split])))
    x = np.random.default_rng(3).uniform(-1.5, 1.5, (300, 3))
    expected = hk.solid(CUBE).value(x, precision="double")
    assert np.abs(solid.value(x, precision="double") - expected).max() < 1e-14


def test_faces_folded_onto_each_other() -> None:
    """A prism whose caps are fans of triangles that cover places once one way and twice the
    other: the sides of the boundary are not those of each face there."""
    loop = np.array([[0, 2], [4, 1], [3, 2], [1, 0], [4, 2]])
    vertices = np.concatenate([np.insert(loop, 2, z, axis=1) for z in (0, 4)]).astype(float)
    walls = [[[i, j, j + 5], [i, j + 5, i + 5]] for i, j in ((i, (i + 1) % 5) for i in range(5))]
    fan = np.array([[0, i, i + 1] for i in range(1, 4)])
    faces = np.concatenate([np.reshape(walls, (-1, 3)), fan[:, ::-1], fan + 5])
    solid = hk.solid((vertices, faces))
    x = np.random.default_rng(5).uniform((0, 0, -1), (4, 2, 5), (2000, 3))
    inside = winding_sum(vertices[faces])(x) > 0.5
    assert ((solid.value(x, precision="double") < 0) == inside).all()
    # A pentagon turned the same way all around: what its fan covers thrice counts once.
    loop = np.array([[0, 0], [4, 0], [1, 4], [2, 1], [-2, 2]])
    vertices = np.concatenate([np.insert(loop, 2, z, axis=1) for z in (0, 1)]).astype(float)
    around = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()
    assert hk.solid((vertices, faces)).surface.area == pytest.approx(15 + around, rel=1e-12)


def test_two_tetrahedra_whose_edges_cross() -> None:
    """The star in a cube: edges meet edges alone, at the centers of the cube's faces."""
    vertices, faces = STAR
    x = [[0.5, 0.5, 0.5], [0.5, 0.5, 0.75], [0.7, 0.6, 0.5], [0.5, 0.5, 1.25], [0.8, 0.5, 1.0]]
    expected = [-(0.125**0.5), -(0.125**0.5) / 2, -(0.02**0.5), 0.25, 0.3 / 3**0.5]
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for places, mesh in ((x, STAR), (x @ turn, (vertices @ turn, faces))):
        if np.linalg.det(turn) < 0 and mesh is not STAR:
            mesh = (mesh[0], faces[:, ::-1])
        found = hk.solid(mesh).value(places, precision="double")
        assert found == pytest.approx(expected, abs=1e-12)
        found = hk.signed_distance(hk.WindingNumber(*mesh), places, precision="double")
        assert found == pytest.approx(expected, abs=1e-12)


def test_parts_in_parts_and_cavities() -> None:
    inner = trimesh.creation.box((1.0, 1.0, 1.0))
    hollow = inner.copy()
    hollow.invert()
    x = np.random.default_rng(4).uniform(-1.2, 1.2, (200, 3))
    both, cavity = (
        hk.solid(trimesh.util.concatenate([CUBE, one])).value(x, precision="double")
        for one in (inner, hollow)
    )
    outer = hk.solid(CUBE).value(x, precision="double")
    assert np.abs(both - outer).max() < 1e-14  # the inner one is inside of the other
    off = np.maximum(outer, -hk.solid(inner).value(x, precision="double"))
    inside = off < 0
    assert (cavity < 0).tolist() == inside.tolist()
    assert np.abs(cavity - off)[inside].max() < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    "combine",
    [
        lambda one: one.blended(hk.Sphere(0.4, (0.8, 0.0, 0.0)), 0.2),
        lambda one: one.twisted(math.degrees(1.0)),
        lambda one: one.shell(0.1) - hk.Cylinder(0.2),
        lambda one: (one.offset(0.1) & hk.solid(hk.Gyroid(0.8), between=(-0.4, 0.4))).scaled(0.5),
        lambda one: one.rotated(30.0, "x").translated((100.0, -50.0, 20.0)),
    ],
)
def test_combinations_keep_their_promises(combine: Any) -> None:
    check_field(combine(hk.solid(SPIKES)), rng=1, count=25, directions=2)


def test_meshes_come_from_files_and_go_through_pickles(tmp_path: Any) -> None:
    path = tmp_path / "spikes.ply"
    trimesh.Trimesh(*SPIKES).export(path)
    solid = hk.solid(path)
    assert isinstance(solid, MeshSolid)
    assert solid.describe() == {"triangles": 20, "crosses itself": False}
    again = pickle.loads(pickle.dumps(solid))
    assert again.value([0.1, 0.2, 0.3]) == solid.value([0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    "solid", [hk.solid(CUBE), hk.Extrusion([(-1, -1), (1, -1), (1, 1), (-1, 1)], 2.0)]
)
def test_ranges_on_balls_hold_the_slopes_beside_corners(solid: Any) -> None:
    """At the middle of the ball one face is nearest, elsewhere in it others."""
    backend, middle, radius = choose_backend("double"), np.array([0.9, 0.7, 0.6]), 0.4
    coordinates = Jet.over_ball(backend.Array3f(*map(float, middle)), backend.Float(radius))
    slopes = solid.formula_on(backend)(*coordinates).first_derivatives
    x = middle + np.random.default_rng(5).uniform(-radius, radius, (200, 3))
    for slope, own in zip(slopes, solid.gradient(x, precision="double").T, strict=True):
        low, high = (to_numpy(backend.Float(one))[0] for one in (slope.lower, slope.upper))
        assert low <= own.min() + 1e-9
        assert own.max() - 1e-9 <= high


def open_box() -> Any:
    return CUBE.vertices, CUBE.faces[1:]


def turned() -> Any:
    faces = CUBE.faces.copy()
    faces[0] = faces[0, ::-1]
    return CUBE.vertices, faces


def half_turned() -> Any:
    other = CUBE.copy().apply_translation((5.0, 0.0, 0.0))
    other.invert()
    return trimesh.util.concatenate([CUBE, other])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (open_box, "not closed: 3 edges have one face alone.*harnack.repair"),
        (turned, "do not agree on their two sides.*fix_winding"),
        (lambda: (CUBE.vertices, CUBE.faces[:, ::-1]), "inside out.*mesh.invert"),
        (half_turned, "a part of the mesh is inside out"),
        (lambda: (np.where(CUBE.vertices > 0, np.nan, 0.0), CUBE.faces), "finite"),
        (lambda: (np.zeros((0, 3)), np.zeros((0, 3), int)), "no vertices"),
        (lambda: (CUBE.vertices, np.concatenate([CUBE.faces, CUBE.faces[:, ::-1]])), "canceled"),
        (lambda: (CUBE.vertices, CUBE.faces + 100), "out of range"),
    ],
)
def test_what_bounds_no_solid_is_refused(make: Any, words: str) -> None:
    with pytest.raises(MeshError, match=words):
        hk.solid(make())


def test_levels_are_for_fields() -> None:
    with pytest.raises(ValueError, match="a mesh is solid by itself"):
        hk.solid(CUBE, below=0.0)
    with pytest.raises(ValueError, match="thickness of a shell"):
        hk.solid(CUBE).shell(0.0)
