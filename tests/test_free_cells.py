"""Extents and free cells of broken meshes, and close sums over all of their boundary edges."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.cells import FreeCells, free_cells
from harnack.enclosures import Gaps, TargetLevels
from harnack.fields.edges.edge_lift import LiftedEdges, lifted_sums
from harnack.fields.edges.lifted_trails import LiftedTrails
from harnack.fields.meshes.edge_trails import closed_trails
from harnack.fields.meshes.winding_extent import MARGIN, FreeWay, winding_box
from harnack.geometry.mesh_shapes import icosphere
from harnack.tree.triangles import Frame
from tests.oracles.direct_sums import winding_sum


def broken(subdivisions: int = 3, part: float = 0.1, seed: int = 0) -> hk.WindingNumber:
    vertices, faces = icosphere(subdivisions)
    kept = np.random.default_rng(seed).random(len(faces)) > part
    return hk.WindingNumber(vertices * [1.0, 0.6, 1.4], faces[kept])


def off_the_level(field: hk.WindingNumber, x: np.ndarray, level: float = 0.5) -> np.ndarray:
    """How far w is from a level, modulo 1, by an independent sum over triangles."""
    w = winding_sum(field.mesh.vertices[field.mesh.triangles])(x)
    return np.abs(np.remainder(w - level + 0.5, 1.0) - 0.5)


@pytest.mark.parametrize("seed", range(2))
def test_free_cells_are_off_the_level(seed: int) -> None:
    field = broken(seed=seed)
    extent = field.extent((0.5,))
    assert extent is not None
    prepared = field.for_levels((0.5,))
    cells = prepared._free[0]  # pyright: ignore[reportPrivateUsage, reportOptionalSubscript]
    assert 0.02 < 1 - cells.is_free.mean() < 0.6
    rng = np.random.default_rng(seed)
    free = np.argwhere(cells.is_free)
    some = rng.choice(free, 3000)
    x = cells.lower + (some + rng.uniform(-0.016, 1.016, some.shape)) * cells.edge
    assert off_the_level(field, x).min() >= MARGIN
    occupied = np.argwhere(~cells.is_free)
    x = cells.lower + (rng.choice(occupied, 3000) + 0.5) * cells.edge
    assert off_the_level(field, x).min() < 0.01  # the surface is in some of them


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


def test_hits_are_those_without_free_cells() -> None:
    field = broken()
    rng = np.random.default_rng(3)
    o = 4 * unit(rng.normal(size=(4000, 3)))
    d = unit(rng.uniform(-1, 1, (4000, 3)) * [1.0, 0.6, 1.4] - o)
    fast = hk.trace(field, o, d)
    field.for_levels = lambda levels: field  # pyright: ignore[reportAttributeAccessIssue]
    plain = hk.trace(field, o, d)
    assert (fast.status == plain.status).all()
    hit = plain.hit
    apart = np.abs(fast.t[hit] - plain.t[hit])
    assert (apart < 3e-4).mean() > 0.998  # others graze the surface
    assert apart.max() < 2e-3
    assert (fast.sheet == plain.sheet)[hit].mean() > 0.999
    assert fast.evaluations.mean() < 0.8 * plain.evaluations.mean()


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_a_moved_mesh_has_cells_of_its_own() -> None:
    field = broken(2)
    before = field.for_levels((0.5,))
    after = field.moved(field.mesh.vertices * 2).for_levels((0.5,))
    one, other = before._free, after._free  # pyright: ignore[reportPrivateUsage]
    assert one is not None
    assert other is not None
    assert other[0].edge == pytest.approx(2 * one[0].edge, rel=1e-6)
    assert before.for_levels((0.5,)) is before
    assert field.for_levels((0.5,)) is before


@pytest.mark.parametrize("shift", [0.0, 50.0])
def test_rays_through_cells_stop_before_those_that_are_not_free(shift: float) -> None:
    """Against dense samples of rays through random cells, also far from the origin."""
    rng = np.random.default_rng(0)
    cells = FreeCells(np.array([-1.0, -0.5, 0.0]) + shift, 0.125, rng.random((16, 12, 9)) > 0.15)
    backend = choose_backend("single")
    o = rng.uniform([-1, -0.5, 0], [1, 1, 1.125], (600, 3)) + shift
    d = unit(rng.normal(size=(600, 3)))
    d[:60] = np.eye(3)[rng.integers(0, 3, 60)]  # along cells
    x = to_vector3(backend, o), to_vector3(backend, d)
    length = to_numpy(cells.prepare(backend).free_along(*x, backend.Float(0)))
    assert length.max() > 0.5
    share = np.linspace(0, 1, 400)[None, :, None]
    p = (o[:, None] + share * length[:, None, None] * d[:, None] - cells.lower) / cells.edge
    # Within 0.017 edges of a free cell counts as free.
    ok = np.zeros(p.shape[:2], np.bool_)
    for offset in np.stack(np.meshgrid(*[(-0.012, 0.012)] * 3), axis=-1).reshape(-1, 3):
        index = np.floor(p + offset).astype(int)
        inside = ((index >= 0) & (index < cells.is_free.shape)).all(axis=2)
        index = np.clip(index, 0, np.array(cells.is_free.shape) - 1)
        ok |= inside & cells.is_free[tuple(np.moveaxis(index, 2, 0))]
    assert ok[length > 0].all()
    # And they do not stop early: a little behind the end is a cell that is not free, or none.
    behind = np.floor((o + (length + 0.02 * cells.edge)[:, None] * d - cells.lower) / cells.edge)
    index = behind.astype(int)
    inside = ((index >= 0) & (index < cells.is_free.shape)).all(axis=1)
    free = cells.is_free[tuple(np.clip(index, 0, np.array(cells.is_free.shape) - 1).T)]
    assert (inside & free).mean() < 0.05


def test_rays_that_rounding_moves_prove_nothing() -> None:
    cells = FreeCells(np.full(3, 1e6), 1e-3, np.ones((4, 4, 4), np.bool_))
    backend = choose_backend("single")
    o, d = to_vector3(backend, np.full((1, 3), 1e6)), to_vector3(backend, np.eye(3)[:1])
    assert to_numpy(cells.prepare(backend).free_along(o - 1e6, d, backend.Float(0)))[0] == 0
    nan = backend.Array3f(dr.nan, 0, 0)
    assert to_numpy(cells.prepare(backend).free_along(nan, d, backend.Float(0)))[0] == 0


def test_cells_are_free_where_the_clearance_says_so() -> None:
    ball = free_cells(
        np.full(3, -1.0), np.full(3, 1.0), lambda x: np.abs(np.linalg.norm(x, axis=1) - 0.5), 10**6
    )
    assert ball.is_free.shape == (64, 64, 64)
    centre = ball.lower + (np.argwhere(~ball.is_free) + 0.5) * ball.edge
    assert np.abs(np.linalg.norm(centre, axis=1) - 0.5).max() <= 1.03 * ball.edge
    coarse = free_cells(np.full(3, -1.0), np.full(3, 1.0), lambda x: np.zeros(len(x)), 5000)
    assert not coarse.is_free.any()
    assert coarse.is_free.shape == (16, 16, 16)


def test_a_free_way_keeps_between_the_levels_around() -> None:
    backend = choose_backend("double")
    real = backend.Float
    levels = TargetLevels((real(0.5),), 1.0)
    way = FreeWay.ahead(levels, real(0.2), real(1e-3), real(7.0))
    none = real(dr.inf)
    for gaps, expected in (
        (Gaps(none, real(0.3)), 7.0),
        (Gaps(real(0.7), real(0.3 - 0.008)), 7.0),
        (Gaps(none, real(0.3 - 0.02)), 0.0),  # to a level that the cells know nothing of
        (Gaps(real(0.5), none), 0.0),
    ):
        assert to_numpy(way.step(gaps))[0] == expected


def test_sums_over_trails_are_those_over_single_edges() -> None:
    field = broken()
    backend = choose_backend("double")
    vertices, edges = field.mesh.unit_vertices, field.mesh.singular
    x = to_vector3(backend, np.random.default_rng(0).normal(size=(3000, 3)))
    up = Frame(x, backend.Array3f(1, 0, 0), backend.Array3f(0, 1, 0), backend.Array3f(0, 0, 1))
    found = LiftedTrails.upload(backend, vertices, closed_trails(edges)).near(up, x)
    other = lifted_sums(LiftedEdges.upload(backend, vertices, edges), x, 1).whole()
    for name, places in (("value", 1e-12), ("gradient", 1e-10), ("free_distance", 1e-13)):
        one, two = to_numpy(getattr(found, name)), to_numpy(getattr(other, name))
        np.testing.assert_allclose(one, two, atol=places)
    # Integrals over edges, where single edges have a bound of them.
    for name in ("s4", "s5"):
        one, two = to_numpy(getattr(found, name)), to_numpy(getattr(other, name))
        assert (one > 0.05 * two).all()
        assert (one < 1.5 * two).all()
