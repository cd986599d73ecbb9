"""Closed solids: the points of a volume where low <= f <= high, with caps where it is cut.

The boundary consists of level sets inside the volume and of caps on the volume's own boundary.
A ray meets a cap where it enters the volume at a point of the solid, or leaves it at one without
having met a level before. Volumes are convex, so a ray enters and leaves at most once. A cap lies
on the section if it is the section that ends the ray's part in the volume there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr

from harnack.rendering.surfaces.encounter import CLEARANCE, SurfaceHit, facing, meet_surface

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer import LevelSet, PreparedLevelSet


@dataclass(frozen=True)
class CappedSolid:
    """A prepared level set whose levels are the finite ones of `low` and `high`."""

    prepared: PreparedLevelSet
    low: Real
    high: Real

    @classmethod
    def of(cls, surface: LevelSet, prepared: PreparedLevelSet) -> CappedSolid:
        """The solid that `surface.solid` describes."""
        if surface.solid is None:
            raise ValueError("this level set is not a solid: make it with solid=(low, high)")
        finite = iter(prepared.levels.values)
        low, high = (next(finite) if math.isfinite(end) else end for end in surface.solid)
        return cls(prepared, low, high)

    def _holds(self, p: Vec3) -> Mask:
        """Whether points of the volume belong to the solid."""
        f = self.prepared.sample(p).value
        return (f >= self.low) & (f <= self.high) & self.prepared.counts(p)

    def meet(self, o: Vec3, d: Vec3, t_max: Real, active: Mask, leaves: Real = 0.0) -> SurfaceHit:
        """Where rays o + t d, |d| = 1, 0 <= t <= t_max, first cross the boundary of the solid.

        leaves: of a ray that starts at the boundary, 1 if it goes out of the solid there, -1 if
            it goes in; else 0. Such a ray starts off the boundary by a clearance, and where the
            solid or a gap in it is thinner than that, it slips through: it then crosses back at
            once, straight on. So going in and going out always alternate, and no light is lost
            at the sharp rims of caps.
        """
        zero = self.prepared.backend.Float(0)
        start, end = self.prepared.clip(o, d, zero, t_max)
        through = active & (start < end)
        start = dr.select(through, start, 0)
        known = self.prepared.resolves(o, end)  # other rays are lost among the levels
        within = through & known & self._holds(self._at(o, d, start))
        inside = within & (start <= 0)
        slipped = active & known & (((leaves < 0) & ~inside) | ((leaves > 0) & inside))
        entering = within & ~inside & ~slipped
        met = self._meet_levels(o, d, t_max, active & ~entering & ~slipped)
        met = replace(
            met, evaluations=met.evaluations + type(met.evaluations)(dr.select(through, 1, 0))
        )
        leaving = inside & ~slipped & ~met.met & ~met.lost & (end < t_max)
        capped = entering | leaving | slipped
        t = dr.select(capped & ~slipped, dr.select(leaving, end, start), 0)
        position = self._at(o, d, t)
        outwards = dr.select(leaving | (leaves < 0), zero + 1, -1)
        normal = outwards * d
        if self.prepared.volume is not None:
            cap = facing(self.prepared.volume.outward_normal(position), d, outwards)
            normal = dr.select(slipped, normal, cap)
        clearance = zero + CLEARANCE * self.prepared.tolerance.distance
        cut = met.cut
        if self.prepared.section is not None:
            first, last = self.prepared.section.clip(o, d, zero, t_max)
            cut = dr.select(leaving, last <= end, entering & (first >= start))
        crossed = replace(
            met, t=t, met=capped, position=position, normal=normal, clearance=clearance, cut=cut
        )
        return dr.select(capped, crossed, met)

    def occludes(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> Mask:
        """Whether the boundary lies on rays; what is not proved free counts as lying there."""
        start, end = self.prepared.clip(o, d, self.prepared.backend.Float(0), t_max)
        through = active & (start < end)
        start = dr.select(through, start, 0)
        known = self.prepared.resolves(o, end)
        within = through & known & self._holds(self._at(o, d, start))
        capped = within & ((start > 0) | (end < t_max))
        return capped | self.prepared.occluded(o, d, 0, t_max, active & ~capped)

    def _meet_levels(self, o: Vec3, d: Vec3, t_max: Real, active: Mask) -> SurfaceHit:
        """The first level set inside the volume, its normal turned out of the solid."""
        met = meet_surface(self.prepared, o, d, t_max, active)
        at_low = dr.abs(met.value - self.low) < dr.abs(met.value - self.high)
        normal = dr.select(at_low, -met.normal, met.normal)
        return replace(met, normal=normal)

    def _at(self, o: Vec3, d: Vec3, t: Real) -> Vec3:
        t = dr.select(dr.isfinite(t), t, 0)
        return dr.fma(self.prepared.backend.Array3f(t), d, o)
