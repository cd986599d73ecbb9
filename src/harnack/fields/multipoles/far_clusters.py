"""Sums over a tree of dipoles: far nodes as multipoles, leaves by whoever knows what is in them.

What the trees of triangles and of points share: which nodes count as far, and what they add.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax
from harnack.fields.multipoles.cluster_walk import SeenCluster, walk_clusters
from harnack.fields.multipoles.multipole import NodeMoments, cartesian
from harnack.fields.multipoles.multipole_kernel import far_terms
from harnack.fields.multipoles.truncation import bend_columns, truncation
from harnack.fields.sums import FieldSums, free_part
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import PackedTree, pack

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.batch import Values
    from harnack.tree.hierarchy import FloatArray, Hierarchy

Own: TypeAlias = "tuple[Any, ...]"

# A rough look takes nodes as a whole beyond this many times their radius.
_ROUGH = 2.5
# Roundings of a far node's gradient itself.
_OUTSIDE = 64.0
# The free distance, in units of coordinates, where nothing bounds it.
_FAR = 1e4

# Gives the sums and the caller's own with the primitive of a record added, where active.
AddPrimitive: TypeAlias = "Callable[[list[Real], Mask, FieldSums, Own], tuple[FieldSums, Own]]"


def node_columns(level: NodeMoments, order: int, rough: float, error: FloatArray) -> FloatArray:
    """Numbers of nodes as the walk below reads them, that may be taken as a whole beyond `rough`
    times their radius: center, accepting distance, A and K of `bend_columns` | 15 coefficients,
    value error E (k,), as given."""
    head = [rough * level.radius, *bend_columns(level, rough)]
    parts = (level.center, *head, cartesian(level.moments, order), error)
    return np.column_stack(parts)


@dataclass(frozen=True)
class Treecode:
    """The walk over a tree of nodes as `node_columns` lays them out.

    looser: the errors of a rough look are at most this many times those stored. steeper, bent:
    errors of gradients (second derivatives) are at most this many times those of values, over r
    (r^2).
    """

    backend: Backend
    tree: PackedTree
    accuracy: float
    rough: float
    order: int
    looser: Real
    steeper: Real
    bent: Real

    @classmethod
    def of(
        cls,
        backend: Backend,
        tree: Hierarchy,
        levels: list[NodeMoments],
        primitives: FloatArray,
        accuracy: float,
        order: int = 2,
    ) -> Treecode:
        """Everything uploaded. primitives: records in their slots, as `tree.pack` takes them.

        E is stored once for both looks: as large as the closer one needs, and no less than what
        the rough one needs over `looser`, the middle of the ratio of both.
        """
        rough = min(accuracy, _ROUGH)
        close = [truncation(level, accuracy * level.radius, order) for level in levels]
        roughly = [truncation(level, rough * level.radius, order) for level in levels]
        looser = _middle(roughly[0][0], close[0][0])
        nodes: list[FloatArray] = []
        steeper = bent = 0.0
        for level, *bounds in zip(levels, close, roughly, strict=True):
            error, slope, second = (
                np.maximum(one, other / looser) for one, other in zip(*bounds, strict=True)
            )
            some = error > 0
            steeper = max(steeper, float((slope[some] / error[some]).max(initial=0.0)))
            bent = max(bent, float((second[some] / error[some]).max(initial=0.0)))
            nodes.append(node_columns(level, order, rough, error))
        packed = pack(backend, tree, nodes, primitives)
        ratios = looser, steeper * (1 + 1e-6), bent * (1 + 1e-6)
        on_device = (dr.opaque(backend.Float, ratio) for ratio in ratios)
        return cls(backend, packed, accuracy, rough, order, *on_device)

    @property
    def coarsest(self) -> float:
        """The detail that nodes taken as a whole beyond `rough` times their radius amount to."""
        return self.rough / self.accuracy

    def ratio(self, detail: Real) -> Real:
        """How many times their radius nodes must be away to be taken as a whole."""
        return fmax(self.accuracy * detail, self.backend.Float(self.rough))

    def sums(
        self, x: Vec3, detail: Real, add: AddPrimitive, own: Own = (), active: Mask = True,
        derivatives: int = 1,
    ) -> tuple[FieldSums, Own]:  # fmt: skip
        """All sums at points x, and those of the caller's own.

        detail: `Field.at_detail`; infinity adds up everything one by one. add(row, active, sums,
        own): the sums with a primitive of a near leaf added. derivatives: 0 for the value alone, 1
        with the gradient, 2 with the Hessian.
        """
        free, closer = free_part(self.rough), self.ratio(detail) / self.rough
        unit = epsilon_at(x)

        def add_cluster(node: SeenCluster, state: Own) -> Own:
            c, inverse = node.payload, node.inverse
            left_out = c[15] * self._decay(inverse)
            slope = left_out * inverse
            sums = FieldSums.of(state[0]).with_far_node(
                far_terms(c, node.r, inverse, derivatives),
                node.far,
                inverse,
                dr.fma(node.head[5], inverse * inverse, node.head[4]),
                (left_out, slope, slope * inverse),
                free * (node.square * inverse),
                unit,
            )
            return sums.parts(), state[1]

        def add_primitive(row: list[Real], active: Mask, state: Own) -> Own:
            sums, own = add(row, active, FieldSums.of(state[0]), state[1])
            return sums.parts(), own

        far_off = _FAR * (1 + dr.max(dr.abs(x)))
        start = (FieldSums.zero(self.backend, far_off, derivatives).parts(), own)
        state = walk_clusters(self.tree, x, closer, add_cluster, add_primitive, start, active)
        sums, looser = FieldSums.of(state[0]), dr.select(detail < 1, self.looser, 1)
        second = sums.second_truncation
        sums = dataclasses.replace(
            sums,
            truncation=looser * sums.truncation,
            slope_truncation=looser * self.steeper * sums.slope_truncation,
            second_truncation=None if second is None else looser * self.bent * second,
        )
        return sums, state[1]

    def values(self, sums: FieldSums, share: float, unit: Real, rounding: Real) -> Values:
        """`FieldSums.values` of sums over the tree."""
        return sums.values(share, unit, rounding, _OUTSIDE)

    def _decay(self, inverse: Real) -> Real:
        """r^-(order + 3), as the first term left out."""
        power = inverse * inverse * inverse
        for _ in range(self.order):
            power = power * inverse
        return power


def _middle(larger: FloatArray, smaller: FloatArray) -> float:
    """The median of their ratio, at least 1."""
    some = smaller > 0
    return max(1.0, float(np.median(larger[some] / smaller[some]))) if some.any() else 1.0
