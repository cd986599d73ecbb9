"""The screened winding number: kernel, bounds, tree, promises, first hits."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.special import eval_legendre, spherical_in, spherical_kn

import harnack as hk
from harnack.backend import choose_backend, to_float, to_numpy, to_vector3
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.fields.solid_angles.screened import (
    ScreenedWindingNumber,
    YukawaKernel,
    accepting_distance,
    thetas,
)
from harnack.fmm.radial_kernel import dipole_source
from harnack.fmm.radial_tree import (
    TaylorMoments,
    cluster_source,
    coefficients,
    taylor_tree_moments,
)
from harnack.fmm.treecode import dipole_records
from harnack.geometry import example_meshes
from harnack.geometry.clouds import CloudError
from harnack.geometry.meshes import MeshError
from harnack.testing import check_field
from harnack.testing.violation_search import random_directions, sample_field
from harnack.tree import build_balanced_tree
from tests.oracles.oracle import OracleValues, first_crossings

DOUBLE = choose_backend("double")
Cloud = tuple[np.ndarray, np.ndarray, np.ndarray]


def kernel(z: np.ndarray, m: np.ndarray, kappa: float) -> tuple[np.ndarray, np.ndarray]:
    """-m.grad K and its gradient in x = -z, (..., 3) each, as textbooks have them."""
    rho = np.linalg.norm(z, axis=-1)
    with np.errstate(under="ignore"):
        decay = np.exp(-kappa * rho)
    first = -(1 + kappa * rho) * decay / rho**2  # K'
    second = (2 + 2 * kappa * rho + (kappa * rho) ** 2) * decay / rho**3  # K''
    n = z / rho[..., None]
    along = (m * n).sum(axis=-1)
    hessian_m = ((second - first / rho) * along)[..., None] * n + (first / rho)[..., None] * m
    return -first * along, hessian_m


def exact(field: ScreenedWindingNumber, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """w and its gradient at x (..., 3), by the plain sum in NumPy."""
    flat = x.reshape(-1, 3)
    m = field.areas[:, None] * field.normals / (4 * math.pi)
    value, gradient = np.empty(len(flat)), np.empty((len(flat), 3))
    for start in range(0, len(flat), 200):
        some = slice(start, start + 200)
        f, g = kernel(field.points[None] - flat[some, None], m[None], 1 / field.length)
        value[some], gradient[some] = f.sum(axis=1), g.sum(axis=1)
    return value.reshape(x.shape[:-1]), gradient.reshape(x.shape)


def sphere_cloud(rng: np.random.Generator, n: int) -> Cloud:
    normals = random_directions(rng, n)
    return normals.copy(), normals, np.full(n, 4 * math.pi / n)


def torus_cloud(rng: np.random.Generator, n: int) -> Cloud:
    s, t = rng.uniform(0, 2 * math.pi, (2, n))
    out = np.stack([np.cos(s), np.sin(s), np.zeros(n)], axis=1)
    normals = np.cos(t)[:, None] * out + np.sin(t)[:, None] * np.array([0, 0, 1.0])
    return out + 0.4 * normals, normals, 0.4 * (1 + 0.4 * np.cos(t)) * 4 * math.pi**2 / n


def soup(rng: np.random.Generator, n: int) -> Cloud:
    """Nothing fits anything: areas over two decades, normals at random."""
    areas = 10 ** rng.uniform(-3, -1, n)
    return rng.normal(size=(n, 3)), random_directions(rng, n), areas


def field_of(cloud: Cloud, length: float, **options: Any) -> ScreenedWindingNumber:
    return ScreenedWindingNumber(*cloud, length=length, **options)


# ---------------------------------------------------------------- the kernel


def test_derivative_of_the_yukawa_kernel_has_the_factor_one_plus_rho_over_l() -> None:
    """With it the kernel solves the screened equation; as seed texts print it, it does not."""
    kappa, m, h = 1.7, np.array([0.3, -0.5, 0.8]), 1e-3

    def right(z: np.ndarray) -> np.ndarray:
        return kernel(z, m, kappa)[0]

    def without(z: np.ndarray) -> np.ndarray:
        rho = np.linalg.norm(z, axis=-1)
        return (z @ m) * np.exp(-kappa * rho) / rho**3

    z = np.random.default_rng(0).uniform(0.3, 1, (100, 3))
    off = {}
    for f in (right, without):
        steps = h * np.concatenate([np.eye(3), -np.eye(3)])
        laplacian = (f(z[:, None] + steps).sum(axis=1) - 6 * f(z)) / h**2
        off[f] = np.median(np.abs(laplacian / (kappa**2 * f(z)) - 1))
    assert off[right] < 1e-3
    assert off[without] > 0.5


def test_addition_theorem() -> None:
    """exp(-rho/l)/rho = (1/l) sum (2k+1) i_k k_k P_k, with k_0(t) = exp(-t)/t: SciPy's times
    2/pi. (k_k is the same sum of positive terms as theta_k, divided by t^(k+1) exp(t).)"""
    length, inner, outer, cosine = 0.7, 0.4, 1.3, 0.35
    rho = math.sqrt(inner**2 + outer**2 - 2 * inner * outer * cosine)
    k = np.arange(40)
    a, b = inner / length, outer / length
    decaying = 2 / math.pi * spherical_kn(k, b)
    terms = (2 * k + 1) * spherical_in(k, a) * decaying * eval_legendre(k, cosine)
    assert terms.sum() / length == pytest.approx(math.exp(-rho / length) / rho, rel=1e-13)
    ours = [theta * math.exp(-b) / b ** (j + 1) for j, theta in enumerate(thetas(b, 5))]
    np.testing.assert_allclose(ours, decaying[:6], rtol=1e-13)


def test_kernel_in_single_precision_from_far_below_a_length_to_a_hundred() -> None:
    rng = np.random.default_rng(1)
    n = 20_000
    tau = 10 ** rng.uniform(-4, 2, n)
    rows = dipole_records(random_directions(rng, n), random_directions(rng, n))
    results = []
    for precision in ("double", "single"):
        backend = choose_backend(precision)  # type: ignore[arg-type]
        number = np.float64 if precision == "double" else np.float32
        row = [to_float(backend, column) for column in rows.astype(np.float32).T.astype(number)]
        kappa = to_float(backend, tau.astype(np.float32).astype(number))
        yukawa = YukawaKernel(backend, 1.0)
        yukawa.kappa = kappa  # another in each lane
        terms = dipole_source(row, backend.Array3f(0), yukawa, 2).terms
        parts = [terms.value, *terms.gradient, *terms.hessian.components()]  # type: ignore[union-attr]
        results.append(np.stack([np.broadcast_to(to_numpy(part), n) for part in parts]))
    scale = np.abs(results[0]).max(axis=0)
    some = tau < 79  # beyond that both stay at exp(-80)
    off = np.abs(results[1] - results[0]).max(axis=0)[some]
    # A relative error of epsilon tau in the exponent is the worst.
    assert (off <= 2e-6 * (1 + tau[some]) * scale[some] + 1e-36).all()
    assert (scale[~some] < 1e-28).all()


# ---------------------------------------------------------------- bounds of derivatives


def series_of_yukawa(c: np.ndarray, kappa: np.ndarray, count: int) -> np.ndarray:
    """Taylor coefficients (count, n) of K along lines that leave rho = 1 at an angle of cosine c,
    by arithmetic of power series: rho' rho = c + s, K' = -K (kappa + 1/rho) rho'."""

    def product(a: np.ndarray, b: np.ndarray, k: int) -> np.ndarray:
        return sum((a[j] * b[k - j] for j in range(k + 1)), start=np.zeros_like(c))

    rho, inverse = np.zeros((2, count, len(c)))
    slope, rate, out = np.zeros((3, count, len(c)))
    rho[0] = inverse[0] = 1
    out[0] = np.exp(-kappa)
    for k in range(count - 1):
        q = c if k == 0 else np.ones_like(c) if k == 1 else np.zeros_like(c)
        slope[k] = q - sum((rho[j] * slope[k - j] for j in range(1, k + 1)), start=0 * c)
        rate[k] = product(inverse, slope, k) + kappa * slope[k]
        out[k + 1] = -product(out, rate, k) / (k + 1)
        rho[k + 1] = slope[k] / (k + 1)
        inverse[k + 1] = -sum((rho[j] * inverse[k + 1 - j] for j in range(1, k + 2)), start=0 * c)
    return out


