"""Enclosures of functions that are made of several functions, or of one function by a map such as
negation or scaling. An enclosure bounds how far a function can change along a path (a ray) from its
value at a sample; so it proves a length on which the function takes no level, a value that rays
look for. The gaps are the differences between the value and the next levels below and above.

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
    """One of the functions f_i of max f_i, at a sample, with enclosures of its change along the
    path.

    min_deficit, max_deficit: bounds, rounding included, of the deficit max f_j - f_i at the sample.
    enclosures: enclosures of the change of f_i along the path.
    """

    min_deficit: Real
    max_deficit: Real
    enclosures: tuple[Enclosure, ...]


@dataclass(frozen=True)
class MaximumEnclosure(Enclosure):
    """An enclosure of max f_i along a path, from enclosures of all f_i (the operands). The gaps are
    the differences between the maximum at the start of the path and the next levels.

    Proof. Let the deficit of f_i be the difference between the maximum and f_i at the start. The
    maximum rises by a gap g only where some f_i rises by g plus its deficit. As long as no f_i
    does, each by its own proof, the maximum does not rise so far. The maximum falls by g only where
    all f_i are that low. As long as one f_i is proved not to have fallen so far, the maximum has
    not. The operands may have proofs of different kinds.
    """

    operands: tuple[MaximumOperand, ...]

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shorter of two lengths: the length on which no operand rises to the level
        above, and the longest length on which some operand is proved not to fall to the level
        below.

        gaps: the differences between the maximum and these levels. If both are infinite, the result
            is the length on which the enclosures of all operands are valid.
        """
        infinity = type(gaps.above)(dr.inf)
        rise_length, fall_length = infinity, type(gaps.above)(0)
        for operand in self.operands:
            rise_gaps, fall_gaps = self._gaps(gaps, operand)
            rise_length = fmin(longest_free_length(operand.enclosures, rise_gaps), rise_length)
            length = longest_free_length(operand.enclosures, fall_gaps)
            # An operand that may lie below the level already proves nothing, whatever its slope.
            fall_length = fmax(dr.select(fall_gaps.below > 0, length, 0), fall_length)
        rise_length = dr.select(gaps.above == dr.inf, infinity, rise_length)
        fall_length = dr.select(gaps.below == dr.inf, infinity, fall_length)
        free = fmin(rise_length, fall_length)
        # Without a level on either side, the enclosures themselves limit the length.
        return dr.select(free == dr.inf, self._shared_valid_length(infinity), free)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which, for the given length, no operand rises to the level
        above, and at least one operand is proved not to fall to the level below.

        gaps: the differences between the maximum and these levels.
        """
        # Start with True (where the gap is a number), and with whether no level lies below.
        free_above, free_below = gaps.above == gaps.above, gaps.below == dr.inf
        for operand in self.operands:
            rise_gaps, fall_gaps = self._gaps(gaps, operand)
            free_above &= any_is_free(operand.enclosures, rise_gaps, length)
            free_below |= (fall_gaps.below > 0) & any_is_free(operand.enclosures, fall_gaps, length)
        return (free_above | (gaps.above == dr.inf)) & free_below

    def _shared_valid_length(self, infinity: Real) -> Real:
        """Return the length, from the start of the path, on which the enclosures of all operands
        are valid: the smallest of the lengths that they prove if there is no level.

        infinity: the number infinity, of the backend's type.
        """
        length = infinity
        for operand in self.operands:
            length = fmin(
                longest_free_length(operand.enclosures, LevelGaps(infinity, infinity)), length
            )
        return length

    @staticmethod
    def _gaps(gaps: LevelGaps, operand: MaximumOperand) -> tuple[LevelGaps, LevelGaps]:
        """Return the gap by which an operand must rise for the maximum to meet the level above, and
        the gap by which it must fall for the maximum to meet the level below.

        gaps: the differences between the maximum and these levels.

        Each of the two results is a `LevelGaps` in which only that one gap may be finite.
        """
        infinity = type(gaps.above)(dr.inf)
        return (
            LevelGaps(infinity, gaps.above + operand.min_deficit, is_one_sided=True),
            LevelGaps(fmax(gaps.below - operand.max_deficit, 0), infinity, is_one_sided=True),
        )


@dataclass(frozen=True)
class NegatedEnclosure(Enclosure):
    """The enclosure of -f along a path, from an enclosure of f. -f rises to a level where f falls
    to minus this level, so the gaps above and below are exchanged.

    inner: the enclosure of f.
    """

    inner: Enclosure

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return a length on which -f is proved to take no level. gaps: the differences between -f
        at the start and the next levels below and above."""
        return self.inner.free_length(gaps.swapped())

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(gaps.swapped(), length)


