"""Checks that every mesh of a level set {f = 0} must pass, with exact predicates. A predicate is
the sign of a determinant. It tells on which side of a plane a point lies or, in two dimensions, on
which side of a line. A mesh consists of vertices (n, 3) and of triangular faces (m, 3), which hold
the indices of their corners. The normal of a face points to the side from which its corners run
counter-clockwise. Coordinates and distances have the unit of the vertices.

A determinant is computed in floating point, with a bound of its rounding error (Shewchuk, Adaptive
Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, 1997). Where that leaves
the sign undecided, it is computed in integers, without rounding: all coordinates are integers times
the same power of two.

Every mesh that `mesh` returns has passed checks: vertices and centers of triangles are tested by
samples of the field, faces that pass through each other are found by exact predicates, and the
number of triangles has a limit. The largest body is chosen by signed volumes and by the nesting of
shells (`clipping`). Files hold single precision; vertices are rounded to it before the last check.
"""

from __future__ import annotations

import itertools
from collections.abc import Generator
from typing import TYPE_CHECKING, Any, Never

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    boundary_edges,
    half_edges,
    longest_edges,
    normals_at_vertices,
    row_dots,
    row_norms,
    unit_rows,
)
from harnack.geometry.neighborhoods import connected_groups, kd_tree
from harnack.meshing.broad_phase import ROUNDING, near_pairs
from harnack.meshing.level_function import LevelFunction

if TYPE_CHECKING:
    from harnack.geometry import Volume

__all__ = [
    "EmptySurfaceError",
    "LocalizedMeshingError",
    "MeshingError",
    "OffLevelError",
    "SelfIntersectionError",
    "SignArray",
    "TriangleLimitError",
    "UnrefinableError",
    "check_inside",
    "check_manifold",
    "check_near_level",
    "check_no_self_intersection",
    "check_triangle_limit",
    "euler_characteristic",
    "intersecting_faces",
    "is_retry_promising",
    "misoriented_faces",
    "nonmanifold_vertices",
    "orient2d",
    "orient3d",
    "point_text",
    "points_off_level",
    "touching_pairs",
]

SignArray = npt.NDArray[np.int8]

# Exact signs.

# The unit roundoff.
_UNIT = 2.0**-53
# Shewchuk's bounds of the rounding errors of both determinants, relative to the sum of the absolute
# values of their terms.
_ORIENT3D_ERROR, _ORIENT2D_ERROR = (7 + 56 * _UNIT) * _UNIT, (3 + 16 * _UNIT) * _UNIT
# A bound of the error by underflow, for coordinates of order one.
_UNDERFLOW = 1e-290


