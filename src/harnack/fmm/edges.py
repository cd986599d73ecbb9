"""The edges of a closed curve on a backend, and sums over them at a point x. The curve consists of
closed loops of straight edges. Its solid angle Omega, seen from x, is known modulo 4 pi. Each edge
adds to the gradient of Omega its Biot and Savart field, a vector. The curve is given in unit
coordinates, in which it lies within a distance of 1 of the origin. In integrals along the curve, D
is the distance from x to the point p of the curve, and |dp| the length element.

- `LoopEdges`: records of runs of consecutive edges of closed loops; `single_edges`: records of one
  edge each.
- `Edge`: distance, field and derivatives of one edge at a point.
- `sum_over_edges`: solid angle, gradient, distance and integrals in one pass.

The solid angle is computed as a product of spinors (pairs of complex numbers, one for each vertex)
and not as a fan of triangles: a fan is 0/0 on lines through its apex, the product only on the curve
itself.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import fmin
from harnack.backend.record_table import RecordTable
from harnack.fmm.point_values import SymmetricMatrix
from harnack.tree.closest_triangles import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

__all__ = ["Edge", "edge_variation"]

# A function that adds an edge to the state of a loop. Its arguments are the ends p and q of the
# edge, 1/|q - p|^2, and the state; it returns the new state.
EachEdge: TypeAlias = "Callable[[Vec3, Vec3, Real, tuple[Any, ...]], tuple[Any, ...]]"

# The largest 1/length^2 of a record, within the range of float32. Edges of length 0, as padding or
# by rounding, have it, too: they have no angle and no gradient, and hardly change any bound.
_MAX_INVERSE_SQUARE = 1e30


def inverse_squares(edges: FloatArray) -> FloatArray:
    """Compute one over the squared length (k,) of edges, given as vectors (k, 3) from start to end.
    The result is at most 1e30, the largest number that records hold.

    For edges shorter than 1e-15 the result is too small. That harms neither distances nor bounds.
    The computed nearest point of the edge is off by less than the edge's length, far below the
    rounding of distances. The bounds of `edge_variation` contain 1/sqrt(d^2 (1 + 4 d^2/length^2)),
    which only grows.
    """
    squared = (edges * edges).sum(axis=1)
    return 1 / np.maximum(squared, 1 / _MAX_INVERSE_SQUARE)


def single_edges(start: FloatArray, end: FloatArray, direction: Any = 1.0) -> FloatArray:
    """Make records (k, 8) of edges. A record holds the start (3,), the direction, the end (3,), and
    1/length^2.

    start, end: (k, 3) the ends of the edges.
    direction: (k,) 1 if the boundary runs from start to end, -1 if it runs back.
    """
    direction = np.broadcast_to(direction, len(start))
    return np.column_stack([start, direction, end, inverse_squares(end - start)])


@dataclass(frozen=True)
class LoopEdges:
    """The edges of a curve on a backend. The curve consists of closed loops of straight edges, in
    unit coordinates (within a distance of 1 of the origin); Omega is its solid angle, seen from a
    point x. Edges are stored in records of `edges_per_record` consecutive edges.

    records: each record holds `edges_per_record` + 1 vertices. Each vertex has four numbers: x, y,
        z, and 1/length^2 of the edge to the next vertex. The last record of a loop is padded with
        edges of length 0. Records do not depend on each other, so that several loops need no
        special case.
    edges_per_record: the number of edges in a record.
    """

    records: RecordTable
    edges_per_record: int

    @classmethod
    def upload(
        cls, backend: Backend, loops: tuple[FloatArray, ...], run: int | None = None
    ) -> LoopEdges:
        """Upload the edges of closed loops.

        loops: for each loop, its vertices (n, 3) in unit coordinates.
        run: the number of edges in a record; None to choose it by the sizes of the loops.
        """
        run, dtype = run or _edges_per_record(loops), backend.dtype
        rounded = (loop.astype(dtype).astype(np.float64) for loop in loops)
        table = np.concatenate([_loop_records(loop, run) for loop in rounded])
        return cls(RecordTable.upload(backend, table), run)

    @property
    def backend(self) -> Backend:
        return self.records.backend

    def rounding(self, records: Any) -> Any:
        """Bound the rounding error of the solid angle Omega that `sum_over_edges` computes, apart
        from the part that `vertex_rounding` bounds. The whole error is at most the sum of both.

        records: the number of records of the loops.

        Proof of both bounds. Let u = epsilon/2, the unit roundoff. As `sum_over_edges` explains,
        Omega is twice the argument of a product of factors F = <chi_a, chi_b>, one for each edge
        (edges of padding included). Here chi_a is the spinor of a vertex at a = p - x, with
        |chi_a|^2 = 2 s |a| and s = |a| + |a_z|. Errors of arguments add up, as each step is
        compared with the exact product of its rounded inputs.

        (1) Multiplication by F. Each of the two parts of the result is off by at most u times the
        size of a single product and u times itself. So the result is off by 2 u of its length, and
        by another u where it is scaled, after every second factor: by 2.5 u on average.

        (2) F itself. It has the length P c, with P = |chi_a||chi_b| and the cosine c of half the
        angle that the edge subtends. One of the four numbers of chi is 0. By Cauchy and Schwarz no
        partial sum is more than P. The real part has at most three roundings, of at most u P each;
        the imaginary part has two, of at most u P together where the real part has three and of
        1.7 u P otherwise. So F is off by 3.2 u P, and turned by 3.2 u/c.

        By (1) and (2) Omega is off by 2 (2.5 + 3.2/c) u for each factor. If the edge subtends at
        most a right angle, 1/c <= sqrt(2), and this is 7.1 epsilon. If it subtends more, x lies in
        the ball over the edge: with half length h <= 1 and distance d <= h, 1/c <= sqrt(2) h/d. Let
        D be the distance from x to a point p of the edge; then the integral of |dp|/D^2 over the
        edge is at least pi/2/d. So Omega is also off by 2.9 epsilon times that integral, which is
        counted by `vertex_rounding`.

        (3) Vertices. |a| and s have relative errors of 2.5 u and 3.5 u, which turn chi as if the
        vertex had moved by 3.5 u |a|; the rounding of p - x moves it by u |a|. Both edges at a
        vertex use the same bits. So the computed Omega is that of a curve moved by at most
        2.25 epsilon |a|, and off by that times the integral of |dp|/D^2 (`vertex_rounding`). In
        unit coordinates |a| <= 1 + |x|.

        (4) The arc tangent and the last operations: 16 epsilon.
        """
        return self.backend.machine_epsilon * (16 + 7.25 * self.edges_per_record * records)

    def records_of(self, first: Any, trips: Any) -> LoopEdges:
        """Select the edges of some consecutive records. Both arguments may differ from lane to
        lane.

        first: the index of the first record.
        trips: the number of records.
        """
        return replace(self, records=self.records.view(first, trips))

    def vertex(self, row: list[Real], k: int) -> Vec3:
        """Read the position (3,) of vertex k from the record `row`. Edge k of the record starts at
        it."""
        return self.backend.Array3f(*row[4 * k : 4 * k + 3])

    def for_each(
        self, body: EachEdge, state: tuple[Any, ...], label: str, active: Mask = True
    ) -> tuple[Any, ...]:
        """Loop over all edges, one after another, and for each edge from p to q set state = body(p,
        q, 1/|q - p|^2, state). Returns the last state.

        body: the function that returns the new state.
        state: the first state.
        label: the name of the recorded loop.
        active: the mask of the lanes on which the loop runs.
        """

        def of_record(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Update the state by the edges in the record `row`, one after another. Returns the new
            state."""
            for k in range(self.edges_per_record):
                # row[4 * k + 3] is 1/|q - p|^2.
                p, q = self.vertex(row, k), self.vertex(row, k + 1)
                state = body(p, q, row[4 * k + 3], state)
            return state

        return self.records.for_each(of_record, state, label, active)


