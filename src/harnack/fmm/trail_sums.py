"""Sums over the edges of closed curves that give a solid angle: bounds of its change along a line,
and its values and derivatives at points and along rays. A *trail* is a sequence of edges, each from
the end of the one before, that ends at the vertex where it begins. The solid angle f of all edges
together is known modulo 4 pi; the *factor* F_e of an edge is a complex number whose argument is
half the solid angle Omega_e of the triangle from the edge to an apex at infinity (`edge_lift`). The
sum of all Omega_e is a real number, not only known modulo 4 pi. A *record* is a row of numbers that
kernels read, here of a few consecutive edges. A *lane* is one entry of Dr.Jit's arrays, such as a
point or a ray.

- `line_rates`: bounds of the change of a solid angle along a line, also along an edge.
- `TrailValues`: the sum of all Omega_e at many points; values only, fast.
- `LiftedTrails`: the same along rays, with derivatives and bounds.

Proved bounds on balls are poor for a ray that runs along a long edge: the balls are small, and the
ray would need thousands of them. But along a fixed line, an edge's term of the derivative of f has
constant sign, and it vanishes if edge and line are in one plane. The sums of these terms, over
curves and over the trees of meshes alike, are computed only near the curve, and on rays along which
f hardly changes.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import clamp, fmax, fmin, max_norm
from harnack.backend.record_table import RecordTable
from harnack.enclosures import Lipschitz
from harnack.fmm.edge_lift import (
    FACTOR_ROUNDINGS,
    STEEP_ROUNDINGS,
    LiftedProduct,
    edge_factor_of_views,
    view_vertex,
)
from harnack.fmm.edges import Edge, inverse_squares
from harnack.fmm.source_sums import SUM_MARGIN, SourceSums
from harnack.fmm.unit_frame import coordinate_rounding

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fmm.edges import LoopEdges
    from harnack.tree.triangle_tree import RayFrame

__all__ = ["LiftedTrails", "RayLine", "add_edge_rates", "line_rates", "lipschitz_along"]

# Bounds along the line of a ray are computed in two cases. First, if the ray may run along the
# curve: if it is nearer to the curve than `_NEAR_CURVE` times the curve's size, and the derivative
# along the ray is below `_NEAR_SLOPE` times the length of the gradient. Second, if the ray may run
# along a flat part of the surface: if this derivative is below `_FAR_SLOPE` times that length.
_NEAR_CURVE, _NEAR_SLOPE, _FAR_SLOPE = 0.001, 0.25, 1e-3
# The number of lengths for which bounds are computed. They are in geometric progression from half
# the distance to the curve towards the size of the curve.
_LENGTHS = 6

# A function of lengths and a mask of active lanes. It returns, for each length T, a bound of the
# derivative along a line at points within T, as `line_rates` does.
Rates: TypeAlias = "Callable[[tuple[Real, ...], Mask], tuple[Real, ...]]"


@dataclass(frozen=True)
class RayLine:
    """Straight lines x + s v, one for each lane, along which the change of a solid angle is
    bounded. Lengths are in units in which the curve has a size of about one.

    x: a point of each line.
    v: the unit direction of each line.
    rounding: a bound of the rounding of points of the lines.
    """

    x: Vec3
    v: Vec3
    rounding: Real

    @property
    def slack(self) -> Real:
        """A length that bounds the rounding of points of the line, and the rounding of the
        differences p - x, for points p of the curve. Such a difference is about as long as x."""
        return dr.fma(8 * float(dr.epsilon(self.x)), dr.norm(self.x), self.rounding)


def lipschitz_along(
    line: RayLine, gradient: Vec3, distance: Real, rates: Rates
) -> tuple[Lipschitz, ...]:
    """Proved bounds of the change of the solid angle f of a curve along lines: for several lengths
    T, a Lipschitz constant of f on the points of a line within T of its point x. The lengths begin
    with half the distance to the curve and grow towards the size of the curve. The constants are
    finite only on lanes on which they may save more time than they take. These are the lanes on
    which the derivative of f along the line is small relative to |gradient|: at most a quarter of
    it near the curve, at most a thousandth elsewhere.

    line: the lines, with their points x.
    gradient: the gradient of f at x.
    distance: the distance from x to the curve.
    rates: a function that takes the lengths and a mask of active lanes, and returns the constants.

    Along a straight edge the longest length is of use, near the ends of an edge the other lengths.
    Along a flat part of the surface, bounded by a plane curve, the shortest length is of use.
    """
    slope, norm = dr.dot(gradient, line.v), dr.norm(gradient)
    max_slope = dr.select(distance < _NEAR_CURVE, _NEAR_SLOPE, _FAR_SLOPE) * norm
    # Not 0, so that the power below is finite.
    shortest = 0.5 * fmax(distance, type(distance)(1e-30))
    # After `_LENGTHS` steps of this ratio the length would be 1, the size of the curve.
    ratio, lengths = dr.power(shortest, -1 / _LENGTHS), [shortest]
    for _ in range(_LENGTHS - 1):
        lengths.append(lengths[-1] * ratio)
    rate_bounds = rates(tuple(lengths), dr.abs(slope) < max_slope)
    pairs = zip(rate_bounds, lengths, strict=True)
    return tuple(Lipschitz(rate * (1 + SUM_MARGIN), length) for rate, length in pairs)


def line_rates(
    edges: LoopEdges, line: RayLine, lengths: tuple[Real, ...], active: Mask
) -> tuple[Real, ...]:
    """Return, for each length T, a constant K with |f(x + s v) - f(x)| <= |s| K for |s| <= T. Here
    f is the solid angle of the edges, and x + s v are the points of the line.

    edges: the edges of closed curves.
    line: the line, with its point x and its direction v.
    lengths: the lengths T.
    active: mask of the lanes on which constants are wanted.

    Returns a tuple with one constant for each length. It is infinite where the line meets the curve
    within T, up to rounding, and on lanes that are not active. These cost no time if their
    neighbors are not active either.

    A ball around a point near the curve is as small as the distance to it, so a ray that runs along
    a long edge would need thousands of balls. Along a *fixed* line there are better bounds. With a
    = p - x, e the vector of the edge from p to q, and v the unit direction, an edge's term of df/ds
    at x + s v is

        v . (a - s v) x e  w(s) = c w(s),   c = v . (a x e),   w(s) = integral over [0, 1] of
                                                               |a - s v + t e|^-3 dt:

    c does not depend on s, and is zero where the line is parallel to the edge. Let rho be a lower
    bound of the distance of the edge from the points of a segment of the line, and |e| = 2h. Then

        w <= 1/(rho^2 sqrt(rho^2 + h^2)),

    for a point of the edge at the length l from the nearest point is at least sqrt(rho^2 + l^2)
    away, and the integral over an interval of l of length 2h is largest if the interval is centered
    at l = 0. Let d_e be the distance of the edge from x. From x to x + s v, |s| <= T, it falls by
    at most T. It falls nowhere below the distance rho' of the edge from the whole line, nor below
    the distance rho" of the segment |s| <= T from the line through the edge (a ray may meet that
    line at a small angle, far ahead). So for |s| <= T

        |f(x + s v) - f(x)| <= |s| K,   K = sum_e |c| / (rho^2 sqrt(rho^2 + h^2)),
                                        rho = max(d_e - T, rho', rho").
    """

    def add(p: Vec3, q: Vec3, inverse: Real, rates: tuple[Real, ...]) -> tuple[Real, ...]:
        """Add the term of the edge from p to q to the constants `rates`, one for each length.
        inverse: 1/|q - p|^2. Returns the new constants."""
        return add_edge_rates(line, Edge.between(p, q, inverse, line.x), lengths, rates)

    start = tuple(edges.backend.Float(0) for _ in lengths)
    rates = edges.for_each(add, start, "edges along", active)
    return tuple(dr.select(active, rate, dr.inf) for rate in rates)


def add_edge_rates(
    line: RayLine, edge: Edge, lengths: tuple[Real, ...], rates: tuple[Real, ...]
) -> tuple[Real, ...]:
    """Add the term of one edge to the constants K of `line_rates`, which bound the change of the
    solid angle along a line within each of several lengths of the line's point x.

    line: the line, with its point x and its direction v.
    edge: the edge, relative to x.
    lengths: the lengths T.
    rates: the constants so far, one for each length.

    Returns the new constants. They are infinite where the line may meet the edge within T.

    Let the edge run from x + a to x + a + e. The symbols c, h, d_e, rho' and rho" are those of
    `line_rates`. m = a x v and n = e x v are a and e projected along the line and rotated by a
    right angle. So the edge, seen along the line, runs from m to m + n, and the line is seen as the
    point 0: rho' is the distance of this segment from 0. Also c = v . (m x n). So c is small if m
    and n are, whatever the lengths of a and e: its error is at most 8 epsilon |m| |e| plus slack
    |n|, where slack bounds the rounding of positions (`RayLine.slack`). To |c| the first part and
    twice the second are added.
    """
    a, e, inverse, slack = edge.a, edge.e, edge.inverse_square_length, line.slack
    epsilon = float(dr.epsilon(type(inverse)))
    m, n = dr.cross(a, line.v), dr.cross(e, line.v)
    c = dr.abs(dr.dot(line.v, dr.cross(m, n)))
    quarter = 0.25 * dr.rcp(inverse)  # h^2
    # Enlarged by the bound of its error: 16 |m| h is 8 |m| |e|.
    c += 16 * epsilon * dr.norm(m) * dr.sqrt(quarter) + 2 * slack * dr.norm(n)
    square = dr.squared_norm(n)
    # rho': the point m + t n of the segment that is nearest to 0.
    t = dr.select(square > 0, clamp(-dr.dot(m, n) / square, 0, 1), 0)
    line_distance = dr.norm(dr.fma(type(a)(t), n, m)) - slack
    distance = dr.sqrt(edge.squared_distance) - slack  # d_e
    # rho": (a - s v) x e = area + s n has the length |e| times the distance of x + s v from the
    # line through the edge. It is shortest at s_nearest.
    area, per_length = dr.cross(a, e), dr.sqrt(inverse)
    s_nearest = dr.select(square > 0, -dr.dot(area, n) / square, 0)
    new_rates: list[Real] = []
    for length, rate in zip(lengths, rates, strict=True):
        s = clamp(s_nearest, -length, length)
        segment_distance = dr.norm(dr.fma(type(a)(s), n, area)) * per_length - slack
        rho = fmax(fmax(distance - length, line_distance), segment_distance)
        rho_square = rho * rho
        term = c * dr.rcp(rho_square) * dr.rsqrt(rho_square + quarter)
        # Infinite where the line may meet the edge.
        new_rates.append(rate + dr.select(rho > 0, term, dr.inf))
    return tuple(new_rates)


# Values at many points.

# The number of edges of a record: its five vertices and its number of edges fill two packets of
# eight.
_EDGES_PER_RECORD = 4
# The number of points of a lane: as many as registers hold, by experiment.
_POINTS_PER_LANE = 3
# The sign of a factor's imaginary part counts as uncertain if this part is closer to zero than this
# many rounding errors of the products in it. Its own error is at most six of these, and that of
# `tree.triangle_tree.edge_function` is one.
_SIGN_ROUNDINGS = 16
# Beyond this distance, in units of the mesh's size, products of lengths could overflow in single
# precision.
_MAX_COORDINATE = 1024.0

# A point, and its ray_sign (`TrailValues.turns`): 1 or -1 for the direction of its ray along the z
# axis.
Point: TypeAlias = "tuple[Vec3, Real]"
Complex: TypeAlias = "tuple[Real, Real]"
# A vertex a = (u, v, z) relative to a point: (u t, v t, s t) with t = |a| + |z| and s as in
# `edge_lift`.
Seen: TypeAlias = "tuple[Real, Real, Real]"


@dataclass(frozen=True)
class _FloatFormat:
    """A floating-point format, for operations on the bits of its numbers. They give signs and
    powers of two faster than arithmetic, and distinguish -0 from 0.

    integer: the type of integers with as many bits.
    mantissa: the number of bits of the mantissa.
    bias: the bias of the exponent.
    """

    integer: Any
    mantissa: int
    bias: int

    @classmethod
    def of(cls, backend: Backend) -> _FloatFormat:
        """The format of a backend's floating-point numbers."""
        mantissa, bias = (23, 127) if backend.precision == "single" else (52, 1023)
        return cls(dr.int_array_t(backend.Float), mantissa, bias)

    def sign(self, x: Real) -> Any:
        """An integer for each number x: -1 if the sign bit of x is set, as it is for -0, else 0."""
        bits = dr.reinterpret_array(self.integer, x)
        # A shift of a signed integer by all bits but the sign repeats the sign bit.
        return bits >> (self.mantissa + self.bias.bit_length() + 1)

    def reciprocal_power_of_two(self, x: Real) -> Real:
        """The power of two by which x > 0 has to be multiplied to lie between one and two."""
        # The stored exponent is the exponent plus the bias; 2 bias minus it is that of the
        # reciprocal.
        exponent = dr.reinterpret_array(self.integer, x) & ((2 * self.bias + 1) << self.mantissa)
        return dr.reinterpret_array(type(x), (2 * self.bias << self.mantissa) - exponent)


@dataclass(frozen=True)
class _AngleProduct:
    """A product z = x + iy of complex factors, together with theta, the sum of their arguments,
    which may be several turns. The length |z| is arbitrary, as only arguments matter.

    x, y: the real and the imaginary part of z.
    half: a count of half turns: theta lies in [half pi, (half + 1) pi]. The argument of each factor
        is taken in [-pi, pi]. The sign bit of y is the parity of `half`.
    """

    x: Real
    y: Real
    half: Any

    @classmethod
    def of(cls, bits: _FloatFormat, factor: Complex) -> _AngleProduct:
        """The product of the single complex factor `factor`. bits: the format of its numbers."""
        # Its argument lies in [-pi, 0], with half = -1, or in [0, pi], with half = 0.
        return cls(*factor, bits.sign(factor[1]))

    def times(self, bits: _FloatFormat, factor: Complex) -> _AngleProduct:
        """The product with a further complex factor x' + iy'. bits: the format of the numbers.

        The factor's argument lies in [-pi, pi]. So it moves theta at most one half plane forward,
        or, if the sign bit of y' is set, at most one back; and it does so exactly if the sign of y
        changes.

        Rounding. The computed y has another sign than the exact y only if the two terms of y nearly
        cancel. Then the exact theta is near a multiple of pi, and just this multiple is what the
        count of half turns crosses, or does not cross, wrongly. So theta is off by a rounding error
        only. A term that underflows keeps its sign bit.
        """
        x = dr.fma(self.x, factor[0], -(self.y * factor[1]))
        y = dr.fma(self.x, factor[1], self.y * factor[0])
        # `half` counts half planes. sign_change: -1 if the sign of y changes, else 0. The number
        # ANDed with it is -1 for a factor that turns back, else 1.
        sign_change = bits.sign(self.y) ^ bits.sign(y)
        return _AngleProduct(x, y, self.half + (sign_change & (bits.sign(factor[1]) | 1)))

    def times_product(self, bits: _FloatFormat, other: _AngleProduct) -> _AngleProduct:
        """The product of this product and `other`. The sums theta of arguments are added. bits: the
        format of the numbers."""
        # `times` takes the principal argument of the other product. The whole turns by which its
        # theta differs from that are an even number of half turns.
        z = self.times(bits, (other.x, other.y))
        return _AngleProduct(z.x, z.y, z.half + ((other.half + 1) & -2))

    def scaled(self, bits: _FloatFormat) -> tuple[_AngleProduct, Real]:
        """The same product, multiplied by a power of two so that |x| + |y| lies between one and
        two; and the value of |x| + |y| before the scaling. This scaling is exact. bits: the format
        of the numbers."""
        length = dr.abs(self.x) + dr.abs(self.y)
        scale = bits.reciprocal_power_of_two(length)
        return _AngleProduct(self.x * scale, self.y * scale, self.half), length

    def turns(self) -> Real:
        """The sum theta of the factors' arguments as a number of turns, that is, divided by 2
        pi."""
        real = cast("Any", type(self.x))
        # atan2 may ignore the sign of a zero, so that a zero becomes a tiny number of its sign.
        y = dr.copysign(fmax(dr.abs(self.y), real(1e-30)), self.y)
        # theta is atan2(y, x), in [-pi, pi], plus (half + 1)/2 full turns, rounded down.
        return dr.fma(dr.atan2(y, self.x), 0.5 / dr.pi, real((self.half + 1) >> 1))


@dataclass(frozen=True)
class TrailValues:
    """Directed edges on a backend, as records of consecutive edges of closed trails, for values at
    many points: the sum of the solid angles Omega_e of all edges' triangles (`edge_lift`), without
    derivatives.

    The formula is that of `edge_lift`, arranged so that little is computed twice. The boundary of
    any set of triangles enters every vertex as often as it leaves it, so that its edges form closed
    trails. The part of a factor that belongs to a vertex is computed once, and not for each of its
    edges. A record of edges is fetched once for several points. There are no divisions. Points at
    which rounding could have changed a sign are marked, so that they can be computed again by
    `edge_lift`.
    """

    records: RecordTable

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> TrailValues:
        """Sort directed edges into trails and upload them to a backend, four edges to a record.

        vertices: (n, 3).
        edges: (k, 2) indices of vertices. The edges must leave each vertex as often as they enter
            it.
        """
        rows: list[FloatArray] = []
        for trail in closed_trails(edges):
            edge_count = len(trail) - 1
            record_count = -(-edge_count // _EDGES_PER_RECORD)
            first = _EDGES_PER_RECORD * np.arange(record_count)[:, None]
            # The last record repeats the last vertex: its remaining edges have length 0.
            index = np.minimum(first + np.arange(_EDGES_PER_RECORD + 1), edge_count)
            edge_counts = np.minimum(edge_count - first, _EDGES_PER_RECORD)
            rows.append(
                np.concatenate([vertices[trail[index]].reshape(record_count, -1), edge_counts], 1)
            )
        return cls(RecordTable.upload(backend, np.concatenate(rows)))

    def turns(self, x: Vec3, ray_sign: Real) -> tuple[Real, Mask]:
        """The sum of the solid angles Omega_e of the edges' triangles (`edge_lift`) at points x,
        divided by 4 pi; and a mask (n,), true where the sum is uncertain, so that it must be
        computed again by `edge_lift`.

        x: (3, n) the points, in units in which the mesh has a size of about one.
        ray_sign: (n,) 1 or -1, for each point. With 1 all triangles have their apex at infinity in
            the direction -z. With -1 this method mirrors the edges and x in a plane z = const
            before it computes the sum (by `_relative_vertex`). The result is then minus the sum
            over the given edges, with an apex in the direction +z.

        Each lane of the kernel computes several points. The mask is true in three cases: rounding
        could have changed the sign of the imaginary part of a factor F_e; a product of factors
        nearly underflows (near an edge or at a short edge); or a coordinate of x is larger than
        1024.
        """
        dr.eval(x, ray_sign)
        backend, n = self.records.backend, dr.width(x)
        real, index = backend.Float, backend.UInt32
        lanes = -(-n // _POINTS_PER_LANE)
        # Lane j computes the points j, j + lanes, ...; the last lanes repeat the last point.
        lane = dr.arange(index, lanes)
        stride, last = dr.opaque(index, lanes), dr.opaque(index, n - 1)  # for any n one kernel
        point_ids = [dr.minimum(lane + k * stride, last) for k in range(_POINTS_PER_LANE)]
        points = [
            (dr.gather(backend.Array3f, x, point_id), dr.gather(real, ray_sign, point_id))
            for point_id in point_ids
        ]
        products, margins = self._over_records(points)
        # Omega_e is twice the argument of F_e. So the sum of all Omega_e over 4 pi is the argument
        # of the product of all F_e in turns. The products have the conjugate factors, hence minus.
        turns = [-product.turns() for product in products]
        dr.eval(*turns, *margins)
        all_turns, all_margins = dr.empty(real, n), dr.empty(real, n)
        for point_id, turn, margin in zip(point_ids, turns, margins, strict=True):
            dr.scatter(all_turns, turn, point_id)
            dr.scatter(all_margins, margin, point_id)
        is_far = max_norm(x) > _MAX_COORDINATE
        return all_turns, (all_margins <= 0) | is_far

    def _over_records(self, points: list[Point]) -> tuple[list[_AngleProduct], list[Real]]:
        """Multiply the factors of all edges, for each of the points of a lane, in a loop over
        records.

        Returns two lists with an entry for each point: the product; and a margin, a number that is
        at most 0 if rounding could have changed a sign, or if the product nearly underflowed.

        points: the points of a lane, each with the direction of its ray.
        """
        backend = self.records.backend
        real, bits = backend.Float, _FloatFormat.of(backend)
        # Minus the relative error of a product (`_multiplied_by_record`).
        slack = real(-_SIGN_ROUNDINGS * 0.5 * backend.machine_epsilon)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """The new state: the products and margins of all points, which `state` holds, after
            multiplication by the factors of the edges in the record `row`."""
            # Column 15, behind five vertices, is the number of edges that are no padding. Padding
            # leads from a vertex to itself: it is never uncertain. slack: minus the relative error
            # of a product.
            slacks = [dr.select(row[15] > k, slack, 1) for k in range(_EDGES_PER_RECORD)]
            pairs = zip(points, state, strict=True)
            return tuple(
                _multiplied_by_record(bits, row, slacks, x, previous) for x, previous in pairs
            )

        # Each point begins with the product 1, without half turns, and with the margin 1.
        entry = (real(1), real(0), bits.integer(0), real(1))
        products = self.records.for_each(add, tuple(entry for _ in points), "trails")
        return [_AngleProduct(*entry[:3]) for entry in products], [entry[3] for entry in products]


def _multiplied_by_record(
    bits: _FloatFormat, row: list[Real], slacks: list[Real], x: Point, state: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Multiply the product of a point by the factors of the four edges of a record. Returns the new
    state of the point.

    bits: the format of the numbers.
    row: the record: five vertices, and the number of edges that are no padding.
    slacks: for each edge, minus the relative error of the products in a factor's imaginary part, or
        1 if it is padding.
    x: the point, with the direction of its ray.
    state: the product (x, y, half), and its margin, which is at most 0 if the product is uncertain.

    The four factors are multiplied with each other first. Their product has an argument of nearly
    zero, where rounding has the least effect.
    """
    z, margin = _AngleProduct(*state[:3]), state[3]
    # Products shorter than this count as nearly underflowed. Single precision has a mantissa of
    # fewer than 50 bits.
    min_length = 2.0**-100 if bits.mantissa < 50 else 2.0**-800
    a = _relative_vertex(bits, row[0:3], x)
    record_product: _AngleProduct | None = None
    for k in range(_EDGES_PER_RECORD):
        b = _relative_vertex(bits, row[3 * k + 3 : 3 * k + 6], x)
        factor, sign_margin = _factor(a, b, slacks[k])
        margin = fmin(sign_margin, margin)
        record_product = (
            _AngleProduct.of(bits, factor)
            if record_product is None
            else record_product.times(bits, factor)
        )
        # Two factors can be multiplied without scaling, four could underflow or overflow.
        if k == 1:
            record_product, length = record_product.scaled(bits)
            margin = fmin(length - min_length, margin)
        a = b
    z, length = z.times_product(bits, cast("_AngleProduct", record_product)).scaled(bits)
    return z.x, z.y, z.half, fmin(length - min_length, margin)


def _relative_vertex(bits: _FloatFormat, vertex: list[Real], point: Point) -> Seen:
    """A vertex relative to a point, in the form that the factors of edges need. For the vector a =
    (u, v, z) from the point to the vertex it is (u t, v t, s t), with t = |a| + |z| and s = |a| -
    ray_sign z. For ray_sign = -1 this is the vertex mirrored in a plane z = const: z changes its
    sign, u and v do not.

    bits: the format of the numbers.
    vertex: the coordinates of the vertex.
    point: the point and ray_sign, 1 or -1 for the direction of its ray along z.

    s t is t^2 if z and ray_sign have different signs, and u^2 + v^2 if they have the same sign. So
    no difference cancels.
    """
    x, ray_sign = point
    u, v, z = vertex[0] - x[0], vertex[1] - x[1], vertex[2] - x[2]
    square = dr.fma(u, u, v * v)
    t = dr.sqrt(dr.fma(z, z, square)) + dr.abs(z)
    # Negative if the sign bits of z and ray_sign differ.
    signs = dr.reinterpret_array(bits.integer, z) ^ dr.reinterpret_array(bits.integer, ray_sign)
    product = dr.select(signs < 0, t * t, square)  # s t
    return u * t, v * t, product


def _factor(a: Seen, b: Seen, slack: Real) -> tuple[Complex, Real]:
    """Compute the factor of an edge, and whether its sign is certain. Returns two results. The
    first is the complex conjugate of the factor F_e (`edge_lift`), times a positive number, as real
    and imaginary part. The second is a margin: a number that is at most 0 if rounding could have
    changed the sign of the imaginary part.

    a, b: the ends of the edge, from `_relative_vertex`.
    slack: minus the relative error of the products in the imaginary part, or 1 for an edge that is
        padding.
    """
    product = a[1] * b[0]
    im = dr.fma(a[0], b[1], -product)
    re = dr.fma(a[2], b[2], dr.fma(a[0], b[0], a[1] * b[1]))
    return (re, im), dr.fma(dr.abs(product), slack, dr.abs(im))


def closed_trails(edges: IntArray) -> list[IntArray]:
    """Divide directed edges (k, 2) into closed trails. A trail is an array of vertex indices in
    which each vertex is joined to the next by an edge, and which ends with the vertex with which it
    begins. Each edge is in exactly one trail, once.

    Raises:
        ValueError: an edge leads to a vertex that no further edge leaves.
    """
    successors: defaultdict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        successors[a].append(b)
    trails: list[IntArray] = []
    for start in list(successors):
        while successors[start]:
            trail = [start]
            while successors[trail[-1]]:
                trail.append(successors[trail[-1]].pop())
            if trail[-1] != start:
                raise ValueError(f"edges: not closed, more go to vertex {trail[-1]} than from it")
            trails.append(np.array(trail, np.int64))
    return trails


# Sums along rays.

# Possible numbers of edges of a record. The one for which padding wastes less memory is used.
_RECORD_SIZES = 3, 4


@dataclass(frozen=True)
class LiftedTrails:
    """Closed trails of directed edges on a backend, in records of `edges_per_record` consecutive
    edges, for sums along rays: of the solid angles Omega_e of the edges' triangles (`edge_lift`),
    with the gradient and bounds.

    Signs are decided by the same bits as in `edge_lift`. The part of a factor that belongs to a
    vertex is computed once, and not for each of its edges. Roots and divisions take most time;
    several edges share them where a bound allows it.

    A record holds `edges_per_record` + 1 vertices; then 1/length^2 of each edge; then the length of
    each edge, negative if the edge runs from a higher to a lower index, and 0 if there is no edge.
    """

    records: RecordTable
    edges_per_record: int

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, trails: list[IntArray]) -> LiftedTrails:
        """Upload closed trails of edges to a backend, in records of three or four edges, whichever
        needs less memory.

        vertices: (n, 3).
        trails: arrays of indices of vertices; each ends with the vertex with which it begins
            (`closed_trails`).
        """
        # run: the number of edges in a record. The key is the number of records, times a number
        # proportional to the memory of one.
        run = min(
            _RECORD_SIZES,
            key=lambda run: sum(-(-(len(t) - 1) // run) for t in trails) * (run + 0.5),
        )
        # Lengths must be those of the edges between rounded vertices.
        rounded = vertices.astype(backend.dtype).astype(np.float64)
        rows = [_trail_records(rounded, trail, run) for trail in trails]
        return cls(RecordTable.upload(backend, np.concatenate(rows)), run)

    def sum(self, frame: RayFrame, x: Vec3, active: Mask = True) -> SourceSums:
        """The sum of the solid angles Omega_e of the edges' triangles (`edge_lift`) at points x of
        rays, on active lanes; with the gradient, and with the sums from which error bounds and
        proved bounds near x follow.

        frame: the rays; x lies on them.

        Symbols. Let L be the length of an edge, e the vector along it, a the vector from x to its
        start, d the distance from x to the edge, and rho the distance from x to a point p of the
        edge. w is a factor of the edge's Biot and Savart field w a x e (`Edge`), and L w is the
        integral of |dp|/rho^3 over the edge.

        Bounds of derivatives. `LiftedEdge.bounds` shows that 1/4 times the integral of |dp|/rho^3
        and 3/16 times the integral of |dp|/rho^4 are terms s4 and s5 of an edge. The second
        integral is at most L w/d. For all edges of a record the d of the nearest edge is used,
        reduced by its rounding. So s4 += L w/4 and s5 += 3 L w/(16 d).

        Rounding. By `LiftedEdge.bounds` the solid angle of an edge changes by at most |field|
        times the length `unit`, by which rounding moves the edge. The sums in its factor add a
        constant, and STEEP_ROUNDINGS L e' unit roundoffs if the edge subtends more than a right
        angle, with a number e' <= 1/d. Then |field| >= 1/d >= e': it is (sin A + sin B)/d, where A
        and B are the angles that the two parts of the edge subtend on both sides of its nearest
        point, and A + B is at least a right angle. So |field| (unit + STEEP_ROUNDINGS roundoffs L)
        bounds both. |field| is at most d L w, because |a x e| is L times the distance of x from the
        line of e. By Cauchy and Schwarz the sum of d L w over a record is at most the square root
        of (sum of L w) (sum of d^2 L w). The largest L of the record is used for all its edges.
        """
        backend = self.records.backend
        real, unit = backend.Float, fmax(coordinate_rounding(frame.o), coordinate_rounding(x))
        factor_rounding = 0.5 * backend.machine_epsilon * FACTOR_ROUNDINGS * self.edges_per_record
        steep_rounding = 0.5 * backend.machine_epsilon * STEEP_ROUNDINGS
        no_factors = LiftedProduct.identity(real)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """The new state, after the edges in the record `row` have been added. It holds the
            product of factors, the gradient, the least squared distance, the bound of the rounding,
            s4 and s5 (quantities of `SourceSums` that bound the remainder of Taylor's formula)."""
            # The symbols and proofs are those of `sum`: L is the length of an edge, d its distance
            # from x, w c its Biot and Savart field. `factor_rounding` bounds the rounding of a
            # record's factors, and `unit` that of a coordinate; `steep_rounding` is STEEP_ROUNDINGS
            # unit roundoffs.
            product, g, min_square, rounding, s4, s5 = state
            product = no_factors.with_state(product)
            a = view_vertex(self._vertex(row, 0), frame, x)
            total, weighted, nearest, longest = (real(0), real(0), real(dr.inf), real(0))
            # Over the edges of the record, total is the sum of L w, weighted the sum of d^2 L w,
            # nearest the least d^2, and longest the largest L.
            for k in range(self.edges_per_record):
                p, q = self._vertex(row, k), self._vertex(row, k + 1)
                # inverse is 1/L^2; length is L, with a sign for the order of the ends' indices, and
                # 0 if there is no edge.
                inverse, length = self._edge(row, k)
                b = view_vertex(q, frame, x)
                re, im = edge_factor_of_views(a, b, length)
                is_edge = length != 0
                product = product.times(dr.select(is_edge, re, 1), dr.select(is_edge, im, 0))
                edge = Edge(a.offset, b.offset, q - p, inverse)
                # c = a x e
                w, c = edge.biot_savart_of_lengths(a.length, b.length)
                g = dr.fma(type(g)(w), c, g)
                integral = dr.abs(length) * w
                square = dr.select(is_edge, edge.squared_distance, dr.inf)
                total, nearest = total + integral, fmin(nearest, square)
                longest = fmax(longest, dr.abs(length))
                weighted = weighted + dr.select(is_edge, integral * square, 0)
                a = b
            # The least d, less its rounding.
            distance = fmax(dr.sqrt(nearest) - 2 * unit, 0)
            # (unit + STEEP_ROUNDINGS roundoffs L) times the bound of the sum of |field|, which is
            # the root, by Cauchy and Schwarz.
            steep = dr.fma(steep_rounding, longest, unit) * dr.sqrt(total * weighted)
            rounding = rounding + (steep + factor_rounding)
            # s4 grows by the sum of L w/4, and s5 by that of 3 L w/(16 d), 3/16 being 0.1875.
            s5 = dr.fma(0.1875 * total, dr.rcp(distance), s5)
            return (
                product.to_state(),
                g,
                fmin(nearest, min_square),
                rounding,
                s4 + 0.25 * total,
                s5,
            )

        start = (no_factors.to_state(), backend.Array3f(0), real(dr.inf), real(0), real(0), real(0))
        product, g, min_square, rounding, s4, s5 = self.records.for_each(
            add, start, "trails along", active
        )
        sums = SourceSums.zero(backend, dr.inf, 1)
        return dataclasses.replace(
            sums,
            total=no_factors.with_state(product).angle(),
            gradient=g,
            rounding=rounding,
            singularity_distance=dr.sqrt(min_square),
            s4=s4,
            s5=s5,
        )

    def _vertex(self, row: list[Real], k: int) -> Vec3:
        """The position (3,) of vertex k of the record `row`."""
        return self.records.backend.Array3f(*row[3 * k : 3 * k + 3])

    def _edge(self, row: list[Real], k: int) -> tuple[Real, Real]:
        """Two numbers of edge k in the record `row`: one over its squared length; and its length
        with a sign, which is negative if the edge runs from a higher to a lower vertex index. The
        length is 0 if there is no edge."""
        first = 3 * (self.edges_per_record + 1)
        return row[first + k], row[first + self.edges_per_record + k]


def _trail_records(vertices: FloatArray, trail: IntArray, run: int) -> FloatArray:
    """The records of a closed trail, as `LiftedTrails` describes them. Edges of length 0 pad the
    last record.

    vertices: (n, 3) positions, rounded to the backend's precision.
    trail: indices of vertices, the last equal to the first.
    run: the number of edges in a record.
    """
    edge_count = len(trail) - 1
    record_count = -(-edge_count // run)
    # For each record, the positions of its vertices in the trail. Consecutive records share one.
    index = np.minimum(run * np.arange(record_count)[:, None] + np.arange(run + 1), edge_count)
    path = trail[index]
    start, end = path[:, :-1], path[:, 1:]
    inverse = inverse_squares((vertices[end] - vertices[start]).reshape(-1, 3)).reshape(
        record_count, run
    )
    length = np.where(start < end, 1, -1) / np.sqrt(inverse)
    # Padding, where `index` stays at the end of the trail, has length 0.
    length = np.where(index[:, :-1] < index[:, 1:], length, 0)
    return np.concatenate([vertices[path].reshape(record_count, -1), inverse, length], axis=1)
