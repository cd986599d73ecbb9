"""Better triangles for a mesh of a level set: edges are flipped, slivers contracted, and vertices
moved along the level set. "The function" is f - level for a field f; its gradient is normal to the
level set. A "sliver" is a triangle with an angle below 4 degrees, a "thin" triangle one with an
angle below 30 degrees. The "star" of a vertex consists of the faces around it.

Flips. Two triangles (a, b, c) and (b, a, d) become (c, d, b) and (d, c, a) if that makes the
smallest of their angles larger, if the new edge is within the tolerance of the level set, and if
the new triangles face along the gradient.

Contractions. The ends of a sliver's shortest edge are merged: see `collapse_slivers`.

Moves. `refinement.smooth` moves vertices to the means of their neighbors. That makes thin triangles
where the lengths of edges change quickly, as beside long boundary edges that cannot be split. Here
several positions are tried for each vertex of a thin triangle, and it moves to the best of them if
the smallest angle of all triangles around it grows. No two neighbors move at once. So the measured
angles are the angles of the new mesh, and the smallest angle around a moved vertex never falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    area_normals,
    boundary_edges,
    edge_keys,
    half_edges,
    row_dots,
    row_norms,
    sorted_unique,
    unit_rows,
)
from harnack.meshing.delaunay_points import newton_to_level
from harnack.meshing.level_function import LevelFunction

__all__ = ["collapse_slivers", "flip_edges", "least_angles", "relax_vertices"]

# A flip has to lower the cosine of the smallest angle by more than the first, a move has to raise
# the smallest angle by more than it, in radians. The second is the smallest cosine between the
# normals of a triangle before and after, and between its normal and the gradient.
_GAIN = 0.01
_FACING = 0.5
_MOST_ROUNDS_OF_FLIPS = 12
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
    """Flip edges of a mesh in rounds, and return its faces (m, 3) after that. A flip replaces the
    edge between two triangles by the other diagonal of their quadrilateral. It is made if the
    smallest of all angles of both triangles becomes larger, if the mesh stays near the level set,
    and if the new edge does not exist already. Of several possible flips of a triangle, only the
    best is made in a round.

    function: f - level for a field f; it is 0 on the level set.
    tolerance: a length, the largest distance of the midpoints of new edges and of the centers of
        new triangles from the level set, estimated by the gradient there.
    """
    refused_keys = np.zeros(0, np.int64)
    boundary_keys = edge_keys(boundary_edges(faces), len(vertices))
    for _ in range(_MOST_ROUNDS_OF_FLIPS):
        # A flip replaces the edge from a to b by the edge from c to d.
        pairs, quads = _quadrilaterals(faces)
        a, b, c, d = quads.T
        old_angle = least_angles(vertices, faces)[pairs].min(axis=1)
        new_faces = np.stack([np.stack([c, d, b], axis=1), np.stack([d, c, a], axis=1)], axis=1)
        new_angle = np.minimum(*(least_angles(vertices, new_faces[:, k]) for k in (0, 1)))
        gain = np.cos(old_angle) - np.cos(new_angle)
        count = len(vertices)
        new_edge_key = edge_keys(quads[:, 2:], count)
        is_useful = gain > _GAIN
        is_useful[is_useful] = ~np.isin(new_edge_key[is_useful], refused_keys)
        used_keys = sorted_unique(edge_keys(quads[:, :2], count))
        # The new edge must be neither an edge of two faces already nor a boundary edge.
        is_useful[is_useful] = ~_are_among(used_keys, new_edge_key[is_useful]) & ~np.isin(
            new_edge_key[is_useful], boundary_keys
        )
        rows = _independent_flips(np.flatnonzero(is_useful), gain, pairs, new_edge_key, len(faces))
        if not len(rows):
            break
        is_allowed = _flips_stay_near(function, vertices, new_faces[rows], tolerance)
        refused_keys = np.concatenate([refused_keys, new_edge_key[rows[~is_allowed]]])
        rows = rows[is_allowed]
        faces = faces.copy()
        faces[pairs[rows, 0]], faces[pairs[rows, 1]] = new_faces[rows, 0], new_faces[rows, 1]
    return faces


def _quadrilaterals(faces: IntArray) -> tuple[IntArray, IntArray]:
    """The pairs of faces that share an edge.

    Returns:
        The indices (k, 2) of the two faces; and the corners (k, 4) of the quadrilateral that they
        form: the two ends of the shared edge, in the direction of the first face, and the third
        corners of the first and of the second face.
    """
    edges, count = half_edges(faces), int(faces.max()) + 1
    keys = edge_keys(edges, count)
    order = np.argsort(keys, kind="stable")
    same_rows = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = order[same_rows], order[same_rows + 1]
    m = len(faces)
    third_corner = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    quads = np.column_stack([edges[first], third_corner[first], third_corner[second]])
    return np.column_stack([first % m, second % m]), quads


def _independent_flips(
    rows: IntArray, gain: FloatArray, pairs: IntArray, key: IntArray, face_count: int
) -> IntArray:
    """Choose flips of edges that can be made at the same time: no two change the same face or make
    the same new edge. Returns the indices of the chosen pairs of faces. A chosen flip gains more
    than every other candidate that changes one of its two faces.

    rows: (k,) the candidates, as indices of the n pairs of neighboring faces.
    gain: (n,) how much the smallest angle grows by the flip of each pair (as a difference of
        cosines).
    pairs: (n, 2) the two faces of each pair.
    key: (n,) a number that identifies the new edge of each pair.
    face_count: the number of faces of the mesh.
    """
    rows = rows[np.argsort(-gain[rows], kind="stable")]
    rank = np.arange(len(rows))
    # For each face the rank of the best candidate that changes it; rank 0 gains most.
    best_rank = np.full(face_count, len(rows))
    for k in (0, 1):
        np.minimum.at(best_rank, pairs[rows, k], rank)
    is_best = (best_rank[pairs[rows]] == rank[:, None]).all(axis=1)
    rows = rows[is_best]
    # Of the flips that make the same edge, keep one.
    return rows[np.unique(key[rows], return_index=True)[1]]


def _flips_stay_near(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> BoolArray:
    """(k,) for each of k flips, whether the mesh stays near the level set. Two conditions must
    hold. The middle of the new edge and the centers of both new triangles are within `tolerance` (a
    length) of the level set, estimated by the gradient there. And the normals of both triangles are
    within 60 degrees of the gradient.

    function: f - level for a field f; it is 0 on the level set.
    new: (k, 2, 3) the corners of the two new triangles of each flip.
    """
    corner = vertices[new]  # (k, 2, 3, 3)
    normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    middle = corner[:, 0, :2].mean(axis=1)
    points = np.concatenate([middle, *corner.mean(axis=2).transpose(1, 0, 2)])
    samples = function.sample(points)
    # Three samples for each flip: at the middle, then at both centers, whose gradients count.
    is_near = (samples.distance <= tolerance).reshape(3, -1).all(axis=0)
    gradient = samples.gradient.reshape(3, -1, 3)[1:].transpose(1, 0, 2)
    size = np.linalg.norm(normal, axis=2) * np.linalg.norm(gradient, axis=2)
    is_along_gradient = ((normal * gradient).sum(axis=2) > _FACING * size).all(axis=1)
    return is_near & is_along_gradient


def _are_among(numbers: IntArray, keys: IntArray) -> BoolArray:
    """(k,) whether each of the `keys` (k,) is among the numbers (n,), which are in ascending
    order."""
    at = np.searchsorted(numbers, keys)
    return numbers[np.minimum(at, len(numbers) - 1)] == keys if len(numbers) else at < 0


def least_angles(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(m,) the smallest angle of each triangle, in radians; 0 for a triangle without an area."""
    corner = vertices[faces]
    side = np.stack([corner[:, (k + 2) % 3] - corner[:, (k + 1) % 3] for k in range(3)], axis=1)
    square = np.einsum("ijk,ijk->ij", side, side)
    twice_area = row_norms(np.cross(side[:, 0], side[:, 1]))
    # The smallest angle is opposite the shortest side a. For the other sides b and c, its tangent
    # is 2 area/(b . c), and 2 b . c = b^2 + c^2 - a^2.
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
    """Remove slivers (triangles with an angle below 4 degrees) by contracting their shortest edge
    to one of its ends, if possible. Returns the faces that are left, with their new corners.

    function: f - level for a field f; it is 0 on the level set.
    fixed: (n,) the mask of the vertices that may not be removed, such as those of the boundary.
    tolerance: a length, the largest distance of the centers of new triangles from the level set.

    An edge (u, v) can be contracted to u without a change of topology if v is not fixed and if u
    and v have only two neighbors in common, the third corners of the edge's two faces (the link
    condition). It is contracted if no new triangle is a sliver, and if the normals of all new
    triangles are along the gradient, and their centers near the level set.
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
        # Try to remove one end of the shortest edge, then the other.
        for target, source in (ends, ends[::-1]):
            if fixed[source]:
                continue
            star_rows = np.flatnonzero((faces == source).any(axis=1) & ~is_removed)
            has_target = (faces[star_rows] == target).any(axis=1)
            if not _can_contract(faces[~is_removed], target, source):
                continue
            new_faces = np.where(
                faces[star_rows[~has_target]] == source, target, faces[star_rows[~has_target]]
            )
            if _is_good(function, vertices, new_faces, tolerance):
                faces[star_rows[~has_target]] = new_faces
                is_removed[star_rows[has_target]] = True
                break
    return faces[~is_removed]


def _can_contract(faces: IntArray, target: int, source: int) -> bool:
    """Whether the edge between the vertices `source` and `target` can be contracted without a
    change of topology. It can if it has two faces, and if its ends have only two neighbors in
    common, the third corners of these faces (the link condition)."""
    target_faces, source_faces = (faces[(faces == v).any(axis=1)] for v in (target, source))
    common = np.setdiff1d(np.intersect1d(target_faces, source_faces), [target, source])
    edge_faces = source_faces[(source_faces == target).any(axis=1)]
    return len(edge_faces) == 2 and np.array_equal(
        common, np.setdiff1d(edge_faces, [target, source])
    )


def _is_good(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> bool:
    """Whether all `new` triangles (k, 3) are good: the normal of each is within about 70 degrees of
    the gradient, its center is within `tolerance` (a length) of the level set, and it is no sliver.

    function: f - level for a field f; it is 0 on the level set.
    """
    corner = vertices[new]
    normal = area_normals(corner)
    samples = function.sample(corner.mean(axis=1))
    size = row_norms(normal) * row_norms(samples.gradient)
    is_along_gradient = row_dots(normal, samples.gradient) > _MIN_COLLAPSE_COSINE * size
    is_near = samples.distance <= tolerance
    return bool((is_along_gradient & is_near & (least_angles(vertices, new) > _SLIVER)).all())


Walls = tuple[FloatArray, FloatArray] | None
# Triangles with a smaller angle are thin, in radians: 30 degrees.
_THIN = 0.52
_MOST_ROUNDS_OF_MOVES = 6
# A vertex is tried at these fractions of the way to each target.
_MOVE_FRACTIONS = (1.0, 0.5)


def relax_vertices(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
) -> FloatArray:
    """Move vertices of thin triangles along the level set, if that makes the smallest angle of the
    triangles around them larger. Returns the vertices (n, 3). Boundary vertices stay.

    function: f - level for a field f; it is 0 on the level set.
    tolerance: a length, the largest distance of the centers of triangles around moved vertices from
        the level set.
    walls: None, or the lower and the upper corner (3,) of a box to which vertices are confined.
    """
    is_fixed = np.zeros(len(vertices), np.bool_)
    is_fixed[boundary_edges(faces)] = True
    vertices = vertices.copy()
    for _ in range(_MOST_ROUNDS_OF_MOVES):
        angles = least_angles(vertices, faces)
        thin_vertices = np.unique(faces[angles < _THIN])
        # Only vertices of thin triangles are moved, and none on the boundary.
        stars = _VertexStars.of(faces, thin_vertices[~is_fixed[thin_vertices]], len(vertices))
        if not len(stars.centers):
            break
        old_angle = stars.least(angles[stars.face])
        best_positions, new_angle = _best_places(function, vertices, faces, stars, walls)
        gain = new_angle - old_angle
        rows = _independent_moves(np.flatnonzero(gain > _GAIN), gain, stars, faces, len(vertices))
        rows = rows[
            _moves_stay_near(function, vertices, faces, stars, best_positions, rows, tolerance)
        ]
        if not len(rows):
            break
        vertices[stars.centers[rows]] = best_positions[rows]
    return vertices


@dataclass(frozen=True)
class _VertexStars:
    """The stars of k vertices (`centers`): the faces around each of them. They are stored as p
    pairs of a vertex and a face around it. Of each pair, `owner` is the vertex, as a position in
    `centers`; `face` is the index of the face; and `corners` are its corners, the vertex first.

    centers: (k,) the indices of the vertices.
    owner: (p,) the vertex of each pair, as a position in `centers`.
    face: (p,) the index of the face of each pair.
    corners: (p, 3) the corners of that face, the vertex first."""

    centers: IntArray
    owner: IntArray
    face: IntArray
    corners: IntArray

    @classmethod
    def of(cls, faces: IntArray, centers: IntArray, count: int) -> _VertexStars:
        """The stars of the vertices with the indices `centers` (k,) in a mesh with `faces` (m, 3).
        count: the number of all vertices of the mesh."""
        index = np.full(count, -1, np.int64)
        index[centers] = np.arange(len(centers))
        # For each pair, the face and the place (0 to 2) of the vertex among its corners.
        face, column = np.nonzero(index[faces] >= 0)
        corners = np.stack([faces[face, (column + k) % 3] for k in range(3)], axis=1)
        return cls(centers, index[corners[:, 0]], face, corners)

    def least(self, of_pairs: FloatArray) -> FloatArray:
        """(k,) for each vertex, the smallest number of its faces. of_pairs: (p,) one number for
        each pair."""
        smallest = np.full(len(self.centers), np.inf)
        np.minimum.at(smallest, self.owner, of_pairs)
        return smallest

    def mean(self, of_pairs: FloatArray) -> FloatArray:
        """(k, 3) for each vertex, the mean of the vectors of its faces. of_pairs: (p, 3) one vector
        for each pair."""
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
    stars: _VertexStars,
    walls: Walls,
) -> tuple[FloatArray, FloatArray]:
    """For each of k vertices, find a position at which the smallest angle of the triangles around
    it is large.

    function: f - level for a field f; it is 0 on the level set.
    stars: the faces around the k vertices.
    walls: None, or the lower and the upper corner (3,) of a box to which positions are confined.

    There are four targets for a vertex: the mean of the positions at which one of its triangles
    would be equilateral; the mean of the midpoints of the edges opposite to it; the mean of these
    two means; and the position at which its thinnest triangle would be equilateral. The vertex is
    tried at half of the way and at all of the way to each target.

    Returns:
        The best position (k, 3) for each vertex, moved onto the level set; and the smallest angle
        (k,) around the vertex there, in radians.
    """
    center, a, b = (vertices[stars.corners[:, k]] for k in range(3))
    normal = unit_rows(np.cross(a - center, b - center))
    middle = 0.5 * (a + b)
    # The position at which the triangle over the opposite edge has equal sides.
    apex = middle + np.sqrt(0.75) * np.cross(normal, b - a)
    start = vertices[stars.centers]
    targets = [stars.mean(apex), stars.mean(middle), 0.5 * (stars.mean(apex) + stars.mean(middle))]
    angles = least_angles(vertices, faces[stars.face])
    is_thinnest = angles <= stars.least(angles)[stars.owner]
    targets.append(start.copy())
    targets[-1][stars.owner[is_thinnest]] = apex[is_thinnest]
    best, best_angle = start.copy(), np.full(len(start), -np.inf)
    for target in targets:
        for fraction in _MOVE_FRACTIONS:
            x = start + fraction * (target - start)
            angle = _least_at(x, stars, a, b, normal)
            is_better = angle > best_angle
            best[is_better], best_angle[is_better] = x[is_better], angle[is_better]
    # Only the best position is moved onto the level set. That changes it little, since the targets
    # are near the level set.
    # (1e-300 keeps it above 0.)
    span = row_norms(best - start) + 1e-300
    best = newton_to_level(function, best, function.sample(best), 2 * span, walls, steps=4)
    return best, _least_at(best, stars, a, b, normal)


def _least_at(
    positions: FloatArray, stars: _VertexStars, a: FloatArray, b: FloatArray, normal: FloatArray
) -> FloatArray:
    """(k,) for each of k vertices that is moved to its position in `positions` (k, 3), the smallest
    angle (in radians) of the triangles around it after the move; -1 if the move turns one of these
    triangles by more than 60 degrees.

    stars: the faces around the vertices, as p pairs of a vertex and a face.
    a, b: (p, 3) the other two corners of the face of each pair.
    normal: (p, 3) the unit normal of the face of each pair, before the move.
    """
    center = positions[stars.owner]
    cross = np.cross(a - center, b - center)
    size = row_norms(cross)
    corner = np.stack([center, a, b], axis=1)
    angles = least_angles(corner.reshape(-1, 3), np.arange(3 * len(a)).reshape(-1, 3))
    is_unturned = row_dots(cross, normal) > _FACING * size
    return stars.least(np.where(is_unturned, angles, -1.0))


def _independent_moves(
    rows: IntArray, gain: FloatArray, stars: _VertexStars, faces: IntArray, vertex_count: int
) -> IntArray:
    """Choose moves of vertices that can be made at the same time: no two chosen vertices are
    neighbors. A candidate is chosen if it gains more than all candidates among its neighbors.
    Returns the chosen ones of `rows`.

    rows: (j,) the candidates, as positions in `stars.centers`.
    gain: (k,) for all k stars, how much the smallest angle grows by the move, in radians.
    stars, faces: the faces around the k vertices, and all faces (m, 3) of the mesh.
    vertex_count: the number of vertices of the mesh.
    """
    # For each vertex its rank among the candidates, 0 for the one that gains most; for each star
    # the best rank in it.
    rank = np.full(vertex_count, len(rows))
    ordered = rows[np.argsort(-gain[rows], kind="stable")]
    rank[stars.centers[ordered]] = np.arange(len(rows))
    best_rank = np.full(len(stars.centers), len(rows))
    np.minimum.at(best_rank, stars.owner, rank[stars.corners].min(axis=1))
    return rows[best_rank[rows] == rank[stars.centers[rows]]]


def _moves_stay_near(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    stars: _VertexStars,
    targets: FloatArray,
    rows: IntArray,
    tolerance: float,
) -> BoolArray:
    """(j,) for each of j vertices, whether the mesh stays near the level set if the vertex moves to
    its target. Three conditions must hold: the target is on the level set; the centers of the
    triangles around it are within `tolerance` (a length) of the level set; and the normals of these
    triangles are within 60 degrees of the gradient.

    function: f - level for a field f; it is 0 on the level set.
    stars: the faces around k vertices. rows: (j,) the vertices, as positions in `stars.centers`.
    targets: (k, 3) the targets of all k vertices.
    """
    is_candidate = np.zeros(len(stars.centers), np.bool_)
    is_candidate[rows] = True
    pairs = np.flatnonzero(is_candidate[stars.owner])
    # The triangles around the candidates, as they are after the move.
    corner = vertices[stars.corners[pairs]]
    corner[:, 0] = targets[stars.owner[pairs]]
    samples = function.sample(corner.mean(axis=1))
    normal = area_normals(corner)
    size = row_norms(normal) * row_norms(samples.gradient)
    is_near = row_dots(normal, samples.gradient) > _FACING * size
    is_near &= samples.distance <= tolerance
    failure_count = np.zeros(len(stars.centers), np.int64)
    np.add.at(failure_count, stars.owner[pairs[~is_near]], 1)
    # On the level set: the distance is tiny compared with the move, or with the tolerance.
    length = row_norms(targets[rows] - vertices[stars.centers[rows]])
    is_target_on_level = function.sample(targets[rows]).distance <= 1e-7 * np.maximum(
        length, 0.1 * tolerance
    )
    return is_target_on_level & (failure_count[rows] == 0)
