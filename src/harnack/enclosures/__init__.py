"""Enclosures: proofs of how far a function f can change along a path (a ray) from its value at a
sampled point. They prove lengths of the ray on which f takes none of given values, the levels.

This package exports what all proofs share. The proofs themselves, the classes of enclosures, are
names of `harnack`; `harnack/__init__.pyi` lists them.
"""

from __future__ import annotations

from harnack.enclosures.enclosure import Enclosure, LevelGaps, Levels, SlopeRange
from harnack.enclosures.promises import (
    BoundedLaplacian,
    HarmonicBall,
    Lipschitz,
    Promise,
    TaylorRemainder,
)
from harnack.enclosures.selection import (
    EnclosureChoice,
    EnclosureKinds,
    any_is_free,
    choose_enclosures,
    longest_free_length,
)

__all__ = [
    "BoundedLaplacian",
    "Enclosure",
    "EnclosureChoice",
    "EnclosureKinds",
    "HarmonicBall",
    "LevelGaps",
    "Levels",
    "Lipschitz",
    "Promise",
    "SlopeRange",
    "TaylorRemainder",
    "any_is_free",
    "choose_enclosures",
    "longest_free_length",
]
