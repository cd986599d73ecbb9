"""A grid of cells over a box, of which those that are proved empty let rays pass without a look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.arrays import aligned_integers
from harnack.backend.extrema import fmin
from harnack.backend.lengths import largest_component
from harnack.cells.octree import Cells, Clearance, octree

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

__all__ = ["FreeCells", "PreparedFreeCells", "free_cells"]

# Balls that are proved empty are larger than those around cells by this part, and so is every cell
# free that far around: of its edge by 0.017. Rays go so far, of the edge, over a face; and they are
# followed where rounding moves them by less than the last part of it.
_LARGER, _OVER, _ROUNDED = 1.02, 0.008, 0.002
# Cells of the first round along the longest side of the box, and of the last.
_FIRST, _ROUNDS = 8, 3


@dataclass(frozen=True)
class FreeCells:
    """Cubes of one size in rows over a box.

    lower: (3,) the corner with the least coordinates. edge: of a cube. is_free: (x, y, z) whether a
    cube, and all within 0.017 edges of it, is proved to hold no point of the set.
    """

    lower: FloatArray
    edge: float
    is_free: BoolArray

    def prepare(self, backend: Backend) -> PreparedFreeCells:
        """On a backend."""
        real, index = backend.Float, backend.UInt32
        return PreparedFreeCells(
            backend,
            backend.Array3f(*(dr.opaque(real, float(c)) for c in self.lower)),
            dr.opaque(real, self.edge),
            tuple(dr.opaque(index, n) for n in self.is_free.shape),
            aligned_integers(backend, self.is_free.ravel().astype(np.uint32)),
        )


def free_cells(lower: FloatArray, upper: FloatArray, clearance: Clearance, most: int) -> FreeCells:
    """Cubes over a box, 64 along its longest side, or fewer where more than `most` would have to be
    looked at in a round."""
    edge = float((upper - lower).max()) / _FIRST
    counts = np.maximum(1, np.ceil((upper - lower) / edge * (1 - 1e-9))).astype(np.int64)
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    root = Cells(lower + grid * edge, np.full(3, edge))
    found = octree(root, lambda x: clearance(x) / _LARGER, most, _ROUNDS)
    size = float(found.leaves.size[0])
    is_free = np.ones(counts * round(edge / size), np.bool_)
    place = np.rint((found.leaves.corners - lower) / size).astype(np.int64)
    is_free[tuple(place.T)] = False
    return FreeCells(lower, size, is_free)


@dataclass(frozen=True)
class PreparedFreeCells:
    """`FreeCells` on a backend."""

    backend: Backend
    lower: Vec3
    edge: Real
    counts: tuple[Any, ...]
    is_free: Any

    def free_along(self, o: Vec3, d: Vec3, t: Real) -> Real:
        """How far rays o + t d, |d| = 1, are proved free from t on; 0 outside of the grid.

        Proof. From a point of a free cell the ray is followed to where it leaves the cell, and a
        little further (`_OVER`). What it passes there, a corner of another cell perhaps, is within
        the margin around the cell, with what rounding does to the point.
        """
        real, vector, index = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        sharp = 1 / self.edge
        origin, along = (o - self.lower) * sharp, d * sharp
        steep = dr.select(dr.abs(along) < 1e-12, vector(1e-12), along)
        inverse = dr.rcp(steep)
        rising = vector(*(dr.select(c > 0, real(1), 0) for c in along))
        known = self.backend.epsilon * (1 + largest_component(origin)) < _ROUNDED / 4

        def body(at: Real, inside: Mask) -> tuple[Real, Mask]:
            p = dr.fma(vector(at), along, origin)
            cell = dr.floor(p)
            within = self.backend.Bool(inside)
            place = index(0)
            for c, count in zip(cell, self.counts, strict=True):
                within &= (c >= 0) & (c < real(count))
                place = place * count + index(dr.select(within, c, 0))
            within &= dr.gather(index, self.is_free, place, within) != 0
            out = (cell + rising - p) * inverse
            leaves = fmin(fmin(out.x, out.y), out.z)
            step = dr.select(leaves > 0, leaves, 0) + _OVER * self.edge
            return dr.select(within, at + step, at), within

        def goes_on(at: Real, inside: Mask) -> Mask:
            del at
            return inside

        start = real(t), self.backend.Bool(known)
        end, _ = dr.while_loop(start, goes_on, body, label="free cells")
        # The last step ended in a cell that is not free, but within the margin of one that is.
        return end - t
