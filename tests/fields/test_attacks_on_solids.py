"""Cases that attacks on solids and formulas found, kept as they were."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.arithmetic import Jet
from harnack.backend import choose_backend

PRECISIONS = ("single", "double")
CREASE = hk.expression(lambda x, y, z: hk.math.maximum(x, y, z) - 0.3)


@pytest.mark.parametrize(
    ("axis", "degrees", "start", "end"),
    [
        ("x", 90, (0, 1, 0), (0, 0, 1)),
        ("y", 90, (0, 0, 1), (1, 0, 0)),
        ("z", 90, (1, 0, 0), (0, 1, 0)),
        ((1, 1, 1), 120, (1, 0, 0), (0, 1, 0)),
    ],
)
def test_solids_turn_anticlockwise(axis: Any, degrees: float, start: Any, end: Any) -> None:
    """As seen from the end of the axis; they turned clockwise."""
    ball = hk.Sphere(0.1, start).rotated(degrees, axis)
    assert ball.value(np.array([end], dtype=float))[0] == pytest.approx(-0.1, abs=1e-6)


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("solid", "o", "d", "t"),
    [
        (hk.solids.DoubleCone(), (0, 0, 3), (0, 0, -1), 3.0),
        (hk.solids.DoubleCone().rotated(90, "x").translated((0, 3, 0)), (0, 0, 0), (0, 1, 0), 3.0),
        (
            hk.solids.DoubleCone().twisted(math.degrees(2.0)) - hk.Torus(1.0, 0.2),
            (0, 0, 3), (0, 0, -1), 3.0,
        ),
        (hk.Torus(0.5, 0.75), (0, 0, 3), (0, 0, -1), 3 - np.sqrt(0.75**2 - 0.5**2)),
        (hk.solids.Superellipsoid((1.0, 1.0)), (-3, 0, 0), (1, 0, 0), 2.0),
        (hk.solids.Supertorus((1.0, 3.0), 0.75, 0.25), (-3, 0, 0), (1, 0, 0), 2.0),
        (CREASE, (-1, 2.5, 2.5), (1, -2, -2), 3.3),
    ],
    ids=["cone", "moved", "combined", "spindle", "octahedron", "diamond", "crease"],
)  # fmt: skip
def test_rays_along_creases_hit(solid: Any, o: Any, d: Any, t: float, precision: Any) -> None:
    """Where f has no gradient but a derivative along the ray; they ran out of steps."""
    hits = hk.trace(solid, [o], [d], precision=precision)
    assert hits.is_hit.all()
    assert hits.t[0] == pytest.approx(t, abs=2e-3)
    assert hits.evaluations[0] < 40


def test_what_is_near_a_level_and_grown_is_not_clipped() -> None:
    """Far from the blobs the value is 0, within 0.9 + 0.2 of the level 1: all but a core is inside,
    but the whole was clipped to where blobs are."""
    blobs = hk.Blobs([[0, 0, 0], [0.9, 0, 0]], radii=0.5)
    solid = hk.solid(blobs, around=(1.0, 0.9)).offset(0.2) & hk.Sphere(2.0)
    hits = hk.trace(solid, [[0, 1.8, 3.0]], [[0, 0, -1.0]])
    assert hits.is_hit.all()
    assert hits.t[0] == pytest.approx(3 - np.sqrt(4 - 1.8**2), abs=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("power", [1.0, 1.5])
def test_shrunk_blends_are_not_clipped(power: float) -> None:
    """Where both solids are deep inside, their blend is lower than the lesser less the radius: rays
    along their common axis hit the clipped volume."""
    two = (hk.Sphere(1.0), hk.Sphere(1.0).translated((0.6, 0.0, 0.0)))
    shrunk = two[0].blended(two[1], 0.1, power=power).offset(-0.3)
    factor = 2 ** (1 / power)

    # In the plane of symmetry both distances are m, and f = 0.1 - factor (0.1 - m) + 0.3.
    m = 0.1 - 0.4 / factor
    hits = hk.trace(shrunk, [[0.3, 0, 3.0]], [[0, 0, -1.0]])
    assert hits.is_hit.all()
    assert hits.t[0] == pytest.approx(3 - np.sqrt((1 + m) ** 2 - 0.09), abs=1e-3)


@pytest.mark.parametrize("enclosures", [None, "affine", "bottom-up-quadratic", "interval"])
def test_powers_of_numbers(enclosures: Any) -> None:
    """2**x was a TypeError of Dr.Jit, when it was traced."""
    field = hk.expression(lambda x, y, z: 2**x - y - 1)
    hits = hk.trace(field, [[2.0, 0, 0]], [[0, 1.0, 0]], t_max=9.0, enclosures=enclosures)
    assert hits.t[0] == pytest.approx(3.0, abs=1e-3)
    with pytest.raises(ValueError, match="the base must be positive"):
        hk.expression(lambda x, y, z: (-2) ** x - y)


def test_little_is_lost_far_from_the_origin() -> None:
    """Ten units away 2 % of the rays at a difference ran out of steps in single precision, just
    outside the tolerance: the rounding of what is carved was taken off twice."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    o = -3 * d + 0.4 * rng.normal(size=(2000, 3)) + [10.0, -5.0, 2.5]
    walls = hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3)) & hk.Sphere(1.0)
    for solid in (hk.Sphere(1.0) - hk.Torus(0.8, 0.3), walls):
        far = solid.translated((10.0, -5.0, 2.5))
        hits = hk.trace(far, o, d, tolerance=1e-4, precision="single")
        assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
        assert hits.evaluations.mean() < 10


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: hk.expression(lambda x, y, z: None), TypeError, "returned an object of type None"),
        (lambda: hk.expression(lambda x, y, z: x if x > 0 else y), TypeError, "cannot decide by"),
        (lambda: hk.expression(lambda x, y, z: 1.0 if x == 0 else y), TypeError, "left - right"),
        (lambda: hk.expression(lambda x, y, z: np.ones(2) * x), TypeError, "type ndarray"),
        (lambda: hk.expression(lambda x, y, z: x * np.ones(2)), TypeError, "type ndarray"),
        (
            lambda: hk.expression(lambda x, y, z: hk.math.maximum(x, None)),
            TypeError,
            "type NoneType",
        ),
        (lambda: hk.expression(lambda x, y, z: x ** "2"[1:]), TypeError, "exponent of x"),  # type: ignore[operator]
        (lambda: hk.expression(lambda x, y, z: np.float64(-2) ** x), ValueError, "must be pos"),
        (lambda: hk.solid(hk.Gyroid(1.0), between=(1.0,)), ValueError, "numbers, two of them"),  # type: ignore[arg-type]
        (lambda: hk.solid(hk.Gyroid(1.0), around=3.0), ValueError, "numbers, two of them"),  # type: ignore[arg-type]
        (lambda: hk.Sphere(1.0).tapered(0.0, 1.0), ValueError, "two numbers each"),  # type: ignore[arg-type]
    ],
)  # fmt: skip
def test_bad_input_is_named(make: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def test_levels_may_be_numbers_of_numpy() -> None:
    assert isinstance(hk.solid(hk.Gyroid(1.0), below=np.float32(0.25)), hk.solids.Solid)  # type: ignore[arg-type]


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("formula", "value"),
    [
        (lambda x: np.sin(x**0), np.sin(1.0)),
        (lambda x: hk.math.cos(0 * x + 0.3), np.cos(0.3)),
        (lambda x: 0 * x + 0.1, 0.1),
        (lambda x: hk.math.norm(0 * x + 0.1, 0 * x + 0.2), np.hypot(0.1, 0.2)),
        (lambda x: x**0 / 3, 1 / 3),
    ],
)
def test_constants_made_of_coordinates_are_held(formula: Any, value: float, precision: Any) -> None:
    """At points and at the start of pieces their jets did not know of which precision they are:
    sines of them were those of single precision, and were not held by their ranges."""
    backend = choose_backend(precision)
    p, d = (backend.Array3f(*one) for one in ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0)))
    along = Jet.along_ray(p, d, backend.Float(0), backend.Float(1))[0]
    jets = [formula(one) for one in (along, Jet.at_point(p)[0])]
    for one in (jets[0].value, jets[0].jet_at_start.value, jets[1].value):
        low, high = (np.float64((backend.Float(0) + end)[0]) for end in (one.lower, one.upper))
        if one.is_literal:  # numbers of the precision themselves
            low, high = one.lower, one.upper
        assert low <= value <= high
        assert high - low < 1e2 * float(dr.epsilon(backend.Float))


