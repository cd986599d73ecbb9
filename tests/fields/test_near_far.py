"""Cells of near dipoles and one polynomial: its formulas, its bounds, and rays through cells."""

# Harmonics have degree l.
# ruff: noqa: E741

from __future__ import annotations

import copy
import itertools
import math
import pickle
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import Precision, choose_backend, to_numpy, to_vector3
from harnack.fields.evaluator import Plan
from harnack.fields.solid_angles import dipole, solid_angle
from harnack.fields.solid_angles.cell_options import NO_CELLS
from harnack.fmm import dipole_cells
from harnack.fmm.dipole_expansion import COEFFICIENTS, DEGREE
from harnack.fmm.local_expansion import (
    _AbsoluteValues,  # pyright: ignore[reportPrivateUsage]
    coefficient_keys,
    evaluate_expansion,
    irregular_harmonics,
    local_to_local_matrices,
    multipole_to_local,
    rounding_tables,
    tail_factors,
)
from harnack.fmm.multipole import dipole_moments, regular_harmonics
from harnack.geometry import example_curves
from harnack.testing import check_field
from tests.oracles.direct_sums import dipole_sum
from tests.tracer.test_cloud_hits import Cloud, cloud, rays, unit


def moments_of(d: np.ndarray, n: np.ndarray, largest: int) -> Any:
    total: Any = {}
    for at, normal in zip(d, n, strict=True):
        for key, (re, im) in dipole_moments(regular_harmonics(*at, 4), *normal).items():
            if key[0] <= largest:
                old = total.get(key, (0.0, 0.0))
                total[key] = old[0] + re, old[1] + im
    return total


def expanded(r: np.ndarray, moments: Any, degree: int) -> np.ndarray:
    largest = max(key[0] for key in moments)
    seen = irregular_harmonics(*r, 1 / np.linalg.norm(r), degree + largest)
    return np.array(multipole_to_local(moments, seen, degree))


def test_expansions_are_the_sum_over_dipoles() -> None:
    rng = np.random.default_rng(0)
    d, n, r = 0.1 * rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), np.array([2.0, 1.5, -2.2])
    found = expanded(r, moments_of(d, n, 5), 10)
    u = 0.2 * unit(rng.normal(size=(50, 3)))
    value, gradient = dipole_sum(d, n)(r + u)
    for k, at in enumerate(u):
        f, *g = evaluate_expansion(found, at, 10)
        np.testing.assert_allclose([f, *g], [value[k], *gradient[k]], atol=2e-5)


def test_shifts_are_exact() -> None:
    rng = np.random.default_rng(1)
    given, u = rng.normal(size=COEFFICIENTS), rng.uniform(-0.5, 0.5, 3)
    before = np.array(evaluate_expansion(given, u, DEGREE))
    corners = itertools.product((-0.28, 0.28), repeat=3)
    for matrix, corner in zip(local_to_local_matrices(DEGREE, 0.28), corners, strict=True):
        after = evaluate_expansion(matrix @ given, 2 * (u - corner), DEGREE)
        np.testing.assert_allclose(after, before * [1, 0.5, 0.5, 0.5], atol=1e-12)


@pytest.mark.parametrize("q", [0.1, 0.25, 1 / 3, 0.4])
def test_the_tail_of_a_dipole_is_bounded_and_attained(q: float) -> None:
    """By one that points to the center of the ball, at the point of the ball nearest to it."""
    at, normal = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    r = np.array([0.0, 0.0, 1.0])
    found = expanded(r, moments_of(at, normal, 1), DEGREE)
    factor, ratio = tail_factors(DEGREE, 1)
    error = factor * q ** (DEGREE + 1) / (1 - ratio * q)
    steeper = ratio * (DEGREE + 2) / (DEGREE + 1)
    slope = (DEGREE + 1) * factor * q**DEGREE / (1 - steeper * q)
    rng = np.random.default_rng(2)
    u = q * np.concatenate([[[0, 0, -1.0]], unit(rng.normal(size=(300, 3)))])
    value, gradient = dipole_sum(at, normal)(r + u)
    off = np.array([evaluate_expansion(found, one, DEGREE) for one in u])
    used = np.abs(off[:, 0] - value) / error
    steep = np.linalg.norm(off[:, 1:] - gradient, axis=1) / slope
    assert used.max() <= 1 + 1e-6
    assert steep.max() <= 1 + 1e-6
    assert used[0] > 0.95
    assert steep[0] > 0.9


