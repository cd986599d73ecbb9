"""Edges of triangles and tetrahedra; products, norms and directions of rows; normals of triangles,
and distances from triangles. A pair is a row (a, b) of two indices of points, and the pairs (a, b)
and (b, a) are the same edge. Faces (m, 3) hold the indices of the corners of triangles. A half-edge
is an edge of a face in the direction in which the face runs it.

`row_dots` and `row_norms` are here because numpy's own sums along an axis of length three are slow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray

__all__ = [
    "Edges",
    "area_normals",
    "boundary_edges",
    "distance_from_triangles",
    "distances_from_triangles",
    "edge_keys",
    "half_edges",
    "has_distinct_corners",
    "limited_rows",
    "longest_edges",
    "normals_at_vertices",
    "row_dots",
    "row_norms",
    "shortest_edges_at_vertices",
    "sorted_unique",
    "unique_with_inverse",
    "unit_normals",
    "unit_rows",
]

# Divisors are at least this, so that nothing is divided by 0.
_TINY = 1e-300


def row_dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """The dot product (n,) of each row of `a` with the same row of `b`, both (n, 3)."""
    return np.einsum("ij,ij->i", a, b)


def area_normals(corners: FloatArray) -> FloatArray:
    """Normals (m, 3) of triangles with corners (m, 3, 3), by the right-hand rule; their lengths are
    twice the areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def row_norms(vectors: FloatArray) -> FloatArray:
    """The lengths (n,) of vectors (n, 3)."""
    return np.sqrt(row_dots(vectors, vectors))


def unit_rows(vectors: FloatArray) -> FloatArray:
    """The vectors (n, 3) divided by their lengths; vectors of length 0 stay as they are."""
    return vectors / np.maximum(row_norms(vectors), _TINY)[:, None]


def limited_rows(vectors: FloatArray, max_length: FloatArray) -> FloatArray:
    """The vectors (n, 3), of which those longer than `max_length` (n,) are shortened to that."""
    return vectors * np.minimum(1, max_length / np.maximum(row_norms(vectors), _TINY))[:, None]


def unit_normals(corners: FloatArray) -> FloatArray:
    """Unit normals (m, 3) of triangles with corners (m, 3, 3), by the right-hand rule; 0 for
    triangles without an area."""
    return unit_rows(area_normals(corners))


