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
    "Plane": {"normal": (0.3, 1.0, -0.4), "distance": 0.1},
    "Sphere": {"radius": 0.7, "center": (0.1, -0.05, 0.2)},
    "Ellipsoid": {"radii": (0.9, 0.6, 0.75)},
    "Cylinder": {"radius": 0.5, "height": 1.3},
    "DoubleCone": {"angle": 35.0},
    "Capsule": {"start": (-0.4, 0.1, -0.3), "end": (0.5, 0.0, 0.4), "radius": 0.3},
    "RoundCone": {"start": (-0.4, 0.1, -0.3), "end": (0.5, 0.0, 0.4), "radii": (0.2, 0.4)},
    "Torus": {"major": 0.7, "minor": 0.25},
    "Cuboid": {"sides": (1.2, 1.0, 0.9), "radius": 0.1},
    "Superellipsoid": {"powers": (3.0, 2.5), "radii": (0.8, 0.7, 0.6)},
    "Noise": {"frequency": 1.3, "amplitude": 0.8},
    "Supertorus": {"powers": (3.0, 2.5), "major": 0.7, "minor": 0.25},
}
OTHERS: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {
    "a blend": ({"r": 0.6, "b": 0.3}, lambda r, b: BOX.blended(hk.Sphere(r, (0.5, 0.4, 0.3)), b)),
    "a blend with a power": (
        {"b": 0.3, "p": 2.5},
        lambda b, p: BOX.blended(hk.Sphere(0.6, (0.5, 0.4, 0.3)), b, power=p),
    ),
    "blends of five": (
        {"r": 0.4, "b": 0.2},
        lambda r, b: hk.smooth_union(
            [hk.Sphere(r, p) for p in np.random.default_rng(1).uniform(-0.5, 0.5, (5, 3)).tolist()],
            b,
        ),
    ),
    "turned about an axis": (
        {"degrees": 25.0, "axis": (1.0, 2.0, 0.5)},
        lambda degrees, axis: BOX.rotated(degrees, axis),
    ),
    "stretched": (
        {"factors": (0.8, 1.2, 0.9)},
        lambda factors: (BOX | hk.Torus(0.8, 0.1)).scaled(factors),
    ),
    "sheared": (
        {"matrix": ((1.0, 0.3, 0.1), (0.0, 0.8, -0.2), (0.1, 0.2, 1.1))},
        lambda matrix: hk.Sphere(0.7, (0.1, 0.0, 0.2)).transformed(matrix),
    ),
    "sheared and moved": (
        {"matrix": ((1.0, 0.3, 0.1, 0.2), (0.0, 0.8, -0.2, 0.1), (0.1, 0.2, 1.1, -0.1))},
        lambda matrix: hk.Sphere(0.7).transformed(matrix),
    ),
    "hollow": (
        {"r": 0.8, "t": 0.1},
        lambda r, t: hk.Sphere(r).shell(t) & hk.solids.Plane((0, 0, 1), 0.2),
    ),
    "a band": (
        {"a": 1.3, "low": -0.2, "high": 0.25},
        lambda a, low, high: (
            hk.solid(hk.expression("a*x^2 + y^2 + z^2 - 0.7", a=a), between=(low, high)) & BOX
        ),
    ),
    "with parts that are sampled": (
        {"r": 0.7, "low": -0.4, "high": 0.3},
        lambda r, low, high: hk.solid(hk.Gyroid(1.0), between=(low, high)) & hk.Sphere(r),
    ),
    "below a level": (
        {"a": 1.3, "level": 0.2},
        lambda a, level: hk.solid(hk.expression("a*x^2 + y^2 + z^2 - 0.7", a=a), below=level),
    ),
    "twisted": (
        {"r": 0.1, "rate": 30.0},
        lambda r, rate: hk.Cuboid((1, 0.8, 1.2), r).twisted(rate),
    ),
    "tapered": (
        {"r": 0.6, "start": (-0.5, 1.1), "end": (0.4, 0.6)},
        lambda r, start, end: hk.Cylinder(r, 1.2).tapered(start, end, "x"),
    ),
    "a pattern of rows": (
        {"r": 0.2, "period": 0.5},
        lambda r, period: hk.Sphere(r, (-0.5, -0.5, 0.0)).repeated(period, (3, 2, 1)),
    ),
    "a pattern of a sheared row": (
        {"period": ((0.5, 0.1, 0.0), (0.0, 0.4, 0.1), (0.1, 0.0, 0.3))},
        lambda period: hk.Sphere(0.2, (-0.5, -0.5, 0.0)).repeated(period, 2),
    ),
    "mirrored": (
        {"normal": (1.0, 0.2, 0.1), "offset": 0.1},
        lambda normal, offset: hk.Sphere(0.5, (0.5, 0.1, 0.0)).mirrored(normal, offset),
    ),
    "around": (
        {"r": 0.2, "axis": (0.1, 0.2, 1.0)},
        lambda r, axis: hk.Sphere(r, (0.6, 0.1, 0.1)).around(5, axis),
    ),
    "arranged": (
        {"r": 0.3, "places": ((0.5, 0.0, 0.1), (-0.4, 0.3, 0.0), (0.0, -0.6, 0.1))},
        lambda r, places: hk.Cuboid((r, 0.4, 0.3)).arranged(places),
    ),
    "struts": (
        {
            "nodes": ((0.5, 0.0, 0.1), (-0.4, 0.3, 0.0), (0.0, -0.6, 0.1), (0.0, 0.0, 0.6)),
            "r": (0.1, 0.15, 0.2, 0.1),
        },
        lambda nodes, r: hk.solids.struts(nodes, [(0, 1), (1, 2), (2, 3), (0, 3)], r),
    ),
    "struts of a lattice": (
        {"r": 0.1},
        lambda r: hk.lattice.octet(1.0, 2).struts(r).translated((0.1, 0.0, 0.0)),
    ),
    "fractal noise": (
        {"beta": 1.2, "k": 1.3, "a": 0.8},
        lambda beta, k, a: hk.solids.FractalNoise(2, beta, k, a),
    ),
    "a displaced solid": (
        {"r": 0.6, "a": 0.2, "k": 1.5},
        lambda r, a, k: hk.solids.DisplacedSolid(hk.Sphere(r), hk.solids.Noise(k, a)),
    ),
    "an extrusion": (
        {"height": 0.8, "twist": 40.0, "taper": 0.7},
        lambda height, twist, taper: hk.Extrusion(
            [(-0.5, -0.4), (0.6, -0.3), (0.1, 0.6)], height, twist, taper
        ),
    ),
    "a straight extrusion": (
        {"height": 0.8},
        lambda height: hk.Extrusion([(-0.5, -0.4), (0.6, -0.3), (0.1, 0.6)], height),
    ),
    "a tube": (
        {
            "points": ((0.5, 0.0, 0.1), (-0.4, 0.3, 0.0), (0.0, -0.6, 0.1), (0.0, 0.0, 0.6)),
            "r": 0.2,
        },
        lambda points, r: hk.Tube(points, r),
    ),
    "many of several kinds": (
        {"r": 0.15, "sides": (0.2, 0.3, 0.25), "degrees": 10.0},
        lambda r, sides, degrees: hk.union(
            [
                part.translated(p)
                for p in np.random.default_rng(1).uniform(-0.5, 0.5, (8, 3)).tolist()
                for part in (
                    hk.Sphere(r, (0.1, 0.0, 0.0)) - hk.Cuboid(sides),
                    hk.Cuboid(sides).rotated(degrees, (1.0, 0.3, 0.2)),
                )
            ]
        ),
    ),
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


# Classes that are tested by `OTHERS`, or have a test of their own.
COVERED = (
    "BandSolid", "BlendedSolid", "BooleanSolid", "Complement", "DeformedSolid", "DisplacedSolid",
    "Extrusion", "FractalNoise", "Julia", "OffsetSolid", "Struts", "SublevelSolid",
    "TransformedSolid", "Tube",
)  # fmt: skip
# Cases whose hits are tested, too: these follow from values and gradients, and take longest.
TRACED = ("Sphere", "Capsule", "Cuboid", "moved and cut", "a sum and a product", "thirty spheres",
          "struts", "an extrusion")  # fmt: skip


class Learned(float):
    """A number as PyTorch has them."""

    requires_grad = True


def solids() -> Iterator[Any]:
    for name, kind in vars(hk.solids).items():
        if inspect.isclass(kind) and issubclass(kind, hk.fields.Field):
            names = kind.traits.differentiable_arguments
            if names and name not in COVERED:
                yield pytest.param(NUMBERS[name], kind, name in TRACED, id=name)
    for name, (numbers, make) in OTHERS.items():
        yield pytest.param(numbers, make, name in TRACED, id=name)


def rays(count: int = 200) -> tuple[Any, Any]:
    origins = RNG.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1)[:, None]
    targets = RNG.uniform(-0.5, 0.5, (count, 3))
    return origins, (targets - origins) / np.linalg.norm(targets - origins, axis=1)[:, None]


