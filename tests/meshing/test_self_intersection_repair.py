"""Meshes with a few triangles that pass through each other are mended there, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from harnack.geometry.example_meshes import icosphere
from harnack.geometry.mesh_edges import boundary_edges
from harnack.meshing.checks import check_manifold, check_no_self_intersection
from harnack.meshing.meshing_errors import SelfIntersectionError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.self_intersection_repair import (
    resolve_local_intersections,
    resolve_self_intersections,
)
from harnack.meshing.triangle_mesh import TriangleMesh


def with_slivers(count: int, depth: float) -> TriangleMesh:
    """A sphere with some faces cut in three at a point a little beyond an edge, and a little above
    the face there, so that edges to it pass through that."""
    vertices, faces = icosphere(3)
    for k in range(count):
        row = 97 * k
        a, b, c = faces[row]
        beside = faces[((faces == a) | (faces == b)).sum(axis=1) == 2]
        (d,) = set(beside.ravel().tolist()) - {a, b, c}
        middle = 0.5 * (vertices[a] + vertices[b])
        way = vertices[d] - middle
        outward = np.cross(vertices[d] - vertices[a], vertices[b] - vertices[a])
        outward *= np.linalg.norm(way) / np.linalg.norm(outward)
        assert outward @ middle > 0
        place = middle + depth * (way + 0.01 * outward)
        new = len(vertices)
        vertices = np.concatenate([vertices, place[None]])
        fans = np.array([[a, b, new], [b, c, new], [c, a, new]])
        faces = np.concatenate([faces[:row], fans[:1], faces[row + 1 :], fans[1:]])
    return TriangleMesh(vertices, faces)


@pytest.mark.parametrize(("count", "depth"), [(1, 1e-3), (5, 1e-6), (5, 1e-2)])
def test_slivers_that_pass_through_others_are_left_out(count: int, depth: float) -> None:
    given = with_slivers(count, depth)
    crossing = intersecting_faces(given.vertices, given.faces)
    assert len(crossing) >= 2 * count
    made, left = resolve_local_intersections(given, crossing, 0.2)
    assert left == 0
    check_no_self_intersection(made.vertices, made.faces)
    check_manifold(made.faces, made.vertices)
    assert not len(boundary_edges(made.faces))
    # Vertices are a part of those before, and nearly all faces are as they were.
    before = {tuple(x) for x in given.vertices.tolist()}
    assert {tuple(x) for x in made.vertices.tolist()} <= before
    corners = [
        {tuple(map(tuple, one)) for one in s.vertices[s.faces].tolist()} for s in (given, made)
    ]
    assert len(corners[0] & corners[1]) > len(given.faces) - 20 * count


def test_what_would_move_the_surface_too_far_is_left_and_refused() -> None:
    given = with_slivers(1, 1e-2)
    crossing = intersecting_faces(given.vertices, given.faces)
    made, left = resolve_local_intersections(given, crossing, 0.0)
    assert made is given
    assert left == len(crossing)
    with pytest.raises(SelfIntersectionError):
        resolve_self_intersections(given, 0.0)


def test_a_sound_mesh_is_returned_as_it_is() -> None:
    given = TriangleMesh(*icosphere(2))
    assert resolve_self_intersections(given, 1.0) is given


def test_a_surface_that_crosses_itself_is_given_up_early() -> None:
    # Two spheres through each other along a circle: no slivers that a few changes remove.
    vertices, faces = icosphere(3)
    given = TriangleMesh(
        np.concatenate([vertices, vertices + np.array([1.2, 0.013, 0.021])]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    crossing = intersecting_faces(given.vertices, given.faces)
    assert 100 < len(crossing) < 400
    made, left = resolve_local_intersections(given, crossing, 0.2)
    # Of what is left the count is right, though only new faces were tested after each change.
    assert left == len(intersecting_faces(made.vertices, made.faces)) > 90
    # Five changes, and not all forty that are allowed: each is a flip here, of two faces.
    before, after = (
        {frozenset(map(tuple, corners)) for corners in one.vertices[one.faces].tolist()}
        for one in (given, made)
    )
    assert 0 < len(after - before) <= 10
