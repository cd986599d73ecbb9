"""Lattice noise: its constants are bounds, and those that can be are attained."""

from __future__ import annotations

import itertools
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy
from harnack.fields.solids.fractal import CONSTANTS, CORNERS, cell_noise, fade, lattice_vector
from harnack.tracer.traced_surface import traced_surface

FADES = pytest.mark.parametrize("kind", ["cubic", "quintic"])
ATTAINED = {"cubic": math.sqrt(19) / 2, "quintic": math.sqrt(499) / 8}
SIGNS = np.array(CORNERS)


def parts(kind: Any, t: Any) -> tuple[Any, Any, Any]:
    """At places (n, 3): weights (n, 8), their gradients (n, 8, 3), and x - c (n, 8, 3)."""
    s, ds, _ = fade(kind, t)
    w = np.where(SIGNS, s[:, None], 1 - s[:, None])
    d = np.where(SIGNS, ds[:, None], -ds[:, None])
    slopes = [d[..., 0] * w[..., 1] * w[..., 2], w[..., 0] * d[..., 1] * w[..., 2],
              w[..., 0] * w[..., 1] * d[..., 2]]  # fmt: skip
    return w.prod(-1), np.stack(slopes, -1), t[:, None] - SIGNS


@FADES
def test_the_largest_value_is_attained_in_the_middle(kind: Any) -> None:
    t = np.full((1, 3), 0.5)
    away = 0.5 - SIGNS
    vectors = away / np.linalg.norm(away, axis=1)[:, None]
    value, _, _ = cell_noise(kind, t[0], vectors)
    assert value == pytest.approx(CONSTANTS[kind].max_abs, rel=1e-12)
    rng = np.random.default_rng(0)
    w, _, r = parts(kind, rng.uniform(size=(50_000, 3)))
    assert (w * np.linalg.norm(r, axis=2)).sum(1).max() <= CONSTANTS[kind].max_abs * (1 + 1e-12)


@FADES
def test_the_slope_is_attained_within_one_percent(kind: Any) -> None:
    """In the middle, along an axis, with the worst vectors."""
    w, slopes, r = parts(kind, np.full((1, 3), 0.5))
    v = np.array([1.0, 0.0, 0.0])
    worst = (w[..., None] * v + r * (slopes @ v)[..., None])[0]
    vectors = worst / np.linalg.norm(worst, axis=1)[:, None]
    _, gradient, _ = cell_noise(kind, [0.5, 0.5, 0.5], vectors)
    assert gradient[0] == pytest.approx(ATTAINED[kind], rel=1e-12)
    assert 0.99 * CONSTANTS[kind].max_gradient <= gradient[0] <= CONSTANTS[kind].max_gradient


@pytest.mark.few(1)
@FADES
def test_the_slope_is_bounded_by_an_eigenvalue(kind: Any) -> None:
    """The proof of `NoiseConstants`: the largest eigenvalue with weights, over an eighth of a cell,
    to which all others are mirrored."""
    axis = np.linspace(0, 0.5, 33)
    t = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    w, slopes, r = parts(kind, t)
    a = w[..., None, None] * np.eye(3) + r[..., :, None] * slopes[..., None, :]
    weights = np.linalg.norm(a, 2, axis=(2, 3)) + 1e-12
    weights /= weights.sum(1, keepdims=True)
    total = np.einsum("ncij,ncik->njk", a / weights[..., None, None], a)
    bound = np.sqrt(np.linalg.eigvalsh(total)[:, -1]).reshape(33, 33, 33)
    assert ATTAINED[kind] * (1 - 1e-9) <= bound.max() <= CONSTANTS[kind].max_gradient
    # Near its largest values it changes by less than what the constant leaves between neighbors.
    high = bound > 0.97 * bound.max()
    change = max(
        np.abs(np.diff(bound, axis=k))[
            np.take(high, range(32), axis=k) & np.take(high, range(1, 33), axis=k)
        ].max()
        for k in range(3)
    )
    assert bound.max() + change / 2 <= CONSTANTS[kind].max_gradient


@FADES
def test_second_derivatives_are_bounded(kind: Any) -> None:
    """Row sums of the bounds of the entries, and what random vectors reach."""
    axis = np.linspace(0, 1, 41)
    s, ds, dds = fade(kind, axis)
    m = (1 - s) * axis**2 + s * (1 - axis) ** 2  # the mean square along the other axes
    i, j, k = np.meshgrid(*(np.arange(len(axis)),) * 3, indexing="ij")

    def diagonal(a: Any, b: Any, c: Any) -> Any:
        rest = dds[a] ** 2 * (m[b] + m[c])
        ends = (2 * ds[a] + (axis[a] - e) * dds[a] for e in (0, 1))
        return sum(np.sqrt(one**2 + rest) for one in ends)

    def mixed(a: Any, b: Any, c: Any) -> Any:
        total: Any = 0.0
        for ca, cb in itertools.product((0, 1), repeat=2):
            wa = s[a] if ca else 1 - s[a]
            wb = s[b] if cb else 1 - s[b]
            along_a = ds[b] * (wa + (2 * ca - 1) * (axis[a] - ca) * ds[a])
            along_b = ds[a] * (wb + (2 * cb - 1) * (axis[b] - cb) * ds[b])
            total = total + np.sqrt(along_a**2 + along_b**2 + (ds[a] * ds[b]) ** 2 * m[c])
        return total

    rows = diagonal(i, j, k) + mixed(i, j, k) + mixed(i, k, j)
    assert (
        0.97 * CONSTANTS[kind].max_second_derivative
        <= rows.max()
        <= CONSTANTS[kind].max_second_derivative
    )

    rng = np.random.default_rng(1)
    t = rng.uniform(size=(3, 4000))
    vectors = rng.normal(size=(8, 3, 4000))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    _, _, hessian = cell_noise(kind, t, vectors)
    full = np.array([[hessian[n] for n in row] for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))])
    most = np.abs(np.linalg.eigvalsh(np.moveaxis(full, 2, 0))).max()
    assert (
        0.2 * CONSTANTS[kind].max_second_derivative < most <= CONSTANTS[kind].max_second_derivative
    )


