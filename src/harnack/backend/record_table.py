"""Tables of numbers on a backend (the device that runs kernels). A row of a table is called a
record, such as all numbers of one triangle. Kernels read a record in packets of eight numbers.

A packet gather fetches eight numbers at once, which is several times faster than eight gathers, if
the memory is aligned (see `backend.arrays`). A loop over all records is recorded once, whatever
their number, so that another table compiles no other kernel.
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
# Takes the 8 * packets_per_record numbers of a record and a state, and returns the next state.
RecordBody: TypeAlias = "Callable[[list[Real], LoopValues], LoopValues]"


@dataclass(frozen=True)
class RecordTable:
    """A table of numbers on a backend (the device that runs kernels). Each row, called a record, is
    padded with zeros to a multiple of eight numbers (packets). `for_each` is a recorded loop over
    the records.

    buffer: all numbers, row after row, with padding.
    packets_per_record: the number of packets of a record.
    records_per_iteration: the number of records that one iteration of `for_each` reads.
    iteration_count: the number of iterations of `for_each`, for each lane or the same for all
        lanes.
    first_record: the index, for each lane, of the record to start at; None to start at the first
        record of the table.
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
        """Upload a table (n, c), rounded to the backend's precision. Returns the `RecordTable`.

        padding_row: (c,) a row without effect on the loop, appended until `at_once` divides the
            number of rows; it may be None if `at_once` divides n.
        at_once: the number of records that one iteration of `for_each` reads.

        Dr.Jit pads the rows with zeros, on many threads and without another copy in NumPy.

        Raises:
            ValueError: padding_row is needed and is None.
        """
        iterations = -(-len(table) // at_once)  # rounded up
        missing_rows = iterations * at_once - len(table)
        if missing_rows and padding_row is None:
            raise ValueError(
                f"{len(table)} records are no multiple of at_once={at_once}: give `padding_row`"
            )
        if padding_row is not None:
            table = np.concatenate([table, np.tile(padding_row, (missing_rows, 1))])
        rows, width = table.shape
        padded_width = -(-width // PACKET) * PACKET  # a multiple of `PACKET`, rounded up
        unpadded = upload_floats(backend, np.ascontiguousarray(table).ravel())
        # Entry `position` of the padded table is row `row` and column `column`; columns beyond the
        # width are 0.
        position = dr.arange(backend.UInt32, rows * padded_width)
        row, column = position // padded_width, position % padded_width
        padded = dr.gather(backend.Float, unpadded, row * width + column, column < width)
        dr.eval(padded)
        return cls(
            backend, padded, padded_width // PACKET, at_once, dr.opaque(backend.UInt32, iterations)
        )

    @staticmethod
    def memory_bytes(backend: Backend, records: int, width: int) -> int:
        """The memory in bytes of a table of so many records of `width` numbers, with padding."""
        return records * -(-width // PACKET) * PACKET * np.dtype(backend.dtype).itemsize

    def with_derivatives(self, entries: Real) -> RecordTable:
        """Return the table with the derivatives of `entries`, all numbers row after row with
        padding, for sums by `for_each` that are differentiated with respect to them.

        Reverse mode adds up the derivatives of the buffer in the loop. Dr.Jit 1.5 may read them too
        early if they are passed on to a gather as they are, and loses some now and then; a
        multiplication waits for the loop.
        """
        factor = dr.opaque(self.backend.Float, 1)  # a product with a literal would be none
        return replace(self, buffer=dr.replace_grad(self.buffer, entries * factor))

    def view(self, first: Any, trips: Any) -> RecordTable:
        """Return a part of the table: `trips` consecutive records, from record `first` on. Both
        numbers may differ between lanes. An iteration of `for_each` must read a single record.

        Raises:
            ValueError: an iteration reads several records.
        """
        if self.records_per_iteration != 1:
            raise ValueError(
                f"records are read {self.records_per_iteration} at once: no part can be taken"
            )
        return replace(self, first_record=first, iteration_count=trips)

    def read_record(self, i: Any, active: Mask = True) -> list[Real]:
        """Return the numbers of record i, padding included, as a list of Dr.Jit arrays.

        i: the index of a record for each lane.
        active: mask of the lanes that need the numbers; all others get zeros.
        """
        numbers: list[Real] = []
        i = i if self.first_record is None else i + self.first_record
        for k in range(self.packets_per_record):
            index = i * self.packets_per_record + k
            # Eight numbers at once, for each lane: those from 8 * index on.
            packet = dr.gather(self.backend.ArrayXf, self.buffer, index, active, shape=(PACKET, 1))
            numbers += [packet[j] for j in range(PACKET)]
        return numbers

    def for_each(
        self,
        body: RecordBody,
        state: LoopValues,
        label: str,
        active: Mask = True,
        *,
        is_sum: bool = False,
    ) -> LoopValues:
        """Apply `body` to all records in turn, on active lanes only, and return the final state.

        body: returns the next state from the numbers of one record (a list of arrays) and the
            state.
        state: a tuple of arrays.
        label: the name of the loop in Dr.Jit's output.
        active: mask of the lanes on which the loop runs; other lanes keep their state.
        is_sum: whether the state is a tuple of sums: `body` adds numbers to it that do not depend
            on it. Then Dr.Jit can run the loop backwards, and the sums can be differentiated in
            reverse mode with respect to the table and to all that `body` uses.

        A packet of lanes, which a processor computes together, skips the loop if all of its lanes
        are inactive.
        """
        # Inactive lanes make no iteration. (`active` is Python's True if all lanes are active.)
        iterations = (
            self.iteration_count if active is True else dr.select(active, self.iteration_count, 0)
        )

        def read_and_apply(i: Any, *state: Any) -> LoopValues:
            """Apply the caller's function `body` to the records of iteration i. Returns the index
            of the next iteration and the new state."""
            for j in range(self.records_per_iteration):
                state = body(self.read_record(i * self.records_per_iteration + j), state)
            return i + 1, *state

        def is_active(i: Any, *_: Any) -> Mask:
            """Return the mask of lanes on which iteration i runs."""
            return i < iterations

        # The index of the iteration comes before the state, and is dropped at the end.
        start = (self.backend.UInt32(0), *state)
        return dr.while_loop(
            start, is_active, read_and_apply, label=label, max_iterations=-1 if is_sum else None
        )[1:]
