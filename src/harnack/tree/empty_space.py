"""Cells of a box that are proved to contain no point of a set, such as a level set, and the
remaining cells: octrees, uniform grids, and connected components of cells. A cell is *empty* if it
is proved to contain no point of the set, and otherwise *occupied*: it may contain points. The
*clearance* is a function from points to proved lower bounds of their distances from the set. The
*margin* of a cell is a layer around it, by which it is enlarged on all sides before it is tested.

- `RefinedCells`, from `refine_cells` and `nonempty_cells`: a box split where it is not proved
  empty.
- `EmptySpaceGrid`: equal cubes on a backend, and the length for which a ray stays in empty cubes.
- `OccupancyGrid`: such a grid of the cells that may contain a set of points, computed by an octree.
- `largest_connected_component`: the largest group of connected cells that are not proved empty.

A component is a group of occupied cells that are connected by faces, edges and corners. If a single
component is to be drawn, the cells of all other components count as empty: rays jump across them,
so that nothing in them is hit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import clamp, fmin, max_norm
from harnack.geometry import ConvexHull

if TYPE_CHECKING:
    from harnack.backend import Backend, IntArray, Mask, Real, Vec3

__all__ = [
    "BoxCells",
    "Clearance",
    "EmptinessTest",
    "EmptySpaceGrid",
    "GridCell",
    "GridData",
    "OccupancyGrid",
    "RefinedCells",
    "distance_to_occupied",
    "kdop_of_points",
    "largest_connected_component",
    "merge_kdops",
    "nonempty_cells",
    "refine_by_test",
    "refine_cells",
    "round_to_short_float",
]

Clearance: TypeAlias = Callable[[FloatArray], FloatArray]
"""A function from points (n, 3) to lengths (n,), which are proved lower bounds of the distances of
the points from a set, such as a level set."""

EmptinessTest: TypeAlias = "Callable[[BoxCells, float], BoolArray]"
"""A function from boxes and a margin to a mask (n,): whether each box, enlarged on all sides by the
margin times its size, is proved to hold no point of a set, such as a level set."""

_OCTANTS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class BoxCells:
    """Boxes of equal size, the cells of a grid or of one depth of an octree.

    corners: (n, 3) the lower corner of each box.
    size: (3,) the edge lengths of every box.
    """

    corners: FloatArray
    size: FloatArray

    @property
    def centers(self) -> FloatArray:
        """The centers (n, 3) of the boxes."""
        return self.corners + 0.5 * self.size

    @property
    def half_diagonal(self) -> float:
        """Half the diagonal of a box: the radius of the ball around it."""
        return 0.5 * float(np.linalg.norm(self.size))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner (3,) of the box around all boxes."""
        return self.corners.min(axis=0), self.corners.max(axis=0) + self.size

    def bounding_kdop(self, slack: float) -> ConvexHull:
        """A convex polytope that contains all boxes, enlarged by `slack` (a length). Its 26 face
        normals are the directions from a cube's center to the cube's faces, edges and corners (a
        k-DOP)."""
        return _kdop_of_boxes(self.centers, 0.5 * self.size + slack)

    def octants(self) -> BoxCells:
        """The 8 n boxes of half the size into which the n boxes are divided, the eight octants of
        each box in a row."""
        half = 0.5 * self.size
        return BoxCells((self.corners[:, None] + _OCTANTS * half).reshape(-1, 3), half)

    def subset(self, which: BoolArray) -> BoxCells:
        """The boxes for which the mask `which` (n,) is True."""
        return BoxCells(self.corners[which], self.size)

    def is_proved_empty(self, clearance: Clearance, margin: float = 0.0) -> BoolArray:
        """Whether each box, enlarged on all sides by `margin` times its size, is proved to hold no
        point of a set: a mask (n,).

        clearance: gives proved lower bounds of the distances of points from the set. A box is
            proved empty if the ball around the enlarged box is smaller than the clearance of its
            center.
        """
        if not len(self.corners):
            return np.zeros(0, np.bool_)
        # The margin counts twice, for both sides of a box; 1e-9 is for rounding.
        return clearance(self.centers) > self.half_diagonal * (1 + 2 * margin + 1e-9)


def kdop_of_points(points: FloatArray, slack: float) -> ConvexHull:
    """The smallest convex polytope with the 26 face normals of `BoxCells.bounding_kdop` that
    contains points (n, 3), enlarged along the axes by `slack` (a length)."""
    return _kdop_of_boxes(points, np.full(3, slack))


