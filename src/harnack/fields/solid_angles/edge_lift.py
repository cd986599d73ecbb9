"""The lifted solid angle of boundary edges. It is a real number, not only known modulo 4 pi, and it
has no jumps along a ray.

The antipodal method (Martens, Trettner and Bessmeltsev 2026) adds up triangles from every edge to
an apex at infinity, opposite to a direction d. Let an edge e run from a to b, relative to x. Its
triangle has the solid angle Omega_e = 2 arg F_e with F_e = (s_a s_b + a'.b') - i (a' x b'). Here a'
is a projected along d (two numbers), and s_a = |a| - a.d. Then

    w(x) = sum of signs of all crossings of the ray from x along d  +  1/(4 pi) sum_e Omega_e(x)

is the winding number of *any* triangles with these boundary edges. For F_e crosses the negative
axis exactly where the ray from x along d passes through e, and there the sum of the signs changes
by as much. As x moves along d itself, that ray only gets shorter. So sum_e Omega_e is continuous
on the whole ray off the edges, and the jumps of w are those of the triangles passed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.fields.batched_fields import SymmetricMatrix
from harnack.fields.clearance import coordinate_rounding
from harnack.fields.solid_angles.edges import Edge, edge_variation, single_edges
from harnack.fields.source_sums import SourceSums, SourceTerm
from harnack.tree.triangle_tree import VerticalRayFrame, edge_function

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.balanced_tree import FloatArray, IntArray
    from harnack.tree.triangle_tree import RayFrame

# The number of edges that each pass through the loop adds. Edges that pad the last pass have length
# and direction 0.
_EDGES_PER_TRIP = 4
# An imaginary part of a factor that would be zero is replaced by plus or minus this number.
_TINY = 1e-36
# Bounds of the rounding of a product's angle Omega = 2 arg, in units of u, the unit roundoff. Each
# factor adds `FACTOR_ROUNDINGS` units, and also `STEEP_ROUNDINGS` units times L e' (see
# `LiftedEdge.bounds`).
#
# Proof. Errors of arguments add up, as each step is compared with the exact product of its rounded
# inputs. (1) `times` multiplies by F: each part of the result is off by at most u times the size of
# a single product and u times itself, the result by 2 u of its length, and scaling it by another u.
# The factor common to both parts does not turn it. (2) F = <chi_a, chi_b>, with chi = (s, a') of
# length sqrt(2 s |a|), and |F| = P c, P = |chi_a||chi_b|, c the cosine of half the angle that the
# edge subtends. By Cauchy and Schwarz no partial sum is more than P. The real part has three
# roundings, of at most u P each, the imaginary part two: F is off by sqrt(13) u P, and turned by
# 3.61 u/c. Together Omega is off by 2 (3 + 3.61/c) u. If the edge subtends at most a right angle,
# 1/c <= sqrt(2): by 16.3 u. If it subtends more, x lies in the ball over it: with length L = 2h and
# distance d <= h, 1/c <= sqrt(d^2 + h^2)/d <= L e', e' = h/(d sqrt(d^2 + h^2)): by 7.3 u L e'
# besides.
FACTOR_ROUNDINGS, STEEP_ROUNDINGS = 16.5, 7.5


@dataclass(frozen=True)
class LiftedEdges:
    """Directed edges on a backend. Each has a record of both ends, its direction and its length
    (`edge_records`)."""

    records: RecordTable

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> LiftedEdges:
        """Upload edges (k, 2) between vertices (n, 3). An edge of weight w is repeated w times."""
        table = edge_records(vertices, edges)
        padding = np.concatenate([table[0, :3], [0.0], table[0, :3], table[0, 7:]])
        return cls(RecordTable.upload(backend, table, padding, _EDGES_PER_TRIP))


def edge_records(vertices: FloatArray, edges: IntArray) -> FloatArray:
    """Records (k, 8) of directed edges (k, 2) between vertices (n, 3): lower end, direction, higher
    end, 1/length^2.

    The lower end is the one with the lower vertex index. Edges of triangles have the same order of
    ends (`tree.triangle_tree`), so that `edge_function` gives the same bits for both. The direction
    is 1 if the edge runs from the lower to the higher index, and -1 if it runs back.
    """
    low, high = vertices[edges.min(axis=1)], vertices[edges.max(axis=1)]
    direction = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    return single_edges(low, high, direction)


@dataclass(frozen=True)
class LiftedEdge:
    """An edge relative to a point x, and to rays of a single direction.

    edge: the edge relative to x.
    ends: its end points in absolute coordinates, in the order of their indices.
    frame: the frame of the rays, which gives coordinates across the rays and along them.
    direction: 1 if the boundary runs from the first end to the second, -1 if it runs back. All
        terms of the edge are multiplied by it.
    """

    edge: Edge
    ends: tuple[Vec3, Vec3]
    frame: RayFrame | VerticalRayFrame
    direction: Real

    @classmethod
    def between(
        cls,
        p: Vec3,
        q: Vec3,
        direction: Real,
        inverse: Real,
        frame: RayFrame | VerticalRayFrame,
        x: Vec3,
    ) -> LiftedEdge:
        """The edge from p to q relative to a point x that lies on a ray of the frame.

        direction: 1 if the boundary runs from p to q, -1 if it runs back.
        inverse: 1/|q-p|^2.
        """
        return cls(Edge.between(p, q, inverse, x), (p, q), frame, direction)

    def factor(self) -> tuple[Real, Real]:
        """Real and imaginary part of the factor F_e, whose argument is half the solid angle of the
        edge's triangle (see the module)."""
        vector, frame, edge = cast("Any", type(self.edge.a)), self.frame, self.edge
        pairs = zip(self.ends, (edge.a, edge.b), strict=True)
        a, b = (vector(*frame.transverse(p), frame.component(a)) for p, a in pairs)
        re, im = edge_factor(a, b, *edge.lengths)
        return re, self.direction * im

    def terms(self, derivatives: int, active: Mask) -> SourceTerm:
        """What the edge adds to the gradient (for `derivatives` >= 1) and to the Hessian (for
        `derivatives` = 2) of the sum of solid angles. It adds 0 on lanes that are not active. The
        value is None, because angles are added up by a product of factors."""
        if derivatives == 0:
            return SourceTerm(None)
        weight, c = self.edge.biot_savart()
        gradient = dr.select(active, self.direction * weight, 0) * c
        if derivatives == 1:
            return SourceTerm(None, gradient)
        c, rate = self.edge.hessian_factors()
        c, rate = dr.select(active, self.direction * c, 0), dr.select(active, rate, 0)
        return SourceTerm(
            None, gradient, SymmetricMatrix.zero(type(c.x)).add_outer_product(c, rate)
        )

    def bounds(self, unit: Real) -> tuple[Real, Real, Real]:
        """Bounds for this edge: of rounding, and of its share in Taylor's remainder.

        unit: a bound of the rounding of a coordinate (`coordinate_rounding`). Coordinates that are
            correctly rounded are off by half of it.

        Returns three numbers. The first bounds the rounding error of Omega_e, the solid angle of
        the edge's triangle, together with the rounding error of multiplying by its factor F_e. The
        other two are the terms that the edge adds to `s4` and `s5` of `SourceSums`.

        Symbols. L = 2a is the edge's length, d its distance from the point x (reduced by its
        rounding), e' = a/(d sqrt(d^2 + a^2)) the local `half_field`, and e = e'/d the local
        `half_integral`.

        Rounding. The ends of the edge, x, and their differences together are off by half a unit.
        This changes the angle by at most that length times Biot and Savart's field, which is at
        most 2e'. The rounding of the number s of an end (see the module) acts as if the end had
        moved by another half unit. Both edges at an end use the same bits of s, so that this
        moves a single point of the boundary. The sums in the factor, and the product, add
        `FACTOR_ROUNDINGS` unit roundoffs, and `STEEP_ROUNDINGS` L e' if the edge subtends more than
        a right angle. The rounding is less than 4 pi in any case.

        Remainder. Let rho be the distance from x to a point p of the edge. At the distance t from x
        the solid angle differs from its linear Taylor polynomial by at most 3/4 t^2 times the
        integral of |dp|/(rho^3 (1 - t/rho)) (`curve_queries.remainder_promises`). Over the edge the
        integral of |dp|/rho^3 is at most 2e, and that of |dp|/rho^4 at most 2e/d. `SourceSums`
        bounds 1/(1 - q), for q = t/rho up to its largest value b, by 1 + q/(1 - b), and adds up the
        two parts with the weights s4 and s5. So the terms e/2 and 3e/(8d) bound the edge's share.
        """
        distance = fmax(dr.sqrt(self.edge.squared_distance) - 2 * unit, 0)
        half_field, half_integral = edge_variation(
            distance * distance, self.edge.inverse_square_length
        )
        factor_rounding = FACTOR_ROUNDINGS * float(dr.epsilon(half_field))
        steep_rounding = (
            STEEP_ROUNDINGS
            * float(dr.epsilon(half_field))
            * dr.rsqrt(self.edge.inverse_square_length)
        )
        rounding = fmin(
            dr.fma(dr.fma(2.0, unit, steep_rounding), half_field, factor_rounding), 4 * dr.pi
        )
        return rounding, 0.5 * half_integral, 0.375 * dr.rcp(distance) * half_integral


