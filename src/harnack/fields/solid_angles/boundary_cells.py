"""Winding numbers modulo 1 from FMM cells.

Modulo 1, the winding number w of a mesh is 1/(4 pi) times the solid angle of its singular edges,
the edges at which triangles do not cancel, which form closed curves. Cells (`curve_cells`) evaluate
it at nearly the same cost for any number of edges, and without following a ray.

`tracer.branch_tracker.BranchTracker` determines the integer along rays: proved steps stay between
two periodic levels, and a jump adds an integer to w. A ray that comes from outside the extent of
the field begins where w is about 0. A ray that begins inside gets w from the center of its cell,
where w was computed once: along the line from the center, the solid angle of the near loops is
followed continuously, the polynomial is continuous, and crossings of triangles are counted
(`BoundaryCells.value_where_known`). Rays take samples that know their branch only if rounding
leaves the result of these steps uncertain, and to pass a periodic level that is no true level.
These cells replaced a tree of chains of edges along rays, which had to open all chains that a ray
passes through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import to_numpy, to_vector3
from harnack.fields.samples import Sample
from harnack.fields.solid_angles.curve_cell_builder import build_curve_cells
from harnack.fields.solid_angles.curve_cells import CurveCells
from harnack.fields.solid_angles.curve_queries import lift_ball, remainder_promises
from harnack.fields.solid_angles.edges import vertex_rounding
from harnack.fields.solid_angles.trail_sums import RayLine, closed_trails, lipschitz_along
from harnack.fields.source_sums import SLOPE_ROUNDINGS, SUM_MARGIN
from harnack.tree.closest_triangles import distance_lower_bound, jump_sum_within
from harnack.tree.triangle_tree import RayFrame

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import FloatArray, Mask, Real, Vec3
    from harnack.enclosures import Lipschitz
    from harnack.fields.solid_angles.winding_mesh import WindingMesh
    from harnack.tree.triangle_tree import TriangleTree

__all__ = ["BoundaryCells"]

_SHARE = 1 / (4 * math.pi)
# The boundary of a broken mesh consists of many small loops, and its cells must be built fast: a
# cell may have `_NEAR_FACTOR` times as many near edges as a cell of a single curve, and the edges
# beyond `_SHARED` radii of a split cell count for all cells inside it.
_NEAR_FACTOR, _SHARED = 4.0, 3.5
# The fraction of the bytes for all numbers except w at the centers: a cell has at least 64 others.
_CELL_BYTES_FRACTION = 64 / 65
# Bound of the error of a point, and the distance from an edge within which samples promise nothing,
# both in roundings of a coordinate.
_POINT_ROUNDINGS, _EDGE_ROUNDINGS = 8.0, 16.0
# A point at which w follows from the center of its cell, and this center, are at least
# `_TRIANGLE_ROUNDINGS` roundings away from triangles. `_MAX_BRANCH_ERROR` bounds the error of w.
_TRIANGLE_ROUNDINGS, _MAX_BRANCH_ERROR = 64.0, 0.125


@dataclass(frozen=True)
class BoundaryCells:
    """FMM cells of the singular edges of a mesh, on a backend, in the unit coordinates of the mesh.

    cells: the cells of the closed curves that the singular edges form.
    rays: the tree of the triangles.
    center_values: w at the center of each cell; NaN if a triangle is near, or if the error of w is
        not below an eighth.
    """

    cells: CurveCells
    rays: TriangleTree
    center_values: Real

    @classmethod
    def build(
        cls, rays: TriangleTree, mesh: WindingMesh, low: FloatArray, high: FloatArray,
        most_bytes: int, value: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    ) -> BoundaryCells | None:  # fmt: skip
        """The cells of a cube around the mesh and around the box from low (3,) to high (3,); None
        if the cells would take more than `most_bytes` bytes.

        value: gives w (n,) at points (n, 3), and bounds (n,) of its error.
        """
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
            int(_CELL_BYTES_FRACTION * most_bytes),
            near=_NEAR_FACTOR,
            shared=_SHARED,
        )
        if cells is None:
            return None
        centers = cells.centers()
        near = distance_lower_bound(rays, to_vector3(backend, centers))
        w, error = value(centers * mesh.size + mesh.center)
        w[
            (to_numpy(near) < _TRIANGLE_ROUNDINGS * backend.machine_epsilon)
            | ~(error < _MAX_BRANCH_ERROR)
        ] = np.nan
        return cls(cells, rays, backend.Float(w.astype(backend.dtype)))

    @property
    def count(self) -> int:
        """The number of cells."""
        return self.cells.count

    @property
    def size(self) -> int:
        """The number of bytes of the cells, with w at their centers."""
        return self.cells.size + self.count * np.dtype(self.cells.backend.dtype).itemsize

    def value_where_known(self, x: Vec3, unit: Real, active: Mask) -> Real:
        """w at x on active lanes; NaN on other lanes, and where w does not follow from the cell.

        unit: the rounding of a coordinate of x, and of the ray on which x lies.

        Proof. On the line from the cell's center c to x, w changes by the change of the solid angle
        of the boundary over 4 pi, and by -1 where the line crosses a triangle along its normal
        (`edge_lift`). This gives an estimate of w(x) with the errors of w(c) and of the cell. Then
        w(x) is the number nearest to the estimate among the numbers that are congruent modulo 1 to
        the value of the cell, as all errors together are below three eighths. The result is NaN on
        a triangle, and where `signed_crossings_between` or `change_from_center` is not certain. Off
        all triangles the result is also the value on the side on which x lies on the ray: the t of
        a crossing is the depth of a point of the triangle that is a few roundings off the ray, and
        so is the true t. If x were between these two, a point of the triangle would be as near to
        x.
        """
        backend, real = self.cells.backend, self.cells.backend.Float
        local, inside = self.cells.sums(x, active)
        displacement = x - local.center
        distance = dr.norm(displacement)
        inside &= distance > _TRIANGLE_ROUNDINGS * unit
        direction = dr.select(inside, displacement / distance, backend.Array3f(0, 0, 1))
        frame = RayFrame.along(backend, local.center, direction)
        change, is_certain = self.cells.change_from_center(local, frame, x, unit, inside)
        turns, is_clear = self.rays.signed_crossings_between(frame, distance, unit, inside)
        on_triangle = jump_sum_within(self.rays, x, _TRIANGLE_ROUNDINGS * unit, inside)
        estimate = dr.gather(real, self.center_values, local.cell, inside) - turns + _SHARE * change
        value = _SHARE * local.sums.angle
        offset = estimate - value
        branch = dr.round(offset)
        error = local.error + local.rounding
        is_valid = inside & is_certain & is_clear & (on_triangle == 0)
        is_valid &= (dr.abs(offset - branch) < _MAX_BRANCH_ERROR) & (
            _SHARE * error < _MAX_BRANCH_ERROR
        )
        return dr.select(is_valid, value + branch, dr.nan)

    def sample(
        self, x: Vec3, direction: Vec3 | None, unit: Real, active: Mask
    ) -> tuple[Sample, Mask]:
        """A sample of w modulo 1 at x, and the mask of the lanes on which it is valid: the active
        lanes whose x lies in a cell and not at an edge.

        The promises are about w continued smoothly, and are the promises of `SolidAngle`.

        direction: (3,) a unit vector, along which `ray_promises` hold; None for no such promises.
        unit: the rounding of a coordinate.
        """
        backend = self.cells.backend
        cell_sums, inside = self.cells.sums(x, active)
        sums, rounding = cell_sums.sums, _POINT_ROUNDINGS * unit
        promises = remainder_promises(
            sums.cubes, sums.fourths, sums.distance * (1 - SUM_MARGIN) - rounding
        )
        ball = lift_ball(sums.angle, sums.gradient, sums.squares, promises, cell_sums.slope_error)
        rounded = cell_sums.rounding + vertex_rounding(backend.machine_epsilon, x, sums.squares)
        ray_promises: tuple[Lipschitz, ...] = ()
        if direction is not None:
            line = RayLine(x, direction, rounding)

            def rates(lengths: tuple[Real, ...], lanes: Mask) -> tuple[Real, ...]:
                return self.cells.rates_along(cell_sums, line, lengths, lanes & inside)

            ray_promises = lipschitz_along(line, sums.gradient, sums.distance, rates)
        sample = Sample(
            _SHARE * sums.angle,
            _SHARE * sums.gradient,
            tuple(promise.scaled(_SHARE) for promise in promises),
            _SHARE * (cell_sums.error + rounded),
            _SHARE * dr.fma(SLOPE_ROUNDINGS / 3 * unit, sums.cubes, cell_sums.slope_error),
            truncation_error=_SHARE * cell_sums.error,
            alternative_promises=(ball.scaled(_SHARE),),
            ray_promises=tuple(promise.scaled(_SHARE) for promise in ray_promises),
        )
        return sample, inside & (sums.distance > _EDGE_ROUNDINGS * unit)
