"""Whether a field has cells: as it was asked for, or where rays are so many that cells pay.

Fields with cells (`near_far`, `curve_cells`) take an argument `cells`: None for cells where they
pay, True for cells in any case, False for none, or how many megabytes they may take.
"""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from harnack.cluster.serialization import Remembered
from harnack.fields.field import Field

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend

__all__ = ["Cells", "HasCells"]

# Megabytes that cells may take by default.
_MEGABYTES = 256.0

Built = TypeVar("Built")


class Cells(Protocol):
    """Cells that were built: their number, and their bytes."""

    @property
    def count(self) -> int: ...

    @property
    def size(self) -> int: ...


class HasCells(Field):
    """A field that may have cells. Subclasses set `cells` by `set_cells`, and define
    `least_rays`.

    for_values: whether cells are for values at points too: where they were asked for, whatever the
        number of points, so that values and bounds of their errors are always of one kind.
    finer: whether there are so many rays that smaller cells pay; true where cells were asked for.
    """

    cells: bool | float | None
    for_values: bool
    finer: bool
    _device: Any
    _batches: Any

    def set_cells(self, cells: Any) -> None:
        """Take the argument. Raises ValueError for what is no number of megabytes."""
        kind = cast("Any", type(cells))
        if issubclass(kind, np.bool_):  # True is no megabyte
            cells = bool(cells)
        is_number = issubclass(kind, (int, float, np.bool_, np.integer, np.floating))
        if cells is not None and not (is_number and 0 <= cells < math.inf):
            raise ValueError(
                f"cells must be True, False, a number of megabytes or None, not {cells!r}"
            )
        self.cells = cells
        self.for_values, self.finer = bool(cells), True
        self._with_cells: Remembered[bool, Self] = Remembered()
        self._built: Remembered[tuple[Backend, int, bool], Any] = Remembered()

    def having_cells(self, cells: bool = True) -> Self:
        """A copy with cells for rays, or with none."""
        other = copy.copy(self)
        other.set_cells(cells)
        other.for_values, other._device, other._batches = False, None, Remembered()
        return other

    def built_once(self, backend: Backend, build: Callable[[], Built]) -> Built:
        """What `build` made for a backend, for values and for tracing."""
        key = backend, self.most_bytes(), self.finer
        if key not in self._built:
            self._built[key] = build()
        return self._built[key]

    @abc.abstractmethod
    def least_rays(self) -> float:
        """The number of rays from which on cells pay; infinite for never."""

    def least_rays_of_finer(self) -> float:
        """The number of rays from which on smaller cells pay. The default has one size."""
        return 0.0

    def for_rays(self, count: int) -> Self:
        """With cells, if none were asked for and none refused, from `least_rays` on."""
        if self.cells is not None or not self.least_rays() <= count:
            return self
        finer = self.least_rays_of_finer() <= count
        if finer not in self._with_cells:
            self._with_cells[finer] = self.having_cells()
            self._with_cells[finer].finer = finer
        return self._with_cells[finer]

    def most_bytes(self) -> int:
        """How many bytes cells may take."""
        return int(1e6 * (_MEGABYTES if self.cells is True else float(self.cells or 0)))

    def said_of_cells(self, built: Cells | None) -> dict[str, str]:
        """For `describe`: the number and memory of the cells of a prepared field, what those of
        another one may take, or from how many rays on there are any."""
        if self.cells is None and self.least_rays() < math.inf:
            return {"cells": f"from {math.ceil(self.least_rays()):,} rays on"}
        if not self.cells:
            return {}
        if self._device is None:
            return {"cells": f"of at most {self.most_bytes() / 1e6:g} MB"}
        if built is None:
            return {"cells": "none, as they need more memory"}
        return {"cells": f"{built.count} of {built.size / 1e6:.1f} MB"}
