"""The lifted solid angle of the boundary edges of a mesh. A solid angle is known only modulo 4 pi;
the lifted one is a real number that has no jumps along a ray. It is the sum over the edges of the
solid angle Omega_e of the triangle from the edge to an apex at infinity, opposite to the ray's
direction d (the antipodal method, Martens, Trettner and Bessmeltsev 2026). Omega_e is twice the
argument of a complex number, the edge's factor F_e, so that the sum is twice the argument of the
product of all factors. x is a point on a ray.

Let an edge e run from a to b, relative to x. Its factor is F_e = (s_a s_b + a'.b') - i (a' x b').
Here a' is a projected along d (two numbers), and s_a = |a| - a.d. Then

    w(x) = sum of signs of all crossings of the ray from x along d  +  1/(4 pi) sum_e Omega_e(x)

is the winding number of *any* triangles with these boundary edges. The crossings are those of the
ray with these triangles. Proof: F_e crosses the negative axis exactly where the ray from x along d
passes through e, and there the sum of the signs changes by as much. As x moves along d, its ray
only gets shorter. So sum_e Omega_e is continuous on the whole ray off the edges, and w jumps only
at the triangles that x passes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.fmm.edges import Edge, edge_variation, single_edges
from harnack.fmm.point_values import LoopRecord, SymmetricMatrix
from harnack.fmm.source_sums import SourceSums, SourceTerm
from harnack.fmm.unit_frame import coordinate_rounding
from harnack.tree.triangle_tree import VerticalRayFrame, edge_function

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.balanced_tree import FloatArray, IntArray
    from harnack.tree.triangle_tree import RayFrame

# The number of edges that each pass of the loop over edges adds. Edges that pad the last pass have
# length and direction 0.
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
# The error of the scale is common to both parts and does not turn the result.
# (2) F = <chi_a, chi_b>, with chi = (s, a') of length sqrt(2 s |a|). Its length is |F| = P c, with
# P = |chi_a||chi_b| and the cosine c of half the angle that the edge subtends. By Cauchy and
# Schwarz no partial sum is more than P. The real part has three roundings, of at most u P each, the
# imaginary part two: F is off by sqrt(13) u P, and turned by 3.61 u/c. Together Omega is off by
# 2 (3 + 3.61/c) u. If the edge subtends at most a right angle, 1/c <= sqrt(2), and this is 16.3 u.
# If it subtends more, x lies in the ball over it: with length L = 2h and distance d <= h,
# 1/c <= sqrt(d^2 + h^2)/d <= L e' with e' = h/(d sqrt(d^2 + h^2)), so Omega is also off by
# 7.3 u L e'.
FACTOR_ROUNDINGS, STEEP_ROUNDINGS = 16.5, 7.5


@dataclass(frozen=True)
class LiftedEdges:
    """Directed boundary edges on a backend, for lifted solid angles: sums over edges that are real
    numbers, not only known modulo 4 pi. Each edge has a record of its ends, its direction, and one
    over its squared length (`edge_records`)."""

    records: RecordTable

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> LiftedEdges:
        """Upload directed edges to a backend.

        vertices: (n, 3).
        edges: (k, 2) the indices of start and end of each edge. An edge that counts w times occurs
            w times.
        """
        table = edge_records(vertices, edges)
        # Loops over the records take `_EDGES_PER_TRIP` in each trip. The last trip is filled up
        # with an edge from a vertex to itself, with direction 0, which adds nothing.
        padding = np.concatenate([table[0, :3], [0.0], table[0, :3], table[0, 7:]])
        return cls(RecordTable.upload(backend, table, padding, _EDGES_PER_TRIP))


def edge_records(vertices: FloatArray, edges: IntArray) -> FloatArray:
    """Make records (k, 8) of directed edges. A record holds the end with the lower vertex index
    (3,), the direction, the end with the higher index (3,), and 1/length^2. The direction is 1 if
    the edge runs from the lower to the higher index, and -1 if it runs back.

    vertices: (n, 3).
    edges: (k, 2) the indices of start and end of each edge.

    The tree of triangles (`tree.triangle_tree`) has the same order of ends for the edges of its
    triangles. So `edge_function` gives the same bits for an edge here and there.
    """
    low, high = vertices[edges.min(axis=1)], vertices[edges.max(axis=1)]
    direction = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    return single_edges(low, high, direction)


@dataclass(frozen=True)
class LiftedEdge:
    """A boundary edge relative to a point x on a ray. Its solid angle Omega_e is that of the
    triangle from the edge to an apex at infinity, opposite to the ray's direction. Its factor F_e
    is a complex number whose argument is half of Omega_e.

    edge: the edge relative to x.
    ends: its end points in absolute coordinates, in the order of their indices.
    frame: the frame of rays of a single direction, which gives coordinates across the rays and
        along them.
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
        """Make the edge from p to q relative to a point x that lies on a ray of the frame.

        direction: 1 if the boundary runs from p to q, -1 if it runs back.
        inverse: 1/|q-p|^2.

        p, q: the end with the lower vertex index, and the other end.
        """
        return cls(Edge.between(p, q, inverse, x), (p, q), frame, direction)

    def factor(self) -> tuple[Real, Real]:
        """Compute the real and the imaginary part of the edge's factor F_e, a complex number whose
        argument is half the solid angle of the edge's triangle."""
        # a, b: the ends relative to x, as two coordinates across the ray and one along it, in the
        # frame of the ray.
        vector, frame, edge = cast("Any", type(self.edge.a)), self.frame, self.edge
        pairs = zip(self.ends, (edge.a, edge.b), strict=True)
        a, b = (vector(*frame.transverse(p), frame.component(a)) for p, a in pairs)
        re, im = edge_factor(a, b, *edge.lengths)
        return re, self.direction * im

    def terms(self, derivatives: int, active: Mask) -> SourceTerm:
        """Compute what the edge adds to the derivatives of the sum of solid angles, by Biot and
        Savart's law.

        derivatives: 0 for none, 1 for the gradient, 2 for the Hessian as well.
        active: the mask of the lanes on which the edge counts; it adds 0 on the others.

        The value of the result is None, because angles are added up by a product of factors.
        """
        if derivatives == 0:
            return SourceTerm(None)
        weight, c = self.edge.biot_savart()
        gradient = dr.select(active, self.direction * weight, 0) * c
        if derivatives == 1:
            return SourceTerm(None, gradient)
        # The term of the Hessian is (c rate^T + rate c^T)/2, as `add_outer_product` adds it.
        c, rate = self.edge.hessian_factors()
        c, rate = dr.select(active, self.direction * c, 0), dr.select(active, rate, 0)
        return SourceTerm(
            None, gradient, SymmetricMatrix.zero(type(c.x)).add_outer_product(c, rate)
        )

    def bounds(self, unit: Real) -> tuple[Real, Real, Real]:
        """Compute bounds of what the edge adds to the rounding error of the sum of solid angles,
        and to the remainder of this sum beyond its linear Taylor polynomial.

        unit: a bound of the rounding of a coordinate (`coordinate_rounding`). Coordinates that are
            correctly rounded are off by half of it.

        Returns three numbers. The first bounds the rounding error of Omega_e, the solid angle of
        the edge's triangle, together with the rounding error of multiplying by its factor F_e. The
        other two are the terms that the edge adds to `s4` and `s5` of `SourceSums`.

        Symbols. L = 2a is the edge's length, d its distance from the point x (reduced by its
        rounding), e' = a/(d sqrt(d^2 + a^2)), and e = e'/d. In the code e' is `half_field`, and e
        is `half_integral`.

        Rounding. The ends of the edge, x, and their differences together are off by half a unit.
        This changes the angle by at most that length times the edge's Biot and Savart field, which
        is at most 2e'. The factor also contains, for each end, the number s: the distance of the
        end from x, minus its component along the ray. Rounding of s acts as if the end had moved by
        another half unit. Both edges at an end use the same bits of s, so that this moves a single
        point of the boundary. The sums in the factor, and the product, add
        `FACTOR_ROUNDINGS` unit roundoffs, and `STEEP_ROUNDINGS` L e' unit roundoffs if the edge
        subtends more than a right angle. An angle is off by less than 4 pi in any case.

        Remainder. Let rho be the distance from x to a point p of the edge. At the distance t from x
        the solid angle differs from its linear Taylor polynomial by at most 3/4 t^2 times the
        integral of |dp|/(rho^3 (1 - t/rho)) (`curve_queries.remainder_promises`). Over the edge the
        integral of |dp|/rho^3 is at most 2e, and that of |dp|/rho^4 at most 2e/d. `SourceSums`
        bounds 1/(1 - q), for q = t/rho up to its largest value b, by 1 + q/(1 - b), and adds up the
        two parts with the weights s4 and s5. So the terms e/2 and 3e/(8d) bound the edge's share.
        """
        # factor_rounding is a bound by itself; steep_rounding is multiplied by e'. `dr.epsilon` is
        # the unit roundoff, half the distance from 1 to the next number.
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
        # Two moves by half a unit, times a field of at most 2 e'.
        rounding = fmin(
            dr.fma(dr.fma(2.0, unit, steep_rounding), half_field, factor_rounding), 4 * dr.pi
        )
        return rounding, 0.5 * half_integral, 0.375 * dr.rcp(distance) * half_integral

    def add_to(
        self, sums: SourceSums, product: LiftedProduct, unit: Real, active: Mask
    ) -> tuple[SourceSums, LiftedProduct]:
        """Add the edge on active lanes to sums and to a product of factors of edges, and return
        both. On other lanes they stay as they are. The solid angle of the edge is in the product
        and not in the sums (`LiftedProduct.add_angle_to`).

        unit: a bound of the rounding of a coordinate.
        """
        # On other lanes the terms are 0.
        (re, im), terms = self.factor(), self.terms(sums.derivatives, active)
        sums = sums.add_term(terms, True)
        rounding, s4, s5 = self.bounds(unit)
        # On other lanes the product is multiplied by 1; scaling it again may round it.
        rounding = dr.select(active, rounding, 2 * float(dr.epsilon(rounding)))
        distance = fmin(dr.sqrt(self.edge.squared_distance), sums.singularity_distance)
        sums = dataclasses.replace(
            sums,
            rounding=sums.rounding + rounding,
            singularity_distance=dr.select(active, distance, sums.singularity_distance),
            s4=sums.s4 + dr.select(active, s4, 0),
            s5=sums.s5 + dr.select(active, s5, 0),
        )
        return sums, product.times(dr.select(active, re, 1), dr.select(active, im, 0))


