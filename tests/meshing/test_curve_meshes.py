"""Meshes of surfaces that end at curves: topology, rim, self-intersections, errors, hard curves."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

import harnack as hk
from harnack.geometry import example_curves
from harnack.meshing import checks
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.mesh_improvement import least_angles, relax_vertices
from harnack.meshing.self_intersection import intersecting_faces
from tests.oracles.oracle import CurveOracle
from tests.oracles.triangle_pairs import intersecting_pairs

PERIOD = 4 * math.pi
# Curves with their Euler characteristic at level 2 pi.
CURVES: dict[str, tuple[Any, int]] = {
    "wavy": (example_curves.wavy_polygon(64), 1),
    "trefoil": (example_curves.torus_knot(2, 3, 96), -1),
    "Hopf link": (example_curves.hopf_link(48), 0),
    "three holes": (example_curves.square_with_holes(24), -2),
    "T(2,5)": (example_curves.torus_knot(2, 5, 160), -3),
    "T(3,4)": (example_curves.torus_knot(3, 4, 200), -5),
    "Borromean rings": (example_curves.borromean_rings(64), -3),
    "figure-eight": (example_curves.figure_eight_knot(160), -5),
    "coil": (example_curves.coil(4, 128), 1),
}
QUICK = ("Hopf link", "three holes")


def named(quick: tuple[str, ...]) -> list[Any]:
    """All names; those that are not quick are marked as slow."""
    return [
        name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in CURVES
    ]


def loops_of(name: str) -> list[np.ndarray]:
    given = CURVES[name][0]
    return given if isinstance(given, list) else [given]


def longest_side(loops: list[np.ndarray]) -> float:
    return float(np.ptp(np.concatenate(loops), axis=0).max())


def undirected(edges: Any) -> set[tuple[int, int]]:
    return {(min(a, b), max(a, b)) for a, b in np.asarray(edges).tolist()}


def check_surface(mesh: Any, loops: list[np.ndarray], expected: int) -> None:
    """Its rim is the curve by index and bitwise; it is an oriented manifold without
    self-intersections, of that Euler characteristic, and faces the way the angle grows."""
    vertices = np.concatenate(loops)
    assert (mesh.vertices[: len(vertices)] == vertices).all()
    first, edges = 0, []
    for loop in loops:
        edges += [(first + k, first + (k + 1) % len(loop)) for k in range(len(loop))]
        first += len(loop)
    facts = mesh.metadata["harnack"]
    assert undirected(facts["boundary"]) == undirected(edges)
    checks.check_manifold(mesh.faces)
    assert facts["euler_characteristic"] == expected
    assert mesh.is_winding_consistent
    assert not len(intersecting_pairs(mesh.vertices, mesh.faces))
    assert facts["turned"] == 0


@pytest.mark.few(1)
@pytest.mark.parametrize("name", named(QUICK))
def test_surfaces_of_curves_end_at_the_curve(name: str) -> None:
    loops, expected = loops_of(name), CURVES[name][1]
    mesh = hk.mesh(hk.SolidAngle(loops), tolerance=2e-3 * longest_side(loops))
    check_surface(mesh, loops, expected)
    assert mesh.body_count == 1
    facts = mesh.metadata["harnack"]
    assert facts["isotopy_far"] >= 0.95
    assert 0.4 < facts["isotopy"] < facts["isotopy_far"]
    assert fifth_percentile_of_angles(mesh) >= 27
    slope = hk.SolidAngle(loops).gradient(mesh.triangles_center, precision="double")
    turned = (slope * np.cross(*edge_vectors(mesh))).sum(axis=1) <= 0
    assert turned.mean() < 1e-3  # only between a long edge and the chain beside it


def fifth_percentile_of_angles(mesh: Any) -> float:
    """In degrees, of least angles of all triangles."""
    return float(np.percentile(np.degrees(least_angles(mesh.vertices, mesh.faces)), 5))


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVES)
def test_angles_at_the_default_tolerance(name: str) -> None:
    """24 degrees in the coil, whose rim has edges four times as long as those beside it, before
    vertices of thin triangles were relaxed; without that, this fails."""
    assert fifth_percentile_of_angles(hk.mesh(hk.SolidAngle(loops_of(name)))) >= 26.5


def test_relaxed_triangles_have_larger_angles_and_the_same_rim() -> None:
    """Of a disc with random vertices; what is moved stays on the plane and turns no triangle."""
    rng = np.random.default_rng(0)
    disc = example_curves.wavy_polygon(24, amplitude=0.0)
    x = np.concatenate([disc, np.column_stack([*rng.uniform(-0.6, 0.6, (2, 60)), np.zeros(60)])])
    faces = Delaunay(x[:, :2]).simplices.astype(np.int64)
    flat = LevelFunction(hk.solids.Plane((0.0, 0.0, 1.0)), 0.0)
    moved = relax_vertices(flat, x, faces, 1.0, None)
    before, after = (least_angles(y, faces) for y in (x, moved))
    assert (moved[: len(disc)] == disc).all()
    assert np.abs(moved[:, 2]).max() < 1e-12
    corner = moved[faces]
    assert (np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > 0).all()
    assert after.min() >= before.min()
    assert np.percentile(after, 5) > 1.5 * np.percentile(before, 5)


def edge_vectors(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    corner = mesh.triangles
    return corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "spacing"), [(1, None), (2, 0.09)])
@pytest.mark.parametrize("name", CURVES)
def test_topology_does_not_depend_on_place_or_spacing(
    name: str, seed: int, spacing: float | None
) -> None:
    """Each seed turns and moves the curve, so that other edges of tetrahedra cross it."""
    rng = np.random.default_rng(seed)
    turn, move = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3)
    loops = [loop @ turn.T + move for loop in loops_of(name)]
    tolerance = 4e-3 * longest_side(loops)
    mesh = hk.mesh(hk.SolidAngle(loops), cell_size=spacing, seed=seed, tolerance=tolerance)
    check_surface(mesh, loops, CURVES[name][1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance", "hits"),
    [
        ("wavy", 4e-3, 1500),
        pytest.param("trefoil", 3.2e-3, 20_000, marks=pytest.mark.slow),
        pytest.param("coil", 3.4e-3, 20_000, marks=pytest.mark.slow),
    ],
)
def test_mesh_and_surface_are_within_the_tolerance(name: str, tolerance: float, hits: int) -> None:
    """Both ways: from points of the mesh, the function passes the level within the tolerance, by
    its lift along the normal; and hits of rays are that near to triangles."""
    loops, rng = loops_of(name), np.random.default_rng(0)
    field = hk.SolidAngle(loops)
    mesh = hk.mesh(field, tolerance=tolerance)
    facts = mesh.metadata["harnack"]
    assert facts["evaluations"] < (1_500_000 if name == "coil" else 300_000)
    assert len(mesh.faces) < 25_000
    assert fifth_percentile_of_angles(mesh) >= 25
    points = np.asarray(mesh.sample(max(hits, 5000), seed=0))
    seen = CurveOracle(loops)(points)
    points, slope = points[seen.smooth > tolerance], seen.gradient[seen.smooth > tolerance]
    step = tolerance * slope / np.linalg.norm(slope, axis=1)[:, None]
    ends = [CurveOracle(loops)(points + sign * step).value - 2 * math.pi for sign in (-1, 1)]
    below, above = (end - PERIOD * np.round(end / PERIOD) for end in ends)
    assert ((below < 0) & (above > 0) & (above - below < 0.5 * PERIOD)).all()
    hit_points = np.zeros((0, 3))
    while len(hit_points) < hits:
        direction = rng.normal(size=(hits, 3))
        origin = 4 * direction / np.linalg.norm(direction, axis=1)[:, None]
        aim = rng.uniform(-1.0, 1.0, origin.shape)
        seen_by = hk.trace(field, origin, aim - origin)
        hit_points = np.concatenate([hit_points, seen_by.position[seen_by.is_hit]])
    assert distances(mesh, hit_points[:hits]).max() < tolerance


def distances(mesh: Any, points: np.ndarray) -> np.ndarray:
    """From points to the triangles of a mesh, one by one."""
    from scipy.spatial import cKDTree

    radius = np.linalg.norm(mesh.triangles - mesh.triangles_center[:, None], axis=2).max(axis=1)
    is_long = radius > 4 * np.median(radius)  # few, beside long edges of a curve: tried for all
    small, long = mesh.triangles[~is_long], mesh.triangles[is_long]
    tree = cKDTree(small.mean(axis=1))
    near = tree.query(points)[0]
    out = np.full(len(points), np.inf)
    for k, (p, r) in enumerate(zip(points, near + 2 * radius[~is_long].max(), strict=True)):
        triangles = np.concatenate([small[tree.query_ball_point(p, r)], long])
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


@pytest.mark.few(1)
@pytest.mark.parametrize("spacing", [0.4, 0.25])
def test_cells_that_are_too_large_for_a_coil_are_made_smaller_where_checks_fail(
    spacing: float,
) -> None:
    messages: list[str] = []
    field = hk.SolidAngle(loops_of("coil"))
    mesh = hk.mesh(field, cell_size=spacing, tolerance=0.07, progress=messages.append)
    assert any("places fail: smaller cells there" in text for text in messages)
    assert mesh.metadata["harnack"]["spacing"] == spacing
    check_surface(mesh, loops_of("coil"), 1)


def test_a_coil_in_cells_that_are_too_large_raises_if_they_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(spanned_module(), "_MOST_LOCAL", 0)
    with pytest.raises(hk.MeshingError, match="smaller `cell_size`"):
        hk.mesh(hk.SolidAngle(loops_of("coil")), cell_size=0.4, tolerance=0.07)


def spanned_module() -> Any:
    return sys.modules["harnack.meshing.curve_spanning"]


def test_long_edges_of_a_coil_need_to_be_integrated() -> None:
    """With large cells wrapped differences are wrong on some edges between its turns."""
    field = hk.SolidAngle(loops_of("coil"))
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (4000, 3)) * [1.2, 1.2, 0.8]
    q = p + rng.normal(size=p.shape) * 0.2
    assert field.boundary is not None
    assert field.boundary.continuous_change is not None
    exact = field.boundary.continuous_change(p, q)
    value = field.value(p, precision="double"), field.value(q, precision="double")
    wrapped = value[1] - value[0]
    wrapped -= PERIOD * np.round(wrapped / PERIOD)
    turns = (exact - wrapped) / PERIOD
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    assert (np.round(turns) != 0).sum() > 20
    # Against the lift followed in small steps.
    steps = np.linspace(0, 1, 400)
    for k in range(40):
        x = p[k] + steps[:, None] * (q[k] - p[k])
        lift = np.unwrap(CurveOracle(loops_of("coil"))(x).value, period=PERIOD)
        assert exact[k] == pytest.approx(lift[-1] - lift[0], abs=1e-6)


@pytest.mark.slow
def test_wrapping_alone_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without integration a mesh of the coil in large cells fails its checks, and says so."""
    field, spacing = hk.SolidAngle(loops_of("coil")), 0.16
    monkeypatch.setattr(spanned_module(), "_MOST_LOCAL", 0)
    mesh = hk.mesh(field, cell_size=spacing, tolerance=0.17)
    assert mesh.metadata["harnack"]["euler_characteristic"] == 1
    marching = sys.modules["harnack.meshing.marching_tetrahedra"]
    monkeypatch.setattr(marching, "_integrate_change", lambda field, p, q, wrapped, period: wrapped)
    with pytest.raises(hk.MeshingError, match="cell_size"):
        hk.mesh(field, cell_size=spacing, tolerance=0.17)


