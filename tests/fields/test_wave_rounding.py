"""Sums of waves: what rounding may do to them is stated at the point, in both precisions."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy
from harnack.backend.elementary import max_sincos_argument, sincos
from harnack.enclosures import TaylorRemainder
from harnack.fields.analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from harnack.testing.violation_search import sample_field

UNIT = 2.0**-24


@pytest.mark.parametrize("scale", [0.1, 1.0, 100.0, 8192.0, 1e5, 1e6])
def test_sines_in_single_precision(scale: float) -> None:
    """Dr.Jit's own are 1e5 units off at 1e6, and use a coarse instruction on CUDA."""
    backend = choose_backend("single")
    x = np.random.default_rng(0).uniform(-scale, scale, 200_000).astype(np.float32)
    s, c = sincos(backend.Float(x))
    assert np.abs(to_numpy(s) - np.sin(x.astype(np.float64))).max() <= 2 * UNIT
    assert np.abs(to_numpy(c) - np.cos(x.astype(np.float64))).max() <= 2 * UNIT


def test_sines_in_double_precision() -> None:
    backend = choose_backend("double")
    x = np.random.default_rng(0).uniform(-1000, 1000, 100_000)
    s, c = sincos(backend.Float(x))
    far = x.astype(np.longdouble)
    assert np.abs(to_numpy(s) - np.sin(far)).max() <= 2 * 2.0**-53
    assert np.abs(to_numpy(c) - np.cos(far)).max() <= 2 * 2.0**-53


def test_sines_have_derivatives() -> None:
    backend = choose_backend("single")
    x = backend.Float([0.3, 2.0, -7.0])
    dr.enable_grad(x)
    s, c = sincos(x)
    dr.backward(s + 2 * c)
    expected = to_numpy(c) - 2 * to_numpy(s)
    np.testing.assert_allclose(to_numpy(dr.grad(x)), expected, atol=2e-6)


_RNG = np.random.default_rng(4)
FIELDS = {
    "gyroid": hk.Gyroid(),
    "gyroid, far": hk.Gyroid(domain=hk.Ball((500.0, 0.0, 0.0), 10.0)),
    "P": hk.fields.SchwarzP(cell=2.0),
    # These were 113 and 31 times as far off as stated.
    "D, a hundred cells": hk.fields.SchwarzD(cell=0.01, domain=hk.Ball(radius=1.0)),
    "plane waves": hk.fields.EigenfunctionSum(
        [PlaneWave(1.0, (30.0, -20.0, 5.0), 0.3), PlaneWave(0.5, (1.0, 2.0, -40.0), 2.0)],
        domain=hk.Ball(radius=3.0),
    ),
    "unlike frequencies": hk.fields.EigenfunctionSum(
        [WaveProduct(1.0, sine_factor(6.3), sine_factor(5.1, 1.0)),
        WaveProduct(-0.4, cosine_factor(63.0), None, sine_factor(2.0))],
        domain=hk.Box((-3, -3, -3), (3, 3, 3)),
    ),
    "many": hk.fields.EigenfunctionSum(
        [
            PlaneWave(float(a), tuple(float(v) for v in k), float(phase))  # type: ignore[arg-type]
            for a, k, phase in zip(
                _RNG.normal(size=40), 5 * _RNG.normal(size=(40, 3)), _RNG.uniform(0, 6, 40),
                strict=True,
            )
        ]
    ),
}  # fmt: skip


@pytest.mark.few(5)
@pytest.mark.parametrize("name", FIELDS)
def test_error_of_waves_covers_single_precision(name: str) -> None:
    """And is never a hundred times the largest error seen, also of sums of forty waves."""
    field = FIELDS[name]
    lower, upper = field.domain.bounds()
    p = np.random.default_rng(1).uniform(lower, upper, (20_000, 3))
    p = p.astype(np.float32).astype(np.float64)
    exact, rounded = sample_field(field, p), sample_field(field, p, "single")
    off = np.abs(rounded.value - exact.value)
    assert (off <= rounded.error).all()
    assert off.max() > 0.01 * rounded.error.max()


