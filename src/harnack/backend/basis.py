"""Directions at right angles to a direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend.arrays import Vec3


def across(d: Vec3) -> tuple[Vec3, Vec3]:
    """u and v with (u, v, d) orthonormal and right-handed, |d| = 1.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
    vector = cast("Any", type(d))
    sign = dr.select(d.z >= 0, type(d.z)(1), -1)
    a = -1 / (sign + d.z)
    b = d.x * d.y * a
    u = vector(dr.fma(sign * d.x, d.x * a, 1), sign * b, -sign * d.x)
    v = vector(b, dr.fma(d.y, d.y * a, sign), -d.y)
    return u, v
