"""Tables of numbers on a backend, as records that a kernel reads in packets of eight.

A packet gather fetches eight numbers in one go, which is several times faster than eight gathers,
if the memory is aligned (`aligned` in `backend.arrays` says why that needs care). A loop over all
records is recorded once, whatever their number: another table does not compile another kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.arrays import aligned

if TYPE_CHECKING:
    from harnack.backend.arrays import Backend, Mask, Real

PACKET = 8

State: TypeAlias = "tuple[Any, ...]"
# Gives the state with one record, of 8 * packets numbers, taken into account.
EachRecord: TypeAlias = "Callable[[list[Real], State], State]"


@dataclass(frozen=True)
class Records:
    """Rows of a table, each filled up with zeros to whole packets.

    packets: of a record. at_once: records a trip of the loop over all of them. trips: of that loop.
    first: the record that counts as the first; None for that of the table.
    """

    backend: Backend
    buffer: Real
    packets: int
    at_once: int
    trips: Any
    first: Any | None = None

    @classmethod
    def upload(
        cls, backend: Backend, table: npt.NDArray[Any], filling: npt.NDArray[Any] | None = None,
        at_once: int = 1,
    ) -> Records:  # fmt: skip
        """The rows (n, c) of a table, rounded to the backend's precision.

        filling: (c,) a row that does no harm, which makes the last trip whole: needed where at_once
            is more than 1.
        Rows are filled up by Dr.Jit, on many threads and without another copy in NumPy.
        """
        trips = -(-len(table) // at_once)
        missing = trips * at_once - len(table)
        if missing and filling is None:
            raise ValueError(
                f"{len(table)} records make no whole trips of {at_once}: give `filling`"
            )
        if filling is not None:
            table = np.concatenate([table, np.tile(filling, (missing, 1))])
        rows, width = table.shape
        padded = -(-width // PACKET) * PACKET
        mapped = aligned(backend, np.ascontiguousarray(table).ravel())
        lane = dr.arange(backend.UInt32, rows * padded)
        row, column = lane // padded, lane % padded
        copy = dr.gather(backend.Float, mapped, row * width + column, column < width)
        dr.eval(copy)
        return cls(backend, copy, padded // PACKET, at_once, dr.opaque(backend.UInt32, trips))

    def part(self, first: Any, trips: Any) -> Records:
        """So many records from `first` on, others in each lane, of a table read one at a time."""
        if self.at_once != 1:
            raise ValueError(f"records are read {self.at_once} at once: no part can be taken")
        return replace(self, first=first, trips=trips)

    def row(self, i: Any, active: Mask = True) -> list[Real]:
        """The numbers of record i, fetched where active."""
        numbers: list[Real] = []
        i = i if self.first is None else i + self.first
        for k in range(self.packets):
            place = i * self.packets + k
            eight = dr.gather(self.backend.ArrayXf, self.buffer, place, active, shape=(PACKET, 1))
            numbers += [eight[j] for j in range(PACKET)]
        return numbers

    def for_each(self, body: EachRecord, state: State, label: str, active: Mask = True) -> State:
        """The state after `body` of all records, one after the other, on lanes that are active.

        Lanes that are not cost nothing where their neighbors are not either.
        """
        trips = self.trips if active is True else dr.select(active, self.trips, 0)

        def step(i: Any, *state: Any) -> State:
            for j in range(self.at_once):
                state = body(self.row(i * self.at_once + j), state)
            return i + 1, *state

        def more(i: Any, *_: Any) -> Mask:
            return i < trips

        start = (self.backend.UInt32(0), *state)
        return dr.while_loop(start, more, step, label=label)[1:]
