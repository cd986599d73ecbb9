"""Parameters of fields by name: which there are, and new fields in which they are exchanged."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
import re
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy
from harnack.fields import Field, Sample
from harnack.fields.analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from harnack.fields.parameters import differentiable_parameters
from harnack.files.molecules import Atoms
from harnack.geometry.example_meshes import icosphere

_MESH = icosphere(0)
_POINTS = _MESH[0]
_CLOUD = {"points": _POINTS, "normals": _POINTS, "areas": np.full(12, 1.0)}
_TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0.4]]
_OUTLINE = [[0.0, 0], [1, 0], [1, 1], [0, 1]]
_ATOMS = Atoms(_POINTS[:3], np.array([1.0, 1.2, 0.9]), ("C", "C", "O"), "three atoms")
_BALL = hk.Ball(radius=2.0)


class Charge(Field):
    """A field of a user, with nothing but what it needs to be traced."""

    def __init__(self, center: Any, strength: float = 1.0) -> None:
        self.center, self.strength = center, strength

    def evaluate(self, p: Any) -> Sample:
        away = p - type(p)(*self.center)
        r = dr.norm(away)
        promise = hk.proofs.HarmonicBall(r, 0.0, math.inf)
        return Sample(self.strength / r, -self.strength * away / (r * r * r), (promise,))


class Evaluated(Field):
    """A field of a user whose evaluator consists of a function that gives samples."""

    def __init__(self, function: Any) -> None:
        self.function = function

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        return hk.fields.EvaluateOnly(self.function)


def blobs(centers: Any, radii: Any, **others: Any) -> hk.Blobs:
    return hk.Blobs(centers, radii, **others)


def waves(amplitude: float) -> Field:
    terms = [
        WaveProduct(amplitude, x=sine_factor(2.0), z=cosine_factor(3.0, 0.2)),
        PlaneWave(0.7, (1.0, -2.0, 0.5), 0.3),
    ]
    return hk.fields.EigenfunctionSum(terms)


_Case = tuple[Any, dict[str, Any], set[str], tuple[str, Any, dict[str, Any]]]
# For each case: how the field is made, with which arguments, the names of its parameters, and a
# change: a name, its new value, and what changes in the arguments with which the field is made.
_CASES: dict[str, _Case] = {
    "plane": (hk.solids.Plane, {"normal": (1, 2, -2)}, {"normal", "distance"},
              ("distance", 0.4, {"distance": 0.4})),
    "sphere": (hk.Sphere, {"radius": 0.8}, {"radius", "center"}, ("radius", 0.5, {"radius": 0.5})),
    "ellipsoid": (hk.Ellipsoid, {"radii": (1.0, 0.5, 0.7)}, {"radii"},
                  ("radii", np.array([1, 2, 3]), {"radii": (1, 2, 3)})),
    "cylinder": (hk.Cylinder, {"radius": 0.5, "height": 1.0}, {"radius", "height"},
                 ("height", 2.0, {"height": 2.0})),
    "double cone": (hk.solids.DoubleCone, {"angle": 20.0}, {"angle"},
                    ("angle", 40.0, {"angle": 40.0})),
    "capsule": (hk.Capsule, {"start": (0, 0, 0), "end": (1, 0, 0)}, {"start", "end", "radius"},
                ("end", (0, 1, 0), {"end": (0, 1, 0)})),
    "round cone": (hk.solids.RoundCone, {"radii": (0.4, 0.2)}, {"start", "end", "radii"},
                   ("radii", np.array([0.1, 0.2]), {"radii": (0.1, 0.2)})),
    "torus": (hk.Torus, {"major": 0.9}, {"major", "minor"}, ("minor", 0.3, {"minor": 0.3})),
    "cuboid": (hk.Cuboid, {"sides": (2, 1, 1)}, {"sides", "radius"},
               ("radius", 0.3, {"radius": 0.3})),
    "superellipsoid": (hk.solids.Superellipsoid, {"powers": (3.0, 2.0)}, {"powers", "radii"},
                       ("powers", np.array([2.5, 4.0]), {"powers": (2.5, 4.0)})),
    "supertorus": (hk.solids.Supertorus, {}, {"powers", "major", "minor"},
                   ("major", 1.2, {"major": 1.2})),
    "extrusion": (hk.solids.Extrusion, {"loops": _OUTLINE, "height": 1.0, "twist": 30.0},
                  {"loops.0", "height", "twist", "taper"}, ("twist", 60.0, {"twist": 60.0})),
    "revolution": (hk.solids.SolidOfRevolution, {"loops": _OUTLINE}, {"loops.0"},
                   ("loops.0", 2 * np.array(_OUTLINE), {"loops": 2 * np.array(_OUTLINE)})),
    "noise": (hk.solids.Noise, {"frequency": 2.0}, {"frequency", "amplitude", "seed"},
              ("seed", 3, {"seed": 3})),
    "fractal noise": (hk.solids.FractalNoise, {"octaves": 2, "fade": "cubic"},
                      {"octaves", "beta", "frequency", "amplitude", "seed"},
                      ("beta", 0.5, {"beta": 0.5})),
    "displaced": (lambda radius: hk.solids.DisplacedSolid(hk.Sphere(radius), hk.solids.Noise(2.0)),
                  {"radius": 0.8},
                  {"solid.radius", "solid.center", "noise.frequency", "noise.amplitude",
                   "noise.seed"},
                  ("solid.radius", 0.9, {"radius": 0.9})),
    "Julia set": (hk.solids.Julia, {"iterations": 5}, {"c", "iterations", "fourth_coordinate"},
                  ("c", np.array([0.1, 0.2, 0.3, 0.4]), {"c": (0.1, 0.2, 0.3, 0.4)})),
    "thread": (hk.solids.Thread, {"profile": [(0, 0.8), (0.1, 0.8), (0.25, 0.5)], "pitch": 0.4},
               {"profile", "pitch", "starts"}, ("pitch", 0.5, {"pitch": 0.5})),
    "tube": (hk.Tube, {"points": _TRIANGLE, "radius": 0.2},
             {"points", "radius", "flattening_error"}, ("radius", 0.1, {"radius": 0.1})),
    "tubes": (hk.solids.TubeNetwork,
              {"points": _TRIANGLE, "segments": [[0, 1], [1, 2]], "radius": 0.2},
              {"points", "segments", "radius"}, ("radius", 0.1, {"radius": 0.1})),
    "mesh solid": (lambda vertices: hk.solid((vertices, _MESH[1])), {"vertices": _MESH[0]},
                   {"vertices", "faces"}, ("vertices", 2 * _MESH[0], {"vertices": 2 * _MESH[0]})),
    "union": (lambda radius: hk.Cuboid((1, 1, 1)) | hk.Sphere(radius), {"radius": 0.8},
              {"parts.0.sides", "parts.0.radius", "parts.1.radius", "parts.1.center"},
              ("parts.1.radius", 0.9, {"radius": 0.9})),
    "difference": (lambda radius: hk.Cuboid((1, 1, 1)) - hk.Sphere(radius), {"radius": 0.4},
                   {"parts.0.sides", "parts.0.radius", "parts.1.field.radius",
                    "parts.1.field.center"},
                   ("parts.1.field.radius", 0.5, {"radius": 0.5})),
    "blend": (lambda radius: hk.Torus().blended(hk.Cylinder(0.2), radius), {"radius": 0.3},
              {"parts.0.major", "parts.0.minor", "parts.1.radius", "radius", "power"},
              ("radius", 0.2, {"radius": 0.2})),
    "moved": (lambda factor: hk.Torus().scaled(factor), {"factor": 2.0},
              {"field.major", "field.minor", "map.matrix", "map.offset"},
              ("map.matrix", 3 * np.eye(3), {"factor": 3.0})),
    "moved offset": (lambda radius: hk.Sphere(radius).offset(0.1).rotated(30, "x").scaled(2),
                     {"radius": 0.8},
                     {"field.field.radius", "field.field.center", "field.distance", "map.matrix",
                      "map.offset"},
                     ("field.field.radius", 0.5, {"radius": 0.5})),
    "twisted": (lambda degrees: hk.Torus().twisted(degrees), {"degrees": 90.0},
                {"inner.major", "inner.minor", "map.rate"},
                ("map.rate", math.radians(45), {"degrees": 45.0})),
    "tapered": (lambda factor: hk.Cuboid().tapered((0.0, 1.0), (1.0, factor)), {"factor": 0.5},
                {"inner.sides", "inner.radius", "map.start", "map.end"},
                ("map.end", np.array([1.0, 0.7]), {"factor": 0.7})),
    "shell": (lambda radius: hk.Sphere(radius).shell(0.2), {"radius": 0.8},
              {"field.radius", "field.center", "level", "half_width"},
              ("field.radius", 0.5, {"radius": 0.5})),
    "solid of a field": (lambda cell: hk.solid(hk.Gyroid(cell, domain=_BALL), above=0.3),
                         {"cell": 1.0}, {"field.field.field.cell", "field.distance"},
                         ("field.field.field.cell", 2.0, {"cell": 2.0})),
    "gyroid": (hk.Gyroid, {"cell": 1.0}, {"cell"}, ("cell", 2.0, {"cell": 2.0})),
    "P": (hk.fields.SchwarzP, {}, {"cell"}, ("cell", 2.0, {"cell": 2.0})),
    "D": (hk.fields.SchwarzD, {"cell": 1.0, "domain": _BALL}, {"cell"},
          ("cell", 2.0, {"cell": 2.0})),
    "waves": (waves, {"amplitude": 1.0},
              {"terms.0.amplitude", "terms.0.x.frequency", "terms.0.x.phase",
               "terms.0.z.frequency", "terms.0.z.phase", "terms.1.amplitude",
               "terms.1.wave_vector", "terms.1.phase"},
              ("terms.0.amplitude", 2.0, {"amplitude": 2.0})),
    "spherical harmonic": (hk.SphericalHarmonic, {"l": 3, "m": 2}, {"l", "m", "radius"},
                           ("m", 1, {"m": 1})),
    "lobes": (hk.fields.Lobes, {"l": 3, "m": 2, "sign": "positive"}, {"l", "m", "scale"},
              ("scale", 2.0, {"scale": 2.0})),
    "sum of lobes": (hk.fields.Lobes.combined, {"weights": {(1, 0): 1.0, (2, 1): 0.5}},
                     {"weights.1,0", "weights.2,1", "scale"},
                     ("weights.2,1", 0.7, {"weights": {(1, 0): 1.0, (2, 1): 0.7}})),
    "hyperspherical": (hk.fields.HypersphericalHarmonic, {"l": 3, "j": 2, "m": 1}, {"l", "j", "m"},
                       ("m", 2, {"m": 2})),
    "polynomial of the sphere": (
        hk.fields.HypersphericalHarmonic.from_polynomial,
        {"coefficients": {(1, 1, 0, 0): 1.0, (0, 0, 1, 1): 0.5}},
        {"coefficients.1,1,0,0", "coefficients.0,0,1,1"},
        ("coefficients.1,1,0,0", 2.0, {"coefficients": {(1, 1, 0, 0): 2.0, (0, 0, 1, 1): 0.5}})),
    "polynomial": (hk.HarmonicPolynomial, {"coefficients": {(2, 1, 0): 1, (0, 1, 2): -1}},
                   {"coefficients.2,1,0", "coefficients.0,1,2"},
                   ("coefficients", {(1, 0, 0): 1.0}, {"coefficients": {(1, 0, 0): 1.0}})),
    "Fourier series": (hk.fields.FourierSeries,
                       {"coefficients": np.eye(3)[None] + np.zeros((2, 1, 1)),
                        "box": hk.Box((0, 0, 0), (1, 1, 1))},
                       {"coefficients"},
                       ("coefficients", np.ones((2, 2, 2)), {"coefficients": np.ones((2, 2, 2))})),
    "network": (hk.Network, {"layers": [(np.eye(3), np.zeros(3)), (np.ones((1, 3)), np.zeros(1))]},
                {"layers.0.0", "layers.0.1", "layers.1.0", "layers.1.1", "level"},
                ("layers.0.1", np.ones(3),
                 {"layers": [(np.eye(3), np.ones(3)), (np.ones((1, 3)), np.zeros(1))]})),
    "height field": (hk.fields.HeightField, {"function": lambda x, y: x * y}, set(),
                     ("function", lambda x, y: x + y, {"function": lambda x, y: x + y})),
    "Riemann surface": (hk.fields.RiemannSurface, {"function": "power", "exponent": 0.5},
                        {"exponent", "height"}, ("height", 2.0, {"height": 2.0})),
    "Riemann surface of a product": (
        hk.fields.RiemannSurface, {"function": {0: 0.5, 1: -0.5}, "part": "real"},
        {"function.0", "function.1", "height"},
        ("function.0", 1.5, {"function": {0: 1.5, 1: -0.5}})),
    "level curves": (hk.fields.LevelCurves, {"function": "log", "argument": {1: 1, -1: -1}},
                     {"argument.1", "argument.-1", "level"}, ("level", 0.2, {"level": 0.2})),
    "formula": (lambda a: hk.expression("x^2 + a*y = 1", parameters={"a": a}), {"a": 1.0},
                {"numbers.a", "default_level"},
                ("numbers.a", 2.0, {"a": 2.0})),
    "blobs": (blobs, {"centers": _POINTS, "radii": 0.5, "groups": [0, 1] * 6},
              {"centers", "radii", "weights", "kernel.support", "groups"},
              ("radii", 0.4, {"radii": 0.4})),
    "molecule": (hk.fields.Molecule, {"source": _ATOMS, "sharpness": 2.0},
                 {"source.positions", "source.radii", "sharpness", "tail"},
                 ("sharpness", 1.5, {"sharpness": 1.5})),
    "HRBF": (hk.fields.HRBF, {"points": _POINTS, "normals": _POINTS}, {"points", "normals"},
             ("points", 2 * _POINTS, {"points": 2 * _POINTS})),
    "dipoles": (hk.DipolePotential, {**_CLOUD, "cells": False},
                {"points", "normals", "areas", "smoothing"},
                ("areas", np.full(12, 2.0), {"areas": np.full(12, 2.0)})),
    "screened": (hk.fields.ScreenedWindingNumber, {**_CLOUD, "length": 0.7},
                 {"points", "normals", "areas", "length", "accuracy"},
                 ("length", 0.5, {"length": 0.5})),
    "winding number": (hk.WindingNumber, {"vertices": _MESH[0], "faces": _MESH[1]},
                       {"vertices", "faces", "order"},
                       ("vertices", 2 * _MESH[0], {"vertices": 2 * _MESH[0]})),
    "morph": (hk.fields.Morph, {"mesh_a": _MESH, "mesh_b": (2 * _MESH[0], _MESH[1]), "gap": 2.0,
                                "w": 1.0},
              {"mesh_a.0", "mesh_a.1", "mesh_b.0", "mesh_b.1", "gap", "w", "spacing", "accuracy"},
              ("w", 0.5, {"w": 0.5})),
    "polygons": (hk.PolygonMesh,
                 {"vertices": _POINTS, "faces": [[0, 1, 2, 3], [[4, 5, 6], [7, 8, 9]]]},
                 {"vertices", "faces.0", "faces.1"},
                 ("vertices", 2 * _POINTS, {"vertices": 2 * _POINTS})),
    "curve": (hk.SolidAngle, {"loops": _TRIANGLE}, {"loops.0"},
              ("loops.0", 2 * np.array(_TRIANGLE), {"loops": 2 * np.array(_TRIANGLE)})),
    "curves": (lambda radius: hk.SolidAngle([hk.geometry.Circle(radius), _TRIANGLE]),
               {"radius": 0.5}, {"loops.0", "loops.1.radius", "loops.1.center", "loops.1.normal"},
               ("loops.1.radius", 0.7, {"radius": 0.7})),
    "sum": (lambda weights: hk.fields.FieldSum([hk.Gyroid(1.0, domain=_BALL),
                                                hk.SphericalHarmonic(2, 1)], weights, 0.1),
            {"weights": (2.0, -1.0)},
            {"terms.0.cell", "terms.1.l", "terms.1.m", "terms.1.radius", "weights", "constant"},
            ("weights", np.array([1.0, 3.0]), {"weights": (1.0, 3.0)})),
    "product": (lambda m: hk.SphericalHarmonic(2, m) * hk.Gyroid(1.0, domain=_BALL), {"m": 1},
                {"factors.0.l", "factors.0.m", "factors.0.radius", "factors.1.cell"},
                ("factors.0.m", 2, {"m": 2})),
    "evaluation only": (Evaluated, {"function": hk.Gyroid(1.0).evaluate}, set(),
                        ("function", hk.Gyroid(2.0).evaluate,
                         {"function": hk.Gyroid(2.0).evaluate})),
    "a user's": (Charge, {"center": (0.1, 0.2, 0.3)}, {"center", "strength"},
                 ("strength", 3.0, {"strength": 3.0})),
}  # fmt: skip
_X = np.random.default_rng(3).uniform(-0.9, 0.9, (20, 3))


def values(field: Field) -> Any:
    """The values of a field at random points; of a field of patches, those of its first patch."""
    one = field.face(0) if isinstance(field, hk.PolygonMesh) else field
    if isinstance(one, hk.solids.TubeNetwork):
        return np.concatenate([one.points.ravel(), one.radius])
    return one.value(_X, precision="double")


def test_every_public_field_is_tested() -> None:
    namespaces = hk, hk.fields, hk.solids
    public = {getattr(namespace, name) for namespace in namespaces for name in namespace.__all__}
    kinds = {
        kind
        for kind in filter(inspect.isclass, public)
        if issubclass(kind, Field) and not inspect.isabstract(kind)
    }
    tested = {type(make(**arguments)) for make, arguments, *_ in _CASES.values()}
    missing = {
        kind.__name__ for kind in kinds if not any(issubclass(each, kind) for each in tested)
    }
    assert missing == set(), "give each a row of _CASES in tests/fields/test_parameters.py"


@pytest.mark.parametrize("case", _CASES)
def test_parameters_have_names_and_are_exchanged(case: str) -> None:
    make, arguments, names, (name, new, changes) = _CASES[case]
    field = make(**arguments)
    parameters = field.parameters()
    assert set(parameters) == names
    for value in parameters.values():
        assert isinstance(value, int | float | np.ndarray)
    same = field.replace(**parameters)
    assert type(same) is type(field)
    assert set(same.parameters()) == names
    np.testing.assert_allclose(values(same), values(field), rtol=1e-12, atol=1e-14)
    replaced, anew = field.replace(**{name: new}), make(**{**arguments, **changes})
    np.testing.assert_array_equal(values(replaced), values(anew))
    assert repr(replaced) == repr(anew)
    assert repr(replaced.domain) == repr(anew.domain)
    assert replaced.default_level == anew.default_level
    if case != "level curves":  # whose level is only the one that is drawn
        assert not np.array_equal(values(replaced), values(field))
    with pytest.raises(TypeError, match="has no parameter 'nonsense'"):
        field.replace(nonsense=1.0)


def test_an_unknown_name_is_refused_with_a_suggestion() -> None:
    both = hk.Cuboid() | hk.Sphere(0.8)
    names = "parts.0.sides", "parts.0.radius", "parts.1.radius", "parts.1.center"
    assert tuple(both.parameters()) == names  # in the order of the constructors
    with pytest.raises(TypeError, match=r'did you mean "parts.1.radius"\?; there are parts.0.si'):
        both.replace(**{"parts.1.radios": 1.0})
    with pytest.raises(TypeError, match=r"has no parameter 'parts\.2'"):
        both.replace(**{"parts.2": hk.Sphere(0.8)})
    moved = both | hk.Torus().translated((1.0, 0.0, 0.0))
    for part, name in (
        ("minor", "parts.2.field.minor"),
        ("parts.2.minor", "parts.2.field.minor"),
        ("center", "parts.1.center"),
    ):
        with pytest.raises(TypeError, match=f'did you mean "{re.escape(name)}"'):
            moved.replace(**{part: 1.0})
    text = hk.expression("x^2 + a*y = b", parameters={"a": 1.0, "b": 0.5})
    with pytest.raises(TypeError, match=r'an Expression has .* mean "numbers\.a"'):
        text.replace(a=1.4)
    with pytest.raises(TypeError, match='did you mean "default_level"'):
        text.replace(level=0.2)
    with pytest.raises(TypeError, match='did you mean "domain"'):
        hk.Gyroid().replace(domian=_BALL)


def test_the_constructor_checks_what_is_exchanged() -> None:
    with pytest.raises(ValueError, match="radii of an ellipsoid"):
        hk.Ellipsoid().replace(radii=(1.0, -1.0, 1.0))
    with pytest.raises(ValueError, match="power"):
        hk.Torus().blended(hk.Cylinder(0.2), 0.3).replace(power=0.5)
    with pytest.raises(ValueError, match="the matrix is singular"):
        hk.Torus().scaled(2.0).replace(**{"map.matrix": np.zeros((3, 3))})
    for field in (hk.Gyroid(), hk.expression("x"), hk.HarmonicPolynomial({(1, 0, 0): 1.0})):
        with pytest.raises(TypeError, match=r"domain must be a volume: .*, not 3"):
            field.replace(domain=3)
    formula = hk.expression("x^2 + a*y = 1", parameters={"a": 1.0})
    with pytest.raises(ValueError, match="a must be"):
        formula.replace(**{"numbers.a": math.nan})
    with pytest.raises(ValueError, match="distance must be"):
        hk.Sphere().offset(0.1).replace(distance=math.inf)
    with pytest.raises(ValueError, match="half_width must be positive"):
        hk.Sphere().shell(0.1).replace(half_width=-1.0)


def test_arguments_that_are_no_parameters_and_whole_parts_are_exchanged() -> None:
    assert hk.Gyroid(1.0).replace(domain=_BALL).domain is _BALL
    both = (hk.Cuboid() | hk.Sphere(0.8)).replace(**{"parts.1": hk.Torus(), "parts.0.radius": 0.2})
    np.testing.assert_array_equal(values(both), values(hk.Cuboid(radius=0.2) | hk.Torus()))
    tree = hk.WindingNumber(*_MESH).replace(method="tree")
    assert tree.method == "tree"


def test_what_was_left_to_the_constructor_is_left_to_it_again() -> None:
    assert repr(hk.Gyroid(1.0).replace(cell=3.0).domain) == repr(hk.Gyroid(3.0).domain)
    cloud = hk.DipolePotential(_POINTS, _POINTS)
    twice = cloud.replace(points=2 * _POINTS)
    np.testing.assert_allclose(twice.areas, 4 * cloud.areas, rtol=1e-9)
    assert twice.replace(areas=cloud.areas).areas is not cloud.areas
    auto = hk.WindingNumber(*_MESH, method="auto", cells=True).replace(order=1)
    assert (auto.method, auto.order, auto.cells) == ("exact", 1, True)


def test_a_denoised_cloud_is_denoised_once() -> None:
    points = icosphere(2)[0] * (1 + 0.02 * np.random.default_rng(1).normal(size=(162, 1)))
    cloud = hk.DipolePotential(points, points / np.linalg.norm(points, axis=1)[:, None],
                               smoothing="auto")  # fmt: skip
    again = cloud.replace(accuracy=4.0)
    assert again.smoothing == cloud.smoothing
    np.testing.assert_array_equal(again.points, cloud.points)


def test_parameters_outlive_copies() -> None:
    field = hk.Gyroid(1.5, domain=_BALL)
    for other in (copy.copy(field), copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
        assert other.parameters() == {"cell": 1.5}
        assert repr(other.replace(cell=2.0)) == repr(field.replace(cell=2.0))


def test_a_field_that_does_not_store_its_arguments_says_so() -> None:
    class Forgetful(Charge):
        def __init__(self, places: Any, *, scale: float = 1.0) -> None:
            super().__init__(places[0], scale)

    field = Forgetful([(0.0, 0.0, 0.0)], scale=2.0)
    assert field.parameters() == {"scale": 2.0}
    with pytest.raises(TypeError, match="a Forgetful does not store the argument 'places'"):
        field.replace(scale=3.0)
    moved = field.replace(places=[(1.0, 0.0, 0.0)])
    assert (moved.center, moved.strength) == ((1.0, 0.0, 0.0), 2.0)


def test_numbers_are_those_that_were_given_and_arrays_those_that_are_stored() -> None:
    class Degrees(Charge):
        def __init__(self, angle: float, weights: Any = None, *, center: Any = (0, 0, 0)) -> None:
            super().__init__(center)
            self.angle = math.radians(angle)
            self._count = 0 if weights is None else len(weights)

    field = Degrees(90.0)
    assert field.parameters()["angle"] == 90.0
    assert field.replace(center=(1, 2, 3)).angle == math.radians(90.0)
    assert set(field.parameters()) == {"angle", "center"}
    with pytest.raises(TypeError, match="does not store the argument 'weights'"):
        Degrees(90.0, [1.0, 2.0]).replace(angle=45.0)


def test_keys_of_mappings_may_have_points() -> None:
    surface = hk.fields.RiemannSurface({1: 0.5, 1.5: -0.5})
    assert set(surface.parameters()) == {"function.1", "function.1.5", "height"}
    exchanged = surface.replace(**{"function.1.5": 0.5}).parameters()
    assert (exchanged["function.1"], exchanged["function.1.5"]) == (0.5, 0.5)


def test_constructors_with_any_arguments() -> None:
    class Several(Charge):
        def __init__(self, *centers: Any, **options: Any) -> None:
            super().__init__(centers[0], **options)
            self.centers = centers

    field = Several((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), strength=2.0)
    assert set(field.parameters()) == {"centers", "strength"}
    stronger = field.replace(strength=3.0)
    assert (stronger.centers, stronger.strength) == (field.centers, 3.0)


def test_derivatives_are_refused_or_kept() -> None:
    backend = choose_backend("double")
    number = backend.Float(0.5)
    matrix = backend.Array3f(1, 2, 3)
    loop = backend.Array3f(np.array(_TRIANGLE).T)
    dr.enable_grad(number, matrix, loop)
    sphere = hk.Sphere().replace(radius=number)
    assert differentiable_parameters(sphere) == (number,)
    with pytest.raises(NotImplementedError, match="Noise cannot be differentiated"):
        hk.solids.Noise().replace(seed=number)
    with pytest.raises(NotImplementedError, match="cannot be differentiated"):
        hk.Torus().scaled(2.0).replace(**{"map.offset": matrix})
    moved = waves(1.0).replace(**{"terms.0.amplitude": number})
    assert differentiable_parameters(moved) == (number,)
    curve = hk.SolidAngle(_TRIANGLE).replace(loops=loop)
    assert curve.parameters()["loops.0"] is loop
    assert differentiable_parameters(curve) == (loop,)
    assert differentiable_parameters(hk.SolidAngle(_TRIANGLE)) == ()
    dr.backward(dr.sum(curve.value(backend.Array3f(0.2, 0.3, 0.5))))
    assert np.abs(to_numpy(dr.grad(loop))).max() > 0


class MovingCharge(Charge):
    """A charge with derivatives by its strength, if that is a Dr.Jit array."""

    traits = hk.fields.Traits(has_parameter_derivatives=True)


class Hidden(MovingCharge):
    """One that does not store its argument, but in a list."""

    def __init__(self, given: Any) -> None:
        super().__init__((0.0, 0.0, 0.0))
        self.others = given
        self.strength = given[0]


def test_a_users_field_has_derivatives_by_its_parameters() -> None:
    backend = choose_backend("double")
    strength = backend.Float(2.0)
    field = Charge((0.0, 0.0, 0.0)).replace(strength=strength)
    assert field.parameters()["strength"] is strength
    assert differentiable_parameters(field) == ()
    points = backend.Array3f(0.0, 0.0, 4.0)
    dr.enable_grad(strength)
    with pytest.raises(NotImplementedError, match="Charge cannot be differentiated"):
        field.value(points)
    with pytest.raises(NotImplementedError, match="Charge cannot be differentiated"):
        Charge((0.0, 0.0, 0.0), strength)
    moving = MovingCharge((0.0, 0.0, 0.0), strength)
    assert differentiable_parameters(moving) == (strength,)
    dr.backward(moving.value(points))
    assert dr.grad(strength)[0] == 0.25
    hits = hk.trace(moving, backend.Array3f(0, 0, 9), backend.Array3f(0, 0, -1), level=0.5)
    dr.set_grad(strength, 0.0)
    dr.backward(hits.t)  # t = 9 - strength / level
    assert abs(dr.grad(strength)[0] + 2.0) < 1e-9


def test_derivatives_by_what_is_no_parameter_are_refused() -> None:
    backend = choose_backend("double")
    strength = backend.Float(2.0)
    dr.enable_grad(strength)
    hidden = Hidden([strength])
    assert differentiable_parameters(hidden) == ()
    with pytest.raises(NotImplementedError, match="Hidden cannot be differentiated"):
        hidden.value(backend.Array3f(0.0, 0.0, 4.0))
    with pytest.raises(NotImplementedError, match="Hidden cannot be differentiated"):
        hk.trace(hidden, backend.Array3f(0, 0, 9), backend.Array3f(0, 0, -1), level=0.5)
