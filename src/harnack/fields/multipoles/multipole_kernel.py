"""What a node of a tree of dipoles adds to a field far from it: value, gradient, Hessian."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.fields.batch import SymmetricSum
from harnack.fields.sums import Terms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Real, Vec3


def far_terms(c: Sequence[Real], r: Vec3, inverse: Real, derivatives: int) -> Terms:
    """sum_l P_l(r)/r^(2l+1) for l = 1, 2, 3, and its derivatives, with the coefficients c that
    `multipole.cartesian` lays out; inverse = 1/|r|.

    derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian too. With u = 1/|r|,
    G_l = grad P_l (so that l P_l = G_l.r by Euler) and H_l the Hessian of P_l,

        f      = sum P_l u^(2l+1)
        grad f = sum G_l u^(2l+1) - s r,           s = sum (2l+1) P_l u^(2l+3)
        Hess f = sum H_l u^(2l+1) - (V r^T + r V^T) - s I + w r r^T,
                 V = sum (2l+1) G_l u^(2l+3),      w = sum (2l+1)(2l+3) P_l u^(2l+5).
    """
    vector = cast("Any", type(r))
    x, y, z = r
    u2 = inverse * inverse
    u3 = inverse * u2
    g1 = vector(c[0], c[1], c[2])
    czz = -(c[3] + c[4])
    half = vector(
        dr.fma(c[3], x, dr.fma(c[5], y, c[6] * z)),
        dr.fma(c[5], x, dr.fma(c[4], y, c[7] * z)),
        dr.fma(c[6], x, dr.fma(c[7], y, czz * z)),
    )
    xyy, xzz, xxy, yzz, xxz, yyz, xyz = c[8:15]
    xx, yy, zz = x * x, y * y, z * z
    # The gradient of P_3; x^3, y^3, z^3 have the coefficients that make it harmonic.
    g3 = vector(
        dr.fma(xyy, yy - xx, dr.fma(xzz, zz - xx, 2 * x * dr.fma(xxy, y, xxz * z)) + xyz * y * z),
        dr.fma(xxy, xx - yy, dr.fma(yzz, zz - yy, 2 * y * dr.fma(xyy, x, yyz * z)) + xyz * x * z),
        dr.fma(xxz, xx - zz, dr.fma(yyz, yy - zz, 2 * z * dr.fma(xzz, x, yzz * y)) + xyz * x * y),
    )
    u4 = u2 * u2
    p1 = dr.dot(g1, r)
    p2 = dr.dot(half, r) * u2
    p3 = dr.dot(g3, r) * (u4 * (1 / 3))
    value = (p1 + p2 + p3) * u3
    if derivatives == 0:
        return Terms(value)
    g2, g3 = half * (2 * u2), g3 * u4
    s = dr.fma(3, p1, dr.fma(5, p2, 7 * p3)) * u2
    gradient = dr.fma(vector(-s), r, g1 + g2 + g3) * u3
    if derivatives == 1:
        return Terms(value, gradient)
    return Terms(value, gradient, _hessian(c, r, (g1, g2, g3), (p1, p2, p3), (u2, u3)))


def _hessian(
    c: Sequence[Real], r: Vec3, g: tuple[Vec3, ...], p: tuple[Real, ...], u: tuple[Real, Real]
) -> SymmetricSum:
    """The Hessian of `far_terms`; g and p are scaled by powers of u to the size of the first."""
    x, y, z = r
    (g1, g2, g3), (p1, p2, p3), (u2, u3) = g, p, u
    u4 = u2 * u2
    s = dr.fma(3, p1, dr.fma(5, p2, 7 * p3)) * u2
    czz = -(c[3] + c[4])
    xyy, xzz, xxy, yzz, xxz, yyz, xyz = c[8:15]
    v = dr.fma(3, g1, dr.fma(5, g2, 7 * g3)) * u2
    w = dr.fma(15, p1, dr.fma(35, p2, 63 * p3)) * u4
    cubes = (
        -2 * dr.fma(xyy + xzz, x, -dr.fma(xxy, y, xxz * z)),
        -2 * dr.fma(xxy + yzz, y, -dr.fma(xyy, x, yyz * z)),
        -2 * dr.fma(xxz + yyz, z, -dr.fma(xzz, x, yzz * y)),
        dr.fma(2, dr.fma(xxy, x, xyy * y), xyz * z),
        dr.fma(2, dr.fma(xxz, x, xzz * z), xyz * y),
        dr.fma(2, dr.fma(yyz, y, yzz * z), xyz * x),
    )
    squares = (2 * c[3], 2 * c[4], 2 * czz, 2 * c[5], 2 * c[6], 2 * c[7])
    pairs = ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    crossed = (
        (v.x * x, v.x * x), (v.y * y, v.y * y), (v.z * z, v.z * z),
        (v.x * y, v.y * x), (v.x * z, v.z * x), (v.y * z, v.z * y),
    )  # fmt: skip
    parts = [
        (square * u2 + cube * u4 - one - other + w * a * b - (s if k < 3 else 0)) * u3
        for k, (square, cube, (one, other), (a, b)) in enumerate(
            zip(squares, cubes, crossed, pairs, strict=True)
        )
    ]
    return SymmetricSum(*parts)
