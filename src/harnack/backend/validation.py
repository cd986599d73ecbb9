"""Checks of the numbers that a caller passes, single ones or in NumPy arrays. Each check returns
the numbers in a fixed type, or raises an error whose message begins with `name`, which says what
the numbers are.

Checks of arrays raise the error class that the calling code names, with the same wording
everywhere. Limits that differ between curves, meshes and clouds are checked by their own modules.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from harnack.backend.arrays import Precision

Function = TypeVar("Function", bound=Callable[..., Any])

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

TRANSPOSE_ADVICE = "; transpose it"
"""Advice of `check_vectors` for an array (3, n) where n vectors (n, 3) are expected."""

# Number of entries of a list, and of letters of a value, that `format_short` writes.
_MAX_ENTRIES, _MAX_TEXT_LENGTH = 4, 60

MAX_COORDINATE = 1e100
"""Larger coordinates are refused: products of their squares would overflow."""

LENGTH_RANGE = {"single": (1e-18, 1e18), "double": (1e-150, 1e150)}
"""The smallest size of a surface, and the largest coordinate of surfaces and rays, by precision.
Squares of distances between them neither overflow nor underflow, as proofs of steps need."""


def as_real_array(
    values: Any,
    name: str,
    error: type[Exception] = ValueError,
    *,
    type_error: type[Exception] | None = None,
    ragged: str = "must be a rectangular array of numbers, not ragged",
    other: str = "must hold real numbers",
) -> npt.NDArray[Any]:
    """Return the values as an array of integers or floats. An array of such numbers is returned
    itself, not copied.

    name: what the values are, for messages.
    error: the class of errors.
    type_error: the class of errors about values that are no real numbers; None for `error`.
    ragged, other: the messages, after `name`, for rows of different lengths and for values that are
        not real numbers.

    Raises:
        NotImplementedError: the values carry derivatives, which would be lost.
        error, type_error: the values are no rectangular array of real numbers.
    """
    check_no_derivatives(name, values)
    try:
        array = np.asarray(values)
    except (ValueError, OverflowError):
        raise error(f"{name} {ragged}") from None
    if array.dtype.kind not in "fiu":
        raise (type_error or error)(f"{name} {other}, not {array.dtype}")
    return array


def check_vectors(
    array: npt.NDArray[Any],
    name: str,
    error: type[Exception] = ValueError,
    *,
    planar: str = "",
    transposed: str = "",
) -> None:
    """Raise `error` unless an array has shape (n, 3).

    name: what the array is, for messages.
    planar, transposed: advice to append for the shapes (n, 2) and (3, n).
    """
    if array.ndim == 2 and array.shape[1] == 3:
        return
    hint = ""
    if array.shape == (3,):
        hint = "; write [[x, y, z]] for a single one"
    elif array.ndim == 2 and array.shape[1] == 2:
        hint = planar
    elif array.ndim == 2 and array.shape[0] == 3:
        hint = transposed
    raise error(f"{name} must have shape (n, 3), not {array.shape}{hint}")


def check_finite(
    rows: FloatArray, name: str, error: type[Exception], advice: str = "coordinates must be finite"
) -> None:
    """Raise `error` unless all numbers of an array (n, k) are finite.

    name: what a row is, for the message, with {} for its index.
    advice: the end of the message.
    """
    ids = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if ids.size:
        raise error(
            f"{name.format(ids[0])} is {format_vector(rows[ids[0]])}{others_suffix(ids.size)}: "
            f"{advice}"
        )


def check_coordinate_size(x: FloatArray, error: type[Exception]) -> None:
    """Raise `error` if a coordinate is larger than `MAX_COORDINATE`."""
    if (size := float(np.abs(x).max(initial=0.0))) > MAX_COORDINATE:
        raise error(f"coordinates up to {size:g} are too large: choose units nearer to 1")


def check_length_range(box: tuple[Any, Any], precision: Precision, subject: str) -> None:
    """Check that the sizes of objects fit a precision (see `LENGTH_RANGE`).

    box: the lower and the upper corner (3,) of a box around the objects. Coordinates may be
        infinite, and the box may be empty.
    subject: the beginning of the message, with its verb, such as "the surface has".

    Raises:
        ValueError: a finite coordinate is too large, or the longest side is too short.
    """
    corners = np.array(box, np.float64)
    if not (corners[0] <= corners[1]).all():
        return
    check_largest_coordinate(
        float(np.abs(corners[np.isfinite(corners)]).max(initial=0.0)), precision, subject
    )
    smallest = LENGTH_RANGE[precision][0]
    if np.isfinite(corners).all() and 0 < (side := float(np.ptp(corners, axis=0).max())) < smallest:
        raise ValueError(
            f"{subject} a size of {side:g}: too small for {precision} precision, in which "
            f"it must be at least {smallest:g}; choose units nearer to 1"
        )


def check_largest_coordinate(size: float, precision: Precision, subject: str) -> None:
    """Raise ValueError if the largest absolute coordinate `size` of objects is too large for a
    precision (see `LENGTH_RANGE`). subject: the beginning of the message, with its verb, such as
    "origins have"."""
    largest = LENGTH_RANGE[precision][1]
    if size > largest:
        raise ValueError(
            f"{subject} coordinates up to {size:g}: too large for {precision} precision, in "
            f"which they must be at most {largest:g}; choose units nearer to 1"
        )


def format_vector(row: FloatArray) -> str:
    """Write a vector as text for messages: "(1, 2, 3)"."""
    return "(" + ", ".join(f"{v:g}" for v in row) + ")"


def others_suffix(count: int) -> str:
    """Return the end of a message about the first of `count` wrong entries: how many more there
    are."""
    return f" (and {count - 1:,} more)" if count > 1 else ""


def check_no_derivatives(name: str, *values: Any) -> None:
    """Check that no value carries derivatives, for code that would lose them.

    Raises:
        NotImplementedError: a value carries derivatives (see `has_derivatives`). The message starts
            with `name`.
    """
    if has_derivatives(values):
        raise NotImplementedError(
            f"{name} cannot be differentiated by these numbers, which carry derivatives: detach "
            "them, as drjit.detach and torch.Tensor.detach do (known are derivatives by rays, "
            "levels, points, vertices of curves and meshes, oriented points, the weights of a "
            "FieldSum, numbers of formulas, many solids, blobs, series and networks, and by the "
            "parameters of a field of your own whose traits are "
            "harnack.fields.Traits(has_parameter_derivatives=True); tensors of PyTorch pass "
            "through a function that harnack.io.wrap_for_torch has wrapped)"
        )


def no_derivatives(function: Function) -> Function:
    """Decorator for a function that would lose derivatives. The function then refuses arguments
    that carry them, by a `NotImplementedError` (see `check_no_derivatives`)."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        """Check all arguments, and call the function."""
        check_no_derivatives(function.__qualname__, args, kwargs)
        return function(*args, **kwargs)

    return cast("Function", wrapper)


def has_derivatives(value: Any) -> bool:
    """Return whether a value is, or contains, a Dr.Jit or PyTorch array with derivatives enabled.
    The entries of containers, the objects that functions refer to, and the attributes of fields,
    callables and dataclasses are searched too."""
    visited: set[int] = set()
    pending: list[Any] = [value]
    for node in pending:  # the list grows in this loop
        kind = cast("Any", type(node))
        if kind is tuple:  # the most frequent type in fields
            pending += [entry for entry in node if type(entry) not in _PLAIN_TYPES]
        elif kind in _PLAIN_TYPES:
            continue
        elif dr.is_array_v(kind):
            if dr.is_diff_v(kind) and dr.grad_enabled(node):
                return True
        elif getattr(node, "requires_grad", False) is True:
            return True
        elif id(node) not in visited and not isinstance(node, type):
            visited.add(id(node))
            pending += _contained_values(node)
    return False


def is_plain_data(value: Any) -> bool:
    """Return whether a value consists of plain data only: Python's and NumPy's numbers, strings and
    arrays, in tuples, dictionaries and dataclasses of this package. Plain data never carries
    derivatives; Dr.Jit arrays and functions can."""
    pending: list[Any] = [value]
    for node in pending:  # the list grows in this loop
        kind = cast("Any", type(node))
        if kind in _PLAIN_TYPES:
            continue
        if kind is tuple:
            pending += node
        elif kind is dict:
            pending += node.values()
        elif dataclasses.is_dataclass(node) and kind.__module__.startswith("harnack."):
            pending += vars(node).values()
        else:
            return False
    return True


def make_read_only(value: Any) -> None:
    """Make all NumPy arrays in a value read-only. Nested tuples, lists, dictionaries and
    dataclasses of this package are searched too."""
    if isinstance(value, np.ndarray):
        cast("npt.NDArray[Any]", value).setflags(write=False)
    elif isinstance(value, tuple | list):
        for member in cast("Sequence[Any]", value):
            make_read_only(member)
    elif isinstance(value, dict):
        make_read_only(list(cast("dict[Any, Any]", value).values()))
    elif dataclasses.is_dataclass(value) and type(value).__module__.startswith("harnack."):
        make_read_only(list(vars(value).values()))


_PLAIN_TYPES = frozenset(
    (str, bytes, bool, int, float, complex, np.ndarray, np.float64, type(None))
)
_CONTAINER_TYPES = (list, tuple, set, frozenset)
# Functions of these packages use no numbers of the caller.
_KNOWN_PACKAGES = frozenset(("harnack", "drjit", "numpy", "math"))


def _contained_values(value: Any) -> list[Any]:
    """Return the values that a value contains or refers to, in which `has_derivatives` searches
    further: entries of containers, what functions use from outside, and attributes."""
    if isinstance(value, _CONTAINER_TYPES):
        return [entry for entry in cast("Any", value) if type(entry) not in _PLAIN_TYPES]
    if isinstance(value, dict):
        return list(cast("Any", value).values())
    if inspect.isfunction(value):
        if str(value.__module__).partition(".")[0] in _KNOWN_PACKAGES and not value.__closure__:
            return []
        # The values that a function uses from outside: its closure, globals and defaults.
        closure, defaults = inspect.getclosurevars(value), value.__kwdefaults__ or {}
        groups = closure.globals.values(), defaults.values(), value.__defaults__ or ()
        return [*closure.nonlocals.values(), *(entry for group in groups for entry in group)]
    if inspect.ismethod(value):
        return [value.__func__, value.__self__]
    # Of other objects, only dataclasses, callables and fields (with `parameters`) are searched.
    is_field = hasattr(value, "parameters")
    if not (dataclasses.is_dataclass(value) or callable(value) or is_field):
        return []
    attributes = [*getattr(value, "__dict__", {}).values()]
    # The function of a field of a user's class may use numbers from outside, too.
    if is_field and not type(value).__module__.startswith("harnack."):
        attributes.append(getattr(cast("Any", type(value)), "evaluate", None))
    return attributes


def format_short(value: Any) -> str:
    """Write a short text for a value in a message: an array by its shape, a long list by its
    length."""
    if isinstance(value, float):  # of NumPy too
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        shape = cast("npt.NDArray[Any]", value).shape
        return f"<array {' x '.join(map(str, shape))}>"
    if isinstance(value, tuple | list):
        entries = cast("Sequence[Any]", value)
        if len(entries) > _MAX_ENTRIES:
            return f"<{len(entries)} entries>"
        comma = "," if len(entries) == 1 else ""
        return f"({', '.join(map(format_short, entries))}{comma})"
    if dr.is_array_v(cast("Any", type(value))):
        return f"<{type(value).__name__}>"
    text = repr(value)
    if len(text) <= _MAX_TEXT_LENGTH and " at 0x" not in text and "\n" not in text:
        return text
    return f"<{getattr(value, '__name__', type(value).__name__)}>"


def is_same_or_equal(a: Any, b: Any) -> bool:
    """Return whether two values are the same object, or equal numbers, strings or tuples of
    these."""
    plain = (int, float, str, tuple)
    return a is b or (isinstance(a, plain) and isinstance(b, plain) and bool(np.all(a == b)))


def as_real(value: Any, name: str) -> float:
    """Return a number of Python or NumPy as a float; infinities and NaN are allowed. name: what it
    is, for messages.

    Raises:
        TypeError: it is not a number.
    """
    if type(value) is float:  # the most frequent type
        return value
    if dr.is_array_v(cast("Any", type(value))):
        return _real_of_array(value, name)
    try:
        # float("none") raises ValueError, so texts and bools are refused.
        return float("none" if isinstance(value, str | bytes | bool | np.bool_) else value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name} must be a number, not {value!r}") from None


def _real_of_array(value: Any, name: str) -> float:
    """The number in a Dr.Jit array or tensor of one number, without its derivatives."""
    numbers = np.array(dr.detach(value), np.float64).ravel()
    if numbers.size != 1:
        raise TypeError(f"{name} must be a number, not {numbers.size} numbers")
    return float(numbers[0])


def as_positive(value: Any, name: str) -> float:
    """Return a positive finite number as a float. name: what it is, for messages.

    Raises:
        TypeError: it is not a number.
        ValueError: it is not positive and finite.
    """
    number = as_real(value, name)
    if not 0.0 < number < math.inf:
        raise ValueError(f"{name} must be positive and finite, not {value!r}")
    return number


def as_finite(value: Any, name: str) -> float:
    """Return a finite number as a float. name: what it is, for messages.

    Raises:
        TypeError: it is not a number.
        ValueError: it is not finite.
    """
    number = as_real(value, name)
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, not {value!r}")
    return number


def as_integer_in_range(value: Any, name: str, minimum: int, maximum: int) -> int:
    """Return a number as an int, if it is an integer from `minimum` to `maximum`. name: what it is,
    for messages.

    Raises:
        ValueError: it is not an integer in that range.
    """
    # A number below the minimum stands for what is no integer; bools are none here.
    try:
        number = minimum - 1 if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        number = minimum - 1
    if not minimum <= number <= maximum:
        end = f"2^{n} - 1" if (n := maximum.bit_length()) >= 32 else str(maximum)
        raise ValueError(f"{name} must be an integer from {minimum} to {end}, not {value!r}")
    return number


def flag(value: Any, name: str) -> bool:
    """Return a bool of Python or NumPy as Python's bool. name: what it is, for messages.

    Raises:
        TypeError: it is not a bool.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, not {format_short(value)}")
    return bool(cast("Any", value))


