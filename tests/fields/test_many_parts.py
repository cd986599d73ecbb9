"""Models of many parts: unions of lists, smooth unions, struts, lattices and patterns of copies."""

from __future__ import annotations

import itertools
import math
import pickle
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.fields.solids import booleans
from harnack.fields.solids.booleans import BlendedSolid, BooleanSolid
from harnack.fields.solids.struts import Struts

POINTS = np.random.default_rng(0).uniform(-1.5, 1.5, (300, 3))
NODES = np.array([[0.0, 0, 0], [1, 0.2, 0], [0.1, 1, 0.3], [0, 0.2, 1]])
EDGES = np.array([[0, 1], [0, 2], [3, 0], [1, 2]])


def balls(count: int, seed: int = 1) -> list[hk.Sphere]:
    rng = np.random.default_rng(seed)
    rows = zip(rng.uniform(0.1, 0.4, count), rng.uniform(-1, 1, (count, 3)), strict=True)
    return [hk.Sphere(float(r), tuple(c)) for r, c in rows]


def ball_values(solids: Any, x: Any) -> Any:
    return np.array([np.linalg.norm(x - s.center, axis=1) - s.radius for s in solids])


def hull_by_search(x: Any, a: Any, b: Any, r: float, s: float) -> Any:
    """The signed distance from the hull of two balls: the nearest of many points of its surface."""
    k = np.arange(200_000) + 0.5
    height, turn = 1 - 2 * k / len(k), k * math.pi * (3 - math.sqrt(5))
    n = np.column_stack([np.sqrt(1 - height**2) * [np.cos(turn), np.sin(turn)][j] for j in (0, 1)])
    n = np.column_stack([n, height])
    is_first = n @ a + r > n @ b + s
    surface = [np.where(is_first[:, None], a + r * n, b + s * n)]
    axis = b - a
    along = axis / np.linalg.norm(axis)
    slope = (r - s) / np.linalg.norm(axis)
    e = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    e /= np.linalg.norm(e)
    turn = np.linspace(0, 2 * np.pi, 400)[:, None]
    across = np.cos(turn) * e + np.sin(turn) * np.cross(along, e)
    normals = slope * along + math.sqrt(1 - slope**2) * across
    t = np.linspace(0, 1, 200)[:, None, None]
    surface.append((a + t * axis + (r + t * (s - r)) * normals).reshape(-1, 3))
    points = np.concatenate(surface)
    distance = np.array([np.linalg.norm(points - p, axis=1).min() for p in x])
    t = np.linspace(0, 1, 2_000)[:, None, None]
    inside = (np.linalg.norm(x - (a + t * axis), axis=-1) < (r + t * (s - r))[..., 0]).any(axis=0)
    return np.where(inside, -distance, distance)


@pytest.mark.parametrize("make", [hk.union, hk.intersection])
def test_one_list_is_like_many_arguments(make: Any) -> None:
    solids = balls(5)
    for combined in (make(solids), make(iter(solids)), make(make(solids[:2]), *solids[2:])):
        assert combined.parts == tuple(solids)
    for wrong, error, text in [
        ([], ValueError, "at least one solid"),
        (["sphere"], TypeError, "not str"),
        ("ab", TypeError, "not str"),
        (3.0, TypeError, "not float"),
        (hk.Gyroid(0.5), TypeError, "make one of it by harnack.solid"),
        ([solids[0], hk.Gyroid(0.5)], TypeError, "make one of it by harnack.solid"),
    ]:
        with pytest.raises(error, match=text):
            make(wrong)
    with pytest.raises(TypeError, match="not list"):
        make(solids[0], solids[1:])
    with pytest.raises(ValueError, match="at least one solid"):
        make()


def test_a_loop_looks_at_each_solid_once(monkeypatch: Any) -> None:
    solids = balls(400)
    calls: list[Any] = []
    seen = booleans.is_checked
    monkeypatch.setattr(booleans, "is_checked", lambda a: calls.append(a) or seen(a))
    total: Any = solids[0]
    for solid in solids[1:]:
        total = total | solid
    assert len(calls) < 2 * len(solids)
    whole = hk.union(solids)
    assert total.parts == whole.parts
    assert total.traits == whole.traits
    assert total.lipschitz == whole.lipschitz == 1.0
    assert total.parameters().keys() == whole.parameters().keys()
    assert total.replace(**{"parts.7.radius": 0.5}).parts[7].radius == 0.5
    assert pickle.loads(pickle.dumps(total)).parts == whole.parts


