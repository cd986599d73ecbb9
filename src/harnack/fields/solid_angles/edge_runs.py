"""Runs of consecutive edges of closed loops that are near to cells, each closed by one more vertex.

A run with its closing edges, from its last vertex to its apex and on to its first, is a closed
loop. So the solid angle of a curve is that of the closed near runs, modulo 4 pi, plus that of what
is left: far edges and the closing edges, reversed. These are a cycle, too: each vertex is entered
as often as it is left.

- `VertexTable`: the vertices of loops, such that every run is consecutive.
- `EdgeRuns`: the runs of many cells. `EdgeRuns.restrict_to_near` gives those of smaller cells, and
  what is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray

# Runs with so few far edges in between are one: closing a run takes two edges and begins another
# one.
_MAX_GAP = 3
# The distance of an apex from the center, in units of the radius beyond which edges are far.
_APEX_RATIO = 2.5


@dataclass(frozen=True)
class VertexTable:
    """Vertices (m, 3) of closed loops, each twice in a row and its first once more, so that a run
    that goes on across a loop's end is consecutive.

    first, sizes: of each loop the place of its first vertex, and the number of its edges.
    """

    points: FloatArray
    first: IntArray
    sizes: IntArray

    @classmethod
    def of(cls, loops: tuple[FloatArray, ...]) -> VertexTable:
        """The vertices of loops, each of shape (n, 3)."""
        rows = [np.concatenate([loop, loop, loop[:1]]) for loop in loops]
        sizes = np.array([len(loop) for loop in loops], np.int64)
        ends = np.cumsum(2 * sizes + 1)
        return cls(np.concatenate(rows), ends - 2 * sizes - 1, sizes)


@dataclass(frozen=True)
class CellEdges:
    """Directed edges of n cells, in the order of these, between rows of a table of points.

    start, end: (k,) rows. cell: (k,) numbers of cells.
    """

    start: IntArray
    end: IntArray
    cell: IntArray


@dataclass(frozen=True)
class EdgeRuns:
    """Runs of the edges of loops, in the order of n cells.

    cell: (m,) the cell that a run belongs to.
    first, count: (m,) the place of its first vertex in the table, and the number of its edges.
    is_whole: (m,) whether it is a whole loop, which needs no apex.
    apex: (m, 3) points that close runs; of no meaning for whole loops.
    """

    cell: IntArray
    first: IntArray
    count: IntArray
    is_whole: BoolArray
    apex: FloatArray

    @classmethod
    def of_loops(cls, table: VertexTable) -> EdgeRuns:
        """All loops, whole, as the runs of one cell."""
        n = len(table.sizes)
        whole = np.ones(n, np.bool_)
        return cls(np.zeros(n, np.int64), table.first, table.sizes, whole, np.zeros((n, 3)))

    def to_octants(self, is_split: BoolArray) -> EdgeRuns:
        """The runs of cells that are split, for each of their eight children."""
        chosen = is_split[self.cell]
        number = np.cumsum(is_split) - 1
        parent, count = number[self.cell[chosen]], int(chosen.sum())
        again = np.tile(np.arange(count), 8)
        cell = 8 * parent[again] + np.repeat(np.arange(8), count)
        order = np.argsort(cell, kind="stable")
        chosen_rows = np.flatnonzero(chosen)[again[order]]
        return self._some(chosen_rows, cell[order])

    def _some(self, rows: IntArray, cell: IntArray) -> EdgeRuns:
        return EdgeRuns(
            cell, self.first[rows], self.count[rows], self.is_whole[rows], self.apex[rows]
        )

    def edges(self) -> tuple[IntArray, IntArray]:
        """For each edge of all runs its run, and the place of its first vertex."""
        run = np.repeat(np.arange(len(self.count)), self.count)
        begin = np.cumsum(self.count) - self.count
        return run, np.arange(len(run)) - begin[run] + self.first[run]

    def restrict_to_near(self, run: IntArray, is_near: BoolArray) -> tuple[EdgeRuns, BoolArray]:
        """The runs of near edges, and for each edge whether it is in one of them.

        run, is_near: (k,) for each of `edges`, its run, and whether it is near. Apexes are to be
            chosen (`with_apexes`).
        """
        begin = np.cumsum(self.count) - self.count
        near = np.flatnonzero(is_near)
        owner = run[near]
        breaks = np.ones(len(near), np.bool_)
        breaks[1:] = (owner[1:] != owner[:-1]) | (np.diff(near) > _MAX_GAP + 1)
        starts = np.flatnonzero(breaks)
        ends = np.append(starts[1:], len(near))[: len(starts)] - 1
        low, high, owner = near[starts], near[ends], owner[starts]
        offset, count = low - begin[owner], high - low + 1
        # Runs of whole loops may go on across the end.
        is_first, is_last = np.ones((2, len(owner)), np.bool_)
        is_first[1:] = is_last[:-1] = owner[1:] != owner[:-1]
        first_of = np.maximum.accumulate(np.where(is_first, np.arange(len(owner)), 0))
        size = self.count[owner]
        between = offset[first_of] + size - (offset + count)
        joins = is_last & self.is_whole[owner] & (between <= _MAX_GAP)
        alone = joins & is_first
        joined = joins & ~is_first
        longer = count + np.where(joined, between + count[first_of], 0)
        keep = np.ones(len(owner), np.bool_)
        keep[first_of[joined]] = False
        offset, longer = np.where(alone, 0, offset), np.where(alone, size, longer)
        whole = self.is_whole[owner] & (longer >= size)
        marks = np.zeros(len(run) + 1, np.int64)
        stop = offset + longer
        np.add.at(marks, begin[owner[keep]] + offset[keep], 1)
        inside = np.minimum(stop, size)
        np.add.at(marks, begin[owner[keep]] + inside[keep], -1)
        over = keep & (stop > size)
        np.add.at(marks, begin[owner[over]], 1)
        np.add.at(marks, begin[owner[over]] + (stop - size)[over], -1)
        kept = np.cumsum(marks[:-1]) > 0
        cell, first = self.cell[owner][keep], (self.first[owner] + offset)[keep]
        none = np.zeros((int(keep.sum()), 3))
        return EdgeRuns(cell, first, longer[keep], whole[keep], none), kept

    def with_apexes(
        self, table: VertexTable, centers: FloatArray, radius: FloatArray, number: np.dtype[Any]
    ) -> EdgeRuns:
        """The same runs with apexes; radius: beyond which edges are far.

        With unit vectors to both ends, the apex lies in the direction of their sum, or where that
        is short of any direction at right angles to their difference: so at most at a right angle
        to both ends, which are farther than the radius r, and the closing edges are no nearer than
        2.5/sqrt(1 + 2.5^2) = 0.928 r.
        """
        center = centers[self.cell]
        first = _unit(table.points[self.first] - center)
        last = _unit(table.points[self.first + self.count] - center)
        mean = first + last
        between = _unit(first - last)
        axis = np.eye(3)[np.abs(between).argmin(axis=1)]
        across = _unit(axis - (axis * between).sum(axis=1, keepdims=True) * between)
        across *= np.where((across * mean).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        short = np.linalg.norm(mean, axis=1, keepdims=True) < 0.1
        apex = center + _APEX_RATIO * radius[self.cell, None] * np.where(short, across, _unit(mean))
        apex = apex.astype(number).astype(np.float64)
        return EdgeRuns(self.cell, self.first, self.count, self.is_whole, apex)

    def closing_edges(self, apexes: int) -> tuple[CellEdges, CellEdges]:
        """The edges from the ends of runs to their apexes, and from the apexes to the beginnings of
        the runs; apexes: the row of the first apex in the table of points."""
        rows = np.flatnonzero(~self.is_whole)
        first, last = self.first[rows], self.first[rows] + self.count[rows]
        cell = self.cell[rows]
        return CellEdges(last, apexes + rows, cell), CellEdges(apexes + rows, first, cell)


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(length, 1e-300)


def subtract_runs(
    before: EdgeRuns,
    edges: tuple[IntArray, IntArray],
    kept: BoolArray,
    after: EdgeRuns,
    vertices: int,
) -> CellEdges:
    """The edges that remain when the closed runs `after` are subtracted from the closed runs
    `before`, sorted by cell.

    edges: the edges of the runs `before` (`EdgeRuns.edges`).
    kept: for each of these edges, whether it is in a run of `after`.
    vertices: the number of vertices.

    The edges refer to a table of points with the vertices first, then the apexes of `before`, then
    the apexes of `after`.
    """
    left = np.flatnonzero(~kept)
    run, place = (one[left] for one in edges)
    inner = after.closing_edges(vertices + len(before.cell))
    return _merged(
        [
            CellEdges(place, place + 1, before.cell[run]),
            *before.closing_edges(vertices),
            *(CellEdges(one.end, one.start, one.cell) for one in inner),
        ]
    )


def _merged(groups: list[CellEdges]) -> CellEdges:
    """The edges of all groups, sorted by cell; each group must be sorted by cell."""
    cells = 1 + max((int(one.cell[-1]) for one in groups if len(one.cell)), default=0)
    counts = [np.bincount(one.cell, minlength=cells) for one in groups]
    total = np.sum(counts, axis=0)
    at = np.cumsum(total) - total
    start, end, cell = np.empty((3, int(total.sum())), np.int64)
    for one, count in zip(groups, counts, strict=True):
        rank = np.arange(len(one.cell)) - np.repeat(np.cumsum(count) - count, count)
        place = np.repeat(at, count) + rank
        start[place], end[place], cell[place] = one.start, one.end, one.cell
        at = at + count
    return CellEdges(start, end, cell)