def merge_kdops(hull: ConvexHull, other: ConvexHull) -> ConvexHull:
    """The smallest convex polytope with the 26 face normals of `BoxCells.bounding_kdop` that
    contains two polytopes with these normals, `hull` and `other`."""
    return ConvexHull(
        hull.normals,
        np.maximum(hull.offsets, other.offsets),
        np.minimum(hull.lower, other.lower),
        np.maximum(hull.upper, other.upper),
    )


def _kdop_of_boxes(centers: FloatArray, half: FloatArray) -> ConvexHull:
    """The smallest convex polytope with the 26 face normals of `BoxCells.bounding_kdop` that
    contains boxes with centers (n, 3) and half edge lengths `half` (3,)."""
    normals = np.array([v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)], float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # A box reaches |n| . half beyond its center in the direction n.
    offsets = (centers @ normals.T).max(axis=0) + np.abs(normals) @ half
    return ConvexHull(normals, offsets, centers.min(axis=0) - half, centers.max(axis=0) + half)


@dataclass(frozen=True)
class RefinedCells:
    """The leaves of octrees that fill a box: cells of the finest size, and larger cells that are
    proved to contain no point of a set.

    occupied: the cells of the finest size that are not proved empty: they may contain points of the
        set.
    empty: the cells that are proved empty: one `BoxCells` for each size, the largest first.
    """

    occupied: BoxCells
    empty: tuple[BoxCells, ...]


def refine_cells(
    cells: BoxCells,
    clearance: Clearance,
    max_cells_per_round: int,
    max_rounds: int,
    margin: float = 0.0,
) -> RefinedCells:
    """Split cells into octants, for several rounds. In each further round, those octants are split
    that are not proved empty. Returns the cells of the last round that are not proved empty, and
    all cells proved empty.

    clearance: gives proved lower bounds of the distances of points from a set. An empty cell holds
        no point of the set.
    max_cells_per_round: refinement stops before a round that would test more cells than this.
    max_rounds: the largest number of rounds; each halves the edges.
    margin: a cell counts as empty only if it is proved empty after it was enlarged on all sides by
        this fraction of its size.
    """

    def is_empty(cells: BoxCells, margin: float) -> BoolArray:
        return cells.is_proved_empty(clearance, margin)

    return refine_by_test(cells, is_empty, max_cells_per_round, max_rounds, margin)


def refine_by_test(
    cells: BoxCells,
    is_empty: EmptinessTest,
    max_cells_per_round: int,
    max_rounds: int,
    margin: float = 0.0,
) -> RefinedCells:
    """Split cells as `refine_cells` does, by a test of boxes in place of a clearance."""
    empty: list[BoxCells] = []
    for _ in range(max_rounds):
        if 8 * len(cells.corners) > max_cells_per_round:
            break
        split = cells.octants()
        which = is_empty(split, margin)
        cells = split.subset(~which)
        empty.append(split.subset(which))
    return RefinedCells(cells, tuple(empty))


def nonempty_cells(
    lower: FloatArray, upper: FloatArray, clearance: Clearance, max_cells: int, finest: int
) -> BoxCells:
    """The cells of a box that may contain points of a set: the octree leaves of the finest size
    that are not proved empty. There are none if all of the box is proved empty.

    lower, upper: the corners (3,) of the box.
    clearance: gives proved lower bounds of the distances of points from the set.
    max_cells: refinement stops before a round that would test more cells than this.
    finest: the largest number of rounds; each halves the edges.
    """
    root = BoxCells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return refine_cells(root, clearance, max_cells, finest).occupied


# The part of `EmptySpaceGrid.margin` that is reserved for the rounding of positions, in cells.
_ROUNDING_SHARE = 1 / 64


Layout = TypeVar("Layout", bound="GridData")


@dataclass(frozen=True)
class GridData:
    """A uniform grid of cubes in NumPy. Some of the cubes, the empty ones, are proved to contain no
    point of a set.

    origin: (3,) the lower corner of the grid, in numbers of single precision.
    cell_size: the width of a cell (`round_to_short_float`).
    shape: the number of cells along x, y and z.
    empty_distance: (cells,), x fastest: for each cell the chessboard distance, in cells, to the
        nearest cell that is not proved empty; 0 for such a cell itself.
    """

    origin: FloatArray
    cell_size: float
    shape: tuple[int, int, int]
    empty_distance: IntArray


