"""Closed solids, ray by ray, against a dense march in NumPy."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_float, to_numpy, to_vector3
from harnack.geometry.volume import Volume
from harnack.rendering.surface_hits import CappedSolid, orient_normal
from harnack.tracer import traced_surface

BACKEND = choose_backend()
BALL = hk.Ball((0.1, 0.0, -0.05), 0.9)
BOX = hk.Box((-0.5, -0.6, -0.7), (0.6, 0.5, 0.4))
TOLERANCE = 1e-4


def gyroid(p: np.ndarray) -> np.ndarray:
    x, y, z = 2 * np.pi * np.moveaxis(p, -1, 0)
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


def solid_of(low: float, high: float, volume: Volume) -> CappedSolid:
    if math.isinf(low) or math.isinf(high):
        level, side = (high, "below") if math.isinf(low) else (low, "above")
    else:
        level, side = (low, high), "between"
    field = hk.Gyroid(1.0, domain=volume)
    surface = traced_surface(field, level=level, side=side, tolerance=TOLERANCE)
    assert surface.solid_range == (low, high)
    return CappedSolid.of(surface, surface.tracer(BACKEND))


def rays(n: int, seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    o = rng.uniform(-spread, spread, (n, 3))
    d = rng.normal(size=(n, 3))
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def met_by(
    solid: CappedSolid, o: np.ndarray, d: np.ndarray, t_max: float, leaves: float = 0.0
) -> Any:
    return solid.intersect(
        to_vector3(BACKEND, o),
        to_vector3(BACKEND, d),
        to_float(BACKEND, np.full(len(o), t_max)),
        BACKEND.Bool(True),
        BACKEND.Float(leaves),
    )


def dense_crossings(
    low: float, high: float, volume: Volume, o: np.ndarray, d: np.ndarray, t_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays first change between inside and outside (inf: never), and where they start."""
    t = np.linspace(0.0, t_max, 4001)
    p = o[:, None] + t[:, None] * d[:, None]
    f = gyroid(p)
    inside = (f >= low) & (f <= high)
    inside &= volume.contains_points(p.reshape(-1, 3)).reshape(inside.shape)
    changes = inside[:, 1:] != inside[:, :-1]
    first = np.where(changes.any(axis=1), t[1:][changes.argmax(axis=1)], np.inf)
    return first, inside[:, 0]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "volume",
    [
        pytest.param(BALL, marks=pytest.mark.slow),
        pytest.param(BOX, marks=pytest.mark.slow),
        hk.geometry.VolumeIntersection((BALL, BOX)),
    ],
)
@pytest.mark.parametrize(("low", "high"), [(-0.4, 0.3), (-math.inf, 0.1), (0.2, math.inf)])
@pytest.mark.parametrize("t_max", [pytest.param(0.4, marks=pytest.mark.slow), 4.0])
def test_rays_cross_the_boundary_where_the_solid_begins_or_ends(
    volume: Volume, low: float, high: float, t_max: float
) -> None:
    o, d = rays(600, 7, 1.2)
    met = met_by(solid_of(low, high, volume), o, d, t_max)
    t = np.where(to_numpy(met.is_hit), to_numpy(met.t), np.inf)
    expected, inside = dense_crossings(low, high, volume, o, d, t_max)
    assert not to_numpy(met.is_out_of_steps).any()
    # A dense march misses what is thinner than its step, and a hit may be early by the
    # tolerance over the sine of the ray to the surface.
    with np.errstate(invalid="ignore"):
        agree = (np.isinf(t) & np.isinf(expected)) | (np.abs(t - expected) < 3e-3)
    assert np.mean(agree) > 0.97
    assert not (np.isinf(t) & np.isfinite(expected) & (expected < t_max - 0.01)).any()
    assert np.isfinite(expected).mean() > 0.05

    hit = to_numpy(met.is_hit)
    towards = (to_numpy(met.normal) * d).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(to_numpy(met.normal), axis=1)[hit], 1, atol=1e-5)
    assert (towards[hit & inside] > 0).all()  # rays from inside go out, along the normal
    assert (towards[hit & ~inside] < 0).all()


