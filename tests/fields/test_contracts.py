"""Every field keeps its promises; every bound keeps clear of levels in every field."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable
from typing import Any, cast

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack import enclosures, literature
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import (
    BoundedLaplacian,
    Enclosure,
    HarmonicBall,
    Lipschitz,
    Promise,
    SlopeRange,
    TaylorRemainder,
    choose_enclosures,
)
from harnack.enclosures.parabola import LipschitzEnclosure
from harnack.fields import Field, Sample
from harnack.fields.analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import bumpy_sphere, icosphere, remove_faces
from harnack.testing import BrokenPromiseError, check_field, check_ray_samples
from harnack.testing.enclosure_contracts import PromiseCase
from tests.enclosures.test_bounded_laplacian import FIELDS as SOURCED
from tests.fields.test_network import random_layers
from tests.fields.test_shapes import SHAPES
from tests.literature.test_enclosures_of_formulas import PROOFS
from tests.oracles.direct_sums import dipole_sum, winding_sum
from tests.oracles.exact import BOUNDS
from tests.oracles.mutated_enclosure import mutated_enclosure
from tests.oracles.step_contracts import check_steps


class EvaluatedPlane(Field):
    """A `Plane` whose evaluator consists of the function that gives samples."""

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        return hk.fields.EvaluateOnly(Plane().evaluate)


class Charges(Field):
    """The potential of point charges: positive, harmonic up to the nearest, no upper end."""

    default_level = 2.5
    domain = hk.Ball(radius=3.0)

    def evaluate(self, p: Any) -> Sample:
        value, gradient, nearest = 0.0, type(p)(0.0), math.inf
        for center in ((-0.8, 0.0, 0.0), (0.8, 0.0, 0.0), (0.0, 0.9, 0.3)):
            away = p - type(p)(*center)
            r = dr.norm(away)
            value, gradient = value + 1 / r, gradient - away / (r * r * r)
            nearest = dr.minimum(nearest, r)
        return Sample(value, gradient, (HarmonicBall(nearest, 0.0, math.inf),))


class Azimuth(Field):
    """The angle about the z axis: harmonic in the plane, known modulo 2 pi."""

    period = 2 * math.pi
    default_level = 1.0
    domain = hk.Box((-2, -2, -2), (2, 2, 2))

    def evaluate(self, p: Any) -> Sample:
        square = p.x * p.x + p.y * p.y
        angle = dr.atan2(p.y, p.x)
        gradient = type(p)(-p.y / square, p.x / square, 0.0)
        # Seen from a point at distance r, the disk of radius r is within a quarter turn.
        ball = HarmonicBall(dr.sqrt(square), angle - 0.5 * math.pi, angle + 0.5 * math.pi, 2)
        return Sample(angle, gradient, (ball,))


class Plane(Field):
    """x: the simplest function, known to be Lipschitz and straight."""

    domain = hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> Sample:
        return Sample(p.x, type(p)(1.0, 0.0, 0.0), (Lipschitz(1.0), TaylorRemainder(0.0)))


def moved(loops: Any, scale: float, shift: float) -> list[np.ndarray]:
    loops = loops if isinstance(loops, list) else [loops]
    return [scale * (loop + shift * np.array([1.0, -0.5, 0.3])) for loop in loops]


_RNG = np.random.default_rng(5)
CURVES: dict[str, Field] = {
    "triangle": hk.SolidAngle([[0, 0, 0], [1, 0, 0], [0, 1, 0.4]]),
    "wavy": hk.SolidAngle(example_curves.wavy_polygon(24)),
    "wavy by edges": hk.SolidAngle(example_curves.wavy_polygon(24), lift_bound="edges"),
    "flat": hk.SolidAngle(example_curves.regular_polygon(9)),
    "trefoil": hk.SolidAngle(example_curves.torus_knot(2, 3, 60)),
    "figure eight, small": hk.SolidAngle(moved(example_curves.figure_eight_knot(48), 1e-3, 0.5)),
    "trefoil in cells": hk.SolidAngle(example_curves.torus_knot(2, 3, 60), cells=True),
    "link in cells": hk.SolidAngle(moved(example_curves.hopf_link(24), 1e2, 0.7), cells=True),
    "holes in cells": hk.SolidAngle(example_curves.square_with_holes(12), cells=True),
    "coil": hk.SolidAngle(example_curves.coil(5, 80, height=0.4)),
    "coil on its axis, large": hk.SolidAngle(
        moved(example_curves.coil(3, 50, return_path="axis"), 1e3, 1.0)
    ),
    "Hopf link": hk.SolidAngle(example_curves.hopf_link(20)),
    "Borromean rings": hk.SolidAngle(example_curves.borromean_rings(20)),
    "holes": hk.SolidAngle(example_curves.square_with_holes(12)),
    "ring of circles": hk.SolidAngle(
        [hk.geometry.Circle(1.0), hk.geometry.Circle(0.4, normal=(0, 0, -1))]
    ),
    "trefoil and circle": hk.SolidAngle(
        [example_curves.torus_knot(2, 3, 60), hk.geometry.Circle(0.5)]
    ),
    "spiky": hk.SolidAngle(example_curves.spiky_polygon(_RNG, 17)),
    "random": hk.SolidAngle(example_curves.random_closed_curve(_RNG, 40)),
}
REAL: dict[str, Field] = {
    "Y 2,0": hk.SphericalHarmonic(2, 0),
    "Y 5,3": hk.SphericalHarmonic(5, 3),
    "Y 12,-7, large": hk.SphericalHarmonic(12, -7, radius=50.0),
    "lobes 3,2": hk.fields.Lobes(3, 2),
    "lobes 2,1, positive": hk.fields.Lobes(2, 1, sign="positive", scale=20.0),
    "Eq. 8": hk.HarmonicPolynomial({(2, 1, 0): 1, (0, 1, 2): -1}),
    "polynomial off center": hk.HarmonicPolynomial(
        {(2, 1, 0): 1, (0, 1, 2): -1, (1, 0, 0): 0.3, (0, 0, 0): 0.1, (1, 1, 1): 0.5},
        domain=hk.Ball((0.3, 0.0, -0.2), 1.5),
    ),
    "gyroid": hk.Gyroid(),
    "gyroid, small": hk.Gyroid(cell=0.01, domain=hk.Box((0, 0, 0), (0.03, 0.02, 0.02))),
    "P": hk.fields.SchwarzP(cell=2.0),
    "D": hk.fields.SchwarzD(cell=100.0),
    "Fig. 21": hk.fields.EigenfunctionSum(
        [
            WaveProduct(1.0, sine_factor(6), sine_factor(6), sine_factor(6)),
            WaveProduct(1.0, sine_factor(2), sine_factor(2), sine_factor(2)),
        ]
    ),
    "plane waves": hk.fields.EigenfunctionSum(
        [
            PlaneWave(0.7, (1.0, -2.0, 0.5), 0.3),
            WaveProduct(0.4, x=cosine_factor(2.0), y=sine_factor(3.0, 0.2)),
            WaveProduct(0.25),
        ]
    ),
    "hyperspherical 4,2,1": hk.fields.HypersphericalHarmonic(4, 2, 1),
    "hyperspherical 6,6,5, in a ball": hk.fields.HypersphericalHarmonic(6, 6, 5, domain=hk.Ball()),
    "Fourier series": hk.fields.FourierSeries.fit(
        lambda x: np.exp(-4 * (x**2).sum(axis=1)) + 0.2 * x[:, 0],
        ((-1.0, -1.0, -0.5), (1.0, 1.0, 0.5)),
        (7, 6, 4),
    ),
    "network": hk.Network(random_layers(3), activation=["elu", ("sine", 2.0)]),
}
OWN: dict[str, Field] = {
    "charges": Charges(),
    "azimuth": Azimuth(),
    "plane": Plane(),
    "evaluation only": EvaluatedPlane(),
    **{name: field for name, (field, _) in SOURCED.items()},
}
_POINTS = np.random.default_rng(5).normal(size=(60, 3))
_POINTS /= np.linalg.norm(_POINTS, axis=1, keepdims=True)
_SPHERE = (_POINTS, _POINTS)

FIELDS = {
    # Accurate enough that clusters of points are never taken as a whole: no truncation.
    "dipoles": hk.DipolePotential(*_SPHERE, np.full(60, 4 * math.pi / 60), accuracy=100.0),
    "dipoles in cells": hk.DipolePotential(
        *_SPHERE, np.full(60, 4 * math.pi / 60), accuracy=100.0, cells=True
    ),
    "smoothed": hk.DipolePotential(
        *_SPHERE, np.full(60, 4 * math.pi / 60), smoothing=0.2, accuracy=100.0
    ),
    "screened": hk.fields.ScreenedWindingNumber(
        *_SPHERE, np.full(60, 4 * math.pi / 60), length=0.7, method="sum"
    ),
    **CURVES,
    **REAL,
    **OWN,
}
# One or two of each kind for what is tried with every bound on every run.
SOME = ("coil", "Y 5,3", "charges", "matter")


# What the fields promise. A harmonic ball with both ends has caps only in space.
_BALL, _PLANE_BALL = HarmonicBall(1.0, -1.0, 1.0), HarmonicBall(1.0, -1.0, 1.0, 2)
_STEEP, _BENT = Lipschitz(1.0), TaylorRemainder(1.0)
PROMISES_OF: dict[str, tuple[Promise, ...]] = {
    **dict.fromkeys(
        ("dipoles", "dipoles in cells", "Y 2,0", "polynomial off center", *CURVES), (_BALL, _BENT)
    ),
    **dict.fromkeys(("Y 5,3", "Y 12,-7, large", "Eq. 8"), (_BALL, _STEEP, _BENT)),
    **dict.fromkeys(
        ("gyroid", "gyroid, small", "P", "D", "Fig. 21", "plane waves"),
        (_PLANE_BALL, _STEEP, _BENT),
    ),
    **dict.fromkeys(("charges", "azimuth"), (_PLANE_BALL,)),
    **dict.fromkeys(
        (
            "hyperspherical 4,2,1",
            "hyperspherical 6,6,5, in a ball",
            "plane",
            "evaluation only",
        ),
        (_STEEP, _BENT),
    ),
    **dict.fromkeys(("lobes 3,2", "lobes 2,1, positive", "Fourier series", "smoothed"), (_BENT,)),
    **dict.fromkeys(SOURCED, (BoundedLaplacian(1.0, -1.0, 1.0, -1.0, 1.0),)),
    "screened": (_PLANE_BALL, _BENT),
    "network": (_STEEP,),
}
PAIRS = [
    (name, bound)
    for name in FIELDS
    for bound in BOUNDS
    if any(PromiseCase(one, 1.0, 1.0).accepts(bound) for one in PROMISES_OF[name])
]
SOME_PAIRS = [pair for pair in PAIRS if pair[0] in SOME]


@pytest.mark.parametrize("name", FIELDS)
def test_the_list_names_every_promise(name: str) -> None:
    """So every proof that applies is tried; a sample is recorded and not computed."""
    backend = choose_backend("double")
    sample = FIELDS[name].evaluator(backend).evaluate(backend.Array3f(0.3, 0.2, 0.1))
    zero = backend.Float(0)
    seen = sample.value, sample.value_error, SlopeRange(zero, zero)
    applies = {
        bound for bound in BOUNDS for one in sample.all_promises if bound.from_promise(one, *seen)
    }
    assert applies == {bound for field, bound in PAIRS if field == name}
    assert {type(one) for one in sample.all_promises} == {type(one) for one in PROMISES_OF[name]}


def name_of(value: object) -> str:
    return value if isinstance(value, str) else value.__name__


# Fields that are approximate: clusters far away are taken as wholes, and what that leaves out is
# bounded. And fields that jump: what they promise holds with their jumps taken out.
_DAMAGED = (bumpy_sphere(2)[0], remove_faces(bumpy_sphere(2)[1], 0.1, seed=0))
_CLOUD = (lambda x: (x, x, np.full(len(x), 4 * math.pi / len(x))))(icosphere(3)[0])
APPROXIMATE: dict[str, Field] = {
    "dipoles, accuracy 2": hk.DipolePotential(*_CLOUD, accuracy=2.0),
    "dipoles, accuracy 4": hk.DipolePotential(*_CLOUD, accuracy=4.0),
    "smoothed by tree": hk.DipolePotential(*_CLOUD, smoothing=0.1, accuracy=2.0),
    "screened by tree": hk.fields.ScreenedWindingNumber(*_CLOUD, length=0.7, method="tree"),
    "mesh by tree, accuracy 2": hk.WindingNumber(*_DAMAGED, method="tree", accuracy=2.0),
    "mesh by tree, accuracy 4": hk.WindingNumber(*_DAMAGED, method="tree", accuracy=4.0),
    "morph": hk.fields.Morph(icosphere(2), _DAMAGED, gap=0.4, w=0.15),
    "mesh, exact": hk.WindingNumber(*_DAMAGED, method="exact"),
    "closed mesh, exact": hk.WindingNumber(*icosphere(1), method="exact"),
}


# Proofs from ranges of derivatives, which `check_ray_samples` tries on every shape.
LOOKS = ("pieces", "segment", "linear-taylor", "quadratic-taylor")


def test_every_field_there_is_is_tested() -> None:
    namespaces = hk, hk.fields, hk.solids
    public = {getattr(namespace, name) for namespace in namespaces for name in namespace.__all__}
    exported = {
        kind
        for kind in filter(inspect.isclass, public)
        if issubclass(kind, Field) and not inspect.isabstract(kind)
    }
    shapes = [shape for shape, _ in SHAPES.values()]
    tested = {type(field) for field in (*FIELDS.values(), *APPROXIMATE.values(), *shapes)}
    # Those have contracts in the test files of their own.
    tested |= {hk.Blobs, hk.fields.HRBF, hk.fields.Molecule, hk.PolygonMesh, hk.solids.TubeNetwork}
    tested |= {hk.fields.RiemannSurface, hk.fields.HeightField, hk.fields.LevelCurves}
    tested |= {hk.fields.FieldSum, hk.fields.FieldProduct}
    missing = {
        kind.__name__ for kind in exported if not any(issubclass(each, kind) for each in tested)
    }
    assert missing == set(), (
        "add each to FIELDS and PROMISES_OF, or to APPROXIMATE if it jumps or truncates, or to "
        "SHAPES in tests/fields/test_shapes.py if it is a solid"
    )
    assert {hk.fields.Lobes, hk.fields.HypersphericalHarmonic, hk.solids.Thread} <= exported
    proofs = {
        kind
        for package in (enclosures, literature)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        for kind in vars(importlib.import_module(module.name)).values()
        if inspect.isclass(kind) and issubclass(kind, Enclosure) and not inspect.isabstract(kind)
    }
    # A bare parabola is made of no promise; `test_bounds` tries it by itself. Proofs from ranges
    # along a path are tried in `tests/literature`, those of combinations in `test_combined_solids`.
    promised = {
        kind for kind in proofs if kind.from_promise.__func__ is not Enclosure.from_promise.__func__
    }
    assert promised == set(BOUNDS), "a proof from a promise has a row of _EXACT in exact.py"
    others = {"SphereArcEnclosure", "ParabolaEnclosure", "MaximumEnclosure", "NegatedEnclosure",
              "ScaledEnclosure", "BandEnclosure", "ConvexityEnclosure"}  # fmt: skip
    # Those are tried in `test_riemann_surfaces`.
    others |= {"NearestBranchEnclosure", "BranchPointEnclosure"}
    ranged = {
        kind
        for kind in proofs
        if kind.from_restriction.__func__ is not Enclosure.from_restriction.__func__
    }
    bases = {"SinglePieceEnclosure"}
    assert {kind.__name__ for kind in proofs - promised - ranged} == others
    named = {type_ for name in (*PROOFS, *LOOKS) for type_ in choose_enclosures(name).kinds}
    unnamed = {kind.__name__ for kind in ranged - named} - bases
    assert unnamed == set(), "add its name to LOOKS, or to PROOFS in tests/literature"
    untried = {bound.__name__ for bound in set(BOUNDS) - {bound for _, bound in PAIRS}}
    assert untried == set(), "no field of FIELDS makes a promise that these proofs read"


@pytest.mark.slow
@pytest.mark.parametrize("bound", [*LOOKS, *PROOFS])
@pytest.mark.parametrize("name", ["torus", "rounded box", "displaced"])
def test_every_proof_from_ranges_holds(name: str, bound: str) -> None:
    points = np.random.default_rng(4).uniform(-1.5, 1.5, (80, 3))
    if (
        name == "displaced" and bound in PROOFS and bound != "interval"
    ):  # noise is known by its derivatives alone
        with pytest.raises(TypeError, match="gives ranges of derivatives alone"):
            check_ray_samples(SHAPES[name][0], points, enclosures=bound)
        return
    for precision in ("single", "double"):
        check_ray_samples(SHAPES[name][0], points, rng=5, enclosures=bound, precision=precision)


@pytest.mark.parametrize("name", SOME)
def test_fields_keep_their_promises(name: str) -> None:
    field = FIELDS[name]
    levels = (1.0, 5.0) if isinstance(field, hk.SolidAngle) else ()
    check_field(field, count=60, directions=4, levels=(field.default_level, *levels))


def test_an_approximate_field_keeps_its_promises() -> None:
    check_field(APPROXIMATE["dipoles, accuracy 2"], count=60, directions=4)


def samples(field: Field, x: np.ndarray, fine: float = 1.0) -> tuple[Sample, Any]:
    """A sample in double precision and a function that makes its numbers arrays (n,) or (n, 3).

    fine: the accuracy scale, as `VariableAccuracy.at` takes it.
    """
    backend = choose_backend("double")
    p, seen = to_vector3(backend, x), field.evaluator(backend)
    if seen.jumps is not None:
        up = backend.Array3f(0, 0, 1)
        nowhere = JumpCrossing(0.0, backend.UInt32(NO_FACET), backend.Float(0), up)
        ahead = seen.jumps.initial_offset(p, up, backend.Float(0), backend.Bool(True))
        seen = seen.jumps.continuation(p, up, nowhere, nowhere, ahead)
    assert seen.variable_accuracy is not None
    sample = seen.variable_accuracy.at(backend.Float(fine)).evaluate(p)

    def on_host(one: Any) -> np.ndarray:
        array = to_numpy(one) if dr.is_array_v(type(one)) else np.asarray(one)
        return np.broadcast_to(array, (len(x), *array.shape[1:]))

    return sample, on_host


def check_promises(sample: Sample, on_host: Any, x: np.ndarray, lift: Any) -> None:
    """The exact function, continued, moves within each promise: `lift` says how far."""
    value, gradient = on_host(sample.value), on_host(sample.gradient)
    rng, largest = np.random.default_rng(3), 0.0
    for known in sample.all_promises:
        reach = np.minimum(on_host(known.radius), 10.0)
        for share in (0.3, 0.9, 0.999):
            d = rng.normal(size=x.shape)
            d *= (share * reach / np.linalg.norm(d, axis=1))[:, None]
            moved = lift(x, d)
            if isinstance(known, HarmonicBall):
                up, down = on_host(known.upper) - value, on_host(known.lower) - value
            else:
                assert isinstance(known, TaylorRemainder)
                length = np.linalg.norm(d, axis=1)
                room = 0.5 * on_host(known.constant) * length**2
                room = room + on_host(sample.gradient_error) * length
                moved = moved - (gradient * d).sum(axis=1)
                up, down = room, -room
            assert (moved >= down - 1e-9).all()
            assert (moved <= up + 1e-9).all()
            largest = max(largest, float((np.abs(moved) / np.maximum(up, -down)).max()))
    assert largest > 0.05  # the promises are not empty


def spread(n: int, seed: int = 2) -> np.ndarray:
    """Points around the unit sphere, half of them close to it."""
    x = np.random.default_rng(seed).uniform(-1.6, 1.6, (n, 3))
    near = x[: n // 2]
    near *= (1 + 0.1 * near[:, :1]) / np.linalg.norm(near, axis=1, keepdims=True)
    return x


@pytest.mark.few(1)
@pytest.mark.parametrize("fine", [True, False])
@pytest.mark.parametrize("accuracy", [2.0, 3.0, 4.0])
def test_what_a_tree_of_dipoles_leaves_out_is_within_its_bounds(
    accuracy: float, fine: bool
) -> None:
    points, normals, areas = _CLOUD
    x, exact = spread(400), dipole_sum(points, areas[:, None] * normals)
    sample, on_host = samples(hk.DipolePotential(*_CLOUD, accuracy=accuracy), x, fine)
    value, gradient = exact(x)
    off = np.abs(on_host(sample.value) - value)
    slant = np.linalg.norm(on_host(sample.gradient) - gradient, axis=1)
    assert (off <= on_host(sample.value_error)).all()
    assert (slant <= on_host(sample.gradient_error) + 1e-12).all()
    assert off.max() > 1e-6  # there is something to bound
    check_promises(sample, on_host, x, lambda x, d: exact(x + d)[0] - value)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_one_dipole_attains_its_curvature_promises(scale: float) -> None:
    """Straight ahead, at the end of each reach: f leaves its tangent by all that is allowed, so
    that a promise smaller by a thousandth, or one that reaches farther by that, would break.

    Two others, of next to no area, keep it from being looked at as a node of its own."""
    points, areas = np.zeros((3, 3)), np.array([1, 1e-14, 1e-14])
    points[1:, 0] = 20 * scale, -20 * scale
    field = hk.DipolePotential(points, [[0.0, 0, 1]] * 3, scale**2 * areas)
    x = scale * np.array([[0.0, 0.0, h] for h in (-0.3, -1.0, -7.0)])
    sample, on_host = samples(field, x)
    value, slope = on_host(sample.value), on_host(sample.gradient)[:, 2]
    np.testing.assert_allclose(value, (scale / x[:, 2]) ** 2, rtol=1e-12)
    seen = 0
    for known in sample.all_promises:
        if isinstance(known, TaylorRemainder):
            t = on_host(known.radius)
            left = (scale / (x[:, 2] + t)) ** 2 - value - slope * t
            share = left / (0.5 * on_host(known.constant) * t * t)
            assert ((share <= 1) & (share >= 1 - 2e-4)).all()
            seen += 1
    assert seen == 3


@pytest.mark.few(1)
@pytest.mark.parametrize("fine", [True, False])
@pytest.mark.parametrize("accuracy", [2.0, 3.0, 4.0])
@pytest.mark.parametrize("order", [*(pytest.param(k, marks=pytest.mark.slow) for k in (0, 1)), 2])
def test_what_a_tree_of_triangles_leaves_out_is_within_its_bounds(
    order: int, accuracy: float, fine: bool
) -> None:
    vertices, faces = _DAMAGED
    x, exact = spread(400), winding_sum(vertices[faces])
    field = hk.WindingNumber(vertices, faces, method="tree", order=order, accuracy=accuracy)
    sample, on_host = samples(field, x, fine)
    value, gradient = exact(x), np.zeros_like(x)
    # Biot and Savart for all three edges of every triangle, each with an integral of its own.
    for k in range(3):
        a, b = (vertices[faces[:, i]] - x[:, None] for i in (k, (k + 1) % 3))
        la, lb = np.linalg.norm(a, axis=2), np.linalg.norm(b, axis=2)
        weight = (1 / la + 1 / lb) / (la * lb + (a * b).sum(axis=2))
        gradient += (weight[..., None] * np.cross(a, b)).sum(axis=1) / (4 * math.pi)
    off = np.abs(on_host(sample.value) - value)
    slant = np.linalg.norm(on_host(sample.gradient) - gradient, axis=1)
    assert (off <= on_host(sample.value_error)).all()
    assert (slant <= on_host(sample.gradient_error) + 1e-9).all()
    assert off.max() > 1e-6

    def lift(x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """How far w moves with its jumps, which are whole numbers, taken out on the way."""
        way = np.linspace(0, 1, 65)[:, None, None] * d + x
        w = exact(way.reshape(-1, 3)).reshape(65, -1)
        return (np.unwrap(w, axis=0, period=1.0) - w[0])[-1]

    check_promises(sample, on_host, x, lift)


@pytest.mark.few(1)
@pytest.mark.parametrize("fine", [True, False])
def test_what_cells_of_boundaries_leave_out_is_within_its_bounds(fine: bool) -> None:
    vertices, faces = bumpy_sphere(3)
    faces = faces[vertices[faces].mean(axis=1)[:, 2] > 0.1]
    x, exact = spread(300), winding_sum(vertices[faces])
    field = hk.WindingNumber(vertices, faces, method="exact", cells=True)
    sample, on_host = samples(field, x, fine)
    off = on_host(sample.value) - exact(x)
    off = np.abs(off if fine else off - np.round(off))
    assert (off <= on_host(sample.value_error) + 1e-12).all()
    assert (off.max() > 1e-9) != fine

    def lift(x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """How far w moves with its jumps, which are whole numbers, taken out on the way."""
        way = np.linspace(0, 1, 65)[:, None, None] * d + x
        w = exact(way.reshape(-1, 3)).reshape(65, -1)
        return (np.unwrap(w, axis=0, period=1.0) - w[0])[-1]

    check_promises(sample, on_host, x, lift)


@pytest.mark.few(1)
@pytest.mark.parametrize("field", ["dipoles, accuracy 4", "mesh by tree, accuracy 4"])
def test_lanes_are_looked_at_as_closely_as_each_asks(field: str) -> None:
    x = spread(400)
    mask = np.random.default_rng(0).random(len(x)) < 0.5
    close, rough, mixed = (samples(APPROXIMATE[field], x, how)[0] for how in (True, False, mask))
    for name in ("value", "value_error", "gradient_error"):
        a, b, c = (to_numpy(getattr(one, name)) for one in (close, rough, mixed))
        np.testing.assert_array_equal(c, np.where(mask, a, b))
        assert name == "value" or (b > 2 * a).mean() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", APPROXIMATE)
def test_approximate_and_jumping_fields_keep_their_promises_at_many_points(name: str) -> None:
    check_field(APPROXIMATE[name], rng=1, count=150)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_fields_keep_their_promises_at_many_points(name: str) -> None:
    field = FIELDS[name]
    levels = (0.6, 3.0, 5.0, 9.0) if isinstance(field, hk.SolidAngle) else ()
    check_field(field, rng=0, count=800, levels=(field.default_level, *levels))


@pytest.mark.parametrize(("name", "bound"), SOME_PAIRS, ids=name_of)
def test_no_level_lies_within_a_step(name: str, bound: type[Enclosure]) -> None:
    assert check_steps(FIELDS[name], bound, count=150) > 0


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize(("name", "bound"), PAIRS, ids=name_of)
def test_no_level_lies_within_many_steps(name: str, bound: type[Enclosure], precision: str) -> None:
    found = check_steps(FIELDS[name], bound, rng=1, count=2000, precision=precision)  # type: ignore[arg-type]
    assert found > 0


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize(("name", "bound"), SOME_PAIRS, ids=name_of)
def test_mutation_is_seen_in_every_field(name: str, bound: type[Enclosure], precision: str) -> None:
    """A thousandth more is too much."""
    with pytest.raises(BrokenPromiseError):
        check_steps(FIELDS[name], mutated_enclosure(bound, 1.001), count=150, precision=precision)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), PAIRS, ids=name_of)
def test_mutation_is_seen_in_all_fields(name: str, bound: type[Enclosure]) -> None:
    with pytest.raises(BrokenPromiseError):
        check_steps(FIELDS[name], mutated_enclosure(bound, 1.001))


def test_levels_inside_a_step_are_seen_without_a_reference() -> None:
    """Where the bound is attained in the field, sampling alone finds a step too long."""

    class Foreign(Enclosure):
        """A proof that `tests.oracles.exact` knows nothing about."""

        factor = 1.0

        def __init__(self, cone: LipschitzEnclosure) -> None:
            self.cone = cone

        @classmethod
        def from_promise(cls, *given: Any) -> Any:
            cone = LipschitzEnclosure.from_promise(*given)
            return None if cone is None else cls(cone)

        def free_length(self, gaps: Any) -> Any:
            return self.factor * self.cone.free_length(gaps)

    class TooLong(Foreign):
        factor = 1.05

    class AlongX(Plane):
        """All directions look along the gradient."""

        def evaluate(self, p: Any) -> Sample:
            return Sample(dr.norm(p), p / dr.norm(p), (Lipschitz(1.0),))

    assert check_steps(AlongX(), Foreign) == 1
    with pytest.raises(BrokenPromiseError, match="a level lies within the step"):
        check_steps(AlongX(), TooLong, count=4000)


class LineCharge(Field):
    """3 - log r about the z axis: above 1 within e^2 of it, harmonic in the plane."""

    default_level = 2.5
    domain = hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> Sample:
        square = p.x * p.x + p.y * p.y
        ball = HarmonicBall(dr.sqrt(square), 1.0, math.inf, 2)
        gradient = type(p)(-p.x / square, -p.y / square, 0.0)
        return Sample(3 - 0.5 * dr.log(square), gradient, (ball,))


@dataclasses.dataclass
class Broken(Field):
    """Another field, with something wrong."""

    of: Field
    change: Callable[[Any, Sample], Sample]
    differentiable: float = 0.0
    slope: float = 1.0
    around: hk.Ball | None = None

    def __post_init__(self) -> None:
        self.period = self.of.period  # type: ignore[misc]
        self.default_level = self.of.default_level
        self.domain = self.of.domain

    def evaluate(self, p: Any) -> Sample:
        return self.change(p, self.of.evaluate(p))

    def extent(self, levels: tuple[float, ...]) -> Any:
        return self.around or self.of.extent(levels)

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        return BrokenEvaluator(self, backend)


class BrokenEvaluator(hk.fields.SampleEvaluator):
    def differentiable_value(self, p: Any) -> Any:
        value, field = super().differentiable_value(p), cast("Broken", self.field)
        return dr.replace_grad(value + field.differentiable, field.slope * value)


def changed(sample: Sample, **new: Any) -> Sample:
    return dataclasses.replace(sample, **new)


def with_known(sample: Sample, **new: Any) -> Sample:
    return changed(
        sample,
        promises=tuple(dataclasses.replace(one, **new) for one in sample.all_promises),
        alternative_promises=(),
    )


def narrower(factor: float) -> Callable[[Any, Sample], Sample]:
    def change(p: Any, s: Sample) -> Sample:
        balls = [one for one in s.all_promises if isinstance(one, HarmonicBall)]
        assert balls
        narrow = (
            dataclasses.replace(
                ball,
                lower=s.value + factor * (ball.lower - s.value),
                upper=s.value + factor * (ball.upper - s.value),
            )
            for ball in balls
        )
        return changed(s, promises=tuple(narrow), alternative_promises=())

    return change


def only(kind: type, **scaled: float) -> Callable[[Any, Sample], Sample]:
    """Keep promises of a kind, some of their numbers multiplied."""

    def change(p: Any, s: Sample) -> Sample:
        kept = [one for one in s.all_promises if isinstance(one, kind)]
        return changed(
            s,
            promises=tuple(
                dataclasses.replace(one, **{k: getattr(one, k) * x for k, x in scaled.items()})
                for one in kept
            ),
            alternative_promises=(),
        )

    return change


def kinked(p: Any, s: Sample) -> Sample:
    """Value and gradient agree, but the function is not harmonic."""
    bend = 1e-3 * dr.squared_norm(p)
    return changed(s, value=s.value + bend, gradient=s.gradient + 2e-3 * p)


COIL = CURVES["coil"]
TREFOIL = CURVES["trefoil"]
GYROID = REAL["gyroid"]
POLYNOMIAL = REAL["Y 5,3"]
TREE = APPROXIMATE["dipoles, accuracy 2"]
BROKEN: dict[str, tuple[Field, str]] = {
    "truncation not told": (
        Broken(TREE, lambda p, s: changed(s, value_error=0.0, gradient_error=0.0)),
        "gradient is not that of the value",
    ),
    "gradient of a tree a little off": (
        Broken(TREE, lambda p, s: changed(s, gradient=s.gradient * 1.0001)),
        "gradient is not that of the value at more than half",
    ),
    "range of a tree too small": (
        Broken(APPROXIMATE["dipoles, accuracy 4"], narrower(0.03)),
        "HarmonicBall: f leaves",
    ),
    "gradient a little off": (
        Broken(TREFOIL, lambda p, s: changed(s, gradient=s.gradient * 1.0001)),
        "gradient is not that of the value",
    ),
    "gradient turned round": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, gradient=-s.gradient)),
        "gradient is not that of the value",
    ),
    "not harmonic": (Broken(POLYNOMIAL, kinked), "not harmonic"),
    "infinite gradient": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, gradient=s.gradient / 0.0)),
        "gradient is not finite",
    ),
    "a NaN value": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, value=dr.select(p.x > 0.5, dr.nan, s.value))),
        "value is not a finite number",
    ),
    "a jump that is no period": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, value=dr.select(p.x > 0, s.value + 9, s.value))),
        "HarmonicBall|gradient",
    ),
    "nothing known": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, promises=(), alternative_promises=())),
        "nothing is known",
    ),
    "range of the paper": (
        hk.SolidAngle(example_curves.coil(5, 80, height=0.2), lift_bound="paper"),
        "HarmonicBall: f leaves",
    ),
    "range too narrow": (Broken(TREFOIL, narrower(0.3)), "HarmonicBall: f leaves"),
    "range of charges with a lid": (
        Broken(OWN["charges"], lambda p, s: with_known(s, upper=s.value + 40)),
        "HarmonicBall: f leaves",
    ),
    "ball too large": (
        Broken(OWN["charges"], only(HarmonicBall, radius=1.5)),
        "HarmonicBall: f leaves|Laplacian",
    ),
    "value outside its range": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, value=s.value + 100)),
        "value is not within",
    ),
    "no ends": (
        Broken(OWN["charges"], lambda p, s: with_known(s, lower=-math.inf)),
        "both ends are infinite",
    ),
    "five dimensions": (
        Broken(OWN["charges"], lambda p, s: with_known(s, dimension=5)),
        "dimension 5",
    ),
    "no radius": (
        Broken(OWN["charges"], lambda p, s: with_known(s, radius=0 * s.value)),
        "no step is possible",
    ),
    "Lipschitz constant too small": (
        Broken(GYROID, only(Lipschitz, constant=0.8)),
        "Lipschitz: f leaves",
    ),
    "curvature too small": (
        Broken(GYROID, only(TaylorRemainder, constant=0.8)),
        "TaylorRemainder: f leaves",
    ),
    "error too small": (
        Broken(POLYNOMIAL, lambda p, s: changed(s, value=s.value + 1e3 - 1e3)),
        "single precision",
    ),
    "differentiable value": (
        Broken(POLYNOMIAL, lambda p, s: s, differentiable=1e-3),
        "differentiable_value",
    ),
    "differentiable value that is a constant": (
        Broken(POLYNOMIAL, lambda p, s: s, slope=0.0),
        "differentiable_value does not have the gradient",
    ),
    "extent too small": (
        Broken(COIL, lambda p, s: s, around=hk.Ball(radius=0.5)),
        "extent: the surface",
    ),
}


@pytest.mark.few(5)
@pytest.mark.parametrize("name", BROKEN)
def test_broken_promises_are_seen(name: str) -> None:
    field, message = BROKEN[name]
    with pytest.raises(BrokenPromiseError, match=message):
        check_field(field, count=400)


# Promises that are attained, wrong by 5 %: field, kind of promise, and what is multiplied.
BY_5_PERCENT: dict[str, Field] = {
    "radius of a line charge": Broken(LineCharge(), only(HarmonicBall, radius=1.05)),
    "radius of a line charge, by half": Broken(LineCharge(), only(HarmonicBall, radius=1.5)),
    "radius of charges": Broken(OWN["charges"], only(HarmonicBall, radius=1.05)),
    "radius of charges, by a fifth": Broken(OWN["charges"], only(HarmonicBall, radius=1.2)),
    "radius of an angle": Broken(OWN["azimuth"], only(HarmonicBall, radius=1.05)),
    "range of an angle": Broken(OWN["azimuth"], narrower(0.95)),
    "slope of a plane": Broken(OWN["plane"], only(Lipschitz, constant=0.95)),
    "slope of a gyroid": Broken(GYROID, only(Lipschitz, constant=0.95)),
    "second derivatives of a gyroid": Broken(GYROID, only(TaylorRemainder, constant=0.95)),
    "slope of P": Broken(REAL["P"], only(Lipschitz, constant=0.95)),
    "second derivatives of P": Broken(REAL["P"], only(TaylorRemainder, constant=0.95)),
    "slope of D": Broken(REAL["D"], only(Lipschitz, constant=0.95)),
    "second derivatives of a small gyroid": Broken(
        REAL["gyroid, small"], only(TaylorRemainder, constant=0.95)
    ),
    "second derivatives of D": Broken(REAL["D"], only(TaylorRemainder, constant=0.95)),
    "slope of plane waves": Broken(REAL["plane waves"], only(Lipschitz, constant=0.95)),
    "second derivatives of plane waves": Broken(
        REAL["plane waves"], only(TaylorRemainder, constant=0.95)
    ),
    "second derivatives of a Fourier series": Broken(
        REAL["Fourier series"], only(TaylorRemainder, constant=0.95)
    ),
    "range of Y 5,3": Broken(POLYNOMIAL, narrower(0.95)),
    "range of Eq. 8": Broken(REAL["Eq. 8"], narrower(0.95)),
    "range of Y 2,0": Broken(REAL["Y 2,0"], narrower(0.95)),
    "second derivatives of Y 2,0": Broken(REAL["Y 2,0"], only(TaylorRemainder, constant=0.95)),
    "radius of a triangle": Broken(CURVES["triangle"], only(HarmonicBall, radius=1.05)),
    "radius of a flat polygon": Broken(CURVES["flat"], only(HarmonicBall, radius=1.05)),
    "range of a flat polygon": Broken(CURVES["flat"], narrower(0.95)),
    "radius of circles": Broken(CURVES["ring of circles"], only(HarmonicBall, radius=1.05)),
    "range of a polygon with holes": Broken(CURVES["holes"], narrower(0.95)),
    "radius of dipoles": Broken(FIELDS["dipoles"], only(HarmonicBall, radius=1.05)),
    "radius of a screened cloud": Broken(FIELDS["screened"], only(HarmonicBall, radius=1.05)),
    "radius of a broken mesh": Broken(APPROXIMATE["mesh, exact"], only(HarmonicBall, radius=1.05)),
    "ends of the Laplacian of a gyroid": Broken(
        OWN["gyroid by its Laplacian"],
        only(BoundedLaplacian, laplacian_lower=0.95, laplacian_upper=0.95),
    ),
    "ends of the Laplacian in matter": Broken(
        OWN["matter"], only(BoundedLaplacian, laplacian_lower=0.95, laplacian_upper=0.95)
    ),
    "radius in matter": Broken(OWN["matter"], only(BoundedLaplacian, radius=1.05)),
    "slope of a sphere": Broken(SHAPES["sphere"][0], only(Lipschitz, constant=0.95)),
    "slope of a Julia set": Broken(SHAPES["julia"][0], only(Lipschitz, constant=0.95)),
    "slope of a formula": Broken(
        hk.expression("sin(x) + 2*y", domain=hk.Ball(radius=2.0)), only(Lipschitz, constant=0.95)
    ),
}


@pytest.mark.few(4)
@pytest.mark.parametrize("name", BY_5_PERCENT)
def test_promises_wrong_by_5_percent_are_found(name: str) -> None:
    found = "f leaves what is promised here|the Laplacian is not between its ends"
    with pytest.raises(BrokenPromiseError, match=found):
        check_field(BY_5_PERCENT[name])


def test_a_line_charge_keeps_its_promise() -> None:
    check_field(LineCharge())


def test_failure_names_the_point() -> None:
    field = Broken(POLYNOMIAL, lambda p, s: changed(s, gradient=s.gradient * 1.01))
    with pytest.raises(BrokenPromiseError, match=r"point \[0\.25, 0\.5, -0\.25\]; 1 of 1 points"):
        check_field(field, np.array([[0.25, 0.5, -0.25]]))
