"""Winding numbers of meshes: values, derivatives, bounds and first hits, against direct sums."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import HarmonicBall
from harnack.fields.solid_angles import winding_rates
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.fmm.trail_sums import TrailValues, closed_trails
from harnack.geometry import MeshError
from harnack.geometry.example_meshes import (
    bumpy_sphere,
    duplicate_faces,
    flip_faces,
    icosphere,
    remove_faces,
    torus_mesh,
)
from tests.oracles.jump_oracle import first_side_changes, judge
from tests.oracles.mesh_rays import mesh_rays

FOUR_PI = 4 * math.pi
METHODS = ["exact", "tree"]
PRECISIONS = ["single", "double"]
Mesh = tuple[np.ndarray, np.ndarray]


# --- the truth ------------------------------------------------------------------------------


def direct_sum(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The solid angles of triangles (m, 3, 3) added up at points (n, 3), over 4 pi."""
    total, chunk = np.zeros(len(points)), max(1, 400_000 // len(triangles))
    for i in range(0, len(points), chunk):
        a, b, c = np.moveaxis(triangles[None] - points[i : i + chunk, None, None], 2, 0)
        la, lb, lc = (np.sqrt(np.einsum("...k,...k", v, v)) for v in (a, b, c))
        re = la * lb * lc
        for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb)):
            re += np.einsum("...k,...k", u, v) * w
        im = np.einsum("...k,...k", a, np.cross(b - a, c - a))
        total[i : i + chunk] = 2 * np.arctan2(im, re).sum(axis=1)
    return total / FOUR_PI


