"""Recorded loops whose state is a record with named fields, and computations on only the lanes that
need them. A lane is one entry of Dr.Jit's arrays, here a ray. A record is a dataclass whose fields
are arrays with an entry for each lane, or further records; the arrays in it are called its leaves.
A recorded loop becomes part of a kernel, and runs on each lane until that lane is no longer active.

A packet is the group of lanes that a processor computes together. A recorded loop runs until the
last ray of a packet has ended, and lanes whose ray has ended take as much time as all others.
Outside of a recording, where arrays may be evaluated, there are two remedies: `compute_on_active`
gathers the active lanes into shorter arrays, and in `loop_with_queue` a lane whose ray has ended
takes the next ray. Both evaluate their results. The result of a ray does not depend on the other
rays or on their order.
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
    """The state of a loop: a frozen dataclass whose fields are Dr.Jit arrays, further such
    dataclasses, or None. It is also called a record."""

    @property
    def active(self) -> Mask:
        """Mask of the lanes on which the loop continues."""
        ...


State = TypeVar("State", bound=LoopState)


def loop_while_active(state: State, body: Callable[[State], State], label: str) -> State:
    """Run a recorded loop: apply `body` to the state until no lane is active. Returns the final
    state.

    body: returns the next state from a state.
    label: the name of the loop in Dr.Jit's output.

    Errors that the body raises while it is recorded are raised unchanged.
    """

    def is_active(*leaves: Any) -> Mask:
        """Return the mask of lanes on which the loop continues. leaves: the arrays of the state."""
        return rebuild_record(state, iter(leaves)).active

    def run_body(*leaves: Any) -> tuple[Any, ...]:
        """Return the arrays of the next state, from the arrays of the state."""
        return tuple(array_leaves(body(rebuild_record(state, iter(leaves)))))

    try:
        leaves = dr.while_loop(tuple(array_leaves(state)), is_active, run_body, label=label)
    except RuntimeError as error:  # Dr.Jit wraps what the body raises
        raise (error.__cause__ or error) from None
    return rebuild_record(state, iter(leaves))


def update_where_active(
    active: Mask, change: Callable[[tuple[Any, ...]], tuple[Any, ...]], state: tuple[Any, ...],
    label: str,
) -> tuple[Any, ...]:  # fmt: skip
    """Apply `change` to the state on active lanes, and return the new state. `change` is the body
    of a recorded loop of at most one iteration, so that a packet without active lanes skips the
    work.

    active: mask of the lanes on which the state changes; other lanes keep theirs.
    change: returns the new arrays of the state from its arrays.
    label: the name of the loop in Dr.Jit's output.
    """
    uint = dr.uint32_array_t(active)

    def run_once(iteration: Any, *state: Any) -> tuple[Any, ...]:
        """Do the only iteration: count it, and change the state."""
        return iteration + 1, *change(state)

    def is_first(iteration: Any, *_: Any) -> Mask:
        """Return the mask of lanes on which the loop runs its only iteration."""
        return active & (iteration < 1)

    # Without the first entry, the number of iterations.
    return dr.while_loop((uint(0), *state), is_first, run_once, label=label)[1:]


def array_leaves(record: Any) -> Iterator[Any]:
    """Yield the arrays of a record (a dataclass) and of its nested records, in the order of the
    fields. Fields that are None are left out."""
    for value in _entries(record):
        if dataclasses.is_dataclass(value):
            yield from array_leaves(value)
        elif value is not None:
            yield value


def rebuild_record(like: Any, leaves: Iterator[Any]) -> Any:
    """Return a record of the same type and structure as `like`, with other arrays. leaves: the
    arrays, in the order of `array_leaves`."""
    values: list[Any] = []
    for value in _entries(like):
        if dataclasses.is_dataclass(value):
            values.append(rebuild_record(value, leaves))
        else:
            values.append(None if value is None else next(leaves))
    return type(like)(*values)


def _entries(record: Any) -> list[Any]:
    """Return the values of a record's fields, in order."""
    return [getattr(record, field.name) for field in dataclasses.fields(record)]


# Work on a subset of the lanes.

Lanes = TypeVar("Lanes")
Result = TypeVar("Result")

# Number of lanes that share a queue: for each thread of a processor, and in all on a GPU.
_LANES_PER_THREAD, _LANES_ON_GPU = 1024, 1 << 17


