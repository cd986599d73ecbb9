"""Determines the branch of f along rays whose samples give f only modulo 1.

Such samples (`Sample.branch_unknown`) come from FMM cells of the boundary of a mesh, whose winding
number is f. The periodic levels are the levels repeated with period 1. Steps that are proved free
of the periodic levels keep f between the same two of them, and a jump adds an integer. The last
accepted value therefore determines the branch at the next point.
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

# A periodic level that is no true level is passed with known branch if it is nearer than this, in
# value.
_NEAR_LEVEL = 1 / 16
# Changes of f and errors of f below these bounds determine the branch without doubt.
_MAX_CHANGE, _MAX_ERROR = 0.25, 0.125


@dataclass(frozen=True)
class BranchTracker:
    """Adds the branch to samples of f that are known only modulo 1.

    levels: the true levels, at which rays hit.
    """

    levels: Levels

    @property
    def _periodic_levels(self) -> Levels:
        return Levels(self.levels.values, 1.0)

    def resolve(
        self, ray_sample: RaySample, before: Real, step: Real, total_error: Real
    ) -> tuple[RaySample, Mask]:
        """Add the branch to samples that lack it.

        Also returns the lanes on which the branch is certain even if f is within its error of a
        periodic level.

        before: f at the last accepted point, behind the facet if that point lies on a facet. 0 if
            there is no such point: then it only tells between which periodic levels f lies.
        step: the distance back to that point.
        total_error: a bound of the error of the value.

        Proof. (1) Let the sample prove that f changes by less than a quarter on the way back. Then
        f is the candidate nearest to the value before, as the errors of both are below an eighth:
        samples with larger errors are not accepted (`gaps`). (2) Else, if the trial point is
        proved, the way to it is free of periodic levels, and f lies between the same two of them as
        before. A point that is not proved is not accepted, whatever its value. A point at which f
        is within its error of a periodic level is accepted only by (1).
        """
        sample, level = ray_sample.sample, self.levels.values[0]
        value, rung = sample.value - level, dr.floor(before - level)
        between = level + (rung + (value - dr.floor(value)))
        nearest = sample.value + dr.round(before - sample.value)
        change = 0 * step + _MAX_CHANGE
        is_near = any_is_free(ray_sample.backward, LevelGaps(change, change), step) & (
            total_error < _MAX_ERROR
        )
        is_near &= before != 0
        value = dr.select(is_near, nearest, between)
        shift = dr.select(sample.branch_unknown, value - sample.value, 0)
        return replace(ray_sample, sample=sample.shifted(shift)), is_near

    def gaps(
        self, sample: Sample, is_modulo: Mask, is_sure: Mask, total_error: Real
    ) -> tuple[LevelGaps, Mask, Mask]:
        """The gaps to solve steps for, and two masks.

        Gaps: to the neighboring periodic levels; but to the neighboring true levels (`passes`)
        where a periodic level that is no true level is near, or f is hardly known.
        Masks: lanes of `passes` whose sample knows its branch; lanes to be sampled again with known
        branch.

        is_modulo: lanes whose sample gave f only modulo 1.
        is_sure: lanes on which the branch is certain even if f is within its error of a periodic
            level.

        A ray passes a periodic level that is no true level by samples that know their branch: a
        step from such a sample may cross that level, and the next sample must know its branch, too.
        """
        rungs, plain = self._periodic_levels.gaps(sample.value), self.levels.gaps(sample.value)
        near = fmax(2 * total_error, _NEAR_LEVEL)
        passes = (rungs.nearest < near) & (rungs.nearest < 0.5 * plain.nearest)
        passes |= ~(total_error < _MAX_ERROR)
        down = dr.select(passes, plain.below, rungs.below)
        up = dr.select(passes, plain.above, rungs.above)
        doubt = passes | (~is_sure & (rungs.nearest < 2 * total_error))
        return LevelGaps(down, up), passes & ~is_modulo, doubt & is_modulo
