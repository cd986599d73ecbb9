"""Real-valued fields: values, gradients, harmonicity, and promises sampled in double precision."""

# l is the symbol of the degree.
# ruff: noqa: E741

from __future__ import annotations

import itertools
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.special import lpmv

from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import HarmonicBall, Lipschitz, TaylorRemainder
from harnack.fields import Field
from harnack.fields.analytic.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from harnack.fields.analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from harnack.fields.analytic.solid_harmonics import evaluate, from_monomials
from harnack.fields.analytic.sphere_bounds import (
    BallRange,
    proved_range,
    range_of_harmonic,
    unit_sphere,
)
from harnack.fields.analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from harnack.geometry import Ball, Box, HalfSpace

DOUBLE = choose_backend("double")
SINGLE = choose_backend("single")

# The paper's Fig. 21, a sum of plane waves with a constant, and one of unlike frequencies.
FIGURE_21 = EigenfunctionSum(
    [
        WaveProduct(1.0, sine_factor(6), sine_factor(6), sine_factor(6)),
        WaveProduct(1.0, sine_factor(2), sine_factor(2), sine_factor(2)),
    ]
)
PLANE_WAVES = EigenfunctionSum(
    [
        PlaneWave(0.7, (1.0, -2.0, 0.5), 0.3),
        PlaneWave(-1.1, (0.0, 1.5, 2.0), 1.0),
        WaveProduct(0.4, y=sine_factor(3.0, 0.2)),
        WaveProduct(0.25),
    ]
)
MIXED = HarmonicPolynomial(
    {(2, 1, 0): 1, (0, 1, 2): -1, (1, 0, 0): 0.3, (0, 0, 0): 0.1, (1, 1, 1): 0.5, (0, 0, 1): -2},
    domain=Ball((0.3, 0.0, -0.2), 1.5),
)
PERIODIC = {
    "gyroid": Gyroid(),
    "small gyroid": Gyroid(cell=0.01, domain=Ball(radius=0.02)),
    "P": SchwarzP(cell=2.0),
    "D": SchwarzD(),
    "figure 21": FIGURE_21,
    "plane waves": PLANE_WAVES,
}
POLYNOMIALS = {
    "Eq. 8": HarmonicPolynomial({(2, 1, 0): 1, (0, 1, 2): -1}),
    "mixed": MIXED,
    "Y_00": SphericalHarmonic(0, 0),
    "Y_10": SphericalHarmonic(1, 0),
    "Y_2-1": SphericalHarmonic(2, -1),
    "Y_42": SphericalHarmonic(4, 2, radius=3.0),
    "Y_80": SphericalHarmonic(8, 0),
    "Y_8-4": SphericalHarmonic(8, -4),
    "Y_12,5": SphericalHarmonic(12, 5),
    "Y_12,12": SphericalHarmonic(12, 12),
}
FIELDS = PERIODIC | POLYNOMIALS


def value(field: Field, points: np.ndarray) -> np.ndarray:
    return to_numpy(field.evaluate(to_vector3(DOUBLE, points)).value) + np.zeros(len(points))


def gradient(field: Field, points: np.ndarray) -> np.ndarray:
    return to_numpy(field.evaluate(to_vector3(DOUBLE, points)).gradient)


def points_in(field: Field, n: int, seed: int = 0) -> np.ndarray:
    """Points of the domain (of its box), some at its center and some at its edge."""
    assert field.domain is not None
    lower, upper = field.domain.bounds()
    points = np.random.default_rng(seed).uniform(lower, upper, (n, 3))
    inside = points[field.domain.contains_points(points)]
    center = 0.5 * (lower + upper)
    return np.concatenate([inside, [center, center + 1e-4 * (upper - lower)]])


