"""Functions of formulas: sin, sqrt, norm and others, of numbers, of arrays and of coordinates with
proved ranges. A formula in Python, for `harnack.expression`, uses these in place of NumPy's."""

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
