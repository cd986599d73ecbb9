"""Functions on surfaces: what their lines and values are asked of."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from harnack.choices import did_you_mean
from harnack.fields import Field, expression

if TYPE_CHECKING:
    from harnack.geometry import Volume

_COORDINATES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "x": lambda x, y, z: x,
    "y": lambda x, y, z: y,
    "z": lambda x, y, z: z,
}
# A surface that is cut by the function's own domain reaches beyond it by rounding, a part of its
# size.
_ROUNDING = 1e-5


def function_of(given: Any, what: str = "of") -> Field:
    """A function on space: a field, "x", "y" or "z", or a Python function of three coordinates.

    Raises:
        TypeError, ValueError: none of these, or a field that is many functions.
    """
    if isinstance(given, str):
        if given not in _COORDINATES:
            raise ValueError(
                f'{what} must be "x", "y" or "z", a field, or a function of x, y and z, not '
                f"{given!r}{did_you_mean(given, _COORDINATES)}"
            )
        return expression(_COORDINATES[given])
    if isinstance(given, Field):
        if given.has_parts:
            raise ValueError(
                f"{what} must be one function on space, and this {type(given).__name__} has one "
                "for each part"
            )
        return given
    if not callable(given):
        raise TypeError(
            f'{what} must be "x", "y" or "z", a field, or a function of x, y and z, not {given!r}'
        )
    return expression(cast("Callable[[Any, Any, Any], Any]", given))


def defined_in(function: Field, size: float) -> Volume | None:
    """Where a function is defined, with room for rounding; None for all of space.

    size: of the surface that it is looked at on.
    """
    if function.domain is None or function.is_entire:
        return None
    return function.domain.padded(_ROUNDING * size)
