"""Pixels in tiles and bands, and places within them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.backend.arrays import aligned_integers
from harnack.rendering.mitsuba.variant import mitsuba_backend

_TILE = 4
# Neighbors that differ by more than this, of 255, are an edge.
_EDGE = 16


def bands(pixels: int, step: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of runs of at most `step` pixels: Ctrl-C works between them."""
    for start in range(0, pixels, step):
        yield start, min(start + step, pixels)


def in_tiles(size: tuple[int, int]) -> IntArray:
    """All pixels of a picture, counted by rows, one square of 4 x 4 after the other.

    Rays that a processor follows together then have about the same length, whatever the size.
    """
    width, height = size
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    y, x = np.indices((rows * _TILE, columns * _TILE))
    inside = (x < width) & (y < height)
    tiles = np.where(inside, y * width + x, -1).reshape(rows, _TILE, columns, _TILE)
    order = tiles.swapaxes(1, 2).ravel()
    return order[order >= 0]


def uploaded(mi: Any, pixels: IntArray) -> Any:
    """Pixels as one of Mitsuba's arrays."""
    return aligned_integers(mitsuba_backend(mi), pixels)


def film_places(mi: Any, pixel: Any, offset: Any, size: tuple[int, int]) -> Any:
    """Places on the film, in [0, 1]^2, of offsets in [0, 1]^2 within pixels counted by rows."""
    place = mi.Vector2f(pixel % size[0], pixel // size[0]) + offset
    return mi.Point2f(place / mi.ScalarVector2f(*size))


def stratified(spp: int) -> int:
    """The samples a pixel, at least `spp`, that can be arranged in a nearly square grid."""
    rows = max(1, math.isqrt(spp))
    return rows * -(-spp // rows)


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


def edges_of(picture: npt.NDArray[np.uint8]) -> BoolArray:
    """Pixels (h, w) of a picture (h, w, 3) that differ visibly from one of four neighbors."""
    shown = picture.astype(np.int64)
    edge = np.zeros(shown.shape[:2], dtype=np.bool_)
    across = (np.abs(np.diff(shown, axis=1)) > _EDGE).any(axis=-1)
    down = (np.abs(np.diff(shown, axis=0)) > _EDGE).any(axis=-1)
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
