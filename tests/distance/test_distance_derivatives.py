"""Derivatives of signed distances, against central differences in double precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f, Array3f64, Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

H = 1e-5


def wave(a: Any) -> hk.Field:
    return hk.expression("a*x^2 + y^2 + z^2 + 0.3*sin(3*x)", a=a)


def blobs(a: Any) -> hk.Field:
    """Larger inside, and without a number."""
    del a
    return hk.Blobs([[0.3, 0.0, 0.0], [-0.3, 0.1, 0.2]], 0.5)


@pytest.mark.parametrize(("make", "level"), [(wave, 0.6), (blobs, 0.4)])
def test_derivatives_agree_with_differences(make: Callable[[Any], Any], level: float) -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (40, 3))

    def distance(a: Any, level: Any, x: Any) -> Any:
        return hk.signed_distance(make(a), x, level=level)

    def difference(f: Callable[[float], Any]) -> Any:
        return (f(H) - f(-H)) / (2 * H)

    a, c, points = Float64(1.3), Float64(level), TensorXf64(x)
    dr.enable_grad(a, c, points)
    result = distance(a, c, points)
    assert result.shape == (40,)
    np.testing.assert_allclose(result, distance(1.3, level, x), atol=1e-12)
    rates = dr.select(dr.arange(type(c), 40) >= 0, result.array, 0)
    dr.backward(dr.sum(rates * rates) / 2)
    d = np.array(dr.detach(result))
    by_a = difference(lambda h: distance(1.3 + h, level, x))
    by_level = difference(lambda h: distance(1.3, level + h, x))
    np.testing.assert_allclose(dr.grad(a), d @ by_a, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(dr.grad(c), d @ by_level, rtol=1e-5)
    by_points = [difference(lambda h, e=e: distance(1.3, level, x + h * e)) for e in np.eye(3)]
    np.testing.assert_allclose(
        np.array(dr.grad(points)), d[:, None] * np.stack(by_points, 1), atol=1e-5
    )


def test_creases_have_derivatives_by_points_alone() -> None:
    side = Float64(1.0)
    dr.enable_grad(side)
    # Nearest to a face, and to an edge.
    points = Array3f64([0.9, 0.9], [0.1, 0.8], [0.2, 0.1])
    dr.enable_grad(points)
    distance = hk.signed_distance(hk.Cuboid((side, 1.0, 1.0)), points)
    dr.backward(dr.gather(Float64, distance, 0), flags=dr.ADFlag.Default)
    np.testing.assert_allclose(dr.grad(side), [-0.5])
    distance = hk.signed_distance(hk.Cuboid((side, 1.0, 1.0)), points)
    with pytest.raises(NotImplementedError, match="crease"):
        dr.backward(distance)
    dr.set_grad(points, 0.0)
    dr.backward(hk.signed_distance(hk.Cuboid((1.0, 1.0, 1.0)), points))
    np.testing.assert_allclose(np.array(dr.grad(points)).T, [[1, 0, 0], [0.8, 0.6, 0]], atol=1e-12)


def test_on_the_surface_the_derivative_is_the_normal() -> None:
    points = Array3f(0.6, 0.0, 0.8)
    dr.enable_grad(points)
    dr.backward(hk.signed_distance(hk.Sphere(1.0), points))
    np.testing.assert_allclose(np.ravel(dr.grad(points)), [0.6, 0, 0.8], atol=1e-6)


def test_what_would_be_lost_is_refused() -> None:
    radius, points = Float64(0.5), TensorXf64(np.array([[1.0, 0.0, 0.0]]))
    dr.enable_grad(radius, points)
    for call in (
        lambda: hk.signed_distance(hk.Sphere(radius), [[1.0, 0.0, 0.0]]),
        lambda: hk.signed_distance(hk.Sphere(0.5), points, method="first_order"),
        lambda: hk.distance.closest_points(hk.Sphere(0.5), points),
        lambda: hk.curvature(hk.Sphere(0.5), points),
    ):
        with pytest.raises(NotImplementedError, match="cannot be differentiated"):
            call()
