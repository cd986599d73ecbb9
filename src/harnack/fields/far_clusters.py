"""Sums over a tree of dipoles: far nodes as multipoles, leaves by whoever knows what is in them.

What the trees of triangles and of points share: which nodes count as far, what they add, and what
their sums prove about the field near a point.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmin
from harnack.fields.edge_hessian import SymmetricSum
from harnack.fields.field import Curvature, HarmonicBall, Sample
from harnack.fields.moments import KNOWN
from harnack.fields.multipole import Level, cartesian
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.truncation import sup_norm, truncation
from harnack.tree import Node, PackedTree, pack, walk

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, Hierarchy

# A rough look takes nodes as a whole beyond this many times their radius.
_ROUGH = 2.5
# Parts of the free distance out to which curvatures are stated: the shorter, the smaller.
_REACHES = (0.2, 0.4, 0.6)
# The part of the way to the dipoles of far nodes out to which they are stated.
_WAY = 0.65
_ROUNDING = 2e-5
# The free distance, in units of the whole, where nothing bounds it.
_FAR = 1e4

Sums: TypeAlias = "tuple[Any, ...]"
AddLeaf: TypeAlias = "Callable[[Node, Mask, Sums], Sums]"


def node_columns(level: Level, order: int, rough: float, error: FloatArray) -> FloatArray:
    """Numbers of nodes as the walks below read them, that may be taken as a whole beyond `rough`
    times their radius: centre, accepting distance, A and K of `bend_columns` | 15 coefficients,
    value error E (k,), as given."""
    head = [rough * level.radius, *bend_columns(level, rough)]
    parts = (level.centre, *head, cartesian(level.moments, order), error)
    return np.column_stack(parts)


def bend_columns(level: Level, rough: float) -> tuple[FloatArray, FloatArray]:
    """A and K (k,) of nodes that are seen from beyond r0 = `rough` times their radius R.

    From there on a step by t = q r, q <= Q = `longest_part(rough)`, moves a node's field off the
    linear by at most

        (A + K/r^2) t^2/r^4 Phi_1(q),   Phi_l(q) = ((1-q)^-(l+1) - 1 - (l+1)q)/q^2.

    The term l, a harmonic function of degree -(l+1), is at most B_l/r^(l+1), and its k-th
    derivative along a line (l+k)!/l! B_l/r^(l+1+k) (`truncation.truncation`, k times). So Taylor's
    remainder is at most B_l Phi_l(q) t^2/r^(l+3). In Phi_l/Phi_1 the ratio of coefficients,
    (l+k)!/(l! (k+1)!), grows with k, so that the quotient grows with q: W_l = Phi_l(Q)/Phi_1(Q)
    serves. With r >= r0: A = B_1 + W_2 B_2/r0 and K = sum_{l>=3} W_l B_l/r0^(l-3), for l >= 6 of
    B_l <= l R^(l-5) sum a |d|^4, with Phi_l(Q) < (1-Q)^-(l+1)/Q^2.
    """
    r0, q = np.maximum(rough * level.radius, 1e-50), longest_part(rough)
    ratio = [((1 - q) ** -(n + 1) - 1 - (n + 1) * q) / (q * q * _phi(q)) for n in range(KNOWN + 1)]
    terms = [ratio[n] * sup_norm(level.moments, n) for n in range(1, KNOWN + 1)]
    x = 1 / (rough * (1 - q))
    rest = x * (6 - 5 * x) / (1 - x) ** 2 / ((1 - q) ** 6 * q * q * _phi(q))
    wide = rest * level.fourth / r0**2 + sum(term / r0**n for n, term in enumerate(terms[2:]))
    return terms[0] + terms[1] / r0, wide


def longest_part(rough: float) -> float:
    """Of the distance of a far node's centre: the longest step that certificates cover."""
    return _WAY * (1 - 1 / rough)


def free_part(rough: float) -> float:
    """Of the distance of a far node's centre: what is counted as free of dipoles."""
    return longest_part(rough) / _REACHES[-1]


