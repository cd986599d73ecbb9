"""Fields whose surface is a union of patches, and the boxes of the patches on a backend (a Dr.Jit
device and precision). A patch is a level set of a function of its own, and each patch lies inside a
box of its own. A ray is traced only along the patches whose boxes it enters."""

from __future__ import annotations

import abc
import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from harnack.cluster.serialization import TransientCache
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.capabilities import PatchEntry, Patches
from harnack.fields.clearance import UnitFrame, frame_parameters, round_to_single
from harnack.fields.field import Field
from harnack.geometry import Box
from harnack.tree.closest_triangles import BoxTree

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.geometry import Volume

__all__ = ["PatchBoxes", "PatchField"]


@dataclass(frozen=True)
class PatchBoxes(UnitFrame):
    """A tree of boxes, one for each patch of a surface, on a backend. Boxes are stored in unit
    coordinates (`UnitFrame`), in which all of them together have a size of about 1. Rays are o + t
    d.

    tree: the tree of the boxes.
    """

    tree: BoxTree

    @classmethod
    def upload(cls, backend: Backend, lower: FloatArray, upper: FloatArray) -> PatchBoxes:
        """Make the tree of n boxes on a backend.

        lower, upper: (n, 3) the lowest and the highest corners of the boxes.

        The size of the unit coordinates is a power of two. So ray parameters are scaled without
        rounding, and keep their order.
        """
        min_corner, max_corner = lower.min(axis=0), upper.max(axis=0)
        center = round_to_single(0.5 * (min_corner + max_corner))
        size = 2.0 ** math.ceil(
            math.log2(np.abs(np.stack([min_corner, max_corner]) - center).max())
        )
        tree = BoxTree.from_corners(backend, (lower - center) / size, (upper - center) / size)
        return cls(*frame_parameters(backend, center, size), tree)

    def next(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        """The first box that a ray o + t d enters after the entry `after`, with start <= t <= end,
        on active lanes. Returns the ray parameters at which the ray enters and leaves the box, and
        the index of the patch in it (NO_PATCH if there is no further box). Entries are ordered by
        the parameter of entering, then by the index of the patch."""
        behind = after.enter / self.size, after.patch
        enter, leave, box = self.tree.next_box(
            self.to_unit(o), d, behind, start / self.size, end / self.size, active
        )
        return PatchEntry(enter * self.size, leave * self.size, box)


class HasPatchBoxes(Protocol):
    """The data of a union of patches on a backend: the boxes of the patches, and further data that
    a field chooses."""

    @property
    def boxes(self) -> PatchBoxes: ...


_Buffers = TypeVar("_Buffers", bound=HasPatchBoxes)


class PatchField(Field, Patches, Generic[_Buffers]):
    """A field whose surface is a union of patches. Each patch is a level set of a function of its
    own, and lies in a box of its own. The boxes depend on the levels. A prepared field has its data
    (boxes and functions) on a backend.

    levels: the levels whose patches lie in the boxes of the prepared field.
    """

    @property
    def patches(self) -> Patches | None:
        return self

    def __init__(self) -> None:
        self.levels: tuple[float, ...] = (self.default_level,)
        self._for_levels: TransientCache[tuple[float, ...], Self] = TransientCache()
        self._device: _Buffers | None = None

    @abc.abstractmethod
    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest corners of the boxes of all patches, two arrays (m, 3). Each
        box is proved to contain its patch.

        levels: the levels whose patches are meant; None for the attribute `levels`.
        """

    @abc.abstractmethod
    def _upload(self, backend: Backend) -> _Buffers:
        """Upload the boxes and the data of the patches to a backend, and return them."""

    def with_levels(self, levels: tuple[float, ...]) -> Self:
        """This field with boxes that contain the patches of these levels, not yet prepared for a
        backend. Equal levels give the same object."""
        if levels == self.levels:
            return self
        if levels not in self._for_levels:
            other = copy.copy(self)
            other.levels = levels
            self._for_levels[levels] = other
        return self._for_levels[levels]

    @cached_prepare
    def prepare(self, backend: Backend) -> Self:
        if self._device is not None and self._device.boxes.backend is backend:
            return self
        prepared = copy.copy(self)
        prepared._device = self._upload(backend)
        return prepared

    def _require_data(self) -> _Buffers:
        """The boxes and the data of the patches, which `prepare` uploaded.

        Raises:
            RuntimeError: `prepare` was not called.
        """
        if self._device is None:
            raise RuntimeError("prepare(backend) comes first")
        return self._device

    def next_entry(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        return self._require_data().boxes.next(o, d, after, start, end, active)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box that contains the patches of these levels: the box around the boxes of all patches.
        It is never None."""
        lower, upper = self.boxes(levels)
        return Box(lower.min(axis=0), upper.max(axis=0))
