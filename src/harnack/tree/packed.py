"""A tree on a backend: nodes and primitives as records of eight floats each, in one buffer each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.tree.hierarchy import FloatArray, Hierarchy

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real

PACKET = 8
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
    heads: Real
    payloads: Real
    payload_packets: int
    node_count: Any
    primitives: Real
    primitive_packets: int
    leaf_size: Any

    def head(self, i: Any) -> list[Real]:
        """The eight numbers of node i that a walk needs."""
        return self._packet(self.heads, i, True)

    def payload(self, i: Any, active: Mask) -> list[Real]:
        """The other numbers of node i."""
        row: list[Real] = []
        for k in range(self.payload_packets):
            row += self._packet(self.payloads, i * self.payload_packets + k, active)
        return row

    def primitive(self, leaf: Any, slot: Any, active: Mask) -> list[Real]:
        """All numbers of a primitive."""
        start = (leaf * self.leaf_size + slot) * self.primitive_packets
        row: list[Real] = []
        for k in range(self.primitive_packets):
            row += self._packet(self.primitives, start + k, active)
        return row

    def _packet(self, buffer: Real, index: Any, active: Mask) -> list[Real]:
        row = dr.gather(self.backend.ArrayXf, buffer, index, active, shape=(PACKET, 1))
        return [row[j] for j in range(PACKET)]


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
    packets = -(-extra // PACKET)
    heads = np.zeros((tree.node_count, PACKET), _number(backend))
    payloads = np.zeros((tree.node_count, extra), _number(backend))
    links = tree.links()
    for number, first, after, values in zip(*links, levels, strict=True):
        heads[number, :_HEAD] = values[:, :_HEAD]
        heads[number, _HEAD] = after
        heads[number, _HEAD + 1] = -first
        payloads[number] = values[:, _HEAD:]
    leaves = links[0][0]
    heads[leaves, _HEAD + 1] = np.arange(len(leaves))
    width = primitives.shape[2]
    return PackedTree(
        backend,
        _upload(backend, heads),
        _upload(backend, payloads) if extra else backend.Float(0),
        packets,
        dr.opaque(backend.UInt32, tree.node_count),
        _upload(backend, primitives.reshape(-1, width)),
        -(-width // PACKET),
        dr.opaque(backend.UInt32, tree.leaf_size),
    )


def _number(backend: Backend) -> type[np.floating[Any]]:
    return np.float32 if backend.precision == "single" else np.float64


def _upload(backend: Backend, table: npt.NDArray[Any]) -> Real:
    """Rows (n, c), filled up with zeros to whole packets: aligned, as `backend.aligned` has it.

    The filling is done by Dr.Jit, on many threads and without another copy in NumPy.
    """
    rows, width = table.shape
    padded = -(-width // PACKET) * PACKET
    mapped = backend.Float(np.array(table, _number(backend), order="C").ravel())
    # Dr.Jit must not see that this may be the array itself, which need not be aligned.
    lane = dr.arange(backend.UInt32, rows * padded) ^ dr.opaque(backend.UInt32, 0)
    row, column = lane // padded, lane % padded
    copy = dr.gather(backend.Float, mapped, row * width + column, column < width)
    dr.eval(copy)
    return copy
