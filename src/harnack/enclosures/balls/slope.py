"""The slope bound: Harnack's inequality that also uses the directional derivative.

The extremal measures are the equality cases of Jensen's inequality and of the chord bound for a
convex function: a point mass ring at one latitude, and two point masses at the poles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.enclosures.balls.ball import Ball
from harnack.enclosures.balls.solve import Condition, is_covered, largest_covered, rounding

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import Gaps

# A chord whose gap is this many times u is not reached within the ball, but for 1e-6 of it.
_NEVER = 1e18


@dataclass(frozen=True)
class Slope(Ball):
    """One- or two-sided slope bound in 2, 3 and 4 dimensions.

    Proof. A positive harmonic u on B(p, R) is, along a unit direction v and with q = t/R,
    u(p+tv) = integral of P(q, s) dnu(s) over s in [-1, 1], where P(q, s) =
    (1-q^2)/(1+q^2-2qs)^(n/2), nu >= 0 has mass u(p) and first moment R u_v(p)/n (differentiate
    at q = 0: dP/dq = n s). So the mean of s is m = R u_v/(n u), and P is convex in s, hence

        u P(q, m) <= u(p+tv) <= u [(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1)]

    (Jensen; chord), both attained. The upper bound is convex in q. The lower one rises, then
    falls: its derivative has the sign of m q^2 - 2q + m (n = 2), q^3 + m q^2 - 5q + 3m (n = 3)
    or q^3 - 3q + 2m (n = 4), each decreasing on [0, 1]. So each first crossing is unique, and
    what is free at q is free before it. With upper - f > 0 the same holds for its negative
    slope; the better of the two is kept on each side.

    Neither end falls as the slope grows: the upper one rises with m as P(q, 1) >= P(q, -1), the
    lower one as P(q, .) does. For upper - f, whose slope is negated, they change places and signs.
    """

    rounds: ClassVar[int] = 4
    """Of the solver: see `largest_covered`."""

    def step(self, gaps: Gaps) -> Real:
        q = type(gaps.up)(1)
        for alternatives in self._conditions(gaps):
            side = type(q)(0)
            for condition in alternatives:
                side = fmax(side, largest_covered(condition, self.rounds))
            q = fmin(q, side)
        return dr.select(self.is_known(gaps), q * self.radius, 0)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        q = length / self.radius
        covered = q <= 1
        q = clamp(q, 0, 1)
        for alternatives in self._conditions(gaps):
            free = None
            for condition in alternatives:
                proved = is_covered(condition, q)
                free = proved if free is None else free | proved
            covered = covered & free
        return (length <= 0) | (covered & self.is_known(gaps))

    def _conditions(self, gaps: Gaps) -> tuple[list[Condition], list[Condition]]:
        """What keeps f from the level above, and from the level below."""
        up: list[Condition] = []
        down: list[Condition] = []
        rising = self.slopes
        for u, slopes, gap_away, away, gap_toward, toward in (
            (self.range_below, rising, gaps.up, up, gaps.down, down),  # u = f - lower
            (self.range_above, rising.negated(), gaps.down, down, gaps.up, up),  # u = upper - f
        ):
            if u is None:
                continue
            # u = 0 forces u to vanish identically: no level is ever reached.
            share = dr.select(u > 0, 1 / u, dr.inf)
            scale = self.radius * share / self.dimension
            most = dr.select(u > 0, slopes.high * scale, 0)
            least = dr.select(u > 0, slopes.low * scale, 0)
            slack = rounding(type(gaps.up))
            # A slope that is not a number counts as the worst one, in either place.
            steep, flat = fmax(fmin(most + slack, 1), -1), clamp(least - slack, -1, 1)
            away.append(_Chord.of(fmin(gap_away * share, _NEVER), steep, self.dimension))
            toward.append(_Jensen(fmin(gap_toward * share, 1), flat, self.dimension))
        return up, down


@dataclass(frozen=True)
class _Chord:
    """(1+m)/2 P(q,1) + (1-m)/2 P(q,-1) <= w = 1 + gap/u.

    The left side times (1-q)^K, K = n-1, is B = (1-q)^K + q A/(1+q)^K with a polynomial A, and
    B^(1/K) <= w^(1/K) (1-q) has no pole: it says q k(q) <= g with g = w^(1/K) - 1 and
    k = g + 1 + (B^(1/K) - 1)/q.
    """

    gap: Real  # g
    mean: Real
    dimension: int

    @classmethod
    def of(cls, gap: Real, mean: Real, dimension: int) -> _Chord:
        if dimension == 3:
            gap = gap / (dr.sqrt(1 + gap) + 1)
        elif dimension == 4:
            root = dr.cbrt(1 + gap)
            gap = gap / dr.fma(root, root + 1, 1)
        return cls(gap, mean, dimension)

    def start(self) -> tuple[Real, Real]:
        n, k = self.dimension, self.dimension - 1
        first = n * self.mean - k
        second = n * (1 - self.mean) - 0.5 * (k - 1) / (k * k) * first * first
        return self.gap + n * self.mean / k, second

    def __call__(self, q: Real) -> Real:
        m, r, s = self.mean, 1 / (1 + q), q * q
        if self.dimension == 2:
            return self.gap + 2 * (q + m) * r
        if self.dimension == 3:
            c = dr.fma(q * (5 - s) + m * (3 + s), r * r, q)  # (B - 1)/q + 2
            root = dr.sqrt(fmax(dr.fma(q, c - 2, 1), 0))
            share = 1 / (root + 1)
            return self.gap + share * (c + q * (c - 2) * share)
        a = q * (9 + s * (s - 2)) + 4 * m * (1 + s)
        c = dr.fma(a, r * r * r, q * (3 - q))  # (B - 1)/q + 3
        root = dr.cbrt(fmax(dr.fma(q, c - 3, 1), 0))
        share = 1 / dr.fma(root, root + 1, 1)
        return self.gap + share * (c + q * (c - 3) * share * (root + 2))


@dataclass(frozen=True)
class _Jensen:
    """P(q, m) >= 1 - gap/u.

    With D = 1+q^2-2qm it says (1-g) D^(n/2) <= 1-q^2, that is q k(q) <= g with
    k = (1-g) (D^(n/2) - 1 + q^2)/q + g q. q k(q) is convex.
    """

    gap: Real
    mean: Real
    dimension: int

    def start(self) -> tuple[Real, Real]:
        n, m, rest = self.dimension, self.mean, 1 - self.gap
        second = 1 + 0.5 * n * (1 + (n - 2) * m * m)
        return -rest * n * m, dr.fma(rest, second, self.gap)

    def __call__(self, q: Real) -> Real:
        e = q - 2 * self.mean
        d = dr.fma(q, e, 1)
        if self.dimension == 2:
            rise = q + e
        elif self.dimension == 4:
            rise = dr.fma(e, d + 1, q)
        else:
            x = dr.sqrt(fmax(d, 0))
            rise = q + e * (d + x + 1) / (x + 1)
        return dr.fma(1 - self.gap, rise, self.gap * q)
