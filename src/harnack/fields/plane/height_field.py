"""Height fields: the graph of a formula over the plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.arithmetic import Jet
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.formula import Formula, as_jet, probe, warn_of_price
from harnack.geometry.volumes import Box, Intersection

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray
    from harnack.geometry import Volume

# The heights over the domain are bounded on so many cells a side.
_CELLS = 32


def _around_the_origin() -> Volume:
    return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@dataclass(frozen=True, eq=False)
class HeightField(Formula):
    """The surface z = u(x, y): the level 0 of f = z - u, which is negative below it.

    function: u, written with plain operators and `harnack.sin` and its like (see `expression`);
        called while a kernel is being recorded, its numbers are literals of that kernel.
    domain: the volume it is drawn in, by default the box of all points with coordinates up to 1.

    Along a ray f'' is that of u alone, and all that is proved is made of its ranges. Rays are
    clipped to the heights that u has over the domain, as ranges of u on its cells prove.

        hk.HeightField(lambda x, y: 0.3 * hk.sin(3 * x) * hk.cos(3 * y))

    Raises:
        TypeError: function cannot be called with two coordinates, or uses what has no ranges.
    """

    function: Callable[[Any, Any], Any]
    domain: Volume | None = field(default_factory=_around_the_origin)

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise TypeError(f"function must be callable with x, y, not {self.function!r}")
        if self.domain is None or not np.isfinite(self.domain.bounds()).all():
            raise ValueError(
                "a height field needs a bounded domain, such as harnack.Ball() or "
                "harnack.Box((-1, -1, -1), (1, 1, 1))"
            )
        point = probe()
        as_jet(self.formula(*point), point[0], "HeightField")
        warn_of_price(self)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return z - self.function(x, y)

    def prepare(self, backend: Backend) -> Formula:
        del backend
        return self

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The domain, between the least and the largest height that a level can have over it."""
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        low, high = self._heights(lower, upper)
        slack = 1e-6 * float(np.abs([lower, upper]).max())
        low, high = low + min(levels) - slack, high + max(levels) + slack
        if not (np.isfinite([low, high]).all() and (low > lower[2] or high < upper[2])):
            return self.domain
        # Where no surface is left, a box that holds none of the domain's.
        bottom, top = max(low, lower[2] - slack), min(high, upper[2] + slack)
        if bottom >= top:
            return self.domain
        x, y = (float(one) for one in lower[:2])
        far_x, far_y = (float(one) for one in upper[:2])
        slab = Box((x - slack, y - slack, bottom), (far_x + slack, far_y + slack, top))
        return Intersection((self.domain, slab))

    def _heights(self, lower: FloatArray, upper: FloatArray) -> tuple[float, float]:
        """Proved: u stays within these over the domain's box."""
        backend = choose_backend("double")
        size = (upper - lower)[:2] / _CELLS
        cells = np.indices((_CELLS, _CELLS)).reshape(2, -1).T + 0.5
        centers = np.column_stack([cells * size + lower[:2], np.zeros(len(cells))])
        half = backend.Float(0.5 * float(size.max()) * (1 + 1e-9))
        jets = Jet.within(to_vector3(backend, centers, "points"), half)
        heights = as_jet(self.function(*jets[:2]), jets[0], "HeightField").value
        low = to_numpy(0 * half + dr.min(heights.low)).min()
        return float(low), float(to_numpy(0 * half + dr.max(heights.high)).max())
