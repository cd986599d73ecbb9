"""Fields of users: right ones pass `check_field`, wrong ones get help where they are first used."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.enclosures import HarmonicBall, Lipschitz, TaylorRemainder, choose_enclosures
from harnack.enclosures.selection import ENCLOSURE_NAMES
from harnack.fields import Field, Sample
from harnack.geometry import example_curves
from harnack.testing import BrokenPromiseError, check_field
from harnack.tracer.traced_surface import traced_surface

P = np.array([[0.5, 0.0, 0.0]])
RAY = (np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, -1.0]]))


class Bell(Field):
    """exp(-|p|^2/width^2): smooth on one scale and all but constant on larger ones."""

    default_level = 0.5

    def __init__(
        self, known: Callable[[float], tuple[Any, ...]], width: float, radius: float | None
    ) -> None:
        self.known, self.width = known(width), width
        self.domain = None if radius is None else hk.Ball(radius=radius)

    def evaluate(self, p: Any) -> Sample:
        f = dr.exp(-dr.squared_norm(p) / self.width**2)
        return Sample(f, self.slope(p, -2 / self.width**2 * f * p), self.known)

    def slope(self, p: Any, exact: Any) -> Any:
        del p
        return exact


def steep(width: float) -> tuple[Any, ...]:
    return (Lipschitz(0.8578 / width),)


def bent(width: float) -> tuple[Any, ...]:
    return (TaylorRemainder(2.001 / width**2),)


@pytest.mark.few(2)
@pytest.mark.parametrize("known", [steep, bent, lambda w: (*bent(w), *steep(w))])
@pytest.mark.parametrize("radius", [None, 2.0, 6.0, 20.0])
@pytest.mark.parametrize("width", [0.5, 1.0])
def test_a_right_gradient_is_called_right(known: Any, radius: float | None, width: float) -> None:
    """Differences over a share of the domain were off by 6e-11 to 4e-6 and the gradient blamed;
    in single precision numbers of 1e-39 vanish."""
    for seed in range(3):
        check_field(Bell(known, width, radius), rng=seed, count=100, directions=2)


@pytest.mark.parametrize("radius", [None, 2.0, 6.0, 20.0])
@pytest.mark.parametrize(("known", "off"), [(bent, 1e-5), (steep, 1e-3)])
def test_a_wrong_gradient_is_still_seen(known: Any, radius: float | None, off: float) -> None:
    """Also of a field that only promises a Lipschitz constant, where nothing was seen before."""

    class Off(Bell):
        def slope(self, p: Any, exact: Any) -> Any:
            return exact * (1 + off)

    with pytest.raises(BrokenPromiseError, match="gradient is not that of the value"):
        check_field(Off(known, 1.0, radius), count=200, directions=1)


def test_kinks_are_allowed_where_only_a_lipschitz_constant_is_promised() -> None:
    class Corner(Field):
        """max(x, y), whose gradient jumps."""

        domain = hk.Ball(radius=1.5)

        def evaluate(self, p: Any) -> Sample:
            first = p.x > p.y
            one = dr.select(first, type(p)(1, 0, 0), type(p)(0, 1, 0))
            return Sample(dr.select(first, p.x, p.y), one, (Lipschitz(1.0),))

    check_field(Corner(), np.random.default_rng(0).normal(size=(400, 3)) * [1e-3, 1e-3, 0.3])
    check_field(Corner(), count=400)


class Logarithm(Field):
    """log x, only there where x >= 1/100, and only there so flat."""

    domain = hk.Box((0.01, -1, -1), (2, 1, 1))

    def evaluate(self, p: Any) -> Sample:
        return Sample(dr.log(p.x), type(p)(1 / p.x, 0, 0), (Lipschitz(100.0), TaylorRemainder(1e4)))


class Square(Field):
    """|p|^2 with the Lipschitz constant that it has in its domain."""

    domain = hk.Ball(radius=2.0)
    default_level = 1.0

    def evaluate(self, p: Any) -> Sample:
        inside = dr.squared_norm(p) <= 4.0 * (1 + 1e-6)
        return Sample(dr.select(inside, dr.squared_norm(p), dr.nan), 2 * p, (Lipschitz(4.0),))


@pytest.mark.few(1)
@pytest.mark.parametrize("field", [Logarithm(), Square()])
def test_nothing_is_asked_outside_the_domain(field: Field) -> None:
    assert field.domain is not None
    check_field(field, count=300)
    lower, upper = field.domain.bounds()
    points = np.random.default_rng(0).uniform(lower - 1, upper + 1, (300, 3))
    check_field(field, points)
    with pytest.raises(ValueError, match="all 5 lie outside the domain"):
        check_field(field, np.full((5, 3), 9.0))


def test_a_promise_that_fails_within_the_domain_is_seen() -> None:
    class Flatter(Square):
        def evaluate(self, p: Any) -> Sample:
            sample = super().evaluate(p)
            return Sample(sample.value, sample.gradient, (Lipschitz(3.9),))

    with pytest.raises(BrokenPromiseError, match="Lipschitz: f leaves"):
        check_field(Flatter(), count=400)


def test_a_surface_outside_its_extent_is_seen_within_a_domain() -> None:
    class Elsewhere(Square):
        def extent(self, levels: tuple[float, ...]) -> Any:
            return hk.Ball(radius=0.9)

    with pytest.raises(BrokenPromiseError, match="extent: the surface"):
        check_field(Elsewhere(), count=100)


def number(p: Any) -> Any:
    return dr.norm(p) - 1


WRONG: dict[str, tuple[Callable[[Any], Any], str]] = {
    "a number": (number, r"Own.evaluate returned an object of type Float\d*, not a Sample"),
    "a pair": (lambda p: (number(p), p), "returned an object of type tuple, not a Sample"),
    "nothing": (lambda p: None, "returned nothing, not a Sample"),
    "a bare promise": (
        lambda p: Sample(number(p), p, Lipschitz(1.0)),  # type: ignore[arg-type]
        "Sample.promises is an object of type Lipschitz, not a tuple",
    ),
    "numbers for promises": (
        lambda p: Sample(number(p), p, (1.0,)),  # type: ignore[arg-type]
        "Sample.promises holds an object of type float, no promise",
    ),
    "a number for a gradient": (
        lambda p: Sample(number(p), number(p), (Lipschitz(1.0),)),
        r"Sample.gradient is an object of type Float\d*, no 3-vector",
    ),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("use", ["check_field", "trace", "signed_distance", "render"])
def test_what_evaluate_must_return_is_said_at_first_use(name: str, use: str) -> None:
    returned, message = WRONG[name]

    class Own(Field):
        domain = hk.Ball(radius=2.0)

        def evaluate(self, p: Any) -> Sample:
            return returned(p)

    uses: dict[str, Callable[[], object]] = {
        "check_field": lambda: check_field(Own()),
        "trace": lambda: hk.trace(Own(), *RAY),
        "signed_distance": lambda: hk.signed_distance(Own(), RAY[0]),
        "render": lambda: hk.render(Own(), size=(8, 8), spp=1, progress=False),
    }
    with pytest.raises(TypeError, match=message) as raised:
        uses[use]()
    assert "return harnack.proofs.Sample(value, gradient, promises)" in str(raised.value)


class Charge(Field):
    """1/|p|, of which no upper limit is known."""

    domain = hk.Ball(radius=3.0)
    default_level = 1.0

    def evaluate(self, p: Any) -> Sample:
        r = dr.norm(p)
        return Sample(1 / r, -p / (r * r * r), (HarmonicBall(r, 0.0, float("inf")),))


@pytest.mark.parametrize(
    ("field", "enclosures", "some"),
    [
        (hk.SolidAngle(example_curves.wavy_polygon(20)), "lipschitz", {"curvature", "caps"}),
        (Bell(bent, 1.0, 2.0), "caps", {"curvature"}),
        (Charge(), "lipschitz", {"slope", "classic"}),
    ],
)
def test_enclosures_that_do_not_apply_name_those_that_do(
    field: Field, enclosures: str, some: set[str]
) -> None:
    """Namely all whose sharpest proof makes steps of the promises."""
    message = r"promises .*; choose .*, or leave enclosures out"
    with pytest.raises(ValueError, match=message) as raised:
        hk.trace(field, *RAY, enclosures=enclosures)
    named = set(re.findall(r'"(.+?)"', str(raised.value)))
    assert named >= some
    for name in ENCLOSURE_NAMES:
        refusal = pytest.raises(ValueError, match="no enclosure applies")
        with nullcontext() if name in named else refusal:
            hk.trace(field, *RAY, enclosures=choose_enclosures(name).kinds[0])


def test_a_promise_is_needed_and_half_a_range_is_enough() -> None:
    silent, message = Bell(lambda w: (), 1.0, 2.0), r"Sample\.promises is empty.*Lipschitz"
    with pytest.raises(ValueError, match=message) as raised:
        hk.trace(silent, *RAY)
    # Nothing is said of enclosures, which were not asked for, and of formulas.
    assert str(raised.value).startswith("the field makes no promise")
    assert "nclosure" not in str(raised.value)
    assert "ormula" not in str(raised.value)
    with pytest.raises(ValueError, match=r"^the enclosures asked for .*" + message):
        hk.trace(silent, *RAY, enclosures="caps")
    assert hk.trace(Charge(), *RAY).is_hit.all()


def test_numpy_in_evaluate_is_named() -> None:
    """It was Dr.Jit's page about variables that remain dirty."""

    class Own(Field):
        domain = hk.Ball(radius=2.0)

        def evaluate(self, p: Any) -> Sample:
            r = type(p.x)(np.linalg.norm(np.array(p), axis=0))
            return Sample(r - 1, p / r, (Lipschitz(1.0),))

    with pytest.raises(TypeError, match=r"Own.evaluate asked for the numbers of p, as NumPy"):
        hk.trace(Own(), *RAY)


