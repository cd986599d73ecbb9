"""Enclosures of maxima and of nearest branches of several functions, and of mapped functions.

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
        inf = type(gaps.above)(dr.inf)
        rise_length, fall_length = inf, type(gaps.above)(0)
        for operand in self.operands:
            rise, fall = self._gaps(gaps, operand)
            rise_length = fmin(longest_free_length(operand.enclosures, rise), rise_length)
            length = longest_free_length(operand.enclosures, fall)
            # An operand that may lie below the level already proves nothing, whatever its slope.
            fall_length = fmax(dr.select(fall.below > 0, length, 0), fall_length)
        rise_length = dr.select(gaps.above == dr.inf, inf, rise_length)
        fall_length = dr.select(gaps.below == dr.inf, inf, fall_length)
        reach = fmin(rise_length, fall_length)
        return dr.select(reach == dr.inf, self._reach(inf), reach)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        free_above, free_below = gaps.above == gaps.above, gaps.below == dr.inf
        for operand in self.operands:
            rise, fall = self._gaps(gaps, operand)
            free_above &= any_is_free(operand.enclosures, rise, length)
            free_below |= (fall.below > 0) & any_is_free(operand.enclosures, fall, length)
        return (free_above | (gaps.above == dr.inf)) & free_below

    def _reach(self, inf: Real) -> Real:
        """The reach of the enclosures of all operands, if there is no level."""
        reach = inf
        for operand in self.operands:
            reach = fmin(longest_free_length(operand.enclosures, LevelGaps(inf, inf)), reach)
        return reach

    @staticmethod
    def _gaps(gaps: LevelGaps, operand: MaximumOperand) -> tuple[LevelGaps, LevelGaps]:
        """The gaps by which an operand must rise, and must fall, for the maximum to meet a
        level."""
        inf = type(gaps.above)(dr.inf)
        return (
            LevelGaps(inf, gaps.above + operand.min_deficit, is_one_sided=True),
            LevelGaps(fmax(gaps.below - operand.max_deficit, 0), inf, is_one_sided=True),
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
        factor = STEP_SAFETY / self.value_factor
        below, above = _scaled(gaps.below, factor), _scaled(gaps.above, factor)
        return LevelGaps(below, above, gaps.is_one_sided)


def _scaled(gap: Real, factor: Real) -> Real:
    """The gap times a positive number; a finite gap stays finite, also if the product overflows."""
    largest = type(gap)(dr.largest(type(gap)))
    return dr.select(gap == dr.inf, gap, fmin(largest, gap * factor))


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
        is_valid = (length >= 0) & (self.distance >= 0)
        for branch in self.branches:
            gap = fmax(towards + branch.excess, 0)
            branch_length = first_reach(gap, -branch.slopes.lower, self.second_derivative_bound)
            is_valid &= branch_length >= 0
            length = fmin(length, branch_length)
        is_valid &= (self.second_derivative_bound >= 0) & (self.reach > 0)
        return fmax(dr.select(is_valid, fmin(length, self.reach), 0) * STEP_SAFETY, 0)


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
    closest_parameter, closest_distance: the length at which the path is closest to the branch line,
        and its distance from the line there; both are lengths in the plane.
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
        w = self.distance_to_limit - fmax(self.distance - towards, 0)
        total = w + self.distance + towards + self.max_fall_rate + self.speed
        w = dr.select(total == total, w, 0)  # NaN proves nothing
        best = 0 * self.distance_to_limit
        for q in _TRIED_FRACTIONS:
            power = fmax(q * w / self.constant, 0)
            radius = dr.power(power, 1 / self.exponent) * _POWER_SAFETY
            radius = dr.select(dr.isfinite(power) & (radius >= 0), fmin(radius, self.max_radius), 0)
            chord = (radius - self.closest_distance) * (radius + self.closest_distance)
            exit_length = self.closest_parameter + dr.sqrt(fmax(chord, 0))
            exit_length = dr.select(self.speed > 0, exit_length / self.speed, dr.inf)
            length = dr.select(self.max_fall_rate > 0, (1 - q) * w / self.max_fall_rate, dr.inf)
            length = fmin(exit_length, length)
            inside = (
                self.closest_distance * self.closest_distance
                + self.closest_parameter * self.closest_parameter
                < radius * radius
            )
            valid = inside & (w > 0) & (chord > 0) & dr.isfinite(chord)  # squares may overflow
            best = fmax(dr.select(valid, length, 0), best)
        return dr.select(away == dr.inf, best * _POWER_SAFETY, 0)
