"""What searches compute at points, so many at a time: NumPy on both ends, in double precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.numbers import LARGEST
from harnack.fields import points as field_points

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["in_batches"]

# Bounds memory, and the time until an interrupt is noticed.
_AT_ONCE = 1 << 18


def in_batches(
    backend: Backend,
    compute: Callable[..., tuple[Real | Vec3, ...]],
    points: Any,
    *others: FloatArray,
) -> tuple[Any, ...]:
    """The results of `compute` for points of shape (n, 3), as float64 arrays (n,) or (n, 3).

    others: more vectors of the same shape that `compute` is given, one a lane; their values are
        not looked at.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers of at most
            1e100.
    """
    _check_size(points)
    with np.errstate(over="ignore"):
        rounded = (one.astype(backend.dtype, copy=False) for one in others)
        results = field_points.in_batches(backend, compute, points, *rounded, at_once=_AT_ONCE)
    return tuple(one.astype(np.float64, copy=False) for one in results)


def _check_size(points: Any) -> None:
    given = None if dr.is_array_v(type(points)) else np.asarray(points)
    if given is None or not given.size or given.dtype.kind not in "fiu":
        return
    size = float(np.abs(given).max())
    if LARGEST < size < np.inf:
        raise ValueError(f"points: coordinates up to {size:g} are too large: at most {LARGEST:g}")
