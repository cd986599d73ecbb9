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


# The package and its namespaces, but for tools of other kinds: drawing, meshing, testing.
NAMESPACES = (hk, hk.fields, hk.solids, hk.kernels, hk.proofs, hk.math, hk.io, hk.distance,
              hk.printing, hk.live, hk.tracer)  # fmt: skip
PUBLIC: dict[str, Any] = {
    name: getattr(namespace, name) for namespace in NAMESPACES for name in namespace.__all__
}


def public_classes(kind: type) -> list[type]:
    classes = {value for value in (*PUBLIC.values(), *vars(geometry).values()) if is_class(value)}
    chosen = (each for each in classes if issubclass(each, kind) and not inspect.isabstract(each))
    return sorted(chosen, key=lambda each: each.__name__)


def is_class(value: object) -> bool:
    # Python 3.10 calls generic aliases, such as list[int], classes.
    return inspect.isclass(value) and not hasattr(value, "__origin__")


def arguments(function: Callable[..., Any]) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def makers() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Constructors of fields and volumes, class methods that make them, and methods of solids and
    of fields whose data may move."""
    for kind in (*public_classes(hk.Field), *public_classes(Volume)):
        if kind in (hk.fields.FieldSum, hk.fields.FieldProduct):
            continue  # they have derivatives by weights, and by what their terms have
        yield kind.__name__, kind
        for name, own in vars(kind).items():
            copies = getattr(getattr(own, "__func__", None), "copies_numbers", False)
            if isinstance(own, classmethod) and not name.startswith("_") and not copies:
                yield f"{kind.__name__}.{name}", getattr(kind, name)
    for field in (hk.DipolePotential(POINTS, POINTS), hk.WindingNumber(POINTS[:3], [[0, 1, 2]])):
        move = getattr(field, "with_points", None) or field.with_vertices
        yield f"{type(field).__name__}.{move.__name__}", move
    for name, own in vars(hk.solids.Solid).items():
        is_maker = inspect.isfunction(own) and own.__annotations__.get("return") == "Solid"
        if is_maker and not name.startswith("_") and name not in ("prepare", "map_operands"):
            yield f"Solid.{name}", getattr(hk.Sphere(1.0), name)


def refuses(is_attached: bool) -> Any:
    """Where there are derivatives by numbers, others than numbers may be refused for their form."""
    if is_attached:
        return pytest.raises((NotImplementedError, TypeError, ValueError))
    return pytest.raises(NotImplementedError, match=REFUSED)


MAKERS = dict(makers())
TRIANGLE: dict[str, Any] = {"vertices": POINTS[:3], "faces": [[0, 1, 2]]}
CLOUD: dict[str, Any] = {"points": POINTS, "normals": POINTS, "areas": np.ones(4)}
# Of classes with derivatives by arrays, arguments that make a field: arrays are those by which
# there are derivatives.
MADE_OF: dict[str, dict[str, Any]] = {
    "SolidAngle": {"loops": LOOP},
    "DipolePotential": CLOUD,
    "ScreenedWindingNumber": CLOUD | {"length": 0.5},
    "WindingNumber": TRIANGLE,
    "PolygonMesh": TRIANGLE,
}
# By whose numbers there are derivatives.
ATTACHED = {
    "DipolePotential.with_points": ("points", "normals", "areas"),
    "WindingNumber.with_vertices": ("vertices",),
    **{
        name: tuple(key for key, value in example.items() if isinstance(value, np.ndarray))
        for name, example in MADE_OF.items()
    },
    "Solid.blended": ("other", "radius", "power", "intersect"), "Solid.offset": ("distance",),
    "Solid.translated": ("offset",), "Solid.rotated": ("degrees", "axis"),
    "Solid.scaled": ("factors",), "Solid.shell": ("thickness",), "Solid.transformed": ("matrix",),
    "Solid.twisted": ("rate", "axis"), "Solid.tapered": ("start", "end", "axis"),
    "Solid.arranged": ("transforms",), "Solid.repeated": ("period", "counts"),
    "Solid.mirrored": ("normal", "offset"), "Solid.around": ("count", "axis"),
}  # fmt: skip


@pytest.mark.parametrize("name", MAKERS)
def test_makers_refuse_each_argument_that_carries_derivatives(name: str) -> None:
    names = arguments(MAKERS[name])
    assert names or name in ("SexticKernel", "CubicKernel")
    traits, known_arguments = getattr(MAKERS[name], "traits", None), MADE_OF.get(name, {})
    # Other classes with derivatives by parameters fail here: for those, derivatives are tested in
    # `test_source_derivatives`.
    is_refused = traits is None or name in MADE_OF or not traits.has_parameter_derivatives
    assert is_refused
    attached = ATTACHED.get(name, getattr(traits, "differentiable_arguments", ()))
    for argument in names:
        for mark in ("torch",) if argument in attached else MARKS:
            with refuses(argument in attached):
                MAKERS[name](**{**known_arguments, argument: learned(mark)})
        with refuses(argument in attached):
            MAKERS[name](**{**known_arguments, argument: [(1.0, {"deep": learned("number")})]})


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
    "surface": SPHERE,
    "function": lambda x, y, z: x * x + y * y + z * z - 1,
    "points": POINTS,
    "origins": ORIGINS,
    "directions": DIRECTIONS,
    "solids": SPHERE,
    "seeds": POINTS,
    "step": 0.1,
    "length": 1.0,
    "max_crossings": 2,
    "nodes": POINTS,
    "edges": [[0, 1], [1, 2]],
    "radius": 0.1,
}
# What results have derivatives by, or do not depend on: where rays begin and end moves no hit.
WITH_DERIVATIVES = (
    {
        ("Surface", "field"),
        ("picture", "surface"),
        ("picture", "level"),
        ("Surface", "level"),
        ("signed_distance", "points"),
        ("smooth_union", "radius"),
        ("smooth_union", "power"),
        ("struts", "nodes"),
        ("struts", "radius"),
        ("struts", "smooth"),
        *(("solid", name) for name in ("below", "above", "between", "around")),
    }
    | {
        (name, argument)
        for name in ("trace", "crossings")
        for argument in ("surface", "origins", "directions", "level", "t_min", "t_max")
    }
    | {
        (name, argument)
        for name in ("sine_factor", "cosine_factor")
        for argument in ("frequency", "phase")
    }
)
# Functions of any numbers, of solids, and of scenes and files, whose results carry nothing; and
# those of names and of surfaces that are already checked.
OTHERS = {
    "atan2", "maximum", "minimum", "norm", "union", "intersection", "animate", "render", "page",
    "check_print", "mesh", "read_scene", "repair", "view", "wall_thickness",
    "wrap_for_jax", "wrap_for_torch", "write_mesh", "write_scene", "choose_enclosures",
    "field_from_file", "traced_surface",
}  # fmt: skip
FUNCTIONS = {
    name: value
    for name, value in PUBLIC.items()
    if inspect.isfunction(value) and name not in OTHERS
} | {"Surface": hk.Surface, "TraceOptions": hk.TraceOptions}
# Settings that are no numbers of the result: names, counts, switches, and volumes.
SETTINGS = {
    "precision", "max_steps", "largest", "side", "require_crossing", "max_crossings", "enclosures",
    "method", "progress", "is_convex", "clip", "section", "backend", "options", "parameters",
    "numbers", "clearance",
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse_each_argument_that_carries_derivatives(name: str) -> None:
    function, refused = FUNCTIONS[name], 0
    parameters = inspect.signature(function).parameters
    for argument in parameters:
        if argument in SETTINGS:
            continue
        required = {
            other: GIVEN[other]
            for other, about in parameters.items()
            if about.default is about.empty and other in GIVEN
        }
        for mark in MARKS:
            is_field = argument in ("field", "surface")
            if (name, argument) in WITH_DERIVATIVES and (is_field or mark != "torch"):
                continue
            value = moved_curve() if is_field else learned(mark)
            value = (value, 1.0) if argument == "solid" else value
            with pytest.raises(NotImplementedError, match=REFUSED):
                function(**{**required, argument: value})
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
        lambda wave: hk.fields.EigenfunctionSum([wave]),
    ),
    "WaveProduct": (
        {"amplitude": 1.0, "x": hk.fields.sine_factor(2.0)},
        lambda wave: hk.fields.EigenfunctionSum([wave]),
    ),
    "BranchPoint": (
        {"location": 0j},
        lambda point: hk.fields.RiemannSurface("sqrt", singular_points=[point]),
    ),
    "Circle": ({"radius": 1.0}, lambda circle: hk.SolidAngle([circle])),
    **{
        name: ({}, lambda kernel: hk.Blobs(POINTS, 0.5, kernel=kernel))
        for name in ("CompactKernel", "CubicKernel", "GaussianKernel", "SexticKernel")
    },
}
# Records of settings, results and pictures, and proofs.
NO_PARTS = {"Boundary", "MovingTriangles", "NearestFacet", "PatchEntry", "VariableAccuracy",
            "JumpCrossing", "LevelGaps", "MarchResult", "Plan", "SurfaceTracer", "TraceOptions",
            "TracedSurface", "RayCrossings", "Camera", "CurvatureSamples", "DistanceBounds", "Hits",
            "ClearanceHits", "Traits",
            "Isolines", "Surface", "PrintCheck", "PrintProblem", "Sample", "SceneFile", "Slider",
            "WallThickness", "HitTolerance", "LiveView"}  # fmt: skip


def test_the_list_of_records_is_whole() -> None:
    records = {
        name
        for name, kind in (PUBLIC | {"Circle": geometry.Circle}).items()
        if is_class(kind) and dataclasses.is_dataclass(kind)
        and not issubclass(kind, hk.Field | Volume | Enclosure | Promise)
    }  # fmt: skip
    assert records - NO_PARTS <= set(PARTS)


@pytest.mark.parametrize("name", PARTS)
def test_records_with_derivatives_are_refused_by_the_field_at_the_latest(name: str) -> None:
    (example_arguments, field_of), tried = PARTS[name], 0
    record = PUBLIC.get(name) or getattr(geometry, name)
    for argument, about in inspect.signature(record).parameters.items():
        example = example_arguments.get(argument, about.default)
        if isinstance(example, tuple):
            value: Any = (Learned(example[0]), *example[1:])
        elif isinstance(example, float | complex):
            value = Learned(abs(example) or 1.0)
        else:
            continue
        with pytest.raises(NotImplementedError, match="carry derivatives"):
            field_of(record(**{**example_arguments, argument: value}))
        tried += 1
    assert tried


# Derivatives of what a trace returns.


def objective(result: Any, weights: np.ndarray) -> Any:
    """A number made of all lanes of a result: floats, or vectors of them."""
    total = 0
    for floats in result if dr.depth_v(result) == 2 else [result]:
        total = total + dr.sum(dr.select(dr.isfinite(floats), floats, 0) * DOUBLE.Float(weights))
    return total


WEIGHTS = np.array([1.0, -0.7, 0.4, 1.3])
SOURCES: dict[str, np.ndarray] = {
    "origins": ORIGINS,
    "directions": DIRECTIONS + np.array([0.02, 0.01, 0]),
    "level": np.array([5.0]),
    "vertices": LOOP,
}


def traced(max_crossings: int | None, source: str, values: np.ndarray, *, enabled: bool) -> Any:
    arrays: dict[str, Any] = {}
    for name, default in SOURCES.items():
        numbers = values if name == source else default
        of = DOUBLE.Float(numbers) if name == "level" else DOUBLE.Array3f(numbers.T)
        if name == source and enabled:
            dr.enable_grad(of)
        arrays[name] = of
    field = hk.SolidAngle(arrays["vertices"])
    rays, level = (arrays["origins"], arrays["directions"]), arrays["level"]
    settings: dict[str, Any] = {"level": level, "tolerance": 1e-11}
    if max_crossings is None:
        return arrays[source], hk.trace(field, *rays, **settings)
    return arrays[source], hk.crossings(field, *rays, max_crossings=max_crossings, **settings)


@pytest.mark.few(1)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("max_crossings", [None, 1])
def test_each_result_of_a_trace_has_its_derivative_or_refuses_it(
    source: str, max_crossings: int | None
) -> None:
    """By the sum of all entries of a result, moved along a random direction: right, and not zero;
    or an error by name in reverse, and NaN in forward mode."""
    start = SOURCES[source]
    motion = np.random.default_rng(1).normal(size=start.shape)
    array, hits = traced(max_crossings, source, start, enabled=True)
    h = 1e-5
    ends = [traced(max_crossings, source, start + s * motion, enabled=False)[1] for s in (h, -h)]
    known = {"t", "position", "normal"}
    known |= {"value"} if source == "level" and max_crossings is None else set()
    right = set()
    for name, result in vars(hits).items():
        if not dr.is_float_v(result):
            assert not dr.grad_enabled(result)
            continue
        assert dr.grad_enabled(result)
        change = [objective(getattr(end, name), WEIGHTS)[0] for end in ends]
        expected = (change[0] - change[1]) / (2 * h)
        dr.set_grad(array, 0)
        if name == "value" and source != "level":  # it is the level
            dr.backward(objective(result, WEIGHTS), dr.ADFlag.ClearInterior)
            assert not np.array(dr.grad(array)).any()
            continue
        if name not in known:
            with pytest.raises(NotImplementedError, match=f"^{name} of hits cannot be diff"):
                dr.backward(objective(result, WEIGHTS), dr.ADFlag.ClearInterior)
            continue
        dr.backward(objective(result, WEIGHTS), dr.ADFlag.ClearInterior)
        derivative = np.array(dr.grad(array)).T.reshape(motion.shape)
        assert abs(expected) > 1e-3
        assert (derivative * motion).sum() == pytest.approx(expected, rel=1e-5)
        right.add(name)
    assert right == known
    array, hits = traced(max_crossings, source, start, enabled=True)
    dr.forward(array)
    for result in (hits.normal, hits.t):
        assert np.isfinite(np.array(result.grad)).all()


def test_the_check_of_a_mesh_refuses_vertices_with_derivatives() -> None:
    """They were dropped without a word by functions that check a mesh before anything else."""
    x: Any = choose_backend("double").Float(0.5)
    dr.enable_grad(x)
    vertices = [[x, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    with pytest.raises(NotImplementedError, match="the vertices cannot be differentiated"):
        geometry.validate_mesh(vertices, [[0, 1, 2]])


class Around(hk.Field):
    """A field of a user that is another field."""

    traits = hk.fields.Traits(has_parameter_derivatives=True)
    period = hk.SolidAngle.period

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def evaluate(self, p: Any) -> Any:
        return self.inner.evaluate(p)


def test_a_field_that_holds_a_curve_has_derivatives_by_its_vertices() -> None:
    """They were dropped without a word."""
    derivatives: list[Any] = []
    p = DOUBLE.Array3f(0.1, 0.2, 0.5)
    for wrap in (lambda curve: curve, Around, lambda curve: Around(Around(curve))):
        vertices = DOUBLE.Array3f(LOOP.T)
        dr.enable_grad(vertices)
        dr.backward(wrap(hk.SolidAngle(vertices)).value(p))
        derivatives.append(np.array(vertices.grad))
    assert np.abs(derivatives[0]).max() > 1e-3
    np.testing.assert_allclose(derivatives[1], derivatives[0], rtol=1e-12)
    np.testing.assert_allclose(derivatives[2], derivatives[0], rtol=1e-12)


class _Ball(hk.fields.Evaluator):
    """|p| - radius."""

    def __init__(self, radius: Any) -> None:
        self.radius = radius

    def evaluate(self, p: Any) -> hk.fields.Sample:
        value = dr.norm(p) - self.radius
        return hk.fields.Sample(value, dr.normalize(p), (hk.proofs.Lipschitz(1.0),))


class OwnBall(hk.Field):
    """|p| - radius, by an evaluator of a user that does not define `differentiable_value`."""

    traits = hk.fields.Traits(has_parameter_derivatives=True)

    def __init__(self, radius: Any) -> None:
        self.radius = radius

    def evaluator(self, backend: Any, plan: Any = None) -> _Ball:
        return _Ball(self.radius)


def test_the_parameters_of_an_evaluator_have_derivatives() -> None:
    """They were dropped without a word, beside those by points."""
    p, radius = DOUBLE.Array3f(0.0, 0.6, 0.8), DOUBLE.Float(0.5)
    dr.enable_grad(p, radius)
    dr.backward(OwnBall(radius).value(p))
    assert radius.grad == -1.0
    np.testing.assert_allclose(np.array(p.grad).ravel(), [0.0, 0.6, 0.8])


def test_hits_of_a_function_that_hides_a_number_are_refused() -> None:
    """The derivative was dropped without a word, as no attribute of the field holds the number."""
    radius = DOUBLE.Float(0.5)
    dr.enable_grad(radius)

    class Hiding(hk.Field):
        def evaluate(self, p: Any) -> Any:
            return _Ball(radius).evaluate(p)

    with pytest.raises(NotImplementedError, match="Hiding cannot be differentiated by these"):
        hk.trace(Hiding(), DOUBLE.Array3f(0.0, 0.0, 2.0), DOUBLE.Array3f(0.0, 0.0, -1.0))
    with pytest.raises(NotImplementedError, match="solid cannot be differentiated by these"):
        hk.solid(Hiding(), below=0)
