"""Formulas of users: values and derivatives, what may go wrong, and steps that are sharp."""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any, cast

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.testing import BrokenPromiseError, check_field, check_ray_samples
from tests.oracles.mutated_enclosure import mutated_enclosure

POINTS = np.random.default_rng(2).uniform(-0.9, 0.9, (200, 3))


def waves(x: Any, y: Any, z: Any) -> Any:
    return (
        hk.math.sin(3 * x) * hk.math.exp(-y * y)
        + hk.math.sqrt(z * z + 1) / (2 + x)
        - hk.math.tanh(y) ** 3
    )


def reference(p: Any) -> Any:
    x, y, z = np.moveaxis(p, -1, 0)
    first = np.sin(3 * x) * np.exp(-y * y)
    return first + np.sqrt(z * z + 1) / (2 + x) - np.tanh(y) ** 3


def test_value_gradient_and_hessian_are_those_of_the_formula() -> None:
    field = hk.expression(waves)
    assert np.abs(field.value(POINTS, precision="double") - reference(POINTS)).max() < 1e-14
    h = 1e-5
    steps = h * np.eye(3)
    gradient = [(reference(POINTS + s) - reference(POINTS - s)) / (2 * h) for s in steps]
    found = field.gradient(POINTS, precision="double")
    assert np.abs(found - np.stack(gradient, axis=1)).max() < 1e-9
    rows = [
        (field.gradient(POINTS + s, precision="double")
         - field.gradient(POINTS - s, precision="double")) / (2 * h) for s in steps
    ]  # fmt: skip
    hessian = field.hessian(POINTS, precision="double")
    assert np.abs(hessian - np.stack(rows, axis=1)).max() < 1e-8


