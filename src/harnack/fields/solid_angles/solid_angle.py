"""The field f of this module is the signed solid angle of closed curves: the area that the curves
enclose on the unit sphere around a point, modulo 4 pi. "The curve" means all closed curves of a
field together: polygons that need not be plane, and circles. They may have holes, knots, links or
many turns. The *lift* of f is the continuous function near a point that equals f modulo 4 pi.
*Promises* are proved bounds of the lift near a point, by which rays take steps that cannot miss a
level set. In unit coordinates the curve has its center at 0 and a radius of 1. In an *FMM cell*
(fast multipole method) near edges are summed directly, and all others are replaced by one
polynomial. A sample's *accuracy scale* is a number: larger is more accurate. A *lane* is one entry
of Dr.Jit's arrays, such as a point or a ray; a *backend* is what Dr.Jit computes on, and in which
precision."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, backend_of, choose_backend, to_numpy
from harnack.backend.elementary import fmin
from harnack.backend.tensors import is_tensor, tensor_to_vectors
from harnack.backend.validation import check_length_range, check_no_derivatives
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import HarmonicBall, Lipschitz
from harnack.fields.batch_evaluation import map_batches
from harnack.fields.batched_fields import cached_upload
from harnack.fields.capabilities import Boundary, VariableAccuracy
from harnack.fields.clearance import tight_extent
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Ray, RaySample, Sample, Traits, space_scaled
from harnack.fields.solid_angles.cell_options import NO_CELLS, CellChoice, FieldWithCells
from harnack.fields.solid_angles.planar import PlanarRegion, planar_region
from harnack.fmm.circle_sums import CircleSet, CircleSums
from harnack.fmm.curve_cell_builder import build_curve_cells
from harnack.fmm.curve_cells import CurveCells, CurveCellSums
from harnack.fmm.curve_queries import (
    closest_on_segments,
    continuous_change,
    gradient_change_bound,
    lift_ball,
    remainder_promises,
    segment_records,
)
from harnack.fmm.edges import (
    CurveSums,
    LoopEdges,
    hessian_over_edges,
    sum_over_edges,
    vertex_rounding,
)
from harnack.fmm.moving_edges import MovingEdges
from harnack.fmm.source_sums import SECOND_ROUNDINGS, SLOPE_ROUNDINGS, SUM_MARGIN
from harnack.fmm.trail_sums import RayLine, line_rates, lipschitz_along
from harnack.fmm.unit_frame import UnitFrame, coordinate_rounding, frame_parameters
from harnack.geometry import Circle, ConvexHull, is_convex_position, total_length
from harnack.geometry.curves import CurveError, Loops, cancel_opposite_circles, validate_curves
from harnack.geometry.polygons import cancel_opposite_edges, remaining_edges
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from harnack.backend import Backend, Mask, Precision, Real, Vec3
    from harnack.geometry import Volume

LiftBoundName = Literal["auto", "planar", "edges", "convex", "paper"]

_PERIOD = 4 * math.pi
# Levels nearer than this to a multiple of 4 pi count as such a multiple.
_LEVEL_MARGIN = 1e-9 * _PERIOD
# The largest number of pairs of a cell and a vertex in one round for an extent.
_MAX_PAIRS = 3_000_000
# The number of sides of the polygons by which circles are drawn where a boundary is drawn.
_CIRCLE_SIDES = 256
# FMM cells save more time than they take to build if the number of rays times the number of edges
# is at least `_MIN_WORK`, and there are at least `_MIN_RAYS` rays and `_MIN_EDGES` edges. To trace
# these rays takes five times as long as to build the cells of a knot. The cells of a tangle of a
# thousand edges take ten times as long to build as those of a knot.
_MIN_WORK, _MIN_RAYS, _MIN_EDGES = 2.5e8, 1e6, 48
# The largest number of planes of the extent of a curve in convex position with cells, by
# experiment: with hundreds, clipping rays takes longer than the march.
_MAX_PLANES = 48


class SolidAngle(FieldWithCells):
    """The signed solid angle f of closed curves, in steradians, with period 4 pi (paper, Eq. 10).
    "The curve" means all loops together. Promises are proved bounds of f near a point.

    loops: one (n, 3) array-like of vertices, n >= 3, a `Circle`, or a list of these. Every loop is
        closed by itself. Orientation matters: a hole runs against its outer loop. A loop may be a
        Dr.Jit 3-vector of n lanes or a tensor (n, 3): hits, values and gradients can be
        differentiated by its vertices (`fmm.moving_edges`), but not by circles. Circles are exact,
        and cost about as much time as nine vertices.

    Edges that are traversed in both directions, by one loop or by two neighbors, are removed before
    anything is computed (`cancel_opposite_edges`): they do not contribute to f. If no edge is left,
    f is 0 everywhere, every ray is a proved miss, and levels that are multiples of 4 pi are
    refused.

    Proofs of steps. Second derivatives of f are bounded near every curve
    (`curve_queries.remainder_promises`), and steps are proved by that bound. The other proofs,
    chosen by the trace option `enclosures`, need a range of the lift on a ball, that is, of the
    continuous function that equals f modulo 4 pi. On wavy polygons and knots they take 1.4 to 2
    times as many evaluations.

    lift_bound: how the range of the lift on a ball is bounded. "auto" chooses "planar" if the
        hypothesis of that bound is checked to hold, else "convex" if its hypothesis holds, else
        "edges". If loops are Dr.Jit arrays it always chooses "edges", so that curves that are moved
        step by step do not change kernels.

    - "edges" holds for **every** curve: |grad f| and the bound of second derivatives bound the
      change of f (`lift_ball`).
    - "planar": let d be the distance from x to the curve. On the ball B(x, d) the lift stays in a
      range 4 pi wide if all loops together bound a region of a plane (`planar`). If the curves are
      circles only, it stays in the sum of one such range for each circle.
    - "convex": on B(x, d) the lift stays in (-6 pi, 6 pi) if the curve is one loop without
      self-intersections on the boundary of a convex set. For the principal value in (-2 pi, 2 pi)
      jumps by 4 pi at the 2 pi level, and a segment crosses this level at most once net (paper,
      Theorem C.1).
    - "paper" assumes that range for any curve and promises nothing else, as the paper does. This is
      false for coils and links, so that hits can be missed. It exists for comparisons.

    cells: whether to build FMM cells (fast multipole method), for many rays and curves of many
        vertices. In a cell, near edges are summed directly, and all others are one polynomial with
        a proved remainder. So an evaluation for tracing costs about the same time whatever the
        number of edges. Where the result depends on the remainder, all edges are summed. None
        builds cells where they save time (`cells_pay_from`), True always, False never. They take
        some 2 to 10 MB, at most the number of megabytes of this argument (True: 256). If that is
        too small, there are no cells, and `describe` of an evaluator reports this. They are built
        at the first trace, for each precision, which takes as long as tracing some 200,000 to
        600,000 camera rays without cells. Circles have no cells. Values and derivatives at points
        are those of all edges.

    Raises CurveError for loops that are not closed curves, ValueError for "convex" or "planar" if
    the hypothesis fails, and for cells if a loop is a Dr.Jit array, as its vertices may move.
    """

    period: ClassVar[float | None] = _PERIOD
    default_level: float = 2 * math.pi
    # The over-relaxation is by experiment.
    traits = Traits(over_relaxation=1.3, has_parameter_derivatives=True)

    def __init__(
        self,
        loops: Any,
        *,
        lift_bound: LiftBoundName = "auto",
        cells: bool | float | None = None,
    ) -> None:
        """Validate the curve, remove edges that cancel each other, and decide how the range of the
        lift is bounded.

        loops: the closed curves: arrays (n, 3) of vertices, or circles; one of them or a list.
        lift_bound: the way in which that range is bounded ("auto" to choose).
        cells: whether to build FMM cells: True, False, None if they save time, or the number of
            megabytes that they may take.
        """
        super().__init__()
        check_no_derivatives(type(self).__name__, lift_bound, cells)
        self.circles: tuple[Circle, ...]
        # Loops that are Dr.Jit arrays are kept besides, for derivatives by their vertices.
        curves, self._differentiable_loops = _movable_loops(loops)
        # net: the polygons as given. `_net_loops` and `_net_circles` are what remains after edges
        # and circles that cancel each other have been removed.
        net, self.circles = validate_curves(curves)
        self._loops: Loops = tuple(_read_only(loop) for loop in net)
        self._net_loops: Loops = cancel_opposite_edges(self.loops) if self.loops else ()
        self._net_circles = cancel_opposite_circles(self.circles)
        is_circle = not self._net_loops and len(self._net_circles) == 1
        self.convex_position = is_circle or (
            not self._net_circles and is_convex_position(self._net_loops)
        )
        # The region of a plane that the curve bounds; None if there is none.
        self._region: PlanarRegion | None = None
        if not self._all_cancel:
            self._region = planar_region(self._net_loops, self._net_circles)
        self.lift_bound_option: LiftBoundName = lift_bound
        self.lift_bound = self._resolve_lift_bound(lift_bound)
        # Unit coordinates: the center of the box around the curve, and the radius around it.
        points = self._points_around()
        self._center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self._size = float(np.linalg.norm(points - self._center, axis=1).max())
        self._extents: TransientCache[tuple[float, ...], Volume | None] = TransientCache()
        self.configure_cells(cells)
        if cells and self._differentiable_loops:
            raise ValueError(
                "cells are of curves that stay as they are, and a loop is a Dr.Jit array: give "
                "NumPy arrays, or no cells"
            )
        # Whether samples come from FMM cells whatever the number of rays.
        has_cells = bool(self._cell_choice(0))
        self.traits = dataclasses.replace(self.traits, has_variable_accuracy=has_cells)

    @property
    def loops(self) -> Loops:
        """The polygons of the curve: one array (n, 3) of vertices for each loop of the argument
        `loops` that is not a circle. They cannot be set, because all other data are computed from
        them once: another curve is another field."""
        return self._loops

    @property
    def _all_cancel(self) -> bool:
        """Whether every edge and every circle is also traversed in the opposite direction. Then f
        is 0 everywhere."""
        return not self._net_loops and not self._net_circles

    @property
    def boundary(self) -> Boundary | None:
        """The curve, as closed polygons (n, 3) without edges that cancel each other. Each circle is
        replaced by a polygon with many sides. None if all edges and circles cancel."""
        if self._all_cancel:
            return None
        circles = (circle.polygon(_CIRCLE_SIDES) for circle in self._net_circles)
        return Boundary(
            (*self._net_loops, *circles),
            closest_point=self._closest_on_curve,
            continuous_change=None if self._net_circles else self._continuous_change,
        )

    def _points_around(self) -> FloatArray:
        """Points (n, 3) whose convex hull contains the curve: the vertices of loops, and the
        corners of polygons around circles. If all edges and circles cancel each other, the points
        are those of the loops and circles that the user gave."""
        loops, circles = self._net_loops, self._net_circles
        if self._all_cancel:
            loops, circles = self.loops, self.circles
        return np.concatenate(
            [*loops, *(circle.polygon(64, circumscribed=True) for circle in circles)]
        )

    def _resolve_lift_bound(self, option: LiftBoundName) -> Literal["edges", "planar", "range"]:
        """Choose the way in which the range of the lift on a ball is computed.

        option: the argument `lift_bound` of the class. "auto" becomes the best way whose assumption
            about the curve is known to hold. "convex" and "paper" both become "range": the fixed
            range (-6 pi, 6 pi).

        Raises:
            ValueError: the option is unknown; or it is "convex" or "planar", and the curve does not
            satisfy the assumption of that bound.
        """
        if option == "auto":
            if self._differentiable_loops:
                return "edges"
            if self._region is not None or (self._net_circles and not self._net_loops):
                return "planar"
            return "range" if self.convex_position else "edges"
        if option == "convex" and not self.convex_position:
            raise ValueError(
                'lift_bound="convex" needs one loop without self-intersections on the boundary '
                'of its convex hull, and this is not one; use lift_bound="auto"'
            )
        if option == "planar":
            if self._region is None and (self._net_loops or not self._net_circles):
                raise ValueError(
                    'lift_bound="planar" needs disjoint loops that bound a region of a plane, or '
                    'circles alone, and this is neither; use lift_bound="auto"'
                )
            return "planar"
        if option not in ("edges", "convex", "paper"):
            names = ("auto", "planar", "edges", "convex", "paper")
            raise ValueError(
                f"unknown lift_bound {option!r}; use auto, planar, edges, convex or paper"
                f"{did_you_mean(option, names)}"
            )
        return "edges" if option == "edges" else "range"

    def _cell_choice(self, ray_count: int) -> CellChoice:
        """The FMM cells with which to trace `ray_count` rays. Circles alone have no cells."""
        return self.cell_choice(ray_count) if self._net_loops else NO_CELLS

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> CurveEvaluator:
        cells = self._cell_choice(plan.ray_count)
        return self._evaluator_of(self._upload(backend, traced=True, cells=cells))

    def evaluate(self, p: Vec3) -> Sample:
        """A sample of f at points p, from all edges."""
        return self._evaluator_of(self._point_data(backend_of(p))).evaluate(p)

    def _evaluator_of(self, data: _CurveData) -> CurveEvaluator:
        """The evaluator that samples f by these data of the curve on a backend."""
        # If vertices can move one by one, all edges are summed: after a move they may not cancel.
        return CurveEvaluator(self, data, self._differentiable_loops or self._net_loops)

    def _point_data(self, backend: Backend) -> _CurveData:
        """The curve on a backend for values at points, which come from all edges."""
        return self._upload(backend, traced=False, cells=NO_CELLS)

    @cached_upload
    def _upload(self, backend: Backend, *, traced: bool, cells: CellChoice) -> _CurveData:
        """Copy the curve to a backend, in unit coordinates: its center at 0, its radius 1.

        traced: whether the data are for tracing rays, and not for values at points, which may be of
            smaller curves.
        cells: the FMM cells of the curve.

        Raises ValueError if coordinates are so large that they could overflow in the backend's
        precision.
        """
        # Centered and scaled to unit size: products of eight lengths stay far from overflow. The
        # backend's precision holds the center exactly, so that subtracting it near the curve is
        # exact.
        dtype = np.float64 if backend.precision == "double" else np.float32
        box = self._center - self._size, self._center + self._size
        if traced:
            check_length_range(box, backend.precision, "the curve has")
        elif (size := float(np.abs(box).max())) > 0.1 * float(np.finfo(dtype).max):
            raise ValueError(
                f"coordinates up to {size:g} are too large for {backend.precision} precision: "
                "choose units nearer to 1"
            )
        center = self._center.astype(dtype).astype(np.float64)
        unit_loops = tuple((loop - center) / self._size for loop in self._net_loops)
        edges = LoopEdges.upload(backend, unit_loops) if unit_loops else None
        circles = None
        if self._net_circles:
            circles = CircleSet.upload(backend, self._net_circles, center, self._size)
        plane = None
        if self._region is not None:
            # The plane n.x = offset in unit coordinates.
            height = (self._region.offset - float(self._region.normal @ center)) / self._size
            numbers = (*self._region.normal.tolist(), height)
            plane = tuple(dr.opaque(backend.Float, number) for number in numbers)
        # The largest coordinate in units of the curve's size: by it positions are rounded.
        magnitude = float(np.abs(self._points_around()).max() / self._size)
        record_count = (
            0
            if edges is None
            else sum(-(-len(loop) // edges.edges_per_record) for loop in unit_loops)
        )
        # For circles alone: the last operations, as in `LoopEdges.rounding`.
        value_rounding = (
            16 * backend.machine_epsilon if edges is None else edges.rounding(record_count)
        )
        curve_cells = None
        if cells:
            low, high = self._box(center)
            curve_cells = build_curve_cells(backend, unit_loops, low, high, cells.max_bytes)
        # The number of roundings of a position: `_CurveData.rounding` lists them.
        return _CurveData(
            *frame_parameters(backend, center, self._size),
            edges,
            circles,
            plane,
            dr.opaque(backend.Float, backend.machine_epsilon * (6 + 2 * magnitude)),
            dr.opaque(backend.Float, value_rounding),
            self._region,
            len(self._net_circles),
            curve_cells,
            cells,
        )

    def _box(self, center: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper corner (3,) of a box that contains the curve and the
        surface of the default level, in unit coordinates. FMM cells are built in this box.

        center: (3,) the origin of the unit coordinates, in user coordinates.
        """
        volume = self.extent((self.default_level,))
        corners = [] if volume is None else [np.stack(volume.bounds())]
        points = np.concatenate([*self._net_loops, *corners]) - center
        return points.min(axis=0) / self._size, points.max(axis=0) / self._size

    @property
    def _without_cells(self) -> SolidAngle:
        """The same field without FMM cells; this field itself if it has none."""
        return self._copy_without_cells if self.cell_choice() else self

    @functools.cached_property
    def _copy_without_cells(self) -> SolidAngle:
        """The same field without FMM cells, as another field."""
        return SolidAngle([*self.loops, *self.circles], lift_bound=self.lift_bound_option)

    def _evaluate_points(
        self, points: Any, precision: Precision | None, choose: Callable[[Sample], Any]
    ) -> npt.NDArray[Any]:
        """Evaluate the field at points (n, 3), and return what the function `choose` takes from
        each sample, such as its value. A field with FMM cells uses the same field without cells,
        because values at points are sums over all edges. (Not if a user's class has an `evaluate`
        of its own.)"""
        if self.cell_choice() and type(self).evaluate is SolidAngle.evaluate:
            return self._without_cells._evaluate_points(points, precision, choose)
        return super()._evaluate_points(points, precision, choose)

    def _closest_on_curve(self, p: Vec3) -> Vec3:
        """The point of the curve that is closest to p, in user coordinates. Edges that cancel each
        other do not count (`remaining_edges`)."""
        data = self._point_data(backend_of(p))
        x = data.to_unit(p)
        # The closest point so far, in unit coordinates, and its squared distance.
        nearest, square = data.backend.Array3f(0), data.backend.Float(dr.inf)
        if self._net_loops:
            center = to_numpy(data.center).reshape(3).astype(np.float64)
            start, end = ((q - center) / self._size for q in remaining_edges(self._net_loops))
            nearest = closest_on_segments(segment_records(data.backend, start, end), x)
            square = dr.squared_norm(x - nearest)
        if data.circles is not None:
            circle_point, circle_square = data.circles.closest(x)
            nearest = dr.select(circle_square < square, circle_point, nearest)
        return nearest * data.size + data.center

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name. `loops` has the polygons first, those that are
        Dr.Jit arrays as they were given, and then the circles."""
        loops = (*(self._differentiable_loops or self._loops), *self.circles)
        return {**super().constructor_arguments(), "loops": loops}

    def _continuous_change(self, p: FloatArray, q: FloatArray) -> FloatArray:
        """The change (n,) of the solid angle along the segments from points p (n, 3) to q (n, 3),
        followed continuously, so that it may exceed 4 pi. It is for curves without circles."""
        backend = choose_backend("double")
        data = self._upload(backend, traced=True, cells=NO_CELLS)
        if data.edges is None:
            return np.zeros(len(p))
        edges = data.edges

        def changes(start: Vec3, end: Vec3) -> tuple[Real]:
            """The change of the solid angle along the segments from `start` to `end`, which are in
            user coordinates; in a tuple of one entry."""
            return (continuous_change(edges, data.to_unit(start), data.to_unit(end)),)

        return map_batches(backend, changes, p, q)[0]

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level that is a multiple of 4 pi, if all edges of the curve cancel
        each other. Then f is 0 everywhere, so that such a level would be all of space."""
        for level in levels:
            if self._all_cancel and abs(math.remainder(float(level), _PERIOD)) < _LEVEL_MARGIN:
                raise ValueError(
                    f"level {level:g}: all edges of this curve cancel each other, so that its "
                    "solid angle is 0 everywhere modulo 4 pi, and no surface is where it takes "
                    "that value: check the loops' orientations"
                )

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that is proved to contain the level sets; None if a level is a multiple of 4 pi,
        whose level set is unbounded.

        The 2 pi level of a curve in convex position lies in its convex hull (paper, Theorem B.1).
        For any curves of total length L, let x be at the distance rho from all of them. Seen from
        x, loop i of length L_i has an angular length t_i of at most L_i/rho. A closed spherical
        curve of length t < 2 pi, cut into simple loops, bounds |area| <= 2 pi - sqrt(4 pi^2 - t^2)
        =: phi(t), by isoperimetry on the sphere. phi is convex with phi(0) = 0, so the areas of all
        loops add up to at most phi of the sum of the t_i. So |f| < l wherever L/rho < sqrt(l (4 pi
        - l)). It follows that a level at distance l from the multiples of 4 pi lies within rho =
        L/sqrt(l (4 pi - l)) of the curves. Cells of the box with this margin that are proved to
        contain no level are then cut away (`tight_extent`).
        """
        return self._extents.get_or_make(levels, lambda: self._extent(levels))

    def _extent(self, levels: tuple[float, ...]) -> Volume | None:
        """Compute the volume that `extent` returns and caches; None if a level is a multiple of 4
        pi.

        Curves in convex position whose levels are all at 2 pi (modulo 4 pi) get their convex hull,
        padded by 1e-4 of their size. Otherwise the volume is the box of the proof in `extent`, from
        which empty cells are cut away. If all edges cancel each other, there is no surface, and the
        volume is the hull of the points.
        """
        points = self._points_around()
        # The distances l of the levels from the multiples of 4 pi.
        gaps = [abs(math.remainder(float(level), _PERIOD)) for level in levels]
        nearest = min(gaps)
        if nearest < _LEVEL_MARGIN:
            return None
        if self._all_cancel:
            return ConvexHull.from_points(points)  # there is no surface: any volume is right
        # Curves whose vertices may move share kernels: their extent is always computed the same
        # way. No number is farther than 2 pi from all multiples of 4 pi: if `nearest` is 2 pi, all
        # levels are 2 pi modulo 4 pi.
        is_in_hull = self.convex_position and nearest > 2 * math.pi * (1 - 1e-9)
        if is_in_hull and not self._differentiable_loops:
            hull = ConvexHull.from_points(points).padded(1e-4 * self._size)
            return hull.with_planes(_MAX_PLANES) if self._cell_choice(0) else hull
        length = sum(circle.length for circle in self._net_circles)
        length += total_length(self._net_loops) if self._net_loops else 0.0
        # The bound rho of `extent`, a little larger for rounding.
        margin = 1.0001 * length / math.sqrt(nearest * (_PERIOD - nearest))
        lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
        loops = [*self._net_loops, *self._net_circles]
        # The range of "paper" is no proof: then the field of the default bound proves cells empty.
        proved = self._without_cells if self.lift_bound_option != "paper" else SolidAngle(loops)
        # A circle counts as three vertices. At least eight cells are allowed: the octants of the
        # box.
        vertices = sum(map(len, self._net_loops)) + 3 * len(self._net_circles)
        return tight_extent(proved, levels, lower, upper, max(8, _MAX_PAIRS // vertices))

    def cells_pay_from(self) -> float:
        """The smallest number of rays for which FMM cells save more time than it takes to build
        them. It is infinite if they never do, or if there can be no cells."""
        edges = sum(map(len, self._net_loops))
        is_fixed = not self._differentiable_loops and self.lift_bound_option != "paper"
        never_pays = not is_fixed or edges < _MIN_EDGES
        return math.inf if never_pays else max(_MIN_RAYS, _MIN_WORK / edges)

    def describe(self) -> dict[str, Any]:
        """Facts about the field for users, as a dictionary of names and values: the numbers of
        loops, vertices and removed edges, the chosen `lift_bound`, and the FMM cells."""
        return {
            "loops": len(self.loops) + len(self.circles),
            **({"circles": len(self.circles)} if self.circles else {}),
            "vertices": sum(len(loop) for loop in self.loops),
            "canceled edges": sum(map(len, self.loops)) - sum(map(len, self._net_loops)),
            "convex position": self.convex_position,
            "lift_bound": self.lift_bound,
            **self.describe_cell_option(),
        }


class CurveEvaluator(Evaluator):
    """The evaluator of a `SolidAngle`.

    field: the field.
    data: the curve on the backend.
    loops: the polygons of which derivatives by vertices are computed.
    detail: the accuracy scale of samples; larger is more accurate. At scales up to 1 samples come
        from FMM cells, if there are any, and at larger ones from all edges.
    """

    def __init__(
        self, field: SolidAngle, data: _CurveData, loops: tuple[Any, ...], detail: Real = 1.0
    ) -> None:
        self.field, self.data, self.loops, self.detail = field, data, loops, detail
        if data.cells is not None:
            at = functools.partial(CurveEvaluator, field, data, loops)
            self.variable_accuracy = VariableAccuracy(at)

    def evaluate(self, p: Vec3) -> Sample:
        """A sample of f at points p in user coordinates: value, gradient, error bounds and proved
        bounds of f near p."""
        return self._sample(p, None)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """A sample of f at the ray parameter t, with proved bounds of how f changes along the ray
        in front of that point and behind it. If the ray runs along an edge of the curve, bounds for
        the line of the ray prove much longer steps than bounds for a ball around the point.

        path: the ray.
        ahead, back: the lengths of the ray in front of the point and behind it for which bounds are
            wanted. They are not used: the bounds state their own lengths.
        """
        del ahead, back
        has_line_bounds = not self.data.is_empty and self.field.lift_bound_option != "paper"
        direction = path.direction if has_line_bounds else None
        return path.enclose(self._sample(path.point(t), direction))

    def _sample(self, p: Vec3, direction: Vec3 | None) -> Sample:
        """A sample of f at points p in user coordinates: value, gradient, error bounds, and
        promises (proved bounds of f near p). At the curve itself, where f has no single value, the
        value is 0 and the gradient is so steep that p counts as close to any level.

        direction: (3,) a unit vector. The sample gets further bounds along the line through p in
            this direction; None for no such bounds.
        """
        data = self.data
        if data.is_empty:
            return self._zero_sample(p)
        x = data.to_unit(p)
        sums, errors = data.at_detail(x, self.detail)
        # errors.value and errors.slope bound the truncation errors of f and its gradient, and
        # errors.rounding the rounding of f. sums.inverse_squares, inverse_cubes and inverse_fourths
        # are the integrals of |dp|/D^2, |dp|/D^3 and |dp|/D^4 over the curve, with D the distance
        # from x.
        epsilon = data.backend.machine_epsilon
        rounding = data.rounding
        # A lower bound of the distance to the curve, also after rounding.
        distance = sums.distance * (1 - SUM_MARGIN) - rounding
        promises = remainder_promises(sums.inverse_cubes, sums.inverse_fourths, distance)
        value_rounding = errors.rounding + vertex_rounding(epsilon, x, sums.inverse_squares)
        if self.field.lift_bound == "edges":
            ball = lift_ball(
                sums.angle, sums.gradient, sums.inverse_squares, promises, errors.slope
            )
        elif self.field.lift_bound == "planar":
            ball = self._planar_ball(x, sums, distance, errors)
        else:
            ball = _convex_ball(sums.angle, distance, errors.value + value_rounding)
        # At the curve itself, up to rounding, f has all values (`remaining_edges`) and no gradient:
        # the sample has a gradient so steep that the point counts as close to any level. Anywhere
        # else NaN stays NaN, and the tracer accepts no such point.
        is_on_curve = sums.distance <= 2 * rounding
        steep_gradient = data.backend.Array3f(0, 0, 4 * _PERIOD / rounding)
        gradient = dr.select(is_on_curve, steep_gradient, sums.gradient)
        gradient_error = errors.slope
        truncation = dr.select(is_on_curve, 0, errors.value)
        error = truncation + dr.select(is_on_curve, errors.rounding, value_rounding)
        if errors.circles is not None:
            circles = errors.circles
            # Measured errors: 15 units in the last place of a circle's angle, and 60 of its
            # gradient near the circle (10 elsewhere). Its position is rounded by a few units too.
            point_error = epsilon * (4 + 4 * dr.max(dr.abs(x)))
            # `value` is the bound for the angle.
            value = 16 * epsilon * data.circle_count + point_error * circles.inverse_squares
            error = error + dr.select(is_on_curve, 0, value)
            circle_gradient_error = (
                32 * epsilon * circles.inverse_squares + 1.5 * point_error * circles.inverse_cubes
            )
            gradient_error = gradient_error + circle_gradient_error
        gradient_error = dr.select(is_on_curve, 0, gradient_error)
        error = dr.select(is_on_curve, 8 * _PERIOD, error)  # the steep gradient times 2 rounding
        ray_promises = _line_bounds(data, x, sums, errors, direction)
        # "paper" promises nothing but the range on the ball.
        if self.field.lift_bound_option == "paper":
            promises = (ball,)
        value = dr.select(is_on_curve, 0, sums.angle)
        # All of this is in unit coordinates; `space_scaled` converts it to user coordinates.
        sample = Sample(
            value,
            gradient,
            promises,
            error,
            gradient_error,
            truncation_error=truncation,
            alternative_promises=(ball,),
            ray_promises=ray_promises,
        )
        return space_scaled(sample, data.size)

    def _planar_ball(
        self, x: Vec3, sums: CurveSums, distance: Real, errors: CellErrors
    ) -> HarmonicBall:
        """A ball around each point x that meets no curve, and a range of the lift of f on it, for
        `lift_bound="planar"`. The range comes from the region of a plane that the curve bounds, or
        from the circles if there are only circles.

        x: the points, in unit coordinates.
        sums, errors: the sums over edges and circles at x, and their error bounds.
        distance: a lower bound of the distance from x to the curve, in unit coordinates.
        """
        data = self.data
        if data.region is None:
            assert errors.circles is not None
            return HarmonicBall(distance, errors.circles.lower, errors.circles.upper)
        height_rounding = data.rounding + data.backend.machine_epsilon * 4 * dr.max(dr.abs(x))
        return data.region.lift_range(
            sums.angle, data.height(x), distance, height_rounding, errors.value
        )

    def _zero_sample(self, p: Vec3) -> Sample:
        """The sample of the constant 0 at points p, for curves whose edges all cancel each other.
        It promises a range of f on a ball much larger than the curve. The range has a positive
        width, because formulas divide by the width. It contains no level, because levels that are
        multiples of 4 pi are refused (`validate_levels`)."""
        data = self.data
        x = data.to_unit(p)
        radius = 1e6 * (1 + dr.norm(x)) * data.size
        zero = dr.zeros(data.backend.Float, dr.width(p))
        ball = HarmonicBall(radius, zero - _LEVEL_MARGIN, zero + _LEVEL_MARGIN)
        return Sample(zero, data.backend.Array3f(zero), (ball,))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The Hessian of f at points p, as three vectors: its rows. Its trace is 0 up to rounding.
        Its entries grow without limit towards the curve."""
        data = self.data
        if data.is_empty:
            zero = dr.zeros(data.backend.Array3f, dr.width(p))
            return zero, zero, zero
        x, scale = data.to_unit(p), 1 / (data.size * data.size)
        # Second derivatives in unit coordinates; `scale` converts them to user coordinates.
        rows = data.backend.Array3f(0), data.backend.Array3f(0), data.backend.Array3f(0)
        if data.edges is not None:
            rows = hessian_over_edges(data.edges, x)
        if data.circles is not None:
            circle_rows = data.circles.hessian(x).rows(data.backend.Array3f)
            rows = tuple(
                edge_row + circle_row
                for edge_row, circle_row in zip(rows, circle_rows, strict=True)
            )
        first, second, third = (row * scale for row in rows)
        return first, second, third

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two proved bounds of rounding errors at points p: of the length of the gradient's error,
        and of the error of each second derivative. The errors come from the rounding of positions.
        The bounds are those of sums over boundary edges (`source_sums.SLOPE_ROUNDINGS`), with
        distances reduced by their rounding. They are infinite at the curve.

        sample: not used; the sums are computed again.
        """
        del sample
        data = self.data
        if data.is_empty:
            return 0.0, 0.0
        x = data.to_unit(p)
        (sums, _), unit = data.sums(x), coordinate_rounding(x)
        distance = sums.distance - 4 * unit
        # The second condition is that of `_sample`.
        is_off_curve = (distance > 0) & (sums.distance > 2 * data.rounding)
        # By this factor |dp|/D^4 can grow if the distance D is reduced by its rounding.
        growth = dr.select(is_off_curve, dr.square(dr.square(sums.distance / distance)), dr.inf)
        # With the integrals I3 (`inverse_cubes`) and I4 of |dp|/D^3 and |dp|/D^4 the sums of
        # `source_sums` are s4 = I3/4 and s5 = 3 I4/16 (`LiftedEdge.bounds`), and I4 <= I3/distance.
        # The factors 1/3 and 1/4 in their places are a little larger.
        gradient_error = SLOPE_ROUNDINGS / 3 * unit * sums.inverse_cubes * growth / data.size
        second_error = 0.25 * SECOND_ROUNDINGS * unit * sums.inverse_cubes / sums.distance * growth
        return gradient_error, second_error / (data.size * data.size)

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A proved bound of |grad f(q) - grad f(p)| for all points q within the distance `radius`
        of p (`curve_queries.gradient_change_bound`). It includes the rounding of positions."""
        data = self.data
        if data.is_empty:
            return 0 * p.x  # f is constant: 0 on each lane
        x, unit_radius = data.to_unit(p), radius / data.size + data.rounding
        # inverse_cubes, inverse_fourths: the integrals of |dp|/D^3 and |dp|/D^4 over the curve.
        sums, _ = data.sums(x)
        distance = sums.distance * (1 - SUM_MARGIN) - data.rounding
        return (
            gradient_change_bound(sums.inverse_cubes, sums.inverse_fourths, distance, unit_radius)
            / data.size
        )

    def differentiable_value(self, p: Vec3) -> Real:
        """f at points p, modulo 4 pi, as an expression that Dr.Jit can differentiate by p and by
        the vertices of loops."""
        data = self.data
        angle = dr.zeros(data.backend.Float, dr.width(p))
        if self.loops:
            angle = MovingEdges.of_loops(data, self.loops).angle(p)
        if data.circles is None:
            return angle
        # The part of the circles, to first order in p: reverse mode cannot pass a recorded loop.
        # Its value is right, as q has the coordinates of p.
        with dr.suspend_grad():
            q = dr.detach(p)
            sums = data.circles.sums(data.to_unit(q))
        return angle + sums.angle + dr.dot(sums.gradient / data.size, p - q)

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        """The gradient of f at points p, as an expression that Dr.Jit can differentiate by p and by
        the vertices of loops."""
        data = self.data
        if not any(map(dr.grad_enabled, self.loops)):
            return super().differentiable_gradient(p)
        gradient = MovingEdges.of_loops(data, self.loops).gradient(p)
        if data.circles is None:
            return gradient
        # The part of the circles, to first order in p, by their second derivatives.
        with dr.suspend_grad():
            q = dr.detach(p)
            x, vector = data.to_unit(q), data.backend.Array3f
            own = data.circles.sums(x).gradient / data.size
            rows = data.circles.hessian(x).rows(vector)
        moved = (p - q) / (data.size * data.size)
        return gradient + own + vector(*(dr.dot(row, moved) for row in rows))

    def describe(self) -> dict[str, Any]:
        """The facts of `SolidAngle.describe`, with the number and the memory of the FMM cells that
        were built."""
        return self.field.describe() | self.data.cell_choice.describe(self.data.cells)


