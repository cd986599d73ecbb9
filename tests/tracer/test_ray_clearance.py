"""How near rays that miss came to the surface: against dense samples in NumPy, and derivatives
against differences of fourth order."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.geometry import example_curves, example_meshes
from harnack.tracer import ClearanceHits

DOUBLE = choose_backend("double")
LOOP = example_curves.wavy_polygon(12)
KNOT = example_curves.torus_knot(2, 3, 30)
SPHERE = hk.Sphere(1.0)

FIELDS: dict[str, tuple[hk.Field, list[float]]] = {
    "union": (hk.Sphere(0.7) | hk.Sphere(0.5).translated((1, 0, 0)), [0.0]),
    "torus": (hk.solids.Torus(1.0, 0.3), [0.0]),
    "curve": (hk.SolidAngle(LOOP), [2 * math.pi]),
    "two levels": (hk.SolidAngle(KNOT), [2 * math.pi, 1.0]),
    "polynomial": (hk.SphericalHarmonic(4, 2), [0.05]),
    "gyroid": (hk.Gyroid(cell=1.5, domain=hk.Ball(radius=0.6)), [1.0]),
}


def vector(points: Any) -> Any:
    return DOUBLE.Array3f(np.atleast_2d(points).T)


def rays(n: int = 60, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Rays from a sphere of radius 3, about half of which miss what lies in the unit ball.
    Directions are not unit."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    return o, rng.uniform(-1.5, 1.5, (n, 3)) - o


def clearances(field: hk.Field, o: np.ndarray, d: np.ndarray, level: Any) -> np.ndarray:
    hits = hk.trace(field, o, d, level=level, clearance=True)
    assert isinstance(hits, ClearanceHits)
    return hits.clearance


def differences(e: Callable[[float], np.ndarray], step: float = 1e-4) -> np.ndarray:
    """de/ds at s = 0 of fourth order."""
    with np.errstate(invalid="ignore"):  # infinite ones
        return (8 * (e(step) - e(-step)) - (e(2 * step) - e(-2 * step))) / (12 * step)


def agree(measured: Any, expected: np.ndarray, rows: np.ndarray) -> None:
    """Clearances of some rays have the derivatives of differences, and those of others 0."""
    measured = np.array(measured)
    scale = np.abs(expected[rows]).max()
    assert scale > 0
    np.testing.assert_allclose(measured[rows], expected[rows], atol=1e-6 * scale)
    assert (measured[~rows] == 0).all()


# --- values ---------------------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize("name", FIELDS)
def test_clearances_are_the_least_of_dense_samples(name: str) -> None:
    field, levels = FIELDS[name]
    o, d = rays()
    hits = hk.trace(field, o, d, level=levels, clearance=True)
    plain = hk.trace(field, o, d, level=levels)
    for attribute, array in vars(plain).items():
        np.testing.assert_array_equal(getattr(hits, attribute), array)
    t = np.linspace(0, 8, 4001)
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    points = (o[:, None] + t[:, None] * unit[:, None]).reshape(-1, 3)
    offsets = field.value(points)[:, None] - levels
    if field.period is not None:
        offsets -= field.period * np.round(offsets / field.period)
    e = np.abs(offsets).min(axis=1) / np.linalg.norm(field.gradient(points), axis=1)
    if field.domain is not None:
        e[~field.domain.contains_points(points)] = np.inf
    expected = np.where(hits.is_hit, 0, e.reshape(len(o), -1).min(axis=1))
    assert (hits.clearance > 0).sum() > 5
    meets = np.isfinite(expected)
    assert np.isfinite(hits.clearance[meets]).all()
    # Never below the least of the ray; and samples in NumPy are 0.002 apart.
    measured, expected = hits.clearance[meets], expected[meets]
    assert (measured <= expected * (1 + 1e-6)).all()
    assert (measured >= expected - 0.06 * expected.clip(0, 0.1)).all()
    # It is met at the point that is given.
    away = (hits.clearance > 0) & np.isfinite(hits.clearance)
    offsets = field.value(hits.nearest_point[away])[:, None] - levels
    if field.period is not None:
        offsets -= field.period * np.round(offsets / field.period)
    length = np.linalg.norm(field.gradient(hits.nearest_point[away]), axis=1)
    np.testing.assert_allclose(
        np.abs(offsets).min(axis=1) / length, hits.clearance[away], rtol=1e-9
    )
    np.testing.assert_array_equal(hits.nearest_point[hits.is_hit], plain.position[hits.is_hit])


def test_rays_that_meet_no_extent_have_a_clearance() -> None:
    o = [[3.0, 0, 5], [0, 0, 3], [0, 0, 3], [0, 0, 3]]
    d = [[0.0, 0, -1], [0, 0, 2], [0, 0, -1], [0.0, 0, -1]]
    hits = hk.trace(SPHERE, o, d, t_max=[np.inf, np.inf, 1.5, np.inf], clearance=True)
    np.testing.assert_allclose(hits.clearance, [2, 2, 0.5, 0], rtol=1e-5)  # single precision
    expected = [[3, 0, 0], [0, 0, 3], [0, 0, 1.5], [0, 0, 1]]
    np.testing.assert_allclose(hits.nearest_point, expected, atol=2e-3)
    # What lies outside of a clip cannot be hit there.
    clip = hk.Ball(radius=0.5)
    hits = hk.trace(SPHERE, [[0.2, 0, 3], [0.6, 0, 3]], [[0, 0, -1]], clip=clip, clearance=True)
    np.testing.assert_allclose(hits.clearance, [0.5, np.inf], rtol=2e-5)
    assert np.isnan(hits.nearest_point[1]).all()


def test_a_plane_has_no_extent() -> None:
    plane = hk.solids.Plane((0, 0, 1), 0.0)
    o, d = [[0.0, 0, 1], [0, 0, 0.5]], [[1.0, 0, 0], [1, 0, 0.1]]
    np.testing.assert_allclose(hk.trace(plane, o, d, clearance=True).clearance, [1, 0.5])


def test_kinds_of_arrays() -> None:
    o, d = rays(5)
    single = hk.trace(SPHERE, o, d, precision="single", clearance=True)
    assert single.clearance.dtype == single.nearest_point.dtype == np.float32
    assert single.clearance.shape == (5,)
    empty = hk.trace(SPHERE, o[:0], d[:0], clearance=True)
    assert empty.clearance.shape == (0,)
    assert empty.nearest_point.shape == (0, 3)
    tensor = dr.tensor_t(DOUBLE.Array3f)
    tensors = [tensor(array) for array in (o, d)]
    measured = hk.trace(SPHERE, *tensors, clearance=True)
    expected = hk.trace(SPHERE, o, d, clearance=True)
    assert measured.nearest_point.shape == (5, 3)
    np.testing.assert_array_equal(measured.clearance.numpy(), expected.clearance)


def test_what_is_refused_by_name() -> None:
    ray = np.array([[0.0, 0, 3]]), np.array([[0.0, 0, -1]])
    with pytest.raises(ValueError, match="leave out largest"):
        hk.trace(SPHERE, *ray, largest=True, clearance=True)
    with pytest.raises(ValueError, match=r'clearance=True is not measured with backend="webgpu"'):
        hk.trace(SPHERE, *ray, backend="webgpu", clearance=True)
    with pytest.raises(TypeError, match="clearance"):
        hk.trace(SPHERE, *ray, clearance=1)  # type: ignore[arg-type]
    mesh = hk.WindingNumber(*example_meshes.icosphere(1))
    with pytest.raises(NotImplementedError, match="clearance=True takes a field without jumps"):
        hk.trace(mesh, *ray, clearance=True)
    square = hk.PolygonMesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]], [[0, 1, 2, 3]])
    with pytest.raises(NotImplementedError, match=r"mesh\.face\(0\)"):
        hk.trace(square, *ray, clearance=True)
    end = DOUBLE.Float(2.0)
    dr.enable_grad(end)
    with pytest.raises(NotImplementedError, match="a trace with clearance=True"):
        hk.trace(SPHERE, vector(ray[0]), vector(ray[1]), t_max=end, clearance=True)
    with pytest.raises(AttributeError, match=r"'clearance': call trace\(\.\.\., clearance=True\)"):
        _ = hk.trace(SPHERE, *ray).clearance  # type: ignore[attr-defined]


# --- derivatives ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("loop", [LOOP, KNOT], ids=["convex position", "knot"])
def test_derivatives_by_vertices(loop: np.ndarray) -> None:
    o, d = rays(40)
    motion = np.random.default_rng(2).normal(size=loop.shape)
    expected = differences(
        lambda s: clearances(hk.SolidAngle(loop + s * motion), o, d, 2 * math.pi)
    )
    vertices = vector(loop)
    dr.enable_grad(vertices)
    dr.set_grad(vertices, vector(motion))
    hits = hk.trace(hk.SolidAngle(vertices), vector(o), vector(d), clearance=True)
    misses = ~np.array(hits.is_hit)
    agree(dr.forward_to(hits.clearance), expected, misses)

    vertices = vector(loop)
    dr.enable_grad(vertices)
    hits = hk.trace(hk.SolidAngle(vertices), vector(o), vector(d), clearance=True)
    dr.backward(dr.sum(hits.clearance))
    gradient = np.array(dr.grad(vertices)).T
    assert (gradient * motion).sum() == pytest.approx(expected[misses].sum(), rel=1e-6)


@pytest.mark.few(2)
@pytest.mark.parametrize("moved", ["level", "origin", "direction"])
@pytest.mark.parametrize("name", [name for name in FIELDS if name != "two levels"])
def test_derivatives_by_levels_and_rays(name: str, moved: str) -> None:
    """Of the polynomial and the gyroid, some rays come nearest on the boundary of the domain."""
    field, (level,) = FIELDS[name]
    o, d = rays()
    motion = np.random.default_rng(3).normal(size=o.shape)
    on_ray, on_level = (0, 1) if moved == "level" else (1, 0)
    shift = [motion * on_ray * (moved == name) for name in ("origin", "direction")]
    expected = differences(
        lambda s: clearances(field, o + s * shift[0], d + s * shift[1], level + s * on_level)
    )
    arguments = [vector(o), vector(d), DOUBLE.Float(level)]
    index = ("origin", "direction", "level").index(moved)
    dr.enable_grad(arguments[index])
    dr.set_grad(arguments[index], 1 if moved == "level" else vector(motion))
    hits = hk.trace(field, arguments[0], arguments[1], level=arguments[2], clearance=True)
    measured = np.array(dr.forward_to(hits.clearance))
    away = ~np.array(hits.is_hit) & np.isfinite(expected)
    assert away.sum() > 2
    agree(measured, expected, away)


class _MovedBall(hk.Field):
    """f = |p - center|^2 - 1 + tilt xyz, by parameters of a user's class: |grad f| depends on
    them."""

    traits = hk.fields.Traits(has_parameter_derivatives=True)

    def __init__(self, x: Any, tilt: Any) -> None:
        self.x, self.tilt = x, tilt

    def extent(self, levels: tuple[float, ...]) -> hk.Ball:
        del levels
        return hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        real = type(p.x)
        q = type(p)(p.x - real(self.x), p.y, p.z)
        value = dr.dot(q, q) - 1 + real(self.tilt) * p.x * p.y * p.z
        products = type(p)(p.y * p.z, p.x * p.z, p.x * p.y)
        gradient = 2 * q + real(self.tilt) * products
        return hk.fields.Sample(value, gradient, (hk.enclosures.Lipschitz(real(60), real(4)),))


@pytest.mark.slow
def test_derivatives_by_parameters_include_those_of_the_gradient() -> None:
    o, d = rays(40)
    measured = []
    for k in range(2):
        numbers = [DOUBLE.Float(0.1), DOUBLE.Float(0.3)]
        dr.enable_grad(numbers[k])
        dr.set_grad(numbers[k], 1)
        hits = hk.trace(_MovedBall(*numbers), vector(o), vector(d), clearance=True)
        measured.append(np.array(dr.forward_to(hits.clearance)))
    misses = ~np.array(hits.is_hit)
    for k, (dx, dtilt) in enumerate([(1, 0), (0, 1)]):
        expected = differences(
            lambda s, dx=dx, dtilt=dtilt: clearances(
                _MovedBall(0.1 + s * dx, 0.3 + s * dtilt), o, d, 0.0
            )
        )
        agree(measured[k], expected, misses)


@pytest.mark.slow
def test_derivatives_by_numbers_of_formulas_and_solids() -> None:
    o, d = rays(40)

    def drop(a: Any) -> hk.Field:
        formula = lambda x, y, z, a: x * x + y * y + a * z * z - 0.3 * a * x * y * z - 0.6  # noqa: E731
        return hk.expression(formula, a=a, domain=hk.Ball(radius=2.0))

    def snowman(a: Any) -> hk.Field:
        return hk.Sphere(a) | hk.Sphere(0.3).translated((0, 0, a))

    for make in drop, snowman:
        number = DOUBLE.Float(0.6)
        dr.enable_grad(number)
        dr.set_grad(number, 1)
        hits = hk.trace(make(number), vector(o), vector(d), clearance=True)
        expected = differences(lambda s, make=make: clearances(make(0.6 + s), o, d, 0.0))
        away = ~np.array(hits.is_hit) & np.isfinite(expected)
        assert away.sum() > 5
        agree(dr.forward_to(hits.clearance), expected, away)


def test_the_point_has_no_derivative() -> None:
    origin = vector([2.0, 0, 3])
    dr.enable_grad(origin)
    hits = hk.trace(SPHERE, origin, vector([0, 0, -1.0]), clearance=True)
    with pytest.raises(NotImplementedError, match="nearest_point of hits"):
        dr.backward(hits.nearest_point.x)
    origin = vector([2.0, 0, 3])
    dr.enable_grad(origin)
    hits = hk.trace(SPHERE, origin, vector([0, 0, -1.0]), clearance=True)
    dr.backward(hits.clearance)
    np.testing.assert_allclose(np.array(origin.grad).ravel(), [1, 0, 0], atol=1e-7)