def test_rounding_of_expansions_is_below_what_is_counted() -> None:
    """`far_sums._ClusterExpansion.of`: the sums of absolute values, all coordinates as large as can
    be."""
    q = 1 / dipole_cells._NEAR
    ones = [_AbsoluteValues(np.array(1.0))] * 3
    for largest in (1, 2, 3, 4):
        seen = irregular_harmonics(*ones, _AbsoluteValues(np.array(1.0)), DEGREE + largest)
        keys = [(largest, m) for m in range(largest + 1)]
        moments: Any = {(l, m): (0.0, 0.0) for l in range(1, largest) for m in range(l + 1)}
        for l, m in keys:
            size = _AbsoluteValues(
                np.array(1 / math.sqrt(math.factorial(l + m) * math.factorial(l - m)))
            )
            moments[l, m] = size, size
        found = multipole_to_local(moments, seen, DEGREE)
        powers = [
            one.number * q**j
            for (j, _, _), one in zip(coefficient_keys(DEGREE), found, strict=True)
        ]
        harmonics = rounding_tables(DEGREE, 1 / math.sqrt(3))
        roundings = 0.51 * (9 * DEGREE + 2 * COEFFICIENTS)
        assert (powers @ harmonics / roundings).max() < 2**23


def sampled(field: hk.DipolePotential, x: np.ndarray, precision: Precision) -> Any:
    backend = choose_backend(precision)
    sample = field.evaluator(backend).evaluate(to_vector3(backend, x))
    dr.eval(sample.value, sample.gradient, sample.value_error, sample.gradient_error)
    numbers = sample.value, sample.gradient, sample.value_error, sample.gradient_error
    return tuple(to_numpy(one).astype(np.float64) for one in numbers)