class Wrapped(hk.Field):
    """A field that holds others in a list, and uploads nothing itself."""

    period = 4 * math.pi

    def __init__(self, inner: hk.Field) -> None:
        self.inner = [inner]
        self.default_level = inner.default_level

    def evaluate(self, p: Any) -> Any:
        return self.inner[0].evaluate(p)


def test_a_field_that_holds_a_field_of_the_library_is_prepared_with_it() -> None:
    """The process ended, as the inner field was uploaded while a kernel was recorded."""
    angle = hk.SolidAngle(example_curves.wavy_polygon(12))
    rng = np.random.default_rng(5)
    o = rng.normal(loc=(0.0, 0.0, 2.5), size=(200, 3))
    d = 0.5 * rng.normal(size=(200, 3)) - o
    options = {"t_max": 10.0, "tolerance": 1e-4}
    hits, expected = hk.trace(Wrapped(angle), o, d, **options), hk.trace(angle, o, d, **options)
    np.testing.assert_array_equal(hits.status, expected.status)
    assert hits.is_hit.sum() > 50
    np.testing.assert_allclose(hits.t[hits.is_hit], expected.t[hits.is_hit], atol=1e-3)


class InContainers(Wrapped):
    """The same, from a field in a record in a dictionary, which no other attribute holds."""

    def __init__(self, inner: hk.Field) -> None:
        self.default_level = inner.default_level
        self.records = {"first": (Record(inner),)}

    def evaluate(self, p: Any) -> Any:
        return self.records["first"][0].field.evaluate(p)


