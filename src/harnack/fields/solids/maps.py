"""What a map of space is, for solids."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.fields.solids.solid import Solid

AXES = {"x": 0, "y": 1, "z": 2}


class Map(abc.ABC):
    """A map of space, one to one."""

    @abc.abstractmethod
    def of(self, solid: Solid) -> Solid:
        """The image of a solid that is no combination of others."""


def axis_index(axis: str) -> int:
    if axis not in AXES:
        raise ValueError(f'axis must be "x", "y" or "z", not {axis!r}')
    return AXES[axis]
