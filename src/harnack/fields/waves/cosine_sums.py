"""Cosine series on a backend: sum factorization, with its derivatives, and local bounds.

The sum over k is made for each i and j, that over j for each i, that over i last: about 2 K^3
products in all where a sum of terms would need 7 K^3. i runs in a recorded loop over rows of a
table, j and k are written out, so that the coefficients are data: another function fitted by as
many terms compiles no other kernel. Each sum begins with the highest frequency, so that what is
large, the low ones, takes part in the fewest roundings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import aligned
from harnack.backend.extrema import clamp, fmin
from harnack.backend.records import Records
from harnack.backend.sines import sincos
from harnack.enclosures import Curvature

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.fields.waves.cosine_series import CellBounds, CosineBounds

# Constants are moved up, and radii down, by this much for the roundings of float32.
_KERNEL_ROUNDING = 1e-5


@dataclass(frozen=True)
class CosineSums:
    """The coefficients and local bounds of a series on a backend.

    lower: corner of the box. rate: pi over its size, angles per length.
    rounding: of value and gradient, in units of u, but for what moves the point.
    """

    backend: Backend
    shape: tuple[int, int, int]
    lower: Vec3
    rate: Vec3
    rows: Records
    rounding: tuple[Real, Real]
    curvature: Real
    cells: tuple[_Cells, ...]

    @classmethod
    def upload(
        cls,
        backend: Backend,
        coefficients: FloatArray,
        lower: FloatArray,
        size: FloatArray,
        bounds: CosineBounds,
        rounding: tuple[float, float],
    ) -> CosineSums:
        """The series of these coefficients (K_x, K_y, K_z)."""
        count, along_y, along_z = coefficients.shape
        first = np.arange(count, dtype=np.float64)[:, None]
        table = np.concatenate([first, coefficients.reshape(count, -1)], axis=1)[::-1]
        return cls(
            backend,
            (count, along_y, along_z),
            _data(backend, lower),
            _data(backend, np.pi / size),
            Records.upload(backend, table),
            (dr.opaque(backend.Float, rounding[0]), dr.opaque(backend.Float, rounding[1])),
            dr.opaque(backend.Float, bounds.curvature * (1 + _KERNEL_ROUNDING)),
            tuple(_Cells.upload(backend, one, size) for one in bounds.cells),
        )

    def angles(self, p: Vec3) -> Vec3:
        """From 0 to pi on the box."""
        return (self.backend.Array3f(p) - self.lower) * self.rate

    def value(self, p: Vec3) -> tuple[Real, Vec3]:
        """Value and gradient."""
        angles = self.angles(p)
        y, z = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            b, by, bz = _sum_plane(row, y, z)
            s, c = sincos(row[0] * angles.x)
            f, gx, gy, gz = state
            return (
                dr.fma(b, c, f),
                dr.fma(b, -row[0] * s, gx),
                dr.fma(by, c, gy),
                dr.fma(bz, c, gz),
            )

        real = self.backend.Float
        f, gx, gy, gz = self.rows.for_each(add, tuple(real(0) for _ in range(4)), "cosines")
        return f, self.rate * self.backend.Array3f(gx, gy, gz)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the matrix of second derivatives."""
        angles = self.angles(p)
        y, z = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            b, by, bz, byy, byz, bzz = _sum_plane(row, y, z, second=True)
            s, c = sincos(row[0] * angles.x)
            d, e = -row[0] * s, -row[0] * row[0] * c
            parts = (b * e, byy * c, bzz * c, by * d, bz * d, byz * c)
            return tuple(one + part for one, part in zip(state, parts, strict=True))

        real, vector, r = self.backend.Float, self.backend.Array3f, self.rate
        start = tuple(real(0) for _ in range(6))
        xx, yy, zz, xy, xz, yz = self.rows.for_each(add, start, "second cosines")
        return (
            r.x * r * vector(xx, xy, xz),
            r.y * r * vector(xy, yy, yz),
            r.z * r * vector(xz, yz, zz),
        )

    def curvatures(self, p: Vec3) -> tuple[Curvature, ...]:
        """Around p, the one of the smallest ball first; the last holds everywhere."""
        everywhere = Curvature(self.curvature + 0 * p.x, dr.inf)
        if not self.cells:
            return (everywhere,)
        share = self.angles(p) * float(1 / np.pi)
        return (*(one.curvature(share) for one in self.cells), everywhere)


@dataclass(frozen=True)
class _Cells:
    """Local bounds of the curvature on a backend; sides: of a cell, as lengths."""

    backend: Backend
    count: int
    sides: Vec3
    bounds: Real

    @classmethod
    def upload(cls, backend: Backend, cells: CellBounds, size: FloatArray) -> _Cells:
        bounds = aligned(backend, cells.bounds * (1 + _KERNEL_ROUNDING))
        return cls(backend, cells.count, _data(backend, size / cells.count), bounds)

    def curvature(self, share: Vec3) -> Curvature:
        """Of the cell in which a point lies, on a ball that stays within its neighbors."""
        place, index = share * float(self.count), self.backend.UInt32(0)
        free: Real = dr.inf
        for axis in (2, 1, 0):
            cell = clamp(dr.floor(place[axis]), 0, self.count - 1)
            index = index * self.count + self.backend.UInt32(cell)
            rest = place[axis] - cell
            free = fmin((1 + fmin(rest, 1 - rest)) * self.sides[axis], free)
        constant = dr.gather(self.backend.Float, self.bounds, index)
        return Curvature(constant, free * (1 - _KERNEL_ROUNDING * self.count))


def _data(backend: Backend, numbers: FloatArray) -> Vec3:
    return backend.Array3f(*(dr.opaque(backend.Float, float(one)) for one in numbers))


def _waves(angle: Real, count: int) -> tuple[list[Real], list[Real]]:
    """cos(k angle) and its derivative -k sin(k angle) for k < count."""
    values, slopes = [0 * angle + 1], [0 * angle]
    for k in range(1, count):
        s, c = sincos(float(k) * angle)
        values.append(c)
        slopes.append(-float(k) * s)
    return values, slopes


def _sum_plane(
    row: list[Real],
    y: tuple[list[Real], list[Real]],
    z: tuple[list[Real], list[Real]],
    *,
    second: bool = False,
) -> tuple[Any, ...]:
    """The sum over j and k for one i, its derivatives by y and z, and with `second` those by y
    twice, by y and z, and by z twice."""
    (cos_y, slope_y), (cos_z, slope_z) = y, z
    many = len(cos_z)
    sums: list[Any] = [0 * cos_y[0]] * (6 if second else 3)
    for j in reversed(range(len(cos_y))):
        a, b, c = 0 * cos_y[0], 0 * cos_y[0], 0 * cos_y[0]
        for k in reversed(range(many)):
            one = row[1 + j * many + k]
            a, b = dr.fma(one, cos_z[k], a), dr.fma(one, slope_z[k], b)
            if second and k:
                c = dr.fma(one * float(-k * k), cos_z[k], c)
        sums[0] = dr.fma(a, cos_y[j], sums[0])
        sums[1] = dr.fma(a, slope_y[j], sums[1])
        sums[2] = dr.fma(b, cos_y[j], sums[2])
        if second:
            sums[3] = dr.fma(a * float(-j * j), cos_y[j], sums[3])
            sums[4] = dr.fma(b, slope_y[j], sums[4])
            sums[5] = dr.fma(c, cos_y[j], sums[5])
    return tuple(sums)
