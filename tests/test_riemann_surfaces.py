"""Riemann surfaces: all sheets, their branch points and poles, against dense sampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk

Product = Callable[[np.ndarray, np.ndarray], np.ndarray]


def of_powers(
    exponents: dict[complex, Fraction], part: str = "imag", height: float = 1.0
) -> Product:
    """The product of all sheets of a product of powers, which has one value at a point."""
    count = math.lcm(*(power.denominator for power in exponents.values()))

    def product(z: np.ndarray, h: np.ndarray) -> np.ndarray:
        g = np.ones_like(z)
        for a, power in exponents.items():
            g = g * np.exp(float(power) * np.log(z - a))
        all_sheets = np.ones_like(h)
        for k in range(count):
            one = g * np.exp(2j * math.pi * k / count)
            all_sheets = all_sheets * (h - height * (one.imag if part == "imag" else one.real))
        return all_sheets

    return product


def of_angle(z: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Which turn of log's surface lies below, as +-1: its parity along each row."""
    angle = np.unwrap(np.angle(z), axis=-1)
    turn = np.floor((h - angle) / (2 * math.pi))
    return np.where(turn % 2 == 0, 1.0, -1.0)


def of_asin(z: np.ndarray, h: np.ndarray, part: str) -> np.ndarray:
    """sin u - sin h, or h^2 - v^2, for sin(u + i v) = z."""
    mean = 0.5 * (abs(z - 1) + abs(z + 1))
    if part == "real":
        return z.real / mean - np.sin(h)
    return h * h - np.arccosh(np.maximum(mean, 1.0)) ** 2


@dataclass(frozen=True)
class Case:
    field: hk.RiemannSurface
    product: Product
    radius: float


def root(z: Any) -> Any:
    w = dr.sqrt(z)
    return [(w, 0.5 / w), (-w, -0.5 / w)]


OWN = hk.RiemannSurface(
    root,
    singular=[hk.BranchPoint(0, power=0.5)],
    second=lambda z, r: 0.25 * (abs(z) - r) ** -1.5,
)
HALF, THIRD = Fraction(1, 2), Fraction(1, 3)
CASES = {
    "log": Case(hk.RiemannSurface("log"), of_angle, 4.0),
    "sqrt": Case(hk.RiemannSurface("sqrt"), of_powers({0: HALF}), 1.0),
    "own": Case(OWN, of_powers({0: HALF}), 1.0),
    "real sqrt": Case(hk.RiemannSurface("sqrt", "real"), of_powers({0: HALF}, "real"), 1.0),
    "cbrt": Case(hk.RiemannSurface("cbrt"), of_powers({0: THIRD}), 1.0),
    "2/3": Case(hk.RiemannSurface("power", exponent=2 / 3), of_powers({0: 2 * THIRD}), 1.0),
    "5/2": Case(hk.RiemannSurface("power", exponent=2.5), of_powers({0: 5 * HALF}), 1.0),
    "-1/2": Case(hk.RiemannSurface("power", exponent=-0.5), of_powers({0: -HALF}), 1.0),
    "pole": Case(hk.RiemannSurface({0: -1}), of_powers({0: Fraction(-1)}), 1.0),
    "asin": Case(hk.RiemannSurface("asin"), lambda z, h: of_asin(z, h, "imag"), 2.0),
    "real asin": Case(hk.RiemannSurface("asin", "real"), lambda z, h: of_asin(z, h, "real"), 2.0),
    "elliptic": Case(
        hk.RiemannSurface("sqrt", of={0: 1, 1: 1, -1: 1}, height=0.5, domain=hk.Ball(radius=2.0)),
        of_powers({0: HALF, 1: HALF, -1: HALF}, height=0.5),
        2.0,
    ),
    "product": Case(
        hk.RiemannSurface({0: 0.5, 1: THIRD, 0.5j: -0.5}, domain=hk.Ball(radius=2.0)),
        of_powers({0: HALF, 1: THIRD, 0.5j: -HALF}),
        2.0,
    ),
}
QUICK = ("log", "sqrt", "real asin", "own")


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rays(n: int, radius: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """From three radii away to uniform points of the ball, as the counts in the docs have them."""
    rng = np.random.default_rng(seed)
    o = 3 * radius * unit(rng.normal(size=(n, 3)))
    target = radius * unit(rng.normal(size=(n, 3))) * rng.random((n, 1)) ** (1 / 3)
    return o, unit(target - o)


def hostile_rays(n: int, case: Case, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Past singular points, at distances from 0 to the radius; a quarter level and a quarter
    upright; half of them start within the ball."""
    rng = np.random.default_rng(seed)
    points = [point.at for point in case.field.branches.points] or [0j]
    at = np.array(points)[rng.integers(len(points), size=n)]
    beside = case.radius * 10.0 ** rng.uniform(-7, 0, n) * (rng.random(n) < 0.9)
    turn = rng.uniform(0, 2 * math.pi, n)
    height = case.radius * rng.uniform(-1, 1, n)
    target = np.column_stack(
        [at.real + beside * np.cos(turn), at.imag + beside * np.sin(turn), height]
    )
    d = rng.normal(size=(n, 3))
    d[: n // 4, 2] = 0
    d[n // 4 : n // 2, :2] = 0
    d = unit(d)
    back = case.radius * np.where(rng.random(n) < 0.5, 3.0, rng.uniform(0, 1, n))
    return target - back[:, None] * d, d


def check_first_hits(case: Case, o: np.ndarray, d: np.ndarray, precision: Any, samples: int) -> int:
    """No crossing before the first hit, and every hit is at a sheet. Returns how many hits."""
    hits = hk.trace(case.field, o, d, precision=precision)
    assert (hits.status != hk.Status.OUT_OF_STEPS).all()
    hit = hits.status == hk.Status.HIT
    across = -np.einsum("nk,nk->n", o, d)
    half = case.radius**2 - np.einsum("nk,nk->n", o, o) + across**2
    half = np.sqrt(np.maximum(half, 0)) * (1 - 1e-6)
    start = np.maximum(across - half, 0)
    # Hits may be early by the tolerance, and are compared with a little less.
    end = np.where(hit, hits.t - 3e-5 * case.radius, across + half)
    rows = np.flatnonzero(end > start)
    share = np.linspace(0, 1, samples)
    for some in np.array_split(rows, max(1, len(rows) * samples // 2_000_000)):
        t = start[some, None] + (end - start)[some, None] * share
        p = o[some, None] + t[..., None] * d[some, None]
        sign = case.product(p[..., 0] + 1j * p[..., 1], p[..., 2])
        passed = (sign[:, 1:] * sign[:, :-1] < 0).any(axis=1)
        assert not passed.any(), (o[some][passed][:3], d[some][passed][:3], passed.sum())
    return int(hit.sum())


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", QUICK)
def test_no_sheet_is_passed_on_the_way_to_a_hit(name: str, precision: str) -> None:
    case = CASES[name]
    assert check_first_hits(case, *rays(200, case.radius), precision, 2000) > 60
    check_first_hits(case, *hostile_rays(200, case), precision, 2000)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", CASES)
def test_no_sheet_is_passed_by_thousands_of_rays(name: str, precision: str) -> None:
    case = CASES[name]
    assert check_first_hits(case, *rays(5000, case.radius), precision, 6000) > 1000
    check_first_hits(case, *hostile_rays(2000, case), precision, 6000)
