"""The solid angle of curves against an independent formula, its gradient, and its extents."""

from __future__ import annotations

import math
import warnings
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import choose_enclosures
from harnack.enclosures.samples import Ray
from harnack.geometry import example_curves, validate_loops
from harnack.geometry.polygons import cancel_opposite_edges
from tests.oracles.oracle import CurveOracle, first_crossings, gap_to_levels

FOUR_PI = 4 * math.pi
CURVES: dict[str, list[np.ndarray]] = {
    "triangle": [np.array([[1.0, 0, 0], [-0.5, 0.8, 0.1], [-0.4, -0.9, 0.3]])],
    "square": [example_curves.regular_polygon(4)],
    "wavy": [example_curves.wavy_polygon(12)],
    "wavy, padded": [example_curves.wavy_polygon(50)],
    "fine": [example_curves.wavy_polygon(1000)],
    "trefoil": [example_curves.torus_knot(2, 3, 60)],
    "coil": [example_curves.coil(6, 150)],
    "link": example_curves.hopf_link(20),
    "holes": example_curves.square_with_holes(),
    "rings": example_curves.borromean_rings(17),
    "spiky": [example_curves.spiky_polygon(np.random.default_rng(0), 21)],
}
PRECISIONS = ["double", "single"]


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def points_beside(loops: list[np.ndarray], distance: float, n: int, seed: int = 0) -> np.ndarray:
    """Points at a distance from random points of edges, the first vertex of a loop among them."""
    rng = np.random.default_rng(seed)
    a = np.concatenate(loops)
    e = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]) - a
    k = rng.integers(len(a), size=n)
    foot = a[k] + rng.uniform(0.1, 0.9, (n, 1)) * e[k]
    foot[: n // 4] = loops[-1][0]
    across = np.cross(e[k], rng.normal(size=(n, 3)))
    across[: n // 4] = rng.normal(size=(n // 4, 3))
    return foot + distance * unit(across)


def points_in_line(loops: list[np.ndarray]) -> np.ndarray:
    """Straight above and below vertices and midpoints of edges, along each axis."""
    a = np.concatenate(loops)
    middle = 0.5 * (a + np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]))
    steps = [s * axis for axis in np.eye(3) for s in (-2.0, -0.3, 0.3, 2.0)]
    return np.concatenate([place + step for place in (a[:12], middle[:12]) for step in steps])


def all_points(loops: list[np.ndarray]) -> np.ndarray:
    rng = np.random.default_rng(1)
    far = unit(rng.normal(size=(40, 3)))
    parts = [rng.uniform(-1.5, 1.5, (300, 3)), points_in_line(loops)]
    parts += [points_beside(loops, 10.0**-k, 100, k) for k in range(1, 7)]
    parts += [10.0**k * far for k in range(1, 5)]
    return np.concatenate(parts).astype(np.float32).astype(np.float64)


def away_from_curve(loops: list[np.ndarray], x: np.ndarray, precision: str) -> np.ndarray:
    """Points that rounding tells from the curve itself."""
    limit = 1e-5 if precision == "single" else 1e-9
    return x[CurveOracle(loops)(x).smooth > limit]