def orient3d(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> SignArray:
    """The exact signs (n,) of det(a - d, b - d, c - d), for points (n, 3). The sign is 1 if a, b, c
    run clockwise as seen from d, -1 if they run counter-clockwise, and 0 if the four points lie in
    one plane."""
    points = _scaled(np.stack([a, b, c, d], axis=1))
    edges = points[:, :3] - points[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (edges[:, k].T for k in range(3))
    terms = [(bx * cy, cx * by, az), (cx * ay, ax * cy, bz), (ax * by, bx * ay, cz)]
    determinant = sum((plus - minus) * third for plus, minus, third in terms)
    sum_of_terms = sum(
        (np.abs(plus) + np.abs(minus)) * np.abs(third) for plus, minus, third in terms
    )
    # A row of zeros makes the determinant 0 exactly. Differences of doubles are 0 only where these
    # are equal.
    is_zero = (edges == 0).all(axis=1).any(axis=1)
    return _signs_with_fallback(
        np.asarray(determinant),
        _ORIENT3D_ERROR * np.asarray(sum_of_terms),
        is_zero,
        points,
        _orient3d_exact,
    )


def orient2d(a: FloatArray, b: FloatArray, c: FloatArray) -> SignArray:
    """The exact signs (n,) of det(a - c, b - c), for points (n, 2). The sign is 1 if a, b, c run
    counter-clockwise, -1 if they run clockwise, and 0 if they lie on one line."""
    points = _scaled(np.stack([a, b, c], axis=1))
    edges = points[:, :2] - points[:, 2:]
    (ax, ay), (bx, by) = (edges[:, k].T for k in range(2))
    determinant, sum_of_terms = ax * by - ay * bx, np.abs(ax * by) + np.abs(ay * bx)
    # A row of zeros makes the determinant 0 exactly.
    is_zero = (edges == 0).all(axis=1).any(axis=1)
    return _signs_with_fallback(
        determinant, _ORIENT2D_ERROR * sum_of_terms, is_zero, points, _orient2d_exact
    )


def _scaled(points: FloatArray) -> FloatArray:
    """The points, times a power of two that makes the largest absolute value of a coordinate at
    least 1/2 and less than 1. The signs of determinants stay the same. Short of underflow no
    coordinate is rounded."""
    largest = float(np.abs(points).max(initial=0.0))
    return points if largest == 0 else np.ldexp(points, -int(np.frexp(largest)[1]))


def _signs_with_fallback(
    value: FloatArray, error: FloatArray, zero: BoolArray, points: FloatArray, exact: Any
) -> SignArray:
    """The signs (n,) of determinants that are known up to an error. A sign that the error leaves
    undecided is computed without rounding.

    value: (n,) the approximate determinants.
    error: (n,) bounds of their errors.
    zero: (n,) mask of the determinants that are known to be 0.
    points: (n, k, d) the points that determine each determinant.
    exact: computes the determinants without rounding from points (j, k, d) with integer coordinates
        (`_integers`).
    """
    signs: SignArray = np.sign(value).astype(np.int8)
    signs[zero] = 0
    open_rows = np.flatnonzero(~zero & (np.abs(value) <= error + _UNDERFLOW))
    if len(open_rows):
        signs[open_rows] = np.sign(exact(_integers(points[open_rows]))).astype(np.int8)
    return signs


def _integers(points: FloatArray) -> Any:
    """Points with integer coordinates of Python's unlimited type `int`, in an array of objects: the
    given points, all times the same power of two, without rounding. A double is an integer of 53
    bits times a power of two; the smallest of these powers becomes 1."""
    mantissa, exponent = np.frexp(points)
    mantissas = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    used = mantissa != 0
    min_exponent = int(exponent[used].min()) if used.any() else 0
    return mantissas * 2 ** np.where(used, exponent - min_exponent, 0).astype(object)


def _orient3d_exact(points: Any) -> Any:
    """Compute det(a - d, b - d, c - d) without rounding, (n,) integers.

    points: (n, 4, 3) integer coordinates of the points a, b, c, d in each row.
    """
    rows = points[:, :3] - points[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (rows[:, k].T for k in range(3))
    return (bx * cy - cx * by) * az + (cx * ay - ax * cy) * bz + (ax * by - bx * ay) * cz


def _orient2d_exact(points: Any) -> Any:
    """Compute det(a - c, b - c) without rounding, (n,) integers.

    points: (n, 3, 2) integer coordinates of the points a, b, c in each row.
    """
    rows = points[:, :2] - points[:, 2:]
    (ax, ay), (bx, by) = (rows[:, k].T for k in range(2))
    return ax * by - ay * bx


# Triangles that intersect.

_EDGES = ((0, 1), (1, 2), (2, 0))
_PAIRS_AT_ONCE = 1 << 18
# For more triangles than this a kernel lists the pairs, which takes 0.05 s to record.
_MIN_FACES_FOR_KERNEL = 5_000
# Up to this many triangles of similar size are compared with each other at once.
_MAX_AT_ONCE = 1 << 19


def misoriented_faces(function: LevelFunction, vertices: FloatArray, faces: IntArray) -> IntArray:
    """Find the faces whose normal does not point to the side on which f is larger: the dot product
    of the normal with the gradient of f at the face's center is not positive. Returns their indices
    (k,).

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    """
    corner = vertices[faces]
    normal = area_normals(corner)
    slope = function.sample(corner.mean(axis=1)).gradient
    return np.flatnonzero(row_dots(normal, slope) <= 0)


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
    crossing_faces: list[IntArray] = []
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
        crossing_faces.append(pairs[meet].ravel())
    return np.unique(np.concatenate([*crossing_faces, np.zeros(0, np.int64)]))


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
    """Generate the pairs of faces that floating point does not prove to have only vertices in
    common, in batches. Each batch consists of the indices (k, 2) of the faces, and two arrays (k,
    3) of signs: for each corner of the second face, the side of the first face's plane on which it
    lies; and the reverse (`_side_signs`).

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
            height, error = row_dots(normal, offset), error_scale * row_norms(offset) + _UNDERFLOW
            shared = (other[:, k, None] == base).any(axis=1)
            above &= shared | (height > error)
            below &= shared | (height < -error)
        # A face that shares all its corners is the same face.
        is_other = (other[:, :, None] != base[:, None]).all(axis=2).any(axis=1)
        apart[rows] = (above | below) & is_other
    return apart


def _side_signs(vertices: FloatArray, base: IntArray, other: IntArray) -> SignArray:
    """For each corner of the faces `other`, the side of the plane of the face in the same row of
    `base` on which it lies; (k, 3) signs, decided exactly. The sign is 1 below the plane, from
    where the corners of `base` run clockwise; -1 above the plane; and 0 on it. Corners that both
    faces have get 0.

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


# Checks of whole meshes.


class MeshingError(ValueError):
    """A level set could not be meshed. The message says why, and names a remedy."""

    def may_be_fixed_by(self, smaller: float) -> bool:
        """Whether smaller cells of the lattice may avoid the error.

        smaller: the size of the smaller cells, as a fraction of the size of the cells that failed.
        """
        del smaller
        return True


class EmptySurfaceError(MeshingError):
    """The level set is empty: no cell of the lattice contains a point of it."""


class LocalizedMeshingError(MeshingError):
    """A check failed at known locations, so that smaller cells there may be enough.

    locations: (k, 3) points.
    """

    def __init__(self, message: str, places: FloatArray) -> None:
        super().__init__(message)
        self.locations = places


class OffLevelError(LocalizedMeshingError):
    """Vertices or centers of faces are farther from the level set than the tolerance; `locations`
    holds these points."""


class SelfIntersectionError(LocalizedMeshingError):
    """Triangles pass through each other.

    faces: (k,) the indices of these triangles.
    locations: (k, 3) their centers.
    """

    def __init__(self, message: str, places: FloatArray, faces: IntArray) -> None:
        super().__init__(message, places)
        self.faces = faces


class UnrefinableError(MeshingError):
    """An error that smaller cells of the lattice do not avoid."""

    def may_be_fixed_by(self, smaller: float) -> bool:
        """False: no cells are small enough. `smaller`, the size to be tried, plays no part."""
        del smaller
        return False


class TriangleLimitError(UnrefinableError):
    """The mesh would have more triangles than allowed, and was not begun."""


# Smaller cells are tried again if there are no more failures than the first, or than the second
# times the number of failures before.
_MAX_FAILURES_FOR_RETRY, _REQUIRED_FAILURE_REDUCTION = 20, 0.5


def is_retry_promising(
    now: MeshingError, before: MeshingError | None, smallest: float = 1.0
) -> bool:
    """Whether to try again with smaller cells after an attempt at meshing failed. It is not
    worthwhile if smaller cells cannot help. Nor is it if a check failed at more than 20 places, and
    at more than half as many as in the attempt before: along a pole of the function, or where
    surfaces on which it jumps cross, cells of every size fail.

    now: the error of the last attempt.
    before: the error of the attempt before it, or None.
    smallest: the size of the smallest cells allowed, relative to the cells that failed now.
    """
    if not now.may_be_fixed_by(smallest):
        return False
    if not isinstance(now, LocalizedMeshingError) or not isinstance(before, LocalizedMeshingError):
        return True
    return len(now.locations) <= max(
        _MAX_FAILURES_FOR_RETRY, _REQUIRED_FAILURE_REDUCTION * len(before.locations)
    )


def euler_characteristic(faces: IntArray, edges: Edges | None = None) -> int:
    """The Euler characteristic of faces (m, 3): the number of vertices that they use, minus the
    number of their edges, plus the number of faces.

    edges: the `Edges` of `half_edges(faces)`, if they are known.
    """
    vertices = int(np.count_nonzero(np.bincount(faces.ravel())))
    edges = edges or Edges.of(half_edges(faces))
    return vertices - len(edges.vertices) + len(faces)


def check_manifold(faces: IntArray, vertices: FloatArray | None = None) -> None:
    """Raise an error unless faces (m, 3) form a manifold: every edge has one or two faces, two
    faces run their common edge in opposite directions, and the faces around every vertex are joined
    to each other by edges.

    vertices: (n, 3), for the locations of failures; may be None.

    Raises:
        MeshingError: the faces are no manifold. It is a LocalizedMeshingError if vertices are
            given.
    """

    def fail(message: str, vertex_ids: IntArray) -> Never:
        """Raise the error of a failed check; `vertex_ids` are the indices of the vertices at which
        it failed."""
        if vertices is None:
            raise MeshingError(message)
        raise LocalizedMeshingError(message, vertices[vertex_ids])

    pairs = half_edges(faces)
    edges = Edges.of(pairs)
    index, uses = edges.edge_of_pair, edges.multiplicity
    if (uses > 2).any():
        fail(
            f"{(uses > 2).sum()} edges of the mesh have more than two faces: the level set crosses "
            "itself, or cells are too large for it; choose a smaller `cell_size`, or another level",
            np.unique(pairs[uses[index] > 2]),
        )
    is_run_alike = edges.run_twice_alike(pairs)
    if is_run_alike.any():
        fail(
            "neighboring faces of the mesh do not agree on its two sides: cells are too large for "
            "this level set; choose a smaller `cell_size`",
            np.unique(pairs[is_run_alike[index]]),
        )
    # A manifold has one fan of faces at each vertex that is used.
    fan_count = int(_vertex_fans(faces, edges).max(initial=-1)) + 1
    if fan_count > np.count_nonzero(np.bincount(faces.ravel())):
        fail(
            "sheets of the mesh touch in a point: cells are too large for this level set; choose a "
            "smaller `cell_size`, or another level",
            nonmanifold_vertices(faces),
        )


def check_no_self_intersection(vertices: FloatArray, faces: IntArray) -> None:
    """Raise an error if a vertex is not finite, or if faces pass through each other or lie on each
    other; decided exactly.

    vertices, faces: (n, 3), (m, 3) the mesh.

    Raises:
        MeshingError: a vertex is not finite. It is a SelfIntersectionError, with the faces, if
            faces meet.
    """
    if not np.isfinite(vertices).all():
        raise MeshingError("vertices of the mesh are no numbers: choose another level or `clip`")
    crossing = intersecting_faces(vertices, faces)
    if len(crossing):
        centers = vertices[faces[crossing]].mean(axis=1)
        raise SelfIntersectionError(
            f"{len(crossing):,} of {len(faces):,} triangles pass through each other, such as near "
            f"{point_text(centers[0])}: choose a smaller `cell_size` or a larger `tolerance`",
            centers,
            crossing,
        )


def check_triangle_limit(expected: float, max_triangles: int) -> None:
    """Raise TriangleLimitError if the number `expected` of triangles is larger than
    `max_triangles`."""
    if expected > max_triangles:
        raise TriangleLimitError(
            f"the mesh takes about {expected:.2g} triangles, and max_triangles is "
            f"{max_triangles:,}: choose a larger `tolerance` or `cell_size`, a smaller `clip`, "
            "or a larger `max_triangles`"
        )


def check_inside(vertices: FloatArray, volume: Volume, slack: float) -> None:
    """Raise MeshingError if a vertex (n, 3) lies outside of a volume by more than the length
    `slack`."""
    out = ~volume.padded(slack).contains_points(vertices)
    if out.any():
        raise MeshingError(
            f"{out.sum():,} vertices of the mesh lie outside of what was asked for, such as "
            f"{point_text(vertices[out][0])}: choose a smaller `cell_size`"
        )


def check_near_level(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    volume: Volume | None,
) -> None:
    """Raise an error unless all vertices and all centers of faces are within `tolerance`, a length,
    of the level set {f = 0}, where f is the field minus its level. Samples of f decide that.

    A point passes if |f| / |grad f| <= tolerance, which estimates the distance. It passes as well
    if f has different signs at two points on a line through it, on both sides of it and at the same
    distance of at most the tolerance: a continuous f is then 0 between them. Fourteen lines are
    tried: the normal of the face, or the mean normal at the vertex, and 13 fixed lines. The fixed
    lines are askew to the axes: many parts have faces in coordinate planes, where rounding would
    decide the sign. Every cone of half-angle 28 degrees contains one of these directions; the
    corner of a cube contains a cone of half-angle 35 degrees.

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    volume: the volume that cuts the solid, so that f counts as positive outside of it. None if the
        solid is not cut.

    Two kinds of points are not tested: vertices on the boundary curve of a level set of a field
    such as `SolidAngle`, since f has no value there; and centers of triangles with no edge longer
    than half of the tolerance, since their corners are tested.

    Raises:
        OffLevelError: some points are farther away; `locations` holds them.
    """
    off_level, count = points_off_level(function, vertices, faces, tolerance, volume)
    if len(off_level):
        raise OffLevelError(
            f"{len(off_level):,} of {count:,} vertices and centers of triangles are farther than "
            f"the tolerance, {tolerance:.3g}, from the level, such as {point_text(off_level[0])}: "
            "choose a smaller `cell_size` or a larger `tolerance`",
            off_level,
        )


def points_off_level(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    volume: Volume | None,
) -> tuple[FloatArray, int]:
    """Find the vertices and centers of faces that are not within `tolerance` of the level set, by
    samples of the function. `check_near_level` describes the test and the parameters.

    Returns these points (k, 3), and the number of points that were tested.
    """
    corner = vertices[faces]
    large = longest_edges(corner) > 0.5 * tolerance
    is_checked = np.ones(len(vertices), np.bool_)
    # Level sets of fields with a period may end at a curve, on which the field has no value.
    if function.period is not None:
        is_checked[boundary_edges(faces)] = False
    points = np.concatenate([vertices[is_checked], corner[large].mean(axis=1)])
    mean = normals_at_vertices(vertices, faces)
    directions = unit_rows(np.concatenate([mean[is_checked], area_normals(corner[large])]))
    # Not `>`: a distance that is not a number fails too.
    rows = np.flatnonzero(~(function.sample(points).distance <= tolerance))
    # Nearer points are tried as well: where the solid is thin, the farther ones may lie beyond it.
    for fraction, line in itertools.product((1.0, 0.25, 0.0625), (None, *_askew_lines())):
        if not len(rows):
            break
        step = fraction * tolerance * (directions[rows] if line is None else line)
        ahead, behind = (_is_positive(function, points[rows] + s * step, volume) for s in (1, -1))
        # Different signs: the level set passes between the two points.
        rows = rows[ahead == behind]
    return points[rows], len(points)


def _askew_lines() -> FloatArray:
    """Directions of 13 lines as unit vectors (13, 3): the axes, the face diagonals and the space
    diagonals of a cube. The cube is turned so that no line is near a coordinate plane or a plane at
    45 degrees to two axes."""
    directions = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))[14:]
    frame: FloatArray = np.linalg.qr([[7, 7, -3], [3, -16, -7], [19, 7, -13]])[0]
    return (directions / row_norms(directions)[:, None]) @ frame


def _is_positive(
    function: LevelFunction, points: FloatArray, volume: Volume | None
) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 3) count as outside of the solid: the function is positive or not a
    number there, or the point lies outside of the volume."""
    is_positive = ~(function.sample(points).value <= 0)
    return is_positive if volume is None else is_positive | ~volume.contains_points(points)


def point_text(x: FloatArray) -> str:
    """The coordinates of a point (3,) as text for messages, with four digits."""
    return "(" + ", ".join(f"{c:.4g}" for c in x) + ")"


def nonmanifold_vertices(faces: IntArray) -> IntArray:
    """Find the vertices at which faces (m, 3) are not a manifold: the ends of edges that have more
    than two faces, and vertices with more than one fan of faces. A fan is a set of faces around a
    vertex that are joined to each other by edges at that vertex. Returns the indices (k,) of these
    vertices, in increasing order."""
    pairs, count = half_edges(faces), int(faces.max(initial=-1)) + 1
    edges = Edges.of(pairs)
    overused = np.unique(pairs[edges.multiplicity[edges.edge_of_pair] > 2])
    fan = _vertex_fans(faces, edges)
    # Each fan once, at its vertex.
    vertex = np.empty(int(fan.max(initial=-1)) + 1, np.int64)
    vertex[fan] = faces.ravel()
    fans = np.bincount(vertex, minlength=count)
    return np.union1d(overused, np.flatnonzero(fans > 1))


def _vertex_fans(faces: IntArray, edges: Edges) -> IntArray:
    """Group the corners of faces (m, 3) into fans. A fan is a largest set of faces around a vertex
    that are joined to each other by edges at that vertex; each face of it takes part with its
    corner at the vertex.

    edges: the `Edges` of `half_edges(faces)`.

    Returns (3m,) for each corner the index of its fan, counted from 0 over all vertices together;
    entry 3 i + k is for corner k of face i.
    """
    m = len(faces)
    corner = np.arange(3 * m).reshape(m, 3)
    # Corners at both ends of the edge k of a face, in the order of `half_edges`.
    first = np.concatenate([corner[:, 0], corner[:, 1], corner[:, 2]])
    second = np.concatenate([corner[:, 1], corner[:, 2], corner[:, 0]])
    forward, backward = edges.paired_half_edges().T  # run in opposite directions
    # Across an edge, the corners at its one end belong together, and those at its other end.
    rows = np.concatenate([first[forward], second[forward]])
    columns = np.concatenate([second[backward], first[backward]])
    return connected_groups(np.column_stack([rows, columns]), 3 * m)
