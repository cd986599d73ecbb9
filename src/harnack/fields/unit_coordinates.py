"""Data on a backend, in coordinates in which they have a size of about one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3


@dataclass(frozen=True)
class UnitCoordinates:
    """The way to coordinates centre + size times these; what lies there, subclasses say."""

    backend: Backend
    centre: Vec3
    size: Real

    def unit(self, p: Vec3) -> Vec3:
        """A point in these coordinates."""
        return (self.backend.Array3f(p) - self.centre) / self.size


def single(centre: FloatArray) -> FloatArray:
    """The nearest centre that single precision holds exactly: to subtract it from points nearby
    then rounds nothing, however far the origin is."""
    with np.errstate(over="ignore"):
        rounded = centre.astype(np.float32).astype(np.float64)
    return np.where(np.isfinite(rounded), rounded, centre)


def placed(backend: Backend, centre: FloatArray, size: float) -> tuple[Backend, Vec3, Real]:
    """What `UnitCoordinates` consist of; neither becomes part of a kernel's code."""
    opaque = (dr.opaque(backend.Float, float(c)) for c in centre)
    return backend, backend.Array3f(*opaque), dr.opaque(backend.Float, size)


def epsilon_at(x: Vec3) -> Real:
    """What rounding may do to a coordinate of x, or of a vertex of size about one."""
    return float(dr.epsilon(x)) * (1 + dr.max(dr.abs(x)))
