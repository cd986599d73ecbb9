"""Colors by name, and colors for numbers. A color map turns numbers in [0, 1] into colors. A color
scale gives colors to the numbers of an interval by a color map. Its ticks are numbers of the
interval with their texts. A color bar shows the scale beside a picture. Colors are in sRGB with
channels in [0, 1] unless stated otherwise."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.name_suggestions import did_you_mean
from harnack.optional_packages import import_optional
from harnack.rendering.images import linear_to_srgb, srgb_to_linear

Color = tuple[float, float, float]

# Colors are given by names of CSS, as hexadecimal numbers, or as three numbers.

# The named colors of CSS Color Module Level 4, section 6.1, which are those of SVG.
_NAMED = """
    aliceblue=f0f8ff antiquewhite=faebd7 aqua=00ffff aquamarine=7fffd4 azure=f0ffff beige=f5f5dc
    bisque=ffe4c4 black=000000 blanchedalmond=ffebcd blue=0000ff blueviolet=8a2be2 brown=a52a2a
    burlywood=deb887 cadetblue=5f9ea0 chartreuse=7fff00 chocolate=d2691e coral=ff7f50
    cornflowerblue=6495ed cornsilk=fff8dc crimson=dc143c cyan=00ffff darkblue=00008b
    darkcyan=008b8b darkgoldenrod=b8860b darkgray=a9a9a9 darkgreen=006400 darkgrey=a9a9a9
    darkkhaki=bdb76b darkmagenta=8b008b darkolivegreen=556b2f darkorange=ff8c00
    darkorchid=9932cc darkred=8b0000 darksalmon=e9967a darkseagreen=8fbc8f darkslateblue=483d8b
    darkslategray=2f4f4f darkslategrey=2f4f4f darkturquoise=00ced1 darkviolet=9400d3
    deeppink=ff1493 deepskyblue=00bfff dimgray=696969 dimgrey=696969 dodgerblue=1e90ff
    firebrick=b22222 floralwhite=fffaf0 forestgreen=228b22 fuchsia=ff00ff gainsboro=dcdcdc
    ghostwhite=f8f8ff gold=ffd700 goldenrod=daa520 gray=808080 green=008000 greenyellow=adff2f
    grey=808080 honeydew=f0fff0 hotpink=ff69b4 indianred=cd5c5c indigo=4b0082 ivory=fffff0
    khaki=f0e68c lavender=e6e6fa lavenderblush=fff0f5 lawngreen=7cfc00 lemonchiffon=fffacd
    lightblue=add8e6 lightcoral=f08080 lightcyan=e0ffff lightgoldenrodyellow=fafad2
    lightgray=d3d3d3 lightgreen=90ee90 lightgrey=d3d3d3 lightpink=ffb6c1 lightsalmon=ffa07a
    lightseagreen=20b2aa lightskyblue=87cefa lightslategray=778899 lightslategrey=778899
    lightsteelblue=b0c4de lightyellow=ffffe0 lime=00ff00 limegreen=32cd32 linen=faf0e6
    magenta=ff00ff maroon=800000 mediumaquamarine=66cdaa mediumblue=0000cd mediumorchid=ba55d3
    mediumpurple=9370db mediumseagreen=3cb371 mediumslateblue=7b68ee mediumspringgreen=00fa9a
    mediumturquoise=48d1cc mediumvioletred=c71585 midnightblue=191970 mintcream=f5fffa
    mistyrose=ffe4e1 moccasin=ffe4b5 navajowhite=ffdead navy=000080 oldlace=fdf5e6 olive=808000
    olivedrab=6b8e23 orange=ffa500 orangered=ff4500 orchid=da70d6 palegoldenrod=eee8aa
    palegreen=98fb98 paleturquoise=afeeee palevioletred=db7093 papayawhip=ffefd5
    peachpuff=ffdab9 peru=cd853f pink=ffc0cb plum=dda0dd powderblue=b0e0e6 purple=800080
    rebeccapurple=663399 red=ff0000 rosybrown=bc8f8f royalblue=4169e1 saddlebrown=8b4513
    salmon=fa8072 sandybrown=f4a460 seagreen=2e8b57 seashell=fff5ee sienna=a0522d silver=c0c0c0
    skyblue=87ceeb slateblue=6a5acd slategray=708090 slategrey=708090 snow=fffafa
    springgreen=00ff7f steelblue=4682b4 tan=d2b48c teal=008080 thistle=d8bfd8 tomato=ff6347
    turquoise=40e0d0 violet=ee82ee wheat=f5deb3 white=ffffff whitesmoke=f5f5f5 yellow=ffff00
    yellowgreen=9acd32