def test_a_loop_keeps_domains_and_constants() -> None:
    class Egg(hk.fields.FormulaSolid):
        domain = hk.Ball(radius=3.0)

        def formula(self, x: Any, y: Any, z: Any) -> Any:
            return x * x + y * y + 2 * z * z - 1

    a, b, c = balls(3)
    total = a | b | Egg() | c
    assert total.domain == Egg.domain
    assert total.lipschitz is None
    assert (a | b | c | hk.solids.Superellipsoid()).lipschitz > 1.0


def blend(a: Any, b: Any, r: float, p: float) -> Any:
    g = np.maximum(1 - np.array([a, b]) / r, 0)
    near = r * (1 - (g**p).sum(0) ** (1 / p))
    return np.where(np.minimum(a, b) < r, near, np.minimum(a, b))


@pytest.mark.parametrize("power", [2.0, 3.0])
def test_smooth_union_blends_neighbors(power: float) -> None:
    solids = balls(3)
    solid = hk.smooth_union(iter(solids), 0.3, power=power)
    a, b, c = ball_values(solids, POINTS)
    expected = blend(blend(a, b, 0.3, power), c, 0.3, power)
    value = solid.value(POINTS, precision="double")
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-9)
    extent = solid.extent((0.0,))
    assert extent is not None
    assert extent.contains_points(POINTS[expected <= 0]).all()


def test_smooth_union_is_a_balanced_tree() -> None:
    solids = balls(100)

    def depth(solid: Any) -> int:
        return 1 + max(map(depth, solid.parts)) if isinstance(solid, BlendedSolid) else 0

    def leaves(solid: Any) -> list[Any]:
        parts = solid.parts if isinstance(solid, BlendedSolid) else ()
        return [leaf for part in parts for leaf in leaves(part)] or [solid]

    whole = hk.smooth_union(solids, 0.1)
    assert depth(whole) == 7
    assert leaves(whole) == solids
    lower, upper = whole.extent((0.0,)).bounds()  # type: ignore[union-attr]
    # Fillets reach less than the radius beyond the solids.
    sides = np.array([np.array(s.center) + k * s.radius for s in solids for k in (-1, 1)])
    assert (lower <= sides.min(0)).all()
    assert (lower > sides.min(0) - 0.1).all()
    assert (upper < sides.max(0) + 0.1).all()
    assert hk.smooth_union(solids[:1], 0.1) is solids[0]
    copy = pickle.loads(pickle.dumps(whole))
    assert copy.parameters().keys() == whole.parameters().keys()
    assert leaves(copy) == solids


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        (([], 0.1), ValueError, "at least one solid"),
        (([hk.Sphere()], 0.0), ValueError, "radius must be a number above 0, not 0.0"),
        (([hk.Sphere(), hk.Sphere()], math.nan), ValueError, "radius must be a number"),
        ((hk.Sphere(), 0.1), TypeError, "a list of them"),
        (([hk.Sphere(), hk.Gyroid(1.0)], 0.1), TypeError, "harnack.solid"),
    ],
)
def test_what_a_smooth_union_refuses(arguments: Any, error: Any, text: str) -> None:
    with pytest.raises(error, match=text):
        hk.smooth_union(*arguments)


@pytest.mark.parametrize(
    ("end", "radii"),
    [((0.4, 0.5, -0.3), (0.4, 0.15)), ((0.4, 0.5, -0.3), (0.1, 0.3)), ((0, 0, 0.7), (0.2, 0.85))],
)
def test_round_cones_have_the_distance_from_the_nearest_point(end: Any, radii: Any) -> None:
    start = (-0.2, 0.1, 0.0)
    solid = hk.solids.RoundCone(start, end, radii)
    x = np.concatenate([POINTS[:60], np.linspace(start, end, 7) + np.array([0.01, 0.02, 0.03])])
    expected = hull_by_search(x, np.array(start), np.array(end), *radii)
    value = solid.value(x, precision="double")
    assert (value > 0).any()
    assert (value < 0).any()
    assert (np.sign(value) == np.sign(expected)).all()
    # The nearest of the points is a little farther than the nearest point.
    assert (np.abs(expected) > np.abs(value) - 1e-9).all()
    np.testing.assert_allclose(value, expected, rtol=0, atol=6e-4)


