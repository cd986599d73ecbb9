"""Moments of clusters of dipoles: identities, sums, derivatives, and what truncation may cost.

Harmonics have degree l and order m.
"""

# ruff: noqa: E741

from __future__ import annotations

import dataclasses
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harnack.backend import choose_backend, to_numpy
from harnack.fmm import multipole
from harnack.fmm.multipole import (
    NodeMoments,
    cartesian_coefficients,
    dipole_tree_moments,
    sup_norm,
    triangle_rule,
    triangle_tree_moments,
    truncation_bounds,
)
from harnack.fmm.source_sums import (
    MAX_STEP_FRACTION,
    TAYLOR_RADII,
    SourceSums,
    max_step_fraction,
    remainder_factor,
    singularity_fraction,
)
from harnack.fmm.treecode import COARSE_RATIO, multipole_terms, node_records
from harnack.tree import BalancedTree, build_balanced_tree

ORDERS = [0, 1, 2]


def complex_of(pairs: Any) -> Any:
    """Real and imaginary parts as one array."""
    return {key: np.asarray(re) + 1j * np.asarray(im) for key, (re, im) in pairs.items()}


def regular(x: np.ndarray, order: int) -> Any:
    """R_lm at x (..., 3)."""
    return complex_of(multipole.regular_harmonics(x[..., 0], x[..., 1], x[..., 2], order))


def of_dipoles(d: np.ndarray, normal: np.ndarray) -> Any:
    """M_lm of clusters of dipoles (k, s, 3)."""
    pairs = multipole.dipole_moments(
        multipole.regular_harmonics(*np.moveaxis(d, -1, 0), multipole.MAX_DEGREE - 1),
        *np.moveaxis(normal, -1, 0),
    )
    return {key: value.sum(axis=1) for key, value in complex_of(pairs).items()}


def triangle_dipoles(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 6, 3) that stand for triangles (n, 3, 3)."""
    barycentric, weights = triangle_rule()
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return barycentric @ corners, weights[:, None] * normal[:, None]


def at(harmonics: Any, l: int, m: int) -> Any:
    """For any m."""
    if abs(m) > l or l < 0:
        return 0.0
    return harmonics[l, m] if m >= 0 else (-1) ** m * np.conj(harmonics[l, -m])


def irregular(x: np.ndarray, order: int) -> Any:
    """I_lm = (l+m)! (l-m)! R_lm / r^(2l+1)."""
    r = np.linalg.norm(x, axis=-1)
    return {
        (l, m): math.factorial(l + m) * math.factorial(l - m) * value / r ** (2 * l + 1)
        for (l, m), value in regular(x, order).items()
    }


def dipole_sum(x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """f at x (k, 3) of dipoles `normal` (s, 3) at y (s, 3)."""
    d = y - x[:, None]
    return ((normal * d).sum(axis=-1) / np.linalg.norm(d, axis=-1) ** 3).sum(axis=1)


def dipole_gradient(x: np.ndarray, y: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Of the same by x."""
    d = y - x[:, None]
    r = np.linalg.norm(d, axis=-1, keepdims=True)
    along = (normal * d).sum(axis=-1, keepdims=True)
    return (3 * along * d / r**5 - normal / r**3).sum(axis=1)


def solid_angles(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Sum over triangles (s, 3, 3), at x (k, 3)."""
    a, b, c = np.moveaxis(corners[None] - x[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    re = la * lb * lc
    for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb)):
        re = re + (u * v).sum(axis=-1) * w
    return 2 * np.arctan2((a * np.cross(b, c)).sum(axis=-1), re).sum(axis=1)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def cluster(seed: int, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Dipoles of all kinds: in a plane, in a ball, equal or opposite or random ones."""
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(count, 3)) * rng.choice([1.0, 0.1, 1e-3], 3)
    normal = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-2, 1, (count, 1))
    if seed % 3 == 0:
        normal[:] = normal[0]
    elif seed % 3 == 1:
        normal[::2] = -normal[1::2]
    return y, normal


