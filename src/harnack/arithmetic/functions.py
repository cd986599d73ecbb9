"""Elementary functions, such as sin and exp: the ranges of their values and of their first two
derivatives on intervals. A range is an interval that is proved to contain all values, rounding
included. An `ElementaryFunction` serves every arithmetic: it evaluates the function for plain
numbers, and bounds the ranges of the function and of its derivatives on an interval x of arguments.
A point interval has the same object as both ends (`x.lower is x.upper`), so that functions of it
are computed once. The functions `sin`, `exp` and so on take numbers of any arithmetic, Dr.Jit and
NumPy arrays, and Python numbers."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.interval import (
    ONE,
    ZERO,
    Interval,
    machine_epsilon,
    pad_underflow,
    round_down,
    round_up,
    smallest_normal,
    typed_select,
)
from harnack.backend.elementary import clamp, fmax, fmin, max_sincos_argument, sincos

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

DerivativeRanges: TypeAlias = "tuple[Interval, Interval, Interval]"

# The domain of roots, powers that are no integers, and logarithms.
_POSITIVE = (0.0, math.inf)
# No function here overflows if its exact value is below this fraction of the largest number; LLVM's
# exp overflows from 0.7 on.
_SAFE_FRACTION = 1 / 16
# An interval of angles of at most this many roundings counts as a point.
_POINT_ROUNDINGS = 64.0
# A bound of the error of exp, log and the like on every backend, in units in the last place.
_MAX_ULP_ERROR = 8.0


@dataclass(frozen=True)
class ElementaryFunction:
    """A function of a single variable, such as sin, that every arithmetic can apply to its numbers:
    it can be evaluated for plain numbers, and it can bound its own values and derivatives on an
    interval.

    ranges: a callable that returns the ranges of the function, of its derivative and of its second
        derivative on an interval whose ends are Dr.Jit numbers. If the interval contains a pole, or
        a point at which the function is not defined, the ranges of derivatives are all numbers:
        f(s) = f(0) + s f'(r) does not hold across such a point.
    on_drjit: evaluates the function for Dr.Jit numbers.
    on_numpy: evaluates the function for NumPy arrays and Python numbers.
    domain: the smallest and the largest number at which the function has a value.
    is_steep: whether there is a point near which the function's slope is unbounded: a pole or a
        vertical tangent.
    has_pole: whether there is a point at which the function is not continuous.
    """

    name: str
    ranges: Callable[[Interval], DerivativeRanges]
    on_drjit: Callable[[Any], Any]
    on_numpy: Callable[[Any], Any]
    domain: tuple[float, float] = (-math.inf, math.inf)
    is_steep: bool = False
    has_pole: bool = False

    def __reduce__(self) -> str:
        # There is one function of each name, in this module.
        return "absolute" if self.name == "abs" else self.name

    def __call__(self, x: Any) -> Any:
        """The function of x. x is a number of any arithmetic, a Dr.Jit or NumPy array or a Python
        number."""
        if hasattr(x, "apply"):
            return x.apply(self)
        if dr.is_array_v(type(x)):
            return self.on_drjit(x)
        return self.on_numpy(x)


def _increasing_range(f: Callable[[Any], Any], x: Interval) -> Interval:
    """The range, on the interval x, of an increasing function f whose computed values have an error
    of at most `_MAX_ULP_ERROR` units in the last place."""
    low = f(x.lower)
    # A point interval has the same object as both ends.
    high = low if x.lower is x.upper else f(x.upper)
    return Interval(low, high).widened(
        _MAX_ULP_ERROR * machine_epsilon(x.lower), _smallest_normal(x)
    )


def _smallest_normal(x: Interval) -> float:
    """The smallest normal number in the precision of the interval's ends."""
    return smallest_normal(x.lower)


def _twice(x: Interval) -> Interval:
    """The interval of all 2 y for y in x."""
    return x + x


