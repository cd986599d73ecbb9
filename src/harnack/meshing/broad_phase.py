"""The broad phase of the intersection test: the pairs of triangles that may meet. All other pairs
are proved apart, in floating point.

Each triangle walks a tree of boxes, and the pairs whose boxes overlap are listed: about eight for
each triangle. They are then tested side by side, since tests within the walk would wait for each
other. Nearly all are separated by a sign that rounding cannot change; the remaining pairs are for
exact arithmetic (`checks.intersecting_faces`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.record_table import RecordTable
from harnack.meshing.edges import IntArray
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

# Columns of a record behind the box: the face's number, and whether it is chosen.
_NUMBER, _CHOSEN = 6, 7
_LEAF_SIZE = 8
# The number of triangles that walk the tree at once, and the smallest number of pairs that there is
# room for.
_ROWS_AT_ONCE, _PAIRS_AT_ONCE = 1 << 17, 1 << 22
# A bound of the rounding of a product of three vectors, or of two, whose components are differences
# of coordinates, relative to the product of their lengths: at most seven roundings of up to six
# terms, whose sum is at most 1.16 times that product, and four of three terms, whose sum is at most
# that product. The rounding is a third of this bound.
ROUNDING = 16 * 2.0**-52
# A bound of the error by underflow, for coordinates of order one.
_UNDERFLOW = 1e-290


def near_pairs(vertices: FloatArray, faces: IntArray, mask: BoolArray | None) -> IntArray:
    """Pairs (k, 2) of faces (m, 3) that may have more in common than the vertices that they share,
    each once; all others are proved not to (`_are_apart`).

    vertices: (n, 3), finite.
    mask: (m,) mask of chosen faces; pairs without a chosen face are left out.
    """
    chosen = np.ones(len(faces), np.bool_) if mask is None else mask
    batches = [np.zeros((0, 2), np.int64)]
    if not chosen.any():
        return batches[0]
    largest = float(np.abs(vertices).max(initial=0.0))
    # Scaled by a power of two, so that nothing is rounded.
    scaled = np.ldexp(vertices, -int(np.frexp(largest)[1])) if largest else vertices
    boxes, pairs = _FaceBoxTree.of(scaled[faces], chosen), _PairTests.of(scaled, faces)
    rows = boxes.order[chosen[boxes.order]]
    room = max(_PAIRS_AT_ONCE, len(faces))
    pending = [rows[start : start + _ROWS_AT_ONCE] for start in range(0, len(rows), _ROWS_AT_ONCE)]
    while pending:
        batch = pending.pop()
        listed = boxes.overlapping(batch, room)
        if listed is None:  # a single triangle always has room
            pending += np.array_split(batch, 2)
            continue
        batches.append(pairs.unseparated(*listed))
    return np.concatenate(batches)


@dataclass(frozen=True)
class _FaceBoxTree:
    """The boxes of faces in a tree. records: (m, 8), a row for each box; order: the indices of the
    faces, leaf by leaf."""

    tree: PackedTree
    records: FloatArray
    order: IntArray

    @classmethod
    def of(cls, corners: FloatArray, mask: BoolArray) -> _FaceBoxTree:
        a, b, c = (corners[:, k] for k in range(3))
        lower, upper = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        hierarchy = build_balanced_tree(0.5 * (lower + upper), leaf_size=_LEAF_SIZE)
        numbers = np.column_stack([np.arange(len(corners)), mask]).astype(np.float64)
        records = np.concatenate([lower, upper, numbers], axis=1)
        placed = hierarchy.values_in_slots(records)
        placed[hierarchy.leaf_slots == NO_PRIMITIVE, _NUMBER] = -1.0
        levels = node_boxes(hierarchy, lower, upper)
        order = hierarchy.leaf_slots[hierarchy.leaf_slots != NO_PRIMITIVE]
        return cls(pack_tree(choose_backend("double"), hierarchy, levels, placed), records, order)

    def overlapping(self, rows: IntArray, limit: int) -> tuple[Any, Any] | None:
        """The pairs of a face in `rows` and any face whose boxes overlap, as two lists, in no
        order; None if there are more than `limit`."""
        backend = self.tree.backend
        real, vector, integer = backend.Float, backend.Array3f, backend.UInt32
        columns = [real(np.ascontiguousarray(column)) for column in self.records[rows].T]
        low, high, own_number = vector(*columns[:3]), vector(*columns[3:6]), columns[_NUMBER]
        number, max_count = dr.zeros(integer, 1), dr.opaque(integer, limit)
        column, partners = dr.zeros(integer, limit), dr.zeros(integer, limit)

        def overlap(row: Any) -> Mask:
            return dr.all((vector(*row[:3]) <= high) & (vector(*row[3:6]) >= low))

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            near = overlap(node.head)
            return near, for_each_primitive(node, near & node.is_leaf, put, state)

        def put(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            with_number = row[_NUMBER]
            # Two chosen faces are listed once.
            once = (with_number > own_number) | ((row[_CHOSEN] == 0) & (with_number >= 0))
            met = active & once & overlap(row)
            slot = dr.scatter_inc(number, integer(0), met)
            has_room = met & (slot < max_count)
            dr.scatter(column, integer(own_number), slot, has_room)
            dr.scatter(partners, integer(with_number), slot, has_room)
            return state

        traverse(self.tree, visit, (real(0),))
        dr.eval(number, column, partners)
        count = int(to_numpy(number)[0])
        if count > limit:
            return None
        listed = dr.arange(integer, count)
        return dr.gather(integer, column, listed), dr.gather(integer, partners, listed)


@dataclass(frozen=True)
class _PairTests:
    """Tests of pairs of faces. points: the records of the vertices. corners: the three columns of
    the faces."""

    points: RecordTable
    corners: tuple[Any, Any, Any]

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> _PairTests:
        backend = choose_backend("double")
        a, b, c = (backend.UInt32(np.ascontiguousarray(column, np.uint32)) for column in faces.T)
        return cls(RecordTable.upload(backend, vertices), (a, b, c))

    def unseparated(self, first: Any, second: Any) -> IntArray:
        """(k, 2) the pairs that are not proved apart, in order."""
        backend = self.points.backend
        names = [[dr.gather(backend.UInt32, k, i) for k in self.corners] for i in (first, second)]
        triangles = [
            tuple(backend.Array3f(*self.points.read_record(name)[:3]) for name in three)
            for three in names
        ]
        shared = [[name == another for another in names[1]] for name in names[0]]
        a, b = cast("tuple[Corners, Corners]", triangles)
        rows = dr.compress(~_are_apart(a, b, shared))
        pairs = [to_numpy(dr.gather(backend.UInt32, i, rows)) for i in (first, second)]
        unsorted = np.stack(pairs, axis=1).astype(np.int64)
        return unsorted[np.lexsort(unsorted.T[::-1])]


def _are_apart(a: Corners, b: Corners, shared: list[list[Mask]]) -> Mask:
    """Whether two triangles have nothing in common but the corners they share, proved.

    shared: whether corner i of a is corner k of b.

    - *A plane*: all corners of one triangle that are not shared lie strictly on one side of the
      other's plane (`_sides`). Points of the first triangle on that plane are then combinations of
      shared corners.
    - *Edges*, where at most one corner is shared: triangles in different planes meet in a segment
      on the line of both planes, whose ends lie on edges that pass through the other triangle.
      None does: each edge without a shared corner has its ends strictly on one side of the other's
      plane, or passes two of its edges on different sides (`_edge_may_pierce`). In one plane all
      these signs are 0, and nothing is proved.
    - *A line*, for triangles in one plane: `_separated_beside_edge`.
    """
    in_a = [shared[i][0] | shared[i][1] | shared[i][2] for i in range(3)]
    in_b = [shared[0][k] | shared[1][k] | shared[2][k] for k in range(3)]
    real = cast("Any", type(a[0].x))
    count: Real = sum((dr.select(first, real(1), real(0)) for first in in_a), real(0))
    of_b, of_a = _sides(a, b), _sides(b, a)
    by_plane = _on_one_side(of_b, in_b) | _on_one_side(of_a, in_a)
    by_plane &= count < 2.5

    def by_edges_or_line(*numbers: Any) -> Mask:
        first, second = cast("tuple[Corners, Corners]", (numbers[:3], numbers[3:6]))
        in_first, in_second, common = list(numbers[6:9]), list(numbers[9:12]), numbers[12]
        passes = _edge_may_pierce(first, second, _sides(first, second), in_second)
        passes |= _edge_may_pierce(second, first, _sides(second, first), in_first)
        turned = (
            _shared_corners_first(first, in_first, common),
            _shared_corners_first(second, in_second, common),
        )
        return ((common < 1.5) & ~passes) | _separated_beside_edge(*turned, common)

    def is_open(*numbers: Any) -> Mask:
        return numbers[12] < 0

    numbers = (*a, *b, *in_a, *in_b, count)
    return by_plane | dr.if_stmt(numbers, ~by_plane, by_edges_or_line, is_open)


def _sides(plane: Corners, of: Corners) -> list[tuple[Mask, Mask]]:
    """For each corner of the triangle `of`, whether it is strictly above the plane of the triangle
    `plane`, and whether strictly below it; neither where rounding leaves it undecided."""
    u, v = plane[1] - plane[0], plane[2] - plane[0]
    normal = dr.cross(u, v)
    error_scale = ROUNDING * dr.norm(u) * dr.norm(v)
    sides: list[tuple[Mask, Mask]] = []
    for corner in of:
        offset = corner - plane[0]
        height, error = dr.dot(normal, offset), error_scale * dr.norm(offset) + _UNDERFLOW
        sides.append((height > error, height < -error))
    return sides


def _on_one_side(sides: list[tuple[Mask, Mask]], shared: list[Mask]) -> Mask:
    above, below = (
        (sides[0][k] | shared[0]) & (sides[1][k] | shared[1]) & (sides[2][k] | shared[2])
        for k in range(2)
    )
    return above | below


def _edge_may_pierce(
    through: Corners, of: Corners, sides: list[tuple[Mask, Mask]], shared: list[Mask]
) -> Mask:
    """Whether an edge of a triangle without shared corners may pass through another: unless both
    ends are strictly on one side of its plane, or the line of the edge has two edges of it on
    different sides of itself."""
    pierces = False
    for i, j in ((0, 1), (1, 2), (2, 0)):
        stays = (sides[i][0] & sides[j][0]) | (sides[i][1] & sides[j][1]) | shared[i] | shared[j]
        direction = of[j] - of[i]
        to = [corner - of[i] for corner in through]
        length, lengths = dr.norm(direction), [dr.norm(offset) for offset in to]
        left, right = False, False
        for k, m in ((0, 1), (1, 2), (2, 0)):
            value = dr.dot(direction, dr.cross(to[k], to[m]))
            error = ROUNDING * length * lengths[k] * lengths[m] + _UNDERFLOW
            left, right = left | (value > error), right | (value < -error)
        pierces = pierces | ~(stays | (left & right))
    return pierces


def _shared_corners_first(of: Corners, shared: list[Mask], count: Real) -> Corners:
    """The corners in another order: shared corners first."""
    once = count < 1.5
    # A single shared corner comes first; with two, the corner that is not shared comes last.
    from_second = dr.select(once, shared[1], ~shared[0])
    from_third = dr.select(once, shared[2], ~shared[1])
    none = count < 0.5
    from_second, from_third = from_second & ~none, from_third & ~none
    return tuple(
        dr.select(from_second, of[(k + 1) % 3], dr.select(from_third, of[(k + 2) % 3], of[k]))
        for k in range(3)
    )  # type: ignore[return-value]


def _separated_beside_edge(a: Corners, b: Corners, count: Real) -> Mask:
    """Whether a plane through an edge, at right angles to its triangle, has the triangles on its
    two sides; shared corners come first.

    m is any vector, and m' = m - (m.e/|e|^2) e, for an edge e, exactly: so m'.e = 0, and m'.x is
    m.x up to |m.e| |x|/|e|, which is rounding if m was made at right angles to e.
    - No shared corner: m.x is less on one triangle than on the other (separating axes).
    - One, the origin: m' < 0 or = 0 on e, < 0 at the other corner of e's triangle and > 0 at both
      corners of the other. Points of both have m' = 0, so of the latter only the origin. Or m < 0
      at both corners of one and m > 0 at those of the other: m along the difference of the
      directions of their middles.
    - Two: e is between them, m' < 0 at the last corner of one, and > 0 at that of the other. Points
      of both have m' = 0: they lie on e.
    """
    none, once = count < 0.5, (count > 0.5) & (count < 1.5)
    twice = (count > 1.5) & (count < 2.5)
    is_beside = False
    for first, second in ((a, b), (b, a)):
        for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            origin = first[i]
            e, x = first[j] - origin, first[k] - origin
            m = dr.fma(e, dr.dot(x, e) / dr.squared_norm(e), -x)
            size, length = dr.norm(m), dr.norm(e)
            dot_error = 1.01 * (dr.abs(dr.dot(m, e)) + ROUNDING * size * length) / length
            rounding = ROUNDING * size + dot_error

            def past(to: Vec3, m: Vec3 = m, rounding: Real = rounding) -> tuple[Mask, Mask]:
                value, error = dr.dot(m, to), rounding * dr.norm(to) + _UNDERFLOW
                return value > error, value < -error

            behind = past(x)[1]
            beyond = [past(corner - origin)[0] for corner in second]
            if i == 0:
                is_beside = is_beside | (once & behind & beyond[1] & beyond[2])
            if (i, j) == (0, 1):
                is_beside = is_beside | (twice & behind & beyond[2])
            # Without a shared corner the edge itself is behind as well: m'.e = 0.
            is_beside = is_beside | (none & behind & beyond[0] & beyond[1] & beyond[2])
    return is_beside | (once & _separated_at_corner(a, b))


def _separated_at_corner(a: Corners, b: Corners) -> Mask:
    """Whether a plane through the first corner, which is that of both, has the others of a and
    those of b on different sides, at right angles to the difference of their mean directions."""
    edges = [corners[k] - corners[0] for corners, k in itertools.product((a, b), (1, 2))]
    mean = [dr.normalize(edges[k]) + dr.normalize(edges[k + 1]) for k in (0, 2)]
    m = dr.normalize(mean[1]) - dr.normalize(mean[0])
    rounding = ROUNDING * dr.norm(m)
    values = [(dr.dot(m, edge), rounding * dr.norm(edge) + _UNDERFLOW) for edge in edges]
    (p, p_error), (q, q_error), (r, r_error), (s, s_error) = values
    return (p < -p_error) & (q < -q_error) & (r > r_error) & (s > s_error)