def summed_on_device(triangles: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The same, as one loop over the triangles for all points at once; also in double precision."""
    backend = choose_backend("double")
    real, vector = backend.Float, backend.Array3f
    buffer, count = real(triangles.ravel()), dr.opaque(backend.UInt32, len(triangles))

    def value(points: np.ndarray) -> np.ndarray:
        x = vector(np.ascontiguousarray(points.T))

        def step(i: Any, total: Any) -> Any:
            row = [dr.gather(real, buffer, 9 * i + k) for k in range(9)]
            a, b, c = (vector(*row[k : k + 3]) - x for k in (0, 3, 6))
            la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
            re = la * lb * lc + dr.dot(a, b) * lc + dr.dot(b, c) * la + dr.dot(c, a) * lb
            return i + 1, total + dr.atan2(dr.dot(a, dr.cross(b - a, c - a)), re)

        start = (backend.UInt32(0), dr.zeros(real, len(points)))
        total = dr.while_loop(start, lambda i, _: i < count, step)[1]
        return to_numpy(total) * (2 / FOUR_PI)

    return value


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rounded(v: np.ndarray) -> np.ndarray:
    """To single precision, so that both precisions are asked about the same."""
    return v.astype(np.float32).astype(np.float64)


def damaged_sphere(subdivisions: int) -> Mesh:
    vertices, faces = bumpy_sphere(subdivisions)
    return vertices, remove_faces(faces, 0.1, seed=0)


def places(mesh: Mesh, n: int, closest: float = 1e-3, seed: int = 0) -> np.ndarray:
    """Points in and around a mesh; a half of them close to its faces."""
    vertices, faces = mesh
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.5, 1.5, (n, 3))
    face = vertices[faces[rng.integers(len(faces), size=n // 2)]]
    near = np.einsum("nv,nvk->nk", rng.dirichlet(4 * np.ones(3), n // 2), face)
    normal = unit(np.cross(face[:, 1] - face[:, 0], face[:, 2] - face[:, 0]))
    away = 10 ** rng.uniform(math.log10(closest), -0.5, (n // 2, 1))
    x[: n // 2] = near + away * normal * rng.choice([-1, 1], (n // 2, 1))
    return rounded(x)


# --- values ---------------------------------------------------------------------------------


def test_both_direct_sums_agree() -> None:
    vertices, faces = damaged_sphere(2)
    x = places((vertices, faces), 500)
    expected = direct_sum(vertices[faces], x)
    np.testing.assert_allclose(summed_on_device(vertices[faces])(x), expected, atol=1e-12)
    assert 0.1 < np.ptp(expected) < 3


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
def test_values_are_within_their_bound(method: Any, precision: Any) -> None:
    vertices, faces = damaged_sphere(3)
    x = places((vertices, faces), 2000)
    expected = direct_sum(vertices[faces], x)
    settings = [(2, None), (0, None), (1, None), (2, 1.5), (2, 4.0)] if method == "tree" else [
        (2, None)
    ]  # fmt: skip
    widest = []
    for order, accuracy in settings:
        field = WindingNumber(vertices, faces, method=method, order=order, accuracy=accuracy)
        assert field.method == method
        value = field.value(x, precision=precision)
        bound = field.error_bound(x, precision=precision)
        assert value.shape == bound.shape == (len(x),)
        assert (np.abs(value - expected) <= bound).all()
        widest.append(bound.max())
    if method == "exact":
        assert widest[0] < (5e-5 if precision == "single" else 1e-13)
    else:
        by_default, dipoles, quadrupoles, coarse, fine = widest
        assert fine < by_default < coarse < 0.5
        assert by_default < quadrupoles < dipoles < 0.5
        assert fine < 0.005


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
def test_derivatives_are_those_of_the_value(method: Any) -> None:
    """Differences of the direct sum, away from faces, over which it jumps."""
    vertices, faces = damaged_sphere(2)
    x = places((vertices, faces), 600, closest=0.05)
    corners = vertices[faces]
    field = WindingNumber(vertices, faces, method=method, accuracy=8.0)
    value, gradient = field.value_and_gradient(x, precision="double")
    np.testing.assert_allclose(value, field.value(x, precision="double"), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(gradient, field.gradient(x, precision="double"))
    hessian = field.hessian(x, precision="double")
    assert gradient.shape == (len(x), 3)
    assert hessian.shape == (len(x), 3, 3)
    h, exact = 2e-4, summed_on_device(corners)

    def shifted(*steps: tuple[int, float]) -> np.ndarray:
        # A point may pass a face by the step: whole numbers are none of a derivative.
        y = x + sum(k * h * np.eye(3)[axis] for axis, k in steps)
        jump = exact(y) - middle
        return jump - np.round(jump)

    middle = exact(x)
    atol = {"exact": 1e-4, "tree": 2e-3}[method]
    for i in range(3):
        difference = (shifted((i, 1)) - shifted((i, -1))) / (2 * h)
        np.testing.assert_allclose(gradient[:, i], difference, rtol=1e-4, atol=atol)
        for j in range(3):
            if i == j:
                bend = (shifted((i, 1)) + shifted((i, -1))) / h**2
            else:
                bend = shifted((i, 1), (j, 1)) + shifted((i, -1), (j, -1))
                bend = (bend - shifted((i, 1), (j, -1)) - shifted((i, -1), (j, 1))) / (4 * h**2)
            np.testing.assert_allclose(hessian[:, i, j], bend, rtol=1e-3, atol=20 * atol)
    np.testing.assert_array_equal(hessian, np.swapaxes(hessian, 1, 2))
    size = np.abs(hessian).max()
    np.testing.assert_allclose(np.trace(hessian, axis1=1, axis2=2), 0, atol=1e-11 * size)


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_of_the_value_itself(method: Any) -> None:
    """The tree's own gradient and Hessian are those of its own value where no cluster changes."""
    vertices, faces = damaged_sphere(2)
    x = places((vertices, faces), 300, closest=0.1)
    accuracy = 2.0 if method == "tree" else None  # else derivatives are sums over edges
    field = WindingNumber(vertices, faces, method=method, accuracy=accuracy)
    h = 1e-5
    gradient = field.gradient(x, precision="double")
    hessian = field.hessian(x, precision="double")
    for i in range(3):
        step = h * np.eye(3)[i]
        v1, g1 = field.value_and_gradient(x + step, precision="double")
        v0, g0 = field.value_and_gradient(x - step, precision="double")
        off = np.abs((v1 - v0) / (2 * h) - gradient[:, i])
        bend = np.abs((g1 - g0) / (2 * h) - hessian[:, i]).max(axis=1)
        assert np.mean(off < 1e-6) > 0.98
        assert np.mean(bend < 1e-5) > 0.98


@pytest.mark.parametrize("method", METHODS)
def test_single_precision_derivatives(method: Any) -> None:
    mesh = damaged_sphere(2)
    x = places(mesh, 500, closest=0.05)
    field = WindingNumber(*mesh, method=method)
    gradients = [field.gradient(x, precision=precision) for precision in PRECISIONS]
    np.testing.assert_allclose(*gradients, atol=1e-4)
    single, double = (field.hessian(x, precision=precision) for precision in PRECISIONS)
    np.testing.assert_allclose(single, double, atol=1e-4 * np.abs(double).max())
    assert np.abs(single - double).max() > 0


def relative(computed: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(n,) how far vectors or matrices are off, as parts of their sizes."""
    axes = tuple(range(1, right.ndim))
    return np.sqrt(((computed - right) ** 2).sum(axis=axes) / (right**2).sum(axis=axes))


def holed(n: int) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """A sphere without 5 % of its triangles, n points, and the gradients there."""
    vertices, faces = icosphere(4)
    mesh = vertices, remove_faces(faces, 0.05, 0)
    x = places(mesh, n)
    return mesh, x, WindingNumber(*mesh, method="exact").gradient(x, precision="double")


def test_gradients_at_points_are_good_by_default() -> None:
    """Those of the tree of triangles were off by 34 % in the median and 300 % at 95 % of points."""
    mesh, x, exact = holed(300)
    original = WindingNumber(*mesh, method="tree", accuracy=2.0)
    assert np.quantile(relative(original.gradient(x, precision="double"), exact), 0.9) > 0.3
    field = WindingNumber(*mesh, method="tree")
    assert relative(field.gradient(x, precision="double"), exact).max() < 1e-9
    at = to_vector3(choose_backend("double"), x)
    dr.enable_grad(at)
    dr.backward(dr.sum(field.value(at)))
    np.testing.assert_allclose(to_numpy(at.grad), exact, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_gradients_of_many_edges_are_good(precision: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond so many edges they come from a tree over what would close the holes."""
    monkeypatch.setattr(winding_rates, "_FEW", 64)
    mesh, x, exact = holed(2000)
    field = WindingNumber(*mesh, method="tree")
    value, gradient = field.value_and_gradient(x, precision=precision)
    assert np.quantile(relative(gradient, exact), 0.95) < 0.01
    bound = field.gradient_error_bound(x, precision=precision)
    assert (np.linalg.norm(gradient - exact, axis=1) <= bound).all()
    np.testing.assert_array_equal(value, field.value(x, precision=precision))
    hessian = WindingNumber(*mesh, method="exact").hessian(x, precision="double")
    off = np.linalg.norm(field.hessian(x, precision=precision) - hessian, 2, axis=(1, 2))
    assert (off <= field.hessian_error_bound(x, precision=precision)).all()


def test_hessians_on_the_device_are_rows() -> None:
    mesh = damaged_sphere(1)
    x = places(mesh, 50, closest=0.1)
    backend = choose_backend("double")
    for method in METHODS:
        field = WindingNumber(*mesh, method=method)  # type: ignore[arg-type]
        rows = field.hessian(backend.Array3f(x.T))
        found = np.stack([to_numpy(row) for row in rows], axis=1)
        np.testing.assert_allclose(found, field.hessian(x, precision="double"), atol=1e-12)


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
def test_closed_meshes_have_whole_numbers(method: Any, precision: Any) -> None:
    rng = np.random.default_rng(0)
    outer, faces = bumpy_sphere(2)
    inner, holes = icosphere(1)
    vertices = np.concatenate([outer, 0.4 * inner])
    both = np.concatenate([faces, holes + len(outer)])
    cavity = np.concatenate([faces, holes[:, ::-1] + len(outer)])
    radius = np.repeat([0.2, 0.65, 1.4, 5.0], 200)
    x = radius[:, None] * unit(rng.normal(size=(800, 3)))
    for some, expected in ((both, [2, 1, 0, 0]), (cavity, [0, 1, 0, 0])):
        field = WindingNumber(vertices, some, method=method, accuracy=3.0)
        assert field.describe()["singular edges"] == 0
        value = field.value(x, precision=precision)
        expected = np.repeat(expected, 200)
        if method == "exact":
            np.testing.assert_array_equal(value, expected)
            assert (field.gradient(x, precision=precision) == 0).all()
            assert (field.hessian(x, precision=precision) == 0).all()
        assert (np.abs(value - expected) <= field.error_bound(x, precision=precision)).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
def test_duplicates_and_flips_count(method: Any) -> None:
    vertices, faces = bumpy_sphere(2)
    x = places((vertices, faces), 800)
    twice = np.concatenate([faces, faces])
    some: dict[str, np.ndarray] = {
        "duplicated": duplicate_faces(faces, 0.2, seed=1),
        "hidden": duplicate_faces(faces, 0.2, seed=2, flipped=True),
        "flipped": flip_faces(faces, 0.2, seed=3),
        "all flipped": faces[:, ::-1],
        "three times": np.concatenate([faces, faces, np.roll(faces, 1, axis=1)]),
        "twice, holes": remove_faces(twice, 0.3, seed=4),
    }
    for name, these in some.items():
        field = WindingNumber(vertices, these, method=method)
        expected = direct_sum(vertices[these], x)
        off = np.abs(field.value(x, precision="double") - expected)
        assert (off <= field.error_bound(x, precision="double")).all(), name


@pytest.mark.parametrize("method", METHODS)
def test_soups_are_welded_by_position(method: Any) -> None:
    """Every face with its own vertices: no edge is singular that is none of the mesh."""
    vertices, faces = damaged_sphere(2)
    whole = WindingNumber(vertices, faces, method=method)
    soup = WindingNumber(
        vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), method=method
    )
    assert soup.describe() == whole.describe()
    x = places((vertices, faces), 400)
    np.testing.assert_allclose(
        soup.value(x, precision="double"), whole.value(x, precision="double"), atol=1e-12
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e5, 0.0), (1.0, 1000.0)])
def test_units_and_places_do_not_matter(method: Any, scale: float, shift: float) -> None:
    vertices, faces = damaged_sphere(2)
    x = places((vertices, faces), 300, closest=0.02)
    here = WindingNumber(vertices, faces, method=method, accuracy=6.0)
    there = WindingNumber(scale * vertices + shift, faces, method=method, accuracy=6.0)
    y = scale * x + shift
    # Another place has other clusters: a tree agrees to its truncation.
    close = {"exact": 1e-8, "tree": 1e-2}[method]
    for of, power in (("value", 0), ("gradient", 1), ("hessian", 2)):
        expected = getattr(here, of)(x, precision="double")
        found = getattr(there, of)(y, precision="double") * scale**power
        np.testing.assert_allclose(found, expected, atol=close * np.abs(expected).max())