def test_reaches_are_proved() -> None:
    """Within its reach of a point an angle moves by less than a quarter of its period."""
    field, rng = hk.SolidAngle(loops_of("trefoil")), np.random.default_rng(2)
    function = LevelFunction(field, 2 * math.pi)
    x = rng.uniform(-3, 3, (2000, 3))
    samples = function.sample(x)
    d = rng.normal(size=x.shape)
    d /= np.linalg.norm(d, axis=1)[:, None]
    assert field.boundary is not None
    assert field.boundary.continuous_change is not None
    end = x + samples.quarter_period_radius[:, None] * d
    change = field.boundary.continuous_change(x, end)
    assert np.abs(change).max() <= math.pi
    assert np.abs(change).max() > 0.55 * math.pi


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.5, 1.0, 1.5, 2.5, 3.0, 3.5])
def test_levels(level: float) -> None:
    loops = loops_of("wavy")
    mesh = hk.mesh(hk.SolidAngle(loops), level=level * math.pi, tolerance=1e-2)
    check_surface(mesh, loops, 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["random", "spiky"])
def test_random_curves(kind: str, seed: int) -> None:
    """Seeds 0 and 3 of spiky ones have surfaces that wind about their edges: the triangles between
    an edge and the chain beside it went through others when the chain was not convex."""
    rng = np.random.default_rng(seed)
    if kind == "random":
        loop = example_curves.random_closed_curve(rng, 60)
    else:
        loop = example_curves.spiky_polygon(rng, 16)
    mesh = hk.mesh(hk.SolidAngle(loop), tolerance=8e-3)
    check_surface(mesh, [loop], mesh.metadata["harnack"]["euler_characteristic"])
    assert mesh.metadata["harnack"]["euler_characteristic"] % 2 == 1  # one rim


