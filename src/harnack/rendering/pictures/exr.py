"""Writing OpenEXR files: float32 scan lines with ZIP compression.

Mitsuba writes them too, but waits for ever where Dr.Jit has a single thread (OpenEXR 2.5 hands
its work to a pool without threads).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt


def exr_bytes(image: npt.NDArray[np.floating[Any]]) -> bytes:
    """An OpenEXR file of an image (h, w) with channel Y, (h, w, 3) with R, G and B, or (h, w, 4)
    with A as well, by which these are multiplied."""
    import OpenEXR  # here, since most pictures do without

    name = "Y" if image.ndim == 2 else {3: "RGB", 4: "RGBA"}[image.shape[-1]]
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(image, dtype=np.float32)}
    # Before version 3.5, which needs Python 3.11, it writes to named files only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "picture.exr")
        OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()
