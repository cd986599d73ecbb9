"""Turns objects into bytes that can be sent to other processes (pickles), and computes hashes of
their contents. A "pickler" is an object that writes such bytes. To "rebuild" an object is to make
it from them. A user's module is one that is neither a part of Python nor of an installed package.
"Words" are the identifiers and strings in users' code; an attribute of a user's module is sent only
if its name is among them.

Cached values are left out: sending them would be useless, and they would give equal objects
different hashes. Cached values are those of `functools.cached_property` and of a `TransientCache`,
and private fields of dataclasses that are not compared.

Functions and classes of Python and of installed packages are sent by name. Functions and classes of
users are sent by value, together with the attributes of users' modules that they use
(`users_code.py`). The hash of such a function depends on what it does, but neither on its line
numbers nor on the ids that cloudpickle generates for classes. So a program that is started again
finds its stored results. These ids are not sent either: if they were, deserializing an object in
the same process would replace the methods of its classes.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import io
import os
import pickle
import re
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

from harnack._version import __version__
from harnack.cluster.users_code import (
    Namespace,
    attributes_named,
    compiled_file,
    fill,
    function_in,
    installed_version,
    is_sent_itself,
    itself,
    refuse_imports_within,
    words_of,
)
from harnack.optional_packages import import_optional

Key = TypeVar("Key")
Value = TypeVar("Value")
# Replaces the value of an attribute that is left out.
_OMIT = object()
# The newest protocol of the oldest Python that is supported.
_PROTOCOL = 5
# Packages on which the bits of kernels and pictures depend.
_PACKAGES = ("drjit", "mitsuba", "numpy")
# Suffixes of files that contain code; such code is sent by value, and not compared as a file.
_CODE_SUFFIXES = (".py", ".pyc", ".ipynb")
# The ids that cloudpickle generates for classes.
_GENERATED_ID = re.compile(r"[0-9a-f]{32}")
# cloudpickle's list of modules is one for all threads.
_REGISTRY_LOCK = threading.RLock()
_MISSING_MESSAGE = (
    "{feature} needs Dask, which is not installed: pip install 'harnack[cluster]', on each machine "
    "of the cluster in the same version"
)


def import_cluster_package(name: str, feature: str) -> Any:
    """Import a module that the extra `cluster` of this package installs.

    feature: the feature that needs it, for the message.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    return import_optional(name, _MISSING_MESSAGE.format(feature=feature))


@functools.cache
def package_versions() -> str:
    """Return the versions, as one text, of this library and of the libraries on which the bits of
    its results depend."""
    import importlib.metadata  # imported here, as it takes time that few programs need

    versions = (f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)
    return ", ".join((f"harnack {__version__}", *versions))


