"""Fields whose surface is a union of patches, and the boxes of the patches on a backend (a Dr.Jit
device and precision). A patch is a level set of a function of its own, and each patch lies inside a
box of its own. A ray is traced only along the patches whose boxes it enters."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NoReturn

import numpy as np

from harnack.fields.capabilities import PatchEntry, Patches
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fmm.unit_frame import UnitFrame, frame_parameters, round_to_single
from harnack.geometry import Box
from harnack.tree.closest_triangles import BoxTree

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.geometry import Volume

__all__ = ["PatchBoxes", "PatchField", "PatchesInBoxes"]


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


@dataclass(frozen=True)
class PatchesInBoxes(Patches):
    """The patches of a surface on a backend, each in a box of its own. Subclasses add the data of
    the functions whose level sets the patches are, and define `patch`.

    boxes: the boxes of the patches.
    """

    boxes: PatchBoxes

    def next_entry(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        return self.boxes.next(o, d, after, start, end, active)


class PatchField(Field):
    """A field whose surface is a union of patches. Each patch is a level set of a function of its
    own, and lies in a box of its own. The boxes depend on the levels.

    no_single_function: the message of the error that is raised if the field itself is evaluated.
    """

    no_single_function: ClassVar[str]
    traits = Traits(has_patches=True)

    @abc.abstractmethod
    def boxes(self, levels: tuple[float, ...] | None = None) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest corners of the boxes of all patches, two arrays (m, 3). Each
        box is proved to contain its patch.

        levels: the levels whose patches are meant; None for the default level.
        """

    @abc.abstractmethod
    def _upload(self, backend: Backend, levels: tuple[float, ...]) -> PatchesInBoxes:
        """Upload the boxes and the data of the patches to a backend, and return them.

        levels: the levels whose patches lie in the boxes.
        """

    def evaluate(self, p: Vec3) -> NoReturn:
        """Not defined, as each patch has a function of its own. Always raises TypeError."""
        del p
        raise TypeError(self.no_single_function)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of the patches, with boxes that contain them for the levels of the plan; or
        for the default level, if it has none."""
        patches = self._upload(backend, plan.levels or (self.default_level,))
        return self.evaluator_of(patches)

    def evaluator_of(self, patches: PatchesInBoxes) -> Evaluator:
        """The evaluator of these patches."""
        return _PatchFieldEvaluator(patches, self.no_single_function)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box that contains the patches of these levels: the box around the boxes of all patches.
        It is never None."""
        lower, upper = self.boxes(levels)
        return Box(lower.min(axis=0), upper.max(axis=0))


class _PatchFieldEvaluator(Evaluator):
    """The evaluator of a `PatchField`, which has patches and nothing else."""

    def __init__(self, patches: PatchesInBoxes, no_single_function: str) -> None:
        """patches: the patches. no_single_function: the message of `evaluate`."""
        self.patches, self._no_single_function = patches, no_single_function

    def evaluate(self, p: Vec3) -> NoReturn:
        """Not defined, as each patch has a function of its own. Always raises TypeError."""
        del p
        raise TypeError(self._no_single_function)
