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
    largest = largest_coordinate(v)
    real = cast("Any", type(largest))
    (low, up), (high, down) = _powers(largest)
    short, long = largest < 2.0**low, largest > 2.0**high
    scale = dr.select(short, real(2.0**up), dr.select(long, real(2.0**down), real(1)))
    back = dr.select(short, real(2.0**-up), dr.select(long, real(2.0**-down), real(1)))
    return dr.norm(v * scale) * back


def unit(v: Vec3) -> Vec3:
    """v/|v|, right for every vector whose largest component is a normal number."""
    largest = dr.detach(largest_coordinate(v))
    (low, _), (high, _) = _powers(largest)
    ordinary = (largest >= 2.0**low) & (largest <= 2.0**high)
    scaled = v / dr.select(ordinary, 1, largest)
    return scaled / dr.norm(scaled)


def largest_coordinate(v: Vec3) -> Real:
    """The largest of |x|, |y| and |z|."""
    return fmax(fmax(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z))


def _powers(x: Real) -> tuple[tuple[int, int], tuple[int, int]]:
    return _DOUBLE if dr.type_v(type(x)) == dr.VarType.Float64 else _SINGLE
