"""Orientability of triangle meshes: whether a mesh has two sides, or a single one as a Moebius
strip."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from harnack.backend.validation import IntArray

__all__ = ["is_nonorientable", "orientation_components"]


def is_nonorientable(faces: IntArray) -> bool:
    """Whether the mesh has a boundary and all of its components are non-orientable, like a Moebius
    strip. Components are connected across edges with exactly two faces."""
    if not (_edges(faces)[2] == 1).any():
        return False
    part = orientation_components(faces)
    return bool((part[: len(faces)] == part[len(faces) :]).all())


def orientation_components(faces: IntArray) -> IntArray:
    """(2m,) component labels in the orientation double cover of m faces: entry k is for face k as
    given, entry m + k for face k reversed.

    Neighbors with consistent orientation share a label. A face and its reverse have the same label
    if and only if their component is non-orientable.
    """
    import scipy.sparse  # here: half a second that few need
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    m = len(faces)
    pairs, index, uses = _edges(faces)
    order = np.argsort(index, kind="stable")
    one, other = order[(uses == 2)[index[order]]].reshape(-1, 2).T
    same = ((pairs[one] == pairs[other]).all(axis=1)).astype(np.int64)
    one, other = one % m, other % m
    # Each face as it is and turned over (m more); neighbors that agree are joined.
    rows = np.concatenate([one, one + m])
    columns = np.concatenate([other + m * same, other + m * (1 - same)])
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    return np.asarray(csgraph.connected_components(joined, directed=False)[1], np.int64)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Edges (3m, 2) in the direction in which faces run them, the first edges of all faces first;
    the index (3m,) of each as an undirected edge; and for each undirected edge how many faces run
    it."""
    pairs = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    keys = pairs.min(axis=1) * (int(pairs.max(initial=0)) + 1) + pairs.max(axis=1)
    _, index, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return pairs, index, uses
