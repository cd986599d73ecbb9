"""The solid angle of edges as a real number that follows a direction: no jumps along rays.

The antipodal method (Martens, Trettner and Bessmeltsev 2026): with the apex of every edge's
triangle at infinity against the direction d, an edge e from a to b (seen from x) has the solid
angle Omega_e = 2 arg F_e with F_e = (s_a s_b + a'.b') - i (a' x b'), where a' is a seen along d
(two numbers) and s_a = |a| - a.d. Then

    w(x) = turns of all crossings of the ray from x along d  +  1/(4 pi) sum_e Omega_e(x)

is the winding number of *any* triangles with these boundary edges: F_e crosses the negative axis
exactly where the ray from x along d passes through e, and there the crossings change by as much.
As x moves along d itself, that ray only gets shorter, so that sum_e Omega_e is continuous on the
whole ray off the edges, and the jumps of w are those of the triangles passed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.backend.records import Records
from harnack.fields.edges.edge_field import edge_field, edge_variation
from harnack.fields.edges.edge_hessian import edge_rates
from harnack.fields.edges.edge_records import single_edges
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree.nearest import squared_distance_to_segment
from harnack.tree.triangles import Upwards, side

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, IntArray

# Edges a trip of the loop; those that fill the last one have no length and no direction.
_CHUNK = 4
# Where an edge is nowhere near the ray, its factor has this for an imaginary part of zero.
_TINY = 1e-36


@dataclass(frozen=True)
class LiftedEdges:
    """Directed edges on the device, one packet each: see `edge_records`."""

    records: Records

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> LiftedEdges:
        """Edges (k, 2) between vertices (n, 3); weights are repetitions."""
        table = edge_records(vertices, edges)
        nothing = np.concatenate([table[0, :3], [0.0], table[0, :3], table[0, 7:]])
        return cls(Records.upload(backend, table, nothing, _CHUNK))


def edge_records(vertices: FloatArray, edges: IntArray) -> FloatArray:
    """(k, 8) for directed edges (k, 2): lower end, direction, higher end, 1/length^2.

    The ends are ordered by vertex index, as those of triangles are (`tree.triangles`), so that
    `side` gives the same bits here and there; direction is 1 if the edge runs from lower to
    higher, -1 if it runs back.
    """
    low, high = vertices[edges.min(axis=1)], vertices[edges.max(axis=1)]
    direction = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    return single_edges(low, high, direction)


@dataclass(frozen=True)
class LiftedSums:
    """Sum over all edges of Omega_e and its derivatives, as far as they were asked for.

    rounding, s4, s5: what bounds their rounding, in units in the last place of a coordinate; see
    `rounding_of_edge` and `nearby.Nearby`.
    """

    angle: Real
    gradient: Vec3
    hessian: SymmetricSum
    rounding: Real
    s4: Real
    s5: Real


def lifted_sums(edges: LiftedEdges, x: Vec3, derivatives: int) -> LiftedSums:
    """All sums at points x in one loop over the edges, for the direction d = z.

    What of the result nobody uses is not computed.

    derivatives: 0 for the angle alone, 1 with the gradient, 2 with the Hessian.

    The angles are added up as a product of factors and a count of how often it goes round. s_a
    is taken as |a'|^2/(|a| + a.d) where a.d > 0, so that nothing cancels.
    """
    real, vector = edges.records.backend.Float, edges.records.backend.Array3f

    def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        return _with_edge(row, x, derivatives, *state)

    sums = (vector(0), *SymmetricSum.zero(real).parts())[: (0, 1, 7)[derivatives]]
    product, bounds = LiftedProduct.one(real).parts(), (real(0), real(0), real(0))
    product, bounds, *rest = edges.records.for_each(add, (product, bounds, *sums), "lift")
    return LiftedSums(
        LiftedProduct(*product).angle(),
        rest[0] if derivatives >= 1 else vector(0),
        SymmetricSum(*rest[1:]) if derivatives == 2 else SymmetricSum.zero(real),
        *bounds,
    )


def _with_edge(
    row: Any, x: Vec3, derivatives: int, product: tuple[Real, Real, Real],
    bounds: tuple[Real, Real, Real], *sums: Any,
) -> Any:  # fmt: skip
    """The sums with the edge of a record added."""
    vector, direction = cast("Any", type(x)), row[3]
    p, q = vector(row[0], row[1], row[2]), vector(row[4], row[5], row[6])
    a, b, frame = p - x, q - x, Upwards(x)
    la, lb = dr.norm(a), dr.norm(b)
    seen = vector(*frame.across(p), a.z), vector(*frame.across(q), b.z)
    re, im = edge_factor(*seen, la, lb)
    product = LiftedProduct(*product).times(re, direction * im).parts()
    square = squared_distance_to_segment(a, b - a, row[7])
    bounds = with_edge(bounds, square, row[7], epsilon_at(x), direction != 0)
    if derivatives == 0:
        return product, bounds
    c, weight = edge_field(a, b, la, lb)
    g = dr.fma(vector(direction * weight), c, sums[0])
    if derivatives == 1:
        return product, bounds, g
    # The edge itself and not b - a, which far away is mostly rounding.
    e = vector(row[4] - row[0], row[5] - row[1], row[6] - row[2])
    u, v = edge_rates(a, e, row[7])
    return product, bounds, g, *SymmetricSum(*sums[1:]).plus(direction * u, v).parts()


def rounding_of_edge(first: Real, unit: Real) -> Real:
    """What rounding may do to the solid angle of an edge.

    first: of `edge_variation`. unit: the rounding of a coordinate, `epsilon_at`, which is twice
    what correct rounding does. The ends of the edge, x and their differences are off by half a
    unit together, and the angle by that times Biot and Savart's field, which is at most 2 first;
    the roundings of the factor F_e are as if its ends had moved by another half, for those of its
    terms are |F_e| times a few over the cosine of half the angle that the edge is seen at, and the
    same bits of an end serve both edges there. It is less than 4 pi in any case.
    """
    return fmin(2 * unit * first, 4 * dr.pi)


def with_edge(
    bounds: tuple[Real, Real, Real], square: Real, inverse: Real, unit: Real, active: Mask
) -> tuple[Real, Real, Real]:
    """Sums of `rounding_of_edge` and of what an edge adds to s4 and s5 of `nearby.Nearby`.

    square, inverse: as for `edge_variation`. Along a line the k-th
    derivative of an edge's field is at most the integral of k!/rho^(k+1) over it (Biot and
    Savart), so that Taylor's remainder after the linear term is at most that of
    t^2/(rho^3 (1-t/rho)). With a = L/2 and distance d an edge has int rho^-3 <=
    2a/(d^2 sqrt(d^2+a^2)) =: 2e, int rho^-4 <= 2e/d; and 1/(1-q) <= 1 + q/(1-b) <= 1 + q rise/4
    on [0, b] (`Nearby.sample`). So an edge adds to the remainder what s4 += 2e/3 and
    s5 += e/(2d) do. d is less by what rounding may have done to it.
    """
    rounding, s4, s5 = bounds
    distance = fmax(dr.sqrt(square) - 2 * unit, 0)
    first, e = edge_variation(distance * distance, inverse)
    first, e, closer = (dr.select(active, one, 0) for one in (first, e, dr.rcp(distance)))
    return (
        rounding + rounding_of_edge(first, unit),
        dr.fma(2 / 3, e, s4),
        dr.fma(0.5 * closer, e, s5),
    )


def edge_factor(a: Vec3, b: Vec3, la: Real, lb: Real) -> tuple[Real, Real]:
    """F_e of the edge from a to b, seen as (u, v, z): across the direction, and along it.

    A ray exactly through an edge or a vertex is decided as `tree.triangles.crossing` does: as if
    it passed at v, and then u, infinitely little below zero.
    """
    real = cast("Any", type(la))
    in_line = (a.x == 0) & (a.y == 0), (b.x == 0) & (b.y == 0)
    ax, bx = dr.select(in_line[0], real(-1e-18), a.x), dr.select(in_line[1], real(-1e-18), b.x)
    im = -side((ax, a.y), (bx, b.y))
    re = dr.fma(_s(a, la), _s(b, lb), dr.fma(ax, bx, a.y * b.y))
    tie = dr.select(a.y == b.y, ax - bx, b.y - a.y)
    # Of a real factor the sign counts alone. Left as small as it may be, it would be no longer than
    # what stands for its imaginary part.
    straight = im == 0
    re = dr.select(straight, dr.select((re < 0) & ~(in_line[0] & in_line[1]), real(-1), 1), re)
    return re, dr.select(straight, dr.mulsign(real(_TINY), tie), im)


def _s(a: Vec3, length: Real) -> Real:
    across = dr.fma(a.x, a.x, a.y * a.y)
    return dr.select(a.z > 0, across / (length + a.z), length - a.z)


@dataclass(frozen=True)
class LiftedProduct:
    """A product re + i im of factors, of length about one, and how often it has gone round."""

    re: Real
    im: Real
    turns: Real

    @classmethod
    def one(cls, real: Any) -> LiftedProduct:
        """Of no factors; real: the type of its numbers."""
        return cls(real(1), real(0), real(0))

    def parts(self) -> tuple[Real, Real, Real]:
        """In the order of the constructor, as loops want them."""
        return self.re, self.im, self.turns

    def times(self, re: Real, im: Real) -> LiftedProduct:
        """With one factor more.

        Arguments lie in (-pi, pi]; that of the product is their sum if they have different signs;
        otherwise the sum has left the interval exactly if its imaginary part has the other sign.
        That of two factors of -pi/2 has: it is -pi, which is pi and a turn less.
        """
        pr = dr.fma(self.re, re, -(self.im * im))
        pi = dr.fma(self.re, im, self.im * re)
        scale = dr.rcp(dr.abs(pr) + dr.abs(pi))
        one = type(pr)(1)
        pi = dr.select(pi == 0, 0, pi)  # no zero with a sign, which would be -pi
        # One of them is then no shorter than pi/2; to ask for it keeps an underflow from counting.
        left = (self.re <= 0) | (re <= 0)
        over = dr.select((self.im >= 0) & (im >= 0) & (pi < 0) & left, one, 0)
        under = dr.select((self.im < 0) & (im < 0) & (pi >= 0) & left, one, 0)
        some = dr.isfinite(scale)
        return LiftedProduct(
            dr.select(some, pr * scale, self.re),
            dr.select(some, pi * scale, self.im),
            self.turns + over - under,
        )

    def angle(self) -> Real:
        """The solid angle: twice the sum of arguments."""
        return 2 * dr.fma(2 * dr.pi, self.turns, dr.atan2(self.im, self.re))
