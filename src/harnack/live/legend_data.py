"""Legends of live pictures that are colored by numbers: `show` other than "shaded". legend.js draws
them beside the picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.rendering.images import to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.scales import viridis

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = [
    "EVALUATIONS_TOP", "FAR_GRAY", "HIT_COLOR", "NEAR_GRAY", "evaluations_share", "legends",
]  # fmt: skip

# The evaluations that are brightest, and where a scale of them has ticks.
EVALUATIONS_TOP = 64
_EVALUATIONS = (0, 3, 15, EVALUATIONS_TOP)
_STOPS = 13
# sRGB of what is nearest, of what is farthest, and of what is hit: also in passes.wgsl.
NEAR_GRAY, FAR_GRAY, HIT_COLOR = 0.95, 0.12, (0.93, 0.93, 0.90)


def evaluations_share(evaluations: Any) -> Any:
    """The position of numbers of evaluations on their scale, which is logarithmic: 0 for none, 1
    for `EVALUATIONS_TOP`."""
    return np.log2(1.0 + np.asarray(evaluations)) / math.log2(1.0 + EVALUATIONS_TOP)


def legends() -> dict[str, Any]:
    """The legend of each kind of picture, by the name of the picture: a title, and either the
    colors of a scale, from its low end to its high end in equal steps, or swatches, which are names
    and their colors.

    In a legend, "ticks" are the positions of numbers on the scale, from 0 to 1, and their labels;
    None for the least and the greatest number that is seen, which are lengths in the unit of the
    surfaces.
    """
    lost = ["out of steps", _css(OUT_OF_STEPS_COLOR)]
    ticks = [[float(evaluations_share(n)), str(n)] for n in _EVALUATIONS[:-1]] + [
        [1.0, f"{EVALUATIONS_TOP}+"]
    ]
    return {
        "evaluations": {
            "title": "evaluations of a ray, log scale",
            "colors": [_css(color) for color in viridis(np.linspace(0, 1, _STOPS))],
            "ticks": ticks,
            "swatches": [lost],
        },
        "depth": {
            "title": "depth, in units of the surface",
            "colors": [_css((gray,) * 3) for gray in (NEAR_GRAY, FAR_GRAY)],
            "ticks": None,
            "swatches": [lost],
        },
        "normal": {
            "title": "normal: x, y, z as red, green, blue",
            "swatches": [
                *([f"+{axis}", _css(0.5 + 0.5 * np.eye(3)[k])] for k, axis in enumerate("xyz")),
                *([f"-{axis}", _css(0.5 - 0.5 * np.eye(3)[k])] for k, axis in enumerate("xyz")),
                lost,
            ],
        },
        "status": {
            "title": "outcome of a ray",
            "swatches": [["hit", _css(HIT_COLOR)], ["miss", None], lost],
        },
    }


def _css(color: Sequence[float] | Any) -> str:
    return "#" + bytes(to_uint8(np.array(color, np.float64))).hex()
