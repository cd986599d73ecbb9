"""A tree over cells, cubes that may hold a surface. It finds the cells near a query point, and
bounds of the distance of the surface in them. For each cell the surface in it is either unknown or
proved to lie in a slab (two parallel planes). Some cells also have a known point of the surface. If
the boundary of the field's domain cuts the surface in a curve, the clip curve, cells may have a
point of this curve.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.elementary import fmax, fmin
from harnack.backend.loops import update_where_active
from harnack.tree import PackedTree, build_balanced_tree, for_each_primitive, pack_tree, traverse
from harnack.tree.closest_triangles import squared_distance_in_nearby_leaf
from harnack.tree.triangle_tree import node_boxes

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.balanced_tree import LoopValues, VisitedNode

__all__ = ["FAR_SENTINEL", "BestCandidate", "CellTree", "SurfaceCells"]

FAR_SENTINEL = 1e150
"""Coordinates of missing surface points, and the thickness of slabs that bound nothing."""
# Cells per leaf: a visit of a node takes a tenth of the time of a visit of a cell.
_LEAF_SIZE = 1
# Number of candidates (surface points from which a descent may lead to a nearer point) that one
# traversal of the tree returns.
_CANDIDATES_PER_WALK = 4
# Two surface points that are closer to each other than this many half edges of a cell are taken to
# lead to the same closest point. The first number is for cells in which the surface is in one piece
# and does not end, the second for all others.
_SEPARATION, _SEPARATION_IN_PIECES = 4.0, 3.0
# The surface in a cell is in one piece if its slab is thinner than this many half edges.
_SINGLE_PIECE_THICKNESS = 0.5
# Within this distance of its known point, in half edges, the clip curve is taken for a line.
_CLIP_CURVE_RADIUS = 4.0


@dataclass(frozen=True)
class SurfaceCells:
    """Cubes that may hold a surface, the cells, with a slab (two parallel planes) that contains the
    surface in the cell, and a point of the surface in it, where these are known.

    FAR stands for `FAR_SENTINEL`: not known.

    center: (n, 3) the centers.
    half: (n,) half the length of an edge.
    surface_point: (n, 3) a point of the surface, no farther from the center than the cell is wide,
        or FAR.
    normal, offset, thickness: (n, 3), (n,), (n,) the slab: a surface point y in the ball around the
        cell has |normal . (y - center) - offset| <= thickness. Where no slab is known the thickness
        is FAR; where no plane approximates the surface the normal is zero.
    plane_radius: (n,) within this radius about its surface point the surface is nearly a plane at
        right angles to `normal`.
    curvature: (n,) an upper bound of the surface's curvature at the surface point, or FAR.
    clip_point: (n, 3) a point of the clip curve, at which a domain cuts the surface, or FAR.
    clip_curvature: (n,) the curvature of the clip curve there.
    """

    center: FloatArray
    half: FloatArray
    surface_point: FloatArray
    normal: FloatArray
    offset: FloatArray
    thickness: FloatArray
    plane_radius: FloatArray
    curvature: FloatArray
    clip_point: FloatArray
    clip_curvature: FloatArray

    @classmethod
    def unknown(cls, center: FloatArray, half: FloatArray) -> SurfaceCells:
        """Return cubes without slabs and surface points.

        center: (n, 3) the centers.
        half: (n,) half the length of an edge.
        """
        n = len(half)
        far, zero = np.full((n, 3), FAR_SENTINEL), np.zeros(n)
        # After center and half: surface_point, normal, offset, thickness, plane_radius, curvature,
        # clip_point and clip_curvature, each an array of its own.
        return cls(
            center, half, far, np.zeros((n, 3)), zero, np.full(n, FAR_SENTINEL), zero.copy(),
            np.full(n, FAR_SENTINEL), far.copy(), zero.copy(),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.half)

    def select(self, mask: BoolArray) -> SurfaceCells:
        """Return the cells that a mask (n,) selects."""
        return SurfaceCells(*(column[mask] for column in vars(self).values()))

    @property
    def is_single_piece(self) -> BoolArray:
        """(n,) whether the slab of a cell is so thin that the surface in it is in one piece."""
        return self.thickness < _SINGLE_PIECE_THICKNESS * self.half

    @classmethod
    def concatenate(cls, parts: list[SurfaceCells]) -> SurfaceCells:
        """Return the cells of all `parts`, one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class BestCandidate:
    """The surface point closest to a query that was found so far, one for each lane.

    point: the surface point.
    distance: its distance from the query.
    exclusion_radius: the radius of a ball about `point` that is proved to hold no surface point
        nearer to the query.
    separation_factor: no descent starts from the surface point of a cell that is closer to `point`
        than this factor times three or four half edges of the cell (its `separation`): such a
        descent is taken to end at `point` again.
    """

    point: Vec3
    distance: Real
    exclusion_radius: Real
    separation_factor: Real


