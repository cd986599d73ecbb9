"""Intervals: ranges of real numbers, rounded outwards.

Every operation gives an interval that holds the result for all numbers of its operands, in the
rounded arithmetic of the backend too. That is what makes ranges of a function, and of its
derivatives, proofs (Moore 1966).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

Number: TypeAlias = "Interval | float"


@dataclass(frozen=True)
class Interval:
    """All numbers from `low` to `high`, Dr.Jit numbers of one kind or Python floats.

    An end that is not a number stands for an infinite one: nothing is known on that side. Python
    floats are constants known while a kernel is recorded; with them, operations are left out.

    Proof of the rounding. An operation of the backend is off by half a unit in the last place, or
    by less than the smallest normal number where the result is no normal number. Each end is moved
    outwards by a whole unit (`_down`, `_up`), which covers its own rounding and that of the move.
    Python's own floats are in double precision and are rounded to single precision where they meet
    it; then they count as the interval of the two neighbours (`constant`).
    """

    low: Real
    high: Real

    @classmethod
    def exactly(cls, x: Real) -> Interval:
        """The number x alone."""
        return cls(x, x)

    @classmethod
    def constant(cls, x: float, like: Any) -> Interval:
        """A Python number x, as far as numbers of the type `like` hold it."""
        if dr.is_array_v(like) and dr.type_v(like) == dr.VarType.Float32:
            single = np.float32(x)
            if float(single) != x:
                return cls(
                    float(np.nextafter(single, np.float32(-np.inf))),
                    float(np.nextafter(single, np.float32(np.inf))),
                )
        return cls(float(x), float(x))

    @property
    def is_static(self) -> bool:
        """Whether it is known while a kernel is being recorded."""
        return isinstance(self.low, float) and isinstance(self.high, float)

    @property
    def is_zero(self) -> bool:
        """Whether it is known, while a kernel is being recorded, to be 0 alone."""
        return self.is_static and self.low == 0.0 == self.high

    @property
    def middle(self) -> Real:
        """A number of the interval, half way."""
        if self.low is self.high:
            return self.low
        return 0.5 * self.low + 0.5 * self.high

    @property
    def radius(self) -> Real:
        """How far numbers of the interval are from `middle` at most."""
        if self.low is self.high:
            return 0.0
        return _up(0.5 * self.high - 0.5 * self.low)

    @property
    def largest(self) -> Real:
        """The largest absolute value."""
        return _larger(_absolute(self.low), _absolute(self.high))

    @property
    def smallest(self) -> Real:
        """The smallest absolute value."""
        return _larger(_larger(self.low, 0.0), -self.high)

    def holds(self, x: Real) -> Mask:
        """Whether x lies in the interval."""
        return ~((x < self.low) | (x > self.high))

    def hull(self, other: Interval) -> Interval:
        """The smallest interval that holds both."""
        return Interval(_smaller(self.low, other.low), _larger(self.high, other.high))

    def meet(self, other: Interval) -> Interval:
        """What both hold, of two that are known to hold a common number; an end that is not a
        number gives way."""
        return Interval(
            _defined_larger(self.low, other.low), _defined_smaller(self.high, other.high)
        )

    def shifted(self, x: Real) -> Interval:
        """The interval plus one exact number."""
        return self + Interval(x, x)

    def __neg__(self) -> Interval:
        if self.low is self.high:
            low = -self.low
            return Interval(low, low)
        return Interval(-self.high, -self.low)

    def __add__(self, other: Interval) -> Interval:
        if other.is_zero:
            return self
        if self.is_zero:
            return other
        return Interval(_down(self.low + other.low), _up(self.high + other.high))

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        if self.is_zero or other.is_zero:
            return ZERO
        if self.is_static:
            return other._times(self)
        if other.is_static:
            return self._times(other)
        ends = (
            self.low * other.low,
            self.low * other.high,
            self.high * other.low,
            self.high * other.high,
        )
        if self.low is self.high or other.low is other.high:
            ends = (ends[0], ends[3])
        if self.low is self.high and other.low is other.high:
            ends = (ends[0],)
        low = high = ends[0]
        for one in ends[1:]:
            low, high = _smaller(low, one), _larger(high, one)
        # 0 times infinity is not a number: the smaller of others may then be wrong.
        known = _all_defined(ends)
        if known is not None:
            low, high = dr.select(known, low, -dr.inf), dr.select(known, high, dr.inf)
        return Interval(_down(_lost(low, -1)), _up(_lost(high, 1)))

    def _times(self, constant: Interval) -> Interval:
        """The product with an interval of Python floats that hold no zero inside."""
        a, b = cast("tuple[float, float]", (constant.low, constant.high))
        if a == b == 1.0:
            return self
        if a == b == -1.0:
            return -self
        if a < 0.0 < b:
            most = self.largest * max(-a, b)
            return Interval(_down(-most), _up(most))
        if b <= 0.0:
            return -self._times(Interval(-b, -a))
        if a == b and np.frexp(a)[0] == 0.5:  # exact, but for what underflows
            return Interval(_lost(self.low * a, -1), _lost(self.high * a, 1))
        low = self.low * a if a == b else _smaller(self.low * a, self.low * b)
        high = self.high * b if a == b else _larger(self.high * a, self.high * b)
        return Interval(_down(_lost(low, -1)), _up(_lost(high, 1)))

    def square(self) -> Interval:
        """The squares."""
        low, high = self.smallest, self.largest
        if self.low is self.high:
            low = high
        return Interval(_larger(_down(_lost(low * low, -1)), 0.0), _up(_lost(high * high, 1)))

    def reciprocal(self) -> Interval:
        """1/x; all numbers where 0 lies in the interval."""
        has_zero = (self.low <= 0) & (self.high >= 0)
        low, high = _down(_lost(1 / self.high, -1)), _up(_lost(1 / self.low, 1))
        return Interval(dr.select(has_zero, -dr.inf, low), dr.select(has_zero, dr.inf, high))

    def widened(self, relative: float, absolute: float = 0.0) -> Interval:
        """With each end moved outwards by a part of itself and an absolute length, for functions
        of the backend that are accurate to so much."""
        low, high = self.low, self.high
        return Interval(
            _down(low - relative * _absolute(low) - absolute),
            _up(high + relative * _absolute(high) + absolute),
        )


ZERO = Interval(0.0, 0.0)
ONE = Interval(1.0, 1.0)


def unit_of(x: Real) -> float:
    """The distance from 1 to the next number of x's precision."""
    return float(dr.epsilon(type(x))) * 2 if dr.is_array_v(cast("Any", type(x))) else 2.0**-52


