"""Cells of near edges and one polynomial: its formulas, its bounds, and rays through cells."""

# Harmonics have degree j.

from __future__ import annotations

import itertools
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import Precision, choose_backend, to_numpy, to_vector3
from harnack.backend.record_table import RecordTable
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.solid_angles.cell_options import NO_CELLS
from harnack.fmm import curve_cell_builder
from harnack.fmm.edge_expansion import (
    _TERM_ROUNDING,  # pyright: ignore[reportPrivateUsage]
    COEFFICIENTS,
    DEGREE,
    EdgeExpansions,
    _rotated_coefficients,  # pyright: ignore[reportPrivateUsage]
)
from harnack.fmm.edge_runs import CellEdges, EdgeRuns, VertexTable, subtract_runs
from harnack.fmm.local_expansion import (
    _AbsoluteValues,  # pyright: ignore[reportPrivateUsage]
    coefficient_keys,
    evaluate_expansion,
    irregular_harmonics,
    local_to_local_matrices,
    rounding_tables,
)
from harnack.geometry import example_curves
from tests.oracles.direct_sums import winding_sum

PERIOD = 4 * math.pi
RNG = np.random.default_rng(7)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def wavy(n: int) -> np.ndarray:
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(t), np.sin(t), 0.45 * np.cos(3 * t)], axis=1)


def collinear() -> np.ndarray:
    """A long rod, its long sides cut into very different edges."""
    t = np.array([0, 1e-3, 0.01, 0.3, 0.31, 0.7, 1.0])
    there = np.stack([2 * t - 1, 0 * t, 0 * t], axis=1)
    back = np.stack([1 - 2 * t, 0 * t + 0.05, 0.02 + 0 * t], axis=1)
    return np.concatenate([there, back])


CURVES: dict[str, Any] = {
    "wavy": wavy(96),
    "trefoil": example_curves.torus_knot(2, 3, 120),
    "coil": example_curves.coil(5, 160, height=0.4),
    "link": example_curves.hopf_link(40),
    "rings": example_curves.borromean_rings(30),
    "random": example_curves.random_closed_curve(RNG, 60),
    "spiky": example_curves.spiky_polygon(RNG, 33),
    "twice": [wavy(50), wavy(50)],
    "twice in one": np.concatenate([wavy(30), wavy(30)]),
    "rod": collinear(),
    "triangle": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.4]]),
    "flat": example_curves.regular_polygon(40),
    "holes": example_curves.square_with_holes(24),
    "there and back": np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [2, 1, 0], [1, 1, 0.2], [0, 1, 0]]
    ),
}
SOME = ("wavy", "trefoil", "coil", "twice", "rod", "holes")


def loops_of(curve: Any) -> list[np.ndarray]:
    return [
        np.asarray(one, dtype=np.float64) for one in (curve if isinstance(curve, list) else [curve])
    ]


def angle_of(curve: Any) -> Any:
    """The solid angle by fans of triangles, modulo 4 pi."""
    fans: list[np.ndarray] = []
    for loop in loops_of(curve):
        apex = np.broadcast_to(loop.mean(axis=0) + 0.123, loop.shape)
        fans.append(np.stack([apex, loop, np.roll(loop, -1, axis=0)], axis=1))
    of_fans = winding_sum(np.concatenate(fans))
    return lambda x: PERIOD * of_fans(x)


def wrapped(difference: np.ndarray) -> np.ndarray:
    return difference - PERIOD * np.round(difference / PERIOD)


def expanded(points: np.ndarray, start: list[int], end: list[int], radius: float) -> EdgeExpansions:
    backend = choose_backend("double")
    rows = RecordTable.upload(backend, np.column_stack([points, np.zeros((len(points), 5))]))
    edges = CellEdges(np.array(start), np.array(end), np.zeros(len(start), np.int64))
    return EdgeExpansions.of(rows, edges, backend.Array3f(0.0), dr.opaque(backend.Float, radius), 1)


