"""Winding numbers without truncation: crossings of one ray, and the boundary edges.

See `edge_lift` for the formula. At points the cost is that of one ray through a tree of boxes plus
one pass over the edges at which the triangles do not cancel, however many triangles there are.

- `ExactWinding`: the winding number of a mesh, at points and along rays.
- `EdgeChains`: long boundaries along rays, by a tree of chains of edges, with less work than all
  edges take.
- `chain_leaves`, `chain_columns`: that tree, in NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.elementary import fmax
from harnack.enclosures import Lipschitz
from harnack.fields.batch import SymmetricSum, Values
from harnack.fields.clearance import epsilon_at
from harnack.fields.field import Sample
from harnack.fields.solid_angles.edge_lift import (
    LiftedEdge,
    LiftedEdges,
    LiftedProduct,
    LiftedSums,
    edge_records,
    lifted_sums,
)
from harnack.fields.solid_angles.edge_trails import (
    EdgeTrails,
    LiftedTrails,
    Line,
    closed_trails,
    known_along,
    with_edge_rates,
)
from harnack.fields.solid_angles.far_clusters import far_terms
from harnack.fields.solid_angles.multipole import (
    bend_columns,
    cartesian,
    triangle_levels,
    truncation,
)
from harnack.fields.sums import FieldSums, Terms, free_part, last_roundings
from harnack.tree import (
    NO_PRIMITIVE,
    Hierarchy,
    Node,
    PackedTree,
    build_hierarchy,
    for_each,
    pack,
    walk,
)
from harnack.tree.hierarchy import State
from harnack.tree.triangles import Frame, TriangleRays

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.sheets import Crossing
    from harnack.fields.solid_angles.winding_mesh import WindingMesh

# A chain is taken as a whole beyond this many times its radius,
RATIO = 2.5
# and where its truncation is at most so much: in a coarse evaluation, and, in epsilons, at detail
# 1.
_ROUGH, _CLOSE = 1e-2, 1.0
# The most edges in a leaf.
_LEAF_SIZE = 4
# The position of nodes without edges, far from everything, in units of about the mesh's size.
_NOWHERE = 1e6


@dataclass(frozen=True)
class ChainLeaves:
    """Edges in the order of their trails, and leaves as ranges of them.

    The leaves belong to a tree in which every node is one chain of edges, or some whole trails: a
    trail takes up 2^j leaves and begins at a multiple of that, so that a node of 2^i leaves lies
    within a trail or contains some entirely.

    edges: (k, 2) vertices.
    first, span: (k,) the first vertex of each edge's trail, and the number of the trail's leaves.
    ends: (leaves + 1,) where each leaf begins, and the last one ends.
    """

    edges: IntArray
    first: IntArray
    span: IntArray
    ends: IntArray

    def hierarchy(self) -> Hierarchy:
        """The tree over the leaves, whose number is a power of two."""
        depth = (len(self.ends) - 2).bit_length()
        slots = _ranges(self.ends[:-1], self.ends[1:], _LEAF_SIZE)
        return Hierarchy(slots, (4,) * (depth // 2) + (2,) * (depth % 2))


def chain_leaves(vertices: FloatArray, trails: list[IntArray]) -> ChainLeaves:
    """Trails of vertices, each ending where it begins, in an order in which neighbors in space are
    next to each other.

    Trails with the same number of leaves are the primitives of a tree of their own. Its empty slots
    become empty leaves, so that its nodes are nodes here. The largest such tree comes first, and so
    each begins at a multiple of its own size.
    """
    middles = np.array([vertices[trail].mean(axis=0) for trail in trails])
    counts = np.array([len(trail) - 1 for trail in trails])
    spans = np.array([1 << (-(-int(count) // _LEAF_SIZE) - 1).bit_length() for count in counts])
    blocks: list[tuple[int, IntArray]] = []
    for span in np.unique(spans):
        alike = np.flatnonzero(spans == span)
        slots = build_hierarchy(middles[alike], leaf_size=1).slots.ravel()
        blocks.append((int(span), np.where(slots == NO_PRIMITIVE, slots, alike[slots])))
    blocks.sort(key=lambda block: -block[0] * len(block[1]))
    order: list[int] = []
    ends: list[IntArray] = [np.zeros(1, np.int64)]
    start = 0
    for span, slots in blocks:
        for k in slots.tolist():
            count = 0 if k == NO_PRIMITIVE else int(counts[k])
            ends.append(_shares(start, count, span)[1:])
            start += count
            order += [] if k == NO_PRIMITIVE else [k]
    used = sum(map(len, ends)) - 1
    ends.append(np.full((1 << (used - 1).bit_length()) - used, start))
    edges = [np.column_stack([trails[k][:-1], trails[k][1:]]) for k in order]
    laid = [counts[k] for k in order]
    return ChainLeaves(
        np.concatenate(edges),
        np.repeat([int(trails[k][0]) for k in order], laid),
        np.repeat([spans[k] for k in order], laid),
        np.concatenate(ends),
    )


def _shares(start: int, count: int, parts: int) -> IntArray:
    """(parts + 1,) where each of `parts` equal shares of `count` numbers begins, and the last one
    ends."""
    return start + np.arange(parts + 1, dtype=np.int64) * count // parts


def _ranges(start: IntArray, end: IntArray, width: int) -> IntArray:
    """(n, width) rows start, start + 1, ..., end - 1, padded with NO_PRIMITIVE."""
    index = start[:, None] + np.arange(width)
    return np.where(index < end[:, None], index, NO_PRIMITIVE)


def chain_columns(
    leaves: ChainLeaves, nodes: int, vertices: FloatArray, epsilon: float
) -> FloatArray:
    """Numbers of the nodes of a level. The head: center, radius, accepting distances for coarse
    evaluations and for detail 1. The payload: 15 coefficients, errors of value and gradient, A and
    K of `bend_columns`, the two ends of the chord, and 1/length^2 of the chord, or 0 for whole
    trails, which have none.

    The triangles for a chain are a fan from its first vertex; for trails, one fan for each.
    """
    size = (len(leaves.ends) - 1) // nodes
    begin, end = leaves.ends[:-1:size], leaves.ends[size::size]
    some = np.flatnonzero(begin < end)
    begin, end = begin[some], end[some]
    whole = leaves.span <= size
    fan = np.where(whole, leaves.first, np.repeat(leaves.edges[begin, 0], end - begin))
    corners = vertices[np.column_stack([fan, leaves.edges])]
    slots = _ranges(begin, end, int((end - begin).max()))
    level = triangle_levels(Hierarchy(slots, ()), corners)[0]
    error, slope, _ = truncation(level, RATIO * level.radius)
    accept = [
        np.maximum(RATIO * level.radius, (error / allowed) ** 0.2)
        for allowed in (_ROUGH, _CLOSE * epsilon)
    ]
    chord = vertices[np.stack([leaves.edges[begin, 0], leaves.edges[end - 1, 1]], axis=1)]
    square = ((chord[:, 1] - chord[:, 0]) ** 2).sum(axis=1)
    inverse = np.where(whole[begin] | (square == 0), 0, 1 / np.where(square > 0, square, 1))
    parts = (level.center, level.radius * (1 + 1e-6), *accept, cartesian(level.moments))
    parts += (error, slope, *bend_columns(level, RATIO), chord.reshape(-1, 6), inverse)
    found = np.column_stack(parts)
    table = np.zeros((nodes, found.shape[1]))
    table[:, :3] = _NOWHERE
    table[some] = found
    return table


# From an edge, a mask and a state: the state with the edge added where the mask holds.
AddEdge: TypeAlias = "Callable[[LiftedEdge, Mask, State], State]"


@dataclass(frozen=True)
class EdgeChains:
    """Closed trails of edges on a backend, in a tree of chains, in units of about their size.

    The chord of a chain from a to b and the loop that runs along the chain and back along the chord
    have together the same edges as the chain. So, in the terms of `edge_lift`,

        sum_{e in chain} Omega_e(x) = Omega_ab(x) + sum_{e in loop} Omega_e(x),

    and for any triangles P with the loop for a boundary the last sum is their solid angle less 4 pi
    times the signs of their crossings with the ray from x along d. P can lie in the convex hull of
    the chain. Where that ray misses a ball around it there are no crossings, and where x is far
    from the ball the solid angle is a multipole expansion. So a far chain is taken as its chord and
    one node of a tree, and the number of its edges matters only where the ray passes close to the
    boundary.
    """

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
        """The sum of Omega_e at points x of rays, where active, and what promises are made of.

        detail: `Field.at_detail`; at 1 truncation is no more than rounding. Edges add to the
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
        """The constants of `edge_trails.rates_along` for the sum of Omega_e on the line."""

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
        """The sums over far nodes without their chords; and the caller's own state, to which `add`
        has added all edges of near leaves and the chords of far nodes."""
        real, vector = self.backend.Float, self.backend.Array3f
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        pad, close = 16 * unit, fmax(real(detail), real(1))

        def visit(node: Node, state: State) -> tuple[Mask, State]:
            center, radius = vector(*node.head[:3]), node.head[3] + pad
            r = x - center
            square, (u, v) = dr.squared_norm(r), frame.across(center)
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
        """The state with the chord of a node of payload c added, where active. It is a loop of at
        most one trip, so that chords cost nothing where no lane has one, as for whole trails."""

        def once(trip: Any, *state: Any) -> State:
            chord = LiftedEdge.between(type(x)(*c[19:22]), type(x)(*c[22:25]), 1, c[25], frame, x)
            return trip + 1, *add(chord, active, state)

        def is_first(trip: Any, *_: Any) -> Mask:
            return active & (trip < 1)

        return dr.while_loop((self.backend.UInt32(0), *state), is_first, once, label="chord")[1:]


