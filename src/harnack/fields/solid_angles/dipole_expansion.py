"""Local expansions (harmonic polynomials) of the field of far dipoles and triangles in balls, and
bounds of their truncation errors.

- `source_tree`: a tree of primitives, dipoles or triangles, in double precision, with all data that
  expansions need; `triangle_sources`: triangles as records.
- `DipoleExpansions`: sums over far nodes and far primitives.
- `PendingSources`: the primitives of balls, split into such sums and the sources that are left to
  smaller balls.

Sources are far from a ball of radius rho by these rules, with a factor k > 1. A node of radius R is
far if its center is farther than k rho + `_NODE_RATIO` R from the ball's center. For a triangle of
radius R this distance is k rho + `TRIANGLE_RATIO` R, for a dipole k rho. So all points of a far
source are farther from the ball's center than k rho. A triangle counts as a sheet of dipoles along
its normal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.elementary import fmin
from harnack.fields.solid_angles.local_expansion import (
    coefficient_keys,
    irregular_harmonics,
    multipole_to_local,
    tail_factors,
)
from harnack.fields.solid_angles.multipole import (
    NodeMoments,
    sup_norm,
    triangle_tree_moments,
    truncation_bounds,
)
from harnack.tree import BalancedTree, PackedTree, VisitedNode, pack_tree
from harnack.tree.lane_lists import (
    LaneLists,
    WriteEntry,
    build_lists,
    for_each_entry,
    traverse_subtrees,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

# Harmonics have degree l.
# ruff: noqa: E741

# The degree of local expansions, and the largest degree of the multipoles they are computed from.
DEGREE, _MULTIPOLE_DEGREE = 6, 4
COEFFICIENTS = (DEGREE + 1) ** 2
_NODE_RATIO = 4.0
# The same factor for triangles, by experiment; and the moments in their records, besides the first.
TRIANGLE_RATIO = 1.5
_TRIANGLE_MOMENTS = tuple(key for key in coefficient_keys(_MULTIPOLE_DEGREE) if key[0] > 2)
# Numbers of a record of a dipole, and of a triangle before its moments.
_DIPOLE_SIZE, _TRIANGLE_HEADER_SIZE = 8, 14
# See `_ClusterExpansion.of`.
_ROUNDING = 2.0**-20
# Moments of a node, in order.
_MOMENTS = tuple(key for key in coefficient_keys(_MULTIPOLE_DEGREE) if key[0])
# Factor by which sums of many positive numbers in double precision become bounds.
_ROUNDED_UP = 1 + 1e-9


def source_tree(tree: BalancedTree, levels: list[NodeMoments], rows: FloatArray) -> PackedTree:
    """The tree of primitives on a backend in double precision, with the records that expansions
    need.

    A node's record holds: center, `_NODE_RATIO` times the radius, radius, area; then its moments up
    to degree 4; the bounds E and G of the terms beyond degree 4 in value and gradient
    (`multipole.truncation_bounds`); and for each degree a bound of its term (`multipole.sup_norm`).

    levels: the moments of the tree's nodes, one entry for each level of the tree.
    rows: the records of the primitives, in the slots of the tree's leaves: dipoles from
        `treecode.dipole_records`, or triangles from `triangle_sources`.
    """
    numbers: list[FloatArray] = []
    for level in levels:
        reach = _NODE_RATIO * level.radius
        error, slope, _ = truncation_bounds(level, reach, _MULTIPOLE_DEGREE - 1)
        moments = _columns(level, _MOMENTS)
        norms = [sup_norm(level.moments, l) for l in range(1, _MULTIPOLE_DEGREE + 1)]
        head = [level.center, reach, level.radius, level.area]
        numbers.append(np.column_stack([*head, *moments, error, slope, *norms]))
    return pack_tree(choose_backend("double"), tree, numbers, rows)


def _columns(level: NodeMoments, keys: Iterable[tuple[int, int, int]]) -> list[FloatArray]:
    """The real or imaginary parts of the moments with these keys (degree, order, 0 for real or 1
    for imaginary). For each key there is one array, with an entry for each node."""
    return [level.moments[l, m].imag if part else level.moments[l, m].real for l, m, part in keys]


def triangle_sources(corners: FloatArray) -> FloatArray:
    """Records (n, 30) of triangles (n, 3, 3).

    A record holds: centroid, area times normal, area, `TRIANGLE_RATIO` times the radius; then
    radius, (E, G) of `multipole.truncation_bounds`, the sup norms of the moments 1, 3 and 4, and
    the moments 3 and 4.

    The second moment about the centroid is a mean of offsets from the centroid, and so is 0. A
    triangle whose area is rounded to 0 gets an area of 1e-30, because a record without an area
    means an empty slot, but the edges of this triangle count.
    """
    leaves = BalancedTree(np.arange(len(corners), dtype=np.int64)[:, None], ())
    level = triangle_tree_moments(leaves, corners)[0]
    moments, reach = level.moments, TRIANGLE_RATIO * level.radius
    error, slope, _ = truncation_bounds(level, reach, _MULTIPOLE_DEGREE - 1)
    normal = 2 * moments[1, 1].real, 2 * moments[1, 1].imag, moments[1, 0].real
    higher = _columns(level, _TRIANGLE_MOMENTS)
    norms = [sup_norm(moments, l) for l in (1, 3, 4)]
    head = [level.center, *normal, np.maximum(level.area, 1e-30), reach, level.radius]
    return np.column_stack([*head, error, slope, *norms, *higher])


@dataclass(frozen=True)
class DipoleExpansions:
    """Sums over the far primitives of n balls: a polynomial for each ball, and error bounds.

    coefficients: (n, COEFFICIENTS) of the local expansion (`local_expansion.coefficient_keys`).
    error, slope: (n,) bounds of the truncation errors of value and gradient, anywhere in the ball.
    tail, tail_slope: (n,) further truncation errors of value and gradient are at most q^(p+1)
        `tail` and q^p `tail_slope` at a distance of q times the radius from the center, with
        p = `DEGREE`.
    s4: (n,) bounds of the sum of area/D^4, with D the smallest distance of a primitive from the
        center.
    min_distance: (n,) a lower bound of the distance of these primitives from the center.
    """

    coefficients: FloatArray
    error: FloatArray
    slope: FloatArray
    tail: FloatArray
    tail_slope: FloatArray
    s4: FloatArray
    min_distance: FloatArray

    @classmethod
    def zero(cls, n: int) -> DipoleExpansions:
        """The sums of n balls over no primitives: zeros, and an infinite distance."""
        zero = np.zeros(n)
        return cls(np.zeros((n, COEFFICIENTS)), *(5 * [zero]), min_distance=np.full(n, np.inf))

    def plus(self, other: DipoleExpansions) -> DipoleExpansions:
        """For each ball, the sum over the primitives of this object and those of `other`."""
        bounds = "error", "slope", "tail", "tail_slope", "s4"
        sums = (_ROUNDED_UP * (getattr(self, name) + getattr(other, name)) for name in bounds)
        min_distance = np.minimum(self.min_distance, other.min_distance)
        return DipoleExpansions(
            self.coefficients + other.coefficients, *sums, min_distance=min_distance
        )

    def subset(self, which: IntArray) -> DipoleExpansions:
        """The sums of the balls with the indices `which`. An index may occur several times."""
        return DipoleExpansions(*(values[which] for values in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: list[DipoleExpansions]) -> DipoleExpansions:
        """The sums of the balls of all parts, in the order of `parts`."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def to_octants(self, shifts: FloatArray, radius: float) -> DipoleExpansions:
        """The same sums about the centers of the eight octants of each cell. The octants of a cell
        follow each other in the result.

        shifts: (8, COEFFICIENTS, COEFFICIENTS) matrices from
            `local_expansion.local_to_local_matrices`.
        radius: the radius of the cells' balls.

        Proof. The ball of an octant lies in that of the cell, so that bounds of errors hold there
        as well. But the truncation error of the polynomial is not small about an octant's center,
        so `tail` is added to `error`. An octant's center is at most half a radius from the cell's
        center, so that distances shrink by at most that, and 1/D^4 grows at most by the factor (1 -
        radius/(2 d))^-4 for D >= d, with d = `min_distance`.
        """
        shifted = np.einsum("oab,kb->koa", shifts, self.coefficients)
        ratio = 0.5 * radius / self.min_distance  # 0 where there is nothing
        error, slope = self.error + self.tail, self.slope + self.tail_slope
        far = self.s4 / (1 - ratio) ** 4, self.min_distance - 0.5 * radius
        bounds = _ROUNDED_UP * error, _ROUNDED_UP * slope, 0 * error, 0 * slope, *far
        repeated = (np.repeat(bound, 8) for bound in bounds)
        return DipoleExpansions(shifted.reshape(-1, COEFFICIENTS), *repeated)

    @classmethod
    def over_nodes(
        cls, tree: PackedTree, lists: LaneLists, c: Vec3, radius: Real
    ) -> DipoleExpansions:
        """Sums over all primitives of far nodes, from the moments of the nodes, for n balls of this
        radius around the centers c (3, n).

        lists: for each ball, the list of the indices of its far nodes in the tree.
        """

        def term(i: Any, active: Mask) -> list[Any]:
            """What node i adds to the attributes of `DipoleExpansions`, as a list of numbers."""
            head, payload = tree.node_heads.read_record(i, active), tree.payload(i, active)
            numbers = dict(zip(_MOMENTS, payload, strict=False))
            error, slope_error, *norms = payload[len(_MOMENTS) :]
            r = c - tree.backend.Array3f(*head[:3])
            expansion = _ClusterExpansion.of(r, _pairs(numbers), norms, radius)
            return expansion.of_cluster(error, slope_error, head[4], head[5], radius)

        return cls._accumulated(tree.backend, lists, term)

    @classmethod
    def over_primitives(
        cls, tree: PackedTree, lists: LaneLists, c: Vec3, radius: Real
    ) -> DipoleExpansions:
        """Sums over single far primitives, for n balls of this radius around the centers c (3, n).

        lists: for each ball, the list of its far primitives, as rows of the tree's primitives.
        """

        def term(i: Any, active: Mask) -> list[Any]:
            """What primitive i, a dipole or a triangle, adds to the attributes of
            `DipoleExpansions`, as a list of numbers."""
            row = tree.primitives.read_record(i, active)
            first = {(1, 0): (row[5], 0.0), (1, 1): (0.5 * row[3], 0.5 * row[4])}
            r = c - tree.backend.Array3f(*row[:3])
            if tree.primitives.packets_per_record == 1:
                local = _ClusterExpansion.of(r, first, [row[6]], radius)
                bounds = local.rounding, local.rounding / radius, local.tail, local.tail_slope
                rest = row[6] * _fourth(local.inverse), dr.rcp(local.inverse)
                return [*local.coefficients, *bounds, *rest]
            size, error, slope_error, *norms = row[_DIPOLE_SIZE:_TRIANGLE_HEADER_SIZE]
            higher = dict(zip(_TRIANGLE_MOMENTS, row[_TRIANGLE_HEADER_SIZE:], strict=False))
            norms.insert(1, 0 * size)
            local = _ClusterExpansion.of(r, first | _pairs(higher), norms, radius)
            return local.of_cluster(error, slope_error, size, row[6], radius)

        return cls._accumulated(tree.backend, lists, term)

    @classmethod
    def _accumulated(
        cls, backend: Backend, lists: LaneLists, term: Callable[[Any, Mask], list[Any]]
    ) -> DipoleExpansions:
        """Add up `term` over the entries of each list.

        term: a function. From an entry of a list and a mask of active lanes it returns what the
            entry adds to the attributes of `DipoleExpansions`. The last number, for `min_distance`,
            is used in a minimum; all other numbers are added up.
        """
        zero = backend.Float(0)

        def add(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add what `term` returns for entry i to the state, on active lanes. The last number of
            the state is a minimum, all other numbers are sums."""
            *sums, minimum = state
            *added, nearest = term(i, active)
            pairs = zip(sums, added, strict=True)
            new = [old + dr.select(active, values, 0) for old, values in pairs]
            return *new, dr.select(active, fmin(minimum, nearest), minimum)

        start = (*([zero] * (COEFFICIENTS + 5)), zero + dr.inf)
        totals = for_each_entry(backend, lists, add, start)
        dr.eval(*totals)
        n = dr.width(lists.count)
        columns = [np.broadcast_to(to_numpy(values), n) for values in totals]
        coefficients = np.stack(columns[:COEFFICIENTS], axis=1)
        bounds = (values * _ROUNDED_UP for values in columns[COEFFICIENTS:-1])
        return cls(coefficients, *bounds, min_distance=columns[-1] / _ROUNDED_UP)


def _fourth(number: Any) -> Any:
    """The fourth power of a number."""
    square = number * number
    return square * square


def _pairs(numbers: dict[Any, Any]) -> dict[tuple[int, int], tuple[Any, Any]]:
    """Moments as pairs of real and imaginary part, from their parts by (degree, order, 0 for real
    or 1 for imaginary)."""
    return {
        (l, m): (numbers[l, m, 0], numbers.get((l, m, 1), 0.0))
        for l, m, part in numbers
        if not part
    }


@dataclass(frozen=True)
class _ClusterExpansion:
    """The local expansion, in a ball, of the field of one source that is given by its multipole
    moments.

    coefficients: the coefficients of the polynomial, times powers of the ball's radius.
    tail, tail_slope: bounds of the truncation errors of value and gradient on the ball's sphere.
    rounding: a bound of the rounding of the value.
    inverse: one over the distance of the multipole's center from the ball's center.
    """

    coefficients: list[Any]
    tail: Any
    tail_slope: Any
    rounding: Any
    inverse: Any

    @classmethod
    def of(cls, r: Vec3, moments: Any, norms: list[Any], radius: Real) -> _ClusterExpansion:
        """The expansion of multipole terms in the ball of this radius.

        r: the vector from the multipole's center to the ball's center.
        moments: a dictionary of the moments, as pairs of real and imaginary part, by (degree,
            order).
        norms: norms[l-1] bounds the term of degree l = 1, 2, ...: at a distance d from the
            multipole's center this term is at most norms[l-1]/d^(l+1).

        The bounds are those of `tail_factors`, whose c grows with l. They bound all terms of degree
        j > p. So at q times the radius, q <= 1, the truncation error is q^(p+1) times as much as on
        the sphere, and that of the gradient q^p times as much.

        Rounding, in double precision. Each product of a coefficient passes through fewer than 2^10
        roundings, including its shifts to smaller cells. The sum of the absolute values of all
        products, with those of the harmonics of the ball, is below 2^23 norms[l-1]/r^(l+1) (tests
        compute it). So the value, and the gradient times the radius, are off by at most 2^-20 of
        norms[l-1]/r^(l+1).
        """
        inverse = dr.rsqrt(dr.squared_norm(r))
        harmonics = irregular_harmonics(r.x, r.y, r.z, inverse, DEGREE + len(norms))
        powers, q = [1.0], radius * inverse
        total, magnitude, inverse_power, q_power = 0.0, 0.0, inverse, q
        for _ in range(DEGREE):
            powers.append(powers[-1] * radius)
            q_power = q_power * q
        terms = zip(
            coefficient_keys(DEGREE), multipole_to_local(moments, harmonics, DEGREE), strict=True
        )
        coefficients = [term * powers[j] for (j, _, _), term in terms]
        ratio = 1.0
        for l, norm in enumerate(norms, start=1):
            inverse_power = inverse_power * inverse
            factor, ratio = tail_factors(DEGREE, l)
            total, magnitude = (
                total + factor * norm * inverse_power,
                magnitude + norm * inverse_power,
            )
        slope_ratio = ratio * (DEGREE + 2) / (DEGREE + 1)
        tail = total * q_power / (1 - ratio * q)
        slope = (DEGREE + 1) * total * q_power / (1 - slope_ratio * q)
        return cls(coefficients, tail, slope / radius, _ROUNDING * magnitude, inverse)

    def of_cluster(
        self, left_out: Real, slope_left_out: Real, size: Real, area: Real, radius: Real
    ) -> list[Any]:
        """What a cluster of dipoles, expanded from its moments up to degree 4, adds to the
        attributes of `DipoleExpansions`, as a list of numbers.

        left_out, slope_left_out: the numbers E and G of `multipole.truncation_bounds`, which bound
            the terms of higher degree in value and gradient, for points that are no nearer to the
            cluster than the ball is.
        size: the cluster's radius.
        area: the area of its dipoles.
        radius: the radius of the ball.
        """
        distance = dr.rcp(self.inverse)
        inverse_gap = dr.rcp(distance - radius)
        power = inverse_gap
        for _ in range(_MULTIPOLE_DEGREE + 1):
            power = power * inverse_gap
        error = self.rounding + left_out * power
        slope = self.rounding / radius + slope_left_out * power * inverse_gap
        min_distance = distance - size
        bounds = self.tail, self.tail_slope, area * _fourth(dr.rcp(min_distance)), min_distance
        return [*self.coefficients, error, slope, *bounds]


@dataclass(frozen=True)
class PendingSources:
    """The sources that n balls have not yet added to their expansions.

    nodes: for each ball a list of nodes, each of which stands for all its primitives.
    primitives: for each ball a list of primitives, as rows of the tree's primitives.
    """

    nodes: LaneLists
    primitives: LaneLists

    @classmethod
    def of_root(cls, backend: Backend) -> PendingSources:
        """The sources of a single ball that has added none: the root of a tree, which stands for
        all its primitives."""
        return cls(LaneLists.of_root(backend), LaneLists.empty(backend))

    def subset(self, backend: Backend, lanes: IntArray) -> PendingSources:
        """The sources of the balls with these indices. An index may occur several times."""
        return PendingSources(
            self.nodes.subset(backend, lanes), self.primitives.subset(backend, lanes)
        )

    @classmethod
    def concatenate(cls, backend: Backend, parts: list[PendingSources]) -> PendingSources:
        """The sources of the balls of all parts, in the order of `parts`."""
        nodes = LaneLists.concatenate(backend, [part.nodes for part in parts])
        return cls(nodes, LaneLists.concatenate(backend, [part.primitives for part in parts]))

    def split_far(
        self, tree: PackedTree, c: Vec3, radius: Real, factor: float, max_node_radius: Real
    ) -> tuple[DipoleExpansions, PendingSources]:
        """Split the sources of each ball into those that are far from it, which are added up, and
        the remaining ones.

        c: (3, n) the centers of the balls.
        radius: the radius of the balls.
        factor: k of this module: a dipole is far if it is farther than `factor` radii from the
            center.
        max_node_radius: a node that is not far, and no leaf, stays a node if its radius is at most
            this. A larger node is replaced by its children, and a leaf by its primitives, each of
            which is far or near by itself.

        Returns the sums over the far sources, and the remaining sources. Each primitive is in
        exactly one far node, or is itself far, or is among the remaining sources.
        """
        backend, far_radius = tree.backend, factor * radius
        far, pending = (
            build_lists(
                backend,
                lambda store, far=far: _count_nodes(
                    tree, self.nodes, c, far_radius, max_node_radius, store, far=far
                ),
            )
            for far in (True, False)
        )
        far_primitives, near_primitives = (
            build_lists(
                backend,
                lambda store, far=far: self.primitives_of(
                    tree, c, far_radius, max_node_radius, store, far=far
                ),
            )
            for far in (True, False)
        )
        sums = DipoleExpansions.over_nodes(tree, far, c, radius)
        sums = sums.plus(DipoleExpansions.over_primitives(tree, far_primitives, c, radius))
        return sums, PendingSources(pending, near_primitives)

    def primitives_of(
        self,
        tree: PackedTree,
        c: Vec3,
        far_radius: Real,
        max_node_radius: Real,
        store: WriteEntry | None,
        *,
        far: bool,
        count_limit: Any = None,
    ) -> Any:
        """Count the far primitives of each ball, or with far=False its near primitives, and write
        them to lists. `build_lists` calls this function twice, to count and to write. The
        primitives are those in the list `primitives`, and those of the leaves below the listed
        nodes that are not far.

        c: (3, n) the centers of the balls.

        far_radius: k rho: a dipole is far if its distance from c is more than this. For a triangle
            `TRIANGLE_RATIO` times its radius is added.
        max_node_radius: nodes up to this radius stay nodes, so that their primitives are not
            visited.
        store: writes an entry; None to count only.
        count_limit: once a count exceeds this, the remaining primitives need not be counted.

        Returns the number of primitives on each lane.

        A leaf that is far has no near primitives: a triangle's box lies in the ball of its node, of
        radius R. So `TRIANGLE_RATIO` times the triangle's radius is at most 1.5 * 2 R = 3 R, while
        its centroid is farther from c than far_radius + 4 R - R.
        """
        uint_t, vector = tree.backend.UInt32, tree.backend.Array3f
        are_points = tree.primitives.packets_per_record == 1

        def is_chosen(row: list[Real], active: Mask) -> Mask:
            """The mask of the lanes on which the primitive in the record `row` is to be counted: it
            is far, or with far=False near, and its slot is not empty."""
            far_distance = far_radius if are_points else far_radius + row[7]
            is_far = dr.squared_norm(c - vector(*row[:3])) > dr.square(far_distance)
            return (is_far if far else ~is_far) & (row[6] > 0) & active

        def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            """Count, and store, the chosen primitives of a leaf that is not far.

            state: the number of primitives so far.

            Returns whether the walk enters the node, and the new number.
            """
            square = dr.squared_norm(c - vector(*node.head[:3]))
            enters = square <= dr.square(far_radius + node.head[3])
            if are_points and not far:  # only nodes whose ball comes near have near points
                enters &= square <= dr.square(far_radius + node.head[4] * (1 + 1e-9) + 1e-12)
            enters &= node.is_leaf | (node.head[4] > max_node_radius)
            if count_limit is not None:
                enters &= state[0] <= count_limit

            def runs(slot: Any, *_: Any) -> Mask:
                """The mask of the lanes that enter the leaf and have further slots in it."""
                return enters & node.is_leaf & (slot < tree.leaf_size)

            def step(slot: Any, count: Any) -> tuple[Any, ...]:
                """Count, and store, the primitive in a slot of the leaf if it is chosen."""
                chosen = is_chosen(tree.primitive(node.leaf, slot, enters), enters)
                if store is not None:
                    store(count, node.leaf * tree.leaf_size + slot, chosen)
                return slot + 1, count + dr.select(chosen, uint_t(1), uint_t(0))

            return enters, (
                dr.while_loop((uint_t(0), state[0]), runs, step, label="primitives")[1],
            )

        def listed(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Count, and store, primitive i of the list if it is chosen. state: the number of
            primitives so far. Returns the new number."""
            chosen = is_chosen(tree.primitives.read_record(i, active), active)
            if store is not None:
                store(state[0], i, chosen)
            return (state[0] + dr.select(chosen, uint_t(1), uint_t(0)),)

        counts = traverse_subtrees(tree, self.nodes, visit, (uint_t(0),))
        return for_each_entry(tree.backend, self.primitives, listed, counts)[0]


def _count_nodes(
    tree: PackedTree,
    lists: LaneLists,
    c: Vec3,
    far_radius: Real,
    max_node_radius: Real,
    store: WriteEntry | None,
    *,
    far: bool,
) -> Any:
    """Count the far nodes of each ball, or with far=False its pending nodes, and write them to
    lists. `build_lists` calls this function twice, to count and to write. The nodes are those in
    the subtrees of the nodes in `lists`.

    Pending nodes are inner nodes that are not far and have a radius of at most `max_node_radius`.
    Other nodes that are not far are replaced by their children. Leaves that are not far are in
    neither list.

    c: (3, n) the centers of the balls.
    far_radius: k rho, with rho the balls' radius and k > 1: a node of radius R is far if its center
        is farther from c than far_radius + `_NODE_RATIO` R.
    store: a function that writes an entry to a list; None to count only.

    Returns the number of nodes on each lane.
    """
    uint_t, vector = tree.backend.UInt32, tree.backend.Array3f

    def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
        """Count a node, and store its index, if it is of the kind that is sought. In `node.head`,
        entry 3 is `_NODE_RATIO` times the radius of the node and entry 4 is the radius.

        state: the number of nodes so far.

        Returns whether the walk enters the node, and the new number.
        """
        is_far = dr.squared_norm(c - vector(*node.head[:3])) > dr.square(far_radius + node.head[3])
        is_pending = ~is_far & ~node.is_leaf & (node.head[4] <= max_node_radius)
        chosen = is_far if far else is_pending
        if store is not None:
            store(state[0], node.index, chosen)
        return ~(is_far | is_pending), (state[0] + dr.select(chosen, uint_t(1), uint_t(0)),)

    return traverse_subtrees(tree, lists, visit, (uint_t(0),))[0]
