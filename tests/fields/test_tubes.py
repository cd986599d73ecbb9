"""Tubes around many polylines, whose segments are looked at in groups."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.testing import check_field


def polylines(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(count)
    return [
        rng.uniform(-1, 1, 3) + np.cumsum(0.06 * rng.normal(size=(int(rng.integers(2, 30)), 3)), 0)
        for _ in range(count)
    ]


def distance(x: np.ndarray, lines: list[np.ndarray]) -> np.ndarray:
    """From points (n, 3) to the nearest segment, one by one."""
    nearest = np.full(len(x), np.inf)
    for line in lines:
        for a, b in itertools.pairwise(line):
            share = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            away = np.linalg.norm(x - a - share[:, None] * (b - a), axis=1)
            nearest = np.minimum(nearest, away)
    return nearest


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("count", [2, 25])
def test_the_distance_is_that_from_the_nearest_of_all(count: int, precision: Any) -> None:
    """With few segments one by one, with many in groups; nothing joins one line to the next."""
    lines = polylines(count)
    tube = hk.Tube.from_polylines(lines, 0.03)
    assert tube.describe()["segments"] == sum(len(line) - 1 for line in lines)
    x = np.random.default_rng(1).uniform(-1.3, 1.3, (2000, 3))
    x[:200] = np.concatenate(lines * 200)[:200]  # at vertices themselves
    found = tube.value(x, precision=precision)
    small = 2e-6 if precision == "single" else 1e-14
    np.testing.assert_allclose(found, distance(x, lines) - 0.03, atol=small)


@pytest.mark.slow
def test_contracts_of_tubes_in_groups() -> None:
    check_field(hk.Tube.from_polylines(polylines(25), 0.03))


@pytest.mark.parametrize("precision", ["single", "double"])
def test_first_hits_of_tubes_in_groups(precision: Any) -> None:
    lines = polylines(12)
    whole = hk.Tube.from_polylines(lines, 0.03)
    rng = np.random.default_rng(2)
    o = 3 * rng.normal(size=(400, 3))
    aim = np.concatenate(lines)[rng.integers(0, sum(map(len, lines)), 400)]
    d = aim + 0.03 * rng.normal(size=(400, 3)) - o
    found = hk.trace(whole, o, d, precision=precision, tolerance=1e-5)
    first = np.min([hk.trace(hk.Tube(one, 0.03), o, d, precision=precision, tolerance=1e-5).t
                    for one in lines], axis=0)  # fmt: skip
    assert (found.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert found.is_hit.mean() > 0.3
    # Rays that graze the tube within the tolerance may hit one and not the other.
    both = np.isfinite(found.t) & np.isfinite(first)
    assert (np.isfinite(found.t) != np.isfinite(first)).mean() < 0.01
    assert (np.abs(found.t[both] - first[both]) < 2e-3).mean() > 0.99


def test_what_is_no_bundle_of_tubes() -> None:
    with pytest.raises(ValueError, match="there are none"):
        hk.Tube.from_polylines([], 0.1)
    with pytest.raises(ValueError, match="two points or more"):
        hk.Tube.from_polylines([[[0, 0, 0], [1, 0, 0]], [[0, 0, 1.0]]], 0.1)
    with pytest.raises(ValueError, match="polyline 1 of a tube"):
        hk.Tube.from_polylines([[[0, 0, 0], [1, 0, 0]], [[0, 0.0]]], 0.1)


def _in_unbounded_solids() -> dict[str, tuple[Any, float]]:
    """Solids without bounds that hold a tube, and where a ray down at (.3, .02) meets it first."""
    tube, plane = hk.Tube([[-1, 0, 0], [1, 0, 0]], 0.1), hk.solids.Plane((0, 0, 1), -0.5)
    bent = hk.Tube.bezier([[-1, 0, 0], [-0.3, 0, 0], [0.3, 0, 0], [1, 0, 0]], 0.1)
    many = hk.Tube.from_polylines(
        [[[x, 0, 0], [x + 0.1, 0, 0]] for x in np.arange(-5, 5, 0.1)], 0.1
    )
    top, wide = 2 - math.sqrt(0.1**2 - 0.02**2), 2 - math.sqrt(0.15**2 - 0.02**2)
    return {
        "union": (tube | plane, top),
        "Bezier curve": (bent | plane, top),
        "groups": (many | plane, top),
        "grown": ((tube | plane).offset(0.05), wide),
        "moved and scaled": ((tube.scaled(0.5) | plane).scaled(2), top),
        "complements": (~(~tube & ~plane), top),
        "difference": (
            hk.solids.Plane((0, 0, 1), 1.0) - tube.translated((0, 0, 0.95)),
            1.0 + 0.05 + 0.098,
        ),
        "without a plane": (tube, top),
    }


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", _in_unbounded_solids())
def test_tubes_are_seen_in_solids_without_bounds(name: str, precision: Any) -> None:
    """The infinite length looked ahead, times a slope of 0, hid them: 0 inf is no number."""
    solid, t = _in_unbounded_solids()[name]
    o, d = [[0.3, 0.02, 2.0]], [[0.0, 0.0, -1.0]]
    cut: dict[str, Any] = {"clip": hk.HalfSpace((1, 0, 0), 5.0)}
    settings: dict[str, Any] = {"precision": precision, "tolerance": 1e-4}
    for options in ({}, {"require_crossing": True}, cut, {"t_max": 100.0}):
        hits = hk.trace(solid, o, d, **settings, **options)
        assert hits.t[0] == pytest.approx(t, abs=2e-4), options
    crossings = hk.crossings(solid, o, d, max_crossings=4, **settings)
    assert crossings.t[0, 0] == pytest.approx(t, abs=2e-4)
    misses = hk.trace(solid, o, [[0.0, 0.1, 1.0]], precision=precision)
    assert misses.status[0] == hk.RayStatus.MISS
    assert misses.evaluations[0] < 10
