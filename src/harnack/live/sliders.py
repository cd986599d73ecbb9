"""Sliders, numbers that a person moves, and the content of a live view (its surfaces and options)
as a function of them."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

from harnack.backend.validation import as_finite
from harnack.fields import Field
from harnack.name_suggestions import did_you_mean
from harnack.tracer import Surface

__all__ = [
    "SLIDER_OPTIONS",
    "Slider",
    "SliderValueError",
    "SlidingContent",
    "extreme_slider_values",
    "slider_values_in_errors",
]

SLIDER_OPTIONS = (
    "level", "tolerance", "max_steps", "over_relaxation", "boundary_radius", "thickness",
)  # fmt: skip
"""Options that are numbers, so that a slider may be their value."""
# Sliders of which all combinations of ends are few.
_COMBINED = 3


@dataclass(frozen=True)
class Slider:
    """A number between two ends that a person moves while looking at a page or a view.

    low, high: its ends.
    start: its value at first; by default the middle or, for a slider with a step, the largest of
        its values that is at most the middle.
    step: the distance of neighboring values, which are counted from `low`; None for a slider that
        takes all values.

    Raises:
        TypeError: not numbers.
        ValueError: ends out of order, a start outside of them, or a step that is not positive.
    """

    low: float
    high: float
    start: float | None = None
    step: float | None = None

    def __post_init__(self) -> None:
        for name in ("low", "high", "start", "step"):
            if name in ("low", "high") or getattr(self, name) is not None:
                object.__setattr__(self, name, as_finite(getattr(self, name), name))
        if not self.low < self.high:
            raise ValueError(f"a slider goes from low to high, not from {self.low} to {self.high}")
        if self.step is not None and not 0 < self.step <= self.high - self.low:
            raise ValueError(
                f"step must be positive and at most {self.high - self.low:g}, not {self.step}"
            )
        if self.start is None:
            object.__setattr__(self, "start", self.nearest(0.5 * (self.low + self.high)))
        if not self.low <= cast("float", self.start) <= self.high:
            raise ValueError(f"start must lie between {self.low} and {self.high}: {self.start}")

    def nearest(self, number: float) -> float:
        """Move a number to a value that the slider can have. The number is first clipped to the
        slider's ends. A slider without a step then takes it as it is. A slider with a step takes
        the largest of its values that is at most the number; a number that differs from such a
        value by rounding only is returned unchanged."""
        number = min(max(number, self.low), self.high)
        if self.step is None:
            return number
        # (1e-9 steps count as rounding.)
        step_count = math.floor((number - self.low) / self.step + 1e-9)
        step_value = min(self.low + self.step * step_count, self.high)
        return number if abs(number - step_value) <= 1e-9 * self.step else step_value

    def values(self, count: int) -> list[float]:
        """Return values of the slider in ascending order: all of them if the slider has a step;
        otherwise `count` evenly spaced values, both ends included."""
        if self.step is None:
            return [self.low + (self.high - self.low) * k / (count - 1) for k in range(count)]
        step_count = math.floor((self.high - self.low) / self.step + 1e-9)
        return [min(self.low + self.step * k, self.high) for k in range(step_count + 1)]


@dataclass(frozen=True)
class SlidingContent:
    """The surfaces and options of a live view as functions of sliders, numbers that a person moves.

    content: surfaces that `hk.render` accepts, or a function of sliders that returns them.
    settings: options of `view` by name; a value is a constant, a slider or a function of sliders.
    sliders: all sliders by name.
    """

    content: Any
    settings: Mapping[str, Any]
    sliders: Mapping[str, Slider]

    @classmethod
    def of(cls, content: Any, options: Mapping[str, Any]) -> SlidingContent:
        """Make the content from the arguments of `view` or `page`. A slider is either the value of
        an option that is a number, or has a name of its own, which is an argument of the functions
        that depend on it.

        content: surfaces, or a function of sliders that returns them.
        options: options and sliders by name.

        Raises:
            TypeError: a function has an argument that is no slider, or nothing depends on a slider.
        """
        sliders = {name: value for name, value in options.items() if isinstance(value, Slider)}
        settings = {name: value for name, value in options.items() if name not in sliders}
        # A slider whose name is an option that is a number is the value of this option.
        settings |= {name: sliders[name] for name in sliders if name in SLIDER_OPTIONS}
        used: set[str] = set(settings) & set(sliders)
        for name, value in {"the first argument": content, **settings}.items():
            if _is_function(value):
                arguments = _arguments(value)
                for argument, parameter in arguments.items():
                    if argument not in sliders and parameter.default is parameter.empty:
                        raise TypeError(
                            f"{name} is a function of {argument!r}, and there is no such "
                            f"slider{did_you_mean(argument, sliders)}: give "
                            f"{argument}=harnack.Slider(...)"
                        )
                used |= set(arguments)
        for name in sliders:
            if name not in used:
                raise TypeError(
                    f"nothing depends on the slider {name!r}: it is no option that is a number, "
                    "and no function has an argument of that name; a formula with this parameter "
                    f"is a function of it as lambda {name}: harnack.expression(...)"
                    f"{did_you_mean(name, SLIDER_OPTIONS)}"
                )
        return cls(content, settings, sliders)

    @property
    def starts(self) -> dict[str, float]:
        """The start value of each slider, by name."""
        return {name: cast("float", slider.start) for name, slider in self.sliders.items()}

    @property
    def name(self) -> str:
        """A title for the content at the start values: the texts of its fields."""
        content, _ = self.at(self.starts)
        surfaces: list[Any] = [*content] if isinstance(content, list | tuple) else [content]
        return ", ".join(repr(getattr(surface, "field", surface)) for surface in surfaces)

    def at(self, values: Mapping[str, float]) -> tuple[Any, dict[str, Any]]:
        """Return the surfaces, and the options by name, for the given values of all sliders."""
        settings = {name: self._at(name, value, values) for name, value in self.settings.items()}
        return self._at("", self.content, values), settings

    def _at(self, name: str, value: Any, values: Mapping[str, float]) -> Any:
        """Return the value of one option (or of the content) at the given slider values: a slider's
        value, a function's result, or the constant itself.

        name: of the option.
        value: the constant, slider or function.
        """
        if isinstance(value, Slider):
            return values[name]
        if not _is_function(value):
            return value
        positional: list[Any] = []
        keywords: dict[str, Any] = {}
        for argument, parameter in _arguments(value).items():
            if parameter.kind is parameter.POSITIONAL_ONLY:
                positional.append(values.get(argument, parameter.default))
            elif argument in values:
                keywords[argument] = values[argument]
        return value(*positional, **keywords)


class SliderValueError(ValueError):
    """An error at a combination of slider values, which the message names."""


@contextmanager
def slider_values_in_errors(values: Mapping[str, float]) -> Generator[None]:
    """Context manager: errors that are raised in its block become errors that name the slider
    values. values: of the sliders, by name. If `values` is empty, the errors stay as they are.

    Raises:
        SliderValueError: in place of the error.
    """
    try:
        yield
    except SliderValueError:
        raise
    except Exception as wrong:
        if not values:
            raise
        values_text = ", ".join(f"{name}={value:g}" for name, value in values.items())
        raise SliderValueError(
            f"at the place {values_text} of the sliders: {type(wrong).__name__}: {wrong} "
            "(a slider needs ends low and high between which there is something to draw)"
        ) from wrong


def extreme_slider_values(sliders: Mapping[str, Slider]) -> list[dict[str, float]]:
    """Return combinations of slider values at the ends of the sliders' intervals, each by slider
    name. Up to three sliders: all combinations of ends. More sliders: each slider in turn at its
    two ends, while all other sliders have their start values."""
    ends = {name: (slider.low, slider.high) for name, slider in sliders.items()}
    if len(sliders) <= _COMBINED:
        return [dict(zip(ends, place, strict=True)) for place in itertools.product(*ends.values())]
    starts = {name: cast("float", slider.start) for name, slider in sliders.items()}
    return [{**starts, name: end} for name, interval in ends.items() for end in interval]


def _arguments(function: Any) -> dict[str, inspect.Parameter]:
    """Return the parameters of a function by name, without `*args` and `**kwargs`."""
    parameters = inspect.signature(function).parameters
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {name: p for name, p in parameters.items() if p.kind not in kinds}


def _is_function(value: Any) -> bool:
    """Return whether a value is a function of sliders: callable, but no class, field or surface."""
    return callable(value) and not isinstance(value, type | Field | Surface)
