"""The ball about a closest point that holds no nearer one: attained, and against dense samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.backend.arrays import upload_vectors
from harnack.distance.cell_classification import taylor_remainder
from harnack.distance.exclusion_ball import exclusion_radius
from harnack.enclosures.samples import Sample
from harnack.fields.analytic.waves import WaveBounds
from tests.distance.test_distance import CURVED, surface_points

DOUBLE = choose_backend("double")


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_the_ball_ends_at_the_center_of_curvature(side: int, share: float) -> None:
    """Of the cylinder side z = y^2: within the radius 1/2 of curvature its vertex is nearest, and
    beyond that it is not, so that no ball may be free."""
    vector, real = DOUBLE.Array3f, DOUBLE.Float
    sample = Sample(
        real(0), vector(0, 0, side), (hk.proofs.TaylorRemainder(2.0, cubic_constant=0.0),)
    )
    rows = vector(0, 0, 0), vector(0, -2, 0), vector(0, 0, 0)
    x = vector(0, 0, side * 0.5 * share)
    free = float(np.array(exclusion_radius(sample, rows, x, vector(0)))[0])
    assert (free > 1) == (share < 1)
    # On the other side it always is.
    free = float(np.array(exclusion_radius(sample, rows, -10 * x, vector(0)))[0])
    assert free > 100


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_the_second_remainder_is_attained_by_poissons_kernel(dimension: int) -> None:
    """As that of first degree: along its axis nothing is to spare."""
    q = np.linspace(0.01, 0.9, 30)
    second = {2: 2, 3: 5, 4: 9}[dimension]
    rest = (1 + q) / (1 - q) ** (dimension - 1) - 1 - dimension * q - second * q * q
    ball = hk.proofs.HarmonicBall(1.0, -1.0, math.inf, dimension)
    found = np.array(
        taylor_remainder(Sample(DOUBLE.Float(0), DOUBLE.Array3f(0), (ball,)), DOUBLE.Float(q), 2)
    )
    assert found == pytest.approx(rest, rel=1e-9)


def test_third_derivatives_of_waves() -> None:
    """Attained by one wave; of the gyroid, by differences of second derivatives."""
    wave = hk.fields.PlaneWave(3.0, (0.0, 4.0, 3.0))
    assert WaveBounds.of([wave]).max_third_derivative == pytest.approx(3 * 5**3, rel=1e-9)
    rng, h = np.random.default_rng(0), 1e-4
    p, v = rng.uniform(-4, 4, (2000, 3)), rng.normal(size=(2000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    field = hk.Gyroid()
    ahead, back = (field.hessian(p + s * h * v, precision="double") for s in (1, -1))
    third = np.abs(np.einsum("ni,nij,nj->n", v, ahead - back, v)) / (2 * h)
    assert 0.5 * field.waves.max_third_derivative < third.max() < field.waves.max_third_derivative


@pytest.mark.parametrize("name", ["wavy", "gyroid"])
def test_no_sample_in_the_ball_is_nearer(name: str) -> None:
    field: Any = CURVED[name]
    on = surface_points(field, 4000)
    prepared = field.evaluator(DOUBLE)
    rng = np.random.default_rng(1)
    y = on[rng.integers(len(on), size=300)]
    g = field.gradient(y, precision="double")
    far = rng.uniform(-1.5, 1.5, (300, 1)) * (1.0 if name == "gyroid" else 0.3)
    x = y + far * g / np.linalg.norm(g, axis=1, keepdims=True)
    at, rows = upload_vectors(DOUBLE, y), prepared.hessian(upload_vectors(DOUBLE, y))
    free = np.array(exclusion_radius(prepared.evaluate(at), rows, upload_vectors(DOUBLE, x), at))
    assert (free > 0.1 * np.abs(far[:, 0])).mean() > 0.3
    for k in range(300):
        within = on[np.linalg.norm(on - y[k], axis=1) < free[k]]
        assert (np.linalg.norm(within - x[k], axis=1) >= abs(far[k, 0]) * (1 - 1e-5)).all()
