"""Sums of terms over pairs of a point and a record, f(x) = sum_j term(x, r_j), as operations that
Dr.Jit differentiates by points and records in forward and reverse mode. A record holds the numbers
of one source, such as the two ends of an edge, or the position and the moment of a dipole.

Dr.Jit cannot run a recorded loop backwards, and with a lane for each pair, memory would grow with
the number of pairs. Here each derivative is a sum over pairs again, and another recorded loop adds
it up. With G_i the derivative of a later result by the value f(x_i),

    by the point x_i:    sum_j (d term/dx)(x_i, r_j)^T G_i,    a loop over records for each point,
    by the record r_j:   sum_i (d term/dr)(x_i, r_j)^T G_i,    a loop over points for each record.

Dr.Jit differentiates the term itself, within an iteration. Nothing is scattered in the second loop.
As there may be few records, each one has several lanes, which share the points and whose sums are
added up at the end. A sum may also be over a *range* of records of its own for each point, such as
the edges of the face that a ray hit; then derivatives by records are scattered in the first loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

Term: TypeAlias = "Callable[[Vec3, tuple[Real, ...]], tuple[Real, ...]]"
"""A function that takes a point (3,) and the numbers of a record, and returns the numbers that are
added up."""

# The number of lanes of loops over points, at least one for each record.
_RECORD_LANES = 65_536


def pair_sum(
    backend: Backend,
    term: Term,
    x: Vec3,
    records: tuple[Any, ...],
    ranges: tuple[Any, Any] | None = None,
) -> tuple[Real, ...]:
    """The sums (n,) of each of the numbers that `term` returns, over all records, at n points x,
    with derivatives by x and by records.

    term: a function of a point and a record; it may use kernel parameters, but no numbers with
        derivatives.
    x: (3, n).
    records: the numbers of m records, as arrays (m,), or of one entry that all records share.
    ranges: the indices of the first record of each point, and the numbers of its records, both
        (n,); None to sum over all records.
    """
    records = tuple(map(backend.Float, records))
    wanted = dr.grad_enabled(x), dr.grad_enabled(records)
    return dr.custom(_PairSum, backend, term, backend.Array3f(x), records, ranges, wanted)


class _PairSum(dr.CustomOp):
    """The operation of `pair_sum`."""

    def eval(
        self,
        backend: Backend,
        term: Term,
        x: Vec3,
        records: tuple[Any, ...],
        ranges: tuple[Any, Any] | None,
        wanted: tuple[bool, bool],
    ) -> tuple[Real, ...]:
        """The sums. wanted: whether x and the records have derivatives."""
        self._backend, self._term, self._wanted = backend, term, wanted
        self._x = tuple(map(_Column, x))
        self._records = tuple(map(_Column, records))
        self._point_count = dr.width(x)
        self._record_count = max(map(len, self._records))
        dr.eval(x, records, ranges)  # loops read them from memory
        index_type = backend.UInt32
        # Counts are kernel parameters, so that other numbers compile no other kernels.
        self._all_records = dr.opaque(index_type, self._record_count)
        self._all_points = dr.opaque(index_type, self._point_count)
        self._first, self._last = index_type(0), self._all_records
        if ranges is not None:
            first, count = map(index_type, ranges)
            self._first, self._last = first, first + count
        self._has_ranges = ranges is not None
        with dr.suspend_grad():
            self._count = self._term_count()
            zeros = (dr.zeros(backend.Float, self._point_count),) * self._count

            def add(j: Any, x: Vec3, record: tuple[Any, ...], sums: tuple[Any, ...]) -> Any:
                """Add the terms of record j."""
                del j
                return tuple(s + t for s, t in zip(sums, term(x, record), strict=True))

            return self._over_records(add, zeros, "pair sum")

    def forward(self) -> None:
        """The derivatives of the sums along a motion of points and records."""
        backend, count = self._backend, self._point_count
        x_motion = tuple(map(_Column, self.grad_in("x")))
        motions = tuple(map(_Column, self.grad_in("records")))
        dr.eval([column.numbers for column in (*x_motion, *motions)])
        lane = dr.arange(backend.UInt32, count)
        along = [column.at(lane) for column in x_motion]
        zeros = (dr.zeros(backend.Float, count),) * self._count

        def add(j: Any, x: Vec3, record: tuple[Any, ...], sums: tuple[Any, ...]) -> Any:
            """Add the change of the terms of record j."""
            with dr.resume_grad():
                moved, numbers = _attached(x), [_attached(number) for number in record]
                terms = self._term(moved, tuple(numbers))
                dr.set_grad(moved, backend.Array3f(*along))
                for number, motion in zip(numbers, motions, strict=True):
                    dr.set_grad(number, motion.at(j))
                dr.forward_to(*terms)
                changes = [dr.grad(entry) for entry in terms]
            return tuple(s + c for s, c in zip(sums, changes, strict=True))

        with dr.suspend_grad():
            changes = self._over_records(add, zeros, "pair sum forward")
        self.set_grad_out(changes)

    def backward(self) -> None:
        """The derivatives by points and records of a result, from those by the sums."""
        weights = tuple(map(_Column, self.grad_out()))
        dr.eval([column.numbers for column in weights])
        with dr.suspend_grad():
            if self._has_ranges:
                by_point, by_record = self._backward_by_ranges(weights)
            else:
                by_point = self._backward_by_points(weights) if self._wanted[0] else None
                by_record = self._backward_by_records(weights) if self._wanted[1] else None
        if by_point is not None and self._wanted[0]:
            self.set_grad_in("x", by_point)
        if by_record is not None and self._wanted[1]:
            self.set_grad_in("records", by_record)

    def _backward_by_points(self, weights: tuple[_Column, ...]) -> Vec3:
        """The derivatives (3, n) by the points. weights: those by the sums."""
        lane = dr.arange(self._backend.UInt32, self._point_count)
        own = tuple(column.at(lane) for column in weights)

        def add(j: Any, x: Vec3, record: tuple[Any, ...], sums: tuple[Any, ...]) -> Any:
            """Add the derivative of the terms of record j."""
            del j
            change, _ = self._pulled_back(x, record, own, (True, False))
            return (sums[0] + change,)

        zeros = dr.zeros(self._backend.Array3f, self._point_count)
        return self._over_records(add, (zeros,), "pair sum by points")[0]

    def _backward_by_records(self, weights: tuple[_Column, ...]) -> tuple[Real, ...]:
        """The derivatives by the numbers of the records. weights: those by the sums."""
        backend = self._backend
        # Lane `record * share + part` adds up the points part, part + share, ...
        share = max(1, min(self._point_count, _RECORD_LANES // self._record_count))
        step = dr.opaque(backend.UInt32, share)
        lane = dr.arange(backend.UInt32, self._record_count * share)
        record_index = lane // step
        record = tuple(column.at(record_index) for column in self._records)

        def add(i: Any, *sums: Real) -> Any:
            """Add the derivative of the terms of point i."""
            x = backend.Array3f(*(column.at(i) for column in self._x))
            own = tuple(column.at(i) for column in weights)
            _, change = self._pulled_back(x, record, own, (False, True))
            return i + step, *(s + c for s, c in zip(sums, change, strict=True))

        zeros = (dr.zeros(backend.Float, self._record_count * share),) * len(record)
        start = (lane - record_index * step, *zeros)

        def is_left(i: Any, *_: Any) -> Mask:
            """Whether there is a point i."""
            return i < self._all_points

        sums = dr.while_loop(start, is_left, add, label="pair sum by records")[1:]
        dr.eval(sums)
        return tuple(dr.block_sum(entry, share) for entry in sums)

    def _backward_by_ranges(self, weights: tuple[_Column, ...]) -> tuple[Vec3, tuple[Real, ...]]:
        """The derivatives by the points and by the records, where each point has records of its
        own. weights: those by the sums."""
        backend = self._backend
        lane = dr.arange(backend.UInt32, self._point_count)
        own = tuple(column.at(lane) for column in weights)
        by_record = tuple(dr.zeros(backend.Float, self._record_count) for _ in self._records)
        dr.eval(by_record)

        def add(j: Any, x: Vec3, record: tuple[Any, ...], sums: tuple[Any, ...]) -> Any:
            """Add the derivatives of the terms of record j."""
            change, changes = self._pulled_back(x, record, own, (True, True))
            for total, number in zip(by_record, changes, strict=True):
                dr.scatter_add(total, number, j)
            return (sums[0] + change,)

        zeros = dr.zeros(backend.Array3f, self._point_count)
        by_point = self._over_records(add, (zeros,), "pair sum by ranges")[0]
        dr.eval(by_point, by_record)
        return by_point, by_record

    def _pulled_back(
        self, x: Vec3, record: tuple[Any, ...], weights: tuple[Any, ...], wanted: tuple[bool, bool]
    ) -> tuple[Vec3, tuple[Real, ...]]:
        """The derivatives of the weighted sum of the terms of one pair, by the point and by the
        numbers of the record.

        wanted: which of the two are computed; the other one is 0.

        Where all weights are 0, as for rays without a hit, the derivatives are 0, even if the term
        has none there.
        """
        is_used = self._backend.Bool(False)
        for weight in weights:
            is_used |= weight != 0
        with dr.resume_grad():
            moved = _attached(x) if wanted[0] else x
            numbers = tuple(map(_attached, record)) if wanted[1] else record
            terms = self._term(moved, numbers)
            total = sum(
                (w * t for w, t in zip(weights, terms, strict=True)), self._backend.Float(0)
            )
            dr.backward_from(total, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            by_point = dr.grad(moved) if wanted[0] else 0 * x
            by_record = [dr.grad(entry) if wanted[1] else 0 * entry for entry in numbers]
        return (
            dr.select(is_used, by_point, 0),
            tuple(dr.select(is_used, number, 0) for number in by_record),
        )

    def _term_count(self) -> int:
        """How many numbers the term returns."""
        number = self._backend.Float(1)
        return len(self._term(self._backend.Array3f(1), (number,) * len(self._records)))

    def _over_records(self, add: Any, state: tuple[Any, ...], label: str) -> tuple[Any, ...]:
        """Run a loop over the records of each point, and return the final state.

        add: returns the next state from the index of a record, the point, the numbers of the
            record, and the state.
        state: the first state, a tuple.
        label: the name of the loop in Dr.Jit's output.
        """
        backend = self._backend
        lane = dr.arange(backend.UInt32, self._point_count)
        x = backend.Array3f(*(column.at(lane) for column in self._x))

        def read_and_add(j: Any, *state: Any) -> tuple[Any, ...]:
            """Apply `add` to record j. Returns the next index and the next state."""
            record = tuple(column.at(j) for column in self._records)
            return j + 1, *add(j, x, record, state)

        start = (self._first + dr.zeros(backend.UInt32, self._point_count), *state)

        def is_left(j: Any, *_: Any) -> Mask:
            """Whether record j is still to be added."""
            return j < self._last

        return dr.while_loop(start, is_left, read_and_add, label=label)[1:]


class _Column:
    """One number of all points or records. numbers: an array, or a single entry for all."""

    def __init__(self, numbers: Any) -> None:
        self.numbers = numbers

    def __len__(self) -> int:
        return dr.width(self.numbers)

    def at(self, index: Any) -> Real:
        """The numbers at these indices."""
        if len(self) == 1:
            return self.numbers
        return dr.gather(type(self.numbers), self.numbers, index)


def _attached(value: Any) -> Any:
    """A copy of a number or vector with derivatives enabled."""
    copy = type(value)(value)
    dr.enable_grad(copy)
    return copy
