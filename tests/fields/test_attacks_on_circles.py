"""Cases that attacks on circles found, kept as they were."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import HarmonicBall
from tests.oracles.circle_oracle import MixedOracle

PRECISIONS = ("single", "double")


def unit(v: Any) -> np.ndarray:
    v = np.asarray(v, dtype=float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_windows_far_above_small_circles_hold() -> None:
    """The solid angle of a small circle vanishes in rounding, and its sign told on which side of it
    a point is: the lift fell 0.5 below its window, where a level lay."""
    big, small = hk.geometry.Circle(1.0), hk.geometry.Circle(1e-4, (1.25, 0.0, 0.25))
    n, rng = 200, np.random.default_rng(0)
    x = np.array(small.center) + np.column_stack(
        [6e-5 * rng.uniform(-1, 1, (n, 2)), rng.uniform(0.25, 1, n)]
    )
    x = x.astype(np.float32).astype(np.float64)
    backend = choose_backend("single")
    evaluator = hk.SolidAngle([big, small]).evaluator(backend)
    sample = evaluator.evaluate(to_vector3(backend, x, "points"))
    value = to_numpy(sample.value).astype(float)
    balls = [one for one in sample.all_promises if isinstance(one, HarmonicBall)]
    assert len(balls) == 1
    for ball in balls:
        radius, lower, upper = (
            np.broadcast_to(to_numpy(one), (n,)) for one in (ball.radius, ball.lower, ball.upper)
        )
        # Down to the small circle, dense near it.
        share = np.append(np.linspace(0, 0.9, 20), 1 - np.logspace(-1, -7, 60))
        down = x[:, None] + (share * radius[:, None])[..., None] * np.array([0, 0, -1.0])
        angle = MixedOracle([], [big, small])(down.reshape(-1, 3)).value.reshape(n, -1)
        lift = np.unwrap(np.column_stack([value, angle]), period=4 * math.pi)
        assert (lift.min(axis=1) >= lower - 1e-4).all()
        assert (lift.max(axis=1) <= upper + 1e-4).all()


@pytest.mark.parametrize("offset", [100.0, 1e4])
def test_rays_beside_circles_far_from_the_origin_end(offset: float) -> None:
    """Beside the curve rounding hid on which side of the plane's region a point is, and a ball of
    radius 0 was all that was promised: one ray in ten ran out of steps."""
    rng, n = np.random.default_rng(3), 600
    center, normal = np.array([offset, -offset, offset]), unit([0.3, 0.5, 0.8])
    ring = [
        hk.geometry.Circle(1, tuple(center), tuple(normal)),
        hk.geometry.Circle(0.5, tuple(center), -normal),
    ]
    first = unit(np.cross(normal, [0.3, 0.5, 0.1]))
    turn = rng.uniform(0, 2 * np.pi, (n, 1))
    radius = rng.choice([0.5, 1.0], (n, 1))
    radius *= 1 + 10.0 ** rng.uniform(-8, -1, (n, 1)) * rng.choice([-1, 1], (n, 1))
    target = center + radius * (np.cos(turn) * first + np.sin(turn) * np.cross(normal, first))
    o = center + 3 * unit(rng.normal(size=(n, 3)))
    field = hk.SolidAngle(ring)
    assert field.describe()["lift_bound"] == "planar"
    hits = hk.trace(field, o, target - o, level=1.2, precision="single", t_max=8)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert hits.is_hit.sum() > 500


def test_small_circles_that_are_tilted_are_in_no_plane() -> None:
    """Such a circle lies in the plane to within its radius, and was taken for a hole of it."""
    outline = hk.geometry.Circle(1)
    for radius, normal in ((5e-13, (1, 0, 0)), (1e-10, (0.009, 0, -1))):
        hole = hk.geometry.Circle(radius, (0.3, 0, 0), normal)
        for both in ([outline, hole], [hole, outline]):
            with pytest.raises(ValueError, match="neither"):
                hk.SolidAngle([np.eye(3) + 9, *both], lift_bound="planar")
            assert hk.SolidAngle(both)._region is None  # pyright: ignore[reportPrivateUsage]
    flat = hk.SolidAngle([outline, hk.geometry.Circle(1e-10, (0.3, 0, 0), (0, 0, -1))])
    assert flat._region is not None  # pyright: ignore[reportPrivateUsage]
