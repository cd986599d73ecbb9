"""Triangles of a mesh that meet in more than what they share, decided exactly.

Two triangles in different planes meet beyond their common corners if and only if an edge of one
passes through the other, with its ends on both sides of that one's plane, or ends on it: corners
that lie on other triangles are not looked for, since edges beyond them would pass through. Two
triangles in one plane overlap unless the line of an edge has them on its two sides (separating
axes), whatever they share: faces that are there twice, or folded back onto their neighbours, do.
Pairs are looked for among those whose boxes overlap.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.edges import IntArray
from harnack.meshing.predicates import SignArray, sides_of_lines, sides_of_planes
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


def intersecting_faces(
    vertices: FloatArray, faces: IntArray, among: BoolArray | None = None
) -> IntArray:
    """Indices of faces (m, 3) that an edge of another face passes through, or that lie on others
    in their plane, and of those others.

    among: (m,) mask; pairs of which neither is chosen are not looked at.
    """
    found: list[IntArray] = []
    near = _near_pairs(vertices[faces], among)
    for start in range(0, len(near), _PAIRS_AT_ONCE):
        pairs = near[start : start + _PAIRS_AT_ONCE]
        one, other = faces[pairs[:, 0]], faces[pairs[:, 1]]
        heights = [_heights(vertices, *two) for two in ((one, other), (other, one))]
        meet = np.zeros(len(pairs), np.bool_)
        rows = np.flatnonzero((heights[0] == 0).all(axis=1) & (heights[1] == 0).all(axis=1))
        meet[rows] = _overlap(vertices[one[rows]], vertices[other[rows]])
        both = np.all([(h.min(axis=1) < 0) & (h.max(axis=1) > 0) for h in heights], axis=0)
        rows = np.flatnonzero(both)
        meet[rows] = _cross(vertices, one[rows], other[rows], heights[0][rows])
        meet[rows] |= _cross(vertices, other[rows], one[rows], heights[1][rows])
        found.append(pairs[meet].ravel())
    return np.unique(np.concatenate([*found, np.zeros(0, np.int64)]))


def _near_pairs(corner: FloatArray, among: BoolArray | None) -> IntArray:
    """Pairs (k, 2) of triangles (m, 3, 3) whose boxes overlap, each once; if not None, with one of
    those of a mask.

    Triangles of one size (up to 2) at a time, with those no larger: of a large triangle and many
    small ones only what is near is looked at.
    """
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    chosen = np.ones(len(corner), np.bool_) if among is None else among
    if not chosen.any():
        return np.zeros((0, 2), np.int64)
    ends = lower[chosen].min(axis=0), upper[chosen].max(axis=0)
    near = (lower <= ends[1]).all(axis=1) & (upper >= ends[0]).all(axis=1)
    centre = 0.5 * (lower + upper)
    radius = 0.5 * lengths(upper - lower)
    octave = np.floor(np.log2(np.maximum(radius, 1e-300)))
    groups = [np.flatnonzero(near & (octave == one)) for one in np.unique(octave[near])]
    trees = [searching.cKDTree(centre[rows]) for rows in groups]
    found: list[IntArray] = []
    for i, j in itertools.product(range(len(groups)), repeat=2):
        reach = float(radius[groups[i]].max() + radius[groups[j]].max())
        step = max(1, _PAIRS_AT_ONCE // 64)
        first = groups[i][chosen[groups[i]]]
        for start in range(0, len(first), step):
            rows = first[start : start + step]
            some = searching.cKDTree(centre[rows])
            table = some.sparse_distance_matrix(trees[j], reach, output_type="ndarray")
            one, other = rows[table["i"]], groups[j][table["j"]]
            keep = (lower[one] <= upper[other]).all(axis=1)
            keep &= (lower[other] <= upper[one]).all(axis=1)
            keep &= (one < other) | ~chosen[other]  # two that are chosen meet once
            found.append(np.column_stack([one[keep], other[keep]]))
    return np.concatenate(found).astype(np.int64)


def _heights(vertices: FloatArray, plane: IntArray, of: IntArray) -> SignArray:
    """(k, 3) on which sides of the planes of faces (k, 3) the corners of others lie; 0 on them."""
    a, b, c = (vertices[plane[:, i]] for i in range(3))
    signs = np.zeros((len(of), 3), np.int8)
    for i in range(3):
        rows = np.flatnonzero((of[:, i, None] != plane).all(axis=1))
        signs[rows, i] = sides_of_planes(a[rows], b[rows], c[rows], vertices[of[rows, i]])
    return signs


def _cross(vertices: FloatArray, through: IntArray, of: IntArray, heights: SignArray) -> BoolArray:
    """(k,) whether an edge of faces `of` (k, 3) passes through faces `through`, of whose planes the
    corners are on the sides `heights`: the line of the edge passes all three edges on one side, or
    touches them."""
    found = np.zeros(len(of), np.bool_)
    for i, j in _EDGES:
        rows = np.flatnonzero((heights[:, i] * heights[:, j] < 0) & ~found)
        p, q = vertices[of[rows, i]], vertices[of[rows, j]]
        x = [vertices[through[rows, k]] for k in range(3)]
        around = np.stack([sides_of_planes(p, q, x[k], x[m]) for k, m in _EDGES])
        found[rows] = (around >= 0).all(axis=0) | (around <= 0).all(axis=0)
    return found


def _overlap(one: FloatArray, other: FloatArray) -> BoolArray:
    """(k,) whether triangles (k, 3, 3) in one plane have an area in common; seen along the axis in
    which they are thinnest."""
    normal = np.abs(np.cross(one[:, 1] - one[:, 0], one[:, 2] - one[:, 0]))
    kept = np.array([[1, 2], [2, 0], [0, 1]])[normal.argmax(axis=1)]
    flat = [np.take_along_axis(t, kept[:, None].repeat(3, axis=1), axis=2) for t in (one, other)]
    found = np.ones(len(one), np.bool_)
    for a, b in (flat, flat[::-1]):
        turn = sides_of_lines(a[:, 0], a[:, 1], a[:, 2])
        for i, j in _EDGES:
            side = [turn * sides_of_lines(a[:, i], a[:, j], b[:, k]) for k in range(3)]
            found &= (np.stack(side) > 0).any(axis=0)
    return found
