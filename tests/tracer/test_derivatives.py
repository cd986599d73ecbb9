"""Derivatives of t by implicit differentiation, against central differences in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.geometry import example_curves, example_meshes

DOUBLE = choose_backend("double")
LOOP = example_curves.wavy_polygon(12)
TREFOIL = example_curves.torus_knot(2, 3, 30)
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
    keep = hits.is_hit & steep
    assert keep.sum() >= 8
    return o[keep], d[keep]


def solve(field: hk.Field, o: np.ndarray, d: np.ndarray, level: object) -> np.ndarray:
    """t to rounding, without any derivative: what differences are taken of."""
    hits = hk.trace(field, o, d, level=level, precision="double", tolerance=1e-13)
    assert hits.is_hit.all()
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


@pytest.mark.few(1)
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


@pytest.mark.slow
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


@pytest.mark.few(1)
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


@pytest.mark.few(1)
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


@pytest.mark.few(1)
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


@pytest.mark.slow
def test_misses_have_no_derivative_and_positions_move_with_t() -> None:
    o = np.array([EYE, EYE])
    d = np.array([[-2.1, 2.2, -1.55], [1.0, 0.0, 0.0]])
    origin = vector(o)
    dr.enable_grad(origin)
    hits = hk.trace(hk.SolidAngle(LOOP), origin, vector(d))
    status = numpy(hits.status)
    assert status.tolist() == [hk.RayStatus.HIT, hk.RayStatus.MISS]
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.position.x, 0)))
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


# Flat faces, edges and ties of formulas.

TALL, CAN = hk.Cuboid((1.0, 1.0, 4.0)), hk.Cylinder(0.4, 2.8)
SOLIDS: dict[str, hk.solids.Solid] = {
    "union, moved and rotated": (TALL | CAN.rotated(70, "x")).translated((0.1, 0.2, 0)).rotated(20),
    "cuboid": TALL,
    "cylinder": CAN,
    "difference": TALL - CAN.rotated(50, (1, 1, 0)),
    "intersection": TALL & CAN.translated((0.2, 0, 0.1)),
    "grown": CAN.offset(0.1),
}


def rays_at(size: float, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 4 / np.linalg.norm(o, axis=1, keepdims=True)
    return o, rng.uniform(-size, size, (n, 3)) - o


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        one if one.startswith("union") else pytest.param(one, marks=pytest.mark.slow)
        for one in SOLIDS
    ],
)
def test_hits_on_faces_and_edges_of_solids(name: str) -> None:
    """By rays and by the level, in reverse mode: extrema tie at every hit of a flat face."""
    solid = SOLIDS[name]
    o, d = rays_at(0.6, 400, 4)
    motion = np.random.default_rng(5).normal(size=o.shape)
    h = 1e-6

    def at(s: float, level: float) -> hk.Hits:
        start = o + s * motion
        return hk.trace(solid, start, d, level=level, precision="double", tolerance=1e-13)

    ends = [at(h, 0.0), at(-h, 0.0), at(0.0, h), at(0.0, -h)]
    moved, lifted = ((a.t - b.t) / (2 * h) for a, b in (ends[:2], ends[2:]))
    # Where both ends of a difference lie on one face, which is not seen from its edge.
    normals = np.array([one.normal for one in ends])
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    good = np.all([one.is_hit for one in ends], axis=0) & (np.ptp(normals, axis=0) < 1e-5).all(
        axis=1
    )
    good &= np.abs((normals[0] * unit).sum(axis=1)) > 0.1
    assert good.sum() > 100
    origin, level = vector(o), DOUBLE.Float(np.zeros(len(o)))
    dr.enable_grad(origin)
    hits = hk.trace(solid, origin, vector(d))
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.t, 0)))
    found = (numpy(dr.grad(origin)) * motion).sum(axis=1)
    np.testing.assert_allclose(found[good], moved[good], rtol=1e-5, atol=1e-5)
    level = DOUBLE.Float(0)
    dr.enable_grad(level)
    dr.set_grad(level, 1)
    found = numpy(dr.forward_to(hk.trace(solid, vector(o), vector(d), level=level).t))
    np.testing.assert_allclose(found[good], lifted[good], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_gradients_at_ties_are_those_of_one_side(precision: str) -> None:
    tolerance = 1e-5 if precision == "single" else 1e-13
    found = TALL.gradient([[0.1, 0.2, 2], [0.5, 0.2, 1], [0.1, 0.2, -2]], precision=precision)
    np.testing.assert_allclose(found, [[0, 0, 1], [1, 0, 0], [0, 0, -1]], atol=tolerance)
    # Edges, corners, planes of symmetry, the middle: some face of those that meet there.
    tied = [[0.5, 0.5, 1], [0.5, 0.5, 2], [0.2, 0.2, 0], [0, 0, 0], [0, 0, 0.5], [0.5, 0, 2]]
    found = np.abs(TALL.gradient(tied, precision=precision))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=tolerance)
    diamond = hk.expression(lambda x, y, z: abs(x) + abs(y) + abs(z))
    found = np.abs(diamond.gradient([[0, 0, 0], [0, 0.3, 0], [1, 0, 2]], precision=precision))
    np.testing.assert_allclose(found, 1, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(hk.Sphere(1.0).gradient([0, 0, 0])), 1, atol=1e-5)


# Fields whose evaluation is a loop, a tree or a look at sheets.


def test_hits_of_clouds_are_those_of_the_whole_sum() -> None:
    """t, and its derivative in reverse mode, against a sum over all points."""
    x = example_meshes.icosphere(3)[0]
    areas = np.full(len(x), 4 * math.pi / len(x))
    o, d = rays_at(0.6, 60, 1)
    origin = vector(o)
    dr.enable_grad(origin)
    cloud = hk.DipolePotential(x, x, areas)
    hits = hk.trace(cloud, origin, vector(d), level=0.5, tolerance=1e-4)
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.t, 0)))
    hit = np.array(hits.is_hit)
    assert hit.sum() > 20
    away = numpy(dr.detach(hits.position))[hit][:, None] - x
    r, along = np.linalg.norm(away, axis=2)[..., None], (away * x).sum(axis=2)[..., None]
    share = areas[:, None]
    value = np.abs((along / r**3 * share).sum(axis=(1, 2)))
    np.testing.assert_allclose(value, 0.5, atol=1e-10)
    gradient = ((x / r**3 - 3 * along / r**5 * away) * share).sum(axis=1)
    unit = (d / np.linalg.norm(d, axis=1, keepdims=True))[hit]
    expected = -gradient / (gradient * unit).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(numpy(dr.grad(origin))[hit], expected, rtol=1e-9, atol=1e-9)


OF_LOOPS: dict[str, tuple[Callable[[], hk.Field], float]] = {
    "Julia set": (lambda: hk.solids.Julia(), 0.0),
    "closed mesh": (lambda: hk.WindingNumber(*example_meshes.icosphere(1)), 0.5),
    "mesh by tree": (lambda: hk.WindingNumber(*example_meshes.icosphere(2), method="tree"), 0.5),
    "cloud of spheres": (lambda: hk.Blobs(LOOP, 0.5), 1.0),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", OF_LOOPS)
def test_reverse_mode_passes_every_field(name: str) -> None:
    """Hits, and values at points, whose derivatives are those of the normal and the gradient."""
    make, level = OF_LOOPS[name]
    field = make()
    o, d = rays_at(0.5, 40, 2)
    origin = vector(o)
    dr.enable_grad(origin)
    hits = hk.trace(field, origin, vector(d), level=level)
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.t, 0)))
    hit, normal = np.array(hits.is_hit), numpy(dr.detach(hits.normal))
    assert hit.sum() > 8
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    slope = (normal * unit).sum(axis=1, keepdims=True)
    expected = (-normal[hit]) / slope[hit]
    np.testing.assert_allclose(numpy(dr.grad(origin))[hit], expected, rtol=1e-9, atol=1e-9)
    points = vector(0.6 * o)
    dr.enable_grad(points)
    dr.backward(dr.sum(field.value(points)))
    expected = field.gradient(0.6 * o, precision="double")
    np.testing.assert_allclose(numpy(dr.grad(points)), expected, rtol=1e-9, atol=1e-12)


def test_values_of_hits_move_with_the_level_alone() -> None:
    from drjit.llvm.ad import Array3f64, Float64

    x, level, radius = Float64([0.3, 3.0]), Float64(0.1), Float64(0.9)
    dr.enable_grad(x, level, radius)
    surface = hk.Sphere(radius)
    hits = hk.trace(surface, Array3f64(x, 0.0, 3.0), Array3f64(0, 0, -1), level=level)
    dr.backward(dr.select(hits.is_hit, hits.value, 0))
    np.testing.assert_allclose(dr.grad(level), [1.0])
    assert not np.any(dr.grad(x))
    assert not np.any(dr.grad(radius))
    hits = hk.trace(surface, Array3f64(x, 0.0, 3.0), Array3f64(0, 0, -1), level=level)
    with pytest.raises(NotImplementedError, match="but at smooth hits"):
        dr.backward(hits.value)
