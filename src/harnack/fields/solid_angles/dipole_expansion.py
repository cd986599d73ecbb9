"""Local expansions of far dipoles and triangles in balls, and bounds of their truncation errors.

- `source_tree`: a tree of primitives, dipoles or triangles, in double precision, with all data that
  expansions need; `triangle_sources`: triangles as records.
- `DipoleExpansions`: sums over far nodes and far primitives.
- `PendingSources`: the primitives of balls, split into such sums and the sources that are left to
  smaller balls.

A node of radius R is far from a ball of radius rho if their centers are farther apart than k rho +
`_NODE_RATIO` R, a triangle if they are farther apart than k rho + `TRIANGLE_RATIO` R, a dipole if
it is farther from the ball's center than k rho, for a factor k > 1: then all points of it are
farther from the center than k rho. A triangle is a sheet of dipoles, along its normal.
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
    """The tree of primitives. Its nodes hold: center, `_NODE_RATIO` times the radius, radius, area
    | moments up to `_MULTIPOLE_DEGREE`, (E, G) of `multipole.truncation_bounds`, and the sup norms
    of the moments.

    rows: primitives in slots, dipoles (`treecode.dipole_records`) or `triangle_sources`.
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
    """The real or imaginary parts (k,) of the moments of nodes with these keys."""
    return [level.moments[l, m].imag if part else level.moments[l, m].real for l, m, part in keys]


