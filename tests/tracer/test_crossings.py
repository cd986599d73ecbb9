"""All crossings of rays, and hits that must cross: each crossing once, none missed, no graze."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import FloatArray, choose_backend
from harnack.enclosures import Lipschitz, TaylorRemainder
from harnack.fields.field import Field, Sample
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere
from harnack.tracer.level_contact import cubic_root

PRECISIONS = ("single", "double")
BALL = hk.Ball(radius=1.5)
# Samples of the oracle along a ray.
_MANY = 8001


class Sphere(Field):
    """|p| - 1, of which only the Lipschitz constant is known."""

    def evaluate(self, p: Any) -> Sample:
        distance = dr.norm(p)
        return Sample(distance - 1.0, p / distance, (Lipschitz(1.0),))


class Wave(Field):
    """cos(k x), with its second derivative."""

    def __init__(self, k: float = 5.0) -> None:
        self.k = k

    def evaluate(self, p: Any) -> Sample:
        s, c = dr.sincos(self.k * p.x)
        zero = dr.zeros(type(s))
        return Sample(c, type(p)(-self.k * s, zero, zero), (TaylorRemainder(self.k**2),))


def rays(n: int, seed: int = 0, distance: float = 2.5) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= distance / np.linalg.norm(o, axis=1)[:, None]
    d = 0.5 * rng.normal(size=(n, 3)) - o
    return o, d / np.linalg.norm(d, axis=1)[:, None]


def alternations(f: FloatArray, level: float, w: float | FloatArray) -> int:
    """How often f, in order, goes from more than w on one side of a level to so much beyond it."""
    side = np.sign(np.where(np.abs(f - level) > w, f - level, 0))
    return int(np.count_nonzero(np.diff(side[side != 0])))


def gyroid(p: FloatArray) -> FloatArray:
    x, y, z = 2 * np.pi * p.T
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


def quintic(p: FloatArray) -> FloatArray:
    x, y, z = p.T
    return x * (x**4 - 10 * x**2 * y**2 + 5 * y**4) + 2 * x * y * z - z * (x * x - y * y)


POLYNOMIAL = {
    (5, 0, 0): 1.0, (3, 2, 0): -10.0, (1, 4, 0): 5.0, (1, 1, 1): 2.0, (2, 0, 1): -1.0,
    (0, 2, 1): 1.0,
}  # fmt: skip


def waves(p: FloatArray) -> FloatArray:
    x, y, z = p.T
    return np.sin(3 * x + 2 * y) + np.cos(4 * z - x) - 0.7 * np.sin(5 * y)


CASES: dict[str, tuple[Any, Any, tuple[float, ...], float]] = {
    "gyroid": (hk.Gyroid(1.0, domain=BALL), gyroid, (0.3,), 12.0),
    "levels": (hk.Gyroid(1.0, domain=BALL), gyroid, (-0.5, 0.0, 0.02, 0.9), 12.0),
    "polynomial": (hk.HarmonicPolynomial(POLYNOMIAL, domain=BALL), quintic, (0.2,), 60.0),
    "waves": (
        hk.fields.EigenfunctionSum(
            [
                hk.fields.PlaneWave(1.0, (3, 2, 0), -np.pi / 2),
                hk.fields.PlaneWave(1.0, (-1, 0, 4)),
                hk.fields.WaveProduct(-0.7, y=hk.fields.sine_factor(5.0)),
            ],
            domain=BALL,
        ),
        waves, (0.1, -0.4), 12.0,
    ),
}  # fmt: skip


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CASES)
def test_crossings_are_those_of_a_dense_oracle(name: str, precision: Any) -> None:
    field, function, levels, steepness = CASES[name]
    n, k, tolerance = 150, 60, 1e-4
    o, d = rays(n, distance=1.4)
    crossings = hk.crossings(
        field, o, d, level=levels, max_crossings=k, t_max=2.5, clip=BALL, tolerance=tolerance,
        precision=precision,
    )  # fmt: skip
    t = np.linspace(0, 2.5, _MANY)
    assert 1 < crossings.count.mean() < k
    assert (crossings.status == hk.RayStatus.MISS).all()
    assert (crossings.traced_to == np.inf).all()
    for i in range(n):
        p = o[i] + t[:, None] * d[i]
        f = function(p[(p * p).sum(axis=1) <= 1.5**2])
        least = sum(alternations(f, level, steepness * tolerance) for level in levels)
        most = sum(alternations(f, level, 0.0) for level in levels)
        assert least <= crossings.count[i] <= most
    at = np.isfinite(crossings.t)
    np.testing.assert_array_equal(at.sum(axis=1), crossings.count)
    assert (np.diff(np.where(at, crossings.t, 9.0 + np.arange(k)), axis=1) > 0).all()
    # They lie on a level, and f passes it to the side that is named.
    ray = np.nonzero(at)[0]
    where = crossings.position[at].astype(float)
    off = function(where)[:, None] - np.array(levels)
    assert (np.abs(off).min(axis=1) < steepness * (2e-5 if precision == "single" else 1e-6)).all()
    h = 1e-4
    rise = function(where + h * d[ray]) - function(where - h * d[ray])
    clear = np.abs(rise) > 1e-2 * h * steepness
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(np.sign(rise[clear]), crossings.side[at][clear])
    gradient = np.stack(
        [function(where + h * e) - function(where - h * e) for e in np.eye(3)], axis=1
    )
    norm = np.linalg.norm(gradient, axis=1)
    aligned = (gradient * crossings.normal[at]).sum(axis=1) / norm
    assert (aligned[norm > 1e-2 * h * steepness] > 0.999).all()
    assert (crossings.side[~at] == 0).all()
    assert np.isnan(crossings.position[~at]).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("level", [2 * math.pi, (0.5, 1.5, 2 * math.pi, 9.0)])
def test_the_ladder_of_an_angle_is_climbed_rung_by_rung(level: Any, precision: Any) -> None:
    field, tolerance = hk.SolidAngle(example_curves.wavy_polygon(12)), 1e-3
    o, d = rays(150, seed=3, distance=3.0)
    crossings = hk.crossings(
        field,
        o,
        d,
        level=level,
        max_crossings=30,
        t_max=6,
        tolerance=tolerance,
        precision=precision,
    )
    assert (crossings.status == hk.RayStatus.MISS).all()
    t, wrong = np.linspace(0, 6, 6001), 0
    for i in range(len(o)):
        p = o[i] + t[:, None] * d[i]
        f = np.unwrap(field.value(p, precision="double"), period=4 * math.pi)
        steep = np.linalg.norm(field.gradient(p, precision="double"), axis=1).max()
        rungs = [one + 4 * math.pi * m for one in np.atleast_1d(level) for m in range(-3, 3)]
        least = sum(alternations(f, rung, tolerance * steep) for rung in rungs)
        most = sum(alternations(f, rung, 0.0) for rung in rungs)
        wrong += not least <= crossings.count[i] <= most
        # Up and down in order: a rung that is climbed is there to be left again.
        if np.ndim(level) == 0:
            turns = round((f[-1] - f[0]) / (4 * math.pi))
            assert abs(crossings.side[i].sum() - turns) <= 1
    assert wrong == 0
    assert 0.3 < crossings.count.mean() < 10


@pytest.mark.slow
def test_rays_that_begin_where_the_extent_does_are_seen_from_outside() -> None:
    """The 2 pi level of a flat curve is the disc that it bounds: it has no inside to start from."""
    field = hk.SolidAngle(np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]))
    rng = np.random.default_rng(5)
    o = rng.uniform(-0.8, 0.8, (300, 3)) + np.array([0, 0, 2])
    d = np.column_stack([rng.uniform(-0.8, 0.8, (300, 2)), np.zeros(300)]) - o
    for precision in PRECISIONS:
        crossings = hk.crossings(field, o, d, max_crossings=3, tolerance=1e-2, precision=precision)
        assert (crossings.count == 1).all()
        np.testing.assert_allclose(crossings.position[:, 0, 2], 0, atol=2e-6)
        upwards = hk.crossings(field, -o, -d, max_crossings=3, tolerance=1e-2, precision=precision)
        np.testing.assert_array_equal(crossings.side[:, 0], -upwards.side[:, 0])


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_sphere_is_entered_and_left(precision: Any) -> None:
    o, d = rays(300)
    crossings = hk.crossings(
        Sphere(), o, d, max_crossings=4, t_max=9, tolerance=1e-4, precision=precision
    )
    b = -(o * d).sum(axis=1)
    c = b * b - (o * o).sum(axis=1) + 1
    hit = c > 1e-3
    np.testing.assert_array_equal(crossings.count[hit], 2)
    np.testing.assert_array_equal(crossings.count[c < 0], 0)
    np.testing.assert_array_equal(crossings.side[hit, :2], np.tile([-1, 1], (hit.sum(), 1)))
    exact = b[hit, None] + np.sqrt(c[hit, None]) * np.array([-1, 1])
    np.testing.assert_allclose(crossings.t[hit, :2], exact, atol=2e-6)
    np.testing.assert_allclose(crossings.normal[hit, :2], crossings.position[hit, :2], atol=2e-5)


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("over_relaxation", [1.0, 1.4])
def test_rays_that_graze_do_not_stick(precision: Any, over_relaxation: float) -> None:
    tolerance = 1e-3
    off = tolerance * np.array([-50, -4, -1.2, -0.4, -0.1, 0, 0.1, 0.5, 0.9, 1.1, 4])
    o = np.column_stack([np.full(11, -3.0), 1 + off, np.zeros(11)])
    d = np.tile([1.0, 0, 0], (11, 1))
    settings: dict[str, Any] = {
        "tolerance": tolerance, "t_max": 6.0, "precision": precision,
        "over_relaxation": over_relaxation,
    }  # fmt: skip
    crossings = hk.crossings(Sphere(), o, d, max_crossings=9, **settings)
    np.testing.assert_array_equal(crossings.count[:3], 2)
    assert set(crossings.count[3:5]) <= {0, 2}
    np.testing.assert_array_equal(crossings.count[5:], 0)
    assert (crossings.status == hk.RayStatus.MISS).all()
    # |f| stays within the tolerance for a length of 0.09, of which a step is 1/5 of it or more.
    assert crossings.evaluations.max() < 600
    plain = hk.trace(Sphere(), o, d, **settings)
    sure = hk.trace(Sphere(), o, d, require_crossing=True, **settings)
    np.testing.assert_array_equal(plain.is_hit, off <= tolerance)
    np.testing.assert_array_equal(sure.is_hit, crossings.count > 0)
    np.testing.assert_array_equal(sure.t[sure.is_hit], crossings.t[sure.is_hit, 0])


def test_a_ray_along_the_surface_runs_out_of_steps_or_is_proved() -> None:
    """With a Lipschitz constant alone, steps along a plane are as short as the tolerance."""

    class Plane(Field):
        def __init__(self, curvature: float | None) -> None:
            self.curvature = curvature

        def evaluate(self, p: Any) -> Sample:
            known = Lipschitz(1.0) if self.curvature is None else TaylorRemainder(self.curvature)
            return Sample(p.z, type(p)(0, 0, 1), (known,))

    o, d = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    lost = hk.crossings(
        Plane(None), o, d, max_crossings=2, t_max=50.0, tolerance=1e-3, max_steps=300
    )
    assert (lost.status[0], lost.count[0]) == (hk.RayStatus.OUT_OF_STEPS, 0)
    assert 0.05 < lost.traced_to[0] < 1
    proved = hk.crossings(Plane(1e-3), o, d, max_crossings=2, t_max=50.0, tolerance=1e-3)
    assert (proved.status[0], proved.count[0]) == (hk.RayStatus.MISS, 0)
    assert proved.evaluations[0] < 100


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_ray_that_starts_on_the_surface_leaves_it_uncounted(precision: Any) -> None:
    rng = np.random.default_rng(1)
    n = rng.normal(size=(400, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    d = rng.normal(size=(400, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    crossings = hk.crossings(
        Sphere(), n, d, max_crossings=4, t_max=9, tolerance=1e-4, precision=precision
    )
    inwards = (n * d).sum(axis=1)
    enters, leaves = inwards < -0.02, inwards > 0.02
    np.testing.assert_array_equal(crossings.count[enters], 1)
    np.testing.assert_array_equal(crossings.side[enters, 0], 1)
    np.testing.assert_allclose(crossings.t[enters, 0], -2 * inwards[enters], atol=2e-6)
    np.testing.assert_array_equal(crossings.count[leaves], 0)
    assert (crossings.count <= 1).all()


def test_the_first_k_are_the_first_of_all() -> None:
    field, (o, d) = hk.Gyroid(1.0, domain=BALL), rays(200)
    every = hk.crossings(field, o, d, max_crossings=40)
    for k in (1, 2, 5):
        first = hk.crossings(field, o, d, max_crossings=k)
        assert first.t.shape == (200, k)
        assert first.position.shape == first.normal.shape == (200, k, 3)
        np.testing.assert_array_equal(first.t, every.t[:, :k])
        np.testing.assert_array_equal(first.side, every.side[:, :k])
        np.testing.assert_array_equal(first.count, np.minimum(every.count, k))
        full = every.count >= k
        np.testing.assert_array_equal(first.status[full], hk.RayStatus.HIT)
        np.testing.assert_array_equal(first.status[~full], hk.RayStatus.MISS)
        assert (first.traced_to[full] > first.t[full, -1]).all()
        assert (first.evaluations <= every.evaluations).all()


def test_steps_are_for_all_of_the_ray() -> None:
    crossings = hk.crossings(
        Wave(), [[0.0, 0, 0]], [[1.0, 0, 0]], max_crossings=40, t_max=20.0, max_steps=25
    )
    whole = hk.crossings(Wave(), [[0.0, 0, 0]], [[1.0, 0, 0]], max_crossings=40, t_max=20.0)
    assert crossings.status[0] == hk.RayStatus.OUT_OF_STEPS
    assert 25 <= crossings.evaluations[0] <= 26
    n = crossings.count[0]
    assert 1 <= n < whole.count[0] == 32
    np.testing.assert_array_equal(crossings.t[0, :n], whole.t[0, :n])
    assert crossings.t[0, n - 1] < crossings.traced_to[0] < whole.t[0, n + 1]
    np.testing.assert_allclose(whole.t[0, :32], (np.arange(32) + 0.5) * math.pi / 5, atol=4e-6)


def test_levels_closer_than_the_tolerance_are_told_apart() -> None:
    o, d = [[-2.0, 0, 0]], [[1.0, 0, 0]]
    crossings = hk.crossings(
        Sphere(), o, d, level=(0.0, 1e-3), max_crossings=9, t_max=4, tolerance=0.1
    )
    np.testing.assert_array_equal(crossings.side[0, :4], [-1, -1, 1, 1])
    np.testing.assert_allclose(crossings.t[0, :4], [0.999, 1, 3, 3.001], atol=1e-5)
    assert crossings.count[0] == 4


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hits_that_must_cross_are_all_hits_but_those_that_turn_back(precision: Any) -> None:
    field, (o, d) = hk.Gyroid(1.0, domain=BALL), rays(2000, seed=7)
    settings: dict[str, Any] = {"level": 1.2, "tolerance": 3e-3, "precision": precision}
    plain = hk.trace(field, o, d, **settings)
    sure = hk.trace(field, o, d, require_crossing=True, **settings)
    options = hk.TraceOptions(tolerance=3e-3, require_crossing=True, precision=precision)
    same = hk.trace(hk.Surface(field, 1.2), o, d, options=options)
    np.testing.assert_array_equal(sure.t, same.t)
    assert (plain.is_hit | ~sure.is_hit).all()
    assert 5 < (plain.is_hit & ~sure.is_hit).sum() < 200
    off = np.abs(gyroid(sure.position[sure.is_hit].astype(float)) - 1.2)
    assert off.max() < 1e-4
    assert (sure.uncertainty == 0).all()
    t = np.linspace(0, 4, 4001)
    for i in np.flatnonzero(plain.is_hit & ~sure.is_hit):
        p = o[i] + t[:, None] * d[i]
        f = gyroid(p[(p * p).sum(axis=1) <= 1.5**2])
        assert alternations(f, 1.2, 12 * 3e-3) == 0


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_a_steep_place_hides_nothing_behind_it(tolerance: float) -> None:
    """Beside a pole the tolerance in value is larger than f ever gets in the rest of the solid,
    whose deep inside, and the way out of it, were proved misses."""
    pole = hk.DipolePotential([[0, 0, 0.0]], [[1.0, 0, 0]], [1.0], cells=False)
    solid = hk.solid(pole, below=6.0) & hk.Sphere(1.0)
    settings: dict[str, Any] = {"precision": "double", "tolerance": tolerance}
    hits = hk.crossings(solid, [[-2, 0.01, 0.0]], [[1.0, 0, 0]], max_crossings=8, **settings)
    expected = [1.00005, 1.591935, 1.999994, 2.99995]
    np.testing.assert_allclose(hits.t[0, :4], expected, atol=max(5e-6, tolerance))
    assert np.isinf(hits.t[0, 4:]).all()
    hit = hk.trace(solid, [[-0.3, 0.01, 0.0]], [[1.0, 0, 0]], require_crossing=True, **settings)
    assert hit.t[0] == pytest.approx(0.29999, abs=max(1e-4, tolerance))


@pytest.mark.parametrize("precision", ["single", "double"])
def test_rays_between_poles_leave_the_solid_behind_them(precision: Any) -> None:
    """Where a ray is inside just before the sphere that cuts a cloud's solid, it leaves it there: 3
    of 150 did not."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(400, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    cloud = hk.DipolePotential(x, x, 4 * math.pi / 400)
    o, d = rays(400, 8)
    along, square = (o * d).sum(axis=1), (o * o).sum(axis=1)
    root = np.sqrt(np.maximum(along**2 - square + 1.3**2, 0))
    out = -along + root
    at = o[:, None] + (out[:, None] - np.linspace(0.001, 0.02, 20))[..., None] * d[:, None]
    value = np.asarray(cloud.value(at.reshape(-1, 3), precision="double")).reshape(-1, 20)
    leaves = (root > 0.1) & (value < 5.9).all(axis=1)
    assert leaves.sum() > 200
    solid = hk.solid(cloud, below=6.0) & hk.Sphere(1.3)
    hits = hk.crossings(solid, o, d, max_crossings=32, precision=precision, max_steps=4000)
    known = leaves & (hits.status == hk.RayStatus.MISS) & np.isinf(hits.t[:, -1])
    assert known.sum() > 0.9 * leaves.sum()
    apart = np.abs(hits.t - out[:, None]).min(axis=1)
    assert (apart[known] < 1e-3).all()


