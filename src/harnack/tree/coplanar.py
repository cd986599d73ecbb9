"""Triangles that overlap in the same plane, as where parts of a mesh touch; and the borders of the
overlaps.

Neither of two such triangles passes through the other, so that no edge crosses a face; and yet the
winding number beside one triangle changes where the other ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray, to_numpy, to_vector3
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmax, fmin
from harnack.tree.balanced_tree import LoopValues, VisitedNode, for_each_primitive, traverse
from harnack.tree.triangle_tree import NO_TRIANGLE, NUMBER_COLUMN, TriangleTree, corners_of

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

__all__ = ["borders_of_overlaps", "overlapping_faces"]

# In units of the mesh's size: triangles this near to a plane lie in it, and overlap by more than
# this.
_SAME = 1e-12
# The size of the cells, of normals and distances from the origin, in which planes are told apart.
_CELL = 1e-6
# The rounding of a normal, as a length at the corner of a triangle of size one.
_ROUNDED = 1e-15
# Odd numbers, with which coordinates of cells are hashed to one number.
_MIXED = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64
)


def borders_of_overlaps(
    rays: TriangleTree, vertices: FloatArray, faces: IntArray, *, at_every_edge: bool = False
) -> tuple[IntArray, FloatArray]:
    """The faces (k,) with parts that other faces in their plane cover, and knives (k, 3, 3):
    triangles that meet that plane in an edge of the covered part's border.

    rays: a tree of the same faces, with coordinates of at most about 1.
    at_every_edge: whether edges between the covering faces count as borders. If not, edges inside
        of a covered part are left out where the covering faces meet in edges that no further face
        has: the face is equally covered on both sides.
    """
    covered, covering = overlapping_faces(rays, vertices, faces)
    if not len(covered):
        return covered, np.zeros((0, 3, 3))
    edges, sign = _edges(faces[covering])
    key, number = np.unique(edges, axis=0, return_inverse=True)
    number = number.reshape(-1)
    pairs = np.repeat(covered, 3) * len(key) + number
    lines, line, count = np.unique(pairs, return_inverse=True, return_counts=True)
    net = np.zeros(len(lines), np.int64)
    np.add.at(net, line.reshape(-1), sign)
    face, edge = np.divmod(lines, len(key))
    ends, faces_at = np.unique(_edges(faces)[0], axis=0, return_counts=True)
    width = len(vertices)
    at = np.searchsorted(ends @ [width, 1], key[edge] @ [width, 1])
    is_border = at_every_edge | (net != 0) | (count != faces_at[at])
    face, edge = face[is_border], edge[is_border]
    p, q = np.moveaxis(vertices[key[edge]], 1, 0)
    normal, _ = _normals(vertices[faces[face]])
    away = np.linalg.norm(q - p, axis=1, keepdims=True) * normal
    middle, side = 0.5 * (p + q), q - p
    return face, np.stack([middle - away - side, middle - away + side, middle + away], axis=1)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Edges (3 m, 2) of faces, the lower index first, and -1 for those that this order reverses,
    else 1."""
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.sort(ends, axis=1), np.where(ends[:, 0] < ends[:, 1], 1, -1)


