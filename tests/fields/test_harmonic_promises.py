"""Polynomials close to their zeros of high order, and how far rounding moves them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import upload_floats
from harnack.backend.elementary import safe_norm
from harnack.enclosures import HarmonicBall, Lipschitz, TaylorRemainder
from harnack.enclosures.harmonic_ball import (
    HarnackEnclosure,
    HarnackSlopeEnclosure,
    SphericalCapEnclosure,
)
from harnack.enclosures.parabola import LipschitzEnclosure, TaylorEnclosure
from harnack.fields.analytic.rounding import HarmonicRounding
from harnack.fields.analytic.solid_harmonics import Weights, evaluate, hessian
from harnack.fields.analytic.sphere_bounds import (
    AxialBound,
    gradient_bound,
    hessian_bound,
    order_on_axis,
    value_bound,
)
from harnack.testing.enclosure_contracts import PromiseCase
from harnack.testing.violation_search import sample_field
from tests.oracles.step_contracts import check_steps

SINGLE, DOUBLE = choose_backend("single"), choose_backend("double")
UNIT = 2.0**-24


def points_near_axis_and_origin(n: int, rng: np.random.Generator) -> np.ndarray:
    """Points of the unit ball, a quarter of them close to the z axis, at all sizes down to 0.1."""
    p = rng.normal(size=(n, 3))
    p[: n // 4, :2] *= 10 ** rng.uniform(-3, 0, (n // 4, 1))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    return 0.999999 * p * 10 ** rng.uniform(-1, 0, (n, 1))


def on_host(array: Any, n: int) -> np.ndarray:
    values = to_numpy(array) if dr.is_array_v(type(array)) else np.asarray(array)
    return np.broadcast_to(values, (n, *values.shape[1:])).astype(np.float64)


def rounding_used(weights: Weights, n: int, seed: int) -> tuple[float, float]:
    """The largest errors of value and gradient in single precision, as shares of their bounds."""
    p = points_near_axis_and_origin(n, np.random.default_rng(seed)).astype(np.float32)
    x = to_vector3(SINGLE, p)
    f, g = evaluate(weights, x.x, x.y, x.z)
    p = p.astype(np.float64)
    exact_f, exact_g = evaluate(weights, *p.T)
    rounding = HarmonicRounding.of(weights, is_divided=False)
    rho, r = (
        upload_floats(DOUBLE, one)
        for one in (np.hypot(p[:, 0], p[:, 1]), np.linalg.norm(p, axis=1))
    )
    lost = 2.0**-126 * rounding.underflow
    of_value = UNIT * on_host(rounding.value_error(rho, r), n) + lost
    of_gradient = UNIT * on_host(rounding.gradient_error(rho, r), n) + 100 * lost
    off = np.stack([on_host(a, n) - b for a, b in zip(g, exact_g, strict=True)], axis=1)
    used = np.abs(on_host(f, n) - exact_f) / of_value
    return float(used.max()), float((np.linalg.norm(off, axis=1) / of_gradient).max())


@pytest.mark.few(2)
@pytest.mark.parametrize("l", range(13))
def test_rounding_of_harmonics_is_within_its_bound(l: int) -> None:  # noqa: E741
    """And the bound is never ten times the largest error seen."""
    for m in range(-l, l + 1):
        of_value, of_gradient = rounding_used({(l, m): 1.0}, 4000, l)
        assert of_value <= 1
        assert of_gradient <= 1
        assert l == 0 or of_value > 0.1


@pytest.mark.few(5)
@pytest.mark.parametrize("seed", range(12))
def test_rounding_of_sums_is_within_its_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    degree = int(rng.integers(1, 13))
    weights = {
        (l, m): float(rng.normal() * 10 ** rng.uniform(-2, 0))
        for l in range(degree + 1)  # noqa: E741
        for m in range(-l, l + 1)
        if rng.random() < 0.6
    }
    of_value, of_gradient = rounding_used(weights, 4000, seed)
    assert 0.05 < of_value <= 1
    assert of_gradient <= 1


@pytest.mark.parametrize("radius", [1.0, 0.7, 30.0])
@pytest.mark.parametrize(("l", "m"), [(2, -2), (4, 2), (9, 9), (12, 5), (12, 0)])
def test_error_of_a_sample_covers_single_precision(l: int, m: int, radius: float) -> None:  # noqa: E741
    """Also the division by the radius; eight units in the last place are for the tracer."""
    field = hk.SphericalHarmonic(l, m, radius=radius)
    p = points_near_axis_and_origin(6000, np.random.default_rng(l)) * radius
    p = p.astype(np.float32).astype(np.float64)
    exact, rounded = sample_field(field, p), sample_field(field, p, "single")
    assert (np.abs(rounded.value - exact.value) <= rounded.error).all()
    # What Taylor's formula says with the rounded numbers holds of the exact function.
    for k, one in enumerate(rounded.promises):
        if isinstance(one, TaylorRemainder):
            true = exact.promises[k]
            assert isinstance(true, TaylorRemainder)
            off = np.linalg.norm(rounded.gradient - exact.gradient, axis=1)
            t = np.minimum(one.radius, radius)[:, None] * np.geomspace(1e-6, 1, 25)
            spare = rounded.error - np.abs(rounded.value - exact.value)
            share = 1 - 2.0e-5  # of the promise, which is what the Hessian itself needs at most
            spare = spare[:, None] + 0.5 * (one.constant - share * true.constant)[:, None] * t * t
            assert (off[:, None] * t <= spare).all()


@pytest.mark.few(4)
@pytest.mark.parametrize("l", [1, 2, 3, 5, 8, 12])
def test_bounds_near_the_axis_hold_and_are_attained(l: int) -> None:  # noqa: E741
    rng = np.random.default_rng(l)
    p = points_near_axis_and_origin(20000, rng)
    rho, r = np.hypot(p[:, 0], p[:, 1]), np.linalg.norm(p, axis=1)
    for m in range(l + 1):
        weights = {(l, m): 0.6, (l, -m): 0.8} if m else {(l, 0): 1.0}
        f, g = evaluate(weights, *p.T)
        steepness = np.linalg.norm(np.stack([one + 0 * r for one in g], axis=1), axis=1)
        xx, yy, zz, xy, xz, yz = (one + 0 * r for one in hessian(weights, *p.T))
        rows = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        bent = np.abs(np.linalg.eigvalsh(rows)).max(axis=1)
        for what, bound in (
            (np.abs(f), value_bound(weights)),
            (steepness, gradient_bound(weights)),
            (bent, hessian_bound(weights)),
        ):
            if not bound.rows:
                continue
            share = (what / bound(rho, r)).max()
            assert 0.97 < share <= 1 + 1e-12


def test_sums_of_powers() -> None:
    terms = {(5, 0): 2.0, (5, 3): 1.0, (2, 7): 0.25, (0, 1): 3.0}
    bound = AxialBound.of(terms)
    for rho, r in ((0.3, 0.7), (0.0, 0.5), (1.0, 1.0)):
        expected = sum(c * rho**i * r**j for (i, j), c in terms.items())
        assert bound(rho, r) == pytest.approx(expected, rel=1e-14)
    assert AxialBound.of({})(0.5, 0.5) == 0
    # A power of r that occurs with two powers of rho counted twice.
    assert AxialBound.of({(1, 2): 1.0, (0, 2): 0.5})(0.5, 0.5) == 0.25
    assert order_on_axis({(0, 0): 1.0, (9, -4): 1.0, (12, 7): 2.0}) == 4


@pytest.mark.parametrize("name", ["(9, 9)", "(12, -6)", "(3, 0)", "two of order 4", "about x"])
def test_promises_near_zeros_of_high_order_hold(name: str) -> None:
    """Sampled, relative to what is promised there, which is as small as f is."""
    field = POLYNOMIALS[name]
    rng = np.random.default_rng(1)
    p = points_near_axis_and_origin(300, rng)
    p[:100, :2] *= 1e-2
    p[100:200] *= 1e-2
    look = sample_field(field, p)
    u = rng.normal(size=(400, 3))
    u *= (np.where(rng.random(400) < 0.5, 1, rng.random(400)) / np.linalg.norm(u, axis=1))[:, None]
    for known in look.promises:
        y = p[:, None] + known.radius[:, None, None] * u
        moved = sample_field(field, y.reshape(-1, 3)).value.reshape(300, 400) - look.value[:, None]
        length = known.radius[:, None] * np.linalg.norm(u, axis=1)
        if isinstance(known, HarmonicBall):
            room = np.maximum(known.upper - look.value, look.value - known.lower)[:, None]
            assert (moved <= (known.upper - look.value)[:, None] + 1e-15 * room).all()
            assert (moved >= (known.lower - look.value)[:, None] - 1e-15 * room).all()
        elif isinstance(known, Lipschitz):
            room = known.constant[:, None] * length
            assert (np.abs(moved) <= room * (1 + 1e-12)).all()
        else:
            slope = known.radius[:, None] * (look.gradient @ u.T)
            # Differences of values of the size of f itself carry its rounding.
            rounding = 4e-15 * (np.abs(look.value)[:, None] + np.abs(slope)) + look.error[:, None]
            assert (
                np.abs(moved - slope) <= 0.5 * known.constant[:, None] * length**2 + rounding
            ).all()


POLYNOMIALS = {
    "(9, 9)": hk.SphericalHarmonic(9, 9),
    "(12, -6)": hk.SphericalHarmonic(12, -6),
    "(3, 0)": hk.SphericalHarmonic(3, 0),
    # Re (x + iy)^4 (1 + z)
    "two of order 4": hk.HarmonicPolynomial(
        {(4, 0, 0): 1, (2, 2, 0): -6, (0, 4, 0): 1, (4, 0, 1): 1, (2, 2, 1): -6, (0, 4, 1): 1}
    ),
    # Im (y + iz)^5
    "about x": hk.HarmonicPolynomial({(0, 4, 1): 5, (0, 2, 3): -10, (0, 0, 5): 1}),
}


def rays(kind: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """From a sphere of radius 2.5: to anywhere, through the origin, by it, or by the z axis."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 2.5 / np.linalg.norm(o, axis=1, keepdims=True)
    aside = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-7, -1, (n, 1))
    if kind == "anywhere":
        to = rng.normal(size=(n, 3))
        to *= rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(to, axis=1, keepdims=True)
    elif kind == "origin":
        to = np.zeros((n, 3))
    elif kind == "by the origin":
        to = aside
    else:
        to = 0.1 * aside
        to[:, 2] += rng.uniform(-1, 1, n)
    return o, (to - o) / np.linalg.norm(to - o, axis=1, keepdims=True)


