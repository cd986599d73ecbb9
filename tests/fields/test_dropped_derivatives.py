"""Nothing that carries derivatives is taken and then not differentiated: what is made of numbers
with derivatives either has the right derivative, or is refused by name.

What there is to test is listed from the package itself: constructors, other ways to make fields,
methods of solids, functions, and the fields of the records that `trace` returns.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack import geometry
from harnack.backend import choose_backend
from harnack.enclosures import Enclosure, Promise
from harnack.geometry import example_curves
from harnack.geometry.volume import Volume

DOUBLE = choose_backend("double")
LOOP = example_curves.wavy_polygon(12)
POINTS = 0.3 * np.random.default_rng(0).normal(size=(4, 3))


class Learned(float):
    """A number as PyTorch has them: Python's and NumPy's functions take it and drop derivatives."""

    requires_grad = True


def learned(shape: str) -> Any:
    """Something that carries derivatives: a number of PyTorch, or one or vectors of Dr.Jit."""
    if shape == "torch":
        return Learned(0.5)
    array = DOUBLE.Float(0.5) if shape == "number" else DOUBLE.Array3f(POINTS.T)
    dr.enable_grad(array)
    return array


MARKS = ("torch", "number", "vectors")
REFUSED = r"cannot be differentiated by these numbers, which carry derivatives: detach them"


def public_classes(kind: type) -> list[type]:
    # `harnack` has a name only once it is asked for.
    names = [(hk, name) for name in hk.__all__] + [(geometry, name) for name in vars(geometry)]
    found = {one for place in names if inspect.isclass(one := getattr(*place))}
    chosen = (one for one in found if issubclass(one, kind) and not inspect.isabstract(one))
    return sorted(chosen, key=lambda one: one.__name__)


def arguments(function: Callable[..., Any]) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def makers() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Constructors of fields and volumes, class methods that make them, and methods of solids and
    of fields whose data may move."""
    for kind in (*public_classes(hk.Field), *public_classes(Volume)):
        if kind is hk.SolidAngle:
            continue  # it has derivatives by its vertices
        yield kind.__name__, kind
        for name, own in vars(kind).items():
            if isinstance(own, classmethod) and not name.startswith("_"):
                yield f"{kind.__name__}.{name}", getattr(kind, name)
    for field in (hk.DipolePotential(POINTS, POINTS), hk.WindingNumber(POINTS[:3], [[0, 1, 2]])):
        move = getattr(field, "with_points", None) or field.with_vertices
        yield f"{type(field).__name__}.{move.__name__}", move
    for name, own in vars(hk.solids.Solid).items():
        is_maker = inspect.isfunction(own) and own.__annotations__.get("return") == "Solid"
        if is_maker and not name.startswith("_") and name not in ("prepare", "map_operands"):
            yield f"Solid.{name}", getattr(hk.Sphere(1.0), name)


MAKERS = dict(makers())


@pytest.mark.parametrize("name", MAKERS)
def test_makers_refuse_each_argument_that_carries_derivatives(name: str) -> None:
    names = arguments(MAKERS[name])
    assert names or name in ("SexticKernel", "CubicKernel")
    for argument in names:
        for mark in MARKS:
            with pytest.raises(NotImplementedError, match=REFUSED):
                MAKERS[name](**{argument: learned(mark)})
        with pytest.raises(NotImplementedError, match=REFUSED):
            MAKERS[name](**{argument: [(1.0, {"deep": learned("number")})]})


def test_the_list_of_makers_has_what_is_known() -> None:
    known = {"Blobs", "Sphere", "Ball", "Tube.bezier", "FourierSeries.fit", "Morph"}
    assert known | {"Solid.translated", "Solid.twisted", "Solid.offset", "WindingNumber"} <= set(
        MAKERS
    )