def level_of(y: np.ndarray, normal: np.ndarray) -> NodeMoments:
    """The cluster as one leaf."""
    tree = BalancedTree(np.zeros((1, 1), np.int64), ())
    low, high = y.min(axis=0)[None], y.max(axis=0)[None]
    return dipole_tree_moments(tree, y[None], normal[None], low, high)[0]


def terms(level: NodeMoments, x: np.ndarray, order: int, derivatives: int) -> Any:
    """Value, gradient and Hessian that a node alone gives at x (k, 3)."""
    backend = choose_backend("double")
    c = [
        dr.opaque(backend.Float, float(v)) for v in cartesian_coefficients(level.moments, order)[0]
    ]
    r = x - level.center[0]
    inverse = backend.Float(1 / np.linalg.norm(r, axis=1))
    found = multipole_terms(c, backend.Array3f(r.T), inverse, derivatives)
    out = [to_numpy(found.value)]
    if found.gradient is not None:
        out.append(np.stack([to_numpy(v) for v in found.gradient], axis=1))
    if found.hessian is not None:
        rows = found.hessian.rows(backend.Array3f)
        out.append(np.stack([np.stack([to_numpy(v) for v in row], 1) for row in rows], axis=1))
    return out


# --- solid harmonics ------------------------------------------------------------------------


def test_addition_theorem_of_the_potential() -> None:
    """1/|x - y| = sum conj(R_lm(y)) I_lm(x): this says which harmonics they are."""
    rng = np.random.default_rng(0)
    x, y = 3 * unit(rng.normal(size=(20, 3))), 0.3 * unit(rng.normal(size=(20, 3)))
    near, far = regular(y, 14), irregular(x, 14)
    total = sum(
        np.conj(at(near, l, m)) * at(far, l, m) for l in range(15) for m in range(-l, l + 1)
    )
    np.testing.assert_allclose(total, 1 / np.linalg.norm(x - y, axis=1), rtol=1e-13)


def test_addition_theorem_of_regular_harmonics() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 10, 3))
    ra, rb, both = regular(a, 5), regular(b, 5), regular(a + b, 5)
    for (l, m), value in both.items():
        total = sum(
            at(ra, k, j) * at(rb, l - k, m - j) for k in range(l + 1) for j in range(-k, k + 1)
        )
        np.testing.assert_allclose(total, value, rtol=1e-11, atol=1e-12)


def test_derivatives_of_regular_harmonics() -> None:
    rng = np.random.default_rng(2)
    x, h = rng.normal(size=(10, 3)), 1e-4

    def along(axis: int, l: int, m: int) -> Any:
        """Exact for degree 4, by five points."""
        step = h * np.eye(3)[axis]
        one, two = (regular(x + k * step, 5)[l, m] - regular(x - k * step, 5)[l, m] for k in (1, 2))
        return (8 * one - two) / (12 * h)

    here = regular(x, 5)
    for l, m in here:
        dx, dy, dz = (along(axis, l, m) for axis in range(3))
        np.testing.assert_allclose(dz, at(here, l - 1, m) + 0 * dz, atol=1e-9)
        np.testing.assert_allclose(dx + 1j * dy, -at(here, l - 1, m + 1) + 0 * dz, atol=1e-9)
        np.testing.assert_allclose(dx - 1j * dy, at(here, l - 1, m - 1) + 0 * dz, atol=1e-9)


# --- moments --------------------------------------------------------------------------------


def test_moments_are_coefficients_of_the_field() -> None:
    y, normal = cluster(2)
    y *= 0.02 / np.linalg.norm(y, axis=1).max()
    held = of_dipoles(y[None], normal[None])
    x = 2 * unit(np.random.default_rng(0).normal(size=(30, 3)))
    far = irregular(x, 5)
    total = -sum(
        np.conj(at(held, l, m)) * at(far, l, m) for l in range(1, 6) for m in range(-l, l + 1)
    )
    expected = dipole_sum(x, y, normal)
    # The next term is smaller by the ratio to the fifth power: 1e-10.
    np.testing.assert_allclose(total.real, expected, atol=1e-8 * np.abs(normal).sum())
    np.testing.assert_allclose(total.imag, 0, atol=1e-12 * np.abs(normal).sum())