PRECISIONS = ["double", "single"]


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("enclosures", [None, "caps", "slope"])
def test_rays_by_zeros_of_high_order_arrive(enclosures: str | None, precision: Any) -> None:
    """Of rays through the origin 97 % ran out of steps in double precision."""
    for field in (hk.SphericalHarmonic(9, 9), hk.SphericalHarmonic(12, 6)):
        for kind, most in (
            ("anywhere", 0),
            ("origin", 6),
            ("by the origin", 6),
            ("by the axis", 6),
        ):
            o, d = rays(kind, 2000, 3)
            hits = hk.trace(field, o, d, enclosures=enclosures, precision=precision)
            spent = hits.status == hk.RayStatus.OUT_OF_STEPS
            assert spent.sum() <= most, (kind, field.l)


@pytest.mark.parametrize("enclosures", [None, "caps"])
def test_the_axis_of_high_order_may_be_any(enclosures: str | None) -> None:
    o, d = rays("by the axis", 2000, 4)
    turned = [np.roll(one, 1, axis=1) for one in (o, d)]  # z becomes x
    hits = hk.trace(POLYNOMIALS["about x"], *turned, enclosures=enclosures, precision="double")
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert hits.evaluations.mean() < 90


@pytest.mark.parametrize("enclosures", [None, "caps"])
def test_levels_beside_that_of_the_zero_are_reached(enclosures: str | None) -> None:
    """Rays that start at the zero, where the balls for level 0 have no room."""
    field = hk.SphericalHarmonic(9, 9)
    d = rays("origin", 300, 5)[1]
    hits = hk.trace(
        field, np.zeros((1, 3)), d, level=0.05, enclosures=enclosures, precision="double"
    )
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert hits.is_hit.sum() > 10
    assert np.abs(sample_field(field, hits.position[hits.is_hit]).value - 0.05).max() < 1e-3


