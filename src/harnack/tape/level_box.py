"""A box that contains all points at which a formula takes given values, by its ranges on
half-spaces: where the range contains none of them, no such point lies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harnack.tape.pruning import BoxLimits, BoxTapes

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray
    from harnack.tape.recording import Tape

__all__ = ["level_box"]

# Faces are looked for at these powers of two, and then between two of them, so many times halved.
_EXPONENTS, _HALVINGS = range(-16, 24), 5


def level_box(tape: Tape, levels: tuple[float, ...]) -> tuple[FloatArray, FloatArray] | None:
    """The lower and the upper corner (3,) of a box that contains all points at which the formula
    takes one of the levels; None if none is found, as for a surface without an end.

    Proof. Outside of the box, a point lies in one of six half-spaces, on each of which the range of
    the formula contains no level. A part of such a half-space has a smaller range, so that the
    search by halves finds the face that is farthest inside, up to its steps.
    """
    lists = BoxTapes.whole(tape).subset(np.zeros(6, np.int64))
    places = [2.0**k for k in _EXPONENTS]
    # For the faces x >= a, y >= a, z >= a, and -x >= a, -y >= a and -z >= a.
    steps = np.array([*(-place for place in reversed(places)), 0.0, *places])
    first, last = np.full(6, -1), np.full(6, len(steps) - 1)
    if not _have_no_level(lists, steps[last], levels).all():
        return None
    while (last - first > 1).any():
        middle = np.maximum((first + last) // 2, 0)
        is_free = _have_no_level(lists, steps[middle], levels)
        first, last = np.where(is_free, first, middle), np.where(is_free, middle, last)
    inner, outer = steps[np.maximum(first, 0)], steps[last]
    for _ in range(_HALVINGS):
        middle = 0.5 * inner + 0.5 * outer
        is_free = _have_no_level(lists, middle, levels)
        inner, outer = np.where(is_free, inner, middle), np.where(is_free, middle, outer)
    lower, upper = -outer[3:], outer[:3]
    return (lower, upper) if (lower < upper).all() else None


def _have_no_level(lists: BoxTapes, places: FloatArray, levels: tuple[float, ...]) -> BoolArray:
    """Whether the formula is proved to take no level in the half-spaces (6,) beyond their faces.

    lists: the whole tape, for six boxes.
    places: (6,) of the faces: x, y and z are at least, and then their negatives.
    """
    lower, upper = np.full((6, 3), -np.inf), np.full((6, 3), np.inf)
    axes = np.arange(3)
    lower[axes, axes], upper[3 + axes, axes] = places[:3], -places[3:]
    pruned = lists.pruned(lower, upper, BoxLimits.unlimited(6, ()))
    is_free = np.ones(6, np.bool_)
    for level in levels:
        is_free &= (pruned.low > level) | (pruned.high < level)
    return is_free
