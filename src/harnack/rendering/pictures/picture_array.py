"""What `render` returns: the numbers of a picture, which know how they look."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.mitsuba.variant import load_mitsuba
from harnack.rendering.pictures.images import png_bytes


class Picture(np.ndarray[Any, np.dtype[Any]]):
    """The numbers of a picture, an array like any other, which notebooks show.

    What is computed from it is an ordinary array: it has no looks of its own.
    """

    _shown: npt.NDArray[np.uint8] | None = None

    @classmethod
    def of(cls, numbers: npt.NDArray[Any], shown: npt.NDArray[np.uint8]) -> Picture:
        """Numbers, and the pixels (h, w), (h, w, 3) or (h, w, 4) that they are shown as."""
        picture = numbers.view(cls)
        picture._shown = shown
        return picture

    def __array_finalize__(self, array: Any) -> None:
        if isinstance(array, Picture) and array.shape == self.shape:  # a copy
            self._shown = array._shown

    def __reduce__(self) -> Any:
        return _restored, (np.asarray(self), self._shown)

    def __deepcopy__(self, memo: Any) -> Picture:
        return self.copy()

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    @property
    def shown(self) -> npt.NDArray[np.uint8]:
        """The pixels that are shown: sRGB in bytes, (h, w, 3), or (h, w, 4) with alpha.

        Raises:
            AttributeError: this array was computed from that of a picture.
        """
        if self._shown is None:
            raise AttributeError(
                "this array was computed from a picture: only what `render` returned has `.shown`"
            )
        return self._shown

    def to_pil(self) -> Any:
        """As an image of Pillow's.

        Raises:
            ModuleNotFoundError: Pillow is not installed.
        """
        try:
            from PIL import Image
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "to_pil needs Pillow: pip install pillow, or take the bytes in `.shown`"
            ) from None
        return Image.fromarray(self.shown)

    def _repr_png_(self) -> bytes | None:
        """For notebooks."""
        return None if self._shown is None else png_bytes(load_mitsuba(), self._shown)


def _restored(numbers: npt.NDArray[Any], shown: npt.NDArray[np.uint8] | None) -> Picture:
    return numbers.view(Picture) if shown is None else Picture.of(numbers, shown)
