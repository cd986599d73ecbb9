"""Distances to level sets and their curvatures, against surfaces where they are known."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.distance import closest_points, curvature, signed_distance, tangent_plane
from harnack.distance.tangent_plane import second_order_distance
from harnack.enclosures import Enclosure, HarmonicBall, Lipschitz, TaylorRemainder
from harnack.enclosures.harmonic_ball import (
    HarnackEnclosure,
    HarnackSlopeEnclosure,
    SphericalCapEnclosure,
)
from harnack.enclosures.parabola import LipschitzEnclosure, TaylorEnclosure
from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.geometry import example_curves
from harnack.testing.enclosure_contracts import PromiseCase
from harnack.testing.violation_search import lift_along_rays, sample_field
from tests.oracles.exact import exact_step

# --- fields whose surfaces are known ---------------------------------------------------------


class Charge(hk.Field):
    """1/r - 1: level 0 is the unit sphere, f grows inward."""

    domain = hk.Ball(radius=4.0)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        r = dr.norm(p)
        return hk.fields.Sample(
            1 / r - 1, -p / (r * r * r), (hk.proofs.HarmonicBall(r, -1.0, math.inf),)
        )

    def hessian(self, p: Any) -> Any:
        r = dr.norm(p)
        return outer(3 * p / r**5, p, -1 / r**3)


@dataclasses.dataclass
class Ellipsoid(hk.Field):
    """(x/a)^2 + (y/b)^2 + (z/c)^2 - 1."""

    a: float = 3.0
    b: float = 1.0
    c: float = 1.5

    def evaluate(self, p: Any) -> hk.fields.Sample:
        q = type(p)(p.x / self.a**2, p.y / self.b**2, p.z / self.c**2)
        return hk.fields.Sample(
            dr.dot(p, q) - 1,
            2 * q,
            (hk.proofs.TaylorRemainder(2 / min(self.a, self.b, self.c) ** 2),),
        )


class Torus(hk.Field):
    """(sqrt(x^2+y^2) - 1)^2 + z^2, level 0.16: the torus of radii 1 and 0.4."""

    default_level = 0.16
    domain = hk.Ball(radius=3.0)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        rho = dr.sqrt(p.x * p.x + p.y * p.y)
        away = rho - 1
        gradient = type(p)(2 * away * p.x / rho, 2 * away * p.y / rho, 2 * p.z)
        return hk.fields.Sample(away * away + p.z * p.z, gradient, (hk.proofs.Lipschitz(8.0),))

    def hessian(self, p: Any) -> Any:
        rho = dr.sqrt(p.x * p.x + p.y * p.y)
        e = type(p)(p.x / rho, p.y / rho, 0)
        x, y, z = outer(2 * e / rho, e, 2 - 2 / rho)
        return x, y, z + type(p)(0, 0, 2 / rho)

    @staticmethod
    def distance(x: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) - 0.4


class Helicoid(hk.Field):
    """z - azimuth, known modulo 2 pi: its level sets are helicoids, which are minimal."""

    period = 2 * math.pi

    def evaluate(self, p: Any) -> hk.fields.Sample:
        square = p.x * p.x + p.y * p.y
        gradient = type(p)(p.y / square, -p.x / square, 1.0)
        # Over half the distance from the axis the azimuth turns by no more than asin(1/2).
        reach = 0.5 * dr.sqrt(square)
        value = p.z - dr.atan2(p.y, p.x)
        ball = hk.proofs.HarmonicBall(reach, value - reach - 0.53, value + reach + 0.53)
        return hk.fields.Sample(value, gradient, (ball,))

    def hessian(self, p: Any) -> Any:
        x, y = p.x, p.y
        fourth = (x * x + y * y) ** 2
        xx, xy = -2 * x * y / fourth, (x * x - y * y) / fourth
        return type(p)(xx, xy, 0), type(p)(xy, -xx, 0), type(p)(0.0)

    @property
    def boundary(self) -> Any:
        return hk.fields.Boundary(closest_point=lambda p: type(p)(0.0, 0.0, p.z))


class Reversed(hk.Field):
    """Minus another field."""

    def __init__(self, of: hk.Field) -> None:
        self.of = of

    def evaluate(self, p: Any) -> hk.fields.Sample:
        sample = self.of.evaluate(p)
        return hk.fields.Sample(-sample.value, -sample.gradient, (hk.proofs.Lipschitz(1e3),))

    def hessian(self, p: Any) -> Any:
        x, y, z = self.of.hessian(p)
        return -x, -y, -z


class Bare(hk.Field):
    """|p| with nothing but a Lipschitz constant; no Hessian."""

    default_level = 1.0

    def evaluate(self, p: Any) -> hk.fields.Sample:
        return hk.fields.Sample(dr.norm(p), p / dr.norm(p), (hk.proofs.Lipschitz(1.0),))


class PlaneJumps(hk.fields.Jumps):
    """The plane x = 0."""

    def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> JumpCrossing:
        t = -o.x / d.x
        later = (t > after.t) | ((t == after.t) & (after.facet < 0))
        meets = active & later & (t <= t_max) & (d.x != 0)
        return JumpCrossing(
            dr.select(meets, t, dr.inf),
            dr.select(meets, dr.uint32_array_t(o.x)(0), dr.uint32_array_t(o.x)(NO_FACET)),
            dr.select(meets, dr.copysign(type(o.x)(1), d.x), 0),
            type(o)(1.0, 0.0, 0.0),
        )

    def initial_offset(self, o: Any, d: Any, t_min: Any, active: Any) -> Any:
        at = o.x + t_min * d.x
        return dr.select((at > 0) | ((at == 0) & (d.x > 0)), 1.0, 0.0)

    def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
        return hk.fields.EvaluateOnly(Step(offset).evaluate)

    def distance(self, p: Any) -> Any:
        return dr.abs(p.x)


class Step(hk.Field):
    """0.3 z, and 1 more where x > 0: the sheet is the plane x = 0.

    Level 0.5 is z = 5/3 for x <= 0, z = -5/3 for x >= 0, and the strip of the sheet between.
    """

    default_level = 0.5
    domain = hk.Box((-4, -4, -4), (4, 4, 4))

    def __init__(self, side: Any = None) -> None:
        self.side = side

    def evaluate(self, p: Any) -> hk.fields.Sample:
        side = dr.select(p.x > 0, 1.0, 0.0) if self.side is None else self.side
        known = (hk.proofs.Lipschitz(0.3),)
        return hk.fields.Sample(0.3 * p.z + side, type(p)(0.0, 0.0, 0.3), known)

    traits = hk.fields.Traits(has_jumps=True)

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.SampleEvaluator:
        return hk.fields.SampleEvaluator(self, backend, jumps=PlaneJumps())

    @staticmethod
    def distance(x: np.ndarray) -> np.ndarray:
        def gap(u: np.ndarray, low: float, high: float) -> np.ndarray:
            return np.maximum(np.maximum(low - u, u - high), 0)

        top = np.hypot(gap(x[:, 0], -4, 0), x[:, 2] - 5 / 3)
        bottom = np.hypot(gap(x[:, 0], 0, 4), x[:, 2] + 5 / 3)
        strip = np.hypot(x[:, 0], gap(x[:, 2], -5 / 3, 5 / 3))
        return np.minimum(np.minimum(top, bottom), strip)


def outer(u: Any, v: Any, diagonal: Any) -> Any:
    """Rows of u v^T + diagonal."""
    row = type(u)
    return (
        u.x * v + row(diagonal, 0, 0),
        u.y * v + row(0, diagonal, 0),
        u.z * v + row(0, 0, diagonal),
    )


WAVY = hk.SolidAngle(example_curves.wavy_polygon(24))
KNOT = hk.SolidAngle(example_curves.torus_knot(2, 3, 60))
POLYNOMIAL = hk.HarmonicPolynomial(
    {(2, 1, 0): 1, (0, 1, 2): -1, (1, 0, 0): 0.3, (0, 0, 0): 0.1, (1, 1, 1): 0.5},
    domain=hk.Ball(radius=1.5),
)
CURVED: dict[str, hk.Field] = {
    "wavy": WAVY,
    "knot": KNOT,
    "polynomial": POLYNOMIAL,
    "Y 5,3": hk.SphericalHarmonic(5, 3),
    "gyroid": hk.Gyroid(),
    "charge": Charge(),
}


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def off_level(field: hk.Field, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f - level, modulo the period, and the gradient."""
    look = sample_field(field, x)
    above = look.value - field.default_level
    if field.period is not None:
        above -= field.period * np.round(above / field.period)
    return above, look.gradient


