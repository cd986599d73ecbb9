"""Intervals: ranges [lower, upper] of real numbers, rounded outwards. The result of every operation
contains the exact result for all numbers of its operands, in spite of the backend's rounding. So
the ranges of a function and of its derivatives are proved (Moore 1966). An interval in Python
floats is a constant that is known while Dr.Jit records code; a point interval has the same object
as both ends (`lower is upper`), so that operations on it are done once. A unit is a unit in the
last place.

A single rounding in float32 that violates an enclosure may cause a missed hit; therefore ranges are
rounded outwards. Where ranges of a function's derivatives are computed along a path, a piece of a
ray, the path can be cut into pieces with ranges of their own (`PathRestriction.piece_count`). By
measurement four pieces are best for sums of blobs, as all pieces share the search for nearby blobs,
and one piece for formulas.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Interval:
    """All numbers from `lower` to `upper`, which are Dr.Jit numbers of the same type, or Python
    floats. An end that is NaN stands for an infinite end: nothing is known on that side. Python
    floats are constants that are known while Dr.Jit records code, so that some operations with them
    can be left out. Results of operations are rounded outwards.

    is_single: whether ends that are Python floats are kept at numbers of single precision. They
        must be if they meet arrays of single precision: there other numbers would be rounded,
        perhaps inwards.

    Proof of the rounding. An operation of the backend has an error of at most half a unit in the
    last place, or less than the smallest normal number if the result is not a normal number. Each
    end is moved outwards by a whole unit (`round_down`, `round_up`), which covers its own
    rounding and that of the move. A sum that is not a normal number is exact, or 0 on a backend
    that flushes it. In this case its error is less than the smallest normal number, which the
    tracer adds to every value.
    """

    lower: Real
    upper: Real
    is_single: bool = False

    @classmethod
    def point(cls, x: Real) -> Interval:
        """The interval [x, x]. Both ends are the same object."""
        return cls(x, x)

    @classmethod
    def enclosing(cls, x: float, like: Any) -> Interval:
        """The narrowest interval that contains the Python number x and whose ends are numbers of
        the precision of `like`, a Dr.Jit number: in single precision they are rounded outwards. The
        ends are Python floats."""
        if dr.is_array_v(like) and dr.type_v(like) == dr.VarType.Float32:
            return cls(*_outward_single(float(x), float(x)), is_single=True)
        return cls(float(x), float(x))

    @property
    def is_literal(self) -> bool:
        """Whether both ends are Python floats, which are known while Dr.Jit records code."""
        return isinstance(self.lower, float) and isinstance(self.upper, float)

    @property
    def is_zero(self) -> bool:
        """Whether the interval is [0, 0] in Python floats, which is known while Dr.Jit records
        code."""
        return self.is_literal and self.lower == 0.0 == self.upper

    @property
    def midpoint(self) -> Real:
        """A number about half way between the ends."""
        if self.lower is self.upper:
            return self.lower
        return 0.5 * self.lower + 0.5 * self.upper

    @property
    def radius(self) -> Real:
        """An upper bound of the distance from `midpoint` to the numbers of the interval."""
        if self.lower is self.upper:
            return 0.0
        return round_up(0.5 * self.upper - 0.5 * self.lower)

    @property
    def max_abs(self) -> Real:
        """The largest absolute value of the numbers of the interval; NaN if an end is NaN."""
        return _maximum_or_nan(_absolute(self.lower), _absolute(self.upper))

    @property
    def min_abs(self) -> Real:
        """The smallest absolute value of the numbers of the interval, which is 0 if the interval
        contains 0."""
        return _maximum(-self.upper, _maximum(self.lower, 0.0))

    def hull(self, other: Interval) -> Interval:
        """The smallest interval that contains this interval and the other one."""
        low = -_maximum_or_nan(-self.lower, -other.lower)
        high = _maximum_or_nan(self.upper, other.upper)
        return Interval(low, high, self.is_single or other.is_single)

    def intersect(self, other: Interval) -> Interval:
        """The intersection with an interval that is known to overlap this one. If an end of one of
        the two is NaN (unknown), the end of the other one is taken."""
        return Interval(
            _maximum_ignoring_nan(self.lower, other.lower),
            _minimum_ignoring_nan(self.upper, other.upper),
            self.is_single or other.is_single,
        )

    def __neg__(self) -> Interval:
        """The interval of all -x for x in the interval. The result for a point interval is a point
        interval."""
        if self.lower is self.upper:
            low = -self.lower
            return Interval(low, low, self.is_single)
        return Interval(-self.upper, -self.lower, self.is_single)

    def __add__(self, other: Interval) -> Interval:
        """The interval of all sums of a number of this interval and one of the other."""
        if other.is_zero:
            return self
        if self.is_zero:
            return other
        return self._rounded_outward(self.lower + other.lower, self.upper + other.upper, other)

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        """The interval of all products of a number of this interval and one of the other. An
        interval of Python floats is multiplied as a constant, with fewer operations. On lanes where
        an end is infinite and the other 0, the product may be all numbers."""
        if self.is_zero or other.is_zero:
            return ZERO
        if self.is_literal:
            return other._times(self)
        if other.is_literal:
            return self._times(other)
        end_products = (
            self.lower * other.lower,
            self.lower * other.upper,
            self.upper * other.lower,
            self.upper * other.upper,
        )
        # A point interval has fewer different products of ends.
        if self.lower is self.upper or other.lower is other.upper:
            end_products = (end_products[0], end_products[3])
        if self.lower is self.upper and other.lower is other.upper:
            end_products = (end_products[0],)
        low = high = end_products[0]
        for product in end_products[1:]:
            low, high = _minimum(low, product), _maximum(high, product)
        # On lanes where a product is NaN (0 times infinity), the result is all numbers. (The mask
        # is never None.)
        is_valid = _none_is_nan(end_products)
        if is_valid is not None:
            low, high = dr.select(is_valid, low, -dr.inf), dr.select(is_valid, high, dr.inf)
        # `pad_underflow` moves a number down (-1) or up (1) by what underflow may have cut off.
        return Interval(round_down(pad_underflow(low, -1)), round_up(pad_underflow(high, 1)))

    def _times(self, constant: Interval) -> Interval:
        """The product with an interval of Python floats, whose signs are known while Dr.Jit records
        code. The constant is not [0, 0], a case that `__mul__` has done already."""
        a, b = cast("tuple[float, float]", (constant.lower, constant.upper))
        if a == b == 1.0:
            return self
        if a == b == -1.0:
            return -self
        # (`pad_underflow` moves a number down (-1) or up (1) by what underflow may have cut off.)
        # The constant may have either sign: the range is symmetric.
        if a < 0.0 < b:
            bound = pad_underflow(self.max_abs * max(-a, b), 1)
            return self._rounded_outward(-bound, bound, constant)
        if b <= 0.0:
            return -self._times(Interval(-b, -a, constant.is_single))
        if a == b <= 1.0 and np.frexp(a)[0] == 0.5:  # a power of two: exact, but for underflow
            low, high = pad_underflow(self.lower * a, -1), pad_underflow(self.upper * a, 1)
            return Interval(low, high, self.is_single or constant.is_single)
        # The constant is positive: whether a or b gives the lowest product depends on the sign of
        # `lower`.
        low = self.lower * a if a == b else _minimum(self.lower * a, self.lower * b)
        high = self.upper * b if a == b else _maximum(self.upper * a, self.upper * b)
        return self._rounded_outward(pad_underflow(low, -1), pad_underflow(high, 1), constant)

    def square(self) -> Interval:
        """The range of x^2 for x in the interval. It is at least 0."""
        low, high = self.min_abs, self.max_abs
        if self.lower is self.upper:
            low = high
        # `pad_underflow` moves a number down (-1) or up (1) by what underflow may have cut off.
        result = self._rounded_outward(pad_underflow(low * low, -1), pad_underflow(high * high, 1))
        return Interval(_maximum(result.lower, 0.0), result.upper, self.is_single)

    def reciprocal(self) -> Interval:
        """The range of 1/x for x in the interval; all numbers if 0 lies in it."""
        if self.is_literal:
            if self.lower <= 0.0 <= self.upper:
                return Interval(-math.inf, math.inf, self.is_single)
            return self._rounded_outward(1 / self.upper, 1 / self.lower)
        has_zero = ~((self.lower > 0) | (self.upper < 0))
        # The error of quotients is two units on CUDA. (`pad_underflow` moves a number down (-1) or
        # up (1) by what underflow may have cut off.)
        low = round_down(pad_underflow(1 / self.upper, -1), 4.0)
        high = round_up(pad_underflow(1 / self.lower, 1), 4.0)
        return Interval(dr.select(has_zero, -dr.inf, low), dr.select(has_zero, dr.inf, high))

    def _rounded_outward(self, low: Real, high: Real, other: Interval | None = None) -> Interval:
        """The interval [low, high], whose ends were computed with rounding, with its ends moved
        outwards by that rounding.

        other: the second operand of the operation, if there is one. If this interval or `other` is
            of single precision (`is_single`), so is the result.
        """
        single = self.is_single or (other is not None and other.is_single)
        low, high = round_down(low), round_up(high)
        if single and isinstance(low, float) and isinstance(high, float):
            low, high = _outward_single(low, high)
        return Interval(low, high, single)

    def widened(self, relative: float, absolute: float = 0.0) -> Interval:
        """The interval with each end x moved outwards by relative * |x| + absolute. If the ends
        were computed by a function of the backend with these relative and absolute errors, the
        result contains the exact ends."""
        low, high = self.lower, self.upper
        return Interval(
            round_down(low - relative * _absolute(low) - absolute),
            round_up(high + relative * _absolute(high) + absolute),
        )


ZERO = Interval(0.0, 0.0)
ONE = Interval(1.0, 1.0)


def machine_epsilon(x: Real) -> float:
    """The distance from 1 to the next number, in the precision of x."""
    return _limits_of(cast("Any", type(x)))[0]


def smallest_normal(x: Real) -> float:
    """The smallest normal number in the precision of x, a Dr.Jit number; 0 for a Python number."""
    return _limits_of(cast("Any", type(x)))[1]


@functools.cache
def _limits_of(kind: type[Any]) -> tuple[float, float]:
    """`machine_epsilon` and `smallest_normal` of numbers of a type. (Dr.Jit's own functions take as
    long as recording an operation.)"""
    if dr.is_array_v(kind):
        return float(dr.epsilon(kind)) * 2, float(dr.smallest(kind))
    return 2.0**-52, 0.0


def typed_select(condition: Mask, a: Real, b: Real, like: Real) -> Real:
    """a on lanes where the condition holds, else b, with numbers of the type of `like`.

    From two Python numbers Dr.Jit's select would make integers or numbers of single precision.
    """
    kind = cast("Any", type(like))
    return dr.select(condition, kind(a) if dr.is_array_v(kind) else a, b)


def round_down(x: Real, units: float = 1.0) -> Real:
    """x minus at least `units` units in the last place of x."""
    return dr.fma(dr.abs(x), -units * machine_epsilon(x), x)


def round_up(x: Real, units: float = 1.0) -> Real:
    """x plus at least `units` units in the last place of x."""
    return dr.fma(dr.abs(x), units * machine_epsilon(x), x)


def pad_underflow(x: Real, sign: int) -> Real:
    """The computed product x, moved up (sign 1) or down (-1) by the largest error that underflow
    causes. A Python float stays as it is."""
    smallest = smallest_normal(x)
    return x + sign * smallest if smallest else x


def _outward_single(low: float, high: float) -> tuple[float, float]:
    """The largest number of single precision that is at most `low`, and the smallest that is at
    least `high`."""
    with np.errstate(over="ignore"):
        single_low, single_high = np.float32(low), np.float32(high)
    if float(single_low) > low:
        single_low = np.nextafter(single_low, np.float32(-np.inf))
    if float(single_high) < high:
        single_high = np.nextafter(single_high, np.float32(np.inf))
    return float(single_low), float(single_high)


def _minimum(a: Real, b: Real) -> Real:
    """The smaller number, a Python float if both are Python floats. If one is NaN on a lane of an
    array, it is the other number."""
    if isinstance(a, float) and isinstance(b, float):
        return min(a, b)
    return fmin(a, b)


def _maximum(a: Real, b: Real) -> Real:
    """The larger number, a Python float if both are Python floats. If one is NaN on a lane of an
    array, it is the other number."""
    if isinstance(a, float) and isinstance(b, float):
        return max(a, b)
    return fmax(a, b)


def _maximum_or_nan(a: Real, b: Real) -> Real:
    """The larger number; NaN if either number is NaN."""
    if isinstance(a, float) and isinstance(b, float):
        return math.nan if a != a or b != b else max(a, b)
    return dr.select((a > b) | dr.isnan(a), a, b)


def _minimum_ignoring_nan(a: Real, b: Real) -> Real:
    """The smaller number; if one is NaN, the other number."""
    return dr.select((a <= b) | dr.isnan(b), a, b)


def _maximum_ignoring_nan(a: Real, b: Real) -> Real:
    """The larger number; if one is NaN, the other number."""
    return dr.select((a >= b) | dr.isnan(b), a, b)


def _absolute(x: Real) -> Real:
    """|x|, a Python float if x is one."""
    return abs(x) if isinstance(x, float) else dr.abs(x)


def _none_is_nan(numbers: tuple[Real, ...]) -> Mask | None:
    """A mask of the lanes on which the sum of the numbers is a number. The sum is NaN if one of the
    numbers is, or if two of them are opposite infinities. The result is never None."""
    total = numbers[0]
    for number in numbers[1:]:
        total = total + number
    return total == total
