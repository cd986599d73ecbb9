"""Derivatives of t by implicit differentiation, against central differences in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.geometry import shapes

DOUBLE = choose_backend("double")
LOOP = shapes.wavy_polygon(12)
TREFOIL = shapes.torus_knot(2, 3, 30)
LEVEL = 2 * math.pi
EYE = np.array([2.2, -2.2, 1.6])

Trace = Callable[[], hk.Hits]


def vector(points: np.ndarray) -> dr.ArrayBase:
    return DOUBLE.Array3f(np.atleast_2d(points).T)


def some_rays(n: int = 40, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from an eye towards points near the origin; directions are not unit."""
    target = np.random.default_rng(seed).uniform(-0.6, 0.6, (n, 3))
    return np.tile(EYE, (n, 1)), target - EYE


def clean_rays(field: hk.Field, levels: list[float], **settings: object) -> tuple[np.ndarray, ...]:
    """Rays whose hit is far from grazing, so that differences are worth comparing with."""
    o, d = some_rays()
    hits = hk.trace(field, o, d, level=levels, precision="double", tolerance=1e-6, **settings)  # type: ignore[arg-type]
    direction = d / np.linalg.norm(d, axis=1, keepdims=True)
    steep = np.abs((hits.normal * direction).sum(axis=1)) > 0.1
    keep = hits.hit & steep
    assert keep.sum() >= 8
    return o[keep], d[keep]


def solve(field: hk.Field, o: np.ndarray, d: np.ndarray, level: object) -> np.ndarray:
    """t to rounding, without any derivative: what differences are taken of."""
    hits = hk.trace(field, o, d, level=level, precision="double", tolerance=1e-13)
    assert hits.hit.all()
    return hits.t


def differences(t: Callable[[float], np.ndarray], step: float = 1e-4) -> np.ndarray:
    """dt/ds at s = 0 of fourth order."""
    return (8 * (t(step) - t(-step)) - (t(2 * step) - t(-2 * step))) / (12 * step)


def agree(found: np.ndarray, expected: np.ndarray) -> None:
    scale = np.abs(expected).max()
    assert scale > 0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * scale)


def numpy(array: dr.ArrayBase) -> np.ndarray:
    return np.array(array).T


@pytest.mark.parametrize("name", ["convex position", "trefoil"])
def test_vertices_forward(name: str) -> None:
    loop = LOOP if name == "convex position" else TREFOIL
    o, d = clean_rays(hk.SolidAngle(loop), [LEVEL])
    motion = np.random.default_rng(1).normal(size=loop.shape)
    vertices = vector(loop)
    dr.enable_grad(vertices)
    dr.set_grad(vertices, vector(motion))
    hits = hk.trace(hk.SolidAngle(vertices), vector(o), vector(d))
    found = numpy(dr.forward_to(hits.t))
    expected = differences(lambda s: solve(hk.SolidAngle(loop + s * motion), o, d, LEVEL))
    agree(found, expected)


def test_vertices_reverse() -> None:
    o, d = clean_rays(hk.SolidAngle(LOOP), [LEVEL])
    weights = np.random.default_rng(2).normal(size=len(o))
    vertices = vector(LOOP)
    dr.enable_grad(vertices)
    hits = hk.trace(hk.SolidAngle(vertices), vector(o), vector(d))
    dr.backward(dr.sum(hits.t * DOUBLE.Float(weights)))
    found = numpy(dr.grad(vertices))
    expected = np.zeros_like(LOOP)
    for i, k in np.ndindex(3, 3):  # the first three vertices
        motion = np.zeros_like(LOOP)
        motion[i, k] = 1
        expected[i, k] = weights @ differences(
            lambda s, motion=motion: solve(hk.SolidAngle(LOOP + s * motion), o, d, LEVEL)
        )
    agree(found[:3], expected[:3])
    # Moving everything by v is moving the origins by -v: all vertices at once.
    for v in np.eye(3):
        shifted = weights @ differences(
            lambda s, v=v: solve(hk.SolidAngle(LOOP), o - s * v, d, LEVEL)
        )
        assert found.sum(axis=0) @ v == pytest.approx(shifted, rel=1e-5)


FIELDS: dict[str, tuple[hk.Field, float]] = {
    "curve": (hk.SolidAngle(LOOP), 2 * math.pi),
    "knot": (hk.SolidAngle(TREFOIL), 1.5),
    "gyroid": (hk.Gyroid(cell=1.5, domain=hk.Ball(radius=1.2)), 0.3),
    "harmonic": (hk.SphericalHarmonic(4, 2), 0.05),
}


