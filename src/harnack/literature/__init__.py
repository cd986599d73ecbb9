"""Methods of the literature, for comparison with those of the rest of harnack: published enclosures
of formulas, and what only these use, two arithmetics and a function of formulas. An enclosure
bounds how far a function can change along a ray, so that it proves steps.

No other part of the package imports this one. The option `enclosures` of verbs takes the classes,
or their names, such as "affine"; it imports this package when such a name is asked for.
"""

from __future__ import annotations

from harnack.literature.affine_forms import AffineForm
from harnack.literature.blob_kernel import ClippedPower, clipped_power
from harnack.literature.formula_enclosures import (
    AffineEnclosure,
    BottomUpLinearEnclosure,
    BottomUpQuadraticEnclosure,
    IntervalEnclosure,
    LongestOfEnclosure,
)
from harnack.literature.parabola_bounds import ParabolaBounds
from harnack.literature.taylor_forms import (
    LinearTaylorEnclosure,
    QuadraticTaylorEnclosure,
    SegmentTracingEnclosure,
)

__all__ = [
    "AffineEnclosure",
    "AffineForm",
    "BottomUpLinearEnclosure",
    "BottomUpQuadraticEnclosure",
    "ClippedPower",
    "IntervalEnclosure",
    "LinearTaylorEnclosure",
    "LongestOfEnclosure",
    "ParabolaBounds",
    "QuadraticTaylorEnclosure",
    "SegmentTracingEnclosure",
    "clipped_power",
]
