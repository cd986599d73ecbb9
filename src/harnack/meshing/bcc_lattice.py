"""Tetrahedra that fill a box, or chosen cells of it, in a regular pattern: a body-centered lattice.
In these tetrahedra the level set {f = 0} of a function f is meshed. The box is divided into equal
boxes, the cells. The points of the lattice are the corners and the centers of all cells, and the
centers of those faces of cells that lie on the boundary of the box.

Each face between two cells belongs to four tetrahedra, one for each edge of the face: the corners
of such a tetrahedron are the two ends of the edge and the centers of the two cells. At the boundary
of the box, the center of the face takes the place of the missing center, and tetrahedra are half as
large. So the tetrahedra fill the box, and the tetrahedra at all faces of a cell together contain
the cell. If the cells are cubes, dihedral angles are 60 and 90 degrees (Labelle and Shewchuk 2007).

Tetrahedra are made at the faces of chosen cells only. Cells that are proved to hold no point of the
level set need not be chosen. Proof that the surface has no gap then. Take a tetrahedron at a face
between a chosen cell and a cell that is not chosen. The cell that is not chosen holds no point of
the level set. So f has the same sign at its center and at all of its corners, also at the corners
of the face between the two cells. Then the level set crosses only those faces of the tetrahedron
that contain the center of the chosen cell. The tetrahedron behind such a face belongs to a face of
the chosen cell as well, so the surface goes on there.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import sorted_unique
from harnack.meshing.meshing_errors import MeshingError, TriangleLimitError
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
    """A body-centered lattice that fills a box: its points are the corners and centers of equal
    cells (boxes), and the centers of cell faces on the boundary of the box. A cell is named by its
    three integer indices along the axes. A point is named by three integers too, its lattice
    coordinates: its position from the lower corner of the box in units of half a cell. They are
    even for corners of cells and odd for centers; the center of a face on the boundary has one even
    coordinate.

    lower: (3,) the lower corner of the box.
    size: (3,) the edges of each cell.
    counts: (3,) the number of cells along each axis.
    """

    lower: FloatArray
    size: FloatArray
    counts: IntArray

    @classmethod
    def covering_box(
        cls, lower: FloatArray, upper: FloatArray, spacing: float, layers: int = 0
    ) -> BccLattice:
        """Make a lattice whose cells fill a box. Cells have edges of at most `spacing`, as nearly
        equal as an integer number of cells along each side allows.

        lower, upper: the corners (3,) of the box.
        layers: how many layers of cells are added on all sides of the box.

        Raises:
            MeshingError: the box has no volume.
        """
        sides = upper - lower
        if not (sides > 0).all():
            raise MeshingError("the box to be filled has no volume: choose a larger `clip`")
        # Rounding must not add a cell where the side is a multiple of the spacing.
        counts = np.maximum(1, np.ceil(sides / spacing * (1 - 1e-9))).astype(np.int64)
        size = sides / counts
        return cls(lower - layers * size, size, counts + 2 * layers)

    @property
    def upper(self) -> FloatArray:
        """(3,) the far corner of the box."""
        return self.lower + self.counts * self.size

    def points(self, coordinates: IntArray) -> FloatArray:
        """The points (n, 3) in space with the lattice coordinates `coordinates` (n, 3). Points on
        the boundary of the box lie exactly on it."""
        x = self.lower + 0.5 * self.size * coordinates
        x = np.where(coordinates == 0, self.lower, x)
        return np.where(coordinates == 2 * self.counts, self.upper, x)

    def is_on_box(self, coordinates: IntArray) -> BoolArray:
        """Whether points lie on the boundary of the box, (n,); `coordinates` (n, 3) are their
        lattice coordinates."""
        return ((coordinates == 0) | (coordinates == 2 * self.counts)).any(axis=1)

    def nonempty_cells(self, clearance: Clearance, most_faces: int) -> IntArray:
        """Find the cells that are not proved to be free of the level set; returns their indices (n,
        3). The search begins with blocks of 2^k cells along each axis. Blocks that are proved empty
        are dropped; the others are halved, k times (octrees).

        clearance: returns for points (k, 3) proved lower bounds (k,) of their distances from the
            level set.
        most_faces: the largest number of triangles of the mesh. It also limits the number of cells;
            a cell makes about three triangles.

        Raises:
            TriangleLimitError: there are too many cells.
        """
        # A surface across the box passes through at least `min_cells` cells: as many as the
        # smallest cross-section of the lattice has, the product of the two smaller counts.
        max_cells = min(MOST_CELLS, most_faces)
        if (min_cells := float(np.prod(np.sort(self.counts)[:2].astype(float)))) > max_cells:
            raise triangle_limit_error(min_cells, max_cells)
        # Blocks have up to 8 cells along each axis, but each axis has at least two blocks. Blocks
        # are larger, up to 2^12 cells, if there are too many of them.
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
        # A round tests eight octants of each cell, so the search ends at more than `max_cells`.
        leaves = refine_cells(root, clearance, 8 * max_cells, halvings).occupied
        if not len(leaves.corners):
            return np.zeros((0, 3), np.int64)
        # If the search ended early, a surface goes on through about 4 times as many cells in each
        # halving.
        rounds = round(math.log2(edges[0] / leaves.size[0]))
        expected = len(leaves.corners) * 4 ** (halvings - rounds)
        if expected > max_cells or rounds < halvings:
            raise triangle_limit_error(expected, max_cells)
        index = np.rint((leaves.corners - self.lower) / self.size).astype(np.int64)
        # The last block along an axis may reach beyond the box.
        return index[(index < self.counts).all(axis=1)]

    def relevant_cells(
        self, clearance: Clearance, matter: IntArray, values: Clearance, most_faces: int
    ) -> tuple[IntArray, BoolArray]:
        """Choose the cells in which the surface is meshed. It is needed only in some cells of the
        lattice, the relevant ones. The function f counts as positive in irrelevant cells, also at
        the points that these share with relevant cells.

        Two kinds of relevant cells are chosen: cells that may hold the level set; and cells that
        have an irrelevant neighbor and a center at which f <= 0. Then every tetrahedron with
        corners of both signs belongs to a chosen cell. Proof: take a relevant cell that is not
        chosen. It holds no point of the level set, so its center has the sign of its relevant
        corners. If one of its corners belongs to an irrelevant cell, f is positive at its center
        (else it would be chosen), and so at all of its corners.

        clearance: returns for points (n, 3) proved lower bounds (n,) of their distances from the
            level set.
        matter: (k, 3) the indices of the relevant cells.
        values: returns the values (n,) of f at points (n, 3).
        most_faces: the largest number of triangles of the mesh; it also limits the number of cells.

        Returns the indices (n, 3) of the chosen cells; and a mask of all relevant cells, of the
        shape `counts`.

        Raises:
            TriangleLimitError: too many cells are chosen.
        """
        is_relevant = np.zeros(tuple(self.counts.tolist()), np.bool_)
        is_relevant[tuple(matter.T)] = True
        centers = self.points(2 * matter + 1)
        half_diagonal = 0.5 * float(np.linalg.norm(self.size))
        # A ball about the center that is free of the level set and contains the cell proves it
        # empty.
        chosen = clearance(centers) <= half_diagonal * (1 + 1e-9)
        at_rim = np.flatnonzero(~chosen & ~self.interior_cells(is_relevant)[tuple(matter.T)])
        chosen[at_rim[values(centers[at_rim]) <= 0]] = True
        if int(chosen.sum()) > min(MOST_CELLS, most_faces):
            raise triangle_limit_error(float(chosen.sum()), min(MOST_CELLS, most_faces))
        return matter[chosen], is_relevant

    def interior_cells(self, cells: BoolArray) -> BoolArray:
        """Return the mask of those cells in the mask `cells` whose neighbors in the lattice all
        belong to that mask as well. Cells that share a corner are neighbors, and neighbors outside
        of the box count as in the mask. Both masks have the shape `counts`."""
        padded = np.pad(cells, 1, constant_values=True)
        inner = cells.copy()
        # All shifts of the mask by -1, 0 and 1 cells along each axis.
        for shift in itertools.product((0, 1, 2), repeat=3):
            inner &= padded[tuple(slice(i, i + n) for i, n in zip(shift, cells.shape, strict=True))]
        return inner

    def cell_indices(self, points: FloatArray) -> IntArray:
        """The indices (n, 3) of the cells that contain points (n, 3); for a point outside of the
        box, the indices of the nearest cell."""
        index = np.floor((points - self.lower) / self.size).astype(np.int64)
        return np.clip(index, 0, self.counts - 1)

    def touches_cells(self, coordinates: IntArray, cells: BoolArray) -> BoolArray:
        """(n,) whether each point is a corner or the center of a cell in a mask.

        coordinates: (n, 3) the lattice coordinates of the points.
        cells: the mask, of the shape `counts`.
        """
        padded = np.pad(cells, 1)
        touches = np.zeros(len(coordinates), np.bool_)
        for offset in itertools.product((-1, 0), repeat=3):
            # For an odd coordinate both offsets lead to the same cell. (1 is the padding.)
            index = (coordinates + offset) // 2 + 1
            touches |= padded[tuple(index.T)]
        return touches

    def outer_cells(self) -> IntArray:
        """The indices (n, 3) of the cells that have a face on the boundary of the box."""
        layers: list[IntArray] = []
        for axis in range(3):
            ends = self.counts.copy()
            ends[axis] = 1
            layer: IntArray = np.indices(tuple(ends.tolist())).reshape(3, -1).T.copy()
            # The layer of cells with index 0 along the axis, then the last layer.
            layers.append(layer.copy())
            layer[:, axis] = self.counts[axis] - 1
            layers.append(layer)
        return distinct_rows(np.concatenate(layers))

    def tetrahedra(self, cells: IntArray) -> tuple[IntArray, IntArray]:
        """The tetrahedra at all faces of chosen cells. Each belongs to an edge of a face. Its
        corners are the ends of the edge, and one point on each side of the face: the center of the
        cell there or, outside of the box, the center of the face instead.

        cells: (k, 3) the indices of the chosen cells.

        Returns the lattice coordinates (n, 3) of the corners of all tetrahedra, each point once;
        and for each tetrahedron the indices (m, 4) of its corners among these points.
        """
        shape = 2 * self.counts + 1
        keys_by_axis: list[list[IntArray]] = []  # of each face: centers, then corners in turn
        for axis in range(3):
            # A face is named by the lattice coordinates of its lower corner.
            upper_face = 2 * cells
            upper_face[:, axis] += 2
            face_corner = np.concatenate([2 * cells, upper_face])
            face_corner = _lattice_coordinates(
                sorted_unique(_flat_indices(face_corner, shape)), shape
            )
            plane_axes = [k for k in range(3) if k != axis]
            face_keys: list[IntArray] = []
            for side in (-1, 1):
                # The centers of the two cells at the face; `clip` leaves the face's own center on
                # the boundary.
                center = face_corner + 1
                center[:, axis] = np.clip(face_corner[:, axis] + side, 0, shape[axis] - 1)
                face_keys.append(_flat_indices(center, shape))
            # The four corners of the face, in turn around it. (A cell is two lattice units long.)
            for i, j in ((0, 0), (2, 0), (2, 2), (0, 2)):
                corner = face_corner.copy()
                corner[:, plane_axes] += [i, j]
                face_keys.append(_flat_indices(corner, shape))
            keys_by_axis.append(face_keys)
        # Six arrays: for all faces the centers on both sides, and the four corners in turn.
        keys = [np.concatenate(column) for column in zip(*keys_by_axis, strict=True)]
        used = sorted_unique(np.concatenate(keys))
        # From lattice points to their positions in `used`: by a table if it is small, else by
        # searches.
        if math.prod(shape.tolist()) < _MAX_TABLE_SIZE:
            index = np.zeros(math.prod(shape.tolist()), np.int64)
            index[used] = np.arange(len(used))
            center_below, center_above, *ring = (index[column] for column in keys)
        else:
            center_below, center_above, *ring = (np.searchsorted(used, column) for column in keys)
        # A tetrahedron for each edge of the face: from corner k - 1 to corner k of the ring.
        corners_of_tetrahedra = [
            np.stack([center_below, center_above, ring[k - 1], ring[k]], axis=1) for k in range(4)
        ]
        return _lattice_coordinates(used, shape), np.concatenate(corners_of_tetrahedra)


def distinct_rows(rows: IntArray) -> IntArray:
    """The distinct rows of an array (n, 3) of nonnegative integers, in lexicographic order."""
    shape = rows.max(axis=0, initial=0) + 1
    return _lattice_coordinates(sorted_unique(_flat_indices(rows, shape)), shape)


def triangle_limit_error(cells: float, max_cells: int) -> TriangleLimitError:
    """Make the error to raise if a mesh would need too many cells; its message names the limit and
    remedies.

    cells: about how many cells hold the surface.
    max_cells: the largest number of cells.
    """
    return TriangleLimitError(
        f"about {cells:.1e} cells hold the surface, which makes some {3 * cells:.0e} triangles; "
        f"at most {max_cells:,} cells are made (max_triangles, and never more than {MOST_CELLS:,}"
        "): choose a larger `cell_size` or `tolerance`, or a smaller `clip`"
    )


def _flat_indices(coordinates: IntArray, shape: IntArray) -> IntArray:
    """(n,) a unique integer for each point with integer coordinates (n, 3): its index in a
    flattened array of the shape `shape` (3,). Coordinates are smaller than the shape."""
    return (coordinates[:, 0] * shape[1] + coordinates[:, 1]) * shape[2] + coordinates[:, 2]


def _lattice_coordinates(keys: IntArray, shape: IntArray) -> IntArray:
    """The inverse of `_flat_indices`: the integer coordinates (n, 3) of the points with the indices
    `keys` (n,) in a flattened array of the shape `shape` (3,)."""
    xy, z = np.divmod(keys, shape[2])
    return np.stack([*np.divmod(xy, shape[1]), z], axis=1)
