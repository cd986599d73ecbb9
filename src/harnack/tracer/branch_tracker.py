"""Determines the branch of f along rays, if samples give f only modulo 1. Here f is the winding
number of a mesh: samples from octree cells lack an unknown integer, the branch, which has to be
added. The true levels are the values of f at which rays hit; the periodic levels are all numbers
that differ from a true level by an integer.

Samples without a branch (`Sample.branch_unknown`) come from octree cells that expand the solid
angle of the boundary of the mesh. On a step that is proved to meet no periodic level, f stays
between the same two of them. At a triangle of the mesh f jumps by a known integer. So the last
accepted value determines the branch at the next point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend import backend_of
from harnack.backend.elementary import fmax, max_norm, safe_norm
from harnack.enclosures import LevelGaps, Levels, any_is_free
from harnack.enclosures.samples import value_error_bound
from harnack.tracer.level_rule import LevelReading, read_plainly

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.samples import Ray, RaySample, Sample
    from harnack.fields.capabilities import ModuloOne, VariableAccuracy
    from harnack.geometry import Volume
    from harnack.tracer.march import MarchState

# A periodic level that is no true level is passed with known branch if it is nearer than this, in
# value.
_NEAR_LEVEL = 1 / 16
# Changes of f and errors of f below these bounds determine the branch without doubt.
_MAX_CHANGE, _MAX_ERROR = 0.25, 0.125


@dataclass(frozen=True)
class BranchReading(LevelReading):
    """A `LevelReading` of samples that may have been given without their branch, the integer that
    has to be added to f. True levels are the values of f at which rays hit; periodic levels are all
    numbers that differ from a true level by an integer. A ray passes a periodic level if its next
    step may go beyond a periodic level that is no true level.

    passes_branch_level: mask of the rays that pass a periodic level. For these `gaps` holds the
        differences between f and the next true levels, for other rays (but those of `needs_branch`)
        those between f and the next periodic levels.
    needs_branch: mask of rays whose point has to be sampled again, with the branch.
    """

    passes_branch_level: Mask
    needs_branch: Mask

    def gaps_after_jump(self, behind: LevelGaps) -> LevelGaps:
        """The attribute `gaps` for f behind a jump at the point. The jump is an integer, so
        differences to periodic levels stay as they are. Differences to true levels are replaced by
        `behind`, the differences between f behind the jump and the true levels."""
        # Rays in the mask look for true levels, all other rays for periodic ones.
        down = dr.select(self.passes_branch_level, behind.below, self.gaps.below)
        return replace(
            self.gaps,
            below=down,
            above=dr.select(self.passes_branch_level, behind.above, self.gaps.above),
        )

    def must_repeat(self, too_coarse: Mask, accepted: Mask) -> Mask:
        """Mask of the points that have to be sampled again: those of `too_coarse`, whose sample is
        not accurate enough, and the accepted points that need the branch. (`accepted` is the mask
        of points before which no level lies on the ray; a ray leaves other points anyway.)"""
        return too_coarse | (self.needs_branch & accepted)

    def next_accuracy(self, accuracy: Real, coarser: Real) -> Real:
        """The accuracy scale of the next sample; larger is more accurate. A ray that passes a
        periodic level needs the branch at the next point, too, and samples of accuracy scale 1 and
        above have it.

        accuracy: the accuracy scale of this sample.
        coarser: the accuracy scale that the truncation error asks for.
        """
        return dr.select(self.passes_branch_level, fmax(accuracy, 1), coarser)


@dataclass(frozen=True)
class BranchTracker:
    """A `LevelRule` for samples that give f only modulo 1. It finds the branch, the integer that
    has to be added. f is the winding number of a mesh, and jumps by integers at facets (triangles).

    levels: the true levels, at which rays hit. The periodic levels are all numbers that differ from
        a true level by an integer.
    """

    levels: Levels

    def begin(
        self,
        samples: ModuloOne,
        known: Volume,
        path: Ray,
        ends: tuple[Real, Real],
        state: MarchState,
    ) -> MarchState:
        """The state of rays at their start: `state` with f at the start and the accuracy scale of
        the first sample.

        samples: how f is sampled up to an integer.
        known: a volume outside of which the branch is that of f = 0.
        ends: t_min and t_max of the rays `path`. They are marched from `state.proved_to` on.

        A ray that starts inside of `known` needs f at its start. If f there takes long to compute,
        the first sample of the ray is made with the branch instead.
        """
        start, backend = state.proved_to, backend_of(state.proved_to)
        entry, _ = known.clip(path.origin, path.direction, *ends)
        starts_outside = (entry > ends[0]) & (start <= entry)
        starts_inside = state.active & ~starts_outside
        rounding = backend.machine_epsilon * (max_norm(path.origin) + start)
        # NaN where f takes long to compute.
        value = samples.value_if_cheap(path.point(start), rounding, starts_inside)
        has_branch = starts_outside | dr.isfinite(value)
        # The accuracy scale 0 is the coarsest, whose samples may lack the branch.
        accuracy = dr.select(has_branch, 0, backend.Float(samples.sure_accuracy))
        # Rays that start outside begin with the branch of f = 0.
        value = dr.select(dr.isfinite(value), value, 0)
        return replace(state, accuracy_scale=accuracy, value=backend.Float(value))

    def accuracy_of(self, accuracy: VariableAccuracy, scale: Real) -> Real:
        """The accuracy scale that the march asks for."""
        del accuracy
        return scale

    def read(self, ray_sample: RaySample, before: Real, step: Real, size: Real) -> LevelReading:
        """Compare samples with the levels, after adding the branch to those that lack it.

        ray_sample: the samples at the trial points.
        before: f at the last accepted points, as `resolve` needs it.
        step: the distance from the trial point back to the last accepted point.
        size: a bound of the absolute values of coordinates on the ray up to the trial point.
        """
        is_modulo = ray_sample.sample.branch_unknown
        if is_modulo is None:
            return read_plainly(self.levels, ray_sample, size)
        gradient_norm = safe_norm(ray_sample.sample.gradient)
        error = value_error_bound(ray_sample.sample, gradient_norm, size)
        ray_sample, is_sure = self.resolve(ray_sample, before, step, error)
        plain = read_plainly(self.levels, ray_sample, size)
        gaps, passes, needs = self.gaps(ray_sample.sample, is_modulo, is_sure, plain.total_error)
        return BranchReading(
            ray_sample, gradient_norm, gaps, plain.nearest_gap, plain.total_error, passes, needs
        )

    @property
    def _periodic_levels(self) -> Levels:
        """All numbers that differ from a true level by an integer."""
        return Levels(self.levels.values, 1.0)

    def resolve(
        self, ray_sample: RaySample, before: Real, step: Real, total_error: Real
    ) -> tuple[RaySample, Mask]:
        """Add the branch, an integer, to the samples that lack it.

        Returns the samples, and a mask of rays on which the branch is certain even if f is within
        its error of a periodic level (a number that differs from a true level by an integer).

        ray_sample: the samples at the trial points, with enclosures (intervals that are proved to
            contain the change of f along the ray).
        before: f at the last accepted point. If this point lies on a facet (a triangle at which f
            jumps), it is f behind the facet. On rays without an accepted point it is an approximate
            value, or 0, and only tells between which periodic levels f lies.
        step: the distance from the trial point back to the last accepted point.
        total_error: a bound of the error of the sampled f.

        Proof. (1) Suppose the sample proves that f changes by less than a quarter on the way back
        to the accepted point. Both values have errors below an eighth, since samples with larger
        errors are not accepted (`gaps`). So the true value is the one nearest to `before` among
        those that differ from the sample by an integer. (2) Otherwise the way to an accepted trial
        point holds no periodic level. So f lies between the same two of them as `before`, and the
        fractional part of the sample determines it. If the way is not proved to hold no periodic
        level, the point is not accepted, whatever its value. If f is within its error of a periodic
        level, the point is accepted only by (1).
        """
        # Any level serves: in case (2) f stays between two neighbors of level + n, n an integer.
        sample, level = ray_sample.sample, self.levels.values[0]
        offset, branch = sample.value - level, dr.floor(before - level)
        in_branch = level + (branch + (offset - dr.floor(offset)))
        # The value for case (1); `in_branch` is that for case (2).
        nearest = sample.value + dr.round(before - sample.value)
        # An array of the width of `step`.
        change = 0 * step + _MAX_CHANGE
        # Case (1): f changes by less than a quarter on the way back, and its error is small.
        changes_little = any_is_free(ray_sample.backward, LevelGaps(change, change), step) & (
            total_error < _MAX_ERROR
        )
        # 0 stands for no accepted point.
        changes_little &= before != 0
        value = dr.select(changes_little, nearest, in_branch)
        shift = dr.select(sample.branch_unknown, value - sample.value, 0)
        return replace(ray_sample, sample=sample.shifted(shift)), changes_little

    def gaps(
        self, sample: Sample, is_modulo: Mask, is_sure: Mask, total_error: Real
    ) -> tuple[LevelGaps, Mask, Mask]:
        """Return the differences between f and the levels below and above it for which the next
        step is solved, and two masks.

        sample: the samples, with the branch added.
        is_modulo: mask of rays whose sample gave f only modulo 1.
        is_sure: mask of rays on which the branch is certain even if f is within its error of a
            periodic level (the mask that `resolve` returns).
        total_error: a bound of the error of the sampled f.

        Mostly they are the differences to the neighboring periodic levels (numbers that differ from
        a true level by an integer). On some rays, those of the mask `passes_level` in the code,
        they are the differences to the neighboring true levels: where the nearest periodic level is
        close and is no true level, or where the error of f is large.

        The first mask is True for the rays in `passes_level` whose sample was given with its
        branch. The second is True for the rays whose point has to be sampled again with the branch.

        A ray passes a periodic level that is no true level by samples with known branch. A step
        from such a sample may cross that level, so the next sample needs a known branch, too.
        """
        periodic, true = self._periodic_levels.gaps(sample.value), self.levels.gaps(sample.value)
        near = fmax(2 * total_error, _NEAR_LEVEL)
        # If the nearest periodic level is a true one, both differences are equal, and the second
        # condition is False.
        passes_level = (periodic.nearest < near) & (periodic.nearest < 0.5 * true.nearest)
        # Written so that an error that is NaN counts as large.
        passes_level |= ~(total_error < _MAX_ERROR)
        down = dr.select(passes_level, true.below, periodic.below)
        up = dr.select(passes_level, true.above, periodic.above)
        unsure = passes_level | (~is_sure & (periodic.nearest < 2 * total_error))
        return LevelGaps(down, up), passes_level & ~is_modulo, unsure & is_modulo
