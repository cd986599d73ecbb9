"""Circles in solid angles: known values, promises, first hits against dense sampling."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import backend_of, choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import upload_floats
from harnack.enclosures import HarmonicBall
from harnack.fields.solid_angles.planar import planar_region
from harnack.fmm.circle_sums import UnitCircle
from harnack.geometry import CurveError, example_curves
from harnack.testing import check_field
from tests.oracles.circle_oracle import MixedOracle, circle_values
from tests.oracles.oracle import first_crossings
from tests.tracer.test_first_hits import is_near_surface, random_level, rotation, unit

FOUR_PI = 4 * math.pi
PRECISIONS = ("single", "double")

# r, z, Omega, its derivatives along r and z, second derivatives zz and rz, of the unit circle: by
# mpmath with 40 digits, the last two from a quadrature of Biot and Savart's integral.
KNOWN = np.array([
    (0.5, 0.25, -4.447982848783549539097, 1.524646012511350776508, 6.481919700280771919989,
     -8.76236690945049043309, 2.933349304826375041541),
    (0.125, -1.5, 1.049474995533620685892, -0.09228867859587594925903, 1.062900844393305943139,
     1.46838419875384021202, -0.1515222041983834551671),
    (2.0, 0.5, -0.2324196235421854810061, 0.3811615031278376941271, -0.3332445468484165923826,
     0.6393150976164798721163, 0.3666686631032968801827),
    (3.0, -2.0, 0.1396462283288360206374, -0.096204979685477833828, 0.0008611979846021082685094,
     -0.04342142055615534146288, -0.03405928198298819056063),
    (1.0, 0.5, -1.768723094544916402446, 3.293511621136948229958, 1.708765522493792546262,
     -2.152981535532843595131, -8.611926142131374380526),
    (1.0, -0.0009765625, 3.132792933990387274268, -2047.994010562356606172,
     8.010911974421306150164, 1024.002628507095383764, -2097157.383182531345949),
    (0.999755859375, 0.0001220703125, -5.354634307073931479321, 3277.199207567123777363,
     6563.68733035140063603, -21479097.10055802486864, 16108086.85839601754692),
    (1.00000095367431640625, 9.5367431640625e-07, -1.57078145348003564774, 1048575.499989798695098,
     -1048560.904198638715975, 1099510579200.749994423, -10.69684372760943731002),
    (2.0**-30, 0.75, -2.513274122871834589766, 2.15716048296418297965e-9,
     3.216990877275948275114, -4.63246686327736551925, -2.300971181828461848524e-9),
    (0.75, 2.0**-30, -6.283185295952863385028, 3.176461147548831282627e-8,
     12.05460213023653469584, -2.947977227477858305272e-7, 34.10699186434215129582),
    (1.00390625, 3.0, -0.2816897675055507622568, 0.07326474860098823078585,
     0.153069851140605878002, -0.1170341103135467507645, -0.07841696046146088558545),
    (1000.0, -700.0, 1.209117921385566186409e-6, -2.434465495647502192868e-9,
     -2.31840396753419997291e-11, -3.300414110898949944497e-12, -2.240740437023166152543e-12),
    (0.125, 1024.0, -2.996054016427526656928e-6, 1.071470608086043704635e-12,
     5.851663684605027839401e-9, -1.714352909073213388208e-11, -4.18542699545770254761e-15),
])  # fmt: skip


def unit_circle(r: np.ndarray, z: np.ndarray, precision: Any) -> tuple[np.ndarray, ...]:
    """Omega, its derivatives along r and z, Omega_zz and Omega_rz."""
    backend = choose_backend(precision)
    one = UnitCircle.at(upload_floats(backend, r), upload_floats(backend, z))
    along, mixed, _ = one.second_derivatives()
    found = one.angle, one.across * one.r, one.axial, along, mixed * one.r
    return tuple(to_numpy(value).astype(float) for value in found)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_values_of_forty_digits(precision: Any) -> None:
    epsilon = choose_backend(precision).machine_epsilon
    r, z, angle, radial, axial, zz, rz = KNOWN.T
    found = unit_circle(r, z, precision)
    assert np.abs(found[0] - angle).max() < 16 * epsilon
    away = np.hypot(found[1] - radial, found[2] - axial) / np.hypot(radial, axial)
    assert away.max() < 52 * epsilon
    # Second derivatives: relative to all of them, and to their rounding at distance d.
    d = np.hypot(r - 1, z)
    away = np.hypot(found[3] - zz, found[4] - rz) / np.hypot(zz, rz)
    # (the least position that the precision tells from the circle is one epsilon off)
    assert (away * np.minimum(d, 1)).max() < 16 * epsilon


@pytest.mark.parametrize("precision", PRECISIONS)
def test_values_on_the_axis_and_in_the_plane(precision: Any) -> None:
    epsilon = choose_backend(precision).machine_epsilon
    z = np.array([-3.0, -0.5, 0.25, 2.0, 50.0])
    angle, radial, axial, zz, _ = unit_circle(0 * z, z, precision)
    expected = -2 * np.pi * np.sign(z) * (1 - np.abs(z) / np.sqrt(1 + z * z))
    assert np.abs(angle - expected).max() < 16 * epsilon
    np.testing.assert_allclose(axial, 2 * np.pi * (1 + z * z) ** -1.5, rtol=16 * epsilon)
    np.testing.assert_allclose(zz, -6 * np.pi * z * (1 + z * z) ** -2.5, rtol=16 * epsilon)
    assert (radial == 0).all()
    r = np.array([0.0, 0.5, 0.99, 1.01, 4.0])
    angle, radial, axial, zz, _ = unit_circle(r, 0 * r, precision)
    two_pi = float(choose_backend(precision).dtype(2 * np.pi))
    np.testing.assert_array_equal(np.abs(angle), np.where(r < 1, two_pi, 0))
    assert (radial == 0).all()
    assert (zz == 0).all()
    assert (np.sign(axial) == np.where(r < 1, 1, -1)).all()


def random_circle(rng: np.random.Generator, scale: float = 1.0) -> hk.geometry.Circle:
    center, normal = scale * rng.uniform(-1, 1, 3), rng.normal(size=3)
    return hk.geometry.Circle(scale * rng.uniform(0.2, 1.0), tuple(center), tuple(normal))


def points_about(rng: np.random.Generator, circle: hk.geometry.Circle, n: int) -> np.ndarray:
    """A third anywhere, a third near the circle, a third near its plane and its axis."""
    x = rng.normal(0, 1.5, (n, 3))
    third = n // 3
    near = 10.0 ** rng.uniform(-3, -0.5, (third, 1)) * rng.normal(size=(third, 3))
    phi = rng.uniform(0, 2 * np.pi, third)
    x[:third] = np.column_stack([np.cos(phi), np.sin(phi), 0 * phi]) + near
    x[third : third + third // 2, 2] *= 10.0 ** rng.uniform(-6, -1, third // 2)
    x[third + third // 2 : 2 * third, :2] *= 1e-3
    axis = np.array(circle.normal)
    first, second = circle.polygon(4)[:2] - np.array(circle.center)
    frame = np.stack([first / circle.radius, second / circle.radius, axis])
    return np.array(circle.center) + circle.radius * x @ frame


@pytest.mark.parametrize("precision", PRECISIONS)
def test_any_circle_agrees_with_carlson_s_integrals(precision: Any) -> None:
    rng, epsilon = np.random.default_rng(1), choose_backend(precision).machine_epsilon
    for _ in range(4):
        circle = random_circle(rng, 10 ** rng.uniform(-2, 2))
        x = points_about(rng, circle, 1500)
        x = x.astype(choose_backend(precision).dtype).astype(float)
        truth, field = circle_values(circle, x), hk.SolidAngle(circle)
        d = truth.smooth / circle.radius
        size = np.abs(x).max(axis=1) / circle.radius + 2
        # Positions are rounded at the size of coordinates.
        place = epsilon * size * truth.gradient_norm * circle.radius
        away = np.abs(np.remainder(field.value(x, precision=precision) - truth.value + FOUR_PI / 2,
                                   FOUR_PI) - FOUR_PI / 2)  # fmt: skip
        assert (away <= 20 * epsilon + 4 * place).all()
        # Points in the plane have |Omega| of 2 pi or 0, whichever side rounding puts them on.
        apart = np.linalg.norm(field.gradient(x, precision=precision) - truth.gradient, axis=1)
        # (The oracle's own form of J cancels near the axis and far away.)
        tolerance = (64 + 16 * size / d) * epsilon + 1e-10
        assert (apart <= tolerance * truth.gradient_norm).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_circle_agrees_with_a_polygon_of_4096_sides(precision: Any) -> None:
    """The polygon of the same area: what is left falls with the square of the sides' length."""
    rng = np.random.default_rng(2)
    circle = hk.geometry.Circle(0.7, (0.3, -0.2, 0.1), (1.0, 2.0, -1.5))
    half = math.pi / 4096
    share = math.sqrt(2 * half / math.sin(2 * half))
    center = np.array(circle.center)
    loop = center + share * (circle.polygon(4096) - center)
    x = points_about(rng, circle, 600)
    x = x[np.abs(np.linalg.norm(x - center, axis=1) - 0.7) > 0.02]
    one, other = hk.SolidAngle(circle), hk.SolidAngle(loop, lift_bound="edges")
    tolerance = 1e-4 if precision == "single" else 1e-5
    apart = one.value(x, precision=precision) - other.value(x, precision=precision)
    apart = np.remainder(apart + FOUR_PI / 2, FOUR_PI) - FOUR_PI / 2
    gradients = [field.gradient(x, precision=precision) for field in (one, other)]
    scale = 1 + np.linalg.norm(gradients[0], axis=1)
    assert (np.abs(apart) < tolerance * scale).all()
    assert (np.linalg.norm(gradients[0] - gradients[1], axis=1) < 20 * tolerance * scale**2).all()
    hessians = [field.hessian(x, precision=precision) for field in (one, other)]
    norms = np.linalg.norm(hessians[0], axis=(1, 2))
    apart = np.linalg.norm(hessians[0] - hessians[1], axis=(1, 2))
    assert (apart < 100 * tolerance * (1 + norms) ** 1.5).all()


