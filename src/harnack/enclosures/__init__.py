"""Enclosures: proofs of how far a function f can change along a path (a ray) from its value at a
sampled point. They prove lengths of the ray on which f takes none of given values, the levels.

This package exports what all proofs share. The classes of enclosures are in the modules
of this package, and those that users name also in `harnack.proofs`. Those of published
methods, which are there for comparison, are in a package of their own, `literature`.
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
