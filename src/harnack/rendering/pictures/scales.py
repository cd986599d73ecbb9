"""A bar of colors beside a picture, with ticks at nice numbers.

Scales: which number has which color, and where ticks stand.

Numbers as colors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.pictures.images import transferred
from harnack.rendering.surfaces.colors import Color

# Least-squares polynomial of degree 6 to the map "viridis" (Smith and van der Walt, matplotlib,
# 2015, CC0), lowest degree first; off by at most 0.017.
_VIRIDIS = np.array(
    [
        [0.2745, 0.0058, 0.3327],
        [0.1077, 1.3965, 1.3868],
        [-0.3272, 0.2148, 0.0920],
        [-4.5999, -5.7582, -19.2918],
        [6.2037, 14.1540, 56.6563],
        [4.7518, -13.7494, -65.3210],
        [-5.4321, 4.6416, 26.2721],
    ]
)


def viridis(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Colors (..., 3) in sRGB, in [0, 1], of numbers (...) in [0, 1]: dark blue to yellow.

    Equal differences look equally large, and it reads well in gray and for the color-blind.
    """
    x = np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64)
    colors = np.zeros((*x.shape, 3))
    for coefficients in _VIRIDIS[::-1]:  # Horner
        colors = colors * x[..., None] + coefficients
    return np.clip(colors, 0.0, 1.0)


# Of OKLab (Ottosson 2020): to the cube roots of cone responses, and from these to linear sRGB.
_TO_CONES = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_FROM_CONES = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)
# Of equally light colors in a circle: none leaves sRGB.
_LIGHTNESS, _CHROMA = 0.72, 0.11


def hues(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Colors (..., 3) in sRGB of numbers (...) of which 0 and 1 are the same: all hues, equally
    light and equally far from gray."""
    angle = 2 * np.pi * np.nan_to_num(x).astype(np.float64)
    lab = np.stack(
        [np.full_like(angle, _LIGHTNESS), _CHROMA * np.cos(angle), _CHROMA * np.sin(angle)], axis=-1
    )
    light = (lab @ _TO_CONES.T) ** 3 @ _FROM_CONES.T
    return np.clip(transferred(light), 0.0, 1.0)


def grays(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Grays (..., 3) of numbers (...) in [0, 1]: 0 is white, 1 is dark."""
    gray = 0.25 + 0.75 * (1 - np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64))
    return np.repeat(gray[..., None], 3, axis=-1)


Numbers = npt.NDArray[np.floating[Any]]
# Steps between ticks, as parts of a power of ten.
_NICE = (1.0, 2.0, 5.0, 10.0)
# Where ticks are closer than this, or numbers as large, they are written with an exponent.
_SMALL, _LARGE = 1e-5, 1e7
# Periods up to so many times pi have ticks at parts of it.
_MOST_PI = 16


@dataclass(frozen=True)
class Scale:
    """Colors of numbers from `low` to `high`; others have those of the ends.

    name: of what is shown, on color bars.
    period: of numbers that count modulo `high` - `low` = period; None for others.
    passed: whether numbers that are shown lie below `low`, and above `high`.
    """

    low: float
    high: float
    name: str
    colors_of: Callable[[Numbers], npt.NDArray[np.float64]] = viridis
    period: float | None = None
    passed: tuple[bool, bool] = (False, False)

    @classmethod
    def cyclic(cls, period: float, name: str) -> Scale:
        """Of numbers that count modulo a period: its ends have one color."""
        return cls(0.0, period, name, hues, period)

    def passed_by(self, numbers: Numbers) -> Scale:
        """The same, for the bar of a picture that shows these."""
        if self.period is not None or not numbers.size:
            return self
        slack = 1e-6 * max(abs(self.low), abs(self.high))
        below, above = numbers.min() < self.low - slack, numbers.max() > self.high + slack
        return replace(self, passed=(bool(below), bool(above)))

    def colors(self, numbers: Numbers) -> npt.NDArray[np.float64]:
        """Colors (..., 3) in sRGB, in [0, 1]."""
        if self.period is not None:
            return self.colors_of(np.mod(numbers, self.period) / self.period)
        # The range of equal numbers is their rounding.
        span = max(self.high - self.low, 1e-6 * abs(self.high), 1e-30)
        return self.colors_of((numbers - self.low) / span)

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


Pixels = npt.NDArray[np.uint8]