@pytest.mark.parametrize("q", [0.1, 1 / 3, 0.5])
def test_far_loops_are_polynomials(q: float) -> None:
    """In value and gradient, for edges short and long."""
    rng = np.random.default_rng(1)
    for n in (3, 7, 40):
        loop = unit(np.cumsum(rng.normal(size=(n, 3)), axis=0) + 4 * rng.normal(size=3))
        backend = choose_backend("double")
        curve = hk.SolidAngle(loop)
        nearest = curve.boundary.closest_point(backend.Array3f(0.0))
        radius = q * float(to_numpy(dr.norm(nearest))[0])
        found = expanded(loop, [*range(n)], [*range(1, n), 0], radius)
        u = unit(rng.normal(size=(500, 3)))
        f, *g = evaluate_expansion(found.coefficients[0], [*u.T], DEGREE)
        off = np.abs(wrapped(f - angle_of(loop)(radius * u)))
        true = hk.SolidAngle(loop).gradient(radius * u, precision="double")
        steep = np.linalg.norm(np.stack(g, axis=1) / radius - true, axis=1)
        assert off.max() <= found.error[0] + 1e-12
        assert steep.max() <= found.slope[0] + 1e-10


def of_one_edge(a: np.ndarray, e: np.ndarray, u: np.ndarray) -> np.ndarray:
    """g of `edge_expansion` at points u, for a short edge."""
    s, w = np.polynomial.legendre.leggauss(40)
    s, w = 0.5 * (s + 1), 0.5 * w
    d = a + 0.5 * e
    reach = np.linalg.norm(d - s[:, None, None] * u, axis=2)
    return (u @ np.cross(d, e)) * (w[:, None] / reach**3).sum(axis=0)


@pytest.mark.parametrize("q", [0.1, 0.25, 1 / 3])
def test_the_tail_is_attained(q: float) -> None:
    """Half of it would be too little, for an edge across the direction to it."""
    a, e = np.array([0, 0, 1.0]), np.array([1e-6, 0, 0])
    found = expanded(np.stack([a, a + e]), [0], [1], q)
    angle, turn = np.meshgrid(np.linspace(0, np.pi, 200), np.linspace(0, np.pi, 41))
    u = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)
    u = u.reshape(-1, 3)
    f, *_ = evaluate_expansion([0.0, *found.coefficients[0, 1:]], [*u.T], DEGREE)
    used = np.abs(f - of_one_edge(a, e, q * u)).max() / (found.error[0] - 2.0**-36)
    assert 0.5 < used <= 1


def test_rounding_of_polynomials_is_below_what_is_counted() -> None:
    """`_EdgePiece.sums`: the sums of absolute values, all coordinates as large as can be."""
    one, q = _AbsoluteValues(np.array(1.0)), 0.5

    class Ones:
        x = y = z = one

    phi = {key: list(pair) for key, pair in irregular_harmonics(one, one, one, one, DEGREE).items()}
    phi = {
        key: [
            part if isinstance(part, _AbsoluteValues) else _AbsoluteValues(np.array(part))
            for part in pair
        ]
        for key, pair in phi.items()
    }
    sizes = [float(part.number) for part in _rotated_coefficients(phi, Ones(), q)]  # pyright: ignore[reportArgumentType]
    roundings = 0.51 * (9 * DEGREE + 2 * COEFFICIENTS)
    harmonics = rounding_tables(DEGREE, 1.0) / roundings
    assert (np.array(sizes) @ harmonics[1:]).max() < 2**14
    assert _TERM_ROUNDING >= 2.0**-53 * 2**9 * 2**14


def test_polynomials_move_with_cells() -> None:
    rng = np.random.default_rng(2)
    given = EdgeExpansions(rng.normal(size=(1, COEFFICIENTS)), np.ones(1), np.ones(1))
    shifts = local_to_local_matrices(DEGREE, 0.28)
    found = given.to_octants(np.array([True]), shifts, 1.0)
    u = 0.3 * rng.normal(size=3)
    before = evaluate_expansion(given.coefficients[0], u, DEGREE)[0]
    for k, corner in enumerate(itertools.product((-0.28, 0.28), repeat=3)):
        after = evaluate_expansion(found.coefficients[k], 2 * (u - corner), DEGREE)[0]
        assert abs(after - before) < 1e-12
    assert (found.error >= 1).all()
    assert (found.error < 1 + 1e-10).all()
    assert len(coefficient_keys(DEGREE)) == COEFFICIENTS


