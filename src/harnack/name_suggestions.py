"""Suggestions of names in error messages: for a name that does not exist, the most similar known
name."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

# Names are similar from this similarity on (0 to 1); each letter of a common prefix adds a bonus.
_MIN_SIMILARITY = 0.6
_COMMON_PREFIX_BONUS = 0.02


def is_one_of(name: object, names: Iterable[str]) -> bool:
    """Return whether a value is a string and one of the known names."""
    return isinstance(name, str) and name in names


def did_you_mean(misspelled: object, candidates: Iterable[str]) -> str:
    """Return the end of an error message about a misspelled name: '; did you mean "gold"?' for the
    most similar candidate; '' if no candidate is similar, or the name is not a string."""
    if not isinstance(misspelled, str):
        return ""
    word = misspelled[:100].lower()
    likeness = {name: _likeness(word, name.lower()) for name in candidates}
    best = max(likeness, key=lambda name: likeness[name], default="")
    return f'; did you mean "{best}"?' if likeness.get(best, 0.0) >= _MIN_SIMILARITY else ""


def _likeness(a: str, b: str) -> float:
    """Return the similarity of two strings: difflib's ratio (0 to 1), and a bonus for each letter
    of their common prefix."""
    alike = (x == y for x, y in zip(a, b, strict=False))
    prefix = sum(itertools.takewhile(bool, alike))
    return difflib.SequenceMatcher(None, a, b).ratio() + _COMMON_PREFIX_BONUS * prefix
