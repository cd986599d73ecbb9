"""Code of users: how it is recognized, which attributes of users' modules it uses, and how such
modules are sent to other processes. A user's module is one that belongs neither to Python, nor to
an installed package, nor to this library. To send a module "by value" is to send its attributes; to
send it "by name" is to import it there. "Words" are the identifiers and strings that occur in code:
an attribute of a user's module is sent if its name is among them.

Code of Python itself and of installed packages is sent by name. A user's module is sent by value,
in its present state: a worker may lack the module, or may have imported it before it was changed,
and a checkpoint folder must distinguish two states of it. But the whole module would be too much,
since modules also hold locks, clients and pictures. So an attribute is sent only if its name occurs
in the code that is sent. A sent module raises an error when any other attribute is used, so that
nothing is missing silently. (One exception: the dictionary that `globals()` returns in a function
lacks what was not sent.)
"""

from __future__ import annotations

import dis
import functools
import importlib.machinery
import importlib.util
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, cast

# Suffixes of modules that can be sent; other modules are compiled, and are files to be compared.
_SOURCES = (*importlib.machinery.SOURCE_SUFFIXES, *importlib.machinery.BYTECODE_SUFFIXES)
# Names by which code can read all attributes of a module at once.
_ALL_ATTRIBUTES = frozenset(("vars", "dir", "__dict__", "getmembers"))
# Functions that import modules without an import statement.
_IMPORTERS = frozenset(("import_module", "__import__"))
# Attributes of its module that a function may use without naming them.
_ALWAYS_SENT = ("__package__", "__name__", "__path__", "__file__")
# Attributes that Python's import sets, and that mean nothing in another process.
_NEVER_SENT = frozenset(("__builtins__", "__spec__", "__loader__", "__cached__"))
# The attribute of a sent module that lists the names of the attributes that were not sent.
_LEFT_OUT = "__left_out__"


class SentModule(ModuleType):
    """A user's module, rebuilt on a worker with the attributes that were sent. It is not in
    sys.modules, and is not the module that `import` finds there under its name."""

    def __getattr__(self, name: str) -> Any:
        """Raise the error for an attribute that the module does not have: a RuntimeError if it was
        not sent, else an AttributeError."""
        # Not an AttributeError, which `hasattr` would take for "no such attribute".
        if name in vars(self).get(_LEFT_OUT, ()):
            raise RuntimeError(
                f"{name} of your module {self.__name__} was not sent, since no code that was sent "
                f"names it; write `{self.__name__}.{name}` where it is used"
            )
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")


@dataclass(frozen=True)
class Namespace:
    """A stand-in, in a pickle, for the module in which pickled functions look up global names.
    Unpickling it gives a `SentModule`.

    known: the attributes that are sent whatever names the functions use, such as `__name__`.
    """

    known: Mapping[str, Any]

    @classmethod
    def of(cls, names: Mapping[str, Any]) -> Namespace:
        """Return the namespace that stands for a module. names: the attributes of the module by
        name."""
        return cls({key: names[key] for key in _ALWAYS_SENT if key in names})

    def __reduce__(self) -> Any:
        """Return how pickle rebuilds it: by `sent_module`, as a module with the known
        attributes."""
        return sent_module, (self.known,)


def sent_module(known: Mapping[str, Any]) -> SentModule:
    """Make a new module that has only the attributes `known`."""
    module = SentModule(str(known.get("__name__", "")))
    vars(module).update(known)
    return module


def itself(module: SentModule) -> SentModule:
    """Return the module, unchanged. Pickle calls this with a rebuilt `Namespace` to rebuild a
    module, so that the module is the one in which its functions look up names."""
    return module


def fill(module: SentModule, contents: tuple[Mapping[str, Any], frozenset[str]]) -> None:
    """Set the attributes of a rebuilt module. contents: the attributes by name, and the names of
    the attributes that were not sent."""
    attributes, left_out = contents
    vars(module).update(attributes, **{_LEFT_OUT: left_out - _NEVER_SENT})


def function_in(module: SentModule, code: CodeType, closure: Any) -> FunctionType:
    """Make a function of the given code and closure whose global names are those of a module."""
    return FunctionType(code, vars(module), None, None, closure)


def attributes_named(module: ModuleType, words: frozenset[str] | set[str]) -> dict[str, Any]:
    """Return the attributes of a module that code may use, by name, in alphabetical order.

    These are the attributes whose names are among `words`, and `__getattr__`; or all attributes, if
    `words` contains a name such as "vars", by which code can read attributes without naming them.
    Attributes that Python's import sets, such as `__spec__`, are left out.

    words: the identifiers and strings in the code.
    """
    uses_all = bool(words & _ALL_ATTRIBUTES)
    return {
        name: value
        for name, value in sorted(vars(module).items())
        if (uses_all or name in words or name == "__getattr__") and name not in _NEVER_SENT
    }