def incomplete(order: int, t: np.ndarray) -> np.ndarray:
    """Q_order(t)."""
    return np.exp(-t) * sum(t**j / math.factorial(j) for j in range(order + 1))


def test_derivatives_are_largest_along_the_line_to_the_pole() -> None:
    """|d^m K[u, ..., u]| <= m! Q_m(tau)/rho^(m+1), attained at u = +-z/rho: 100,000 lines."""
    rng = np.random.default_rng(2)
    c, tau = rng.uniform(-1, 1, 100_000), 10 ** rng.uniform(-4, 2, 100_000)
    c[:2000] = np.sign(c[:2000])
    series = series_of_yukawa(c, tau, 7)
    for m in range(1, 7):
        bound = incomplete(m, tau)
        assert (np.abs(series[m]) <= bound * (1 + 1e-9)).all()
        np.testing.assert_allclose(np.abs(series[m, :2000]), bound[:2000], rtol=1e-9)


# ---------------------------------------------------------------- clusters


def seen(level: TaylorMoments, x: np.ndarray, kappa: float) -> tuple[Any, ...]:
    """Clusters from x (k, 3): value, gradient, error, gradient_error, sums as NumPy arrays."""
    zeros = np.zeros((len(x), 4))
    head = np.concatenate([zeros, level.radius[:, None], level.weight[:, None]], axis=1)
    c = np.concatenate([coefficients(level), level.third[:, None]], axis=1)
    z = level.center - x
    source = cluster_source(
        [to_float(DOUBLE, column) for column in head.T],
        [to_float(DOUBLE, column) for column in c.T],
        to_vector3(DOUBLE, z),
        to_float(DOUBLE, np.linalg.norm(z, axis=1)),
        YukawaKernel(DOUBLE, kappa),
        1,
    )
    return tuple(
        np.broadcast_to(to_numpy(one), (len(x), *to_numpy(one).shape[1:]))
        for one in (source.terms.value, source.terms.gradient, source.error, source.gradient_error)
    )


