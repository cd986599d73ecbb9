"""Triangles as records of a tree, and their crossings with rays. A *record* is a row of numbers
that kernels read; `row` is the record of one triangle: its corners, the *parity* (1, or -1 if the
record reverses the face), the number of the triangle, and 1/length^2 of its edges. The *sign* of a
crossing is 1 if the triangle's normal points along the ray, else -1. A ray is o + t d with |d| = 1,
and t is the *depth* along it. A *lane* is one entry of Dr.Jit's arrays, such as a ray.

A record (16 numbers with padding) contains the corners in the order of their vertices' indices, so
that an edge shared by two triangles has the same two ends in the same order in both: every decision
about the edge is the same for both, to the last bit, so that no ray slips through between them or
crosses both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.elementary import clamp, fmax, fmin, max_norm, orthonormal_basis
from harnack.tree.balanced_tree import (
    BalancedTree,
    LoopValues,
    PackedTree,
    VisitedNode,
    for_each_primitive,
    pack_tree,
    traverse,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

    # The coordinates of a point: (u, v) across a ray, and the depth along it.
    RayCoordinates: TypeAlias = tuple[Real, Real, Real]

# Columns of a record; 0 to 8 are the corners.
PARITY_COLUMN, NUMBER_COLUMN, INVERSE_SQUARES_COLUMN = 9, 10, 11
# A ray passes through an edge if its distance from the edge is at most this many machine epsilons
# times 1 plus the largest coordinate.
_EDGE_ROUNDINGS = 4.0
# Whether a crossing is before or behind the end of a line is not certain if the crossing is within
# this number of roundings of the end.
_UNCERTAIN_ROUNDINGS = 64.0
# Triangles are numbered in floats; single precision holds no larger integers without gaps.
MAX_TRIANGLES = 2**24
NO_TRIANGLE = 0xFFFFFFFF


def triangle_records(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """The records (m, 14) of the triangles `faces` (m, 3): for each triangle the row of numbers by
    which a tree describes it to kernels.

    A record has the corners (9 numbers), ordered by the indices of their vertices; +1, or -1 if
    that order reverses the face; the index of the face; and 1/length^2 of the edges between corners
    0 and 1, 1 and 2, and 0 and 2 (0 for an edge without a length).
    """
    order = np.argsort(faces, axis=1, kind="stable")
    corners = vertices[np.take_along_axis(faces, order, axis=1)]
    # Orders that keep the orientation of the face.
    is_even = np.isin(order @ np.array([9, 3, 1]), (5, 15, 19))  # 012, 120, 201 in base three
    edges = corners[:, [1, 2, 2]] - corners[:, [0, 1, 0]]
    square = (edges * edges).sum(axis=2)
    inverse = np.where(square > 0, 1 / np.where(square > 0, square, 1), 0)
    parity = np.where(is_even, 1.0, -1.0)[:, None]
    number = np.arange(len(faces), dtype=np.float64)[:, None]
    return np.concatenate([corners.reshape(-1, 9), parity, number, inverse], axis=1)


def records_in_slots(tree: BalancedTree, records: FloatArray) -> FloatArray:
    """Arrange records (m, c) of triangles by the slots of a tree: (leaves, leaf_size, c). An empty
    slot gets a triangle without an area, at the first corner of the leaf, with the number -1."""
    placed = tree.values_in_slots(records)
    is_empty = tree.leaf_slots < 0
    # Three times the first corner of each leaf's first triangle.
    first_corners = np.tile(placed[:, 0, :3], 3)
    placed[is_empty, :9] = np.broadcast_to(first_corners[:, None], (*is_empty.shape, 9))[is_empty]
    placed[is_empty, PARITY_COLUMN], placed[is_empty, NUMBER_COLUMN] = 1.0, -1.0
    placed[is_empty, INVERSE_SQUARES_COLUMN : INVERSE_SQUARES_COLUMN + 3] = 0.0
    return placed


def node_boxes(tree: BalancedTree, low: FloatArray, high: FloatArray) -> list[FloatArray]:
    """Bounding boxes of the nodes of a tree, from the corners `low` and `high` (n, 3) of the boxes
    of its n primitives. Returns an array (k, 6) for each level of the tree, leaves first: lower and
    upper corner of each node's box."""
    low, high = (
        tree.values_in_slots(low, np.inf).min(axis=1),
        tree.values_in_slots(high, -np.inf).max(axis=1),
    )
    levels = [np.concatenate([low, high], axis=1)]
    for arity in tree.arities:
        low = low.reshape(-1, arity, 3).min(axis=1)
        high = high.reshape(-1, arity, 3).max(axis=1)
        levels.append(np.concatenate([low, high], axis=1))
    return levels


