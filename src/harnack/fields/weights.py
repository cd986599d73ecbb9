"""Numbers beside fields: the weights of sums, and the numbers that operators combine with fields.
Each is a float of Python, or a Dr.Jit array of one lane, which may have derivatives enabled.
"""

from __future__ import annotations

import numbers
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of, to_numpy
from harnack.backend.tensors import is_tensor, tensor_to_array
from harnack.backend.validation import as_finite, check_no_derivatives, format_short

if TYPE_CHECKING:
    from harnack.backend import Backend, Real


def is_number(value: Any) -> bool:
    """Whether a value is a number of Python or NumPy, and no boolean; or a Dr.Jit array or tensor,
    which then must hold a single number."""
    if isinstance(value, bool | np.bool_):
        return False
    return isinstance(value, numbers.Real) or dr.is_array_v(cast("Any", type(value)))


def as_number(value: Any) -> Any:
    """The number `value` as a float, or as a Dr.Jit array of one lane.

    Raises:
        TypeError: a Dr.Jit array of other than real numbers.
        ValueError: a Dr.Jit array of several numbers.
    """
    return checked_number(value, "a number beside a field")


def checked_number(value: Any, name: str) -> Any:
    """A number as a float, or as a Dr.Jit array of one lane. name: what it is, for messages."""
    kind = cast("Any", type(value))
    if not dr.is_array_v(kind):
        check_no_derivatives(name, value)  # a number of PyTorch
        return as_finite(value, name)
    array = tensor_to_array(value, name) if is_tensor(value) else value
    if dr.depth_v(type(array)) != 1 or dr.width(array) != 1:
        raise ValueError(f"{name} must be a single number, not {format_short(value)}")
    backend_of(array)  # raises TypeError for other than real numbers
    return array


def checked_weights(weights: Any, count: int) -> Any:
    """The weights of a sum of `count` terms: a tuple of floats and Dr.Jit arrays of one lane, or
    one Dr.Jit array of `count` lanes."""
    if weights is None:
        return (1.0,) * count
    if dr.is_array_v(cast("Any", type(weights))):
        array = tensor_to_array(weights, "weights") if is_tensor(weights) else weights
        backend_of(array)
        if dr.depth_v(type(array)) != 1 or dr.width(array) != count:
            raise ValueError(f"{count} terms need {count} weights, not {format_short(weights)}")
        return array
    try:
        entries = tuple(weights)
    except TypeError:
        raise TypeError(f"weights must be a list of numbers, not {weights!r}") from None
    if len(entries) != count:
        raise ValueError(f"{count} terms need {count} weights, not {len(entries)}")
    return tuple(checked_number(entry, "weights") for entry in entries)


def separate_weights(weights: Any, count: int) -> tuple[Any, ...]:
    """The weights of a sum one by one: Python numbers and Dr.Jit arrays of one lane."""
    if isinstance(weights, tuple):
        return cast("tuple[Any, ...]", weights)
    index = backend_of(weights).UInt32
    return tuple(dr.gather(type(weights), weights, index(k)) for k in range(count))


def host_number(number: Any) -> float:
    """A Python number, or a Dr.Jit array of one lane, as a float."""
    return number if isinstance(number, float) else float(to_numpy(number)[0])


def host_numbers(weights: Any) -> tuple[float, ...]:
    """Weights as floats."""
    if isinstance(weights, tuple):
        return tuple(host_number(weight) for weight in cast("tuple[Any, ...]", weights))
    return tuple(map(float, to_numpy(weights)))


def device_number(number: Any, backend: Backend) -> Real | None:
    """A Dr.Jit number in the precision of a backend, with its derivatives; None for a float."""
    return None if isinstance(number, float) else backend.Float(number)


def device_numbers(weights: Any, backend: Backend, count: int) -> tuple[Real | None, ...]:
    """Weights that are Dr.Jit numbers in the precision of a backend, with their derivatives; None
    in place of floats."""
    return tuple(device_number(weight, backend) for weight in separate_weights(weights, count))