def repeated(level: TaylorMoments, views: int) -> TaylorMoments:
    return TaylorMoments(*(np.repeat(value, views, axis=0) for value in vars(level).values()))


@pytest.mark.few(1)
@pytest.mark.parametrize("kappa", [1e-3, 1.0, 30.0])
def test_truncation_stays_within_its_bound(kappa: float) -> None:
    """100,000 views of clusters of 8 to 2048 dipoles, their moments moved up from the leaves."""
    rng = np.random.default_rng(3)
    n = 8192
    rows = dipole_records(rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    tree = build_balanced_tree(rows[:, :3], leaf_size=8, arity=4)
    worst = 0.0
    for level, views in zip(taylor_tree_moments(tree, rows)[:5], (25, 40, 40, 40, 40), strict=True):
        count = len(level.radius)
        members = tree.values_in_slots(rows).reshape(count, -1, 8)
        level = repeated(level, views)
        away = level.radius * 10 ** rng.uniform(0.02, 1.5, len(level.radius))
        x = level.center + away[:, None] * random_directions(rng, len(away))
        value, gradient, error, slope = seen(level, x, kappa)
        f, g = np.zeros(len(x)), np.zeros((len(x), 3))
        for k in range(members.shape[1]):
            row = np.repeat(members[:, k], views, axis=0)
            more = kernel(row[:, :3] - x, row[:, 3:6], kappa)
            f, g = f + more[0], g + more[1]
        least = 1e-26 * level.weight / (away - level.radius) ** 3  # exponentials end at exp(-80)
        off = np.abs(value - f)
        assert (off <= error * (1 + 1e-9) + 1e-12 * np.abs(f) + least).all()
        slope_off = np.linalg.norm(gradient - g, axis=1)
        size = np.linalg.norm(g, axis=1)
        assert (slope_off <= slope * (1 + 1e-9) + 1e-12 * size + least).all()
        worst = max(worst, (off / error)[error > 1e-20].max())
    assert worst > 0.1


def test_truncation_bound_is_attained() -> None:
    """By a dipole on the line to x that points along it, without screening."""
    m, d = np.array([[0.0, 0, 1]]), np.array([[0.0, 0, 0.3]])
    t2 = np.einsum("ki,kj->kij", m, d)
    t3 = np.einsum("kij,kl->kijl", t2, d)
    radius, one = np.array([0.3]), np.ones(1)
    level = TaylorMoments(np.zeros((1, 3)), radius, one, radius**3, m, t2, t3)
    x = np.array([[0.0, 0, 0.7]])
    value, gradient, error, slope = seen(level, x, 1e-9)
    f, g = kernel(d - x, m, 1e-9)
    assert np.abs(value - f) / error == pytest.approx(1, abs=1e-6)
    assert np.linalg.norm(gradient - g) / slope == pytest.approx(1, abs=1e-6)


def test_clusters_are_accepted_from_the_distance_asked_for() -> None:
    radius = np.array([0.0, 1e-3, 0.1, 1.0])
    plain = accepting_distance(radius, 1e-9, 6.0)
    np.testing.assert_allclose(plain, 6 * radius, atol=2e-5)
    screened = accepting_distance(radius, 100.0, 6.0)
    assert (screened <= plain).all()
    assert (screened >= 1.5 * radius).all()
    assert screened[3] < 2


# ---------------------------------------------------------------- the field

SMALL: dict[str, ScreenedWindingNumber] = {}
_RNG = np.random.default_rng(4)
for _name, _cloud, _length in (
    ("sphere, short", sphere_cloud(_RNG, 200), 0.1),
    ("sphere", sphere_cloud(_RNG, 200), 0.5),
    ("torus, long", torus_cloud(_RNG, 300), 100.0),
    ("soup", soup(_RNG, 40), 0.3),
    ("one", soup(_RNG, 1), 0.2),
):
    SMALL[_name] = field_of(_cloud, _length)
_p, _n, _a = torus_cloud(_RNG, 150)
SMALL["large"] = field_of((1e3 * _p + 2e3, _n, 1e6 * _a), 300.0)
SMALL["small"] = field_of((1e-3 * _p - 1e-3, _n, 1e-6 * _a), 1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(one, marks=() if one in ("sphere", "soup", "large") else pytest.mark.slow)
        for one in SMALL
    ],
)
def test_field_keeps_its_promises(name: str) -> None:
    field = SMALL[name]
    levels = (field.default_level, 0.5, -0.2)
    check_field(field, count=60, directions=4, levels=levels)


