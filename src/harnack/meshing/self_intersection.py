"""Faces of a mesh that intersect or touch others, decided by exact predicates. A mesh consists of
vertices (n, 3) and of triangular faces (m, 3), which hold the indices of their corners.
"""

from __future__ import annotations

import itertools
from collections.abc import Generator

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import area_normals, row_dots, row_norms
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.broad_phase import ROUNDING, near_pairs
from harnack.meshing.exact_predicates import UNDERFLOW, SignArray, orient2d, orient3d

__all__ = ["intersecting_faces", "intersecting_pairs", "touching_pairs"]

_EDGES = ((0, 1), (1, 2), (2, 0))
_PAIRS_AT_ONCE = 1 << 18
# For more triangles than this a kernel lists the pairs, which takes 0.05 s to record.
_MIN_FACES_FOR_KERNEL = 5_000
# Up to this many triangles of similar size are compared with each other at once.
_MAX_AT_ONCE = 1 << 19


def intersecting_faces(
    vertices: FloatArray, faces: IntArray, among: BoolArray | None = None
) -> IntArray:
    """Find the faces that meet another face in more than the corners and edges that both faces
    have, decided exactly. Two kinds of pairs are found: an edge of one face passes through the
    other face; or both faces lie in one plane and overlap. So faces that occur twice, or are folded
    back onto their neighbors, are found. Returns the indices (k,) of these faces, in increasing
    order.

    An edge that only ends on another face does not count (`touching_pairs` finds it). If the
    surface goes on behind that end and comes out on the other side, another edge passes through.
    Two triangles in one plane overlap, whatever they share, unless the line of an edge separates
    them.

    vertices, faces: (n, 3), (m, 3) the mesh.
    among: (m,) mask of chosen faces; pairs without a chosen face are not tested. None if all are
        chosen.
    """
    return np.unique(intersecting_pairs(vertices, faces, among))


def intersecting_pairs(
    vertices: FloatArray, faces: IntArray, among: BoolArray | None = None
) -> IntArray:
    """The pairs of faces that meet in more than shared corners and edges, as `intersecting_faces`
    decides it. Returns their indices (k, 2), each pair once.

    vertices, faces, among: as for `intersecting_faces`.
    """
    crossing_pairs: list[IntArray] = []
    for pairs, sides in _pairs_in_doubt(vertices, faces, among):
        first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
        meet = np.zeros(len(pairs), np.bool_)
        # Faces in one plane: all corners of each lie on the plane of the other.
        rows = np.flatnonzero((sides[0] == 0).all(axis=1) & (sides[1] == 0).all(axis=1))
        meet[rows] = _share_area(vertices[first[rows]], vertices[second[rows]])
        # Else each face must have corners on both sides of the other's plane.
        may_cross = np.all([(s.min(axis=1) < 0) & (s.max(axis=1) > 0) for s in sides], axis=0)
        rows = np.flatnonzero(may_cross)
        meet[rows] = _edge_pierces(vertices, first[rows], second[rows], sides[0][rows])
        meet[rows] |= _edge_pierces(vertices, second[rows], first[rows], sides[1][rows])
        crossing_pairs.append(pairs[meet])
    return np.concatenate([*crossing_pairs, np.zeros((0, 2), np.int64)])


