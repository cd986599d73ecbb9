"""Names that users choose from: what to say of one that there is not."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

# Of likeness, from 0 to 1: below it, names are unlike. Names that begin alike are more so.
_ALIKE = 0.6
_PREFIX = 0.02


def did_you_mean(given: object, known: Iterable[str]) -> str:
    """'; did you mean "gold"?' for the known name most like the given one, '' if none is."""
    if not isinstance(given, str):
        return ""
    word = given[:100].lower()
    likeness = {name: _likeness(word, name.lower()) for name in known}
    best = max(likeness, key=lambda name: likeness[name], default="")
    return f'; did you mean "{best}"?' if likeness.get(best, 0.0) >= _ALIKE else ""


def _likeness(a: str, b: str) -> float:
    alike = (x == y for x, y in zip(a, b, strict=False))
    prefix = sum(itertools.takewhile(bool, alike))
    return difflib.SequenceMatcher(None, a, b).ratio() + _PREFIX * prefix
