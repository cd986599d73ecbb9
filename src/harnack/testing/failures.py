"""How a broken promise is reported."""

from __future__ import annotations

__all__ = ["BrokenPromiseError"]


class BrokenPromiseError(AssertionError):
    """A field or a bound promised something that is not true; the message says what and where."""
