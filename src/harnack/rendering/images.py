"""Pictures as files: tone mapping, PNG and EXR."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.geometry.files import write_atomically
from harnack.rendering.exr import exr_bytes

FloatImage = npt.NDArray[np.float32]

# Radiances up to here are shown as they are; brighter ones approach white smoothly.
_SHOULDER = 0.8


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """The path of a picture to write.

    Raises:
        ValueError: its extension is neither .png nor .exr.
        FileNotFoundError: its folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in (".png", ".exr"):
        raise ValueError(f"{path}: pictures are written as .png or .exr")
    if not path.resolve().parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: create the folder {path.parent} first")
    return path


def tone_mapped(radiance: FloatImage) -> npt.NDArray[np.uint8]:
    """Linear sRGB radiance as 8-bit sRGB: a smooth shoulder, then the transfer function."""
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
            mi.Bitmap(np.ascontiguousarray(image)).write(str(partial))
