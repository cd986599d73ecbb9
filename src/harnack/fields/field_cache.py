"""What is computed or uploaded once for a field, and kept as long as the field is."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast
from weakref import finalize

from harnack.fields.field import Field

if TYPE_CHECKING:
    from harnack.backend import Backend

Prepare = TypeVar("Prepare", bound=Callable[..., Field])
Value = TypeVar("Value")


class FieldCache(Generic[Value]):
    """One value for each field, the one that was asked for last. It goes when the field goes.

    A value must not hold its field, or neither would ever go; the field itself is not kept.
    """

    def __init__(self) -> None:
        # By identity: fields that anyone writes may be equal to others, or have no hash.
        self._kept: dict[int, tuple[Any, dict[str, Any], Value]] = {}

    def get(self, field: Field, key: Any, make: Callable[[], Value]) -> Value:
        """The value of a field under a key, from `make` where another key was asked for last.

        It is made anew if an attribute of the field has been set since.
        """
        if id(field) in self._kept:
            kept_key, attributes, value = self._kept[id(field)]
            now = vars(field)
            same = attributes.keys() == now.keys()
            if same and kept_key == key and all(attributes[name] is now[name] for name in now):
                return value
        value = make()
        if value is not field:
            if id(field) not in self._kept:
                finalize(field, self._kept.pop, id(field), None).atexit = False
            self._kept[id(field)] = key, {**vars(field)}, value
        return value


def prepared_once(prepare: Prepare) -> Prepare:
    """A field's method `prepare` that uploads the field to each backend only once.

    Fields with parameters are uploaded each time: a parameter may change in place, and its
    derivatives belong to one trace.
    """
    kept: defaultdict[Backend, FieldCache[Field]] = defaultdict(FieldCache)

    @functools.wraps(prepare)
    def once(self: Field, backend: Backend) -> Field:
        if self.parameters():
            return prepare(self, backend)
        return kept[backend].get(self, None, lambda: prepare(self, backend))

    return cast("Prepare", once)
