"""Sums f over dipoles of a radial potential K(r), the kernel: direct sums, or sums by a tree in
which a cluster of far dipoles counts as a single source, given by its moments. A *dipole* is an
oriented point with a vector m, its moment; its weight is |m|. A *record* is a row of numbers that
describes a dipole or a node of the tree. A *node* stands for the cluster of all dipoles below it;
its *accepting distance* is the distance beyond which its moments may be used.

Expansion. A cluster consists of dipoles m_i at c + d_i with |d_i| <= R. At a point x let z = c - x,
and let r be the distance of c from x: |z|, or more if the kernel has a height (`radial_kernel`).
Taylor's formula in d_i gives

    f = -sum_i m_i.grad K(z + d_i) = -(T1[G] + T2[G,G] + T3[G,G,G]/2) K(z) + (rest).

Here G is the derivative with respect to z. The tensors are T1 = sum m_i, T2 = sym sum m_i d_i and
T3 = sym sum m_i d_i d_i, where sym is the symmetric part. Brackets apply a tensor to vectors:
T2[z,z] = z.T2 z. With the functions psi_k of `radial_kernel`

    T1[G] K = -T1[z] psi_1,     T2[G,G] K = T2[z,z] psi_2 - tr T2 psi_1,
    T3[G,G,G] K = 3 z.tr T3 psi_2 - T3[z,z,z] psi_3.

K is not harmonic in three dimensions, so that traces do not drop out: the tensors have 19 numbers,
where 15 would do for a harmonic kernel.

Truncation. The numbers Q_m of `radial_kernel` bound derivatives of K: the m-th one at the distance
D is at most m! Q_m/D^(m+1). They are constant or fall with D. The rest of Taylor's formula is an
integral of the fourth derivative of K along the segment from c to c + d_i. At the length t from c
the distance is at least r - t, so that this derivative is at most Q_4 4!/(r - t)^5, with Q_4 at
the distance r - R. 4!/(r - t)^5 is the third derivative of 1/(r - t)^2 by t. So the rest is at most
Q_4 |m_i| times the rest of the Taylor series of that function, at t = |d_i|. With q = |d_i|/r

    |rest| <= Q_4 |m_i| (1/(1-q)^2 - 1 - 2q - 3q^2)/r^2 = Q_4 |m_i| |d_i|^3 (4-3q)/((1-q)^2 r^5).

For Q_4 = 1 the bound is attained by a dipole on the line to x that points along it. (4-3q)/(1-q)^2
grows with q, so that q = R/r gives a bound for all dipoles. For the gradient, likewise from 2/(r -
t)^3,

    Q_5 |m_i| |d_i|^3 (20 - 30q + 12q^2)/((1-q)^3 r^6),

and for second derivatives from 6/(r - t)^4,

    Q_6 |m_i| |d_i|^3 (120 - 270q + 216q^2 - 60q^3)/((1-q)^4 r^7).
"""

from __future__ import annotations

import abc
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import fmax
from harnack.backend.record_table import RecordTable
from harnack.fmm.radial_kernel import (
    KernelBounds,
    RadialKernel,
    RadialSums,
    SourceAtPoint,
    cluster_parts,
    combine_terms,
    dipole_source,
)
from harnack.fmm.treecode import (
    ClusterView,
    dipole_hierarchy,
    empty_record,
    records_in_slots,
    traverse_clusters,
)
from harnack.tree import BalancedTree, PackedTree, pack_tree

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Mask, Real, Vec3


# The number of dipoles that each pass through the loop of a direct sum adds, by experiment.
_DIPOLES_PER_TRIP = 4


class RadialSum(abc.ABC):
    """Dipoles on a backend, and the sum over them of a radial potential, the kernel, at points. The
    sum may replace far clusters of dipoles by their moments.

    kernel: the radial potential.
    rounding: a bound of the rounding of a dipole's term, as a fraction of the bound of the term's
        absolute value.
    """

    def __init__(self, backend: Backend, rows: FloatArray, kernel: RadialKernel) -> None:
        """Keep the kernel. rows: (n, 8) the records of the dipoles, from `dipole_records`, which
        subclasses upload."""
        self.backend, self.kernel = backend, kernel
        self.rounding = dr.opaque(backend.Float, 12 * backend.machine_epsilon)

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> RadialSums:
        """The sum over all dipoles at points x (3, n): value, derivatives and error bounds.

        closer: the moments of a cluster are used beyond `closer` times its accepting distance
            (`RadialKernel.accepting_distance`). Larger is more accurate; numbers below 1 count as
            1.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        """
        return self.accumulate(RadialSums.zero(self.backend, derivatives), x, closer)

    @abc.abstractmethod
    def accumulate(self, sums: RadialSums, x: Vec3, closer: Real) -> RadialSums:
        """Add the terms of these dipoles at points x to `sums`, which may hold sums over other
        dipoles. Returns the new sums.

        closer: the moments of a cluster are used beyond `closer` times its accepting distance.
            Larger is more accurate.
        """

    def _with_dipole(self, sums: RadialSums, row: list[Real], x: Vec3) -> RadialSums:
        """Add the dipole in the record `row` to the sums at points x, and return the new sums."""
        dipole = dipole_source(row, x, self.kernel, sums.sums.derivatives)
        # self.rounding: the rounding of a term, as a fraction; True: on all lanes.
        return sums.plus(dipole, self.rounding, True)


