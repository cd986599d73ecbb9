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
from harnack.fields.batch import Values
from harnack.fields.multipoles.multipole import Level, cartesian
from harnack.fields.multipoles.multipole_kernel import far_terms
from harnack.fields.multipoles.nearby import (
    SECOND_ROUNDINGS,
    SLOPE_ROUNDINGS,
    Nearby,
    Sums,
    bend_columns,
    free_part,
    rounding_of_dipole,
    with_far_node,
)
from harnack.fields.multipoles.truncation import truncation
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import Node, PackedTree, pack, walk

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, Hierarchy

# A rough look takes nodes as a whole beyond this many times their radius.
_ROUGH = 2.5
# Roundings of a far node's gradient itself.
_OUTSIDE = 64.0
# The free distance, in units of coordinates, where nothing bounds it.
_FAR = 1e4

AddLeaf: TypeAlias = "Callable[[Node, Mask, Sums], Sums]"
AddToErrors: TypeAlias = "Callable[[Node, Mask, Errors, Sums], tuple[Errors, Sums]]"


@dataclass(frozen=True)
class Errors:
    """What bounds the errors of sums at points.

    value, slope, second: of what was left out of value, gradient and second derivatives. rounding:
    of the value. s4, s5: as in `Nearby`; rounding of positions and of terms moves the gradient by
    `SLOPE_ROUNDINGS` s4 and second derivatives by `SECOND_ROUNDINGS` s5 units in the last place
    of coordinates.
    """

    value: Real
    slope: Real
    second: Real
    rounding: Real
    s4: Real
    s5: Real

    def parts(self) -> tuple[Real, ...]:
        """In the order of the constructor, as loops want them."""
        return self.value, self.slope, self.second, self.rounding, self.s4, self.s5

    def values(
        self, share: float, unit: Real, rounding: Real, value: Real, gradient: Vec3 | None,
        hessian: SymmetricSum | None,
    ) -> Values:  # fmt: skip
        """`share` times a sum and its derivatives, with bounds of their errors.

        unit: the rounding of a coordinate, at least epsilon. rounding: what there is of it in the
        value besides. Far outside the whole, where distances are as long as coordinates, the
        powers of a distance in a gradient, and the sums of moments, have roundings of their own.
        """
        outside = fmax(unit - 2 * float(dr.epsilon(value)), 0)
        rounded = SLOPE_ROUNDINGS * unit + _OUTSIDE * outside
        return Values(
            share * value,
            dr.fma(share, self.value + self.rounding, rounding),
            None if gradient is None else share * gradient,
            None if hessian is None else SymmetricSum(*(share * part for part in hessian.parts())),
            share * dr.fma(rounded, self.s4, self.slope),
            share * dr.fma(SECOND_ROUNDINGS * unit, self.s5, self.second),
        )


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

    def at(
        self, x: Vec3, derivatives: int, add_leaf: AddToErrors, closer: Real, own: Sums = ()
    ) -> tuple[Errors, tuple[Any, ...]]:
        """Errors; value, gradient and Hessian's parts (as asked for), and the caller's own sums.

        add_leaf(node, mask, errors, sums): errors and sums with the contents of a leaf added where
        the mask is. closer: nodes are taken as a whole beyond so many times `accuracy` times their
        radius; infinity adds up everything one by one.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        zero = SymmetricSum.zero(real).parts()
        sums: Sums = (vector(0), *zero)[: (0, 1, 7)[derivatives]]
        count, unit = len(dataclasses.fields(Errors)), epsilon_at(x)
        closer = fmax(real(closer), real(1)) * (self.accuracy / self.rough)

        def visit(node: Node, state: Sums) -> tuple[Mask, Sums]:
            errors, (value, *rest) = Errors(*state[:count]), state[count:]
            r, _, inverse, far = self._far(node, x, closer)
            c = node.payload(far)
            terms = far_terms(c, r, inverse, derivatives)
            value = value + dr.select(far, terms.value, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(far, terms.gradient, 0)
            if derivatives == 2 and terms.hessian is not None:
                pairs = zip(rest[1:7], terms.hessian.parts(), strict=True)
                rest[1:7] = [old + dr.select(far, new, 0) for old, new in pairs]
            left_out = c[15] * self._decay(inverse)
            size, fourth = self._size(node, inverse), dr.square(inverse * inverse)
            errors = Errors(
                errors.value + left_out,
                dr.fma(left_out, inverse, errors.slope),
                dr.fma(left_out, inverse * inverse, errors.second),
                errors.rounding + rounding_of_dipole(size, inverse, unit),
                dr.fma(size, fourth, errors.s4),
                dr.fma(size, fourth * inverse, errors.s5),
            )
            errors, rest = add_leaf(node, ~far & node.is_leaf, errors, (value, *rest))
            return ~far, (*errors.parts(), *rest)

        start = (*(real(0) for _ in range(count)), real(0), *sums, *own)
        state = walk(self.tree, visit, start)
        errors = Errors(*state[:count])
        errors = dataclasses.replace(
            errors, slope=self.steeper * errors.slope, second=self.bent * errors.second
        )
        return errors, tuple(state[count:])

    @property
    def coarsest(self) -> float:
        """The detail that nodes taken as a whole beyond `rough` times their radius amount to."""
        return self.rough / self.accuracy

    def ratio(self, detail: Real) -> Real:
        """How many times their radius nodes must be away to be taken as a whole."""
        return fmax(self.accuracy * detail, self.backend.Float(self.rough))

    def near(
        self, x: Vec3, detail: Real, add_leaf: AddLeaf, own: Sums = (), active: Mask = True
    ) -> tuple[Nearby, Sums]:
        """All sums that a certificate at x needs, and those of the caller's own.

        detail: `Field.at_detail`. add_leaf: as for `at`, of the sums of `Nearby` in their order and
        then the own ones.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        free, closer = free_part(self.rough), self.ratio(detail) / self.rough
        unit = epsilon_at(x)

        def visit(node: Node, state: Sums) -> tuple[Mask, Sums]:
            r, square, inverse, far = self._far(node, x, closer)
            c = node.payload(far)
            left_out = c[15] * self._decay(inverse)
            sums = with_far_node(
                state[:8], far_terms(c, r, inverse, 1), far, inverse, self._size(node, inverse),
                (left_out, left_out * inverse), free * (square * inverse), unit,
            )  # fmt: skip
            state = (*sums, *state[8:])
            return ~far, add_leaf(node, ~far & node.is_leaf, state)

        zero = real(0)
        far_off = _FAR * (1 + dr.max(dr.abs(x)))
        start = (zero, vector(0), zero, zero, zero, real(far_off), zero, zero, *own)
        value, g, truncation, slope, *rest = walk(self.tree, visit, start, active)
        looser = dr.select(detail < 1, self.looser, 1)
        left_out = looser * truncation, looser * self.steeper * slope
        return Nearby(self.backend, value, g, *left_out, *rest[:4]), tuple(rest[4:])

    def _far(self, node: Node, x: Vec3, closer: Real) -> tuple[Vec3, Real, Real, Mask]:
        """x from the node's centre, the square of its length, one over that (0 where it is not
        enough), and whether it is enough: `closer` times what is for a coarse look."""
        r = x - self.backend.Array3f(*node.head[:3])
        square = dr.squared_norm(r)
        far = square > dr.square(node.head[3] * closer)
        return r, square, dr.select(far, dr.rsqrt(square), 0), far

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