@pytest.mark.few(5)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CURVES)
def test_values_and_gradients(name: str, precision: str) -> None:
    """Within the stated error and that of the position, everywhere."""
    loops, backend = CURVES[name], choose_backend(precision)  # type: ignore[arg-type]
    x = away_from_curve(loops, all_points(loops), precision)
    sample = hk.SolidAngle(loops).evaluate(to_vector3(backend, x))
    truth, steep = CurveOracle(loops)(x), CurveOracle(loops)(x).gradient_norm
    size = 1 + np.abs(x).max(axis=1)
    off = gap_to_levels(to_numpy(sample.value) - truth.value, [0.0], FOUR_PI)
    # The last term is the rounding of the truth.
    error = sample.value_error
    error = to_numpy(error) if dr.is_array_v(type(error)) else error
    allowed = error + 4 * backend.machine_epsilon * (2 + steep * size) + 1e-10
    worst = np.argmax(off / allowed)
    assert off[worst] <= allowed[worst], (x[worst], off[worst], truth.smooth[worst])
    # A gradient changes by about itself over the distance to the curve.
    wrong = np.linalg.norm(to_numpy(sample.gradient) - truth.gradient, axis=1)
    edges = sum(len(loop) for loop in loops)
    total = sum_of_edge_fields(loops, x)
    blur = backend.machine_epsilon * total * (4 * math.sqrt(edges) + 8 * size / truth.smooth)
    worst = np.argmax(wrong / blur)
    assert wrong[worst] <= blur[worst], (x[worst], wrong[worst], blur[worst])


def sum_of_edge_fields(loops: list[np.ndarray], x: np.ndarray) -> np.ndarray:
    """A bound of the sum over the edges of the sizes of their gradients, which may cancel."""
    total, distance = np.zeros(len(x)), CurveOracle(loops)(x).smooth
    for loop in loops:
        for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            length = np.linalg.norm(b - a)
            d = np.maximum(np.linalg.norm(x - 0.5 * (a + b), axis=1) - 0.5 * length, distance)
            total += np.minimum(length / d**2, 2 / d)
    return total


@pytest.mark.parametrize("name", CURVES)
def test_gradients_are_derivatives_of_values(name: str) -> None:
    loops, backend = CURVES[name], choose_backend("double")
    x = np.concatenate(
        [points_beside(loops, 10.0**-k, 60, k) for k in range(5)]
        + [np.random.default_rng(2).uniform(-2, 2, (100, 3))]
    )
    field, distance = hk.SolidAngle(loops), CurveOracle(loops)(x).smooth
    gradient = to_numpy(field.evaluate(to_vector3(backend, x)).gradient)

    def value(points: np.ndarray) -> np.ndarray:
        return to_numpy(field.evaluate(to_vector3(backend, points)).value)

    h = 1e-4 * distance
    for k, axis in enumerate(np.eye(3)):
        step = h[:, None] * axis
        move = value(x + step) - value(x - step)
        slope = (np.remainder(move + 2 * math.pi, FOUR_PI) - 2 * math.pi) / (2 * h)
        scale = sum_of_edge_fields(loops, x)
        assert (np.abs(slope - gradient[:, k]) <= 1e-6 * scale + 1e-13 / h).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_point_on_the_curve_is_close_to_every_level(precision: str) -> None:
    loops, backend = CURVES["wavy"], choose_backend(precision)  # type: ignore[arg-type]
    x = np.concatenate([loops[0], 0.5 * (loops[0] + np.roll(loops[0], 1, axis=0))])
    sample = hk.SolidAngle(loops).evaluate(to_vector3(backend, x))
    steep = np.linalg.norm(to_numpy(sample.gradient), axis=1)
    assert np.isfinite(to_numpy(sample.value)).all()
    assert (steep > 1e5).all()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("scale", [1e-20, 1e-3, 1e3, 1e15])
def test_scale_and_translation(scale: float, precision: str) -> None:
    """Omega does not change; gradients and radii scale. Moving costs the rounding of a point."""
    loops, backend = CURVES["link"], choose_backend(precision)  # type: ignore[arg-type]
    x = np.random.default_rng(3).uniform(-1.5, 1.5, (200, 3)).astype(np.float32).astype(float)
    x = x[CurveOracle(loops)(x).smooth > 0.02]
    shift = np.array([2.0, -1.0, 0.5])
    plain = hk.SolidAngle(loops).evaluate(to_vector3(backend, x))
    moved = hk.SolidAngle([scale * (loop + shift) for loop in loops]).evaluate(
        to_vector3(backend, scale * (x + shift))
    )
    off = gap_to_levels(to_numpy(moved.value) - to_numpy(plain.value), [0.0], FOUR_PI)
    steep = np.linalg.norm(to_numpy(plain.gradient), axis=1)
    assert (off <= 2 * moved.value_error + 16 * backend.machine_epsilon * (1 + 4 * steep)).all()
    scaled = scale * to_numpy(moved.gradient)
    np.testing.assert_allclose(
        scaled, to_numpy(plain.gradient), rtol=0, atol=2e3 * backend.machine_epsilon * steep.max()
    )
    radius, before = to_numpy(moved.promises[0].radius) / scale, to_numpy(plain.promises[0].radius)
    np.testing.assert_allclose(radius, before, rtol=3e-3 if precision == "single" else 1e-9)