def surface_points(field: hk.Field, n: int, seed: int = 0) -> np.ndarray:
    """Where random rays first hit the surface, moved onto it by Newton's method."""
    rng = np.random.default_rng(seed)
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    lower, upper = volume.bounds()
    center, size = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
    o = center + 0.5 * size * rng.normal(size=(n, 3))
    hits = hk.trace(field, o, unit(rng.normal(size=(n, 3))), t_max=3 * size, tolerance=1e-5 * size)
    x = hits.position[hits.is_hit].astype(np.float64)
    for _ in range(4):
        above, g = off_level(field, x)
        x = x - (above / np.einsum("nk,nk->n", g, g))[:, None] * g
    above, g = off_level(field, x)
    settled = np.abs(above) <= 1e-12 * size * np.linalg.norm(g, axis=1)
    inside = np.ones(len(x), bool) if field.domain is None else field.domain.contains_points(x)
    return x[settled & inside]


# --- curvature -------------------------------------------------------------------------------


def test_curvature_of_spheres() -> None:
    x = np.random.default_rng(0).normal(size=(100, 3))
    x = x[np.linalg.norm(x, axis=1) > 0.2]
    r = np.linalg.norm(x, axis=1)
    inward, outward = curvature(Charge(), x), curvature(Reversed(Charge()), x)
    assert np.allclose(inward.mean, -1 / r, rtol=1e-12)
    assert np.allclose(outward.mean, 1 / r, rtol=1e-12)
    assert np.allclose(inward.gaussian, 1 / r**2, rtol=1e-12)
    assert np.allclose(outward.gaussian, 1 / r**2, rtol=1e-12)
    assert np.allclose(outward.normal, unit(x), atol=1e-14)


def test_curvature_of_a_torus() -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 2 * np.pi, (2, 200))
    r = rng.uniform(0.05, 0.8, 200)
    rho = 1 + r * np.cos(v)
    found = curvature(Torus(), np.column_stack([rho * np.cos(u), rho * np.sin(u), r * np.sin(v)]))
    assert np.allclose(found.gaussian, np.cos(v) / (r * rho), rtol=1e-10)
    assert np.allclose(found.mean, (1 + 2 * r * np.cos(v)) / (2 * r * rho), rtol=1e-10)


def test_curvature_of_a_minimal_surface() -> None:
    x = np.random.default_rng(2).uniform(-2, 2, (200, 3))
    found = curvature(Helicoid(), x)
    square = x[:, 0] ** 2 + x[:, 1] ** 2
    assert np.abs(found.mean).max() < 1e-12
    assert np.allclose(found.gaussian, -1 / (1 + square) ** 2, rtol=1e-12)


