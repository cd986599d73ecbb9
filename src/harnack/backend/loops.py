"""Recorded loops whose state is a record with names, and work on only the lanes that need it.

A recorded loop follows the rays of one packet until the last of them has ended, and lanes that are
masked cost as much as the others. Where arrays may be evaluated, outside of any recording,
`compute_on_active` gathers the lanes of a mask, and in `loop_with_queue` a lane that has finished a
ray fetches the next. Both evaluate what they compute, and give what would be computed for each lane
by itself, in any order of lanes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Mask


class LoopState(Protocol):
    """A frozen dataclass of Dr.Jit arrays, such dataclasses, and None where there is nothing."""

    @property
    def active(self) -> Mask:
        """Which lanes go on."""
        ...


State = TypeVar("State", bound=LoopState)


def loop_while_active(state: State, body: Callable[[State], State], label: str) -> State:
    """Runs `body` on the lanes of the state that are active, until none is.

    Errors that the body raises while it is recorded come out as they are.
    """

    def running(*leaves: Any) -> Mask:
        return rebuild_record(state, iter(leaves)).active

    def step(*leaves: Any) -> tuple[Any, ...]:
        return tuple(array_leaves(body(rebuild_record(state, iter(leaves)))))

    try:
        leaves = dr.while_loop(tuple(array_leaves(state)), running, step, label=label)
    except RuntimeError as error:  # Dr.Jit wraps what the body raises
        raise (error.__cause__ or error) from None
    return rebuild_record(state, iter(leaves))


def update_where_active(
    active: Mask, change: Callable[[tuple[Any, ...]], tuple[Any, ...]], state: tuple[Any, ...],
    label: str,
) -> tuple[Any, ...]:  # fmt: skip
    """The state, changed where active: by a loop of at most one trip, so that packets without such
    lanes skip what it costs."""
    index = dr.uint32_array_t(active)

    def step(trip: Any, *state: Any) -> tuple[Any, ...]:
        return trip + 1, *change(state)

    def is_first(trip: Any, *_: Any) -> Mask:
        return active & (trip < 1)

    return dr.while_loop((index(0), *state), is_first, step, label=label)[1:]


def array_leaves(record: Any) -> Iterator[Any]:
    """The arrays of a record of arrays and records, in order; None is left out."""
    for value in _entries(record):
        if dataclasses.is_dataclass(value):
            yield from array_leaves(value)
        elif value is not None:
            yield value


def rebuild_record(like: Any, leaves: Iterator[Any]) -> Any:
    """The leaves as a record like another one."""
    values: list[Any] = []
    for value in _entries(like):
        if dataclasses.is_dataclass(value):
            values.append(rebuild_record(value, leaves))
        else:
            values.append(None if value is None else next(leaves))
    return type(like)(*values)


def _entries(record: Any) -> list[Any]:
    """The values of a record's fields, in order."""
    return [getattr(record, field.name) for field in dataclasses.fields(record)]


# Some lanes.

Lanes = TypeVar("Lanes")
Result = TypeVar("Result")

# Lanes that share a queue: so many for each thread of a processor, and on a GPU in all.
_LANES_PER_THREAD, _LANES_ON_GPU = 1024, 1 << 17


def active_lanes(mask: Mask) -> tuple[Any, int]:
    """Indices of the lanes where a mask is set, and how many these are.

    A single one is named twice: Dr.Jit compiles kernels of their own for arrays of one number.
    """
    rows = dr.compress(mask)
    count = len(rows)
    if count == 1:
        rows = _evaluate_unshared(lambda: dr.full(type(rows), int(rows[0]), 2))
    return rows, count


def broadcast_copy(record: Lanes, width: int, index: Any) -> Lanes:
    """A copy of a record in which all lanes may differ, evaluated. index: the type of lanes."""
    copies = _evaluate_unshared(
        lambda: [_broadcast(leaf, width, index) for leaf in array_leaves(record)]
    )
    return rebuild_record(record, iter(copies))


def gather_record(record: Lanes, rows: Any) -> Lanes:
    """Some lanes of a record. What is the same in all lanes stays one number."""

    def some(leaf: Any) -> Any:
        return leaf if dr.width(leaf) == 1 else dr.gather(type(leaf), leaf, rows)

    return rebuild_record(record, map(some, array_leaves(record)))