def test_loops_add_up_and_reversal_changes_the_sign() -> None:
    backend, loops = choose_backend("double"), CURVES["link"]
    x = to_vector3(backend, np.random.default_rng(4).uniform(-1, 1, (100, 3)))

    def value(parts: list[np.ndarray]) -> np.ndarray:
        return to_numpy(hk.SolidAngle(parts).evaluate(x).value)

    together, apart = value(loops), value(loops[:1]) + value(loops[1:])
    np.testing.assert_allclose(gap_to_levels(together - apart, [0.0], FOUR_PI), 0, atol=1e-12)
    reverse = value([loop[::-1] for loop in loops])
    np.testing.assert_allclose(gap_to_levels(together + reverse, [0.0], FOUR_PI), 0, atol=1e-12)


def test_sign_and_size_above_a_disk() -> None:
    """A counter-clockwise circle seen from above: Omega = 2 pi (1 - z/sqrt(z^2+1)), sign of the
    paper's Eq. 10."""
    field = hk.SolidAngle(example_curves.regular_polygon(512))
    z = np.array([0.5, 1.0, 3.0])
    x = to_vector3(choose_backend("double"), np.column_stack([0 * z, 0 * z, z]))
    value = to_numpy(field.evaluate(x).value)
    expected = 2 * math.pi * (1 - z / np.sqrt(z * z + 1))
    np.testing.assert_allclose(np.abs(value), expected, rtol=1e-4)
    oracle = CurveOracle([example_curves.regular_polygon(512)])(
        np.column_stack([0 * z, 0 * z, z])
    ).value
    np.testing.assert_allclose(value, oracle, rtol=1e-12)


# --- extents --------------------------------------------------------------------------------


@pytest.mark.few(3)
@pytest.mark.parametrize("levels", [(2 * math.pi,), (0.5,), (3.0, 11.0)], ids=str)
@pytest.mark.parametrize("name", CURVES)
def test_no_level_lies_outside_the_extent(name: str, levels: tuple[float, ...]) -> None:
    """On random segments, none of whose points is in the extent."""
    loops = CURVES[name]
    extent = hk.SolidAngle(loops).extent(levels)
    assert extent is not None
    lower, upper = extent.bounds()
    center, reach = 0.5 * (lower + upper), 0.5 * np.linalg.norm(upper - lower)
    rng = np.random.default_rng(5)
    o = center + reach * rng.uniform(0.3, 1.5, (3000, 1)) * unit(rng.normal(size=(3000, 3)))
    d, length = unit(rng.normal(size=(3000, 3))), 0.3 * reach
    along = np.linspace(0, length, 20)
    x = o[:, None] + along[:, None] * d[:, None]
    outside = ~extent.contains_points(x.reshape(-1, 3)).reshape(len(o), -1).any(axis=1)
    o, d = o[outside][:400], d[outside][:400]
    assert len(o) > 100
    crossings = first_crossings(
        CurveOracle(loops), o, d, 0.0, length,
        levels=levels, period=FOUR_PI, depth=1e-6, spacing=0.1, finest=1e-4,
    )  # fmt: skip
    found = np.isfinite(crossings.beyond)
    # A crossing on a segment that dips into the extent between its twenty points does not count.
    at = (o + crossings.beyond[:, None] * d)[found]
    assert extent.contains_points(at).all(), at


