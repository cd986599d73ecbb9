"""A tree of the edges of closed trails in which every node is one chain, or whole trails.

A trail takes up 2^j leaves and begins at a multiple of that: a node of 2^i leaves lies within a
trail or holds some entirely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.fields.multipoles.multipole import cartesian, triangle_levels
from harnack.fields.multipoles.truncation import bend_columns, truncation
from harnack.tree import NO_PRIMITIVE, Hierarchy, build_hierarchy

# A chain is taken as a whole beyond this many times its radius.
RATIO = 2.5
# And where what it leaves out is at most so much: in a rough look, and over epsilon in a close one.
_ROUGH, _CLOSE = 1e-2, 1.0
# Edges of a leaf at most.
_LEAF_SIZE = 4
# Where nodes without edges are, far from everything, in units of about the mesh's size.
_NOWHERE = 1e6


@dataclass(frozen=True)
class ChainLeaves:
    """Edges in the order of their trails, and leaves as ranges of them.

    edges: (k, 2) vertices. first: (k,) the first vertex of an edge's trail, span: (k,) the number
    of its leaves. ends: (leaves + 1,) where each leaf begins, and the last one ends.
    """

    edges: IntArray
    first: IntArray
    span: IntArray
    ends: IntArray

    def hierarchy(self) -> Hierarchy:
        """The tree over the leaves, a power of two."""
        depth = (len(self.ends) - 2).bit_length()
        slots = _ranges(self.ends[:-1], self.ends[1:], _LEAF_SIZE)
        return Hierarchy(slots, (4,) * (depth // 2) + (2,) * (depth % 2))


def chain_leaves(vertices: FloatArray, trails: list[IntArray]) -> ChainLeaves:
    """Trails of vertices, each ending where it begins, laid out; neighbours next to each other.

    Trails of as many leaves are the primitives of a tree of their own. Its empty slots stay empty
    leaves, so that its nodes are nodes here. The largest such tree comes first, and so each begins
    at a multiple of its own size.
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
    """(parts + 1,) where each of so many parts of `count` numbers begins, and the last one ends."""
    return start + np.arange(parts + 1, dtype=np.int64) * count // parts


def _ranges(start: IntArray, end: IntArray, width: int) -> IntArray:
    """(n, width): start, start + 1, .. up to end, then NO_PRIMITIVE."""
    index = start[:, None] + np.arange(width)
    return np.where(index < end[:, None], index, NO_PRIMITIVE)


def chain_columns(
    leaves: ChainLeaves, nodes: int, vertices: FloatArray, epsilon: float
) -> FloatArray:
    """Numbers of the nodes of a level: centre, radius, accepting distances of rough and close looks
    | 15 coefficients, errors of value and gradient, A and K of `bend_columns`, chord from and to,
    1/its length^2 or 0 for whole trails, which have none.

    The triangles of a chain are a fan from its first vertex, those of trails one for each.
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
    parts = (level.centre, level.radius * (1 + 1e-6), *accept, cartesian(level.moments))
    parts += (error, slope, *bend_columns(level, RATIO), chord.reshape(-1, 6), inverse)
    found = np.column_stack(parts)
    table = np.zeros((nodes, found.shape[1]))
    table[:, :3] = _NOWHERE
    table[some] = found
    return table
