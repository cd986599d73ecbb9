"""Closest points of surfaces of fields with jump surfaces, such as meshes: on the jump surfaces,
and by rays.

A *jump surface* consists of facets across which the field jumps, such as the triangles of a mesh. A
point of it is part of the level set where f passes a level from one side to the other. A short ray
through the point decides that, in the same arithmetic in which rays meet the surface anywhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm, orthonormal_basis
from harnack.fields.capabilities import NO_FACET, JumpCrossing, NearestFacet
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer

__all__ = ["JumpSurfaceSearch", "compass_search", "is_on_surface", "straddles_level"]

# Half the length of a ray through a point of a facet, in epsilons of coordinates.
_PROBE_HALF_LENGTH = 32.0
# A regular tetrahedron about the origin, turned so that none of its edges lies in a plane that
# triangles of meshes often lie in; and its six edges.
_CORNERS = (
    (-1.271, -0.030, 1.177),
    (0.662, -1.591, -0.176),
    (1.243, 1.088, 0.520),
    (-0.634, 0.533, -1.521),
)
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3))
# In these lengths: the distance from y at which f is evaluated, where rounding of y hardly counts.
_SIGN_TEST_SCALE = 64.0
# Before a facet f is evaluated at this part of the way to it.
_BEFORE = 0.98

NextJump: TypeAlias = "Callable[[tuple[Any, Any], Any, Any], NearestFacet]"


@dataclass(frozen=True)
class JumpSurfaceSearch:
    """Search for the closest point of a prepared surface that lies on a jump surface.

    scale: at least the coordinates that the field computes with, for bounds of rounding errors.
    most: the largest number of facets that are examined for each point.
    """

    surface: SurfaceTracer
    scale: float
    most: int

    def closest(self, x: Vec3, limit: Real) -> tuple[Vec3, Vec3]:
        """A point of the surface on a facet, nearer to x than `limit` (NaN where none is found),
        and the vector from x to the nearest facet, part of the surface or not, if that is nearer
        than `limit` (else infinite).

        Facets are examined in the order of their distance, each at its nearest point y to x. A
        short ray through y along the facet's normal hits the surface there, or the facet is not
        part of it at y. Where y lies on the facet's edge that ray may miss it, and the six edges of
        a small tetrahedron about y follow: a surface through y separates its corners, and a surface
        that ends in a curve through y leaves it through two faces, so that either crosses an edge.

        The first facet that is hit holds the closest point on facets, unless a nearer facet belongs
        to the surface elsewhere than at y: the result is a point of the surface in any case.
        """
        backend = self.surface.backend
        real, index, vector = backend.Float, backend.UInt32, backend.Array3f
        following = self._next_jump(x)
        most = dr.opaque(index, self.most)
        short = (
            _PROBE_HALF_LENGTH * backend.machine_epsilon * fmax(real(self.scale), dr.max(dr.abs(x)))
        )
        limit = real(limit)
        nothing = NearestFacet(
            real(-1), index(NO_FACET), vector(dr.inf), vector(0), backend.Bool(False)
        )

        def body(*state: Any) -> tuple[Any, ...]:
            last = NearestFacet(*state[:5])
            probe, foot, nearest, n, active = state[5:]
            fresh = active & (probe == 0)
            found = following((last.sort_key, last.facet), limit, fresh)
            near = _select(fresh, found, last)
            active &= near.facet != NO_FACET
            nearest = dr.select(active & fresh & (n == 0), near.offset, nearest)
            y = x + near.offset
            start, end = _probe(vector, probe, near.normal)
            met, sheet, at = self._probe_hits(y, short, start, end, active)
            at = dr.select((sheet == near.facet) & (probe == 0), y, at)
            foot = dr.select(met, at, foot)
            n = n + dr.select(fresh, index(1), 0)
            last_probe = near.is_inner | (probe == len(_EDGES))
            active &= ~met & ~(last_probe & (n >= most))
            probe = dr.select(last_probe, index(0), probe + 1)
            return *_parts(near), probe, foot, nearest, n, active

        def more(*state: Any) -> Mask:
            return state[-1]

        start = (
            *_parts(nothing), index(0), vector(dr.nan), vector(dr.inf), index(0),
            backend.Bool(True),
        )  # fmt: skip
        *_, foot, nearest, _, _ = dr.while_loop(start, more, body, label="sheets in turn")
        return foot, nearest

    def _probe_hits(
        self, y: Vec3, short: Real, start: Vec3, end: Vec3, active: Mask
    ) -> tuple[Mask, Any, Vec3]:
        """Whether the segment between two points about y, in units of `short`, meets the surface;
        the facet that it meets, and where."""
        backend = self.surface.backend
        real, vector = backend.Float, backend.Array3f
        o = dr.fma(vector(short), start, y)
        way, length = (end - start) / dr.norm(end - start), dr.norm(end - start)
        seen = self.surface.first_hit(o, way, real(0), short * length, active)
        met = active & (seen.status == int(RayStatus.HIT))
        # To first order any level is near where the gradient has no bound, as at the facet's edge.
        met &= straddles_level(self.surface, y, _SIGN_TEST_SCALE * short, met)
        return met, seen.facet, dr.fma(vector(seen.t), way, o)

    def _next_jump(self, x: Vec3) -> NextJump:
        """The facets of the field in turn; for a field that does not list them, the nearest facet
        only."""
        field, backend = self.surface.field, self.surface.backend
        real, index = backend.Float, backend.UInt32
        probe = field.nearest_facet(x, (real(-1), index(NO_FACET)), real(0), backend.Bool(False))
        if probe is None:
            only = _nearest_jump_by_differences(backend, field, x)

            def once(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestFacet:
                del active
                fresh = (after[0] < 0) & (only.sort_key < limit)
                order = dr.select(fresh, only.sort_key, dr.inf)
                sheet = dr.select(fresh, only.facet, index(NO_FACET))
                return NearestFacet(order, sheet, only.offset, only.normal, only.is_inner)

            return once

        def told(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestFacet:
            found = field.nearest_facet(x, after, limit, active)
            if found is None:
                raise RuntimeError("nearest_sheet tells sheets at some times and not at others")
            return found

        return told


def straddles_level(surface: SurfaceTracer, y: Vec3, radius: Real, active: Mask) -> Mask:
    """Whether f takes values on both sides of a level within 1.74 radii of y.

    It is evaluated at the corners of a tetrahedron and, on its edges, just before a jump surface.
    Two values on different sides prove that the surface crosses the path between them, where f
    passes the level continuously or by a jump. No gradient is needed: it is unbounded at the edge
    of a jump surface, where f takes exactly the values between those on both sides.
    """
    backend, field = surface.backend, surface.field.exact(surface.backend)
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    nowhere = vector(0)

    def body(k: Any, low: Real, high: Real, active: Mask) -> tuple[Any, ...]:
        start, end = _probe(vector, k + 1, nowhere)
        o = dr.fma(vector(radius), start, y)
        length = dr.norm(end - start)
        way, reach = (end - start) / length, radius * length
        behind = JumpCrossing(real(0), index(NO_FACET), real(0), nowhere)
        t = real(field.next_jump(o, way, behind, reach, active).t)
        inside = dr.select(t < reach, t, 0.5 * reach)
        for share in (real(0), _BEFORE * inside):
            value = real(field.evaluate(dr.fma(vector(share), way, o)).value)
            low, high = fmin(low, value), fmax(high, value)
        return k + 1, low, high, active & (k + 1 < len(_EDGES))

    def more(*state: Any) -> Mask:
        return state[-1]

    start = index(0), real(dr.inf), real(-dr.inf), backend.Bool(active)
    _, low, high, _ = dr.while_loop(start, more, body, label="sides of a level")
    return (low < high) & (surface.levels.gaps(low).above < high - low)


def _parts(near: NearestFacet) -> tuple[Any, ...]:
    return near.sort_key, near.facet, near.offset, near.normal, near.is_inner


def _select(mask: Mask, one: NearestFacet, other: NearestFacet) -> NearestFacet:
    pairs = zip(_parts(one), _parts(other), strict=True)
    return NearestFacet(*(dr.select(mask, a, b) for a, b in pairs))


def _probe(vector: Any, number: Any, normal: Vec3) -> tuple[Vec3, Vec3]:
    """Both ends of a probe about the origin: along the normal, then the tetrahedron's edges."""
    start, end = -normal, normal
    for k, (i, j) in enumerate(_EDGES):
        start = dr.select(number == k + 1, vector(*_CORNERS[i]), start)
        end = dr.select(number == k + 1, vector(*_CORNERS[j]), end)
    return start, end