def active_lanes(mask: Mask) -> tuple[Any, int]:
    """Return the indices of the lanes where the mask is set, as a Dr.Jit array, and their number.

    If there is only one such lane, its index is listed twice: Dr.Jit compiles separate kernels for
    arrays of length 1.
    """
    lane_indices = dr.compress(mask)
    count = len(lane_indices)
    if count == 1:
        lane_indices = _evaluate_in_own_memory(
            lambda: dr.full(type(lane_indices), int(lane_indices[0]), 2)
        )
    return lane_indices, count


def broadcast_copy(record: Lanes, width: int, index: Any) -> Lanes:
    """Return an evaluated copy of a record in which every array has `width` lanes; an array of a
    single lane is repeated. index: the Dr.Jit type of lane indices."""
    copies = _evaluate_in_own_memory(
        lambda: [_broadcast(leaf, width, index) for leaf in array_leaves(record)]
    )
    return rebuild_record(record, iter(copies))


def gather_record(record: Lanes, rows: Any) -> Lanes:
    """Return the record with only some of its lanes. An array of width 1, which all lanes share,
    stays as it is. rows: the indices of the lanes."""

    def gather(leaf: Any) -> Any:
        """Return one array of the record, with only these lanes."""
        return leaf if dr.width(leaf) == 1 else dr.gather(type(leaf), leaf, rows)

    return rebuild_record(record, map(gather, array_leaves(record)))


def compute_on_active(
    mask: Mask, compute: Callable[[Lanes], Result], lanes: Lanes, inactive_result: Result
) -> Result:
    """Run `compute` on the lanes where `mask` is set, and use `inactive_result` on all other lanes.
    Returns the results of all lanes.

    The active lanes are gathered into shorter arrays, and the results are scattered back. Inputs
    and results are evaluated, so that kernels do not depend on the number of active lanes.

    compute: returns a record from the record of inputs; each lane's result must not depend on other
        lanes.
    lanes: the record of inputs.
    inactive_result: a record with the structure of the result.
    """
    width = dr.width(mask)
    dr.eval(mask, *array_leaves(lanes), *array_leaves(inactive_result))
    lane_indices, active_count = active_lanes(mask)
    result = broadcast_copy(inactive_result, width, type(lane_indices))
    if not active_count:
        _begin_new_scope(lane_indices)  # as the computation would have done
        return result
    # The results of the active lanes replace the inactive ones in place.
    targets, values = (
        [*array_leaves(result)],
        [*array_leaves(compute(gather_record(lanes, lane_indices)))],
    )
    dr.eval(values)
    for target, value in zip(targets, values, strict=True):
        dr.scatter(target, value, lane_indices)
    dr.eval(targets)
    _begin_new_scope(lane_indices)
    return rebuild_record(result, iter(targets))


def loop_with_queue(
    start: State, body: Callable[[State], State], result: Callable[[State], Result], label: str
) -> Result:
    """Run the loop `loop_while_active(start, body, label)` for many rays with few lanes. Returns
    `result` of the final states, evaluated.

    Only a fixed number of lanes run at a time, far fewer than `start` has. A lane whose ray has
    ended stores its result and takes the next ray from a queue, so that no lane waits for the
    slowest ray of its packet.

    start: the initial states of all rays.
    body: returns the next state of each lane from its state. It may depend on the state of that
        lane only, and must use no other array that differs between lanes.
    result: returns the result, a record, from a final state.
    label: the name of the loop in Dr.Jit's output.
    """
    dr.eval(*array_leaves(start))
    width = max(dr.width(leaf) for leaf in array_leaves(start))
    # A mask with an entry for each ray.
    active = dr.full(type(start.active), True, width) & start.active
    ray_indices, ray_count = active_lanes(active)
    # Rays that are not active from the start have the results of their initial states.
    results = broadcast_copy(result(start), width, type(ray_indices))
    if ray_count:
        _run_queue(start, body, result, ray_indices, ray_count, [*array_leaves(results)], label)
    _begin_new_scope(ray_indices)
    return results


@dataclass(frozen=True)
class _QueueLane:
    """The state of the lanes that process the queue of rays, which lists the rays still to be
    traced.

    queue_index: for each lane, the position in the queue of the ray that it follows now.
    state: for each lane, the loop state of that ray.
    """

    queue_index: Any
    state: Any

    @property
    def active(self) -> Mask:
        """Mask of the lanes that follow a ray."""
        return self.state.active