def _unbounded_unless_defined(defined: Mask, ranges: DerivativeRanges) -> DerivativeRanges:
    """Return the three `ranges`, with the ranges of both derivatives replaced by all numbers on
    lanes where `defined` is False: there the function has a pole or no value somewhere in the
    interval.

    ranges: of the function, of its derivative and of its second derivative.
    """
    value, *derivatives = ranges
    # (The last argument of `typed_select` tells the type of the numbers only.)
    slope, second = (
        Interval(
            typed_select(defined, derivative.lower, -dr.inf, value.lower),
            typed_select(defined, derivative.upper, dr.inf, value.lower),
        )
        for derivative in derivatives
    )
    return value, slope, second


def _exp(x: Interval) -> DerivativeRanges:
    """The ranges of exp, of its derivative and of its second derivative on the interval x, which
    are all the same."""
    e = _exponential_range(dr.exp, x)
    e = Interval(fmax(e.lower, 0), e.upper)
    return e, e, e


def _exponential_range(f: Callable[[Any], Any], x: Interval) -> Interval:
    """The range, on the interval x, of an increasing function f that is computed by exp.

    exp is computed as 2^y with a rounded exponent y: on CUDA the error is larger by |x| units in
    the last place. If f overflows at the lower end of x, the lower end of the range is a large
    number rather than infinity, so that 1/(1 + exp(x)) is known to be small.
    """
    large = _SAFE_FRACTION * float(dr.largest(type(x.lower)))

    def end(v: Real, sign: int) -> Real:
        """A bound of f(v): an upper bound for sign 1, a lower bound for sign -1."""
        result = f(v)
        error = machine_epsilon(v) * (_MAX_ULP_ERROR + dr.abs(v))
        moved = dr.fma(dr.abs(result), sign * error, result) + sign * _smallest_normal(x)
        # A lower bound must not be +infinity, nor an upper bound -infinity. (The last argument of
        # `typed_select` tells the type of the numbers only.)
        return typed_select(sign * result == -dr.inf, -sign * large, moved, v)

    return Interval(end(x.lower, -1), end(x.upper, 1))


def _log(x: Interval) -> DerivativeRanges:
    """The ranges of log, of its derivative 1/x and of its second derivative -1/x^2 on the interval
    x. If x reaches 0 or below, the ranges of the derivatives are all numbers."""
    inverse = x.reciprocal()
    # Near 1 the error of a logarithm is four units of 1 on CUDA.
    value = _increasing_range(dr.log, x).widened(0.0, 4 * machine_epsilon(x.lower))
    return _unbounded_unless_defined(x.lower > 0, (value, inverse, -inverse.square()))


def sqrt_range(x: Interval) -> Interval:
    """The range of the square root on the interval x. Numbers of x below 0 have no square root: the
    range is that of the other numbers of x, NaN if there are none."""
    # The part of x with numbers >= 0.
    low = fmax(x.lower, 0)
    # A point interval keeps one object as both ends: then its root is computed once.
    high = low if x.lower is x.upper else x.upper
    root = _increasing_range(dr.sqrt, Interval(low, high))
    # A lower end that rounding took below 0 counts as 0. If x has no number >= 0, there is no root.
    is_none = x.upper < 0
    # (The last argument of `typed_select` tells the type of the numbers only.)
    like = root.lower
    return Interval(
        typed_select(is_none, dr.nan, fmax(root.lower, 0), like),
        typed_select(is_none, dr.nan, root.upper, like),
    )


