"""Fourier series: fits, bounds, first hits, and what is refused."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.fields.analytic.cosine_series import (
    CosineBounds,
    evaluate_on_grid,
    fit_cosines,
    midpoints,
)
from harnack.testing import BrokenPromiseError, check_field
from tests.backend.test_kernels import compiled
from tests.oracles.oracle import OracleValues, first_crossings

HALF = 3 * math.pi / 4
FIG_21 = ((-HALF,) * 3, (HALF,) * 3)
CENTERS = np.random.default_rng(5).uniform(-0.6, 0.6, (12, 3))
CUBE = ((-1.2,) * 3, (1.2,) * 3)


def figure_21(x: np.ndarray) -> np.ndarray:
    """Even about the walls of `FIG_21`: a cosine series of ten terms exactly."""
    return np.sin(6 * x).prod(axis=1) + np.sin(2 * x).prod(axis=1)


def blobs(x: np.ndarray) -> np.ndarray:
    return np.exp(-((x[:, None] - CENTERS) ** 2).sum(axis=2) / 0.06).sum(axis=1) - 0.5


def random_series(rng: np.random.Generator, shape: tuple[int, int, int]) -> np.ndarray:
    decay = (1 + np.indices(shape).sum(axis=0)) ** rng.uniform(0, 2)
    return rng.normal(size=shape) / decay


def by_terms(a: np.ndarray, low: np.ndarray, size: np.ndarray, x: np.ndarray) -> OracleValues:
    """The series by one product of cosines for each term, in double precision."""
    angle = math.pi * (x - low) / size
    waves = [np.cos(angle[:, k, None] * np.arange(n)) for k, n in enumerate(a.shape)]
    slopes = [
        -np.pi / size[k] * np.arange(n) * np.sin(angle[:, k, None] * np.arange(n))
        for k, n in enumerate(a.shape)
    ]

    def total(parts: list[np.ndarray]) -> np.ndarray:
        return np.einsum("ijk,ni,nj,nk->n", a, *parts, optimize=True)

    gradient = [total([*waves[:k], slopes[k], *waves[k + 1 :]]) for k in range(3)]
    smooth = np.full(len(x), float((size / np.array(a.shape)).min()))
    return OracleValues(total(waves), np.stack(gradient, axis=1), smooth)


def rays(n: int, size: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """From a sphere of radius 3 `size` towards points of the ball of radius `size`."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 3 * size / np.linalg.norm(o, axis=1, keepdims=True)
    target = rng.normal(size=(n, 3))
    target *= (size * rng.random(n) ** (1 / 3) / np.linalg.norm(target, axis=1))[:, None]
    d = target - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", [(4, 3, 5), (1, 6, 2)])
