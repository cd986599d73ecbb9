"""Objects as bytes to send, and names that say what is in them.

What an object has only computed and remembers is left out: it would be sent for nothing, and two
equal objects would differ. It is what `functools.cached_property` and a `Remembered` keep, and
private fields of dataclasses that are not compared.

Functions and classes are sent by name if they are part of Python or of an installed package. Those
of users are sent themselves: a worker may lack their module, or have imported it before it was
changed. They are named by what they do, so that the same program, started again, finds what it
did: not by the lines on which they stand, nor by the numbers that cloudpickle gives them.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import importlib.metadata
import io
import os
import pickle
import re
import sys
import sysconfig
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

from harnack._version import __version__

Key = TypeVar("Key")
Value = TypeVar("Value")
# In the place of an attribute: none.
_LEFT_OUT = object()
# The newest protocol of the oldest Python that is supported.
_PROTOCOL = 5
# Bits of kernels and of pictures depend on these.
_PACKAGES = ("drjit", "mitsuba", "numpy")
# Names of files whose contents are code, which is sent itself.
_CODE = (".py", ".pyc", ".ipynb")
# Numbers that cloudpickle makes up for classes.
_MADE_UP = re.compile(r"[0-9a-f]{32}")
# cloudpickle's list of modules is one for all threads.
_BY_VALUE = threading.RLock()
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


@functools.cache
def packages() -> str:
    """Versions of this library and of those on which the bits of its results depend."""
    others = (f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    return ", ".join((f"harnack {__version__}", *others))


class Remembered(dict[Key, Value]):
    """Results that an object keeps by what they were asked for; it is packed and copied empty."""

    def __reduce__(self) -> Any:
        return Remembered, ()


@dataclass(frozen=True)
class Packed:
    """An object as bytes. name: 32 hexadecimal digits, the same for what is made of the same
    numbers by the same versions of this library and of `packages`. files: which it names, and
    what is in them. made_by: `packages` where it was packed."""

    name: str
    data: bytes
    files: tuple[tuple[str, str], ...] = ()
    made_by: str = ""

    @classmethod
    def of(cls, thing: Any, what: str) -> Packed:
        """Pack an object.

        Raises:
            ModuleNotFoundError: the extra `cluster` is not installed.
            TypeError: it cannot be packed. The messages begin with `what`.
        """
        name, files = _named(thing, what)
        return cls(name, _bytes_of(thing, what), tuple(sorted(files.items())), packages())

    def open(self) -> Any:
        """The object. The same one as long as it is among the last that were opened here, so that
        what it has prepared is not prepared again.

        Raises:
            RuntimeError: it was packed by other versions of packages than there are here.
            ValueError: a file that it names is another one here.
        """
        return _opened(self)

    def __hash__(self) -> int:
        return hash(self.name)


@functools.lru_cache(maxsize=4)
def _opened(packed: Packed) -> Any:
    if packed.made_by != packages():
        raise RuntimeError(
            f"this was sent by {packed.made_by}, and here is {packages()}: install the same on "
            "all machines"
        )
    for name, contents in packed.files:
        if _contents(name) != contents:
            raise ValueError(
                f"the file {name} is not here, or not as it was where it was named: put it on all "
                "machines under the same name, with the whole path"
            )
    return pickle.loads(packed.data)


def name_of(thing: Any, what: str) -> str:
    """32 hexadecimal digits that depend on all that is in an object and in the files that it names,
    and on the versions of `packages`.

    Each object is written out wherever it occurs, so that it does not matter which of several equal
    ones are the same object.

    Raises:
        ModuleNotFoundError, TypeError: as `Packed.of`.
    """
    return _named(thing, what)[0]


def _named(thing: Any, what: str) -> tuple[str, dict[str, str]]:
    """The name of an object, and a digest of each file that it names."""
    try:
        data, files = _words_of(thing, what, share=False)
    except (RecursionError, TypeError, ValueError):  # an object that holds itself
        data, files = _words_of(thing, what, share=True)
    return hashlib.blake2b(packages().encode() + data, digest_size=16).hexdigest(), files


def _bytes_of(thing: Any, what: str) -> bytes:
    file = io.BytesIO()
    _dump(_lean(_cloudpickle(what).Pickler)(file, protocol=_PROTOCOL), thing, what)
    return file.getvalue()


def _words_of(thing: Any, what: str, *, share: bool) -> tuple[bytes, dict[str, str]]:
    """Bytes that say what is in an object, to be compared and not to be read, and its files."""
    file = io.BytesIO()
    pickler = _naming(_cloudpickle(what).Pickler)(file, protocol=_PROTOCOL)
    files: dict[str, str] = {}
    pickler.what, pickler.files, pickler.begun, pickler.fast = what, files, {}, not share
    _dump(pickler, thing, what)
    return file.getvalue(), files


def _cloudpickle(what: str) -> Any:
    return load_module("cloudpickle", what)


def _dump(pickler: Any, thing: Any, what: str) -> None:
    try:
        with _users_code_by_value(_cloudpickle(what)):
            pickler.dump(thing)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise TypeError(
            f"{what}: it cannot be sent to another process or written down ({error}); make it of "
            "arrays, numbers and the classes of this library"
        ) from error


@contextmanager
def _users_code_by_value(cloudpickle: Any) -> Generator[None]:
    """Within, cloudpickle writes out functions and classes of modules that are not installed."""
    with _BY_VALUE:
        there = set(cloudpickle.list_registry_pickle_by_value())
        modules = [
            one
            for name, one in list(sys.modules.items())
            if getattr(one, "__name__", None) == name and name not in there
            and _is_users(name, getattr(one, "__file__", None))
        ]  # fmt: skip
        for one in modules:
            cloudpickle.register_pickle_by_value(one)
        try:
            yield
        finally:
            for one in modules:
                cloudpickle.unregister_pickle_by_value(one)


@functools.cache
def _is_users(name: str, file: str | None) -> bool:
    """Whether a module is neither a part of Python nor of an installed package or this one."""
    root = name.partition(".")[0]
    if file is None or root in sys.stdlib_module_names or root in ("__main__", "harnack"):
        return False
    path = Path(file).resolve()
    if {"site-packages", "dist-packages"} & set(path.parts):
        return False
    places = sysconfig.get_paths()
    return not any(
        path.is_relative_to(Path(places[one]).resolve())
        for one in ("stdlib", "platstdlib", "purelib", "platlib")
    )


def _contents(name: str) -> str | None:
    """A digest of what is in a file; None where there is none."""
    try:
        if not Path(name).is_file():  # pipes never end
            return None
        digest = hashlib.blake2b(digest_size=16)
        with open(name, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
        return digest.hexdigest()
    except (OSError, ValueError):
        return None


def _cached_property(function: Callable[..., Any], name: str) -> functools.cached_property[Any]:
    made = functools.cached_property(function)
    made.__set_name__(object, name)
    return made


@functools.cache
def _lean(base: Any) -> Callable[..., Any]:
    """cloudpickle's class, which knows functions too, without what objects remember."""

    class Lean(base):
        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, ModuleType) and sys.modules.get(obj.__name__) is obj:
                return importlib.import_module, (obj.__name__,)
            if isinstance(obj, functools.cached_property):  # which holds a lock in Python 3.11
                return _cached_property, (obj.func, obj.attrname)
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


