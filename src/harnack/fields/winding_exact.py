"""Winding numbers without truncation: crossings of one ray, and the boundary edges.

See `edge_lift` for the formula. The cost is that of one ray through a tree of boxes plus one pass
over the edges at which the triangles do not cancel, however many triangles there are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.fields.edge_chains import EdgeChains
from harnack.fields.edge_lift import LiftedEdges, LiftedSums, lifted_sums
from harnack.fields.edge_trails import EdgeTrails
from harnack.fields.field import HarmonicBall, Lipschitz, Sample
from harnack.fields.winding_mesh import rounding_of_sum
from harnack.tree.triangles import Frame, TriangleRays

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.edge_hessian import SymmetricSum
    from harnack.fields.sheets import Crossing
    from harnack.fields.winding_mesh import WindingMesh

# The ball reaches half-way to the nearest edge, as for `SolidAngle`; sums of float32 terms.
_REACH, _ROUNDING = 0.5, 2e-5
# So many edges are summed one by one along rays.
_FEW = 64


@dataclass(frozen=True)
class ExactWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one."""

    backend: Backend
    rays: TriangleRays
    edges: LiftedEdges | None
    trails: EdgeTrails | None
    chains: EdgeChains | None
    edge_count: int

    @classmethod
    def of(cls, backend: Backend, mesh: WindingMesh, rays: TriangleRays) -> ExactWinding:
        """Everything uploaded."""
        count = len(mesh.singular)
        if not count:
            return cls(backend, rays, None, None, None, 0)
        edges = LiftedEdges.upload(backend, mesh.unit_vertices, mesh.singular)
        trails = EdgeTrails.upload(backend, mesh.unit_vertices, mesh.singular)
        if count <= _FEW:
            return cls(backend, rays, edges, trails, None, count)
        chains = EdgeChains.upload(backend, mesh.unit_vertices, mesh.singular)
        return cls(backend, rays, edges, trails, chains, count)

    @property
    def rounding(self) -> float:
        """What rounding may add to w."""
        return rounding_of_sum(self.backend, self.edge_count)

    def values(self, x: Vec3) -> Real:
        """w at points, not while a loop is recorded: as `at`, for a third of the work.

        Crossings are decided by `tree.triangles.crossing`, and wherever the trails are in doubt
        about an edge, the sum over edges is done again by `lifted_sums`, which decides alike.
        """
        # Away from the middle of the mesh, where less of it lies ahead. Mirrored, it winds the
        # other way.
        way = dr.select(x.z >= 0, self.backend.Float(1), -1)
        turns = self.rays.turns_along(x, way)
        if self.trails is None or self.edges is None:
            return dr.select(way > 0, turns, 0 - turns)  # no zero with a sign
        dr.eval(x, way, turns)
        around, doubt = self.trails.turns(x, way)
        value = way * (turns + around)
        dr.eval(value, doubt)
        again = dr.compress(doubt)
        if len(again):
            dr.scatter(value, self.at(dr.gather(type(x), x, again), 0)[0], again)
        return value

    def at(self, x: Vec3, derivatives: int) -> tuple[Real, Vec3, SymmetricSum | None, Real]:
        """w, gradient, Hessian (as asked for) and a bound of the truncation error, which is 0."""
        turns = self.rays.turns_along(x, self.backend.Float(1))
        if self.edges is None:
            return turns, self.backend.Array3f(0), None, self.backend.Float(0)
        sums = lifted_sums(self.edges, lambda p: p - x, derivatives=derivatives, variation=False)
        share = 1 / (4 * math.pi)
        hessian = type(sums.hessian)(*(share * part for part in sums.hessian.parts()))
        value = dr.fma(share, sums.angle, turns)
        return value, share * sums.gradient, hessian, self.backend.Float(0)

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """The part of w that counts crossings, for t at the start of a ray."""
        return self.rays.turns_ahead(frame, t, active)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, turns: Real, fine: Mask
    ) -> Sample:
        """w continued along a stretch of a ray.

        The certificate is that of `SolidAngle` ("edges"), for the sum of solid angles is the
        lift of the boundary's.
        """
        del behind
        real = self.backend.Float
        if self.edges is None:
            return Sample(real(turns), self.backend.Array3f(0), (Lipschitz(0.0),), 0.0)
        share = 1 / (4 * math.pi)
        if self.chains is not None:
            sums = self.chains.sums(frame, x, fine)
            gradient, error, doubt = share * sums.gradient, sums.error, share * sums.slope_error
        else:
            sums = lifted_sums(
                self.edges, self._seen_along(frame, x), derivatives=1, variation=True
            )
            gradient, error, doubt = self._gradient(frame, sums, share), real(0), 0.0
        value = dr.fma(share, sums.angle, turns)
        epsilon = self.backend.epsilon
        distance = sums.distance * (1 - _ROUNDING) - 8 * epsilon
        r = _REACH * distance
        variation = 2 * r * (sums.first + r / (1 - _REACH) * sums.second) * (1 + _ROUNDING)
        ball = HarmonicBall(r, value - share * variation, value + share * variation)
        # On an edge itself, to rounding, all values meet: a gradient that says so.
        apart = (sums.distance > 8 * epsilon) & dr.isfinite(dr.squared_norm(gradient))
        steep = self.backend.Array3f(0, 0, share / (4 * epsilon))
        gradient, error = dr.select(apart, gradient, steep), dr.fma(share, error, self.rounding)
        return Sample(value, gradient, (ball,), error, doubt)

    def _seen_along(self, frame: Frame, x: Vec3) -> Any:
        """Across the ray vertices are seen from its origin, so that `side` decides for all points
        of the ray alike, and as for triangles; along it, from x."""
        vector = self.backend.Array3f

        def place(p: Vec3) -> Vec3:
            u, v = frame.across(p)
            return vector(u, v, dr.dot(p - x, frame.d))

        return place

    def _gradient(self, frame: Frame, sums: LiftedSums, share: float) -> Vec3:
        g = share * sums.gradient
        return g.x * frame.u + g.y * frame.v + g.z * frame.d
