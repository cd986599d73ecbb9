"""Winding numbers by a tree: multipole moments of clusters of far triangles, near triangles
exactly.

Barill et al. 2018 ("Fast winding numbers for soups and clouds") with orders 0 to 2, gradients and
Hessians from the same moments, a bound of the truncation, and promises.

Near triangles. By Stokes' theorem the field of a set of triangles is that of the boundary of their
union, so only edges at which they do not cancel are summed. `edge_lift` explains how crossings and
edges together give the winding number: both are decided by the same bits, so that an edge that two
triangles share contributes no rounding error.

Soups have the same cells as clouds: if triangles have hardly an edge in common, cells of edges
would have three near edges for each triangle. Near triangles are added as in the leaves of the
tree, and far triangles are sheets of dipoles with two more moments, so that a sample in a cell
gives all of w, including its integer. These cells are built in a quarter of the time of cells of
edges. Soups of few triangles, each as large as the whole soup, have cells of edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax
from harnack.fields.clearance import coordinate_rounding
from harnack.fields.solid_angles.dipole_cells import DipoleCells, build_cells
from harnack.fields.solid_angles.dipole_expansion import TRIANGLE_RATIO, triangle_sources
from harnack.fields.solid_angles.edge_lift import LiftedEdge, LiftedProduct, LiftedSums
from harnack.fields.solid_angles.trail_sums import RayLine, add_edge_rates, lipschitz_along
from harnack.fields.solid_angles.treecode import Treecode
from harnack.fields.source_sums import SourceSums, final_rounding
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
    from harnack.fields.batched_fields import PointValues
    from harnack.fields.capabilities import JumpCrossing
    from harnack.fields.field import Sample
    from harnack.fields.solid_angles.trail_sums import Rates
    from harnack.fields.solid_angles.treecode import AddPrimitive
    from harnack.fields.solid_angles.winding_mesh import WindingMesh

# The first of three columns of a record after the columns of `tree.triangle_tree`: 1 if an edge is
# singular.
SINGULAR = INVERSE_SQUARES_COLUMN + 3
# The corners that edges join, and 1 if they run in the triangle's direction, else -1.
_EDGES = ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0))


@dataclass(frozen=True)
class NearEdge:
    """An edge of a near triangle.

    edge: the edge relative to a point.
    is_singular: whether the triangles at it do not cancel.
    """

    edge: LiftedEdge
    is_singular: Mask

    def is_open(self, reach: Real) -> Mask:
        """Whether the edge may be part of the boundary of the triangles near x.

        It is not if it is not singular and nearer than (reach - 1)/2 times its length L: a far node
        with a triangle at it has radius R >= L/2 and is farther than reach R, hence the edge
        farther than (reach - 1) R. So all triangles at it are near, and they cancel there.

        In a cell the same holds of a triangle that is far from it, with `TRIANGLE_RATIO` for the
        reach: the point is nearer to the center by less than the k > 1 radii of `dipole_expansion`.
        Far nodes are farther.
        """
        square, inverse = self.edge.edge.squared_distance, self.edge.edge.inverse_square_length
        closed = ~self.is_singular & (square * inverse < dr.square(0.5 * (reach - 1)))
        return (inverse > 0) & ~closed


def edges_of(row: list[Real], x: Vec3, frame: RayFrame | VerticalRayFrame) -> Iterator[NearEdge]:
    """The edges of the triangle of a record, relative to x; in an empty slot they have length 0."""
    ends = corners_of(row, cast("Any", type(x)))
    for k, (i, j, sign) in enumerate(_EDGES):
        inverse = dr.select(row[NUMBER_COLUMN] >= 0, row[INVERSE_SQUARES_COLUMN + k], 0)
        edge = LiftedEdge.between(ends[i], ends[j], sign * row[PARITY_COLUMN], inverse, frame, x)
        yield NearEdge(edge, row[SINGULAR + k] > 0)


IsAhead: TypeAlias = "Callable[[list[Real], Real], Mask]"

_SHARE = 1 / (4 * math.pi)


@dataclass(frozen=True)
class TreeWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one.

    cells: for samples with gradients up to detail 1; None for no cells.
    """

    clusters: Treecode
    rounding: Real
    cells: DipoleCells | None = None

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, accuracy: float, order: int,
    ) -> TreeWinding:  # fmt: skip
        """The winding number of a mesh, uploaded, without cells."""
        records = np.concatenate([mesh.records, mesh.singular_flags], axis=1)
        slots = records_in_slots(mesh.tree, records)
        rounding = final_rounding(backend)
        levels = list(mesh.levels)
        clusters = Treecode.of(backend, mesh.tree, levels, slots, accuracy, order)
        return cls(clusters, rounding)

    def build_cells(self, mesh: WindingMesh, half: float, most_bytes: int) -> DipoleCells | None:
        """Cells of the cube [-half, half]^3, of at most `most_bytes` bytes: see `dipole_cells`."""
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
        """Whether coarse samples cost less."""
        return True

    @property
    def backend(self) -> Backend:
        return self.clusters.backend

    @property
    def coarsest_detail(self) -> float:
        """`Field.coarsest_accuracy`."""
        return self.clusters.coarsest_accuracy if self.cells is None else 1.0

    def values(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """w and its derivatives up to order `derivatives` at points; closer: the accuracy scale, at
        least 1.

        Near triangles add their crossings with the rays from x along z, and their open edges.
        """
        unit, detail = (
            coordinate_rounding(x),
            fmax(self.backend.Float(closer), self.backend.Float(1)),
        )

        def is_ahead(row: list[Real], t: Real) -> Mask:
            del row
            return t > 0

        sums = self._sums(VerticalRayFrame(x), x, detail, unit, is_ahead, derivatives)
        return self.clusters.values(sums, _SHARE, unit, self.rounding)

    def _sums(
        self,
        frame: RayFrame | VerticalRayFrame,
        x: Vec3,
        detail: Real,
        unit: Real,
        is_ahead: IsAhead,
        derivatives: int,
        where: Mask = True,
    ) -> SourceSums:
        """4 pi w: far clusters, the crossings of near triangles that are ahead of x on rays of the
        frame, and the open edges of near triangles (`NearEdge.is_open`).

        is_ahead(row, t): whether a crossing at t with the triangle of a record is ahead.
        """
        start = LiftedProduct.identity(self.backend.Float).parts()

        def adder(reach: Real) -> AddPrimitive:
            def add(
                row: list[Real], active: Mask, sums: SourceSums, state: tuple[Any, ...]
            ) -> tuple[SourceSums, tuple[Any, ...]]:
                t, sign = signed_crossing(row, frame)
                # A crossing is a full turn of the product, which counts them without rounding.
                re, im, turns = state
                turns = turns + dr.select(active & is_ahead(row, t), sign, 0)
                lifted = LiftedSums(sums, LiftedProduct(re, im, turns))
                for edge in edges_of(row, x, frame):
                    lifted = lifted.add_edge(edge.edge, unit, active & edge.is_open(reach))
                return lifted.sums, lifted.product.parts()

            return add

        sums, product = self._near_sums(x, detail, adder, start, where, derivatives)
        return LiftedSums(sums, LiftedProduct(*product)).total()

    def _near_sums(
        self, x: Vec3, detail: Real, adder: Callable[[Real], AddPrimitive], state: tuple[Any, ...],
        where: Mask, derivatives: int = 1,
    ) -> tuple[SourceSums, tuple[Any, ...]]:  # fmt: skip
        """The sums, and the caller's own state, by the cells if there are cells, the detail is at
        most 1 and no second derivatives are requested.

        adder: from the reach of `NearEdge.is_open`, a function that adds a near triangle.
        """
        if self.cells is None or derivatives == 2:
            add = adder(self.clusters.acceptance_ratio(detail))
            return self.clusters.sums(x, detail, add, state, where, derivatives=derivatives)
        acceptance = self.clusters.acceptance_ratio(fmax(detail, self.backend.Float(1)))
        adders = adder(self.backend.Float(TRIANGLE_RATIO)), adder(acceptance)
        return self.cells.sums_with_tree(self.clusters, x, detail, adders, state, where)

    def crossings_ahead(self, frame: RayFrame, t: Real, active: Mask) -> Real:
        """0: this method does not count crossings along rays, as every sum gives all of w."""
        del frame, t, active
        return self.backend.Float(0)

    def sample_interval(
        self, frame: RayFrame, x: Vec3, behind: JumpCrossing, turns: Real, detail: Real,
        active: Mask = True,
    ) -> Sample:  # fmt: skip
        """w on a ray interval, where active, with promises.

        Near triangles add their crossings ahead of x along the ray, and their open edges
        (`NearEdge.is_open`). Crossings that the tracer has passed up to the start of the interval
        count as behind x, all others as ahead: so it does not matter on which side of a triangle
        rounding puts x.

        Promises. For far dipoles see `SourceSums.sample`. The near triangles' field is that of
        their open edges, and f is harmonic up to the nearest of them; `LiftedEdge.bounds` has their
        terms of the remainder.
        """
        del turns
        index, unit = (
            self.backend.UInt32,
            fmax(coordinate_rounding(frame.o), coordinate_rounding(x)),
        )

        def is_ahead(row: list[Real], t: Real) -> Mask:
            number = index(fmax(row[NUMBER_COLUMN], self.backend.Float(0)))
            return ~((t < behind.t) | ((t == behind.t) & (number <= behind.facet)))

        sums = self._sums(frame, x, detail, unit, is_ahead, 1, active)
        line = RayLine(x, frame.d, 8 * unit)
        promises = lipschitz_along(
            line, sums.gradient, sums.singularity_distance, self._rates(line, active)
        )
        return sums.sample(_SHARE, unit, self.rounding, along=promises)

    def _rates(self, line: RayLine, where: Mask) -> Rates:
        """The rates of `trail_sums.line_rates` for 4 pi w on a line."""

        def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
            active = active & where

            def adder(reach: Real) -> AddPrimitive:
                def add(
                    row: list[Real], active: Mask, sums: SourceSums, old: tuple[Any, ...]
                ) -> tuple[SourceSums, tuple[Any, ...]]:
                    for near in edges_of(row, line.x, VerticalRayFrame(line.x)):
                        is_open = active & near.is_open(reach)
                        new = add_edge_rates(line, near.edge.edge, lengths, old)
                        old = tuple(dr.select(is_open, a, b) for a, b in zip(new, old, strict=True))
                    return sums, old

                return add

            start = tuple(self.backend.Float(0) for _ in lengths)
            far, near = self._near_sums(line.x, self.backend.Float(0), adder, start, active)
            return far.add_line_rates(line.v, line.slack, lengths, near, active)

        return rates