"""
NAMED_COLORS: Mapping[str, str] = MappingProxyType(
    {name: number for name, _, number in (entry.partition("=") for entry in _NAMED.split())}
)
"""Hexadecimal numbers by name."""

_COLOR_HELP = 'a name of CSS such as "steelblue", "#4682b4", or three numbers from 0 to 1'


def parse_color(color: Any, name: str) -> Color:
    """Return a color in sRGB, as three numbers in [0, 1].

    color: a name of CSS, "#rrggbb" or "#rgb", or three numbers in [0, 1].
    name: what the color is for, to begin messages with.

    Raises:
        TypeError: neither text nor three numbers.
        ValueError: no known name, or numbers outside of [0, 1].
    """
    if isinstance(color, str):
        return _from_text(color, name)
    try:
        # float("") raises ValueError, so texts and bools are refused.
        numbers = [float("" if isinstance(number, str | bool) else number) for number in color]
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be {_COLOR_HELP}, not {color!r}") from None
    if len(numbers) != 3:
        raise TypeError(f"{name} must be {_COLOR_HELP}, not {color!r}")
    if not all(0 <= number <= 1 for number in numbers):
        raise ValueError(f"{name} must be {_COLOR_HELP}, not {color!r}")
    return cast("Color", tuple(numbers))


def _from_text(text: str, name: str) -> Color:
    """Return the sRGB color of a text: the name of a CSS color, "#rrggbb" or "#rgb".

    name: what the color is for, to begin messages with.

    Raises:
        ValueError: the text is none of these.
    """
    digits = NAMED_COLORS.get(text.strip().lower())
    if digits is None:
        match = re.fullmatch(r"#([0-9a-fA-F]{3}|[0-9a-fA-F]{6})", text.strip())
        if match is None:
            raise ValueError(
                f"{name} must be {_COLOR_HELP}, not {text!r}{did_you_mean(text, NAMED_COLORS)}"
            )
        # "#rgb" stands for "#rrggbb".
        digits = match[1] if len(match[1]) == 6 else "".join(2 * digit for digit in match[1])
    red, green, blue = (int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4))
    return red, green, blue


def linear_from_srgb(color: Color) -> Color:
    """Convert a color from sRGB to linear sRGB, in which amounts of light can be added (IEC
    61966-2-1)."""
    red, green, blue = (float(srgb_to_linear(channel)) for channel in color)
    return red, green, blue


# Color maps: numbers as colors.

# Least-squares polynomial of degree 6 to the map "viridis" (Smith and van der Walt, matplotlib,
# 2015, CC0), lowest degree first; off by at most 0.017.
VIRIDIS = np.array(
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
    """Return the colors (..., 3) in sRGB of numbers (...) in [0, 1], from dark blue to yellow.
    Other numbers have the color of the nearer end, and NaN counts as 0.

    Equal differences of numbers look equally large, also in gray and for the color-blind.
    """
    x = np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64)
    colors = np.zeros((*x.shape, 3))
    for coefficients in VIRIDIS[::-1]:  # Horner
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


def cyclic_colormap(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Return the colors (..., 3) in sRGB of numbers (...) that count modulo 1, such as angles: 0
    and 1 have the same color. They go through all hues, equally light and equally far from gray.
    NaN counts as 0."""
    angle = 2 * np.pi * np.nan_to_num(x).astype(np.float64)
    # A circle around gray in the color space OKLab.
    lab = np.stack(
        [np.full_like(angle, _LIGHTNESS), _CHROMA * np.cos(angle), _CHROMA * np.sin(angle)], axis=-1
    )
    light = (lab @ _TO_CONES.T) ** 3 @ _FROM_CONES.T
    return np.clip(linear_to_srgb(light), 0.0, 1.0)


