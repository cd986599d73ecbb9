"""Powers that are cut off at zero: max(x, 0)^n, the kernels of compact blobs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.arithmetic.functions import Function, power
from harnack.arithmetic.interval import Interval
from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.arithmetic.functions import Ranges


@dataclass(frozen=True)
class ClippedPower(Function):
    """x -> max(x, 0)^n, n >= 1: convex, and n - 1 times continuously differentiable.

    Written as maximum(x, 0)**n its second derivative would have no bound, since that of the maximum
    has none. Arithmetics may make use of where it is zero.
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
        n,
    )