def node_slabs(
    tree: BalancedTree, corners: FloatArray, boxes: list[FloatArray]
) -> list[FloatArray]:
    """A slab for each node of a tree: a flat cylinder that contains the node's triangles. Returns
    an array (k, 6) for each level of the tree, leaves first.

    corners: (n, 3, 3) the corners of the triangles.
    boxes: the bounding boxes of the nodes (`node_boxes`).

    A slab has six numbers: a unit normal n, an offset, half a thickness and a radius. With c the
    center of the node's box, each point of its triangles is c + h n + r, where r is orthogonal to
    n, |h - offset| <= half the thickness and |r| <= radius. The normal is that of the sum of the
    triangles' normals; it is (0, 0, 1) if the sum is 0.

    A piece of a smooth surface is much thinner than its bounding box. With boxes alone, a search
    for the triangle nearest to a far point would visit the whole cap of the surface whose depth is
    less than the width of a box.
    """
    # Empty slots have NaN corners, which `nanmin` and `nanmax` leave out.
    points = tree.values_in_slots(corners, np.nan).reshape(len(tree.leaf_slots), -1, 3)
    edges = corners - corners[:, :1]
    normals = tree.values_in_slots(np.cross(edges[:, 1], edges[:, 2])).sum(axis=1)
    levels: list[FloatArray] = []
    # The last arity, 1, is that of no level: above the root nothing is summed.
    for box, arity in zip(boxes, (*tree.arities, 1), strict=True):
        # The sum of the normals, scaled to length 1; it stays near 0 if the sum is 0 or tiny.
        n = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        n[~(np.linalg.norm(n, axis=1) > 0.5)] = (0.0, 0.0, 1.0)
        # Offsets of all corners below each node from its center: h along n, and |r|^2 across.
        offset = points.reshape(len(n), -1, 3) - 0.5 * (box[:, None, :3] + box[:, None, 3:])
        height = (offset @ n[:, :, None])[..., 0]
        low, high = np.nanmin(height, axis=1), np.nanmax(height, axis=1)
        square = np.einsum("nij,nij->ni", offset, offset) - height * height
        # A little larger, against rounding.
        radius = np.sqrt(np.maximum(np.nanmax(square, axis=1), 0)) * (1 + 1e-6) + 1e-7
        levels.append(np.column_stack([n, 0.5 * (low + high), 0.5 * (high - low), radius]))
        normals = normals.reshape(-1, arity, 3).sum(axis=1)
    return levels


@dataclass(frozen=True)
class RayFrame:
    """Orthonormal coordinates of rays o + t d, one frame for each ray: u and v across the ray, and
    the depth t along it. The unit vectors u, v and d are orthogonal and right-handed."""

    o: Vec3
    u: Vec3
    v: Vec3
    d: Vec3

    @classmethod
    def along(cls, backend: Backend, o: Vec3, d: Vec3) -> RayFrame:
        """The frame of rays o + t d, where |d| = 1."""
        vector = backend.Array3f
        o, d = vector(o), vector(d)
        u, v = orthonormal_basis(d)
        return cls(o, u, v, d)

    def transverse(self, p: Vec3) -> tuple[Real, Real]:
        """The coordinates (u, v) of p in the plane across the ray; the ray itself is at (0, 0)."""
        a = p - self.o
        return _flush_tiny(dr.dot(a, self.u)), _flush_tiny(dr.dot(a, self.v))

    def depth(self, p: Vec3) -> Real:
        """The t of the point o + t d of the ray that is nearest to p."""
        return dr.dot(p - self.o, self.d)

    def component(self, a: Vec3) -> Real:
        """The component of a vector a along the ray."""
        return dr.dot(a, self.d)


