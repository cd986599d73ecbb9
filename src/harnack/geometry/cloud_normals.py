"""Normals of point clouds that have none: local planes, turned to agree with each other."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend.numbers import FloatArray, IntArray, vector_text
from harnack.geometry.clouds import (
    CloudError,
    check_neighbours,
    checked_points,
    in_parts,
    nearest_others,
    point_tree,
)
from harnack.geometry.singular import weld_vertices

__all__ = ["estimate_normals"]

Indices = npt.NDArray[np.int64] | npt.NDArray[np.int32]

# Of the variances of a neighbourhood, the second over the first: below it lies on a line.
_LINE = 1e-9
# Where to look for extreme points: towards the faces, edges and corners of a cube.
_DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])


def estimate_normals(points: npt.ArrayLike, neighbours: int = 16) -> FloatArray:
    """Unit normals (n, 3), outward, of points (n, 3) that sample a surface.

    Hoppe et al. 1992. The line of a normal is that in which a point and its nearest neighbours
    vary least. Its direction is carried from point to point along the tree that spans the graph of
    neighbours and in which normals agree best, mirrored as Xie et al. 2003 propose, which carries
    it around edges and thin walls. What then remains is one sign for each connected piece of the
    graph: the one with which the piece's extreme points in 26 directions face outward, added up.
    That sign is right for a closed surface, however unevenly sampled.

    So each piece faces outward by itself: the inner wall of a hollow body does not face its cavity,
    and how an open surface faces is a convention (a flat one: to the positive side of the axis
    nearest to its normal). Where details are smaller than neighbourhoods, normals may be turned
    wrongly. Look at the result.

    Points at the same position get the same normal.

    Raises:
        CloudError: as `validate_cloud` for points; fewer than 4 positions; neighbourhoods on a
            line, which have no plane; fewer than 3 neighbours.
    """
    x = checked_points(points)
    check_neighbours(neighbours)
    positions, where = np.unique(weld_vertices(x), return_inverse=True)
    x = x[positions]
    if len(x) < 4:
        raise CloudError(f"{len(x)} different points do not show a surface: give at least 4")
    normals, nearest = _planes(x, neighbours)
    piece, parent = _spanning_forest(x, normals, nearest)
    sign = _carried_signs(x, normals, parent)
    normals *= sign[:, None]
    normals *= _outward_signs(x, normals, piece)[piece, None]
    return normals[where]


def _planes(x: FloatArray, neighbours: int) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Normals (n, 3) of any sign, and the indices of the neighbours (n, k)."""
    tree = point_tree(x)
    normals = np.empty_like(x)
    nearest = np.empty((len(x), min(neighbours, len(x) - 1)), dtype=np.int32)
    on_line = np.zeros(len(x), dtype=bool)

    def fit(part: slice) -> None:
        index, distance = nearest_others(tree, x[part], neighbours)
        nearest[part] = index
        offsets = (x[index] - x[part, None]) / distance[:, -1, None, None]
        offsets = np.concatenate([offsets, np.zeros_like(offsets[:, :1])], axis=1)
        offsets -= offsets.mean(axis=1, keepdims=True)
        variances, axes = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))
        normals[part] = axes[:, :, 0]
        on_line[part] = variances[:, 1] <= _LINE * variances[:, 2]

    in_parts(fit, len(x))
    if on_line.any():
        first = int(np.flatnonzero(on_line)[0])
        raise CloudError(
            f"the {nearest.shape[1]} nearest neighbours of {on_line.sum():,} points lie on a line, "
            f"first of {vector_text(x[first])}: they show no surface; ask for more neighbours, or "
            "give normals"
        )
    return normals, nearest


def _agreement(x: FloatArray, normals: FloatArray, i: Indices, j: Indices) -> FloatArray:
    """The product of each normal i with normal j mirrored in the plane that bisects i and j: (m,).

    On a circle, across an edge between two planes and across a thin wall it is 1 if both face
    outward (Xie et al. 2003).
    """
    edge = x[j] - x[i]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    edge /= np.where(length > 0.0, length, 1.0)
    a, b = normals[i], normals[j]
    along = np.einsum("ij,ij->i", edge, a) * np.einsum("ij,ij->i", edge, b)
    return np.einsum("ij,ij->i", a, b) - 2.0 * along


def _spanning_forest(
    x: FloatArray, normals: FloatArray, nearest: npt.NDArray[np.int32]
) -> tuple[IntArray, IntArray]:
    """For each point its piece (n,), from 0, and its parent (n,); a root is its own parent."""
    import scipy.sparse  # here: half a second that few need

    sparse: Any = scipy.sparse
    n, k = nearest.shape
    weight = np.empty((n, k))

    def weigh(part: slice) -> None:
        start = np.repeat(np.arange(part.start, part.stop, dtype=np.int64), k)
        agreement = np.abs(_agreement(x, normals, start, nearest[part].ravel()))
        # An edge of weight 0 would be no edge.
        weight[part] = np.maximum(1.0 - agreement, 0.0).reshape(-1, k) + 1e-9

    in_parts(weigh, n)
    first = np.arange(0, n * k + 1, k, dtype=np.int64)
    graph = sparse.csr_array((weight.ravel(), nearest.ravel(), first), shape=(n, n))
    forest = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    _, piece = sparse.csgraph.connected_components(forest, directed=False)
    # One more point joins the pieces, so that one search from it visits all.
    _, roots = np.unique(piece, return_index=True)
    start = np.concatenate([forest.row, np.full(len(roots), n)])
    end = np.concatenate([forest.col, roots])
    joined = sparse.csr_array((np.ones(len(start)), (start, end)), shape=(n + 1, n + 1))
    _, before = sparse.csgraph.breadth_first_order(joined, n, directed=False)
    parent = np.asarray(before[:n], dtype=np.int64)
    parent[roots] = roots
    return np.asarray(piece, dtype=np.int64), parent


def _carried_signs(x: FloatArray, normals: FloatArray, parent: IntArray) -> FloatArray:
    """The sign (n,) of each normal with which it agrees with its root, along the way to it.

    Pointer doubling: after step i, `parent` is the ancestor 2^i levels up, or the root.
    """
    agreement = _agreement(x, normals, np.arange(len(x)), parent)
    sign = np.where(agreement < 0.0, -1.0, 1.0)
    while True:
        above = parent[parent]
        if np.array_equal(above, parent):
            return sign
        sign *= sign[parent]
        parent = above


def _outward_signs(x: FloatArray, normals: FloatArray, piece: IntArray) -> FloatArray:
    """The sign (p,) of each piece with which its extreme points face outward."""
    by_piece = np.argsort(piece, kind="stable")
    x, normals, piece = x[by_piece], normals[by_piece], piece[by_piece]
    starts = np.flatnonzero(np.append(True, piece[1:] != piece[:-1]))
    outwardness = np.zeros(len(starts))
    for direction in _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True):
        height = x @ direction
        highest = np.flatnonzero(height == np.maximum.reduceat(height, starts)[piece])
        _, first = np.unique(piece[highest], return_index=True)
        outwardness += normals[highest[first]] @ direction
    total = np.add.reduceat(normals, starts)
    main = np.take_along_axis(total, np.abs(total).argmax(axis=1)[:, None], axis=1)[:, 0]
    decisive = np.where(np.abs(outwardness) > 1e-6, outwardness, main)
    return np.where(decisive < 0.0, -1.0, 1.0)
