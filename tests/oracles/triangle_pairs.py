"""Triangles of a mesh that intersect, by separating axes; slow, shares nothing with the package.

Two triangles that do not intersect are separated by a plane at right angles to one of 17
directions: their normals, products of an edge of each, and, if they lie in one plane, normals of
edges within it. If they touch in a common corner alone, the plane passes through that corner.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray

__all__ = ["intersecting_pairs"]

_AT_ONCE = 256
_SLACK = 1e-11


def intersecting_pairs(vertices: FloatArray, faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Pairs (k, 2) of faces that meet in more than a common corner or edge."""
    corner = vertices[faces]
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    found = [np.zeros((0, 2), np.int64)]
    for start in range(0, len(faces), _AT_ONCE):
        rows = np.arange(start, min(start + _AT_ONCE, len(faces)))
        overlap = np.ones((len(rows), len(faces)), np.bool_)
        for axis in range(3):
            overlap &= lower[rows, axis, None] <= upper[None, :, axis]
            overlap &= lower[None, :, axis] <= upper[rows, axis, None]
        i, j = np.nonzero(overlap)
        one, other = rows[i], j
        one, other = one[one < other], other[one < other]
        same = (faces[one][:, :, None] == faces[other][:, None, :]).any(axis=2)
        folded = same.sum(axis=1) == 2
        apart = ~folded & ~_separated(corner[one], corner[other])
        apart[folded] = _is_folded(corner[one[folded]], corner[other[folded]], same[folded])
        found.append(np.column_stack([one[apart], other[apart]]))
    return np.concatenate(found)


def _separated(a: FloatArray, b: FloatArray) -> npt.NDArray[np.bool_]:
    edges_a, edges_b = ([t[:, (k + 1) % 3] - t[:, k] for k in range(3)] for t in (a, b))
    normal_a, normal_b = (np.cross(e[0], e[1]) for e in (edges_a, edges_b))
    axes = [normal_a, normal_b]
    axes += [np.cross(e, f) for e, f in itertools.product(edges_a, edges_b)]
    axes += [np.cross(normal_a, e) for e in (*edges_a, *edges_b)]
    size = np.linalg.norm(np.concatenate([a, b], axis=1) - a[:, :1], axis=2).max(axis=1)
    separated = np.zeros(len(a), np.bool_)
    for axis in axes:
        heights_a, heights_b = (np.einsum("nij,nj->ni", t - a[:, :1], axis) for t in (a, b))
        slack = _SLACK * size * np.linalg.norm(axis, axis=1)
        a_below = heights_a.max(axis=1) <= heights_b.min(axis=1) + slack
        b_below = heights_b.max(axis=1) <= heights_a.min(axis=1) + slack
        extent = np.maximum(np.ptp(heights_a, axis=1), np.ptp(heights_b, axis=1))
        separated |= (a_below | b_below) & (extent > 10 * slack)
    return separated


def _is_folded(a: FloatArray, b: FloatArray, same: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Whether triangles with a common edge, of which `same` (n, 3) tells the ends, lie on each
    other."""
    n = np.arange(len(a))
    third = same.argmin(axis=1)
    p, q, x = a[n, (third + 1) % 3], a[n, (third + 2) % 3], a[n, third]
    away = np.minimum(
        np.linalg.norm(b - p[:, None], axis=2), np.linalg.norm(b - q[:, None], axis=2)
    )
    y = b[n, away.argmax(axis=1)]
    along = (q - p) / np.linalg.norm(q - p, axis=1, keepdims=True)
    u, v = (z - p - ((z - p) * along).sum(axis=1, keepdims=True) * along for z in (x, y))
    product = (u * v).sum(axis=1)
    return product >= (1 - 1e-12) * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