def court(height: float = 0.0) -> np.ndarray:
    """An outline about a circle of radius 0.6; of four corners, two are raised."""
    return np.array([[-1, -1.4, height], [1, -1.4, 0], [1, 1.25, height], [-1, 1.25, 0.0]])


HOLE = hk.geometry.Circle(0.6, normal=(0, 0, -1))
TILTED = hk.geometry.Circle(0.8, (0.1, 0.2, 0.3), (1, 2, 3))
FIELDS: dict[str, hk.SolidAngle] = {
    "circle": hk.SolidAngle(hk.geometry.Circle(1.0)),
    "circle, edges": hk.SolidAngle(TILTED, lift_bound="edges"),
    "large circle": hk.SolidAngle(hk.geometry.Circle(300.0, (500.0, 0, -200.0), (1, 0, 1))),
    "ring": hk.SolidAngle(
        [hk.geometry.Circle(1.0), hk.geometry.Circle(0.4, (0.2, 0, 0), (0, 0, -1))]
    ),
    "coaxial": hk.SolidAngle([hk.geometry.Circle(1.0), hk.geometry.Circle(0.8, (0, 0, 0.5))]),
    "linked": hk.SolidAngle(
        [hk.geometry.Circle(1.0), hk.geometry.Circle(1.0, (1.0, 0, 0), (0, 1, 0))]
    ),
    "court": hk.SolidAngle([court(), HOLE]),
    "court, edges": hk.SolidAngle([court(), HOLE], lift_bound="edges"),
    "bent court": hk.SolidAngle([court(0.4), HOLE]),
    "trefoil and circle": hk.SolidAngle(
        [example_curves.torus_knot(2, 3, 40), hk.geometry.Circle(0.5)]
    ),
    "twice": hk.SolidAngle([hk.geometry.Circle(1.0), hk.geometry.Circle(1.0)]),
}
SOME = ("circle", "ring", "coaxial", "court")
EVERY = [pytest.param(name, marks=() if name in SOME else pytest.mark.slow) for name in FIELDS]


