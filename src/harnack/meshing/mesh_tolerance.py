"""The tolerance of `mesh` and `repair`: how far triangles may be from a surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.tracer import TraceOptions

__all__ = ["MeshTolerance"]


@dataclass(frozen=True)
class MeshTolerance:
    """The largest allowed distance of the triangles of a mesh from the surface that they stand for.

    length: this distance, a length; None for 1e-3 of the size of the surface (the longest side of
        its bounding box)."""

    length: float | None = None

    @classmethod
    def of(cls, options: TraceOptions) -> MeshTolerance:
        """The tolerance of a call of `mesh` or `repair`, from the options of traces that were
        given.

        Raises:
            TypeError: a `HitTolerance` that is more than a length.
        """
        hits = options.hit_tolerance
        if hits is not None and (hits.per_length or hits.value):
            raise TypeError("the tolerance of a mesh is a length, without per_length and value")
        return cls(None if hits is None else hits.distance)

    def at(self, size: float) -> float:
        """The tolerance, as a length, for a surface of this size (the longest side of its bounding
        box).

        Raises:
            ValueError: the tolerance that was given is half of the size or more.
        """
        length = 1e-3 * size if self.length is None else self.length
        if not length < 0.5 * size and self.length is not None:
            raise ValueError(
                f"tolerance={length:g} is a length, and half of the surface's size of {size:.3g} "
                "or more: choose a smaller tolerance"
            )
        return length

    def within(self, size: float) -> float:
        """The tolerance, as a length, for one component of a surface. size: the longest side of the
        component's bounding box.

        It is the tolerance that was given, but at most 0.4 `size`, since a small component could
        vanish within a larger tolerance. If none was given, it is 1e-3 of `size`. Unlike `at`, it
        never raises."""
        return self.at(size) if self.length is None else min(self.length, 0.4 * size)
