"""Lobes of spherical harmonics: what they promise, and first hits against an oracle of SciPy's."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.special import sph_harm_y

import harnack as hk
from harnack.fields.analytic.lobes import _LobesEvaluator
from harnack.testing import BrokenPromiseError, check_field
from tests.oracles.oracle import OracleValues, first_crossings

SMALL = {
    "both": hk.fields.Lobes(2, 0),
    "positive": hk.fields.Lobes(3, -2, sign="positive", scale=2.5),
    "sum": hk.fields.Lobes.combined({(0, 0): 0.3, (2, 0): 1.0, (3, 3): -0.4}),
}
MORE = {
    "p": hk.fields.Lobes(1, 0, sign="negative"),
    "constant": hk.fields.Lobes(0, 0, scale=1e-3),
    "steep": hk.fields.Lobes(12, 5),
    "sum, negative": hk.fields.Lobes.combined(
        {(5, 1): 1.0, (4, 0): 0.7}, sign="negative", scale=1e4
    ),
}


def harmonic(degree, m, u):
    """Y_lm at unit vectors (n, 3), made of SciPy's complex ones."""
    polar, azimuth = np.arccos(np.clip(u[:, 2], -1, 1)), np.arctan2(u[:, 1], u[:, 0])
    whole = sph_harm_y(degree, abs(m), polar, azimuth) * (-1.0) ** m
    part = whole.real if m >= 0 else whole.imag
    return part if m == 0 else math.sqrt(2) * part


def radius_less_length(field, x):
    """(n,) r - s |Y| or r - s (+-Y) at points (n, 3): negative in the lobes."""
    r = np.linalg.norm(x, axis=1)
    u = x / np.maximum(r, 1e-300)[:, None]
    y = sum(c * harmonic(*key, u) for key, c in field.weights.items())
    return r - field.scale * {"both": abs(y), "positive": y, "negative": -y}[field.part]


def lobe(field, x):
    """(n,) 0 outside of all lobes, else the sign of Y: between two lobes lies the surface, however
    thin what is outside of them is."""
    r = np.linalg.norm(x, axis=1)
    u = x / np.maximum(r, 1e-300)[:, None]
    y = sum(c * harmonic(*key, u) for key, c in field.weights.items())
    return np.where(radius_less_length(field, x) < 0, np.sign(y), 0)


def oracle(field):
    """Values, gradients by differences, and lengths over which they are smooth."""

    def at(x):
        r = np.linalg.norm(x, axis=1)
        h = 1e-5 * np.maximum(r, 1e-9)[:, None]
        slopes = [
            radius_less_length(field, x + h * e) - radius_less_length(field, x - h * e)
            for e in np.eye(3)
        ]
        gradient = np.stack(slopes, axis=1) / (2 * h)
        return OracleValues(radius_less_length(field, x), gradient, r / max(field.degree, 1))

    return at


