"""The largest of the sums of blobs of several groups. A blob is a bump around a center that is 0
outside of a ball, its support. Each blob belongs to a group, and each group has a sum, that of its
blobs; f is the largest of these sums. So blobs of one group flow together, and different groups
meet in creases. A list here holds the blobs that may be nonzero near a point or ray, sorted by
groups; a group without a blob in the list has the sum 0 there. The record of a blob is its row of
numbers in a table. Loops are recorded by Dr.Jit: the state of a loop is the tuple of arrays that it
changes from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures import Enclosure, LevelGaps, SlopeRange, longest_free_length
from harnack.fields.blobs.blob_sums import (
    EachBlob,
    ForEach,
    State,
    SumValue,
    jet_bounds,
    jet_from_bounds,
    sum_along,
    sum_jets,
    value_at,
)

if TYPE_CHECKING:
    from harnack.arithmetic import Jet
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.enclosures.samples import Ray
    from harnack.fields.blobs.blob_sums import Term
    from harnack.fields.blobs.kernels import BlobKernel


@dataclass(frozen=True)
class GroupedList:
    """A list of blobs for each lane: the blobs that may be nonzero near the lane's point or ray.
    Blobs of the same group, which are added up, follow one another in the list. It holds positions
    in a table of records (rows of numbers), one record for each blob.

    records: the table of the records of all blobs.
    group_of_record: for each record of the table, the index of its group.
    entries: an array of indices of records; None if the list is a range of the table itself.
    begin, end: the list has the records with the indices entries[begin:end], or if `entries` is
        None, the records from begin to end - 1.
    group_count: how many groups exist, including groups without a blob in this list.
    """

    records: RecordTable
    group_of_record: Any
    entries: Any
    begin: Any
    end: Any
    group_count: Any

    def record(self, i: Any) -> Any:
        """The index, in the table, of the record of the blob at position i of the list. Positions
        run from `begin` to `end` - 1."""
        if self.entries is None:
            return i
        return dr.gather(self.records.backend.UInt32, self.entries, i)

    def group(self, i: Any) -> Any:
        """The index of the group of the blob at position i of the list. Positions run from `begin`
        to `end` - 1."""
        kind = self.records.backend.UInt32
        return dr.gather(kind, self.group_of_record, self.record(i), i < self.end)

    def each_group(self, body: Any, state: State, label: str) -> tuple[Any, State]:
        """Loop over the groups that have a blob in this list: set state = body(for_each, state) for
        one group after another.

        body: a function that returns the state after one more group. It must call
            for_each(add_blob, blob_state) exactly once: this sets blob_state = add_blob(record,
            blob_state) for each blob of the group and returns the last blob_state.
        state: the first state, a tuple of arrays.
        label: the name of the recorded loop.

        Returns the number of groups that have a blob in the list, and the last state.
        """
        kind = self.records.backend.UInt32

        def step(i: Any, groups: Any, *state: Any) -> State:
            group = _OneGroup(self, i)
            final = body(group, state)
            assert group.end is not None, "the body has to go over the blobs of its group"
            # The next group begins where the blobs of this one end.
            return group.end, groups + 1, *final

        def has_more(i: Any, *_: Any) -> Mask:
            return i < self.end

        start = (kind(self.begin), kind(0), *state)
        _, groups, *final = dr.while_loop(start, has_more, step, label=label)
        return groups, tuple(final)


class _OneGroup:
    """A function that loops over the blobs of one group, which follow one another in a list of
    blobs (`GroupedList`). As the blobs are found during the loop, the end of the group is known
    only afterwards.

    begin: the position in the list of the group's first blob.
    end: the position after its last blob, once the loop has run.
    """

    def __init__(self, blobs: GroupedList, begin: Any) -> None:
        self._blobs, self.begin = blobs, begin
        self.end: Any = None

    def __call__(self, body: EachBlob, state: State) -> State:
        """Set state = body(record, state) for all blobs of the group, one after another, where
        `record` is a blob's row of numbers. Returns the last state."""
        blobs = self._blobs
        group = blobs.group(self.begin)

        def step(i: Any, *state: Any) -> State:
            return i + 1, *body(blobs.records.read_record(blobs.record(i)), state)

        def has_more(i: Any, *_: Any) -> Mask:
            return (i < blobs.end) & (blobs.group(i) == group)

        kind = blobs.records.backend.UInt32
        self.end, *final = dr.while_loop(
            (kind(self.begin), *state), has_more, step, label="blobs of a group"
        )
        return tuple(final)