def test_curvature_of_a_hyperbolic_cylinder() -> None:
    """x^2 - y^2 = c has curvature -+ c/(x^2+y^2)^(3/2) across, none along z."""
    field = hk.HarmonicPolynomial({(2, 0, 0): 1, (0, 2, 0): -1})
    x = np.random.default_rng(3).uniform(-0.7, 0.7, (200, 3))
    found = curvature(field, x)
    c, square = x[:, 0] ** 2 - x[:, 1] ** 2, x[:, 0] ** 2 + x[:, 1] ** 2
    assert np.allclose(found.mean, -c / (2 * square**1.5), atol=1e-12)
    assert np.abs(found.gaussian * square).max() < 1e-12


@pytest.mark.parametrize("name", ["wavy", "knot", "polynomial", "gyroid"])
def test_curvature_is_how_the_normal_turns(name: str) -> None:
    """Mean and Gaussian curvature from differences of the unit normal in a tangent frame."""
    field = CURVED[name]
    x = surface_points(field, 2000)[:200]
    scale = np.abs(curvature(field, x).gaussian) ** 0.5 + np.abs(curvature(field, x).mean)
    normal = unit(sample_field(field, x).gradient)
    u = unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)]))
    frame = (u, np.cross(normal, u))
    h = 1e-3 * np.minimum(boundary_distance(field, x), 0.1)[:, None]
    shape = np.empty((len(x), 2, 2))
    for j, way in enumerate(frame):
        ahead, back = (unit(sample_field(field, x + s * h * way).gradient) for s in (1, -1))
        for i, along in enumerate(frame):
            shape[:, i, j] = np.einsum("nk,nk->n", (ahead - back) / (2 * h), along)
    found = curvature(field, x)
    assert (np.abs(found.mean - 0.5 * np.trace(shape, axis1=1, axis2=2)) < 1e-5 * (1 + scale)).all()
    assert (np.abs(found.gaussian - np.linalg.det(shape)) < 1e-5 * (1 + scale**2)).all()