@pytest.mark.parametrize("name", SMALL)
def test_values_are_those_of_the_plain_sum(name: str) -> None:
    field = SMALL[name]
    rng = np.random.default_rng(5)
    low, high = field.points.min(axis=0), field.points.max(axis=0)
    size = float((high - low).max()) or 1.0
    x = (rng.uniform(low - 0.3 * size, high + 0.3 * size, (300, 3))).astype(np.float32)
    value, gradient = exact(field, x.astype(np.float64))
    np.testing.assert_allclose(field.value(x, precision="double"), value, rtol=1e-9, atol=1e-13)
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(
        field.gradient(x, precision="double"), gradient, rtol=1e-9, atol=1e-12 * scale
    )
    assert (np.abs(field.value(x) - value) <= field.error_bound(x) + 1e-30).all()


def test_trace_of_the_hessian_is_the_screened_equation() -> None:
    for name in ("sphere, short", "sphere", "torus, long"):
        for method in ("sum", "tree"):
            field = SMALL[name]
            field = field_of(
                (field.points, field.normals, field.areas), field.length, method=method
            )  # type: ignore[arg-type]
            x = np.random.default_rng(6).uniform(-0.5, 0.5, (50, 3))
            rows = field.evaluator(DOUBLE).hessian(to_vector3(DOUBLE, x))
            hessian = np.stack([to_numpy(row) for row in rows], axis=1)
            value = field.value(x, precision="double")
            scale = np.abs(hessian).max()
            trace = np.trace(hessian, axis1=1, axis2=2)
            np.testing.assert_allclose(trace, value / field.length**2, atol=1e-11 * scale)


