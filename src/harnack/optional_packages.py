"""Imports packages that only some features need. Extras of this package, such as
`harnack[cluster]`, install them."""

from __future__ import annotations

import importlib
from typing import Any


def import_optional(module: str, message: str) -> Any:
    """Import a module of a package that may not be installed, and return it.

    message: the text of the error if it is not: which feature needs the package, and how it is
        installed.

    Raises:
        ModuleNotFoundError: the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(message) from error
