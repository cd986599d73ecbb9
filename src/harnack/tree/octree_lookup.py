"""The leaf of an octree in which a point lies, on a backend.

The builder of an octree numbers its nodes level by level (`OctreeLookup.from_levels`); what a leaf
holds is up to the caller, who keeps a record for each.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import IntArray

if TYPE_CHECKING:
    from harnack.backend import Backend, BoolArray, FloatArray, Mask, Real, Vec3

__all__ = ["BALL_MARGIN", "MAX_DEPTH", "OCTANT_DIRECTIONS", "OctreeLookup", "encode_nodes"]

# Cells of the finest level are 2^-DEEPEST as wide as the cube; those of a grid that is looked up at
# once 2^-_TOP_DEPTH.
MAX_DEPTH, _TOP_DEPTH = 10, 5
# What holds in the ball of a cell should hold in one larger by this factor, for rounding: it moves
# a point by less than 2^-20 of the cube's side in single precision, and such balls of the finest
# cells reach 2^-19 of it beyond these.
BALL_MARGIN = 1.004
# From the center of a cube to those of its octants, in quarters of its side; z fastest.
OCTANT_DIRECTIONS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def encode_nodes(is_leaf: BoolArray, leaves: int, split: int) -> IntArray:
    """The nodes of a level, for `OctreeLookup.from_levels`. leaves: the number of leaves of the
    levels above.
    split: of the nodes of the levels above, but the first, that are split."""
    number = np.empty(len(is_leaf), np.int64)
    number[is_leaf] = -1 - (leaves + np.arange(int(is_leaf.sum())))
    number[~is_leaf] = 8 * (split + np.arange(int((~is_leaf).sum())))
    return number


@dataclass(frozen=True)
class OctreeLookup:
    """The octree of a cube on a backend.

    lower_corner: the lower corner of the cube. scale: 2^DEEPEST over its side.
    top_grid: for each cube of a grid of 2^_TOP_DEPTH along each side, z fastest, the node that it
        is, or that it is in: the number of the first of its eight children, z fastest; or for a
            leaf -1 minus
        its number.
    encoded_nodes: likewise for each node but the first.
    """

    backend: Backend
    lower_corner: Vec3
    cells_per_length: Real
    top_grid: Any
    encoded_nodes: Any

    @classmethod
    def from_levels(
        cls, backend: Backend, low: FloatArray, side: float, levels: list[IntArray]
    ) -> OctreeLookup:
        """levels: nodes of each level, those of a level octant by octant of the ones above that are
        split."""
        root, *below = levels
        nodes = np.concatenate([*below, np.zeros(8, np.int64)])  # room for any octant
        corner = backend.Array3f(*(dr.opaque(backend.Float, float(one)) for one in low))
        return cls(
            backend, corner, dr.opaque(backend.Float, 2**MAX_DEPTH / side),
            backend.Int32(_build_top_grid(int(root[0]), nodes).astype(np.int32)),
            backend.Int32(nodes.astype(np.int32)),
        )  # fmt: skip

    @staticmethod
    def memory_bytes(nodes: int) -> int:
        """Bytes of so many nodes and of the grid on top."""
        return 4 * (nodes + 8**_TOP_DEPTH)

    def find_leaf(self, x: Vec3) -> tuple[Any, Mask]:
        """The number of the leaf in which x lies, and whether x lies in the cube."""
        index, integer = self.backend.UInt32, self.backend.Int32
        place = (x - self.lower_corner) * self.cells_per_length
        inside = dr.all((place >= 0) & (place < float(2**MAX_DEPTH)))
        ix, iy, iz = (index(dr.select(inside, place[k], 0)) for k in range(3))
        down = MAX_DEPTH - _TOP_DEPTH
        first = (((ix >> down) << _TOP_DEPTH | (iy >> down)) << _TOP_DEPTH) | (iz >> down)

        def more(node: Any, *_: Any) -> Mask:
            return node >= 0

        def step(node: Any, bit: Any) -> tuple[Any, Any]:
            octant = ((ix >> bit) & 1) * 4 + ((iy >> bit) & 1) * 2 + ((iz >> bit) & 1)
            return dr.gather(integer, self.encoded_nodes, index(node) + octant), bit - 1

        node = dr.gather(integer, self.top_grid, first)
        node, _ = dr.while_loop((node, index(down - 1) + 0 * ix), more, step, label="cell")
        return index(-1 - node), inside


def _build_top_grid(root: int, nodes: IntArray) -> IntArray:
    """`OctreeLookup.top_grid`."""
    grid = np.full((1, 1, 1), root, np.int64)
    for _ in range(_TOP_DEPTH):
        x, y, z = np.indices([2 * side for side in grid.shape])
        node = grid[x >> 1, y >> 1, z >> 1]
        octant = (x & 1) * 4 + (y & 1) * 2 + (z & 1)
        grid = np.where(node >= 0, nodes[np.maximum(node, 0) + octant], node)
    return grid.ravel()