def places(some: Cloud, n: int, seed: int) -> np.ndarray:
    """Everywhere, and near the points at all distances; numbers of single precision."""
    rng = np.random.default_rng(seed)
    near = some[0][rng.integers(len(some[0]), size=n)]
    x = near + 10 ** rng.uniform(-4, 0.3, (n, 1)) * unit(rng.normal(size=(n, 3)))
    return x.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize(
    ("n", "count"), [(300, 20_000), pytest.param(5000, 100_000, marks=pytest.mark.slow)]
)
def test_errors_are_bounded(n: int, count: int, precision: Precision) -> None:
    some = cloud(n)
    x = places(some, count, 3)
    value, gradient = dipole_sum(some[0], some[1] * some[2][:, None])(x)
    found, slope, error, slope_error = sampled(hk.DipolePotential(*some, cells=True), x, precision)
    # The bounds leave out the rounding of the point itself.
    point = 4 * choose_backend(precision).machine_epsilon * np.abs(x).max(axis=1)
    off = np.abs(found - value) - point * np.linalg.norm(gradient, axis=1) - 1e-6 * np.abs(value)
    assert (off <= error).all()
    known = slope_error < np.linalg.norm(slope, axis=1)
    assert known.mean() > 0.9  # far from the surface the gradient vanishes
    rounding = 1e-5 * np.linalg.norm(gradient, axis=1)
    steep = np.linalg.norm(slope - gradient, axis=1) - rounding
    assert (steep <= slope_error)[known].all()


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_errors_are_attained(part: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the error would be too little, at corners of cells towards a dipole that just misses
    being near, and half way from there to the center: with a dipole alone and in double precision,
    so that all error is truncation."""
    monkeypatch.setattr(dipole_cells, "_MOST_NEAR", 0)
    point, normal = np.full((1, 3), 0.3), unit(np.ones((1, 3)))
    field = hk.DipolePotential(point, normal, [1.0], cells=True)
    on = field.evaluator(choose_backend("double")).data
    assert isinstance(on.tree, dipole.DipoleTree)
    cells = on.tree.cells
    assert cells is not None
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners *= part / math.sqrt(3) / 1.0041
    x = (table[:, None, :3] + corners / table[:, None, 3:4]).reshape(-1, 3)
    x = field.points.mean(axis=0) + field._size * x
    value, _ = dipole_sum(point, normal)(x)
    found, _, error, _ = sampled(field, x, "double")
    used = np.abs(found - value) / error
    assert used.max() <= 1
    assert used.max() > 0.5


def test_the_bound_of_bending_is_attained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps in cells are proved by `SourceSums.s4`. Of a dipole alone it is exact at the centers of
    the cells that take it into account themselves: a thousandth less would be too little."""
    monkeypatch.setattr(dipole_cells, "_MOST_NEAR", 0)
    point = np.full((1, 3), 0.3)
    field = hk.DipolePotential(point, unit(np.ones((1, 3))), [1.0], cells=True)
    on = field.evaluator(choose_backend("double")).data
    assert isinstance(on.tree, dipole.DipoleTree)
    cells = on.tree.cells
    assert cells is not None
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1)
    far = table[:, 13] == 0  # no near dipoles
    x = to_vector3(choose_backend("double"), table[far, :3])
    sums, _, found = cells.sums(x, dr.full(dr.mask_t(x.x), True, 1), lambda *given: given[2:], ())
    assert to_numpy(found).all()
    there = (field.points - field._center) / field._size
    away = np.linalg.norm(table[far, :3] - there, axis=1)
    used = to_numpy(sums.s4) / (1.0 / field._size**2 / away**4)
    assert used.min() >= 1
    assert used.min() < 1.0005


def compare(some: Cloud, o: np.ndarray, d: np.ndarray, **settings: Any) -> None:
    """Rays with cells end as those without, but for grazes within the tolerance."""
    settings = {"tolerance": 1e-4, **settings}
    with_cells = hk.DipolePotential(*some, cells=True)
    plain = hk.trace(hk.DipolePotential(*some), o, d, **settings)
    hits = hk.trace(with_cells, o, d, **settings)
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    assert (plain.is_hit != hits.is_hit).mean() < 2e-3
    # Where one hits before the other, the level is within its tolerance there; with what single
    # precision does to positions.
    near = 1.3e-4 + 1e-6 * np.abs(o).max()
    value_at = dipole_sum(some[0], some[1] * some[2][:, None])
    for these, others in ((plain, hits), (hits, plain)):
        early = np.flatnonzero(these.is_hit & (these.t < others.t - 10 * near))
        assert len(early) < 0.02 * len(o)
        if len(early):
            x = o[early] + these.t[early, None] * d[early]
            value, gradient = value_at(x)
            far = np.linalg.norm(x[:, None] - some[0][None], axis=2).min(axis=1) > near
            off = np.abs(value - 2 * math.pi)
            assert (off <= near * np.linalg.norm(gradient, axis=1) + 1e-4)[far].all()


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize(
    ("n", "count"), [(400, 2000), pytest.param(5000, 20_000, marks=pytest.mark.slow)]
)
def test_rays_end_as_without_cells(n: int, count: int, precision: Precision) -> None:
    some = cloud(n)
    compare(some, *rays(some[0], count), precision=precision, t_max=6.0)


