"""Meshes of real-valued level sets, parts that all meshes are made with, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from harnack.meshing import checks
from harnack.meshing.delaunay_points import BoundaryCurve
from harnack.tree.empty_space import BoxCells, nonempty_cells, refine_cells


def test_periodic_surfaces_end_at_the_faces_of_a_box() -> None:
    box = hk.Box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    mesh = hk.mesh(hk.Gyroid(cell=1.0), level=0.2, clip=box, tolerance=4e-3, cell_size=0.09)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    assert (np.abs(np.abs(rim).max(axis=1) - 0.5) < 1e-12).all()
    assert np.abs(mesh.vertices).max() <= 0.5
    off = hk.Gyroid(cell=1.0).value(mesh.triangles_center, precision="double") - 0.2
    assert np.abs(off).max() < 4e-3 * 8  # its slope is at most 2 pi sqrt(1.5)
    checks.check_manifold(mesh.faces)


def test_a_domain_that_is_a_ball_cuts() -> None:
    mesh = hk.mesh(hk.Gyroid(1.0, domain=hk.Ball(radius=0.6)), tolerance=1e-2)
    rim = mesh.vertices[np.unique(mesh.metadata["harnack"]["boundary"])]
    np.testing.assert_allclose(np.linalg.norm(rim, axis=1), 0.6, atol=1e-8)


def test_closed_surfaces_are_watertight() -> None:
    mesh = hk.mesh(hk.Sphere(0.8), tolerance=3.2e-3)
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=5e-3)


def test_a_level_set_is_meshed_as_it_is_traced() -> None:
    """Level, side, clip and section are the surface's own."""
    box, half = hk.Box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)), hk.HalfSpace((0, 0, 1), 0.1)
    coarse: dict[str, Any] = {"tolerance": 1.2e-2, "cell_size": 0.1}
    field = hk.Gyroid(1.0)
    mesh = hk.mesh(hk.Surface(field, 0.2, clip=box, section=half), **coarse)
    same = hk.mesh(field, level=0.2, clip=box, section=half, **coarse)
    assert (mesh.vertices == same.vertices).all()
    solid = hk.Surface(field, level=(-0.2, 0.2), side="between", clip=box)
    wall = hk.mesh(solid, **coarse)
    assert (
        wall.vertices
        == hk.mesh(field, level=(-0.2, 0.2), side="between", clip=box, **coarse).vertices
    ).all()
    assert (
        hk.mesh(solid.replace(level=0.1, side=None), **coarse).metadata["harnack"]["level"] == 0.1
    )
    ball = hk.mesh(hk.Surface(hk.Sphere(0.8), 0.1), tolerance=3.6e-2)  # a `Solid`
    assert ball.volume == pytest.approx(4 / 3 * math.pi * 0.9**3, rel=0.05)
    several = hk.Surface(field, [-0.2, 0.2], clip=box)
    with pytest.raises(ValueError, match=r"there are 2 levels \(-0.2, 0.2\).*level=-0.2"):
        hk.mesh(several)
    assert hk.mesh(several.replace(level=0.2), **coarse).metadata["harnack"]["level"] == 0.2


@pytest.mark.parametrize(
    ("field", "arguments", "message"),
    [
        (hk.solids.Plane(), {}, r"give a clip, such as a box \(harnack.Box\)"),
        (hk.Gyroid(1.0), {"level": 9.0}, "no surface has level"),
        (hk.Sphere(0.5), {"clip": hk.Box((1, 1, 1), (2, 2, 2))}, "is empty"),
        (
            hk.SolidAngle(example_curves.wavy_polygon(12)),
            {"level": 4 * math.pi},
            "multiple of 4 pi",
        ),
        (hk.SolidAngle(example_curves.wavy_polygon(12)), {"level": 0.0}, "multiple of 4 pi"),
        (
            hk.SolidAngle(example_curves.wavy_polygon(12)),
            {"level": -8 * math.pi},
            "multiple of 4 pi",
        ),
        (hk.SolidAngle(example_curves.wavy_polygon(12)), {"tolerance": 0.0}, "tolerance"),
        (hk.SolidAngle(example_curves.wavy_polygon(12)), {"cell_size": -1.0}, "cell_size"),
        (hk.SolidAngle(hk.geometry.Circle(1.0)), {}, "circle.polygon"),
        ("curve", {}, "a harnack field is needed"),
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
    curve = BoundaryCurve.of((square,), 0.4)
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
    tree = refine_cells(BoxCells(lower[None], upper - lower), clearance, 10_000, 4)
    volume = sum(len(one.corners) * one.size.prod() for one in (tree.occupied, *tree.empty))
    assert volume == pytest.approx((upper - lower).prod())
    on = np.random.default_rng(0).normal(size=(2000, 3))
    on /= np.linalg.norm(on, axis=1)[:, None]
    inside = (on[:, None] >= tree.occupied.corners) & (
        on[:, None] <= tree.occupied.corners + tree.occupied.size
    )
    assert inside.all(axis=2).any(axis=1).all()
    assert len(tree.occupied.corners) < 16**3 / 4
    hull = nonempty_cells(lower, upper, clearance, 10_000, 4).bounding_kdop(0.0)
    assert hull.contains_points(on).all()
    assert not len(nonempty_cells(lower, upper, lambda x: np.full(len(x), 9.0), 100, 3).corners)


def test_closed_meshes_are_turned_outwards() -> None:
    for text in ("x^2 + y^2 + z^2 = 1", "1 = x^2 + y^2 + z^2"):
        ball = hk.expression(text, domain=hk.Ball(radius=1.5))
        mesh = hk.mesh(ball, tolerance=3e-2)
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)
        outwards = np.einsum("nk,nk->n", mesh.face_normals, mesh.triangles_center)
        assert (outwards > 0).all()
