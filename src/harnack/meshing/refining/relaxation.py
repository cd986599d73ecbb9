"""Vertices of the worst triangles moved along the surface to where their least angle is larger.

Means of neighbors, to which `smoothed` moves vertices, make thin triangles where lengths of edges
change quickly, as beside the long edges of a rim that cannot be cut. Here some places are tried for
each vertex of a thin triangle, and it moves to the best of them if the least angle of all triangles
around it grows. No two neighbors move at once, so that what was measured is what is made: the
least angle around a moved vertex never falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.edges import IntArray, boundary_edges, dots, lengths
from harnack.meshing.points import newton
from harnack.meshing.refining.flips import least_angles
from harnack.meshing.samples import LevelFunction

__all__ = ["relaxed"]

Walls = tuple[FloatArray, FloatArray] | None
# Triangles with a smaller angle are thin, in radians: 30 degrees.
_THIN = 0.52
# By how much, in radians, an angle has to grow.
_GAIN = 0.01
# The least cosine between normals of a triangle before and after, and between it and the slope.
_FACING = 0.5
_MOST_ROUNDS_OF_MOVES = 6
# Parts of the way to each aim that are tried.
_PARTS = (1.0, 0.5)


def relaxed(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
) -> FloatArray:
    """Vertices (n, 3), those of the rim where they were, of triangles with larger least angles.

    tolerance: how far the centers of triangles around moved vertices may be from the surface.
    """
    fixed = np.zeros(len(vertices), np.bool_)
    fixed[boundary_edges(faces)] = True
    vertices = vertices.copy()
    for _ in range(_MOST_ROUNDS_OF_MOVES):
        angles = least_angles(vertices, faces)
        thin = np.unique(faces[angles < _THIN])
        stars = _Stars.of(faces, thin[~fixed[thin]], len(vertices))
        if not len(stars.centers):
            break
        before = stars.least(angles[stars.face])
        there, after = _best_places(function, vertices, faces, stars, walls)
        gain = after - before
        rows = _independent_moves(np.flatnonzero(gain > _GAIN), gain, stars, faces, len(vertices))
        rows = rows[_moves_stay_near(function, vertices, faces, stars, there, rows, tolerance)]
        if not len(rows):
            break
        vertices[stars.centers[rows]] = there[rows]
    return vertices


@dataclass(frozen=True)
class _Stars:
    """Faces around some vertices: centers (k,), and pairs of one of these, owner (p,), and a face,
    face (p,), with the corners of that face, corners (p, 3), the center first."""

    centers: IntArray
    owner: IntArray
    face: IntArray
    corners: IntArray

    @classmethod
    def of(cls, faces: IntArray, centers: IntArray, count: int) -> _Stars:
        place = np.full(count, -1, np.int64)
        place[centers] = np.arange(len(centers))
        face, column = np.nonzero(place[faces] >= 0)
        corners = np.stack([faces[face, (column + k) % 3] for k in range(3)], axis=1)
        return cls(centers, place[corners[:, 0]], face, corners)

    def least(self, of_pairs: FloatArray) -> FloatArray:
        """(k,) the least of numbers (p,) around each vertex."""
        found = np.full(len(self.centers), np.inf)
        np.minimum.at(found, self.owner, of_pairs)
        return found

    def mean(self, of_pairs: FloatArray) -> FloatArray:
        """(k, 3) means of vectors (p, 3) around each vertex."""
        count = np.bincount(self.owner, minlength=len(self.centers))
        sums = [
            np.bincount(self.owner, of_pairs[:, axis], minlength=len(self.centers))
            for axis in range(3)
        ]
        return np.stack(sums, axis=1) / count[:, None]


def _best_places(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    stars: _Stars,
    walls: Walls,
) -> tuple[FloatArray, FloatArray]:
    """Where each vertex is best (k, 3), and the least angle around it there (k,)."""
    here, a, b = (vertices[stars.corners[:, k]] for k in range(3))
    normal = np.cross(a - here, b - here)
    normal /= np.maximum(lengths(normal), 1e-300)[:, None]
    middle = 0.5 * (a + b)
    # Where the triangle over the opposite edge has equal sides.
    apex = middle + np.sqrt(0.75) * np.cross(normal, b - a)
    start = vertices[stars.centers]
    aims = [stars.mean(apex), stars.mean(middle), 0.5 * (stars.mean(apex) + stars.mean(middle))]
    angles = least_angles(vertices, faces[stars.face])
    thinnest = angles <= stars.least(angles)[stars.owner]
    aims.append(start.copy())
    aims[-1][stars.owner[thinnest]] = apex[thinnest]
    best, found = start.copy(), np.full(len(start), -np.inf)
    for aim in aims:
        for part in _PARTS:
            x = start + part * (aim - start)
            least = _least_at(x, stars, a, b, normal)
            better = least > found
            best[better], found[better] = x[better], least[better]
    # Onto the surface only the best of them, which changes little: the aims are beside it.
    span = lengths(best - start) + 1e-300
    best = newton(function, best, function.at(best), 2 * span, walls, steps=4)
    return best, _least_at(best, stars, a, b, normal)


def _least_at(
    x: FloatArray, stars: _Stars, a: FloatArray, b: FloatArray, normal: FloatArray
) -> FloatArray:
    """(k,) the least angle around vertices if they are at x (k, 3); -1 where a triangle turns.

    a, b, normal: (p, 3) the other corners of each pair's face, and its unit normal.
    """
    apex = x[stars.owner]
    cross = np.cross(a - apex, b - apex)
    size = lengths(cross)
    corner = np.stack([apex, a, b], axis=1)
    angles = least_angles(corner.reshape(-1, 3), np.arange(3 * len(a)).reshape(-1, 3))
    facing = dots(cross, normal) > _FACING * size
    return stars.least(np.where(facing, angles, -1.0))


def _independent_moves(
    rows: IntArray, gain: FloatArray, stars: _Stars, faces: IntArray, count: int
) -> IntArray:
    """Those of some vertices that gain more than all neighbors do."""
    rank = np.full(count, len(rows))
    ordered = rows[np.argsort(-gain[rows], kind="stable")]
    rank[stars.centers[ordered]] = np.arange(len(rows))
    first = np.full(len(stars.centers), len(rows))
    np.minimum.at(first, stars.owner, rank[stars.corners].min(axis=1))
    return rows[first[rows] == rank[stars.centers[rows]]]


def _moves_stay_near(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    stars: _Stars,
    there: FloatArray,
    rows: IntArray,
    tolerance: float,
) -> BoolArray:
    """(k,) whether some vertices, where they would be, are on the surface, and the triangles
    around them near it, facing the way it does."""
    moved = np.zeros(len(stars.centers), np.bool_)
    moved[rows] = True
    pairs = np.flatnonzero(moved[stars.owner])
    corner = vertices[stars.corners[pairs]]
    corner[:, 0] = there[stars.owner[pairs]]
    samples = function.at(corner.mean(axis=1))
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = lengths(normal) * lengths(samples.gradient)
    good = dots(normal, samples.gradient) > _FACING * size
    good &= samples.distance <= tolerance
    off = np.zeros(len(stars.centers), np.int64)
    np.add.at(off, stars.owner[pairs[~good]], 1)
    length = lengths(there[rows] - vertices[stars.centers[rows]])
    on = function.at(there[rows]).distance <= 1e-7 * np.maximum(length, 0.1 * tolerance)
    return on & (off[rows] == 0)
