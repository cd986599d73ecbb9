"""What one edge adds to the gradient of a solid angle, and to a bound of how much it varies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3


def edge_field(a: Vec3, b: Vec3, la: Real, lb: Real) -> tuple[Vec3, Real]:
    """c and weight; the edge from a to b, seen from x, adds weight c to the gradient.

    Biot and Savart's law (paper, Eq. 11): c = a x b and weight = (1/|a|+1/|b|)/(|a||b|+a.b), 0 in
    line with the edge. The bracket cancels beside the edge (a.b < 0), where it is
    |c|^2/(|a||b|-a.b) instead; c is taken as a x (b - a), which cancels less far away.
    la, lb: |a| and |b|.
    """
    c = dr.cross(a, b - a)
    dot, both, square = dr.dot(a, b), la * lb, dr.squared_norm(c)
    bracket = dr.select(dot < 0, square / (both - dot), both + dot)
    return c, dr.select(square > 0, (la + lb) / (both * bracket), 0)


def edge_variation(square: Real, inverse: Real) -> tuple[Real, Real]:
    """h/(d sqrt(d^2+h^2)) and the same over d, of an edge of half length h at distance d.

    square: d^2. inverse: 1/(2h)^2. `SolidAngle` says what they bound.
    """
    first = dr.rsqrt(square * dr.fma(square, 4 * inverse, 1))
    return first, first * dr.rsqrt(square)
