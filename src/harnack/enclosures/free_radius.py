"""The longest length proved by a proof on a ball: the solver that all such proofs share, and
`HarmonicBallEnclosure`, for harmonic functions.

A proof on a ball B(p, R) shows that all lengths up to q R are free of levels if

    q k(q) <= gap,

with a k that has no poles on [0, 1] and a dimensionless gap. `largest_free_fraction` finds the
largest such q from the safe side: large numbers are never subtracted, and the error of q is small
relative to q. Near a surface the gap is tiny, and with a q of a small absolute error only, the
march would stall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import drjit as dr

from harnack.backend.elementary import clamp, fmax
from harnack.enclosures.enclosure import Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.promises import BoundedLaplacian, HarmonicBall, Promise

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real

# Lengths are multiplied by this, to cover the roundings of the two sides of the comparison.
CONDITION_SAFETY = 1.0 - 2e-6
# k is the difference of numbers of order one. This number of unit roundoffs is added to it, which
# covers their rounding and that of the slope.
_ROUNDINGS = 16.0


class FreeRadiusCondition(Protocol):
    """A condition q k(q) <= gap which proves that all of [0, q] is free of levels, where q is a
    fraction of the radius. q k(q) crosses the gap upwards at most once on [0, 1]."""

    @property
    def gap(self) -> Real: ...

    def __call__(self, q: Real) -> Real:
        """k(q)."""
        ...

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """k(0) and k'(0), for a first guess; no proof relies on them."""
        ...


def condition_rounding(real: Any) -> float:
    """The number that is added to k to cover rounding, in the precision of `real`."""
    return _ROUNDINGS * float(dr.epsilon(real))


def is_free_fraction(condition: FreeRadiusCondition, q: Real) -> Mask:
    """Whether all of [0, q] is proved free, for 0 <= q <= 1."""
    rounding = condition_rounding(type(q))
    return q * (condition(q) + rounding) <= condition.gap * CONDITION_SAFETY


def largest_free_fraction(condition: FreeRadiusCondition, rounds: int) -> Real:
    """The largest q in [0, 1) that is proved free, approached from below.

    Four iterations come within 1e-5 of it for four balls in five, and within a few percent wherever
    the extremal measure is not concentrated in 1e-3 of the sphere; twelve come within 1e-5.

    Why it is safe: only a q at which q k(q) <= gap was *evaluated* is returned; by the single
    crossing, all smaller q are then free too. The choice of candidates affects the length alone:
    each solves q (k_i + k' (q - q_i)) = gap, with k' the slope of k through the last two points (so
    the parabola through them and the start), which converges like the secant method; the last one
    is where the chord from the best covered to the best uncovered point reaches the gap, which
    is covered if q k(q) is convex.
    """
    real = cast("Any", type(condition.gap))
    gap, rounding = condition.gap, condition_rounding(real)
    previous_q = real(0)
    previous_k, slope = condition.expansion_at_zero()
    q = clamp(_root(gap, previous_k, slope), 0, 1)
    safe, low_excess = real(0), -gap  # q k(q) - gap at the ends of the bracket
    unsafe, high_excess = real(1), real(dr.inf)
    for i in range(rounds):
        if i == rounds - 1:
            t = dr.select(dr.isfinite(high_excess), low_excess / (low_excess - high_excess), 1)
            q = fmax(safe, dr.select(dr.isfinite(high_excess), dr.fma(t, unsafe - safe, safe), q))
            q = q * CONDITION_SAFETY
        # Candidates aim at twice the slack, so that rounding does not fail them.
        k = condition(q) + 2 * rounding
        excess = dr.fma(q, k - rounding, -gap)
        is_free: Mask = excess <= 0
        better = is_free & (q >= safe)
        safe, low_excess = dr.select(better, q, safe), dr.select(better, excess, low_excess)
        worse = ~is_free & (q <= unsafe)
        unsafe, high_excess = dr.select(worse, q, unsafe), dr.select(worse, excess, high_excess)
        step = q - previous_q
        slope = dr.select(step == 0, 0, (k - previous_k) / step)
        previous_q, previous_k = q, k
        q = clamp(_root(gap, dr.fma(-slope, q, k), slope), safe, unsafe)
    return safe * CONDITION_SAFETY


def _root(gap: Real, constant: Real, slope: Real) -> Real:
    """The positive root of x (constant + slope x) = gap, or 1 if there is none."""
    root = dr.sqrt(fmax(dr.fma(constant, constant, 4 * slope * gap), 0))
    # Two forms of the same root, each used where the other one cancels.
    is_rising = constant > 0
    numerator = dr.select(is_rising, 2 * gap, root - constant)
    denominator = dr.select(is_rising, constant + root, 2 * slope)
    candidate = numerator / denominator
    return dr.select((denominator > 0) & dr.isfinite(candidate), candidate, 1)


# A radius is multiplied by this, as distances carry a few roundings of float32.
_RADIUS_SAFETY = 1.0 - 1e-6


@dataclass(frozen=True)
class HarmonicBallEnclosure(Enclosure):
    """Base of enclosures of a harmonic f on B(p, radius) of R^dimension that falls and rises there
    by less than two bounds.

    max_fall, max_rise: f - lower and upper - f at p, so that two large numbers are never
        subtracted. None for a side that is not bounded.
    """

    radius: Real
    max_fall: Real | None
    max_rise: Real | None
    dimension: int
    slopes: SlopeRange

    @classmethod
    def from_promise(
        cls, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Self | None:
        if not isinstance(promise, HarmonicBall):
            return None
        radius, max_fall, max_rise = allowed_movement(promise, value, error)
        if not cls.applies_to(promise.dimension, max_fall is not None, max_rise is not None):
            return None
        return cls(radius, max_fall, max_rise, promise.dimension, slopes)

    def is_valid(self, gaps: LevelGaps) -> Mask:
        """Whether ranges and gaps are numbers, and large enough to divide by."""
        valid = (gaps.below >= 0) & (gaps.above >= 0)
        for movement in (self.max_fall, self.max_rise):
            if movement is not None:
                valid &= (movement == 0) | (dr.isfinite(1 / movement) & dr.isfinite(2 * movement))
        return valid

    @classmethod
    def applies_to(cls, dimension: int, is_bounded_below: bool, is_bounded_above: bool) -> bool:
        """Whether this proof holds for balls of this dimension with these ends bounded."""
        del dimension
        return is_bounded_below or is_bounded_above


def allowed_movement(
    promise: HarmonicBall | BoundedLaplacian, value: Real, error: Real
) -> tuple[Real, Real | None, Real | None]:
    """The radius of a promise, and bounds of the fall and of the rise of f that it implies (None:
    that side is not bounded).

    The ends of the promise are moved outwards by the error and by eight units in the last place of
    f: if the two ends are equal up to rounding, the promise would otherwise prove f constant. A
    radius that is not a positive number, or a NaN anywhere, proves nothing (radius 0).
    """
    epsilon = 2 * float(dr.epsilon(type(value)))  # Dr.Jit's is half the distance to the next number
    total_error = dr.fma(8 * epsilon, dr.abs(value), error)
    is_valid = promise.radius > 0

    def movement(end: Real, sign: float) -> Real | None:
        nonlocal is_valid
        if isinstance(end, float) and math.isinf(end):
            return None
        distance = sign * (end - value)
        is_valid = is_valid & (distance == distance)  # not NaN
        return fmax(distance, 0) + total_error

    fall, rise = movement(promise.lower, -1.0), movement(promise.upper, 1.0)
    return dr.select(is_valid, promise.radius * _RADIUS_SAFETY, 0), fall, rise
