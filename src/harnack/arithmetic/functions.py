"""Elementary functions: their ranges, and those of their first two derivatives, on intervals.

One `Function` serves every arithmetic: it knows the function for plain numbers, and the ranges of
it and of its first two derivatives on an interval. `sin(x)` and its like take numbers of any
arithmetic, Dr.Jit and NumPy arrays, and Python numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.interval import ONE, ZERO, Interval, select, unit_of
from harnack.backend.elementary import clamp, fmax, fmin, largest_angle, sincos

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

Ranges: TypeAlias = "tuple[Interval, Interval, Interval]"

# The domain of roots, powers that are no integers, and logarithms.
_POSITIVE = (0.0, math.inf)
# No function here overflows sooner than at this part of the largest number: LLVM's exp does at 0.7.
_OVERFLOWS = 1 / 16
# Units in the last place that exp, log and their like are off by at most, on every backend.
_UNITS = 8.0


@dataclass(frozen=True)
class Function:
    """A function of one number.

    ranges: of it, its derivative and its second derivative on an interval. Where the interval
        contains a pole, or a point at which the function is not defined, the ranges of derivatives
        are all numbers: f(s) = f(0) + s f'(r) does not hold across such a point.
    plain: the function of Dr.Jit numbers.
    numpy: the function of NumPy arrays and Python numbers.
    domain: the least and the largest number of which it has a value.
    is_steep: whether its slope has no bound near a number: a pole, or a vertical tangent.
    has_pole: whether there is a point across which it is not continuous.
    """

    name: str
    ranges: Callable[[Interval], Ranges]
    plain: Callable[[Any], Any]
    numpy: Callable[[Any], Any]
    domain: tuple[float, float] = (-math.inf, math.inf)
    is_steep: bool = False
    has_pole: bool = False

    def __reduce__(self) -> str:
        # There is one of each name, in this module.
        return "absolute" if self.name == "abs" else self.name

    def __call__(self, x: Any) -> Any:
        """The function of a number of any kind."""
        if hasattr(x, "apply"):
            return x.apply(self)
        if dr.is_array_v(type(x)):
            return self.plain(x)
        return self.numpy(x)


def _rising(f: Callable[[Any], Any], x: Interval) -> Interval:
    """The range of an increasing function that is accurate to `_UNITS`."""
    low = f(x.low)
    high = low if x.low is x.high else f(x.high)
    return Interval(low, high).widened(_UNITS * unit_of(x.low), _tiny(x))


def _tiny(x: Interval) -> float:
    return float(dr.smallest(cast("Any", type(x.low))))


def _two(x: Interval) -> Interval:
    return x + x


def _where(defined: Mask, ranges: Ranges) -> Ranges:
    """The ranges; where the function is not defined, those of derivatives are all numbers."""
    value, *rest = ranges
    slope, second = (
        Interval(
            select(defined, one.low, -dr.inf, value.low),
            select(defined, one.high, dr.inf, value.low),
        )
        for one in rest
    )
    return value, slope, second


def _exp(x: Interval) -> Ranges:
    e = _exponential(dr.exp, x)
    e = Interval(fmax(e.low, 0), e.high)
    return e, e, e


def _exponential(f: Callable[[Any], Any], x: Interval) -> Interval:
    """The range of an increasing function computed from 2^y, whose exponent is rounded: on CUDA it
    is off by |x| units more. What overflows is large, so that 1/(1 + exp(x)) is known to be small.
    """
    large = _OVERFLOWS * float(dr.largest(type(x.low)))

    def end(v: Real, sign: int) -> Real:
        result = f(v)
        off = unit_of(v) * (_UNITS + dr.abs(v))
        moved = dr.fma(dr.abs(result), sign * off, result) + sign * _tiny(x)
        return select(sign * result == -dr.inf, -sign * large, moved, v)

    return Interval(end(x.low, -1), end(x.high, 1))


def _log(x: Interval) -> Ranges:
    one = x.reciprocal()
    # Near 1 a logarithm is off by four units of 1 on CUDA.
    value = _rising(dr.log, x).widened(0.0, 4 * unit_of(x.low))
    return _where(x.low > 0, (value, one, -one.square()))


def _sqrt(x: Interval) -> Ranges:
    low = fmax(x.low, 0)
    high = low if x.low is x.high else x.high
    root = _rising(dr.sqrt, Interval(low, high))
    # Ends that rounding took below 0 count as 0; where both are below, there is no root.
    is_none = x.high < 0
    like = root.low
    root = Interval(
        select(is_none, dr.nan, fmax(root.low, 0), like),
        select(is_none, dr.nan, root.high, like),
    )
    slope = _half(_positive_reciprocal(root))
    second = -_half(slope * _positive_reciprocal(Interval(low, high)))
    return _where(x.low >= 0, (root, slope, second))


def _half(x: Interval) -> Interval:
    return x * Interval(0.5, 0.5)


def _positive_reciprocal(x: Interval) -> Interval:
    """1/x for numbers >= 0; its upper end is infinite if 0 is one of them."""
    above = Interval(x.high, x.high).reciprocal()
    return Interval(fmax(above.low, 0), Interval(fmax(x.low, 0), x.high).reciprocal().high)


def _reciprocal(x: Interval) -> Ranges:
    one = x.reciprocal()
    slope = -one.square()
    return _where((x.low > 0) | (x.high < 0), (one, slope, _two(-slope * one)))


def _sine(x: Interval) -> Ranges:
    s, c = _sine_and_cosine(x)
    return s, c, -s


def _cosine(x: Interval) -> Ranges:
    s, c = _sine_and_cosine(x)
    return c, -s, -c


def _sine_and_cosine(x: Interval) -> tuple[Interval, Interval]:
    """Ranges of sin and cos.

    Proof. Both are monotone between the multiples of pi/2 at which they are 1 or -1: the range is
    given by the ends, and by such points inside. Whether one is inside is tested for an interval
    widened by the rounding of the test; if one is counted wrongly, it is that near to an end.
    Beyond `largest_angle` sines are not known: on pieces the range is [-1, 1] there; at a point it
    is all numbers, as the value at a point is taken half way between the ends, and 0 would look
    like one.
    """
    unit, most = unit_of(x.low), largest_angle(type(x.low))
    s0, c0 = sincos(x.low)
    if x.low is x.high:
        known = dr.abs(x.low) <= most

        def at_point(one: Real) -> Interval:
            plain = Interval(one, one).widened(4 * unit, 4 * unit)
            low = dr.select(known, fmax(plain.low, -1), -dr.inf)
            return Interval(low, dr.select(known, fmin(plain.high, 1), dr.inf))

        return at_point(s0), at_point(c0)
    s1, c1 = sincos(x.high)
    turn = 1 / (2 * math.pi)
    slack = 8 * unit * (fmax(dr.abs(x.low), dr.abs(x.high)) + 1) * turn
    low, high = x.low * turn - slack, x.high * turn + slack
    wide = ~(fmax(dr.abs(x.low), dr.abs(x.high)) <= most) | ~(high - low < 1)

    def passes(phase: float) -> Mask:
        return dr.floor(high - phase) > dr.floor(low - phase)

    def over(a: Real, b: Real, top: float, bottom: float) -> Interval:
        plain = Interval(fmin(a, b), fmax(a, b)).widened(4 * unit, 4 * unit)
        least = dr.select(passes(bottom), -1, plain.low)
        return _unit_range(Interval(least, dr.select(passes(top), 1, plain.high)), wide)

    return over(s0, s1, 0.25, 0.75), over(c0, c1, 0.0, 0.5)


def _unit_range(x: Interval, wide: Mask) -> Interval:
    return Interval(
        dr.select(wide, -1, fmax(x.low, -1)),
        dr.select(wide, 1, fmin(x.high, 1)),
    )


def _tan(x: Interval) -> Ranges:
    s, c = _sine_and_cosine(x)
    t = s * c.reciprocal()
    # Monotone where the cosine has no zero: the ends are the range.
    ends = [
        one * two.reciprocal()
        for one, two in (
            _sine_and_cosine(Interval(x.low, x.low)), _sine_and_cosine(Interval(x.high, x.high)),
        )
    ]  # fmt: skip
    no_pole = c.smallest > 0
    t = Interval(dr.select(no_pole, ends[0].low, t.low), dr.select(no_pole, ends[1].high, t.high))
    slope = ONE + t.square()
    return _where(no_pole, (t, slope, _two(t * slope)))


def _hyperbolic_tangent(x: Real) -> Real:
    """tanh; Dr.Jit's own is accurate to only 11 bits on CUDA. From 20 on it is 1 up to rounding."""
    x = clamp(x, -20.0, 20.0)
    return dr.sinh(x) / dr.cosh(x)


