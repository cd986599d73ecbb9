"""The closest points of the curve in which the field's domain cuts a level set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.backend.lengths import largest_component, length

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import TargetLevels
    from harnack.fields.field import Field
    from harnack.geometry import Volume

__all__ = ["RimDescent"]

_ROUNDS, _LANDINGS = 80, 8
# In epsilons, of coordinates: so far inside the domain feet are put, by how much they may miss
# that, and how near they are to the level.
_INSIDE, _MISS, _NEAR = 64.0, 48.0, 256.0
_LEAST_SHARE = 1e-9  # of a step: shorter ones are given up
_LEAST_SLOPE = 0.05  # of (x - y) . t along the curve: steps are no longer than 20 times that
_LEAST_STEP = 1e-8  # of the distance: what is left is half its square


@dataclass(frozen=True)
class RimDescent:
    """The search for a closest point with f = level and h = 0, h the distance from the domain's
    boundary; all prepared for one backend."""

    backend: Backend
    field: Field
    levels: TargetLevels
    domain: Volume

    def closest(self, x: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        """A point y of the curve that is no farther from x than those nearby, met on the way from
        `start`, and the curve's curvature there; NaN where the curve is not met.

        Let the curve have the tangent t and the second derivative y'', which follows from those of
        f and h along t (differences of their gradients). Half the squared distance has the
        derivative -(x - y).t along the curve and the second derivative 1 - (x - y).y'', which give
        Newton's step w t + w^2/2 y''. After a step Newton's method for both equations leads back to
        the curve. The step counts if that comes nearer to x, else a quarter of it is tried: at a
        corner, where two faces of the domain meet, steps so become as short as it needs.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x = vector(x)

        def body(
            y: Vec3, best: Vec3, nearest: Real, curvature: Real, w: Real, tangent: Vec3,
            bend: Vec3, share: Real, landing: Any, k: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            there = self._at(y)
            distance = length(x - y)
            met = dr.isfinite(nearest)
            counts = there.is_on & (~met | (distance < nearest))
            # On the curve, and nearer: the next step.
            slope = 1 - dr.dot(x - y, there.bend)
            step = dr.dot(x - y, there.tangent) / fmax(dr.abs(slope), _LEAST_SLOPE)
            step = clamp(step, -distance, distance)
            best, nearest = dr.select(counts, y, best), dr.select(counts, distance, nearest)
            curvature = dr.select(counts, length(there.bend), curvature)
            w, tangent = dr.select(counts, step, w), dr.select(counts, there.tangent, tangent)
            bend = dr.select(counts, there.bend, bend)
            # Off the curve: back to it, for some rounds; else a shorter step.
            lands = ~there.is_on & (landing < _LANDINGS) & dr.isfinite(dr.squared_norm(there.back))
            fails = ~counts & ~lands
            share = dr.select(counts, fmin(4 * share, 1), dr.select(fails, 0.25 * share, share))
            s = share * w
            onward = dr.fma(vector(s), tangent, best) + vector(0.5 * s * s) * bend
            active &= (lands | counts | met) & (share > _LEAST_SHARE) & (k + 1 < _ROUNDS)
            active &= lands | (dr.abs(s) > fmax(_LEAST_STEP * nearest, there.near))
            y = dr.select(lands, y + there.back, onward)
            landing = dr.select(lands, landing + 1, 0)
            return (
                y, best, nearest, curvature, w, tangent, bend, share, landing, k + 1, active
            )  # fmt: skip

        def more(*state: Any) -> Mask:
            return state[-1]

        state = (
            vector(start), vector(dr.nan), real(dr.inf), real(dr.nan), real(0), vector(0),
            vector(0), real(1), count(0), count(0), self.backend.Bool(True),
        )  # fmt: skip
        found = dr.while_loop(state, more, body, label="along the rim")
        return found[1], found[3]

    def _at(self, y: Vec3) -> _RimPlace:
        real, vector = self.backend.Float, self.backend.Array3f
        sample = self.field.evaluate(y)
        gradient, size = vector(sample.gradient), largest_component(y)
        steep, n = length(gradient), vector(self.domain.outward_normal(y))
        u = gradient / steep
        inwards = -self.domain.signed_distance(y) - _INSIDE * self.backend.epsilon * size
        off = self.levels.to_nearest(sample.value) / steep
        near = dr.fma(_NEAR * self.backend.epsilon, size, real(sample.error) / steep)
        cosine = dr.dot(n, u)
        sine = 1 - cosine * cosine

        def solution(along_u: Real, along_n: Real) -> Vec3:
            """The shortest vector with these products with u and n."""
            first, second = along_u - cosine * along_n, along_n - cosine * along_u
            return (vector(first) * u + vector(second) * n) / sine

        t = dr.cross(u, n) * dr.rsqrt(sine)
        h = self.backend.epsilon**0.5 * fmax(size, real(1e-30))
        ahead = dr.fma(vector(h), t, y)
        falls = dr.dot(vector(self.field.evaluate(ahead).gradient) - gradient, t) / (steep * h)
        turns = dr.dot(vector(self.domain.outward_normal(ahead)) - n, t) / h
        # Beside an edge of the domain the normal is another one ahead: no curvature.
        turns = dr.select(dr.abs(turns) * h < 1e-3, turns, 0)
        is_on = (dr.abs(off) <= near) & (dr.abs(inwards) <= _MISS * self.backend.epsilon * size)
        return _RimPlace(is_on, near, solution(off, inwards), t, solution(-falls, -turns))


@dataclass(frozen=True)
class _RimPlace:
    """A place near the curve: whether it is on it, to `near`; the step back to it, to first order;
    its unit tangent and second derivative."""

    is_on: Mask
    near: Real
    back: Vec3
    tangent: Vec3
    bend: Vec3
