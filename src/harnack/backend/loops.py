"""Recorded loops whose state is a record with names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

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


def while_active(state: State, body: Callable[[State], State], label: str) -> State:
    """Runs `body` on the lanes of the state that are active, until none is.

    Errors that the body raises while it is recorded come out as they are.
    """

    def running(*leaves: Any) -> Mask:
        return record_of(state, iter(leaves)).active

    def step(*leaves: Any) -> tuple[Any, ...]:
        return tuple(leaves_of(body(record_of(state, iter(leaves)))))

    try:
        leaves = dr.while_loop(tuple(leaves_of(state)), running, step, label=label)
    except RuntimeError as error:  # Dr.Jit wraps what the body raises
        raise (error.__cause__ or error) from None
    return record_of(state, iter(leaves))


def leaves_of(record: Any) -> Iterator[Any]:
    """The arrays of a record of arrays and records, in order; None is left out."""
    for value in _entries(record):
        if dataclasses.is_dataclass(value):
            yield from leaves_of(value)
        elif value is not None:
            yield value


def record_of(like: Any, leaves: Iterator[Any]) -> Any:
    """The leaves as a record like another one."""
    values: list[Any] = []
    for value in _entries(like):
        if dataclasses.is_dataclass(value):
            values.append(record_of(value, leaves))
        else:
            values.append(None if value is None else next(leaves))
    return type(like)(*values)


def _entries(record: Any) -> list[Any]:
    """The values of a record's fields, in order."""
    return [getattr(record, field.name) for field in dataclasses.fields(record)]
