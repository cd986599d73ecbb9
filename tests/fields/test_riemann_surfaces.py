"""Riemann surfaces: all sheets, their branch points and poles, against dense sampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy
from harnack.enclosures import LevelGaps, SlopeRange
from harnack.enclosures.extremum import BranchPointEnclosure, BranchSample, NearestBranchEnclosure
from harnack.fields.analytic.branches import Branches, Disk, PlaneSegment, complex_type
from harnack.fields.analytic.plane import make_branches
from harnack.testing import BrokenPromiseError, check_field
from harnack.testing.branch_contracts import check_branch_points
from tests.backend.test_kernels import compiled

Product = Callable[[np.ndarray, np.ndarray], np.ndarray]


def of_powers(
    exponents: dict[complex, Fraction], part: str = "imag", height: float = 1.0
) -> Product:
    """The product of all sheets of a product of powers, which has one value at a point."""
    count = math.lcm(*(power.denominator for power in exponents.values()))

    def product(z: np.ndarray, h: np.ndarray) -> np.ndarray:
        g = np.ones_like(z)
        for a, power in exponents.items():
            with np.errstate(divide="ignore", invalid="ignore"):  # rays through a
                g = g * np.exp(float(power) * np.log(z - a))
        all_sheets = np.ones_like(h)
        for k in range(count):
            one = g * np.exp(2j * math.pi * k / count)
            all_sheets = all_sheets * (h - height * (one.imag if part == "imag" else one.real))
        return all_sheets

    return product


def of_angle(z: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Which turn of log's surface lies below, as +-1: its parity along each row."""
    angle = np.unwrap(np.angle(z), axis=-1)
    turn = np.floor((h - angle) / (2 * math.pi))
    return np.where(turn % 2 == 0, 1.0, -1.0)


def of_asin(z: np.ndarray, h: np.ndarray, part: str) -> np.ndarray:
    """sin u - sin h, or h^2 - v^2, for sin(u + i v) = z."""
    mean = 0.5 * (abs(z - 1) + abs(z + 1))
    if part == "real":
        return z.real / mean - np.sin(h)
    return h * h - np.arccosh(np.maximum(mean, 1.0)) ** 2


@dataclass(frozen=True)
class Case:
    field: hk.fields.RiemannSurface
    product: Product
    radius: float


def root(z: Any) -> Any:
    w = dr.sqrt(z)
    return [(w, 0.5 / w), (-w, -0.5 / w)]


