"""Which levels bracket a value: the question every enclosure is asked.

An angle-valued function is known modulo its period, so its levels form a ladder: every
asked-for level plus every multiple of the period (paper, Alg. 2, with the reduction that the
printed algorithm leaves out: both bracketing levels are found from the reduced difference).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmin
from harnack.enclosures.enclosure import Gaps

if TYPE_CHECKING:
    from harnack.backend import Real


@dataclass(frozen=True)
class TargetLevels:
    """A finite set of target levels, repeated with `period` if there is one.

    `values` may be Python floats or size-1 Dr.Jit arrays of the backend in use (so that a level
    can change without a kernel being compiled again, or carry derivatives).
    """

    values: tuple[Real, ...]
    period: float | None = None

    def gaps(self, f: Real) -> Gaps:
        """Distances in value from f to the next level below and above.

        Either is infinite when there is no such level. A value on a level has both a gap of
        zero on one side and, for a ladder, of at most one period on the other. Gaps of a value
        that is not a number are not numbers.
        """
        down: Real = math.inf
        up: Real = math.inf
        for level in self.values:
            above = f - level  # > 0: the level lies below f
            if self.period is not None:
                # Within half a period of 0, so that neither side of a level is lost to rounding.
                reduced = above - self.period * dr.round(above / self.period)
                is_above = reduced >= 0
                below_gap = dr.select(is_above, reduced, self.period + reduced)
                above_gap = dr.select(is_above, self.period - reduced, -reduced)
            else:
                # In this order a gap of what is not a number is none, and nothing is proved.
                below_gap = dr.select(above < 0, math.inf, above)
                above_gap = dr.select(above > 0, math.inf, -above)
            down, up = fmin(down, below_gap), fmin(up, above_gap)
        return Gaps(down, up, len(self.values) == 1 and self.period is None)

    def to_nearest(self, f: Real) -> Real:
        """level - f for the level nearest to f."""
        gaps = self.gaps(f)
        return dr.select(gaps.up < gaps.down, gaps.up, -gaps.down)
