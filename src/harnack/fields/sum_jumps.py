"""The facets across which a sum of fields jumps, if one of its terms does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.fields.capabilities import JumpCrossing, Jumps, MovingTriangles, NearestFacet

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.fields.evaluator import Evaluator


class WeightedJumps(Jumps):
    """The jumps of the sum of weight * f and further functions without jumps, where f jumps across
    facets. The offset (`Jumps.initial_offset`) is that of f times the weight.

    jumps: those of f.
    weight: a number other than 0.
    is_negative: whether the weight is below 0.
    with_continuation: a function that takes the evaluator of f between two crossings, and returns
        that of the sum.
    """

    def __init__(
        self,
        jumps: Jumps,
        weight: Real,
        *,
        is_negative: bool,
        with_continuation: Callable[[Evaluator], Evaluator],
    ) -> None:
        self.inner, self.weight, self.is_negative = jumps, weight, is_negative
        self.with_continuation = with_continuation
        self.takes_all_levels = jumps.takes_all_levels

    def next_crossing(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        crossing = self.inner.next_crossing(
            o, d, self._times(after, 1 / self.weight), t_max, active
        )
        return self._times(crossing, self.weight)

    def _times(self, crossing: JumpCrossing, factor: Real) -> JumpCrossing:
        """A crossing with its jump multiplied by a factor, which has the sign of the weight. The
        normal points to the side on which the function is larger."""
        normal = -crossing.normal if self.is_negative else crossing.normal
        return dataclasses.replace(crossing, jump=factor * crossing.jump, normal=normal)

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        return self.weight * self.inner.initial_offset(o, d, t_min, active)

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> Evaluator:
        """The evaluator of the sum between two crossings. The offset of f is rounded to the nearest
        integer if it is one up to the rounding of the products with the weight."""
        inverse = 1 / self.weight
        ends = self._times(behind, inverse), self._times(ahead, inverse)
        own = offset * inverse
        whole = dr.round(own)
        rounding = 16 * float(dr.epsilon(type(self.weight))) * (1 + dr.abs(own))
        own = dr.select(dr.abs(own - whole) <= rounding, whole, own)
        return self.with_continuation(self.inner.continuation(o, d, *ends, own))

    def moving_triangles(self) -> MovingTriangles | None:
        return self.inner.moving_triangles()

    def distance(self, p: Vec3) -> Real:
        return self.inner.distance(p)

    @property
    def gives_distances(self) -> bool:
        return self.inner.gives_distances

    def nearest_facet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestFacet | None:
        return self.inner.nearest_facet(p, after, limit, active)