def length_bound(sizes: list[Real], sign: int) -> Real:
    """A bound of the Euclidean norm of numbers of the backend, all >= 0: a lower bound for sign -1,
    an upper bound for sign 1. It is that end of `sqrt_range` of the sum of their squares, without
    the operations of the other end."""
    relative, absolute = _MAX_ULP_ERROR * machine_epsilon(sizes[0]), smallest_normal(sizes[0])
    if sign > 0:
        squares = [round_up(pad_underflow(size * size, 1)) for size in sizes]
        root = dr.sqrt(functools.reduce(lambda a, b: round_up(a + b), squares))
        return round_up(root + relative * dr.abs(root) + absolute)
    squares = [fmax(round_down(pad_underflow(size * size, -1)), 0.0) for size in sizes]
    root = dr.sqrt(fmax(functools.reduce(lambda a, b: round_down(a + b), squares), 0.0))
    return fmax(round_down(root - relative * dr.abs(root) - absolute), 0.0)


def _sqrt(x: Interval) -> DerivativeRanges:
    """The ranges of the square root, of its derivative and of its second derivative on the interval
    x. If x contains a number below 0, the ranges of the derivatives are all numbers."""
    low = fmax(x.lower, 0)
    high = low if x.lower is x.upper else x.upper
    root = sqrt_range(x)
    # 1/(2 sqrt x) and -1/(4 x sqrt x)
    slope = _half(_positive_reciprocal(root))
    second = -_half(slope * _positive_reciprocal(Interval(low, high)))
    return _unbounded_unless_defined(x.lower >= 0, (root, slope, second))


def _half(x: Interval) -> Interval:
    """The interval of all y/2 for y in x."""
    return x * Interval(0.5, 0.5)


def _positive_reciprocal(x: Interval) -> Interval:
    """The range of 1/y for the numbers y >= 0 of the interval x. Its upper end is infinite if 0 is
    one of them."""
    # The smallest value is 1/x.upper, the largest that at the lower end.
    of_upper_end = Interval(x.upper, x.upper).reciprocal()
    return Interval(
        fmax(of_upper_end.lower, 0), Interval(fmax(x.lower, 0), x.upper).reciprocal().upper
    )


def _reciprocal(x: Interval) -> DerivativeRanges:
    """The ranges of 1/x, of its derivative and of its second derivative on the interval x. All
    three are all numbers if x contains 0."""
    inverse = x.reciprocal()
    slope = -inverse.square()
    return _unbounded_unless_defined(
        (x.lower > 0) | (x.upper < 0), (inverse, slope, _twice(-slope * inverse))
    )


def _sine(x: Interval) -> DerivativeRanges:
    """The ranges of sin, of its derivative and of its second derivative on the interval x."""
    sine, cosine = _sine_and_cosine(x)
    return sine, cosine, -sine


def _cosine(x: Interval) -> DerivativeRanges:
    """The ranges of cos, of its derivative and of its second derivative on the interval x."""
    sine, cosine = _sine_and_cosine(x)
    return cosine, -sine, -cosine


