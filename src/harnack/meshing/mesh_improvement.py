"""Better triangles: edges flipped, slivers contracted, vertices moved along the surface.

Flips. Two triangles (a, b, c) and (b, a, d) become (c, d, b) and (d, c, a) where that makes the
smaller of their least angles larger, where the new edge is within the tolerance of the surface, and
where the new triangles face the way the surface does.

Contractions. The ends of a sliver's shortest edge are merged: see `collapse_slivers`.

Moves. Means of neighbors, to which `smoothed` moves vertices, make thin triangles where lengths of
edges change quickly, as beside long boundary edges that cannot be cut. Here several positions are
tried for each vertex of a thin triangle, and it moves to the best of them if the least angle of all
triangles around it grows. No two neighbors move at once, so that the measured angles are those of
the new mesh: the least angle around a moved vertex never falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.delaunay_points import newton_to_level
from harnack.meshing.edges import (
    IntArray,
    area_normals,
    boundary_edges,
    edge_keys,
    half_edges,
    row_dots,
    row_norms,
    sorted_unique,
)
from harnack.meshing.level_function import LevelFunction

__all__ = ["collapse_slivers", "flip_edges", "least_angles", "relax_vertices"]

# The smallest growth of a least angle: of its cosine in flips, in radians in moves; and the
# smallest cosine between normals of a triangle before and after, and between its normal and the
# gradient.
_GAIN = 0.01
_FACING = 0.5
_MAX_ROUNDS_OF_FLIPS = 12
# Triangles with a smaller angle, in radians, are slivers: 4 degrees.
_SLIVER = 0.07
# The smallest cosine between normals of the triangles around a contracted edge and the gradient.
_MIN_COLLAPSE_COSINE = 0.3


def flip_edges(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
) -> IntArray:
    """Faces after rounds of flips, each of which improves the two triangles at its edge; of several
    flips of one triangle only the best is done.

    tolerance: how far the middles of new edges, and the centers of new triangles, may be from the
        surface, estimated by the slope there.
    """
    refused = np.zeros(0, np.int64)
    boundary = edge_keys(boundary_edges(faces), len(vertices))
    for _ in range(_MAX_ROUNDS_OF_FLIPS):
        pairs, quads = _quadrilaterals(faces)
        a, b, c, d = quads.T
        before = least_angles(vertices, faces)[pairs].min(axis=1)
        new = np.stack([np.stack([c, d, b], axis=1), np.stack([d, c, a], axis=1)], axis=1)
        after = np.minimum(*(least_angles(vertices, new[:, k]) for k in (0, 1)))
        gain = np.cos(before) - np.cos(after)
        count = len(vertices)
        key = edge_keys(quads[:, 2:], count)
        useful = gain > _GAIN
        useful[useful] = ~np.isin(key[useful], refused)
        used_keys = sorted_unique(edge_keys(quads[:, :2], count))
        useful[useful] = ~_holds(used_keys, key[useful]) & ~np.isin(key[useful], boundary)
        rows = _independent_flips(np.flatnonzero(useful), gain, pairs, key, len(faces))
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
    edges, count = half_edges(faces), int(faces.max()) + 1
    keys = edge_keys(edges, count)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = order[same], order[same + 1]
    m = len(faces)
    third = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    quads = np.column_stack([edges[first], third[first], third[second]])
    return np.column_stack([first % m, second % m]), quads


def _independent_flips(
    rows: IntArray, gain: FloatArray, pairs: IntArray, key: IntArray, count: int
) -> IntArray:
    """The candidates that are the best of both their faces, and the only ones of their edge."""
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
    points = np.concatenate([middle, *corner.mean(axis=2).transpose(1, 0, 2)])
    samples = function.sample(points)
    near = (samples.distance <= tolerance).reshape(3, -1).all(axis=0)
    slope = samples.gradient.reshape(3, -1, 3)[1:].transpose(1, 0, 2)
    size = np.linalg.norm(normal, axis=2) * np.linalg.norm(slope, axis=2)
    facing = ((normal * slope).sum(axis=2) > _FACING * size).all(axis=1)
    return near & facing


def _holds(numbers: IntArray, keys: IntArray) -> BoolArray:
    """(k,) whether the keys (k,) are among ascending numbers (n,)."""
    at = np.searchsorted(numbers, keys)
    return numbers[np.minimum(at, len(numbers) - 1)] == keys if len(numbers) else at < 0


def least_angles(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(m,) the least angle of each triangle, in radians; 0 for a triangle without an area."""
    corner = vertices[faces]
    side = np.stack([corner[:, (k + 2) % 3] - corner[:, (k + 1) % 3] for k in range(3)], axis=1)
    square = np.einsum("ijk,ijk->ij", side, side)
    twice_area = row_norms(np.cross(side[:, 0], side[:, 1]))
    # The least angle is opposite the shortest side: tan = 2 area/(b . c).
    shortest = square.argmin(axis=1)
    dot = 0.5 * (square.sum(axis=1) - 2 * square[np.arange(len(faces)), shortest])
    return np.arctan2(twice_area, dot)