@pytest.mark.parametrize("shift", [0.0, 1024.0])
def test_rays_along_faces_and_through_corners_of_cells(shift: float) -> None:
    """Also far from the origin."""
    points, normals, areas = cloud(400)
    points = (points + shift).astype(np.float32).astype(np.float64)
    field = hk.DipolePotential(points, normals, areas, cells=True)
    on = field.evaluator(choose_backend("single")).data
    assert isinstance(on.tree, dipole.DipoleTree)
    cells = on.tree.cells
    assert cells is not None
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1).astype(np.float64)
    rng = np.random.default_rng(4)
    chosen = table[rng.integers(cells.count, size=1000)]
    corner = (
        chosen[:, :3] + rng.choice([-1, 1], (1000, 3)) / (1.004 * math.sqrt(3)) / chosen[:, 3:4]
    )
    corner = field._center + field._size * corner
    d = np.eye(3)[rng.integers(3, size=1000)]
    d[500:] = unit(rng.choice([-1.0, 1.0], (500, 3)))
    compare((points, normals, areas), corner - 3 * d, d, t_max=6.0, precision="single")


def test_memory_is_bounded_and_stated() -> None:
    some = cloud(3000)
    x = places(some, 2000, 5)
    value, gradient = dipole_sum(some[0], some[1] * some[2][:, None])(x)
    sizes: list[int] = []
    for megabytes in (True, 2.0, 1.2, 0.01):
        field = hk.DipolePotential(*some, cells=megabytes)
        evaluator = field.evaluator(choose_backend("single"))
        assert isinstance(evaluator.data.tree, dipole.DipoleTree)
        cells, said = evaluator.data.tree.cells, evaluator.describe()["cells"]
        if cells is None:
            sizes.append(0)
            assert said == "none, as they need more memory"
        else:
            sizes.append(cells.size)
            assert cells.size <= 1e6 * (256 if megabytes is True else megabytes)
            assert said == f"{cells.count} of {cells.size / 1e6:.1f} MB"
        found, _, error, _ = sampled(field, x, "single")
        rounding = 1e-6 * (np.abs(value) + np.linalg.norm(gradient, axis=1))
        assert (np.abs(found - value) <= error + rounding).all()
    assert sizes[0] > sizes[1] > sizes[2] > sizes[3] == 0
    assert "cells" not in hk.DipolePotential(*some, cells=False).describe()
    assert hk.DipolePotential(*some).describe()["cells"] == "from 100,000 rays on"
    for asked in (True, np.True_):
        assert hk.DipolePotential(*some, cells=asked).describe()["cells"] == "of at most 256 MB"


def test_solids_tell_their_parts_how_many_rays_there_will_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Parts of solids had no cells, however many rays there were."""
    points, normals, areas = cloud(300)
    curve = hk.SolidAngle(example_curves.torus_knot(2, 3, 60))
    knot = hk.solid(curve, around=(2 * math.pi, 0.4))
    inside = hk.solid(hk.DipolePotential(points, normals, areas), above=2 * math.pi)
    solid = (inside.scaled(2.0) - knot.translated((1.0, 0, 0))).offset(0.01)
    backend = choose_backend("single")
    assert knot.evaluator(backend, Plan(ray_count=1000)).variable_accuracy is None
    assert knot.evaluator(backend, Plan(ray_count=10**8)).variable_accuracy is not None
    o = np.random.default_rng(3).normal(size=(2000, 3)) * 0.2 + [0.0, 0.0, 6.0]
    d = np.random.default_rng(4).uniform(-2, 2, (2000, 3)) - o
    hits = hk.trace(solid, o, d, tolerance=1e-4, precision="single")
    calls = builds(monkeypatch)
    monkeypatch.setattr(dipole, "_LEAST_RAYS", 1000)
    monkeypatch.setattr(dipole, "_PAYS", 1)
    monkeypatch.setattr(solid_angle, "_MIN_RAYS", 1000)
    monkeypatch.setattr(solid_angle, "_MIN_WORK", 1000)
    same = hk.trace(solid, o, d, tolerance=1e-4, precision="single")
    assert len(calls) == 1
    assert (np.asarray(hits.is_hit) == np.asarray(same.is_hit)).mean() > 0.998
    both = np.asarray(hits.is_hit & same.is_hit)
    apart = np.abs(np.asarray(hits.t)[both] - np.asarray(same.t)[both])
    assert np.quantile(apart, 0.99) < 1e-3


@pytest.mark.parametrize("cells", [-1.0, math.inf, math.nan, "yes", [1]])
def test_cells_is_a_number_of_megabytes(cells: Any) -> None:
    with pytest.raises(ValueError, match="megabytes"):
        hk.DipolePotential(*cloud(100), cells=cells)


def builds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows with each time that cells are built."""
    calls: list[int] = []
    build = dipole.build_cells

    def counted(*arguments: Any, **settings: Any) -> Any:
        calls.append(1)
        return build(*arguments, **settings)

    monkeypatch.setattr(dipole, "build_cells", counted)
    return calls


