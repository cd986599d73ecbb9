"""Closed solids: the points of a volume where low <= f <= high, with caps where it is cut.

The boundary consists of level sets inside the volume and of caps on the volume's own boundary.
A ray meets a cap where it enters the volume at a point of the solid, or leaves it at one without
having met a level before. Volumes are convex, so a ray enters and leaves at most once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr

from harnack.render.encounter import Encounter, facing, meet_surface

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tracer import LevelSet, PreparedLevelSet


@dataclass(frozen=True)
class Solid:
    """A prepared level set whose levels are the finite ones of `low` and `high`."""

    prepared: PreparedLevelSet
    low: Real
    high: Real

    @classmethod
    def of(cls, surface: LevelSet, prepared: PreparedLevelSet) -> Solid:
        """The solid that `surface.solid` describes."""
        if surface.solid is None:
            raise ValueError("this level set is not a solid: make it with solid=(low, high)")
        finite = iter(prepared.levels.values)
        low, high = (next(finite) if math.isfinite(end) else end for end in surface.solid)
        return cls(prepared, low, high)

    def holds(self, p: Vec3) -> Mask:
        """Whether points of the volume belong to the solid."""
        f = self.prepared.sample(p).value
        return (f >= self.low) & (f <= self.high)

    def meet(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Encounter:
        """Where rays o + t d, |d| = 1, 0 <= t <= t_max, first cross the boundary of the solid."""
        volume = self.prepared.volume
        if volume is None:
            return self._meet_levels(o, d, t_max, active)
        start, end, entering, through = self._ends(o, d, t_max, active)
        inner = self._meet_levels(o, d, t_max, active & ~entering)
        last = self._at(o, d, end, through)
        leaving = through & ~entering & ~inner.met & ~inner.lost & (end < t_max)
        leaving &= self.holds(last)
        position = dr.select(entering, self._at(o, d, start, through), last)
        cap = replace(
            inner,
            t=dr.select(entering, start, end),
            met=entering | leaving,
            position=position,
            normal=_cap_normal(volume, position, d, entering),
            clearance=dr.zeros(self.prepared.backend.Float),
            evaluations=inner.evaluations + dr.select(through, type(inner.evaluations)(2), 0),
        )
        return dr.select(cap.met, cap, inner)

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Whether the boundary lies on rays; what is not proved free counts as lying there."""
        if self.prepared.volume is None:
            return self.prepared.occluded(o, d, 0, t_max, active)
        _, end, entering, through = self._ends(o, d, t_max, active)
        inner = self.prepared.occluded(o, d, 0, t_max, active & ~entering)
        leaving = through & (end < t_max) & self.holds(self._at(o, d, end, through))
        return entering | inner | leaving

    def _ends(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> tuple[Real, Real, Mask, Mask]:
        """The part of rays in the volume: its start and end, whether the start is on a cap, and
        whether there is such a part."""
        real = self.prepared.backend.Float
        start, end = self.prepared.clip(o, d, real(0), real(t_max))
        through = active & (start < end)
        entering = through & (start > 0) & self.holds(self._at(o, d, start, through))
        return start, end, entering, through

    def _at(self, o: Vec3, d: Vec3, t: Real, usable: Mask) -> Vec3:
        t = dr.select(usable & dr.isfinite(t), t, 0)
        return dr.fma(self.prepared.backend.Array3f(t), d, o)

    def _meet_levels(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Encounter:
        """The first level set inside the volume, its normal turned out of the solid."""
        met = meet_surface(self.prepared, o, d, t_max, active)
        f = self.prepared.sample(met.position).value
        at_low = dr.abs(f - self.low) < dr.abs(f - self.high)
        return replace(met, normal=dr.select(at_low, -met.normal, met.normal))


def _cap_normal(volume: Volume, position: Vec3, d: Vec3, entering: Mask) -> Vec3:
    """The volume's outward normal, against rays that enter and along those that leave."""
    side = dr.select(entering, type(position.x)(-1), 1)
    return facing(volume.outward_normal(position), d, side)
