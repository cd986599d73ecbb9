"""Scalar functions on surfaces, for isolines and for pictures of values."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from harnack.fields import Field
from harnack.fields.expressions import expression

if TYPE_CHECKING:
    from harnack.geometry import Volume

# A surface that is cut by the function's own domain reaches beyond it by rounding, a part of its
# size.
_PADDING = 1e-5


def function_of(given: Any, what: str = "of") -> Field:
    """A function on space: a field, or what `harnack.expression` takes: a function of three
    coordinates, or a text such as "z".

    Raises:
        TypeError, ValueError: none of these, or a field that is many functions.
    """
    if isinstance(given, str):
        try:
            return expression(given)
        except ValueError as error:
            raise ValueError(f"{what.rstrip(',')}: {error}") from None
    if isinstance(given, Field):
        if given.has_parts:
            raise ValueError(
                f"{what} must be one function on space, and this {type(given).__name__} has one "
                "for each part"
            )
        return given
    if not callable(given):
        raise TypeError(
            f'{what} must be a text such as "z" or "x*y", a field, or a function of x, y and z, '
            f"not {given!r}"
        )
    return expression(cast("Callable[[Any, Any, Any], Any]", given))


def defined_in(function: Field, size: float) -> Volume | None:
    """Where a function is defined, with room for rounding; None for all of space.

    size: of the surface that it is looked at on.
    """
    if function.domain is None or function.is_entire:
        return None
    return function.domain.padded(_PADDING * size)