@dataclass(frozen=True)
class LiftedSums:
    """Sums over edges and other sources. The angles of the edges are kept as a product of complex
    factors, and are not yet part of the value.

    sums: the value without the angles of edges, the derivatives, and all bounds.
    product: the product of the factors F_e of the edges, whose argument is half the sum of angles.
    """

    sums: SourceSums
    product: LiftedProduct

    @classmethod
    def zero(cls, backend: Backend, derivatives: int) -> LiftedSums:
        """Sums over nothing. derivatives: 0 for the value only, 1 with the gradient, 2 with the
        Hessian."""
        return cls(
            SourceSums.zero(backend, dr.inf, derivatives), LiftedProduct.identity(backend.Float)
        )

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> LiftedSums:
        """The sums from a state of a loop, as the method `parts` returns it."""
        return cls(SourceSums.from_state(parts[0]), LiftedProduct(*parts[1]))

    def parts(self) -> tuple[Any, ...]:
        """The numbers of the sums and of the product as nested tuples, for the state of a loop."""
        return self.sums.to_state(), self.product.parts()

    def add_edge(self, edge: LiftedEdge, unit: Real, active: Mask) -> LiftedSums:
        """The sums with an edge added on active lanes. unit: a bound of the rounding of a
        coordinate."""
        (re, im), terms = edge.factor(), edge.terms(self.sums.derivatives, active)
        sums = self.sums.add_term(terms, True)
        rounding, s4, s5 = edge.bounds(unit)
        # A factor of 1 scales the product, too.
        rounding = dr.select(active, rounding, 2 * float(dr.epsilon(rounding)))
        distance = fmin(dr.sqrt(edge.edge.squared_distance), sums.singularity_distance)
        sums = dataclasses.replace(
            sums,
            rounding=sums.rounding + rounding,
            singularity_distance=dr.select(active, distance, sums.singularity_distance),
            s4=sums.s4 + dr.select(active, s4, 0),
            s5=sums.s5 + dr.select(active, s5, 0),
        )
        factor = dr.select(active, re, 1), dr.select(active, im, 0)
        return LiftedSums(sums, self.product.times(*factor))

    @property
    def angle(self) -> Real:
        """The sum of the solid angles Omega_e of the edges' triangles."""
        return self.product.angle()

    def total(self) -> SourceSums:
        """The sums, with the solid angles of the edges added to the value."""
        return self.sums.add_term(SourceTerm(self.angle), True)


