"""What stands behind the surfaces in place of the studio's wall: colors and images."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.files.file_format import Place, read_bytes
from harnack.names import did_you_mean
from harnack.rendering.mitsuba.variant import load_mitsuba
from harnack.rendering.studio.lighting import GROUNDS
from harnack.rendering.surfaces.colors import NAMED_COLORS, Color, color_of

FloatImage = npt.NDArray[np.float32]

TRANSPARENT = "transparent"
BACKDROPS = (*GROUNDS, "white", TRANSPARENT)
"""Names. Those of colors will do as well."""
IMAGE_FILES = (".png", ".jpg", ".jpeg", ".exr")


@dataclass(frozen=True)
class Ground:
    """The studio's floor, going over into a wall. name: in GROUNDS."""

    name: str


@dataclass(frozen=True)
class Gradient:
    """From a color at the bottom of a picture to one at its top, both in sRGB."""

    bottom: Color
    top: Color


@dataclass(frozen=True, eq=False)
class Photo:
    """An image, pixels (h, w, 3) of linear sRGB, first row at the top, that fills a picture."""

    pixels: FloatImage


Backdrop = Ground | Gradient | Photo | None
"""None for nothing: the picture is transparent there."""


def checked_backdrop(given: Any) -> Backdrop:
    """What is to be behind the surfaces.

    Raises:
        TypeError, ValueError: none of what there is, naming what there is.
        FileFormatError: an image's file that cannot be read.
    """
    if isinstance(given, os.PathLike):
        return Photo(_read(Path(cast("os.PathLike[str]", given))))
    if isinstance(given, np.ndarray) and given.ndim != 1:
        return Photo(_pixels(cast("npt.NDArray[Any]", given)))
    if isinstance(given, str):
        return _named(given)
    if isinstance(given, list | tuple) and len(pair := cast("list[Any]", given)) == 2:
        return Gradient(*(color_of(one, "a color of the backdrop") for one in pair))
    try:
        color = color_of(given, "backdrop")
    except TypeError:
        raise TypeError(f"backdrop must be one of {_KNOWN}, not {given!r}") from None
    return Gradient(color, color)


_KNOWN = (
    f"{', '.join(BACKDROPS)}, a color, (bottom, top) with two colors, an image (h, w, 3) or its "
    f"file ({', '.join(IMAGE_FILES)})"
)


def _named(given: str) -> Backdrop:
    if given in GROUNDS:
        return Ground(given)
    if given == TRANSPARENT:
        return None
    if Path(given).suffix.lower() in IMAGE_FILES:
        return Photo(_read(Path(given)))
    try:
        color = color_of(given, "backdrop")
    except ValueError:
        known = (*BACKDROPS, *NAMED_COLORS)
        raise ValueError(
            f"backdrop must be one of {_KNOWN}, not {given!r}{did_you_mean(given, known)}"
        ) from None
    return Gradient(color, color)


def _pixels(image: npt.NDArray[Any]) -> FloatImage:
    """An array as an image: bytes are sRGB, other numbers linear."""
    wrong = f"a backdrop's image must have the shape (h, w, 3), not {image.shape}"
    if image.ndim != 3 or image.shape[-1] != 3 or not image.size:
        raise ValueError(wrong)
    if image.dtype == np.uint8:
        return _decoded(load_mitsuba().Bitmap(np.ascontiguousarray(image)))
    if image.dtype.kind not in "fiu":
        raise TypeError(f"a backdrop's image must hold numbers, not {image.dtype}")
    pixels = image.astype(np.float32)
    if not (np.isfinite(pixels).all() and pixels.min() >= 0):
        raise ValueError("a backdrop's image must hold finite numbers that are not negative")
    if image.dtype.kind != "f" and pixels.max() > 1:
        raise TypeError(f"a backdrop's image must hold bytes (uint8) or floats, not {image.dtype}")
    return pixels


def _read(path: Path) -> FloatImage:
    """The image in a file; what is clear in it is white."""
    if path.suffix.lower() not in IMAGE_FILES:
        raise Place(path).error(f"a backdrop is an image: {', '.join(IMAGE_FILES)}")
    data = read_bytes(path)
    try:
        return _of_exr(data) if path.suffix.lower() == ".exr" else _of_bytes(data)
    except (RuntimeError, ValueError, KeyError, OSError) as error:
        raise Place(path).error(
            f"this is no image that can be read as {path.suffix.lower()}"
        ) from error


def _of_bytes(data: bytes) -> FloatImage:
    mi = load_mitsuba()
    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    return _decoded(mi.Bitmap(stream))


def _decoded(bitmap: Any) -> FloatImage:
    """The pixels of one of Mitsuba's bitmaps."""
    mi = load_mitsuba()
    clear = bitmap.has_alpha()
    kind = mi.Bitmap.PixelFormat.RGBA if clear else mi.Bitmap.PixelFormat.RGB
    pixels = np.array(bitmap.convert(kind, mi.Struct.Type.Float32, False), dtype=np.float32)
    if clear:
        pixels = pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:])
    return np.ascontiguousarray(pixels)


def _of_exr(data: bytes) -> FloatImage:
    """Not by Mitsuba, which waits for ever where Dr.Jit has one thread."""
    import OpenEXR  # here, since most pictures do without

    library = cast("Any", OpenEXR)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "backdrop.exr")
        path.write_bytes(data)
        with library.File(str(path)) as file:
            channels: dict[str, FloatImage] = {
                name: np.array(one.pixels, dtype=np.float32)
                for name, one in file.channels().items()
            }
    if "RGBA" in channels:  # colors are multiplied by alpha
        both = channels["RGBA"]
        pixels = both[..., :3] + (1 - np.clip(both[..., 3:], 0, 1))
    elif "RGB" in channels:
        pixels = channels["RGB"]
    else:  # KeyError: no colors at all
        pixels = np.repeat(channels["Y"][..., None], 3, axis=-1)
    return np.maximum(np.nan_to_num(pixels, posinf=1e6), 0)
