"""Balanced trees: built by median splits, stored as records, traversed without a stack.

- `BalancedTree`: which primitive lies in which leaf, from `build_balanced_tree`, in vectorized
  NumPy.
- `PackedTree`: nodes and primitives as records on a backend, from `pack_tree`.
- `traverse`: visits nodes depth first, and enters or skips each subtree; `for_each_primitive`:
  visits the primitives of a leaf.

The meaning of a node, and the decision to skip it, are up to the caller.

Trees are balanced and complete: a level is a reshape of arrays, sums over nodes are sums along an
axis, and a walk needs a link in each node and no stack. Nodes are records of eight-float packets,
siblings side by side. If vertices move, the tree keeps its shape, and its bounds are computed from
the new positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.backend.record_table import PACKET, RecordTable

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real

NO_PRIMITIVE = -1
# The number of points that fit into the cache, with their indices.
_POINTS_IN_CACHE = 1 << 17
# Rows up to this length are reduced faster by a loop over columns than by NumPy's reductions.
_LONG_ROW = 48


@dataclass(frozen=True)
class BalancedTree:
    """A balanced tree: primitives in leaves, and levels of nodes above them.

    Every leaf holds w or w - 1 primitives and every level is complete, so that a level is a reshape
    and every sum over nodes a sum along an axis.

    leaf_slots: (leaves, leaf_size) index of the primitive in each slot, NO_PRIMITIVE for an empty
        one (the last of a leaf, if any).
    arities: the number of children of every inner node, level by level from the leaves' parents to
        the root.
    """

    leaf_slots: IntArray
    arities: tuple[int, ...]

    @property
    def leaf_size(self) -> int:
        """The number of slots of a leaf."""
        return self.leaf_slots.shape[1]

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of nodes of each level, from the leaves to the root."""
        counts = [len(self.leaf_slots)]
        for arity in self.arities:
            counts.append(counts[-1] // arity)
        return tuple(counts)

    @property
    def node_count(self) -> int:
        """The number of nodes of all levels."""
        return sum(self.counts)

    def node_links(self) -> tuple[tuple[IntArray, ...], tuple[IntArray, ...], tuple[IntArray, ...]]:
        """The index of each node, of its first child, and of the node that follows its subtree when
        all nodes are visited depth first (`node_count` for the last); each level by level, leaves
        first.

        The children of a node are numbered consecutively, then the children of the first of them,
        and so on, so that siblings, which are mostly visited together, lie side by side in memory.
        The first child of a leaf is 0, the index of the root, which stands for none.
        """
        below = [0]  # the number of nodes below a node, for each level
        for arity in self.arities:
            below.append(arity * (1 + below[-1]))
        number, after = [np.zeros(1, np.int64)], [np.array([self.node_count], np.int64)]
        first = [np.ones(1, np.int64)]
        for level, arity in reversed(list(enumerate(self.arities))):
            position = np.arange(arity)
            child = first[0][:, None] + position
            following = np.where(position < arity - 1, child + 1, after[0][:, None])
            start = first[0][:, None] + arity + position * below[level]
            number.insert(0, child.reshape(-1))
            after.insert(0, following.reshape(-1))
            first.insert(0, start.reshape(-1))
        first[0] = np.zeros_like(first[0])
        return tuple(number), tuple(first), tuple(after)

    def values_in_slots(self, values: FloatArray, empty: float = 0.0) -> FloatArray:
        """Values of primitives (n, ...) in slots (leaves, leaf_size, ...); `empty` in empty
        ones."""
        out = values.take(self.leaf_slots, axis=0, mode="clip")
        leaf, slot = np.nonzero(self.leaf_slots == NO_PRIMITIVE)
        out[leaf, slot] = empty
        return out


def build_balanced_tree(points: FloatArray, *, leaf_size: int = 8, arity: int = 4) -> BalancedTree:
    """A tree over finite points (n, 3), n >= 1: each split halves a node along its longest side.

    arity: 2 or 4 (two splits at once; the root may have 2 children).

    O(n log n): each of log2(n / leaf_size) levels is one partial sort. Nodes that fit into the
    cache are split down to their leaves, one after the other: threads would not make it faster.
    """
    if arity not in (2, 4):
        raise ValueError(f"arity must be 2 or 4, not {arity}")
    rows = np.arange(len(points), dtype=np.int64)[None]
    x = np.array(points.T, dtype=np.float64, order="C")[:, None]
    depth = max(0, math.ceil(math.log2(len(points) / leaf_size)))
    remaining = depth
    while remaining and rows.shape[1] > _POINTS_IN_CACHE:
        rows, x = _split(rows, x)
        remaining -= 1
    at_once = max(1, _POINTS_IN_CACHE // rows.shape[1])
    leaves: list[IntArray] = []
    for start in range(0, len(rows), at_once):
        batch, coordinates = rows[start : start + at_once], x[:, start : start + at_once]
        for _ in range(remaining):
            batch, coordinates = _split(batch, coordinates)
        leaves.append(batch)
    slots = np.concatenate(leaves)
    if arity == 2:
        return BalancedTree(slots, (2,) * depth)
    return BalancedTree(slots, (4,) * (depth // 2) + (2,) * (depth % 2))


def _split(rows: IntArray, x: FloatArray) -> tuple[IntArray, FloatArray]:
    """The points of nodes, a row each, halved: indices (k, w) and positions x (3, k, w) become
    (2k, ceil(w/2)) and (3, 2k, ceil(w/2)).

    The last slot of a row may be empty: NO_PRIMITIVE, at NaN, which sorts behind all numbers. If
    each row holds w or w - 1 points, each new row holds ceil(w/2) points or one less.
    """
    count, width = rows.shape
    half, middle = (width + 1) // 2, width // 2
    key = x[_sides(x).argmax(axis=0), np.arange(count)]
    order = cast("IntArray", np.argpartition(key, middle, axis=1))
    short = np.flatnonzero(np.isnan(key[:, -1]))
    at = (order[short] == width - 1).argmax(axis=1)  # the empty slot: somewhere on the right
    order[short, at], order[short, -1] = order[short, -1], width - 1
    if width % 2:  # m points of 2m on either side, the empty slot on the left
        order[short, -1], order[short, middle] = order[short, middle], width - 1
    order += np.arange(0, rows.size, width, dtype=np.int64)[:, None]
    return _halves(rows, order, half, NO_PRIMITIVE), np.stack(
        [_halves(coordinate, order, half, np.nan) for coordinate in x]
    )


def _sides(x: FloatArray) -> FloatArray:
    """Lengths (3, k) of the boxes of rows of points (3, k, w)."""
    if x.shape[2] > _LONG_ROW:
        return np.fmax.reduce(x, axis=2) - np.fmin.reduce(x, axis=2)
    low = high = x[..., 0]
    for k in range(1, x.shape[2]):
        low, high = np.fmin(low, x[..., k]), np.fmax(high, x[..., k])
    return high - low


def _halves(values: npt.NDArray[Any], order: IntArray, half: int, empty: float) -> Any:
    """Rows (k, w), reordered by flat indices and cut in two (2k, half), with `empty` at the end."""
    count, width = order.shape
    out = np.empty((count, 2, half), values.dtype)
    flat = values.reshape(-1)
    out[:, 0] = flat[order[:, :half]]
    out[:, 1, : width - half] = flat[order[:, half:]]
    if width % 2:
        out[:, 1, half - 1] = empty
    return out.reshape(-1, half)


_HEAD = 6  # numbers in the first packet of a node that are the caller's; two links follow
# Links are stored as floats, and single precision holds no larger integers without gaps.
_MAX_NODES = 2**24


@dataclass(frozen=True)
class PackedTree:
    """A tree on a backend: nodes with links, siblings side by side (`BalancedTree.node_links`), and
    primitives leaf by leaf.

    node_heads: for each node six numbers of the caller, the index of the node that follows its
        subtree, and the index of its leaf or, for an inner node, minus the index of its first
        child.
    node_payloads: further numbers of the caller for each node, stored separately because a walk
        reads many heads in a row and few payloads; None if there are none.
    primitives: `leaf_size` rows for each leaf.
    """

    backend: Backend
    node_heads: RecordTable
    node_payloads: RecordTable | None
    node_count: Any
    primitives: RecordTable
    leaf_size: Any

    def head(self, i: Any) -> list[Real]:
        """The eight numbers of node i that a walk needs."""
        return self.node_heads.read_record(i)

    def payload(self, i: Any, active: Mask) -> list[Real]:
        """The further numbers of node i."""
        return [] if self.node_payloads is None else self.node_payloads.read_record(i, active)

    def primitive(self, leaf: Any, slot: Any, active: Mask) -> list[Real]:
        """All numbers of a primitive."""
        return self.primitives.read_record(leaf * self.leaf_size + slot, active)


def pack_tree(
    backend: Backend, tree: BalancedTree, levels: Sequence[FloatArray], primitives: FloatArray
) -> PackedTree:
    """Pack a tree with the numbers of its nodes (k, 6 or more), level by level from the leaves, and
    the numbers of its primitives in their slots (leaves, leaf_size, c).

    Raises:
        ValueError: more nodes than links in single precision can count.
    """
    if tree.node_count >= _MAX_NODES:
        raise ValueError(f"a tree of {tree.node_count} nodes is too large: cut the input in parts")
    extra = levels[0].shape[1] - _HEAD
    heads = np.zeros((tree.node_count, PACKET), backend.dtype)
    payloads = np.zeros((tree.node_count, extra), backend.dtype)
    links = tree.node_links()
    for number, first, after, values in zip(*links, levels, strict=True):
        heads[number, :_HEAD] = values[:, :_HEAD]
        heads[number, _HEAD] = after
        heads[number, _HEAD + 1] = -first
        payloads[number] = values[:, _HEAD:]
    leaves = links[0][0]
    heads[leaves, _HEAD + 1] = np.arange(len(leaves))
    return PackedTree(
        backend,
        RecordTable.upload(backend, heads),
        RecordTable.upload(backend, payloads) if extra else None,
        dr.opaque(backend.UInt32, tree.node_count),
        RecordTable.upload(backend, primitives.reshape(-1, primitives.shape[2])),
        dr.opaque(backend.UInt32, tree.leaf_size),
    )


LoopValues: TypeAlias = "tuple[Any, ...]"


@dataclass(frozen=True)
class VisitedNode:
    """The node that a walk visits; each lane may be at a different node.

    index: of the node.
    head: the six numbers of the caller that every visit reads.
    leaf: the index of its leaf, if it is a leaf.
    """

    tree: PackedTree
    index: Any
    head: tuple[Real, ...]
    leaf: Any
    is_leaf: Mask

    def payload(self, active: Mask) -> list[Real]:
        """The other numbers, fetched where active."""
        return self.tree.payload(self.index, active)


Visit: TypeAlias = "Callable[[VisitedNode, LoopValues], tuple[Mask, LoopValues]]"
PrimitiveBody: TypeAlias = "Callable[[list[Real], Mask, LoopValues], LoopValues]"


def traverse(tree: PackedTree, visit: Visit, state: LoopValues, active: Mask = True) -> LoopValues:
    """The state after visiting nodes depth first, from the root on.

    visit: takes a node and the state. Returns whether to visit the node's children (else the walk
        skips its subtree), and the new state.

    May be called while a loop is being recorded.
    """
    index, mask = tree.backend.UInt32, tree.backend.Bool

    def body(i: Any, *state: Any) -> LoopValues:
        head = tree.head(i)
        is_leaf, number = head[7] >= 0, index(dr.abs(head[7]))
        node = VisitedNode(tree, i, tuple(head[:6]), number, is_leaf)
        descend, state = visit(node, state)
        i = dr.select(descend & ~is_leaf, number, index(head[6]))
        return i, *state

    def is_running(i: Any, *_: Any) -> Mask:
        return i < tree.node_count

    start = dr.select(mask(active), index(0), tree.node_count)
    return dr.while_loop((start, *state), is_running, body, label="walk")[1:]


def for_each_primitive(
    node: VisitedNode, active: Mask, body: PrimitiveBody, state: LoopValues
) -> LoopValues:
    """The state after visiting the primitives of a leaf, on active lanes. It costs nothing where
    all lanes of a packet are inactive.

    Empty slots are visited as well: the caller of `pack_tree` has filled them with numbers without
    effect.
    """
    tree = node.tree
    index = tree.backend.UInt32

    def is_running(slot: Any, *_: Any) -> Mask:
        return active & (slot < tree.leaf_size)

    def step(slot: Any, *state: Any) -> LoopValues:
        return slot + 1, *body(tree.primitive(node.leaf, slot, active), active, state)

    return dr.while_loop((index(0), *state), is_running, step, label="leaf")[1:]