@dataclass(frozen=True)
class ScaledEnclosure(Enclosure):
    """An enclosure of h = value_factor * f(map(.)) along a path, from an enclosure of f along the
    mapped path. The map of space multiplies all lengths on the path by `speed`.

    inner: the enclosure of f along the mapped path.
    speed, value_factor: two factors > 0.

    Proof. A length s of the path becomes the length speed * s of the mapped path. h differs from a
    level by g if and only if f differs by g/value_factor from the level divided by value_factor. So
    a length that `inner` proves free of levels for the gaps divided by value_factor is, divided by
    speed, free here. Both factors have errors of a few roundings; the gaps and the length are
    shortened by more than that (`STEP_SAFETY`).
    """

    inner: Enclosure
    speed: Real
    value_factor: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.inner.free_length(self._gaps(gaps)) / self.speed * STEP_SAFETY

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(self._gaps(gaps), length * self.speed / STEP_SAFETY)

    def _gaps(self, gaps: LevelGaps) -> LevelGaps:
        """Return the gaps of f: those of value_factor * f, `gaps`, divided by value_factor. Gaps
        are the differences between a value and the next levels."""
        factor = STEP_SAFETY / self.value_factor
        below, above = _scaled(gaps.below, factor), _scaled(gaps.above, factor)
        return LevelGaps(below, above, gaps.is_one_sided)


def _scaled(gap: Real, factor: Real) -> Real:
    """Return the gap times a positive factor. A finite gap stays finite, even if the product
    overflows."""
    largest = type(gap)(dr.largest(type(gap)))
    return dr.select(gap == dr.inf, gap, fmin(largest, gap * factor))


@dataclass(frozen=True)
class BranchSample:
    """One branch phi_j of a multivalued function at a sample of a path. Followed along the path,
    the branch is a smooth function.

    slopes: the range of the derivative of |phi_j| along the path at the sample.
    excess: |phi_j| minus the smallest |phi_i| of all branches at the sample, minus a bound of the
        rounding error of this difference.
    """

    slopes: SlopeRange
    excess: Real