@dataclasses.dataclass(frozen=True)
class Record:
    field: Any


def test_fields_in_dictionaries_and_records_are_prepared() -> None:
    """The process ended."""
    angle = hk.SolidAngle(example_curves.wavy_polygon(12))
    o, d = [[0.3, 0.1, 2.5]], [[-0.1, 0.0, -1.0]]
    expected = hk.trace(angle, o, d, t_max=10.0, tolerance=1e-4).t
    again = hk.SolidAngle(example_curves.wavy_polygon(12))  # nothing of it is kept
    t = hk.trace(InContainers(again), o, d, t_max=10.0, tolerance=1e-4).t
    np.testing.assert_allclose(t, expected, atol=1e-3)


def test_a_field_that_nothing_prepared_is_refused_by_name() -> None:
    """The process ended."""
    hidden = hk.SolidAngle(example_curves.wavy_polygon(12))

    class Own(hk.Field):
        period = 4 * math.pi

        def evaluate(self, p: Any) -> Any:
            return hidden.evaluate(p)

    with pytest.raises(RuntimeError, match="a SolidAngle cannot be uploaded while a kernel is"):
        hk.trace(hk.Surface(Own(), 2 * math.pi), [[0.3, 0.1, 2.5]], [[0.0, 0.0, -1.0]])


