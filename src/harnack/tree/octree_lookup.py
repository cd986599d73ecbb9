"""Lookup of the leaf of an octree that contains a point, on a backend. An octree divides a cube
into eight equal octants, and these again; a *leaf* is a cube that is not divided. A node is
*encoded* as one integer: an inner node as the index of the first of its eight children, leaf k as
-1 - k.

The builder of an octree lists its nodes depth by depth (`OctreeLookup.from_levels`). A lookup
returns the index of a leaf; the caller keeps what belongs to the leaf, such as a local expansion.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray

if TYPE_CHECKING:
    from harnack.backend import Backend, IntArray, Mask, Real, Vec3

__all__ = ["BALL_MARGIN", "OCTANT_OFFSET", "OctreeCells", "OctreeLookup"]

# The smallest cells have 2^-_MAX_DEPTH of the width of the cube. A lookup begins in a uniform grid
# whose cells have 2^-_TOP_DEPTH of it.
_MAX_DEPTH, _TOP_DEPTH = 10, 5
# What is used for all points of a cell has to be proved in a ball: the ball around the cell,
# enlarged by this factor, because rounding may move a point out of the cell. Rounding in single
# precision moves it by less than 2^-20 of the cube's width; the enlarged balls of the smallest
# cells are larger by 2^-19 of that width.
BALL_MARGIN = 1.004
# Vectors from the center of a cube to the centers of its octants, in quarters of the cube's width;
# the z component changes fastest.
_OCTANT_DIRECTIONS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
# The offset of an octant's center from the center of its cell along each axis, in units of the
# radius of the cell's ball.
OCTANT_OFFSET = 0.5 / (math.sqrt(3) * BALL_MARGIN)


@dataclass(frozen=True)
class OctreeCells:
    """The cells of one depth of an octree: cubes of equal size.

    centers: (n, 3) the centers of the cells.
    half_side: half the side of a cell.
    depth: 0 for the whole cube.
    """

    centers: FloatArray
    half_side: float
    depth: int = 0

    @property
    def radius(self) -> float:
        """The radius of the balls around the cells (`BALL_MARGIN`)."""
        return math.sqrt(3) * self.half_side * BALL_MARGIN

    @property
    def is_last(self) -> bool:
        """Whether no cell of this depth may be divided."""
        return self.depth == _MAX_DEPTH

    def octants(self, is_divided: BoolArray) -> OctreeCells:
        """The octants of the cells on which the mask (n,) is true. Those of a cell follow each
        other."""
        half = 0.5 * self.half_side
        centers = self.centers[is_divided][:, None] + half * _OCTANT_DIRECTIONS
        return OctreeCells(centers.reshape(-1, 3), half, self.depth + 1)


@dataclass(frozen=True)
class OctreeLookup:
    """The octree of a cube on a backend, in which `find_leaf` looks up the leaf that contains a
    point. A node is encoded as one integer: an inner node as the index of the first of its eight
    consecutive children (z fastest), leaf k as -1 - k.

    lower_corner: (3,) the lower corner of the cube.
    cells_per_length: 2^_MAX_DEPTH divided by the width of the cube.
    top_grid: (8^_TOP_DEPTH,) an encoded node for each cell of a uniform grid, z fastest. It is the
        node of depth _TOP_DEPTH that fills the cell, or a leaf of smaller depth that contains the
        cell.
    encoded_nodes: all nodes except the root, encoded.
    """

    backend: Backend
    lower_corner: Vec3
    cells_per_length: Real
    top_grid: Any
    encoded_nodes: Any

    @classmethod
    def from_levels(
        cls, backend: Backend, low: FloatArray, side: float, levels: list[BoolArray]
    ) -> OctreeLookup:
        """Upload an octree.

        low, side: the lower corner (3,) and the width of its cube.
        levels: for each depth, the root first, the mask (n,) of the nodes that are leaves. The
            eight children of each inner node follow each other, in the order of the inner nodes of
            the depth above.

        Leaves and inner nodes are each numbered in the order of `levels`.
        """
        is_leaf = np.concatenate(levels)
        # The children of inner node j begin at 8 j, as the root is not in the list of nodes.
        leaves, inner = (np.cumsum(mask, dtype=np.int64) for mask in (is_leaf, ~is_leaf))
        encoded = np.where(is_leaf, -leaves, 8 * (inner - 1))
        # Eight unused entries: if the root is a leaf, lookups of children still read something.
        nodes = np.append(encoded[1:], np.zeros(8, np.int64))
        corner = backend.Array3f(*(dr.opaque(backend.Float, float(number)) for number in low))
        return cls(
            backend, corner, dr.opaque(backend.Float, 2**_MAX_DEPTH / side),
            backend.Int32(_build_top_grid(int(encoded[0]), nodes).astype(np.int32)),
            backend.Int32(nodes.astype(np.int32)),
        )  # fmt: skip

    @staticmethod
    def memory_bytes(nodes: int) -> int:
        """The memory in bytes of a lookup with `nodes` nodes, its grid included."""
        return 4 * (nodes + 8**_TOP_DEPTH)

    def find_leaf(self, x: Vec3) -> tuple[Any, Mask]:
        """Return the index of the leaf that contains x, and a mask that tells whether x lies in the
        octree's cube. For points outside of the cube, the index is that of the leaf at the lower
        corner.

        The lookup begins in a uniform grid, and then goes from node to child until it is at a leaf.
        """
        index, integer = self.backend.UInt32, self.backend.Int32
        position = (x - self.lower_corner) * self.cells_per_length
        is_inside = dr.all((position >= 0) & (position < float(2**_MAX_DEPTH)))
        ix, iy, iz = (index(dr.select(is_inside, position[k], 0)) for k in range(3))
        # self.top_grid has the encoded node for each cell of the uniform grid.
        # Integer coordinates in cells of the greatest depth. Their upper bits give the cell of the
        # uniform grid, the other `down` bits one octant for each further depth.
        down = _MAX_DEPTH - _TOP_DEPTH
        grid_index = (((ix >> down) << _TOP_DEPTH | (iy >> down)) << _TOP_DEPTH) | (iz >> down)

        def is_inner(node: Any, *_: Any) -> Mask:
            """Whether a lane has not yet reached a leaf: the encoded `node` is an inner node."""
            return node >= 0

        def step(node: Any, bit: Any) -> tuple[Any, Any]:
            """Go from a node to its child that contains x. Bit number `bit` of the integer
            coordinates of x chooses the child. Returns the child, encoded, and the number of the
            next lower bit."""
            octant = ((ix >> bit) & 1) * 4 + ((iy >> bit) & 1) * 2 + ((iz >> bit) & 1)
            return dr.gather(integer, self.encoded_nodes, index(node) + octant), bit - 1

        node = dr.gather(integer, self.top_grid, grid_index)
        # down - 1: the first bit below the uniform grid; 0 * ix makes it an array with an entry for
        # each lane.
        node, _ = dr.while_loop((node, index(down - 1) + 0 * ix), is_inner, step, label="cell")
        return index(-1 - node), is_inside


def _build_top_grid(encoded_root: int, nodes: IntArray) -> IntArray:
    """The array `OctreeLookup.top_grid` (8^_TOP_DEPTH,): for each cell of a uniform grid, z
    fastest, the encoded node that the cell is, or the encoded leaf that contains the cell.

    encoded_root: the root, encoded as `OctreeLookup` says.
    nodes: all other nodes, encoded.
    """
    grid = np.full((1, 1, 1), encoded_root, np.int64)
    for _ in range(_TOP_DEPTH):
        # Halve the cells. A half of a cell takes the child of the cell's node that fills it, or the
        # node itself if that is a leaf.
        x, y, z = np.indices([2 * side for side in grid.shape])
        node = grid[x >> 1, y >> 1, z >> 1]
        octant = (x & 1) * 4 + (y & 1) * 2 + (z & 1)
        grid = np.where(node >= 0, nodes[np.maximum(node, 0) + octant], node)
    return grid.ravel()