@dataclass(frozen=True)
class _CurveData(UnitFrame):
    """A closed curve (all loops and circles of a `SolidAngle`) on a backend, in unit coordinates:
    its center at 0, its radius 1.

    edges, circles: the edges of its polygons and its circles; None if there are none.
    plane: the normal (x, y, z) and the offset of the plane in which the curve bounds a
        `PlanarRegion`; None if there is no such region.
    rounding: a bound of the rounding of a point's position. Near the curve p - center is exact,
        division and the curve's own coordinates have a few roundings of size 1, and p itself was
        rounded once, at the curve's distance from 0.
    value_rounding: a bound of the rounding of the solid angle, which depends on the number of edges
        (`LoopEdges.rounding`).
    region: that region; None if there is none.
    circle_count: the number of circles.
    cells: the FMM cells, each with its near edges and a polynomial for all other edges; None for no
        cells.
    cell_choice: the cells that the curve was to have.
    """

    edges: LoopEdges | None
    circles: CircleSet | None
    plane: tuple[Real, ...] | None
    rounding: Real
    value_rounding: Real
    region: PlanarRegion | None
    circle_count: int
    cells: CurveCells | None
    cell_choice: CellChoice

    @property
    def is_empty(self) -> bool:
        """Whether all edges and circles cancel each other, so that f is 0 everywhere."""
        return self.edges is None and self.circles is None

    def at_detail(self, x: Vec3, detail: Real) -> tuple[CurveSums, CellErrors]:
        """Return the sums over all edges and circles at points x in unit coordinates, and bounds of
        the errors of these sums. On lanes on which x is in an FMM cell and the accuracy scale
        `detail` is at most 1, the sums over edges come from that cell. On all other lanes, and if
        there are no cells, all edges are summed. A larger accuracy scale is more accurate."""
        edge_sums = None
        # No truncation errors where all edges are summed.
        errors = CellErrors(0.0, 0.0, self.value_rounding)
        if self.cells is not None and self.edges is not None:
            cell_sums, is_in_cell = self.cells.sums(x, detail <= 1)
            edge_sums = sum_over_edges(self.edges, x, ~is_in_cell)
            edge_sums = edge_sums.select(is_in_cell, cell_sums.sums)
            errors = CellErrors(
                dr.select(is_in_cell, cell_sums.error, 0),
                dr.select(is_in_cell, cell_sums.slope_error, 0),
                dr.select(is_in_cell, cell_sums.rounding, self.value_rounding),
                cell_sums,
                is_in_cell,
            )
        sums, circles = self.sums(x, edge_sums)
        return sums, dataclasses.replace(errors, circles=circles)

    def edge_rates(
        self, sum_errors: CellErrors, line: RayLine, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """For each length T, a proved bound of |df/ds| along the line x + s v at all |s| <= T,
        where f is the solid angle of the edges without the circles. On lanes whose sums at x come
        from an FMM cell, the bound is computed from that cell (`CurveCells.rates_along`); on all
        other lanes, from all edges (`trail_sums.line_rates`).

        sum_errors: the error bounds of the sums at x, as `at_detail` returned them. They also say
            on which lanes the sums come from a cell, and from which one.
        line: the lines, with their points x and directions v.
        lengths: the lengths T, in unit coordinates.
        active: mask of the lanes on which bounds are wanted. On other lanes they are infinite.

        Returns a tuple with one bound for each length.
        """
        assert self.edges is not None
        if self.cells is None or sum_errors.cell is None:
            return line_rates(self.edges, line, lengths, active)
        is_in_cell = sum_errors.in_cells
        outside_rates = line_rates(self.edges, line, lengths, active & ~is_in_cell)
        cell_rates = self.cells.rates_along(sum_errors.cell, line, lengths, active & is_in_cell)
        # Each of the two is infinite on the lanes of the other one, so that the minimum takes the
        # one that was computed.
        return tuple(
            fmin(cell_rate, edge_rate)
            for cell_rate, edge_rate in zip(cell_rates, outside_rates, strict=True)
        )

    def height(self, x: Vec3) -> Real:
        """The signed distance of points x from the plane in which the curve bounds a
        `PlanarRegion`, positive on the side of the plane's normal. All is in unit coordinates.
        There must be such a region."""
        assert self.plane is not None
        return dr.dot(self.backend.Array3f(*self.plane[:3]), x) - self.plane[3]

    def sums(
        self, x: Vec3, edge_sums: CurveSums | None = None
    ) -> tuple[CurveSums, CircleSums | None]:
        """The sums over all edges and circles at points x in unit coordinates; and the sums over
        the circles only, or None if there are none.

        edge_sums: the sums over the edges; None to sum over all edges, without FMM cells.
        """
        if edge_sums is None and self.edges is not None:
            edge_sums = sum_over_edges(self.edges, x)
        circles = None if self.circles is None else self.circles.sums(x)
        # A curve that is not empty has edges or circles.
        first, *rest = (sums for sums in (edge_sums, circles) if sums is not None)
        return functools.reduce(CurveSums.plus, rest, first), circles


@dataclass(frozen=True)
class CellErrors:
    """Error bounds of the sums over a curve at points x, and where the sums come from: on some
    lanes from FMM cells, in which far edges are approximated by a polynomial; on the other lanes
    from all edges.

    value, slope: bounds of the truncation errors of the solid angle and of its gradient. They are 0
        on lanes on which all edges are summed.
    rounding: a bound of the rounding of the solid angle.
    cell: the sums that the cells gave; None without cells.
    in_cells: the mask of the lanes on which the sums of the cells were used; False without cells.
    circles: the sums over circles only, which have errors of their own; None if there are none.
    """

    value: Real
    slope: Real
    rounding: Real
    cell: CurveCellSums | None = None
    in_cells: Mask = False
    circles: CircleSums | None = None


def _convex_ball(angle: Real, distance: Real, error: Real) -> HarmonicBall:
    """A ball around each point, and a range of the lift of f on it, for a curve in convex position
    (on the boundary of its convex hull). If f at the center is the principal value, in (-2 pi, 2
    pi), the lift stays in (-6 pi, 6 pi) on the ball.

    angle: f at the center. It may differ from the principal value by a multiple of 4 pi, by which
        the range is moved, too.
    distance: the radius of the ball, at most the distance to the curve.
    error: a bound of the error of `angle`. If the true value may be beyond -2 pi or 2 pi, there are
        two possible principal values, and the range contains the ranges of both.
    """
    principal = angle - _PERIOD * dr.round(angle / _PERIOD)
    branch = angle - principal
    # If rounding may have put the value on the wrong side of +-2 pi, its principal value may be one
    # period away, and the range grows by a period to that side.
    possible_shift = dr.select(dr.abs(principal) > 0.5 * _PERIOD - error, _PERIOD, 0)
    shift_below, shift_above = (
        dr.select(principal < 0, possible_shift, 0),
        dr.select(principal > 0, possible_shift, 0),
    )
    # 1.5 periods are 6 pi.
    return HarmonicBall(
        distance, branch - 1.5 * _PERIOD - shift_below, branch + 1.5 * _PERIOD + shift_above
    )


def _line_bounds(
    data: _CurveData, x: Vec3, sums: CurveSums, errors: CellErrors, direction: Vec3 | None
) -> tuple[Lipschitz, ...]:
    """Proved bounds of how fast f changes along a line through each point x. For each of several
    lengths s there is a Lipschitz constant of f on the part of the line within s of x.

    data: the curve on a backend. All lengths are in its unit coordinates.
    x: the points.
    sums, errors: the sums over edges and circles at x, and their error bounds.
    direction: (3,) the unit direction of the line. If it is None, the result is an empty tuple.
    """
    if direction is None:
        return ()
    line = RayLine(x, data.backend.Array3f(direction), data.rounding)

    def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
        """For each length T in `lengths`, a bound of |df/ds| at the points x + s v of the line with
        |s| <= T, summed over the edges and circles of the curve `data`. Returns one bound for each
        length. It is infinite on lanes that are not active."""
        summands: list[tuple[Real, ...]] = []
        if data.edges is not None:
            summands.append(data.edge_rates(errors, line, lengths, active))
        if data.circles is not None:
            summands.append(data.circles.line_rates(line, lengths, active))
        return tuple(sum(terms) for terms in zip(*summands, strict=True))

    return lipschitz_along(line, sums.gradient, sums.distance, rates)


def _read_only(loop: FloatArray) -> FloatArray:
    """A view of the array `loop` that cannot be written to."""
    view = loop.view()
    view.flags.writeable = False
    return view


def _movable_loops(loops: Any) -> tuple[Any, tuple[Any, ...]]:
    """Convert the argument `loops` of `SolidAngle` into two forms.

    Returns the curves with NumPy arrays in place of Dr.Jit arrays, as `validate_curves` takes them;
    and a tuple for derivatives by vertices. If any loop is a Dr.Jit array, this tuple has all loops
    except circles, with tensors converted to 3-vectors. If none is, it is empty, and the curves are
    returned as they were given.
    """
    is_list = isinstance(loops, list | tuple)
    parts: list[Any] = [*loops] if is_list else [loops]
    if not any(map(_is_drjit, parts)):
        return loops, ()
    parts = [
        tensor_to_vectors(loop, "a loop", CurveError) if is_tensor(loop) else loop for loop in parts
    ]
    curves = [to_numpy(loop) if _is_drjit(loop) else loop for loop in parts]
    movable = tuple(loop for loop in parts if not isinstance(loop, Circle))
    return curves if is_list else curves[0], movable


def _is_drjit(value: Any) -> bool:
    """Whether a value is a Dr.Jit array."""
    return dr.is_array_v(type(value))
