"""The operators that the numbers of all arithmetics share, so that each of them evaluates formulas.
A formula is a Python function of the coordinates x, y and z, written with + - * / ** and functions
such as `harnack.math.sin`. An arithmetic is a kind of numbers, such as intervals with derivatives
(`Jet`), for which a formula can be evaluated; all such kinds are subclasses of `FormulaNumber`. A
number stands for a function of the variables, such as a part of the formula.

`tally_of` estimates, before Dr.Jit records code for a formula, how long that code will be. It also
tells whether the formula may jump, have a vertical tangent, or turn sharply (be flat, steep and
flat again) within the rounding of coordinates.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.functions import (
    absolute,
    acos,
    asin,
    atan,
    cos,
    cosh,
    exp,
    log,
    power,
    reciprocal,
    sin,
    sinh,
    sqrt,
    tan,
    tanh,
)

if TYPE_CHECKING:
    from typing import Self

    from harnack.arithmetic.functions import ElementaryFunction
    from harnack.backend import FloatArray, Real

# NumPy's functions of such numbers: numpy.sin(x) is sin(x).
_UFUNCS = {
    "sin": sin, "cos": cos, "tan": tan, "exp": exp, "log": log, "sqrt": sqrt, "tanh": tanh,
    "sinh": sinh, "cosh": cosh, "arctan": atan, "arcsin": asin, "arccos": acos,
    "absolute": absolute, "fabs": absolute, "square": power(2),
}  # fmt: skip
# For each of NumPy's functions of two numbers: the method to call if the left operand is such a
# number, and the method of the right operand to call if only that one is.
_OPERATORS = {
    "add": ("__add__", "__radd__"), "subtract": ("__sub__", "__rsub__"),
    "multiply": ("__mul__", "__rmul__"), "divide": ("__truediv__", "__rtruediv__"),
    "true_divide": ("__truediv__", "__rtruediv__"), "power": ("__pow__", "__rpow__"),
    "maximum": ("maximum", "maximum"), "minimum": ("minimum", "minimum"),
    "arctan2": ("atan2", "_atan2_of"),
}  # fmt: skip
# The names of those functions in formulas.
_NAMES = (
    "sin, cos, tan, exp, log, sqrt, tanh, atan, atan2, asin, acos, sinh, cosh, "
    "maximum, minimum, norm"
)


class FormulaNumber(abc.ABC):
    """Base of the numbers of all arithmetics, with which formulas are evaluated: it defines their
    operators. These are + - * / **, abs, NumPy's functions, maximum, minimum and atan2. A subclass
    defines sums, products, functions of a single number, the larger of two numbers, and the polar
    angle. A formula is written once and evaluated with numbers of any subclass, such as `Jet`."""

    @abc.abstractmethod
    def constant(self, x: float | Real) -> Self:
        """The number x, a Python number or one of the backend, as a constant of this arithmetic."""

    @abc.abstractmethod
    def sum(self, other: Any) -> Self: ...

    @abc.abstractmethod
    def product(self, other: Any) -> Self: ...

    @abc.abstractmethod
    def __neg__(self) -> Self: ...

    @abc.abstractmethod
    def apply(self, function: ElementaryFunction) -> Self:
        """The elementary function, such as sin, of this number."""

    @abc.abstractmethod
    def pointwise_maximum(self, other: Any) -> Self: ...

    @abc.abstractmethod
    def polar_angle(self, x: Any) -> Self:
        """The polar angle in (-pi, pi] of the point (x, y), where y is this number and x a number
        of the same arithmetic."""

    def norm_of_powers(self, p: float) -> Self:
        """The p-norm (|x|^p + |y|^p + ...)^(1/p) of some numbers, where this number is the sum
        |x|^p + |y|^p + ... that is already computed."""
        return self.apply(sqrt if p == 2.0 else power(1 / p))

    def of_several(self, name: str, values: Sequence[Any], *literals: float) -> Self | None:
        """A function of several numbers, as a single operation of this arithmetic; None, the
        default, if it is to be computed from operations of one and two numbers.

        name: "maximum", "minimum", "norm", "orthogonal intersection", "blended union", "blended
            intersection", "segment distance" or "cone distance".
        values: the numbers, of any kind, at least one of them of this arithmetic.
        literals: the p of a norm, the power of a blend, the numbers of a segment or a cone.
        """
        del name, values, literals
        return None

    def least_of_rows(self, name: str, point: Sequence[Any], rows: FloatArray) -> Self | None:
        """The least of many functions of a point, as a single step of this arithmetic; None, the
        default, if they are to be computed one by one.

        name: "capsule" or "round cone" (`harnack.tape.operations`).
        point: (3,) the coordinates.
        rows: (n, c) the constants of each function.
        """
        del name, point, rows
        return None

    def constant_between(self, lower: Real, upper: Real) -> Self:
        """A constant that lies between two numbers of the backend.

        Raises:
            TypeError: this arithmetic has no such constants, as this default.
        """
        del lower, upper
        raise TypeError(
            f"{type(self).__name__} has no constants that are ranges, as long formulas need them"
        )

    def _coerce_or_none(self, other: Any) -> Self | None:
        """The operand `other` as a number of this arithmetic: `other` itself if it is one already,
        else a constant; None if `other` is not a number."""
        if isinstance(other, type(self)):
            return other
        # An array of depth 1 holds numbers, not vectors.
        if dr.is_array_v(cast("Any", type(other))):
            return self.constant(other) if dr.depth_v(type(other)) == 1 else None
        try:
            return self.constant(float(other))
        except (TypeError, ValueError):
            return None

    def coerce(self, other: Any) -> Self:
        """The operand `other`, a number of any kind, as a number of this arithmetic.

        Raises:
            TypeError: it is no number.
        """
        b = self._coerce_or_none(other)
        if b is None:
            raise TypeError(f"expected a number, not an object of type {type(other).__name__}")
        return b

    def __add__(self, other: Any) -> Any:
        b = self._coerce_or_none(other)
        return NotImplemented if b is None else self.sum(b)

    __radd__ = __add__

    def __pos__(self) -> Self:
        return self

    def __sub__(self, other: Any) -> Any:
        b = self._coerce_or_none(other)
        return NotImplemented if b is None else self.sum(-b)

    def __rsub__(self, other: Any) -> Self:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        b = self._coerce_or_none(other)
        return NotImplemented if b is None else self.product(b)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        """The quotient of this number and another one: this number times the reciprocal.

        Raises:
            ZeroDivisionError: the divisor is the Python number 0.
        """
        if isinstance(other, int | float):
            if other == 0:
                raise ZeroDivisionError("a formula divides by the constant 0")
            return self * (1.0 / other)
        b = self._coerce_or_none(other)
        return NotImplemented if b is None else self.product(b.apply(reciprocal))

    def __rtruediv__(self, other: Any) -> Self:
        return self.apply(reciprocal) * other

    def __pow__(self, exponent: Any) -> Self:
        """This number to a power: by products for a constant integer, by the function `power` for
        another constant, and as exp(exponent log(this)) for a number of the same arithmetic."""
        if isinstance(exponent, type(self)):
            return (self.apply(log) * exponent).apply(exp)
        n = exponent_of(exponent)
        if not n.is_integer():
            return self.apply(power(n))
        return (
            self._power_by_squaring(int(n))
            if n >= 0
            # A negative power is the reciprocal of the positive one.
            else self._power_by_squaring(int(-n)).apply(reciprocal)
        )

    def _power_by_squaring(self, n: int) -> Self:
        """This number to the power n >= 0, by repeated squaring."""
        if n == 0:
            return self.constant(1.0)
        if n == 1:
            return self
        half = self._power_by_squaring(n // 2)
        square = half.product(half)
        return square.product(self) if n % 2 else square

    def __rpow__(self, base: Any) -> Any:
        """A constant base to the power of this number.

        Raises:
            ValueError: the base is not positive.
        """
        b = self._coerce_or_none(base)
        if b is None:
            return NotImplemented
        if not dr.is_array_v(cast("Any", type(base))) and not float(base) > 0:
            raise ValueError(
                f"{float(base):g}**x is no real number for most x: the base must be positive"
            )
        return b**self

    def __xor__(self, other: Any) -> Any:
        raise TypeError("formulas write powers as x**2, not x^2")

    __rxor__ = __xor__

    def __abs__(self) -> Self:
        return self.apply(absolute)

    def maximum(self, other: Any) -> Self:
        """The larger of this number and another one of any kind, at each point."""
        return self.pointwise_maximum(self.coerce(other))

    def minimum(self, other: Any) -> Self:
        """The smaller of this number and another one of any kind, at each point."""
        return -((-self).pointwise_maximum(-self.coerce(other)))

    def atan2(self, x: Any) -> Self:
        """The polar angle in (-pi, pi] of the point (x, y), where y is this number and x a number
        of any kind."""
        return self.polar_angle(self.coerce(x))

    def _atan2_of(self, y: Any) -> Self:
        """The polar angle in (-pi, pi] of the point (x, y), where x is this number and y a number
        of any kind. NumPy's arctan2(y, x) calls it if only x is a number of this arithmetic."""
        return self.coerce(y).polar_angle(self)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **settings: Any) -> Any:
        """Apply one of NumPy's functions or operators to numbers of this arithmetic. NumPy calls
        this method, with the parameters of its protocol.

        ufunc: the function, such as numpy.sin.
        method: how it is applied; only "__call__", a plain call, is supported.
        inputs, settings: the operands; and keyword arguments, which are not supported.

        Raises:
            TypeError: this function has no proved ranges, or an operand is no number.
        """
        name = ufunc.__name__
        if method == "__call__" and not settings:
            if name in _UFUNCS:
                return self.apply(_UFUNCS[name])
            if name in _OPERATORS:
                left_operand, right_operand = inputs
                # The method of the left operand if that is a number of an arithmetic, else the
                # method of the right operand.
                left_method, right_method = _OPERATORS[name]
                is_left = isinstance(left_operand, FormulaNumber)
                result = (
                    getattr(left_operand, left_method)(right_operand)
                    if is_left
                    else getattr(right_operand, right_method)(left_operand)
                )
                if result is NotImplemented:
                    wrong_type = type(right_operand if is_left else left_operand).__name__
                    raise TypeError(f"expected a number, not an object of type {wrong_type}")
                return result
        raise TypeError(
            f"numpy.{name} has no proved ranges: write formulas with + - * / **, abs, and "
            f"harnack.{_NAMES}"
        )

    def __float__(self) -> float:
        raise TypeError(
            "a formula cannot use functions of plain numbers, such as math.sin: use those of "
            "harnack.math"
        )

    def _undecided(self, *operands: Any) -> Any:
        """Raise TypeError: a formula cannot compare its numbers or use them as conditions."""
        del operands
        raise TypeError(
            "a formula cannot decide by its coordinates: use harnack.math.maximum and "
            "harnack.math.minimum"
        )

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = _undecided

    def __eq__(self, other: object) -> bool:
        raise TypeError(
            "a formula is a number and no comparison: for left == right, write left - right"
        )

    __hash__ = object.__hash__