@pytest.mark.few(1)
@pytest.mark.parametrize("name", EVERY)
def test_contracts(name: str) -> None:
    check_field(FIELDS[name])


def sample_at(field: hk.SolidAngle, x: Any, precision: Any = "double") -> Any:
    backend = choose_backend(precision)
    return field.evaluator(backend).evaluate(to_vector3(backend, x))


@pytest.mark.few(2)
@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_lifts_stay_in_the_range_promised(name: str, precision: Any) -> None:
    """By an oracle followed along radii of the ball, many of which end beside the curve."""
    field, rng = FIELDS[name], np.random.default_rng(3)
    oracle = MixedOracle(field.loops, field.circles)
    box = [one.polygon(8) for one in field.circles] + list(field.loops)
    low, high = np.concatenate(box).min(axis=0), np.concatenate(box).max(axis=0)
    size = float((high - low).max())
    n = 2500
    x = rng.uniform(low - size, high + size, (n, 3))
    for one in field.circles:  # half of them near a circle or its plane
        part = rng.integers(0, n, n // 4)
        x[part] = points_about(rng, one, len(part))
    x = x.astype(np.float32).astype(float)
    sample = sample_at(field, x, precision)
    value, error = (
        np.broadcast_to(to_numpy(v).astype(float), n) for v in (sample.value, sample.value_error)
    )
    ok = oracle(x).smooth > 1e-4 * size
    direction = unit(rng.normal(size=(n, 3)))
    # Towards the nearest point of the curve, roughly, half of the time.
    p = to_vector3(choose_backend("double"), x)
    toward = to_numpy(field.boundary.closest_point(p)) - x
    direction[::2] = unit(toward[::2] + 0.2 * np.linalg.norm(toward[::2], axis=1)[:, None]
                          * direction[::2])  # fmt: skip
    start = oracle(x).value
    drift = np.abs(np.remainder(value - start + FOUR_PI / 2, FOUR_PI) - FOUR_PI / 2)
    # Where the whole ball is small (beside the curve), what rounding did to x shows.
    slack = drift + error + 1e-6 + (1e-3 if precision == "single" else 0)
    balls = [one for one in sample.all_promises if isinstance(one, HarmonicBall)]
    assert balls
    for ball in balls:
        radius, low, high = (
            np.broadcast_to(to_numpy(v).astype(float), n)
            for v in (ball.radius, ball.lower, ball.upper)
        )
        assert (radius[ok] > 0).mean() > 0.99
        lift, before = value.copy(), start
        for share in 1 - np.geomspace(1, 1e-3, 40)[1:]:
            now = oracle(x + (share * radius)[:, None] * direction).value
            lift += np.remainder(now - before + FOUR_PI / 2, FOUR_PI) - FOUR_PI / 2
            before = now
            assert (lift >= low - slack)[ok].all(), np.flatnonzero((lift < low - slack) & ok)
            assert (lift <= high + slack)[ok].all(), np.flatnonzero((lift > high + slack) & ok)


def sums_over(field: hk.SolidAngle, x: np.ndarray) -> Any:
    """The sums over a field's circles, in its unit coordinates."""
    backend = choose_backend("double")
    on = field.evaluator(backend).data
    assert on.circles is not None
    return on.circles.sums(on.to_unit(to_vector3(backend, x)))


def test_the_gradient_s_bound_is_attained_at_the_center() -> None:
    """The integral of |dp|/D^2 bounds it: at the center it is the gradient."""
    field = hk.SolidAngle(TILTED, lift_bound="edges")
    sums = sums_over(field, np.array([TILTED.center]))
    share = dr.norm(sums.gradient) / sums.inverse_squares
    assert 1 - 1e-12 < share[0] <= 1 + 1e-12
    # Elsewhere it is a bound, and nearly attained beside the circle.
    sums = sums_over(field, points_about(np.random.default_rng(0), TILTED, 20000))
    share = to_numpy(dr.norm(sums.gradient) / sums.inverse_squares)
    assert 0.99 < share.max() <= 1 + 1e-9


def test_the_bound_of_second_derivatives_is_attained_on_the_axis() -> None:
    """At 45 degrees to the circle, where (v.D)(v.(D x dp)) is half of |D|^2 |dp| everywhere."""
    field = FIELDS["circle"]
    on_axis = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    square = field._size**2
    bend = 1.5 * to_numpy(sums_over(field, on_axis).inverse_cubes) / square
    along = np.abs(field.hessian(on_axis, precision="double")[:, 2, 2])
    np.testing.assert_allclose(along, bend, rtol=1e-12)
    x = points_about(np.random.default_rng(0), hk.geometry.Circle(1.0), 30000)
    largest = np.abs(np.linalg.eigvalsh(field.hessian(x, precision="double"))).max(axis=1)
    share = largest * square / (1.5 * to_numpy(sums_over(field, x).inverse_cubes))
    assert 0.95 < share.max() <= 1 + 1e-9


@pytest.mark.parametrize("name", ["circle", "circle, edges", "court", "linked", "large circle"])
def test_hessians_are_derivatives_of_gradients(name: str) -> None:
    field, rng = FIELDS[name], np.random.default_rng(4)
    size = field._size
    x = np.concatenate([points_about(rng, one, 300) for one in field.circles])
    d = MixedOracle(field.loops, field.circles)(x).smooth
    x, d = x[d > 0.02 * size], d[d > 0.02 * size]
    h = 1e-4 * d[:, None]
    rows = [
        (field.gradient(x + h * e, precision="double")
         - field.gradient(x - h * e, precision="double")) / (2 * h)
        for e in np.eye(3)
    ]  # fmt: skip
    hessian = field.hessian(x, precision="double")
    norm = np.linalg.norm(hessian, axis=(1, 2))
    np.testing.assert_array_less(np.linalg.norm(np.stack(rows, 1) - hessian, axis=(1, 2)),
                                 1e-5 * norm + 1e-7 / size**2)  # fmt: skip
    np.testing.assert_allclose(np.trace(hessian, axis1=1, axis2=2) / norm, 0, atol=1e-12)
    single = field.hessian(x, precision="single")
    assert (np.linalg.norm(single - hessian, axis=(1, 2)) < 1e-3 * norm).all()


def test_circles_that_are_run_back_cancel() -> None:
    there = hk.geometry.Circle(1.0, (0.5, 0, 0), (0, 3, 4))
    nothing = hk.SolidAngle([there, there.reversed()])
    assert not hk.trace(nothing, [[0.5, 0, 2]], [[0, 0, -1]]).is_hit.any()
    with pytest.raises(ValueError, match="cancel each other"):
        hk.trace(nothing, [[0.5, 0, 2]], [[0, 0, -1]], level=0.0)
    left = hk.SolidAngle([there, there.reversed(), TILTED])
    x = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_array_equal(left.value(x), hk.SolidAngle(TILTED).value(x))


def test_regions_of_planes_are_found() -> None:
    ring, hole = hk.geometry.Circle(1.0), hk.geometry.Circle(0.3, normal=(0, 0, -1))
    assert planar_region((), (ring, hole)) is not None
    assert planar_region((), (ring.reversed(), hole.reversed())) is not None
    assert planar_region((court(),), (HOLE,)) is not None
    assert planar_region((court()[::-1],), (HOLE.reversed(),)) is not None
    assert (
        planar_region((), (hk.geometry.Circle(1.0), hk.geometry.Circle(1.0, (3, 0, 0)))) is not None
    )
    # A hole run the same way counts twice; the other way outside, there are three values.
    assert planar_region((), (ring, hole.reversed())) is None
    assert (
        planar_region((), (hk.geometry.Circle(1.0), hk.geometry.Circle(1.0, (3, 0, 0), (0, 0, -1))))
        is None
    )
    # Crossing, touching, in another plane, not flat.
    assert planar_region((), (ring, hk.geometry.Circle(0.5, (0.8, 0, 0), (0, 0, -1)))) is None
    assert planar_region((), (ring, hk.geometry.Circle(0.5, (0.5, 0, 0), (0, 0, -1)))) is None
    assert planar_region((), (ring, hk.geometry.Circle(0.5, (0, 0, 1e-3), (0, 0, -1)))) is None
    assert planar_region((court(),), (hk.geometry.Circle(1.05, normal=(0, 0, -1)),)) is None
    assert planar_region((court(1e-6),), (HOLE,)) is None
    assert FIELDS["bent court"].describe()["lift_bound"] == "edges"
    with pytest.raises(ValueError, match="region of a plane"):
        hk.SolidAngle([court(0.4), HOLE], lift_bound="planar")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hk.geometry.Circle(0.0), "radius of a circle"),
        (lambda: hk.geometry.Circle(math.nan), "finite"),
        (lambda: hk.geometry.Circle(-1.0), "radius of a circle"),
        (lambda: hk.geometry.Circle([1.0, 2.0]), "must be a number"),  # type: ignore[arg-type]
        (lambda: hk.geometry.Circle(1.0, (0, 0)), "three numbers"),  # type: ignore[arg-type]
        (lambda: hk.geometry.Circle(1.0, (0, 0, math.inf)), "finite"),
        (lambda: hk.geometry.Circle(1.0, (0, 0, 1e200)), "smaller units"),
        (lambda: hk.geometry.Circle(1.0, normal=(0, 0, 0)), "direction of its axis"),
        (lambda: hk.SolidAngle([hk.geometry.Circle(1.0), [[0, 0, 0], [1, 0, 0]]]), "loop 1 has 2"),
    ],
)
def test_what_is_no_circle(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="radius of a circle"):
        hk.geometry.Circle("one")  # type: ignore[arg-type]
    assert issubclass(CurveError, ValueError)