def compute_on_active(
    mask: Mask, compute: Callable[[Lanes], Result], lanes: Lanes, inactive_result: Result
) -> Result:
    """What `compute` makes of a record's lanes where `mask` is set, `inactive_result` on the
    others.

    All lanes are evaluated first and last, so that kernels do not depend on how many there are.
    `inactive_result` is a record like the result.
    """
    width = dr.width(mask)
    dr.eval(mask, *array_leaves(lanes), *array_leaves(inactive_result))
    rows, count = active_lanes(mask)
    result = broadcast_copy(inactive_result, width, type(rows))
    if not count:
        _begin_new_scope(rows)
        return result
    targets, values = [*array_leaves(result)], [*array_leaves(compute(gather_record(lanes, rows)))]
    dr.eval(values)
    for target, value in zip(targets, values, strict=True):
        dr.scatter(target, value, rows)
    dr.eval(targets)
    _begin_new_scope(rows)
    return rebuild_record(result, iter(targets))


def loop_with_queue(
    start: State, body: Callable[[State], State], result: Callable[[State], Result], label: str
) -> Result:
    """What `result` makes of each lane after `loop_while_active(start, body, label)`, evaluated.

    Far fewer lanes run the loop than `start` has: one whose ray has ended writes the result and
    fetches the next ray from a queue, so that none waits for the slowest ray of its packet.

    body: must know of its lane by the state alone, and hold nothing that differs between lanes.
    """
    dr.eval(*array_leaves(start))
    width = max(dr.width(leaf) for leaf in array_leaves(start))
    active = dr.full(type(start.active), True, width) & start.active
    rows, count = active_lanes(active)
    done = broadcast_copy(result(start), width, type(rows))
    if count:
        _run_queue(start, body, result, rows, count, [*array_leaves(done)], label)
    _begin_new_scope(rows)
    return done


@dataclass(frozen=True)
class _QueueLane:
    """row: in the queue, of the ray that the lane follows. ray: its state."""

    queue_index: Any
    state: Any

    @property
    def active(self) -> Mask:
        return self.state.active


def _run_queue(
    start: Any, body: Callable[[Any], Any], result: Callable[[Any], Any],
    rows: Any, total: int, done: list[Any], label: str,
) -> None:  # fmt: skip
    """rows: of the `total` rays in `start` that are to be run. done: where their results go."""
    index = cast("Any", type(rows))
    count = dr.opaque(index, total)
    threads = dr.thread_count() if dr.backend_v(rows) == dr.JitBackend.LLVM else 0
    at_once = min(len(rows), _LANES_PER_THREAD * threads or _LANES_ON_GPU)
    taken, first = _evaluate_unshared(
        lambda: [dr.full(index, at_once, 1), dr.arange(index, at_once)]
    )

    def fetched(row: Any, wanted: Mask) -> Any:
        which = dr.gather(index, rows, row, wanted)

        def of_ray(leaf: Any) -> Any:
            return leaf if dr.width(leaf) == 1 else dr.gather(type(leaf), leaf, which, wanted)

        return rebuild_record(start, map(of_ray, array_leaves(start)))

    def one_step(lane: _QueueLane) -> _QueueLane:
        now = body(lane.state)
        ended = lane.active & ~now.active
        which = dr.gather(index, rows, lane.queue_index, ended)
        for target, value in zip(done, array_leaves(result(now)), strict=True):
            dr.scatter(target, value, which, ended)
        row = dr.select(ended, dr.scatter_inc(taken, index(0), ended), lane.queue_index)
        again = ended & (row < count)
        both = zip(array_leaves(fetched(row, again)), array_leaves(now), strict=True)
        return _QueueLane(row, rebuild_record(now, (dr.select(again, *pair) for pair in both)))

    loop_while_active(_QueueLane(first, fetched(first, first < count)), one_step, label)
    dr.eval(done)


def _begin_new_scope(array: Any) -> None:
    """Begin a new scope, as loops do: Dr.Jit looks for equal numbers in one scope only, so that
    what follows would be another kernel where there was nothing to do."""
    dr.detail.new_scope(dr.backend_v(array))


def _evaluate_unshared(make: Callable[[], Any]) -> Any:
    """What is made, evaluated, in memory of its own.

    Dr.Jit keeps equal arrays once, and kernels differ by what they share: those for as many lanes
    as another array has by chance would be compiled anew.
    """
    with dr.scoped_set_flag(dr.JitFlag.ValueNumbering, False):
        made = make()
        dr.make_opaque(made)
    return made


def _broadcast(leaf: Any, width: int, index: Any) -> Any:
    return dr.gather(type(leaf), leaf, dr.arange(index, width) * (dr.width(leaf) > 1))
