"""Arithmetic of functions along a path: numbers that carry proved ranges, intervals that contain
all values of a function. A path is a piece of a ray. There are intervals and jets (ranges of values
and derivatives). A formula is written once and evaluated with any of them."""

from __future__ import annotations

from harnack.arithmetic.angles import atan2
from harnack.arithmetic.functions import (
    ElementaryFunction,
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
from harnack.arithmetic.norms import (
    blend_intersection,
    blend_union,
    maximum,
    minimum,
    norm,
    orthogonal_intersection,
)
from harnack.arithmetic.segments import cone_distance, segment_distance
from harnack.arithmetic.values import Values

__all__ = [
    "ONE",
    "ZERO",
    "ElementaryFunction",
    "Interval",
    "Jet",
    "Values",
    "absolute",
    "acos",
    "asin",
    "atan",
    "atan2",
    "blend_intersection",
    "blend_union",
    "cone_distance",
    "cos",
    "cosh",
    "exp",
    "log",
    "maximum",
    "minimum",
    "norm",
    "orthogonal_intersection",
    "power",
    "reciprocal",
    "segment_distance",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
]
