"""Runs of consecutive edges of closed loops that are near to cells. Each run is closed by a further
vertex, its apex.

A run together with its two closing edges, from its last vertex to its apex and on to its first
vertex, is a closed loop. So the solid angle of a curve is that of the closed near runs, modulo 4
pi, plus that of the remaining edges. The remaining edges are the far edges and the closing edges,
reversed. They form a cycle, too: they enter each vertex as often as they leave it.

- `VertexTable`: the vertices of loops, in an order in which every run is consecutive.
- `EdgeRuns`: the runs of many cells. `EdgeRuns.restrict_to_near` gives the runs of smaller cells,
and the edges in them.
- `subtract_runs`: the remaining edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray

# Runs with at most this many far edges in between are joined: it takes two closing edges to end a
# run.
_MAX_GAP = 3
# The distance of an apex from the center, in units of the radius beyond which edges are far.
_APEX_RATIO = 2.5


@dataclass(frozen=True)
class VertexTable:
    """The vertices of closed loops, in a table in which every run of consecutive edges has
    consecutive rows.

    points: (m, 3) the vertices of each loop, twice in a row, and its first vertex a third time. So
        a run that continues across the end of a loop is consecutive.
    first, sizes: for each loop the row of its first vertex, and the number of its edges.
    """

    points: FloatArray
    first: IntArray
    sizes: IntArray

    @classmethod
    def of(cls, loops: tuple[FloatArray, ...]) -> VertexTable:
        """The table of the vertices of loops, each of shape (n, 3)."""
        rows = [np.concatenate([loop, loop, loop[:1]]) for loop in loops]
        sizes = np.array([len(loop) for loop in loops], np.int64)
        ends = np.cumsum(2 * sizes + 1)
        return cls(np.concatenate(rows), ends - 2 * sizes - 1, sizes)


@dataclass(frozen=True)
class CellEdges:
    """Directed edges of n cells, sorted by cell. Their ends are rows of a table of points.

    start, end: (k,) rows of the table.
    cell: (k,) the index of the cell that each edge belongs to.
    """

    start: IntArray
    end: IntArray
    cell: IntArray


@dataclass(frozen=True)
class EdgeRuns:
    """Runs of consecutive edges of closed loops, each near to a cell, sorted by cell. Together with
    its apex, a run is a closed loop.

    cell: (m,) the cell that each run belongs to.
    first, count: (m,) the row of its first vertex in the table, and the number of its edges.
    is_whole: (m,) whether it is a whole loop, which needs no apex.
    apex: (m, 3) the points that close the runs; unused for whole loops.
    """

    cell: IntArray
    first: IntArray
    count: IntArray
    is_whole: BoolArray
    apex: FloatArray

    @classmethod
    def of_loops(cls, table: VertexTable) -> EdgeRuns:
        """The runs of a single cell to which all edges are near: each loop as a whole is a run."""
        n = len(table.sizes)
        is_whole = np.ones(n, np.bool_)
        return cls(np.zeros(n, np.int64), table.first, table.sizes, is_whole, np.zeros((n, 3)))

    def to_octants(self, is_split: BoolArray) -> EdgeRuns:
        """The runs of the cells that are split, repeated for each of a cell's eight octants. Octant
        j of the i-th split cell gets the index 8 i + j.

        is_split: (n,) the mask of the cells that are split.
        """
        is_chosen = is_split[self.cell]
        split_index = np.cumsum(is_split) - 1
        parent, count = split_index[self.cell[is_chosen]], int(is_chosen.sum())
        repeated = np.tile(np.arange(count), 8)
        cell = 8 * parent[repeated] + np.repeat(np.arange(8), count)
        order = np.argsort(cell, kind="stable")
        rows = np.flatnonzero(is_chosen)[repeated[order]]
        return self._some(rows, cell[order])

    def _some(self, rows: IntArray, cell: IntArray) -> EdgeRuns:
        """The runs with the indices `rows`, each assigned to the cell in `cell`."""
        return EdgeRuns(
            cell, self.first[rows], self.count[rows], self.is_whole[rows], self.apex[rows]
        )

    def edges(self) -> tuple[IntArray, IntArray]:
        """The edges of all runs, one run after another: for each edge the index (k,) of its run,
        and the row (k,) of its first vertex in the table."""
        run = np.repeat(np.arange(len(self.count)), self.count)
        start = np.cumsum(self.count) - self.count
        return run, np.arange(len(run)) - start[run] + self.first[run]

    def restrict_to_near(self, run: IntArray, is_near: BoolArray) -> tuple[EdgeRuns, BoolArray]:
        """Cut the runs down to the runs of near edges. Short gaps of far edges between near edges
        stay in a run.

        run, is_near: (k,) for each edge in the order of `edges`, the index of its run, and whether
            it is near.

        Returns the new runs, whose apexes are still to be chosen (`with_apexes`), and for each edge
        (k,) whether it is in one of them.
        """
        first_edge = np.cumsum(self.count) - self.count
        near_ids = np.flatnonzero(is_near)
        old_run = run[near_ids]
        begins_run = np.ones(len(near_ids), np.bool_)
        begins_run[1:] = (old_run[1:] != old_run[:-1]) | (np.diff(near_ids) > _MAX_GAP + 1)
        begin = np.flatnonzero(begins_run)
        finish = np.append(begin[1:], len(near_ids))[: len(begin)] - 1
        first_near, last_near, old_run = near_ids[begin], near_ids[finish], old_run[begin]
        offset, count = first_near - first_edge[old_run], last_near - first_near + 1
        # Runs of whole loops may continue across the end of the loop. `offset` and `count` are each
        # run's first edge in its old run and the number of its edges, first_of the first new run of
        # the same old run, and gap_around the number of far edges from a run across the end to it.
        is_first, is_last = np.ones((2, len(old_run)), np.bool_)
        is_first[1:] = is_last[:-1] = old_run[1:] != old_run[:-1]
        first_of = np.maximum.accumulate(np.where(is_first, np.arange(len(old_run)), 0))
        size = self.count[old_run]
        gap_around = offset[first_of] + size - (offset + count)
        may_join = is_last & self.is_whole[old_run] & (gap_around <= _MAX_GAP)
        is_cyclic = may_join & is_first
        is_joined = may_join & ~is_first
        length = count + np.where(is_joined, gap_around + count[first_of], 0)
        is_kept = np.ones(len(old_run), np.bool_)
        is_kept[first_of[is_joined]] = False
        offset, length = np.where(is_cyclic, 0, offset), np.where(is_cyclic, size, length)
        is_whole = self.is_whole[old_run] & (length >= size)
        depth_change = np.zeros(len(run) + 1, np.int64)
        offset_end = offset + length
        np.add.at(depth_change, first_edge[old_run[is_kept]] + offset[is_kept], 1)
        inside_end = np.minimum(offset_end, size)
        np.add.at(depth_change, first_edge[old_run[is_kept]] + inside_end[is_kept], -1)
        passes_end = is_kept & (offset_end > size)
        np.add.at(depth_change, first_edge[old_run[passes_end]], 1)
        np.add.at(
            depth_change, first_edge[old_run[passes_end]] + (offset_end - size)[passes_end], -1
        )
        in_run = np.cumsum(depth_change[:-1]) > 0
        cell, first = self.cell[old_run][is_kept], (self.first[old_run] + offset)[is_kept]
        apexes = np.zeros((int(is_kept.sum()), 3))
        return EdgeRuns(cell, first, length[is_kept], is_whole[is_kept], apexes), in_run

    def with_apexes(
        self, table: VertexTable, centers: FloatArray, radius: FloatArray, number: np.dtype[Any]
    ) -> EdgeRuns:
        """The same runs, with an apex chosen for each.

        table: the vertices of the loops.
        centers: (n, 3) of the cells.
        radius: (n,) the distance from the centers beyond which edges are far.
        number: the type of numbers to which apexes are rounded.

        Take unit vectors from the center to both ends of a run. The apex lies in the direction of
        their sum, or if the sum is short, in a direction perpendicular to their difference. So the
        apex is at most at a right angle to both ends, which are farther than the radius r.
        Therefore the closing edges are no nearer to the center than 2.5/sqrt(1 + 2.5^2) = 0.928 r.
        """
        center = centers[self.cell]
        to_first = _unit(table.points[self.first] - center)
        to_last = _unit(table.points[self.first + self.count] - center)
        mean = to_first + to_last
        difference = _unit(to_first - to_last)
        axis = np.eye(3)[np.abs(difference).argmin(axis=1)]
        perpendicular = _unit(axis - (axis * difference).sum(axis=1, keepdims=True) * difference)
        perpendicular *= np.where((perpendicular * mean).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        is_short = np.linalg.norm(mean, axis=1, keepdims=True) < 0.1
        apex = center + _APEX_RATIO * radius[self.cell, None] * np.where(
            is_short, perpendicular, _unit(mean)
        )
        apex = apex.astype(number).astype(np.float64)
        return EdgeRuns(self.cell, self.first, self.count, self.is_whole, apex)

    def closing_edges(self, apexes: int) -> tuple[CellEdges, CellEdges]:
        """The closing edges of all runs that are no whole loops, as two groups: the edges from the
        ends of the runs to their apexes, and the edges from the apexes to the beginnings of the
        runs.

        apexes: the row of the first run's apex in the table of points. The apexes of the other runs
            follow.
        """
        run_ids = np.flatnonzero(~self.is_whole)
        first, last = self.first[run_ids], self.first[run_ids] + self.count[run_ids]
        cell = self.cell[run_ids]
        return CellEdges(last, apexes + run_ids, cell), CellEdges(apexes + run_ids, first, cell)


def _unit(vectors: FloatArray) -> FloatArray:
    """The vectors (n, 3), divided by their lengths; a vector 0 stays 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(length, 1e-300)


