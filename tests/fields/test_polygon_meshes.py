"""Meshes of nonplanar polygons, and tubes around their edges: first hits, boxes, errors."""

from __future__ import annotations

import itertools
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import Backend, choose_backend, to_numpy, to_vector3
from harnack.backend.validation import FloatArray
from harnack.fields.capabilities import NO_FACET
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.geometry.example_meshes import bumpy_sphere, icosphere
from harnack.geometry.meshes import MeshError
from harnack.geometry.polygon_meshes import cluster_into_polygons
from harnack.rendering import Camera
from harnack.testing import check_field
from harnack.tree.closest_triangles import NO_BOX, BoxTree
from tests.backend.test_kernels import compiled

PRECISIONS = ("single", "double")

SQUARE = np.array([(0.0, 0, 0), (1, 0, 0.2), (1, 1, 0), (0, 1, 0.2)])


def patches(count: int, subdivisions: int = 3) -> tuple[FloatArray, list[list[list[int]]]]:
    return cluster_into_polygons(*bumpy_sphere(subdivisions), count)


def hostile() -> hk.PolygonMesh:
    """Faces that cross, coil, have holes and loops apart, and are long and thin."""
    t = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    flower = np.column_stack([np.cos(t), np.sin(t), 0.3 * np.sin(3 * t)])
    coil = np.column_stack(
        [(1 + 0.3 * np.cos(t)) * np.cos(2 * t), (1 + 0.3 * np.cos(t)) * np.sin(2 * t), np.sin(t)]
    )
    hole = 0.4 * flower[::-1] + (0.1, 0, 0.05)
    apart = 0.3 * flower + (0, 0, 1.2)
    needle = np.array([(-1.5, 0.01, 0.4), (1.5, 0, 0.5), (1.5, 0.02, 0.4)])
    dent = np.array([(-1, -1, -0.8), (0.1, 0.1, -0.5), (1, -1, -0.8), (0, 1.2, -0.9)])
    loops = [flower, hole, coil, apart, needle, dent]
    start = np.cumsum([0, *map(len, loops)])
    index = [list(range(a, b)) for a, b in itertools.pairwise(start)]
    faces = [[index[0], index[1]], index[2], [index[3]], index[4], index[5]]
    return hk.PolygonMesh(np.concatenate(loops), faces)


