"""How long a picture will take, told before it is begun."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from harnack.rendering.mitsuba.integrator import PathTracer
from harnack.rendering.pictures.light_paths.exposure import PATHS_A_BAND, follow
from harnack.rendering.pictures.pixels import uploaded

# Paths that are tried: at first, how many times as many next, and no more than this part of all.
_FIRST, _MORE, _PART = 2**12, 4, 1 / 16
# So many times as long as the first can be told from what starting costs.
_ENOUGH = 3.0
# A picture that takes no longer is not told about, in seconds.
SHORT = 15.0
# Seconds between two moves of the progress bar, and the fewest paths of a band.
_BAND, _FEWEST = 4.0, 2**14


@dataclass(frozen=True)
class Pace:
    """Seconds for one path, and for all of a picture."""

    path: float
    picture: float

    @property
    def paths_a_band(self) -> int:
        """Paths that take as long as a progress bar may stand still."""
        return round(min(max(_BAND / max(self.path, 1e-9), _FEWEST), PATHS_A_BAND))

    def __str__(self) -> str:
        seconds = round(self.picture)
        minutes, rest = divmod(seconds, 60)
        hours, left = divmod(minutes, 60)
        if seconds < 90:
            return f"{seconds} s"
        if minutes < 90:
            return f"{minutes} min {rest // 10 * 10} s" if minutes < 10 else f"{minutes} min"
        return f"{hours} h {left} min"


def pace_of(
    mi: Any, scene: Any, sensor: Any, tracer: PathTracer, *, spp: int, features: bool
) -> Pace:
    """Measured on a few paths all over the picture.

    Starting costs the same however many paths there are, so what counts is how much longer four
    times as many took. Of a picture of few paths nothing is measured, and its pace is 0.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels = width * height
    whole = pixels * spp

    def seconds(count: int) -> float:
        # The golden ratio spreads any number of pixels evenly.
        chosen = (np.arange(count) * 0.6180339887498949 % 1 * pixels).astype(np.int64)
        pixel = uploaded(mi, np.minimum(chosen, pixels - 1))
        sample = dr.opaque(mi.UInt32, 0, count)
        began = time.perf_counter()
        found, _ = follow(mi, scene, sensor, tracer, pixel, sample, 0, features)
        dr.eval(found.light)
        dr.sync_thread()
        return time.perf_counter() - began

    count, path = _FIRST, 0.0
    if _MORE * count <= _PART * whole:
        seconds(count)  # compiles
        first = before = seconds(count)
        while _MORE * count <= _PART * whole and before < _ENOUGH * first:
            after = seconds(_MORE * count)
            path = max(after - before, 0.0) / ((_MORE - 1) * count)
            count, before = _MORE * count, after
    return Pace(path, whole * path)