def test_curvature_where_there_is_no_surface() -> None:
    found = curvature(Ellipsoid2(), [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert np.isnan(found.mean).tolist() == [True, False]


class Ellipsoid2(Ellipsoid):
    """With second derivatives."""

    def hessian(self, p: Any) -> Any:
        row = type(p)
        return row(2 / self.a**2, 0, 0), row(0, 2 / self.b**2, 0), row(0, 0, 2 / self.c**2)


def test_curvature_in_single_precision() -> None:
    x = surface_points(WAVY, 500)[:100]
    double, single = curvature(WAVY, x), curvature(WAVY, x, precision="single")
    assert np.median(np.abs(single.mean - double.mean) / np.abs(double.mean)) < 1e-4


def test_curvature_needs_second_derivatives() -> None:
    with pytest.raises(NotImplementedError, match="Bare gives no second derivatives"):
        curvature(Bare(), [[1.0, 0.0, 0.0]])


# --- first and second order --------------------------------------------------------------------


@pytest.mark.slow
def test_the_example_of_a_charge() -> None:
    """f = 1/r - 1 at r = 0.8: 0.16 to first order, 0.2 is true. With the sign that was printed,
    d (1 - k d/2), the second order would be 0.128."""
    x = [[0.0, 0.8, 0.0]]
    assert signed_distance(Charge(), x, method="first_order") == pytest.approx([0.16], rel=1e-12)
    assert signed_distance(Charge(), x, method="second_order") == pytest.approx([0.2], rel=1e-12)
    assert signed_distance(Charge(), x, method="closest_point") == pytest.approx([0.2], rel=1e-12)


def order_of(field: hk.Field, method: Any) -> float:
    """The slope of log(error) over log(distance)."""
    lengths = np.geomspace(1e-3, 1e-2, 5)
    y = surface_points(field, 3000)
    normal = unit(sample_field(field, y).gradient)
    bend = np.sqrt(np.abs(curvature(field, y).gaussian)) + np.abs(curvature(field, y).mean)
    # Where the surface is bent the least: distances along the normal are true far out.
    y, normal = (one[np.argsort(bend)[: len(y) // 2]] for one in (y, normal))
    errors = []
    for d in lengths:
        for sign in (-1, 1):
            found = signed_distance(field, y + sign * d * normal, method=method)
            errors.append(np.median(np.abs(found - sign * d)))
    errors = np.array(errors).reshape(-1, 2).mean(axis=1)
    return float(np.polyfit(np.log(lengths), np.log(errors), 1)[0])


@pytest.mark.few(4)
@pytest.mark.parametrize("name", ["wavy", "knot", "polynomial", "Y 5,2", "gyroid"])
def test_orders_of_accuracy(name: str) -> None:
    """Points d along the normal from points of the surface are at distance d."""
    field = CURVED.get(name)
    if field is None:  # at level 0 it is a cone: flat along rays, with planes among its sheets
        field = hk.SphericalHarmonic(5, 2)
        field.default_level = 0.05
    assert 1.9 < order_of(field, "first_order") < 2.1
    assert 2.9 < order_of(field, "second_order") < 3.1


@given(above=st.floats(-10, 10), steepness=st.floats(0.01, 10), bend=st.floats(-100, 100))
def test_second_order_stays_a_distance(above: float, steepness: float, bend: float) -> None:
    """Whatever f is like: of the sign of f - level, and no more than twice the first order."""
    v = choose_backend("double").Array3f
    rows = (v(0.0), v(0.0), v(0.0, 0.0, bend))
    real = choose_backend("double").Float
    found = to_numpy(second_order_distance(real(above), v(0.0, 0.0, steepness), rows))[0]
    first = above / steepness
    assert abs(found) <= 2 * abs(first)
    assert found == 0 or math.copysign(1, found) == math.copysign(1, above)
    if bend == 0:
        assert found == pytest.approx(first)


def test_where_the_gradient_vanishes() -> None:
    field = Ellipsoid2()
    assert signed_distance(field, [[0.0, 0.0, 0.0]], method="first_order").tolist() == [-math.inf]
    assert signed_distance(field, [[0.0, 0.0, 0.0]], method="second_order").tolist() == [-math.inf]
    level = [[0.0, 0.0, 0.0]]
    for method in ("first_order", "second_order", "closest_point"):
        assert signed_distance(field, level, level=-1.0, method=method).tolist() == [0.0]  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_sign_is_that_of_the_nearest_level() -> None:
    """Of the ladder 0, 2 pi, ..: above it up to half a period, then below the next one."""
    x = np.array([[1.0, 0.0, z] for z in (0.3, 2.8, 3.5, 6.0, 6.6)])
    for method in ("first_order", "second_order", "closest_point", "lower_bound"):
        found = signed_distance(Helicoid(), x, method=method)  # type: ignore[arg-type]
        assert np.sign(found).tolist() == [1, 1, -1, -1, 1]


# --- the closest point -------------------------------------------------------------------------


def test_newton_finds_the_distance_from_a_torus() -> None:
    x = np.random.default_rng(4).uniform(-1.6, 1.6, (2000, 3))
    found = signed_distance(Torus(), x)
    assert np.abs(found - Torus.distance(x)).max() < 1e-13


@pytest.mark.slow
def test_newton_works_without_second_derivatives() -> None:
    x = np.random.default_rng(5).uniform(-2, 2, (500, 3))
    assert np.abs(signed_distance(Bare(), x) - (np.linalg.norm(x, axis=1) - 1)).max() < 1e-14
    x = np.random.default_rng(5).uniform(-4, 4, (500, 3))
    assert np.allclose(signed_distance(Ellipsoid(), x), signed_distance(Ellipsoid2(), x), rtol=1e-9)


def test_newton_leaves_symmetric_stationary_points() -> None:
    """On the long axis of an ellipsoid, within its evolute, the closest point lies aside."""
    a, b = 3.0, 1.0
    t = np.linspace(-0.98, 0.98, 41) * (a - b * b / a)
    x = np.column_stack([t, 0 * t, 0 * t])
    exact = -b * np.sqrt(1 - t**2 / (a**2 - b**2))
    for field in (Ellipsoid(a, b), Ellipsoid2(a, b)):
        # At the center, where grad f = 0, a descent begins at a point that is seen.
        assert np.abs(signed_distance(field, x) - exact).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVED)
def test_feet_lie_on_the_surface_and_below_the_point(name: str) -> None:
    """They are points of the surface, so that the distance is an upper bound of the true one; and
    the way there is normal to it, unless the surface ends there."""
    field = CURVED[name]
    x = points_around(field, 500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        y, d = closest_points(field, x), signed_distance(field, x)
    found = ~np.isnan(d)
    x, y, d = x[found], y[found], d[found]
    assert found.mean() > 0.9
    assert np.allclose(np.linalg.norm(x - y, axis=1), np.abs(d), rtol=1e-12)
    above, g = off_level(field, y)
    inner = boundary_distance(field, y) > 1e-9
    assert inner.mean() > 0.4
    slack = 1e-13 * (1 + np.linalg.norm(g, axis=1))
    assert (np.abs(above) <= slack)[inner].all()
    slant = np.linalg.norm(np.cross(unit(g), unit(x - y)), axis=1)
    assert (slant * np.abs(d) <= 1e-7 * np.abs(d) + 1e-13)[inner].all()


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CURVED)
def test_no_sample_of_the_surface_is_nearer_but_for_a_few(name: str) -> None:
    """Upper bounds always; nearly always the distance itself."""
    field = CURVED[name]
    x = points_around(field, 1000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = np.abs(signed_distance(field, x))
    nearest, _ = cKDTree(surface_points(field, 40_000)).query(x)
    known = ~np.isnan(found)
    assert (found <= nearest * (1 + 1e-9) + 1e-12)[known].mean() > 0.985
    assert np.median((nearest / found)[known]) < 1.1


def points_around(field: hk.Field, n: int, seed: int = 0) -> np.ndarray:
    """Random points within the domain, most of them well inside."""
    rng = np.random.default_rng(seed)
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    lower, upper = volume.bounds()
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    return middle + rng.uniform(-0.5, 0.5, (n, 3)) * half


def boundary_distance(field: hk.Field, x: np.ndarray) -> np.ndarray:
    """From points (n, 3) to the curve that the surface ends in; inf without one."""
    p, boundary = to_vector3(choose_backend("double"), x), field.boundary
    nearest = None
    if boundary is not None and boundary.closest_point is not None:
        nearest = boundary.closest_point(p)
    if nearest is None:
        return np.full(len(x), np.inf)
    return np.linalg.norm(to_numpy(nearest) - x, axis=1)


def disk_distance(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """From points to a convex polygon in the plane z = 0, counter-clockwise."""
    along = np.roll(corners, -1, axis=0) - corners
    away = x[:, None] - corners
    share = np.clip((away * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
    edge = np.linalg.norm(away - share[..., None] * along, axis=2).min(axis=1)
    cross = along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0]
    return np.where((cross > 0).all(axis=1), np.abs(x[:, 2]), edge)


@pytest.mark.slow
def test_the_rim_of_a_disk_belongs_to_it() -> None:
    """The 2 pi level of a plane polygon is the polygon; beyond its edges the edge is closest."""
    corners = example_curves.regular_polygon(9)
    x = np.random.default_rng(6).uniform(-2, 2, (2000, 3))
    exact = disk_distance(x, corners)
    for scale, shift in ((1.0, 0.0), (1e-3, 1.0), (1e4, -3.0)):
        field = hk.SolidAngle(scale * (corners + shift))
        found = np.abs(signed_distance(field, scale * (x + shift)))
        assert np.abs(found / scale - exact).max() < 1e-10
        lower = np.abs(signed_distance(field, scale * (x + shift), method="lower_bound"))
        assert (lower <= scale * exact * (1 + 1e-12)).all()
        assert np.median(lower / (scale * exact)) > 0.3


def test_points_without_a_descent_see_the_surface() -> None:
    """From the center of a sphere every way is as good: no gradient."""
    found = signed_distance(Ellipsoid2(1, 1, 1), [[0, 0, 0], [0.5, 0, 0], [0, 3, 0]])
    assert found == pytest.approx([-1, -0.5, 2.0])
    assert np.linalg.norm(closest_points(Ellipsoid2(1, 1, 1), [[0, 0, 0]])) == pytest.approx(1)


def test_points_without_a_surface_are_counted() -> None:
    """|p| = 1 has no point in a box from 2 to 3."""

    class Elsewhere(Bare):
        domain = hk.Box((2, 2, 2), (3, 3, 3))

    field, x = Elsewhere(), [[2.5, 2.1, 2.0], [2.5, 2.5, 3.0]]
    with pytest.warns(RuntimeWarning, match=r"signed_distance: no closest .* 2 of 2 points"):
        assert np.isnan(signed_distance(field, x)).all()
    with pytest.warns(RuntimeWarning, match=r"closest_points: no closest .* 1 of 1 points"):
        assert np.isnan(closest_points(field, x[:1])).all()


@pytest.mark.slow
def test_feet_lie_in_the_domain() -> None:
    """The plane x = 0.9 within the unit ball: beside the part that is left of it, its rim."""
    field = hk.HarmonicPolynomial({(1, 0, 0): 1.0})
    x = np.array([[0.5, 0.0, 0.0], [0.5, 0.7, 0.0]])
    found, feet = signed_distance(field, x, level=0.9), closest_points(field, x, level=0.9)
    assert found[0] == pytest.approx(-0.4)
    rim = math.hypot(0.4, 0.7 - math.sqrt(0.19))
    assert rim <= -found[1] < 2 * rim
    assert feet[:, 0] == pytest.approx(0.9)
    assert (np.linalg.norm(feet, axis=1) <= 1 + 1e-12).all()


def on_sphere(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points spread over the unit sphere, their normals and areas."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    points = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    return points, points, np.full(n, 4 * np.pi / n)


@pytest.mark.slow
@pytest.mark.parametrize("n", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["dipoles", "dipoles by tree", "screened", "barely screened"])
def test_every_point_has_a_distance_from_a_cloud(kind: str, n: int) -> None:
    """Far from the points f is nearly constant, and its gradient leads nowhere."""
    cloud = on_sphere(n)
    field = {
        "dipoles": lambda: hk.DipolePotential(*cloud, accuracy=100.0),
        "dipoles by tree": lambda: hk.DipolePotential(*cloud),
        "screened": lambda: hk.fields.ScreenedWindingNumber(*cloud, length=0.7),
        "barely screened": lambda: hk.fields.ScreenedWindingNumber(*cloud, length=5.0),
    }[kind]()
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-2, 2, (150, 3)), rng.normal(size=(10, 3)) * 20])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, y = signed_distance(field, x), closest_points(field, x)
    assert np.allclose(np.linalg.norm(x - y, axis=1), np.abs(found), rtol=1e-12)
    look = sample_field(field, y)
    steepness = np.linalg.norm(look.gradient, axis=1)
    off = np.abs(look.value - field.default_level)
    assert (off <= 2 * look.error + 1e-12 * steepness).all()
    assert (signed_distance(field, x, method="lower_bound") / found <= 1 + 1e-9).all()
    # The level sets pass through all points: that bounds the distance, but the foot is a minimum.
    nearest, _ = cKDTree(cloud[0]).query(x)
    assert (np.abs(found) <= nearest + 1e-9).mean() > 0.98
    assert (np.abs(found) <= 1.5 * nearest).all()


# --- the proved lower bound --------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["double", "single"])
def test_the_lower_bound_is_attained_by_planes_and_spheres(precision: Any) -> None:
    rng = np.random.default_rng(7)
    x = rng.uniform(-0.5, 0.5, (500, 3))

    class Plane(hk.Field):
        def evaluate(self, p: Any) -> hk.fields.Sample:
            slope = type(p)(2.0, 1.0, -2.0)
            return hk.fields.Sample(dr.dot(p, slope), slope, (hk.proofs.TaylorRemainder(0.0),))

    flat = np.abs(x @ [2, 1, -2]) / 3
    found = np.abs(signed_distance(Plane(), x, method="lower_bound", precision=precision))
    slack = 1e-5 if precision == "single" else 1e-5 * flat
    assert (found <= flat).all()
    assert (found >= flat - slack).all()
    found = np.abs(signed_distance(Bare(), x, method="lower_bound", precision=precision))
    round_ = np.abs(np.linalg.norm(x, axis=1) - 1)
    assert (found <= round_).all()
    assert (found >= round_ * (1 - 1e-5)).all()


@pytest.mark.slow
def test_the_lower_bound_is_of_first_order() -> None:
    for name, field in CURVED.items():
        y = surface_points(field, 500)
        normal = unit(sample_field(field, y).gradient)
        inner = boundary_distance(field, y) > 0.3
        d = 1e-4
        found = np.abs(signed_distance(field, y + d * normal, method="lower_bound"))[inner] / d
        assert found.max() <= 1, name
        assert np.median(found) > 0.99, name


def cases(
    rng: np.random.Generator, n: int
) -> list[tuple[type[Enclosure], PromiseCase, np.ndarray]]:
    """Random ones of each kind, the bounds for them, and how large slopes may be."""
    radius, below, above = (10 ** rng.uniform(-2, 1, n) for _ in range(3))
    down, up = (share * 10 ** rng.uniform(-2, 1, n) for share in (below, above))
    result: list[tuple[type[Enclosure], PromiseCase, np.ndarray]] = []
    for dimension in (2, 3, 4):
        for low, high in ((-below, above), (-below, np.inf), (-np.inf, above)):
            ball = PromiseCase(HarmonicBall(radius, low, high, dimension), down, up)
            steepest = dimension * np.minimum(-low, high) / radius
            if dimension == 3 and np.ndim(low) == np.ndim(high):
                share = below / (below + above)
                result.append(
                    (
                        SphericalCapEnclosure,
                        ball,
                        3 * (below + above) / radius * share * (1 - share),
                    )
                )
            result += [(HarnackSlopeEnclosure, ball, steepest), (HarnackEnclosure, ball, steepest)]
    constant, slopes = 10 ** rng.uniform(-2, 2, n), 10 ** rng.uniform(-2, 1, n)
    result.append(
        (LipschitzEnclosure, PromiseCase(Lipschitz(constant, radius), down, up), constant)
    )
    result.append(
        (TaylorEnclosure, PromiseCase(TaylorRemainder(constant, radius), down, up), slopes)
    )
    return result


@pytest.mark.slow
def test_the_steepest_directions_have_the_shortest_steps() -> None:
    """What the proof of the lower bound says of every bound: of all directions' steps, those up
    and down the gradient are the smallest, taken together."""
    rng = np.random.default_rng(8)
    n = 50
    kinds = set()
    for bound, case, steepest in cases(rng, n):
        steep = steepest * rng.uniform(0, 1, n)
        ends = np.minimum(*(exact_step(bound, case, s * steep) for s in (1, -1)))
        for _ in range(4):
            any_way = exact_step(bound, case, steep * rng.uniform(-1, 1, n))
            assert (ends <= any_way * (1 + 1e-12)).all(), bound
        # The comparison would notice slopes of no influence or of the wrong sign.
        if bound not in (HarnackEnclosure, LipschitzEnclosure):
            assert (exact_step(bound, case, steep) > ends * 1.01).mean() > 0.05
        kinds.add(bound)
    assert kinds == {
        SphericalCapEnclosure,
        HarnackSlopeEnclosure,
        HarnackEnclosure,
        LipschitzEnclosure,
        TaylorEnclosure,
    }


def true_distance(field: hk.Field, x: np.ndarray, rays: int) -> np.ndarray:
    """From points to the nearest of many samples of the surface, which then slide along it towards
    the point: never less than the true distance, and nearly always that."""
    tree = cKDTree(surface_points(field, rays))
    distance, which = tree.query(x)
    y = tree.data[which]
    for _ in range(15):
        g = off_level(field, y)[1]
        n, r = unit(g), x - y
        there = y + 0.5 * (r - np.einsum("nk,nk->n", r, n)[:, None] * n)
        for _ in range(3):
            above, g = off_level(field, there)
            there = there - (above / np.einsum("nk,nk->n", g, g))[:, None] * g
        above, g = off_level(field, there)
        moved = np.linalg.norm(x - there, axis=1)
        better = (np.abs(above) <= 1e-11 * np.linalg.norm(g, axis=1)) & (moved < distance)
        y, distance = np.where(better[:, None], there, y), np.where(better, moved, distance)
    return np.minimum(distance, boundary_distance(field, x))


def check_lower_bound(field: hk.Field, points: int, rays: int, precision: Any) -> float:
    """That it never exceeds the true distance; returns the median of their ratio."""
    x = points_around(field, points, seed=9)
    on = surface_points(field, points // 4, seed=10)
    rng = np.random.default_rng(11)
    near = on + 10 ** rng.uniform(-6, -0.5, (len(on), 1)) * unit(rng.normal(size=(len(on), 3)))
    if field.domain is not None:
        near = near[field.domain.contains_points(near)]
    x[: len(near)] = near
    lower = np.abs(signed_distance(field, x, method="lower_bound", precision=precision))
    exact = true_distance(field, x, rays)
    assert (lower <= exact * (1 + 1e-12)).all()
    # It is close enough to the truth for the comparison to notice three percent.
    assert (lower * 1.03 > exact).any()
    return float(np.median(lower / exact))


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["wavy", "polynomial", "gyroid"])
def test_the_lower_bound_is_one(name: str) -> None:
    assert check_lower_bound(CURVED[name], 2000, 20_000, "double") > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", ["wavy", "knot", "polynomial", "gyroid"])
def test_the_lower_bound_is_one_at_many_points(name: str, precision: Any) -> None:
    """100,000 points in each precision."""
    assert check_lower_bound(CURVED[name], 25_000, 300_000, precision) > 0.3


def test_the_lower_bound_holds_in_random_directions() -> None:
    """Walks of that length in any direction meet no level, not by sampling of the surface."""
    rng = np.random.default_rng(12)
    for name in ("knot", "polynomial", "Y 5,3"):
        field = CURVED[name]
        x = points_around(field, 400, seed=13)
        lower = np.abs(signed_distance(field, x, method="lower_bound"))
        above, _ = off_level(field, x)
        room = np.inf if field.period is None else field.period - np.abs(above)
        for _ in range(20):
            d = unit(rng.normal(size=(len(x), 3)))
            moved = lift_along_rays(field, x, d, lower[:, None] * np.linspace(0, 1, 17)).moved
            away = np.sign(above)[:, None] * moved  # from the nearest level in value
            assert (away >= -np.abs(above)[:, None] - 1e-12).all(), name
            assert (away <= np.broadcast_to(room, len(x))[:, None] + 1e-12).all(), name


def test_points_outside_the_domain_have_no_lower_bound() -> None:
    with pytest.raises(ValueError, match=r"entry 1 and 1 more outside the domain of Gyroid"):
        signed_distance(hk.Gyroid(), [[0, 0, 0], [9, 0, 0], [0, 9, 0]], method="lower_bound")


# --- surfaces along which the gradient is zero -------------------------------------------------

BOX = hk.Box((-2.5, -2.5, -2.5), (2.5, 2.5, 2.5))


def to_sphere(x: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(x, axis=1) - 1)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("text", "exact"),
    [
        ("(x^2 + y^2 + z^2 - 1)^3", to_sphere),
        ("x*x*y", lambda x: np.abs(x[:, :2]).min(axis=1)),
        ("(x^2 + y^2 + z^2 - 1)^2 * x^3", lambda x: np.fmin(to_sphere(x), np.abs(x[:, 0]))),
        ("(x^2 + y^2 + z^2 - 1)^2", to_sphere),
        ("(x^2 + y^2 + z^2 - 1)^7", to_sphere),
        ("1e-30 * (x^2 + y^2 + z^2 - 1)^3", to_sphere),
    ],
)
def test_surfaces_along_which_the_gradient_is_zero(text: str, exact: Any) -> None:
    """Of a cube nearly all distances were NaN: Newton's method shrinks by a third at each step."""
    x = np.concatenate([[[0, 0, 1.5]], np.random.default_rng(4).uniform(-2, 2, (150, 3))])
    computed = signed_distance(hk.expression(text, domain=BOX), x)
    assert np.abs(np.abs(computed) - exact(x)).max() < 1e-7
    bounds = hk.distance.distance_bounds(hk.expression(text, domain=BOX), x[:10])
    assert (bounds.lower <= exact(x[:10]) + 1e-12).all()


# --- fields that jump --------------------------------------------------------------------------


def test_sheets_count() -> None:
    x = np.random.default_rng(14).uniform(-2, 2, (2000, 3))
    exact = Step.distance(x)
    lower = signed_distance(Step(), x, method="lower_bound")
    assert (np.abs(lower) <= exact * (1 + 1e-12)).all()
    assert np.median(np.abs(lower) / exact) > 0.9
    for method in ("closest_point", "first_order"):
        found = signed_distance(Step(), x, method=method)  # type: ignore[arg-type]
        assert (np.sign(found) == np.sign(0.3 * x[:, 2] + (x[:, 0] > 0) - 0.5)).all()
        # Where a smooth half-plane ends at the sheet the closest point of its rim is no foot.
        assert (np.abs(found) >= exact - 1e-12).mean() > (
            0.99 if method == "closest_point" else 0.5
        )
        assert (np.abs(np.abs(found) - exact) < 1e-9).mean() > 0.5


def test_sheets_count_in_single_precision() -> None:
    x = np.random.default_rng(15).uniform(-1, 1, (500, 3))
    found = np.abs(signed_distance(Step(), x, precision="single"))
    assert np.abs(found - Step.distance(x)).max() < 1e-6
    lower = np.abs(signed_distance(Step(), x, method="lower_bound", precision="single"))
    assert (lower <= Step.distance(x)).all()


def test_points_on_a_sheet() -> None:
    """The sheet is the surface for |z| < 5/3 only."""
    x = np.array([[0.0, 0.3, 1.0], [0.0, 1.0, -1.5], [0.0, 0.0, 2.0]])
    found = np.abs(signed_distance(Step(), x))
    assert found[:2] == pytest.approx([0, 0], abs=1e-9)
    assert found[2] == pytest.approx(1 / 3, abs=1e-6)
    assert signed_distance(Step(), x, method="lower_bound").tolist() == [0, 0, 0]


def test_a_field_must_say_how_far_its_sheets_are() -> None:
    class Quiet(PlaneJumps):
        distance = hk.fields.Jumps.distance

    class Silent(Step):
        traits = hk.fields.Traits(has_jumps=True)

        def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.SampleEvaluator:
            return hk.fields.SampleEvaluator(self, backend, jumps=Quiet())

    with pytest.raises(NotImplementedError, match=r"Silent has jumps.*distance\(p\) of its Quiet"):
        signed_distance(Silent(), [[1.0, 0.0, 0.0]], method="lower_bound")


# --- input -------------------------------------------------------------------------------------

METHODS = ("first_order", "second_order", "closest_point", "lower_bound")


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
def test_results_are_float64_arrays_of_the_same_length(method: Any) -> None:
    for n in (0, 7):
        for precision in ("single", "double"):
            x = np.full((n, 3), 0.3)
            found = signed_distance(WAVY, x, method=method, precision=precision)  # type: ignore[arg-type]
            assert found.shape == (n,)
            assert found.dtype == np.float64
    assert closest_points(WAVY, np.zeros((0, 3))).shape == (0, 3)
    assert curvature(WAVY, np.zeros((0, 3))).normal.shape == (0, 3)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
def test_batches_make_no_difference(method: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    x = points_around(WAVY, 40)
    whole = signed_distance(WAVY, x, method=method)
    monkeypatch.setattr(tangent_plane, "_BATCH_SIZE", 17)
    assert np.allclose(signed_distance(WAVY, x, method=method), whole, rtol=1e-12)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS)
def test_precisions_agree(method: Any) -> None:
    x = points_around(WAVY, 300)
    double = signed_distance(WAVY, x, method=method)
    single = signed_distance(WAVY, x, method=method, precision="single")
    assert np.quantile(np.abs(single - double) / np.abs(double), 0.95) < 2e-3
    if method == "lower_bound":
        assert np.median(single / double) > 0.99


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([0.0, 0.0, 0.0], r"points must have shape \(n, 3\)"),
        (np.zeros((4, 2)), r"points must have shape \(n, 3\)"),
        ([[0.0, math.nan, 0.0]], "points has NaN or infinite values: entry 0"),
        ([[0.0, 0.0, 0.0], [math.inf, 0.0, 0.0]], "points has NaN or infinite values: entry 1"),
    ],
)
@pytest.mark.parametrize("method", [*METHODS, "curvature"])
def test_bad_points(method: Any, points: Any, message: str) -> None:
    given = {} if method == "curvature" else {"method": method}
    function: Any = curvature if method == "curvature" else signed_distance
    with pytest.raises(ValueError, match=message):
        function(hk.Gyroid(), points, **given)


def test_other_bad_input() -> None:
    x = [[0.1, 0.2, 0.3]]
    with pytest.raises(
        ValueError, match=r"unknown method 'third'; choose one of \"first_order\", "
    ):
        signed_distance(WAVY, x, method="third")  # type: ignore[arg-type]
    with pytest.raises(NotImplementedError, match="Bare gives no second derivatives"):
        signed_distance(Bare(), x, method="second_order")
    with pytest.raises(ValueError, match="no surface has level 7"):
        signed_distance(hk.Gyroid(), x, level=7.0)
    with pytest.raises(ValueError, match="level must be finite"):
        signed_distance(WAVY, x, level=math.nan)
    with pytest.raises(ValueError, match='precision is "single" or "double"'):
        signed_distance(WAVY, x, precision="half")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="real numbers"):
        signed_distance(WAVY, [["a", "b", "c"]])


def test_several_levels() -> None:
    x = [[0.5, 0.0, 0.0], [0.0, 1.7, 0.0]]
    found = signed_distance(Bare(), x, level=[1.0, 2.0])
    assert found == pytest.approx([-0.5, -0.3])


@pytest.mark.few(1)
@pytest.mark.parametrize("far", [1e90, 1e99])
def test_distances_from_very_far_away_come_without_warnings_of_numpy(far: float) -> None:
    field = hk.SolidAngle(example_curves.wavy_polygon(12))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="overflow|divide|invalid")
        found = signed_distance(field, [[far, 0, 0]], method="closest_point", precision="double")
    assert np.isnan(found) | (np.abs(found) >= 0.99 * far)


