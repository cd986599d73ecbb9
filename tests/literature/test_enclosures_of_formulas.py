"""The literature's arithmetics along paths: parabolas and affine forms enclose what they are made
of, and the proofs made of them hit what pieces of the path hit."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from inspect import isclass
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import harnack as hk
from harnack import literature
from harnack.arithmetic import (
    Jet,
    absolute,
    atan2,
    exp,
    log,
    sin,
    sqrt,
    tanh,
)
from harnack.backend import choose_backend, to_float, to_vector3
from harnack.enclosures import Enclosure, LevelGaps, SlopeRange, choose_enclosures
from harnack.enclosures.selection import ENCLOSURE_NAMES
from harnack.fields.formula_evaluator import FormulaOnRay
from harnack.literature import (
    AffineEnclosure,
    AffineForm,
    BottomUpLinearEnclosure,
    BottomUpQuadraticEnclosure,
    IntervalEnclosure,
    LongestOfEnclosure,
    ParabolaBounds,
    clipped_power,
)

Formula = Callable[[Any, Any, Any], Any]
PROOFS = ("bottom-up-linear", "bottom-up-quadratic", "mixed", "affine", "interval")


def test_every_enclosure_has_a_name_and_is_imported_when_it_is_asked_for() -> None:
    chosen = {choose_enclosures(name).kinds[0] for name in ENCLOSURE_NAMES}
    named = {kind for kind in chosen if kind.__module__.startswith("harnack.literature.")}
    public = [getattr(literature, name) for name in literature.__all__]
    assert named == {kind for kind in public if isclass(kind) and issubclass(kind, Enclosure)}
    assert len(named) == 8
    code = """
import sys
from harnack.enclosures import choose_enclosures
choose_enclosures(), choose_enclosures("pieces"), choose_enclosures("classic")
print("harnack.literature" in sys.modules)
print(choose_enclosures("affine").kinds)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    kind = "harnack.literature.formula_enclosures.AffineEnclosure"
    assert run.stdout.splitlines() == ["False", f"(<class '{kind}'>,)"]


def larger(a: Any, b: Any) -> Any:
    return np.maximum(a, b) if isinstance(a, np.ndarray) else a.maximum(b)


FORMULAS: dict[str, Formula] = {
    "quadric": lambda x, y, z: x * x + 2 * y * y - z * z + x * y - 0.3,
    "torus": lambda x, y, z: (sqrt(x * x + y * y + 0.01) - 1) ** 2 + z**2 - 0.1,
    "gyroid": lambda x, y, z: sin(3 * x) * sin(2 * y) + sin(2 * y) * sin(3 * z) - 0.1,
    "quartic": lambda x, y, z: x**4 + y**4 + z**4 - 5 * (x**2 + y**2 + z**2) + 11,
    "blobs": lambda x, y, z: (
        clipped_power(3)(1 - ((x - 0.3) ** 2 + y**2 + z**2) * 0.7) * 1.5
        + clipped_power(3)(1 - ((x + 0.5) ** 2 + y**2 + z**2) * 0.4)
        - 0.2
    ),
    "clipped square": lambda x, y, z: clipped_power(2)(x * y - z) - clipped_power(1)(x - y),
    "maximum": lambda x, y, z: larger(x * x + y * y - 1, z * z - 0.3 * x),
    "clipped by hand": lambda x, y, z: larger(1 - (x * x + y * y + z * z) * 0.3, 0.0) ** 3,
    "gaussians": lambda x, y, z: exp(-(x * x + y * y + z * z)) + exp(-2 * (y * y + x * z)) - 0.3,
    "quotient": lambda x, y, z: (x * y + 1) / (2 + x * x + z * z) - 0.2 * tanh(y),
    "angle": lambda x, y, z: atan2(y + 0.3 * z, x - 0.2) - 0.4 * atan2(1 + y * y, z),
    "kinks": lambda x, y, z: absolute(x * y) - larger(-z, -x) + sqrt(1 + y * y),
    "powers": lambda x, y, z: (1 + x * x + y * y) ** 1.7 - (2 + z * z) ** -2.0 + log(3 + x * x),
}


