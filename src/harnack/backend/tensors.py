"""Tensors (n, 3) and (n,), the shape in which arrays of other frameworks come to Dr.Jit and go.

`drjit.wrap` gives a function tensors and takes back tensors, while what is computed here runs on
vectors, a lane a row. All conversions pass derivatives on, in both directions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr

from harnack.backend.arrays import backend_of
from harnack.backend.numbers import TRANSPOSE, check_vectors

if TYPE_CHECKING:
    from harnack.backend.arrays import Real, Vec3

Method = TypeVar("Method", bound=Callable[..., Any])


def is_tensor(value: Any) -> bool:
    """Whether a value is a Dr.Jit tensor."""
    return dr.is_tensor_v(cast("Any", type(value)))


def vectors_of(tensor: Any, name: str = "vectors", error: type[Exception] = ValueError) -> Vec3:
    """The rows of a tensor (n, 3) as a 3-vector of n lanes.

    Raises:
        TypeError: not of 32- or 64-bit floats.
        `error`: another shape. The message starts with `name`.
    """
    check_vectors(tensor, name, error, transposed=TRANSPOSE)
    numbers = numbers_of(tensor, name)
    backend = backend_of(numbers)
    count = 3 * tensor.shape[0]
    places = (dr.arange(backend.UInt32, k, count, 3) for k in range(3 if count else 0))
    rows = [dr.gather(backend.Float, numbers, place) for place in places]
    return backend.Array3f(*rows) if rows else dr.zeros(backend.Array3f, 0)


def numbers_of(tensor: Any, name: str = "values") -> Real:
    """All numbers of a tensor, row by row; a TypeError if these are no 32- or 64-bit floats."""
    array = tensor.array
    try:
        return backend_of(array).Float(array)
    except TypeError as error:
        raise TypeError(f"{name}: {error}") from None


def tensor_of(array: Any, shape: tuple[int, ...]) -> Any:
    """A Dr.Jit array as a tensor of a shape, a 3-vector as one of shape (*shape, 3).

    What is the same in all lanes is repeated. Counts become signed, as PyTorch has no others.
    """
    kind = cast("Any", type(array))
    count = math.prod(shape)
    if dr.width(array) == 1 and count > 1:
        lane = dr.uint32_array_t(dr.array_t(kind))
        array = dr.gather(kind, array, dr.zeros(lane, count))
    if dr.depth_v(kind) > 1:
        array, shape = dr.ravel(array), (*shape, dr.size_v(kind))
    elif dr.is_unsigned_v(kind) and not dr.is_mask_v(kind):
        array = dr.int32_array_t(kind)(array)
    return dr.tensor_t(type(array))(array, shape)


def takes_tensors(method: Method) -> Method:
    """The same method of points, which also takes a tensor of points and then gives tensors."""

    @functools.wraps(method)
    def general(self: Any, points: Any, **settings: Any) -> Any:
        if not is_tensor(points):
            return method(self, points, **settings)
        *shape, _ = points.shape or (0,)
        rows = cast("Any", type(points))(points.array, (1, 3)) if points.shape == (3,) else points
        return tensor_of(method(self, vectors_of(rows, "points"), **settings), tuple(shape))

    return cast("Method", general)