@dataclass(frozen=True)
class EmptySpaceGrid:
    """A uniform grid of cubes on a backend, for rays that jump across empty cells. Some of the
    cubes, the empty ones, are proved to contain no point of a set. All numbers are parameters of
    kernels, so that kernels are compiled once for all grids.

    A point outside of the grid is treated like its nearest cell.

    origin: (3,) the lower corner of the grid.
    cell_size: the width of a cell.
    shape: the number of cells along x, y and z.
    empty_distance: for each cell, x fastest, the chessboard distance, in cells, to the nearest cell
        that is not proved empty; 0 for such a cell itself.
    margin: an empty cell enlarged on all sides by this number of cells is empty too.
    """

    backend: Backend
    origin: Vec3
    cell_size: Real
    shape: Vec3
    empty_distance: Any
    margin: float

    @staticmethod
    def upload_layout(backend: Backend, layout: GridData) -> tuple[Backend, Vec3, Real, Vec3, Any]:
        """Upload a grid to a backend. Returns the attributes backend, origin, cell_size, shape and
        empty_distance of an `EmptySpaceGrid`.

        layout: the grid in NumPy.
        """

        def vector(numbers: Any) -> Vec3:
            """Three numbers, uploaded as a vector."""
            return backend.Array3f(*(dr.opaque(backend.Float, float(number)) for number in numbers))

        return (
            backend,
            vector(layout.origin),
            dr.opaque(backend.Float, layout.cell_size),
            vector(layout.shape),
            upload_integers(backend, layout.empty_distance),
        )

    @property
    def usable_margin(self) -> float:
        """`margin` without the part that is reserved for the rounding of positions."""
        return self.margin - _ROUNDING_SHARE

    def cell(self, p: Vec3) -> GridCell:
        """The cell in which p lies or, if p is outside of the grid, the nearest cell."""
        position = (p - self.origin) / self.cell_size
        corner = type(p)(*(clamp(dr.floor(position[k]), 0, self.shape[k] - 1) for k in range(3)))
        x, y, z = (self.backend.UInt32(corner[k]) for k in range(3))
        row, layer = self.backend.UInt32(self.shape.x), self.backend.UInt32(self.shape.y)
        return GridCell(self, position, corner, x + row * (y + layer * z))

    def empty_run(self, p: Vec3, d: Vec3, length: Real) -> Real:
        """For each ray, a length s for which p + s d is proved to stay in empty cells from p on; it
        may exceed `length`. It is 0 if p is not in an empty cell.

        p, d: the start and the direction of each ray.
        length: the length at which the search may stop.

        Proof. All cells less than empty_distance cells away from a point's cell are empty, and so
        are the margins around them. These cells form a cube, and with their margins a cube larger
        by the margin. A step leaves the cube of cells by at most the margin minus
        `_ROUNDING_SHARE`, so it stays inside of the larger cube; the remaining `_ROUNDING_SHARE` is
        for the rounding of positions. Steps end in the first cell that is not proved empty.
        """

        def extend(s: Real) -> tuple[Real, Mask]:
            """A length, at least s, up to which the path from p + s d on stays in empty cells; and
            a mask of whether the cell at p + s d is empty. If it is not, the length is s."""
            cell = self.cell(dr.fma(type(p)(s), d, p))
            free_cells = cell.empty_distance
            return dr.select(
                free_cells > 0, s + cell.exit_distance(d, self.backend.Float(free_cells)), s
            ), free_cells > 0

        def body(s: Real, active: Mask) -> tuple[Real, Mask]:
            """Extend s on active lanes. Returns the new s, and the mask of lanes that stay active:
            where the cell at p + s d is empty and the new s is less than `length`, where the search
            may stop."""
            further, empty = extend(s)
            return dr.select(active, further, s), active & empty & (further < length)

        # 0 for each lane, but NaN if p is not finite: then the lane is not active.
        start = self.backend.Float(0) + 0 * p.x
        active = dr.full(self.backend.Bool, True, 1) & (start == start) & (length > 0)

        def running(s: Real, active: Mask) -> Mask:
            """Whether s is to be extended further (`active`): the cell at p + s d is empty, and s
            is less than `length`."""
            del s
            return active

        return dr.while_loop((start, active), running, body, label="empty cells")[0]

    def is_resolved(self, o: Vec3, end: Real) -> Mask:
        """Whether coordinates are precise enough for the grid. They are if rounding moves points of
        rays by less than the part of the margin that is reserved for rounding. False if o is not
        finite.

        o: the origins of the rays.
        end: the length up to which their points count.
        """
        rounding = 4 * self.backend.machine_epsilon * (max_norm(o) + end)
        return (rounding < _ROUNDING_SHARE * self.cell_size) & dr.all(dr.isfinite(o))

    def end_of_empty_run(self, o: Vec3, d: Vec3, t: Real, end: Real) -> Real:
        """A ray parameter, at most `end`, up to which rays o + t d, |d| = 1, are proved to stay in
        empty cells from `t` on.

        It is `t` itself if coordinates are so large that rounding might move a point too far
        (`is_resolved`): a point is off by at most four roundings of its largest coordinate.

        o, d: origin and direction of each ray.
        t, end: the ray parameters at which the search starts and at which it may stop.
        """
        length = dr.select(self.is_resolved(o, end), end - t, 0)
        run = self.empty_run(dr.fma(type(o)(t), d, o), d, length)
        return dr.select(length > 0, fmin(t + run, end), t)


