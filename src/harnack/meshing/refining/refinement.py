"""Finer meshes: edges cut where the surface bulges from them, vertices moved onto it, and smoothed.

Vertices and edges of the boundary stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import check_count
from harnack.meshing.edges import Edges, IntArray, boundary_edges, directed_edges
from harnack.meshing.points import newton
from harnack.meshing.refining.flips import flipped, without_slivers
from harnack.meshing.refining.relaxation import relaxed
from harnack.meshing.rows import dots, lengths
from harnack.meshing.samples import LevelFunction, Samples

__all__ = ["far_places", "improved", "refined", "smoothed"]

Walls = tuple[FloatArray, FloatArray] | None
# Edges shorter than this part of the tolerance are never cut.
_SHORTEST = 0.5
_MOST_ROUNDS = 12
# Edges to be cut become more at first, and then fewer. If they are so many times as many as they
# were, they run away: the surface bends within any triangle, as around each dipole of a cloud.
_RUNS_AWAY = 3


def refined(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Cut edges at their middles, and move these onto the surface, until the middles of all edges
    but those of the boundary, and the centres of all faces, are within `tolerance` of it; or until
    that is seen not to succeed, which whoever asks for it has to check (`check_near_level`).

    Raises:
        TooLargeError: it takes more triangles than the function allows.
    """
    least, before = math.inf, 0
    for round_number in range(_MOST_ROUNDS):
        report(f"refining, round {round_number + 1}: {len(faces):,} triangles")
        far = _Far.of(function, vertices, faces, tolerance, walls)
        marked = far.marked
        if not marked.any():
            break
        count = int(marked.sum())
        if count > _RUNS_AWAY * least:
            break
        least = min(least, count) if count < before else least
        before = count
        # Every edge that is cut makes one more triangle on each side.
        check_count(len(faces) + 2 * count, function.most_faces)
        samples, reach = far.samples.some(marked), 0.5 * far.span[marked]
        moved = newton(function, far.middle[marked], samples, reach, walls)
        place = np.full(len(marked), -1, np.int64)
        place[marked] = len(vertices) + np.arange(int(marked.sum()))
        vertices = np.concatenate([vertices, moved])
        faces = _split(vertices, faces, place[far.edges])
    return vertices, faces


