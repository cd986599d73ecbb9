"""Branch points: all branches are close to one value there, and a ray may pass beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures.enclosure import Enclosure, Gaps

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

_ROUND_DOWN = 1.0 - 1e-5
# Which part of the room there is goes to the branches, the rest to the ray's own movement.
_PARTS = (0.5, 0.95)


@dataclass(frozen=True)
class Cusp(Enclosure):
    """The movement of f = s min_j |h - u_j| near a line z = a about which branches u_j turn.

    Within the radius R of the line |u_j - c| <= C r^alpha, alpha > 0, of all branches (up to a
    period); r is the distance from it. No parabola reaches far there, for second derivatives grow
    without bound, though the branches hardly move.

    Proof. Let y = |h - c|, and v the most by which it falls per unit of the path. On a disk of
    radius r <= R about the line and for a length L of the path, all |h - u_j| are at least
    y - v L - C r^alpha. For any part q of w = y - (|f| - gap), r = (q w/C)^(1/alpha) and L =
    (1 - q) w/v leave |f| - gap of it: so f, whose sign changes only where one of them is 0, does
    not fall that far up to L, or up to where the path leaves the disk if that is earlier.

    height: y. fall: v. foot, across: of the line's foot on the path in the plane, how far ahead it
    is, and how far off the line, in the plane's lengths. speed: of the path in the plane.
    inside: the largest r that may be used, R less rounding. distance: |f|.
    """

    height: Real
    fall: Real
    foot: Real
    across: Real
    speed: Real
    power: Real
    constant: Real
    inside: Real
    distance: Real
    is_positive: Mask

    def step(self, gaps: Gaps) -> Real:
        towards = dr.select(self.is_positive, gaps.down, gaps.up)
        away = dr.select(self.is_positive, gaps.up, gaps.down)
        room = self.height - fmax(self.distance - towards, 0)
        together = room + self.distance + towards + self.fall + self.speed
        room = dr.select(together == together, room, 0)  # what is not a number proves nothing
        best = 0 * self.height
        for part in _PARTS:
            share = fmax(part * room / self.constant, 0)
            radius = dr.power(share, 1 / self.power) * _ROUND_DOWN
            radius = dr.select(dr.isfinite(share) & (radius >= 0), fmin(radius, self.inside), 0)
            chord = (radius - self.across) * (radius + self.across)
            leaves = self.foot + dr.sqrt(fmax(chord, 0))
            leaves = dr.select(self.speed > 0, leaves / self.speed, dr.inf)
            length = dr.select(self.fall > 0, (1 - part) * room / self.fall, dr.inf)
            length = fmin(leaves, length)
            start = self.across * self.across + self.foot * self.foot < radius * radius
            known = start & (room > 0) & (chord > 0) & dr.isfinite(chord)  # squares may overflow
            best = fmax(dr.select(known, length, 0), best)
        return dr.select(away == dr.inf, best * _ROUND_DOWN, 0)
