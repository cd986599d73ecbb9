"""The interpreter of tapes: a loop on a backend (a Dr.Jit device and precision) that runs the
instructions of a tape on numbers of any arithmetic. A lane may run any of the lists of a
`BoxTapes`. The results of instructions are kept in slots, arrays of local memory. The kernel has
each operation once, however long the tape is, and other lists with the same operations compile
nothing."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.arithmetic import Interval, Jet, Values
from harnack.arithmetic.jet import Dual
from harnack.backend.arrays import upload_integers
from harnack.backend.local_memory import allocate_local, local_size
from harnack.backend.record_table import RecordTable
from harnack.tape.operations import COORDINATE_COUNT

if TYPE_CHECKING:
    from harnack.backend import Backend, BoolArray, FloatArray, Index, IntArray, Real
    from harnack.tape.operations import Operation
    from harnack.tape.pruning import BoxTapes
    from harnack.tape.recording import Tape

__all__ = ["TapeFormula", "TapeProgram", "rounded_ends"]

# An instruction is four words: its operation, and the slot of its result; the slots of its operands
# in local memory; the row of its constants; flags. A slot has 16 bits.
_WORDS, _SLOT_BITS = 4, 16
_MAX_SLOTS = 1 << _SLOT_BITS
# Flags: whether an operand is read from local memory; whether it is the first or the second operand
# (otherwise that is the result of the instruction before); whether the result is written there; and
# whether it is the first member of a chain without an operand, for which infinity stands.
_READS, _FIRST, _SECOND, _WRITES, _BEGINS = 1, 2, 4, 8, 16


@dataclass(frozen=True)
class TapeProgram:
    """Lists of instructions on a backend.

    operations: the operations that occur. The index after the last one stands for reading an
        operand from local memory.
    words: the instructions of all lists, `_WORDS` integers for each; equal lists are stored once.
    constants: rows of lower ends of constants and, in single precision, of their upper ends.
    begins, ends: for each list the first instruction, and that after the last one.
    constant_count: the length of rows of lower ends.
    slot_count: the number of slots in local memory.
    """

    backend: Backend
    operations: tuple[Operation, ...]
    words: Index
    constants: RecordTable
    begins: Index
    ends: Index
    constant_count: int
    slot_count: int

    @classmethod
    def upload(cls, backend: Backend, lists: BoxTapes) -> TapeProgram:
        """Upload lists of instructions.

        Raises:
            ValueError: a list keeps more than 65,536 results at a time.
        """
        lists, index = lists.distinct()
        words, before, count = _encode(lists)
        ends = rounded_ends(backend, lists.tape.constants[_rows_of_constants(lists.tape)])
        is_exact = backend.precision == "double"
        rows = ends[0] if is_exact else np.concatenate(ends, axis=1)
        return cls(
            backend,
            lists.tape.operations,
            upload_integers(backend, words.ravel()),
            RecordTable.upload(backend, rows),
            upload_integers(backend, before[lists.starts[:-1]][index]),
            upload_integers(backend, before[lists.starts[1:]][index]),
            ends[0].shape[1],
            local_size(count),
        )

    def formula(self, index: Any, active: Any = True) -> TapeFormula:
        """The formula of a list for each lane.

        index: of the list; an integer for all lanes.
        active: the lanes on which it is computed; on others its values are NaN.
        """
        index = self.backend.UInt32(index)
        begin, end = (
            dr.gather(self.backend.UInt32, array, index) for array in (self.begins, self.ends)
        )
        return TapeFormula(self, begin, end if active is True else dr.select(active, end, begin))


def _encode(lists: BoxTapes) -> tuple[npt.NDArray[np.uint32], IntArray, int]:
    """The instructions of lists as words (n, 4); for each entry, and for the end, the number of
    instructions before it; and the number of slots in local memory.

    An operand is the result of the instruction before, or read from local memory. An instruction
    reads one operand from there, or the first and the third of three; any other is read by an
    instruction of its own before it. So results that are used at once are never written.
    """
    tape, instructions = lists.tape, lists.instructions
    count, entries = len(instructions), np.arange(len(instructions))
    slots, slot_count = lists.slots()
    if slot_count > _MAX_SLOTS:
        raise ValueError(
            f"the formula keeps {slot_count:,} results at a time, of which there may be "
            f"{_MAX_SLOTS:,}: write it as sums and minima of parts that are computed one after "
            "another"
        )
    kinds: Any = tape.kinds[instructions]
    arities = np.array([0 if o.is_of_point else o.operand_count for o in tape.operations])
    arity = np.where(kinds >= 0, arities[kinds], 0)
    begins: Any = (tape.chains[instructions] >= 0) & (lists.operands[0] == entries)
    arity = np.where(begins, 0, arity)
    is_run = kinds >= 0
    # Whether an operand is the result of the entry before, which is in the same list.
    is_before: list[BoolArray] = [
        (column == entries - 1) & (kinds[column] >= 0) for column in lists.operands
    ]
    is_last = np.zeros(count, np.bool_)
    is_last[lists.results] = True
    # Which operand is read from local memory, and which one by an instruction of its own. A list
    # that consists of a coordinate reads it.
    columns: Any = lists.operands
    first, second, third = columns
    is_twice: BoolArray = (arity == 2) & (second == first)
    reads_first = ((arity >= 1) & ~is_before[0]) | (arity == 3)
    reads_second: Any = (arity == 2) & np.where(is_twice, reads_first, is_before[0])
    loads: Any = (arity >= 2) & ~is_before[1] & ~reads_second
    is_plain_load = ~is_run & is_last
    loaded = np.where(loads, second, entries)
    operand: IntArray = np.asarray(np.where(reads_second, second, first), np.int64)
    reads: Any = reads_first | reads_second
    is_written = np.zeros(count, np.bool_)
    is_written[operand[reads]] = True
    is_written[third[arity == 3]] = True
    is_written[loaded[loads]] = True
    row_of = np.cumsum(_rows_of_constants(tape)) - 1
    flags: Any = (
        _READS * reads
        + _FIRST * reads_first
        + _SECOND * reads_second
        + _WRITES * is_written
        + _BEGINS * begins
    )
    is_load: Any = loads | is_plain_load
    counts = is_load.astype(np.int32) + is_run
    before = np.concatenate([[0], np.cumsum(counts)])
    words = np.zeros((before[-1], _WORDS), np.uint32)
    # The instruction of an entry comes after that which reads its second operand.
    run = np.flatnonzero(is_run)
    places = before[run] + is_load[run]
    words[places, 0] = kinds[run] | slots[run] << _SLOT_BITS
    words[places, 1] = (slots[operand] | slots[third] << _SLOT_BITS)[run]
    words[places, 2] = row_of[instructions[run]]
    words[places, 3] = flags[run]
    read = np.flatnonzero(is_load)
    words[before[read], 0] = len(tape.operations)
    words[before[read], 1] = slots[loaded[read]]
    words[before[read], 3] = _READS + _FIRST
    return words, before, slot_count


def _rows_of_constants(tape: Tape) -> BoolArray:
    """For each instruction (n,) whether its constants are a row of the table of constants. The
    others have no constants, but the first is a row, so that there is one."""
    counts = np.array([operation.constant_count for operation in tape.operations] + [0])
    has_row = counts[tape.kinds] > 0  # kinds: -1 for coordinates
    has_row[0] = True
    return has_row


def rounded_ends(backend: Backend, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The largest numbers of a backend's precision that are at most the numbers of an array, and
    the smallest that are at least these."""
    if backend.precision == "double":
        return numbers, numbers
    with np.errstate(over="ignore"):
        nearest = numbers.astype(np.float32)
        low = np.where(nearest > numbers, np.nextafter(nearest, np.float32(-np.inf)), nearest)
        high = np.where(nearest < numbers, np.nextafter(nearest, np.float32(np.inf)), nearest)
    return low.astype(np.float64), high.astype(np.float64)


