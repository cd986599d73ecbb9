"""When a point of a ray counts as a hit, and how a ray can end."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.backend.numbers import real

if TYPE_CHECKING:
    from harnack.backend import Backend, Real


class Status(enum.IntEnum):
    """How a ray ended."""

    MISS = 0
    """It is proved that the ray meets no level between t_min and t_max."""
    HIT = 1
    """The ray is proved free up to t, where the surface is within tolerance."""
    OUT_OF_STEPS = 2
    """The ray is proved free up to t; what follows is not known. Raise max_steps."""


@dataclass(frozen=True)
class Tolerance:
    """When a point is close enough to a level to be a hit.

    distance: |f - level| <= distance * |grad f|, a length to first order (paper, Sec. 3.1.2).
    per_length: added to `distance` for each unit of t: half the angle of a pixel makes the
        tolerance grow with its footprint.
    value: also a hit where |f - level| <= value, whatever the gradient.

    Beside a pole of f, |f - level|/|grad f| is the distance to the pole and none to the level: rays
    that pass a point charge within the tolerance are called hits of every level. The same holds
    where the slope of f has no bound, as that of sqrt(|x|) beside x = 0.

    Where rounding leaves the distance to the level less certain than this, that uncertainty is
    the tolerance: about 1e-6 of the coordinates' size in single precision, 1e-15 in double.
    """

    distance: float = 1e-4
    per_length: float = 0.0
    value: float = 0.0

    def __post_init__(self) -> None:
        for name in ("distance", "per_length", "value"):
            number = real(getattr(self, name), f"tolerance: {name}")
            if not 0 <= number < math.inf:
                raise ValueError(f"tolerance: {name} must be finite and >= 0, not {number!r}")
        if self.distance == 0 and self.value == 0 and self.per_length == 0:
            raise ValueError("tolerance must be positive: a level set is never met exactly")

    def prepare(self, backend: Backend) -> PreparedTolerance:
        """The same as numbers of a backend, which no kernel is compiled anew for."""
        numbers = (self.distance, self.per_length, self.value)
        return PreparedTolerance(*(dr.opaque(backend.Float, number) for number in numbers))


@dataclass(frozen=True)
class PreparedTolerance:
    """A `Tolerance` on a backend."""

    distance: Real
    per_length: Real
    value: Real

    def in_value(self, steepness: Real, t: Real) -> Real:
        """How far in value a level may be from f to be a hit, where |grad f| = steepness."""
        return fmax(steepness * dr.fma(t, self.per_length, self.distance), self.value)