def test_hessian_through_the_tree() -> None:
    cloud = torus_cloud(np.random.default_rng(6), 1000)
    x = to_vector3(DOUBLE, np.random.default_rng(6).uniform(-1, 1, (50, 3)))
    for length in (0.2, 50.0):
        fields = [
            field_of(cloud, length, method="sum"),
            field_of(cloud, length, method="tree", accuracy=15.0),
        ]
        whole, parts = (
            np.stack([to_numpy(row) for row in one.evaluator(DOUBLE).hessian(x)]) for one in fields
        )
        np.testing.assert_allclose(parts, whole, atol=1e-4 * np.abs(whole).max())
        assert np.abs(parts - whole).max() > 1e-12


def tree_field(length: float, accuracy: float, n: int = 1000) -> ScreenedWindingNumber:
    cloud = torus_cloud(np.random.default_rng(7), n)
    return field_of(cloud, length, method="tree", accuracy=accuracy)


@pytest.mark.few(1)
@pytest.mark.parametrize("length", [0.05, 0.4, 100.0])
def test_tree_keeps_its_promises_for_the_exact_function(length: float) -> None:
    field = tree_field(length, 4.0)
    rng = np.random.default_rng(8)
    near = field.points[:25] + rng.normal(size=(25, 3)) * 10 ** rng.uniform(-4, -1, (25, 1))
    x = np.concatenate([near, rng.uniform(-1.6, 1.6, (25, 3))])
    for precision in ("double", "single"):
        x = x.astype(np.float32).astype(np.float64)
        f, g = exact(field, x)
        look = sample_field(field, x, precision)  # type: ignore[arg-type]
        sample = field.evaluator(choose_backend(precision)).evaluate(  # type: ignore[arg-type]
            to_vector3(choose_backend(precision), x)  # type: ignore[arg-type]
        )
        doubt = np.broadcast_to(to_numpy(sample.gradient_error), len(x))
        unit = 2.0**-20 if precision == "single" else 2.0**-48
        error = look.error + unit * np.abs(f)
        assert (np.abs(look.value - f) <= error).all()
        assert np.quantile(np.abs(look.value - f) / error, 0.9) > 1e-3
        off = np.linalg.norm(look.gradient - g, axis=1)
        spread = (
            unit
            * np.linalg.norm(g, axis=1)
            / np.abs(x[:, None] - field.points).max(axis=2).min(axis=1)
        )
        assert (off <= doubt + spread + 10 * unit * np.linalg.norm(g, axis=1)).all()
        doubt = doubt + spread
        for known in look.promises:
            share = np.linspace(0.1, 0.999, 6)
            for _ in range(2):
                d = random_directions(rng, len(x))
                t = known.radius[:, None] * share  # type: ignore[union-attr]
                there = exact(field, x[:, None] + t[..., None] * d[:, None])[0]
                if isinstance(known, TaylorRemainder):
                    line = look.value[:, None] + t * (look.gradient * d).sum(axis=1)[:, None]
                    room = 0.5 * known.constant[:, None] * t * t  # type: ignore[index]
                    room = room + error[:, None] + t * doubt[:, None]
                    assert (np.abs(there - line) <= room).all()
                else:
                    assert isinstance(known, HarmonicBall)
                    assert (there >= (known.lower - error)[:, None]).all()
                    assert (there <= (known.upper + error)[:, None]).all()


