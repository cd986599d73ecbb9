"""Winding numbers modulo 1, by cells of the boundary.

Modulo 1 the winding number of a mesh is the solid angle of its singular edges over 4 pi, which are
closed curves. In cells (`curve_cells`) that costs about the same however many of them there are,
and no ray has to be followed. What is left open is a whole number: between two sheets w does not
pass a level, modulo 1, unless a ray meets it, so the march knows that number from one sample to the
next (`tracer.branch_tracker`).

Winding numbers have the cells of their boundary: modulo one w is the solid angle of the edges at
which triangles do not cancel, so that a sample needs no ray and few edges. The whole number is the
ray's business (`branch_tracker`): the levels, repeated with period one, are rungs; proved steps
stay between two of them, sheets move w by whole rungs, and a ray that comes from outside of the
field's extent begins where w is about 0. Those that begin inside know w from the middle of the
cell, where it was computed once: on the line from there the near loops are lifted, the polynomial
is continuous, and crossings are counted. Only where rounding leaves one of these open, and to pass
a rung that is no level, do they take samples that know the number. It replaced a tree of chains of
edges along rays, which had to open all chains that a ray passes through.
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
# The boundary of a broken mesh is many small loops, and its cells must be built soon: they have so
# many times as many near edges as those of one curve, and split ones share what is beyond so many
# radii.
_NEAR_FACTOR, _SHARED = 4.0, 3.5
# Of the bytes, for all but w at the centers: a cell has at least 64 numbers besides.
_CELL_BYTES_FRACTION = 64 / 65
# Roundings of a coordinate: of a point, and within which of an edge nothing is known.
_POINT_ROUNDINGS, _EDGE_ROUNDINGS = 8.0, 16.0
# In roundings: points are that far off triangles where w is known from a cell's center, and so are
# the centers. By how much w may then be off.
_TRIANGLE_ROUNDINGS, _MAX_BRANCH_ERROR = 64.0, 0.125


@dataclass(frozen=True)
class BoundaryCells:
    """Cells of the singular edges of a mesh on a backend, in its unit coordinates.

    rays: the triangles. center_values: w at the center of each cell; NaN where a triangle is near,
        and where it is not known up to an eighth.
    """

    cells: CurveCells
    rays: TriangleTree
    center_values: Real

    @classmethod
    def build(
        cls, rays: TriangleTree, mesh: WindingMesh, low: FloatArray, high: FloatArray,
        most_bytes: int, value: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    ) -> BoundaryCells | None:  # fmt: skip
        """Cells of a cube around the mesh and the box from low (3,) to high (3,), of at most so
        many bytes; None where that is too little.

        value: w at points (n, 3), and bounds of its error.
        """
        backend = rays.tree.backend
        trails = closed_trails(mesh.singular_edges)
        loops = tuple(mesh.unit_vertices[trail[:-1]] for trail in trails)
        ends = (np.array(end) for end in (low, high))
        points = np.concatenate(
            [*loops, *(((end - mesh.center) / mesh.size)[None] for end in ends)]
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
        """Their bytes, with w at the centers."""
        return self.cells.size + self.count * np.dtype(self.cells.backend.dtype).itemsize

    def value_where_known(self, x: Vec3, unit: Real, active: Mask) -> Real:
        """w at x where active; NaN where it is not known.

        unit: the rounding of a coordinate of x, and of those of the ray on which it lies.

        Proof. On the line from the cell's center c to x, w changes by that of the solid angle of
        the boundary over 4 pi, and where the line crosses a triangle along its normal, by -1
        (`edge_lift`). So w is known at x with the errors of w(c) and of the cell; it is the number
        nearest to that of those that are what the cell knows modulo 1, as all errors together are
        below three eighths. On a triangle nothing is known, nor where `signed_crossings_between` or
        `change_from_center` are not sure. Off all triangles it is the number of the side on which
        the ray has x, too: the t of a crossing is the depth of a point of the triangle that is a
        few roundings off the ray, and so is the true one. If x were between these two, a point of
        the triangle would be as near to x.
        """
        backend, real = self.cells.backend, self.cells.backend.Float
        found, inside = self.cells.sums(x, active)
        way = x - found.center
        end = dr.norm(way)
        inside &= end > _TRIANGLE_ROUNDINGS * unit
        d = dr.select(inside, way / end, backend.Array3f(0, 0, 1))
        frame = RayFrame.along(backend, found.center, d)
        change, sure = self.cells.change_from_center(found, frame, x, unit, inside)
        turns, clear = self.rays.signed_crossings_between(frame, end, unit, inside)
        on_triangle = jump_sum_within(self.rays, x, _TRIANGLE_ROUNDINGS * unit, inside)
        estimate = dr.gather(real, self.center_values, found.cell, inside) - turns + _SHARE * change
        value = _SHARE * found.sums.angle
        rest = estimate - value
        number = dr.round(rest)
        error = found.error + found.rounding
        known = inside & sure & clear & (on_triangle == 0)
        known &= (dr.abs(rest - number) < _MAX_BRANCH_ERROR) & (_SHARE * error < _MAX_BRANCH_ERROR)
        return dr.select(known, value + number, dr.nan)

    def sample(
        self, x: Vec3, direction: Vec3 | None, unit: Real, active: Mask
    ) -> tuple[Sample, Mask]:
        """w at x but for a whole number, with promises of its lift, those along a unit direction
        among them if one is given; and the points for which they hold: those that are active, in a
        cell and not at an edge. See `SolidAngle` for the promises.

        unit: the rounding of a coordinate.
        """
        backend = self.cells.backend
        found, inside = self.cells.sums(x, active)
        sums, rounding = found.sums, _POINT_ROUNDINGS * unit
        known = remainder_promises(
            sums.cubes, sums.fourths, sums.distance * (1 - SUM_MARGIN) - rounding
        )
        ball = lift_ball(sums.angle, sums.gradient, sums.squares, known, found.slope_error)
        rounded = found.rounding + vertex_rounding(backend.machine_epsilon, x, sums.squares)
        along: tuple[Lipschitz, ...] = ()
        if direction is not None:
            line = RayLine(x, direction, rounding)

            def rates(lengths: tuple[Real, ...], wanted: Mask) -> tuple[Real, ...]:
                return self.cells.rates_along(found, line, lengths, wanted & inside)

            along = lipschitz_along(line, sums.gradient, sums.distance, rates)
        sample = Sample(
            _SHARE * sums.angle,
            _SHARE * sums.gradient,
            tuple(one.scaled(_SHARE) for one in known),
            _SHARE * (found.error + rounded),
            _SHARE * dr.fma(SLOPE_ROUNDINGS / 3 * unit, sums.cubes, found.slope_error),
            truncation_error=_SHARE * found.error,
            alternative_promises=(ball.scaled(_SHARE),),
            ray_promises=tuple(one.scaled(_SHARE) for one in along),
        )
        return sample, inside & (sums.distance > _EDGE_ROUNDINGS * unit)
