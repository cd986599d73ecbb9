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

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.fields.edges.edge_field import edge_field
from harnack.fields.edges.edge_lift import LiftedProduct, edge_factor, edge_records, with_edge
from harnack.fields.edges.edge_passing import with_edge_rates
from harnack.fields.meshes.chain_tree import RATIO, chain_columns, chain_leaves
from harnack.fields.meshes.edge_trails import closed_trails
from harnack.fields.multipoles.multipole_kernel import far_terms
from harnack.fields.multipoles.nearby import Nearby, Sums, free_part, with_far_node
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import Node, PackedTree, for_each, pack, walk
from harnack.tree.nearest import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.edges.edge_passing import Line
    from harnack.tree.hierarchy import FloatArray, IntArray
    from harnack.tree.triangles import Frame

# An edge's ends, 1 or -1 for its way and 1/length^2, and where it counts, added to sums.
AddEdge: TypeAlias = "Callable[[tuple[Vec3, Vec3], Real, Real, Mask, Sums], Sums]"


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
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))

        def add(
            ends: tuple[Vec3, Vec3], way: Real, inverse: Real, active: Mask, state: Sums
        ) -> Sums:
            return _with_edge(frame, x, ends, (way, inverse, unit), active, state)

        one = LiftedProduct.one(self.backend.Float).parts()
        found, product = self._walk(frame, x, detail, add, one)
        return dataclasses.replace(found, value=found.value + LiftedProduct(*product).angle())

    def rates(
        self, frame: Frame, line: Line, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """The constants of `edge_passing` for the sum of Omega_e along the rays from points x."""

        def add(
            ends: tuple[Vec3, Vec3], way: Real, inverse: Real, active: Mask, state: Sums
        ) -> Sums:
            del way
            p, q = ends
            with_it = with_edge_rates(line, (p - line.x, q - p), inverse, lengths, state[8:])
            pairs = zip(with_it, state[8:], strict=True)
            return *state[:8], *(dr.select(active, new, old) for new, old in pairs)

        start = tuple(self.backend.Float(0) for _ in lengths)
        far, near = self._walk(frame, line.x, 0, add, start, active)
        return far.with_rates(line, lengths, near, active)

    def _walk(
        self, frame: Frame, x: Vec3, detail: Real, add: AddEdge, own: Sums, active: Mask = True
    ) -> tuple[Nearby, Sums]:
        """The sums over far nodes without their chords, and all edges and chords added to them and
        to the caller's own by `add`, where it is told to."""
        real, vector = self.backend.Float, self.backend.Array3f
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        pad, close = 16 * unit, fmax(real(detail), real(1))

        def visit(node: Node, state: Sums) -> tuple[Mask, Sums]:
            centre, radius = vector(*node.head[:3]), node.head[3] + pad
            r = x - centre
            square, (u, v) = dr.squared_norm(r), frame.across(centre)
            missed = (dr.fma(u, u, v * v) > radius * radius) | (dr.dot(r, frame.d) > radius)
            accepting = dr.select(detail < 1, node.head[4], node.head[5] * close)
            far = missed & (square > dr.square(accepting))
            inverse = dr.select(far, dr.rsqrt(square), 0)
            c, decay = node.payload(far), dr.square(inverse * inverse) * inverse
            sums = with_far_node(
                state[:8], far_terms(c, r, inverse, 1), far, inverse,
                dr.fma(c[18], inverse * inverse, c[17]),
                (c[15] * decay, c[16] * decay * inverse),
                free_part(RATIO) * (square * inverse), unit,
            )  # fmt: skip
            chord = vector(*c[19:22]), vector(*c[22:25])
            state = add(chord, real(1), c[25], far & (c[25] > 0), (*sums, *state[8:]))
            return ~far, for_each(node, ~far & node.is_leaf, edge, state)

        def edge(row: list[Real], active: Mask, state: Sums) -> Sums:
            ends, way = (vector(*row[:3]), vector(*row[4:7])), row[3]
            # A slot without an edge has no direction.
            return add(ends, way, row[7], active & (way != 0), state)

        zero = real(0)
        start = (zero, vector(0), zero, zero, zero, real(dr.inf), zero, zero, *own)
        sums = walk(self.tree, visit, start, active)
        return Nearby(self.backend, *sums[:8]), sums[8:]


def _with_edge(
    frame: Frame, x: Vec3, ends: tuple[Vec3, Vec3], more: tuple[Real, ...], active: Mask,
    state: tuple[Any, ...],
) -> tuple[Any, ...]:  # fmt: skip
    """The sums with the edge between `ends` added.

    more: 1 or -1 for its way; 1/length^2; and how far rounding moves a coordinate.
    """
    value, g, truncation, slope_truncation, rounding, clear, s4, s5, *product = state
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
    sums = value, g + slope, truncation, slope_truncation, rounding, clear, s4, s5
    return *sums, *product