def rays(n: int, seed: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rays from around towards a box, a quarter of them past given points, closely."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= (rng.uniform(0, 3, n) / np.linalg.norm(o, axis=1))[:, None]
    target = 0.6 * rng.normal(size=(n, 3))
    some = n // 4
    target[:some] = points[rng.integers(len(points), size=some)]
    target[:some] += 1e-3 * rng.normal(size=(some, 3))
    return o, target - o


def by_face(
    mesh: hk.PolygonMesh, o: FloatArray, d: FloatArray, **settings: Any
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """First hits of all faces, traced one by one without any box: t, face and normal."""
    t, face = np.full(len(o), np.inf), np.full(len(o), -1)
    normal = np.zeros((len(o), 3))
    for k in range(mesh.faces.face_count):
        field = mesh.face(k)
        field.extent = lambda levels: None  # type: ignore[method-assign]
        hits = hk.trace(field, o, d, t_max=8.0, **settings)
        assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
        nearer = hits.is_hit & (hits.t < t)
        t[nearer], face[nearer], normal[nearer] = hits.t[nearer], k, hits.normal[nearer]
    return t, face, normal


class OnePart(hk.Field):
    """One part of a field, as a field of its own."""

    def __init__(self, whole: hk.PolygonMesh | hk.solids.TubeNetwork, index: int) -> None:
        self.whole, self.index = whole, index
        self.period, self.default_level = whole.period, whole.default_level  # type: ignore[misc]
        lower, upper = (ends[index] for ends in whole.boxes())
        self.box = hk.Box(tuple(lower), tuple(upper))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        patches = self.whole.evaluator(backend, plan).patches
        assert patches is not None
        return patches.patch(dr.opaque(backend.UInt32, self.index))

    def extent(self, levels: tuple[float, ...]) -> hk.Box:
        return self.box


@pytest.mark.few(1)
@pytest.mark.parametrize("index", range(5))
def test_parts_keep_their_promises(index: int) -> None:
    check_field(OnePart(hostile(), index), count=60, directions=4)


@pytest.mark.slow
def test_segments_keep_their_promises() -> None:
    tubes = hk.solids.TubeNetwork(10 * SQUARE, [[0, 1], [1, 2], [0, 2]], [0.5, 0.1, 1e-3])
    for index in range(3):
        check_field(OnePart(tubes, index), count=60, directions=4)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_rays_enter_all_boxes_in_order(precision: Any) -> None:
    """Against all boxes one by one in double precision; those next to a ray may be more."""
    rng, backend = np.random.default_rng(8), choose_backend(precision)
    middle = rng.uniform(-0.9, 0.9, (300, 3))
    half = rng.uniform(0, 0.1, (300, 3)) * (rng.random((300, 3)) < 0.8)  # some are flat
    o, d = rng.uniform(-2, 2, (50, 3)), rng.normal(size=(50, 3))
    d[:9] = np.repeat(np.eye(3), 3, axis=0) * np.array([1, -1, 1])  # along axes
    d /= np.linalg.norm(d, axis=1)[:, None]
    tree = BoxTree.from_corners(backend, middle - half, middle + half)
    origin, direction = to_vector3(backend, o), to_vector3(backend, d)
    start, end = dr.full(backend.Float, 0.25, 50), dr.full(backend.Float, 2.0, 50)
    behind = dr.full(backend.Float, -1.0, 50), dr.full(backend.UInt32, NO_BOX, 50)
    entered: list[list[tuple[float, float, int]]] = [[] for _ in range(50)]
    for _ in range(301):
        near, far, box = tree.next_box(origin, direction, behind, start, end, True)
        dr.eval(near, far, box)
        behind = near, box
        for k, one in enumerate(zip(to_numpy(near), to_numpy(far), to_numpy(box), strict=True)):
            if one[2] != NO_BOX:
                entered[k].append(one)
    for k in range(50):
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (middle - half - o[k]) / d[k], (middle + half - o[k]) / d[k]
        low, high = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
        meets = (low <= high) & (high >= 0.25) & (low <= 2.0)
        order = [(near, box) for near, _, box in entered[k]]
        assert order == sorted(set(order))
        found = {box: (near, far) for near, far, box in entered[k]}
        assert len(found) == len(entered[k])
        assert set(np.flatnonzero(meets)) <= set(found)
        for box in np.flatnonzero(meets):
            assert found[box][0] <= max(low[box], 0.25)
            assert found[box][1] >= high[box]
        slack = 1e-4 if precision == "single" else 1e-12
        wide = (low <= high + slack) & (high >= 0.25 - slack) & (low <= 2.0 + slack)
        assert set(found) <= set(np.flatnonzero(wide | np.isnan(low) | np.isnan(high)))


def assert_same_hits(mesh: hk.PolygonMesh, n: int, precision: Any, **settings: Any) -> None:
    """Hits of the mesh and of its faces one by one are the same, up to the tolerance: beside an
    edge, within which every face has a hit, one face may come before another."""
    o, d = rays(n, 1, mesh.vertices)
    settings = {"tolerance": 1e-5, "precision": precision, **settings}
    hits = hk.trace(mesh, o, d, t_max=8.0, **settings)
    t, face, normal = by_face(mesh, o, d, **settings)
    # Rays that the one hits and the other does not pass an edge within the tolerance.
    assert (hits.is_hit != np.isfinite(t)).sum() <= n / 1000
    both = hits.is_hit & np.isfinite(t)
    assert both.sum() > n / 10
    same = both & (hits.primitive_index == face)
    assert same.sum() >= 0.995 * both.sum()
    off = np.abs(hits.t[same] - t[same])
    assert (off > 2e-3).sum() <= n / 1000  # grazing
    turned = np.einsum("ij,ij->i", hits.normal, normal) < 0.9
    assert (turned & same).sum() <= 0.005 * n
    assert (hits.primitive_index[~hits.is_hit] == -1).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_first_hits_are_those_of_the_faces_one_by_one(precision: Any) -> None:
    assert_same_hits(hk.PolygonMesh(*patches(24)), 400, precision)
    assert_same_hits(hostile(), 400, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("level", [2 * np.pi, 4.0])
def test_first_hits_of_many_faces(precision: Any, level: float) -> None:
    assert_same_hits(hk.PolygonMesh(*patches(300, 4)), 2000, precision, level=level)
    assert_same_hits(hostile(), 2000, precision, level=level)


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("level", [2 * np.pi, 5.5])
def test_rays_along_edges_and_through_vertices(precision: Any, level: float) -> None:
    """What the faces one by one say is hit is hit, up to rays that an edge passes within the
    tolerance, where both are right."""
    settings: dict[str, Any] = {"level": level, "precision": precision, "tolerance": 1e-4}
    rng = np.random.default_rng(9)
    for mesh in (hostile(), hk.PolygonMesh(*patches(24))):
        n, x = 400, mesh.vertices
        a, b = (x[ends] for ends in mesh.edges[rng.integers(len(mesh.edges), size=n)].T)
        back = a - (b - a) * rng.uniform(1, 30, (n, 1))
        o = 2 * rng.normal(size=(n, 3))
        ways = (
            (back, b - a),
            (back + 1e-4 * rng.normal(size=(n, 3)), b - a),
            (o, a - o),
            (o, a + rng.uniform(0, 1, (n, 1)) * (b - a) - o),
            (a, rng.normal(size=(n, 3))),
            (np.round(o, 1), np.eye(3)[rng.integers(3, size=n)] * np.sign(o[:, :1])),
        )
        for o, d in ways:
            hits = hk.trace(mesh, o, d, t_max=8.0, **settings)
            t, _, _ = by_face(mesh, o, d, **settings)
            assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
            found = np.where(hits.is_hit, hits.t, np.inf)
            with np.errstate(invalid="ignore"):
                apart = (found != t) & ~(np.abs(found - t) < 1e-2)
            assert apart.sum() <= 6


@pytest.mark.few(2)
@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 300.0)])
def test_hits_move_with_the_mesh(scale: float, shift: float) -> None:
    vertices, faces = patches(24)
    o, d = rays(500, 2, vertices)
    plain = hk.trace(hk.PolygonMesh(vertices, faces), o, d, tolerance=1e-4)
    mesh = hk.PolygonMesh(scale * vertices + shift, faces)
    moved = hk.trace(mesh, scale * o + shift, d, tolerance=1e-4 * scale)
    assert (moved.is_hit != plain.is_hit).sum() <= 2
    both = moved.is_hit & plain.is_hit & (moved.primitive_index == plain.primitive_index)
    assert both.sum() >= 0.98 * plain.is_hit.sum()
    np.testing.assert_allclose(moved.t[both] / scale, plain.t[both], atol=2e-2)
    assert np.median(np.abs(moved.t[both] / scale - plain.t[both])) < 2e-4


