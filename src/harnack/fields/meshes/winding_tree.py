"""Winding numbers by a tree: clusters of far triangles as multipoles, near ones exactly.

Barill et al. 2018 ("Fast winding numbers for soups and clouds") with orders 0 to 2, gradients and
Hessians from the same moments, a bound of what the truncation costs, and certificates.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.fields.edges.edge_lift import LiftedProduct, with_edge
from harnack.fields.edges.edge_passing import Line, known_along, with_edge_rates
from harnack.fields.meshes.triangle_kernel import edges_of
from harnack.fields.meshes.winding_mesh import rounding_of_sum
from harnack.fields.multipoles.far_clusters import Errors, FarClusters
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import Node, for_each
from harnack.tree.triangles import INDEX, Upwards, crossing, in_slots

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.batch import Values
    from harnack.fields.edges.edge_passing import Rates
    from harnack.fields.field import Sample
    from harnack.fields.meshes.winding_mesh import WindingMesh
    from harnack.fields.sheets import Crossing
    from harnack.tree.triangles import Frame

_SHARE = 1 / (4 * math.pi)


@dataclass(frozen=True)
class TreeWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one."""

    clusters: FarClusters
    rounding: Real

    @classmethod
    def of(cls, backend: Backend, mesh: WindingMesh, accuracy: float, order: int) -> TreeWinding:
        """Everything uploaded."""
        records = np.concatenate([mesh.records, mesh.singular_flags], axis=1)
        slots = in_slots(mesh.tree, records)
        rounding = rounding_of_sum(backend, len(mesh.triangles))
        levels = list(mesh.levels)
        return cls(FarClusters.of(backend, mesh.tree, levels, slots, accuracy, order), rounding)

    @property
    def has_detail(self) -> bool:
        """Whether rough looks cost less."""
        return True

    @property
    def backend(self) -> Backend:
        """The one it lies on."""
        return self.clusters.backend

    @property
    def coarsest_detail(self) -> float:
        """`Field.coarsest_detail`."""
        return self.clusters.coarsest

    def at(self, x: Vec3, derivatives: int, closer: Real) -> Values:
        """w, gradient and Hessian (as asked for) at points, `closer` as for `FarClusters.at`.

        Near triangles: the crossings of the rays from x along z, and their open edges.
        """
        real, epsilon = self.backend.Float, epsilon_at(x)
        frame, reach = Upwards(x), self.clusters.accuracy * fmax(real(closer), real(1))
        count = len(dataclasses.fields(Errors))

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            errors, (value, *rest) = Errors(*state[:count]), state[count:]
            product = LiftedProduct(*rest[-3:])
            t, turn = crossing(row, frame)
            value = value + dr.select(active & (t > 0), 4 * math.pi * turn, 0)
            bounds = errors.rounding, errors.s4, errors.s5
            for edge in edges_of(row, x, frame):
                open_ = active & edge.is_open(reach)
                product = edge.times(product, open_)
                bounds = with_edge(bounds, edge.square, edge.inverse, epsilon, open_)
                if derivatives >= 1:
                    rest[0] = rest[0] + dr.select(open_, edge.gradient(), 0)
                if derivatives == 2:
                    rest[1:7] = edge.add_hessian(SymmetricSum(*rest[1:7]), open_).parts()
            errors = dataclasses.replace(errors, rounding=bounds[0], s4=bounds[1], s5=bounds[2])
            return *errors.parts(), value, *rest[:-3], *product.parts()

        def leaf(node: Node, near: Mask, errors: Errors, sums: Any) -> tuple[Errors, Any]:
            state = for_each(node, near, add, (*errors.parts(), *sums))
            return Errors(*state[:count]), state[count:]

        one = LiftedProduct.one(real).parts()
        errors, (value, *rest) = self.clusters.at(x, derivatives, leaf, closer, one)
        value = value + LiftedProduct(*rest[-3:]).angle()
        gradient = rest[0] if derivatives >= 1 else None
        hessian = SymmetricSum(*rest[1:7]) if derivatives == 2 else None
        return errors.values(_SHARE, epsilon, self.rounding, value, gradient, hessian)

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """No crossings are counted: every sum is the whole of w."""
        del frame, t, active
        return self.backend.Float(0)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, turns: Real, detail: Real
    ) -> Sample:
        """w on a stretch of a ray, with a certificate.

        Near triangles: their crossings ahead of x along the ray, and their open edges
        (`NearEdge.is_open`). Crossings passed up to the start of the stretch are behind x, all
        others ahead, as the tracer has it: the sign of a triangle that x is on, to rounding, is
        not asked for.

        Certificate. Far dipoles: see `nearby.Nearby.sample`. The near triangles' field is that of
        their open edges, and f is harmonic as far as the nearest of them; what they add to the
        remainder, says `edge_lift.with_edge`.
        """
        del turns
        real, index = self.backend.Float, self.backend.UInt32
        epsilon, reach = fmax(epsilon_at(frame.o), epsilon_at(x)), self.clusters.ratio(detail)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, g, truncation, slope_truncation, rounding, clear, s4, s5, *product = state
            t, turn = crossing(row, frame)
            passed = t < behind.t
            passed |= (t == behind.t) & (index(fmax(row[INDEX], real(0))) <= behind.sheet)
            value = value + dr.select(active & ~passed, 4 * math.pi * turn, 0)
            product, bounds = LiftedProduct(*product), (rounding, s4, s5)
            for edge in edges_of(row, x, frame):
                open_ = active & edge.is_open(reach)
                product = edge.times(product, open_)
                bounds = with_edge(bounds, edge.square, edge.inverse, epsilon, open_)
                g = g + dr.select(open_, edge.gradient(), 0)
                clear = dr.select(open_, fmin(dr.sqrt(edge.square), clear), clear)
            rounding, s4, s5 = bounds
            sums = value, g, truncation, slope_truncation, rounding, clear, s4, s5
            return *sums, *product.parts()

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return for_each(node, near, add, sums)

        one = LiftedProduct.one(real).parts()
        found, product = self.clusters.near(x, detail, leaf, one)
        found = dataclasses.replace(found, value=found.value + LiftedProduct(*product).angle())
        line = Line(x, frame.d, 8 * epsilon)
        known = known_along(line, found.gradient, found.clear, self._rates(line))
        return found.sample(_SHARE, epsilon, self.rounding, along=known)

    def _rates(self, line: Line) -> Rates:
        """The rates of `edge_passing` for 4 pi w on stretches of lines."""
        reach = self.clusters.rough

        def rates(lengths: tuple[Real, ...], active: Mask) -> tuple[Real, ...]:
            def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
                old = state[8:]
                for edge in edges_of(row, line.x, Upwards(line.x)):
                    open_ = active & edge.is_open(reach)
                    new = with_edge_rates(line, (edge.a, edge.e), edge.inverse, lengths, old)
                    old = tuple(dr.select(open_, a, b) for a, b in zip(new, old, strict=True))
                return *state[:8], *old

            def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
                return for_each(node, near, add, sums)

            start = tuple(self.backend.Float(0) for _ in lengths)
            far, near = self.clusters.near(line.x, 0, leaf, start, active)
            return far.with_rates(line, lengths, near, active)

        return rates
