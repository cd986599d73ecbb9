"""The nearest of several sheets: surfaces that a function with several branches makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Gaps, Slopes
from harnack.enclosures.parabola import first_root

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Sheet:
    """One of several functions phi_j, continued along the path from where it was looked at.

    opening: slopes of |phi_j| there. beyond: by how much |phi_j| exceeds the smallest of them,
        less what rounding may have added.
    """

    opening: Slopes
    beyond: Real


@dataclass(frozen=True)
class Nearest(Enclosure):
    """The movement of f = s min_j |phi_j|, s the sign of the product of all phi_j.

    Such an f is continuous and single-valued wherever the set of the phi_j is, whichever branch is
    called which, for s changes only where the minimum is 0. It is zero where one of them is.

    Let |phi_j''| <= bend along the path for 0 <= s < reach, for continuations without a jump; and
    g_j = phi_j with the sign for which it has that of f here.

    Proof towards zero, from f > 0 to a level f - d; downwards is upwards for -f. As long as no g_j
    has fallen by |phi_j| - f + d, to f - d, f stays above that: if all g_j are positive, no sign
    has changed and f is the smallest g_j. Otherwise f - d < 0, and where f is negative an odd
    number of the g_j is, so one of them, and f >= -|g_j| > f - d. A g_j falls along its parabola at
    most.
    Away from zero, to a level f + a: f < f + a as long as the nearest has |g_i| below that: as it
    has not risen by a, nor fallen by 2 f + a. So a step is free of all sheets, not of the nearest
    alone, and what is the nearest may change on the way.

    sheets: all of them. nearest: that of the smallest. distance: |f|. is_positive: whether f is.
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