@functools.cache
def _naming(base: Any) -> Callable[..., Any]:
    """The same without all that differs when a program is started again, and with what is in the
    files that are named."""
    lean: Any = _lean(base)

    class Naming(lean):
        what: str
        files: dict[str, str]
        begun: dict[int, tuple[Any, int]]

        def persistent_id(self, obj: Any) -> Any:
            kind = cast("type[Any]", type(obj))
            if id(obj) in self.begun:  # classes and functions may name themselves
                return f"number {self.begun[id(obj)][1]}"
            if kind is set or kind is frozenset:  # whose order differs
                members = cast("set[Any] | frozenset[Any]", obj)
                return kind.__name__, sorted(name_of(one, self.what) for one in members)
            if not isinstance(obj, str | os.PathLike):
                return None
            path = os.fsdecode(cast("str | os.PathLike[str]", obj))
            suffix = os.path.splitext(path)[1]
            if not suffix or suffix in _CODE or (contents := _contents(path)) is None:
                return None
            self.files[path] = contents
            return f"file {contents}"

        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, CodeType):
                return tuple, ([getattr(obj, one, None) for one in _SAID_BY_CODE],)
            found = lean.reducer_override(self, obj)
            if isinstance(obj, type | FunctionType) and isinstance(found, tuple):
                self.begun[id(obj)] = (obj, len(self.begun))
                _, arguments, *rest = cast("tuple[Any, ...]", found)
                return tuple, ([*(one for one in arguments if not _is_made_up(one)), *rest[:-1]],)
            return found

    return Naming


_SAID_BY_CODE = (
    "co_name", "co_code", "co_consts", "co_names", "co_varnames", "co_freevars", "co_cellvars",
    "co_argcount", "co_posonlyargcount", "co_kwonlyargcount", "co_flags", "co_exceptiontable",
)  # fmt: skip


def _is_made_up(argument: Any) -> bool:
    return isinstance(argument, str) and _MADE_UP.fullmatch(argument) is not None


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
            private = one.name.startswith("_")
            if private and not one.compare and one.default is not dataclasses.MISSING:
                found[one.name] = one.default
    return found