@pytest.mark.parametrize(("l", "m"), [(2, -2), (4, 2), (8, 4), (12, 5)])
def test_single_precision_hits_are_as_close_as_documented(l: int, m: int) -> None:  # noqa: E741
    """Hits of x y = 0 were 7e-5 off, the error being that of the largest value in a ball."""
    field = hk.SphericalHarmonic(l, m)
    o, d = rays("anywhere", 4000, 6)
    hits = hk.trace(field, o, d, tolerance=1e-6)
    p = hits.position[hits.is_hit].astype(np.float64)
    look = sample_field(field, p)
    off = np.abs(look.value) / np.linalg.norm(look.gradient, axis=1)
    error = sample_field(field, p, "single").error / np.linalg.norm(look.gradient, axis=1)
    size = np.abs(o).max() + 2.5
    assert np.median(off) < 6e-6
    # Twice what rounding of the value and of the point may be, each.
    assert (off <= 2.1 * (8 * UNIT * size + error) + 1.05e-6).all()


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "enclosures",
    [
        HarnackEnclosure,
        HarnackSlopeEnclosure,
        SphericalCapEnclosure,
        LipschitzEnclosure,
        TaylorEnclosure,
    ],
)
def test_no_level_lies_within_a_step_near_the_zeros(enclosures: Any) -> None:
    assert check_steps(POLYNOMIALS["(12, -6)"], enclosures, count=150) > 0


