"""How little the solid angle of closed curves moves along a line that runs beside an edge.

A ball about a point near the curve is as small as the distance to it, so a ray that runs beside a
long edge would need thousands of them. Along a *given* line much more is known. With a = p - x, e
the edge from p to q and v the unit direction, an edge's share of df/ds at x + s v is

    v . (a - s v) x e  w(s) = c w(s),   c = v . (a x e),   w(s) = integral over [0, 1] of
                                                           |a - s v + t e|^-3 dt:

c does not depend on s, and is zero where the line is parallel to the edge. If rho bounds the
distance of the edge from the points of a stretch of the line from below, and |e| = 2h,

    w <= 1/(rho^2 sqrt(rho^2 + h^2)),

for a point of the edge at length l from the nearest one is at least sqrt(rho^2 + l^2) away, and
the integral over an interval of l of length 2h is largest if it is centered. Walking from x by at
most T, rho falls no faster than one walks, and nowhere below the distance rho' of the edge from the
whole line, nor below the distance rho" of the stretch from the line through the edge (a ray may
meet that one at a small angle, far ahead). So for |s| <= T

    |f(x + s v) - f(x)| <= |s| K,   K = sum_e |c| / (rho^2 sqrt(rho^2 + h^2)),
                                    rho = max(d_e - T, rho', rho").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr

from harnack.backend.extrema import clamp, fmax
from harnack.enclosures import Lipschitz
from harnack.fields.edges.edge import Edge
from harnack.fields.sums import SUM_ROUNDING

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.fields.edges.edge_records import LoopEdges

__all__ = ["Line", "known_along", "rates_along", "with_edge_rates"]

# Nearer to the curve than this part of its size, and with a slope below this part of the
# gradient, a ray may run along the curve and asks what is known along its line; elsewhere only
# with a slope so small that it may run along a flat part of the surface.
_BESIDE, _FLAT, _GRAZING = 0.001, 0.25, 1e-3
# Of the distance to the curve, the powers that are the lengths asked about: from half of it to the
# size of the curve.
_LENGTHS = 6

# The rates for lengths, on lanes that are active.
Rates: TypeAlias = "Callable[[tuple[Real, ...], Mask], tuple[Real, ...]]"


@dataclass(frozen=True)
class Line:
    """Lines x + s v and how far their points may be off by rounding; lengths of order one."""

    x: Vec3
    v: Vec3
    rounding: Real

    @property
    def slack(self) -> Real:
        """Beyond the rounding of the points, that of differences p - x, which are as long as x."""
        return dr.fma(8 * float(dr.epsilon(self.x)), dr.norm(self.x), self.rounding)


def known_along(line: Line, gradient: Vec3, distance: Real, rates: Rates) -> tuple[Lipschitz, ...]:
    """How fast f moves along lines through points so far from the curve, for lengths that lead from
    half that distance to the curve's size; only on lanes where it may be worth its cost.

    Beside a straight edge the longest will do, and others near its ends; along a flat part of the
    surface, bounded by a plane curve, the shortest.
    """
    slope, steepness = dr.dot(gradient, line.v), dr.norm(gradient)
    flat = dr.select(distance < _BESIDE, _FLAT, _GRAZING) * steepness
    first = 0.5 * fmax(distance, type(distance)(1e-30))
    longer, lengths = dr.power(first, -1 / _LENGTHS), [first]
    for _ in range(_LENGTHS - 1):
        lengths.append(lengths[-1] * longer)
    found = rates(tuple(lengths), dr.abs(slope) < flat)
    pairs = zip(found, lengths, strict=True)
    return tuple(Lipschitz(rate * (1 + SUM_ROUNDING), length) for rate, length in pairs)


def rates_along(
    edges: LoopEdges, line: Line, lengths: tuple[Real, ...], active: Mask
) -> tuple[Real, ...]:
    """For each length T a constant K of the module's bound on the line for |s| <= T.

    Infinite on lanes that are not active, which cost nothing where their neighbors are not
    either, and where the line meets the curve within T, to rounding.
    """

    def add(p: Vec3, q: Vec3, inverse: Real, rates: tuple[Real, ...]) -> tuple[Real, ...]:
        return with_edge_rates(line, Edge.between(p, q, inverse, line.x), lengths, rates)

    start = tuple(edges.backend.Float(0) for _ in lengths)
    rates = edges.for_each(add, start, "edges along", active)
    return tuple(dr.select(active, rate, dr.inf) for rate in rates)


def with_edge_rates(
    line: Line, edge: Edge, lengths: tuple[Real, ...], rates: tuple[Real, ...]
) -> tuple[Real, ...]:
    """The rates with an edge added, seen from the line's x.

    m = a x v and n = e x v are a and e as seen along the line, turned by a right angle. Distances
    on the line's plane are taken from them, and c = v . m x n, so that it is small where both are,
    whatever the lengths of a and e: its error is at most 8 epsilon |m| |e| and slack |n|.
    """
    a, e, inverse, slack = edge.a, edge.e, edge.inverse, line.slack
    epsilon = float(dr.epsilon(type(inverse)))
    m, n = dr.cross(a, line.v), dr.cross(e, line.v)
    c = dr.abs(dr.dot(line.v, dr.cross(m, n)))
    quarter = 0.25 * dr.rcp(inverse)  # h^2
    c += 16 * epsilon * dr.norm(m) * dr.sqrt(quarter) + 2 * slack * dr.norm(n)
    square = dr.squared_norm(n)
    foot = dr.select(square > 0, clamp(-dr.dot(m, n) / square, 0, 1), 0)
    passing = dr.norm(dr.fma(type(a)(foot), n, m)) - slack
    distance = dr.sqrt(edge.square) - slack
    # (a - s v) x e = area + s n, of length |e| times the distance from the line through the edge.
    area, per_length = dr.cross(a, e), dr.sqrt(inverse)
    nearest = dr.select(square > 0, -dr.dot(area, n) / square, 0)
    grown: list[Real] = []
    for length, rate in zip(lengths, rates, strict=True):
        s = clamp(nearest, -length, length)
        through = dr.norm(dr.fma(type(a)(s), n, area)) * per_length - slack
        rho = fmax(fmax(distance - length, passing), through)
        square = rho * rho
        term = c * dr.rcp(square) * dr.rsqrt(square + quarter)
        # Not where the edge may be met: nothing is known then.
        grown.append(rate + dr.select(rho > 0, term, dr.inf))
    return tuple(grown)