@dataclass(frozen=True)
class VerticalRayFrame:
    """The coordinates of rays from points o along the z axis, with the methods of `RayFrame` but
    almost no computation: x and y across the ray, and the depth z along it."""

    o: Vec3

    def transverse(self, p: Vec3) -> tuple[Real, Real]:
        """The coordinates (x, y) of p relative to the ray: the x and the y axis take the place of u
        and v."""
        return _flush_tiny(p.x - self.o.x), _flush_tiny(p.y - self.o.y)

    def depth(self, p: Vec3) -> Real:
        """The t of the point o + t (0, 0, 1) of the ray that is nearest to p."""
        return p.z - self.o.z

    def component(self, a: Vec3) -> Real:
        """The component of a vector a along the z axis."""
        return a.z


def _flush_tiny(coordinate: Real) -> Real:
    """A coordinate across a ray, or 0 if it is so small that a product of two could underflow. Such
    a coordinate is far smaller than the rounding error of a vertex."""
    is_double = dr.type_v(type(coordinate)) == dr.VarType.Float64
    return dr.select(dr.abs(coordinate) < (1e-140 if is_double else 1e-16), 0, coordinate)


def edge_function(a: tuple[Real, Real], b: tuple[Real, Real]) -> Real:
    """Twice the signed area of the triangle with the corners (0, 0), a and b. Its sign says on
    which side of the edge from a to b the ray passes.

    a, b: the coordinates (u, v) of the edge's ends across the ray, which is at (0, 0).

    For all triangles at the edge the result has the same bits, if a and b come in the same order.
    """
    return dr.fma(a[0], b[1], -(a[1] * b[0]))