def _normals(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (m, 3) of triangles, 0 for triangles without a normal, and heights (m,) over
    their longest edges."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    area = np.sqrt(np.einsum("ni,ni->n", normal, normal))
    squares = [np.einsum("ni,ni->n", edge, edge) for edge in (u, v, u - v)]
    longest = np.sqrt(np.max(squares, axis=0))
    height = area / np.where(longest > 0, longest, 1)
    return normal / np.where(area > 0, area, 1)[:, None], height


def _candidates(corners: FloatArray, normal: FloatArray, height: FloatArray) -> IntArray:
    """Triangles (k,) in whose plane others may lie.

    A plane is a point of R^4: its normal, whose first coordinate that is clear of 0 is positive,
    and its distance from the origin. For two triangles in one plane these points differ by rounding
    and by a move of corners by `_SAME`, over the smaller of their heights. So of triangles that are
    alone in their cell of R^4 only those as near to its walls may have others in their plane; the
    lower triangle of a pair is always among the returned triangles.
    """
    clear = np.abs(normal) - 0.3
    first = np.take_along_axis(normal, (clear > 0).argmax(axis=1)[:, None], axis=1)
    normal = np.where(first < 0, -normal, normal)
    position = np.column_stack([normal, np.einsum("ni,ni->n", normal, corners[:, 0])]) / _CELL
    cell = np.floor(position)
    within = position - cell
    to_wall = np.minimum(within, 1 - within).min(axis=1) * _CELL
    tolerance = 4 * (_SAME + _ROUNDED) / np.where(height > 0, height, 1e-300)
    is_sure = (to_wall > tolerance) & (np.abs(clear).min(axis=1) > tolerance)
    # Cells with the same number count as one cell.
    number = (cell.astype(np.int64).astype(np.uint64) * _MIXED).sum(axis=1)
    _, group, count = np.unique(number, return_inverse=True, return_counts=True)
    return np.flatnonzero((count[group] > 1) | ~is_sure)


def overlapping_faces(
    rays: TriangleTree, vertices: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray]:
    """Pairs of faces (k,), (k,) that overlap in a plane, each in both orders.

    For each face, the overlapping faces that are not lower than itself are searched for; there are
    few.
    """
    backend = rays.tree.backend
    corners = vertices[faces]
    normals, heights = _normals(corners)
    rows = _candidates(corners, normals, heights)
    sizes, after = backend.Float(heights), np.full(len(rows), -1.0)
    batches: list[IntArray] = []
    while len(rows):
        ends = tuple(to_vector3(backend, corner) for corner in np.moveaxis(corners[rows], 1, 0))
        ids = upload_integers(backend, rows)
        partners = _next_in_plane(rays, ends, ids, sizes, backend.Float(after))
        number = to_numpy(partners).astype(np.int64)
        hit = number != NO_TRIANGLE
        rows, after = rows[hit], number[hit].astype(np.float64)
        batches.append(np.column_stack([rows, number[hit]]))
    if not batches:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = np.concatenate(batches)
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _next_in_plane(
    rays: TriangleTree, corners: tuple[Vec3, ...], face: Any, sizes: Real, after: Real
) -> Any:
    """The first face with a number above `after` that overlaps `face`, a face in each lane, in its
    plane, and is no smaller. sizes: of all faces; of two equal faces the later counts as larger."""
    backend = rays.tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    a, b, c = corners
    size = dr.gather(real, sizes, face)
    low, high = fmin(fmin(a, b), c) - _SAME, fmax(fmax(a, b), c) + _SAME

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        below, above = vector(*node.head[:3]), vector(*node.head[3:6])
        open_ = dr.all((below <= high) & (above >= low))
        return open_, for_each_primitive(node, open_ & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        number = index(fmax(row[NUMBER_COLUMN], real(0)))
        theirs = corners_of(row, vector)
        their_size = dr.gather(real, sizes, number, active)
        larger = (their_size > size) | ((their_size == size) & (number > face))
        chosen = active & (row[NUMBER_COLUMN] > after) & (number < state[0]) & larger
        chosen &= _in_plane(corners, theirs) & _overlap(corners, theirs)
        return (dr.select(chosen, number, state[0]),)

    return traverse(rays.tree, visit, (index(NO_TRIANGLE),))[0]


def _unit(vector: Vec3) -> Vec3:
    """A vector scaled to length 1; 0 stays 0."""
    length = dr.norm(vector)
    return dr.select(length > 0, vector / dr.select(length > 0, length, 1), 0)


def _normal(corners: tuple[Vec3, ...]) -> Vec3:
    a, b, c = corners
    return _unit(dr.cross(b - a, c - a))


def _in_plane(ours: tuple[Vec3, ...], theirs: tuple[Vec3, ...]) -> Mask:
    """Whether one of two triangles has all corners in the plane of the other. (The normal of a thin
    triangle may be only rounding.)"""

    def lies_in(corners: tuple[Vec3, ...], plane: tuple[Vec3, ...]) -> Mask:
        normal = _normal(plane)
        near = [dr.abs(dr.dot(normal, p - plane[0])) <= _SAME for p in corners]
        return near[0] & near[1] & near[2] & (dr.squared_norm(normal) > 0.5)

    return lies_in(ours, theirs) | lies_in(theirs, ours)


def _overlap(ours: tuple[Vec3, ...], theirs: tuple[Vec3, ...]) -> Mask:
    """Whether two triangles in a plane overlap by more than `_SAME`: no edge of either has the
    other triangle on its far side."""
    overlaps: Mask = True
    for triangle, opposite in ((ours, theirs), (theirs, ours)):
        normal = _normal(triangle)
        for k in range(3):
            p, q = triangle[k], triangle[(k + 1) % 3]
            inward = dr.cross(normal, _unit(q - p))
            reach = [dr.dot(inward, x - p) for x in opposite]
            overlaps &= fmax(fmax(reach[0], reach[1]), reach[2]) > _SAME
    return overlaps