class Unbounded(hk.SolidAngle):
    """Of which nobody knows where its levels are."""

    def extent(self, levels: tuple[float, ...]) -> None:
        del levels


@pytest.mark.few(1)
@pytest.mark.parametrize("level", [2 * math.pi, 1.0])
@pytest.mark.parametrize("name", ["trefoil", "coil", "link", "rings", "holes", "wavy"])
def test_the_extent_holds_every_hit_found_without_it(name: str, level: float) -> None:
    loops = CURVES[name]
    rng = np.random.default_rng(6)
    o = 4.0 * unit(rng.normal(size=(1500, 3)))
    d = unit(rng.uniform(-1.2, 1.2, (1500, 3)) - o)
    settings: dict[str, Any] = {"level": level, "tolerance": 1e-4}
    free = hk.trace(Unbounded(loops), o, d, t_max=9.0, max_steps=500, **settings)
    assert free.is_hit.sum() > 200
    extent = hk.SolidAngle(loops).extent((level,))
    assert extent is not None
    assert extent.padded(1e-3).contains_points(free.position[free.is_hit]).all()
    bounded = hk.trace(hk.SolidAngle(loops), o, d, **settings)
    # Rays that graze the border within the tolerance may go either way.
    assert (bounded.is_hit & ~free.is_hit).sum() + (free.is_hit & ~bounded.is_hit).sum() <= 3
    both = bounded.is_hit & free.is_hit
    assert np.quantile(np.abs(bounded.t[both] - free.t[both]), 0.99) < 1e-3


def test_extent_of_a_multiple_of_the_period_is_unknown() -> None:
    """Omega vanishes on unbounded sets, of a planar curve on the rest of its plane."""
    assert hk.SolidAngle(CURVES["square"]).extent((0.0,)) is None
    assert hk.SolidAngle(CURVES["square"]).extent((1.0, FOUR_PI)) is None


def test_convex_position_is_found_out() -> None:
    assert hk.SolidAngle(CURVES["wavy"]).describe()["lift_bound"] == "range"
    for name in ("trefoil", "coil", "link", "spiky"):
        assert hk.SolidAngle(CURVES[name]).describe()["lift_bound"] == "edges"
    for name in ("square", "holes"):
        assert hk.SolidAngle(CURVES[name]).describe()["lift_bound"] == "planar"
    with pytest.raises(ValueError, match="convex"):
        hk.SolidAngle(CURVES["trefoil"], lift_bound="convex")
    with pytest.raises(ValueError, match="unknown lift_bound"):
        hk.SolidAngle(CURVES["trefoil"], lift_bound="best")  # type: ignore[arg-type]
    assert len(validate_loops(CURVES["link"])) == 2