@dataclass(frozen=True)
class TapeFormula:
    """A formula that a list of instructions computes, a list for each lane. It is called with three
    coordinates, numbers of one arithmetic (`Jet`, `Values` or `Dual`).

    program: the lists.
    begin, end: the first instruction, and that after the last one.
    """

    program: TapeProgram
    begin: Index
    end: Index

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        return self.of_several([(x, y, z)])[0]

    def of_several(self, points: Sequence[tuple[Any, Any, Any]]) -> list[Any]:
        """The values of the formula for several points at once, in one loop. A point is three
        coordinates; points may be of different arithmetics."""
        program, backend = self.program, self.program.backend
        zero = backend.Float(self.begin) * 0
        packed, unpack = _pack([number for point in points for number in point])
        packed = [(zero == zero) & part if dr.is_mask_v(part) else zero + part for part in packed]
        layouts = [_Layout.of(point[0]) for point in points]
        numbers = unpack(packed)
        memory = self._memory(layouts, numbers, zero)
        calls = [self._call(operation, layouts, unpack) for operation in program.operations]
        calls.append(_first)
        has_third = any(o.operand_count > 2 and not o.is_of_point for o in program.operations)
        has_chains = any(o.is_member for o in program.operations)
        infinite = [
            part
            for j, layout in enumerate(layouts)
            for part in layout.parts(numbers[COORDINATE_COUNT * j].constant(math.inf), zero)
        ]
        mask = (1 << _SLOT_BITS) - 1
        word_type = dr.uint32_array_t(backend.Array4f)

        def body(k: Any, last: list[Any], memory: list[Any]) -> tuple[Any, list[Any], list[Any]]:
            """Run instruction k of each lane. last: the result of the instruction before."""
            words = dr.gather(word_type, program.words, k)
            flags, slot = words[3], words[1] & mask
            reads = (flags & _READS) != 0
            read = dr.if_stmt((slot, memory, last), reads, _read_all, _keep_last)
            is_first, is_second = (flags & _FIRST) != 0, (flags & _SECOND) != 0
            first = [dr.select(is_first, a, b) for a, b in zip(read, last, strict=True)]
            second = [dr.select(is_second, a, b) for a, b in zip(read, last, strict=True)]
            if has_chains:
                begins = (flags & _BEGINS) != 0
                first = [dr.select(begins, a, b) for a, b in zip(infinite, first, strict=True)]
            third = [slots.read(words[1] >> _SLOT_BITS, reads) for slots in memory if has_third]
            constants = program.constants.read_record(words[2])
            parts = dr.switch(words[0] & mask, calls, first, second, third, constants, packed)
            is_written = (flags & _WRITES) != 0
            slot = words[0] >> _SLOT_BITS
            memory = dr.if_stmt((slot, memory, parts), is_written, _write_all, _keep_memory)
            return k + 1, parts, memory

        start = self.begin + backend.UInt32(0 * zero)
        last = [zero + dr.nan for _ in memory]

        def is_running(k: Any, *_: Any) -> Any:
            """Whether there is an instruction k in the list of each lane."""
            return k < self.end

        _, parts, _ = dr.while_loop((start, last, memory), is_running, body, label="tape")
        return _numbers_of_parts(layouts, parts, numbers)

    def _memory(self, layouts: list[_Layout], numbers: Sequence[Any], zero: Real) -> list[Any]:
        """Local memory for the parts of results, with the coordinates in their slots. numbers: the
        coordinates of all points."""
        backend = self.program.backend
        size = sum(layout.size for layout in layouts)
        memory = [allocate_local(backend, self.program.slot_count) for _ in range(size)]
        for axis in range(COORDINATE_COUNT):
            parts = [
                part
                for j, layout in enumerate(layouts)
                for part in layout.parts(numbers[COORDINATE_COUNT * j + axis], zero)
            ]
            for slots, part in zip(memory, parts, strict=True):
                slots[backend.UInt32(axis)] = part
        return memory

    def _call(self, operation: Operation, layouts: list[_Layout], unpack: Any) -> Any:
        """A function that applies an operation to the parts of its operands, for several
        numbers."""

        def call(
            first: list[Real], second: list[Real], third: list[Real], constants: list[Real],
            packed: list[Real],
        ) -> list[Real]:  # fmt: skip
            """The parts of the results. constants: the lower ends, then the upper ends if these
            differ. packed: the coordinates."""
            coordinates = unpack(packed)
            parts: list[Real] = []
            start = 0
            for j, layout in enumerate(layouts):
                end = start + layout.size
                point = coordinates[COORDINATE_COUNT * j : COORDINATE_COUNT * (j + 1)]
                if operation.is_of_point:
                    operands = point
                else:
                    entries = (first, second, third)[: operation.operand_count]
                    operands = [layout.number(entry[start:end], point[0]) for entry in entries]
                    operands += point if operation.is_member else []
                bounds = self._constants(operation, constants, point[0])
                value = operation.apply(operands, bounds)
                parts.extend(layout.parts(value, 0 * packed[0]))
                start = end
            return parts

        return call

    def _constants(self, operation: Operation, constants: list[Real], like: Any) -> list[Any]:
        """The constants of an operation, as numbers of the arithmetic of `like`."""
        is_double = self.program.backend.precision == "double"
        low = constants[: operation.constant_count]
        if is_double:
            return [like.constant(number) for number in low]
        width = self.program.constant_count
        high = constants[width : width + operation.constant_count]
        return [like.constant_between(*ends) for ends in zip(low, high, strict=True)]