def test_where_a_circle_is() -> None:
    circle = hk.geometry.Circle(2.0, (1.0, -1.0, 0.5), (0.0, 3.0, 4.0))
    assert circle.normal == (0.0, 0.6, 0.8)
    low, high = circle.bounds()
    polygon = circle.polygon(2000)
    np.testing.assert_allclose(polygon.min(axis=0), low, atol=1e-5)
    np.testing.assert_allclose(polygon.max(axis=0), high, atol=1e-5)
    # Counter-clockwise as seen from the normal's tip; the one around it touches it from outside.
    area = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0) / 2
    np.testing.assert_allclose(area, math.pi * 4 * np.array(circle.normal), rtol=1e-4, atol=1e-4)
    around = circle.polygon(6, circumscribed=True)
    middle = 0.5 * (around + np.roll(around, -1, axis=0)) - np.array(circle.center)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 2.0)


@pytest.mark.slow
def test_closest_points_of_the_boundary() -> None:
    field, rng = FIELDS["court"], np.random.default_rng(5)
    x = rng.normal(0, 1.5, (400, 3))
    x[0] = 0, 0, 1.0  # on the axis, all points of the circle are as near
    backend = choose_backend("double")
    nearest = to_numpy(field.boundary.closest_point(to_vector3(backend, x)))
    d = MixedOracle(field.loops, field.circles)(x).smooth
    np.testing.assert_allclose(np.linalg.norm(nearest - x, axis=1), d, rtol=1e-9)
    on = MixedOracle(field.loops, field.circles)(nearest + 1e-12).smooth
    assert (on < 1e-9).all()
    found = hk.distance.closest_points(field, x[:20], level=-2 * math.pi + 1.2, precision="double")
    away = np.abs(np.remainder(field.value(found, precision="double") - 1.2, FOUR_PI) - FOUR_PI / 2)
    assert ((away < 1e-9) | (MixedOracle(field.loops, field.circles)(found).smooth < 1e-9)).all()
    assert (np.linalg.norm(found - x[:20], axis=1) <= d[:20] + 1e-9).all()