def _tanh(x: Interval) -> Ranges:
    t = _rising(_hyperbolic_tangent, x).widened(_UNITS * unit_of(x.low))
    high = dr.select(x.high == x.high, fmin(t.high, 1), 1)  # also if an end is NaN
    t = Interval(fmax(t.low, -1), high)
    slope = ONE - t.square()
    slope = Interval(fmax(slope.low, 0), slope.high)
    return t, slope, -_two(t * slope)


def _atan(x: Interval) -> Ranges:
    slope = (ONE + x.square()).reciprocal()
    most = 3 * math.sqrt(3) / 8 * (1 + 1e-6)  # of |2x/(1+x^2)^2|, at x = 1/sqrt(3)
    second = -_two(x * slope.square())
    second = Interval(fmax(second.low, -most), fmin(second.high, most))
    return _rising(dr.atan, x), slope, second


def _asin(x: Interval) -> Ranges:
    inside = Interval(fmax(x.low, -1), fmin(x.high, 1))
    slope = _positive_reciprocal(_sqrt(ONE - inside.square())[0])
    second = inside * slope * slope.square()
    return _where((x.low >= -1) & (x.high <= 1), (_rising(dr.asin, inside), slope, second))


def _acos(x: Interval) -> Ranges:
    value, slope, second = _asin(x)
    quarter = Interval.constant(math.pi / 2, type(x.low))
    return quarter - value, -slope, -second


