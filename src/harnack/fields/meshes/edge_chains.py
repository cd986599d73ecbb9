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

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.fields.edges.edge_lift import LiftedEdge, LiftedProduct, LiftedSums, edge_records
from harnack.fields.edges.edge_passing import with_edge_rates
from harnack.fields.meshes.chain_tree import RATIO, chain_columns, chain_leaves
from harnack.fields.meshes.edge_trails import closed_trails
from harnack.fields.multipoles.multipole_kernel import far_terms
from harnack.fields.sums import FieldSums, free_part
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import Node, PackedTree, for_each, pack, walk
from harnack.tree.walk import State

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fields.edges.edge_passing import Line
    from harnack.tree.triangles import Frame

# An edge, and where it counts, added to a state.
AddEdge: TypeAlias = "Callable[[LiftedEdge, Mask, State], State]"


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

    def near(self, frame: Frame, x: Vec3, detail: Real, active: Mask = True) -> FieldSums:
        """The sum of Omega_e at points x of rays, where active, and what a certificate needs.

        detail: `Field.at_detail`; 1 leaves out no more than rounding does. Edges add to the
        remainder what `LiftedEdge.bounds` says, and so do chords: none is nearer than the ball
        around its chain.
        """
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))

        def add(edge: LiftedEdge, active: Mask, state: State) -> State:
            return LiftedSums.of(state).plus(edge, unit, active).parts()

        own = LiftedProduct.one(self.backend.Float).parts()
        return LiftedSums.of(self._walk(frame, x, detail, add, own, active)).whole()

    def rates(
        self, frame: Frame, line: Line, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """The constants of `edge_passing` for the sum of Omega_e along the rays from points x."""

        def add(edge: LiftedEdge, active: Mask, state: State) -> State:
            old = state[1]
            new = with_edge_rates(line, edge.edge, lengths, old)
            pairs = zip(new, old, strict=True)
            return state[0], tuple(dr.select(active, one, other) for one, other in pairs)

        start = tuple(self.backend.Float(0) for _ in lengths)
        state = self._walk(frame, line.x, 0, add, start, active)
        far = FieldSums.of(state[0])
        return far.with_rates(line.v, line.slack, lengths, state[1], active)

    def _walk(
        self, frame: Frame, x: Vec3, detail: Real, add: AddEdge, own: State, active: Mask = True
    ) -> State:
        """The sums over far nodes without their chords, and the caller's own, with all edges and
        chords added by `add`, where it is told to."""
        real, vector = self.backend.Float, self.backend.Array3f
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        pad, close = 16 * unit, fmax(real(detail), real(1))

        def visit(node: Node, state: State) -> tuple[Mask, State]:
            centre, radius = vector(*node.head[:3]), node.head[3] + pad
            r = x - centre
            square, (u, v) = dr.squared_norm(r), frame.across(centre)
            missed = (dr.fma(u, u, v * v) > radius * radius) | (dr.dot(r, frame.d) > radius)
            accepting = dr.select(detail < 1, node.head[4], node.head[5] * close)
            far = missed & (square > dr.square(accepting))
            inverse = dr.select(far, dr.rsqrt(square), 0)
            c, decay = node.payload(far), dr.square(inverse * inverse) * inverse
            sums = FieldSums.of(state[0]).with_far_node(
                far_terms(c, r, inverse, 1),
                far,
                inverse,
                dr.fma(c[18], inverse * inverse, c[17]),
                (c[15] * decay, c[16] * decay * inverse, 0),
                free_part(RATIO) * (square * inverse),
                unit,
            )
            state = self._with_chord(frame, x, c, far & (c[25] > 0), add, (sums.parts(), state[1]))
            return ~far, for_each(node, ~far & node.is_leaf, edge, state)

        def edge(row: list[Real], active: Mask, state: State) -> State:
            p, q, way = vector(*row[:3]), vector(*row[4:7]), row[3]
            # A slot without an edge has no direction.
            here = LiftedEdge.between(p, q, way, row[7], frame, x)
            return add(here, active & (way != 0), state)

        start = (FieldSums.zero(self.backend, dr.inf, 1).parts(), own)
        return walk(self.tree, visit, start, active)

    def _with_chord(
        self, frame: Frame, x: Vec3, c: list[Real], active: Mask, add: AddEdge, state: State
    ) -> State:
        """The state with the chord of a node of payload c, where active. Whole trails have none:
        in a loop of one trip, or of none, chords cost nothing where no lane has one."""

        def once(trip: Any, *state: Any) -> State:
            chord = LiftedEdge.between(type(x)(*c[19:22]), type(x)(*c[22:25]), 1, c[25], frame, x)
            return trip + 1, *add(chord, active, state)

        def is_first(trip: Any, *_: Any) -> Mask:
            return active & (trip < 1)

        return dr.while_loop((self.backend.UInt32(0), *state), is_first, once, label="chord")[1:]
