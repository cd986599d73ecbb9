"""Further quantities of a closed curve of straight edges, and of its solid angle f at a point x:
derivatives, closest points, changes, and proved bounds of f near x. f is known modulo 4 pi. In
integrals along the curve, p is a point of the curve, |dp| the length element, and D = p - x.

- `closest_on_segments`: the closest point of the curve, at which the level sets end.
- `continuous_change`: the change of the solid angle along a straight segment.
- `remainder_promises`, `gradient_change_bound`, `lift_ball`: proved bounds of f near x. The ray
  tracer makes steps that are as long as such a bound allows.

By default the tracer uses a bound of second derivatives. It comes from the integral of |dp|/|D|^3,
which is also the weight in Biot and Savart's law. Other step rules need the range of f on a ball
instead; with these, polygons and knots take 1.4 to 2 times as many evaluations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import clamp
from harnack.backend.record_table import RecordTable
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.fmm.edges import single_edges
from harnack.fmm.source_sums import SUM_MARGIN

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fmm.edges import LoopEdges

__all__ = [
    "closest_on_segments",
    "continuous_change",
    "gradient_change_bound",
    "lift_ball",
    "remainder_promises",
    "segment_records",
]


def segment_records(backend: Backend, start: FloatArray, end: FloatArray) -> RecordTable:
    """Upload k >= 1 straight segments as records for `closest_on_segments`. A segment whose ends
    are equal in the backend's precision counts as a point.

    start, end: (k, 3) the ends of the segments, with coordinates of order one.
    """
    start, end = (q.astype(backend.dtype).astype(np.float64) for q in (start, end))
    return RecordTable.upload(backend, single_edges(start, end))


def closest_on_segments(segments: RecordTable, x: Vec3) -> Vec3:
    """Find, for each of n points x, the closest point (3, n) on any of the segments.

    segments: the result of `segment_records`.
    x: (3, n).
    """
    vector = segments.backend.Array3f
    x = vector(x)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Update the state by the segment in the record `row`. The state holds the smallest squared
        distance so far, and the closest point. Returns the new state."""
        nearest, closest = state
        p, q = vector(*row[:3]), vector(*row[4:7])
        # row[7] is 1/|q - p|^2; the fraction is 0 at p and 1 at q.
        fraction = clamp(dr.dot(x - p, q - p) * row[7], 0, 1)
        point = dr.fma(vector(fraction), q - p, p)
        square = dr.squared_norm(x - point)
        is_closer = square < nearest
        return dr.select(is_closer, square, nearest), dr.select(is_closer, point, closest)

    start = (segments.backend.Float(dr.inf), vector(0))
    # The state is the squared distance and the point.
    return segments.for_each(add, start, "nearest edge")[1]


