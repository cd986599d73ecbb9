"""The Dr.Jit array types in use, and conversions between NumPy and Dr.Jit. A `Backend` is a device
with a precision: it holds the array types of Dr.Jit for both. A Dr.Jit array has entries, called
lanes, which one kernel computes in parallel; a 3-vector is three such arrays. An array is evaluated
if its numbers are in memory, and otherwise it is only recorded: its numbers are computed when a
kernel runs. A literal is a constant in a kernel's code; a kernel parameter is read from memory, so
another value needs no other kernel.

Nothing here changes a Dr.Jit flag, the number of threads or the Mitsuba variant.
"""

from __future__ import annotations

import functools
import importlib
import os
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.llvm import ensure_llvm
from harnack.backend.validation import FloatArray, as_real_array, check_vectors
from harnack.name_suggestions import is_one_of

# Dr.Jit creates its array types at run time, one family per backend and precision, so no static
# type describes "a Float of any backend". These names stand for such types.
Real: TypeAlias = Any  #: Dr.Jit floating-point array, one number per lane (or a Python float)
Vec3: TypeAlias = Any  #: Dr.Jit 3-vector, one per lane
Index: TypeAlias = Any  #: Dr.Jit integer array
Mask: TypeAlias = Any  #: Dr.Jit Boolean array

BackendName: TypeAlias = Literal["llvm", "cuda", "metal"]
Precision: TypeAlias = Literal["single", "double"]

BACKEND_VARIABLE = "HARNACK_BACKEND"
_ALIGNMENT = 64  # bytes: the widest vectors of any processor


@dataclass(frozen=True)
class Backend:
    """The Dr.Jit array types of one backend and precision. All of them carry derivatives.

    name: "llvm" (CPU), "cuda" (NVIDIA GPU) or "metal" (Apple GPU, single precision only).
    precision: "single" or "double", the precision of Float and of the vectors' components.
    Float, UInt32, Int32, Bool: array types with one entry per lane.
    Array2f, Array3f, Array4f, ArrayXf: vector types with 2, 3, 4 and any number of Floats.
    """

    name: BackendName
    precision: Precision
    Float: Any
    UInt32: Any
    Int32: Any
    Bool: Any
    Array2f: Any
    Array3f: Any
    Array4f: Any
    ArrayXf: Any

    def __repr__(self) -> str:
        return f"Backend({self.name}, {self.precision})"

    @property
    def dtype(self) -> type[np.float32 | np.float64]:
        """NumPy's type of numbers of this precision."""
        return np.float32 if self.precision == "single" else np.float64

    @property
    def machine_epsilon(self) -> float:
        """The distance from 1 to the next number of this precision."""
        return 2.0**-23 if self.precision == "single" else 2.0**-52


@functools.cache
def _make_backend(name: BackendName, precision: Precision) -> Backend:
    """Return the `Backend` with this name and precision. LLVM or Metal is checked when its
    `Backend` is first made; later calls return the same object."""
    if name == "llvm":
        ensure_llvm()
    module = importlib.import_module(f"drjit.{name}.ad")
    suffix = "64" if precision == "double" else ""

    def type_named(stem: str) -> Any:
        """Return the Dr.Jit type of this name in the right precision: for double precision, "Float"
        becomes "Float64"."""
        return getattr(module, stem + suffix)

    backend = Backend(
        name=name,
        precision=precision,
        Float=type_named("Float"),
        UInt32=module.UInt32,
        Int32=module.Int32,
        Bool=module.Bool,
        Array2f=type_named("Array2f"),
        Array3f=type_named("Array3f"),
        Array4f=type_named("Array4f"),
        ArrayXf=type_named("ArrayXf"),
    )
    if name == "metal":
        _check_ieee_arithmetic(backend)
    return backend


def _check_ieee_arithmetic(backend: Backend) -> None:
    """Check that a device computes as IEEE 754 prescribes.

    Metal's compiler may by default assume that no number is infinite or NaN, and may round
    differently; the proofs need both infinities and NaN and the right rounding. So a few operations
    are run on the device and compared with NumPy. The device may flush subnormal numbers (those
    below about 1e-38) to zero: no operation of the comparison has such a result.

    Raises:
        RuntimeError: a result differs from NumPy's.
    """
    # Special and ordinary numbers; the last one is 2^24, to which adding 1 is rounded.
    values = np.array([1, 3, 0, -0.0, 1e-30, 8e37, np.inf, np.nan, 0.1, 16777216], np.float32)
    x, one = upload_floats(backend, values), dr.opaque(backend.Float, 1)
    np_one = np.float32(1)
    with np.errstate(all="ignore"):
        # Each operation: the device's result, NumPy's, and the allowed error in units in the last
        # place. A quotient and a root may have an error of two units: proved bounds allow more.
        operations: dict[str, tuple[Any, Any, int]] = {
            "1 / x": (one / x, np_one / values, 2), "sqrt(x)": (dr.sqrt(x), np.sqrt(values), 2),
            "x - x": (x - x, values - values, 0), "x + 1": (x + one, values + np_one, 0),
            "2 x": (2 * one * x, 2 * values, 0), "x x": (x * x, values * values, 0),
            "x == x": (dr.select(x == x, one, 0), (values == values).astype(np.float32), 0),
        }  # fmt: skip
        for name, (computed, expected, ulps) in operations.items():
            result = to_numpy(computed)
            is_near = np.abs(result - expected) <= ulps * np.spacing(np.abs(expected))
            is_same = (result == expected) | (np.isnan(result) & np.isnan(expected))
            if not (is_near | is_same).all():
                raise RuntimeError(
                    f"Dr.Jit's {backend.name} device does not compute {name} as IEEE 754 says, on "
                    f"which proofs rest: set {BACKEND_VARIABLE}=llvm to compute on the CPU"
                )


