"""Vertices and faces that are too far from the level: few are mended where they are."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.meshing.checks import check_manifold, check_near_level, check_no_self_intersection
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import OffLevelError
from harnack.meshing.outlier_projection import project_outliers
from harnack.meshing.triangle_mesh import TriangleMesh

TOLERANCE = 0.005
FUNCTION = LevelFunction(hk.Sphere(1.0), 0.0)


def sphere() -> TriangleMesh:
    ball = trimesh.creation.icosphere(3)
    return TriangleMesh(np.array(ball.vertices), np.array(ball.faces, np.int64))


def check(one: TriangleMesh) -> None:
    check_near_level(FUNCTION, one.vertices, one.faces, TOLERANCE, None)


def far_places(one: TriangleMesh) -> np.ndarray:
    with pytest.raises(OffLevelError) as far:
        check(one)
    return far.value.locations


def dented() -> TriangleMesh:
    """One vertex is too far inside, and so are centers of faces around it."""
    made = sphere()
    vertices = made.vertices.copy()
    vertices[17] *= 1 - 1.3 * TOLERANCE
    return TriangleMesh(vertices, made.faces)


def coarse() -> TriangleMesh:
    """One vertex is left out, and faces across have their centers too far inside."""
    made = sphere()
    ring = made.faces[(made.faces == 3).any(axis=1)]
    followers = {int(f[(i := f.tolist().index(3)) - 2]): int(f[i - 1]) for f in ring}
    order = [next(iter(followers))]
    while followers[order[-1]] != order[0]:
        order.append(followers[order[-1]])
    fan = [[order[0], order[k], order[k + 1]] for k in range(1, len(order) - 1)]
    rest = made.faces[~(made.faces == 3).any(axis=1)]
    return TriangleMesh.without_unused_vertices(made.vertices, np.concatenate([rest, fan]))


@pytest.mark.parametrize("make", [dented, coarse])
def test_a_few_places_are_brought_near(make: object) -> None:
    surface: TriangleMesh = make()  # type: ignore[operator]
    made = project_outliers(FUNCTION, surface, far_places(surface), TOLERANCE, check)
    assert made is not None
    check(made)
    check_manifold(made.faces, made.vertices)
    check_no_self_intersection(made.vertices, made.faces)
    assert trimesh.Trimesh(made.vertices, made.faces, process=False).is_watertight


def test_nothing_is_mended_where_it_would_pass_through_others() -> None:
    """A small ball around the place where the vertex would come to lie."""
    surface = dented()
    places = far_places(surface)
    small = trimesh.creation.icosphere(1, radius=1e-3)
    vertices = np.concatenate([surface.vertices, small.vertices + sphere().vertices[17]])
    faces = np.concatenate([surface.faces, small.faces + len(surface.vertices)])
    assert (
        project_outliers(FUNCTION, TriangleMesh(vertices, faces), places, TOLERANCE, check) is None
    )


def test_many_places_or_far_ones_are_not_mended() -> None:
    surface = dented()
    assert project_outliers(FUNCTION, surface, surface.vertices[:200], TOLERANCE, check) is None
    assert project_outliers(FUNCTION, surface, np.zeros((1, 3)), TOLERANCE, check) is None
