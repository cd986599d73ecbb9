"""Lists of different lengths, stored one after the other in one array. Their lengths are integers
(m,); "entries" are the elements of all lists."""

from __future__ import annotations

import numpy as np

from harnack.backend.validation import IntArray

__all__ = ["next_in_lists", "ranks_in_lists"]


def ranks_in_lists(sizes: IntArray) -> IntArray:
    """The position of each entry within its own list: sizes (2, 3) give (0, 1, 0, 1, 2)."""
    ranks = np.arange(int(sizes.sum()), dtype=np.int64)
    ranks -= np.repeat(np.cumsum(sizes) - sizes, sizes)
    return ranks


def next_in_lists(sizes: IntArray) -> IntArray:
    """For each entry the index of the next entry of the same list; after the last entry of a list
    comes its first: sizes (2, 3) give (1, 0, 3, 4, 2)."""
    following = np.arange(1, int(sizes.sum()) + 1, dtype=np.int64)
    sizes = sizes[sizes > 0]
    ends = np.cumsum(sizes)
    # The last entry of each list is followed by its first.
    following[ends - 1] = ends - sizes
    return following
