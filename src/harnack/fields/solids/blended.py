"""Two solids joined with a rounded edge."""

from __future__ import annotations

import copy
import math
import numbers
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harnack.arithmetic.blends import blend_intersection, blend_union
from harnack.fields.formula import as_data, probe
from harnack.fields.solids.combined import shortest_wave, union
from harnack.fields.solids.solid import Shape, Solid, not_a_solid

if TYPE_CHECKING:
    from harnack.backend import Backend
    from harnack.geometry import Volume


@dataclass(frozen=True, eq=False)
class Blend(Shape):
    """The union or intersection of two solids with a fillet: see `arithmetic.blends`.

    Its Lipschitz constant is 2^(1/p) times the larger of the solids' own. A union's fillet stays
    within the union of the solids where both are at most the radius: within that of the solids
    grown by the radius.
    """

    parts: tuple[Solid, Solid]
    radius: Any
    power: Any
    is_union: bool

    def __post_init__(self) -> None:
        for name, least, value in (("radius", 0.0, self.radius), ("power", 1.0, self.power)):
            good = isinstance(value, numbers.Real) and least <= float(value) < math.inf
            if not good or value == 0:
                bound = "above 0" if least == 0.0 else f"of at least {least:g}"
                raise ValueError(f"{name} must be a number {bound}, not {value!r}")
            object.__setattr__(self, name, float(value))
        for one in self.parts:
            if not isinstance(one, Solid):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise TypeError(not_a_solid(one))
            one.formula(*probe())  # says early what has no formula
        constants = [one.lipschitz for one in self.parts]
        known = all(one is not None for one in constants)
        lipschitz = 2 ** (1 / self.power) * max(constants) * (1 + 1e-6) if known else None
        object.__setattr__(self, "lipschitz", lipschitz)
        object.__setattr__(self, "wavelength", shortest_wave(self.parts))
        object.__setattr__(self, "domain", union(*self.parts).domain)

    def hull(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        whole = union(*self.parts) if self.is_union else self.parts[0] & self.parts[1]
        if self.is_union:
            return whole.hull(level, above=True) if above else whole.hull(self._reached(level))
        return whole.hull(-self._reached(-level), above=True) if above else whole.hull(level)

    def _reached(self, level: float) -> float:
        """What the lesser of both is at most where their blended union is at most `level`.

        Proof. The blend grows with both, so it is at least that of the lesser value m taken twice:
        r - 2^(1/p) (r - m) for m < r, and m beyond.
        """
        if level >= self.radius:
            return level
        return self.radius - (self.radius - level) / 2 ** (1 / self.power) * (1 - 1e-9)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b = (one.formula(x, y, z) for one in self.parts)
        blend = blend_union if self.is_union else blend_intersection
        return blend(a, b, self.radius, self.power)

    def prepare(self, backend: Backend) -> Solid:
        other = copy.copy(self)
        parts = tuple(one.prepare(backend) for one in self.parts)
        object.__setattr__(other, "parts", parts)
        # The power stays a literal: ranges of x^p are found by what p is.
        object.__setattr__(other, "radius", as_data(self.radius, backend))
        return other
