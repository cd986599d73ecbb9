"""Guaranteed ray tracing of harmonic and other implicit surfaces.

import harnack as hk
hits = hk.trace(hk.SolidAngle(vertices), origins, directions)

Names are imported when they are first used, as `__init__.pyi` lists them: unused names take no time
to start.
"""

from __future__ import annotations

from typing import Any, cast

import lazy_loader

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend as backend
from harnack._version import __version__ as __version__
from harnack.name_suggestions import did_you_mean

_import, __dir__, __all__ = cast("Any", lazy_loader).attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in __all__:
        return _import(name)
    hint = did_you_mean(name, __all__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
