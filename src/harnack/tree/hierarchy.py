"""The shape of a tree: which primitive lies in which leaf. Vectorised NumPy, no formulas.

A balanced tree of median splits: every leaf holds w or w - 1 primitives, every level is complete,
so that a level is a reshape and every sum over nodes a sum along an axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NO_PRIMITIVE = -1


@dataclass(frozen=True)
class Hierarchy:
    """Primitives in leaves, leaves in levels.

    slots: (leaves, leaf_size) index of the primitive in each slot, NO_PRIMITIVE for an empty one
        (the last of a leaf, if any).
    arities: children of every inner node, level by level from the leaves' parents to the root.
    """

    slots: IntArray
    arities: tuple[int, ...]

    @property
    def leaf_size(self) -> int:
        """Slots of a leaf."""
        return self.slots.shape[1]

    @property
    def counts(self) -> tuple[int, ...]:
        """Nodes of each level, from the leaves to the root."""
        counts = [len(self.slots)]
        for arity in self.arities:
            counts.append(counts[-1] // arity)
        return tuple(counts)

    @property
    def node_count(self) -> int:
        """Nodes of all levels."""
        return sum(self.counts)

    def preorder(self) -> tuple[tuple[IntArray, ...], tuple[int, ...]]:
        """Number of each node in depth-first order, level by level; and subtree sizes of levels.

        A subtree is a run of numbers: the node that follows it is `number + size`.
        """
        sizes = [1]
        for arity in self.arities:
            sizes.append(1 + arity * sizes[-1])
        number = [np.zeros(1, np.int64)]
        for arity, size in zip(reversed(self.arities), reversed(sizes[:-1]), strict=True):
            first = number[0][:, None] + 1
            number.insert(0, (first + size * np.arange(arity)).reshape(-1))
        return tuple(number), tuple(sizes)

    def gather(self, values: FloatArray, empty: float = 0.0) -> FloatArray:
        """Values of primitives (n, ...) in slots: (leaves, leaf_size, ...), `empty` elsewhere."""
        out = values[np.maximum(self.slots, 0)]
        out[self.slots == NO_PRIMITIVE] = empty
        return out


def build_hierarchy(points: FloatArray, *, leaf_size: int = 8, arity: int = 4) -> Hierarchy:
    """A tree over points (n, 3), n >= 1: each split halves a node along its longest side.

    arity: 2 or 4 (two splits at once; the root may have 2 children).

    O(n log n): each of log2(n / leaf_size) levels is one partial sort.
    """
    if arity not in (2, 4):
        raise ValueError(f"arity must be 2 or 4, not {arity}")
    rows = np.arange(len(points), dtype=np.int64)[None]
    depth = max(0, math.ceil(math.log2(len(points) / leaf_size)))
    for _ in range(depth):
        rows = _split(points, rows)
    if arity == 2:
        return Hierarchy(rows, (2,) * depth)
    return Hierarchy(rows, (4,) * (depth // 2) + (2,) * (depth % 2))


def _split(points: FloatArray, rows: IntArray) -> IntArray:
    """Rows (k, w) of indices, of which the last may be empty, halved: (2k, ceil(w/2)).

    If each row holds w or w - 1 indices, each of the new ones holds ceil(w/2) or one less.
    """
    width = rows.shape[1]
    half = (width + 1) // 2
    empty = rows == NO_PRIMITIVE
    p = points[np.maximum(rows, 0)]
    low = np.where(empty[..., None], np.inf, p).min(axis=1)
    high = np.where(empty[..., None], -np.inf, p).max(axis=1)
    axis = (high - low).argmax(axis=1)
    key = np.take_along_axis(p, axis[:, None, None], axis=2)[..., 0]
    key[empty] = np.inf
    middle = width // 2
    order = np.argpartition(key, sorted({middle, width - 1}), axis=1)
    rows = np.take_along_axis(rows, order, axis=1)
    left, right = rows[:, :half].copy(), np.full((len(rows), half), NO_PRIMITIVE, np.int64)
    right[:, : width - half] = rows[:, half:]
    if width % 2:  # 2m + 1 slots for 2m primitives: m on either side
        short = rows[:, -1] == NO_PRIMITIVE
        right[short, : half - 1] = rows[short, half - 1 : width - 1]
        left[short, half - 1] = NO_PRIMITIVE
    return np.stack([left, right], axis=1).reshape(-1, half)