def on_unit_sphere(n: int, dimension: int = 3, seed: int = 0) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(n, dimension))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def real_harmonic(l: int, m: int, p: np.ndarray) -> np.ndarray:
    """|p|^l Y_lm from SciPy's associated Legendre functions, in spherical coordinates."""
    r = np.linalg.norm(p, axis=1)
    phi, t = np.arctan2(p[:, 1], p[:, 0]), p[:, 2] / r
    k = abs(m)
    n = (2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k)
    legendre = (-1) ** k * lpmv(k, l, t)  # SciPy's carry the Condon-Shortley phase
    angle = np.cos(k * phi) if m >= 0 else np.sin(k * phi)
    return r**l * math.sqrt(n * (2 if m else 1)) * legendre * angle


# --- values, gradients, Laplacians ----------------------------------------------------------


@pytest.mark.parametrize("l", range(13))
def test_spherical_harmonics_agree_with_scipy(l: int) -> None:
    points = np.random.default_rng(l).uniform(-1, 1, (300, 3))
    for m in range(-l, l + 1):
        ours = evaluate({(l, m): 1.0}, *points.T)[0]
        np.testing.assert_allclose(ours, real_harmonic(l, m, points), rtol=0, atol=2e-12)


def test_spherical_harmonic_signs_and_scale() -> None:
    axes = 2.0 * np.eye(3)
    size = math.sqrt(3 / (4 * math.pi))
    for m, axis in ((1, 0), (-1, 1), (0, 2)):
        expected = np.zeros(3)
        expected[axis] = size
        np.testing.assert_allclose(
            value(SphericalHarmonic(1, m, radius=2.0), axes), expected, atol=1e-15
        )


def test_spherical_harmonics_are_orthonormal() -> None:
    # Gauss-Legendre times equal angles integrates products of degree 12 exactly.
    t, weight = np.polynomial.legendre.leggauss(16)
    phi = 2 * np.pi * np.arange(32) / 32
    s = np.sqrt(1 - t**2)
    points = np.stack(
        [np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(t, np.ones(32))]
    ).reshape(3, -1)
    weights = np.repeat(weight, 32) * 2 * np.pi / 32
    pairs = [(l, m) for l in (0, 1, 5, 11, 12) for m in range(-l, l + 1)]
    basis = np.array([evaluate({pair: 1.0}, *points)[0] for pair in pairs])
    np.testing.assert_allclose(basis * weights @ basis.T, np.eye(len(pairs)), atol=1e-12)


@pytest.mark.parametrize("name", FIELDS)
def test_gradient_is_the_derivative(name: str) -> None:
    field = FIELDS[name]
    p = points_in(field, 300)
    size = float(np.max(np.diff(field.domain.bounds(), axis=0)))  # type: ignore[union-attr]
    h = 1e-5 * size
    numeric = np.stack(
        [(value(field, p + h * e) - value(field, p - h * e)) / (2 * h) for e in np.eye(3)], axis=1
    )
    g = gradient(field, p)
    np.testing.assert_allclose(g, numeric, rtol=0, atol=1e-6 * max(np.abs(g).max(), 1e-9))


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_polynomials_are_harmonic(name: str) -> None:
    """Mean value property: the mean over a design that is exact up to degree 13."""
    field = POLYNOMIALS[name]
    t, weight = np.polynomial.legendre.leggauss(8)
    phi = 2 * np.pi * np.arange(16) / 16
    s = np.sqrt(1 - t**2)
    sphere = np.stack(
        [np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(t, np.ones(16))]
    ).reshape(3, -1)
    weights = np.repeat(weight, 16) / 32
    for p in points_in(field, 30):
        around = value(field, p + 0.3 * sphere.T)
        mean = around @ weights
        np.testing.assert_allclose(
            mean, value(field, p[None])[0], rtol=0, atol=1e-13 * (1 + np.abs(around).max())
        )


@pytest.mark.parametrize("name", PERIODIC)
def test_extension_continues_the_field(name: str) -> None:
    field = PERIODIC[name]
    p = points_in(field, 500)
    np.testing.assert_allclose(extended(field, p, np.zeros(len(p))), value(field, p), atol=1e-12)