def exponent_of(n: Any) -> float:
    """The constant exponent n as a Python float.

    Raises:
        TypeError: it is not a number.
    """
    try:
        return float(n)
    except (TypeError, ValueError):
        kind = type(n).__name__
        raise TypeError(f"the exponent of x**n must be a number, not of type {kind}") from None


# The numbers of Dr.Jit operations for a sum, a product and a function, measured for one piece of a
# path with its sample and slopes.
_SUM, _PRODUCT, _FUNCTION = 60, 220, 300
# A function with a slope of `_ABRUPT` or more may turn within the rounding of coordinates, if these
# are up to `_FAR`: 1/4096 is 16 roundings of single precision there.
_ABRUPT, _FAR = 4096.0, 128.0
# Sizes and slopes above this number count as this number, whose square does not overflow.
_MAX_SIZE = 1e100


@dataclass(eq=False)
class Tally:
    """A summary of the operations that a formula does on its numbers, from which the length of its
    compiled code and its smoothness are estimated. A number of the formula is bent by a maximum, an
    absolute value, or a function that is no power: it may then turn sharply, that is, be flat,
    steep, and flat again.

    operations: about how many operations of Dr.Jit it takes to compute the ranges of all numbers.
    may_jump: whether a function was used that is not continuous everywhere.
    is_steep: whether the slope may have no bound in a bounded box, as with roots, powers below 1,
        quotients or logarithms.
    steepest: the largest slope, for coordinates up to 1, of any number that was bent.
    finest: the smallest nonzero constant, at most 1. A bent number may turn within this distance.
    farthest: the largest constant that was added.
    """

    operations: int = 0
    may_jump: bool = False
    is_steep: bool = False
    steepest: float = 0.0
    finest: float = 1.0
    farthest: float = 0.0

    def turns_within(self, finest: float) -> bool:
        """Whether the formula may turn so sharply that a change of the coordinates by their
        rounding changes it by far more than its slopes nearby say.

        max(-1, min(1, 1e9 y)) is an example: flat, steep, and flat again.

        finest: the smallest change of a bent number within which the formula may turn; for example
            the attribute `finest`.

        This is an estimate from the numbers of the formula, and no proof. Sums and products of
        coordinates alone do not turn in this way. A function of 1e9 y, such as tanh, may turn, and
        so may a maximum with 1e-9.
        """
        return self.steepest * max(self.farthest / _FAR, 1.0) >= _ABRUPT * finest


