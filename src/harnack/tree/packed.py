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
    """Nodes in depth-first order, with links; primitives leaf by leaf.

    The first packet of a node holds six numbers of its owner's, the node that follows its
    subtree, and the number of its leaf (-1 for an inner node); then the owner's other packets.
    """

    backend: Backend
    nodes: Real
    node_packets: int
    node_count: Any
    primitives: Real
    primitive_packets: int
    leaf_size: int

    def node(self, i: Any, packet: int, active: Mask = True) -> list[Real]:
        """Eight numbers of node i."""
        return self._packet(self.nodes, i * self.node_packets + packet, active)

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
    numbers, sizes = tree.preorder()
    extra = levels[0].shape[1] - _HEAD
    packets = 1 - (-extra // PACKET)
    table = np.zeros((tree.node_count, PACKET * packets), _number(backend))
    for depth, (number, size, values) in enumerate(zip(numbers, sizes, levels, strict=True)):
        table[number, :_HEAD] = values[:, :_HEAD]
        table[number, _HEAD] = number + size
        table[number, _HEAD + 1] = np.arange(len(number)) if depth == 0 else -1
        table[number, PACKET : PACKET + extra] = values[:, _HEAD:]
    width = primitives.shape[2]
    return PackedTree(
        backend,
        _upload(backend, table),
        packets,
        dr.opaque(backend.UInt32, tree.node_count),
        _upload(backend, primitives.reshape(-1, width)),
        -(-width // PACKET),
        tree.leaf_size,
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