def _nearest_jump_by_differences(backend: Backend, field: Field, x: Vec3) -> NearestFacet:
    """The nearest sheet to x, from its distance d alone: along the way on which d falls.

    Central differences over h = r d are off by r^2, and by epsilon s/(r d) as rounding moves d by
    epsilon s, s the size of coordinates: with r = (epsilon s/d)^(1/3) both are small down to
    distances of a few roundings. There any direction serves: y = x is on the sheet to rounding.
    """
    real, vector = backend.Float, backend.Array3f
    d = real(field.distance_to_jumps(x))
    size = fmax(dr.max(dr.abs(x)), d)
    h = d * fmin(dr.cbrt(backend.machine_epsilon * size / d), 0.5)
    rate: list[Real] = []
    for axis in range(3):
        move = vector(*(h if k == axis else 0 for k in range(3)))
        ahead, back = (field.distance_to_jumps(q) for q in (x + move, x - move))
        rate.append(back - ahead)
    fall = vector(*rate)
    gradient_norm = dr.norm(fall)
    has_direction = (gradient_norm > 0.2 * h) & (d > 64 * backend.machine_epsilon * size)
    way = dr.select(has_direction, fall / gradient_norm, vector(1 / math.sqrt(3)))
    offset = dr.select(has_direction, d * way, 0)
    return NearestFacet(d, backend.UInt32(0), offset, way, backend.Bool(False))


