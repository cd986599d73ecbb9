"""Derivatives of formulas and solids by their numbers, against central differences in double
precision. Classes and arguments are found by their traits."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend

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


@pytest.mark.parametrize(("numbers", "make"), solids())
def test_derivatives_agree_with_differences(numbers: dict[str, Any], make: Any) -> None:
    origins, directions = rays()
    points = RNG.uniform(-1, 1, (200, 3))
    for name, number in numbers.items():
        count = np.size(number)
        for k in range(count):

            def shifted(h: float, k: int = k, name: str = name, count: int = count) -> Any:
                changed = np.array(numbers[name], float)
                changed.reshape(-1)[k] += h
                value = changed.item() if count == 1 else tuple(changed.tolist())
                solid = make(**{**numbers, name: value})
                return {
                    a: np.array(b) for a, b in outputs(solid, points, origins, directions).items()
                }

            h = 1e-5
            above, below, further, back = (shifted(s) for s in (h, -h, 2 * h, -2 * h))
            entry = Float64(np.ravel(number)[k])
            dr.enable_grad(entry)
            entries = [entry if j == k else Float64(np.ravel(number)[j]) for j in range(count)]
            value = entries[0] if count == 1 else Array3f64(*entries)
            solid = make(**{**numbers, name: value})
            for output, array in outputs(solid, points, origins, directions).items():
                dr.set_grad(entry, 1.0)
                dr.forward_to(array, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
                derivative = np.array(dr.grad(array))
                difference = (above[output] - below[output]) / (2 * h)
                wide = (further[output] - back[output]) / (4 * h)
                # Rays that graze, and points near creases, have no derivative.
                is_smooth = np.abs(difference - wide) < 1e-5 * (1 + np.abs(difference))
                assert is_smooth.mean() > 0.8, output
                error = np.abs(derivative - difference)[is_smooth]
                scale = max(np.abs(difference[is_smooth]).max(), 1e-3)
                assert np.quantile(error, 0.98) < 1e-5 * scale, (name, k, output)


def test_numbers_that_would_be_lost_are_refused() -> None:
    r = Float64(0.5)
    dr.enable_grad(r)
    for make in (
        lambda: hk.Capsule((0, 0, 0), (0, 0, 1), r),
        lambda: hk.Plane((r, 0, 0), 0.1),
        lambda: hk.Superellipsoid((r, 2.0), (1, 1, 1)),
        lambda: hk.Sphere(0.3).rotated(r),
        lambda: hk.Sphere(0.3).scaled(r),
        lambda: hk.Sphere(r).twisted(10),
        lambda: hk.Sphere(r).shell(0.1),
        lambda: hk.solids.struts([[0, 0, 0], [1, 0, 0]], [[0, 1]], r),
        lambda: hk.fields.FieldSum([hk.Sphere(r), hk.Sphere(1.0)], [1, 1]),
        lambda: hk.expression(lambda x, y, z: x - r),
        lambda: hk.smooth_union([hk.Sphere(r), hk.Sphere(1.0)], 0.1),
    ):
        with pytest.raises(NotImplementedError):
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
