"""Functions with a bounded Laplacian: the kernel's norm, sharpness, promises, first hits."""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from benchmarks.laplacian import GyroidByLaplacian
from harnack.backend import choose_backend, to_numpy
from harnack.enclosures import BoundedLaplacian, LevelGaps, Lipschitz, SlopeRange, choose_enclosures
from harnack.enclosures.bounded_laplacian import (
    GREEN_KERNEL_BOUND,
    GREEN_SLOPE_BOUND,
    BoundedLaplacianEnclosure,
)
from harnack.enclosures.parabola import LipschitzEnclosure
from harnack.fields import Field, Sample
from harnack.testing import BrokenPromiseError, check_enclosure, check_field
from tests.oracles.green_kernel import Proof, kappa_ratio
from tests.oracles.oracle import OracleValues, first_crossings

TOLERANCE = 1e-4
PLANETS = (((0.0, 0.0, 0.0), 1.0, 3.0), ((1.3, 0.2, 0.0), 0.4, 8.0), ((0.2, -0.9, 0.5), 0.7, 2.0))


class Matter(Field):
    """Newton's potential of balls of constant density: superharmonic, its Laplacian jumps.

    |grad f| falls with the distance from a ball's surface, f with that from its center; a ball of
    radius `reach` either misses a ball of matter, meets it or lies within it.
    """

    default_level = 1.3
    domain = hk.Ball(radius=3.0)
    reach = 0.8

    def evaluate(self, p: Any) -> Sample:
        value = lower = upper = least = most = 0.0
        gradient, reach = type(p)(0.0), self.reach
        for center, size, density in PLANETS:
            away = p - type(p)(*center)
            r = dr.norm(away)
            near, far = dr.maximum(r - reach, 0), r + reach

            def potential(d: Any, size: float = size, density: float = density) -> Any:
                outside = size**3 / (3 * dr.maximum(d, size))
                return density * dr.select(d < size, size**2 / 2 - d * d / 6, outside)

            value += potential(r)
            gradient -= (density / 3) * away * dr.minimum(1, (size / r) ** 3)
            lower, upper = lower + potential(far), upper + potential(near)
            least -= dr.select(near < size + 1e-5, density, 0)
            most -= dr.select(far < size - 1e-5, density, 0)
        ends = lower * (1 - 1e-5), upper * (1 + 1e-5), least, most
        return Sample(value, gradient, (BoundedLaplacian(type(value)(reach), *ends),))


FIELDS: dict[str, tuple[Field, float]] = {
    "gyroid by its Laplacian": (GyroidByLaplacian(cell=1.5, domain=hk.Ball(radius=2.0)), 0.2),
    "matter": (Matter(), 1.3),
}


# --- the norm of the kernel ------------------------------------------------------------------


def test_a_stretch_of_the_proof_of_the_kernels_norm() -> None:
    """Where it is tight; `test_the_kernels_norm_is_proved` does all of it."""
    proof = Proof(GREEN_KERNEL_BOUND, first=0.47, last=0.5)
    assert proof.table_margin() > 0
    assert Proof(GREEN_KERNEL_BOUND).below()
    assert Proof(GREEN_KERNEL_BOUND).above()
    assert Proof(GREEN_KERNEL_BOUND).is_convex(GREEN_SLOPE_BOUND)
    assert Proof(GREEN_KERNEL_BOUND).is_convex()
    too_small = Proof(0.39, first=0.47, last=0.5)
    assert too_small.table_margin() < 0
    assert not Proof(0.39).below()
    assert not Proof(0.385).above()
    assert not Proof(0.38).is_convex()


@pytest.mark.slow
def test_the_kernels_norm_is_proved() -> None:
    assert Proof(GREEN_KERNEL_BOUND).holds()
    assert not Proof(0.391).holds()


