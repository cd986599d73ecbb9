"""Names that users write: messages about names that do not exist, and about old ones."""

from __future__ import annotations

import difflib
import functools
import itertools
import sys
import warnings
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, cast

# Of likeness, from 0 to 1: below it, names are unlike. Names that begin alike are more so.
_ALIKE = 0.6
_PREFIX = 0.02

_T = TypeVar("_T", bound=Callable[..., Any])


def is_one_of(name: object, known: Iterable[str]) -> bool:
    """Whether something is one of the known names; nothing but a text is."""
    return isinstance(name, str) and name in known


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


def renamed(**new_names: str) -> Callable[[_T], _T]:
    """Has a function or a class take parameters by their old names too, with a DeprecationWarning.

    new_names: the new name of each old one. A class also keeps the attributes of the old names.
    """

    def decorate(target: _T) -> _T:
        if not isinstance(target, type):
            return cast("_T", _with_old_keywords(target, target.__name__, new_names))
        kind = cast("Any", target)
        kind.__init__ = _with_old_keywords(kind.__init__, kind.__name__, new_names)
        for old, new in new_names.items():
            get = functools.partial(_renamed_attribute, old=old, new=new)
            setattr(kind, old, property(get, doc=f"The old name of `{new}`."))
        return cast("_T", kind)

    return decorate


def _with_old_keywords(
    function: Callable[..., Any], name: str, new_names: dict[str, str]
) -> Callable[..., Any]:
    @functools.wraps(function)
    def general(*given: Any, **named: Any) -> Any:
        for old in new_names.keys() & named.keys():
            new = new_names[old]
            if new in named:
                raise TypeError(f"{name} was given {old} and {new}, which are the same")
            _warn_of_old(f"{name}({old}=...)", new)
            named[new] = named.pop(old)
        return function(*given, **named)

    return general


def _renamed_attribute(owner: Any, *, old: str, new: str) -> Any:
    _warn_of_old(f"{type(owner).__name__}.{old}", new)
    return getattr(owner, new)


def _warn_of_old(old: str, new: str) -> None:
    message = f"{old} is now called {new}; the old name will be removed in a later version"
    warnings.warn(message, DeprecationWarning, stacklevel=3)


def names_that_moved(subpackage: str) -> Callable[[str], Any]:
    """The `__getattr__` of a subpackage whose fields or proofs are names of `harnack` alone."""

    package: Any = sys.modules[subpackage.partition(".")[0]]

    def getattr_(name: str) -> Any:
        if name.startswith("_") or name not in package.__all__:
            raise AttributeError(f"module {subpackage!r} has no attribute {name!r}")
        _warn_of_old(f"{subpackage}.{name}", f"harnack.{name}")
        return getattr(package, name)

    return getattr_