class TransientCache(dict[Key, Value]):
    """A dictionary in which an object caches computed values, as long as it lives: a
    `functools.cached_property` for each key. It is empty in copies and pickles of the object."""

    def get_or_make(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of a key; without one, that of `make()`, which is then kept."""
        if key not in self:
            self[key] = make()
        return self[key]

    def __reduce__(self) -> Any:
        """Return how pickle rebuilds the cache: as an empty one."""
        return TransientCache, ()


@dataclass(frozen=True)
class SerializedObject:
    """An object as bytes (a pickle), with what is needed to check on another machine that it means
    the same there.

    content_hash: 32 hexadecimal digits, equal for equal contents and equal versions of this
        library, of `package_versions` and of `other_versions`.
    data: the pickle.
    file_digests: for each file that the object names, its path and the hash of its contents.
    package_versions: the versions in the process that pickled the object; `deserialize` refuses
        others.
    other_versions: (name, version) of the other installed packages that the object uses.
    """

    content_hash: str
    data: bytes
    file_digests: tuple[tuple[str, str], ...] = ()
    package_versions: str = ""
    other_versions: tuple[tuple[str, str], ...] = ()

    @classmethod
    def serialize(cls, thing: Any, label: str) -> SerializedObject:
        """Pickle an object. label: what the object is; messages begin with it.

        Raises:
            ModuleNotFoundError: the extra `cluster` is not installed.
            TypeError: the object cannot be pickled.
        """
        hash_text, pickler = _hash_and_files(thing, label)
        # What is sent is another pickle than the one that is hashed.
        data = _pickle(_make_cacheless_pickler, thing, label).file.getvalue()
        files, other_versions = (
            sorted(pickler.files.items()),
            sorted(pickler.other_versions.items()),
        )
        return cls(hash_text, data, tuple(files), package_versions(), tuple(other_versions))

    def deserialize(self) -> Any:
        """Unpickle the object. The four objects that were deserialized last in this process are
        kept, and the same object is returned for the same contents, so that what it has cached is
        used again.

        Raises:
            RuntimeError: the object was pickled with other versions of packages than are installed
                here.
            ValueError: a file that it names has other contents here.
        """
        return _deserialize_cached(self)

    def __hash__(self) -> int:
        return hash(self.content_hash)


@functools.lru_cache(maxsize=4)
def _deserialize_cached(packed: SerializedObject) -> Any:
    """Unpickle an object after checks of versions and files (see `SerializedObject.deserialize`).
    The cache of this function holds the four objects that were deserialized last."""
    sent = [
        packed.package_versions,
        *(f"{name} {version}" for name, version in packed.other_versions),
    ]
    local = [
        package_versions(),
        *(f"{name} {installed_version(name)}" for name, _ in packed.other_versions),
    ]
    if sent != local:
        raise RuntimeError(
            f"this was sent by {', '.join(sent)}, and here is {', '.join(local)}: install the same "
            "on all machines"
        )
    for name, expected in packed.file_digests:
        digest = _file_digest(name)
        # A plain word that named a file there may be no file here: it need not be meant as one.
        if digest != expected and not (digest is None and name.isidentifier()):
            raise ValueError(
                f"the file {name} is not here, or not as it was where it was named: put it on all "
                "machines under the same name, with the whole path"
            )
    return pickle.loads(packed.data)


def content_hash(thing: Any, label: str) -> str:
    """Return a hash of 32 hexadecimal digits that depends on everything an object contains, on the
    contents of the files that it names, and on `package_versions`. label: what the object is, for
    messages.

    Equal parts of the object are written out at each place, so that the hash does not depend on
    whether they are the same Python object.

    Raises:
        ModuleNotFoundError: the extra `cluster` is not installed.
        TypeError: the object cannot be pickled.
    """
    return _hash_and_files(thing, label)[0]


def _hash_and_files(
    value: Any, label: str, identifiers: frozenset[str] = frozenset()
) -> tuple[str, Any]:
    """Return the content hash of a value, and the pickler that wrote it. The pickler has noted the
    hashes of the files (`files`) and the versions of the packages (`other_versions`) that the value
    uses.

    label: what the value is, for messages.
    identifiers: identifiers in users' code that are known already; they select the attributes of
        users' modules that are written.
    """
    # The fast way writes equal parts at each place, so it fails for an object that contains itself.
    # The other way writes a reference for a part that was written before.
    try:
        pickler = _pickle(_make_hashing_pickler, value, label, identifiers, fast=True)
    except (RecursionError, TypeError, ValueError):  # an object that contains itself
        pickler = _pickle(_make_hashing_pickler, value, label, identifiers)
    data = (
        f"{package_versions()} {sorted(pickler.other_versions.items())}".encode()
        + pickler.file.getvalue()
    )
    return hashlib.blake2b(data, digest_size=16).hexdigest(), pickler


def _pickle(
    make_class: Callable[[Any], Any], value: Any, label: str,
    identifiers: frozenset[str] = frozenset(), *, fast: bool = False,
) -> Any:  # fmt: skip
    """Write a value into the buffer `file` of a new pickler, and return the pickler.

    make_class: makes the class of the pickler from cloudpickle's class `Pickler`.
    label: what the value is, for messages.
    identifiers: identifiers in users' code that are known already.
    fast: whether to write equal parts of the value at each place, without references between them.

    An attribute of a user's module is written if its name is an identifier in the users' code that
    is written; all identifiers are known only at the end. So the value is written again until no
    attribute is missing. This ends, since the code has finitely many identifiers.

    Raises:
        TypeError: the value cannot be pickled.
    """
    cloudpickle = import_cluster_package("cloudpickle", label)
    while True:
        pickler = make_class(cloudpickle.Pickler)(label, identifiers)
        pickler.fast = fast
        try:
            pickler.dump(value)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise TypeError(
                f"{label}: it cannot be sent to another process or written down ({error}); make it "
                "of arrays, numbers and the classes of this library"
            ) from error
        identifiers = frozenset(pickler.words)
        # The pickler is complete if no module has further attributes whose names are words now. A
        # pair is a module and the words that were known when it was written.
        if all(len(attributes_named(*pair)) == len(attributes_named(pair[0], identifiers))
               for pair in pickler.modules):  # fmt: skip
            return pickler


def _by_value(definition: Any, reduce: Callable[[Any], Any]) -> Any:
    """Return how pickle rebuilds a function, class or type variable: the result of cloudpickle's
    function `reduce`. If the definition is in a user's module, the result describes its contents;
    otherwise its name."""
    module = sys.modules.get(str(getattr(definition, "__module__", None)))
    if module is None or not is_sent_itself(module):
        return reduce(definition)
    with _REGISTRY_LOCK:
        cloudpickle = import_cluster_package("cloudpickle", "to send code")
        # cloudpickle describes the contents of definitions in the modules on its list.
        was_listed = module.__name__ in cloudpickle.list_registry_pickle_by_value()
        cloudpickle.register_pickle_by_value(module)
        try:
            return reduce(definition)
        finally:
            if not was_listed:
                cloudpickle.unregister_pickle_by_value(module)


def _file_digest(name: str) -> str | None:
    """Return a hash of the contents of the file with this name, as text; None if there is no such
    file."""
    try:
        if not Path(name).is_file():  # pipes never end
            return None
        digest = hashlib.blake2b(digest_size=16)
        with open(name, "rb") as file:
            # In blocks of a megabyte.
            while block := file.read(1 << 20):
                digest.update(block)
        return digest.hexdigest()
    except (OSError, ValueError):
        return None


def _cached_property(function: Callable[..., Any], name: str) -> functools.cached_property[Any]:
    """Make a cached property from its function and its name. Pickle calls this to rebuild one."""
    cached = functools.cached_property(function)
    cached.__set_name__(object, name)
    return cached


def _cached_function(function: Callable[..., Any], settings: dict[str, Any]) -> Any:
    """Make a function with an empty cache. Pickle calls this to rebuild one. settings: arguments of
    `functools.lru_cache`."""
    return functools.lru_cache(**settings)(function)


_CachedFunction = type(functools.cache(_cached_property))


@functools.cache
def _make_cacheless_pickler(base: Any) -> Callable[..., Any]:
    """Make a subclass of cloudpickle's class Pickler (`base`) that leaves out cached values (see
    the module's docstring) and pickles users' code by value.

    Attributes of its instances:

    file: the buffer to which it writes.
    label: what the pickled object is, for messages.
    words: identifiers and strings that occur in the users' code pickled so far.
    modules: for each user's module pickled so far, the module and the words known when it was
        pickled, which decided which of its attributes were written.
    spaces: the objects that stand for the global names of modules, by the id of the module's
        dictionary.
    """

    class CachelessPickler(base):
        """A pickler that leaves out cached values and writes users' code by value. It writes into
        the attribute `file`. context: what the pickled object is, for messages; it becomes the
        attribute `label`. words: identifiers in users' code that are known already."""

        def __init__(self, context: str, words: frozenset[str]) -> None:
            self.file = io.BytesIO()
            super().__init__(self.file, protocol=_PROTOCOL)
            self.label = context
            self.words = set(words)
            self.modules: list[tuple[ModuleType, frozenset[str]]] = []
            self.spaces: dict[int, Namespace] = {}

        def reducer_override(self, obj: Any) -> Any:
            """Return how an object is rebuilt: a function, its arguments and a state without cached
            values, as `pickle.Pickler.reducer_override` returns it; NotImplemented to pickle the
            object as usual."""
            if isinstance(obj, ModuleType):
                return self.of_module(obj)
            if isinstance(obj, functools.cached_property):  # which holds a lock in Python 3.11
                return _cached_property, (obj.func, obj.attrname)
            reduce = functools.partial(base.reducer_override, self)
            if isinstance(obj, TypeVar):
                return _without_generated_id(_by_value(obj, base.dispatch_table[TypeVar]))
            if isinstance(obj, type):
                return _without_generated_id(_by_value(obj, reduce))
            if isinstance(obj, FunctionType):
                return self.of_function(obj, _by_value(obj, reduce))
            obj_type: type = obj.__class__
            transient = _transient_attributes(obj_type)
            if not transient:
                return _refuse_user_names(obj)
            # Replace cached values in the state by their defaults, or leave them out. A reduce
            # value has two to six entries; a missing state counts as None.
            constructor, arguments, state, *rest = (*obj.__reduce_ex__(_PROTOCOL), None)[:6]
            if isinstance(state, dict):
                state_attributes = cast("dict[str, Any]", state)
                state = {key: transient.get(key, value) for key, value in state_attributes.items()}
                state = {key: value for key, value in state.items() if value is not _OMIT}
            return constructor, arguments, state, *rest[:3]

        def of_module(self, module: ModuleType) -> Any:
            """Return how a module is rebuilt: by its name; or, if it is a user's module, as a new
            module with those of its attributes whose names are among the words."""
            if not is_sent_itself(module):
                return importlib.import_module, (module.__name__,)
            words = frozenset(self.words)
            self.modules.append((module, words))
            attributes = attributes_named(module, words)
            left_out = frozenset(vars(module)) - frozenset(attributes)
            # Pickle's form: a function, its arguments, the state, no items of lists and of
            # dictionaries, and the function that sets the state.
            return itself, (self.space(vars(module)),), (attributes, left_out), None, None, fill

        def of_function(self, function: FunctionType, reduced: Any) -> Any:
            """Return how a user's function is rebuilt, with its global names looked up in its
            rebuilt module. Its identifiers and strings are added to the words.

            reduced: how cloudpickle rebuilds it; returned unchanged if that is by name only.
            """
            if not isinstance(reduced, tuple):
                return reduced
            refuse_imports_within(function)
            self.words |= words_of(function)
            # cloudpickle describes a function by a constructor, its arguments, and `rest`: a state,
            # and what sets the state. Of the arguments, code and closure are kept. In place of
            # cloudpickle's dictionary of globals, the function gets that of its rebuilt module,
            # into which the state then sets the globals that it names.
            _, (code, _, _, _, closure), *rest = cast("tuple[Any, ...]", reduced)
            return function_in, (self.space(function.__globals__), code, closure), *rest

        def space(self, names: dict[str, Any]) -> Namespace:
            """Return the `Namespace` that stands for the global names of a module in the pickle. It
            is the same object at each call for the same module, so that all functions of the module
            share their global names after unpickling.

            names: the dictionary of the module, `vars(module)`.
            """
            return self.spaces.setdefault(id(names), Namespace.of(names))

    return CachelessPickler


def _without_generated_id(reduced: Any) -> Any:
    """Return cloudpickle's description of how a class is rebuilt, without the id that cloudpickle
    generated for the class. By this id cloudpickle would find a class that it rebuilt before, and
    replace the methods of that class. reduced: the description."""
    if not isinstance(reduced, tuple):
        return reduced
    constructor, arguments, *rest = cast("tuple[Any, ...]", reduced)
    return (
        constructor,
        tuple(None if _is_generated_id(argument) else argument for argument in arguments),
        *rest,
    )


def _refuse_user_names(obj: Any) -> Any:
    """Return how to rebuild an object that pickle would describe only by its name in a user's
    module. A cached function is rebuilt from its contents. The result is NotImplemented for all
    other objects, which are pickled as usual.

    Raises:
        TypeError: the contents cannot be determined.
    """
    module = sys.modules.get(str(getattr(obj, "__module__", None)))
    if module is None or not hasattr(obj, "__qualname__") or not is_sent_itself(module):
        return NotImplemented
    if isinstance(obj, _CachedFunction):
        return _cached_function, (obj.__wrapped__, obj.cache_parameters())
    if isinstance(obj.__reduce_ex__(_PROTOCOL), str):
        raise TypeError(
            f"{obj.__qualname__} of your module {module.__name__} can be sent by its name only, "
            "which does not tell what it does"
        )
    return NotImplemented


@functools.cache
def _make_hashing_pickler(base: Any) -> Callable[..., Any]:
    """Make a pickler class whose output is only hashed. It leaves out everything that changes from
    run to run (line numbers, generated ids, the order of sets), and adds a hash of each file that a
    string or a path names. base: cloudpickle's class Pickler.

    Attributes of its instances besides those of `_make_cacheless_pickler`:

    files: the hash of each file by its path.
    other_versions: the versions of the installed packages that are used, by name.
    begun: the functions, classes and modules whose writing has begun: by the id of each, the object
        itself and its number in the order in which they were begun.
    """
    base_pickler: Any = _make_cacheless_pickler(base)

    class HashingPickler(base_pickler):
        """A pickler whose output is only hashed. context: what the pickled object is, for messages;
        it becomes the attribute `label`. words: identifiers in users' code that are known already.
        """

        def __init__(self, context: str, words: frozenset[str]) -> None:
            super().__init__(context, words)
            self.files: dict[str, str] = {}
            self.other_versions: dict[str, str] = {}
            self.begun: dict[int, tuple[Any, int]] = {}

        def persistent_id(self, obj: Any) -> Any:
            """Return a value to write in place of the object, or None to pickle the object as
            usual. Pickle calls this for each object.

            A function, class or module whose writing has begun is replaced by its number, as it may
            refer to itself. A set is replaced by the sorted hashes of its members, since its order
            changes from run to run. The name of a file is replaced by a hash of the file.
            """
            obj_type = cast("type[Any]", type(obj))
            # Classes, functions and modules may name themselves. An entry is (object, number).
            if id(obj) in self.begun:
                return f"number {self.begun[id(obj)][1]}"
            if obj_type is set or obj_type is frozenset:  # whose order differs
                members = cast("set[Any] | frozenset[Any]", obj)
                words = frozenset(cast("set[str]", self.words))
                hashed = [_hash_and_files(member, self.label, words) for member in members]
                for _, pickler in hashed:
                    self.words |= pickler.words
                    self.modules += pickler.modules
                    self.files |= pickler.files
                    self.other_versions |= pickler.other_versions
                return obj_type.__name__, sorted(name for name, _ in hashed)
            return self.of_file(obj) if isinstance(obj, str | os.PathLike) else None

        def of_file(self, obj: Any) -> str | None:
            """Return the text "file" and a hash of the contents, if the object is the name or path
            of an existing file; None for a file of code and for any other string. The hash is noted
            in `files`."""
            path = os.fsdecode(cast("str | os.PathLike[str]", obj))
            if path.endswith(_CODE_SUFFIXES) or (contents := _file_digest(path)) is None:
                return None
            self.files[path] = contents
            return f"file {contents}"

        def reducer_override(self, obj: Any) -> Any:
            """Describe an object in the form of pickle's reduce values (function, arguments,
            state). The description needs to determine only the contents, as the object is never
            rebuilt from it."""
            if obj is tuple:  # the descriptions below begin with it
                return NotImplemented
            if isinstance(obj, CodeType):
                values = [getattr(obj, attribute, None) for attribute in _CODE_ATTRIBUTES]
                return tuple, ([obj.co_consts, repr(values).encode()],)
            if isinstance(obj, functools.cached_property):
                return tuple, ([obj.func],)
            self.note_origin(obj)
            reduced = base_pickler.reducer_override(self, obj)
            is_code = isinstance(obj, type | FunctionType | ModuleType)
            # What pickle would do as usual is asked for here, unless cloudpickle has a function for
            # the type (in `dispatch_table`); a definition is described by its name.
            if reduced is NotImplemented and type(obj) not in base.dispatch_table:
                reduced = obj.__qualname__ if is_code else obj.__reduce_ex__(_PROTOCOL)
            # An object that is described by its name only.
            if isinstance(reduced, str):
                return tuple, ([str(getattr(obj, "__module__", None)).encode(), reduced.encode()],)
            # A description without a state (the third entry) holds no names of attributes.
            if not isinstance(reduced, tuple) or len(cast("tuple[Any, ...]", reduced)) < 3:
                return cast("Any", reduced)
            constructor, arguments, state, *rest = cast("tuple[Any, ...]", reduced)
            if isinstance(obj, ModuleType):  # names of attributes that were not sent have no effect
                state, _ = state
            state = _with_encoded_keys(state)
            if is_code:
                # From here on the object is written as a number where it occurs again.
                self.begun[id(obj)] = (obj, len(self.begun))
                return tuple, ([*map(_encoded, arguments), state],)
            return constructor, arguments, state, *rest

        def note_origin(self, obj: Any) -> None:
            """Note which code defines an object: the version of its installed package (in
            `other_versions`), or the hash of its compiled file (in `files`)."""
            name = obj.__name__ if isinstance(obj, ModuleType) else getattr(obj, "__module__", None)
            if not isinstance(name, str):
                return
            root = name.partition(".")[0]
            module = sys.modules.get(name)
            if (
                root not in (*_PACKAGES, "cloudpickle")
                and (version := installed_version(root)) is not None
            ):
                self.other_versions[root] = version
            elif module is not None and (path := compiled_file(module)) is not None:
                self.files[path] = str(_file_digest(path))

    return HashingPickler


# Attributes whose values are names, and attributes that contain dictionaries of names.
_NAME_ATTRIBUTES = ("__name__", "__qualname__", "__module__", "__annotations__")
_NAMESPACE_ATTRIBUTES = ("__globals__", "__kwdefaults__")
# What Python notes in a class from version 3.13 on: its line in the file, which comments move, and
# the names that its methods assign to, in an order that differs from process to process.
_NOTED_BY_THE_COMPILER = ("__firstlineno__", "__static_attributes__")


def _with_encoded_keys(state: Any) -> Any:
    """Return the state of an object, with the names of its attributes as bytes instead of strings.
    Strings would be taken for names of files, and hashed as such if there is such a file."""
    if isinstance(state, tuple):
        return tuple(map(_with_encoded_keys, cast("tuple[Any, ...]", state)))
    if not isinstance(state, dict):
        return state
    attributes = {
        key: value
        for key, value in cast("dict[Any, Any]", state).items()
        if key not in _NOTED_BY_THE_COMPILER
    }
    # Some values are names, too, and some are dictionaries of names.
    attributes |= {key: _encoded(attributes[key]) for key in _NAME_ATTRIBUTES if key in attributes}
    attributes |= {
        key: _with_encoded_keys(attributes[key])
        for key in _NAMESPACE_ATTRIBUTES
        if key in attributes
    }
    return [(_encoded(key), value) for key, value in attributes.items()]


def _encoded(names: Any) -> Any:
    """Return a string as bytes; a dictionary as a list of pairs, with its strings as bytes; any
    other value unchanged."""
    if isinstance(names, dict):
        mapping = cast("dict[Any, Any]", names)
        return [(_encoded(key), _encoded(value)) for key, value in mapping.items()]
    return names.encode() if isinstance(names, str) else names


_CODE_ATTRIBUTES = (
    "co_name", "co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars",
    "co_argcount", "co_posonlyargcount", "co_kwonlyargcount", "co_flags", "co_exceptiontable",
)  # fmt: skip


def _is_generated_id(argument: Any) -> bool:
    """Return whether a value is an id that cloudpickle generated for a class: 32 hexadecimal
    digits."""
    return isinstance(argument, str) and _GENERATED_ID.fullmatch(argument) is not None


@functools.lru_cache(maxsize=1024)
def _transient_attributes(kind: type) -> dict[str, Any]:
    """Return the attributes in which objects of the class `kind` cache computed values. The value
    of each entry is what replaces the cached value in a pickle: the default of a private dataclass
    field, or `_OMIT` to leave the attribute out."""
    replacements: dict[str, Any] = {
        name: _OMIT
        for definition in kind.__mro__
        for name, value in vars(definition).items()
        if isinstance(value, functools.cached_property)
    }
    if dataclasses.is_dataclass(kind):
        for definition in dataclasses.fields(kind):
            # Private fields that are not compared hold what is computed from the others.
            private = definition.name.startswith("_")
            if private and not definition.compare and definition.default is not dataclasses.MISSING:
                replacements[definition.name] = definition.default
    return replacements
