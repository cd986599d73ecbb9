"""The winding number w of a mesh without truncation error: from the crossings of one ray with
triangles, and from the boundary edges, at which triangles do not cancel. The signs of all crossings
of the ray add up to an integer, and the solid angles of edges add the rest (`edge_lift` has the
formula). A value at a point takes as long as one ray through a tree of boxes plus one pass over the
boundary edges, whatever the number of triangles. A *lane* is one entry of Dr.Jit's arrays, such as
a point or a ray.

Winding numbers have two evaluators. `winding_exact` adds the crossings of one ray and the boundary
edges (the antipodal method), without truncation. `winding_tree` uses multipoles, for triangle
soups. The tree's truncation error is bounded by the next two moments, which are computed, and an
absolute remainder. The bound is part of `Sample.value_error` and `gradient_error`, by which the
tracer shortens its steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.elementary import fmax
from harnack.enclosures import Lipschitz
from harnack.fields.field import Sample
from harnack.fmm.edge_lift import LiftedEdges, lifted_sums
from harnack.fmm.edges import LoopEdges
from harnack.fmm.point_values import PointValues, SymmetricMatrix
from harnack.fmm.source_sums import SourceTerm, final_rounding
from harnack.fmm.trail_sums import (
    LiftedTrails,
    RayLine,
    TrailValues,
    closed_trails,
    line_rates,
    lipschitz_along,
)
from harnack.fmm.unit_frame import coordinate_rounding
from harnack.tree.triangle_tree import RayFrame, TriangleTree

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.capabilities import JumpCrossing
    from harnack.fields.solid_angles.winding_mesh import WindingMesh

# One over the solid angle of all directions.
_PER_SPHERE = 1 / (4 * math.pi)


@dataclass(frozen=True)
class ExactWinding:
    """The winding number w of a mesh on a backend, evaluated from crossings of rays and from the
    boundary edges, at which triangles do not cancel. Lengths are in units in which the mesh has a
    size of about one.

    rays: a tree of the triangles, in which crossings are counted.
    edges, trails: the boundary edges, for values at points; None for a closed mesh.
    ray_trails, loops: the boundary edges, for samples along rays; None for a closed mesh or without
        tracing.
    rounding: a bound of the rounding of w that the final operations cause, after all terms have
        been added.
    """

    backend: Backend
    rays: TriangleTree
    edges: LiftedEdges | None
    trails: TrailValues | None
    ray_trails: LiftedTrails | None
    loops: LoopEdges | None
    rounding: Real

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, rays: TriangleTree, traced: bool
    ) -> ExactWinding:
        """Upload a mesh to a backend.

        rays: a tree of its triangles, on the same backend.
        traced: whether `sample_interval` will be called, for tracing, which needs further data.
        """
        if not len(mesh.singular_edges):
            # No edges, in none of the forms below.
            return cls(backend, rays, None, None, None, None, final_rounding(backend))
        vertices, edges = mesh.unit_vertices, mesh.singular_edges
        # The same edges in three forms: for values, fast values, and samples along rays.
        ray_trails, loops = None, None
        if traced:
            trails = closed_trails(edges)
            ray_trails = LiftedTrails.upload(backend, vertices, trails)
            loops = LoopEdges.upload(backend, tuple(vertices[trail[:-1]] for trail in trails))
        return cls(
            backend,
            rays,
            LiftedEdges.upload(backend, vertices, edges),
            TrailValues.upload(backend, vertices, edges),
            ray_trails,
            loops,
            final_rounding(backend),
        )

    has_detail: ClassVar[bool] = False
    """Whether samples at small accuracy scales take less time. They do not: all are exact."""

    coarsest_accuracy: ClassVar[float] = 0.5
    """The smallest accuracy scale that makes a difference (`VariableAccuracy.coarsest`). Only FMM
    cells of the boundary distinguish it from 1, so that any number below 1 will do."""

    def fast_values(self, x: Vec3) -> Real:
        """The winding number w (n,) at points x (3, n), without error bounds. It takes a third of
        the time of `values`, and cannot be called while Dr.Jit records a loop.

        Crossings are decided by `tree.triangle_tree.signed_crossing`. Where `TrailValues` is
        uncertain about an edge, the sum over edges is computed again by `lifted_sums`, which
        decides by the same bits as the crossings.
        """
        # Rays lead away from the middle of the mesh, so that less of it lies ahead. A ray along -z
        # is one along z in the mesh mirrored in a plane z = const, whose winding number is -w.
        ray_sign = dr.select(x.z >= 0, self.backend.Float(1), -1)
        # The signed number of crossings of the ray from each x.
        turns = self.rays.signed_crossings_vertical(x, ray_sign)
        # self.trails, self.edges: the boundary edges in two forms; None for a closed mesh.
        if self.trails is None or self.edges is None:
            return dr.select(ray_sign > 0, turns, 0 - turns)  # 0 - 0 is 0, but -(0) is -0
        dr.eval(x, ray_sign, turns)
        edge_turns, is_uncertain = self.trails.turns(x, ray_sign)
        value = ray_sign * (turns + edge_turns)
        dr.eval(value, is_uncertain)
        uncertain_ids = dr.compress(is_uncertain)
        # 0: without derivatives.
        if len(uncertain_ids):
            dr.scatter(
                value, self.values(dr.gather(type(x), x, uncertain_ids), 0).value, uncertain_ids
            )
        return value

    def values(self, x: Vec3, derivatives: int) -> PointValues:
        """The winding number w and its derivatives up to order `derivatives` at points x (3, n),
        with error bounds. For a closed mesh all derivatives are 0."""
        real = self.backend.Float
        turns = self.rays.signed_crossings_vertical(x, real(1))
        if self.edges is None:
            # Value and its error, gradient, Hessian, and the errors of both.
            zeros = self.backend.Array3f(0), SymmetricMatrix.zero(real)
            return PointValues(turns, real(self.rounding), *zeros, real(0), real(0))
        sums, unit = lifted_sums(self.edges, x, derivatives), coordinate_rounding(x)
        # The sums are solid angles: 4 pi w.
        sums = sums.add_term(SourceTerm(4 * math.pi * turns), True)
        return sums.values(_PER_SPHERE, unit, self.rounding)

    def crossings_ahead(self, frame: RayFrame, t: Real, active: Mask) -> Real:
        """The sum (n,) of the signs of all crossings of triangles by rays of the frame, beyond the
        ray parameter t, on active lanes. It is the integer that `sample_interval` takes as `turns`.
        """
        return self.rays.signed_crossings_ahead(frame, t, active)

    def sample_interval(
        self, frame: RayFrame, x: Vec3, behind: JumpCrossing, turns: Real, detail: Real,
        active: Mask = True,
    ) -> Sample:  # fmt: skip
        """A sample of w at points x of a ray interval between two crossings of triangles, on active
        lanes: value, gradient, errors, and proved bounds of w near x (`SourceSums.sample`) and
        along the ray. w is continued smoothly along the interval.

        frame: the rays, with points x on them.
        turns: the sum of the signs of all crossings ahead of the interval's start
            (`crossings_ahead`).
        behind, detail: not used here, as no triangles are summed and every sample has full
            accuracy.
        """
        del behind, detail
        if self.edges is None:
            # A closed mesh: w is constant on the interval.
            zero = self.backend.Array3f(0)
            return Sample(self.backend.Float(turns), zero, (Lipschitz(0.0),), 0.0)
        if self.ray_trails is None or self.loops is None:
            raise RuntimeError("uploaded for points and not for rays")
        # self.ray_trails, self.loops: the boundary edges, for sums along rays and for bounds along
        # lines. sums: 4 pi w, the solid angles of edges, and 4 pi for each crossing ahead.
        sums = self.ray_trails.sum(frame, x, active)
        sums = sums.add_term(SourceTerm(4 * math.pi * turns), True)
        unit = fmax(coordinate_rounding(frame.o), coordinate_rounding(x))
        # 8 * unit bounds the rounding of points of the line.
        line, loops = RayLine(x, frame.d, 8 * unit), self.loops

        def rates(lengths: tuple[Real, ...], lanes: Mask) -> tuple[Real, ...]:
            """For each length T in `lengths`, a bound of the derivative of 4 pi w along the line at
            its points within T of x (`line_rates`). Returns one bound for each length; it is
            infinite on lanes on which `lanes` is False."""
            return line_rates(loops, line, lengths, lanes & active)

        bounds_along = lipschitz_along(line, sums.gradient, sums.singularity_distance, rates)
        return sums.sample(_PER_SPHERE, unit, self.rounding, along=bounds_along)
