"""A tree on a backend: nodes and primitives as records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.records import PACKET, Records
from harnack.tree.hierarchy import Hierarchy

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real

_HEAD = 6  # numbers of the first packet of a node that its owner chooses; then skip and leaf
# Links are stored as floats, and single precision counts no further.
_MOST_NODES = 2**24


@dataclass(frozen=True)
class PackedTree:
    """Nodes with links, siblings side by side (`Hierarchy.links`); primitives leaf by leaf.

    The head of a node holds six numbers of its owner's, the node that follows its subtree, and
    the number of its leaf or, for an inner node, minus that of its first child. The owner's other
    packets lie elsewhere: a walk reads many heads in a row, and few of those.
    """

    backend: Backend
    heads: Records
    payloads: Records | None
    node_count: Any
    primitives: Records
    leaf_size: Any

    def head(self, i: Any) -> list[Real]:
        """The eight numbers of node i that a walk needs."""
        return self.heads.row(i)

    def payload(self, i: Any, active: Mask) -> list[Real]:
        """The other numbers of node i."""
        return [] if self.payloads is None else self.payloads.row(i, active)

    def primitive(self, leaf: Any, slot: Any, active: Mask) -> list[Real]:
        """All numbers of a primitive."""
        return self.primitives.row(leaf * self.leaf_size + slot, active)


def pack(
    backend: Backend, tree: Hierarchy, levels: Sequence[FloatArray], primitives: FloatArray
) -> PackedTree:
    """A tree with the numbers of its nodes (k, 6 or more), level by level from the leaves, and of
    its primitives in their slots (leaves, leaf_size, c).

    Raises:
        ValueError: more nodes than links in single precision can count.
    """
    if tree.node_count >= _MOST_NODES:
        raise ValueError(f"a tree of {tree.node_count} nodes is too large: cut the input in parts")
    extra = levels[0].shape[1] - _HEAD
    heads = np.zeros((tree.node_count, PACKET), backend.dtype)
    payloads = np.zeros((tree.node_count, extra), backend.dtype)
    links = tree.links()
    for number, first, after, values in zip(*links, levels, strict=True):
        heads[number, :_HEAD] = values[:, :_HEAD]
        heads[number, _HEAD] = after
        heads[number, _HEAD + 1] = -first
        payloads[number] = values[:, _HEAD:]
    leaves = links[0][0]
    heads[leaves, _HEAD + 1] = np.arange(len(leaves))
    return PackedTree(
        backend,
        Records.upload(backend, heads),
        Records.upload(backend, payloads) if extra else None,
        dr.opaque(backend.UInt32, tree.node_count),
        Records.upload(backend, primitives.reshape(-1, primitives.shape[2])),
        dr.opaque(backend.UInt32, tree.leaf_size),
    )
