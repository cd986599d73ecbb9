"""Cells of triangle soups: near triangles, and one polynomial for all others."""

from __future__ import annotations

import itertools
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields import Plan
from harnack.fields.solid_angles import winding_number
from harnack.fields.solid_angles.cell_options import NO_CELLS
from harnack.fmm import dipole_cells
from harnack.fmm.dipole_cells import DipoleCells
from harnack.fmm.dipole_expansion import triangle_sources
from harnack.geometry.example_meshes import bumpy_sphere, icosphere, remove_faces
from tests.fields.test_winding import (
    Mesh,
    check_first_hits,
    direct_sum,
    places,
    rays,
    rounded,
    unit,
)

PRECISIONS = ["single", "double"]


def torn(subdivisions: int, by: float, shift: float = 0.0, seed: int = 0) -> Mesh:
    """A bumpy sphere, all corners of its triangles moved by about so much."""
    vertices, faces = bumpy_sphere(subdivisions)
    corners = vertices[faces]
    corners = corners + by * np.random.default_rng(seed).normal(size=corners.shape) + shift
    return rounded(corners.reshape(-1, 3)), np.arange(corners.size // 3).reshape(-1, 3)


def scattered(n: int, size: float, seed: int = 0) -> Mesh:
    """Triangles anywhere in any direction, some of them slivers, some twice."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    corners[::17, 2] = 0.5 * (corners[::17, 0] + corners[::17, 1]) + 1e-4 * size
    corners[::11, 2] = corners[::11, 1] + 1e-3 * size
    corners[1::23] = corners[::23][: len(corners[1::23])]
    return rounded(corners.reshape(-1, 3)), np.arange(3 * n).reshape(-1, 3)


def soup(mesh: Mesh, cells: Any = True) -> hk.WindingNumber:
    return hk.WindingNumber(*mesh, method="tree", cells=cells)


def cells_of(field: hk.WindingNumber, precision: Any = "single", ray_count: int = 0) -> DipoleCells:
    cells = field.evaluator(choose_backend(precision), Plan(ray_count=ray_count)).data.built
    assert isinstance(cells, DipoleCells)
    return cells


MESHES = {
    "torn": torn(2, 0.01),
    "torn far away": torn(2, 0.01, shift=300.0),
    "hardly torn": torn(2, 1e-4),
    "scattered": scattered(700, 0.03),
    "large": scattered(200, 0.3),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", MESHES)
def test_samples_are_within_their_errors(
    kind: str, precision: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dipole_cells, "_MAX_NEAR_FRACTION", 1.0)
    if kind == "large":  # near them are leaves whose balls are not
        monkeypatch.setattr(dipole_cells, "_MOST_NEAR", 24)
    mesh, backend = MESHES[kind], choose_backend(precision)
    field = soup(mesh)
    cells = cells_of(field, precision)
    assert cells.count > 8
    middle = rounded(mesh[0].mean(axis=0, keepdims=True))
    x = rounded(middle + places((mesh[0] - middle, mesh[1]), 3000, 1e-4))
    sample = field.evaluator(backend).evaluate(to_vector3(backend, x))
    plain = soup(mesh, False)
    gradient = hk.WindingNumber(*mesh, method="exact").gradient(x, precision="double")
    steep = np.linalg.norm(gradient, axis=1)
    place = 4 * backend.machine_epsilon * np.abs(x).max(axis=1) * steep
    off = np.abs(to_numpy(sample.value) - direct_sum(mesh[0][mesh[1]], x))
    error = to_numpy(sample.value_error).astype(np.float64)
    beside = plain.error_bound(x, precision=precision) > 0.5  # of a triangle, by rounding
    assert beside.mean() < 0.1
    assert (off <= error + place + 1e-12)[~beside].all()
    assert np.median(error) < 1e-2
    turned = np.linalg.norm(to_numpy(sample.gradient) - gradient, axis=1)
    bent = to_numpy(sample.promises[0].constant) * 4 * backend.machine_epsilon * np.abs(x).max()
    assert (turned <= to_numpy(sample.gradient_error) + bent + 1e-4 * steep).all()


def test_errors_are_attained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the error would be too little: at corners of the cells around one triangle, of a
    large and a small one that are far from them."""
    monkeypatch.setattr(dipole_cells, "_MOST_NEAR", 1)
    small = np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]])
    large = np.array([[0.0, 0, 0], [0.2, 0, 0.1], [0, 0.25, 0]])
    corners = np.stack([small, small + 0.5, large + np.array([0.6, -0.6, 0.6])])
    field = soup((corners.reshape(-1, 3), np.arange(9).reshape(-1, 3)))
    cells = cells_of(field, "double")
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1)
    away = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    unit_x = table[:, None, :3] + away / math.sqrt(3) / 1.0041 / table[:, None, 3:4]
    x = field.mesh.center + field.mesh.size * unit_x.reshape(-1, 3)
    backend = choose_backend("double")
    sample = field.evaluator(backend).evaluate(to_vector3(backend, x))
    off = np.abs(to_numpy(sample.value) - direct_sum(corners, x))
    used = off / to_numpy(sample.value_error)
    assert used.max() <= 1
    assert used.max() > 0.5