def test_round_cones_of_equal_radii_are_capsules_and_of_nested_balls_are_balls() -> None:
    ends = (0.0, 0.1, 0.2), (0.5, -0.3, 0.4)
    on_axis = np.linspace(*ends, 5)
    x = np.concatenate([POINTS, on_axis])

    def value(solid: Any) -> Any:
        return solid.value(x, precision="double")

    def same(a: Any, b: Any) -> None:
        np.testing.assert_allclose(value(a), value(b), rtol=0, atol=1e-12)

    cone = hk.solids.RoundCone
    same(cone(*ends, (0.3, 0.3)), hk.Capsule(*ends, 0.3))
    same(cone(*ends, (0.1, 0.9)), hk.Sphere(0.9, ends[1]))
    same(cone(*ends, (0.9, 0.1)), hk.Sphere(0.9, ends[0]))
    same(cone(ends[0], ends[0], (0.4, 0.4)), hk.Sphere(0.4, ends[0]))
    # Nearly nested, where the cone is a sliver.
    length = math.dist(*ends)
    same(cone(*ends, (0.9, 0.9 - length * (1 - 1e-14))), hk.Sphere(0.9, ends[0]))
    for wrong in ((0.1,), 0.1, (0.1, 0.0), (0.1, math.nan), (0.1, 0.2, 0.3)):
        with pytest.raises(ValueError, match="the radii of a round cone"):
            cone(*ends, wrong)  # type: ignore[arg-type]


