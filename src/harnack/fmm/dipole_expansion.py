"""Local expansions of far sources in balls, with bounds of their truncation errors. The primitives
are dipoles, or triangles, each of which counts as a sheet of dipoles along its normal. f is the sum
of the potentials of all primitives. A source is a primitive, or a node of a tree, which stands for
all its primitives. The local expansion of sources is a harmonic polynomial that approximates their
potential in a ball around a cell of an octree. It has a finite degree; the truncation error is the
error from all terms of higher degree.

- `source_tree`: a tree of primitives in double precision, with all data that expansions need;
  `triangle_sources`: triangles as records.
- `DipoleExpansions`: the sums over the far sources of balls, as local expansions with error bounds.
- `PendingSources`: the sources that balls have not yet added to their expansions.

Sources are far from a ball of radius rho by these rules, with a factor k > 1. A node of radius R is
far if its center is farther than k rho + `_NODE_RATIO` R from the ball's center. For a triangle of
radius R this distance is k rho + `TRIANGLE_RATIO` R, for a dipole k rho. So all points of a far
source are farther from the ball's center than k rho.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.elementary import fmin
from harnack.fmm.local_expansion import (
    coefficient_keys,
    irregular_harmonics,
    multipole_to_local,
    tail_factors,
)
from harnack.fmm.multipole import (
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

# The degree of local expansions; and the largest degree of the multipole terms from which they are
# computed.
DEGREE, _MULTIPOLE_DEGREE = 6, 4
COEFFICIENTS = (DEGREE + 1) ** 2
# A node is far from a ball of radius rho beyond k rho plus this many times the node's radius.
_NODE_RATIO = 4.0
# The same factor for triangles, by experiment; and the moments that a triangle's record has besides
# the first one, as keys (degree, order, 0 for real or 1 for imaginary part).
TRIANGLE_RATIO = 1.5
_TRIANGLE_MOMENTS = tuple(key for key in coefficient_keys(_MULTIPOLE_DEGREE) if key[0] > 2)
# The number of entries of a dipole's record, and of a triangle's record before its moments.
_DIPOLE_SIZE, _TRIANGLE_HEADER_SIZE = 8, 14
# The relative rounding of a term, with the proof in `_ClusterExpansion.of`.
_ROUNDING = 2.0**-20
# The keys of the moments in a node's record, in order.
_MOMENTS = tuple(key for key in coefficient_keys(_MULTIPOLE_DEGREE) if key[0])
# Factor by which sums of many positive numbers in double precision become bounds.
_ROUNDED_UP = 1 + 1e-9


def source_tree(tree: BalancedTree, levels: list[NodeMoments], rows: FloatArray) -> PackedTree:
    """Pack a tree of primitives for a backend in double precision, with the records that expansions
    need.

    tree: the hierarchy of the tree: which primitives are in which node.
    levels: the multipole moments of the tree's nodes, one entry for each level of the tree.
    rows: the records of the primitives, in the slots of the tree's leaves: dipoles from
        `treecode.dipole_records`, or triangles from `triangle_sources`.

    A node's record holds: center, `_NODE_RATIO` times the radius, radius, area; then its moments up
    to degree 4; the bounds E and G of the terms beyond degree 4 in value and gradient
    (`multipole.truncation_bounds`); and for each degree a bound of its term (`multipole.sup_norm`).
    """
    records: list[FloatArray] = []
    for level in levels:
        # Points at which the node's moments are used are farther than `reach` from its center.
        # An order of 3 means terms up to degree 4.
        reach = _NODE_RATIO * level.radius
        error, slope, _ = truncation_bounds(level, reach, _MULTIPOLE_DEGREE - 1)
        moments = _columns(level, _MOMENTS)
        norms = [sup_norm(level.moments, l) for l in range(1, _MULTIPOLE_DEGREE + 1)]
        head = [level.center, reach, level.radius, level.area]
        records.append(np.column_stack([*head, *moments, error, slope, *norms]))
    return pack_tree(choose_backend("double"), tree, records, rows)


def _columns(level: NodeMoments, keys: Iterable[tuple[int, int, int]]) -> list[FloatArray]:
    """List the real or imaginary parts of the moments with these keys. A key is (degree, order,
    part), where part is 0 for the real and 1 for the imaginary part. For each key there is one
    array, with an entry for each node.

    level: the moments of the nodes at one level of the tree.
    """
    return [level.moments[l, m].imag if part else level.moments[l, m].real for l, m, part in keys]


def triangle_sources(corners: FloatArray) -> FloatArray:
    """Make the records (n, 30) of triangles (n, 3, 3), with the data that expansions need.

    A record holds: centroid, area times normal, area, `TRIANGLE_RATIO` times the radius of the
    triangle; then this radius, the bounds E of the value and G of the gradient of all terms beyond
    degree 4 (`multipole.truncation_bounds`), bounds of the terms of degrees 1, 3 and 4
    (`multipole.sup_norm`), and the moments of degrees 3 and 4.

    The moment of degree 2 about the centroid is a mean of offsets from the centroid, and so is 0. A
    triangle whose area is rounded to 0 gets an area of 1e-30, because records without an area are
    skipped as empty slots. This triangle must not be skipped: near triangles are summed by their
    edges, which cancel where triangles meet, and its edges cancel those of its neighbors.
    """
    # A tree in which each leaf is one triangle, to compute its moments.
    leaves = BalancedTree(np.arange(len(corners), dtype=np.int64)[:, None], ())
    level = triangle_tree_moments(leaves, corners)[0]  # the leaves; it has no other level
    moments, reach = level.moments, TRIANGLE_RATIO * level.radius
    error, slope, _ = truncation_bounds(level, reach, _MULTIPOLE_DEGREE - 1)
    # Area times normal, from the moments M_11 and M_10 (`multipole.dipole_moments`).
    normal = 2 * moments[1, 1].real, 2 * moments[1, 1].imag, moments[1, 0].real
    higher = _columns(level, _TRIANGLE_MOMENTS)
    norms = [sup_norm(moments, l) for l in (1, 3, 4)]
    head = [level.center, *normal, np.maximum(level.area, 1e-30), reach, level.radius]
    return np.column_stack([*head, error, slope, *norms, *higher])


@dataclass(frozen=True)
class DipoleExpansions:
    """Sums over the far primitives (dipoles or triangles) of n balls. For each ball their potential
    is approximated by a local expansion, a harmonic polynomial, with bounds of its errors in the
    ball.

    coefficients: (n, COEFFICIENTS) of the local expansion (`local_expansion.coefficient_keys`).
    error, slope: (n,) bounds of the truncation errors of value and gradient, anywhere in the ball.
    tail, tail_slope: (n,) bounds of further truncation errors of value and gradient, which are
        smaller near the center: at a distance of q times the ball's radius from the center they are
        at most q^(p+1) `tail` and q^p `tail_slope`, with p = `DEGREE`.
    s4: (n,) upper bounds of the sum of area/D^4 over the primitives, where D is the distance of the
        primitive's nearest point from the ball's center.
    min_distance: (n,) a lower bound of the distances D.
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
        """Make the sums of n balls that have no far primitives: zeros, with an infinite smallest
        distance."""
        zero = np.zeros(n)
        return cls(np.zeros((n, COEFFICIENTS)), *(5 * [zero]), min_distance=np.full(n, np.inf))

    def plus(self, other: DipoleExpansions) -> DipoleExpansions:
        """Add the sums over other primitives, for the same balls."""
        bounds = "error", "slope", "tail", "tail_slope", "s4"
        sums = (_ROUNDED_UP * (getattr(self, name) + getattr(other, name)) for name in bounds)
        min_distance = np.minimum(self.min_distance, other.min_distance)
        return DipoleExpansions(
            self.coefficients + other.coefficients, *sums, min_distance=min_distance
        )

    def subset(self, which: IntArray) -> DipoleExpansions:
        """Select the sums of the balls with the indices `which`. An index may occur several
        times."""
        return DipoleExpansions(*(values[which] for values in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: list[DipoleExpansions]) -> DipoleExpansions:
        """Join the sums of several groups of balls, in the order of `parts`."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def to_octants(self, shifts: FloatArray, radius: float) -> DipoleExpansions:
        """Move the expansion of each cell to the centers of the cell's eight octants. The results
        are 8 n sums; the octants of a cell follow each other.

        shifts: (8, COEFFICIENTS, COEFFICIENTS) matrices from
            `local_expansion.local_to_local_matrices`.
        radius: the radius of the cells' balls.

        Proof. The ball of an octant lies in the ball of its cell, so that bounds of errors hold
        there as well. But the truncation error of the polynomial is not small about an octant's
        center, so `tail` is added to `error`. An octant's center is at most half a radius from the
        cell's center, so that distances shrink by at most that. So 1/D^4 grows at most by the
        factor (1 - radius/(2 d))^-4 for D >= d, with d = `min_distance`.
        """
        shifted = np.einsum("oab,kb->koa", shifts, self.coefficients)
        ratio = 0.5 * radius / self.min_distance  # 0 where there are no primitives
        error, slope = self.error + self.tail, self.slope + self.tail_slope
        far = self.s4 / (1 - ratio) ** 4, self.min_distance - 0.5 * radius
        # In the order of the attributes: error, slope, tail, tail_slope, s4, min_distance.
        bounds = _ROUNDED_UP * error, _ROUNDED_UP * slope, 0 * error, 0 * slope, *far
        repeated = (np.repeat(bound, 8) for bound in bounds)
        return DipoleExpansions(shifted.reshape(-1, COEFFICIENTS), *repeated)

    @classmethod
    def over_nodes(
        cls, tree: PackedTree, lists: LaneLists, c: Vec3, radius: Real
    ) -> DipoleExpansions:
        """Sum over the far nodes of n balls: each node's moments give a local expansion in the
        ball.

        tree: the tree of the primitives (`source_tree`).
        lists: for each ball, the list of the indices of its far nodes in the tree.
        c: (3, n) the centers of the balls.
        radius: the radius of the balls.
        """

        def term(i: Any, active: Mask) -> list[Any]:
            """Compute what node i of the tree adds to the attributes of `DipoleExpansions`, for
            balls with the centers c, in the order of the attributes, as a flat list of numbers.
            active: the mask of the lanes that have this node."""
            # The record of the node, in the order of `source_tree`.
            head, payload = tree.node_heads.read_record(i, active), tree.payload(i, active)
            moments = dict(zip(_MOMENTS, payload, strict=False))
            error, slope_error, *norms = payload[len(_MOMENTS) :]
            r = c - tree.backend.Array3f(*head[:3])
            expansion = _ClusterExpansion.of(r, _pairs(moments), norms, radius)
            # head[4] and head[5]: the radius and the area of the node.
            return expansion.of_cluster(error, slope_error, head[4], head[5], radius)

        return cls._accumulated(tree.backend, lists, term)

    @classmethod
    def over_primitives(
        cls, tree: PackedTree, lists: LaneLists, c: Vec3, radius: Real
    ) -> DipoleExpansions:
        """Sum over the far primitives of n balls, one primitive at a time.

        tree: the tree of the primitives (`source_tree`).
        lists: for each ball, the list of the indices of its far primitives.
        c: (3, n) the centers of the balls.
        radius: the radius of the balls.
        """

        def term(i: Any, active: Mask) -> list[Any]:
            """Compute what primitive i of the tree, a dipole or a triangle, adds to the attributes
            of `DipoleExpansions`, for balls with the centers c, in the order of the attributes, as
            a flat list of numbers. active: the mask of the lanes that have this primitive."""
            # row: position, area times normal, area; of a triangle all of `triangle_sources`.
            row = tree.primitives.read_record(i, active)
            # The moments of degree 1, from area times normal.
            first_moments = {(1, 0): (row[5], 0.0), (1, 1): (0.5 * row[3], 0.5 * row[4])}
            r = c - tree.backend.Array3f(*row[:3])
            if tree.primitives.packets_per_record == 1:  # a dipole, which has no further moments
                expansion = _ClusterExpansion.of(r, first_moments, [row[6]], radius)
                bounds = (
                    expansion.rounding,
                    expansion.rounding / radius,
                    expansion.tail,
                    expansion.tail_slope,
                )
                # expansion.inverse is 1/r, and row[6] the area. The last two numbers are area/r^4,
                # a term of `s4`, and the distance r, of which the smallest is kept.
                distance_terms = (
                    row[6] * _fourth_power(expansion.inverse),
                    dr.rcp(expansion.inverse),
                )
                return [*expansion.coefficients, *bounds, *distance_terms]
            size, error, slope_error, *norms = row[_DIPOLE_SIZE:_TRIANGLE_HEADER_SIZE]
            higher = dict(zip(_TRIANGLE_MOMENTS, row[_TRIANGLE_HEADER_SIZE:], strict=False))
            norms.insert(1, 0 * size)  # a triangle's moment of degree 2 is 0
            expansion = _ClusterExpansion.of(r, first_moments | _pairs(higher), norms, radius)
            return expansion.of_cluster(error, slope_error, size, row[6], radius)

        return cls._accumulated(tree.backend, lists, term)

    @classmethod
    def _accumulated(
        cls, backend: Backend, lists: LaneLists, term: Callable[[Any, Mask], list[Any]]
    ) -> DipoleExpansions:
        """Add up the terms of all entries of each ball's list.

        lists: for each ball a list of sources.
        term: a function that returns what a source adds to the attributes of `DipoleExpansions`, as
            a flat list of numbers. Its arguments are the source's index and a mask of active lanes.
            The last number, for `min_distance`, is used in a minimum; all others are added up.
        """
        zero = backend.Float(0)

        def add(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the term of source i to the state, on active lanes. The last number of the state
            is a minimum, all other numbers are sums. Returns the new state."""
            *sums, minimum = state
            *added, nearest = term(i, active)
            pairs = zip(sums, added, strict=True)
            new = [old + dr.select(active, values, 0) for old, values in pairs]
            return *new, dr.select(active, fmin(minimum, nearest), minimum)

        # Five bounds are sums, and the last attribute is a minimum.
        start = (*([zero] * (COEFFICIENTS + 5)), zero + dr.inf)
        totals = for_each_entry(backend, lists, add, start)
        dr.eval(*totals)
        n = dr.width(lists.count)
        columns = [np.broadcast_to(to_numpy(values), n) for values in totals]
        coefficients = np.stack(columns[:COEFFICIENTS], axis=1)
        # Rounding must not make upper bounds smaller, nor the lower bound of distances larger.
        bounds = (values * _ROUNDED_UP for values in columns[COEFFICIENTS:-1])
        return cls(coefficients, *bounds, min_distance=columns[-1] / _ROUNDED_UP)


def _fourth_power(number: Any) -> Any:
    """Compute the fourth power of a number."""
    square = number * number
    return square * square


def _pairs(numbers: dict[Any, Any]) -> dict[tuple[int, int], tuple[Any, Any]]:
    """Join the real and imaginary parts of moments to pairs. The keys of `numbers` are (degree,
    order, part), where part is 0 for the real and 1 for the imaginary part. The keys of the result
    are (degree, order), and its values are pairs (real part, imaginary part)."""
    return {
        (l, m): (numbers[l, m, 0], numbers.get((l, m, 1), 0.0))
        for l, m, part in numbers
        if not part
    }


@dataclass(frozen=True)
class _ClusterExpansion:
    """The local expansion (a harmonic polynomial), in a ball, of the potential of one source: a
    node, a triangle or a dipole, given by its multipole moments about its center.

    coefficients: the coefficients of the polynomial. That of a term of degree j is multiplied by
        the ball's radius to the power j.
    tail, tail_slope: bounds of the truncation errors of value and gradient on the ball's sphere.
    rounding: a bound of the rounding of the value.
    inverse: one over the distance of the source's center from the ball's center.
    """

    coefficients: list[Any]
    tail: Any
    tail_slope: Any
    rounding: Any
    inverse: Any

    @classmethod
    def of(cls, r: Vec3, moments: Any, norms: list[Any], radius: Real) -> _ClusterExpansion:
        """Expand the multipole terms of a source in a ball.

        r: (3, n) the vector from the source's center to the ball's center.
        moments: a dictionary of the source's moments, as pairs of real and imaginary part, by
            (degree, order).
        norms: norms[l-1] bounds the multipole term of degree l = 1, 2, ...: at a distance d from
            the source's center this term is at most norms[l-1]/d^(l+1).
        radius: the radius of the ball.

        Truncation. `tail_factors` bounds the terms of degree j > p of the polynomial, where
        p = `DEGREE`; the ratio c of its geometric series grows with l, so that of the largest l is
        used for all. At q times the radius, q <= 1, the truncation error is at most q^(p+1) times
        as much as on the sphere, and that of the gradient q^p times as much.

        Rounding, in double precision. For a multipole term of degree l, the value in the ball is a
        sum of products: of a moment, an irregular harmonic at r (these two make a coefficient), and
        a harmonic at the point of the ball. Each product passes through fewer than 2^10 roundings,
        including those of shifts to smaller cells. The sum of the absolute values of all products
        is below 2^23 norms[l-1]/|r|^(l+1) (a test computes it). As a rounding is at most 2^-53 of
        its number, the value, and the gradient times the radius, are off by at most 2^-20 of
        norms[l-1]/|r|^(l+1).
        """
        # powers: of the radius. inverse_power: 1/|r|^(l+1) in the loop over l; q_power: q^(p+1).
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
        # total: the sum over l of the factor times the term's bound; magnitude: without the factor.
        ratio = 1.0
        for l, norm in enumerate(norms, start=1):
            inverse_power = inverse_power * inverse
            factor, ratio = tail_factors(DEGREE, l)
            total, magnitude = (
                total + factor * norm * inverse_power,
                magnitude + norm * inverse_power,
            )
        # Geometric series. A term of degree j has a gradient of at most j/radius times its largest
        # value on the sphere; j grows from each term to the next by at most the factor
        # (p + 2)/(p + 1).
        slope_ratio = ratio * (DEGREE + 2) / (DEGREE + 1)
        tail = total * q_power / (1 - ratio * q)
        slope = (DEGREE + 1) * total * q_power / (1 - slope_ratio * q)
        return cls(coefficients, tail, slope / radius, _ROUNDING * magnitude, inverse)

    def of_cluster(
        self, left_out: Real, slope_left_out: Real, size: Real, area: Real, radius: Real
    ) -> list[Any]:
        """Compute what a source with an extent (a node or a triangle) adds to the attributes of
        `DipoleExpansions`, in their order, as a flat list of numbers. The source was expanded from
        its moments up to degree 4.

        left_out, slope_left_out: the numbers E and G of `multipole.truncation_bounds`, which bound
            the multipole terms of higher degree in value and gradient, at the distances of the
            points of the ball.
        size: the source's radius.
        area: the sum of the areas of its dipoles.
        radius: the radius of the ball.
        """
        # self.inverse: one over the distance of the source's center from the ball's center.
        # All points of the ball are at least this gap away from the source's center: the distance
        # of the ball's center, minus the ball's radius.
        distance = dr.rcp(self.inverse)
        inverse_gap = dr.rcp(distance - radius)
        # power: 1/gap^(k+1) for the first degree k that is left out, one more than
        # `_MULTIPOLE_DEGREE`.
        power = inverse_gap
        for _ in range(_MULTIPOLE_DEGREE + 1):
            power = power * inverse_gap
        error = self.rounding + left_out * power
        slope = self.rounding / radius + slope_left_out * power * inverse_gap
        min_distance = distance - size
        bounds = (
            self.tail,
            self.tail_slope,
            area * _fourth_power(dr.rcp(min_distance)),
            min_distance,
        )
        return [*self.coefficients, error, slope, *bounds]


@dataclass(frozen=True)
class PendingSources:
    """The sources (nodes of a tree, or single primitives) that n balls have not yet added to their
    local expansions. A primitive is a dipole or a triangle; a node stands for all its primitives. A
    ball adds the sources that are far from it, and leaves the others to the smaller balls in it.

    nodes: for each ball a list of the indices of nodes.
    primitives: for each ball a list of the indices of primitives.
    """

    nodes: LaneLists
    primitives: LaneLists

    @classmethod
    def of_root(cls, backend: Backend) -> PendingSources:
        """Make the sources of a single ball that has added nothing yet: the root of the tree, which
        stands for all primitives."""
        return cls(LaneLists.of_root(backend), LaneLists.empty(backend))

    def subset(self, backend: Backend, lanes: IntArray) -> PendingSources:
        """Select the sources of the balls with the indices `lanes`. An index may occur several
        times."""
        return PendingSources(
            self.nodes.subset(backend, lanes), self.primitives.subset(backend, lanes)
        )

    @classmethod
    def concatenate(cls, backend: Backend, parts: list[PendingSources]) -> PendingSources:
        """Join the sources of several groups of balls, in the order of `parts`."""
        nodes = LaneLists.concatenate(backend, [part.nodes for part in parts])
        return cls(nodes, LaneLists.concatenate(backend, [part.primitives for part in parts]))

    def split_far(
        self, tree: PackedTree, c: Vec3, radius: Real, factor: float, max_node_radius: Real
    ) -> tuple[DipoleExpansions, PendingSources]:
        """Split the sources of each ball into far sources, which are added up, and the remaining
        sources.

        tree: the tree of the primitives.
        c: (3, n) the centers of the balls.
        radius: the radius of the balls.
        factor: a dipole is far if it is farther than `factor` radii from the center of the ball.
        max_node_radius: an inner node that is not far remains a node if its radius is at most this.
            A larger one is replaced by its children, and a leaf by its primitives, each of which
            is far or near by itself.

        Returns the sums over the far sources, and the remaining sources. Each primitive is in
        exactly one far node, or is itself far, or is among the remaining sources.
        """
        backend, far_radius = tree.backend, factor * radius
        # `is_far=is_far` binds the value of this pass of the loop.
        far_nodes, pending_nodes = (
            build_lists(
                backend,
                lambda store, is_far=is_far: _count_nodes(
                    tree, self.nodes, c, far_radius, max_node_radius, store, far=is_far
                ),
            )
            for is_far in (True, False)
        )
        far_primitives, near_primitives = (
            build_lists(
                backend,
                lambda store, is_far=is_far: self.primitives_of(
                    tree, c, far_radius, max_node_radius, store, far=is_far
                ),
            )
            for is_far in (True, False)
        )
        sums = DipoleExpansions.over_nodes(tree, far_nodes, c, radius)
        sums = sums.plus(DipoleExpansions.over_primitives(tree, far_primitives, c, radius))
        return sums, PendingSources(pending_nodes, near_primitives)

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
        their indices to lists. `build_lists` calls this function twice, to count and to write.

        The search goes through two sets: the primitives in the list `primitives`; and the
        primitives in leaves that are not far, in the subtrees of the nodes in the list `nodes`. The
        search does not enter a node that is far, nor an inner node whose radius is at most
        `max_node_radius`, which stays in a list of nodes (`split_far`).

        tree: the tree of the primitives.
        c: (3, n) the centers of the balls.
        far_radius: a dipole is far if its distance from c is more than this, which is k times the
            radius of the balls. For a triangle `TRIANGLE_RATIO` times its radius is added.
        max_node_radius: the largest radius of inner nodes that are not entered; negative to enter
            all that are not far.
        store: a function that writes an entry; None to count only.
        far: whether far primitives are sought, and not near ones.
        count_limit: once a count exceeds this, the remaining primitives need not be counted.

        Returns the number of primitives on each lane.

        Proof that a far leaf has no near primitives. A triangle's box lies in the ball of its leaf,
        of radius R. So `TRIANGLE_RATIO` times the triangle's radius is at most 1.5 * 2 R = 3 R,
        while its centroid is farther from c than far_radius + 4 R - R.
        """
        uint_t, vector = tree.backend.UInt32, tree.backend.Array3f
        are_points = tree.primitives.packets_per_record == 1

        def is_chosen(row: list[Real], active: Mask) -> Mask:
            """Decide on which active lanes a primitive is counted: it is far, or with far=False
            near, and its slot is not empty (its area is positive). row: the primitive's record."""
            # row[6]: the area. row[7]: for a triangle, `TRIANGLE_RATIO` times its radius.
            far_distance = far_radius if are_points else far_radius + row[7]
            is_far = dr.squared_norm(c - vector(*row[:3])) > dr.square(far_distance)
            return (is_far if far else ~is_far) & (row[6] > 0) & active

        def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            """Visit a node of the tree, for a ball with the center c on each lane. In a leaf that
            is not far, count and store the primitives that are sought: the far ones, or with
            far=False the near ones. A dipole is far if it is farther than `far_radius` from c. Only
            inner nodes with a radius of more than `max_node_radius` are entered.

            node: its `head` holds center, `_NODE_RATIO` times the radius, and radius.
            state: a tuple with the number of primitives so far.

            Returns the mask of the lanes that enter the node, and the new number, in a tuple.
            """
            square = dr.squared_norm(c - vector(*node.head[:3]))
            enters = square <= dr.square(far_radius + node.head[3])
            # If the primitives are dipoles (`are_points`), only nodes whose ball comes near have
            # near ones; the radius (head[4]) is increased
            # a little against rounding.
            if are_points and not far:
                enters &= square <= dr.square(far_radius + node.head[4] * (1 + 1e-9) + 1e-12)
            enters &= node.is_leaf | (node.head[4] > max_node_radius)
            # Lanes that have counted enough stop; `count_limit` is None for no such limit.
            if count_limit is not None:
                enters &= state[0] <= count_limit

            def runs(slot: Any, *_: Any) -> Mask:
                """Whether the loop goes on, on each lane: the lane enters a leaf, and the leaf has
                this slot."""
                return enters & node.is_leaf & (slot < tree.leaf_size)

            def step(slot: Any, count: Any) -> tuple[Any, ...]:
                """Count and store the primitive in a slot of the leaf if it is sought. count: the
                number so far. Returns the next slot and the new number."""
                chosen = is_chosen(tree.primitive(node.leaf, slot, enters), enters)
                # `store` is None in the pass that only counts.
                if store is not None:
                    store(count, node.leaf * tree.leaf_size + slot, chosen)
                return slot + 1, count + dr.select(chosen, uint_t(1), uint_t(0))

            # The loop's state is the slot and the number of primitives.
            return enters, (
                dr.while_loop((uint_t(0), state[0]), runs, step, label="primitives")[1],
            )

        def listed(i: Any, active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Count primitive i of the ball's list if it is sought (`is_chosen`), and store its
            index unless the function `store` is None.

            active: the mask of the lanes that have an entry.
            state: a tuple with the number of primitives so far. Returns the new number, in a tuple.
            """
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
    """Count the far nodes of each ball, or with far=False its pending nodes, and write their
    indices to lists. `build_lists` calls this function twice, to count and to write.

    The search goes through the subtrees of the nodes in `lists`. Pending nodes are inner nodes that
    are not far and have a radius of at most `max_node_radius`. Other inner nodes that are not far
    are replaced by their children. Leaves that are not far are neither far nor pending; their
    primitives are counted by `PendingSources.primitives_of`.

    tree: the tree of the primitives.
    lists: for each ball, the nodes at which the search begins.
    c: (3, n) the centers of the balls.
    far_radius: k times the balls' radius, k > 1. A node of radius R is far if its center is farther
        from c than far_radius + `_NODE_RATIO` R.
    max_node_radius: the largest radius of pending nodes.
    store: a function that writes an entry to a list; None to count only.
    far: whether far nodes are sought, and not pending ones.

    Returns the number of nodes on each lane.
    """
    uint_t, vector = tree.backend.UInt32, tree.backend.Array3f

    def visit(node: VisitedNode, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
        """Count a node if it is of the kind that is sought: far from the center c of the ball, or
        with far=False pending: not far, no leaf, and of a radius of at most `max_node_radius`.
        Store its index unless the function `store` is None.

        node: its `head` holds center, `_NODE_RATIO` times the radius, and radius.
        state: a tuple with the number of nodes so far.

        Returns the mask of the lanes that enter the node, and the new number, in a tuple.
        """
        # Nodes that are neither far nor pending are entered: the walk goes on to their children.
        is_far = dr.squared_norm(c - vector(*node.head[:3])) > dr.square(far_radius + node.head[3])
        is_pending = ~is_far & ~node.is_leaf & (node.head[4] <= max_node_radius)
        chosen = is_far if far else is_pending
        if store is not None:
            store(state[0], node.index, chosen)
        return ~(is_far | is_pending), (state[0] + dr.select(chosen, uint_t(1), uint_t(0)),)

    # The state has one entry, the number of nodes.
    return traverse_subtrees(tree, lists, visit, (uint_t(0),))[0]
