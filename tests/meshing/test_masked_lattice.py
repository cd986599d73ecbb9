"""Lattices of which only a part matters: what is chosen of them, and surfaces closed at its end."""

from __future__ import annotations

import math

import numpy as np
import pytest

import harnack as hk
from harnack.geometry.mesh_edges import boundary_edges
from harnack.meshing import csg_meshing
from harnack.meshing.bcc_lattice import BccLattice
from harnack.meshing.checks import check_manifold, check_no_self_intersection
from harnack.meshing.lattice_meshing import IrrelevantRegion, mesh_closed_surface
from harnack.meshing.level_function import LevelFunction

FOUR = BccLattice.covering_box(np.zeros(3), np.full(3, 4.0), 1.0)


def distance_to_plane(points: np.ndarray) -> np.ndarray:
    return np.abs(points[:, 0] - 2.0)


def side_of_plane(points: np.ndarray) -> np.ndarray:
    return points[:, 0] - 2.0


def beyond_two(points: np.ndarray) -> np.ndarray:
    """Nothing matters where y > 2."""
    return np.maximum(points[:, 1] - 2.0, 0.0)


def test_cells_at_the_level_are_chosen_where_they_matter_and_negative_ones_at_the_end() -> None:
    """Of 4 x 4 x 4 cells those of y > 3 are proved not to matter: their centers are 1.5 away from
    what does, and their corners 0.87 from their centers."""
    matter = FOUR.nonempty_cells(beyond_two, 1000)
    chosen, does = FOUR.relevant_cells(distance_to_plane, matter, side_of_plane, 1000)
    assert does[:, :3].all()
    assert not does[:, 3].any()
    expected = {(x, y, z) for x in (1, 2) for y in range(3) for z in range(4)}
    expected |= {(0, 2, z) for z in range(4)}  # negative, beside cells that do not matter
    assert {tuple(cell) for cell in chosen.tolist()} == expected


def test_all_cells_matter_where_nothing_is_elsewhere() -> None:
    matter = FOUR.nonempty_cells(lambda p: np.zeros(len(p)), 1000)
    chosen, does = FOUR.relevant_cells(distance_to_plane, matter, side_of_plane, 1000)
    assert does.all()
    assert sorted(map(tuple, chosen.tolist())) == sorted(
        map(tuple, FOUR.nonempty_cells(distance_to_plane, 1000).tolist())
    )


def test_deep_cells_have_only_such_neighbors() -> None:
    cells = np.zeros((5, 5, 5), np.bool_)
    cells[:4] = True
    deep = FOUR.interior_cells(cells)
    assert deep[:3].all()  # beyond the lattice counts as well
    assert not deep[3:].any()


def test_points_are_beside_the_cells_of_which_they_are_corners_or_centers() -> None:
    cells = np.zeros((4, 4, 4), np.bool_)
    cells[1, 2, 3] = True
    points = np.array([[2, 4, 6], [4, 6, 8], [3, 5, 7], [1, 5, 7], [6, 4, 6], [2, 4, 4]])
    assert FOUR.touches_cells(points, cells).tolist() == [True, True, True, False, False, False]


def test_a_surface_is_closed_where_nothing_matters_and_as_it_was_elsewhere() -> None:
    """A ball, of which only the lower half is asked for."""
    lattice = BccLattice.covering_box(np.full(3, -1.3), np.full(3, 1.3), 0.1, layers=2)

    def made(elsewhere: IrrelevantRegion | None) -> tuple[np.ndarray, np.ndarray]:
        function = LevelFunction(hk.Sphere(1.0), 0.0)
        one = mesh_closed_surface(function, lattice, 5e-3, lambda _: None, elsewhere=elsewhere)
        return one.vertices, one.faces

    vertices, faces = made(IrrelevantRegion(lambda p: np.maximum(p[:, 2], 0.0)))
    assert not len(boundary_edges(faces))
    check_manifold(faces, vertices)
    check_no_self_intersection(vertices, faces)
    assert vertices[:, 2].max() < 0.5  # closed below the top
    whole, _ = made(None)
    for x in (vertices, whole):
        below = x[x[:, 2] < 0]
        assert np.abs(np.linalg.norm(below, axis=1) - 1).max() < 1e-6


BALL = hk.Sphere(2.0)
GYROID = hk.Gyroid(cell=1.5)
WALLS = hk.solid(GYROID, between=GYROID.levels_of_thickness(0.2))
PARTS = {
    "intersection": BALL & WALLS,
    "complement of an intersection": BALL - (WALLS & hk.Sphere(1.2)),
    "complement of a complement": BALL & (hk.Sphere(1.5) - (hk.Sphere(1.0) - WALLS)),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", PARTS)
def test_parts_made_where_they_matter_are_the_same(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    volumes: list[float] = []
    for most in (0, math.inf):
        monkeypatch.setattr(csg_meshing, "_MANY_CELLS", most)
        volumes.append(float(hk.mesh(PARTS[name], tolerance=2e-2).volume))
    assert volumes[0] == pytest.approx(volumes[1], rel=2e-3)


def test_both_sides_of_a_wall_ask_once_where_the_other_parts_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    whole = IrrelevantRegion.relevant_cells

    def counted(self: IrrelevantRegion, lattice: BccLattice, most: int) -> np.ndarray:
        asked.append(len(self.cached_cells))
        return whole(self, lattice, most)

    monkeypatch.setattr(IrrelevantRegion, "relevant_cells", counted)
    monkeypatch.setattr(csg_meshing, "_MANY_CELLS", 0)
    hk.mesh(BALL & WALLS, tolerance=4e-2)
    assert asked == [0, 1]  # of both sides of the wall; the ball is meshed without cells
