"""Derivatives by curves, oriented points and meshes, against central differences in double
precision, in forward and reverse mode. Classes are found by their traits: each class with
derivatives by parameters has an example here, and whatever else it takes is refused
(`test_dropped_derivatives`)."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend
from harnack.fmm.pair_sums import pair_sum
from harnack.geometry import Circle, example_curves
from harnack.geometry.example_meshes import icosphere
from tests.backend.test_kernels import compiled

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

DOUBLE = choose_backend("double")
Arrays = dict[str, np.ndarray]

_RNG = np.random.default_rng(0)
POINTS = _RNG.normal(size=(40, 3))
POINTS /= np.linalg.norm(POINTS, axis=1)[:, None]
NORMALS = 2 * POINTS + 0.2 * _RNG.normal(size=POINTS.shape)
AREAS = np.pi / 10 * _RNG.uniform(0.8, 1.2, len(POINTS))
CLOUD: Arrays = {"points": POINTS, "normals": NORMALS, "areas": AREAS}
LOOPS: Arrays = {
    "outer": example_curves.wavy_polygon(12),
    "inner": 0.3 * example_curves.wavy_polygon(7)[::-1] + np.array([0.1, 0.0, 0.2]),
}
VERTICES, FACES = icosphere(1)
VERTICES = VERTICES + 0.05 * _RNG.normal(size=VERTICES.shape)
WITH_HOLES = FACES[np.arange(len(FACES)) % 7 > 0]
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE = 0.8 * CUBE + 0.1 * _RNG.normal(size=CUBE.shape)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7, 3]]


def curve_with_circle(outer: Any, inner: Any) -> hk.SolidAngle:
    return hk.SolidAngle([outer, Circle(0.5, (0.2, 0.1, 0.4)), inner])


# For each example: what moves, a field made of it, and the level.
Example = tuple[Arrays, Callable[..., hk.Field], float]
EXAMPLES: dict[str, Example] = {
    "SolidAngle": (LOOPS, curve_with_circle, 5.0),
    "DipolePotential": (CLOUD, hk.DipolePotential, 5.0),
    "a smoothed sum": (
        CLOUD,
        lambda points, normals, areas: hk.DipolePotential(points, normals, areas, smoothing=0.3),
        5.0,
    ),
    "ScreenedWindingNumber": (
        CLOUD,
        lambda **cloud: hk.fields.ScreenedWindingNumber(**cloud, length=0.7),
        0.25,
    ),
    "WindingNumber": (
        {"vertices": VERTICES},
        lambda vertices: hk.WindingNumber(vertices, WITH_HOLES),
        0.5,
    ),
    "PolygonMesh": ({"vertices": CUBE}, lambda vertices: hk.PolygonMesh(vertices, SIDES), 5.5),
    "FieldSum": (
        LOOPS | {"points": POINTS, "weight": np.array([0.7])},
        lambda outer, inner, points, weight: hk.fields.FieldSum(
            [
                hk.SolidAngle([outer, inner]),
                hk.DipolePotential(points, NORMALS, AREAS, smoothing=0.3),
            ],
            [1.0, weight],
        ),
        7.0,
    ),
    "FieldProduct": (
        CLOUD,
        lambda **cloud: hk.fields.FieldProduct(
            [hk.DipolePotential(**cloud, smoothing=0.3), hk.expression("2 + x*y")]
        ),
        8.0,
    ),
}  # fmt: skip


def moving(arrays: Arrays) -> dict[str, Any]:
    """The arrays as Dr.Jit arrays with derivatives enabled."""
    result = {name: Array3f64(a.T) if a.ndim == 2 else Float64(a) for name, a in arrays.items()}
    for array in result.values():
        dr.enable_grad(array)
    return result


def rays(count: int = 200) -> tuple[Any, Any]:
    rng = np.random.default_rng(2)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1)[:, None]
    directions = rng.uniform(-0.5, 0.5, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1)[:, None]


def outputs(field: Any, level: float) -> dict[str, Any]:
    """All results as Dr.Jit arrays of one dimension."""
    origins, directions = rays()
    hits = hk.trace(
        field, Array3f64(origins.T), Array3f64(directions.T), level=level, tolerance=1e-9
    )
    is_hit, results = hits.is_hit, {}
    vectors = {"position": dr.select(is_hit, hits.position, 0), "normal": hits.normal}
    if not field.traits.has_patches:  # these have no single function
        points = Array3f64(np.random.default_rng(3).uniform(-1.2, 1.2, (200, 3)).T)
        results["value"], vectors["gradient"] = field.value(points), field.gradient(points)
    results["t"] = dr.select(is_hit, hits.t, 0)
    for name, vector in vectors.items():
        results |= {f"{name} {k}": vector[k] for k in range(3)}
    return results


def numbers_of(example: Example, motion: Arrays, step: float) -> Arrays:
    """The results after a step. (Arrays have derivatives enabled, so that hits are refined up to
    rounding.)"""
    arrays, make, level = example
    moved = {name: array + step * motion[name] for name, array in arrays.items()}
    results = outputs(make(**moving(moved)), level)
    return {name: np.array(dr.detach(result)) for name, result in results.items()}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", EXAMPLES)
def test_derivatives_agree_with_differences(name: str) -> None:
    """By a direction of all numbers at once, which shows if one is left out; and in reverse mode
    the same, for a random sum of all results."""
    arrays, make, level = example = EXAMPLES[name]
    rng = np.random.default_rng(4)
    motion = {key: np.abs(a).max() * rng.uniform(-1, 1, a.shape) for key, a in arrays.items()}
    h = 1e-6
    above, below, further, back = (numbers_of(example, motion, s) for s in (h, -h, 2 * h, -2 * h))
    attached = moving(arrays)
    results = outputs(make(**attached), level)
    for key, array in attached.items():
        dr.set_grad(array, type(array)(motion[key].T))
    dr.forward_to(*results.values(), flags=dr.ADFlag.AllowNoGrad)
    forward, weights, total = {}, {}, 0.0
    for key, result in results.items():
        forward[key] = derivative = np.array(dr.grad(result))
        difference = (above[key] - below[key]) / (2 * h)
        wide = (further[key] - back[key]) / (4 * h)
        # Rays that graze, and points near singularities, have no accurate differences.
        is_smooth = np.abs(difference - wide) < 1e-5 * (1 + np.abs(difference))
        assert is_smooth.mean() > 0.95, key
        error = np.abs(derivative - difference)[is_smooth]
        assert np.quantile(error, 0.98) < 1e-5 * np.abs(difference[is_smooth]).max(), key
        weights[key] = np.where(np.isfinite(derivative), rng.normal(size=derivative.shape), 0)
        total += (weights[key] * np.nan_to_num(derivative)).sum()
    attached = moving(arrays)
    results = outputs(make(**attached), level)
    dr.backward(sum(dr.sum(result * Float64(weights[key])) for key, result in results.items()))
    reverse = sum(
        (np.array(dr.grad(array)).T * motion[key]).sum() for key, array in attached.items()
    )
    assert reverse == pytest.approx(total, rel=1e-9)


def test_each_class_with_derivatives_by_parameters_has_an_example() -> None:
    """A new one fails here. One without is refused all derivatives by `test_dropped_derivatives`,
    and those by single numbers have examples in `test_number_derivatives`."""
    public = {**vars(hk), **vars(hk.fields)}
    classes = {kind for kind in public.values() if inspect.isclass(kind)}
    names = {
        kind.__name__
        for kind in classes
        if issubclass(kind, hk.Field) and kind.traits.has_parameter_derivatives
    }
    assert names == {name for name in EXAMPLES if name in vars(hk) or name in vars(hk.fields)}


def test_a_closed_mesh_has_a_winding_number_that_does_not_move() -> None:
    vertices = Array3f64(VERTICES.T)
    dr.enable_grad(vertices)
    field = hk.WindingNumber(vertices, FACES)
    value = field.value(Array3f64([0.1, 3.0], 0.0, 0.0))
    np.testing.assert_allclose(value, [1.0, 0.0], atol=1e-12)
    dr.backward(dr.sum(value) + field.gradient(Array3f64(0.1, 0.2, 0.3)).x)
    np.testing.assert_allclose(dr.grad(vertices), 0.0, atol=1e-15)


@pytest.mark.slow
def test_a_coordinate_that_all_vertices_share_moves_facets() -> None:
    triangle = Array3f64([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 0.5)
    dr.enable_grad(triangle)
    field = hk.WindingNumber(triangle, [[0, 1, 2]])
    hits = hk.trace(
        field, Array3f64([0.2, 5.0], 0.3, 2.0), Array3f64(0, 0, -1)
    )  # the second misses
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.t + hits.normal.x, 0)))
    np.testing.assert_allclose(np.array(triangle.z.grad).ravel(), [-1.0], atol=1e-12)


def test_vertices_at_the_same_place_move_one_by_one() -> None:
    """The edges of a soup of triangles do not cancel where only one of their vertices moves."""
    soup = VERTICES[FACES].reshape(-1, 3)
    p, motion = Array3f64(0.3, 0.2, 0.1), np.zeros_like(soup)
    motion[5] = (0.3, 0.5, -0.2)

    def value(vertices: Any) -> Any:
        return hk.WindingNumber(vertices, np.arange(len(soup)).reshape(-1, 3)).value(p)

    vertices = Array3f64(soup.T)
    dr.enable_grad(vertices)
    dr.backward(value(vertices))
    difference = (value(soup + 1e-6 * motion) - value(soup - 1e-6 * motion)) / 2e-6
    assert abs(difference[0]) > 1e-3
    assert (np.array(dr.grad(vertices)).T * motion).sum() == pytest.approx(difference[0], rel=1e-5)


def test_moved_fields_have_derivatives_by_their_new_numbers() -> None:
    points, vertices = Array3f64(POINTS.T), Array3f64(VERTICES.T)
    dr.enable_grad(points, vertices)
    old = Array3f64(VERTICES.T)
    dr.enable_grad(old)
    p = Array3f64(0.3, 0.2, 0.1)
    cloud = hk.DipolePotential(POINTS, NORMALS, AREAS).with_points(points, NORMALS, AREAS)
    mesh = hk.WindingNumber(old, WITH_HOLES).with_vertices(vertices)
    dr.backward(cloud.value(p) + mesh.value(p))
    assert np.abs(dr.grad(points)).max() > 0.01
    assert np.abs(dr.grad(vertices)).max() > 0.01
    assert np.abs(dr.grad(old)).max() == 0


def test_tensors_are_attached() -> None:
    tensors = {name: TensorXf64(array) for name, array in CLOUD.items()}
    for tensor in tensors.values():
        dr.enable_grad(tensor)
    arrays, p = moving(CLOUD), Array3f64(0.3, 0.2, 0.1)
    for numbers in (tensors, arrays):
        dr.backward(hk.DipolePotential(**numbers).value(p))
    for name in ("points", "normals"):
        np.testing.assert_allclose(dr.grad(tensors[name]), np.array(dr.grad(arrays[name])).T)
    np.testing.assert_allclose(dr.grad(tensors["areas"]), dr.grad(arrays["areas"]))


def test_faces_of_polygon_meshes_move() -> None:
    vertices = Array3f64(CUBE.T)
    dr.enable_grad(vertices)
    dr.backward(hk.PolygonMesh(vertices, SIDES).face(0).value(Array3f64(0.3, 0.2, 0.1)))
    moved = np.abs(np.array(dr.grad(vertices))).max(axis=0) > 1e-3
    np.testing.assert_array_equal(np.flatnonzero(moved), [0, 1, 2, 3])


class Twice(hk.SolidAngle):
    """A class of a user with another function than the class that it is derived from."""

    def evaluate(self, p: Any) -> Any:
        sample = super().evaluate(p)
        return dataclasses.replace(sample, value=2 * sample.value, gradient=2 * sample.gradient)


class TwiceTheCloud(hk.DipolePotential):
    def evaluate(self, p: Any) -> Any:
        sample = super().evaluate(p)
        return dataclasses.replace(sample, value=2 * sample.value, gradient=2 * sample.gradient)


def test_what_would_be_lost_is_refused() -> None:
    """Estimates from what moves; and functions of users whose base class has no derivatives in
    `evaluate`: they were dropped without a word."""
    points, normals, loop = Array3f64(POINTS.T), Array3f64(NORMALS.T), Array3f64(LOOPS["outer"].T)
    dr.enable_grad(points, normals, loop)
    p = Array3f64(0.3, 0.2, 0.1)
    for refused in (
        lambda: hk.DipolePotential(points, NORMALS),
        lambda: hk.DipolePotential(points, "estimate", AREAS),
        lambda: hk.DipolePotential(POINTS, normals),
        lambda: hk.DipolePotential(points, NORMALS, smoothing="auto"),
        lambda: hk.fields.ScreenedWindingNumber(points, NORMALS, length=0.5),
        lambda: Circle(dr.sum(points.x)),
        lambda: hk.SolidAngle(Circle(1.0, (0, 0, dr.sum(points.x)))),
        lambda: Twice(loop).value(p),
        lambda: Twice(loop).gradient(p),
        lambda: hk.trace(Twice(loop), Array3f64(0.1, 0.2, 2.0), Array3f64(0, 0, -1), level=10.0),
        lambda: TwiceTheCloud(points, NORMALS, AREAS).value(p),
        lambda: TwiceTheCloud(points, NORMALS, AREAS).gradient(p),
    ):
        with pytest.raises(NotImplementedError, match="carry derivatives"):
            refused()


@pytest.mark.slow
def test_other_numbers_compile_nothing() -> None:
    """Steps of fields whose numbers move."""
    rng = np.random.default_rng(5)
    o, d = Array3f64([0.0, 0.1, 0.2], 0.1, 3.0), Array3f64(0, 0, -1)

    def step(k: int) -> None:
        for name in ("SolidAngle", "ScreenedWindingNumber", "WindingNumber"):
            arrays, make, level = EXAMPLES[name]
            moved = {key: a * (1 + 0.01 * k) + 1e-3 * k * rng.normal(size=a.shape)
                     for key, a in arrays.items()}  # fmt: skip
            hits = hk.trace(make(**moving(moved)), o, d, level=Float64(level + 0.01 * k))
            dr.backward(dr.sum(dr.select(hits.is_hit, hits.t + hits.normal.x, 0)))

    step(0), step(1)
    assert compiled(lambda: (step(2), step(3))) == 0


def test_sums_over_pairs_by_shared_numbers_and_with_ranges() -> None:
    """A coordinate that all points share, a number that all records share, and records of its own
    for each point."""
    x, r = np.array([[0.1, 0.2, 0.3], [0.1, -0.4, 0.3]]), np.array([1.0, 2.0, 3.0, 4.0])
    first, count = DOUBLE.UInt32([1, 0]), DOUBLE.UInt32([3, 0])

    def term(p: Any, record: Any) -> tuple[Any, ...]:
        return (p.x * p.y * record[0] + p.z * record[0] * record[1],)

    for ranges, pairs in ((None, [(0, 1, 2, 3)] * 2), ((first, count), [(1, 2, 3), ()])):
        shared, factor, numbers = Float64(0.3), Float64(0.5), Float64(r)
        dr.enable_grad(shared, factor, numbers)
        points = Array3f64(Float64(x[:, 0]), Float64(x[:, 1]), shared)
        (sums,) = pair_sum(DOUBLE, term, points, (numbers, factor), ranges)
        expected = [
            sum(r[k] * (p[0] * p[1] + 0.15) for k in ks) for p, ks in zip(x, pairs, strict=True)
        ]
        np.testing.assert_allclose(sums, expected, atol=1e-14)
        dr.backward(dr.sum(sums))
        total = sum(r[k] for ks in pairs for k in ks)
        np.testing.assert_allclose(dr.grad(shared), [0.5 * total])
        np.testing.assert_allclose(dr.grad(factor), [0.3 * total])
        terms = [(p[0] * p[1] + 0.15, ks) for p, ks in zip(x, pairs, strict=True)]
        by_number = [sum(number for number, ks in terms if k in ks) for k in range(4)]
        np.testing.assert_allclose(dr.grad(numbers), by_number)