def test_gyroid_formula_and_cell() -> None:
    x, y, z = np.random.default_rng(3).uniform(-9, 9, (3, 200))
    expected = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    p = np.stack([x, y, z], axis=1)
    np.testing.assert_allclose(value(Gyroid(), p), expected, atol=1e-13)
    np.testing.assert_allclose(value(Gyroid(cell=3.0), 3 / (2 * math.pi) * p), expected, atol=1e-12)
    np.testing.assert_allclose(value(SchwarzP(), p), np.cos(p).sum(axis=1), atol=1e-13)


def test_diamond_formula() -> None:
    p = np.random.default_rng(4).uniform(-9, 9, (200, 3))
    x, y, z = p.T
    expected = np.sin(x) * np.cos(y - z) + np.cos(x) * np.sin(y + z)
    np.testing.assert_allclose(value(SchwarzD(), p), expected, atol=1e-13)


def test_plane_waves_and_products_agree() -> None:
    p = np.random.default_rng(5).uniform(-3, 3, (200, 3))
    product = EigenfunctionSum(
        [WaveProduct(2.0, x=cosine_factor(3.0, 0.4), z=sine_factor(2.0, -0.1))]
    )
    # 2 cos a sin b = sin(b + a) + sin(b - a)
    half = math.pi / 2
    waves = EigenfunctionSum(
        [
            PlaneWave(1.0, (3.0, 0.0, 2.0), 0.3 - half),
            PlaneWave(1.0, (-3.0, 0.0, 2.0), -0.5 - half),
        ]
    )
    np.testing.assert_allclose(value(product, p), value(waves, p), atol=1e-13)
    assert product.waves.largest_value == pytest.approx(waves.waves.largest_value)
    assert product.curvature == pytest.approx(waves.curvature)


def test_opposite_wave_vectors_add_up() -> None:
    together = EigenfunctionSum(
        [PlaneWave(1.0, (1.0, 2.0, 0.0), 0.5), PlaneWave(1.0, (-1.0, -2.0, 0.0), 0.5)]
    )
    assert together.waves.largest_value == pytest.approx(2 * math.cos(0.5))


@pytest.mark.parametrize("name", [n for n in FIELDS if n != "small gyroid"])
def test_single_precision_is_accurate(name: str) -> None:
    """Also at degree 12, where monomials would lose three digits."""
    field = FIELDS[name]
    p = points_in(field, 2000).astype(np.float32).astype(float)
    sample = field.evaluate(to_vector3(SINGLE, p))
    f, g = value(field, p), gradient(field, p)
    assert np.abs(to_numpy(sample.value) - f).max() <= 4e-6 * max(np.abs(f).max(), 1)
    assert np.abs(to_numpy(sample.gradient) - g).max() <= 4e-6 * max(np.abs(g).max(), 1)


@pytest.mark.parametrize("name", ["gyroid", "Y_8-4", "mixed"])
def test_value_differentiates(name: str) -> None:
    field = FIELDS[name]
    p = points_in(field, 50)
    x = to_vector3(DOUBLE, p)
    dr.enable_grad(x)
    dr.backward(field.evaluator(DOUBLE).differentiable_value(x))
    np.testing.assert_allclose(to_numpy(dr.grad(x)), gradient(field, p), atol=1e-10)


# --- conversion from monomials --------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(4))
def test_monomials_convert_exactly(seed: int) -> None:
    """Expand random harmonic polynomials of every degree into monomials, and come back."""
    rng = np.random.default_rng(seed)
    weights = {(l, m): float(rng.normal()) for l in range(8) for m in range(-l, l + 1)}
    monomials: dict[tuple[int, int, int], float] = {}
    for (l, m), w in weights.items():
        for powers, c in expand(l, m).items():
            monomials[powers] = monomials.get(powers, 0.0) + w * c
    back = from_monomials(monomials)
    assert back.keys() == weights.keys()
    for key, w in weights.items():
        assert back[key] == pytest.approx(w, rel=1e-9, abs=1e-11)
    field = HarmonicPolynomial(monomials)
    p = points_in(field, 200)
    direct = sum(c * np.prod(p ** np.array(powers), axis=1) for powers, c in monomials.items())
    np.testing.assert_allclose(value(field, p), direct, rtol=0, atol=1e-10)


