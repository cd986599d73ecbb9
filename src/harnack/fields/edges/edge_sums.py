"""One pass over the edges of a curve: solid angle, its gradient, distance and variation.

The only loop that costs anything in a trace of a curve, so it is written for throughput: eight
edges a trip, vertices fetched in aligned packets of eight floats, one square root, one division
and about eighty additions and multiplications an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.backend.extrema import fmin
from harnack.fields.batch import SymmetricSum
from harnack.fields.edges.edge import Edge
from harnack.tree.nearest import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields.edges.edge_records import LoopEdges

# Two complex numbers, as four reals.
Spinor: TypeAlias = "tuple[Real, Real, Real, Real]"

# Often, and without squares: beside a vertex or far away, the product of a few factors leaves the
# range of float32.
_RENORMALIZE_EVERY = 2


@dataclass(frozen=True)
class EdgeSums:
    """Sums over all edges at x: Omega in (-2pi, 2pi], its gradient, distance to the nearest edge,
    and of the integrals of |dp|/D^k along the edges, D the distance to p: squares is at least that
    for k = 2, cubes is that for k = 3, fourths at least that for k = 4."""

    angle: Real
    gradient: Vec3
    distance: Real
    squares: Real
    cubes: Real
    fourths: Real


def sum_over_edges(edges: LoopEdges, x: Vec3) -> EdgeSums:
    """All sums at x in one loop.

    Solid angle. For unit spinors chi(a) of the directions a = p_i - x, the product of
    <chi(p_i), chi(p_{i+1})> around a closed loop has argument Omega/2 (the Berry phase of spin
    1/2; it equals the fan formula of van Oosterom and Strackee 1983, Eq. 10, with the apex at
    infinity). With s = |a| + |a_z| and A = a_x + i a_y, chi is (s, A) above and (conj A, s)
    below: neither cancels, and the gauge drops out because each vertex enters once plain and
    once conjugated. A factor vanishes only on its own edge: there is no apex to be in line with.

    Gradient. Biot-Savart: each edge gives (1/|a|+1/|b|)/(|a||b|+a.b) a x b (Eq. 11). The
    bracket cancels beside the edge; |factor|^2 = 2 s_a s_b (|a||b|+a.b) does not.

    Integrals. Biot and Savart's field of an edge of length L at distance h from its line is h times
    the integral of |dp|/D^3, and |a x b| = h L: so that integral is L times the weight of a x b in
    the gradient. With d, the distance to the edge, the integral of |dp|/D^4 is at most 1/d of it,
    and that of |dp|/D^2 at most 2d times it: in polar angles around the foot of x on the line, both
    are integrals from t1, cos t1 = h/d, to t2, and 2 (sin t2 - sin t1) >= (t2 - t1) cos t1, since
    the difference is concave in t2, 0 at t1, and at pi/2 not less than 0 (tan(u/2) >= u/2).
    """
    real, x = edges.backend.Float, edges.backend.Array3f(x)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        zr, zi, g, d2, squares, cubes, fourths = state
        p = edges.vertex(row, 0)
        a = p - x
        la, sa, ca = spinor(a)
        for k in range(edges.run):
            q, inverse = edges.vertex(row, k + 1), row[4 * k + 3]
            b = q - x
            lb, sb, cb = spinor(b)
            re, im = inner_product(ca, cb)
            zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
            if k % _RENORMALIZE_EVERY == _RENORMALIZE_EVERY - 1:
                scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
                zr, zi = zr * scale, zi * scale
            e = q - p
            weight = (la + lb) * (sa * sb) / (la * lb * dr.fma(re, re, im * im))
            g = dr.fma(type(g)(weight), dr.cross(a, e), g)
            square = squared_distance_to_segment(a, e, inverse)
            d2 = fmin(square, d2)
            share = weight * dr.rsqrt(inverse)
            near = dr.rsqrt(square)
            cubes, fourths = cubes + share, dr.fma(share, near, fourths)
            squares = dr.fma(share, square * near, squares)
            p, a, la, sa, ca = q, b, lb, sb, cb
        return zr, zi, g, d2, squares, cubes, fourths

    start = (real(1), real(0), type(x)(0), real(dr.inf), real(0), real(0), real(0))
    zr, zi, g, d2, squares, cubes, fourths = edges.records.for_each(add, start, "edges")
    angle = 2 * dr.atan2(zi, zr)
    # The weights are half of those in the gradient.
    return EdgeSums(angle, 2 * g, dr.sqrt(d2), 4 * squares, 2 * cubes, 2 * fourths)


def hessian_over_edges(edges: LoopEdges, x: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Rows of the Hessian of the solid angle at x, in one loop over the edges."""
    x = edges.backend.Array3f(x)

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        return SymmetricSum(*state).plus(*Edge.between(p, q, inverse, x).rates()).parts()

    start = SymmetricSum.zero(edges.backend.Float).parts()
    return SymmetricSum(*edges.for_each(add, start, "edge hessian")).rows(type(x))


def inner_product(a: Spinor, b: Spinor) -> tuple[Real, Real]:
    """<a, b> as (real, imaginary), conjugate-linear in a."""
    re = dr.fma(a[0], b[0], dr.fma(a[1], b[1], dr.fma(a[2], b[2], a[3] * b[3])))
    im = dr.fma(a[0], b[1], dr.fma(a[2], b[3], -dr.fma(a[1], b[0], a[3] * b[2])))
    return re, im


def spinor(a: Vec3) -> tuple[Real, Real, Spinor]:
    """|a|, |a| + |a_z| and the (unnormalized) spinor of direction a as four reals."""
    length = dr.sqrt(dr.fma(a.z, a.z, dr.fma(a.x, a.x, a.y * a.y)))
    s = length + dr.abs(a.z)
    up = a.z >= 0
    chi = (
        dr.select(up, s, a.x),
        dr.select(up, 0, -a.y),
        dr.select(up, a.x, s),
        dr.select(up, a.y, 0),
    )
    return length, s, chi
