"""Values that are known but for a whole number, continued along rays.

A sample in cells of a boundary (`Sample.branch_unknown`) knows a winding number but for a whole
number. The levels, repeated with period 1, are a ladder, and w lies between two of its rungs. Steps
that are proved free of all rungs stay between them, and a sheet moves w by a whole number of rungs:
so the number follows from the value at the last accepted point, and need be found only once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax
from harnack.enclosures import LevelGaps, Levels, any_is_free

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.fields.samples import RaySample, Sample

# How near a rung that is no level may be, in value, before the number is asked for.
_NEAR_LEVEL = 1 / 16
# A change of f that leaves no doubt about the number, and errors that do not.
_MAX_CHANGE, _MAX_ERROR = 0.25, 0.125


@dataclass(frozen=True)
class BranchTracker:
    """levels: those that count."""

    levels: Levels

    @property
    def _periodic_levels(self) -> Levels:
        return Levels(self.levels.values, 1.0)

    def resolve(
        self, look: RaySample, before: Real, step: Real, total_error: Real
    ) -> tuple[RaySample, Mask]:
        """The look with the number added where the value is known but for that; and where it is
        known even if f is within its error of a rung.

        before: f at the last accepted point, behind the sheet if that is at one; where there is
            none, 0, which only tells between which rungs f is. step: how far that is back.
        total_error: of the value.

        Proof. (1) If the look proves that f changes by less than a quarter on the way back, it is
        the value nearest to the one before, as both are known up to less than an eighth: what is
        known worse is not taken (`gaps`). (2) Else, if the point is proved, the way to it is free
        of rungs, and f lies between the same two as before. A point that is not proved is not
        accepted, whatever its value; nor is one within its error of a rung, but by (1).
        """
        sample, level = look.sample, self.levels.values[0]
        value, rung = sample.value - level, dr.floor(before - level)
        between = level + (rung + (value - dr.floor(value)))
        nearest = sample.value + dr.round(before - sample.value)
        change = 0 * step + _MAX_CHANGE
        is_near = any_is_free(look.backward, LevelGaps(change, change), step) & (
            total_error < _MAX_ERROR
        )
        is_near &= before != 0
        value = dr.select(is_near, nearest, between)
        shift = dr.select(sample.branch_unknown, value - sample.value, 0)
        return replace(look, sample=sample.shifted(shift)), is_near

    def gaps(
        self, sample: Sample, is_modulo: Mask, is_sure: Mask, total_error: Real
    ) -> tuple[LevelGaps, Mask, Mask]:
        """The gaps from f to the rungs on both sides, or where one that is no level is near, or f
        is hardly known, to the next levels; where it is the latter; and where the sample must be
        taken again with the number instead.

        is_sure: where f is known even within its error of a rung.

        A ray passes such a rung by samples that know the number: a step from one of them may, and
        the one after it must be of that kind too.
        """
        rungs, plain = self._periodic_levels.gaps(sample.value), self.levels.gaps(sample.value)
        near = fmax(2 * total_error, _NEAR_LEVEL)
        passes = (rungs.nearest < near) & (rungs.nearest < 0.5 * plain.nearest)
        passes |= ~(total_error < _MAX_ERROR)
        down = dr.select(passes, plain.below, rungs.below)
        up = dr.select(passes, plain.above, rungs.above)
        doubt = passes | (~is_sure & (rungs.nearest < 2 * total_error))
        return LevelGaps(down, up), passes & ~is_modulo, doubt & is_modulo
