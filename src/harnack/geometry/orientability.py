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
    import scipy.sparse  # imported here, as it takes half a second and few programs need it
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    m = len(faces)
    pairs, index, uses = _edges(faces)
    order = np.argsort(index, kind="stable")
    first, second = order[(uses == 2)[index[order]]].reshape(-1, 2).T
    is_reversed = ((pairs[first] == pairs[second]).all(axis=1)).astype(np.int64)
    first, second = first % m, second % m
    # Each face as it is, and reversed (m more); neighbors that agree are joined.
    rows = np.concatenate([first, first + m])
    columns = np.concatenate([second + m * is_reversed, second + m * (1 - is_reversed)])
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    return np.asarray(csgraph.connected_components(joined, directed=False)[1], np.int64)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Edges (3m, 2) in the direction in which faces run them, the first edges of all faces first;
    the index (3m,) of each as an undirected edge; and for each undirected edge the number of faces
    that run it."""
    pairs = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    keys = pairs.min(axis=1) * (int(pairs.max(initial=0)) + 1) + pairs.max(axis=1)
    _, index, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return pairs, index, uses
