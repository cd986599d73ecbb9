"""Pairs of faces that a tree and floating point leave open: none that meet are missed."""

from __future__ import annotations

import numpy as np
import pytest

from harnack.geometry.example_meshes import icosphere
from harnack.meshing import broad_phase, self_intersection
from harnack.meshing.broad_phase import near_pairs
from harnack.meshing.self_intersection import intersecting_faces
from tests.oracles.triangle_pairs import intersecting_pairs

Mesh = tuple[np.ndarray, np.ndarray]


def noisy() -> Mesh:
    vertices, faces = icosphere(2)
    return vertices + np.random.default_rng(1).normal(0.0, 0.2, vertices.shape), faces


def coplanar() -> Mesh:
    """Triangles between points of a grid in a slanted plane, exactly in it."""
    u, v = np.array([3.0, 5, 7]), np.array([-11.0, 2, 13])
    grid = np.array([i * u + j * v for i in range(6) for j in range(6)]) * 2.0**-20
    rng = np.random.default_rng(2)
    faces = np.array([rng.choice(36, 3, replace=False) for _ in range(80)])
    a, b, c = (np.stack(np.divmod(faces[:, k], 6), axis=1) for k in range(3))
    (p, q), (r, s) = (b - a).T, (c - a).T
    return grid, faces[p * s != q * r]  # not in a line


def around_few_points() -> Mesh:
    """Faces of which most share one or two corners."""
    rng = np.random.default_rng(3)
    faces = np.array([rng.choice(12, 3, replace=False) for _ in range(60)])
    return rng.normal(size=(12, 3)), faces


def degenerate() -> Mesh:
    """Points and needles without an area among others, and faces that are there twice."""
    vertices, faces = noisy()
    vertices[:20] = np.round(4 * vertices[:20]) / 4
    needles = faces[:30].copy()
    needles[:, 2] = needles[:, 1]
    return vertices, np.concatenate([faces, needles, faces[40:50], faces[50:60, ::-1]])


def far_away() -> Mesh:
    vertices, faces = noisy()
    return 1e-3 * vertices + 1e6, faces


MESHES = [noisy, coplanar, around_few_points, degenerate, far_away]


@pytest.mark.parametrize("make", MESHES)
def test_the_same_faces_are_found_as_with_all_pairs_of_boxes(
    make: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, faces = make()  # type: ignore[operator]
    some = np.random.default_rng(4).random(len(faces)) < 0.3
    by_boxes = [intersecting_faces(vertices, faces, among).tolist() for among in (None, some)]
    monkeypatch.setattr(self_intersection, "_MIN_FACES_FOR_KERNEL", 0)
    by_tree = [intersecting_faces(vertices, faces, among).tolist() for among in (None, some)]
    assert by_tree == by_boxes
    assert by_tree[0]


def test_pairs_for_which_there_is_no_room_are_found_in_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, faces = noisy()
    expected = near_pairs(vertices, faces, None)
    lower, upper = vertices[faces].min(axis=1), vertices[faces].max(axis=1)
    overlap = ((lower[:, None] <= upper) & (lower <= upper[:, None])).all(axis=2)
    assert (overlap.sum() - len(faces)) / 2 > len(faces)  # more than there is room for
    monkeypatch.setattr(broad_phase, "_PAIRS_AT_ONCE", 1)
    found = near_pairs(vertices, faces, None)
    assert sorted(found.tolist()) == sorted(expected.tolist())


@pytest.mark.parametrize("make", [noisy, coplanar, around_few_points])
def test_no_pair_is_left_out_that_separating_axes_find(make: object) -> None:
    vertices, faces = make()  # type: ignore[operator]
    near = {tuple(sorted(pair)) for pair in near_pairs(vertices, faces, None).tolist()}
    expected = {tuple(pair) for pair in intersecting_pairs(vertices, faces).tolist()}
    assert expected
    assert expected <= near


def test_each_pair_comes_once_and_few_do() -> None:
    vertices, faces = icosphere(4)
    assert not len(near_pairs(vertices, faces, None))
    vertices[0] *= -1.5
    near = np.sort(near_pairs(vertices, faces, None), axis=1)
    assert len(np.unique(near, axis=0)) == len(near) < 1000
    assert not len(near_pairs(vertices, faces, np.zeros(len(faces), np.bool_)))
    assert not len(near_pairs(np.zeros((0, 3)), np.zeros((0, 3), np.int64), None))
