"""Searches in trees: the boxes that a ray enters, in order, and the triangles closest to a point. A
*node* of a tree has a box around all that is below it, so that a search skips a node whose box is
too far. A *record* (`row` in the code) is the row of numbers that describes one box or one
triangle. A *lane* is one entry of Dr.Jit's arrays, such as a point or a ray; each lane searches by
itself."""

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
    """A tree, on a backend, of boxes that may overlap, with a search for the boxes that a ray
    enters. The coordinates of the boxes are at most about 1."""

    tree: PackedTree

    @classmethod
    def from_corners(cls, backend: Backend, lower: FloatArray, upper: FloatArray) -> BoxTree:
        """Build the tree of n boxes from their lower and upper corners, (n, 3) each. Boxes are
        numbered in this order."""
        hierarchy = build_balanced_tree(0.5 * (lower + upper), leaf_size=_LEAF_SIZE)
        number = np.arange(len(lower), dtype=np.float64)[:, None]
        records = hierarchy.values_in_slots(np.concatenate([lower, upper, number], axis=1))
        # Empty slots hold an empty box, with the number -1.
        records[hierarchy.leaf_slots < 0] = [np.inf] * 3 + [-np.inf] * 3 + [-1.0]
        return cls(pack_tree(backend, hierarchy, node_boxes(hierarchy, lower, upper), records))

    def next_box(
        self, o: Vec3, d: Vec3, after: tuple[Real, Any], start: Real, end: Real, active: Mask
    ) -> tuple[Real, Real, Any]:
        """Find, on active lanes, the next box that each ray o + t d, |d| = 1, enters. Boxes are
        ordered by the pair (t of entering, number of the box); the next box is the first one after
        the pair `after`. Boxes are enlarged a little, so that rounding never skips a box that the
        ray meets.

        o, d: origin and direction of each ray.
        after: (t, number of a box), the pair after which the search begins.
        start, end: only the part start <= t <= end of each ray counts. A ray that is in a box at t
            = start enters this box at `start`.
        active: the mask of the lanes that search.

        Repeated calls, the first with after = (t, NO_BOX) for any t < start, visit every box that
        the ray meets for start <= t <= end exactly once.

        Returns:
            The t where the ray enters the box, the t where it leaves it, and the number of the box
            (NO_BOX if there is none).
        """
        real, index = self.tree.backend.Float, self.tree.backend.UInt32
        t_after, n_after = real(after[0]), index(after[1])
        # A function from a box to the t where the ray enters it and leaves it.
        enter_and_leave = self._make_slab_test(o, d)

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if the ray meets its box before the best box so far. state: the best box
            so far (the t where the ray enters and leaves it, and its number). Returns the mask of
            lanes that enter the node, and the state, which the boxes of a leaf have updated."""
            near, far = enter_and_leave(node.head)
            is_met = (near <= far) & (far >= start) & (near <= fmin(state[0], end))
            return is_met, for_each_primitive(node, is_met & node.is_leaf, nearer, state)

        def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """The new state: the box in the record `row` if the ray enters it between `start` and
            `end`, after the pair `after` of the enclosing function (split into `t_after` and
            `n_after`), and before the best box so far, which is `state`; otherwise `state`."""
            best, leave, number = state
            near, far = enter_and_leave(row)
            # The number -1 of an empty slot is no index; such a slot is never chosen.
            t, n = fmax(near, start), index(fmax(row[_BOX_NUMBER_COLUMN], real(0)))
            is_after = (t > t_after) | ((t == t_after) & (n > n_after))
            is_before_best = (t < best) | ((t == best) & (n < number))
            is_entered = (
                (near <= far) & (far >= start) & (t <= end) & (row[_BOX_NUMBER_COLUMN] >= 0)
            )
            is_chosen = active & is_entered & is_after & is_before_best
            return (
                dr.select(is_chosen, t, best),
                dr.select(is_chosen, far, leave),
                dr.select(is_chosen, n, number),
            )

        # The best box so far: where the ray enters and leaves it, and its number.
        initial = (real(dr.inf), real(dr.inf), index(NO_BOX))
        near, far, number = traverse(self.tree, visit, initial, active)
        return near, far, number

    def _make_slab_test(self, o: Vec3, d: Vec3) -> Any:
        """Make a function that computes where rays o + t d enter and leave a box.

        The function takes the six numbers of the box, lower corner first, and returns two t. The
        ray misses the box if the first is larger than the second. The first is rounded down and the
        second up, so that rounding never loses a hit.

        Rounding. With u the machine epsilon and S = 1 + the largest coordinate of o in magnitude,
        each plane of the box, at the coordinate x, is moved outwards by 16 u S. That exceeds the
        error of x - o. Each t is moved by 8 u |t|, which exceeds the error of the three operations
        in (x - o)/d.
        """
        backend = self.tree.backend
        vector = backend.Array3f
        # Never zero: 1e-18 of the boxes' size is far below their padding.
        direction = dr.select(dr.abs(d) < 1e-18, dr.select(d < 0, vector(-1e-18), vector(1e-18)), d)
        inverse = dr.rcp(direction)
        pad = 16 * backend.machine_epsilon * (1 + max_norm(o))

        def interval(box: Any) -> tuple[Real, Real]:
            """The t at which the rays enter the box, enlarged by the length `pad`, and the t at
            which they leave it. box: its six numbers, lower corner first."""
            low, high = vector(*box[:3]) - pad, vector(*box[3:6]) + pad
            # `inverse` is one over the rays' direction, for each coordinate.
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
    """The result of a search, for each lane: the triangle nearest to its point x, among the
    triangles that the search considers.

    squared_distance: the squared distance of the triangle from x; inf if there is no triangle.
    triangle: its index; NO_TRIANGLE if there is none.
    offset: (3,) the vector from x to the nearest point of the triangle.
    normal: (3,) a normal of the triangle by the right-hand rule, of any length; zero for a triangle
        of zero area.
    is_inner: whether the nearest point lies inside the triangle, not on its edges.
    """

    squared_distance: Real
    triangle: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask


def distance_lower_bound(triangles: TriangleTree, x: Vec3) -> Real:
    """A proved lower bound of the distance from points x to the triangles of a tree; it is exact up
    to rounding. Coordinates of triangles are at most about one.

    Proof. The distance computed by `ClosestPointOnTriangle` is off by a few machine epsilons of |x|
    + 1, as is proved there. Boxes of the tree are skipped only if they are farther than the
    smallest distance so far by that much. So 16 epsilons of |x| + 1 are subtracted. That is several
    times the largest error that was observed for random needles and random triangles.
    """
    real, vector = triangles.tree.backend.Float, triangles.tree.backend.Array3f
    x = vector(x)
    pad = _distance_rounding(triangles, x)
    may_be_within = _distance_test(triangles, x, pad)

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box is nearer than the best distance so far. state: the best squared
        distance so far. Returns the mask of lanes that enter the node, and the state, which the
        triangles of a leaf have updated."""
        is_near = may_be_within(node, state[0])
        return is_near, for_each_primitive(node, is_near & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """The new state: the smaller of `state`, the best squared distance so far, and the squared
        distance of the triangle in the record `row`."""
        square = ClosestPointOnTriangle.of(row, x).squared_distance
        return (dr.select(active, fmin(square, state[0]), state[0]),)

    # The state is the smallest squared distance so far.
    start = (initial_squared_distance(triangles, x),)
    return fmax(dr.sqrt(traverse(triangles.tree, visit, start)[0]) - pad, real(0))


def initial_squared_distance(triangles: TriangleTree, x: Vec3) -> Real:
    """An upper bound of the squared distance from points x to the triangles of a tree. A search
    that starts with it skips most boxes at once. It is the squared distance to a corner of a
    triangle in a nearby leaf, rounded up."""
    # Column 0: the first corner of a triangle.
    square, pad = (
        squared_distance_in_nearby_leaf(triangles.tree, x, 0),
        _distance_rounding(triangles, x),
    )
    # More than (sqrt(square) + pad)^2.
    return square + 2 * pad * (dr.sqrt(square) + pad)


def squared_distance_in_nearby_leaf(tree: PackedTree, x: Vec3, column: int) -> Real:
    """An upper bound of the smallest squared distance from x to the points of a tree: the smallest
    squared distance to the points of one leaf nearby. The leaf is found from the root by always
    going to the child whose box has the nearest center.

    column: the column of a record at which the three coordinates of its point begin.
    """
    backend = tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    x = vector(x)

    def body(i: Any, end: Any, best: Real, first: Any, after: Any, nearest_leaf: Any) -> LoopValues:
        """Compare the center of node i's box with the nearest center among its siblings so far.
        After the last sibling, go down to the first child of the sibling with the nearest center.

        i, end: the node, and the node after its last sibling.
        best: the smallest squared distance of a sibling's center so far.
        nearest_leaf: the leaf of that sibling, NO_TRIANGLE for an inner node.
        first, after: the first child of that sibling, and the node after its subtree.

        Returns the new values of the parameters, where i is the next node.
        """
        head = tree.head(i)
        middle = 0.5 * (vector(*head[:3]) + vector(*head[3:6]))
        square = dr.squared_norm(middle - x)
        # head[6]: the node after the subtree. head[7]: the number of the leaf, or minus the first
        # child.
        is_nearer, following = square < best, index(head[6])
        best = dr.select(is_nearer, square, best)
        # The index of the leaf, or of the first child.
        is_leaf, number = head[7] >= 0, index(dr.abs(head[7]))
        # For the nearest sibling so far: its leaf if it is a leaf, or its first child and the end
        # of its children.
        nearest_leaf = dr.select(is_nearer, dr.select(is_leaf, number, NO_TRIANGLE), nearest_leaf)
        first = dr.select(is_nearer, number, first)
        after = dr.select(is_nearer, following, after)
        is_last = following == end
        goes_down = is_last & (nearest_leaf == NO_TRIANGLE)
        i = dr.select(goes_down, first, following)
        end, best = dr.select(goes_down, after, end), dr.select(goes_down, dr.inf, best)
        return i, end, best, first, after, nearest_leaf

    def is_running(i: Any, end: Any, *state: Any) -> Mask:
        """Whether a lane still has siblings to compare. It has none left, i = `end`, only when it
        has found a leaf: from the last sibling `body` otherwise goes down to children."""
        return i != end

    start = (
        index(0), index(tree.node_count), real(dr.inf), index(0), index(0), index(NO_TRIANGLE),
    )  # fmt: skip
    # Entry 5 of the state is the leaf.
    leaf = dr.while_loop(start, is_running, body, label="to a leaf")[5]

    def add(slot: Any, square: Real) -> LoopValues:
        """Update `square`, the smallest squared distance so far, by that of the point in a slot of
        the leaf. Returns the next slot and the new `square`."""
        row = tree.primitive(leaf, slot, backend.Bool(True))
        point = vector(*row[column : column + 3])
        return slot + 1, fmin(square, dr.squared_norm(point - x))

    def has_slots(slot: Any, square: Real) -> Mask:
        """Whether the leaf has further slots; `square` is not used."""
        del square
        return slot < tree.leaf_size

    # The state is the slot and the smallest squared distance.
    return dr.while_loop((index(0), real(dr.inf)), has_slots, add, label="points of a leaf")[1]


def next_closest_triangle(
    triangles: TriangleTree, x: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
) -> ClosestTriangle:
    """Find the next of the triangles in the order of distance from points x: the first one that
    comes after the pair `after`, if its squared distance from x is at most `limit`. Only active
    lanes search.

    Triangles are ordered by squared distance from x, and at equal distances by number; `after` is a
    squared distance and a number. Repeated calls, the first with (-1, NO_TRIANGLE), return each
    triangle within the limit once. If there is no further triangle, the result's `triangle` is
    NO_TRIANGLE.
    """
    backend = triangles.tree.backend
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    x, limit = vector(x), real(limit)
    square_after, number_after = real(after[0]), index(after[1])
    may_be_within = _distance_test(triangles, x, _distance_rounding(triangles, x))

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box is nearer than the best triangle so far. state: the best triangle
        so far (squared distance, number, and what `ClosestTriangle` holds besides). Returns the
        mask of lanes that enter the node, and the state, which the triangles of a leaf have
        updated."""
        is_near = may_be_within(node, state[0])
        return is_near, for_each_primitive(node, is_near & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """The new state: the triangle in the record `row` if it comes after the pair `after` of the
        enclosing function (split into `square_after` and `number_after`) and before the best
        triangle so far, which is `state`; otherwise `state`."""
        best, number, offset, normal, is_inner = state
        point = ClosestPointOnTriangle.of(row, x)
        # The number -1 of an empty slot is no index; such a slot is never chosen.
        square, n = point.squared_distance, index(fmax(row[NUMBER_COLUMN], real(0)))
        is_after = (square > square_after) | ((square == square_after) & (n > number_after))
        is_before_best = (square < best) | ((square == best) & (n < number))
        is_chosen = active & is_after & is_before_best & (row[NUMBER_COLUMN] >= 0)
        return (
            dr.select(is_chosen, square, best),
            dr.select(is_chosen, n, number),
            dr.select(is_chosen, point.offset, offset),
            dr.select(is_chosen, normal_of(row, vector), normal),
            dr.select(is_chosen, point.is_inner, is_inner),
        )

    # The best triangle so far: squared distance, number, offset, normal, and `is_inner`.
    start = (limit, index(NO_TRIANGLE), vector(0), vector(0), backend.Bool(False))
    square, number, offset, normal, is_inner = traverse(triangles.tree, visit, start, active)
    exists = number != NO_TRIANGLE
    return ClosestTriangle(dr.select(exists, square, dr.inf), number, offset, normal, is_inner)


def _distance_rounding(triangles: TriangleTree, x: Vec3) -> Real:
    """A bound of the rounding error of computed distances from points x to triangles: a length, 16
    machine epsilons times 1 plus the largest coordinate of x in magnitude (`distance_lower_bound`).
    """
    return _ROUNDING_EPSILONS * triangles.tree.backend.machine_epsilon * (1 + dr.max(dr.abs(x)))


def _distance_test(triangles: TriangleTree, x: Vec3, pad: Real) -> Any:
    """Make a function that tells whether a node's triangles may be within a distance of x.

    The function takes a node and a squared distance, and returns a mask: False only where all
    triangles of the node are proved to be farther from x. It tests the distance of x from the
    node's bounding box and, if the tree has slabs, from the node's slab (a flat cylinder around its
    triangles, see `node_slabs`). Box and slab are enlarged by the length `pad`.
    """
    vector = triangles.tree.backend.Array3f

    def may_be_within(node: VisitedNode, square: Real) -> Mask:
        """Whether the node's box and slab, enlarged by the length `pad` of `_distance_test`, come
        within the distance sqrt(square) of x."""
        low, high = vector(*node.head[:3]) - pad, vector(*node.head[3:]) + pad
        # The vector from x to the box, up to signs.
        gap = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
        is_box_near = dr.squared_norm(gap) <= square
        slab = node.payload(is_box_near)
        if not slab:
            return is_box_near
        n, offset, thickness, radius = vector(*slab[:3]), slab[3], slab[4], slab[5]
        # x relative to the center of the box, along the slab's normal and across it.
        relative = x - 0.5 * (low + high)
        height = dr.dot(relative, n)
        radial = dr.norm(dr.fma(vector(-height), n, relative))
        normal_gap = fmax(dr.abs(height - offset) - (thickness + pad), 0)
        radial_gap = fmax(radial - (radius + pad), 0)
        return is_box_near & (dr.fma(normal_gap, normal_gap, radial_gap * radial_gap) <= square)

    return may_be_within


@dataclass(frozen=True)
class ClosestPointOnTriangle:
    """The point of a triangle that is closest to a point x.

    squared_distance: the squared distance of that point from x.
    offset: (3,) the vector from x to that point.
    is_inner: whether the point lies inside the triangle, not on its edges.

    It is the closest point of the triangle's plane if that point lies in the triangle, otherwise
    the closest point of the edges. The closest point of the plane is computed as a + alpha e + s h:
    a and e are the start and the vector of the longest edge, L is its length, and h is the altitude
    on e, from which the component along e is removed twice.

    Proof that the distance is off by only a few machine epsilons of l = L + |x - a|, however thin
    the triangle. (A normal from a cross product would be off by epsilon L/|h|, which is large for a
    needle.) The vector x - a minus its component along e, removed twice, is right up to epsilon l
    and orthogonal to e up to epsilon^2 l. The same holds for h, so its direction within the plane
    normal to e is off by an angle d <= epsilon L/|h|. So the computed point, with 0 <= s <= 1, lies
    off the plane by at most s |h| d <= epsilon L. Within the plane it is off the closest point by k
    <= epsilon l + min(d H, |h|), with H the distance of x from the plane. An offset k lengthens H
    by at most k^2/(2H). The part min(d H, |h|) of k contributes min(d H, |h|)^2/(2H) <= d |h|/2 <=
    epsilon L/2. For H < epsilon l the distance grows by at most k <= 3 epsilon l. If the same k
    puts the point on the wrong side of an edge, the distance from the edges is taken for the
    distance from the plane or the reverse; the two differ by as little.
    """

    squared_distance: Real
    offset: Vec3
    is_inner: Mask

    @classmethod
    def of(cls, row: list[Real], x: Vec3) -> ClosestPointOnTriangle:
        """Find the point of the triangle in the record `row` (`triangle_records`) that is closest
        to x."""
        vector = cast("Any", type(x))
        # x is the origin. The closest point of the edges comes first.
        p, q, r = (corner - x for corner in corners_of(row, vector))
        inverse_pq, inverse_qr, inverse_pr = row[
            INVERSE_SQUARES_COLUMN : INVERSE_SQUARES_COLUMN + 3
        ]
        pq, qr, pr = q - p, r - q, r - p
        best, offset = _shortest_vector(
            _closest_on_segment(p, pq, inverse_pq),
            _closest_on_segment(q, qr, inverse_qr),
            _closest_on_segment(p, pr, inverse_pr),
        )
        squares = [dr.squared_norm(edge) for edge in (pq, qr, pr)]
        is_pr_longest = (squares[2] > squares[0]) & (squares[2] >= squares[1])
        is_qr_longest = ~is_pr_longest & (squares[1] > squares[0])

        def of_longest(of_pq: Any, of_qr: Any, of_pr: Any) -> Any:
            """Select, from three numbers or vectors that belong to the edges pq (`of_pq`), qr
            (`of_qr`) and pr (`of_pr`), the one of the longest edge."""
            return dr.select(is_pr_longest, of_pr, dr.select(is_qr_longest, of_qr, of_pq))

        a, e, inverse = (
            of_longest(p, q, p),
            of_longest(pq, qr, pr),
            of_longest(inverse_pq, inverse_qr, inverse_pr),
        )
        # x is a + alpha e + away, and the corner opposite to the edge a + beta e + h.
        alpha, away = _project_on_edge(-a, e, inverse)
        beta, h = _project_on_edge(of_longest(r, p, q) - a, e, inverse)
        s = dr.dot(away, h) / dr.squared_norm(h)  # NaN for a triangle without an area: not inside
        # s: how high x is projected, as a fraction of the triangle's height. There, the triangle
        # reaches along the edge from s beta to 1 - s (1 - beta).
        is_inside = (s >= 0) & (s <= 1) & (alpha >= s * beta) & (1 - alpha >= s * (1 - beta))
        # From x to the closest point of the plane.
        across = dr.fma(vector(s), h, -away)
        square = dr.squared_norm(across)
        is_inside &= square < best
        return cls(
            dr.select(is_inside, square, best), dr.select(is_inside, across, offset), is_inside
        )


def _project_on_edge(v: Vec3, e: Vec3, inverse: Real) -> tuple[Real, Vec3]:
    """Split v = t e + r, where r is orthogonal to e. Returns t and r. The component along e is
    removed twice, so that r is orthogonal to e despite rounding, even if e is short. inverse:
    1/|e|^2."""
    vector = cast("Any", type(v))
    t = dr.dot(v, e) * inverse
    rest = dr.fma(vector(-t), e, v)
    correction = dr.dot(rest, e) * inverse
    return t + correction, dr.fma(vector(-correction), e, rest)


def _closest_on_segment(a: Vec3, e: Vec3, inverse: Real) -> Vec3:
    """The point of the segment from a to a + e that is nearest to the origin. inverse: 1/|e|^2; any
    finite number if e = 0."""
    real, vector = cast("Any", type(inverse)), cast("Any", type(a))
    return dr.fma(vector(clamp(-dr.dot(a, e) * inverse, real(0), real(1))), e, a)


def _shortest_vector(*vectors: Vec3) -> tuple[Real, Vec3]:
    """The shortest of the vectors: returns its squared length and the vector itself."""
    best, *rest = vectors
    square = dr.squared_norm(best)
    for vector in rest:
        other_square = dr.squared_norm(vector)
        best, square = dr.select(other_square < square, vector, best), fmin(other_square, square)
    return square, best


def squared_distance_to_segment(a: Vec3, e: Vec3, inverse: Real) -> Real:
    """The squared distance from the origin to the segment from a to a + e.

    inverse: 1/|e|^2; any finite number if e = 0.
    """
    return dr.squared_norm(_closest_on_segment(a, e, inverse))


def jump_sum_within(triangles: TriangleTree, x: Vec3, distance: Real, active: Mask = True) -> Real:
    """The sum of |jump| over all triangles within `distance` of points x. The jump is the change of
    the winding number across a triangle. |jump| is the absolute value of the number in the column
    `PARITY_COLUMN` of the triangle's record. It is counted on active lanes only."""
    real, vector = triangles.tree.backend.Float, triangles.tree.backend.Array3f
    x, distance = vector(x), real(distance)
    # The test enlarges boxes by a length, here `distance` itself, which is more than rounding.
    square, may_be_within = distance * distance, _distance_test(triangles, x, distance)

    def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
        """Enter a node if its box comes within `distance` of x. state: the sum so far. Returns the
        mask of lanes that enter the node, and the state, to which the triangles of a leaf have been
        added."""
        is_near = may_be_within(node, square)
        return is_near, for_each_primitive(node, is_near & node.is_leaf, add, state)

    def add(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
        """The new state: the sum so far, `state`, plus |jump| of the triangle in the record `row`,
        if its distance from x is at most `distance`."""
        # `square` is the square of `distance`.
        is_within = (
            active
            & (row[NUMBER_COLUMN] >= 0)
            & (ClosestPointOnTriangle.of(row, x).squared_distance <= square)
        )
        return (state[0] + dr.select(is_within, dr.abs(row[PARITY_COLUMN]), 0),)

    return traverse(triangles.tree, visit, (real(0),), active)[0]
