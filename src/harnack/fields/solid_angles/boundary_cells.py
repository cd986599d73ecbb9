"""The winding number w of a mesh modulo 1, from FMM cells: octree cells, each with a list of near
edges and a polynomial for all far edges. The singular edges of a mesh are those at which its
triangles do not cancel, such as the edges of holes; they form closed curves, the boundary. Modulo
1, w is 1/(4 pi) times the solid angle of the boundary. The cells (`curve_cells`) evaluate that
solid angle at nearly the same cost for any number of edges.

The integer that is missing is tracked along each ray by `tracer.branch_tracker.BranchTracker`. If a
step of the ray is proved to contain no point at which w has the level modulo 1, w changes on it by
less than 1; and a crossing of a triangle changes w by a known integer. So w at the end of a step
follows from w at its start. A ray that begins outside of the field's extent begins with w near 0. A
ray that begins inside takes w from the center of its cell, where w was computed when the cells were
built (`BoundaryCells.value_where_known`): the change of the solid angle is followed continuously
from there to the ray's start, and the triangles that are crossed are counted.

The sum over all edges, which gives w with its integer, is needed in two cases only: if rounding
leaves the integer uncertain, and if a ray has to pass a point at which w modulo 1 has the level but
w has not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import to_numpy, to_vector3
from harnack.enclosures.samples import Sample
from harnack.fmm.curve_cell_builder import build_curve_cells
from harnack.fmm.curve_cells import CurveCells
from harnack.fmm.curve_queries import lift_ball, remainder_promises
from harnack.fmm.edges import vertex_rounding
from harnack.fmm.source_sums import SLOPE_ROUNDINGS, SUM_MARGIN
from harnack.fmm.trail_sums import RayLine, closed_trails, lipschitz_along
from harnack.tree.closest_triangles import distance_lower_bound, jump_sum_within
from harnack.tree.triangle_tree import RayFrame

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import FloatArray, Mask, Real, Vec3
    from harnack.enclosures import Lipschitz
    from harnack.fields.solid_angles.winding_mesh import WindingMesh
    from harnack.tree.triangle_tree import TriangleTree

__all__ = ["BoundaryCells"]

# One over the solid angle 4 pi of all directions.
_PER_SPHERE = 1 / (4 * math.pi)
# The boundary of a broken mesh consists of many small loops, and its cells must be built fast. So a
# cell may have `_NEAR_FACTOR` times as many near edges as a cell of a single curve. If a cell is
# split, edges farther than `_SHARED_RADII` radii from its center are in the expansions of all cells
# inside it.
_NEAR_FACTOR, _SHARED_RADII = 4.0, 3.5
# The fraction of the bytes that is left for everything except w at the centers: a cell has at least
# 64 other numbers.
_CELL_BYTES_FRACTION = 64 / 65
# A bound of the error of a point's position, and the distance from an edge within which samples are
# not valid, both as multiples of the rounding of a coordinate.
_POINT_ROUNDINGS, _EDGE_ROUNDINGS = 8.0, 16.0
# A point at which w follows from the center of its cell, and this center, are at least
# `_TRIANGLE_ROUNDINGS` roundings away from triangles. `_MAX_BRANCH_ERROR` bounds the error of w.
_TRIANGLE_ROUNDINGS, _MAX_BRANCH_ERROR = 64.0, 0.125


@dataclass(frozen=True)
class BoundaryCells:
    """FMM cells of the boundary of a mesh, on a backend. The boundary consists of the singular
    edges, at which the triangles do not cancel; they form closed curves. The cells give the winding
    number w modulo 1: it is 1/(4 pi) times the solid angle of the boundary. Points are in the unit
    coordinates of the mesh: relative to its center, over its size.

    cells: the cells of the boundary.
    rays: the tree of the mesh's triangles.
    center_values: (count,) the winding number w at the center of each cell, with its integer. It is
        NaN if a triangle is near to the center, or if the bound of the error of w is not below an
        eighth.
    """

    cells: CurveCells
    rays: TriangleTree
    center_values: Real

    @classmethod
    def build(
        cls, rays: TriangleTree, mesh: WindingMesh, low: FloatArray, high: FloatArray,
        most_bytes: int, value: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    ) -> BoundaryCells | None:  # fmt: skip
        """Build the cells of the boundary of a mesh, in a cube that contains the mesh and a box.

        rays: the tree of the mesh's triangles.
        mesh: the mesh.
        low, high: (3,) opposite corners of the box, in the mesh's own coordinates.
        most_bytes: the number of bytes that the cells may take.
        value: a function that computes w (n,) at points (n, 3), in the mesh's own coordinates, and
            bounds (n,) of its error.

        Returns None if the cells would take more bytes.
        """
        # loops: the vertices of each closed curve; a trail repeats its first vertex at the end.
        backend = rays.tree.backend
        trails = closed_trails(mesh.singular_edges)
        loops = tuple(mesh.unit_vertices[trail[:-1]] for trail in trails)
        ends = (np.array(corner) for corner in (low, high))
        points = np.concatenate(
            [*loops, *(((corner - mesh.center) / mesh.size)[None] for corner in ends)]
        )
        cells = build_curve_cells(
            backend,
            loops,
            points.min(axis=0),
            points.max(axis=0),
            # The rest is for w at the centers.
            int(_CELL_BYTES_FRACTION * most_bytes),
            near=_NEAR_FACTOR,
            shared=_SHARED_RADII,
        )
        if cells is None:
            return None
        # w at the centers; NaN where it is not certain: near triangles, or if its error is large.
        centers = cells.centers()
        triangle_distance = distance_lower_bound(rays, to_vector3(backend, centers))
        w, error = value(centers * mesh.size + mesh.center)
        w[
            (to_numpy(triangle_distance) < _TRIANGLE_ROUNDINGS * backend.machine_epsilon)
            | ~(error < _MAX_BRANCH_ERROR)
        ] = np.nan
        return cls(cells, rays, backend.Float(w.astype(backend.dtype)))

    @property
    def count(self) -> int:
        """The number of cells."""
        return self.cells.count

    @property
    def size(self) -> int:
        """The number of bytes that the cells take, including w at their centers."""
        return self.cells.size + self.count * np.dtype(self.cells.backend.dtype).itemsize

    def value_where_known(self, x: Vec3, unit: Real, active: Mask) -> Real:
        """Compute the winding number w at points x, with its integer and not only modulo 1, from w
        at the center of the cell that contains x.

        x: (3, n) in unit coordinates.
        unit: a bound of the rounding of a coordinate of x, and of the ray on which x lies.
        active: the mask of the lanes to compute.

        Returns w (n,). It is NaN where w does not follow with certainty: off the cube of the cells,
        near triangles, if w at the center is not known, and on lanes that are not active.

        Proof. On the line from the cell's center c to x, w changes for two reasons: by 1/(4 pi)
        times the change of the solid angle of the boundary, and by -1 where the line crosses a
        triangle along its normal (`edge_lift`). This gives an estimate of w(x) with the errors of
        w(c) and of the cell. The value of the cell is w(x) modulo 1. Among the numbers that differ
        from it by integers, w(x) is the one nearest to the estimate, because all errors together
        are below three eighths. The result is NaN on a triangle, and where
        `signed_crossings_between` or `change_from_center` is not certain. If x lies on a ray, its
        own position and the crossings that the tracer has computed on the ray must agree about the
        side of each triangle on which x lies. They do, unless x counts as on the triangle. The
        computed t of a crossing is that of a point of the triangle a few roundings off the ray, and
        so is the true t. If x were between these two, the triangle would come within a few
        roundings of x.
        """
        # cell_sums: the sums in the cell of x. turns: the number of triangles that the line from
        # its center to x crosses, counted with signs. value: w modulo 1. self.rays: the tree of the
        # mesh's triangles. self.center_values: w at the centers of the cells.
        backend, real = self.cells.backend, self.cells.backend.Float
        cell_sums, inside = self.cells.sums(x, active)
        displacement = x - cell_sums.center
        distance = dr.norm(displacement)
        # At the center itself the line to x has no direction.
        inside &= distance > _TRIANGLE_ROUNDINGS * unit
        direction = dr.select(inside, displacement / distance, backend.Array3f(0, 0, 1))
        frame = RayFrame.along(backend, cell_sums.center, direction)
        change, is_certain = self.cells.change_from_center(cell_sums, frame, x, unit, inside)
        turns, is_clear = self.rays.signed_crossings_between(frame, distance, unit, inside)
        # The sum of |jump| over the triangles within rounding of x; 0 if there are none.
        on_triangle = jump_sum_within(self.rays, x, _TRIANGLE_ROUNDINGS * unit, inside)
        estimate = (
            dr.gather(real, self.center_values, cell_sums.cell, inside)
            - turns
            + _PER_SPHERE * change
        )
        value = _PER_SPHERE * cell_sums.sums.angle
        # w is the value plus an integer, the branch.
        offset = estimate - value
        branch = dr.round(offset)
        error = cell_sums.error + cell_sums.rounding
        is_valid = inside & is_certain & is_clear & (on_triangle == 0)
        is_valid &= (dr.abs(offset - branch) < _MAX_BRANCH_ERROR) & (
            _PER_SPHERE * error < _MAX_BRANCH_ERROR
        )
        return dr.select(is_valid, value + branch, dr.nan)

    def sample(
        self, x: Vec3, direction: Vec3 | None, unit: Real, active: Mask
    ) -> tuple[Sample, Mask]:
        """Compute a sample of w modulo 1 at points x: value, gradient, error bounds, and proved
        bounds of w near x. The bounds hold for the smooth continuation of w through the triangles,
        without its jumps; they are computed as those of `SolidAngle`.

        x: (3, n) in unit coordinates.
        direction: (3, n) unit vectors of rays through x, on which the bounds `ray_promises` of the
            sample hold; None for no such bounds.
        unit: a bound of the rounding of a coordinate.
        active: the mask of the lanes to compute.

        Returns the sample, and the mask of the lanes on which it is valid: the active lanes whose x
        lies in a cell and not near an edge.
        """
        backend = self.cells.backend
        cell_sums, inside = self.cells.sums(x, active)
        sums, rounding = cell_sums.sums, _POINT_ROUNDINGS * unit
        # The solid angle f = 4 pi w. promises: bounds of f's second derivatives on balls around x;
        # ball: a range of f on a ball. inverse_squares, inverse_cubes and inverse_fourths: the
        # integrals of |dp|/D^2, |dp|/D^3 and |dp|/D^4 over the boundary.
        promises = remainder_promises(
            sums.inverse_cubes, sums.inverse_fourths, sums.distance * (1 - SUM_MARGIN) - rounding
        )
        ball = lift_ball(
            sums.angle, sums.gradient, sums.inverse_squares, promises, cell_sums.slope_error
        )
        rounded = cell_sums.rounding + vertex_rounding(
            backend.machine_epsilon, x, sums.inverse_squares
        )
        ray_promises: tuple[Lipschitz, ...] = ()
        if direction is not None:
            line = RayLine(x, direction, rounding)

            def rates(lengths: tuple[Real, ...], lanes: Mask) -> tuple[Real, ...]:
                """For each length T in `lengths`, bound the derivative of the boundary's solid
                angle along the line at all points within T of x (`CurveCells.rates_along`). lanes:
                the mask of the lanes to compute. Returns one bound for each length."""
                return self.cells.rates_along(cell_sums, line, lengths, lanes & inside)

            ray_promises = lipschitz_along(line, sums.gradient, sums.distance, rates)
        # All numbers of f become numbers of w by the factor 1/(4 pi). The rounding of the gradient
        # is at most SLOPE_ROUNDINGS unit s4 (`source_sums`), and s4 = I3/4 <= I3/3 with the
        # integral I3 of |dp|/D^3 over the boundary.
        sample = Sample(
            _PER_SPHERE * sums.angle,
            _PER_SPHERE * sums.gradient,
            tuple(promise.scaled(_PER_SPHERE) for promise in promises),
            _PER_SPHERE * (cell_sums.error + rounded),
            _PER_SPHERE
            * dr.fma(SLOPE_ROUNDINGS / 3 * unit, sums.inverse_cubes, cell_sums.slope_error),
            truncation_error=_PER_SPHERE * cell_sums.error,
            alternative_promises=(ball.scaled(_PER_SPHERE),),
            ray_promises=tuple(promise.scaled(_PER_SPHERE) for promise in ray_promises),
        )
        return sample, inside & (sums.distance > _EDGE_ROUNDINGS * unit)