def test_many_rays_get_cells_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    some = cloud(300)
    field = hk.DipolePotential(*some)
    assert field.cell_choice(99_999) == NO_CELLS
    with_cells = field.cell_choice(100_000)
    assert with_cells.max_bytes == 256e6
    assert field.cell_choice(200_000) == with_cells
    assert field.cells is None
    backend = choose_backend("single")
    for count, choice in ((99_999, NO_CELLS), (100_000, with_cells)):
        on = field.evaluator(backend, Plan(ray_count=count)).data
        assert isinstance(on.tree, dipole.DipoleTree)
        assert (on.tree.cells is None) == (choice == NO_CELLS)
        assert field.evaluator(backend, Plan(ray_count=count)).data is on
    for given in (False, 3.0):
        refused = hk.DipolePotential(*some, cells=given)
        assert refused.cell_choice(10**8) == refused.cell_choice()
    smooth = hk.DipolePotential(*some, smoothing=0.05)
    assert smooth.cell_choice(10**8) == NO_CELLS
    # Tracing asks for them.
    monkeypatch.setattr(dipole, "_LEAST_RAYS", 1000)
    monkeypatch.setattr(dipole, "_PAYS", 1)
    calls = builds(monkeypatch)
    field = hk.DipolePotential(*some)
    few, many = rays(some[0], 999), rays(some[0], 1000)
    hk.trace(field, *few, precision="single")
    assert not calls
    hits = hk.trace(field, *many, precision="single")
    hk.trace(field, *many, precision="single")
    assert len(calls) == 1
    plain = hk.trace(hk.DipolePotential(*some, cells=False), *many, precision="single")
    assert (plain.is_hit != hits.is_hit).mean() < 2e-3
    hk.render(field, size=(32, 32), show="shaded", progress=False)
    assert len(calls) == 1


def test_cells_do_not_depend_on_how_many_are_made_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tables: list[np.ndarray] = []
    for at_once in (1 << 14, 37):
        monkeypatch.setattr(dipole_cells, "_CHUNK_SIZE", at_once)
        field = hk.DipolePotential(*cloud(300), cells=True)
        on = field.evaluator(choose_backend("double")).data
        assert isinstance(on.tree, dipole.DipoleTree)
        assert on.tree.cells is not None
        cells = on.tree.cells
        assert cells.count > 100
        tables.append(np.concatenate([to_numpy(cells.records.buffer), to_numpy(cells.near)]))
    np.testing.assert_allclose(tables[0], tables[1], rtol=1e-9, atol=1e-12)


def test_very_many_rays_get_smaller_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dipole, "_LEAST_RAYS", 1000)
    field = hk.DipolePotential(*cloud(600))
    of_few_rays, of_many_rays = field.cell_choice(5000), field.cell_choice(60 * 600)
    assert of_few_rays != of_many_rays
    assert field.cell_choice(10**9) == of_many_rays
    assert field.cell_choice(6000) == of_few_rays
    counts: list[int] = []
    requested = hk.DipolePotential(*cloud(600), cells=True)
    for each, count in ((field, 5000), (field, 60 * 600), (requested, 0)):
        on = each.evaluator(choose_backend("single"), Plan(ray_count=count)).data
        assert isinstance(on.tree, dipole.DipoleTree)
        assert on.tree.cells is not None
        counts.append(on.tree.cells.count)
    assert 1.5 * counts[0] < counts[1] == counts[2]