# Not frozen, as there are ten of them for each part of a model: a frozen one takes twice as long to
# make.
@dataclass(eq=False)
class OperationCounter(FormulaNumber):
    """A number without a value: a formula that is evaluated with such numbers records its
    operations in a tally, which all of them share. It knows only estimates of its size and its
    slope. It is bent if an operation may make it turn sharply (`Tally`).

    tally: the summary of all operations.
    is_constant: whether the number is the same everywhere, so that functions of it have no slope.
    is_square: whether it is a sum of squares. The root of such a sum has no vertical tangent: f =
        sqrt(u^2 + v^2) has |grad f| <= |grad u| + |grad v|.
    size, rate: estimated bounds of the number and of its slope, for coordinates up to 1
        (`Tally.turns_within`). The result of a function that has a pole or grows faster than a
        power counts as about 1, and as no steeper than the argument of the function. A constant
        that is an array counts as 1.
    """

    tally: Tally
    is_constant: bool = False
    is_square: bool = False
    size: float = 1.0
    rate: float = 1.0

    def constant(self, x: Any) -> OperationCounter:
        """The constant x. A formula may turn where one of its numbers changes by about |x|, as
        max(y, 0.01) does for x = 0.01. So the smallest |x| > 0 is kept as the tally's `finest`. An
        x that is an array counts as 1."""
        is_number = isinstance(x, int | float)
        size = self._size_of(float(x) if is_number else 1.0)
        is_positive = is_number and x >= 0
        return OperationCounter(
            self.tally, is_constant=True, is_square=is_positive, size=size, rate=0.0
        )

    def _size_of(self, x: float) -> float:
        """The size of a constant, which is noted in the tally."""
        size = min(abs(x), _MAX_SIZE)
        if size > 0.0:
            self.tally.finest = min(self.tally.finest, size)
        return size

    def __add__(self, other: Any) -> Any:
        if isinstance(other, int | float):
            return self._shifted(float(other), is_square=self.is_square and other >= 0)
        return super().__add__(other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, int | float):
            return self._shifted(float(other), is_square=False)
        return super().__sub__(other)

    def _shifted(self, x: float, *, is_square: bool) -> OperationCounter:
        """The sum of this number and the constant x or -x, as of two numbers."""
        size = self._size_of(x)
        farthest = max(size, self.size) if self.is_constant else size
        self.tally.farthest = max(self.tally.farthest, farthest)
        return self._after(_SUM, self, self.size + size, self.rate, is_square=is_square)

    def sum(self, other: OperationCounter) -> OperationCounter:
        """The sum of this number and another one. The largest absolute value of a constant that is
        added is kept as the tally's `farthest`."""
        for number in (self, other):
            if number.is_constant:
                self.tally.farthest = max(self.tally.farthest, number.size)
        total = self.size + other.size, self.rate + other.rate
        return self._after(_SUM, other, *total, is_square=self.is_square and other.is_square)

    def product(self, other: OperationCounter) -> OperationCounter:
        """The product of this number and another one. The result counts as a sum of squares if both
        factors are the same number, or if one is a sum of squares and the other a positive
        constant."""
        # (`is_square` of a constant says that it is not negative.)
        is_scaled = self.is_constant or other.is_constant
        is_square = other is self or (is_scaled and self.is_square and other.is_square)
        size, rate = self.size * other.size, self.size * other.rate + other.size * self.rate
        return self._after(_PRODUCT, other, size, rate, is_square=is_square)

    def __neg__(self) -> OperationCounter:
        return self._after(0, self, self.size, self.rate)

    def __pow__(self, exponent: Any) -> OperationCounter:
        """This number to a power; the operation is added to the tally."""
        if isinstance(exponent, OperationCounter):  # exp(exponent log(x))
            self._note(log)
            rate = self.rate + exponent.rate
            self.tally.steepest = max(self.tally.steepest, rate)
            # The size of the power is not known, and taken as 1.
            return self._after(_FUNCTION, exponent, 1.0, rate)
        n = exponent_of(exponent)
        return self.apply(sqrt if n == 0.5 else power(n))

    def apply(self, function: ElementaryFunction) -> OperationCounter:
        """An elementary function of this number. A power of at least 1 does not bend it; every
        other function does."""
        self._note(function)
        # Powers are named "power n".
        name, _, exponent = function.name.partition(" ")
        if name == "power" and float(exponent) >= 1.0:
            n, size = float(exponent), max(self.size, 1.0)
            size, rate = _power(size, n), n * _power(size, n - 1) * self.rate
            return self._after(_FUNCTION, self, size, rate, is_square=n == 2.0)
        # The size of another function is not known, and taken as 1.
        size = self.size if function is absolute else 1.0
        return self._bent(_FUNCTION, self, size, self.rate)

    def pointwise_maximum(self, other: OperationCounter) -> OperationCounter:
        """The larger of this number and another one, an operation that may bend both. The size and
        the slope of the result count as the larger sizes and slopes of the two."""
        rate = max(self.rate, other.rate)
        return self._bent(_FUNCTION, other, max(self.size, other.size), rate)

    def polar_angle(self, x: OperationCounter) -> OperationCounter:
        """The polar angle of the point (x, y), where y is this number. It may jump and be steep
        unless both numbers are constant."""
        if not (self.is_constant and x.is_constant):
            self.tally.may_jump = self.tally.is_steep = True
        # An angle counts as of the size 1.
        return self._bent(_FUNCTION + _PRODUCT, x, 1.0, self.rate + x.rate)

    def norm_of_powers(self, p: float) -> OperationCounter:
        """The p-norm of some numbers, where this number is the sum of their p-th powers. The p-th
        root may bend the sum, but the norm is not steep."""
        # The derivative of x^(1/p) is 1/(p size^(p-1)), with size = x^(1/p).
        size = max(self.size, 1.0) ** (1 / p)
        return self._bent(_FUNCTION, self, size, self.rate / (p * size ** (p - 1)))

    def of_several(
        self, name: str, values: Sequence[Any], *literals: float
    ) -> OperationCounter | None:
        """The Euclidean norm of numbers that are not constant: what the square root of the sum of
        their squares would record, in one step, since shapes with a norm may be many."""
        if name != "norm" or literals != (2.0,):
            return None
        size = rate = 0.0
        for value in values:
            if not isinstance(value, OperationCounter) or value.is_constant:
                return None
            base = max(value.size, 1.0)
            size += min(base * base, _MAX_SIZE)
            rate += min(2.0 * base * value.rate, _MAX_SIZE)
        size, rate = min(size, _MAX_SIZE), min(rate, _MAX_SIZE)
        tally = self.tally
        tally.operations += len(values) * (_FUNCTION + _SUM) - _SUM
        return OperationCounter(tally, is_square=True, size=size, rate=rate).norm_of_powers(2.0)

    def _note(self, function: ElementaryFunction) -> None:
        """Record in the tally whether this function of this number may jump or be steep. A root of
        a sum of squares is not steep."""
        if not self.is_constant:
            is_norm = function is sqrt and self.is_square
            self.tally.may_jump |= function.has_pole
            self.tally.is_steep |= function.is_steep and not is_norm

    def _bent(
        self, operations: int, other: OperationCounter, size: float, rate: float
    ) -> OperationCounter:
        """The result of an operation that may bend this and another number, that is, be flat on
        both sides of a place and steep between. The slopes of both numbers are recorded in the
        tally.

        operations: the number of Dr.Jit operations that the operation takes.
        size, rate: estimates of the size and of the slope of the result.
        """
        if not (self.is_constant and other.is_constant):
            self.tally.steepest = max(self.tally.steepest, self.rate, other.rate)
        return self._after(operations, other, size, rate)

    def _after(
        self,
        operations: int,
        other: OperationCounter,
        size: float,
        rate: float,
        *,
        is_square: bool = False,
    ) -> OperationCounter:
        """The result of an operation on this number and another one.

        operations: the number of Dr.Jit operations, which is added to the tally.
        size, rate, is_square: the estimates of the result: its size, its slope, and whether it is a
            sum of squares.
        """
        self.tally.operations += operations
        is_constant = self.is_constant and other.is_constant
        rate = 0.0 if is_constant else min(rate, _MAX_SIZE)
        return OperationCounter(self.tally, is_constant, is_square, min(size, _MAX_SIZE), rate)


def _power(x: float, n: float) -> float:
    """x^n for x >= 1, but at most `_MAX_SIZE`."""
    return math.exp(min(n * math.log(x), math.log(_MAX_SIZE)))


def tally_of(formula: Callable[[Any, Any, Any], Any]) -> Tally:
    """The tally of a formula: how many operations it has, and whether it may jump or be steep.

    formula: a function of three coordinates.

    A formula that does not accept an `OperationCounter` gets a tally with no operations, in which
    `may_jump` is True. Such a formula accepts only jets, as the formulas of the library's shapes
    do, and their slopes are bounded.
    """
    tally = Tally()
    x, y, z = (
        OperationCounter(tally) for _ in range(3)
    )  # three, as x * x is a square and x * y is not
    try:
        formula(x, y, z)
    except (TypeError, AttributeError, RuntimeError):  # the last is Dr.Jit's, of its loops
        return Tally(may_jump=True)
    return tally
