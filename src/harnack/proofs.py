"""Namespace for fields of one's own. It has the promises (proved bounds of a field's function f
near a point) and the enclosures (intervals, proved to contain the change of f along a ray) that
follow from promises."""

from __future__ import annotations

from harnack.enclosures import choose_enclosures
from harnack.enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from harnack.enclosures.enclosure import Enclosure, LevelGaps
from harnack.enclosures.harmonic_ball import (
    HarnackEnclosure,
    HarnackSlopeEnclosure,
    SphericalCapEnclosure,
)
from harnack.enclosures.parabola import LipschitzEnclosure, ParabolaEnclosure, TaylorEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.promises import BoundedLaplacian, HarmonicBall, Lipschitz, TaylorRemainder
from harnack.fields.field import Sample

__all__ = [
    "BoundedLaplacian",
    "BoundedLaplacianEnclosure",
    "Enclosure",
    "HarmonicBall",
    "HarnackEnclosure",
    "HarnackSlopeEnclosure",
    "LevelGaps",
    "Lipschitz",
    "LipschitzEnclosure",
    "ParabolaEnclosure",
    "PiecewiseTaylorEnclosure",
    "Sample",
    "SphericalCapEnclosure",
    "TaylorEnclosure",
    "TaylorRemainder",
    "choose_enclosures",
]