@pytest.mark.parametrize("name", CURVES)
def test_what_is_left_over_is_a_cycle_far_away(name: str) -> None:
    """Runs hold the near edges, closed runs and what is left over enter each vertex as often as
    they leave it, and what is left over is no nearer than closing edges may be."""
    rng = np.random.default_rng(3)
    loops = [loop - loop.mean() for loop in loops_of(CURVES[name])]
    table = VertexTable.of(tuple(loops))
    before = EdgeRuns.of_loops(table)
    centers = np.array([np.concatenate(loops)[rng.integers(3)] + 0.1 * rng.normal(size=3)])
    for radius in (0.5, 0.25, 0.1, 0.03):
        run, place = before.edges()
        p, q = table.points[place], table.points[place + 1]
        distance = to_segments(centers[0], p, q)
        after, kept = before.restrict_to_near(run, distance <= radius)
        after = after.with_apexes(table, centers, np.array([radius]), np.dtype(np.float64))
        assert kept[distance <= radius].all()
        left = subtract_runs(before, (run, place), kept, after, len(table.points))
        points = np.concatenate([table.points, before.apex, after.apex])
        degree: dict[bytes, int] = {}
        for at, sign in ((left.start, 1), (left.end, -1)):
            for vertex in points[at]:
                degree[vertex.tobytes()] = degree.get(vertex.tobytes(), 0) + sign
        assert not any(degree.values())
        if len(left.start):
            nearest = to_segments(centers[0], points[left.start], points[left.end])
            assert nearest.min() >= 0.92 * radius
        assert len(run) == before.count.sum()
        before = after


