"""Points in, numbers out: NumPy on both ends, Dr.Jit between, so many points at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import aligned, to_numpy, to_vector3

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = ["FloatArray", "in_batches"]

FloatArray = npt.NDArray[np.float64]

# Bounds memory, and the time until an interrupt is noticed.
_AT_ONCE = 1 << 18
# Squares of longer coordinates overflow.
_LARGEST = 1e100


def in_batches(
    backend: Backend, compute: Callable[..., tuple[Real | Vec3, ...]], points: Any, *others: Any
) -> tuple[Any, ...]:
    """The results of `compute` for points of shape (n, 3), as float64 arrays (n,) or (n, 3).

    others: more vectors of the same shape that `compute` is given, one a lane; their values are
        not looked at.

    Raises TypeError or ValueError for points that are not an (n, 3) array of finite numbers of at
    most 1e100.
    """
    _check_size(points)
    whole = [to_vector3(backend, points, "points"), *(_upload(backend, one) for one in others)]
    n = dr.width(whole[0])
    parts: list[tuple[FloatArray, ...]] = []
    # Once for no points at all: it tells shapes, and the errors of `compute`.
    for start in range(0, max(n, 1), _AT_ONCE):
        lanes = dr.arange(backend.UInt32, max(1, min(_AT_ONCE, n - start))) + start
        with dr.suspend_grad():
            given = (
                dr.gather(backend.Array3f, one, lanes) if n else backend.Array3f(0) for one in whole
            )
            results = compute(*given)
            dr.eval(*results)
        parts.append(tuple(_spread(to_numpy(one), dr.width(lanes)) for one in results))
    return tuple(np.concatenate(column)[:n] for column in zip(*parts, strict=True))


def _check_size(points: Any) -> None:
    given = None if dr.is_array_v(type(points)) else np.asarray(points)
    if given is None or not given.size or given.dtype.kind not in "fiu":
        return
    size = float(np.abs(given).max())
    if _LARGEST < size < np.inf:
        raise ValueError(f"points: coordinates up to {size:g} are too large: at most {_LARGEST:g}")


def _upload(backend: Backend, vectors: FloatArray) -> Vec3:
    kind = np.float32 if backend.precision == "single" else np.float64
    return backend.Array3f(*(aligned(backend, one.astype(kind)) for one in vectors.T))


def _spread(values: Any, n: int) -> FloatArray:
    return np.broadcast_to(values, (n, *values.shape[1:])).astype(np.float64)
