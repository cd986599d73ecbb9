"""FMM cells of curves. A curve consists of closed loops of straight edges; f is its solid angle at
a point x. The cells are the leaves of an octree over a cube around the curve. The ball of a cell is
a ball around the cell, and the near edges of a cell are those within three radii of its ball from
its center. In each cell f is the direct sum over the near edges, plus a local expansion (a harmonic
polynomial) for all far edges. So the cost of a sample depends only on the number of near edges. In
integrals along edges, D is the distance from x to the point p of an edge, and |dp| the length
element.

Near loops. The near edges of a cell form runs of consecutive edges. An open run has no solid angle,
so each run is closed to a loop by two closing edges, from its ends to a further vertex, its apex
(`edge_runs`). The remaining edges then form a cycle far away, whose solid angle has a single value
in the cell. Closing edges count in values, but not in the proved bounds of f near a point, which
are about the curve.

Expansions. Each far edge by itself gives a harmonic function: the integral of the edge's Biot and
Savart field along the line from the center (`edge_expansion`). So truncation errors are proved edge
by edge, and no coefficient is fitted to samples. A cell inherits the expansion of its parent, and
adds the edges that were near to the parent and are far from its own ball. `curve_cell_builder`
builds the cells.

Accuracy. The cells have accuracy scale 1; for a larger scale all edges are summed. Cells are so
small that fewer than 1 % of all samples need that sum, because a lane that sums over all edges
delays its packet. Extents of curves with cells have few planes: with 1,024 vertices, clipping at
the hull took three times as long as tracing the rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.backend.elementary import fmin
from harnack.fmm.edge_expansion import COEFFICIENTS, DEGREE
from harnack.fmm.edge_lift import LiftedProduct, edge_factor_of_views, view_vertex
from harnack.fmm.edges import CurveSums, Edge, inner_product, spinor
from harnack.fmm.local_expansion import evaluate_expansion
from harnack.fmm.source_sums import SUM_MARGIN
from harnack.fmm.trail_sums import add_edge_rates
from harnack.tree.closest_triangles import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.fmm.edge_lift import VertexView
    from harnack.fmm.trail_sums import RayLine
    from harnack.tree.octree_lookup import OctreeLookup
    from harnack.tree.triangle_tree import RayFrame

# The number of entries of a cell's record before the coefficients, and the number of vertices in a
# record of near edges.
HEADER_SIZE, VERTICES_PER_RECORD = 15, 2
# Areas below this many roundings do not tell on which side of a line an edge passes.
_SIDE_ROUNDINGS = 64.0
# Rates along lines are bounded for lengths up to this fraction of the distance to far edges.
_LINE_FRACTION = 0.5


@dataclass(frozen=True)
class CurveCellSums:
    """The sums over all edges of a curve at a point x, computed in the cell that contains x: by a
    direct sum over the cell's near edges, and a polynomial (the expansion) for its far edges. D is
    the distance from x to the point p of an edge.

    sums: solid angle, gradient, distance and integrals, as `edges.sum_over_edges` gives them; here
        the distance is a lower bound, and the integrals are upper bounds.
    error, slope_error: bounds of the truncation errors of the expansion, in value and gradient.
    rounding: a bound of the rounding error of the value, to which that of `edges.vertex_rounding`
        has to be added.
    expansion_gradient: (3,) the gradient of the expansion at x.
    far_i3: an upper bound of the integral of |dp|/D^3 over the far edges.
    far_distance: a lower bound of the distance from x to the far edges.
    near_first, count: the index of the cell's first record of near edges, and the number of its
        records.
    cell, center: the index of the cell, and its center (3,).
    expansion_change: the value of the expansion at x minus its value at the center.
    """

    sums: CurveSums
    error: Real
    slope_error: Real
    rounding: Real
    expansion_gradient: Vec3
    far_i3: Real
    far_distance: Real
    near_first: Any
    count: Any
    cell: Any
    center: Vec3
    expansion_change: Real


@dataclass(frozen=True)
class CurveCells:
    """The FMM cells of a curve on a backend. A cell has a list of near edges, in closed loops, and
    for all far edges a local expansion: a harmonic polynomial in the offset from the cell's center.
    Closing edges close the runs of near edges to loops; they are not edges of the curve.

    lookup: the octree whose leaves are the cells.
    records: one record per cell. In this order it holds: the cell's center (3,), and one over the
        radius of its ball; bounds of the truncation errors of value and gradient, and of the
        rounding of the value; a lower bound of the distance of the far edges from the center; the
        factor that multiplies `CurveSums.inverse_squares` of the near edges; an upper bound of the
        integral of |dp|/D^3 over the far edges, with D the distance from the center, and the
        gradient (3,) of this integral by the center; the index of the first record of near edges,
        and the number of these records; and after these `HEADER_SIZE` numbers the coefficients of
        the expansion.
    near: records of two vertices each. For each vertex a record holds its position (3,) and a
        number for the edge that leads to it: one over the squared length of this edge, negative
        for closing edges, and 0 if there is no edge.
    count, size: the number of cells, and the number of bytes that they take.
    """

    backend: Backend
    lookup: OctreeLookup
    records: RecordTable
    near: RecordTable
    count: int
    size: int

    def centers(self) -> FloatArray:
        """Read the centers (count, 3) of the cells. Numbers of the backend hold them exactly."""
        row = self.records.read_record(dr.arange(self.backend.UInt32, self.count))
        return to_numpy(self.backend.Array3f(*row[:3])).astype(np.float64)

    def sums(self, x: Vec3, active: Mask) -> tuple[CurveCellSums, Mask]:
        """Sum over all edges of the curve at points x, by the near edges and the expansion of the
        cell that contains x.

        x: (3, n).
        active: the mask of the lanes to compute.

        Returns the sums, and the mask of the lanes on which they are valid: the active lanes whose
        point lies in the cube of the cells.

        Proof of the bound of I3, the integral of |dp|/D^3 over far edges, at the point x = c + u.
        It follows from I3 and its gradient at the center c. For a point p of an edge, let
        D = |p - c|, s the cosine of the angle between u and p - c, and q = |u|/D. The integrand at
        p is D^-3 (1 - 2 q s + q^2)^(-3/2) = D^-3 sum of C_j(s) q^j, with Gegenbauer's polynomials
        C_j, which are largest at s = 1. The first two terms give the value and the gradient at the
        center. The others are at most (1-q)^-3 - 1 - 3q = q^2 psi(q), with
        psi = (6 - 8q + 3q^2)/(1-q)^3, which grows with q.

        Rounding moves x by less than 2.25 epsilon (1 + |x|). This changes the polynomial by at most
        its gradient times that; for near edges `edges.vertex_rounding` counts it.
        """
        vector, index = self.backend.Array3f, self.backend.UInt32
        cell, inside = self.lookup.find_leaf(x)
        active = active & inside
        row = self.records.read_record(cell, active)
        # The columns of `records`. inverse: 1/radius of the cell's ball. far_least: the least
        # distance of a far edge from the center. row[10:13]: the gradient of I3 at the center.
        # row[13] and row[14]: the first record of near edges, and their number.
        inverse, error, slope_error, rounding, far_least, factor, inverse_cubes = row[3:10]
        center = vector(*row[:3])
        u = x - center
        # The constant is added last, so that the polynomial's rounding stays small, and the
        # change from the center is known without it.
        constant, *rest = row[HEADER_SIZE : HEADER_SIZE + COEFFICIENTS]
        polynomial = [self.backend.Float(0), *rest]
        value, *slopes = evaluate_expansion(polynomial, [*(u * inverse)], DEGREE)
        slope = inverse * vector(*slopes)
        bound = dr.norm(slope) + slope_error
        # An error of x of at most 2.25 epsilon (1 + |x|) changes the value by at most that length
        # times the bound of the gradient.
        rounding = dr.fma(2.25 * self.backend.machine_epsilon * (1 + dr.norm(x)), bound, rounding)
        first, count = index(row[13]), dr.select(active, index(row[14]), 0)
        near = self._sum_near(x, first, count)
        # The bound of I3 at x (see the proof), with 1/(1 - q) = least/(least - |u|).
        distance = dr.norm(u) * (1 + SUM_MARGIN)
        q, far_free = distance / far_least, far_least - distance
        least_over_free = far_least / far_free
        psi = dr.fma(q, dr.fma(3, q, -8), 6) * least_over_free * least_over_free * least_over_free
        far_i3 = dr.fma(inverse_cubes, dr.fma(dr.square(q), psi, 1), dr.dot(u, vector(*row[10:13])))
        sums = CurveSums(
            near.angle + (constant + value),
            near.gradient + slope,
            fmin(near.distance, far_free),
            near.inverse_squares * factor,
            near.inverse_cubes + far_i3,
            near.inverse_fourths + far_i3 / far_free,
        )
        # The other attributes of `CurveCellSums`, in their order.
        details = (
            error,
            slope_error,
            rounding,
            slope,
            far_i3,
            far_free,
            first,
            count,
            cell,
            center,
            value,
        )
        return CurveCellSums(sums, *details), active

    def change_from_center(
        self, cell_sums: CurveCellSums, frame: RayFrame, x: Vec3, unit: Real, active: Mask
    ) -> tuple[Real, Mask]:
        """Compute the change of the solid angle from the cell's center to x, followed continuously
        along the line between them.

        cell_sums: the result of `sums` at x.
        frame: the frame of the rays from the center to x.
        x: (3, n) points in cells.
        unit: a bound of the rounding of a coordinate.
        active: the mask of the lanes to compute.

        Returns the change; and the mask of the lanes on which it is certain, that is, on which
        rounding does not leave it open on which side of the line an edge passes.

        Proof. The far edges contribute the polynomial, everywhere in the ball. The near loops are
        closed, so that the sum over their edges in `edge_lift` is their solid angle; it has no
        jumps on the line, as long as the line meets no edge. A coordinate across the line is off by
        at most eight units of the distances of the edge's ends. The real and the imaginary part of
        an edge's factor are off by that times the coordinates of the ends. Only for factors near
        the negative real axis it is then open in which direction they turn.
        """
        vector = self.backend.Array3f
        center, no_factors = cell_sums.center, LiftedProduct.identity(self.backend.Float)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Multiply two products of edge factors, one at x and one at the cell's center, by the
            factors of the near edges in the record `row` of the cell, as seen along the rays
            `frame` from the center to x. `unit` bounds the rounding of a coordinate.

            state: the vertex before the record; the mask of the lanes on which no rounding has
                mattered so far; the product at x, and the product at the center.

            Returns the new state.
            """
            p, is_certain, *products = state
            at_x, at_center = (no_factors.with_state(product) for product in products)
            a, a_center = view_vertex(p, frame, x), view_vertex(p, frame, center)
            for k in range(VERTICES_PER_RECORD):
                q, inverse = vector(*row[4 * k : 4 * k + 3]), row[4 * k + 3]
                b, b_center = view_vertex(q, frame, x), view_vertex(q, frame, center)
                # (u, v): the coordinates of a vertex across the ray.
                offset = dr.abs(b.u) + dr.abs(b.v)
                is_certain &= offset > _SIDE_ROUNDINGS * unit  # off the vertex
                slack = _SIDE_ROUNDINGS * unit * (offset + dr.abs(a.u) + dr.abs(a.v))
                # inverse is 0 if no edge leads to q.
                at_x, sure_x = _with_edge(at_x, a, b, inverse != 0, slack)
                at_center, sure_center = _with_edge(
                    at_center, a_center, b_center, inverse != 0, slack
                )
                is_certain &= sure_x & sure_center
                a, a_center, p = b, b_center, q
            return p, is_certain, at_x.to_state(), at_center.to_state()

        # No edge leads to the first vertex: the vertex before it may be any.
        start = vector(0), self.backend.Bool(active), *(2 * [no_factors.to_state()])
        near = self.near.view(cell_sums.near_first, dr.select(active, cell_sums.count, 0))
        _, is_certain, *products = near.for_each(add, start, "from the center")
        at_x, at_center = (no_factors.with_state(product) for product in products)
        return at_x.angle() - at_center.angle() + cell_sums.expansion_change, is_certain

    def rates_along(
        self, cell_sums: CurveCellSums, line: RayLine, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """Bound the size of the derivative of the solid angle along a line, on several parts of the
        line: for each length T, at all points within T of x in both directions.

        cell_sums: the result of `sums` at x.
        line: the line through x = line.x, with the unit direction v = line.v.
        lengths: the lengths T.
        active: the mask of the lanes to compute.

        Returns a tuple with one bound for each length (as `trail_sums.line_rates`); it is infinite
        where nothing is proved, and on lanes that are not active.

        Proof. The derivative is at most the sum of the bounds of its parts from all edges. For near
        edges of the curve these are the bounds of `add_edge_rates`. Let H be the Biot and Savart
        field, at x, of all other edges of the curve. The polynomial is the solid angle of these
        edges and of the closing edges, run backwards. So H is the gradient of the polynomial, up to
        `slope_error`, plus the fields of the closing edges in the near loops. At x + sv the other
        edges change the angle by at most |s||H . v| + s^2/2 K for |s| <= r. Here r is half the
        distance d of the far edges. K is the constant of `curve_queries.remainder_promises` for
        q = 1/2, which is 3/2 (I3 + d I4) with the integrals I3 and I4 of |dp|/D^3 and |dp|/D^4 over
        the far edges, and so at most 3 I3.
        """
        vector, x = self.backend.Array3f, line.x

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the near edges in the record `row` of the cell. The state holds the vertex before
            the record; a field, to which a closing edge adds its Biot and Savart field; and the
            bounds along `line` for all `lengths`, to which an edge of the curve adds
            (`add_edge_rates`). Returns the new state."""
            p, field, *rates = state
            for k in range(VERTICES_PER_RECORD):
                q, inverse = vector(*row[4 * k : 4 * k + 3]), row[4 * k + 3]
                # inverse > 0 marks edges of the curve, inverse < 0 closing edges.
                edge = Edge.between(p, q, dr.select(inverse > 0, inverse, 1), x)
                new_rates = add_edge_rates(line, edge, lengths, tuple(rates))
                pairs = zip(new_rates, rates, strict=True)
                rates = [dr.select(inverse > 0, new, old) for new, old in pairs]
                # The field is the number w times the vector c.
                w, c = edge.biot_savart()
                field = field + dr.select(inverse < 0, w * c, 0)
                p = q
            return p, field, *rates

        # No edge leads to the first vertex: the vertex before it may be any.
        zeros = (self.backend.Float(0) for _ in lengths)
        start = vector(0), cell_sums.expansion_gradient, *zeros
        near = self.near.view(cell_sums.near_first, dr.select(active, cell_sums.count, 0))
        _, field, *rates = near.for_each(add, start, "near edges along")
        # A bound of |H . v|, with the field H of the proof.
        slope = dr.abs(dr.dot(field, line.v)) + cell_sums.slope_error
        slope = slope + SUM_MARGIN * cell_sums.sums.inverse_squares  # for rounding
        half_k = (1 + SUM_MARGIN) * 1.5 * cell_sums.far_i3  # K/2
        valid_length = _LINE_FRACTION * cell_sums.far_distance
        return tuple(
            dr.select(
                active & (length <= valid_length), rate + dr.fma(length, half_k, slope), dr.inf
            )
            for rate, length in zip(rates, lengths, strict=True)
        )

    def _sum_near(self, x: Vec3, first: Any, count: Any) -> CurveSums:
        """Sum over the near loops of a cell at points x (3, n): solid angle, gradient, distance and
        integrals, by the formulas of `edges.sum_over_edges`. Closing edges do not count in the
        distance, in `inverse_cubes` and in `inverse_fourths`, which are about the curve.

        first, count: the index of the cell's first record of near edges, and the number of its
            records.
        """
        real, vector = self.backend.Float, self.backend.Array3f

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the edges in the record `row` of the cell to the state. It holds the product of
            factors (zr, zi), half the gradient (g), the smallest squared distance (d2), a quarter
            of the first integral and half of the other two. Then, for the last vertex, come its
            position p, the vector a = p - x, |a|, and the number s and the spinor of a
            (`edges.spinor`). Returns the new state."""
            zr, zi, g, d2, inverse_squares, inverse_cubes, inverse_fourths, p, a, la, sa, *ca = (
                state
            )
            # The steps of `edges.sum_over_edges`, on lanes on which an edge leads to q. on_curve:
            # it is an edge of the curve, and not a closing edge.
            for k in range(VERTICES_PER_RECORD):
                q, inverse = vector(*row[4 * k : 4 * k + 3]), row[4 * k + 3]
                b = q - x
                lb, sb, cb = spinor(b)
                re, im = inner_product((ca[0], ca[1], ca[2], ca[3]), cb)
                e, is_edge, on_curve = q - p, inverse != 0, inverse > 0
                weight = (la + lb) * (sa * sb) / (la * lb * dr.fma(re, re, im * im))
                weight = dr.select(is_edge, weight, 0)
                re, im = dr.select(is_edge, re, 1), dr.select(is_edge, im, 0)
                zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
                g = dr.fma(vector(weight), dr.cross(a, e), g)
                inverse_square = dr.select(is_edge, dr.abs(inverse), 1)
                square = squared_distance_to_segment(a, e, inverse_square)
                term, inverse_d = weight * dr.rsqrt(inverse_square), dr.rsqrt(square)
                inverse_squares = inverse_squares + dr.select(is_edge, term * square * inverse_d, 0)
                d2 = dr.select(on_curve, fmin(square, d2), d2)
                inverse_cubes = inverse_cubes + dr.select(on_curve, term, 0)
                inverse_fourths = inverse_fourths + dr.select(on_curve, term * inverse_d, 0)
                p, a, la, sa, ca = q, b, lb, sb, cb
            scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
            zr, zi = zr * scale, zi * scale
            integrals = inverse_squares, inverse_cubes, inverse_fourths
            return zr, zi, g, d2, *integrals, p, a, la, sa, *ca

        # The last vertex is arbitrary at the start, as no edge leads to the first vertex.
        unit, zero = real(1), real(0)
        start = (unit, zero, vector(0), real(dr.inf), zero, zero, zero, vector(0), vector(1), unit,
                 unit, unit, zero, zero, zero)  # fmt: skip
        sums = self.near.view(first, count).for_each(add, start, "near edges")
        # As in `edges.sum_over_edges`, the weights were half of the true ones.
        return CurveSums.of_factors(*sums[:7])


def _with_edge(
    product: LiftedProduct, a: VertexView, b: VertexView, is_edge: Mask, slack: Real
) -> tuple[LiftedProduct, Mask]:
    """Multiply a product of edge factors by the factor of the edge from a to b.

    a, b: the ends of the edge, as seen from a point on a ray.
    is_edge: the mask of the lanes on which there is an edge; others keep their product.
    slack: a bound of the rounding of the factor's real and imaginary part.

    Returns the new product, and the mask of the lanes on which rounding cannot change the sign of
    the factor's argument: the factor is farther than `slack` from the negative real axis, or there
    is no edge.
    """
    # 1: all edges count as running from the lower index to the higher one.
    re, im = edge_factor_of_views(a, b, type(slack)(1))
    is_sure = ~is_edge | (dr.abs(im) > slack) | (re > slack)
    return product.times(dr.select(is_edge, re, 1), dr.select(is_edge, im, 0)), is_sure
