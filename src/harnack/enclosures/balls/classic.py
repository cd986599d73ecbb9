"""The published rule: Harnack's inequality with a lower bound alone.

Source: Gillespie, Yang, Botsch, Crane 2024, Eq. 4-7 (n = 3) and Eq. 27 (n = 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.enclosures.balls.ball import Ball
from harnack.enclosures.enclosure import ROUND_DOWN

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.enclosures.enclosure import Gaps


@dataclass(frozen=True)
class Classic(Ball):
    """Harnack's inequality for u = f - lower > 0 on B(p, R), in every direction alike.

    Proof. u is a Poisson integral of a positive measure of mass u(p), and the kernel
    P(q, s) = (1-q^2)/(1+q^2-2qs)^(n/2), q = |y-p|/R, lies between its values at s = -1 and 1:

        u(p) (1-q)/(1+q)^(n-1) <= u(y) <= u(p) (1+q)/(1-q)^(n-1).

    The step is the q at which one of the two first reaches a level. With u = f - lower and
    v = level - lower the root is, in forms that do not cancel near v = u (the printed Eq. 7 does:
    20 % too long in float32 at |a-1| = 1e-6),

        n = 2:  |v-u| / (u+v)         n = 3:  2 |v-u| / (u + 2v + sqrt(u (u + 8v)))

    and for n = 4 the cubic is solved by Newton's method from the safe side (`_quartic_growing`).
    A level at or below `lower` cannot be reached inside the ball: the step is R. The slope does not
    enter.
    """

    def step(self, gaps: Gaps) -> Real:
        return dr.select(self.is_known(gaps), self.radius * self._fraction(gaps), 0)

    def _fraction(self, gaps: Gaps) -> Real:
        """The step divided by the radius, from whichever sides are bounded."""
        below = above = None
        if self.range_below is not None:
            below = _one_sided(self.range_below, gaps.up, gaps.down, self.dimension)
        if self.range_above is not None:  # upper - f is positive and harmonic: mirror
            above = _one_sided(self.range_above, gaps.down, gaps.up, self.dimension)
        if below is None or above is None:
            one = below if above is None else above
            assert one is not None
            return one
        return fmax(below, above)


def _one_sided(u: Real, gap_away: Real, gap_toward: Real, dimension: int) -> Real:
    """Safe q for positive u, a level `gap_away` above u and one `gap_toward` below it."""
    growing, falling = _LEVEL_RULES[dimension]
    # u = 0 forces u to vanish identically: no level is ever reached.
    up = dr.select((gap_away == dr.inf) | (u <= 0), 1, growing(u, u + gap_away, gap_away))
    v = u - gap_toward
    down = dr.select((v <= 0) | (gap_toward == dr.inf), 1, falling(u, fmax(v, 0), gap_toward))
    return clamp(fmin(up, down), 0, 1) * ROUND_DOWN


def _plane(u: Real, v: Real, gap: Real) -> Real:
    return gap / (u + v)


def _space(u: Real, v: Real, gap: Real) -> Real:
    # The product of the two roots, as u (u + 8v) may underflow or overflow.
    return 2 * gap / (u + 2 * v + dr.sqrt(u) * dr.sqrt(u + 8 * v))


def _quartic_growing(u: Real, v: Real, gap: Real) -> Real:
    """(1+q)/(1-q)^3 = w, w = v/u. Newton's method from the safe side, in two forms.

    For w < 2: h(q) = gap - q (u + v (3 - 3q + q^2)) is decreasing and convex, from the left. That
    cancels for large w, where y = 1-q is the root of the convex w y^3 + y - 2, from the right."""
    q = gap / (u + 3 * v)
    for _ in range(4):
        h = gap - q * (u + v * (3 - 3 * q + q * q))
        q = q + fmax(h, 0) / (u + 3 * v * (1 - q) * (1 - q))
    w = v / u
    y = fmin(dr.cbrt(2 / w), 1)
    for _ in range(4):
        y = y - (y * dr.fma(w * y, y, 1) - 2) / dr.fma(3 * w * y, y, 1)
    return dr.select(v < 2 * u, q, dr.fma(y, -1 - 1e-6, 1))


def _quartic_falling(u: Real, v: Real, gap: Real) -> Real:
    """(1-q)/(1+q)^3 = v/u: h(q) = gap - q (u + v (3 + 3q + q^2)) is decreasing and concave, so
    Newton's method ends right of the root and the chord from (0, gap) to there ends left of it,
    the safe side."""
    q = fmin(gap / (u + 3 * v), 1)
    for _ in range(4):
        h = gap - q * (u + v * (3 + 3 * q + q * q))
        q = q + fmin(h, 0) / (u + 3 * v * (1 + q) * (1 + q))
    h = fmin(gap - q * (u + v * (3 + 3 * q + q * q)), 0)
    return q * gap / (gap - h)


_LEVEL_RULES = {
    2: (_plane, _plane),
    3: (_space, _space),
    4: (_quartic_growing, _quartic_falling),
}
