"""Pixels in bands, and places within them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from harnack.geometry.convex_volume import FloatArray
from harnack.rendering.studio import stratified


def bands(pixels: int, step: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of runs of at most `step` pixels: Ctrl-C works between them."""
    for start in range(0, pixels, step):
        yield start, min(start + step, pixels)


def film_places(mi: Any, pixel: Any, offset: Any, size: tuple[int, int]) -> Any:
    """Places on the film, in [0, 1]^2, of offsets in [0, 1]^2 within pixels counted by rows."""
    place = mi.Vector2f(pixel % size[0], pixel // size[0]) + offset
    return mi.Point2f(place / mi.ScalarVector2f(*size))


def grid_offsets(count: int) -> FloatArray:
    """At least `count` places (n, 2) in the unit square, always the same.

    The canonical arrangement of multi-jittering (Kensler 2013): one in each cell of a grid, and
    no two in the same row or column of the n x n grid, so that edges of any slope look smooth.
    """
    total = stratified(count)
    rows = max(r for r in range(1, total + 1) if total % r == 0 and r * r <= total)
    columns = total // rows
    j, i = (index.ravel() for index in np.mgrid[:rows, :columns])
    x = (i + (j + 0.5) / rows) / columns
    y = (j + (i + 0.5) / columns) / rows
    return np.column_stack([x, y])