def _read_all(slot: Any, memory: list[Any], last: list[Real]) -> list[Real]:
    """The parts of a result in local memory. (A packet of lanes none of which reads skips this.)"""
    del last
    return [slots.read(slot) for slots in memory]


def _keep_last(slot: Any, memory: list[Any], last: list[Real]) -> list[Real]:
    """The parts of the result of the instruction before."""
    del slot, memory
    return last


def _write_all(slot: Any, memory: list[Any], parts: list[Real]) -> list[Any]:
    """Write the parts of a result into local memory."""
    for slots, part in zip(memory, parts, strict=True):
        slots.write(part, slot)
    return memory


def _keep_memory(slot: Any, memory: list[Any], parts: list[Real]) -> list[Any]:
    """Leave local memory as it is."""
    del slot, parts
    return memory


def _first(first: list[Real], *_: Any) -> list[Real]:
    """The operation that reads an operand from local memory."""
    return first


def _numbers_of_parts(
    layouts: list[_Layout], parts: list[Real], coordinates: Sequence[Any]
) -> list[Any]:
    """The values for several points from all their parts. coordinates: of the points."""
    values: list[Any] = []
    for j, layout in enumerate(layouts):
        values.append(layout.number(parts[: layout.size], coordinates[COORDINATE_COUNT * j]))
        parts = parts[layout.size :]
    return values


