"""Scales: which number has which colour, and where ticks stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.pictures.scales.colormap import hues, viridis

Numbers = npt.NDArray[np.floating[Any]]
# Steps between ticks, as parts of a power of ten.
_NICE = (1.0, 2.0, 5.0, 10.0)
# Where ticks are closer than this, or numbers as large, they are written with an exponent.
_SMALL, _LARGE = 1e-5, 1e7
# Periods up to so many times pi have ticks at parts of it.
_MOST_PI = 16


@dataclass(frozen=True)
class Scale:
    """Colours of numbers from `low` to `high`; others have those of the ends.

    name: of what is shown, on colour bars.
    period: of numbers that count modulo `high` - `low` = period; None for others.
    passed: whether numbers that are shown lie below `low`, and above `high`.
    """

    low: float
    high: float
    name: str
    colours_of: Callable[[Numbers], npt.NDArray[np.float64]] = viridis
    period: float | None = None
    passed: tuple[bool, bool] = (False, False)

    @classmethod
    def cyclic(cls, period: float, name: str) -> Scale:
        """Of numbers that count modulo a period: its ends have one colour."""
        return cls(0.0, period, name, hues, period)

    def passed_by(self, numbers: Numbers) -> Scale:
        """The same, for the bar of a picture that shows these."""
        if self.period is not None or not numbers.size:
            return self
        slack = 1e-6 * max(abs(self.low), abs(self.high))
        below, above = numbers.min() < self.low - slack, numbers.max() > self.high + slack
        return replace(self, passed=(bool(below), bool(above)))

    def colours(self, numbers: Numbers) -> npt.NDArray[np.float64]:
        """Colours (..., 3) in sRGB, in [0, 1]."""
        if self.period is not None:
            return self.colours_of(np.mod(numbers, self.period) / self.period)
        # The range of equal numbers is their rounding.
        span = max(self.high - self.low, 1e-6 * abs(self.high), 1e-30)
        return self.colours_of((numbers - self.low) / span)

    def ticks(self, most: int) -> list[tuple[float, str]]:
        """At most so many, but at least two: numbers and how they are written."""
        period = 0.0 if self.period is None else self.period
        turns = round(period / math.pi)
        if 0 < turns <= _MOST_PI and math.isclose(period, turns * math.pi, rel_tol=1e-6):
            return _parts_of_turns(turns, most)
        if not self.high > self.low:
            return [(self.low, f"{self.low:.4g}")]
        step = _step((self.high - self.low) / max(most - 1, 1))
        first, last = self._multiples(step)
        if last - first < 1:  # one more than asked for, if that brings two
            step = _step((self.high - self.low) / max(most + 1, 3))
            first, last = self._multiples(step)
        if last - first < 1:  # no room for two nice numbers
            largest = max(abs(self.low), abs(self.high))
            digits = 2 + max(2, math.ceil(math.log10(largest / (self.high - self.low))))
            return [(end, f"{end:.{digits}g}") for end in (self.low, self.high)]
        largest = max(abs(first), abs(last)) * step
        return [(k * step, _written(k * step, step, largest)) for k in range(first, last + 1)]

    def _multiples(self, step: float) -> tuple[int, int]:
        """The first and the last multiple of a step in the range."""
        return math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)


def _step(least: float) -> float:
    """The smallest nice number that is not less than a positive one."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(part * power for part in _NICE if part * power >= least * (1 - 1e-9))


def _written(number: float, step: float, largest: float) -> str:
    """A multiple of a nice step, with the digits that it needs.

    largest: of all that are written.
    """
    if number == 0:
        return "0"
    below = math.floor(math.log10(step) + 1e-9)  # the place of the last digit
    if step >= _SMALL and largest < _LARGE:
        return f"{number:.{max(0, -below)}f}"
    digits = max(0, math.floor(math.log10(abs(number)) + 1e-9) - below)
    mantissa, exponent = f"{number:.{digits}e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"


def _parts_of_turns(turns: int, most: int) -> list[tuple[float, str]]:
    """Ticks of 0 to `turns` pi: at halves of pi, or at one, two, ... times pi."""
    halves = next(
        step for step in (1, 2, 4, 8, 16, 32)
        if (2 * turns) // step + 1 <= max(most, 2) or step >= 2 * turns
    )  # fmt: skip
    return [(k * math.pi / 2, _as_pi(k)) for k in range(0, 2 * turns + 1, halves)]


def _as_pi(halves: int) -> str:
    """So many halves of pi."""
    if halves == 0:
        return "0"
    times, below = (halves // 2, "") if halves % 2 == 0 else (halves, "/2")
    return f"{'' if times == 1 else f'{times} '}pi{below}"
