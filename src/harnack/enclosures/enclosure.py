"""Enclosures, which bound how far a function f can change along a path, and their inputs. f is
sampled at a point of the path (mostly a ray); F(s) is the change of f at the length s beyond that
point. A level is a value of f that rays look for; a length is free if f takes no level on it.

- `Enclosure`: the base of all enclosures. A new proof is a class derived from it, in this package.
- `PathRestriction`: f along a path, for enclosures that use ranges of its derivatives on pieces of
  the path (`PathPiece`).
- `Levels`: the levels that rays look for, and their distances from a value (`LevelGaps`).
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import drjit as dr

from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from harnack.backend import Mask, Real
    from harnack.enclosures.promises import Promise


@dataclass(frozen=True)
class PathPiece:
    """A piece of a path, with ranges of the first two derivatives F' and F'' on it. F is the change
    of the function f along the path, as a function of the length.

    length: the length of the piece.
    slope_range: the range of F' on the piece.
    min_second_derivative, max_second_derivative: the range of F''; an end may be infinite, for
        functions with kinks.
    """

    length: Real
    slope_range: SlopeRange
    min_second_derivative: Real
    max_second_derivative: Real


class PathRestriction(Protocol):
    """A function f restricted to a path (a ray), with computable ranges of its derivatives along
    it.

    piece_count: the number of pieces into which the path is best cut, found by experiment.
    """

    @property
    def piece_count(self) -> int: ...

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """Return ranges of the derivatives of F(s) = f(path(t+s)) on the pieces of the path between
        each knot and the next, where t is the start of the path.

        knots: increasing lengths s, the first of them 0.
        """
        ...


# A length that is proved in exact arithmetic, times this, is proved in single precision too: the
# formulas of steps have some ten roundings.
STEP_SAFETY = 1.0 - 1e-6


@dataclass(frozen=True)
class LevelGaps:
    """The differences in value, >= 0, between f at a point and the next level below and the next
    level above. A level is a value of f that rays look for.

    below, above: the two differences; infinite if there is no level on that side.
    is_one_sided: whether on every lane at most one of the two is finite, as with a single level.
        This is known while a kernel is being recorded, and saves the proof for the other side.
    """

    below: Real
    above: Real
    is_one_sided: bool = False

    @property
    def nearest(self) -> Real:
        """The difference between f and the nearest level."""
        return fmin(self.below, self.above)

    def reduced_by(self, error: Real) -> LevelGaps:
        """Return lower bounds of the gaps, for a value of f that may be wrong by `error`."""
        below, above = fmax(self.below - error, 0), fmax(self.above - error, 0)
        return LevelGaps(below, above, self.is_one_sided)

    def swapped(self) -> LevelGaps:
        """Return the gaps of -f to the negated levels: `below` and `above` are exchanged."""
        return LevelGaps(self.above, self.below, self.is_one_sided)


@dataclass(frozen=True)
class SlopeRange:
    """An interval that contains the derivative of a function f along a unit direction at a point.

    lower, upper: its ends, in units of f per length.
    """

    lower: Real
    upper: Real

    @classmethod
    def around(cls, slope: Real, error: Real) -> SlopeRange:
        """Return the interval from slope - error to slope + error.

        An error that is the Python float 0.0 adds no operation to the kernel.
        """
        if isinstance(error, float) and error == 0.0:
            return cls(slope, slope)
        return cls(slope - error, slope + error)

    def negated(self) -> SlopeRange:
        """Return the range of the derivative along the opposite direction, from -upper to
        -lower."""
        return SlopeRange(-self.upper, -self.lower)


class Enclosure(abc.ABC):
    """A proof that F stays within an interval that depends on s, for 0 <= s < reach. F(s) =
    f(path(t+s)) - f(path(t)) is the change of f from its value at a sample, at the length s beyond
    it. A level is a value of f that rays look for; a length s is free if F takes no level on it.
    The gaps (`LevelGaps`) are the differences between f at the sample and the next levels below and
    above.

    As F is a change, two large numbers are never subtracted; in single precision rays would stall
    otherwise. From the gaps an enclosure proves a free length (`free_length`), or decides whether a
    given length is free (`is_free`). `is_free` takes one evaluation of the proof and no solver; the
    tracer uses it for the way back from a sample.

    Each end of the interval must be an increasing function of the slope at the sample, or constant,
    and every proof says why it is. Then the upper end of a `SlopeRange` gives an upper bound of F
    that holds for every slope in the range, and its lower end gives such a lower bound. In
    particular slopes in [-|grad f|, |grad f|] bound F in every direction.
    """

    @property
    def reach_growth(self) -> float:
        """How far the enclosures at the next sample should reach, as a multiple of the length that
        was proved free at this sample. The best values were found by experiment."""
        return 2.0

    @classmethod
    def from_promise(
        cls, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Self | None:
        """Return the enclosure that this class proves from a promise (a proved bound of f near the
        sample); None if it does not use promises of that kind. Nothing else of f is known: no
        second derivative along the path, for example.

        value: f at the sample.
        error: a bound of the error of this value.
        slopes: the range of the derivative of f along the path at the sample.
        """
        del promise, value, error, slopes
        return None

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the enclosure that this class proves from ranges of the derivatives of f along the
        path; None if this class does not use such ranges.

        function: f along the path.
        slopes: the range of its derivative at the start of the path.
        length: the length of the path on which the enclosure is wanted.
        """
        del function, slopes, length
        return None

    @abc.abstractmethod
    def free_length(self, gaps: LevelGaps) -> Real:
        """Return a length L >= 0 such that f is proved to take no level for 0 < s < L. NaN proves
        nothing.

        gaps: the differences between f at the sample and the next levels.
        """

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to take no level for 0 < s < length.

        gaps: the differences between f at the sample and the next levels.
        """
        return length <= self.free_length(gaps)

    def arrives(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to take a level for some 0 <= s <= length.
        Here the mask is False everywhere: only enclosures that prove a change of at least some size
        override this method.

        gaps: the differences between f at the sample and the next levels.
        """
        del length
        return (gaps.above == gaps.above) & False  # False, as an array of the width of the gaps


