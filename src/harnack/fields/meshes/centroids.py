"""Triangle meshes as oriented points: the centroids of pieces that are small enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import FloatArray, IntArray


@dataclass(frozen=True)
class Centroids:
    """The midpoint rule on the pieces of triangles.

    points: (n, 3) centroids. moments: (n, 3) area times normal. spread: over the pieces, the
        largest mean square distance from the centroid, the sum of the squares of edges over 36.
    """

    points: FloatArray
    moments: FloatArray
    spread: float


def piece_counts(corners: FloatArray, longest: float) -> IntArray:
    """In how many parts to cut each edge of triangles (m, 3, 3), so that none is longer: (m,)."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.maximum(np.ceil(edges / longest), 1).astype(np.int64)


def centroids(corners: FloatArray, counts: IntArray) -> Centroids:
    """Those of triangles (m, 3, 3) cut in counts^2 similar pieces each."""
    points: list[FloatArray] = []
    moments: list[FloatArray] = []
    for count in np.unique(counts):
        a, b, c = np.moveaxis(corners[counts == count], 1, 0)
        # In units of a piece: the first corner of the pieces that are turned as the triangle, and
        # of those that are turned the other way and fill the gaps, plus a third, or two.
        i, j = np.indices((count, count)).reshape(2, -1)
        like, turned = i + j < count, i + j < count - 1
        steps = [(i + 1 / 3, j + 1 / 3, like), (i + 2 / 3, j + 2 / 3, turned)]
        u, v = (np.concatenate([s[k][s[2]] for s in steps]) / count for k in (0, 1))
        middle = a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]
        points.append(middle.reshape(-1, 3))
        share = 0.5 / count**2 * np.cross(b - a, c - a)
        moments.append(np.repeat(share, count**2, axis=0))
    edges = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2))
    spread = float((edges / counts**2).max()) / 36
    return Centroids(np.concatenate(points), np.concatenate(moments), spread)