def lifted_sums(edges: LiftedEdges, x: Vec3, derivatives: int) -> SourceSums:
    """Sum over all edges at points x (3, n), in one loop: the lifted solid angle for rays in the
    direction d = z, its derivatives, and bounds of errors and remainder.

    derivatives: 0 for the angle only, 1 with the gradient, 2 with the Hessian. Results that are not
        used are not computed.
    """
    backend, unit = edges.records.backend, coordinate_rounding(x)
    vector = backend.Array3f
    # dr.inf: the distance of the nearest edge before any is added.
    no_sums = SourceSums.zero(backend, dr.inf, derivatives)
    no_factors = LiftedProduct.identity(backend.Float)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge in the record `row` to the state, which is that of the sums without angles,
        and of the product of the edges' factors. Returns the new state. `unit` bounds the rounding
        of a coordinate."""
        p, q = vector(*row[:3]), vector(*row[4:7])
        # Padding has the direction row[3] = 0 and is not active.
        edge = LiftedEdge.between(p, q, row[3], row[7], VerticalRayFrame(x), x)
        sums, product = no_sums.with_state(state[0]), no_factors.with_state(state[1])
        sums, product = edge.add_to(sums, product, unit, row[3] != 0)
        return sums.to_state(), product.to_state()

    start = no_sums.to_state(), no_factors.to_state()
    sums, product = edges.records.for_each(add, start, "lift")
    return no_factors.with_state(product).add_angle_to(no_sums.with_state(sums))


def edge_rates(edges: LiftedEdges, x: Vec3, derivatives: int) -> SourceSums:
    """Compute the derivatives, without the value, of the solid angle of closed boundary edges at
    points x (3, n), by Biot and Savart's law.

    derivatives: 1 for the gradient, 2 with the Hessian.

    Returns sums without a value; `s4` and `s5` bound the errors of the derivatives.
    """
    backend, unit = edges.records.backend, coordinate_rounding(x)
    vector = backend.Array3f
    # dr.inf: the distance of the nearest edge before any is added.
    no_sums = SourceSums.zero(backend, dr.inf, derivatives)

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Add the edge in the record `row` to the sums, given as a state (`SourceSums.to_state`). A
        record that is padding has the direction 0 and adds nothing. Returns the new state."""
        # `unit` of the enclosing function bounds the rounding of a coordinate.
        p, q, active = vector(*row[:3]), vector(*row[4:7]), row[3] != 0
        edge = LiftedEdge.between(p, q, row[3], row[7], VerticalRayFrame(x), x)
        # On other lanes the terms are 0.
        sums = no_sums.with_state(state).add_term(edge.terms(derivatives, active), True)
        _, s4, s5 = edge.bounds(unit)
        s4, s5 = (dr.select(active, bound, 0) for bound in (s4, s5))
        return dataclasses.replace(sums, s4=sums.s4 + s4, s5=sums.s5 + s5).to_state()

    return no_sums.with_state(edges.records.for_each(add, no_sums.to_state(), "rates of edges"))


