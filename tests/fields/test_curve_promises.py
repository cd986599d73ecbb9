"""What curves promise near a point: integrals over edges and circles, and Taylor's remainder."""

from __future__ import annotations

import math

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import TaylorRemainder
from harnack.fmm.edges import LoopEdges, sum_over_edges
from harnack.geometry import example_curves
from tests.oracles.oracle import CurveOracle

PRECISIONS = ("double", "single")
CURVES = {
    "square": [np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])],
    "wavy": [example_curves.wavy_polygon(13)],
    "link": example_curves.hopf_link(9),
    "sliver": [np.array([[0.0, 0, 0], [1, 0, 0], [1, 1e-3, 0]])],
}


def places(loops: list[np.ndarray], n: int, seed: int = 0) -> np.ndarray:
    """Points (4 n, 3): around, far off, beside edges, and in line with them."""
    rng = np.random.default_rng(seed)
    a = np.concatenate(loops)
    e = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]) - a
    k, turn = rng.integers(len(a), size=2 * n), rng.normal(size=(n, 3))
    beside = a[k[:n]] + rng.uniform(0, 1, (n, 1)) * e[k[:n]]
    beside += 10 ** rng.uniform(-4, 0, (n, 1)) * turn / np.linalg.norm(turn, axis=1)[:, None]
    in_line = a[k[n:]] + rng.choice([-1, 1], (n, 1)) * rng.uniform(1.1, 3, (n, 1)) * e[k[n:]]
    return np.concatenate(
        [rng.uniform(-1.5, 1.5, (n, 3)), 30 * rng.normal(size=(n, 3)), beside, in_line]
    )


def integrals(loops: list[np.ndarray], x: np.ndarray, power: int) -> np.ndarray:
    """The integral (n,) of |dp|/D^power over the edges, by Gauss and Legendre, where t = sinh u
    stretches what is near the foot of x."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    total = np.zeros(len(x))
    for loop in loops:
        for p, q in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            length = np.linalg.norm(q - p)
            t = ((x - p) @ (q - p)) / length
            foot = p + t[:, None] * (q - p) / length
            h = np.maximum(np.linalg.norm(x - foot, axis=1), 1e-12)
            low, high = np.arcsinh(-t / h), np.arcsinh((length - t) / h)
            u = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * nodes
            # |dp| = h cosh(u) du and D = h cosh(u).
            inside = h[:, None] ** (1 - power) * np.cosh(u) ** (1 - power)
            total += 0.5 * (high - low) * (inside @ weights)
    return total


@pytest.mark.few(7)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", sorted(CURVES))
def test_integrals_over_edges(name: str, precision: str) -> None:
    loops, backend = CURVES[name], choose_backend(precision)  # type: ignore[arg-type]
    x = places(loops, 200)
    x = x[CurveOracle(loops)(x).smooth > 1e-5]
    if precision == "single":
        loops = [loop.astype(np.float32).astype(float) for loop in loops]
        x = x.astype(np.float32).astype(float)
    sums = sum_over_edges(LoopEdges.upload(backend, tuple(loops)), to_vector3(backend, x))
    rough = 3e-3 if precision == "single" else 1e-6
    cubes, fourths, squares = (integrals(loops, x, power) for power in (3, 4, 2))
    np.testing.assert_allclose(to_numpy(sums.inverse_cubes), cubes, rtol=rough)
    share = to_numpy(sums.inverse_fourths) / fourths
    assert 1 - rough < share.min()
    assert share.max() < 2.2
    share = to_numpy(sums.inverse_squares) / squares
    assert 1 - rough < share.min()
    assert share.max() <= 2 + rough


def test_the_bound_of_squares_is_attained_far_off_and_nearly_at_a_mere_half() -> None:
    """2 d times the integral for cubes is twice that for squares far from a short edge."""
    edge = [np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])]
    x, backend = np.array([[0.0, 0, 1.0]]), choose_backend("double")
    sums = sum_over_edges(LoopEdges.upload(backend, tuple(edge)), to_vector3(backend, x))
    share = to_numpy(sums.inverse_squares) / integrals(edge, x, 2)
    np.testing.assert_allclose(share, 2, rtol=1e-5)


FIELDS = {
    **{name: hk.SolidAngle(loops) for name, loops in CURVES.items()},
    "circle": hk.SolidAngle(hk.geometry.Circle(1.0)),
    "court": hk.SolidAngle([1.5 * CURVES["square"][0], hk.geometry.Circle(0.8, normal=(0, 0, -1))]),
}


def remainders(field: hk.SolidAngle, x: np.ndarray, d: np.ndarray) -> list[np.ndarray]:
    """For each promise, |f(x + t d) - f(x) - t f'(x)|/(constant t^2/2) at 24 t up to its radius."""
    backend = choose_backend("double")
    p = to_vector3(backend, x)
    sample = field.evaluator(backend).evaluate(p)
    value, slope = to_numpy(sample.value), (to_numpy(sample.gradient) * d).sum(axis=1)
    out: list[np.ndarray] = []
    for one in sample.promises:
        assert isinstance(one, TaylorRemainder)
        radius, constant = to_numpy(one.radius), to_numpy(one.constant)
        shares = []
        for part in np.linspace(0.08, 0.9999, 24):
            t = part * radius
            there = field.value(x + t[:, None] * d, precision="double")
            moved = np.remainder(there - value - t * slope + 2 * math.pi, 4 * math.pi)
            shares.append(np.abs(moved - 2 * math.pi) / (0.5 * constant * t * t))
        out.append(np.array(shares))
    return out


