"""Near points, and what is connected through them: search trees, pairs and graphs, by SciPy."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from harnack.backend.validation import FloatArray, IntArray

__all__ = ["connected_groups", "kd_tree", "pairs_within"]


def kd_tree(points: FloatArray, *, is_balanced: bool = True) -> Any:
    """SciPy's `cKDTree` of points (n, d), in which the nearest ones are searched.

    is_balanced: False for a tree that is built faster and searched more slowly.
    """
    import scipy.spatial  # imported here: it takes half a second, and few programs need it

    spatial = cast("Any", scipy.spatial)
    return spatial.cKDTree(points, compact_nodes=is_balanced, balanced_tree=is_balanced)


def pairs_within(points: FloatArray, distance: float) -> IntArray:
    """The pairs of points (n, 3) that are at most `distance` apart, as indices (k, 2)."""
    pairs = kd_tree(points).query_pairs(distance, output_type="ndarray")
    return np.asarray(pairs, np.int64).reshape(-1, 2)


def connected_groups(pairs: IntArray, count: int) -> IntArray:
    """The connected components of a graph with the nodes 0 to count - 1 and the edges `pairs` (k,
    2). Returns the number (count,) of each node's component. Components are numbered in the order
    of their first nodes."""
    import scipy.sparse  # imported here: it takes half a second, and few programs need it
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    joined = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    # (The first result is the number of components.)
    return np.asarray(csgraph.connected_components(joined, directed=False)[1], np.int64)