def aimed_at(loops: list[np.ndarray], n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from around curves towards places near them."""
    rng = np.random.default_rng(8)
    points = np.concatenate(loops)
    center, size = points.mean(axis=0), np.ptp(points, axis=0).max()
    o = center + 2 * size * unit(rng.normal(size=(n, 3)))
    return o, unit(center + 0.6 * size * rng.uniform(-1, 1, (n, 3)) - o)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_tiny_edge_hides_no_hits(precision: str) -> None:
    """A ring run through twice: its 2 pi level lies far outside of its flat hull."""
    ring = np.tile(example_curves.regular_polygon(20), (2, 1))
    ring -= ring[0]
    o, d = aimed_at([ring], 1200)
    plain = hk.trace(hk.SolidAngle(ring), o, d, precision=precision)
    field = hk.SolidAngle(np.insert(ring, 1, [1e-30, 0, 0], axis=0))
    assert field.describe()["lift_bound"] == "edges"
    tiny = hk.trace(field, o, d, precision=precision)
    assert plain.is_hit.sum() > 400
    assert (plain.status == tiny.status).all()
    np.testing.assert_allclose(plain.t[plain.is_hit], tiny.t[plain.is_hit], atol=1e-3)


# --- edges run both ways ----------------------------------------------------------------------

CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0.2], [1, 1, 0.1], [-1, 1, -0.3]])
# Two triangles with a common edge that both run, in opposite directions; and the same as one loop.
HALVES = [CORNERS[[0, 1, 2]], CORNERS[[2, 3, 0]]]
KEYHOLE = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0.5], [-2, 2, 0], [-2, -2, 0], [-1, -1, 0.1],
                    [-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.1]])  # fmt: skip
CANCELING: dict[str, tuple[list[np.ndarray], list[np.ndarray], np.ndarray]] = {
    "halves": (HALVES, [CORNERS], CORNERS[[0, 2]]),
    "keyhole": ([KEYHOLE], [KEYHOLE[:4], KEYHOLE[5:9]], KEYHOLE[4:6]),
}


def rays_beside(edge: np.ndarray, n: int, seed: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Rays that pass the inner part of an edge at 1e-9 to 1e-2, some of them along it."""
    rng = np.random.default_rng(seed)
    (a, b), e = edge, unit(edge[1] - edge[0])
    place = a + rng.uniform(0.2, 0.8, (n, 1)) * (b - a)
    across = unit(np.cross(e, rng.normal(size=(n, 3))))
    place += 10 ** rng.uniform(-9, -2, (n, 1)) * across
    d = unit(rng.normal(size=(n, 3)))
    d[: n // 4] = e + 1e-4 * rng.normal(size=(n // 4, 3)) * rng.integers(0, 2, (n // 4, 1))
    return place - rng.uniform(0, 4, (n, 1)) * unit(d), unit(d)


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CANCELING)
def test_edges_run_both_ways_are_not_there(name: str, precision: str) -> None:
    loops, net, edge = CANCELING[name]
    o, d = rays_beside(edge, 4000)
    field, other = hk.SolidAngle(loops), hk.SolidAngle(net)
    assert field.convex_position == other.convex_position
    hits, expected = (
        hk.trace(curve, o, d, tolerance=1e-4, precision=precision) for curve in (field, other)
    )
    assert (expected.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    assert (hits.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    assert (hits.is_hit != expected.is_hit).sum() <= 4  # graze within the tolerance
    both = hits.is_hit & expected.is_hit
    assert np.quantile(np.abs(hits.t[both] - expected.t[both]), 0.99) < 1e-3
    # And by an oracle of its own: the field is near the level where it hits.
    look = CurveOracle(net)(hits.position[hits.is_hit].astype(float))
    gap = gap_to_levels(look.value, [2 * math.pi], FOUR_PI)
    assert (gap <= 3e-4 * look.gradient_norm).all()
    backend = choose_backend(precision)  # type: ignore[arg-type]
    p = to_vector3(backend, o[:50])
    for one, two in (
        (field.evaluate(p).gradient, other.evaluate(p).gradient),
        (field.hessian(p)[0], other.hessian(p)[0]),
        (field.boundary.closest_point(p), other.boundary.closest_point(p)),
    ):
        np.testing.assert_allclose(to_numpy(one), to_numpy(two), rtol=1e-3, atol=1e-4)


def test_parts_that_cancel_are_left_out() -> None:
    square = example_curves.regular_polygon(4)
    assert hk.SolidAngle(HALVES).describe()["canceled edges"] == 2
    assert hk.SolidAngle(square).describe()["canceled edges"] == 0
    # What is run twice the same way counts twice.
    assert hk.SolidAngle([square, square]).describe()["canceled edges"] == 0
    (net,) = cancel_opposite_edges((square, square, square[::-1].copy()))
    assert sorted(map(tuple, net)) == sorted(map(tuple, square))
    kept = (square, square)
    assert cancel_opposite_edges(kept) is kept
    # A spike is run out and back.
    spike = np.insert(square, 1, [[3.0, 0, 0], square[0]], axis=0)
    assert len(cancel_opposite_edges((spike,))[0]) == 4


NOTHING: dict[str, list[np.ndarray]] = {
    "forth and back": [HALVES[0], HALVES[0][::-1]],
    "spikes": [np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 1, 0]])],
}