def test_the_bound_of_bending_is_attained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps in cells are proved by `SourceSums.s4`. Beside a tiny triangle it is nearly exact at
    the
    centers of cells: a thousandth less would be too little."""
    monkeypatch.setattr(dipole_cells, "_MOST_NEAR", 0)
    tiny = 1e-6 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    places = np.array([[0.3, 0.3, 0.3], [1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]])
    corners = tiny + places[:, None]
    field = soup((corners.reshape(-1, 3), np.arange(9).reshape(-1, 3)))
    cells = cells_of(field, "double")
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1)
    c = table[table[:, 13] == 0, :3]  # no near triangles
    x = to_vector3(choose_backend("double"), c)
    sums, _, found = cells.sums(x, dr.full(dr.mask_t(x.x), True, 1), lambda *given: given[2:], ())
    assert to_numpy(found).all()
    there = (corners.mean(axis=1) - field.mesh.center) / field.mesh.size
    away = np.linalg.norm(c[:, None] - there, axis=2)
    exact = (0.5e-12 / field.mesh.size**2 / away**4).sum(axis=1)
    used = to_numpy(sums.s4) / exact
    assert used.min() >= 1
    assert used.min() < 1.001


# Far from the middle of what sets the size, beside the origin, between two heaps of sources, so
# that the far field is steep, in a cell with nothing near. Copies, size, place, distance.
HEAPS = 2000, 1.4e-4, np.full(3, 0.00395965576171875), 0.005096144243526092
AROUND = np.array([
    [[0, 1.5, 0], [0.02, 1.5, 0], [0, 1.52, 0]],
    [[2.12, 2.12, 2.12], [2.10, 2.12, 2.12], [2.12, 2.10, 2.12]],
    [[0.2, 0, 0], [0.22, 0, 0], [0.2, 0.02, 0]],
])  # fmt: skip


def heaps() -> tuple[np.ndarray, np.ndarray]:
    """Corners of triangles, the first three those around; and points between the heaps."""
    copies, size, place, distance = HEAPS
    axis = np.ones(3) / math.sqrt(3)
    u = unit(np.cross(axis, [1.0, 0, 0])[None])[0]
    w = np.cross(axis, u)
    small = size / 3 * np.array([-u - w, 2 * u - w, 2 * w - u]) + place
    ends = np.repeat([small + distance * axis, small - distance * axis], copies, axis=0)
    x = place + 2e-4 * np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    return rounded(np.concatenate([AROUND, ends])), rounded(x)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangles", "points"])
def test_rounding_of_positions_counts_where_all_is_far(kind: str) -> None:
    """Errors were up to three times as large as was said, in single precision."""
    (corners, x), backend = heaps(), choose_backend("single")
    flat = corners.reshape(-1, 3)
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = 0.5 * np.cross(b - a, c - a)
    points, areas = rounded(corners.mean(axis=1)), np.linalg.norm(normals, axis=1)
    field: Any
    if kind == "triangles":
        field = soup((flat, np.arange(len(flat)).reshape(-1, 3)))
        exact = 4 * math.pi * direct_sum(corners, x)
    else:
        field = hk.DipolePotential(points, normals, areas, cells=True)
        away, moments = x[:, None] - points, field.normals * field.areas[:, None]
        exact = -((moments * away).sum(axis=2) / np.linalg.norm(away, axis=2) ** 3).sum(axis=1)
    sample = field.evaluator(backend).evaluate(to_vector3(backend, x))
    scale = 4 * math.pi if kind == "triangles" else 1.0
    off = np.abs(scale * to_numpy(sample.value).astype(np.float64) - exact)
    steep = scale * np.linalg.norm(to_numpy(sample.gradient), axis=1)
    place = 4 * backend.machine_epsilon * np.abs(x).max(axis=1) * steep
    assert (off <= scale * to_numpy(sample.value_error) + place).all()


def test_triangles_of_no_area_count_for_their_edges() -> None:
    corners = np.zeros((2, 3, 3))
    corners[1, 1:] = np.eye(3)[:2]
    sources = triangle_sources(corners)
    assert (sources[:, 6] > 0).all()
    assert (np.abs(sources[0, 3:6]) < 1e-30).all()
    np.testing.assert_allclose(sources[1, 3:7], [0, 0, 0.5, 0.5])


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("by", [0.01, 1e-4])
def test_first_hits(by: float, precision: Any) -> None:
    check_first_hits(torn(2, by), "tree", 400, 3, precision, cells=True)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "precision"), [(1, "single"), (2, "double")])
def test_many_first_hits(seed: int, precision: Any) -> None:
    """So many that a grid of empty cells is made."""
    check_first_hits(torn(2, 0.04 / seed, seed=seed), "tree", 5000, seed, precision, cells=True)


def compare(mesh: Mesh, o: np.ndarray, d: np.ndarray, **settings: Any) -> hk.Hits:
    """Rays end as without cells, but for grazes within the tolerance."""
    settings = {"tolerance": 1e-4, "precision": "single", **settings}
    hits, plain = (hk.trace(soup(mesh, cells), o, d, **settings) for cells in (True, False))
    assert not (hits.status == hk.RayStatus.OUT_OF_STEPS).any()
    assert (plain.is_hit != hits.is_hit).mean() <= 2e-3
    both = plain.is_hit & hits.is_hit
    apart = np.abs(plain.t[both] - hits.t[both])
    assert (apart > 2e-3 * (1 + np.abs(o).max() / 100)).mean() <= 5e-3
    return hits


@pytest.mark.slow
def test_rays_from_inside_far_away_and_along_faces_of_cells() -> None:
    mesh, rng = torn(2, 0.01), np.random.default_rng(1)
    o, d = rng.uniform(-0.6, 0.6, (1000, 3)), unit(rng.normal(size=(1000, 3)))
    compare(mesh, o, d, t_min=0.3)
    compare(mesh, o - 1e3 * d, d, precision="double")
    cells = cells_of(soup(mesh))
    table = to_numpy(cells.records.buffer).reshape(cells.count, -1).astype(np.float64)
    some = table[rng.integers(cells.count, size=1000)]
    corner = some[:, :3] + rng.choice([-1, 1], (1000, 3)) / (1.004 * math.sqrt(3)) / some[:, 3:4]
    field = soup(mesh)
    corner = field.mesh.center + field.mesh.size * corner
    d = np.eye(3)[rng.integers(3, size=1000)]
    d[500:] = unit(rng.choice([-1.0, 1.0], (500, 3)))
    hits = compare(mesh, corner - 3 * d, d)
    assert hits.is_hit.mean() > 0.3


@pytest.mark.slow
def test_many_rays_and_crossings() -> None:
    mesh = torn(2, 0.01)
    hits = compare(mesh, *rays(mesh, 6000, 9))  # so many that a grid of empty cells is made
    assert hits.is_hit.mean() > 0.3
    o, d = rays(mesh, 300, 2)
    fields = [soup(mesh, cells) for cells in (True, False)]
    crossings = [hk.crossings(field, o, d, max_crossings=6).t for field in fields]
    first = [hk.trace(field, o, d, require_crossing=True).t for field in fields]
    for t, plain_t in (crossings, first):
        there = np.isfinite(t) & np.isfinite(plain_t)
        assert (np.isfinite(t) == np.isfinite(plain_t)).mean() > 0.98
        assert (np.abs(t[there] - plain_t[there]) > 1e-3).mean() < 0.02


def test_moved_soups_have_cells_of_their_own() -> None:
    vertices, faces = torn(2, 0.01)
    o, d = rays((vertices, faces), 500, 3)
    field = soup((vertices, faces))
    hk.trace(field, o, d)
    moved = 1.3 * vertices + 0.2
    hits = hk.trace(field.with_vertices(moved), 1.3 * o + 0.2, d)
    plain = hk.trace(soup((moved, faces), False), 1.3 * o + 0.2, d)
    assert (hits.is_hit == plain.is_hit).mean() > 0.998


@pytest.mark.slow
def test_when_there_are_cells_of_triangles() -> None:
    mesh = torn(3, 0.01)
    field = hk.WindingNumber(*mesh)
    assert field.method == "tree"
    assert field.describe()["cells"] == "from 15,360 rays on"
    backend = choose_backend("single")
    assert field.evaluator(backend, Plan(ray_count=15_000)).data is field.evaluator(backend).data
    evaluator, cells = (
        field.evaluator(backend, Plan(ray_count=20_000)),
        cells_of(field, "single", 20_000),
    )
    assert evaluator.describe()["cells"] == f"{cells.count} of {cells.size / 1e6:.1f} MB"
    assert evaluator.modulo_one is None
    short = soup(mesh, 0.01).evaluator(backend)
    assert short.describe()["cells"] == "none, as they need more memory"
    coarse = cells_of(soup(mesh, 2.0))
    assert coarse.size <= 2e6 < cells.size


def test_few_or_large_triangles_and_shared_edges_have_cells_of_edges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where triangles are as large as all of the soup, all of them are near."""
    vertices, faces = bumpy_sphere(2)
    for mesh in (scattered(300, 0.5), (vertices, remove_faces(faces, 0.1, 0))):
        evaluator = soup(mesh).evaluator(choose_backend("single"))
        assert evaluator.data.cells is not None
        assert evaluator.modulo_one is not None
    monkeypatch.setattr(winding_number, "_MOST_OF_SOUP", 100)
    assert soup(torn(2, 0.01), None).cell_choice(10**9) == NO_CELLS
    closed = soup(icosphere(1), True).evaluator(choose_backend("single"))
    assert closed.describe()["triangles"] == 80