def test_promises_are_attained_by_one_dipole() -> None:
    """Moving straight at it, without screening: no constant could be smaller."""
    field = field_of((np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([1.0])), 1e9)
    x = np.array([[0.0, 0, 0.8]])
    look = sample_field(field, x)
    for known in look.promises:
        if isinstance(known, TaylorRemainder):
            y = x - (1 - 1e-9) * known.radius * np.array([[0, 0, 1.0]])
            slope = look.gradient[0] @ (y - x)[0]
            bent = abs(exact(field, y)[0] - look.value - slope)
            assert bent / (0.5 * known.constant * known.radius**2) == pytest.approx(1, abs=1e-4)
        else:
            assert isinstance(known, HarmonicBall)
            y = x - (1 - 1e-9) * known.radius * np.array([[0, 0, 1.0]])
            moved = exact(field, y)[0] - look.value
            assert moved / (known.lower - look.value) == pytest.approx(1, abs=1e-4)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["sphere, short", "sphere", "torus, long", "soup"])
def test_extension_to_four_dimensions_stays_in_the_ball_range(name: str) -> None:
    """w(y) cos(s/l) on the whole ball of R^4, not only where s = 0."""
    field = SMALL[name]
    rng = np.random.default_rng(9)
    x = rng.uniform(-1.3, 1.3, (80, 3))
    (ball,) = [one for one in sample_field(field, x).promises if isinstance(one, HarmonicBall)]
    assert ball.dimension == 4
    w = rng.normal(size=(80, 200, 4))
    w /= np.linalg.norm(w, axis=2, keepdims=True)
    w *= ball.radius[:, None, None] * rng.uniform(0, 1, (80, 200, 1)) ** 0.25  # type: ignore[index]
    u = exact(field, x[:, None] + w[..., :3])[0] * np.cos(w[..., 3] / field.length)
    assert (u >= ball.lower[:, None] - 1e-12).all()  # type: ignore[index]
    assert (u <= ball.upper[:, None] + 1e-12).all()  # type: ignore[index]


def test_dense_sphere_is_one_minus_the_blurred_inside() -> None:
    """w = 1 - u inside, -u outside, (1 - l^2 Laplacian) u = 1 inside: for a sphere in closed form,
    and the default level is the mean of the two limits."""
    vertices, faces = example_meshes.icosphere(4)
    for length in (0.25, 1.0, 20.0):
        field = ScreenedWindingNumber.of_mesh(vertices, faces, length=length)
        k = 1 / length
        r = np.array([0.05, 0.3, 0.6, 1.4, 1.8])
        x = r[:, None] * random_directions(np.random.default_rng(10), len(r))
        inside = (1 + k) * math.exp(-k) * np.sinh(k * r) / (k * r)
        outside = -(k * math.cosh(k) - math.sinh(k)) * np.exp(-k * r) / (k * r)
        np.testing.assert_allclose(
            field.value(x, precision="double"), np.where(r < 1, inside, outside), atol=3e-3
        )
        limit = (1 + k) * math.exp(-k) * math.sinh(k) / k
        assert field.default_level == pytest.approx(limit - 0.5, abs=0.02)


