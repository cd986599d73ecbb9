"""Joining edges to closed loops, by integer index."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence

Edge = tuple[int, int]


class OpenChainError(ValueError):
    """Edges that do not join to closed loops. vertex: where they end or meet in an odd way."""

    def __init__(self, vertex: int, count: int) -> None:
        super().__init__(f"{count} edges meet at vertex {vertex}")
        self.vertex = vertex
        self.count = count


def boundary_edges(faces: Iterable[Sequence[int]]) -> list[Edge]:
    """Directed edges of faces that do not cancel against the same edge run the other way.

    An edge is listed as often as it remains. At every vertex as many of them begin as end,
    because that is so for each face.
    """
    net: Counter[Edge] = Counter()
    for face in faces:
        for a, b in zip(face, (*face[1:], face[0]), strict=True):
            if a < b:
                net[a, b] += 1
            elif a > b:
                net[b, a] -= 1
    remaining: list[Edge] = []
    for (a, b), count in net.items():
        remaining += [(a, b)] * count if count > 0 else [(b, a)] * -count
    return remaining


def join(edges: Sequence[Edge]) -> list[list[int]]:
    """Loops of vertex indices made of all the edges.

    If as many edges begin as end at every vertex, their directions are kept, and a loop ends
    where it first meets itself. Otherwise exactly two edges must meet at every vertex, and each
    loop runs in the direction of its first edge.

    Raises:
        OpenChainError: neither is the case.
    """
    balance: Counter[int] = Counter()
    for a, b in edges:
        balance[a] += 1
        balance[b] -= 1
    if any(balance.values()):
        edges = _with_common_direction(edges)
    leaving: defaultdict[int, list[int]] = defaultdict(list)
    for a, b in reversed(edges):
        leaving[a].append(b)
    loops: list[list[int]] = []
    for a, _ in edges:
        while leaving[a]:
            loops += _walk(a, leaving)
    return loops


def _walk(start: int, leaving: dict[int, list[int]]) -> list[list[int]]:
    """Loops met on the way from `start` back to it, using up the edges."""
    loops: list[list[int]] = []
    path = [start]
    position = {start: 0}
    while True:
        vertex = leaving[path[-1]].pop()
        if vertex in position:
            begin = position[vertex]
            loops.append(path[begin:])
            for passed in path[begin + 1 :]:
                del position[passed]
            del path[begin + 1 :]
            if begin == 0:
                return loops
        else:
            position[vertex] = len(path)
            path.append(vertex)


def _with_common_direction(edges: Sequence[Edge]) -> list[Edge]:
    """The edges turned so that each loop runs in the direction of its first edge."""
    touching: defaultdict[int, list[int]] = defaultdict(list)
    for k, (a, b) in enumerate(edges):
        touching[a].append(k)
        touching[b].append(k)
    for vertex, met in touching.items():
        if len(met) != 2:
            raise OpenChainError(vertex, len(met))
    used = [False] * len(edges)
    turned: list[Edge] = []
    for k in range(len(edges)):
        start, vertex = edges[k]
        edge = k
        while not used[edge]:
            used[edge] = True
            turned.append((start, vertex))
            first, second = touching[vertex]
            edge = second if first == edge else first
            start, vertex = vertex, sum(edges[edge]) - vertex
    return turned
