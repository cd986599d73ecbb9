"""An enclosure of functions f that are not harmonic but have a bounded Laplacian on a ball. An
enclosure bounds how far f can change along a ray from the center p of the ball; so it proves a
length of the ray on which f takes no level, a value that rays look for.

The talk on Gillespie, Yang, Botsch, Crane 2024 names such functions as future work; the proof below
and its constant are new in harnack.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.enclosures.enclosure import Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.free_radius import (
    allowed_movement,
    condition_rounding,
    is_free_fraction,
    largest_free_fraction,
)
from harnack.enclosures.promises import BoundedLaplacian, Promise

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real

GREEN_KERNEL_BOUND = 0.394
"""The constant in kappa <= GREEN_KERNEL_BOUND q^2 (2 + ln(1/q))/(1-q^2)^2, for the kappa of
`BoundedLaplacianEnclosure`; proved by `tests/oracles/green_kernel.py`."""

GREEN_SLOPE_BOUND = 0.1907
"""The integral of |G(0,.) + d_v G(0,.)/3| over the unit ball, (19 - 6 ln 3 - 2 sqrt(3) pi)/8,
rounded up."""

# Gaps above this multiple of the scale of the bound count as this multiple, which is reached only
# within 1e-6 of the sphere.
_UNREACHABLE_GAP = 1e18


@dataclass(frozen=True)
class BoundedLaplacianEnclosure(Enclosure):
    """An enclosure of f along a ray from p, if c <= f <= C and a <= Laplacian f <= b on the ball
    B(p, R) of space. q is the length along the ray as a fraction of R.

    radius: R.
    max_fall, max_rise: f(p) - c and C - f(p).
    laplacian_mean, laplacian_spread: m R^2 and l R^2, with m = (a+b)/2 and l = (b-a)/2.
    slopes: the range of the derivative of f along the path at p; f_v in the proof stands for a
        derivative in this range.

    Proof for R = 1, at the point x = p + q v for a unit direction v. Let G be the Green function of
    the ball. Then f = h - integral of G Lap f, where h is harmonic with the boundary values of f,
    so c <= h <= C. As in `HarnackSlopeEnclosure`, the chord of the Poisson kernel gives h(x) <= c +
    (h(p)-c) A + (h_v(p)/3) B with A = (1+3q^2)/(1-q^2)^2 and B = (3q+q^3)/(1-q^2)^2. Put h = f +
    integral of G Lap f in all three places:

        f(x) <= c + (f(p)-c) A + (f_v(p)/3) B + integral of K Lap f,
        K = -G(x,.) + A G(p,.) + (B/3) d_v G(p,.).

    Let kappa be the integral of |K|. The integral of K Lap f is at most m (A-1+q^2)/6 + l kappa(q),
    since the integral of G(x,.) is (1-q^2)/6 and that of d_v G(p,.) is 0. And

        kappa(q) <= 0.394 q^2 (2 + ln(1/q))/(1-q^2)^2  for all 0 < q < 1,

    which is proved by a quadrature with an error bound (`tests/oracles/green_kernel.py`).
    Numerically no constant below 0.391 would do, and the logarithm is needed. The bound of f from
    below is that of -f from above, with -C, -b and -a.

    The first crossing of a level is unique. Let w = f(p)-c + m/6, but at least 0; and leave out m
    q^2/6 if it is negative. Both only raise the bound. As h-c is positive, |h_v(p)|/3 <= h(p)-c,
    hence |f_v(p)|/3 <= w + 0.1907 l, where 0.1907 bounds the integral of |G(p,.) + d_v G(p,.)/3|. A
    larger slope is clamped to this. Then the bound of f - f(p), w (A-1) + (f_v/3) B + l kappa + m
    q^2/6, is convex in q, since A'' >= |B''| and kappa'' >= 0.1907 B'' (checked in the same place),
    and it is 0 at q = 0.

    Both ends of the interval that contains f(x) - f(p) increase with the slope, or stay. The slope
    enters the upper end as f_v B/3 with B >= 0. The lower end is minus the upper end for -f, so the
    slope enters it in the same way.
    """

    radius: Real
    max_fall: Real
    max_rise: Real
    laplacian_mean: Real
    laplacian_spread: Real
    slopes: SlopeRange

    solver_iterations: ClassVar[int] = 5
    """Rounds of `largest_free_fraction`."""

    @classmethod
    def from_promise(
        cls, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Self | None:
        """Return the enclosure from a `BoundedLaplacian`; None for another kind of promise, and if
        the promise bounds f on one side only.

        value, error: f at the center of the ball, and a bound of its error.
        slopes: the range of the derivative of f along the path there.
        """
        if not isinstance(promise, BoundedLaplacian):
            return None
        radius, max_fall, max_rise = allowed_movement(promise, value, error)
        if max_fall is None or max_rise is None:
            return None
        ends = promise.laplacian_lower, promise.laplacian_upper
        return cls.from_ranges(radius, (max_fall, max_rise), ends, slopes)

    @classmethod
    def from_ranges(
        cls,
        radius: Real,
        ranges: tuple[Real, Real],
        laplacian: tuple[Real, Real],
        slopes: SlopeRange,
    ) -> Self:
        """Return the enclosure from bounds of a function on a ball.

        radius: the radius of the ball.
        ranges: two differences in value, both >= 0: how far the function may fall on the ball below
            its value at the center, and how far it may rise above it.
        laplacian: a lower and an upper bound of its Laplacian on the ball.
        slopes: the range of its derivative along the path at the center.

        A range of the Laplacian that is empty or NaN gives a spread that is NaN, so that nothing is
        proved.
        """
        half = 0.5 * radius * radius
        lower, upper = half * laplacian[0], half * laplacian[1]
        # m R^2 and l R^2: both ends were multiplied by R^2/2.
        mean, spread = lower + upper, upper - lower
        # [mean - spread, mean + spread] contains both ends, whatever the roundings.
        rounding = 4 * float(dr.epsilon(type(spread))) if dr.is_array_v(spread) else 0.0
        spread = dr.select(spread >= 0, spread + rounding * (spread + dr.abs(mean)), dr.nan)
        return cls(radius, *ranges, mean, spread, slopes)

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shorter of the lengths on which f is proved not to reach the level above and
        the level below. gaps: the differences between f(p) and these levels."""
        above, below = self._conditions(gaps)
        q = fmin(
            largest_free_fraction(above, self.solver_iterations),
            largest_free_fraction(below, self.solver_iterations),
        )
        return dr.select(self._is_known(gaps), q * self.radius, 0)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to reach neither the level above nor the
        level below on the length `length` of the path. gaps: the differences between f(p) and these
        levels."""
        above, below = self._conditions(gaps)
        q = length / self.radius
        is_inside = (q <= 1) & self._is_known(gaps)
        q = clamp(q, 0, 1)
        return (length <= 0) | (is_inside & is_free_fraction(above, q) & is_free_fraction(below, q))

    def _is_known(self, gaps: LevelGaps) -> Mask:
        """Return the mask of lanes on which the bounds and the gaps (differences between f(p) and
        the next levels) are numbers, and neither too large nor too small to divide by."""
        is_valid = (gaps.below >= 0) & (gaps.above >= 0) & dr.isfinite(self.laplacian_mean)
        for x in (self.max_fall + self.max_rise, self.laplacian_spread):
            is_valid = is_valid & ((x == 0) | (dr.isfinite(1 / x) & dr.isfinite(4 * x)))
        return is_valid

    def _conditions(self, gaps: LevelGaps) -> tuple[_GreenCondition, _GreenCondition]:
        """Return two conditions on a fraction of the radius: for f not to reach the level above on
        it, and for f not to reach the level below.

        gaps: the differences between f(p) and these levels.
        """
        fall, rise, slopes = self.max_fall, self.max_rise, self.slopes
        return (
            self._growth(gaps.above, fall, rise, self.laplacian_mean, slopes.upper),
            # Of -f: fall and rise are exchanged, and the signs of the others change.
            self._growth(gaps.below, rise, fall, -self.laplacian_mean, slopes.negated().upper),
        )

    def _growth(self, gap: Real, u: Real, rise: Real, mean: Real, slope: Real) -> _GreenCondition:
        """Return the condition for f not to rise to the level above. For the numbers of -f as
        arguments, it is the condition for f not to fall to the level below.

        All numbers of the condition are divided by w + l R^2. Here R is the radius, l half the
        difference of the two bounds of the Laplacian, and w = max(u + m R^2/6, 0).

        gap: the difference between f(p) and the level.
        u: f(p) - c, how far f may fall on the ball.
        rise: how far f may rise on the ball.
        mean: m R^2, the mean of the two bounds of the Laplacian times R^2.
        slope: the largest derivative f_v along the path at p.
        """
        w = fmax(dr.fma(mean, 1 / 6, u), 0)
        scale = w + self.laplacian_spread
        inverse = dr.select(scale > 0, 1 / scale, 0)
        w, spread = w * inverse, self.laplacian_spread * inverse
        max_slope = dr.fma(GREEN_SLOPE_BOUND, spread, w)
        rounding = condition_rounding(type(gap))
        # A slope that is not a number counts as the steepest.
        slope = fmin(slope * (self.radius / 3 * inverse) + rounding, max_slope)
        slope = fmax(slope, rounding - max_slope)
        # A level outside of the range is never met, and a constant function meets none.
        is_reachable = (gap <= rise) & (scale > 0)
        gap = dr.select(is_reachable, fmin(gap * inverse, _UNREACHABLE_GAP), _UNREACHABLE_GAP)
        # The first number is sqrt(1 + gap) - 1, in a form that does not cancel.
        return _GreenCondition(
            gap / (dr.sqrt(1 + gap) + 1), w, slope, spread, fmax(mean * inverse, 0)
        )


@dataclass(frozen=True)
class _GreenCondition:
    """The condition for f not to reach a level at the gap d, on a fraction q of the radius: w (A-1)
    + s B + l kappa + m q^2/6 <= d. A, B, kappa, w, s = f_v/3, l and m are those of
    `BoundedLaplacianEnclosure`, with R = 1. All numbers are divided by a difference of values, so
    that they have no unit.

    Let S = (1-q)^2 (1 + left side), which has no pole, and g = sqrt(1 + d) - 1. The condition is
    sqrt(S) <= (1 + g) (1-q), that is, q k(q) <= g with k = g + 1 + (sqrt(S) - 1)/q.

    gap: g.
    weight: w.
    slope: s.
    spread: l.
    mean: m where it is positive, else 0.
    """

    gap: Real
    weight: Real
    slope: Real
    spread: Real
    mean: Real

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """Return k(0) and about k'(0). No proof relies on them."""
        # ln(1/q) in kappa, taken at q = sqrt(gap), about the root for slope 0.
        # (Of gaps of 1e-12 or less it is just below 14.)
        log = clamp(-0.5 * dr.log(fmax(self.gap, 1e-12)), 0, 14)
        first = 3 * self.slope
        quadratic = dr.fma(GREEN_KERNEL_BOUND * self.spread, 2 + log, 5 * self.weight - 2 * first)
        second = 0.5 * (1 + quadratic + self.mean / 6) - 0.125 * (first - 2) * (first - 2)
        return self.gap + 0.5 * first, second

    def __call__(self, q: Real) -> Real:
        """Return k(q) = g + 1 + (sqrt(S) - 1)/q, in a form that does not cancel near q = 0. The
        condition holds at the fraction q of the radius if q k(q) <= g, where g = sqrt(1 + d) - 1
        for the gap d. S is (1-q)^2 times (1 + the left side of the condition). In the code c is (S
        - 1)/q + 2, and root is sqrt(S)."""
        s, r, p = q * q, 1 / (1 + q), 1 - q
        log = 2 - dr.log(fmax(q, 1e-30))
        # The first three terms of the left side are q inner/(1-q^2)^2.
        inner = q * dr.fma(self.weight, 5 - s, GREEN_KERNEL_BOUND * self.spread * log)
        inner = dr.fma(self.slope, 3 + s, inner)
        c = dr.fma(inner, r * r, q * dr.fma(self.mean * (1 / 6) * p, p, 1))  # (S-1)/q + 2
        root = dr.sqrt(fmax(dr.fma(q, c - 2, 1), 0))
        inverse = 1 / (root + 1)
        # By root - 1 = q (c - 2)/(root + 1); g is `gap`.
        return self.gap + inverse * (c + q * (c - 2) * inverse)
