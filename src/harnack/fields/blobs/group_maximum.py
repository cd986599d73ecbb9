"""The largest of the sums of blobs of several groups: groups do not flow together but meet in
creases.

A group is 0 where none of its blobs is near.
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
    """A list of records in the order of their groups: the records of `entries` from begin to end,
    or those of the table itself if entries is None.

    of: the group of each record.
    count: the number of all groups.
    """

    records: RecordTable
    of: Any
    entries: Any
    begin: Any
    end: Any
    count: Any

    def record(self, i: Any) -> Any:
        """The index, in the table, of the record at position i of the list."""
        if self.entries is None:
            return i
        return dr.gather(self.records.backend.UInt32, self.entries, i)

    def group(self, i: Any) -> Any:
        """The group at position i of the list."""
        kind = self.records.backend.UInt32
        return dr.gather(kind, self.of, self.record(i), i < self.end)

    def each_group(self, body: Any, state: State, label: str) -> tuple[Any, State]:
        """The number of groups in the list, and the state after body(for_each, state) for each
        group.

        for_each: the loop over the blobs of the group.
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
    """The loop over the blobs of the group that begins at a position of the list."""

    def __init__(self, blobs: GroupedList, begin: Any) -> None:
        self._blobs, self._begin = blobs, begin
        self.end: Any = None

    def __call__(self, body: EachBlob, state: State) -> State:
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
    """The largest sum at points p, with its gradient. The errors are the largest errors of all
    groups."""
    real = backend.Float

    def body(for_each: ForEach, state: State) -> State:
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
    groups, final = blobs.each_group(body, start, "groups")
    value, x, y, z, error, gradient_error = final
    is_zero = (groups < blobs.count) & ~(value > 0)  # the largest sum is 0, that of a far group
    gradient = dr.select(is_zero, backend.Array3f(0), backend.Array3f(x, y, z))
    return SumValue(dr.select(is_zero, 0, value), gradient, error, gradient_error)


def group_maximum_jet(term: Term, like: Jet, zero: Real, blobs: GroupedList) -> Jet:
    """The jet of the largest sum, from the list of all blobs."""

    def body(for_each: ForEach, state: State) -> State:
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
    _, final = blobs.each_group(body, start, "groups")
    return jet_from_bounds(like, iter(final[1:]))


@dataclass(frozen=True)
class GroupMaximumEnclosure(Enclosure):
    """An enclosure of the largest sum along the path from p, for a length.

    value: at p.
    knots: the ends of the pieces that the enclosures use.

    Along a path the largest sum reaches a level above as soon as one of the sums does, and falls to
    a level below only when the last of the sums has. So a step upwards is the shortest step of the
    groups, and a step downwards the longest. That is sharper than ranges of the maximum itself,
    which do not use how far each group is from the level (Aydinlilar and Zanni 2023, equation 20,
    take the maximum of two inclusion functions).
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
        """The shortest step upwards of the groups, and the longest downwards: see
        `GroupMaximumEnclosure`. Proof. For a group whose sum is lower by g, the level above is
        farther by g and the level below nearer by g; the error of g is that of both sums, the
        larger of which the tracer has subtracted from the gaps already
        (`samples.value_error_bound`)."""
        backend = self.blobs.records.backend
        real = backend.Float

        def body(for_each: ForEach, state: State) -> State:
            up, down = state
            sums = sum_along(
                self.kernel, backend, self.p, self.path.direction, self.knots, for_each,
                signed=self.signed,
            )  # fmt: skip
            slope = dr.dot(sums.start.gradient, self.path.direction)
            slopes = SlopeRange.around(slope, sums.start.gradient_error)
            enclosures = self.path.proofs.from_restriction(sums, slopes, self.length)
            lower = self.value - sums.start.value
            inf = real(dr.inf)
            rising = longest_free_length(
                enclosures, LevelGaps(inf, gaps.above + lower, is_one_sided=True)
            )
            falling = longest_free_length(
                enclosures, LevelGaps(gaps.below - lower, inf, is_one_sided=True)
            )
            is_clear = gaps.below > lower
            return fmin(rising, up), fmax(dr.select(is_clear, falling, 0), down)

        start = (real(0) + self.length, real(0))
        groups, (up, down) = self.blobs.each_group(body, start, "steps of groups")
        # The sums of far groups stay 0.
        stays_below = (groups < self.blobs.count) & (gaps.below > self.value)
        down = dr.select(stays_below, self.length, down)
        down = dr.select(gaps.below == dr.inf, self.length, down)
        return fmin(dr.select(gaps.above == dr.inf, self.length, up), down)