def test_numpy_and_plain_operators_mean_the_same() -> None:
    ours = hk.expression(lambda x, y, z: hk.math.cos(x) + abs(y) ** 3 - hk.math.maximum(z, 0.1))
    theirs = hk.expression(lambda x, y, z: np.cos(x) + np.abs(y) ** 3 - np.maximum(z, 0.1))
    o, d = [[0.1, -3, 0.2]], [[0.05, 1, 0.1]]
    one, two = (hk.trace(field, o, d, level=0.5) for field in (ours, theirs))
    assert one.t == two.t
    assert one.evaluations == two.evaluations


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (3, TypeError, "must be callable"),
        (lambda x, y: x, TypeError, "must take three coordinates"),
        (lambda x, y, z: math.sin(x), TypeError, "use those of harnack.math"),
        (lambda x, y, z: x if x > 0 else y, TypeError, "cannot decide by its coordinates"),
        (lambda x, y, z: np.fmod(x, y), TypeError, "has no proved ranges"),
        (lambda x, y, z: x / 0, ZeroDivisionError, "constant 0"),
        (lambda x, y, z: hk.math.norm(x, y, p=0.5), ValueError, "at least 1"),
    ],
)
def test_mistakes_are_told_when_the_field_is_made(
    function: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        hk.expression(function)


@pytest.mark.parametrize(
    ("text", "function"),
    [
        ("x^2 + y^2 = 1 + sin(2*z)", lambda x, y, z: x**2 + y**2 - (1 + np.sin(2 * z))),
        ("-x^2*y", lambda x, y, z: -(x**2) * y),
        ("2^-x + e^y - pi*z", lambda x, y, z: 2.0**-x + np.exp(y) - np.pi * z),
        ("max(x, y, z) + ln(x + 3)", lambda x, y, z:
         np.maximum(x, np.maximum(y, z)) + np.log(x + 3)),
        ("max(x, min(y, z)) = norm(x, y, z)/2",
         lambda x, y, z: np.maximum(x, np.minimum(y, z)) - np.sqrt(x * x + y * y + z * z) / 2),
        ("(x+2)^0.5 / (3 + abs(y))\n - log(2 + z)", lambda x, y, z:
         np.sqrt(x + 2) / (3 + np.abs(y)) - np.log(2 + z)),
        ("atan2(y, x) - 2*atan2(-1, z)", lambda x, y, z: np.arctan2(y, x) - 2*np.arctan2(-1, z)),
        ("x^3^2/8 - y^2^3", lambda x, y, z: x**9 / 8 - y**8),
        (" + ".join(["x*y"] * 150), lambda x, y, z: 150 * x * y),
    ],
)  # fmt: skip
def test_formulas_may_be_texts(text: str, function: Any) -> None:
    found = hk.expression(text).value(POINTS, precision="double")
    np.testing.assert_allclose(found, function(*POINTS.T), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("2x", r"a \* missing at '2x'"),
        ("x y", r"a \* missing at 'x y'"),
        ("x(y + 1)", r"a \* missing after 'x'"),
        ("x^2 + yy", "'yy' is unknown, there are x, y, z"),
        ("sine(x)", r"no known function, .*; did you mean \"sin\"\?"),
        ("max(x)", "max takes 2 or more arguments, not 1"),
        ("sin x", "the argument of sin stands in brackets"),
        ("sin^2(x)", "the argument of sin stands in brackets, and a power behind them"),
        ("X + y", r"'X' is unknown, .*; did you mean \"x\"\?"),
        ("1_000*x", "'_' has no meaning"),
        ("0x10*x", "'0x' has no meaning"),
        ("sqrt(-1)*x", "too large, or not real"),
        ("x + log(0)", "too large, or not real"),
        ("asin(2) + x", "too large, or not real"),
        ("1e308*10*x", "too large, or not real"),
        ("norm(x)", "norm takes 2 or 3 arguments, not 1"),
        ("atan2(y)", "atan2 takes 2 arguments, not 1"),
        ("atan2(y x)", r"a \* missing at 'y x'"),
        ("sin(x=1)", "is amiss"),
        ("x == 1", "one = between"),
        ("x < 1", "one = between"),
        ("x = y = z", "more than one = sign"),
        ("(x", "bracket is amiss"),
        ("", "is amiss"),
        ("x # y", "'#' has no meaning"),
        ("x\u00b2", "has no meaning"),
        ("'x'", "has no meaning"),
        ("1j*x", "no real number"),
        ("True", "'True'|True is no real number"),
        ("x if y else z", "not understood"),
        ("lambda: x", "is amiss|has no meaning"),
        ("x % 2", "has no meaning"),
        ("x // 2", "the operators are"),
        ("x.real", "not understood"),
        ("(x).__class__", "'_' has no meaning"),
        ("__import__('os')", "has no meaning|no known function"),
        ("9^9^9^9^9", "too large, or not real"),
        ("(-1)^0.5 * x", "too large, or not real"),
        ("1e999*x", "too large"),
        ("1" * 400 + "*x", "too large"),
        ("x/0", "divides by zero"),
        ("x" + "+x" * 300, "more than 200 operations"),
        ("-" * 500 + "x", "more than 200|is amiss"),
        ("(" * 1000 + "x" + ")" * 1000, "amiss|more than"),
        ("x+" * 3000 + "x", "more than 200 operations are within each other, as in a long sum"),
        ("x+" * 500_001 + "x", "at most 1,000,000 characters"),
    ],
)
def test_what_is_no_formula_is_said_and_never_run(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        hk.expression(text)


def test_formulas_of_texts_are_traced_like_functions() -> None:
    text = hk.expression("(x^2 + 9/4*y^2 + z^2 - 1)^3 = x^2*z^3 + 9/80*y^2*z^3")
    code = hk.expression(
        lambda x, y, z: (x**2 + 9 / 4 * y**2 + z**2 - 1) ** 3 - (x**2 * z**3 + 9 / 80 * y**2 * z**3)
    )
    o, d = np.tile([[0.1, -3, 0.2]], (50, 1)), POINTS[:50] - [0.1, -3, 0.2]
    one, other = (hk.trace(f, o, d, clip=hk.Ball(radius=2)) for f in (text, code))
    np.testing.assert_array_equal(one.t, other.t)
    assert np.isfinite(one.t).sum() > 20


def test_numbers_of_a_function_have_names() -> None:
    with pytest.raises(TypeError, match=r"numbers by name, here \(x, y, z, w\); this one takes"):
        hk.expression(lambda x, y, z: x, parameters={"w": 1.0})
    plane = hk.expression(lambda x, y, z, w: x * w + y + z, w=2.0)
    assert plane.function(1.0, 0.0, 0.0, **plane.numbers) == 2.0
    moved = plane.replace(**{"numbers.w": 3.0})
    np.testing.assert_allclose(moved.value([1.0, 0.0, 0.0]), 3.0, rtol=1e-6)


def test_domain_and_level_are_checked() -> None:
    with pytest.raises(TypeError, match="must be a volume"):
        hk.expression(waves, domain="ball")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="level must be finite"):
        hk.expression(waves, level=math.nan)


