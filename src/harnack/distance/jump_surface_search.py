"""Closest points of surfaces whose function f jumps, such as the winding number of a mesh. f jumps
at facets, such as the triangles of the mesh. The surface consists of the points at which f takes a
given value, the level, and of the parts of facets where the level lies between the values of f on
the two sides. Points on facets are found by a list of facets in the order of their distance, other
points by rays.

A *jump surface* consists of facets across which f jumps, such as the triangles of a mesh. A point
of it belongs to the surface if a level lies between the values of f on both sides of it. A short
ray through the point decides that, by the same arithmetic that traces rays elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm, orthonormal_basis
from harnack.fields.capabilities import (
    NO_FACET,
    JumpCrossing,
    NearestFacet,
    exactly_sampled,
)
from harnack.name_suggestions import with_article
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.capabilities import Jumps
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
# The distance from a hit y at which f is evaluated, in half lengths of the ray: there the rounding
# of y hardly matters.
_SIGN_TEST_SCALE = 64.0
# On a path that meets a facet, f is evaluated at this fraction of the distance to the facet.
_FRACTION_TO_FACET = 0.98

NextJump: TypeAlias = "Callable[[tuple[Any, Any], Any, Any], NearestFacet]"


@dataclass(frozen=True)
class JumpSurfaceSearch:
    """Searches for the point of a surface that is closest to a query x and lies on a facet: a flat
    piece, such as a triangle of a mesh, across which the function f of the surface jumps. A facet
    belongs to the surface where a level lies between the values of f on its two sides. A probe is a
    short ray that tests this.

    surface: the tracer of the surface.
    scale: an upper bound of the coordinates that the field computes with, for bounds of rounding
        errors.
    max_facets: the largest number of facets that are examined for each point.
    """

    surface: SurfaceTracer
    scale: float
    max_facets: int

    def closest(self, x: Vec3, limit: Real) -> tuple[Vec3, Vec3]:
        """Search for the point closest to x on that part of the surface that lies on facets.

        limit: only facets nearer to x than this are examined.

        Returns two results: a point of the surface on a facet, NaN if none is found; and the vector
        from x to the nearest facet, infinite if that is farther than `limit`. The nearest facet
        need not be part of the surface.

        Facets are examined in the order of their distance, each at its point y nearest to x. If the
        facet is part of the surface at y, a short ray through y along the facet's normal hits the
        surface. If y lies on the facet's edge, that ray may miss the surface; then the six edges of
        a small tetrahedron about y are tried as well. A surface through y separates its corners,
        and a surface that ends in a curve through y leaves the tetrahedron through two of its
        faces, so that either crosses one of these edges.

        The first facet that is hit contains the closest point on facets, unless a nearer facet
        belongs to the surface at another point than y. The result is a point of the surface in any
        case.
        """
        backend = self.surface.backend
        real, index, vector = backend.Float, backend.UInt32, backend.Array3f
        next_facet = self._next_jump(x)
        max_count = dr.opaque(index, self.max_facets)
        length = (
            _PROBE_HALF_LENGTH * backend.machine_epsilon * fmax(real(self.scale), dr.max(dr.abs(x)))
        )
        limit = real(limit)
        # The place before the first facet: a sort key below all others.
        no_facet = NearestFacet(
            real(-1), index(NO_FACET), vector(dr.inf), vector(0), backend.Bool(False)
        )

        def body(*state: Any) -> tuple[Any, ...]:
            """Trace one probe, a short ray through the nearest point of a facet, and choose the
            next probe or facet. Returns the new state. `next_facet` finds the facets in order,
            `length` is half the length of the ray along the normal, and `max_count` the largest
            number of facets.

            state: the attributes of the facet; the index of the probe (0 for the ray along the
                normal, 1 to 6 for the edges of the tetrahedron); the surface point found; the
                vector to the nearest facet; the number of facets examined; and whether to continue.
            """
            last = NearestFacet(*state[:5])
            probe, best, nearest, count, active = state[5:]
            # The next facet is fetched when the probes of the last one are done.
            is_first = active & (probe == 0)
            candidate = next_facet((last.sort_key, last.facet), limit, is_first)
            facet = _select(is_first, candidate, last)
            active &= facet.facet != NO_FACET
            nearest = dr.select(active & is_first & (count == 0), facet.offset, nearest)
            y = x + facet.offset
            start, end = _probe(vector, probe, facet.normal)
            is_hit, hit_facet, hit_point = self._probe_hits(y, length, start, end, active)
            # A hit of this facet along its normal is y itself, without the rounding of the ray.
            hit_point = dr.select((hit_facet == facet.facet) & (probe == 0), y, hit_point)
            best = dr.select(is_hit, hit_point, best)
            count = count + dr.select(is_first, index(1), 0)
            # Inside a facet the ray along the normal decides alone.
            last_probe = facet.is_inner | (probe == len(_EDGES))
            active &= ~is_hit & ~(last_probe & (count >= max_count))
            probe = dr.select(last_probe, index(0), probe + 1)
            return *_parts(facet), probe, best, nearest, count, active

        def is_active(*state: Any) -> Mask:
            return state[-1]

        start = (
            *_parts(no_facet), index(0), vector(dr.nan), vector(dr.inf), index(0),
            backend.Bool(True),
        )  # fmt: skip
        *_, best, nearest, _, _ = dr.while_loop(start, is_active, body, label="sheets in turn")
        return best, nearest

    def _probe_hits(
        self, y: Vec3, scale: Real, start: Vec3, end: Vec3, active: Mask
    ) -> tuple[Mask, Any, Vec3]:
        """Trace the segment from y + scale * start to y + scale * end.

        scale: a length; `start` and `end` are vectors without a unit.
        active: mask of lanes that are traced.

        Returns the mask of lanes on which the segment hits the surface, the index of the facet that
        it hits, and the hit point. A hit counts only if f takes values on both sides of a level
        around y.
        """
        backend = self.surface.backend
        real, vector = backend.Float, backend.Array3f
        o = dr.fma(vector(scale), start, y)
        direction, length = (end - start) / dr.norm(end - start), dr.norm(end - start)
        hit = self.surface.first_hit(o, direction, real(0), scale * length, active)
        is_hit = active & (hit.status == int(RayStatus.HIT))
        # To first order any level is near where the gradient has no bound, as at the facet's edge.
        is_hit &= straddles_level(self.surface, y, _SIGN_TEST_SCALE * scale, is_hit)
        return is_hit, hit.facet, dr.fma(vector(hit.t), direction, o)

    def _next_jump(self, x: Vec3) -> NextJump:
        """Make a function that finds the facets across which f jumps, one after the other in the
        order of their distance from x. If the field cannot list its facets, the function finds only
        the nearest one.

        The function takes three arguments: the sort key (a number that grows with the distance from
        x) and the index of the facet before, as a pair; the largest distance from x; and the active
        lanes. It returns the next facet (`NearestFacet`), whose index is NO_FACET if there is none.
        """
        jumps, backend = _jumps_of(self.surface), self.surface.backend
        real, index = backend.Float, backend.UInt32
        # Asked for no lane (the limit 0 and the mask False), only to learn whether the field can
        # list its facets. The sort key -1 is below all others.
        first_facet = jumps.nearest_facet(
            x, (real(-1), index(NO_FACET)), real(0), backend.Bool(False)
        )
        if first_facet is None:
            facet = _nearest_jump_by_differences(backend, jumps, x)

            def single_facet(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestFacet:
                """Return the nearest facet if it is nearer to x than `limit` and the first number
                of `after`, the sort key of the facet before, is below 0, that is, if there was none
                before. Otherwise return the placeholder for no facet. `active` is not used."""
                del active
                is_first = (after[0] < 0) & (facet.sort_key < limit)
                sort_key = dr.select(is_first, facet.sort_key, dr.inf)
                facet_id = dr.select(is_first, facet.facet, index(NO_FACET))
                return NearestFacet(sort_key, facet_id, facet.offset, facet.normal, facet.is_inner)

            return single_facet

        def listed_facet(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestFacet:
            """Return the next facet in the order of the distance from x: the one after the facet
            `after`, which is given by its sort key (a number that grows with the distance) and its
            index. The result is the placeholder for no facet if the next one is farther from x than
            `limit`, and on lanes that are not active."""
            nearest = jumps.nearest_facet(x, after, limit, active)
            if nearest is None:
                raise RuntimeError("nearest_facet gives facets at some times and not at others")
            return nearest

        return listed_facet


def straddles_level(surface: SurfaceTracer, y: Vec3, radius: Real, active: Mask) -> Mask:
    """Return the mask of lanes on which f takes values on both sides of a level within 1.74 times
    `radius` of y (the distance of the farthest samples).

    active: mask of lanes that are tested.

    f is evaluated at the corners of a tetrahedron around y and, on each of its edges, just before
    the first facet at which f jumps. Two values on different sides of the level prove that the
    surface crosses the path between them: f passes the level there, continuously or by a jump. No
    gradient is used, because it is unbounded near the edge of a jump surface.
    """
    backend, jumps = surface.backend, _jumps_of(surface)
    evaluator = exactly_sampled(surface.evaluator, backend)
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    zero = vector(0)

    def body(k: Any, lower: Real, upper: Real, active: Mask) -> tuple[Any, ...]:
        """Extend the range [lower, upper] of values of f by two values on edge k of the
        tetrahedron: at its start, and before the first facet on it (or the middle if there is
        none)."""
        start, end = _probe(vector, k + 1, zero)
        o = dr.fma(vector(radius), start, y)
        edge_norm = dr.norm(end - start)
        direction, edge_length = (end - start) / edge_norm, radius * edge_norm
        # The place from which facets are looked for: no facet, no jump, no normal.
        start_crossing = JumpCrossing(real(0), index(NO_FACET), real(0), zero)
        # Up to the first facet on the edge; the two values are taken on the same side of it.
        t = real(jumps.next_crossing(o, direction, start_crossing, edge_length, active).t)
        before_jump = dr.select(t < edge_length, t, 0.5 * edge_length)
        for distance in (real(0), _FRACTION_TO_FACET * before_jump):
            value = real(evaluator.evaluate(dr.fma(vector(distance), direction, o)).value)
            lower, upper = fmin(lower, value), fmax(upper, value)
        return k + 1, lower, upper, active & (k + 1 < len(_EDGES))

    def is_active(*state: Any) -> Mask:
        return state[-1]

    start = index(0), real(dr.inf), real(-dr.inf), backend.Bool(active)
    _, lower, upper, _ = dr.while_loop(start, is_active, body, label="sides of a level")
    # The next level above the smallest value is below the largest value.
    return (lower < upper) & (surface.levels.gaps(lower).above < upper - lower)


def _jumps_of(surface: SurfaceTracer) -> Jumps:
    """Return the facets at which the surface's function f jumps.

    Raises:
        TypeError: f does not jump.
    """
    if surface.evaluator.jumps is None:
        raise TypeError(f"{with_article(type(surface.field).__name__)} does not jump")
    return surface.evaluator.jumps


def _parts(facet: NearestFacet) -> tuple[Any, ...]:
    """Return the attributes of a facet in the order of the constructor, as the state of a loop."""
    return facet.sort_key, facet.facet, facet.offset, facet.normal, facet.is_inner


def _select(mask: Mask, first: NearestFacet, second: NearestFacet) -> NearestFacet:
    """Return the facet `first` in lanes of the mask, `second` elsewhere."""
    pairs = zip(_parts(first), _parts(second), strict=True)
    return NearestFacet(*(dr.select(mask, a, b) for a, b in pairs))


def _probe(vector: Any, index: Any, normal: Vec3) -> tuple[Vec3, Vec3]:
    """Return the start and the end of a probe, a segment near the origin along which a ray is
    traced.

    vector: the type of 3-vectors.
    index: 0 for the segment along `normal`; k + 1 for edge k of a tetrahedron about the origin.
    """
    start, end = -normal, normal
    for k, (i, j) in enumerate(_EDGES):
        start = dr.select(index == k + 1, vector(*_CORNERS[i]), start)
        end = dr.select(index == k + 1, vector(*_CORNERS[j]), end)
    return start, end


def _nearest_jump_by_differences(backend: Backend, jumps: Jumps, x: Vec3) -> NearestFacet:
    """Return the facet nearest to x, for jumps that know only the distance d(x) from its nearest
    facet. The facet lies at the distance d in the direction in which d falls fastest.

    That direction is computed by central differences of d over the length h = r d, with a ratio r.
    Their relative truncation error is about r^2. Rounding moves d by epsilon s, where s is the size
    of the coordinates, which adds epsilon s/(r d). With r = (epsilon s/d)^(1/3) both errors are
    small down to distances of a few rounding errors. At smaller distances any direction serves, as
    x itself is on the facet to rounding.
    """
    real, vector = backend.Float, backend.Array3f
    # d, h, size and epsilon are those of the docstring (there s is the size).
    d = real(jumps.distance(x))
    size = fmax(dr.max(dr.abs(x)), d)
    h = d * fmin(dr.cbrt(backend.machine_epsilon * size / d), 0.5)
    differences: list[Real] = []
    for axis in range(3):
        shift = vector(*(h if k == axis else 0 for k in range(3)))
        ahead, behind = (jumps.distance(q) for q in (x + shift, x - shift))
        differences.append(behind - ahead)
    descent = vector(*differences)
    gradient_norm = dr.norm(descent)
    # The differences have the length 2 h if one facet is nearest. At a point with several nearest
    # facets they may cancel: then x itself counts as the nearest point, with any normal.
    has_direction = (gradient_norm > 0.2 * h) & (d > 64 * backend.machine_epsilon * size)
    direction = dr.select(has_direction, descent / gradient_norm, vector(1 / math.sqrt(3)))
    offset = dr.select(has_direction, d * direction, 0)
    # Which facet it is is not known: the index is 0, and the point may lie on an edge (False).
    return NearestFacet(d, backend.UInt32(0), offset, direction, backend.Bool(False))


# Compass search: nearer points by rays.

_MAX_RAYS = 600
# A round consists of rays to the intersections of planes, then of rays tilted against the best
# direction. If all of them fail, the next round tilts rays less. Tilted rays turn by the golden
# angle (in radians) from each to the next, so that any number of them is spread evenly and no round
# repeats the one before.
_PLANE_RAYS, _TILTED_RAYS, _GOLDEN_ANGLE = 4, 8, 2.399963229728653
# The first step, as the tangent of the angle to the best direction, and its factor after a round in
# which all rays failed.
_INITIAL_STEP, _STEP_REDUCTION = 1.0, 0.25
# Number of rays in directions all over the sphere, before the rounds.
_SPHERE_RAYS = 128
# Planes whose normals are closer than this, as the sine of an angle, count as the same.
_MIN_PLANE_SINE = 1e-3
# The distance from a hit within which f is evaluated on both sides of the level, in machine
# epsilons of the coordinates.
_HIT_TEST_RADIUS = 1024.0


@dataclass(frozen=True)
class _HitPlane:
    """The plane tangent to the surface at the hit of a ray from the query x. It consists of the
    points x + r with r . normal = offset, where |normal| = 1. A normal of 0 stands for no plane."""

    normal: Vec3
    offset: Real

    @classmethod
    def where(cls, mask: Mask, first: _HitPlane, second: _HitPlane) -> _HitPlane:
        """Return the plane `first` in lanes of the mask, `second` elsewhere."""
        normal = dr.select(mask, first.normal, second.normal)
        return cls(normal, dr.select(mask, first.offset, second.offset))

    def is_apart(self, other: _HitPlane) -> Mask:
        """Return the mask of lanes in which neither this plane nor the other one is the placeholder
        for no plane, and the two are not nearly parallel."""
        return (
            dr.squared_norm(dr.cross(self.normal, other.normal)) > _MIN_PLANE_SINE * _MIN_PLANE_SINE
        )

    def nearest_on_line(self, other: _HitPlane) -> Vec3:
        """Return the shortest vector from x to the line in which this plane and the other one
        intersect; not finite if they are parallel. It is the combination of the two normals whose
        inner products with the normals are the two offsets."""
        vector = cast("Any", type(self.normal))
        cosine = dr.dot(self.normal, other.normal)
        along_normal = vector(self.offset - cosine * other.offset) * self.normal
        return (along_normal + vector(other.offset - cosine * self.offset) * other.normal) / (
            1 - cosine * cosine
        )

    def intersection_point(self, second: _HitPlane, third: _HitPlane) -> Vec3:
        """Return the vector from x to the point in which this plane and the planes `second` and
        `third` intersect, by Cramer's rule; not finite if the three normals are linearly
        dependent."""
        vector = cast("Any", type(self.normal))
        a, b, c = self.normal, second.normal, third.normal
        normals = (dr.cross(b, c), dr.cross(c, a), dr.cross(a, b))
        offsets = (self.offset, second.offset, third.offset)
        weighted_sum = sum(
            (vector(offset) * normal for offset, normal in zip(offsets, normals, strict=True)),
            vector(0),
        )
        return weighted_sum / dr.dot(a, normals[0])


@dataclass(frozen=True)
class _HitPlanes:
    """Three planes tangent to the surface at hits of rays from the query x, from which a compass
    search guesses where creases are. The first is the plane at the best point so far. The other two
    are the planes of the last two hits that are parallel neither to the first plane nor to each
    other."""

    first: _HitPlane
    second: _HitPlane
    third: _HitPlane

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> _HitPlanes:
        """Make the planes from a tuple of normals and offsets, as `parts` returns it."""
        return cls(*(_HitPlane(parts[k], parts[k + 1]) for k in (0, 2, 4)))

    def parts(self) -> tuple[Any, ...]:
        """Return the three normals and offsets, alternating, as the state of a loop."""
        return tuple(
            number
            for plane in (self.first, self.second, self.third)
            for number in (plane.normal, plane.offset)
        )

    def updated(self, plane: _HitPlane, is_hit: Mask, is_best: Mask) -> _HitPlanes:
        """Return the planes after another hit.

        plane: the hit's tangent plane.
        is_hit: the lanes on which there was a hit; the others keep their planes.
        is_best: the lanes in which it belongs to the new best point and becomes the first plane.

        If the new plane becomes the first one, the old first plane moves to the second place,
        unless the two are nearly parallel. Otherwise the new plane becomes the second one, unless
        it is nearly parallel to the first. The third place gets the old second plane, unless that
        is nearly parallel to the new plane.
        """
        first, second, third = self.first, self.second, self.third
        select = _HitPlane.where
        is_apart = first.is_apart(plane)
        # If the plane becomes the first one.
        if_best = _HitPlanes(
            plane,
            select(is_apart, first, second),
            select(is_apart & second.is_apart(plane), second, third),
        )
        # If it does not.
        is_new = is_hit & ~is_best & is_apart
        otherwise = _HitPlanes(
            first,
            select(is_new, plane, second),
            select(is_new & second.is_apart(plane), second, third),
        )
        return _HitPlanes(
            select(is_best, if_best.first, otherwise.first),
            select(is_best, if_best.second, otherwise.second),
            select(is_best, if_best.third, otherwise.third),
        )

    def shortest_to_intersection(self, number: Any) -> Vec3:
        """Return the shortest vector from x to an intersection of planes: of all three (number 0),
        of the first and the second (1), of the first and the third (2); or to the first plane alone
        (3). It is not finite where there is no intersection."""
        first, second, third = self.first, self.second, self.third
        vector = cast("Any", type(first.normal))
        to_line = dr.select(
            number == 1, first.nearest_on_line(second), first.nearest_on_line(third)
        )
        to_first = vector(first.offset) * first.normal
        to_point = dr.select(number == 0, first.intersection_point(second, third), to_first)
        return dr.select((number == 1) | (number == 2), to_line, to_point)


def compass_search(surface: SurfaceTracer, x: Vec3, foot: Vec3) -> Vec3:
    """Search for the surface point closest to x by a compass search over directions of rays from x.
    It starts at the surface point `foot`, and returns a point of the surface that is no farther
    from x.

    It finds closest points that descents along a smooth surface cannot reach: on creases of two
    jump surfaces, on curves where a smooth part ends at a jump surface, and on edges that a volume
    cuts.

    First, rays in directions all over the sphere are traced. Then, in each round, rays leave x in
    directions tilted by some angle against the direction of the best point. A first hit that is
    nearer becomes the best point. If no ray of a round improves it, the angle is reduced, down to
    sqrt(epsilon). To be fast along creases, the tangent planes of hits are stored, and a round
    begins with rays to the points nearest to x in the intersections of these planes. A hit is
    accepted only if f takes values on both sides of the level around it (`straddles_level`), so
    that it is a point of the surface.
    """
    backend = surface.backend
    real, vector, count = backend.Float, backend.Array3f, backend.UInt32
    offset = vector(foot) - x
    t = dr.norm(offset)
    active = dr.isfinite(t) & (t > 0)
    d = dr.select(active, offset / t, vector(0, 0, 1))

    def body(
        d: Vec3, t: Real, foot: Vec3, step: Real, angle: Real, failed: Any, ray: Any, active: Mask,
        *values: Any,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Trace one ray, and choose the next direction. Returns the new state: values in the order
        of the parameters.

        d, t, foot: direction, distance and position of the best point.
        step: tangent of the angle by which rays are tilted against d.
        angle: the angle about d, in radians, that gives the direction of the tilt.
        failed: the number of rays of this round so far; none of them found a nearer point.
        ray: the number of rays traced so far.
        active: whether the search goes on.
        values: the planes of hits, `_HitPlanes.parts`.
        """
        hit_planes, is_global = _HitPlanes.of(values), ray < _SPHERE_RAYS
        # The first rays of a round, with `failed` from 0 to 3, go to the intersections of planes
        # with these numbers; the others are tilted.
        to_planes = ~is_global & (failed < _PLANE_RAYS)
        direction = dr.select(
            to_planes,
            dr.normalize(hit_planes.shortest_to_intersection(failed)),
            _tilt_direction(d, step, angle),
        )
        direction = dr.select(is_global, _spiral_direction(vector, real(ray)), direction)
        is_valid = active & dr.isfinite(dr.squared_norm(direction))
        # Rays of a round go farther than t, as a farther hit gives a plane, too.
        max_t = dr.select(is_global, t, t * (1 + fmin(step, 0.5)))
        hit = surface.first_hit(x, dr.select(is_valid, direction, d), real(0), max_t, is_valid)
        is_hit = is_valid & (hit.status == int(RayStatus.HIT))
        is_nearer = is_hit & (hit.t < t * (1 - 8 * backend.machine_epsilon))
        point = dr.fma(vector(hit.t), direction, x)
        is_nearer &= is_on_surface(surface, point, hit, is_nearer)
        normal = dr.normalize(hit.gradient)
        has_plane = is_hit & dr.isfinite(dr.squared_norm(normal))
        # The tangent plane at the hit; its distance from x is that of the hit, projected on the
        # normal.
        plane = _HitPlane(normal, dr.dot(normal, direction) * hit.t)
        hit_planes = hit_planes.updated(plane, has_plane, has_plane & is_nearer)
        d, t = dr.select(is_nearer, direction, d), dr.select(is_nearer, hit.t, t)
        foot = dr.select(is_nearer, point, foot)
        failed = dr.select(is_nearer | is_global, count(0), failed + 1)
        # A round in which all rays failed is over: the next one tilts rays less. After success with
        # a tilted ray, rays are tilted more.
        is_spent = failed == _PLANE_RAYS + _TILTED_RAYS
        new_step = dr.select(is_spent, _STEP_REDUCTION * step, step)
        step = dr.select(
            is_nearer & ~is_global & ~to_planes, fmin(2 * step, _INITIAL_STEP), new_step
        )
        angle = dr.select(is_nearer | to_planes | is_global, angle, angle + _GOLDEN_ANGLE)
        failed = dr.select(is_spent, count(0), failed)
        active &= (step > backend.machine_epsilon**0.5) & (ray + 1 < _MAX_RAYS)
        return d, t, foot, step, angle, failed, ray + 1, active, *hit_planes.parts()

    def is_active(*state: Any) -> Mask:
        return state[7]

    # At the start no plane is known: three times the normal 0.
    start = (
        d, t, vector(foot), real(_INITIAL_STEP), real(0), count(0), count(0), active,
        *3 * (vector(0), real(0)),
    )  # fmt: skip
    return dr.while_loop(start, is_active, body, label="closing in")[2]


