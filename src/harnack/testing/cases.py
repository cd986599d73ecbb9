"""Promises with the levels asked for, as records that every proof can be tried on."""

from __future__ import annotations

import abc
import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from harnack.enclosures import (
    BoundedLaplacian,
    Curvature,
    Enclosure,
    Gaps,
    HarmonicBall,
    Lipschitz,
    Slopes,
)
from harnack.enclosures.balls.ball import Ball
from harnack.enclosures.balls.bounded_laplacian import GreenBall

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

__all__ = ["BallCase", "Case", "CurvatureCase", "LaplacianCase", "LipschitzCase"]


@dataclass(frozen=True)
class _Case(abc.ABC):
    """gap_down, gap_up: how far in value the levels below and above are."""

    @abc.abstractmethod
    def enclosure(self, kind: type[Enclosure], slopes: Slopes) -> Enclosure | None:
        """The enclosure that a proof makes of this; None if it makes none."""

    @property
    def gaps(self) -> Gaps:
        """The distances to the levels below and above."""
        numbers = vars(self)
        return Gaps(numbers["gap_down"], numbers["gap_up"])

    def accepts(self, kind: type[Enclosure]) -> bool:
        """Whether a proof applies to this."""
        given: dict[str, Any] = vars(self)
        plain = {
            key: value if value is None or key == "dimension" else 1.0
            for key, value in given.items()
        }
        return dataclasses.replace(self, **plain).enclosure(kind, Slopes(0.0, 0.0)) is not None

    def step(self, kind: type[Enclosure], slope: Real, error: Real = 0.0) -> Real:
        """The step along a direction with a slope known up to an error."""
        enclosure = self.enclosure(kind, Slopes.around(slope, error))
        assert enclosure is not None
        return enclosure.step(self.gaps)

    def covers(self, kind: type[Enclosure], slope: Real, length: Real, error: Real = 0.0) -> Mask:
        """Whether a length along such a direction is proved free."""
        enclosure = self.enclosure(kind, Slopes.around(slope, error))
        assert enclosure is not None
        return enclosure.covers(self.gaps, length)


@dataclass(frozen=True)
class BallCase(_Case):
    """f is harmonic on a ball of R^dimension and moves there by less than the ranges (None: not
    bounded on that side)."""

    radius: Real
    range_below: Real | None
    range_above: Real | None
    gap_down: Real
    gap_up: Real
    dimension: int

    def enclosure(self, kind: type[Enclosure], slopes: Slopes) -> Enclosure | None:
        below, above = self.range_below, self.range_above
        if not issubclass(kind, Ball):  # a proof of someone's own
            ends = -math.inf if below is None else -below, math.inf if above is None else above
            promise = HarmonicBall(self.radius, *ends, self.dimension)
            return kind.of(promise, 0 * self.radius, 0.0, slopes)
        # Without what `Ball.of` takes off for rounding, so that steps can be compared exactly.
        if not kind.applies(self.dimension, below is not None, above is not None):
            return None
        return kind(self.radius, below, above, self.dimension, slopes)


@dataclass(frozen=True)
class LaplacianCase(_Case):
    """f moves on a ball of space by less than the ranges, with a Laplacian between two ends."""

    radius: Real
    range_below: Real
    range_above: Real
    laplacian_lower: Real
    laplacian_upper: Real
    gap_down: Real
    gap_up: Real

    def enclosure(self, kind: type[Enclosure], slopes: Slopes) -> Enclosure | None:
        ends = self.laplacian_lower, self.laplacian_upper
        if issubclass(kind, GreenBall):  # without what is taken off for rounding, as above
            ranges = self.range_below, self.range_above
            return kind.of_ranges(self.radius, ranges, ends, slopes)
        promise = BoundedLaplacian(self.radius, -self.range_below, self.range_above, *ends)
        return kind.of(promise, 0 * self.radius, 0.0, slopes)


@dataclass(frozen=True)
class LipschitzCase(_Case):
    """f moves by at most `constant` times the length within the radius."""

    constant: Real
    radius: Real
    gap_down: Real
    gap_up: Real

    def enclosure(self, kind: type[Enclosure], slopes: Slopes) -> Enclosure | None:
        return kind.of(Lipschitz(self.constant, self.radius), 0.0, 0.0, slopes)


@dataclass(frozen=True)
class CurvatureCase(_Case):
    """f leaves its tangent by at most `constant` times half the square of the length."""

    constant: Real
    radius: Real
    gap_down: Real
    gap_up: Real

    def enclosure(self, kind: type[Enclosure], slopes: Slopes) -> Enclosure | None:
        return kind.of(Curvature(self.constant, self.radius), 0.0, 0.0, slopes)


Case: TypeAlias = BallCase | LaplacianCase | LipschitzCase | CurvatureCase