def outputs(
    solid: Any, points: Any, origins: Any, directions: Any, *, is_traced: bool = True
) -> dict[str, Any]:
    """All results as Dr.Jit arrays of one dimension."""
    p, o, d = (Array3f64(*entry.T) for entry in (points, origins, directions))
    gradient = solid.gradient(p)
    results = {"value": solid.value(p)} | {f"gradient {k}": gradient[k] for k in range(3)}
    if not is_traced:
        return results
    hits = hk.trace(solid, o, d, tolerance=1e-9)
    is_hit = hits.is_hit
    results["t"] = dr.select(is_hit, hits.t, 0)
    results |= {f"normal {k}": hits.normal[k] for k in range(3)}
    return results | {f"position {k}": dr.select(is_hit, hits.position[k], 0) for k in range(3)}


def by_formula(solid: Any, points: Any) -> dict[str, Any] | None:
    """Values and gradients by the formula with NumPy numbers, for which nothing is compiled; None
    for a solid that has none."""
    steps = 3e-5 * np.array([[0] * 3, *np.eye(3), *-np.eye(3)])
    try:
        values = [solid.formula(*(points + step).T) for step in steps]
    except (AttributeError, TypeError):
        return None
    slopes = {f"gradient {k}": (values[1 + k] - values[4 + k]) / 6e-5 for k in range(3)}
    return {"value": np.array(values[0])} | slopes


