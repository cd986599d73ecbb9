"""Nearer points of a surface by rays from the point itself, in directions near the best so far.

What other searches cannot follow, a ray sees: the crease in which two sheets meet, the rim at which
a smooth part of the surface ends in a sheet, the edge along which a volume cuts it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.basis import across
from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_coordinate
from harnack.distance.meshes.on_sheets import takes_level
from harnack.fields.sheets import NO_SHEET
from harnack.tracer import Status

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.prepared import MarchResult, PreparedLevelSet

__all__ = ["close_in"]

_MOST_RAYS = 600
# Rays of a turn, which all have to fail before the next turn is narrower: those to where planes
# meet, then those near the best direction, about 137.5 degrees apart, so that however many there
# are they are spread evenly, and no turn repeats the one before.
_MEETINGS, _TILTED, _GOLDEN = 4, 8, 2.399963229728653
# Steps are tangents of angles.
_WIDEST, _CLOSER = 1.0, 0.25
# Rays that leave in directions all over the sphere before that.
_AROUND = 128
# Planes whose normals are closer than this, as the sine of an angle, count as the same.
_APART = 1e-3
# In epsilons, of coordinates: so far about a hit f is looked at on both sides of the level.
_ABOUT = 1024.0


@dataclass(frozen=True)
class _TouchingPlane:
    """Points x + r with r.normal = offset, |normal| = 1; normal = 0 where there is no plane."""

    normal: Vec3
    offset: Real

    @classmethod
    def where(cls, mask: Mask, one: _TouchingPlane, other: _TouchingPlane) -> _TouchingPlane:
        """One plane in some lanes, another elsewhere."""
        normal = dr.select(mask, one.normal, other.normal)
        return cls(normal, dr.select(mask, one.offset, other.offset))

    def is_apart(self, other: _TouchingPlane) -> Mask:
        """Whether both are planes, and not nearly parallel."""
        return dr.squared_norm(dr.cross(self.normal, other.normal)) > _APART * _APART

    def meeting(self, other: _TouchingPlane) -> Vec3:
        """The shortest way to where both are; not finite if they are parallel."""
        vector = cast("Any", type(self.normal))
        cosine = dr.dot(self.normal, other.normal)
        ours = vector(self.offset - cosine * other.offset) * self.normal
        return (ours + vector(other.offset - cosine * self.offset) * other.normal) / (
            1 - cosine * cosine
        )

    def corner(self, second: _TouchingPlane, third: _TouchingPlane) -> Vec3:
        """The way to where all three are; not finite if they are parallel to a line."""
        vector = cast("Any", type(self.normal))
        a, b, c = self.normal, second.normal, third.normal
        ways = (dr.cross(b, c), dr.cross(c, a), dr.cross(a, b))
        offsets = (self.offset, second.offset, third.offset)
        total = sum((vector(o) * w for o, w in zip(offsets, ways, strict=True)), vector(0))
        return total / dr.dot(a, ways[0])


@dataclass(frozen=True)
class _TouchingPlanes:
    """Three planes that touch the surface: where the best point is, then the two last seen that are
    parallel neither to it nor to one another."""

    first: _TouchingPlane
    second: _TouchingPlane
    third: _TouchingPlane

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> _TouchingPlanes:
        """From `parts`."""
        return cls(*(_TouchingPlane(parts[k], parts[k + 1]) for k in (0, 2, 4)))

    def parts(self) -> tuple[Any, ...]:
        """Normals and offsets, as loops want them."""
        return tuple(
            part
            for plane in (self.first, self.second, self.third)
            for part in (plane.normal, plane.offset)
        )

    def with_(self, plane: _TouchingPlane, seen: Mask, best: Mask) -> _TouchingPlanes:
        """With one more, where `seen`; that of the best point, where `best`."""
        first, second, third = self.first, self.second, self.third
        parts = _TouchingPlane.where
        stays = first.is_apart(plane)
        ours = _TouchingPlanes(
            plane,
            parts(stays, first, second),
            parts(stays & second.is_apart(plane), second, third),
        )
        is_new = seen & ~best & stays
        theirs = _TouchingPlanes(
            first,
            parts(is_new, plane, second),
            parts(is_new & second.is_apart(plane), second, third),
        )
        return _TouchingPlanes(
            parts(best, ours.first, theirs.first),
            parts(best, ours.second, theirs.second),
            parts(best, ours.third, theirs.third),
        )

    def meeting(self, number: Any) -> Vec3:
        """The shortest way to where planes meet: all three (0), the first and the second (1), the
        first and the third (2), or to the first alone (3); not finite where they do not."""
        first, second, third = self.first, self.second, self.third
        vector = cast("Any", type(first.normal))
        pairs = dr.select(number == 1, first.meeting(second), first.meeting(third))
        alone = vector(first.offset) * first.normal
        ends = dr.select(number == 0, first.corner(second, third), alone)
        return dr.select((number == 1) | (number == 2), pairs, ends)


def close_in(surface: PreparedLevelSet, x: Vec3, foot: Vec3) -> Vec3:
    """Points of the surface no farther from x than `foot`: a compass search over directions.

    Rays leave x at an angle to the best direction; the first that meets the surface nearer than
    the best becomes the best. If all of a turn fail, the next turns are narrower, down to an angle
    of sqrt(epsilon). A compass alone is slow along creases; so each hit adds the plane that touches
    the surface there, and a turn begins with rays to the nearest points where these planes meet.
    Every point taken is a first hit that f takes the level about (`takes_level`), hence one of the
    surface, whatever led there.
    """
    backend = surface.backend
    real, vector, count = backend.Float, backend.Array3f, backend.UInt32
    r = vector(foot) - x
    t = dr.norm(r)
    active = dr.isfinite(t) & (t > 0)
    d = dr.select(active, r / t, vector(0, 0, 1))

    def body(
        d: Vec3, t: Real, foot: Vec3, step: Real, angle: Real, failed: Any, n: Any, active: Mask,
        *parts: Any,
    ) -> tuple[Any, ...]:  # fmt: skip
        planes, around = _TouchingPlanes.of(parts), n < _AROUND
        meets = ~around & (failed < _MEETINGS)
        way = dr.select(meets, dr.normalize(planes.meeting(failed)), _tilted(d, step, angle))
        way = dr.select(around, _spiral(vector, real(n)), way)
        usable = active & dr.isfinite(dr.squared_norm(way))
        # Beyond t as well, for planes.
        end = dr.select(around, t, t * (1 + fmin(step, 0.5)))
        seen = surface.first_hit(x, dr.select(usable, way, d), real(0), end, usable)
        hit = usable & (seen.status == int(Status.HIT))
        nearer = hit & (seen.t < t * (1 - 8 * backend.epsilon))
        there = dr.fma(vector(seen.t), way, x)
        nearer &= _is_on_surface(surface, there, seen, nearer)
        normal = dr.normalize(seen.gradient)
        touches = hit & dr.isfinite(dr.squared_norm(normal))
        touching = _TouchingPlane(normal, dr.dot(normal, way) * seen.t)
        planes = planes.with_(touching, touches, touches & nearer)
        d, t = dr.select(nearer, way, d), dr.select(nearer, seen.t, t)
        foot = dr.select(nearer, there, foot)
        failed = dr.select(nearer | around, count(0), failed + 1)
        spent = failed == _MEETINGS + _TILTED
        narrower = dr.select(spent, _CLOSER * step, step)
        step = dr.select(nearer & ~around & ~meets, fmin(2 * step, _WIDEST), narrower)
        angle = dr.select(nearer | meets | around, angle, angle + _GOLDEN)
        failed = dr.select(spent, count(0), failed)
        active &= (step > backend.epsilon**0.5) & (n + 1 < _MOST_RAYS)
        return d, t, foot, step, angle, failed, n + 1, active, *planes.parts()

    def more(*state: Any) -> Mask:
        return state[7]

    start = (
        d, t, vector(foot), real(_WIDEST), real(0), count(0), count(0), active,
        *3 * (vector(0), real(0)),
    )  # fmt: skip
    return dr.while_loop(start, more, body, label="closing in")[2]


def _is_on_surface(surface: PreparedLevelSet, y: Vec3, hit: MarchResult, active: Mask) -> Mask:
    """Whether hits y are on a sheet, or f takes the level about them: beside the rim of a sheet,
    where its gradient has no bound, rays are within the tolerance of any level to first order."""
    is_smooth = active & (hit.sheet == NO_SHEET)
    radius = _ABOUT * surface.backend.epsilon * fmax(largest_coordinate(y), hit.t)
    return ~is_smooth | takes_level(surface, y, radius, is_smooth)


def _tilted(d: Vec3, step: Real, angle: Real) -> Vec3:
    """The direction at a distance of `step` from d, seen along d at that angle."""
    vector = cast("Any", type(d))
    u, v = across(d)
    sine, cosine = dr.sincos(angle)
    return dr.normalize(d + vector(step * cosine) * u + vector(step * sine) * v)


def _spiral(vector: Any, n: Real) -> Vec3:
    """Evenly spread directions, one for each n < `_AROUND`."""
    z = 1 - (2 * n + 1) / _AROUND
    flat = dr.sqrt(1 - z * z)
    sine, cosine = dr.sincos(_GOLDEN * n)
    return vector(flat * cosine, flat * sine, z)