@pytest.mark.parametrize("name", FIELDS)
def test_level_forward_and_reverse(name: str) -> None:
    field, level = FIELDS[name]
    o, d = clean_rays(field, [level])
    expected = differences(lambda s: solve(field, o, d, level + s))
    parameter = DOUBLE.Float(level)
    dr.enable_grad(parameter)
    dr.set_grad(parameter, 1)
    agree(numpy(dr.forward_to(hk.trace(field, vector(o), vector(d), level=parameter).t)), expected)

    parameter = DOUBLE.Float(level)
    dr.enable_grad(parameter)
    dr.backward(dr.sum(hk.trace(field, vector(o), vector(d), level=parameter).t))
    agree(numpy(dr.grad(parameter)), np.array([expected.sum()]))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("moved", ["origin", "direction"])
def test_rays_forward_and_reverse(name: str, moved: str) -> None:
    field, level = FIELDS[name]
    o, d = clean_rays(field, [level])
    motion = np.random.default_rng(3).normal(size=o.shape)
    shift = (motion, 0 * motion) if moved == "origin" else (0 * motion, motion)
    expected = differences(lambda s: solve(field, o + s * shift[0], d + s * shift[1], level), 1e-5)

    rays = vector(o), vector(d)
    ray = rays[moved == "direction"]
    dr.enable_grad(ray)
    dr.set_grad(ray, vector(motion))
    agree(numpy(dr.forward_to(hk.trace(field, *rays, level=level).t)), expected)

    rays = vector(o), vector(d)
    ray = rays[moved == "direction"]
    dr.enable_grad(ray)
    dr.backward(hk.trace(field, *rays, level=level).t)
    agree((numpy(dr.grad(ray)) * motion).sum(axis=1), expected)


@pytest.mark.parametrize(
    ("field", "levels"),
    [
        (hk.Gyroid(cell=1.5, domain=hk.Ball(radius=1.2)), [-0.8, 0.1, 0.9]),
        (hk.SolidAngle(LOOP), [1.0, 2 * math.pi, 9.0]),
        # 2 pi + 4 pi is the same level, a period up.
        (hk.SolidAngle(LOOP), [1.0, 6 * math.pi, 9.0]),
    ],
    ids=["gyroid", "curve", "a period up"],
)
def test_each_hit_follows_its_own_level(field: hk.Field, levels: list[float]) -> None:
    """Level k moves with speed k + 1: a hit moves with the speed of the level that it is on."""
    o, d = clean_rays(field, levels)
    parameters = [DOUBLE.Float(level) for level in levels]
    for k, parameter in enumerate(parameters):
        dr.enable_grad(parameter)
        dr.set_grad(parameter, k + 1.0)
    hits = hk.trace(field, vector(o), vector(d), level=parameters)
    found = numpy(dr.forward_to(hits.t))
    moving = [k + 1.0 for k in range(len(levels))]
    expected = differences(
        lambda s: solve(field, o, d, [a + s * b for a, b in zip(levels, moving, strict=True)])
    )
    agree(found, expected)
    value, period = numpy(hits.value), field.period or 1e9
    away = [np.abs(np.remainder(value - a + period / 2, period) - period / 2) for a in levels]
    assert len(set(np.argmin(away, axis=0))) >= 2


def test_misses_have_no_derivative_and_positions_move_with_t() -> None:
    o = np.array([EYE, EYE])
    d = np.array([[-2.1, 2.2, -1.55], [1.0, 0.0, 0.0]])
    origin = vector(o)
    dr.enable_grad(origin)
    hits = hk.trace(hk.SolidAngle(LOOP), origin, vector(d))
    status = numpy(hits.status)
    assert status.tolist() == [hk.Status.HIT, hk.Status.MISS]
    dr.backward(dr.sum(dr.select(hits.hit, hits.position.x, 0)))
    gradient = numpy(dr.grad(origin))
    assert np.isfinite(gradient).all()
    assert (gradient[1] == 0).all()

    def x(s: float) -> np.ndarray:
        start = o[:1] + s * np.array([[0.0, 1.0, 0.0]])
        unit = d[:1] / np.linalg.norm(d[:1])
        return start[:, 0] + solve(hk.SolidAngle(LOOP), start, d[:1], LEVEL) * unit[:, 0]

    assert gradient[0, 1] == pytest.approx(float(differences(x)[0]), rel=1e-5)


def test_nothing_is_attached_where_nothing_was_enabled() -> None:
    hits = hk.trace(hk.SolidAngle(LOOP), vector(EYE), vector(-EYE))
    assert not dr.grad_enabled(hits.t)


def test_the_value_of_t_is_polished_to_rounding() -> None:
    """With derivatives t is a root to rounding, whatever the tolerance."""
    o, d = clean_rays(hk.SolidAngle(LOOP), [LEVEL])
    origin = vector(o)
    dr.enable_grad(origin)
    hits = hk.trace(hk.SolidAngle(LOOP), origin, vector(d), tolerance=1e-3)
    np.testing.assert_allclose(numpy(hits.t), solve(hk.SolidAngle(LOOP), o, d, LEVEL), atol=1e-9)
