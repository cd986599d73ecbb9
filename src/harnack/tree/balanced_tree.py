"""Balanced trees over primitives (points, segments or triangles), built by median splits, stored as
records, and traversed without a stack. A *leaf* holds a few primitives, in numbered *slots*, the
last of which may be empty. A *node* is a leaf or has children; a *level* is all nodes at the same
height above the leaves. A *record* is a row of numbers that kernels read, for a node or a
primitive. A *lane* is one entry of Dr.Jit's arrays, such as a ray or a point; each lane walks
through the tree by itself.

- `BalancedTree`: which primitive lies in which leaf. `build_balanced_tree` computes it in
  vectorized NumPy.
- `PackedTree`: nodes and primitives as records on a backend, from `pack_tree`.
- `traverse`: visits nodes depth first, and enters or skips each subtree; `for_each_primitive`:
  visits the primitives of a leaf.

Nodes hold numbers of the caller, such as a bounding box, and the caller decides which nodes a walk
skips.

All nodes of a level of the tree have the same number of children. So a level is a reshape of
arrays, a sum over the children of each node is a sum along an axis, and each node needs only a link
to where the walk goes on, no stack. Nodes are records of eight-float packets, siblings side by
side. If vertices move, the tree keeps its shape, and its bounds are computed from the new
positions.
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
_MAX_LOOPED_ROW = 48


@dataclass(frozen=True)
class BalancedTree:
    """The shape of a balanced tree: which primitive (point, segment or triangle) lies in which
    leaf, and how many children the nodes above the leaves have. It holds no positions.

    Every leaf has w slots and holds w or w - 1 primitives. All nodes of a level have the same
    number of children, in order, so the level above is a reshape of arrays, and a sum over the
    children of each node is a sum along an axis.

    leaf_slots: (leaves, w) the index of the primitive in each slot; NO_PRIMITIVE in an empty slot,
        which can only be the last of a leaf.
    arities: the number of children of the nodes of each level, from the parents of leaves to the
        root.
    """

    leaf_slots: IntArray
    arities: tuple[int, ...]

    @property
    def leaf_size(self) -> int:
        """The number w of slots of a leaf."""
        return self.leaf_slots.shape[1]

    @property
    def counts(self) -> tuple[int, ...]:
        """The numbers of nodes of the levels of the tree: one number for each level, the leaves
        first, the root last."""
        counts = [len(self.leaf_slots)]
        for arity in self.arities:
            counts.append(counts[-1] // arity)
        return tuple(counts)

    @property
    def node_count(self) -> int:
        """The number of nodes of the tree, leaves included."""
        return sum(self.counts)

    def node_links(self) -> tuple[tuple[IntArray, ...], tuple[IntArray, ...], tuple[IntArray, ...]]:
        """Number the nodes, and compute the links with which a walk visits all of them depth first,
        without a stack.

        Returns:
            Three tuples of arrays, one array for each level of the tree, leaves first: the index of
            each node; the index of its first child; and the index of the node that follows when its
            subtree has been visited, `node_count` for the last one.

        The children of a node have consecutive indices; after them come the descendants of the
        first child, then the descendants of the second, and so on. So siblings, which are mostly
        visited together, lie side by side in memory. A leaf has no children: the index of its first
        child is given as 0, which is the index of the root.
        """
        # self.arities: the number of children of a node at each level, from the parents of the
        # leaves to the root. below: the number of nodes below a node, for each level.
        below = [0]
        for arity in self.arities:
            below.append(arity * (1 + below[-1]))
        # The root has the index 0, its first child 1. From there, level by level downwards.
        # `next_index` is where the walk goes on after a node's subtree.
        index, next_index = [np.zeros(1, np.int64)], [np.array([self.node_count], np.int64)]
        first_child = [np.ones(1, np.int64)]
        for level, arity in reversed(list(enumerate(self.arities))):
            position = np.arange(arity)
            child = first_child[0][:, None] + position
            # After a child's subtree comes its next sibling; after the last, what follows its
            # parent's subtree.
            after_child = np.where(position < arity - 1, child + 1, next_index[0][:, None])
            # Behind the siblings come the descendants of the first one, then those of the second,
            # and so on: below[level] of each.
            child_of_child = first_child[0][:, None] + arity + position * below[level]
            index.insert(0, child.reshape(-1))
            next_index.insert(0, after_child.reshape(-1))
            first_child.insert(0, child_of_child.reshape(-1))
        first_child[0] = np.zeros_like(first_child[0])
        return tuple(index), tuple(first_child), tuple(next_index)

    def values_in_slots(self, values: FloatArray, empty: float = 0.0) -> FloatArray:
        """Arrange values (n, ...) of the n primitives by the slots of leaves: (leaves, leaf_size,
        ...). Empty slots get the value `empty`."""
        # "clip" reads some value for NO_PRIMITIVE, which is overwritten.
        in_slots = values.take(self.leaf_slots, axis=0, mode="clip")
        leaf, slot = np.nonzero(self.leaf_slots == NO_PRIMITIVE)
        in_slots[leaf, slot] = empty
        return in_slots


def build_balanced_tree(points: FloatArray, *, leaf_size: int = 8, arity: int = 4) -> BalancedTree:
    """Build a balanced tree over finite points (n, 3), n >= 1. Nodes are split at the median along
    the longest side of the bounding box of their points.

    leaf_size: the largest number of points of a leaf.
    arity: the number of children of a node, 2 or 4 (two splits at once). With 4, the root has 2
        children if the number of splits is odd.

    The time is O(n log n): each of log2(n / leaf_size) levels of splits is one partial sort. Once
    nodes are small enough for the processor's cache, each batch of nodes is split down to its
    leaves before the next batch. Threads would not make it faster.

    Raises:
        ValueError: the arity is neither 2 nor 4.
    """
    if arity not in (2, 4):
        raise ValueError(f"arity must be 2 or 4, not {arity}")
    # One row for each node: the indices of its points, and their coordinates (3, nodes, points).
    point_ids = np.arange(len(points), dtype=np.int64)[None]
    positions = np.array(points.T, dtype=np.float64, order="C")[:, None]
    # The number of splits from the root to a leaf.
    depth = max(0, math.ceil(math.log2(len(points) / leaf_size)))
    remaining = depth
    while remaining and point_ids.shape[1] > _POINTS_IN_CACHE:
        point_ids, positions = _split(point_ids, positions)
        remaining -= 1
    at_once = max(1, _POINTS_IN_CACHE // point_ids.shape[1])
    leaves: list[IntArray] = []
    for start in range(0, len(point_ids), at_once):
        batch, coordinates = (
            point_ids[start : start + at_once],
            positions[:, start : start + at_once],
        )
        for _ in range(remaining):
            batch, coordinates = _split(batch, coordinates)
        leaves.append(batch)
    slots = np.concatenate(leaves)
    if arity == 2:
        return BalancedTree(slots, (2,) * depth)
    return BalancedTree(slots, (4,) * (depth // 2) + (2,) * (depth % 2))


def _split(point_ids: IntArray, positions: FloatArray) -> tuple[IntArray, FloatArray]:
    """Split each of k nodes into two halves of its points, at the median along the longest side of
    the points' bounding box.

    point_ids: (k, w) the indices of the points of each node, one node per row.
    positions: (3, k, w) the coordinates of these points.

    The last slot of a row may be empty: its index is NO_PRIMITIVE and its position NaN, which sorts
    behind all numbers. Each row holds w or w - 1 points; each half holds ceil(w/2) points or one
    less.

    Returns:
        The indices (2k, ceil(w/2)) and the positions (3, 2k, ceil(w/2)) of the points of the
        halves; the two halves of a node follow each other.
    """
    count, width = point_ids.shape
    half, middle = (width + 1) // 2, width // 2
    # The coordinate of each point along its node's longest side, and the order that splits it.
    key = positions[_box_sizes(positions).argmax(axis=0), np.arange(count)]
    order = cast("IntArray", np.argpartition(key, middle, axis=1))
    short_rows = np.flatnonzero(np.isnan(key[:, -1]))
    # The empty slot, number width - 1, is somewhere on the right: move it to the end of the row.
    empty_slot = (order[short_rows] == width - 1).argmax(axis=1)
    order[short_rows, empty_slot], order[short_rows, -1] = order[short_rows, -1], width - 1
    # A short row of odd width 2m + 1 has 2m points, and its left half has m + 1 slots. The last of
    # these becomes the empty slot, so that both halves have m points.
    if width % 2:
        order[short_rows, -1], order[short_rows, middle] = order[short_rows, middle], width - 1
    # From places in a row to places in the flattened array.
    order += np.arange(0, point_ids.size, width, dtype=np.int64)[:, None]
    return _halves(point_ids, order, half, NO_PRIMITIVE), np.stack(
        [_halves(coordinate, order, half, np.nan) for coordinate in positions]
    )


def _box_sizes(positions: FloatArray) -> FloatArray:
    """The edge lengths (3, k) of the bounding boxes of k nodes. positions: (3, k, w) the
    coordinates of the w points of each node; NaN marks an empty slot."""
    if positions.shape[2] > _MAX_LOOPED_ROW:
        return np.fmax.reduce(positions, axis=2) - np.fmin.reduce(positions, axis=2)
    # For short rows a loop over their places takes less time.
    low = high = positions[..., 0]
    for k in range(1, positions.shape[2]):
        low, high = np.fmin(low, positions[..., k]), np.fmax(high, positions[..., k])
    return high - low


def _halves(values: npt.NDArray[Any], order: IntArray, half: int, empty: float) -> Any:
    """Reorder each row of values (k, w) and cut it in two halves.

    order: (k, w) for each new place, the index into the flattened values.
    half: the length of each half, ceil(w/2).
    empty: the value that fills the last slot of second halves, if w is odd.

    Returns (2k, half): the two halves of a row follow each other.
    """
    count, width = order.shape
    halves = np.empty((count, 2, half), values.dtype)
    flat = values.reshape(-1)
    halves[:, 0] = flat[order[:, :half]]
    halves[:, 1, : width - half] = flat[order[:, half:]]
    if width % 2:
        halves[:, 1, half - 1] = empty
    return halves.reshape(-1, half)


# The first packet of a node holds this many numbers of the caller, and then two links.
_CALLER_NUMBERS = 6
# Links are stored as floats, and single precision holds no larger integers without gaps.
_MAX_NODES = 2**24


@dataclass(frozen=True)
class PackedTree:
    """A tree on a backend, for walks in Dr.Jit: records (rows of numbers) of its nodes and of its
    primitives (points, segments or triangles). The leaves have slots for primitives, of which the
    last may be empty. Siblings lie side by side (`BalancedTree.node_links`), and primitives leaf by
    leaf.

    node_heads: eight numbers for each node: six of the caller; the index of the node at which the
        walk goes on if it skips the node's subtree; and for a leaf its index among leaves, or for
        an inner node minus the index of its first child.
    node_payloads: further numbers of the caller for each node; None if there are none. They are
        stored separately because a walk reads many heads in a row and few payloads.
    node_count: the number of nodes.
    primitives: the records of primitives, `leaf_size` for each leaf.
    """

    backend: Backend
    node_heads: RecordTable
    node_payloads: RecordTable | None
    node_count: Any
    primitives: RecordTable
    leaf_size: Any

    def head(self, i: Any) -> list[Real]:
        """The eight numbers of node i in `node_heads`."""
        return self.node_heads.read_record(i)

    def payload(self, i: Any, active: Mask) -> list[Real]:
        """The numbers of node i in `node_payloads`, read on active lanes; [] if the tree has no
        payloads."""
        return [] if self.node_payloads is None else self.node_payloads.read_record(i, active)

    def primitive(self, leaf: Any, slot: Any, active: Mask) -> list[Real]:
        """The record of the primitive in a slot of a leaf, read on active lanes."""
        return self.primitives.read_record(leaf * self.leaf_size + slot, active)


def pack_tree(
    backend: Backend, tree: BalancedTree, levels: Sequence[FloatArray], primitives: FloatArray
) -> PackedTree:
    """Upload a tree to a backend, for `traverse`.

    tree: the shape of the tree.
    levels: for each level of the tree, leaves first, the caller's numbers (k, c) of its k nodes, c
        >= 6. The first six numbers of a node are read at every visit of the node, the further
        numbers only on demand.
    primitives: (leaves, leaf_size, j) the record of the primitive in each slot
        (`BalancedTree.values_in_slots`).

    Raises:
        ValueError: there are more nodes than single precision can count.
    """
    if tree.node_count >= _MAX_NODES:
        raise ValueError(f"a tree of {tree.node_count} nodes is too large: cut the input in parts")
    payload_size = levels[0].shape[1] - _CALLER_NUMBERS
    heads = np.zeros((tree.node_count, PACKET), backend.dtype)
    payloads = np.zeros((tree.node_count, payload_size), backend.dtype)
    links = tree.node_links()
    for index, first_child, next_index, values in zip(*links, levels, strict=True):
        heads[index, :_CALLER_NUMBERS] = values[:, :_CALLER_NUMBERS]
        heads[index, _CALLER_NUMBERS] = next_index
        # Minus the first child; for leaves it is replaced below.
        heads[index, _CALLER_NUMBERS + 1] = -first_child
        payloads[index] = values[:, _CALLER_NUMBERS:]
    leaves = links[0][0]  # the indices of the nodes at level 0
    heads[leaves, _CALLER_NUMBERS + 1] = np.arange(len(leaves))
    return PackedTree(
        backend,
        RecordTable.upload(backend, heads),
        RecordTable.upload(backend, payloads) if payload_size else None,
        dr.opaque(backend.UInt32, tree.node_count),
        RecordTable.upload(backend, primitives.reshape(-1, primitives.shape[2])),
        dr.opaque(backend.UInt32, tree.leaf_size),
    )


LoopValues: TypeAlias = "tuple[Any, ...]"


@dataclass(frozen=True)
class VisitedNode:
    """The node that a walk through a tree visits now; each lane may visit a different node.

    index: the index of the node.
    head: the first six numbers of the node, which the caller of `pack_tree` gave.
    leaf: the index of the node among the leaves; it has no meaning for an inner node.
    is_leaf: whether the node is a leaf.
    """

    tree: PackedTree
    index: Any
    head: tuple[Real, ...]
    leaf: Any
    is_leaf: Mask

    def payload(self, active: Mask) -> list[Real]:
        """The further numbers of the node (those after the first six), read on active lanes; [] if
        the tree has none."""
        return self.tree.payload(self.index, active)


Visit: TypeAlias = "Callable[[VisitedNode, LoopValues], tuple[Mask, LoopValues]]"
PrimitiveBody: TypeAlias = "Callable[[list[Real], Mask, LoopValues], LoopValues]"


def traverse(tree: PackedTree, visit: Visit, state: LoopValues, active: Mask = True) -> LoopValues:
    """Visit the nodes of a tree depth first, from the root on, and return the final state. Each
    lane (entry of Dr.Jit's arrays, such as a ray) walks by itself.

    visit: a function that takes a `VisitedNode` and the state. It returns a mask, whether to visit
        the node's children (otherwise its subtree is skipped), and the new state.
    state: a tuple of arrays, which `visit` updates.
    active: the lanes that walk at all.

    May be called while a loop is being recorded.
    """
    index, mask = tree.backend.UInt32, tree.backend.Bool

    def body(i: Any, *state: Any) -> LoopValues:
        """Visit node i of the tree. Returns the index of the node to visit next, which is its first
        child or the node after its subtree, and then the new state."""
        head = tree.head(i)
        # head[6]: the node after the subtree. head[7]: the number of the leaf, or minus the index
        # of the first child. The root is nobody's child, so that this is never -0.
        is_leaf, number = head[7] >= 0, index(dr.abs(head[7]))
        node = VisitedNode(tree, i, tuple(head[:6]), number, is_leaf)
        descend, state = visit(node, state)
        i = dr.select(descend & ~is_leaf, number, index(head[6]))
        return i, *state

    def is_running(i: Any, *_: Any) -> Mask:
        """Whether a lane has further nodes to visit."""
        return i < tree.node_count

    # Lanes that are not active begin behind the last node.
    start = dr.select(mask(active), index(0), tree.node_count)
    return dr.while_loop((start, *state), is_running, body, label="walk")[1:]


def for_each_primitive(
    node: VisitedNode, active: Mask, body: PrimitiveBody, state: LoopValues
) -> LoopValues:
    """Update a state by each primitive of the leaf `node`, and return the final state.

    active: the lanes whose node is a leaf and whose state is to be updated.
    body: a function that takes the record of a primitive, the mask of active lanes and the state,
        and returns the new state.
    state: a tuple of arrays.

    A packet of lanes that are all inactive costs no time. Empty slots are visited as well: the
    caller of `pack_tree` has filled them with numbers that have no effect.
    """
    tree = node.tree
    index = tree.backend.UInt32

    def is_running(slot: Any, *_: Any) -> Mask:
        """Whether a lane is active and has further slots to visit. slot: the number of the next
        slot."""
        return active & (slot < tree.leaf_size)

    def step(slot: Any, *state: Any) -> LoopValues:
        """Call the caller's function `body` for the primitive in a slot. Returns the number of the
        next slot, and then the new state."""
        return slot + 1, *body(tree.primitive(node.leaf, slot, active), active, state)

    return dr.while_loop((index(0), *state), is_running, step, label="leaf")[1:]
