"""A function along a path, as far as enclosures ask for it: ranges, and not values at points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from harnack.backend import Real, Vec3
    from harnack.enclosures.enclosure import Slopes


@dataclass(frozen=True)
class Piece:
    """What F' and F'' are on one piece of the path.

    length: of the piece.
    slopes: the range of F' on it.
    least_curvature, most_curvature: the range of F''; an end may be infinite, for functions with
        kinks.
    """

    length: Real
    slopes: Slopes
    least_curvature: Real
    most_curvature: Real


class Restriction(Protocol):
    """A function along a path, as enclosures ask for it.

    piece_count: how many pieces of the path take the least time, by experiment.
    """

    @property
    def piece_count(self) -> int: ...

    def pieces(self, knots: Sequence[Real]) -> tuple[Piece, ...]:
        """Ranges of the derivatives of f(path(t+s)) between each knot and the next.

        knots: lengths s, rising, the first of them 0.
        """
        ...


@runtime_checkable
class Evaluable(Protocol):
    """A restriction that is a formula: any arithmetic can be asked for what it makes of it."""

    def through(self, coordinates: Callable[[Vec3, Vec3], tuple[Any, Any, Any]]) -> Any:
        """The formula of coordinates made from a point p and the direction d of the path."""
        ...