def test_functions_of_numpy_with_the_same_meaning() -> None:
    """numpy.arctan and its like had no ranges, although harnack.math.atan has."""
    hits = hk.trace(
        hk.expression(lambda x, y, z: np.arctan(x) - 0.5), [[-2.0, 0, 0]], [[1.0, 0, 0]]
    )
    assert hits.t[0] == pytest.approx(2 + np.tan(0.5), abs=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("solid", "o", "d", "roots"),
    [
        # Rays from the origin ended where their box touches the solid, f not yet seen off 0.
        (hk.Cuboid((0.64, 1.78, 1.606)).scaled(100), (0, 0, 0), (0, 0, 1), [80.3]),
        # Behind a flat solid f rose too little beyond its box for the side to be known.
        (hk.Cuboid((200, 200, 2)), (-50, 0, 1 - 1e-3), (1, 0, 2e-5), [50]),
        # On the rim the gradient is not known, and the ray was left without a gap to go on with.
        (hk.Cylinder(100, 2), (150, 0, 1.01), (-1, 0, -1e-4), [100, 250]),
    ],
    ids=["origin", "flat", "rim"],
)  # fmt: skip
def test_no_crossing_is_lost(solid: Any, o: Any, d: Any, roots: Any, precision: Any) -> None:
    settings: dict[str, Any] = {"precision": precision, "tolerance": 1e-4}
    crossings = hk.crossings(solid, [o], [d], max_crossings=4, **settings)
    assert crossings.status[0] == hk.RayStatus.MISS  # there are no others
    assert crossings.count[0] == len(roots)
    off = 2.0 if d[2] == 2e-5 else 1e-2  # at so small an angle rounding moves it far
    assert crossings.t[0, : len(roots)] == pytest.approx(roots, abs=off)
    first = hk.trace(solid, [o], [d], require_crossing=True, **settings)
    assert first.t[0] == pytest.approx(roots[0], abs=off)


