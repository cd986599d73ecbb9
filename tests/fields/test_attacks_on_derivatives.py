"""Derivatives of fields at their limits: numbers that have none, arrays without entries, copies,
second derivatives, and domains that move."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64, Int, TensorXf64

import harnack as hk
from harnack.backend import choose_backend

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

BALL = hk.Sphere(0.5)
POINT = np.array([0.3, -0.2, 0.4])


def number(value: float) -> Float64:
    """A Dr.Jit number with a derivative."""
    result = Float64(value)
    dr.enable_grad(result)
    return result


@pytest.mark.parametrize(
    ("make", "plain"),
    [
        (lambda x: BALL.translated((x, 0.1, 0.3)), 0.4),
        (lambda x: BALL.translated(Array3f64(x, 0.1, 0.3)), 0.4),
        (lambda x: BALL.scaled(x), 1.2),
        (lambda x: BALL.scaled((x, 1, 1)), 1.2),
        (lambda x: BALL.transformed([[x, 0, 0], [0, 1, 0], [0, 0, 1]]), 1.2),
        (lambda x: hk.Cuboid().twisted(x), 20.0),
        (lambda x: hk.Cuboid().tapered((-x, 1.0), (0.5, 0.9)), 0.5),
        (lambda x: BALL.repeated(x, (2, 1, 1)), 0.5),
        (lambda x: BALL.mirrored((x, 0.0, 0.0), x), 0.2),
        (lambda x: BALL.arranged([(x, 0, 0), (0, 0, 1)]), 0.2),
    ],
)
def test_numbers_of_dr_jit_without_derivatives(make: Callable[..., Any], plain: float) -> None:
    field = make(Float64(plain))
    assert field.value(POINT) == make(plain).value(POINT)
    assert field.parameters() is not None


def test_arrays_of_several_numbers_are_refused() -> None:
    two = Float64(0.1, 0.2)
    with pytest.raises(ValueError, match="all must be of one shape"):
        BALL.translated((two, 0, 0))
    with pytest.raises(ValueError, match="a level is one number"):
        hk.Surface(BALL, two)
    with pytest.raises(ValueError, match="positive integers"):
        BALL.repeated(0.5, (Int(2), 2, 1))


def test_no_points_and_no_rays() -> None:
    curve = hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(5))
    nothing = dr.zeros(Array3f64, 0)
    for field in (hk.Sphere(number(0.5)), curve):
        assert dr.width(field.value(nothing)) == dr.width(field.gradient(nothing)) == 0
        assert dr.width(hk.signed_distance(field, nothing)) == 0
    rays = dr.zeros(TensorXf64, (0, 3))
    assert hk.trace(BALL, rays, rays).is_hit.shape == (0,)


def test_copies_keep_derivatives_or_are_refused() -> None:
    r = number(0.5)
    for field in (hk.Sphere(r), BALL.translated((r, 0, 0)), hk.expression("x*a", a=r)):
        assert dr.grad_enabled(copy.copy(field).value(Array3f64(POINT)))
        for function in (copy.deepcopy, pickle.dumps):
            with pytest.raises(NotImplementedError, match="would lose derivatives"):
                function(field)


def test_formulas_are_pickled() -> None:
    formula = hk.expression("a*x + y^2", a=0.5)
    for other in (pickle.loads(pickle.dumps(formula)), copy.deepcopy(formula)):
        assert other.value(POINT) == formula.value(POINT)
        assert other.replace(**{"numbers.a": 1.0}).value(POINT) == pytest.approx(0.34)


def test_domains_that_move_are_known() -> None:
    """The clearance of rays ends where the domain does, and pictures as well."""
    rays = Array3f64(0.1, 0.2, 3.0), Array3f64(0, 0, -1)
    waves = [hk.fields.PlaneWave(1.0, (number(6.0), 0.0, 0.3)), hk.fields.PlaneWave(1.0, (0, 6, 0))]
    with pytest.raises(NotImplementedError, match="the domain of this EigenfunctionSum moves"):
        hk.trace(hk.fields.EigenfunctionSum(waves), *rays, clearance=True)
    still = [hk.fields.PlaneWave(number(1.0), (6, 0, 0.3)), hk.fields.PlaneWave(1.0, (0, 6, 0))]
    hk.trace(hk.fields.EigenfunctionSum(still), *rays, clearance=True)
    hk.trace(hk.fields.EigenfunctionSum(waves, domain=hk.Ball()), *rays, clearance=True)