def _sine_and_cosine(x: Interval) -> tuple[Interval, Interval]:
    """The ranges of sin and cos on the interval x.

    Proof. Both are monotone between the points at which they are 1 or -1, which are multiples of
    pi/2. So the range is given by the values at the ends and by such points inside the interval.
    Whether such a point is inside is tested on an interval that is wider by the rounding of the
    test; a point that is counted although it is outside is within that rounding of an end. For
    arguments beyond `max_sincos_argument` sines are not known. There the range is [-1, 1] on
    intervals. At a single point, and on intervals as narrow as its rounding, it is all numbers: the
    value at a point is taken half way between the ends of its range, and from [-1, 1] it would be
    0, which looks like a value.
    """
    epsilon, max_argument = machine_epsilon(x.lower), max_sincos_argument(type(x.lower))
    sine_lower, cosine_lower = sincos(x.lower)
    if x.lower is x.upper:
        is_valid = dr.abs(x.lower) <= max_argument

        def at_point(value: Real) -> Interval:
            """The range of a sine or cosine at a single point, from its computed value: the value
            with its rounding, clipped to [-1, 1]."""
            plain = Interval(value, value).widened(4 * epsilon, 4 * epsilon)
            low = dr.select(is_valid, fmax(plain.lower, -1), -dr.inf)
            return Interval(low, dr.select(is_valid, fmin(plain.upper, 1), dr.inf))

        return at_point(sine_lower), at_point(cosine_lower)
    sine_upper, cosine_upper = sincos(x.upper)
    # The ends of the interval in full turns, moved outwards. From a whole turn on, or for arguments
    # that are too large, the range is [-1, 1].
    turns_per_radian = 1 / (2 * math.pi)
    rounding = 8 * epsilon * (fmax(dr.abs(x.lower), dr.abs(x.upper)) + 1) * turns_per_radian
    low, high = x.lower * turns_per_radian - rounding, x.upper * turns_per_radian + rounding
    size = fmax(dr.abs(x.lower), dr.abs(x.upper))
    is_unknown = ~(size <= max_argument) | ~(high - low < 1)
    # An interval that is a point up to some roundings.
    no_value = ~(size <= max_argument) & (x.upper - x.lower <= _POINT_ROUNDINGS * epsilon * size)

    def passes(phase: float) -> Mask:
        """Whether x/(2 pi), the interval in full turns, contains phase + k for an integer k."""
        return dr.floor(high - phase) > dr.floor(low - phase)

    def range_between(a: Real, b: Real, top: float, bottom: float) -> Interval:
        """The range of a sine or cosine on the interval.

        a, b: its computed values at the ends of the interval x.
        top, bottom: the phases, as fractions of a full turn, at which it is 1 and -1.
        """
        plain = Interval(fmin(a, b), fmax(a, b)).widened(4 * epsilon, 4 * epsilon)
        lowest = dr.select(passes(bottom), -1, plain.lower)
        # (On lanes of `is_unknown` the range is [-1, 1].)
        clipped = _clip_to_unit(
            Interval(lowest, dr.select(passes(top), 1, plain.upper)), is_unknown
        )
        return Interval(
            dr.select(no_value, -dr.inf, clipped.lower), dr.select(no_value, dr.inf, clipped.upper)
        )

    return range_between(sine_lower, sine_upper, 0.25, 0.75), range_between(
        cosine_lower, cosine_upper, 0.0, 0.5
    )


def _clip_to_unit(x: Interval, wide: Mask) -> Interval:
    """The interval x, clipped to [-1, 1]; [-1, 1] itself on lanes where the mask `wide` is True."""
    return Interval(
        dr.select(wide, -1, fmax(x.lower, -1)),
        dr.select(wide, 1, fmin(x.upper, 1)),
    )


def _tan(x: Interval) -> DerivativeRanges:
    """The ranges of tan, of its derivative and of its second derivative on the interval x; all
    three are all numbers if a pole may lie in x."""
    sine_range, cosine_range = _sine_and_cosine(x)
    tangent = sine_range * cosine_range.reciprocal()
    # tan increases where the cosine has no zero: its values at the ends are then the range.
    ranges_at_ends = [
        sine * cosine.reciprocal()
        for sine, cosine in (
            _sine_and_cosine(Interval(x.lower, x.lower)),
            _sine_and_cosine(Interval(x.upper, x.upper)),
        )
    ]
    has_no_pole = cosine_range.min_abs > 0
    tangent = Interval(
        dr.select(has_no_pole, ranges_at_ends[0].lower, tangent.lower),
        dr.select(has_no_pole, ranges_at_ends[1].upper, tangent.upper),
    )
    # 1 + tan^2 and 2 tan (1 + tan^2)
    slope = ONE + tangent.square()
    return _unbounded_unless_defined(has_no_pole, (tangent, slope, _twice(tangent * slope)))


def _hyperbolic_tangent(x: Real) -> Real:
    """tanh x, from sinh and cosh, since Dr.Jit's tanh is accurate to only 11 bits on CUDA.

    From 20 on it is 1 up to rounding.
    """
    x = clamp(x, -20.0, 20.0)
    return dr.sinh(x) / dr.cosh(x)