def test_values_can_be_differentiated_in_points() -> None:
    field = FIELDS["court"]
    backend = choose_backend("double")
    x = to_vector3(backend, [[0.3, 0.4, 0.5], [2.0, -1.0, 0.3]])
    dr.enable_grad(x)
    value = field.value(x)
    dr.backward(dr.sum(value))
    gradient = field.gradient(to_numpy(x), precision="double")
    np.testing.assert_allclose(to_numpy(dr.grad(x)), gradient, rtol=1e-12)
    assert backend_of(x) is backend


def random_curves(
    rng: np.random.Generator, kind: int
) -> tuple[list[np.ndarray], list[hk.geometry.Circle]]:
    """One of eight kinds of curves with circles, about 1 in size."""
    kinds = [
        lambda: ([], [random_circle(rng)]),
        lambda: (
            [],
            [
                hk.geometry.Circle(1.0),
                hk.geometry.Circle(rng.uniform(0.1, 0.7), (0.2, 0, 0), (0, 0, -1)),
            ],
        ),
        lambda: (
            [],
            [hk.geometry.Circle(rng.uniform(0.5, 1), (0, 0, z)) for z in np.linspace(-0.5, 0.5, 3)],
        ),
        lambda: (
            [],
            [
                hk.geometry.Circle(1.0),
                hk.geometry.Circle(1.0, (rng.uniform(0.2, 1.8), 0, 0), (0, 1, 0.3)),
            ],
        ),
        lambda: ([], [random_circle(rng) for _ in range(int(rng.integers(2, 7)))]),
        lambda: ([court()], [HOLE]),
        lambda: ([court(rng.uniform(-0.5, 0.5))], [HOLE, random_circle(rng)]),
        lambda: (
            [example_curves.spiky_polygon(rng, int(rng.integers(5, 12)))],
            [hk.geometry.Circle(0.5)],
        ),
    ]
    return kinds[kind % len(kinds)]()