# Nearer points by rays.

_MOST_RAYS = 600
# Rays of a turn, which all have to fail before the next turn is narrower: those to where planes
# meet, then those near the best direction, about 137.5 degrees apart, so that however many there
# are they are spread evenly, and no turn repeats the one before.
_PLANE_TRIALS, _TILTED, _GOLDEN = 4, 8, 2.399963229728653
# Steps are tangents of angles.
_INITIAL_STEP, _STEP_REDUCTION = 1.0, 0.25
# Rays that leave in directions all over the sphere before that.
_SPHERE_RAYS = 128
# Planes whose normals are closer than this, as the sine of an angle, count as the same.
_APART = 1e-3
# In epsilons, of coordinates: so far from a hit f is evaluated on both sides of the level.
_HIT_TEST_RADIUS = 1024.0


@dataclass(frozen=True)
class _HitPlane:
    """Points x + r with r.normal = offset, |normal| = 1; normal = 0 where there is no plane."""

    normal: Vec3
    offset: Real

    @classmethod
    def where(cls, mask: Mask, one: _HitPlane, other: _HitPlane) -> _HitPlane:
        """One plane in some lanes, another elsewhere."""
        normal = dr.select(mask, one.normal, other.normal)
        return cls(normal, dr.select(mask, one.offset, other.offset))

    def is_apart(self, other: _HitPlane) -> Mask:
        """Whether both are planes, and not nearly parallel."""
        return dr.squared_norm(dr.cross(self.normal, other.normal)) > _APART * _APART

    def nearest_on_line(self, other: _HitPlane) -> Vec3:
        """The shortest way to where both are; not finite if they are parallel."""
        vector = cast("Any", type(self.normal))
        cosine = dr.dot(self.normal, other.normal)
        ours = vector(self.offset - cosine * other.offset) * self.normal
        return (ours + vector(other.offset - cosine * self.offset) * other.normal) / (
            1 - cosine * cosine
        )

    def intersection_point(self, second: _HitPlane, third: _HitPlane) -> Vec3:
        """The way to where all three are; not finite if they are parallel to a line."""
        vector = cast("Any", type(self.normal))
        a, b, c = self.normal, second.normal, third.normal
        ways = (dr.cross(b, c), dr.cross(c, a), dr.cross(a, b))
        offsets = (self.offset, second.offset, third.offset)
        total = sum((vector(o) * w for o, w in zip(offsets, ways, strict=True)), vector(0))
        return total / dr.dot(a, ways[0])


@dataclass(frozen=True)
class _HitPlanes:
    """Three planes that touch the surface: where the best point is, then the two last seen that are
    parallel neither to it nor to one another."""

    first: _HitPlane
    second: _HitPlane
    third: _HitPlane

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> _HitPlanes:
        """From `parts`."""
        return cls(*(_HitPlane(parts[k], parts[k + 1]) for k in (0, 2, 4)))

    def parts(self) -> tuple[Any, ...]:
        """Normals and offsets, as loops want them."""
        return tuple(
            part
            for plane in (self.first, self.second, self.third)
            for part in (plane.normal, plane.offset)
        )

    def updated(self, plane: _HitPlane, seen: Mask, best: Mask) -> _HitPlanes:
        """With one more, where `seen`; that of the best point, where `best`."""
        first, second, third = self.first, self.second, self.third
        parts = _HitPlane.where
        stays = first.is_apart(plane)
        ours = _HitPlanes(
            plane,
            parts(stays, first, second),
            parts(stays & second.is_apart(plane), second, third),
        )
        is_new = seen & ~best & stays
        theirs = _HitPlanes(
            first,
            parts(is_new, plane, second),
            parts(is_new & second.is_apart(plane), second, third),
        )
        return _HitPlanes(
            parts(best, ours.first, theirs.first),
            parts(best, ours.second, theirs.second),
            parts(best, ours.third, theirs.third),
        )

    def meeting(self, number: Any) -> Vec3:
        """The shortest way to where planes meet: all three (0), the first and the second (1), the
        first and the third (2), or to the first alone (3); not finite where they do not."""
        first, second, third = self.first, self.second, self.third
        vector = cast("Any", type(first.normal))
        pairs = dr.select(number == 1, first.nearest_on_line(second), first.nearest_on_line(third))
        alone = vector(first.offset) * first.normal
        ends = dr.select(number == 0, first.intersection_point(second, third), alone)
        return dr.select((number == 1) | (number == 2), pairs, ends)