def to_segments(x: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    e = q - p
    share = ((x - p) * e).sum(axis=1) / np.maximum((e * e).sum(axis=1), 1e-300)
    return np.linalg.norm(p + np.clip(share, 0, 1)[:, None] * e - x, axis=1)


def places(curve: Any, n: int, seed: int) -> np.ndarray:
    """Everywhere, and near the curve at all distances; numbers of single precision."""
    rng = np.random.default_rng(seed)
    loops = loops_of(curve)
    vertices = np.concatenate(loops)
    following = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    k, t = rng.integers(len(vertices), size=n), rng.random((n, 1))
    size = np.ptp(vertices, axis=0).max()
    x = (1 - t) * vertices[k] + t * following[k]
    x = x + size * 10 ** rng.uniform(-4, 0.2, (n, 1)) * unit(rng.normal(size=(n, 3)))
    return x.astype(np.float32).astype(np.float64)


def sampled(field: hk.SolidAngle, x: np.ndarray, precision: Precision, plan: Plan = POINTS) -> Any:
    backend = choose_backend(precision)
    sample = field.evaluator(backend, plan).evaluate(to_vector3(backend, x))
    numbers = (
        sample.value,
        sample.gradient,
        sample.value_error,
        sample.gradient_error,
        sample.truncation_error,
    )
    numbers = tuple(backend.Float(one) if isinstance(one, float) else one for one in numbers)
    dr.eval(*numbers)
    return tuple(to_numpy(one).astype(np.float64) for one in numbers)


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", CURVES)
def test_errors_are_bounded(name: str, precision: Precision) -> None:
    curve = [loop.astype(np.float32) for loop in loops_of(CURVES[name])]
    x = places(curve, 6000, 4)
    field = hk.SolidAngle(curve, cells=True)
    found, slope, error, slope_error, truncation = sampled(field, x, precision)
    assert (truncation <= error).all()
    gradient = hk.SolidAngle(curve).gradient(x, precision="double")
    steep = np.linalg.norm(gradient, axis=1)
    # The bounds leave out the rounding of the point itself.
    point = 8 * choose_backend(precision).machine_epsilon * (1 + np.abs(x).max(axis=1))
    off = np.abs(wrapped(found - angle_of(curve)(x))) - point * steep
    assert (off <= error + 1e-9).all()
    off = np.linalg.norm(slope - gradient, axis=1)
    distance = np.full(len(x), np.inf)
    for loop in curve:
        for p, q in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            e, a = (q - p).astype(float), x - p
            share = np.clip((a @ e) / max(e @ e, 1e-300), 0, 1)
            distance = np.minimum(distance, np.linalg.norm(a - share[:, None] * e, axis=1))
    rounding = (1e-5 if precision == "single" else 1e-12) + 8 * point / distance
    clear = distance > 100 * point
    scale = np.linalg.norm(gradient, axis=1) + 1 / distance
    assert (off <= slope_error + rounding * scale)[clear].all()


def table_of(field: hk.SolidAngle, precision: Precision = "single") -> tuple[Any, np.ndarray]:
    """The cells of a field on a backend, and the numbers of their records."""
    on = field.evaluator(choose_backend(precision)).data
    assert on.cells is not None
    cells = on.cells
    return cells, to_numpy(cells.records.buffer).reshape(cells.count, -1).astype(np.float64)


def test_samples_cost_what_is_near() -> None:
    """Eight times as many edges are a few more near ones in each cell."""
    mean: list[float] = []
    for n in (64, 512):
        cells, table = table_of(hk.SolidAngle(wavy(n), cells=True))
        assert cells.size < 12e6
        mean.append(table[:, 14].mean())
    assert mean[0] < mean[1] < 4


@pytest.mark.parametrize("name", ["wavy", "trefoil", "link", "rod"])
def test_promises_hold(name: str) -> None:
    """Second derivatives near points, and rates along lines that run along edges."""
    curve, n = CURVES[name], 4000
    o, d = rays(curve, n, 8)
    rng = np.random.default_rng(9)
    x = np.concatenate([places(curve, n // 2, 8), o[n // 2 :] + 0.3 * d[n // 2 :]])
    x = x.astype(np.float32).astype(np.float64)
    backend = choose_backend("double")
    evaluator = hk.SolidAngle(curve, cells=True).evaluator(backend)
    p, v = to_vector3(backend, x), to_vector3(backend, d)
    sample = evaluator._sample(p, v)
    known = [(one.radius, one.constant) for one in (*sample.promises, *sample.ray_promises)]
    dr.eval(sample.value, sample.gradient, known)
    value, gradient = to_numpy(sample.value), to_numpy(sample.gradient)
    exact = hk.SolidAngle(curve)
    bends, found = len(sample.promises), 0
    for k, (radius, constant) in enumerate(known):
        radius = np.minimum(to_numpy(radius + 0 * p.x), 1e3)
        constant = to_numpy(constant + 0 * p.x)
        way = unit(rng.normal(size=(n, 3))) if k < bends else d
        for share in (0.1, 0.5, 0.99):
            t = share * radius
            y = x + t[:, None] * way
            move = wrapped(exact.value(y, precision="double") - exact.value(x, precision="double"))
            slope = (exact.gradient(x, precision="double") * way).sum(axis=1)
            most = 0.5 * constant * t * t if k < bends else constant * t
            off = np.abs(move - slope * t) if k < bends else np.abs(move)
            if k >= bends:  # a change of more than a half period is not seen by values
                off = np.where(most < 0.5 * PERIOD, off, 0)
            off = np.minimum(off, np.abs(off - PERIOD))
            assert (off <= most + 1e-6 * (1 + np.abs(slope) * t)).all()
            found += int((np.isfinite(most) & (most < PERIOD)).sum())
    assert np.isfinite(value).all()
    assert gradient.shape == (n, 3)
    assert found > n


def test_the_bound_of_bending_is_attained() -> None:
    """Steps in cells are proved by the integral of |dp|/D^3. At centers it is that of all edges,
    but for the part of a thousandth that is added for rounding: a 500th less would be too little,
    in cells of far edges as in cells of near ones."""
    backend = choose_backend("double")
    on = hk.SolidAngle(wavy(100), cells=True).evaluator(backend).data
    assert on.cells is not None
    table = to_numpy(on.cells.records.buffer).reshape(on.cells.count, -1)
    x = to_vector3(backend, table[:, :3])
    found, in_cells = on.cells.sums(x, dr.full(backend.Bool, True, on.cells.count))
    used = to_numpy(found.sums.inverse_cubes) / to_numpy(on.sums(x)[0].inverse_cubes)
    assert to_numpy(in_cells).all()
    assert used.min() >= 1 - 1e-9
    for count in (table[:, 14] == 0, table[:, 14] > 0):
        assert used[count].min() < 1.0011


def compare(curve: Any, o: np.ndarray, d: np.ndarray, **settings: Any) -> None:
    """Rays with cells end as those without, but for grazes within the tolerance."""
    settings = {"tolerance": 1e-4, **settings}
    hits = hk.trace(hk.SolidAngle(curve, cells=True), o, d, **settings)
    plain = hk.trace(hk.SolidAngle(curve, cells=False), o, d, **settings)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    assert (plain.is_hit != hits.is_hit).mean() < 2e-3
    value, exact = angle_of(curve), hk.SolidAngle(curve)
    near = 1.3e-4 + 1e-6 * np.abs(o).max()
    for these, others in ((plain, hits), (hits, plain)):
        early = np.flatnonzero(these.is_hit & ~(others.t < these.t + 10 * near))
        assert len(early) < 0.02 * len(o)
        if len(early):
            x = o[early] + these.t[early, None] * d[early]
            steep = np.linalg.norm(exact.gradient(x, precision="double"), axis=1)
            off = np.abs(wrapped(value(x) - 2 * math.pi))
            clear = steep < 0.1 / near
            assert (off <= (2 * near + these.uncertainty[early]) * steep + 1e-4)[clear].all()


def rays(curve: Any, n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """From outside and inside; anywhere, and closely past the curve, also along its edges."""
    rng = np.random.default_rng(seed)
    vertices = np.concatenate(loops_of(curve))
    center, size = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    o = center + 1.2 * size * unit(rng.normal(size=(n, 3)))
    o[: n // 4] = center + 0.4 * size * rng.uniform(-1, 1, (n // 4, 3))
    target = center + 0.6 * size * rng.uniform(-1, 1, (n, 3))
    target[n // 2 :] = places(curve, n - n // 2, seed)
    d = unit(target - o)
    along = n // 8
    first = loops_of(curve)[0]
    k = rng.integers(len(first), size=along)
    e = np.roll(first, -1, axis=0)[k] - first[k]
    keep = np.linalg.norm(e, axis=1) > 0
    o[-along:][keep] = (first[k] - 2 * e + 1e-4 * size * rng.normal(size=e.shape))[keep]
    d[-along:][keep] = unit(e[keep])
    return o.astype(np.float32).astype(np.float64), d


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", SOME)
def test_rays_end_as_without_cells(name: str, precision: Precision) -> None:
    compare(CURVES[name], *rays(CURVES[name], 2000), precision=precision)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CURVES, "fine"])
def test_many_rays_end_as_without_cells(name: str) -> None:
    curve = CURVES.get(name, wavy(1024))
    compare(curve, *rays(curve, 40_000, 5), precision="single")
    compare(curve, *rays(curve, 8_000, 6), precision="double", tolerance=1e-7)


@pytest.mark.parametrize("shift", [0.0, 1024.0])
def test_rays_along_faces_and_through_corners_of_cells(shift: float) -> None:
    """Also far from the origin."""
    curve = (wavy(96) + shift).astype(np.float32).astype(np.float64)
    field = hk.SolidAngle(curve, cells=True)
    cells, table = table_of(field)
    rng = np.random.default_rng(4)
    chosen = table[rng.integers(cells.count, size=2000)]
    away = rng.choice([-1, 1], (2000, 3)) / (1.004 * math.sqrt(3)) / chosen[:, 3:4]
    corner = field._center + field._size * (chosen[:, :3] + away)
    d = np.eye(3)[rng.integers(3, size=2000)]
    d[1000:] = unit(rng.choice([-1.0, 1.0], (1000, 3)))
    compare(curve, corner - 3 * d, d, precision="single")


def test_levels_and_tolerances_that_cells_do_not_reach() -> None:
    """Other levels lie outside of the cube in part; small tolerances need all edges."""
    o, d = rays(CURVES["trefoil"], 2000)
    for level, tolerance in ((1.0, 1e-4), (None, 1e-6)):
        settings: dict[str, Any] = {"tolerance": tolerance, "precision": "single"}
        plain = hk.trace(hk.SolidAngle(CURVES["trefoil"]), o, d, level=level, **settings)
        field = hk.SolidAngle(CURVES["trefoil"], cells=True)
        hits = hk.trace(field, o, d, level=level, **settings)
        both = plain.is_hit & hits.is_hit
        assert (plain.is_hit != hits.is_hit).mean() < 2e-3
        assert np.quantile(np.abs(plain.t[both] - hits.t[both]), 0.9) < 2e-4


def test_values_and_derivatives_are_those_of_all_edges() -> None:
    curve, x = CURVES["trefoil"], places(CURVES["trefoil"], 300, 5)
    plain, field = hk.SolidAngle(curve), hk.SolidAngle(curve, cells=True)
    field.evaluator(choose_backend("single"))
    for derivative in ("value", "gradient", "hessian"):
        by_cells, by_edges = (
            getattr(each, derivative)(x, precision="single") for each in (field, plain)
        )
        np.testing.assert_array_equal(by_cells, by_edges)
    o, d = rays(curve, 400)
    backend = choose_backend("double")
    level = backend.Float(2.0)
    dr.enable_grad(level)
    given = to_vector3(backend, o), to_vector3(backend, d)
    t = hk.trace(field, *given, level=level, tolerance=1e-8).t
    dr.forward(level)
    found = to_numpy(dr.grad(t))
    hits = hk.trace(plain, o, d, level=2.0, precision="double", tolerance=1e-8)
    x = o[hits.is_hit] + hits.t[hits.is_hit, None] * d[hits.is_hit]
    slope = (plain.gradient(x, precision="double") * d[hits.is_hit]).sum(axis=1)
    steady = np.abs(slope) > 0.5
    np.testing.assert_allclose(found[hits.is_hit][steady] * slope[steady], 1.0, atol=0.01)


def test_circles_beside_cells() -> None:
    loops = [wavy(64), hk.geometry.Circle(0.4, normal=(0, 0, -1))]
    o, d = rays(wavy(64), 2000)
    plain, hits = (
        hk.trace(hk.SolidAngle(loops, cells=cells), o, d, tolerance=1e-4, precision="single")
        for cells in (False, True)
    )
    assert (plain.is_hit != hits.is_hit).mean() < 2e-3
    both = plain.is_hit & hits.is_hit
    assert np.quantile(np.abs(plain.t[both] - hits.t[both]), 0.98) < 1e-3


def test_memory_is_bounded_and_stated() -> None:
    curve = wavy(400)
    x = places(curve, 2000, 5)
    truth = angle_of(curve)(x)
    sizes: list[int] = []
    for megabytes in (True, 3.0, 1.0, 0.01):
        field = hk.SolidAngle(curve, cells=megabytes)
        evaluator = field.evaluator(choose_backend("double"))
        cells, said = evaluator.data.cells, evaluator.describe()["cells"]
        if cells is None:
            sizes.append(0)
            assert said == "none, as they need more memory"
        else:
            sizes.append(cells.size)
            assert cells.size <= 1e6 * (256 if megabytes is True else megabytes)
            assert said == f"{cells.count} of {cells.size / 1e6:.1f} MB"
        found, _, error, *_ = sampled(field, x, "double")
        assert (np.abs(wrapped(found - truth)) <= error + 1e-9).all()
    assert sizes[0] > sizes[1] > sizes[2] > sizes[3] == 0
    assert "cells" not in hk.SolidAngle(curve, cells=False).describe()
    assert hk.SolidAngle(curve).describe()["cells"] == "from 1,000,000 rays on"


def test_many_rays_get_cells_by_themselves() -> None:
    assert hk.SolidAngle(wavy(100)).describe()["cells"] == "from 2,500,000 rays on"
    curve = wavy(1000)
    field = hk.SolidAngle(curve)
    assert field.cell_choice(999_999) == NO_CELLS
    with_cells = field.cell_choice(1_000_000)
    assert with_cells.max_bytes == 256e6
    assert field.cell_choice(10**8) == with_cells
    assert field.cells is None
    vector = choose_backend("single").Array3f
    for one in (
        hk.SolidAngle(wavy(47)),
        hk.SolidAngle(curve, cells=False),
        hk.SolidAngle(curve, lift_bound="paper"),
        hk.SolidAngle(vector(*curve.T)),
        hk.SolidAngle(hk.geometry.Circle(1.0, (0, 0, 0), (0, 0, 1))),
    ):
        evaluator = one.evaluator(choose_backend("single"), Plan(ray_count=10**9))
        assert evaluator.data.cells is None
        assert evaluator.variable_accuracy is None
    backend = choose_backend("double")
    assert field.evaluator(backend, Plan(ray_count=999_999)).data.cells is None
    many = field.evaluator(backend, Plan(ray_count=1_000_000))
    assert many.data.cells is not None
    assert many.variable_accuracy is not None
    assert field.evaluator(backend, Plan(ray_count=10**8)).data is many.data
    x = places(curve, 500, 6)
    found, _, error, *_ = sampled(field, x, "double", Plan(ray_count=1_000_000))
    assert (np.abs(wrapped(found - angle_of(curve)(x))) <= error + 1e-9).all()


def test_loops_of_a_field_cannot_be_replaced() -> None:
    """Neither as a whole nor in place: what was computed from them would stay, and be traced."""
    given = wavy(50)
    field = hk.SolidAngle(given)
    with pytest.raises(AttributeError, match="loops"):
        field.loops = (2 * given,)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match="read-only"):
        field.loops[0][:] *= 2
    given *= 2  # the caller's own
    assert field.loops[0].max() < 1.01
    assert field.evaluator(choose_backend("single"), Plan(ray_count=10**8)).field is field


@pytest.mark.parametrize("cells", [-1.0, math.inf, math.nan, "yes", [1]])
def test_cells_is_a_number_of_megabytes(cells: Any) -> None:
    with pytest.raises(ValueError, match="megabytes"):
        hk.SolidAngle(wavy(20), cells=cells)


def test_vertices_that_may_move_have_no_cells() -> None:
    loop = to_vector3(choose_backend("single"), wavy(20))
    with pytest.raises(ValueError, match="cells are of curves that stay as they are"):
        hk.SolidAngle(loop, cells=True)


def test_errors_are_attained_in_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of the error would be too little in some cell: all its edges add up in size, and
    what they leave out only in part."""
    monkeypatch.setattr(curve_cell_builder, "_MAX_TAIL_RATIO", 1e-3)
    curve = wavy(200)
    field = hk.SolidAngle(curve, cells=True)
    _, table = table_of(field, "double")
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) / math.sqrt(3) / 1.0041
    x = (table[:, None, :3] + corners / table[:, None, 3:4]).reshape(-1, 3)
    x = field._center + field._size * x
    found, _, _, _, truncation = sampled(field, x, "double")
    some = truncation > 1e-6
    used = np.abs(wrapped(found - angle_of(curve)(x)))[some] / truncation[some]
    assert 0.125 < used.max() <= 1
