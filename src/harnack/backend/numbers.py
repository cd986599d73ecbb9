"""NumPy arrays of numbers that a caller gives: their types, and the checks that all of them pass.

Each check raises the error class of whoever asks, in one wording. Counts and units, which differ
between curves, meshes and clouds, are checked where those are.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

TRANSPOSE = "; transpose it"
"""Advice of `check_vectors` where an array (3, n) surely holds n vectors."""

LARGEST = 1e100
"""Coordinates beyond this are refused: their squares would overflow soon."""


def real_array(
    values: Any,
    name: str,
    error: type[Exception] = ValueError,
    *,
    type_error: type[Exception] | None = None,
    ragged: str = "must be a rectangular array of numbers, not ragged",
    other: str = "must hold real numbers",
) -> npt.NDArray[Any]:
    """The values as an array of integers or floats, which may be the array given itself.

    type_error: raised for what is no real number, if not `error`.
    ragged, other: what messages say, behind `name`, of rows of different lengths and of what is no
        real number.
    """
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
    """That an array has shape (n, 3). planar, transposed: advice for shapes (n, 2) and (3, n)."""
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
    """That all numbers of an array (n, k) are finite. name: of a row, with {} for its index."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise error(
            f"{name.format(bad[0])} is {vector_text(rows[bad[0]])}{and_more(bad.size)}: {advice}"
        )


def check_size(x: FloatArray, error: type[Exception]) -> None:
    """That no coordinate is larger than `LARGEST`."""
    if (size := float(np.abs(x).max(initial=0.0))) > LARGEST:
        raise error(f"coordinates up to {size:g} are too large: choose units nearer to 1")


def vector_text(row: FloatArray) -> str:
    """A vector as messages show it: (1, 2, 3)."""
    return "(" + ", ".join(f"{v:g}" for v in row) + ")"


def and_more(count: int) -> str:
    """What a message about the first of `count` entries says of the others."""
    return f" (and {count - 1:,} more)" if count > 1 else ""