def expand(l: int, m: int) -> dict[tuple[int, int, int], float]:
    """Monomials of r^l Y_lm, by a least-squares fit to SciPy's values."""
    powers = [(i, j, l - i - j) for i in range(l + 1) for j in range(l + 1 - i)]
    p = on_unit_sphere(400, seed=l)
    matrix = np.stack([np.prod(p ** np.array(k), axis=1) for k in powers], axis=1)
    solution = np.linalg.lstsq(matrix, real_harmonic(l, m, p), rcond=None)[0]
    kept = np.where(np.abs(solution) > 1e-12, solution, 0.0)
    return {k: float(c) for k, c in zip(powers, kept, strict=True) if c}


# --- promises -------------------------------------------------------------------------------


def extended(field: EigenfunctionSum, p: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The harmonic extension to R^4, term by term from the definition of the terms."""
    total = np.zeros(len(p))
    for term in field.terms:
        if isinstance(term, PlaneWave):
            k = np.array(term.wave_vector)
            total += term.amplitude * np.cos(p @ k + term.phase) * np.cosh(np.linalg.norm(k) * w)
            continue
        part = np.full(len(p), term.amplitude)
        for axis, f in term.factors:
            angle = f.frequency * p[:, axis] + f.phase
            part *= np.cos(angle) if f.is_cosine else np.sin(angle)
        size = math.sqrt(sum(f.frequency**2 for _, f in term.factors))
        total += part * np.cosh(size * w)
    return total


def ends(known: Any, n: int) -> tuple[np.ndarray, ...]:
    return tuple(to_numpy(v) + np.zeros(n) for v in (known.radius, known.lower, known.upper))


def violation(field: Field, n_points: int, n_samples: int, seed: int = 0) -> float:
    """How far samples of the ball leave its promise, relative to its width (<= 0: never), and
    how far they get in it (1: the promise is sharp)."""
    p = points_in(field, n_points, seed)
    sample = field.evaluate(to_vector3(DOUBLE, p))
    f = to_numpy(sample.value) + np.zeros(len(p))
    balls = [k for k in sample.all_promises if isinstance(k, HarmonicBall)]
    assert balls
    worst = -np.inf
    for ball in balls:
        n = ball.dimension
        radius, lower, upper = ends(ball, len(p))
        assert (radius > 0).all()
        assert (lower <= f).all()
        assert (f <= upper).all()
        u = on_unit_sphere(n_samples, n, seed)
        # Half on the sphere, where the extremes are, half inside.
        u *= np.where(np.arange(n_samples) % 2, 1.0, np.random.default_rng(1).random(n_samples))[
            :, None
        ]
        for i in range(len(p)):
            y = p[i] + radius[i] * u[:, :3]
            if n == 4:
                assert isinstance(field, EigenfunctionSum)
                v = extended(field, y, radius[i] * u[:, 3])
            else:
                v = value(field, y)
            room = upper[i] - lower[i]
            worst = max(worst, (v.max() - upper[i]) / room, (lower[i] - v.min()) / room)
    return float(worst)


@pytest.mark.few(12)
@pytest.mark.parametrize("name", [n for n in FIELDS if n != "Y_00"])
def test_harmonic_balls_keep_their_promise(name: str) -> None:
    assert violation(FIELDS[name], n_points=120, n_samples=2000) <= 0


@pytest.mark.parametrize("name", [n for n in FIELDS if n != "Y_00"])
def test_single_precision_promises_no_more(name: str) -> None:
    """The margin of 1e-5 is for float32, and float32 must not use it up."""
    field = FIELDS[name]
    p = points_in(field, 3000).astype(np.float32).astype(float)
    exact, rounded = (
        ends(field.evaluate(to_vector3(backend, p)).alternative_promises[0], len(p))
        for backend in (DOUBLE, SINGLE)
    )
    margin = 0.45e-5 * (exact[2] - exact[1])
    assert (rounded[0] <= exact[0] * (1 + 1e-6)).all()
    assert (rounded[1] <= exact[1] + margin).all()
    assert (rounded[2] >= exact[2] - margin).all()


@pytest.mark.parametrize("name", PERIODIC)
def test_extension_is_harmonic_in_four_dimensions(name: str) -> None:
    field = PERIODIC[name]
    p = points_in(field, 100)
    k = max(field.waves.wavenumbers)
    q = np.concatenate([p, np.random.default_rng(2).uniform(-1, 1, (len(p), 1)) / k], axis=1)
    h = 1e-3 / k

    def at(points: np.ndarray) -> np.ndarray:
        return extended(field, points[:, :3], points[:, 3])

    laplacian = sum(at(q + h * e) - 2 * at(q) + at(q - h * e) for e in np.eye(4)) / h**2
    scale = max(np.abs(at(q)).max(), 1) * k**2
    assert np.abs(laplacian).max() <= 1e-5 * scale


@pytest.mark.parametrize("name", PERIODIC)
def test_lipschitz_constants_keep_their_promise(name: str) -> None:
    field = PERIODIC[name]
    p = points_in(field, 200)
    sample = field.evaluate(to_vector3(DOUBLE, p))
    f = to_numpy(sample.value)
    known = [k for k in sample.all_promises if isinstance(k, Lipschitz)]
    assert known
    for promise in known:
        constant = to_numpy(promise.constant) + np.zeros(len(p))
        u = on_unit_sphere(2000) * np.random.default_rng(1).random(2000)[:, None]
        for i in range(len(p)):
            step = float(promise.radius) * u
            change = np.abs(value(field, p[i] + step) - f[i])
            assert (change <= constant[i] * np.linalg.norm(step, axis=1) + 1e-12).all()


@pytest.mark.few(10)
@pytest.mark.parametrize("name", [n for n in FIELDS if n != "Y_00"])
def test_curvature_keeps_its_promise(name: str) -> None:
    field = FIELDS[name]
    p = points_in(field, 200)
    f, g = value(field, p), gradient(field, p)
    known = [
        k for k in field.evaluate(to_vector3(DOUBLE, p)).promises if isinstance(k, TaylorRemainder)
    ]
    assert known
    u = on_unit_sphere(2000) * np.random.default_rng(1).random(2000)[:, None]
    # A global promise is tried on a few periods.
    scale = 6 / field.curvature**0.5 if isinstance(field, EigenfunctionSum) else 1.0
    for promise in known:
        constant, radius = (
            to_numpy(v) + np.zeros(len(p)) if dr.is_array_v(type(v)) else np.full(len(p), v)
            for v in (promise.constant, promise.radius)
        )
        radius = np.where(np.isfinite(radius), radius, scale)
        for i in range(len(p)):
            y = radius[i] * u
            off = np.abs(value(field, p[i] + y) - f[i] - y @ g[i])
            assert (off <= 0.5 * constant[i] * np.sum(y * y, axis=1) + 1e-12).all()


@pytest.mark.parametrize("name", PERIODIC)
def test_proved_constants_hold_and_are_tight_for_minimal_surfaces(name: str) -> None:
    field = PERIODIC[name]
    p = np.random.default_rng(0).uniform(-1, 1, (40000, 3)) * 20 / max(field.waves.wavenumbers)
    f, g = value(field, p), np.linalg.norm(gradient(field, p), axis=1)
    low, high = field.value_range
    assert low <= f.min()
    assert f.max() <= high
    assert g.max() <= field.max_gradient
    h = 1e-4 / max(field.waves.wavenumbers)
    v = on_unit_sphere(len(p))
    bend = np.abs(np.sum((gradient(field, p + h * v) - gradient(field, p - h * v)) * v, axis=1))
    assert bend.max() / (2 * h) <= field.curvature * (1 + 1e-6)
    if isinstance(field, Gyroid | SchwarzP | SchwarzD):
        assert f.max() >= 0.97 * high
        assert g.max() >= 0.97 * field.max_gradient
        assert bend.max() / (2 * h) >= 0.93 * field.curvature


def test_minimal_surface_bounds_are_attained() -> None:
    q = math.pi / 4
    for field, top, steep in (
        (Gyroid(), (q, q, q), (0.0, 0.0, 0.0)),
        (SchwarzP(), (0.0, 0.0, 0.0), (2 * q, 2 * q, 2 * q)),
        (SchwarzD(), (q, q, q), (0.0, 0.0, 0.0)),
    ):
        assert value(field, np.array([top]))[0] == pytest.approx(field.value_range[1])
        assert np.linalg.norm(gradient(field, np.array([steep]))) == pytest.approx(
            field.max_gradient
        )


# --- proved ranges --------------------------------------------------------------------------


@pytest.mark.parametrize("l", range(1, 13))
def test_ranges_of_spherical_harmonics(l: int) -> None:
    p = np.concatenate([on_unit_sphere(20000, seed=l), np.eye(3), -np.eye(3)]).T
    t = np.linspace(0, np.pi, 20001)
    for m in range(-l, l + 1):
        low, high = range_of_harmonic(l, m)
        phi = math.pi / 2 / abs(m) if m < 0 else 0.0
        meridian = np.stack([np.sin(t) * np.cos(phi), np.sin(t) * np.sin(phi), np.cos(t)])
        f = np.concatenate([evaluate({(l, m): 1.0}, *q)[0] for q in (p, meridian)])
        assert low <= f.min()
        assert f.max() <= high
        assert max(f.max(), -f.min() if m else f.max()) >= high * (1 - 1e-4)
        assert min(f.min(), -f.max() if m else f.min()) <= low * (1 - 1e-4)


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(6))
def test_ranges_of_random_polynomials_are_proved_and_tight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    top = (2, 3, 4, 6, 9, 12)[seed]
    weights = {
        (l, m): float(rng.normal())
        for l in range(top + 1)
        for m in range(-l, l + 1)
        if rng.random() < 0.4 or (l, m) == (top, 0)
    }
    known = BallRange.of(weights).with_spheres(weights, 1.3)
    sphere = unit_sphere(0.02 / top * 2)
    for s in (0.25 * 1.3, 0.85 * 1.3, 1.3):
        f = evaluate(weights, *(s * sphere))[0]
        low, high = known.on_ball(s)
        assert low <= f.min()
        assert f.max() <= high
        slack = max(f.min() - low, high - f.max()) / (f.max() - f.min())
        assert slack <= 0.01


def test_ranges_hold_between_the_tabulated_spheres() -> None:
    weights = {(1, 0): 1.0, (3, 2): -2.0, (6, -1): 1.5, (0, 0): 0.3}
    known = BallRange.of(weights).with_spheres(weights, 1.5)
    sphere = unit_sphere(0.02)
    for s in np.linspace(0.05, 2.5, 25):
        f = evaluate(weights, *(s * sphere))[0]
        low, high = known.on_ball(float(s))
        lower, upper = (to_numpy(v)[0] for v in known.at(DOUBLE.Float(s)))
        assert (lower, upper) == pytest.approx((low, high))
        assert low <= f.min()
        assert f.max() <= high


@pytest.mark.parametrize("covering", [1.0, 0.3, 0.05, 0.01])
def test_unit_sphere_covers(covering: float) -> None:
    from scipy.spatial import cKDTree

    points = unit_sphere(covering).T
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    probes = np.concatenate([on_unit_sphere(50000), [[0, 0, 1], [0, 0, -1]]])
    # Probes near a pole and near the rings' gaps are where a mistake would show.
    probes = np.concatenate([probes, normalized(probes * [0.05, 0.05, 1])])
    chord = cKDTree(points).query(probes)[0]
    angle = 2 * np.arcsin(chord / 2).max()
    assert 0.75 * covering <= angle <= covering


def normalized(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_proved_range_is_attained_by_the_worst_case() -> None:
    """cos(L t) sampled as badly as the spacing allows: the bound holds and is no more than
    fourth order away."""
    degree, covering = 7, 0.03
    seen = math.cos(degree * covering)
    low, high = proved_range(-seen, seen, degree, covering)
    assert high >= 1
    assert high <= 1 + (degree * covering) ** 4
    assert low == pytest.approx(-high)


def test_proved_range_refuses_points_too_far_apart() -> None:
    with pytest.raises(ValueError, match="too far apart"):
        proved_range(-1.0, 1.0, 12, 0.2)


# --- levels, walls, errors ------------------------------------------------------------------


def test_levels_out_of_range_are_refused() -> None:
    Gyroid().validate_levels((0.0, 1.4))
    for field, level in (
        (Gyroid(), 1.6),
        (SchwarzD(), -1.5),
        (PLANE_WAVES, 3.0),
        (SphericalHarmonic(3, 2), 1.0),
        (SphericalHarmonic(0, 0), 0.0),
        (POLYNOMIALS["Eq. 8"], 0.4),
    ):
        with pytest.raises(ValueError, match=r"no surface has level .* stays within"):
            field.validate_levels((0.0, level) if level else (level,))


def test_a_constant_moves_the_range_only() -> None:
    plain = EigenfunctionSum([WaveProduct(1.0, sine_factor(2), sine_factor(2))])
    moved = EigenfunctionSum([WaveProduct(1.0, sine_factor(2), sine_factor(2)), WaveProduct(5.0)])
    assert moved.value_range == pytest.approx((4.0, 6.0))
    p = points_in(plain, 50)
    a, b = (f.evaluate(to_vector3(DOUBLE, p)).alternative_promises[0] for f in (plain, moved))
    for x, y, shift in zip(ends(a, len(p)), ends(b, len(p)), (0, 5, 5), strict=True):
        np.testing.assert_allclose(x + shift, y, atol=1e-12)


def test_walls() -> None:
    gyroid = Gyroid(cell=1.0)
    assert gyroid.wall_levels(0.3) == (-0.3, 0.3)
    assert gyroid.wall_levels(0.3, level=0.5) == pytest.approx((0.2, 0.8))
    low, high = gyroid.levels_of_thickness(0.1)
    assert high == pytest.approx(0.05 * math.sqrt(3) * 2 * math.pi)
    assert low == -high
    # Points of the middle surface, moved by less than half the thickness, stay in the wall.
    p = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    for _ in range(20):
        g = gradient(gyroid, p)
        p = p - (value(gyroid, p) / np.maximum(np.sum(g * g, axis=1), 1e-3))[:, None] * g
    p = p[np.abs(value(gyroid, p)) < 1e-12]
    assert len(p) > 3000
    moved = p + 0.05 * on_unit_sphere(len(p))
    assert np.abs(value(gyroid, moved)).max() <= high


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SphericalHarmonic(13, 0), "degree l must be 0 to 12, not 13"),
        (lambda: SphericalHarmonic(-1, 0), "degree l must be 0 to 12"),
        (lambda: SphericalHarmonic(3, -4), "order m must be -l to l, here -3 to 3, not -4"),
        (lambda: SphericalHarmonic(3, 1, radius=0.0), "radius of a ball must be positive"),
        (
            lambda: HarmonicPolynomial({(2, 0, 0): 1, (0, 1, 1): 3, (0, 3, 0): 1}),
            r"not harmonic: its Laplacian is 2 \+ 6 y, not 0",
        ),
        (lambda: HarmonicPolynomial({(2, 0, 0): 1, (0, 2, 0): -1.001}), "its Laplacian is"),
        (lambda: HarmonicPolynomial({}), "needs a coefficient"),
        (lambda: HarmonicPolynomial({(1, 0, 0): 0.0}), "needs a coefficient"),
        (lambda: HarmonicPolynomial({(1, 0): 1.0}), r"\(1, 0\) is no exponent"),  # type: ignore[dict-item]
        (lambda: HarmonicPolynomial({(-1, 0, 0): 1.0}), "must not be negative"),
        (lambda: HarmonicPolynomial({(1, 0, 0): math.nan}), r"\(1, 0, 0\) is nan"),
        (lambda: HarmonicPolynomial({(13, 0, 0): 1.0}), r"x\^13 has degree 13: at most 12"),
        (
            lambda: HarmonicPolynomial({(1, 0, 0): 1.0}, domain=HalfSpace((0, 0, 1), 0.0)),
            "bounded domain",
        ),
        (lambda: EigenfunctionSum([]), "at least one term"),
        (lambda: EigenfunctionSum([WaveProduct(2.0)]), "the sum is constant"),
        (
            lambda: EigenfunctionSum(
                [WaveProduct(1.0, sine_factor(1)), WaveProduct(-1.0, sine_factor(1))]
            ),
            "the sum is constant",
        ),
        (
            lambda: EigenfunctionSum([WaveProduct(math.inf, sine_factor(1))]),
            "amplitude of a product must",
        ),
        (lambda: EigenfunctionSum([PlaneWave(1.0, (1.0, 2.0))]), "three numbers"),  # type: ignore[arg-type]
        (lambda: sine_factor(0.0), "frequency 0 is a constant"),
        (lambda: cosine_factor(math.nan), "frequency of a factor must be finite"),
        (lambda: Gyroid(cell=0.0), "edge length of the cell must be positive"),
        (lambda: SchwarzP(cell=math.inf), "edge length of the cell must be positive"),
        (lambda: Gyroid().wall_levels(-1.0), "half width of a wall must be positive"),
        (lambda: Gyroid().wall_levels(2.0), "a side without surface"),
        (lambda: Gyroid().levels_of_thickness(9.0), "a side without surface"),
    ],
)
def test_errors_say_what_is_wrong(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_wrong_types_are_refused() -> None:
    with pytest.raises(TypeError):
        SphericalHarmonic(1.5, 0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="term 0 must be a Product or a PlaneWave"):
        EigenfunctionSum(["sin x"])  # type: ignore[list-item]


def test_domains() -> None:
    assert Gyroid(cell=2.0).domain == Ball(radius=2.0)
    assert FIGURE_21.domain == Ball(radius=2 * math.pi / math.sqrt(12))
    box = Box((0, 0, 0), (1, 2, 3))
    assert Gyroid(domain=box).domain == box
    field = HarmonicPolynomial({(1, 1, 0): 1.0}, domain=box)
    assert field.domain == box
    # The promise covers the box's far corner: no violation there.
    corners = np.array(list(itertools.product((0, 1), (0, 2), (0, 3))), dtype=float)
    assert field.value_range[1] >= value(field, corners).max()
    assert violation(field, 60, 1000) <= 0


def test_promises_at_the_origin_are_finite() -> None:
    for field in (*POLYNOMIALS.values(), Gyroid()):
        sample = field.evaluate(to_vector3(SINGLE, np.zeros((1, 3))))
        for number in (sample.value, sample.gradient, *ends(sample.alternative_promises[0], 1)):
            assert np.isfinite(to_numpy(number) if dr.is_array_v(type(number)) else number).all()
