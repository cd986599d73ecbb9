"""Walking a tree without a stack: depth first, over a subtree or past it.

What a node means, and when to go past it, is up to the caller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.tree.packed import PackedTree

State: TypeAlias = "tuple[Any, ...]"


@dataclass(frozen=True)
class Node:
    """A node on a walk; all lanes may be at different ones.

    head: its owner's six numbers that every visit reads. leaf: number of its leaf, if it is_leaf.
    """

    tree: PackedTree
    index: Any
    head: tuple[Real, ...]
    leaf: Any
    is_leaf: Mask

    def payload(self, active: Mask) -> list[Real]:
        """The other numbers, fetched where active."""
        return self.tree.payload(self.index, active)


Visit: TypeAlias = "Callable[[Node, State], tuple[Mask, State]]"
EachPrimitive: TypeAlias = "Callable[[list[Real], Mask, State], State]"


def walk(tree: PackedTree, visit: Visit, state: State, active: Mask = True) -> State:
    """The state after visiting nodes from the root on.

    visit(node, state) gives the new state, and whether to go into the node's children: where it
    does not, the walk goes on behind the subtree. May be called while a loop is recorded.
    """
    index, mask = tree.backend.UInt32, tree.backend.Bool

    def body(i: Any, *state: Any) -> State:
        head = tree.head(i)
        is_leaf, number = head[7] >= 0, index(dr.abs(head[7]))
        node = Node(tree, i, tuple(head[:6]), number, is_leaf)
        descend, state = visit(node, state)
        i = dr.select(descend & ~is_leaf, number, index(head[6]))
        return i, *state

    def more(i: Any, *_: Any) -> Mask:
        return i < tree.node_count

    start = dr.select(mask(active), index(0), tree.node_count)
    return dr.while_loop((start, *state), more, body, label="walk")[1:]


def for_each(node: Node, active: Mask, body: EachPrimitive, state: State) -> State:
    """The state after visiting the primitives of a leaf, where active; costs nothing elsewhere.

    Empty slots are visited as well: whoever packed the tree filled them with what does no harm.
    """
    tree = node.tree
    index = tree.backend.UInt32

    def more(slot: Any, *_: Any) -> Mask:
        return active & (slot < tree.leaf_size)

    def step(slot: Any, *state: Any) -> State:
        return slot + 1, *body(tree.primitive(node.leaf, slot, active), active, state)

    return dr.while_loop((index(0), *state), more, step, label="leaf")[1:]
