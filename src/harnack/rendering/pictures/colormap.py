"""Numbers as colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

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