@pytest.mark.parametrize("name", FIELDS)
def test_taylor_with_a_rounded_gradient_holds(name: str) -> None:
    """What single precision says of f near p is true of f within the errors that it states.

    The tracer allows for a rounding of the point besides, 8 u of its size.
    """
    field = FIELDS[name]
    lower, upper = field.domain.bounds()
    rng = np.random.default_rng(2)
    p = rng.uniform(lower, upper, (4000, 3)).astype(np.float32).astype(np.float64)
    exact, rounded = sample_field(field, p), sample_field(field, p, "single")
    d = rng.normal(size=p.shape)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    (promise,) = [one for one in rounded.promises if isinstance(one, TaylorRemainder)]
    steep = np.linalg.norm(exact.gradient, axis=1)
    moved_point = 8 * UNIT * np.abs(p).max(axis=1)
    for t in np.geomspace(1e-4, 2, 8) / np.sqrt(field.curvature):
        true = sample_field(field, p + t * d)
        said = rounded.value + t * np.einsum("nk,nk->n", rounded.gradient, d)
        room = 0.5 * promise.constant * t * t + rounded.error
        room += moved_point * (steep + field.curvature * t)
        assert (np.abs(true.value - said) <= room).all()


@pytest.mark.parametrize("precision", ["single", "double"])
def test_sines_are_right_as_far_as_they_are_known_and_no_numbers_beyond(precision: Any) -> None:
    """In double precision they were wrong from some 10^9 on: a gyroid had values of 1e122 there."""
    backend = choose_backend(precision)
    real, kind = backend.Float, backend.dtype
    rng, most = np.random.default_rng(0), max_sincos_argument(real)
    near_zeros = np.round(rng.uniform(-1, 1, 20_000) * most / math.pi) * math.pi
    x = np.concatenate([rng.uniform(-most, most, 20_000), near_zeros]).astype(kind)
    x = x[np.abs(x) <= most]
    s, c = sincos(real(x))
    unit = np.finfo(kind).eps / 2
    for found, right in (
        (s, np.sin(x.astype(np.longdouble))),
        (c, np.cos(x.astype(np.longdouble))),
    ):
        assert np.abs(found.numpy() - right).max() <= 2 * unit
    assert np.isnan(np.asarray(sincos(real([2.0 * most, -1e3 * most, np.inf])))).all()


@pytest.mark.parametrize(
    ("precision", "far", "status"),
    [
        ("single", 1e3, hk.RayStatus.HIT), ("single", 1e8, hk.RayStatus.OUT_OF_STEPS),
        ("double", 1e9, hk.RayStatus.HIT), ("double", 1e12, hk.RayStatus.HIT),
        ("double", 1e16, hk.RayStatus.OUT_OF_STEPS),
    ],
)  # fmt: skip
def test_gyroids_far_from_the_origin_are_right_or_not_known(
    precision: Any, far: float, status: hk.RayStatus
) -> None:
    rng = np.random.default_rng(1)
    center = far * np.array([1.0, -1.0, 0.5])
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(tuple(center), 100.0))
    o, d = center + rng.normal(size=(100, 3)), rng.normal(size=(100, 3))
    for field in (gyroid, hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3))):
        assert (hk.trace(field, o, d, precision=precision).status == status).all()
    x = o.astype(np.float32) if precision == "single" else o
    values = gyroid.value(x, precision=precision)
    if status == hk.RayStatus.HIT:
        angles = [2 * np.pi * x.astype(np.longdouble)[:, k] for k in range(3)]
        sines, cosines = np.sin(angles), np.cos(angles)
        right = sum(sines[k] * cosines[(k + 1) % 3] for k in range(3))
        assert np.abs(values - right).max() < 20 * np.finfo(x.dtype).eps * far
    else:
        assert np.isnan(values).all()


def test_formulas_know_sines_of_large_angles_in_double_precision() -> None:
    f, x = hk.expression("sin(x)"), np.array([2.0, 7e6, 1e9, 1e12, 1e14])
    points = np.column_stack([x, 0 * x, 0 * x])
    np.testing.assert_allclose(f.value(points, precision="double"), np.sin(x), atol=1e-15)


@pytest.mark.parametrize(("precision", "far"), [("single", 2e6), ("double", 1e15)])
def test_formulas_of_angles_that_are_not_known_have_no_value(precision: Any, far: float) -> None:
    """The middle of their range looked like the value 0."""
    f = hk.expression("sin(x) + y")
    assert np.isnan(f.value([[far, 0.5, 0.0]], precision=precision)).all()
    o, d = np.array([[far, 0.0, 0.0]] * 3), np.eye(3)
    found = hk.trace(f, o, d, precision=precision, clip=hk.Ball((far, 0.0, 0.0), 10.0))
    assert (found.status == hk.RayStatus.OUT_OF_STEPS).all()


def test_gradients_of_large_angles_are_not_taken_beside_the_point() -> None:
    """As if they were at a tie: they were off by 35 where rounding is 0.1."""
    x = np.random.default_rng(0).uniform(-100, 100, (3000, 3)).astype(np.float32)
    f = hk.expression("sin(30*x) + cos(20*y)*z")
    off = f.gradient(x, precision="single") - f.gradient(x, precision="double")
    assert np.abs(off).max() < 0.5
