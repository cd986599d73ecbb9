"""Legends of live pictures whose colors stand for numbers: pictures of normals, depths, numbers of
evaluations, and status of rays. The option `show` names the kind of picture. legend.js draws a
legend beside the picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.rendering.aov_render import STATUS_COLORS
from harnack.rendering.images import to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.scales import viridis
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = [
    "EVALUATIONS_TOP", "FAR_GRAY", "NEAR_GRAY", "css_color", "evaluations_share", "legends",
]  # fmt: skip

# The evaluations that are brightest, and where a scale of them has ticks.
EVALUATIONS_TOP = 64
_EVALUATIONS = (0, 3, 15, EVALUATIONS_TOP)
_STOPS = 13
# sRGB of what is nearest, and of what is farthest.
NEAR_GRAY, FAR_GRAY = 0.95, 0.12


def evaluations_share(evaluations: Any) -> Any:
    """Return the positions, on a logarithmic color scale, of numbers of evaluations per ray: 0 for
    no evaluation, 1 for `EVALUATIONS_TOP` evaluations. evaluations: a number or an array of
    numbers; the result has its shape."""
    return np.log2(1.0 + np.asarray(evaluations)) / math.log2(1.0 + EVALUATIONS_TOP)


def legends() -> dict[str, Any]:
    """Return the legends of all kinds of pictures, as JSON data by the value of `show`.

    Each legend has a "title". A legend of a color scale has "colors", CSS colors at equal steps
    from the low end to the high end of the scale, and "ticks", pairs of a position from 0 to 1 on
    the scale and a label. "ticks" is None if the labels are the least and the greatest number in
    the picture. "swatches" are pairs of a name and its CSS color (None for the background).
    """
    out_of_steps_swatch = ["out of steps", css_color(OUT_OF_STEPS_COLOR)]
    hit_swatch = ["hit", css_color(STATUS_COLORS[RayStatus.HIT])]
    # The end of the scale has a "+", as it stands for all larger numbers, too.
    ticks = [[float(evaluations_share(n)), str(n)] for n in _EVALUATIONS[:-1]] + [
        [1.0, f"{EVALUATIONS_TOP}+"]
    ]
    return {
        "evaluations": {
            "title": "evaluations of a ray, log scale",
            "colors": [css_color(color) for color in viridis(np.linspace(0, 1, _STOPS))],
            "ticks": ticks,
            "swatches": [out_of_steps_swatch],
        },
        "depth": {
            "title": "depth, in units of the surface",
            "colors": [css_color((gray,) * 3) for gray in (NEAR_GRAY, FAR_GRAY)],
            "ticks": None,
            "swatches": [out_of_steps_swatch],
        },
        "normal": {
            "title": "normal: x, y, z as red, green, blue",
            # A normal n has the color (n + 1)/2; here it points along an axis, or against it.
            "swatches": [
                *(
                    [f"+{axis}", css_color(0.5 + 0.5 * np.eye(3)[k])]
                    for k, axis in enumerate("xyz")
                ),
                *(
                    [f"-{axis}", css_color(0.5 - 0.5 * np.eye(3)[k])]
                    for k, axis in enumerate("xyz")
                ),
                out_of_steps_swatch,
            ],
        },
        "status": {
            "title": "outcome of a ray",
            "swatches": [hit_swatch, ["miss", None], out_of_steps_swatch],
        },
    }


def css_color(color: Sequence[float] | Any) -> str:
    """Return an sRGB color of three numbers from 0 to 1 as CSS text, such as "#f2f2f2"."""
    return "#" + bytes(to_uint8(np.array(color, np.float64))).hex()
