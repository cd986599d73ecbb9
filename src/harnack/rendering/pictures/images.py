"""Pictures as files: tone mapping, PNG and EXR."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.files.writing import check_writable, write_atomically
from harnack.rendering.pictures.exr import exr_bytes

FloatImage = npt.NDArray[np.float32]

# Radiances up to here are shown as they are; brighter ones approach white smoothly.
_SHOULDER = 0.8
_ROWS_AT_ONCE = 64


def check_picture_path(path: Any) -> Path:
    """The path of a picture to write.

    Raises:
        TypeError: it is no path.
        ValueError: its extension is neither .png nor .exr.
        OSError: no file can be created there, as `write_atomically` says.
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"path must name a picture to write, such as 'a.png', not {path!r}")
    if path == "":
        raise ValueError("the name of the picture to write is empty: give one, such as a.png")
    path = Path(cast("str | os.PathLike[str]", path))
    if path.suffix.lower() not in (".png", ".exr"):
        raise ValueError(f"{path}: pictures are written as .png or .exr")
    check_writable(path)
    return path


def tone_mapped(radiance: FloatImage) -> npt.NDArray[np.uint8]:
    """Linear sRGB radiance as 8-bit sRGB: a smooth shoulder, then the transfer function."""
    shown = np.empty(radiance.shape, dtype=np.uint8)
    for start in range(0, len(radiance), _ROWS_AT_ONCE):  # float64 is many times the picture
        rows = slice(start, start + _ROWS_AT_ONCE)
        shown[rows] = _tone_mapped(radiance[rows])
    return shown


def _tone_mapped(radiance: FloatImage) -> npt.NDArray[np.uint8]:
    x = np.clip(np.nan_to_num(radiance, nan=0.0, posinf=1e6), 0.0, None).astype(np.float64)
    room = 1.0 - _SHOULDER
    x = np.where(x <= _SHOULDER, x, 1.0 - room * np.exp(-(x - _SHOULDER) / room))
    return as_bytes(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055))


def as_bytes(image: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.uint8]:
    """Numbers in [0, 1] as bytes."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_image(mi: Any, path: Path, image: npt.NDArray[Any]) -> None:
    """Write (h, w) or (h, w, 3) floats as EXR or bytes as PNG; no half-written file is left."""
    with write_atomically(path) as partial:
        if path.suffix.lower() == ".exr":
            partial.write_bytes(exr_bytes(image))
        else:
            # Through memory: Mitsuba's own files do not say why they cannot be written.
            packed = mi.MemoryStream()
            mi.Bitmap(np.ascontiguousarray(image)).write(packed, mi.Bitmap.FileFormat.PNG)
            partial.write_bytes(packed.raw_buffer())
