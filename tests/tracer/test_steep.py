"""Vertical tangents, poles, and places without a value: hits are there, and rays get past.

The oracle is the formula in double precision: dense samples along rays for first changes of sign,
and points around a hit for whether the surface is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import harnack as hk
from harnack.arithmetic.operators import tally_of
from harnack.backend import choose_backend, to_numpy
from harnack.enclosures import LevelGaps, Levels, choose_enclosures
from harnack.enclosures.samples import Ray
from harnack.tracer.steep import SteepPlace

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import BoolArray, FloatArray, Precision

# Texts, the same functions of arrays, half a side of the box, and how many rays of 300 meet them.
FORMULAS: dict[str, tuple[str, Callable[..., Any], float]] = {
    "astroid": (
        "abs(x)^(2/3) + abs(y)^(2/3) + abs(z)^(2/3) = 1",
        lambda x, y, z: abs(x) ** (2 / 3) + abs(y) ** (2 / 3) + abs(z) ** (2 / 3) - 1,
        1.5,
    ),
    "root of a product": ("sqrt(x*y*z) = 0.5", lambda x, y, z: np.sqrt(x * y * z) - 0.5, 2.0),
    "logarithm": ("log(x) = y", lambda x, y, z: np.log(x) - y, 1.5),
    "heart": (
        "(x^2 + 9/4*y^2 + z^2 - 1) = (x^2*z^3 + 9/80*y^2*z^3)^(1/3)",
        lambda x, y, z: (
            (x**2 + 9 / 4 * y**2 + z**2 - 1) - (x**2 * z**3 + 9 / 80 * y**2 * z**3) ** (1 / 3)
        ),
        1.5,
    ),
    "powers": (
        "((abs(x)^10 + abs(y)^10)^(1/15) + abs(z)^(2/3))^1.5 = 1",
        lambda x, y, z: ((abs(x) ** 10 + abs(y) ** 10) ** (1 / 15) + abs(z) ** (2 / 3)) ** 1.5 - 1,
        1.5,
    ),
}


def rays(half: float, count: int = 300) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    o = rng.normal(size=(count, 3))
    o *= 3 * half / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-half, half, (count, 3)) - o
    return o, d / np.linalg.norm(d, axis=1)[:, None]


def first_roots(f: Callable[..., Any], o: FloatArray, d: FloatArray, half: float) -> FloatArray:
    """The first change of sign on each ray in the box, to 1e-3; inf where there is none."""
    ends = np.sort([(-half - o) / d, (half - o) / d], axis=0)
    start, end = ends[0].max(1), ends[1].min(1)
    t = start[:, None] + np.linspace(0, 1, 4001) * np.maximum(end - start, 0)[:, None]
    with np.errstate(all="ignore"):
        values = f(*np.moveaxis(o[:, None] + t[..., None] * d[:, None], 2, 0))
    changes = (values[:, 1:] * values[:, :-1] <= 0) & (start < end)[:, None]
    return np.where(changes.any(1), t[np.arange(len(t)), changes.argmax(1)], np.inf)


@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name",
    [
        "astroid",
        "root of a product",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("logarithm", "heart", "powers")),
    ],
)
def test_hits_are_where_the_surface_is(name: str, precision: Precision) -> None:
    """Rays beside a cusp hit it far from the surface, or stopped there and where there is no f."""
    text, f, half = FORMULAS[name]
    o, d = rays(half)
    truth = first_roots(f, o, d, half)
    box = hk.Box((-half,) * 3, (half,) * 3)
    hits = hk.trace(hk.expression(text), o, d, clip=box, precision=precision)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    np.testing.assert_array_equal(hits.status == hk.RayStatus.HIT, np.isfinite(truth))
    both = np.isfinite(truth)
    assert both.sum() > 40
    np.testing.assert_allclose(hits.t[both], truth[both], atol=2e-3)
    assert hits.evaluations.mean() < 12
    assert hits.uncertainty.max() < 2e-5


@pytest.mark.parametrize(
    "text",
    [
        "sqrt(abs(x)) + 0.5",
        pytest.param("asin(1 - abs(y)) = 9", marks=pytest.mark.slow),
        pytest.param("(x^2)^0.25 + 0.3", marks=pytest.mark.slow),
        pytest.param("abs(x)^(1/3) + 0.5", marks=pytest.mark.slow),
        pytest.param("sqrt(y) = 2", marks=pytest.mark.slow),
        pytest.param("1/(abs(x) + 0.0001*abs(y)) + 1", marks=pytest.mark.slow),
    ],
)
def test_no_surface_is_hit_where_there_is_none(text: str) -> None:
    o, d = rays(1.0)
    box = hk.Box((-1, -1, -1), (1, 1, 1))
    hits = hk.trace(hk.expression(text), o, d, clip=box, precision="single")
    assert (hits.status == hk.RayStatus.MISS).all()


def test_poles_are_no_surfaces() -> None:
    """1/x = 0.5 at x = 2; at x = 0 it is on both sides of the level, and the ray stops."""
    field = hk.expression("1/x = 0.5")
    o, d = [[5.0, 0, 0], [-5.0, 0, 0], [1e-6, 1.0, 0]], [[-1.0, 0, 0], [1.0, 0, 0], [0, -1.0, 0]]
    hits = hk.trace(field, o, d, t_max=20.0)
    assert hits.status.tolist() == [1, 2, 0]
    assert hits.t[0] == pytest.approx(3.0, abs=1e-3)
    assert hits.t[1] == pytest.approx(5.0, abs=1e-3)


def test_ends_of_ranges_that_are_no_number() -> None:
    """log(x) has no lower end where x may be negative, and neither has the smaller of it and y."""
    o, d = [[1.0629, 0, -0.68043], [-0.35924, -0.39349, -0.83078]], [[-1.0, 0, 0], [1.0, 0, 0]]
    hits = hk.trace(hk.expression("min(log(x), y) = z"), o, d, t_max=2.7)
    assert hits.status.tolist() == [1, 2]  # the other begins where there is no log(x)
    assert hits.t[0] == pytest.approx(1.0629 - np.exp(-0.68043), abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "o", "d", "precision", "t"),
    [
        # On these rays f is -z; at the axis it jumps, within [-0.5, 0.5] - z.
        ("x*y/(x^2 + y^2) = z", (1.66, 0, -0.93), (-1, 0, 0), "double", None),
        ("x^2*y/(x^4 + y^2) = z", (0.90696, 0, 0.62904), (-1, 0, 0), "double", None),
        ("x^2*y/(x^4 + y^2) = z", (0.90696, 0, 0.62904), (-1, 0, 0), "single", None),
        # f is a jump between 1.83 and -0.17.
        (
            "abs(x)/x = y + 0.5*z",
            (-0.45275336503982544, 0.022624239325523376, -1.755385160446167),
            (0.21221067011356354, -0.4286957383155823, 0.8781722784042358), "single", None,
        ),
        # The pole is no surface; that is at z = 1, or nowhere.
        ("(1/z)^3 = 1", (0, 0, -1), (0.1, 0, 1), "double", None),
        ("((y^2 - x^2)/(2*z) + 1)^3 = 1", (0.3, 0.1, -1), (0.1, 0, 1), "double", None),
        # The values at y = 8.8e-8 hide the surface, which is 0.007 ahead.
        (
            "abs(x)^(1/3) + abs(y)^(1/3) + abs(z)^(1/3) = 1.2",
            (-2.9498493671417236, 8.825632846765075e-08, -4.051289792528223e-08), (1, 0, 0),
            "single", 1.2256,
        ),
        # The ray lies in the plane of the cusp.
        ("sqrt(sqrt(abs(x))) = y + z/2", (0, 1, -1.5), (0, -1, 0), "double", 0.25),
        ("asin(x) + asin(y) = z", (1, 1, 2), (0, -1, 0), "double", 1 - np.sin(2 - np.pi / 2)),
    ],
)  # fmt: skip
def test_hits_by_rounding(text: str, o: Any, d: Any, precision: Precision, t: float | None) -> None:
    """Ranges of f around a point hold numbers that are no values of f: they make no hit alone. What
    rounding hides is found by looking, or the ray stops."""
    hits = hk.trace(hk.expression(text), [o], [d], t_max=3.0, precision=precision)
    if t is None:
        assert hits.status[0] != hk.RayStatus.HIT
    else:
        assert hits.status[0] == hk.RayStatus.OUT_OF_STEPS or abs(hits.t[0] - t) < 3e-4


@pytest.mark.slow
def test_crossings_beside_a_vertical_tangent() -> None:
    """|grad f| times the tolerance is more there than f ever swings."""
    o, d = [-1.595e-10, 0.040684, -0.99394], np.array([0, 0.11293, 0.9936])
    d /= np.linalg.norm(d)
    field = hk.expression("abs(x*y)^(1/3) = z")
    for precision in ("single", "double"):
        hits = hk.trace(field, [o], [d], t_max=3.0, require_crossing=True, precision=precision)
        assert hits.t[0] == pytest.approx(1.00063, abs=2e-4)
        crossings = hk.crossings(field, [o], [d], t_max=3.0, max_crossings=3, precision=precision)
        assert crossings.count[0] == 1
        assert crossings.t[0, 0] == pytest.approx(1.00063, abs=2e-4)


@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
def test_valley_with_a_vertical_tangent(precision: Precision) -> None:
    """z = sqrt(|x|): along and down into its valley, and from it."""
    field = hk.fields.HeightField(lambda x, y: hk.math.sqrt(abs(x)))
    o = [[0, 0.5, 3], [1e-9, 0.5, 3], [-0.9, 0.1, 0.25], [0, 0.1, 0.25], [0, 0.5, 0.25]]
    d = [[0, 0, -1], [0, 0, -1], [1, 0, 0], [1, 0, 0], [0, -1, 0]]
    hits = hk.trace(field, o, d, precision=precision)
    assert hits.status.tolist() == [1, 1, 1, 1, 0]
    # The rounding of x alone moves the bottom of the valley by 0.003 in single precision.
    np.testing.assert_allclose(hits.t[:4], [3, 3, 0.8375, 0.0625], atol=4e-3)
    assert abs(hits.t[2:4] - [0.8375, 0.0625]).max() < 1e-4
    assert (hits.uncertainty < 1e-4).all()


def test_powers_that_overflow() -> None:
    """|grad f|^2 = 1e63 at the sides of the box leaves single precision."""
    field = hk.expression("x^100 + y^100 + z^100 = 1")
    o, d = rays(2.0)
    hits = hk.trace(field, o, d, clip=hk.Box((-2, -2, -2), (2, 2, 2)), precision="single")
    p = hits.position[hits.status == hk.RayStatus.HIT]
    assert len(p) > 100
    assert (abs(np.abs(p).max(1) - 1) < 0.012).all()


@pytest.mark.parametrize("text", ["sqrt(x) - 1", "1 - x^(1/3)", "log(x)", "asin(x) - pi/2"])
def test_steps_proved_by_values_end_before_the_level(text: str) -> None:
    """The level is at x = 1. A step that is a thousandth longer than what was proved passes it."""
    backend = choose_backend("double")
    field = hk.expression(text).evaluator(backend)
    path = Ray(backend.Array3f(0, 0, 0), backend.Array3f(1, 0, 0), choose_enclosures(None))
    t, levels = backend.Float(0.25), Levels((backend.Float(0.0),))
    ahead = backend.Float([0.5, 0.75 - 5e-4, 0.75 + 1e-9])
    sample = field.evaluate(path.point(t))
    free = to_numpy(SteepPlace.at(field, levels, path, t, ahead, sample).free)
    assert free[0] == 0.5
    assert 0.75 / 1.001 < free[1] < 0.75
    assert free[2] == 0


def test_a_slope_proves_that_a_level_is_taken_no_sooner_than_it_is() -> None:
    """Of 1 - x at x = 1/2 after half a unit: hits beside vertical tangents rest on it."""
    backend = choose_backend("double")
    path = Ray(backend.Array3f(0, 0, 0), backend.Array3f(1, 0, 0), choose_enclosures(None))
    t, reach, none = (backend.Float(length) for length in (0.5, 1.0, 0.0))
    look = hk.expression("1 - x").evaluator(backend).sample_ray(path, t, reach, none)
    gaps, lengths = (
        LevelGaps(backend.Float(0.5), backend.Float(np.inf)),
        backend.Float([0.4998, 0.5002]),
    )
    assert [to_numpy(proof.arrives(gaps, lengths)).tolist() for proof in look.forward] == [
        [False, True]
    ]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["union", "difference", "near", "rotated"])
@pytest.mark.parametrize("require_crossing", [False, True])
def test_solids_made_of_cusps(kind: str, require_crossing: bool) -> None:
    text, f, half = FORMULAS["astroid"]
    star, ball = hk.solid(hk.expression(text), below=0), hk.Sphere(0.6, center=(0.5, 0, 0))

    def of_ball(x: Any, y: Any, z: Any) -> Any:
        return np.sqrt((x - 0.5) ** 2 + y * y + z * z) - 0.6

    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    solid, oracle = {
        "union": (star | ball, lambda *p: np.minimum(f(*p), of_ball(*p))),
        "difference": (ball - star, lambda *p: np.maximum(-f(*p), of_ball(*p))),
        "near": (hk.solid(hk.expression(text), around=(0, 0.05)), lambda *p: abs(f(*p)) - 0.05),
        "rotated": (
            star.rotated(30, (0, 0, 1)), lambda x, y, z: f(c * x + s * y, c * y - s * x, z)
        ),
    }[kind]  # fmt: skip
    o, d = rays(half)
    truth = first_roots(oracle, o, d, half)
    box = hk.Box((-half,) * 3, (half,) * 3)
    hits = hk.trace(solid, o, d, clip=box, require_crossing=require_crossing, precision="single")
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    np.testing.assert_allclose(hits.t, truth, atol=2e-3)


def test_rays_pass_where_all_squares_of_a_norm_are_zero() -> None:
    """A box as formulas write it: the root of squares that are 0 inside; rays through an axis."""

    def box(x: Any, y: Any, z: Any) -> Any:
        q = [abs(side) - 0.75 for side in (x, y, z)]
        out = [hk.math.maximum(side, 0.0) for side in q]
        outside = hk.math.sqrt(out[0] * out[0] + out[1] ** 2 + 4 * out[2] ** 2)
        return hk.math.minimum(
            -outside - hk.math.minimum(hk.math.maximum(*q), 0.0), hk.math.sqrt(x**2 + y**2) - 0.1
        )

    o, d = rays(1.0, 200)
    o[:2], d[:2] = [[0.5, 0, 0.1], [0.5, 0.5, 0]], [[-1, 0, 0], [-(0.5**0.5), -(0.5**0.5), 0]]
    field = hk.expression(box)
    hits = hk.trace(field, 0.3 * o, d, precision="single")
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    assert hits.evaluations.mean() < 12
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 3))
    assert np.isfinite(field.gradient(points, precision="single")).all()


def test_which_formulas_are_steep() -> None:
    def steep(text: str) -> bool:
        return hk.expression(text).evaluator(choose_backend("single")).is_steep

    assert not any(
        map(steep, ("x^4 + y^2 = 1", "sqrt(x^2 + 2*y^2 + 1) = z/3", "abs(x) = norm(y, z)"))
    )
    assert all(map(steep, ("sqrt(x*y)", "1/x", "x^0.3", "tan(x)", "log(x)", "x^y", "atan2(y, x)")))
    rooted = hk.Sphere() | hk.solid(hk.expression("sqrt(x)"), below=1)
    assert not hk.Sphere().evaluator(choose_backend("single")).is_steep
    assert rooted.evaluator(choose_backend("single")).is_steep
    assert not tally_of(lambda x, y, z: 2.0).is_steep


def test_which_formulas_turn_within_rounding() -> None:
    def abrupt(text: str) -> bool:
        return hk.expression(text).evaluator(choose_backend("single")).is_abrupt

    assert all(
        map(
            abrupt,
            (
                "max(-1, min(1, 1e9*y))", "max(-1e-9, min(1e-9, y))", "1e9*y/sqrt(1 + (1e9*y)^2)",
                "tanh(1e5*(x + y))", "exp(-(1e9*y)^2)", "max(-1, min(1, 1e3*(y - 1e4)))",
                "abs(1e6*y + 1) - abs(1e6*y - 1)",
            ),
        )
    )  # fmt: skip
    assert not any(
        map(
            abrupt,
            (
                "1e9*y", "1e9*x^2 + y^2 = 1", "max(abs(x) - 1, abs(y) - 1, abs(z) - 0.001)",
                "exp(-400*(x^2 + y^2)) = 0.5", "sin(20*x)*cos(20*y) + sin(20*y)*cos(20*z)",
                "x^20 + y^20 + z^20 = 1", "norm(x, y, z) = 1", "1/(x^2 + y^2) = 3",
            ),
        )
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Steps(hk.solids.FormulaSolid):
    """The product of two functions of y that go from -1 to 1 at -0.5 and at `offset`."""

    steepness: float = 1e9
    offset: float = 0.25

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        def step(at: Any) -> Any:
            return hk.math.maximum(hk.math.minimum((y - at) * self.steepness, 1.0), -1.0)

        return step(-0.5) * step(self.offset)


def test_numbers_are_told_before_they_are_data_of_a_kernel() -> None:
    steep, flat = Steps(), Steps(steepness=1.0)
    backend = choose_backend("single")
    assert steep.evaluator(backend).is_abrupt
    assert steep.evaluator(backend).is_steep
    assert not flat.evaluator(backend).is_steep
    small = hk.Sphere(1e-5), hk.Cylinder(1e-3, 0.0002), hk.Cuboid((0.0002, 2.0, 2.0))
    assert not any(shape.evaluator(backend).is_steep for shape in small)


def meets(at: float, o: FloatArray, d: FloatArray) -> BoolArray:
    """Which rays of length 5 meet the plane y = at."""
    return np.not_equal(o[:, 1] < at, (o + 5 * d)[:, 1] < at)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_no_level_is_passed_within_the_rounding_of_coordinates(precision: Precision) -> None:
    """In single precision a fifth of the rays to the first plane were misses, most others ended
    undecided."""
    o, d = (np.float64(np.float32(one)) for one in rays(1.0, 1000))
    settings: dict[str, Any] = {"t_max": 5.0, "precision": precision}
    for text, level in (("max(-1, min(1, 1e9*y)) - 0.1*x", 0.0), ("tanh(1e9*y)", 0.3)):
        hits = hk.trace(hk.expression(text), o, d, level=level, **settings)
        assert_array_equal(
            hits.status, np.where(meets(0, o, d), hk.RayStatus.HIT, hk.RayStatus.MISS)
        )
        assert np.abs(hits.position[hits.is_hit, 1]).max() < 1e-4
    crossings = hk.crossings(Steps(), o, d, max_crossings=3, **settings)
    assert_array_equal(crossings.count, 1 * meets(-0.5, o, d) + meets(0.25, o, d))
    assert (crossings.status == hk.RayStatus.MISS).all()


def test_exponentials_that_overflow() -> None:
    """In the ball the slope of f is no number. Rays in contact passed through it, and their first
    crossing was where they leave it; most others ended undecided there."""
    field = hk.expression("1/(1 + exp(-1e6*(x^2 + y^2 + z^2 - 0.5))) - 0.5 + 0.1*z")
    o, d = [[-2.5, 0.6435840129852295, 0.16996535658836365], [0.05, 0.1, 0.1]], [[1.0, 0, 0]] * 2
    half = np.sqrt(0.5 - np.sum(np.square(o)[:, 1:], axis=1))
    ends = np.stack([-half, half], axis=1) - np.array(o)[:, :1]
    settings: dict[str, Any] = {"t_max": 5.0, "precision": "single"}
    hits = hk.trace(field, o, d, require_crossing=True, **settings)
    np.testing.assert_allclose(hits.t, [ends[0, 0], ends[1, 1]], atol=1e-4)
    crossings = hk.crossings(field, o, d, max_crossings=4, **settings)
    assert crossings.count.tolist() == [2, 1]
    np.testing.assert_allclose(crossings.t[0, :2], ends[0], atol=1e-4)
    assert (crossings.status == hk.RayStatus.MISS).all()


def test_what_overflows_on_the_way_to_a_value_makes_no_hit() -> None:
    """(...)^80 leaves single precision at the start, where f is -0.68; its range there is wide."""
    field = hk.expression("1/(1 + (100*(x^2 + y^2 - 0.4) + 1)^80) - 0.5 + 0.1*z")
    o, d = [[-1.5809962749, -0.8071405888, -1.7603905201]], [[0.8636800647, 0.1104671583, 0.49]]
    hits = hk.trace(field, o, d, t_max=5.0, precision="single", max_steps=100)
    assert hits.status[0] == hk.RayStatus.OUT_OF_STEPS


@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
def test_ranges_beside_a_jump_are_no_values(precision: Precision) -> None:
    """On the axis f jumps, within [-0.5, 0.5] - z; ranges of coordinates far from 0 are wide."""
    field = hk.expression("(x - 100)*(y + 100)/((x - 100)^2 + (y + 100)^2) = z")
    o = [[100, -97.5, 0.593], [100, -102.5, 0.827], [98.5, -100, 0.52], [98, -102, 0.4]]
    d = [[0, -1, 0], [0, 1, 0], [1, 0, 0], [1, 1 / 3, 0]]
    hits = hk.trace(field, o, d, t_max=5.0, precision=precision, max_steps=300)
    assert (hits.status[:3] != hk.RayStatus.HIT).all()
    assert hits.status[3] == hk.RayStatus.HIT
    x, y, z = hits.position[3] - [100, -100, 0]
    assert x * y / (x**2 + y**2) == pytest.approx(z, abs=1e-3)


def test_sheets_thinner_than_rounding_are_never_missed() -> None:
    o, d = (np.float64(np.float32(one)) for one in rays(1.0))
    sheet = hk.expression("exp(-(1e9*y)^2) = 0.5")
    hits = hk.trace(sheet, o, d, precision="single", t_max=5.0, max_steps=300)
    assert_array_equal(hits.status != hk.RayStatus.MISS, meets(0, o, d))
