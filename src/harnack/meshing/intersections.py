"""Triangles of a mesh that pass through each other.

Two triangles without a common edge meet beyond their common corner if an edge of one passes through
the other (or they lie in one plane, which is not looked for: a mesh folded flat onto itself has
turned faces, see `turned_faces`). Pairs are looked for among those whose boxes overlap.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.edges import IntArray
from harnack.meshing.rows import dots, lengths
from harnack.meshing.samples import LevelFunction

__all__ = ["intersecting_faces", "turned_faces"]

_EDGES = ((0, 1), (1, 2), (2, 0))
_PAIRS_AT_ONCE = 1 << 18


def turned_faces(function: LevelFunction, vertices: FloatArray, faces: IntArray) -> IntArray:
    """Indices of faces whose normal does not point to where the function grows, at their centre."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    slope = function.at(corner.mean(axis=1)).gradient
    return np.flatnonzero(dots(normal, slope) <= 0)


def intersecting_faces(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Indices of faces (m, 3) that an edge of another face passes through, and of those others."""
    found: list[IntArray] = []
    corner = vertices[faces]
    for pairs in _near_pairs(corner):
        one, other = pairs.T
        same = (faces[one][:, :, None] == faces[other][:, None, :]).any(axis=2).sum(axis=1)
        pairs = pairs[same < 2]
        for k in (0, 1):  # of both planes
            pairs = pairs[~_is_beside(corner[pairs[:, k]], corner[pairs[:, 1 - k]])]
        meet = np.zeros(len(pairs), np.bool_)
        for k, (i, j) in itertools.product((0, 1), _EDGES):
            edge, face = faces[pairs[:, k]][:, [i, j]], faces[pairs[:, 1 - k]]
            apart = ~(edge[:, :, None] == face[:, None, :]).any(axis=(1, 2))
            meet |= apart & _passes_through(vertices[edge], vertices[face])
        found.append(pairs[meet].ravel())
    return np.unique(np.concatenate([*found, np.zeros(0, np.int64)]))


def _near_pairs(corner: FloatArray) -> list[IntArray]:
    """Pairs (k, 2) of triangles (m, 3, 3) whose boxes overlap, each once, in batches.

    Triangles of one size (up to 2) at a time, with those no larger: of a large triangle and many
    small ones only what is near is looked at.
    """
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    centre = 0.5 * (lower + upper)
    radius = 0.5 * lengths(upper - lower)
    octave = np.floor(np.log2(np.maximum(radius, 1e-300)))
    groups = [np.flatnonzero(octave == one) for one in np.unique(octave)]
    trees = [searching.cKDTree(centre[rows]) for rows in groups]
    batches: list[IntArray] = []
    for i, j in itertools.combinations_with_replacement(range(len(groups)), 2):
        reach = float(radius[groups[i]].max() + radius[groups[j]].max())
        step = max(1, _PAIRS_AT_ONCE // 64)
        for start in range(0, len(groups[i]), step):
            rows = groups[i][start : start + step]
            some = searching.cKDTree(centre[rows])
            table = some.sparse_distance_matrix(trees[j], reach, output_type="ndarray")
            one, other = rows[table["i"]], groups[j][table["j"]]
            keep = (lower[one] <= upper[other]).all(axis=1)
            keep &= (lower[other] <= upper[one]).all(axis=1)
            keep &= (one < other) | (i != j)
            batches.append(np.column_stack([one[keep], other[keep]]))
    return batches


def _is_beside(one: FloatArray, other: FloatArray) -> BoolArray:
    """(k,) whether triangles lie on one side of the planes of others (k, 3, 3), or touch them."""
    normal = np.cross(one[:, 1] - one[:, 0], one[:, 2] - one[:, 0])
    rise = other - one[:, :1]
    height = np.einsum("nij,nj->ni", rise, normal)
    slack = 1e-12 * np.linalg.norm(rise, axis=2).max(axis=1) * lengths(normal)
    return (height.min(axis=1) >= -slack) | (height.max(axis=1) <= slack)


def _passes_through(edge: FloatArray, face: FloatArray) -> BoolArray:
    """(k,) whether segments (k, 2, 3) pass through triangles (k, 3, 3): their ends are on both
    sides, and the line passes all edges on the same side."""
    p, q = edge[:, 0], edge[:, 1]
    a, b, c = (face[:, k] for k in range(3))
    ends = _volume(p, a, b, c) * _volume(q, a, b, c) < 0
    around = np.sign(np.stack([_volume(p, q, x, y) for x, y in ((a, b), (b, c), (c, a))]))
    return ends & (np.abs(around.sum(axis=0)) == 3)


def _volume(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """(k,) six times that of tetrahedra, signed."""
    return (np.cross(b - a, c - a) * (d - a)).sum(axis=1)
