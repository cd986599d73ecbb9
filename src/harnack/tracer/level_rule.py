"""How the march, the loop that steps along rays, compares a sample of f with the levels, the values
of f that rays look for. At a trial point of each ray f is sampled; the point is accepted if it is
proved that no level lies before it on the ray. The accuracy scale of a sample tells how exactly f
is computed; larger is more accurate.

A `LevelRule` chooses the accuracy of a sample and reads from it how far f is from the next levels.
`PlainLevels` is the rule for samples that give f itself. `branch_tracker.BranchTracker` is the rule
for samples that may lack an integer, as those of winding numbers do. The surface chooses the rule
(`SurfaceTracer`), so the march knows of no kind of field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from harnack.backend.elementary import fmax, safe_norm
from harnack.fields.samples import value_error_bound

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures import LevelGaps, Levels
    from harnack.fields.capabilities import VariableAccuracy
    from harnack.fields.samples import RaySample


@dataclass(frozen=True)
class LevelReading:
    """What a sample at the trial point of each ray says about the levels.

    ray_sample: the sample, with its enclosures (intervals that are proved to contain the change of
        f along the ray).
    gradient_norm: |grad f| at the point.
    gaps: the differences between f and the levels below and above it for which the next step is
        solved.
    nearest_gap: the difference between f and the nearest level.
    total_error: a bound of the rounding and truncation error of f.
    """

    ray_sample: RaySample
    gradient_norm: Real
    gaps: LevelGaps
    nearest_gap: Real
    total_error: Real

    def gaps_after_jump(self, behind: LevelGaps) -> LevelGaps:
        """The attribute `gaps` for f behind a jump at the point. behind: the differences between f
        behind the jump and the next levels."""
        return behind

    def must_repeat(self, too_coarse: Mask, accepted: Mask) -> Mask:
        """Mask of the points that have to be sampled again with higher accuracy.

        too_coarse: mask of the points at which the truncation error of f is too large.
        accepted: mask of the points before which no level lies.
        """
        del accepted
        return too_coarse

    def next_accuracy(self, accuracy: Real, coarser: Real) -> Real:
        """The accuracy scale of the sample after this one, if the point is accepted.

        accuracy: the accuracy scale of this sample.
        coarser: the accuracy scale, mostly a smaller one, that the truncation error of this sample
            asks for.
        """
        del accuracy
        return coarser


class LevelRule(Protocol):
    """How samples of f are compared with the levels."""

    @property
    def levels(self) -> Levels:
        """The values of f that rays look for."""
        ...

    def accuracy_of(self, accuracy: VariableAccuracy, scale: Real) -> Real:
        """The accuracy scale with which the field is sampled where the march asks for `scale`.
        Larger is more accurate. accuracy: how the field can be sampled."""
        ...

    def read(self, ray_sample: RaySample, before: Real, step: Real, size: Real) -> LevelReading:
        """Compare samples with the levels.

        ray_sample: the samples at the trial points.
        before: f at the last accepted points.
        step: the distance from the trial point back to the last accepted point.
        size: a bound of the absolute values of coordinates on the ray up to the trial point.
        """
        ...


@dataclass(frozen=True)
class PlainLevels:
    """The rule for samples that give f itself: the levels next to the value of the sample count."""

    levels: Levels

    def accuracy_of(self, accuracy: VariableAccuracy, scale: Real) -> Real:
        """The accuracy scale `scale`; but at least 1 for a field whose coarser samples may lack an
        integer."""
        return fmax(scale, 1) if accuracy.may_lack_integer else scale

    def read(self, ray_sample: RaySample, before: Real, step: Real, size: Real) -> LevelReading:
        """Compare the samples `ray_sample` with the levels. size: a bound of the absolute values of
        coordinates on the rays. `before` and `step` are not used."""
        del before, step
        return read_plainly(self.levels, ray_sample, size)


def read_plainly(levels: Levels, ray_sample: RaySample, size: Real) -> LevelReading:
    """The `LevelReading` of samples that give f itself. size: a bound of the absolute values of
    coordinates on the ray."""
    gradient_norm = safe_norm(ray_sample.sample.gradient)
    gaps = levels.gaps(ray_sample.sample.value)
    error = value_error_bound(ray_sample.sample, gradient_norm, size)
    return LevelReading(ray_sample, gradient_norm, gaps, gaps.nearest, error)