def touching_pairs(vertices: FloatArray, faces: IntArray) -> tuple[IntArray, FloatArray]:
    """Find the pairs of faces that touch, decided exactly. Two faces touch if a corner or an edge
    of one face lies on the other face; a corner that both faces have does not count.

    Returns the pairs (k, 2) of indices of faces; and for each pair a point (k, 3) of contact: the
    corner, or the middle of the edge.

    Every pair of faces that meet in more than shared corners and edges is in this list or has its
    faces in the result of `intersecting_faces`. Proof. If all of a face lies on another face, so do
    its edges. If two edges meet between their ends, and neither edge lies in the plane of the
    other's face, an edge passes through a face. Faces that share two corners have no more in common
    unless they overlap in one plane. If two faces share one corner and their planes differ, the
    planes meet in a line through that corner, and each face meets the line in a segment that begins
    at the corner. The faces meet off the corner only if both segments run in the same direction.
    Then either an edge passes through a face, or the shorter segment is an edge that lies on the
    other face.

    vertices, faces: (n, 3), (m, 3) the mesh.
    """
    batches: list[IntArray] = []
    contacts: list[FloatArray] = []

    def add(pairs: IntArray, touches: BoolArray, p: FloatArray, q: FloatArray) -> None:
        """Add pairs to the result, and for each pair its point of contact.

        pairs: (k, 2) pairs of faces.
        touches: (k,) mask of the pairs to be added.
        p, q: (k, 3) points; the point of contact is midway between them.
        """
        batches.append(pairs[touches])
        contacts.append(0.5 * (p + q)[touches])

    for pairs, heights in _pairs_in_doubt(vertices, faces, None):
        # [pair, corner of the first face, corner of the second face]
        is_same = faces[pairs[:, 0], :, None] == faces[pairs[:, 1]][:, None]
        shared_count = is_same.sum(axis=(1, 2))
        # Corners and edges of `other` are tested against `base`, then the two change places.
        for order, ((base, other), sides) in enumerate(
            zip((pairs.T, pairs.T[::-1]), heights, strict=True)
        ):
            # A corner is an edge from itself to itself.
            for i, j in ((0, 0), (1, 1), (2, 2), *_EDGES):
                rows = np.flatnonzero((shared_count == 0) & (sides[:, i] == 0) & (sides[:, j] == 0))
                p, q = (vertices[faces[other[rows], k]] for k in (i, j))
                add(pairs[rows], _segments_meet(vertices[faces[base[rows]]], p, q), p, q)
            # For each corner of `other`, whether it is shared: `other` is the second face if order
            # is 0, and the first face if order is 1.
            is_common = is_same.any(axis=1 + order)
            for i in range(3):
                rows = np.flatnonzero((shared_count == 1) & ~is_common[:, i] & (sides[:, i] == 0))
                # Face `base`, begun at the shared corner; the edge from there to p meets the face
                # beyond that corner if it runs within the face's angle.
                apex = is_same.any(axis=2 - order)[rows].argmax(axis=1)[:, None]
                turned = np.take_along_axis(faces[base[rows]], (apex + np.arange(3)) % 3, axis=1)
                p = vertices[faces[other[rows], i]]
                add(pairs[rows], _is_in_angle(vertices[turned], p), p, p)
    all_pairs = np.concatenate([*batches, np.zeros((0, 2), np.int64)])
    # A pair may have been found several times; its first point of contact is kept.
    _, first = np.unique(all_pairs, axis=0, return_index=True)
    return all_pairs[first], np.concatenate([*contacts, np.zeros((0, 3))])[first]


def _pairs_in_doubt(
    vertices: FloatArray, faces: IntArray, among: BoolArray | None
) -> Generator[tuple[IntArray, tuple[SignArray, SignArray]]]:
    """Generate, in batches, the pairs of faces for which floating point leaves it open whether they
    have only vertices in common. Each batch consists of the indices (k, 2) of the faces, and two
    arrays (k, 3) of signs (`_side_signs`). The first array holds for each corner of the second face
    the side of the first face's plane on which it lies. The second array holds the same with the
    faces exchanged.

    vertices, faces: (n, 3), (m, 3) the mesh.
    among: (m,) mask of chosen faces; pairs without a chosen face are left out. None if all are
        chosen.
    """
    face_count = len(faces) if among is None else int(among.sum())
    by_kernel = face_count > _MIN_FACES_FOR_KERNEL
    near = near_pairs(vertices, faces, among) if by_kernel else _near_pairs(vertices[faces], among)
    for start in range(0, len(near), _PAIRS_AT_ONCE):
        pairs = near[start : start + _PAIRS_AT_ONCE]
        if not by_kernel:
            pairs = pairs[~_are_separated(vertices, faces, pairs)]
        first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
        yield pairs, (_side_signs(vertices, first, second), _side_signs(vertices, second, first))