@dataclass(frozen=True)
class GridCell:
    """The cell of a grid in which a point lies, for each lane (entry of Dr.Jit's arrays).
    Coordinates are in units of cells from the origin of the grid.

    cell_coordinates: the coordinates of the point.
    corner: the coordinates of the lower corner of its cell.
    index: the index of the cell in `EmptySpaceGrid.empty_distance`.
    """

    grid: EmptySpaceGrid
    cell_coordinates: Vec3
    corner: Vec3
    index: Any

    @property
    def empty_distance(self) -> Any:
        """The chessboard distance, in cells, from this cell to the nearest occupied one
        (`GridData`)."""
        return dr.gather(self.grid.backend.UInt32, self.grid.empty_distance, self.index)

    def exit_distance(self, d: Vec3, reach: Real = 1.0) -> Real:
        """The length up to which the path from the point (`cell_coordinates`) in direction d stays
        within a cube of cells around it.

        reach: the cube consists of the cells less than `reach` cells away from the point's cell,
            and of the margin around them.

        The path may leave the cube through a face on which the grid ends, since points outside of
        the grid are treated like the nearest cell. So the length may be infinite.
        """
        # self.corner: the lower corner of the point's cell.
        length: Real = self.grid.backend.Float(dr.inf)
        margin = self.grid.usable_margin
        for k in range(3):
            # The planes of the cube across this axis; the path leaves through one of them.
            upper, lower = self.corner[k] + reach, self.corner[k] + 1 - reach
            is_rising = d[k] > 0
            gap = dr.select(
                is_rising, upper - self.cell_coordinates[k], self.cell_coordinates[k] - lower
            )
            is_grid_end = dr.select(is_rising, upper >= self.grid.shape[k], lower <= 0)
            distance = (gap + margin) / dr.abs(d[k])
            length = fmin(dr.select(is_grid_end | (d[k] == 0), dr.inf, distance), length)
        return length * self.grid.cell_size


def distance_to_occupied(empty: BoolArray) -> IntArray:
    """The array `GridData.empty_distance` (cells,), x fastest: for each cell the chessboard
    distance, in cells, from the nearest cell that is not empty. If all cells are empty, it is the
    largest number of cells along an axis.

    empty: (nz, ny, nx) a mask of the empty cells.
    """
    # (SciPy has this transform, but importing `scipy.ndimage` takes a fifth of a second.)
    longest = max(empty.shape)
    # One larger than the longest distance is computed, too. Bytes stay in the processor's cache.
    kind = np.uint8 if longest < 255 else np.int32
    distance = np.where(empty, kind(longest), kind(0))
    # A way of least length goes along x first, then diagonally in x and y or along y, then in all
    # of x, y and z. So sweeps along x, along y and along z find all distances.
    for axis in (2, 1, 0):
        planes = np.moveaxis(distance, axis, 0)
        count, swept = len(planes), (axis == 0, axis <= 1)
        for step, order in ((-1, range(1, count)), (1, range(count - 2, -1, -1))):
            for k in order:
                before = _least_of_three(planes[k + step], swept)
                np.minimum(planes[k], before + kind(1), out=planes[k])
    return distance.astype(np.int64).ravel()