# Up to so many edges, sums at detail 1 along rays run over all of them: that takes 4 ns for each
# edge and point, and a tree of chains 13 to 30 us for each point, measured with 1,585 edges.
_MOST_EDGES = 4000
_SHARE = 1 / (4 * math.pi)


@dataclass(frozen=True)
class ExactWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one.

    rounding: of w, after all terms have been added.
    """

    backend: Backend
    rays: TriangleRays
    edges: LiftedEdges | None
    trails: EdgeTrails | None
    chains: EdgeChains | None
    all_edges: LiftedTrails | None
    rounding: Real

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, rays: TriangleRays, traced: bool
    ) -> ExactWinding:
        """Everything uploaded; traced: also what `on_stretch` needs."""
        if not len(mesh.singular):
            return cls(backend, rays, None, None, None, None, last_roundings(backend))
        vertices, edges = mesh.unit_vertices, mesh.singular
        chains, all_edges = None, None
        if traced:
            chains = EdgeChains.upload(backend, vertices, edges)
        if traced and len(edges) <= _MOST_EDGES:
            all_edges = LiftedTrails.upload(backend, vertices, closed_trails(edges))
        return cls(
            backend,
            rays,
            LiftedEdges.upload(backend, vertices, edges),
            EdgeTrails.upload(backend, vertices, edges),
            chains,
            all_edges,
            last_roundings(backend),
        )

    @property
    def has_detail(self) -> bool:
        """Whether coarse samples cost less."""
        return self.chains is not None

    @property
    def coarsest_detail(self) -> float:
        """`Field.coarsest_detail`: any number below 1.

        There is nothing between coarse and close here: truncation is at most `_ROUGH` below detail
        1, and no more than rounding from there on. A sample that is too coarse is repeated at
        detail 1 or more, and the march returns to coarse ones where f is known well enough for
        them, whatever the number: from 0.5 down to 0.01, evaluations and hits were the same on
        five broken meshes in both precisions. With 1 itself the tracer would take truncation for
        that of detail 1, and for one that more detail reduces.
        """
        return 0.5

    def values(self, x: Vec3) -> Real:
        """w at points, as by `at`, for a third of the work; not while a loop is being recorded.

        Crossings are decided by `tree.triangles.crossing`. Wherever `EdgeTrails` is uncertain about
        an edge, the sum over edges is computed again by `lifted_sums`, which decides by the same
        bits.
        """
        # Rays lead away from the middle of the mesh, so that less of it lies ahead. For a mirrored
        # mesh the winding number changes its sign.
        way = dr.select(x.z >= 0, self.backend.Float(1), -1)
        turns = self.rays.turns_along(x, way)
        if self.trails is None or self.edges is None:
            return dr.select(way > 0, turns, 0 - turns)  # no zero with a sign
        dr.eval(x, way, turns)
        around, doubt = self.trails.turns(x, way)
        value = way * (turns + around)
        dr.eval(value, doubt)
        again = dr.compress(doubt)
        if len(again):
            dr.scatter(value, self.at(dr.gather(type(x), x, again), 0).value, again)
        return value

    def at(self, x: Vec3, derivatives: int) -> Values:
        """w and the derivatives asked for at points."""
        real = self.backend.Float
        turns = self.rays.turns_along(x, real(1))
        if self.edges is None:
            nothing = self.backend.Array3f(0), SymmetricSum.zero(real)
            return Values(turns, real(self.rounding), *nothing, real(0), real(0))
        sums, unit = lifted_sums(self.edges, x, derivatives).whole(), epsilon_at(x)
        sums = sums.plus(Terms(4 * math.pi * turns), True)
        return sums.values(_SHARE, unit, self.rounding)

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """The part of w that counts crossings, at the start t of a ray."""
        return self.rays.turns_ahead(frame, t, active)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, turns: Real, detail: Real,
        active: Mask = True,
    ) -> Sample:  # fmt: skip
        """w continued along a ray interval, where active, with the promises of
        `FieldSums.sample`."""
        del behind
        if self.edges is None:
            nothing = self.backend.Array3f(0)
            return Sample(self.backend.Float(turns), nothing, (Lipschitz(0.0),), 0.0)
        if self.chains is None:
            raise RuntimeError("uploaded for points and not for rays")
        found = self._near(self.chains, frame, x, detail, active)
        found = found.plus(Terms(4 * math.pi * turns), True)
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        line, chains = Line(x, frame.d, 8 * unit), self.chains

        def rates(lengths: tuple[Real, ...], wanted: Mask) -> tuple[Real, ...]:
            return chains.rates(frame, line, lengths, wanted & active)

        known = known_along(line, found.gradient, found.free_distance, rates)
        return found.sample(_SHARE, unit, self.rounding, along=known)

    def _near(
        self, chains: EdgeChains, frame: Frame, x: Vec3, detail: Real, active: Mask
    ) -> FieldSums:
        """The sum over boundary edges: below detail 1 by chains, else over all edges if they are
        few, as at detail 1 the tree of chains is visited down to its leaves nearly everywhere."""
        if self.all_edges is None:
            return chains.near(frame, x, detail, active)
        is_close = self.backend.Float(detail) >= 1
        close = self.all_edges.near(frame, x, is_close & active)
        coarse = chains.near(frame, x, detail, ~is_close & active)
        return coarse.where(is_close, close)