def _near_pairs(corner: FloatArray, among: BoolArray | None) -> IntArray:
    """Pairs of triangles whose bounding boxes overlap; returns their indices (k, 2), each pair
    once.

    corner: (m, 3, 3) the corners of the triangles.
    among: (m,) mask of chosen triangles; pairs without a chosen triangle are left out. None if all
        are chosen.

    Triangles are grouped by the radius of their boxes, up to a factor of 2. Each group is compared
    with each group, itself included. Two triangles are compared if the centers of their boxes are
    no farther apart than the sum of the largest radii in both groups. So a large triangle is
    compared only with the small triangles near it.
    """
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    chosen = np.ones(len(corner), np.bool_) if among is None else among
    if not chosen.any():
        return np.zeros((0, 2), np.int64)
    chosen_bounds = lower[chosen].min(axis=0), upper[chosen].max(axis=0)
    # Only triangles near the box around all chosen ones can have a chosen partner.
    near = (lower <= chosen_bounds[1]).all(axis=1) & (upper >= chosen_bounds[0]).all(axis=1)
    center = 0.5 * (lower + upper)
    radius = 0.5 * row_norms(upper - lower)
    log2_radius = np.floor(np.log2(np.maximum(radius, 1e-300)))
    groups = [
        np.flatnonzero(near & (log2_radius == value)) for value in np.unique(log2_radius[near])
    ]
    trees = [kd_tree(center[rows]) for rows in groups]
    batches: list[IntArray] = []

    def add_if_overlapping(first: IntArray, second: IntArray) -> None:
        """Append those of the pairs (first, second) whose boxes overlap; `first` and `second` are
        indices (k,) of triangles."""
        keep = (lower[first] <= upper[second]).all(axis=1)
        keep &= (lower[second] <= upper[first]).all(axis=1)
        batches.append(np.column_stack([first[keep], second[keep]]))

    for i, j in itertools.product(range(len(groups)), repeat=2):
        max_distance = float(radius[groups[i]].max() + radius[groups[j]].max())
        queries = groups[i][chosen[groups[i]]]
        # All triangles of the group are chosen: the tree lists each pair once.
        if i == j and len(queries) == len(groups[i]) <= _MAX_AT_ONCE:
            table = trees[i].query_pairs(max_distance, output_type="ndarray")
            add_if_overlapping(*groups[i][table.T])
            continue
        step = max(1, _PAIRS_AT_ONCE // 64)  # for about 64 pairs of each triangle
        for start in range(0, len(queries), step):
            rows = queries[start : start + step]
            query_tree = kd_tree(center[rows])
            table = query_tree.sparse_distance_matrix(trees[j], max_distance, output_type="ndarray")
            first, second = rows[table["i"]], groups[j][table["j"]]
            is_new = (first < second) | ~chosen[second]  # two chosen triangles are listed once
            add_if_overlapping(first[is_new], second[is_new])
    return np.concatenate(batches).astype(np.int64)


def _are_separated(vertices: FloatArray, faces: IntArray, pairs: IntArray) -> BoolArray:
    """(k,) whether the two faces of each pair are proved to meet only in shared vertices. That is
    proved if all vertices of one face that are not shared lie strictly on one side of the plane of
    the other face. False if rounding leaves it undecided, and for two faces with the same three
    corners.

    The sign of a determinant, `height`, tells the side of the plane. Its rounding error is at most
    `broad_phase.ROUNDING` times the product of the three vectors' lengths.

    vertices, faces: (n, 3), (m, 3) the mesh.
    pairs: (k, 2) indices of faces.
    """
    apart = np.zeros(len(pairs), np.bool_)
    for first, second in (pairs.T, pairs.T[::-1]):
        rows = np.flatnonzero(~apart)
        base, other = faces[first[rows]], faces[second[rows]]
        a = vertices[base[:, 0]]
        u, v = vertices[base[:, 1]] - a, vertices[base[:, 2]] - a
        normal = np.cross(u, v)
        error_scale = ROUNDING * (row_norms(u) * row_norms(v))
        above, below = np.ones(len(rows), np.bool_), np.ones(len(rows), np.bool_)
        for k in range(3):
            offset = vertices[other[:, k]] - a
            height, error = row_dots(normal, offset), error_scale * row_norms(offset) + UNDERFLOW
            shared = (other[:, k, None] == base).any(axis=1)
            above &= shared | (height > error)
            below &= shared | (height < -error)
        # A face that shares all its corners is the same face.
        is_other = (other[:, :, None] != base[:, None]).all(axis=2).any(axis=1)
        apart[rows] = (above | below) & is_other
    return apart


def _side_signs(vertices: FloatArray, base: IntArray, other: IntArray) -> SignArray:
    """(k, 3) signs, decided exactly: for each corner of the faces `other`, on which side of a plane
    it lies, that of the face in the same row of `base`. The sign is 1 below the plane, from where
    the corners of `base` run clockwise; -1 above the plane; and 0 on it. Corners that both faces
    have get 0.

    vertices: (n, 3).
    base, other: (k, 3) indices of the corners of faces.
    """
    a, b, c = (vertices[base[:, i]] for i in range(3))
    signs = np.zeros((len(other), 3), np.int8)
    for i in range(3):
        rows = np.flatnonzero((other[:, i, None] != base).all(axis=1))
        signs[rows, i] = orient3d(a[rows], b[rows], c[rows], vertices[other[rows, i]])
    return signs


def _edge_pierces(
    vertices: FloatArray, pierced: IntArray, piercing: IntArray, sides: SignArray
) -> BoolArray:
    """(k,) whether an edge of the face `piercing` passes through the face `pierced` in the same
    row, or touches the boundary of `pierced`. It does if the edge's ends lie strictly on the two
    sides of the plane of `pierced`, and all three edges of `pierced` turn the same way around the
    edge's line, or touch the line.

    vertices: (n, 3).
    pierced, piercing: (k, 3) indices of the corners of faces.
    sides: (k, 3) the `_side_signs` of the corners of `piercing` for the planes of `pierced`.
    """
    pierces = np.zeros(len(piercing), np.bool_)
    for i, j in _EDGES:
        # Signs with a negative product: the ends are on different sides.
        rows = np.flatnonzero((sides[:, i] * sides[:, j] < 0) & ~pierces)
        p, q = vertices[piercing[rows, i]], vertices[piercing[rows, j]]
        x = [vertices[pierced[rows, k]] for k in range(3)]
        orientations = np.stack([orient3d(p, q, x[k], x[m]) for k, m in _EDGES])
        pierces[rows] = (orientations >= 0).all(axis=0) | (orientations <= 0).all(axis=0)
    return pierces


def _projection_axes(triangle: FloatArray) -> IntArray:
    """The two coordinates (k, 2) that a projection along the coordinate axis nearest to the normal
    of each of the triangles (k, 3, 3) keeps."""
    nearest = np.abs(area_normals(triangle)).argmax(axis=1)
    return np.array([[1, 2], [2, 0], [0, 1]])[nearest]


def _share_area(first: FloatArray, second: FloatArray) -> BoolArray:
    """(k,) whether two triangles in one plane have an area in common. They do unless the line of an
    edge separates them (separating axes). For the test they are projected to two dimensions, along
    the coordinate axis nearest to their normal.

    first, second: (k, 3, 3) the corners of the triangles of each pair.
    """
    axes = _projection_axes(first)[:, None]
    flat = [np.take_along_axis(t, axes, axis=2) for t in (first, second)]
    overlaps = np.ones(len(first), np.bool_)
    for a, b in (flat, flat[::-1]):
        # 1 if the projected triangle runs counter-clockwise; then its inside is left of its edges.
        sign = orient2d(a[:, 0], a[:, 1], a[:, 2])
        for i, j in _EDGES:
            side = [sign * orient2d(a[:, i], a[:, j], b[:, k]) for k in range(3)]
            overlaps &= (np.stack(side) > 0).any(axis=0)
    return overlaps


def _segments_meet(triangle: FloatArray, p: FloatArray, q: FloatArray) -> BoolArray:
    """(k,) whether segments meet triangles in whose planes they lie. A segment meets its triangle
    unless an edge's line has the segment strictly on its outer side, or the segment's line has the
    triangle strictly on one side (separating axes). False for triangles without an area.

    triangle: (k, 3, 3) the corners of the triangles.
    p, q: (k, 3) the ends of the segments; if they are equal, the segment is a point.
    """
    axes = _projection_axes(triangle)
    a = np.take_along_axis(triangle, axes[:, None], axis=2)
    p, q = (np.take_along_axis(end, axes, axis=1) for end in (p, q))
    # 1 if the projected triangle runs counter-clockwise; then its inside is left of its edges.
    sign = orient2d(a[:, 0], a[:, 1], a[:, 2])
    is_on = sign != 0
    for i, j in _EDGES:
        sides_of_ends = [sign * orient2d(a[:, i], a[:, j], end) for end in (p, q)]
        is_on &= (np.stack(sides_of_ends) >= 0).any(axis=0)
    sides_of_corners = np.stack([orient2d(p, q, a[:, k]) for k in range(3)])
    return is_on & ~((sides_of_corners > 0).all(axis=0) | (sides_of_corners < 0).all(axis=0))


def _is_in_angle(triangle: FloatArray, p: FloatArray) -> BoolArray:
    """(k,) whether points lie in the angle of a triangle at its first corner, its two sides
    included. False for triangles without an area.

    triangle: (k, 3, 3) the corners of the triangles.
    p: (k, 3) the points, each in the plane of its triangle.
    """
    axes = _projection_axes(triangle)
    a = np.take_along_axis(triangle, axes[:, None], axis=2)
    p = np.take_along_axis(p, axes, axis=1)
    sign = orient2d(a[:, 0], a[:, 1], a[:, 2])
    first_side = sign * orient2d(a[:, 0], a[:, 1], p)
    return (sign != 0) & (first_side >= 0) & (sign * orient2d(a[:, 2], a[:, 0], p) >= 0)