def _least_of_three(plane: IntArray, along: tuple[bool, bool]) -> IntArray:
    """For each entry of a plane the least of it and its neighbors along the axes in `along`, and
    along both also diagonally."""
    for axis in (0, 1):
        if along[axis]:
            entries, least = np.moveaxis(plane, axis, 0), plane.copy()
            rows = np.moveaxis(least, axis, 0)
            np.minimum(rows[1:], entries[:-1], out=rows[1:])
            np.minimum(rows[:-1], entries[1:], out=rows[:-1])
            plane = least
    return plane


def round_to_short_float(size: float) -> float:
    """A length near `size`, off by at most one part in 4,096, whose small multiples single
    precision represents exactly. It is a power of two times an integer below 2^13."""
    mantissa, exponent = math.frexp(size)
    return math.ldexp(round(mantissa * 4096), exponent - 12)


# `EmptySpaceGrid.margin` of the grids; and how often cubes are halved down to cells, so that the
# first cubes are 2^_ROUNDS cells wide.
_MARGIN, _ROUNDS = 1 / 16, 3


@dataclass(frozen=True)
class OccupancyGrid(GridData):
    """A uniform grid of cubes, some of which may contain points of a set; the other cells are
    empty. Empty cells, and margins of 1/16 cell around them, are proved to contain no point of the
    set."""

    @classmethod
    def from_clearance(
        cls, lower: FloatArray, upper: FloatArray, clearance: Clearance, across: int
    ) -> OccupancyGrid:
        """Build a grid over a box that contains the set, with about `across` cells along the box's
        longest side.

        lower, upper: the corners (3,) of the box.
        clearance: gives proved lower bounds of the distances of points from the set.
        """

        def is_empty(cells: BoxCells, margin: float) -> BoolArray:
            return cells.is_proved_empty(clearance, margin)

        return cls.from_test(lower, upper, is_empty, across)

    @classmethod
    def from_test(
        cls, lower: FloatArray, upper: FloatArray, is_empty: EmptinessTest, across: int
    ) -> OccupancyGrid:
        """Build a grid as `from_clearance` does, by a test of boxes.

        There are no points of the set outside of the box, so an empty cell at a face of the box
        stays empty if it is extended outwards. Cells are never smaller than the spacing of the
        box's largest coordinate in single precision, so there may be fewer than `across`.
        """
        reach = np.abs([lower, upper]).max().astype(np.float32)
        cell = max(float((upper - lower).max()) / across, float(np.spacing(reach)))
        cell = round_to_short_float(cell)  # single precision has its small multiples exactly
        # For rounding the corner down, and for the margin beyond the box.
        room = (_MARGIN + 1e-3) * cell
        origin = np.nextafter((lower - room).astype(np.float32), np.float32(-np.inf))
        origin = origin.astype(np.float64)  # the same numbers
        # The grid is first filled with cubes of this width, which are then halved down to cells.
        side = cell * 2**_ROUNDS
        nx, ny, nz = (int(count) for count in np.ceil((upper + room - origin) / side))
        indices = np.indices((nx, ny, nz)).reshape(3, -1).T
        roots = BoxCells(origin + side * indices, np.full(3, side))
        # Margins are fractions of a cube: those of large cubes are larger than needed, never
        # smaller.
        roots = roots.subset(~is_empty(roots, _MARGIN))
        # The largest integer: no limit of the number of cells.
        most = int(np.iinfo(np.int64).max)
        cells = refine_by_test(roots, is_empty, most, _ROUNDS, _MARGIN).occupied
        nx, ny, nz = (count << _ROUNDS for count in (nx, ny, nz))
        mask = np.ones((nz, ny, nx), np.bool_)
        x, y, z = np.round((cells.corners - origin) / cell).astype(np.int64).T
        mask[z, y, x] = False
        return cls(origin, cell, (nx, ny, nz), distance_to_occupied(mask))

    @classmethod
    def empty(cls) -> OccupancyGrid:
        """The grid of a set without points: a single cell, which is empty."""
        return cls(np.zeros(3), 1.0, (1, 1, 1), distance_to_occupied(np.ones((1, 1, 1), np.bool_)))

    def occupied_boxes(self) -> BoxCells:
        """The cells that are not empty, with their margins, in the order of their indices."""
        size = np.full(3, self.cell_size * (1 + 2 * _MARGIN))
        return BoxCells(self.occupied_centers() - 0.5 * size, size)

    def occupied_centers(self) -> FloatArray:
        """The centers (n, 3) of the cells that are not empty."""
        x, y, z = self.shape
        indices = np.argwhere((self.empty_distance == 0).reshape(z, y, x))[:, ::-1]
        return self.origin + self.cell_size * (indices + 0.5)

    def refined(self, clearance: Clearance) -> OccupancyGrid:
        """The same grid with more empty cells: a cell also counts as empty if its eight octants are
        all proved empty. Each octant is enlarged by the margin of the cell before it is tested.

        clearance: gives proved lower bounds of the distances of points from the set.
        """
        x, y, z = self.shape
        is_occupied = (self.empty_distance == 0).reshape(z, y, x)
        indices = np.argwhere(is_occupied)[:, ::-1]  # as (x, y, z)
        halves = BoxCells(
            self.origin + self.cell_size * indices, np.full(3, self.cell_size)
        ).octants()
        # Margins are fractions of the size, here of half a cell.
        is_occupied[is_occupied] = ~halves.is_proved_empty(clearance, 2 * _MARGIN).reshape(
            -1, 8
        ).all(axis=1)
        return replace(self, empty_distance=distance_to_occupied(~is_occupied))

    def upload(self, backend: Backend) -> EmptySpaceGrid:
        """The grid on a backend, for rays."""
        return EmptySpaceGrid(*EmptySpaceGrid.upload_layout(backend, self), _MARGIN)