class Grid:
    """The Green function of the unit ball and q v from its definition, on a grid of (r, mu)."""

    def __init__(self, q: float, count: int = 1500) -> None:
        # Cells are small near r = 0 and r = q; each stands for a ring.
        edges = np.unique(np.concatenate([np.linspace(0, 1, count), q + 1e-9 * np.arange(2)]))
        r, self.dr = 0.5 * (edges[1:] + edges[:-1])[:, None], np.diff(edges)[:, None]
        angle = (np.arange(count) + 0.5) * np.pi / count
        self.mu, self.r = np.cos(angle)[None], r
        self.volume = 2 * np.pi * r**2 * self.dr * np.sin(angle)[None] * np.pi / count
        self.a, self.b = (1 + 3 * q**2) / (1 - q**2) ** 2, (3 * q + q**3) / (1 - q**2) ** 2
        self.at_q = self.green(q)
        self.at_0, self.slope = self.green(0.0), self.mu * (r**-2 - r) / (4 * np.pi)

    def green(self, q: float) -> np.ndarray:
        s, r = self.r * self.mu, self.r
        direct = np.sqrt(r * r - 2 * q * s + q * q)
        return (1 / direct - 1 / np.sqrt(1 - 2 * q * s + q * q * r * r)) / (4 * np.pi)

    @property
    def kernel(self) -> np.ndarray:
        return self.a * self.at_0 - self.at_q + self.b / 3 * self.slope

    def integral(self, density: np.ndarray) -> float:
        return float((density * self.volume).sum())


@pytest.mark.few(2)
@pytest.mark.parametrize("q", [0.05, 0.5, 0.8])
def test_the_oracles_norm_is_that_of_the_definition(q: float) -> None:
    grid = Grid(q)
    assert grid.integral(grid.at_q) == pytest.approx((1 - q * q) / 6, rel=2e-4)
    norm = grid.integral(np.abs(grid.kernel)) / q**2
    assert norm == pytest.approx(kappa_ratio(q, 0.02), rel=1e-3)
    assert norm <= kappa_ratio(q, 0.02) * (1 + 2e-4)


@pytest.mark.few(4)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("share", [1.4, 30.0])
@pytest.mark.parametrize("q", [0.1, 0.5, 0.8])
def test_the_function_with_the_kernels_sign_nearly_attains_the_bound(
    q: float, share: float, precision: Any
) -> None:
    """Laplacian = plus or minus one where the kernel has that sign, and mass at the poles.

    What is left is the gap between kappa and its bound, 0.7 % and more: a step 1.001 times as long
    meets a level from q = 0.5 on, below it one of 1.005. `test_bounds` sees one of 1.001 wherever
    one density fills the ball, of which the bound is attained. share: mass at the poles; with 4/3
    or more f stays positive.
    """
    grid = Grid(q)
    source = np.sign(grid.kernel)
    turn = grid.integral(source * grid.slope)
    # f has next to no slope: then the Laplacian matters most. h - c at the center is the share.
    ahead, behind = 0.5 * (share + turn / 3) + 1e-3, 0.5 * (share - turn / 3)
    h, slope = ahead + behind, 3 * (ahead - behind) - turn
    there = ahead * (1 + q) / (1 - q) ** 2 + behind * (1 - q) / (1 + q) ** 2
    value = h - grid.integral(source * grid.at_0)
    movement = there - grid.integral(source * grid.at_q) - value
    assert movement > 0
    real = choose_backend(precision).Float
    promise = BoundedLaplacian(real(1), real(0), real(1e9), real(-1), real(1))
    slopes = SlopeRange(real(slope), real(slope))
    made = BoundedLaplacianEnclosure.from_promise(promise, real(value), 0.0, slopes)
    assert made is not None
    step = float(to_numpy(made.free_length(LevelGaps(real(np.inf), real(movement))))[0])
    # A grid has an error, too.
    tightness = 1.001 if q >= 0.5 else 1.005
    assert q / tightness < step < q * (1 + 1e-5)


class WithoutKernel(BoundedLaplacianEnclosure):
    def _growth(self, *given: Any) -> Any:
        return dataclasses.replace(super()._growth(*given), spread=0)


class WithoutMean(BoundedLaplacianEnclosure):
    def _growth(self, *given: Any) -> Any:
        return dataclasses.replace(super()._growth(*given), mean=0)


class WrongSign(BoundedLaplacianEnclosure):
    def _growth(self, gap: Any, u: Any, most: Any, mean: Any, slope: Any) -> Any:
        return super()._growth(gap, u, most, -mean, slope)