def collapse_slivers(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    fixed: BoolArray,
    tolerance: float,
) -> IntArray:
    """Faces without slivers whose shortest edge can be contracted to one of its ends.

    An edge (u, v) can be contracted to u without a change of topology if u and v have only the two
    neighbors in common that are the third corners of its faces (the link condition), and v is not
    `fixed` (n,), as boundary vertices are. It is contracted if no new triangle is a sliver, all
    face the way that the surface does, and their centers are within `tolerance` of it.
    """
    slivers = np.flatnonzero(least_angles(vertices, faces) < _SLIVER)
    is_removed = np.zeros(len(faces), np.bool_)
    faces = faces.copy()
    for row in slivers:
        if is_removed[row]:
            continue
        corner = vertices[faces[row]]
        sides = row_norms(np.roll(corner, -1, axis=0) - corner)
        k = int(sides.argmin())
        ends = int(faces[row, k]), int(faces[row, (k + 1) % 3])
        for target, source in (ends, ends[::-1]):
            if fixed[source]:
                continue
            star = np.flatnonzero((faces == source).any(axis=1) & ~is_removed)
            beside = (faces[star] == target).any(axis=1)
            if not _can_contract(faces[~is_removed], target, source):
                continue
            new = np.where(faces[star[~beside]] == source, target, faces[star[~beside]])
            if _are_valid_triangles(function, vertices, new, tolerance):
                faces[star[~beside]] = new
                is_removed[star[beside]] = True
                break
    return faces[~is_removed]


def _can_contract(faces: IntArray, target: int, source: int) -> bool:
    """Whether an edge with two faces satisfies the link condition."""
    target_faces, source_faces = (faces[(faces == v).any(axis=1)] for v in (target, source))
    common = np.setdiff1d(np.intersect1d(target_faces, source_faces), [target, source])
    beside = source_faces[(source_faces == target).any(axis=1)]
    return len(beside) == 2 and np.array_equal(common, np.setdiff1d(beside, [target, source]))


