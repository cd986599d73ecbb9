"""The function max(x, 0)^n, the kernel (shape) of blobs in the literature, for formulas. The
arithmetics of this package use that it is 0 for x <= 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from harnack.arithmetic.functions import DerivativeRanges, ElementaryFunction, power
from harnack.arithmetic.interval import Interval
from harnack.backend.elementary import fmax


@dataclass(frozen=True)
class ClippedPower(ElementaryFunction):
    """The function x -> max(x, 0)^n for an integer n >= 1, which is a common kernel (shape) of
    blobs.

    It is convex and n - 1 times continuously differentiable. Written as maximum(x, 0)**n, no bound
    of its second derivative would be known, since the maximum has none at 0. An arithmetic may use
    that the function is 0 for x <= 0.
    """

    exponent: int = 1


def clipped_power(n: int) -> ClippedPower:
    """The function x -> max(x, 0)^n for an integer n >= 1. As a single function it has, for n >= 2,
    a bounded second derivative, unlike the power of a maximum.

    Raises:
        ValueError: n is less than 1 or no integer.
    """
    if int(n) != n or n < 1:
        raise ValueError(f"the exponent of a clipped power must be an integer >= 1, not {n}")

    def ranges(x: Interval) -> DerivativeRanges:
        """The ranges of max(x, 0)^n, of its derivative and of its second derivative on the interval
        x.

        At 0 the second derivative has no upper bound for n = 1, and jumps from 0 to 2 for n = 2.
        """
        low = fmax(x.lower, 0)
        clipped = Interval(low, low if x.lower is x.upper else fmax(x.upper, 0))
        value, slope, second = power(n).ranges(clipped)
        # From here on, the ends of x itself.
        low, high = x.lower, x.upper
        # The derivatives of the power at 0 are those from the right only; for n = 1 and 2 those
        # from the left differ.
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
        lambda x: power(n).on_drjit(fmax(x, 0)),
        lambda x: np.maximum(x, 0.0) ** n,
        exponent=n,
    )