@dataclass(frozen=True)
class VertexView:
    """A vertex of a boundary edge as seen from a point x on a ray.

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
    """Compute how the vertex p is seen from the point x on a ray of the frame."""
    offset = p - x
    length = dr.norm(offset)
    u, v = frame.transverse(p)
    a = cast("Any", type(x))(u, v, frame.component(offset))
    return VertexView(offset, length, u, v, _length_less_axial(a, length))


def edge_factor_of_views(a: VertexView, b: VertexView, direction: Real) -> tuple[Real, Real]:
    """Compute the real and the imaginary part of the factor F_e = (s_a s_b + a'.b') - i (a' x b')
    of the edge from a to b. Its argument is half the solid angle of the edge's triangle. Here a'
    and b' are the two coordinates (u, v) of the ends across the ray, and s_a and s_b the numbers
    `s` of their `VertexView`s. a' x b' is the number a'_u b'_v - a'_v b'_u.

    a, b: the ends of the edge, as seen from x.
    direction: which end comes first in the order of vertex indices: positive if it is a, negative
        if it is b. It is not the direction of the ray. The cross product a' x b' is computed from
        the ends in the order of their indices. So all computations of the same edge get the same
        bits, and agree on which side of the ray the edge passes.
    """
    rises = direction > 0
    low, high = (dr.select(rises, a.u, b.u), dr.select(rises, a.v, b.v)), (
        dr.select(rises, b.u, a.u), dr.select(rises, b.v, a.v)
    )  # fmt: skip
    re, im = _factor(low, high, a.s, b.s)
    return re, dr.select(rises, im, -im)


def edge_factor(a: Vec3, b: Vec3, la: Real, lb: Real) -> tuple[Real, Real]:
    """Compute the real and the imaginary part of the factor F_e of the edge from a to b. The
    argument of F_e is half the solid angle of the edge's triangle (see the module).

    a, b: the ends relative to a point x, as (u, v, z), with two coordinates across the direction d
        and the coordinate along it.
    la, lb: |a| and |b|.

    The number s_a = |a| - a.d is computed as |a'|^2/(|a| + a.d) where a.d > 0, so that nothing
    cancels. a' is a without its component along d.
    """
    return _factor((a.x, a.y), (b.x, b.y), _length_less_axial(a, la), _length_less_axial(b, lb))


def _factor(a: tuple[Real, Real], b: tuple[Real, Real], sa: Real, sb: Real) -> tuple[Real, Real]:
    """Compute the real and the imaginary part of the factor F_e = (sa sb + a.b) - i (a x b) of an
    edge from a to b. Here a x b is the number a_u b_v - a_v b_u. The argument of F_e is half the
    solid angle of the edge's triangle (see the module).

    a, b: the coordinates (u, v) of both ends relative to the ray, across its direction d.
    sa, sb: for both ends, the distance from x minus the component along d.

    The imaginary part is never zero, so that its sign always tells on which side of the ray the
    edge passes. A ray that passes exactly through an edge or a vertex is treated as if its v were
    smaller by an infinitesimal amount, and its u by a much smaller infinitesimal amount.
    `tree.triangle_tree.signed_crossing` uses the same rule for crossings.
    """
    real, (au, av), (bu, bv) = cast("Any", type(sa)), a, b
    # An end that lies on the ray is moved off it, by far less than rounding.
    on_ray = (au == 0) & (av == 0), (bu == 0) & (bv == 0)
    ax, bx = dr.select(on_ray[0], real(-1e-18), au), dr.select(on_ray[1], real(-1e-18), bu)
    im = -edge_function((ax, av), (bx, bv))
    re = dr.fma(sa, sb, dr.fma(ax, bx, av * bv))
    # The sign of the imaginary part after the infinitesimal move of the ray, if it is zero now.
    tie = dr.select(av == bv, ax - bx, bv - av)
    # Only the sign of a real factor matters, and it may be smaller than `_TINY`. So it is replaced
    # by 1 or -1; by 1 also if both ends lie on the ray.
    is_real = im == 0
    re = dr.select(is_real, dr.select((re < 0) & ~(on_ray[0] & on_ray[1]), real(-1), 1), re)
    return re, dr.select(is_real, dr.mulsign(real(_TINY), tie), im)


def _length_less_axial(a: Vec3, length: Real) -> Real:
    """Compute s = |a| - a.d, without cancellation, for a vector a = (u, v, z), whose z is its
    component a.d along the direction d. length: |a|."""
    square = dr.fma(a.x, a.x, a.y * a.y)
    return dr.select(a.z > 0, square / (length + a.z), length - a.z)


@dataclass(frozen=True)
class LiftedProduct(LoopRecord):
    """A product of the complex factors of edges, together with the sum of their arguments, which is
    a real number and not only known modulo 2 pi. The product is scaled to a length of about 1.

    re, im: real and imaginary part of the product.
    turns: the number of full turns by which the sum of the factors' arguments is larger than the
        argument of re + i im.
    """

    re: Real
    im: Real
    turns: Real

    @classmethod
    def identity(cls, real: Any) -> LiftedProduct:
        """Make the product of no factors, which is 1. real: the type of its numbers."""
        return cls(real(1), real(0), real(0))

    def times(self, re: Real, im: Real) -> LiftedProduct:
        """Multiply by a further factor re + i im, and return the new product. If the product is 0
        or overflows, so that it cannot be scaled, re and im of the old product are kept.

        Arguments lie in (-pi, pi]. If the arguments of both factors have different signs, the
        argument of the product is their sum. Otherwise the sum has left the interval exactly if the
        product's imaginary part has the other sign. (So two factors of argument -pi/2 have the
        product -1 of argument pi, with one turn less, as their arguments add up to -pi.)
        """
        new_re = dr.fma(self.re, re, -(self.im * im))
        new_im = dr.fma(self.re, im, self.im * re)
        scale = dr.rcp(dr.abs(new_re) + dr.abs(new_im))
        turn = type(new_re)(1)
        new_im = dr.select(new_im == 0, 0, new_im)  # no zero with a sign, which would be -pi
        # The sum can leave the interval only if one of the arguments is at least pi/2 in size;
        # testing for this keeps underflow from counting.
        may_wrap = (self.re <= 0) | (re <= 0)
        turns_up = dr.select((self.im >= 0) & (im >= 0) & (new_im < 0) & may_wrap, turn, 0)
        turns_down = dr.select((self.im < 0) & (im < 0) & (new_im >= 0) & may_wrap, turn, 0)
        is_finite = dr.isfinite(scale)
        return LiftedProduct(
            dr.select(is_finite, new_re * scale, self.re),
            dr.select(is_finite, new_im * scale, self.im),
            self.turns + turns_up - turns_down,
        )

    def angle(self) -> Real:
        """Compute twice the sum of the factors' arguments, which is the sum of the edges' solid
        angles."""
        return 2 * dr.fma(2 * dr.pi, self.turns, dr.atan2(self.im, self.re))

    def add_angle_to(self, sums: SourceSums) -> SourceSums:
        """Add the sum of the edges' solid angles to the value of `sums`."""
        return sums.add_term(SourceTerm(self.angle()), True)
