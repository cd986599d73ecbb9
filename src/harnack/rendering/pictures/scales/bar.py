"""A bar of colours beside a picture, with ticks at nice numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.pictures.scales.scale import Scale
from harnack.rendering.surfaces.colours import Colour

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


def with_bar(pixels: Pixels, scale: Scale, background: Colour) -> Pixels:
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
    column = (scale.colours(values) * 255 + 0.5).astype(np.uint8)
    for row, colour in enumerate(column):
        draw.line([(letters, top + row), (letters + thick - 1, top + row)], fill=tuple(colour))
    for is_passed, row, away, colour in zip(
        scale.passed, (top + length, top - 1), (point, -point), (column[-1], column[0]), strict=True
    ):
        if is_passed:
            ends = [(letters, row), (letters + thick - 1, row), (letters + thick // 2, row + away)]
            draw.polygon(ends, fill=tuple(colour))
    for value, text in ticks:
        part = (value - scale.low) / (scale.high - scale.low) if scale.high > scale.low else 0.5
        y = top + round((1 - part) * (length - 1))
        right = letters + thick
        draw.line([(right, y), (right + gap // 2, y)], fill=ink)
        draw.text((right + gap, y), text, font=font, fill=ink, anchor="lm")
    return np.concatenate([pixels, np.asarray(strip, dtype=np.uint8)], axis=1)
