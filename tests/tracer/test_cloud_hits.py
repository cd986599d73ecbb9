"""First hits of dipole clouds, against the sum over all points in double precision."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

import harnack as hk
from tests.oracles.direct_sums import dipole_sum
from tests.oracles.oracle import Crossings, OracleValues, first_crossings

LEVEL, FAR, TOLERANCE = 2 * math.pi, 4.0, 1e-4
# What single precision does to a point of a ray, as a length: beyond this a crossing counts.
ROUNDING = 2e-6
Cloud = tuple[np.ndarray, np.ndarray, np.ndarray]


def cloud(n: int, seed: int = 0) -> Cloud:
    """n points strewn over the bumpy sphere r = 1 + 0.15 sin 5x sin 5y sin 5z, with the normals
    and, at random a little too large or small, the areas that they hold."""
    rng = np.random.default_rng(seed)
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    u = np.column_stack([np.cos(turn), np.sin(turn), z])
    u[:, :2] *= np.sqrt(1 - z * z)[:, None]
    u = unit(u + rng.normal(size=u.shape) / math.sqrt(n))
    s, c = np.sin(5 * u), np.cos(5 * u)
    r = 1 + 0.15 * s.prod(axis=1)
    slope = 0.75 * c * np.roll(s, 1, axis=1) * np.roll(s, 2, axis=1)
    slope -= (slope * u).sum(axis=1, keepdims=True) * u
    normals = unit(u - slope / r[:, None])
    areas = 4 * np.pi / n * r * r / (normals * u).sum(axis=1) * rng.uniform(0.7, 1.3, n)
    points = (u * r[:, None]).astype(np.float32).astype(np.float64)
    return points, normals, areas


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rays(points: np.ndarray, n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """From outside and inside; anywhere, closely past points, and along the surface."""
    rng = np.random.default_rng(seed)
    o = 2.4 * unit(rng.normal(size=(n, 3)))
    o[: n // 4] = rng.uniform(-0.9, 0.9, (n // 4, 3))
    target = rng.uniform(-1.2, 1.2, (n, 3))
    half = n // 2
    past = points[rng.integers(len(points), size=half)]
    target[n - half :] = past + 10 ** rng.uniform(-3, -1, (half, 1)) * unit(
        rng.normal(size=(half, 3))
    )
    o = o.astype(np.float32).astype(np.float64)
    return o, unit(target - o)


def looking(points: np.ndarray, moments: np.ndarray) -> Any:
    """The O(n) sum, smooth over the distance to the nearest point."""
    exact, tree = dipole_sum(points, moments), cKDTree(points)

    def look(x: np.ndarray) -> OracleValues:
        value, gradient = exact(x)
        return OracleValues(value, gradient, tree.query(x)[0])

    return look


def crossings_of(some: Cloud, o: np.ndarray, d: np.ndarray, spacing: float) -> Crossings:
    points, normals, areas = some
    return first_crossings(
        looking(points, areas[:, None] * normals), o, d, 0.0, FAR,
        levels=[LEVEL], depth=ROUNDING, spacing=spacing, finest=5e-4,
    )  # fmt: skip


def wrong_hits(
    hits: hk.Hits, truth: Crossings, some: Cloud, o: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays that pass a crossing of the exact sum, and hits that are nowhere near a level.

    A hit is taken where the tree's value is within tolerance, or twice its error, of the level,
    and the exact value may be off by that error once more, on either side: a hit lies no farther
    behind a crossing than the error is long.
    """
    points, normals, areas = some
    at = np.flatnonzero(hits.is_hit)
    x = (o + hits.t[:, None] * d)[at]
    value, gradient = dipole_sum(points, areas[:, None] * normals)(x)
    steepness = np.linalg.norm(gradient, axis=1)
    error = hk.DipolePotential(*some, accuracy=4.0).error_bound(x, precision="single")
    error += 1e-6 * np.abs(value)
    latest = truth.beyond + ROUNDING
    latest[at] += 1.05 * error / steepness
    missed = np.flatnonzero(np.where(hits.is_hit, hits.t, np.inf) > latest)
    off = np.abs(value - LEVEL) > 1.05 * (TOLERANCE + ROUNDING) * steepness + 3 * error
    # On a point itself all values meet.
    return missed, at[off & (cKDTree(points).query(x)[0] > 1e-5)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "count", "spacing"),
    [(100, 1000, 0.1), (1000, 1000, 0.15), pytest.param(10_000, 1000, 0.2, marks=pytest.mark.slow)],
)
def test_first_hits_agree_with_the_sum_over_all_points(n: int, count: int, spacing: float) -> None:
    some = cloud(n)
    o, d = rays(some[0], count)
    truth = crossings_of(some, o, d, spacing)
    hits = hk.trace(
        hk.DipolePotential(*some), o, d, t_max=FAR, tolerance=TOLERANCE, precision="single"
    )
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    missed, early = wrong_hits(hits, truth, some, o, d)
    assert len(missed) == 0, (o[missed], d[missed], hits.t[missed], truth.beyond[missed])
    assert len(early) == 0, (o[early], d[early], hits.t[early])
    crossed = np.isfinite(truth.beyond)
    assert crossed.sum() > 0.6 * count
    # Hits that cross nothing touch the surface; where it is crossed, they are mostly just there.
    assert hits.is_hit[crossed].all()
    gap = truth.beyond[crossed] - hits.t[crossed]
    assert np.median(gap) < 3 * TOLERANCE


def test_the_oracle_sees_hits_that_are_late_or_nowhere() -> None:
    some = cloud(100)
    o, d = rays(some[0], 100)
    truth = crossings_of(some, o, d, 0.1)
    hits = hk.trace(
        hk.DipolePotential(*some), o, d, t_max=FAR, tolerance=TOLERANCE, precision="single"
    )
    crossed = np.isfinite(truth.beyond)
    late = truth.beyond + 0.01
    for t, wrong in ((np.where(crossed, late, hits.t), 0), (0.97 * hits.t, 1)):
        spoiled = hk.Hits(**{**vars(hits), "t": t})
        assert len(wrong_hits(spoiled, truth, some, o, d)[wrong]) > 0.7 * crossed.sum()


@pytest.mark.slow
def test_a_tree_that_hides_its_error_misses_hits() -> None:
    """Truncation matters: the test above would see it if the bound did not enter the steps."""

    class Sure(hk.DipolePotential):
        """As coarse as can be, and nothing said of it."""

        variable_accuracy = None  # type: ignore[assignment]

        def evaluate(self, p: Any) -> hk.fields.Sample:
            sample = super().evaluate(p)
            return hk.fields.Sample(sample.value, sample.gradient, sample.promises)

    some = cloud(1000)
    o, d = rays(some[0], 1000)
    truth = crossings_of(some, o, d, 0.3)
    late_counts = []
    for kind in (Sure, hk.DipolePotential):
        field = kind(*some, accuracy=1.5)
        hits = hk.trace(field, o, d, t_max=FAR, tolerance=1e-5, precision="single")
        at = hits.is_hit
        x = o + np.where(at, hits.t, 0)[:, None] * d
        error = field.error_bound(x, precision="single")
        steepness = np.linalg.norm(field.gradient(x, precision="single"), axis=1)
        late = np.where(at, hits.t, np.inf) > truth.beyond + ROUNDING
        late &= ~at | (kind is Sure) | (hits.t > truth.beyond + 1.1 * error / steepness)
        late_counts.append(int(late.sum()))
    assert late_counts[0] > 10
    assert late_counts[1] == 0