def test_struts_are_the_hulls_of_their_balls() -> None:
    radii = np.array([0.3, 0.1, 0.2, 0.1])
    solid = hk.solids.struts(NODES, EDGES, radii)
    t = np.linspace(0, 1, 20_001)
    expected = np.full(60, np.inf)
    x = POINTS[:60]
    for a, b in EDGES:
        axis, r = (
            NODES[a] + t[:, None] * (NODES[b] - NODES[a]),
            radii[a] + t * (radii[b] - radii[a]),
        )
        distance = np.linalg.norm(x[:, None] - axis, axis=-1) - r
        expected = np.minimum(expected, distance.min(axis=1))
    np.testing.assert_allclose(solid.value(x, precision="double"), expected, rtol=0, atol=1e-7)
    assert isinstance(solid, Struts)
    assert {type(solid.strut(k)) for k in range(len(EDGES))} == {hk.solids.RoundCone}
    same = hk.solids.struts(NODES, EDGES, 0.1)
    assert isinstance(same, Struts)
    assert same.strut(2) == hk.Capsule(tuple(NODES[3]), tuple(NODES[EDGES[2][1]]), 0.1)
    smooth = hk.solids.struts(NODES, EDGES, 0.1, smooth=0.2)
    assert isinstance(smooth, BlendedSolid)
    assert (smooth.radius, smooth.power) == (0.2, 2.0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"nodes": NODES[:, :2]}, "the nodes of struts must have shape"),
        ({"nodes": NODES * math.nan}, "node 0 of struts"),
        ({"edges": [[0, 4]]}, "edge 0 joins nodes 0 and 4: there are 4 nodes"),
        ({"edges": [[0, -1]]}, "edge 0 joins nodes 0 and -1"),
        ({"edges": [[0, 1], [2, 2]]}, "edge 1 has no length"),
        ({"edges": [[0.0, 1.0]]}, "integer indices"),
        ({"edges": np.zeros((0, 2), int)}, "shape \\(m, 2\\)"),
        ({"radius": 0.0}, "the radius of struts must be positive"),
        ({"radius": [0.1, 0.1, -0.1, 0.1]}, "the radius of node 2 of struts must be positive"),
        ({"radius": [0.1, 0.1, math.nan, 0.1]}, "the radius of node 2"),
        ({"radius": [0.1, 0.1]}, "a number or has shape \\(4,\\), one for each node, not \\(2,\\)"),
        ({"smooth": -1.0}, "radius must be a number above 0"),
    ],
)
def test_what_struts_refuse(change: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        hk.solids.struts(**({"nodes": NODES, "edges": EDGES, "radius": 0.1} | change))


# Nodes and edges of a single cell; the numbers of edges at nodes in the interior; the length of an
# edge for a cell of side 1.
LATTICES = {
    "cubic": (8, 12, {6}, 1.0),
    "bcc": (9, 8, {8}, math.sqrt(3) / 2),
    "fcc": (14, 24, {4, 12}, math.sqrt(2) / 2),
    "octet": (14, 36, {12}, math.sqrt(2) / 2),
    "diamond": (14, 16, {4}, math.sqrt(3) / 4),
    "kagome": (16, 30, {6}, math.sqrt(2) / 4),
}


@pytest.mark.parametrize("name", LATTICES)
def test_lattices_are_the_graphs_they_are_named_after(name: str) -> None:
    make = getattr(hk.lattice, name)
    node_count, edge_count, coordination, length = LATTICES[name]
    cell = make(1.0, 1)
    assert (len(cell.nodes), len(cell.edges)) == (node_count, edge_count)
    lattice = make(0.7, (3, 4, 5))
    half = 0.35 * np.array([3, 4, 5])
    assert (np.abs(lattice.nodes) <= half + 1e-12).all()
    is_interior = (np.abs(lattice.nodes) < half - 0.69).all(axis=1)
    assert set(lattice.coordination[is_interior]) == coordination
    start, end = (lattice.nodes[ends] for ends in lattice.edges.T)
    np.testing.assert_allclose(np.linalg.norm(end - start, axis=1), 0.7 * length, rtol=1e-12)
    # Nodes and edges are there once; all nodes have edges; opposite sides are alike.
    assert len(np.unique(lattice.nodes.round(9), axis=0)) == len(lattice.nodes)
    assert len(np.unique(np.sort(lattice.edges, axis=1), axis=0)) == len(lattice.edges)
    assert lattice.coordination.min() >= 1
    # Moved by a period, the interior is the same graph.
    middles = {tuple(m) for m in (0.5 * (start + end)).round(6) + 0.0}
    inner, step = 0.5 * (start + end), np.array([0.7, 0, 0])
    moved = (inner + step)[(np.abs(inner + step) < half - 0.36).all(axis=1)]
    assert {tuple(m) for m in moved.round(6) + 0.0} <= middles
    assert len(moved) > 20


def test_bonds_of_diamond_are_at_equal_angles() -> None:
    lattice = hk.lattice.diamond(1.0, 3)
    middle = int(np.flatnonzero(lattice.coordination == 4)[0])
    ends = lattice.edges[(lattice.edges == middle).any(axis=1)]
    bonds = lattice.nodes[ends.sum(axis=1) - middle] - lattice.nodes[middle]
    bonds /= np.linalg.norm(bonds, axis=1)[:, None]
    cosines = (bonds @ bonds.T)[~np.eye(4, dtype=bool)]
    np.testing.assert_allclose(cosines, -1 / 3, atol=1e-12)


@pytest.mark.parametrize("region", [hk.Ball((0.3, 0, 0), 1.2), hk.Box((-1, -1, -1), (0.4, 1, 0.2))])
def test_clipped_lattices_keep_the_edges_that_touch(region: Any) -> None:
    lattice = hk.lattice.bcc((1.0, 1.0, 0.8), (4, 3, 4))
    clipped = lattice.clipped(region)

    def middles(a: Any) -> set[Any]:
        return {tuple(m) for m in a.nodes[a.edges].mean(axis=1).round(9) + 0.0}

    start, end = (lattice.nodes[ends] for ends in lattice.edges.T)
    t = np.linspace(0, 1, 2_001)[:, None, None]
    x = start + t * (end - start)
    inside = region.contains_points(x.reshape(-1, 3)).reshape(x.shape[:2]).any(axis=0)
    assert middles(clipped) == {tuple(m) for m in (0.5 * (start + end))[inside].round(9) + 0.0}
    assert 0 < inside.sum() < len(inside)
    assert clipped.coordination.min() >= 1


def test_lattices_fill_regions() -> None:
    ball = hk.Sphere(1.3, (5.0, 0.0, 0.0))
    lattice = hk.lattice.octet(0.5, region=ball)
    distance = np.linalg.norm(lattice.nodes - [5, 0, 0], axis=1)
    length = 0.5 * math.sqrt(0.5)
    assert distance.max() < 1.3 + length
    # Each node of the whole lattice that is inside is there: six cells to a side.
    whole = hk.lattice.octet(0.5, 6)
    inside = np.linalg.norm(whole.nodes, axis=1) < 1.3
    nodes = {tuple(p) for p in (lattice.nodes - [5, 0, 0]).round(6) + 0.0}
    assert {tuple(p) for p in whole.nodes[inside].round(6) + 0.0} <= nodes
    by_volume = hk.lattice.octet(0.5, region=hk.Ball((5.0, 0.0, 0.0), 1.3))
    assert len(by_volume.edges) <= len(lattice.edges)
    cut = by_volume.struts(0.05, smooth=0.02) & ball
    assert isinstance(cut, BooleanSolid)


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: hk.lattice.bcc(0.0, 2), ValueError, "the cell of a lattice must be positive"),
        (lambda: hk.lattice.bcc((1, 2), 2), ValueError, "three numbers"),
        (lambda: hk.lattice.bcc(1.0, 0), ValueError, "counts must be one or three positive"),
        (lambda: hk.lattice.bcc(1.0, 1.5), ValueError, "counts must be one or three positive"),
        (lambda: hk.lattice.bcc(1.0), ValueError, "give counts"),
        (lambda: hk.lattice.bcc(1.0, 2, region=hk.Ball()), ValueError, "give counts"),
        (lambda: hk.lattice.bcc(1.0, region=3), TypeError, "not int"),
        (lambda: hk.lattice.bcc(1.0, region=hk.Cylinder(1.0)), ValueError, "has no bounds"),
        (lambda: hk.lattice.bcc(1.0, 2).clipped(hk.Ball((9, 9, 9), 1)), ValueError, "no edge"),
        (lambda: hk.lattice.bcc(1.0, 2).clipped(3), TypeError, "a volume or a solid"),  # type: ignore[arg-type]
        (lambda: hk.lattice.Lattice(NODES, [[0, 9]]), ValueError, "edge 0 joins nodes 0 and 9"),
    ],
)
def test_what_lattices_refuse(make: Any, error: Any, text: str) -> None:
    with pytest.raises(error, match=text):
        make()


