"""The closest points of the curve in which the field's domain cuts a level set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.backend.lengths import largest_coordinate, length

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
# Of the way to another face: steps end there.
_BEFORE = 0.999
# At a corner of the domain, whether the search turns into the other face, or has.
_TURNING, _TURNED = 1, 2
_LEAST_SHARE = 1e-9  # of a step: shorter ones are given up
_LEAST_SLOPE = 0.05  # of (x - y) . t along the curve: steps are no longer than 20 times that
_SAME = 1e-6  # cosines of angles between normals of one face differ from one by less
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
        the curve. The step counts if that comes nearer to x, else a quarter of it is tried. Where
        it led to another face of the domain instead, that face ends steps from then on, so that
        they lead to the corner where both faces meet; from there the search goes on, once, along
        the curve in the other face.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x = vector(x)

        def body(
            y: Vec3, best: Vec3, nearest: Real, w: Real, tangent: Vec3, bend: Vec3, normal: Vec3,
            wall: Vec3, wall_height: Real, hop: Any, share: Real, landing: Any, k: Any,
            active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            there = self._at(y)
            distance = length(x - y)
            met = dr.isfinite(nearest)
            is_other = dr.dot(there.normal, normal) < 1 - _SAME
            gap = fmax(wall_height - dr.dot(wall, best), 0)
            turns = (hop == _TURNING) & is_other & (distance < nearest + 8 * gap + 100 * there.near)
            counts = there.is_on & (~met | (distance < nearest) | turns)
            # Beyond another face: that is a wall. Else off the curve: back to it, for some rounds.
            is_free = ~(dr.squared_norm(wall) > 0)
            crosses = met & is_other & is_free & ~counts & (hop != _TURNING)
            lands = ~there.is_on & ~crosses & (landing < _LANDINGS)
            lands &= dr.isfinite(dr.squared_norm(there.back))
            fails = ~counts & ~lands
            # On the curve, and nearer: the next step.
            slope = 1 - dr.dot(x - y, there.bend)
            step = dr.dot(x - y, there.tangent) / fmax(dr.abs(slope), _LEAST_SLOPE)
            w = dr.select(counts, clamp(step, -distance, distance), w)
            best, nearest = dr.select(counts, y, best), dr.select(counts, distance, nearest)
            tangent = dr.select(counts, there.tangent, tangent)
            bend = dr.select(counts, there.bend, bend)
            moves = counts & is_other
            wall = dr.select(crosses, there.normal, dr.select(moves, 0, wall))
            wall_height = dr.select(crosses, dr.dot(there.normal, y) + there.inwards, wall_height)
            normal = dr.select(counts, there.normal, normal)
            share = dr.select(counts, fmin(4 * share, 1), share)
            share = dr.select(fails & ~crosses, 0.25 * share, share)
            # The wall is met where rate |s| + s^2/2 wall.bend is the gap.
            s, gap = share * w, fmax(wall_height - dr.dot(wall, best), 0)
            rate = dr.sign(w) * dr.dot(wall, tangent)
            root = rate + dr.sqrt(rate * rate + 2 * gap * dr.dot(wall, bend))
            until = dr.select(root > 0, _BEFORE * 2 * gap / root, dr.inf)
            is_limited = ~(is_free & ~crosses) & (until < dr.abs(s))
            s = dr.select(is_limited, clamp(s, -until, until), s)
            onward = dr.fma(vector(s), tangent, best) + vector(0.5 * s * s) * bend
            least = dr.select(is_limited, 0, _LEAST_STEP * nearest)
            is_short = dr.abs(s) <= fmax(least, there.near)
            hop = dr.select((hop == _TURNING) & ~lands, _TURNED, hop)
            ends = is_short & is_limited & ~lands & (hop == 0)
            hop = dr.select(ends, _TURNING, hop)
            onward = dr.select(ends, dr.fma(vector(gap + 8 * there.near), wall, best), onward)
            active &= (lands | counts | met) & (share > _LEAST_SHARE) & (k + 1 < _ROUNDS)
            active &= lands | ends | ~is_short
            y, landing = dr.select(lands, y + there.back, onward), dr.select(lands, landing + 1, 0)
            return (
                y, best, nearest, w, tangent, bend, normal, wall, wall_height, hop, share,
                landing, k + 1, active,
            )  # fmt: skip

        def more(*state: Any) -> Mask:
            return state[-1]

        nothing, zero = vector(dr.nan), vector(0)
        state = (
            vector(start), nothing, real(dr.inf), real(0), zero, nothing, zero, zero, real(0),
            count(0), real(1), count(0), count(0), self.backend.Bool(True),
        )  # fmt: skip
        found = dr.while_loop(state, more, body, label="along the rim")
        return found[1], length(found[5])

    def _at(self, y: Vec3) -> _RimPlace:
        real, vector = self.backend.Float, self.backend.Array3f
        sample = self.field.evaluate(y)
        gradient, size = vector(sample.gradient), largest_coordinate(y)
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
        return _RimPlace(
            is_on, near, solution(off, inwards), t, solution(-falls, -turns), n, inwards
        )


@dataclass(frozen=True)
class _RimPlace:
    """A place near the curve: whether it is on it, to `near`; the step back to it, to first order;
    its unit tangent and second derivative; the normal of the domain, and
    how far the place is inside it, less a margin."""

    is_on: Mask
    near: Real
    back: Vec3
    tangent: Vec3
    bend: Vec3
    normal: Vec3
    inwards: Real
