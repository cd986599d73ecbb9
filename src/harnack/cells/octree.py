"""An octree over a box, of which cells that are proved empty are left out."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import ConvexHull

__all__ = ["Cells", "Clearance", "carve"]

Clearance: TypeAlias = Callable[[FloatArray], FloatArray]
"""For points (n, 3) lengths (n,): no point of the set is nearer than that."""

_OCTANTS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class Cells:
    """Boxes of one size, (3,) edges, at corners (n, 3), the least of their coordinates."""

    corners: FloatArray
    size: FloatArray

    @property
    def centres(self) -> FloatArray:
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
        normals = np.array([v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)], float)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        half = 0.5 * self.size + slack
        offsets = (self.centres @ normals.T).max(axis=0) + np.abs(normals) @ half
        lower, upper = self.bounds()
        return ConvexHull(normals, offsets, lower - slack, upper + slack)

    def split(self) -> Cells:
        """Eight of each."""
        half = 0.5 * self.size
        return Cells((self.corners[:, None] + _OCTANTS * half).reshape(-1, 3), half)

    def without_empty(self, clearance: Clearance) -> Cells:
        """Those that are not proved empty: whose ball is not within the clearance of its centre."""
        if not len(self.corners):
            return self
        free = clearance(self.centres) > self.half_diagonal * (1 + 1e-9)
        return Cells(self.corners[~free], self.size)


def carve(
    lower: FloatArray, upper: FloatArray, clearance: Clearance, most: int, finest: int
) -> Cells:
    """The cells of a box that may hold a set; there are none where the box is proved empty.

    most: cells that are looked at in one round; when it would be more, no further round is made.
    finest: rounds at most; each halves the edges.
    """
    cells = Cells(np.array(lower)[None], np.array(upper) - np.array(lower))
    for _ in range(finest):
        if 8 * len(cells.corners) > most:
            break
        cells = cells.split().without_empty(clearance)
    return cells