def group_maximum_at(kernel: BlobKernel, backend: Backend, p: Vec3, blobs: GroupedList) -> SumValue:
    """The largest of the groups' sums of blobs at points p (3, n), with its gradient. Its two error
    bounds, of value and gradient, are the largest that any group has.

    kernel: the shape of all blobs.
    blobs: the list of the blobs that may be nonzero at p.
    """
    real = backend.Float

    def add_group(for_each: ForEach, state: State) -> State:
        """Return the state with another group included. It consists of the largest sum so far, the
        three components of its gradient, and the largest error bounds so far of value and gradient.

        for_each: the loop over the blobs of the group.
        """
        value, x, y, z, error, gradient_error = state
        sums = value_at(kernel, backend, p, for_each)
        is_larger = sums.value > value
        return (
            dr.select(is_larger, sums.value, value),
            dr.select(is_larger, sums.gradient.x, x),
            dr.select(is_larger, sums.gradient.y, y),
            dr.select(is_larger, sums.gradient.z, z),
            fmax(sums.error, error),
            fmax(sums.gradient_error, gradient_error),
        )

    start = (real(-dr.inf), *(real(0) for _ in range(5)))
    groups, final = blobs.each_group(add_group, start, "groups")
    value, x, y, z, error, gradient_error = final
    # A group without a blob in the list has the sum 0, which is then the largest.
    is_zero = (groups < blobs.group_count) & ~(value > 0)
    gradient = dr.select(is_zero, backend.Array3f(0), backend.Array3f(x, y, z))
    return SumValue(dr.select(is_zero, 0, value), gradient, error, gradient_error)


def largest_group_at(kernel: BlobKernel, backend: Backend, p: Vec3, blobs: GroupedList) -> Any:
    """The index of the group whose sum is the largest at points p (3, n), of those that have a blob
    in the list. A group without any has the sum 0; if that is the largest, the result is the number
    of groups, which is the index of none.

    kernel: the shape of all blobs.
    blobs: the list of the blobs that may be nonzero at p.
    """
    real, index = backend.Float, backend.UInt32

    def add_group(for_each: ForEach, state: State) -> State:
        """Return the largest sum so far and the index of its group, with another group included."""
        value, largest = state
        sums = value_at(kernel, backend, p, for_each)
        is_larger = sums.value > value
        group = blobs.group(cast("_OneGroup", for_each).begin)
        return dr.select(is_larger, sums.value, value), dr.select(is_larger, group, largest)

    none = index(blobs.group_count)
    groups, (value, largest) = blobs.each_group(add_group, (real(-dr.inf), none), "largest group")
    return dr.select((groups < blobs.group_count) & ~(value > 0), none, largest)


def for_each_of_group(blobs: GroupedList, group: Any) -> ForEach:
    """Make a function that loops over the blobs of a list, with the amplitude 0 for those of other
    groups than `group`, an index for each lane. The sums that it returns can be differentiated in
    reverse mode (`RecordTable.for_each`)."""

    def for_each(body: EachBlob, state: State) -> State:
        """Set state = body(record, state) for all blobs, one after another, where `state` is a
        tuple of sums. Returns the last state."""

        def step(i: Any, *state: Any) -> State:
            record = blobs.records.read_record(blobs.record(i))
            record[7] = dr.select(blobs.group(i) == group, record[7], 0)
            return i + 1, *body(record, state)

        def has_more(i: Any, *_: Any) -> Mask:
            return i < blobs.end

        start = (blobs.records.backend.UInt32(blobs.begin), *state)
        return dr.while_loop(
            start, has_more, step, label="blobs of the largest group", max_iterations=-1
        )[1:]

    return for_each


def group_maximum_jet(term: Term, like: Jet, zero: Real, blobs: GroupedList) -> Jet:
    """The jet of the largest of the groups' sums of blobs. A jet is a set of intervals that contain
    the values and the derivatives of a function on a piece of a path.

    term: a function that returns the jet of a blob from its record (row of numbers).
    like: any jet with as many derivatives as those of the blobs, and of the same piece.
    zero: the number 0 on each lane.
    blobs: the list of all blobs.
    """

    def add_group(for_each: ForEach, state: State) -> State:
        """Return the state with another group included. It consists of a number that is 1 before
        the first group and 0 afterwards, and of the ends of the intervals of the maximum's jet so
        far.

        for_each: the loop over the blobs of the group.
        """
        group_jet = sum_jets(term, like, zero, for_each)
        maximum = jet_from_bounds(like, iter(state[1:]))
        # Before the first group there is no maximum: the jet of the group is taken alone.
        new_maximum = maximum.maximum(group_jet)
        is_first = state[0] > 0
        return (
            # 0 on each lane, as the state must keep its width.
            real(0) + 0 * zero,
            *(dr.select(is_first, a, b) for a, b in zip(
                jet_bounds(group_jet, zero), jet_bounds(new_maximum, zero), strict=True
            )),
        )  # fmt: skip

    real = cast("Any", type(zero))
    start = (real(1) + 0 * zero, *jet_bounds(like.constant(0.0), zero))
    _, final = blobs.each_group(add_group, start, "groups")
    return jet_from_bounds(like, iter(final[1:]))