def test_drjit_rays_give_flat_arrays_with_derivatives() -> None:
    backend = choose_backend("double")
    o = backend.Array3f([-3.0, 0.0], [0.2, 0.0], [0.0, -2.0])
    level = backend.Float(0.1)
    dr.enable_grad(level)
    dr.set_grad(level, 1)
    d = backend.Array3f([1.0, 0.0], [0.0, 0.0], [0.0, 1.0])
    crossings = hk.crossings(Sphere(), o, d, level=level, max_crossings=3, t_max=9.0)
    assert dr.width(crossings.t) == dr.width(crossings.position) == 6
    half = math.sqrt(1.1**2 - 0.04)
    np.testing.assert_allclose(crossings.t, [3 - half, 3 + half, np.inf, 0.9, 3.1, np.inf])
    moved = dr.forward_to(crossings.t).numpy()[[0, 1, 3, 4]]
    np.testing.assert_allclose(moved, [-1.1 / half, 1.1 / half, -1, 1])


def test_no_rays_have_no_crossings() -> None:
    crossings = hk.crossings(Sphere(), np.zeros((0, 3)), np.zeros((0, 3)), max_crossings=5)
    assert crossings.t.shape == (0, 5)
    assert crossings.normal.shape == (0, 5, 3)
    assert crossings.count.shape == (0,)