def _pack(numbers: Sequence[Any]) -> tuple[list[Any], Callable[[list[Any]], Sequence[Any]]]:
    """The Dr.Jit arrays in numbers of any arithmetic, each once; and a function that makes the
    numbers of other arrays in their place. What is a Python number stays one, and ends of intervals
    that are the same object stay so: operations with them are shorter."""
    arrays: list[Any] = []
    index_of: dict[int, int] = {}

    def note(value: Any) -> Any:
        """Keep the arrays in a value, and return it with their indices in their place."""
        if dr.is_array_v(type(value)):
            if id(value) not in index_of:
                index_of[id(value)] = len(arrays)
                arrays.append(value)
            return _Place(index_of[id(value)])
        if isinstance(value, tuple):
            return tuple(note(entry) for entry in cast("tuple[Any, ...]", value))
        if dataclasses.is_dataclass(value):
            return type(value), {f.name: note(getattr(value, f.name)) for f in fields(value)}
        return value

    return arrays, _builder(note(tuple(numbers)))


@dataclass(frozen=True)
class _Place:
    """The place of an array with this index."""

    index: int


def _builder(form: Any) -> Callable[[list[Any]], Any]:
    """A function that makes the value with this form (`_pack`) of arrays. It is called for each
    operation of each kernel, and so does not look at the form again."""
    if isinstance(form, _Place):
        return operator.itemgetter(form.index)
    if not isinstance(form, tuple):
        return lambda _: form
    entries = cast("tuple[Any, ...]", form)
    if len(entries) == 2 and isinstance(entries[0], type):
        kind = cast("Any", entries[0])
        names, builders = tuple(entries[1]), [_builder(entry) for entry in entries[1].values()]
        return lambda arrays: kind(
            **{name: build(arrays) for name, build in zip(names, builders, strict=True)}
        )
    builders = [_builder(entry) for entry in entries]
    return lambda arrays: tuple([build(arrays) for build in builders])


