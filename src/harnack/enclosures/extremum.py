"""Enclosures of functions that are the greatest or the nearest of several, and of maps of others.

- `Greatest`, with `Negated` and `Stretched`: unions, intersections and differences of solids, and
  solids that were moved and scaled.
- `Nearest`: the surfaces of all branches of a multivalued function.
- `Cusp`: the same near a branch point, where all branches are close to one value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Gaps, Slopes
from harnack.enclosures.parabola import first_root
from harnack.enclosures.selection import any_covers, longest_step

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Part:
    """One of several functions, at a sample.

    least_below, most_below: bounds, by rounding, of how far its value is below the greatest.
    enclosures: of its movement along the path.
    """

    least_below: Real
    most_below: Real
    enclosures: tuple[Enclosure, ...]


@dataclass(frozen=True)
class Greatest(Enclosure):
    """The movement of max f_i, from enclosures of the movements of all f_i.

    Proof. The greatest rises by a gap g only where some f_i rises by g plus its distance below the
    greatest: as far as none of them does, each by its own proof, the greatest does not. It falls by
    g only where all f_i are that low: as far as one of them is proved not to have fallen so far,
    the greatest has not. The proofs of the parts may be of any kind, and of different kinds.
    """

    parts: tuple[Part, ...]

    def step(self, gaps: Gaps) -> Real:
        none = type(gaps.up)(dr.inf)
        up, down = none, type(gaps.up)(0)
        for part in self.parts:
            rise, fall = self._gaps(gaps, part)
            up = fmin(longest_step(part.enclosures, rise), up)
            fallen = longest_step(part.enclosures, fall)
            # A part that may lie below the level already proves nothing, whatever its slope.
            down = fmax(dr.select(fall.down > 0, fallen, 0), down)
        up = dr.select(gaps.up == dr.inf, none, up)
        down = dr.select(gaps.down == dr.inf, none, down)
        reach = fmin(up, down)
        return dr.select(reach == dr.inf, self._reach(none), reach)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        up, down = gaps.up == gaps.up, gaps.down == dr.inf
        for part in self.parts:
            rise, fall = self._gaps(gaps, part)
            up &= any_covers(part.enclosures, rise, length)
            down |= (fall.down > 0) & any_covers(part.enclosures, fall, length)
        return (up | (gaps.up == dr.inf)) & down

    def _reach(self, none: Real) -> Real:
        """How far the enclosures of all parts reach, if there is no level."""
        reach = none
        for part in self.parts:
            reach = fmin(longest_step(part.enclosures, Gaps(none, none)), reach)
        return reach

    @staticmethod
    def _gaps(gaps: Gaps, part: Part) -> tuple[Gaps, Gaps]:
        """How far the part must rise, or fall, for the greatest to meet a level."""
        none = type(gaps.up)(dr.inf)
        return (
            Gaps(none, gaps.up + part.least_below, is_one_sided=True),
            Gaps(fmax(gaps.down - part.most_below, 0), none, is_one_sided=True),
        )


@dataclass(frozen=True)
class Negated(Enclosure):
    """The movement of -f: that of f with the levels above and below exchanged."""

    inner: Enclosure

    def step(self, gaps: Gaps) -> Real:
        return self.inner.step(gaps.exchanged())

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        return self.inner.covers(gaps.exchanged(), length)


@dataclass(frozen=True)
class Stretched(Enclosure):
    """The movement of factor * f(map(path)), where the map stretches the path by `speed`.

    Proof. A length s of the path is a length speed s of the path that `inner` is about, and a gap g
    of factor f is a gap g/factor of f. speed and factor, positive, are known to within a few
    roundings, by which steps are shortened.
    """

    inner: Enclosure
    speed: Real
    factor: Real

    def step(self, gaps: Gaps) -> Real:
        return self.inner.step(self._gaps(gaps)) / self.speed * ROUND_DOWN

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        return self.inner.covers(self._gaps(gaps), length * self.speed / ROUND_DOWN)

    def _gaps(self, gaps: Gaps) -> Gaps:
        share = ROUND_DOWN / self.factor
        down, up = _scaled(gaps.down, share), _scaled(gaps.up, share)
        return Gaps(down, up, gaps.is_one_sided)


def _scaled(gap: Real, share: Real) -> Real:
    """The gap times a positive number; a finite gap stays finite, also if the product overflows."""
    largest = type(gap)(dr.largest(type(gap)))
    return dr.select(gap == dr.inf, gap, fmin(largest, gap * share))


@dataclass(frozen=True)
class Sheet:
    """One of several functions phi_j, continued along the path from a sample.

    opening: slopes of |phi_j| there.
    beyond: by how much |phi_j| exceeds the smallest of them, less what rounding may have added.
    """

    opening: Slopes
    beyond: Real


@dataclass(frozen=True)
class Nearest(Enclosure):
    """The movement of f = s min_j |phi_j|, s the sign of the product of all phi_j.

    Such an f is continuous and single-valued wherever the set of all phi_j is, however the branches
    are numbered, for s changes only where the minimum is 0. It is zero where one of them is.

    Let |phi_j''| <= bend along the path for 0 <= s < reach, for continuations without a jump; and
    g_j = phi_j with the sign for which it has that of f here.

    Proof towards zero, from f > 0 to a level f - d; downwards is upwards for -f. As long as no g_j
    has fallen by |phi_j| - f + d, to f - d, f stays above that: if all g_j are positive, no sign
    has changed and f is the smallest g_j. Otherwise f - d < 0, and where f is negative an odd
    number of the g_j is, so one of them, and f >= -|g_j| > f - d. A g_j falls along its parabola at
    most.
    Away from zero, to a level f + a: f stays below f + a as long as the phi_i that is nearest at
    the start has |g_i| below f + a: as long as g_i has not risen by a, nor fallen by 2 f + a. So a
    step is free of all sheets, not of the nearest alone, and another one may become the nearest on
    the way.

    sheets: one for each phi_j.
    nearest: that with the smallest |phi_j|.
    distance: |f|.
    is_positive: whether f is positive.
    """

    sheets: tuple[Sheet, ...]
    nearest: Sheet
    distance: Real
    is_positive: Mask
    bend: Real
    reach: Real

    def step(self, gaps: Gaps) -> Real:
        towards = dr.select(self.is_positive, gaps.down, gaps.up)
        away = dr.select(self.is_positive, gaps.up, gaps.down)
        length = first_root(away, self.nearest.opening.high, self.bend)
        length = fmin(
            first_root(away + 2 * self.distance, -self.nearest.opening.low, self.bend), length
        )
        known = (length >= 0) & (self.distance >= 0)
        for sheet in self.sheets:
            gap = fmax(towards + sheet.beyond, 0)
            one = first_root(gap, -sheet.opening.low, self.bend)
            known &= one >= 0
            length = fmin(length, one)
        known &= (self.bend >= 0) & (self.reach > 0)
        return fmax(dr.select(known, fmin(length, self.reach), 0) * ROUND_DOWN, 0)


# What powers may round by is more than `ROUND_DOWN` takes off.
_ROUND_POWERS_DOWN = 1.0 - 1e-5
# The values of q in the proof of `Cusp` that are tried.
_PARTS = (0.5, 0.95)


@dataclass(frozen=True)
class Cusp(Enclosure):
    """The movement of f = s min_j |h - u_j| near a branch point a: around the line z = a the
    branches u_j pass into each other.

    Within the radius R of that line |u_j - c| <= C r^alpha, alpha > 0, for all branches (up to a
    period), r the distance from the line. No parabola reaches far there, for second derivatives
    grow without bound, though the branches hardly move.

    Proof. Let y = |h - c|, and v the most by which it falls per unit of the path. On a disk of
    radius r <= R about the line and for a length L of the path, all |h - u_j| are at least
    y - v L - C r^alpha. For any 0 < q < 1 and w = y - (|f| - gap), r = (q w/C)^(1/alpha) and L =
    (1 - q) w/v make that |f| - gap: so f, whose sign changes only where one of them is 0, does not
    fall by the gap up to L, or up to where the path leaves the disk if that is earlier.

    height: y.
    fall: v.
    foot, across: how far ahead the path's closest point to the line is, and how far from it, both
        as lengths in the plane.
    speed: of the path in the plane.
    power, constant: alpha and C.
    inside: the largest r that may be used, R less rounding.
    distance: |f|.
    is_positive: whether f is positive.
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
        room = dr.select(together == together, room, 0)  # NaN proves nothing
        best = 0 * self.height
        for part in _PARTS:
            share = fmax(part * room / self.constant, 0)
            radius = dr.power(share, 1 / self.power) * _ROUND_POWERS_DOWN
            radius = dr.select(dr.isfinite(share) & (radius >= 0), fmin(radius, self.inside), 0)
            chord = (radius - self.across) * (radius + self.across)
            leaves = self.foot + dr.sqrt(fmax(chord, 0))
            leaves = dr.select(self.speed > 0, leaves / self.speed, dr.inf)
            length = dr.select(self.fall > 0, (1 - part) * room / self.fall, dr.inf)
            length = fmin(leaves, length)
            start = self.across * self.across + self.foot * self.foot < radius * radius
            known = start & (room > 0) & (chord > 0) & dr.isfinite(chord)  # squares may overflow
            best = fmax(dr.select(known, length, 0), best)
        return dr.select(away == dr.inf, best * _ROUND_POWERS_DOWN, 0)