def _sinh(x: Interval) -> Ranges:
    s, c = _exponential(dr.sinh, x), _cosh_range(x)
    return s, c, s


def _cosh(x: Interval) -> Ranges:
    s, c = _exponential(dr.sinh, x), _cosh_range(x)
    return c, s, c


def _cosh_range(x: Interval) -> Interval:
    return _exponential(dr.cosh, Interval(x.smallest, x.largest))


def _abs(x: Interval) -> Ranges:
    """|x|: its second derivative at 0 is a Dirac impulse, upwards."""
    positive, negative = x.low > 0, x.high < 0
    slope = Interval(select(positive, 1, -1, x.low), select(negative, -1, 1, x.low))
    kink = select(positive | negative, 0, dr.inf, x.low)
    return Interval(x.smallest, x.largest), slope, Interval(type(x.low)(0), kink)


def integer_power(x: Interval, n: int) -> Interval:
    """The range of x^n, n >= 0."""
    if n == 0:
        return ONE
    if n == 1:
        return x
    if n % 2 == 0:
        low, high = x.smallest, x.largest
        if x.low is x.high:
            low = high
    else:
        low, high = x.low, x.high
    a = _repeated(low, n)
    b = a if low is high else _repeated(high, n)
    # Every product is off by at most half a unit.
    result = Interval(a, b).widened(n * unit_of(x.low), n * _tiny(x))
    return Interval(fmax(result.low, 0), result.high) if n % 2 == 0 else result


def _repeated(x: Real, n: int) -> Real:
    result: Real = None
    while n:
        if n & 1:
            result = x if result is None else result * x
        x = x * x if n > 1 else x
        n >>= 1
    return result


def power(n: float) -> Function:
    """x -> x^n; for x >= 0 if n is no integer."""
    if float(n).is_integer():
        k = int(n)
        if k < 0:

            def inverse(x: Interval) -> Ranges:
                one = x.reciprocal()
                slope = Interval.constant(k, type(x.low)) * integer_power(one, 1 - k)
                second = Interval.constant(k * (k - 1), type(x.low)) * integer_power(one, 2 - k)
                defined = (x.low > 0) | (x.high < 0)
                return _where(defined, (integer_power(one, -k), slope, second))

            def plain(x: Any) -> Any:
                return 1 / _repeated(x, -k)

            return Function(
                f"power {k}", inverse, plain, _numpy_power(k), is_steep=True, has_pole=True
            )

        def whole(x: Interval) -> Ranges:
            like = cast("Any", type(x.low))
            slope, second = Interval.constant(k, like), Interval.constant(k * (k - 1), like)
            return (
                integer_power(x, k),
                slope * integer_power(x, max(k - 1, 0)),
                second * integer_power(x, max(k - 2, 0)) if k > 1 else ZERO,
            )

        def of_numbers(x: Any) -> Any:
            return 0 * x + 1 if k == 0 else _repeated(x, k)

        return Function(f"power {k}", whole, of_numbers, _numpy_power(k))

    def real(x: Interval) -> Ranges:
        like = cast("Any", type(x.low))
        slope = Interval.constant(n, like) * _real_power(x, n - 1)
        second = Interval.constant(n * (n - 1), like) * _real_power(x, n - 2)
        defined = x.low >= 0 if n > 0 else x.low > 0
        value, is_none = _real_power(x, n), x.high < 0
        value = Interval(
            select(is_none, dr.nan, value.low, x.low), select(is_none, dr.nan, value.high, x.low)
        )
        return _where(defined, (value, slope, second))

    def of_positive(x: Any) -> Any:
        return dr.power(fmax(x, 0), n)

    return Function(
        f"power {n}", real, of_positive, _numpy_power(n), _POSITIVE, n < 1, has_pole=n < 0
    )