@given(seed=st.integers(0, 1000))
def test_moments_moved_are_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, normal = rng.normal(size=(2, 4, 6, 3))
    shift = rng.normal(size=(4, 3))
    expected = of_dipoles(d + shift[:, None], normal)
    given = {key: (value.real, value.imag) for key, value in of_dipoles(d, normal).items()}
    found = complex_of(multipole.multipole_to_multipole(given, *shift.T))
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_allclose(found[key], value, rtol=1e-10, atol=1e-10)


@pytest.mark.few(3)
@pytest.mark.parametrize("spread", [True, False])
@pytest.mark.parametrize("n", [1, 2, 9, 100, 333])
def test_nodes_have_the_moments_of_what_they_hold(n: int, spread: bool) -> None:
    """Of triangles, or of the dipoles that stand for them: the same moments."""
    rng = np.random.default_rng(n)
    corners = rng.normal(size=(n, 1, 3)) + 0.3 * rng.normal(size=(n, 3, 3))
    tree = build_balanced_tree(corners.mean(axis=1))
    points, normals = triangle_dipoles(corners)
    boxes = corners.min(axis=1), corners.max(axis=1)
    levels = (
        triangle_tree_moments(tree, corners)
        if spread
        else dipole_tree_moments(tree, points, normals, *boxes)
    )
    assert [len(level.center) for level in levels] == list(tree.counts)
    held = tree.leaf_slots
    for level, arity in zip(levels, (*tree.arities, 1), strict=True):
        for node in range(len(level.center)):
            rows = held[node][held[node] >= 0]
            d = (points[rows] - level.center[node]).reshape(1, -1, 3)
            a = normals[rows].reshape(1, -1, 3)
            size = np.linalg.norm(a, axis=-1)
            far = np.linalg.norm(corners[rows] - level.center[node], axis=-1).max()
            assert far <= level.radius[node] * (1 + 1e-12)
            assert level.area[node] == pytest.approx(size.sum())
            square = (d * d).sum(axis=-1)
            powers = (
                (level.second_moment, np.einsum("ks,ksi,ksj->ij", size, d, d)),
                (level.third_moment, np.einsum("ks,ks,ksi->i", size, square, d)),
                (level.fourth_moment, (size * square * square).sum()),
            )
            for found, expected in powers:
                np.testing.assert_allclose(found[node], expected, rtol=1e-9, atol=1e-9)
            assert np.abs((size[..., None] * d).sum(axis=1)).max() <= 1e-10 * (1 + size.sum())
            for key, value in of_dipoles(d, a).items():
                np.testing.assert_allclose(level.moments[key][node], value[0], atol=1e-8)
        held = held.reshape(len(held) // arity, -1)


def test_nodes_without_area_have_a_center() -> None:
    """Two turned copies cancel as dipoles but keep their areas; nothing at all has none."""
    y = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    level = level_of(y, np.zeros((2, 3)))
    np.testing.assert_array_equal(level.center, [[1.0, 0, 0]])
    assert level.area.tolist() == [0]
    assert all(np.isfinite(value).all() for value in truncation_bounds(level, 2 * level.radius))


def test_triangle_dipoles_integrate_to_degree_four() -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(5, 3, 3))
    points, normals = triangle_dipoles(corners)
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(normals.sum(axis=1), normal)
    share = np.linalg.norm(normals, axis=2) / np.linalg.norm(normal, axis=1)[:, None]
    # Over a triangle the mean of u^i v^j w^k is 2 i! j! k!/(i+j+k+2)!, barycentric u, v, w.
    for n in range(200):
        i, j, k = rng.integers(0, 5, 3) if n else (0, 0, 0)
        if i + j + k > 4:
            continue
        weights = np.linalg.solve(
            np.moveaxis(corners, 1, 2)[:, None], points[..., None]
        )[..., 0]  # fmt: skip
        power = weights[..., 0] ** i * weights[..., 1] ** j * weights[..., 2] ** k
        exact = 2 * math.factorial(i) * math.factorial(j) * math.factorial(k)
        exact /= math.factorial(i + j + k + 2)
        np.testing.assert_allclose((share * power).sum(axis=1), exact, rtol=1e-9)