@pytest.mark.few(11)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("certificate", ["auto", "edges", "paper"])
@pytest.mark.parametrize("name", NOTHING)
def test_a_curve_that_cancels_as_a_whole_has_no_surface(
    name: str, certificate: str, precision: str
) -> None:
    field = hk.SolidAngle(NOTHING[name], lift_bound=certificate)  # type: ignore[arg-type]
    o, d = aimed_at(NOTHING[name], 300)
    o[:3], d[:3] = [0, 0, 0], np.eye(3)  # on the curve
    for level in (2 * math.pi, 0.5):
        for enclosures in (None, "classic", "slope"):
            end = hk.trace(field, o, d, level=level, precision=precision, enclosures=enclosures)
            assert (end.status == int(hk.RayStatus.MISS)).all()
    far = hk.trace(Unbounded(NOTHING[name]), o, d, precision=precision)
    assert (far.status == int(hk.RayStatus.MISS)).all()
    backend = choose_backend(precision)  # type: ignore[arg-type]
    p = to_vector3(backend, o)
    assert (to_numpy(field.evaluate(p).value) == 0).all()
    assert (to_numpy(field.evaluate(p).gradient) == 0).all()
    assert all((to_numpy(row) == 0).all() for row in field.hessian(p))
    assert (to_numpy(field.evaluator(backend).differentiable_value(p)) == 0).all()
    assert field.boundary is None
    assert field.describe()["canceled edges"] == sum(map(len, NOTHING[name]))
    for level in (0.0, FOUR_PI, -2 * FOUR_PI):
        with pytest.raises(ValueError, match="cancel"):
            hk.trace(field, o, d, level=level)


@pytest.mark.slow
def test_vertices_can_be_differentiated_by_where_edges_cancel() -> None:
    """Against finite differences, for a loop whose bridge is run there and back."""
    backend = choose_backend("double")
    o, d = aimed_at([KEYHOLE], 200)

    def hits(vertices: np.ndarray, *, differentiate: bool) -> tuple[np.ndarray, np.ndarray]:
        v = to_vector3(backend, vertices)
        if differentiate:
            dr.enable_grad(v)
            dr.set_grad(v, to_vector3(backend, move))
        end = hk.trace(
            hk.SolidAngle(v), to_vector3(backend, o), to_vector3(backend, d), tolerance=1e-9
        )
        rate = to_numpy(dr.forward_to(end.t)) if differentiate else np.zeros(len(o))
        return to_numpy(dr.detach(end.t)), rate

    move = np.random.default_rng(1).normal(size=KEYHOLE.shape)
    t, rate = hits(KEYHOLE, differentiate=True)
    h = 1e-5
    ahead, _ = hits(KEYHOLE + h * move, differentiate=False)  # the bridge opens
    behind, _ = hits(KEYHOLE - h * move, differentiate=False)
    t, ahead, behind = (np.nan_to_num(ends, posinf=1e9) for ends in (t, ahead, behind))
    same = (t < 1e8) & (np.abs(ahead - t) < 1e-2) & (np.abs(behind - t) < 1e-2)
    assert same.sum() > 40
    off = np.abs(rate - (ahead - behind) / (2 * h))[same]
    assert np.median(off) < 1e-5
    assert np.quantile(off, 0.9) < 1e-2


# --- rays along the curve ---------------------------------------------------------------------