@pytest.mark.slow
def test_one_triangle() -> None:
    vertices = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2]])
    x = np.array([[0.0, 0, 0], [1, 1, 1], [-3, 2, 0.5], [0.3, 0.3, 0.3]])
    for method in METHODS:
        field = WindingNumber(vertices, faces, method=method)  # type: ignore[arg-type]
        value = field.value(x, precision="double")
        assert value[0] == pytest.approx(1 / 8)
        off = np.abs(value - direct_sum(vertices[faces], x))
        assert (off <= field.error_bound(x, precision="double")).all()
        assert field.describe()["triangles"] == 1


OCTANT: Mesh = (np.eye(3), np.array([[0, 1, 2]]))
CUBE = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1, 1) for z in (-1, 1)])
CUBE_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("missing", [1, 2, 3, 5, 7, 11])
def test_points_in_line_with_vertices_and_edges(missing: int, method: Any, precision: Any) -> None:
    """On a grid that boundary edges and vertices lie on, so that every decision is a tie."""
    steps = np.array([-3, -2, -1, -0.5, 0, 0.5, 1, 2, 3])
    x = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    for vertices, faces in ((CUBE, CUBE_FACES[missing:]), OCTANT, (OCTANT[0], [[0, 2, 1]])):
        field = WindingNumber(vertices, faces, method=method)
        corners = vertices[np.asarray(faces)]
        fractions = np.array([[i, j, 16 - i - j] for i in range(17) for j in range(17 - i)]) / 16
        surface = np.einsum("wk,tkd->wtd", fractions, corners).reshape(-1, 3)
        off = np.array([np.linalg.norm(surface - p, axis=1).min() > 0.2 for p in x])
        expected = direct_sum(corners, x[off])
        value = field.value(x[off], precision=precision)
        assert (np.abs(value - expected) <= field.error_bound(x[off], precision=precision)).all()


