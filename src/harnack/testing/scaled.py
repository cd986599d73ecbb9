"""A proof made wrong on purpose: a test suite that accepts it is worth nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from harnack.enclosures import Enclosure, Gaps

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

__all__ = ["scaled", "unscaled"]


def scaled(kind: type[Enclosure], factor: float, *, covers: float | None = None) -> Any:
    """The same proof with every step multiplied by `factor`, and every length that it covers by
    `covers` (None: by the same)."""
    loose = factor if covers is None else covers
    base: Any = kind

    class Scaled(base):
        original = kind

        def step(self, gaps: Gaps) -> Real:
            inner: Any = super()
            return factor * inner.step(gaps)

        def covers(self, gaps: Gaps, length: Real) -> Mask:
            inner: Any = super()
            return inner.covers(gaps, length / loose)

    Scaled.__name__ = f"Scaled{kind.__name__}"
    return Scaled


def unscaled(kind: type[Enclosure]) -> type[Enclosure]:
    """The proof that `scaled` was given; any other as it is."""
    return getattr(kind, "original", kind)
