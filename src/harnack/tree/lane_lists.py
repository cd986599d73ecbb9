"""Lists of integers, such as indices of nodes or primitives of a tree, one list for each lane. A
lane is an entry of Dr.Jit's arrays, such as a query point. Lists are built and traversed in Dr.Jit.

- `LaneLists`: many lists, one after the other in memory.
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
"""Called with a position, an entry and a mask: writes the entry into the list of each lane."""


_TOO_LONG = "more than 2^31 entries of lists: cut the input in parts"


@dataclass(frozen=True)
class LaneLists:
    """One list of integers for each lane, where a lane is an entry of Dr.Jit's arrays, such as a
    query point.

    first: the index in `entries` at which each list begins.
    count: the length of each list.
    entries: the entries of all lists, one list after the other.
    """

    first: Any
    count: Any
    entries: Any

    @classmethod
    def of_root(cls, backend: Backend) -> LaneLists:
        """The list of a single lane, whose only entry is 0, the index of the root of a tree."""
        index = backend.UInt32
        return cls(index(0), index(1), index(0))

    @classmethod
    def empty(cls, backend: Backend) -> LaneLists:
        """The list of a single lane, without entries."""
        index = backend.UInt32
        return cls(index(0), index(0), index(0))

    @classmethod
    def concatenate(cls, backend: Backend, parts: list[LaneLists]) -> LaneLists:
        """The lists of all `parts` together: the lists of the first part, then those of the second
        part, and so on.

        In each part, the first list must begin at entry 0, and each further list where the one
        before it ends.

        Raises:
            ValueError: there are 2^31 entries or more.
        """
        counts = np.concatenate([to_numpy(part.count) for part in parts])
        entries = [to_numpy(part.entries)[: int(to_numpy(part.count).sum())] for part in parts]
        first = np.cumsum(counts, dtype=np.int64) - counts
        if first[-1] + counts[-1] >= 2**31:
            raise ValueError(_TOO_LONG)
        # One further entry, so that the array is never empty.
        arrays = first, counts, np.append(np.concatenate(entries), 0)
        return cls(*(upload_integers(backend, part) for part in arrays))

    def subset(self, backend: Backend, lanes: IntArray) -> LaneLists:
        """The lists of some lanes: k lists, for the lanes with indices `lanes` (k,). A lane may
        occur several times. The entries are shared, not copied."""
        index = backend.UInt32
        uploaded = upload_integers(backend, lanes)
        first, count = (dr.gather(index, numbers, uploaded) for numbers in (self.first, self.count))
        return LaneLists(first, count, self.entries)


def build_lists(backend: Backend, walk: Callable[[WriteEntry | None], Any]) -> LaneLists:
    """Build one list for each lane by running the function `walk` twice: to count the entries, and
    to write them.

    walk: called with None, it returns the number of entries of each lane. Called with a
        `WriteEntry`, a function that writes one entry, it also calls that function for each entry.

    Raises:
        ValueError: there are 2^31 entries or more.
    """
    index = backend.UInt32
    count = walk(None)
    dr.eval(count)
    # Where each list begins, and the number of all entries.
    start = np.concatenate([[0], np.cumsum(to_numpy(count).astype(np.int64))])
    if start[-1] >= 2**31:
        raise ValueError(_TOO_LONG)
    # One entry at least, so that the array is never empty.
    first, entries = upload_integers(backend, start[:-1]), dr.zeros(index, max(1, int(start[-1])))

    def write_entry(position: Any, entry: Any, active: Mask) -> None:
        """Write an entry into the list of each active lane. position: the place in the list, from 0
        on."""
        dr.scatter(entries, index(entry), first + position, active)

    dr.eval(walk(write_entry), entries)
    return LaneLists(first, count, entries)


def traverse_subtrees(
    tree: PackedTree, lists: LaneLists, visit: Visit, state: LoopValues
) -> LoopValues:
    """Visit the subtrees whose roots are the listed nodes of a tree, each from its root on, depth
    first; and return the final state. Each lane goes through its own list, one subtree after the
    other.

    lists: the indices of nodes, one list for each lane.
    visit: a function that takes a `VisitedNode` and the state. It returns a mask, whether to visit
        the node's children, and the new state.
    state: a tuple of arrays, which `visit` updates.
    """
    index = tree.backend.UInt32

    def body(k: Any, i: Any, end: Any, *state: Any) -> LoopValues:
        """Visit node i of the subtree of list entry k; `end` is the node after that subtree. If i
        equals `end`, begin the subtree of entry k instead. Returns the next k, i and `end`, and
        then the new state."""
        # At the start i and end are both 0, so that the first subtree begins.
        begins = i == end
        entry = dr.gather(index, lists.entries, lists.first + k, begins & (k < lists.count))
        i = dr.select(begins, entry, i)
        head = tree.head(i)
        # head[6]: the node after the subtree. head[7]: the number of the leaf, or minus the first
        # child.
        after, is_leaf, number = index(head[6]), head[7] >= 0, index(dr.abs(head[7]))
        end = dr.select(begins, after, end)
        descend, state = visit(VisitedNode(tree, i, tuple(head[:6]), number, is_leaf), state)
        i = dr.select(descend & ~is_leaf, number, after)
        return k + dr.select(i == end, index(1), index(0)), i, end, *state

    def is_running(k: Any, *_: Any) -> Mask:
        """Whether entry k of a lane's list exists, so that the list has further entries."""
        return k < lists.count

    start = (index(0), index(0), index(0), *state)
    # Without k, i and `end`.
    return dr.while_loop(start, is_running, body, label="subtrees")[3:]


def for_each_entry(
    backend: Backend,
    lists: LaneLists,
    body: Callable[[Any, Mask, LoopValues], LoopValues],
    state: LoopValues,
) -> LoopValues:
    """Call the function `body` for each entry of each lane's list in `lists`, and return the final
    state.

    body: takes an entry, the mask of the lanes that have one, and the state, a tuple of arrays;
        returns the new state.
    state: the first state.
    """
    index = backend.UInt32

    def step(k: Any, *state: Any) -> LoopValues:
        """Call the caller's function `body` for entry k of the lists. Returns the number of the
        next entry, and then the new state."""
        active = k < lists.count
        entry = dr.gather(index, lists.entries, lists.first + k, active)
        return k + 1, *body(entry, active, state)

    def is_running(k: Any, *_: Any) -> Mask:
        """Whether entry k of a lane's list exists, so that the list has further entries."""
        return k < lists.count

    return dr.while_loop((index(0), *state), is_running, step, label="entries")[1:]
