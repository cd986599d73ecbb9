"""The polar angle of a point z of the plane relative to a direction c near z. Both arithmetics of
this package compute it as an arc tangent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.arithmetic.angles import meets_branch_cut
from harnack.arithmetic.functions import atan, reciprocal

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


def relative_angle(y: Any, x: Any, y_near: Real, x_near: Real) -> tuple[Any, Mask, Real, Real]:
    """The angle from a vector c = (a, b) to z = (x, y), as the arc tangent of (y a - x b)/(x a + y
    b).

    y, x: numbers of the same arithmetic, with an attribute `range`. The box of z is that of their
        ranges.
    y_near, x_near: a point of the box. c is a vector in about its direction.

    Returns the angle, the mask of lanes on which it is the difference of the polar angles of z and
    of c, and a and b.

    Proof. For any vector c = (a, b), the angle of z = (x, y) is that of c plus that of (x a + y b,
    y a - x b), up to a multiple of 2 pi. If the box of z does not meet the cut of the angle, z and
    c lie in one of the half-planes x > 0, y > 0 and y < 0, so their angles differ by at most pi.
    Where x a + y b > 0, the angle of the second vector is an arc tangent, less than pi/2 in size.
    So the multiple is 0.
    """
    a, b = _approximate_direction(x_near, y_near)
    along_c, across_c = x * a + y * b, y * a - x * b
    angle = across_c.product(along_c.apply(reciprocal)).apply(atan)
    is_valid = ~meets_branch_cut(y.range, x.range) & (along_c.range.lower > 0)
    return angle, is_valid, a, b


def _approximate_direction(x: Real, y: Real) -> tuple[Real, Real]:
    """A vector in about the direction of (x, y), of a length between 1/2 and 2. It is (1, 0) if (x,
    y) is 0 or not finite."""
    size = dr.maximum(dr.abs(x), dr.abs(y))
    is_valid = (size > 0) & dr.isfinite(size)
    scale = dr.select(is_valid, 1 / size, 0)
    a, b = x * scale, y * scale
    # The length is now between 1 and sqrt 2.
    inverse_length = dr.rsqrt(dr.maximum(a * a + b * b, 1))
    return dr.select(is_valid, a * inverse_length, 1), dr.select(is_valid, b * inverse_length, 0)