@pytest.mark.few(4)
@pytest.mark.parametrize("name", sorted(FIELDS))
def test_taylor_s_remainder(name: str) -> None:
    field, rng = FIELDS[name], np.random.default_rng(1)
    loops = list(field.loops) or CURVES["square"]
    x = np.concatenate([places(loops, 250), rng.normal(size=(500, 3))])
    nearest = to_numpy(field.boundary.closest_point(to_vector3(choose_backend("double"), x))) - x
    distance = np.linalg.norm(nearest, axis=1)
    x, nearest = x[distance > 1e-3], nearest[distance > 1e-3]
    d = rng.normal(size=x.shape)
    # Half of them at 45 degrees to the curve, where the remainder is large.
    toward = nearest[::2] / np.linalg.norm(nearest[::2], axis=1)[:, None]
    across = np.cross(toward, d[::2])
    d[::2] = toward + across / np.linalg.norm(across, axis=1)[:, None]
    d /= np.linalg.norm(d, axis=1)[:, None]
    shares = remainders(field, x, d)
    assert len(shares) == 3
    for share, reached in zip(shares, (0.25, 0.15, 0.05), strict=True):
        # Differences of values are rounded, which shows where the remainder is small.
        assert np.nanmax(share[6:]) <= 1 + 1e-4
        assert np.nanmax(share[6:]) > reached


def test_the_remainder_is_attained_on_the_axis_of_a_circle() -> None:
    """Of second order, at 45 degrees to the circle: a constant of 0.999 times would be wrong."""
    x, d = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    backend = choose_backend("double")
    sample = FIELDS["circle"].evaluator(backend).evaluate(to_vector3(backend, x))
    narrowest = sample.promises[0]
    assert isinstance(narrowest, TaylorRemainder)
    field = FIELDS["circle"]
    # The constant is 3/2 (I3 + r I4/(1 - q)); of that, 3/2 I3 is attained as t tends to 0.
    circle = 3 / 2 * 2 * math.pi / 2**1.5
    constant, radius = float(narrowest.constant[0]), float(narrowest.radius[0])
    assert radius == pytest.approx(0.3 * 2**0.5, rel=1e-4)
    spread = 3 / 2 * 2 * math.pi / 2**2 * radius / (1 - 0.3)
    assert constant == pytest.approx(circle + spread, rel=1e-4)
    t = 1e-3
    there = field.value(x + t * d, precision="double") - to_numpy(sample.value)
    rest = abs(float(there[0]) - t * float(-to_numpy(sample.gradient)[0, 2]))
    assert rest / (0.5 * circle * t * t) == pytest.approx(1, abs=2e-3)
