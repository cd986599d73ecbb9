"""Second derivatives of fields: against differences, closed forms, and in single precision."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, cast

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.geometry import example_curves
from harnack.geometry.polygons import remaining_edges
from harnack.testing import BrokenPromiseError, check_field

MANY_TERMS = hk.fields.EigenfunctionSum(
    [
        hk.fields.PlaneWave(0.7, (1.0, -2.0, 0.5), 0.3),
        hk.fields.PlaneWave(-0.4, (0.0, 3.0, 0.0)),
        hk.fields.WaveProduct(
            0.4, x=hk.fields.cosine_factor(2.0), y=hk.fields.sine_factor(3.0, 0.2)
        ),
        hk.fields.WaveProduct(
            1.3,
            hk.fields.sine_factor(1.0),
            hk.fields.cosine_factor(2.0, -1.0),
            hk.fields.sine_factor(0.5),
        ),
        hk.fields.WaveProduct(0.25, z=hk.fields.sine_factor(2.0)),
        hk.fields.WaveProduct(0.1),
    ]
)
FIELDS: dict[str, hk.Field] = {
    "triangle": hk.SolidAngle([[0, 0, 0], [1, 0, 0], [0, 1, 0.4]]),
    "wavy": hk.SolidAngle(example_curves.wavy_polygon(24)),
    "large trefoil": hk.SolidAngle(300 * example_curves.torus_knot(2, 3, 61) + 100),
    "holes": hk.SolidAngle(example_curves.square_with_holes(12)),
    "Y 0,0 + x": hk.HarmonicPolynomial({(0, 0, 0): 1.0, (1, 0, 0): 2.0}),
    "Y 12,-7": hk.SphericalHarmonic(12, -7, radius=2.0),
    "polynomial": hk.HarmonicPolynomial(
        {(2, 1, 0): 1, (0, 1, 2): -1, (1, 1, 1): 0.5, (1, 0, 0): 3}
    ),
    "gyroid": hk.Gyroid(cell=3.0),
    "P": hk.fields.SchwarzP(),
    "D": hk.fields.SchwarzD(),
    "many terms": MANY_TERMS,
}
HARMONIC = ("triangle", "wavy", "large trefoil", "holes", "Y 0,0 + x", "Y 12,-7", "polynomial")


def gradient(field: hk.Field, points: np.ndarray) -> np.ndarray:
    backend = choose_backend("double")
    sample = field.evaluator(backend).evaluate(to_vector3(backend, points))
    return np.broadcast_to(to_numpy(sample.gradient), points.shape)


def hessian(field: hk.Field, points: np.ndarray, precision: Any = "double") -> np.ndarray:
    backend = choose_backend(precision)
    rows = field.evaluator(backend).hessian(to_vector3(backend, points))
    return np.stack([np.broadcast_to(to_numpy(row), points.shape) for row in rows], axis=1).astype(
        np.float64
    )


def differences(field: hk.Field, points: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Central differences of the gradient, of order h^4."""
    result = np.zeros((len(points), 3, 3))
    for axis in range(3):
        for node, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
            there = points.copy()
            there[:, axis] += node * h
            result[:, :, axis] += weight / 12 * gradient(field, there) / h[:, None]
    return result


def random_points(field: hk.Field, n: int, seed: int = 0) -> np.ndarray:
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    lower, upper = volume.bounds()
    return np.random.default_rng(seed).uniform(lower, upper, (n, 3))


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def size(matrices: np.ndarray) -> np.ndarray:
    return np.abs(matrices).max(axis=(1, 2))


@pytest.mark.few(9)
@pytest.mark.parametrize("name", FIELDS)
def test_it_is_the_derivative_of_the_gradient(name: str) -> None:
    field = FIELDS[name]
    x = random_points(field, 200)
    if isinstance(field, hk.SolidAngle):
        x, near = away_from_curve(field, x)
    else:
        near = np.full(len(x), field.domain.radius)  # type: ignore[union-attr]
    found, expected = hessian(field, x), differences(field, x, 1e-3 * near)
    scale = size(expected) + np.linalg.norm(gradient(field, x), axis=1) / near
    # A homogeneous polynomial of degree 12 is flat near the origin: 1e-3 is no small step there.
    assert (size(found - expected) <= 1e-7 * scale + 1e-10 * scale.max()).all()