@pytest.mark.slow
def test_rays_start_and_end_anywhere() -> None:
    mesh = hk.PolygonMesh(*patches(24))
    o, d = rays(500, 3, mesh.vertices)
    hits = hk.trace(mesh, o, d)
    reached = hits.is_hit & (hits.t > 0.05)
    before = hk.trace(mesh, o[reached], d[reached], t_max=hits.t[reached] - 0.01)
    assert not before.is_hit.any()
    again = hk.trace(mesh, o[reached], d[reached], t_min=hits.t[reached] - 0.01)
    # By another way, and on grazing rays, another point within the tolerance.
    np.testing.assert_allclose(again.t, hits.t[reached], atol=2e-3)
    assert np.median(np.abs(again.t - hits.t[reached])) < 1e-4
    assert (again.primitive_index == hits.primitive_index[reached]).mean() > 0.99


def test_out_of_steps_is_no_miss() -> None:
    mesh = hk.PolygonMesh(*patches(24))
    o, d = rays(200, 4, mesh.vertices)
    hits, few = hk.trace(mesh, o, d), hk.trace(mesh, o, d, max_steps=3)
    lost = few.status == hk.RayStatus.OUT_OF_STEPS
    assert lost.any()
    assert (few.primitive_index[lost] == -1).all()
    assert (few.t[lost] <= hits.t[lost] + 1e-3).all()
    assert (few.is_hit <= hits.is_hit).all()
    assert (few.evaluations <= 3).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_face_in_a_lane_is_the_solid_angle_of_that_face(precision: Any) -> None:
    mesh, backend = hostile(), choose_backend(precision)
    rng = np.random.default_rng(5)
    p = rng.uniform(-1.5, 1.5, (600, 3))
    index = np.arange(600) % mesh.faces.face_count
    patches = mesh.evaluator(backend).patches
    assert patches is not None
    part = patches.patch(backend.UInt32(index.astype(np.uint32)))
    sample = part.evaluate(to_vector3(backend, p))
    tolerance = 2e-4 if precision == "single" else 1e-11
    for k in range(mesh.faces.face_count):
        here, face = index == k, mesh.face(k)
        value = to_numpy(sample.value)[here] - face.value(p[here], precision=precision)
        turns = value / (4 * np.pi)
        np.testing.assert_allclose(turns, np.round(turns), atol=tolerance)
        gradient = face.gradient(p[here], precision=precision)
        size = 1 + np.abs(gradient).max()
        np.testing.assert_allclose(to_numpy(sample.gradient)[here], gradient, atol=tolerance * size)
        alone = face.evaluator(backend).evaluate(to_vector3(backend, p[here]))
        for one, mine in zip(alone.promises, sample.promises, strict=True):
            assert isinstance(one, hk.proofs.TaylorRemainder)
            assert isinstance(mine, hk.proofs.TaylorRemainder)
            for ours, its in ((mine.radius, one.radius), (mine.constant, one.constant)):
                np.testing.assert_allclose(
                    to_numpy(ours)[here], to_numpy(its), rtol=1e-3, atol=1e-5
                )


