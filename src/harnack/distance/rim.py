"""The closest points of the curve in which the field's domain cuts a level set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import fmin
from harnack.backend.lengths import largest_component, length

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import TargetLevels
    from harnack.fields.field import Field
    from harnack.geometry import Volume

__all__ = ["RimDescent"]

_STEPS = 60
# In epsilons, of coordinates: so far inside the domain feet are put, and so near to the level.
_INSIDE, _NEAR = 64.0, 256.0


@dataclass(frozen=True)
class RimDescent:
    """The search for a closest point with f = level and h = 0, h the distance from the domain's
    boundary; all prepared for one backend."""

    backend: Backend
    field: Field
    levels: TargetLevels
    domain: Volume

    def closest(self, x: Vec3, start: Vec3) -> Vec3:
        """The nearest point to x of the curve that is met on the way; NaN where none is.

        A step is the shortest one that leads both f and h to where they should be, to first order,
        and one along the curve. That looks for a zero of (x - y) . t, t the curve's tangent, by the
        secant of the last two places where this falls along the curve, else by the whole of it.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32

        def body(
            y: Vec3, best: Vec3, nearest: Real, slant: Real, moved: Real, k: Any
        ) -> tuple[Any, ...]:
            sample = self.field.evaluate(y)
            wanted, g = self.levels.to_nearest(sample.value), vector(sample.gradient)
            size, steep = largest_component(y), length(g)
            n, u = self.domain.outward_normal(y), g / steep
            inwards = -self.domain.signed_distance(y) - _INSIDE * self.backend.epsilon * size
            off = wanted / steep
            near = _NEAR * self.backend.epsilon * size + sample.error / steep
            distance = length(x - y)
            good = (dr.abs(off) <= near) & (dr.abs(inwards) <= near) & (distance < nearest)
            best, nearest = dr.select(good, y, best), dr.select(good, distance, nearest)
            cosine = dr.dot(n, u)
            sine = 1 - cosine * cosine
            back = vector((off - cosine * inwards) / sine) * u
            back += vector((inwards - cosine * off) / sine) * n
            t = dr.cross(u, n) * dr.rsqrt(sine)
            now = dr.dot(x - y, t)
            falls = moved * (slant - now) > 0
            step = dr.select(falls, moved * now / (slant - now), now)
            limit = fmin(dr.abs(now), 2 * dr.abs(moved) + 1e-3 * distance)
            step = dr.clip(step, -2 * limit, 2 * limit)
            there = y + back + vector(step) * t
            usable = dr.isfinite(dr.squared_norm(there))
            still = dr.abs(step) + length(back) <= near
            k = dr.select(usable & ~(still & good), k + 1, _STEPS)
            return dr.select(usable, there, y), best, nearest, now, step, k

        def more(*state: Any) -> Mask:
            return state[-1] < _STEPS

        state = (vector(start), vector(dr.nan), real(dr.inf), real(0), real(dr.inf), count(0))
        return dr.while_loop(state, more, body, label="along the rim")[1]
