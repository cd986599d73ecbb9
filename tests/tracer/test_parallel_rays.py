"""Rays that are parallel to a surface, up to rounding, and rays that never end."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk

CYLINDER = hk.expression(lambda x, y, z: x * x + y * y - 0.25)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_rays_parallel_to_a_surface_are_no_hits_at_the_end_of_the_numbers(precision: Any) -> None:
    """They were hits at 1e37, with an uncertainty of 1e31."""
    o = np.array([[0.0, 0.0, 2.0], [1.0, 2.0, 3.0], [0.1, 0.2, 2.0]])
    along = hk.trace(hk.solids.Plane((0, 0, 1), 0.5), o, [[1, 0, 0], [1, 1, 0], [0.3, 0.7, 0]],
                     precision=precision)  # fmt: skip
    assert (along.status == hk.RayStatus.MISS).all()
    up = hk.trace(CYLINDER, o, [[0, 0, 1]] * 3, precision=precision)
    assert (up.status == hk.RayStatus.MISS).all()
    # The directions are rounded, and with them whether and where the ray meets the plane.
    slanted = hk.trace(hk.solids.Plane((1, 2, 3), 0.5), o, [[3, 0, -1], [2, -1, 0], [0, 3, -2]],
                       precision=precision)  # fmt: skip
    assert (slanted.status != hk.RayStatus.HIT).all()


def test_what_is_not_known_far_away_proves_no_miss() -> None:
    """Angles so large are no numbers in single precision."""
    d = [[1.0, 0.3, 0.02], [0.3, -1.0, 0.3]]
    sine = hk.expression("sin(x)")
    waves = hk.trace(sine, [[1e13, 1e13, 1e13]], d, t_min=1e13, precision="single")
    assert (waves.status == hk.RayStatus.OUT_OF_STEPS).all()


@pytest.mark.parametrize("precision", ["single", "double"])
def test_a_cone_without_bounds_proves_its_misses(precision: Any) -> None:
    rng = np.random.default_rng(0)
    o, d = 2 * rng.normal(size=(1000, 3)), rng.normal(size=(1000, 3))
    angle = 0.5
    found = hk.trace(hk.solids.DoubleCone(math.degrees(angle)), o, d, precision=precision)
    assert (found.status != hk.RayStatus.OUT_OF_STEPS).all()
    # (x^2 + y^2) cos^2 = z^2 sin^2 along o + t d is a quadratic equation.
    d /= np.linalg.norm(d, axis=1)[:, None]
    weight = np.array([np.cos(angle) ** 2] * 2 + [-(np.sin(angle) ** 2)])
    a, b, c = ((weight * one).sum(axis=1) for one in (d * d, o * d, o * o))
    inside = b * b - a * c
    roots = (-b[:, None] + np.sqrt(np.maximum(inside, 0))[:, None] * [-1.0, 1.0]) / a[:, None]
    roots = np.where((inside[:, None] > 0) & (roots > 0), roots, np.inf)
    clear = np.abs(inside) > 1e-3
    np.testing.assert_array_equal(found.is_hit[clear], np.isfinite(roots.min(axis=1))[clear])
    sure = clear & found.is_hit & (roots.min(axis=1) < 100)
    np.testing.assert_allclose(found.t[sure], roots.min(axis=1)[sure], rtol=1e-3, atol=1e-3)