def _down(x: Real) -> Real:
    """A number below x, by a whole unit in the last place at least."""
    return dr.fma(dr.abs(x), -unit_of(x), x)


def _up(x: Real) -> Real:
    """A number above x, by a whole unit in the last place at least."""
    return dr.fma(dr.abs(x), unit_of(x), x)


def _lost(x: Real, sign: int) -> Real:
    """x, moved by what underflow may have taken from a product."""
    kind = cast("Any", type(x))
    return x + sign * float(dr.smallest(kind)) if dr.is_array_v(kind) else x


def _smaller(a: Real, b: Real) -> Real:
    if isinstance(a, float) and isinstance(b, float):
        return min(a, b)
    return fmin(a, b)


def _larger(a: Real, b: Real) -> Real:
    if isinstance(a, float) and isinstance(b, float):
        return max(a, b)
    return fmax(a, b)


def _defined_smaller(a: Real, b: Real) -> Real:
    """The smaller; a where b is not a number, and b where a is not."""
    return dr.select((a <= b) | ~(b == b), a, b)


def _defined_larger(a: Real, b: Real) -> Real:
    return dr.select((a >= b) | ~(b == b), a, b)


def _absolute(x: Real) -> Real:
    return abs(x) if isinstance(x, float) else dr.abs(x)


def _all_defined(numbers: tuple[Real, ...]) -> Mask | None:
    total = numbers[0]
    for one in numbers[1:]:
        total = total + one
    return total == total
