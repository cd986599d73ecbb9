"""Boxes around level sets, carved by what a field promises in the middle of their cells."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import Curvature
from harnack.geometry import Box

if TYPE_CHECKING:
    from harnack.fields.field import Field

# Cells that are split at most, and how often.
_MOST_CELLS, _FINEST = 4096, 5


def carved_box(
    field: Field, lower: FloatArray, upper: FloatArray, levels: tuple[float, ...]
) -> Box:
    """A box around the level sets of a field of dipoles, given one (3,), (3,) that holds them.

    Cells with no level in them are cut away: those in a ball around the middle of the cell on which
    a curvature promise keeps f from the levels.
    """
    lower, upper = _bounds_of_cells(field, lower, upper, levels)
    slack = 1e-4 * float((upper - lower).max())
    return Box(_point(lower - slack), _point(upper + slack))


def _bounds_of_cells(
    field: Field, lower: FloatArray, upper: FloatArray, levels: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """The bounds of the cells of a box that are not proved empty."""
    field = field.prepare(choose_backend("double"))
    corner, size = lower[None], upper - lower
    halves = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    for _ in range(_FINEST):
        if 8 * len(corner) > _MOST_CELLS:
            break
        size = 0.5 * size
        split = (corner[:, None] + halves * size).reshape(-1, 3)
        kept = split[~_without_level(field, split + 0.5 * size, size, levels)]
        if not len(kept):
            return lower, upper  # no level anywhere: any box will do
        corner = kept
    return corner.min(axis=0), corner.max(axis=0) + size


def _without_level(
    field: Field, centres: FloatArray, size: FloatArray, levels: tuple[float, ...]
) -> npt.NDArray[np.bool_]:
    sample = field.evaluate(to_vector3(choose_backend("double"), centres, "centres"))
    h = 0.5 * float(np.linalg.norm(size))
    value, error = to_numpy(sample.value), to_numpy(sample.error)
    away = np.min([np.abs(value - level) for level in levels], axis=0) - error
    slope = np.linalg.norm(to_numpy(sample.gradient), axis=1) + to_numpy(sample.gradient_error)
    empty = np.zeros(len(centres), np.bool_)
    for one in sample.known:
        if isinstance(one, Curvature):
            moved = h * (slope + 0.5 * h * to_numpy(one.constant))
            empty |= (to_numpy(one.radius) > h) & (moved < away)
    return empty


def _point(row: FloatArray) -> tuple[float, float, float]:
    x, y, z = row.tolist()
    return x, y, z