def normals_at_vertices(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """For each of the vertices (n, 3) the sum (n, 3) of the `area_normals` of the faces there."""
    normals, sums = area_normals(vertices[faces]), np.zeros_like(vertices)
    for k in range(3):
        np.add.at(sums, faces[:, k], normals)
    return sums


def shortest_edges_at_vertices(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """For each of the vertices (n, 3) the length (n,) of the shortest edge of the faces there; inf
    for vertices without a face."""
    corners, lengths = vertices[faces], np.full(len(vertices), np.inf)
    shortest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)
    for k in range(3):
        np.minimum.at(lengths, faces[:, k], shortest)
    return lengths


def longest_edges(corners: FloatArray) -> FloatArray:
    """The length (m,) of the longest edge of each triangle with corners (m, 3, 3)."""
    return np.max([row_norms(corners[:, k] - corners[:, k - 1]) for k in range(3)], axis=0)


def distance_from_triangles(point: FloatArray, corner: FloatArray) -> float:
    """The distance of a point (3,) from the nearest of k triangles, whose corners are `corner` (k,
    3, 3). It is infinite if there are no triangles."""
    return float(distances_from_triangles(point, corner).min(initial=np.inf))


def distances_from_triangles(points: FloatArray, corner: FloatArray) -> FloatArray:
    """The distances (k,) of points (k, 3), each from the triangle with the same index in `corner`
    (k, 3, 3); or of a single point (3,) from all triangles. A distance is the smallest distance of
    the point from the triangle's edges and, if the projection of the point lies in the triangle,
    from its plane. It is exact up to rounding."""
    distance = np.full(len(corner), np.inf)
    for k in range(3):
        start, edge = corner[:, k], corner[:, k - 1] - corner[:, k]
        fraction = row_dots(points - start, edge) / np.maximum(row_dots(edge, edge), _TINY)
        foot = start + np.clip(fraction, 0, 1)[:, None] * edge
        distance = np.minimum(distance, row_norms(points - foot))
    normal = area_normals(corner)
    size = row_norms(normal)
    is_within = size > 0  # a triangle without an area has edges alone
    size = np.maximum(size, _TINY)
    # The foot of the perpendicular on the plane lies in the triangle if it is on the inner side of
    # all edges.
    height = row_dots(points - corner[:, 0], normal) / size
    foot = points - (height / size)[:, None] * normal
    for k in range(3):
        side = np.cross(corner[:, (k + 1) % 3] - corner[:, k], foot - corner[:, k])
        is_within &= row_dots(side, normal) >= 0
    return np.where(is_within, np.minimum(distance, np.abs(height)), distance)


@dataclass(frozen=True)
class Edges:
    """The distinct edges among n pairs of indices of points. A pair (a, b) and its reverse (b, a)
    are the same edge. `edge_of_pair` is the index of each pair's edge, and `multiplicity` the
    number of pairs of each edge.

    vertices: (k, 2) the two ends of each of the k edges, the lower index first, in lexicographic
        order.
    edge_of_pair: (n,) for each pair, the index of its edge.
    multiplicity: (k,) for each edge, the number of pairs that are this edge.
    pairs_by_edge: (n,) the indices of the pairs, in the order of their edges.
    """

    vertices: IntArray
    edge_of_pair: IntArray
    multiplicity: IntArray
    pairs_by_edge: IntArray

    @classmethod
    def of(cls, pairs: IntArray) -> Edges:
        """Find the distinct edges among pairs (n, 2) of indices of points."""
        count = int(pairs.max(initial=-1)) + 1
        keys, index, uses, order = unique_with_inverse(edge_keys(pairs, count))
        return cls(np.stack(np.divmod(keys, max(count, 1)), axis=1), index, uses, order)

    def paired_half_edges(self) -> IntArray:
        """For each edge that exactly two pairs are, the indices of these two pairs, (j, 2). If the
        pairs are the half-edges of faces, they show which two faces meet at an edge."""
        return self.pairs_by_edge[np.repeat(self.multiplicity == 2, self.multiplicity)].reshape(
            -1, 2
        )

    def run_twice_alike(self, pairs: IntArray) -> BoolArray:
        """The mask (k,) of the edges of which there are exactly two pairs, both in the same
        direction. If the pairs are the half-edges of faces, the two faces at such an edge do not
        agree which side of the surface is which.

        pairs: (n, 2) the pairs of which these are the edges.
        """
        directions = np.where(pairs[:, 0] < pairs[:, 1], 1, -1)
        sums = np.bincount(self.edge_of_pair, directions, minlength=len(self.multiplicity))
        return (self.multiplicity == 2) & (sums != 0)


def edge_keys(pairs: IntArray, count: int) -> IntArray:
    """An integer (k,) for each pair (k, 2) of indices below `count`: the same for a pair and its
    reverse, and different for different edges."""
    first, second = pairs.T
    return np.minimum(first, second) * count + np.maximum(first, second)


def half_edges(faces: IntArray) -> IntArray:
    """The edges of faces (m, 3) in the directions in which the faces run them, as pairs (3m, 2) of
    indices of points. First come the edges of all faces from corner 0 to corner 1, then those from
    1 to 2, then those from 2 to 0. So row k m + i is edge k of face i."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def has_distinct_corners(faces: IntArray) -> BoolArray:
    """(m,) whether the three corners of each of the faces (m, 3) are different vertices."""
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def boundary_edges(faces: IntArray) -> IntArray:
    """The edges (k, 2) that only a single one of the faces (m, 3) has. Each is given by the indices
    of its ends, in the direction in which its face runs it."""
    pairs = half_edges(faces)
    edges = Edges.of(pairs)
    return pairs[edges.multiplicity[edges.edge_of_pair] == 1]


def sorted_unique(keys: IntArray) -> IntArray:
    """The distinct values of integers (n,), in increasing order; several times as fast as
    `np.unique`."""
    keys = np.sort(keys)
    return keys[np.flatnonzero(np.diff(keys, prepend=keys[:1] - 1))]


def unique_with_inverse(keys: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """What `np.unique` computes for nonnegative integers (n,), in a third of the time. Returns four
    arrays: the distinct values (k,) in increasing order; for each integer the index (n,) of its
    value; the number (k,) of integers with each value; and the permutation (n,) that sorts the
    integers."""
    bits = len(keys).bit_length()
    # Keys too large to stand in one word with an index.
    if int(keys.max(initial=0)) >> (62 - bits):
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
    else:
        # Key and index in one word, since sorting is far faster than `argsort`.
        keys_with_index = np.sort((keys << bits) | np.arange(len(keys)))
        order, ordered = keys_with_index & ((1 << bits) - 1), keys_with_index >> bits
    is_first = np.ones(len(keys), np.bool_)
    is_first[1:] = ordered[1:] != ordered[:-1]
    index = np.empty(len(keys), np.int64)
    index[order] = np.cumsum(is_first) - 1
    start = np.flatnonzero(is_first)
    return ordered[start], index, np.diff(start, append=len(keys)), order