def lines_beside(
    loops: list[np.ndarray], n: int, seed: int = 10
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points 1e-5 to 4e-3 beside edges; directions along their edge, for half of them about; and
    the distances."""
    rng = np.random.default_rng(seed)
    a = np.concatenate(loops)
    e = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]) - a
    k = rng.integers(len(a), size=n)
    away = 10 ** rng.uniform(-5, -2.4, (n, 1))
    x = a[k] + rng.uniform(0, 1, (n, 1)) * e[k]
    x += away * unit(np.cross(e[k], rng.normal(size=(n, 3))))
    d = unit(e[k]) * rng.choice([-1, 1], (n, 1))
    d[: n // 2] += 10 ** rng.uniform(-6, -1, (n // 2, 1)) * rng.normal(size=(n // 2, 3))
    return x, unit(d), away[:, 0]


def moves_along(
    loops: list[np.ndarray], x: np.ndarray, d: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """The largest |f(x + s d) - f(x)|/s of the lift over 0 < s < length, by the oracle."""
    oracle, s, worst = CurveOracle(loops), np.zeros(len(x)), np.zeros(len(x))
    look = oracle(x)
    value, start, alive = look.value, look.value, np.arange(len(x))
    lift, smooth = value.copy(), look.smooth
    while len(alive):
        s[alive] = np.minimum(s[alive] + 0.3 * smooth, length[alive])
        look = oracle(x[alive] + s[alive, None] * d[alive])
        move = np.remainder(look.value - lift[alive] + 2 * math.pi, FOUR_PI) - 2 * math.pi
        lift[alive] += move
        worst[alive] = np.maximum(worst[alive], np.abs(lift - start)[alive] / s[alive])
        going = s[alive] < length[alive]
        alive, smooth = alive[going], look.smooth[going]
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("precision", [pytest.param("single", marks=pytest.mark.slow), "double"])
@pytest.mark.parametrize(
    "name",
    [
        *("wavy", "holes", "link"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("triangle", "coil", "spiky")),
    ],
)
def test_what_is_promised_along_a_line_holds(name: str, precision: str) -> None:
    loops, backend = CURVES[name], choose_backend(precision)  # type: ignore[arg-type]
    x, d, away = lines_beside(loops, 40)
    if precision == "single":
        x, d = (v.astype(np.float32).astype(float) for v in (x, d))
        x, d = x[away > 1e-4], unit(d[away > 1e-4])
    path = Ray(to_vector3(backend, x), to_vector3(backend, d), choose_enclosures(None))
    start = backend.Float(0)
    evaluator = hk.SolidAngle(loops).evaluator(backend)
    promises = evaluator.sample_ray(path, start, start, start).sample.ray_promises
    gain = 0.0
    assert len(promises) == 6
    for promise in promises:
        rate, length = to_numpy(promise.constant), to_numpy(promise.radius)
        # Others say nothing that a step could use, and would take the oracle long.
        useful = (rate * length < 20) & (length < 1e3 * CurveOracle(loops)(x).smooth)
        assert useful.any() or promise is not promises[0]
        for sign in (-1, 1):
            worst = moves_along(loops, x[useful], sign * d[useful], length[useful])
            assert (worst <= rate[useful] * (1 + 1e-6) + 1e-6).all()
            gain = max(gain, float((worst / rate[useful]).max(initial=0)))
    assert gain > 0.6  # half the rate would not do


def rays_along(loops: list[np.ndarray], away: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays at this distance from an edge and parallel to it."""
    rng = np.random.default_rng(11)
    a = np.concatenate(loops)
    e = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]) - a
    k, side = rng.integers(len(a), size=n), rng.choice([-1, 1], (n, 1))
    place = a[k] + rng.uniform(0, 1, (n, 1)) * e[k]
    place += away * unit(np.cross(e[k], rng.normal(size=(n, 3))))
    d = side * unit(e[k])
    return place - rng.uniform(0, 2.5, (n, 1)) * d, d


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("tolerance", [1e-4, 1e-7])
@pytest.mark.parametrize("name", ["triangle", "wavy", "holes", "coil", "spiky"])
def test_hostile_rays_end(name: str, tolerance: float, precision: str) -> None:
    """Rays along edges, along flat parts of the surface, and at vertices."""
    loops = CURVES[name]
    rng = np.random.default_rng(12)
    a = np.concatenate(loops)
    o = 3 * unit(rng.normal(size=(200, 3)))
    rays = [(o, unit(a[rng.integers(len(a), size=200)] - o))]
    rays += [rays_along(loops, away, 200) for away in (0, 1e-8, 1e-6, 1e-4, 1e-3)]
    ends = [
        hk.trace(hk.SolidAngle(loops), *pair, tolerance=tolerance, precision=precision)
        for pair in rays
    ]
    for end in ends:
        assert (end.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    # Aimed at the curve, within the tolerance of which every level is.
    assert all(end.is_hit.all() for end in ends[: 4 if tolerance == 1e-4 else 1])


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "away"),
    [("wavy", 1e-3), ("triangle", 2e-3), ("spiky", 2e-3), ("coil", 1e-3),
     pytest.param("triangle", 1e-4, marks=pytest.mark.slow),
     pytest.param("holes", 3e-4, marks=pytest.mark.slow)],
)  # fmt: skip
def test_no_hit_is_missed_along_the_curve(name: str, away: float) -> None:
    """Against dense sampling: the tolerance is small, so that rays do not end at once."""
    loops = CURVES[name]
    o, d = rays_along(loops, away, 40)
    d[::2] = unit(d[::2] + 0.02 * np.random.default_rng(14).normal(size=(20, 3)))
    end = hk.trace(hk.SolidAngle(loops), o, d, t_max=4.0, tolerance=1e-7, precision="double")
    found = first_crossings(
        CurveOracle(loops), o, d, 0.0, 4.0,
        levels=[2 * math.pi], period=FOUR_PI, depth=1e-6, spacing=0.2, finest=1e-5,
    )  # fmt: skip
    assert np.isfinite(found.beyond).any()
    proved = np.where(end.status == int(hk.RayStatus.MISS), 4.0, end.t)
    assert (proved <= found.beyond + 1e-6).all()
    look = CurveOracle(loops)(end.position[end.is_hit])
    gap = gap_to_levels(look.value, [2 * math.pi], FOUR_PI)
    assert (gap <= 2e-7 * look.gradient_norm).all()


