"""Triangles of a mesh that overlap in the same plane, as where parts of a mesh touch; and the
borders of the overlaps. A face is *covered* where other faces in its plane lie on it. To *cut* a
face, it is divided by the plane of another triangle, a *knife*. A *lane* is one entry of Dr.Jit's
arrays, here a face.

Two such triangles do not pass through each other: no edge of either crosses the other. Yet the
winding number just above or below one triangle jumps where one crosses the border of the other
triangle. So faces are cut at these borders.
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

# A length in units of the mesh's size: a triangle lies in a plane if it is within this distance of
# it, and two triangles overlap if they do so by more than this.
_IN_PLANE = 1e-12
# The edge of the cells of R^4 by which planes are told apart: each plane is a point of R^4
# (`_candidates`).
_PLANE_CELL = 1e-6
# The rounding of a normal, as a length at the corner of a triangle of size one.
_NORMAL_ROUNDING = 1e-15
# Odd numbers by which the four coordinates of a cell are multiplied to hash it to one number.
_HASH_FACTORS = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64
)


def borders_of_overlaps(
    tree: TriangleTree, vertices: FloatArray, faces: IntArray, *, at_every_edge: bool = False
) -> tuple[IntArray, FloatArray]:
    """The faces that are partly covered by other faces in their plane, and where to cut them so
    that each piece is covered completely or not at all.

    tree: a tree of the same faces, with coordinates of at most about 1.
    vertices, faces: (n, 3) and (m, 3), the mesh.
    at_every_edge: whether to cut along all edges of the covering faces. If not, an edge is left out
        if all faces at this edge cover the face, and together run the edge equally often in both
        directions: the face is then equally covered on both sides of the edge.

    Returns:
        The indices of the covered faces (k,), repeated for each border edge; and knives (k, 3, 3):
        triangles that meet the plane of the face in an edge of the border of the covered part.
    """
    covered, covering = overlapping_faces(tree, vertices, faces)
    if not len(covered):
        return covered, np.zeros((0, 3, 3))
    # Each pair of a covered face and an edge of a covering face becomes one integer. `count` is how
    # many covering faces have the edge, `net` the sum of its directions there.
    edges, sign = _edges(faces[covering])
    unique_edges, edge_index = np.unique(edges, axis=0, return_inverse=True)
    edge_index = edge_index.reshape(-1)
    pairs = np.repeat(covered, 3) * len(unique_edges) + edge_index
    pair_keys, pair_index, count = np.unique(pairs, return_inverse=True, return_counts=True)
    net = np.zeros(len(pair_keys), np.int64)
    np.add.at(net, pair_index.reshape(-1), sign)
    face, edge = np.divmod(pair_keys, len(unique_edges))
    # How many faces of the mesh have the edge. Edges are looked up by a single integer each.
    ends, face_count = np.unique(_edges(faces)[0], axis=0, return_counts=True)
    width = len(vertices)
    place_in_ends = np.searchsorted(ends @ [width, 1], unique_edges[edge] @ [width, 1])
    is_border = at_every_edge | (net != 0) | (count != face_count[place_in_ends])
    face, edge = face[is_border], edge[is_border]
    p, q = np.moveaxis(vertices[unique_edges[edge]], 1, 0)
    normal, _ = _normals(vertices[faces[face]])
    # Two corners of a knife are behind the face and one is in front of it. The face's plane cuts
    # the knife halfway between them, in the edge from p to q.
    away = np.linalg.norm(q - p, axis=1, keepdims=True) * normal
    middle, side = 0.5 * (p + q), q - p
    return face, np.stack([middle - away - side, middle - away + side, middle + away], axis=1)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """The three edges of each of the faces (m, 3), and in which direction the face runs them.

    Returns:
        (3 m, 2) the vertices of each edge, the lower index first; and (3 m,) 1 if the face runs the
        edge in that order, else -1.
    """
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.sort(ends, axis=1), np.where(ends[:, 0] < ends[:, 1], 1, -1)


def _normals(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (m, 3) of triangles with corners (m, 3, 3), 0 for triangles without an area; and
    their heights (m,) above their longest edges."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    area = np.sqrt(np.einsum("ni,ni->n", normal, normal))  # twice the triangle's area
    squares = [np.einsum("ni,ni->n", edge, edge) for edge in (u, v, u - v)]
    longest = np.sqrt(np.max(squares, axis=0))
    height = area / np.where(longest > 0, longest, 1)
    return normal / np.where(area > 0, area, 1)[:, None], height


def _candidates(corners: FloatArray, normals: FloatArray, heights: FloatArray) -> IntArray:
    """The indices (k,) of triangles in whose plane other triangles may lie. Of two triangles in one
    plane, the one with the smaller height is always among them.

    corners: (m, 3, 3) the corners of all triangles.
    normals: (m, 3) their unit normals.
    heights: (m,) for each triangle, its height above its longest edge.

    A plane is a point of R^4: its unit normal and its distance from the origin. The normal is
    turned so that its first coordinate that is larger than 0.3 in magnitude is positive; a unit
    vector always has one. For two triangles in one plane these points differ only by rounding and
    by the effect of moving corners by `_IN_PLANE`, divided by the smaller of the triangles'
    heights. R^4 is divided into cells. So a triangle that is alone in its cell shares its plane
    with another triangle only in two cases: its point is nearer to a wall of the cell than this
    difference, or a coordinate of its normal is nearer to 0.3 in magnitude than this difference.
    """
    excess = np.abs(normals) - 0.3
    # The first coordinate larger than 0.3 in magnitude decides the orientation: `argmax` gives the
    # place of the first True.
    deciding = np.take_along_axis(normals, (excess > 0).argmax(axis=1)[:, None], axis=1)
    normals = np.where(deciding < 0, -normals, normals)
    plane = np.column_stack([normals, np.einsum("ni,ni->n", normals, corners[:, 0])]) / _PLANE_CELL
    cell = np.floor(plane)
    in_cell = plane - cell
    wall_distance = np.minimum(in_cell, 1 - in_cell).min(axis=1) * _PLANE_CELL
    # Four times the difference of the docstring; infinite, in effect, without a height.
    tolerance = 4 * (_IN_PLANE + _NORMAL_ROUNDING) / np.where(heights > 0, heights, 1e-300)
    is_sure = (wall_distance > tolerance) & (np.abs(excess).min(axis=1) > tolerance)
    # Each cell of R^4 is hashed to one number. If two cells get the same number, they count as one
    # cell, which only adds candidates.
    number = (cell.astype(np.int64).astype(np.uint64) * _HASH_FACTORS).sum(axis=1)
    _, group, count = np.unique(number, return_inverse=True, return_counts=True)
    return np.flatnonzero((count[group] > 1) | ~is_sure)


def overlapping_faces(
    tree: TriangleTree, vertices: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray]:
    """All pairs of faces (m, 3) that lie in one plane and overlap. Returns the indices (k,) of the
    first and (k,) of the second faces of the pairs; each pair occurs in both orders.

    tree: a tree of the same faces, with coordinates of at most about 1.
    vertices: (n, 3).

    The search begins at the smaller face of each pair: for each face it finds the overlapping faces
    that are at least as large, and there are few of them. The size of a face is its height above
    its longest edge.
    """
    backend = tree.tree.backend
    corners = vertices[faces]
    normals, heights = _normals(corners)
    # In each round, find the next partner of each face of `searching`, after the last one found
    # (`after`; -1 is before all faces).
    searching = _candidates(corners, normals, heights)
    sizes, after = backend.Float(heights), np.full(len(searching), -1.0)
    batches: list[IntArray] = []
    while len(searching):
        ends = tuple(
            to_vector3(backend, corner) for corner in np.moveaxis(corners[searching], 1, 0)
        )
        ids = upload_integers(backend, searching)
        partners = _next_in_plane(tree, ends, ids, sizes, backend.Float(after))
        number = to_numpy(partners).astype(np.int64)
        is_found = number != NO_TRIANGLE
        searching, after = searching[is_found], number[is_found].astype(np.float64)
        batches.append(np.column_stack([searching, number[is_found]]))
    if not batches:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = np.concatenate(batches)
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _next_in_plane(
    tree: TriangleTree, corners: tuple[Vec3, ...], face: Any, sizes: Real, after: Real
) -> Any:
    """For each lane, which has one face, the lowest-numbered face after the number `after` that is
    coplanar with the lane's face, overlaps it and is at least as large. NO_TRIANGLE if there is
    none.

    tree: a tree of all faces.
    corners, face: the corners and the number of the lane's face.
    sizes: the height of each face above its longest edge; of two faces with equal heights the
        later one counts as larger.
    """
    backend = tree.tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    a, b, c = corners
    size = dr.gather(real, sizes, face)
    low, high = fmin(fmin(a, b), c) - _IN_PLANE, fmax(fmax(a, b), c) + _IN_PLANE

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box meets the box of the lane's face. state: the lowest number of a
        face found so far. Returns the mask of lanes that enter the node, and the state, which the
        faces of a leaf have updated."""
        node_low, node_high = vector(*node.head[:3]), vector(*node.head[3:6])
        is_near = dr.all((node_low <= high) & (node_high >= low))
        return is_near, for_each_primitive(node, is_near & node.is_leaf, lower_numbered, state)

    def lower_numbered(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """Return the new state: the number of the face in the record `row` if this face is sought
        and its number is lower than `state`, the lowest so far; otherwise `state`. A face is sought
        if its number is above the parameter `after` of the enclosing function, and it is larger
        than the lane's face, lies in its plane and overlaps it."""
        # The number -1 of an empty slot is no index; such a slot is never chosen.
        number = index(fmax(row[NUMBER_COLUMN], real(0)))
        other_corners = corners_of(row, vector)
        other_size = dr.gather(real, sizes, number, active)
        # `size`, `face` and `corners` are those of the lane's face.
        is_larger = (other_size > size) | ((other_size == size) & (number > face))
        is_chosen = active & (row[NUMBER_COLUMN] > after) & (number < state[0]) & is_larger
        is_chosen &= _in_plane(corners, other_corners) & _overlap(corners, other_corners)
        return (dr.select(is_chosen, number, state[0]),)

    # The state is the lowest number so far.
    return traverse(tree.tree, visit, (index(NO_TRIANGLE),))[0]


def _unit(vector: Vec3) -> Vec3:
    """A vector scaled to length 1; a vector of length 0 stays 0."""
    length = dr.norm(vector)
    return dr.select(length > 0, vector / dr.select(length > 0, length, 1), 0)


def _normal(corners: tuple[Vec3, ...]) -> Vec3:
    """The unit normal of a triangle with three corners; 0 if it has no area."""
    a, b, c = corners
    return _unit(dr.cross(b - a, c - a))


def _in_plane(ours: tuple[Vec3, ...], theirs: tuple[Vec3, ...]) -> Mask:
    """Whether one of two triangles has all its corners in the plane of the other one, up to
    `_IN_PLANE`. It is enough that this holds for one of the two planes, since the normal of a thin
    triangle may be only rounding error.

    ours, theirs: the corners of the two triangles.
    """

    def lies_in(corners: tuple[Vec3, ...], plane: tuple[Vec3, ...]) -> Mask:
        """Whether three corners lie in the plane of the triangle with the corners `plane`; False if
        this triangle has no area."""
        # A unit vector, or 0 if the triangle has no area.
        normal = _normal(plane)
        is_near = [dr.abs(dr.dot(normal, p - plane[0])) <= _IN_PLANE for p in corners]
        return is_near[0] & is_near[1] & is_near[2] & (dr.squared_norm(normal) > 0.5)

    return lies_in(ours, theirs) | lies_in(theirs, ours)


def _overlap(ours: tuple[Vec3, ...], theirs: tuple[Vec3, ...]) -> Mask:
    """Whether two triangles in one plane overlap by more than the length `_IN_PLANE`. They do if no
    edge of either triangle separates them, that is, has the whole other triangle on its outer side.

    ours, theirs: the corners of the two triangles.
    """
    overlaps: Mask = True
    for first, second in ((ours, theirs), (theirs, ours)):
        normal = _normal(first)
        for k in range(3):
            p, q = first[k], first[(k + 1) % 3]
            inward = dr.cross(normal, _unit(q - p))
            offsets = [dr.dot(inward, x - p) for x in second]
            overlaps &= fmax(fmax(offsets[0], offsets[1]), offsets[2]) > _IN_PLANE
    return overlaps
