"""Checks of the numbers that shapes are made of."""

from __future__ import annotations

import math
import operator
from typing import Any

from harnack.geometry import Ball, Box, Volume

Point = tuple[float, float, float]

# Extents are widened by this part of the coordinates: numbers of a shape are rounded to the
# precision in which it is traced.
_ROUNDED = 1e-6


def positive(value: Any, name: str) -> float:
    """A positive finite number.

    Raises:
        ValueError: it is another one.
    """
    number = finite(value, name)
    if not number > 0.0:
        raise ValueError(f"{name} must be positive, not {value!r}")
    return number


def finite(value: Any, name: str) -> float:
    """A finite number.

    Raises:
        ValueError: it is none.
    """
    try:
        number = float("none" if isinstance(value, str) else value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, not {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, not {value!r}")
    return number


def whole(value: Any, name: str, least: int, most: int) -> int:
    """An integer from `least` to `most`.

    Raises:
        ValueError: it is none.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if not least <= number <= most:
        end = f"2^{n} - 1" if (n := most.bit_length()) >= 32 else str(most)
        raise ValueError(f"{name} must be an integer from {least} to {end}, not {value!r}")
    return number


def triple(value: Any, name: str, *, all_positive: bool = False) -> Point:
    """Three finite numbers.

    Raises:
        ValueError: they are not.
    """
    try:
        entries = tuple(value)
    except TypeError:
        raise ValueError(f"{name} must be three numbers, not {value!r}") from None
    if len(entries) != 3:
        raise ValueError(f"{name} must be three numbers, not {len(entries)}: {value!r}")
    check = positive if all_positive else finite
    x, y, z = (check(one, f"each of {name}") for one in entries)
    return x, y, z


def box_around(half: tuple[float, float, float], center: Any = (0.0, 0.0, 0.0)) -> Volume:
    """The box of the half sides given; one with no side >= 0 holds no surface."""
    sizes = [max(h, 0.0) + _ROUNDED * (abs(h) + abs(c)) for h, c in zip(half, center, strict=True)]
    lower = [c - s for c, s in zip(center, sizes, strict=True)]
    upper = [c + s for c, s in zip(center, sizes, strict=True)]
    return Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]))


def ball_around(center: tuple[float, float, float], radius: float) -> Volume:
    """The ball of the radius given; where that is not positive, one that holds no surface."""
    slack = _ROUNDED * (abs(radius) + sum(abs(c) for c in center)) + 1e-30
    return Ball(center, max(radius, 0.0) + slack)


def set_checked(shape: Any, name: str, value: Any) -> None:
    """Puts a number that was checked in the place of the one given."""
    object.__setattr__(shape, name, value)
