"""Objects as bytes to send, and names that say what is in them.

What an object has only computed and remembers is left out: it would be sent for nothing, and two
equal objects would differ. It is what `functools.cached_property` and a `Remembered` keep, and
fields of dataclasses that are not compared.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import io
import pickle
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeVar, cast

from harnack._version import __version__

Key = TypeVar("Key")
Value = TypeVar("Value")
# In the place of an attribute: none.
_LEFT_OUT = object()
# The newest protocol of the oldest Python that is supported.
_PROTOCOL = 5
_MISSING = (
    "{what} needs Dask, which is not installed: pip install 'harnack[cluster]', on each machine of "
    "the cluster in the same version"
)


def load_module(name: str, what: str) -> Any:
    """A module that the extra `cluster` brings.

    Raises:
        ModuleNotFoundError: it is not installed. The message says that `what` needs it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(_MISSING.format(what=what)) from error


class Remembered(dict[Key, Value]):
    """Results that an object keeps by what they were asked for; it is packed and copied empty."""

    def __reduce__(self) -> Any:
        return Remembered, ()


@dataclass(frozen=True)
class Packed:
    """An object as bytes. name: 32 hexadecimal digits, the same for what is made of the same
    numbers by the same version of this library."""

    name: str
    data: bytes

    @classmethod
    def of(cls, thing: Any, what: str) -> Packed:
        """Pack an object.

        Raises:
            ModuleNotFoundError: the extra `cluster` is not installed.
            TypeError: it cannot be packed. The messages begin with `what`.
        """
        return cls(name_of(thing, what), _bytes_of(thing, what, share=True))

    def open(self) -> Any:
        """The object. The same one as long as it is among the last that were opened here, so that
        what it has prepared is not prepared again."""
        return _opened(self)

    def __hash__(self) -> int:
        return hash(self.name)


@functools.lru_cache(maxsize=4)
def _opened(packed: Packed) -> Any:
    return pickle.loads(packed.data)


def name_of(thing: Any, what: str) -> str:
    """32 hexadecimal digits that depend on all that is in an object, and on this library's version.

    Each object is written out wherever it occurs, so that it does not matter which of several equal
    ones are the same object.

    Raises:
        ModuleNotFoundError, TypeError: as `Packed.of`.
    """
    try:
        data = _bytes_of(thing, what, share=False)
    except (RecursionError, TypeError, ValueError):  # an object that holds itself
        data = _bytes_of(thing, what, share=True)
    return hashlib.blake2b(__version__.encode() + data, digest_size=16).hexdigest()


def _bytes_of(thing: Any, what: str, *, share: bool) -> bytes:
    cloudpickle = load_module("cloudpickle", what)
    file = io.BytesIO()
    pickler = _pickler(cloudpickle.Pickler)(file, protocol=_PROTOCOL)
    pickler.fast = not share
    try:
        pickler.dump(thing)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise TypeError(
            f"{what}: it cannot be sent to another process or written down ({error}); make it of "
            "arrays, numbers and the classes of this library"
        ) from error
    return file.getvalue()


@functools.cache
def _pickler(base: Any) -> Callable[..., Any]:
    """cloudpickle's class, which knows functions too, without what objects remember."""

    class Lean(base):
        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, ModuleType) and sys.modules.get(obj.__name__) is obj:
                return importlib.import_module, (obj.__name__,)
            kind: type = obj.__class__
            remembered = _remembered(kind)
            if not remembered:
                return base.reducer_override(self, obj)
            make, arguments, state, *rest = (*obj.__reduce_ex__(_PROTOCOL), None)[:6]
            if isinstance(state, dict):
                given = cast("dict[str, Any]", state)
                state = {key: remembered.get(key, one) for key, one in given.items()}
                state = {key: one for key, one in state.items() if one is not _LEFT_OUT}
            return make, arguments, state, *rest[:3]

    return Lean


@functools.lru_cache(maxsize=1024)
def _remembered(kind: type) -> dict[str, Any]:
    """What to put in the place of attributes that objects of a class compute and remember."""
    found: dict[str, Any] = {
        name: _LEFT_OUT
        for one in kind.__mro__
        for name, value in vars(one).items()
        if isinstance(value, functools.cached_property)
    }
    if dataclasses.is_dataclass(kind):
        for one in dataclasses.fields(kind):
            if not one.compare and one.default is not dataclasses.MISSING:
                found[one.name] = one.default
    return found
