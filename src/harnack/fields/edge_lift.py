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

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import aligned
from harnack.backend.extrema import fmin
from harnack.fields.edge_field import edge_field, edge_variation
from harnack.fields.edge_hessian import SymmetricSum, edge_rates
from harnack.tree.nearest import squared_distance_to_segment
from harnack.tree.triangles import side

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, IntArray

# Edges a trip of the loop; those that fill the last one have no length and no direction.
_CHUNK = 4
# Where an edge is nowhere near the ray, its factor has this for an imaginary part of zero.
_TINY = 1e-36


@dataclass(frozen=True)
class LiftedEdges:
    """Directed edges on the device, one packet each: lower end, direction, higher end, 1/length^2.

    The ends are ordered by vertex index, as those of triangles are (`tree.triangles`), so that
    `side` gives the same bits here and there; direction is 1 if the edge runs from lower to
    higher, -1 if it runs back.
    """

    backend: Backend
    buffer: Any
    trips: Any

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> LiftedEdges:
        """Edges (k, 2) between vertices (n, 3); weights are repetitions."""
        low, high = vertices[edges.min(axis=1)], vertices[edges.max(axis=1)]
        direction = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)[:, None]
        square = ((high - low) ** 2).sum(axis=1, keepdims=True)
        table = np.concatenate([low, direction, high, 1 / np.maximum(square, 1e-300)], axis=1)
        padding = np.tile(table[:1], (-len(table) % _CHUNK, 1))
        padding[:, 4:7], padding[:, 3] = padding[:, :3], 0.0
        values = np.concatenate([table, padding]).ravel()
        cast = values.astype(np.float32) if backend.precision == "single" else values
        return cls(
            backend, aligned(backend, cast), dr.opaque(backend.UInt32, -(-len(edges) // _CHUNK))
        )


@dataclass(frozen=True)
class LiftedSums:
    """Sums over all edges at x, as far as they were asked for, in the coordinates of the frame.

    angle: sum of Omega_e; gradient, hessian: its derivatives; distance: to the nearest edge;
    first, second: sums of a/(d sqrt(d^2+a^2)) and of the same over d, as in `edge_sums`.
    """

    angle: Real
    gradient: Vec3
    hessian: SymmetricSum
    distance: Real
    first: Real
    second: Real


def lifted_sums(
    edges: LiftedEdges, place: Callable[[Vec3], Vec3], *, derivatives: int, variation: bool
) -> LiftedSums:
    """All sums in one loop over the edges.

    place: gives a vertex as (u, v, z) seen from x: across the direction, and along it.
    derivatives: 0 for the angle alone, 1 with the gradient, 2 with the Hessian.

    The angles are added up as a product of factors and a count of how often it goes round. s_a
    is taken as |a'|^2/(|a| + a.d) where a.d > 0, so that nothing cancels.
    """
    backend = edges.backend
    real, vector = backend.Float, backend.Array3f

    def body(i: Any, *state: Any) -> Any:
        for j in range(_CHUNK):
            row = dr.gather(backend.ArrayXf, edges.buffer, i * _CHUNK + j, shape=(8, 1))
            state = _with_edge(vector, row, place, derivatives, variation, *state)
        return i + 1, *state

    def more(i: Any, *_: Any) -> Mask:
        return i < edges.trips

    sums = (vector(0), *SymmetricSum.zero(real).parts())[: (0, 1, 7)[derivatives]]
    winding, sizes = (real(1), real(0), real(0)), (real(dr.inf), real(0), real(0))
    start = (backend.UInt32(0), winding, sizes, *sums)
    _, (zr, zi, turns), (d2, s1, s2), *rest = dr.while_loop(start, more, body, label="lift")
    return LiftedSums(
        whole_angle(zr, zi, turns),
        rest[0] if derivatives >= 1 else vector(0),
        SymmetricSum(*rest[1:]) if derivatives == 2 else SymmetricSum.zero(real),
        dr.sqrt(d2),
        s1,
        s2,
    )


def _with_edge(
    vector: Any, row: Any, place: Callable[[Vec3], Vec3], derivatives: int, variation: bool,
    winding: Any, sizes: Any, *sums: Any,
) -> Any:  # fmt: skip
    """The sums with the edge of a record added."""
    direction, inverse = row[3], row[7]
    a, b = place(vector(row[0], row[1], row[2])), place(vector(row[4], row[5], row[6]))
    la, lb = dr.norm(a), dr.norm(b)
    re, im = edge_factor(a, b, la, lb)
    im = direction * im
    zr, zi, turns = winding
    winding = times(zr, zi, turns, re, im)
    if derivatives >= 1:
        c, weight = edge_field(a, b, la, lb)
        g = dr.fma(vector(direction * weight), c, sums[0])
        rest = sums[1:]
        if derivatives == 2:
            u, v = edge_rates(a, b - a, inverse)
            rest = SymmetricSum(*rest).plus(direction * u, v).parts()
        sums = (g, *rest)
    if variation:
        d2, s1, s2 = sizes
        square = squared_distance_to_segment(a, b - a, inverse)
        first, second = edge_variation(square, inverse)
        sizes = fmin(square, d2), s1 + first, s2 + second
    return winding, sizes, *sums


def edge_factor(a: Vec3, b: Vec3, la: Real, lb: Real) -> tuple[Real, Real]:
    """F_e of the edge from a to b.

    A ray exactly through an edge or a vertex is decided as `tree.triangles.crossing` does: as if
    it passed at v, and then u, infinitely little below zero.
    """
    real = cast("Any", type(la))
    in_line = (a.x == 0) & (a.y == 0), (b.x == 0) & (b.y == 0)
    ax, bx = dr.select(in_line[0], real(-1e-18), a.x), dr.select(in_line[1], real(-1e-18), b.x)
    im = -side((ax, a.y), (bx, b.y))
    re = dr.fma(_s(a, la), _s(b, lb), dr.fma(ax, bx, a.y * b.y))
    re = dr.select(in_line[0] & in_line[1], 1, re)
    tie = dr.select(a.y == b.y, ax - bx, b.y - a.y)
    return re, dr.select(im == 0, dr.mulsign(real(_TINY), tie), im)


def _s(a: Vec3, length: Real) -> Real:
    across = dr.fma(a.x, a.x, a.y * a.y)
    return dr.select(a.z > 0, across / (length + a.z), length - a.z)


def times(zr: Real, zi: Real, turns: Real, re: Real, im: Real) -> tuple[Real, Real, Real]:
    """The product z (re + i im), of length about one, and how often it has gone round.

    Arguments lie in (-pi, pi]; that of the product is their sum if they have different signs;
    otherwise the sum has left the interval exactly if its imaginary part has the other sign.
    """
    pr, pi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
    scale = dr.rcp(dr.abs(pr) + dr.abs(pi))
    one = type(zr)(1)
    # One of them is then longer than pi/2; to ask for it keeps an underflow from counting.
    left = (zr < 0) | (re < 0)
    over = dr.select((zi >= 0) & (im >= 0) & (pi < 0) & left, one, 0)
    under = dr.select((zi < 0) & (im < 0) & (pi >= 0) & left, one, 0)
    some = dr.isfinite(scale)
    return (
        dr.select(some, pr * scale, zr),
        dr.select(some, pi * scale, zi),
        turns + over - under,
    )


def whole_angle(zr: Real, zi: Real, turns: Real) -> Real:
    """The solid angle of a product of factors that `times` made."""
    return 2 * dr.fma(2 * dr.pi, turns, dr.atan2(zi, zr))