# Heights of letters and bar, and the bar's width, as parts of the picture's height; and the least
# height of letters, in pixels.
_LETTERS, _BAR, _WIDTH, _LEAST = 1 / 28, 0.78, 1 / 22, 10
# Files that Pillow finds by name where they are installed, and a letter that none of them has.
_TYPEFACES = (
    "DejaVuSans.ttf", "NotoSans-Regular.ttf", "FreeSans.ttf", "LiberationSans-Regular.ttf",
    "arial.ttf", "Arial.ttf", "Arial Unicode.ttf", "segoeui.ttf",
)  # fmt: skip
_NO_LETTER = "\uffff"
_ON_DARK, _ON_LIGHT = (226, 226, 226), (26, 26, 28)


def require_pillow() -> tuple[Any, Any, Any]:
    """Pillow's images, drawings and typefaces.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "a color bar needs Pillow: pip install 'harnack[film]', or leave colorbar away"
        ) from None
    return Image, ImageDraw, ImageFont


def typeface_for(text: str, size: int) -> Any:
    """Pillow's own typeface, which has plain ASCII letters, or the first of this machine that has
    all letters of a text.

    Raises:
        ValueError: none has them.
    """
    _, _, typefaces = require_pillow()
    own = typefaces.load_default(size)
    if text.isascii():
        return own
    for name in _TYPEFACES:
        try:
            one = typefaces.truetype(name, size)
        except OSError:  # it is not installed
            continue
        none = bytes(one.getmask(_NO_LETTER))
        if all(letter == " " or bytes(one.getmask(letter)) != none for letter in text):
            return one
    raise ValueError(
        f"no typeface that was found here has all letters of {text!r}: install DejaVu Sans "
        "(Debian's fonts-dejavu-core), or write the title in plain ASCII letters"
    )


def with_bar(pixels: Pixels, scale: Scale, background: Color) -> Pixels:
    """A picture (h, w, 3) with the bar of its scale to the right: (h, w + more, 3).

    An end of the bar is a point where the picture has numbers beyond it.
    background: behind the bar, sRGB in [0, 1].
    """
    behind = tuple(round(255 * part) for part in background)
    ink = _ON_LIGHT if sum(background) > 1.5 else _ON_DARK
    images, drawings, _ = require_pillow()
    height = len(pixels)
    letters = max(_LEAST, round(_LETTERS * height))
    font = typeface_for(scale.name, letters)
    length = max(2, min(round(_BAR * height), height - 4 * letters))
    thick, gap = max(3, round(_WIDTH * height)), max(2, letters // 2)
    ticks = scale.ticks(max(2, min(6, length // (2 * letters))))
    room = max(font.getlength(text) for _, text in ticks)
    wide = max(thick + gap + room, font.getlength(scale.name))
    strip = images.new("RGB", (math.ceil(wide) + 2 * letters, height), behind)
    top = (height - length + letters) // 2
    draw = drawings.Draw(strip)
    point = gap if any(scale.passed) else 0  # its height
    title = max(0, top - gap - point)
    draw.text((letters, title), scale.name, font=font, fill=ink, anchor="ls")
    values = scale.high - (np.arange(length) + 0.5) / length * (scale.high - scale.low)
    if scale.period is not None:  # the upper end is the lower one
        values = np.minimum(values, np.nextafter(scale.high, scale.low))
    column = (scale.colors(values) * 255 + 0.5).astype(np.uint8)
    for row, color in enumerate(column):
        draw.line([(letters, top + row), (letters + thick - 1, top + row)], fill=tuple(color))
    for is_passed, row, away, color in zip(
        scale.passed, (top + length, top - 1), (point, -point), (column[-1], column[0]), strict=True
    ):
        if is_passed:
            ends = [(letters, row), (letters + thick - 1, row), (letters + thick // 2, row + away)]
            draw.polygon(ends, fill=tuple(color))
    for value, text in ticks:
        part = (value - scale.low) / (scale.high - scale.low) if scale.high > scale.low else 0.5
        y = top + round((1 - part) * (length - 1))
        right = letters + thick
        draw.line([(right, y), (right + gap // 2, y)], fill=ink)
        draw.text((right + gap, y), text, font=font, fill=ink, anchor="lm")
    return np.concatenate([pixels, np.asarray(strip, dtype=np.uint8)], axis=1)