# --- terms ----------------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("order", ORDERS)
def test_cartesian_terms_are_the_harmonics(order: int) -> None:
    for seed in range(6):
        level = level_of(*cluster(seed))
        x = level.center + 3 * np.random.default_rng(seed).normal(size=(50, 3))
        far = irregular(x - level.center, order + 1)
        expected = -sum(
            np.conj(at(level.moments, l, m)) * at(far, l, m)
            for l in range(1, order + 2)
            for m in range(-l, l + 1)
        )
        assert np.abs(expected.imag).max() <= 1e-10 * np.abs(expected).max()
        (value,) = terms(level, x, order, 0)
        np.testing.assert_allclose(value, expected.real, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("order", ORDERS)
def test_derivatives_of_terms(order: int) -> None:
    h = 1e-4
    for seed in range(6):
        level = level_of(*cluster(seed))
        x = level.center + 2 * unit(np.random.default_rng(seed).normal(size=(40, 3)))
        value, gradient, hessian = terms(level, x, order, 2)
        np.testing.assert_array_equal(value, terms(level, x, order, 0)[0])
        np.testing.assert_array_equal(gradient, terms(level, x, order, 1)[1])
        for axis in range(3):
            step = h * np.eye(3)[axis]
            (v1, g1), (v0, g0) = (terms(level, x + s * step, order, 1) for s in (1, -1))
            (v3, g3), (v2, g2) = (terms(level, x + 2 * s * step, order, 1) for s in (1, -1))
            slope = (8 * (v1 - v0) - (v3 - v2)) / (12 * h)
            bend = (8 * (g1 - g0) - (g3 - g2)) / (12 * h)
            scale = np.abs(hessian).max()
            np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-9 * scale)
            np.testing.assert_allclose(hessian[:, axis], bend, atol=1e-8 * scale)
        np.testing.assert_array_equal(hessian, np.swapaxes(hessian, 1, 2))
        trace = np.trace(hessian, axis1=1, axis2=2)
        np.testing.assert_allclose(trace, 0, atol=1e-12 * np.abs(hessian).max())


# --- bounds ---------------------------------------------------------------------------------


def test_sup_norm_bounds_every_term() -> None:
    ways = unit(np.random.default_rng(0).normal(size=(500, 3)))
    far = irregular(ways, 5)
    for seed in range(10):
        level = level_of(*cluster(seed))
        for l in range(1, 6):
            term = sum(np.conj(at(level.moments, l, m)) * at(far, l, m) for m in range(-l, l + 1))
            bound = sup_norm(level.moments, l)[0]
            assert np.abs(term).max() <= bound * (1 + 1e-12)
            if l == 1:  # of a dipole it is the largest value
                assert np.abs(term).max() >= 0.95 * bound


