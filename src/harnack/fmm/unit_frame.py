"""Unit coordinates, in which the data of a field have a size of about 1, and the rounding of
coordinates in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3


@dataclass(frozen=True)
class UnitFrame:
    """Data of a field on a backend (a Dr.Jit device and precision), in unit coordinates, in which
    the data have a size of about 1. A point x in unit coordinates stands for the point p = center +
    size * x of space. Subclasses add the data."""

    backend: Backend
    center: Vec3
    size: Real

    def to_unit(self, p: Vec3) -> Vec3:
        """The point p of space in unit coordinates: (p - center) / size."""
        return (self.backend.Array3f(p) - self.center) / self.size


def round_to_single(center: FloatArray) -> FloatArray:
    """The center (3,) rounded to numbers of single precision, so that subtracting it from nearby
    points is exact, however far the origin is. Coordinates that are too large for single precision
    are left as they are."""
    with np.errstate(over="ignore"):
        rounded = center.astype(np.float32).astype(np.float64)
    return np.where(np.isfinite(rounded), rounded, center)


def center_and_size(
    low: FloatArray, high: FloatArray, least_size: float = 0.0
) -> tuple[FloatArray, float]:
    """The center (3,) and the size of unit coordinates for data in a box. The size is a power of
    two, so that lengths are scaled without rounding: at least half the longest side of the box.

    low, high: (3,) opposite corners of the box.
    least_size: another lower bound of the size.
    """
    extent = max(0.5 * float((high - low).max()), least_size)
    return round_to_single(0.5 * (low + high)), 2.0 ** math.ceil(math.log2(extent))


def frame_parameters(
    backend: Backend, center: FloatArray, size: float
) -> tuple[Backend, Vec3, Real]:
    """The three attributes of a `UnitFrame`, with center and size as kernel parameters, so that
    other numbers use the same compiled kernel.

    center: (3,) the point that becomes the origin.
    size: the length that becomes 1.
    """
    opaque = (dr.opaque(backend.Float, float(c)) for c in center)
    return backend, backend.Array3f(*opaque), dr.opaque(backend.Float, size)


def coordinate_rounding(x: Vec3) -> Real:
    """A bound of the rounding errors of the coordinates of x, a point in unit coordinates
    (`UnitFrame`), and of the coordinates of data, whose absolute values are about 1."""
    return float(dr.epsilon(x)) * (1 + dr.max(dr.abs(x)))