def test_winding_number_is_the_limit() -> None:
    vertices, faces = example_meshes.torus_mesh(1.0, 0.4, 60, 30)
    field = ScreenedWindingNumber.of_mesh(vertices, faces, length=1e6)
    assert field.default_level == pytest.approx(0.5, abs=0.02)
    x = np.array([[1.0, 0, 0], [0, -1, 0.1], [0, 0, 0], [2, 0, 0]])
    np.testing.assert_allclose(field.value(x), [1, 1, 0, 0], atol=5e-3)


@pytest.mark.slow
def test_mesh_quadrature_is_as_good_as_it_says() -> None:
    """A triangle against itself cut into 4^6, at distances from 1.1 to 30 of its radius."""
    rng = np.random.default_rng(11)
    for length in (0.3, 100.0):
        vertices = rng.normal(size=(3, 3))
        face = np.array([[0, 1, 2]])
        one = ScreenedWindingNumber.of_mesh(vertices, face, length=length)
        fine = ScreenedWindingNumber.of_mesh(vertices, face, length=length, subdivide=6)
        assert len(fine.points) == 4**6
        assert fine.areas.sum() == pytest.approx(one.areas.sum())
        radius = np.linalg.norm(vertices - one.points[0], axis=1).max()
        edges = ((vertices - np.roll(vertices, 1, axis=0)) ** 2).sum()
        r = radius * 10 ** rng.uniform(math.log10(1.1), 1.5, 300)
        x = one.points[0] + r[:, None] * random_directions(rng, 300)
        q = radius / r
        bound = one.areas[0] * edges / 36 * (3 - 2 * q) / ((1 - q) ** 2 * r**4) / (4 * math.pi)
        off = np.abs(exact(one, x)[0] - exact(fine, x)[0])
        assert (off <= bound * 1.001).all()
        assert (off / bound).max() > 0.01


# ---------------------------------------------------------------- first hits


def oracle(field: ScreenedWindingNumber) -> Any:
    def function(x: np.ndarray) -> OracleValues:
        value, gradient = exact(field, x)
        near = np.concatenate(
            [
                np.linalg.norm(x[i : i + 200, None] - field.points, axis=2).min(axis=1)
                for i in range(0, len(x), 200)
            ]
        )
        return OracleValues(value, gradient, np.minimum(near, 2 * field.length))

    return function


def compare(field: ScreenedWindingNumber, level: float, seed: int, **options: Any) -> int:
    """Trace random rays, look for crossings; the number of hits."""
    rng = np.random.default_rng(seed)
    n, tolerance = 40, 1e-3
    o = 2.5 * random_directions(rng, n)
    aim = np.where(
        rng.random((n, 1)) < 0.5, field.points[rng.integers(len(field.points), size=n)], 0
    )
    d = aim + rng.uniform(-0.8, 0.8, (n, 3)) * (rng.random((n, 1)) < 0.8) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = o.astype(np.float32).astype(float), d.astype(np.float32).astype(float)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    hits = hk.trace(field, o, d, level=level, t_max=6.0, tolerance=tolerance, **options)
    function = oracle(field)
    at = o + np.where(np.isfinite(hits.t), hits.t, 0)[:, None] * d
    here = function(at)
    # As sharp as the bound of what the tree leaves out.
    blur = 3 * field.error_bound(at) / np.maximum(here.gradient_norm, 1e-30)
    truth = first_crossings(
        function, o, d, 0.0, 6.0, levels=[level], depth=tolerance, finest=0.5 * tolerance
    )
    allowed = 5 * tolerance + np.where(hits.is_hit, blur, 0)
    missed = hits.t > truth.beyond + allowed
    assert not missed.any(), (o[missed], d[missed], hits.t[missed], truth.beyond[missed])
    away = np.abs(here.value - level) > here.gradient_norm * allowed
    early = hits.is_hit & away & (here.smooth > 5 * tolerance)
    assert not early.any(), (o[early], d[early], hits.t[early], here.value[early])
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    return int(hits.is_hit.sum())


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("length", "enclosures"),
    [(0.15, None), (0.6, None), (50.0, None), (0.6, "slope"), (50.0, "classic")],
)
def test_first_hits(length: float, enclosures: str | None) -> None:
    rng = np.random.default_rng(12)
    hits = 0
    for cloud in (sphere_cloud(rng, 150), torus_cloud(rng, 200), soup(rng, 20)):
        field = field_of(cloud, length)
        for level in (field.default_level, 0.4):
            hits += compare(field, level, int(rng.integers(1000)), enclosures=enclosures)
    assert hits > 60


