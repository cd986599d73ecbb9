"""Sums and products of fields: what they are of their terms, that no first hit is missed, and
derivatives by weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f64, Float64

import harnack as hk
from harnack import math as hm
from harnack.backend import choose_backend
from harnack.enclosures import HarmonicBall
from harnack.fields import Field, FieldProduct, FieldSum, Formula
from harnack.testing import check_field, check_ray_samples
from tests.fields.test_contracts import Charges

_BALL = hk.Ball()
_CURVES = hk.geometry.example_curves
_RNG = np.random.default_rng(4)
_POINTS = _RNG.normal(size=(60, 3))
_POINTS /= np.linalg.norm(_POINTS, axis=1, keepdims=True)


def _waves(x: Any, y: Any, z: Any) -> Any:
    return hm.sin(6 * x) * hm.cos(6 * y) + hm.sin(6 * y) * hm.cos(6 * z) + 0.5 * z


Y20, Y31, Y42 = (hk.SphericalHarmonic(*degree) for degree in ((2, 0), (3, 1), (4, 2)))
GYROID = hk.Gyroid(0.8, domain=_BALL)
WAVES = hk.expression(_waves, domain=_BALL)
CREASES = hk.expression(lambda x, y, z: abs(x) + abs(y) - z, domain=_BALL)
CLOUD = hk.DipolePotential(0.6 * _POINTS, _POINTS, accuracy=100.0)
SMALL_CLOUD = hk.DipolePotential(0.3 * _POINTS + 0.2, _POINTS, accuracy=100.0)
LOOP, SMALL_LOOP = (
    hk.SolidAngle(size * _CURVES.wavy_polygon(n)) for n, size in ((12, 0.8), (7, 0.5))
)
BLOBS = hk.Blobs(np.random.default_rng(1).uniform(-0.4, 0.4, (6, 3)), 0.3)

# The field, and its values by NumPy.
Values = Callable[[Any], Any]
CASES: dict[str, tuple[Field, Values]] = {
    "harmonic": (2 * Y20 + Y31 - 0.1, lambda x: 2 * Y20.value(x) + Y31.value(x) - 0.1),
    "three": (
        Y20 / 2 - Y31 - 3 * Y42,
        lambda x: Y20.value(x) / 2 - Y31.value(x) - 3 * Y42.value(x),
    ),
    "gyroid": (0.3 * GYROID + Y20, lambda x: 0.3 * GYROID.value(x) + Y20.value(x)),
    "formula and harmonic": (WAVES - Y31, lambda x: WAVES.value(x) - Y31.value(x)),
    "formulas": (
        2 * CREASES - WAVES,
        lambda x: 2 * CREASES.value(x) - WAVES.value(x),
    ),
    "creases and harmonic": (-CREASES + Y20, lambda x: Y20.value(x) - CREASES.value(x)),
    "clouds": (CLOUD - 0.7 * SMALL_CLOUD, lambda x: CLOUD.value(x) - 0.7 * SMALL_CLOUD.value(x)),
    "cloud and formula": (CLOUD + WAVES, lambda x: CLOUD.value(x) + WAVES.value(x)),
    "solid angles": (
        2 * LOOP - 3 * SMALL_LOOP,
        lambda x: 2 * LOOP.value(x) - 3 * SMALL_LOOP.value(x),
    ),
    "solid angle and harmonic": (LOOP + Y20, lambda x: LOOP.value(x) + Y20.value(x)),
    "half a solid angle": (0.5 * LOOP + GYROID, lambda x: 0.5 * LOOP.value(x) + GYROID.value(x)),
    "blobs": (BLOBS + WAVES - Y31, lambda x: BLOBS.value(x) + WAVES.value(x) - Y31.value(x)),
    "solids": (
        FieldSum([hk.Sphere(0.5), hk.Torus(0.5, 0.2), Y20], [1, 0.5, 1]),
        lambda x: hk.Sphere(0.5).value(x) + 0.5 * hk.Torus(0.5, 0.2).value(x) + Y20.value(x),
    ),
    "product": (Y20 * Y31, lambda x: Y20.value(x) * Y31.value(x)),
    "product with formula": (
        (GYROID + 1) * WAVES,
        lambda x: (GYROID.value(x) + 1) * WAVES.value(x),
    ),
    "product of formulas": (WAVES * CREASES, lambda x: WAVES.value(x) * CREASES.value(x)),
    "polynomial of fields": (
        (Y20 * GYROID) * Y31 + 0.2 * WAVES,
        lambda x: Y20.value(x) * GYROID.value(x) * Y31.value(x) + 0.2 * WAVES.value(x),
    ),
}
QUICK = ("harmonic", "formula and harmonic", "solid angles", "clouds", "product with formula")


@pytest.mark.parametrize("name", CASES)
def test_values_are_those_of_the_terms(name: str) -> None:
    field, values = CASES[name]
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    np.testing.assert_allclose(field.value(x), values(x), rtol=1e-12, atol=1e-12)
    h = 1e-5
    steps = [(values(x + h * e) - values(x - h * e)) / (2 * h) for e in np.eye(3)]
    if field.period is None:
        np.testing.assert_allclose(field.gradient(x), np.stack(steps, axis=1), atol=2e-5)


def rays(seed: int, count: int = 20) -> tuple[Any, Any]:
    """Rays from a sphere around the unit ball towards points in it."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(count, 3))
    o *= 1.3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.6, 0.6, (count, 3)) - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def sampled_hits(values: Values, level: float, period: float | None, o: Any, d: Any) -> Any:
    """The first parameter t at which samples of the values along each ray pass the level."""
    # From where the ray enters the unit ball to where it leaves it.
    b = (o * d).sum(axis=1)
    root = np.sqrt(b * b - (o * o).sum(axis=1) + 1)
    t = (-b - root)[:, None] + 2 * root[:, None] * np.linspace(0, 1, 3000)
    x = o[:, None] + t[..., None] * d[:, None]
    u = values((1 - 1e-9) * x.reshape(-1, 3)).reshape(t.shape) - level
    if period is not None:
        u -= period * np.round(u / period)
    passes = u[:, 1:] * u[:, :-1] <= 0
    if period is not None:  # not where the remainder jumps
        passes &= np.abs(u[:, 1:] - u[:, :-1]) < 0.5 * period
    first = t[np.arange(len(t)), 1 + passes.argmax(axis=1)]
    return np.where(passes.any(axis=1), first, np.inf)


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CASES]
)
def test_no_first_hit_is_missed(name: str, precision: Any) -> None:
    field, values = CASES[name]
    o, d = rays(2)
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    levels = np.quantile(values(x), [0.3, 0.6]) if field.period is None else [2.0, -3.0]
    for level in levels:
        hits = hk.trace(field, o, d, level=float(level), tolerance=1e-5, precision=precision,
                        clip=_BALL)  # fmt: skip
        expected = sampled_hits(values, level, field.period, o, d)
        assert set(hits.status) <= {int(hk.RayStatus.HIT), int(hk.RayStatus.MISS)}
        assert (hits.t <= expected + 5e-4).all()
        at = o[hits.is_hit] + hits.t[hits.is_hit, None] * d[hits.is_hit]
        gap = values(at) - level
        if field.period is not None:
            gap -= field.period * np.round(gap / field.period)
        steepness = np.linalg.norm(field.gradient(at), axis=1)
        assert (np.abs(gap) <= 2e-4 * (1 + steepness + abs(level))).all()
        assert hits.evaluations.mean() < 40


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["creases and harmonic", "solid angle and harmonic", "clouds", "product"]
)
def test_promises_hold(name: str) -> None:
    field, _ = CASES[name]
    points = np.random.default_rng(3).uniform(-0.55, 0.55, (20, 3))
    check_field(field, points)