@pytest.mark.few(3)
@pytest.mark.parametrize(("numbers", "make", "is_traced"), list(solids()))
def test_derivatives_agree_with_differences(
    numbers: dict[str, Any], make: Any, is_traced: bool
) -> None:
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
        solid = make(**plain)
        if not is_traced and (known := by_formula(solid, points)) is not None:
            return known
        results = outputs(solid, points, origins, directions, is_traced=is_traced)
        return {name: np.array(array) for name, array in results.items()}

    h = 3e-5
    above, below, further, back = (shifted(s) for s in (h, -h, 2 * h, -2 * h))
    attached = {name: Float64(v) if np.shape(v) == () else TensorXf64(np.array(v))
                for name, v in numbers.items()}  # fmt: skip
    for number in attached.values():
        dr.enable_grad(number)
    results = outputs(make(**attached), points, origins, directions, is_traced=is_traced)
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
        scale = max(np.abs(difference[is_smooth]).max(), 0.05)
        assert np.quantile(error, 0.98) < 1e-5 * scale, name


def test_numbers_that_would_be_lost_are_refused() -> None:
    r = Float64(0.5)
    dr.enable_grad(r)
    for make in (
        lambda: hk.expression(lambda x, y, z: x - r),
        lambda: hk.expression("x - a", a=Learned(0.5)),
        lambda: hk.Sphere(Learned(0.5)),
        lambda: hk.solids.struts(
            [[0, 0, 0], [1, 0, 0], [0, r, 0]], [[0, 1], [1, 2]], 0.1, smooth=r
        ),
        lambda: hk.lattice.cubic(r, 2),
    ):
        with pytest.raises(NotImplementedError, match="carry"):
            make()


def test_parts_without_numbers_and_second_derivatives_are_sampled() -> None:
    radius = Float64(0.5)
    dr.enable_grad(radius)
    solid = hk.Sphere(radius) | hk.Tube([(0, 0, 2), (1, 0, 2)], 0.1)
    points = Array3f64(0.5, 0.0, [0.5, 1.7])
    dr.backward(solid.value(points))
    np.testing.assert_allclose(dr.grad(radius), [-1.0])
    with pytest.raises(NotImplementedError, match="gradient of BooleanSolid"):
        solid.gradient(points)


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


def test_julia_sets_move_with_their_constant() -> None:
    """Of values and hits: gradients have no derivatives."""
    c = (-0.2, 0.6, 0.1, 0.0)
    change = np.array([0.5, -0.7, 0.3, 0.8])
    points = RNG.uniform(-1.5, 1.5, (50, 3))
    above, below = (
        hk.solids.Julia(tuple(np.array(c) + h * change), 4, 0.1 + h).value(points)
        for h in (1e-6, -1e-6)
    )
    numbers, slice_ = TensorXf64(np.array(c)), Float64(0.1)
    dr.enable_grad(numbers, slice_)
    value = hk.solids.Julia(numbers, 4, slice_).value(Array3f64(*points.T))
    dr.set_grad(numbers, TensorXf64(change))
    dr.set_grad(slice_, 1.0)
    dr.forward_to(value)
    difference = (above - below) / 2e-6
    np.testing.assert_allclose(dr.grad(value), difference, atol=1e-6 * np.abs(difference).max())
    with pytest.raises(NotImplementedError, match="gradient of Julia"):
        hk.solids.Julia(numbers, 4, slice_).gradient(Array3f64(*points.T))


def test_many_parts_compile_few_kernels() -> None:
    """As many for thirty as for ten, and none for other numbers and places."""

    def step(count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        radii = [Float64(r) for r in rng.uniform(0.1, 0.3, count)]
        dr.enable_grad(radii)
        places = rng.normal(size=(count, 3)).tolist()
        spheres = [hk.Sphere(*part) for part in zip(radii, places, strict=True)]
        value = hk.union(spheres).value(Array3f64([0.0, 0.1, 0.3], 0.1, 0.2))
        dr.backward(dr.sum(value))
        dr.eval([dr.grad(r) for r in radii])

    step(10, 0)
    few = compiled(lambda: step(11, 1))
    assert compiled(lambda: step(30, 2)) <= max(few, 4)
    assert compiled(lambda: step(30, 3)) == 0
