"""Better triangles: edges turned within the two triangles beside them, slivers taken out.

Flips. Two triangles (a, b, c) and (b, a, d) become (c, d, b) and (d, c, a) where that makes the
smaller of their least angles larger, where the new edge is as near to the surface as is asked for,
and where the new triangles face the way the surface does.

Contractions. The ends of a sliver's shortest edge are merged: see `without_slivers`.
"""

from __future__ import annotations

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.edges import (
    IntArray,
    boundary_edges,
    directed_edges,
    distinct,
    dots,
    edge_keys,
    lengths,
)
from harnack.meshing.samples import LevelFunction

__all__ = ["flipped", "least_angles", "without_slivers"]

# Cosines: by how much a least angle has to grow, and how far normals may turn.
_GAIN = 0.01
_FACING = 0.5
_MOST_ROUNDS_OF_FLIPS = 12
# Triangles with a smaller angle, in radians, are slivers: 4 degrees.
_SLIVER = 0.07
# The least cosine between normals of the triangles around a contracted edge and the slope.
_STILL_FACING = 0.3


def flipped(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
) -> IntArray:
    """Faces after rounds of flips, each of which improves the two triangles it touches; of several
    flips of one triangle the best is made.

    tolerance: how far the middles of new edges, and the centers of new triangles, may be from the
        surface, by the slope there.
    """
    refused = np.zeros(0, np.int64)
    rim = edge_keys(boundary_edges(faces), len(vertices))
    for _ in range(_MOST_ROUNDS_OF_FLIPS):
        pairs, quads = _quadrilaterals(faces)
        a, b, c, d = quads.T
        before = least_angles(vertices, faces)[pairs].min(axis=1)
        new = np.stack([np.stack([c, d, b], axis=1), np.stack([d, c, a], axis=1)], axis=1)
        after = np.minimum(*(least_angles(vertices, new[:, k]) for k in (0, 1)))
        gain = np.cos(before) - np.cos(after)
        count = len(vertices)
        key = edge_keys(quads[:, 2:], count)
        good = gain > _GAIN
        good[good] = ~np.isin(key[good], refused)
        taken = distinct(edge_keys(quads[:, :2], count))
        good[good] = ~_holds(taken, key[good]) & ~np.isin(key[good], rim)
        rows = _independent_flips(np.flatnonzero(good), gain, pairs, key, len(faces))
        if not len(rows):
            break
        allowed = _flips_stay_near(function, vertices, new[rows], tolerance)
        refused = np.concatenate([refused, key[rows[~allowed]]])
        rows = rows[allowed]
        faces = faces.copy()
        faces[pairs[rows, 0]], faces[pairs[rows, 1]] = new[rows, 0], new[rows, 1]
    return faces


