"""Unions of parts that have parts in common: these are made once, and nothing lies on itself."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from harnack.fields.solids.booleans import BooleanSolid, Complement
from harnack.geometry import example_meshes
from harnack.meshing.csg_rewrite import factor_common_operands

BALL, CUBE, ROD = hk.Sphere(1.0), hk.Cuboid((2.0, 2.0, 2.0)), hk.Cylinder(0.3, 8.0)
NEAR = hk.Sphere(0.5).translated((0.7, 0.0, 0.0))
UNIONS = {
    "of a shell": BALL.shell(0.2) | (BALL & CUBE),
    "of a shell, without a hole": (BALL.shell(0.2) - ROD) | ((BALL & CUBE) - ROD),
    "of a part of another": BALL | (BALL & CUBE),
    "of others besides": (BALL & CUBE) | ROD | (BALL & NEAR) | (CUBE - ROD),
    "of what was moved": (BALL.shell(0.2) | (BALL & CUBE)).rotated(30, "x").scaled(1.2),
    "of what was grown": (BALL.offset(0.1) - ROD) | (BALL.offset(0.1) & NEAR),
}


@pytest.mark.parametrize("level", [0.0, -0.05])
@pytest.mark.parametrize("name", UNIONS)
def test_what_they_have_in_common_is_taken_out_of_the_same_points(name: str, level: float) -> None:
    union = UNIONS[name]
    assert isinstance(union, BooleanSolid)
    made = factor_common_operands(union, level)
    assert made is not None
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (20_000, 3))
    inside = union.value(points, precision="double") <= level
    assert 0.02 < inside.mean() < 0.9
    assert (inside == (made.value(points, precision="double") <= 0)).all()


def test_nothing_is_changed_where_there_is_nothing_in_common() -> None:
    same = BALL | (hk.Sphere(1.0) & CUBE)  # another ball, as far as one can tell
    assert isinstance(same, BooleanSolid)
    assert factor_common_operands(same, 0.0) is None
    other_level = BALL | (BALL.offset(0.1) & CUBE)
    assert isinstance(other_level, BooleanSolid)
    assert factor_common_operands(other_level, 0.0) is None


@pytest.mark.few(1)
@pytest.mark.parametrize("hole", [ROD, NEAR, BALL & NEAR])
def test_what_is_added_and_cut_away_again_is_not_made(hole: hk.solids.Solid) -> None:
    """Triangles of the rod passed through others, which was refused, or left a crumb."""
    shell = BALL.shell(0.2)
    mesh = hk.mesh((shell | hole) - hole, tolerance=2e-2)
    expected = hk.mesh(shell - hole, tolerance=2e-2)
    facts = [part.metadata["harnack"] for part in (mesh, expected)]
    assert facts[0]["euler_characteristic"] == facts[1]["euler_characteristic"]
    assert mesh.body_count == expected.body_count
    assert mesh.volume == pytest.approx(expected.volume, rel=2e-2)


def test_of_what_is_cut_away_whole_nothing_is_left() -> None:
    with pytest.raises(hk.MeshingError, match="empty"):
        hk.mesh((ROD | NEAR) - ROD - NEAR, tolerance=8e-2)


def test_of_a_hollow_part_the_hollow_is_cut_away() -> None:
    """So that no space around it is made, and the lattice only where the hollow is."""
    hollow = BALL.shell(0.2) | (BALL & CUBE)
    assert isinstance(hollow, BooleanSolid)
    made = factor_common_operands(hollow, 0.0)
    assert isinstance(made, BooleanSolid)
    assert not made.is_union
    assert made.parts[0] is BALL
    hole = made.parts[1]
    assert isinstance(hole, Complement)
    assert isinstance(hole.field, BooleanSolid)
    assert not hole.field.is_union


def test_the_surface_of_a_hollow_part_stays_as_it_was_given() -> None:
    """Each triangle is there once, though part and shell both have it."""
    torus = example_meshes.torus_mesh(1.0, 0.5, 24, 12)
    part = hk.solid(torus)
    hollow = part.shell(0.15) | (part & hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3)))
    mesh = hk.mesh(hollow, tolerance=1.5e-2)
    assert mesh.is_watertight
    on_it = np.abs(part.value(np.asarray(mesh.triangles_center), precision="double")) < 1e-9

    def as_sets(corners: np.ndarray) -> set[frozenset[tuple[float, ...]]]:
        return {frozenset(map(tuple, triangle.tolist())) for triangle in corners}

    assert on_it.sum() == len(torus[1])
    assert as_sets(np.asarray(mesh.triangles)[on_it]) == as_sets(torus[0][torus[1]])