def viewpoints(level: NodeMoments, q: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    r = level.radius[0] / q * np.where(np.arange(60) < 30, 1.0, rng.uniform(1, 4, 60))
    return level.center[0] + r[:, None] * unit(rng.normal(size=(60, 3)))


@pytest.mark.few(3)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("accuracy", [1.5, 2.0, 4.0])
def test_truncation_is_bounded(order: int, accuracy: float) -> None:
    """In value and gradient, from the accepting distance on, and not by much too much."""
    k = order + 2
    used = []
    for seed in range(30):
        y, normal = cluster(seed, 2 if seed % 5 == 4 else 12)
        level = level_of(y, normal)
        nearest = accuracy * level.radius
        e, g, _ = (bound[0] for bound in truncation_bounds(level, nearest, order))
        x = viewpoints(level, 1 / accuracy, seed)
        r = np.linalg.norm(x - level.center[0], axis=1)
        value, gradient = terms(level, x, order, 1)
        off = np.abs(value - dipole_sum(x, y, normal))
        slope = np.linalg.norm(gradient - dipole_gradient(x, y, normal), axis=1)
        tiny = 1e-12 * np.linalg.norm(normal, axis=1).sum()
        assert (off <= e / r ** (k + 1) * (1 + 1e-9) + tiny / r**2).all()
        assert (slope <= g / r ** (k + 2) * (1 + 1e-9) + tiny / r**3).all()
        used.append((off / (e / r ** (k + 1))).max())
    assert max(used) > 0.2


@pytest.mark.few(2)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("accuracy", [1.5, 4.0])
def test_bounds_are_not_rounded_below_their_series(order: int, accuracy: float) -> None:
    """Their closed form, in single precision, against the series that it sums."""
    for seed in range(40):
        level = level_of(*cluster(seed))
        r, k = accuracy * level.radius[0], order + 2
        powers = [(l, l * (level.radius[0] / r) ** (l - 5) / r**4) for l in range(6, 200)]
        parts = [(l, level.fourth_moment[0] * term * r**k / r) for l, term in powers]
        parts += [(l, sup_norm(level.moments, l)[0] / r ** (l - k)) for l in range(k, 6)]
        e, g, h = truncation_bounds(level, np.array([r]), order)
        value, slope = sum(one for _, one in parts), sum((l + 1) * one for l, one in parts)
        second = sum((l + 1) * (l + 2) * one for l, one in parts)
        assert second <= np.float32(h[0]) <= second * (1 + 2e-6)
        assert value <= np.float32(e[0]) <= value * (1 + 2e-6)
        assert slope <= np.float32(g[0]) <= slope * (1 + 2e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_truncation_is_bounded_for_triangles(order: int) -> None:
    """Whose quadrature points stand for them: the solid angle itself is within the bound."""
    k = order + 2
    for seed in range(20):
        rng = np.random.default_rng(seed)
        corners = rng.normal(size=(8, 1, 3)) * rng.choice([0.1, 1.0], 3)
        corners = corners + rng.choice([0.1, 1.0]) * rng.normal(size=(8, 3, 3))
        tree = build_balanced_tree(corners.mean(axis=1))
        level = triangle_tree_moments(tree, corners)[-1]
        for accuracy in (1.5, 2.0, 4.0):
            e = truncation_bounds(level, accuracy * level.radius, order)[0][0]
            x = viewpoints(level, 1 / accuracy, seed)
            r = np.linalg.norm(x - level.center[0], axis=1)
            off = np.abs(terms(level, x, order, 0)[0] - solid_angles(x, corners))
            assert (off <= e / r ** (k + 1) + 1e-12).all()


def bent(
    level: NodeMoments,
    rough: float,
    way: np.ndarray,
    part: float,
    y: np.ndarray,
    normal: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How far f moves off the linear on steps along `way` (60, 3), and the bound of it."""
    columns = node_records(level, 2, rough, np.zeros(1))[0]
    np.testing.assert_array_equal(columns[:3], level.center[0])
    assert columns[3] == pytest.approx(rough * level.radius[0])
    x = viewpoints(level, 1 / rough, 7)
    r = np.linalg.norm(x - level.center[0], axis=1)
    q = part * max_step_fraction(rough)
    t = q * r
    linear = (dipole_gradient(x, y, normal) * way).sum(axis=1) * t
    off = dipole_sum(x + t[:, None] * way, y, normal) - dipole_sum(x, y, normal) - linear
    phi = (3 - 2 * q) / (1 - q) ** 2
    return np.abs(off), (columns[4] + columns[5] / r**2) * q * q * phi / r**2


@pytest.mark.few(1)
@pytest.mark.parametrize("rough", [1.5, 2.0, 2.5])
def test_fields_of_nodes_bend_as_their_columns_say(rough: float) -> None:
    rng = np.random.default_rng(3)
    for seed in range(60):
        y, normal = cluster(seed)
        level = level_of(y, normal)
        tiny = 1e-11 * np.linalg.norm(normal, axis=1).sum() / level.radius[0] ** 2
        inwards = -unit(viewpoints(level, 1 / rough, 7) - level.center[0])
        for part in (0.02, 0.3, 0.7, 1.0):
            for way in (inwards, unit(inwards + rng.normal(size=(60, 3)))):
                off, bound = bent(level, rough, way, part, y, normal)
                assert (off <= bound * (1 + 1e-9) + tiny).all()


@pytest.mark.parametrize("ratio", [1.5, 2.0, COARSE_RATIO])
def test_numbers_of_the_proof_of_steps_agree(ratio: float) -> None:
    """What the proof in `SourceSums.sample` says of radii, far nodes and chords."""
    assert list(TAYLOR_RADII) == sorted(TAYLOR_RADII)
    # The largest ball, about a node that counts as a singular point, is the longest step.
    longest = TAYLOR_RADII[-1] * singularity_fraction(ratio)
    assert longest == pytest.approx(max_step_fraction(ratio), rel=1e-12)
    # It ends before the node's dipoles, and reaches no farther than the chord of phi.
    assert max_step_fraction(ratio) <= MAX_STEP_FRACTION * (1 - 1 / ratio) < 1 - 1 / ratio
    assert singularity_fraction(ratio) <= 1
    real = choose_backend("double").Float
    sums = SourceSums.zero(choose_backend("double"), 1.0, 0)
    for b in TAYLOR_RADII:
        sums = dataclasses.replace(sums, s4=real(1), s5=real(1))
        for q in np.linspace(0, b, 9):
            # A dipole of area 1 at the distance 1.
            assert remainder_factor(q) <= to_numpy(sums.remainder(b, real(q)))[0] * (1 + 1e-12)
        chord = to_numpy(sums.remainder(b, real(b)))[0]
        assert chord == pytest.approx(remainder_factor(b), rel=1e-12)


def test_a_mass_counts_as_a_dipole() -> None:
    """m/rho has Taylor remainders of at most those of a dipole of area m rho/3 (`source_sums`)."""
    rng = np.random.default_rng(8)
    rho = rng.uniform(0.5, 2, 400)
    t = rng.uniform(0.01, 0.99, 400) * rho
    way = unit(rng.normal(size=(400, 3)))
    way[:100] = (-1.0, 0, 0)
    x = np.stack([rho, 0 * rho, 0 * rho], axis=1)
    linear = 1 / rho - t * way[:, 0] / rho**2
    off = np.abs(1 / np.linalg.norm(x + t[:, None] * way, axis=1) - linear)
    bound = (rho / 3) * t**2 / rho**4 * np.array([remainder_factor(q) for q in t / rho])
    assert (off <= bound * (1 + 1e-9)).all()
    # Short steps toward it attain the bound.
    short = 1 / (1 - 1e-3) - (1 + 1e-3)
    assert short == pytest.approx(1e-6 / 3 * remainder_factor(1e-3), rel=2e-3)


@pytest.mark.parametrize("rough", [1.5, 2.5])
def test_a_dipole_alone_attains_the_bound_of_its_bend(rough: float) -> None:
    """Approached along its axis. It may lie in a node with others that have no area."""
    y = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, -1]])
    normal = np.array([[0.0, 0, 2], [0, 0, 0], [0, 0, 0]])
    level = level_of(y, normal)
    assert level.radius[0] == pytest.approx(1)
    columns = node_records(level, 2, rough, np.zeros(1))[0]
    r = 3.0
    for q in (0.1, max_step_fraction(rough)):
        x, way = np.array([[0, 0, r]]), np.array([[0, 0, -1.0]])
        slope = (dipole_gradient(x, y[:1], normal[:1]) * way).sum()
        moved, still = (dipole_sum(at, y[:1], normal[:1])[0] for at in (x + q * r * way, x))
        bound = (columns[4] + columns[5] / r**2) * q * q * (3 - 2 * q) / (1 - q) ** 2 / r**2
        assert abs(moved - still - q * r * slope) == pytest.approx(bound, rel=1e-9)


@pytest.mark.parametrize("q", [0.01, 0.217, 0.39])
def test_higher_terms_bend_the_more_the_longer_the_step(q: float) -> None:
    """That is what lets one quotient, that of the longest step, serve for all shorter ones."""

    def phi(l: int, q: float) -> float:
        return sum(math.comb(l + k, k) * q ** (k - 2) for k in range(2, 400))

    for l in range(1, 12):
        closed = ((1 - q) ** -(l + 1) - 1 - (l + 1) * q) / q**2
        assert phi(l, q) == pytest.approx(closed, rel=1e-6)
        assert phi(l, q / 2) / phi(1, q / 2) <= phi(l, q) / phi(1, q)
