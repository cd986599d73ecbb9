"""Sums over a tree of dipoles: far nodes as multipoles, leaves by whoever knows what is in them.

What the trees of triangles and of points share: which nodes count as far, and what they add.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.fields.edge_hessian import SymmetricSum
from harnack.fields.multipole import Level, cartesian
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.nearby import (
    Nearby,
    Sums,
    bend_columns,
    free_part,
    rounding_of_dipole,
    with_far_node,
)
from harnack.fields.truncation import truncation
from harnack.tree import Node, PackedTree, pack, walk

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, Hierarchy

# A rough look takes nodes as a whole beyond this many times their radius.
_ROUGH = 2.5
# The free distance, in units of the whole, where nothing bounds it.
_FAR = 1e4

AddLeaf: TypeAlias = "Callable[[Node, Mask, Sums], Sums]"


def node_columns(level: Level, order: int, rough: float, error: FloatArray) -> FloatArray:
    """Numbers of nodes as the walks below read them, that may be taken as a whole beyond `rough`
    times their radius: centre, accepting distance, A and K of `bend_columns` | 15 coefficients,
    value error E (k,), as given."""
    head = [rough * level.radius, *bend_columns(level, rough)]
    parts = (level.centre, *head, cartesian(level.moments, order), error)
    return np.column_stack(parts)


@dataclass(frozen=True)
class FarClusters:
    """The walks over a tree of nodes as `node_columns` lays them out.

    looser: the errors of a rough look are at most this many times those stored. steeper: errors
    of gradients are at most this many times those of values, over r.
    """

    backend: Backend
    tree: PackedTree
    accuracy: float
    rough: float
    order: int
    looser: float
    steeper: float

    @classmethod
    def of(
        cls,
        backend: Backend,
        tree: Hierarchy,
        levels: list[Level],
        primitives: FloatArray,
        accuracy: float,
        order: int = 2,
    ) -> FarClusters:
        """Everything uploaded. primitives: records in their slots, as `tree.pack` takes them.

        E is stored once for both looks: as large as the closer one needs, and no less than what
        the rough one needs over `looser`, the middle of the ratio of both.
        """
        rough = min(accuracy, _ROUGH)
        close = [truncation(level, accuracy * level.radius, order) for level in levels]
        roughly = [truncation(level, rough * level.radius, order) for level in levels]
        looser = _middle(roughly[0][0], close[0][0])
        nodes: list[FloatArray] = []
        steeper = 0.0
        for level, *bounds in zip(levels, close, roughly, strict=True):
            error, slope = (
                np.maximum(one, other / looser) for one, other in zip(*bounds, strict=True)
            )
            some = error > 0
            steeper = max(steeper, float((slope[some] / error[some]).max(initial=0.0)))
            nodes.append(node_columns(level, order, rough, error))
        packed = pack(backend, tree, nodes, primitives)
        return cls(backend, packed, accuracy, rough, order, looser, steeper * (1 + 1e-6))

    def at(self, x: Vec3, derivatives: int, add_leaf: AddLeaf, own: Sums = ()) -> tuple[Any, ...]:
        """Value, gradient and Hessian's parts (as asked for), the caller's own sums, and the
        truncation bound, last.

        add_leaf(node, mask, sums): the sums with the contents of a leaf added where the mask is.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        zero = SymmetricSum.zero(real).parts()
        sums: Sums = (vector(0), *zero)[: (0, 1, 7)[derivatives]]

        def visit(node: Node, state: Sums) -> tuple[Mask, Sums]:
            error, value, *rest = state
            r, _, inverse, far = self._far(node, x, True)
            c = node.payload(far)
            terms = far_terms(c, r, inverse, derivatives)
            error = dr.fma(c[15], self._decay(inverse), error) + self._rounded(node, inverse)
            value = value + dr.select(far, terms.value, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(far, terms.gradient, 0)
            if derivatives == 2 and terms.hessian is not None:
                pairs = zip(rest[1:7], terms.hessian.parts(), strict=True)
                rest[1:7] = [old + dr.select(far, new, 0) for old, new in pairs]
            return ~far, (error, *add_leaf(node, ~far & node.is_leaf, (value, *rest)))

        error, *rest = walk(self.tree, visit, (real(0), real(0), *sums, *own))
        return *rest, error

    def near(self, x: Vec3, fine: Mask, add_leaf: AddLeaf, own: Sums = ()) -> tuple[Nearby, Sums]:
        """All sums that a certificate at x needs, and those of the caller's own.

        fine: where to look closely; elsewhere nodes are taken as a whole from `rough` on.
        add_leaf: as for `at`, of the sums of `Nearby` in their order and then the own ones.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        free = free_part(self.rough)

        def visit(node: Node, state: Sums) -> tuple[Mask, Sums]:
            r, square, inverse, far = self._far(node, x, fine)
            c = node.payload(far)
            left_out = c[15] * self._decay(inverse)
            sums = with_far_node(
                state[:7], far_terms(c, r, inverse, 1), far, inverse, self._size(node, inverse),
                (left_out, left_out * inverse), free * (square * inverse), self.backend.epsilon,
            )  # fmt: skip
            state = (*sums, *state[7:])
            return ~far, add_leaf(node, ~far & node.is_leaf, state)

        start = (real(0), vector(0), real(0), real(0), real(_FAR), real(0), real(0), *own)
        sums = walk(self.tree, visit, start)
        looser = dr.select(fine, real(1), self.looser)
        value, g, error, slope_error = *sums[:2], looser * sums[2], looser * self.steeper * sums[3]
        return Nearby(self.backend, value, g, error, slope_error, *sums[4:7]), sums[7:]

    def _far(self, node: Node, x: Vec3, fine: Mask) -> tuple[Vec3, Real, Real, Mask]:
        """x from the node's centre, the square of its length, one over that (0 where it is not
        enough), and whether it is enough."""
        r = x - self.backend.Array3f(*node.head[:3])
        square = dr.squared_norm(r)
        closer = dr.select(fine, self.backend.Float(self.accuracy / self.rough), 1)
        far = square > dr.square(node.head[3] * closer)
        return r, square, dr.select(far, dr.rsqrt(square), 0), far

    def _rounded(self, node: Node, inverse: Real) -> Real:
        return self.backend.epsilon * rounding_of_dipole(self._size(node, inverse), inverse)

    def _size(self, node: Node, inverse: Real) -> Real:
        """A + K/r^2 of `bend_columns`: that many dipoles in its centre would do as much."""
        return dr.fma(node.head[5], inverse * inverse, node.head[4])

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