def lifted_sums(edges: LiftedEdges, x: Vec3, derivatives: int) -> LiftedSums:
    """Sums over all edges at points x (3, n), in one loop: the solid angles of the edges' triangles
    with their apex at infinity opposite to the direction d = z, derivatives, and bounds.

    derivatives: 0 for the angle only, 1 with the gradient, 2 with the Hessian. Results that are not
        used are not computed.
    """
    backend, unit = edges.records.backend, coordinate_rounding(x)
    vector = backend.Array3f

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge in the record `row` to the state of the sums."""
        p, q = vector(*row[:3]), vector(*row[4:7])
        edge = LiftedEdge.between(p, q, row[3], row[7], VerticalRayFrame(x), x)
        return LiftedSums.of(state).add_edge(edge, unit, row[3] != 0).parts()

    start = LiftedSums.zero(backend, derivatives).parts()
    return LiftedSums.of(edges.records.for_each(add, start, "lift"))


def edge_rates(edges: LiftedEdges, x: Vec3, derivatives: int) -> SourceSums:
    """The gradient and, for derivatives = 2, the Hessian of the solid angle of closed edges at
    points x (3, n), by Biot and Savart's law. The sums have no value, but the terms `s4` and `s5`,
    by which their errors are bounded."""
    backend, unit = edges.records.backend, coordinate_rounding(x)
    vector = backend.Array3f

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge in the record `row` to the state of the sums."""
        p, q, active = vector(*row[:3]), vector(*row[4:7]), row[3] != 0
        edge = LiftedEdge.between(p, q, row[3], row[7], VerticalRayFrame(x), x)
        sums = SourceSums.from_state(state).add_term(edge.terms(derivatives, active), True)
        _, s4, s5 = edge.bounds(unit)
        s4, s5 = (dr.select(active, bound, 0) for bound in (s4, s5))
        return dataclasses.replace(sums, s4=sums.s4 + s4, s5=sums.s5 + s5).to_state()

    start = SourceSums.zero(backend, dr.inf, derivatives).to_state()
    return SourceSums.from_state(edges.records.for_each(add, start, "rates of edges"))