def _tanh(x: Interval) -> DerivativeRanges:
    """The ranges of tanh, of its derivative and of its second derivative on the interval x."""
    # Widened once more, since the function is the quotient of two functions with errors.
    t = _increasing_range(_hyperbolic_tangent, x).widened(_MAX_ULP_ERROR * machine_epsilon(x.lower))
    upper = dr.select(x.upper == x.upper, fmin(t.upper, 1), 1)  # also if an end is NaN
    t = Interval(fmax(t.lower, -1), upper)
    # 1 - tanh^2, which is at least 0, and -2 tanh (1 - tanh^2)
    slope = ONE - t.square()
    slope = Interval(fmax(slope.lower, 0), slope.upper)
    return t, slope, -_twice(t * slope)


def _atan(x: Interval) -> DerivativeRanges:
    """The ranges of the arc tangent, of its derivative 1/(1+x^2) and of its second derivative
    -2x/(1+x^2)^2 on the interval x."""
    slope = (ONE + x.square()).reciprocal()
    max_second = 3 * math.sqrt(3) / 8 * (1 + 1e-6)  # of |2x/(1+x^2)^2|, at x = 1/sqrt(3)
    second = -_twice(x * slope.square())
    second = Interval(fmax(second.lower, -max_second), fmin(second.upper, max_second))
    return _increasing_range(dr.atan, x), slope, second


def _asin(x: Interval) -> DerivativeRanges:
    """The ranges of the arc sine, of its derivative and of its second derivative on the interval x.
    If x is not within [-1, 1], the range of the arc sine is that on the part of x in [-1, 1], and
    the ranges of the derivatives are all numbers."""
    inside = Interval(fmax(x.lower, -1), fmin(x.upper, 1))
    # 1/sqrt(1 - x^2) and x/sqrt(1 - x^2)^3. (The first result of `_sqrt` is the range of the root.)
    slope = _positive_reciprocal(_sqrt(ONE - inside.square())[0])
    second = inside * slope * slope.square()
    return _unbounded_unless_defined(
        (x.lower >= -1) & (x.upper <= 1), (_increasing_range(dr.asin, inside), slope, second)
    )


def _acos(x: Interval) -> DerivativeRanges:
    """The ranges of the arc cosine, pi/2 - asin, of its derivative and of its second derivative on
    the interval x."""
    value, slope, second = _asin(x)
    quarter = Interval.enclosing(math.pi / 2, type(x.lower))
    return quarter - value, -slope, -second


def _sinh(x: Interval) -> DerivativeRanges:
    """The ranges of sinh, of its derivative cosh and of its second derivative sinh on the interval
    x."""
    sinh_range, cosh_range = _exponential_range(dr.sinh, x), _cosh_range(x)
    return sinh_range, cosh_range, sinh_range


def _cosh(x: Interval) -> DerivativeRanges:
    """The ranges of cosh, of its derivative sinh and of its second derivative cosh on the interval
    x."""
    sinh_range, cosh_range = _exponential_range(dr.sinh, x), _cosh_range(x)
    return cosh_range, sinh_range, cosh_range


def _cosh_range(x: Interval) -> Interval:
    """The range of cosh on the interval x. cosh increases with |x|."""
    return _exponential_range(dr.cosh, Interval(x.min_abs, x.max_abs))


def _abs(x: Interval) -> DerivativeRanges:
    """The ranges of |x|, of its derivative and of its second derivative on the interval x. The
    second derivative has no upper bound at 0, where the slope jumps from -1 to 1."""
    is_positive, is_negative = x.lower > 0, x.upper < 0
    # (The last argument of `typed_select` tells the type of the numbers only.)
    slope = Interval(
        typed_select(is_positive, 1, -1, x.lower), typed_select(is_negative, -1, 1, x.lower)
    )
    max_second = typed_select(is_positive | is_negative, 0, dr.inf, x.lower)
    return Interval(x.min_abs, x.max_abs), slope, Interval(type(x.lower)(0), max_second)


