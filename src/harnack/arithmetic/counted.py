"""How many operations a kernel for the ranges of a formula has, before it is recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from harnack.arithmetic.operators import Operators

# Measured, for one piece of a path with its sample and slopes.
_SUM, _PRODUCT, _FUNCTION = 60, 220, 300


@dataclass(frozen=True, eq=False)
class Counted(Operators):
    """A number that counts operations. tally: of all numbers together, one entry."""

    tally: list[int]

    def constant(self, x: Any) -> Counted:
        del x
        return self

    def sum(self, other: Any) -> Counted:
        del other
        return self._spending(_SUM)

    def product(self, other: Any) -> Counted:
        del other
        return self._spending(_PRODUCT)

    def __neg__(self) -> Counted:
        return self

    def __pow__(self, exponent: Any) -> Counted:
        del exponent
        return self._spending(_FUNCTION)

    def apply(self, function: Any) -> Counted:
        del function
        return self._spending(_FUNCTION)

    def larger(self, other: Any) -> Counted:
        del other
        return self._spending(_FUNCTION)

    def _spending(self, operations: int) -> Counted:
        self.tally[0] += operations
        return self


def operations_of(formula: Callable[[Any, Any, Any], Any]) -> int:
    """About how many operations the ranges of a formula of three coordinates take; 0 where it asks
    for numbers of a kind of its own."""
    number = Counted([0])
    try:
        formula(number, number, number)
    except (TypeError, AttributeError):
        return 0
    return number.tally[0]
