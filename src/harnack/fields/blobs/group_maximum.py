"""The largest of the sums of blobs of several groups. Blobs of one group flow together; different
groups meet in creases.

The sum of a group is 0 at points that are outside of the supports of its blobs.
"""

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
    from harnack.fields.blobs.blob_sums import Term
    from harnack.fields.blobs.kernels import BlobKernel
    from harnack.fields.samples import Ray


@dataclass(frozen=True)
class GroupedList:
    """A list of blobs, sorted by groups, for each lane.

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
        """The index in the table of the record at position i of the list."""
        if self.entries is None:
            return i
        return dr.gather(self.records.backend.UInt32, self.entries, i)

    def group(self, i: Any) -> Any:
        """The index of the group of the blob at position i of the list."""
        kind = self.records.backend.UInt32
        return dr.gather(kind, self.group_of_record, self.record(i), i < self.end)

    def each_group(self, body: Any, state: State, label: str) -> tuple[Any, State]:
        """Apply `body` to each group that has a blob in this list of blobs near a lane's point or
        ray, one group after another.

        body: a function; body(for_each, state) returns the state after one more group. It must call
            for_each(add_blob, blob_state) once, which calls `add_blob` for each blob of the group
            and returns the last `blob_state`.
        state: the first state, a tuple of arrays.
        label: the name of the recorded loop.

        Returns the number of groups that have blobs in the list, and the last state.
        """
        kind = self.records.backend.UInt32

        def step(i: Any, groups: Any, *state: Any) -> State:
            group = _OneGroup(self, i)
            final = body(group, state)
            assert group.end is not None, "the body has to go over the blobs of its group"
            return group.end, groups + 1, *final

        def has_more(i: Any, *_: Any) -> Mask:
            return i < self.end

        start = (kind(self.begin), kind(0), *state)
        _, groups, *final = dr.while_loop(start, has_more, step, label=label)
        return groups, tuple(final)


class _OneGroup:
    """The loop over the blobs of one group, for `GroupedList.each_group`.

    begin: the position in the list of the group's first blob.
    end: the position after its last blob, once the loop has run.
    """

    def __init__(self, blobs: GroupedList, begin: Any) -> None:
        self._blobs, self._begin = blobs, begin
        self.end: Any = None

    def __call__(self, body: EachBlob, state: State) -> State:
        """Apply `body` to all blobs of the group, one after another. Returns the last state."""
        blobs = self._blobs
        group = blobs.group(self._begin)

        def step(i: Any, *state: Any) -> State:
            return i + 1, *body(blobs.records.read_record(blobs.record(i)), state)

        def has_more(i: Any, *_: Any) -> Mask:
            return (i < blobs.end) & (blobs.group(i) == group)

        kind = blobs.records.backend.UInt32
        self.end, *final = dr.while_loop(
            (kind(self._begin), *state), has_more, step, label="blobs of a group"
        )
        return tuple(final)


def group_maximum_at(kernel: BlobKernel, backend: Backend, p: Vec3, blobs: GroupedList) -> SumValue:
    """The largest of the groups' sums at points p (3, n), with its gradient. The error bounds are
    the largest ones of all groups.

    blobs: the list of the blobs that may be nonzero at p.
    """
    real = backend.Float

    def add_group(for_each: ForEach, state: State) -> State:
        """The state with another group included. It consists of the largest sum, the three
        components of its gradient, and the largest error bounds of value and gradient."""
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
    is_zero = (groups < blobs.group_count) & ~(
        value > 0
    )  # then the largest sum is the sum of a far group, which is 0
    gradient = dr.select(is_zero, backend.Array3f(0), backend.Array3f(x, y, z))
    return SumValue(dr.select(is_zero, 0, value), gradient, error, gradient_error)


def group_maximum_jet(term: Term, like: Jet, zero: Real, blobs: GroupedList) -> Jet:
    """The jet (ranges of value and derivatives on a piece of a path) of the largest of the groups'
    sums.

    term: a function that returns the jet of a blob from its record.
    like: any jet of the same variables and piece.
    zero: the number 0 on each lane.
    blobs: the list of all blobs.
    """

    def add_group(for_each: ForEach, state: State) -> State:
        """The state with another group included. It consists of a number that is positive before
        the first group, and the bounds of the maximum's jet."""
        jet = sum_jets(term, like, zero, for_each)
        maximum = jet_from_bounds(like, iter(state[1:]))
        new_maximum = maximum.maximum(jet)
        is_first = state[0] > 0  # the first group
        return (
            real(0) + 0 * zero,
            *(dr.select(is_first, a, b) for a, b in zip(
                jet_bounds(jet, zero), jet_bounds(new_maximum, zero), strict=True
            )),
        )  # fmt: skip

    real = cast("Any", type(zero))
    start = (real(1) + 0 * zero, *jet_bounds(like.constant(0.0), zero))
    _, final = blobs.each_group(add_group, start, "groups")
    return jet_from_bounds(like, iter(final[1:]))