@pytest.mark.parametrize("wrong", [WithoutKernel, WithoutMean, WrongSign])
def test_a_term_left_out_is_seen_by_check_enclosure(wrong: type[BoundedLaplacianEnclosure]) -> None:
    with pytest.raises(BrokenPromiseError, match="a level is met within the step"):
        check_enclosure(wrong)


# --- promises --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FIELDS)
def test_one_proof_of_a_bounded_laplacian_is_used_by_default(name: str) -> None:
    field, level = FIELDS[name]
    o, d = rays(np.random.default_rng(1), 200)
    plain = hk.trace(field, o, d, level=level)
    for enclosures in ("laplacian", BoundedLaplacianEnclosure):
        np.testing.assert_array_equal(
            hk.trace(field, o, d, level=level, enclosures=enclosures).t, plain.t
        )
    with pytest.raises(ValueError, match=r'BoundedLaplacian.*choose .*"laplacian"'):
        hk.trace(field, o, d, level=level, enclosures="lipschitz")


def test_the_name_takes_lipschitz_constants_where_there_is_nothing_else() -> None:
    real = choose_backend("double").Float
    given = (real(0), 0.0, SlopeRange(real(0.4), real(0.4)))
    (made,) = choose_enclosures("laplacian").from_promises(
        (Lipschitz(real(1), real(1)),), (), *given
    )
    assert type(made) is LipschitzEnclosure
    endless = BoundedLaplacian(real(1), -np.inf, real(1), real(0), real(1))
    with pytest.raises(ValueError, match="a BoundedLaplacian both"):
        choose_enclosures("laplacian").from_promises((endless,), (), *given)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_what_is_no_number_proves_nothing(precision: Any) -> None:
    real = choose_backend(precision).Float
    slopes, gaps = SlopeRange(real(0.1), real(0.1)), LevelGaps(real(0.5), real(0.5))
    numbers = [1.0, -1.0, 1.0, -1.0, 1.0]
    for place in range(len(numbers)):
        given = [real(np.nan if i == place else one) for i, one in enumerate(numbers)]
        made = BoundedLaplacianEnclosure.from_promise(
            BoundedLaplacian(*given), real(0), 0.0, slopes
        )
        assert made is not None
        assert to_numpy(made.free_length(gaps))[0] == 0
        assert not to_numpy(made.is_free(gaps, real(0.1)))[0]
    swapped = BoundedLaplacian(*(real(one) for one in (1.0, -1.0, 1.0, 1.0, -1.0)))
    made = BoundedLaplacianEnclosure.from_promise(swapped, real(0), 0.0, slopes)
    assert made is not None
    assert to_numpy(made.free_length(gaps))[0] == 0


class Wrong(Field):
    """|p|^2, whose Laplacian is 6."""

    default_level = 0.5
    domain = hk.Ball(radius=1.0)

    def __init__(self, low: float, high: float, upper: float) -> None:
        self.ends, self.upper = (low, high), upper

    def evaluate(self, p: Any) -> Sample:
        value = dr.squared_norm(p)
        promise = BoundedLaplacian(0.5, 0.0, value + self.upper, *self.ends)
        return Sample(value, 2 * p, (promise,))


def test_wrong_promises_are_found() -> None:
    check_field(Wrong(6.0, 6.0, 1.5))
    check_field(Wrong(0.0, 7.0, 1.5))
    for wrong, message in (
        (Wrong(0.0, 5.9, 1.5), "Laplacian is not between its ends"),
        (Wrong(6.1, 7.0, 1.5), "Laplacian is not between its ends"),
        (Wrong(7.0, 6.0, 1.5), "laplacian_lower exceeds"),
        (Wrong(6.0, 6.0, 0.2), "f leaves what is promised"),
        (Wrong(6.0, 6.0, -0.2), "not within"),
    ):
        with pytest.raises(BrokenPromiseError, match=message):
            check_field(wrong)


SOLID = hk.solid(Matter(), above=1.3)
SOLIDS: dict[str, Field] = {
    "inside out": ~SOLID,
    "scaled and turned": SOLID.scaled(2.5).rotated(40.0, (1, 2, 0)).translated((0.1, 0, -2)),
    "sheared": SOLID.transformed([[1, 0.4, 0], [0, 1.5, 0], [0.2, 0, 0.7]]),
    "with a bite": SOLID - hk.Sphere(0.8),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLIDS)
