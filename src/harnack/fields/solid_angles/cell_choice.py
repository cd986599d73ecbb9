"""Whether a field has cells: as it was asked for, or where rays are so many that cells pay.

Fields with cells (`near_far`, `curve_cells`) take an argument `cells`: None for cells where they
pay, True for cells in any case, False for none, or how many megabytes they may take.
"""

from __future__ import annotations

import abc
import copy
import math
from typing import TYPE_CHECKING, Any, Protocol

from harnack.cluster.packing import Remembered
from harnack.fields.field import Field

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend

__all__ = ["Cells", "HasCells"]

# Megabytes that cells may take by default.
_MEGABYTES = 256.0
# So many points are many: to build cells that were asked for takes longer than values at fewer.
_MANY_POINTS = 100_000


class Cells(Protocol):
    """Cells that were built: their number, and their bytes."""

    @property
    def count(self) -> int: ...

    @property
    def size(self) -> int: ...


class HasCells(Field):
    """A field that may have cells. Subclasses set `cells` by `set_cells`, and define
    `least_rays`, and `least_points` if cells `give_values`.

    finer: whether there are so many rays that smaller cells pay; true where cells were asked for.
    """

    cells: bool | float | None
    finer: bool
    _device: Any

    def set_cells(self, cells: bool | float | None) -> None:
        """Take the argument. Raises ValueError for what is no number of megabytes."""
        if cells is not None and not 0 <= cells < math.inf:
            raise ValueError(
                f"cells must be True, False, a number of megabytes or None, not {cells}"
            )
        self.cells, self.finer = cells, True
        self._with_cells: Remembered[tuple[int, ...], Self] = Remembered()

    @abc.abstractmethod
    def least_rays(self) -> float:
        """The number of rays from which on cells pay; infinite for never."""

    def least_rays_of_finer(self) -> float:
        """The number of rays from which on smaller cells pay. The default has one size."""
        return 0.0

    def made_of(self) -> tuple[Any, ...]:
        """Attributes that may be replaced, for which cells are made anew. The default has none."""
        return ()

    def having_cells(self) -> Self:
        """A copy with cells."""
        other = copy.copy(self)
        other.set_cells(True)
        other._device = None
        return other

    def for_rays(self, count: int) -> Self:
        """With cells, if none were asked for and none refused, from `least_rays` on."""
        if self.cells is not None or not self.least_rays() <= count:
            return self
        return self._kept_with_cells(finer=self.least_rays_of_finer() <= count)

    def _kept_with_cells(self, *, finer: bool) -> Self:
        """A copy with cells, the same one as long as what it is made of is the same."""
        key = finer, *map(id, self.made_of())  # of objects that the copy holds
        if key not in self._with_cells:
            self._with_cells[key] = self.having_cells()
            self._with_cells[key].finer = finer
        return self._with_cells[key]

    @property
    def give_values(self) -> bool:
        """Whether cells give values and gradients at points. Those of the default do not."""
        return False

    def least_points(self) -> float:
        """The number of points from which on cells pay for values at them."""
        return math.inf

    def for_points(self, count: int, backend: Backend) -> Any:
        """For values and gradients at so many points (`BatchedField.for_points`): with its cells
        where these pay, or where some were asked for and points are many."""
        if not self.give_values or count < (_MANY_POINTS if self.cells else self.least_points()):
            return self
        if self.cells is None:
            return self._kept_with_cells(finer=False).prepare(backend)
        return self.prepare(backend) if self.cells else self

    def most_bytes(self) -> int:
        """How many bytes cells may take."""
        return int(1e6 * (_MEGABYTES if self.cells is True else float(self.cells or 0)))

    def said_of_cells(self, built: Cells | None) -> dict[str, str]:
        """For `describe`: the number and memory of the cells that were built, or from how many rays
        on there are any."""
        if self.cells is None and self.least_rays() < math.inf:
            return {"cells": f"from {math.ceil(self.least_rays()):,} rays on"}
        if self._device is None or not self.cells:
            return {}
        if built is None:
            return {"cells": "none, as they need more memory"}
        return {"cells": f"{built.count} of {built.size / 1e6:.1f} MB"}
