"""The boxes of a field's parts on a backend (see `harnack.fields.parts`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.fields.parts import PartEntry
from harnack.fields.unit_coordinates import UnitCoordinates, placed, single
from harnack.tree.boxes import BoxTree

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3

__all__ = ["BoxedParts"]


@dataclass(frozen=True)
class BoxedParts(UnitCoordinates):
    """A tree of boxes, one for each part, in coordinates in which they have a size of about one."""

    tree: BoxTree

    @classmethod
    def upload(cls, backend: Backend, lower: FloatArray, upper: FloatArray) -> BoxedParts:
        """Boxes from their corners (n, 3).

        The size is a power of two, so that places along rays are scaled without rounding, and keep
        their order.
        """
        low, high = lower.min(axis=0), upper.max(axis=0)
        centre = single(0.5 * (low + high))
        size = 2.0 ** math.ceil(math.log2(np.abs(np.stack([low, high]) - centre).max()))
        tree = BoxTree.of(backend, (lower - centre) / size, (upper - centre) / size)
        return cls(*placed(backend, centre, size), tree)

    def next(
        self, o: Vec3, d: Vec3, after: PartEntry, start: Real, end: Real, active: Mask
    ) -> PartEntry:
        """As `Field.next_part`."""
        behind = after.enter / self.size, after.part
        enter, leave, box = self.tree.next(
            self.unit(o), d, behind, start / self.size, end / self.size, active
        )
        return PartEntry(enter * self.size, leave * self.size, box)
