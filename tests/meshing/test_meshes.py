"""Meshes: what is accepted, welding, duplicates that cancel, and the singular edges."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harnack.geometry import boundary_edges
from harnack.geometry.boundary_edges import net_faces, singular_edges, singular_loops, weld_vertices
from harnack.geometry.example_meshes import (
    bumpy_sphere,
    duplicate_faces,
    flip_faces,
    icosphere,
    remove_faces,
    torus_mesh,
)
from harnack.geometry.meshes import (
    MeshError,
    validate_mesh,
    without_zero_area_faces,
    zero_area_faces,
)

SQUARE = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
TWO = [[0, 1, 2], [0, 2, 3]]


def rotation(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


# --- what is accepted --------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.int32, np.uint8, np.uint64, np.int64])
def test_a_mesh_becomes_arrays_of_its_own(dtype):
    mine = np.array(SQUARE, dtype=np.float32), np.array(TWO, dtype=dtype)
    x, faces = validate_mesh(*mine)
    mine[0][:] = 7.0
    mine[1][:] = 0
    assert x.dtype == np.float64
    assert faces.dtype == np.int64
    assert x.tolist() == SQUARE
    assert faces.tolist() == TWO
    for array in (x, faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def replaced(row: int, value) -> list:
    return [*SQUARE[:row], value, *SQUARE[row + 1 :]]


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([], TWO, "there are no vertices"),
        (np.zeros((0, 3)), TWO, "there are no vertices"),
        (None, TWO, "the vertices are no array"),
        ("abc", TWO, "must be real numbers"),
        (np.array(SQUARE) * 1j, TWO, "must be real numbers, not complex128"),
        (np.array(SQUARE).T, TWO, r"shape \(n, 3\), not \(3, 4\); transpose"),
        (np.array(SQUARE)[:, :2], TWO, r"shape \(n, 3\), not \(4, 2\)"),
        (replaced(1, [0.0, 0]), TWO, "the vertices are ragged"),
        (replaced(2, [0, np.nan, 1]), TWO, r"vertex 2 is \(0, nan, 1\): .* finite"),
        ([*replaced(0, [np.inf] * 3)[:3], [np.nan] * 3], TWO, r"vertex 0 .*and 1 more"),
        (np.array(SQUARE) * 1e101, TWO, r"up to 1e\+101 are too large"),
        (np.array(SQUARE) * 1e-101, TWO, "face 0 .*only 1e-101 long: choose units"),
        (np.broadcast_to(0.0, (100_000_001, 3)), TWO, "vertices are too many"),
        (SQUARE, [], "there are no faces"),
        (SQUARE, np.zeros((0, 3), dtype=int), "there are no faces"),
        (SQUARE, None, "the faces are no array"),
        (SQUARE, [[0, 1, 2, 3]], "quadrilaterals, triangulate them"),
        (SQUARE, [[0, 1, 2], [0, 1, 2, 3]], "the faces are ragged.*triangulate"),
        (SQUARE, np.zeros((3, 5), dtype=int), r"shape \(m, 3\), not \(3, 5\): transpose"),
        (SQUARE, [0, 1, 2], r"shape \(m, 3\), not \(3,\)"),
        (SQUARE, [[0.0, 1.0, 2.0]], r"integer indices .* float64: convert them with .astype"),
        (SQUARE, [[True, False, True]], "integer indices of vertices, not bool"),
        (SQUARE, [[0, 1, 2], [1, 2, 4]], r"face 1 is \(1, 2, 4\), but vertex 4 is out of range"),
        (SQUARE, [[1, 2, 3], [1, 3, 4]], r"face 1 .*seem to count from 1: subtract 1"),
        (SQUARE, [[0, 1, 2], [0, -2, 3], [-1, 0, 1]], r"face 1 .*and 1 more.*vertex -2 is out"),
        (SQUARE, np.array([[0, 1, 2**64 - 1]], dtype=np.uint64), "vertex 1844674407370955161"),
        (SQUARE, [[0, 1, 2**70]], "the faces are no array of numbers"),
        (SQUARE, np.broadcast_to(0, (100_000_001, 3)), "faces are too many.*decimate"),
        (SQUARE, [[0, 1, 2], [2, 3, 2]], r"one face has zero area, first face 1 .*are equal"),
        ([*SQUARE, [0.5, 0.5, 0]], [[0, 2, 4], [0, 0, 0]],
         r"2 of 2 faces have zero area, first face 0 .*on a line; .*without_zero_area_faces\("),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 1, 0]], [[0, 2, 3]], "are equal"),
    ],
)  # fmt: skip
def test_each_bad_mesh_has_its_own_error(vertices, faces, message):
    with pytest.raises(MeshError, match=message) as caught:
        validate_mesh(vertices, faces)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("scale", [1e-90, 1e-30, 1.0, 1e30, 1e90])
@pytest.mark.parametrize("seed", range(3))
def test_zero_area_does_not_depend_on_scale_or_direction(scale, seed):
    rng = np.random.default_rng(seed)
    a, along, up = rng.normal(size=(3, 50, 3))
    s = rng.uniform(-2, 2, size=(50, 1))
    on_line = np.concatenate([a, a + along, a + s * along])
    faces = np.arange(150).reshape(3, 50).T
    # A point a + s along is off the line by the rounding of coordinates, at most about 3 units
    # in the last place of a; coordinates here and edges are alike in size.
    assert len(zero_area_faces(scale * (on_line - a.mean(axis=0)), faces)) > 40
    thin = on_line.copy()
    thin[100:] += 1e-12 * up
    assert len(zero_area_faces(scale * thin, faces)) == 0
    validate_mesh(scale * thin, faces)


def test_zero_area_of_exactly_collinear_vertices_anywhere():
    for offset in (0.0, 1e6, -3.0):
        x = offset + np.array([[0, 0, 0], [1, 2, 3], [2, 4, 6], [0, 0, 2.0**-20], [0, 0, 0]])
        assert zero_area_faces(x, [[0, 1, 2], [1, 0, 2], [0, 1, 3], [0, 4, 1]]).tolist() == [
            0,
            1,
            3,
        ]


def test_faces_without_area_can_be_removed():
    x = [*SQUARE, [0.5, 0.5, 0]]
    vertices, faces = without_zero_area_faces(x, [[0, 2, 4], *TWO, [1, 1, 2]])
    assert vertices.tolist() == x
    assert faces.tolist() == TWO
    validate_mesh(vertices, faces)
    with pytest.raises(MeshError, match="all 1 faces have zero area"):
        without_zero_area_faces(x, [[0, 2, 4]])
    with pytest.raises(MeshError, match="out of range"):
        without_zero_area_faces(x, [[0, 2, 7]])
    assert zero_area_faces(x, TWO).tolist() == []


# --- welding and duplicates --------------------------------------------------------------------


def plainly_welded(x: np.ndarray) -> np.ndarray:
    """By comparing every position with all before it; -0.0 equals 0.0."""
    return np.array([(x == row).all(axis=1).argmax() for row in x])


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40), kinds=st.integers(1, 3))
def test_welding_agrees_with_the_plain_one(seed, n, kinds):
    rng = np.random.default_rng(seed)
    x = rng.integers(0, kinds + 1, size=(n, 3)) * rng.choice([-0.1, 0.1, 1e300], size=(n, 3))
    np.testing.assert_array_equal(weld_vertices(x), plainly_welded(x))


def test_welding_survives_equal_hashes(monkeypatch):
    monkeypatch.setattr(boundary_edges, "_GOLDEN", np.uint64(0))  # every row then has the same hash
    x = np.random.default_rng(0).integers(0, 3, size=(100, 3)).astype(float)
    np.testing.assert_array_equal(weld_vertices(x), plainly_welded(x))


def naive_net(faces) -> Counter:
    """Signed count of each face, keyed by its corners in the cyclic order that starts lowest."""
    net: Counter = Counter()
    for face in faces:
        if len(set(face)) == 3:
            k = face.index(min(face))
            a, b, c = face[k:] + face[:k]
            net[(a, b, c)] += b < c
            net[(a, c, b)] -= b > c
    signed: Counter = Counter()
    for (a, b, c), count in net.items():
        signed[(a, min(b, c), max(b, c))] += count
    return Counter({k: v for k, v in signed.items() if v})


@given(seed=st.integers(0, 2**32 - 1), m=st.integers(1, 60), n=st.integers(3, 6))
def test_net_faces_and_singular_edges_agree_with_counting(seed, m, n):
    faces = np.random.default_rng(seed).integers(0, n, size=(m, 3))
    net, multiplicity, source = net_faces(faces)
    assert (multiplicity > 0).all()
    assert (np.diff(source) > 0).all()
    np.testing.assert_array_equal(net, faces[source])
    repeated = np.repeat(net, multiplicity, axis=0).tolist()
    assert naive_net(repeated) == naive_net(faces.tolist())
    assert len(net) == len(naive_net(faces.tolist()))
    edges, weights = singular_edges(net, multiplicity)
    assert (weights > 0).all()
    listed = Counter(map(tuple, np.repeat(edges, weights, axis=0).tolist()))
    assert listed == Counter(boundary_edges.boundary_edges(faces.tolist()))
    again, their_weights = singular_edges(faces)
    np.testing.assert_array_equal(edges, again)
    np.testing.assert_array_equal(weights, their_weights)
    loops = singular_loops(edges, weights)
    walked = [(a, b) for loop in loops for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    assert Counter(walked) == listed


def test_duplicates_add_and_turned_duplicates_cancel():
    faces = np.array([[0, 1, 2], [2, 3, 0], [1, 2, 0], [0, 3, 2], [4, 5, 6], [5, 4, 6], [6, 5, 4]])
    net, multiplicity, source = net_faces(faces)
    assert net.tolist() == [[0, 1, 2], [5, 4, 6]]  # (2 3 0) and (0 3 2) cancel
    assert multiplicity.tolist() == [2, 1]
    assert source.tolist() == [0, 5]


def test_nothing_remains_of_nothing():
    empty = np.zeros((0, 3), dtype=np.int64)
    for faces in (empty, np.array([[1, 1, 2]]), np.array([[0, 1, 2], [2, 1, 0]])):
        net, multiplicity, source = net_faces(faces)
        assert net.shape == (0, 3)
        assert multiplicity.shape == source.shape == (0,)
        edges, weights = singular_edges(net, multiplicity)
        assert edges.shape == (0, 2)
        assert weights.shape == (0,)
        assert singular_loops(edges, weights) == []


# --- singular edges: the claim of the module's docstring --------------------------------------


def solid_angle(x, faces, points) -> np.ndarray:
    """Sum over the faces of van Oosterom and Strackee's formula, at points (k, 3): (k,)."""
    a, b, c = (x[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    num = np.einsum("kij,kij->ki", a, np.cross(b, c))
    den = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return 2.0 * np.arctan2(num, den).sum(axis=1)


def damaged(kind: str, faces):
    if kind == "holes":
        return remove_faces(faces, 0.1, 0)
    if kind == "flips":
        return flip_faces(faces, 0.1, 0)
    if kind == "duplicates":
        return duplicate_faces(faces, 0.1, 0)
    return duplicate_faces(faces, 0.1, 0, flipped=True) if kind == "turned" else faces


@pytest.mark.parametrize("kind", ["whole", "holes", "flips", "duplicates", "turned"])
def test_modulo_four_pi_the_solid_angle_is_that_of_the_singular_loops(kind):
    x, faces = bumpy_sphere(3)
    faces = damaged(kind, faces)
    loops = singular_loops(*singular_edges(*net_faces(faces)[:2]))
    assert bool(loops) == (kind != "whole")
    points = np.random.default_rng(1).normal(size=(200, 3))
    total = solid_angle(x, faces, points)
    for loop in loops:
        fan = np.array([[loop[0], loop[k], loop[k + 1]] for k in range(1, len(loop) - 1)])
        total -= solid_angle(x, fan, points)
    np.testing.assert_allclose(np.abs(np.exp(0.5j * total) - 1.0), 0.0, atol=1e-10)


@pytest.mark.parametrize("kind", ["holes", "flips", "duplicates"])
def test_only_singular_edges_are_singular(kind):
    """Close to an edge, |grad| grows like weight / distance if it is singular, else it does not."""
    x, faces = bumpy_sphere(2)
    faces = damaged(kind, faces)
    edges, weights = singular_edges(faces)
    weight_of = {tuple(sorted(e)): w for e, w in zip(edges.tolist(), weights, strict=True)}
    ends = np.roll(faces, -1, axis=1)
    every = {(min(e), max(e)) for e in zip(faces.ravel(), ends.ravel(), strict=True)}
    assert set(weight_of) < every
    rho, h = 1e-4, 1e-7
    for a, b in sorted(every)[::7]:
        along = x[b] - x[a]
        across = np.cross(along, rotation(0)[0])
        middle = 0.5 * (x[a] + x[b]) + rho * across / np.linalg.norm(across)
        points = middle + h * np.concatenate([np.eye(3), -np.eye(3)])
        f = np.exp(0.5j * solid_angle(x, faces, points))
        gradient = 2.0 * np.angle(f[:3] / f[3:]) / (2.0 * h)
        expected = 2.0 * weight_of.get((a, b), 0) / rho  # Biot-Savart: 2 / distance a loop
        assert np.linalg.norm(gradient) == pytest.approx(expected, rel=0.01, abs=0.01 * 2.0 / rho)


# --- shapes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mesh", "volume", "count"),
    [
        (icosphere(0), 2.5361507, 20),
        (icosphere(4), 4.0 / 3.0 * np.pi, 5120),
        (bumpy_sphere(4), 4.2387, 5120),
        (torus_mesh(1.0, 0.4, 90, 40), 2.0 * np.pi**2 * 0.16, 7200),
    ],
)
def test_shapes_are_closed_and_face_outward(mesh, volume, count):
    x, faces = validate_mesh(*mesh)
    assert len(faces) == count
    assert len(singular_edges(faces)[0]) == 0
    assert np.linalg.det(x[faces]).sum() / 6.0 == pytest.approx(volume, rel=6e-3)
    assert len(np.unique(weld_vertices(x))) == len(x) == len(np.unique(faces))


def test_vertices_of_the_spheres():
    x, _ = icosphere(3)
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, rtol=1e-15)
    bumpy, faces = bumpy_sphere(3)
    assert len(faces) == 20 * 4**3
    r = 1.0 + 0.15 * np.sin(5 * x[:, 0]) * np.sin(5 * x[:, 1]) * np.sin(5 * x[:, 2])
    np.testing.assert_allclose(np.linalg.norm(bumpy, axis=1), r, rtol=1e-14)


