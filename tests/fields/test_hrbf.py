"""Hermite radial basis functions: interpolation, proved ranges, first hits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.formula_evaluator import FormulaEvaluator
from harnack.testing import check_field


def surface(count: int = 17, seed: int = 1, **settings: Any) -> hk.fields.HRBF:
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    return hk.fields.HRBF(n * (1 + 0.2 * np.sin(3 * n[:, :1])), 2.0 * n, **settings)


def test_it_passes_through_the_points_along_the_normals() -> None:
    f = surface()
    np.testing.assert_allclose(f.value(f.points, precision="double"), 0, atol=1e-12)
    np.testing.assert_allclose(f.gradient(f.points, precision="double"), f.normals, atol=1e-12)
    far = hk.fields.HRBF(1e3 * f.points + 1e5, f.normals)
    np.testing.assert_allclose(far.value(1e3 * f.points + 1e5, precision="double"), 0, atol=1e-7)


@pytest.mark.slow
def test_values_and_derivatives_are_those_of_the_formula() -> None:
    f = surface()
    check_field(f, count=60, directions=4)
    backend = choose_backend("double")
    evaluator = f.evaluator(backend)
    p = to_vector3(backend, np.random.default_rng(0).uniform(-1.3, 1.3, (300, 3)))
    by_tree, by_formula = evaluator.evaluate(p), FormulaEvaluator.evaluate(evaluator, p)
    np.testing.assert_allclose(to_numpy(by_tree.value), to_numpy(by_formula.value), atol=1e-11)
    np.testing.assert_allclose(
        to_numpy(by_tree.gradient), to_numpy(by_formula.gradient), atol=1e-11
    )
    for a, b in zip(evaluator.hessian(p), FormulaEvaluator.hessian(evaluator, p), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), atol=1e-11)


@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_single_precision_is_within_the_stated_error(offset: float) -> None:
    base = surface()
    f = hk.fields.HRBF(base.points + offset, base.normals)
    x = np.random.default_rng(0).uniform(-1.5, 1.5, (1000, 3)) + offset
    x = x.astype(np.float32).astype(np.float64)
    sample = f.evaluator(choose_backend("single")).evaluate(to_vector3(choose_backend("single"), x))
    off = np.abs(to_numpy(sample.value) - f.value(x, precision="double"))
    assert (off <= to_numpy(sample.value_error)).all()
    turned = to_numpy(sample.gradient) - f.gradient(x, precision="double")
    assert (np.linalg.norm(turned, axis=1) <= to_numpy(sample.gradient_error)).all()


@pytest.mark.parametrize("precision", ["single", "double"])
def test_ranges_hold_and_are_attained(precision: Any) -> None:
    """Two points far apart, so that one of them decides: its ranges are reached. The lines pass the
    points at any distance, through them too."""
    rng = np.random.default_rng(3)
    f = hk.fields.HRBF([[0.1, 0.2, 0.3], [0.4, -0.8, 0.1]], [[1.0, 0.5, 0], [0.2, 0.3, -1]])
    backend = choose_backend(precision)
    count = 200
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    aside = np.cross(d, rng.normal(size=(count, 3)))
    aside *= rng.choice([0.0, 1e-7, 1e-3, 0.5], (count, 1))
    start = f.points[rng.integers(0, 2, count)] + aside - rng.choice([0, 1, 30.0], (count, 1)) * d
    p, d = (one.astype(backend.dtype).astype(np.float64) for one in (start, d))
    length = (rng.random(count) * 3).astype(backend.dtype).astype(np.float64)
    knots = [0.0, backend.Float(0.4 * length), backend.Float(length)]
    on_backend: Any = f.evaluator(backend).function
    ranges_along = on_backend.along(to_vector3(backend, p), to_vector3(backend, d), knots)
    ends = [0 * length, *(to_numpy(one).astype(np.float64) for one in knots[1:])]
    width: list[Any] = []
    for k, part in enumerate(ranges_along.parts):
        s = ends[k][:, None] + np.linspace(0, 1, 200) * (ends[k + 1] - ends[k])[:, None]
        x = (p[:, None] + s[..., None] * d[:, None]).reshape(-1, 3)
        gradient = f.gradient(x, precision="double").reshape(count, -1, 3)
        hessian = f.hessian(x, precision="double").reshape(count, -1, 3, 3)
        first = np.einsum("njk,nk->nj", gradient, d)
        second = np.einsum("njkl,nk,nl->nj", hessian, d, d)
        tiny = 1e-10 * (1 + np.abs(start).max() ** 2)
        ends_of = (
            part.slope_range.lower,
            part.slope_range.upper,
            part.min_second_derivative,
            part.max_second_derivative,
        )
        low, high, least, most = (to_numpy(one).astype(np.float64)[:, None] for one in ends_of)
        assert (low - first).max() <= tiny
        assert (first - high).max() <= tiny
        assert (least - second).max() <= tiny
        assert (second - most).max() <= tiny
        width.append((high - low)[:, 0] / (np.ptp(first, axis=1) + 1e-9))
    assert np.quantile(width, 0.2) < 3  # a sum of ranges is wider than the range of a sum


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("enclosures", [None, "quadratic-taylor", "segment"])
def test_first_hits(precision: Any, enclosures: Any) -> None:
    f = surface()
    rng = np.random.default_rng(0)
    o = rng.normal(size=(300, 3))
    o *= 4 / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-1, 1, (300, 3)) - o
    d /= np.linalg.norm(d, axis=1)[:, None]
    o, d = (one.astype(np.float32).astype(np.float64) for one in (o, d))
    hits = hk.trace(f, o, d, precision=precision, enclosures=enclosures)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    found = hits.status == hk.RayStatus.HIT
    assert 0.6 < found.mean() < 0.95
    if enclosures is None:
        assert np.mean(hits.evaluations) < 10
    low, high = f.domain.bounds()  # type: ignore[union-attr]
    enter = np.minimum((low - o) / d, (high - o) / d).max(1)
    leave = np.maximum((low - o) / d, (high - o) / d).min(1)
    inside = enter < leave
    end = np.where(found, np.nan_to_num(hits.t, posinf=0), leave)
    s = enter[:, None] + np.linspace(0, 1, 300) * (end - enter)[:, None]
    values = f.value(
        (o[:, None] + s[..., None] * d[:, None]).reshape(-1, 3), precision="double"
    ).reshape(300, -1)
    # All rays begin outside, or the domain cuts the surface open.
    begins = values[:, 0] > 1e-2
    assert (values[inside & begins].min(1) > -2e-3).all()
    assert np.abs(values[found & begins, -1]).max() < 2e-3


@pytest.mark.parametrize(
    ("points", "normals", "message"),
    [
        ([[0, 0, 0]], [[0, 0, 1]], "2 to"),
        ([[0, 0, 0], [1, 0, 0]], [[0, 0, 1]], "one for each"),
        ([[0, 0, 0], [1, 0, 0]], [[0, 0, 1], [0, 0, 0]], "normal 1 is zero"),
        ([[0, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 0, 1]], "more than once"),
        ([[0, 0, np.inf], [0, 0, 0]], [[0, 0, 1], [0, 0, 1]], "point 0"),
        ([[0, 0], [1, 0]], [[0, 0, 1], [0, 0, 1]], "shape"),
    ],
)
def test_what_are_no_points(points: Any, normals: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hk.fields.HRBF(points, normals)