@pytest.mark.slow
@pytest.mark.parametrize("length", [1e-4, pytest.param(1e-8, marks=pytest.mark.slow)])
def test_a_tiny_edge_does_not_force_small_cells(length: float) -> None:
    plain = example_curves.wavy_polygon(48)
    tiny = np.insert(plain, 1, plain[0] + length * (plain[1] - plain[0]) + [0, 0, length], axis=0)
    plain_mesh, tiny_mesh = (hk.mesh(hk.SolidAngle(loop), tolerance=1e-2) for loop in (plain, tiny))
    check_surface(tiny_mesh, [tiny], 1)
    counts = [mesh.metadata["harnack"]["evaluations"] for mesh in (plain_mesh, tiny_mesh)]
    assert counts[1] < 1.3 * counts[0]


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e3), (1.0, 1e6)])
def test_curves_of_any_size_and_place(scale: float, offset: float) -> None:
    loop = example_curves.wavy_polygon(48) * scale + offset
    mesh = hk.mesh(hk.SolidAngle(loop), tolerance=1e-2 * scale)
    check_surface(mesh, [loop], 1)
    plain = hk.mesh(hk.SolidAngle(example_curves.wavy_polygon(48)), tolerance=1e-2)
    assert len(mesh.faces) == pytest.approx(len(plain.faces), rel=0.05)


