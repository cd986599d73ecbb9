"""Noise taken out of pictures by Open Image Denoise, a neural network that runs on CPUs.

It guesses: what comes out looks clean and is close to what more samples would have shown, but no
number of it is a mean of samples any more.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.pictures.light_paths.exposure import Exposure


def load_denoiser() -> Any:
    """The package `pyoidn`.

    Raises:
        ModuleNotFoundError: it is not installed, or its library cannot be loaded.
    """
    try:
        return importlib.import_module("pyoidn")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "denoise needs Open Image Denoise: pip install 'harnack[denoise]'"
        ) from None
    except OSError as wrong:
        raise ModuleNotFoundError(f"Open Image Denoise cannot be loaded: {wrong}") from None


def denoised(found: Exposure) -> npt.NDArray[np.float32]:
    """The image of an exposure with features, (h, w, 4), without noise. What part of each pixel is
    covered stays as it is."""
    if found.albedo is None or found.normal is None:
        raise ValueError("an exposure without features cannot be denoised")
    light = np.maximum(found.image[..., :3], 0)
    features = (np.clip(found.albedo, 0, 1), np.clip(found.normal, -1, 1))
    parts = [np.ascontiguousarray(part, dtype=np.float32) for part in (light, *features)]
    clean = load_denoiser().denoise(parts[0], albedo=parts[1], normal=parts[2], hdr=True)
    return np.concatenate([clean, found.image[..., 3:]], axis=-1)
