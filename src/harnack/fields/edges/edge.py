"""What is known at a point x about one edge from p to q: its distance, field and derivatives.

With a = p - x, b = q - x, e = q - p and c = a x e, the edge adds to the gradient of a solid angle
Biot and Savart's field w c (paper, Eq. 11),

    w = integral of |a + te|^-3 dt over [0, 1] = (|a|+|b|)/(|a||b| D),   D = |a||b| + a.b.

D cancels beside the edge (a.b < 0), where it is |c|^2/(|a||b| - a.b) instead.

Second derivatives. The derivative of w c along the axis j is c dw/dx_j - w (axis_j x e). The second
term is antisymmetric. Around closed curves the fields add up to a gradient, whose derivative is
symmetric: the antisymmetric parts cancel, and what is left is

    Hessian = sum over edges of (c grad w^T + grad w c^T)/2,

symmetric as it stands, and free of trace, for grad w lies in the plane of a and e.

With h the vector from x to the nearest point of the edge's *line*, s the position on the line
from there and L = |e|,

    grad w = 3 integral of (a + te)/|a + te|^5 dt = J h + K e/L^2,
    J = 3/L integral of (h^2+s^2)^(-5/2) ds,   K = 3 integral of s (h^2+s^2)^(-5/2) ds.

K = 1/|a|^3 - 1/|b|^3 at once. J is -2 dw/d(h^2) at fixed ends, and the closed form of w gives it as
a product and sums of positive terms:

    J = w [ ((|a|-|b|)^2 + |a||b|)/(|a||b|)^2 + (|a|+|b|)^2/(|a||b| D) ],

where the integral written out, s/h^2 (...) between two ends, loses all digits far away and in line
with the edge. The difference of the cubes is taken from |b| - |a| = e.(a+b)/(|a|+|b|).
h = a - (a.e) e/L^2 cancels where it is short: a fused multiply-add rounds it once, and what is left
of the error lies along e, where a second projection finds it. With c = h x e, the three stay at
right angles.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.tree.nearest import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

__all__ = ["Edge", "edge_variation"]


@dataclass(frozen=True)
class Edge:
    """The edge from p to q, seen from x: a = p - x and b = q - x.

    e: q - p, which has no rounding of x. inverse: 1/|e|^2, anything finite for an edge without a
    length: that has no field.
    """

    a: Vec3
    b: Vec3
    e: Vec3
    inverse: Real

    @classmethod
    def between(cls, p: Vec3, q: Vec3, inverse: Real, x: Vec3) -> Edge:
        """The edge from p to q, seen from x."""
        return cls(p - x, q - x, q - p, inverse)

    @functools.cached_property
    def lengths(self) -> tuple[Real, Real]:
        """|a| and |b|."""
        return dr.norm(self.a), dr.norm(self.b)

    @functools.cached_property
    def square(self) -> Real:
        """The square of the distance from x to the edge."""
        return squared_distance_to_segment(self.a, self.e, self.inverse)

    def field(self) -> tuple[Real, Vec3]:
        """w and c of Biot and Savart's field w c, what the edge adds to the gradient; in line with
        the edge w is 0."""
        (la, lb), c = self.lengths, dr.cross(self.a, self.e)
        square = dr.squared_norm(c)
        return dr.select(square > 0, (la + lb) / (la * lb * self._bracket(square)), 0), c

    def field_of_lengths(self, la: Real, lb: Real) -> tuple[Real, Vec3]:
        """The same for given |a| and |b|, by one division."""
        c, both, dot = dr.cross(self.a, self.e), la * lb, dr.dot(self.a, self.b)
        square, beside = dr.squared_norm(c), dot < 0
        above = (la + lb) * dr.select(beside, both - dot, 1)
        below = both * dr.select(beside, square, both + dot)
        return dr.select(square > 0, above / below, 0), c

    def rates(self) -> tuple[Vec3, Vec3]:
        """c and grad w: the edge's share of the Hessian is (c grad w^T + grad w c^T)/2.

        Lengths should be of order one, to stay far from overflow: the terms fall like distance^-5
        and grow like distance^-3.
        """
        a, e, vector = self.a, self.e, cast("Any", type(self.a))
        h = dr.fma(vector(-dr.dot(a, e) * self.inverse), e, a)
        h = dr.fma(vector(-dr.dot(h, e) * self.inverse), e, h)
        c, (la, lb) = dr.cross(h, e), self.lengths
        alpha, beta, total, apart = 1 / la, 1 / lb, la + lb, la - lb
        both, share = alpha * beta, total / self._bracket(dr.squared_norm(c))
        across = both * both * share * (dr.fma(apart * apart, both, 1) + total * share)
        cubes = both * dr.fma(alpha, alpha, dr.fma(beta, beta, both))
        along = dr.dot(e, a + self.b) / total * cubes * self.inverse
        return c, across * h + along * e

    def _bracket(self, square: Real) -> Real:
        """D, square: |c|^2."""
        (la, lb), dot = self.lengths, dr.dot(self.a, self.b)
        return dr.select(dot < 0, square / (la * lb - dot), la * lb + dot)


def edge_variation(square: Real, inverse: Real) -> tuple[Real, Real]:
    """h/(d sqrt(d^2+h^2)) and the same over d, of an edge of half length h at distance d.

    square: d^2. inverse: 1/(2h)^2. `SolidAngle` says what they bound.
    """
    first = dr.rsqrt(square * dr.fma(square, 4 * inverse, 1))
    return first, first * dr.rsqrt(square)