def paths(precision: str, count: int, seed: int) -> tuple[Any, ...]:
    """Points, unit directions and lengths from 1e-4 to 5; and the same in long double."""
    backend = choose_backend(precision)  # type: ignore[arg-type]
    generator = np.random.default_rng(seed)
    p = generator.normal(size=(count, 3)) * 1.5
    d = generator.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    h = 10 ** generator.uniform(-4, 0.7, count)
    given = to_vector3(backend, p), to_vector3(backend, d), to_float(backend, h)
    exact = [np.stack([v[k].numpy() for k in range(3)]).astype(np.longdouble) for v in given[:2]]
    return *given, *exact, given[2].numpy().astype(np.longdouble)


def along(formula: Formula, exact: tuple[Any, ...], samples: int = 65) -> tuple[Any, Any]:
    """Lengths s and values of the formula there, in long double: (samples, n)."""
    p, d, h = exact
    s = np.linspace(0, 1, samples, dtype=np.longdouble)[:, None] * h
    return s, np.stack([formula(*(p[k] + one * d[k] for k in range(3))) for one in s])


def wide(x: Any, like: Any) -> Any:
    return (0 * like + x).numpy().astype(np.longdouble)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMULAS)
def test_parabolas_enclose(name: str, precision: str) -> None:
    formula = FORMULAS[name]
    p, d, h, *exact = paths(precision, 3000, 1)
    s, values = along(formula, tuple(exact))
    moved = values - values[0]
    allowed = 4e-18 * (np.abs(values) + np.abs(values[0]) + 50)  # of the samples' own rounding
    for degree in (1, 2):
        made = formula(*ParabolaBounds.along_ray(p, d, h, degree=degree))
        (a, b), (c, e) = ([wide(one, h) for one in pair] for pair in made.bounds)
        known = np.isfinite(a + b) & np.isfinite(c + e)
        assert known.mean() > 0.55, "hardly anything is proved"
        if degree == 1:
            assert not b.any()
            assert not e.any()
        a, b, c, e = (np.where(known, one, 0) for one in (a, b, c, e))
        lower, upper = a * s + b * s * s, c * s + e * s * s
        wrong = (moved < lower - allowed) | (moved > upper + allowed)
        assert not wrong[:, known].any()
        low, high = wide(made.value.lower, h), wide(made.value.upper, h)
        assert ((low <= values[0] + allowed[0]) & (values[0] <= high + allowed[0])).all()


@pytest.mark.few(5)
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMULAS)
def test_affine_forms_enclose(name: str, precision: str) -> None:
    formula = FORMULAS[name]
    p, d, h, *exact = paths(precision, 3000, 2)
    s, values = along(formula, tuple(exact))
    made = formula(*AffineForm.along_ray(p, d, h))
    center, slope, error = (wide(one, h) for one in (made.center, made.slope, made.error))
    known = np.isfinite(center + slope + error)
    assert known.mean() > 0.8
    line = center + slope * (2 * s / exact[2] - 1)
    allowed = 4e-18 * (np.abs(values) + 50)
    assert not (np.abs(values - line) > error + allowed)[:, known].any()