def lattice_squares(n: int, count: int, seed: int) -> Mesh:
    """Some of the squares between the points of a lattice n^3, each as two triangles."""
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(*3 * [np.arange(n + 1.0)], indexing="ij"), axis=-1)
    strides = np.array([(n + 1) ** 2, n + 1, 1])
    axis = rng.integers(3, size=count)
    corner = rng.integers(n, size=(count, 3))
    # Squares across an axis reach from 0 to n along it.
    corner[np.arange(count), axis] = rng.integers(n + 1, size=count)
    base, u, v = corner @ strides, strides[(axis + 1) % 3], strides[(axis + 2) % 3]
    first = np.stack([base, base + u, base + u + v], axis=1)
    second = np.stack([base, base + u + v, base + v], axis=1)
    return lattice.reshape(-1, 3), np.unique(np.concatenate([first, second]), axis=0)


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("count", [6, 60, 300])
def test_lattices_are_all_ties(count: int, precision: Any) -> None:
    """Vertical rays through vertices, along edges, and through diagonals of a lattice's squares."""
    vertices, faces = lattice_squares(4, count, seed=count)
    field = WindingNumber(vertices, faces, method="exact")
    steps = np.arange(-0.5, 5, 0.5)
    x = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    backend = choose_backend("double")
    jumps = field.evaluator(backend).jumps
    assert jumps is not None
    apart = to_numpy(jumps.distance(to_vector3(backend, x)))
    x = x[apart > 0.2]
    assert len(x) > 300
    expected = direct_sum(vertices[faces], x)
    off = np.abs(field.value(x, precision=precision) - expected)
    assert (off <= field.error_bound(x, precision=precision)).all()
    # Nearly every such ray meets an edge or the line that it lies on.
    trails = TrailValues.upload(backend, vertices, field.mesh.singular_edges)
    ways = backend.Float(np.where(np.arange(len(x)) % 2, 1.0, -1.0))
    assert to_numpy(trails.turns(to_vector3(backend, x), ways)[1]).mean() > 0.3


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hard_points(precision: Any) -> None:
    """In line with vertices and edges, beside edges of all lengths, and far away."""
    rng = np.random.default_rng(0)
    vertices, faces = damaged_sphere(2)
    tiny, more = icosphere(1)
    vertices, faces = merged(
        (vertices, faces),
        (1e-3 * tiny + [0.2, 0.1, 0.3], more[3:]),
        (1e-6 * tiny, more[5:]),
    )
    vertices = rounded(vertices)
    field = WindingNumber(vertices, faces, method="exact")
    ends = vertices[field.mesh.singular_edges]
    middle = rounded(0.5 * (ends[:, 0] + ends[:, 1]))
    below = rng.uniform(0.1, 2, (len(ends), 1)) * [0, 0, -1]
    # Rays go away from the middle, which is at a height of about zero.
    inwards = below * np.sign(middle[:, 2:] + 1e-9) / 4
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1, keepdims=True)
    beside = 0.1 * length * unit(rng.normal(size=below.shape))
    x = np.concatenate([
        ends[:, 0] + inwards, middle + inwards, ends[:, 0] + below, middle + below,
        middle + beside, ends[:, 0] + beside,
        1e3 * below + middle, 10 ** rng.uniform(1, 8, below.shape) * unit(middle), 1e6 * below,
    ])  # fmt: skip
    x = rounded(x)
    found, gradient = field.value_and_gradient(x, precision=precision)
    expected = direct_sum(vertices[faces], x)
    # The last places of a point count where the gradient is large.
    places = 2.0 ** (-22 if precision == "single" else -51) * (1 + np.abs(x).max(axis=1))
    bound = field.error_bound(x, precision=precision) + places * np.linalg.norm(gradient, axis=1)
    for value in (field.value(x, precision=precision), found):
        assert (np.abs(value - expected) <= bound).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_lengths_far_apart(precision: Any) -> None:
    """Products of lengths leave float32: a triangle from far away, and a tiny one from close by."""
    rng = np.random.default_rng(0)
    field = WindingNumber(*OCTANT, method="exact")
    far = 10 ** rng.uniform(1, 12, (500, 1)) * unit(rng.normal(size=(500, 3)))
    assert (np.abs(field.value(far, precision=precision)) < 1e-2).all()
    tiny = 1e-10 if precision == "single" else 1e-70
    # The tiny one is where coordinates are small: in the middle.
    centered = merged(OCTANT, (-OCTANT[0], OCTANT[1]), (tiny * OCTANT[0] + tiny, OCTANT[1]))
    field = WindingNumber(*centered, method="exact")
    x = tiny * rng.uniform(-3, 3, (500, 3)).astype(np.float32)
    off = np.abs(field.value(x, precision=precision) - direct_sum(centered[0][centered[1]], x))
    assert (off <= field.error_bound(x, precision=precision)).all()