def is_on_surface(surface: SurfaceTracer, y: Vec3, hit: MarchResult, active: Mask) -> Mask:
    """Return the mask of lanes on which the hit y of a ray is a point of the surface: f takes
    values on both sides of a level around it.

    hit: the result of tracing the ray.
    active: the lanes to be tested.

    A hit alone is no proof near the edge of a jump surface, for two reasons. The gradient is
    unbounded there, so that every point is within the tolerance of any level to first order. And a
    ray that begins there may hit the facet at once, whatever value f has.
    """
    radius = _HIT_TEST_RADIUS * surface.backend.machine_epsilon * fmax(max_norm(y), hit.t)
    return straddles_level(surface, y, radius, active)


def _tilt_direction(d: Vec3, step: Real, angle: Real) -> Vec3:
    """Return the unit vector along d + step w. d is a unit vector, and w the unit vector at right
    angles to d that is given by the angle `angle` (in radians) about d. So `step` is the tangent of
    the angle between d and the result."""
    vector = cast("Any", type(d))
    u, v = orthonormal_basis(d)
    sine, cosine = dr.sincos(angle)
    return dr.normalize(d + vector(step * cosine) * u + vector(step * sine) * v)


def _spiral_direction(vector: Any, n: Real) -> Vec3:
    """Return the unit vector with number n of `_SPHERE_RAYS` unit vectors that are spread evenly
    over the sphere, along a spiral. vector: the type of 3-vectors."""
    z = 1 - (2 * n + 1) / _SPHERE_RAYS
    radius = dr.sqrt(1 - z * z)
    sine, cosine = dr.sincos(_GOLDEN_ANGLE * n)
    return vector(radius * cosine, radius * sine, z)