def choose_backend(precision: Precision = "single") -> Backend:
    """Return the backend to compute on: CUDA if there is a usable device; else, for single
    precision, Metal if there is a usable device; else LLVM.

    The environment variable HARNACK_BACKEND ("llvm", "cuda" or "metal") forces one of them. Metal
    has no double precision; with "metal", double precision uses LLVM.

    Raises:
        ValueError: unknown precision, or unknown name in HARNACK_BACKEND.
        LLVMNotFoundError: LLVM is needed, and no LLVM that Dr.Jit can use is installed.
        RuntimeError: CUDA or Metal is forced and no device is usable, or Metal computes
            incorrectly.
    """
    if not is_one_of(precision, ("single", "double")):
        raise ValueError(f'precision is "single" or "double", not {precision!r}')
    forced = os.environ.get(BACKEND_VARIABLE, "")
    if forced not in ("", "llvm", *_DEVICES):
        raise ValueError(
            f'{BACKEND_VARIABLE} is {forced!r}; set it to "llvm", "cuda" or "metal", or unset it'
        )
    # GPUs are tried in order of preference; LLVM is last.
    for name, (kind, advice) in _DEVICES.items():
        if forced not in ("", name):
            continue
        if dr.has_backend(kind):
            if name != "metal" or precision == "single":
                return _make_backend(name, precision)
        elif forced:
            raise RuntimeError(
                f"{BACKEND_VARIABLE}={name}, but Dr.Jit finds no usable device for it: {advice}, "
                f"or unset {BACKEND_VARIABLE}"
            )
    return _make_backend("llvm", precision)


def precision_of_input(*arrays: Any) -> Precision:
    """Return the precision in which to compute with arrays or lists. It is "double" if any of them
    is an array of float64 or a list with such an array, otherwise "single" (float32, integers,
    lists of numbers)."""

    def is_double(array: Any) -> bool:
        """Return whether an array, or an entry of nested lists, has the type float64."""
        if isinstance(array, list | tuple):
            return any(map(is_double, cast("list[Any]", array)))
        dtype = getattr(array, "dtype", None)
        return dtype is not None and dtype == np.float64

    return "double" if any(map(is_double, arrays)) else "single"


def backend_of(array: Any) -> Backend:
    """Return the backend and precision of a Dr.Jit array or vector of floats, with or without
    automatic differentiation.

    Raises:
        TypeError: not a Dr.Jit array; an array of Dr.Jit's scalar mode, a matrix, tensor or the
            like; or not of 32- or 64-bit floats.
        LLVMNotFoundError: Dr.Jit has loaded an LLVM that it cannot use.
    """
    kind = _untyped_class(array)
    full_name = f"{kind.__module__}.{kind.__name__}"
    if not dr.is_array_v(kind):
        raise TypeError(
            f"expected a Dr.Jit array, got {full_name}: convert NumPy arrays and lists with "
            "harnack.backend.to_vector3 or to_float"
        )
    name = _BACKEND_NAMES.get(dr.backend_v(kind))
    if name is None:
        raise TypeError(
            f"{full_name} belongs to Dr.Jit's scalar mode: use the types of "
            "drjit.llvm.ad, drjit.cuda.ad or drjit.metal.ad (in Mitsuba, a variant such as "
            '"llvm_ad_rgb")'
        )
    # Matrices, complex numbers and quaternions are special; more than two levels are vectors of
    # vectors.
    if dr.is_special_v(kind) or dr.is_tensor_v(kind) or dr.depth_v(kind) > 2:
        raise TypeError(f"expected a Dr.Jit scalar or vector array, got {full_name}")
    precision = _PRECISIONS.get(dr.type_v(kind))
    if precision is None:
        raise TypeError(f"expected floats of 32 or 64 bits, got {full_name}")
    return _make_backend(name, precision)


