"""Checks values of a scene file against the type annotations of the function or class that they are
passed to, so that errors appear on reading and not on drawing. Lists of the file have become
tuples."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import numpy as np

from harnack.fields import Field
from harnack.geometry import Volume
from harnack.name_suggestions import with_article

__all__ = ["ValueTypeError", "check_types"]

# Names that modules import for type checkers alone.
_NAMES = {"Volume": Volume, "Field": Field}
_WORDS: dict[Any, str] = {
    bool: "true or false", int: "a whole number", float: "a number", str: "a text",
    type(None): "null",
}  # fmt: skip


class ValueTypeError(TypeError):
    """The error for an argument that does not have the type of its annotation."""


def check_types(function: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Check the arguments of a class or a function against its type annotations.

    arguments: values by name; lists have become tuples. A tuple may also stand for an array; the
        function itself checks the numbers of arrays.

    Raises:
        ValueTypeError: the message names the argument, and the required type.
    """
    target = function.__init__ if isinstance(function, type) else function
    hints = typing.get_type_hints(target, localns=_NAMES)
    for name, value in arguments.items():
        if name in hints and not _fits(value, hints[name]):
            raise ValueTypeError(f"{name} must be {_type_in_words(hints[name])}, not {value!r:.60}")


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value, in which lists have become tuples, can be passed where `hint` is the
    type annotation."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or origin is np.ndarray:
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, member) for member in arguments)
    if origin is typing.Literal:
        return value in arguments
    # An int may stand for a float, but a bool for neither.
    if hint is float or hint is int:
        return isinstance(value, int if hint is int else int | float) and type(value) is not bool
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, dict)
    # A tuple of a fixed length, with a type for each entry.
    if origin is tuple and arguments[-1] is not Ellipsis:
        entries = cast("tuple[Any, ...]", value if isinstance(value, tuple) else ())
        return len(entries) == len(arguments) and all(map(_fits, entries, arguments))
    # A tuple or other sequence of any length, with one type for all entries.
    if origin is tuple or (isinstance(origin, type) and issubclass(origin, Iterable)):
        is_list = isinstance(value, tuple)
        return is_list and all(_fits(part, arguments[0]) for part in cast("tuple[Any, ...]", value))
    # Annotations of other kinds are not checked.
    return origin is not None or not isinstance(hint, type) or isinstance(value, hint)


def _type_in_words(hint: Any) -> str:
    """Return a type annotation in words, such as "a list of 3 entries, each a number", for people
    who write scene files."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_type_in_words, arguments))
    if origin is typing.Literal:
        return " or ".join(map(repr, arguments))
    if arguments:
        kinds = dict.fromkeys(_type_in_words(kind) for kind in arguments if kind is not Ellipsis)
        count = (
            "" if origin is not tuple or Ellipsis in arguments else f"{len(arguments)} entries, "
        )
        return f"a list of {count}each {' or '.join(kinds)}"
    return _WORDS.get(hint, with_article(getattr(hint, "__name__", str(hint))))
