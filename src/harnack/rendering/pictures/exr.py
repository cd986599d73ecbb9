"""Writing OpenEXR files: float32 scan lines with ZIP compression.

Mitsuba writes them too, but waits for ever where Dr.Jit has a single thread (OpenEXR 2.5 hands
its work to a pool without threads).
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

_MAGIC, _VERSION = 20000630, 2
_FLOAT, _ZIP, _INCREASING_Y = 2, 3, 0
_LINES_A_BLOCK = 16  # of ZIP compression


def exr_bytes(image: npt.NDArray[np.floating[Any]]) -> bytes:
    """An OpenEXR file of an image (h, w) with channel Y or (h, w, 3) with R, G and B.

    Source: "The OpenEXR File Layout", openexr.com, and the ZIP coding of the reference library.
    """
    names = {2: ("Y",), 3: ("R", "G", "B")}[image.ndim]
    height, width = image.shape[:2]
    order = sorted(range(len(names)), key=lambda k: names[k])
    header = _header([names[k] for k in order], width, height)
    chunks: list[bytes] = []
    for y in range(0, height, _LINES_A_BLOCK):  # one at a time: pictures may be large
        planes = image[y : y + _LINES_A_BLOCK].astype("<f4").reshape(-1, width, len(names))
        block = _compressed(planes[:, :, order].transpose(0, 2, 1).tobytes())
        chunks.append(struct.pack("<ii", y, len(block)) + block)
    sizes = [len(chunk) for chunk in chunks]
    first = len(header) + 8 * len(chunks)
    offsets = first + np.concatenate([[0], np.cumsum(sizes[:-1])])
    return header + offsets.astype("<u8").tobytes() + b"".join(chunks)


def _header(channels: list[str], width: int, height: int) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iB3x2i", _FLOAT, 0, 1, 1) for name in channels
    )
    attributes = [
        ("channels", "chlist", listed + b"\0"),
        ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", bytes([_INCREASING_Y])),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    packed = b"".join(
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    return struct.pack("<ii", _MAGIC, _VERSION) + packed + b"\0"


def _compressed(raw: bytes) -> bytes:
    """Even bytes before odd ones, differences of neighbours, zlib; as it was if not shorter."""
    data = np.frombuffer(raw, dtype=np.uint8)
    halves = np.concatenate([data[0::2], data[1::2]])
    halves[1:] = halves[1:] - halves[:-1] + np.uint8(128)
    packed = zlib.compress(halves.tobytes())
    return packed if len(packed) < len(raw) else raw
