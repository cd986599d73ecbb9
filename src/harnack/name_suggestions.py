"""Suggestions of names in error messages: for a name that does not exist, the most similar known
name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def is_one_of(name: object, names: Iterable[str]) -> bool:
    """Return whether a value is a string and one of the known names."""
    return isinstance(name, str) and name in names


def did_you_mean(misspelled: object, candidates: Iterable[str]) -> str:
    """Return the end of an error message about a misspelled name: '; did you mean "gold"?' for the
    most similar candidate; '' if no candidate is similar, or the name is not a string."""
    if not isinstance(misspelled, str):
        return ""
    name_of_lowercase = {name.lower(): name for name in candidates}
    # Comparing long texts takes long: the beginning suffices.
    similar = difflib.get_close_matches(misspelled[:100].lower(), name_of_lowercase, n=1)
    return f'; did you mean "{name_of_lowercase[similar[0]]}"?' if similar else ""
