"""Winding numbers by a tree: clusters of far triangles as multipoles, near ones exactly.

Barill et al. 2018 ("Fast winding numbers for soups and clouds") with orders 0 to 2, gradients and
Hessians from the same moments, a bound of what the truncation costs, and certificates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.fields.edge_field import edge_variation
from harnack.fields.edge_hessian import SymmetricSum
from harnack.fields.edge_lift import times, whole_angle
from harnack.fields.far_clusters import FarClusters
from harnack.fields.triangle_kernel import NearTriangle
from harnack.fields.winding_mesh import rounding_of_sum
from harnack.tree import Node, for_each
from harnack.tree.triangles import EDGES, INDEX, crossing, in_slots

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.field import Sample
    from harnack.fields.sheets import Crossing
    from harnack.fields.winding_mesh import WindingMesh
    from harnack.tree.triangles import Frame

_SHARE = 1 / (4 * math.pi)
# Columns of a record behind those of `tree.triangles`: 1 where an edge is singular.
_SINGULAR = EDGES + 3


@dataclass(frozen=True)
class TreeWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one."""

    clusters: FarClusters
    rounding: float

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

    def at(self, x: Vec3, derivatives: int) -> tuple[Real, Vec3, SymmetricSum | None, Real]:
        """w, gradient, Hessian (as asked for) and the bound of the truncation error of w."""

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return self._near(node, near, x, derivatives, sums)

        zero = self.backend.Float(0)
        value, *rest, unsure, error = self.clusters.at(x, derivatives, leaf, (zero,))
        gradient = _SHARE * rest[0] if derivatives >= 1 else self.backend.Array3f(0)
        hessian = SymmetricSum(*(_SHARE * part for part in rest[1:])) if derivatives == 2 else None
        error = dr.fma(_SHARE, error, unsure)
        return _SHARE * value, gradient, hessian, error

    def _near(
        self, node: Node, near: Mask, x: Vec3, derivatives: int, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """The sums with the triangles of a leaf added, with one arctangent for all of them."""
        real = self.backend.Float

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            zr, zi, turns, *rest, unsure = state
            triangle = NearTriangle.of(row, x)
            re, im = triangle.factor()
            unsure = unsure + dr.select(active, triangle.unsure(re, im, self.backend.epsilon), 0)
            zr, zi, turns = times(zr, zi, turns, re, im)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(active, triangle.gradient(), 0)
            if derivatives == 2:
                rest[1:] = triangle.add_hessian(SymmetricSum(*rest[1:]), active).parts()
            return zr, zi, turns, *rest, unsure

        value, *rest = state
        zr, zi, turns, *rest = for_each(node, near, add, (real(1), real(0), real(0), *rest))
        return value + dr.select(near, whole_angle(zr, zi, turns), 0), *rest

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """No crossings are counted: every sum is the whole of w."""
        del frame, t, active
        return self.backend.Float(0)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, turns: Real, fine: Mask
    ) -> Sample:
        """w on a stretch of a ray, with a certificate.

        Certificate. Far dipoles: see `nearby.Nearby.sample`. By Stokes the near triangles'
        field is that of the boundary of their union. An edge of length L that is not singular and
        nearer than (accuracy - 1) L/2 is not part of it: a far node with a triangle at it has
        radius R >= L/2 and is farther than accuracy R, hence the edge farther than
        (accuracy - 1) R. All other edges count as *open*, and f is harmonic as far as the nearest
        of them. Along a line the k-th derivative of an edge's field is at most the integral of
        k!/rho^(k+1) over it (Biot and Savart), so that Taylor's remainder after the linear term is
        at most that of t^2/(rho^3 (1-t/rho)). With a = L/2 and distance d an edge has
        int rho^-3 <= 2a/(d^2 sqrt(d^2+a^2)) =: 2e, int rho^-4 <= 2e/d; and 1/(1-q) <=
        1 + q/(1-b) <= 1 + q rise/4 on [0, b]. So an edge adds to the remainder what
        s4 += 2e/3 and s5 += e/(2d) do.

        A triangle that the ray passes is told which side of it x is on: behind those passed up to
        the start of the stretch, before all others. Its own sign is rounded where x lies on it, as
        it does on several at once where sheets overlap.
        """
        del turns

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return self._near_certified(node, near, x, frame, behind, fine, sums)

        real, epsilon = self.backend.Float, self.backend.epsilon
        found, (beside, unsure) = self.clusters.near(x, fine, leaf, (real(dr.inf), real(0)))
        # Beside an edge, open or not, a triangle turns by pi within the rounding of its place.
        turned = fmin(2 * epsilon * dr.rsqrt(beside), real(1))
        return found.sample(_SHARE, self.rounding + turned + unsure)

    def _near_certified(
        self, node: Node, near: Mask, x: Vec3, frame: Frame, behind: Crossing,
        fine: Mask, state: tuple[Any, ...],
    ) -> tuple[Any, ...]:  # fmt: skip
        real, index = self.backend.Float, self.backend.UInt32
        # Edges nearer than this many half lengths have both their triangles among the near ones.
        reach = dr.select(fine, real(self.clusters.accuracy), self.clusters.rough)
        closed = dr.square(0.5 * (reach - 1))

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            zr, zi, turns, g, clear, s4, s5, beside, unsure = state
            triangle = NearTriangle.of(row, x)
            re, im = triangle.factor()
            unsure = unsure + dr.select(active, triangle.unsure(re, im, self.backend.epsilon), 0)
            t, turn = crossing(row, frame)
            passed = (t < behind.t) | ((t == behind.t) & (index(row[INDEX]) <= behind.sheet))
            # Not zero, as on a plane that coordinates hit exactly: zero has no side.
            told = dr.mulsign(fmax(dr.abs(im), 1e-30), dr.select(passed, -turn, turn))
            im = dr.select(turn != 0, told, im)
            zr, zi, turns = times(zr, zi, turns, re, im)
            g = g + dr.select(active, triangle.gradient(), 0)
            distances = triangle.squared_distances()
            for k, (near2, inverse) in enumerate(zip(distances, triangle.inverse, strict=True)):
                beside = dr.select(active & (inverse > 0), fmin(near2, beside), beside)
                open_ = (row[_SINGULAR + k] > 0) | (near2 * inverse >= closed)
                open_ &= active & (inverse > 0)
                clear = dr.select(open_, fmin(dr.sqrt(near2), clear), clear)
                e = dr.select(open_, edge_variation(near2, inverse)[1], 0)
                s4 = dr.fma(2 / 3, e, s4)
                s5 = dr.fma(0.5 * dr.rsqrt(fmax(near2, 1e-37)), e, s5)
            return zr, zi, turns, g, clear, s4, s5, beside, unsure

        value, g, error, slope_error, clear, s4, s5, beside, unsure = state
        begin = (real(1), real(0), real(0), g, clear, s4, s5, beside, unsure)
        zr, zi, turns, g, clear, s4, s5, beside, unsure = for_each(node, near, add, begin)
        value = value + dr.select(near, whole_angle(zr, zi, turns), 0)
        return value, g, error, slope_error, clear, s4, s5, beside, unsure
