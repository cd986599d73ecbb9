"""The second derivatives of the solid angle of closed curves, edge by edge.

With a = p - x and e the edge from p to q, an edge's Biot-Savart field is w c with c = a x e and
w = integral of |a + te|^-3 dt over [0, 1]. Its derivative along the axis j is

    c dw/dx_j - w (axis_j x e).

The second term is antisymmetric. Around closed curves the fields add up to a gradient, whose
derivative is symmetric: the antisymmetric parts cancel, and what is left is

    Hessian = sum over edges of (c grad w^T + grad w c^T)/2,

symmetric as it stands, and free of trace, for grad w lies in the plane of a and e.

With h the vector from x to the nearest point of the edge's *line*, s the position on the line
from there and L = |e|,

    grad w = 3 integral of (a + te)/|a + te|^5 dt = J h + K e/L^2,
    J = 3/L integral of (h^2+s^2)^(-5/2) ds,   K = 3 integral of s (h^2+s^2)^(-5/2) ds.

K = 1/|a|^3 - 1/|b|^3 at once, b = q - x. J is -2 dw/d(h^2) at fixed ends, and the closed form
w = (|a|+|b|)/(|a||b| D), D = |a||b| + a.b, gives it as a product and sums of positive terms:

    J = w [ ((|a|-|b|)^2 + |a||b|)/(|a||b|)^2 + (|a|+|b|)^2/(|a||b| D) ],

where the integral written out, s/h^2 (...) between two ends, loses all digits far away and in line
with the edge. D cancels beside the edge (a.b < 0), where it is |c|^2/(|a||b| - a.b); the
difference of the cubes is taken from |b| - |a| = e.(a+b)/(|a|+|b|). h = a - (a.e) e/L^2 cancels
where it is short: a fused multiply-add rounds it once, and what is left of the error lies along
e, where a second projection finds it. With c = h x e, the three stay at right angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.fields.symmetric import SymmetricSum

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields.edges.edge_records import LoopEdges

__all__ = ["edge_rates", "hessian_over_edges"]


def edge_rates(a: Vec3, e: Vec3, inverse: Real) -> tuple[Vec3, Vec3]:
    """c and grad w of an edge e that starts at a, seen from the origin; inverse = 1/|e|^2.

    The edge's share of the Hessian is (c grad w^T + grad w c^T)/2. An edge of length zero with a
    finite `inverse` has none. Lengths should be of order one, to stay far from overflow: the
    terms fall like distance^-5 and grow like distance^-3.
    """
    b = a + e
    h = dr.fma(type(a)(-dr.dot(a, e) * inverse), e, a)
    h = dr.fma(type(a)(-dr.dot(h, e) * inverse), e, h)
    c = dr.cross(h, e)
    la, lb = dr.norm(a), dr.norm(b)
    alpha, beta = 1 / la, 1 / lb
    both = alpha * beta
    ab, length, total = dr.dot(a, b), la * lb, la + lb
    d = dr.select(ab < 0, dr.squared_norm(c) / (length - ab), length + ab)
    apart, share = la - lb, total / d
    across = both * both * share * (dr.fma(apart * apart, both, 1) + total * share)
    cubes = both * dr.fma(alpha, alpha, dr.fma(beta, beta, both))
    along = dr.dot(e, a + b) / total * cubes * inverse
    return c, across * h + along * e


def hessian_over_edges(edges: LoopEdges, x: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Rows of the Hessian of the solid angle at x, in one loop over the edges."""
    x = edges.backend.Array3f(x)

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        return SymmetricSum(*state).plus(*edge_rates(p - x, q - p, inverse)).parts()

    start = SymmetricSum.zero(edges.backend.Float).parts()
    return SymmetricSum(*edges.for_each(add, start, "edge hessian")).rows(type(x))