def test_slots_are_copied_and_pickled() -> None:
    class Own(hk.Field):
        __slots__ = ("radius",)

        def evaluate(self, p: Any) -> Sample:
            return Sample(dr.norm(p) - self.radius, dr.normalize(p), (Lipschitz(1.0),))

    own = Own()
    own.radius = 0.5
    assert copy.copy(own).radius == copy.deepcopy(own).radius == 0.5


def doubled(sample: Sample) -> Sample:
    """The sample of 2 f; the promises are left out, as nothing is traced."""
    return Sample(2 * sample.value, 2 * sample.gradient, (Lipschitz(1e3),))


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (hk.DipolePotential, (np.eye(3), np.eye(3))),
        (hk.SolidAngle, (np.eye(3),)),
        (functools.partial(hk.SolidAngle, cells=True), (example_curves.wavy_polygon(300),)),
    ],
)
def test_values_are_those_of_an_overridden_evaluate(kind: Any, arguments: Any) -> None:
    """They were those of the base class, without the factor 2."""
    base = getattr(kind, "func", kind)

    class Own(base):
        def evaluate(self, p: Any) -> Any:
            return doubled(super().evaluate(p))

    options = getattr(kind, "keywords", {})
    derived, field = Own(*arguments, **options), kind(*arguments)
    points = np.array([[0.3, 0.2, 0.5], [0.7, -0.4, 0.3]])
    for name in ("value", "gradient"):
        expected = 2 * getattr(field, name)(points)
        np.testing.assert_allclose(getattr(derived, name)(points), expected, rtol=1e-2)
    with pytest.raises(NotImplementedError, match="define its method hessian"):
        derived.hessian(points)


class Larger(hk.Sphere):
    """A sphere whose radius is 0.2 larger, with the formula of the smaller one."""

    def evaluate(self, p: Any) -> Sample:
        sample = super().evaluate(p)
        return Sample(sample.value - 0.2, sample.gradient, (Lipschitz(1.0),))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Larger(0.6).blended(hk.Cuboid((1.0, 0.1, 0.1)), 0.1),
        lambda: (Larger(0.6) | hk.Cuboid((1.0, 0.1, 0.1))).twisted(40.0),
        lambda: hk.solids.DisplacedSolid(Larger(0.6), hk.solids.Noise()),
    ],
)
def test_no_formula_of_another_function_is_taken(make: Callable[[], hk.Field]) -> None:
    """The blend was that of the smaller sphere."""
    with pytest.raises(
        TypeError, match=r"define formula\(x, y, z\) of the same function in Larger"
    ):
        make()


class Twice(hk.Field):
    """A field whose two methods disagree."""

    domain = hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> Sample:
        return Sample(dr.norm(p) - 1, dr.normalize(p), (Lipschitz(1.0),))

    def evaluator(self, backend: Any, plan: Any) -> Any:
        return hk.fields.EvaluateOnly(
            lambda p: Sample(dr.norm(p) - 0.5, dr.normalize(p), (Lipschitz(1.0),))
        )


def test_methods_that_disagree_are_found() -> None:
    with pytest.raises(BrokenPromiseError, match=r"Field.evaluate is not the value of the eval"):
        check_field(Twice())
    assert Twice().value([0.0, 0.0, 2.0]) == 1.5  # without a plan


def returning(evaluator: Any) -> hk.Field:
    """A field of a class with this method, and with nothing else."""
    return type("Own", (hk.Field,), {"evaluator": evaluator, "domain": hk.Ball(radius=2.0)})()


@pytest.mark.parametrize("use", [lambda field: hk.trace(field, *RAY), lambda field: field.value(P)])
@pytest.mark.parametrize(
    ("evaluator", "message"),
    [
        (lambda self, backend: None, r"Own.evaluator: .*write def evaluator\(self, backend, plan"),
        (lambda self, backend, plan: None, "Own.evaluator returned nothing: return a"),
        (lambda self, backend, plan: self, "Own.evaluator returned an object of type Own"),
        (lambda self, backend, plan: hk.fields.SampleEvaluator(self, backend), "Own does not def"),
    ],
)
def test_what_evaluator_must_return_is_said(evaluator: Any, message: str, use: Any) -> None:
    with pytest.raises(TypeError, match=message):
        use(returning(evaluator))


