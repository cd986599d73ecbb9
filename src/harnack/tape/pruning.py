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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

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


# The places of the octants of a box: for each axis, 0 for the lower half and 1 for the upper one.
OCTANTS = np.array(list(itertools.product((0, 1), repeat=3)))

# How far limits are from the levels, as a fraction of the range of the formula on the box.
_LIMIT_SHARE = 1 / 8


@dataclass(frozen=True, eq=False)
class PrunedTapes:
    """Pruned lists of m boxes.

    lists: the lists.
    low, high: (m,) the ranges of the formula on the boxes.
    limits: the values that are computed rightly.
    caps: (n,) for entries that are members of chains, the number above which their functions do
        not matter.
    """

    lists: BoxTapes
    low: FloatArray
    high: FloatArray
    limits: BoxLimits
    caps: FloatArray

    def subset(self, which: IntArray) -> PrunedTapes:
        """The lists of the boxes with these indices."""
        caps = self.caps[self.lists.entries_of(which)]
        lists, limits = self.lists.subset(which), self.limits.subset(which)
        return PrunedTapes(lists, self.low[which], self.high[which], limits, caps)

    def octants(self, middles: FloatArray, margin: float) -> BoxTapes:
        """For all boxes the lists of their first octants, then those of the second ones, and so on
        (`OCTANTS`). Members of chains are left out where the box of their function is farther from
        an octant than their cap, since its distance is a lower bound of the function there.

        middles: (m, 3) the middles of the boxes.
        margin: how far octants reach beyond their faces.
        """
        lists, reach = self.lists, np.maximum(self.caps, 0.0) + margin
        lower, upper = (ends[:, lists.instructions] for ends in lists.tape.boxes)
        columns = np.ascontiguousarray(middles.T)[:, lists.boxes]
        touches: Any = (lower - columns <= reach, columns - upper <= reach)
        is_member = lists.tape.chains[lists.instructions] >= 0
        return BoxTapes.concatenated(
            [
                lists.without_members(is_member & ~(touches[x][0] & touches[y][1] & touches[z][2]))
                for x, y, z in OCTANTS.tolist()
            ]
        )


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
        Members of a chain (`operations.chain_operation`) follow one another, and the first one in a
        list may have none, too.
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

    def entries_of(self, which: IntArray) -> IntArray:
        """The entries of the lists of the boxes with these indices, one list after another."""
        lengths = self.lengths[which]
        starts = np.cumsum(lengths) - lengths
        offsets: IntArray = np.repeat(self.starts[which] - starts, lengths)
        return np.arange(len(offsets)) + offsets

    def without_members(self, is_left_out: BoolArray) -> BoxTapes:
        """The lists without some members of chains (n,). A chain keeps a member or its first
        operand."""
        keeps, same = ~is_left_out, np.arange(len(self.instructions), dtype=np.int32)
        before = self.operands[0].copy()
        for kind, group in self._groups:
            if kind == _CHAIN:
                chains = self._chains(group)
                chains.link(keeps[group], chains.has_operand, keeps, same, before)
                same[group] = same[same[group]]
        return self._compressed(keeps, same, before)

    def _compressed(self, keeps: BoolArray, same: EntryArray, before: EntryArray) -> BoxTapes:
        """The lists of the entries that are kept (n,). same: (n,) for each the entry by which it is
        replaced; before: (n,) its first operand."""
        new_index = np.cumsum(keeps, dtype=np.int32) - 1
        kept = np.flatnonzero(keeps)
        columns = [before, *self.operands[1:]]
        operands = np.stack([new_index[same[column[kept]]] for column in columns])
        counts = np.bincount(self.boxes[kept], minlength=len(self))
        starts = np.concatenate([[0], np.cumsum(counts)])
        return BoxTapes(self.tape, starts, self.instructions[kept], operands)

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
        starts = np.repeat(self.starts[:-1], self.lengths)
        columns = [self.instructions, *(self.operands - starts.astype(np.int32))]
        places = np.arange(len(starts)) - starts
        keys = np.add.reduceat(_hashes(columns, places), self.starts[:-1])
        _, first, index = np.unique(keys, return_index=True, return_inverse=True)
        # Lists keep their order, as neighbors in space have the same ones.
        order = np.argsort(first)
        first, index = first[order], np.argsort(order)[index]
        # Lists that differ may have one key, though hardly ever: all are compared.
        same = self.starts[:-1][first[index]]
        is_equal = np.array_equal(self.lengths[first[index]], self.lengths) and all(
            np.array_equal(column[np.repeat(same, self.lengths) + places], column)
            for column in columns
        )
        if is_equal:
            return self.subset(first), index
        rows, ends = np.column_stack(columns).astype(np.int32), self.starts.tolist()
        index_of: dict[bytes, int] = {}
        texts = [rows[start:end].tobytes() for start, end in itertools.pairwise(ends)]
        index = np.array([index_of.setdefault(text, len(index_of)) for text in texts], np.int64)
        return self.subset(np.unique(index, return_index=True)[1]), index

    @functools.cached_property
    def _groups(self) -> list[tuple[int, EntryArray]]:
        """The entries, in groups with the same operation, each group after those of its operands:
        pairs of the index of the operation (-1 for coordinates) and the entries (k,). Members of
        chains are groups of their own, whatever their operations, with the index `_CHAIN`."""
        kinds_of_tape = np.where(self.tape.chains >= 0, _CHAIN, self.tape.kinds)
        kinds = kinds_of_tape[self.instructions]
        keys = self.tape.depths * (len(self.tape.operations) + 2) + kinds_of_tape - _CHAIN
        if keys.max() < 1 << 16:
            keys = keys.astype(np.uint16)  # NumPy sorts short integers several times as fast
        keys = keys[self.instructions]
        order = np.argsort(keys, kind="stable").astype(np.int32)
        borders = np.flatnonzero(np.diff(keys[order].astype(np.int64))) + 1
        groups = np.split(order, borders) if len(order) else []
        return [(int(kinds[group[0]]), group) for group in groups]

    def _chains(self, group: EntryArray) -> _Chains:
        """The chains of a group."""
        before = self.operands[0][group]
        chains = self.tape.chains[self.instructions]
        is_first = (before != group - 1) | (chains[before] != chains[group])
        starts = np.flatnonzero(is_first)
        return _Chains(group, starts, before[starts])

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
        changes a value of the formula that matters. (A replaced entry passes on its own limits.) A
        chain is the minimum of its members' functions and of its first operand: those above the cap
        are left out, but for one if all are.
        """
        low, high, members = self._ranges(lower, upper)
        result = self.results
        limits = limits.narrowed(low[result], high[result])
        same, keeps, before, caps = self._replacements(low, high, members, limits)
        lists = self._compressed(keeps, same, before)
        return PrunedTapes(lists, low[result], high[result], limits, caps[keeps])

    def _ranges(
        self, lower: FloatArray, upper: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The ranges of all entries on their boxes: their lower and upper ends (n,); and the lower
        ends of the functions of members of chains (n,), which are infinite for other entries. The
        range of a member is that of its chain."""
        count = len(self.instructions)
        low, high, members = np.empty(count), np.empty(count), np.full(count, np.inf)
        columns = np.ascontiguousarray(lower.T), np.ascontiguousarray(upper.T)
        for kind, group in self._groups:
            if kind == _CHAIN:
                high_members = self._member_ranges(group, columns, members)
                chains = self._chains(group)
                low[group] = chains.spread(chains.least(members[group], low))
                high[group] = chains.spread(chains.least(high_members, high))
                continue
            if kind < 0:
                axes, boxes = self.instructions[group], self.boxes[group]
                low[group], high[group] = lower[boxes, axes], upper[boxes, axes]
                continue
            operation = self.tape.operations[kind]
            ranges = [(low[column], high[column]) for column in self._operand_columns(kind, group)]
            if operation.is_of_point:
                ranges = self._ranges_of_point(group, columns)
            constants = self._constant_columns(kind, group)
            low[group], high[group] = operation.rounded_ranges(ranges, constants)
        return low, high, members

    def _ranges_of_point(
        self, group: EntryArray, columns: tuple[FloatArray, FloatArray]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """The ranges of x, y and z for the entries of a group. columns: (3, m), (3, m) the corners
        of the boxes."""
        boxes = self.boxes[group]
        return [(start[boxes], end[boxes]) for start, end in zip(*columns, strict=True)]

    def _member_ranges(
        self, group: EntryArray, columns: tuple[FloatArray, FloatArray], lows: FloatArray
    ) -> FloatArray:
        """The ranges of the functions of members of chains: the upper ends (k,), and the lower ends
        are written to `lows` (n,)."""
        highs = np.empty(len(group))
        kinds = self.tape.kinds[self.instructions[group]]
        for kind in np.flatnonzero(np.bincount(kinds)).tolist():
            where = np.flatnonzero(kinds == kind)
            entries = group[where] if len(where) < len(group) else group
            ranges = self._ranges_of_point(entries, columns)
            constants = self._constant_columns(kind, entries)
            own = self.tape.operations[kind].rounded_ranges(ranges, constants)
            lows[entries], highs[where] = own
        return highs

    def _replacements(
        self, low: FloatArray, high: FloatArray, members: FloatArray, limits_of_boxes: BoxLimits
    ) -> tuple[EntryArray, BoolArray, EntryArray, FloatArray]:
        """For each entry (n,) the entry by which it is replaced, mostly itself; whether the last
        entry of its list still needs it; its first operand; and for members of chains their cap
        (`PrunedTapes.caps`). low, high, members: (n,) the ranges of the entries (`_ranges`)."""
        count = len(self.instructions)
        floor, cap = np.full(count, np.inf), np.full(count, -np.inf)
        floor[self.results] = limits_of_boxes.floor
        cap[self.results] = limits_of_boxes.cap
        same, needed = np.arange(count, dtype=np.int32), np.zeros(count, np.bool_)
        needed[self.results] = True
        before, caps = self.operands[0].copy(), np.full(count, np.inf)
        for kind, whole_group in reversed(self._groups):
            if kind == _CHAIN:
                chains = self._chains(whole_group)
                limits = floor[chains.last], cap[chains.last]
                own_caps = np.minimum(limits[1], high[chains.last])
                caps[whole_group] = chains.spread(own_caps)
                is_used = needed[chains.last]
                is_kept = members[whole_group] <= caps[whole_group]
                has_head = chains.has_operand & (low[chains.operands] <= own_caps)
                chains.link(is_kept, has_head, needed, same, before, is_used)
                heads = chains.operands[has_head & is_used]
                needed[heads] = True
                own_floors = np.maximum(limits[0], low[chains.last])[has_head & is_used]
                np.minimum.at(floor, heads, own_floors)
                np.maximum.at(cap, heads, own_caps[has_head & is_used])
                continue
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
            if kind == _CHAIN or (kind >= 0 and self.tape.operations[kind].choice is not None):
                same[group] = same[same[group]]
        return same, needed, before, caps

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


# The index of an operation that stands for all members of chains.
_CHAIN = -2


@dataclass(frozen=True, eq=False)
class _Chains:
    """The chains of a group of entries, which are the members of all of them, one after another.

    entries: (k,) the members.
    starts: (c,) for each chain the place of its first member among the entries.
    operands: (c,) the first operands: the entry before the chain; the first member itself for none.
    """

    entries: EntryArray
    starts: IntArray
    operands: EntryArray

    @property
    def first(self) -> EntryArray:
        """The first members (c,)."""
        return self.entries[self.starts]

    @property
    def has_operand(self) -> BoolArray:
        """Whether chains (c,) have a first operand."""
        return self.operands != self.first

    @property
    def last(self) -> EntryArray:
        """The last members (c,), whose value is that of the chain."""
        return self.entries[np.append(self.starts[1:], len(self.entries)) - 1]

    def spread(self, values: Any) -> Any:
        """Values of chains (c,), for each of their members (k,)."""
        return np.repeat(values, np.diff(self.starts, append=len(self.entries)))

    def least(self, of_members: FloatArray, of_entries: FloatArray) -> FloatArray:
        """The least value of each chain (c,). of_members: (k,); of_entries: (n,) those of first
        operands."""
        least = np.minimum.reduceat(of_members, self.starts)
        return np.where(self.has_operand, np.minimum(least, of_entries[self.operands]), least)

    def link(
        self, is_kept: BoolArray, has_head: BoolArray, keeps: BoolArray, same: EntryArray,
        before: EntryArray, is_used: BoolArray | None = None,
    ) -> None:  # fmt: skip
        """Leave out members: write whether entries are kept (`keeps`), by which entry the last
        member is replaced (`same`), and which is the first operand of members (`before`), each
        (n,). A chain of which nothing would be left keeps its first member.

        is_kept: (k,) whether members matter, which is changed.
        has_head: (c,) whether the first operand of chains is there and matters.
        is_used: (c,) whether the value of chains is used; None for all.
        """
        counts = np.add.reduceat(is_kept, self.starts, dtype=np.int64)
        is_kept[self.starts[(counts == 0) & ~has_head]] = True
        if is_used is not None:
            is_kept &= self.spread(is_used)
        keeps[self.entries] = is_kept
        # For each member the place of the last one that is kept up to it, and of the one before.
        up_to = np.maximum.accumulate(np.where(is_kept, np.arange(len(is_kept)), -1))
        earlier = np.append(-1, up_to[:-1])
        head = self.spread(np.where(has_head, self.operands, -1))
        previous = np.where(earlier >= self.spread(self.starts), self.entries[earlier], head)
        before[self.entries] = np.where(previous >= 0, previous, self.entries)
        final = up_to[np.append(self.starts[1:], len(is_kept)) - 1]
        value = np.where(final >= self.starts, self.entries[final], self.operands)
        same[self.last] = value if is_used is None else np.where(is_used, value, self.last)


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


def _hashes(columns: Sequence[EntryArray], places: IntArray) -> npt.NDArray[np.uint64]:
    """For each entry of lists (n,) a hash of its numbers in all columns and of its place in its
    list. Sums of the hashes of different lists are different but by chance."""
    shift, factors = np.uint64(31), (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
    multiply, add, mix = (np.uint64(factor) for factor in factors)
    hashes = places.astype(np.uint64) * mix
    for column in columns:
        hashes += column.astype(np.uint64) * add  # modulo 2^64, as all of this
        hashes ^= hashes >> shift
        hashes *= multiply
    return hashes ^ (hashes >> shift)