def subtract_runs(
    before: EdgeRuns,
    edges: tuple[IntArray, IntArray],
    is_in_after: BoolArray,
    after: EdgeRuns,
    vertices: int,
) -> CellEdges:
    """The edges that remain when the closed runs `after` are subtracted from the closed runs
    `before`, sorted by cell. They are the edges of `before` that are not in `after`, the closing
    edges of `before`, and the reversed closing edges of `after`.

    edges: the edges of the runs `before`, as `EdgeRuns.edges` returns them.
    is_in_after: (k,) for each of these edges, whether it is in a run of `after`.
    vertices: the number of vertices in the table.

    The resulting edges refer to a table of points that has the vertices first, then the apexes of
    `before`, then the apexes of `after`.
    """
    remaining = np.flatnonzero(~is_in_after)
    run, vertex = (part[remaining] for part in edges)
    closing = after.closing_edges(vertices + len(before.cell))
    return _merged(
        [
            CellEdges(vertex, vertex + 1, before.cell[run]),
            *before.closing_edges(vertices),
            *(CellEdges(part.end, part.start, part.cell) for part in closing),
        ]
    )


def _merged(groups: list[CellEdges]) -> CellEdges:
    """The edges of all groups as one group, sorted by cell. Each group must be sorted by cell."""
    cell_count = 1 + max((int(group.cell[-1]) for group in groups if len(group.cell)), default=0)
    counts = [np.bincount(group.cell, minlength=cell_count) for group in groups]
    total = np.sum(counts, axis=0)
    next_slot = np.cumsum(total) - total
    start, end, cell = np.empty((3, int(total.sum())), np.int64)
    for group, count in zip(groups, counts, strict=True):
        rank = np.arange(len(group.cell)) - np.repeat(np.cumsum(count) - count, count)
        slot = np.repeat(next_slot, count) + rank
        start[slot], end[slot], cell[slot] = group.start, group.end, group.cell
        next_slot = next_slot + count
    return CellEdges(start, end, cell)
