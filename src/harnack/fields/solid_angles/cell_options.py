"""The argument `cells` of fields that may have FMM cells, and the decision whether cells pay.

FMM cells are cells of an octree, each with a list of near sources and a polynomial for all far
sources. Fields with cells (`dipole_cells`, `curve_cells`) take an argument `cells`. None builds
cells if they pay, True builds cells in any case, and False builds none. A number builds cells in
any case and limits their memory to this number of megabytes.

`trace`, `render`, and views that Python draws tell a field the number of rays
(`Field.for_ray_count`). The field builds cells if that pays: to build the cells of a cloud takes as
long as to trace about six rays per point without cells. Solids tell their operands the number, too.

Values at points use cells if the user requested cells, whatever the number of points. If that
number decided, the values of a part of the points could differ from those of all points by more
than their error bounds.
"""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from harnack.cluster.serialization import TransientCache
from harnack.fields.field import Field

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend

__all__ = ["BuiltCells", "FieldWithCells"]

# Megabytes that cells may take if the argument `cells` does not say how many.
_MEGABYTES = 256.0

Built = TypeVar("Built")


class BuiltCells(Protocol):
    """The FMM cells of a field, once they have been built.

    count: the number of cells.
    size: the number of bytes that they take.
    """

    @property
    def count(self) -> int: ...

    @property
    def size(self) -> int: ...


class FieldWithCells(Field):
    """A field that may have FMM cells. The constructor of a subclass calls `configure_cells`, which
    sets the attributes, and the subclass defines `cells_pay_from`.

    cells: the argument `cells`, as described in this module.
    cells_for_values: whether values at points use the cells, too. It is true if the user requested
        cells, whatever the number of points, so that values and their error bounds always come from
        the same method.
    finer_cells: whether the number of rays is so large that smaller cells pay; true if the user
        requested cells.
    """

    cells: bool | float | None
    cells_for_values: bool
    finer_cells: bool
    _device: Any
    _batches: Any

    def configure_cells(self, cells: Any) -> None:
        """Set whether the field uses FMM cells (octree cells, each with a polynomial for all far
        sources), and forget all cells that have been built.

        cells: True to build them in any case, False for none, None to build them if the number of
            rays is large enough, or a number of megabytes that limits their memory.

        Raises:
            ValueError: `cells` is none of these.
        """
        kind = cast("Any", type(cells))
        if issubclass(kind, np.bool_):  # True is no megabyte
            cells = bool(cells)
        is_number = issubclass(kind, (int, float, np.bool_, np.integer, np.floating))
        if cells is not None and not (is_number and 0 <= cells < math.inf):
            raise ValueError(
                f"cells must be True, False, a number of megabytes or None, not {cells!r}"
            )
        self.cells = cells
        self.cells_for_values, self.finer_cells = bool(cells), True
        self._with_cells: TransientCache[bool, Self] = TransientCache()
        self._built: TransientCache[tuple[Backend, int, bool], Any] = TransientCache()

    def with_cells(self, cells: bool = True) -> Self:
        """A copy of this field that uses cells for rays only, or with cells=False no cells."""
        field = copy.copy(self)
        field.configure_cells(cells)
        field.cells_for_values, field._device, field._batches = False, None, TransientCache()
        return field

    def build_cached(self, backend: Backend, build: Callable[[], Built]) -> Built:
        """The result of `build()` for a backend. It is computed once, and used for values and for
        tracing, as long as the limit of bytes and `finer_cells` are the same."""
        key = backend, self.max_bytes(), self.finer_cells
        if key not in self._built:
            self._built[key] = build()
        return self._built[key]

    @abc.abstractmethod
    def cells_pay_from(self) -> float:
        """The smallest number of rays for which cells save more time than it takes to build them;
        infinite if they never do."""

    def finer_cells_pay_from(self) -> float:
        """The smallest number of rays for which smaller cells (octree cells with local expansions)
        save more time than their longer construction takes.

        By default it is 0: fields whose cells have only one size take no account of the choice.
        """
        return 0.0

    def for_ray_count(self, count: int) -> Self:
        """The field for tracing `count` rays. It has cells if the user left the choice open
        (`cells` is None) and `count` is at least `cells_pay_from()`; otherwise it is this field
        itself."""
        if self.cells is not None or not self.cells_pay_from() <= count:
            return self
        finer = self.finer_cells_pay_from() <= count
        if finer not in self._with_cells:
            self._with_cells[finer] = self.with_cells()
            self._with_cells[finer].finer_cells = finer
        return self._with_cells[finer]

    def max_bytes(self) -> int:
        """The number of bytes that the cells may take."""
        return int(1e6 * (_MEGABYTES if self.cells is True else float(self.cells or 0)))

    def describe_cells(self, built: BuiltCells | None) -> dict[str, str]:
        """The entry "cells" of `describe`, or an empty dictionary if the field has no cells.

        built: in a prepared field the cells; None if they would have taken too much memory.

        In a prepared field the entry states the number and the memory of the cells. In a field that
        is not prepared it states how much memory they may take. If the field decides by the number
        of rays, the entry is the smallest number of rays for which it builds cells.
        """
        if self.cells is None and self.cells_pay_from() < math.inf:
            return {"cells": f"from {math.ceil(self.cells_pay_from()):,} rays on"}
        if not self.cells:
            return {}
        if self._device is None:
            return {"cells": f"of at most {self.max_bytes() / 1e6:g} MB"}
        if built is None:
            return {"cells": "none, as they need more memory"}
        return {"cells": f"{built.count} of {built.size / 1e6:.1f} MB"}
