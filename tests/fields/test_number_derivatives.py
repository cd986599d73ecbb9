"""Derivatives of formulas and solids by their numbers, against central differences in double
precision. Classes and arguments are found by their traits."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend
from tests.backend.test_kernels import compiled

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

RNG = np.random.default_rng(0)
BOX = hk.Cuboid((1.1, 0.9, 1.0))
# For each class the numbers of a solid that rays from all sides hit.
NUMBERS: dict[str, dict[str, Any]] = {
    "Plane": {"distance": 0.1},
    "Sphere": {"radius": 0.7, "center": (0.1, -0.05, 0.2)},
    "Ellipsoid": {"radii": (0.9, 0.6, 0.75)},
    "Cylinder": {"radius": 0.5, "height": 1.3},
    "DoubleCone": {"angle": 35.0},
    "Capsule": {"start": (-0.4, 0.1, -0.3), "end": (0.5, 0.0, 0.4), "radius": 0.3},
    "RoundCone": {"start": (-0.4, 0.1, -0.3), "end": (0.5, 0.0, 0.4), "radii": (0.2, 0.4)},
    "Torus": {"major": 0.7, "minor": 0.25},
    "Cuboid": {"sides": (1.2, 1.0, 0.9), "radius": 0.1},
    "Superellipsoid": {"radii": (0.8, 0.7, 0.6)},
    "Supertorus": {"major": 0.7, "minor": 0.25},
}
OTHERS: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {
    "a blend": ({"r": 0.6, "b": 0.3}, lambda r, b: BOX.blended(hk.Sphere(r, (0.5, 0.4, 0.3)), b)),
    "moved and cut": (
        {"offset": (0.2, 0.1, -0.1), "r": 0.8},
        lambda offset, r: hk.Sphere(r) - BOX.rotated(20).translated(offset),
    ),
    "moved twice, grown": (
        {"offset": (0.1, 0.2, 0.0), "d": 0.1},
        lambda offset, d: (
            BOX.translated(offset).translated((0.1, 0.0, 0.0)) | hk.Torus(0.8, 0.1)
        ).offset(d),
    ),
    "turned and scaled": (
        {"degrees": 25.0, "factor": 1.2, "offset": (0.1, 0.0, 0.1)},
        lambda degrees, factor, offset: (
            BOX.rotated(degrees, (1.0, 2.0, 0.5)).scaled(factor).translated(offset)
            & hk.Sphere(0.9).translated((0.1, 0.0, 0.0)).scaled(factor)
        ),
    ),
    "a sum and a product": (
        {"a": 1.3, "r": 0.7, "w": 0.4},
        lambda a, r, w: (
            hk.expression("a*x^2 + y^2 + z^2 - 0.7", a=a) * hk.expression("b + 0.1*x", b=r)
            + hk.SphericalHarmonic(2, 1) * w
            + hk.expression("c*z", c=a) / 5
        ),
    ),
    "a formula": (
        {"a": 1.3, "b": 0.4},
        lambda a, b: hk.expression(
            lambda x, y, z, a, b: x**2 * a + y**2 + z**2 + hk.math.sin(3 * x) * b - 0.7, a=a, b=b
        ),
    ),
    "a text": ({"a": 1.3}, lambda a: hk.expression("a*x^2 + y^2 + a*z^4 = 0.6", a=a)),
    "thirty spheres": (
        {"r": 0.3},
        lambda r: hk.union(
            [hk.Sphere(r, p) for p in np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3))]
        ),
    ),
}


class Learned(float):
    """A number as PyTorch has them."""

    requires_grad = True


def solids() -> Iterator[Any]:
    for name, kind in vars(hk.solids).items():
        if inspect.isclass(kind) and issubclass(kind, hk.fields.Field):
            names = kind.traits.differentiable_arguments
            if names and name not in ("BooleanSolid", "Complement", "OffsetSolid"):
                yield pytest.param(NUMBERS[name], kind, id=name)
    for name, (numbers, make) in OTHERS.items():
        yield pytest.param(numbers, make, id=name)


def rays(count: int = 200) -> tuple[Any, Any]:
    origins = RNG.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1)[:, None]
    targets = RNG.uniform(-0.5, 0.5, (count, 3))
    return origins, (targets - origins) / np.linalg.norm(targets - origins, axis=1)[:, None]


def outputs(solid: Any, points: Any, origins: Any, directions: Any) -> dict[str, Any]:
    """All results as Dr.Jit arrays of one dimension."""
    p, o, d = (Array3f64(*entry.T) for entry in (points, origins, directions))
    hits = hk.trace(solid, o, d, tolerance=1e-9)
    is_hit = hits.is_hit
    results = {"value": solid.value(p), "t": dr.select(is_hit, hits.t, 0)}
    for name, vector in (("gradient", solid.gradient(p)), ("normal", hits.normal)):
        results |= {f"{name} {k}": vector[k] for k in range(3)}
    return results | {f"position {k}": dr.select(is_hit, hits.position[k], 0) for k in range(3)}


@pytest.mark.few(3)
@pytest.mark.parametrize(("numbers", "make"), list(solids()))
def test_derivatives_agree_with_differences(numbers: dict[str, Any], make: Any) -> None:
    """In one direction of all numbers at once, which shows if one is left out."""
    origins, directions = rays()
    points = RNG.uniform(-1, 1, (200, 3))
    change = {name: RNG.choice([-1, 1], np.shape(v)) * RNG.uniform(0.5, 1, np.shape(v))
              for name, v in numbers.items()}  # fmt: skip

    def shifted(h: float) -> dict[str, Any]:
        moved = {name: np.array(v, float) + h * change[name] for name, v in numbers.items()}
        plain = {
            name: v.item() if v.shape == () else tuple(v.tolist()) for name, v in moved.items()
        }
        results = outputs(make(**plain), points, origins, directions)
        return {name: np.array(array) for name, array in results.items()}

    h = 1e-5
    above, below, further, back = (shifted(s) for s in (h, -h, 2 * h, -2 * h))
    attached = {name: Float64(v) if np.shape(v) == () else TensorXf64(np.array(v))
                for name, v in numbers.items()}  # fmt: skip
    for number in attached.values():
        dr.enable_grad(number)
    results = outputs(make(**attached), points, origins, directions)
    for name, number in attached.items():
        dr.set_grad(number, type(number)(np.array(change[name])))
    dr.forward_to(*results.values(), flags=dr.ADFlag.AllowNoGrad)
    for name, array in results.items():
        derivative = np.array(dr.grad(array))
        difference = (above[name] - below[name]) / (2 * h)
        wide = (further[name] - back[name]) / (4 * h)
        # Rays that graze, and points near creases, have no derivative.
        is_smooth = np.abs(difference - wide) < 1e-5 * (1 + np.abs(difference))
        assert is_smooth.mean() > 0.8, name
        error = np.abs(derivative - difference)[is_smooth]
        scale = max(np.abs(difference[is_smooth]).max(), 1e-3)
        assert np.quantile(error, 0.98) < 1e-5 * scale, name


def test_numbers_that_would_be_lost_are_refused() -> None:
    r = Float64(0.5)
    dr.enable_grad(r)
    for make in (
        lambda: hk.solids.Plane((r, 0, 0), 0.1),
        lambda: hk.solids.Superellipsoid((r, 2.0), (1, 1, 1)),
        lambda: hk.Sphere(0.3).rotated(10, (0, 1, r)),
        lambda: hk.Sphere(0.3).scaled((r, 1, 1)),
        lambda: hk.Sphere(0.3).transformed([[r, 0, 0], [0, 1, 0], [0, 0, 1]]),
        lambda: hk.Sphere(r).twisted(10),
        lambda: hk.Sphere(r).shell(0.1),
        lambda: hk.solids.struts([[0, 0, 0], [1, 0, 0]], [[0, 1]], r),
        lambda: hk.expression(lambda x, y, z: x - r),
        lambda: hk.expression("x - a", a=Learned(0.5)),
        lambda: hk.Sphere(Learned(0.5)),
        lambda: hk.Sphere(0.3).blended(BOX, 0.1, power=r),
        lambda: hk.smooth_union([hk.Sphere(r), hk.Sphere(1.0)], 0.1),
    ):
        with pytest.raises(NotImplementedError, match="carry"):
            make()


def test_tensors_and_lists_are_attached() -> None:
    for center in (TensorXf64(np.array([0.1, 0.2, 0.3])), Array3f64(0.1, 0.2, 0.3)):
        dr.enable_grad(center)
        value = hk.Sphere(0.5, center).value(Array3f64(1.0, 0.2, 0.3))
        dr.backward(value)
        np.testing.assert_allclose(np.ravel(dr.grad(center)), [-1, 0, 0], atol=1e-12)
    x = Float64(0.1)
    dr.enable_grad(x)
    for center in ((x, 0.2, 0.3), [x, 0.2, 0.3]):
        dr.set_grad(x, 0.0)
        dr.backward(hk.Sphere(0.5, center).value(Array3f64(1.0, 0.2, 0.3)))
        np.testing.assert_allclose(dr.grad(x), [-1], atol=1e-12)


def test_normals_move_with_rays_and_levels() -> None:
    x, level = Float64(0.3), Float64(0.1)
    dr.enable_grad(x, level)
    hits = hk.trace(hk.Sphere(0.9), Array3f64(x, 0.0, 3.0), Array3f64(0, 0, -1), level=level)
    dr.backward(hits.normal.x)  # x / (0.9 + level)
    np.testing.assert_allclose(dr.grad(x), [1.0], atol=1e-9)
    np.testing.assert_allclose(dr.grad(level), [-0.3], atol=1e-9)


def test_normals_move_with_weights() -> None:
    weight = Float64(2.0)
    dr.enable_grad(weight)
    # The normal is (2 w x, 0, -1), normalized.
    surface = hk.expression("x^2 + y^2") * weight - hk.expression("z")
    hits = hk.trace(surface, Array3f64(0.3, 0.0, 3.0), Array3f64(0, 0, -1), level=0.1)
    dr.backward(hits.normal.x)
    np.testing.assert_allclose(dr.grad(weight), [0.6 / (1 + 1.2**2) ** 1.5], atol=1e-9)


def test_other_numbers_compile_nothing() -> None:
    def step(k: int) -> None:
        radius, offset = Float64(0.5 + 0.01 * k), Array3f64(0.1 * k, 0.2, 0.0)
        dr.enable_grad(radius, offset)
        solid = hk.Sphere(radius) | hk.Cuboid((0.5, 0.5, 0.5)).translated(offset)
        hits = hk.trace(solid, Array3f64([0.0, 0.1], 0.1, 3.0), Array3f64(0, 0, -1))
        dr.backward(dr.sum(hits.t + hits.normal.x))

    step(0), step(1)
    assert compiled(lambda: (step(2), step(3))) == 0


def test_a_class_with_another_function_has_no_derivatives_by_its_bases_formula() -> None:
    class Bumpy(hk.Sphere):
        def evaluate(self, p: Any) -> Any:
            sample = hk.Sphere.evaluate(self, p)
            return dataclasses.replace(sample, value=2 * sample.value, gradient=2 * sample.gradient)

    radius = Float64(0.5)
    dr.enable_grad(radius)
    with pytest.raises(NotImplementedError, match="Bumpy cannot be differentiated"):
        Bumpy(radius).value(Array3f64(1.0, 0.0, 0.0))
