"""Enclosures: what is proved about f along a path. None of them knows a field by name.

This package exports what all proofs share. The proofs themselves are names of `harnack`, which
`harnack/__init__.pyi` lists.
"""

from __future__ import annotations

from harnack.enclosures.enclosure import Enclosure, Gaps, Slopes, TargetLevels
from harnack.enclosures.promises import (
    BoundedLaplacian,
    Curvature,
    HarmonicBall,
    Lipschitz,
    Promise,
)
from harnack.enclosures.selection import Choice, Proofs, any_covers, choose_proofs, longest_step
from harnack.name_suggestions import names_that_moved

__all__ = [
    "BoundedLaplacian",
    "Choice",
    "Curvature",
    "Enclosure",
    "Gaps",
    "HarmonicBall",
    "Lipschitz",
    "Promise",
    "Proofs",
    "Slopes",
    "TargetLevels",
    "any_covers",
    "choose_proofs",
    "longest_step",
]

__getattr__ = names_that_moved(__name__)
