"""Enclosures by harmonic balls: what `classic`, `slope` and `caps` prove from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.enclosures.enclosure import Enclosure, Gaps, Slopes
from harnack.enclosures.promises import BoundedLaplacian, HarmonicBall, Promise

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real

# Distances carry a few roundings of float32; a radius is shortened by this much.
_RADIUS_SLACK = 1.0 - 1e-6


@dataclass(frozen=True)
class Ball(Enclosure):
    """f is harmonic on B(p, radius) of R^dimension and moves there by less than the two ranges.

    range_below = f - lower and range_above = upper - f are how far the promise lets f move, so that
    bounds never subtract two large numbers. None says that this side is not bounded.
    """

    radius: Real
    range_below: Real | None
    range_above: Real | None
    dimension: int
    slopes: Slopes

    @classmethod
    def of(cls, promise: Promise, value: Real, error: Real, slopes: Slopes) -> Self | None:
        if not isinstance(promise, HarmonicBall):
            return None
        radius, below, above = known_ranges(promise, value, error)
        if not cls.applies(promise.dimension, below is not None, above is not None):
            return None
        return cls(radius, below, above, promise.dimension, slopes)

    def is_known(self, gaps: Gaps) -> Mask:
        """Whether ranges and gaps are numbers, and large enough to divide by."""
        known = (gaps.down >= 0) & (gaps.up >= 0)
        for one in (self.range_below, self.range_above):
            if one is not None:
                known &= (one == 0) | (dr.isfinite(1 / one) & dr.isfinite(2 * one))
        return known

    @classmethod
    def applies(cls, dimension: int, is_bounded_below: bool, is_bounded_above: bool) -> bool:
        """Whether the proof is one for balls of this dimension, with these ends known."""
        del dimension
        return is_bounded_below or is_bounded_above


def known_ranges(
    promise: HarmonicBall | BoundedLaplacian, value: Real, error: Real
) -> tuple[Real, Real | None, Real | None]:
    """Radius, and how far the promise lets f move down and up (None: that side is not bounded).

    The ends of the promise are moved out by the error and eight units in the last place of f: a
    promise that seems to leave f no range would otherwise prove f constant. A radius that is not a
    positive number, or a NaN anywhere, proves nothing (radius 0).
    """
    total_error = dr.fma(8 * float(dr.epsilon(type(value))), dr.abs(value), error)
    known = promise.radius > 0

    def movement(end: Real, sign: float) -> Real | None:
        nonlocal known
        if isinstance(end, float) and math.isinf(end):
            return None
        distance = sign * (end - value)
        known = known & (distance == distance)  # not NaN
        return fmax(distance, 0) + total_error

    below, above = movement(promise.lower, -1.0), movement(promise.upper, 1.0)
    return dr.select(known, promise.radius * _RADIUS_SLACK, 0), below, above