def test_touching_parts_of_a_curve() -> None:
    """Two vertices of a figure eight 1e-6 apart."""
    loop = np.array(
        [[0, 0, 0], [1, 1, 0], [2, 0, 0], [1, -1, 0], [0, 0, 1e-6], [-1, 1, 0.2], [-2, 0, 0],
         [-1, -1, 0]], float,
    )  # fmt: skip
    check_surface(hk.mesh(hk.SolidAngle(loop), tolerance=1.7e-2), [loop], 1)


@pytest.mark.parametrize("seed", range(3))
def test_faces_that_pass_through_others_are_all_found(seed: int) -> None:
    """Against separating axes, in soups with and without common corners."""
    rng = np.random.default_rng(seed)
    for vertices, faces in (
        (rng.uniform(size=(200, 3)), rng.integers(0, 200, (200, 3))),
        (rng.normal(size=(200, 1, 3)) + 0.4 * rng.normal(size=(200, 3, 3)), None),
    ):
        if faces is None:
            faces = np.arange(600).reshape(-1, 3)
        x = vertices.reshape(-1, 3)
        faces = faces[[len(set(face)) == 3 for face in faces.tolist()]]
        expected = np.unique(intersecting_pairs(x, faces))
        assert len(expected) > 50
        assert (intersecting_faces(x, faces) == expected).all()
