"""Runs of consecutive edges of a curve that are near to cells. A curve consists of closed loops of
straight edges; cells are cubes of an octree in which the curve's solid angle is computed
(`curve_cells`). A run is a chain of consecutive edges of a loop that are near to a cell, or a whole
loop. A run that is no whole loop is closed by two closing edges, from its last vertex to a further
vertex, its apex, and on to its first vertex.

So the solid angle of a curve is, modulo 4 pi, that of the closed near runs, plus that of the
remaining edges. The remaining edges are the far edges and the closing edges, reversed. They form a
cycle, too: they enter each vertex as often as they leave it.

- `VertexTable`: the vertices of loops, in an order in which every run is consecutive.
- `EdgeRuns`: the runs of many cells. `EdgeRuns.restrict_to_near` gives the runs of smaller cells,
  and the edges in them.
- `subtract_runs`: the remaining edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.geometry.flat_lists import ranks_in_lists

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray

# Runs with at most this many far edges in between are joined: to separate them would add two
# closing edges.
_MAX_GAP = 3
# The distance of an apex from the cell's center, in units of the radius beyond which edges are far.
_APEX_RATIO = 2.5


@dataclass(frozen=True)
class VertexTable:
    """The vertices of closed loops, in a table in which the vertices of every run of consecutive
    edges have consecutive rows.

    points: (m, 3) for each loop its vertices, the same vertices once more, and its first vertex a
        third time. So a run that continues across the end of a loop has consecutive rows.
    first, sizes: for each loop the row of its first vertex, and the number of its edges.
    """

    points: FloatArray
    first: IntArray
    sizes: IntArray

    @classmethod
    def of(cls, loops: tuple[FloatArray, ...]) -> VertexTable:
        """Make the table of the vertices of loops, each of shape (n, 3)."""
        rows = [np.concatenate([loop, loop, loop[:1]]) for loop in loops]
        sizes = np.array([len(loop) for loop in loops], np.int64)
        ends = np.cumsum(2 * sizes + 1)
        return cls(np.concatenate(rows), ends - 2 * sizes - 1, sizes)


@dataclass(frozen=True)
class CellEdges:
    """Directed edges, each of which belongs to a cell, sorted by cell. Their ends are given as rows
    of a table of points.

    start, end: (k,) for each edge the row of its start, and the row of its end.
    cell: (k,) for each edge the index of its cell.
    """

    start: IntArray
    end: IntArray
    cell: IntArray


@dataclass(frozen=True)
class EdgeRuns:
    """Runs of consecutive edges of closed loops that are near to cells, sorted by cell. A run is a
    chain of edges near to one cell. It is a whole loop, or is closed by two closing edges, from its
    last vertex to its apex and on to its first vertex. The table is the `VertexTable` of the loops.

    cell: (m,) for each run the index of its cell.
    first, count: (m,) for each run the row of its first vertex in the table, and the number of its
        edges.
    is_whole: (m,) whether a run is a whole loop, which needs no apex.
    apex: (m, 3) the apexes of the runs; unused for whole loops.
    """

    cell: IntArray
    first: IntArray
    count: IntArray
    is_whole: BoolArray
    apex: FloatArray

    @classmethod
    def of_loops(cls, table: VertexTable) -> EdgeRuns:
        """Make the runs of a single cell to which all edges are near: each loop is a run."""
        n = len(table.sizes)
        is_whole = np.ones(n, np.bool_)
        return cls(np.zeros(n, np.int64), table.first, table.sizes, is_whole, np.zeros((n, 3)))

    def to_octants(self, is_split: BoolArray) -> EdgeRuns:
        """Hand the runs of each cell that is split to its eight octants: each run is repeated eight
        times. The octants become the cells of the result; octant j of the i-th split cell gets the
        index 8 i + j.

        is_split: (n,) the mask of the cells that are split.
        """
        # Each chosen run becomes eight, sorted by their new cells. split_index: the number of each
        # cell among those that are split. repeated: positions among the chosen runs.
        is_chosen = is_split[self.cell]
        split_index = np.cumsum(is_split) - 1
        parent, count = split_index[self.cell[is_chosen]], int(is_chosen.sum())
        repeated = np.tile(np.arange(count), 8)
        cell = 8 * parent[repeated] + np.repeat(np.arange(8), count)
        order = np.argsort(cell, kind="stable")
        rows = np.flatnonzero(is_chosen)[repeated[order]]
        return self._some(rows, cell[order])

    def _some(self, rows: IntArray, cell: IntArray) -> EdgeRuns:
        """Select the runs with the indices `rows` (m,), and assign each to a new cell, with the
        index in `cell` (m,)."""
        return EdgeRuns(
            cell, self.first[rows], self.count[rows], self.is_whole[rows], self.apex[rows]
        )

    def edges(self) -> tuple[IntArray, IntArray]:
        """List the edges of all runs, one run after another. Returns for each edge the index (k,)
        of its run, and the row (k,) of its start in the table."""
        run = np.repeat(np.arange(len(self.count)), self.count)
        start = np.cumsum(self.count) - self.count
        return run, np.arange(len(run)) - start[run] + self.first[run]

    def restrict_to_near(self, run: IntArray, is_near: BoolArray) -> tuple[EdgeRuns, BoolArray]:
        """Cut the runs down to shorter runs of the edges that are still near. Gaps of up to
        `_MAX_GAP` far edges between near edges stay in a run.

        run: (k,) for each edge in the order of `edges`, the index of its run.
        is_near: (k,) whether the edge is near.

        Returns the new runs, whose apexes are still to be chosen (`with_apexes`), and for each edge
        (k,) whether it is in one of them.
        """
        # A new run begins at each near edge that follows a longer gap, or is the first one of its
        # old run. `begin` and `finish`: positions in `near_ids` of its first and last edge.
        first_edge = np.cumsum(self.count) - self.count
        near_ids = np.flatnonzero(is_near)
        old_run = run[near_ids]
        begins_run = np.ones(len(near_ids), np.bool_)
        begins_run[1:] = (old_run[1:] != old_run[:-1]) | (np.diff(near_ids) > _MAX_GAP + 1)
        begin = np.flatnonzero(begins_run)
        finish = np.append(begin[1:], len(near_ids))[: len(begin)] - 1
        first_near, last_near, old_run = near_ids[begin], near_ids[finish], old_run[begin]
        offset, count = first_near - first_edge[old_run], last_near - first_near + 1
        # If the old run is a whole loop, its last new run may continue across the end of the loop
        # into its first new run. offset, count: each new run's first edge within its old run, and
        # the number of its edges. first_of: the first new run of the same old run. gap_around: the
        # number of far edges from the end of a new run across the end of the loop to that run.
        is_first, is_last = np.ones((2, len(old_run)), np.bool_)
        is_first[1:] = is_last[:-1] = old_run[1:] != old_run[:-1]
        first_of = np.maximum.accumulate(np.where(is_first, np.arange(len(old_run)), 0))
        old_size = self.count[old_run]
        gap_around = offset[first_of] + old_size - (offset + count)
        may_join = is_last & self.is_whole[old_run] & (gap_around <= _MAX_GAP)
        # A last run that is also the first becomes the whole loop; another one takes the first run
        # over, which is not kept.
        is_cyclic = may_join & is_first
        is_joined = may_join & ~is_first
        length = count + np.where(is_joined, gap_around + count[first_of], 0)
        is_kept = np.ones(len(old_run), np.bool_)
        is_kept[first_of[is_joined]] = False
        offset, length = np.where(is_cyclic, 0, offset), np.where(is_cyclic, old_size, length)
        is_whole = self.is_whole[old_run] & (length >= old_size)
        # Mark the edges in new runs: +1 where a run begins, -1 behind its end, then running sums. A
        # run that passes the end of its loop is marked in two parts.
        run_changes = np.zeros(len(run) + 1, np.int64)
        offset_end = offset + length
        np.add.at(run_changes, first_edge[old_run[is_kept]] + offset[is_kept], 1)
        inside_end = np.minimum(offset_end, old_size)
        np.add.at(run_changes, first_edge[old_run[is_kept]] + inside_end[is_kept], -1)
        passes_end = is_kept & (offset_end > old_size)
        np.add.at(run_changes, first_edge[old_run[passes_end]], 1)
        np.add.at(
            run_changes, first_edge[old_run[passes_end]] + (offset_end - old_size)[passes_end], -1
        )
        in_run = np.cumsum(run_changes[:-1]) > 0
        cell, first = self.cell[old_run][is_kept], (self.first[old_run] + offset)[is_kept]
        apexes = np.zeros((int(is_kept.sum()), 3))
        return EdgeRuns(cell, first, length[is_kept], is_whole[is_kept], apexes), in_run

    def with_apexes(
        self, table: VertexTable, centers: FloatArray, radius: FloatArray, number: np.dtype[Any]
    ) -> EdgeRuns:
        """Choose an apex for each run, and return the runs with these apexes.

        table: the vertices of the loops.
        centers: (n, 3) of the cells.
        radius: (n,) for each cell the distance r from its center beyond which edges are far.
        number: the type of numbers to which apexes are rounded.

        Take unit vectors from the center to both ends of a run. The apex lies at the distance 2.5 r
        from the center in the direction of their sum, or if the sum is short, in a direction
        perpendicular to their difference. So the directions of both ends are at most at a right
        angle to that of the apex, and the ends are farther than r from the center. Therefore the
        closing edges are no nearer to the center than 2.5/sqrt(1 + 2.5^2) r = 0.928 r.
        """
        center = centers[self.cell]
        to_first = _unit(table.points[self.first] - center)
        to_last = _unit(table.points[self.first + self.count] - center)
        direction_sum = to_first + to_last
        difference = _unit(to_first - to_last)
        # A vector perpendicular to the difference, on the side of the sum, from the coordinate axis
        # that is least parallel to the difference.
        axis = np.eye(3)[np.abs(difference).argmin(axis=1)]
        perpendicular = _unit(axis - (axis * difference).sum(axis=1, keepdims=True) * difference)
        perpendicular *= np.where(
            (perpendicular * direction_sum).sum(axis=1, keepdims=True) < 0, -1.0, 1.0
        )
        is_short = np.linalg.norm(direction_sum, axis=1, keepdims=True) < 0.1
        apex = center + _APEX_RATIO * radius[self.cell, None] * np.where(
            is_short, perpendicular, _unit(direction_sum)
        )
        # Rounded as the backend will round it.
        apex = apex.astype(number).astype(np.float64)
        return EdgeRuns(self.cell, self.first, self.count, self.is_whole, apex)

    def closing_edges(self, apexes: int) -> tuple[CellEdges, CellEdges]:
        """List the closing edges of all runs that are no whole loops. Returns two groups: the edges
        from the last vertices of the runs to their apexes, and the edges from the apexes to the
        first vertices of the runs.

        apexes: the row of the first run's apex in a table of points. The apexes of the other runs
            follow, also of those that are whole loops.
        """
        run_ids = np.flatnonzero(~self.is_whole)
        first, last = self.first[run_ids], self.first[run_ids] + self.count[run_ids]
        cell = self.cell[run_ids]
        return CellEdges(last, apexes + run_ids, cell), CellEdges(apexes + run_ids, first, cell)


def _unit(vectors: FloatArray) -> FloatArray:
    """Divide vectors (n, 3) by their lengths; a vector 0 stays 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(length, 1e-300)