OWN = hk.fields.RiemannSurface(
    root,
    singular_points=[hk.fields.BranchPoint(0, power=0.5)],
    second_bound=lambda z, r: 0.25 * (abs(z) - r) ** -1.5,
)
HALF, THIRD = Fraction(1, 2), Fraction(1, 3)
CASES = {
    "log": Case(hk.fields.RiemannSurface("log"), of_angle, 4.0),
    "sqrt": Case(hk.fields.RiemannSurface("sqrt"), of_powers({0: HALF}), 1.0),
    "own": Case(OWN, of_powers({0: HALF}), 1.0),
    "real sqrt": Case(hk.fields.RiemannSurface("sqrt", "real"), of_powers({0: HALF}, "real"), 1.0),
    "cbrt": Case(hk.fields.RiemannSurface("cbrt"), of_powers({0: THIRD}), 1.0),
    "2/3": Case(hk.fields.RiemannSurface("power", exponent=2 / 3), of_powers({0: 2 * THIRD}), 1.0),
    "5/2": Case(hk.fields.RiemannSurface("power", exponent=2.5), of_powers({0: 5 * HALF}), 1.0),
    "-1/2": Case(hk.fields.RiemannSurface("power", exponent=-0.5), of_powers({0: -HALF}), 1.0),
    "pole": Case(hk.fields.RiemannSurface({0: -1}), of_powers({0: Fraction(-1)}), 1.0),
    "asin": Case(hk.fields.RiemannSurface("asin"), lambda z, h: of_asin(z, h, "imag"), 2.0),
    "real asin": Case(
        hk.fields.RiemannSurface("asin", "real"), lambda z, h: of_asin(z, h, "real"), 2.0
    ),
    "elliptic": Case(
        hk.fields.RiemannSurface(
            "sqrt", argument={0: 1, 1: 1, -1: 1}, height=0.5, domain=hk.Ball(radius=2.0)
        ),
        of_powers({0: HALF, 1: HALF, -1: HALF}, height=0.5),
        2.0,
    ),
    "product": Case(
        hk.fields.RiemannSurface({0: 0.5, 1: THIRD, 0.5j: -0.5}, domain=hk.Ball(radius=2.0)),
        of_powers({0: HALF, 1: THIRD, 0.5j: -HALF}),
        2.0,
    ),
}
QUICK = ("log", "sqrt", "real asin", "own")


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rays(n: int, radius: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """From three radii away to uniform points of the ball, as the counts in the docs have them."""
    rng = np.random.default_rng(seed)
    o = 3 * radius * unit(rng.normal(size=(n, 3)))
    target = radius * unit(rng.normal(size=(n, 3))) * rng.random((n, 1)) ** (1 / 3)
    return o, unit(target - o)


def hostile_rays(n: int, case: Case, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Past singular points, at distances from 0 to the radius; a quarter level and a quarter
    upright; half of them start within the ball."""
    rng = np.random.default_rng(seed)
    points = [point.location for point in case.field.branches.branch_points] or [0j]
    at = np.array(points)[rng.integers(len(points), size=n)]
    beside = case.radius * 10.0 ** rng.uniform(-7, 0, n) * (rng.random(n) < 0.9)
    turn = rng.uniform(0, 2 * math.pi, n)
    height = case.radius * rng.uniform(-1, 1, n)
    target = np.column_stack(
        [at.real + beside * np.cos(turn), at.imag + beside * np.sin(turn), height]
    )
    d = rng.normal(size=(n, 3))
    d[: n // 4, 2] = 0
    d[n // 4 : n // 2, :2] = 0
    d = unit(d)
    back = case.radius * np.where(rng.random(n) < 0.5, 3.0, rng.uniform(0, 1, n))
    return target - back[:, None] * d, d


def check_first_hits(case: Case, o: np.ndarray, d: np.ndarray, precision: Any, samples: int) -> int:
    """No crossing before the first hit, and every hit is at a sheet. Returns how many hits."""
    hits = hk.trace(case.field, o, d, precision=precision)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    hit = hits.status == hk.RayStatus.HIT
    across = -np.einsum("nk,nk->n", o, d)
    half = case.radius**2 - np.einsum("nk,nk->n", o, o) + across**2
    half = np.sqrt(np.maximum(half, 0)) * (1 - 1e-6)
    start = np.maximum(across - half, 0)
    # Hits may be early by the tolerance, and are compared with a little less.
    end = np.where(hit, hits.t - 3e-5 * case.radius, across + half)
    rows = np.flatnonzero(end > start)
    share = np.linspace(0, 1, samples)
    for some in np.array_split(rows, max(1, len(rows) * samples // 2_000_000)):
        t = start[some, None] + (end - start)[some, None] * share
        p = o[some, None] + t[..., None] * d[some, None]
        sign = case.product(p[..., 0] + 1j * p[..., 1], p[..., 2])
        passed = (sign[:, 1:] * sign[:, :-1] < 0).any(axis=1)
        assert not passed.any(), (o[some][passed][:3], d[some][passed][:3], passed.sum())
    return int(hit.sum())


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", QUICK)
def test_no_sheet_is_passed_on_the_way_to_a_hit(name: str, precision: str) -> None:
    case = CASES[name]
    assert check_first_hits(case, *rays(200, case.radius), precision, 2000) > 60
    check_first_hits(case, *hostile_rays(200, case), precision, 2000)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", CASES)
def test_no_sheet_is_passed_by_thousands_of_rays(name: str, precision: str) -> None:
    case = CASES[name]
    assert check_first_hits(case, *rays(1000, case.radius), precision, 4000) > 200
    check_first_hits(case, *hostile_rays(400, case), precision, 4000)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", QUICK)
def test_promises_and_looks_hold(name: str) -> None:
    check_field(CASES[name].field, rng=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_promises_and_looks_of_all_hold(name: str) -> None:
    check_field(CASES[name].field, rng=4, count=600)


def test_a_bound_that_is_too_small_is_found() -> None:
    wrong = hk.fields.RiemannSurface(
        root, singular_points=[0], second_bound=lambda z, r: 0.05 * (abs(z) - r) ** -1.5
    )
    with pytest.raises(BrokenPromiseError):
        check_field(wrong)


def test_a_singular_point_left_out_is_found() -> None:
    wrong = hk.fields.RiemannSurface(
        root, singular_points=[5], second_bound=lambda z, r: 0.25 * abs(z) ** -1.5
    )
    with pytest.raises(BrokenPromiseError):
        check_field(wrong)


def test_a_branch_point_whose_constant_is_too_small_is_found() -> None:
    """Random rays hardly come near: 1.4 of the square root of 2 passed."""
    point = hk.fields.BranchPoint(0, 0.5, 0.99)
    wrong = hk.fields.RiemannSurface(
        root, singular_points=[point], second_bound=lambda z, r: 0.25 * (abs(z) - r) ** -1.5
    )
    with pytest.raises(BrokenPromiseError, match=r"constant must be at least (1|0.9999)"):
        check_field(wrong, count=20)


def test_a_branch_that_is_no_number_near_a_branch_point_is_found() -> None:
    """Only the other branch was compared there."""

    def with_nan(z: Any) -> Any:
        (w, slope), other = root(z)
        return [(w * dr.select(abs(z) > 1e-3, 1 + 0 * abs(z), dr.nan), slope), other]

    point = hk.fields.BranchPoint(0, 0.5, 1.0)
    wrong = hk.fields.RiemannSurface(
        with_nan, singular_points=[point], second_bound=lambda z, r: 0.25 * (abs(z) - r) ** -1.5
    )
    with pytest.raises(BrokenPromiseError, match="a branch is farther from the value"):
        check_branch_points(wrong, 1.0, np.random.default_rng(0))


@pytest.mark.parametrize("factor", [1.0, 1.001])
@pytest.mark.parametrize("rises", [False, True])
def test_sheets_that_bend_as_far_as_they_may_are_met(rises: bool, factor: float) -> None:
    """Two sheets on the parabolas of their bounds: the step ends where the first of them meets the
    level, and one that is 1.001 times as long passes it."""
    real, rng = choose_backend("double").Float, np.random.default_rng(3)
    n = 2000
    near = 10 ** rng.uniform(-4, 0, n)
    far = near + 10 ** rng.uniform(-4, 0, n)
    bend = 10 ** rng.uniform(-1, 2, n)
    slopes = rng.normal(size=(2, n))
    gap = rng.uniform(0.1, 2, n) * near

    sheets = [
        BranchSample(SlopeRange(real(slope), real(slope)), real(beyond))
        for slope, beyond in zip(slopes, (0 * near, far - near), strict=True)
    ]
    nearest = NearestBranchEnclosure(
        tuple(sheets), sheets[0], real(near), real(near) > 0, real(bend), real(1e9)
    )
    none = real(np.full(n, np.inf))
    gaps = LevelGaps(none, real(gap)) if rises else LevelGaps(real(gap), none)
    s = factor * to_numpy(nearest.free_length(gaps))
    # Towards zero sheets fall as fast as they may; away from it the nearest rises so, or falls.
    sign = 1 if rises else -1
    first, second = (
        h + slope * s + sign * bend * s * s / 2
        for h, slope in zip((near, far), slopes, strict=True)
    )
    if rises:
        below = near + slopes[0] * s - bend * s * s / 2
        passed = (first > near + gap) | (below < -near - gap)
    else:
        # To the level near - gap, which may lie behind zero.
        passed = np.minimum(first, second) < near - gap
    assert np.isfinite(s).all()
    assert passed.all() if factor > 1 else not passed.any()


@pytest.mark.parametrize("factor", [1.0, 1.001])
def test_branches_that_turn_as_far_as_they_may_are_met(factor: float) -> None:
    """Along a line beside a branch point, with branches as far from their value there as they may
    be: the step ends where the nearest meets the level."""
    real, rng = choose_backend("double").Float, np.random.default_rng(4)
    n = 2000
    height, fall, constant = 10 ** rng.uniform(-3, 2, (3, n))
    power = rng.choice([0.25, 1 / 3, 0.5, 2 / 3], n)
    distance = height * rng.uniform(0.2, 1, n)
    gap = distance * rng.uniform(0.1, 1, n)
    room = height - (distance - gap)
    across = (0.5 * room / constant) ** (1 / power) * (1 - 2e-5)
    zero, none = real(0 * across), real(np.full(n, np.inf))
    cusp = BranchPointEnclosure(
        real(height), real(fall), zero, real(across), zero, real(power), real(constant),
        none, real(distance), zero == 0,
    )  # fmt: skip
    s = factor * to_numpy(cusp.free_length(LevelGaps(real(gap), none)))
    left = height - fall * s - constant * across**power
    passed = left < distance - gap
    assert (s > 0).all()
    assert passed.all() if factor > 1 else not passed.any()


@pytest.mark.parametrize(("name", "most"), [("log", 5.7), ("sqrt", 5.0)])
def test_few_evaluations_are_needed(name: str, most: float) -> None:
    case = CASES[name]
    hits = hk.trace(case.field, *rays(3000, case.radius), tolerance=1e-4, precision="single")
    assert hits.evaluations.mean() <= most
    assert hits.evaluations[hits.status == hk.RayStatus.HIT].mean() <= most


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", ["sqrt", "cbrt", "2/3", "real asin"])
def test_hits_beside_branch_points_are_near_the_surface(name: str, precision: Any) -> None:
    """Within four tolerances of a hit there are points on both sides of the surface."""
    case = CASES[name]
    o, d = hostile_rays(400, case, seed=7)
    hits = hk.trace(case.field, o, d, tolerance=1e-4, precision=precision)
    x = hits.position[hits.status == hk.RayStatus.HIT].astype(float)
    rng = np.random.default_rng(0)
    shifts = unit(rng.normal(size=(600, 3))) * rng.random((600, 1)) * 4e-4
    p = x[:, None] + shifts
    sign = np.sign(case.product(p[..., 0] + 1j * p[..., 1], p[..., 2]))
    both = (sign > 0).any(axis=1) & (sign < 0).any(axis=1)
    assert both.all(), x[~both][:5]


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", ["sqrt", "real asin", "-1/2"])
def test_crossings_of_all_sheets_are_counted(name: str, precision: Any) -> None:
    case = CASES[name]
    o, d = rays(300, case.radius, seed=5)
    hits = hk.crossings(case.field, o, d, precision=precision, max_crossings=12)
    across = -np.einsum("nk,nk->n", o, d)
    half = np.sqrt(case.radius**2 - np.einsum("nk,nk->n", o, o) + across**2)
    t = across[:, None] + half[:, None] * np.linspace(-1, 1, 8000)
    p = o[:, None] + t[..., None] * d[:, None]
    sign = case.product(p[..., 0] + 1j * p[..., 1], p[..., 2])
    crossings = (sign[:, 1:] * sign[:, :-1] < 0).sum(axis=1)
    # Two crossings closer than the tolerance are a graze.
    assert (hits.count != crossings).sum() <= 2
    assert hits.count.sum() > 200


def test_rays_along_and_through_the_axis_end() -> None:
    o = [[0, 0, 3], [0, 0, 0.9], [0, 0, 0], [3, 0, 0], [-1, -1, -1]]
    d = [[0, 0, -1], [1, 0, 0], [1, 0, 0], [-1, 0, 0], [1, 1, 1]]
    for precision in ("single", "double"):
        hits = hk.trace(CASES["sqrt"].field, o, d, precision=precision)
        # The axis meets the surface at 0 alone, and to a tolerance of 1e-4 up to twice its root.
        assert abs(hits.t[0] - 3) < 0.02
        assert hits.status[1] == hk.RayStatus.MISS  # |h| <= |z|^(1/2) is less than 0.9 on its way
        assert hits.t[2] == 0
        assert hits.t[3] == pytest.approx(2, abs=1e-4)
        assert hits.t[4] == pytest.approx(math.sqrt(3), abs=1e-3)
        log = hk.trace(CASES["log"].field, [[0, 0, 1], [1, 0, -3]], [[1, 0, 0], [0, 0, 1]],
                       precision=precision)  # fmt: skip
        assert log.t[0] == 0  # every height of the axis is near the surface
        assert log.t[1] == pytest.approx(3, abs=1e-3)


@pytest.mark.parametrize("enclosures", ["curvature", "slope", "lipschitz"])
def test_other_enclosures_find_the_same_hits(enclosures: str) -> None:
    case = CASES["sqrt"]
    o, d = rays(150, 1.0, seed=9)
    ours = hk.trace(case.field, o, d)
    theirs = hk.trace(case.field, o, d, enclosures=enclosures, max_steps=20_000)
    # What a ray does near the rim of the ball or an edge of a sheet may differ by the tolerance.
    same = (ours.status == theirs.status) & np.isclose(ours.t, theirs.t, atol=5e-3)
    assert same.mean() > 0.97
    assert theirs.evaluations.mean() > ours.evaluations.mean()


@pytest.mark.few(5)
@pytest.mark.parametrize(
    ("branches", "sharpest"),
    [
        (make_branches("log"), 1.0),
        (make_branches("sqrt"), 1.0),
        (make_branches("power", exponent=2.5), 1.0),
        (make_branches({0: -1}), 1.0),
        (make_branches("asin"), 0.5),
        (make_branches({0: 0.5, 1: -0.5, 1j: 2}), 0.2),
    ],
)
def test_second_derivatives_on_stretches_and_disks(branches: Branches, sharpest: float) -> None:
    """No point of a stretch or of a disk exceeds the bound, and for one factor one attains it."""
    backend = choose_backend("double")
    evaluator = branches.on_backend(backend)
    rng = np.random.default_rng(2)
    n = 300
    z, w = rng.normal(size=(2, n, 2)) @ [1, 1j]
    z, w = 1.5 * z, w / abs(w)
    length = rng.uniform(0, 2, n)
    complex_number = complex_type(backend)

    def upload(values: np.ndarray) -> Any:
        parts = (np.ascontiguousarray(one) for one in (values.real, values.imag))
        return complex_number(*(backend.Float(one) for one in parts))

    def second(points: np.ndarray) -> np.ndarray:
        branches = evaluator.evaluate(upload(points.ravel()))
        return np.max([to_numpy(abs(branch.second)) for branch in branches], axis=0).reshape(
            points.shape
        )

    start, way, ahead = upload(z), upload(w), backend.Float(length)
    bound = to_numpy(
        evaluator.second_derivative_bound(PlaneSegment(start, way, ahead, backend.Float(0)))
    )
    there = second(z[:, None] + w[:, None] * length[:, None] * np.linspace(0, 1, 2001)).max(axis=1)
    assert (there <= bound).all()
    assert np.max(there / bound) > sharpest * (1 - 1e-3)
    clear = to_numpy(evaluator.clearance(start))
    radius = rng.uniform(0, 0.95, n) * clear
    disk = Disk(start, backend.Float(radius), backend.Float(0))
    circle = z[:, None] + radius[:, None] * np.exp(1j * np.linspace(0, 2 * math.pi, 1000))
    assert (second(circle).max(axis=1) <= to_numpy(evaluator.second_derivative_bound(disk))).all()


def test_values_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    p = rng.uniform(-1, 1, (500, 3))
    z, h = p[:, 0] + 1j * p[:, 1], p[:, 2]
    log = CASES["log"].field.value(p, precision="double") - (h - np.angle(z))
    np.testing.assert_allclose(np.abs(np.exp(1j * log) - 1), 0, atol=1e-12)
    u = np.sqrt(z).imag
    both = np.minimum(abs(h - u), abs(h + u)) * np.sign(h * h - u * u)
    np.testing.assert_allclose(CASES["sqrt"].field.value(p, precision="double"), both, atol=1e-12)
    u = np.arcsin(z).real
    turns = 2 * math.pi * np.arange(-2, 3)[:, None]
    least = np.min([abs(h - u - turns), abs(h - math.pi + u - turns)], axis=(0, 1))
    both = least * np.sign(np.sin(u) - np.sin(h))
    np.testing.assert_allclose(
        CASES["real asin"].field.value(p, precision="double"), both, atol=1e-12
    )


def test_extents_are_the_heights_that_there_are() -> None:
    field = hk.fields.RiemannSurface("sqrt", domain=hk.Box((-1, -1, -9), (1, 1, 9)))
    volume = field.extent((0.0,))
    assert volume is not None
    assert volume.bounds()[1][2] == pytest.approx(2**0.25, rel=1e-4)
    miss = hk.trace(field, [[-3, 0, 3.0]], [[1, 0, 0]])
    assert miss.evaluations[0] == 0
    pole = hk.fields.RiemannSurface({0: -1}, domain=hk.Box((-1, -1, -9), (1, 1, 9)))
    assert pole.extent((0.0,)) is pole.domain


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        (("logg",), {}, "did you mean"),
        (("power",), {}, "needs its exponent"),
        (("power",), {"exponent": math.pi}, "is no fraction"),
        (("power",), {"exponent": "x"}, "must be a rational number"),
        (("sqrt",), {"exponent": 2}, "exponent cannot be given"),
        (("asin",), {"argument": {0: 1}}, "argument cannot be given"),
        (("log",), {"argument": {0: 0.5}}, "whole numbers"),
        (("log",), {"argument": {}}, "at least one zero"),
        (("log", "both"), {}, 'must be "imag" or "real"'),
        (({0: Fraction(1, 23), 1: Fraction(1, 7)},), {}, "161 sheets"),
        (({},), {}, "at least one exponent"),
        (({0: 99},), {}, "at most 6"),
        ((3,), {}, "function must be one of"),
        (("log",), {"height": 0.0}, "other than 0"),
        ((root,), {}, "needs singular_points="),
        ((root,), {"singular_points": [0], "second_bound": 3}, "second_bound must be a function"),
        ((root,), {"singular_points": 0, "second_bound": abs}, "singular_points must be"),
        ((lambda z: z,), {"singular_points": [], "second_bound": abs}, "must return its branches"),
        (
            (lambda z: [(z,)],),
            {"singular_points": [], "second_bound": abs},
            "must return its branches",
        ),
        (
            (root,),
            {"singular_points": [0], "second_bound": abs, "period": 1.0},
            "must have one branch",
        ),
    ],
)
def test_errors_say_what_is_wrong(arguments: Any, settings: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        hk.fields.RiemannSurface(*arguments, **settings)


def test_levels_of_the_logarithm_are_the_surface_moved_up() -> None:
    hits = hk.trace(hk.fields.RiemannSurface("log"), [[1, 0, 3.0]], [[0, 0, -1]], level=0.5)
    assert hits.t[0] == pytest.approx(2.5, abs=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
def test_walls_about_all_sheets_are_met_first(precision: Any) -> None:
    """Levels +-0.05 of the cube root: the nearest sheet is so far below or above."""
    field = hk.fields.RiemannSurface("cbrt")
    o, d = rays(300, 1.0, seed=8)
    hits = hk.trace(field, o, d, level=(-0.05, 0.05), precision=precision)
    hit = hits.status == hk.RayStatus.HIT
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    across = -np.einsum("nk,nk->n", o, d)
    half = np.sqrt(1 - np.einsum("nk,nk->n", o, o) + across**2) * (1 - 1e-6)
    end = np.where(hit, hits.t - 3e-5, across + half)
    share = np.linspace(0, 1, 3000)
    t = (across - half)[:, None] * (1 - share) + end[:, None] * share
    p = o[:, None] + t[..., None] * d[:, None]
    g = (p[..., 0] + 1j * p[..., 1]) ** (1 / 3)
    sheets = [(g * np.exp(2j * math.pi * k / 3)).imag for k in range(3)]
    beyond = np.min([abs(p[..., 2] - u) for u in sheets], axis=0) - 0.05
    passed = (beyond[:, 1:] * beyond[:, :-1] < 0).any(axis=1) & (end > across - half)
    assert not passed.any()
    assert hit.sum() > 150


def test_other_heights_and_places_compile_no_kernel() -> None:
    def trace(k: int) -> int:
        exponents = {0.1 * k: 0.5, 1 + 0.1j * k: Fraction(1, 3)}
        field = hk.fields.RiemannSurface(
            exponents, height=1 + 0.1 * k, domain=hk.Ball(radius=2 + 0.1 * k)
        )
        return compiled(lambda: hk.trace(field, *rays(300, 1.0, seed=k)), size=300)

    trace(0), trace(1)
    assert [trace(k) for k in range(2, 5)] == [0] * 3


def test_own_branches_without_second_derivatives_say_so() -> None:
    with pytest.raises(NotImplementedError, match="g''"):
        OWN.hessian(np.array([[0.3, 0.2, 0.1]]))


@pytest.mark.parametrize("name", ["sqrt", "real asin"])
def test_rays_past_branch_points_take_no_small_steps(name: str) -> None:
    """Down to no distance at all: without `BranchPointEnclosure` such rays end out of steps in
    single precision."""
    o, d = hostile_rays(1000, CASES[name], seed=3)
    hits = hk.trace(CASES[name].field, o, d, tolerance=1e-4, precision="single")
    assert hits.evaluations.max() <= 40


@pytest.mark.slow
def test_hits_carry_derivatives() -> None:
    backend = choose_backend("double")
    place = np.array([0.3, 0.4, 2.0])
    o = backend.Array3f(*place.tolist())
    dr.enable_grad(o)
    field = hk.fields.RiemannSurface("sqrt")
    dr.backward(hk.trace(field, o, backend.Array3f(0.05, 0, -1)).t)
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        ends = [
            hk.trace(field, [start], [[0.05, 0, -1]], precision="double", tolerance=1e-12).t[0]
            for start in (place + step, place - step)
        ]
        assert to_numpy(o.grad)[0, k] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5)
