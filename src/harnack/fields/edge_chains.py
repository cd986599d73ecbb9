"""The solid angle of long boundaries along rays: far chains of edges as a chord and a small loop.

The chord of a chain from a to b and the loop that runs along the chain and back along the chord
have the same edges as the chain together. So, in the terms of `edge_lift`,

    sum_{e in chain} Omega_e(x) = Omega_ab(x) + sum_{e in loop} Omega_e(x),

and for any triangles P with the loop for a boundary the last sum is their solid angle less 4 pi
times the turns of their crossings with the ray from x along d. P lies in the convex hull of the
chain. Where that ray misses a ball around it there are no crossings, and where x is far from the
ball the solid angle is a multipole expansion: both terms are smooth, and one node of a tree of
chains does for all of its edges. Their number costs only where the ray passes the boundary closely.

Several closed trails are joined to one by edges that are run through once each way, and cancel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.extrema import fmin
from harnack.fields.edge_field import edge_field, edge_variation
from harnack.fields.edge_lift import edge_factor, times, whole_angle
from harnack.fields.edge_trails import closed_trails
from harnack.fields.multipole import cartesian, triangle_levels
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.truncation import truncation
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
from harnack.tree.nearest import squared_distance_to_segment

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray, IntArray
    from harnack.tree.triangles import Frame

# Edges of a leaf at most.
_LEAF_SIZE = 4
# A chain is taken as a whole beyond this many times its radius, and where its error is at most
# this: in a rough look, and as a multiple of epsilon in a close one.
_RATIO, _ROUGH, _CLOSE = 2.5, 1e-3, 1.0
# Column of an edge: 1/length^2, or -1 for one that joins trails and cancels.
_INVERSE = 7


@dataclass(frozen=True)
class ChainSums:
    """Sums over all edges at x.

    angle: sum of Omega_e; gradient: of it, in the coordinates of x; error, slope_error: of both by
    truncation; distance: no edge is nearer; first, second: bounds of the sums of
    a/(d sqrt(d^2+a^2)) and of the same over d, as in `edge_sums`.
    """

    angle: Real
    gradient: Vec3
    error: Real
    slope_error: Real
    distance: Real
    first: Real
    second: Real


@dataclass(frozen=True)
class EdgeChains:
    """Closed trails of edges on a backend, in a tree of chains, in units of about their size."""

    backend: Backend
    tree: PackedTree

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> EdgeChains:
        """Directed edges (k, 2) between vertices (n, 3), as often out of a vertex as into it."""
        path, real = joined(vertices, closed_trails(edges))
        count = len(real)
        depth = max(0, int(np.ceil(np.log2(count / _LEAF_SIZE))))
        arities = (4,) * (depth // 2) + (2,) * (depth % 2)
        tree = Hierarchy(_slots(count, 2**depth), arities)
        levels = [
            _columns(backend, vertices[path], real, _slots(count, nodes)) for nodes in tree.counts
        ]
        return cls(backend, pack(backend, tree, levels, _records(tree, vertices, path, real)))

    def sums(self, frame: Frame, x: Vec3, fine: Mask) -> ChainSums:
        """All sums at points x of rays; fine: where to look closely."""
        real, vector, epsilon = self.backend.Float, self.backend.Array3f, self.backend.epsilon
        pad = 16 * epsilon * (1 + dr.max(dr.abs(frame.o)))

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            zr, zi, turns, angle, g, error, slope_error, d, first, second = state
            centre, radius = vector(*node.head[:3]), node.head[3] + pad
            r = x - centre
            square, (u, v) = dr.squared_norm(r), frame.across(centre)
            beside = (dr.fma(u, u, v * v) > radius * radius) | (dr.dot(r, frame.d) > radius)
            far = beside & (square > dr.square(dr.select(fine, node.head[5], node.head[4])))
            inverse = dr.select(far, dr.rsqrt(square), 0)
            c = node.payload(far)
            terms = far_terms(c, r, inverse, 1)
            re, im, slope = _edge(frame, x, vector(*c[17:20]), vector(*c[20:23]))
            zr, zi, turns = times(zr, zi, turns, dr.select(far, re, 1), dr.select(far, im, 0))
            apart = dr.select(far, square * inverse - radius, dr.inf)
            nearer, fifth = dr.rcp(apart), dr.square(dr.square(inverse)) * inverse
            share = c[23] * nearer * nearer
            state = (
                zr, zi, turns,
                angle + dr.select(far, terms.value, 0),
                g + dr.select(far, terms.gradient + slope, 0),
                dr.fma(c[15], fifth, error),
                dr.fma(c[16], fifth * inverse, slope_error),
                fmin(apart, d),
                first + share,
                dr.fma(share, nearer, second),
            )  # fmt: skip
            return ~far, for_each(node, ~far & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            zr, zi, turns, angle, g, error, slope_error, d, first, second = state
            a, b, way, inverse = vector(*row[:3]), vector(*row[4:7]), row[3], row[_INVERSE]
            re, im, slope = _edge(frame, x, a, b)
            active &= way != 0
            zr, zi, turns = times(
                zr, zi, turns, dr.select(active, re, 1), dr.select(active, way * im, 0)
            )
            slope = dr.select(active, way * slope, 0)
            joins = inverse < 0
            square = squared_distance_to_segment(a - x, b - a, inverse)
            one, two = edge_variation(square, inverse)
            counts = active & ~joins
            return (
                zr, zi, turns, angle,
                g + slope,
                error,
                dr.fma(8 * epsilon, dr.select(joins, dr.norm(slope), 0), slope_error),
                dr.select(counts, fmin(dr.sqrt(square), d), d),
                first + dr.select(counts, one, 0),
                second + dr.select(counts, two, 0),
            )  # fmt: skip

        start = (
            real(1), real(0), real(0), real(0), vector(0), real(0), real(0), real(dr.inf),
            real(0), real(0),
        )  # fmt: skip
        zr, zi, turns, angle, g, *rest = walk(self.tree, visit, start)
        return ChainSums(angle + whole_angle(zr, zi, turns), g, *rest)


def _edge(frame: Frame, x: Vec3, p: Vec3, q: Vec3) -> tuple[Real, Real, Vec3]:
    """Factor and gradient of the edge from p to q, as `edge_lift.lifted_sums` takes them."""
    vector, a, b = cast("Any", type(x)), p - x, q - x
    la, lb = dr.norm(a), dr.norm(b)
    seen_p = vector(*frame.across(p), dr.dot(a, frame.d))
    seen_q = vector(*frame.across(q), dr.dot(b, frame.d))
    re, im = edge_factor(seen_p, seen_q, la, lb)
    c, weight = edge_field(a, b, la, lb)
    return re, im, weight * c


def joined(vertices: FloatArray, trails: list[IntArray]) -> tuple[IntArray, npt.NDArray[np.bool_]]:
    """One closed path of vertices (k + 1,) through all trails, and which of its edges (k,) are
    theirs: the others lead from trail to trail, and in the end back the same way."""
    middles = np.array([vertices[trail].mean(axis=0) for trail in trails])
    order = build_hierarchy(middles, leaf_size=1).slots.ravel()
    trails = [trails[k] for k in order[order != NO_PRIMITIVE]]
    back = np.array([trail[0] for trail in trails[-2::-1]], np.int64)
    real = np.concatenate([np.append(np.ones(len(trail) - 1, np.bool_), False) for trail in trails])
    path = np.concatenate([*trails, back])
    return path, np.append(real, np.zeros(len(path), np.bool_))[: len(path) - 1]


def _slots(count: int, nodes: int) -> IntArray:
    """(nodes, w) which of `count` edges in a row each node holds: w or w - 1 of them."""
    ends = np.arange(nodes + 1) * count // nodes
    index = ends[:-1, None] + np.arange(-(-count // nodes))
    return np.where(index < ends[1:, None], index, NO_PRIMITIVE)


def _columns(
    backend: Backend, path: FloatArray, real: npt.NDArray[np.bool_], slots: IntArray
) -> FloatArray:
    """Numbers of the nodes of a level: centre, radius, accepting distances of rough and close looks
    | 15 coefficients, errors of value and gradient, chord, half the edges' length.

    The triangles are a fan from the chain's first vertex.
    """
    first = slots[:, 0]
    count = (slots != NO_PRIMITIVE).sum(axis=1)
    start, after = np.repeat(path[first], count, axis=0), path[1:]
    corners = np.stack([start, path[:-1], after], axis=1)
    level = triangle_levels(Hierarchy(slots, ()), corners)[0]
    radius = level.radius * (1 + 1e-6)
    error, slope = truncation(level, _RATIO * radius)
    accept = [
        np.maximum(_RATIO * radius, (error / allowed) ** 0.2)
        for allowed in (_ROUGH, _CLOSE * backend.epsilon)
    ]
    length = np.where(real, np.linalg.norm(after - path[:-1], axis=1), 0)
    half = 0.5 * np.add.reduceat(length, first) * (1 + 1e-6)
    parts = (level.centre, radius, *accept, cartesian(level.moments), error, slope)
    parts += (path[first], path[first + count], half)
    return np.column_stack(parts)


def _records(
    tree: Hierarchy, vertices: FloatArray, path: IntArray, real: npt.NDArray[np.bool_]
) -> FloatArray:
    """Edges in slots (leaves, leaf_size, 8): lower end, direction, higher end, `_INVERSE`.

    The ends are ordered by vertex index, as those of triangles are; a slot without an edge has no
    direction."""
    start, end = path[:-1], path[1:]
    low, high = vertices[np.minimum(start, end)], vertices[np.maximum(start, end)]
    way = np.where(start < end, 1.0, -1.0)
    square = ((high - low) ** 2).sum(axis=1)
    inverse = np.where(real, 1 / np.maximum(square, 1e-300), -1.0)
    return tree.gather(np.column_stack([low, way, high, inverse]))
