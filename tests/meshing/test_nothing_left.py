"""Solids of which nothing is left, meshes without an inside, and sheets that hang on a surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.meshing.components import drop_degenerate_components
from harnack.meshing.triangle_mesh import TriangleMesh

BALL = trimesh.creation.icosphere(2)


def test_a_solid_less_itself_is_empty() -> None:
    solid = hk.solid(BALL)
    with pytest.raises(hk.MeshingError, match="empty"):
        hk.mesh(solid - solid, tolerance=4e-2)


def test_films_are_left_out_and_cavities_stay() -> None:
    outer = trimesh.creation.box((3.0, 3.0, 3.0))
    inner = trimesh.creation.box((2.0, 2.0, 2.0))
    film = trimesh.creation.box((1.0, 1.0, 1e-14))
    film.apply_translation((4.0, 0.0, 0.0))
    parts = [outer.faces, inner.faces[:, ::-1] + 8, film.faces + 16]
    x = np.concatenate([outer.vertices, inner.vertices, film.vertices])
    made = drop_degenerate_components(TriangleMesh(x, np.concatenate(parts)))
    assert np.array_equal(made.faces, np.concatenate(parts[:2]))
    assert len(made.vertices) == 16


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "text",
    ["(x^2 + y^2 + z^2 - 1)^2", "x*x*(y - 3)", "(x^2 + y^2 + z^2 - 1)^4", "abs(x + y - 0.1)",
     "(x^2 + y^2 + z^2 - 1) * (x - 0.1)^2"],
)  # fmt: skip
def test_a_level_that_is_touched_and_not_passed_is_said(text: str) -> None:
    """It was called empty, or cells were called too large, of which none are small enough."""
    box = hk.Box((-2, -2, -2), (2, 2, 2))
    with pytest.raises(hk.MeshingError, match=r"comes to 0 without passing it.*u instead of u\^2"):
        hk.mesh(hk.expression(text, domain=box), tolerance=4e-2)


@pytest.mark.slow
@pytest.mark.parametrize("power", [3, 7])
def test_a_level_passed_without_slope_is_meshed(power: int) -> None:
    field = hk.expression(f"(x^2 + y^2 + z^2 - 1)^{power}", domain=hk.Box((-2,) * 3, (2,) * 3))
    result = hk.mesh(field, tolerance=4e-2)
    assert result.is_watertight
    assert np.abs(np.linalg.norm(result.vertices, axis=1) - 1).max() < 1e-9
    assert result.volume == pytest.approx(4 / 3 * math.pi, rel=1e-2)


@pytest.mark.slow
def test_between_two_levels_that_are_the_same_triangles_is_nothing() -> None:
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    field = hk.WindingNumber(cube.vertices, cube.faces)
    with pytest.raises(hk.MeshingError, match="no thickness"):
        hk.mesh(field, level=(0.25, 0.75), side="between", tolerance=1e-2)


def strip(turns: int) -> trimesh.Trimesh:
    """A closed strip, turned by so many half turns."""
    n = 30
    angle = 2 * np.pi * np.arange(n) / n
    bend = 0.5 * turns * angle
    ends = []
    for s in (-0.3, 0.3):
        r = 1 + s * np.cos(bend)
        ends.append(np.column_stack([r * np.cos(angle), r * np.sin(angle), s * np.sin(bend)]))
    x = np.stack(ends, axis=1).reshape(-1, 3)
    faces: list[list[int]] = []
    for k in range(n):
        a, b, c, d = 2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 3
        if k == n - 1:
            c, d = (1, 0) if turns % 2 else (0, 1)
        faces += [[a, c, b], [b, c, d]]
    return trimesh.Trimesh(x, faces, process=False)


def test_a_strip_of_one_side_has_no_inside() -> None:
    with pytest.raises(hk.geometry.MeshError, match="one side only"):
        hk.repair(strip(1))
    with pytest.raises(hk.geometry.MeshError, match="one side only"):
        hk.solid(strip(1))
    with pytest.raises(hk.geometry.MeshError, match=r"not closed.*repair"):
        hk.solid(strip(2))


def test_fins_cost_no_sound_triangle() -> None:
    """A triangle, and a sheet of several, that hang on edges of a closed mesh."""
    x, faces = np.asarray(BALL.vertices), np.asarray(BALL.faces)
    a, b = faces[0, :2]
    c, d = faces[100, :2]
    n = len(x)
    tips = np.array([1.5 * x[a], 1.5 * x[c], 1.5 * x[d]])
    fins = [[a, b, n], [c, d, n + 1], [d, n + 2, n + 1]]
    given = trimesh.Trimesh(np.concatenate([x, tips]), np.concatenate([faces, fins]), process=False)
    made = hk.repair(given)
    facts = made.metadata["harnack"]
    assert (facts["stage"], facts["kept"], facts["patches"]) == ("cleaned", len(faces), 0)
    assert facts["left_out"]["branching"] == len(fins)
    assert math.isclose(made.volume, BALL.volume)
    assert len(made.vertices) == n


def test_vertices_of_no_face_are_left_out_where_all_is_kept() -> None:
    x = np.concatenate([[[9.0, 9.0, 9.0]], BALL.vertices])
    made = hk.repair(trimesh.Trimesh(x, BALL.faces[:-1] + 1, process=False))
    assert made.metadata["harnack"]["stage"] == "filled"
    assert np.abs(made.vertices).max() < 2


def test_what_is_kept_counts_what_is_left_of_the_largest_body() -> None:
    two = trimesh.util.concatenate(
        [BALL, BALL.copy().apply_scale(0.5).apply_translation((3, 0, 0))]
    )
    made = hk.repair(two, largest=True)
    assert made.metadata["harnack"]["kept"] == len(made.faces) == len(BALL.faces)
