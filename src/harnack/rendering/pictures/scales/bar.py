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


def with_bar(pixels: Pixels, scale: Scale, background: Colour) -> Pixels:
    """A picture (h, w, 3) with the bar of its scale to the right: (h, w + more, 3).

    An end of the bar is a point where the picture has numbers beyond it.
    background: behind the bar, sRGB in [0, 1].
    """
    behind = tuple(round(255 * part) for part in background)
    ink = _ON_LIGHT if sum(background) > 1.5 else _ON_DARK
    images, drawings, typefaces = require_pillow()
    height = len(pixels)
    letters = max(_LEAST, round(_LETTERS * height))
    font = typefaces.load_default(letters)
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
