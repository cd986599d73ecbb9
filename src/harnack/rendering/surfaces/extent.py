"""The box that a surface is proved to lie in, which pictures of it need."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Solid

if TYPE_CHECKING:
    from harnack.tracer import LevelSet


class UnboundedSurfaceError(ValueError):
    """A surface without a box around it cannot be drawn.

    reason: what is wrong. usual: a level of the same field whose surface has a box, if known.
    """

    def __init__(self, reason: str, usual: float | None) -> None:
        other = "" if usual is None else f", or choose another level, such as {usual:g}"
        super().__init__(
            f"{reason}: give it a clip, such as clip=harnack.Ball((0, 0, 0), 1){other}"
        )
        self.reason = reason
        self.usual = usual


def box_of(surface: LevelSet) -> FloatArray:
    """Lower and upper corner (2, 3) of a box that holds the surface.

    Raises:
        UnboundedSurfaceError: no finite box is known.
    """
    volume = surface.volume
    ends = None if volume is None else np.array(volume.bounds(), dtype=np.float64)
    if ends is None or not np.isfinite(ends).all():
        raise _unbounded(surface)
    return ends


def _unbounded(surface: LevelSet) -> UnboundedSurfaceError:
    field = surface.field
    levels = surface.numbers
    shown = ", ".join(f"{level:g}" for level in levels)
    reason = f"the surface of level {shown} reaches to infinity, as far as is known"
    if field.period is not None and any(
        abs(math.remainder(level, field.period)) < 1e-6 * field.period for level in levels
    ):
        reason += (
            f" (far away, an angle comes near the multiples of its period, {field.period:g}, "
            "and this is one)"
        )
    if isinstance(field, Solid):
        reason += " (a solid made of a field does not end at that field's domain)"
    usual = field.default_level
    is_other = usual not in levels and field.extent((usual,)) is not None
    return UnboundedSurfaceError(reason, usual if is_other else None)
