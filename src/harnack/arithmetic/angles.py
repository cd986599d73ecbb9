"""The polar angle `atan2` of a point (x, y) of the plane in radians, from -pi (excluded) to pi, and
its range on boxes. It has a cut {y = 0, x <= 0} along the negative x axis, where it jumps by 2 pi.
At the origin it has no value (there it counts as 0). On a box that meets the cut, its range is
[-pi, pi], and the ranges of its derivatives are all numbers. So no arithmetic takes the angle for a
continuous function there, and no step leads across the cut. A box is the set of all points (x, y)
with x and y in two intervals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.interval import Interval, machine_epsilon
from harnack.arithmetic.operators import FormulaNumber

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

__all__ = ["angle_range", "atan2"]

# A bound of the error of Dr.Jit's atan2, in units in the last place; measured: 3.3.
_MAX_ULP_ERROR = 8.0
# A number of double precision above pi.
_PI = math.nextafter(math.pi, 4.0)


def atan2(y: Any, x: Any) -> Any:
    """The polar angle of the point (x, y) in radians, -pi < angle <= pi.

    y, x: numbers of any kind: of an arithmetic, Dr.Jit or NumPy arrays or Python numbers.

    The angle jumps along the negative x axis. Nothing is proved there, so that a ray stops. If you
    need only its cosine or sine, x / norm(x, y) and y / norm(x, y) have no such cut.
    """
    if isinstance(y, FormulaNumber):
        return y.atan2(x)
    if isinstance(x, FormulaNumber):
        return x.coerce(y).atan2(x)
    if any(dr.is_array_v(cast("Any", type(number))) for number in (y, x)):
        return dr.atan2(y, x)
    return np.arctan2(y, x)


def meets_branch_cut(y: Interval, x: Interval) -> Mask:
    """A mask of the lanes on which the box of all points (x, y) may meet the cut {y = 0, x <= 0} of
    the polar angle. It is also set if an end is NaN.

    y, x: intervals whose ends are numbers of the backend.
    """
    return ~((x.lower > 0) | (y.lower > 0) | (y.upper < 0))


def angle_range(y: Interval, x: Interval) -> tuple[Interval, Mask]:
    """The range of the polar angle on the box of all points (x, y); and a mask of the lanes on
    which the box meets the cut {y = 0, x <= 0} of the angle.

    y, x: intervals whose ends are numbers of the backend.

    On a box that meets the cut the range is [-pi, pi]. Exception: for a box that is a single point
    of the cut other than the origin, it is the angle pi.

    Proof. Along an edge of the box the angle is monotone, because its derivative (y'x - x'y)/(x^2 +
    y^2) has one sign there. Inside of the box the angle has no extremum. So the ends of the range
    are at corners. The angle falls with x where y > 0 and rises with y where x > 0, which tells the
    corner. If a coordinate of the corner is infinite, the angle is the limit. Its two coordinates
    cannot both be infinite: if the corner of the largest angle has x = -infinity, y > 0 on the box
    (else it would meet the cut), and the corner has the lower y; if it has x = infinity, y <= 0 on
    the box, and the corner has the upper y.
    """
    meets_cut = meets_branch_cut(y, x)
    is_point = x.lower is x.upper and y.lower is y.upper
    pi = Interval.enclosing(_PI, type(x.lower)).upper
    # A point interval has the same object as both ends.
    if is_point:
        angle = dr.atan2(y.lower, x.lower)
        angle = dr.select((y.lower == 0) & (x.lower < 0), math.pi, angle)
        low, high = _widened(angle, angle)
        is_unknown = meets_cut & ~((y.lower == 0) & (x.lower < 0))
    else:
        y, x = _nan_to_infinite(y), _nan_to_infinite(x)
        # The smallest angle is minus the largest one of the box mirrored at the x axis.
        low, high = _widened(-_largest_angle(Interval(-y.upper, -y.lower), x), _largest_angle(y, x))
        is_unknown = meets_cut
    # An end that is NaN is unknown.
    low, high = (dr.select(end == end, end, sign * dr.inf) for end, sign in ((low, -1), (high, 1)))
    low, high = dr.maximum(low, -pi), dr.minimum(high, pi)
    return Interval(dr.select(is_unknown, -pi, low), dr.select(is_unknown, pi, high)), meets_cut


def _largest_angle(y: Interval, x: Interval) -> Real:
    """The largest polar angle on the box of all points (x, y), if the box does not meet the cut. It
    is the angle of a corner (`angle_range`)."""
    # The angle falls with x where y > 0, and rises with y where x > 0.
    corner_x = dr.select(y.upper > 0, x.lower, x.upper)
    corner_y = dr.select(corner_x > 0, y.upper, y.lower)
    # At an infinite corner the angle is that of the axis on which it lies.
    is_x_infinite, is_y_infinite = dr.isinf(corner_x), dr.isinf(corner_y)
    corner_x, corner_y = (
        dr.select(is_x_infinite, dr.sign(corner_x), dr.select(is_y_infinite, 0, corner_x)),
        dr.select(is_x_infinite, 0, dr.select(is_y_infinite, dr.sign(corner_y), corner_y)),
    )
    return dr.atan2(corner_y, corner_x)


def _widened(low: Real, high: Real) -> tuple[Real, Real]:
    """The lower and the upper end of the interval [low, high] of computed angles, both moved
    outwards by the error of the backend's atan2."""
    tiny = float(dr.smallest(cast("Any", type(low))))
    wide = Interval(low, high).widened(_MAX_ULP_ERROR * machine_epsilon(low), tiny)
    return wide.lower, wide.upper


def _nan_to_infinite(x: Interval) -> Interval:
    """The interval x, with infinite ends in place of ends that are NaN."""
    return Interval(
        dr.select(x.lower == x.lower, x.lower, -dr.inf),
        dr.select(x.upper == x.upper, x.upper, dr.inf),
    )
