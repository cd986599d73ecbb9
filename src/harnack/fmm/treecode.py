"""Sums over a tree of sources: far clusters are replaced by multipole moments, near sources are
summed directly. A *source* is a dipole (an oriented point) or a triangle, one of the tree's
primitives. A *node* of the tree stands for the cluster of all sources below it. Where a node is far
from the point x, it counts as a single source, given by its moments. A *record* is a row of numbers
that kernels read, for a node or a source. In a leaf every source has a *slot*; some slots are
empty. A *lane* is one entry of Dr.Jit's arrays, such as a point; each lane walks through the tree
by itself.

- `traverse_clusters`: a traversal of a tree that visits its far clusters.
- `Treecode`: the sums over such a tree, shared by triangles and points. The caller adds the
  primitives of near leaves.
- `multipole_terms`: the terms of a far node in value, gradient and Hessian.
- `dipole_records`, `records_in_slots`: oriented points as records, also in the leaves of a tree.

`traverse_clusters` and `dipole_hierarchy` are for points of any kind, whose records and moments the
caller makes. All else here is for dipoles: moments begin with the degree l = 1, as those of a
dipole do, while those of a mass begin with l = 0 (`multipole.MOMENT_KEYS`); records have eight
numbers; and `Treecode.sums` asks the caller for the terms of near primitives, and makes those of
far nodes itself. `source_sums` says what other kinds of sources need for bounds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax
from harnack.fmm.multipole import (
    NodeMoments,
    cartesian_coefficients,
    remainder_constants,
    truncation_bounds,
)
from harnack.fmm.point_values import SymmetricMatrix
from harnack.fmm.source_sums import SourceSums, SourceTerm, singularity_fraction
from harnack.fmm.unit_frame import coordinate_rounding
from harnack.tree import (
    NO_PRIMITIVE,
    PackedTree,
    VisitedNode,
    build_balanced_tree,
    for_each_primitive,
    pack_tree,
    traverse,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fmm.point_values import PointValues
    from harnack.tree import BalancedTree
    from harnack.tree.balanced_tree import FloatArray, PrimitiveBody

State: TypeAlias = "tuple[Any, ...]"


@dataclass(frozen=True)
class ClusterView:
    """A node of a tree of sources, as seen from points x.

    head: the numbers of the node's record that every visit reads.
    payload: its other numbers, which are read only on lanes on which the node is far.
    r: the vector from the node's center to x.
    square: |r|^2, plus the argument `height_square` of `traverse_clusters`.
    inverse: 1/sqrt(square), or 0 where the node is not far.
    far: the mask of the lanes on which the node is far enough for its moments to be used.
    """

    head: tuple[Real, ...]
    payload: list[Real]
    r: Vec3
    square: Real
    inverse: Real
    far: Mask


EachCluster: TypeAlias = "Callable[[ClusterView, State], State]"


def traverse_clusters(
    tree: PackedTree, x: Vec3, closer: Real, add_cluster: EachCluster,
    add_primitive: PrimitiveBody, state: State, active: Mask = True, height_square: Real = 0.0,
) -> State:  # fmt: skip
    """Traverse a tree from points x: nodes that are far from x are added as a single source, and
    the primitives of near leaves are added one by one. Returns the last state.

    tree: a packed tree. A node's record begins with its center and its accepting distance, beyond
        which its moments may be used.
    x: the points, one for each lane.
    closer: the moments of nodes are used beyond this many times the accepting distance; at least 1.
        Larger is more accurate.
    add_cluster: a function (node, state) that returns the state with a node added on the lanes on
        which it is far.
    add_primitive: a function (record, mask of active lanes, state) that returns the state with the
        primitive of a near leaf added.
    state: the first state.
    active: the mask of the active lanes.
    height_square: a number added to the squares of all distances. For points in four dimensions it
        is the square of their distance from the three-dimensional space of the tree.
    """
    vector = tree.backend.Array3f

    def visit(node: VisitedNode, state: State) -> tuple[Mask, State]:
        """Add the node, by the function `add_cluster`, on lanes on which it is far from x: farther
        than `closer` times its accepting distance. On other lanes, if it is a leaf, add its
        primitives by the function `add_primitive`. `height_square` is added to all squared
        distances. Returns the mask of the lanes on which the walk enters the node, and the new
        state."""
        # A record begins with the center and the accepting distance.
        r = x - vector(*node.head[:3])
        square = dr.squared_norm(r) + height_square
        is_far = square > dr.square(node.head[3] * closer)
        inverse = dr.select(is_far, dr.rsqrt(square), 0)
        cluster = ClusterView(node.head, node.payload(is_far), r, square, inverse, is_far)
        state = add_cluster(cluster, state)
        return ~is_far, for_each_primitive(node, ~is_far & node.is_leaf, add_primitive, state)

    return traverse(tree, visit, state, active)


# The largest number of dipoles in a leaf, and the number of children of a node: by experiment.
_LEAF_SIZE, _ARITY = 8, 4


def dipole_hierarchy(points: FloatArray) -> BalancedTree:
    """Build the balanced tree over points (n, 3), those of dipoles or of others: which points are
    in which node. It holds no positions and no moments."""
    return build_balanced_tree(points, leaf_size=_LEAF_SIZE, arity=_ARITY)


def dipole_records(points: FloatArray, moments: FloatArray) -> FloatArray:
    """Records (n, 8) of dipoles, the sources of a field of oriented points: position, moment,
    length of the moment, 0.

    points: (n, 3) the positions.
    moments: (n, 3) area times normal.
    """
    weight = np.linalg.norm(moments, axis=1, keepdims=True)
    return np.concatenate([points, moments, weight, np.zeros_like(weight)], axis=1)


def empty_record(row: FloatArray) -> FloatArray:
    """Records for empty slots of a leaf: (..., 8), with the positions of the dipoles in `row` (...,
    8) and moment 0, so that they add nothing to sums."""
    empty = np.zeros_like(row)
    empty[..., :3] = row[..., :3]
    return empty


def records_in_slots(tree: BalancedTree, rows: FloatArray) -> FloatArray:
    """Arrange the records of dipoles in the slots of the leaves of a tree: (leaves, leaf_size, 8).
    Empty slots hold a record with moment 0 at the position of the leaf's first dipole.

    rows: (n, 8) the records of all dipoles.
    """
    slots = tree.values_in_slots(rows)
    empty = tree.leaf_slots == NO_PRIMITIVE
    slots[empty] = np.broadcast_to(empty_record(slots[:, :1]), slots.shape)[empty]
    return slots


def multipole_terms(c: Sequence[Real], r: Vec3, inverse: Real, derivatives: int) -> SourceTerm:
    """The potential f of a far node at a point, and its derivatives. f is the sum of
    P_l(r)/|r|^(2l+1) over l = 1, 2, 3, with harmonic polynomials P_l of degree l.

    c: the coefficients of the polynomials P_l, in the order of `multipole.cartesian_coefficients`.
    r: the vector from the node's center to the point.
    inverse: 1/|r|.
    derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian, too.

    With u = 1/|r|, G_l = grad P_l (so that l P_l = G_l.r by Euler) and H_l the Hessian of P_l,

        f      = sum P_l u^(2l+1)
        grad f = sum G_l u^(2l+1) - s r,           s = sum (2l+1) P_l u^(2l+3)
        Hess f = sum H_l u^(2l+1) - (V r^T + r V^T) - s I + w r r^T,
                 V = sum (2l+1) G_l u^(2l+3),      w = sum (2l+1)(2l+3) P_l u^(2l+5).

    In the code a common factor u^3 is left out of all terms and multiplied at the end. So p1, p2,
    p3 are P_l u^(2l-2), and g1, g2, g3 are G_l u^(2l-2).
    """
    vector = cast("Any", type(r))
    x, y, z = r
    u2 = inverse * inverse
    u3 = inverse * u2
    g1 = vector(c[0], c[1], c[2])
    # P_2 has the coefficients of x^2, y^2 (and z^2, as its trace is 0), xy, xz, yz. `half` is half
    # of its gradient.
    czz = -(c[3] + c[4])
    half = vector(
        dr.fma(c[3], x, dr.fma(c[5], y, c[6] * z)),
        dr.fma(c[5], x, dr.fma(c[4], y, c[7] * z)),
        dr.fma(c[6], x, dr.fma(c[7], y, czz * z)),
    )
    xyy, xzz, xxy, yzz, xxz, yyz, xyz = c[8:15]
    xx, yy, zz = x * x, y * y, z * z
    # The gradient of P_3; x^3, y^3, z^3 have the coefficients that make it harmonic.
    g3 = vector(
        dr.fma(xyy, yy - xx, dr.fma(xzz, zz - xx, 2 * x * dr.fma(xxy, y, xxz * z)) + xyz * y * z),
        dr.fma(xxy, xx - yy, dr.fma(yzz, zz - yy, 2 * y * dr.fma(xyy, x, yyz * z)) + xyz * x * z),
        dr.fma(xxz, xx - zz, dr.fma(yyz, yy - zz, 2 * z * dr.fma(xzz, x, yzz * y)) + xyz * x * y),
    )
    u4 = u2 * u2
    p1 = dr.dot(g1, r)
    p2 = dr.dot(half, r) * u2
    p3 = dr.dot(g3, r) * (u4 * (1 / 3))
    value = (p1 + p2 + p3) * u3
    if derivatives == 0:
        return SourceTerm(value)
    g2, g3 = half * (2 * u2), g3 * u4
    s = dr.fma(3, p1, dr.fma(5, p2, 7 * p3)) * u2
    gradient = dr.fma(vector(-s), r, g1 + g2 + g3) * u3
    if derivatives == 1:
        return SourceTerm(value, gradient)
    return SourceTerm(value, gradient, _hessian(c, r, (g1, g2, g3), (p1, p2, p3), (u2, u3)))


def _hessian(
    c: Sequence[Real], r: Vec3, g: tuple[Vec3, ...], p: tuple[Real, ...], u: tuple[Real, Real]
) -> SymmetricMatrix:
    """The Hessian of the sum f of P_l(r)/|r|^(2l+1) over l = 1, 2, 3 (`multipole_terms` has the
    formula).

    c: the coefficients of the polynomials P_l.
    r: the vector from the node's center to the point.
    g, p: for l = 1, 2, 3 the gradients G_l and the values P_l, times u^(2l-2), with u = 1/|r|.
        These products are of the same size for all l.
    u: u^2 and u^3.
    """
    x, y, z = r
    (g1, g2, g3), (p1, p2, p3), (u2, u3) = g, p, u
    u4 = u2 * u2
    s = dr.fma(3, p1, dr.fma(5, p2, 7 * p3)) * u2
    czz = -(c[3] + c[4])
    xyy, xzz, xxy, yzz, xxz, yyz, xyz = c[8:15]
    v = dr.fma(3, g1, dr.fma(5, g2, 7 * g3)) * u2
    w = dr.fma(15, p1, dr.fma(35, p2, 63 * p3)) * u4
    # The entries xx, yy, zz, xy, xz, yz of the Hessians of P_3 and P_2.
    p3_entries = (
        -2 * dr.fma(xyy + xzz, x, -dr.fma(xxy, y, xxz * z)),
        -2 * dr.fma(xxy + yzz, y, -dr.fma(xyy, x, yyz * z)),
        -2 * dr.fma(xxz + yyz, z, -dr.fma(xzz, x, yzz * y)),
        dr.fma(2, dr.fma(xxy, x, xyy * y), xyz * z),
        dr.fma(2, dr.fma(xxz, x, xzz * z), xyz * y),
        dr.fma(2, dr.fma(yyz, y, yzz * z), xyz * x),
    )
    p2_entries = (2 * c[3], 2 * c[4], 2 * czz, 2 * c[5], 2 * c[6], 2 * c[7])
    pairs = ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    # The entries of V r^T and of r V^T.
    crossed = (
        (v.x * x, v.x * x), (v.y * y, v.y * y), (v.z * z, v.z * z),
        (v.x * y, v.y * x), (v.x * z, v.z * x), (v.y * z, v.z * y),
    )  # fmt: skip
    # The first three entries, on the diagonal, contain s I.
    parts = [
        (p2_entry * u2 + p3_entry * u4 - left - right + w * a * b - (s if k < 3 else 0)) * u3
        for k, (p2_entry, p3_entry, (left, right), (a, b)) in enumerate(
            zip(p2_entries, p3_entries, crossed, pairs, strict=True)
        )
    ]
    return SymmetricMatrix(*parts)


ExtraState: TypeAlias = "tuple[Any, ...]"

COARSE_RATIO = 2.5
"""Coarse evaluations use the moments of a node beyond this many times its radius, or beyond
`Treecode.accuracy` times it where that is less."""
# The number of roundings by which the gradient of a far node itself may be wrong.
_FAR_GRADIENT_ROUNDINGS = 64.0
# If no term bounds the distance that is free of sources, it is taken to be this many times one plus
# the largest coordinate.
_NO_SOURCE_DISTANCE = 1e4

# A function that adds a primitive. Its arguments are the primitive's record, the mask of the lanes
# on which to add it, the sums, and a further state of the caller. It returns the new sums and the
# new state.
AddPrimitive: TypeAlias = (
    "Callable[[list[Real], Mask, SourceSums, ExtraState], tuple[SourceSums, ExtraState]]"
)


def node_records(
    level: NodeMoments, order: int, acceptance_ratio: float, error: FloatArray
) -> FloatArray:
    """The records of the k nodes of one level of a tree, as `Treecode` reads them: (k, 22).

    A record holds the node's center c, its accepting distance, two constants A and K that bound the
    remainder of Taylor's formula for the node's field (`remainder_constants`), 15 coefficients of
    the moments, and the error bound E. A point that is farther from c than the accepting distance
    may use the moments of the node instead of its children. Coefficients of moments above the order
    are 0.

    level: the moments of the nodes.
    order: 0, 1 or 2, the order of the multipole moments that are used.
    acceptance_ratio: the accepting distance of a node, in radii of the node.
    error: (k,) E: at the distance r the truncation error of the value is at most E r^-(order + 3).
    """
    head = [acceptance_ratio * level.radius, *remainder_constants(level, acceptance_ratio)]
    parts = (level.center, *head, cartesian_coefficients(level.moments, order), error)
    return np.column_stack(parts)


@dataclass(frozen=True)
class Treecode:
    """A tree of sources on a backend, which computes sums over all sources at points. A node that
    is far from a point counts as a single source, given by its multipole moments. The accuracy
    scale of an evaluation says how far: the larger, the more accurate. Evaluations at the smallest
    scale are called coarse.

    tree: the nodes, with the records of `node_records`.
    accuracy: at accuracy scale 1, nodes are far beyond this many times their radius.
    coarse_ratio: the same number for coarse evaluations.
    order: the order of the multipole moments: 0, 1 or 2.
    coarse_error_ratio: the truncation error of a coarse evaluation is at most this many times the
        stored bound.
    gradient_error_ratio, hessian_error_ratio: at distance r, the truncation error of the gradient
        is at most `gradient_error_ratio`/r times that of the value, and that of second derivatives
        at most `hessian_error_ratio`/r^2 times that of the value.
    """

    backend: Backend
    tree: PackedTree
    accuracy: float
    coarse_ratio: float
    order: int
    coarse_error_ratio: Real
    gradient_error_ratio: Real
    hessian_error_ratio: Real

    @classmethod
    def of(
        cls,
        backend: Backend,
        tree: BalancedTree,
        levels: list[NodeMoments],
        primitives: FloatArray,
        accuracy: float,
        order: int = 2,
    ) -> Treecode:
        """Upload a tree with its moments and sources.

        tree: the hierarchy of the tree: which sources are in which node.
        levels: the moments of the nodes, one entry for each level of the tree, from the leaves to
            the root.
        primitives: the records of the sources in their slots, as `tree.pack_tree` takes them.
        accuracy: at accuracy scale 1, nodes are far beyond this many times their radius.
        order: the order of the multipole moments: 0, 1 or 2.

        Each node stores a single bound E of its truncation error for both kinds of evaluation. E is
        at least the bound at accuracy scale 1, and at least the bound of the coarse evaluation
        divided by `coarse_error_ratio`. This ratio is the median, over the leaves, of the ratio of
        the two bounds.
        """
        coarse_ratio = min(accuracy, COARSE_RATIO)
        fine_bounds = [truncation_bounds(level, accuracy * level.radius, order) for level in levels]
        coarse_bounds = [
            truncation_bounds(level, coarse_ratio * level.radius, order) for level in levels
        ]
        # Level 0 has the leaves, and the first bound is that of the value.
        error_ratio = _median_ratio(coarse_bounds[0][0], fine_bounds[0][0])
        nodes: list[FloatArray] = []
        # The largest ratios, over all nodes, of the error of the gradient and of second derivatives
        # to that of the value.
        slope_ratio = second_ratio = 0.0
        for level, *bounds in zip(levels, fine_bounds, coarse_bounds, strict=True):
            error, slope, second = (
                np.maximum(fine, coarse / error_ratio) for fine, coarse in zip(*bounds, strict=True)
            )
            nonzero = error > 0
            slope_ratio = max(
                slope_ratio, float((slope[nonzero] / error[nonzero]).max(initial=0.0))
            )
            second_ratio = max(
                second_ratio, float((second[nonzero] / error[nonzero]).max(initial=0.0))
            )
            nodes.append(node_records(level, order, coarse_ratio, error))
        packed = pack_tree(backend, tree, nodes, primitives)
        # The factors 1 + 1e-6 are for the rounding to single precision.
        ratios = error_ratio, slope_ratio * (1 + 1e-6), second_ratio * (1 + 1e-6)
        uploaded = (dr.opaque(backend.Float, ratio) for ratio in ratios)
        return cls(backend, packed, accuracy, coarse_ratio, order, *uploaded)

    @property
    def coarsest_accuracy(self) -> float:
        """The smallest accuracy scale that makes a difference: that of coarse evaluations, where 1
        is that of an ordinary evaluation. At smaller scales results are the same
        (`acceptance_ratio`)."""
        return self.coarse_ratio / self.accuracy

    def acceptance_ratio(self, detail: Real) -> Real:
        """The distance beyond which the moments of a node are used, in radii of the node. It grows
        with the accuracy scale `detail`, and is at least `coarse_ratio`."""
        return fmax(self.accuracy * detail, self.backend.Float(self.coarse_ratio))

    def sums(
        self, x: Vec3, detail: Real, add: AddPrimitive, extra_state: ExtraState = (),
        active: Mask = True, derivatives: int = 1,
    ) -> tuple[SourceSums, ExtraState]:  # fmt: skip
        """The sums over all sources at points x, with error bounds; and the caller's last state.

        detail: the accuracy scale. The larger it is, the farther away nodes must be to count as one
            source; infinity gives the direct sum.
        add: a function that adds a primitive of a near leaf (`AddPrimitive`).
        extra_state: a further state of the caller, which `add` updates.
        active: the mask of the active lanes.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        """
        # The records of nodes hold accepting distances for the coarse ratio; `closer` is the factor
        # from these to the distances for this accuracy scale.
        singular_share, closer = (
            singularity_fraction(self.coarse_ratio),
            self.acceptance_ratio(detail) / self.coarse_ratio,
        )
        unit = coordinate_rounding(x)
        # The distance that is taken to be free of sources if no node bounds it.
        no_source = _NO_SOURCE_DISTANCE * (1 + dr.max(dr.abs(x)))
        no_sums = SourceSums.zero(self.backend, no_source, derivatives)

        def add_cluster(node: ClusterView, state: ExtraState) -> ExtraState:
            """Add a node to the state on lanes on which it is far. The state consists of the state
            of the sums and the caller's own state. At `singular_share` times the distance of the
            node's center the node counts as a singular point. Returns the new state."""
            # The coefficients c[:15] of the moments, and c[15] = E (`node_records`).
            c, inverse = node.payload, node.inverse
            error = c[15] * self._decay(inverse)
            slope = error * inverse
            # Its terms; where it is far; 1/r; the factor A + K/r^2 of the remainder; truncation
            # errors of value, gradient and Hessian, the latter two without their constant ratios;
            # the distance at which it counts as a singular point; the rounding.
            sums = no_sums.with_state(state[0]).add_far_node(
                multipole_terms(c, node.r, inverse, derivatives),
                node.far,
                inverse,
                dr.fma(node.head[5], inverse * inverse, node.head[4]),
                (error, slope, slope * inverse),
                singular_share * (node.square * inverse),
                unit,
            )
            return sums.to_state(), state[1]

        def add_primitive(row: list[Real], active: Mask, state: ExtraState) -> ExtraState:
            """Add the primitive in the record `row` of a near leaf to the state, on active lanes.
            Returns the new state."""
            sums, extra_state = add(row, active, no_sums.with_state(state[0]), state[1])
            return sums.to_state(), extra_state

        start = no_sums.to_state(), extra_state
        state = traverse_clusters(self.tree, x, closer, add_cluster, add_primitive, start, active)
        # Below the accuracy scale 1, nodes may be nearer than the distance at which their bounds E
        # hold: they hold times this ratio.
        sums, error_ratio = (
            no_sums.with_state(state[0]),
            dr.select(detail < 1, self.coarse_error_ratio, 1),
        )
        # The loop has added up error bounds without the ratios, which are the same for all nodes:
        # self.gradient_error_ratio and self.hessian_error_ratio are those of the errors of the
        # derivatives to the error of the value.
        second = sums.hessian_truncation
        sums = dataclasses.replace(
            sums,
            truncation=error_ratio * sums.truncation,
            gradient_truncation=error_ratio * self.gradient_error_ratio * sums.gradient_truncation,
            hessian_truncation=None
            if second is None
            else error_ratio * self.hessian_error_ratio * second,
        )
        return sums, state[1]

    def values(self, sums: SourceSums, share: float, unit: Real, rounding: Real) -> PointValues:
        """Value and derivatives with error bounds, from the result `sums` of the method `sums`.

        share: the factor by which all results are multiplied.
        unit: a bound of the rounding of a coordinate.
        rounding: a bound of the rounding of the final operations on the value.
        """
        return sums.values(share, unit, rounding, _FAR_GRADIENT_ROUNDINGS)

    def _decay(self, inverse: Real) -> Real:
        """The number r^-(order + 3) at the distance r from a node, for inverse = 1/r. The
        truncation error of the value at this distance is the node's bound E times it: the first
        multipole term beyond the order falls off like that."""
        decay = inverse * inverse * inverse
        for _ in range(self.order):
            decay = decay * inverse
        return decay


def _median_ratio(larger: FloatArray, smaller: FloatArray) -> float:
    """The median of the ratios larger/smaller of the entries of two arrays; but at least 1. Entries
    with smaller = 0 do not count; if there are no others, the result is 1."""
    nonzero = smaller > 0
    return max(1.0, float(np.median(larger[nonzero] / smaller[nonzero]))) if nonzero.any() else 1.0
