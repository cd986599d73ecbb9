"""`Values`: the range of a formula on a box, and whether the formula is continuous there.

Ranges of derivatives prove long steps where a formula is smooth. Beside a vertical tangent, as that
of sqrt(|x|) at x = 0, they are unbounded, and where the formula has no value at all they prove
nothing. The range of values does prove steps there: sqrt(|x|) + 0.5 is at least 0.5, whatever its
slope.

`tally_of` determines the formulas for which this may be needed, before anything is recorded.
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


# Ranges beyond this power of the largest number belong to numbers that overflow, whatever their
# other end.
_LARGE = 0.5


@dataclass(frozen=True, eq=False)
class Values(FormulaNumber):
    """The range of a function on a box of its variables.

    value: its range, over the points of the box at which it has a value.
    nowhere: whether it has a value at no point of the box.
    jumps: whether it may jump, or have a pole, in the box: it is not proved to be continuous where
        it has a value. It also counts as jumping where numbers overflowed on the way to the value,
        unless they are known to be large: its range may then be far larger than its values.
    gaps: whether there may be points of the box at which it has no value.
    """

    value: Interval
    nowhere: Mask
    jumps: Mask
    gaps: Mask

    @classmethod
    def between(cls, p: Vec3, q: Vec3, slack: Real | None) -> tuple[Values, Values, Values]:
        """The coordinates on the smallest box around two points, `slack` larger on all sides."""
        no = p.x != p.x
        no = no & ~no
        padding = ZERO if slack is None else Interval(-slack, slack)
        x, y, z = (
            cls(Interval.point(p[k]).hull(Interval.point(q[k])) + padding, no, no, no)
            for k in range(3)
        )
        return x, y, z

    def constant(self, x: float | Real) -> Values:
        no = self.nowhere & ~self.nowhere
        kind = cast("Any", type(self.value.lower))
        if dr.is_array_v(cast("Any", type(x))):
            return Values(Interval.point(kind(x)), no, no, no)
        ends = Interval.enclosing(float(cast("Any", x)), kind)
        low = kind(ends.lower)
        return Values(
            Interval(low, low if ends.lower == ends.upper else kind(ends.upper)), no, no, no
        )

    def sum(self, other: Values) -> Values:
        return self._with(self.value + other.value, other)

    def product(self, other: Values) -> Values:
        if other is self:
            return self.apply(power(2))
        return self._with(self.value * other.value, other)

    def __neg__(self) -> Values:
        return Values(-self.value, self.nowhere, self.jumps, self.gaps)

    def __pow__(self, exponent: Any) -> Any:
        if isinstance(exponent, Values):
            return super().__pow__(exponent)
        return self.apply(power(exponent_of(exponent)))

    def apply(self, function: ElementaryFunction) -> Values:
        x = self.value
        value, (low, high) = function.ranges(x)[0], function.domain
        nowhere, gaps = self.nowhere, self.gaps
        if low > -math.inf:
            nowhere, gaps = nowhere | (x.upper < low), gaps | ~(x.lower >= low)
        if high < math.inf:
            nowhere, gaps = nowhere | (x.lower > high), gaps | ~(x.upper <= high)
        # The range of a box with a pole is all numbers.
        pole = _is_lost(value, 0.0 if function.has_pole else _LARGE)
        return Values(value, nowhere, self.jumps | _is_lost(x) | pole, gaps)

    def checked(self) -> Values:
        """The same range; it may jump where numbers that overflowed left no range."""
        return replace(self, jumps=self.jumps | _is_lost(self.value))

    def pointwise_maximum(self, other: Values) -> Values:
        """The larger of two functions. Where only one of them has a value, the result may count as
        that value or have none: the range holds both, and may jump."""
        x, y = self.value, other.value
        gaps = self.gaps | other.gaps
        either = _unless(self.nowhere, x, y).hull(_unless(other.nowhere, y, x))
        low = dr.select(gaps, either.lower, x.intersect(y).lower)
        return Values(
            Interval(low, either.upper),
            self.nowhere & other.nowhere,
            self.jumps | other.jumps | gaps | _is_lost(x) | _is_lost(y),
            gaps,
        )

    def polar_angle(self, x: Values) -> Values:
        value, met = angle_range(self.value, x.value)
        angle = self._with(value, x)
        jumps = angle.jumps | met | _is_lost(self.value) | _is_lost(x.value)
        return Values(value, angle.nowhere, jumps, angle.gaps)

    def _with(self, value: Interval, other: Values) -> Values:
        """The range of a function of this and another function."""
        return Values(
            value,
            self.nowhere | other.nowhere,
            self.jumps | other.jumps,
            self.gaps | other.gaps,
        )


def _is_lost(x: Interval, large: float = _LARGE) -> Mask:
    """Whether a range has an infinite end, and is not altogether beyond this power of the largest
    number; 0 for no such power."""
    lost = ~(dr.isfinite(x.lower) & dr.isfinite(x.upper))
    if large == 0.0:
        return lost
    limit = float(dr.largest(cast("Any", type(x.lower)))) ** large
    return lost & ~((x.lower > limit) | (x.upper < -limit))


def _unless(condition: Mask, x: Interval, y: Interval) -> Interval:
    """The interval x, or y where the condition holds."""
    return Interval(dr.select(condition, y.lower, x.lower), dr.select(condition, y.upper, x.upper))
