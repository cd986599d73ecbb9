"""Rays on scanlines for the derivative of a picture where it is smooth.

At a fixed screen point, a hit moves along its ray by -df/(grad f . d): near an outline, at the
distance r on the screen, this grows like r^(-1/2). Its integral is finite, but the variance of
rays at random places is not. So rays are placed by the pieces of scanlines between discontinuities,
densest at outlines: with u = a + (b - a) q^2 for an outline at the end a of a piece [a, b], the
density of rays is proportional to (u - a)^(-1/2), and the weighted derivatives are bounded.

Horizontal scanlines take the part m_x^2 of each derivative and vertical ones m_y^2, where m is the
unit vector on the screen along the image of the surface's normal. Near an outline m is its normal;
so where a line runs along an outline, which it then meets nowhere, its part is small."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.inverse.boundary_motion import BoundaryKind

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.inverse.boundary_motion import BoundaryMotion
    from harnack.inverse.discontinuities import Discontinuities
    from harnack.inverse.film import Grid

# Pieces shorter than this part of a pixel are left out: they are mostly none, but rays that pass an
# edge within the tolerance.
_SHORTEST = 0.01
# The number of rays of a piece: so many for each line that it crosses, and at least so many.
_PER_LINE, _FEWEST = 0.5, 4


@dataclass(frozen=True)
class ScanlineSamples:
    """Rays on scanlines.

    axis: (n,) 0 for horizontal scanlines and 1 for vertical ones.
    screen: (n, 2) the screen points.
    length: (n,) of the scanline for which a ray stands, in pixels.
    """

    axis: IntArray
    screen: FloatArray
    length: FloatArray


def scanline_samples(
    grid: Grid, is_hit: BoolArray, jumps: Discontinuities, motion: BoundaryMotion,
    weights: FloatArray, random: np.random.Generator,
) -> ScanlineSamples:  # fmt: skip
    """Place rays on all pieces of scanlines on which the surface is seen.

    is_hit: (k, m) whether the rays through the points of the grid hit.
    jumps, motion: the discontinuities on the scanlines.
    weights: (n,) the number of pieces for which each piece that begins at a jump stands.
    """
    axes: list[IntArray] = []
    screens: list[FloatArray] = []
    lengths: list[FloatArray] = []
    for axis, lines, border_hit in (
        (0, (grid.columns, grid.rows[1:-1]), is_hit[1:-1, 0]),
        (1, (grid.rows, grid.columns[1:-1]), is_hit[0, 1:-1]),
    ):
        along, across = lines
        own = np.flatnonzero(jumps.axis == axis)
        pieces = _Pieces.of(lines, border_hit, jumps.at(own), motion.kind[own], weights[own])
        extent = pieces.end - pieces.start
        density = _PER_LINE * (len(along) - 2) / along[-1]
        count = np.maximum(_FEWEST, np.ceil(extent * density)).astype(int)
        which = np.repeat(np.arange(len(count)), count)
        place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        q = (place + random.uniform(size=len(which))) / count[which]
        u, slope = _warped(q, pieces.starts_at_outline[which], pieces.ends_at_outline[which])
        screen = np.empty((len(which), 2))
        screen[:, axis] = pieces.start[which] + extent[which] * u
        screen[:, 1 - axis] = across[pieces.line[which]]
        axes.append(np.full(len(which), axis))
        screens.append(screen)
        lengths.append((pieces.weight * extent / count)[which] * slope)
    return ScanlineSamples(np.concatenate(axes), np.concatenate(screens), np.concatenate(lengths))


@dataclass(frozen=True)
class _Pieces:
    """The pieces of scanlines of one direction on which the surface is seen.

    line: (n,) the index of the scanline.
    start, end: (n,) coordinates along the scanline.
    starts_at_outline, ends_at_outline: (n,) whether the ray touches the surface at these ends.
    weight: (n,) the number of pieces for which the piece stands.
    """

    line: IntArray
    start: FloatArray
    end: FloatArray
    starts_at_outline: BoolArray
    ends_at_outline: BoolArray
    weight: FloatArray

    @classmethod
    def of(
        cls, lines: tuple[FloatArray, FloatArray], border_hit: BoolArray, jumps: Discontinuities,
        kind: IntArray, weights: FloatArray,
    ) -> _Pieces:  # fmt: skip
        """Divide scanlines at jumps.

        lines: the coordinates of the lines across the scanlines, with both borders, and those of
            the scanlines.
        border_hit: whether each scanline begins on the surface.
        kind, weights: of the jumps, and of the pieces that begin there.
        """
        along, across = lines
        # Pieces begin at the border and at jumps.
        middle, count = jumps.middle, len(across)
        axis = jumps.axis[0] if len(jumps) else 0
        line = np.concatenate([np.arange(count), np.searchsorted(across, middle[:, 1 - axis])])
        start = np.concatenate([np.zeros(count), middle[:, axis]])
        seen = np.concatenate([border_hit, jumps.behind.is_hit])
        is_outline = kind == int(BoundaryKind.OUTLINE)
        outline = np.concatenate([np.zeros(count, bool), is_outline])
        weight = np.concatenate([np.ones(count), weights])
        order = np.lexsort((start, line))
        line, start, outline = line[order], start[order], outline[order]
        is_last = np.append(line[1:] != line[:-1], True)
        end = np.where(is_last, along[-1], np.append(start[1:], 0))
        end_outline = np.append(outline[1:], False) & ~is_last
        pieces = cls(line, start, end, outline, end_outline, weight[order])
        return pieces.at(np.flatnonzero(seen[order] & (end - start > _SHORTEST)))

    def at(self, index: IntArray) -> _Pieces:
        """The pieces with these indices."""
        return _Pieces(
            self.line[index], self.start[index], self.end[index],
            self.starts_at_outline[index], self.ends_at_outline[index], self.weight[index],
        )  # fmt: skip


def _warped(q: FloatArray, at_start: BoolArray, at_end: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Numbers u(q) in [0, 1] and their derivatives, which are 0 at the ends with an outline."""
    cases = [at_start & at_end, at_start, at_end]
    u = np.select(cases, [q * q * (3 - 2 * q), q * q, q * (2 - q)], q)
    return u, np.select(cases, [6 * q * (1 - q), 2 * q, 2 * (1 - q)], 1.0)