@dataclass(frozen=True)
class CellTree:
    """A bounding-volume tree over at least one cell (a cube that may hold a surface), stored on a
    backend. Each cell has a record: its box, a slab that contains the surface in it, and a known
    point of the surface."""

    tree: PackedTree

    @classmethod
    def of(cls, backend: Backend, cells: SurfaceCells) -> CellTree:
        """Build the tree of the cells. If a cell has a point of the clip curve (in which the
        boundary of the domain cuts the surface), the tree has a second record for that point.

        Besides the attributes of a cell (`SurfaceCells`) a record has an index, a bound of how much
        too large its estimate of a distance may be, and a separation; `_CellRecord` explains them.
        """
        clip_rows = np.flatnonzero(cells.clip_point[:, 0] < FAR_SENTINEL)
        count, cell_of_record = len(cells), np.concatenate([np.arange(len(cells)), clip_rows])
        is_plain = cells.is_single_piece & (cells.clip_point[:, 0] == FAR_SENTINEL)
        separations = np.where(is_plain, _SEPARATION, _SEPARATION_IN_PIECES) * cells.half
        # How far the surface may be from its plane: a fraction of curvature times radius^2, but not
        # farther than its slab allows. It decides only in which cells descents start.
        bulge = 0.15 * cells.curvature * np.square(cells.plane_radius)
        slack = np.where(cells.is_single_piece, np.minimum(cells.thickness, bulge), 0.0)
        records = np.column_stack(
            [
                cells.center,
                cells.half,
                cells.surface_point,
                cells.thickness,
                cells.normal,
                cells.offset,
                np.arange(count, dtype=np.float64),
                cells.plane_radius,
                slack,
                separations,
            ]
        )[cell_of_record]
        # The same for the clip curve and its tangent line.
        radius = _CLIP_CURVE_RADIUS * cells.half[clip_rows]
        bulge = radius * np.minimum(0.25, cells.clip_curvature[clip_rows] * radius)
        # The records of clip points: another point at the places 4 to 6; other numbers from place
        # 12 on, of which the first is the index -1. They keep the box and the slab of their cell.
        records[count:, 4:7] = cells.clip_point[clip_rows]
        records[count:, 12:] = np.column_stack([
            np.full(len(clip_rows), -1), radius, bulge,
            _SEPARATION_IN_PIECES * cells.half[clip_rows],
        ])  # fmt: skip
        center, half = cells.center[cell_of_record], cells.half[cell_of_record, None]
        hierarchy = build_balanced_tree(center, leaf_size=_LEAF_SIZE)
        slot_records = hierarchy.values_in_slots(records)
        # Empty places of leaves get a record that is infinitely far away: no center and no point,
        # no slab, the normal 0, and the index -1.
        slot_records[hierarchy.leaf_slots < 0] = (
            [FAR_SENTINEL] * 3 + [0] + [FAR_SENTINEL] * 4 + [0, 0, 0, 0, -1, 0, 0, 0]
        )
        boxes = node_boxes(hierarchy, center - half, center + half)
        return cls(pack_tree(backend, hierarchy, boxes, slot_records))

    def best_start(self, x: Vec3, limit: Real) -> Vec3:
        """Return the surface point at which a search for the point closest to x should start. It is
        the known surface point of the cell in which the surface has the smallest estimated distance
        from x (`_CellRecord.estimate`). It is `FAR_SENTINEL` if no estimate is below `limit`, a
        length."""
        vector = self.tree.backend.Array3f

        def visit_cell(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """Return the smallest estimated distance and the surface point of its cell, after a
            visit of another cell. row: the cell's record. state: the two values before the
            visit."""
            best, point = state
            cell = _CellRecord.of(vector, row)
            estimate = cell.estimate(x)
            is_best = active & (estimate < best)
            return dr.select(is_best, estimate, best), dr.select(is_best, cell.surface_point, point)

        # The distance of the surface point of a cell near x limits the traversal from the start.
        # (4 is the place of the surface point in a record.)
        upper_bound = (1 + 1e-9) * dr.sqrt(squared_distance_in_nearby_leaf(self.tree, x, 4))
        start = fmin(upper_bound, limit), vector(FAR_SENTINEL)
        # The state is (estimated distance, surface point); the walk is limited by the first.
        return self._walk(x, visit_cell, start, lambda state: dr.square(state[0]))[1]

    def closer_candidates(
        self, x: Vec3, best: BestCandidate, points: tuple[Vec3, ...], tolerance: Real, marks: Any
    ) -> tuple[Real, list[Vec3]]:
        """Find cells that may hold a point nearer to x than `best`.

        best: the surface point closest to x so far.
        points: surface points at which searches started already.
        tolerance: a length; cells that may hold a point nearer by less than this do not count.
        marks: None, or a Bool array with one entry for each cell. Here the entry of every cell
            whose lower bound is below best.distance - tolerance is set to True, even if the cell's
            surface point is skipped.

        Returns a lower bound of the distance from x to the surface, at most best.distance; and the
        surface points (`FAR_SENTINEL` for none) of the few cells with the smallest estimated
        distance, among those whose lower bound is below best.distance - tolerance. Points that are
        so close to `best`, to `points` or to each other that both lead to the same closest point
        (`_SEPARATION`) are skipped.
        """
        backend = self.tree.backend
        vector, index = backend.Array3f, backend.UInt32

        def visit_cell(row: list[Real], active: Mask, state: LoopValues) -> LoopValues:
            """Visit a cell, and return the new state. The lower bound of the distance is reduced to
            the cell's own, if that is smaller. If the cell may hold a nearer point, it is marked;
            and its surface point is added to the list of candidates, if a descent from it is worth
            its time.

            row: the cell's record.
            state: the lower bound so far, then the list of candidates.

            x, best, points, tolerance and marks are the parameters of `closer_candidates`.
            """
            lower, *listed = state
            cell = _CellRecord.of(vector, row)
            # Cells in the exclusion ball about the best point hold no nearer point.
            is_relevant = active & ~cell.is_within(best.point, best.exclusion_radius)
            cell_bound = cell.lower_bound(x)
            is_open_cell = is_relevant & (cell_bound < best.distance - tolerance)
            if marks is not None:
                cell_index = index(fmax(cell.number, 0))
                dr.scatter(marks, backend.Bool(True), cell_index, is_open_cell & cell.is_cell)
            lower = dr.select(is_relevant & cell.is_cell, fmin(lower, cell_bound), lower)
            estimate = cell.estimate(x)
            # The point is worth a descent if the estimate, less its slack, is below the best
            # distance.
            is_listed = is_open_cell & (estimate < best.distance + cell.estimate_slack)
            is_listed &= cell.is_separated(best.point, best.separation_factor)
            # (1: at least the cell's separation away.)
            for other in points:
                is_listed &= cell.is_separated(other, 1.0)
            estimate = dr.select(is_listed, estimate, dr.inf)
            insert = functools.partial(with_candidate, cell, estimate)
            return lower, *update_where_active(is_listed, insert, (*listed,), "listed cells")

        def with_candidate(cell: _CellRecord, estimate: Real, state: LoopValues) -> LoopValues:
            """Insert the surface point of `cell` in the list of candidates. Returns the new list.

            estimate: the estimated distance of the surface in the cell from the query.
            state: the list, of fixed length: alternately the estimate and the surface point of each
                candidate, sorted by estimate.

            Candidates with a larger estimate move to the next place, and the last one is dropped.
            If the new candidate and a listed one are so close that both lead to the same closest
            point, the one with the larger estimate is dropped instead.
            """
            listed, point = [*state], cell.surface_point
            for k in range(0, len(listed), 2):
                old, y = listed[k], listed[k + 1]
                # (1: apart by at least the cell's separation.)
                is_nearer, is_apart = estimate < old, cell.is_separated(y, 1.0)
                listed[k] = dr.select(is_nearer, estimate, old)
                listed[k + 1] = dr.select(is_nearer, point, y)
                estimate = dr.select(is_apart, dr.select(is_nearer, old, estimate), dr.inf)
                point = dr.select(is_nearer, y, point)
            return tuple(listed)

        def may_contain(low: Vec3, high: Vec3) -> Mask:
            """Return whether a box, with the corners `low` and `high`, extends outside of the ball
            about the best point that is proved to hold no nearer point."""
            y = best.point
            # The corner of the box that is farthest from the best point.
            corner = vector(*(fmax(high[k] - y[k], y[k] - low[k]) for k in range(3)))
            return dr.squared_norm(corner) >= best.exclusion_radius * best.exclusion_radius

        # Boxes farther away than the best point are skipped; the list begins with infinite
        # estimates.
        limit = backend.Float(best.distance)
        empty_list = (
            entry
            for _ in range(_CANDIDATES_PER_WALK)
            for entry in (backend.Float(dr.inf), vector(FAR_SENTINEL))
        )
        start = limit, *empty_list
        lower, *listed = self._walk(x, visit_cell, start, lambda state: limit * limit, may_contain)
        # The points only, without their estimates.
        return lower, listed[1::2]

    def _walk(
        self, x: Vec3, visit_cell: Any, start: LoopValues, limit: Callable[[LoopValues], Real],
        may_contain: Callable[[Vec3, Vec3], Mask] = lambda low, high: low.x <= high.x,
    ) -> LoopValues:  # fmt: skip
        """Traverse the tree from the root, and visit its cells. Returns the final state.

        x: the query.
        visit_cell: a function of a cell's record, the active lanes and the state that returns the
            new state.
        start: the initial state of the traversal.
        limit: a function of the state; boxes whose squared distance from x is above its result are
            skipped.
        may_contain: a function of the lower and the upper corner of a box that tells whether the
            box is to be visited; by default every box is.
        """
        vector = self.tree.backend.Array3f

        def visit(node: VisitedNode, state: LoopValues) -> tuple[Mask, LoopValues]:
            """Return a mask and the new state. The mask tells where the traversal enters the node:
            where its box is near enough. If the node is a leaf, its cells are visited, which
            changes the state."""
            # The corners of the node's box, and the vector between x and the box (0 inside).
            low, high = vector(*node.head[:3]), vector(*node.head[3:6])
            offset = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
            is_near = (dr.squared_norm(offset) < limit(state)) & may_contain(low, high)
            return is_near, for_each_primitive(node, is_near & node.is_leaf, visit_cell, state)

        return traverse(self.tree, visit, start)


@dataclass(frozen=True)
class _CellRecord:
    """A record of the tree: a cell (a cube that may hold the surface), or a point of the clip curve
    in a cell (the curve in which the boundary of the field's domain cuts the surface). Most
    attributes are those of a cell in `SurfaceCells`; the others are:

    number: the index of the cell; -1 for a point of the clip curve.
    spread: within this radius about `surface_point` the surface is taken for a plane, and the clip
        curve for a line.
    estimate_slack: an upper bound of (estimate - distance) for the surface in the cell.
    separation: surface points that are closer than this to `surface_point` are taken to lead to the
        same closest point.
    """

    center: Vec3
    half: Real
    surface_point: Vec3
    thickness: Real
    normal: Vec3
    offset: Real
    number: Real
    spread: Real
    estimate_slack: Real
    separation: Real

    @classmethod
    def of(cls, vector: Any, row: list[Real]) -> _CellRecord:
        """Make the record that is stored in a row of 16 numbers, in the order in which
        `CellTree.of` writes them. vector: the type of 3-vectors."""
        return cls(
            # In the order of the attributes.
            vector(*row[:3]),
            row[3],
            vector(*row[4:7]),
            row[7],
            vector(*row[8:11]),
            *row[11:16],
        )

    @property
    def is_cell(self) -> Mask:
        """Whether the record describes a cell, and not a point of the clip curve."""
        return self.number >= 0

    def lower_bound(self, x: Vec3) -> Real:
        """Return a lower bound of the distance from x to the surface in the cell. It is the larger
        of two distances from x: to the cell's box, and to the part of its slab in the ball around
        the cell."""
        vector = cast("Any", type(x))
        from_center = x - self.center
        box_distance = dr.norm(
            vector(*(fmax(dr.abs(from_center[k]) - self.half, 0) for k in range(3)))
        )
        height = dr.dot(from_center, self.normal)
        in_plane_distance = dr.norm(dr.fma(vector(-height), self.normal, from_center))
        normal_gap = fmax(dr.abs(height - self.offset) - self.thickness, 0)
        # (A cell without a slab has a huge thickness, so that this gap is 0.) The ball has the
        # radius sqrt(3) half.
        in_plane_gap = fmax(in_plane_distance - 1.7321 * self.half, 0)
        return fmax(box_distance, dr.norm(vector(normal_gap, in_plane_gap, 0)))

    def estimate(self, x: Vec3) -> Real:
        """Return an estimate of the distance from x to the surface in the cell, not below the
        proved bound; infinite if no surface point is known.

        Within `spread` of its point the surface is taken for a plane, and the clip curve for a
        line. The vector from x to the closest point of the plane or line is at right angles to the
        vector from there to the surface point: so the distance follows by Pythagoras.
        """
        from_point = x - self.surface_point
        # A point of the clip curve has no plane.
        height = dr.select(self.is_cell, dr.dot(from_point, self.normal), 0)
        lateral_square = dr.squared_norm(from_point) - height * height - self.spread * self.spread
        distance = dr.sqrt(dr.fma(height, height, fmax(lateral_square, 0)))
        # (A missing point is at `FAR_SENTINEL`.)
        return dr.select(
            self.surface_point.x < 0.5 * FAR_SENTINEL, fmax(distance, self.lower_bound(x)), dr.inf
        )

    def is_separated(self, y: Vec3, times: Real) -> Mask:
        """Return the mask of lanes on which the surface point is at least `times` * `separation`
        away from y."""
        return dr.squared_norm(self.surface_point - y) >= dr.square(times * self.separation)

    def is_within(self, y: Vec3, radius: Real) -> Mask:
        """Return the mask of lanes on which the whole cell is within a radius of y."""
        farthest = dr.abs(y - self.center) + self.half
        return dr.squared_norm(farthest) < radius * radius
