"""Triangle meshes as oriented points: large triangles cut into pieces, small ones merged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import FloatArray, IntArray

# Cells in which triangles are merged, and the longest edge of these, in the longest edge of pieces.
_CELL = 0.54


@dataclass(frozen=True)
class Centroids:
    """Points that stand for parts of triangles.

    points: (n, 3) centroids. moments: (n, 3) area times normal, summed up.
    farthest: no point of a triangle is farther from the point that stands for it.
    spread: the largest integral of |d|^2 over the part that a point stands for, d the distance from
        the point, over the length of its moment; slant: of the Frobenius norm of the sum of moment
        times d, likewise.
    """

    points: FloatArray
    moments: FloatArray
    farthest: float
    spread: float
    slant: float


def piece_counts(corners: FloatArray, longest: float) -> IntArray:
    """In how many parts to cut each edge of triangles (m, 3, 3), so that none is longer: (m,)."""
    return np.maximum(np.ceil(_longest_edges(corners) / longest), 1).astype(np.int64)


def centroids(corners: FloatArray, longest: float) -> Centroids:
    """Of triangles (m, 3, 3), cut in similar pieces with edges at most `longest`; of those much
    smaller, one point for all in a cell that face the same way."""
    small = _longest_edges(corners) <= _CELL * longest
    parts = [
        make(some, longest)
        for make, some in ((_cut, corners[~small]), (_merged, corners[small]))
        if len(some)
    ]
    return Centroids(
        np.concatenate([one.points for one in parts]),
        np.concatenate([one.moments for one in parts]),
        max(one.farthest for one in parts),
        max(one.spread for one in parts),
        max(one.slant for one in parts),
    )


def _longest_edges(corners: FloatArray) -> FloatArray:
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)


def _farthest(corners: FloatArray, points: FloatArray) -> FloatArray:
    """The largest distance of a corner (m, 3, 3) from points (m, 3): (m,)."""
    return np.linalg.norm(corners - points[:, None], axis=2).max(axis=1)


def _areas(corners: FloatArray) -> FloatArray:
    """Area times normal, (m, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def _mean_squares(corners: FloatArray) -> FloatArray:
    """The mean square distance from the centroid over triangles: (m,)."""
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2)) / 36


def _cut(corners: FloatArray, longest: float) -> Centroids:
    """Triangles cut in counts^2 similar pieces each: first moments vanish."""
    counts = piece_counts(corners, longest)
    points: list[FloatArray] = []
    moments: list[FloatArray] = []
    for count in np.unique(counts):
        some = corners[counts == count]
        a, b, c = np.moveaxis(some, 1, 0)
        # Pieces that are turned as the triangle, and those that fill the gaps between them.
        i, j = np.indices((count, count)).reshape(2, -1)
        steps = [(i + j < count, 1 / 3), (i + j < count - 1, 2 / 3)]
        u, v = (np.concatenate([k[one] + third for one, third in steps]) / count for k in (i, j))
        middle = a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]
        points.append(middle.reshape(-1, 3))
        moments.append(np.repeat(_areas(some) / count**2, count**2, axis=0))
    spread = float((_mean_squares(corners) / counts**2).max())
    farthest = float((_farthest(corners, corners.mean(axis=1)) / counts).max())
    return Centroids(np.concatenate(points), np.concatenate(moments), farthest, spread, 0.0)


def _merged(corners: FloatArray, longest: float) -> Centroids:
    """One point for all triangles whose centroids are in a cell and whose normals have the same
    largest component: their moments add up to at least 1/sqrt(3) of their area."""
    moments, middles = _areas(corners), corners.mean(axis=1)
    axis = np.abs(moments).argmax(axis=1)
    side = np.take_along_axis(moments, axis[:, None], axis=1)[:, 0] > 0
    cells = np.floor(middles / (_CELL * longest)).astype(np.int64)
    keys = np.column_stack([cells, 2 * axis + side])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.ravel()
    area = np.linalg.norm(moments, axis=1)
    points = _sums(group, area[:, None] * middles) / _sums(group, area[:, None])
    d = middles - points[group]
    total = _sums(group, moments)
    length = np.linalg.norm(total, axis=1)
    square = area * (_mean_squares(corners) + (d * d).sum(axis=1))
    outer = np.einsum("ki,kj->kij", moments, d).reshape(-1, 9)
    slant = np.linalg.norm(_sums(group, outer), axis=1)
    spread = float((_sums(group, square[:, None])[:, 0] / length).max())
    farthest = float(_farthest(corners, points[group]).max())
    return Centroids(points, total, farthest, spread, float((slant / length).max()))


def _sums(group: IntArray, values: FloatArray) -> FloatArray:
    """Sums of rows (m, k) of the same group: (groups, k)."""
    columns: list[FloatArray] = [np.bincount(group, one).astype(np.float64) for one in values.T]
    return np.column_stack(columns)
