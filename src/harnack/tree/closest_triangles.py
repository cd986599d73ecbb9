"""Queries of trees: the boxes that a ray enters, in order, and the triangles closest to a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import clamp, fmax, fmin, max_norm
from harnack.tree.balanced_tree import (
    LoopValues,
    PackedTree,
    VisitedNode,
    build_balanced_tree,
    for_each_primitive,
    pack_tree,
    traverse,
)
from harnack.tree.triangle_tree import (
    INVERSE_SQUARES_COLUMN,
    NO_TRIANGLE,
    NUMBER_COLUMN,
    PARITY_COLUMN,
    TriangleTree,
    corners_of,
    node_boxes,
    normal_of,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

__all__ = ["MAX_BOXES", "NO_BOX", "BoxTree"]

# Boxes are numbered in floats; single precision holds no larger integers without gaps.
MAX_BOXES = 2**24
NO_BOX = 0xFFFFFFFF
# The column of a record that holds the number of its box, behind the box's two corners.
_BOX_NUMBER_COLUMN = 6
_LEAF_SIZE = 4


@dataclass(frozen=True)
class BoxTree:
    """A tree of boxes, which may overlap. Their coordinates are at most about 1."""

    tree: PackedTree

    @classmethod
    def from_corners(cls, backend: Backend, lower: FloatArray, upper: FloatArray) -> BoxTree:
        """The tree of n boxes, from their lower and upper corners, (n, 3) each. Boxes are numbered
        in this order."""
        hierarchy = build_balanced_tree(0.5 * (lower + upper), leaf_size=_LEAF_SIZE)
        number = np.arange(len(lower), dtype=np.float64)[:, None]
        records = hierarchy.values_in_slots(np.concatenate([lower, upper, number], axis=1))
        records[hierarchy.leaf_slots < 0] = [np.inf] * 3 + [-np.inf] * 3 + [-1.0]
        return cls(pack_tree(backend, hierarchy, node_boxes(hierarchy, lower, upper), records))

    def next_box(
        self, o: Vec3, d: Vec3, after: tuple[Real, Any], start: Real, end: Real, active: Mask
    ) -> tuple[Real, Real, Any]:
        """The next box that each ray o + t d, |d| = 1, enters after `after` = (t, number).

        A ray enters a box at t = max(t of the first point of the ray in the box, start), and boxes
        are ordered by (t, number). Boxes that a ray has left before `start` are not entered.
        Starting with after = (t, NO_BOX), t < start, repeated calls visit every box that the ray
        meets for start <= t <= end exactly once. Boxes are enlarged a little, so that rounding
        never skips a box that the ray meets.

        Returns:
            The t where the ray enters the box, the t where it leaves it, and the number of the box
            (NO_BOX if there is none).
        """
        real, index = self.tree.backend.Float, self.tree.backend.UInt32
        t_after, n_after = real(after[0]), index(after[1])
        span = self._slab_test(o, d)

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if the ray meets its box before the best box so far."""
            near, far = span(node.head)
            open_ = (near <= far) & (far >= start) & (near <= fmin(state[0], end))
            return open_, for_each_primitive(node, open_ & node.is_leaf, nearer, state)

        def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """Take the box of a record if it comes after `after` and before the best so far."""
            best, leave, number = state
            near, far = span(row)
            t, n = fmax(near, start), index(fmax(row[_BOX_NUMBER_COLUMN], real(0)))
            later = (t > t_after) | ((t == t_after) & (n > n_after))
            first = (t < best) | ((t == best) & (n < number))
            entered = (near <= far) & (far >= start) & (t <= end) & (row[_BOX_NUMBER_COLUMN] >= 0)
            chosen = active & entered & later & first
            return (
                dr.select(chosen, t, best),
                dr.select(chosen, far, leave),
                dr.select(chosen, n, number),
            )

        begun = (real(dr.inf), real(dr.inf), index(NO_BOX))
        near, far, number = traverse(self.tree, visit, begun, active)
        return near, far, number

    def _slab_test(self, o: Vec3, d: Vec3) -> Any:
        """Make a function that computes at which t rays o + t d enter and leave a box.

        The function takes six numbers, the lower and the upper corner. It returns t slightly too
        small and slightly too large, which covers rounding. Each plane of the box is moved outwards
        by 16 roundings of the size of coordinates, and t is widened by 8 roundings of itself. The
        quotient (x - o)/d has three roundings, and that of x - o is at most half a unit of the last
        place of coordinates. The ray misses the box if the first t is larger than the second."""
        backend = self.tree.backend
        vector = backend.Array3f
        # Never zero: 1e-18 of the boxes' size is far below their padding.
        direction = dr.select(dr.abs(d) < 1e-18, dr.select(d < 0, vector(-1e-18), vector(1e-18)), d)
        inverse = dr.rcp(direction)
        pad = 16 * backend.machine_epsilon * (1 + max_norm(o))

        def interval(box: Any) -> tuple[Real, Real]:
            """The t at which the rays enter the box and leave it."""
            low, high = vector(*box[:3]) - pad, vector(*box[3:6]) + pad
            a, b = (low - o) * inverse, (high - o) * inverse
            near = fmax(fmax(fmin(a.x, b.x), fmin(a.y, b.y)), fmin(a.z, b.z))
            far = fmin(fmin(fmax(a.x, b.x), fmax(a.y, b.y)), fmax(a.z, b.z))
            rounding = 8 * backend.machine_epsilon
            return near - rounding * dr.abs(near), far + rounding * dr.abs(far)

        return interval


