"""Edges as records on a backend: edges one by one, and runs of edges of closed loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.records import Records

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

# Gives the state with the edge from p to q, of which the third is 1/length^2, taken into account.
EachEdge: TypeAlias = "Callable[[Vec3, Vec3, Real, tuple[Any, ...]], tuple[Any, ...]]"

# The largest 1/length^2 of a record, within the range of float32. Edges that have no length, for
# padding or by rounding, have it too: no angle, no gradient, hardly any variation.
_SHARPEST = 1e30


def inverse_squares(edges: FloatArray) -> FloatArray:
    """1/length^2 of edges (k, 3), (k,), or the largest number that records hold, if less.

    Too small a number makes no distance too long: the foot of the perpendicular ends nearer to
    the edge's start than it should by less than the edge's length, at most 1e-15, far below the
    rounding of distances. Nor a variation too small: 1/sqrt(d^2 (1 + 4 d^2/length^2)) grows.
    """
    squared = (edges * edges).sum(axis=1)
    return 1 / np.maximum(squared, 1 / _SHARPEST)


def single_edges(start: FloatArray, end: FloatArray, direction: Any = 1.0) -> FloatArray:
    """(k, 8) records of edges from (k, 3) to (k, 3): start, direction, end, 1/length^2.

    direction: 1 or -1, (k,), as the edge runs from start to end or back.
    """
    direction = np.broadcast_to(direction, len(start))
    return np.column_stack([start, direction, end, inverse_squares(end - start)])


@dataclass(frozen=True)
class LoopEdges:
    """Records of `run` consecutive edges each, of closed loops.

    A record holds run + 1 vertices as (x, y, z, 1/|edge to the next|^2). Records do not lean on
    each other, so several loops need no special case.
    """

    records: Records
    run: int

    @classmethod
    def upload(
        cls, backend: Backend, loops: tuple[FloatArray, ...], run: int | None = None
    ) -> LoopEdges:
        """The edges of closed loops, each of shape (n, 3); run: None for what suits them."""
        run, number = run or _run_for(loops), backend.dtype
        rounded = (loop.astype(number).astype(np.float64) for loop in loops)
        table = np.concatenate([_runs(loop, run) for loop in rounded])
        return cls(Records.upload(backend, table), run)

    @property
    def backend(self) -> Backend:
        """The one they lie on."""
        return self.records.backend

    def part(self, first: Any, trips: Any) -> LoopEdges:
        """The edges of so many records from `first` on, others in each lane."""
        return replace(self, records=self.records.part(first, trips))

    def vertex(self, row: list[Real], k: int) -> Vec3:
        """Vertex k of a record, at which its edge k starts."""
        return self.backend.Array3f(*row[4 * k : 4 * k + 3])

    def for_each(
        self, body: EachEdge, state: tuple[Any, ...], label: str, active: Mask = True
    ) -> tuple[Any, ...]:
        """The state after `body` of all edges, as `Records.for_each` has it."""

        def of_record(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            for k in range(self.run):
                p, q = self.vertex(row, k), self.vertex(row, k + 1)
                state = body(p, q, row[4 * k + 3], state)
            return state

        return self.records.for_each(of_record, state, label, active)


def _run_for(loops: tuple[FloatArray, ...]) -> int:
    """Eight edges a record, or four where eight would be mostly padding."""
    edges = sum(len(loop) for loop in loops)
    padded = sum(-(-len(loop) // 8) * 8 for loop in loops)
    return 8 if padded <= 1.2 * edges else 4


def _runs(loop: FloatArray, run: int) -> FloatArray:
    trips = -(-len(loop) // run)
    stays = np.repeat(loop[:1], trips * run + 1 - len(loop), axis=0)
    path = np.concatenate([loop, stays])  # back to the start, then edges without a length
    inverse = inverse_squares(path[1:] - path[:-1])
    rows = np.concatenate([path, np.append(inverse, 0.0)[:, None]], axis=1)
    index = np.arange(trips)[:, None] * run + np.arange(run + 1)[None, :]
    return rows[index].reshape(trips, -1)