def test_a_series_is_fitted_exactly(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(1)
    a = random_series(rng, shape)
    low, size = np.array([-1.0, 2.0, 0.5]), np.array([2.0, 0.7, 3.0])
    grid = tuple(2 * n + 1 for n in shape)
    x = midpoints(low, low + size, grid)
    values = by_terms(a, low, size, x).value
    np.testing.assert_allclose(fit_cosines(values.reshape(grid), shape), a, atol=1e-13)
    box = (tuple(low), tuple(low + size))
    for fitted in (
        hk.fields.FourierSeries.fit(values.reshape(grid), box, shape),
        hk.fields.FourierSeries.fit(lambda p: by_terms(a, low, size, p).value, box, shape),
    ):
        assert fitted.fit_error is not None
        assert fitted.fit_error < 1e-12
        np.testing.assert_allclose(fitted.coefficients, a, atol=1e-13)
        inside = low + size * rng.random((100, 3))
        exact = by_terms(a, low, size, inside)
        np.testing.assert_allclose(
            fitted.value(inside, precision="double"), exact.value, atol=1e-12
        )
        np.testing.assert_allclose(
            fitted.gradient(inside, precision="double"), exact.gradient, atol=1e-11
        )


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_between_nodes(seed: int) -> None:
    """On grids that are no multiples of the bounds' own; and they are not far too large."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(1, 9, 3) + np.array([2, 0, 0]))
    a, size = random_series(rng, (shape[0], shape[1], shape[2])), rng.uniform(0.5, 2, 3)
    bounds = CosineBounds.of(a, size)
    x = size * rng.random((20_000, 3))
    values = by_terms(a, np.zeros(3), size, x).value
    half = bounds.high - bounds.low
    assert bounds.low <= values.min() < bounds.low + 0.1 * half
    assert bounds.high - 0.1 * half < values.max() <= bounds.high
    # Second derivatives in random directions.
    angles = tuple(math.pi * np.sort(rng.random(23)) for _ in range(3))
    grids = np.stack(np.meshgrid(*angles, indexing="ij"), axis=-1).reshape(-1, 3)
    h = np.zeros((len(grids), 3, 3))
    for i in range(3):
        for j in range(3):
            orders = [0, 0, 0]
            orders[i] += 1
            orders[j] += 1
            part = evaluate_on_grid(a, angles, tuple(orders))  # type: ignore[arg-type]
            h[:, i, j] = math.pi**2 / (size[i] * size[j]) * part.ravel()
    bent = np.abs(np.linalg.eigvalsh(h)).max(axis=1)
    assert 0.5 * bounds.curvature < bent.max() <= bounds.curvature
    for cells in bounds.cells:
        n = cells.count
        place = np.minimum((grids / math.pi * n).astype(int), n - 1)
        local = cells.bounds[place[:, 0] + n * (place[:, 1] + n * place[:, 2])]
        assert (bent <= local).all()
        assert cells.bounds.mean() < 0.9 * bounds.curvature


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "plain",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("anisotropic", "far away", "tiny")),
    ],
)
def test_series_keep_their_promises(kind: str) -> None:
    move, scale = {"far away": (300.0, 1.0), "tiny": (0.0, 1e-3)}.get(kind, (0.0, 1.0))
    box = tuple(tuple(move + scale * v for v in corner) for corner in CUBE)
    terms = (9, 5, 3) if kind == "anisotropic" else 7
    field = hk.fields.FourierSeries.fit(lambda x: blobs((x - move) / scale), box, terms)
    check_field(field, count=150, directions=6)


@pytest.mark.slow
@pytest.mark.parametrize("terms", [2, 16, (16, 4, 9)])
def test_other_series_keep_their_promises(terms: Any) -> None:
    check_field(hk.fields.FourierSeries.fit(blobs, CUBE, terms), count=150)
    torus = hk.fields.FourierSeries.fit(
        lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.6, x[:, 2]) - 0.25,
        CUBE,
        3 if terms == 2 else terms,  # it is even on every axis: of two terms one is left
    )
    check_field(torus, count=150)


@pytest.mark.slow
def test_local_bounds_that_are_too_small_are_seen() -> None:
    field = hk.fields.FourierSeries.fit(blobs, CUBE, 8)
    assert field._bounds.cells
    cells = tuple(dataclasses.replace(c, bounds=0.5 * c.bounds) for c in field._bounds.cells)
    field._bounds = dataclasses.replace(field._bounds, cells=cells)
    with pytest.raises(BrokenPromiseError, match="TaylorRemainder: f leaves"):
        check_field(field, count=2000)


def agree(field: Any, level: float, n: int, size: float, precision: Any, **settings: Any) -> Any:
    """Traces, and asserts that no ray passes a crossing and that every hit is one."""
    o, d = rays(n, size)
    hits = hk.trace(field, o, d, level=level, precision=precision, **settings)
    assert (hits.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    low, high = field.domain.bounds()
    volume = settings.get("clip", field.domain)
    at = -(o * d).sum(axis=1)
    t = at[:, None] + np.linspace(-2 * size, 2 * size, 400)
    inside = volume.contains_points((o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3))
    inside = inside.reshape(t.shape)
    some = inside.any(axis=1)
    first = np.where(some, t[np.arange(n), inside.argmax(axis=1)], 0)
    last = np.where(some, t[np.arange(n), t.shape[1] - 1 - inside[:, ::-1].argmax(axis=1)], 0)

    def function(x: np.ndarray) -> OracleValues:
        return by_terms(field.coefficients, low, high - low, x)

    truth = first_crossings(
        function, o, d, first, last, levels=[level], depth=1e-4, spacing=0.06, finest=1e-4
    )
    assert (hits.t <= truth.beyond + 1e-3).all()
    there = function(hits.position[hits.is_hit])
    assert (np.abs(there.value - level) <= 4e-4 * there.gradient_norm + 1e-5).all()
    assert np.isfinite(truth.beyond).mean() > 0.2
    return hits


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
def test_first_hits_of_figure_21(precision: Any) -> None:
    field = hk.fields.FourierSeries.fit(figure_21, FIG_21, 10)
    assert field.fit_error is not None
    assert field.fit_error < 1e-12
    ball = hk.Ball(radius=math.pi / 2)
    hits = agree(field, 0.5, 200, math.pi / 2, precision, clip=ball)
    assert hits.evaluations.mean() < 10


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", ["figure 21", "blobs"])
def test_first_hits_of_many_rays(name: str, precision: Any) -> None:
    if name == "blobs":
        agree(hk.fields.FourierSeries.fit(blobs, CUBE, 12), 0.0, 800, 1.2, precision)
    else:
        field = hk.fields.FourierSeries.fit(figure_21, FIG_21, 10)
        ball = hk.Ball(radius=math.pi / 2)
        agree(field, 0.5, 2000, math.pi / 2, precision, clip=ball)


@pytest.mark.slow
def test_displacements_are_those_of_the_surfaces() -> None:
    """A sphere whose radius grew by 0.01: the surfaces are that far apart."""
    wave = hk.fields.FourierSeries.fit(lambda x: np.exp(-4 * (x**2).sum(axis=1)), CUBE, 10)
    level = math.exp(-4 * 0.5**2)
    wave._source = lambda x: np.exp(-4 * (np.linalg.norm(x, axis=1) - 0.01) ** 2)
    found = wave.displacement(level)
    assert found.count > 1000
    assert found.mean == pytest.approx(0.01, rel=0.03)
    assert found.largest < 0.012
    x = midpoints(np.full(3, -1.2), np.full(3, 1.2), (40, 40, 40))
    grid = hk.fields.FourierSeries.fit(np.exp(-4 * (x**2).sum(axis=1)).reshape((40,) * 3), CUBE, 9)
    found = grid.displacement(level)
    assert 0 < found.mean <= found.largest < 0.005
    with pytest.raises(ValueError, match="no point with level"):
        wave.displacement(-7.0)
    with pytest.raises(ValueError, match="no function to miss"):
        hk.fields.FourierSeries(np.ones((2, 2, 2)), CUBE).displacement()


@pytest.mark.slow
def test_values_have_derivatives() -> None:
    import drjit as dr
    from drjit.llvm.ad import Array3f64

    field = hk.fields.FourierSeries.fit(blobs, CUBE, 6)
    p = Array3f64([0.1, 0.3], [0.2, -0.4], [-0.3, 0.1])
    dr.enable_grad(p)
    dr.backward(dr.sum(field.value(p)))
    x = np.array([[0.1, 0.2, -0.3], [0.3, -0.4, 0.1]])
    np.testing.assert_allclose(p.grad.numpy().T, field.gradient(x, precision="double"), atol=1e-12)


@pytest.mark.slow
def test_another_function_compiles_no_kernel() -> None:
    """Coefficients, box, bounds and roundings are data; only the number of terms is code."""
    o, d = rays(300, 1.2)

    def trace(k: int) -> int:
        move = 0.01 * k
        box = tuple(tuple(v + move for v in corner) for corner in CUBE)
        field = hk.fields.FourierSeries.fit(
            lambda x: (1 + move) * blobs(x - move), box, 4, samples=16
        )
        return compiled(lambda: hk.trace(field, o, d, level=0.1 + move), size=300)

    assert trace(0) > 0
    assert [trace(k) for k in range(1, 4)] == [0] * 3


def nan_at_one(x: np.ndarray) -> np.ndarray:
    return np.where(x[:, 0] > 1.1, np.nan, x[:, 0])


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: fit(nan_at_one), ValueError, "the function is nan at .* bound it first"),
        (lambda: fit(lambda x: x), ValueError, "one value for each point"),
        (lambda: fit(lambda x: 1.0), ValueError, "one value for each point"),
        (lambda: fit(lambda x: np.ones(len(x))), ValueError, "function is constant"),
        (lambda: fit(lambda x: ["a"] * len(x)), TypeError, "values of the function"),
        (lambda: fit(np.full((30, 30, 30), np.nan)), ValueError, "27000 values that are NaN"),
        (lambda: fit(np.ones((30, 30))), ValueError, r"shape \(n_x, n_y, n_z\)"),
        (lambda: fit("grid"), TypeError, "a grid must hold real numbers"),
        (lambda: fit(np.zeros((8, 8, 8)), 9), ValueError, "cannot be told apart by"),
        (lambda: fit(blobs, 25), ValueError, "terms must be 1 to 24 .* 2 K\\^3"),
        (lambda: fit(blobs, 0), ValueError, "terms must be 1 to 24"),
        (lambda: fit(blobs, (3, 4)), ValueError, "terms must be one number or three"),
        (lambda: fit(blobs, 2.5), TypeError, "float"),
        (lambda: fit(blobs, 4, samples=400), ValueError, "too many: at most"),
        (lambda: fit(np.zeros((8, 8, 8)), 4, samples=8), TypeError, "a grid has its own"),
        (lambda: fit(blobs, box=((0, 0, 0), (1, 1, 0))), ValueError, "finite sides longer than 0"),
        (lambda: fit(blobs, box=hk.Box((0, 0, 0), (1, 1, math.inf))), ValueError, "finite sides"),
        (lambda: fit(blobs, box=3.0), TypeError, "a harnack.Box or two corners"),
        (lambda: hk.fields.FourierSeries(np.ones((2, 2)), CUBE), ValueError, "K_x, K_y, K_z"),
        (
            lambda: hk.fields.FourierSeries(np.ones((1, 1, 1)), CUBE),
            ValueError,
            "series is constant",
        ),
        (
            lambda: hk.trace(fit(blobs, 4), [[3.0, 0, 0]], [[-1.0, 0, 0]], level=99.0),
            ValueError,
            "no surface has level 99",
        ),
    ],
)
def test_what_is_refused(make: Any, kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        make()


def fit(function: Any, terms: Any = 6, *, box: Any = CUBE, **settings: Any) -> Any:
    return hk.fields.FourierSeries.fit(function, box, terms, **settings)