@dataclass(frozen=True)
class Levels:
    """The levels: the values of a function f that rays look for. They are a finite set, repeated
    with `period` if there is one.

    An angle-valued function is known up to multiples of its period. Its levels are then each of the
    values plus every multiple of the period (paper, Alg. 2). The printed algorithm omits a
    reduction: here both neighboring levels are computed from the difference reduced to half a
    period.

    values: Python floats, or Dr.Jit arrays of size 1 of the backend in use. As arrays, levels can
        change without a kernel being compiled again, and can carry derivatives.
    period: the period, or None.
    """

    values: tuple[Real, ...]
    period: float | None = None

    def gaps(self, f: Real) -> LevelGaps:
        """Return the differences between the value f and the next level below and above.

        A difference is infinite if there is no such level. If f is a level, the gap on one side is
        0, and with a period the gap on the other side is at most the period. The gaps are NaN where
        f is NaN.
        """
        below: Real = math.inf
        above: Real = math.inf
        for level in self.values:
            offset = f - level  # > 0: the level lies below f
            if self.period is not None:
                # Within half a period of 0, where rounding cannot confuse the sides of a level.
                reduced = offset - self.period * dr.round(offset / self.period)
                is_above = reduced >= 0
                below_gap = dr.select(is_above, reduced, self.period + reduced)
                above_gap = dr.select(is_above, self.period - reduced, -reduced)
            else:
                # Compared in this order, NaN gives NaN, which proves nothing.
                below_gap = dr.select(offset < 0, math.inf, offset)
                above_gap = dr.select(offset > 0, math.inf, -offset)
            below, above = fmin(below, below_gap), fmin(above, above_gap)
        # With a single level, only one of the two gaps is finite.
        return LevelGaps(below, above, len(self.values) == 1 and self.period is None)

    def offset_to_nearest(self, f: Real) -> Real:
        """Return the difference level - f for the level nearest to the value f."""
        gaps = self.gaps(f)
        return dr.select(gaps.above < gaps.below, gaps.above, -gaps.below)