def test_an_exchanged_function_is_checked_as_a_new_one() -> None:
    plane = hk.expression("x + 2*y", level=0.5)
    turned = plane.replace(function="y + 2*x")
    np.testing.assert_allclose(turned.value([[1.0, 0.0, 0.0]]), [2.0])
    assert turned.default_level == 0.5
    assert turned.replace(default_level=1.0).function(1.0, 0.0, 0.0) == 2.0
    with pytest.raises(TypeError, match=r"function must be callable, .*, not 3"):
        plane.replace(function=3)
    with pytest.raises(TypeError, match="function must take three coordinates"):
        plane.replace(function=lambda x: x)
    with pytest.raises(ValueError, match="is no formula in x, y and z"):
        plane.replace(function="x +")
    cut = hk.expression("x + a", parameters={"a": 1.0})
    with pytest.raises(TypeError, match=r"no parameter 'function\.parameters\.a'"):
        cut.replace(**{"function": "x", "function.parameters.a": 2.0})
    with pytest.raises(ValueError, match="level"):
        plane.replace(default_level=math.nan)


@pytest.mark.parametrize(
    "make",
    [
        lambda: hk.Gyroid(1.0, domain=cast("Any", 3)),
        lambda: hk.fields.HeightField(lambda x, y: x * y, cast("Any", "ball")),
        lambda: hk.fields.HypersphericalHarmonic.from_polynomial(
            {(1, 0, 0, 0): 1.0}, domain=cast("Any", 3)
        ),
        lambda: hk.HarmonicPolynomial({(1, 0, 0): 1.0}, domain=cast("Any", 3)),
    ],
)
def test_every_domain_is_checked_when_the_field_is_made(make: Any) -> None:
    with pytest.raises(TypeError, match="domain must be a volume: "):
        make()


def test_what_is_returned_must_be_a_number() -> None:
    with pytest.raises(TypeError, match="returned an object of type str"):
        hk.expression(lambda x, y, z: "nothing")
    constant = hk.expression(lambda x, y, z: 1.0)
    assert hk.trace(constant, [[0, 0, 3]], [[0, 0, -1]], t_max=5.0).status == hk.RayStatus.MISS


def test_where_a_formula_is_not_defined_there_is_no_surface() -> None:
    """log(x) - y has no value at x < 0: a proved miss. The larger of it and another function may
    count as that one there: neither a hit nor a proved miss."""
    field = hk.expression(lambda x, y, z: hk.math.log(x) - y)
    hits = hk.trace(field, [[-1, 0, 3], [1.0, 3.0, 0]], [[0, 0, -1], [0, -1, 0]], t_max=5.0,
                    max_steps=60)  # fmt: skip
    assert hits.status.tolist() == [hk.RayStatus.MISS, hk.RayStatus.HIT]
    assert hits.t[1] == pytest.approx(3.0, abs=1e-3)
    larger = hk.expression(lambda x, y, z: hk.math.maximum(hk.math.log(x) - y, z))
    ray = hk.trace(larger, [[-1, 0, 3]], [[0, 0, -1]], t_max=5.0, max_steps=60)
    assert ray.status.tolist() == [hk.RayStatus.OUT_OF_STEPS]


@pytest.mark.slow
def test_promises_without_a_radius_are_no_broken_ones() -> None:
    # Of one of the points tried, beside f = 0, no Lipschitz constant is known.
    box = hk.Box((-1, -1, -1), (1, 1, 1))
    field = hk.expression("sin(3*x)*cos(2*y) + exp(-z*z) - 0.4 + 0.3*z^3", domain=box)
    check_field(field)


@pytest.mark.slow
def test_a_false_claim_of_convexity_is_found() -> None:
    check_field(hk.expression(lambda x, y, z: x * x + 2 * y * y + z * z - 1, is_convex=True))
    saddle = hk.expression(lambda x, y, z: x * x - y * y + z, is_convex=True)
    with pytest.raises(BrokenPromiseError, match="an enclosure looking ahead is left"):
        check_ray_samples(saddle, POINTS)


def test_steps_of_a_parabola_are_the_longest_there_are() -> None:
    """x^2 has a constant second derivative: the proof is attained, and 1.001 times it is wrong."""
    field = hk.expression(lambda x, y, z: x * x + 0 * y)
    check_ray_samples(field, POINTS, rng=4)
    for factor in (1.001, 1.01):
        with pytest.raises(BrokenPromiseError):
            check_ray_samples(field, POINTS, rng=4, enclosures=scaled_pieces(factor))