class DirectSum(RadialSum):
    """The sum over dipoles, one by one. It has no truncation error."""

    def __init__(self, backend: Backend, rows: FloatArray, kernel: RadialKernel) -> None:
        """Upload the dipoles. rows: (n, 8) their records. kernel: the radial potential."""
        super().__init__(backend, rows, kernel)
        self._records = RecordTable.upload(backend, rows, empty_record(rows[0]), _DIPOLES_PER_TRIP)

    def accumulate(self, sums: RadialSums, x: Vec3, closer: Real) -> RadialSums:
        """Add the terms of all dipoles at points x to `sums`. Returns the new sums; `closer` has no
        effect."""
        del closer

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the dipole in the record `row` to the sums, given as a state. Returns the new
            state."""
            return self._with_dipole(sums.with_state(state), row, x).to_state()

        return sums.with_state(self._records.for_each(add, sums.to_state(), "radial dipoles"))


class RadialTreecode(RadialSum):
    """The sum over dipoles by a tree: near dipoles are added one by one, far clusters by their
    moments. A cluster is far from a point if its distance is larger than its accepting distance
    (`RadialKernel.accepting_distance`)."""

    def __init__(
        self, backend: Backend, dipoles: ClusteredDipoles, kernel: RadialKernel, accuracy: float
    ) -> None:
        """Upload a tree of dipoles.

        dipoles: the tree with its moments.
        kernel: the radial potential.
        accuracy: the larger it is, the farther away a cluster must be for its moments to be used
            (`RadialKernel.accepting_distance`).
        """
        super().__init__(backend, dipoles.rows, kernel)
        self._tree = dipoles.packed(backend, kernel, accuracy)

    def accumulate(self, sums: RadialSums, x: Vec3, closer: Real) -> RadialSums:
        """Add the terms of near dipoles and far clusters at points x to `sums`. Returns the new
        sums.

        closer: a cluster is far beyond this many times its accepting distance. Larger is more
            accurate; numbers below 1 count as 1.
        """
        closer = fmax(self.backend.Float(closer), self.backend.Float(1))
        derivatives = sums.sums.derivatives

        def near(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the dipole in the record `row` to the sums, given as a state. Its leaf is not far
            from x on active lanes. Returns the new state."""
            # Lanes on which the leaf is far do not take part in the loop over its dipoles.
            del active
            return self._with_dipole(sums.with_state(state), row, x).to_state()

        def far(node: ClusterView, state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the cluster `node` to the sums, given as a state, on lanes on which it is far.
            Returns the new state."""
            length = dr.sqrt(node.square)
            # node.r leads from the center of the cluster to x; z leads back.
            cluster = cluster_source(
                node.head, node.payload, -node.r, length, self.kernel, derivatives
            )
            return sums.with_state(state).plus(cluster, self.rounding, node.far).to_state()

        height = self.kernel.height_square
        total = traverse_clusters(
            self._tree, x, closer, far, near, sums.to_state(), height_square=height
        )
        return sums.with_state(total)


def cluster_source(
    head: Sequence[Real], c: Sequence[Real], z: Vec3, length: Real, kernel: RadialKernel,
    derivatives: int,
) -> SourceAtPoint:  # fmt: skip
    """What a cluster of dipoles adds at a point to the sum f: value and derivatives, with bounds of
    their truncation errors. The cluster's potential is replaced by its Taylor polynomial of degree
    2 in the dipoles' offsets from the center.

    head: the first six numbers of the cluster's record: center, accepting distance, radius, weight.
    c: the other numbers of its record: 23 coefficients, and the third moment (`node_records`).
    z: the vector from the point to the cluster's center.
    length: D, the distance from the point to the center, in four dimensions if the kernel has a
        height.
    kernel: the radial potential.
    derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
    """
    radius, weight = head[4], head[5]
    inverse = dr.rcp(length)
    parts = cluster_parts(c, z, inverse)
    radial = kernel.at(length, inverse, len(parts) + derivatives)
    terms = combine_terms(parts, z, inverse, radial, derivatives)
    nearest = length - radius
    inverse_nearest = dr.rcp(nearest)
    bounds = kernel.bounds(nearest, 6)
    tail = KernelBounds.of(nearest, inverse_nearest, bounds)
    fourth, fifth, sixth = bounds[2:]
    # bounds: Q_2 to Q_6 of the kernel. The errors of the module. Let r = D and q = R/r, with the
    # radius R. A dipole m_i at the offset d_i from the center has an error of at most Q_4 |m_i|
    # |d_i|^3 (4-3q)/((1-q)^2 r^5) of the value, and similar ones of the derivatives. The sum of
    # |m_i| |d_i|^3 is the third moment c[23], and 1/((1-q)^j r^(j+3)) is 1/r^3 times 1/nearest^j,
    # as nearest = (1-q) r.
    q = radius * inverse
    common = c[23] * inverse * inverse * inverse * inverse_nearest * inverse_nearest
    error = common * fourth * dr.fma(-3, q, 4)
    gradient_error = common * inverse_nearest * fifth * dr.fma(q, dr.fma(12, q, -30), 20)
    polynomial = dr.fma(q, dr.fma(q, dr.fma(-60, q, 216), -270), 120)
    hessian_error = common * inverse_nearest * inverse_nearest * sixth * polynomial
    return SourceAtPoint(terms, weight, tail, error, gradient_error, hessian_error)


@dataclass(frozen=True)
class ClusteredDipoles:
    """A tree over dipoles, with the moments of its nodes: the data of a sum by a tree that do not
    depend on the kernel.

    rows: (n, 8) the records of the dipoles, from `dipole_records`.
    tree: the hierarchy of the dipoles.
    levels: the moments of the nodes of each level of the tree, from the leaves to the root.
    """

    rows: FloatArray
    tree: BalancedTree
    levels: list[TaylorMoments]

    @classmethod
    def of(cls, rows: FloatArray) -> ClusteredDipoles:
        """Build a tree over dipoles. rows: (n, 8) their records."""
        tree = dipole_hierarchy(rows[:, :3])
        return cls(rows, tree, taylor_tree_moments(tree, rows))

    def packed(self, backend: Backend, kernel: RadialKernel, accuracy: float) -> PackedTree:
        """The tree with the records of its nodes and dipoles, on a backend. `kernel` and `accuracy`
        decide beyond which distance the moments of a cluster are used
        (`RadialKernel.accepting_distance`)."""
        numbers = [
            node_records(level, kernel.accepting_distance(level.radius, accuracy))
            for level in self.levels
        ]
        return pack_tree(backend, self.tree, numbers, records_in_slots(self.tree, self.rows))


@dataclass(frozen=True)
class TaylorMoments:
    """The moments of the k nodes at one level of a tree: sums over the dipoles below each node, of
    which the node's Taylor expansion consists. m is the moment vector of a dipole and d its offset
    from the node's center.

    center: (k, 3) the mean position of the dipoles, by weight.
    radius, weight: (k,) the largest |d|, and the sum of the weights w = |m|.
    third: (k,) the sum of w |d|^3.
    t1: (k, 3) the sum T1 of the vectors m.
    t2, t3: (k, 3, 3) and (k, 3, 3, 3) the symmetric parts T2 and T3 of the sums of the tensors m d
        and m d d.
    """

    center: FloatArray
    radius: FloatArray
    weight: FloatArray
    third: FloatArray
    t1: FloatArray
    t2: FloatArray
    t3: FloatArray


def taylor_tree_moments(tree: BalancedTree, rows: FloatArray) -> list[TaylorMoments]:
    """The moments of the nodes of a tree over dipoles: a list with an entry for each level of the
    tree, from the leaves to the root.

    rows: (n, 8) the records of the dipoles.

    T1, T2, T3 are moved from a child's center to its parent's, by replacing d with d + s: T2 gains
    sym(T1 s), and T3 gains sym(2 T2 s + T1 s s). All other numbers are computed from the dipoles
    themselves.
    """
    slots = records_in_slots(tree, rows)
    levels: list[TaylorMoments] = []
    # count: the number of nodes at a level. Leaves have no children: the first arity, 0, is not
    # used.
    for count, arity in zip(tree.counts, (0, *tree.arities), strict=True):
        # Positions, moments and weights, each (count, dipoles below a node, ...): the columns 0 to
        # 2, 3 to 5, and 6 of the records.
        position, moment, weights = np.split(
            slots.reshape(count, -1, slots.shape[2])[..., :7], [3, 6], axis=2
        )
        weight = weights.sum(axis=(1, 2))
        center = (weights * position).sum(axis=1) / np.where(weight > 0, weight, 1)[:, None]
        offset = position - center[:, None]
        # Empty slots have weight 0.
        length = np.where(weights[..., 0] > 0, np.linalg.norm(offset, axis=2), 0)
        third = (weights[..., 0] * length**3).sum(axis=1)
        if not levels:
            offset = np.where(weights > 0, offset, 0)
            moments = _symmetric(
                moment.sum(axis=1),
                np.einsum("ksi,ksj->kij", moment, offset),
                np.einsum("ksi,ksj,ksl->kijl", moment, offset, offset),
            )
        else:
            moments = _moved_to_parents(levels[-1], center, arity)
        levels.append(TaylorMoments(center, length.max(axis=1), weight, third, *moments))
    return levels


def _moved_to_parents(
    children: TaylorMoments, center: FloatArray, arity: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The moments T1 (k, 3), T2 (k, 3, 3), T3 (k, 3, 3, 3) of k parents, from the moments of their
    children. Each parent has `arity` children, which follow each other. center: (k, 3) the parents'
    centers.

    Let s be the offset of a child's center from that of its parent. The parent's moments are the
    sums over its children of T1, sym(T2 + T1 s) and sym(T3 + 2 T2 s + T1 s s), where sym is the
    symmetric part.
    """
    s = children.center - np.repeat(center, arity, axis=0)
    t1, t2, t3 = children.t1, children.t2, children.t3
    t1_s = np.einsum("ki,kj->kij", t1, s)
    moved_t3 = t3 + np.einsum("kij,kl->kijl", 2 * t2 + t1_s, s)
    sums = [a.reshape(-1, arity, *a.shape[1:]).sum(axis=1) for a in (t1, t2 + t1_s, moved_t3)]
    return _symmetric(*sums)


def _symmetric(
    t1: FloatArray, t2: FloatArray, t3: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The symmetric parts of tensors: of k tensors `t1` (k, 3) of first order, which stay as they
    are; of `t2` (k, 3, 3), the mean over both orders of the indices; and of `t3` (k, 3, 3, 3), the
    mean over all six orders. Returns three arrays of these shapes."""
    orders = itertools.permutations((1, 2, 3))
    total = sum((t3.transpose(0, *order) for order in orders), start=np.zeros_like(t3))
    return t1, 0.5 * (t2 + t2.transpose(0, 2, 1)), total / 6


def coefficients(level: TaylorMoments) -> FloatArray:
    """The coefficients (k, 23) of the k nodes of a level, in the order in which `cluster_parts`
    reads them: T1; tr T2; -T2; -3/2 tr T3; T3/2. Of symmetric tensors, each different entry occurs
    once."""
    t2, t3 = -level.t2, 0.5 * level.t3
    # The indices of the entries xx, yy, zz, xy, xz, yz, and of xxx, yyy, zzz, xxy, ...
    i, j = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]).T
    a, b, c = np.array(
        [(0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 0, 1), (0, 0, 2), (0, 1, 1), (1, 1, 2), (0, 2, 2),
         (1, 2, 2), (0, 1, 2)]
    ).T  # fmt: skip
    trace2 = np.einsum("kii->k", level.t2)[:, None]
    trace3 = -1.5 * np.einsum("kiij->kj", level.t3)
    return np.concatenate([level.t1, trace2, t2[:, i, j], trace3, t3[:, a, b, c]], axis=1)


def node_records(level: TaylorMoments, accept: FloatArray) -> FloatArray:
    """Records (k, 30) of the k nodes of a level of a tree: center, accepting distance, radius,
    weight; then the 23 numbers of `coefficients`, and the third moment.

    accept: (k,) for each node, the distance beyond which its moments are used.
    """
    # The ball must contain all dipoles in spite of the rounding of center and radius.
    head = np.stack([accept, level.radius * (1 + 1e-5) + 1e-6, level.weight], axis=1)
    return np.concatenate([level.center, head, coefficients(level), level.third[:, None]], axis=1)
