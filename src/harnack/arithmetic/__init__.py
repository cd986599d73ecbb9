"""Arithmetic of functions along a path: numbers that carry proved ranges, intervals that contain
all values of a function. A path is a piece of a ray. There are intervals, jets (ranges of values
and derivatives), parabolas and affine forms (lines with an error). A formula is written once and
evaluated with any of them."""

from __future__ import annotations

from harnack.arithmetic.affine import AffineForm
from harnack.arithmetic.angles import atan2
from harnack.arithmetic.functions import (
    ClippedPower,
    ElementaryFunction,
    absolute,
    acos,
    asin,
    atan,
    clipped_power,
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
from harnack.arithmetic.parabola_bounds import ParabolaBounds
from harnack.arithmetic.values import Values

__all__ = [
    "ONE",
    "ZERO",
    "AffineForm",
    "ClippedPower",
    "ElementaryFunction",
    "Interval",
    "Jet",
    "ParabolaBounds",
    "Values",
    "absolute",
    "acos",
    "asin",
    "atan",
    "atan2",
    "blend_intersection",
    "blend_union",
    "clipped_power",
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
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
]
