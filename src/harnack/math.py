"""Functions for formulas: sin, sqrt, norm and others. They take numbers, arrays, and coordinates
with proved ranges. A Python function that is passed to `harnack.expression` uses them in place of
NumPy's."""

from __future__ import annotations

from harnack.arithmetic import (
    absolute,
    acos,
    asin,
    atan,
    atan2,
    cos,
    cosh,
    exp,
    log,
    maximum,
    minimum,
    norm,
    sin,
    sinh,
    sqrt,
    tan,
    tanh,
)

__all__ = [
    "absolute",
    "acos",
    "asin",
    "atan",
    "atan2",
    "cos",
    "cosh",
    "exp",
    "log",
    "maximum",
    "minimum",
    "norm",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
]
