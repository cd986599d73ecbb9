"""Finds where a picture jumps: points on scanlines between two rays that see different things, such
as a surface and the background beside it. They are found by bisection with proved first hits, so
that what is seen on both sides is certain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import BoolArray, FloatArray, IntArray

# An interval of a scanline is cut into this many parts, again and again.
_PARTS, _ROUNDS = 16, 5
# Jumps of the color count from this fraction of the picture's range of colors on.
_SMALLEST_JUMP = 0.004


@dataclass(frozen=True)
class Seen:
    """What n rays see.

    is_hit: (n,) whether they hit.
    color: (n, c) the channels of the picture.
    t: (n,) the ray parameters of the hits; inf for others.
    position, normal: (n, 3) of the hits.
    """

    is_hit: BoolArray
    color: FloatArray
    t: FloatArray
    position: FloatArray
    normal: FloatArray

    def at(self, index: IntArray | BoolArray) -> Seen:
        """What the rays with these indices see."""
        return Seen(*(array[index] for array in vars(self).values()))


@dataclass(frozen=True)
class Discontinuities:
    """Points of scanlines at which a picture jumps.

    axis: (n,) 0 for horizontal scanlines and 1 for vertical ones.
    screen: (n, 2, 2) two screen points of the scanline, just before and just behind the jump.
    before, behind: what the rays through these two points see.
    """

    axis: IntArray
    screen: FloatArray
    before: Seen
    behind: Seen


def find_discontinuities(
    columns: FloatArray, rows: FloatArray, is_hit: BoolArray, color: FloatArray,
    look: Callable[[FloatArray], Seen],
) -> Discontinuities:  # fmt: skip
    """Find the jumps of a picture on the scanlines of a grid of rays.

    columns, rows: (m,) and (k,) screen coordinates of the grid's lines.
    is_hit, color: (k, m) and (k, m, c) what the rays through the points of the grid see.
    look: what rays through screen points (n, 2) see.

    Two jumps between neighbors that undo each other, as of a wire that is thinner than the distance
    of the lines, are not found.
    """
    threshold = _SMALLEST_JUMP * np.ptp(color, axis=(0, 1)).max()
    axes: list[IntArray] = []
    ends: list[FloatArray] = []
    for axis, hit, shown, along, across in (
        (0, is_hit[1:-1], color[1:-1], columns, rows[1:-1]),
        (1, is_hit[:, 1:-1].T, color[:, 1:-1].swapaxes(0, 1), rows, columns[1:-1]),
    ):
        line, k = np.nonzero(_may_jump(hit, shown, threshold))
        start, end = np.empty((2, len(k), 2))
        start[:, axis], end[:, axis] = along[k], along[k + 1]
        start[:, 1 - axis] = end[:, 1 - axis] = across[line]
        axes.append(np.full(len(k), axis))
        ends.append(np.stack([start, end], axis=1))
    axis, screen = np.concatenate(axes), np.concatenate(ends)
    for _ in range(_ROUNDS):
        axis, screen = _divided(axis, screen, threshold, look)
    seen = look(screen.reshape(-1, 2))
    even = 2 * np.arange(len(axis))
    before, behind = seen.at(even), seen.at(even + 1)
    jumps = _differ(before.is_hit, behind.is_hit, before.color, behind.color, threshold)
    return Discontinuities(axis[jumps], screen[jumps], before.at(jumps), behind.at(jumps))


def _differ(
    first_hit: BoolArray, second_hit: BoolArray, first: FloatArray, second: FloatArray,
    threshold: float,
) -> BoolArray:  # fmt: skip
    """Whether two rays see different things: only one of them hits, or colors differ by more than
    the threshold."""
    return (first_hit != second_hit) | (np.abs(second - first).max(axis=-1) > threshold)


def _may_jump(is_hit: BoolArray, color: FloatArray, threshold: float) -> BoolArray:
    """Whether the picture may jump between neighbors of lines: (k, m - 1) for (k, m) points. It may
    where only one of two hits, and where the change of color differs from that before it or that
    behind it, as it does not where colors change smoothly."""
    change = np.diff(color, axis=1)
    bend = np.abs(np.diff(change, axis=1)).max(axis=-1) > threshold
    bends = np.zeros(change.shape[:2], bool)
    bends[:, 1:] |= bend
    bends[:, :-1] |= bend
    is_large = np.abs(change).max(axis=-1) > threshold
    return (is_hit[:, 1:] != is_hit[:, :-1]) | (is_large & bends)


def _divided(
    axis: IntArray, screen: FloatArray, threshold: float, look: Callable[[FloatArray], Seen]
) -> tuple[IntArray, FloatArray]:
    """Divide intervals of scanlines into parts, and keep those whose ends see different things. A
    smooth change of color is not kept for long, since it is divided among the parts.

    axis, screen: (n,) and (n, 2, 2) the directions and the ends of intervals.
    """
    fraction = np.linspace(0, 1, _PARTS + 1)[None, :, None]
    points = screen[:, :1] * (1 - fraction) + screen[:, 1:] * fraction
    seen = look(points.reshape(-1, 2))
    hit = seen.is_hit.reshape(points.shape[:2])
    color = seen.color.reshape(*points.shape[:2], -1)
    keep = _differ(hit[:, :-1], hit[:, 1:], color[:, :-1], color[:, 1:], threshold)
    which, part = np.nonzero(keep)
    return axis[which], np.stack([points[which, part], points[which, part + 1]], axis=1)