@dataclass(frozen=True)
class VertexView:
    """A vertex as seen from a point x on a ray.

    offset: the vector from x to the vertex.
    length: the length of the offset.
    u, v: the vertex's two coordinates relative to the ray, across its direction.
    s: the length minus the component of the offset along the ray.
    """

    offset: Vec3
    length: Real
    u: Real
    v: Real
    s: Real


def view_vertex(p: Vec3, frame: RayFrame, x: Vec3) -> VertexView:
    """The vertex p as seen from the point x on a ray of the frame."""
    offset = p - x
    length = dr.norm(offset)
    u, v = frame.transverse(p)
    a = cast("Any", type(x))(u, v, frame.component(offset))
    return VertexView(offset, length, u, v, _length_less_axial(a, length))


def edge_factor_of_views(a: VertexView, b: VertexView, direction: Real) -> tuple[Real, Real]:
    """Real and imaginary part of the factor F_e = (s_a s_b + a'.b') - i (a' x b') of the edge from
    a to b, whose argument is half the solid angle of the edge's triangle (see the module).

    direction: positive if a has the lower vertex index, else negative. The cross product a' x b' is
        computed from the ends in the order of their indices. So all computations of the same edge
        get the same bits, and agree on which side of the ray the edge passes.
    """
    rises = direction > 0
    low, high = (dr.select(rises, a.u, b.u), dr.select(rises, a.v, b.v)), (
        dr.select(rises, b.u, a.u), dr.select(rises, b.v, a.v)
    )  # fmt: skip
    re, im = _factor(low, high, a.s, b.s)
    return re, dr.select(rises, im, -im)


def edge_factor(a: Vec3, b: Vec3, la: Real, lb: Real) -> tuple[Real, Real]:
    """Real and imaginary part of the factor F_e of the edge from a to b, whose argument is half the
    solid angle of the edge's triangle (see the module).

    a, b: the ends relative to a point x, as (u, v, z), with two coordinates across the direction d
        and the coordinate along it.
    la, lb: |a| and |b|.

    s_a is computed as |a'|^2/(|a| + a.d) where a.d > 0, so that nothing cancels.
    """
    return _factor((a.x, a.y), (b.x, b.y), _length_less_axial(a, la), _length_less_axial(b, lb))


