"""How the boundaries of what a picture shows move on the screen when f, the function of the field,
changes. A boundary is a curve on the screen at which the picture jumps. At a point x of the surface
that is seen on the boundary, all that is needed is the change of f at fixed points of space, and
gradients.

Let J be the derivative of the screen point by x, and n the unit normal of the boundary on the
screen, so that its normal velocity is v = n . J dx for a motion dx of x that keeps x on the
boundary. It does not matter which: motions along the boundary have n . J dx = 0.

- Outline: the ray touches the surface. It lies in the tangent plane, hence J g is a multiple of n,
  where g = grad f. Every motion that keeps f = level at x has g . dx = -df, where df is the change
  of f at fixed x minus that of the level; so dx = -df g/|g|^2 does. (That the point of contact also
  moves along the ray changes nothing: J maps this to 0.)
- Crease: two smooth parts of the surface meet, with gradients g1 and g2 on both sides. The point
  stays on both, g1 . dx = -df1 and g2 . dx = -df2, and n is normal to the image of g1 x g2.
- Edge: the outline of a solid along a crease. The second surface is that of the side that is
  turned away: where a ray that passes a little farther inside leaves the solid again.
- Cut: a clip volume with the unit normal g2 ends the surface. The same, with df2 = 0.
- End: a level set of an angle ends at the curve around which the angle is. At a distance r, f
  changes by grad f ~ 1/r when the curve moves, and by O(1) for all other reasons. So at two points
  at the distance r from the curve's point, in directions that differ by 90 degrees, g1 . dx = -df1
  and g2 . dx = -df2 up to a relative error of the order of r, for the motion dx of the curve; r is
  a millionth of the size of the surface.

With the rows g_k of a matrix G, the shortest such motion is dx = -G^T (G G^T)^-1 df; so v is a
weighted sum of the numbers df_k, with weights that are constants of the derivative."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend.arrays import to_numpy, upload_vectors
from harnack.inverse.film import at_least_two
from harnack.tracer.ray_crossings import crossings_to_numpy, trace_crossings
from harnack.tracer.rays import RayBatch
from harnack.tracer.surface import intersection_of

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.inverse.discontinuities import Discontinuities
    from harnack.inverse.film import Screen
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.traced_surface import TracedSurface

# Within so many times the accuracy of jumps on the screen, points are the same on both sides of a
# jump, or lie on a cut or an end. On a surface under the sine s to the ray, this is divided by s.
_SAME_POINT = 3.0
# At creases beside an outline, s is that of the flatter side, and at least this number.
_FLATTEST = 0.02
# A ray may touch the surface if the sine of the angle between them is below this number. On a
# surface with the radius of curvature R, the sine is (2 e/R)^(1/2) at the distance e from the
# outline: 0.03 for the 0.005 of a pixel that is left, if R is ten pixels.
# Below the second number, it does if Newton's method finds a contact beside the hit.
_TOUCHING, _BEND = 0.1, 0.6
# The jump is then found within this part of a pixel from the outline, or the accuracy of jumps.
_NEAR_OUTLINE = 0.005
# By so much the cosine of the turn of the normal up to the contact may be below what is expected.
_MORE_TURN = 0.1
# For edges, rays pass this part of a pixel inside of the outline; both crossings of such a ray are
# at most this part of the width of a pixel from the edge; or so many, if it leaves through a side
# that is nearly parallel to it.
_INSIDE, _LONGEST_EDGE, _LONGEST_ALONG = 0.005, 0.5, 4.0
PARALLEL = 4e-4
"""Two gradients are parallel if the squared sine of their angle is below this number: 1.1
degrees."""
# Points of contact are found by one step of Newton's method along the ray, with a difference of
# gradients over this part of the width of a pixel; steps of more widths than this are not made.
_DIFFERENCE, _LONGEST_STEP = 0.05, 30.0
# The distance from a curve at which f is sampled, as a part of the size of coordinates there.
_BESIDE_CURVE = 1e-6
_TINY = 1e-300


class BoundaryKind(IntEnum):
    """Why a picture jumps at a point."""

    OUTLINE = 0
    CREASE = 1
    EDGE = 2
    CUT = 3
    END = 4
    SHADOW = 5
    UNKNOWN = 6


@dataclass(frozen=True)
class BoundaryMotion:
    """The motion of n points of boundaries as weighted sums of changes of f.

    kind: (n,) a `BoundaryKind` for each point.
    normal: (n, 2) the unit normal on the screen, which points from before the jump to behind it; 0
        for unknown kinds.
    index: (k,) the point to which each term of the sums belongs.
    position: (k, 3) where the change of f is taken.
    weight: (k,) its weight.
    """

    kind: IntArray
    normal: FloatArray
    index: IntArray
    position: FloatArray
    weight: FloatArray

    @classmethod
    def unknown(cls, count: int) -> BoundaryMotion:
        """Points that move in no known way, such as those of surfaces of facets or patches."""
        kind = np.full(count, int(BoundaryKind.UNKNOWN))
        index, nothing = np.zeros(0, np.int64), np.zeros((0, 3))
        return cls(kind, np.zeros((count, 2)), index, nothing, np.zeros(0))


def boundary_motion(
    jumps: Discontinuities, film: Screen, surface: TracedSurface, tracer: SurfaceTracer
) -> BoundaryMotion:
    """Tell how the points at which a picture jumps move. Edges of shadows are of an unknown kind
    here; `shadow_motion` tells theirs.

    jumps: the points, with what is seen on both sides.
    film: where points of the surface are seen.
    surface, tracer: the surface, and its tracer in the double precision in which the points were
        found.
    """
    traits = surface.field.traits
    if traits.has_jumps or traits.has_patches or not len(jumps):
        return BoundaryMotion.unknown(len(jumps))
    points = _JumpPoints.of(jumps, film, surface, tracer)
    points.take_creases()
    points.take_ends()
    points.take_cuts()
    points.take_outlines()
    points.take_edges()
    # What is left touches the surface at corners, where edges end in outlines.
    points.take(points.sine < _TOUCHING, BoundaryKind.OUTLINE)
    return solve_conditions(jumps, film, points.kind, points.x, points.conditions)


@dataclass(frozen=True)
class _JumpPoints:
    """The points at which a picture jumps, while their kinds are told. A kind that was told stays.

    jumps, film, surface, tracer: as of `boundary_motion`.
    is_front: (n,) whether what is in front is seen before the jump.
    x, other: (n, 3) the points of the surface that are seen in front, and on the other side.
    gradient: (n, 3) grad f at x.
    directions: (n, 3) of the rays.
    sine: (n,) of the angles between rays and surface at x.
    width: (n,) of a pixel at x, a length.
    resolution: (n,) the accuracy of the jumps, in pixels.
    kind: (n,) a `BoundaryKind` for each point.
    conditions: those by which the points stay on the boundary.
    """

    jumps: Discontinuities
    film: Screen
    surface: TracedSurface
    tracer: SurfaceTracer
    is_front: BoolArray
    x: FloatArray
    other: FloatArray
    gradient: FloatArray
    directions: FloatArray
    sine: FloatArray
    width: FloatArray
    resolution: FloatArray
    kind: IntArray
    conditions: Conditions

    @classmethod
    def of(
        cls, jumps: Discontinuities, film: Screen, surface: TracedSurface, tracer: SurfaceTracer
    ) -> _JumpPoints:
        """The points before their kinds are told."""
        before, behind = jumps.before, jumps.behind
        is_front = before.t <= behind.t
        x = np.where(is_front[:, None], before.position, behind.position)
        other = np.where(is_front[:, None], behind.position, before.position)
        g, directions = gradients_at(tracer, x), film.directions(jumps.middle)
        resolution = np.abs(jumps.screen[:, 1] - jumps.screen[:, 0]).max(axis=1)
        kind = np.full(len(x), int(BoundaryKind.UNKNOWN))
        conditions = Conditions(x.copy(), g.copy(), x.copy(), np.zeros_like(x))
        return cls(
            jumps, film, surface, tracer, is_front, x, other, g, directions,
            _sines(g, directions), film.pixel_width(x), resolution, kind, conditions,
        )  # fmt: skip

    def left(self, which: BoolArray | bool = True) -> IntArray:
        """The indices of points of unknown kind, of those in a mask."""
        return np.flatnonzero((self.kind == int(BoundaryKind.UNKNOWN)) & which)

    def take(self, which: BoolArray, value: BoundaryKind) -> IntArray:
        """Give points of unknown kind this one; returns their indices."""
        index = self.left(which)
        self.kind[index] = int(value)
        return index

    def _reach(self, sine: FloatArray) -> FloatArray:
        """The distances (n,) within which points of a surface under these sines are the same."""
        return _SAME_POINT * self.resolution * self.width / sine

    def take_creases(self) -> None:
        """Tell creases: both rays hit, at the same point."""
        # The two sides of a crease are apart by what the flatter one is seen to recede.
        other_sine = _sines(gradients_at(self.tracer, self.other), self.directions)
        reach = self._reach(np.maximum(np.fmin(self.sine, other_sine), _FLATTEST))
        with np.errstate(invalid="ignore"):
            is_same = np.linalg.norm(self.x - self.other, axis=1) < reach
        is_same &= self.jumps.before.is_hit & self.jumps.behind.is_hit
        index = self.take(is_same, BoundaryKind.CREASE)
        other = self.other[index]
        self.conditions.set_second(index, other, gradients_at(self.tracer, other))

    def take_ends(self) -> None:
        """Tell ends: the point lies on a curve at which all level sets end."""
        curve = _closest_on_curves(self.tracer, self.x)
        if curve is None:
            return
        reach = self._reach(np.maximum(self.sine, _TOUCHING))
        is_near = np.linalg.norm(self.x - curve, axis=1) < reach
        index = self.take(is_near, BoundaryKind.END)
        first, second = _beside_curve(self.x[index], curve[index], self.gradient[index])
        self.conditions.set_first(index, first, gradients_at(self.tracer, first))
        self.conditions.set_second(index, second, gradients_at(self.tracer, second))
        self.x[index] = curve[index]

    def take_cuts(self) -> None:
        """Tell cuts: the point lies on the boundary of the domain or of a clip volume."""
        cut = intersection_of([self.surface.field.domain, self.surface.clip_volume])
        if cut is None:
            return
        depth = to_numpy(cut.signed_distance(upload_vectors(self.tracer.backend, self.x)))
        reach = self._reach(np.maximum(self.sine, _TOUCHING))
        if (index := self.take(np.abs(depth) < reach, BoundaryKind.CUT)).size:
            x = self.x[index]
            normal = cut.outward_normal(upload_vectors(self.tracer.backend, x))
            self.conditions.set_second(index, x, to_numpy(normal).reshape(-1, 3))

    def take_outlines(self) -> None:
        """Tell outlines: beside the point there is a contact of the ray with the level, on the same
        smooth side of the surface. Else the surface ends before, at an edge.

        Between the point and the contact, the normal of a smooth side turns by the angle between
        ray and surface, and not by much more.
        """
        index = self.left(self.sine < _BEND)
        if not index.size:
            return
        sine, d = self.sine[index], self.directions[index]
        contact = _contact(self.tracer, self.x[index], self.gradient[index], d, self.width[index])
        g, gap = gradients_at(self.tracer, contact), _gaps(self.tracer, contact)
        accuracy = np.maximum(_SAME_POINT * self.resolution[index], _NEAR_OUTLINE)
        is_contact = _distances_on_screen(self.film.at(index), contact, g, gap) < accuracy
        is_contact &= (_sines(g, d) < _TOUCHING / 2) | (sine < _TOUCHING)
        is_contact &= _cosines(self.gradient[index], g) > np.sqrt(1 - sine**2) - _MORE_TURN
        index, contact = index[is_contact], contact[is_contact]
        self.kind[index] = int(BoundaryKind.OUTLINE)
        self.conditions.set_first(index, contact, g[is_contact])
        self.x[index] = contact

    def take_edges(self) -> None:
        """Tell edges: a ray a little farther inside soon leaves the solid again."""
        index = self.left()
        if not index.size:
            return
        first, second, is_edge = _sides_of_edges(
            self.jumps, self.film, self.surface, index, self.is_front[index]
        )
        g = gradients_at(self.tracer, second)
        length = np.linalg.norm(second - first, axis=1) / self.width[index]
        is_along = _sines(g, self.directions[index]) < _TOUCHING
        is_edge &= (length < _LONGEST_EDGE) | is_along
        index, first, second = index[is_edge], first[is_edge], second[is_edge]
        self.kind[index] = int(BoundaryKind.EDGE)
        self.conditions.set_first(index, first, gradients_at(self.tracer, first))
        self.conditions.set_second(index, second, g[is_edge])


@dataclass(frozen=True)
class Conditions:
    """The conditions g1 . dx = -df1 and, for pairs, g2 . dx = -df2, by which n points stay on a
    boundary.

    position, gradient: (n, 3) where df1 is taken, and g1.
    second_position, second_gradient: (n, 3) the same of the second condition; g2 is 0 for none.
    """

    position: FloatArray
    gradient: FloatArray
    second_position: FloatArray
    second_gradient: FloatArray

    def set_first(self, index: IntArray, position: FloatArray, gradient: FloatArray) -> None:
        """Set the first condition of points with these indices."""
        self.position[index], self.gradient[index] = position, gradient

    def set_second(self, index: IntArray, position: FloatArray, gradient: FloatArray) -> None:
        """Set the second condition of points with these indices."""
        self.second_position[index], self.second_gradient[index] = position, gradient


def solve_conditions(
    jumps: Discontinuities, film: Screen, kind: IntArray, x: FloatArray, conditions: Conditions
) -> BoundaryMotion:
    """The motion of points x (n, 3) of these kinds under their conditions. Of the terms, those of
    the first conditions come first, for all known points; then those of the second conditions."""
    g1, g2 = conditions.gradient, conditions.second_gradient
    squares, mixed, others = (inner_products(a, b) for a, b in ((g1, g1), (g1, g2), (g2, g2)))
    determinant = squares * others - mixed**2
    is_single = kind == int(BoundaryKind.OUTLINE)
    is_pair = ~is_single & (determinant > PARALLEL * squares * others)
    jacobian = film.jacobian(x)
    along = np.einsum("nsi,ni->ns", jacobian, np.cross(g1, g2))
    turned = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal = np.where(is_pair[:, None], turned, np.einsum("nsi,ni->ns", jacobian, g1))
    length = np.linalg.norm(normal, axis=1)
    is_known = (is_pair | is_single) & (length > 0)
    towards = jumps.screen[:, 1] - jumps.screen[:, 0]
    side = np.where((normal * towards).sum(axis=1) < 0, -1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.where(is_known[:, None], normal * (side / length)[:, None], 0)
        pulled = np.einsum("ns,nsi->ni", normal, jacobian)
        first, second = inner_products(pulled, g1), inner_products(pulled, g2)
        # The row -pulled . G^T (G G^T)^-1; for a single condition, of g1 alone.
        paired = -(first * others - second * mixed) / determinant
        weight = np.where(is_pair, paired, -first / squares)
        second_weight = -(second * squares - first * mixed) / determinant
    kind = np.where(is_known, kind, int(BoundaryKind.UNKNOWN))
    # What cuts a surface does not change.
    is_cut = kind == int(BoundaryKind.CUT)
    known, pairs = np.flatnonzero(is_known), np.flatnonzero(is_known & is_pair & ~is_cut)
    return BoundaryMotion(
        kind,
        normal,
        np.concatenate([known, pairs]),
        np.concatenate([conditions.position[known], conditions.second_position[pairs]]),
        np.concatenate([weight[known], second_weight[pairs]]),
    )


def _sines(g: FloatArray, directions: FloatArray) -> FloatArray:
    """The sines (n,) of the angles between rays (n, 3) and level sets with gradients g (n, 3)."""
    with np.errstate(invalid="ignore"):  # normals of facets are no gradients
        return np.abs(inner_products(g, directions)) / np.linalg.norm(g, axis=1)


def _cosines(a: FloatArray, b: FloatArray) -> FloatArray:
    """The cosines (n,) of the angles between vectors (n, 3)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return inner_products(a, b) / np.sqrt(inner_products(a, a) * inner_products(b, b))


