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
    from harnack.inverse.film import Grid

# An interval of a scanline is cut into this many parts, so many times: 1/216 of the distance of the
# lines.
_PARTS, _ROUNDS = 6, 3
# Jumps of the color count from this fraction of the picture's range of colors on.
_SMALLEST_JUMP = 0.004
# A jump has at least this part of the change of color in the interval that was divided last.
_LEAST_OF_JUMP = 0.6
# A piece that is found with a small probability stands for at most this many others.
_MAX_WEIGHT = 8.0


@dataclass(frozen=True)
class Seen:
    """What n rays see.

    is_hit: (n,) whether they hit.
    color: (n, c) the channels of the picture.
    t: (n,) the ray parameters of the hits; inf for others.
    position: (n, 3) of the hits.
    """

    is_hit: BoolArray
    color: FloatArray
    t: FloatArray
    position: FloatArray

    def at(self, index: IntArray | BoolArray) -> Seen:
        """What the rays with these indices see."""
        return Seen(self.is_hit[index], self.color[index], self.t[index], self.position[index])

    def differs_from(self, other: Seen, threshold: float) -> BoolArray:
        """Whether two rays see different things: only one of them hits, or colors differ by more
        than the threshold."""
        jump = np.abs(other.color - self.color).max(axis=-1) > threshold
        return (self.is_hit != other.is_hit) | jump

    @staticmethod
    def joined(parts: list[Seen]) -> Seen:
        """What the rays of all parts see, one part after the other."""
        arrays = zip(*(vars(part).values() for part in parts), strict=True)
        return Seen(*map(np.concatenate, arrays))


@dataclass(frozen=True)
class Discontinuities:
    """Points of scanlines at which a picture jumps.

    axis: (n,) 0 for horizontal scanlines and 1 for vertical ones.
    screen: (n, 2, 2) two screen points of the scanline, just before and just behind the jump.
    before, behind: what the rays through these two points see.
    threshold: by how much more than this the color jumps, if both rays hit.
    """

    axis: IntArray
    screen: FloatArray
    before: Seen
    behind: Seen
    threshold: float

    def __len__(self) -> int:
        """The number of points."""
        return len(self.axis)

    @property
    def middle(self) -> FloatArray:
        """The screen points (n, 2) of the jumps."""
        return self.screen.mean(axis=1)

    @property
    def place(self) -> FloatArray:
        """The coordinates (n,) of the jumps along their scanlines."""
        return self.middle[np.arange(len(self)), self.axis]

    def at(self, index: IntArray | BoolArray) -> Discontinuities:
        """The points with these indices."""
        before, behind = self.before.at(index), self.behind.at(index)
        return Discontinuities(self.axis[index], self.screen[index], before, behind, self.threshold)

    def neighbors(self) -> tuple[IntArray, IntArray]:
        """The indices (k,) of jumps, and of the next jumps on the same scanlines."""
        across = self.middle[np.arange(len(self)), 1 - self.axis]
        order = np.lexsort((self.place, across, self.axis))
        first, second = order[:-1], order[1:]
        is_same = (self.axis[first] == self.axis[second]) & (across[first] == across[second])
        return first[is_same], second[is_same]


def piece_weights(jumps: Discontinuities, grid: Grid) -> FloatArray:
    """For each jump (n,), the number of pieces for which the piece of the scanline that begins
    there stands: 1/P, if the piece was found with the probability P only.

    A piece that ends at another jump, behind which the scanline goes on as it was before the piece,
    is found only if the ray of a column or row lies in it. Each has a random place in its cell, so
    P = 1 - (1 - p_1)(1 - p_2)..., where p_i is the part of cell i that the piece covers.
    """
    weights = np.ones(len(jumps))
    first, second = jumps.neighbors()
    goes_on = ~jumps.before.at(first).differs_from(jumps.behind.at(second), jumps.threshold)
    start, end = jumps.place[first] * grid.samples, jumps.place[second] * grid.samples
    missed = np.ones(len(first))
    for k in range(3):
        cell = np.floor(start) + k
        missed *= 1 - np.clip(np.minimum(end, cell + 1) - np.maximum(start, cell), 0, 1)
    # (Of the three cells, the middle one is covered as a whole by pieces that reach the third.)
    chance = np.maximum(1 - missed, 1 / _MAX_WEIGHT)
    weights[first] = np.where(goes_on, 1 / chance, 1)
    return weights


def jump_weights(jumps: Discontinuities, pieces: FloatArray) -> FloatArray:
    """For each jump (n,), the number of jumps for which it stands: that of the piece that begins or
    ends there, whichever is more. pieces: (n,) the weights of the pieces that begin."""
    first, second = jumps.neighbors()
    weights = pieces.copy()
    weights[second] = np.maximum(weights[second], pieces[first])
    return weights


