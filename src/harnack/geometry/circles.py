"""Circles: closed curves that are no polygons."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend.numbers import LARGEST, FloatArray, real_array, vector_text
from harnack.names import renamed

__all__ = ["Circle", "net_circles"]

_SMALLEST = 1 / LARGEST


@renamed(centre="center")
@dataclass(frozen=True)
class Circle:
    """A circle, run counter-clockwise as seen from where its normal points to.

    radius: a positive length. center: (3,). normal: (3,), not zero; kept with length one.

    Raises ValueError, or TypeError for what is no number.
    """

    radius: float
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        radius = _numbers(self.radius, "radius", ())
        if not _SMALLEST <= radius <= LARGEST:
            raise ValueError(
                f"radius of a circle must lie between {_SMALLEST:g} and {LARGEST:g}, not "
                f"{float(radius):g}"
            )
        center, normal = (
            _numbers(self.center, "center", (3,)),
            _numbers(self.normal, "normal", (3,)),
        )
        if np.abs(center).max() > LARGEST:
            raise ValueError(f"center of a circle is {vector_text(center)}: choose smaller units")
        largest = float(np.abs(normal).max())
        if largest == 0.0:
            raise ValueError("normal of a circle is zero: give the direction of its axis")
        if abs(float(normal @ normal) - 1) > 1e-15:  # else it is one already, to rounding
            normal = normal / largest
            normal = normal / np.linalg.norm(normal)
        object.__setattr__(self, "radius", float(radius))
        object.__setattr__(self, "center", tuple(center.tolist()))
        object.__setattr__(self, "normal", tuple(normal.tolist()))

    @property
    def length(self) -> float:
        """The circumference."""
        return 2 * math.pi * self.radius

    def reversed(self) -> Circle:
        """The same circle, run the other way: a hole in what another curve bounds."""
        x, y, z = self.normal
        return Circle(self.radius, self.center, (-x, -y, -z))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the box around it, (3,) each."""
        reach = self.radius * np.sqrt(np.maximum(1 - np.square(self.normal), 0))
        return np.array(self.center) - reach, np.array(self.center) + reach

    def polygon(self, sides: int, *, around: bool = False) -> FloatArray:
        """(sides, 3) corners of the regular polygon in the circle, or of that around it."""
        if sides < 3:
            raise ValueError(f"a polygon needs at least three sides, not {sides}")
        radius = self.radius / math.cos(math.pi / sides) if around else self.radius
        axis = np.array(self.normal)
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first /= np.linalg.norm(first)
        angle = 2 * math.pi * np.arange(sides)[:, None] / sides
        across = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
        return np.array(self.center) + radius * across


def _numbers(values: Any, name: str, shape: tuple[int, ...]) -> FloatArray:
    array = real_array(values, f"{name} of a circle", type_error=TypeError).astype(np.float64)
    if array.shape != shape:
        wanted = "three numbers" if shape else "a number"
        raise ValueError(f"{name} of a circle must be {wanted}, not an array {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} of a circle must be finite, not {values!r}")
    return array


def net_circles(circles: Iterable[Circle]) -> tuple[Circle, ...]:
    """The circles without those that are run there and back, as `net_loops` for edges.

    Only circles with exactly the same center and radius and exactly opposite normals cancel.
    """
    surplus: Counter[Circle] = Counter()
    for one in circles:
        back = one.reversed()
        if surplus[back] > 0:
            surplus[back] -= 1
        else:
            surplus[one] += 1
    return tuple(surplus.elements())
