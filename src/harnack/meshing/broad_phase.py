"""Which pairs of triangles may intersect: the broad phase of the intersection test. All other pairs
are proved apart, in floating point: the two triangles have nothing in common but vertices that they
share. Triangles are the faces of a mesh; some of them may be chosen, and only pairs with a chosen
face count. A lane is one of the many runs of a kernel on the device, each for one face or one pair.

A tree of bounding boxes is searched for each face, and the pairs whose boxes overlap are listed:
about eight for each face. The listed pairs are then tested in parallel, one pair in each lane.
Nearly all pairs are proved apart by the sign of a determinant that rounding cannot change. The
remaining pairs are decided by exact arithmetic (`self_intersection.intersecting_faces`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.record_table import RecordTable
from harnack.tree.balanced_tree import (
    NO_PRIMITIVE,
    LoopValues,
    PackedTree,
    VisitedNode,
    build_balanced_tree,
    for_each_primitive,
    pack_tree,
    traverse,
)
from harnack.tree.triangle_tree import node_boxes

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

    Corners = tuple[Vec3, Vec3, Vec3]

__all__ = ["ROUNDING", "near_pairs"]

# Columns of a box's record, after its two corners: the face's index, and whether it is chosen.
_FACE_INDEX, _IS_CHOSEN = 6, 7
_LEAF_SIZE = 8
# The number of faces for which the tree is searched at once, and the smallest number of pairs for
# which memory is reserved.
_WALK_SIZE, _PAIRS_AT_ONCE = 1 << 17, 1 << 22
# The rounding error of a product of vectors u, v, w whose components are differences of coordinates
# is at most ROUNDING times the product of their lengths. That holds for the determinant u . (v x
# w): at most seven roundings of up to six terms, and the sum of the terms is at most 1.16 times the
# product of the lengths. It holds for the dot product of two vectors: four roundings of three
# terms, and their sum is at most the product of the lengths. The error is at most a third of this
# bound.
ROUNDING = 16 * 2.0**-52
# A bound of the error by underflow, for coordinates of order one.
_UNDERFLOW = 1e-290


def near_pairs(vertices: FloatArray, faces: IntArray, among: BoolArray | None) -> IntArray:
    """Find the pairs of faces that may meet in more points than the vertices that they share.
    Returns the indices (k, 2) of the faces, each pair once. All other pairs are proved to meet only
    in shared vertices (`_are_apart`).

    vertices, faces: (n, 3), (m, 3) the mesh; all vertices are finite.
    among: (m,) mask of chosen faces; pairs without a chosen face are left out. None if all are
        chosen.
    """
    chosen = np.ones(len(faces), np.bool_) if among is None else among
    batches = [np.zeros((0, 2), np.int64)]
    if not chosen.any():
        return batches[0]
    largest = float(np.abs(vertices).max(initial=0.0))
    # Scaled by a power of two (`frexp` gives it second), so that nothing is rounded.
    scaled = np.ldexp(vertices, -int(np.frexp(largest)[1])) if largest else vertices
    boxes, pairs = _FaceBoxTree.of(scaled[faces], chosen), _PairTests.of(scaled, faces)
    rows = boxes.order[chosen[boxes.order]]
    room = max(_PAIRS_AT_ONCE, len(faces))
    pending = [rows[start : start + _WALK_SIZE] for start in range(0, len(rows), _WALK_SIZE)]
    while pending:
        batch = pending.pop()
        listed = boxes.overlapping(batch, room)
        # Too many pairs: search for each half of the faces. A single face always has room.
        if listed is None:
            pending += np.array_split(batch, 2)
            continue
        batches.append(pairs.unseparated(*listed))
    return np.concatenate(batches)


@dataclass(frozen=True)
class _FaceBoxTree:
    """A tree of the bounding boxes of all faces, on the device. A record is the row of numbers that
    describes one face there: the lower and the upper corner of its box, its index, and whether it
    is chosen (1 or 0).

    tree: the nodes, and the records of the faces in their leaves.
    records: (m, 8) the records in the order of the faces.
    order: (m,) the indices of the faces, leaf by leaf.
    """

    tree: PackedTree
    records: FloatArray
    order: IntArray

    @classmethod
    def of(cls, corners: FloatArray, chosen: BoolArray) -> _FaceBoxTree:
        """Build the tree over the bounding boxes of triangles.

        corners: (m, 3, 3) the corners of the triangles.
        chosen: (m,) mask of the chosen triangles."""
        a, b, c = (corners[:, k] for k in range(3))
        lower, upper = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        hierarchy = build_balanced_tree(0.5 * (lower + upper), leaf_size=_LEAF_SIZE)
        index_and_choice = np.column_stack([np.arange(len(corners)), chosen]).astype(np.float64)
        records = np.concatenate([lower, upper, index_and_choice], axis=1)
        slots = hierarchy.values_in_slots(records)
        # Leaves have the same number of slots for faces; an empty slot has the index -1.
        slots[hierarchy.leaf_slots == NO_PRIMITIVE, _FACE_INDEX] = -1.0
        boxes = node_boxes(hierarchy, lower, upper)
        order = hierarchy.leaf_slots[hierarchy.leaf_slots != NO_PRIMITIVE]
        return cls(pack_tree(choose_backend("double"), hierarchy, boxes, slots), records, order)

    def overlapping(self, rows: IntArray, room: int) -> tuple[Any, Any] | None:
        """List the pairs of a face in `rows` and any other face whose boxes overlap. A pair of two
        chosen faces is listed once.

        rows: (k,) indices of chosen faces.
        room: the largest number of pairs that can be stored.

        Returns two index arrays on the device, of the first and of the second faces of the pairs,
        in arbitrary order; or None if there are more than `room` pairs.
        """
        backend = self.tree.backend
        real, vector, integer = backend.Float, backend.Array3f, backend.UInt32
        columns = [real(np.ascontiguousarray(column)) for column in self.records[rows].T]
        low, high, own_index = vector(*columns[:3]), vector(*columns[3:6]), columns[_FACE_INDEX]
        # (An opaque number may change without compiling the kernel again.)
        pair_count, max_count = dr.zeros(integer, 1), dr.opaque(integer, room)
        # The pairs found so far: face own_faces[i] with face partners[i], for i < pair_count.
        own_faces, partners = dr.zeros(integer, room), dr.zeros(integer, room)

        def overlap(row: Any) -> Mask:
            """Whether the box in the record `row` overlaps the box of the lane's own face."""
            return dr.all((vector(*row[:3]) <= high) & (vector(*row[3:6]) >= low))

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Visit a node of the tree. In a leaf, the pairs of the lane's own face and the leaf's
            faces are listed. Returns the mask of lanes that descend, those where the node's box
            overlaps the box of the own face; and `state`, unchanged."""
            is_near = overlap(node.head)
            return is_near, for_each_primitive(node, is_near & node.is_leaf, add_pair, state)

        def add_pair(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """List the pair of the lane's own face and the face of the record `row`, if their boxes
            overlap. active: mask of the lanes that do so. state: not used; it is returned."""
            index = row[_FACE_INDEX]
            # Two chosen faces are listed once, by the face of smaller index. Empty slots (index -1)
            # are never listed.
            is_new = (index > own_index) | ((row[_IS_CHOSEN] == 0) & (index >= 0))
            is_pair = active & is_new & overlap(row)
            # The next free position, counted by all lanes together.
            slot = dr.scatter_inc(pair_count, integer(0), is_pair)
            has_room = is_pair & (slot < max_count)
            dr.scatter(own_faces, integer(own_index), slot, has_room)
            dr.scatter(partners, integer(index), slot, has_room)
            return state

        traverse(self.tree, visit, (real(0),))  # the traversal's own state is not used
        dr.eval(pair_count, own_faces, partners)
        count = int(to_numpy(pair_count)[0])
        if count > room:
            return None
        listed = dr.arange(integer, count)
        return dr.gather(integer, own_faces, listed), dr.gather(integer, partners, listed)


@dataclass(frozen=True)
class _PairTests:
    """Tests of pairs of faces, on the device: they prove that the two faces have nothing in common
    but shared vertices. `points` is a table of the vertices, and `corners` are the indices of the
    first, second and third vertices of all faces.

    points: the record table of the vertices.
    corners: three index arrays on the device: the first, second and third vertices of all faces.
    """

    points: RecordTable
    corners: tuple[Any, Any, Any]

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> _PairTests:
        """Upload vertices (n, 3) and faces (m, 3) to the device."""
        backend = choose_backend("double")
        a, b, c = (backend.UInt32(np.ascontiguousarray(column, np.uint32)) for column in faces.T)
        return cls(RecordTable.upload(backend, vertices), (a, b, c))

    def unseparated(self, first: Any, second: Any) -> IntArray:
        """Find the pairs of faces that are not proved apart. Returns the indices (k, 2) of the
        faces, in lexicographic order.

        first, second: index arrays on the device, of the first and of the second faces of all
            pairs.
        """
        backend = self.points.backend
        # For both faces of each pair, the indices of the three corners, and their positions.
        vertex_ids = [
            [dr.gather(backend.UInt32, column, face) for column in self.corners]
            for face in (first, second)
        ]
        triangles = [
            tuple(backend.Array3f(*self.points.read_record(vertex)[:3]) for vertex in ids)
            for ids in vertex_ids
        ]
        # shared[i][k]: whether corner i of the first face is corner k of the second.
        shared = [[vertex == another for another in vertex_ids[1]] for vertex in vertex_ids[0]]
        a, b = cast("tuple[Corners, Corners]", triangles)
        rows = dr.compress(~_are_apart(a, b, shared))
        pairs = [to_numpy(dr.gather(backend.UInt32, i, rows)) for i in (first, second)]
        unsorted_pairs = np.stack(pairs, axis=1).astype(np.int64)
        return unsorted_pairs[np.lexsort(unsorted_pairs.T[::-1])]


def _are_apart(a: Corners, b: Corners, shared: list[list[Mask]]) -> Mask:
    """Whether two triangles are proved to have nothing in common but the corners that they share,
    and the edge between these. False proves nothing.

    a, b: the three corners of each triangle.
    shared: shared[i][k] is whether corner i of `a` is the same vertex as corner k of `b`.

    Each of three conditions proves it:

    - *A plane*: all corners of one triangle that are not shared lie strictly on one side of the
      other triangle's plane (`_sides`). Only combinations of shared corners are then points of the
      first triangle on that plane.
    - *Edges*, if at most one corner is shared: two triangles in different planes meet in a segment
      on the line that the planes have in common. Each end of the segment lies on an edge of one
      triangle that passes through the other triangle. No edge does if every edge without a shared
      corner has both ends strictly on one side of the other triangle's plane, or if the line of the
      edge passes two edges of the other triangle on different sides (`_edge_may_pierce`). For
      triangles in one plane all these signs are 0, and nothing is proved.
    - *A line*, for triangles in one plane: an edge of one triangle lies on a line that has the two
      triangles on its two sides (`_are_beside_edge`).
    """
    is_shared_a = [shared[i][0] | shared[i][1] | shared[i][2] for i in range(3)]
    is_shared_b = [shared[0][k] | shared[1][k] | shared[2][k] for k in range(3)]
    real = cast("Any", type(a[0].x))
    shared_count: Real = sum(
        (dr.select(is_shared, real(1), real(0)) for is_shared in is_shared_a), real(0)
    )
    sides_of_b, sides_of_a = _sides(a, b), _sides(b, a)
    by_plane = _on_one_side(sides_of_b, is_shared_b) | _on_one_side(sides_of_a, is_shared_a)
    # Three shared corners: the same triangle twice. (Counts are floats.)
    by_plane &= shared_count < 2.5

    def by_edges_or_line(*arguments: Any) -> Mask:
        """Whether the two triangles are apart by the condition on edges or by the condition on a
        line (`_are_apart`). arguments: the three corners of the first triangle; those of the second
        one; for each corner of the first one whether it is shared; the same for the second one; and
        the number of shared corners."""
        first, second = cast("tuple[Corners, Corners]", (arguments[:3], arguments[3:6]))
        in_first, in_second, count = (list(arguments[6:9]), list(arguments[9:12]), arguments[12])
        may_pierce = _edge_may_pierce(first, second, _sides(first, second), in_second)
        may_pierce |= _edge_may_pierce(second, first, _sides(second, first), in_first)
        reordered = (
            _shared_corners_first(first, in_first, count),
            _shared_corners_first(second, in_second, count),
        )
        return ((count < 1.5) & ~may_pierce) | _are_beside_edge(*reordered, count)

    def never(*arguments: Any) -> Mask:
        """False in all lanes. It takes the place of the conditions on edges and on a line
        (`_are_apart`) where the condition on a plane holds already."""
        return arguments[12] < 0  # the number of shared corners

    # The other two conditions are tested on those lanes only on which no plane proves it.
    arguments = (*a, *b, *is_shared_a, *is_shared_b, shared_count)
    return by_plane | dr.if_stmt(arguments, ~by_plane, by_edges_or_line, never)


def _sides(base: Corners, triangle: Corners) -> list[tuple[Mask, Mask]]:
    """For each corner of `triangle`, two masks: whether the corner is proved to be above the plane
    of the triangle `base`, and whether it is proved to be below. Above is the side to which the
    normal of `base` points, by the right-hand rule. Both masks are False if rounding leaves the
    side undecided."""
    u, v = base[1] - base[0], base[2] - base[0]
    normal = dr.cross(u, v)
    error_scale = ROUNDING * dr.norm(u) * dr.norm(v)
    sides: list[tuple[Mask, Mask]] = []
    for corner in triangle:
        offset = corner - base[0]
        determinant, error = dr.dot(normal, offset), error_scale * dr.norm(offset) + _UNDERFLOW
        sides.append((determinant > error, determinant < -error))
    return sides


def _on_one_side(sides: list[tuple[Mask, Mask]], shared: list[Mask]) -> Mask:
    """Whether all corners of a triangle that are not shared are above a plane, or all below it.

    sides: for each corner two masks, whether it is above the plane and whether below (`_sides`).
    shared: whether each corner is shared with the other triangle.
    """
    above, below = (
        (sides[0][k] | shared[0]) & (sides[1][k] | shared[1]) & (sides[2][k] | shared[2])
        for k in range(2)
    )
    return above | below


def _edge_may_pierce(
    pierced: Corners, piercing: Corners, sides: list[tuple[Mask, Mask]], shared: list[Mask]
) -> Mask:
    """Whether an edge of the triangle `piercing` may pass through the triangle `pierced`. Edges
    with a shared corner are not considered.

    An edge is proved not to pass through if both of its ends are strictly on one side of the plane
    of `pierced`, or if its line passes one edge of `pierced` on the left and another edge on the
    right.

    sides: for each corner of `piercing` two masks, whether it is above the plane of `pierced` and
        whether below (`_sides`).
    shared: for each corner of `piercing`, whether it is a corner of `pierced` as well.
    """
    pierces = False
    for i, j in ((0, 1), (1, 2), (2, 0)):
        misses = (sides[i][0] & sides[j][0]) | (sides[i][1] & sides[j][1]) | shared[i] | shared[j]
        direction = piercing[j] - piercing[i]
        offsets = [corner - piercing[i] for corner in pierced]
        length, lengths = dr.norm(direction), [dr.norm(offset) for offset in offsets]
        left, right = False, False
        for k, m in ((0, 1), (1, 2), (2, 0)):
            # The volume between the edge's line and edge (k, m) of `pierced`; its sign is the side.
            value = dr.dot(direction, dr.cross(offsets[k], offsets[m]))
            error = ROUNDING * length * lengths[k] * lengths[m] + _UNDERFLOW
            left, right = (left | (value > error), right | (value < -error))
        pierces = pierces | ~(misses | (left & right))
    return pierces


def _shared_corners_first(triangle: Corners, shared: list[Mask], count: Real) -> Corners:
    """The corners of a triangle in the same cyclic order, begun so that the shared corners come
    first.

    shared: whether each corner is shared.
    count: how many are shared. With none or three the order has no meaning.
    """
    # The count is a float: 1 if it is below 1.5.
    is_single = count < 1.5
    # A single shared corner comes first; with two, the corner that is not shared comes last.
    from_second = dr.select(is_single, shared[1], ~shared[0])
    from_third = dr.select(is_single, shared[2], ~shared[1])
    has_none = count < 0.5
    from_second, from_third = from_second & ~has_none, from_third & ~has_none
    return tuple(
        dr.select(
            from_second,
            triangle[(k + 1) % 3],
            dr.select(from_third, triangle[(k + 2) % 3], triangle[k]),
        )
        for k in range(3)
    )  # type: ignore[return-value]


def _are_beside_edge(a: Corners, b: Corners, shared_count: Real) -> Mask:
    """Whether two triangles are proved to lie on two sides of a plane that contains an edge of one
    of them and is at right angles to that triangle.

    a, b: the corners of the triangles, the shared ones first.
    shared_count: the number of shared corners.

    Proof. All vectors start at the first end of the edge e. Let m be the computed vector, in the
    triangle's plane and nearly at right angles to e, and m' = m - (m.e/|e|^2) e without rounding.
    Then m'.e = 0 exactly, and for a vector x, m'.x differs from m.x by at most |m.e| |x|/|e|, which
    is only rounding.
    - No shared corner: m'.x <= 0 on the triangle of e, and m'.x > 0 on the other triangle (a
      separating axis).
    - One shared corner, where e starts: m'.x = 0 on e, m'.x < 0 at the third corner of the triangle
      of e, and m'.x > 0 at the two other corners of the other triangle. So points of both triangles
      have m'.x = 0, and the shared corner is the only such point of the other triangle. Another
      plane through the shared corner is tried as well (`_are_opposite_at_corner`).
    - Two shared corners, the ends of e: m'.x < 0 at the last corner of one triangle, and m'.x > 0
      at the last corner of the other triangle. So points of both triangles have m'.x = 0 and lie on
      e.
    """
    has_none, has_one = shared_count < 0.5, (shared_count > 0.5) & (shared_count < 1.5)
    has_two = (shared_count > 1.5) & (shared_count < 2.5)
    is_beside = False
    for first, second in ((a, b), (b, a)):
        for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            origin = first[i]
            # The edge e, and the third corner x of its triangle.
            e, x = first[j] - origin, first[k] - origin
            # -x without its component along e, so m points out of the triangle.
            m = dr.fma(e, dr.dot(x, e) / dr.squared_norm(e), -x)
            m_length, e_length = dr.norm(m), dr.norm(e)
            # The bound of |m'.x - m.x| / |x| in the proof; 1.01 covers its own rounding.
            dot_error = 1.01 * (dr.abs(dr.dot(m, e)) + ROUNDING * m_length * e_length) / e_length
            rounding = ROUNDING * m_length + dot_error

            def sides_of(offset: Vec3, m: Vec3 = m, rounding: Real = rounding) -> tuple[Mask, Mask]:
                """Whether m'.offset is proved positive, and whether it is proved negative.
                rounding: a bound of |m'.x - computed m.x|/|x| for every vector x."""
                value, error = dr.dot(m, offset), rounding * dr.norm(offset) + _UNDERFLOW
                return value > error, value < -error

            # Proved negative for the third corner; proved positive for the corners of the other
            # triangle.
            is_third_behind = sides_of(x)[1]
            are_corners_beyond = [sides_of(corner - origin)[0] for corner in second]
            # The shared corners come first: e has to start at corner 0, or to be the edge (0, 1).
            if i == 0:
                is_beside = is_beside | (
                    has_one & is_third_behind & are_corners_beyond[1] & are_corners_beyond[2]
                )
            if (i, j) == (0, 1):
                is_beside = is_beside | (has_two & is_third_behind & are_corners_beyond[2])
            # Without a shared corner the edge itself is behind as well: m'.e = 0.
            is_beside = is_beside | (
                has_none
                & is_third_behind
                & are_corners_beyond[0]
                & are_corners_beyond[1]
                & are_corners_beyond[2]
            )
    return is_beside | (has_one & _are_opposite_at_corner(a, b))


def _are_opposite_at_corner(a: Corners, b: Corners) -> Mask:
    """Whether two triangles that share their first corner are proved to lie on two sides of a plane
    through it: the other corners of `a` strictly on one side, those of `b` strictly on the other.
    One plane is tried. For each triangle, take the sum of the unit vectors along both edges at the
    shared corner, scaled to length 1; the plane's normal is the difference of the two sums."""
    edges = [one[k] - one[0] for one, k in itertools.product((a, b), (1, 2))]
    mean_directions = [dr.normalize(edges[k]) + dr.normalize(edges[k + 1]) for k in (0, 2)]
    plane_normal = dr.normalize(mean_directions[1]) - dr.normalize(mean_directions[0])
    rounding = ROUNDING * dr.norm(plane_normal)
    # The dot products with the edges of a, then of b; each with a bound of its rounding error.
    values = [(dr.dot(plane_normal, edge), rounding * dr.norm(edge) + _UNDERFLOW) for edge in edges]
    (a1, a1_error), (a2, a2_error), (b1, b1_error), (b2, b2_error) = values
    return (a1 < -a1_error) & (a2 < -a2_error) & (b1 > b1_error) & (b2 > b2_error)