# --- creases ----------------------------------------------------------------------------------

_ATOL_CREASE = 1e-9


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("point", "expected"),
    [
        # Outside, the distance of a union is the smaller one of its operands.
        ((0.68198523, 0.66800878, 0.32818945), 0.00947903),
        # Inside, nearest to the crease.
        ((1.0737746, -0.17090853, -0.16507987), -0.20011330),
    ],
)
def test_distance_of_a_union_beside_its_crease(point: Any, expected: float) -> None:
    """At these points among 2,000 uniform ones descents ended on the wrong operand, or beside the
    crease."""
    solid = hk.Sphere(1.0) | hk.Torus(1.2, 0.4)
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (2000, 3))
    row = int(np.argmin(np.linalg.norm(points - point, axis=1)))
    assert points[row] == pytest.approx(point, abs=1e-7)
    assert signed_distance(solid, points)[row] == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_distances_inside_a_lens_are_exact_at_its_edge() -> None:
    """The lens of two unit spheres, also as the complement of the union of their complements: the
    nearest point of a point in the middle plane is on the edge or on a cap."""
    left, right = (hk.Sphere(1.0).translated((x, 0, 0)) for x in (-0.4, 0.4))
    points = np.random.default_rng(5).uniform((0.0, -1.5, -1.5), (0.0, 1.5, 1.5), (500, 3))
    radius = np.linalg.norm(points, axis=1)
    edge = math.sqrt(1 - 0.16)
    expected = np.where(radius > edge, radius - edge, 1 - np.hypot(0.4, radius))
    for solid in (left & right, ~(~left | ~right)):
        distance = signed_distance(solid, points)
        assert np.abs(distance) == pytest.approx(expected, abs=_ATOL_CREASE)


def test_distance_of_a_cuboid_from_its_corner() -> None:
    """The function of a cuboid is its distance outside: where that is proved, it is the result,
    also where descents along the surface end beside the corner."""
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (20000, 3))
    half = np.array([1.0, 0.7, 0.5])
    excess: Any = np.abs(points) - half
    outside: Any = np.linalg.norm(np.maximum(excess, 0), axis=1)
    expected: Any = outside + np.minimum(excess.max(axis=1), 0)
    distance = signed_distance(hk.Cuboid((2.0, 1.4, 1.0)), points)
    assert distance == pytest.approx(expected, abs=1e-6)


def test_operands_of_nested_combinations() -> None:
    """At every point the function of a combination is that of one of its operands."""
    drilled = hk.Cuboid((2.0, 2.0, 2.0)) - hk.Cylinder(0.4, 3.0)
    field = (~drilled).offset(-0.1) | hk.Sphere(0.5)
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3))
    values = [operand.value(points) for operand in field.operands()]
    assert len(values) == 3
    difference = np.abs(np.array(values) - field.value(points)).min(axis=0)
    assert difference == pytest.approx(0, abs=1e-12)
    assert hk.Sphere(1.0).operands()[1:] == ()
