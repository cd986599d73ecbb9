"""Closed curves that bound a region S of a plane, and a proved range of their solid angle f near a
point. The curves are polygons and circles, called loops. f is known modulo 4 pi; on a ball that
meets no curve it has a continuous *lift*, a function without jumps that equals f modulo 4 pi.

Let disjoint simple loops of a single plane have winding numbers 0 and 1 only. An example is an
outline with holes, each of opposite orientation. They bound a region S of the plane. Above the
plane the solid angle f of the loops is minus that of S and lies in (-2 pi, 0); below, it lies in
(0, 2 pi). Let d be the distance from x to the curves and h the distance to the plane, h <= d. The
ball B(x, d) meets no curve. It meets the plane in a disk D of radius sqrt(d^2 - h^2), which is
inside of S or outside of it.

- If D is outside, the lift is f on both sides of the plane: it lies in (-2 pi, 2 pi).
- If D is inside, the lift is f on the side of the plane on which x is, and f minus or plus 4 pi on
  the other side. It lies in (-4 pi, 0) if x is above the plane, and in (0, 4 pi) if x is below.
- B(x, h) does not meet the plane: there the lift lies in (-2 pi, 0) or in (0, 2 pi).

f itself tells where D is. At x, D has the solid angle 2 pi (1 - h/d). If D is inside, |f| is at
least that, for S contains D. If D is outside, |f| is at most 2 pi minus that, for S is in the rest
of the plane. If h < d/2, |f| = pi separates the two cases. Otherwise f may prove one of the cases;
if it proves neither, B(x, h) is used, whose radius is at least d/2. In rounded arithmetic the error
of f is large near the curve: if h < d/2 and neither case is certain, the lift lies in (-4 pi, 4 pi)
in either case.

The range is 4 pi wide, whereas the range for a curve in convex position is 12 pi wide.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures import HarmonicBall
from harnack.geometry.convex_position import is_simple, segment_distance_lower_bound

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real
    from harnack.geometry.curves import Circle, Loops

__all__ = ["PlanarRegion", "planar_region"]

# All relative to the size of the curves.
_MAX_PLANE_DISTANCE = 1e-12  # the largest distance of a vertex from the plane
_MIN_LOOP_DISTANCE = 1e-6  # the least distance of two loops
_MAX_TILT = 1e-6  # the largest slope of a loop's own plane, relative to the size of the loop
_MAX_VERTICES = 2048  # the tests take quadratic time


@dataclass(frozen=True)
class PlanarRegion:
    """The plane of a region that closed curves bound. It is all that is needed to bound the curves'
    solid angle near a point.

    normal: (3,) the unit normal n of the plane. The curves' solid angle is negative on the side to
        which n points.
    offset: the plane is the set of points x with n.x = offset.
    """

    normal: FloatArray
    offset: float

    def lift_range(
        self, angle: Real, height: Real, distance: Real, slack: Real, error: Real = 0.0
    ) -> HarmonicBall:
        """Make a ball around each point, and a proved range, on this ball, of the lift: the curves'
        solid angle f, continued from the point without its jumps of 4 pi. The docstring of the
        module has the proof. In short: the ball whose radius is the distance d to the curves meets
        the plane in a disk D, which is inside or outside of the region that the curves bound. Which
        one it is, and so the range, follows from |f| and from the distance h to the plane. If |f|
        and h do not tell which one it is, a smaller ball that does not meet the plane is used; or,
        near the plane, the range (-4 pi, 4 pi), which holds in both cases.

        angle: f at the point, known modulo 4 pi.
        height: the signed distance of the point from the plane, positive on the normal's side. It
            is off by at most `slack`.
        distance: the distance of the point from the curves, or a lower bound of it.
        slack: a length that bounds the rounding of positions.
        error: a bound of the error of the angle, in addition to its rounding.
        """
        turn = 2 * math.pi
        # The principal value of f, in [-2 pi, 2 pi].
        f = angle - 2 * turn * dr.round(angle / (2 * turn))
        # Upper bounds of h and of h/d in the module's notation.
        height_bound = dr.abs(height) + slack
        ratio = height_bound / distance
        # Near the curve the rounding of positions moves f by up to about 2 slack/distance. The
        # tolerance is much larger than that, and than the rounding of f elsewhere.
        tolerance = 1e-3 + 16 * slack / distance + error
        # If D is outside, |f| is at most 2 pi h/d; if inside, at least 2 pi (1 - h/d). So an |f|
        # above the first number proves D inside, one below the second number proves D outside. If
        # h < d/2, pi is between both numbers and separates the cases with the most room.
        is_inside = dr.abs(f) > turn * fmax(ratio, 0.5) + tolerance
        is_outside = dr.abs(f) < turn * fmin(1 - ratio, 0.5) - tolerance
        free_height = fmax(dr.abs(height) - slack, 0)
        # If neither is certain, the smaller ball, which does not meet the plane, is used. The proof
        # gives it a radius of at least d/2; it is not used if rounding left it below 0.4 d.
        is_beside = ~(is_inside | is_outside) & (free_height >= 0.4 * distance)
        zero = type(f)(0)
        radius = dr.select(is_beside, free_height, distance)
        # D outside: (-2 pi, 2 pi). D inside: (-4 pi, 0) or (0, 4 pi), by the sign of f. Smaller
        # ball: (-2 pi, 0) or (0, 2 pi), by the side of the plane. Else (-4 pi, 4 pi).
        lower = dr.select(is_outside, -turn, -2 * turn)
        upper = dr.select(is_outside, turn, 2 * turn)
        lower = dr.select(is_inside, dr.select(f < 0, lower, zero), lower)
        upper = dr.select(is_inside, dr.select(f < 0, zero, upper), upper)
        lower = dr.select(is_beside, dr.select(height > 0, -turn, zero), lower)
        upper = dr.select(is_beside, dr.select(height > 0, zero, turn), upper)
        # f was reduced modulo 4 pi; the range must belong to the value in the sample.
        branch = angle - f
        return HarmonicBall(radius, lower + branch, upper + branch)


@dataclass(frozen=True)
class _PlanarLoop:
    """A simple closed curve in a plane: a polygon or a circle, in two coordinates of the plane,
    with lengths relative to the size of all curves together.

    points: (k, 2) the vertices of a polygon, or the center (1, 2) of a circle.
    radius: the radius of a circle, 0 for a polygon.
    sign: 1 if the loop runs counter-clockwise, else -1.
    """

    points: FloatArray
    radius: float
    sign: int

    def contains(self, point: FloatArray) -> bool:
        """Whether a point (2,) is inside the loop. The point must not lie on the loop."""
        if self.radius > 0:
            return bool(np.linalg.norm(point - self.points[0]) < self.radius)
        a, b = self.points - point, np.roll(self.points, -1, axis=0) - point
        # The numbers of edges that cross the ray from the point along the first axis upward and
        # downward differ if the point is inside.
        is_upward, is_downward = (a[:, 1] <= 0) & (b[:, 1] > 0), (a[:, 1] > 0) & (b[:, 1] <= 0)
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        return int((is_upward & (cross > 0)).sum()) != int((is_downward & (cross < 0)).sum())

    @property
    def some_point(self) -> FloatArray:
        """Any one point (2,) of the loop itself: a vertex, or a point of the circle."""
        return self.points[0] + (np.array([self.radius, 0.0]) if self.radius > 0 else 0.0)


def planar_region(loops: Loops, circles: Sequence[Circle]) -> PlanarRegion | None:
    """The plane of the region that closed curves bound together; None if they do not bound a region
    of a plane, or if there is too much to test.

    loops: the polygons, each an array (n, 3) of vertices.
    circles: the circles.

    The result is None in these cases: the loops do not lie in one plane up to 1e-12 of their size;
    one is not simple; they cross, or come nearer to each other than 1e-6 of their size; they have
    winding numbers other than 0 and 1 (or 0 and -1); there are more than 2048 vertices, or 256
    curves.
    """
    if sum(map(len, loops)) > _MAX_VERTICES or len(loops) + len(circles) > _MAX_VERTICES // 8:
        return None
    plane = _plane_of(loops, circles)
    if plane is None:
        return None
    normal, origin, size, axes = plane
    outlines: list[_PlanarLoop] = []
    for polygon in loops:
        centered = (polygon - origin) / size
        edges = np.roll(centered, -1, axis=0) - centered
        # No edge may have the length 0.
        if len(polygon) < 3 or not (edges * edges).sum(axis=1).all() or not is_simple(centered):
            return None
        points = centered @ axes.T
        # Twice the signed area, positive for a counter-clockwise polygon.
        next_points = np.roll(points, -1, axis=0)
        area = float((points[:, 0] * next_points[:, 1] - points[:, 1] * next_points[:, 0]).sum())
        outlines.append(_PlanarLoop(points, 0.0, 1 if area > 0 else -1))
    for loop in circles:
        center = ((np.array(loop.center) - origin) / size) @ axes.T
        sign = 1 if float(np.dot(loop.normal, normal)) > 0 else -1
        outlines.append(_PlanarLoop(center[None], loop.radius / size, sign))
    if not all(_are_separated(loop, other) for loop, other in itertools.combinations(outlines, 2)):
        return None
    # The winding number just inside each loop: the sum of the signs of all loops around it.
    winding_inside = [
        sum(other.sign for other in outlines if other is loop or other.contains(loop.some_point))
        for loop in outlines
    ]
    min_winding, max_winding = min(0, *winding_inside), max(0, *winding_inside)
    if max_winding - min_winding != 1:
        return None
    # With winding number -1 the loops run clockwise seen from the normal, so that it is reversed.
    orientation = 1.0 if max_winding == 1 else -1.0
    return PlanarRegion(orientation * normal, orientation * float(normal @ origin))


def _plane_of(
    loops: Loops, circles: Sequence[Circle]
) -> tuple[FloatArray, FloatArray, float, FloatArray] | None:
    """A plane that contains all loops and circles, up to 1e-12 of their size; None if there is
    none.

    Returns four values: the unit normal (3,) of the plane; a point (3,) of it, the origin of its
    coordinates; the size of the curves, the longest side of their box; and two perpendicular unit
    vectors (2, 3) in the plane, right-handed together with the normal.
    """
    points = np.concatenate([*loops, *(circle.polygon(4) for circle in circles)])
    lower, upper = points.min(axis=0), points.max(axis=0)
    size = float((upper - lower).max())
    origin: FloatArray = 0.5 * (lower + upper)
    if not 0.0 < size < np.inf:
        return None
    # The points relative to a point of the plane; which point that is, is decided below.
    x: FloatArray = (points - origin) / size
    if circles:
        normal = np.array(circles[0].normal)
        # The plane of the first circle is known exactly.
        origin = np.array(circles[0].center)
        x = (points - origin) / size
    else:
        # The direction in which the points vary least.
        normal = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][2]
        origin = points.mean(axis=0)
        x = (points - origin) / size
    if not np.abs(x @ normal).max() <= _MAX_PLANE_DISTANCE:
        return None
    # Small loops must not be tilted more than large ones.
    for loop in (*loops, *(circle.polygon(4) for circle in circles)):
        span = loop - loop[0]
        if not np.abs(span @ normal).max() <= _MAX_TILT * np.abs(span).max():
            return None
    axis = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    axis = axis / np.linalg.norm(axis)
    return normal, origin, size, np.stack([axis, np.cross(normal, axis)])


def _are_separated(first: _PlanarLoop, second: _PlanarLoop) -> bool:
    """Whether two loops of a plane, `first` and `second`, are nowhere nearer to each other than
    1e-6 of the size of all curves. One loop may lie inside the other."""
    if first.radius > 0 and second.radius > 0:
        distance = float(np.linalg.norm(first.points[0] - second.points[0]))
        # They are beside each other, or one is inside the other.
        outer_gap = distance - (first.radius + second.radius)
        return max(outer_gap, abs(first.radius - second.radius) - distance) >= _MIN_LOOP_DISTANCE
    # If one of them is a circle, it becomes the first.
    if second.radius > 0:
        first, second = second, first
    start, stop = second.points, np.roll(second.points, -1, axis=0)
    if first.radius > 0:
        edge, offset = stop - start, first.points[0] - start
        fraction = np.clip((offset * edge).sum(axis=1) / (edge * edge).sum(axis=1), 0, 1)
        nearest = float(np.linalg.norm(offset - fraction[:, None] * edge, axis=1).min())
        farthest = float(np.linalg.norm(offset, axis=1).max())
        return (
            nearest - first.radius >= _MIN_LOOP_DISTANCE
            or first.radius - farthest >= _MIN_LOOP_DISTANCE
        )
    edges_a, edges_b = (
        _embed_in_space(x.points, np.roll(x.points, -1, axis=0)) for x in (first, second)
    )
    for a, b in zip(*edges_a, strict=True):
        repeated = (np.broadcast_to(end, edges_b[0].shape) for end in (a, b))
        if not segment_distance_lower_bound(*repeated, *edges_b).min() >= _MIN_LOOP_DISTANCE:
            return False
    return True


def _embed_in_space(*ends: FloatArray) -> tuple[Any, ...]:
    """Points (k, 2) of the plane as points (k, 3) of space, with z = 0. Returns one array for each
    argument."""
    return tuple(np.column_stack([end, np.zeros(len(end))]) for end in ends)