def integer(value: Any, name: str) -> int:
    """Return an integer of Python or NumPy as an int. name: what it is, for messages.

    Raises:
        TypeError: it is not an integer.
    """
    try:
        # operator.index(None) raises TypeError, so bools are refused.
        return operator.index(cast("Any", None if isinstance(value, bool | np.bool_) else value))
    except TypeError:
        raise TypeError(f"{name} must be a whole number, not {format_short(value)}") from None


def as_triple(value: Any, name: str, *, all_positive: bool = False) -> tuple[float, float, float]:
    """Return three finite numbers as a tuple of floats.

    name: what they are, for messages.
    all_positive: whether they must be positive.

    Raises:
        TypeError, ValueError: they are not three such numbers.
    """
    kind = cast("Any", type(value))
    # (The entries of a Dr.Jit vector one by one: together, a vector of literals would be a kernel.)
    is_flat = dr.is_array_v(kind) and (dr.is_tensor_v(kind) or dr.depth_v(kind) == 1)
    try:
        entries = tuple(np.array(dr.detach(value)).ravel() if is_flat else value)
    except TypeError:
        raise TypeError(f"{name} must be three numbers, not {value!r}") from None
    if len(entries) != 3:
        raise ValueError(f"{name} must be three numbers, not {len(entries)}: {value!r}")
    check, each = as_positive if all_positive else as_finite, f"each of {name}"
    x, y, z = entries
    return check(x, each), check(y, each), check(z, each)
