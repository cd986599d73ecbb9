"""What an enclosure is: a proof of how far f can move along the next stretch of a path.

An enclosure is about F(s) = f(path(t+s)) - f(path(t)), the movement of f relative to its value
where it was looked at, so that two large numbers are never subtracted: in float32 that is the
difference between a march and a stall. Asked how far a level is in value (`Gaps`), it proves a
length free of it (`step`), or says whether a given length is (`covers`), which costs one evaluation
of the proof and no solve: the tracer asks it looking back.

A new proof is one file of this room: a class derived from `Enclosure`.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.backend.extrema import fmax, fmin

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real
    from harnack.enclosures.promises import Promise
    from harnack.enclosures.restriction import Restriction

# A length that is proved in exact arithmetic, times this, is proved in that of single precision:
# the formulas of steps have some ten roundings.
ROUND_DOWN = 1.0 - 1e-6


@dataclass(frozen=True)
class Gaps:
    """How far f must move, down or up, to reach a level: lengths in value >= 0.

    Infinite where there is no level on that side.

    is_one_sided: at most one of the two is finite, on every lane: there is one level alone. Known
        while a kernel is being recorded, it spares the proof of the other side.
    """

    down: Real
    up: Real
    is_one_sided: bool = False

    @property
    def smaller(self) -> Real:
        """The distance in value to the nearest level."""
        return fmin(self.down, self.up)

    def less(self, error: Real) -> Gaps:
        """The gaps that surely remain of a value known up to `error`."""
        down, up = fmax(self.down - error, 0), fmax(self.up - error, 0)
        return Gaps(down, up, self.is_one_sided)

    def exchanged(self) -> Gaps:
        """Those of the negative function."""
        return Gaps(self.up, self.down, self.is_one_sided)


@dataclass(frozen=True)
class Slopes:
    """An interval that holds the derivative of f along a unit direction, in f per length."""

    low: Real
    high: Real

    @classmethod
    def around(cls, slope: Real, error: Real) -> Slopes:
        """The slopes within `error` of one; an error of 0.0 costs nothing."""
        if isinstance(error, float) and error == 0.0:
            return cls(slope, slope)
        return cls(slope - error, slope + error)

    def negated(self) -> Slopes:
        """The slopes in the opposite direction."""
        return Slopes(-self.high, -self.low)


class Enclosure(abc.ABC):
    """A proof that F stays within a range for 0 <= s < reach.

    Neither end of the range may fall as the slope grows, and every proof says why: then the range
    at the upper end of `Slopes` bounds F from above and that at the lower end bounds it from below,
    whatever the slope in between is. In particular slopes in [-|grad f|, |grad f|] bound F in every
    direction.
    """

    @property
    def growth(self) -> float:
        """How many times the last step an enclosure should reach next, by experiment."""
        return 2.0

    @classmethod
    def of(cls, promise: Promise, value: Real, error: Real, slopes: Slopes) -> Self | None:
        """The enclosure that this proof makes of a promise; None if it makes none of that kind.

        value: f where it was looked at, known up to `error`. slopes: of f along the path.
        """
        del promise, value, error, slopes
        return None

    @classmethod
    def along(cls, function: Restriction, slopes: Slopes, length: Real) -> Self | None:
        """The enclosure that this proof makes of ranges of f along the path; None if it makes none.

        length: how far it should reach. slopes: of f along the path, where it starts.
        """
        del function, slopes, length
        return None

    @abc.abstractmethod
    def step(self, gaps: Gaps) -> Real:
        """A length L >= 0 such that f meets no level for 0 < s < L. What is not a number proves
        nothing."""

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        """Whether f is proved to meet no level for 0 < s < length."""
        return length <= self.step(gaps)