def _run_queue(
    start: Any, body: Callable[[Any], Any], result: Callable[[Any], Any],
    ray_indices: Any, ray_count: int, results: list[Any], label: str,
) -> None:  # fmt: skip
    """Run the loop of `loop_with_queue`, with the same start, body and result.

    ray_indices: the indices in `start` of the rays in the queue.
    ray_count: the number of these rays; `ray_indices` may be longer.
    results: the arrays, one entry per ray, into which the results are written.
    label: the name of the loop in Dr.Jit's output.
    """
    index_type = cast("Any", type(ray_indices))
    opaque_ray_count = dr.opaque(index_type, ray_count)
    # The number of lanes is fixed by the device, and not by the number of rays, unless there are
    # fewer rays. (On a GPU, `threads` is 0.)
    threads = dr.thread_count() if dr.backend_v(ray_indices) == dr.JitBackend.LLVM else 0
    width = min(len(ray_indices), _LANES_PER_THREAD * threads or _LANES_ON_GPU)
    # The first rays of the queue have lanes already; the next position is the number of lanes.
    next_position, first_indices = _evaluate_in_own_memory(
        lambda: [dr.full(index_type, width, 1), dr.arange(index_type, width)]
    )

    def fetch_rays(queue_index: Any, mask: Mask) -> Any:
        """Return the initial states of the rays at the positions `queue_index` of the queue, for
        the lanes of `mask`."""
        # The queue, `ray_indices`, holds indices of rays, and `start` the initial states of all.
        ray_ids = dr.gather(index_type, ray_indices, queue_index, mask)

        def gather(leaf: Any) -> Any:
            """Return one array of the initial states, at these rays."""
            return leaf if dr.width(leaf) == 1 else dr.gather(type(leaf), leaf, ray_ids, mask)

        return rebuild_record(start, map(gather, array_leaves(start)))

    def step_lanes(lane: _QueueLane) -> _QueueLane:
        """Apply the body to the rays of all lanes. In each lane whose ray ends, store the result
        and take the next ray of the queue.

        `next_position`, of the enclosing function, is a counter in memory: the next position in the
        queue. `scatter_inc` adds 1 to it for each such lane and returns the number before, so each
        lane gets a position of its own.
        """
        new_state = body(lane.state)
        is_ended = lane.active & ~new_state.active
        # Results are written at the index of the ray, whatever its lane was.
        ray_ids = dr.gather(index_type, ray_indices, lane.queue_index, is_ended)
        for target, value in zip(results, array_leaves(result(new_state)), strict=True):
            dr.scatter(target, value, ray_ids, is_ended)
        # 0 is the index of the counter, an array of one entry.
        queue_index = dr.select(
            is_ended, dr.scatter_inc(next_position, index_type(0), is_ended), lane.queue_index
        )
        # At the end of the queue, a lane takes no further ray, and stays inactive.
        is_fetching = is_ended & (queue_index < opaque_ray_count)
        fetched_and_new = zip(
            array_leaves(fetch_rays(queue_index, is_fetching)), array_leaves(new_state), strict=True
        )
        return _QueueLane(
            queue_index,
            rebuild_record(
                new_state, (dr.select(is_fetching, *states) for states in fetched_and_new)
            ),
        )

    loop_while_active(
        _QueueLane(first_indices, fetch_rays(first_indices, first_indices < opaque_ray_count)),
        step_lanes,
        label,
    )
    dr.eval(results)


def _begin_new_scope(array: Any) -> None:
    """Begin a new Dr.Jit scope, as a recorded loop does. Dr.Jit merges equal expressions within a
    scope only. So without this call, the code that follows would compile to another kernel if the
    loop was skipped. array: any array of the backend on which the scope begins."""
    dr.detail.new_scope(dr.backend_v(array))


def _evaluate_in_own_memory(compute: Callable[[], Any]) -> Any:
    """Evaluate the arrays that `compute` returns, each in memory of its own, and return them.

    Normally Dr.Jit stores equal arrays once, and a kernel depends on which of its inputs are the
    same array. Two arrays that are equal by accident, such as index arrays of the same length,
    would therefore compile another kernel.
    """
    with dr.scoped_set_flag(dr.JitFlag.ValueNumbering, False):
        arrays = compute()
        dr.make_opaque(arrays)
    return arrays


def _broadcast(leaf: Any, width: int, index: Any) -> Any:
    """Return a copy of the array `leaf` with `width` lanes; an array of a single lane is repeated.
    index: the Dr.Jit type of lane indices."""
    # All indices are 0 for an array of a single lane.
    return dr.gather(type(leaf), leaf, dr.arange(index, width) * (dr.width(leaf) > 1))