@pytest.mark.parametrize("name", ["formula and harmonic", "product with formula"])
def test_enclosures_along_rays_hold(name: str) -> None:
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (100, 3))
    check_ray_samples(CASES[name][0], points)


@pytest.mark.parametrize("field", [Y31, WAVES, LOOP, CLOUD], ids=["Y31", "waves", "loop", "cloud"])
def test_a_single_term_takes_as_many_evaluations(field: Field) -> None:
    o, d = rays(5, 200)
    alone = hk.trace(field, o, d)
    for factor in (1.0, -2.5):
        scaled = hk.trace(FieldSum([field], [factor]), o, d)
        np.testing.assert_array_equal(scaled.is_hit, alone.is_hit)
        assert scaled.evaluations.mean() <= 1.02 * alone.evaluations.mean()


def test_a_sum_of_harmonic_terms_is_harmonic() -> None:
    """Its range on a ball has the ends of the terms, exchanged where a weight is negative. Of
    potentials of charges only the lower end is known; with weights of both signs, both ends follow
    on half the ball."""
    backend = choose_backend("double")
    p = backend.Array3f(0.3, 0.2, 0.1)
    ball = next(x for x in (2 * Y20 - Y31).evaluate(p).all_promises if isinstance(x, HarmonicBall))
    x = np.random.default_rng(1).normal(size=(1000, 3))
    x *= ball.radius[0] / np.linalg.norm(x, axis=1, keepdims=True)
    inside = (2 * Y20 - Y31).value(x + np.array([0.3, 0.2, 0.1]))
    assert ball.lower[0] <= inside.min() < inside.max() <= ball.upper[0]
    charges = Charges()
    other = hk.SphericalHarmonic(1, 0, radius=3.0)
    same, opposite = 2 * charges + FieldSum([Charges()]) + other, charges - 0.5 * Charges()
    balls = [
        next(x for x in field.evaluate(p).all_promises if isinstance(x, HarmonicBall))
        for field in (same, opposite)
    ]
    assert balls[0].upper == math.inf
    assert math.isfinite(balls[1].lower[0])
    assert math.isfinite(balls[1].upper[0])
    o, d = rays(7, 30)
    for field in (same, opposite):
        level = float(np.median(field.value(0.3 * o)))
        for enclosures in (None, "classic"):
            hits = hk.trace(field, o, d, level=level, clip=_BALL, enclosures=enclosures)
            assert hits.is_hit.any()
            expected = sampled_hits(field.value, level, None, o, d)
            assert (hits.t <= expected + 1e-3).all()