@dataclass(frozen=True)
class TriangleTree:
    """A tree of bounding boxes over triangles on a backend, with methods that find the crossings of
    rays with the triangles. Coordinates of triangles are at most about 1. The sign of a crossing is
    1 if the triangle's normal points along the ray, else -1."""

    tree: PackedTree

    @classmethod
    def of(
        cls, backend: Backend, tree: BalancedTree, records: FloatArray, *, slabs: bool = False
    ) -> TriangleTree:
        """Build the tree on a backend.

        tree: which triangle lies in which leaf.
        records: the records of the triangles, from `triangle_records`.
        slabs: whether nodes have slabs (flat cylinders around their triangles, see `node_slabs`)
            besides boxes. They make searches for the closest triangle of a far point faster.
        """
        corners = records[:, :9].reshape(-1, 3, 3)
        levels = node_boxes(tree, corners.min(axis=1), corners.max(axis=1))
        if slabs:
            pairs = zip(levels, node_slabs(tree, corners, levels), strict=True)
            levels = [np.concatenate(pair, axis=1) for pair in pairs]
        return cls(pack_tree(backend, tree, levels, records_in_slots(tree, records)))

    def next_crossing(
        self,
        frame: RayFrame,
        after: tuple[Real, Any],
        t_max: Real,
        active: Mask,
        reach: float = 0.0,
    ) -> tuple[Real, Any, Real, Vec3]:
        """The first crossing of each ray with a triangle that comes after the crossing `after` and
        has t <= t_max.

        frame: the rays.
        after: (t, number of a triangle). Crossings are ordered by t, and at the same t by the
            number of the triangle. With the number NO_TRIANGLE, all crossings at exactly this t are
            skipped.
        active: the mask of the rays that are searched.
        reach: a length. If it is more than 0, a triangle counts as crossed too if its border is
            within this distance of the ray; but not if its border is that close to an end of the
            ray, t = 0 or t_max.

        Returns:
            t (inf if there is none); the number of the triangle (NO_TRIANGLE if there is none); the
            sign of the crossing; and the unit normal of the triangle by the right-hand rule. The
            sign is 1 if the normal points along the ray, and -1 if it points back. It is 0 if there
            is no crossing, or if only the border of the triangle is within `reach` of the ray.
        """
        real, index, vector = (
            self.tree.backend.Float,
            self.tree.backend.UInt32,
            self.tree.backend.Array3f,
        )
        t_after, n_after = real(after[0]), index(after[1])
        may_meet_box = self._make_box_test(frame, reach)

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if the ray comes near its box before the best crossing so far. state:
            the best crossing so far (its t first). Returns the mask of lanes that enter the node,
            and the state, which the triangles of a leaf have updated."""
            limit = fmin(state[0], t_max)
            is_met = may_meet_box(node, t_after, limit)
            return is_met, for_each_primitive(node, is_met & node.is_leaf, nearer, state)

        def nearer(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """The new state: the crossing with the triangle in the record `row`, if it comes after
            the crossing `after` of the enclosing function (split into `t_after` and `n_after`), not
            after t_max, and before the best crossing so far, which is `state`; otherwise `state`.
            With `reach` more than 0, a border within that distance of the ray counts as crossed."""
            best, number, sign, normal = state
            t, new_sign = signed_crossing(row, frame)
            # The triangle of an empty slot, number -1, has no area: its sign is 0.
            n = index(fmax(row[NUMBER_COLUMN], real(0)))
            # After NO_TRIANGLE no triangle is left at the same t.
            is_after = (t > t_after) | ((t == t_after) & (n > n_after) & (n_after != NO_TRIANGLE))
            is_before_best = (t < best) | ((t == best) & (n < number))
            is_crossed = new_sign != 0
            if reach > 0:
                # A border near an end of the ray does not count.
                is_off_ends = (t > 2 * reach) & (t < t_max - 2 * reach)
                is_crossed |= is_off_ends & _is_beside(row, frame, reach)
            is_chosen = active & is_crossed & is_after & is_before_best & (t <= t_max)
            return (
                dr.select(is_chosen, t, best),
                dr.select(is_chosen, n, number),
                dr.select(is_chosen, new_sign, sign),
                dr.select(is_chosen, normal_of(row, vector), normal),
            )

        # The best crossing so far: t, number of the triangle, sign, and a normal of any length.
        start = (real(dr.inf), index(NO_TRIANGLE), real(0), vector(0))
        best, number, sign, normal = traverse(self.tree, visit, start, active)
        # 1e-37 only keeps the normal finite (0) where there is no crossing.
        return best, number, sign, normal * dr.rsqrt(fmax(dr.squared_norm(normal), real(1e-37)))

    def signed_crossings_ahead(self, frame: RayFrame, t_min: Real, active: Mask = True) -> Real:
        """The sum of the signs of all crossings of each ray (of `frame`) with triangles at t >
        t_min, on active lanes. The sign of a crossing is 1 if the triangle's normal points along
        the ray, else -1.
        """
        real, may_meet_box = self.tree.backend.Float, self._make_box_test(frame)

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if the ray comes near its box ahead of t_min. state: the sum so far.
            Returns the mask of lanes that enter the node, and the state, to which the triangles of
            a leaf have been added."""
            is_met = may_meet_box(node, real(t_min), real(dr.inf))
            return is_met, for_each_primitive(node, is_met & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """The new state: the sum so far, `state`, plus the sign of the crossing with the
            triangle in the record `row`, if the crossing is ahead of t_min."""
            t, sign = signed_crossing(row, frame)
            return (state[0] + dr.select(active & (t > t_min), sign, 0),)

        return traverse(self.tree, visit, (real(0),), active)[0]

    def signed_crossings_between(
        self, frame: RayFrame, end: Real, unit: Real, active: Mask
    ) -> tuple[Real, Mask]:
        """The sum of the signs of all crossings of each ray (of `frame`) with triangles at 0 < t <
        end, and a mask of the rays for which rounding cannot change the sum. The sign of a crossing
        is 1 if the triangle's normal points along the ray, else -1.

        unit: the rounding error of a coordinate.

        The computed t belongs to a point of the triangle within a few units of the ray. So t is off
        by at most a few units divided by the cosine of the angle between ray and normal. If t is
        that close to 0 or to `end`, the sum is not certain.
        """
        real, may_meet_box = self.tree.backend.Float, self._make_box_test(frame)

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if the ray comes near its box between 0 and `end`. state: the sum so
            far, and the mask of lanes on which it is certain. Returns the mask of lanes that enter
            the node, and the state, which the triangles of a leaf have updated."""
            is_met = may_meet_box(node, real(0), real(end))
            return is_met, for_each_primitive(node, is_met & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """The new state (sum, mask): the sign of the crossing with the triangle in the record
            `row` is added to the sum if the crossing is between 0 and `end`. The mask becomes False
            if rounding may have decided whether it is between them."""
            total, is_sure = state
            t, sign = signed_crossing(row, frame)
            normal = normal_of(row, self.tree.backend.Array3f)
            # Is |t| larger than the error of t? Both sides are multiplied by |normal| and by the
            # cosine, so that nothing is divided by a cosine near 0.
            steep, error = (
                dr.abs(dr.dot(normal, frame.d)),
                _UNCERTAIN_ROUNDINGS * unit * dr.norm(normal),
            )
            is_certain = (dr.abs(t) * steep > error) & (dr.abs(t - end) * steep > error)
            is_between = active & (t > 0) & (t < end)
            # A triangle that the ray does not cross (sign 0) adds no doubt, whatever its t.
            return total + dr.select(is_between, sign, 0), is_sure & (
                is_certain | (sign == 0) | ~active
            )

        start = real(0), self.tree.backend.Bool(active)
        total, is_sure = traverse(self.tree, visit, start, active)
        return total, is_sure

    def signed_crossings_vertical(self, x: Vec3, way: Real, active: Mask = True) -> Real:
        """The sum of the signs of all crossings of rays from x along the z axis with triangles, on
        active lanes. The sign of a crossing is 1 if the triangle's normal has a positive z
        component, else -1, whichever of the two directions the ray has.

        way: 1 for rays upwards, -1 for rays downwards.

        Testing boxes takes less time than for other directions.
        """
        real = self.tree.backend.Float
        is_upward, height = way > 0, way * x.z
        # A bound of the rounding of coordinates. `height` is z, or for rays downwards -z.
        pad = 4 * self.tree.backend.machine_epsilon * (1 + dr.max(dr.abs(x)))
        low_x, high_x, low_y, high_y = x.x - pad, x.x + pad, x.y - pad, x.y + pad

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Enter a node if its box meets the vertical ray from x, up to rounding. state: the sum
            so far. Returns the mask of lanes that enter the node, and the state, to which the
            triangles of a leaf have been added."""
            # For rays downwards, z and the ray are mirrored: the upper end of the box is at -z0.
            x0, y0, z0, x1, y1, z1 = node.head
            is_met = (
                (high_x >= x0) & (low_x <= x1) & (high_y >= y0) & (low_y <= y1)
                & (height - pad <= dr.select(is_upward, z1, -z0))
            )  # fmt: skip
            return is_met, for_each_primitive(node, is_met & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """The new state: the sum so far, `state`, plus the sign of the ray's crossing with the
            triangle in the record `row`, if the crossing is ahead of x."""
            t, sign = signed_crossing(row, VerticalRayFrame(x))
            return (state[0] + dr.select(active & (way * t > 0), sign, 0),)

        return traverse(self.tree, visit, (real(0),), active)[0]

    def _make_box_test(self, frame: RayFrame, reach: float = 0.0) -> Any:
        """Make a function that tells whether the rays of `frame` come near a node's box.

        The function takes a node, t_min and t_max. It returns a mask: whether the ray comes within
        `reach` (a length) of the node's box at some t between these two. Rounding may turn a no
        into a yes, never a yes into a no: boxes and t are widened by `pad`, a bound of the rounding
        error, since |d| = 1 makes t a length.
        """
        backend = self.tree.backend
        vector = backend.Array3f
        d = frame.d
        # Never zero: 1e-18 of the box's size is far below its padding.
        direction = dr.select(dr.abs(d) < 1e-18, dr.select(d < 0, vector(-1e-18), vector(1e-18)), d)
        inverse = dr.rcp(direction)
        o = frame.o
        size = max_norm(o)
        # By how much boxes are enlarged: the reach, and a bound of the rounding of coordinates.
        pad = 16 * backend.machine_epsilon * (1 + size) + reach

        def may_meet(node: VisitedNode, t_min: Real, t_max: Real) -> Mask:
            """Whether the ray o + t d comes within `reach` (of `_make_box_test`) of the node's box,
            up to rounding, for a t between t_min and t_max."""
            low, high = vector(*node.head[:3]) - pad, vector(*node.head[3:]) + pad
            # The t at which the ray passes the box's planes; it is in the box from near to far.
            a, b = (low - o) * inverse, (high - o) * inverse
            near = fmax(fmax(fmin(a.x, b.x), fmin(a.y, b.y)), fmin(a.z, b.z))
            far = fmin(fmin(fmax(a.x, b.x), fmax(a.y, b.y)), fmax(a.z, b.z))
            margin = 8 * backend.machine_epsilon * dr.abs(far) + pad
            return (near <= far + margin) & (far + margin >= t_min) & (near - margin <= t_max)

        return may_meet


def corners_of(row: list[Real], vector: Any) -> tuple[Vec3, Vec3, Vec3]:
    """The three corners of the triangle in the record `row`. vector: the type of the result's
    points, a Dr.Jit 3-vector."""
    return vector(*row[0:3]), vector(*row[3:6]), vector(*row[6:9])


def normal_of(row: list[Real], vector: Any) -> Vec3:
    """A normal of the triangle in the record `row`, in the direction of its face's right-hand rule;
    its length is twice the area.

    vector: the type of the normal, a Dr.Jit 3-vector.
    """
    p, q, r = corners_of(row, vector)
    return row[PARITY_COLUMN] * dr.cross(q - p, r - p)


def signed_crossing(row: list[Real], frame: RayFrame | VerticalRayFrame) -> tuple[Real, Real]:
    """The t and the sign of the crossing of a ray (of `frame`) with the triangle in the record
    `row`. The sign is 1 if the triangle's normal points along the ray, -1 if it points back, and 0
    if the ray does not cross the triangle.

    In the plane across the ray, with coordinates (u, v), the sign is the winding number of the
    triangle about the ray. It is a sum over the edges of the triangle: +1 for each that crosses the
    half-line v = 0, u > 0 upwards, and -1 for each that crosses it downwards. Upwards means from v
    <= 0 to v > 0, which v alone decides; whether u > 0 at the crossing is the sign of
    `edge_function`. Both decisions are the same for all triangles at an edge or a vertex. So a
    rounding error that adds a crossing to one triangle takes it from its neighbor. The sum over a
    closed surface is right whatever the rounding was, and rays through edges and vertices need no
    special case.

    t is the depth of some point of the triangle whose distance from the ray is at most a few
    roundings of the coordinates. This holds however thin the triangle is (`_crossing_depth`).
    """
    vector = cast("Any", type(frame.o))
    p, q, r = corners_of(row, vector)
    a, b, c = frame.transverse(p), frame.transverse(q), frame.transverse(r)
    ab, bc, ac = edge_function(a, b), edge_function(b, c), edge_function(a, c)
    is_a_up, is_b_up, is_c_up = a[1] > 0, b[1] > 0, c[1] > 0

    def edge_sign(from_up: Mask, to_up: Mask, left: Real) -> Real:
        """How an edge crosses the half-line v = 0, u > 0: 1 upwards, -1 downwards, 0 if it does
        not.

        from_up, to_up: whether v > 0 at the ends of the edge.
        left: the `edge_function` of its ends."""
        one = type(left)(1)
        return dr.select(~from_up & to_up & (left > 0), one, 0) - dr.select(
            from_up & ~to_up & (left < 0), one, 0
        )

    # The triangle runs a, b, c, a; its last edge is stored from a to c, hence the minus sign.
    sign = row[PARITY_COLUMN] * (
        edge_sign(is_a_up, is_b_up, ab)
        + edge_sign(is_b_up, is_c_up, bc)
        - edge_sign(is_a_up, is_c_up, ac)
    )
    a, b, c = (*a, frame.depth(p)), (*b, frame.depth(q)), (*c, frame.depth(r))
    close = _EDGE_ROUNDINGS * float(dr.epsilon(frame.o)) * (1 + dr.max(dr.abs(frame.o)))
    return _crossing_depth((a, b, c), (ab, bc, ac), close), sign


def _is_beside(row: list[Real], frame: RayFrame, reach: float) -> Mask:
    """Whether the line along a ray (of `frame`) comes within `reach` (a length) of an edge or a
    corner of the triangle in the record `row`. (Dr.Jit computes only once what `signed_crossing`
    computes as well.)"""
    p, q, r = corners_of(row, type(frame.o))
    a, b, c = frame.transverse(p), frame.transverse(q), frame.transverse(r)
    is_near: Mask = False
    zero = type(a[0])(0)  # stands for the depths, which `_square` does not read
    for start, end in ((a, b), (b, c), (a, c)):
        twice_area, square = edge_function(start, end), _square((*start, zero), (*end, zero))
        # Where the ray, at (0, 0), is projected on the edge: 0 at its start, 1 at its end. Its
        # distance from the edge's line is twice_area over the edge's length.
        t = -dr.fma(start[0], end[0] - start[0], start[1] * (end[1] - start[1])) / square
        is_near |= (twice_area * twice_area <= reach * reach * square) & (t > 0) & (t < 1)
    for u, v in (a, b, c):
        is_near |= dr.fma(u, u, v * v) <= reach * reach
    return is_near


def _crossing_depth(
    corners: tuple[RayCoordinates, RayCoordinates, RayCoordinates],
    areas: tuple[Real, Real, Real],
    close: Real,
) -> Real:
    """The t at which a ray passes through a triangle.

    corners: (u, v, depth) of each corner a, b and c, in the frame of the ray.
    areas: the `edge_function` of the edges ab, bc and ac: twice the signed area of the triangle
        from the ray to the edge.
    close: a ray within this distance of an edge counts as passing through the edge.

    The barycentric weight of a corner is an area divided by the triangle's area, which for a thin
    triangle is only rounding error. So t is computed along the longest edge, on which coordinates
    are accurate. Let w be the weight of the corner opposite to the longest edge, the apex. Measure
    positions along that edge from 0 at its start to 1 at its end, and let s' be the position of the
    apex. Then the ray's position is s + w s' with 0 <= s <= 1 - w. First, w is clamped to the range
    for which there is such an s; then s is computed from w. A wrong w moves the point only across
    the longest edge, by no more than the rounding of an area over the edge's length.

    If the ray is within `close` of an edge or a vertex, t is the depth of that edge or vertex. It
    has the same bits for all triangles there, so that the ray crosses all of them at exactly the
    same t.
    """
    (a, b, c), (ab, bc, ac) = corners, areas
    squares = _square(a, b), _square(b, c), _square(a, c)
    is_first = (squares[0] >= squares[1]) & (squares[0] >= squares[2])
    is_last = squares[2] > squares[1]

    def select_longest(first: Real, second: Real, last: Real) -> Real:
        """Select the number that belongs to the longest edge, from the numbers of the edges ab
        (`first`), bc (`second`) and ac (`last`)."""
        return dr.select(is_first, first, dr.select(is_last, last, second))

    start, end, apex = (
        tuple(select_longest(*numbers) for numbers in zip(*choice, strict=True))
        for choice in ((a, b, a), (b, c, c), (c, a, b))
    )
    e = end[0] - start[0], end[1] - start[1]
    # The positions of the ray and of the apex (s') along the longest edge.
    inverse_square = dr.rcp(select_longest(*squares))
    ray_position = -dr.fma(start[0], e[0], start[1] * e[1]) * inverse_square
    apex_position = dr.fma(apex[0] - start[0], e[0], (apex[1] - start[1]) * e[1]) * inverse_square
    zero = type(ab)(0)
    ray_position, apex_position = clamp(ray_position, zero, 1), clamp(apex_position, zero, 1)
    # So that 0 <= s <= 1 - w for s = ray_position - w apex_position. `fmin` ignores the NaN of a
    # quotient 0/0.
    max_w = fmin(
        (1 - ray_position) / (1 - apex_position), fmin(ray_position / apex_position, type(ab)(1))
    )
    # w: the area at the longest edge over the triangle's area. The triangle runs the edge ac from c
    # to a, hence the minus sign.
    w = clamp(select_longest(ab, bc, -ac) / (bc - ac + ab), zero, max_w)
    s = clamp(dr.fma(-w, apex_position, ray_position), zero, 1 - w)
    t = dr.fma(s, end[2] - start[2], dr.fma(w, apex[2] - start[2], start[2]))
    # Edges that the ray passes through decide t; vertices come last and overrule them.
    close_square = close * close
    for (tail, head), area, square in zip(
        ((a, b), (b, c), (a, c)), (ab, bc, ac), squares, strict=True
    ):
        position = -dr.fma(tail[0], head[0] - tail[0], tail[1] * (head[1] - tail[1])) / square
        edge_depth = dr.fma(clamp(position, zero, 1), head[2] - tail[2], tail[2])
        is_on_edge = (area * area <= close_square * square) & (position > 0) & (position < 1)
        t = dr.select(is_on_edge, edge_depth, t)
    for u, v, depth in corners:
        # A vertex counts within twice the length `close`.
        t = dr.select(dr.fma(u, u, v * v) <= 4 * close_square, depth, t)
    return t


def _square(a: RayCoordinates, b: RayCoordinates) -> Real:
    """The squared distance between the points a and b across a ray; their depths do not matter."""
    u, v = b[0] - a[0], b[1] - a[1]
    return dr.fma(u, u, v * v)
