"""Meshes of level sets: topology, boundary, distance from the surface, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cells import Cells, carve, octree
from harnack.geometry import shapes
from harnack.meshing import checks, marching
from harnack.meshing.points import Boundary
from harnack.meshing.samples import LevelFunction
from tests.oracles.oracle import CurveOracle

# Curves with their Euler characteristic at level 2 pi.
CURVES: dict[str, tuple[Any, int]] = {
    "wavy": (shapes.wavy_polygon(64), 1),
    "trefoil": (shapes.torus_knot(2, 3, 96), -1),
    "Hopf link": (shapes.hopf_link(48), 0),
    "T(2,5)": (shapes.torus_knot(2, 5, 160), -3),
    "coil": (shapes.coil(4, 128), 1),
}
QUICK = ("wavy", "trefoil")


def slow_but(quick: tuple[str, ...]) -> list[Any]:
    """All names; those that are not quick are marked as slow."""
    return [
        name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in CURVES
    ]


def loops_of(name: str) -> list[np.ndarray]:
    given = CURVES[name][0]
    return given if isinstance(given, list) else [given]


def runs(edges: np.ndarray) -> set[tuple[int, int]]:
    return {(min(a, b), max(a, b)) for a, b in edges.tolist()}


@pytest.mark.parametrize("name", slow_but(QUICK))
def test_surfaces_of_curves_end_at_the_curve(name: str) -> None:
    """Vertex by vertex, bitwise; and have the topology that they are known to have."""
    loops, expected = loops_of(name), CURVES[name][1]
    mesh = hk.mesh(hk.SolidAngle(loops))
    facts = mesh.metadata["harnack"]
    vertices = np.concatenate(loops)
    assert (mesh.vertices[: len(vertices)] == vertices).all()
    first, edges = 0, []
    for loop in loops:
        edges += [(first + k, first + (k + 1) % len(loop)) for k in range(len(loop))]
        first += len(loop)
    if name == "coil":  # where its ends meet, edges are so near to others that they are cut
        rim = mesh.vertices[facts["boundary"]]
        assert len(rim) <= len(edges) + 16
        length = sum(
            np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum() for loop in loops
        )
        assert np.linalg.norm(rim[:, 1] - rim[:, 0], axis=1).sum() == pytest.approx(length)
    else:
        assert runs(facts["boundary"]) == runs(np.array(edges))
    checks.check_manifold(mesh.faces)
    assert facts["euler_characteristic"] == expected
    assert mesh.body_count == 1
    # The normal points to where the angle grows, but for slivers beside the curve.
    middle = mesh.triangles_center
    slope = hk.SolidAngle(loops).gradient(middle, precision="double")
    turned = (slope * mesh.face_normals).sum(axis=1) <= 0
    assert turned.mean() < 4e-3
    assert mesh.area_faces[turned].sum() < 1e-3 * mesh.area


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("name", ["wavy", "trefoil", "Hopf link", "coil"])
def test_topology_does_not_depend_on_seed_or_spacing(name: str, seed: int) -> None:
    loops, expected = loops_of(name), CURVES[name][1]
    for spacing in (None, 0.08, 0.11):
        mesh = hk.mesh(hk.SolidAngle(loops), spacing=spacing, seed=seed)
        assert mesh.metadata["harnack"]["euler_characteristic"] == expected, spacing


@pytest.mark.parametrize("level", [1.5 * math.pi, 2 * math.pi])
def test_meshes_are_within_the_tolerance(level: float) -> None:
    """Of all points of the mesh; and hits lie on it."""
    loops, rng = loops_of("wavy"), np.random.default_rng(0)
    field, tolerance = hk.SolidAngle(loops), 2e-3
    mesh = hk.mesh(field, level, tolerance=tolerance)
    size = float(np.ptp(mesh.bounds, axis=0).max())
    share = rng.dirichlet([1, 1, 1], (len(mesh.faces), 6))
    points = np.einsum("nks,nsi->nki", share, mesh.triangles).reshape(-1, 3)
    seen = CurveOracle(loops)(points)
    off = seen.value - level
    off -= 4 * math.pi * np.round(off / (4 * math.pi))
    apart = np.abs(off) / np.linalg.norm(seen.gradient, axis=1)
    assert apart.max() < tolerance * size
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    origin = 4.0 * direction
    hits = hk.trace(field, origin, rng.uniform(-0.6, 0.6, origin.shape) - origin, level=level)
    found = hits.position[hits.hit]
    assert len(found) > 500
    assert distances(mesh, found).max() < tolerance * size


def distances(mesh: Any, points: np.ndarray) -> np.ndarray:
    """From points to the triangles of a mesh, one by one."""
    from scipy.spatial import cKDTree

    tree = cKDTree(mesh.triangles_center)
    reach = float(np.linalg.norm(mesh.triangles - mesh.triangles_center[:, None], axis=2).max())
    near = tree.query(points)[0]
    out = np.full(len(points), np.inf)
    for k, (p, r) in enumerate(zip(points, near + 2 * reach, strict=True)):
        triangles = mesh.triangles[tree.query_ball_point(p, r)]
        out[k] = np.sqrt(squares_to_triangles(triangles, p).min())
    return out


def squares_to_triangles(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Squared distances of a point from triangles (n, 3, 3)."""
    normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = ((p - t[:, 0]) * normal).sum(axis=1)
    foot = p - height[:, None] * normal
    inside = np.ones(len(t), bool)
    best = np.full(len(t), np.inf)
    for k in range(3):
        a, b = t[:, k], t[:, (k + 1) % 3]
        inside &= (np.cross(b - a, foot - a) * normal).sum(axis=1) >= 0
        share = np.clip(((p - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1), 0, 1)
        best = np.minimum(best, ((a + share[:, None] * (b - a) - p) ** 2).sum(axis=1))
    return np.where(inside, height**2, best)


def test_long_edges_of_a_coil_need_to_be_integrated() -> None:
    """With large cells wrapped differences are wrong on some edges between its turns."""
    field = hk.SolidAngle(loops_of("coil"))
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (4000, 3)) * [1.2, 1.2, 0.8]
    q = p + rng.normal(size=p.shape) * 0.2
    exact = field.change_along(p, q)
    assert exact is not None
    value = field.value(p, precision="double"), field.value(q, precision="double")
    wrapped = value[1] - value[0]
    wrapped -= 4 * math.pi * np.round(wrapped / (4 * math.pi))
    turns = (exact - wrapped) / (4 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    assert (np.round(turns) != 0).sum() > 20
    # Against the lift followed in small steps.
    steps = np.linspace(0, 1, 400)
    for k in range(40):
        x = p[k] + steps[:, None] * (q[k] - p[k])
        lift = np.unwrap(CurveOracle(loops_of("coil"))(x).value, period=4 * math.pi)
        assert exact[k] == pytest.approx(lift[-1] - lift[0], abs=1e-6)


def test_wrapping_alone_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without integration a mesh of the coil in large cells fails its checks, and says so."""
    field = hk.SolidAngle(loops_of("coil"))
    spacing = 0.16
    hk.mesh(field, spacing=spacing, tolerance=0.05)
    monkeypatch.setattr(marching, "_integrated", lambda field, p, q, wrapped, period: wrapped)
    with pytest.raises(hk.MeshingError, match="spacing"):
        hk.mesh(field, spacing=spacing, tolerance=0.05)


def test_reaches_are_proved() -> None:
    """Within its reach of a point an angle moves by less than a quarter of its period."""
    field, rng = hk.SolidAngle(loops_of("trefoil")), np.random.default_rng(2)
    function = LevelFunction(field, 2 * math.pi)
    x = rng.uniform(-3, 3, (2000, 3))
    samples = function.at(x)
    d = rng.normal(size=x.shape)
    d /= np.linalg.norm(d, axis=1)[:, None]
    change = field.change_along(x, x + samples.reach[:, None] * d)
    assert change is not None
    assert np.abs(change).max() <= math.pi
    assert np.abs(change).max() > 0.55 * math.pi


def test_periodic_surfaces_end_at_the_faces_of_a_box() -> None:
    box = hk.Box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    mesh = hk.mesh(hk.Gyroid(cell=1.0), 0.2, clip=box, tolerance=4e-3)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    assert (np.abs(np.abs(rim).max(axis=1) - 0.5) < 1e-12).all()
    assert np.abs(mesh.vertices).max() <= 0.5
    off = hk.Gyroid(cell=1.0).value(mesh.triangles_center, precision="double") - 0.2
    assert np.abs(off).max() < 4e-3 * 8  # its slope is at most 2 pi sqrt(1.5)
    checks.check_manifold(mesh.faces)


def test_a_domain_that_is_a_ball_cuts() -> None:
    mesh = hk.mesh(hk.Gyroid(1.0, domain=hk.Ball(radius=0.6)), tolerance=8e-3)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    np.testing.assert_allclose(np.linalg.norm(rim, axis=1), 0.6, atol=1e-8)


def test_closed_surfaces_are_watertight() -> None:
    mesh = hk.mesh(hk.Sphere(0.8), tolerance=2e-3)
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=5e-3)


@pytest.mark.parametrize(
    ("field", "arguments", "message"),
    [
        (hk.Plane(), {}, "give clip=harnack.Box"),
        (hk.Gyroid(1.0), {"level": 9.0}, "no surface has level"),
        (hk.Sphere(0.5), {"clip": hk.Box((1, 1, 1), (2, 2, 2))}, "is empty"),
        (hk.SolidAngle(shapes.wavy_polygon(12)), {"level": 4 * math.pi}, "does not say where"),
        (hk.SolidAngle(shapes.wavy_polygon(12)), {"tolerance": 0.0}, "tolerance"),
        (hk.SolidAngle(shapes.wavy_polygon(12)), {"spacing": -1.0}, "spacing"),
        (hk.SolidAngle(hk.Circle(1.0)), {}, "circle.polygon"),
        ("curve", {}, "needs a field"),
    ],
)
def test_what_cannot_be_meshed_is_refused(field: Any, arguments: Any, message: str) -> None:
    with pytest.raises((hk.MeshingError, ValueError, TypeError), match=message):
        hk.mesh(field, **arguments)


def test_a_mesh_with_too_many_faces_at_an_edge_is_noticed() -> None:
    fin = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    with pytest.raises(hk.MeshingError, match="more than two faces"):
        checks.check_manifold(fin)
    with pytest.raises(hk.MeshingError, match="two sides"):
        checks.check_manifold(np.array([[0, 1, 2], [0, 1, 3]]))
    with pytest.raises(hk.MeshingError, match="touch in a point"):
        checks.check_manifold(np.array([[0, 1, 2], [0, 3, 4]]))


def test_long_edges_of_a_curve_are_cut_and_its_vertices_stay_first() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    curve = Boundary.of((square,), 0.4)
    assert (curve.points[:4] == square).all()
    assert len(curve.points) == len(curve.edges) == 12
    lengths = np.linalg.norm(np.diff(curve.points[curve.edges], axis=1), axis=2)
    np.testing.assert_allclose(lengths, 1 / 3)
    assert len(curve.split(np.arange(12) < 2).edges) == 14


def test_cells_of_an_octree_fill_the_box_and_keep_the_set() -> None:
    """A sphere of radius 1: leaves hold it, and all cells together have the volume of the box."""

    def clearance(x: np.ndarray) -> np.ndarray:
        return np.abs(np.linalg.norm(x, axis=1) - 1)

    lower, upper = np.full(3, -2.0), np.array([2.0, 2.0, 3.0])
    tree = octree(Cells(lower[None], upper - lower), clearance, 10_000, 4)
    volume = sum(len(one.corners) * one.size.prod() for one in (tree.leaves, *tree.empty))
    assert volume == pytest.approx((upper - lower).prod())
    on = np.random.default_rng(0).normal(size=(2000, 3))
    on /= np.linalg.norm(on, axis=1)[:, None]
    inside = (on[:, None] >= tree.leaves.corners) & (
        on[:, None] <= tree.leaves.corners + tree.leaves.size
    )
    assert inside.all(axis=2).any(axis=1).all()
    assert len(tree.leaves.corners) < 16**3 / 4
    hull = carve(lower, upper, clearance, 10_000, 4).wrapped(0.0)
    assert hull.contains_points(on).all()
    assert not len(carve(lower, upper, lambda x: np.full(len(x), 9.0), 100, 3).corners)