WEIGHTED: dict[str, tuple[Callable[[Any], Field], float | None]] = {
    "harmonic": (lambda w: FieldSum([Y20, Y31], w[:2], w[2]), 0.1),
    "gyroid": (lambda w: GYROID * w[0] + Y20 * w[1] + w[2], 0.1),
    "formula": (lambda w: WAVES * w[0] - Y20 * w[1] + w[2], 0.1),
    "product": (lambda w: (WAVES * w[0]) * (GYROID * w[1] + (1.5 + w[2])), 0.1),
    "solid angle": (lambda w: LOOP + Y20 * w[0] + GYROID * w[1] + w[2], None),
}


@pytest.mark.parametrize("name", WEIGHTED)
def test_derivatives_by_weights(name: str) -> None:
    make, level = WEIGHTED[name]
    start = np.array([1.0, -1.2, 0.05])
    o, d = (Array3f64(v.T.copy()) for v in rays(3, 12))

    def weights(numbers: Any) -> list[Any]:
        return [Float64(float(w)) for w in numbers]

    def t(numbers: Any) -> Any:
        hits = hk.trace(make(weights(numbers)), o, d, level=level, tolerance=1e-11)
        return np.where(hits.is_hit.numpy(), hits.t.numpy(), 0.0)

    w = weights(start)
    dr.enable_grad(w)
    hits = hk.trace(make(w), o, d, level=level)
    dr.backward(dr.sum(dr.select(hits.is_hit, hits.t, 0)))
    assert dr.count(hits.is_hit)[0] > 4
    h = 1e-6
    differences = [(t(start + h * e) - t(start - h * e)).sum() / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose([x.grad[0] for x in w], differences, rtol=1e-5, atol=1e-6)
    if level is None:
        return
    w = weights(start)
    dr.enable_grad(w)
    dr.backward(dr.sum(make(w).value(0.3 * o)))
    x = 0.3 * o.numpy().T
    sums = [make(start + s * h * e).value(x).sum() for e in np.eye(3) for s in (1, -1)]
    differences = [(sums[k] - sums[k + 1]) / (2 * h) for k in (0, 2, 4)]
    np.testing.assert_allclose([x.grad[0] for x in w], differences, rtol=1e-5, atol=1e-7)


def test_weights_in_one_array_have_derivatives() -> None:
    w = Float64(2.0, 1.0)
    dr.enable_grad(w)
    field = FieldSum([Y20, Y31], w)
    assert field.parameters()["weights"] is w
    dr.backward(field.value(Array3f64(0.1, 0.2, 0.3)))
    point = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(w.grad.numpy(), [Y20.value(point), Y31.value(point)])
    tensor = dr.llvm.ad.TensorXf64([2.0, 1.0])
    np.testing.assert_allclose(
        FieldSum([Y20, Y31], tensor).value(point), (2 * Y20 + Y31).value(point)
    )
    dr.clear_grad(w)
    dr.backward(field.gradient(Array3f64(0.1, 0.2, 0.3)).z)
    expected = [Y20.gradient(point)[2], Y31.gradient(point)[2]]
    np.testing.assert_allclose(w.grad.numpy(), expected)


def test_derivatives_are_refused_where_they_would_be_lost() -> None:
    class Learned(float):
        requires_grad = True

    with pytest.raises(NotImplementedError, match="cannot be differentiated by these numbers"):
        FieldSum([Y20], [Learned(2.0)])
    with pytest.raises(NotImplementedError, match="cannot be differentiated by these numbers"):
        _ = Y20 * Learned(2.0)


def test_operators_make_flat_sums() -> None:
    field = 3 * (2 * Y20 + Y31) - Y20 / 2 + 1 - np.float64(0.25)
    assert isinstance(field, FieldSum)
    assert field.terms == (Y20, Y31)
    assert field.weights == (5.5, 3.0)
    assert field.constant == 0.75
    assert (1 - Y20).parameters()["constant"] == 1.0
    assert sum([Y20, Y31]).terms == (Y20, Y31)  # begins with the number 0
    assert isinstance(2 * WAVES - CREASES + 1, Formula)
    assert isinstance(WAVES * CREASES, Formula)
    assert isinstance(WAVES * Y20, FieldProduct)
    assert (2 * CREASES).replace(weights=[3.0]).value([0.1, 0.2, 0.0]) == pytest.approx(0.9)
    only_sign = np.float32(-1) * Y20
    np.testing.assert_allclose(only_sign.hessian([0.1, 0.2, 0.3]), -Y20.hessian([0.1, 0.2, 0.3]))


@pytest.mark.parametrize("method", ["exact", pytest.param("tree", marks=pytest.mark.slow)])
def test_one_term_may_jump(method: Any) -> None:
    """The winding number of a mesh with holes, and a harmonic function."""
    vertices, faces = hk.geometry.example_meshes.icosphere(2)
    faces = hk.geometry.example_meshes.remove_faces(faces, 0.15, seed=0)
    winding = hk.WindingNumber(0.6 * vertices, faces, method=method)
    o, d = rays(11, 40)
    for weight in (1.0, -1.5):
        field = weight * winding + 0.3 * Y20 + 0.1
        hits = hk.trace(field, o, d, tolerance=1e-5)

        def values(x: Any, weight: float = weight) -> Any:
            return weight * winding.value(x) + 0.3 * Y20.value(x) + 0.1

        expected = sampled_hits(values, field.default_level, None, o, d)
        assert 0.5 < hits.is_hit.mean() < 1
        assert (hits.t <= expected + 1e-3).all()
        assert (hits.t >= expected - 2e-3)[hits.is_hit].all()
    (alone, doubled) = (hk.trace(field, o, d) for field in (winding, 2 * winding))
    np.testing.assert_array_equal(doubled.is_hit, alone.is_hit)
    assert doubled.evaluations.mean() <= 1.02 * alone.evaluations.mean()
    # By weights, facets stay where they are, and hits on the surface between them move.
    at, weight = {}, 1.0
    for number in (1 - 1e-5, 1 + 1e-5, 1.0):
        weight = _weight(number)
        hits = hk.trace(winding + Y20 * weight, Array3f64(o.T.copy()), Array3f64(d.T.copy()))
        at[number] = np.array(dr.select(hits.is_hit & (hits.primitive_index < 0), hits.t, 0))
    dr.set_grad(weight, 1.0)
    dr.forward_to(hits.t)
    is_off = at[1.0] > 0
    difference = (at[1 + 1e-5] - at[1 - 1e-5])[is_off] / 2e-5
    derivative = np.array(dr.grad(hits.t))
    np.testing.assert_allclose(derivative[is_off], difference, rtol=1e-5, atol=1e-7)
    assert is_off.any()
    assert not derivative[np.array(hits.primitive_index) >= 0].any()


def _weight(number: float = 1.0) -> Float64:
    weight = Float64(number)
    dr.enable_grad(weight)
    return weight


def test_periods() -> None:
    """A sum with angle-valued terms is known modulo the greatest number that divides them all."""
    full = 4 * math.pi
    assert (LOOP + Y20).period == pytest.approx(full)
    assert (0.5 * LOOP).period == pytest.approx(full / 2)
    assert (2 * LOOP - 3 * SMALL_LOOP).period == pytest.approx(full)
    assert (LOOP / 2 + SMALL_LOOP / 3).period == pytest.approx(full / 6)
    assert (Y20 + Y31).period is None
    # At 4 pi the level set would extend to infinity.
    assert (LOOP + SMALL_LOOP).default_level == pytest.approx(1.5 * full)
    with pytest.raises(ValueError, match="must be integers, or have simple fractions"):
        LOOP + math.sqrt(2) * SMALL_LOOP
    with pytest.raises(ValueError, match="weight of a SolidAngle, which is angle-valued"):
        LOOP * Float64(2.0)
    with pytest.raises(ValueError, match="is angle-valued: known up to multiples"):
        LOOP * Y20


def test_fields_that_fall_off_have_an_extent() -> None:
    """Without it, rays that miss would never end."""
    o, d = rays(9, 200)
    for field in (CLOUD - 0.7 * SMALL_CLOUD, 2 * LOOP - 3 * SMALL_LOOP, -2 * CLOUD):
        assert field.extent((field.default_level,)) is not None
        hits = hk.trace(field, 3 * o, d)
        assert not (hits.status == int(hk.RayStatus.OUT_OF_STEPS)).any()
        assert 0.05 < hits.is_hit.mean() < 0.95
    assert (CLOUD - SMALL_CLOUD).extent((0.0,)) is None


def test_sums_of_formulas_have_the_extents_of_their_terms() -> None:
    blobs, other = (hk.fields.Blobs([[x, 0, 0]], 0.5) for x in (-1.0, 2.0))
    box = blobs.extent((1.0,))
    for field, level in ((2 * blobs, 1.0), (-blobs, -1.0), (0.1 - blobs, -0.9)):
        assert field.extent((level,)) == box
    both = (blobs - 0.5 * other).extent((0.7,))
    assert both is not None
    lower, upper = both.bounds()
    assert lower[0] <= -1.5
    assert upper[0] >= 2.5
    assert (blobs - other).extent((0.0,)) is None  # which is all the space outside of both
    hits = hk.trace(2 * blobs, [[-1, 0, 1e6], [0, 5, 9]], [[0, 0, -1]], level=2.0)
    assert hits.status.tolist() == [hk.RayStatus.HIT, hk.RayStatus.MISS]
    with pytest.raises(ValueError, match="level 0 of blobs"):
        hk.trace(blobs - 0.5, [[0, 5, 9]], [[0, 0, -1]], level=-0.5)


def test_products_are_0_where_a_factor_is() -> None:
    first, second = (hk.expression(f"x^2 + y^2 + z^2 - {r}", domain=hk.Box((-3,) * 3, (3,) * 3))
                     for r in (1, 4))  # fmt: skip
    assert (first * second).extent((0.0,)) is not None
    blobs, other = (hk.fields.Blobs([[x, 0, 0]], 0.5) for x in (-1.0, 2.0))
    assert (blobs * other).extent((0.0,)) is None  # all the space outside of both
    assert FieldProduct((blobs, other)).extent((0.0,)) is None


_MESH = hk.geometry.example_meshes.icosphere(1)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Y20 / Y31, TypeError, "cannot be a divisor"),
        (lambda: 1 / Y20, TypeError, r"combined by \+, - and \*"),
        (lambda: Y20**2, TypeError, r"combined by \+, - and \*"),
        (lambda: Y20 < Y31, TypeError, r"combined by \+, - and \*"),
        (lambda: Y20 / 0, ZeroDivisionError, "division by zero"),
        (lambda: Y20 * math.nan, ValueError, "must be finite"),
        (lambda: Y20 + "1", TypeError, "unsupported operand"),
        (lambda: Y20 * True, TypeError, "unsupported operand"),
        (lambda: Y20 * Float64(1.0, 2.0), ValueError, "must be a single number"),
        (lambda: Y20 + hk.Sphere(), TypeError, "a Sphere is a set of points"),
        (lambda: hk.Sphere() + Y20, TypeError, "a Sphere is a set of points"),
        (lambda: Y20 - hk.Sphere(), TypeError, "is a field and no solid"),
        (lambda: 2 * hk.Sphere(), TypeError, "a Sphere is a set of points"),
        (lambda: -hk.Sphere(), TypeError, "a Sphere is a set of points"),
        (
            lambda: hk.WindingNumber(*_MESH) - 2 * hk.WindingNumber(*_MESH[:2]),
            ValueError,
            "only one term of a sum may jump",
        ),
        (lambda: Y20 * hk.WindingNumber(*_MESH), ValueError, "jumps across facets"),
        (lambda: FieldSum([Y20, Y31], [1.0]), ValueError, "2 terms need 2 weights"),
        (lambda: FieldSum([Y20, Y31], Float64(1.0)), ValueError, "2 terms need 2 weights"),
        (lambda: FieldSum([]), ValueError, "at least one term"),
        (lambda: FieldSum([Y20, 3.0]), TypeError, "a harnack field is needed"),
        (lambda: FieldProduct([Y20]), ValueError, "two factors, not 1"),
    ],
)
def test_what_cannot_be_done_is_named(
    make: Callable[[], Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


def test_solids_keep_their_operators() -> None:
    assert isinstance(hk.Sphere() - hk.Torus(), hk.fields.Solid)
    assert isinstance(hk.Sphere() | hk.Torus(), hk.fields.Solid)
    shell = hk.solid(2 * Y20 + GYROID, between=(-0.2, 0.2))
    assert isinstance(shell & hk.Sphere(0.7), hk.fields.Solid)
    inside = hk.solid(CLOUD + SMALL_CLOUD, above=3.0)
    assert inside.sublevel_extent() is not None
    assert hk.solid(hk.Gyroid(1.0) + SMALL_CLOUD, above=3.0).domain is None


def test_a_sum_without_weights_is_constant() -> None:
    field = FieldSum([Y20, GYROID], [0.0, 0.0], 0.3)
    np.testing.assert_array_equal(field.gradient(np.zeros((2, 3)) + 0.1), 0)
    o, d = rays(3, 5)
    assert not hk.trace(field, o, d, level=0.1).is_hit.any()