def far_places(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> FloatArray:
    """Middles (k, 3) of the edges that `refined` would still cut."""
    far = _Far.of(function, vertices, faces, tolerance, None)
    return far.middle[far.marked]


@dataclass(frozen=True)
class _Far:
    """Edges and which of them are to be cut.

    edges: (m, 3) of the faces. middle: (k, 3), span: (k,) and marked: (k,) of edges.
    samples: at the middles.
    """

    edges: IntArray
    middle: FloatArray
    span: FloatArray
    samples: Samples
    marked: BoolArray

    @classmethod
    def of(
        cls,
        function: LevelFunction,
        vertices: FloatArray,
        faces: IntArray,
        tolerance: float,
        walls: Walls,
    ) -> _Far:
        """Those whose middle, or the centre of a face beside them, is beyond the tolerance."""
        ends, edges, is_rim = _edges(faces)
        if walls is not None:  # the rim lies in them, and so do the middles of its edges
            is_rim = np.zeros_like(is_rim)
        middle = 0.5 * (vertices[ends[:, 0]] + vertices[ends[:, 1]])
        span = lengths(vertices[ends[:, 0]] - vertices[ends[:, 1]])
        samples = function.at(middle)
        marked = samples.distance > tolerance
        off = function.at(vertices[faces].mean(axis=1)).distance > tolerance
        # Of a face that is off, the longest edge that may be cut.
        free = np.where(is_rim[edges], 0.0, span[edges])
        worst = edges[np.arange(len(faces)), free.argmax(axis=1)]
        marked[worst[off]] = True
        marked &= ~is_rim & (span > _SHORTEST * tolerance)
        return cls(edges, middle, span, samples, marked)


def _edges(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """All edges (k, 2), those of each face (m, 3) (that of corners 0 and 1 first), and whether they
    belong to one face only."""
    edges = Edges.of(directed_edges(faces))
    return edges.ends, edges.index.reshape(3, -1).T, edges.uses == 1


def _split(vertices: FloatArray, faces: IntArray, middle: IntArray) -> IntArray:
    """Faces cut at the middles (m, 3) of their edges, -1 for those that are not cut."""
    cut = middle >= 0
    number = cut.sum(axis=1)
    parts = [faces[number == 0]]
    three = number == 3
    (a, b, c), (x, y, z) = faces[three].T, middle[three].T
    parts += [np.stack(t, axis=1) for t in ((a, x, z), (x, b, y), (z, y, c), (x, y, z))]
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        one = (number == 1) & cut[:, k]
        (a, b, c), x = faces[one][:, order].T, middle[one, k]
        parts += [np.stack(t, axis=1) for t in ((a, x, c), (x, b, c))]
        two = (number == 2) & ~cut[:, k]
        # The edge from a to b is whole; y and z are the middles of the others.
        (a, b, c), y, z = faces[two][:, order].T, middle[two, order[1]], middle[two, order[2]]
        first = lengths(vertices[a] - vertices[y])
        second = lengths(vertices[b] - vertices[z])
        shorter = (first < second)[:, None]
        parts.append(np.stack([z, y, c], axis=1))
        parts.append(np.where(shorter, np.stack([a, b, y], 1), np.stack([a, b, z], 1)))
        parts.append(np.where(shorter, np.stack([a, y, z], 1), np.stack([b, y, z], 1)))
    return np.concatenate(parts)


def improved(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    walls: Walls,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Better angles: edges are flipped and vertices smoothed in turn, slivers are contracted; then
    edges are cut again where triangles are no longer within `tolerance`."""
    for _ in range(2):
        faces = flipped(function, vertices, faces, tolerance)
        vertices = smoothed(function, vertices, faces, walls, rounds=2)
    fixed = np.zeros(len(vertices), np.bool_)
    fixed[boundary_edges(faces)] = True
    faces = without_slivers(function, vertices, faces, fixed, 2 * tolerance)
    vertices, faces = refined(function, vertices, faces, tolerance, walls, report)
    for _ in range(2):
        faces = flipped(function, vertices, faces, tolerance)
        vertices = relaxed(function, vertices, faces, tolerance, walls)
    return vertices, flipped(function, vertices, faces, tolerance)


def smoothed(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    walls: Walls,
    rounds: int = 3,
) -> FloatArray:
    """Vertices moved towards the mean of their neighbours and back onto the surface, a few times;
    those of the boundary stay. Moves that turn a face by much are taken back."""
    ends, _, _ = _edges(faces)
    rim = np.unique(boundary_edges(faces))
    free = np.zeros(len(vertices), np.bool_)
    free[np.unique(faces)] = True
    free[rim] = False
    count = np.maximum(np.bincount(ends.ravel(), minlength=len(vertices)), 1)
    rows = np.flatnonzero(free)
    size = float(np.ptp(vertices[free], axis=0).max(initial=0.0)) if len(rows) else 0.0
    for _ in range(rounds):
        sums = np.zeros_like(vertices)
        for one, other in ((0, 1), (1, 0)):
            for axis in range(3):
                sums[:, axis] += np.bincount(
                    ends[:, one], vertices[ends[:, other], axis], minlength=len(vertices)
                )
        aim = 0.5 * (vertices + sums / count[:, None])
        start = function.at(aim[rows])
        # No farther than neighbours are: beside the curve gradients turn.
        span = lengths(aim[rows] - vertices[rows]) + 1e-300
        there = vertices.copy()
        there[rows] = newton(function, aim[rows], start, 2 * span, walls)
        after = function.at(there[rows])
        worse = after.distance > 1e-7 * size + 1e-12 * lengths(there[rows])
        there[rows[worse]] = vertices[rows[worse]]
        vertices = _unfolded(vertices, there, faces)
    return vertices


def _unfolded(before: FloatArray, after: FloatArray, faces: IntArray) -> FloatArray:
    """`after`, but for vertices of faces that have turned over, which stay as before."""
    for _ in range(8):
        corner = after[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        old = before[faces]
        was = np.cross(old[:, 1] - old[:, 0], old[:, 2] - old[:, 0])
        turned = dots(normal, was) <= 0.3 * lengths(normal) * lengths(was)
        if not turned.any():
            return after
        after = after.copy()
        back = np.unique(faces[turned])
        after[back] = before[back]
    return before