def _untyped_class(value: object) -> Any:
    """Return the class of a value, typed as `Any`: static type checkers do not know the attributes
    of Dr.Jit's classes."""
    return type(value)


# Devices in the order in which they are chosen, and advice if there is none.
_DEVICES: dict[BackendName, tuple[Any, str]] = {
    "cuda": (dr.JitBackend.CUDA, "check that nvidia-smi lists one"),
    "metal": (dr.JitBackend.Metal, "it is for Macs with macOS 14 or later"),
}
_BACKEND_NAMES: dict[Any, BackendName] = {
    dr.JitBackend.LLVM: "llvm", **{kind: name for name, (kind, _) in _DEVICES.items()}
}  # fmt: skip
_PRECISIONS: dict[Any, Precision] = {
    dr.VarType.Float32: "single",
    dr.VarType.Float64: "double",
}


def to_vector3(backend: Backend, vectors: Any, name: str = "vectors") -> Vec3:
    """Convert vectors to backend.Array3f, from an array or list of shape (n, 3) or from a Dr.Jit
    3-vector.

    The numbers of an array or list must be finite. A Dr.Jit vector is converted to the backend's
    precision. Its numbers are not checked: reading them would evaluate the vector, and so split the
    kernel that is being recorded.

    name: what the vectors are, for messages.

    Raises:
        TypeError: not numbers; a Dr.Jit array that is no 3-vector or of another backend.
        ValueError: wrong shape; NaN or infinite values.
    """
    if dr.is_array_v(_untyped_class(vectors)):
        _check_same_backend(backend, vectors, name)
        if dr.depth_v(type(vectors)) != 2 or dr.size_v(type(vectors)) != 3:
            raise TypeError(f"{name} must be a 3-vector, got {type(vectors).__name__}")
        return backend.Array3f(vectors)
    return upload_vectors(backend, as_finite_vectors(vectors, name), name)


def as_finite_vectors(vectors: Any, name: str) -> FloatArray:
    """Convert vectors to a float64 array (n, 3) of finite numbers. name: what the vectors are, for
    messages.

    Raises:
        TypeError: not numbers.
        ValueError: wrong shape; NaN or infinite values.
    """
    values = as_real_array(vectors, name, type_error=TypeError).astype(np.float64, copy=False)
    check_vectors(values, name)
    is_finite = np.isfinite(values)
    if not is_finite.all():
        _check_rows(~is_finite.all(axis=1), "NaN or infinite", name)
    return values


def upload_vectors(backend: Backend, rows: npt.NDArray[Any], name: str = "vectors") -> Vec3:
    """Copy rows (n, 3) into a backend.Array3f with n lanes, evaluated. Infinite values and NaN are
    allowed.

    Raises:
        ValueError: a number is too large for single precision. The message starts with `name`.
    """
    return backend.Array3f(
        *(upload_floats(backend, column) for column in _cast(backend, rows, name).T)
    )


def to_float(backend: Backend, values: Any, name: str = "values") -> Real:
    """Convert numbers to backend.Float, from a number, an array or list of shape (n,), or a Dr.Jit
    array.

    Infinite values are allowed (a ray may have no end), NaN is not. A single number becomes a
    kernel parameter, not a literal in the kernel's code, so that another number compiles no other
    kernel. The numbers of a Dr.Jit array are not checked.

    name: what the numbers are, for messages.

    Raises:
        TypeError: not numbers; a Dr.Jit array that has more than one number per lane or is of
            another backend.
        ValueError: wrong shape; NaN.
    """
    if dr.is_array_v(_untyped_class(values)):
        _check_same_backend(backend, values, name)
        if dr.depth_v(type(values)) != 1:
            raise TypeError(f"{name} must be one number a lane, got {type(values).__name__}")
        return backend.Float(values)
    numbers = as_real_array(values, name, type_error=TypeError).astype(np.float64, copy=False)
    if numbers.ndim > 1:
        raise ValueError(f"{name} must be a number or have shape (n,), not {numbers.shape}")
    _check_rows(np.isnan(numbers), "NaN", name)
    rounded = _cast(backend, numbers, name)
    # A single number.
    if rounded.ndim == 0:
        return dr.opaque(backend.Float, float(rounded))
    return upload_floats(backend, rounded)


def gather_vectors(backend: Backend, vectors: Vec3, index: Index) -> Vec3:
    """Return the vector at a given index for each lane, in the backend's precision.

    vectors: a Dr.Jit 3-vector of any precision, from which is read.
    index: an index for each lane.

    A component of width 1, which all lanes share, is not gathered: Dr.Jit would write the
    derivatives of such a gather beyond the end of the array.
    """
    return backend.Array3f(
        *(
            component if dr.width(component) == 1 else dr.gather(backend.Float, component, index)
            for component in backend.Array3f(vectors)
        )
    )