@pytest.mark.few(1)
@pytest.mark.parametrize("length", [0.15, 50.0])
def test_first_hits_through_the_tree(length: float) -> None:
    field = tree_field(length, 6.0, 400)
    assert compare(field, field.default_level, 0) > 15
    assert compare(field, 0.3, 1) > 10


def test_rays_at_a_dipole_hit() -> None:
    """All levels meet there."""
    field = SMALL["sphere"]
    d = field.points[:50]
    hits = hk.trace(field, -2 * d, d, level=0.5)
    assert hits.is_hit.all()
    on = hk.trace(field, d, d, level=0.5)
    assert on.is_hit.all()


@pytest.mark.slow
def test_hits_carry_derivatives() -> None:
    field = SMALL["sphere"]
    backend = choose_backend("double")
    o = backend.Array3f(0.3, -2.0, 0.1)
    dr.enable_grad(o)
    hits = hk.trace(field, o, backend.Array3f(0, 1, 0), tolerance=1e-12)
    dr.backward(hits.t)
    got = to_numpy(dr.grad(o))[0]
    n = to_numpy(hits.normal)[0]
    np.testing.assert_allclose(got, -n / n[1], rtol=1e-6)


# ---------------------------------------------------------------- what people see


def test_extent_and_levels() -> None:
    field = SMALL["sphere"]
    assert field.extent((0.0,)) is None
    wide, narrow = field.extent((1e-3,)), field.extent((0.5,))
    assert wide is not None
    assert narrow is not None
    assert (wide.bounds()[1] > narrow.bounds()[1]).all()
    assert (np.abs(narrow.bounds()[0]) < 1.6).all()
    field.validate_levels((0.0, 0.5, -3.0))
    with pytest.raises(ValueError, match="too small to be told from 0"):
        field.validate_levels((1e-25,))


def test_describe() -> None:
    described = SMALL["sphere"].describe()
    assert described["points"] == 200
    assert described["length"] == 0.5
    assert described["method"] == "sum"
    assert 0 < described["default level"] < 0.5


def test_areas_are_estimated() -> None:
    points, normals, _ = sphere_cloud(np.random.default_rng(13), 2000)
    field = ScreenedWindingNumber(points, normals, length=0.5)
    assert field.areas.sum() == pytest.approx(4 * math.pi, rel=0.05)


def test_bad_input() -> None:
    points, normals, areas = sphere_cloud(np.random.default_rng(14), 10)
    for length in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="length must be positive"):
            ScreenedWindingNumber(points, normals, areas, length=length)
    with pytest.raises(ValueError, match="method is"):
        field_of((points, normals, areas), 1.0, method="fast")
    with pytest.raises(ValueError, match="accuracy must lie"):
        field_of((points, normals, areas), 1.0, accuracy=1.0)
    with pytest.raises(CloudError, match="normals"):
        ScreenedWindingNumber(points, normals[:5], areas, length=1.0)
    with pytest.raises(CloudError, match="area"):
        ScreenedWindingNumber(points, normals, -areas, length=1.0)
    vertices, faces = example_meshes.icosphere(0)
    with pytest.raises(ValueError, match="subdivide must lie"):
        ScreenedWindingNumber.of_mesh(vertices, faces, length=1.0, subdivide=-1)
    with pytest.raises(MeshError, match="out of range"):
        ScreenedWindingNumber.of_mesh(vertices, faces + 5, length=1.0)