# How far rounding may move a distance, in machine epsilons times 1 plus the largest coordinate.
_ROUNDING_EPSILONS = 16.0


@dataclass(frozen=True)
class ClosestTriangle:
    """The triangle nearest to points x, among the triangles that a query considers.

    squared_distance: of the triangle from x; inf where there is no triangle.
    triangle: its index; NO_TRIANGLE where there is none.
    offset: (3,) the vector from x to the nearest point of the triangle.
    normal: (3,) a normal of the triangle by the right-hand rule, of any length; zero for a triangle
        of zero area.
    is_inner: whether the nearest point lies inside the triangle, not on its edges."""

    squared_distance: Real
    triangle: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask


def distance_lower_bound(rays: TriangleTree, x: Vec3) -> Real:
    """A proved lower bound of the distance from x to the triangles, which is exact up to rounding.
    Coordinates of triangles are at most about one.

    Proof. The distance from `ClosestPointOnTriangle` is off by a few machine epsilons of |x| + 1,
    as is proved there. Boxes are skipped only if they are farther than the best distance so far by
    that much. 16 epsilons of |x| + 1 are subtracted, several times the largest error that was found
    with random needles and random triangles."""
    real, vector = rays.tree.backend.Float, rays.tree.backend.Array3f
    x = vector(x)
    pad = _pad(rays, x)
    inside = _distance_test(rays, x, pad)

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box is nearer than the best distance so far."""
        closer = inside(node, state[0])
        return closer, for_each_primitive(node, closer & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """The smaller of the best squared distance so far and that to the triangle of a record."""
        square = ClosestPointOnTriangle.of(row, x).squared_distance
        return (dr.select(active, fmin(square, state[0]), state[0]),)

    start = (initial_squared_distance(rays, x),)
    return fmax(dr.sqrt(traverse(rays.tree, visit, start)[0]) - pad, real(0))


def initial_squared_distance(rays: TriangleTree, x: Vec3) -> Real:
    """An upper bound of the squared distance from x to the triangles, with which a walk can skip
    most boxes from its start. It is the squared distance to a vertex in a nearby leaf, rounded up.
    """
    square, pad = squared_distance_in_nearby_leaf(rays.tree, x, 0), _pad(rays, x)
    return square + 2 * pad * (dr.sqrt(square) + pad)


def squared_distance_in_nearby_leaf(tree: PackedTree, x: Vec3, column: int) -> Real:
    """The smallest squared distance from x to the points of a nearby leaf. It is an upper bound of
    the smallest squared distance to any point of the tree.

    The leaf is found from the root by always going to the child whose box has the nearest center.

    column: the column of a record at which the three coordinates of its point begin."""
    backend = tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    x = vector(x)

    def body(i: Any, end: Any, best: Real, first: Any, after: Any, nearest_leaf: Any) -> LoopValues:
        """Look at node i among its siblings, the last of which is followed by node `end`. After the
        last, go down to the first child of the sibling with the nearest center.

        best: the smallest squared distance of a sibling's center. nearest_leaf: the leaf of that
            sibling, NO_TRIANGLE for an inner node. first, after: its first child, and the node
            after its subtree."""
        head = tree.head(i)
        middle = 0.5 * (vector(*head[:3]) + vector(*head[3:6]))
        square = dr.squared_norm(middle - x)
        nearer, following = square < best, index(head[6])
        best = dr.select(nearer, square, best)
        is_leaf, number = head[7] >= 0, index(dr.abs(head[7]))
        # For the nearest sibling so far: its leaf if it is a leaf, or its first child and the end
        # of its children.
        nearest_leaf = dr.select(nearer, dr.select(is_leaf, number, NO_TRIANGLE), nearest_leaf)
        first = dr.select(nearer, number, first)
        after = dr.select(nearer, following, after)
        is_last = following == end
        down = is_last & (nearest_leaf == NO_TRIANGLE)
        i = dr.select(down, first, following)
        end, best = dr.select(down, after, end), dr.select(down, dr.inf, best)
        return i, end, best, first, after, nearest_leaf

    def is_running(i: Any, end: Any, *state: Any) -> Mask:
        return i != end

    start = (
        index(0), index(tree.node_count), real(dr.inf), index(0), index(0), index(NO_TRIANGLE),
    )  # fmt: skip
    leaf = dr.while_loop(start, is_running, body, label="to a leaf")[5]

    def add(slot: Any, square: Real) -> LoopValues:
        """Take the point in a slot of the leaf into account."""
        row = tree.primitive(leaf, slot, backend.Bool(True))
        point = vector(*row[column : column + 3])
        return slot + 1, fmin(square, dr.squared_norm(point - x))

    def has_slots(slot: Any, square: Real) -> Mask:
        del square
        return slot < tree.leaf_size

    return dr.while_loop((index(0), real(dr.inf)), has_slots, add, label="points of a leaf")[1]


def next_closest_triangle(
    rays: TriangleTree, x: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
) -> ClosestTriangle:
    """The next triangle after `after` that is nearer to x than `limit`, a squared distance.

    Triangles are ordered by (squared distance, number), and `after` is such a pair. Starting with
    (-1, NO_TRIANGLE), repeated calls visit each triangle once."""
    backend = rays.tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    x, limit = vector(x), real(limit)
    square_after, number_after = real(after[0]), index(after[1])
    inside = _distance_test(rays, x, _pad(rays, x))

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box is nearer than the best triangle so far."""
        closer = inside(node, state[0])
        return closer, for_each_primitive(node, closer & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """Take the triangle of a record if it comes after `after` and before the best so far."""
        best, number, offset, normal, is_inner = state
        point = ClosestPointOnTriangle.of(row, x)
        square, n = point.squared_distance, index(fmax(row[NUMBER_COLUMN], real(0)))
        later = (square > square_after) | ((square == square_after) & (n > number_after))
        first = (square < best) | ((square == best) & (n < number))
        chosen = active & later & first & (row[NUMBER_COLUMN] >= 0)
        return (
            dr.select(chosen, square, best),
            dr.select(chosen, n, number),
            dr.select(chosen, point.offset, offset),
            dr.select(chosen, normal_of(row, vector), normal),
            dr.select(chosen, point.is_inner, is_inner),
        )

    start = (limit, index(NO_TRIANGLE), vector(0), vector(0), backend.Bool(False))
    square, number, offset, normal, is_inner = traverse(rays.tree, visit, start, active)
    exists = number != NO_TRIANGLE
    return ClosestTriangle(dr.select(exists, square, dr.inf), number, offset, normal, is_inner)


def _pad(triangles: TriangleTree, x: Vec3) -> Real:
    """A bound of the rounding error of distances from x, a length: see `distance_lower_bound`."""
    return _ROUNDING_EPSILONS * triangles.tree.backend.machine_epsilon * (1 + dr.max(dr.abs(x)))


def _distance_test(triangles: TriangleTree, x: Vec3, pad: Real) -> Any:
    """Make a function that tells whether a node's triangles may be within a distance of x.

    The function takes a node and a squared distance, and returns a mask. It tests the distance from
    the node's box and, if the tree has them, from its slab (`node_slabs`), both widened by the
    length `pad`."""
    vector = triangles.tree.backend.Array3f

    def may_be_within(node: VisitedNode, square: Real) -> Mask:
        """Whether the node's box and slab come within the distance whose square is given."""
        low, high = vector(*node.head[:3]) - pad, vector(*node.head[3:]) + pad
        gap = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
        is_box_near = dr.squared_norm(gap) <= square
        slab = node.payload(is_box_near)
        if not slab:
            return is_box_near
        n, offset, thickness, radius = vector(*slab[:3]), slab[3], slab[4], slab[5]
        relative = x - 0.5 * (low + high)
        height = dr.dot(relative, n)
        radial = dr.norm(dr.fma(vector(-height), n, relative))
        normal_gap = fmax(dr.abs(height - offset) - (thickness + pad), 0)
        radial_gap = fmax(radial - (radius + pad), 0)
        return is_box_near & (dr.fma(normal_gap, normal_gap, radial_gap * radial_gap) <= square)

    return may_be_within


@dataclass(frozen=True)
class ClosestPointOnTriangle:
    """The closest point to x of a record's triangle.

    squared_distance: from x.
    offset: (3,) from x to the point.
    is_inner: whether the point lies inside the triangle, not on its edges.

    It is the closest point of the plane if that lies in the triangle, otherwise the closest point
    of the edges. The closest point of the plane is computed along the longest edge e, from a and of
    length L, and along the altitude h on it, made orthogonal to e twice.

    Proof that the distance is off by only a few epsilons of l = L + |x - a|, however thin the
    triangle (a cross product's direction is off by epsilon L/|h|, which for a needle is an error of
    any size): x - a minus its component along e, removed twice, is right up to epsilon l and
    orthogonal to e up to epsilon^2 l, and so is h, whose direction within the plane normal to e is
    off by d <= epsilon L/|h|. So the point a + alpha e + s h lies off the plane by at most s|h| d
    <= epsilon L, and off the closest point within it by k <= epsilon l + min(d H, |h|), H the
    distance from the plane. That lengthens H by at most k^2/(2H), where k >= epsilon l counts as
    min(d H, |h|)^2/(2H) <= d |h|/2 <= epsilon L/2, and by k <= 3 epsilon l for H < epsilon l. If
    the same k puts the point on the wrong side of an edge, the edges' distance or the plane's is
    off by as much.
    """

    squared_distance: Real
    offset: Vec3
    is_inner: Mask

    @classmethod
    def of(cls, row: list[Real], x: Vec3) -> ClosestPointOnTriangle:
        """The closest point to x of the triangle of a record (`triangle_records`)."""
        vector = cast("Any", type(x))
        p, q, r = (corner - x for corner in corners_of(row, vector))
        first, second, third = row[INVERSE_SQUARES_COLUMN : INVERSE_SQUARES_COLUMN + 3]
        pq, qr, pr = q - p, r - q, r - p
        best, offset = _shortest_vector(
            _closest_on_segment(p, pq, first),
            _closest_on_segment(q, qr, second),
            _closest_on_segment(p, pr, third),
        )
        squares = [dr.squared_norm(edge) for edge in (pq, qr, pr)]
        by_pr = (squares[2] > squares[0]) & (squares[2] >= squares[1])
        by_qr = ~by_pr & (squares[1] > squares[0])

        def chosen(of_pq: Any, of_qr: Any, of_pr: Any) -> Any:
            """The number or vector of the longest edge, of one for each of the edges pq, qr
            and pr."""
            return dr.select(by_pr, of_pr, dr.select(by_qr, of_qr, of_pq))

        a, e, inverse = chosen(p, q, p), chosen(pq, qr, pr), chosen(first, second, third)
        alpha, away = _project_on_edge(-a, e, inverse)
        beta, h = _project_on_edge(chosen(r, p, q) - a, e, inverse)
        s = dr.dot(away, h) / dr.squared_norm(h)  # NaN for a triangle without an area: not inside
        inside = (s >= 0) & (s <= 1) & (alpha >= s * beta) & (1 - alpha >= s * (1 - beta))
        across = dr.fma(vector(s), h, -away)
        square = dr.squared_norm(across)
        inside &= square < best
        return cls(dr.select(inside, square, best), dr.select(inside, across, offset), inside)


def _project_on_edge(v: Vec3, e: Vec3, inverse: Real) -> tuple[Real, Vec3]:
    """The coefficient t and the rest r of v = t e + r, where r is orthogonal to e. The rest is made
    orthogonal twice, so that rounding does not matter even if e is short. inverse: 1/|e|^2."""
    vector = cast("Any", type(v))
    t = dr.dot(v, e) * inverse
    rest = dr.fma(vector(-t), e, v)
    correction = dr.dot(rest, e) * inverse
    return t + correction, dr.fma(vector(-correction), e, rest)


def _closest_on_segment(a: Vec3, e: Vec3, inverse: Real) -> Vec3:
    """The point of the segment from a to a + e that is nearest to the origin. inverse: 1/|e|^2."""
    real, vector = cast("Any", type(inverse)), cast("Any", type(a))
    return dr.fma(vector(clamp(-dr.dot(a, e) * inverse, real(0), real(1))), e, a)


def _shortest_vector(*vectors: Vec3) -> tuple[Real, Vec3]:
    """The squared length of the shortest of some vectors, and this vector."""
    best, *rest = vectors
    square = dr.squared_norm(best)
    for vector in rest:
        other_square = dr.squared_norm(vector)
        best, square = dr.select(other_square < square, vector, best), fmin(other_square, square)
    return square, best


def squared_distance_to_segment(a: Vec3, e: Vec3, inverse: Real) -> Real:
    """The squared distance from the origin to the segment from a to a + e.

    inverse: 1/|e|^2; any finite number if e = 0."""
    return dr.squared_norm(_closest_on_segment(a, e, inverse))


def jump_sum_within(rays: TriangleTree, x: Vec3, distance: Real, active: Mask = True) -> Real:
    """The sum of the absolute values of the jumps of the winding number across the triangles that
    are within `distance` of x."""
    real, vector = rays.tree.backend.Float, rays.tree.backend.Array3f
    x, distance = vector(x), real(distance)
    reach, inside = distance * distance, _distance_test(rays, x, distance)

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box comes within the distance."""
        close = inside(node, reach)
        return close, for_each_primitive(node, close & node.is_leaf, add, state)

    def add(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """Add the jump across the triangle of a record, if it is within the distance."""
        within = (
            active
            & (row[NUMBER_COLUMN] >= 0)
            & (ClosestPointOnTriangle.of(row, x).squared_distance <= reach)
        )
        return (state[0] + dr.select(within, dr.abs(row[PARITY_COLUMN]), 0),)

    return traverse(rays.tree, visit, (real(0),), active)[0]
