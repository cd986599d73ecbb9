"""An octree over a box, of which cells that are proved empty are left out."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.geometry import ConvexHull

__all__ = ["Cells", "Clearance", "Octree", "carve", "octree", "union", "wrapped_points"]

Clearance: TypeAlias = Callable[[FloatArray], FloatArray]
"""For points (n, 3) lengths (n,): no point of the set is nearer than that."""

_OCTANTS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class Cells:
    """Boxes of one size, (3,) edges, at corners (n, 3), the least of their coordinates."""

    corners: FloatArray
    size: FloatArray

    @property
    def centers(self) -> FloatArray:
        """(n, 3)."""
        return self.corners + 0.5 * self.size

    @property
    def half_diagonal(self) -> float:
        """The radius of the balls around them."""
        return 0.5 * float(np.linalg.norm(self.size))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The least and the largest coordinates (3,) of all."""
        return self.corners.min(axis=0), self.corners.max(axis=0) + self.size

    def wrapped(self, slack: float) -> ConvexHull:
        """A polytope around all of them, `slack` thicker, with the 26 directions of a cube's faces,
        edges and corners."""
        return _wrapped(self.centers, 0.5 * self.size + slack)

    def split(self) -> Cells:
        """Eight of each."""
        half = 0.5 * self.size
        return Cells((self.corners[:, None] + _OCTANTS * half).reshape(-1, 3), half)

    def some(self, which: BoolArray) -> Cells:
        """Those chosen by a mask (n,)."""
        return Cells(self.corners[which], self.size)

    def proved_empty(self, clearance: Clearance, margin: float = 0.0) -> BoolArray:
        """(n,) whether a cell's ball is within the clearance of its center; that of the cell
        enlarged on all sides by `margin` times its size."""
        if not len(self.corners):
            return np.zeros(0, np.bool_)
        return clearance(self.centers) > self.half_diagonal * (1 + 2 * margin + 1e-9)


def wrapped_points(points: FloatArray, slack: float) -> ConvexHull:
    """A polytope around points (n, 3), `slack` thicker, with the directions of `Cells.wrapped`."""
    return _wrapped(points, np.full(3, slack))


def union(one: ConvexHull, other: ConvexHull) -> ConvexHull:
    """The smallest polytope with the directions of `Cells.wrapped` around two such."""
    return ConvexHull(
        one.normals,
        np.maximum(one.offsets, other.offsets),
        np.minimum(one.lower, other.lower),
        np.maximum(one.upper, other.upper),
    )


def _wrapped(centers: FloatArray, half: FloatArray) -> ConvexHull:
    """The polytope around boxes of half sizes (3,)."""
    normals = np.array([v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)], float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (centers @ normals.T).max(axis=0) + np.abs(normals) @ half
    return ConvexHull(normals, offsets, centers.min(axis=0) - half, centers.max(axis=0) + half)


@dataclass(frozen=True)
class Octree:
    """Cells of a box: those of the finest size that may hold the set, and those proved empty on the
    way there, coarsest first. Together they fill the box."""

    leaves: Cells
    empty: tuple[Cells, ...]


def octree(
    cells: Cells, clearance: Clearance, most: int, finest: int, margin: float = 0.0
) -> Octree:
    """Split `cells`, again and again, where they are not proved empty.

    most: cells that are looked at in one round; when it would be more, no further round is made.
    finest: rounds at most; each halves the edges.
    margin: as for `Cells.proved_empty`.
    """
    empty: list[Cells] = []
    for _ in range(finest):
        if 8 * len(cells.corners) > most:
            break
        split = cells.split()
        free = split.proved_empty(clearance, margin)
        cells = split.some(~free)
        empty.append(split.some(free))
    return Octree(cells, tuple(empty))


def carve(
    lower: FloatArray, upper: FloatArray, clearance: Clearance, most: int, finest: int
) -> Cells:
    """The leaves of the octree of one box; there are none where the box is proved empty."""
    root = Cells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return octree(root, clearance, most, finest).leaves