@dataclass(frozen=True)
class GroupMaximumEnclosure(Enclosure):
    """An enclosure of the largest of the groups' sums of blobs along a path: it proves lengths of
    the path on which this maximum takes no level.

    kernel: the kernel of the blobs.
    blobs: the blobs that may be nonzero there.
    path: the ray; it gives the direction of the path, and the proofs to use.
    p: the points at which the path starts.
    value: the largest sum at p.
    knots: the ends of the pieces of the path on which derivatives are bounded, as distances from p.
    length: the distance from p up to which the list of blobs is complete.
    signed: whether amplitudes may be negative.

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
        """A length of the path from p that is proved to contain no level. It is the smaller of two
        lengths: the shortest one of any group before its sum rises to the level above, and the
        longest one of any group before its sum falls to the level below.

        gaps: the differences of the largest sum at p from the next levels below and above.

        Proof. Take a group whose sum is lower than the largest by g. For this group the level above
        is farther by g, and the level below is nearer by g. The error of g is that of both sums.
        The larger of these errors has been subtracted from the gaps by the tracer
        (`samples.value_error_bound`).
        """
        backend = self.blobs.records.backend
        real = backend.Float

        def add_group(for_each: ForEach, state: State) -> State:
            """Return the state (up, down) after one more group. A group's sum is the sum of all
            blobs of the group.

            up: the shortest length before the sum of any group rises to the level above. The
                largest sum reaches that level when the first of the sums does.
            down: the longest length before the sum of any group falls to the level below. The
                largest sum falls to that level only when the last of the sums has.
            for_each: the loop over the blobs of the group; for_each(body, state) returns the last
                state.
            """
            up, down = state
            sums = sum_along(
                self.kernel, backend, self.p, self.path.direction, self.knots, for_each,
                signed=self.signed,
            )  # fmt: skip
            slope = dr.dot(sums.start.gradient, self.path.direction)
            slopes = SlopeRange.around(slope, sums.start.gradient_error)
            enclosures = self.path.proofs.from_restriction(sums, slopes, self.length)
            deficit = self.value - sums.start.value
            inf = real(dr.inf)
            rising = longest_free_length(
                enclosures, LevelGaps(inf, gaps.above + deficit, is_one_sided=True)
            )
            falling = longest_free_length(
                enclosures, LevelGaps(gaps.below - deficit, inf, is_one_sided=True)
            )
            is_above_level = gaps.below > deficit
            return fmin(rising, up), fmax(dr.select(is_above_level, falling, 0), down)

        start = (real(0) + self.length, real(0))
        groups, (up, down) = self.blobs.each_group(add_group, start, "steps of groups")
        # The sums of far groups stay 0. If the level is below 0, the maximum never falls to it.
        zero_is_above_level = (groups < self.blobs.group_count) & (gaps.below > self.value)
        down = dr.select(zero_is_above_level, self.length, down)
        down = dr.select(gaps.below == dr.inf, self.length, down)
        return fmin(dr.select(gaps.above == dr.inf, self.length, up), down)