def placed(
    rng: np.random.Generator, loops: list[np.ndarray], circles: list[hk.geometry.Circle]
) -> tuple[list[np.ndarray], list[hk.geometry.Circle]]:
    """Rotated at random, 1e-3 to 1e3 in size, and moved by up to twice its size."""
    scale, turn, shift = 10 ** rng.uniform(-3, 3), rotation(rng), rng.uniform(-1, 1, 3)
    moved = [
        hk.geometry.Circle(
            scale * one.radius,
            tuple(scale * (turn @ np.array(one.center) + shift)),
            tuple(turn @ np.array(one.normal)),
        )
        for one in circles
    ]
    return [scale * (loop @ turn.T + shift) for loop in loops], moved


def compare(seed: int, curves: int, rays: int, precision: Any) -> tuple[int, int, list[str]]:
    """Rays and hits, and what is wrong with some: rays from everywhere, a third of them grazing the
    surface or aimed at the curve."""
    rng = np.random.default_rng(seed)
    failures: list[str] = []
    total = hits_found = 0
    for kind in range(seed * curves, (seed + 1) * curves):
        loops, circles = placed(rng, *random_curves(rng, kind))
        oracle = MixedOracle(loops, circles)
        points = np.concatenate([*loops, *(one.polygon(48) for one in circles)])
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        size = float(np.linalg.norm(points - center, axis=1).max())
        o = center + size * rng.uniform(0.1, 3.0, (rays, 1)) * unit(rng.normal(size=(rays, 3)))
        target = center + size * rng.uniform(0, 1.2, (rays, 1)) * unit(rng.normal(size=(rays, 3)))
        third = rays // 3
        target[:third] = points[rng.integers(len(points), size=third)]
        away = 10 ** rng.uniform(-5, -1, (third, 1)) * size
        target[:third] += away * rng.normal(size=(third, 3))
        d = unit(target - o)
        gradient = oracle(target[-third:]).gradient
        tangent = unit(np.cross(gradient, rng.normal(size=(third, 3))))
        back = size * rng.uniform(0.5, 2, (third, 1))
        o[-third:], d[-third:] = target[-third:] - back * tangent, tangent
        o = o.astype(np.float32).astype(float)
        level, tolerance, far = random_level(rng), 1e-4 * size, 8 * size
        field = hk.SolidAngle([*loops, *circles])
        hits = hk.trace(field, o, d, level=level, t_max=far, tolerance=tolerance,
                        precision=precision)  # fmt: skip
        truth = first_crossings(oracle, o, d, 0.0, far, levels=[level], period=FOUR_PI,
                                depth=tolerance, finest=0.5 * tolerance)  # fmt: skip
        missed = hits.t > truth.beyond + 10 * tolerance
        early = np.zeros(rays, bool)
        at = np.flatnonzero(hits.is_hit)
        early[at] = ~is_near_surface(oracle, o[at], d[at], hits.t[at].astype(float), level,  # type: ignore[arg-type]
                                     10 * tolerance)  # fmt: skip
        out = hits.status == hk.RayStatus.OUT_OF_STEPS
        failures += [
            f"seed {seed} kind {kind} missed {missed[k]} early {early[k]} out {out[k]} "
            f"{o[k].tolist()} {d[k].tolist()} {level} {hits.t[k]} {truth.beyond[k]}"
            for k in np.flatnonzero(missed | early | out)
        ]
        total, hits_found = total + rays, hits_found + len(at)
    return total, hits_found, failures


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_first_hits(precision: Any) -> None:
    total, hits, failures = compare(0, 8, 45, precision)
    assert not failures, "\n".join(failures[:10])
    assert hits > 0.2 * total


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("seed", range(1, 5))
def test_many_first_hits(seed: int, precision: Any) -> None:
    """Over all seeds 3,360 rays and 32 curves in each precision."""
    total, hits, failures = compare(seed, 8, 105, precision)
    assert not failures, "\n".join(failures[:10])
    assert hits > 0.2 * total