def _quadrilaterals(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (k, 2) of faces with a common edge, and their corners (k, 4): the edge (a, b) as the
    first runs it, and the third corners of both."""
    edges, count = directed_edges(faces), int(faces.max()) + 1
    keys = edge_keys(edges, count)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    one, other = order[same], order[same + 1]
    m = len(faces)
    third = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    quads = np.column_stack([edges[one], third[one], third[other]])
    return np.column_stack([one % m, other % m]), quads


def _independent_flips(
    rows: IntArray, gain: FloatArray, pairs: IntArray, key: IntArray, count: int
) -> IntArray:
    """Those candidates that are the best of both their faces, and the only ones of their edge."""
    rows = rows[np.argsort(-gain[rows], kind="stable")]
    rank = np.arange(len(rows))
    first = np.full(count, len(rows))
    for k in (0, 1):
        np.minimum.at(first, pairs[rows, k], rank)
    best = (first[pairs[rows]] == rank[:, None]).all(axis=1)
    rows = rows[best]
    return rows[np.unique(key[rows], return_index=True)[1]]


def _flips_stay_near(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> BoolArray:
    """(k,) whether both new triangles (k, 2, 3) are near the surface and face the way it does."""
    corner = vertices[new]  # (k, 2, 3, 3)
    normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    middle = corner[:, 0, :2].mean(axis=1)
    places = np.concatenate([middle, *corner.mean(axis=2).transpose(1, 0, 2)])
    samples = function.at(places)
    near = (samples.distance <= tolerance).reshape(3, -1).all(axis=0)
    slope = samples.gradient.reshape(3, -1, 3)[1:].transpose(1, 0, 2)
    size = np.linalg.norm(normal, axis=2) * np.linalg.norm(slope, axis=2)
    facing = ((normal * slope).sum(axis=2) > _FACING * size).all(axis=1)
    return near & facing


def _holds(numbers: IntArray, wanted: IntArray) -> BoolArray:
    """(k,) whether numbers in order (n,) hold those wanted (k,)."""
    place = np.searchsorted(numbers, wanted)
    return numbers[np.minimum(place, len(numbers) - 1)] == wanted if len(numbers) else place < 0


def least_angles(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(m,) of triangles, in radians; 0 for one without an area."""
    corner = vertices[faces]
    side = np.stack([corner[:, (k + 2) % 3] - corner[:, (k + 1) % 3] for k in range(3)], axis=1)
    square = np.einsum("ijk,ijk->ij", side, side)
    twice_area = lengths(np.cross(side[:, 0], side[:, 1]))
    # The least angle is opposite the shortest side: tan = 2 area/(b . c).
    shortest = square.argmin(axis=1)
    rest = 0.5 * (square.sum(axis=1) - 2 * square[np.arange(len(faces)), shortest])
    return np.arctan2(twice_area, rest)


def without_slivers(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    fixed: BoolArray,
    tolerance: float,
) -> IntArray:
    """Faces without those slivers of which an end of the shortest edge can be moved to the other.

    An edge (u, v) can be contracted to u without a change of topology if u and v have just the two
    neighbors in common that are the third corners of its faces (the link condition), and v is not
    `fixed` (n,), as vertices of the rim are. It is, if no new triangle is a sliver, all face the
    way that the surface does, and their centers are within `tolerance` of it.
    """
    slivers = np.flatnonzero(least_angles(vertices, faces) < _SLIVER)
    gone = np.zeros(len(faces), np.bool_)
    faces = faces.copy()
    for row in slivers:
        if gone[row]:
            continue
        corner = vertices[faces[row]]
        sides = lengths(np.roll(corner, -1, axis=0) - corner)
        k = int(sides.argmin())
        ends = int(faces[row, k]), int(faces[row, (k + 1) % 3])
        for kept, lost in (ends, ends[::-1]):
            if fixed[lost]:
                continue
            around = np.flatnonzero((faces == lost).any(axis=1) & ~gone)
            beside = (faces[around] == kept).any(axis=1)
            if not _can_contract(faces[~gone], kept, lost):
                continue
            new = np.where(faces[around[~beside]] == lost, kept, faces[around[~beside]])
            if _is_good(function, vertices, new, tolerance):
                faces[around[~beside]] = new
                gone[around[beside]] = True
                break
    return faces[~gone]


def _can_contract(faces: IntArray, kept: int, lost: int) -> bool:
    """The link condition, of an edge with two faces."""
    near, far = (faces[(faces == v).any(axis=1)] for v in (kept, lost))
    common = np.setdiff1d(np.intersect1d(near, far), [kept, lost])
    beside = far[(far == kept).any(axis=1)]
    return len(beside) == 2 and np.array_equal(common, np.setdiff1d(beside, [kept, lost]))


def _is_good(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> bool:
    corner = vertices[new]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    samples = function.at(corner.mean(axis=1))
    size = lengths(normal) * lengths(samples.gradient)
    facing = dots(normal, samples.gradient) > _STILL_FACING * size
    near = samples.distance <= tolerance
    return bool((facing & near & (least_angles(vertices, new) > _SLIVER)).all())
