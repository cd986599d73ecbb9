"""A body-centered lattice: tetrahedra that fill cells of a box without a Delaunay triangulation.

Its points are the corners and the centers of equal cells, and where a cell lies on the box, the
centers of its faces there. Two centers on both sides of a face make four tetrahedra with the four
edges of the face; at the box, where the outer center is that of the face itself, half as large
ones. So the tetrahedra fill the box, and those at the faces of some cells contain these cells. In
cubes their dihedral angles are 60 and 90 degrees (Labelle and Shewchuk 2007).

Cells that are proved empty need none. Proof. Let the level set meet chosen cells only, and let a
tetrahedron at a face of a chosen cell have its other apex in a cell that is not chosen: that cell
holds no level, so its center and the corners of the face, which it has too, are on one side. Of the
faces of the tetrahedron only those with the chosen cell's center and a corner of another side are
crossed, and the tetrahedron behind such a face belongs to a face of the chosen cell as well.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import MeshingError, TriangleLimitError
from harnack.meshing.edges import IntArray, sorted_unique
from harnack.tree.empty_space import BoxCells, Clearance, refine_cells

__all__ = ["BccLattice", "distinct_rows"]

# The largest number of cells, which make about five million triangles; more are refused.
MOST_CELLS = 2_000_000
# In lattices of fewer points than this, the index of a point is looked up in a table.
_MAX_TABLE_SIZE = 20_000_000
# The largest number of cells from which octrees start.
_MAX_ROOT_CELLS = 200_000


@dataclass(frozen=True)
class BccLattice:
    """A body-centered lattice that fills a box.

    lower: (3,) the corner of the box.
    size: (3,) the edges of each cell.
    counts: (3,) the number of cells along each side of the box.

    Points are given by integer coordinates (n, 3) in units of half a cell: even if they are corners
    of cells, odd if they are centers; centers of faces on the box have one even coordinate.
    """

    lower: FloatArray
    size: FloatArray
    counts: IntArray

    @classmethod
    def covering_box(
        cls, lower: FloatArray, upper: FloatArray, spacing: float, layers: int = 0
    ) -> BccLattice:
        """A lattice whose cells fill a box and are as nearly cubes of edge `spacing` as possible,
        with `layers` more cells around it.

        Raises:
            MeshingError: a box without volume.
        """
        sides = upper - lower
        if not (sides > 0).all():
            raise MeshingError("the box to be filled has no volume: choose a larger `clip`")
        counts = np.maximum(1, np.ceil(sides / spacing * (1 - 1e-9))).astype(np.int64)
        size = sides / counts
        return cls(lower - layers * size, size, counts + 2 * layers)

    @property
    def upper(self) -> FloatArray:
        """(3,) the far corner of the box."""
        return self.lower + self.counts * self.size

    def points(self, coordinates: IntArray) -> FloatArray:
        """Points (n, 3) in space, from their lattice coordinates; those on the box lie exactly on
        it."""
        x = self.lower + 0.5 * self.size * coordinates
        x = np.where(coordinates == 0, self.lower, x)
        return np.where(coordinates == 2 * self.counts, self.upper, x)

    def is_on_box(self, coordinates: IntArray) -> BoolArray:
        """(n,) whether points lie on the box."""
        return ((coordinates == 0) | (coordinates == 2 * self.counts)).any(axis=1)

    def nonempty_cells(self, clearance: Clearance, most_faces: int) -> IntArray:
        """(n, 3) indices of the cells that are not proved empty, by octrees over blocks of them.

        most_faces: the largest number of triangles; a cell makes about three.

        Raises:
            MeshingError: there are too many cells.
        """
        # A surface across the box passes through at least this many cells.
        max_cells = min(MOST_CELLS, most_faces)
        if (min_cells := float(np.prod(np.sort(self.counts)[:2].astype(float)))) > max_cells:
            raise triangle_limit_error(min_cells, max_cells)
        halvings = 0
        while halvings < 3 and (self.counts >= 2 ** (halvings + 2)).all():
            halvings += 1
        blocks = -(-self.counts // 2**halvings)
        while math.prod(blocks.tolist()) > _MAX_ROOT_CELLS and halvings < 12:
            halvings += 1
            blocks = -(-self.counts // 2**halvings)
        grid = np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), axis=-1)
        edges = self.size * 2**halvings
        root = BoxCells(self.lower + grid.reshape(-1, 3) * edges, edges)
        root = root.subset(~root.is_proved_empty(clearance))
        leaves = refine_cells(root, clearance, 8 * max_cells, halvings).occupied
        if not len(leaves.corners):
            return np.zeros((0, 3), np.int64)
        rounds = round(math.log2(edges[0] / leaves.size[0]))
        expected = len(leaves.corners) * 4 ** (halvings - rounds)
        if expected > max_cells or rounds < halvings:
            raise triangle_limit_error(expected, max_cells)
        index = np.rint((leaves.corners - self.lower) / self.size).astype(np.int64)
        return index[(index < self.counts).all(axis=1)]

    def relevant_cells(
        self, clearance: Clearance, matter: IntArray, values: Clearance, most_faces: int
    ) -> tuple[IntArray, BoolArray]:
        """Indices (n, 3) of the relevant cells to mesh, and a mask (counts) of all relevant cells.

        Chosen are cells that may hold the level set, and cells with a nonpositive center next to an
        irrelevant cell. Irrelevant cells count as positive, with all of their points. Then every
        tetrahedron with corners of both signs belongs to a chosen cell: the center of a cell not
        chosen has the sign of its relevant corners, and if one corner is irrelevant all are
        positive.

        matter: (k, 3) indices of the relevant cells (`nonempty_cells`).
        values: of the function.

        Raises:
            MeshingError: too many cells are chosen.
        """
        does = np.zeros(tuple(self.counts.tolist()), np.bool_)
        does[tuple(matter.T)] = True
        centers = self.points(2 * matter + 1)
        half_diagonal = 0.5 * float(np.linalg.norm(self.size))
        chosen = clearance(centers) <= half_diagonal * (1 + 1e-9)
        rim = np.flatnonzero(~chosen & ~self.interior_cells(does)[tuple(matter.T)])
        chosen[rim[values(centers[rim]) <= 0]] = True
        if int(chosen.sum()) > min(MOST_CELLS, most_faces):
            raise triangle_limit_error(float(chosen.sum()), min(MOST_CELLS, most_faces))
        return matter[chosen], does

    def interior_cells(self, cells: BoolArray) -> BoolArray:
        """A mask, of the shape `counts`, of the cells in `cells` all of whose neighbors in the
        lattice are in `cells` as well."""
        padded = np.pad(cells, 1, constant_values=True)
        inner = cells.copy()
        for shift in itertools.product((0, 1, 2), repeat=3):
            inner &= padded[tuple(slice(i, i + n) for i, n in zip(shift, cells.shape, strict=True))]
        return inner

    def cell_indices(self, points: FloatArray) -> IntArray:
        """(n, 3) indices of the cells that points lie in, or that are nearest to them."""
        index = np.floor((points - self.lower) / self.size).astype(np.int64)
        return np.clip(index, 0, self.counts - 1)

    def touches_cells(self, coordinates: IntArray, cells: BoolArray) -> BoolArray:
        """(n,) whether points, given by lattice coordinates, are corners or centers of cells in the
        mask `cells`, of the shape `counts`."""
        padded = np.pad(cells, 1)
        touches = np.zeros(len(coordinates), np.bool_)
        for offset in itertools.product((-1, 0), repeat=3):
            # For an odd coordinate both offsets lead to the same cell.
            index = (coordinates + offset) // 2 + 1
            touches |= padded[tuple(index.T)]
        return touches

    def outer_cells(self) -> IntArray:
        """(n, 3) indices of the cells at the faces of the box."""
        layers: list[IntArray] = []
        for axis in range(3):
            ends = self.counts.copy()
            ends[axis] = 1
            layer: IntArray = np.indices(tuple(ends.tolist())).reshape(3, -1).T.copy()
            layers.append(layer.copy())
            layer[:, axis] = self.counts[axis] - 1
            layers.append(layer)
        return distinct_rows(np.concatenate(layers))

    def tetrahedra(self, cells: IntArray) -> tuple[IntArray, IntArray]:
        """The tetrahedra at all faces of cells (k, 3): the lattice coordinates (n, 3) of their
        points, and (m, 4) the indices of the four corners of each."""
        shape = 2 * self.counts + 1
        keys_by_axis: list[list[IntArray]] = []  # of each face: centers, then corners in turn
        for axis in range(3):
            lower = 2 * cells
            lower[:, axis] += 2
            face = np.concatenate([2 * cells, lower])
            face = _lattice_coordinates(sorted_unique(_flat_indices(face, shape)), shape)
            plane_axes = [k for k in range(3) if k != axis]
            face_keys: list[IntArray] = []
            for side in (-1, 1):
                center = face + 1
                center[:, axis] = np.clip(face[:, axis] + side, 0, shape[axis] - 1)
                face_keys.append(_flat_indices(center, shape))
            for i, j in ((0, 0), (2, 0), (2, 2), (0, 2)):
                corner = face.copy()
                corner[:, plane_axes] += [i, j]
                face_keys.append(_flat_indices(corner, shape))
            keys_by_axis.append(face_keys)
        keys = [np.concatenate(column) for column in zip(*keys_by_axis, strict=True)]
        used = sorted_unique(np.concatenate(keys))
        if math.prod(shape.tolist()) < _MAX_TABLE_SIZE:
            index = np.zeros(math.prod(shape.tolist()), np.int64)
            index[used] = np.arange(len(used))
            first, second, *ring = (index[column] for column in keys)
        else:
            first, second, *ring = (np.searchsorted(used, column) for column in keys)
        corners = [np.stack([first, second, ring[k - 1], ring[k]], axis=1) for k in range(4)]
        return _lattice_coordinates(used, shape), np.concatenate(corners)


def distinct_rows(rows: IntArray) -> IntArray:
    """The unique rows of nonnegative integers (n, 3), sorted."""
    shape = rows.max(axis=0, initial=0) + 1
    return _lattice_coordinates(sorted_unique(_flat_indices(rows, shape)), shape)


def triangle_limit_error(cells: float, most: int) -> TriangleLimitError:
    """The error for too many cells."""
    return TriangleLimitError(
        f"about {cells:.1e} cells hold the surface, which makes some {3 * cells:.0e} triangles; "
        f"at most {most:,} cells are made (max_triangles, and never more than {MOST_CELLS:,}): "
        "choose a larger `cell_size` or `tolerance`, or a smaller `clip`"
    )


def _flat_indices(coordinates: IntArray, shape: IntArray) -> IntArray:
    """(n,) a unique integer for each point with integer coordinates (n, 3): its index in a
    flattened array of the shape `shape` (3,)."""
    return (coordinates[:, 0] * shape[1] + coordinates[:, 1]) * shape[2] + coordinates[:, 2]


def _lattice_coordinates(keys: IntArray, shape: IntArray) -> IntArray:
    """The coordinates (n, 3) that `_flat_indices` turned into the integers `keys` (n,)."""
    xy, z = np.divmod(keys, shape[2])
    return np.stack([*np.divmod(xy, shape[1]), z], axis=1)
