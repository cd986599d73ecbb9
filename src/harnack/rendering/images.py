"""Pictures as arrays and as files: the array that `render` returns, tone mapping from linear light
to 8-bit sRGB, and PNG and EXR files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.files.file_geometry import check_writable, write_atomically
from harnack.optional_packages import import_optional
from harnack.rendering.mitsuba import load_mitsuba

FloatImage = npt.NDArray[np.float32]

# Radiances up to here are shown as they are; brighter ones approach white smoothly.
SHOULDER_START = 0.8
# The transfer function of sRGB (IEC 61966-2-1): a line up to a linear value, which it takes to a
# value of sRGB; beyond them (1 + offset) x^(1/gamma) - offset.
SRGB_LINEAR_END, SRGB_LINE_END, SRGB_SLOPE = 0.0031308, 0.04045, 12.92
SRGB_OFFSET, SRGB_GAMMA = 0.055, 2.4
_ROWS_AT_ONCE = 64


def check_picture_path(path: Any) -> Path:
    """Return the path of a picture to write, checked.

    Raises:
        TypeError: it is no path.
        ValueError: its extension is neither .png nor .exr.
        OSError: no file can be created there.
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


def tone_map(image: FloatImage, behind: FloatImage | None = None) -> npt.NDArray[np.uint8]:
    """Convert an image of linear sRGB radiance to 8-bit sRGB. Bright light is compressed smoothly,
    then the transfer function of sRGB is applied.

    image: (h, w) or (h, w, 3); or (h, w, 4) with alpha, by which the other channels are multiplied.
        In the result they are divided by alpha, as PNG files need it.
    behind: (h, w, 3) linear sRGB to lay the image over, which is not compressed. It needs an image
        with alpha, and then the result has three channels.
    """
    shape = image.shape if behind is None else behind.shape
    shown = np.empty(shape, dtype=np.uint8)
    # By groups of rows, as the picture in float64 would take much memory.
    for start in range(0, len(image), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        shown[rows] = _tone_mapped(
            image[rows].astype(np.float64), None if behind is None else behind[rows]
        )
    return shown


def _tone_mapped(image: FloatArray, behind: FloatImage | None) -> npt.NDArray[np.uint8]:
    """Apply `tone_map` to some rows of an image. behind: the same rows of what lies behind it, or
    None."""
    if image.ndim < 3 or image.shape[-1] < 4:
        return to_uint8(linear_to_srgb(_apply_shoulder(image)))
    alpha = np.clip(image[..., 3:], 0.0, 1.0)
    # Light is compressed as it is without alpha: it is divided by alpha first.
    light = _apply_shoulder(image[..., :3] / np.where(alpha > 0, alpha, 1.0))
    if behind is not None:
        return to_uint8(linear_to_srgb(alpha * light + (1.0 - alpha) * behind))
    return to_uint8(np.concatenate([linear_to_srgb(light), alpha], axis=-1))


def _apply_shoulder(radiance: FloatArray) -> FloatArray:
    """Compress radiance above 0.8 smoothly to at most 1. Negative numbers and NaN become 0."""
    return compress_highlights(np.clip(np.nan_to_num(radiance, nan=0.0, posinf=1e6), 0.0, None))


def compress_highlights(
    radiance: Any, select: Callable[..., Any] = np.where, exp: Callable[[Any], Any] = np.exp
) -> Any:
    """Compress radiance, which is not negative, above 0.8 smoothly to at most 1.

    radiance: NumPy's numbers; or Dr.Jit's, with `drjit.select` and `drjit.exp`.
    """
    room = 1 - SHOULDER_START
    compressed = 1 - room * exp((SHOULDER_START - radiance) / room)
    return select(radiance > SHOULDER_START, compressed, radiance)


def linear_to_srgb(x: Any, select: Callable[..., Any] = np.where) -> Any:
    """Convert linear sRGB in [0, 1] to sRGB, by its transfer function.

    x: NumPy's numbers; or Dr.Jit's, with `drjit.select`.
    """
    power = (1 + SRGB_OFFSET) * x ** (1 / SRGB_GAMMA) - SRGB_OFFSET
    return select(x <= SRGB_LINEAR_END, SRGB_SLOPE * x, power)


def srgb_to_linear(x: Any) -> FloatArray:
    """Convert sRGB in [0, 1], a number or an array, to linear sRGB, in which amounts of light can
    be added: the inverse of `linear_to_srgb`."""
    power = ((x + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_GAMMA
    linear: FloatArray = cast("Any", np.where)(x <= SRGB_LINE_END, x / SRGB_SLOPE, power)
    return linear


def to_uint8(image: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.uint8]:
    """Convert numbers in [0, 1] to bytes. Other numbers are clipped."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_image(
    mi: Any, path: Path, image: npt.NDArray[Any], names: Sequence[str] | None = None
) -> None:
    """Write an image to a file. The file is replaced only if all of it was written.

    path: .exr or .png.
    image: (h, w), (h, w, 3) or (h, w, 4), floats for EXR and bytes for PNG.
    names: of the channels of an EXR file, if they are other than Y, RGB or RGBA.
    """
    with write_atomically(path) as partial:
        if path.suffix.lower() == ".exr":
            partial.write_bytes(exr_bytes(image, names))
        else:
            partial.write_bytes(png_bytes(mi, image))


def png_bytes(mi: Any, image: npt.NDArray[np.uint8]) -> bytes:
    """Return the bytes of a PNG file. image: bytes (h, w), (h, w, 3) or (h, w, 4) with alpha."""
    # Through memory: Mitsuba's own files do not say why they cannot be written.
    packed = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(image)).write(packed, mi.Bitmap.FileFormat.PNG)
    return packed.raw_buffer()


def exr_bytes(image: npt.NDArray[np.floating[Any]], names: Sequence[str] | None = None) -> bytes:
    """Return the bytes of an OpenEXR file of an image.

    image: without `names`, (h, w) with the channel Y; (h, w, 3) with R, G and B; or (h, w, 4) with
        A as well, by which the others are multiplied. With `names`, (h, w, n).
    names: the names of the n channels; None for those above.
    """
    # Mitsuba writes them too, but waits for ever where Dr.Jit has one thread (OpenEXR 2.5 hands
    # its work to a pool without threads).
    import OpenEXR  # here, since most pictures do without

    numbers = np.asarray(image, dtype=np.float32)
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if names is None:
        name = "Y" if image.ndim == 2 else {3: "RGB", 4: "RGBA"}[image.shape[-1]]
        channels = {name: np.ascontiguousarray(numbers)}
    else:
        channels = {name: np.ascontiguousarray(numbers[..., k]) for k, name in enumerate(names)}
    # Before version 3.5, which needs Python 3.11, it writes to named files only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "picture.exr")
        OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()


class Picture(np.ndarray[Any, np.dtype[Any]]):
    """The array of numbers that `render` returns. Notebooks show it as an image.

    Arrays that are computed from it are ordinary arrays, which notebooks do not show as images.
    """

    _srgb: npt.NDArray[np.uint8] | None = None

    @classmethod
    def of(cls, numbers: npt.NDArray[Any], pixels: npt.NDArray[np.uint8]) -> Picture:
        """Return a picture with these numbers, which notebooks show by the pixels (h, w), (h, w, 3)
        or (h, w, 4)."""
        picture = numbers.view(cls)
        picture._srgb = pixels
        return picture

    def __array_finalize__(self, array: Any) -> None:
        if isinstance(array, Picture) and array.shape == self.shape:  # a copy
            self._srgb = array._srgb

    def __reduce__(self) -> Any:
        return _restored, (np.asarray(self), self._srgb)

    def __deepcopy__(self, memo: Any) -> Picture:
        return self.copy()

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    @property
    def srgb(self) -> npt.NDArray[np.uint8]:
        """The pixels that are shown: 8-bit sRGB, (h, w, 3), or (h, w, 4) with alpha.

        Raises:
            AttributeError: this array was computed from a picture and has no pixels.
        """
        if self._srgb is None:
            raise AttributeError(
                "this array was computed from a picture: only what `render` returned has `.srgb`"
            )
        return self._srgb

    def to_pil(self) -> Any:
        """Return the picture as an image of the package Pillow.

        Raises:
            ModuleNotFoundError: Pillow is not installed.
        """
        message = "to_pil needs Pillow: pip install pillow, or take the bytes in `.srgb`"
        return import_optional("PIL.Image", message).fromarray(self.srgb)

    def _repr_png_(self) -> bytes | None:
        """Return the bytes of a PNG file, which notebooks show; None for an array that was computed
        from a picture."""
        return None if self._srgb is None else png_bytes(load_mitsuba(), self._srgb)


def _restored(numbers: npt.NDArray[Any], shown: npt.NDArray[np.uint8] | None) -> Picture:
    """Return a picture from its numbers and from the pixels that are shown (None if it has none).
    Pickle calls this to rebuild it."""
    return numbers.view(Picture) if shown is None else Picture.of(numbers, shown)
