"""`Values`: the range of a formula on a box, and whether the formula is continuous there.

Ranges of derivatives prove long steps where a formula is smooth. Beside a vertical tangent, as that
of sqrt(|x|) at x = 0, they have no ends, and where the formula has no value at all they prove
nothing. The values themselves do: sqrt(|x|) + 0.5 is at least 0.5, whatever its slope.

`is_steep` says of which formulas this may be needed, before anything is recorded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.functions import power, sqrt
from harnack.arithmetic.interval import ZERO, Interval
from harnack.arithmetic.operators import Operators, exponent_of

if TYPE_CHECKING:
    from harnack.arithmetic.functions import Function
    from harnack.backend import Mask, Real, Vec3


@dataclass(frozen=True, eq=False)
class Values(Operators):
    """The range of a function on a box of its variables.

    value: its range, over the points of the box at which it has a value.
    nowhere: whether it has a value at no point of the box.
    jumps: whether it may jump, or have a pole, in the box: it is not proved to be continuous where
        it has a value.
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
        around = ZERO if slack is None else Interval(-slack, slack)
        x, y, z = (
            cls(Interval.exactly(p[k]).hull(Interval.exactly(q[k])) + around, no, no, no)
            for k in range(3)
        )
        return x, y, z

    def constant(self, x: float | Real) -> Values:
        no = self.nowhere & ~self.nowhere
        kind = cast("Any", type(self.value.low))
        if dr.is_array_v(cast("Any", type(x))):
            return Values(Interval.exactly(kind(x)), no, no, no)
        ends = Interval.constant(float(cast("Any", x)), kind)
        low = kind(ends.low)
        return Values(Interval(low, low if ends.low == ends.high else kind(ends.high)), no, no, no)

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

    def apply(self, function: Function) -> Values:
        x = self.value
        value, (low, high) = function.ranges(x)[0], function.domain
        nowhere, gaps = self.nowhere, self.gaps
        if low > -math.inf:
            nowhere, gaps = nowhere | (x.high < low), gaps | ~(x.low >= low)
        if high < math.inf:
            nowhere, gaps = nowhere | (x.low > high), gaps | ~(x.high <= high)
        # A pole in the box has all numbers for its range, and so has what overflows.
        pole = ~(dr.isfinite(value.low) & dr.isfinite(value.high))
        return Values(value, nowhere, self.jumps | pole, gaps)

    def larger(self, other: Values) -> Values:
        """The larger of two. Where only one of them has a value, it may count as that one or have
        none: the range holds both, and may jump."""
        x, y = self.value, other.value
        gaps = self.gaps | other.gaps
        either = _unless(self.nowhere, x, y).hull(_unless(other.nowhere, y, x))
        least = dr.select(gaps, either.low, x.meet(y).low)
        return Values(
            Interval(least, either.high),
            self.nowhere & other.nowhere,
            self.jumps | other.jumps | gaps,
            gaps,
        )

    def angle(self, x: Values) -> Values:
        value, met = angle_range(self.value, x.value)
        angle = self._with(value, x)
        return Values(value, angle.nowhere, angle.jumps | met, angle.gaps)

    def _with(self, value: Interval, other: Values) -> Values:
        """A range made of those of two functions."""
        return Values(
            value,
            self.nowhere | other.nowhere,
            self.jumps | other.jumps,
            self.gaps | other.gaps,
        )


def _unless(condition: Mask, x: Interval, y: Interval) -> Interval:
    """x, or y where the condition holds."""
    return Interval(dr.select(condition, y.low, x.low), dr.select(condition, y.high, x.high))


@dataclass(frozen=True, eq=False)
class _Steepness(Operators):
    """A number that notes whether a formula uses what may have a vertical tangent.

    noted: a list of one entry, which all numbers of the formula share.
    is_constant: whether it is the same everywhere, so that functions of it have no slope.
    is_square: whether it is a sum of squares. The root of one has no vertical tangent: with
        f = sqrt(u^2 + v^2), |grad f| <= |grad u| + |grad v|.
    """

    noted: list[bool]
    is_constant: bool = False
    is_square: bool = False

    def constant(self, x: Any) -> _Steepness:
        is_positive = isinstance(x, int | float) and x >= 0
        return _Steepness(self.noted, is_constant=True, is_square=is_positive)

    def sum(self, other: _Steepness) -> _Steepness:
        return self._with(other, self.is_square and other.is_square)

    def product(self, other: _Steepness) -> _Steepness:
        scaled = self.is_constant or other.is_constant
        is_square = scaled and self.is_square and other.is_square
        return self._with(other, other is self or is_square)

    def larger(self, other: _Steepness) -> _Steepness:
        return self._with(other)

    def __neg__(self) -> _Steepness:
        return self._with(self)

    def apply(self, function: Function) -> _Steepness:
        is_norm = function is sqrt and self.is_square
        self.noted[0] |= function.is_steep and not (self.is_constant or is_norm)
        return self._with(self, function.name == "power 2")

    def __pow__(self, exponent: Any) -> Any:
        if isinstance(exponent, _Steepness):
            return super().__pow__(exponent)
        n = exponent_of(exponent)
        return self.apply(sqrt if n == 0.5 else power(n))

    def angle(self, x: _Steepness) -> _Steepness:
        self.noted[0] |= not (self.is_constant and x.is_constant)
        return self._with(x)

    def norm_of_powers(self, p: float) -> _Steepness:
        del p
        return self._with(self)

    def _with(self, other: _Steepness, is_square: bool = False) -> _Steepness:
        return _Steepness(self.noted, self.is_constant and other.is_constant, is_square)


def is_steep(formula: Callable[[Any, Any, Any], Any]) -> bool:
    """Whether the slope of a formula of three coordinates may have no bound in a bounded box: it
    uses roots, powers below 1, quotients, logarithms and their like. A formula that accepts only
    ranges of derivatives, as those of the library's own shapes do, has bounded ones."""
    noted = [False]
    x, y, z = (_Steepness(noted) for _ in range(3))  # three, as x * x is a square and x * y is not
    try:
        formula(x, y, z)
    except (TypeError, AttributeError):
        return False
    return noted[0]
