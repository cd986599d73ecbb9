"""The solver that all proofs on a ball share, and `HarmonicBallEnclosure`, for harmonic functions.
f is a function that is bounded on a ball B(p, R) about a point p of a ray; a length of the ray from
p on is free if f takes no level (a value that rays look for) on it.

A proof on the ball shows that all lengths up to q R are free if

    q k(q) <= gap,

where k is a function without poles on [0, 1], and the gap is the difference between f(p) and a
level, divided by a difference of values so that it has no unit. `largest_free_fraction` finds the
largest such q from below. Large numbers are never subtracted, so the error of q is small relative
to q. Near a surface the gap is tiny; if only the absolute error of q were small, rays would stall
there.
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
    """A condition q k(q) <= gap for 0 <= q <= 1, with a function k and a number gap >= 0. If it
    holds, f is proved to take no level on a ray within q times the radius of a ball about its
    start: all of [0, q] is free.

    The product q k(q) crosses the gap at most once on [0, 1], upwards. So if a q satisfies the
    condition, all smaller ones do.
    """

    @property
    def gap(self) -> Real: ...

    def __call__(self, q: Real) -> Real:
        """Return k(q)."""
        ...

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """Return k(0) and k'(0), or approximations. They give the solver's first candidate; no
        proof relies on them."""
        ...


def condition_rounding(real: Any) -> float:
    """Return a bound of the rounding error of the function k in a condition q k(q) <= gap
    (`FreeRadiusCondition`). It is added to the computed k.

    real: the Dr.Jit type of the numbers, single or double precision.
    """
    return _ROUNDINGS * float(dr.epsilon(real))


def is_free_fraction(condition: FreeRadiusCondition, q: Real) -> Mask:
    """Return the mask of lanes on which a condition proves that f takes no level from the start of
    the ray up to the fraction q of the ball's radius, 0 <= q <= 1."""
    rounding = condition_rounding(type(q))
    return q * (condition(q) + rounding) <= condition.gap * CONDITION_SAFETY


def largest_free_fraction(condition: FreeRadiusCondition, rounds: int) -> Real:
    """Return about the largest fraction q in [0, 1) of the ball's radius up to which a condition
    proves that f takes no level, never a larger one.

    rounds: the number of iterations. Four come within 1e-5 of the largest q for four balls in five,
        and within a few percent for nearly all others (unless the boundary values for which the
        bound is attained are concentrated in 1e-3 of the sphere); twelve come within 1e-5.

    The result is safe, because only a q at which q k(q) <= gap was *evaluated* is returned. By the
    single crossing, all smaller q are then free too. The choice of candidates affects the length
    alone. Each candidate solves q (k_i + k' (q - q_i)) = gap, where k' is the slope of k through
    the last two points (the left side is the parabola through them and the start). This converges
    like the secant method. The last candidate is where the chord from the best proved point to the
    best point that was not proved meets the gap; it is proved if q k(q) is convex.
    """
    real = cast("Any", type(condition.gap))
    gap, rounding = condition.gap, condition_rounding(real)
    previous_q = real(0)
    previous_k, slope = condition.expansion_at_zero()
    q = clamp(_root(gap, previous_k, slope), 0, 1)
    # The largest q that is proved, and the smallest that failed; the solution lies between.
    safe, low_excess = real(0), -gap  # q k(q) - gap at the ends of the bracket
    unsafe, high_excess = real(1), real(dr.inf)
    for i in range(rounds):
        # The last candidate, by the chord; without a failed q it is the candidate at hand.
        if i == rounds - 1:
            chord_fraction = dr.select(
                dr.isfinite(high_excess), low_excess / (low_excess - high_excess), 1
            )
            q = fmax(
                safe,
                dr.select(dr.isfinite(high_excess), dr.fma(chord_fraction, unsafe - safe, safe), q),
            )
            q = q * CONDITION_SAFETY
        # Candidates aim at twice the slack, so that rounding does not fail them.
        k = condition(q) + 2 * rounding
        excess = dr.fma(q, k - rounding, -gap)
        is_free: Mask = excess <= 0
        raises_safe = is_free & (q >= safe)
        safe, low_excess = (
            dr.select(raises_safe, q, safe),
            dr.select(raises_safe, excess, low_excess),
        )
        lowers_unsafe = ~is_free & (q <= unsafe)
        unsafe, high_excess = (
            dr.select(lowers_unsafe, q, unsafe),
            dr.select(lowers_unsafe, excess, high_excess),
        )
        step = q - previous_q
        slope = dr.select(step == 0, 0, (k - previous_k) / step)
        previous_q, previous_k = q, k
        # The line through the last two points, as (its value at 0) + slope q.
        q = clamp(_root(gap, dr.fma(-slope, q, k), slope), safe, unsafe)
    return safe * CONDITION_SAFETY