def codes_within(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object, and the code objects of all functions and classes that it defines, at
    any depth."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes_within(constant)


def words_of(function: FunctionType) -> set[str]:
    """Return the words of a function: all names in its code, and its string constants, as
    attributes may be looked up by them."""
    return {
        word
        for code in codes_within(function.__code__)
        for word in (*code.co_names, *_strings_in(code.co_consts))
    }


def _strings_in(constants: Iterable[Any]) -> Iterator[str]:
    """Yield the strings among the constants of a code object, and in its tuples and frozen sets."""
    for constant in constants:
        if isinstance(constant, str):
            yield constant
        elif isinstance(constant, tuple | frozenset):
            yield from _strings_in(cast("Iterable[Any]", constant))


def refuse_imports_within(function: FunctionType) -> None:
    """Refuse a function that imports users' modules when it is called: it cannot be determined in
    advance which modules these are, and which of their attributes are used.

    Raises:
        TypeError: the function imports such a module.
    """
    package = function.__globals__.get("__package__") or ""
    for code in codes_within(function.__code__):
        names = [_imported_module(statement, package) for statement in _imports(code)]
        # Any string that could be the name of a module may be imported by a function.
        if _IMPORTERS.intersection(code.co_names):
            names += [
                text
                for text in _strings_in(code.co_consts)
                if text.replace(".", "_").isidentifier()
            ]
        for name in names:
            if _is_user_root(name.partition(".")[0]):
                raise TypeError(
                    f"{function.__qualname__} of the module {function.__module__} imports your "
                    f"module {name} when it is called, and which that is then cannot be told; "
                    "import it at the top of the module"
                )


def _imports(code: CodeType) -> Iterator[tuple[int, str]]:
    """Yield the import statements in a code object as (level, name): the number of packages to go
    up (0 for an absolute import), and the module's name relative to that package."""
    instructions = [
        instruction
        for instruction in dis.get_instructions(code)
        if instruction.opname != "EXTENDED_ARG"
    ]
    for k, step in enumerate(instructions):
        if step.opname == "IMPORT_NAME":  # after its level and the names imported from the module
            yield int(instructions[k - 2].argval), str(step.argval)


def _imported_module(statement: tuple[int, str], package: str) -> str:
    """Return the full name of the module that an import statement imports. statement: the import as
    (level, name), as `_imports` yields it. package: the package of the module in which the
    statement stands."""
    level, name = statement
    with suppress(ImportError):  # the function will raise this error itself
        return importlib.util.resolve_name("." * level + name, package)
    return name


def _is_user_root(root: str) -> bool:
    """Return whether the top-level module named `root` is a user's module. It may be imported
    already or not."""
    module = sys.modules.get(root)
    if module is not None:
        return is_users(module)
    spec = None
    with suppress(ImportError, ValueError, AttributeError):
        spec = importlib.util.find_spec(root)
    if spec is None or spec.origin in ("built-in", "frozen"):
        return False
    location = spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    return location is not None and _is_user_location(root, location)


def is_users(module: ModuleType) -> bool:
    """Return whether a module is a user's: not a part of Python, of an installed package or of this
    library. `__main__` is one, and so is a module that is not in sys.modules."""
    name = module.__name__
    root = name.partition(".")[0]
    if name == "__main__" or sys.modules.get(name) is not module:
        return True
    location = _location_of(module)
    # A module without a file belongs to whom its top-level module belongs.
    if location is None and root != name and (top_module := sys.modules.get(root)) is not None:
        return is_users(top_module)
    if location is None:  # a built-in module has a specification
        return getattr(module, "__spec__", None) is None
    return _is_user_location(root, location)


def is_sent_itself(module: ModuleType) -> bool:
    """Return whether a module is sent by value: it is a user's module and not a compiled one."""
    location = _location_of(module)
    return is_users(module) and (
        location is None or location.endswith(_SOURCES) or not Path(location).suffix
    )


def compiled_file(module: ModuleType) -> str | None:
    """Return the path of the file of a user's module, if it is a compiled one; None for any other
    module."""
    path = _location_of(module)
    return path if path is not None and is_users(module) and not is_sent_itself(module) else None


def _location_of(module: ModuleType) -> str | None:
    """Return the file of a module, or the folder of a package without a file; None if the module
    has neither."""
    attributes = vars(module)
    location = attributes.get("__file__") or next(iter(attributes.get("__path__", ())), None)
    return location if isinstance(location, str) else None


@functools.cache
def _is_user_location(root: str, location: str) -> bool:
    """Return whether the file or folder `location` belongs to a user, not to Python, an installed
    package or this library. root: the name of the top-level module that it is a part of."""
    if root == "harnack":
        return False
    path = Path(location).resolve()
    if {"site-packages", "dist-packages"} & set(path.parts):
        return False
    paths = sysconfig.get_paths()
    return not any(
        path.is_relative_to(Path(paths[name]).resolve())
        for name in ("stdlib", "platstdlib", "purelib", "platlib")
    )


@functools.cache
def installed_version(root: str) -> str | None:
    """Return the version of the installed package that has the top-level module `root`; None if no
    package has it, as for Python's own modules and users' modules."""
    if root in sys.stdlib_module_names or root in ("__main__", "harnack") or _is_user_root(root):
        return None
    import importlib.metadata  # imported here, as it takes time that few programs need

    with suppress(importlib.metadata.PackageNotFoundError, ValueError):
        return importlib.metadata.version(root)
    for name in importlib.metadata.packages_distributions().get(root, ()):
        return importlib.metadata.version(name)
    return None
