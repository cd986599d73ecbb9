"""Lengths of vectors whose squares would overflow or vanish."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3


def length(v: Vec3) -> Real:
    """|v|, right for every vector of ordinary numbers; NaN if a component is NaN.

    `drjit.norm` squares first: in single precision it is 0 for vectors shorter than 1e-19, such as
    the gradient of a polynomial of degree 12 at a fiftieth of its size from a zero of that order.
    """
    largest = fmax(fmax(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z))
    return dr.select(largest > 0, largest * dr.norm(v / largest), largest)