def integer_power(x: Interval, n: int) -> Interval:
    """The range of y^n for y in the interval x, for an integer n >= 0."""
    if n == 0:
        return ONE
    if n == 1:
        return x
    # An even power increases with |y|. For a point interval both ends stay the same object.
    if n % 2 == 0:
        low, high = x.min_abs, x.max_abs
        if x.lower is x.upper:
            low = high
    else:
        low, high = x.lower, x.upper
    at_low = _power_by_squaring(low, n)
    at_high = at_low if low is high else _power_by_squaring(high, n)
    # The relative errors of the products add up to at most n - 1 roundings of half a machine
    # epsilon each; a product that underflows has a small absolute error instead.
    result = Interval(at_low, at_high).widened(
        n * machine_epsilon(x.lower), n * _smallest_normal(x)
    )
    # An even power is at least 0.
    return Interval(fmax(result.lower, 0), result.upper) if n % 2 == 0 else result


def _power_by_squaring(x: Real, n: int) -> Real:
    """x^n by repeated squaring, for an integer n >= 1."""
    result: Real = None
    while n:
        if n & 1:
            result = x if result is None else result * x
        x = x * x if n > 1 else x  # (the last square is not needed, and might overflow)
        n >>= 1
    return result


def power(n: float) -> ElementaryFunction:
    """The function x -> x^n, as an `ElementaryFunction`. For an n that is no integer it is defined
    for x >= 0 only."""
    if float(n).is_integer():
        k = int(n)
        if k < 0:

            def inverse(x: Interval) -> DerivativeRanges:
                """The ranges of x^n and of its first two derivatives on the interval x, for a
                negative integer n = k. They are powers of 1/x."""
                # n x^(n-1) and n (n-1) x^(n-2).
                reciprocal_range = x.reciprocal()
                slope = Interval.enclosing(k, type(x.lower)) * integer_power(
                    reciprocal_range, 1 - k
                )
                second = Interval.enclosing(k * (k - 1), type(x.lower)) * integer_power(
                    reciprocal_range, 2 - k
                )
                is_defined = (x.lower > 0) | (x.upper < 0)
                return _unbounded_unless_defined(
                    is_defined, (integer_power(reciprocal_range, -k), slope, second)
                )

            def plain(x: Any) -> Any:
                return 1 / _power_by_squaring(x, -k)

            return ElementaryFunction(
                f"power {k}", inverse, plain, _numpy_power(k), is_steep=True, has_pole=True
            )

        def ranges(x: Interval) -> DerivativeRanges:
            """The ranges of x^n and of its first two derivatives on the interval x, for an integer
            n >= 0."""
            number_type = cast("Any", type(x.lower))
            # The factors n and n (n-1) of the derivatives.
            slope, second = (
                Interval.enclosing(k, number_type),
                Interval.enclosing(k * (k - 1), number_type),
            )
            return (
                integer_power(x, k),
                slope * integer_power(x, max(k - 1, 0)),
                second * integer_power(x, max(k - 2, 0)) if k > 1 else ZERO,
            )

        def of_numbers(x: Any) -> Any:
            return 0 * x + 1 if k == 0 else _power_by_squaring(x, k)

        return ElementaryFunction(f"power {k}", ranges, of_numbers, _numpy_power(k))

    def real(x: Interval) -> DerivativeRanges:
        """The ranges of x^n and of its first two derivatives on the interval x, for an n that is no
        integer. The range of the function is NaN if x has no number >= 0."""
        number_type = cast("Any", type(x.lower))
        slope = Interval.enclosing(n, number_type) * _real_power(x, n - 1)
        second = Interval.enclosing(n * (n - 1), number_type) * _real_power(x, n - 2)
        is_defined = x.lower >= 0 if n > 0 else x.lower > 0
        value, is_none = _real_power(x, n), x.upper < 0
        # (The last argument of `typed_select` tells the type of the numbers only.)
        value = Interval(
            typed_select(is_none, dr.nan, value.lower, x.lower),
            typed_select(is_none, dr.nan, value.upper, x.lower),
        )
        return _unbounded_unless_defined(is_defined, (value, slope, second))

    def of_positive(x: Any) -> Any:
        return dr.power(fmax(x, 0), n)

    # The domain, and whether the slope is unbounded somewhere. With an exponent below 1 it is at 0;
    # with one below 0 there is a pole.
    return ElementaryFunction(
        f"power {n}", real, of_positive, _numpy_power(n), _POSITIVE, n < 1, has_pole=n < 0
    )


