"""Lists of nodes and primitives of a tree, a list for each lane, built and traversed in Dr.Jit.

- `LaneLists`: many lists of integers, one list after the other in memory.
- `build_lists`: builds lists by a walk that runs twice, to count entries and to write them.
- `traverse_subtrees`: visits the subtrees of the listed nodes; `for_each_entry`: a loop over the
  entries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend import IntArray, to_numpy
from harnack.backend.arrays import upload_integers
from harnack.tree.balanced_tree import LoopValues, PackedTree, Visit, VisitedNode

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask

WriteEntry: TypeAlias = "Callable[[Any, Any, Mask], None]"
"""Writes an entry, where active, at a place in the list of its lane."""


_TOO_LONG = "more than 2^31 entries of lists: cut the input in parts"


@dataclass(frozen=True)
class LaneLists:
    """A list for each lane. first: the index in `entries` at which it begins. count: its length.
    entries: the entries of all lists."""

    first: Any
    count: Any
    entries: Any

    @classmethod
    def of_root(cls, backend: Backend) -> LaneLists:
        """A single list, whose only entry is the root of a tree."""
        index = backend.UInt32
        return cls(index(0), index(1), index(0))

    @classmethod
    def empty(cls, backend: Backend) -> LaneLists:
        """A single list, which is empty."""
        index = backend.UInt32
        return cls(index(0), index(0), index(0))

    @classmethod
    def concatenate(cls, backend: Backend, parts: list[LaneLists]) -> LaneLists:
        """The lists of the lanes of all parts, part after part. In each part, the first list must
        begin at entry 0 and the lists follow each other."""
        counts = np.concatenate([to_numpy(part.count) for part in parts])
        entries = [to_numpy(part.entries)[: int(to_numpy(part.count).sum())] for part in parts]
        first = np.cumsum(counts, dtype=np.int64) - counts
        if first[-1] + counts[-1] >= 2**31:
            raise ValueError(_TOO_LONG)
        arrays = first, counts, np.append(np.concatenate(entries), 0)
        return cls(*(upload_integers(backend, part) for part in arrays))

    def subset(self, backend: Backend, lanes: IntArray) -> LaneLists:
        """The lists of these lanes; a lane may occur several times."""
        index = backend.UInt32
        uploaded = upload_integers(backend, lanes)
        first, count = (dr.gather(index, numbers, uploaded) for numbers in (self.first, self.count))
        return LaneLists(first, count, self.entries)


def build_lists(backend: Backend, walk: Callable[[WriteEntry | None], Any]) -> LaneLists:
    """Build lists from a walk. walk: returns the number of entries of each lane, and writes each
    entry if it is called with a `WriteEntry` instead of None."""
    index = backend.UInt32
    count = walk(None)
    dr.eval(count)
    start = np.concatenate([[0], np.cumsum(to_numpy(count).astype(np.int64))])
    if start[-1] >= 2**31:
        raise ValueError(_TOO_LONG)
    first, entries = upload_integers(backend, start[:-1]), dr.zeros(index, max(1, int(start[-1])))

    def put(position: Any, entry: Any, active: Mask) -> None:
        dr.scatter(entries, index(entry), first + position, active)

    dr.eval(walk(put), entries)
    return LaneLists(first, count, entries)


def traverse_subtrees(
    tree: PackedTree, lists: LaneLists, visit: Visit, state: LoopValues
) -> LoopValues:
    """The state after a walk (`balanced_tree.traverse`) over the subtrees of the listed nodes."""
    index = tree.backend.UInt32

    def body(k: Any, i: Any, end: Any, *state: Any) -> LoopValues:
        begins = i == end
        entry = dr.gather(index, lists.entries, lists.first + k, begins & (k < lists.count))
        i = dr.select(begins, entry, i)
        head = tree.head(i)
        after, is_leaf, number = index(head[6]), head[7] >= 0, index(dr.abs(head[7]))
        end = dr.select(begins, after, end)
        descend, state = visit(VisitedNode(tree, i, tuple(head[:6]), number, is_leaf), state)
        i = dr.select(descend & ~is_leaf, number, after)
        return k + dr.select(i == end, index(1), index(0)), i, end, *state

    def is_running(k: Any, *_: Any) -> Mask:
        return k < lists.count

    start = (index(0), index(0), index(0), *state)
    return dr.while_loop(start, is_running, body, label="subtrees")[3:]


def for_each_entry(
    backend: Backend,
    lists: LaneLists,
    body: Callable[[Any, Mask, LoopValues], LoopValues],
    state: LoopValues,
) -> LoopValues:
    """The state after `body` of each entry of the lists, where active."""
    index = backend.UInt32

    def step(k: Any, *state: Any) -> LoopValues:
        active = k < lists.count
        entry = dr.gather(index, lists.entries, lists.first + k, active)
        return k + 1, *body(entry, active, state)

    def is_running(k: Any, *_: Any) -> Mask:
        return k < lists.count

    return dr.while_loop((index(0), *state), is_running, step, label="entries")[1:]