@pytest.mark.few(1)
@pytest.mark.parametrize("level", [2 * np.pi, 5.0])
def test_boxes_hold_the_surfaces(level: float) -> None:
    for mesh in (hostile(), hk.PolygonMesh(*patches(12))):
        lower, upper = mesh.boxes((level,))
        for k in range(mesh.faces.face_count):
            face = mesh.face(k)
            face.extent = lambda levels: None  # type: ignore[method-assign]
            middle = np.concatenate(mesh.faces.loops(k)).mean(axis=0)
            rng = np.random.default_rng(k)
            o = middle + 3 * rng.normal(size=(1000, 3))
            d = middle + 0.3 * rng.normal(size=(1000, 3)) - o
            hits = hk.trace(
                face, o, d, level=level, t_max=20.0, precision="double", require_crossing=True
            )
            seen = hits.position[hits.is_hit]
            assert len(seen)
            assert (seen >= lower[k] - 1e-6).all()
            assert (seen <= upper[k] + 1e-6).all()


def test_boxes_of_convex_faces_are_those_of_their_vertices() -> None:
    mesh = hk.PolygonMesh(SQUARE, [[0, 1, 2, 3]])
    lower, upper = mesh.boxes()
    np.testing.assert_allclose(lower[0], SQUARE.min(axis=0), atol=1e-3)
    np.testing.assert_allclose(upper[0], SQUARE.max(axis=0), atol=1e-3)
    assert mesh.faces.in_convex_position.tolist() == [True]
    dented = np.array([(0.0, 0, 0), (1, 0, 0), (0.2, 0.2, 0.2), (0, 1, 0), (0, 0, 1)])
    assert hk.PolygonMesh(dented, [[0, 1, 2, 3, 4]]).faces.in_convex_position.tolist() == [False]
    twice = np.array([(np.cos(t), np.sin(t), 0.1 * t) for t in np.arange(10) * 0.4 * np.pi])
    assert hk.PolygonMesh(twice, [list(range(10))]).faces.in_convex_position.tolist() == [False]


