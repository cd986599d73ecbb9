"""Further quantities of the edges of a curve: derivatives, closest points, changes, promises.

- `differentiable_angle`: the solid angle as an expression that Dr.Jit differentiates.
- `closest_on_segments`: the closest point of the curve, at which the level sets end.
- `continuous_change`: the change of the solid angle along a straight segment.
- `remainder_promises`, `gradient_change_bound`, `lift_ball`: promises (proved bounds) of the solid
  angle near a point.

By default a curve promises a bound of second derivatives. It comes from the integral of
|dp|/|p - x|^3, which is also the weight in Biot and Savart's law. Other step rules need the range
of the solid angle on a ball instead; with these, polygons and knots take 1.4 to 2 times as many
evaluations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, to_vector3
from harnack.backend.arrays import gather_vectors
from harnack.backend.elementary import clamp
from harnack.backend.record_table import RecordTable
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.fields.solid_angles.edges import inner_product, single_edges, spinor
from harnack.fields.source_sums import SUM_MARGIN

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.solid_angles.edges import LoopEdges

__all__ = [
    "closest_on_segments",
    "continuous_change",
    "gradient_change_bound",
    "lift_ball",
    "remainder_promises",
    "segment_records",
]


def differentiable_angle(backend: Backend, loops: tuple[Any, ...], x: Vec3) -> Real:
    """Omega(x) in steradians, modulo 4 pi, of closed loops. The result is one wide expression that
    Dr.Jit can differentiate in both directions.

    loops: the vertices of each loop, as an (n, 3) array or as a Dr.Jit vector.

    The loop of `sum_over_edges` computes the value fastest, but reverse mode cannot differentiate a
    recorded loop. Here every pair of a point and an edge is a lane, and a block sum adds up the
    edges of each point. So the memory is proportional to the number of points times the number of
    vertices. The formula is that of `sum_over_edges`, with one angle for each edge instead of a
    product. An angle may jump by 4 pi; its derivative does not.
    """
    total = dr.zeros(backend.Float, dr.width(x))
    for loop in loops:
        vertices = loop if dr.is_array_v(type(loop)) else to_vector3(backend, np.asarray(loop))
        total = total + _loop_angle(backend, vertices, backend.Array3f(x))
    return total


def _loop_angle(backend: Backend, vertices: Vec3, x: Vec3) -> Real:
    """The solid angle (n,), in steradians and modulo 4 pi, of one closed loop at points x (3, n),
    as an expression that Dr.Jit can differentiate. vertices: (3, m) of the loop."""
    point_count, edge_count = dr.width(x), dr.width(vertices)
    lane = dr.arange(backend.UInt32, point_count * edge_count)
    point, edge = lane // edge_count, lane % edge_count
    next_vertex = dr.select(edge + 1 == edge_count, 0, edge + 1)
    lane_x = gather_vectors(backend, x, point)
    a = gather_vectors(backend, vertices, edge) - lane_x
    b = gather_vectors(backend, vertices, next_vertex) - lane_x
    # The phase of a vertex's spinor is arbitrary; it enters its two edges with opposite signs.
    re, im = inner_product(spinor(a)[2], spinor(b)[2])
    return dr.block_sum(2 * dr.atan2(im, re), edge_count)


def segment_records(backend: Backend, start: FloatArray, end: FloatArray) -> RecordTable:
    """Records of the k >= 1 segments from start (k, 3) to end (k, 3). The coordinates should be of
    order one. Ends that are equal in the backend's precision make a record of a point."""
    start, end = (q.astype(backend.dtype).astype(np.float64) for q in (start, end))
    return RecordTable.upload(backend, single_edges(start, end))


def closest_on_segments(segments: RecordTable, x: Vec3) -> Vec3:
    """The point (3, n) on any of the segments that is closest to each point x (3, n). segments:
    the result of `segment_records`."""
    vector = segments.backend.Array3f
    x = vector(x)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The least squared distance and the closest point `state`, updated by the segment in a
        record."""
        nearest, closest = state
        p, q = vector(*row[:3]), vector(*row[4:7])
        fraction = clamp(dr.dot(x - p, q - p) * row[7], 0, 1)
        point = dr.fma(vector(fraction), q - p, p)
        square = dr.squared_norm(x - point)
        is_closer = square < nearest
        return dr.select(is_closer, square, nearest), dr.select(is_closer, point, closest)

    start = (segments.backend.Float(dr.inf), vector(0))
    return segments.for_each(add, start, "nearest edge")[1]


def continuous_change(edges: LoopEdges, p: Vec3, q: Vec3) -> Real:
    """The change (n,) of the curve's solid angle, followed continuously along the segments from
    points p to points q. p and q must differ.

    The change is the integral of Biot and Savart's field along the segment. For an edge from a to b
    of the curve, it is minus the solid angle at the origin of the parallelogram (a - p) + s (b - a)
    - t (q - p) with s and t from 0 to 1. This is less than 2 pi in size, because the plane of the
    parallelogram misses the origin unless the segment meets the edge. The parallelogram is split
    into two triangles, whose solid angles are twice an arctangent each (van Oosterom and Strackee
    1983), so there is no branch to choose.
    """
    real = edges.backend.Float

    def add(a: Vec3, b: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge from a to b to the change of the solid angle, which is the state of the
        loop.
        inverse: not used here."""
        del inverse
        ap, bp, bq, aq = a - p, b - p, b - q, a - q
        return (state[0] - _angle(ap, bp, bq) - _angle(ap, bq, aq),)

    return edges.for_each(add, (real(0),), "swept angle")[0]