def as_kernel_parameters(array: Any) -> Any:
    """Return the array with literals turned into kernel parameters, so that another value uses the
    same compiled kernel. A literal is a constant in the kernel's code. Derivatives are kept."""
    kind = _untyped_class(array)
    if dr.depth_v(kind) > 1:
        return kind(*map(as_kernel_parameters, array))
    if array.state != dr.VarState.Literal:
        return array
    # A copy in memory; derivatives are attached again.
    parameter = dr.detach(kind(array))
    dr.make_opaque(parameter)
    return dr.replace_grad(parameter, array) if dr.grad_enabled(array) else parameter


def _check_same_backend(backend: Backend, array: Any, name: str) -> None:
    """Raise `TypeError` for a Dr.Jit array of another backend than the given one. name: what the
    array is, for messages."""
    try:
        array_backend = backend_of(array)
    except TypeError as error:
        raise TypeError(f"{name}: {error}") from None
    if array_backend.name != backend.name:
        raise TypeError(
            f"{name} lives on {array_backend.name}, but the computation runs on {backend.name}"
        )


def _check_rows(is_bad: Any, kind: str, name: str) -> None:
    """Raise `ValueError` if `is_bad` (n,) is True anywhere; the message names the first such row.

    kind: what is wrong with the row, such as "NaN".
    name: what the rows are.
    """
    indices = np.flatnonzero(is_bad)
    if indices.size:
        rest = f" and {indices.size - 1} more" if indices.size > 1 else ""
        raise ValueError(f"{name} has {kind} values: entry {indices[0]}{rest}")


def _cast(backend: Backend, values: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """Return the numbers of an array in the backend's precision. name: what they are, for messages.

    Raises:
        ValueError: a finite number is too large for single precision.
    """
    if backend.precision == "double" or values.dtype == backend.dtype:
        return values
    with np.errstate(over="ignore"):
        rounded = values.astype(np.float32)
    overflow = np.isinf(rounded) & np.isfinite(values)
    if overflow.any():
        raise ValueError(
            f"{name} has {values[overflow][0]:g}, too large for single precision: "
            'use smaller units, or in Python precision="double"'
        )
    return rounded


def upload_floats(backend: Backend, values: npt.NDArray[Any]) -> Real:
    """Copy a one-dimensional NumPy array into an evaluated backend.Float in aligned memory (see
    `_aligned`).

    Raises:
        ValueError: another shape, or numbers too large for single precision.
    """
    if values.ndim != 1:
        raise ValueError(f"expected a one-dimensional array, got shape {values.shape}")
    if values.size == 0:
        return dr.zeros(backend.Float, 0)
    return backend.Float(_aligned(_cast(backend, values, "an array"), np.dtype(backend.dtype)))


def upload_integers(backend: Backend, values: npt.NDArray[Any]) -> Index:
    """Copy a one-dimensional NumPy array of integers >= 0 into an evaluated backend.UInt32 in
    aligned memory (see `_aligned`)."""
    return backend.UInt32(_aligned(values, np.dtype(np.uint32)))


def _aligned(values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return a copy of a one-dimensional array, converted to the type `dtype`, whose memory begins
    at a multiple of _ALIGNMENT bytes and has at least _ALIGNMENT unused bytes after it.

    Dr.Jit uses the memory of a NumPy array in place, and NumPy's memory is aligned to the
    processor's vectors by chance only. Without alignment, Dr.Jit silently replaces packet gathers
    (eight numbers at once) by slower single gathers; and since a kernel depends on the alignment,
    the same work would compile another kernel.
    """
    size = values.size * dtype.itemsize
    memory = np.empty(size + 2 * _ALIGNMENT, np.uint8)
    # The distance from the start of the memory to the next multiple of the alignment.
    start = -memory.ctypes.data % _ALIGNMENT
    copy = memory[start : start + size].view(dtype)
    copy[:] = values
    return copy


def to_numpy(array: Any) -> npt.NDArray[Any]:
    """Copy a Dr.Jit array of n lanes into a NumPy array of shape (n,), or (n, k) for vectors of k
    components. Derivatives are dropped. A component with a single lane is repeated n times.

    Raises:
        TypeError: not a Dr.Jit array, or an array of vectors of vectors.
    """
    kind = _untyped_class(array)
    if not dr.is_array_v(kind) or dr.depth_v(kind) > 2:
        raise TypeError(f"expected a Dr.Jit array or vector, got {kind.__module__}.{kind.__name__}")
    array = dr.detach(array)
    if dr.depth_v(kind) == 1:
        return np.array(array.numpy())
    # Component by component: Dr.Jit's own conversion of vectors compiles a kernel for every n.
    dr.eval(array)
    return np.stack(np.broadcast_arrays(*(component.numpy() for component in array)), axis=-1)