def compass_search(surface: SurfaceTracer, x: Vec3, foot: Vec3) -> Vec3:
    """Compass search over ray directions from x, starting at the surface point `foot`. Returns
    points of the surface that are no farther from x.

    It reaches closest points on creases of two jump surfaces, on curves where a smooth part ends at
    a jump surface, and on edges cut by a volume, which no other search here can follow.

    Rays leave x at an angle to the best direction; a nearer first hit becomes the best. If no
    direction improves it, the angle is reduced, down to sqrt(epsilon). To be fast along creases,
    each hit adds its tangent plane, and a round starts with rays to the nearest points of the
    planes' intersections. Every accepted point is a first hit about which f straddles the level
    (`straddles_level`), hence on the surface.
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
        planes, around = _HitPlanes.of(parts), n < _SPHERE_RAYS
        meets = ~around & (failed < _PLANE_TRIALS)
        way = dr.select(
            meets, dr.normalize(planes.meeting(failed)), _tilt_direction(d, step, angle)
        )
        way = dr.select(around, _spiral_direction(vector, real(n)), way)
        usable = active & dr.isfinite(dr.squared_norm(way))
        # Beyond t as well, for planes.
        end = dr.select(around, t, t * (1 + fmin(step, 0.5)))
        seen = surface.first_hit(x, dr.select(usable, way, d), real(0), end, usable)
        hit = usable & (seen.status == int(RayStatus.HIT))
        nearer = hit & (seen.t < t * (1 - 8 * backend.machine_epsilon))
        there = dr.fma(vector(seen.t), way, x)
        nearer &= is_on_surface(surface, there, seen, nearer)
        normal = dr.normalize(seen.gradient)
        touches = hit & dr.isfinite(dr.squared_norm(normal))
        touching = _HitPlane(normal, dr.dot(normal, way) * seen.t)
        planes = planes.updated(touching, touches, touches & nearer)
        d, t = dr.select(nearer, way, d), dr.select(nearer, seen.t, t)
        foot = dr.select(nearer, there, foot)
        failed = dr.select(nearer | around, count(0), failed + 1)
        spent = failed == _PLANE_TRIALS + _TILTED
        narrower = dr.select(spent, _STEP_REDUCTION * step, step)
        step = dr.select(nearer & ~around & ~meets, fmin(2 * step, _INITIAL_STEP), narrower)
        angle = dr.select(nearer | meets | around, angle, angle + _GOLDEN)
        failed = dr.select(spent, count(0), failed)
        active &= (step > backend.machine_epsilon**0.5) & (n + 1 < _MOST_RAYS)
        return d, t, foot, step, angle, failed, n + 1, active, *planes.parts()

    def more(*state: Any) -> Mask:
        return state[7]

    start = (
        d, t, vector(foot), real(_INITIAL_STEP), real(0), count(0), count(0), active,
        *3 * (vector(0), real(0)),
    )  # fmt: skip
    return dr.while_loop(start, more, body, label="closing in")[2]


def is_on_surface(surface: SurfaceTracer, y: Vec3, hit: MarchResult, active: Mask) -> Mask:
    """Whether f takes the level about hits y. Beside the edge of a jump surface the gradient is
    unbounded, so that to first order rays are within the tolerance of any level, and a ray that
    begins there may hit the facet at once, whatever f is."""
    radius = _HIT_TEST_RADIUS * surface.backend.machine_epsilon * fmax(max_norm(y), hit.t)
    return straddles_level(surface, y, radius, active)


def _tilt_direction(d: Vec3, step: Real, angle: Real) -> Vec3:
    """The direction at a distance of `step` from d, seen along d at that angle."""
    vector = cast("Any", type(d))
    u, v = orthonormal_basis(d)
    sine, cosine = dr.sincos(angle)
    return dr.normalize(d + vector(step * cosine) * u + vector(step * sine) * v)


def _spiral_direction(vector: Any, n: Real) -> Vec3:
    """Evenly spread directions, one for each n < `_SPHERE_RAYS`."""
    z = 1 - (2 * n + 1) / _SPHERE_RAYS
    flat = dr.sqrt(1 - z * z)
    sine, cosine = dr.sincos(_GOLDEN * n)
    return vector(flat * cosine, flat * sine, z)
