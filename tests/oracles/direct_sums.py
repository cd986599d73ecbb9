"""Sums over all elements in double precision: what trees and boundary edges are held against.

Nothing is taken from the fields: every triangle has an arctangent of its own (van Oosterom and
Strackee 1983), every dipole its term.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.record_table import RecordTable

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["ValueAndGradient", "dipole_sum", "sliced_sum", "winding_sum"]

ValueAndGradient: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Points (n, 3) in, values (n,) and gradients (n, 3) out."""

_AT_ONCE = 1 << 20


def winding_sum(triangles: npt.ArrayLike) -> Callable[[FloatArray], FloatArray]:
    """The winding number of triangles (m, 3, 3) as a function of points (n, 3): (n,)."""
    corners = np.asarray(triangles, dtype=np.float64).reshape(-1, 9)

    def term(x: Vec3, row: list[Real]) -> Real:
        vector = cast("Any", type(x))
        a, b, c = (vector(*row[k : k + 3]) - x for k in (0, 3, 6))
        la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
        re = la * lb * lc + dr.dot(a, b) * lc + dr.dot(b, c) * la + dr.dot(c, a) * lb
        return dr.atan2(dr.dot(a, dr.cross(b - a, c - a)), re) / (2 * dr.pi)

    def value(points: FloatArray) -> FloatArray:
        def total(x: Vec3, backend: Backend) -> tuple[Any, ...]:
            return _summed(backend, corners, lambda row, sums: (sums[0] + term(x, row),),
                           (dr.zeros(backend.Float, dr.width(x)),))  # fmt: skip

        return _in_parts(points, total)[0]

    return value


def dipole_sum(points: npt.ArrayLike, moments: npt.ArrayLike) -> ValueAndGradient:
    """The sum of m_i.(y_i - x)/|y_i - x|^3 over points y (m, 3) with moments m (m, 3), area times
    normal, and its gradient, as a function of points x."""
    rows = np.concatenate([np.asarray(points), np.asarray(moments)], axis=1).astype(np.float64)

    def value_and_gradient(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        def total(x: Vec3, backend: Backend) -> tuple[Any, ...]:
            vector: Any = backend.Array3f

            def add(row: list[Real], sums: tuple[Any, ...]) -> tuple[Any, ...]:
                z, m = vector(*row[:3]) - x, vector(*row[3:6])
                square = dr.squared_norm(z)
                cube, along = 1 / (square * dr.sqrt(square)), dr.dot(m, z)
                return sums[0] + along * cube, sums[1] + cube * (3 * along / square * z - m)

            zero = dr.zeros(backend.Float, dr.width(x)), dr.zeros(vector, dr.width(x))
            return _summed(backend, rows, add, zero)

        value, gradient = _in_parts(at, total)
        return value, gradient

    return value_and_gradient


def sliced_sum(points: npt.ArrayLike, moments: npt.ArrayLike, height: float) -> ValueAndGradient:
    """The sum of m_i.(y_i - x) (atan(r/w) - r w/D^2)/(2 r^3), D^2 = r^2 + w^2, over points y (m, 3)
    with moments m (m, 3) at distances r, seen from a height w; and its gradient."""
    rows = np.concatenate([np.asarray(points), np.asarray(moments)], axis=1).astype(np.float64)

    def value_and_gradient(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        def total(x: Vec3, backend: Backend) -> tuple[Any, ...]:
            vector: Any = backend.Array3f
            w = dr.opaque(backend.Float, height)

            def add(row: list[Real], sums: tuple[Any, ...]) -> tuple[Any, ...]:
                z, m = vector(*row[:3]) - x, vector(*row[3:6])
                square = dr.squared_norm(z)
                r, d2 = dr.sqrt(square), square + w * w
                kappa = (dr.atan2(r, w) - r * w / d2) / (2 * r * square)
                slope, along = (w / (d2 * d2) - 3 * kappa) / square, dr.dot(m, z)
                return sums[0] + along * kappa, sums[1] - kappa * m - slope * along * z

            zero = dr.zeros(backend.Float, dr.width(x)), dr.zeros(vector, dr.width(x))
            return _summed(backend, rows, add, zero)

        value, gradient = _in_parts(at, total)
        return value, gradient

    return value_and_gradient


def _summed(
    backend: Backend,
    rows: FloatArray,
    add: Callable[[list[Real], tuple[Any, ...]], tuple[Any, ...]],
    start: tuple[Any, ...],
) -> tuple[Any, ...]:
    """`add` of every row (k,) of numbers, one after the other, by one loop."""
    return RecordTable.upload(backend, rows).for_each(add, start, "direct sum")


def _in_parts(
    points: FloatArray, total: Callable[[Vec3, Backend], tuple[Any, ...]]
) -> tuple[FloatArray, ...]:
    backend = choose_backend("double")
    columns: list[tuple[FloatArray, ...]] = []
    for i in range(0, max(len(points), 1), _AT_ONCE):
        x = to_vector3(backend, points[i : i + _AT_ONCE])
        columns.append(tuple(to_numpy(one) for one in total(x, backend)))
    return tuple(np.concatenate(one) for one in zip(*columns, strict=True))
