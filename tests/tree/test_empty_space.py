"""Grids of cells proved empty, extents of broken meshes, and sums over all of their edges."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.solid_angles.winding_number import WindingModuloOne, winding_box
from harnack.fmm.edge_lift import LiftedEdges, lifted_sums
from harnack.fmm.trail_sums import LiftedTrails, closed_trails
from harnack.geometry.example_meshes import icosphere
from harnack.tree.empty_space import OccupancyGrid, distance_to_occupied
from harnack.tree.triangle_tree import RayFrame
from tests.oracles.direct_sums import winding_sum


def broken(subdivisions: int = 3, part: float = 0.1, seed: int = 0) -> hk.WindingNumber:
    vertices, faces = icosphere(subdivisions)
    kept = np.random.default_rng(seed).random(len(faces)) > part
    return hk.WindingNumber(vertices * [1.0, 0.6, 1.4], faces[kept])


def off_the_level(field: hk.WindingNumber, x: np.ndarray, level: float = 0.5) -> np.ndarray:
    """How far w is from a level, modulo 1, by an independent sum over triangles."""
    w = winding_sum(field.mesh.vertices[field.mesh.triangles])(x)
    return np.abs(np.remainder(w - level + 0.5, 1.0) - 0.5)


def index_of(cells: OccupancyGrid, empty: bool) -> np.ndarray:
    """(n, 3) cells that are empty, or are not."""
    at = np.argwhere((cells.empty_distance.reshape(cells.shape[::-1]) > 0) == empty)
    return at[:, ::-1]


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(2))
def test_empty_cells_are_off_the_level(seed: int) -> None:
    field = broken(seed=seed)
    cells = field.occupied_cells_of(hk.fields.Plan((0.5,)))
    assert cells is not None
    rng = np.random.default_rng(seed)
    empty, rest = index_of(cells, empty=True), index_of(cells, empty=False)
    assert 0.01 < len(rest) / len(empty) < 0.6
    some = rng.choice(empty, 3000)
    x = cells.origin + (some + rng.uniform(-1 / 16, 17 / 16, some.shape)) * cells.cell_size
    assert off_the_level(field, x).min() > 0
    w = winding_sum(field.mesh.vertices[field.mesh.triangles])
    side = [
        np.remainder(w(cells.origin + (some + k) * cells.cell_size) - 0.5, 1.0)
        for k in (0.01, 0.99)
    ]
    assert np.abs(side[0] - side[1]).max() < 0.99  # no level between two corners, modulo 1
    x = cells.origin + (rng.choice(rest, 3000) + 0.5) * cells.cell_size
    assert off_the_level(field, x).min() < 0.01  # the surface is in some of them


@pytest.mark.parametrize("precision", ["single", "double"])
def test_coarse_samples_are_w_less_a_whole_number(precision: str) -> None:
    field = broken()
    x = np.random.default_rng(1).normal(size=(4000, 3))
    backend = choose_backend(precision)  # type: ignore[arg-type]
    p = to_vector3(backend, x)
    sample = WindingModuloOne(field).evaluator(backend).evaluate(p)
    error = to_numpy(backend.Float(sample.value_error))
    whole = winding_sum(field.mesh.vertices[field.mesh.triangles])(x)
    off = to_numpy(sample.value) - whole
    slack = np.linalg.norm(to_numpy(sample.gradient), axis=1) * 4 * backend.machine_epsilon
    off = np.abs(off - np.round(off))
    assert (off <= error + slack + 8 * backend.machine_epsilon).all()
    assert np.median(error) < 0.05


def test_extents_hold_the_level_set_and_the_triangles() -> None:
    field = broken()
    extent = field.extent((0.5,))
    assert extent is not None
    lower, upper = winding_box(field.mesh, (0.5,)).bounds()
    assert np.ptp(extent.bounds(), axis=0).prod() < 0.6 * (upper - lower).prod()
    backend = choose_backend("double")
    corners = field.mesh.vertices[field.mesh.faces].reshape(-1, 3)
    assert to_numpy(extent.contains(to_vector3(backend, corners))).all()
    # No change of w over 1/2 off the triangles outside: w modulo 1 stays on one side of it.
    x = np.random.default_rng(0).uniform(lower, upper, (20000, 3))
    outside = ~to_numpy(extent.contains(to_vector3(backend, x)))
    assert outside.sum() > 3000
    w = winding_sum(field.mesh.vertices[field.mesh.triangles])(x[outside])
    assert np.abs(w).max() < 0.5


@pytest.mark.slow
def test_hits_are_those_without_cells() -> None:
    field = broken()
    field.configure_cells(False)
    rng = np.random.default_rng(3)
    o = 4 * unit(rng.normal(size=(5000, 3)))
    d = unit(rng.uniform(-1, 1, (5000, 3)) * [1.0, 0.6, 1.4] - o)
    fast = hk.trace(field, o, d, precision="single", tolerance=1e-4)
    field.occupied_cells_of = lambda plan: None  # pyright: ignore[reportAttributeAccessIssue]
    plain = hk.trace(field, o, d, precision="single", tolerance=1e-4)
    assert (fast.status == plain.status).all()
    hit = plain.is_hit
    apart = np.abs(fast.t[hit] - plain.t[hit])
    assert (apart < 3e-4).mean() > 0.998  # others graze the surface
    assert apart.max() < 2e-3
    assert (fast.primitive_index == plain.primitive_index)[hit].mean() > 0.999
    assert fast.evaluations.mean() < 0.8 * plain.evaluations.mean()


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_a_moved_mesh_has_cells_of_its_own() -> None:
    field = broken(2)
    cells = field.occupied_cells_of(hk.fields.Plan((0.5,)))
    cells_of_moved = field.with_vertices(field.mesh.vertices * 2).occupied_cells_of(
        hk.fields.Plan((0.5,))
    )
    assert cells is not None
    assert cells_of_moved is not None
    assert cells_of_moved.cell_size == pytest.approx(2 * cells.cell_size, rel=1e-3)
    assert field.occupied_cells_of(hk.fields.Plan((0.5,))) is cells


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("shift", [0.0, 50.0])
def test_rays_through_cells_stop_before_those_that_are_not_empty(
    shift: float, precision: str
) -> None:
    """Against dense samples of rays through random cells, also far from the origin."""
    rng = np.random.default_rng(0)
    empty = rng.random((9, 12, 16)) > 0.15
    corner = np.array([-1.0, -0.5, 0.0]) + shift
    cells = OccupancyGrid(corner, 0.125, empty.shape[::-1], distance_to_occupied(empty))  # type: ignore[arg-type]
    backend = choose_backend(precision)  # type: ignore[arg-type]
    o = rng.uniform([-1, -0.5, 0], [1, 1, 1.125], (600, 3)) + shift
    d = unit(rng.normal(size=(600, 3)))
    d[:60] = np.eye(3)[rng.integers(0, 3, 60)]  # along cells
    x = to_vector3(backend, o), to_vector3(backend, d)
    t = cells.upload(backend).end_of_empty_run(*x, backend.Float(0), backend.Float(4))
    length = to_numpy(t).astype(float)
    assert length.max() == 4  # beyond the grid all is empty
    share = np.linspace(0, 1, 400)[None, :, None]
    p = (o[:, None] + share * length[:, None, None] * d[:, None] - corner) / cells.cell_size

    def is_empty(p: np.ndarray) -> np.ndarray:
        index = np.floor(p).astype(int)
        inside = ((index >= 0) & (index < cells.shape)).all(axis=-1)
        index = np.clip(index, 0, np.array(cells.shape) - 1)
        return ~inside | empty[tuple(np.moveaxis(index, -1, 0)[::-1])]

    # Within a sixteenth of a cell of an empty one all is empty.
    near = np.stack(np.meshgrid(*[(-1 / 16, 1 / 16)] * 3), axis=-1).reshape(-1, 3)
    ok = np.any([is_empty(p + offset) for offset in near], axis=0)
    assert ok[length > 0].all()
    # And they do not stop early: a little behind the end is a cell that is not empty, or outside of
    # the grid one next to it.
    behind = (o + (length + 0.02 * cells.cell_size)[:, None] * d - corner) / cells.cell_size
    behind = np.clip(behind, 0, np.array(cells.shape) - 1e-6)
    assert is_empty(behind)[length < 4].mean() < 0.05


def test_rays_that_rounding_moves_prove_nothing() -> None:
    cells = OccupancyGrid(
        np.zeros(3), 1e-3, (4, 4, 4), distance_to_occupied(np.ones((4, 4, 4), bool))
    )
    backend = choose_backend("single")
    grid, d = cells.upload(backend), to_vector3(backend, np.eye(3)[:1])
    for far, expected in ((0.0, 1.0), (1e3, 0.0), (np.nan, 0.0)):
        o = backend.Array3f(far, 0, 0)
        found = to_numpy(grid.end_of_empty_run(o, d, backend.Float(0), backend.Float(1)))
        assert found[0] == expected


def test_cells_are_empty_where_the_clearance_says_so() -> None:
    def clearance(x: np.ndarray) -> np.ndarray:
        return np.abs(np.linalg.norm(x, axis=1) - 0.5)

    ball = OccupancyGrid.from_clearance(np.full(3, -1.0), np.full(3, 1.0), clearance, 64)
    rest = ball.origin + (index_of(ball, empty=False) + 0.5) * ball.cell_size
    assert np.abs(np.linalg.norm(rest, axis=1) - 0.5).max() <= 1.01 * ball.cell_size
    empty = ball.origin + (index_of(ball, empty=True) + 0.5) * ball.cell_size
    # A ball around the cell and a sixteenth more: clearances 1.001 times as long would be seen.
    least = 0.5 * 3**0.5 * (1 + 2 / 16) * ball.cell_size
    assert least <= np.abs(np.linalg.norm(empty, axis=1) - 0.5).min() < 1.001 * least
    full = OccupancyGrid.from_clearance(
        np.full(3, -1.0), np.full(3, 1.0), lambda x: np.zeros(len(x)), 8
    )
    assert not full.empty_distance.any()
    none = OccupancyGrid.from_clearance(
        np.full(3, -1.0), np.full(3, 1.0), lambda x: np.full(len(x), 9.0), 8
    )
    assert (none.empty_distance == max(none.shape)).all()


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (5, 1, 4), (6, 7, 11)])
def test_distances_to_occupied_cells_are_those_of_a_chessboard(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    for fraction in (0.01, 0.1, 0.9):
        is_empty = rng.random(shape) > fraction
        is_empty.flat[rng.integers(is_empty.size)] = False
        cells, occupied = np.argwhere(is_empty | True), np.argwhere(~is_empty)
        distance = np.abs(cells[:, None] - occupied).max(axis=2).min(axis=1)
        np.testing.assert_array_equal(distance_to_occupied(is_empty), distance)


def test_sums_over_trails_are_those_over_single_edges() -> None:
    field = broken()
    backend = choose_backend("double")
    vertices, edges = field.mesh.unit_vertices, field.mesh.singular_edges
    x = to_vector3(backend, np.random.default_rng(0).normal(size=(3000, 3)))
    up = RayFrame(x, backend.Array3f(1, 0, 0), backend.Array3f(0, 1, 0), backend.Array3f(0, 0, 1))
    found = LiftedTrails.upload(backend, vertices, closed_trails(edges)).sum(up, x)
    other = lifted_sums(LiftedEdges.upload(backend, vertices, edges), x, 1)
    for name, places in (("value", 1e-12), ("gradient", 1e-10), ("singularity_distance", 1e-13)):
        one, two = to_numpy(getattr(found, name)), to_numpy(getattr(other, name))
        np.testing.assert_allclose(one, two, atol=places)
    # Integrals over edges, where single edges have a bound of them.
    for name in ("s4", "s5"):
        one, two = to_numpy(getattr(found, name)), to_numpy(getattr(other, name))
        assert (one > 0.05 * two).all()
        assert (one < 1.5 * two).all()


def test_a_step_ends_at_its_margin() -> None:
    """Steps 1.001 times as long would be seen."""
    empty = np.ones((1, 1, 64), np.bool_)
    empty[0, 0, 40] = False
    cells = OccupancyGrid(np.zeros(3), 1.0, (64, 1, 1), distance_to_occupied(empty))
    backend = choose_backend("double")
    o, d = to_vector3(backend, np.array([[0.5, 0.5, 0.5]])), to_vector3(backend, np.eye(3)[:1])
    found = to_numpy(
        cells.upload(backend).end_of_empty_run(o, d, backend.Float(0), backend.Float(60))
    )
    assert found[0] == pytest.approx(39.5 + 1 / 16 - 1 / 64, abs=1e-9)