def triangle_sources(corners: FloatArray) -> FloatArray:
    """(n, 30) records of triangles (n, 3, 3): centroid, area times normal, area, `TRIANGLE_RATIO`
    times the radius | radius, (E, G) of `multipole.truncation_bounds`, the sup norms of the moments
    1, 3 and 4, and the moments 3 and 4.

    The second moment about the centroid is a mean of vectors from there, and so is 0. A triangle
    whose area is rounded to 0 gets an area of 1e-30: records without an area are empty slots, and
    its edges count.
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
    """Sums over far primitives of n balls.

    coefficients: (n, COEFFICIENTS) of the local expansion (`local_expansion.coefficient_keys`).
    error, slope: (n,) bounds of the truncation errors of value and gradient, anywhere in the ball.
    tail, tail_slope: (n,) bounds of further truncation errors: at a distance a from the center at
        most q^(p+1) and q^p times these, with q = a/radius and p = `DEGREE`.
    s4: (n,) bounds of the sums of area/D^4, D the smallest distance of a primitive from the center.
    min_distance: (n,) a distance from the center within which there are none of these primitives.
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
        """Sums over no primitives."""
        zero = np.zeros(n)
        return cls(np.zeros((n, COEFFICIENTS)), *(5 * [zero]), min_distance=np.full(n, np.inf))

    def plus(self, other: DipoleExpansions) -> DipoleExpansions:
        """The sums over the primitives of both operands."""
        bounds = "error", "slope", "tail", "tail_slope", "s4"
        sums = (_ROUNDED_UP * (getattr(self, name) + getattr(other, name)) for name in bounds)
        min_distance = np.minimum(self.min_distance, other.min_distance)
        return DipoleExpansions(
            self.coefficients + other.coefficients, *sums, min_distance=min_distance
        )

    def subset(self, indices: IntArray) -> DipoleExpansions:
        """The sums of the balls with these indices; a ball may occur several times."""
        return DipoleExpansions(*(values[indices] for values in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: list[DipoleExpansions]) -> DipoleExpansions:
        """The sums of all balls, in the order of `parts`."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def to_octants(self, shifts: FloatArray, radius: float) -> DipoleExpansions:
        """The same sums about the centers of the eight octants of cells with balls of this radius,
        all octants of a cell in a row.

        Proof. The ball of an octant lies in that of the cell, so that bounds of errors are bounds
        there as well, but the truncation error of the polynomial is not small about an octant's
        center. This center is half a radius away, or less by the margin, so that distances shrink
        by at most that, and 1/D^4 grows by at most (1 - radius/(2 least))^-4, D >= least.
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
        """Sums over listed far nodes, for balls around c."""

        def term(i: Any, active: Mask) -> list[Any]:
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
        """Sums over listed far primitives, for balls around c."""

        def term(i: Any, active: Mask) -> list[Any]:
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
        """The sums of `term` over the entries of lists.

        term: from an entry of a list, all numbers, the last of which is a minimum.
        """
        zero = backend.Float(0)

        def add(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
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
    square = number * number
    return square * square


def _pairs(numbers: dict[Any, Any]) -> dict[tuple[int, int], tuple[Any, Any]]:
    return {
        (l, m): (numbers[l, m, 0], numbers.get((l, m, 1), 0.0))
        for l, m, part in numbers
        if not part
    }


@dataclass(frozen=True)
class _ClusterExpansion:
    """The local expansion of multipole terms.

    coefficients: coefficients times powers of the ball's radius.
    tail, tail_slope: bounds of the truncation errors of value and gradient on the ball's sphere.
    rounding: a bound of the rounding of the value.
    inverse: one over the distance.
    """

    coefficients: list[Any]
    tail: Any
    tail_slope: Any
    rounding: Any
    inverse: Any

    @classmethod
    def of(cls, r: Vec3, moments: Any, norms: list[Any], radius: Real) -> _ClusterExpansion:
        """The expansion of multipole terms in the ball of this radius.

        r: from the multipoles to the ball's center.
        norms: of the terms l = 1, 2, ...: term l is at most norms[l-1]/r^(l+1).

        The bounds are those of `tail_factors`, whose c grows with l: they bound all terms of degree
        j > p, so that at q times the radius, q <= 1, the truncation error is q^(p+1) times as much,
        and q^p times as much for the gradient.

        Rounding, in double precision: each product of a coefficient passes through fewer than 2^10
        roundings, its shifts to smaller cells included, and the sum of the absolute values of all
        products, with those of the harmonics of the ball, is below 2^23 norms[l-1]/r^(l+1) (tests
        compute it). So value, and gradient times the radius, are off by at most 2^-20 of that.
        """
        inverse = dr.rsqrt(dr.squared_norm(r))
        harmonics = irregular_harmonics(r.x, r.y, r.z, inverse, DEGREE + len(norms))
        powers, q = [1.0], radius * inverse
        total, magnitude, u, power = 0.0, 0.0, inverse, q
        for _ in range(DEGREE):
            powers.append(powers[-1] * radius)
            power = power * q
        terms = zip(
            coefficient_keys(DEGREE), multipole_to_local(moments, harmonics, DEGREE), strict=True
        )
        coefficients = [term * powers[j] for (j, _, _), term in terms]
        ratio = 1.0
        for l, norm in enumerate(norms, start=1):
            u = u * inverse
            factor, ratio = tail_factors(DEGREE, l)
            total, magnitude = total + factor * norm * u, magnitude + norm * u
        slope_ratio = ratio * (DEGREE + 2) / (DEGREE + 1)
        tail = total * power / (1 - ratio * q)
        slope = (DEGREE + 1) * total * power / (1 - slope_ratio * q)
        return cls(coefficients, tail, slope / radius, _ROUNDING * magnitude, inverse)

    def of_cluster(
        self, left_out: Real, slope_left_out: Real, size: Real, area: Real, radius: Real
    ) -> list[Any]:
        """The numbers of `DipoleExpansions` for a cluster of dipoles with moments up to
        `_MULTIPOLE_DEGREE`.

        left_out, slope_left_out: (E, G) of `multipole.truncation_bounds`, for points that are no
            nearer than the ball.
        size: the cluster's radius.
        area: the area of its dipoles.
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
    """Sources that balls have still to take into account: for each ball a list of nodes, whose
    primitives all count, and a list of primitives, as rows of the tree's primitives."""

    nodes: LaneLists
    primitives: LaneLists

    @classmethod
    def of_root(cls, backend: Backend) -> PendingSources:
        """All primitives of a tree, for one ball."""
        return cls(LaneLists.of_root(backend), LaneLists.empty(backend))

    def subset(self, backend: Backend, lanes: IntArray) -> PendingSources:
        """The sources of the balls with these indices; a ball may occur several times."""
        return PendingSources(
            self.nodes.subset(backend, lanes), self.primitives.subset(backend, lanes)
        )

    @classmethod
    def concatenate(cls, backend: Backend, parts: list[PendingSources]) -> PendingSources:
        """The sources of all balls, in the order of `parts`."""
        nodes = LaneLists.concatenate(backend, [part.nodes for part in parts])
        return cls(nodes, LaneLists.concatenate(backend, [part.primitives for part in parts]))

    def split_far(
        self, tree: PackedTree, c: Vec3, radius: Real, factor: float, smallest: Real
    ) -> tuple[DipoleExpansions, PendingSources]:
        """The sums over the sources farther than `factor` radii from the centers c of balls, and
        the remaining sources.

        smallest: inner nodes up to this radius stay nodes if they are not far. Larger nodes are
            replaced by their children, and leaves by their primitives, which are far or near.

        Each primitive is in exactly one far node, or is itself far, or is among the remaining
        sources.
        """
        backend, inner = tree.backend, factor * radius
        far, pending = (
            build_lists(
                backend,
                lambda put, far=far: _nodes(tree, self.nodes, c, inner, smallest, put, far=far),
            )
            for far in (True, False)
        )
        far_primitives, near_primitives = (
            build_lists(
                backend,
                lambda put, far=far: self.primitives_of(tree, c, inner, smallest, put, far=far),
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
        inner: Real,
        smallest: Real,
        put: WriteEntry | None,
        *,
        far: bool,
        max_count: Any = None,
    ) -> Any:
        """The number of far primitives, of the list of primitives and of leaves that are not far,
        or with far = False the number of the other primitives; for `build_lists`. A primitive is
        far if it is farther from c than `inner` and its reach. If there are more than `max_count`,
        not all may be counted.

        A leaf that is far has no near primitives. A triangle's box lies in the ball of its node, so
        that the triangle's radius is at most the diameter of that ball: its centroid is farther
        from c than inner + 4 R - R, and the reach is at most 1.5 * 2 R.
        """
        index, vector = tree.backend.UInt32, tree.backend.Array3f
        are_points = tree.primitives.packets_per_record == 1

        def is_chosen(row: list[Real], active: Mask) -> Mask:
            reach = inner if are_points else inner + row[7]
            is_far = dr.squared_norm(c - vector(*row[:3])) > dr.square(reach)
            return (is_far if far else ~is_far) & (row[6] > 0) & active

        def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            square = dr.squared_norm(c - vector(*node.head[:3]))
            enters = square <= dr.square(inner + node.head[3])
            if are_points and not far:  # only nodes whose ball comes near have near points
                enters &= square <= dr.square(inner + node.head[4] * (1 + 1e-9) + 1e-12)
            enters &= node.is_leaf | (node.head[4] > smallest)
            if max_count is not None:
                enters &= state[0] <= max_count

            def runs(slot: Any, *_: Any) -> Mask:
                return enters & node.is_leaf & (slot < tree.leaf_size)

            def step(slot: Any, count: Any) -> tuple[Any, ...]:
                chosen = is_chosen(tree.primitive(node.leaf, slot, enters), enters)
                if put is not None:
                    put(count, node.leaf * tree.leaf_size + slot, chosen)
                return slot + 1, count + dr.select(chosen, index(1), index(0))

            return enters, (dr.while_loop((index(0), state[0]), runs, step, label="primitives")[1],)

        def listed(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            chosen = is_chosen(tree.primitives.read_record(i, active), active)
            if put is not None:
                put(state[0], i, chosen)
            return (state[0] + dr.select(chosen, index(1), index(0)),)

        counts = traverse_subtrees(tree, self.nodes, visit, (index(0),))
        return for_each_entry(tree.backend, self.primitives, listed, counts)[0]


def _nodes(
    tree: PackedTree,
    lists: LaneLists,
    c: Vec3,
    inner: Real,
    smallest: Real,
    put: WriteEntry | None,
    *,
    far: bool,
) -> Any:
    """The number of nodes in listed subtrees that are far from c, or with far = False the number of
    pending inner nodes, which are not far and have a radius of at most `smallest`; for
    `build_lists`. Other nodes are replaced by their children; leaves that are not far are in
    neither list."""
    index, vector = tree.backend.UInt32, tree.backend.Array3f

    def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
        is_far = dr.squared_norm(c - vector(*node.head[:3])) > dr.square(inner + node.head[3])
        is_pending = ~is_far & ~node.is_leaf & (node.head[4] <= smallest)
        chosen = is_far if far else is_pending
        if put is not None:
            put(state[0], node.index, chosen)
        return ~(is_far | is_pending), (state[0] + dr.select(chosen, index(1), index(0)),)

    return traverse_subtrees(tree, lists, visit, (index(0),))[0]
