"""Cases that attacks on Riemann surfaces and level curves found, kept as they were."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import harnack as hk

PRECISIONS = ("single", "double")


@pytest.mark.few(4)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("enclosures", ["curvature", "slope", "caps"])
def test_rays_from_creases_miss_nothing(enclosures: str, precision: Any) -> None:
    """On the line of symmetry y = 0 two sheets agree in f and in all of its gradient but y, and
    were taken for one: one first hit in seven was missed by these bounds."""
    rng, n = np.random.default_rng(1), 200
    o = np.column_stack([rng.uniform(0.05, 0.8, n), 0 * np.ones(n), rng.uniform(0.02, 0.6, n)])
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    hits = hk.trace(
        hk.fields.RiemannSurface("asin"), o, d, enclosures=enclosures, precision=precision
    )
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    end = np.minimum(hits.t, 1.2)
    x = o[:, None] + (np.linspace(0, 1, 800) * end[:, None])[..., None] * d[:, None]
    u = np.abs(np.arcsin(x[..., 0] + 1j * x[..., 1]).imag)
    product = (x[..., 2] - u) * (x[..., 2] + u)  # which is positive at the start
    assert (product > -5e-3).all()
    assert hits.is_hit.sum() > 100


@pytest.mark.few(5)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("function", "settings"),
    [("power", {"exponent": 1}), ("power", {"exponent": 3}), ({0: 1, 1: Fraction(1, 2)}, {})],
)
def test_rays_through_zeros_of_whole_powers_end(
    function: Any, settings: dict[str, Any], precision: Any
) -> None:
    """g was made by its logarithm, which has no value at a zero: rays ran out of steps there."""
    field = hk.fields.RiemannSurface(function, **settings)
    hits = hk.trace(field, [[0, 0, 2.0], [1e-21, 0, 2.0]], [[0, 0, -1.0]], precision=precision)
    np.testing.assert_allclose(hits.t, 2.0, atol=1.1e-4)


@pytest.mark.parametrize("enclosures", [None, "curvature", "slope"])
def test_what_is_not_a_number_is_not_free(enclosures: Any) -> None:
    """A value that is not a number had no level above nor below it, and rays passed: a miss."""
    settings: dict[str, Any] = {"singular_points": [], "second_bound": lambda z, r: 1.0}

    def lost(z: Any) -> list[tuple[Any, Any]]:
        return [(z * math.nan, z)]

    o, d = [[0.3, 0.2, 3.0], [-2, 0.1, 0.2], [0.3, 0.2, 0.1]], [[0, 0, -1.0], [1, 0, 0], [0, 0, 1]]

    def one_is_lost(z: Any) -> list[tuple[Any, Any]]:
        return [(z, 1.0), *lost(z)]

    for field in (
        hk.fields.RiemannSurface(lost, **settings),
        hk.fields.RiemannSurface(one_is_lost, **settings),
        hk.fields.LevelCurves(lost, **settings),
    ):
        hits = hk.trace(field, o, d, enclosures=enclosures, max_steps=20)
        assert (hits.status == hk.RayStatus.OUT_OF_STEPS).all()


def test_functions_of_ones_own_are_tried_at_once() -> None:
    """They failed in the middle of a trace, for reasons of Dr.Jit's."""

    def identity(z: Any) -> list[tuple[Any, Any]]:
        return [(z, 1.0)]

    for function, settings, error, words in (
        (lambda z: [(np.sqrt(z), 1)], {}, TypeError, "drjit.sqrt"),
        (identity, {"second_bound": lambda z, r: z}, TypeError, "real number"),
        (identity, {"second_bound": lambda z, r: "1"}, TypeError, "real number"),
        (identity, {"second_bound": lambda z: 1.0}, TypeError, "z and a radius"),
        (identity, {"period": "1"}, ValueError, "positive number"),
    ):
        given: dict[str, Any] = {
            "singular_points": [],
            "second_bound": lambda z, r: 0.0,
            **settings,
        }
        with pytest.raises(error, match=words):
            hk.fields.RiemannSurface(function, **given)
    with pytest.raises(ValueError, match="level must be finite"):
        hk.fields.LevelCurves("log", level=math.nan)