class Bent(Field):
    """|p|^2: its gradient changes by twice the way. share: of that, what its evaluator says."""

    def __init__(self, share: float) -> None:
        self.share = share

    def evaluate(self, p: Any) -> Sample:
        return Sample(dr.squared_norm(p), 2 * p, (TaylorRemainder(2.0),))

    def evaluator(self, backend: Any, plan: Any = None) -> Any:
        class BentEvaluator(hk.fields.SampleEvaluator):
            def gradient_change_bound(self, p: Any, radius: Any) -> Any:
                return 2 * self.field.share * radius

        return BentEvaluator(self, backend)


def test_a_bound_of_the_gradients_change_is_tried() -> None:
    """Meshes are proved by it; a tenth of it was called right."""
    check_field(Bent(1.0))
    with pytest.raises(BrokenPromiseError, match="gradient_change_bound: the gradient changes by"):
        check_field(Bent(0.1))


class Grown(Field):
    """|p| - 1, with a radius that its evaluator adds up on the backend."""

    def evaluator(self, backend: Any, plan: Any = None) -> Any:
        return GrownEvaluator(backend)


class GrownEvaluator(hk.fields.Evaluator):
    def __init__(self, backend: Any) -> None:
        self.radius = dr.opaque(backend.Float, 0.75) + dr.opaque(backend.Float, 0.25)

    def evaluate(self, p: Any) -> Sample:
        return Sample(dr.norm(p) - self.radius, p / dr.norm(p), (Lipschitz(1.0),))


def test_numbers_of_evaluators_are_computed_before_rays() -> None:
    """The sum took the size of the first batch: incompatible sizes. Also inside of a solid."""
    for field in (Grown(), hk.solid(Grown(), below=0) | hk.Sphere(0.5)):
        surface = hk.Surface(field, clip=hk.Ball(radius=2.0))
        backend = choose_backend("single")
        tracer = traced_surface(surface).tracer(backend)
        for n in (50, 90):
            o = backend.Array3f(dr.linspace(backend.Float, -0.5, 0.5, n), 0, 3)
            hit = tracer.first_hit(o, backend.Array3f(0, 0, -1), 0, np.inf)
            assert dr.width(hit.t) == n
            assert (np.array(hit.status) == hk.RayStatus.HIT).all()


def test_traits_of_another_type_are_refused() -> None:
    kind = type("Own", (Twice,), {"traits": {"has_jumps": True}})
    with pytest.raises(TypeError, match=r"the traits of Own are .*harnack.fields.Traits\("):
        kind()


class Rounded(Field):
    """x, off by 0.5/scale^power at an accuracy scale, and by nothing at large scales."""

    default_level = 0.3
    domain = hk.Ball(radius=2.0)
    traits = hk.fields.Traits(has_variable_accuracy=True)

    def __init__(self, power: float) -> None:
        self.power = power

    def evaluate(self, p: Any) -> Sample:
        return self.at(1.0 + 0 * p.x).evaluate(p)

    def at(self, scale: Any) -> hk.fields.Evaluator:
        off = 0.5 * dr.maximum(scale, 0.25) ** -self.power
        off = dr.select(scale < 1e5, off, 0)
        known = (Lipschitz(1.0),)
        return hk.fields.EvaluateOnly(
            lambda p: Sample(p.x + off, type(p)(1.0, 0.0, 0.0), known, off, truncation_error=off)
        )

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        accuracy = hk.fields.VariableAccuracy(self.at, coarsest=0.25)
        return hk.fields.SampleEvaluator(self, backend, variable_accuracy=accuracy)


@pytest.mark.parametrize("power", [0.5, 1.0, 3.0, 6.0])
def test_truncation_may_fall_as_any_power_of_the_scale(power: float) -> None:
    hits = hk.trace(Rounded(power), [[1.5, 0, 0]], [[-1.0, 0, 0]], tolerance=1e-3)
    assert hits.status[0] == hk.RayStatus.HIT
    assert hits.t[0] == pytest.approx(1.2, abs=1.1e-3)


def test_a_field_of_a_function_takes_functions_only() -> None:
    with pytest.raises(TypeError, match="evaluate must be a function that takes"):
        hk.fields.EvaluateOnly(hk.Gyroid(1.0))  # type: ignore[arg-type]
