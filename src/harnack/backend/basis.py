"""Directions at right angles to a direction: Duff et al. 2017, "Building an Orthonormal Basis,
Revisited"."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from harnack.backend.arrays import Vec3
    from harnack.backend.numbers import FloatArray


def across(d: Vec3) -> tuple[Vec3, Vec3]:
    """u and v with (u, v, d) orthonormal and right-handed, |d| = 1."""
    vector = cast("Any", type(d))
    sign = dr.select(d.z >= 0, type(d.z)(1), -1)
    a = -1 / (sign + d.z)
    b = d.x * d.y * a
    u = vector(dr.fma(sign * d.x, d.x * a, 1), sign * b, -sign * d.x)
    v = vector(b, dr.fma(d.y, d.y * a, sign), -d.y)
    return u, v


def across_rows(d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`across` of rows (n, 3) on the host."""
    x, y, z = d.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.column_stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.column_stack([b, sign + y * y * a, -y])
    return u, v