def test_hits_lie_on_the_boundary_far_closer_than_the_tolerance() -> None:
    low, high = -0.4, 0.3
    o, d = rays(2000, 3, 1.2)
    met = met_by(solid_of(low, high, BALL), o, d, 5.0)
    p = to_numpy(met.position)[to_numpy(met.is_hit)].astype(float)
    off_level = np.minimum(np.abs(gyroid(p) - low), np.abs(gyroid(p) - high)) / (2 * np.pi)
    off_cap = np.abs(np.linalg.norm(p - BALL.center, axis=1) - BALL.radius)
    assert len(p) > 500
    off = np.minimum(off_level, off_cap)
    assert np.quantile(off, 0.99) < 0.05 * TOLERANCE  # caps carry the clip's rounding
    assert off.max() < TOLERANCE


def test_occlusion_is_meeting() -> None:
    solid = solid_of(-0.4, 0.3, BOX)
    o, d = rays(4000, 5, 1.0)
    for t_max in (0.3, 3.0, np.inf):
        met = met_by(solid, o, d, t_max)
        occluded = solid.occludes(
            to_vector3(BACKEND, o),
            to_vector3(BACKEND, d),
            to_float(BACKEND, np.full(len(o), t_max)),
            BACKEND.Bool(True),
        )
        np.testing.assert_array_equal(to_numpy(occluded), to_numpy(met.is_hit))


@pytest.mark.slow
def test_a_ray_that_slipped_through_a_thin_part_crosses_back_at_once() -> None:
    solid = solid_of(-0.4, 0.3, BALL)
    o, d = rays(3000, 11, 1.2)
    _, inside = dense_crossings(-0.4, 0.3, BALL, o, d, 1.0)
    going_in, going_out = met_by(solid, o, d, 9.0, -1.0), met_by(solid, o, d, 9.0, 1.0)
    slipped = ~inside
    assert (to_numpy(going_in.t)[slipped] == 0).all()
    assert to_numpy(going_in.is_hit)[slipped].all()
    assert ((to_numpy(going_in.normal) * d).sum(axis=1)[slipped] > 0.99).all()
    assert (to_numpy(going_out.t)[inside] == 0).all()
    assert ((to_numpy(going_out.normal) * d).sum(axis=1)[inside] < -0.99).all()
    plain = to_numpy(met_by(solid, o, d, 9.0).t)
    np.testing.assert_array_equal(to_numpy(going_in.t)[inside], plain[inside])
    np.testing.assert_array_equal(to_numpy(going_out.t)[~inside], plain[~inside])


def test_only_solids_are_solid() -> None:
    surface = traced_surface(hk.Gyroid())
    with pytest.raises(ValueError, match="solid"):
        CappedSolid.of(surface, surface.tracer(BACKEND))


def test_a_normal_is_turned_only_if_it_faces_away() -> None:
    rng = np.random.default_rng(0)
    n, d = (BACKEND.Array3f(rng.normal(size=(3, 500))) for _ in range(2))
    n, d = dr.normalize(n), dr.normalize(d)
    for side in (1.0, -1.0):
        turned = orient_normal(n, d, BACKEND.Float(side))
        along = side * to_numpy(dr.dot(turned, d))
        assert (along > 0).all()
        np.testing.assert_allclose(to_numpy(dr.norm(turned)), 1.0, atol=1e-5)
        kept = side * to_numpy(dr.dot(n, d)) >= 1e-3
        np.testing.assert_array_equal(to_numpy(turned)[kept], to_numpy(n)[kept])
        # What is turned ends perpendicular to the ray, where the true normal's part across it
        # points.
        across = to_numpy(turned - dr.dot(turned, d) * d)
        before = to_numpy(n - dr.dot(n, d) * d)
        assert ((across * before).sum(axis=1) >= 0).all()