# Functions of fields, rays and numbers: an argument for each name that they have.
SPHERE = hk.Sphere(0.8)
ORIGINS, DIRECTIONS = POINTS + np.array([0, 0, 3.0]), np.tile([0, 0, -1.0], (4, 1))
GIVEN: dict[str, Any] = {
    "field": SPHERE,
    "function": lambda x, y, z: x * x + y * y + z * z - 1,
    "points": POINTS,
    "origins": ORIGINS,
    "directions": DIRECTIONS,
    "solids": SPHERE,
}
# What results have derivatives by, or do not depend on: where rays begin and end moves no hit.
WITH_DERIVATIVES = {
    ("trace", "field"), ("level_set", "field"), ("trace", "origins"), ("trace", "directions"),
    ("trace", "level"), ("level_set", "level"), ("trace", "t_min"), ("trace", "t_max"),
}  # fmt: skip
# Functions of any numbers, of solids, and of scenes and files, whose results carry nothing.
OTHERS = {
    "atan2", "maximum", "minimum", "norm", "union", "intersection", "animate", "render", "page",
    "check_print", "mesh", "read_scene", "repair", "view", "wall_thickness",
    "wrap_for_jax", "wrap_for_torch", "write_scene",
}  # fmt: skip
FUNCTIONS = {
    name: getattr(hk, name)
    for name in hk.__all__
    if inspect.isfunction(getattr(hk, name)) and name not in OTHERS
}
# Settings that are no numbers of the result: names, counts, switches, and volumes.
SETTINGS = {
    "precision", "max_steps", "largest", "confirm", "all_hits", "bound", "method", "progress",
    "is_convex", "clip", "section", "backend",
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse_each_argument_that_carries_derivatives(name: str) -> None:
    function, refused = FUNCTIONS[name], 0
    parameters = inspect.signature(function).parameters
    for argument in parameters:
        if argument in SETTINGS:
            continue
        given = {
            one: GIVEN[one]
            for one, about in parameters.items()
            if about.default is about.empty and one in GIVEN
        }
        for mark in MARKS:
            is_field = argument == "field"
            if (name, argument) in WITH_DERIVATIVES and (is_field or mark != "torch"):
                continue
            value = moved_curve() if is_field else learned(mark)
            value = (value, 1.0) if argument == "solid" else value
            with pytest.raises(NotImplementedError, match=REFUSED):
                function(**{**given, argument: value})
            refused += 1
    assert refused


def moved_curve() -> hk.SolidAngle:
    vertices = DOUBLE.Array3f(LOOP.T)
    dr.enable_grad(vertices)
    return hk.SolidAngle(vertices)


# Records that fields are made of: what is made of one by an example, with an argument replaced.
PARTS: dict[str, tuple[dict[str, Any], Callable[[Any], Any]]] = {
    "PlaneWave": (
        {"amplitude": 1.0, "wave_vector": (1.0, 2.0, 3.0)},
        lambda one: hk.fields.EigenfunctionSum([one]),
    ),
    "WaveProduct": (
        {"amplitude": 1.0, "x": hk.fields.sine_factor(2.0)},
        lambda one: hk.fields.EigenfunctionSum([one]),
    ),
    "BranchPoint": (
        {"location": 0j},
        lambda one: hk.fields.RiemannSurface("sqrt", singular_points=[one]),
    ),
    "Circle": ({"radius": 1.0}, lambda one: hk.SolidAngle([one])),
    **{
        name: ({}, lambda one: hk.Blobs(POINTS, 0.5, kernel=one))
        for name in ("CompactKernel", "CubicKernel", "GaussianKernel", "SexticKernel")
    },
}
# Records of settings, results and pictures, and proofs.
NO_PARTS = {"RayCrossings", "Camera", "CurvatureSamples", "DistanceBounds", "Hits", "Isolines",
            "Surface", "PrintCheck", "PrintProblem", "Sample", "SceneFile", "Slider",
            "WallThickness", "HitTolerance", "LiveView"}  # fmt: skip


def test_the_list_of_records_is_whole() -> None:
    records = {
        name
        for name in hk.__all__
        if inspect.isclass(kind := getattr(hk, name)) and dataclasses.is_dataclass(kind)
        and not issubclass(kind, hk.Field | Volume | Enclosure | Promise)
    }  # fmt: skip
    assert records - NO_PARTS <= set(PARTS)


@pytest.mark.parametrize("name", PARTS)
def test_records_with_derivatives_are_refused_by_the_field_at_the_latest(name: str) -> None:
    (given, made), tried = PARTS[name], 0
    for argument, about in inspect.signature(getattr(hk, name)).parameters.items():
        example = given.get(argument, about.default)
        if isinstance(example, tuple):
            value: Any = (Learned(example[0]), *example[1:])
        elif isinstance(example, float | complex):
            value = Learned(abs(example) or 1.0)
        else:
            continue
        with pytest.raises(NotImplementedError, match="carry derivatives"):
            made(getattr(hk, name)(**{**given, argument: value}))
        tried += 1
    assert tried


# Derivatives of what a trace returns.


def objective(result: Any, weights: np.ndarray) -> Any:
    """A number made of all lanes of a result: floats, or vectors of them."""
    total = 0
    for one in result if dr.depth_v(result) == 2 else [result]:
        total = total + dr.sum(dr.select(dr.isfinite(one), one, 0) * DOUBLE.Float(weights))
    return total


WEIGHTS = np.array([1.0, -0.7, 0.4, 1.3])
SOURCES: dict[str, np.ndarray] = {
    "origins": ORIGINS,
    "directions": DIRECTIONS + np.array([0.02, 0.01, 0]),
    "level": np.array([5.0]),
    "vertices": LOOP,
}


def traced(all_hits: int | None, source: str, values: np.ndarray, *, enabled: bool) -> Any:
    arrays: dict[str, Any] = {}
    for name, default in SOURCES.items():
        numbers = values if name == source else default
        of = DOUBLE.Float(numbers) if name == "level" else DOUBLE.Array3f(numbers.T)
        if name == source and enabled:
            dr.enable_grad(of)
        arrays[name] = of
    field = hk.SolidAngle(arrays["vertices"])
    rays, level = (arrays["origins"], arrays["directions"]), arrays["level"]
    settings = {"level": level, "tolerance": 1e-11, "all_hits": all_hits}
    return arrays[source], hk.trace(field, *rays, **settings)


@pytest.mark.few(1)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("all_hits", [None, 1])
def test_each_result_of_a_trace_has_its_derivative_or_refuses_it(
    source: str, all_hits: int | None
) -> None:
    """By the sum of all entries of a result, moved along a random direction: right, and not zero;
    or an error by name in reverse, and NaN in forward mode."""
    start = SOURCES[source]
    motion = np.random.default_rng(1).normal(size=start.shape)
    given, hits = traced(all_hits, source, start, enabled=True)
    h = 1e-5
    ends = [traced(all_hits, source, start + s * motion, enabled=False)[1] for s in (h, -h)]
    right = set()
    for name, result in vars(hits).items():
        if not dr.is_float_v(result):
            assert not dr.grad_enabled(result)
            continue
        assert dr.grad_enabled(result)
        change = [objective(getattr(one, name), WEIGHTS)[0] for one in ends]
        expected = (change[0] - change[1]) / (2 * h)
        dr.set_grad(given, 0)
        if name not in ("t", "position"):
            with pytest.raises(NotImplementedError, match=f"^{name} of hits cannot be diff"):
                dr.backward(objective(result, WEIGHTS), dr.ADFlag.ClearInterior)
            continue
        dr.backward(objective(result, WEIGHTS), dr.ADFlag.ClearInterior)
        found = np.array(dr.grad(given)).T.reshape(motion.shape)
        assert abs(expected) > 1e-3
        assert (found * motion).sum() == pytest.approx(expected, rel=1e-5)
        right.add(name)
    assert right == {"t", "position"}
    given, hits = traced(all_hits, source, start, enabled=True)
    dr.forward(given)
    assert np.isnan(np.array(hits.normal.grad)).all()
    assert np.isfinite(np.array(hits.t.grad)).all()
