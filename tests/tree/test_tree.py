"""Trees over primitives: what lies where, what a walk visits, and rays through triangles."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.geometry.example_meshes import bumpy_sphere, torus_mesh
from harnack.tree import (
    NO_PRIMITIVE,
    BalancedTree,
    build_balanced_tree,
    for_each_primitive,
    pack_tree,
    traverse,
)
from harnack.tree.triangle_tree import RayFrame, TriangleTree, triangle_records

SIZES = [1, 2, 3, 7, 8, 9, 15, 16, 17, 33, 63, 100, 257, 1000]
NO_TRIANGLE = 0xFFFFFFFF


def points(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [3.0, 1.0, 0.2]


# --- hierarchy ------------------------------------------------------------------------------


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("leaf_size", [1, 2, 5, 8])
@pytest.mark.parametrize("arity", [2, 4])
def test_every_primitive_lies_in_one_slot(n: int, leaf_size: int, arity: int) -> None:
    tree = build_balanced_tree(points(n), leaf_size=leaf_size, arity=arity)
    taken = tree.leaf_slots[tree.leaf_slots != NO_PRIMITIVE]
    np.testing.assert_array_equal(np.sort(taken), np.arange(n))
    filled = (tree.leaf_slots != NO_PRIMITIVE).sum(axis=1)
    assert filled.max() - filled.min() <= 1
    assert filled.max() <= leaf_size
    # The empty slot of a leaf is its last.
    assert (tree.leaf_slots[:, :-1] != NO_PRIMITIVE).all()
    assert tree.counts[0] == len(tree.leaf_slots)
    assert tree.counts[-1] == 1
    assert tree.node_count == sum(tree.counts)
    assert set(tree.arities[:-1]) <= {arity}


@pytest.mark.parametrize("where", ["all equal", "on a line", "on a grid"])
def test_points_that_coincide(where: str) -> None:
    n = 150
    x = {
        "all equal": np.ones((n, 3)),
        "on a line": np.arange(n)[:, None] * np.ones(3),
        "on a grid": np.random.default_rng(0).integers(0, 3, (n, 3)).astype(float),
    }[where]
    tree = build_balanced_tree(x)
    taken = tree.leaf_slots[tree.leaf_slots != NO_PRIMITIVE]
    np.testing.assert_array_equal(np.sort(taken), np.arange(n))


def test_splits_are_along_the_longest_side() -> None:
    """Both halves of the points of a thin rod lie apart."""
    x = points(64)
    x[:, 0] = 100 * np.arange(64)[::-1]
    tree = build_balanced_tree(x, leaf_size=8, arity=2)
    spans = x[tree.leaf_slots][..., 0]
    order = spans.min(axis=1).argsort()
    assert (spans.max(axis=1)[order][:-1] < spans.min(axis=1)[order][1:]).all()


@pytest.mark.parametrize("arity", [0, 3, 8])
def test_other_arities_are_refused(arity: int) -> None:
    with pytest.raises(ValueError, match="arity must be 2 or 4"):
        build_balanced_tree(points(5), arity=arity)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("arity", [2, 4])
def test_links_lead_depth_first_and_keep_siblings_together(n: int, arity: int) -> None:
    tree = build_balanced_tree(points(n), leaf_size=2, arity=arity)
    number, first, after = tree.node_links()
    assert sorted(np.concatenate(number).tolist()) == list(range(tree.node_count))
    assert (first[0] == 0).all()

    def visit(level: int, node: int, following: int) -> None:
        assert after[level][node] == following
        if not level:
            return
        arity = tree.arities[level - 1]
        children = number[level - 1][node * arity : (node + 1) * arity].tolist()
        assert children == list(range(first[level][node], first[level][node] + arity))
        for k in range(arity):
            visit(level - 1, node * arity + k, [*children, following][k + 1])

    assert number[-1][0] == 0
    visit(len(tree.arities), 0, tree.node_count)


def test_gather_fills_empty_slots() -> None:
    tree = build_balanced_tree(points(9), leaf_size=8)
    values = np.arange(9.0) + 1
    placed = tree.values_in_slots(values, -7.0)
    assert placed.shape == tree.leaf_slots.shape
    np.testing.assert_array_equal(
        placed[tree.leaf_slots >= 0], values[tree.leaf_slots[tree.leaf_slots >= 0]]
    )
    assert (placed[tree.leaf_slots < 0] == -7).all()
    assert (tree.leaf_slots < 0).sum() == 1


# --- walk -----------------------------------------------------------------------------------


def visits(tree: BalancedTree, flags: list[np.ndarray], lanes: int = 1, active: Any = True) -> Any:
    """How often each primitive is met by all lanes together; nodes without a flag are passed."""
    backend = choose_backend("single")
    n = int(tree.leaf_slots.max()) + 1
    levels = [np.tile(flag.astype(float)[:, None], (1, 6)) for flag in flags]
    packed = pack_tree(backend, tree, levels, tree.leaf_slots[..., None].astype(float))
    counts = dr.zeros(backend.UInt32, n)

    def visit(node: Any, state: tuple[Any, ...]) -> Any:
        open_ = node.head[0] > 0
        return open_, for_each_primitive(node, open_ & node.is_leaf, meet, state)

    def meet(row: list[Any], active: Any, state: tuple[Any, ...]) -> Any:
        taken = active & (row[0] >= 0)
        place = backend.UInt32(dr.select(row[0] >= 0, row[0], 0))
        dr.scatter_add(counts, backend.UInt32(1), place, taken)
        return (state[0] + dr.select(taken, backend.UInt32(1), 0),)

    start = dr.zeros(backend.UInt32, lanes)
    (total,) = traverse(packed, visit, (start,), active)
    dr.eval(total, counts)
    return to_numpy(counts), to_numpy(total)


@pytest.mark.parametrize("n", SIZES)
def test_a_walk_meets_every_primitive_once(n: int) -> None:
    for arity in (2, 4):
        tree = build_balanced_tree(points(n), leaf_size=4, arity=arity)
        counts, total = visits(tree, [np.ones(k) for k in tree.counts])
        np.testing.assert_array_equal(counts, np.ones(n))
        assert total.tolist() == [n]


@pytest.mark.parametrize("arity", [2, 4])
def test_a_walk_passes_over_subtrees(arity: int) -> None:
    rng = np.random.default_rng(5)
    tree = build_balanced_tree(points(200), leaf_size=4, arity=arity)
    flags = [rng.random(k) < 0.8 for k in tree.counts]
    flags[-1][:] = True
    above = np.ones(1, bool)
    for level in range(len(flags) - 1, -1, -1):
        above = flags[level] & above
        if level:
            above = np.repeat(above, tree.arities[level - 1])
    expected = np.zeros(200)
    slots = tree.leaf_slots[above]
    expected[slots[slots >= 0]] = 1
    assert 10 < expected.sum() < 190
    np.testing.assert_array_equal(visits(tree, flags)[0], expected)


def test_lanes_that_are_not_active_do_not_walk() -> None:
    backend = choose_backend("single")
    tree = build_balanced_tree(points(50))
    active = dr.arange(backend.UInt32, 8) % 2 == 0
    _, total = visits(tree, [np.ones(k) for k in tree.counts], 8, active)
    assert total.tolist() == [50, 0] * 4


@pytest.mark.slow
def test_payload_and_leaves_are_those_of_the_node() -> None:
    backend = choose_backend("double")
    tree = build_balanced_tree(points(100), leaf_size=4)
    levels = [np.random.default_rng(0).normal(size=(k, 6 + 13)) for k in tree.counts]
    packed = pack_tree(backend, tree, levels, tree.leaf_slots[..., None].astype(float))
    number, first, after = tree.node_links()
    for level, values in enumerate(levels):
        for node in (0, len(values) // 2, len(values) - 1):
            i = backend.UInt32(int(number[level][node]))
            row = [float(v[0]) for v in packed.head(i) + packed.payload(i, True)]
            assert row[:6] == values[node, :6].tolist()
            assert row[6] == after[level][node]
            assert row[7] == (node if level == 0 else -first[level][node])
            assert row[8:21] == values[node, 6:].tolist()
            assert row[21:] == [0, 0, 0]


# --- rays -----------------------------------------------------------------------------------


def ray_tree(backend: Any, vertices: np.ndarray, faces: np.ndarray) -> TriangleTree:
    tree = build_balanced_tree(vertices[faces].mean(axis=1))
    return TriangleTree.of(backend, tree, triangle_records(vertices, faces))


def frame_of(backend: Any, o: np.ndarray, d: np.ndarray) -> RayFrame:
    return RayFrame.along(backend, to_vector3(backend, o), to_vector3(backend, d))


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def targets(vertices: np.ndarray, faces: np.ndarray, n: int, seed: int) -> np.ndarray:
    """Vertices, middles of edges, points of faces, and anywhere: a quarter of each."""
    rng = np.random.default_rng(seed)
    face = vertices[faces[rng.integers(len(faces), size=n)]]
    weights = rng.dirichlet(np.ones(3), n)
    kind = np.arange(n) % 4
    weights[kind == 0] = [1, 0, 0]
    weights[kind == 1] = [0.5, 0.5, 0]
    aim = (weights[..., None] * face).sum(axis=1)
    aim[kind == 3] = rng.uniform(-1, 1, ((kind == 3).sum(), 3))
    return aim


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("shape", ["sphere", "torus"])
def test_turns_ahead_tell_inside_from_outside(precision: Any, shape: str) -> None:
    """However a ray leaves: through faces, edges or vertices."""
    backend = choose_backend(precision)
    rng = np.random.default_rng(1)
    n = 4000
    if shape == "sphere":
        vertices, faces = bumpy_sphere(2)
        o = unit(rng.normal(size=(n, 3))) * rng.choice([0.2, 0.6, 1.3, 3.0], (n, 1))
        inside = np.linalg.norm(o, axis=1) < 1
    else:
        vertices, faces = torus_mesh(1.0, 0.4, 24, 12)
        angle = rng.uniform(0, 2 * np.pi, n)
        radius = rng.choice([1.0, 0.3, 1.9], n)
        o = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)])
        inside = radius == 1.0
    rays = ray_tree(backend, vertices, faces)
    d = unit(targets(vertices, faces, n, 2) - o)
    d[::50] = np.eye(3)[rng.integers(3, size=len(d[::50]))]
    turns = to_numpy(rays.signed_crossings_ahead(frame_of(backend, o, d), 0, backend.Bool(True)))
    np.testing.assert_array_equal(turns, inside)
    for way in (1, -1):  # turns are about the axis upwards
        turns = to_numpy(rays.signed_crossings_vertical(to_vector3(backend, o), backend.Float(way)))
        np.testing.assert_array_equal(way * turns, inside)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_rays_exactly_through_vertices_and_edges(precision: Any) -> None:
    """A cube's and an octahedron's, along axes and diagonals: all that is decided is a tie."""
    backend = choose_backend(precision)
    cube = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1, 1) for z in (-1, 1)])
    cube_faces = np.array([
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ])  # fmt: skip
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    octahedron_faces = np.array([
        [0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
        [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5],
    ])  # fmt: skip
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    ways = unit(grid[np.abs(grid).sum(axis=1) > 0])
    origins = np.concatenate([np.zeros((1, 3)), 0.25 * grid, 4 * ways])
    o = np.repeat(origins, len(ways), axis=0)
    d = np.tile(ways, (len(origins), 1))
    for vertices, faces in ((cube, cube_faces), (octahedron, octahedron_faces)):
        rays = ray_tree(backend, vertices, faces)
        inside = np.abs(o).sum(axis=1) < 1
        turns = to_numpy(
            rays.signed_crossings_ahead(frame_of(backend, o, d), 0, backend.Bool(True))
        )
        np.testing.assert_array_equal(turns, inside)
        for way in (1, -1):
            turns = to_numpy(
                rays.signed_crossings_vertical(to_vector3(backend, o), backend.Float(way))
            )
            np.testing.assert_array_equal(way * turns, inside)


def brute_crossings(o: np.ndarray, d: np.ndarray, triangles: np.ndarray) -> Any:
    """t (n, m), inf where ray and triangle do not meet, and turns (Moeller and Trumbore 1997)."""
    p, q, r = np.moveaxis(triangles, 1, 0)
    e, f = q - p, r - p
    h = np.cross(d[:, None], f[None])
    a = (e * h).sum(axis=-1)
    s = o[:, None] - p
    u = (s * h).sum(axis=-1) / a
    g = np.cross(s, np.broadcast_to(e, s.shape))
    v = (d[:, None] * g).sum(axis=-1) / a
    t = (f * g).sum(axis=-1) / a
    meets = (u >= 0) & (v >= 0) & (u + v <= 1)
    turn = np.sign((np.cross(e, f)[None] * d[:, None]).sum(axis=-1))
    return np.where(meets, t, np.inf), turn


@pytest.mark.parametrize("copies", [1, 2])
def test_crossings_come_in_order(copies: int) -> None:
    """By t, then by number: duplicates have equal t, and none is left out."""
    backend = choose_backend("double")
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1, 1, (60, 1, 3)) + rng.normal(0, 0.5, (60, 3, 3))
    vertices = corners.reshape(-1, 3)
    faces = np.tile(np.arange(180).reshape(-1, 3), (copies, 1))
    n = 500
    o, target = rng.uniform(-2, 2, (2, n, 3))
    d = unit(target - o)
    t_max = 2.5
    t, turn = brute_crossings(o, d, vertices[faces])
    t = np.where((t > 0) & (t <= t_max), t, np.inf)
    rays, frame = ray_tree(backend, vertices, faces), frame_of(backend, o, d)
    after: Any = (backend.Float(0), backend.UInt32(NO_TRIANGLE))
    met = 0
    for k in range(200):
        where, number, side, normal = rays.next_crossing(
            frame, after, backend.Float(t_max), backend.Bool(True)
        )
        dr.eval(where, number, side, normal)
        order = np.lexsort((np.tile(np.arange(len(faces)) % 60, (n, 1)), t), axis=1)[:, k]
        rows = np.arange(n)
        expected, found = t[rows, order], to_numpy(where)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        hit = np.isfinite(expected)
        i = to_numpy(number).astype(np.int64)
        assert (i[~hit] == NO_TRIANGLE).all()
        np.testing.assert_array_equal(i[hit] % 60, order[hit] % 60)
        if copies == 2:
            np.testing.assert_array_equal(i[hit] // 60, k % 2)
        np.testing.assert_array_equal(to_numpy(side)[hit], turn[rows, order][hit])
        p, q, r = np.moveaxis(vertices[faces[i[hit]]], 1, 0)
        normals = to_numpy(normal)
        np.testing.assert_allclose(normals[hit], unit(np.cross(q - p, r - p)), atol=1e-9)
        met += int(hit.sum())
        if not hit.any():
            break
        after = (where, number)
    assert met == np.isfinite(t).sum()
    assert met > 500 * copies


def test_records_are_alike_for_both_faces_of_an_edge() -> None:
    """Corners ordered by index, with the sign of the order."""
    vertices = np.random.default_rng(0).normal(size=(3, 3))
    for face, parity in (
        ([0, 1, 2], 1), ([1, 2, 0], 1), ([2, 0, 1], 1),
        ([0, 2, 1], -1), ([2, 1, 0], -1), ([1, 0, 2], -1),
    ):  # fmt: skip
        record = triangle_records(vertices, np.array([face]))[0]
        np.testing.assert_array_equal(record[:9], vertices.ravel())
        assert record[9] == parity
        for k, (i, j) in enumerate(((0, 1), (1, 2), (0, 2))):
            length = np.linalg.norm(vertices[i] - vertices[j])
            assert record[11 + k] == pytest.approx(1 / length**2)