@pytest.mark.slow
def test_another_mesh_compiles_no_kernel() -> None:
    o, d = rays(300, 6, SQUARE)

    def trace(k: int) -> int:
        vertices, faces = patches(20 + 7 * k)
        mesh = hk.PolygonMesh((1 + 0.1 * k) * vertices + k, faces)
        settings = {"level": 6.0 - 0.1 * k, "tolerance": 1e-4 * (1 + k)}
        return compiled(lambda: hk.trace(mesh, o, d, **settings), size=300)

    trace(0), trace(1)
    assert [trace(k) for k in range(2, 6)] == [0] * 4


@pytest.mark.slow
def test_derivatives_by_rays() -> None:
    mesh, backend = hk.PolygonMesh(SQUARE, [[0, 1, 2, 3]]), choose_backend("double")
    o = backend.Array3f(0.4, 0.45, 2.0)
    dr.enable_grad(o)
    hits = hk.trace(mesh, o, backend.Array3f(0.05, 0, -1))
    dr.backward(hits.t)
    found = to_numpy(dr.grad(o)).ravel()
    normal = to_numpy(hits.normal).ravel()
    d = np.array([0.05, 0, -1]) / np.linalg.norm([0.05, 0, -1])
    np.testing.assert_allclose(found, -normal / (normal @ d), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("show", ["shaded", pytest.param("path", marks=pytest.mark.slow)])
def test_pictures(show: str) -> None:
    vertices, faces = patches(24)
    mesh = hk.PolygonMesh(vertices, faces)
    tubes = hk.solids.TubeNetwork(mesh.vertices, mesh.edges, 0.02)
    settings: dict[str, Any] = {"show": show, "size": (64, 48), "spp": 4, "camera": Camera()}
    alone = hk.render(mesh, **settings)
    both = hk.render([mesh, tubes], material=["eggshell", "gold"], **settings)
    assert np.isfinite(alone).all()
    assert alone.std() > 0.02
    assert np.abs(alone - both).mean() > 0.005


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (SQUARE, [], "there are no faces"),
        (SQUARE, "0123", "must be a list of lists"),
        (SQUARE, [[]], "face 0 is empty"),
        (SQUARE, [[0, 1, 2], [0, 1]], "face 1 has a loop of 2 vertices: a face needs three"),
        (SQUARE, [[0, 1, 2, 4]], "face 0 has vertex 4, which is out of range: there are 4 vert"),
        (SQUARE, [[1, 2, 3, 4]], "seem to count from 1"),
        (SQUARE, [[0, 1, 2, -1]], "vertex -1"),
        (SQUARE, [[0, 1, 2, 1]], "face 0 visits vertex 1 twice"),
        (SQUARE, [[0.0, 1.0, 2.0]], r"integer indices, not float64: convert them"),
        (SQUARE, [[0, 1, 2], 3], "face 1 is 3: it must be a list"),
        (SQUARE, [[0, [1, 2, 3]]], "face 0 mixes indices and loops"),
        (SQUARE, [[[0, 1, 2], [2, 1, 3]]], "face 0 runs along the edge from vertex . to . twice"),
        ([], [[0, 1, 2]], "there are no vertices"),
        ([[0, 1], [1, 0]], [[0, 1, 2]], r"shape \(n, 3\)"),
        (np.where(SQUARE == 0.2, np.nan, SQUARE), [[0, 1, 2]], r"vertex 1 is \(1, 0, nan\)"),
        (np.zeros((3, 3)), [[0, 1, 2]], "an edge without a length"),
        ([(0, 0, 0), (1, 1, 1), (3, 3, 3)], [[0, 1, 2]], "face 0 lie on a line"),
        ([(7, 0, 1e-8), (1e6, 1, 0), (3e6, 3, 0), (2e6, 2, 0)], [[0, 1, 2, 3]], "on a line"),
    ],
)
def test_bad_meshes_are_refused(vertices: Any, faces: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        hk.PolygonMesh(vertices, faces)


def test_what_a_polygon_mesh_is_not() -> None:
    mesh = hk.PolygonMesh(SQUARE, [[0, 1, 2, 3]])
    o, d = np.array([[0, 0, 3.0]]), np.array([[0, 0, -1.0]])
    with pytest.raises(TypeError, match=r"ask a face, such as mesh.face\(0\)"):
        mesh.value([[0, 0, 0]])
    with pytest.raises(TypeError, match="no level set of one function"):
        hk.signed_distance(mesh, [[0, 0, 1.0]])
    with pytest.raises(NotImplementedError, match="crossings takes one function"):
        hk.crossings(mesh, o, d, max_crossings=2)
    with pytest.raises(NotImplementedError, match="require_crossing takes one function"):
        hk.trace(mesh, o, d, require_crossing=True)
    with pytest.raises(ValueError, match="multiple of 4 pi"):
        hk.trace(mesh, o, d, level=0.0)
    with pytest.raises(IndexError, match="there is no face 1"):
        mesh.face(1)
    with pytest.raises(ValueError, match="one function"):
        hk.render(mesh, size=(16, 12), show="shaded", antialias="cones")


@pytest.mark.parametrize("precision", PRECISIONS)
def test_tubes_are_the_union_of_tubes(precision: Any) -> None:
    vertices, faces = icosphere(0)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])), axis=0)
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    radius = np.linspace(0.02, 0.1, len(edges))
    o, d = rays(400, 7, vertices)
    hits = hk.trace(
        hk.solids.TubeNetwork(vertices, edges, radius), o, d, level=0.01, precision=precision
    )
    t, which = np.full(len(o), np.inf), np.full(len(o), -1)
    for k, (pair, r) in enumerate(zip(edges, radius, strict=True)):
        one = hk.trace(hk.Tube(vertices[pair], r), o, d, level=0.01, precision=precision)
        nearer = one.is_hit & (one.t < t)
        t[nearer], which[nearer] = one.t[nearer], k
    assert (hits.is_hit == np.isfinite(t)).mean() > 0.995
    both = hits.is_hit & np.isfinite(t) & (hits.primitive_index == which)
    assert both.sum() > 0.98 * hits.is_hit.sum() > 100
    assert np.median(np.abs(hits.t[both] - t[both])) < 1e-4
    assert NO_FACET == 2**32 - 1


