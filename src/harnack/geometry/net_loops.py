"""Closed curves without the edges that are run there and back.

Seen from outside of an edge, its part in the solid angle of one loop is minus that in another
which runs it the other way, so that the two drop out of the sum. Computed one by one they leave
their rounding errors, and distances and convexity count a curve that is not there.
"""

from __future__ import annotations

import numpy as np

from harnack.backend.numbers import FloatArray, IntArray
from harnack.geometry.curves import Loops
from harnack.geometry.singular import net_edges, singular_loops, weld_vertices

__all__ = ["net_loops", "uncanceled_edges"]


def net_loops(loops: Loops) -> Loops:
    """Closed loops with the same solid angle modulo 4 pi, of which no edge runs another back.

    Vertices at exactly the same position are one. Of edges that run both ways between two of
    them the surplus is left, once for each time that it counts. Where nothing cancels, the loops
    are returned as they are, and none where everything does. Edges are compared as wholes: of two
    that overlap in part and run opposite ways, both stay.

    Proof that the rest is closed: around a loop as many edges begin at a vertex as end there,
    and so they do after one of each was taken away from both ends of an edge. The gradient of the
    solid angle is the sum of the edges' fields, which cancel (Biot and Savart), and the integral
    along closed paths is still a multiple of 4 pi, so that values change by a constant at most; far
    away both vanish, modulo 4 pi.
    """
    points = np.concatenate(loops)
    begin, end = _welded(loops, points)
    edges, weights = net_edges(begin, end)
    if int(weights.sum()) == len(points):
        return loops
    return tuple(points[np.array(loop)] for loop in singular_loops(edges, weights))


def uncanceled_edges(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """Starts and ends (k, 3) of the edges of closed loops that are left (`net_loops`), each once.

    Around an edge that is run n times net, the solid angle changes by 4 pi n: unless n = 0 it
    takes every value modulo 4 pi next to each of its points, so that every level set ends there.
    """
    if not loops:
        return np.zeros((0, 3)), np.zeros((0, 3))
    points = np.concatenate(loops)
    edges, _ = net_edges(*_welded(loops, points))
    return points[edges[:, 0]], points[edges[:, 1]]


def _welded(loops: Loops, points: FloatArray) -> tuple[IntArray, IntArray]:
    """Begin and end of all edges as indices of points, equal for points at the same position."""
    index = weld_vertices(points)
    parts = np.split(index, np.cumsum([len(loop) for loop in loops])[:-1])
    return index, np.concatenate([np.roll(part, -1) for part in parts])
