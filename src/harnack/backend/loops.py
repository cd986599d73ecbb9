"""Recorded loops whose state is a record with names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Mask


class LoopState(Protocol):
    """A frozen dataclass of Dr.Jit arrays, or of such dataclasses."""

    @property
    def active(self) -> Mask:
        """Which lanes go on."""
        ...


State = TypeVar("State", bound=LoopState)


def while_active(state: State, body: Callable[[State], State], label: str) -> State:
    """Runs `body` on the lanes of the state that are active, until none is.

    Errors that the body raises while it is recorded come out as they are.
    """

    def running(*leaves: Any) -> Mask:
        return _record(state, iter(leaves)).active

    def step(*leaves: Any) -> tuple[Any, ...]:
        return tuple(_leaves(body(_record(state, iter(leaves)))))

    try:
        leaves = dr.while_loop(tuple(_leaves(state)), running, step, label=label)
    except RuntimeError as error:  # Dr.Jit wraps what the body raises
        raise (error.__cause__ or error) from None
    return _record(state, iter(leaves))


def _leaves(record: Any) -> Iterator[Any]:
    for value in vars(record).values():
        if dataclasses.is_dataclass(value):
            yield from _leaves(value)
        else:
            yield value


def _record(like: State, leaves: Iterator[Any]) -> State:
    """The leaves as a record like another one."""
    given: dict[str, Any] = vars(like)
    values = [
        _record(value, leaves) if dataclasses.is_dataclass(value) else next(leaves)
        for value in given.values()
    ]
    return cast("Any", type(like))(*values)
