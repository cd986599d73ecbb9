"""Closed meshes of struts: stars of half struts, joined at the middles of edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.fields.solids.struts import Struts
from harnack.meshing import strut_mesh
from harnack.meshing.closed_mesh import to_manifold

TOLERANCE = 0.02
FORK = np.array([[0.0, 0, 0], [2, 0, 0], [0.1, 2, 0.3], [-0.5, 0.2, 2]])


def graph_of(solid: Struts) -> Any:
    edges = np.unique(np.sort(solid.edges, axis=1), axis=0)
    return strut_mesh._Graph.of(solid.nodes, edges, solid.radii, TOLERANCE, 10**6)


def separate(solid: Struts) -> Any:
    """The union of the meshes of whole struts."""
    from manifold3d import Manifold, OpType

    graph = graph_of(solid)
    parts = [to_manifold(graph.strut_surface(k)) for k in range(len(graph.edges))]
    return Manifold.batch_boolean(parts, OpType.Add)


@pytest.mark.parametrize(
    "solid",
    [
        hk.lattice.octet(1.0, 1).struts(0.1),
        hk.solids.struts(FORK, [[0, 1], [2, 0], [0, 3]], [0.3, 0.1, 0.2, 0.35]),
    ],
    ids=["octet", "fork"],
)
def test_joined_stars_are_the_union_of_all_struts(solid: Struts) -> None:
    assert strut_mesh._are_stars_apart(graph_of(solid))
    joined = strut_mesh.strut_manifold(solid, 0.0, TOLERANCE, 10**6)
    assert joined is not None
    expected = separate(solid)
    assert joined.volume() == pytest.approx(expected.volume(), rel=1e-9)
    assert joined.surface_area() == pytest.approx(expected.surface_area(), rel=1e-9)
    assert joined.genus() == expected.genus()
    points = np.array(joined.to_mesh64().vert_properties)[:, :3]
    values = solid.value(points, precision="double")
    assert np.abs(values).max() <= TOLERANCE


@pytest.mark.parametrize(
    ("nodes", "edges"),
    [
        (FORK, [[0, 1], [0, 2], [1, 3]]),
        ([[0, 0, 0], [2, 0, 0], [2, 0.2, 0]], [[0, 1], [0, 2]]),
        ([[-1, 0, 0], [1, 0, 0], [0, -1, 0.1], [0, 1, 0.1]], [[0, 1], [2, 3]]),
        ([[-1, 0, 0], [1, 0, 0], [0.9, 0, 0], [3, 0, 0]], [[0, 1], [2, 3]]),
    ],
    ids=["a bent chain", "an acute angle", "a crossing", "nodes that nearly coincide"],
)
def test_struts_that_meet_elsewhere_are_united_as_wholes(nodes: Any, edges: Any) -> None:
    solid = hk.solids.struts(np.array(nodes, float), edges, 0.1)
    is_apart = strut_mesh._are_stars_apart(graph_of(solid))
    assert is_apart == (len(edges) == 3)
    mesh = hk.mesh(solid, tolerance=2 * TOLERANCE)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(separate(solid).volume(), rel=1e-2)


def test_a_lattice_is_meshed_as_it_is() -> None:
    cylinder = hk.Cylinder(1.0, 2.0)
    lattice = hk.lattice.octet(0.5, region=cylinder)
    part = lattice.struts(0.05) & cylinder
    mesh = hk.mesh(part, tolerance=0.01)
    assert mesh.is_watertight
    assert len(mesh.faces) < 40 * len(lattice.edges)
    assert np.abs(mesh.vertices[:, 2]).max() == 1.0
    points = np.random.default_rng(0).uniform(-1, 1, (100_000, 3))
    inside = (part.value(points, precision="double") < 0).mean() * 8
    assert mesh.volume == pytest.approx(inside, rel=0.02)
    ends = part.value(np.array(mesh.vertices), precision="double")
    assert np.abs(ends).max() < 0.01


def test_meshes_of_single_struts() -> None:
    for solid in (
        hk.Capsule((0, 0.1, 0), (1, 0, 2), 0.4),
        hk.solids.RoundCone((0, 0, 0), (0, 1, -1), (0.5, 0.2)),
        hk.solids.RoundCone((0, 0, 0), (0, 1, -1), (0.9, 0.05)),
        hk.solids.RoundCone((0, 0, 0), (0, 0.1, 0), (0.5, 0.2)),
        hk.Cylinder(0.5, 1.0),
    ):
        for level in (-0.1, 0.0, 0.1):
            mesh = hk.mesh(solid, level=level, tolerance=0.01)
            assert mesh.is_watertight
            values = solid.value(np.array(mesh.vertices), precision="double")
            assert np.abs(values - level).max() < 0.01
    with pytest.raises(hk.MeshingError, match="empty"):
        hk.mesh(hk.Cylinder(0.5, 1.0), level=-0.5)


def test_an_enormous_mesh_of_struts_is_refused() -> None:
    capsule = hk.Capsule((0, 0, 0), (1, 0, 0))
    with pytest.raises(hk.MeshingError, match="struts within 1e-09 take more than"):
        strut_mesh.strut_manifold(Struts.of([capsule]), 0.0, 1e-9, 10**6)
    with pytest.raises(hk.MeshingError, match="or raise `max_triangles`"):
        hk.mesh(hk.lattice.cubic(1.0, 2).struts(0.1), max_triangles=500)


@pytest.mark.parametrize("length", [1e-7, 1e-10, 1e-13])
def test_an_edge_far_shorter_than_others_has_a_direction(length: float) -> None:
    nodes = [[0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 0.6 * length, 0.8 * length]]
    mesh = hk.mesh(hk.solids.struts(np.array(nodes), [[0, 1], [2, 3]], 0.1), tolerance=0.01)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.01 * np.pi + 0.008 / 3 * np.pi, rel=0.04)


def test_a_tolerance_below_rounding_is_refused_at_once() -> None:
    with pytest.raises(hk.MeshingError, match="struts within 5e-21 take more than"):
        hk.mesh(hk.Capsule((0, 0, 0), (1, 0, 0), 0.1), tolerance=1e-20)


@pytest.mark.parametrize(
    ("nodes", "edges", "radii", "level"),
    [
        ([[0, 0, 0], [0.3, 0, 0], [0, 1, 0.2], [3, 0, 0]], [[0, 1], [0, 2], [3, 0]], 0, 0.0),
        ([[0, 0, 0], [0.1, 0.2, -0.1]], [[0, 1]], 2, 0.0),
        (FORK, [[0, 1], [2, 0], [0, 3]], 1, -0.11),
        (FORK, [[0, 1], [2, 0], [0, 3]], 1, -0.3),
    ],
    ids=["nested balls", "a ball in another one", "tips", "few points left"],
)
def test_balls_in_others_and_cones_that_come_to_a_point(
    nodes: Any, edges: Any, radii: int, level: float
) -> None:
    # Thin struts are kept beside large balls.
    radius = ([0.9, 0.2, 0.2, 1e-3], [0.3, 0.1, 0.2, 0.35], [0.1, 0.5])[radii]
    solid = hk.solids.struts(np.array(nodes, float), edges, radius)
    mesh = hk.mesh(solid, level=level, tolerance=0.004)
    assert mesh.is_watertight
    values = solid.value(np.array(mesh.triangles_center), precision="double")
    assert np.abs(values - level).max() < 0.004
    low, high = np.array(solid.sublevel_extent(level).bounds())
    if level == 0:
        assert mesh.bounds == pytest.approx(np.array([low, high]), abs=0.004)
    assert mesh.euler_number == 2
    points = np.random.default_rng(0).uniform(low, high, (200_000, 3))
    inside = float((solid.value(points, precision="double") < level).mean())
    assert mesh.volume == pytest.approx(inside * np.prod(high - low), rel=0.03, abs=1e-3)
