"""Panels side by side, with a line of text below each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import harnack as hk
from harnack.rendering.images import tone_map
from harnack.rendering.scales import viridis

from .figure import Counts
from .view import Pixels

_GAP, _INK, _PAPER = 6, (30, 30, 30), (255, 255, 255)
_LETTERS = 13


@dataclass(frozen=True)
class Panel:
    """A picture (h, w, 3) of bytes, and a line of text."""

    pixels: Pixels
    label: str


def montage(*rows: Sequence[Panel]) -> Image.Image:
    """Rows of panels."""
    strip = _LETTERS + 6
    font = ImageFont.load_default(_LETTERS)
    sizes = [
        (sum(p.pixels.shape[1] + _GAP for p in row) - _GAP, max(p.pixels.shape[0] for p in row))
        for row in rows
    ]
    height = sum(h + strip for _, h in sizes)
    sheet = Image.new("RGB", (max(w for w, _ in sizes), height), _PAPER)
    draw, top = ImageDraw.Draw(sheet), 0
    for row, (_, tall) in zip(rows, sizes, strict=True):
        x = 0
        for panel in row:
            sheet.paste(Image.fromarray(panel.pixels), (x, top))
            draw.text((x + 2, top + tall + 1), panel.label, _INK, font)
            x += panel.pixels.shape[1] + _GAP
        top += tall + strip
    return sheet


def fitting(width: int, share: float = 0.75) -> tuple[int, int]:
    """The size of a panel of a width."""
    return width, round(share * width)


def scene(name: str, width: int, *, share: float = 0.75, **settings: Any) -> tuple[Pixels, Counts]:
    """A picture of a scene of the gallery, and the counts of its first hits."""
    from harnack.gallery import SCENES

    entry = SCENES[name]
    options = {"show": "shaded", "material": list(entry.materials), **settings}
    options.setdefault("camera", entry.camera)
    options.setdefault("options", entry.options)
    surfaces = entry.surfaces()
    if len(options["material"]) == 1:
        options["material"] *= len(surfaces)
    return drawn(surfaces, fitting(width, share), **options)


def drawn(what: Any, size: tuple[int, int], **settings: Any) -> tuple[Pixels, Counts]:
    """A picture by `hk.render`, shaded by default, and the counts of its first hits: one ray
    through the middle of each pixel."""
    settings = {"show": "shaded", **settings}
    image = tone_map(hk.render(what, size=size, progress=False, **settings))
    options = {k: v for k, v in settings.items() if k not in ("show", "spp", "seed", "antialias")}
    status, evaluations = (
        hk.render(what, size=size, show=show, progress=False, **options)
        for show in ("status", "evaluations")
    )
    return image, Counts.of(status, evaluations)


def heat(numbers: Any, top: float, size: tuple[int, int]) -> Pixels:
    """Numbers (n,), row by row, as colors: 0 is dark blue; `top` and larger numbers are yellow."""
    colors = viridis(np.asarray(numbers, np.float64) / top)
    return (colors * 255 + 0.5).astype(np.uint8).reshape(*size[::-1], 3)


def halved(pixels: Pixels) -> Pixels:
    """A picture of half the size: the mean of blocks of four pixels."""
    return np.asarray(Image.fromarray(pixels).reduce(2))


def doubled(pixels: Pixels) -> Pixels:
    """A picture with four pixels for each pixel."""
    return pixels.repeat(2, axis=0).repeat(2, axis=1)
