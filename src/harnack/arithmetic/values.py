"""`Values`: the range of a formula on a box of its variables, and whether the formula is continuous
there. A range is an interval that is proved to contain all values. A formula has no value where it
takes, for example, the root of a negative number; it may jump at a pole or at the cut of a polar
angle (the negative x axis). A range is lost if an end is infinite or NaN, unless it is known to be
large, that is, if all of it is beyond a large number on one side of 0.

Ranges of derivatives prove long steps where a formula is smooth. Near a vertical tangent, such as
that of sqrt(|x|) at x = 0, they are unbounded, and where the formula has no value they prove
nothing. The range of values does prove steps there: sqrt(|x|) + 0.5 is at least 0.5, whatever its
slope.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.functions import power
from harnack.arithmetic.interval import ZERO, Interval
from harnack.arithmetic.operators import FormulaNumber, exponent_of

if TYPE_CHECKING:
    from harnack.arithmetic.functions import ElementaryFunction
    from harnack.backend import Mask, Real, Vec3


# The exponent e of `_is_lost`: a range with an infinite end counts as known to be large if its
# other end exceeds (largest number)^e.
_LARGE_EXPONENT = 0.5


@dataclass(frozen=True, eq=False)
class Values(FormulaNumber):
    """The range of a function on a box of its variables, and whether it is continuous and has a
    value everywhere in the box. All are known lane by lane. Three masks tell whether it has a value
    at no point of the box (`nowhere`), whether it may jump (`jumps`), and whether there may be
    points without a value (`gaps`).

    value: the range of its values, over the points of the box at which it has one.
    nowhere: whether it has a value at no point of the box.
    jumps: whether it may jump or have a pole in the box, that is, whether it is not proved to be
        continuous where it has a value. This is also set if numbers overflowed on the way to the
        value, unless they are known to be large: the range may then be far larger than the values.
    gaps: whether there may be points of the box at which it has no value.
    """

    value: Interval
    nowhere: Mask
    jumps: Mask
    gaps: Mask

    @classmethod
    def between(cls, p: Vec3, q: Vec3, slack: Real | None) -> tuple[Values, Values, Values]:
        """The three coordinates on the smallest box that contains the points p and q.

        slack: a length by which the box is larger on all sides; None for 0.
        """
        # Any mask in the width of p, and then False on each lane.
        is_never = p.x != p.x
        is_never = is_never & ~is_never
        padding = ZERO if slack is None else Interval(-slack, slack)
        x, y, z = (
            cls(
                Interval.point(p[k]).hull(Interval.point(q[k])) + padding,
                is_never,
                is_never,
                is_never,
            )
            for k in range(3)
        )
        return x, y, z

    def constant(self, x: float | Real) -> Values:
        """The constant number x as a function on the same box."""
        # False on each lane.
        is_never = self.nowhere & ~self.nowhere
        number_type = cast("Any", type(self.value.lower))
        if dr.is_array_v(cast("Any", type(x))):
            return Values(Interval.point(number_type(x)), is_never, is_never, is_never)
        ends = Interval.enclosing(float(cast("Any", x)), number_type)
        low = number_type(ends.lower)
        return Values(
            Interval(low, low if ends.lower == ends.upper else number_type(ends.upper)),
            is_never,
            is_never,
            is_never,
        )

    def constant_between(self, lower: Real, upper: Real) -> Values:
        is_never = self.nowhere & ~self.nowhere
        return Values(Interval(lower, upper), is_never, is_never, is_never)

    def sum(self, other: Values) -> Values:
        """The sum of this function and another one."""
        return self._with(self.value + other.value, other)

    def product(self, other: Values) -> Values:
        """The product of this function and another one; the product of a function with itself is
        its square, whose range is sharper."""
        if other is self:
            return self.apply(power(2))
        return self._with(self.value * other.value, other)

    def __neg__(self) -> Values:
        return Values(-self.value, self.nowhere, self.jumps, self.gaps)

    def __pow__(self, exponent: Any) -> Any:
        """This function to a power."""
        if isinstance(exponent, Values):
            return super().__pow__(exponent)
        return self.apply(power(exponent_of(exponent)))

    def apply(self, function: ElementaryFunction) -> Values:
        """The composition of an elementary function with this function. It has no value where this
        function is outside of the elementary function's domain. It may jump if its range is lost,
        or if it may have a pole."""
        x = self.value
        # The first result of `ranges` is the range of the function itself.
        value, (domain_low, domain_high) = function.ranges(x)[0], function.domain
        nowhere, gaps = self.nowhere, self.gaps
        if domain_low > -math.inf:
            nowhere, gaps = nowhere | (x.upper < domain_low), gaps | ~(x.lower >= domain_low)
        if domain_high < math.inf:
            nowhere, gaps = nowhere | (x.lower > domain_high), gaps | ~(x.upper <= domain_high)
        # On a box with a pole the range of the function is all numbers.
        may_have_pole = _is_lost(value, 0.0 if function.has_pole else _LARGE_EXPONENT)
        return Values(value, nowhere, self.jumps | _is_lost(x) | may_have_pole, gaps)

    def checked(self) -> Values:
        """This function, with `jumps` also set where numbers overflowed so that no range is
        known."""
        return replace(self, jumps=self.jumps | _is_lost(self.value))

    def pointwise_maximum(self, other: Values) -> Values:
        """The larger of this function and another one at each point.

        At a point where only one of the two functions has a value, the result may count as that
        value or as having none. So if there may be such points, the range contains the ranges of
        both functions, and the result may jump.
        """
        x, y = self.value, other.value
        gaps = self.gaps | other.gaps
        # x, or y where this function has no value at all; and the other way round.
        either = _unless(self.nowhere, x, y).hull(_unless(other.nowhere, y, x))
        # Without such points it is the larger of both lower ends.
        low = dr.select(gaps, either.lower, x.intersect(y).lower)
        return Values(
            Interval(low, either.upper),
            self.nowhere & other.nowhere,
            self.jumps | other.jumps | gaps | _is_lost(x) | _is_lost(y),
            gaps,
        )

    def polar_angle(self, x: Values) -> Values:
        """The polar angle of the point (x, y), where y is this function. It may jump if the box
        meets the cut of the angle, the negative x axis."""
        value, meets_cut = angle_range(self.value, x.value)
        angle = self._with(value, x)
        jumps = angle.jumps | meets_cut | _is_lost(self.value) | _is_lost(x.value)
        return Values(value, angle.nowhere, jumps, angle.gaps)

    def _with(self, value: Interval, other: Values) -> Values:
        """A function with the range `value` that was computed from this function and another one.
        It has no value at points where one of the two functions has none, and may jump where one of
        them may jump."""
        return Values(
            value,
            self.nowhere | other.nowhere,
            self.jumps | other.jumps,
            self.gaps | other.gaps,
        )


def _is_lost(x: Interval, large: float = _LARGE_EXPONENT) -> Mask:
    """A mask of the lanes on which a range has an infinite end or NaN, and is not known to be
    large.

    large: an exponent e. The range is known to be large if all of it is above L^e or below -L^e,
        where L is the largest number of its precision. With e = 0.0, no range with an infinite end
        or NaN counts as known to be large.
    """
    lost = ~(dr.isfinite(x.lower) & dr.isfinite(x.upper))
    if large == 0.0:
        return lost
    limit = float(dr.largest(cast("Any", type(x.lower)))) ** large
    return lost & ~((x.lower > limit) | (x.upper < -limit))


def _unless(condition: Mask, x: Interval, y: Interval) -> Interval:
    """The interval x on lanes where the condition does not hold, y on lanes where it does."""
    return Interval(dr.select(condition, y.lower, x.lower), dr.select(condition, y.upper, x.upper))
