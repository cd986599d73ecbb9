"""The public `trace`: shapes, settings, statuses, and an error for each bad input."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.geometry import example_curves
from harnack.geometry.curves import (
    CurveError,
)

SQUARE = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
FIELD = hk.SolidAngle(SQUARE)
WAVY = hk.SolidAngle(example_curves.wavy_polygon(12))
GYROID = hk.Gyroid(domain=hk.Ball(radius=5.0))
DOWN = np.array([[0.0, 0.0, -1.0]])
ENCLOSURES = [None, "classic", "slope", "caps", "curvature"]


def above(n: int, height: float = 2.0, seed: int = 0) -> np.ndarray:
    """Points above the square, none above its border."""
    xy = np.random.default_rng(seed).uniform(-0.95, 0.95, (n, 2))
    return np.column_stack([xy, np.full(n, height)])


def around(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from a sphere of radius 3 into the unit ball."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    return o, rng.uniform(-0.7, 0.7, (n, 3)) - o


# --- what comes out -------------------------------------------------------------------------


def test_shapes_and_types_of_numpy_output() -> None:
    hits = hk.trace(FIELD, above(7), np.tile(DOWN, (7, 1)), precision="single")
    shapes_of = {name: array.shape for name, array in vars(hits).items()}
    assert shapes_of == {
        "t": (7,), "position": (7, 3), "normal": (7, 3), "value": (7,),
        "evaluations": (7,), "status": (7,), "primitive_index": (7,), "uncertainty": (7,),
    }  # fmt: skip
    assert all(type(array) is np.ndarray for array in vars(hits).values())
    assert hits.t.dtype == hits.position.dtype == hits.value.dtype == np.float32
    assert hits.evaluations.dtype == hits.status.dtype == np.int64
    assert hits.is_hit.dtype == bool
    assert hk.trace(FIELD, above(7), DOWN, precision="double").t.dtype == np.float64


def test_precision_follows_the_arrays() -> None:
    """float64 is traced in double precision, all others in single; `precision` says otherwise."""
    o, d = above(7), np.tile(DOWN, (7, 1))
    small = [array.astype(np.float32) for array in (o, d)]
    for rays, precision, dtype in (
        ((o, d), None, np.float64),
        ((o, d), "single", np.float32),
        (small, None, np.float32),
        (small, "double", np.float64),
        ((o.tolist(), d.tolist()), None, np.float32),
        ((np.ones((1, 3), np.int64), -np.ones((1, 3), np.int64)), None, np.float32),
    ):
        hits = hk.trace(FIELD, *rays, precision=precision)
        assert hits.t.dtype == hits.position.dtype == hits.normal.dtype == dtype
        crossings = hk.crossings(FIELD, *rays, max_crossings=2, precision=precision)
        assert crossings.t.dtype == crossings.position.dtype == dtype
    in_double = hk.trace(FIELD, o, d)
    for name, values in vars(hk.trace(FIELD, o, d, precision="double")).items():
        np.testing.assert_array_equal(getattr(in_double, name), values)


def test_one_origin_or_one_direction_serves_all() -> None:
    o, d = around(9)
    for origins, directions in ((o[:1], d), (o, d[:1])):
        hits = hk.trace(WAVY, origins, directions)
        repeated = hk.trace(
            WAVY, np.broadcast_to(origins, (9, 3)), np.broadcast_to(directions, (9, 3))
        )
        assert hits.t.shape == (9,)
        np.testing.assert_array_equal(hits.t, repeated.t)
        np.testing.assert_array_equal(hits.normal, repeated.normal)
    assert hk.trace(WAVY, o[:1], d[:1], t_min=np.zeros(4)).t.shape == (4,)


def test_no_rays_give_no_hits() -> None:
    for o, d in ((np.zeros((0, 3)), np.zeros((0, 3))), (np.zeros((0, 3)), DOWN)):
        hits = hk.trace(FIELD, o, d)
        assert hits.t.shape == hits.status.shape == (0,)
        assert hits.position.shape == hits.normal.shape == (0, 3)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_drjit_stays_drjit(precision: Any) -> None:
    backend = choose_backend(precision)
    o, d = around(20)
    hits = hk.trace(WAVY, backend.Array3f(o.T), backend.Array3f(d.T))
    assert type(hits.t) is type(hits.value) is backend.Float
    assert type(hits.position) is type(hits.normal) is backend.Array3f
    plain = hk.trace(WAVY, o, d, precision=precision)
    np.testing.assert_allclose(np.array(hits.t), plain.t, rtol=1e-5)
    np.testing.assert_array_equal(np.array(hits.status), plain.status)
    with pytest.raises(ValueError, match="precision follows"):
        hk.trace(WAVY, backend.Array3f(o.T), backend.Array3f(d.T), precision=precision)


def test_a_planar_square_is_met_where_its_plane_is() -> None:
    """The 2 pi level of a planar polygon is its flat interior."""
    o = above(200)
    d = np.random.default_rng(1).normal(size=(200, 3)) * 0.3 + DOWN
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    t = -o[:, 2] / unit[:, 2]
    x = o + t[:, None] * unit
    inside = np.abs(x[:, :2]).max(axis=1)
    hits = hk.trace(FIELD, o, d, tolerance=1e-5)
    clear = np.abs(inside - 1) > 1e-3
    np.testing.assert_array_equal(hits.is_hit[clear], inside[clear] < 1)
    hit = hits.is_hit & clear
    np.testing.assert_allclose(hits.t[hit], t[hit], atol=1e-4)
    np.testing.assert_allclose(hits.position[hit], x[hit], atol=1e-4)
    np.testing.assert_allclose(np.abs(hits.normal[hit, 2]), 1, atol=1e-3)
    assert np.isinf(hits.t[~hits.is_hit]).all()
    assert np.isnan(hits.position[~hits.is_hit]).all()
    assert (hits.normal[~hits.is_hit] == 0).all()


def test_normals_are_unit_gradients() -> None:
    o, d = around(100)
    for field, level in ((WAVY, None), (GYROID, 0.4)):
        hits = hk.trace(field, o, d, level=level, tolerance=1e-9, precision="double")
        x, h = hits.position[hits.is_hit], 1e-6
        backend = choose_backend("double")
        rise = []
        for axis in np.eye(3):
            ends = [
                np.array(field.evaluate(backend.Array3f((x + s * h * axis).T)).value)
                for s in (1, -1)
            ]
            move = ends[0] - ends[1]
            if field.period is not None:
                move = np.remainder(move + field.period / 2, field.period) - field.period / 2
            rise.append(move / (2 * h))
        gradient = np.stack(rise, axis=1)
        expected = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        np.testing.assert_allclose(hits.normal[hits.is_hit], expected, atol=1e-5)


def test_t_is_a_length_whatever_the_direction() -> None:
    o, d = around(50)
    plain, long = hk.trace(WAVY, o, d), hk.trace(WAVY, o, 37.0 * d)
    np.testing.assert_allclose(plain.t, long.t, rtol=1e-5)
    hit = plain.is_hit
    np.testing.assert_allclose(
        np.linalg.norm(plain.position - o, axis=1)[hit], plain.t[hit], rtol=1e-5
    )


def test_precisions_agree() -> None:
    o, d = around(400)
    for field in (WAVY, GYROID, hk.SphericalHarmonic(5, 2)):
        single = hk.trace(field, o, d, tolerance=1e-5, precision="single")
        double = hk.trace(field, o, d, tolerance=1e-5, precision="double")
        assert (single.status != double.status).sum() <= 1  # a ray that grazes the border
        both = single.is_hit & double.is_hit
        assert both.sum() > 50
        assert np.quantile(np.abs(single.t[both] - double.t[both]), 0.98) < 2e-4


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "over_relaxation", [1.0, *(pytest.param(x, marks=pytest.mark.slow) for x in (1.2, 1.4)), 1.9]
)
@pytest.mark.parametrize("enclosures", ENCLOSURES)
def test_different_proofs_give_the_same_hits(
    enclosures: str | None, over_relaxation: float
) -> None:
    o, d = around(300)
    for field in (WAVY, hk.SolidAngle(example_curves.torus_knot(2, 3, 40)), GYROID):
        settings: Any = {"tolerance": 1e-7, "precision": "double", "max_steps": 20_000}
        reference = hk.trace(field, o, d, enclosures="slope", over_relaxation=1.0, **settings)
        hits = hk.trace(
            field, o, d, enclosures=enclosures, over_relaxation=over_relaxation, **settings
        )
        assert (hits.status != reference.status).sum() <= 1
        both = hits.is_hit & reference.is_hit
        assert both.sum() > 50
        assert np.quantile(np.abs(hits.t[both] - reference.t[both]), 0.98) < 1e-5


# --- settings -------------------------------------------------------------------------------


def test_t_min_and_t_max_of_each_ray() -> None:
    """Heights 2: the square is at t = 2."""
    o = above(5)
    t_min, t_max = np.array([0, 1.9, 2.1, 0, 0]), np.array([9.0, math.inf, 9, 1.9, 2.1])
    hits = hk.trace(FIELD, o, DOWN, t_min=t_min, t_max=t_max)
    assert hits.status.tolist() == [1, 1, 0, 0, 1]
    # Only points within the extent are looked at, and none before t_min.
    assert (hits.t >= t_min).all()
    assert hk.trace(FIELD, o, DOWN, t_min=2.1).status.tolist() == [0] * 5
    assert hk.trace(FIELD, o, DOWN, t_max=1.9).status.tolist() == [0] * 5


def test_a_ray_without_end_ends_in_a_miss() -> None:
    o, d = around(50)
    knot = hk.SolidAngle(example_curves.torus_knot(2, 3, 40))
    for field, level in ((WAVY, None), (knot, 1.0), (GYROID, None)):
        hits = hk.trace(field, 50 * o, -d, level=level)
        assert (hits.status == hk.RayStatus.MISS).all()
        assert (hits.evaluations < 200).all()


@pytest.mark.slow
def test_clip_volumes() -> None:
    o, d = above(100), DOWN
    half = hk.trace(FIELD, o, d, clip=hk.HalfSpace((1.0, 0.0, 0.0), 0.0))
    np.testing.assert_array_equal(half.is_hit, o[:, 0] <= 0)
    ball = hk.trace(FIELD, o, d, clip=hk.Ball(radius=0.5))
    distance = np.linalg.norm(o[:, :2], axis=1)
    clear = np.abs(distance - 0.5) > 1e-3
    np.testing.assert_array_equal(ball.is_hit[clear], distance[clear] < 0.5)
    box = hk.trace(FIELD, o, d, clip=hk.Box((-2, -2, 0.5), (2, 2, 3)))
    assert not box.is_hit.any()


def test_tolerances() -> None:
    o, d = around(100)
    exact = hk.trace(WAVY, o, d, tolerance=1e-12, precision="double")
    hit = exact.is_hit
    fewer = []
    growing, by_value = (
        hk.tracer.HitTolerance(1e-4, per_length=1e-2),
        hk.tracer.HitTolerance(0.0, value=0.05),
    )
    for tolerance in (1e-2, growing, by_value, 1e-6):
        hits = hk.trace(WAVY, o, d, tolerance=tolerance, precision="double")
        both = hit & hits.is_hit
        assert both.sum() > 0.9 * hit.sum()
        assert (hits.t[both] <= exact.t[both] + 1e-9).all()
        assert np.quantile(np.abs(hits.t[both] - exact.t[both]), 0.9) < 0.2
        fewer.append(hits.evaluations.sum())
    assert max(fewer[:3]) < fewer[3] < exact.evaluations.sum()
    hits = hk.trace(WAVY, o, d, tolerance=by_value, precision="double")
    away = np.abs(np.remainder(hits.value[hits.is_hit], 4 * math.pi) - 2 * math.pi)
    assert (away <= 0.05).all()


def test_few_steps_end_with_the_proved_length() -> None:
    o, d = around(200)
    full = hk.trace(WAVY, o, d)
    for steps in (1, 2, 5):
        short = hk.trace(WAVY, o, d, max_steps=steps)
        out = short.status == hk.RayStatus.OUT_OF_STEPS
        assert out.any()
        assert (short.evaluations <= steps).all()
        assert (short.t[out] <= full.t[out] + 1e-5).all()
        assert np.isfinite(short.t[out]).all()
        np.testing.assert_array_equal(short.t[~out], full.t[~out])


def test_several_levels_and_periods() -> None:
    o, d = around(200)
    single = [hk.trace(GYROID, o, d, level=level, tolerance=1e-4).t for level in (-0.5, 0.7)]
    both = hk.trace(GYROID, o, d, level=[-0.5, 0.7], tolerance=1e-4)
    np.testing.assert_allclose(both.t, np.minimum(*single), atol=1e-3)
    np.testing.assert_array_equal(
        hk.trace(WAVY, o, d, level=1.0).status, hk.trace(WAVY, o, d, level=1 + 8 * math.pi).status
    )


def test_a_surface_and_options_are_what_the_keywords_are() -> None:
    o, d = around(30)
    surface, options = hk.Surface(WAVY, 1.0), hk.TraceOptions(tolerance=1e-6)
    by_keywords = hk.trace(WAVY, o, d, level=1.0, tolerance=1e-6).t
    for hits in (
        hk.trace(surface, o, d, options=options),
        hk.trace(surface, o, d, tolerance=1e-6),
        hk.trace(WAVY, o, d, level=1.0, options=options),
        hk.trace(surface.replace(level=2.0).replace(level=1.0), o, d, options=options),
        hk.trace(surface, o, d, options=hk.TraceOptions().replace(tolerance=1e-6)),
    ):
        np.testing.assert_array_equal(hits.t, by_keywords)


@pytest.mark.parametrize(
    ("volume", "expected"),
    [
        (hk.Ball(radius=0.5), 1e-4),
        (hk.Box((-3, -1, -1), (3, 1, 1)), 6e-4),
        (hk.HalfSpace((0, 0, 1), 1.0), 1e-4),
    ],
    ids=["ball", "box", "no bounds"],
)
def test_the_default_tolerance_follows_the_longest_side(volume: hk.Volume, expected: float) -> None:
    """1e-4 of it; 1e-4 without bounds."""
    o, d = around(200)
    endless = hk.Gyroid(domain=hk.HalfSpace((0, 0, 1), 50.0))
    # Steps that get shorter and shorter, so that hits are as far off as the tolerance lets them.
    options = hk.TraceOptions(enclosures="lipschitz", over_relaxation=1.0)
    for surface in (
        hk.Surface(hk.Gyroid(domain=volume)),
        hk.Surface(endless, clip=volume),
        hk.Surface(endless, section=volume),
    ):
        hits, same, other = (
            hk.trace(surface, o, d, t_max=20.0, options=options.replace(tolerance=tolerance)).t
            for tolerance in (None, expected, 0.9 * expected)
        )
        assert np.isfinite(hits).sum() > 20
        np.testing.assert_array_equal(hits, same)
        assert (hits != other).any()


# --- what is refused ------------------------------------------------------------------------

NAN = [[math.nan, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("origins", "directions", "settings", "message"),
    [
        (np.zeros(3), DOWN, {}, r"origins must have shape \(n, 3\).*\[\[x, y, z\]\]"),
        (np.zeros((4, 2)), DOWN, {}, r"origins must have shape"),
        (np.zeros((2, 3)), np.ones((3, 3)), {}, "give 1 or 3"),
        (np.zeros((2, 3)), DOWN, {"t_max": np.ones(3)}, "give 1 or 3"),
        (NAN, DOWN, {}, "origins has NaN"),
        ([[0.0, 0, math.inf]], DOWN, {}, "origins has NaN or infinite"),
        (np.zeros((1, 3)), NAN, {}, "directions has NaN"),
        (np.zeros((2, 3)), [[1.0, 0, 0], [0, 0, 0]], {}, "directions: entry 1 has length zero"),
        (np.zeros((1, 3)), DOWN, {"t_min": math.nan}, "t_min has NaN"),
        (np.zeros((1, 3)), DOWN, {"t_max": [math.nan]}, "t_max has NaN"),
        (np.zeros((1, 3)), DOWN, {"t_min": -1.0}, "t_min must be >= 0"),
        (np.zeros((1, 3)), DOWN, {"t_min": 2.0, "t_max": 1.0}, "t_max is smaller than t_min"),
        (np.zeros((1, 3)), DOWN, {"level": math.nan}, "level must be finite"),
        (np.zeros((1, 3)), DOWN, {"level": math.inf}, "level must be finite"),
        (np.zeros((1, 3)), DOWN, {"level": []}, "level: give at least one"),
        (np.zeros((1, 3)), DOWN, {"enclosures": "best"}, "unknown enclosures 'best'; choose"),
        (np.zeros((1, 3)), DOWN, {"enclosures": "lipschitz"}, "no enclosure applies"),
        (np.zeros((1, 3)), DOWN, {"tolerance": 0.0}, "tolerance must be finite and > 0"),
        (np.zeros((1, 3)), DOWN, {"tolerance": -1e-3}, "tolerance must be finite and > 0"),
        (np.zeros((1, 3)), DOWN, {"tolerance": math.nan}, "tolerance must be finite and > 0"),
        (np.zeros((1, 3)), DOWN, {"over_relaxation": 0.9}, r"over_relaxation must lie in \[1, 2\)"),
        (np.zeros((1, 3)), DOWN, {"over_relaxation": 2.0}, r"over_relaxation must lie in \[1, 2\)"),
        (np.zeros((1, 3)), DOWN, {"max_steps": 0}, "max_steps must be an integer from 1"),
    ],
)  # fmt: skip
def test_bad_rays_and_settings(
    origins: Any, directions: Any, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        hk.trace(FIELD, origins, directions, **settings)


def test_wrong_types_are_refused() -> None:
    with pytest.raises(TypeError, match="origins must hold real numbers"):
        hk.trace(FIELD, [["a", "b", "c"]], DOWN)
    with pytest.raises(TypeError, match="directions must hold real numbers"):
        hk.trace(FIELD, np.zeros((1, 3)), DOWN * 1j)


@pytest.mark.parametrize(
    ("field", "level", "message"),
    [
        (hk.Gyroid(), 1.51, r"no surface has level 1.51.*\[-1.5, 1.5\]"),
        (hk.fields.SchwarzP(), -3.1, r"no surface has level -3.1.*\[-3, 3\]"),
        (hk.fields.SchwarzD(), 1.5, r"no surface has level 1.5.*1.41421"),
        (hk.SphericalHarmonic(4, 2), 1.0, r"no surface has level 1: .*within"),
        (hk.HarmonicPolynomial({(1, 0, 0): 2.0}), 2.5, r"no surface has level 2.5.*within"),
        (hk.Gyroid(), [0.0, 7.0], "no surface has level 7"),
    ],
)
def test_a_level_that_no_surface_has(field: hk.Field, level: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hk.trace(field, np.zeros((1, 3)), DOWN, level=level)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (SQUARE[:2], "at least 3"),
        (SQUARE[[0, 1, 0, 1]], "2 different vertices"),
        (SQUARE[[0, 1, 1, 2]], "vertices 1 and 2 of the loop are both"),
        (np.where(SQUARE == 1, math.nan, SQUARE), "must be finite"),
        (SQUARE[:, :2], "append a column of zeros"),
        (SQUARE.T, "transpose it"),
        ([], "there are no loops"),
        ([SQUARE, SQUARE[:2]], "loop 1"),
    ],
)
def test_bad_curves(vertices: Any, message: str) -> None:
    with pytest.raises(CurveError, match=message):
        hk.SolidAngle(vertices)


def test_a_curve_may_repeat_its_first_vertex_at_the_end() -> None:
    closed = hk.SolidAngle(np.concatenate([SQUARE, SQUARE[:1]]))
    assert len(closed.loops[0]) == 4
    o = above(20)
    np.testing.assert_array_equal(hk.trace(closed, o, DOWN).t, hk.trace(FIELD, o, DOWN).t)


def test_drjit_rays_of_another_shape_are_refused() -> None:
    backend = choose_backend("single")
    with pytest.raises(TypeError, match="origins must be a 3-vector"):
        hk.trace(FIELD, backend.Float(1, 2, 3), backend.Array3f(0, 0, -1))
    assert dr.width(hk.trace(FIELD, backend.Array3f(0, 0, 2), backend.Array3f(0, 0, -1)).t) == 1