@dataclass(frozen=True)
class _Layout:
    """How numbers of an arithmetic are stored as parts, which are Dr.Jit numbers of one type.

    kind: the class of the numbers.
    first, second: for jets, the numbers of their first and second derivatives.
    start_second: the number of second derivatives at the start of a piece of a path; None if there
        is no such piece.
    """

    kind: type[Any]
    first: int = 0
    second: int = 0
    start_second: int | None = None

    @classmethod
    def of(cls, number: Any) -> _Layout:
        """The layout of numbers like this one.

        Raises:
            TypeError: it is of another arithmetic.
        """
        if isinstance(number, Jet):
            start = number.jet_at_start
            return cls(
                Jet, len(number.first_derivatives), len(number.second_derivatives),
                None if start is None else len(start.second_derivatives),
            )  # fmt: skip
        if isinstance(number, Values | Dual):
            return cls(type(number))
        raise TypeError(
            f"a long formula is evaluated with ranges of values and derivatives, and not with "
            f"numbers of type {type(number).__name__}: leave enclosures out, or use "
            '"pieces"'
        )

    @property
    def size(self) -> int:
        """The number of parts of a number."""
        if self.kind is Dual:
            return 4
        if self.kind is Values:
            return 5
        at_start = 0 if self.start_second is None else 2 + 2 * self.first + 2 * self.start_second
        return 2 + 2 * self.first + 2 * self.second + at_start

    def parts(self, number: Any, zero: Real) -> list[Real]:
        """The parts of a number. zero: 0 as a Dr.Jit number."""
        if isinstance(number, Dual):
            parts = [number.value, *number.first_derivatives]
        elif isinstance(number, Values):
            masks = (number.nowhere, number.jumps, number.gaps)
            parts = [number.value.lower, number.value.upper]
            parts += [dr.select(mask, zero + 1, zero) for mask in masks]
        else:
            parts = _ends_of_jet(number)
            if number.jet_at_start is not None:
                parts += _ends_of_jet(number.jet_at_start)
        return [zero + part for part in parts]

    def number(self, parts: list[Real], like: Any) -> Any:
        """The number with these parts. like: a number on the same piece of a path."""
        if self.kind is Dual:
            return Dual(parts[0], (parts[1], parts[2], parts[3]))
        if self.kind is Values:
            low, high, *masks = parts
            nowhere, jumps, gaps = (mask > 0.5 for mask in masks)
            return Values(Interval(low, high), nowhere, jumps, gaps)
        start, length = None, like.piece_length
        if self.start_second is not None:
            own = 2 + 2 * self.first + 2 * self.second
            start = _jet_of_ends(parts[own:], self.first, 0 * length)
            parts = parts[:own]
        return _jet_of_ends(parts, self.first, length, start)


def _ends_of_jet(jet: Jet) -> list[Any]:
    """The ends of all ranges of a jet."""
    ranges = (jet.value, *jet.first_derivatives, *jet.second_derivatives)
    return [end for entry in ranges for end in (entry.lower, entry.upper)]


def _jet_of_ends(ends: list[Real], first: int, length: Real, start: Jet | None = None) -> Jet:
    """The jet with these ends of ranges. first: the number of first derivatives."""
    value, *derivatives = (Interval(*ends[k : k + 2]) for k in range(0, len(ends), 2))
    return Jet(value, tuple(derivatives[:first]), tuple(derivatives[first:]), start, length)