def subtract_runs(
    before: EdgeRuns,
    edges: tuple[IntArray, IntArray],
    is_in_after: BoolArray,
    after: EdgeRuns,
    vertices: int,
) -> CellEdges:
    """List the edges that remain when closed runs are subtracted from other closed runs. They form
    a cycle for each cell: the edges of `before` that are not in `after`, the closing edges of
    `before`, and the reversed closing edges of `after`.

    before: the runs that cells inherit.
    edges: the edges of these runs, as `EdgeRuns.edges` returns them.
    is_in_after: (k,) for each of these edges, whether it is in a run of `after`.
    after: the shorter runs of the same cells (`EdgeRuns.restrict_to_near`), with apexes.
    vertices: the number of rows in the table of vertices.

    Returns the edges, sorted by cell. They refer to a table of points that has the vertices first,
    then the apexes of `before`, then the apexes of `after`.
    """
    # An edge runs from a row of the table of vertices to the next row.
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
    """Merge groups of edges, each sorted by cell, into one group sorted by cell."""
    # next_slot: for each cell the place of its next edge in the result.
    cell_count = 1 + max((int(group.cell[-1]) for group in groups if len(group.cell)), default=0)
    counts = [np.bincount(group.cell, minlength=cell_count) for group in groups]
    total = np.sum(counts, axis=0)
    next_slot = np.cumsum(total) - total
    start, end, cell = np.empty((3, int(total.sum())), np.int64)
    for group, count in zip(groups, counts, strict=True):
        slot = np.repeat(next_slot, count) + ranks_in_lists(count)
        start[slot], end[slot], cell[slot] = group.start, group.end, group.cell
        next_slot = next_slot + count
    return CellEdges(start, end, cell)