def _numpy_power(n: float) -> Callable[[Any], Any]:
    """Make the function x -> x^n for NumPy arrays and Python numbers."""
    return lambda x: np.power(x, float(n))


def _real_power(x: Interval, n: float) -> Interval:
    """The range of y^n for the numbers y >= 0 of the interval x and any n.

    The power is computed as exp2(n log2 y), with an error of n log2(y) units in the last place and
    a few more. A y below the smallest normal number may stand for any number from 0 to that.
    """
    lower = fmax(x.lower, 0)
    # A point interval keeps the same object as both ends.
    upper = (
        fmax(_smallest_normal(x), x.upper)
        if x.upper is not x.lower
        else fmax(_smallest_normal(x), lower)
    )

    def end(v: Real, sign: int) -> Real:
        """A bound of v^n: an upper bound for sign 1, a lower bound for sign -1."""
        result = dr.power(v, n)
        error = machine_epsilon(v) * (_MAX_ULP_ERROR + abs(n) * (4 + 2 * dr.abs(dr.log2(v))))
        return result + sign * (error * result + _smallest_normal(x))

    positive_lower = fmax(lower, _smallest_normal(x))
    # For n > 0 the power increases with y, else it falls.
    if n > 0:
        return Interval(
            dr.select(lower >= _smallest_normal(x), fmax(end(positive_lower, -1), 0), 0),
            end(upper, 1),
        )
    largest = dr.select(lower >= _smallest_normal(x), end(positive_lower, 1), dr.inf)
    return Interval(fmax(end(upper, -1), 0), largest)


exp = ElementaryFunction("exp", _exp, dr.exp, np.exp)
log = ElementaryFunction("log", _log, dr.log, np.log, _POSITIVE, is_steep=True, has_pole=True)
sqrt = ElementaryFunction("sqrt", _sqrt, dr.sqrt, np.sqrt, _POSITIVE, is_steep=True)
reciprocal = ElementaryFunction(
    "reciprocal", _reciprocal, lambda x: 1 / x, lambda x: 1 / x, is_steep=True, has_pole=True
)
# (`sincos` returns the sine and the cosine.)
sin = ElementaryFunction("sin", _sine, lambda x: sincos(x)[0], np.sin)
cos = ElementaryFunction("cos", _cosine, lambda x: sincos(x)[1], np.cos)
tan = ElementaryFunction(
    "tan", _tan, lambda x: sincos(x)[0] / sincos(x)[1], np.tan, is_steep=True, has_pole=True
)
tanh = ElementaryFunction("tanh", _tanh, _hyperbolic_tangent, np.tanh)
atan = ElementaryFunction("atan", _atan, dr.atan, np.arctan)
asin = ElementaryFunction("asin", _asin, dr.asin, np.arcsin, (-1.0, 1.0), is_steep=True)
acos = ElementaryFunction("acos", _acos, dr.acos, np.arccos, (-1.0, 1.0), is_steep=True)
sinh = ElementaryFunction("sinh", _sinh, dr.sinh, np.sinh)
cosh = ElementaryFunction("cosh", _cosh, dr.cosh, np.cosh)
absolute = ElementaryFunction("abs", _abs, dr.abs, np.abs)