def test_solids_of_a_bounded_laplacian_keep_its_promise(name: str) -> None:
    check_field(SOLIDS[name], count=60, directions=4)


def test_maps_of_space_keep_the_promise_tight() -> None:
    """By a similarity all four ends are mapped; the hits are those of the field itself."""
    o, d = rays(np.random.default_rng(5), 300)
    plain = hk.trace(SOLID, o, d, precision="double")
    grown = hk.trace(SOLID.scaled(3.0), 3 * o, d, precision="double")
    assert plain.is_hit.mean() > 0.3
    np.testing.assert_array_equal(grown.is_hit, plain.is_hit)
    np.testing.assert_allclose(grown.t[grown.is_hit], 3 * plain.t[plain.is_hit], atol=1e-3)
    assert grown.evaluations.mean() < 1.2 * plain.evaluations.mean()


# --- first hits ------------------------------------------------------------------------------


def rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """From around the origin, towards the ball of radius 2."""
    o = rng.normal(size=(count, 3))
    o *= rng.uniform(0.2, 2.5, (count, 1)) / np.linalg.norm(o, axis=1, keepdims=True)
    o = o.astype(np.float32).astype(np.float64)
    d = rng.uniform(-1.2, 1.2, (count, 3)) - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def gyroid(x: np.ndarray) -> OracleValues:
    k = 2 * np.pi / 1.5
    s, c = np.sin(k * x), np.cos(k * x)
    c1, s2 = np.roll(c, -1, axis=1), np.roll(s, 1, axis=1)
    value = (s * c1).sum(axis=1)
    return OracleValues(value, k * (c * c1 - s2 * s), np.full(len(x), 0.2))


def matter(x: np.ndarray) -> OracleValues:
    value, gradient = np.zeros(len(x)), np.zeros_like(x)
    for center, size, density in PLANETS:
        away = x - np.array(center)
        r = np.linalg.norm(away, axis=1)
        mass = density * np.minimum(r, size) ** 3 / 3
        value += mass / r + 0.5 * density * np.maximum(size**2 - r**2, 0)
        gradient -= (mass / r**3)[:, None] * away
    return OracleValues(value, gradient, np.full(len(x), 0.2))


ORACLES = {"gyroid by its Laplacian": gyroid, "matter": matter}


def check_hits(name: str, precision: Any, count: int, seed: int) -> float:
    """Against dense sampling in double precision; the evaluations a ray."""
    field, level = FIELDS[name]
    oracle = ORACLES[name]
    o, d = rays(np.random.default_rng(seed), count)
    assert field.domain is not None
    backend = choose_backend("double")
    ways = [backend.Array3f(np.ascontiguousarray(one.T)) for one in (o, d)]
    ends = field.domain.upload(backend).clip(*ways, backend.Float(0), backend.Float(8.0))
    near, far = (np.broadcast_to(to_numpy(one), count).astype(float) for one in ends)
    inside = near < far
    o, d, near, far = o[inside], d[inside], near[inside], far[inside]
    hits = hk.trace(field, o, d, level=level, tolerance=TOLERANCE, t_max=8.0, precision=precision)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    truth = first_crossings(
        oracle, o, d, near, far, levels=[level], depth=TOLERANCE, spacing=0.05, finest=TOLERANCE
    )
    assert len(o) > 0.7 * count
    assert np.isfinite(truth.beyond).mean() > 0.2
    assert not (hits.t > truth.beyond + 3 * TOLERANCE).any()
    at = oracle((o + hits.t[:, None] * d)[hits.is_hit])
    off = np.abs(at.value - level) / at.gradient_norm
    assert (off < 3 * TOLERANCE).all()
    return float(hits.evaluations.mean())


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", FIELDS)
def test_first_hits(name: str, precision: Any) -> None:
    assert check_hits(name, precision, 600, seed=3) < 12


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", FIELDS)
def test_first_hits_of_many_rays(name: str, precision: Any) -> None:
    check_hits(name, precision, 8000, seed=4)