def inner_products(a: FloatArray, b: FloatArray) -> FloatArray:
    """The inner products (n,) of vectors (n, 3)."""
    return (a * b).sum(axis=1)


def _sides_of_edges(
    jumps: Discontinuities, film: Screen, surface: TracedSurface, index: IntArray,
    is_before: BoolArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:  # fmt: skip
    """Points on both sides of edges that are outlines: where rays a little farther inside enter the
    solid, (n, 3), and where they leave it, (n, 3); and whether they leave it so soon, (n,).

    index, is_before: (n,) the jumps, and whether the solid is seen before the jump or behind it.
    """
    ends = jumps.screen[index]
    inside = np.where(is_before[:, None], ends[:, 0], ends[:, 1])
    inwards = np.where(is_before, -1, 1)[:, None] * np.diff(ends, axis=1)[:, 0]
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    film, inside = film.at(index), inside + _INSIDE * inwards
    origins, directions = film.origins(inside), film.directions(inside)
    t = np.minimum(jumps.before.t[index], jumps.behind.t[index])
    reach = _LONGEST_ALONG * film.pixel_width(origins + t[:, None] * directions)
    near, far = np.maximum(t - reach, 0), t + reach
    rays = RayBatch.of(origins, directions, near, far, "double")
    crossings = crossings_to_numpy(
        trace_crossings(surface, rays, 2, differentiable=False), len(index), 2
    )
    points = np.where(np.isfinite(crossings.position), crossings.position, 0)
    return points[:, 0], points[:, 1], crossings.count == 2


def _contact(
    tracer: SurfaceTracer, x: FloatArray, g: FloatArray, d: FloatArray, width: FloatArray
) -> FloatArray:
    """The points (n, 3) at which rays are tangent to level sets, near points x (n, 3).

    g, d: (n, 3) grad f at x, and the directions of the rays. width: (n,) the width of a pixel.

    There grad f . d = 0; the derivative of this along the ray is taken as a difference.
    """
    h = _DIFFERENCE * width
    slope = inner_products(g, d)
    bend = (inner_products(gradients_at(tracer, x + h[:, None] * d), d) - slope) / h
    with np.errstate(invalid="ignore", divide="ignore"):
        step = -slope / bend
    step = np.where(np.abs(step) < _LONGEST_STEP * width, step, 0)
    return x + step[:, None] * d


def gradients_at(tracer: SurfaceTracer, points: FloatArray) -> FloatArray:
    """grad f at points (n, 3)."""
    if not len(points):
        return np.zeros((0, 3))
    sample = tracer.sample(upload_vectors(tracer.backend, at_least_two(points)))
    return to_numpy(sample.gradient).reshape(-1, 3)[: len(points)]


def _gaps(tracer: SurfaceTracer, points: FloatArray) -> FloatArray:
    """|f - level| at points (n, 3), with the nearest level."""
    value = tracer.sample(upload_vectors(tracer.backend, at_least_two(points))).value
    return np.abs(to_numpy(tracer.levels.offset_to_nearest(value)))[: len(points)]


def _distances_on_screen(film: Screen, x: FloatArray, g: FloatArray, gap: FloatArray) -> FloatArray:
    """The distances (n,) on the screen, to first order, from the outlines of level sets through
    points x (n, 3), at which rays touch them, to that of the level.

    g: (n, 3) grad f. gap: (n,) |f - level|.
    """
    across = np.linalg.norm(np.einsum("nsi,ni->ns", film.jacobian(x), g), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return across * gap / inner_products(g, g)


def _closest_on_curves(tracer: SurfaceTracer, x: FloatArray) -> FloatArray | None:
    """The points (n, 3), closest to points x (n, 3), of the curves at which all level sets end;
    None if there are no such curves."""
    boundary = tracer.field.boundary
    if boundary is None or boundary.closest_point is None:
        return None
    closest = boundary.closest_point(upload_vectors(tracer.backend, x))
    return to_numpy(closest).reshape(-1, 3)


def _beside_curve(x: FloatArray, curve: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two points (n, 3) beside each point of a curve, in directions that are normal to the curve
    and to each other.

    x, g: (n, 3) points near the points of the curve, and grad f there, which is nearly normal to
        the curve and to the direction away from it.
    """
    radius = _BESIDE_CURVE * np.maximum(np.abs(x).max(axis=1, keepdims=True), _TINY)
    away = x - curve
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), _TINY)
    around = g - (g * away).sum(axis=1, keepdims=True) * away
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), _TINY)
    return curve + radius * away, curve + radius * around
