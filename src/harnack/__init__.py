"""Guaranteed ray tracing of harmonic and other implicit surfaces.

    import harnack as hk
    hits = hk.trace(hk.SolidAngle(vertices), origins, directions)

The names that `__init__.pyi` lists are imported when they are first used, so that `import harnack`
is fast. So are the namespaces: modules of the package that hold all further public names.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, cast

import lazy_loader

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend as backend
from harnack._version import __version__ as __version__
from harnack.name_suggestions import did_you_mean

_import, _, _names = cast("Any", lazy_loader).attach_stub(__name__, __file__)
_NAMESPACES = (
    "arithmetic", "distance", "enclosures", "fields", "files", "gallery", "geometry", "io",
    "kernels", "lattice", "literature", "live", "math", "meshing", "printing", "proofs",
    "rendering", "solids", "testing", "tracer",
)  # fmt: skip
__all__ = [  # pyright: ignore[reportUnsupportedDunderAll]
    name for name in _names if name not in (*_NAMESPACES, "backend")
]


def __getattr__(name: str) -> Any:
    """Return an attribute of the package that is not imported yet: import the namespace or the
    object of this name. Python calls this function if an attribute is not found.

    Raises:
        AttributeError: there is no such name. The message names the namespace that has it, or
            suggests a similar name.
    """
    if name in _NAMESPACES:
        return import_module(f"{__name__}.{name}")
    if name in __all__:
        return _import(name)
    namespace = _namespace_of(name)
    if namespace is not None:
        raise AttributeError(f"{name} is in a namespace: {__name__}.{namespace}.{name}")
    hint = did_you_mean(name, (*__all__, *_NAMESPACES))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    return sorted((*__all__, *_NAMESPACES))


def _namespace_of(name: str) -> str | None:
    """Return the namespace (a module of the package) that has the public name `name`; None if there
    is none."""
    if name.startswith("_"):
        return None
    for namespace in _NAMESPACES:
        if name in getattr(import_module(f"{__name__}.{namespace}"), "__all__", ()):
            return namespace
    return None