def vertex_rounding(epsilon: float, x: Vec3, inverse_squares: Real) -> Real:
    """Bound one part of the rounding error of the solid angle that a curve subtends at a point x.
    This part grows as x nears the curve. It comes from the rounding of vertices, and from edges
    that subtend more than a right angle at x. `LoopEdges.rounding` bounds the other part, and has
    the proof of both bounds. The whole error is at most their sum.

    epsilon: the machine epsilon of the backend.
    x: the point in unit coordinates (the curve lies within a distance of 1 of the origin).
    inverse_squares: an upper bound of the integral of |dp|/D^2 along the curve, with D the distance
        from x to the point p (`CurveSums.inverse_squares`).
    """
    return epsilon * dr.fma(2.25, dr.norm(x), 2.9 + 2.25) * inverse_squares


def _edges_per_record(loops: tuple[FloatArray, ...]) -> int:
    """Choose the number of edges in a record for these loops: eight, or four if padding each loop
    to a multiple of eight edges would add more than a fifth to their number.

    loops: for each loop, its vertices (n, 3).
    """
    edges = sum(len(loop) for loop in loops)
    padded = sum(-(-len(loop) // 8) * 8 for loop in loops)
    return 8 if padded <= 1.2 * edges else 4


def _loop_records(loop: FloatArray, run: int) -> FloatArray:
    """Make the records of a closed loop, with `run` consecutive edges each, as described at
    `LoopEdges`. Edges of length 0 pad the last record.

    loop: (n, 3) the vertices.

    Returns (number of records, 4 (run + 1)).
    """
    record_count = -(-len(loop) // run)
    padding = np.repeat(loop[:1], record_count * run + 1 - len(loop), axis=0)
    path = np.concatenate([loop, padding])  # back to the start, then edges of length 0
    inverse = inverse_squares(path[1:] - path[:-1])
    # Each vertex with 1/length^2 of the edge that begins at it; no edge begins at the last one.
    rows = np.concatenate([path, np.append(inverse, 0.0)[:, None]], axis=1)
    # Consecutive records share a vertex: the last of one is the first of the next.
    index = np.arange(record_count)[:, None] * run + np.arange(run + 1)[None, :]
    return rows[index].reshape(record_count, -1)


@dataclass(frozen=True)
class Edge:
    """The straight edge of a closed curve from p to q, relative to a point x: a = p - x, b = q - x,
    and e = q - p. The edge adds its Biot and Savart field w c, with a factor w and the vector
    c = a x e, to the gradient of the curve's solid angle at x (paper, Eq. 11).

    a, b: p - x and q - x.
    e: q - p, which is free of the rounding of x.
    inverse_square_length: 1/|e|^2; any finite number for an edge of length 0, which has no field.

    Field. The factor is

        w = integral of |a + te|^-3 dt over [0, 1] = (|a|+|b|)/(|a||b| D),   D = |a||b| + a.b.

    Near the edge (a.b < 0) the sum D cancels, and is computed as |c|^2/(|a||b| - a.b) instead.

    Second derivatives. The derivative of w c along the axis j is c dw/dx_j - w (axis_j x e). The
    second term is antisymmetric. Around closed curves the fields add up to a gradient, whose
    derivative is symmetric. So the antisymmetric parts cancel, and what remains is

        Hessian = sum over edges of (c grad w^T + grad w c^T)/2.

    Each term is symmetric, and its trace is 0, as c is perpendicular to grad w, which lies in the
    plane of a and e.

    Let h be the vector from x to the nearest point of the edge's *line*, s the position on the line
    from there, and L = |e|. Then

        grad w = 3 integral of (a + te)/|a + te|^5 dt = J h + K e/L^2,
        J = 3/L integral of (h^2+s^2)^(-5/2) ds,   K = 3 integral of s (h^2+s^2)^(-5/2) ds.

    Directly, K = 1/|a|^3 - 1/|b|^3. J is -2 dw/d(h^2) at fixed ends, and the closed form of w gives
    it as a product and sums of positive terms:

        J = w [ ((|a|-|b|)^2 + |a||b|)/(|a||b|)^2 + (|a|+|b|)^2/(|a||b| D) ].

    (The integral written out, s/h^2 (...) between two ends, loses all digits far away and in line
    with the edge.) The difference K of the cubes is computed from
    |b| - |a| = e.(a+b)/(|a|+|b|). h = a - (a.e) e/L^2 cancels where it is short. A fused
    multiply-add rounds it once; the rest of the error lies along e, where a second projection
    removes it. With c = h x e, the three vectors c, h and e stay at right angles.
    """

    a: Vec3
    b: Vec3
    e: Vec3
    inverse_square_length: Real

    @classmethod
    def between(cls, p: Vec3, q: Vec3, inverse: Real, x: Vec3) -> Edge:
        """Make the edge from p to q, relative to a point x. inverse: 1/|q - p|^2."""
        return cls(p - x, q - x, q - p, inverse)

    @functools.cached_property
    def lengths(self) -> tuple[Real, Real]:
        """The distances from x to both ends of the edge: |a|, then |b|."""
        return dr.norm(self.a), dr.norm(self.b)

    @functools.cached_property
    def squared_distance(self) -> Real:
        """The square of the distance from x to the edge."""
        return squared_distance_to_segment(self.a, self.e, self.inverse_square_length)

    def biot_savart(self) -> tuple[Real, Vec3]:
        """Compute the number w and the vector c of the edge's Biot and Savart field w c, which is
        its term of the gradient. w is 0 at points in line with the edge, where c is 0."""
        (la, lb), c = self.lengths, dr.cross(self.a, self.e)
        square = dr.squared_norm(c)
        return dr.select(square > 0, (la + lb) / (la * lb * self._denominator(square)), 0), c

    def biot_savart_of_lengths(self, la: Real, lb: Real) -> tuple[Real, Vec3]:
        """Compute the number w and the vector c of the edge's Biot and Savart field w c, with a
        single division, from known distances of its ends.

        la, lb: |a| and |b|.
        """
        # Near the edge (a.b < 0), numerator and denominator are multiplied by |a||b| - a.b, so that
        # nothing cancels.
        c, product, dot = dr.cross(self.a, self.e), la * lb, dr.dot(self.a, self.b)
        square, is_obtuse = dr.squared_norm(c), dot < 0
        numerator = (la + lb) * dr.select(is_obtuse, product - dot, 1)
        denominator = product * dr.select(is_obtuse, square, product + dot)
        return dr.select(square > 0, numerator / denominator, 0), c

    def hessian_factors(self) -> tuple[Vec3, Vec3]:
        """Compute the vectors c = a x e and grad w, where w c is the edge's Biot and Savart field.
        The edge's term of the Hessian of the solid angle is (c grad w^T + grad w c^T)/2.

        By the formulas of the class docstring grad w = J h + K e/L^2. Here h is the vector from x
        to the nearest point of the edge's line, L = |e|, K = 1/|a|^3 - 1/|b|^3, and J is a product
        of sums of positive terms.

        Lengths should be of order one, to stay far from overflow: at the distance d, the terms fall
        like d^-5 far away and grow like d^-3 near the edge.
        """
        a, e, vector = self.a, self.e, cast("Any", type(self.a))
        # h by two projections; then h_factor = J and e_factor = K/L^2.
        h = dr.fma(vector(-dr.dot(a, e) * self.inverse_square_length), e, a)
        h = dr.fma(vector(-dr.dot(h, e) * self.inverse_square_length), e, h)
        c, (la, lb) = dr.cross(h, e), self.lengths
        inverse_a, inverse_b, total, difference = 1 / la, 1 / lb, la + lb, la - lb
        inverse, ratio = inverse_a * inverse_b, total / self._denominator(dr.squared_norm(c))
        h_factor = (
            inverse
            * inverse
            * ratio
            * (dr.fma(difference * difference, inverse, 1) + total * ratio)
        )
        cube_ratio = inverse * dr.fma(inverse_a, inverse_a, dr.fma(inverse_b, inverse_b, inverse))
        e_factor = dr.dot(e, a + self.b) / total * cube_ratio * self.inverse_square_length
        return c, h_factor * h + e_factor * e

    def _denominator(self, square: Real) -> Real:
        """Compute D = |a||b| + a.b, a factor in the denominator of the edge's field. Near the edge,
        where the sum cancels, it is computed as |c|^2/(|a||b| - a.b).

        square: |c|^2 with c = a x e.
        """
        (la, lb), dot = self.lengths, dr.dot(self.a, self.b)
        return dr.select(dot < 0, square / (la * lb - dot), la * lb + dot)


def edge_variation(square: Real, inverse: Real) -> tuple[Real, Real]:
    """Compute two numbers for an edge of half length h at the distance d from a point: first h/(d
    sqrt(d^2+h^2)), second this number divided by d. Twice the first is an upper bound of the length
    of the edge's Biot and Savart field. Twice the second is an upper bound of the integral of
    |dp|/D^3 along the edge (`LiftedEdge.bounds`).

    square: d^2.
    inverse: 1/(2h)^2.
    """
    first = dr.rsqrt(square * dr.fma(square, 4 * inverse, 1))
    return first, first * dr.rsqrt(square)


# Two complex numbers, as four reals: real and imaginary part of the first, then of the second.
Spinor: TypeAlias = "tuple[Real, Real, Real, Real]"

# Products are scaled after this many factors, without squares: near a vertex or far away, the
# product of a few factors leaves the range of float32.
_RENORMALIZE_EVERY = 2


@dataclass(frozen=True)
class CurveSums:
    """Sums over a closed curve at a point x, from which its solid angle and proved bounds of it are
    computed. D is the distance from x to the point p of the curve.

    angle, gradient: the solid angle, modulo 4 pi, and its gradient.
    distance: the distance from x to the curve, or a lower bound of it.
    inverse_squares, inverse_cubes, inverse_fourths: the integrals of |dp|/D^k along the curve for k
        = 2, 3 and 4, or upper bounds of them.
    """

    angle: Real
    gradient: Vec3
    distance: Real
    inverse_squares: Real
    inverse_cubes: Real
    inverse_fourths: Real

    @classmethod
    def of_factors(
        cls, zr: Real, zi: Real, half_gradient: Vec3, square: Real, quarter: Real, *halves: Real
    ) -> CurveSums:
        """The sums over edges, from what a loop over the edges adds up.

        zr, zi: the product of the edges' factors, whose argument is half the solid angle.
        half_gradient: half the gradient.
        square: the smallest squared distance.
        quarter, halves: a quarter of `inverse_squares`, and half of the other two integrals.
        """
        angle, gradient = 2 * dr.atan2(zi, zr), 2 * half_gradient
        return cls(angle, gradient, dr.sqrt(square), 4 * quarter, *(2 * half for half in halves))

    def plus(self, other: CurveSums) -> CurveSums:
        """The sums over two curves together: this one, and that of `other`."""
        return CurveSums(
            self.angle + other.angle,
            self.gradient + other.gradient,
            fmin(self.distance, other.distance),
            self.inverse_squares + other.inverse_squares,
            self.inverse_cubes + other.inverse_cubes,
            self.inverse_fourths + other.inverse_fourths,
        )

    def select(self, mask: Mask, other: CurveSums) -> CurveSums:
        """The sums `other` on the lanes on which the mask is true, and these sums on all other
        lanes."""
        pairs = zip(vars(other).values(), vars(self).values(), strict=True)
        return CurveSums(*(dr.select(mask, theirs, ours) for theirs, ours in pairs))


def sum_over_edges(edges: LoopEdges, x: Vec3, active: Mask = True) -> CurveSums:
    """Sum over all edges of a curve at points x: its solid angle Omega in (-2 pi, 2 pi], the
    gradient, the distance to the nearest edge, and integrals along the curve (`CurveSums`): an
    upper bound for k = 2, the integral for k = 3, and an upper bound for k = 4.

    x: (3, n), in unit coordinates.
    active: the mask of the lanes to compute.

    Nearly all of the time of tracing a curve is spent in this loop, so it is written for
    throughput: records of eight edges, vertices fetched in aligned packets of eight floats, one
    square root, one division and about eighty additions and multiplications for each edge. Its
    rounding is bounded by `LoopEdges.rounding` and `vertex_rounding`.

    Solid angle. Let a = p - x for a vertex p, and chi_a a spinor of the direction a. Around a
    closed loop, the product of the factors <chi_a, chi_b> of all edges has the argument Omega/2
    (the Berry phase of spin 1/2; it equals the fan formula of van Oosterom and Strackee 1983, Eq.
    10, with the apex at infinity). With s = |a| + |a_z| and A = a_x + i a_y, chi_a is (s, A) for
    a_z >= 0 and (conj A, s) for a_z < 0, so that s does not cancel. The two forms differ by a
    phase, which drops out, because each vertex enters once plain and once conjugated. A factor
    vanishes only on its own edge, whereas a fan of triangles is singular on lines through its apex.

    Gradient. By Biot and Savart's law, each edge adds (1/|a|+1/|b|)/(|a||b|+a.b) a x b (Eq. 11).
    The sum |a||b|+a.b cancels near the edge. It is computed from the squared length of the edge's
    factor, 2 s_a s_b (|a||b|+a.b), which does not cancel.

    Integrals. The field of an edge of length L, whose line is at the distance h, has the length h
    times the integral of |dp|/D^3 along the edge, and |a x b| = h L. So this integral is L times
    the weight of a x b in the gradient. With the distance d to the edge, the integral of |dp|/D^4
    is at most 1/d times it, and the integral of |dp|/D^2 at most 2d times it. Proof of the last:
    write both as integrals over the polar angle at x, measured from the direction of the nearest
    point of the line, from t1 with cos t1 = h/d to t2. Then 2 (sin t2 - sin t1) >= (t2 - t1)
    cos t1, since the difference is concave in t2, 0 at t1, and at pi/2 not less than 0
    (tan(u/2) >= u/2).
    """
    real, x = edges.backend.Float, edges.backend.Array3f(x)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edges in the record `row` to the state, and return the new state. It holds the
        product of factors (zr, zi), half the gradient (g), and the smallest squared distance (d2).
        Then come a quarter of the bound of the integral of |dp|/D^2, and half of the other two
        integrals."""
        zr, zi, g, d2, inverse_squares, inverse_cubes, inverse_fourths = state
        # la: |a|; sa and ca: the number s and the spinor of a. Likewise for b.
        p = edges.vertex(row, 0)
        a = p - x
        la, sa, ca = spinor(a)
        for k in range(edges.edges_per_record):
            q, inverse = edges.vertex(row, k + 1), row[4 * k + 3]
            b = q - x
            lb, sb, cb = spinor(b)
            re, im = inner_product(ca, cb)
            zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
            # Only the argument of the product matters: it is scaled, so that it does not overflow.
            if k % _RENORMALIZE_EVERY == _RENORMALIZE_EVERY - 1:
                scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
                zr, zi = zr * scale, zi * scale
            # Half the weight of a x e = a x b in the gradient; |factor|^2 is re^2 + im^2.
            e = q - p
            weight = (la + lb) * (sa * sb) / (la * lb * dr.fma(re, re, im * im))
            g = dr.fma(type(g)(weight), dr.cross(a, e), g)
            square = squared_distance_to_segment(a, e, inverse)
            d2 = fmin(square, d2)
            term = weight * dr.rsqrt(inverse)  # the weight times the edge's length
            inverse_d = dr.rsqrt(square)
            inverse_cubes, inverse_fourths = (
                inverse_cubes + term,
                dr.fma(term, inverse_d, inverse_fourths),
            )
            inverse_squares = dr.fma(term, square * inverse_d, inverse_squares)
            p, a, la, sa, ca = q, b, lb, sb, cb
        return zr, zi, g, d2, inverse_squares, inverse_cubes, inverse_fourths

    start = (real(1), real(0), type(x)(0), real(dr.inf), real(0), real(0), real(0))
    # The weights are half of the true ones; the bound for k = 2 has another factor of 2.
    return CurveSums.of_factors(*edges.records.for_each(add, start, "edges", active))


def hessian_over_edges(edges: LoopEdges, x: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Compute the three rows of the Hessian of the curve's solid angle at points x (3, n), in one
    loop over the edges."""
    x = edges.backend.Array3f(x)

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge from p to q to the Hessian, whose six entries are the state. inverse: 1/|q -
        p|^2. Returns the new state."""
        return (
            SymmetricMatrix(*state)
            .add_outer_product(*Edge.between(p, q, inverse, x).hessian_factors())
            .components()
        )

    start = SymmetricMatrix.zero(edges.backend.Float).components()
    return SymmetricMatrix(*edges.for_each(add, start, "edge hessian")).rows(type(x))


def inner_product(a: Spinor, b: Spinor) -> tuple[Real, Real]:
    """Compute the inner product <a, b> of two spinors (pairs of complex numbers), conj(a_1) b_1 +
    conj(a_2) b_2. Returns its real and its imaginary part."""
    re = dr.fma(a[0], b[0], dr.fma(a[1], b[1], dr.fma(a[2], b[2], a[3] * b[3])))
    im = dr.fma(a[0], b[1], dr.fma(a[2], b[3], -dr.fma(a[1], b[0], a[3] * b[2])))
    return re, im


def spinor(a: Vec3) -> tuple[Real, Real, Spinor]:
    """Compute for a vector a its length |a|, the number s = |a| + |a_z|, and a spinor of its
    direction. The spinor is a pair of complex numbers, given as four real numbers: (s, a_x + i a_y)
    if a_z >= 0, else (a_x - i a_y, s). Its length is sqrt(2 s |a|)."""
    length = dr.sqrt(dr.fma(a.z, a.z, dr.fma(a.x, a.x, a.y * a.y)))
    s = length + dr.abs(a.z)
    is_up = a.z >= 0
    # Real and imaginary part of the first number, then of the second.
    chi = (
        dr.select(is_up, s, a.x),
        dr.select(is_up, 0, -a.y),
        dr.select(is_up, a.x, s),
        dr.select(is_up, a.y, 0),
    )
    return length, s, chi
