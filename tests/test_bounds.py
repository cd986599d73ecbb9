"""Bounds: never too long, as long as their proofs allow, and covers agrees with step."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

from harnack.backend import choose_backend, to_numpy
from harnack.bounds import (
    Bound,
    Caps,
    Classic,
    CurvatureStep,
    LipschitzStep,
    Longest,
    Slope,
    choose_bound,
)
from harnack.certify import (
    BallCertificate,
    Certificate,
    CurvatureCertificate,
    Levels,
    LipschitzCertificate,
    certify,
)
from harnack.certify.ball import from_ball
from harnack.fields import HarmonicBall, Lipschitz, Sample
from harnack.testing import BrokenPromiseError, Scaled, check_bound
from harnack.testing.poisson import cap_mass, cap_movement, cap_slope, kernel_movement
from tests.oracles.exact import exact_step, on_host

BOUNDS = (Classic(), Slope(), Caps(), LipschitzStep(), CurvatureStep())
# Solved to the end: the default number of rounds trades a little length for time.
PATIENT = (Classic(), Slope(rounds=14), Caps(rounds=14), LipschitzStep(), CurvatureStep())


def name_of(bound: Bound) -> str:
    return type(bound).__name__


def random_balls(
    rng: np.random.Generator, n: int, sides: str, rows: int, least: float = -9.0
) -> tuple[BallCertificate, np.ndarray]:
    """Certificates and slopes of all sizes, as float64 arrays; `sides` is below, above or both.

    Gaps reach from 1e-9 to 1e3 of the rooms; means from the middle to within 1e-9 of the ends.
    """

    def powers(low: float, high: float) -> np.ndarray:
        return 10 ** rng.uniform(low, high, rows)

    radius, span = powers(-3, 3), powers(-3, 3)
    p = np.where(rng.random(rows) < 0.5, rng.uniform(0.01, 0.99, rows), powers(least, 0))
    p = np.clip(np.where(rng.random(rows) < 0.5, p, 1 - p), 10**least, 1 - 10**least)
    sign = rng.choice([-1.0, 1.0], rows)
    means = [rng.uniform(-1, 1, rows), sign, sign * powers(-9, 0), sign * (1 - powers(-9, 0))]
    mean = np.choose(rng.integers(0, 4, rows), means)
    below, above = span * p, span * (1 - p)
    limit = span * p * (1 - p) if sides == "both" else below
    if sides != "both":
        above = below
    down, up = below * powers(-9, 3), above * powers(-9, 3)
    lonely = rng.random(rows)
    down = np.where(lonely < 0.2, np.inf, down)
    up = np.where(lonely > 0.8, np.inf, up)
    ball = BallCertificate(
        radius,
        None if sides == "above" else below,
        None if sides == "below" else above,
        down,
        up,
        n,
    )
    return ball, mean * n * limit / radius


def random_certificates(
    bound: Bound, rng: np.random.Generator, rows: int, least: float = -9.0
) -> list[tuple[Certificate, np.ndarray]]:
    """Every kind that the bound accepts, with slopes."""
    cases: list[tuple[Certificate, np.ndarray]] = []
    for n in (2, 3, 4):
        cases += [random_balls(rng, n, sides, rows, least) for sides in ("below", "above", "both")]
    radius, constant, down, up = 10 ** rng.uniform(-3, 3, (4, rows))
    slope = constant * radius * rng.choice([-1.0, 1.0], rows) * 10 ** rng.uniform(-6, 2, rows)
    cases.append((LipschitzCertificate(constant, radius, down, up), slope))
    cases.append((CurvatureCertificate(constant, radius, down, up), slope))
    return [case for case in cases if bound.accepts(case[0])]


def ratios(
    bound: Bound, certificate: Certificate, slope: np.ndarray, precision: str = "double"
) -> np.ndarray:
    """step/exact of each row; the exact step from the numbers as rounded to the precision."""
    backend = choose_backend(precision)  # type: ignore[arg-type]
    fields = {
        key: backend.Float(value) if isinstance(value, np.ndarray) else value
        for key, value in vars(certificate).items()
    }
    on_device, s = type(certificate)(**fields), backend.Float(slope)
    inner = bound.bound if isinstance(bound, Scaled) else bound
    exact = exact_step(inner, on_host(on_device, len(slope)), to_numpy(s).astype(np.float64))
    step = to_numpy(bound.step(on_device, s)).astype(np.float64)
    return np.where(exact > 0, step / np.where(exact > 0, exact, 1), np.where(step > 0, 2.0, 1.0))


def check_equality(bound: Bound) -> None:
    """The extremal functions attain the bound."""
    inner = bound.bound if isinstance(bound, Scaled) else bound
    rng = np.random.default_rng(7)
    # A share of 1e-9 costs digits of the reference, so caps are compared down to 1e-4.
    for certificate, slope in random_certificates(inner, rng, 1000, least=-4.0):
        ratio = ratios(bound, certificate, slope)
        # With n = 4, 16 units in the last place of the slope are 1e-5 of a step to the sphere.
        tolerance = 1.7e-5 if getattr(certificate, "dimension", 3) == 4 else 1.01e-5
        assert ratio.max() <= 1, (certificate, slope, ratio.argmax())
        assert ratio.min() >= 1 - tolerance, (certificate, slope, ratio.argmin())


@pytest.mark.parametrize("n", [2, 3, 4])
def test_reference_formulas_agree_with_quadrature(n: int) -> None:
    rng = np.random.default_rng(n)
    nodes, weights = np.polynomial.legendre.leggauss(300)
    for b, q in zip(rng.uniform(0, 2, 60), rng.uniform(-0.9, 0.9, 60), strict=True):
        edge = 2 * math.asin(math.sqrt(b / 2))
        angle, w = edge / 2 * (nodes + 1), edge / 2 * weights
        density = {2: 1 / np.pi, 3: np.sin(angle) / 2, 4: 2 / np.pi * np.sin(angle) ** 2}[n]
        poisson = (1 - q * q) / (1 + q * q - 2 * q * np.cos(angle)) ** (n / 2)
        assert cap_mass(b, n) == pytest.approx((w * density).sum(), abs=1e-12)
        assert cap_slope(b, n) == pytest.approx((w * density * n * np.cos(angle)).sum(), abs=1e-12)
        moved = (w * density * (poisson - 1)).sum()
        assert cap_movement(q, b, n) == pytest.approx(moved, abs=1e-11)
        if q > 0:
            s = 1 - b
            plain = (1 - q * q) / (1 + q * q - 2 * q * s) ** (n / 2) - 1
            assert kernel_movement(q, s, n) == pytest.approx(plain, abs=1e-11)


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("bound", BOUNDS, ids=name_of)
def test_no_function_meets_a_level_within_a_step(bound: Bound, precision: str) -> None:
    check_bound(bound, precision=precision)  # type: ignore[arg-type]


@pytest.mark.parametrize("bound", PATIENT, ids=name_of)
def test_extremal_functions_attain_the_bound(bound: Bound) -> None:
    check_equality(bound)


@pytest.mark.parametrize("bound", BOUNDS, ids=name_of)
def test_few_rounds_lose_little(bound: Bound) -> None:
    rng = np.random.default_rng(8)
    for certificate, slope in random_certificates(bound, rng, 1000, least=-4.0):
        ratio = ratios(bound, certificate, slope)
        assert ratio.max() <= 1
        assert ratio.min() > 0.9
        assert np.quantile(ratio, 0.2) >= 1 - 1.01e-5


@pytest.mark.parametrize("bound", BOUNDS, ids=name_of)
def test_single_precision_is_never_longer_than_exact(bound: Bound) -> None:
    rng = np.random.default_rng(9)
    for certificate, slope in random_certificates(bound, rng, 4000):
        ratio = ratios(bound, certificate, slope, "single")
        assert ratio.max() <= 1, (certificate, slope, ratio.argmax())
        assert np.quantile(ratio, 0.5) > 1 - 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("bound", BOUNDS, ids=name_of)
def test_bounds_hold_in_many_trials(bound: Bound, precision: str) -> None:
    check_bound(bound, precision=precision, rng=1, rows=20_000)  # type: ignore[arg-type]
    rng = np.random.default_rng(2)
    for certificate, slope in random_certificates(bound, rng, 40_000):
        assert ratios(bound, certificate, slope, precision).max() <= 1


@pytest.mark.parametrize("bound", BOUNDS, ids=name_of)
def test_mutation_is_seen_by_check_bound(bound: Bound) -> None:
    with pytest.raises(BrokenPromiseError, match="meets no level within the step"):
        check_bound(Scaled(bound, 1.001))


@pytest.mark.parametrize("bound", PATIENT, ids=name_of)
@pytest.mark.parametrize("factor", [1.001, 0.999])
def test_mutation_is_seen_by_the_equality_cases(bound: Bound, factor: float) -> None:
    with pytest.raises(AssertionError):
        check_equality(Scaled(bound, factor))


def test_mutation_of_covers_alone_is_seen() -> None:
    @dataclasses.dataclass(frozen=True)
    class LooseCovers(Scaled):
        def step(self, certificate, slope):  # type: ignore[no-untyped-def]
            return self.bound.step(certificate, slope)

    for bound in BOUNDS:
        with pytest.raises(BrokenPromiseError, match="which is covered"):
            check_bound(LooseCovers(bound, 1.001), rows=2000)


@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.parametrize("sides", ["below", "both"])
def test_sharper_bounds_step_further(n: int, sides: str) -> None:
    certificate, slope = random_balls(np.random.default_rng(3), n, sides, 4000)
    steps = [
        exact_step(bound, certificate, slope)
        for bound in (Classic(), Slope(), Caps())
        if bound.accepts(certificate)
    ]
    assert len(steps) == (3 if (n, sides) == (3, "both") else 2)
    for plain, sharp in itertools.pairwise(steps):
        assert (sharp >= plain * (1 - 1e-5)).all()
        assert np.mean(sharp > 1.01 * plain) > 0.2


NUMBERS = ("bound", "n", "radius", "below", "above", "down", "up", "slope")

# Steps that were once too long in single precision: bound, dimension, then radius, rooms, gaps,
# slope. The first was 30,000 times too long, the next ones 50, 35 and 1.001 to 1.004 times.
TOO_LONG = [
    (Caps(), 3, 942.6076, 178.08643, 2.2322106e-06, 9137.556, 5.872868e-15, 6.2389e-17),
    (Caps(), 3, 27.06822, 4.520412e-06, 359.36676, 4.631279e-15, 0.009406633, 5.00992e-07),
    (Slope(), 3, 1.8636177, 544.62054, 1.4247069e-06, 55042.06, 2.068392e-15, 2.288335e-06),
    (Slope(), 2, 61.276134, 3.082086e-06, 415.04337, 4.0358596e-15, 0.0054619377, -1.0059662e-07),
    (Slope(), 3, 0.0045461752, 0.0006375729, None, 0.0023793974, 1.1893234e-12, 1.6341318e-08),
    (Slope(), 4, 185.57632, 0.031889975, None, 0.5379021, 5.5247563e-11, -0.0006873716),
    (Classic(), 4, 27.039043, 0.023019595, 1.04534436e-07, 2.7896934, 5.2109227, -1.4940459e-09),
    (Classic(), 4, 93.224815, 9.029508e-05, None, 0.0132376235, 0.08723341, 5.066823e-07),
]


@pytest.mark.parametrize(
    ("bound", "n", "radius", "below", "above", "down", "up", "slope"), TOO_LONG
)
def test_steps_that_were_once_too_long(
    bound: Bound,
    n: int,
    radius: float,
    below: float,
    above: float | None,
    down: float,
    up: float,
    slope: float,
) -> None:
    rooms = [None if room is None else np.array([room]) for room in (below, above)]
    ball = BallCertificate(np.array([radius]), *rooms, np.array([down]), np.array([up]), n)
    for precision in ("single", "double"):
        assert ratios(bound, ball, np.array([slope]), precision)[0] <= 1


# And some that were far too short, 1e-4 of what could be proved: the ray moves away from a level.
TOO_SHORT = [
    (Slope(), 3, 290.14287241, 0.0140877411, None, 1.38518878e-10, 0.1140721416, 0.000145663489),
    (Slope(), 4, 153.37622967, 3.58113495e-05, None, 8.6228912e-14, 0.00047076, 9.3394783e-07),
    (Slope(), 2, 0.1349517427, 0.5887654633, None, 6.1403174e-07, 2.2552248308, 7.1895992272),
    (Caps(), 3, 0.1, 1.0, 2.0, 1e-9, 1.0, 5.0),
]


@pytest.mark.parametrize(NUMBERS, TOO_SHORT)
def test_steps_away_from_a_level_are_long(
    bound: Bound,
    n: int,
    radius: float,
    below: float,
    above: float | None,
    down: float,
    up: float,
    slope: float,
) -> None:
    rooms = [None if room is None else np.array([room]) for room in (below, above)]
    ball = BallCertificate(np.array([radius]), *rooms, np.array([down]), np.array([up]), n)
    for precision in ("single", "double"):
        assert ratios(bound, ball, np.array([slope]), precision)[0] > 0.98


@pytest.mark.parametrize("precision", ["single", "double"])
def test_numbers_at_the_edge(precision: str) -> None:
    """No room, no level, no radius, no slope: a step is a number, and safe."""
    real = choose_backend(precision).Float  # type: ignore[arg-type]
    one, gap, inf, nan = real(1), real(0.1), real(math.inf), real(math.nan)
    for n in (2, 3, 4):
        for bound in (Classic(), Slope(), Caps()):

            def step(ball: BallCertificate, slope: float, bound: Bound = bound) -> float:
                length = bound.step(ball, real(slope))
                assert bool(to_numpy(bound.covers(ball, real(slope), 0.98 * length))[0])
                return float(to_numpy(length)[0])

            if bound.accepts(BallCertificate(one, one, one, gap, gap, n)):
                free = BallCertificate(one, one, one, inf, inf, n)
                assert step(free, 0.5) == pytest.approx(1, abs=1e-4)
                on_level = BallCertificate(one, one, one, real(0), inf, n)
                assert step(on_level, -0.5) == 0
                nothing = BallCertificate(real(0), one, one, gap, gap, n)
                assert step(nothing, 0.5) == 0
                worst = BallCertificate(one, one, one, gap, gap, n)
                assert 0 <= step(worst, math.nan) <= 0.1
                unknown = from_ball(HarmonicBall(one, nan, one, n), real(0.5), gap, gap)
                assert step(unknown, 0.5) == 0


@pytest.mark.parametrize("precision", ["single", "double"])
def test_what_is_not_a_number_proves_no_step(precision: str) -> None:
    real = choose_backend(precision).Float  # type: ignore[arg-type]
    one, gap, nan = real(1), real(0.1), real(math.nan)
    unknown = [
        (LipschitzStep(), LipschitzCertificate(nan, one, gap, gap)),
        (LipschitzStep(), LipschitzCertificate(one, nan, gap, gap)),
        (LipschitzStep(), LipschitzCertificate(one, one, nan, gap)),
        (LipschitzStep(), LipschitzCertificate(one, one, gap, nan)),
        (CurvatureStep(), CurvatureCertificate(nan, one, gap, gap)),
        (CurvatureStep(), CurvatureCertificate(one, nan, gap, gap)),
        (CurvatureStep(), CurvatureCertificate(one, one, nan, gap)),
        (CurvatureStep(), CurvatureCertificate(one, one, gap, nan)),
    ]
    for bound, certificate in unknown:
        length = to_numpy(bound.step(certificate, real(0.5)) * one)  # type: ignore[arg-type]
        assert not length[0] > 0, certificate
        covers = bound.covers(certificate, real(0.5), real(0.5))  # type: ignore[arg-type]
        assert not to_numpy(covers & (one > 0))[0], certificate
    slope = CurvatureStep().step(CurvatureCertificate(one, one, gap, gap), nan)
    assert not to_numpy(slope)[0] > 0
    constant = CurvatureStep().step(CurvatureCertificate(real(0), one, gap, gap), real(0))
    assert to_numpy(constant)[0] == pytest.approx(1, abs=1e-5)


def test_a_promise_without_room_does_not_prove_f_constant() -> None:
    """By rounding a value may lie on or beyond the end of its range."""
    for precision, ulp in (("single", 6e-8), ("double", 1.2e-16)):
        real = choose_backend(precision).Float  # type: ignore[arg-type]
        ball = HarmonicBall(real(1), real(0.999), real(1 + 1e-9), 3)
        sample = Sample(real(1 + 2e-9), choose_backend(precision).Array3f(0), (ball,))  # type: ignore[arg-type]
        (certificate,) = certify(sample, real(4 * ulp), real(4 * ulp))
        assert to_numpy(certificate.room_above)[0] >= 4 * ulp
        blurred = dataclasses.replace(sample, error=1e-3)
        (certificate,) = certify(blurred, real(0.1), real(0.1))
        assert to_numpy(certificate.room_above)[0] >= 1e-3


def test_covers_nothing_beyond_the_radius() -> None:
    real = choose_backend("double").Float
    inf = real(math.inf)
    certificates = [
        BallCertificate(real(2), real(1), real(1), inf, inf, 3),
        LipschitzCertificate(real(1), real(2), inf, inf),
        CurvatureCertificate(real(1), real(2), inf, inf),
    ]
    for bound in BOUNDS:
        for certificate in filter(bound.accepts, certificates):
            assert to_numpy(bound.covers(certificate, real(0.1), real(1.99)))[0]
            assert not to_numpy(bound.covers(certificate, real(0.1), real(2.01)))[0]


def test_longest_takes_the_longest_of_all_certificates() -> None:
    real = choose_backend("double").Float
    ball = BallCertificate(real(1), real(1), real(1), real(0.1), real(0.1), 3)
    line = LipschitzCertificate(real(1), real(10), real(0.1), real(0.1))
    slope = real(0.9)
    both = Longest((Caps(), Slope(), Classic(), LipschitzStep()))
    steps = [
        float(bound.step(c, slope)[0]) for bound, c in ((Caps(), ball), (LipschitzStep(), line))
    ]
    assert float(both.step((ball, line), slope)[0]) == max(steps)
    assert bool(both.covers((ball, line), slope, real(max(steps) * 0.999))[0])
    assert not bool(both.covers((ball, line), slope, real(max(steps) * 1.01))[0])
    chosen = both.pairs((ball, line))
    assert [type(bound) for bound, _ in chosen] == [Caps, LipschitzStep]


def test_a_sufficient_bound_leaves_the_others_out() -> None:
    real = choose_backend("double").Float
    ball = BallCertificate(real(1), real(1), real(1), real(0.1), real(0.1), 4)
    curved = CurvatureCertificate(real(1), real(10), real(0.1), real(0.1))
    pairs = choose_bound(None).pairs((ball, curved))
    assert [type(bound) for bound, _ in pairs] == [CurvatureStep]


def test_bounds_are_chosen_by_name() -> None:
    assert isinstance(choose_bound("classic").bounds[0], Classic)
    assert choose_bound(Caps()).bounds == (Caps(),)
    longest = Longest((Slope(),))
    assert choose_bound(longest) is longest
    with pytest.raises(ValueError, match=r"unknown bound 'harnak'; choose one of caps, classic"):
        choose_bound("harnak")
    real = choose_backend("double").Float
    line = LipschitzCertificate(real(1), real(10), real(0.1), real(0.1))
    with pytest.raises(ValueError, match=r"no bound applies.*LipschitzCertificate.*Caps"):
        Longest((Caps(),)).pairs((line,))


def test_check_bound_refuses_a_bound_that_accepts_nothing() -> None:
    class Nothing(Scaled):
        def accepts(self, certificate: Certificate) -> bool:
            del certificate
            return False

    with pytest.raises(ValueError, match="accepts none"):
        check_bound(Nothing(Classic(), 1.0))


@pytest.mark.parametrize("precision", ["single", "double"])
def test_gaps_to_the_levels_of_a_ladder(precision: str) -> None:
    real = choose_backend(precision).Float  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    f = rng.uniform(-30, 30, 2000)
    f[:6] = (0, 1.5, 1.5 + 4 * math.pi, 1.5 - 4 * math.pi, 4 * math.pi, -20)
    period, values = 4 * math.pi, (1.5, -3.0)
    ladder = np.sort(np.concatenate([np.arange(-5, 6) * period + value for value in values]))
    seen = real(f)
    f = to_numpy(seen).astype(np.float64)
    down, up = (to_numpy(x) for x in Levels(values, period).gaps(seen))
    below = np.array([x - ladder[ladder <= x].max() for x in f])
    above = np.array([ladder[ladder >= x].min() - x for x in f])
    tolerance = 1e-5 if precision == "single" else 1e-13

    def close(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.abs(a - b) <= tolerance

    # On a level, to rounding, either side may be the one that it is counted on.
    on_level = np.minimum(below, above) <= tolerance
    assert ((close(down, below) & close(up, above)) | on_level).all()
    assert (np.minimum(down, up)[on_level] <= tolerance).all()


def test_gaps_without_a_period() -> None:
    real = choose_backend("double").Float
    down, up = Levels((0.0, 2.0)).gaps(real([-1, 0, 0.5, 2, 3]))
    assert np.array_equal(to_numpy(down), [np.inf, 0, 0.5, 0, 1])
    assert np.array_equal(to_numpy(up), [1, 0, 1.5, 0, np.inf])


def test_lipschitz_knowledge_becomes_a_certificate() -> None:
    backend = choose_backend("double")
    real = backend.Float
    sample = Sample(real(0.3), backend.Array3f(1, 0, 0), (Lipschitz(real(2), real(5)),))
    (certificate,) = certify(sample, real(0.3), real(0.7))
    step = choose_bound("lipschitz").step((certificate,), real(1))
    assert to_numpy(step)[0] == pytest.approx(0.15, rel=1e-5)
