"""Enclosures: proofs of bounds of the movement of f along a path, for fields of any kind.

This package exports the parts that all proofs share. The proofs themselves are names of `harnack`,
which `harnack/__init__.pyi` lists.
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