def _phi(q: float) -> float:
    """Phi_1 of `node_columns`: convex, and 3 at 0."""
    return (3 - 2 * q) / (1 - q) ** 2


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
            value, g, error, slope_error, clear, s4, s5, *rest = state
            r, square, inverse, far = self._far(node, x, fine)
            c = node.payload(far)
            terms = far_terms(c, r, inverse, 1)
            apart = free * (square * inverse)
            decay, square = self._decay(inverse), inverse * inverse
            fourth = self._size(node, inverse) * (square * square)
            state = (
                value + dr.select(far, terms.value, 0),
                g + dr.select(far, terms.gradient, 0),
                dr.fma(c[15], decay, error) + self._rounded(node, inverse),
                dr.fma(c[15], decay * inverse, slope_error),
                dr.select(far, fmin(apart, clear), clear),
                s4 + fourth,
                dr.fma(fourth, inverse, s5),
                *rest,
            )
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
        """A + K/r^2 of `node_columns`: that many dipoles in its centre would do as much."""
        return dr.fma(node.head[5], inverse * inverse, node.head[4])

    def _decay(self, inverse: Real) -> Real:
        """r^-(order + 3), as the first term left out."""
        power = inverse * inverse * inverse
        for _ in range(self.order):
            power = power * inverse
        return power


def rounding_of_dipole(area: Real, inverse: Real) -> Real:
    """What rounding may do to the value of a dipole at distance rho = 1/inverse, over epsilon.

    Coordinates rounded by epsilon each move it by at most 2 epsilon area/rho^3; the four roundings
    of its term, by 4 epsilon area/rho^2.
    """
    square = inverse * inverse
    return area * dr.fma(2 * inverse, square, 4 * square)


def _middle(larger: FloatArray, smaller: FloatArray) -> float:
    """The median of their ratio, at least 1."""
    some = smaller > 0
    return max(1.0, float(np.median(larger[some] / smaller[some]))) if some.any() else 1.0


@dataclass(frozen=True)
class Nearby:
    """What sums over a tree tell about f near x.

    error, slope_error: what was left out of value and gradient. clear: the distance of the nearest
    dipole, or `free_part` of that to the nearest far node's centre if that is less. s4, s5: sums of
    a/rho^4 and a/rho^5 over dipoles a at rho and, with A + K/r^2 for a, over far nodes at r.
    """

    backend: Backend
    value: Real
    gradient: Vec3
    error: Real
    slope_error: Real
    clear: Real
    s4: Real
    s5: Real

    def sample(self, share: float, rounding: Real, normal: Vec3 | None = None) -> Sample:
        """`share` times f, with what is known of it.

        Certificate. Along a line the k-th derivative of a dipole a at rho is at most
        (k+1)! a/rho^(k+2) (it is a mixed derivative of a/rho, whose tensor is symmetric and takes
        its largest value on equal vectors), so that Taylor's remainder after the linear term is at
        most a ((rho-t)^-2 - rho^-2 - 2t rho^-3) = a t^2 rho^-4 phi(t/rho), phi(q) =
        (3-2q)/(1-q)^2. That of a far node is at most that of a dipole of area A + K/r^2 in its
        centre, for t/r <= `longest_part` (`node_columns`). phi is convex: on [0, b] it lies below
        3 + rise q, rise = (phi(b)-3)/b = (4-3b)/(1-b)^2. With t <= r = b clear,
        |f(y) - f(x) - g.(y-x)| <= t^2 (3 s4 + rise r s5).
        A ball of that radius bounds f by |g| r more, and holds harmonic f: dipoles of far nodes
        are farther away than 1 - 1/rough times the centre, and `longest_part` is less.
        """
        epsilon, g = self.backend.epsilon, share * self.gradient
        distance = self.clear * (1 - _ROUNDING) - 8 * epsilon
        bends = [self._bend(share, b, b * distance) for b in _REACHES]
        slope, widest = dr.norm(g) + share * self.slope_error, bends[-1]
        r = widest.radius
        variation = (1 + _ROUNDING) * r * dr.fma(0.5 * r, widest.constant, slope)
        value = share * self.value
        ball = HarmonicBall(r, value - variation, value + variation)
        # On a singular point itself all values meet: a gradient that says so.
        apart = (self.clear > 16 * epsilon) & dr.isfinite(value) & dr.isfinite(dr.squared_norm(g))
        steep = self.backend.Array3f(0, 0, share * 4 * math.pi / (8 * epsilon))
        return Sample(
            dr.select(apart, value, 0),
            dr.select(apart, g, steep),
            (*bends, ball),
            share * self.error + rounding,
            dr.select(apart, share * self.slope_error, 0),
            normal,
        )

    def _bend(self, share: float, b: float, r: Real) -> Curvature:
        """What is known out to r = b times the free distance."""
        rise = (4 - 3 * b) / (1 - b) ** 2
        third = 3 * self.s4
        return Curvature((2 + 2 * _ROUNDING) * share * dr.fma(r * rise, self.s5, third), r)
