"""Derivatives of blobs, series and networks by all arrays of numbers that they are made of, against
central differences in double precision, in forward and in reverse mode."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend
from harnack.backend.validation import has_derivatives
from harnack.fields.networks.activations import ACTIVATIONS
from harnack.fields.parameters import kept_arguments
from tests.backend.test_kernels import compiled
from tests.fields.test_dropped_derivatives import public_classes
from tests.fields.test_number_derivatives import outputs, rays

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

RNG = np.random.default_rng(3)
FEW = {
    "centers": np.array([[0.3, 0.1, 0], [-0.3, 0, 0.2], [0, -0.3, -0.2], [0.1, 0.3, 0.4]]),
    "radii": np.array([0.4, 0.5, 0.35, 0.3]),
    "weights": np.array([1.0, 0.9, 1.2, -0.4]),
}
MANY = {
    "centers": np.random.default_rng(1).uniform(-0.6, 0.6, (80, 3)),
    "radii": np.random.default_rng(2).uniform(0.1, 0.3, 80),
    "weights": np.random.default_rng(4).uniform(0.5, 1, 80),
}
WIDTHS, LEVEL = (3, 8, 8, 8, 8, 8, 1), -0.75
LAYERS = [
    tuple(2 * rng.normal(size=s) / k**0.5 for s in ((m, k), (m,)))
    for rng in [np.random.default_rng(0)]
    for k, m in itertools.pairwise(WIDTHS)
]
GROUPS = [2, 0, 2, 1]


def cases() -> Iterator[Any]:
    yield "blobs", FEW, lambda **n: hk.Blobs(kernel="gaussian", **n)
    yield "blobs in groups", FEW, lambda **n: hk.Blobs(kernel="cubic", groups=GROUPS, **n)
    yield "many blobs", MANY, hk.Blobs
    yield "many blobs in groups", MANY, lambda **n: hk.Blobs(groups=np.arange(80) % 3, **n)
    yield "blobs of one radius", {**FEW, "radii": 0.5}, lambda **n: hk.Blobs(kernel="sextic", **n)
    yield (
        "a sum of blobs",
        {k: FEW[k] for k in ("centers", "radii")},
        lambda **n: hk.Blobs(**n) * 0.8 + hk.Blobs([[0, 0, 0.6]], 0.5),
    )
    yield "a gyroid", {"cell": 1.3}, lambda cell: hk.Gyroid(cell, domain=hk.Ball())
    numbers = {"a": 1.2, "k": 3.0, "phase": 0.3, "vector": np.array([1.0, 0, 2.0]), "b": 0.7}
    yield "waves", numbers, waves
    harmonic = hk.SphericalHarmonic
    yield "a harmonic", {"radius": 1.2}, lambda radius: harmonic(3, 1, radius=radius) - 0.1
    yield "a harmonic polynomial", {"a": 1.3, "b": 0.4, "c": 0.2, "d": 0.3}, polynomial
    lobes = hk.fields.Lobes
    yield "lobes", {"scale": 1.4}, lambda scale: lobes(3, 2, scale=scale, sign="positive")
    coefficients = np.random.default_rng(5).normal(size=(3, 4, 5))
    box = hk.Box((-1, -1, -1), (1, 1, 1))
    series = hk.fields.FourierSeries
    yield "a series", {"coefficients": coefficients}, lambda coefficients: series(coefficients, box)
    yield "a root", {"height": 1.2}, lambda height: hk.fields.RiemannSurface("sqrt", height=height)
    names = ["tanh", "softplus", ("sine", 2.0), ("elu", 0.8), "relu"]
    yield (
        f"a network of {names}",
        {"layers": LAYERS},
        lambda layers: hk.Network(layers, activation=names, level=LEVEL),
    )


def polynomial(a: Any, b: Any, c: Any, d: Any) -> hk.Field:
    squares = {(2, 0, 0): b, (0, 2, 0): -b - c, (0, 0, 2): c}
    return hk.HarmonicPolynomial({(2, 1, 0): a, (0, 1, 2): -a, **squares, (0, 0, 0): d})


def waves(a: Any, k: Any, phase: Any, vector: Any, b: Any) -> hk.Field:
    sine = hk.fields.sine_factor
    terms = [
        hk.fields.WaveProduct(a, x=sine(k, phase), y=hk.fields.cosine_factor(3.0)),
        hk.fields.PlaneWave(b, vector, phase),
        hk.fields.WaveProduct(1.0, z=sine(k)),
    ]
    return hk.fields.EigenfunctionSum(terms, domain=hk.Ball())


QUICK = "many blobs", "blobs in groups", "a harmonic polynomial"
CASES = [
    pytest.param(*rest, id=name, marks=() if name in QUICK else pytest.mark.slow)
    for name, *rest in cases()
]


@pytest.mark.parametrize(("numbers", "make"), CASES)
def test_derivatives_agree_with_differences(numbers: dict[str, Any], make: Any) -> None:
    check(numbers, make)


def tree_map(function: Callable[..., Any], *trees: Any) -> Any:
    """The function of all numbers and arrays in mappings, lists and tuples."""
    first = trees[0]
    if isinstance(first, dict):
        return {k: tree_map(function, *(tree[k] for tree in trees)) for k in first}
    if isinstance(first, list | tuple):
        return type(first)(tree_map(function, *entries) for entries in zip(*trees, strict=True))
    return function(*trees)


def leaves(tree: Any) -> list[Any]:
    entries: list[Any] = []
    tree_map(entries.append, tree)
    return entries


def with_derivatives(numbers: Any) -> Any:
    """The numbers as Dr.Jit numbers and tensors with derivatives enabled."""

    def attached(value: Any) -> Any:
        array = np.array(value, float)
        number = Float64(array) if array.shape == () else TensorXf64(array)
        dr.enable_grad(number)
        return number

    return tree_map(attached, numbers)


def check(numbers: Any, make: Callable[..., Any]) -> None:
    """In one direction of all numbers at once, which shows if one is left out."""
    origins, directions = rays()
    points = RNG.uniform(-0.8, 0.8, (200, 3))
    change = tree_map(
        lambda v: RNG.choice([-1, 1], np.shape(v)) * RNG.uniform(0.5, 1, np.shape(v)), numbers
    )

    def shifted(h: float) -> dict[str, Any]:
        moved = tree_map(lambda v, c: np.array(v, float) + h * c, numbers, change)
        plain = tree_map(lambda v: v.item() if v.shape == () else v, moved)
        results = outputs(make(**plain), points, origins, directions)
        return {name: np.array(array) for name, array in results.items()}

    h = 1e-5
    above, below = shifted(h), shifted(-h)
    attached = with_derivatives(numbers)
    results = outputs(make(**attached), points, origins, directions)
    tree_map(lambda a, c: dr.set_grad(a, type(a)(np.array(c))), attached, change)
    # The edges stay for reverse mode.
    flags = dr.ADFlag.ClearVertices | dr.ADFlag.AllowNoGrad
    dr.forward_to(*results.values(), flags=flags)
    total, expected = Float64(0), 0.0
    for name, array in results.items():
        derivative, value = np.array(dr.grad(array)), np.array(dr.detach(array))
        difference = (above[name] - below[name]) / (2 * h)
        bend = above[name] + below[name] - 2 * value
        # Rays that graze, and points near creases, have no derivative.
        is_smooth = np.abs(bend) < 1e-3 * h * (1 + np.abs(difference))
        assert is_smooth.mean() > 0.8, name
        error = np.abs(derivative - difference)[is_smooth]
        scale = max(np.abs(difference[is_smooth]).max(), 1e-3)
        assert np.quantile(error, 0.98) < 1e-5 * scale, name
        weights = np.where(is_smooth, RNG.uniform(0.5, 1, is_smooth.shape), 0)
        total += dr.sum(dr.select(Float64(weights) != 0, array, 0) * Float64(weights))
        expected += np.where(is_smooth, derivative, 0) @ weights
        dr.clear_grad(array)
    # Reverse mode gives the same derivative in this direction.
    for number in leaves(attached):
        dr.clear_grad(number)
    dr.backward(total)
    pairs = zip(leaves(attached), leaves(change), strict=True)
    reverse = sum((np.ravel(dr.grad(a)) * np.ravel(c)).sum() for a, c in pairs)
    np.testing.assert_allclose(reverse, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("numbers", "make"),
    [case for case in CASES if case.id in QUICK[1:] or case.id.startswith(("waves", "a netw"))],
)
def test_other_numbers_compile_nothing(numbers: Any, make: Any) -> None:
    def step(k: int) -> None:
        attached = with_derivatives(tree_map(lambda v: v * (1 + 0.001 * k), numbers))
        x = Float64([0.0, 0.1, 0.2])
        hits = hk.trace(make(**attached), Array3f64(x, 0.1, 3), Array3f64(0, 0, -1))
        dr.backward(dr.sum(dr.select(hits.is_hit, hits.t + hits.normal.x, 0)))

    step(0), step(1)
    assert compiled(lambda: (step(2), step(3))) == 0


def test_gradients_at_centers_are_finite() -> None:
    for kernel in ("compact", "gaussian", "cubic", "sextic"):
        centers = Array3f64([0.1], 0.2, 0.3)
        dr.enable_grad(centers)
        field = hk.Blobs(centers, 0.5, kernel=kernel)
        dr.backward(
            field.value(Array3f64(0.1, 0.2, 0.3)) + field.gradient(Array3f64(0.1, 0.2, 0.3)).x
        )
        assert np.isfinite(dr.grad(centers)).all()


def test_blobs_by_lists_of_numbers() -> None:
    radius = Float64(0.5)
    dr.enable_grad(radius)
    field = hk.Blobs([[0.0, 0, 0], [5, 0, 0]], [radius, 0.3], kernel="compact")
    dr.backward(field.gradient(Array3f64(0.4, 0.0, 0.0)).x)
    whole = Float64([0.5, 0.3])
    dr.enable_grad(whole)
    field = hk.Blobs([[0.0, 0, 0], [5, 0, 0]], whole, kernel="compact")
    dr.backward(field.gradient(Array3f64(0.4, 0.0, 0.0)).x)
    np.testing.assert_allclose(whole.grad, [*radius.grad, 0], rtol=1e-12)


def test_all_classes_are_tested() -> None:
    """By all numbers that a class names. (`test_dropped_derivatives` finds those that are taken
    and not named.)"""
    tested: defaultdict[Any, set[str]] = defaultdict(set)
    for case in CASES:
        numbers, make = case.values
        field = make(**with_derivatives(numbers))
        for part in field.terms if isinstance(field, hk.fields.FieldSum) else (field,):
            kept = kept_arguments(part)
            method = getattr(type(part), "with_attached_numbers", None)
            tested[method] |= {name for name, value in kept.items() if has_derivatives(value)}
    families = ("harnack.fields.blobs", "harnack.fields.analytic", "harnack.fields.networks")
    classes = [kind for kind in public_classes(hk.Field) if kind.__module__.startswith(families)]
    assert len(classes) > 12
    for kind in classes:
        names, method = kind.traits.differentiable_arguments, "with_attached_numbers"
        assert set(names) <= tested[getattr(kind, method, None)], kind
    text = str([case.id for case in CASES])
    assert all(name in text for name in ACTIVATIONS)


def test_clearance_of_a_domain_that_moves_is_refused() -> None:
    size = Float64(1.2)
    dr.enable_grad(size)
    ray = Array3f64(1.3, 0, 3), Array3f64(0, 0, -1)
    moving = hk.Gyroid(size), hk.SphericalHarmonic(3, 1, radius=size) - 0.1
    for field in moving:
        with pytest.raises(NotImplementedError, match="domain of this"):
            hk.trace(field, *ray, clearance=True)
    hk.trace(hk.Gyroid(size, domain=hk.Ball()), *ray, clearance=True)
