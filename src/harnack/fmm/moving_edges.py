"""Solid angles of edges whose ends move, and their gradients, as expressions that Dr.Jit
differentiates by points and by the ends of edges (`pair_sums`). Other sums over edges
(`fmm.edges`) are faster, and have no derivatives by vertices.

The edges of one sum must together bound something: each vertex is the end of as many edges as it is
the start of. Then the sum of their angles is the solid angle Omega of the curve that they form,
modulo 4 pi, and the sum of their fields is its gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import IntArray, to_vector3
from harnack.backend.arrays import gather_vectors, upload_integers
from harnack.fmm.edges import inner_product, spinor
from harnack.fmm.pair_sums import pair_sum

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fmm.unit_frame import UnitFrame


@dataclass(frozen=True)
class MovingEdges:
    """Edges in the unit coordinates of a field, whose ends may have derivatives.

    frame: the unit coordinates. Their center and size are constants.
    ends: the coordinates of all starts, and of all ends: six arrays of an entry for each edge.
    """

    frame: UnitFrame
    ends: tuple[Real, ...]

    @classmethod
    def of_loops(cls, frame: UnitFrame, loops: Sequence[Any]) -> MovingEdges:
        """The edges of closed loops.

        loops: the vertices of each loop, as an array (m, 3) or as a Dr.Jit vector.
        """
        parts: list[list[Real]] = []
        for loop in loops:
            count = dr.width(loop) if dr.is_array_v(type(loop)) else len(loop)
            start = np.arange(count)
            end = np.append(start[1:], 0)
            parts.append(_coordinates(frame, loop, start, end))
        ends = (
            parts[0]
            if len(parts) == 1
            else [dr.concat(entry) for entry in zip(*parts, strict=True)]
        )
        return cls(frame, tuple(ends))

    @classmethod
    def of_pairs(cls, frame: UnitFrame, vertices: Any, pairs: IntArray) -> MovingEdges:
        """The edges between vertices, a Dr.Jit vector of n lanes or an array (n, 3). pairs: the
        indices (k, 2) of the vertices from which and to which the k edges run."""
        return cls(frame, tuple(_coordinates(frame, vertices, pairs[:, 0], pairs[:, 1])))

    def angle(self, p: Vec3, ranges: tuple[Any, Any] | None = None) -> Real:
        """The solid angle Omega of all edges at points p (3, n) of space, modulo 4 pi.

        ranges: the first edge and the number of edges that are added up, for each point; None for
            all edges.

        Each edge adds twice the argument of an inner product of spinors, one for each end. The
        phase of a vertex's spinor is arbitrary; it enters the edges at the vertex with opposite
        signs. A single angle may jump by 4 pi; its derivative does not.
        """
        vector = self.frame.backend.Array3f

        def angle(x: Vec3, ends: tuple[Real, ...]) -> tuple[Real, ...]:
            """The angle of one edge. (The result of `spinor` ends with the spinor.)"""
            a, b = vector(*ends[:3]) - x, vector(*ends[3:]) - x
            re, im = inner_product(spinor(a)[2], spinor(b)[2])
            return (2 * dr.atan2(im, re),)

        x = self.frame.to_unit(p)
        return pair_sum(self.frame.backend, angle, x, self.ends, ranges)[0]

    def gradient(self, p: Vec3, ranges: tuple[Any, Any] | None = None) -> Vec3:
        """The gradient (3, n) of the solid angle at points p (3, n) of space. ranges: as for
        `angle`.

        Each edge adds its field by Biot and Savart (`edges.Edge`). From x, its ends are a and b,
        and its points a + s e with e = b - a and s in [0, 1]. The field is the integral of D x dD
        over |D|^3 with D = a + s e. Here D x dD = a x e ds, and |D|^2 is a quadratic polynomial of
        s, so that the integral of |D|^-3 is

            w = (|a| + |b|)/(|a||b| (|a||b| + a.b)).

        Near the edge, where a.b < 0, the last factor cancels. It is then replaced by
        |a x e|^2/(|a||b| - a.b), as |a|^2 |b|^2 - (a.b)^2 = |a x b|^2 and a x b = a x e.

        With unit coordinates x = (p - center)/size and Omega unchanged by scaling, the gradient by
        p is that by x over the size.
        """
        vector = self.frame.backend.Array3f

        def field(x: Vec3, ends: tuple[Real, ...]) -> tuple[Real, ...]:
            """The field of one edge."""
            start, end = vector(*ends[:3]), vector(*ends[3:])
            a, b = start - x, end - x
            cross, product, dot = dr.cross(a, end - start), dr.norm(a) * dr.norm(b), dr.dot(a, b)
            is_obtuse = dot < 0
            numerator = (dr.norm(a) + dr.norm(b)) * dr.select(is_obtuse, product - dot, 1)
            denominator = dr.select(is_obtuse, dr.squared_norm(cross), product + dot)
            term = numerator / (product * denominator) * cross
            return term.x, term.y, term.z

        x = self.frame.to_unit(p)
        return vector(*pair_sum(self.frame.backend, field, x, self.ends, ranges)) / self.frame.size


def _coordinates(frame: UnitFrame, vertices: Any, start: IntArray, end: IntArray) -> list[Real]:
    """The coordinates of the starts and of the ends of edges, six arrays, in unit coordinates.

    vertices: a Dr.Jit vector of n lanes, or an array (n, 3).
    start, end: (k,) indices of vertices.
    """
    backend, zero = frame.backend, dr.zeros(frame.backend.Float, len(start))
    if not dr.is_array_v(type(vertices)):
        vertices = to_vector3(backend, np.asarray(vertices))
    points = (
        frame.to_unit(gather_vectors(backend, vertices, upload_integers(backend, index)))
        for index in (start, end)
    )
    # A coordinate that all vertices share has a single entry: the zeros repeat it.
    return [coordinate + zero for point in points for coordinate in point]