@given(st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=12), min_size=1, max_size=5))
def test_trails_take_every_edge_once(walks: list[list[int]]) -> None:
    pairs = [(a, b) for walk in walks for a, b in zip(walk, walk[1:] + walk[:1], strict=True)]
    trails = closed_trails(np.array(pairs))
    assert all(trail[0] == trail[-1] and len(trail) > 1 for trail in trails)
    found = [pair for trail in trails for pair in itertools.pairwise(trail.tolist())]
    assert sorted(found) == sorted(pairs)


def test_edges_that_are_not_closed_are_refused() -> None:
    with pytest.raises(ValueError, match="not closed, more go to vertex 2"):
        closed_trails(np.array([[0, 1], [1, 2]]))


def test_auto_takes_the_exact_method_for_few_edges() -> None:
    assert WindingNumber(*bumpy_sphere(2)).method == "exact"
    assert WindingNumber(*damaged_sphere(2)).method == "exact"
    assert WindingNumber(*damaged_sphere(5)).method == "tree"


@pytest.mark.slow
def test_thousands_of_points() -> None:
    """80,000 faces with a tenth of them removed: every value within its bound."""
    vertices, faces = damaged_sphere(6)
    x = places((vertices, faces), 10_000, closest=2e-3)
    exact = WindingNumber(vertices, faces, method="exact")
    some = np.random.default_rng(0).permutation(len(x))[:2000]
    expected = exact.value(x, precision="double")
    summed = summed_on_device(vertices[faces])(x[some])
    np.testing.assert_allclose(expected[some], summed, atol=1e-11)
    np.testing.assert_allclose(summed[:50], direct_sum(vertices[faces], x[some[:50]]), atol=1e-11)
    for precision in PRECISIONS:
        for order in (0, 1, 2):
            field = WindingNumber(vertices, faces, method="tree", order=order)
            off = np.abs(field.value(x, precision=precision) - expected)  # type: ignore[arg-type]
            bound = field.error_bound(x, precision=precision)  # type: ignore[arg-type]
            assert (off <= bound).all()
    off = np.abs(exact.value(x, precision="single") - expected)
    assert (off <= exact.error_bound(x, precision="single")).all()