def _are_valid_triangles(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> bool:
    corner = vertices[new]
    normal = area_normals(corner)
    samples = function.sample(corner.mean(axis=1))
    size = row_norms(normal) * row_norms(samples.gradient)
    facing = row_dots(normal, samples.gradient) > _MIN_COLLAPSE_COSINE * size
    near = samples.distance <= tolerance
    return bool((facing & near & (least_angles(vertices, new) > _SLIVER)).all())


Walls = tuple[FloatArray, FloatArray] | None
# Triangles with a smaller angle are thin, in radians: 30 degrees.
_THIN = 0.52
_MAX_ROUNDS_OF_MOVES = 6
# The fractions of the displacement to each aim that are tried.
_PARTS = (1.0, 0.5)


def relax_vertices(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
) -> FloatArray:
    """Vertices (n, 3), moved where that makes the least angles of triangles larger; boundary
    vertices stay.

    tolerance: how far the centers of triangles around moved vertices may be from the surface.
    """
    fixed = np.zeros(len(vertices), np.bool_)
    fixed[boundary_edges(faces)] = True
    vertices = vertices.copy()
    for _ in range(_MAX_ROUNDS_OF_MOVES):
        angles = least_angles(vertices, faces)
        thin = np.unique(faces[angles < _THIN])
        stars = _VertexStars.of(faces, thin[~fixed[thin]], len(vertices))
        if not len(stars.centers):
            break
        before = stars.least(angles[stars.face])
        moved, after = _best_positions(function, vertices, faces, stars, walls)
        gain = after - before
        rows = _independent_moves(np.flatnonzero(gain > _GAIN), gain, stars, faces, len(vertices))
        rows = rows[_moves_stay_near(function, vertices, faces, stars, moved, rows, tolerance)]
        if not len(rows):
            break
        vertices[stars.centers[rows]] = moved[rows]
    return vertices


@dataclass(frozen=True)
class _VertexStars:
    """Faces around vertices: the vertices, centers (k,), and pairs of a vertex, owner (p,), and a
    face, face (p,), with the corners of that face, corners (p, 3), the center first."""

    centers: IntArray
    owner: IntArray
    face: IntArray
    corners: IntArray

    @classmethod
    def of(cls, faces: IntArray, centers: IntArray, count: int) -> _VertexStars:
        index = np.full(count, -1, np.int64)
        index[centers] = np.arange(len(centers))
        face, column = np.nonzero(index[faces] >= 0)
        corners = np.stack([faces[face, (column + k) % 3] for k in range(3)], axis=1)
        return cls(centers, index[corners[:, 0]], face, corners)

    def least(self, of_pairs: FloatArray) -> FloatArray:
        """(k,) the least of numbers (p,) around each vertex."""
        smallest = np.full(len(self.centers), np.inf)
        np.minimum.at(smallest, self.owner, of_pairs)
        return smallest

    def mean(self, of_pairs: FloatArray) -> FloatArray:
        """(k, 3) means of vectors (p, 3) around each vertex."""
        count = np.bincount(self.owner, minlength=len(self.centers))
        sums = [
            np.bincount(self.owner, of_pairs[:, axis], minlength=len(self.centers))
            for axis in range(3)
        ]
        return np.stack(sums, axis=1) / count[:, None]


def _best_positions(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    stars: _VertexStars,
    walls: Walls,
) -> tuple[FloatArray, FloatArray]:
    """The best positions (k, 3) of vertices, and the least angle around each vertex there (k,)."""
    center, a, b = (vertices[stars.corners[:, k]] for k in range(3))
    normal = np.cross(a - center, b - center)
    normal /= np.maximum(row_norms(normal), 1e-300)[:, None]
    middle = 0.5 * (a + b)
    # The position at which the triangle over the opposite edge has equal sides.
    apex = middle + np.sqrt(0.75) * np.cross(normal, b - a)
    start = vertices[stars.centers]
    aims = [stars.mean(apex), stars.mean(middle), 0.5 * (stars.mean(apex) + stars.mean(middle))]
    angles = least_angles(vertices, faces[stars.face])
    thinnest = angles <= stars.least(angles)[stars.owner]
    aims.append(start.copy())
    aims[-1][stars.owner[thinnest]] = apex[thinnest]
    best, best_angle = start.copy(), np.full(len(start), -np.inf)
    for aim in aims:
        for part in _PARTS:
            x = start + part * (aim - start)
            angle = _least_at(x, stars, a, b, normal)
            better = angle > best_angle
            best[better], best_angle[better] = x[better], angle[better]
    # Only the best position is moved onto the surface, which changes it little: the aims are near
    # it.
    span = row_norms(best - start) + 1e-300
    best = newton_to_level(function, best, function.sample(best), 2 * span, walls, steps=4)
    return best, _least_at(best, stars, a, b, normal)


def _least_at(
    x: FloatArray, stars: _VertexStars, a: FloatArray, b: FloatArray, normal: FloatArray
) -> FloatArray:
    """(k,) the least angle around vertices if they are at x (k, 3); -1 where a triangle turns.

    a, b, normal: (p, 3) the other corners of each pair's face, and its unit normal.
    """
    apex = x[stars.owner]
    cross = np.cross(a - apex, b - apex)
    size = row_norms(cross)
    corner = np.stack([apex, a, b], axis=1)
    angles = least_angles(corner.reshape(-1, 3), np.arange(3 * len(a)).reshape(-1, 3))
    facing = row_dots(cross, normal) > _FACING * size
    return stars.least(np.where(facing, angles, -1.0))


def _independent_moves(
    rows: IntArray, gain: FloatArray, stars: _VertexStars, faces: IntArray, count: int
) -> IntArray:
    """The vertices that gain more than all their neighbors."""
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
    stars: _VertexStars,
    targets: FloatArray,
    rows: IntArray,
    tolerance: float,
) -> BoolArray:
    """(k,) whether the vertices `rows`, at their targets, are on the surface, and the triangles
    around them near it, facing the way it does."""
    moved = np.zeros(len(stars.centers), np.bool_)
    moved[rows] = True
    pairs = np.flatnonzero(moved[stars.owner])
    corner = vertices[stars.corners[pairs]]
    corner[:, 0] = targets[stars.owner[pairs]]
    samples = function.sample(corner.mean(axis=1))
    normal = area_normals(corner)
    size = row_norms(normal) * row_norms(samples.gradient)
    is_near = row_dots(normal, samples.gradient) > _FACING * size
    is_near &= samples.distance <= tolerance
    failures = np.zeros(len(stars.centers), np.int64)
    np.add.at(failures, stars.owner[pairs[~is_near]], 1)
    length = row_norms(targets[rows] - vertices[stars.centers[rows]])
    on = function.sample(targets[rows]).distance <= 1e-7 * np.maximum(length, 0.1 * tolerance)
    return on & (failures[rows] == 0)