def scaled_pieces(factor: float) -> Any:
    return mutated_enclosure(hk.proofs.PiecewiseTaylorEnclosure, factor)


def test_a_twisted_ellipsoid_takes_less_than_six_looks() -> None:
    """The path is passed on, and not a Lipschitz factor, with which it takes 49."""
    size = np.array([1.0, 0.3, 2.0])

    def twisted(x: Any, y: Any, z: Any) -> Any:
        c, s = hk.math.cos(2 * z), hk.math.sin(2 * z)
        u, v = x * c + y * s, y * c - x * s
        return (u / size[0]) ** 2 + (v / size[1]) ** 2 + (z / size[2]) ** 2 - 1

    box = np.array([1.05, 1.05, 2.05])
    field = hk.expression(twisted, domain=hk.Box(tuple(-box), tuple(box)))
    rng = np.random.default_rng(0)
    o = rng.normal(size=(4000, 3))
    o *= 5 / np.linalg.norm(o, axis=1, keepdims=True)
    hits = hk.trace(field, o, rng.uniform(-1, 1, (4000, 3)) * box - o, precision="single",
                    tolerance=hk.tracer.HitTolerance(value=1e-3, distance=1e-12))  # fmt: skip
    assert hits.evaluations.mean() < 6
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()


def test_a_formula_that_compiles_for_long_says_so_before() -> None:
    """A network of 16 by 16 took minutes to compile on a busy machine, without a word. It is
    interpreted now, unless its numbers are arrays of Dr.Jit, which cannot be recorded."""
    rng = np.random.default_rng(0)
    backend = choose_backend("double")

    def network(widths: tuple[int, ...], number: Any = float) -> Any:
        sizes = (3, *widths, 1)
        layers = [rng.normal(size=(m, n)) for n, m in itertools.pairwise(sizes)]

        def function(*values: Any) -> Any:
            for k, weights in enumerate(layers):
                if k:
                    values = tuple(hk.math.tanh(v) for v in values)
                values = tuple(
                    sum((v * number(w) for w, v in zip(row, values, strict=True)), start=0.0)
                    for row in weights
                )
            return values[0]

        return lambda x, y, z: function(x, y, z)

    with pytest.warns(UserWarning, match="operations.* [0-9]+ s to compile.*Long formulas"):
        hk.expression(network((16, 16), backend.Float))
    with pytest.warns(UserWarning, match="Long formulas"):
        hk.fields.HeightField(lambda x, y: network((16, 16), backend.Float)(x, y, 0.0 * x))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hk.expression(network((8, 8), backend.Float))
        hk.expression(network((16, 16)))
        hk.expression(lambda x, y, z: (x**2 + y**2 + z**2 - 1) ** 3 - x**2 * z**3)


def test_scalars_of_numpy_are_numbers_in_samples_and_promises() -> None:
    class Height(hk.Field):
        domain = hk.Ball()

        def evaluate(self, p: Any) -> hk.fields.Sample:
            known = (
                hk.proofs.Lipschitz(np.float64(1.001)),
                hk.proofs.TaylorRemainder(np.float64(0.0), np.float32(9)),
            )
            return hk.fields.Sample(p.z, type(p)(0, 0, 1), known, np.float64(1e-6))

    assert hk.trace(Height(), [[0, 0, 0.5]], [[0, 0, -1]]).t[0] == pytest.approx(0.5, abs=2e-4)


ROUND_BOX = (
    "sqrt(max(abs(x) - 1, 0)^2 + max(abs(y) - 0.7, 0)^2 + max(abs(z) - 0.5, 0)^2)"
    " + min(max(abs(x) - 1, abs(y) - 0.7, abs(z) - 0.5), 0)"
)


def test_roots_of_what_is_zero_all_around_have_slope_zero() -> None:
    """All 1,000 gradients inside were no numbers."""
    box = hk.expression(ROUND_BOX)
    half = np.array([1.0, 0.7, 0.5])
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * half
    nearest = np.eye(3)[(np.abs(points) - half).argmax(axis=1)]
    assert (box.gradient(points, precision="double") == nearest * np.sign(points)).all()


def test_gradients_without_a_bound_are_of_one_side() -> None:
    cone = hk.expression("sqrt(x^2 + y^2)")
    gradient = cone.gradient([[0.0, 0.0, 0.3]], precision="double")
    assert np.linalg.norm(gradient) == pytest.approx(1.0)
