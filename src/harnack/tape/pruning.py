"""Tapes for boxes: of a formula's instructions only those that can matter on a box. On each box
ranges of all results are computed, by interval arithmetic. Where the range of one operand of a
minimum is below that of the other, the minimum is that operand, and what only the other one needs
is left out (as of other choices: `operations`). The value of the formula in the box is unchanged.
If only values near some levels matter, those are unchanged, and all others stay on their side.

The lists of instructions of many boxes are stored one after another, in `BoxTapes`.

Sources: Duff 1992 (pruning of constructive solid geometry by interval arithmetic); Keeter 2020
(shortened tapes). New here: blends and the distances of boxes are pruned by choices as well.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from harnack.tape.operations import COORDINATE_COUNT

if TYPE_CHECKING:
    import numpy.typing as npt

    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.tape.recording import Tape

EntryArray: TypeAlias = (
    "npt.NDArray[np.int32] | npt.NDArray[np.int64] | npt.NDArray[np.int32 | np.int64]"
)
"""Indices of entries of lists, which are many: 32 bits save memory and time."""

__all__ = ["BoxLimits", "BoxTapes", "PrunedTapes"]


@dataclass(frozen=True, eq=False)
class BoxLimits:
    """Which values of a formula matter on m boxes: a value above the cap may be replaced by any
    other value above the cap, and one below the floor by any other below the floor.

    floor, cap: (m,).
    levels: values that matter on all boxes; () for all values.
    """

    floor: FloatArray
    cap: FloatArray
    levels: tuple[float, ...]

    @classmethod
    def unlimited(cls, count: int, levels: tuple[float, ...]) -> BoxLimits:
        """No limits on `count` boxes."""
        return cls(np.full(count, -np.inf), np.full(count, np.inf), levels)

    def subset(self, which: IntArray) -> BoxLimits:
        """The limits of the boxes with these indices."""
        return replace(self, floor=self.floor[which], cap=self.cap[which])

    def narrowed(self, low: FloatArray, high: FloatArray) -> BoxLimits:
        """Limits farther from the levels than the formula changes in an eighth of a box, within
        these limits: beyond them no ray comes near a level. low, high: (m,) its ranges."""
        if not self.levels:
            return self
        reach = np.maximum(_LIMIT_SHARE * (high - low), 0.0)
        return replace(
            self,
            floor=np.fmax(self.floor, min(self.levels) - reach),
            cap=np.fmin(self.cap, max(self.levels) + reach),
        )


# How far limits are from the levels, as a fraction of the range of the formula on the box.
_LIMIT_SHARE = 1 / 8


@dataclass(frozen=True, eq=False)
class PrunedTapes:
    """Pruned lists of m boxes.

    lists: the lists.
    low, high: (m,) the ranges of the formula on the boxes.
    limits: the values that are computed rightly.
    """

    lists: BoxTapes
    low: FloatArray
    high: FloatArray
    limits: BoxLimits


@dataclass(frozen=True, eq=False)
class BoxTapes:
    """For each of m boxes, a list of instructions of a tape, in their order. Entries of all lists
    are stored one after another; the last entry of a list gives the value of the formula in the
    box.

    tape: the whole tape.
    starts: (m + 1,) the list of box k has the entries starts[k] to starts[k + 1] - 1.
    instructions: (n,) for each entry the instruction of the tape.
    operands: (3, n) for each entry the entries that are its operands; the entry itself in place of
        operands that its operation does not have. Operations of the point itself
        (`Operation.is_of_point`) have none: coordinates are in a list only where others use them.
    """

    tape: Tape
    starts: IntArray
    instructions: EntryArray
    operands: EntryArray

    @classmethod
    def whole(cls, tape: Tape) -> BoxTapes:
        """The list of all instructions, for a single box of any size."""
        count = tape.result + 1
        instructions = np.arange(count, dtype=np.int32)
        operands = tape.operands[:count].T.astype(np.int32)
        is_known = (operands >= 0) & ~tape.is_of_point[:count]
        operands = np.where(is_known, operands, instructions)
        return cls(tape, np.array([0, count], np.int64), instructions, operands)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def lengths(self) -> IntArray:
        """The numbers of entries of the lists (m,)."""
        return np.diff(self.starts)

    @property
    def results(self) -> IntArray:
        """The last entries of the lists (m,)."""
        return self.starts[1:] - 1

    @functools.cached_property
    def boxes(self) -> IntArray:
        """For each entry (n,) the box whose list it is in."""
        return np.repeat(np.arange(len(self)), self.lengths)

    def subset(self, which: IntArray) -> BoxTapes:
        """The lists of the boxes with these indices, which may be repeated, in this order."""
        lengths = self.lengths[which]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        # For each entry of the result, how far its list has moved.
        moved = np.repeat((self.starts[which] - starts[:-1]).astype(np.int32), lengths)
        entries = np.arange(starts[-1], dtype=np.int32) + moved
        operands = np.stack([column[entries] - moved for column in self.operands])
        return BoxTapes(self.tape, starts, self.instructions[entries], operands)

    @classmethod
    def concatenated(cls, parts: list[BoxTapes]) -> BoxTapes:
        """The lists of all parts, one after another. There is at least one part."""
        offsets = np.cumsum([0, *(len(part.instructions) for part in parts)])
        pairs = list(zip(parts, offsets[:-1].tolist(), strict=True))
        starts = [part.starts[:-1] + offset for part, offset in pairs]
        return cls(
            parts[0].tape,
            np.concatenate([*starts, offsets[-1:]]),
            np.concatenate([part.instructions for part in parts]),
            np.concatenate([part.operands + np.int32(offset) for part, offset in pairs], axis=1),
        )

    def distinct(self) -> tuple[BoxTapes, IntArray]:
        """The lists without repetitions, of which many boxes have few; and for each box (m,) the
        index of its list among them."""
        relative = self.operands - self.starts[self.boxes].astype(np.int32)
        columns = np.column_stack([self.instructions, *relative]).astype(np.int32)
        text, ends = columns.tobytes(), (self.starts * columns.strides[0]).tolist()
        index_of: dict[bytes, int] = {}
        first: list[int] = []
        index = np.empty(len(self), np.int64)
        for box, (start, end) in enumerate(itertools.pairwise(ends)):
            index[box] = index_of.setdefault(text[start:end], len(first))
            if index[box] == len(first):
                first.append(box)
        return self.subset(np.array(first, np.int64)), index

    @functools.cached_property
    def _groups(self) -> list[tuple[int, EntryArray]]:
        """The entries, in groups with the same operation, each group after those of its operands:
        pairs of the index of the operation (-1 for coordinates) and the entries (k,)."""
        kinds = self.tape.kinds[self.instructions]
        keys = self.tape.depths * (len(self.tape.operations) + 1) + self.tape.kinds + 1
        if keys.max() < 1 << 16:
            keys = keys.astype(np.uint16)  # NumPy sorts short integers several times as fast
        keys = keys[self.instructions]
        order = np.argsort(keys, kind="stable").astype(np.int32)
        borders = np.flatnonzero(np.diff(keys[order].astype(np.int64))) + 1
        groups = np.split(order, borders)
        return [(int(kinds[group[0]]), group) for group in groups]

    def _operand_columns(self, kind: int, group: EntryArray) -> list[EntryArray]:
        """The operands (k,) of the entries of a group: an array for each operand of the
        operation."""
        operation = self.tape.operations[kind]
        count = 0 if operation.is_of_point else operation.operand_count
        return [column[group] for column in self.operands[:count]]

    def _constant_columns(self, kind: int, group: EntryArray) -> list[FloatArray]:
        """The constants (k,) of the entries of a group: an array for each of the operation's."""
        instructions = self.instructions[group]
        count = self.tape.operations[kind].constant_count
        return [column[instructions] for column in self.tape.constant_columns[:count]]

    def pruned(self, lower: FloatArray, upper: FloatArray, limits: BoxLimits) -> PrunedTapes:
        """The lists without what cannot matter on boxes.

        lower, upper: (m, 3) the corners of the boxes.
        limits: which values of the formula matter on each box.

        Proof. The ranges hold by induction, from the coordinates on. The limits of the last entry
        are those of its box. Going down from it, the limits of an entry are the widest that follow
        from the entries that use it (`Operation.limits`), and where the operation chooses an
        operand, the entry is replaced by that one. By the definition of limits no replacement
        changes a value of the formula that matters. (A replaced entry passes on its own limits.)
        """
        low, high = self._ranges(lower, upper)
        result = self.results
        limits = limits.narrowed(low[result], high[result])
        same, keeps = self._replacements(low, high, limits)
        new_index = np.cumsum(keeps, dtype=np.int32) - 1
        kept = np.flatnonzero(keeps)
        operands = np.stack([new_index[same[column[kept]]] for column in self.operands])
        counts = np.bincount(self.boxes[kept], minlength=len(self))
        starts = np.concatenate([[0], np.cumsum(counts)])
        lists = BoxTapes(self.tape, starts, self.instructions[kept], operands)
        return PrunedTapes(lists, low[result], high[result], limits)

    def _ranges(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The ranges of all entries on their boxes: their lower and upper ends (n,)."""
        count = len(self.instructions)
        low, high = np.empty(count), np.empty(count)
        lower_columns, upper_columns = np.ascontiguousarray(lower.T), np.ascontiguousarray(upper.T)
        for kind, group in self._groups:
            if kind < 0:
                axes, boxes = self.instructions[group], self.boxes[group]
                low[group], high[group] = lower[boxes, axes], upper[boxes, axes]
                continue
            operation = self.tape.operations[kind]
            ranges = [(low[column], high[column]) for column in self._operand_columns(kind, group)]
            if operation.is_of_point:
                boxes = self.boxes[group]
                columns = zip(lower_columns, upper_columns, strict=True)
                ranges = [(start[boxes], end[boxes]) for start, end in columns]
            constants = self._constant_columns(kind, group)
            low[group], high[group] = operation.rounded_ranges(ranges, constants)
        return low, high

    def _replacements(
        self, low: FloatArray, high: FloatArray, limits_of_boxes: BoxLimits
    ) -> tuple[EntryArray, BoolArray]:
        """For each entry (n,) the entry by which it is replaced, mostly itself; and whether the
        last entry of its list still needs it (n,). low, high: (n,) the ranges of the entries."""
        count = len(self.instructions)
        floor, cap = np.full(count, np.inf), np.full(count, -np.inf)
        floor[self.results] = limits_of_boxes.floor
        cap[self.results] = limits_of_boxes.cap
        same, needed = np.arange(count, dtype=np.int32), np.zeros(count, np.bool_)
        needed[self.results] = True
        for kind, whole_group in reversed(self._groups):
            group = whole_group[needed[whole_group]]
            if kind < 0 or not len(group):
                continue
            operation = self.tape.operations[kind]
            columns = self._operand_columns(kind, group)
            # No value outside of the range occurs.
            limits = np.maximum(floor[group], low[group]), np.minimum(cap[group], high[group])
            constants = self._constant_columns(kind, group)
            choice = None
            if operation.choice is not None:
                ranges = [(low[column], high[column]) for column in columns]
                choice = operation.choice(ranges, constants, limits)
                # An entry that is replaced passes on its own limits.
                for k, column in enumerate(columns):
                    is_chosen = choice == k
                    chosen = column[is_chosen]
                    same[group[is_chosen]], needed[chosen] = chosen, True
                    np.minimum.at(floor, chosen, limits[0][is_chosen])
                    np.maximum.at(cap, chosen, limits[1][is_chosen])
                is_kept = choice < 0
                columns = [column[is_kept] for column in columns]
                limits = limits[0][is_kept], limits[1][is_kept]
                constants = [column[is_kept] for column in constants]
            if operation.limits is None:
                for column in columns:
                    needed[column], floor[column], cap[column] = True, -np.inf, np.inf
                continue
            with np.errstate(all="ignore"):
                lowest, highest = operation.limits(constants, limits)
            for column in columns:
                needed[column] = True
                np.minimum.at(floor, column, lowest)
                np.maximum.at(cap, column, highest)
        needed &= same == np.arange(count, dtype=np.int32)
        for kind, group in self._groups:
            if kind >= 0 and self.tape.operations[kind].choice is not None:
                same[group] = same[same[group]]
        return same, needed

    def slots(self) -> tuple[IntArray, int]:
        """For each entry (n,) the slot in which its result is kept, and the number of slots. The
        coordinates x, y and z have the slots 0, 1 and 2 in every list. Any other slot is used again
        once its result has had its last use, also by the instruction that uses it last, since
        operands are read before results are written."""
        count = len(self.instructions)
        is_coordinate = self.instructions < COORDINATE_COUNT
        entries = np.arange(count)
        last_use = entries.copy()
        for column in self.operands:
            np.maximum.at(last_use, column, entries)
        slots = np.where(is_coordinate, self.instructions, -1)
        lists = _SlotLists(self, slots, last_use, is_coordinate)
        most = COORDINATE_COUNT
        # Long lists one by one, short lists all at once.
        is_long = self.lengths > _LONG_LIST
        for k in np.flatnonzero(is_long):
            most = max(most, lists.assign_one(int(self.starts[k]), int(self.starts[k + 1])))
        return slots, max(most, lists.assign_many(np.flatnonzero(~is_long)))


# Lists of more entries are treated one by one when slots are assigned.
_LONG_LIST = 2_000


@dataclass(frozen=True, eq=False)
class _SlotLists:
    """The assignment of slots to the entries of lists.

    tapes: the lists.
    slots: (n,) for each entry its slot, which is written.
    last_use: (n,) for each entry the last entry that uses its result, or itself.
    is_coordinate: (n,) whether the entry is a coordinate, which has a slot already.
    """

    tapes: BoxTapes
    slots: IntArray
    last_use: IntArray
    is_coordinate: BoolArray

    def assign_one(self, start: int, end: int) -> int:
        """Assign slots to the entries start to end - 1 of a single list. Returns the number of
        slots."""
        slots, free = self.slots[start:end].tolist(), []
        operands, last_use = self.tapes.operands[:, start:end].T.tolist(), self.last_use[start:end]
        last_use, is_coordinate = last_use.tolist(), self.is_coordinate[start:end].tolist()
        used = COORDINATE_COUNT
        for k in range(end - start):
            for operand in {*operands[k]}:
                is_last = operand < k + start and last_use[operand - start] == k + start
                if is_last and not is_coordinate[operand - start]:
                    free.append(slots[operand - start])
            if is_coordinate[k]:
                continue
            if free:
                slots[k] = free.pop()
            else:
                slots[k], used = used, used + 1
        self.slots[start:end] = slots
        return used

    def assign_many(self, lists: IntArray) -> int:
        """Assign slots to the entries of many lists at once, one position in all lists after
        another. Returns the largest number of slots."""
        # Longest lists first: those that have an entry at a position are then the first ones.
        lists = lists[np.argsort(-self.tapes.lengths[lists], kind="stable")]
        lengths, starts = self.tapes.lengths[lists], self.tapes.starts[lists]
        is_free = np.ones((len(lists), 8), np.bool_)
        is_free[:, :COORDINATE_COUNT] = False
        most = COORDINATE_COUNT
        for k in range(int(lengths.max(initial=0))):
            count = int(np.searchsorted(-lengths, -k, side="left"))  # lists longer than k
            rows, entries = np.arange(count), starts[:count] + k
            for column in (row[entries] for row in self.tapes.operands):
                ends = (column < entries) & (self.last_use[column] == entries)
                ends &= ~self.is_coordinate[column]
                is_free[rows[ends], self.slots[column[ends]]] = True
            needs = ~self.is_coordinate[entries]
            if not is_free[:count].any(axis=1).all():
                is_free = np.concatenate([is_free, np.ones_like(is_free)], axis=1)
            first = is_free[:count].argmax(axis=1)
            rows, first, entries = rows[needs], first[needs], entries[needs]
            is_free[rows, first] = False
            self.slots[entries] = first
            most = max(most, int(first.max(initial=0)) + 1)
        return most