def _factor(a: tuple[Real, Real], b: tuple[Real, Real], sa: Real, sb: Real) -> tuple[Real, Real]:
    """Real and imaginary part of the factor F_e = (sa sb + a.b) - i (a x b) of an edge.

    a, b: the coordinates (u, v) of both ends relative to the ray, across its direction d.
    sa, sb: for both ends, the distance from x minus the component along d.

    A ray that passes exactly through an edge or a vertex is treated as if its v were smaller by an
    infinitesimal amount, and its u by a much smaller infinitesimal amount.
    `tree.triangle_tree.signed_crossing` uses the same rule for crossings.
    """
    real, (au, av), (bu, bv) = cast("Any", type(sa)), a, b
    on_ray = (au == 0) & (av == 0), (bu == 0) & (bv == 0)
    ax, bx = dr.select(on_ray[0], real(-1e-18), au), dr.select(on_ray[1], real(-1e-18), bu)
    im = -edge_function((ax, av), (bx, bv))
    re = dr.fma(sa, sb, dr.fma(ax, bx, av * bv))
    tie = dr.select(av == bv, ax - bx, bv - av)
    # Only the sign of a real factor matters. The factor may be so small that it would be no larger
    # than the number that stands for its imaginary part.
    is_real = im == 0
    re = dr.select(is_real, dr.select((re < 0) & ~(on_ray[0] & on_ray[1]), real(-1), 1), re)
    return re, dr.select(is_real, dr.mulsign(real(_TINY), tie), im)


def _length_less_axial(a: Vec3, length: Real) -> Real:
    """s = |a| - a.d, without cancellation, of a vector a = (u, v, z) with z along the direction d.
    length: |a|."""
    square = dr.fma(a.x, a.x, a.y * a.y)
    return dr.select(a.z > 0, square / (length + a.z), length - a.z)


@dataclass(frozen=True)
class LiftedProduct:
    """A product of complex factors, scaled to a length of about 1, with the sum of their arguments.

    re, im: real and imaginary part of the product.
    turns: the number of full turns by which the sum of the factors' arguments is larger than the
        argument of re + i im.
    """

    re: Real
    im: Real
    turns: Real

    @classmethod
    def identity(cls, real: Any) -> LiftedProduct:
        """The product of no factors. real: the type of its numbers."""
        return cls(real(1), real(0), real(0))

    def parts(self) -> tuple[Real, Real, Real]:
        """The attributes in the order of the constructor, for the state of a loop."""
        return self.re, self.im, self.turns

    def times(self, re: Real, im: Real) -> LiftedProduct:
        """The product with a further factor re + i im.

        Arguments lie in (-pi, pi]. If the arguments of both factors have different signs, the
        argument of the product is their sum. Otherwise the sum has left the interval exactly if the
        product's imaginary part has the other sign. That is so for two factors of argument -pi/2:
        their sum -pi counts as pi and one turn less.
        """
        new_re = dr.fma(self.re, re, -(self.im * im))
        new_im = dr.fma(self.re, im, self.im * re)
        scale = dr.rcp(dr.abs(new_re) + dr.abs(new_im))
        unit = type(new_re)(1)
        new_im = dr.select(new_im == 0, 0, new_im)  # no zero with a sign, which would be -pi
        # The sum can leave the interval only if one of the arguments is at least pi/2 in size;
        # testing for this keeps underflow from counting.
        may_wrap = (self.re <= 0) | (re <= 0)
        turns_up = dr.select((self.im >= 0) & (im >= 0) & (new_im < 0) & may_wrap, unit, 0)
        turns_down = dr.select((self.im < 0) & (im < 0) & (new_im >= 0) & may_wrap, unit, 0)
        is_finite = dr.isfinite(scale)
        return LiftedProduct(
            dr.select(is_finite, new_re * scale, self.re),
            dr.select(is_finite, new_im * scale, self.im),
            self.turns + turns_up - turns_down,
        )

    def angle(self) -> Real:
        """Twice the sum of the factors' arguments: the sum of the edges' solid angles."""
        return 2 * dr.fma(2 * dr.pi, self.turns, dr.atan2(self.im, self.re))