def _root(gap: Real, constant: Real, slope: Real) -> Real:
    """Return the positive root x of x (constant + slope x) = gap; 1 if there is none."""
    root = dr.sqrt(fmax(dr.fma(constant, constant, 4 * slope * gap), 0))
    # Two forms of the same root, each used where the other one cancels.
    is_rising = constant > 0
    numerator = dr.select(is_rising, 2 * gap, root - constant)
    denominator = dr.select(is_rising, constant + root, 2 * slope)
    candidate = numerator / denominator
    return dr.select((denominator > 0) & dr.isfinite(candidate), candidate, 1)


# A radius is multiplied by this number, since distances have a few rounding errors of float32.
_RADIUS_SAFETY = 1.0 - 1e-6


@dataclass(frozen=True)
class HarmonicBallEnclosure(Enclosure):
    """Base of enclosures of a function f that is harmonic and bounded on a ball B(p, radius) of
    R^dimension. An enclosure bounds the change of f along a ray from p. The gaps are the
    differences between f(p) and the next levels (values that rays look for) below and above.

    max_fall, max_rise: how far f may fall below, and rise above, its value f(p) on the ball; None
        for a side on which it is not bounded. In this form two large numbers are never subtracted.
    slopes: the range of the derivative of f along the ray at p.
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
        """Return the enclosure from a `HarmonicBall`; None for another kind of promise, and for a
        ball on which f is not bounded on the sides that this class needs.

        value, error: f at the center of the ball, and a bound of its error.
        slopes: the range of the derivative of f along the path there.
        """
        if not isinstance(promise, HarmonicBall):
            return None
        radius, max_fall, max_rise = allowed_movement(promise, value, error)
        if not cls.applies_to(promise.dimension, max_fall is not None, max_rise is not None):
            return None
        return cls(radius, max_fall, max_rise, promise.dimension, slopes)

    def is_valid(self, gaps: LevelGaps) -> Mask:
        """Return the mask of lanes on which the bounds and the gaps are numbers, and the bounds
        large enough to divide by."""
        can_prove = (gaps.below >= 0) & (gaps.above >= 0)
        for movement in (self.max_fall, self.max_rise):
            if movement is not None:
                can_prove &= (movement == 0) | (
                    dr.isfinite(1 / movement) & dr.isfinite(2 * movement)
                )
        return can_prove

    @classmethod
    def applies_to(cls, dimension: int, is_bounded_below: bool, is_bounded_above: bool) -> bool:
        """Return whether this class has a proof for balls of this dimension.

        is_bounded_below, is_bounded_above: whether f has a lower bound, and an upper bound, on the
            ball. One of the two is enough here.
        """
        del dimension
        return is_bounded_below or is_bounded_above


def allowed_movement(
    promise: HarmonicBall | BoundedLaplacian, value: Real, error: Real
) -> tuple[Real, Real | None, Real | None]:
    """Return three numbers: the radius of the ball on which a promise bounds f; how far f may fall
    on the ball below its value at the center; and how far it may rise above that value.

    value: f at the center.
    error: a bound of the error of this value.

    A fall or rise that is not bounded is None. Both bounds are increased by the error and by eight
    units in the last place of f. Otherwise a promise whose two ends are equal up to rounding would
    prove f constant. The radius is 0, which proves nothing, if it is not a positive number or if
    any number is NaN.
    """
    epsilon = 2 * float(dr.epsilon(type(value)))  # Dr.Jit's is half the distance to the next number
    total_error = dr.fma(8 * epsilon, dr.abs(value), error)
    is_valid = promise.radius > 0

    def movement(end: Real, sign: float) -> Real | None:
        """Return how far f may move to one end of the promised range; None if that end is infinite.
        Where that is NaN, the mask `is_valid` of the enclosing function becomes False.

        end: the upper end, with sign 1, or the lower end, with sign -1.
        """
        nonlocal is_valid
        if isinstance(end, float) and math.isinf(end):
            return None
        distance = sign * (end - value)
        is_valid = is_valid & (distance == distance)  # not NaN
        return fmax(distance, 0) + total_error

    fall, rise = movement(promise.lower, -1.0), movement(promise.upper, 1.0)
    return dr.select(is_valid, promise.radius * _RADIUS_SAFETY, 0), fall, rise
