"""Nearer points of a surface by rays from the point itself, in directions beside the best so far.

What other searches cannot follow, a ray sees: the crease in which two sheets meet, the rim at which
a smooth part of the surface ends in a sheet, the edge along which a volume cuts it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.basis import across
from harnack.backend.extrema import fmin
from harnack.tracer import Status

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.march import PreparedLevelSet

__all__ = ["close_in", "nearer_along"]

_MOST_RAYS = 600
# Rays of a turn that all have to fail before the next are closer; about 137.5 degrees apart, so
# that however many there are, they are spread evenly, and no turn repeats the one before.
_TURN, _GOLDEN = 8, 2.399963229728653
# Steps are tangents of angles.
_WIDEST, _CLOSER = 1.0, 0.25
# Rays that leave in directions all over the sphere before that.
_AROUND = 64


def nearer_along(surface: PreparedLevelSet, x: Vec3, way: Vec3, limit: Real) -> Vec3:
    """Where rays from x along `way` first meet the surface before `limit`; NaN where they do
    not, or the way is zero or no number."""
    real, vector = surface.backend.Float, surface.backend.Array3f
    length = dr.norm(way)
    usable = (length > 0) & dr.isfinite(length)
    d = dr.select(usable, way / length, vector(0, 0, 1))
    seen = surface.first_hit(x, d, real(0), real(limit), usable)
    hit = usable & (seen.status == int(Status.HIT))
    return dr.select(hit, dr.fma(vector(seen.t), d, x), vector(dr.nan))


def close_in(surface: PreparedLevelSet, x: Vec3, foot: Vec3) -> Vec3:
    """Points of the surface no farther from x than `foot`: a compass search over directions.

    Rays no longer than the distance so far leave x at an angle to the best direction; the first
    that meets the surface becomes the best. If all of a turn miss, the next turns are narrower,
    down to an angle of sqrt(epsilon): that is epsilon of the distance to a smooth part, and about
    sqrt(epsilon) of that to a sharp crease. Every point is a first hit, hence one of the surface.
    """
    backend = surface.backend
    real, vector, count = backend.Float, backend.Array3f, backend.UInt32
    r = vector(foot) - x
    t = dr.norm(r)
    finest, slack = backend.epsilon**0.5, 1 - 8 * backend.epsilon
    active = dr.isfinite(t) & (t > 0)
    d = dr.select(active, r / t, vector(0, 0, 1))

    def body(
        d: Vec3, t: Real, foot: Vec3, step: Real, angle: Real, failed: Any, n: Any, active: Mask
    ) -> tuple[Any, ...]:
        u, v = across(d)
        sine, cosine = dr.sincos(angle)
        aside = dr.normalize(d + vector(step * cosine) * u + vector(step * sine) * v)
        around = n < _AROUND
        aside = dr.select(around, _spiral(vector, real(n)), aside)
        seen = surface.first_hit(x, aside, real(0), t * slack, active)
        nearer = active & (seen.status == int(Status.HIT)) & (seen.t < t)
        d, t = dr.select(nearer, aside, d), dr.select(nearer, seen.t, t)
        foot = dr.select(nearer, dr.fma(vector(seen.t), aside, x), foot)
        failed = dr.select(nearer | around, count(0), failed + 1)
        spent = failed == _TURN
        step = dr.select(
            nearer & ~around, fmin(2 * step, _WIDEST), dr.select(spent, _CLOSER * step, step)
        )
        angle = dr.select(nearer, angle, angle + _GOLDEN)
        failed = dr.select(spent, count(0), failed)
        active &= (step > finest) & (n + 1 < _MOST_RAYS)
        return d, t, foot, step, angle, failed, n + 1, active

    def more(*state: Any) -> Mask:
        return state[-1]

    zero = count(0)
    start = (d, t, vector(foot), real(_WIDEST), real(0), zero, count(0), active)
    return dr.while_loop(start, more, body, label="closing in")[2]


def _spiral(vector: Any, n: Real) -> Vec3:
    """Evenly spread directions, one for each n < `_AROUND`."""
    z = 1 - (2 * n + 1) / _AROUND
    flat = dr.sqrt(1 - z * z)
    sine, cosine = dr.sincos(_GOLDEN * n)
    return vector(flat * cosine, flat * sine, z)