def rays(field, n, seed):
    """Rays (n, 3) from outside and inside; some close past the origin, some through it."""
    rng, size = np.random.default_rng(seed), field.extent_radius()

    def directions():
        v = rng.normal(size=(n, 3))
        return v / np.linalg.norm(v, axis=1)[:, None]

    o = size * rng.uniform(0.05, 2.5, (n, 1)) * directions()
    target = size * rng.uniform(0, 1, (n, 1)) * directions()
    target[: n // 4] *= 10 ** rng.uniform(-6, -1, (n // 4, 1))
    target[: n // 40] = 0
    d = target - o
    return o, d / np.linalg.norm(d, axis=1)[:, None]


def compare(field, n, seed, precision, tolerance):
    """Traces rays; fails where a crossing was passed, or where a hit is not at the surface."""
    o, d = rays(field, n, seed)
    size = field.extent_radius()
    if precision == "single":
        o, d = (x.astype(np.float32).astype(np.float64) for x in (o, d))
        d /= np.linalg.norm(d, axis=1)[:, None]
    tol = tolerance * size
    hits = hk.trace(field, o, d, t_max=4 * size, tolerance=tol, precision=precision)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    truth = first_crossings(
        oracle(field), o, d, 0.0, 4 * size, levels=[0.0], depth=tol, finest=0.5 * tol
    )
    # A crossing in a cusp between lobes is within the tolerance of the origin or counts.
    passed = hits.t > truth.beyond + 4 * tol
    at = o + truth.before[:, None] * d
    passed &= ~(np.linalg.norm(at, axis=1) < 4 * tol)
    assert not passed.any(), np.flatnonzero(passed)[:5]
    x = (o + hits.t[:, None] * d)[hits.is_hit]
    around = np.random.default_rng(1).normal(size=(len(x), 96, 3))
    reach = tol + hits.uncertainty[hits.is_hit]
    around *= 3 * reach[:, None, None] / np.linalg.norm(around, axis=2)[..., None]
    states = lobe(field, (x[:, None] + around).reshape(-1, 3)).reshape(len(x), -1)
    near = (states != states[:, :1]).any(axis=1) | (np.linalg.norm(x, axis=1) < 4 * reach)
    assert near.all(), x[~near][:3]
    assert len(x) > 0.2 * n
    return hits


@pytest.mark.few(2)
@pytest.mark.parametrize("name", SMALL)
def test_lobes_keep_their_promises(name):
    check_field(SMALL[name], count=60, directions=4)


@pytest.mark.slow
@pytest.mark.parametrize("name", MORE)
def test_all_lobes_keep_their_promises(name):
    check_field(MORE[name])
    near = np.random.default_rng(1).normal(size=(100, 3)) * 1e-4 * MORE[name].scale
    check_field(MORE[name], near)


def test_a_bound_that_is_too_small_is_noticed():
    class TooSmall(_LobesEvaluator):
        def _second_derivatives(self, farthest):
            least, most = super()._second_derivatives(farthest)
            return 0.2 * least, 0.2 * most

    class Wrong(hk.fields.Lobes):
        def evaluator(self, *given):
            return TooSmall(**vars(super().evaluator(*given)))

    with pytest.raises(BrokenPromiseError):
        check_field(Wrong(1, 0), count=100)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_first_hits_of_lobes(precision):
    hits = compare(hk.fields.Lobes(3, 2), 400, 0, precision, 1e-4)
    assert hits.evaluations.mean() < 14


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", [*SMALL, *MORE])
def test_first_hits_of_many_lobes(name, precision):
    field = {**SMALL, **MORE}[name]
    compare(field, 1000, 7, precision, 1e-4)
    compare(field, 500, 8, precision, 1e-5 if precision == "single" else 1e-6)


def test_the_values_are_those_of_spherical_harmonics():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200, 3))
    for field in SMALL.values():
        value = field.value(x, precision="double")
        inside = radius_less_length(field, x)
        np.testing.assert_array_equal(value < 0, inside < 0)
    positive, negative = hk.fields.Lobes(3, 1).positive, hk.fields.Lobes(3, 1).negative
    both = np.minimum(radius_less_length(positive, x), radius_less_length(negative, x))
    np.testing.assert_array_equal(hk.fields.Lobes(3, 1).value(x, precision="double") < 0, both < 0)


def test_rays_down_the_axis_end_at_the_origin():
    """From below, where Y_10 is negative, the positive lobe begins at the origin."""
    hits = hk.trace(hk.fields.Lobes(1, 0).positive, [[0, 0, -2]], [[0, 0, 1]], tolerance=1e-5)
    assert hits.is_hit.all()
    assert abs(hits.t[0] - 2) < 1e-4


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: hk.fields.Lobes(13, 0), "degree"),
        (lambda: hk.fields.Lobes(2, 3), "order"),
        (lambda: hk.fields.Lobes(2, 1, scale=0.0), "scale"),
        (lambda: hk.fields.Lobes(2, 1, sign="left"), "part must be"),
        (lambda: hk.fields.Lobes(0, 0).negative, "no direction"),
        (lambda: hk.fields.Lobes.combined({}), "coefficient"),
    ],
)
def test_what_makes_no_lobes_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize("precision", ["single", "double"])
def test_scales_that_a_precision_has_no_room_for_are_refused(precision: str) -> None:
    """Found by an attack: at 1e-24 the first hit was missed in single precision."""
    o, d = [[0, 0, 1.0]], [[0, 0, -1.0]]
    for lobes in (hk.fields.Lobes(2, 0, scale=1e-70), hk.fields.Lobes.combined({(2, 0): 1e70})):
        with pytest.raises(ValueError, match=r"another unit of length|units nearer to 1"):
            hk.trace(lobes, o, d, precision=precision)
    small = hk.fields.Lobes(2, 0, scale=1e-5)
    reach = small.extent_radius()
    hits = hk.trace(small, [[0, 0, 3 * reach]], d, tolerance=1e-4 * reach, precision=precision)
    assert hits.t[0] == pytest.approx(2 * reach, rel=1e-3)


def test_second_derivatives_at_the_origin_are_numbers() -> None:
    for lobes in (hk.fields.Lobes(2, 1), hk.fields.Lobes(2, 1).positive):
        assert np.isfinite(lobes.hessian([[0, 0, 0]])).all()


@pytest.mark.parametrize("scale", ["2", None, 1j, True])
def test_scales_are_numbers(scale: Any) -> None:
    with pytest.raises(TypeError, match="scale of lobes must be a number"):
        hk.fields.Lobes(2, 0, scale=scale)


@pytest.mark.parametrize("key", [2, "20", (2.5, 0), (True, 0), (1, 2, 3)])
def test_harmonics_are_named_by_two_whole_numbers(key: Any) -> None:
    with pytest.raises(TypeError, match="two whole numbers"):
        hk.fields.Lobes.combined({key: 1.0})
