"""Ranges of numbers, functions and jets hold every true value, whatever the operands."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.arithmetic import ZERO, Interval, Jet, Values, maximum, minimum, norm, power
from harnack.arithmetic.functions import ElementaryFunction, length_bound, sqrt_range
from harnack.backend import choose_backend

Long = np.longdouble
PRECISIONS = ("single", "double")
# Single precision is where rounding shows.
QUICK_PRECISIONS = ["single", pytest.param("double", marks=pytest.mark.slow)]


def hostile(dtype: Any) -> Any:
    """Ends of ranges: zeros, the smallest and largest numbers, poles of tan and ends of asin."""
    info = np.finfo(dtype)
    near = [0.0, 1.0, math.pi / 2, math.pi, 3 * math.pi / 2, 2 * math.pi, 0.5, 1 / 3, 1e-3]
    sizes = [info.tiny, 4 * info.tiny, info.tiny**0.5, info.max, info.max**0.5, math.inf]
    angles = [11.0, 1e3 * math.pi, 1e5, 999999.0, 1e6, 1.5e6, 88.0, 88.5, 709.6, 3e7]
    numbers = np.array([*near, *sizes, *angles]).astype(dtype)
    with np.errstate(over="ignore"):
        beside = [numbers, *(np.nextafter(numbers, dtype(v)) for v in (0, np.inf))]
    positive = np.unique(np.concatenate(beside))
    positive = positive[(positive == 0) | (positive >= info.tiny)]  # others count as 0
    return np.concatenate([-positive, positive])


def ranges(rng: Any, dtype: Any, count: int) -> tuple[Any, Any]:
    """Lower and upper ends: hostile ones, points, slivers, and ordinary ranges of all sizes."""
    ends = hostile(dtype)
    a, b = rng.choice(ends, count), rng.choice(ends, count)
    a[::4] = (rng.normal(size=a[::4].shape) * 10.0 ** rng.uniform(-6, 3, a[::4].shape)).astype(
        dtype
    )
    b[::8] = a[::8] + (10.0 ** rng.uniform(-9, 1, a[::8].shape)).astype(dtype)
    b[1::8] = a[1::8]
    with np.errstate(over="ignore"):
        b[2::8] = np.nextafter(a[2::8], dtype(np.inf))
    for one in (a, b):
        one[np.abs(one) < np.finfo(dtype).tiny] = 0
    most = np.finfo(dtype).max
    return np.clip(np.minimum(a, b), -np.inf, most), np.clip(np.maximum(a, b), -most, np.inf)


def inside(rng: Any, low: Any, high: Any) -> list[Any]:
    """Numbers of the ranges: the ends, 0, and some in between."""
    dtype = low.dtype.type
    most = np.finfo(dtype).max
    a, b = np.clip(low, -most, most), np.clip(high, -most, most)
    found = [a, b, np.clip(dtype(0), a, b)]
    for _ in range(4):
        t = rng.uniform(size=a.shape).astype(dtype) ** rng.integers(1, 6)
        found.append(np.clip(a * (1 - t) + b * t, a, b))
    return found


def finite(x: Any) -> Any:
    return np.clip(x, -np.finfo(x.dtype).max, np.finfo(x.dtype).max)


def interval(backend: Any, low: Any, high: Any, *, exact: bool) -> Interval:
    a = backend.Float(low)
    return Interval(a, a if exact else backend.Float(high))


def result_dtype(result: Interval) -> Any:
    both = result.lower, result.upper
    is_single = any(dr.type_v(type(v)) == dr.VarType.Float32 for v in both if dr.is_array_v(v))
    return np.float32 if is_single else np.float64


def check(result: Interval, true: Any, where: Any, what: str) -> None:
    """That true numbers lie in the result; an end that is no number says nothing."""
    shape = np.shape(true)
    low = np.broadcast_to(np.array(result.lower, dtype=np.float64), shape).astype(Long)
    high = np.broadcast_to(np.array(result.upper, dtype=np.float64), shape).astype(Long)
    slack = 2 * np.finfo(result_dtype(result)).tiny  # sums below that may count as 0
    bad = where & np.isfinite(true) & ((true < low - slack) | (true > high + slack))
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise AssertionError(
            f"{what}: {bad.sum()} outside, such as {true[k]!r} of "
            f"[{low[k]!r}, {high[k]!r}], lane {k}"
        )


OPERATIONS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "+": (lambda x, y: x + y, lambda a, b: a + b),
    "-": (lambda x, y: x - y, lambda a, b: a - b),
    "*": (lambda x, y: x * y, lambda a, b: a * b),
    "square": (lambda x, y: x.square(), lambda a, b: a * a),
    "1/": (lambda x, y: x.reciprocal(), lambda a, b: 1 / a),
    "neg": (lambda x, y: -x, lambda a, b: -a),
    "hull": (lambda x, y: x.hull(y), lambda a, b: a),
    "largest": (lambda x, y: Interval(-x.max_abs, x.max_abs), lambda a, b: np.abs(a)),
    "smallest": (lambda x, y: Interval(x.min_abs, dr.inf), lambda a, b: np.abs(a)),
    "radius": (
        lambda x, y: (
            Interval(x.midpoint, x.midpoint)
            + Interval(-x.radius, x.radius) * Interval(1 + 1e-5, 1 + 1e-5)
        ),
        lambda a, b: a,
    ),
}


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_of_intervals(name: str, precision: Any) -> None:
    backend, rng = choose_backend(precision), np.random.default_rng(1)
    operation, truth = OPERATIONS[name]
    x, y = (ranges(rng, backend.dtype, 4_000) for _ in range(2))
    for exact_x, exact_y in itertools.product((False, True), repeat=2):
        xs = (finite(x[0]),) * 2 if exact_x else x
        ys = (finite(y[0]),) * 2 if exact_y else y
        a = interval(backend, *xs, exact=exact_x)
        b = interval(backend, *ys, exact=exact_y)
        result = operation(a, b)
        with np.errstate(all="ignore"):
            for u, v in zip(inside(rng, *xs), inside(rng, *ys), strict=True):
                where = np.isfinite(xs[0] - xs[1]) if name == "radius" else True
                check(result, truth(u.astype(Long), v.astype(Long)), where, name)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_constants_meet_arrays_without_rounding_inwards(precision: Any) -> None:
    """Sums and products of constants are made before a kernel runs, in double precision."""
    backend, rng = choose_backend(precision), np.random.default_rng(2)
    for _ in range(200):
        a, b, c = rng.normal(size=3) * 10.0 ** rng.integers(-3, 4, 3)
        x, y, z = (Interval.enclosing(v, backend.Float) for v in (a, b, c))
        for made, true in (
            (x * y + z, Long(a) * Long(b) + Long(c)),
            ((x + y) * z, (Long(a) + Long(b)) * Long(c)),
            ((x * y).reciprocal() - z, 1 / (Long(a) * Long(b)) - Long(c)),
            (x.square() * y, Long(a) ** 2 * Long(b)),
        ):
            assert made.is_literal
            ends = Interval(backend.Float(made.lower), backend.Float(made.upper))
            check(ends, np.array([true]), True, "constants")
            assert made.upper - made.lower < 2e-6 * (abs(a) + 1) * (abs(b) + 1) * (abs(c) + 1) * (
                1 + 1 / abs(a * b)
            ) * (abs(a) + 1)


def long_power(n: float) -> Callable[[Any], tuple[Any, Any, Any]]:
    def of(x: Any) -> tuple[Any, Any, Any]:
        m = Long(n)
        first = m * x ** (m - 1) if n else 0 * x
        return x**m, first, m * (m - 1) * x ** (m - 2) if n not in (0.0, 1.0) else 0 * x

    return of


def root(x: Any) -> Any:
    """The derivative of the arc sine."""
    return ((1 - x) * (1 + x)) ** Long(-0.5)


TRUTHS: dict[str, tuple[ElementaryFunction, Callable[[Any], tuple[Any, Any, Any]]]] = {
    "exp": (hk.math.exp, lambda x: (np.exp(x),) * 3),
    "log": (hk.math.log, lambda x: (np.log(x), 1 / x + 0 * np.log(x), -1 / x**2 + 0 * np.log(x))),
    "sqrt": (hk.math.sqrt, lambda x: (np.sqrt(x), 0.5 / np.sqrt(x), -0.25 / (x * np.sqrt(x)))),
    "sin": (hk.math.sin, lambda x: (np.sin(x), np.cos(x), -np.sin(x))),
    "cos": (hk.math.cos, lambda x: (np.cos(x), -np.sin(x), -np.cos(x))),
    "tan": (
        hk.math.tan,
        lambda x: (np.tan(x), 1 / np.cos(x) ** 2, 2 * np.sin(x) / np.cos(x) ** 3),
    ),
    "tanh": (
        hk.math.tanh,
        lambda x: (np.tanh(x), 1 / np.cosh(x) ** 2, -2 * np.tanh(x) / np.cosh(x) ** 2),
    ),
    "atan": (hk.math.atan, lambda x: (np.arctan(x), 1 / (1 + x**2), -2 * x / (1 + x**2) ** 2)),
    "asin": (
        hk.math.asin,
        lambda x: (np.arcsin(x), root(x), x * root(x) ** 3),
    ),
    "acos": (
        hk.math.acos,
        lambda x: (np.arccos(x), -root(x), -x * root(x) ** 3),
    ),
    "sinh": (hk.math.sinh, lambda x: (np.sinh(x), np.cosh(x), np.sinh(x))),
    "cosh": (hk.math.cosh, lambda x: (np.cosh(x), np.sinh(x), np.cosh(x))),
    "abs": (hk.math.absolute, lambda x: (np.abs(x), np.sign(x), 0 * x)),
    **{
        f"power {n}": (power(n), long_power(n))
        for n in (0.0, 1.0, 2.0, 3.0, 4.0, 7.0, -1.0, -2.0, -3.0, 0.5, 1.5, 2.5, -0.5, 1 / 3, 12.7)
    },
}  # fmt: skip


@pytest.mark.few(4)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("name", TRUTHS)
def test_functions(name: str, precision: Any) -> None:
    backend, rng = choose_backend(precision), np.random.default_rng(3)
    function, truth = TRUTHS[name]
    x = ranges(rng, backend.dtype, 6_000)
    for exact in (False, True):
        xs = (finite(x[0]),) * 2 if exact else x
        made = function.ranges(interval(backend, *xs, exact=exact))
        for u in inside(rng, *xs):
            with np.errstate(all="ignore"):
                true = truth(u.astype(Long))
            for k, (one, right) in enumerate(zip(made, true, strict=True)):
                check(one, right, True, f"{name}, derivative {k}, exact={exact}")


@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
def test_angles(precision: Any) -> None:
    """Ranges on boxes, many of which meet the cut: there [-pi, pi], and any derivative."""
    backend, rng, n = choose_backend(precision), np.random.default_rng(4), 20_000
    y, x = (ranges(rng, backend.dtype, n) for _ in range(2))
    for exact in (False, True):
        ys, xs = ((finite(one[0]),) * 2 if exact else one for one in (y, x))
        boxes = [interval(backend, *one, exact=exact) for one in (ys, xs)]
        one = Interval.point(backend.Float(1))
        jets = [Jet(box, (one,), (ZERO,), piece_length=backend.Float(0)) for box in boxes]
        made = hk.math.atan2(*jets)
        for v, u in zip(inside(rng, *ys), inside(rng, *xs), strict=True):
            v, u = (part.astype(Long) + 0 for part in (v, u))  # no -0
            with np.errstate(all="ignore"):
                square = u * u + v * v
                first = (u - v) / square
                second = -2 * (u - v) * (u + v) / square**2
            check(made.value, np.arctan2(v, u), True, "angle")
            check(made.first_derivatives[0], first, True, "angle, first derivative")
            check(made.second_derivatives[0], second, True, "angle, second derivative")
        meets = (ys[0] <= 0) & (ys[1] >= 0) & (xs[0] <= 0)
        low, high = (np.array(end) for end in (made.value.lower, made.value.upper))
        if not exact:
            assert (low[meets] <= -math.pi).all()
            assert (high[meets] >= math.pi).all()
        assert np.isinf(np.array(made.first_derivatives[0].lower))[meets].all()
        assert np.isinf(np.array(made.first_derivatives[0].upper))[meets].all()
        assert (np.abs([low, high]) <= math.pi * (1 + 1e-6)).all()


def test_angles_on_the_cut() -> None:
    """-0 is 0, of which the angle is pi; the origin has none, and counts as 0."""
    field = hk.expression("atan2(y, x)")
    points = [[-1, 0, 0], [-1, -0.0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 0], [0, -0.0, 1]]
    for precision in PRECISIONS:
        values = field.value(np.array(points), precision=precision)
        assert values == pytest.approx([math.pi, math.pi, 0, -math.pi / 2, 0, 0])


# Formulas as functions of jets, and of long doubles.
FORMULAS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "polynomial": (
        lambda x, y, z: 0.1 * (x * x * y - 3 * z) + x / 3 + (z - 0.7) ** 3 / y,
        lambda x, y, z: Long(0.1) * (x * x * y - 3 * z) + x / 3 + (z - Long(0.7)) ** 3 / y,
    ),
    "mixed": (
        lambda x, y, z: (
            hk.math.sin(3 * x) * hk.math.exp(-y * y) + hk.math.cos(x * z) / (2 + hk.math.tanh(z))
        ),
        lambda x, y, z: np.sin(3 * x) * np.exp(-y * y) + np.cos(x * z) / (2 + np.tanh(z)),
    ),
    "crease": (
        lambda x, y, z: maximum(x, y * z, 0.3) - minimum(abs(x), abs(y - 0.5)),
        lambda x, y, z: (
            np.maximum(np.maximum(x, y * z), Long(0.3)) - np.minimum(np.abs(x), np.abs(y - 0.5))
        ),
    ),
    "torus": (
        lambda x, y, z: norm(norm(x, y) - 1, z) - 0.3,
        lambda x, y, z: np.sqrt((np.sqrt(x * x + y * y) - 1) ** 2 + z * z) - Long(0.3),
    ),
    "angle": (
        lambda x, y, z: hk.math.atan2(y * z + 0.1, x - y) + 0.3 * hk.math.atan2(2.0, x),
        lambda x, y, z: np.arctan2(y * z + Long(0.1), x - y) + Long(0.3) * np.arctan2(Long(2), x),
    ),
    **{
        f"norm {p}": (
            lambda x, y, z, p=p: norm(x, y, 2 * z, p=p),
            lambda x, y, z, p=p: (
                (np.abs(x) ** Long(p) + np.abs(y) ** Long(p) + np.abs(2 * z) ** Long(p))
                ** (1 / Long(p))
            ),
        )
        for p in (1.0, 1.5, 2.0, 3.0, 4.0, 8.5)
    },
    "largest": (
        lambda x, y, z: norm(x, y, z, p=math.inf),
        lambda x, y, z: np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)),
    ),
}


def places(rng: Any, count: int) -> tuple[Any, Any, Any]:
    """Origins, directions and lengths of pieces, many through the origin or along an axis."""
    p, d = rng.normal(size=(2, count, 3))
    p[::5] *= 0.05
    p[1::5] = np.round(p[1::5])
    d[2::5, :2] = 0.0
    d[3::5, 2] = 0.0
    d /= np.linalg.norm(d, axis=1)[:, None]
    p[4::5] = -d[4::5] * rng.uniform(0, 1, (len(p[4::5]), 1))  # through the origin
    return p, d, 10.0 ** rng.uniform(-4, 1, count)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("is_narrowed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_jets_along_pieces(name: str, precision: Any, *, is_narrowed: bool) -> None:
    """Values lie in the range; difference quotients of first order in that of F', of second order
    in that of F''."""
    backend, rng = choose_backend(precision), np.random.default_rng(4)
    formula, truth = FORMULAS[name]
    p, d, length = (v.astype(backend.dtype) for v in places(rng, 2_000))
    start = (rng.uniform(0, 1, len(length)) < 0.7) * rng.uniform(0, 2, len(length))
    start = start.astype(backend.dtype)
    end = start + length
    at, along = (backend.Array3f(*(backend.Float(c) for c in v.T)) for v in (p, d))
    coordinates = Jet.along_ray(at, along, backend.Float(start), backend.Float(end))
    if not is_narrowed:
        coordinates = tuple(replace(one, jet_at_start=None) for one in coordinates)
    jet = formula(*coordinates)
    p, d, start, width = (v.astype(Long) for v in (p, d, start, end - start))

    def f(s: Any) -> Any:
        with np.errstate(all="ignore"):
            return truth(*(p[:, k] + s * d[:, k] for k in range(3)))

    for _ in range(5):
        a, b, c = np.sort(rng.uniform(size=(3, len(start))), axis=0).astype(Long)
        a = np.where(rng.uniform(size=a.shape) < 0.3, 0, a)
        c = np.where(rng.uniform(size=a.shape) < 0.3, 1, c)
        b = np.maximum(b, a + 1e-3)
        c = np.minimum(np.maximum(c, b + 1e-3), 1)
        ok = (b > a) & (c > b)
        a, b, c = (start + width * one for one in (a, b, c))
        fa, fb, fc = f(a), f(b), f(c)
        check(jet.value, fb, ok, "value")
        check(jet.value, fa, ok, "value")
        with np.errstate(all="ignore"):
            noise = Long(2.0) ** -58 * (np.abs(fa) + np.abs(fb) + np.abs(fc) + 1)
            left, right = (fb - fa) / (b - a), (fc - fb) / (c - b)
            doubt = noise * (1 / (b - a) + 1 / (c - b))
        check_within(jet.first_derivatives[0], left, doubt, ok, "first")
        check_within(jet.first_derivatives[0], right, doubt, ok, "first")
        second = 2 * (right - left) / (c - a)
        check_within(jet.second_derivatives[0], second, 4 * doubt / (c - a), ok, "second")


def check_within(result: Interval, true: Any, doubt: Any, where: Any, what: str) -> None:
    """As `check`, of numbers known up to a doubt."""
    shape = np.shape(true)
    low = np.broadcast_to(np.array(result.lower, dtype=np.float64), shape).astype(Long)
    high = np.broadcast_to(np.array(result.upper, dtype=np.float64), shape).astype(Long)
    nearest = np.clip(
        true, np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    )
    known = where & np.isfinite(true) & np.isfinite(doubt)
    bad = known & (np.abs(nearest - true) > doubt)
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise AssertionError(
            f"{what}: {bad.sum()} outside, such as {true[k]!r} +- {doubt[k]!r} of "
            f"[{low[k]!r}, {high[k]!r}], lane {k}"
        )


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("name", FORMULAS)
def test_gradients_and_hessians_at_points(name: str, precision: Any) -> None:
    """Against central differences in long doubles, at points away from creases."""
    backend, rng = choose_backend(precision), np.random.default_rng(5)
    formula, truth = FORMULAS[name]
    p = rng.normal(size=(3, 500)).astype(backend.dtype)
    jet = formula(*Jet.at_point(backend.Array3f(p), order=2))
    p = p.astype(Long)
    h = Long(1e-5)

    def f(*shifts: Any) -> Any:
        return truth(*(p[k] + h * sum(one[k] for one in shifts) for k in range(3)))

    axes = np.eye(3, dtype=int)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    check(jet.value, f(), True, "value")
    for i in range(3):
        slope = (f(axes[i]) - f(-axes[i])) / (2 * h)
        check_mostly(jet.first_derivatives[i], slope, 1e-6)
    for k, (i, j) in enumerate(pairs):
        a, b = axes[i], axes[j]
        mixed = (f(a, b) - f(a, -b) - f(-a, b) + f(-a, -b)) / (4 * h * h)
        check_mostly(jet.second_derivatives[k], mixed, 1e-4)


def check_mostly(result: Interval, true: Any, relative: float) -> None:
    """That nearly all numbers, known to a few digits, are in a narrow result."""
    low, high = (
        np.broadcast_to(np.array(v, dtype=np.float64), true.shape)
        for v in (result.lower, result.upper)
    )
    doubt = relative * (1 + np.abs(true))
    right = (true >= low - doubt) & (true <= high + doubt)
    assert right.mean() > 0.985
    narrow = high - low < 1e-2 * (1 + np.abs(true))
    assert narrow.mean() > 0.95


@pytest.mark.parametrize(
    "make", [lambda y: 1 / y, hk.math.tan, lambda y: y**-2.0, lambda y: 1 / y**3]
)
def test_nothing_is_known_across_a_pole(make: Callable[[Any], Any]) -> None:
    """1/y falls on both sides of 0 and is larger behind it: its slope there is no number <= 0."""
    backend = choose_backend("double")
    at = backend.Array3f(0, -1 if make is not hk.math.tan else 1, 0)
    jet = make(
        Jet.along_ray(at, backend.Array3f(0, 1, 0), backend.Float(0.0), backend.Float(2.0))[1]
    )
    for one in (jet.first_derivatives[0], jet.second_derivatives[0]):
        assert one.lower[0] == -math.inf
        assert one.upper[0] == math.inf


def test_kinds_of_numbers() -> None:
    """Python numbers, NumPy arrays, Dr.Jit arrays and jets mix."""
    backend = choose_backend("double")
    x = np.array([3.0, -3.0, 0.0, 1e-200, 1e200])
    y = np.array([4.0, 4.0, 0.0, 0.0, 1e200])
    a, b = backend.Float(x), backend.Float(y)
    for p in (1.0, 1.5, 2.0, 4.0, math.inf):
        expected = norm(x, y, p=p)
        assert expected[0] == pytest.approx(np.linalg.norm([3, 4], p))
        usual = [0, 1, 2, 3] if p == 2.0 else list(range(5))
        assert np.allclose(np.array(norm(a, b, p=p))[usual], expected[usual], rtol=1e-12)
        assert norm(3.0, 4, p=p) == pytest.approx(expected[0])
        jet = norm(Jet.at_point(backend.Array3f(a, b, 0))[0], b, p=p)
        assert np.array(jet.value.lower)[0] <= expected[0] <= np.array(jet.value.upper)[0]
    assert maximum(1, 2.0, -3) == 2.0
    assert list(minimum(x, 1.0)[:2]) == [1.0, -3.0]
    assert list(maximum(a, 1.0, y)[:2]) == [4.0, 4.0]
    jet = Jet.at_point(backend.Array3f(1, 2, 3))[0]
    for larger in (maximum(0.5, jet), np.maximum(0.5, jet), np.maximum(jet, 0.5)):
        assert float(larger.value.lower[0]) == 1.0
    assert float(hk.math.absolute(jet - 3).value.lower[0]) <= 2.0


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: maximum(1.0), TypeError, "two numbers"),
        (lambda: norm(), TypeError, "a number or more"),
        (lambda: norm(1.0, 2.0, p=0.5), ValueError, "at least 1"),
        (lambda: norm(1.0, 2.0, p=math.nan), ValueError, "at least 1"),
    ],
)
def test_wrong_calls(call: Callable[[], Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()


def test_values_hold_all_values_and_say_where_there_are_none() -> None:
    """Ranges on boxes, against samples: whether they jump and where they have no value."""
    backend = choose_backend("double")
    rng = np.random.default_rng(3)
    centers, half = rng.uniform(-2, 2, (2000, 3)), rng.uniform(0, 0.5, 2000)

    def formula(x: Any, y: Any, z: Any) -> Any:
        root = hk.math.sqrt(x * y) if isinstance(x, Values) else np.sqrt(x * y)
        return maximum(root + z**2, (z + 3.0) ** 0.5 - y) * x

    p = backend.Array3f(*(backend.Float(value) for value in centers.T))
    values = formula(*Values.between(p, p, backend.Float(half)))
    low, high = np.array(values.value.lower), np.array(values.value.upper)
    nowhere, gaps = np.array(values.nowhere), np.array(values.gaps)
    assert 50 < nowhere.sum() + gaps.sum() < 1950
    for _ in range(20):
        points = centers + half[:, None] * rng.uniform(-1, 1, (2000, 3))
        with np.errstate(invalid="ignore"):
            truth = formula(*points.T)
        there = np.isfinite(truth)
        assert not (there & nowhere).any()
        assert (there | gaps | nowhere)[np.isfinite(low)].all()
        assert not (there & ((truth < low) | (truth > high))).any()
    x = Values.between(p, p, backend.Float(half))[0]
    over = np.array((1.0 / x).jumps)
    np.testing.assert_array_equal(over, np.abs(centers[:, 0]) <= half)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_ends_that_are_no_number_stay_unknown(precision: Any) -> None:
    """Of numbers that only a kernel knows: to processors NaN is not unequal to itself."""
    real = choose_backend(precision).Float
    unknown, half, one = (dr.opaque(real, x) for x in (math.nan, 0.5, 1.0))
    high, low = Interval(-half, unknown), Interval(unknown, half)
    both = Interval(-one, one)
    for a, b in itertools.permutations((high, low, both), 2):
        hull = a.hull(b)
        assert dr.isnan(hull.upper)[0] == (high in (a, b))
        assert dr.isnan(hull.lower)[0] == (low in (a, b))
    assert (high.intersect(both).upper[0], both.intersect(low).lower[0]) == (1, -1)
    assert dr.isnan(high.max_abs)[0]
    assert dr.isnan(low.max_abs)[0]


@pytest.mark.parametrize("precision", ["single", "double"])
def test_bounds_of_lengths_are_the_ends_of_ranges_of_roots(precision: Any) -> None:
    backend = choose_backend(precision)
    sizes = [0.0, 1e-300, 1e-30, 0.1, 1.0, 3.0, 1e30, math.inf, math.nan]
    numbers = [backend.Float(part) for part in np.array([*itertools.product(sizes, repeat=3)]).T]
    squares = [Interval.point(number).square() for number in numbers]
    expected = sqrt_range(squares[0] + squares[1] + squares[2])
    for sign, end in ((-1, expected.lower), (1, expected.upper)):
        np.testing.assert_array_equal(length_bound(numbers, sign), end)


def test_roots_of_sums_of_squares_have_the_slopes_of_norms() -> None:
    backend = choose_backend("double")
    x, y, _ = Jet.over_ball(backend.Array3f(0.0, 0.1, 0.0), backend.Float(0.2))
    written = hk.math.sqrt(x * x / 4 + 2 * y**2)
    exact = norm(x * 0.5, y * 2**0.5)
    for slope, right in zip(written.first_derivatives, exact.first_derivatives, strict=True):
        np.testing.assert_allclose(np.array(slope.lower), np.array(right.lower), rtol=1e-9)
        np.testing.assert_allclose(np.array(slope.upper), np.array(right.upper), rtol=1e-9)
    assert np.isinf(np.array(hk.math.sqrt(x * x - y * y).first_derivatives[0].upper))