def _angle(a: Vec3, b: Vec3, c: Vec3) -> Real:
    """The signed solid angle at the origin of the triangle with the corners a, b, c."""
    la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
    volume = dr.dot(a, dr.cross(b, c))
    dot_terms = dr.fma(dr.dot(a, b), lc, dr.fma(dr.dot(b, c), la, dr.dot(c, a) * lb))
    # A triangle has no solid angle at points of its own plane, whatever rounding does.
    return dr.select(volume == 0, 0, 2 * dr.atan2(volume, dr.fma(la * lb, lc, dot_terms)))


# Radii of the promises as fractions of the distance to the curve, by experiment.
_RADIUS_FRACTIONS = (0.3, 0.6, 0.85)


def remainder_promises(
    inverse_cubes: Real, inverse_fourths: Real, distance: Real
) -> tuple[TaylorRemainder, ...]:
    """Promises for a curve's solid angle at points x: bounds of what it differs, on balls around x,
    from its linear Taylor polynomial at x.

    inverse_cubes, inverse_fourths: I3 and I4, the integrals of |dp|/|D|^3 and |dp|/|D|^4 over the
        curve, with D = p - x.
    distance: the distance d from x to the curve, or a lower bound of it.

    Returns one promise for each radius q d, for a few fixed fractions q.

    Proof. Along a unit direction v the derivative of the solid angle is the integral of v.(D x
    dp)/|D|^3 over the curve (Biot and Savart). Its second derivative is the integral of 3
    (v.D)(v.(D x dp))/|D|^5, as D changes by -v. D and D x dp are perpendicular, so the product of
    their components along v is at most half of the product of their lengths: the second derivative
    is at most 3/2 times the integral of |dp|/|D|^3. At x + s v, |D| is less by s at most. So by
    Taylor the remainder after the linear term is, for t < d, at most

        3/2 integral of |dp| integral over [0, t] of (t-s)/(|D|-s)^3 ds
            = 3/4 t^2 integral of |dp|/(|D|^3 (1 - t/|D|)).

    For u = t/|D| <= q, 1/(1 - u) <= 1 + u/(1 - q). On the ball of radius q d that is
    `TaylorRemainder` with the constant 3/2 (I3 + q d I4/(1 - q)). The bound holds for any piece of
    a curve, and the bounds of pieces add up.
    """
    scale = 1.5 * (1 + SUM_MARGIN)
    return tuple(
        TaylorRemainder(
            scale * dr.fma(q / (1 - q) * distance, inverse_fourths, inverse_cubes), q * distance
        )
        for q in _RADIUS_FRACTIONS
    )


def gradient_change_bound(
    inverse_cubes: Real, inverse_fourths: Real, distance: Real, radius: Real
) -> Real:
    """A bound of |grad f(y) - grad f(x)| for |y - x| <= `radius`, with f the solid angle of a
    curve. It is infinite unless `radius` is less than `distance`.

    inverse_cubes, inverse_fourths: I3 and I4, the integrals of |dp|/|D|^3 and |dp|/|D|^4 over the
        curve, with D the vector from x to the point p of the curve.
    distance: d, the distance from x to the curve, or a lower bound of it.

    Proof. At x, the second derivative of the solid angle along every line is at most 3/2 times the
    integral of |dp|/|D|^3 (`remainder_promises`), and so is the norm of the Hessian. At a point at
    the distance s from x, |D| is less by at most s. So for a unit vector v, and with t = `radius`,
    the gradient changes from x to x + t v by at most

        3/2 integral of |dp| integral over [0, t] of ds/(|D|-s)^3
            = 3/4 t integral of |dp|/|D|^3 (2 - u)/(1 - u)^2,    u = t/|D|.

    For 0 <= u <= q < 1 the fraction (2 - u)/(1 - u)^2 is convex in u, and so at most its chord
    2 + u (3 - 2q)/(1 - q)^2. With q = t/d the change is at most 3/2 t I3 + 3/4 t^2 I4
    (3 - 2q)/(1 - q)^2.
    """
    q = radius / distance
    growth = (3 - 2 * q) / dr.square(1 - q)
    change = radius * (1.5 * inverse_cubes + 0.75 * radius * growth * inverse_fourths)
    return dr.select(radius < distance, (1 + SUM_MARGIN) * change, dr.inf)


def lift_ball(
    value: Real,
    gradient: Vec3,
    inverse_squares: Real,
    bends: tuple[TaylorRemainder, ...],
    slope_error: Real = 0.0,
) -> HarmonicBall:
    """A ball around x, and a range in which the solid angle is proved to lie on it. The solid angle
    is lifted, that is, continued from x without its jumps of 4 pi. The ball is that of the second
    of the promises `bends`. The promises themselves prove longer steps than this range.

    value, gradient: the solid angle and its gradient at x.
    inverse_squares: the integral of |dp|/|D|^2, to which the rounding of the gradient is
        proportional.
    bends: the bounds of second derivatives on balls around x, from `remainder_promises`.
    slope_error: a bound of the errors of the gradient other than its rounding.
    """
    promise = bends[1]
    gradient_bound = dr.norm(gradient) + SUM_MARGIN * inverse_squares + slope_error
    max_change = (
        (1 + SUM_MARGIN)
        * promise.radius
        * dr.fma(0.5 * promise.radius, promise.constant, gradient_bound)
    )
    return HarmonicBall(promise.radius, value - max_change, value + max_change)
