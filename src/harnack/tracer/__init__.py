"""Finds first hits and crossings of rays with level sets of a function: the points at which it
takes a given value. Every step along a ray is proved. The names that `__init__.pyi` lists are
imported when they are first used."""

from __future__ import annotations

from typing import Any, cast

import lazy_loader

__getattr__, __dir__, __all__ = cast("Any", lazy_loader).attach_stub(__name__, __file__)