@pytest.mark.parametrize("precision", ["single", "double"])
def test_steps_do_not_depend_on_the_unit_of_the_value(precision: Any) -> None:
    """Close to a zero of order 12 values, slopes and second derivatives are below 1e-25."""
    backend = choose_backend(precision)
    rng = np.random.default_rng(7)
    slope, h, up, down = (10 ** rng.uniform(-3, 0, 200) for _ in range(4))
    slope *= rng.choice([-1, 1], 200)

    def step(unit: float) -> np.ndarray:
        one, *rest = (backend.Float(unit * v) for v in (slope, h, up, down))
        return to_numpy(
            PromiseCase(TaylorRemainder(rest[0]), rest[2], rest[1]).step(TaylorEnclosure, one)
        )

    expected = step(1.0)
    assert (expected > 0).all()
    for unit in (2.0**-100, 2.0**90):
        np.testing.assert_allclose(step(unit), expected, rtol=4e-6)


def test_a_function_without_slope_or_curvature_moves_nowhere() -> None:
    real = DOUBLE.Float
    flat = PromiseCase(TaylorRemainder(real(0.0), real(3.0)), real(1.0), real(1.0))
    assert to_numpy(flat.step(TaylorEnclosure, real(0.0)))[0] == pytest.approx(3.0)
    on_level = PromiseCase(TaylorRemainder(real(0.0), real(3.0)), real(1.0), real(0.0))
    assert to_numpy(on_level.step(TaylorEnclosure, real(0.0)))[0] == 0


@pytest.mark.parametrize("precision", ["single", "double"])
def test_lengths_of_very_short_and_long_vectors(precision: Any) -> None:
    backend = choose_backend(precision)
    tiny, huge = (1e-32, 1e38) if precision == "single" else (1e-302, 1e308)
    rng = np.random.default_rng(8)
    v = rng.normal(size=(3000, 3)) * 10 ** rng.uniform(-4, 0, (3000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    sizes = 10 ** rng.uniform(np.log10(tiny), np.log10(huge), 3000)
    found = to_numpy(safe_norm(to_vector3(backend, v * sizes[:, None])))
    np.testing.assert_allclose(found, sizes, rtol=1e-6 if precision == "single" else 1e-14)
    assert to_numpy(safe_norm(backend.Array3f(0.0, 0.0, 0.0)))[0] == 0
    for k in range(3):
        one = [1.0, 1.0, 1.0]
        one[k] = float("nan")
        assert np.isnan(to_numpy(safe_norm(backend.Array3f(*one)))[0])


@pytest.mark.parametrize("precision", ["single", "double"])
def test_distances_near_a_zero_of_high_order(precision: Any) -> None:
    """Squares of gradients below 1e-19 vanish in single precision: a proved lower bound was 21
    times the distance, since all slopes seemed to be zero."""
    field = hk.SphericalHarmonic(12, 12)
    rng = np.random.default_rng(0)
    rho, angle = 10 ** rng.uniform(-2.4, -1, 2000), rng.uniform(0, 2 * np.pi, 2000)
    p = np.stack([rho * np.cos(angle), rho * np.sin(angle), 0 * rho], axis=1)
    p = p.astype(np.float32).astype(np.float64)
    # The surface is 24 half planes through the z axis, at odd multiples of pi/24.
    off = np.abs((np.arctan2(p[:, 1], p[:, 0]) - np.pi / 24) % (np.pi / 12))
    true = np.hypot(p[:, 0], p[:, 1]) * np.sin(np.minimum(off, np.pi / 12 - off))

    def distance(method: Any) -> np.ndarray:
        return np.abs(hk.signed_distance(field, p, method=method, precision=precision))

    assert (distance("lower_bound") <= true).all()
    assert np.median(distance("lower_bound") / true) > 0.5
    # |f|/|grad f| = rho |cos 12 phi|/12.
    first = rho * np.abs(np.cos(12 * np.arctan2(p[:, 1], p[:, 0]))) / 12
    np.testing.assert_allclose(distance("first_order"), first, atol=1e-7)
