"""Enclosures of functions that are the greatest or the nearest of several, and of maps of others.

- `MaximumEnclosure`, with `NegatedEnclosure` and `ScaledEnclosure`: unions, intersections and
  differences of solids, and solids that were moved and scaled.
- `NearestBranchEnclosure`: the surfaces of all branches of a multivalued function.
- `BranchPointEnclosure`: the same near a branch point, where all branches are close to one value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures.enclosure import STEP_SAFETY, Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.parabola import first_reach
from harnack.enclosures.selection import any_is_free, longest_free_length

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class MaximumOperand:
    """An operand f_i of max f_i, at a sample.

    min_deficit, max_deficit: bounds, with rounding, of the difference max f_j - f_i at the sample.
    enclosures: of the movement of f_i along the path.
    """

    min_deficit: Real
    max_deficit: Real
    enclosures: tuple[Enclosure, ...]


@dataclass(frozen=True)
class MaximumEnclosure(Enclosure):
    """The movement of max f_i, from enclosures of the movements of all f_i.

    Proof. The maximum rises by a gap g only where some f_i rises by g plus its deficit, the
    difference between the maximum and f_i at the start: as long as no f_i does, each by its own
    proof, the maximum does not. It falls by g only where all f_i are that low: as long as one of
    them is proved not to have fallen so far, the maximum has not. The proofs of the operands may be
    of any kind, and of different kinds.
    """

    operands: tuple[MaximumOperand, ...]

    def free_length(self, gaps: LevelGaps) -> Real:
        none = type(gaps.above)(dr.inf)
        up, down = none, type(gaps.above)(0)
        for part in self.operands:
            rise, fall = self._gaps(gaps, part)
            up = fmin(longest_free_length(part.enclosures, rise), up)
            fallen = longest_free_length(part.enclosures, fall)
            # A part that may lie below the level already proves nothing, whatever its slope.
            down = fmax(dr.select(fall.below > 0, fallen, 0), down)
        up = dr.select(gaps.above == dr.inf, none, up)
        down = dr.select(gaps.below == dr.inf, none, down)
        reach = fmin(up, down)
        return dr.select(reach == dr.inf, self._reach(none), reach)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        up, down = gaps.above == gaps.above, gaps.below == dr.inf
        for part in self.operands:
            rise, fall = self._gaps(gaps, part)
            up &= any_is_free(part.enclosures, rise, length)
            down |= (fall.below > 0) & any_is_free(part.enclosures, fall, length)
        return (up | (gaps.above == dr.inf)) & down

    def _reach(self, none: Real) -> Real:
        """The reach of the enclosures of all operands, if there is no level."""
        reach = none
        for part in self.operands:
            reach = fmin(longest_free_length(part.enclosures, LevelGaps(none, none)), reach)
        return reach

    @staticmethod
    def _gaps(gaps: LevelGaps, part: MaximumOperand) -> tuple[LevelGaps, LevelGaps]:
        """How far an operand must rise, and how far it must fall, for the maximum to meet a
        level."""
        none = type(gaps.above)(dr.inf)
        return (
            LevelGaps(none, gaps.above + part.min_deficit, is_one_sided=True),
            LevelGaps(fmax(gaps.below - part.max_deficit, 0), none, is_one_sided=True),
        )


@dataclass(frozen=True)
class NegatedEnclosure(Enclosure):
    """The movement of -f: that of f with the levels above and below exchanged."""

    inner: Enclosure

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.inner.free_length(gaps.swapped())

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(gaps.swapped(), length)


@dataclass(frozen=True)
class ScaledEnclosure(Enclosure):
    """The movement of value_factor * f(map(path)), where the map stretches the path by `speed`.

    Proof. A length s of the path is a length speed s of the path that `inner` is about, and a gap g
    of value_factor f is a gap g/value_factor of f. speed and value_factor, positive, are known to
    within a few roundings, by which steps are shortened.
    """

    inner: Enclosure
    speed: Real
    value_factor: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.inner.free_length(self._gaps(gaps)) / self.speed * STEP_SAFETY

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(self._gaps(gaps), length * self.speed / STEP_SAFETY)

    def _gaps(self, gaps: LevelGaps) -> LevelGaps:
        share = STEP_SAFETY / self.value_factor
        down, up = _scaled(gaps.below, share), _scaled(gaps.above, share)
        return LevelGaps(down, up, gaps.is_one_sided)


def _scaled(gap: Real, share: Real) -> Real:
    """The gap times a positive number; a finite gap stays finite, also if the product overflows."""
    largest = type(gap)(dr.largest(type(gap)))
    return dr.select(gap == dr.inf, gap, fmin(largest, gap * share))


@dataclass(frozen=True)
class BranchSample:
    """A branch phi_j of a multivalued function at a sample, continued along the path.

    slopes: the range of the slope of |phi_j| at the sample.
    excess: |phi_j| minus the smallest |phi_i| at the sample, less a bound of its rounding error.
    """

    slopes: SlopeRange
    excess: Real


@dataclass(frozen=True)
class NearestBranchEnclosure(Enclosure):
    """The movement of f = s min_j |phi_j|, s the sign of the product of all phi_j.

    Such an f is continuous and single-valued wherever the set of all phi_j is, however the branches
    are numbered, for s changes only where the minimum is 0. It is zero where one of the phi_j is.

    Let |phi_j''| <= second_derivative_bound along the path for 0 <= s < reach, for continuations
    without a jump; and let g_j be phi_j or -phi_j, whichever has the sign of f at the start.

    Proof towards zero, from f > 0 to a level f - d; downwards is upwards for -f. As long as no g_j
    has fallen by |phi_j| - f + d, to f - d, f stays above that: if all g_j are positive, no sign
    has changed and f is the smallest g_j. Otherwise f - d < 0, and where f is negative an odd
    number of the g_j is, so at least one g_j is, and f >= -|g_j| > f - d. A g_j falls along its
    parabola at most.

    Proof away from zero, to a level f + a: f stays below f + a as long as |g_i| does, for the phi_i
    that is nearest at the start: as long as g_i has neither risen by a nor fallen by 2 f + a. So a
    step is free of all branches, not of the nearest alone, and another branch may become the
    nearest on the way.

    branches: a sample of each phi_j.
    nearest: the sample of the phi_j with the smallest |phi_j|.
    distance: |f|.
    is_positive: whether f is positive.
    """

    branches: tuple[BranchSample, ...]
    nearest: BranchSample
    distance: Real
    is_positive: Mask
    second_derivative_bound: Real
    reach: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        towards = dr.select(self.is_positive, gaps.below, gaps.above)
        away = dr.select(self.is_positive, gaps.above, gaps.below)
        length = first_reach(away, self.nearest.slopes.upper, self.second_derivative_bound)
        length = fmin(
            first_reach(
                away + 2 * self.distance, -self.nearest.slopes.lower, self.second_derivative_bound
            ),
            length,
        )
        known = (length >= 0) & (self.distance >= 0)
        for sheet in self.branches:
            gap = fmax(towards + sheet.excess, 0)
            one = first_reach(gap, -sheet.slopes.lower, self.second_derivative_bound)
            known &= one >= 0
            length = fmin(length, one)
        known &= (self.second_derivative_bound >= 0) & (self.reach > 0)
        return fmax(dr.select(known, fmin(length, self.reach), 0) * STEP_SAFETY, 0)


# Powers may have larger rounding errors than `STEP_SAFETY` covers.
_POWER_SAFETY = 1.0 - 1e-5
# The values of q in the proof of `BranchPointEnclosure` that are tried.
_TRIED_FRACTIONS = (0.5, 0.95)


@dataclass(frozen=True)
class BranchPointEnclosure(Enclosure):
    """The movement of f = s min_j |h - u_j| near a branch point a: around the line z = a the
    branches u_j pass into each other.

    Within the radius R of that line |u_j - c| <= C r^alpha, alpha > 0, for all branches (up to a
    period), r the distance from the line. A parabola proves only short lengths there, for second
    derivatives grow without bound, though the branches hardly move.

    Proof. Let y = |h - c|, and v its largest rate of decrease along the path. On a disk of radius r
    <= R about the line and for a length L of the path, all |h - u_j| are at least y - v L - C
    r^alpha. For any 0 < q < 1 and w = y - (|f| - gap), r = (q w/C)^(1/alpha) and L = (1 - q) w/v
    make that |f| - gap: so f, whose sign changes only where one of them is 0, does not fall by the
    gap up to L, or up to where the path leaves the disk if that is earlier.

    distance_to_limit: y.
    max_fall_rate: v.
    closest_parameter, closest_distance: how far ahead the path is closest to the branch line, and
        its distance from the line there; both are lengths in the plane.
    speed: of the path in the plane.
    exponent, constant: alpha and C.
    max_radius: the largest r that may be used, R less rounding.
    distance: |f|.
    is_positive: whether f is positive.
    """

    distance_to_limit: Real
    max_fall_rate: Real
    closest_parameter: Real
    closest_distance: Real
    speed: Real
    exponent: Real
    constant: Real
    max_radius: Real
    distance: Real
    is_positive: Mask

    def free_length(self, gaps: LevelGaps) -> Real:
        towards = dr.select(self.is_positive, gaps.below, gaps.above)
        away = dr.select(self.is_positive, gaps.above, gaps.below)
        room = self.distance_to_limit - fmax(self.distance - towards, 0)
        together = room + self.distance + towards + self.max_fall_rate + self.speed
        room = dr.select(together == together, room, 0)  # NaN proves nothing
        best = 0 * self.distance_to_limit
        for part in _TRIED_FRACTIONS:
            share = fmax(part * room / self.constant, 0)
            radius = dr.power(share, 1 / self.exponent) * _POWER_SAFETY
            radius = dr.select(dr.isfinite(share) & (radius >= 0), fmin(radius, self.max_radius), 0)
            chord = (radius - self.closest_distance) * (radius + self.closest_distance)
            leaves = self.closest_parameter + dr.sqrt(fmax(chord, 0))
            leaves = dr.select(self.speed > 0, leaves / self.speed, dr.inf)
            length = dr.select(
                self.max_fall_rate > 0, (1 - part) * room / self.max_fall_rate, dr.inf
            )
            length = fmin(leaves, length)
            start = (
                self.closest_distance * self.closest_distance
                + self.closest_parameter * self.closest_parameter
                < radius * radius
            )
            known = start & (room > 0) & (chord > 0) & dr.isfinite(chord)  # squares may overflow
            best = fmax(dr.select(known, length, 0), best)
        return dr.select(away == dr.inf, best * _POWER_SAFETY, 0)
