"""The solid angle of long boundaries along rays: far chains of edges as a chord and a small loop.

The chord of a chain from a to b and the loop that runs along the chain and back along the chord
have the same edges as the chain together. So, in the terms of `edge_lift`,

    sum_{e in chain} Omega_e(x) = Omega_ab(x) + sum_{e in loop} Omega_e(x),

and for any triangles P with the loop for a boundary the last sum is their solid angle less 4 pi
times the turns of their crossings with the ray from x along d. P can lie in the convex hull of the
chain. Where that ray misses a ball around it there are no crossings, and where x is far from the
ball the solid angle is a multipole expansion: one node of a tree does for all of its edges, and
their number costs only where the ray passes the boundary closely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.fields.chain_tree import RATIO, chain_columns, chain_leaves
from harnack.fields.edge_field import edge_field
from harnack.fields.edge_lift import (
    LiftedProduct,
    edge_factor,
    edge_records,
    epsilon_at,
    with_edge,
)
from harnack.fields.edge_trails import closed_trails
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.nearby import Nearby, free_part, with_far_node
from harnack.tree import Node, PackedTree, for_each, pack, walk
from harnack.tree.nearest import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, IntArray
    from harnack.tree.triangles import Frame


@dataclass(frozen=True)
class EdgeChains:
    """Closed trails of edges on a backend, in a tree of chains, in units of about their size."""

    backend: Backend
    tree: PackedTree

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> EdgeChains:
        """Directed edges (k, 2) between vertices (n, 3), as often out of a vertex as into it."""
        leaves = chain_leaves(vertices, closed_trails(edges))
        tree = leaves.hierarchy()
        levels = [chain_columns(leaves, nodes, vertices, backend.epsilon) for nodes in tree.counts]
        records = tree.gather(edge_records(vertices, leaves.edges))
        return cls(backend, pack(backend, tree, levels, records))

    def near(self, frame: Frame, x: Vec3, detail: Real) -> Nearby:
        """The sum of Omega_e at points x of rays, and what a certificate needs.

        detail: `Field.at_detail`; 1 leaves out no more than rounding does. Edges add to the
        remainder what `edge_lift.with_edge` says, and so do chords: none is nearer than the ball
        around its chain.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        pad, close = 16 * unit, fmax(real(detail), real(1))

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            centre, radius = vector(*node.head[:3]), node.head[3] + pad
            r = x - centre
            square, (u, v) = dr.squared_norm(r), frame.across(centre)
            missed = (dr.fma(u, u, v * v) > radius * radius) | (dr.dot(r, frame.d) > radius)
            accepting = dr.select(detail < 1, node.head[4], node.head[5] * close)
            far = missed & (square > dr.square(accepting))
            inverse = dr.select(far, dr.rsqrt(square), 0)
            c, decay = node.payload(far), dr.square(inverse * inverse) * inverse
            sums = with_far_node(
                state[1:], far_terms(c, r, inverse, 1), far, inverse,
                dr.fma(c[18], inverse * inverse, c[17]),
                (c[15] * decay, c[16] * decay * inverse),
                free_part(RATIO) * (square * inverse), unit,
            )  # fmt: skip
            state = (state[0], *sums)
            chord = vector(*c[19:22]), vector(*c[22:25])
            state = _with_edge(frame, x, chord, (real(1), c[25], unit), far & (c[25] > 0), state)
            return ~far, for_each(node, ~far & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            ends, way = (vector(*row[:3]), vector(*row[4:7])), row[3]
            # A slot without an edge has no direction.
            return _with_edge(frame, x, ends, (way, row[7], unit), active & (way != 0), state)

        one, zero = LiftedProduct.one(real).parts(), real(0)
        start = (one, zero, vector(0), zero, zero, zero, real(dr.inf), zero, zero)
        product, value, *rest = walk(self.tree, visit, start)
        return Nearby(self.backend, value + LiftedProduct(*product).angle(), *rest)


def _with_edge(
    frame: Frame, x: Vec3, ends: tuple[Vec3, Vec3], more: tuple[Real, ...], active: Mask,
    state: tuple[Any, ...],
) -> tuple[Any, ...]:  # fmt: skip
    """The sums with the edge between `ends` added.

    more: 1 or -1 for its way; 1/length^2; and how far rounding moves a coordinate.
    """
    product, value, g, truncation, slope_truncation, rounding, clear, s4, s5 = state
    vector, (p, q), (way, inverse, unit) = cast("Any", type(x)), ends, more
    a, b = p - x, q - x
    la, lb = dr.norm(a), dr.norm(b)
    seen_a = vector(*frame.across(p), dr.dot(a, frame.d))
    seen_b = vector(*frame.across(q), dr.dot(b, frame.d))
    re, im = edge_factor(seen_a, seen_b, la, lb)
    re, im = dr.select(active, re, 1), dr.select(active, way * im, 0)
    product = LiftedProduct(*product).times(re, im).parts()
    c, weight = edge_field(a, b, la, lb)
    slope = dr.select(active, (way * weight) * c, 0)
    square = squared_distance_to_segment(a, b - a, inverse)
    rounding, s4, s5 = with_edge((rounding, s4, s5), square, inverse, unit, active)
    clear = dr.select(active, fmin(dr.sqrt(square), clear), clear)
    return product, value, g + slope, truncation, slope_truncation, rounding, clear, s4, s5
