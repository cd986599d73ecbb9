"""Numbers as colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.rendering.pictures.images import transferred

# Least-squares polynomial of degree 6 to the map "viridis" (Smith and van der Walt, matplotlib,
# 2015, CC0), lowest degree first; off by at most 0.017.
_VIRIDIS = np.array(
    [
        [0.2745, 0.0058, 0.3327],
        [0.1077, 1.3965, 1.3868],
        [-0.3272, 0.2148, 0.0920],
        [-4.5999, -5.7582, -19.2918],
        [6.2037, 14.1540, 56.6563],
        [4.7518, -13.7494, -65.3210],
        [-5.4321, 4.6416, 26.2721],
    ]
)


def viridis(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Colours (..., 3) in sRGB, in [0, 1], of numbers (...) in [0, 1]: dark blue to yellow.

    Equal differences look equally large, and it reads well in grey and for the colour-blind.
    """
    x = np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64)
    colours = np.zeros((*x.shape, 3))
    for coefficients in _VIRIDIS[::-1]:  # Horner
        colours = colours * x[..., None] + coefficients
    return np.clip(colours, 0.0, 1.0)


# Of OKLab (Ottosson 2020): to the cube roots of cone responses, and from these to linear sRGB.
_TO_CONES = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_FROM_CONES = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)
# Of equally light colours in a circle: none leaves sRGB.
_LIGHTNESS, _CHROMA = 0.72, 0.11


def hues(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Colours (..., 3) in sRGB of numbers (...) of which 0 and 1 are the same: all hues, equally
    light and equally far from grey."""
    angle = 2 * np.pi * np.nan_to_num(x).astype(np.float64)
    lab = np.stack(
        [np.full_like(angle, _LIGHTNESS), _CHROMA * np.cos(angle), _CHROMA * np.sin(angle)], axis=-1
    )
    light = (lab @ _TO_CONES.T) ** 3 @ _FROM_CONES.T
    return np.clip(transferred(light), 0.0, 1.0)


def greys(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Greys (..., 3) of numbers (...) in [0, 1]: 0 is white, 1 is dark."""
    grey = 0.25 + 0.75 * (1 - np.clip(np.nan_to_num(x), 0.0, 1.0).astype(np.float64))
    return np.repeat(grey[..., None], 3, axis=-1)
