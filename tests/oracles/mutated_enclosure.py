"""Enclosures that are wrong on purpose, to test that checks detect it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures import Enclosure, LevelGaps

__all__ = ["mutated_enclosure", "original_enclosure"]


def mutated_enclosure(kind: type[Enclosure], factor: float, *, covers: float | None = None) -> Any:
    """A class of enclosures that is wrong on purpose, to test that the checks detect it: its free
    lengths (lengths proved to hold no level) are multiplied by a factor.

    kind: the class from which it is derived.
    factor: multiplies every free length.
    covers: multiplies every length that `is_free` accepts; None for the same factor.
    """
    covers_factor = factor if covers is None else covers
    # Type checkers accept no variable as a base class.
    base: Any = kind

    class Scaled(base):
        """The class `kind` with all lengths scaled."""

        original = kind

        def free_length(self, gaps: LevelGaps) -> Real:
            parent: Any = super()
            return factor * parent.free_length(gaps)

        def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
            parent: Any = super()
            return parent.is_free(gaps, length / covers_factor)

    Scaled.__name__ = f"Scaled{kind.__name__}"
    return Scaled


def original_enclosure(kind: type[Enclosure]) -> type[Enclosure]:
    """Return the class from which `mutated_enclosure` made the class `kind`. A class that it did
    not make is returned as it is."""
    return getattr(kind, "original", kind)
