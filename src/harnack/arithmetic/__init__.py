"""Arithmetic of functions along a path: numbers that carry proved ranges. No fields, no proofs."""

from __future__ import annotations

from harnack.arithmetic.functions import (
    Function,
    absolute,
    acos,
    asin,
    atan,
    cos,
    cosh,
    exp,
    log,
    power,
    reciprocal,
    sin,
    sinh,
    sqrt,
    tan,
    tanh,
)
from harnack.arithmetic.interval import ONE, ZERO, Interval
from harnack.arithmetic.jet import Jet
from harnack.arithmetic.norms import maximum, minimum, norm

__all__ = [
    "ONE",
    "ZERO",
    "Function",
    "Interval",
    "Jet",
    "absolute",
    "acos",
    "asin",
    "atan",
    "cos",
    "cosh",
    "exp",
    "log",
    "maximum",
    "minimum",
    "norm",
    "power",
    "reciprocal",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
]