# --- first hits -----------------------------------------------------------------------------

TOLERANCE, REACH = 2e-5, 3e-4


def merged(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    faces = [faces + start for (_, faces), start in zip(meshes, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def turned(vertices: np.ndarray, seed: int) -> np.ndarray:
    return vertices @ np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0].T


def damaged(kind: str, seed: int) -> Mesh:
    """A mesh that somebody ruined."""
    rng = np.random.default_rng(seed)
    vertices, faces = bumpy_sphere(2) if seed % 2 else torus_mesh(0.9, 0.45, 20, 10)
    if kind == "holes":
        faces = remove_faces(faces, rng.uniform(0.02, 0.4), seed)
    elif kind == "flips":
        faces = flip_faces(faces, rng.uniform(0.02, 0.2), seed)
    elif kind == "duplicates":
        faces = duplicate_faces(faces, 0.2, seed)
        faces = duplicate_faces(faces, 0.1, seed + 1, flipped=True)
    elif kind == "self-intersections":
        other, more = icosphere(1)
        vertices, faces = merged((vertices, faces), (0.7 * other + [0.5, 0.3, 0.2], more))
        faces = remove_faces(faces, 0.1, seed)
    elif kind == "soup":
        corners = vertices[remove_faces(faces, 0.2, seed)]
        corners = corners + 0.01 * rng.normal(size=corners.shape)
        vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
    else:
        faces = flip_faces(remove_faces(faces, 0.1, seed), 0.05, seed)
        faces = duplicate_faces(faces, 0.05, seed)
    return rounded(turned(vertices, seed)), faces


KINDS = ["holes", "flips", "duplicates", "self-intersections", "soup", "all of it"]


def rays(mesh: Mesh, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    return mesh_rays(*mesh, n, seed, -1.2, 1.2)


def check_first_hits(
    mesh: Mesh, method: Any, n: int, seed: int, precision: Any, *, cells: bool = False
) -> None:
    vertices, faces = mesh
    o, d = rays(mesh, n, seed)
    field = WindingNumber(vertices, faces, method=method, cells=cells)
    exact = summed_on_device(vertices[faces])
    far = 5.0
    truth = first_side_changes(exact, o, d, 0.0, far, level=0.5, samples=384)
    hits = hk.trace(field, o, d, t_max=far, precision=precision, tolerance=TOLERANCE)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    t = np.where(hits.is_hit, hits.t, np.inf).astype(np.float64)
    verdict = judge(
        t, exact, o, d, 0.0, far,
        level=0.5, reach=REACH, edges=vertices[field.mesh.singular_edges], truth=truth, samples=384,
    )  # fmt: skip
    assert verdict.wrong == 0, verdict
    assert verdict.changes > n / 5
    check_sheets(hits, field, exact, mesh, d)


def check_sheets(hits: Any, field: WindingNumber, exact: Any, mesh: Mesh, d: np.ndarray) -> None:
    """Hits on sheets lie on the face that they name, with its normal to the larger side."""
    vertices, faces = mesh
    rows = np.flatnonzero(hits.primitive_index >= 0)
    assert len(rows) > 20
    corners = vertices[faces[field.facet_faces[hits.primitive_index[rows]]]]
    normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    np.testing.assert_allclose(hits.normal[rows], -normal, atol=1e-4)
    plane = ((hits.position[rows] - corners[:, 0]) * normal).sum(axis=1)
    np.testing.assert_allclose(plane, 0, atol=1e-5)
    low = corners.min(axis=1) - 1e-4 <= hits.position[rows]
    assert (low & (hits.position[rows] <= corners.max(axis=1) + 1e-4)).all()
    # Elsewhere the value is the level.
    smooth = hits.is_hit & (hits.primitive_index < 0)
    off = np.abs(exact(hits.position[smooth].astype(np.float64)) - 0.5)
    if smooth.sum() > 20:
        assert np.median(off) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_first_hits(method: Any) -> None:
    check_first_hits(damaged("soup", 1), method, 500, 0, "single")


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [2, 5])
def test_many_first_hits(kind: str, seed: int, method: Any) -> None:
    precision = "double" if seed == 5 else "single"
    check_first_hits(damaged(kind, seed), method, 1000, seed, precision)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_closed_meshes_are_hit_where_rays_meet_triangles(method: Any, precision: Any) -> None:
    vertices, faces = bumpy_sphere(2)
    o, d = rays((vertices, faces), 1500, 7)
    p, q, r = np.moveaxis(vertices[faces], 1, 0)
    e, f = q - p, r - p
    h, s = np.cross(d[:, None], f[None]), o[:, None] - p
    a = (e * h).sum(axis=-1)
    u = (s * h).sum(axis=-1) / a
    g = np.cross(s, np.broadcast_to(e, s.shape))
    v, t = (d[:, None] * g).sum(axis=-1) / a, (f * g).sum(axis=-1) / a
    # Rays that pass an edge closely may go either way.
    margin = np.minimum(np.minimum(u, v), 1 - u - v)
    clear = (np.abs(margin) > 1e-4).all(axis=1) & (np.abs(t) > 1e-4).all(axis=1)
    t = np.where((margin >= 0) & (t > 0), t, np.inf)
    first = t.min(axis=1)
    hits = hk.trace(WindingNumber(vertices, faces, method=method), o, d, precision=precision)
    np.testing.assert_array_equal(hits.is_hit[clear], np.isfinite(first)[clear])
    rows = np.flatnonzero(clear & hits.is_hit)
    assert len(rows) > 500
    # Rounding across a ray moves t by as much as the triangle leans.
    lean = np.abs((unit(np.cross(e, f))[t.argmin(axis=1)] * d).sum(axis=1))
    assert (np.abs(hits.t - first)[rows] <= 2e-6 + 1e-6 / lean[rows]).all()
    np.testing.assert_array_equal(hits.primitive_index[rows], t.argmin(axis=1)[rows])


def test_sheets_name_faces_as_given() -> None:
    """Faces that cancel are none: those behind them keep their numbers."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]])
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2], [0, 2, 1]])
    field = WindingNumber(vertices, faces)
    assert field.facet_faces.tolist() == [1, 2, 3, 4]
    assert field.describe()["singular edges"] == 0
    hits = hk.trace(field, [[2.0, 2.1, 2.2]], [(np.array([-1.8, -1.9, -1.9])).tolist()])
    assert field.facet_faces[hits.primitive_index].tolist() == [3]


# --- what is refused ------------------------------------------------------------------------

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.where(np.eye(4, 3) > 0, np.nan, TETRAHEDRON), FACES, "vertex 0 is .*finite"),
        (TETRAHEDRON, FACES + 1, "out of range.*subtract 1"),
        (TETRAHEDRON, FACES - 1, "out of range"),
        (TETRAHEDRON, [[0, 1, 1]], "zero area"),
        (TETRAHEDRON, [[0, 1, 2], [2, 1, 0]], "every face is canceled"),
        (TETRAHEDRON, FACES.astype(float), "integer"),
        (TETRAHEDRON[:, :2], FACES, "shape"),
        (TETRAHEDRON, np.zeros((0, 3), int), "no faces"),
    ],
)
def test_meshes_that_are_refused(vertices: Any, faces: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        WindingNumber(vertices, faces)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "fast"}, "method is"),
        ({"accuracy": 1.0}, "accuracy must lie between"),
        ({"accuracy": 101}, "accuracy must lie between"),
        ({"accuracy": math.nan}, "accuracy must lie between"),
        ({"order": 3}, "order must be"),
        ({"order": -1}, "order must be"),
    ],
)
def test_settings_that_are_refused(settings: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WindingNumber(TETRAHEDRON, FACES, **settings)


def test_level_zero_is_refused() -> None:
    field = WindingNumber(TETRAHEDRON, FACES)
    with pytest.raises(ValueError, match=r"level 0 .* no surface"):
        hk.trace(field, [[2.0, 2, 2]], [[-1.0, -1, -1]], level=0.0)


def test_points_that_are_refused() -> None:
    field = WindingNumber(TETRAHEDRON, FACES)
    with pytest.raises(ValueError, match=r"NaN or infinite values: entry 1"):
        field.value([[0.0, 0, 0], [0, math.inf, 0]])
    with pytest.raises(ValueError, match="points"):
        field.value([[0.0, 0]])
    with pytest.raises(TypeError, match="real numbers"):
        field.value(np.array([["a", "b", "c"]]))
    assert field.value(np.zeros((0, 3))).shape == (0,)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["exact", "tree"])
def test_lifts_stay_within_their_promise(method: str) -> None:
    """The continuous lift of w, followed along segments in the ball, against [lower, upper]."""
    vertices, faces = bumpy_sphere(2)
    faces = remove_faces(faces, 0.15, seed=4)
    field = WindingNumber(vertices, faces, method=method)
    exact = WindingNumber(vertices, faces, method="exact")
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.4, 1.4, (300, 3))
    backend = choose_backend("double")
    sample = field.evaluator(backend).evaluate(to_vector3(backend, x))
    ball = next(one for one in sample.all_promises if isinstance(one, HarmonicBall))
    value, radius = to_numpy(sample.value), to_numpy(ball.radius)
    room = np.stack([to_numpy(ball.lower) - value, to_numpy(ball.upper) - value])
    slack = (
        2 * np.broadcast_to(to_numpy(type(sample.value)(sample.value_error)), value.shape) + 1e-9
    )
    assert (radius > 0).all()
    largest = 0.0
    for _ in range(6):
        d = rng.normal(size=x.shape)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        t = np.linspace(0, 0.999, 65)[:, None, None] * radius[:, None]
        y = (x + t * d).reshape(-1, 3)
        w = exact.value(y, precision="double").reshape(65, -1)
        moved = np.unwrap(w, axis=0, period=1.0) - w[0]
        assert (moved >= room[0] - slack).all()
        assert (moved <= room[1] + slack).all()
        largest = max(largest, float((np.abs(moved) / np.abs(room).max(axis=0)).max()))
    assert largest > 0.1  # the promise is not an empty one