# Cells that share a face, an edge or a corner are neighbors.
_NEIGHBOR_STENCIL = np.ones((3, 3, 3), np.bool_)


def largest_connected_component(cells: OccupancyGrid) -> OccupancyGrid:
    """The grid in which only the largest group of connected cells counts as occupied, that is, as
    not proved empty. A grid without occupied cells is returned as it is.

    The size of a group is the sum of its projections along the three axes. A projection counts the
    rows of cells along an axis that contain a cell of the group. Of equal groups, the first along
    z, y and x is chosen.

    The number of cells would be a worse measure of areas or volumes. It would be right only if each
    piece of a surface were surrounded by as many occupied cells. But there are more occupied cells
    around a piece on which the function vanishes to a higher order; and around the two sides of a
    plate thinner than a cell there are no more than around a single side. Projections are
    independent of the number of layers of cells, except at their outlines. Where a function
    vanishes to a higher order, the outline is several cells wider, so that with coarse cells a
    smaller component may be chosen.

    Proof that no component of the set is cut in two. All of the set lies in occupied cells, as
    closed cubes. A connected part of it cannot be covered by two unions of such cubes that are
    closed and have no point in common. Cubes have a point in common if they share at least a
    corner, that is, if they are neighbors. So the part lies in the cells of a single group.

    Proof that rays may jump across the other groups, and beyond their cells by the margin
    (`EmptySpaceGrid.empty_run`). A neighbor of a cell of another group belongs to that group or was
    empty before, and the margin is less than a cell. So the margin contains nothing of the chosen
    group. The margin of a cell that was empty before contains nothing of the set at all.
    """
    x, y, z = cells.shape
    is_occupied = (cells.empty_distance == 0).reshape(z, y, x)
    if not is_occupied.any():
        return cells
    from scipy import ndimage  # imported here: it takes a third of a second

    # groups: 0 for empty cells, else the number of the group, from 1 on.
    groups, count = cast("Any", ndimage).label(is_occupied, _NEIGHBOR_STENCIL)
    group, indices = groups[is_occupied], np.argwhere(is_occupied)
    sizes = sum(_projection_sizes(group, np.delete(indices, axis, 1), count) for axis in range(3))
    chosen = groups == 1 + int(np.argmax(sizes))
    return replace(cells, empty_distance=distance_to_occupied(~chosen))


def _projection_sizes(group: IntArray, places: IntArray, count: int) -> IntArray:
    """The numbers (count,) of different places of each group: the sizes of the groups' projections
    onto a plane.

    group: (n,) the group that each place belongs to, from 1 to count.
    places: (n, 2) cells of a plane, onto which the cells of groups were projected.
    """
    # A group and a place become one integer, from which the group is recovered by division.
    width = 1 + places.max(axis=0)
    index = (group * width[0] + places[:, 0]) * width[1] + places[:, 1]
    return np.bincount(np.unique(index) // (width[0] * width[1]), minlength=count + 1)[1:]
