"""Winding numbers without truncation: crossings of one ray, and the boundary edges.

See `edge_lift` for the formula. At points the cost is that of one ray through a tree of boxes plus
one pass over the edges at which the triangles do not cancel, however many triangles there are.
Along rays a tree of chains of these edges takes less than all of them (`edge_chains`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.enclosures import Lipschitz
from harnack.fields.batch import Values
from harnack.fields.edges.edge_lift import LiftedEdges, lifted_sums
from harnack.fields.edges.edge_passing import Line, known_along
from harnack.fields.edges.lifted_trails import LiftedTrails
from harnack.fields.field import Sample
from harnack.fields.meshes.edge_chains import EdgeChains
from harnack.fields.meshes.edge_trails import EdgeTrails, closed_trails
from harnack.fields.sums import FieldSums, rounding_of_sum
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree.triangles import Frame, TriangleRays

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.meshes.winding_mesh import WindingMesh
    from harnack.fields.sheets import Crossing


# Up to so many edges close sums along rays run over all of them: at 4 ns an edge and point, where a
# tree of chains takes 13 to 30 us a point, measured with 1,585 edges.
_MOST_EDGES = 4000
_SHARE = 1 / (4 * math.pi)


@dataclass(frozen=True)
class ExactWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one.

    rounding: what rounding may add to w.
    """

    backend: Backend
    rays: TriangleRays
    edges: LiftedEdges | None
    trails: EdgeTrails | None
    chains: EdgeChains | None
    all_edges: LiftedTrails | None
    rounding: Real

    @classmethod
    def of(
        cls, backend: Backend, mesh: WindingMesh, rays: TriangleRays, traced: bool
    ) -> ExactWinding:
        """Everything uploaded; traced: for `on_stretch` as well."""
        if not len(mesh.singular):
            return cls(backend, rays, None, None, None, None, rounding_of_sum(backend, 0))
        vertices, edges = mesh.unit_vertices, mesh.singular
        chains, all_edges = None, None
        if traced:
            chains = EdgeChains.upload(backend, vertices, edges)
        if traced and len(edges) <= _MOST_EDGES:
            all_edges = LiftedTrails.upload(backend, vertices, closed_trails(edges))
        return cls(
            backend,
            rays,
            LiftedEdges.upload(backend, vertices, edges),
            EdgeTrails.upload(backend, vertices, edges),
            chains,
            all_edges,
            rounding_of_sum(backend, len(edges)),
        )

    @property
    def has_detail(self) -> bool:
        """Whether coarse samples cost less."""
        return self.chains is not None

    @property
    def coarsest_detail(self) -> float:
        """`Field.coarsest_detail`: of chains, by how much less is left out in a close sample."""
        return 0.5

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
            dr.scatter(value, self.at(dr.gather(type(x), x, again), 0).value, again)
        return value

    def at(self, x: Vec3, derivatives: int) -> Values:
        """w, gradient and Hessian (as asked for) at points."""
        real = self.backend.Float
        turns = self.rays.turns_along(x, real(1))
        if self.edges is None:
            nothing = self.backend.Array3f(0), SymmetricSum.zero(real)
            return Values(turns, real(self.rounding), *nothing, real(0), real(0))
        sums, unit = lifted_sums(self.edges, x, derivatives).whole(), epsilon_at(x)
        sums = dataclasses.replace(sums, value=dr.fma(4 * math.pi, turns, sums.value))
        return sums.values(_SHARE, unit, self.rounding)

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """The part of w that counts crossings, for t at the start of a ray."""
        return self.rays.turns_ahead(frame, t, active)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, turns: Real, detail: Real
    ) -> Sample:
        """w continued along a stretch of a ray, certified as `FieldSums.sample` says."""
        del behind
        if self.edges is None:
            nothing = self.backend.Array3f(0)
            return Sample(self.backend.Float(turns), nothing, (Lipschitz(0.0),), 0.0)
        if self.chains is None:
            raise RuntimeError("uploaded for points and not for rays")
        found = self._near(self.chains, frame, x, detail)
        found = dataclasses.replace(found, value=dr.fma(4 * math.pi, turns, found.value))
        unit = fmax(epsilon_at(frame.o), epsilon_at(x))
        line, chains = Line(x, frame.d, 8 * unit), self.chains

        def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
            return chains.rates(frame, line, lengths, active)

        known = known_along(line, found.gradient, found.free_distance, rates)
        return found.sample(_SHARE, unit, self.rounding, along=known)

    def _near(self, chains: EdgeChains, frame: Frame, x: Vec3, detail: Real) -> FieldSums:
        """The sum over boundary edges: coarse by chains, close over all edges if they are few.

        Close sums over chains go down to the leaves nearly everywhere.
        """
        if self.all_edges is None:
            return chains.near(frame, x, detail)
        is_close = self.backend.Float(detail) >= 1
        close = self.all_edges.near(frame, x, is_close)
        coarse = chains.near(frame, x, detail, ~is_close)
        return coarse.where(is_close, close)
