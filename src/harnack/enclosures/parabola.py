"""Parabolas: Lipschitz constants, bounded second derivatives, and Taylor forms of a path's own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Gaps, Slopes
from harnack.enclosures.promises import Curvature, Lipschitz, Promise

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real

_ROOT_OF_TWO = math.sqrt(2.0)


@dataclass(frozen=True)
class Parabola(Enclosure):
    """slopes.low s + least_curvature s^2/2 <= F(s) <= slopes.high s + most_curvature s^2/2.

    For 0 <= s < reach. Curvatures are second derivatives, of either sign.

    Proof of the step. The upper parabola starts a gap g > 0 below the level above; it can reach it
    first at the smallest positive root of a s + c s^2/2 = g, which is, without cancellation,
    2g/(a + r) where a > 0 and (r - a)/c where a <= 0 < c, with r = sqrt(a^2 + 2 c g); there is none
    where a <= 0 and c <= 0, or where r is not real. For the level below the same holds of -F.
    Exact to second order where the curvatures are, so it converges quadratically at the surface.
    The upper end rises with the largest slope, the lower one with the least.
    """

    slopes: Slopes
    least_curvature: Real
    most_curvature: Real
    reach: Real

    def step(self, gaps: Gaps) -> Real:
        up = first_root(gaps.up, self.slopes.high, self.most_curvature)
        down = first_root(gaps.down, -self.slopes.low, -self.least_curvature)
        known = (up >= 0) & (down >= 0) & (self.reach > 0)  # and not NaN
        return fmax(dr.select(known, fmin(fmin(up, down), self.reach), 0) * ROUND_DOWN, 0)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        free = _stays_below(gaps.up, self.slopes.high, self.most_curvature, length)
        free &= _stays_below(gaps.down, -self.slopes.low, -self.least_curvature, length)
        return (length <= 0) | ((length <= self.reach) & free)


@dataclass(frozen=True)
class Cone(Parabola):
    """The Lipschitz cone: the step of sphere tracing.

    Proof. |F(s)| <= K s for s < radius by the promise: a parabola without curvature, whose step is
    min(gap)/K. Source: Hart 1996, Theorem 1.
    """

    @classmethod
    def of(cls, promise: Promise, value: Real, error: Real, slopes: Slopes) -> Self | None:
        if not isinstance(promise, Lipschitz):
            return None
        constant = _not_negative(promise.constant)
        return cls(Slopes(-constant, constant), 0.0, 0.0, promise.radius)

    # Both sides in one formula, for speed: a ray beside an edge asks a dozen cones at each point.

    def step(self, gaps: Gaps) -> Real:
        length = gaps.smaller / self.slopes.high
        known = (gaps.down > 0) & (gaps.up > 0) & (self.slopes.high >= 0) & (self.reach > 0)
        return dr.select(known, fmin(length, self.reach), 0) * ROUND_DOWN

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        moved = self.slopes.high * length
        free = (length <= self.reach) & (moved <= gaps.down) & (moved <= gaps.up)
        return (length <= 0) | free


@dataclass(frozen=True)
class Taylor(Parabola):
    """Taylor's formula with a bound H of the second derivatives.

    Proof. With a slope in [low, high], F(s) lies between low s - H s^2/2 and high s + H s^2/2 for
    s < radius: the promise, read along a line.
    """

    @classmethod
    def of(cls, promise: Promise, value: Real, error: Real, slopes: Slopes) -> Self | None:
        if not isinstance(promise, Curvature):
            return None
        constant = _not_negative(promise.constant)
        return cls(slopes, -constant, constant, promise.radius)


def _not_negative(constant: Real) -> Real:
    """The constant, or not a number where it can be none: then nothing is proved."""
    return dr.select(constant >= 0, constant, dr.nan)


def first_root(gap: Real, slope: Real, curvature: Real) -> Real:
    """The first s > 0 at which slope s + curvature s^2/2 reaches the gap; infinite if none does.

    In a form whose squares neither overflow nor vanish: close to a zero of high order slope,
    curvature and gap are all far below the root of the smallest number.
    """
    none = gap == dr.inf  # there is no level on this side
    turns = curvature < 0
    gap = _rounded_down_where(turns, dr.select(none, 0, gap))
    steep, bent = dr.abs(slope), _steepest_that_turns(gap, curvature)
    longer, shorter = fmax(steep, bent), fmin(steep, bent)
    ratio = dr.select(longer > 0, shorter / longer, 0)
    root = longer * dr.sqrt(dr.fma(dr.select(turns, -ratio, ratio), ratio, 1))
    away = dr.select(slope <= 0, dr.select(gap > 0, dr.inf, 0), dr.nan)
    falling = dr.select(curvature <= 0, away, (root - slope) / curvature)
    found = dr.select(slope > 0, gap / (0.5 * slope + 0.5 * root), falling)
    return dr.select(none | (turns & (steep < bent)), dr.inf, found)


def _stays_below(gap: Real, slope: Real, curvature: Real, length: Real) -> Mask:
    """Whether slope s + curvature s^2/2 <= gap for 0 <= s <= length.

    The largest value lies at an end, or at the vertex of a parabola that rises and then turns."""
    bend = 0.5 * curvature * length
    turned = (slope > 0) & (slope + 2 * bend < 0)
    steepest = _steepest_that_turns(_rounded_down_where(turned, gap), curvature)
    return dr.select(turned, slope <= steepest, (bend + slope) * length <= gap)


def _steepest_that_turns(gap: Real, curvature: Real) -> Real:
    """sqrt(2 |curvature| gap): a parabola with a smaller slope turns before the gap."""
    return dr.sqrt(dr.abs(curvature)) * (_ROOT_OF_TWO * dr.sqrt(gap))


def _rounded_down_where(turns: Mask, gap: Real) -> Real:
    """The gap, smaller by eight roundings where a parabola turns: if it turns close to the level,
    rounding decides whether a^2 + 2 c g is negative."""
    return dr.select(turns, gap * (1 - 8 * float(dr.epsilon(type(gap)))), gap)