def gray_colormap(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Return grays (..., 3) in sRGB for numbers (...) in [0, 1]: 0 is white and 1 is dark. NaN
    counts as 0."""
    gray = 0.25 + 0.75 * (1 - np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64))
    return np.repeat(gray[..., None], 3, axis=-1)


# Scales: which number has which color, and where ticks stand.

Numbers = npt.NDArray[np.floating[Any]]
# Steps between ticks, as multiples of a power of ten.
_NICE = (1.0, 2.0, 5.0, 10.0)
# Numbers are written with an exponent if ticks are closer than the first, or if numbers are as
# large as the second.
_MIN_PLAIN_STEP, _MAX_PLAIN_NUMBER = 1e-5, 1e7
# Periods up to this multiple of pi have ticks at fractions of pi.
_MAX_PI_MULTIPLE = 16


@dataclass(frozen=True)
class ColorScale:
    """A map from numbers in an interval [low, high] to colors. Numbers outside have the color of
    the nearer end. Numbers that count modulo a period, such as angles, have a cyclic scale from 0
    to the period.

    name: what the numbers are, for color bars.
    colors_of: the color map: gives the colors (..., 3) in sRGB of numbers (...) in [0, 1].
    period: high - low for a cyclic scale; else None.
    exceeded: whether a picture shows numbers below `low`, and above `high`.
    """

    low: float
    high: float
    name: str
    colors_of: Callable[[Numbers], npt.NDArray[np.float64]] = viridis
    period: float | None = None
    exceeded: tuple[bool, bool] = (False, False)

    @classmethod
    def cyclic(cls, period: float, name: str) -> ColorScale:
        """Return the scale of numbers that count modulo `period`, from 0 to the period. Its two
        ends have the same color. name: what the numbers are."""
        return cls(0.0, period, name, cyclic_colormap, period)

    def with_exceeded(self, numbers: Numbers) -> ColorScale:
        """Return this scale with `exceeded` set for a picture that shows the given numbers. A
        cyclic scale is never exceeded, nor is any scale by rounding alone."""
        if self.period is not None or not numbers.size:
            return self
        # By less than this, numbers exceed the ends by rounding alone.
        slack = 1e-6 * max(abs(self.low), abs(self.high))
        below, above = numbers.min() < self.low - slack, numbers.max() > self.high + slack
        return replace(self, exceeded=(bool(below), bool(above)))

    def colors(self, numbers: Numbers) -> npt.NDArray[np.float64]:
        """Return the colors (..., 3) in sRGB, in [0, 1], of numbers (...)."""
        if self.period is not None:
            return self.colors_of(np.mod(numbers, self.period) / self.period)
        # If low equals high, the division must not be by zero.
        span = max(self.high - self.low, 1e-6 * abs(self.high), 1e-30)
        return self.colors_of((numbers - self.low) / span)

    def ticks(self, max_count: int) -> list[tuple[float, str]]:
        """Choose the ticks of a color bar. Returns pairs (number, text): at most `max_count`, but
        at least two unless all numbers of the scale are equal.

        A period that is a small multiple of pi has ticks at multiples of pi/2. Otherwise ticks are
        at multiples of 1, 2 or 5 times a power of ten, or at the two ends if the interval has no
        two such multiples.
        """
        period = 0.0 if self.period is None else self.period
        # Scales of angles have ticks at fractions of pi.
        pi_multiple = round(period / math.pi)
        if 0 < pi_multiple <= _MAX_PI_MULTIPLE and math.isclose(
            period, pi_multiple * math.pi, rel_tol=1e-6
        ):
            return _ticks_at_parts_of_pi(pi_multiple, max_count)
        if not self.high > self.low:
            return [(self.low, f"{self.low:.4g}")]
        spacing = _step((self.high - self.low) / max(max_count - 1, 1))
        first_multiple, last_multiple = self._multiples(spacing)
        if last_multiple - first_multiple < 1:  # one tick more than requested, if that gives two
            spacing = _step((self.high - self.low) / max(max_count + 1, 3))
            first_multiple, last_multiple = self._multiples(spacing)
        if last_multiple - first_multiple < 1:  # no room for two nice numbers
            largest = max(abs(self.low), abs(self.high))
            # At least two digits more than the two ends have in common.
            digits = 2 + max(2, math.ceil(math.log10(largest / (self.high - self.low))))
            return [(end, f"{end:.{digits}g}") for end in (self.low, self.high)]
        largest = max(abs(first_multiple), abs(last_multiple)) * spacing
        return [
            (k * spacing, _format_number(k * spacing, spacing, largest))
            for k in range(first_multiple, last_multiple + 1)
        ]

    def _multiples(self, step: float) -> tuple[int, int]:
        """Return the integers k of the first and the last multiple k * step in [low, high]."""
        return math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)


def _step(bound: float) -> float:
    """Return the smallest number that is at least `bound` > 0 and is 1, 2 or 5 times a power of
    ten."""
    power = 10.0 ** math.floor(math.log10(bound))
    return next(multiple * power for multiple in _NICE if multiple * power >= bound * (1 - 1e-9))


def _format_number(number: float, step: float, largest: float) -> str:
    """Write a tick's number, a multiple of `step`, with as many digits as it needs to differ from
    its neighbors.

    step: the distance between ticks, 1, 2 or 5 times a power of ten.
    largest: the largest absolute number of all ticks. It decides, with `step`, whether all are
        written with exponents.
    """
    if number == 0:
        return "0"
    # The place of the last digit; 1e-9 allows for rounding.
    last_place = math.floor(math.log10(step) + 1e-9)
    if step >= _MIN_PLAIN_STEP and largest < _MAX_PLAIN_NUMBER:
        return f"{number:.{max(0, -last_place)}f}"
    # The number of digits between the number's first digit and the step's digit.
    digits = max(0, math.floor(math.log10(abs(number)) + 1e-9) - last_place)
    mantissa, exponent = f"{number:.{digits}e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"


def _ticks_at_parts_of_pi(multiple: int, max_count: int) -> list[tuple[float, str]]:
    """Choose ticks for a cyclic scale from 0 to `multiple` times pi. Returns pairs (number, text)
    at multiples of pi/2, pi, 2 pi, ...: at the closest spacing with at most `max_count` ticks, but
    at least two."""
    # In units of pi/2; the last one is that of the largest multiple, `_MAX_PI_MULTIPLE`.
    spacing_in_halves = next(
        step for step in (1, 2, 4, 8, 16, 32)
        if (2 * multiple) // step + 1 <= max(max_count, 2) or step >= 2 * multiple
    )  # fmt: skip
    return [(k * math.pi / 2, _as_pi(k)) for k in range(0, 2 * multiple + 1, spacing_in_halves)]


def _as_pi(halves: int) -> str:
    """Write the number halves * pi/2 as text, such as "3 pi/2" for 3 and "2 pi" for 4."""
    if halves == 0:
        return "0"
    factor, divisor = (halves // 2, "") if halves % 2 == 0 else (halves, "/2")
    return f"{'' if factor == 1 else f'{factor} '}pi{divisor}"


# A bar of colors beside a picture, with ticks at nice numbers.

Pixels = npt.NDArray[np.uint8]

# Heights of letters and bar, and the bar's width, as parts of the picture's height; and the least
# height of letters, in pixels.
_LETTER_HEIGHT, _BAR_HEIGHT, _BAR_WIDTH, _MIN_LETTER_HEIGHT = 1 / 28, 0.78, 1 / 22, 10
# Files that Pillow finds by name where they are installed, and a letter that none of them has.
_TYPEFACES = (
    "DejaVuSans.ttf", "NotoSans-Regular.ttf", "FreeSans.ttf", "LiberationSans-Regular.ttf",
    "arial.ttf", "Arial.ttf", "Arial Unicode.ttf", "segoeui.ttf",
)  # fmt: skip
_NO_LETTER = "\uffff"
_ON_DARK, _ON_LIGHT = (226, 226, 226), (26, 26, 28)


def require_pillow() -> tuple[Any, Any, Any]:
    """Return the modules Image, ImageDraw and ImageFont of the package Pillow.

    Raises:
        ModuleNotFoundError: Pillow is not installed.
    """
    message = "a color bar needs Pillow: pip install 'harnack[film]', or leave color_bar away"
    image, draw, font = (
        import_optional(f"PIL.{name}", message) for name in ("Image", "ImageDraw", "ImageFont")
    )
    return image, draw, font


def typeface_for(text: str, size: int) -> Any:
    """Return a typeface of Pillow that has all letters of a text. It is Pillow's own for plain
    ASCII text; otherwise the first one of a list that is installed on this machine and has the
    letters.

    size: the height of letters in pixels.

    Raises:
        ValueError: no typeface has all letters.
    """
    _, _, typefaces = require_pillow()
    default = typefaces.load_default(size)
    if text.isascii():
        return default
    for name in _TYPEFACES:
        try:
            typeface = typefaces.truetype(name, size)
        except OSError:  # it is not installed
            continue
        # A typeface draws the same sign for every letter that it lacks.
        missing_sign = bytes(typeface.getmask(_NO_LETTER))
        if all(letter == " " or bytes(typeface.getmask(letter)) != missing_sign for letter in text):
            return typeface
    raise ValueError(
        f"no typeface that was found here has all letters of {text!r}: install DejaVu Sans "
        "(Debian's fonts-dejavu-core), or write the title in plain ASCII letters"
    )


def add_color_bar(pixels: Pixels, scale: ColorScale, background: Color) -> Pixels:
    """Put the color bar of a scale to the right of a picture (h, w, 3). Returns the wider picture.

    background: the sRGB color, in [0, 1], behind the bar.

    An end of the bar is pointed if the picture has numbers beyond it (`ColorScale.exceeded`).
    """
    # The background is light if its channels have a mean above 1/2.
    background_bytes = tuple(round(255 * fraction) for fraction in background)
    ink_color = _ON_LIGHT if sum(background) > 1.5 else _ON_DARK
    images, drawings, _ = require_pillow()
    height = len(pixels)
    letter_height = max(_MIN_LETTER_HEIGHT, round(_LETTER_HEIGHT * height))
    font = typeface_for(scale.name, letter_height)
    bar_length = max(2, min(round(_BAR_HEIGHT * height), height - 4 * letter_height))
    bar_width, gap = max(3, round(_BAR_WIDTH * height)), max(2, letter_height // 2)
    # Ticks are two heights of letters apart, but at least two are asked for.
    ticks = scale.ticks(max(2, min(6, bar_length // (2 * letter_height))))
    tick_width = max(font.getlength(text) for _, text in ticks)
    width = max(bar_width + gap + tick_width, font.getlength(scale.name))
    strip = images.new("RGB", (math.ceil(width) + 2 * letter_height, height), background_bytes)
    top = (height - bar_length + letter_height) // 2
    # In Pillow's anchors, l is left, s the baseline and m the middle of the letters.
    strip_drawing = drawings.Draw(strip)
    tip_height = gap if any(scale.exceeded) else 0
    title_y = max(0, top - gap - tip_height)
    # The title, above the bar.
    strip_drawing.text((letter_height, title_y), scale.name, font=font, fill=ink_color, anchor="ls")
    values = scale.high - (np.arange(bar_length) + 0.5) / bar_length * (scale.high - scale.low)
    if scale.period is not None:  # the upper end is the lower one
        values = np.minimum(values, np.nextafter(scale.high, scale.low))
    column = (scale.colors(values) * 255 + 0.5).astype(np.uint8)
    # The bar, row by row from the top.
    for row, color in enumerate(column):
        strip_drawing.line(
            [(letter_height, top + row), (letter_height + bar_width - 1, top + row)],
            fill=tuple(color),
        )
    # The pointed ends, as triangles below and above the bar.
    for is_passed, row, tip_offset, color in zip(
        scale.exceeded,
        (top + bar_length, top - 1),
        (tip_height, -tip_height),
        (column[-1], column[0]),
        strict=True,
    ):
        if is_passed:
            ends = [
                (letter_height, row),
                (letter_height + bar_width - 1, row),
                (letter_height + bar_width // 2, row + tip_offset),
            ]
            strip_drawing.polygon(ends, fill=tuple(color))
    # The ticks to the right of the bar.
    for value, text in ticks:
        fraction = (value - scale.low) / (scale.high - scale.low) if scale.high > scale.low else 0.5
        y = top + round((1 - fraction) * (bar_length - 1))
        right = letter_height + bar_width
        strip_drawing.line([(right, y), (right + gap // 2, y)], fill=ink_color)
        strip_drawing.text((right + gap, y), text, font=font, fill=ink_color, anchor="lm")
    return np.concatenate([pixels, np.asarray(strip, dtype=np.uint8)], axis=1)