def expressions() -> st.SearchStrategy[str]:
    """Random formulas, as Python text of x, y, z."""
    number = st.floats(-2, 2).map(lambda one: f"({one:.3f})")
    leaf = st.one_of(st.sampled_from(["x", "y", "z"]), number)

    def more(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        two = st.tuples(st.sampled_from("+-*"), inner, inner)
        return st.one_of(
            two.map(lambda one: f"({one[1]} {one[0]} {one[2]})"),
            inner.map(lambda one: f"({one})**2"),
            inner.map(lambda one: f"({one})**3"),
            inner.map(lambda one: f"sin({one} + 0*x)"),
            inner.map(lambda one: f"exp(-({one} + 0*x)**2)"),
            inner.map(lambda one: f"clipped_power(3)({one} + 0*x)"),
            inner.map(lambda one: f"1/(2 + ({one})**2)"),
            st.tuples(inner, inner).map(lambda one: f"larger({one[0]} + 0*x, {one[1]} + 0*x)"),
        )

    return st.recursive(leaf, more, max_leaves=6)


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(text=expressions(), seed=st.integers(0, 100))
def test_random_expressions_are_enclosed(text: str, seed: int) -> None:
    formula: Formula = eval(f"lambda x, y, z: ({text}) + 0*x", dict(globals()))
    p, d, h, *exact = paths("single", 300, seed)
    s, values = along(formula, tuple(exact), 33)
    moved = values - values[0]
    # Of the samples' own rounding: intermediate results may be larger than values.
    size = np.abs(values).max(0) + 1e3 * (1 + np.abs(exact[0]).max(0) + exact[2]) ** 6
    for degree in (1, 2):
        made = formula(*ParabolaBounds.along_ray(p, d, h, degree=degree))
        (a, b), (c, e) = ([wide(one, h) for one in pair] for pair in made.bounds)
        known = np.isfinite(a + b) & np.isfinite(c + e)
        a, b, c, e = (np.where(known, one, 0) for one in (a, b, c, e))
        lower, upper = a * s + b * s * s, c * s + e * s * s
        wrong = (moved < lower - 1e-17 * size) | (moved > upper + 1e-17 * size)
        assert not wrong[:, known].any(), text


def test_parabolas_are_exact_where_they_can_be() -> None:
    """Quadratics are themselves; a convex function of a line is its tangent and its chord."""
    p, d, h, *exact = paths("double", 500, 3)
    s, values = along(FORMULAS["quadric"], tuple(exact))
    made = FORMULAS["quadric"](*ParabolaBounds.along_ray(p, d, h))
    (a, b), (c, e) = ([wide(one, h) for one in pair] for pair in made.bounds)
    moved = values - values[0]
    for x, y in ((a, b), (c, e)):
        np.testing.assert_allclose(x * s + y * s * s, moved, atol=1e-11)

    x, _, _ = ParabolaBounds.along_ray(p, d, h, degree=1)
    (a, _), (c, _) = exp(x).bounds
    start, rate, length = exact[0][0], exact[1][0], exact[2]
    np.testing.assert_allclose(wide(a, h), rate * np.exp(start), rtol=1e-6, atol=1e-9)
    chord = np.exp(start) * np.expm1(rate * length) / length
    np.testing.assert_allclose(wide(c, h), chord, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_parabolas_of_smooth_functions_have_their_slope_at_the_start() -> None:
    """Exact to first order on short lengths: that is what makes the march converge."""
    p, d = paths("double", 500, 4)[:2]
    for name in ("gyroid", "blobs", "gaussians", "quotient", "powers"):
        made = FORMULAS[name](
            *ParabolaBounds.along_ray(p, d, to_float(choose_backend("double"), 1e-5))
        )
        (a, _), (c, _) = made.bounds
        jet = FORMULAS[name](*Jet.along_ray(p, d, 0.0, dr.zeros(type(p.x)) + 1e-5))
        assert float(dr.max(dr.abs(c - a))[0]) < 1e-3
        slope = jet.jet_at_start.first_derivatives[0]
        assert not np.any((a > slope.upper + 1e-12).numpy())
        assert not np.any((c < slope.lower - 1e-12).numpy())


@pytest.mark.parametrize(
    "kind",
    [
        BottomUpLinearEnclosure,
        BottomUpQuadraticEnclosure,
        LongestOfEnclosure,
        AffineEnclosure,
        IntervalEnclosure,
    ],
)
def test_steps_meet_no_level_and_slightly_longer_ones_would(kind: Any) -> None:
    """A step may end at the length asked; a step 1.001 times as long meets the level somewhere."""
    formula = FORMULAS["quadric"]
    p, d, h, *exact = paths("double", 4000, 5)
    field = hk.expression(formula)
    function = FormulaOnRay(field.evaluator(choose_backend("double")), p, d)
    slope = dr.dot(field.evaluate(p).gradient, d)
    made = kind.from_restriction(function, SlopeRange(slope, slope), h)
    generator = np.random.default_rng(6)
    gap = generator.uniform(0.05, 2, 4000)
    gaps = LevelGaps(to_float(choose_backend("double"), gap), dr.zeros(type(h)) + dr.inf)
    step = wide(made.free_length(gaps), h)
    assert (step >= 0).all()
    assert (step <= exact[2]).all()
    assert (step > 0).mean() > 0.3
    _, values = along(formula, (exact[0], exact[1], step * (1 - 1e-9)), 129)
    assert (values[0] - values.min(0) < gap).all()
    if kind in (BottomUpQuadraticEnclosure, LongestOfEnclosure):  # exact of a quadric
        cut = (step > 0) & (step < exact[2])
        _, values = along(formula, (exact[0], exact[1], 1.001 * step), 129)
        assert ((values[0] - values.min(0))[cut] >= gap[cut]).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["torus", "gyroid", "quartic", "blobs", "clipped by hand"])
def test_all_proofs_hit_the_same(name: str, precision: str) -> None:
    level = 0.3 if name == "clipped by hand" else 0.0
    field = hk.expression(FORMULAS[name], domain=hk.Ball(radius=3.0), level=level)
    generator = np.random.default_rng(7)
    o = generator.normal(size=(400, 3))
    o *= 4 / np.linalg.norm(o, axis=1)[:, None]
    target = generator.normal(size=(400, 3)) * 0.7
    backend = choose_backend(precision)  # type: ignore[arg-type]
    rays = to_vector3(backend, o), to_vector3(backend, target - o)

    def hits(enclosures: str | None) -> tuple[Any, Any]:
        traced = hk.trace(field, *rays, enclosures=enclosures, tolerance=1e-5, max_steps=1000)
        return traced.status.numpy(), traced.t.numpy()

    status, t = hits(None)
    hit = status == int(hk.RayStatus.HIT)
    assert 20 < hit.sum() < 400
    for enclosures in PROOFS:
        other, there = hits(enclosures)
        out_of_steps = other == int(hk.RayStatus.OUT_OF_STEPS)
        # Bands are not relative to the value: in single precision they stall beside a surface.
        stalls = precision == "single" and enclosures in ("affine", "interval")
        assert stalls or not out_of_steps.any()
        different = (other != status) & ~out_of_steps
        assert different.sum() <= 2, enclosures  # rays that only graze the surface
        both = hit & (other == status)
        if stalls and not both.any():
            continue
        apart = np.abs(t[both] - there[both])
        assert np.median(apart) < 3e-5
        assert (apart < 1e-2).mean() > 0.99


def test_proofs_of_formulas_say_what_they_need() -> None:
    options = hk.TraceOptions(enclosures="bottom-up-quadratic")
    with pytest.raises(ValueError, match="no enclosure applies"):
        hk.trace(hk.SphericalHarmonic(4, 2), [[3.0, 0, 0]], [[-1.0, 0, 0]], options=options)


def test_formulas_with_what_has_no_ranges_are_refused() -> None:
    x, y, _ = ParabolaBounds.along_ray(*paths("single", 3, 8)[:3])
    with pytest.raises(TypeError, match="no proved ranges"):
        np.fmod(x, y)
    with pytest.raises(TypeError, match="plain numbers"):
        float(x)
    with pytest.raises(TypeError, match="cannot decide"):
        bool(x)
    with pytest.raises(ZeroDivisionError):
        x / 0
    with pytest.raises(ValueError, match="clipped power"):
        clipped_power(0)
    assert np.sin(x).value.lower.numpy() == pytest.approx(np.sin(x.value.lower.numpy()), abs=1e-5)


def test_float_lanes_with_no_length_prove_nothing_false() -> None:
    backend = choose_backend("single")
    p, d = to_vector3(backend, np.zeros((2, 3)) + 0.1), to_vector3(backend, np.eye(3)[:2])
    made = FORMULAS["quartic"](*ParabolaBounds.along_ray(p, d, to_float(backend, [0.0, 1e-30])))
    field = hk.expression(FORMULAS["quartic"])
    enclosure = BottomUpQuadraticEnclosure.from_restriction(
        FormulaOnRay(field.evaluator(backend), p, d),
        SlopeRange(0.0, 0.0),
        to_float(backend, [0.0, 1e-30]),
    )
    assert enclosure is not None
    step = enclosure.free_length(
        LevelGaps(to_float(backend, [1.0, 1.0]), to_float(backend, [1.0, 1.0]))
    )
    assert (step.numpy() >= 0).all()
    assert (step.numpy() <= [0.0, 1e-30]).all()
    assert made.bound_degree == 2