@pytest.mark.parametrize("precision", PRECISIONS)
def test_values_by_cells_are_within_their_bounds(
    precision: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In cells and outside of their cube, at points anywhere and close to triangles; those of a
    mesh with holes stay what they were."""
    monkeypatch.setattr(dipole_cells, "_MAX_NEAR_FRACTION", 1.0)
    mesh = MESHES["torn"]
    field, plain, x = soup(mesh), soup(mesh, False), places(mesh, 3000, 1e-4)
    x[-100:] *= 5
    value, gradient = field.value_and_gradient(x, precision=precision)
    error = field.error_bound(x, precision=precision)
    beside = error > 0.5  # of a triangle, by rounding
    assert beside.mean() < 0.1
    slopes = hk.WindingNumber(*mesh, method="exact").gradient(x, precision="double")
    place = 4 * np.finfo(precision).eps * np.linalg.norm(slopes, axis=1)
    off = np.abs(value - direct_sum(mesh[0][mesh[1]], x))
    assert (off <= error + place)[~beside].all()
    turned = np.linalg.norm(gradient - slopes, axis=1)
    bound = field.gradient_error_bound(x, precision=precision)
    assert (turned <= bound + 1e-5 * np.linalg.norm(slopes, axis=1)).all()
    assert np.median(error) < 0.5 * np.median(plain.error_bound(x))  # by cells
    vertices, faces = bumpy_sphere(3)
    holes = [hk.WindingNumber(vertices, faces[200:], cells=some) for some in (True, False)]
    np.testing.assert_array_equal(*(one.value(x) for one in holes))


def test_values_of_soups_without_cells_build_no_cells_of_edges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those took minutes, and were of no use. The mesh stays as it is."""
    monkeypatch.setattr(winding_number.BoundaryCells, "build", None)
    mesh, x = scattered(100, 2.0), 3 * np.eye(3)
    field = soup(mesh)
    np.testing.assert_array_equal(field.value(x), soup(mesh, False).value(x))
    with pytest.raises(AttributeError, match="mesh"):
        field.mesh = None  # pyright: ignore[reportAttributeAccessIssue]
