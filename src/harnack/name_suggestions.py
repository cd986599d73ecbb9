"""Names in error messages: suggestions for a name that does not exist, which are the most similar
known names; and the article before a name."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar, cast

_Class = TypeVar("_Class", bound=type)

# A shorter text is no beginning of a word by which a name is found.
_SHORTEST_BEGINNING = 3


def is_one_of(name: object, names: Iterable[str]) -> bool:
    """Return whether a value is a string and one of the known names."""
    return isinstance(name, str) and name in names


def did_you_mean(misspelled: object, candidates: Iterable[str]) -> str:
    """Return the end of an error message about a misspelled name: '; did you mean "gold"?' for the
    most similar candidate; '' if no candidate is similar, or the name is not a string.

    Of candidates with dots, such as "parts.1.radius", one of which only some parts are given, the
    last among them, is similar. If no spelling is similar, it is a candidate that has a word which
    begins with the name: "tolerance" for "tol", "default_level" for "level".
    """
    import difflib  # imported here, for messages alone

    if not isinstance(misspelled, str):
        return ""
    name_of_lowercase = {name.lower(): name for name in candidates}
    # Comparing long texts takes long: the beginning suffices.
    text = misspelled[:100].lower()
    similar = (
        [name for name in name_of_lowercase if "." in name and _is_shortened(text, name)]
        or difflib.get_close_matches(text, name_of_lowercase, n=1)
        or sorted(filter(functools.partial(_begins_word, text), name_of_lowercase), key=len)
    )
    return f'; did you mean "{name_of_lowercase[similar[0]]}"?' if similar else ""


def _is_shortened(text: str, name: str) -> bool:
    """Return whether a text is a name with dots of which parts are left out, but not the last one:
    "parts.0.radius" for "parts.0.field.radius"."""
    parts, remaining = text.split("."), iter(name.split("."))
    # `in` takes entries from the iterator up to the one it finds.
    return name.endswith(f".{parts[-1]}") and all(part in remaining for part in parts)


def _begins_word(text: str, name: str) -> bool:
    """Return whether one of the words of a name begins with a text of at least three characters."""
    return len(text) >= _SHORTEST_BEGINNING and any(
        word.startswith(text) for word in re.split(r"[._ -]", name)
    )


def no_such_name(owner: str, kind: str, name: str, names: Sequence[str]) -> TypeError:
    """Return the error for a name that does not exist, with a suggestion and the list of names.

    owner: what has no such name, such as "a Sphere".
    kind: what is named, such as "parameter".
    names: the names that exist.
    """
    hint = did_you_mean(name, names)
    return TypeError(f"{owner} has no {kind} {name!r}{hint}; there are {', '.join(names)}")


def suggests_arguments(kind: _Class) -> _Class:
    """Decorator for a class. Its constructor, and so `dataclasses.replace`, then refuses keywords
    that are no arguments with a suggestion and the list of arguments. Python's error has none."""
    construct = cast("Any", kind).__init__
    names = [*inspect.signature(construct).parameters][1:]  # without self

    @functools.wraps(construct)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        """Check the names of the keywords, and construct the object."""
        for name in kwargs:
            if name not in names:
                raise no_such_name(kind.__name__, "argument", name, names)
        construct(self, *args, **kwargs)

    cast("Any", kind).__init__ = checked
    return kind


def with_article(name: str) -> str:
    """Return a name with the article before it: "a Sphere", "an Expression", "a Union", "an
    HRBF"."""
    if name[:2].isupper():  # spoken as letters
        has_vowel = name[0] in "AEFHILMNORSX"
    else:
        # Words that are written with a vowel and spoken with a consonant.
        is_consonant = name.lower().startswith(("uni", "eu", "one"))
        has_vowel = name[:1].lower() in tuple("aeiou") and not is_consonant
    return f"{'an' if has_vowel else 'a'} {name}"