@pytest.mark.parametrize("precision", PRECISIONS)
def test_rays_in_the_plane_and_at_the_circle(precision: Any) -> None:
    """Rays that run along the disk, through the circle itself and along the axis."""
    field = hk.SolidAngle(hk.geometry.Circle(1.0))
    o = np.array(
        [[-3.0, 0, 0], [-3.0, 0, 1e-6], [0, 0, 3.0], [-3.0, 1.0, 0], [-3, 2, 0], [1, 0, 2]]
    )
    d = np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, -1], [1, 0, 0], [1, 0, 0], [0, 0, -1]])
    hits = hk.trace(field, o, d, tolerance=1e-4, precision=precision)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    np.testing.assert_array_equal(hits.is_hit, [True, True, True, True, False, True])
    np.testing.assert_allclose(hits.t[[0, 1, 2, 5]], [2, 2, 3, 2], atol=2e-3)
    # Level 1: near the plane, rays that run beside the disk are far from the surface.
    assert (hits.evaluations < 60).all()


@pytest.mark.slow
def test_few_evaluations_a_ray() -> None:
    """At most twelve a hitting ray: of a circle, a ring, a court, and circles one above another."""
    rng = np.random.default_rng(0)
    o = np.array([2.2, -2.9, 1.6])
    d = unit(rng.uniform(-1, 1, (4000, 3)) * [1, 1.35, 0.15] + [0, 0, 0.2] - o)
    for name, level in (("circle", 1.2), ("ring", 1.2), ("court", 0.7), ("court", 1.2),
                        ("coaxial", 2 * math.pi)):  # fmt: skip
        hits = hk.trace(
            FIELDS[name], np.broadcast_to(o, d.shape), d, level=-level, t_max=20.0, tolerance=1e-4,
            precision="single",
        )  # fmt: skip
        assert hits.is_hit.mean() > 0.1
        assert hits.evaluations[hits.is_hit].mean() < 12.0, name