def test_copies_are_where_they_are_put() -> None:
    shape = hk.Sphere(0.2, (0.5, 0.1, 0.0))
    center, x, y, z = np.array([0.5, 0.1, 0.0]), *np.eye(3)
    turn = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]])
    oblique = np.array([[0.4, 0, 0], [0.1, 0.5, 0], [0, 0.2, 0.3]])
    angles = 2 * np.pi * np.arange(5) / 5
    square = np.vstack([turn, [0, 0, 0, 1]])
    cases: list[tuple[Any, Any]] = [
        (shape.arranged(NODES), center + NODES),
        (shape.arranged([turn, turn]), [turn[:, :3] @ center + turn[:, 3]] * 2),
        (shape.arranged([square]), [turn[:, :3] @ center + turn[:, 3]]),
        (shape.repeated(0.4, (3, 1, 1)), [center + 0.4 * k * x for k in range(3)]),
        (shape.repeated((0.4, 0.5, 1), (2, 2, 1)),
         [center + 0.4 * i * x + 0.5 * j * y for i, j in itertools.product(range(2), repeat=2)]),
        (shape.repeated(oblique, (1, 2, 2)),
         [center + i * oblique[1] + j * oblique[2]
          for i, j in itertools.product(range(2), repeat=2)]),
        (shape.mirrored(), [center, center * [-1, 1, 1]]),
        (shape.mirrored("z", 0.4), [center, center + 0.8 * z]),
        (shape.mirrored((3, 4, 0), 0.1),
         [center, center - 2 * (center @ [0.6, 0.8, 0] - 0.1) * np.array([0.6, 0.8, 0])]),
        (shape.around(5), [[0.5 * math.cos(a) - 0.1 * math.sin(a),
                            0.5 * math.sin(a) + 0.1 * math.cos(a), 0] for a in angles]),
        (shape.around(2, "x"), [center, center * [1, -1, -1]]),
    ]  # fmt: skip
    for solid, centers in cases:
        assert len(solid.parts) == len(centers)
        extent = solid.extent((0.0,))
        lower, upper = extent.bounds()
        np.testing.assert_allclose(lower, np.min(centers, axis=0) - 0.2, atol=1e-5)
        np.testing.assert_allclose(upper, np.max(centers, axis=0) + 0.2, atol=1e-5)
    assert cases[3][0].parts[0] is shape
    assert cases[9][0].parts[0] is shape
    for solid, centers in cases[3], cases[8]:
        distance = np.linalg.norm(POINTS[:, None] - np.array(centers), axis=-1).min(axis=1) - 0.2
        value = solid.value(POINTS, precision="double")
        np.testing.assert_allclose(value, distance, rtol=0, atol=1e-12)