@dataclass(frozen=True)
class GroupMaximumEnclosure(Enclosure):
    """A proof of lengths on which the largest of the groups' sums of blobs takes no level (a value
    that rays look for). It is about a path: the straight line from a point p along a ray's
    direction. Each group of blobs has a sum, the sum of its blobs.

    kernel: the shape of all blobs.
    blobs: the blobs that may be nonzero on the path.
    path: the ray; it gives the direction of the path, and the proofs to use.
    p: the points at which the path starts.
    value: the largest sum at p.
    knots: the ends of the pieces of the path on which derivatives are bounded, as distances from p.
    length: the distance from p up to which the list of blobs is complete.
    signed: whether amplitudes (factors of blobs) may be negative.

    Along a path the largest sum reaches a level above it as soon as one of the sums does, and falls
    to a level below it only when the last of the sums has. So the free length upwards is the
    shortest of the groups' free lengths, and the free length downwards is the longest. That is
    sharper than ranges of the maximum itself, because it uses how far each group is from the level.
    (Aydinlilar and Zanni 2023, equation 20, take the maximum of two inclusion functions.)
    """

    kernel: BlobKernel
    blobs: GroupedList
    path: Ray
    p: Vec3
    value: Real
    knots: Sequence[Real]
    length: Real
    signed: bool

    def free_length(self, gaps: LevelGaps) -> Real:
        """A length of the path from p on which the largest of the groups' sums is proved to take no
        level (a value that rays look for). It is the smaller of two lengths: the shortest length of
        any group before its sum rises to the level above, and the longest length of any group
        before its sum falls to the level below.

        gaps: the differences of the largest sum at p from the next levels below and above; infinite
            if there is no such level.

        Proof. The largest sum reaches the level above when the first of the sums does, and falls to
        the level below only when the last of the sums has. Take a group whose sum at p is lower
        than the largest by g (`deficit`). For this group the level above is farther by g, and the
        level below is nearer by g. If it is below that level already, its length downwards is 0.
        The error of g is that of both sums. The larger of these errors has been subtracted from the
        gaps by the tracer (`samples.value_error_bound`).
        """
        backend = self.blobs.records.backend
        real = backend.Float

        def add_group(for_each: ForEach, state: State) -> State:
            """Return the state (rise_length, fall_length) after one more group. A group's sum is
            the sum of all blobs of the group.

            rise_length: the shortest length before the sum of any group so far rises to the level
                above.
            fall_length: the longest length before the sum of any group so far falls to the level
                below.
            for_each: a function that loops over the blobs of the group: for_each(body, state) sets
                state = body(record, state) for each blob and returns the last state.
            """
            rise_length, fall_length = state
            sums = sum_along(
                self.kernel, backend, self.p, self.path.direction, self.knots, for_each,
                signed=self.signed,
            )  # fmt: skip
            slope = dr.dot(sums.start.gradient, self.path.direction)
            slopes = SlopeRange.around(slope, sums.start.gradient_error)
            enclosures = self.path.proofs.from_restriction(sums, slopes, self.length)
            deficit = self.value - sums.start.value
            inf = real(dr.inf)
            # One side at a time: an infinite gap stands for no level on the other side.
            group_rise_length = longest_free_length(
                enclosures, LevelGaps(inf, gaps.above + deficit, is_one_sided=True)
            )
            group_fall_length = longest_free_length(
                enclosures, LevelGaps(gaps.below - deficit, inf, is_one_sided=True)
            )
            is_above_level = gaps.below > deficit
            return fmin(group_rise_length, rise_length), fmax(
                dr.select(is_above_level, group_fall_length, 0), fall_length
            )

        # Before any group: nothing rises on the whole length, and nothing is kept from falling.
        start = (real(0) + self.length, real(0))
        groups, (rise_length, fall_length) = self.blobs.each_group(
            add_group, start, "steps of groups"
        )
        # A group without a blob in the list has the sum 0 on the whole length. If the level is
        # below 0, the maximum never falls to it.
        zero_is_above_level = (groups < self.blobs.group_count) & (gaps.below > self.value)
        fall_length = dr.select(zero_is_above_level, self.length, fall_length)
        fall_length = dr.select(gaps.below == dr.inf, self.length, fall_length)
        return fmin(dr.select(gaps.above == dr.inf, self.length, rise_length), fall_length)
