"""How a broken promise is reported."""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray

__all__ = ["BrokenPromiseError", "require"]


class BrokenPromiseError(AssertionError):
    """A field or a bound promised something that is not true; the message says what and where."""


def require(
    good: Any,
    message: str,
    points: FloatArray,
    amount: FloatArray | None = None,
    there: FloatArray | None = None,
) -> None:
    """Raise BrokenPromiseError for the worst of the points (n, 3) that are not good (n,).

    amount: (n,) how wrong. there: (n, 3) where it shows, if not at the point.
    """
    broken: BoolArray = ~np.asarray(good, dtype=np.bool_)
    bad = np.flatnonzero(broken)
    if not bad.size:
        return
    worst = bad[0] if amount is None else bad[np.abs(amount[bad]).argmax()]
    by = "" if amount is None else f" (by {amount[worst]:.3g})"
    where = "" if there is None else f", at {there[worst].tolist()}"
    raise BrokenPromiseError(
        f"{message}{by}: point {points[worst].tolist()}{where}; {bad.size} of {len(points)} points"
    )
