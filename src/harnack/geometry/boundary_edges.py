"""Edges of meshes, given by the integer indices of their two ends: closed loops of edges, and the
edges of a mesh that do not cancel between its faces. An edge (a, b) is directed; it cancels against
the same edge run the other way, (b, a). A mesh is welded if vertices at the same position have the
same index. Edges are compared by index, never by distance: near edges do not cancel, however near
they are.

At the edges that do not cancel the winding number of the mesh is singular. Let T be the triangles
of a mesh, m_T integers, and Omega_T(x) the signed solid angle of T seen from x. Then

    w = 1/(4 pi) sum_T m_T Omega_T

jumps by m_T across T. With its jumps removed along a ray it is smooth everywhere but on the
*singular edges*: edges whose weights, summed over the triangles around them, do not cancel.

Proof. Off T, Omega_T is harmonic, and by Stokes its gradient is the integral of Biot and Savart
along the boundary of T alone (Gillespie et al. 2024, Eq. 11, edge by edge): grad Omega_T(x) is the
sum of B_e(x) over the edges e of T, where B_e is analytic off the segment e and B_{-e} = -B_e.
Hence, off the triangles, 4 pi grad w = G with G = sum_e n_e B_e. Here n_e, the weight of the edge
e, is the sum of the m_T with the sign with which e runs around T. Edges with n_e = 0 drop out, so G
extends to an analytic field on R^3 minus S, where S is the union of the other edges. G is curl and
divergence free there by continuity, so around every point off S it has a local potential, and this
is harmonic. The integral of G along a closed path off S is a multiple of 4 pi: move the path
slightly so that it meets triangles in their interiors only. Between these crossings the integral
follows 4 pi w, and each crossing of T adds +-4 pi m_T. So 4 pi w mod 4 pi extends to a function on
R^3 minus S that is harmonic in the neighborhood of each point, with values mod 4 pi. QED.

The n_e are the boundary of an integral chain, so at each vertex as much weight begins as ends: S
consists of closed loops, and 4 pi w is mod 4 pi the solid angle of these loops.

Functions of arrays take linear time but for a sort, about a second for a million triangles;
`boundary_edges`, `join_edges` and `singular_loops` take a Python step per edge.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from harnack.backend.validation import FloatArray, IntArray

__all__ = [
    "NetFaces",
    "net_edges",
    "net_faces",
    "singular_edges",
    "singular_loops",
    "weld_vertices",
]

Edge = tuple[int, int]


class OpenChainError(ValueError):
    """Edges do not form closed loops.

    vertex: a vertex at which a chain of edges ends, or at which too many edges meet.
    count: the number of edges at this vertex.
    """

    def __init__(self, vertex: int, count: int) -> None:
        super().__init__(f"{count} edges meet at vertex {vertex}")
        self.vertex = vertex
        self.count = count


def boundary_edges(faces: Iterable[Sequence[int]]) -> list[Edge]:
    """The directed edges of faces that remain when each edge cancels against the same edge run the
    other way. An edge is listed as often as it remains. At every vertex the same number of them
    begins and ends, because that holds for each face.

    faces: each the indices of its vertices, in order around the face.
    """
    net: Counter[Edge] = Counter()
    for face in faces:
        for a, b in zip(face, (*face[1:], face[0]), strict=True):
            # Counted in the direction from the lower to the higher index; the reverse counts -1.
            if a < b:
                net[a, b] += 1
            elif a > b:
                net[b, a] -= 1
    remaining: list[Edge] = []
    for (a, b), count in net.items():
        remaining += [(a, b)] * count if count > 0 else [(b, a)] * -count
    return remaining


def join_edges(edges: Sequence[Edge]) -> list[list[int]]:
    """Join all edges (start, end) to closed loops, each a list of vertex indices.

    If at every vertex as many edges begin as end, the edges keep their directions, and a loop ends
    where it first returns to one of its own vertices. Otherwise exactly two edges must meet at
    every vertex, and each loop runs in the direction of its first edge.

    Raises:
        OpenChainError: neither is the case.
    """
    balance: Counter[int] = Counter()
    for a, b in edges:
        balance[a] += 1
        balance[b] -= 1
    if any(balance.values()):
        edges = _orient_consistently(edges)
    leaving: defaultdict[int, list[int]] = defaultdict(list)
    # Reversed, since edges are taken from the end of each list.
    for a, b in reversed(edges):
        leaving[a].append(b)
    loops: list[list[int]] = []
    for a, _ in edges:
        while leaving[a]:
            loops += _loops_through(a, leaving)
    return loops


def _loops_through(start: int, leaving: dict[int, list[int]]) -> list[list[int]]:
    """Follow edges from the vertex `start` until they return to it. Returns the loops that this
    path forms, each a list of vertices. The edges of these loops are removed from `leaving`.

    leaving: for each vertex the ends of the edges that begin there.
    """
    loops: list[list[int]] = []
    path = [start]
    position = {start: 0}
    while True:
        vertex = leaving[path[-1]].pop()
        if vertex in position:
            # The path meets itself: what lies between is a loop, and the rest of the path goes on.
            loop_begin = position[vertex]
            loops.append(path[loop_begin:])
            for vertex_in_loop in path[loop_begin + 1 :]:
                del position[vertex_in_loop]
            del path[loop_begin + 1 :]
            if loop_begin == 0:
                return loops
        else:
            position[vertex] = len(path)
            path.append(vertex)


def _orient_consistently(edges: Sequence[Edge]) -> list[Edge]:
    """The edges, reversed where necessary, so that each loop runs in the direction of its first
    edge. They are listed loop by loop.

    Raises:
        OpenChainError: more or fewer than two edges meet at a vertex.
    """
    touching: defaultdict[int, list[int]] = defaultdict(list)
    for k, (a, b) in enumerate(edges):
        touching[a].append(k)
        touching[b].append(k)
    for vertex, edge_ids in touching.items():
        if len(edge_ids) != 2:
            raise OpenChainError(vertex, len(edge_ids))
    used = [False] * len(edges)
    oriented: list[Edge] = []
    for k in range(len(edges)):
        start, vertex = edges[k]
        edge = k
        while not used[edge]:
            used[edge] = True
            oriented.append((start, vertex))
            first, second = touching[vertex]
            edge = second if first == edge else first
            # The other end of the next edge.
            start, vertex = vertex, sum(edges[edge]) - vertex
    return oriented


# 2^64 over the golden ratio, made odd: the multiplier of Fibonacci hashing (Knuth, TAOCP 6.4).
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


class NetFaces(NamedTuple):
    """The faces of a mesh after duplicates were added up: a face counts +1 for each copy with its
    orientation and -1 for each reversed copy.

    faces: (k, 3), no two faces with the same three vertices.
    multiplicity: (k,) how often each face counts, positive.
    source: (k,) ascending: entry i is the index of the first original face that has the vertices
        and the orientation of `faces[i]`.
    """

    faces: IntArray
    multiplicity: IntArray
    source: IntArray


def weld_vertices(vertices: FloatArray) -> IntArray:
    """For each vertex (n, 3) the index (n,) of the first vertex at exactly the same position; -0.0
    equals 0.0. `weld_vertices(vertices)[faces]` are the faces of the welded mesh."""
    # Adding 0.0 turns -0.0 into 0.0; then equal numbers have equal bits.
    bits = (np.ascontiguousarray(vertices, dtype=np.float64) + 0.0).view(np.uint64)
    order, starts = _group_equal_rows(bits)
    first = np.minimum.reduceat(order, starts) if len(order) else order
    welded = np.empty(len(bits), dtype=np.int64)
    welded[order] = np.repeat(first, _group_lengths(starts, len(order)))
    return welded


def net_faces(faces: IntArray) -> NetFaces:
    """Add up duplicates among the faces (m, 3) of a welded mesh: a face with the same three
    vertices counts +1 if it has the same orientation, -1 if it is reversed. It makes no difference
    at which corner a face begins. A face whose sum is 0 is left out, and so is a face with two
    equal vertices, which has no area. The remaining faces are oriented so that their multiplicity
    is positive, in the order of the original faces."""
    a, b, c = faces.T
    proper = np.flatnonzero((a != b) & (b != c) & (c != a))
    corners = np.sort(faces[proper], axis=1)
    a, b, c = faces[proper].T
    # A cyclic shift of a sorted row has one descent, any other order has two.
    descents = (a > b).astype(np.int64) + (b > c) + (c > a)
    sign = np.where(descents == 1, 1, -1)
    if not len(proper):
        empty = np.zeros(0, dtype=np.int64)
        return NetFaces(empty.reshape(0, 3), empty, empty)
    order, starts = _group_equal_rows(corners.view(np.uint64))
    # The sum of each group of faces with the same vertices.
    net = np.add.reduceat(sign[order], starts)
    group_sign = np.repeat(np.sign(net), _group_lengths(starts, len(order)))
    # The first face of the group with the orientation that remains.
    agreeing = np.where(sign[order] == group_sign, proper[order], np.iinfo(np.int64).max)
    source = np.minimum.reduceat(agreeing, starts)[net != 0]
    net = net[net != 0]
    by_source = np.argsort(source)
    source = source[by_source]
    return NetFaces(faces[source], np.abs(net[by_source]), source)


def singular_edges(faces: IntArray, multiplicity: npt.ArrayLike = 1) -> tuple[IntArray, IntArray]:
    """The edges at which a mesh's winding number is singular: directed edges (k, 2) that do not
    cancel between the faces, and their weights (k,) > 0. Each edge has the direction that remains
    after cancellation. The edges are sorted by the lower, then by the higher one of their two
    vertex indices. The docstring of this module proves that there are no other singular edges.

    faces: (m, 3) of a welded mesh (equal positions have equal indices).
    multiplicity: (m,) how often each face counts, integers of any sign; or one integer for all.
    """
    if not len(faces):
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)
    weight = np.broadcast_to(np.asarray(multiplicity, dtype=np.int64), (len(faces),))
    return net_edges(faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.repeat(weight, 3))


def net_edges(
    begin: IntArray, end: IntArray, weight: npt.ArrayLike = 1
) -> tuple[IntArray, IntArray]:
    """Cancel opposite edges. Returns the directed edges (k, 2) that remain, and their weights (k,)
    > 0, which say how often each remains. The edges are sorted by the lower, then by the higher one
    of their two vertex indices.

    begin, end: (m,) the first and the last vertex of each edge.
    weight: how often each edge counts, (m,) or one number for all, integers of any sign. The
        reversed edge counts with the opposite sign. An edge from a vertex to itself does not count.
    """
    if not len(begin):
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)
    lower, upper = np.minimum(begin, end), np.maximum(begin, end)
    signed = np.where(begin < end, 1, -1) * np.asarray(weight, dtype=np.int64)
    count = int(upper.max()) + 1
    keys = lower * count + upper  # below 2^63: there are at most 10^8 vertices
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    net = np.add.reduceat(signed[order], starts)
    keys = keys[starts]
    lower, upper = keys // count, keys % count
    remains = (net != 0) & (lower != upper)
    lower, upper, net = lower[remains], upper[remains], net[remains]
    begin, end = np.where(net > 0, lower, upper), np.where(net > 0, upper, lower)
    return np.column_stack([begin, end]), np.abs(net)


def singular_loops(edges: IntArray, weights: IntArray) -> list[list[int]]:
    """Join singular edges to closed loops, each a list of vertex indices. A loop does not repeat
    its first vertex at the end, and ends where it first returns to one of its own vertices. Each
    edge takes a step of Python, so this is meant for up to about a million edges.

    edges, weights: directed edges (k, 2) and their weights (k,), as `singular_edges` returns them.
        An edge of weight w is used w times.

    Raises:
        OpenChainError: the edges are not a result of `singular_edges`: a loop does not close.
    """
    repeated: list[list[int]] = np.repeat(edges, weights, axis=0).tolist()
    return join_edges([(begin, end) for begin, end in repeated])


def _group_equal_rows(rows: npt.NDArray[np.uint64]) -> tuple[IntArray, IntArray]:
    """Group the rows of an array (n, k) by equality. Returns an order (n,) of the rows that puts
    equal rows next to each other, and the positions in it at which the groups start.

    Rows are ordered by a 64-bit hash, and neighbors are then compared in full. If different rows
    have the same hash, the rows are sorted by their columns instead, which is three times slower.
    """
    hashes = np.zeros(len(rows), dtype=np.uint64)
    for column in rows.T:
        hashes ^= column
        hashes *= _GOLDEN
        # The product has mixed the high bits only: they are brought down.
        hashes ^= hashes >> np.uint64(29)
    order = np.argsort(hashes).astype(np.int64, copy=False)
    hashes = hashes[order]
    new_hash = hashes[1:] != hashes[:-1]
    new_row = _differ_from_previous(rows[order])
    # Different rows with the same hash.
    if (new_hash != new_row).any():
        order = np.lexsort(rows.T[::-1]).astype(np.int64, copy=False)
        new_row = _differ_from_previous(rows[order])
    starts = np.flatnonzero(np.append(True, new_row)) if len(rows) else np.zeros(0, dtype=np.int64)
    return order, starts


def _differ_from_previous(rows: npt.NDArray[np.uint64]) -> npt.NDArray[np.bool_]:
    """(n - 1,) for each row of an array (n, k) except the first, whether it differs from the row
    before."""
    return (rows[1:] != rows[:-1]).any(axis=1)


def _group_lengths(starts: IntArray, count: int) -> IntArray:
    """The lengths of groups of consecutive entries.

    starts: the index at which each group starts.
    count: the number of all entries.
    """
    return np.diff(np.append(starts, count))