def test_the_rounding_of_one_part_makes_no_hit_inside_of_another() -> None:
    """385,000 sizes away the twisted part is known to 6 of 4, the other is 3.85 to 1e-5: their
    greatest is not zero, and was called a hit with an uncertainty of 1.5e-5."""
    twisted = hk.solid(hk.expression("x*y*z - 0.089375"), below=0).twisted(
        math.degrees(1.3472932840911636)
    )
    hill = hk.solid(hk.expression("exp(-x^2 - y^2) - z - 0.644"), below=0)
    solid = (
        (twisted & ~hill).scaled(1e-5).translated((-1.080524678e-4, 2.767405466e-4, -4.17053243e-5))
    )
    o = [[-1.0094386616119177e-4, 2.895665143994727e-4, -5.2641241924609245e-5]]
    hits = hk.trace(solid, o, [[0, 0, 1]], precision="single", tolerance=1e-9)
    assert hits.status[0] == hk.RayStatus.OUT_OF_STEPS


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["trace", "crossings"])
def test_crossings_at_creases_lie_on_the_surface(verb: str) -> None:
    """The cubic between two points with a crease between them had its root anywhere: |f| was up to
    500,000 tolerances. What changes sign is the level to within the tolerance."""
    steep = hk.solid(hk.expression("x*y*z - 1"), below=0)
    gentle = hk.solid(hk.expression("sin(x) + sin(y) + sin(z) - 1"), below=0)
    rng = np.random.default_rng(0)
    o, d = rng.uniform(-30, 30, (4000, 3)), rng.normal(size=(4000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    settings: dict[str, Any] = {"tolerance": 1e-6, "precision": "double"}
    solid = steep | gentle
    if verb == "trace":
        hits: Any = hk.trace(solid, o, d, require_crossing=True, **settings)
    else:
        hits = hk.crossings(solid, o, d, max_crossings=4, **settings)
    x = np.asarray(hits.position)[np.isfinite(hits.t)]
    assert len(x) > 3000
    value = solid.value(x, precision="double")
    slope = np.linalg.norm(solid.gradient(x, precision="double"), axis=1)
    assert (np.abs(value) / slope).max() < 1.05e-6