def test_moved_points_keep_cells() -> None:
    some = cloud(200)
    moved = hk.DipolePotential(*some, cells=8).with_points(1.5 * some[0], some[1], 2.25 * some[2])
    assert moved.cells == 8
    x = places(some, 500, 6)
    value, _ = dipole_sum(1.5 * some[0], some[1] * 2.25 * some[2][:, None])(x)
    found, _, error, _ = sampled(moved, x, "double")
    assert (np.abs(found - value) <= error + 1e-9 * np.abs(value)).all()


def test_smoothed_sums_have_no_cells() -> None:
    points, normals = np.eye(3), np.eye(3)
    with pytest.raises(ValueError, match="cells are of sums without smoothing"):
        hk.DipolePotential(points, normals, smoothing=0.1, cells=True)


@pytest.mark.parametrize("cells", [False, True])
def test_a_cloud_as_it_comes_keeps_its_contract(cells: bool) -> None:
    """Values at points leave out more than samples do: `check_field` took that for an error."""
    check_field(hk.DipolePotential(*cloud(1000), cells=cells), rng=0, count=40, directions=2)


# --- values at points -------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["single", "double"])
def test_values_by_cells_are_within_their_bounds(precision: Precision) -> None:
    """In cells and outside of their cube, at points anywhere and close to those of the cloud; at
    all of them at once or at some."""
    given = points, normals, areas = cloud(3000)
    field, plain = (hk.DipolePotential(*given, cells=some) for some in (True, False))
    rng = np.random.default_rng(3)
    x = rng.uniform(-4, 4, (3000, 3))
    x[:1500] = points[:1500] + 10 ** rng.uniform(-4, 0, (1500, 1)) * rng.normal(size=(1500, 3))
    x = x.astype(np.float32).astype(np.float64)
    exact, slopes = dipole_sum(points, areas[:, None] * normals)(x)
    value, gradient = field.value_and_gradient(x, precision=precision)
    error = field.error_bound(x, precision=precision)
    off = np.abs(value - exact)
    rounding = np.finfo(precision).eps * (np.abs(exact) + np.linalg.norm(slopes, axis=1))
    assert (off <= error + rounding).all()
    turned = np.linalg.norm(gradient - slopes, axis=1)
    bound = field.gradient_error_bound(x, precision=precision)
    assert (turned <= bound + 1e-5 * np.linalg.norm(slopes, axis=1)).all()
    inside = np.abs(x).max(axis=1) < 1
    assert np.median(error[inside]) < 0.1 * np.median(plain.error_bound(x)[inside])
    backend = choose_backend(precision)
    np.testing.assert_array_equal(field.value(x[:9], precision=precision), value[:9])
    np.testing.assert_array_equal(to_numpy(field.value(to_vector3(backend, x))), value)
    field.evaluator(backend)  # what is uploaded for rays changes no values
    np.testing.assert_array_equal(field.value(x, precision=precision), value)