@dataclass(frozen=True)
class NearestBranchEnclosure(Enclosure):
    """An enclosure of f = s min_j |phi_j| along a path, where phi_j are the branches of a
    multivalued function and s is the sign of the product of all phi_j. So f is zero if and only if
    one of the phi_j is: the level set f = 0 consists of the surfaces of all branches.

    Such an f is continuous and single-valued wherever the set of all phi_j is, however the branches
    are numbered, because s changes only where the minimum is 0.

    branches: a sample of each phi_j.
    nearest: the sample of the phi_j with the smallest |phi_j|.
    distance: |f| at the sample.
    is_positive: whether f is positive at the sample.
    second_derivative_bound: a bound of all |phi_j''| along the path, if each branch is continued
        without a jump.
    reach: the length on which this bound holds.

    Proof. Let g_j be phi_j or -phi_j, whichever has the sign of f at the start. A g_j falls at most
    along the parabola given by its slope and the bound of its second derivative.

    First for a level towards zero. Let f > 0 at the start, and take a level f - d below it (for f <
    0 the proof is that of -f). As long as no g_j has fallen to the value f - d, that is, by |phi_j|
    - f + d, f stays above the level. For if all g_j are positive, no sign has changed and f is the
    smallest g_j. Otherwise the level is below 0. If f is negative then, an odd number of the g_j is
    negative, so at least one is, and f is at least -|g_j| and thus above the level.

    Then for a level away from zero. f stays below a level f + a as long as |g_i| does, where phi_i
    is the nearest branch at the start. This holds as long as g_i has neither risen by a nor fallen
    by 2 f + a. So a step is proved for all branches, not for the nearest one alone, and another
    branch may become the nearest on the way.
    """

    branches: tuple[BranchSample, ...]
    nearest: BranchSample
    distance: Real
    is_positive: Mask
    second_derivative_bound: Real
    reach: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shortest of several lengths: those up to which each branch is proved to stay
        above the level towards zero, and the one up to which the nearest branch stays below the
        level away from zero. The class has the proof.

        gaps: the differences between f at the start and the next levels below and above.
        """
        gap_towards_zero = dr.select(self.is_positive, gaps.below, gaps.above)
        gap_away = dr.select(self.is_positive, gaps.above, gaps.below)
        # The nearest branch may neither rise by the gap away from zero nor fall by 2 |f| more than
        # it.
        length = first_reach(gap_away, self.nearest.slopes.upper, self.second_derivative_bound)
        length = fmin(
            first_reach(
                gap_away + 2 * self.distance,
                -self.nearest.slopes.lower,
                self.second_derivative_bound,
            ),
            length,
        )
        # Comparisons with NaN are False, so that it proves nothing.
        is_valid = (length >= 0) & (self.distance >= 0)
        for branch in self.branches:
            # How far |phi_j| may fall: `excess` is by how much it is larger than |f|.
            gap = fmax(gap_towards_zero + branch.excess, 0)
            branch_length = first_reach(gap, -branch.slopes.lower, self.second_derivative_bound)
            is_valid &= branch_length >= 0
            length = fmin(length, branch_length)
        is_valid &= (self.second_derivative_bound >= 0) & (self.reach > 0)
        return fmax(dr.select(is_valid, fmin(length, self.reach), 0) * STEP_SAFETY, 0)


# Powers may have larger rounding errors than `STEP_SAFETY` covers.
_POWER_SAFETY = 1.0 - 1e-5
# The values of q, in the proof of `BranchPointEnclosure`, that are tried.
_TRIED_FRACTIONS = (0.5, 0.95)


@dataclass(frozen=True)
class BranchPointEnclosure(Enclosure):
    """An enclosure of f = s min_j |h - u_j| along a path near a branch point a, where all branches
    u_j of a multivalued function of the plane are close to one value c. h is the height of a point
    of space, and s the sign of the product of all h - u_j. So f is 0 on the surfaces h = u_j.

    A point of space is (z, h), with z in the plane. The branches pass into each other around the
    line z = a. Let r be the distance from this line. Within a radius R of it, |u_j - c| <= C
    r^alpha with alpha > 0, for all branches (up to a period). A parabola proves only short lengths
    there: second derivatives grow without bound, though the branches hardly move.

    Proof. Let y = |h - c| at the start, and v the largest rate at which it decreases along the
    path. On a disk of radius r <= R about the line, and for a length L of the path, all |h - u_j|
    are at least y - v L - C r^alpha. Let w = y - (|f| - gap). For any 0 < q < 1, the choice r = (q
    w/C)^(1/alpha) and L = (1 - q) w/v makes this bound |f| - gap. The sign of f changes only where
    one of the h - u_j is 0. So |f| does not fall by the gap on the length L, as long as the path
    does not leave the disk.

    distance_to_limit: y.
    max_fall_rate: v.
    closest_parameter, closest_distance: for the point of the path that is closest to the line z =
        a, the length of the path up to it, measured in its projection to the plane, and its
        distance from the line.
    speed: the length of the path's projection to the plane per length of the path.
    exponent, constant: alpha and C.
    max_radius: the largest r that may be used, R minus rounding.
    distance: |f| at the start.
    is_positive: whether f is positive at the start.
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
        """Return the longest of the lengths that the class's proof gives for the values of q that
        are tried; 0 if there is a level farther from zero than f.

        The path leaves the disk of radius r at the length closest_parameter + sqrt(r^2 -
        closest_distance^2) of its projection; so the free length is at most that, divided by speed.
        In the code w, r, C, alpha, L and v are those of the proof: y = |h - c| at the start falls
        at most at the rate v, and w = y - (|f| - gap).
        """
        gap_towards_zero = dr.select(self.is_positive, gaps.below, gaps.above)
        gap_away = dr.select(self.is_positive, gaps.above, gaps.below)
        w = self.distance_to_limit - fmax(self.distance - gap_towards_zero, 0)
        any_nan = w + self.distance + gap_towards_zero + self.max_fall_rate + self.speed
        w = dr.select(any_nan == any_nan, w, 0)  # NaN proves nothing
        # Zero, as an array.
        best = 0 * self.distance_to_limit
        for q in _TRIED_FRACTIONS:
            # r = (q w/C)^(1/alpha), the radius of the disk.
            radius_power = fmax(q * w / self.constant, 0)
            radius = dr.power(radius_power, 1 / self.exponent) * _POWER_SAFETY
            radius = dr.select(
                dr.isfinite(radius_power) & (radius >= 0), fmin(radius, self.max_radius), 0
            )
            # Where the path leaves the disk.
            squared_half_chord = (radius - self.closest_distance) * (radius + self.closest_distance)
            exit_length = self.closest_parameter + dr.sqrt(fmax(squared_half_chord, 0))
            exit_length = dr.select(self.speed > 0, exit_length / self.speed, dr.inf)
            # L = (1 - q) w/v, but no farther than the disk.
            length = dr.select(self.max_fall_rate > 0, (1 - q) * w / self.max_fall_rate, dr.inf)
            length = fmin(exit_length, length)
            starts_inside = (
                self.closest_distance * self.closest_distance
                + self.closest_parameter * self.closest_parameter
                < radius * radius
            )
            is_valid = (
                starts_inside & (w > 0) & (squared_half_chord > 0) & dr.isfinite(squared_half_chord)
            )  # squares may overflow
            best = fmax(dr.select(is_valid, length, 0), best)
        return dr.select(gap_away == dr.inf, best * _POWER_SAFETY, 0)
