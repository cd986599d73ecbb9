"""The option `cells` of fields that are sums over many sources (dipoles, triangles or edges of
curves): whether to build FMM cells. These are cells of an octree, each with a list of near sources
and one polynomial for all far sources, so that a sample costs less time. To build them takes time
and memory. None builds cells if they save more time than they cost, True builds them in any case,
and False builds none. A number builds them in any case and limits their memory to this number of
megabytes.

The number of rays decides whether cells save time. `trace`, `render`, and views that Python draws
tell it to a field (`Plan.ray_count`); solids tell it to their operands, too. To build the cells of
a cloud takes as long as to trace about six rays per point without cells. `CellChoice` is the choice
for a number of rays.

Values at points use cells if the user requested cells, whatever the number of points. If that
number decided, the values of a part of the points could differ from those of all points by more
than their error bounds.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from harnack.cluster.serialization import TransientCache
from harnack.fields.field import Field

if TYPE_CHECKING:
    from harnack.backend import Backend

__all__ = ["NO_CELLS", "BuiltCells", "CellChoice", "FieldWithCells"]

# Megabytes that cells may take if the option `cells` is True, and so names no limit.
_MEGABYTES = 256.0

Built = TypeVar("Built")


class BuiltCells(Protocol):
    """The FMM cells of a field (octree cells, each with a polynomial for all far sources), once
    they have been built.

    count: the number of cells.
    size: the number of bytes that they take.
    """

    @property
    def count(self) -> int: ...

    @property
    def size(self) -> int: ...


@dataclass(frozen=True)
class CellChoice:
    """Which FMM cells a field has on a backend.

    max_bytes: the number of bytes that they may take; 0 for no cells.
    finer: whether cells are smaller, which takes longer to build them and saves time for very many
        rays. Fields whose cells have only one size ignore it.
    """

    max_bytes: int = 0
    finer: bool = True

    def __bool__(self) -> bool:
        """Whether there are cells, if they fit into the memory."""
        return self.max_bytes > 0

    def describe(self, built: BuiltCells | None) -> dict[str, str]:
        """The entry "cells" of a description, with the number and the memory of cells that have
        been built; an empty dictionary if this is the choice of no cells.

        built: the cells; None if they would have taken too much memory.
        """
        if not self:
            return {}
        if built is None:
            return {"cells": "none, as they need more memory"}
        return {"cells": f"{built.count} of {built.size / 1e6:.1f} MB"}


NO_CELLS = CellChoice()
"""The choice of no cells."""


class FieldWithCells(Field):
    """A field that may have FMM cells: octree cells, each with a list of near sources and a
    polynomial for all far sources. With cells a sample costs less time, but to build them takes
    time, too. So by default the number of rays decides whether the field has cells, and how small
    they are. The constructor of a subclass calls `configure_cells`, which sets the attributes, and
    the subclass defines `cells_pay_from`.

    cells: True for cells in any case, False for none, None if the number of rays decides, or a
        number of megabytes, for cells in any case with this limit of memory.
    """

    cells: bool | float | None

    def configure_cells(self, cells: Any) -> None:
        """Set whether the field has FMM cells, and forget all cells that have been built. Values at
        points use the cells if the user requested them, by True or a number.

        cells: True to build them in any case, False for none, None to build them if the number of
            rays is large enough, or a number of megabytes that limits their memory.

        Raises:
            ValueError: `cells` is none of these.
        """
        kind = cast("Any", type(cells))
        if issubclass(kind, np.bool_):  # so that np.True_ does not count as one megabyte
            cells = bool(cells)
        is_number = issubclass(kind, (int, float, np.bool_, np.integer, np.floating))
        if cells is not None and not (is_number and 0 <= cells < math.inf):
            raise ValueError(
                f"cells must be True, False, a number of megabytes or None, not {cells!r}"
            )
        self.cells = cells
        # Built cells, by backend and choice.
        self._built: TransientCache[tuple[Backend, CellChoice], Any] = TransientCache()

    def cell_choice(self, ray_count: int = 0) -> CellChoice:
        """The cells with which to trace `ray_count` rays. If the user left the choice open (`cells`
        is None), there are cells if there are so many rays that cells save time. The choice for 0
        rays is also that for values at points: cells that the user requested, or none.
        """
        if self.cells is not None:
            return CellChoice(int(1e6 * (_MEGABYTES if self.cells is True else self.cells)))
        if not self.cells_pay_from() <= ray_count:
            return NO_CELLS
        return CellChoice(int(1e6 * _MEGABYTES), self.finer_cells_pay_from() <= ray_count)

    def built_cells(
        self, backend: Backend, choice: CellChoice, build: Callable[[], Built]
    ) -> Built:
        """The cells of a choice on a backend, which are built once and used for values and for
        tracing.

        build: a function that builds the cells.
        """
        return self._built.get_or_make((backend, choice), build)

    @abc.abstractmethod
    def cells_pay_from(self) -> float:
        """The smallest number of rays for which cells save more time than their construction takes;
        infinite if they never do."""

    def finer_cells_pay_from(self) -> float:
        """The smallest number of rays for which smaller cells save more time than their longer
        construction takes. It is 0 by default, for fields whose cells have only one size: they
        ignore `CellChoice.finer`."""
        return 0.0

    def describe_cell_option(self) -> dict[str, str]:
        """The entry "cells" of `describe`: how much memory cells may take; or, if the number of
        rays decides, the smallest number for which there are cells. An empty dictionary if there
        are no cells in any case."""
        if self.cells is None and self.cells_pay_from() < math.inf:
            return {"cells": f"from {math.ceil(self.cells_pay_from()):,} rays on"}
        choice = self.cell_choice()
        return {"cells": f"of at most {choice.max_bytes / 1e6:g} MB"} if choice else {}
