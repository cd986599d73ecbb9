"""The winding number w of a mesh by a tree over its triangles: clusters of far triangles are
replaced by multipole moments, and near triangles are summed exactly. By Stokes' theorem the field
of near triangles is that of the boundary of their union. So only their *open* edges are summed, at
which near triangles do not cancel. An edge is *singular* if the triangles of the whole mesh do not
cancel at it. A near triangle is given by its record, the row of numbers that describes it in the
tree. A node of the tree is *far* from a point if its distance is more than a certain multiple of
its radius; triangles in no far node are *near*. A *lane* is one entry of Dr.Jit's arrays, such as a
point or a ray.

The method is that of Barill et al. 2018 ("Fast winding numbers for soups and clouds") with orders 0
to 2, gradients and Hessians from the same moments, a bound of the truncation error, and proved
bounds of w near a point.

`edge_lift` explains how crossings of a ray and edges together give the winding number. Both are
decided by the same bits, so that an edge that two triangles share contributes no rounding error.

FMM cells (fast multipole method). If triangles have hardly an edge in common (a soup), cells of
edges would have three near edges for each triangle. So soups have the same cells as clouds. Near
triangles are added as in the leaves of the tree, and far triangles are sheets of dipoles with two
more moments. So a sample in a cell gives all of w, including its integer. These cells are built in
a quarter of the time of cells of edges. Soups of few triangles, each as large as the whole soup,
have cells of edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax
from harnack.fmm.dipole_cells import DipoleCells, TreeWithCells, build_cells
from harnack.fmm.dipole_expansion import triangle_sources
from harnack.fmm.edge_lift import LiftedEdge, LiftedProduct
from harnack.fmm.source_sums import SourceSums, final_rounding
from harnack.fmm.trail_sums import RayLine, add_edge_rates, lipschitz_along
from harnack.fmm.treecode import Treecode
from harnack.fmm.unit_frame import coordinate_rounding
from harnack.tree.triangle_tree import (
    INVERSE_SQUARES_COLUMN,
    NUMBER_COLUMN,
    PARITY_COLUMN,
    RayFrame,
    VerticalRayFrame,
    corners_of,
    records_in_slots,
    signed_crossing,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.capabilities import JumpCrossing
    from harnack.fields.field import Sample
    from harnack.fields.solid_angles.winding_mesh import WindingMesh
    from harnack.fmm.point_values import PointValues
    from harnack.fmm.trail_sums import Rates
    from harnack.fmm.treecode import AddPrimitive

# The first of three columns that a record has after the columns of `tree.triangle_tree`. They hold
# for each edge 1 if it is singular, else 0.
SINGULAR = INVERSE_SQUARES_COLUMN + 3
# For each edge of a triangle, the two corners that it joins, and 1 if it runs in the triangle's
# direction, else -1.
_EDGES = ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0))


@dataclass(frozen=True)
class NearEdge:
    """An edge of a near triangle, that is, of a triangle that is in no far node of the tree as seen
    from the point x.

    edge: the edge relative to x.
    is_singular: whether the triangles of the whole mesh do not cancel at this edge.
    """

    edge: LiftedEdge
    is_singular: Mask

    def is_open(self, reach: Real) -> Mask:
        """Mask of the lanes on which the edge may be part of the boundary of the near triangles, so
        that it must be summed. Edges of length 0, which stand in empty slots, are not open.

        reach: a node of the tree is far if its distance from x is more than `reach` times its
            radius.

        The edge is not part of the boundary if it is not singular, and is nearer to x than (reach -
        1)/2 times its length L. Proof: a far node that has a triangle at this edge has a radius R
        >= L/2 and is farther than reach R, and so the edge is farther than (reach - 1) R. Hence all
        triangles at a nearer edge are near, and cancel there.

        If x is in an FMM cell, far triangles are summed by the cell's polynomial, and `reach` is
        `TRIANGLE_RATIO`. The polynomial holds in a ball around the cell, and a triangle is far if
        it is farther from the ball's center than k > 1 radii of the ball plus `reach` times the
        triangle's size (`dipole_expansion`). As x is in the ball, the triangle is farther from x
        than `reach` times its size, and the same proof holds. Far nodes are even farther.
        """
        square, inverse = self.edge.edge.squared_distance, self.edge.edge.inverse_square_length
        # self.edge.edge has the positions of the ends relative to x. square * inverse is
        # (distance/L)^2.
        is_closed = ~self.is_singular & (square * inverse < dr.square(0.5 * (reach - 1)))
        return (inverse > 0) & ~is_closed


def edges_of(row: list[Real], x: Vec3, frame: RayFrame | VerticalRayFrame) -> Iterator[NearEdge]:
    """Yield the three edges of a triangle, each relative to points x. The record of an empty slot
    of a leaf gives edges of length 0.

    row: the triangle's record.
    frame: the rays from x whose crossings with triangles are counted; the solid angles of edges
        refer to their direction.
    """
    ends = corners_of(row, cast("Any", type(x)))
    for k, (i, j, sign) in enumerate(_EDGES):
        # sign: -1 for the edge that a triangle runs from j to i. Empty slots have the number -1;
        # for them 0 marks an edge of length 0.
        inverse = dr.select(row[NUMBER_COLUMN] >= 0, row[INVERSE_SQUARES_COLUMN + k], 0)
        edge = LiftedEdge.between(ends[i], ends[j], sign * row[PARITY_COLUMN], inverse, frame, x)
        yield NearEdge(edge, row[SINGULAR + k] > 0)


# A function of a triangle's record and the parameter t of a crossing with it: whether the crossing
# is ahead.
IsAhead: TypeAlias = "Callable[[list[Real], Real], Mask]"

# One over the solid angle of all directions.
_PER_SPHERE = 1 / (4 * math.pi)


class TreeWinding(TreeWithCells):
    """The winding number w of a mesh on a backend, evaluated by a tree over its triangles, in units
    in which the mesh has a size of about one. The accuracy scale of a sample is a factor: the
    larger it is, the more accurate the sample.
    """

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, accuracy: float, order: int,
    ) -> TreeWinding:  # fmt: skip
        """Upload a mesh to a backend, without FMM cells.

        accuracy: the moments of a node are used beyond this many times its radius.
        order: the order of the multipoles: 0, 1 or 2.
        """
        # The flags are the columns that begin at `SINGULAR`.
        records = np.concatenate([mesh.records, mesh.singular_flags], axis=1)
        slots = records_in_slots(mesh.tree, records)
        rounding = final_rounding(backend)
        levels = list(mesh.levels)
        clusters = Treecode.of(backend, mesh.tree, levels, slots, accuracy, order)
        return cls(clusters, rounding)

    def build_cells(self, mesh: WindingMesh, half: float, most_bytes: int) -> DipoleCells | None:
        """Build FMM cells in the cube [-half, half]^3 in unit coordinates (`dipole_cells`). None if
        they would need more than `most_bytes` bytes.

        mesh: the mesh from which this object was made.
        """
        sources, triangles = (
            mesh.tree.values_in_slots(triangle_sources(mesh.corners)),
            self.clusters.tree,
        )
        return build_cells(
            self.backend, mesh.tree, list(mesh.levels), sources, triangles.primitives, half,
            most_bytes,
        )  # fmt: skip

    @property
    def has_detail(self) -> bool:
        """Whether samples at small accuracy scales take less time. It is true for a tree."""
        return True

    def values(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """The winding number w and its derivatives up to order `derivatives` at points x (3, n),
        with error bounds. Near triangles add their crossings with the rays from x along z, and
        their open edges.

        closer: the accuracy scale; larger is more accurate. Values below 1 count as 1.
        """
        unit, detail = (
            coordinate_rounding(x),
            fmax(self.backend.Float(closer), self.backend.Float(1)),
        )

        def is_ahead(row: list[Real], t: Real) -> Mask:
            """Mask of the lanes on which a crossing at the ray parameter t is ahead of x. row: not
            used."""
            del row
            return t > 0

        sums = self._winding_sums(VerticalRayFrame(x), x, detail, unit, is_ahead, derivatives)
        return self.clusters.values(sums, _PER_SPHERE, unit, self.rounding)

    def _winding_sums(
        self,
        frame: RayFrame | VerticalRayFrame,
        x: Vec3,
        detail: Real,
        unit: Real,
        is_ahead: IsAhead,
        derivatives: int,
        active_lanes: Mask = True,
    ) -> SourceSums:
        """Sums whose value is 4 pi w: the moments of far clusters, the crossings of near triangles
        that are ahead of x on rays, and the open edges of near triangles (`NearEdge.is_open`).

        frame: the rays, with points x on them.
        detail: the accuracy scale; larger is more accurate.
        unit: the rounding of a coordinate.
        is_ahead: a function (row, t): whether a crossing at the ray parameter t with the triangle
            of the record `row` counts as ahead of x.
        derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian.
        active_lanes: the mask of the lanes on which sums are wanted.
        """
        # Angles of edges are added as the argument of a product of complex factors.
        no_factors = LiftedProduct.identity(self.backend.Float)

        def adder(reach: Real) -> AddPrimitive:
            """Make the function that adds a near triangle to sums at points x of the rays `frame`,
            where nodes are far beyond `reach` times their radius."""

            def add(
                row: list[Real], active: Mask, sums: SourceSums, state: tuple[Any, ...]
            ) -> tuple[SourceSums, tuple[Any, ...]]:
                """Add the triangle in the record `row` to the sums, on active lanes: its crossing
                with the ray of `frame`, if `is_ahead` says that it is ahead of x, and its open
                edges. state: the parts of the product of the edges' factors so far
                (`LiftedProduct`). Returns the new sums and the new state."""
                t, sign = signed_crossing(row, frame)
                # A crossing is a full turn of the product, which counts them without rounding.
                re, im, turns = state
                turns = turns + dr.select(active & is_ahead(row, t), sign, 0)
                product = LiftedProduct(re, im, turns)
                for edge in edges_of(row, x, frame):
                    is_open = active & edge.is_open(reach)
                    sums, product = edge.edge.add_to(sums, product, unit, is_open)
                return sums, product.to_state()

            return add

        start = no_factors.to_state()
        sums, product = self.sums(x, detail, adder, start, active_lanes, derivatives)
        return no_factors.with_state(product).add_angle_to(sums)

    def crossings_ahead(self, frame: RayFrame, t: Real, active: Mask) -> Real:
        """Always 0, whatever `frame` and t are. The crossings of rays with triangles need not be
        counted before sampling, because every sum over the tree contains them and gives w with its
        integer."""
        del frame, t, active
        return self.backend.Float(0)

    def sample_interval(
        self, frame: RayFrame, x: Vec3, behind: JumpCrossing, turns: Real, detail: Real,
        active: Mask = True,
    ) -> Sample:  # fmt: skip
        """A sample of w at points x of a ray interval between two crossings of triangles, on active
        lanes: value, gradient, errors, and promises (proved bounds of w near x and along the ray).

        frame: the rays.
        behind: the crossing at which the interval starts.
        turns: not used here.
        detail: the accuracy scale; larger is more accurate.

        Near triangles add their crossings ahead of x along the ray, and their open edges
        (`NearEdge.is_open`). Crossings that the tracer has passed up to the start of the interval
        count as behind x, all others as ahead. So it does not matter on which side of a triangle
        rounding puts x.

        The proved bounds near x bound the remainder of the linear Taylor polynomial of w at x. It
        has two parts. The part of far clusters is bounded in `SourceSums.sample`. The field of near
        triangles is that of their open edges, and harmonic up to the nearest of these; the part of
        an open edge is bounded in `LiftedEdge.bounds`.
        """
        del turns
        # `unit` is the rounding of a coordinate.
        index, unit = (
            self.backend.UInt32,
            fmax(coordinate_rounding(frame.o), coordinate_rounding(x)),
        )

        def is_ahead(row: list[Real], t: Real) -> Mask:
            """Whether the crossing at t with the triangle of the record `row` is after the start of
            the interval. Crossings at the same t are in the order of the triangles' numbers."""
            number = index(fmax(row[NUMBER_COLUMN], self.backend.Float(0)))
            return ~((t < behind.t) | ((t == behind.t) & (number <= behind.facet)))

        sums = self._winding_sums(frame, x, detail, unit, is_ahead, 1, active)
        # 8 * unit bounds the rounding of points of the line.
        line = RayLine(x, frame.d, 8 * unit)
        bounds_along = lipschitz_along(
            line, sums.gradient, sums.singularity_distance, self._rates(line, active)
        )
        return sums.sample(_PER_SPHERE, unit, self.rounding, along=bounds_along)

    def _rates(self, line: RayLine, active_lanes: Mask) -> Rates:
        """Make a function that computes, for each of several lengths T, a bound of the derivative
        of 4 pi w along a line, at its points within T of x = line.x. It does for meshes what
        `trail_sums.line_rates` does for curves.

        active_lanes: the mask of the lanes that may be active.
        """

        def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
            """For each length T in `lengths`, a bound of the derivative of 4 pi w along the line at
            its points within T of x. Returns one bound for each length; it is infinite on lanes
            that are not active."""
            active = active & active_lanes

            def adder(reach: Real) -> AddPrimitive:
                """Make the function that adds the open edges of a near triangle to the bounds for
                the line `line` and for each of `lengths`, where nodes are far beyond `reach` times
                their radius."""

                def add(
                    row: list[Real], active: Mask, sums: SourceSums, old: tuple[Any, ...]
                ) -> tuple[SourceSums, tuple[Any, ...]]:
                    """Add the open edges of the triangle in the record `row` to the bounds `old` of
                    the change along `line`, one for each of `lengths`, on active lanes. Returns the
                    sums over far clusters, unchanged, and the new bounds."""
                    # Of the edges only the positions relative to x are used. The rays matter only
                    # for their solid angles, so any direction does.
                    for near_edge in edges_of(row, line.x, VerticalRayFrame(line.x)):
                        is_open = active & near_edge.is_open(reach)
                        new = add_edge_rates(line, near_edge.edge.edge, lengths, old)
                        old = tuple(dr.select(is_open, a, b) for a, b in zip(new, old, strict=True))
                    return sums, old

                return add

            start = tuple(self.backend.Float(0) for _ in lengths)
            # Accuracy scale 0: the coarsest sums are enough for bounds.
            far_sums, edge_rates = self.sums(line.x, self.backend.Float(0), adder, start, active)
            # Add the bounds of the far clusters; this makes the bounds infinite on other lanes.
            # `line.slack` bounds the rounding of points of the line.
            return far_sums.add_line_rates(line.v, line.slack, lengths, edge_rates, active)

        return rates