def find_discontinuities(
    grid: Grid, is_hit: BoolArray, color: FloatArray, look: Callable[[FloatArray], Seen]
) -> Discontinuities:  # fmt: skip
    """Find the jumps of a picture on the scanlines of a grid of rays.

    is_hit, color: (k, m) and (k, m, c) what the rays through the points of the grid see.
    look: what rays through screen points (n, 2) see.

    Two jumps between neighbors that undo each other, as of a wire that is thinner than the distance
    of the lines, are not found (`piece_weights`).
    """
    threshold = _SMALLEST_JUMP * float(np.ptp(color, axis=(0, 1)).max())
    axes: list[IntArray] = []
    ends: list[FloatArray] = []
    sides: list[FloatArray] = []
    bends: list[BoolArray] = []
    for axis, hit, shown, along, across in (
        (0, is_hit[1:-1], color[1:-1], grid.columns, grid.rows[1:-1]),
        (1, is_hit[:, 1:-1].T, color[:, 1:-1].swapaxes(0, 1), grid.rows, grid.columns[1:-1]),
    ):
        line, k = np.nonzero(_may_jump(hit, shown, threshold))
        start, end = np.empty((2, len(k), 2))
        start[:, axis], end[:, axis] = along[k], along[k + 1]
        start[:, 1 - axis] = end[:, 1 - axis] = across[line]
        axes.append(np.full(len(k), axis))
        ends.append(np.stack([start, end], axis=1))
        sides.append(np.stack([shown[line, k], shown[line, k + 1]]).swapaxes(0, 1))
        bends.append(hit[line, k] & hit[line, k + 1])
    axis, screen = np.concatenate(axes), np.concatenate(ends)
    keep = _without_smooth(np.concatenate(bends), screen, np.concatenate(sides), look, threshold)
    axis, screen = axis[keep], screen[keep]
    points = _divisions(screen)
    seen = look(points.reshape(-1, 2))
    jumps = _between(axis, points, seen, threshold)
    for k in range(1, _ROUNDS):
        points = _divisions(jumps.screen)
        # The ends have been looked at.
        inner = look(points[1:-1].reshape(-1, 2))
        seen = Seen.joined([jumps.before, inner, jumps.behind])
        jumps = _between(jumps.axis, points, seen, threshold, is_last=k + 1 == _ROUNDS)
    return jumps


def _without_smooth(
    is_hit: BoolArray, screen: FloatArray, color: FloatArray,
    look: Callable[[FloatArray], Seen], threshold: float,
) -> BoolArray:  # fmt: skip
    """Which of n intervals to divide: those with both ends on the surface only if the ray through
    their middle misses or shows that the color bends. Of a smooth color's bend it finds a quarter,
    and of a jump all.

    is_hit: (n,) whether both ends are on the surface.
    screen, color: (n, 2, 2) and (n, 2, c) the ends, and what is seen there.
    """
    keep, index = np.ones(len(is_hit), bool), np.flatnonzero(is_hit)
    middle = look(screen[index].mean(axis=1))
    bend = np.abs(color[index].sum(axis=1) - 2 * middle.color).max(axis=-1)
    keep[index] = ~middle.is_hit | (bend > threshold)
    return keep


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


def _stands_out(values: FloatArray, threshold: float) -> BoolArray:
    """Where the change from one of m points (m, n, c) to the next is by more than the threshold
    above that before it and that behind it, or below both: (m - 1, n). There the values jump; where
    they are only steep, as near outlines, each change is larger than the last."""
    change = np.diff(values, axis=0)
    more = np.diff(change, axis=0)
    # The first and the last change have one neighbor.
    before = np.concatenate([-more[:1], more])
    behind = np.concatenate([-more, more[-1:]])
    height = np.maximum(np.minimum(before, behind), -np.maximum(before, behind))
    return height.max(axis=-1) > threshold


def _divisions(screen: FloatArray) -> FloatArray:
    """The points (parts + 1, n, 2) that divide intervals (n, 2, 2) into parts, with their ends."""
    fraction = np.linspace(0, 1, _PARTS + 1)[:, None, None]
    # (In this form the coordinate of the scanline stays as it is, bit by bit.)
    return screen[:, 0] + (screen[:, 1] - screen[:, 0]) * fraction


def _between(
    axis: IntArray, points: FloatArray, seen: Seen, threshold: float, *, is_last: bool = False
) -> Discontinuities:
    """The parts of n intervals whose ends see different things: only one of them the surface, or
    other colors, with a change of color or of depth unlike that in the parts beside it.

    axis: (n,) the directions of the scanlines.
    points, seen: (parts + 1, n, 2) the ends of the parts, and what is seen there, in this order.
    is_last: whether to leave out slopes that are still steep, as those of the normal near outlines
        and corners are. Of the change in an interval, a jump has nearly all, and a part of a slope
        only a part: near an outline, where the change is like a square root, at most 6^(-1/2).
    """
    ends = np.stack([points[:-1], points[1:]], axis=2).reshape(-1, 2, 2)
    count, total = len(axis), len(seen.is_hit)
    before, behind = seen.at(np.arange(total - count)), seen.at(np.arange(count, total))
    parts = Discontinuities(np.tile(axis, _PARTS), ends, before, behind, threshold)
    color = seen.color.reshape(_PARTS + 1, count, seen.color.shape[-1])
    t = np.where(seen.is_hit, seen.t, 0).reshape(_PARTS + 1, count, 1)
    t_threshold = _SMALLEST_JUMP * float(np.ptp(seen.t[seen.is_hit])) if seen.is_hit.any() else 0.0
    stands_out = _stands_out(color, threshold) | _stands_out(t, t_threshold)
    differ = before.differs_from(behind, threshold)
    differ &= (before.is_hit != behind.is_hit) | stands_out.ravel()
    if is_last:
        color, first_of_last = seen.color, total - count
        whole = np.tile(np.abs(color[first_of_last:] - color[:count]).max(axis=1), _PARTS)
        step = np.abs(behind.color - before.color).max(axis=1)
        differ &= (before.is_hit != behind.is_hit) | (step > _LEAST_OF_JUMP * whole)
    return parts.at(differ)