@pytest.mark.parametrize(
    ("points", "segments", "radius", "message"),
    [
        (SQUARE, [[0, 1, 2]], 0.1, r"shape \(m, 2\)"),
        (SQUARE, [[0.0, 1.0]], 0.1, "integer indices"),
        (SQUARE, [[0, 4]], 0.1, "segment 0 joins points 0 and 4: there are 4 points"),
        (SQUARE, [[1, 1]], 0.1, "segment 0 has no length"),
        (SQUARE, [[0, 1]], 0.0, "must be positive"),
        (SQUARE, [[0, 1]], [0.1, 0.1], "is a number or has shape"),
        (SQUARE, [[0, 1]], [np.nan], "finite"),
        (SQUARE * np.nan, [[0, 1]], 0.1, "point 0 of tubes"),
    ],
)
def test_bad_tubes_are_refused(points: Any, segments: Any, radius: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hk.solids.TubeNetwork(points, segments, radius)


def test_patches_cover_a_mesh_once() -> None:
    vertices, faces = bumpy_sphere(3)
    points, polygons = cluster_into_polygons(vertices, faces, 30)
    mesh = hk.PolygonMesh(points, polygons)
    assert 20 <= mesh.faces.face_count <= 30
    # Each edge is run once each way: what is left of the solid angles of a closed mesh is none.
    runs = np.column_stack([mesh.faces.corners, mesh.faces.corners[mesh.faces.next_corner]])
    assert {tuple(run) for run in runs} == {tuple(run[::-1]) for run in runs}
    total = sum(mesh.face(k).value([(0.1, 0, 0)], precision="double") for k in range(30))
    turns = float(np.asarray(total).ravel()[0]) / (4 * math.pi)
    assert abs(turns - round(turns)) < 1e-9
