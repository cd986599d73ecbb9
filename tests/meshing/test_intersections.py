"""Faces that meet others: exact signs, edges through faces, and overlaps within a plane."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from harnack.geometry.example_meshes import icosphere
from harnack.meshing.exact_predicates import orient2d, orient3d
from harnack.meshing.self_intersection import intersecting_faces

# A rotation without short decimals: coplanar corners are not in planes of three coordinates.
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def exact_side(points: np.ndarray) -> int:
    """The sign of a determinant of differences to the last of some points."""
    rows = [[Fraction(float(x)) - Fraction(float(y)) for x, y in zip(p, points[-1], strict=True)]
            for p in points[:-1]]  # fmt: skip
    if len(rows) == 2:
        value = rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
    else:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = rows
        value = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)
    return (value > 0) - (value < 0)


@pytest.mark.parametrize("scale", [1.0, 1e-130, 1e150])
def test_signs_are_those_of_exact_arithmetic(scale: float) -> None:
    """Of points in a line or a plane up to rounding, and of some that are exactly there."""
    rng = np.random.default_rng(0)
    for size, function in ((2, orient2d), (3, orient3d)):
        points = rng.normal(size=(600, size + 1, size))
        share = rng.dirichlet(np.ones(size), 600)
        points[:, -1] = np.einsum("nk,nkj->nj", share, points[:, :-1])
        points[:100] = np.round(8 * points[:100]) / 8
        points[100:150, -1] = points[100:150, 0]
        points *= scale
        found = function(*np.moveaxis(points, 1, 0))
        expected = [exact_side(some) for some in points]
        assert found.tolist() == expected
        assert {-1, 0, 1} <= set(expected)


def test_tiny_differences_do_not_underflow() -> None:
    a, b, c = np.array([[0.0, 0]]), np.array([[1e-200, 0]]), np.array([[0, 1e-200]])
    assert orient2d(np.concatenate([a, a]), np.concatenate([b, b]),
                          np.concatenate([c, [[1.0, 1.0]]])).tolist() == [1, 1]  # fmt: skip


def two(first: Any, second: Any) -> list[int]:
    """Which of two triangles with no corner in common meet, in five places."""
    x = np.array([*first, *second], float)
    faces = np.arange(6).reshape(2, 3)
    found = [intersecting_faces(y, faces).tolist()
             for y in (x, x * 1e-7, 3 + x, 1e5 * x)]  # fmt: skip
    assert all(one == found[0] for one in found)
    return found[0]


A = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]


@pytest.mark.parametrize(
    ("other", "meet"),
    [
        ([(1, 1, 0), (5, 1, 0), (1, 5, 0)], True),  # in one plane, overlapping
        ([(0.5, 0.5, 0), (1, 0.5, 0), (0.5, 1, 0)], True),  # one within the other
        ([(-2, 1, 0), (6, 1, 0), (-2, 1.5, 0)], True),  # across, no corner in the other
        (A, True),  # the same
        ([(0, 0, 0), (4, 0, 0), (0, -4, 0)], False),  # side by side
        ([(4, 0, 0), (4, 4, 0), (0, 4, 0)], False),
        ([(5, 1, 0), (9, 1, 0), (5, 5, 0)], False),
        ([(1, 0, 0), (3, 0, 0), (2, -1, 0)], False),  # along a part of an edge
        ([(1, 1, 1), (5, 1, 1), (1, 5, 1)], False),  # above
        ([(1, 1, -1), (1, 1, 1), (5, 5, 0)], True),  # an edge passes through
        ([(1, 1, 0), (1, 1, 1), (2, 1, 1)], False),  # stands on it
        ([(2, 2, -1), (2, 2, 1), (5, 5, 0)], True),  # an edge passes through an edge
        ([(0, 0, -1), (0, 0, 1), (-4, -4, 0)], True),  # and through a corner
    ],
)
def test_two_triangles(other: Any, meet: bool) -> None:
    assert two(A, other) == ([0, 1] if meet else [])


def test_two_triangles_in_a_plane_that_rounding_knows_nothing_of() -> None:
    """Corners of a grid in a slanted plane, exactly in it: integers times the edges."""
    u, v = np.array([3.0, 5, 7]), np.array([-11.0, 2, 13])
    grid = np.array([i * u + j * v for i in range(4) for j in range(4)]) * 2.0**-20 / 1.0
    faces = np.array([[0, 1, 4], [5, 4, 1], [0, 2, 8], [10, 11, 14]])
    assert intersecting_faces(grid, faces).tolist() == [0, 1, 2]


def test_folded_and_doubled_faces() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.2, 1, 0], [0.7, 0.5, 0], [0.3, -1, 0]]) @ TURN.T
    x = np.round(x * 2.0**20) / 2.0**20
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0.25, 1, 0], [0.75, 0.5, 0], [0.25, -1, 0]])
    assert intersecting_faces(flat, np.array([[0, 1, 2], [1, 0, 3]])).tolist() == [0, 1]
    assert intersecting_faces(flat, np.array([[0, 1, 2], [1, 0, 4]])).tolist() == []
    assert intersecting_faces(flat, np.array([[0, 1, 2], [2, 0, 1]])).tolist() == [0, 1]
    # Folded by nearly a straight angle: not in one plane, and they share all that they have.
    assert intersecting_faces(x, np.array([[0, 1, 2], [1, 0, 4]])).tolist() == []


def test_pairs_among_some() -> None:
    """Triangles that cross in a chain: only pairs with one of those asked for count."""
    x = np.concatenate([np.array([(0, 0, 0), (2, 0, 0), (0, 2, 0)])
                        + np.array([0.3 * k, 0.3 * k, 0]) * 1.0 for k in range(6)])  # fmt: skip
    x += 0.2 * np.repeat(np.arange(6) % 2, 3)[:, None] * [0, 0, 1]
    faces = np.arange(18).reshape(6, 3)
    assert intersecting_faces(x, faces).tolist() == [0, 1, 2, 3, 4, 5]
    assert intersecting_faces(x, faces, np.arange(6) == 0).tolist() == [0, 2]
    assert intersecting_faces(x, faces, np.arange(6) % 4 == 2).tolist() == [0, 2, 4]
    assert intersecting_faces(x, faces, np.zeros(6, bool)).tolist() == []


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(3))
def test_random_faces_that_share_corners(seed: int) -> None:
    """Edges through faces, in exact arithmetic; one by one."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(40, 3))
    faces = np.array([rng.choice(40, 3, replace=False) for _ in range(24)])

    def passes(of: Any, through: Any) -> bool:
        for p, q in itertools.combinations(of, 2):
            if p in through or q in through:
                continue
            ends = [exact_side(x[[*through, end]]) for end in (p, q)]
            sides = [exact_side(x[[p, q, a, b]]) for a, b in zip(through, np.roll(through, -1),
                                                                 strict=True)]  # fmt: skip
            if ends[0] * ends[1] < 0 and len(set(sides)) == 1:
                return True
        return False

    expected = {k for i, j in itertools.permutations(range(24), 2)
                if passes(faces[i], faces[j]) for k in (i, j)}  # fmt: skip
    assert 3 < len(expected) < 24
    assert set(intersecting_faces(x, faces).tolist()) == expected


def test_neighbors_do_not_meet() -> None:
    vertices, faces = icosphere(2)
    assert not len(intersecting_faces(vertices, faces))
    moved = vertices.copy()
    moved[0] *= -1.5
    assert len(intersecting_faces(moved, faces))
