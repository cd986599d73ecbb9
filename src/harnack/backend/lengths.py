"""Lengths of vectors whose squares would overflow or vanish."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3


# Vectors shorter than the first and longer than the last of these powers of two are multiplied by
# the power in between, which is exact: squares then neither vanish nor overflow.
_SINGLE, _DOUBLE = ((-50, 76), (60, -68)), ((-450, 572), (500, -524))


def length(v: Vec3) -> Real:
    """|v|, right for every vector of ordinary numbers; NaN if a component is NaN.

    `drjit.norm` squares first: in single precision it is 0 for vectors shorter than 1e-19, such as
    the gradient of a polynomial of degree 12 at a fiftieth of its size from a zero of that order.
    """
    largest = fmax(fmax(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z))
    real = cast("Any", type(largest))
    is_double = dr.type_v(real) == dr.VarType.Float64
    (low, up), (high, down) = _DOUBLE if is_double else _SINGLE
    short, long = largest < 2.0**low, largest > 2.0**high
    scale = dr.select(short, real(2.0**up), dr.select(long, real(2.0**down), real(1)))
    back = dr.select(short, real(2.0**-up), dr.select(long, real(2.0**-down), real(1)))
    return dr.norm(v * scale) * back