@FADES
def test_derivatives_are_those_of_the_value(kind: Any) -> None:
    rng = np.random.default_rng(2)
    t, h = rng.uniform(0.1, 0.9, (3, 100)), 1e-5
    vectors = rng.normal(size=(8, 3, 100))
    _, gradient, hessian = cell_noise(kind, t, vectors)
    for k in range(3):
        step = np.zeros((3, 1))
        step[k] = h
        up, down = cell_noise(kind, t + step, vectors), cell_noise(kind, t - step, vectors)
        assert np.allclose((up[0] - down[0]) / (2 * h), gradient[k], atol=1e-7)
        rows = [(0, 1, 2), (1, 3, 4), (2, 4, 5)][k]
        for j, n in enumerate(rows):
            assert np.allclose((up[1][j] - down[1][j]) / (2 * h), hessian[n], atol=1e-6)


def test_vectors_are_unit_and_spread_evenly() -> None:
    backend = choose_backend("double")
    rng = np.random.default_rng(3)
    places = (backend.UInt32(v) for v in rng.integers(0, 2**32, (3, 20_000)).astype(np.uint32))
    g = lattice_vector(*places, backend.UInt32(7), backend.Float(0))
    g = np.stack([np.array(v) for v in g])
    assert np.allclose(np.linalg.norm(g, axis=0), 1)
    assert np.abs(g.mean(axis=1)).max() < 0.03
    assert np.allclose(np.cov(g), np.eye(3) / 3, atol=0.03)


def test_noise_is_continuous_across_the_lattice_and_depends_on_the_seed() -> None:
    one, two = hk.solids.Noise(1.0), hk.solids.Noise(1.0, seed=1)
    rng = np.random.default_rng(4)
    x = rng.uniform(-4, 4, (200, 3))
    x[:, 0] = np.round(x[:, 0])
    left, right = (one.value(x + aside, precision="double") for aside in (-1e-9, 1e-9))
    assert np.abs(left - right).max() < 1e-8
    assert np.abs(one.value(x) - two.value(x)).mean() > 0.05
    assert np.abs(one.value(np.round(x), precision="double")).max() < 1e-12


def test_constants_of_sums() -> None:
    """1/f noise has n times the constant of noise, Brownian noise less than twice."""
    one = hk.solids.Noise().lipschitz
    assert hk.solids.FractalNoise(6, 1.0).lipschitz == pytest.approx(6 * one, rel=1e-6)
    assert hk.solids.FractalNoise(6, 2.0).lipschitz == pytest.approx((2 - 2.0**-5) * one, rel=1e-6)
    field = hk.solids.FractalNoise(5, 1.3, 1.7, 0.4)
    x = np.random.default_rng(5).uniform(-3, 3, (4000, 3))
    slopes = np.linalg.norm(field.gradient(x, precision="double"), axis=1)
    assert 0.2 * field.lipschitz < slopes.max() <= field.lipschitz
    assert np.abs(field.value(x)).max() <= field.max_abs


def test_nothing_is_claimed_where_the_lattice_is_finer_than_numbers() -> None:
    """Rays from there run out of steps; they do not miss."""
    hits = hk.trace(hk.solids.Noise(1e12), [[0.0, 0.0, 1e3]], [[0.0, 0.0, 1.0]], t_max=1.0)
    assert hits.status[0] == int(hk.RayStatus.OUT_OF_STEPS)


def test_two_batches_of_rays_have_different_sizes() -> None:
    """The constant of the displaced solid took the size of the first: incompatible sizes."""
    solid = hk.solids.DisplacedSolid(hk.Sphere(1.0), hk.solids.FractalNoise(3, amplitude=0.2))
    backend = choose_backend("single")
    tracer = traced_surface(solid, level=0.0).tracer(backend)
    for n in (50, 90):
        o = backend.Array3f(dr.linspace(backend.Float, -0.5, 0.5, n), 0, 3)
        hit = tracer.first_hit(o, backend.Array3f(0, 0, -1), 0, np.inf)
        assert dr.width(hit.t) == n
        assert (to_numpy(hit.status) == hk.RayStatus.HIT).all()
