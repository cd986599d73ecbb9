"""The solid angle of closed trails of edges along rays, edge by edge, and as fast as it will go.

The formula is that of `edge_lift`, and its decisions are made by the same bits. A close sum over a
tree of chains (`EdgeChains`) goes down to most of its leaves, on other ways in neighboring lanes,
so that up to some thousands of edges a plain loop over all of them is faster, and exact. What is
needed of a vertex is computed once and not once for each of its edges, and roots and divisions,
which cost most, are shared by edges where a bound allows it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.backend.records import Records
from harnack.fields.edges.edge import Edge
from harnack.fields.edges.edge_lift import LiftedProduct, ends_factor, sight_of
from harnack.fields.edges.edge_records import inverse_squares
from harnack.fields.sums import FieldSums
from harnack.fields.unit_coordinates import epsilon_at

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.tree.triangles import Frame

__all__ = ["LiftedTrails"]

# Edges of a record, whichever of these wastes less: five numbers each and three more fill packets.
_RUNS = 3, 4


@dataclass(frozen=True)
class LiftedTrails:
    """Closed trails of edges on a backend, as records of `run` consecutive edges.

    A record holds run + 1 vertices, run numbers 1/length^2, and run lengths: negative where the
    edge runs from a higher to a lower index, 0 where there is no edge.
    """

    records: Records
    run: int

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, trails: list[IntArray]) -> LiftedTrails:
        """Trails of vertices (n, 3), each ending where it begins."""
        run = min(_RUNS, key=lambda run: sum(-(-(len(t) - 1) // run) for t in trails) * (run + 0.5))
        rounded = vertices.astype(backend.dtype).astype(np.float64)
        rows = [_rows(rounded, trail, run) for trail in trails]
        return cls(Records.upload(backend, np.concatenate(rows)), run)

    def near(self, frame: Frame, x: Vec3, active: Mask = True) -> FieldSums:
        """The sum of Omega_e at points x of rays, where active, and what a certificate needs.

        Derivatives. With w of `edge`, L w is the integral of |dp|/rho^3 over an edge, and 1/d times
        that bounds the integral of |dp|/rho^4, d the distance to it; for edges of a record at most
        1/d of the nearest. So they add to the remainder what s4 += L w/4 and s5 += 3 L w/(16 d) do
        (`LiftedEdge.bounds`).

        Rounding. An angle is off by `unit` times Biot and Savart's field, which is at most d L w:
        |a x e| is the length of e times the distance from its line. By Cauchy and Schwarz these add
        up over a record to at most the root of (sum of L w) (sum of d^2 L w). d is less by what
        rounding may have done to it, for all bounds.
        """
        backend = self.records.backend
        real, unit = backend.Float, fmax(epsilon_at(frame.o), epsilon_at(x))

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            product, g, least, rounding, s4, s5 = state
            product = LiftedProduct(*product)
            a = sight_of(self._vertex(row, 0), frame, x)
            total, spread, nearest = real(0), real(0), real(dr.inf)
            for k in range(self.run):
                p, q = self._vertex(row, k), self._vertex(row, k + 1)
                inverse, signed = self._edge(row, k)
                b = sight_of(q, frame, x)
                re, im = ends_factor(a, b, signed)
                is_edge = signed != 0
                product = product.times(dr.select(is_edge, re, 1), dr.select(is_edge, im, 0))
                edge = Edge(a.offset, b.offset, q - p, inverse)
                w, c = edge.field_of_lengths(a.length, b.length)
                g = dr.fma(type(g)(w), c, g)
                integral = dr.abs(signed) * w
                square = dr.select(is_edge, edge.square, dr.inf)
                total, nearest = total + integral, fmin(nearest, square)
                spread = spread + dr.select(is_edge, integral * square, 0)
                a = b
            distance = fmax(dr.sqrt(nearest) - 2 * unit, 0)
            rounding = dr.fma(unit, dr.sqrt(total * spread), rounding)
            s5 = dr.fma(0.1875 * total, dr.rcp(distance), s5)
            return product.parts(), g, fmin(nearest, least), rounding, s4 + 0.25 * total, s5

        one = LiftedProduct.one(real).parts()
        start = (one, backend.Array3f(0), real(dr.inf), real(0), real(0), real(0))
        product, g, least, rounding, s4, s5 = self.records.for_each(
            add, start, "trails along", active
        )
        sums = FieldSums.zero(backend, dr.inf, 1)
        return dataclasses.replace(
            sums,
            value=LiftedProduct(*product).angle(),
            gradient=g,
            rounding=rounding,
            free_distance=dr.sqrt(least),
            s4=s4,
            s5=s5,
        )

    def _vertex(self, row: list[Real], k: int) -> Vec3:
        return self.records.backend.Array3f(*row[3 * k : 3 * k + 3])

    def _edge(self, row: list[Real], k: int) -> tuple[Real, Real]:
        """1/length^2 and the signed length of edge k of a record."""
        first = 3 * (self.run + 1)
        return row[first + k], row[first + self.run + k]


def _rows(vertices: FloatArray, trail: IntArray, run: int) -> FloatArray:
    """Records of a trail; edges that fill the last one up have no length."""
    count = len(trail) - 1
    trips = -(-count // run)
    index = np.minimum(run * np.arange(trips)[:, None] + np.arange(run + 1), count)
    path = trail[index]
    begin, end = path[:, :-1], path[:, 1:]
    inverse = inverse_squares((vertices[end] - vertices[begin]).reshape(-1, 3)).reshape(trips, run)
    length = np.where(begin < end, 1, -1) / np.sqrt(inverse)
    length = np.where(index[:, :-1] < index[:, 1:], length, 0)
    return np.concatenate([vertices[path].reshape(trips, -1), inverse, length], axis=1)
