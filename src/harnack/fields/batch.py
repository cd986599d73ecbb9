"""Evaluating a field at many points: NumPy in, NumPy out."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import aligned, choose_backend, to_numpy, to_vector3

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Vec3

FloatArray = npt.NDArray[np.float64]

# Points in one kernel: enough to keep a GPU busy, few enough to keep memory small.
_AT_ONCE = 1 << 20
# Cells along an axis, as a power of two; three of them make a key of 15 bits, which NumPy sorts
# by radix.
_BITS = 5


def at_points(
    points: Any,
    kernel: Callable[[Backend, Vec3], tuple[Any, ...]],
    precision: Precision,
) -> tuple[npt.NDArray[Any], ...]:
    """The arrays that `kernel` gives at points (n, 3), in their order.

    The points are visited cell by cell along a Morton curve, so that neighbouring lanes walk a
    tree together, which halves the time. Raises ValueError for other shapes, NaN or infinity.
    """
    backend = choose_backend(precision)
    given = np.asarray(points)
    to_vector3(backend, given[:1] if given.ndim == 2 else given, "points")  # shape, early
    if given.dtype.kind not in "fiu":
        raise TypeError(f"points must hold real numbers, not {given.dtype}")
    if not np.isfinite(given).all():
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        raise ValueError(f"points has NaN or infinite values: entry {bad[0]}")
    number = np.float64 if precision == "double" else np.float32
    order = morton_order(given)
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    for start in range(0, max(len(given), 1), _AT_ONCE):
        some = given[order[start : start + _AT_ONCE]].astype(number)
        x = backend.Array3f(*(aligned(backend, some[:, k]) for k in range(3)))
        results = kernel(backend, x)
        dr.eval(*results)
        parts.append(tuple(_wide(to_numpy(one), len(some)) for one in results))
    gathered: list[npt.NDArray[Any]] = []
    for pieces in zip(*parts, strict=True):
        sorted_values = np.concatenate(pieces)
        values = np.empty_like(sorted_values)
        values[order] = sorted_values
        gathered.append(values)
    return tuple(gathered)


def _wide(values: npt.NDArray[Any], n: int) -> npt.NDArray[Any]:
    return np.broadcast_to(values, (n, *values.shape[1:]))


def morton_order(points: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """An order that visits points (n, 3) cell by cell, cells along a Morton curve."""
    if len(points) < 2:
        return np.arange(len(points))
    low = points.min(axis=0)
    size = float((points.max(axis=0) - low).max())
    cells = ((points - low) * ((2**_BITS - 1e-3) / max(size, 1e-300))).astype(np.uint16)
    key = np.zeros(len(points), np.uint16)
    for axis in range(3):
        key |= _spread(cells[:, axis]) << np.uint16(axis)
    return np.argsort(key, kind="stable")


def _spread(x: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Five bits with two zeros between each and the next."""
    spread = np.zeros_like(x)
    for bit in range(_BITS):
        spread |= (x & np.uint16(1 << bit)) << np.uint16(2 * bit)
    return spread