def continuous_change(edges: LoopEdges, p: Vec3, q: Vec3) -> Real:
    """Compute the change (n,) of the curve's solid angle, followed continuously along n straight
    segments from p to q. The result is a real number, and not only known modulo 4 pi.

    edges: the edges of the curve.
    p, q: (3, n) the ends of the segments; they must differ.

    The change is the integral of the curve's Biot and Savart field along the segment. The part of
    an edge from a to b is minus the solid angle, at the origin, of the parallelogram
    (a - p) + s (b - a) - t (q - p) with s and t from 0 to 1. This is less than 2 pi in size,
    because the plane of the parallelogram misses the origin unless the segment meets the edge. The
    parallelogram is split into two triangles, whose solid angles are twice an arctangent each (van
    Oosterom and Strackee 1983), so there is no branch to choose.
    """
    real = edges.backend.Float

    def add(a: Vec3, b: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the part of the edge from a to b to the change of the solid angle, which is the only
        entry of the state. Returns the new state. inverse: not used here."""
        del inverse
        # The corners of the parallelogram, in order.
        ap, bp, bq, aq = a - p, b - p, b - q, a - q
        return (state[0] - _angle(ap, bp, bq) - _angle(ap, bq, aq),)

    return edges.for_each(add, (real(0),), "swept angle")[0]


def _angle(a: Vec3, b: Vec3, c: Vec3) -> Real:
    """Compute the signed solid angle, at the origin, of the triangle with the corners a, b, c:
    twice the argument of the complex number |a||b||c| + (a.b)|c| + (b.c)|a| + (c.a)|b| + i det(a,
    b, c)."""
    la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
    volume = dr.dot(a, dr.cross(b, c))
    dot_terms = dr.fma(dr.dot(a, b), lc, dr.fma(dr.dot(b, c), la, dr.dot(c, a) * lb))
    # A triangle has no solid angle at points of its own plane, whatever rounding does.
    return dr.select(volume == 0, 0, 2 * dr.atan2(volume, dr.fma(la * lb, lc, dot_terms)))


# The radii of the balls of `remainder_promises`, as fractions of the distance to the curve, by
# experiment.
_RADIUS_FRACTIONS = (0.3, 0.6, 0.85)


def remainder_promises(
    inverse_cubes: Real, inverse_fourths: Real, distance: Real
) -> tuple[TaylorRemainder, ...]:
    """Bound how much a curve's solid angle f differs from its linear Taylor polynomial at x, on
    several balls around x.

    inverse_cubes, inverse_fourths: I3 and I4, the integrals of |dp|/|D|^3 and |dp|/|D|^4 over the
        curve, with the vector D = p - x from x to the point p of the curve; or upper bounds.
    distance: the distance d from x to the curve, or a lower bound of it.

    Returns one bound for each radius q d, for a few fixed fractions q.

    Proof. Along a unit direction v the derivative of the solid angle is the integral of v.(D x
    dp)/|D|^3 over the curve (Biot and Savart). Its second derivative is the integral of 3
    (v.D)(v.(D x dp))/|D|^5, as D changes by -v. D and D x dp are perpendicular, so the product of
    their components along v is at most half of the product of their lengths: the second derivative
    is at most 3/2 times the integral of |dp|/|D|^3. At x + s v, |D| is less by s at most. So by
    Taylor the remainder after the linear term is, for t < d, at most

        3/2 integral of |dp| integral over [0, t] of (t-s)/(|D|-s)^3 ds
            = 3/4 t^2 integral of |dp|/(|D|^3 (1 - t/|D|)).

    For u = t/|D| <= q, 1/(1 - u) <= 1 + u/(1 - q). So on the ball of radius q d, where t <= q d,
    the remainder is at most 3/4 t^2 (I3 + q d I4/(1 - q)). This is `TaylorRemainder` with the
    constant 3/2 (I3 + q d I4/(1 - q)), a bound of second derivatives. The bound holds for any piece
    of a curve, and the bounds of pieces add up.
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
    """Bound how much the gradient of a curve's solid angle f changes near a point x: the result is
    a bound of |grad f(y) - grad f(x)| for |y - x| <= `radius`. It is infinite unless `radius` is
    less than `distance`.

    inverse_cubes, inverse_fourths: I3 and I4, the integrals of |dp|/|D|^3 and |dp|/|D|^4 over the
        curve, with D the vector from x to the point p of the curve; or upper bounds.
    distance: d, the distance from x to the curve, or a lower bound of it.
    radius: the radius of the ball around x.

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
    """Compute a range in which a curve's solid angle is proved to lie, on a ball around x. The
    solid angle is continued from x without its jumps of 4 pi.

    value, gradient: the solid angle and its gradient at x.
    inverse_squares: the integral of |dp|/|D|^2 along the curve, or an upper bound; the rounding of
        the gradient is proportional to it.
    bends: the bounds of second derivatives on balls around x, from `remainder_promises`. The second
        one gives the radius of the ball, and the range by Taylor's formula. The bounds themselves
        prove longer steps than this range.
    slope_error: a bound of the errors of the gradient other than its rounding.
    """
    # |f(y) - f(x)| <= r (|grad f(x)| + r/2 times the bound of second derivatives) for |y - x| <= r.
    promise = bends[1]
    gradient_bound = dr.norm(gradient) + SUM_MARGIN * inverse_squares + slope_error
    max_change = (
        (1 + SUM_MARGIN)
        * promise.radius
        * dr.fma(0.5 * promise.radius, promise.constant, gradient_bound)
    )
    return HarmonicBall(promise.radius, value - max_change, value + max_change)
