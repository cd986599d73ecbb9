"""Meshes of hard families: kinks, thin walls, knife edges, slices of morphs, flat functions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import bumpy_sphere, torus_mesh
from tests.oracles.extents import longest_side

BOX = hk.Box((-1, -1, -1), (1, 1, 1))
BELOW: dict[str, Any] = {"level": 0.0, "side": "below"}


def octahedron() -> hk.Field:
    return hk.expression(lambda x, y, z: abs(x) + abs(y) + abs(z) - 0.9)


def wall(half: float) -> hk.Field:
    return hk.expression(lambda x, y, z: abs(z - 0.3 * x * x) - half)


def test_an_octahedron_of_absolute_values() -> None:
    mesh = hk.mesh(octahedron(), clip=BOX, tolerance=8e-3, **BELOW)
    facts = mesh.metadata["harnack"]
    assert mesh.is_watertight
    assert facts["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(4 / 3 * 0.9**3, rel=2e-3)
    assert facts["creases"] >= 12


@pytest.mark.slow
def test_smooth_surfaces_have_no_creases() -> None:
    mesh = hk.mesh(hk.Gyroid(1.0), level=0.2, clip=BOX, tolerance=8e-3)
    assert mesh.metadata["harnack"]["creases"] == 0


@pytest.mark.slow
def test_a_cut_ball_as_one_greatest_value() -> None:
    field = hk.expression(lambda x, y, z: hk.math.maximum(x * x + y * y + z * z - 0.81, z - 0.3))
    mesh = hk.mesh(field, clip=BOX, tolerance=8e-3, **BELOW)
    cap = math.pi * 0.6**2 * (2.7 - 0.6) / 3  # of height 0.6 of a ball of radius 0.9
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.9**3 - cap, rel=3e-3)


@pytest.mark.slow
def test_walls_thinner_than_cells_are_noticed() -> None:
    """Between points of the lattice a wall changes no sign: this one came back as ten pieces with
    264 holes and a third of its volume, without a word."""
    with pytest.raises(hk.MeshingError, match="miss parts of the level set"):
        hk.mesh(wall(0.02), clip=BOX, tolerance=8e-3, cell_size=1 / 12, **BELOW)
    mesh = hk.mesh(wall(0.02), clip=BOX, tolerance=2e-2, **BELOW)
    assert mesh.metadata["harnack"]["spacing"] == pytest.approx(0.6 / 12)
    assert mesh.metadata["harnack"]["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(0.16, rel=2e-2)


@pytest.mark.parametrize("half", [0.002, 0.0002])
def test_walls_far_thinner_than_cells_are_refused(half: float) -> None:
    for arguments in (BELOW, {"level": 0.0}):
        with pytest.raises(hk.MeshingError, match="cell_size"):
            hk.mesh(wall(half), clip=BOX, tolerance=8e-3, cell_size=1 / 12, **arguments)


@pytest.mark.slow
def test_knife_edges_are_noticed() -> None:
    edge = hk.expression(lambda x, y, z: hk.math.maximum(z - 0.05 * x, -z - 0.05 * x) + 0 * y)
    with pytest.raises(hk.MeshingError, match="make the solid of smooth parts"):
        hk.mesh(edge, clip=BOX, tolerance=8e-3, cell_size=1 / 12, **BELOW)
    above = hk.solid(hk.expression(lambda x, y, z: z - 0.05 * x + 0 * y), below=0)
    below = hk.solid(hk.expression(lambda x, y, z: -z - 0.05 * x + 0 * y), below=0)
    mesh = hk.mesh(above & below, clip=BOX, tolerance=8e-3)
    assert mesh.volume == pytest.approx(0.1, rel=1e-3)


def test_a_function_without_a_slope_is_refused_with_a_reason() -> None:
    """It said that the tolerance takes 3e302 triangles."""
    with pytest.raises(hk.MeshingError, match="Julia is constant at"):
        hk.mesh(hk.solids.Julia(iterations=6), tolerance=3e-2)


@pytest.mark.slow
def test_slices_of_morphs() -> None:
    torus, ball = torus_mesh(0.75, 0.3, 24, 12), bumpy_sphere(2)
    mesh = hk.mesh(
        hk.fields.Morph(torus, ball, gap=0.2, w=0.02), level=0.5, side="above", tolerance=2.7e-2
    )
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["euler_characteristic"] == 0  # a torus still
    off = (
        hk.fields.Morph(torus, ball, gap=0.2, w=0.02).value(mesh.vertices, precision="double") - 0.5
    )
    assert np.abs(off).max() < 0.05
    end = hk.mesh(hk.fields.Morph(torus, ball, gap=0.2, w=0.0), tolerance=2.7e-2)  # the mesh itself
    assert end.is_watertight
    assert end.metadata["harnack"]["euler_characteristic"] == 0


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("powers", "radii", "volume"),
    [((1.0, 1.0), (1.0, 1.0, 1.0), 4 / 3), ((2.0, 2.0), (1.0, 0.5, 0.3), 0.2 * math.pi)],
)
def test_superellipsoids(powers: Any, radii: Any, volume: float) -> None:
    mesh = hk.mesh(hk.solids.Superellipsoid(powers, radii), tolerance=8e-3)
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(volume, rel=6e-3)


def test_level_curves_are_walls_and_angles_are_refused() -> None:
    """Re log((z-1)/(z+1)) = 0 is the plane x = 0; the imaginary part is an angle."""
    charges = {1: 1, -1: -1}
    mesh = hk.mesh(hk.fields.LevelCurves("log", argument=charges), tolerance=1.6e-2)
    assert np.abs(mesh.vertices[:, 0]).max() < 1e-9
    assert mesh.area == pytest.approx(4 * 0.5, rel=1e-6)
    with pytest.raises(TypeError, match="is angle-valued, and mesh"):
        hk.mesh(hk.fields.LevelCurves("log", "imag", argument=charges))


def test_dipoles_of_a_sphere() -> None:
    """Its tips at the points are steep without bound; the rest is a sphere."""
    k = np.arange(200) + 0.5
    height, turn = 1 - k / 100, math.pi * (1 + math.sqrt(5)) * k
    round_ = np.sqrt(1 - height**2)
    points = np.column_stack([round_ * np.cos(turn), round_ * np.sin(turn), height])
    field = hk.DipolePotential(points, points)
    mesh = hk.mesh(field, level=2 * math.pi, side="above", tolerance=0.2)
    assert mesh.is_watertight
    assert mesh.metadata["harnack"]["euler_characteristic"] == 2
    assert mesh.volume == pytest.approx(4 / 3 * math.pi, rel=0.03)


@pytest.mark.slow
def test_circles_are_refused_and_their_polygons_are_not() -> None:
    with pytest.raises(TypeError, match=r"give circle\.polygon"):
        hk.mesh(hk.SolidAngle([hk.geometry.Circle(1.0)]))
    ring = hk.geometry.Circle(1.0).polygon(48)
    mesh = hk.mesh(hk.SolidAngle([ring]), tolerance=8e-3)
    assert mesh.area == pytest.approx(24 * math.sin(math.pi / 24), rel=1e-6)


def hairpin(width: float, length: float) -> np.ndarray:
    half = 0.5 * width
    return np.array([[-length, -half, 0], [length, -half, 0.1 * width], [length, half, 0],
                     [-length, half, 0.2 * width]])  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("loops", "expected"),
    [
        ([hairpin(1e-3, 1.0)], 1),
        ([hairpin(1.0, 500.0)], 1),
        ([example_curves.wavy_polygon(24) * 1e-3 + 10.0], 1),
        ([example_curves.wavy_polygon(24) + 1e4], 1),
        ([example_curves.wavy_polygon(24).astype(np.float32)], 1),
    ],
)
def test_hostile_curves(loops: list[np.ndarray], expected: int) -> None:
    field = hk.SolidAngle(loops)
    mesh = hk.mesh(field, tolerance=1e-2 * longest_side(field))
    facts = mesh.metadata["harnack"]
    assert facts["euler_characteristic"] == expected
    assert len(facts["boundary"]) == sum(map(len, loops))
    assert (mesh.vertices[: len(loops[0])] == loops[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-2, 1e-3])
def test_strands_that_nearly_touch(gap: float) -> None:
    up = np.array([[-1, 0, gap / 2], [1, 0, gap / 2], [1, 1, 0.5], [-1, 1, 0.5]])
    down = np.array([[-1, 0, -gap / 2], [-1, -1, -0.5], [1, -1, -0.5], [1, 0, -gap / 2]])
    mesh = hk.mesh(hk.SolidAngle([up, down]), tolerance=1e-2)
    assert (mesh.vertices[:8] == np.concatenate([up, down])).all()
    assert len(mesh.metadata["harnack"]["boundary"]) == 8


@pytest.mark.slow
def test_walls_of_the_angle_about_an_axis_between_cylinders() -> None:
    """The angle jumps on the axis, where triangles without an area were turned at random."""
    radius, angle = "6*sqrt(x^2 + y^2)", "6*atan2(y, x)"
    gyroid = hk.expression(
        f"sin({angle})*cos(6*z) + sin(6*z)*cos({radius}) + sin({radius})*cos({angle})"
    )
    wall = hk.solid(gyroid, between=(-0.3, 0.3)) & hk.Cylinder(1.5, 1.0)
    mesh = hk.mesh(wall - hk.Cylinder(0.7, 4.0), tolerance=1.2e-2)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1.0885, rel=1e-2)  # by the midpoint rule


@pytest.mark.slow
def test_formulas_without_a_value_where_other_parts_leave_nothing() -> None:
    field = hk.expression("sqrt(x^2 + y^2 - 0.09)*cos(3*atan2(y, x)) - z")
    solid = (hk.solid(field, below=0) & hk.Cylinder(1.5, 2.0)) - hk.Cylinder(0.7)
    mesh = hk.mesh(solid, cell_size=0.1)
    assert mesh.volume == pytest.approx(5.5292, rel=1e-3)  # half of what is between