def away_from_curve(field: hk.SolidAngle, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points that are not too near, and their distances to the curve."""
    backend = choose_backend("double")
    nearest = field.boundary.closest_point(to_vector3(backend, x))
    distance = np.linalg.norm(to_numpy(nearest) - x, axis=1)
    clear = distance > 1e-3 * np.ptp(x)
    return x[clear], distance[clear]


@pytest.mark.parametrize("name", FIELDS)
def test_it_is_symmetric_and_of_harmonic_fields_free_of_trace(name: str) -> None:
    found = hessian(FIELDS[name], random_points(FIELDS[name], 500))
    assert (found == found.transpose(0, 2, 1)).all()
    trace = np.abs(np.trace(found, axis1=1, axis2=2))
    if name in HARMONIC:
        assert (trace <= 1e-11 * (size(found) + 1e-3 * np.median(size(found)))).all()
    else:
        assert np.median(trace) > 0.01 * np.median(size(found))


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "l",
    [
        pytest.param(degree, marks=() if degree in (0, 1, 2, 3, 7, 12) else pytest.mark.slow)
        for degree in range(13)
    ],
)
def test_every_solid_harmonic(l: int) -> None:  # noqa: E741
    rng = np.random.default_rng(l)
    x = rng.uniform(-0.6, 0.6, (20, 3))
    for m in range(-l, l + 1):
        field = hk.SphericalHarmonic(l, m)
        found = hessian(field, x)
        expected = differences(field, x, np.full(len(x), 1e-3))
        assert (size(found - expected) <= 1e-7 * (1 + size(expected))).all(), m
        assert (np.abs(np.trace(found, axis1=1, axis2=2)) <= 1e-12 * (1 + size(found))).all(), m


def test_closed_form_of_a_polynomial() -> None:
    x, y, z = points = np.random.default_rng(1).uniform(-1, 1, (3, 50))
    field = hk.HarmonicPolynomial({(2, 1, 0): 1, (0, 1, 2): -1}, domain=hk.Ball(radius=3.0))
    expected = np.array([[2 * y, 2 * x, 0 * x], [2 * x, 0 * x, -2 * z], [0 * x, -2 * z, -2 * y]])
    assert np.abs(hessian(field, points.T) - expected.transpose(2, 0, 1)).max() < 1e-14


def test_a_product_of_waves_is_a_sum_of_plane_waves() -> None:
    """2 sin a cos b = sin(a+b) + sin(a-b), with the same factor twice in the sum."""
    product = hk.fields.EigenfunctionSum(
        [hk.fields.WaveProduct(2.0, x=hk.fields.sine_factor(1.5), z=hk.fields.cosine_factor(2.5))]
    )
    waves = hk.fields.EigenfunctionSum(
        [
            hk.fields.PlaneWave(1.0, (1.5, 0.0, 2.5), -0.5 * math.pi),
            hk.fields.PlaneWave(1.0, (1.5, 0.0, -2.5), -0.5 * math.pi),
        ]
    )
    x = random_points(product, 100)
    assert np.abs(hessian(product, x) - hessian(waves, x)).max() < 1e-13


def test_beside_a_long_edge_it_is_that_of_an_angle() -> None:
    """Omega = const - 2 phi about a line, phi the angle around it: second derivatives known."""
    far = 1e4
    field = hk.SolidAngle([[0, 0, -far], [0, 0, far], [2 * far, 0, 0]])
    rng = np.random.default_rng(2)
    phi, rho = rng.uniform(-3, 3, 200), 10 ** rng.uniform(-3, 0, 200)
    x = np.column_stack([rho * np.cos(phi), rho * np.sin(phi), rng.uniform(-1, 1, 200)])
    expected = np.zeros((200, 3, 3))
    expected[:, 0, 0], expected[:, 1, 1] = np.sin(2 * phi), -np.sin(2 * phi)
    expected[:, 0, 1] = expected[:, 1, 0] = -np.cos(2 * phi)
    expected *= 2 / rho[:, None, None] ** 2
    turn = np.sign(gradient(field, x)[:, 1] * np.cos(phi) - gradient(field, x)[:, 0] * np.sin(phi))
    assert (size(hessian(field, x) * turn[:, None, None] - expected) <= 1e-6 * size(expected)).all()


PLACES: dict[str, tuple[Callable[..., np.ndarray], float]] = {
    # Points for an edge from p to q, with u a unit vector; error in units of the Hessian. The
    # rounding of the place alone is 6e-8 of the curve's size over the distance to it.
    "one size away": (lambda p, q, u, s: 2 * u, 1e-5),
    "beside an edge": (lambda p, q, u, s: p + s * (q - p) + 1e-2 * u, 2e-4),
    "close beside an edge": (lambda p, q, u, s: p + s * (q - p) + 1e-4 * u, 2e-2),
    "beside a vertex": (lambda p, q, u, s: p + 1e-2 * u, 2e-4),
    "in line with an edge": (lambda p, q, u, s: p + (1.2 + 4 * s) * (q - p) + 1e-7 * u, 1e-3),
    "far away": (lambda p, q, u, s: 30 * u, 2e-4),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", ["wavy", "triangle"])
def test_single_precision_is_usable(name: str, place: str) -> None:
    field = FIELDS[name]
    assert isinstance(field, hk.SolidAngle)
    rng = np.random.default_rng(3)
    loop = field.loops[0]
    which = rng.integers(len(loop), size=500)
    where, allowed = PLACES[place]
    x = where(
        loop[which],
        np.roll(loop, -1, axis=0)[which],
        unit(rng.normal(size=(500, 3))),
        rng.uniform(0, 1, (500, 1)),
    )
    x = x.astype(np.float32).astype(np.float64)
    exact, rounded = hessian(field, x), hessian(field, x, "single")
    assert np.quantile(size(exact - rounded) / size(exact), 0.99) <= allowed
    trace = np.abs(np.trace(rounded, axis1=1, axis2=2))
    assert np.quantile(trace / size(exact), 0.99) <= min(allowed, 1e-4)


def test_a_hessian_may_be_asked_for_in_a_recorded_loop() -> None:
    backend = choose_backend("double")
    field = FIELDS["wavy"]
    evaluator = field.evaluator(backend)
    x = np.random.default_rng(4).uniform(-1, 1, (10, 3))
    p = to_vector3(backend, x)

    def body(i: Any, total: Any) -> Any:
        return i + 1, total + evaluator.hessian(p)[0]

    start = (backend.UInt32(0), backend.Array3f(0))
    _, total = dr.while_loop(start, lambda i, _: i < 3, body)
    assert np.allclose(to_numpy(total), 3 * hessian(field, x)[:, 0], rtol=1e-12)


class Bare(hk.Field):
    """A field that gives what tracing needs and no more."""

    def evaluate(self, p: Any) -> hk.fields.Sample:
        return hk.fields.Sample(p.x, type(p)(1.0, 0.0, 0.0), (hk.proofs.Lipschitz(1.0),))


def test_a_field_without_second_derivatives_says_so() -> None:
    backend = choose_backend("double")
    with pytest.raises(
        NotImplementedError, match=r"Bare gives no second derivatives.*hessian\(p\)"
    ):
        Bare().hessian(to_vector3(backend, [[0.0, 0.0, 0.0]]))
    check_field(Bare(), count=20)


@dataclasses.dataclass
class Spoiled(hk.Field):
    """A quadratic harmonic polynomial whose Hessian has something added to it."""

    xx: float = 0.0
    yy: float = 0.0
    xy: float = 0.0
    yx: float = 0.0
    domain = hk.Ball(radius=1.0)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        ball = hk.proofs.HarmonicBall(type(p.x)(1.0), -8.0, 8.0)
        return hk.fields.Sample(p.x * p.y, type(p)(p.y, p.x, 0.0), (ball,))

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        return SpoiledEvaluator(self, backend)


class SpoiledEvaluator(hk.fields.SampleEvaluator):
    def hessian(self, p: Any) -> Any:
        row, field = type(p), cast("Spoiled", self.field)
        return row(field.xx, 1 + field.xy, 0), row(1 + field.yx, field.yy, 0), row(0.0)


@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        (Spoiled(xy=1e-4), "not symmetric"),
        (Spoiled(xx=1e-4), "has a trace"),
        (Spoiled(xx=1e-4, yy=-1e-4), "not the derivative of the gradient"),
        (Spoiled(xy=1e-4, yx=1e-4), "not the derivative of the gradient"),
        (Spoiled(xx=math.nan), "not finite"),
    ],
)
def test_check_field_sees_a_wrong_hessian(spoiled: Spoiled, message: str) -> None:
    check_field(Spoiled(), count=20)
    with pytest.raises(BrokenPromiseError, match=message):
        check_field(spoiled, count=20)


class Creased(Spoiled):
    """Nothing says that it is smooth."""

    traits = hk.fields.Traits(has_creases=True)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        return dataclasses.replace(super().evaluate(p), promises=(hk.proofs.Lipschitz(1.0),))

    evaluator = Spoiled.evaluator


def test_check_field_sees_a_wrong_hessian_where_there_may_be_creases() -> None:
    """Differences were taken at the spacing at which values tell most of the gradient, 1e-7 of the
    size: there any Hessian is right up to rounding."""
    check_field(Creased(), count=20)
    with pytest.raises(BrokenPromiseError, match="derivative of the gradient"):
        check_field(Creased(xx=1e-4), count=20)


# --- the curve that level sets end in ---------------------------------------------------------


def test_closest_point_of_the_curve() -> None:
    field = hk.SolidAngle(10 * example_curves.wavy_polygon(12) + 7)
    x = np.random.default_rng(5).uniform(-10, 25, (200, 3))
    (loop,) = field.loops
    share = np.linspace(0, 1, 2001)[:, None, None]
    dense = (loop + share * (np.roll(loop, -1, axis=0) - loop)).reshape(-1, 3)
    expected = np.array([np.linalg.norm(dense - one, axis=1).min() for one in x])
    backend = choose_backend("double")
    found = to_numpy(field.boundary.closest_point(to_vector3(backend, x)))
    assert np.abs(np.linalg.norm(found - x, axis=1) - expected).max() < 1e-4


def test_edges_run_both_ways_are_no_boundary() -> None:
    """A square with a hole, cut to a single loop by a bridge that is run there and back."""
    square = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
    hole = [[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]]
    keyhole = [*square, square[0], *hole, hole[0]]
    start, end = remaining_edges((np.array(keyhole, float),))
    assert len(start) == 8
    assert not (np.abs(start - end) == 1).any()
    field = hk.SolidAngle(keyhole)
    backend = choose_backend("double")
    nearest = field.boundary.closest_point(to_vector3(backend, [[-1.5, -1.5, 0.0]]))
    assert np.linalg.norm(to_numpy(nearest) - [-1.5, -1.5, 0.0]) == pytest.approx(0.5)


def test_a_curve_that_cancels_as_a_whole_has_none() -> None:
    there = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    field = hk.SolidAngle([there, there[::-1]])
    assert field.boundary is None
    assert hk.Gyroid().boundary is None


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("length", [1e-90, 1e-40, 1e-25, 1e-18, 1e-12])
def test_tiny_edges_leave_all_numbers_finite(length: float, precision: str) -> None:
    """At the center of the curve, where single precision tells their ends apart."""
    square = [[0.0, 0, 0], [1, 1, 0.2], [-1, 1, 0], [-1, -1, -0.2], [1, -1, 0]]
    tiny = [square[0], [length, 0, 0], *square[1:]]
    backend = choose_backend(precision)  # type: ignore[arg-type]
    # Beside the tiny edge and at right angles to it, among others.
    x = [[0.0, 0.3, 0.1], [0, 0, 0.5], [0.3, 0.4, -0.2], [0, -0.1, 0], [3, 3, 3]]
    p = to_vector3(backend, x)
    field, other = (hk.SolidAngle(one, lift_bound="edges") for one in (tiny, square))
    for rows, expected in zip(field.hessian(p), other.hessian(p), strict=True):
        np.testing.assert_allclose(to_numpy(rows), to_numpy(expected), rtol=2e-3, atol=1e-4)
    sample, plain = field.evaluate(p), other.evaluate(p)
    np.testing.assert_allclose(to_numpy(sample.value), to_numpy(plain.value), atol=1e-5)
    np.testing.assert_allclose(
        to_numpy(sample.promises[0].radius),
        to_numpy(plain.promises[0].radius),
        rtol=1e-3,
        atol=1e-6,
    )
    nearest = to_numpy(field.boundary.closest_point(p))
    np.testing.assert_allclose(nearest, to_numpy(other.boundary.closest_point(p)), atol=1e-6)
