"""The spherical-cap bound: the sharpest enclosure for a harmonic function with two known ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.enclosures.balls.ball import Ball
from harnack.enclosures.balls.solve import is_covered, largest_covered, rounding

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import Gaps


@dataclass(frozen=True)
class Caps(Ball):
    """Bounded on both sides in space: the extremal boundary values are two spherical caps.

    Proof. With values in [c, C], f = c + (C-c) g and g the Poisson integral of boundary values
    in [0, 1] with mean p = (f-c)/(C-c) and first moment mu = R f_v/(3 (C-c)) along v. For fixed
    q the kernel P(q, s) is convex in s, so among densities in [0, 1] with given mass and first
    moment, integral P g is largest for the indicator of {s <= s1} u {s >= s2} (bathtub principle:
    P minus the chord through s1, s2 is positive exactly there), two caps about v of heights
    b = p + mu/(1-p) ahead and a = p - mu/(1-p) behind, which depend on p and mu alone. The
    integral over caps is elementary,

        U = c + (C-c) [1 - (1-q^2)/(2q) (1/s1 - 1/s2)],
        s1^2 = (1-q)^2 + 2qb,   s2^2 = (1+q)^2 - 2qa,

    and as s2^2 - s1^2 = 4q (1-p), U <= f + gap is the same as

        (1 - gap/(C-f)) s1 s2 (s1+s2)/2 <= 1-q^2.

    The lower bound is the complement: C - (C-c)(...) with p -> 1-p, mu -> -mu. |mu| <= p (1-p)
    holds in exact arithmetic and is enforced.

    Neither end falls as the slope grows: weight then moves from s = a-1 to s = 1-b, which is no
    smaller as a + b = 2p <= 2, and P(q, .) rises. L is the complement, negated.

    The first crossing is unique: (X-s)^(-3/2) with X = (1+q^2)/(2q) is a Laplace transform of
    exp(-tX) exp(ts), hence totally positive in (q, s) on (0, 1) x (-1, 1) (Karlin 1968), hence
    variation diminishing: U - level is the transform of values with signs (+, -, +), so it has
    at most those sign changes, in that order, and where it starts negative it turns once.
    """

    rounds: ClassVar[int] = 4
    """Of the solver: see `largest_covered`."""

    @classmethod
    def applies(cls, dimension: int, is_bounded_below: bool, is_bounded_above: bool) -> bool:
        return dimension == 3 and is_bounded_below and is_bounded_above

    def step(self, gaps: Gaps) -> Real:
        up, down = self._conditions(gaps)
        q = fmin(largest_covered(up, self.rounds), largest_covered(down, self.rounds))
        return dr.select(self.is_known(gaps), q * self.radius, 0)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        up, down = self._conditions(gaps)
        q = length / self.radius
        inside = (q <= 1) & self.is_known(gaps)
        q = clamp(q, 0, 1)
        return (length <= 0) | (inside & is_covered(up, q) & is_covered(down, q))

    def _conditions(self, gaps: Gaps) -> tuple[_TwoCaps, _TwoCaps]:
        """What keeps f from the level above, and from the level below."""
        below, above = self.range_below, self.range_above
        assert below is not None
        assert above is not None
        share = 1 / (below + above)
        p, rest = below * share, above * share
        moment = self.radius * share / 3
        rising, falling = moment * self.slopes.high, -moment * self.slopes.low
        return (
            _two_caps(gaps.up, above, p, rest, rising),
            _two_caps(gaps.down, below, rest, p, falling),
        )


def _two_caps(gap: Real, most: Real, p: Real, rest: Real, mu: Real) -> _TwoCaps:
    # Without a range f is constant: no level is ever reached.
    slack = rounding(type(gap)) * p
    shift = dr.select(rest > 0, mu / rest, 0) + slack
    shift = fmax(fmin(shift, p), -p)  # the worst one, p, if the slope is not a number
    return _TwoCaps(dr.select(gap < most, gap / most, 1), p, rest, shift)


@dataclass(frozen=True)
class _TwoCaps:
    """(1-g) S(q) <= 1-q^2 with S = s1 s2 (s1+s2)/2, g = gap/(C-f) and heights b, a of the caps.

    That is q k(q) <= g with k = (1-g) (S - 1 + q^2)/q + g q.
    """

    gap: Real
    p: Real
    rest: Real  # 1 - p, accurate where it is small
    shift: Real  # mu/(1-p)

    def start(self) -> tuple[Real, Real]:
        x, y, rest = self.rest - self.shift, self.rest + self.shift, 1 - self.gap
        second = 2.5 - 0.75 * dr.fma(x, x, y * y) - x * y + 2 * self.shift * self.shift
        return 3 * rest * self.shift, dr.fma(rest, second, self.gap)

    def __call__(self, q: Real) -> Real:
        # s = 1 + q x with x = e/(s+1), as s^2 = 1 + q e.
        e1, e2 = q - 2 * (self.rest - self.shift), q + 2 * (self.rest + self.shift)
        back, on = 1 - q, 1 + q
        s1 = dr.sqrt(dr.fma(back, back, 2 * q * (self.p + self.shift)))
        s2 = dr.sqrt(dr.fma(on, on, -2 * q * (self.p - self.shift)))
        both = 1 / ((s1 + 1) * (s2 + 1))
        total = dr.fma(e1, s2 + 1, e2 * (s1 + 1)) * both  # x1 + x2
        rise = q * dr.fma(e1 * e2, both, 1) + total * dr.fma(0.5 * s1, s2, 1)
        return dr.fma(1 - self.gap, rise, self.gap * q)
