"""Kernels at many points: NumPy in, NumPy out."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import choose_backend, to_numpy, to_vector3

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
    """The arrays that `kernel` gives at points (n, 3), in their order; of a single point (3,) their
    only entries.

    The points are visited cell by cell along a Morton curve, so that neighbouring lanes walk a
    tree together, which halves the time. Raises ValueError for other shapes, NaN or infinity.
    """
    backend = choose_backend(precision)
    given = np.asarray(points)
    if given.shape == (3,):
        return tuple(one[0] for one in at_points(given[None], kernel, precision))
    to_vector3(backend, given[:1] if given.ndim == 2 else given, "points")  # shape, early
    if given.dtype.kind not in "fiu":
        raise TypeError(f"points must hold real numbers, not {given.dtype}")
    if not np.isfinite(given).all():
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        raise ValueError(f"points has NaN or infinite values: entry {bad[0]}")
    if not len(given):
        return tuple(one[:0] for one in at_points(np.zeros((1, 3)), kernel, precision))
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    for start in range(0, len(given), _AT_ONCE):
        some = given[start : start + _AT_ONCE]
        x = to_vector3(backend, some, "points")
        order = morton_order(backend, x)
        results = kernel(backend, dr.gather(backend.Array3f, x, order))
        places = [_back_in_place(one, order, len(some)) for one in results]
        dr.eval(*places)
        parts.append(tuple(to_numpy(one) for one in places))
    if len(parts) == 1:
        return parts[0]
    return tuple(np.concatenate(pieces) for pieces in zip(*parts, strict=True))


def _back_in_place(values: Any, order: Any, n: int) -> Any:
    """Values of the points in the order visited, in the order given."""
    kind = cast("Any", type(values))
    if dr.depth_v(kind) == 1:
        out = dr.zeros(kind, n)
        dr.scatter(out, values, order)
        return out
    return kind([_back_in_place(one, order, n) for one in values])


def morton_order(backend: Backend, x: Vec3) -> Any:
    """An order that visits points cell by cell, cells along a Morton curve (a Dr.Jit UInt32)."""
    index, vector = backend.UInt32, backend.Array3f
    n = dr.width(x)
    if n < 2:
        return dr.arange(index, n)
    low = vector(*(dr.min(one) for one in x))
    sides = [dr.max(x[k]) - low[k] for k in range(3)]
    size = dr.maximum(dr.maximum(sides[0], sides[1]), sides[2])
    scale = (2**_BITS - 1e-3) / dr.maximum(size, 1e-30)
    key = index(0)
    for axis in range(3):
        cell = index((x[axis] - low[axis]) * scale)
        for bit in range(_BITS):
            key |= (cell & (1 << bit)) << (2 * bit + axis)
    keys = to_numpy(key).astype(np.uint16)
    return index(np.argsort(keys, kind="stable").astype(np.uint32))
