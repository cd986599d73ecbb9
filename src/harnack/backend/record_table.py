"""Tables of numbers on a backend, as records that a kernel reads in packets of eight.

A packet gather fetches eight numbers in one go, which is several times faster than eight gathers,
if the memory is aligned (`upload_floats` in `backend.arrays` says why that needs care). A loop over
all
records is recorded once, whatever their number: another table does not compile another kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.arrays import upload_floats

if TYPE_CHECKING:
    from harnack.backend.arrays import Backend, Mask, Real

PACKET = 8

LoopValues: TypeAlias = "tuple[Any, ...]"
# Gives the state with one record, of 8 * packets numbers, taken into account.
RecordBody: TypeAlias = "Callable[[list[Real], LoopValues], LoopValues]"


@dataclass(frozen=True)
class RecordTable:
    """Rows of a table, each filled up with zeros to whole packets.

    packets_per_record: of a record. at_once: records a trip of the loop over all of them. trips: of
        that loop.
    first_record: the record that counts as the first; None for that of the table.
    """

    backend: Backend
    buffer: Real
    packets_per_record: int
    records_per_iteration: int
    iteration_count: Any
    first_record: Any | None = None

    @classmethod
    def upload(
        cls, backend: Backend, table: npt.NDArray[Any], padding_row: npt.NDArray[Any] | None = None,
        at_once: int = 1,
    ) -> RecordTable:  # fmt: skip
        """The rows (n, c) of a table, rounded to the backend's precision.

        empty_record: (c,) a row that does no harm, which makes the last trip whole: needed where
            at_once is more than 1.
        Rows are filled up by Dr.Jit, on many threads and without another copy in NumPy.
        """
        trips = -(-len(table) // at_once)
        missing = trips * at_once - len(table)
        if missing and padding_row is None:
            raise ValueError(
                f"{len(table)} records make no whole trips of {at_once}: give `filling`"
            )
        if padding_row is not None:
            table = np.concatenate([table, np.tile(padding_row, (missing, 1))])
        rows, width = table.shape
        padded = -(-width // PACKET) * PACKET
        mapped = upload_floats(backend, np.ascontiguousarray(table).ravel())
        lane = dr.arange(backend.UInt32, rows * padded)
        row, column = lane // padded, lane % padded
        copy = dr.gather(backend.Float, mapped, row * width + column, column < width)
        dr.eval(copy)
        return cls(backend, copy, padded // PACKET, at_once, dr.opaque(backend.UInt32, trips))

    def view(self, first: Any, trips: Any) -> RecordTable:
        """So many records from `first_record` on, others in each lane, of a table read one at a
        time."""
        if self.records_per_iteration != 1:
            raise ValueError(
                f"records are read {self.records_per_iteration} at once: no part can be taken"
            )
        return replace(self, first_record=first, iteration_count=trips)

    def read_record(self, i: Any, active: Mask = True) -> list[Real]:
        """The numbers of record i, fetched where active."""
        numbers: list[Real] = []
        i = i if self.first_record is None else i + self.first_record
        for k in range(self.packets_per_record):
            place = i * self.packets_per_record + k
            eight = dr.gather(self.backend.ArrayXf, self.buffer, place, active, shape=(PACKET, 1))
            numbers += [eight[j] for j in range(PACKET)]
        return numbers

    def for_each(
        self, body: RecordBody, state: LoopValues, label: str, active: Mask = True
    ) -> LoopValues:
        """The state after `body` of all records, one after the other, on lanes that are active.

        Lanes that are not cost nothing where their neighbors are not either.
        """
        trips = (
            self.iteration_count if active is True else dr.select(active, self.iteration_count, 0)
        )

        def step(i: Any, *state: Any) -> LoopValues:
            for j in range(self.records_per_iteration):
                state = body(self.read_record(i * self.records_per_iteration + j), state)
            return i + 1, *state

        def more(i: Any, *_: Any) -> Mask:
            return i < trips

        start = (self.backend.UInt32(0), *state)
        return dr.while_loop(start, more, step, label=label)[1:]