def _numpy_power(n: float) -> Callable[[Any], Any]:
    return lambda x: np.power(x, float(n))


def _real_power(x: Interval, n: float) -> Interval:
    """The range of x^n for x >= 0 and any n: exp2(n log2 x), so off by n log2(x) units and a few.

    An x below the smallest normal number may be any number from 0 to that.
    """
    least = fmax(x.low, 0)
    most = fmax(_tiny(x), x.high) if x.high is not x.low else fmax(_tiny(x), least)

    def end(v: Real, sign: int) -> Real:
        result = dr.power(v, n)
        off = unit_of(v) * (_UNITS + abs(n) * (4 + 2 * dr.abs(dr.log2(v))))
        return result + sign * (off * result + _tiny(x))

    at_least = fmax(least, _tiny(x))
    if n > 0:
        return Interval(dr.select(least >= _tiny(x), fmax(end(at_least, -1), 0), 0), end(most, 1))
    high = dr.select(least >= _tiny(x), end(at_least, 1), dr.inf)
    return Interval(fmax(end(most, -1), 0), high)


exp = Function("exp", _exp, dr.exp, np.exp)
log = Function("log", _log, dr.log, np.log, _POSITIVE, is_steep=True, has_pole=True)
sqrt = Function("sqrt", _sqrt, dr.sqrt, np.sqrt, _POSITIVE, is_steep=True)
reciprocal = Function(
    "reciprocal", _reciprocal, lambda x: 1 / x, lambda x: 1 / x, is_steep=True, has_pole=True
)
sin = Function("sin", _sine, lambda x: sincos(x)[0], np.sin)
cos = Function("cos", _cosine, lambda x: sincos(x)[1], np.cos)
tan = Function(
    "tan", _tan, lambda x: sincos(x)[0] / sincos(x)[1], np.tan, is_steep=True, has_pole=True
)
tanh = Function("tanh", _tanh, _hyperbolic_tangent, np.tanh)
atan = Function("atan", _atan, dr.atan, np.arctan)
asin = Function("asin", _asin, dr.asin, np.arcsin, (-1.0, 1.0), is_steep=True)
acos = Function("acos", _acos, dr.acos, np.arccos, (-1.0, 1.0), is_steep=True)
sinh = Function("sinh", _sinh, dr.sinh, np.sinh)
cosh = Function("cosh", _cosh, dr.cosh, np.cosh)
absolute = Function("abs", _abs, dr.abs, np.abs)


@dataclass(frozen=True)
class ClippedPower(Function):
    """x -> max(x, 0)^n, n >= 1: convex, and n - 1 times continuously differentiable. A kernel of
    blobs with compact support.

    Written as maximum(x, 0)**n its second derivative would have no bound, since that of the maximum
    has none. An arithmetic may use that it is 0 for x <= 0.
    """

    exponent: int = 1


def clipped_power(n: int) -> ClippedPower:
    """The function max(x, 0)^n.

    Raises:
        ValueError: n is less than 1.
    """
    if int(n) != n or n < 1:
        raise ValueError(f"the exponent of a clipped power must be an integer >= 1, not {n}")

    def ranges(x: Interval) -> Ranges:
        low = fmax(x.low, 0)
        u = Interval(low, low if x.low is x.high else fmax(x.high, 0))
        value, slope, second = power(n).ranges(u)
        low, high = x.low, x.high
        if n == 1:
            slope = Interval(dr.select(low > 0, 1, 0), dr.select(high >= 0, 1, 0))
            crosses = (low <= 0) & (high >= 0)
            second = Interval(0.0, dr.select(crosses, dr.inf, 0))
        elif n == 2:
            second = Interval(dr.select(low > 0, 2, 0), dr.select(high >= 0, 2, 0))
        return value, slope, second

    return ClippedPower(
        f"clipped power {n}",
        ranges,
        lambda x: power(n).plain(fmax(x, 0)),
        lambda x: np.maximum(x, 0.0) ** n,
        exponent=n,
    )