def test_copies_of_a_combination_are_of_all_its_parts() -> None:
    pair = hk.Sphere(0.2) | hk.Cuboid((1, 1, 0.1))
    assert len(pair.repeated(2.0, (3, 2, 1)).parts) == 12  # type: ignore[attr-defined]
    cut = hk.Sphere(0.5) - hk.Cuboid((1, 1, 0.1))
    rows = cut.repeated(2.0, (3, 1, 1))
    assert len(rows.parts) == 3  # type: ignore[attr-defined]
    lower, upper = rows.extent((0.0,)).bounds()  # type: ignore[union-attr]
    np.testing.assert_allclose([lower[0], upper[0]], [-0.5, 4.5], atol=1e-5)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda s: s.arranged([[1, 2]]), "shape \\(n, 3\\)"),
        (lambda s: s.arranged([1, 2, 3]), "shape \\(n, 3\\)"),
        (lambda s: s.arranged(np.zeros((0, 3))), "give at least one"),
        (lambda s: s.arranged([[1, 2, math.nan]]), "transform 0 is"),
        (lambda s: s.arranged([np.zeros((3, 4))]), "singular"),
        (lambda s: s.repeated(0.0, 2), "period 0 is 0: 2 copies"),
        (lambda s: s.repeated((1, 0, 1), (2, 2, 2)), "period 1 is 0: 2 copies"),
        (lambda s: s.repeated((1, 2), 2), "the period must be a number, three numbers or three"),
        (lambda s: s.repeated(math.inf, 2), "the period must be finite"),
        (lambda s: s.repeated(1.0, (2, 2)), "counts must be one or three positive integers"),
        (lambda s: s.repeated(1.0, 0), "counts must be one or three positive integers"),
        (lambda s: s.mirrored("w"), "axis must be"),
        (lambda s: s.mirrored((0, 0, 0)), "a vector \\(3,\\) that is not zero"),
        (lambda s: s.mirrored("x", math.inf), "the offset of the mirror"),
        (lambda s: s.around(0), "must be a positive integer"),
        (lambda s: s.around(2.5), "must be a positive integer"),
        (lambda s: s.around(3, (0, 0, 0)), "axis must be a vector"),
    ],
)
def test_what_patterns_refuse(make: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make(hk.Sphere(0.2))


def test_only_solids_have_patterns() -> None:
    with pytest.raises(AttributeError, match="make a solid of the field first"):
        hk.Gyroid(0.5).repeated(1.0, 2)  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
def test_first_hits_of_a_lattice(precision: Any) -> None:
    """Of 384 struts: no ray passes what is inside before its hit; hits are on the surface."""
    lattice = hk.lattice.bcc(0.5, (4, 4, 3))
    rng, n = np.random.default_rng(3), 200
    o = rng.normal(size=(n, 3))
    o = 3 * o / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-0.9, 0.9, (n, 3)) - o
    o, d = (v.astype(np.float32).astype(float) for v in (o, d))
    d /= np.linalg.norm(d, axis=1)[:, None]
    hits = hk.trace(lattice.struts(0.05), o, d, t_max=6.0, precision=precision)
    status = np.array(hits.status)
    assert (status != int(hk.RayStatus.OUT_OF_STEPS)).all()
    is_hit = status == int(hk.RayStatus.HIT)
    assert 0.2 < is_hit.mean() < 1.0
    end = np.where(is_hit, np.array(hits.t), 6.0)
    start, stop = (lattice.nodes[ends] for ends in lattice.edges.T)

    def distance(x: Any) -> Any:
        axis = stop - start
        t = np.clip(((x[:, None] - start) * axis).sum(-1) / (axis * axis).sum(-1), 0, 1)
        return np.linalg.norm(x[:, None] - start - t[..., None] * axis, axis=-1).min(axis=1) - 0.05

    for share in np.linspace(0, 1, 301)[:-1]:
        assert (distance(o + share * end[:, None] * d) > -1e-5).all()
    assert np.abs(distance(o + end[:, None] * d)[is_hit]).max() < 1e-3