@pytest.mark.parametrize("name", ["trefoil", "wavy", "link"])
def test_curves_far_from_the_origin_can_be_traced(name: str) -> None:
    """At 2e4 times their size single precision tells places 1e-3 apart."""
    rng = np.random.default_rng(13)
    shift = 2e4 * unit(rng.normal(size=3))
    loops = [loop + shift for loop in CURVES[name]]
    o, d = aimed_at(loops, 1600)
    one, two = (hk.trace(hk.SolidAngle(loops), o, d, precision=p) for p in PRECISIONS)  # type: ignore[arg-type]
    assert (two.status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    # Hits are as near the surface as rounding lets anyone know, and no surface is passed.
    look = CurveOracle(loops)(two.position[two.is_hit].astype(float))
    gap = gap_to_levels(look.value, [2 * math.pi], FOUR_PI)
    assert (gap <= 0.03 * look.gradient_norm).all()
    both = one.is_hit & two.is_hit
    assert (two.t[both] - one.t[both] < 0.02).all()
    assert (one.is_hit & ~two.is_hit).sum() < 8  # within as much of the surface's border


@pytest.mark.parametrize("scale", [1.0, 1e30, 9e99])
@pytest.mark.parametrize("level", [1.0, 2 * math.pi, 3.0])
def test_extents_at_any_scale_are_found_without_warnings(scale: float, level: float) -> None:
    x = example_curves.wavy_polygon(12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, plain = (hk.SolidAngle(s * x).extent((level,)) for s in (scale, 1.0))
    assert found is not None
    assert plain is not None
    np.testing.assert_allclose(np.array(found.bounds()) / scale, plain.bounds(), rtol=1e-6)