def test_damage_is_of_the_size_asked_for_and_repeats():
    _, faces = icosphere(2)
    assert len(remove_faces(faces, 0.1, 3)) == 288
    assert (flip_faces(faces, 0.1, 3) != faces).any(axis=1).sum() == 32
    assert len(net_faces(flip_faces(faces, 0.1, 3)).faces) == 320
    assert sorted(net_faces(duplicate_faces(faces, 0.25, 3)).multiplicity)[-81:] == [1] + 80 * [2]
    assert len(net_faces(duplicate_faces(faces, 0.25, 3, flipped=True)).faces) == 240
    for make in (remove_faces, flip_faces, duplicate_faces):
        np.testing.assert_array_equal(make(faces, 0.1, 3), make(faces, 0.1, 3))
        assert not np.array_equal(make(faces, 0.1, 3), make(faces, 0.1, 4))
        np.testing.assert_array_equal(make(faces, 0.0, 3), faces)
        with pytest.raises(ValueError, match="between 0 and 1"):
            make(faces, 1.1, 3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: icosphere(-1), "0 to 10 subdivisions"),
        (lambda: icosphere(11), "0 to 10 subdivisions"),
        (lambda: torus_mesh(1.0, 0.4, 2, 9), "at least 3 segments"),
        (lambda: torus_mesh(1.0, 1.4, 9, 9), "0 < minor_radius < major_radius"),
    ],
)
def test_impossible_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
