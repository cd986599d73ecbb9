"""Fields: the functions f whose level sets are drawn, with a folder for each family. This package
exports the base classes and all fields but solids, which are in `harnack.solids`. They are imported
when they are first used, as `__init__.pyi` lists them."""

from __future__ import annotations

from typing import Any, cast

import lazy_loader

__getattr__, __dir__, __all__ = cast("Any", lazy_loader).attach_stub(__name__, __file__)