def test_bad_settings_are_refused() -> None:
    o, d = [[-2.0, 0, 0]], [[1.0, 0, 0]]
    for wrong in (0, -3, True):
        with pytest.raises(ValueError, match="at least 1"):
            hk.crossings(Sphere(), o, d, max_crossings=wrong)
    with pytest.raises(TypeError, match="an integer such as 8"):
        hk.crossings(Sphere(), o, d, max_crossings="all")  # type: ignore[call-overload]
    mesh = hk.WindingNumber(*icosphere(0))
    with pytest.raises(ValueError, match="crossings takes one level of a field with jumps"):
        hk.crossings(mesh, o, d, max_crossings=2, level=(0.3, 0.6))
    with pytest.raises(ValueError, match="require_crossing takes one level of a field with jumps"):
        hk.trace(hk.Surface(mesh, [0.3, 0.6]), o, d, require_crossing=True)


def balls() -> tuple[FloatArray, Any]:
    """A ball with a hollow, and another one that cuts into it."""
    v, f = icosphere(2)
    vertices = np.concatenate([v, 0.5 * v + [0.2, 0, 0], 0.4 * v + [1.2, 0, 0]])
    return vertices, np.concatenate([f, f[:, ::-1] + len(v), f + 2 * len(v)])


def changes_of_winding(
    vertices: FloatArray, faces: Any, o: FloatArray, d: FloatArray
) -> tuple[FloatArray, Any]:
    """Where a ray from outside crosses triangles at which the winding number passes 1/2."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    along = normal @ d
    t = ((a - o) * normal).sum(axis=1) / along
    p = o + t[:, None] * d
    inside = np.array(
        [(np.cross(y - x, p - x) * normal).sum(axis=1) > 0 for x, y in ((a, b), (b, c), (c, a))]
    ).all(axis=0)
    crossed = np.flatnonzero(inside & (t > 0))
    crossed = crossed[np.argsort(t[crossed])]
    w = np.concatenate([[0], np.cumsum(-np.sign(along[crossed]))])
    passes = crossed[(w[1:] > 0.5) != (w[:-1] > 0.5)]
    return t[passes], passes


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("method", "precision"),
    [
        ("exact", "single"),
        ("exact", "double"),
        ("tree", "single"),
        pytest.param("tree", "double", marks=pytest.mark.slow),
    ],
)
def test_closed_meshes_are_crossed_at_their_triangles(method: str, precision: Any) -> None:
    vertices, faces = balls()
    o, d = rays(200, seed=4, distance=3.0)
    mesh = hk.WindingNumber(vertices, faces, method=method)
    crossings = hk.crossings(mesh, o, d, max_crossings=10, precision=precision)
    assert 2 < crossings.count.mean() < 6
    for i in range(len(o)):
        t, triangles = changes_of_winding(vertices, faces, o[i], d[i])
        n = crossings.count[i]
        assert n == len(t)
        np.testing.assert_allclose(crossings.t[i, :n], t, atol=2e-5)
        np.testing.assert_array_equal(crossings.primitive_index[i, :n], triangles)
        np.testing.assert_array_equal(crossings.side[i, :n], np.resize([1, -1], n))
    assert (crossings.primitive_index[np.isinf(crossings.t)] == -1).all()
    assert (crossings.status == hk.RayStatus.MISS).all()
    sure = hk.trace(mesh, o, d, require_crossing=True, precision=precision)
    np.testing.assert_array_equal(sure.t, crossings.t[:, 0])
    np.testing.assert_array_equal(sure.primitive_index, crossings.primitive_index[:, 0])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exact", pytest.param("tree", marks=pytest.mark.slow)])
def test_meshes_with_holes_are_crossed_where_the_winding_number_passes(method: str) -> None:
    vertices, faces = balls()
    kept = np.random.default_rng(0).random(len(faces)) < 0.8
    mesh = hk.WindingNumber(vertices, faces[kept], method=method)
    o, d = rays(30, seed=6, distance=3.0)
    crossings = hk.crossings(mesh, o, d, max_crossings=12, tolerance=1e-4, precision="single")
    exact = hk.WindingNumber(vertices, faces[kept])
    alike = 0
    for i in range(len(o)):
        crossed = crossings.t[i, : crossings.count[i]]
        near = crossed[:, None] + 1e-3 * np.linspace(-1, 1, 101) ** 3
        t = np.unique(np.concatenate([np.linspace(0, 6, 3001), near.ravel()]))
        w = exact.value(o[i] + t[:, None] * d[i], precision="double")
        steep = np.linalg.norm(exact.gradient(o[i] + t[:, None] * d[i], precision="double"), axis=1)
        # Beside an edge that is open gradients are large, and so is the tolerance in value.
        around = np.lib.stride_tricks.sliding_window_view(np.pad(steep, 20, mode="edge"), 41)
        least = alternations(w, 0.5, 1e-3 + 1e-4 * around.max(axis=1))
        most = alternations(w, 0.5, 0.0)
        assert least <= crossings.count[i] <= most
        if crossings.count[i] == most:
            alike += 1
            np.testing.assert_allclose(crossed, t[:-1][np.diff(w > 0.5)], atol=1e-3)
    assert alike > 25
    smooth = np.isfinite(crossings.t) & (crossings.primitive_index < 0)
    assert 5 < smooth.sum() < np.isfinite(crossings.t).sum() - 10
    value = exact.value(crossings.position[smooth].astype(float), precision="double")
    assert np.quantile(np.abs(value - 0.5), 0.9) < 1e-4


def test_a_ray_that_starts_on_a_triangle_leaves_it_uncounted() -> None:
    vertices, faces = icosphere(1)
    mesh = hk.WindingNumber(vertices, faces)
    o = np.einsum("nkd,k->nd", vertices[faces[:40]], [0.3, 0.3, 0.4])
    for sign, count in ((1.0, 0), (-1.0, 1)):
        crossings = hk.crossings(mesh, o, sign * o, max_crossings=3, precision="double")
        np.testing.assert_array_equal(crossings.count, count)


def test_the_root_of_a_cubic_is_found_in_its_bracket() -> None:
    backend, rng = choose_backend("double"), np.random.default_rng(2)
    start, end = rng.uniform(0.01, 1, 1000), -rng.uniform(0, 1, 1000)
    slope, last = rng.uniform(-4, 4, (2, 1000))
    numbers = (backend.Float(each) for each in (start, end, slope, last))
    u = cubic_root(*numbers).numpy()
    assert ((u >= 0) & (u <= 1)).all()
    b, c = 3 * (end - start) - 2 * slope - last, slope + last - 2 * (end - start)
    value = start + u * (slope + u * (b + u * c))
    assert np.quantile(np.abs(value), 0.95) < 1e-3
    assert np.abs(value).max() < 0.2
