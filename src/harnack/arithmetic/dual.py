"""Dual numbers: values with their gradients, as plain numbers. No ranges, so nothing is proved.

Where a formula has ties, as max(x, 0) has at x = 0, ranges of derivatives have all slopes nearby.
A dual number has the slopes of one side, as each comparison is decided by the values.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.interval import Interval
from harnack.arithmetic.operators import Operators

if TYPE_CHECKING:
    from harnack.arithmetic.functions import Function
    from harnack.backend import Real, Vec3

_Partials = tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class Dual(Operators):
    """A function at a point: its value, and its partial derivatives in x, y and z."""

    value: Real
    first: _Partials

    @classmethod
    def at_point(cls, p: Vec3) -> tuple[Dual, Dual, Dual]:
        """The coordinates as functions of themselves."""
        return cls(p.x, (1.0, 0.0, 0.0)), cls(p.y, (0.0, 1.0, 0.0)), cls(p.z, (0.0, 0.0, 1.0))

    def constant(self, x: float | Real) -> Dual:
        return Dual(cast("Any", type(self.value))(x), (0.0, 0.0, 0.0))

    def sum(self, other: Dual) -> Dual:
        return Dual(self.value + other.value, _each(operator.add, self.first, other.first))

    def product(self, other: Dual) -> Dual:
        x, y = self.value, other.value

        def rule(a: Any, b: Any) -> Any:
            return a * y + x * b

        return Dual(x * y, _each(rule, self.first, other.first))

    def __neg__(self) -> Dual:
        return Dual(-self.value, _each(operator.neg, self.first))

    def apply(self, function: Function) -> Dual:
        """A function of this one. Where this one is constant, so is that, also at a pole of the
        slope, as that of the root in a norm of zeros."""
        slope = function.ranges(Interval.exactly(self.value))[1].middle
        real = cast("Any", type(self.value))

        def rule(a: Any) -> Any:
            return dr.select(real(a) == 0, 0, a * slope)

        return Dual(function.plain(self.value), _each(rule, self.first))

    def larger(self, other: Dual) -> Dual:
        is_own = self.value > other.value

        def rule(a: Any, b: Any) -> Any:
            return dr.select(is_own, a, b)

        value = dr.select(is_own, self.value, other.value)
        return Dual(value, _each(rule, self.first, other.first))


def _each(function: Callable[..., Any], *partials: _Partials) -> _Partials:
    x, y, z = (function(*of_axis) for of_axis in zip(*partials, strict=True))
    return x, y, z