def test_values_have_cells_where_those_were_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the same as rays; not where rays asked for them."""
    calls = builds(monkeypatch)
    some, x = cloud(300), np.eye(3)
    many = hk.DipolePotential(*some)
    many.evaluator(choose_backend("double"), Plan(ray_count=10**9))
    assert len(calls) == 1
    calls.clear()
    many.value(x)
    hk.DipolePotential(*some, cells=False).value(x)
    assert not calls
    field = hk.DipolePotential(*some, cells=True)
    field.value(x, precision="single")
    hk.trace(field, *rays(some[0], 10), precision="single")
    field.error_bound(x, precision="single")
    assert len(calls) == 1
    field.value(x, precision="double")
    assert len(calls) == 2


@pytest.mark.parametrize("name", ["points", "normals", "areas"])
def test_a_cloud_stays_as_it_is(name: str) -> None:
    """Values of old points, and of old and new ones mixed, came out where these were replaced."""
    points, normals, _ = cloud(20)
    for field in (
        hk.DipolePotential(points, normals),
        hk.fields.ScreenedWindingNumber(points, normals, length=1.0),
    ):
        given = getattr(field, name)
        with pytest.raises(AttributeError, match=name):
            setattr(field, name, 2 * given)
        for one in (field, copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
            with pytest.raises(ValueError, match="read-only"):
                getattr(one, name)[0] = 0


def test_how_a_field_is_computed_stays_as_it_is() -> None:
    """`method` and `smoothing` could be set, with no effect on what was made of them."""
    points, normals, _ = cloud(20)
    for field, name in (
        (hk.DipolePotential(points, normals), "smoothing"),
        (hk.WindingNumber(points[:3], [[0, 1, 2]]), "method"),
    ):
        with pytest.raises(AttributeError, match=name):
            setattr(field, name, getattr(field, name))


@pytest.mark.parametrize("precision", ["single", "double"])
def test_gradients_beside_many_copies_of_a_point(precision: Precision) -> None:
    """As many roundings as there are copies: they were one and a half times what was allowed."""
    count, area = 20_000, 8.0
    points = np.concatenate([np.tile([0.3, 0.2, 0.7], (count, 1)), [[-1, -1, -1], [1, 1, 1]]])
    normals, areas = np.tile([0.6, 0, 0.8], (count + 2, 1)), np.full(count + 2, area / count)
    field = hk.DipolePotential(points, normals, areas, cells=True)
    x = np.array([
        [0.2983548641204834, 0.20425990223884583, 0.6965691447257996],
        [0.30169931054115295, 0.1995246857404709, 0.7035130262374878],
    ])  # fmt: skip
    _, exact = dipole_sum(field.points, field.areas[:, None] * field.normals)(x)
    off = np.linalg.norm(field.gradient(x, precision=precision) - exact, axis=1)
    assert (off <= field.gradient_error_bound(x, precision=precision)).all()


def test_gradients_at_points_are_good_by_default() -> None:
    """They were off by 14 % in the median away from the surface, and by half at 5 % of points."""
    rng = np.random.default_rng(0)
    n = unit(rng.normal(size=(4000, 3)))
    points = n * (1 + 0.15 * np.sin(7 * n[:, :1]) * np.cos(6 * n[:, 1:2]))
    areas = np.full(len(n), 4 * np.pi / len(n))
    x = rng.uniform(-1.3, 1.3, (300, 3))
    exact = dipole_sum(points, areas[:, None] * n)(x)[1]
    size = np.linalg.norm(exact, axis=1)
    field = hk.DipolePotential(points, n, areas)
    off = np.linalg.norm(field.gradient(x, precision="double") - exact, axis=1)
    assert np.quantile(off / size, 0.95) < 0.01
    assert (off <= field.gradient_error_bound(x, precision="double") + 1e-12 * size).all()
    rough = field.rough_value_and_gradient(x, precision="double")[1]
    assert np.quantile(np.linalg.norm(rough - exact, axis=1) / size, 0.95) > 0.1


def test_solids_of_a_sum_sample_it_as_coarsely_as_the_sum_itself() -> None:
    """The solid had the coarsest accuracy of the field before it was prepared."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cloud = hk.DipolePotential(points, points, cells=False)
    solid = hk.solid(cloud, above=2 * math.pi)
    backend = choose_backend("single")
    accuracy = cloud.evaluator(backend).variable_accuracy
    assert accuracy is not None
    coarsest = accuracy.coarsest
    assert coarsest < 1
    for made_of_it in (solid, solid | solid.translated((5, 0, 0))):
        sampling = made_of_it.evaluator(backend).variable_accuracy
        assert sampling is not None
        assert sampling.coarsest == coarsest
